//! Report of a run as PDF/A-2b, which can be filed for years: fonts and pictures are in the file.
//!
//! ```text
//!  report as HTML -> markup of Typst -> pages (Typst, with report.typ) -> PDF/A-2b
//! ```
//!
//! The same record always gives the same bytes, if the fonts of this program have all its characters. Other characters,
//! such as Chinese, come from the fonts of the computer. A program without the feature `pdf` refuses to write a PDF.

#[cfg(feature = "pdf")]
mod fonts;
#[cfg(feature = "pdf")]
mod layout;
#[cfg(feature = "pdf")]
mod markup;
mod paper;

use std::path::{Path, PathBuf};

#[cfg(feature = "pdf")]
use self::layout::pdf;
pub use self::paper::Paper;
use super::ReportError;
use super::report_content::ReportOptions;
use super::run::{html, with_report};
use regrind_formats::run_files::RunFile;
use regrind_formats::write_atomic;
use regrind_language::Language;

/// Verifies the record in the run folder `folder`, writes the report of the run as PDF to `path`, or to
/// `report.pdf` in this folder, and returns the path.
///
/// # Errors
/// As [`run_report_pdf`], and if the file cannot be written.
pub fn write_run_report_pdf(
    folder: &Path,
    options: &ReportOptions,
    paper: Paper,
    path: Option<&Path>,
) -> Result<PathBuf, ReportError> {
    let path = path.map_or_else(|| folder.join(RunFile::PdfReport.name()), Path::to_owned);
    write_atomic(&path, &run_report_pdf(folder, options, paper)?)?;
    Ok(path)
}

/// Verifies the record in the run folder `folder` and returns the report of the run as PDF/A-2b. Its content is that of
/// [`run_report`](crate::run_report).
///
/// # Errors
/// Fails if the record is missing or does not pass verification, if a file on record cannot be read, if no font on this
/// computer has a character of the report, or if this program was built without the feature `pdf`.
pub fn run_report_pdf(folder: &Path, options: &ReportOptions, paper: Paper) -> Result<Vec<u8>, ReportError> {
    with_report(folder, options, |report| pdf(report, &html(report, folder)?, paper))
}

/// Returns the language that a PDF states, from the bytes of its file; the default one if it states none.
pub fn pdf_language(pdf: &[u8]) -> Language {
    const MARK: &[u8] = b"/Lang";
    let at = pdf.windows(MARK.len()).position(|bytes| bytes == MARK).map(|at| at + MARK.len());
    let tag = at.and_then(|at| pdf.get(at..at + 16)).map(|bytes| String::from_utf8_lossy(bytes).into_owned());
    let tag = tag.as_deref().and_then(|text| text.split(['(', ')']).nth(1));
    tag.and_then(Language::first_of).unwrap_or_default()
}

#[cfg(not(feature = "pdf"))]
fn pdf(_: &super::report_content::Report, _: &str, _: Paper) -> Result<Vec<u8>, ReportError> {
    Err(ReportError::NoPdf)
}
