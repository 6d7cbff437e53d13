//! Metrics for Prometheus: the cell, its machines, its figures, its history and the page. A figure that is not known has no
//! sample. Lengths are in metres and durations in seconds, as Prometheus wants them.

use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use axum::response::Response;
use regrind_cell::{AlarmId, StateName};
use regrind_control::{MachineStatus, Request, Snapshot, send_request};
use regrind_report::{CycleSummary, RunResult, record_stamp};
use tokio::sync::Semaphore;

use super::content::Outcome;
use super::endpoint::{Call, blocking, response};
use super::exposition::{Metrics, OPEN_METRICS, PROMETHEUS};
use super::runs::{listed, observed};
use crate::history::Listed;
use crate::live::ObservedRun;
use crate::problem::Problem;
use crate::shared::{MAX_STREAMS, Shared};

/// Media types of the metrics.
pub(super) const MEDIA: [&str; 2] = [PROMETHEUS, OPEN_METRICS];

/// Answers with the metrics.
pub(super) async fn metrics(call: Call) -> Result<Response, Problem> {
    let page = &call.page;
    let (mut runs, unreadable) = listed(page).await?;
    runs.sort_by(|a, b| (&b.summary.began, &b.id).cmp(&(&a.summary.began, &a.id)));
    let mut metrics = Metrics::default();
    let version = env!("CARGO_PKG_VERSION").to_owned();
    metrics.gauges(
        "regrind_build_info",
        "Version of the program that serves the page.",
        [(vec![("version", version)], 1.0)],
    );
    let active: Vec<&Listed> = runs.iter().filter(|run| run.is_live).collect();
    metrics.gauge("regrind_runs_active", "Runs that a program drives now.", Some(active.len() as f64));
    metrics.gauge("regrind_runs_unreadable", "Runs whose record cannot be read.", Some(unreadable.len() as f64));
    // Several active runs belong to several cells, of which no figure is that of the cell.
    let shown = active
        .iter()
        .find(|run| page.first_run.as_ref() == Some(&run.id))
        .or(active.first().filter(|_| active.len() == 1));
    match shown {
        Some(run) => add_run(&mut metrics, page, run).await?,
        None if active.is_empty() => add_rest(&mut metrics, page, runs.first()).await?,
        None => {}
    }
    add_history(&mut metrics, &runs);
    add_page(&mut metrics, page);
    Ok(response(call.media, "no-store", metrics.text(call.media == OPEN_METRICS).into_bytes()))
}

/// Adds the state of an active run, its machines and its figures.
async fn add_run(metrics: &mut Metrics, page: &Shared, run: &Listed) -> Result<(), Problem> {
    let folder = page.history.home().join(&run.id);
    let seen = observed(page, &folder, &run.summary, true).await;
    let live = seen.snapshot.as_deref().filter(|_| seen.answers);
    let age_s = seen.snapshot_at.map(|at| at.elapsed().as_secs_f64());
    metrics.gauge("regrind_cell_answers", "1 if the program of the active run answers.", Some(truth(live.is_some())));
    add_state(metrics, live.map(|live| live.state));
    add_names(metrics, run);
    let age_s = match age_s {
        Some(age_s) => Some(age_s),
        None => record_age_s(&folder).await?,
    };
    add_status_age(metrics, age_s);
    if let Some(live) = live {
        add_progress(metrics, live);
    }
    add_figures(metrics, &seen);
    if live.is_none() {
        return Ok(());
    }
    let machines = move || Ok(send_request(&folder, &Request::Machines).ok().and_then(|reply| reply.machines));
    if let Some(machines) = blocking(machines).await? {
        add_machines(metrics, &machines);
    }
    Ok(())
}

/// Adds the state of a cell without an active run. `last` is its last run.
async fn add_rest(metrics: &mut Metrics, page: &Shared, last: Option<&Listed>) -> Result<(), Problem> {
    // The state of a run without an end, whose program is gone, is not known.
    let is_idle = last.is_none_or(|last| last.summary.result != RunResult::Open);
    add_state(metrics, is_idle.then_some(StateName::Idle));
    if let Some(last) = last {
        add_names(metrics, last);
        add_status_age(metrics, record_age_s(&page.history.home().join(&last.id)).await?);
        let summary = Arc::clone(&last.summary);
        add_figures(metrics, &ObservedRun { summary, ..ObservedRun::default() });
    }
    Ok(())
}

