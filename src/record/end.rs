//! Result of a run in its last record.

use regrind_cell::{CycleRow, Ending};
use regrind_journal::or_none;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::Value;

/// Result of a run in its last record.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum RunEnd {
    /// End of the run of a part.
    Part(PartEnd),
    /// End of a recovery of machines.
    Recovery(RecoveryEnd),
    /// End of the run of a part, without the figures of its cycles.
    Bare(Ending),
    /// Any other content, such as that of a test.
    Other(Value),
}

impl Default for RunEnd {
    fn default() -> Self {
        Self::Other(Value::Null)
    }
}

impl From<RunEnd> for Value {
    fn from(content: RunEnd) -> Self {
        // Does not fail: all keys are texts, and a number that is not finite is null.
        serde_json::to_value(content).unwrap_or_default()
    }
}

/// Ending of the run of a part, with the figures of its cycles. It is also the content of `result.json` in the run
/// folder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PartEnd {
    /// True if any machine of the cell is simulated.
    #[serde(default)]
    pub simulation: bool,
    /// Ending.
    pub ending: Ending,
    /// Figures of the cycles. A row that cannot be read is omitted.
    #[serde(default, deserialize_with = "readable_rows")]
    pub cycles: Vec<CycleRow>,
    /// Number of touches of an adaptive measurement; `None` for any other.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "or_none")]
    pub touches: Option<TouchCounts>,
}

/// Number of touches of a run with adaptive measurement.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TouchCounts {
    /// Touches that were taken.
    pub taken: usize,
    /// Touches that whole patterns would need.
    pub whole_patterns: usize,
}

/// Result of a recovery: for each machine, true if it is idle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecoveryEnd {
    /// State of the CMM.
    pub cmm_home: bool,
    /// State of the grinder.
    pub grinder_home: bool,
}

fn readable_rows<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<CycleRow>, D::Error> {
    let rows = Value::deserialize(deserializer)?;
    Ok(rows.as_array().into_iter().flatten().filter_map(|row| CycleRow::deserialize(row).ok()).collect())
}
