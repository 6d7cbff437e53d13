//! Motion that all maps have made together.

use nalgebra::{Matrix3x6, Matrix6, Vector6};

use super::projected_map::ProjectedMap;
use super::scale::Scale;
use crate::geometry::{Point, Pose};

/// Weight of a shift along the surface. A shift across it changes the deviations, so it counts.
const ALONG: f64 = 1e-6;

/// Maximum number of points of a map that are compared.
const MAX_COMPARED: usize = 2_000;

/// Returns the pose that brings the points of all maps back to where their start poses place them, by least squares of the
/// shifts across the surface. Without it, the maps together would have moved to the nominal surface, and a registration
/// with locked directions would not show where the part lies.
///
/// `start` and `settled` are poses of the maps, `points` their points, and `projected` these points as they have settled.
pub(super) fn back_to_start(
    points: &[&[Point]],
    start: &[Pose],
    settled: &[Pose],
    projected: &[ProjectedMap],
    scale: &Scale,
) -> Pose {
    let mut back = Pose::identity();
    // Steps, because rotations are not linear.
    for _ in 0..3 {
        let (mut square, mut right) = (Matrix6::zeros(), Vector6::zeros());
        for (k, map) in projected.iter().enumerate() {
            for i in (0..map.len()).filter(|&i| map.is_usable[i] && map.is_sampled(i, MAX_COMPARED)) {
                let p = (back * settled[k]).transform_point(&points[k][i]);
                let shift = start[k].transform_point(&points[k][i]) - p;
                let moves: Matrix3x6<f64> = scale.shift_from_motion(&p);
                let normal = map.normals[i];
                let across = moves.transpose() * normal;
                square += across * across.transpose() + moves.transpose() * moves * ALONG;
                right += across * normal.dot(&shift) + moves.transpose() * shift * ALONG;
            }
        }
        // The shifts along the surface make it regular.
        let Some(factor) = square.cholesky() else { return back };
        back = scale.pose(&factor.solve(&right)) * back;
    }
    back
}
