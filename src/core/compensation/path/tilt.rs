//! A head that tilts its wheel about one axis: how far at a place, and where the slides must be then.
//!
//! ```text
//!  constant    t = a
//!  following   t = f(n) + a      f: the turn that lays z along the normal n, seen along the axis
//!  spindle     R(t) s            s: the spindle upright
//!  slides      c + (R(t) - 1) v  v: from the wheel's centre to the pivot, upright; 0 where the control keeps the centre by itself
//! ```
//!
//! With the normal turned into the wheel's frame nothing else changes: the wheel touches where it would touch that normal upright, turned
//! back. While it turns along the track it still touches the surface all along, since at every place of the track it does.

use crate::geometry::{Point, Vector};

use super::options::PathOptions;
use super::wanted::Contact;
use super::{PathError, Wheel};

/// The axis of the model frame that a head turns about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TurnAxis {
    /// x, which an A turns about.
    X,
    /// y, which a B turns about.
    Y,
}

/// The rotary axis of a head.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rotary {
    /// What programs call it.
    pub letter: char,
    /// What it turns about, right-handed.
    pub about: TurnAxis,
    /// Whether its scale counts the other way.
    pub reversed: bool,
    /// Least and largest angle on its scale.
    pub range_rad: [f64; 2],
    /// Largest rate.
    pub rate_rad_s: f64,
    /// What its scale is written in multiples of; 0 where every angle can be written.
    pub step_rad: f64,
    /// From the wheel's centre to the pivot with the head upright; `None` where the control keeps the centre where programs say.
    pub pivot_mm: Option<Vector>,
}

/// How a wheel leans, right-handed about the axis of its head.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lean {
    /// By the same angle everywhere.
    Constant {
        /// The angle.
        angle_rad: f64,
    },
    /// After the normal of the surface, seen along the axis.
    Following {
        /// From the normal to the upright direction of the head.
        lead_rad: f64,
    },
}

/// Where the wheel stands at a place of a track, and what a program says of it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stand {
    /// The centre of the wheel and its tilt, to rounding.
    pub(super) centre: Point,
    pub(super) tilt_rad: f64,
    /// The point that a program moves, and the tilt as it can be written.
    pub(super) at: Point,
    pub(super) written_rad: f64,
}

/// How a step leaves the path, in millimetres.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sag {
    /// How far its middle is from where the control leads the wheel.
    pub(super) sag: f64,
    /// How far the wheel's centre goes.
    pub(super) chord: f64,
    /// How far the slides are from the straight way between its ends.
    pub(super) bent: f64,
}

impl Rotary {
    /// Returns a direction of the upright head after a turn.
    #[inline]
    pub fn turned(&self, v: &Vector, angle_rad: f64) -> Vector {
        let (s, c) = angle_rad.sin_cos();
        match self.about {
            TurnAxis::X => Vector::new(v.x, v.y * c - v.z * s, v.y * s + v.z * c),
            TurnAxis::Y => Vector::new(v.x * c + v.z * s, v.y, v.z * c - v.x * s),
        }
    }

    /// Returns what the scale shows after a turn, in rad.
    pub fn on_scale_rad(&self, angle_rad: f64) -> f64 {
        if self.reversed { 0.0 - angle_rad } else { angle_rad }
    }

    /// Returns how far the slides are from where they would hold the wheel's centre upright, in millimetres: (R - 1) v.
    #[inline]
    pub fn shift_mm(&self, angle_rad: f64) -> Vector {
        self.pivot_mm.map_or_else(Vector::zeros, |pivot| self.turned(&pivot, angle_rad) - pivot)
    }

    /// The turn that lays z along a normal, seen along the axis.
    #[inline]
    fn along(&self, normal: &Vector) -> f64 {
        match self.about {
            TurnAxis::X => (-normal.y).atan2(normal.z),
            TurnAxis::Y => normal.x.atan2(normal.z),
        }
    }

