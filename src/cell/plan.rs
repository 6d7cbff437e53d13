//! What the recipe and the cell file ask of the cell, as far as the cell decides upon it.

use std::time::Duration;

use serde::{Deserialize, Serialize};

/// The numbers that the cell decides by. Checked by who builds it; a number that is none makes the cell accept nothing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CellPlan {
    /// Where the first cycle begins.
    pub begin_with: Beginning,
    /// The most passes of the grinder.
    pub max_cycles: u32,
    /// What is accepted.
    pub tolerance: Tolerance,
    /// Improvement, as a share of the cycle before, below which the run is taken as stalled.
    pub stall_share: f64,
    /// Improvement of the rms below which the run is taken as stalled, whatever share that is.
    #[serde(default)]
    pub stall_mm: f64,
    /// What to do when it stalls.
    pub on_stall: Disposal,
    /// What to do when it has diverged twice.
    pub on_divergence: Disposal,
    /// What to do when there is no next map for another reason than the budget.
    pub on_refusal: Disposal,
    /// The limits that a measurement must keep.
    pub gates: Gates,
    /// The most material that may be taken off anywhere in the whole run.
    pub removal_budget_mm: f64,
    /// The least that a pass takes off anywhere.
    pub least_depth_mm: f64,
    /// Whether a machine found aborted or faulted at the start is cleared without asking.
    pub clear_at_start: bool,
    /// How long each thing may take.
    pub deadlines: Deadlines,
}

/// What the first cycle begins with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Beginning {
    /// A pass of the grinder.
    Grind,
    /// A measurement of the part as it is; its surface stands over the nominal one by the allowance.
    Measure,
}

/// What is accepted.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tolerance {
    /// Peak to valley; infinite where it is not limited.
    #[serde(deserialize_with = "super::number::limit")]
    pub pv_mm: f64,
    /// Root mean square; infinite where it is not limited.
    #[serde(deserialize_with = "super::number::limit")]
    pub rms_mm: f64,
    /// Whether the uncertainty of the figures is counted; else what is as probably above as below is held against the limit.
    pub with_uncertainty: bool,
    /// The probability with which a figure must be within its limit to be accepted, and beyond it to be rejected, 0.5 to below 1. Recorded where it is not
    /// the usual one.
    #[serde(default = "Tolerance::usual", skip_serializing_if = "Tolerance::is_usual")]
    pub probability: f64,
    /// Which points the peak to valley is taken of.
    pub pv_of: PvOf,
}

impl Tolerance {
    /// The probability that is asked for where nobody asks for another: of a normal figure its guard band is the expanded uncertainty with
    /// k = 2 (ISO 14253-1).
    pub const USUAL: f64 = 0.975;

    fn usual() -> f64 {
        Self::USUAL
    }

    fn is_usual(probability: &f64) -> bool {
        *probability == Self::USUAL
    }
}

/// Which points a peak to valley is taken of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub enum PvOf {
    /// The points that were touched.
    #[serde(rename = "all")]
    All,
    /// The aperture: the touched points and the places between them, without the outermost 0.1 % of these at either end.
    #[default]
    #[serde(rename = "99.8 %")]
    MostPoints,
}

/// What to do when a run does not get on, or a part does not get better.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Disposal {
    /// Hold with an alarm; a person decides.
    Hold,
    /// End the run in order; the part is not in tolerance.
    Stop,
}

/// The limits that a measurement must keep before anything is made of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Gates {
    /// Least share of the planned points that must be found, 0 to 1.
    pub least_found: f64,
    /// Least share of the aperture that must be covered, 0 to 1.
    pub least_coverage: f64,
    /// Most shift of the part from where it is expected.
    pub most_shift_mm: f64,
    /// Most turn of the part from how it is expected.
    pub most_turn_rad: f64,
    /// Most error of the radius of the probe; none where there is no reference sphere.
    pub most_radius_error_mm: Option<f64>,
}

/// How long each thing may take.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Deadlines {
    /// To connect and check both machines.
    pub connect: Duration,
    /// To load the part; none waits for ever.
    pub load: Option<Duration>,
    /// To send a payload, and to collect a result.
    pub transfer: Duration,
    /// For any other answer of a machine: prepare, start, clear, acknowledge, resume, reconcile.
    pub answer: Duration,
    /// Between two signs of progress of a running job of each machine: CMM, grinder. A job done by hand gives none before its end.
    pub progress: [Duration; 2],
    /// After how long without a sign of progress a person is told, or after three times the longest that this job took for one; none where
    /// a job gives no such signs.
    #[serde(default)]
    pub progress_notice: [Option<Duration>; 2],
    /// Since the first of several failures at the same place, without getting any further, before the cell is held.
    #[serde(default = "Deadlines::vain")]
    pub vain: Duration,
    /// How many failures in a row, without getting any further, are enough for that.
    #[serde(default = "Deadlines::vain_failures")]
    pub vain_failures: u32,
    /// From HOLD to the safe place of each machine: CMM, grinder.
    pub hold: [Duration; 2],
    /// From STOP to the end of the job of each machine: CMM, grinder.
    pub stop: [Duration; 2],
    /// From ABORT to its confirmation; then the alarm, one repetition, and as long again.
    pub abort: Duration,
    /// For a registration or a compensation.
    pub compute: Duration,
    /// How long the cell stays suspended before it is held.
    pub suspended: Duration,
    /// How long it stays held before it ends in order; none waits for ever.
    pub held: Option<Duration>,
}

impl Deadlines {
    fn vain() -> Duration {
        Duration::from_secs(60)
    }

    fn vain_failures() -> u32 {
        5
    }
}

impl Default for Deadlines {
    fn default() -> Self {
        let s = Duration::from_secs;
        Self {
            connect: s(20),
            load: None,
            transfer: s(120),
            answer: s(10),
            progress: [s(60); 2],
            progress_notice: [Some(s(30)); 2],
            vain: Self::vain(),
            vain_failures: Self::vain_failures(),
            hold: [s(30); 2],
            stop: [s(60); 2],
            abort: s(2),
            compute: s(600),
            suspended: s(600),
            held: None,
        }
    }
}
