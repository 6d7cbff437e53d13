//! `regrind report`: one HTML file that tells a run.

use std::path::PathBuf;

use clap::Args;
use regrind::report::write_run_report;

use super::Outcome;
use super::control::folder_of;
use super::failure::Failure;

/// Write the report of a run: one HTML file that opens without a network
#[derive(Args, Debug)]
#[command(after_help = "\
RUN is the folder of a run; without it, the newest under runs/. The record is proven first; the report is RUN/report.html.

Example:
  regrind report runs/freeform-mirror-20260704T120000Z

Exit codes: 0 written; 1 the record is broken; 2 no such run, no record in it, or the folder cannot be written.")]
pub(super) struct Arguments {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    run: Option<PathBuf>,
    /// Print JSON instead of words
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let path = write_run_report(&folder_of(arguments.run.as_deref())?).map_err(Failure::Report)?;
    if arguments.json {
        super::print_json(&serde_json::json!({ "report": path }))?;
    } else {
        super::print(&format!("{}\n", path.display()))?;
    }
    Ok(Outcome::Accepted)
}
