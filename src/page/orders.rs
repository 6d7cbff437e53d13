//! Orders from the page, through the same socket as those from the terminal.
//!
//! One browser has control. Orders that make the cell safe (hold, stop, abort) are accepted from every browser whose
//! person can give them. Orders that let machines move, or that confirm what a person has seen, are accepted only from
//! the browser that has control. Each change of control is on record in the run, and so is each refusal.

use std::path::PathBuf;
use std::sync::Arc;

use axum::Extension;
use axum::Json;
use axum::body::Bytes;
use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use regrind_cell::Role;
use regrind_control::{OnBehalf, Reply, Request, send_request_on_behalf};
use regrind_formats::UploadedFile;
use serde::{Deserialize, Serialize};
use tokio::task::{JoinHandle, spawn_blocking};

use super::guard::{Session, foreign};
use super::history::History;
use super::shared::Shared;
use super::users::PageRole;

/// Answer of the page to an order.
#[derive(Serialize)]
struct Answer {
    accepted: bool,
    message: String,
}

/// Sends the order in `body` to the cell of the active run named `run`, and responds with the reply of the cell.
/// Refuses the order in these cases:
///
/// - The order does not come from this page or has no valid token.
/// - `body` does not contain an order that the page can give.
/// - The person does not have the right to give this order.
/// - Another browser has control, and the order is not `hold`, `stop` or `abort`.
/// - The order is `resume`, and it would clear an alarm that only a process engineer can clear.
pub(crate) async fn order(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(run): Path<String>,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    let folder = match from_this_page(&page, &run, &headers, &session).await {
        Ok(folder) => folder,
        Err(refused) => return refused,
    };
    let request = serde_json::from_slice::<Request>(&body).ok();
    // Other requests that the cell understands are for programs and the terminal only.
    let Some((request, name)) = request.and_then(|request| name_of(&request).map(|name| (request, name))) else {
        return refuse(
            &page,
            &run,
            "a request that is not allowed, because this page has no such order".into(),
            StatusCode::BAD_REQUEST,
        )
        .await;
    };
    if let Err(refused) = permitted(&page, &run, &session, name).await {
        return refused;
    }
    if name == "resume"
        && let Some(what) = clears_alarm_of_another(&folder, &session).await
    {
        return refuse(&page, &run, what, StatusCode::FORBIDDEN).await;
    }
    answered(give(folder, marked(request), &session).await)
}

/// Returns an entry of a person in the log of the shift with its mark, so that nobody takes it for a note of a program.
/// Other requests are unchanged.
fn marked(request: Request) -> Request {
    match request {
        Request::Remark { what, alarm: None } if !what.trim().is_empty() => {
            let entry: String = what.trim().chars().take(MAX_ENTRY_CHARACTERS).collect();
            Request::Remark { what: format!("shift log: {entry}"), alarm: None }
        }
        other => other,
    }
}