    #[inline]
    fn rounded(&self, angle_rad: f64) -> f64 {
        if self.step_rad > 0.0 { (angle_rad / self.step_rad).round() * self.step_rad } else { angle_rad }
    }

    /// How far the slides are lifted at most by a turn within the range.
    fn most_lift_mm(&self) -> f64 {
        let [a, b] = self.range_rad.map(|angle| self.on_scale_rad(angle));
        // The height is a sine of the angle: so many looks find its top to a millionth of the way to the pivot.
        const LOOKS: u32 = 2000;
        let at = |k: u32| a + (b - a) * f64::from(k) / f64::from(LOOKS);
        (0..=LOOKS).map(|k| self.shift_mm(at(k)).z).fold(f64::NEG_INFINITY, f64::max)
    }
}

impl PathOptions {
    /// Returns how far the head is turned where the wheel touches a place; 0 for a wheel that does not lean.
    #[inline]
    pub fn tilt_rad(&self, contact: &Contact) -> f64 {
        match (self.lean, &self.rotary) {
            (Some(Lean::Constant { angle_rad }), _) => angle_rad,
            (Some(Lean::Following { lead_rad }), Some(rotary)) => rotary.along(&contact.normal) + lead_rad,
            _ => 0.0,
        }
    }

    /// Returns the wheel as it stands where it touches a place.
    #[inline]
    pub fn wheel_at(&self, contact: &Contact) -> Wheel {
        if self.lean.is_none() { self.wheel } else { self.wheel_turned(self.tilt_rad(contact)) }
    }

    /// Returns the upright direction of the head where the wheel touches a place.
    #[inline]
    pub fn head_at(&self, contact: &Contact) -> Vector {
        let turned = |rotary: &Rotary| rotary.turned(&Vector::z(), self.tilt_rad(contact));
        self.rotary.as_ref().map_or_else(Vector::z, turned)
    }

    fn wheel_turned(&self, angle_rad: f64) -> Wheel {
        let Some(rotary) = &self.rotary else { return self.wheel };
        let mut wheel = self.wheel;
        if let Wheel::Torus { spindle, .. } | Wheel::Cup { spindle, .. } = &mut wheel {
            *spindle = rotary.turned(spindle, angle_rad);
        }
        wheel
    }

    /// Returns the axis by which the wheel leans, if it does.
    #[inline]
    pub fn leaning(&self) -> Option<&Rotary> {
        self.lean.and(self.rotary.as_ref())
    }

    /// Where the wheel stands when it touches a place, lifted off by so much along the normal; `None` where a rim cannot touch it.
    #[inline]
    pub(super) fn stand(&self, contact: &Contact, lifted_mm: f64) -> Option<Stand> {
        let centre = |wheel: Wheel| {
            let touching = wheel.centre(contact)?;
            Some(if lifted_mm > 0.0 { touching + contact.normal * lifted_mm } else { touching })
        };
        let Some(rotary) = self.leaning() else {
            let centre = centre(self.wheel)?;
            return Some(Stand { centre, tilt_rad: 0.0, at: centre, written_rad: 0.0 });
        };
        let tilt_rad = self.tilt_rad(contact);
        // The centre is that of the angle that is written, and so nothing of the surface is lost by the digits of the angle.
        let written_rad = rotary.rounded(tilt_rad);
        let at = centre(self.wheel_turned(written_rad))? + rotary.shift_mm(written_rad);
        Some(Stand { centre: centre(self.wheel_turned(tilt_rad))?, tilt_rad, at, written_rad })
    }

