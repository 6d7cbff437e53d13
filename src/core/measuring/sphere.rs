//! Fit of a sphere to the centres of a probe on a reference sphere; it gives the real radius of the probe.

use nalgebra::{Matrix4, Vector4};
use thiserror::Error;

use crate::geometry::Point;

/// Sphere fitted to points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SphereFit {
    /// Centre, in the frame of the points.
    pub centre: Point,
    /// Radius, in millimetres.
    pub radius_mm: f64,
    /// Standard uncertainty of the radius from the residuals, in millimetres.
    pub radius_sigma_mm: f64,
    /// Rms distance of the points from the sphere, in millimetres.
    pub rms_mm: f64,
}

/// Reason why a sphere cannot be fitted.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum SphereFitError {
    #[error(
        "{points} points were touched on the reference sphere; at least {MIN_POINTS} are required; check the sphere and \
         its position in the cell file"
    )]
    TooFew { points: usize },
    #[error(
        "the points touched on the reference sphere are not finite or lie on a plane; check the sphere and its \
         position in the cell file"
    )]
    Degenerate,
}

/// Minimum number of points: one more than the unknowns, so that the fit can be judged.
const MIN_POINTS: usize = 5;

/// Fits a sphere to `points`, in mm. Returns the centre, the radius, the standard uncertainty of the radius and the rms
/// distance of the points from the sphere.
///
/// The fit minimises the sum of the squared distances of the points from the sphere. The method is Gauss-Newton,
/// starting from a linear (algebraic) fit.
///
/// # Errors
/// Returns an error if there are fewer than five points, if the points lie on a plane, or if a coordinate is not
/// finite.
pub fn fit_sphere(points: &[Point]) -> Result<SphereFit, SphereFitError> {
    if points.len() < MIN_POINTS {
        return Err(SphereFitError::TooFew { points: points.len() });
    }
    let middle = points.iter().fold(nalgebra::Vector3::zeros(), |sum, p| sum + p.coords) / points.len() as f64;
    let (mut centre, mut radius) = algebraic(points, &middle).ok_or(SphereFitError::Degenerate)?;
    for _ in 0..50 {
        let (normal, gradient) = normal_equations(points, &centre, radius);
        let step = normal.cholesky().ok_or(SphereFitError::Degenerate)?.solve(&gradient);
        centre += step.xyz();
        radius += step.w;
        if step.norm() < 1e-13 * (1.0 + radius.abs()) {
            break;
        }
    }
    let squares: f64 = points.iter().map(|p| ((p.coords - centre).norm() - radius).powi(2)).sum();
    let (normal, _) = normal_equations(points, &centre, radius);
    let inverse = normal.try_inverse().ok_or(SphereFitError::Degenerate)?;
    let variance = squares / (points.len() - 4) as f64;
    let fit = SphereFit {
        centre: centre.into(),
        radius_mm: radius,
        radius_sigma_mm: (variance * inverse[(3, 3)]).sqrt(),
        rms_mm: (squares / points.len() as f64).sqrt(),
    };
    let finite = (centre.sum() + fit.radius_mm + fit.radius_sigma_mm + fit.rms_mm).is_finite();
    if finite && radius > 0.0 { Ok(fit) } else { Err(SphereFitError::Degenerate) }
}

/// Fits a sphere by linear least squares (algebraic fit). `middle` is the centroid of the points. Returns the centre
/// and the radius of the sphere, in mm.
///
/// For a point p on a sphere with the centre c and the radius r, |p|^2 = 2 p.c + (r^2 - |c|^2). This equation is linear
/// in c and in the term in brackets. To reduce rounding errors, it is solved with `middle` as the origin.
///
/// Returns `None` if the points lie on a plane, or if the result is not finite.
fn algebraic(points: &[Point], middle: &nalgebra::Vector3<f64>) -> Option<(nalgebra::Vector3<f64>, f64)> {
    let (mut normal, mut right) = (Matrix4::zeros(), Vector4::zeros());
    let size = points.iter().map(|p| (p.coords - middle).norm()).fold(0.0, f64::max);
    for p in points {
        let q = (p.coords - middle) / size;
        let row = Vector4::new(2.0 * q.x, 2.0 * q.y, 2.0 * q.z, 1.0);
        normal += row * row.transpose();
        right += row * q.norm_squared();
    }
    let solved = normal.cholesky()?.solve(&right);
    let least = normal.symmetric_eigenvalues().min();
    if least <= 1e-12 || least.is_nan() {
        return None;
    }
    let centre = solved.xyz();
    let radius = (solved.w + centre.norm_squared()).sqrt() * size;
    radius.is_finite().then(|| (middle + centre * size, radius))
}

/// Returns the normal equations of one Gauss-Newton step of a sphere fit. The four unknowns are the changes of the
/// centre (x, y, z) and of the radius.
///
/// The results are the matrix J'J and the right side J'r. The residuals r are the distances of the points from
/// `centre`, minus `radius`. J has one row for each point: the unit vector from `centre` to the point, then 1.
fn normal_equations(points: &[Point], centre: &nalgebra::Vector3<f64>, radius: f64) -> (Matrix4<f64>, Vector4<f64>) {
    points.iter().fold((Matrix4::zeros(), Vector4::zeros()), |(normal, gradient), p| {
        let from = p.coords - centre;
        let distance = from.norm();
        let row = (from / distance).push(1.0);
        (normal + row * row.transpose(), gradient + row * (distance - radius))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measuring::sphere_targets;

    #[test]
    fn fit_sphere_from_upper_half() {
        let centre = Point::new(-300.0, 40.0, 12.0);
        let on = |radius| sphere_targets(centre, radius, 25).into_iter().map(|t| t.point).collect::<Vec<_>>();
        for radius in [14.0, 0.3, 400.0] {
            let fit = fit_sphere(&on(radius)).unwrap();
            assert!((fit.radius_mm - radius).abs() < 1e-9 && (fit.centre - centre).norm() < 1e-9, "{fit:?}");
        }
    }

    #[test]
    fn fit_sphere_sigma_from_noise() {
        // Residuals alternate between +1 um and -1 um.
        let sign = |k: usize| if k.is_multiple_of(2) { 1e-3 } else { -1e-3 };
        let targets = sphere_targets(Point::origin(), 14.0, 40);
        let points: Vec<Point> = targets.iter().enumerate().map(|(k, t)| t.point + t.normal * sign(k)).collect();
        let fit = fit_sphere(&points).unwrap();
        assert!(
            (fit.radius_mm - 14.0).abs() < 3.0 * fit.radius_sigma_mm && (2e-4..1e-3).contains(&fit.radius_sigma_mm)
        );
    }

    #[test]
    fn fit_sphere_refuses_degenerate_points() {
        assert_eq!(fit_sphere(&[Point::origin(); 4]), Err(SphereFitError::TooFew { points: 4 }));
        assert_eq!(fit_sphere(&[Point::origin(); 9]), Err(SphereFitError::Degenerate));
        let plane: Vec<Point> = (0..9).map(|k| Point::new(f64::from(k % 3), f64::from(k / 3), 0.0)).collect();
        assert_eq!(fit_sphere(&plane), Err(SphereFitError::Degenerate));
        let mut bad = plane;
        bad[2].z = f64::NAN;
        assert_eq!(fit_sphere(&bad), Err(SphereFitError::Degenerate));
    }
}
