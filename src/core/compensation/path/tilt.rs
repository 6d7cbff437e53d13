//! Tilt of the wheel by a head with one rotary axis: tilt angle at a contact, and position of the slides for it.
//!
//! ```text
//!  constant    t = a
//!  following   t = f(n) + a      f: rotation that brings z onto the normal n, seen along the axis
//!  spindle     R(t) s            s: direction of the spindle with the head upright
//!  slides      c + (R(t) - 1) v  v: from the wheel's centre c to the pivot, head upright;
//!                                   0 if the control itself keeps the centre in position
//! ```
//!
//! To place a tilted wheel, rotate the normal into the wheel's frame, place the upright wheel for that normal, and
//! rotate the result back. The wheel stays in contact while it rotates along the track, because it touches at every
//! place of the track.

use super::options::PathOptions;
use super::rotary::{RotaryAxis, TiltMode};
use super::target_surface::Contact;
use super::{PathError, Wheel};
use crate::geometry::{Point, Vector};

/// Position and tilt of the wheel at a place of a track: exact, and as a program writes them.
#[derive(Clone, Copy, Debug)]
pub(super) struct WheelPosition {
    /// Centre of the wheel and tilt, not rounded to the increment of the axis.
    pub(super) centre: Point,
    pub(super) tilt_rad: f64,
    /// Programmed point, and tilt rounded to the increment of the axis.
    pub(super) programmed_point: Point,
    pub(super) programmed_tilt_rad: f64,
}

/// Deviation of a straight step from the path, in millimetres.
#[derive(Clone, Copy, Debug)]
pub(super) struct StepDeviation {
    /// Distance between the middle of the path's step and the position to which the control moves the wheel.
    pub(super) sag_mm: f64,
    /// Distance that the wheel's centre moves.
    pub(super) chord_mm: f64,
    /// Distance of the slides from the straight line between the ends of the step, at its middle.
    pub(super) slide_sag_mm: f64,
}

impl PathOptions {
    /// Returns the tilt of the head when the wheel touches at `contact`, in rad, right-handed. Returns 0 if the wheel
    /// is not tilted.
    #[inline]
    pub fn tilt_rad(&self, contact: &Contact) -> f64 {
        match (self.tilt, &self.rotary) {
            (Some(TiltMode::Constant { angle_rad }), _) => angle_rad,
            (Some(TiltMode::Following { lead_rad }), Some(rotary)) => {
                rotary.normal_tilt_rad(&contact.normal) + lead_rad
            }
            _ => 0.0,
        }
    }

    /// Returns the wheel with its spindle in the direction that it has when the wheel touches at `contact`.
    #[inline]
    pub fn wheel_at(&self, contact: &Contact) -> Wheel {
        if self.tilt.is_none() { self.wheel } else { self.wheel_turned(self.tilt_rad(contact)) }
    }

    /// Returns the direction of the head when the wheel touches at `contact`: the z axis, rotated by the tilt.
    #[inline]
    pub fn head_at(&self, contact: &Contact) -> Vector {
        let turned = |rotary: &RotaryAxis| rotary.rotated(&Vector::z(), self.tilt_rad(contact));
        self.rotary.as_ref().map_or_else(Vector::z, turned)
    }

    fn wheel_turned(&self, angle_rad: f64) -> Wheel {
        let Some(rotary) = &self.rotary else { return self.wheel };
        let mut wheel = self.wheel;
        if let Wheel::Torus { spindle, .. } | Wheel::Cup { spindle, .. } = &mut wheel {
            *spindle = rotary.rotated(spindle, angle_rad);
        }
        wheel
    }

    /// Returns the rotary axis of the head; `None` if there is none, or if the path does not tilt the wheel.
    #[inline]
    pub fn tilting_axis(&self) -> Option<&RotaryAxis> {
        self.tilt.and(self.rotary.as_ref())
    }

