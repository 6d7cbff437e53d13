//! Computations of a cycle, and their files.

use std::path::Path;

use crate::formats::run_files::{CycleFile, is_tool_path_file};
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
    pub(super) fn from_file_name(name: &str) -> Option<Self> {
        if is_tool_path_file(name) {
            return Some(Self::Compensation);
        }
        Some(match CycleFile::from_name(name)? {
            CycleFile::Measured
            | CycleFile::Conditions
            | CycleFile::ReferenceSphere
            | CycleFile::Touches
            | CycleFile::RepeatedTouches => Self::Gate,
            CycleFile::Registration
            | CycleFile::Deviations
            | CycleFile::DeviationUncertainty
            | CycleFile::ColouredDeviations
            | CycleFile::Model
            | CycleFile::Form
            | CycleFile::Figures
            | CycleFile::Parameters
            | CycleFile::ErrorMap
            | CycleFile::ErrorMapX3p
            | CycleFile::ErrorMapSvg
            | CycleFile::ErrorMapPng => Self::Registration,
            CycleFile::Correction | CycleFile::AxisTable => Self::Compensation,
            CycleFile::Judgement => return None,
        })
    }
}

/// Creates a folder for results if it does not exist.
pub(super) fn create_folder(folder: &Path) -> Result<(), FormatError> {
    ResultFolder::prepare(folder).map(ResultFolder::keep)
}