/// Takes the file of a measurement in `body`, and confirms with it that the measurement is done. The name of the file is
/// in `named`. The machine reads the file and checks it; the response contains what it found. Refuses the file in the
/// same cases as [`order`] refuses a confirmation.
pub(crate) async fn measurement(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(run): Path<String>,
    Query(NamedFile { name }): Query<NamedFile>,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    let folder = match from_this_page(&page, &run, &headers, &session).await {
        Ok(folder) => folder,
        Err(refused) => return refused,
    };
    if let Err(refused) = permitted(&page, &run, &session, "done").await {
        return refused;
    }
    let stored = spawn_blocking({
        let folder = folder.clone();
        move || UploadedFile::store(&folder, &name, &body)
    });
    match stored.await {
        Ok(Ok(file)) => {
            let request = Request::Done { map: None, file: Some(file.path().to_owned()) };
            let reply = give(folder, request, &session).await;
            // The person knows the file by its name.
            answered(reply.map(|reply| Reply { message: file.without_folder(&reply.message), ..reply }))
        }
        Ok(Err(error)) => {
            let message = error.to_string();
            (StatusCode::INSUFFICIENT_STORAGE, Json(Answer { accepted: false, message })).into_response()
        }
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// Name of a file that a browser sends.
#[derive(Deserialize)]
pub(crate) struct NamedFile {
    name: String,
}

/// Checks that a request of the browser of `session` comes from this page, and uses up its token. Returns the folder of
/// the run named `run`.
///
/// # Errors
/// Returns the response to the browser if the request comes from elsewhere, or if the run does not exist.
async fn from_this_page(page: &Shared, run: &str, headers: &HeaderMap, session: &Session) -> Result<PathBuf, Response> {
    if let Some(what) = foreign(&page.guard, headers, session) {
        return Err(refuse(page, run, what, StatusCode::FORBIDDEN).await);
    }
    page.history.folder(run).ok_or_else(|| StatusCode::NOT_FOUND.into_response())
}

/// Checks whether the browser of `session` may give the order `name`.
///
/// # Errors
/// Returns the response to the browser if the person does not have the right to give the order, or if another browser
/// has control and the order needs control.
async fn permitted(page: &Shared, run: &str, session: &Session, name: &str) -> Result<(), Response> {
    if let Some(what) = not_for(session, name) {
        return Err(refuse(page, run, what, StatusCode::FORBIDDEN).await);
    }
    if !MAKES_SAFE.contains(&name) && !page.guard.has_control(session, true) {
        let message = "another screen has control of the cell; press TAKE CONTROL on this screen first".to_owned();
        return Err((StatusCode::CONFLICT, Json(Answer { accepted: false, message })).into_response());
    }
    Ok(())
}

/// Maximum length of an entry in the log of the shift.
const MAX_ENTRY_CHARACTERS: usize = 400;

/// Orders that every screen can give, without control.
const MAKES_SAFE: [&str; 4] = ["hold", "stop", "abort", "remark"];

/// Returns the name of an order that the page can give, such as `hold`; `None` for any other request to a cell.
fn name_of(request: &Request) -> Option<&'static str> {
    match request {
        Request::Hold { .. } => Some("hold"),
        Request::Stop { .. } => Some("stop"),
        Request::Abort { .. } => Some("abort"),
        // Only a resume for the state that the person saw is accepted.
        Request::Resume { state_number: Some(_), .. } => Some("resume"),
        Request::Loaded => Some("loaded"),
        Request::Clear { .. } => Some("clear"),
        Request::Over { .. } => Some("over"),
        // A browser names no file of this computer: it sends the file itself.
        Request::Started { .. } => Some("started"),
        Request::Done { file: None, .. } => Some("done"),
        Request::Still { device: Some(_) } => Some("still"),
        Request::Remark { .. } => Some("remark"),
        _ => None,
    }
}

/// Returns the reason why the person at a browser cannot give the order named `order`; `None` if the person can give
/// it.
fn not_for(session: &Session, order: &str) -> Option<String> {
    let person = session.person.as_ref().filter(|_| !session.may(order))?;
    Some(format!("the order {order} from {person}: the role of this person does not allow this order"))
}

/// Checks whether the person at the browser of `session` may give a resume order for the run in `folder`. Returns the
/// reason to refuse the order if an alarm is active that only a process engineer can clear, and the person has another
/// role. Otherwise returns `None`. Also returns `None` if there is no list of users, or if the cell does not answer.
async fn clears_alarm_of_another(folder: &std::path::Path, session: &Session) -> Option<String> {
    let person = session.person.as_ref().filter(|person| person.role != PageRole::Engineer)?;
    let Reply { status, .. } = give(folder.to_owned(), Request::Status, session).await.ok()?;
    let theirs = status.alarms.iter().find(|alarm| alarm.cleared_by == Role::ProcessEngineer)?;
    Some(format!(
        "the order resume from {person}, which is not allowed, because only an engineer can clear the active alarm \"{}\"",
        theirs.event
    ))
}

/// Gives control of the cell of the run named `run` to the browser of `session`. Refuses this if the order does not
/// come from this page or has no valid token, or if the person does not have the right to take control. Then sends a
/// remark about the change to the cell, for the record of the run. If the cell does not answer, control does not
/// change.
pub(crate) async fn take_control(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(run): Path<String>,
    headers: HeaderMap,
) -> Response {
    let refused = foreign(&page.guard, &headers, &session).or_else(|| not_for(&session, "control"));
    if let Some(what) = refused {
        return refuse(&page, &run, what, StatusCode::FORBIDDEN).await;
    }
    let Some(folder) = page.history.folder(&run) else { return StatusCode::NOT_FOUND.into_response() };
    let what = "another screen of the page took control of the cell".to_owned();
    let recorded = give(folder, Request::Remark { what, alarm: None }, &session).await;
    if recorded.is_ok() {
        page.guard.take_control(&session);
    }
    answered(recorded)
}

fn answered(reply: std::io::Result<Reply>) -> Response {
    match reply {
        Ok(Reply { accepted, message, .. }) => Json(Answer { accepted, message }).into_response(),
        Err(error) => {
            let message =
                format!("the program that runs the cell does not answer: {error}; check that this program still runs");
            (StatusCode::BAD_GATEWAY, Json(Answer { accepted: false, message })).into_response()
        }
    }
}

/// Refuses a request that concerns the run named `run`. First sends the refusal to the record of the run, unless too
/// many requests were refused within a minute. Then responds with the HTTP status `status`, and with the reason `what`
/// as JSON.
async fn refuse(page: &Shared, run: &str, what: String, status: StatusCode) -> Response {
    if page.guard.refused(&what) {
        drop(write_down(&page.history, Some(run.to_owned()), format!("the page refused {what}")).await);
    }
    (status, Json(Answer { accepted: false, message: what })).into_response()
}

/// Writes the message `what` to the record of the run named `run`. If `run` is `None`, writes it to the records of all
/// active runs. The message is sent to the program of the run, which writes it. A run that has ended gets no message.
/// Returns the task that sends the messages.
pub(crate) fn write_down(history: &Arc<History>, run: Option<String>, what: String) -> JoinHandle<()> {
    let history = Arc::clone(history);
    spawn_blocking(move || {
        let folders = run.map_or_else(|| history.live(), |run| history.folder(&run).into_iter().collect());
        for folder in folders {
            let by = OnBehalf { name: None, station: "page".into() };
            drop(send_request_on_behalf(&folder, &Request::Remark { what: what.clone(), alarm: None }, Some(by)));
        }
    })
}

/// Sends a request to the cell of the run in `folder`, in the name of the person at the browser, and returns the reply.
/// Does not block the other requests.
async fn give(folder: PathBuf, request: Request, session: &Session) -> std::io::Result<Reply> {
    let screen = session.id.get(..6).map_or("page".to_owned(), |short| format!("page, screen {short}"));
    let station = if session.from.is_loopback() { screen } else { format!("{screen}, at {}", session.from) };
    let by = OnBehalf { name: session.person.as_ref().map(ToString::to_string), station };
    spawn_blocking(move || send_request_on_behalf(&folder, &request, Some(by))).await.map_err(std::io::Error::other)?
}
