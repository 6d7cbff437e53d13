//! Scallops: what stands between the tracks of a pass because the wheel is round across them.
//!
//! The wheel touches the wanted surface along its tracks and leaves a groove around each. With s for the distance of two tracks along the
//! surface and g for the curvature of the groove against the surface,
//!
//! ```text
//!  h = s^2 g / 8        mean over the groove: h / 3        rms about that mean: h 2 / (3 sqrt 5) = 0.298 h
//! ```
//!
//! The gap between wheel and surface is a quadratic form Q, the wheel's curvatures less those of the hollow surface. A wheel that moves along
//! the track sweeps the least of it over that direction: g = Q_22 - Q_12^2 / Q_11, which for a ball is nearly 1 / r - k. The heights are those
//! of parabolas: tracks as far apart as the wheel's radius make them 7 % higher.

use rayon::prelude::*;

use super::fit::{PLACES, on_grid, wheel_in};
use super::wanted::{Bend, Contact};
use super::{Pattern, ToolPath, Wanted, Wheel};
use crate::geometry::{Aperture, Vector};

/// The rms of a parabola about its mean, over its height.
const RMS_OF_HEIGHT: f64 = 0.298_142_396_999_972;

/// What the tracks of a pass leave between them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Scallops {
    /// Distance of the tracks over x and y, in millimetres.
    pub track_mm: f64,
    /// Height of the highest one over the grooves beside it, in millimetres: what it adds to a peak to valley.
    pub height_mm: f64,
    /// Root mean square over the part, about their mean height nearby, in millimetres. The mean changes slowly over the part, and what changes slowly
    /// is form, which a correction takes back.
    pub rms_mm: f64,
    /// Mean height over the surface that the wheel touches, in millimetres.
    pub mean_mm: f64,
}

impl Scallops {
    /// Returns what tracks leave on a wanted surface, by the wheel as it stands where it touches. Where the wheel does not fit the surface there are
    /// none, and no path either.
    pub fn between(
        wanted: &Wanted,
        outline: &Aperture,
        wheel_at: impl Fn(&Contact) -> Wheel + Sync,
        pattern: Pattern,
        track_mm: f64,
    ) -> Self {
        let height = |place: &[f64; 2]| {
            let bend = wanted.bend(*place);
            let wheel = wheel_at(&bend.contact);
            let Groove { bend, stretch } = groove(&bend, from_middle(outline, *place), &wheel, pattern);
            let height = (track_mm * stretch).powi(2) * bend / 8.0;
            if height.is_finite() { height } else { 0.0 }
        };
        let inside: Vec<f64> = on_grid(outline, PLACES).par_iter().map(height).collect();
        let border = outline.outline_mm(4 * PLACES).par_iter().map(height).reduce(|| 0.0, f64::max);
        let mean_of = |power: i32| inside.iter().map(|h| h.powi(power)).sum::<f64>() / inside.len().max(1) as f64;
        Self {
            track_mm,
            height_mm: inside.iter().copied().fold(border, f64::max),
            rms_mm: RMS_OF_HEIGHT * mean_of(2).sqrt(),
            mean_mm: mean_of(1) / 3.0,
        }
    }

    /// Returns the distance of tracks that leave at most this height and this rms, in millimetres; infinite where no distance leaves any.
    pub fn track_for_mm(&self, height_mm: f64, rms_mm: f64) -> f64 {
        let by = |most: f64, found: f64| if found > 0.0 { (most / found).sqrt() } else { f64::INFINITY };
        self.track_mm * by(height_mm, self.height_mm).min(by(rms_mm, self.rms_mm))
    }

    /// Returns what tracks of another distance leave: the height goes by its square.
    #[must_use]
    pub fn at_mm(&self, track_mm: f64) -> Self {
        let times = (track_mm / self.track_mm).powi(2);
        let [height_mm, rms_mm, mean_mm] = [self.height_mm, self.rms_mm, self.mean_mm].map(|value| times * value);
        Self { track_mm, height_mm, rms_mm, mean_mm }
    }
}

