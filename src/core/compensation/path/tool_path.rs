//! Tool path: the path of a wheel over a part, with its checks.

use rayon::prelude::*;

use super::options::PathOptions;
use super::tilt::{WheelPosition, suggest_tilt};
use super::tracks::{Span, Tracks};
use super::{PathError, TargetSurface, wheel_fit};
use crate::geometry::{Aperture, Point};

/// Approximate number of tracks that are searched for the highest place.
const SOME_TRACKS: usize = 200;

/// Path of a wheel over a part. Its points are computed on demand by [`ToolPath::moves`].
#[derive(Clone, Debug)]
pub struct ToolPath {
    target: TargetSurface,
    outline: Aperture,
    options: PathOptions,
    pub(super) tracks: Tracks,
    safe_z_mm: f64,
    min_node_spacing_mm: f64,
}

impl ToolPath {
    /// Plans the tracks of a wheel over a part. `wanted` is the target surface of the pass, `outline` is the outline of
    /// the part.
    ///
    /// Checks the options, and checks that the wheel fits the surface: slope, radius of hollows in every direction, and
    /// no contact between the body of the wheel and the part away from the contact point. Travel, speed and
    /// acceleration are not checked here, but in [`super::PathSummary::check`].
    ///
    /// # Errors
    /// Returns an error for invalid options, for a wheel that does not fit, for an outline without tracks, and for 1e6
    /// tracks or more. Each error gives place, value, limit and remedy. If a constant tilt of the head solves the
    /// problem, the error is [`PathError::NeedsTilt`] with this angle.
    pub fn new(wanted: TargetSurface, outline: Aperture, options: PathOptions) -> Result<Self, PathError> {
        options.check()?;
        let grain_mm = wanted.min_node_spacing_mm();
        let tracks = Tracks { spans: Vec::new(), track_mm: f64::NAN };
        let mut path =
            Self { target: wanted, outline, options, tracks, safe_z_mm: f64::INFINITY, min_node_spacing_mm: grain_mm };
        match path.lay() {
            Ok(()) => Ok(path),
            Err(refused) => Err(suggest_tilt(refused, &options, |tilted| {
                path.options = tilted;
                wheel_fit::may_fit(&path.target, &path.outline, &tilted) && path.lay().is_ok()
            })),
        }
    }

    fn lay(&mut self) -> Result<(), PathError> {
        let track_mm = wheel_fit::track_mm(&self.target, &self.outline, &self.options)?;
        self.tracks = Tracks::lay(&self.outline, &self.options, track_mm)?;
        self.safe_z_mm = self.max_clearance_height_mm()? + self.options.safe_height_mm + self.options.lift_mm();
        wheel_fit::check_body(&self.target, &self.outline, &self.options)
    }

    /// Returns the smallest angle between the direction of the head and a normal of the part, in rad. At the angle 0 a
    /// ball touches with its pole, which has no cutting speed.
    pub fn min_head_angle_rad(&self) -> f64 {
        let lean = |place: [f64; 2]| {
            let contact = self.target.at(place);
            contact.normal.angle(&self.options.head_at(&contact))
        };
        wheel_fit::on_grid(&self.outline, wheel_fit::PLACES).into_iter().map(lean).fold(f64::INFINITY, f64::min)
    }

    /// Returns the distance between neighbouring tracks, projected onto the xy plane, in millimetres.
    pub fn track_mm(&self) -> f64 {
        self.tracks.track_mm
    }

    /// Returns the number of tracks. If a track leaves the part and comes back, each piece counts.
    pub fn track_count(&self) -> usize {
        self.tracks.spans.len()
    }

    /// Returns the safe height: the z of the model frame at which rapid moves in x and y travel, in millimetres.
    pub fn safe_z_mm(&self) -> f64 {
        self.flipped_height_mm(self.safe_z_mm)
    }

