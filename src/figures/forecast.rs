//! Expected result of another pass.

use serde::{Deserialize, Serialize};

/// Expected result of another pass.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Forecast {
    /// Root mean square of the deviations, in millimetres.
    #[serde(with = "super::number")]
    pub rms_mm: f64,
    /// Standard deviation of `rms_mm` from part to part, in millimetres.
    #[serde(with = "super::number")]
    pub sigma_mm: f64,
    /// Lower bound of the rms that further corrections can reach, in millimetres, as estimated from the passes so far.
    /// It includes the scallops between the tracks. `None` while the non-repeatable error is unknown, as after only one
    /// pass.
    #[serde(default, with = "super::number::optional")]
    pub floor_mm: Option<f64>,
}