impl ToolPath {
    /// Returns what this path leaves between its tracks.
    pub fn scallops(&self) -> Scallops {
        let options = self.options();
        let wheel_at = |contact: &Contact| options.wheel_at(contact);
        Scallops::between(self.wanted(), self.outline(), wheel_at, options.pattern, self.track_mm())
    }
}

/// The groove that the wheel leaves at a place.
pub(super) struct Groove {
    /// Its curvature against the surface, across the track, 1/mm; 0 where there is none.
    pub(super) bend: f64,
    /// How far two tracks are apart along the surface, across the track, over their distance over x and y.
    pub(super) stretch: f64,
}

/// Returns the middle that a spiral winds about, less a place.
pub(super) fn from_middle(outline: &Aperture, place: [f64; 2]) -> [f64; 2] {
    let [low, high] = outline.bounds();
    std::array::from_fn(|k| place[k] - 0.5 * (low[k] + high[k]))
}

/// Returns the groove at a place, given from the middle of the part.
pub(super) fn groove(bend: &Bend, [x, y]: [f64; 2], wheel: &Wheel, pattern: Pattern) -> Groove {
    // The track over x and y; the next one lies at a right angle to it there.
    let radius = x.hypot(y);
    let [east, north] = match pattern {
        Pattern::Spiral if radius > 0.0 => [-y / radius, x / radius],
        Pattern::Spiral | Pattern::Raster => [1.0, 0.0],
    };
    let n = &bend.contact.normal;
    let on_surface = |east: f64, north: f64| Vector::new(east, north, -(east * n.x + north * n.y) / n.z);
    let track = on_surface(east, north).normalize();
    let across = n.cross(&track);
    let stretch = on_surface(-north, east).dot(&across).abs();
    let wheel = wheel_in(bend, wheel);
    let gap: [f64; 3] = std::array::from_fn(|k| wheel[k] - bend.curvature[k]);
    let [c, s] = [0, 1].map(|k| track.dot(&bend.along[k]));
    let [along, mixed, over] = [
        gap[0] * c * c + 2.0 * gap[1] * s * c + gap[2] * s * s,
        (gap[2] - gap[0]) * s * c + gap[1] * (c * c - s * s),
        gap[0] * s * s - 2.0 * gap[1] * s * c + gap[2] * c * c,
    ];
    let swept = over - if mixed == 0.0 { 0.0 } else { mixed * mixed / along };
    Groove { bend: if swept > 0.0 { swept } else { 0.0 }, stretch }
}

#[cfg(test)]
mod tests {
    use super::super::PathOptions;
    use super::super::fit::tests::{PART, ball, path, quadric};
    use super::*;

    fn between(wanted: &Wanted, wheel: Wheel, track_mm: f64) -> Scallops {
        Scallops::between(wanted, &PART, |_| wheel, Pattern::Raster, track_mm)
    }

    #[test]
    fn by_hand() {
        let of = |b: f64| between(&quadric(0.0, b), Wheel::Sphere { radius_mm: 12.5 }, 0.5);
        // 0.25 / (8 * 12.5) on a plane; where the surface is hollow or stands up with a radius of 50 mm, a quarter less or more.
        let flat = of(0.0);
        assert!((flat.height_mm - 2.5e-3).abs() < 1e-12, "{flat:?}");
        assert!((flat.rms_mm / flat.height_mm - 2.0 / (3.0 * 5f64.sqrt())).abs() < 1e-12);
        assert!((flat.mean_mm - 2.5e-3 / 3.0).abs() < 1e-12);
        let nearly = |found: Scallops, height_mm: f64| {
            // Towards the edges it bends less, and the tracks are farther apart along the slope.
            assert!((found.height_mm / height_mm - 1.0).abs() < 0.03, "{found:?}");
            assert!(found.rms_mm <= 0.2982 * found.height_mm && found.rms_mm > 0.28 * found.height_mm, "{found:?}");
        };
        nearly(of(0.01), 2.5e-3 * 0.75);
        nearly(of(-0.01), 2.5e-3 * 1.25);
        // Four times as near, a sixteenth as high.
        let near = between(&quadric(0.0, 0.0), Wheel::Sphere { radius_mm: 12.5 }, 0.125);
        assert!(
            (near.height_mm - flat.at_mm(0.125).height_mm).abs() < 1e-15 && near.rms_mm == flat.at_mm(0.125).rms_mm
        );
    }