    /// Returns the safe height of rapid moves in the frame of the wheel, in millimetres. This frame is the model frame,
    /// but with z reversed if the wheel comes from below.
    pub(super) fn travel_mm(&self) -> f64 {
        self.safe_z_mm
    }

    /// Converts the height `z_mm` from the model frame into the frame of the wheel, or back. If the wheel grinds the
    /// part from below (from -z), these frames are mirror images, and the sign changes. If the wheel grinds from above,
    /// the height is unchanged.
    #[inline]
    pub(super) fn flipped_height_mm(&self, z_mm: f64) -> f64 {
        if self.options.from_below { -z_mm } else { z_mm }
    }

    /// Returns the smallest node spacing of the target surface, in millimetres; the surface has no finer detail.
    pub(super) fn min_node_spacing_mm(&self) -> f64 {
        self.min_node_spacing_mm
    }

    /// Returns the options of the path.
    pub fn options(&self) -> &PathOptions {
        &self.options
    }

    /// Returns the target surface of the path.
    pub fn target(&self) -> &TargetSurface {
        &self.target
    }

    /// Returns the outline of the part.
    pub fn outline(&self) -> &Aperture {
        &self.outline
    }

    /// Returns position and tilt of the wheel at one point of the track `span`. `t` is the curve parameter of this
    /// point: x in mm on a straight track, the angle in rad on a spiral ([`Span::place`]). In the leads before and
    /// after the track the wheel is lifted off the surface.
    ///
    /// All values are NaN if the wheel cannot touch at this point. [`ToolPath::new`] rejects a path with such a point.
    #[inline]
    pub(super) fn wheel_position(&self, span: &Span, t: f64) -> WheelPosition {
        let contact = self.target.at(span.place(t));
        let lifted = self.tracks.lift_mm(span, t, &self.options);
        let nowhere = Point::new(f64::NAN, f64::NAN, f64::NAN);
        let none = WheelPosition {
            centre: nowhere,
            tilt_rad: f64::NAN,
            programmed_point: nowhere,
            programmed_tilt_rad: f64::NAN,
        };
        self.options.wheel_position(&contact, lifted).unwrap_or(none)
    }

    /// Returns the height, in mm, above which rapid moves must stay at one point of the track `span`. `t` is the curve
    /// parameter of this point: x in mm on a straight track, the angle in rad on a spiral. Returns NaN if the wheel
    /// cannot touch the surface at this point.
    fn clearance_height_mm(&self, span: &Span, t: f64) -> f64 {
        let contact = self.target.at(span.place(t));
        let lifted = self.tracks.lift_mm(span, t, &self.options);
        self.options
            .wheel_position(&contact, lifted)
            .map_or(f64::NAN, |stand| self.options.clearance_height_mm(&contact, lifted, &stand))
    }

    /// Returns the largest z, in mm, of the wheel along the tracks: rapid moves must be higher. At most about 200
    /// tracks are searched, in steps of about 1 mm. The caller adds the safe height, which allows for the points
    /// between.
    ///
    /// # Errors
    /// Returns [`PathError::CannotTouch`] if the wheel cannot touch the surface at one of the searched points.
    fn max_clearance_height_mm(&self) -> Result<f64, PathError> {
        let highest = |span: &Span| {
            let (from, to) = span.with_leads(&self.options);
            let count = (span.length_mm(from, to).ceil() as usize).clamp(8, 20_000);
            (0..=count)
                .map(|k| from + (to - from) * k as f64 / count as f64)
                .map(|t| (self.clearance_height_mm(span, t), t))
                .try_fold(
                    f64::NEG_INFINITY,
                    |most, (z, t)| if z.is_finite() { Ok(most.max(z)) } else { Err(span.place(t)) },
                )
        };
        let spans = &self.tracks.spans;
        let some = spans.len().div_ceil(SOME_TRACKS).max(1);
        let chosen = spans.par_iter().step_by(some).chain(spans.par_iter().rev().take(1));
        let heights: Vec<Result<f64, [f64; 2]>> = chosen.map(highest).collect();
        heights
            .into_iter()
            .try_fold(f64::NEG_INFINITY, |most, one| one.map(|z| most.max(z)))
            .map_err(|[x_mm, y_mm]| PathError::CannotTouch { x_mm, y_mm })
    }
}

