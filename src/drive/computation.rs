//! Computations of a cycle, and the folders of their files.

use std::path::Path;

use super::program::PROGRAM_FILE;
use crate::formats::{FormatError, ResultFolder};

/// Kind of computation for a cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Computation {
    Gate,
    Registration,
    Compensation,
    /// Registration after the last batch of an adaptive measurement, on which the cell decides.
    FinalRegistration,
}

impl Computation {
    /// Returns the kind of computation that writes a result file of this name; `None` for any other file.
    pub(super) fn from_file_name(file: &str) -> Option<Self> {
        Some(match file {
            "measured.csv" | "reference_sphere.csv" | "touches.json" => Self::Gate,
            "correction.csv" | "correction.json" | "toolpath_z.csv" => Self::Compensation,
            program if program.strip_prefix(PROGRAM_FILE).is_some_and(|end| end.starts_with('.')) => Self::Compensation,
            "registration.json"
            | "deviations.csv"
            | "deviation_uncertainty.csv"
            | "deviations.ply"
            | "figures.json"
            | "parameters.json"
            | "error_map.csv"
            | "error_map.x3p"
            | "error_map.svg"
            | "error_map.png" => Self::Registration,
            _ => return None,
        })
    }
}

/// Returns the path of the result folder of a cycle, relative to the run folder. The second and each further `attempt`
/// has a subfolder of its own, so that recorded files are never overwritten.
pub(super) fn cycle_folder(cycle: u32, attempt: u32) -> String {
    match attempt {
        0 | 1 => format!("cycle-{cycle}"),
        attempt => format!("cycle-{cycle}/attempt-{attempt}"),
    }
}

/// Returns the path of the folder for the results after batch `batch` of an adaptive measurement, relative to the run
/// folder.
pub(super) fn batch_folder(cycle: u32, batch: u32) -> String {
    format!("cycle-{cycle}/batch-{batch}")
}

/// Creates a folder for results if it does not exist.
pub(super) fn create_folder(folder: &Path) -> Result<(), FormatError> {
    ResultFolder::prepare(folder).map(ResultFolder::keep)
}