    /// Returns position and tilt of the wheel for a contact. If `lifted_mm` is above 0, the wheel is lifted off by this
    /// distance along the normal. Returns `None` if the rim of the wheel cannot touch there, because the normal is too
    /// near to the spindle.
    #[inline]
    pub(super) fn wheel_position(&self, contact: &Contact, lifted_mm: f64) -> Option<WheelPosition> {
        let centre = |wheel: Wheel| {
            let touching = wheel.centre(contact)?;
            Some(if lifted_mm > 0.0 { touching + contact.normal * lifted_mm } else { touching })
        };
        let Some(rotary) = self.tilting_axis() else {
            let centre = centre(self.wheel)?;
            return Some(WheelPosition { centre, tilt_rad: 0.0, programmed_point: centre, programmed_tilt_rad: 0.0 });
        };
        let tilt_rad = self.tilt_rad(contact);
        // `at` belongs to the rounded angle, so the rounding of the angle causes no error of the surface.
        let written_rad = rotary.rounded(tilt_rad);
        let at = centre(self.wheel_turned(written_rad))? + rotary.pivot_shift_mm(written_rad);
        Some(WheelPosition {
            centre: centre(self.wheel_turned(tilt_rad))?,
            tilt_rad,
            programmed_point: at,
            programmed_tilt_rad: written_rad,
        })
    }

    /// Computes the deviation of a straight step of the machine from the curved path, at the middle of the step. The
    /// step goes from `from` to `to`. `middle` is the position of the wheel on the path half-way between them.
    ///
    /// Returns three lengths in millimetres: the deviation of the wheel's centre, the distance that the wheel's centre
    /// moves, and the deviation of the linear axes from the straight line between the ends of the step.
    ///
    /// During a step the controller moves the linear axes and the head in proportion. If the tilt follows the surface,
    /// the tilt can be wrong at the middle. Then the angle error in rad, multiplied by the radius of the wheel's ring,
    /// is added to the deviation of the wheel's centre. A ball has no ring, so nothing is added.
    #[inline]
    pub(super) fn step_deviation(
        &self,
        from: &WheelPosition,
        middle: &WheelPosition,
        to: &WheelPosition,
    ) -> StepDeviation {
        let (chord, half) = (to.centre - from.centre, middle.centre - from.centre);
        let length2 = chord.norm_squared();
        let share = if length2 > 0.0 { half.dot(&chord) / length2 } else { 0.0 };
        let (Some(rotary), Some(TiltMode::Following { .. })) = (self.tilting_axis(), self.tilt) else {
            let sag = (half - chord * share).norm();
            return StepDeviation { sag_mm: sag, chord_mm: length2.sqrt(), slide_sag_mm: sag };
        };
        let turn = |stand: &WheelPosition| rotary.pivot_shift_mm(stand.tilt_rad);
        let turned = from.tilt_rad + share * (to.tilt_rad - from.tilt_rad);
        let slides = chord * share + turn(from) + (turn(to) - turn(from)) * share;
        let bent = (half + turn(middle) - slides).norm();
        let off = half - (slides - rotary.pivot_shift_mm(turned));
        let along = if length2 > 0.0 { off.dot(&chord) / length2 } else { 0.0 };
        let ring_mm = match self.wheel {
            Wheel::Sphere { .. } => 0.0,
            Wheel::Torus { ring_mm, .. } | Wheel::Cup { ring_mm, .. } => ring_mm,
        };
        let sag = (off - chord * along).norm() + ring_mm * (middle.tilt_rad - turned).abs();
        StepDeviation { sag_mm: sag, chord_mm: length2.sqrt(), slide_sag_mm: bent }
    }

    /// Returns the maximum height, in mm, by which the tilt can raise the position of the linear axes above the wheel's
    /// centre, at any angle in the range of the rotary axis. Returns 0 if the path does not tilt the wheel.
    pub(super) fn lift_mm(&self) -> f64 {
        self.tilting_axis().map_or(0.0, RotaryAxis::max_lift_mm)
    }

