//! Groove that the wheel leaves along one track.

use super::target_surface::SurfaceCurvature;
use super::{TrackPattern, Wheel};
use crate::geometry::{Aperture, Vector};

/// Groove that the wheel leaves at a place.
pub(super) struct Groove {
    /// Curvature of the groove relative to the surface, across the track, in 1/mm; 0 if there is no groove.
    pub(super) curvature_per_mm: f64,
    /// Ratio of the distance between two tracks along the surface, across the track, to their distance over x and y.
    pub(super) stretch: f64,
}

/// Returns `place` minus the middle of the bounding box of the part, in mm. A spiral winds about this middle.
pub(super) fn relative_to_middle(outline: &Aperture, place: [f64; 2]) -> [f64; 2] {
    let [low, high] = outline.bounds();
    std::array::from_fn(|k| place[k] - 0.5 * (low[k] + high[k]))
}

/// Returns the groove that the wheel leaves at one place of the surface. The result contains two values:
///
/// - The curvature of the groove relative to the surface, across the track, in 1/mm. The curvature is 0 if there is no
///   groove.
/// - The stretch: the distance between two neighbouring tracks, measured on the surface across the track, divided by
///   their distance in the xy plane.
///
/// `bend` holds contact point, normal and curvatures of the surface at this place. `[x, y]` is the place in mm,
/// relative to the middle of the part ([`relative_to_middle`]). `wheel` is the wheel with the direction of its spindle.
/// `pattern` gives the direction of the track: along x for a raster, tangential for a spiral.
pub(super) fn groove(bend: &SurfaceCurvature, [x, y]: [f64; 2], wheel: &Wheel, pattern: TrackPattern) -> Groove {
    // Direction of the track over x and y; the next track is at a right angle to it.
    let radius = x.hypot(y);
    let [east, north] = match pattern {
        TrackPattern::Spiral if radius > 0.0 => [-y / radius, x / radius],
        TrackPattern::Spiral | TrackPattern::Raster => [1.0, 0.0],
    };
    let n = &bend.contact.normal;
    let on_surface = |east: f64, north: f64| Vector::new(east, north, -(east * n.x + north * n.y) / n.z);
    let track = on_surface(east, north).normalize();
    let across = n.cross(&track);
    let stretch = on_surface(-north, east).dot(&across).abs();
    let wheel = wheel_curvatures(bend, wheel);
    let gap: [f64; 3] = std::array::from_fn(|k| wheel[k] - bend.second_form_per_mm[k]);
    let [c, s] = [0, 1].map(|k| track.dot(&bend.tangents[k]));
    let [along, mixed, over] = [
        gap[0] * c * c + 2.0 * gap[1] * s * c + gap[2] * s * s,
        (gap[2] - gap[0]) * s * c + gap[1] * (c * c - s * s),
        gap[0] * s * s - 2.0 * gap[1] * s * c + gap[2] * c * c,
    ];
    let swept = over - if mixed == 0.0 { 0.0 } else { mixed * mixed / along };
    Groove { curvature_per_mm: if swept > 0.0 { swept } else { 0.0 }, stretch }
}

/// Returns the second fundamental form (the curvatures) of the wheel at the contact point, in 1/mm. The three values
/// are the curvature in the first tangent direction of `bend`, the mixed term, and the curvature in the second tangent
/// direction.
pub(super) fn wheel_curvatures(bend: &SurfaceCurvature, wheel: &Wheel) -> [f64; 3] {
    let ([around, across], direction) = wheel.curvatures(&bend.contact.normal);
    let [c, s] = [0, 1].map(|k| direction.dot(&bend.tangents[k]));
    [around * c * c + across * s * s, (around - across) * s * c, around * s * s + across * c * c]
}
