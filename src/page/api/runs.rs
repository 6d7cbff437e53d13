//! The cell, its runs, their figures and their records as JSON.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use axum::response::Response;
use regrind_cell::StateName;
use regrind_control::is_live;
use regrind_report::{RecordChoice, RunResult, RunSummary, record_count, record_entries};

use super::content::{
    CellNow, CycleFigures, EventsPage, Outcome, RecordedEvent, RunDetail, RunFigures, RunItem, RunState, RunsPage,
};
use super::endpoint::{Call, blocking, json, unreadable_record};
use crate::history::Listed;
use crate::live::ObservedRun;
use crate::problem::Problem;
use crate::shared::Shared;

/// Maximum time to wait for the first message of a run under way.
const FIRST_MESSAGE: Duration = Duration::from_secs(2);
/// Time in the cursor of a run whose start is not on record.
const NO_TIME: &str = "0000-00-00T00:00:00Z";
/// Maximum size of the contents of a page of records, in bytes. The last record of a page can exceed it.
pub(super) const MAX_PAGE_BYTES: usize = 1 << 20;

/// Choices of records, by their words in the address.
pub(super) const CHOICES: [&str; 3] = ["all", "events", "people"];

/// Answers with the state of the cell.
pub(super) async fn cell(call: Call) -> Result<Response, Problem> {
    json(&cell_now(&call.page).await?)
}

/// Returns the state of the cell.
pub(super) async fn cell_now(page: &Shared) -> Result<CellNow, Problem> {
    let (mut listed, _) = listed(page).await?;
    listed.sort_by(|a, b| position(b).cmp(&position(a)));
    let active: Vec<&Listed> = listed.iter().filter(|run| run.is_live).collect();
    let first = active.iter().find(|run| page.first_run.as_ref() == Some(&run.id));
    let shown = first.or(active.first().filter(|_| active.len() == 1));
    let run = match shown {
        Some(run) => Some(state_of(page, run).await),
        None => None,
    };
    let last = listed.first();
    let state = match &run {
        Some(run) => run.state(),
        None if !active.is_empty() => None,
        None => last.is_none_or(|last| last.summary.result != RunResult::Open).then_some(StateName::Idle),
    };
    let active_runs = active.iter().map(|run| run.id.clone()).collect();
    Ok(CellNow { state, active_runs, run, last_run: last.map(RunItem::from) })
}

async fn state_of(page: &Shared, run: &Listed) -> RunState {
    let seen = observed(page, &page.history.home().join(&run.id), &run.summary, run.is_live).await;
    RunState::new(&run.id, &seen)
}

/// Returns all runs in no order, and the names of those whose record cannot be read.
pub(super) async fn listed(page: &Shared) -> Result<(Vec<Listed>, Vec<String>), Problem> {
    let history = Arc::clone(&page.history);
    blocking(move || Ok(history.all())).await
}

/// Returns the current knowledge about the run in `folder`, whose record has the summary `summary`. Waits for the first
/// message of its program if a program drives it.
pub(super) async fn observed(page: &Shared, folder: &Path, summary: &Arc<RunSummary>, is_live: bool) -> ObservedRun {
    let of_record = || ObservedRun { summary: Arc::clone(summary), ..ObservedRun::default() };
    if !is_live {
        return of_record();
    }
    let mut run = page.run_watcher.subscribe(folder);
    let is_new = run.borrow().snapshot.is_none();
    if is_new {
        // Without a message in time, the record is what is known.
        drop(tokio::time::timeout(FIRST_MESSAGE, run.changed()).await);
    }
    let seen = run.borrow().clone();
    if seen.summary.last.is_empty() { ObservedRun { summary: Arc::clone(summary), ..seen } } else { seen }
}

/// Returns the position of a run in the list: the time at which it began, and its name.
fn position(run: &Listed) -> (&str, &str) {
    let began = run.summary.began.as_str();
    (if began.is_empty() { NO_TIME } else { began }, &run.id)
}

/// Answers with a page of the list of runs.
pub(super) async fn runs(call: Call) -> Result<Response, Problem> {
    let (mut listed, unreadable) = listed(&call.page).await?;
    let arguments = &call.arguments;
    let after = arguments.text("cursor").and_then(|cursor| cursor.split_once('~'));
    let (part, result) = (arguments.text("part"), arguments.text("result"));
    listed.retain(|run| {
        part.is_none_or(|part| run.summary.part == part)
            && result.is_none_or(|result| Outcome::from(run.summary.result).name() == result)
            && after.is_none_or(|after| position(run) < after)
    });
    listed.sort_by(|a, b| position(b).cmp(&position(a)));
    let limit = usize::try_from(arguments.number("limit").unwrap_or(1)).unwrap_or(usize::MAX);
    let more = listed.len() > limit;
    listed.truncate(limit);
    let next = listed.last().filter(|_| more).map(|last| {
        let (began, id) = position(last);
        format!("{began}~{id}")
    });
    json(&RunsPage { runs: listed.iter().map(RunItem::from).collect(), next_cursor: next, unreadable })
}

/// Answers with a run.
pub(super) async fn run(call: Call) -> Result<Response, Problem> {
    let (folder, summary) = call.summary().await?;
    let seen = observed(&call.page, &folder, &summary, live(&folder).await?).await;
    json(&RunDetail::new(&call.run(), &seen))
}

/// Returns true if a program drives the run in `folder`.
pub(super) async fn live(folder: &Path) -> Result<bool, Problem> {
    let folder = folder.to_owned();
    blocking(move || Ok(is_live(&folder))).await
}

/// Answers with the figures of the cycles of a run.
pub(super) async fn figures(call: Call) -> Result<Response, Problem> {
    let (_, summary) = call.summary().await?;
    let cycles = summary.cycles.iter().map(CycleFigures::from).collect();
    json(&RunFigures { run: call.run(), simulation: summary.simulation, cycles })
}

/// Returns the choice of records that `word` names; all records if there is no word.
pub(super) fn choice(word: Option<&str>) -> RecordChoice {
    match word {
        Some("events") => RecordChoice::Events,
        Some("people") => RecordChoice::People,
        _ => RecordChoice::All,
    }
}

/// Answers with a page of the record of a run.
pub(super) async fn events(call: Call) -> Result<Response, Problem> {
    let (folder, run) = (call.folder()?, call.run());
    let number = |name: &str| call.arguments.number(name).unwrap_or_default();
    let (after, limit, show) = (number("after"), number("limit") as usize, choice(call.arguments.text("show")));
    let page = blocking(move || {
        let unreadable = |_| unreadable_record(&run);
        let (entries, next_after) =
            record_entries(&folder, show, after, (limit, MAX_PAGE_BYTES)).map_err(unreadable)?;
        let last = record_count(&folder).map_err(unreadable)?;
        Ok(EventsPage { run, events: entries.into_iter().map(RecordedEvent::from).collect(), next_after, last })
    });
    json(&page.await?)
}
