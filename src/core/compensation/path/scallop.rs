//! Scallops: ridges that remain between the tracks of a pass because the wheel is curved across the tracks.
//!
//! The wheel touches the target surface along its tracks and leaves a groove around each track. Let s be the distance
//! between two tracks along the surface and g the curvature of the groove relative to the surface. Then
//!
//! ```text
//!  h = s^2 g / 8        mean over the groove: h / 3        rms about that mean: h 2 / (3 sqrt 5) = 0.298 h
//! ```
//!
//! The gap between wheel and surface is a quadratic form Q: the wheel's curvatures minus those of the surface
//! (positive in a hollow). A wheel that moves along the track (index 1) leaves the minimum of Q over that direction:
//! g = Q_22 - Q_12^2 / Q_11, which for a ball is nearly 1 / r - k. The heights are those of parabolas. If the tracks
//! are as far apart as the wheel's radius, the true heights are 7 % larger.

use rayon::prelude::*;

use super::groove::{Groove, groove, relative_to_middle};
use super::target_surface::Contact;
use super::wheel_fit::{PLACES, on_grid};
use super::{TargetSurface, ToolPath, TrackPattern, Wheel};
use crate::geometry::Aperture;

/// Ratio of the rms of a parabola about its mean to its height: 2 / (3 sqrt 5).
const RMS_PER_HEIGHT: f64 = 0.298_142_396_999_972;

/// Size of the scallops that the tracks of a pass leave.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Scallops {
    /// Distance between tracks over x and y, in millimetres.
    pub track_mm: f64,
    /// Height of the highest scallop above its neighbouring grooves, in millimetres. This is its contribution to a
    /// peak-to-valley value.
    pub height_mm: f64,
    /// Root mean square over the part about the local mean height, in millimetres. The local mean changes slowly over
    /// the part. It counts as form error, which a correction compensates.
    pub rms_mm: f64,
    /// Mean height above the surface that the wheel touches, in millimetres.
    pub mean_mm: f64,
}

impl Scallops {
    /// Computes the scallops that a pass leaves on the surface `wanted`. Scallops are the ridges between tracks.
    /// `outline` is the outline of the part, `pattern` is raster or spiral, and `track_mm` is the distance between
    /// tracks, projected onto the xy plane. `wheel_at` returns the wheel, with the direction of its spindle, for a
    /// contact.
    ///
    /// The height counts as 0 at a place where the wheel does not fit. [`ToolPath::new`] rejects such a path.
    pub fn compute(
        wanted: &TargetSurface,
        outline: &Aperture,
        wheel_at: impl Fn(&Contact) -> Wheel + Sync,
        pattern: TrackPattern,
        track_mm: f64,
    ) -> Self {
        let height = |place: &[f64; 2]| height_at(wanted, outline, &wheel_at, pattern, track_mm, *place);
        let inside: Vec<f64> = on_grid(outline, PLACES).par_iter().map(height).collect();
        let border = outline.outline_mm(4 * PLACES).par_iter().map(height).reduce(|| 0.0, f64::max);
        let mean_of = |power: i32| inside.iter().map(|h| h.powi(power)).sum::<f64>() / inside.len().max(1) as f64;
        Self {
            track_mm,
            height_mm: inside.iter().copied().fold(border, f64::max),
            rms_mm: RMS_PER_HEIGHT * mean_of(2).sqrt(),
            mean_mm: mean_of(1) / 3.0,
        }
    }

    /// Returns the largest distance between tracks, in millimetres, at which the height of the scallops is at most
    /// `height_mm` and their root mean square is at most `rms_mm`. Returns infinity if the wheel leaves no scallops.
    pub fn max_track_mm(&self, height_mm: f64, rms_mm: f64) -> f64 {
        let by = |most: f64, found: f64| if found > 0.0 { (most / found).sqrt() } else { f64::INFINITY };
        self.track_mm * by(height_mm, self.height_mm).min(by(rms_mm, self.rms_mm))
    }