    /// Returns the height, in mm, above which rapid moves must stay at one contact of the wheel. `stand` is the
    /// position of the wheel at this contact.
    ///
    /// If the wheel is upright, the height is the z of the wheel's centre in `stand`. If the path tilts the wheel, the
    /// height is the larger of two values. One is the z of the wheel's centre. The other is the z of the contact point,
    /// moved by `lifted_mm` along the surface normal, plus the largest radius of the wheel.
    #[inline]
    pub(super) fn clearance_height_mm(&self, contact: &Contact, lifted_mm: f64, stand: &WheelPosition) -> f64 {
        match self.tilt {
            None | Some(TiltMode::Constant { angle_rad: 0.0 }) => stand.centre.z,
            _ => {
                let place = contact.point + contact.normal * lifted_mm;
                stand.centre.z.max(place.z + self.wheel.reach_mm())
            }
        }
    }
}

/// Searches a constant tilt of the head with which the wheel can grind the whole part, after planning with an upright
/// wheel failed with the error `refused`.
///
/// Tries angles in steps of 5° up to 90° to either side, within the range of the rotary axis. `would_do` returns true
/// if the path is possible with the given options. Returns [`PathError::NeedsTilt`], which contains `refused` and the
/// first possible angle.
///
/// Returns `refused` unchanged in each of these cases:
///
/// - No tried angle is possible.
/// - The error is not one that a tilt can remove.
/// - The head has no rotary axis.
/// - The options already contain a tilt, or the wheel comes from below.
pub(super) fn suggest_tilt(
    refused: PathError,
    options: &PathOptions,
    mut would_do: impl FnMut(PathOptions) -> bool,
) -> PathError {
    const STEP_DEG: f64 = 5.0;
    const MAX_TILT_DEG: f64 = 90.0;
    let is_of_reach = matches!(
        refused,
        PathError::Steep { .. } | PathError::CannotTouch { .. } | PathError::Body { .. } | PathError::Hollow { .. }
    );
    let (Some(rotary), None, true, false) = (&options.rotary, options.tilt, is_of_reach, options.from_below) else {
        return refused;
    };
    let [least, most] = rotary.range_rad;
    let steps = (1..=(MAX_TILT_DEG / STEP_DEG) as i32).flat_map(|k| [k, -k]).map(|k| STEP_DEG * f64::from(k));
    let found = steps.filter(|deg| (least..=most).contains(&rotary.scale_reading_rad(deg.to_radians()))).find(|deg| {
        let lean = Some(TiltMode::Constant { angle_rad: deg.to_radians() });
        would_do(PathOptions { tilt: lean, ..*options })
    });
    match found {
        Some(angle_deg) => PathError::NeedsTilt { refused: Box::new(refused), letter: rotary.letter, angle_deg },
        None => refused,
    }
}

#[cfg(test)]
mod tests {
    use super::super::wheel_fit::tests::{PART, ball, path, quadric, surface};
    use super::super::{MachineLimits, Move, RotationAxis, Scallops, ToolPath};
    use super::*;

    const PIVOT: Vector = Vector::new(0.0, 0.0, 200.0);

    fn head(about: RotationAxis) -> RotaryAxis {
        let letter = if about == RotationAxis::X { 'A' } else { 'B' };
        RotaryAxis {
            letter,
            axis: about,
            reversed: false,
            range_rad: [-2.0, 2.0],
            rate_rad_s: 10.0,
            step_rad: 0.0,
            pivot_mm: Some(PIVOT),
        }
    }

    fn tilted_options(rotary: RotaryAxis, lean: TiltMode, wheel: Wheel) -> PathOptions {
        PathOptions { wheel, rotary: Some(rotary), tilt: Some(lean), ..ball(1.0) }
    }

