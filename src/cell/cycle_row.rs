//! Figures of a cycle in the table of a run.

use serde::{Deserialize, Serialize};

/// Row of a cycle in the table at the end of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct CycleRow {
    pub cycle: u32,
    /// PV of all used points, in µm.
    pub pv_um: f64,
    /// PV that is judged, in µm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub judged_pv_um: Option<f64>,
    /// RMS of all used points, in µm.
    pub rms_um: f64,
    /// RMS that is judged, in µm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub judged_rms_um: Option<f64>,
    pub points: u32,
    pub outliers: u32,
    /// Height of the target surface above the nominal one, in µm.
    pub level_um: f64,
}

impl CycleRow {
    /// Returns `[PV, RMS]` of this cycle in µm, the two values that are compared with the limits. If the cycle has no
    /// separate judged PV, the first value is the PV of all used points. If the cycle has no separate judged RMS, the
    /// second value is the RMS of all used points. The used points are the points that the registration has used.
    pub fn judged_um(&self) -> [f64; 2] {
        [self.judged_pv_um.unwrap_or(self.pv_um), self.judged_rms_um.unwrap_or(self.rms_um)]
    }
}
