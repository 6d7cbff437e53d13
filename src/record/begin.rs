//! Content that the program adds to the first record of a run.

use std::path::Path;

use regrind_cell::{CellPlan, Tolerance};
use regrind_formats::KnowledgeOrigin;
use regrind_journal::{Begin, JournalError, Reader, or_none};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Reads the content of the first record of the run in `folder`. All its fields are missing if there is no record, or if
/// the content is not that of a first record.
///
/// # Errors
/// The folder has no journal, or the record cannot be read.
pub fn begin_of(folder: &Path) -> Result<Begin<RunContent>, JournalError> {
    let first = Reader::open(folder)?.records(0).next().transpose()?;
    Ok(first.and_then(|record| Begin::read(&record)).unwrap_or_default())
}

/// Content that the program adds to the first record of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum RunContent {
    /// Recovery of machines. It makes no part.
    Recovery(RecoveryStart),
    /// Run of a part.
    Part(Box<PartStart>),
    /// Any other content, such as that of a test.
    Other(Value),
}

impl Default for RunContent {
    fn default() -> Self {
        Self::Other(Value::Null)
    }
}

impl From<RunContent> for Value {
    fn from(content: RunContent) -> Self {
        // Does not fail: all keys are texts, and a number that is not finite is null.
        serde_json::to_value(content).unwrap_or_default()
    }
}

impl RunContent {
    /// Returns the start of a part; `None` for a recovery and for unknown content.
    pub fn part(&self) -> Option<&PartStart> {
        match self {
            Self::Part(start) => Some(start),
            Self::Recovery(_) | Self::Other(_) => None,
        }
    }

    /// Returns the name of the part, the path of the recipe and the path of the cell file; each `None` if the record
    /// does not have it.
    pub fn names(&self) -> [Option<&str>; 3] {
        match self {
            Self::Part(start) => [&start.part_name, &start.recipe, &start.cell].map(Option::as_deref),
            Self::Recovery(start) => [None, None, start.cell.as_deref()],
            Self::Other(_) => [None; 3],
        }
    }

    /// Returns true if the run is a recovery of machines.
    pub fn is_recovery(&self) -> bool {
        matches!(self, Self::Recovery(RecoveryStart { recover: true, .. }))
    }

    /// Returns the number of the run among the runs of its folder, and the run before it. Returns `None` for a record
    /// without a number, as early versions wrote it.
    pub fn place(&self) -> Option<(u64, Option<&PreviousRun>)> {
        match self {
            Self::Recovery(start) => Some((start.number?, start.before.as_ref())),
            Self::Part(start) => Some((start.number?, start.before.as_ref())),
            Self::Other(_) => None,
        }
    }
}

