//! Reasons why a recipe and a cell cannot make a run.

use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::compensation::path::PathError;
use crate::device::DriverError;
use crate::formats::gcode::DialectError;
use crate::formats::{ChoiceError, FormatError};
use crate::measuring::PatternError;
use crate::surface::{DefinitionError, SurfaceError};

/// Reason why a recipe and a cell cannot make a run.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum SetupError {
    #[error(transparent)]
    File(#[from] FormatError),
    #[error("{path}: {source}")]
    Nominal { path: PathBuf, source: SurfaceError },
    #[error("{path}: {source}")]
    Choice { path: PathBuf, source: ChoiceError },
    #[error("{path}: {source}")]
    Definition { path: PathBuf, source: DefinitionError },
    #[error("{}: {key}: {what}; correct the value of this key", .path.display())]
    Table { path: PathBuf, key: &'static str, what: String },
    #[error("{path}: {source}")]
    Pattern { path: PathBuf, source: PatternError },
    #[error(
        "{}: {key} is {found}, but the cell file {} allows {allowed} (limit in that file: {limit}); change the recipe or use another cell",
        .recipe.display(), .cell.display()
    )]
    Limit { recipe: Box<Path>, cell: Box<Path>, key: &'static str, found: f64, allowed: Box<str>, limit: &'static str },
    #[error(
        "{recipe}: measure.qualify requires the reference sphere, and {cell} has none; add [cmm.reference_sphere] to \
         the cell file, or write qualify = false"
    )]
    NoSphere { recipe: PathBuf, cell: PathBuf },
    #[error(
        "{}: the gap between the reference sphere at {at} mm and the part of {} in its fixture is {gap_mm:.1} mm; \
         the probe requires {needed_mm:.1} mm; correct [cmm.reference_sphere] or [cmm.fixture]",
        .cell.display(), .recipe.display()
    )]
    SphereInPart { recipe: Box<Path>, cell: Box<Path>, at: Box<str>, gap_mm: f64, needed_mm: f64 },
    #[error(
        "{}: target {number} of the measuring pattern lies at {at} mm in the CMM frame, outside the travel of {} ({allowed}); move \
         [cmm.fixture], or measure less of the part",
        .recipe.display(), .cell.display()
    )]
    Travel { recipe: Box<Path>, cell: Box<Path>, number: usize, at: Box<str>, allowed: Box<str> },
    #[error(
        "{recipe}: the measuring pattern is `free`, and the wire of the CMM in {cell} requires a plan; choose grid, \
         spiral or file"
    )]
    NeedsPlan { recipe: PathBuf, cell: PathBuf },
    #[error(
        "{}: {key} requires the temperature of each measurement, and the wire of the CMM in {} reports none; remove \
         the key, or use another wire", .recipe.display(), .cell.display()
    )]
    NoTemperature { recipe: Box<Path>, cell: Box<Path>, key: &'static str },
    #[error(
        "{recipe}: grinding.track_mm is missing, and the scallops between the tracks cannot determine it, because \
         there is no path over this part: {source}; add grinding.track_mm"
    )]
    Tracks { recipe: PathBuf, source: PathError },
    #[error("{}: {source} (cell file {})", .recipe.display(), .cell.display())]
    Dialect { recipe: PathBuf, cell: PathBuf, source: DialectError },
    #[error("{cell}: {source}")]
    Machine { cell: PathBuf, source: DriverError },
}