    /// Looks at a step by its middle. The control moves slides and head in proportion; a ring that is turned otherwise than it should be counts as
    /// far as its own places move.
    #[inline]
    pub(super) fn sag_mm(&self, from: &Stand, middle: &Stand, to: &Stand) -> Sag {
        let (chord, half) = (to.centre - from.centre, middle.centre - from.centre);
        let length2 = chord.norm_squared();
        let share = if length2 > 0.0 { half.dot(&chord) / length2 } else { 0.0 };
        let (Some(rotary), Some(Lean::Following { .. })) = (self.leaning(), self.lean) else {
            let sag = (half - chord * share).norm();
            return Sag { sag, chord: length2.sqrt(), bent: sag };
        };
        let turn = |stand: &Stand| rotary.shift_mm(stand.tilt_rad);
        let turned = from.tilt_rad + share * (to.tilt_rad - from.tilt_rad);
        let slides = chord * share + turn(from) + (turn(to) - turn(from)) * share;
        let bent = (half + turn(middle) - slides).norm();
        let off = half - (slides - rotary.shift_mm(turned));
        let along = if length2 > 0.0 { off.dot(&chord) / length2 } else { 0.0 };
        let ring_mm = match self.wheel {
            Wheel::Sphere { .. } => 0.0,
            Wheel::Torus { ring_mm, .. } | Wheel::Cup { ring_mm, .. } => ring_mm,
        };
        let sag = (off - chord * along).norm() + ring_mm * (middle.tilt_rad - turned).abs();
        Sag { sag, chord: length2.sqrt(), bent }
    }

    /// How much higher the slides must be than the highest place of the wheel's centre, whatever the head is turned to.
    pub(super) fn lift_mm(&self) -> f64 {
        self.leaning().map_or(0.0, Rotary::most_lift_mm)
    }

    /// The height that has to be travelled over: of the wheel's centre, and where the wheel is turned in the air, as high as any place of it may
    /// come to lie.
    #[inline]
    pub(super) fn height_mm(&self, contact: &Contact, lifted_mm: f64, stand: &Stand) -> f64 {
        match self.lean {
            None | Some(Lean::Constant { angle_rad: 0.0 }) => stand.centre.z,
            _ => {
                let place = contact.point + contact.normal * lifted_mm;
                stand.centre.z.max(place.z + self.wheel.reach_mm())
            }
        }
    }
}

/// Says of a wheel that cannot reach a place upright by how much it must be tilted, where the machine can and that does.
pub(super) fn or_tilted(
    refused: PathError,
    options: &PathOptions,
    mut would_do: impl FnMut(PathOptions) -> bool,
) -> PathError {
    const STEP_DEG: f64 = 5.0;
    const MOST_DEG: f64 = 90.0;
    let is_of_reach = matches!(
        refused,
        PathError::Steep { .. } | PathError::CannotTouch { .. } | PathError::Body { .. } | PathError::Hollow { .. }
    );
    let (Some(rotary), None, true, false) = (&options.rotary, options.lean, is_of_reach, options.from_below) else {
        return refused;
    };
    let [least, most] = rotary.range_rad;
    let steps = (1..=(MOST_DEG / STEP_DEG) as i32).flat_map(|k| [k, -k]).map(|k| STEP_DEG * f64::from(k));
    let found = steps.filter(|deg| (least..=most).contains(&rotary.on_scale_rad(deg.to_radians()))).find(|deg| {
        let lean = Some(Lean::Constant { angle_rad: deg.to_radians() });
        would_do(PathOptions { lean, ..*options })
    });
    match found {
        Some(angle_deg) => PathError::Upright { refused: Box::new(refused), letter: rotary.letter, angle_deg },
        None => refused,
    }
}

#[cfg(test)]
mod tests {
    use super::super::fit::tests::{PART, ball, path, quadric, surface};
    use super::super::{Limits, Move, Scallops, ToolPath};
    use super::*;

    const PIVOT: Vector = Vector::new(0.0, 0.0, 200.0);

    fn head(about: TurnAxis) -> Rotary {
        let letter = if about == TurnAxis::X { 'A' } else { 'B' };
        Rotary {
            letter,
            about,
            reversed: false,
            range_rad: [-2.0, 2.0],
            rate_rad_s: 10.0,
            step_rad: 0.0,
            pivot_mm: Some(PIVOT),
        }
    }