#[cfg(test)]
mod tests {
    use super::super::wheel_fit::tests::{PART, surface};
    use super::super::{Move, TrackPattern, Wheel};
    use super::*;

    /// Returns a surface without symmetry, seen from +z (1) or from -z (-1).
    fn asymmetric_target(from: f64) -> TargetSurface {
        surface(move |[x, y]| {
            let z = 0.01 * x * x - 0.004 * y * y + 0.05 * x + 0.03 * (0.3 * y).sin();
            (from * z, [from * (0.02 * x + 0.05), from * (-0.008 * y + 0.009 * (0.3 * y).cos())])
        })
    }

    #[test]
    fn path_from_below_is_mirrored() {
        let cup = Wheel::tilted_cup(6.0, 1.0, 0.5);
        for (wheel, pattern) in [
            (Wheel::Sphere { radius_mm: 10.0 }, TrackPattern::Raster),
            (Wheel::Sphere { radius_mm: 10.0 }, TrackPattern::Spiral),
            (cup, TrackPattern::Raster),
        ] {
            let options = PathOptions { pattern, ..PathOptions::new(wheel, 1.5, 600.0) };
            let above = ToolPath::new(asymmetric_target(1.0), PART, options).unwrap();
            // A hanging part: its lower side is the mirror image of the upper side of the other part.
            let below =
                ToolPath::new(asymmetric_target(1.0), PART, PathOptions { from_below: true, ..options }).unwrap();
            assert_eq!(above.track_count(), below.track_count());
            for (up, down) in above.moves().zip(below.moves()) {
                let mirrored = match up {
                    Move::RapidZ(z) => Move::RapidZ(-z),
                    Move::RapidXy(_) | Move::RapidTilted { .. } | Move::FeedTilted { .. } => up,
                    Move::Feed { to: at, feed_mm_min } => Move::Feed { to: Point::new(at.x, at.y, -at.z), feed_mm_min },
                };
                assert_eq!(mirrored, down);
            }
            let (up, down) = (above.summary().unwrap(), below.summary().unwrap());
            assert_eq!([up.min_mm[2], up.max_mm[2]], [-down.max_mm[2], -down.min_mm[2]]);
            assert_eq!((up.points, up.length_mm, up.rapid_mm), (down.points, down.length_mm, down.rapid_mm));
            assert!(below.safe_z_mm() == -above.safe_z_mm() && below.safe_z_mm() == down.min_mm[2]);
        }
    }

    #[test]
    fn path_from_below_touches_surface() {
        // The surface is in the model frame; the wheel is under it.
        let options =
            PathOptions { from_below: true, ..PathOptions::new(Wheel::Sphere { radius_mm: 10.0 }, 1.5, 600.0) };
        let below = ToolPath::new(asymmetric_target(-1.0), PART, options).unwrap();
        let model = asymmetric_target(1.0);
        let mut touching = 0;
        for one in below.moves() {
            let Move::Feed { to: at, .. } = one else { continue };
            let mut place = [at.x, at.y];
            for _ in 0..50 {
                let contact = model.at(place);
                let off = at - contact.point;
                let aside = off - contact.normal * off.dot(&contact.normal);
                place = [place[0] + 0.7 * aside.x, place[1] + 0.7 * aside.y];
            }
            if PART.contains(place[0], place[1]) {
                let contact = model.at(place);
                let beside = (at - contact.point).dot(&contact.normal) + 10.0;
                assert!(beside.abs() < 1e-6, "{beside} at {place:?}");
                touching += 1;
            }
        }
        assert!(touching > 100);
    }
}
