//! Errors of writing, reading and correcting programs.

use std::path::PathBuf;

use thiserror::Error;

use super::dialect::DialectError;
use crate::FormatError;

/// Reason why a program could not be written, read or corrected. Lines count from 1.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum GcodeError {
    #[error(transparent)]
    File(#[from] FormatError),
    #[error(
        "{axis} of move {number} is {value_mm} mm, which is not a finite number; do not use this path; report the fault with the input files"
    )]
    NotFinite { axis: char, value_mm: f64, number: u64 },
    #[error(transparent)]
    Dialect(#[from] DialectError),
    #[error(
        "{axis} of move {number} is {value_mm} mm; the dialect allows at most {max_mm} mm (numbers.max_mm); \
         move the work offset"
    )]
    Large { axis: char, value_mm: f64, number: u64, max_mm: f64 },
    #[error(
        "the feed of {feed_mm_min} mm/min of move {number} is 0 with {decimals} decimals (numbers.feed_decimals); \
         raise grinding.feed_mm_min"
    )]
    Slow { feed_mm_min: f64, decimals: u8, number: u64 },
    #[error("the path has {found} moves instead of the expected {expected}; report the fault with the input files")]
    Count { found: u64, expected: u64 },
    #[error("{path}, line {line}: {what}; {remedy}")]
    Line { path: PathBuf, line: u64, what: String, remedy: &'static str },
    #[error("{path}: {what}; {remedy}")]
    Program { path: PathBuf, what: String, remedy: &'static str },
}

impl GcodeError {
    /// Converts the move number of this error. The number was counted from the start of its track. `moves` is the
    /// number of moves in the program before this track. The returned error has the number counted from the start of
    /// the program.
    pub(super) fn after(self, moves: u64) -> Self {
        match self {
            Self::NotFinite { axis, value_mm, number } => Self::NotFinite { axis, value_mm, number: number + moves },
            Self::Large { axis, value_mm, number, max_mm } => {
                Self::Large { axis, value_mm, number: number + moves, max_mm }
            }
            Self::Slow { feed_mm_min, decimals, number } => {
                Self::Slow { feed_mm_min, decimals, number: number + moves }
            }
            error => error,
        }
    }
}
