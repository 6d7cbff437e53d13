//! Figures of the form of a part.

use serde::{Deserialize, Serialize};

use super::interval::Interval;

/// Figures of the form of a part, with their credible intervals.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FormFigures {
    /// Peak to valley over the places at which the form was estimated. If the whole pattern was measured, these are the
    /// touched points.
    pub pv: Interval,
    /// PV 99.8 %: peak to valley over the aperture, at the touched points and between them. The outermost 0.1 % at each
    /// end are left out, but never a touched point.
    #[serde(rename = "pv_robust")]
    pub pv_998: Interval,
    /// Root mean square.
    pub rms: Interval,
    /// Standard deviation of the noise of a single point, in millimetres.
    #[serde(rename = "scatter_mm", with = "super::number")]
    pub noise_sigma_mm: f64,
}
