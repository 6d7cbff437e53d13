//! Figures for people: heat maps of deviations as SVG, PNG and coloured PLY, and line plots.
//!
//! ```text
//!  samples (x, y, value) -> raster -> colours --+-> PNG   one pixel a pixel, nothing else
//!                                               +-> SVG   the PNG inside axes, with a colour bar
//!  series of (x, y) --------------> ticks ------+-> SVG
//!  points with deviations --------> colours --------> PLY
//!
//!  records of a run -> Content       -> words ----------> a line for each record
//!                        +------------> RunHistory -----> the report of the run, HTML with its maps
//!                                         +-------------> its results for other systems: QIF, Q-DAS ASCII
//! ```
//!
//! A figure is a plain value until it is saved. The same figure always gives the same bytes. Frame: maps are drawn over
//! x and y of the model frame {M}, with y upwards. Units: axes in millimetres, deviations in micrometres or nanometres.

mod axis;
mod chart;
mod colour;
mod convergence;
mod convergence_curves;
mod dfq;
mod end_of_run;
mod equipment;
mod first_page;
mod fonts;
mod form;
mod heat_map;
mod interval_bar;
mod label;
mod maps;
mod pdf;
mod pixels;
mod plot;
mod ply;
mod qif;
mod raster;
mod record_lines;
mod report_content;
mod results;
mod results_file;
mod run;
mod run_history;
mod shop_header;
mod states;
mod summary;
mod svg;
mod texts;
mod words;
mod xml;

use std::path::Path;

pub use axis::Scale;
pub use chart::{Chart, ChartAxis, Dot, Layer, Mark, NumberFormat, Shape};
pub use colour::ColourMap;
pub use convergence_curves::{ConvergenceCurve, ConvergenceWords, convergence_chart};
pub use dfq::{DfqPart, dfq_of_parts};
pub use end_of_run::first_lines;
pub use heat_map::HeatMap;
pub use interval_bar::interval_bar;
pub use label::{label_language, run_label, write_run_label};
pub use pdf::{Paper, pdf_language, run_report_pdf, write_run_report_pdf};
pub use plot::{Axis, Plot, Series};
pub use ply::{coloured_ply, save_coloured_ply};
pub use record_lines::{
    RecordChoice, RecordEntry, RecordLine, RecordVerification, record_count, record_entries, record_lines,
    verify_record,
};
use regrind_formats::{FormatError, write_atomic};
pub use regrind_journal::{Stamp as RecordStamp, has_record, stamp as record_stamp};
pub use regrind_language::Language;
pub use report_content::ReportOptions;
pub use results_file::{ResultsFormat, run_results, write_run_results};
pub use run::{report_options, run_report, write_run_report};
pub use run_history::{AlarmAcknowledgement, AlarmHistory, HoldOrder};
pub use shop_header::{MAX_LOGO_BYTES, ShopField, ShopHeader, logo_uri};
pub use states::state_picture;
pub use summary::{CycleSummary, RunResult, RunSummary, run_summary};
pub use texts::verdict_in_words;
use thiserror::Error;
pub use words::{ending_words, in_air, words};

/// Reasons why a figure could not be drawn or saved. The title identifies a figure, and the name identifies one of its
/// lines. Indices count from 0.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum ReportError {
    /// Fewer points than the figure needs.
    #[error("{figure}: the figure cannot be drawn; at least {least} points are required, but the data has {found}")]
    TooFewPoints { figure: String, found: usize, least: usize },
    /// Number that is not finite, so that no figure can show it.
    #[error("{figure}: point {} has the {what} {value}; a figure shows finite numbers only", index + 1)]
    NotFinite { figure: String, index: usize, what: &'static str, value: f64 },
    /// Number at or below 0, which has no logarithm.
    #[error("{figure}: point {} has the {what} {value}; a logarithmic axis shows numbers above 0 only", index + 1)]
    NoLogarithm { figure: String, index: usize, what: &'static str, value: f64 },
    /// Points that all lie at one place.
    #[error("{figure}: all {points} points have the same x and y; a map needs points at different positions")]
    NoExtent { figure: String, points: usize },
    /// Limit of a colour bar that is not a finite number above 0.
    #[error("{figure}: the limit of the colour bar is {limit}; give a finite number above 0")]
    ColourLimit { figure: String, limit: f64 },
    /// Triangle with a corner index that refers to no point.
    #[error(
        "{figure}: a triangle uses point number {corner}, but the figure has only {points} points (the first point has number 0)"
    )]
    Corner { figure: String, corner: u32, points: usize },
    /// Failure to draw a figure or to encode its pixels as PNG.
    #[error("{figure}: the figure could not be written as a PNG picture: {reason}")]
    Picture { figure: String, reason: String },
    /// Run without results.
    #[error(
        "run {run}: no measurement of this run could be registered, so the run has no results to write; `regrind report` shows the reason"
    )]
    NothingMeasured { run: String },
    /// Recovery of machines, which makes no part and so has no label.
    #[error("run {run}: this run brought machines home and made no part, so it has no label")]
    NoPart { run: String },
    /// Label whose texts do not fit into a code.
    #[error(
        "run {run}: the label cannot be written, because its texts do not fit into a QR code: {reason}; use a shorter serial number"
    )]
    Label { run: String, reason: String },
    /// Report that cannot be laid out as PDF.
    #[error(
        "run {run}: the report cannot be written as PDF: {reason}; if this is about the logo, use a PNG in RGB; the HTML report has the same content"
    )]
    Pdf { run: String, reason: String },
    /// Program that was built without the feature `pdf`.
    #[error(
        "this program cannot write PDF; use a released program, or build it with `cargo build --features pdf`, or print the HTML report from a browser"
    )]
    NoPdf,
    /// Record of the run that cannot be read or does not pass verification.
    #[error(transparent)]
    Record(#[from] regrind_journal::JournalError),
    /// File that cannot be read or written.
    #[error(transparent)]
    File(#[from] FormatError),
}

/// Returns the present time in UTC, RFC 3339, to the second.
pub fn now() -> String {
    regrind_journal::utc_to_the_second(std::time::SystemTime::now())
}

/// Returns the present day in UTC, `2026-07-04`.
pub fn today() -> String {
    let mut now = regrind_journal::utc(std::time::SystemTime::now());
    now.truncate(10);
    now
}

/// Writes `text` to a file atomically, replacing the whole file.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn save_text(path: &Path, text: &str) -> Result<(), ReportError> {
    Ok(write_atomic(path, text.as_bytes())?)
}

/// Returns the minimum and the maximum of the values, ignoring NaN. Without values, returns infinity and minus
/// infinity.
fn range(values: impl Iterator<Item = f64>) -> [f64; 2] {
    values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| [low.min(value), high.max(value)])
}