    fn leaning(rotary: Rotary, lean: Lean, wheel: Wheel) -> PathOptions {
        PathOptions { wheel, rotary: Some(rotary), lean: Some(lean), ..ball(1.0) }
    }

    /// Where slides and head are at feed, and how far the centre goes there.
    fn feeds(path: &ToolPath) -> Vec<(Point, f64, f64)> {
        let of = |one| match one {
            Move::FeedTilted { at, tilt_rad, centre_mm, .. } => Some((at, tilt_rad, centre_mm)),
            _ => None,
        };
        path.moves().filter_map(of).collect()
    }

    #[test]
    fn a_ball_tilted_by_thirty_degrees_on_a_plane_by_hand() {
        let tilted = |about| {
            let lean = Lean::Constant { angle_rad: 30f64.to_radians() };
            path(quadric(0.0, 0.0), leaning(head(about), lean, Wheel::Sphere { radius_mm: 10.0 })).unwrap()
        };
        let upright: Vec<Point> = path(quadric(0.0, 0.0), ball(10.0))
            .unwrap()
            .moves()
            .filter_map(|one| if let Move::Feed { at, .. } = one { Some(at) } else { None })
            .collect();
        // The pivot swings to +x by 200 sin 30 when B turns, to -y when A does, and comes down by 200 (1 - cos 30).
        for (about, by) in [
            (TurnAxis::Y, Vector::new(100.0, 0.0, -26.794_919_243_112_27)),
            (TurnAxis::X, Vector::new(0.0, -100.0, -26.794_919_243_112_27)),
        ] {
            let found = feeds(&tilted(about));
            assert_eq!(found.len(), upright.len());
            for ((at, tilt, _), plain) in found.into_iter().zip(&upright) {
                assert!((at - plain - by).norm() < 1e-9 && (tilt - 30f64.to_radians()).abs() < 1e-15, "{at} {plain}");
            }
        }
    }

    #[test]
    fn a_tilt_of_nothing_is_the_upright_path() {
        for wheel in [
            Wheel::Sphere { radius_mm: 10.0 },
            Wheel::Torus { ring_mm: 8.0, tube_mm: 2.0, spindle: Vector::y() },
            Wheel::tilted_cup(6.0, 1.0, 0.5),
        ] {
            let lean = Lean::Constant { angle_rad: 0.0 };
            let tilted = path(quadric(0.01, -0.004), leaning(head(TurnAxis::Y), lean, wheel)).unwrap();
            let plain = path(quadric(0.01, -0.004), PathOptions { wheel, ..ball(1.0) }).unwrap();
            for (a, b) in tilted.moves().zip(plain.moves()) {
                let upright = match a {
                    Move::RapidTilted { to_mm, tilt_rad: 0.0 } => Move::RapidXy(to_mm),
                    Move::FeedTilted { at, tilt_rad: 0.0, feed_mm_min, .. } => Move::Feed { at, feed_mm_min },
                    other => other,
                };
                assert_eq!(upright, b);
            }
            let [a, b] = [&tilted, &plain].map(|path| path.summary().unwrap());
            assert_eq!((a.moves, a.length_mm, a.speed_mm_s), (b.moves, b.length_mm, b.speed_mm_s));
        }
    }

    #[test]
    fn a_wheel_that_follows_keeps_its_lead() {
        // Along x the normal turns by -atan(2 a x), which B takes up; seen along y it is no more than that.
        let (a, lead) = (0.02f64, 0.5);
        let follows = leaning(head(TurnAxis::Y), Lean::Following { lead_rad: lead }, Wheel::Sphere { radius_mm: 8.0 });
        let laid = path(quadric(a, 0.0), follows).unwrap();
        for x in [-7.0, 0.0, 5.0] {
            let contact = laid.wanted().at([x, 1.0]);
            let tilt = follows.tilt_rad(&contact);
            assert!((tilt - (lead - (2.0 * a * x).atan())).abs() < 1e-6, "{tilt} at {x}");
            assert!((contact.normal.angle(&follows.head_at(&contact)) - lead).abs() < 1e-6);
        }
        assert!((laid.least_lean_rad() - lead).abs() < 1e-6);
        let turned = laid.summary().unwrap().turned.unwrap();
        assert!(turned.least_rad.value < 0.2 && turned.most_rad.value > 0.8 && turned.rate_rad_s.value > 0.1);
    }