    /// Returns for every move at feed: position of the slides, tilt of the head, and distance that the centre moves.
    fn feeds(path: &ToolPath) -> Vec<(Point, f64, f64)> {
        let of = |one| match one {
            Move::FeedTilted { to: at, tilt_rad, centre_mm, .. } => Some((at, tilt_rad, centre_mm)),
            _ => None,
        };
        path.moves().filter_map(of).collect()
    }

    #[test]
    fn tilted_ball_pivot_by_hand() {
        let tilted = |about| {
            let lean = TiltMode::Constant { angle_rad: 30f64.to_radians() };
            path(quadric(0.0, 0.0), tilted_options(head(about), lean, Wheel::Sphere { radius_mm: 10.0 })).unwrap()
        };
        let upright: Vec<Point> = path(quadric(0.0, 0.0), ball(10.0))
            .unwrap()
            .moves()
            .filter_map(|one| if let Move::Feed { to: at, .. } = one { Some(at) } else { None })
            .collect();
        // The pivot moves by 200 sin 30° to +x when B rotates, or to -y when A rotates, and down by 200 (1 - cos 30°).
        for (about, by) in [
            (RotationAxis::Y, Vector::new(100.0, 0.0, -26.794_919_243_112_27)),
            (RotationAxis::X, Vector::new(0.0, -100.0, -26.794_919_243_112_27)),
        ] {
            let found = feeds(&tilted(about));
            assert_eq!(found.len(), upright.len());
            for ((at, tilt, _), plain) in found.into_iter().zip(&upright) {
                assert!((at - plain - by).norm() < 1e-9 && (tilt - 30f64.to_radians()).abs() < 1e-15, "{at} {plain}");
            }
        }
    }

    #[test]
    fn zero_tilt_is_upright_path() {
        for wheel in [
            Wheel::Sphere { radius_mm: 10.0 },
            Wheel::Torus { ring_mm: 8.0, tube_mm: 2.0, spindle: Vector::y() },
            Wheel::tilted_cup(6.0, 1.0, 0.5),
        ] {
            let lean = TiltMode::Constant { angle_rad: 0.0 };
            let tilted = path(quadric(0.01, -0.004), tilted_options(head(RotationAxis::Y), lean, wheel)).unwrap();
            let plain = path(quadric(0.01, -0.004), PathOptions { wheel, ..ball(1.0) }).unwrap();
            for (a, b) in tilted.moves().zip(plain.moves()) {
                let upright = match a {
                    Move::RapidTilted { to_mm, tilt_rad: 0.0 } => Move::RapidXy(to_mm),
                    Move::FeedTilted { to: at, tilt_rad: 0.0, feed_mm_min, .. } => Move::Feed { to: at, feed_mm_min },
                    other => other,
                };
                assert_eq!(upright, b);
            }
            let [a, b] = [&tilted, &plain].map(|path| path.summary().unwrap());
            assert_eq!((a.moves, a.length_mm, a.speed_mm_s), (b.moves, b.length_mm, b.speed_mm_s));
        }
    }

    #[test]
    fn following_tilt_lead_is_constant() {
        // Along x the normal rotates by -atan(2 a x), and B follows it. Seen along y there is no other rotation.
        let (a, lead) = (0.02f64, 0.5);
        let follows = tilted_options(
            head(RotationAxis::Y),
            TiltMode::Following { lead_rad: lead },
            Wheel::Sphere { radius_mm: 8.0 },
        );
        let laid = path(quadric(a, 0.0), follows).unwrap();
        for x in [-7.0, 0.0, 5.0] {
            let contact = laid.target().at([x, 1.0]);
            let tilt = follows.tilt_rad(&contact);
            assert!((tilt - (lead - (2.0 * a * x).atan())).abs() < 1e-6, "{tilt} at {x}");
            assert!((contact.normal.angle(&follows.head_at(&contact)) - lead).abs() < 1e-6);
        }
        assert!((laid.min_head_angle_rad() - lead).abs() < 1e-6);
        let turned = laid.summary().unwrap().head_rotation.unwrap();
        assert!(
            turned.min_tilt_rad.value < 0.2 && turned.max_tilt_rad.value > 0.8 && turned.max_rate_rad_s.value > 0.1
        );
    }

