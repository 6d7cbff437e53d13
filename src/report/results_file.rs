//! File of the results of a run, in the formats of other programs.

use std::path::{Path, PathBuf};

use regrind_formats::run_files::RunFile;
use regrind_formats::write_atomic;

use super::results::Results;
use super::run_history::RunHistory;
use super::{ReportError, dfq, qif};

/// File formats of the results of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResultsFormat {
    /// QIF 3.0 results (ANSI/DMSC), XML.
    Qif,
    /// Q-DAS ASCII transfer format, description and values in one file.
    Dfq,
}

/// Verifies the record in the run folder `folder`, writes the results of the run in `format`, and returns the path of
/// the written file. With `path` = `None` the file is `results.qif` or `results.dfq` in the run folder.
///
/// # Errors
/// Fails if the record is missing, does not pass verification or contains no measurement, or if the file cannot be
/// written.
pub fn write_run_results(folder: &Path, format: ResultsFormat, path: Option<&Path>) -> Result<PathBuf, ReportError> {
    let usual = match format {
        ResultsFormat::Qif => RunFile::QifResults,
        ResultsFormat::Dfq => RunFile::DfqResults,
    };
    let path = path.map_or_else(|| folder.join(usual.name()), Path::to_path_buf);
    write_atomic(&path, run_results(folder, format)?.as_bytes())?;
    Ok(path)
}

/// Verifies the record in the run folder `folder` and returns the results of the run as text in `format`. The same
/// record always gives the same text, byte for byte.
///
/// # Errors
/// Fails if the record is missing or does not pass verification, if a file `figures.json` of a cycle cannot be read, or
/// if no measurement of the run has figures.
pub fn run_results(folder: &Path, format: ResultsFormat) -> Result<String, ReportError> {
    let (story, verified) = RunHistory::read_verified(folder)?;
    let results = Results::from_history(&story, verified.head.to_string()).with_areas(&story, folder)?;
    if results.measured.iter().all(|of| of.figures.is_empty()) {
        return Err(ReportError::NothingMeasured { run: results.run });
    }
    Ok(match format {
        ResultsFormat::Qif => qif::text(&results),
        ResultsFormat::Dfq => dfq::text(&results),
    })
}
