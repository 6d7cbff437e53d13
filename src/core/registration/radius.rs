//! What the uncertainty of the probe's radius does to a registration.
//!
//! A radius that is wrong by d moves every distance by -d. The fit takes what it can of that for a motion of the part:
//!
//! ```text
//!  pose  -d g,  g = (A^T A)^-1 A^T 1        deviation  -d (1 - a_i g)
//! ```
//!
//! On a nearly flat part almost all of it is taken for height, where the scatter of thousands of points is far below what a sphere of
//! some points tells the radius to: left out, it would be most of what is wrong.

use nalgebra::Vector6;

use super::deviation::{Deviation, PointStatus};
use super::result::Registration;

/// What the points tell of the radius that they were registered with.
#[derive(Clone, Copy, Debug)]
pub(super) struct ToldRadius {
    /// How much larger the radius should be, in millimetres.
    pub(super) more_mm: f64,
    /// Its standard uncertainty by what scatter would be left, as if every point scattered by itself.
    pub(super) sigma_mm: f64,
    /// The share of the rms that would be left.
    pub(super) rms_left: f64,
}

impl Registration {
    /// Returns what the points tell of the radius, taken for a seventh unknown; `None` where there is no scatter.
    ///
    /// ```text
    ///  dr = sum r_i (1 - a_i g) / sum (1 - a_i g)^2
    /// ```
    pub(super) fn told_radius(&self) -> Option<ToldRadius> {
        let variance = self.verdict.residual_sigma_mm.powi(2);
        let used = || self.deviations.iter().filter(|d| d.status == PointStatus::Used);
        let sum: Vector6<f64> = used().map(row).sum();
        let motion = self.verdict.covariance * sum / variance;
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
        let told = ToldRadius { more_mm, sigma_mm, rms_left: (rest / squares).sqrt() };
        (more_mm.is_finite() && sigma_mm.is_finite() && told.rms_left.is_finite()).then_some(told)
    }

    /// Adds the standard uncertainty of the probe's radius, in millimetres, to what is stated of pose and deviations.
    ///
    /// (A^T A)^-1 is taken from the covariance, so that directions that are held or locked stay as they are; without any
    /// scatter there is none, and nothing is changed. Equation: GUM, 5.1.2, for one more input; a robust loss is taken for squares.
    pub fn allow_for_radius(&mut self, radius_sigma_mm: f64) {
        let variance = self.verdict.residual_sigma_mm.powi(2);
        if !(variance > 0.0 && radius_sigma_mm > 0.0 && radius_sigma_mm.is_finite()) {
            return;
        }
        let used = self.deviations.iter().filter(|d| d.status == PointStatus::Used);
        let sum: Vector6<f64> = used.map(row).sum();
        let motion = self.verdict.covariance * sum / variance;
        self.verdict.covariance += motion * motion.transpose() * radius_sigma_mm.powi(2);
        for deviation in &mut self.deviations {
            let left = 1.0 - row(deviation).dot(&motion);
            deviation.uncertainty_mm = deviation.uncertainty_mm.hypot(left * radius_sigma_mm);
        }
    }
}

/// How the distance of a point falls with the twist of the pose; moving the point along its normal changes nothing of it.
fn row(deviation: &Deviation) -> Vector6<f64> {
    let (n, arm) = (deviation.normal, deviation.point.coords.cross(&deviation.normal));
    Vector6::new(n.x, n.y, n.z, arm.x, arm.y, arm.z)
}