    #[test]
    fn tilted_path_touches_between_points() {
        let part = || quadric(0.02, -0.01);
        for (about, wheel) in [
            (RotationAxis::Y, Wheel::Sphere { radius_mm: 8.0 }),
            (RotationAxis::X, Wheel::Sphere { radius_mm: 8.0 }),
            (RotationAxis::Y, Wheel::tilted_cup(6.0, 1.0, 0.2)),
            (RotationAxis::X, Wheel::Torus { ring_mm: 8.0, tube_mm: 2.0, spindle: Vector::y() }),
        ] {
            let rotary = RotaryAxis { step_rad: 1e-4f64.to_radians(), ..head(about) };
            let laid = path(part(), tilted_options(rotary, TiltMode::Following { lead_rad: -0.4 }, wheel)).unwrap();
            let found = feeds(&laid);
            let ground: Vec<Point> = (0..400 * 121)
                .map(|k| [-8.0 + 0.04 * f64::from(k % 400), f64::from(k / 400) * 0.1 - 6.0])
                .map(|at| laid.target().at(at).point)
                .collect();
            let mut looked = 0;
            for pair in found.windows(2).step_by(97).filter(|pair| (pair[1].0 - pair[0].0).norm() < 5.0) {
                let (at, tilt) = (nalgebra::center(&pair[0].0, &pair[1].0), 0.5 * (pair[0].1 + pair[1].1));
                let centre = at - rotary.pivot_shift_mm(tilt);
                let stands = laid.options().wheel_turned(tilt);
                let near = |p: &&Point| (**p - centre).norm() < wheel.reach_mm() + 0.1;
                let nearest = ground.iter().filter(near).map(|p| stands.distance_mm(&(p - centre)));
                let nearest = nearest.fold(f64::INFINITY, f64::min);
                // Larger distances occur in leads and over the edge. Otherwise the distance is within the chord error
                // plus the effect of the spacing of the ground points.
                if nearest < 2e-3 {
                    assert!(nearest > -1.3e-4, "{about:?} {wheel:?}: {nearest} at {at}");
                    looked += 1;
                }
            }
            assert!(looked > 20, "{looked}");
        }
    }

    #[test]
    fn rotary_limits_refused_with_remedy() {
        let follows = TiltMode::Following { lead_rad: 0.5 };
        let wheel = Wheel::Sphere { radius_mm: 8.0 };
        let of = |rotary| path(quadric(0.02, 0.0), tilted_options(rotary, follows, wheel)).unwrap().summary().unwrap();
        let limits = MachineLimits::default();
        assert_eq!(of(head(RotationAxis::Y)).check(&limits), Ok(()));
        let narrow = RotaryAxis { range_rad: [-1.0, 0.7], ..head(RotationAxis::Y) };
        let Err(PathError::Tilt { letter: 'B', found_deg, x_mm, by_deg, .. }) = of(narrow).check(&limits) else {
            panic!()
        };
        assert!(x_mm > -20.0 && found_deg > 40.2 && (found_deg - 0.7f64.to_degrees() - by_deg).abs() < 1e-9);
        // The scale of the axis counts in the opposite direction.
        let reversed = RotaryAxis { reversed: true, range_rad: [-1.0, -0.1], ..head(RotationAxis::Y) };
        assert_eq!(of(reversed).check(&limits), Ok(()));
        let lazy = RotaryAxis { rate_rad_s: 0.05, ..head(RotationAxis::Y) };
        let Err(PathError::Rate { feed_mm_min, .. }) = of(lazy).check(&limits) else { panic!() };
        let slower = PathOptions { feed_mm_min: 0.999 * feed_mm_min, ..tilted_options(lazy, follows, wheel) };
        assert_eq!(path(quadric(0.02, 0.0), slower).unwrap().summary().unwrap().check(&limits), Ok(()));
        for (options, expected) in [
            (PathOptions { rotary: None, ..slower }, PathError::NoRotary),
            (PathOptions { from_below: true, ..slower }, PathError::TiltBelow),
        ] {
            assert_eq!(path(quadric(0.0, 0.0), options).unwrap_err(), expected);
        }
        let pole = PathOptions { tilt: Some(TiltMode::Following { lead_rad: 0.01 }), ..slower };
        assert!(matches!(path(quadric(0.0, 0.0), pole), Err(PathError::Option { key: "lead of a ball (rad)", .. })));
    }

