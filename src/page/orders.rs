//! Orders from the page, through the same door as those from the terminal.
//!
//! One browser has control. What makes safe (hold, stop, abort) is taken from every one; what lets machines move, or says what a
//! person has seen, from the one that has control only. Who takes control is on record in the run, and so is what did not come from
//! the page.

use std::path::PathBuf;

use axum::Extension;
use axum::Json;
use axum::body::Bytes;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use regrind_control::{OnBehalf, Reply, Request, ask_for};
use serde::Serialize;
use tokio::task::spawn_blocking;

use super::Shared;
use super::guard::{Session, foreign};

/// What the page answers to an order.
#[derive(Serialize)]
struct Answer {
    accepted: bool,
    message: String,
}

/// Gives an order to a running cell.
pub(crate) async fn order(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(run): Path<String>,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    if let Some(what) = foreign(&page.guard, &headers, &session) {
        return refuse(&page, &run, what, StatusCode::FORBIDDEN).await;
    }
    let Some(folder) = page.history.folder(&run) else { return StatusCode::NOT_FOUND.into_response() };
    let request = match serde_json::from_slice(&body) {
        Ok(request @ (Request::Hold { .. } | Request::Stop { .. } | Request::Abort { .. })) => request,
        Ok(
            request @ (Request::Resume { seen: Some(_), .. }
            | Request::Loaded
            | Request::Clear { .. }
            | Request::Over { .. }),
        ) => {
            if !page.guard.has_control(&session.0, true) {
                let what = "another screen has control; take it over first".to_owned();
                return (StatusCode::CONFLICT, Json(Answer { accepted: false, message: what })).into_response();
            }
            request
        }
        // What else the cell understands is for programs and the terminal.
        Ok(_) | Err(_) => {
            return refuse(&page, &run, "what is no order of the page".into(), StatusCode::BAD_REQUEST).await;
        }
    };
    answered(give(folder, request, &session).await)
}

/// Gives control to the browser that asks for it.
pub(crate) async fn take_control(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(run): Path<String>,
    headers: HeaderMap,
) -> Response {
    if let Some(what) = foreign(&page.guard, &headers, &session) {
        return refuse(&page, &run, what, StatusCode::FORBIDDEN).await;
    }
    let Some(folder) = page.history.folder(&run) else { return StatusCode::NOT_FOUND.into_response() };
    let what = "control was taken over by another screen of the page".to_owned();
    let recorded = give(folder, Request::Remark { what }, &session).await;
    if recorded.is_ok() {
        page.guard.take_control(&session.0);
    }
    answered(recorded)
}

fn answered(reply: std::io::Result<Reply>) -> Response {
    match reply {
        Ok(Reply { accepted, message, .. }) => Json(Answer { accepted, message }).into_response(),
        Err(error) => {
            let message = format!("the program of the cell does not answer: {error}");
            (StatusCode::BAD_GATEWAY, Json(Answer { accepted: false, message })).into_response()
        }
    }
}

/// Refuses, and has it on record in the run that it was meant for.
async fn refuse(page: &Shared, run: &str, what: String, status: StatusCode) -> Response {
    if page.guard.refused(&what)
        && let Some(folder) = page.history.folder(run)
    {
        let remark = Request::Remark { what: format!("the page refused {what}") };
        // A run that is over takes no remark.
        drop(give(folder, remark, &Session(String::new())).await);
    }
    (status, Json(Answer { accepted: false, message: what })).into_response()
}

/// Asks the cell on a thread that may wait.
async fn give(folder: PathBuf, request: Request, session: &Session) -> std::io::Result<Reply> {
    let screen = session.0.get(..6).map_or("page".to_owned(), |short| format!("page, screen {short}"));
    let by = OnBehalf { name: None, station: screen };
    spawn_blocking(move || ask_for(&folder, &request, Some(by))).await.map_err(std::io::Error::other)?
}