/// Returns the time since the record in the run folder `folder` last changed, in seconds.
async fn record_age_s(folder: &Path) -> Result<Option<f64>, Problem> {
    let folder = folder.to_owned();
    blocking(move || {
        let age = |at| SystemTime::now().duration_since(at).unwrap_or_default().as_secs_f64();
        Ok(record_stamp(&folder).changed_at().map(age))
    })
    .await
}

fn truth(is: bool) -> f64 {
    f64::from(u8::from(is))
}

fn add_status_age(metrics: &mut Metrics, age_s: Option<f64>) {
    metrics.gauge(
        "regrind_status_age_seconds",
        "Time since the last status of the active run; without one, since the last change of the last record.",
        age_s,
    );
}

/// Adds a sample for each state. All are 0 if the state is not known.
fn add_state(metrics: &mut Metrics, state: Option<StateName>) {
    metrics.gauges(
        "regrind_cell_state",
        "1 for the present state of the cell by its PackML name; all are 0 if it is not known.",
        StateName::ALL.map(|each| (vec![("state", each.to_string())], truth(state == Some(each)))),
    );
}

fn add_names(metrics: &mut Metrics, run: &Listed) {
    let summary = &run.summary;
    let labels = [("run", &run.id), ("part", &summary.part), ("name", &summary.name), ("recipe", &summary.recipe)];
    let labels = labels.map(|(label, value)| (label, value.clone())).to_vec();
    metrics.gauges("regrind_run_info", "Names of the active run, or of the last run.", [(labels, 1.0)]);
    metrics.gauge("regrind_simulation", "1 if any machine of this run is simulated.", Some(truth(summary.simulation)));
}

fn add_progress(metrics: &mut Metrics, live: &Snapshot) {
    metrics.gauge(
        "regrind_cycle",
        "Number of the cycle of the active run; 0 before the first.",
        Some(f64::from(live.cycle)),
    );
    metrics.gauge("regrind_max_cycles", "Maximum number of the cycle.", Some(f64::from(live.max_cycles)));
    metrics.gauge("regrind_run_elapsed_seconds", "Time since the active run began.", Some(live.elapsed_s));
    let progress = live.progress.filter(|progress| progress.total > 0);
    let ratio = progress.map(|progress| {
        (vec![("machine", progress.device.name().to_owned())], f64::from(progress.done) / f64::from(progress.total))
    });
    metrics.gauges("regrind_job_progress_ratio", "Completed share of the current job of a machine.", ratio);
    metrics.gauge(
        "regrind_job_remaining_max_seconds",
        "Maximum remaining time of the current job.",
        progress.and_then(|progress| progress.remaining_s).map(|[_, most_s]| most_s),
    );
    let is_active = |id: AlarmId| live.alarms.iter().any(|alarm| alarm.id == id);
    metrics.gauges(
        "regrind_alarm_active",
        "1 if the alarm is active, by its code.",
        AlarmId::ALL.iter().map(|id| (vec![("code", code(*id))], truth(is_active(*id)))),
    );
}

/// Returns the name of an alarm in JSON.
fn code(id: AlarmId) -> String {
    match serde_json::to_value(id) {
        Ok(serde_json::Value::String(name)) => name,
        // The kinds of alarm have no fields, so each is a text.
        _ => format!("{id:?}"),
    }
}

/// Adds the figures of the last measurement of a run, with their limits and the durations of the last jobs.
fn add_figures(metrics: &mut Metrics, seen: &ObservedRun) {
    let cycles = &seen.summary.cycles;
    let last = |value: fn(&CycleSummary) -> Option<f64>| cycles.iter().rev().find_map(value);
    metrics.gauge(
        "regrind_pass_last_duration_seconds",
        "Duration of the last pass of the run.",
        last(CycleSummary::pass_s),
    );
    metrics.gauge(
        "regrind_measurement_last_duration_seconds",
        "Duration of the last measurement of the run.",
        last(CycleSummary::measurement_s),
    );
    let Some((of, [pv, rms])) = cycles.iter().rev().find_map(|of| Some((of, of.judged?))) else { return };
    metrics.gauge("regrind_form_cycle", "Number of the cycle that was measured last.", Some(f64::from(of.cycle)));
    for (names, figure) in [(PV, pv), (RMS, rms)] {
        let [low_mm, high_mm] = figure.interval_mm;
        for ((name, help), mm) in names.into_iter().zip([figure.median_mm, low_mm, high_mm, figure.limit_mm]) {
            metrics.gauge(name, help, Some(1e-3 * mm));
        }
    }
}