    #[test]
    fn between_its_points_the_wheel_touches_too_when_slides_and_head_move_in_proportion() {
        let part = || quadric(0.02, -0.01);
        for (about, wheel) in [
            (TurnAxis::Y, Wheel::Sphere { radius_mm: 8.0 }),
            (TurnAxis::X, Wheel::Sphere { radius_mm: 8.0 }),
            (TurnAxis::Y, Wheel::tilted_cup(6.0, 1.0, 0.2)),
            (TurnAxis::X, Wheel::Torus { ring_mm: 8.0, tube_mm: 2.0, spindle: Vector::y() }),
        ] {
            let rotary = Rotary { step_rad: 1e-4f64.to_radians(), ..head(about) };
            let laid = path(part(), leaning(rotary, Lean::Following { lead_rad: -0.4 }, wheel)).unwrap();
            let found = feeds(&laid);
            let ground: Vec<Point> = (0..400 * 121)
                .map(|k| [-8.0 + 0.04 * f64::from(k % 400), f64::from(k / 400) * 0.1 - 6.0])
                .map(|at| laid.wanted().at(at).point)
                .collect();
            let mut looked = 0;
            for pair in found.windows(2).step_by(97).filter(|pair| (pair[1].0 - pair[0].0).norm() < 5.0) {
                let (at, tilt) = (nalgebra::center(&pair[0].0, &pair[1].0), 0.5 * (pair[0].1 + pair[1].1));
                let centre = at - rotary.shift_mm(tilt);
                let stands = laid.options().wheel_turned(tilt);
                let near = |p: &&Point| (**p - centre).norm() < wheel.reach_mm() + 0.1;
                let nearest = ground.iter().filter(near).map(|p| stands.distance_mm(&(p - centre)));
                let nearest = nearest.fold(f64::INFINITY, f64::min);
                // The wheel comes down, or is over the edge; else within the chord error and the gap between places that are looked at.
                if nearest < 2e-3 {
                    assert!(nearest > -1.3e-4, "{about:?} {wheel:?}: {nearest} at {at}");
                    looked += 1;
                }
            }
            assert!(looked > 20, "{looked}");
        }
    }

    #[test]
    fn what_the_head_cannot_do_is_refused_with_what_would_do() {
        let follows = Lean::Following { lead_rad: 0.5 };
        let wheel = Wheel::Sphere { radius_mm: 8.0 };
        let of = |rotary| path(quadric(0.02, 0.0), leaning(rotary, follows, wheel)).unwrap().summary().unwrap();
        let limits = Limits::default();
        assert_eq!(of(head(TurnAxis::Y)).check(&limits), Ok(()));
        let narrow = Rotary { range_rad: [-1.0, 0.7], ..head(TurnAxis::Y) };
        let Err(PathError::Tilt { letter: 'B', found_deg, x_mm, by_deg, .. }) = of(narrow).check(&limits) else {
            panic!()
        };
        assert!(x_mm > -20.0 && found_deg > 40.2 && (found_deg - 0.7f64.to_degrees() - by_deg).abs() < 1e-9);
        // Its scale counts the other way.
        let reversed = Rotary { reversed: true, range_rad: [-1.0, -0.1], ..head(TurnAxis::Y) };
        assert_eq!(of(reversed).check(&limits), Ok(()));
        let lazy = Rotary { rate_rad_s: 0.05, ..head(TurnAxis::Y) };
        let Err(PathError::Rate { feed_mm_min, .. }) = of(lazy).check(&limits) else { panic!() };
        let slower = PathOptions { feed_mm_min: 0.999 * feed_mm_min, ..leaning(lazy, follows, wheel) };
        assert_eq!(path(quadric(0.02, 0.0), slower).unwrap().summary().unwrap().check(&limits), Ok(()));
        for (options, expected) in [
            (PathOptions { rotary: None, ..slower }, PathError::NoRotary),
            (PathOptions { from_below: true, ..slower }, PathError::TiltBelow),
        ] {
            assert_eq!(path(quadric(0.0, 0.0), options).unwrap_err(), expected);
        }
        let pole = PathOptions { lean: Some(Lean::Following { lead_rad: 0.01 }), ..slower };
        assert!(matches!(path(quadric(0.0, 0.0), pole), Err(PathError::Option { key: "lead of a ball (rad)", .. })));
    }

