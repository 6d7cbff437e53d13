//! Rigid fit: the motion that maps one set of points onto another, pair by pair.
//!
//! A tracker that is moved between two stations sees the same few reference points from each. The motion from the
//! observed points to their reference positions brings the stations into one frame. The fit is Kabsch's: centroids, the
//! 3 x 3 cross-covariance, its singular value decomposition, and a determinant that distinguishes a rotation from a
//! mirror image.
//!
//! Units: millimetres.

use nalgebra::{Matrix3, Vector3};
use regrind_figures::statistics::root_mean;
use thiserror::Error;

use super::{Point, Pose, Vector};

/// Minimum ratio of the spread of the points across their longest direction to the spread along it. With a smaller
/// ratio the points nearly lie on a line, and do not determine the rotation about it.
const MIN_WIDTH_SHARE: f64 = 1e-3;
/// Minimum ratio of the spread out of a plane to the largest spread. With a smaller ratio the points cannot show
/// whether one set is a mirror image of the other.
const MIN_DEPTH_SHARE: f64 = 1e-2;

/// Result of a rigid fit.
#[derive(Clone, Debug, PartialEq)]
pub struct RigidFit {
    /// Pose that maps the first set onto the second.
    pub pose: Pose,
    /// Residual of each pair, in the given order: the target minus the moved point.
    pub residuals_mm: Vec<Vector>,
    /// Root mean square of the lengths of the residuals.
    pub rms_mm: f64,
}

impl RigidFit {
    /// Returns the index of the pair of points with the largest residual, and the length of this residual in
    /// millimetres. The residual of a pair is the target point minus the moved point. The index counts from 0, in the
    /// order of the pairs given to [`fit_rigid`]. Returns `(0, 0.0)` if all residuals are 0.
    pub fn max_residual(&self) -> (usize, f64) {
        let lengths = self.residuals_mm.iter().map(Vector3::norm).enumerate();
        lengths.fold((0, 0.0), |worst, next| if next.1 > worst.1 { next } else { worst })
    }
}

/// Reason why two sets of points have no rigid fit. An index counts from 0.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum RigidError {
    /// The sets have different lengths.
    #[error("{from} points cannot be fitted to {to} points; give two lists of the same length, pair by pair")]
    Counts { from: usize, to: usize },
    /// Too few points to fix a pose.
    #[error("{points} pairs of points do not determine a pose; at least 3 are required; measure more reference points")]
    TooFew { points: usize },
    /// A coordinate is NaN or infinite.
    #[error("pair {} of the points has a coordinate that is not finite; remove this pair", index + 1)]
    NotFinite { index: usize },
    /// All points lie on a line.
    #[error(
        "the points lie on one line: their width is {share:.1e} of their length; at least {MIN_WIDTH_SHARE:.0e} is \
         required to determine the rotation about this line; add a reference point off the line"
    )]
    Collinear { share: f64 },
    /// One set is a mirror image of the other.
    #[error(
        "one set of points is a mirror image of the other: as given they fit to {rms_mm:.4} mm rms, mirrored to \
         {mirrored_rms_mm:.4} mm; correct a reversed axis or two swapped points"
    )]
    Mirrored { rms_mm: f64, mirrored_rms_mm: f64 },
}

/// Fits the rigid motion that maps the points `from` onto the points `to`, pair by pair, with the smallest sum of
/// squared distances (Kabsch 1976, Umeyama 1991). Units: millimetres.
///
/// # Errors
/// Returns an error if the lists have different lengths or fewer than three pairs, if a coordinate is not finite, if
/// the points of a list lie on one line, or if one list is the mirror image of the other.
pub fn fit_rigid(from: &[Point], to: &[Point]) -> Result<RigidFit, RigidError> {
    check(from, to)?;
    let (a, b) = (centroid(from), centroid(to));
    let cross: Matrix3<f64> = from.iter().zip(to).map(|(p, q)| (q.coords - b) * (p.coords - a).transpose()).sum();
    let svd = cross.svd(true, true);
    let (u, v_t) = (svd.u.expect("asked for"), svd.v_t.expect("asked for"));
    let sign = (u * v_t).determinant().signum();
    let rotation = u * Matrix3::from_diagonal(&Vector::new(1.0, 1.0, sign)) * v_t;
    let pose = Pose { rotation, translation_mm: b - rotation * a }.orthonormalised();
    let residuals_mm: Vec<Vector> = from.iter().zip(to).map(|(p, q)| q - pose.transform_point(p)).collect();
    let rms_mm = rms(&residuals_mm);
    if sign < 0.0 {
        let mirror = u * v_t;
        let mirrored: Vec<Vector> =
            from.iter().zip(to).map(|(p, q)| (q.coords - b) - mirror * (p.coords - a)).collect();
        let mirrored_rms_mm = rms(&mirrored);
        let deep = spreads(from)[2].min(spreads(to)[2]) > MIN_DEPTH_SHARE * spreads(from)[0];
        if deep && mirrored_rms_mm < 0.1 * rms_mm {
            return Err(RigidError::Mirrored { rms_mm, mirrored_rms_mm });
        }
    }
    Ok(RigidFit { pose, residuals_mm, rms_mm })
}