/// Names and helps of a figure, of the two ends of its interval, and of its limit.
type FigureNames = [(&'static str, &'static str); 4];

const PV: FigureNames = [
    ("regrind_form_pv_meters", "Peak to valley of the last measurement, as it is judged."),
    ("regrind_form_pv_low_meters", "Lower end of the 95 % interval of the peak to valley."),
    ("regrind_form_pv_high_meters", "Upper end of the 95 % interval of the peak to valley."),
    ("regrind_form_pv_limit_meters", "Largest accepted peak to valley."),
];
const RMS: FigureNames = [
    ("regrind_form_rms_meters", "Root mean square of the last measurement, as it is judged."),
    ("regrind_form_rms_low_meters", "Lower end of the 95 % interval of the root mean square."),
    ("regrind_form_rms_high_meters", "Upper end of the 95 % interval of the root mean square."),
    ("regrind_form_rms_limit_meters", "Largest accepted root mean square."),
];

fn add_machines(metrics: &mut Metrics, machines: &[MachineStatus; 2]) {
    let label = |of: &MachineStatus| vec![("machine", of.device.name().to_owned())];
    let connected = machines.iter().map(|of| (label(of), truth(of.is_connected)));
    metrics.gauges("regrind_machine_connected", "1 if the last request to the machine was answered.", connected);
    let ages = machines.iter().filter_map(|of| Some((label(of), of.answer_age_s?)));
    metrics.gauges("regrind_machine_answer_age_seconds", "Time since the last answer of the machine.", ages);
    let lost = machines.iter().map(|of| (label(of), f64::from(of.lost_links)));
    metrics.counters("regrind_machine_lost_links", "Losses of the link to the machine in the active run.", lost);
}

/// Adds the parts by their results, and the durations of all passes and measurements.
fn add_history(metrics: &mut Metrics, runs: &[Listed]) {
    let count =
        |outcome: Outcome| runs.iter().filter(|run| Outcome::from(run.summary.result) == outcome).count() as f64;
    let made = [Outcome::Accepted, Outcome::NotAccepted, Outcome::Stopped, Outcome::Aborted];
    metrics.counters(
        "regrind_parts",
        "Runs that have ended, by the result of their part.",
        made.map(|outcome| (vec![("result", outcome.name().to_owned())], count(outcome))),
    );
    metrics.counters(
        "regrind_recoveries",
        "Runs that brought machines home.",
        [(Vec::new(), count(Outcome::Recovery))],
    );
    let lost = runs.iter().filter(|run| !run.is_live && run.summary.result == RunResult::Open).count();
    metrics.gauge(
        "regrind_runs_interrupted",
        "Runs without an end on record that no program drives.",
        Some(lost as f64),
    );
    let all = |value: fn(&CycleSummary) -> Option<f64>| -> Vec<f64> {
        runs.iter().flat_map(|run| &run.summary.cycles).filter_map(value).collect()
    };
    metrics.summary("regrind_pass_duration_seconds", "Durations of all passes on record.", &all(CycleSummary::pass_s));
    metrics.summary(
        "regrind_measurement_duration_seconds",
        "Durations of all measurements on record, for each cycle.",
        &all(CycleSummary::measurement_s),
    );
}

/// Adds the load of the page.
fn add_page(metrics: &mut Metrics, page: &Shared) {
    let [known, strangers] = page.guard.connections.counts();
    let connections = [("authorised", known), ("unauthorised", strangers)];
    metrics.gauges(
        "regrind_page_connections",
        "Open connections of the page, by whether their client has access.",
        connections.map(|(access, count)| (vec![("access", access.to_owned())], count as f64)),
    );
    let streams = MAX_STREAMS - Semaphore::available_permits(&page.streams);
    metrics.gauge(
        "regrind_page_streams",
        "Open streams of events of the interface for programs.",
        Some(streams as f64),
    );
    let refusals = page.guard.refusal_count() as f64;
    metrics.counters(
        "regrind_page_refusals",
        "Requests that the page has refused since it began.",
        [(Vec::new(), refusals)],
    );
}
