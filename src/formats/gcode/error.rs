//! Why a program could not be written, read or corrected.

use std::path::PathBuf;

use thiserror::Error;

use crate::FormatError;

/// Why a program could not be written, read or corrected. Lines count from 1.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum GcodeError {
    #[error(transparent)]
    File(#[from] FormatError),
    #[error(
        "{axis} of move {number} is {value_mm} mm; the path must not be used: please report it with the files that led to it"
    )]
    NotFinite { axis: char, value_mm: f64, number: u64 },
    #[error("{found} moves came where {expected} were announced; please report it with the files that led to it")]
    Count { found: u64, expected: u64 },
    #[error("{path}, line {line}: {what}; {remedy}")]
    Line { path: PathBuf, line: u64, what: String, remedy: &'static str },
    #[error("{path}: {what}; {remedy}")]
    Program { path: PathBuf, what: String, remedy: &'static str },
}

impl GcodeError {
    /// Counts the moves that came before those whose error this is.
    pub(super) fn after(self, moves: u64) -> Self {
        match self {
            Self::NotFinite { axis, value_mm, number } => Self::NotFinite { axis, value_mm, number: number + moves },
            error => error,
        }
    }
}