    /// Returns the scallops for the distance `track_mm` between tracks. Heights, rms and mean are proportional to the
    /// square of the distance.
    #[must_use]
    pub fn with_track_mm(&self, track_mm: f64) -> Self {
        let times = (track_mm / self.track_mm).powi(2);
        let [height_mm, rms_mm, mean_mm] = [self.height_mm, self.rms_mm, self.mean_mm].map(|value| times * value);
        Self { track_mm, height_mm, rms_mm, mean_mm }
    }
}

/// Returns the height of the scallops at `place` (x and y in millimetres), in millimetres. The other arguments are those
/// of [`Scallops::compute`]. Returns 0 at a place where the wheel does not fit.
fn height_at(
    wanted: &TargetSurface,
    outline: &Aperture,
    wheel_at: impl Fn(&Contact) -> Wheel,
    pattern: TrackPattern,
    track_mm: f64,
    place: [f64; 2],
) -> f64 {
    let bend = wanted.curvature_at(place);
    let wheel = wheel_at(&bend.contact);
    let Groove { curvature_per_mm: bend, stretch } = groove(&bend, relative_to_middle(outline, place), &wheel, pattern);
    let height = (track_mm * stretch).powi(2) * bend / 8.0;
    if height.is_finite() { height } else { 0.0 }
}

impl ToolPath {
    /// Returns the height of the scallops that this path leaves at `place` (x and y in millimetres), in millimetres.
    pub fn scallop_height_at(&self, place: [f64; 2]) -> f64 {
        let options = self.options();
        let wheel_at = |contact: &Contact| options.wheel_at(contact);
        height_at(self.target(), self.outline(), wheel_at, options.pattern, self.track_mm(), place)
    }

    /// Returns height, rms and mean of the scallops that this path leaves on the part. Scallops are the ridges between
    /// tracks.
    pub fn scallops(&self) -> Scallops {
        let options = self.options();
        let wheel_at = |contact: &Contact| options.wheel_at(contact);
        Scallops::compute(self.target(), self.outline(), wheel_at, options.pattern, self.track_mm())
    }
}

#[cfg(test)]
mod tests {
    use super::super::PathOptions;
    use super::super::wheel_fit::tests::{PART, ball, path, quadric};
    use super::*;
    use crate::geometry::Vector;

    fn scallops_on(wanted: &TargetSurface, wheel: Wheel, track_mm: f64) -> Scallops {
        Scallops::compute(wanted, &PART, |_| wheel, TrackPattern::Raster, track_mm)
    }

    #[test]
    fn scallop_height_by_hand() {
        let of = |b: f64| scallops_on(&quadric(0.0, b), Wheel::Sphere { radius_mm: 12.5 }, 0.5);
        // 0.25 / (8 * 12.5) on a plane. On a hollow or a dome with a radius of 50 mm it is a quarter less or more.
        let flat = of(0.0);
        assert!((flat.height_mm - 2.5e-3).abs() < 1e-12, "{flat:?}");
        assert!((flat.rms_mm / flat.height_mm - 2.0 / (3.0 * 5f64.sqrt())).abs() < 1e-12);
        assert!((flat.mean_mm - 2.5e-3 / 3.0).abs() < 1e-12);
        let nearly = |found: Scallops, height_mm: f64| {
            // Towards the edges the curvature is smaller, and the tracks are farther apart along the slope.
            assert!((found.height_mm / height_mm - 1.0).abs() < 0.03, "{found:?}");
            assert!(found.rms_mm <= 0.2982 * found.height_mm && found.rms_mm > 0.28 * found.height_mm, "{found:?}");
        };
        nearly(of(0.01), 2.5e-3 * 0.75);
        nearly(of(-0.01), 2.5e-3 * 1.25);
        // A quarter of the distance gives a sixteenth of the height.
        let near = scallops_on(&quadric(0.0, 0.0), Wheel::Sphere { radius_mm: 12.5 }, 0.125);
        assert!(
            (near.height_mm - flat.with_track_mm(0.125).height_mm).abs() < 1e-15
                && near.rms_mm == flat.with_track_mm(0.125).rms_mm
        );
    }

