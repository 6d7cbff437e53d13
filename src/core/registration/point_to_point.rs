//! For comparison: the classic iteration on closest points, which the paper argues against.
//!
//! A measured point is drawn to the nearest point of the offset cloud, not to the surface between: the two sampling grids slide
//! along each other, and the error of a distance is of the size of the sampling step.

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Matrix3;
use rayon::prelude::*;

use crate::geometry::{Point, Pose, Vector};
use crate::surface::{Nominal, Side};

use super::error::RegistrationError;

/// What an iteration on closest points found.
#[derive(Clone, Debug)]
pub struct PointToPoint {
    /// Takes model coordinates to CMM coordinates.
    pub cmm_from_model: Pose,
    /// Sum of the squared distances between closest points after each turn, in mm^2.
    pub objective_mm2: Vec<f64>,
}

/// Registers probe centres to the points of the offset surface, closest point to closest point.
///
/// Shapes: at least 3 measured points. Frames and units as in [`super::register`]. Source: Besl and McKay, 1992, with the rigid
/// motion of each turn by singular value decomposition (Kabsch).
///
/// # Errors
/// Too few measured points, or no convergence of the objective to `tolerance` within `most_iterations`.
pub fn register_point_to_point(
    nominal: &Nominal,
    probe_radius_mm: f64,
    side: Side,
    measured: &[Point],
    start: Pose,
    tolerance: f64,
    most_iterations: usize,
) -> Result<PointToPoint, RegistrationError> {
    if measured.len() < 3 {
        return Err(RegistrationError::TooFewPoints { points: measured.len(), least: 3 });
    }
    let offset: Vec<[f64; 3]> = nominal.offset_points(probe_radius_mm * side.sign()).map(Into::into).collect();
    let tree = ImmutableKdTree::<f64, 3>::new_from_slice(&offset)
        .map_err(|_| RegistrationError::TooFewPoints { points: offset.len(), least: 3 })?;
    let (mut pose, mut objective_mm2) = (start, Vec::new());
    for _ in 0..most_iterations {
        let inverse = pose.inverse();
        let closest: Vec<(Point, f64)> = measured
            .par_iter()
            .map(|y| {
                let nearest = tree.query(&inverse.point(y).into()).nearest_one::<SquaredEuclidean<f64>>().execute();
                (Point::from(offset[nearest.item as usize]), nearest.distance)
            })
            .collect();
        let objective = closest.iter().map(|c| c.1).sum::<f64>();
        let before = objective_mm2.last().copied().unwrap_or(f64::INFINITY);
        objective_mm2.push(objective);
        if objective == 0.0 || 1.0 - objective / before <= tolerance {
            return Ok(PointToPoint { cmm_from_model: pose, objective_mm2 });
        }
        pose = rigid_motion(&closest, measured);
    }
    let objective_mm2 = objective_mm2.last().copied().unwrap_or(f64::INFINITY);
    Err(RegistrationError::NotConverged { iterations: most_iterations, objective_mm2 })
}

/// The rigid motion that carries the first of each pair as near as possible to the second.
fn rigid_motion(from: &[(Point, f64)], to: &[Point]) -> Pose {
    let n = to.len() as f64;
    let a = from.iter().map(|(p, _)| p.coords).sum::<Vector>() / n;
    let b = to.iter().map(|p| p.coords).sum::<Vector>() / n;
    let h: Matrix3<f64> = from.iter().zip(to).map(|((p, _), q)| (p.coords - a) * (q.coords - b).transpose()).sum();
    let svd = h.svd(true, true);
    let (u, v) = (svd.u.expect("asked for"), svd.v_t.expect("asked for").transpose());
    let proper = Vector::new(1.0, 1.0, (v * u.transpose()).determinant().signum());
    let rotation = v * Matrix3::from_diagonal(&proper) * u.transpose();
    Pose { rotation, translation_mm: b - rotation * a }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Twist;
    use crate::surface::Projection;

    fn wavy(columns: i32, rows: i32, step: f64, phase: f64) -> Vec<Point> {
        let at = |k: i32, n: i32| (f64::from(k) - f64::from(n - 1) / 2.0 + phase) * step;
        (0..columns * rows)
            .map(|k| (at(k % columns, columns), at(k / columns, rows)))
            .map(|(x, y)| Point::new(x, y, 1.5 * (0.3 * x).sin() + 0.05 * x * y + 0.02 * y * y))
            .collect()
    }

    #[test]
    fn points_of_the_cloud_itself_are_found_again() {
        let nominal = Nominal::from_points(wavy(61, 61, 0.5, 0.0), Projection::Auto).unwrap();
        let truth = Pose::exp(&Twist::new(0.05, -0.02, 0.03, 0.002, -0.001, 0.003));
        let measured: Vec<Point> = wavy(41, 41, 0.5, 0.0).iter().map(|p| truth.point(p)).collect();
        let found =
            register_point_to_point(&nominal, 0.0, Side::Normal, &measured, Pose::identity(), 1e-9, 200).unwrap();
        assert!((truth.inverse() * found.cmm_from_model).log().amax() < 1e-12);
    }

    #[test]
    fn points_between_those_of_the_cloud_are_drawn_to_them() {
        let nominal = Nominal::from_points(wavy(61, 61, 0.5, 0.0), Projection::Auto).unwrap();
        let measured = wavy(41, 41, 0.5, 0.3);
        let found =
            register_point_to_point(&nominal, 0.0, Side::Normal, &measured, Pose::identity(), 1e-9, 500).unwrap();
        // The grids slide onto each other: the distances say next to nothing and the pose is off by part of a step.
        assert!(found.cmm_from_model.translation_mm.norm() > 0.02);
        assert!(found.objective_mm2.windows(2).all(|w| w[1] <= w[0]));
    }
}
