//! Runs a recipe on simulated machines in a child program, and shows how it converges.

use std::convert::Infallible;
use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::{Path, Query, State};
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderMap, StatusCode};
use axum::response::sse::{Event, Sse};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use futures_util::stream::unfold;
use maud::{Markup, html};
use regrind_formats::SimulationFolder;
use regrind_formats::run_files::CycleFile;
use regrind_language::Language;
use regrind_report::{ReportOptions, RunResult};
use serde::Deserialize;
use serde_json::json;
use tokio::task::spawn_blocking;

use super::super::chart::chart;
use super::super::guard::{Session, foreign};
use super::super::live::{ObservedRun, verdict};
use super::super::pieces::figures;
use super::super::reader::language;
use super::super::shared::Shared;
use super::access::{for_engineer, refused};
use super::running::{EndedSimulation, LOOK_EVERY, Simulation, SimulationTask, started};
use super::state::Workbench;
use super::texts::WorkbenchText;

/// Text that is to be simulated.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ToSimulate {
    text: String,
    seed: u64,
}

/// Number of a simulation, in an address.
#[derive(Deserialize)]
pub(crate) struct OfSimulation {
    id: u64,
}

/// Starts a simulation of a text as the recipe named `name`, and responds with its number. A simulation that is under
/// way ends.
pub(crate) async fn begin(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(name): Path<String>,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    let workbench = match permitted(&page, &session, &headers) {
        Ok(workbench) => workbench,
        Err(response) => return *response,
    };
    let Ok(ToSimulate { text, seed }) = serde_json::from_slice(&body) else {
        return refused(StatusCode::BAD_REQUEST, "the request is not that of this page; load the page again");
    };
    let Some(recipe) = workbench.recipes.file(&name) else {
        return refused(StatusCode::NOT_FOUND, "this is no name for a recipe");
    };
    let of_folder = text.clone();
    let folder = match spawn_blocking(move || SimulationFolder::create(&of_folder)).await {
        Ok(Ok(folder)) => Arc::new(folder),
        Ok(Err(error)) => return refused(StatusCode::INSUFFICIENT_STORAGE, error.to_string()),
        Err(_) => return StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    };
    let command = workbench.programs.simulation(&recipe, &folder.draft(), &folder.runs(), seed);
    let id = workbench.next_number();
    let task =
        SimulationTask { id, name, text, seed, person: session.person.clone(), person_key: session.key_of_person() };
    match started(command.into(), task, folder) {
        Ok(simulation) => {
            *workbench.simulation() = Some(simulation);
            Json(json!({ "id": id })).into_response()
        }
        Err(error) => refused(StatusCode::INTERNAL_SERVER_ERROR, format!("the simulation cannot start: {error}")),
    }
}

/// Ends a simulation of the recipe named `name`.
pub(crate) async fn end(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(name): Path<String>,
    Query(of): Query<OfSimulation>,
    headers: HeaderMap,
) -> Response {
    let workbench = match permitted(&page, &session, &headers) {
        Ok(workbench) => workbench,
        Err(response) => return *response,
    };
    workbench.simulation().take_if(|simulation| simulation.is(of.id, &name));
    StatusCode::NO_CONTENT.into_response()
}

fn permitted<'p>(page: &'p Shared, session: &Session, headers: &HeaderMap) -> Result<&'p Workbench, Box<Response>> {
    if let Some(what) = foreign(&page.guard, headers, session) {
        page.guard.refused(&what);
        return Err(Box::new(refused(StatusCode::FORBIDDEN, what)));
    }
    for_engineer(page, session)
}

/// Browser that shows a simulation.
struct SimulationEvents {
    page: Shared,
    session: Session,
    id: u64,
    name: String,
    language: Language,
    sent: Option<(String, bool)>,
}

/// Streams how a simulation of the recipe named `name` converges: pieces of HTML, sent only if they differ from the last
/// ones. The stream ends with the simulation, and tells if another one has ended it.
pub(crate) async fn events(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(name): Path<String>,
    Query(of): Query<OfSimulation>,
    headers: HeaderMap,
) -> Response {
    if let Err(response) = for_engineer(&page, &session) {
        return *response;
    }
    let looking = SimulationEvents { language: language(&headers), page, session, id: of.id, name, sent: None };
    Sse::new(unfold(looking, |mut looking| async {
        let event = looking.next().await?;
        Some((Ok::<_, Infallible>(event), looking))
    }))
    .into_response()
}

impl SimulationEvents {
    /// Waits until the simulation has changed, and returns the next message for the browser. Returns `None` when the
    /// simulation has ended, or when there is none.
    async fn next(&mut self) -> Option<Event> {
        if self.sent.as_ref().is_some_and(|(_, is_over)| *is_over) {
            return None;
        }
        loop {
            if !self.page.guard.has_access(&self.session) {
                return None;
            }
            let (html, is_over) = self.current_pieces()?;
            if self.sent.as_ref() != Some(&(html.clone(), is_over)) {
                let event = Event::default().json_data(json!({ "html": html, "isOver": is_over })).ok();
                self.sent = Some((html, is_over));
                return event;
            }
            tokio::time::sleep(LOOK_EVERY).await;
        }
    }

