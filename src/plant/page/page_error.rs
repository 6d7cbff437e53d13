//! Reasons why a page is not made, and the page that shows such a reason.

use std::time::Duration;

use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use maud::html;
use regrind_page::{Session, plant_document};

use super::super::error::PlantError;
use super::style::STYLE;
use super::words;

/// Time limit for making a page.
const PATIENCE: Duration = Duration::from_secs(15);
/// Seconds until the browser retries a page that could not be made.
const AGAIN_S: u32 = 5;

/// Reason why a page is not made.
pub(super) enum PageError {
    /// The database cannot be reached, or refuses.
    Plant(Box<PlantError>),
    /// The requested object does not exist.
    NotHere(String),
    /// The request is invalid.
    Nonsense(String),
}

impl From<PlantError> for PageError {
    fn from(error: PlantError) -> Self {
        Self::Plant(Box::new(error))
    }
}

/// Waits for the future `making` and returns its result. Returns an error if `making` does not finish within the time
/// limit of a page (15 s).
pub(super) async fn within<T>(making: impl Future<Output = Result<T, PageError>>) -> Result<T, PageError> {
    let late = || {
        let what = format!("no answer within {} s", PATIENCE.as_secs());
        PageError::from(PlantError::Unreachable { place: "the other end".into(), what })
    };
    tokio::time::timeout(PATIENCE, making).await.unwrap_or_else(|_| Err(late()))
}

/// Returns an error page. `reason` is the reason why the requested page cannot be shown. The page contains the reason,
/// and the reason determines the HTTP status. If the plant cannot be reached, the browser requests the page again every
/// 5 s. `session` is the session of the person who has signed in.
pub(super) fn unmade(session: &Session, reason: &PageError) -> Response {
    let (status, again_s, title, words) = match reason {
        PageError::Plant(error) if error.may_pass() => (
            StatusCode::SERVICE_UNAVAILABLE,
            Some(AGAIN_S),
            "The database of the plant cannot be reached",
            error.to_string(),
        ),
        PageError::Plant(error) => (
            StatusCode::INTERNAL_SERVER_ERROR,
            None,
            "The database of the plant refused the request",
            error.to_string(),
        ),
        PageError::NotHere(what) => (StatusCode::NOT_FOUND, None, "Not found", what.clone()),
        PageError::Nonsense(what) => (StatusCode::BAD_REQUEST, None, "Invalid request", what.clone()),
    };
    let main = html! {
        main .list .plant {
            h1 { (title) }
            p role="alert" { (words::shown(&words)) }
            @if again_s.is_some() {
                p { "Cells grind, hold and accept without the database; their records wait at the cells. The present state of the cells is not known here. "
                    "This page tries again by itself every " (AGAIN_S) " s." }
            }
        }
    };
    (status, plant_document(title, session, again_s, STYLE, main)).into_response()
}
