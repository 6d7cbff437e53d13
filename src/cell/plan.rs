//! Parameters of the recipe and of the cell file on which the cell decides.

use std::time::Duration;

use regrind_figures::number;
use serde::{Deserialize, Serialize};

/// Parameters by which the cell decides. The code that builds a plan checks its values. With a NaN as a limit, the cell
/// accepts no part.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CellPlan {
    /// First step of the first cycle.
    pub begin_with: FirstStep,
    /// Maximum number of passes of the grinder.
    pub max_cycles: u32,
    /// Accepted tolerance.
    pub tolerance: Tolerance,
    /// Minimum improvement of a figure by a cycle, as a share of the figure of the previous cycle. With less
    /// improvement the run counts as stalled.
    pub stall_share: f64,
    /// Minimum improvement of the rms by a cycle. With less improvement the rms counts as stalled, even if the
    /// improvement exceeds `stall_share`.
    #[serde(default)]
    pub stall_mm: f64,
    /// Action when the run stalls.
    pub on_stall: HoldOrStop,
    /// Action after two cycles in a row that are worse than the one before.
    pub on_divergence: HoldOrStop,
    /// Action when no next map can be computed, for a reason other than the removal budget.
    pub on_refusal: HoldOrStop,
    /// Limits that a measurement must satisfy.
    pub gates: GateLimits,
    /// Maximum removal at any place in the whole run.
    pub removal_budget_mm: f64,
    /// Minimum removal of a pass at any place.
    #[serde(rename = "least_depth_mm")]
    pub min_depth_mm: f64,
    /// True if a machine that is aborted or faulted at the start is cleared without asking a person.
    pub clear_at_start: bool,
    /// Time limits.
    pub deadlines: Deadlines,
}

/// First step of the first cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum FirstStep {
    /// A pass of the grinder.
    Grind,
    /// A measurement of the part as it is; its surface is above the nominal one by the allowance.
    Measure,
}

impl FirstStep {
    /// Returns the maximum number of cycles, and thus of measurements, of a run with at most `max_passes` passes. A run
    /// that begins with a measurement has one cycle without a pass.
    pub fn max_cycle_number(self, max_passes: u32) -> u32 {
        max_passes.saturating_add(u32::from(self == Self::Measure))
    }
}

impl CellPlan {
    /// Returns the maximum number of cycles, and thus of measurements, see [`FirstStep::max_cycle_number`].
    pub fn max_cycle_number(&self) -> u32 {
        self.begin_with.max_cycle_number(self.max_cycles)
    }
}

/// Accepted tolerance.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tolerance {
    /// Limit of the peak to valley; infinite if it is not limited.
    #[serde(deserialize_with = "number::limit")]
    pub pv_mm: f64,
    /// Limit of the root mean square; infinite if it is not limited.
    #[serde(deserialize_with = "number::limit")]
    pub rms_mm: f64,
    /// True if a figure must be within its limit with `probability`. If false, the median is compared with the limit.
    pub with_uncertainty: bool,
    /// Probability with which a figure must be within its limit to be accepted, and beyond it to be rejected: 0.5 to
    /// below 1. Recorded only if it is not the default one.
    #[serde(default = "Tolerance::usual", skip_serializing_if = "Tolerance::is_usual")]
    pub probability: f64,
    /// Points from which the peak to valley is taken.
    #[serde(rename = "pv_of")]
    pub pv_points: PvPoints,
}

impl Tolerance {
    /// Default probability. For a normal figure the guard band is then the expanded uncertainty with k = 2 (ISO
    /// 14253-1).
    pub const DEFAULT_PROBABILITY: f64 = 0.975;

    fn usual() -> f64 {
        Self::DEFAULT_PROBABILITY
    }

    fn is_usual(probability: &f64) -> bool {
        *probability == Self::DEFAULT_PROBABILITY
    }
}

/// Points that a peak to valley includes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
pub enum PvPoints {
    /// The points that were touched.
    #[serde(rename = "all")]
    All,
    /// The aperture: the touched points and the places between them, without the outermost 0.1 % of these at either
    /// end.
    #[default]
    #[serde(rename = "99.8 %")]
    MostPoints,
}

/// Response to a run without progress, or to a part that does not improve.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum HoldOrStop {
    /// Hold with an alarm; a person decides.
    Hold,
    /// End the run in order; the part is not in tolerance.
    Stop,
}

/// Limits that a measurement must satisfy before it is used.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GateLimits {
    /// Minimum share of the planned points that must be found, 0 to 1.
    #[serde(rename = "least_found")]
    pub min_found_share: f64,
    /// Minimum share of the aperture that must be covered, 0 to 1.
    #[serde(rename = "least_coverage")]
    pub min_coverage: f64,
    /// Maximum shift of the part from its expected place.
    #[serde(rename = "most_shift_mm")]
    pub max_shift_mm: f64,
    /// Maximum turn of the part from its expected orientation.
    #[serde(rename = "most_turn_rad")]
    pub max_rotation_rad: f64,
    /// Maximum error of the radius of the probe; `None` if there is no reference sphere.
    #[serde(rename = "most_radius_error_mm")]
    pub max_radius_error_mm: Option<f64>,
}

/// Time limits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Deadlines {
    /// Time to connect and check both machines.
    pub connect: Duration,
    /// Time to load the part; `None` means no limit.
    pub load: Option<Duration>,
    /// Time to send a payload, and to collect a result.
    pub transfer: Duration,
    /// Time for any other answer of a machine: prepare, start, clear, acknowledge, resume, reconcile.
    pub answer: Duration,
    /// Maximum time between two progress reports of a running job, for each machine: CMM, grinder. A manual job gives
    /// no report before its end.
    pub progress: [Duration; 2],
    /// Time without a progress report after which a person is notified. The cell extends it to three times the longest
    /// interval between reports of the running job. `None` if a machine gives no such reports.
    #[serde(default)]
    pub progress_notice: [Option<Duration>; 2],
    /// Maximum duration of a series of failures without progress, from its first failure. After this time the cell is
    /// held.
    #[serde(rename = "vain", default = "Deadlines::default_recurring_failure_time")]
    pub recurring_failure_time: Duration,
    /// Number of failures in a row, without progress, after which the cell is held.
    #[serde(rename = "vain_failures", default = "Deadlines::default_max_recurring_failures")]
    pub max_recurring_failures: u32,
    /// Time from HOLD to the safe position of each machine: CMM, grinder.
    pub hold: [Duration; 2],
    /// Time from STOP to the end of the job of each machine: CMM, grinder.
    pub stop: [Duration; 2],
    /// Time from ABORT to its confirmation. After this time the cell raises an alarm, repeats ABORT once and waits for
    /// the same time again.
    pub abort: Duration,
    /// Time for a registration or a compensation.
    pub compute: Duration,
    /// Time in the suspended state before the cell is held.
    pub suspended: Duration,
    /// Time in the held state before the run ends in order; `None` means no limit.
    pub held: Option<Duration>,
}

impl Deadlines {
    fn default_recurring_failure_time() -> Duration {
        Duration::from_secs(60)
    }

    fn default_max_recurring_failures() -> u32 {
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
            recurring_failure_time: Self::default_recurring_failure_time(),
            max_recurring_failures: Self::default_max_recurring_failures(),
            hold: [s(30); 2],
            stop: [s(60); 2],
            abort: s(2),
            compute: s(600),
            suspended: s(600),
            held: None,
        }
    }
}