/// Checks the input of [`fit_rigid`].
///
/// # Errors
/// Returns an error if the lists have different lengths or fewer than three points, if a coordinate is not finite, or
/// if the points of a list lie on one line.
fn check(from: &[Point], to: &[Point]) -> Result<(), RigidError> {
    if from.len() != to.len() {
        return Err(RigidError::Counts { from: from.len(), to: to.len() });
    }
    if from.len() < 3 {
        return Err(RigidError::TooFew { points: from.len() });
    }
    let finite = |p: &Point| p.coords.iter().all(|c| c.is_finite());
    if let Some(index) = from.iter().zip(to).position(|(p, q)| !finite(p) || !finite(q)) {
        return Err(RigidError::NotFinite { index });
    }
    for points in [from, to] {
        let [length, width, _] = spreads(points);
        let share = if length > 0.0 { width / length } else { 0.0 };
        if share < MIN_WIDTH_SHARE {
            return Err(RigidError::Collinear { share });
        }
    }
    Ok(())
}

fn centroid(points: &[Point]) -> Vector {
    points.iter().map(|p| p.coords).sum::<Vector>() / points.len() as f64
}

fn rms(residuals: &[Vector]) -> f64 {
    root_mean(residuals.iter().map(Vector3::norm_squared))
}

/// Returns the root mean square distances of `points` from their centroid along their three principal axes, in mm. The
/// largest value comes first.
fn spreads(points: &[Point]) -> [f64; 3] {
    let middle = centroid(points);
    let scatter: Matrix3<f64> = points.iter().map(|p| (p.coords - middle) * (p.coords - middle).transpose()).sum();
    let mut squares: [f64; 3] = scatter.symmetric_eigenvalues().into();
    squares.sort_unstable_by(|a, b| b.total_cmp(a));
    squares.map(|square| (square.max(0.0) / points.len() as f64).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Twist;

    const OBSERVED: [[f64; 3]; 5] = [
        [2400.0, -2698.0, 4817.0],
        [-2397.0, -2699.0, 4820.0],
        [2396.0, 2656.0, 2141.0],
        [-2399.0, 2658.0, 2140.0],
        [10.0, 20.0, 900.0],
    ];

    fn points(of: &[[f64; 3]]) -> Vec<Point> {
        of.iter().map(|p| Point::from(*p)).collect()
    }

    #[test]
    fn fit_rigid_recovers_planted_motion() {
        let from = points(&OBSERVED);
        for count in [3, 4, 5] {
            for angle in [0.0, 1e-9, 0.01, 1.0, 2.0, std::f64::consts::PI] {
                let omega = Vector::new(0.36, -0.48, 0.8) * angle;
                let truth = Pose::exp(&Twist::new(300.0, -20.0, 1e4, omega.x, omega.y, omega.z));
                let to: Vec<Point> = from.iter().map(|p| truth.transform_point(p)).collect();
                let fit = fit_rigid(&from[..count], &to[..count]).unwrap();
                assert!((fit.pose.rotation - truth.rotation).amax() < 1e-14, "{count} points, {angle} rad");
                assert!(fit.rms_mm < 1e-10 && (fit.pose.transform_point(&from[0]) - to[0]).norm() < 1e-10);
            }
        }
    }

    #[test]
    fn fit_rigid_names_worst_point() {
        let from = points(&OBSERVED);
        let mut to = from.clone();
        to[3].z += 4.0;
        let fit = fit_rigid(&from, &to).unwrap();
        let (worst, off_mm) = fit.max_residual();
        assert!(worst == 3 && off_mm > 0.5 && off_mm < 4.0, "{worst}: {off_mm}");
        // The best fit is a minimum: a small rotation or shift about it increases the rms.
        for k in 0..6 {
            let mut twist = Twist::zeros();
            twist[k] = if k < 3 { 1e-3 } else { 1e-6 };
            let near = Pose::exp(&twist) * fit.pose;
            let moved: Vec<Vector> = from.iter().zip(&to).map(|(p, q)| q - near.transform_point(p)).collect();
            assert!(rms(&moved) > fit.rms_mm, "direction {k}");
        }
    }

    #[test]
    fn fit_rigid_refuses_mirror_image() {
        let from = points(&OBSERVED);
        let to: Vec<Point> = from.iter().map(|p| Point::new(-p.x, p.y, p.z)).collect();
        assert!(
            matches!(fit_rigid(&from, &to), Err(RigidError::Mirrored { mirrored_rms_mm, .. }) if mirrored_rms_mm < 1e-9)
        );
        // Three points lie in a plane, where a mirror image is also a rotation.
        assert!(fit_rigid(&from[..3], &to[..3]).unwrap().rms_mm < 1e-9);
        // Noise out of the plane is not a mirror image.
        let noise = |s: f64| points(&[[0.0, 0.0, s], [1e3, 0.0, -s], [0.0, 1e3, -s], [1e3, 1e3, s]]);
        assert!(fit_rigid(&noise(0.1), &noise(-0.1)).is_ok());
    }

    #[test]
    fn fit_rigid_refuses_degenerate_points() {
        let from = points(&OBSERVED);
        let line = points(&[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [2.0, 2.0, 2.0001], [5.0, 5.0, 5.0]]);
        assert!(matches!(fit_rigid(&line, &from[..4]), Err(RigidError::Collinear { share }) if share < 1e-3));
        assert!(matches!(fit_rigid(&from[..4], &line), Err(RigidError::Collinear { .. })));
        let one = vec![from[0]; 4];
        assert_eq!(fit_rigid(&one, &one), Err(RigidError::Collinear { share: 0.0 }));
        assert_eq!(fit_rigid(&from[..2], &from[..2]), Err(RigidError::TooFew { points: 2 }));
        assert_eq!(fit_rigid(&from, &from[..4]), Err(RigidError::Counts { from: 5, to: 4 }));
        let mut bad = from.clone();
        bad[1].y = f64::NAN;
        assert_eq!(fit_rigid(&bad, &from), Err(RigidError::NotFinite { index: 1 }));
    }
}