    #[test]
    fn scallop_track_for_height_and_rms() {
        let unit = scallops_on(&quadric(0.004, -0.006), Wheel::Sphere { radius_mm: 12.5 }, 1.0);
        let by_rms = unit.with_track_mm(unit.max_track_mm(1.0, 2e-4));
        assert!((by_rms.rms_mm - 2e-4).abs() < 1e-15, "{by_rms:?}");
        let by_height = unit.with_track_mm(unit.max_track_mm(5e-4, 1.0));
        assert!((by_height.height_mm - 5e-4).abs() < 1e-15, "{by_height:?}");
    }

    #[test]
    fn scallops_of_flat_disc_and_cup_wheels() {
        let straight = Wheel::Torus { ring_mm: 40.0, tube_mm: f64::INFINITY, spindle: Vector::y() };
        for (wanted, wheel) in [
            (quadric(0.0, 0.0), Wheel::Sphere { radius_mm: f64::INFINITY }),
            (quadric(-0.001, 0.0), straight),
            // A hollow of radius 20 mm and a wheel of radius 30 mm: no path is laid for this pair.
            (quadric(0.0, 0.025), Wheel::Sphere { radius_mm: 30.0 }),
        ] {
            let none = scallops_on(&wanted, wheel, 0.5);
            assert_eq!([none.height_mm.max(1e-18), none.rms_mm.max(1e-18)], [1e-18; 2], "{wheel:?}");
            assert!(none.max_track_mm(1e-3, 1e-3) > 1e3);
        }
        // Across the tracks a disc is as sharp as its rim. A cup that touches with one point of its ring is blunt
        // there.
        let disc = Wheel::Torus { ring_mm: 40.0, tube_mm: 5.0, spindle: Vector::y() };
        assert!((scallops_on(&quadric(0.0, 0.0), disc, 0.5).height_mm - 0.25 / 40.0).abs() < 1e-12);
        let cup = scallops_on(&quadric(0.0, 0.0), Wheel::tilted_cup(20.0, 1.0, 0.5), 0.5);
        let blunt = 0.5f64.sin() / (20.0 + 0.5f64.sin());
        assert!((cup.height_mm - 0.25 * blunt / 8.0).abs() < 1e-12, "{cup:?}");
    }

    #[test]
    fn scallops_on_slope_use_true_spacing() {
        // A plane that rises along x and y: tracks run along (1, 0, p), and the offset to the next one is (0, t, q t).
        let [p, q] = [0.4, 0.3];
        let slope = super::super::wheel_fit::tests::surface(|[x, y]| (p * x + q * y, [p, q]));
        let expected = 0.25 * (1.0 + p * p + q * q) / (1.0 + p * p) / (8.0 * 12.5);
        let found = scallops_on(&slope, Wheel::Sphere { radius_mm: 12.5 }, 0.5);
        assert!((found.height_mm / expected - 1.0).abs() < 1e-9, "{found:?} {expected}");
    }

    #[test]
    fn tool_path_reports_scallops() {
        let laid = path(quadric(0.0, 0.0), ball(12.5)).unwrap();
        let height_mm = laid.track_mm().powi(2) / 100.0;
        assert!((laid.scallops().height_mm - height_mm).abs() < 1e-12);
        assert!((laid.scallop_height_at([0.3, -0.2]) - height_mm).abs() < 1e-12);
        let spiral = path(quadric(0.0, 0.0), PathOptions { pattern: TrackPattern::Spiral, ..ball(12.5) }).unwrap();
        assert!((spiral.scallops().height_mm - 2.5e-3).abs() < 1e-12);
    }
}