/// Data with which the run of a part began. A program needs them to resume the run. A field is `None` if an earlier
/// version did not write it, or if it has another type. For `seed`, `rehearsal` and `before`, null has a meaning: a
/// content where one of them has another type is [`RunContent::Other`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PartStart {
    /// Path of the recipe, from `working_folder`.
    #[serde(default, deserialize_with = "or_none")]
    pub recipe: Option<String>,
    /// SHA-256 of the recipe, in hexadecimal digits.
    #[serde(default, deserialize_with = "or_none")]
    pub recipe_sha256: Option<String>,
    /// Path of the cell file, from `working_folder`.
    #[serde(default, deserialize_with = "or_none")]
    pub cell: Option<String>,
    /// SHA-256 of the cell file, in hexadecimal digits.
    #[serde(default, deserialize_with = "or_none")]
    pub cell_sha256: Option<String>,
    /// Working folder of the program that began the run.
    #[serde(default, deserialize_with = "or_none")]
    pub working_folder: Option<String>,
    /// SHA-256 of the nominal surface, in hexadecimal digits.
    #[serde(default, deserialize_with = "or_none")]
    pub nominal_sha256: Option<String>,
    /// Identity of the settings that two runs share if one can learn from the other.
    #[serde(default, deserialize_with = "or_none")]
    pub setting: Option<String>,
    /// Name of the part.
    #[serde(default, deserialize_with = "or_none")]
    pub part_name: Option<String>,
    /// Number of the drawing of the part.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drawing: Option<String>,
    /// Material of the part.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub material: Option<String>,
    /// Name of the part in files and prompts.
    #[serde(default, deserialize_with = "or_none")]
    pub part_in_files: Option<String>,
    /// Number of the run, which the machines get with each job.
    #[serde(default, deserialize_with = "or_none")]
    pub job: Option<u32>,
    /// Seed of another simulated part; `None` for the part of the recipe.
    #[serde(default)]
    pub seed: Option<u64>,
    /// Measuring strategy; `None` if the machine measures by its own program.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "or_none")]
    pub measuring: Option<MeasuringStrategy>,
    /// Parameters by which the cell decides.
    #[serde(default)]
    pub plan: RecordedPlan,
    /// Version of the transition table of the cell.
    #[serde(default, deserialize_with = "or_none")]
    pub table_version: Option<u32>,
    /// True if the program itself simulated its machines.
    #[serde(default, deserialize_with = "or_none")]
    pub machines_within: Option<bool>,
    /// True if the run was a rehearsal without a part.
    #[serde(default)]
    pub rehearsal: Option<bool>,
    /// Run from which the first correction was learned.
    #[serde(default, deserialize_with = "or_none")]
    pub learned_from: Option<String>,
    /// Cells from which the first correction was learned, if it is not from a run of this cell.
    #[serde(default, deserialize_with = "or_none")]
    pub taught_by: Option<KnowledgeOrigin>,
    /// Reasons why earlier runs or the plant gave no knowledge.
    #[serde(default, deserialize_with = "or_none")]
    pub left_alone: Option<Vec<String>>,
    /// Number of the run among the runs of its folder, from 1.
    #[serde(default, deserialize_with = "or_none")]
    pub number: Option<u64>,
    /// Run before it, as its anchor was when this run began.
    #[serde(default)]
    pub before: Option<PreviousRun>,
}

/// Measuring strategy of a run, for its report.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeasuringStrategy {
    /// Number of targets on the part.
    pub targets: usize,
    /// True if targets are chosen while others are touched, until enough is known.
    pub adaptive: bool,
    /// Number of points on the reference sphere; 0 if there is none.
    pub sphere_points: usize,
    /// Speed towards a target, in mm/s.
    pub speed_mm_s: f64,
    /// Distance from a target at which the probe begins to search, in mm.
    pub approach_mm: f64,
}

/// Start of a recovery of machines.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RecoveryStart {
    /// True.
    pub recover: bool,
    /// Path of the cell file.
    #[serde(default, deserialize_with = "or_none")]
    pub cell: Option<String>,
    /// Number of the run among the runs of its folder, from 1.
    #[serde(default, deserialize_with = "or_none")]
    pub number: Option<u64>,
    /// Run before it, as its anchor was when this run began.
    #[serde(default)]
    pub before: Option<PreviousRun>,
}

/// State of a run at the time when the next run of the folder began.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PreviousRun {
    /// Name of the run.
    pub run: String,
    /// Number of its records.
    pub records: u64,
    /// Hash of the last of these records.
    pub head: String,
}

/// Plan of a cell as it is on record. Two plans are compared as JSON: a plan of an earlier version that lacks a key is
/// not the same plan.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct RecordedPlan(Value);

impl RecordedPlan {
    /// Converts `plan` to the form in which it is recorded.
    pub fn new(plan: &CellPlan) -> Self {
        Self(serde_json::to_value(plan).unwrap_or_default())
    }

    /// Returns the limits of the part; `None` if they are not on record.
    pub fn tolerance(&self) -> Option<Tolerance> {
        serde_json::from_value(self.0.get("tolerance")?.clone()).ok()
    }

    /// Returns the plan; `None` if it is not on record, or if it is that of a version with other parameters.
    pub fn cell_plan(&self) -> Option<CellPlan> {
        serde_json::from_value(self.0.clone()).ok()
    }

    /// Returns true if no plan is on record.
    pub fn is_missing(&self) -> bool {
        self.0.is_null()
    }
}