    #[test]
    fn unreachable_flank_suggests_tilt() {
        // A flank of 74°: the spindle of an upright wheel is in the way.
        let flank = || surface(|[x, y]| (3.5 * y + 0.01 * x * x, [0.02 * x, 3.5]));
        let upright = PathOptions { rotary: Some(head(RotationAxis::X)), ..ball(5.0) };
        let Err(PathError::NeedsTilt { refused, letter: 'A', angle_deg }) = path(flank(), upright) else { panic!() };
        assert!(matches!(*refused, PathError::Steep { .. }), "{refused}");
        // At least 74.05° - 68.75°, towards the normal, which points to -y.
        assert_eq!(angle_deg, 10.0);
        let tilted = PathOptions { tilt: Some(TiltMode::Constant { angle_rad: angle_deg.to_radians() }), ..upright };
        assert!(path(flank(), tilted).is_ok());
        // A rotation about y does not help. A machine without a rotary axis gets the original error.
        let about_y = PathOptions { rotary: Some(head(RotationAxis::Y)), ..upright };
        assert!(matches!(path(flank(), about_y), Err(PathError::Steep { .. })));
        assert!(matches!(path(flank(), ball(5.0)), Err(PathError::Steep { .. })));
        // A cup that is tilted less than the slope of the dome.
        let cup = PathOptions { wheel: Wheel::tilted_cup(6.0, 1.0, 0.15), ..about_y };
        let refused = path(quadric(-0.0125, -0.001), cup).unwrap_err();
        let PathError::NeedsTilt { angle_deg, .. } = refused else { panic!("{refused}") };
        let lean = Some(TiltMode::Constant { angle_rad: angle_deg.to_radians() });
        assert!(
            angle_deg < 0.0 && path(quadric(-0.0125, -0.001), PathOptions { tilt: lean, ..cup }).is_ok(),
            "{angle_deg}"
        );
    }

    #[test]
    fn scallops_of_tilted_disc() {
        // A disc that rolls along the track, tilted across it by 0.5 rad: the curvature of its ring changes, that of
        // its rim does not.
        let disc = Wheel::Torus { ring_mm: 40.0, tube_mm: 5.0, spindle: Vector::y() };
        let lean = TiltMode::Constant { angle_rad: 0.5 };
        let laid = path(quadric(0.0, 0.0), tilted_options(head(RotationAxis::X), lean, disc)).unwrap();
        let found = Scallops::compute(
            laid.target(),
            &PART,
            |contact| laid.options().wheel_at(contact),
            laid.options().pattern,
            0.5,
        );
        assert!((found.height_mm - 0.25 / 8.0 / 5.0).abs() < 1e-12, "{found:?}");
        let across = tilted_options(
            head(RotationAxis::X),
            lean,
            Wheel::Torus { ring_mm: 40.0, tube_mm: 5.0, spindle: Vector::x() },
        );
        let laid = path(quadric(0.0, 0.0), across).unwrap();
        // With its spindle along the tracks, the disc has the curvature of its outer circle across the tracks.
        assert!((laid.scallops().height_mm - laid.track_mm().powi(2) / 8.0 / 45.0).abs() < 1e-12);
    }
}
