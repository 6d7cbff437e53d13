//! `regrind runs`: lists the runs and their results.

use std::path::PathBuf;

use clap::Args;
use regrind::drive::is_live;
use regrind::report::{RunResult, RunSummary, run_summary};
use serde_json::{Value, json};

use super::Outcome;
use super::control::folders;
use super::failure::Failure;

/// List the runs with their part, progress and result
#[derive(Args, Debug)]
#[command(after_help = "\
Active runs are first, then the newest. This command does not verify the records; to verify a record:
`regrind audit verify`.

Example:
  regrind runs --part SN-0042

Exit codes: 0 listed; 2 no such folder.")]
pub(super) struct Arguments {
    /// Folder of the runs
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// Only runs of parts whose serial number contains this text
    #[arg(long, value_name = "TEXT", default_value = "")]
    part: String,
    /// Print the list as JSON
    #[arg(long)]
    json: bool,
}

/// Run in the list.
struct Listed {
    folder: PathBuf,
    is_live: bool,
    summary: RunSummary,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let Arguments { runs, part, json } = arguments;
    std::fs::read_dir(runs).map_err(|source| Failure::NoRuns { path: runs.clone(), source })?;
    let listed = |folder: PathBuf| {
        let summary = run_summary(&folder).ok()?;
        Some(Listed { is_live: is_live(&folder), folder, summary })
    };
    let wanted = |run: &Listed| run.summary.part.to_lowercase().contains(&part.to_lowercase());
    let mut all: Vec<Listed> = folders(runs).filter_map(listed).filter(wanted).collect();
    all.sort_by(|a, b| (b.is_live, &b.summary.began).cmp(&(a.is_live, &a.summary.began)));
    if *json {
        super::print_json(&all.iter().map(as_json).collect::<Vec<_>>())?;
    } else if all.is_empty() {
        super::print(&format!("no run in {}\n", runs.display()))?;
    } else {
        super::print(&all.iter().map(in_words).collect::<String>())?;
    }
    Ok(Outcome::Accepted)
}

/// Returns two lines of text about a run. The first line is the run folder. The second line contains the state or the
/// result, the part, the number of cycles, and the newest measured PV and RMS in µm.
fn in_words(run: &Listed) -> String {
    let Listed { folder, is_live, summary } = run;
    let figures = summary.cycles.iter().rev().find_map(|of| of.figures);
    let measured = figures.map_or(String::new(), |[[pv, _], [rms, _]]| format!(", PV {pv:.2} µm, RMS {rms:.3} µm"));
    let cycles = summary.cycles.len();
    let counted = format!("{cycles} cycle{}", if cycles == 1 { "" } else { "s" });
    let ended = match summary.result {
        _ if *is_live => "on now",
        RunResult::Open if summary.machines_within => {
            "interrupted; cannot be resumed, because its simulated machines ended with the program"
        }
        result => word(result),
    };
    format!("{}\n    {}  {}, {counted}{measured}\n", folder.display(), ended, summary.part)
}

fn word(result: RunResult) -> &'static str {
    match result {
        RunResult::Accepted => "ACCEPTED",
        RunResult::NotAccepted => "NOT ACCEPTED",
        RunResult::Stopped => "STOPPED",
        RunResult::Aborted => "ABORTED",
        RunResult::Recovery => "machines brought home",
        RunResult::Open => "interrupted: regrind resume",
    }
}

fn as_json(run: &Listed) -> Value {
    let RunSummary {
        run: id,
        part,
        name,
        recipe,
        operator,
        began,
        ended,
        simulation,
        result,
        verdict,
        cycles,
        alarms,
        ..
    } = &run.summary;
    let cycles: Vec<Value> = cycles
        .iter()
        .map(|of| {
            let [pv, rms] = of.figures.map_or([[None; 2]; 2], |figures| figures.map(|figure| figure.map(Some)));
            json!({
                "cycle": of.cycle, "verdict": of.recorded_verdict(), "reason": of.reason,
                "pv_um": pv[0], "pv_expanded_um": pv[1], "rms_um": rms[0], "rms_expanded_um": rms[1],
            })
        })
        .collect();
    json!({
        "folder": run.folder, "run": id, "live": run.is_live, "part": part, "part_name": name, "recipe": recipe, "operator": operator,
        "began": began, "ended": ended, "simulation": simulation, "result": result.name(), "words": verdict,
        "alarms": alarms.len(), "cycles": cycles,
    })
}