    /// Returns the present HTML of the simulation, and true if it has ended. Returns `None` if the page has no workbench.
    fn current_pieces(&self) -> Option<(String, bool)> {
        let workbench = self.page.workbench.as_ref()?;
        let present = workbench.simulation();
        let Some(simulation) = present.as_ref().filter(|simulation| simulation.is(self.id, &self.name)) else {
            let others = present.as_ref().filter(|later| later.task.person_key != self.session.key_of_person());
            return Some((gone(others, self.language).into_string(), true));
        };
        let ended = simulation.ended.borrow().clone();
        let seen = simulation.observed();
        // The record can be read a moment after the program has ended.
        let is_over = ended.as_ref().is_some_and(|ended| !ended.is_complete || verdict(&seen).is_some());
        Some((pieces(simulation, &seen, ended.as_ref(), self.language).into_string(), is_over))
    }
}

/// Returns the HTML in place of a simulation that was ended. `replaced_by` is the simulation of another person that has
/// ended it, if there is one.
fn gone(replaced_by: Option<&Simulation>, language: Language) -> Markup {
    let say = |text: WorkbenchText| text.to(language);
    html! {
        p .quiet {
            (say(WorkbenchText::SimulationEnded))
            @if let Some(later) = replaced_by {
                " " (say(WorkbenchText::SimulationReplaced)) " " (later.task.person.as_ref().map_or(say(WorkbenchText::OtherBrowser), |person| &person.name))
            }
        }
    }
}

/// Returns the HTML of a simulation: what it does or how it has ended, and its cycles.
fn pieces(simulation: &Simulation, seen: &ObservedRun, ended: Option<&EndedSimulation>, language: Language) -> Markup {
    let say = |text: WorkbenchText| text.to(language);
    let summary = &seen.summary;
    let failed = ended.filter(|ended| !ended.is_complete);
    html! {
        p .verdict role="status" {
            span .simulation { "SIMULATION" } " "
            @match (failed, verdict(seen)) {
                (Some(_), _) => strong { (say(WorkbenchText::SimulationFailed)) },
                (None, Some(true)) => strong .good { (say(WorkbenchText::Accepted)) },
                (None, Some(false)) if summary.result == RunResult::NotAccepted => strong { (say(WorkbenchText::NotAccepted)) },
                (None, Some(false)) => strong { (super::super::texts::result(summary.result).to(language)) },
                (None, None) => span { (say(WorkbenchText::Simulates)) },
            }
            " " span .quiet { (say(WorkbenchText::Seed)) " " (simulation.task.seed) }
        }
        @if let Some(failed) = failed { p .warns { (failed.message) } }
        @if !summary.cycles.is_empty() {
            (figures(&summary.cycles, summary.tolerance.as_ref(), language))
            (chart(&summary.cycles, summary.tolerance.as_ref(), false, language))
        }
    }
}

/// Serves the error map of the last measured cycle of the simulation of the recipe named `name`, as a picture.
pub(crate) async fn map(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(name): Path<String>,
    Query(of): Query<OfSimulation>,
) -> Response {
    let found = of_run(&page, &session, (of.id, &name), |folder, seen| {
        let map = folder.join(seen.summary.cycles.iter().rev().find_map(|cycle| cycle.map.clone())?);
        std::fs::read(map.parent()?.join(CycleFile::ErrorMapPng.name())).ok()
    });
    match found.await {
        Ok(bytes) => ([(CONTENT_TYPE, "image/png")], bytes).into_response(),
        Err(response) => response,
    }
}

/// Serves the report of the simulation of the recipe named `name`.
pub(crate) async fn report(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(name): Path<String>,
    Query(of): Query<OfSimulation>,
    headers: HeaderMap,
) -> Response {
    let language = language(&headers);
    let found = of_run(&page, &session, (of.id, &name), move |folder, _| {
        regrind_report::run_report(folder, &ReportOptions { language, ..ReportOptions::default() }).ok()
    });
    match found.await {
        Ok(html) => super::super::view::report_document(html.into_bytes()),
        Err(response) => response,
    }
}

/// Reads from the folder of the run of a simulation without blocking other requests.
///
/// # Errors
/// Returns the response to the browser if there is no such simulation of this recipe, or if `read` finds nothing.
async fn of_run<T: Send + 'static>(
    page: &Shared,
    session: &Session,
    (id, name): (u64, &str),
    read: impl FnOnce(&std::path::Path, &ObservedRun) -> Option<T> + Send + 'static,
) -> Result<T, Response> {
    let workbench = for_engineer(page, session).map_err(|response| *response)?;
    let found = {
        let simulation = workbench.simulation();
        let simulation = simulation.as_ref().filter(|simulation| simulation.is(id, name));
        simulation.and_then(|simulation| Some((simulation.run_folder()?, simulation.observed())))
    };
    let nothing = || refused(StatusCode::NOT_FOUND, "there is no such result of a simulation");
    let Some((folder, seen)) = found else { return Err(nothing()) };
    spawn_blocking(move || read(&folder, &seen)).await.ok().flatten().ok_or_else(nothing)
}