    #[test]
    fn the_distance_for_a_height_and_an_rms_leaves_just_these() {
        let unit = between(&quadric(0.004, -0.006), Wheel::Sphere { radius_mm: 12.5 }, 1.0);
        let by_rms = unit.at_mm(unit.track_for_mm(1.0, 2e-4));
        assert!((by_rms.rms_mm - 2e-4).abs() < 1e-15, "{by_rms:?}");
        let by_height = unit.at_mm(unit.track_for_mm(5e-4, 1.0));
        assert!((by_height.height_mm - 5e-4).abs() < 1e-15, "{by_height:?}");
    }

    #[test]
    fn wheels_that_are_straight_across_the_tracks_or_do_not_fit_leave_none() {
        let straight = Wheel::Torus { ring_mm: 40.0, tube_mm: f64::INFINITY, spindle: Vector::y() };
        for (wanted, wheel) in [
            (quadric(0.0, 0.0), Wheel::Sphere { radius_mm: f64::INFINITY }),
            (quadric(-0.001, 0.0), straight),
            // A hollow of 20 mm for a wheel of 30 mm, which no path is laid for.
            (quadric(0.0, 0.025), Wheel::Sphere { radius_mm: 30.0 }),
        ] {
            let none = between(&wanted, wheel, 0.5);
            assert_eq!([none.height_mm.max(1e-18), none.rms_mm.max(1e-18)], [1e-18; 2], "{wheel:?}");
            assert!(none.track_for_mm(1e-3, 1e-3) > 1e3);
        }
        // A cup that stands on one place of its ring is blunt across the tracks, and a disc as sharp as its rim.
        let disc = Wheel::Torus { ring_mm: 40.0, tube_mm: 5.0, spindle: Vector::y() };
        assert!((between(&quadric(0.0, 0.0), disc, 0.5).height_mm - 0.25 / 40.0).abs() < 1e-12);
        let cup = between(&quadric(0.0, 0.0), Wheel::tilted_cup(20.0, 1.0, 0.5), 0.5);
        let blunt = 0.5f64.sin() / (20.0 + 0.5f64.sin());
        assert!((cup.height_mm - 0.25 * blunt / 8.0).abs() < 1e-12, "{cup:?}");
    }

    #[test]
    fn on_a_slope_tracks_are_farther_apart_than_over_x_and_y() {
        // A plane that rises along x and y: tracks lie (1, 0, p), the next (0, t, q t) beside.
        let [p, q] = [0.4, 0.3];
        let slope = super::super::fit::tests::surface(|[x, y]| (p * x + q * y, [p, q]));
        let expected = 0.25 * (1.0 + p * p + q * q) / (1.0 + p * p) / (8.0 * 12.5);
        let found = between(&slope, Wheel::Sphere { radius_mm: 12.5 }, 0.5);
        assert!((found.height_mm / expected - 1.0).abs() < 1e-9, "{found:?} {expected}");
    }

    #[test]
    fn a_path_tells_its_own() {
        let laid = path(quadric(0.0, 0.0), ball(12.5)).unwrap();
        assert!((laid.scallops().height_mm - laid.track_mm().powi(2) / 100.0).abs() < 1e-12);
        let spiral = path(quadric(0.0, 0.0), PathOptions { pattern: Pattern::Spiral, ..ball(12.5) }).unwrap();
        assert!((spiral.scallops().height_mm - 2.5e-3).abs() < 1e-12);
    }
}
