//! Effect of the probe radius and of its uncertainty on a registration.
//!
//! A radius that is wrong by d changes every distance by -d. The fit explains part of this as a motion of the part:
//!
//! ```text
//!  pose  -d g,  g = (A^T A)^-1 A^T 1        deviation  -d (1 - a_i g)
//! ```
//!
//! On a nearly flat part almost all of it becomes a change of height. There the noise of thousands of points averages
//! to far less than the uncertainty of a radius that was calibrated on some points of a sphere. Without this term, the
//! largest part of the uncertainty would be missing.

use nalgebra::Vector6;

use super::deviation::{Deviation, PointStatus};
use super::result::Registration;

/// Estimate of the probe radius from the registered points.
#[derive(Clone, Copy, Debug)]
pub(super) struct RadiusEstimate {
    /// Estimated radius minus the given one, in mm.
    pub(super) difference_mm: f64,
    /// Standard uncertainty of the estimate in mm, from the remaining residuals, which are assumed independent.
    pub(super) sigma_mm: f64,
    /// Ratio of the rms with the estimated radius to the rms with the given radius.
    pub(super) rms_share: f64,
}

impl Registration {
    /// Estimates the correction dr of the probe radius by linear least squares, as a seventh unknown of the fit.
    /// Returns dr and its standard uncertainty in mm, and the ratio of the rms with the corrected radius to the rms
    /// with the given radius. Returns `None` if one of the three is not finite, for example if the residuals are zero.
    ///
    /// ```text
    ///  dr = sum r_i (1 - a_i g) / sum (1 - a_i g)^2,   g = (A^T A)^-1 A^T 1
    /// ```
    ///
    /// Here r_i is the deviation of inlier i, a_i its row of the Jacobian A, and 1 in A^T 1 the vector of ones.
    pub(super) fn estimate_radius(&self) -> Option<RadiusEstimate> {
        let variance = self.quality.residual_sigma_mm.powi(2);
        let used = || self.deviations.iter().filter(|d| d.status == PointStatus::Inlier);
        let sum: Vector6<f64> = used().map(row).sum();
        let motion = self.quality.covariance * sum / variance;
        let (mut cross, mut lever, mut squares, mut points) = (0.0, 0.0, 0.0, 0);
        for deviation in used() {
            let left = 1.0 - row(deviation).dot(&motion);
            cross += deviation.deviation_mm * left;
            lever += left * left;
            squares += deviation.deviation_mm.powi(2);
            points += 1;
        }
        let more_mm = cross / lever;
        let rest = (squares - cross * more_mm).max(0.0);
        let sigma_mm = (rest / f64::from((points - 7).max(1)) / lever).sqrt();
        let told = RadiusEstimate { difference_mm: more_mm, sigma_mm, rms_share: (rest / squares).sqrt() };
        (more_mm.is_finite() && sigma_mm.is_finite() && told.rms_share.is_finite()).then_some(told)
    }

    /// Adds the uncertainty of the probe radius to the covariance of the pose and to the uncertainties of the
    /// deviations. `radius_sigma_mm` is the standard uncertainty of the radius, in mm. The radius is one more input
    /// quantity of the uncertainty budget (GUM, 5.1.2).
    ///
    /// Directions that are undetermined or locked keep their covariance. Changes nothing if the residuals are zero, or
    /// if `radius_sigma_mm` is not positive and finite. Treats a robust loss as a square loss.
    pub fn add_radius_uncertainty(&mut self, radius_sigma_mm: f64) {
        let variance = self.quality.residual_sigma_mm.powi(2);
        if !(variance > 0.0 && radius_sigma_mm > 0.0 && radius_sigma_mm.is_finite()) {
            return;
        }
        let used = self.deviations.iter().filter(|d| d.status == PointStatus::Inlier);
        let sum: Vector6<f64> = used.map(row).sum();
        let motion = self.quality.covariance * sum / variance;
        self.quality.covariance += motion * motion.transpose() * radius_sigma_mm.powi(2);
        for deviation in &mut self.deviations {
            let left = 1.0 - row(deviation).dot(&motion);
            deviation.uncertainty_mm = deviation.uncertainty_mm.hypot(left * radius_sigma_mm);
        }
    }
}

/// Returns the row of the Jacobian for one deviation: the decrease of the distance with respect to each coordinate of
/// the twist (a small motion: translation, then rotation about the origin) of the pose in the model frame.
///
/// The row is computed from the contact point. The row of the probe centre is the same, because the centre lies on the
/// normal through the contact point.
fn row(deviation: &Deviation) -> Vector6<f64> {
    let (n, arm) = (deviation.normal, deviation.point.coords.cross(&deviation.normal));
    Vector6::new(n.x, n.y, n.z, arm.x, arm.y, arm.z)
}