    #[test]
    fn a_wheel_that_cannot_reach_upright_is_told_by_how_much_to_tilt() {
        // A flank of 74 degrees, on which the spindle of an upright wheel is in the way.
        let flank = || surface(|[x, y]| (3.5 * y + 0.01 * x * x, [0.02 * x, 3.5]));
        let upright = PathOptions { rotary: Some(head(TurnAxis::X)), ..ball(5.0) };
        let Err(PathError::Upright { refused, letter: 'A', angle_deg }) = path(flank(), upright) else { panic!() };
        assert!(matches!(*refused, PathError::Steep { .. }), "{refused}");
        // 74.05 - 68.75 degrees and more, towards the normal, which leans to -y.
        assert_eq!(angle_deg, 10.0);
        let tilted = PathOptions { lean: Some(Lean::Constant { angle_rad: angle_deg.to_radians() }), ..upright };
        assert!(path(flank(), tilted).is_ok());
        // About y it would not do, and a machine without the axis is told what it was told before.
        let about_y = PathOptions { rotary: Some(head(TurnAxis::Y)), ..upright };
        assert!(matches!(path(flank(), about_y), Err(PathError::Steep { .. })));
        assert!(matches!(path(flank(), ball(5.0)), Err(PathError::Steep { .. })));
        // A cup that is tilted less than the dome slopes.
        let cup = PathOptions { wheel: Wheel::tilted_cup(6.0, 1.0, 0.15), ..about_y };
        let refused = path(quadric(-0.0125, -0.001), cup).unwrap_err();
        let PathError::Upright { angle_deg, .. } = refused else { panic!("{refused}") };
        let lean = Some(Lean::Constant { angle_rad: angle_deg.to_radians() });
        assert!(angle_deg < 0.0 && path(quadric(-0.0125, -0.001), PathOptions { lean, ..cup }).is_ok(), "{angle_deg}");
    }

    #[test]
    fn scallops_are_those_of_the_wheel_as_it_stands() {
        // A disc that rolls along the track, tilted across it by 0.5: its ring is seen under that angle, its rim as it was.
        let disc = Wheel::Torus { ring_mm: 40.0, tube_mm: 5.0, spindle: Vector::y() };
        let lean = Lean::Constant { angle_rad: 0.5 };
        let laid = path(quadric(0.0, 0.0), leaning(head(TurnAxis::X), lean, disc)).unwrap();
        let found = Scallops::between(
            laid.wanted(),
            &PART,
            |contact| laid.options().wheel_at(contact),
            laid.options().pattern,
            0.5,
        );
        assert!((found.height_mm - 0.25 / 8.0 / 5.0).abs() < 1e-12, "{found:?}");
        let across =
            leaning(head(TurnAxis::X), lean, Wheel::Torus { ring_mm: 40.0, tube_mm: 5.0, spindle: Vector::x() });
        let laid = path(quadric(0.0, 0.0), across).unwrap();
        // Across the tracks the disc with its spindle along them is as round as its rim's outer circle.
        assert!((laid.scallops().height_mm - laid.track_mm().powi(2) / 8.0 / 45.0).abs() < 1e-12);
    }
}
