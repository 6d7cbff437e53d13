//! Access to the workbench, and its answers.

use axum::Json;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::super::guard::Session;
use super::super::shared::Page;
use super::state::Workbench;

/// Answer to a request of the workbench that is not carried out.
#[derive(Serialize)]
struct Refusal {
    message: String,
}

/// Answer to a text that is longer than `RecipeFolder::MAX_BYTES`.
pub(super) const TOO_LONG: &str = "the text of a recipe has at most 256 KiB";

pub(super) fn refused(status: StatusCode, message: impl Into<String>) -> Response {
    (status, Json(Refusal { message: message.into() })).into_response()
}

/// Returns the workbench of `page` if the person of `session` may use it.
///
/// # Errors
/// Returns the response to the browser if the page has no folder of recipes, or if the person is no engineer.
pub(super) fn for_engineer<'p>(page: &'p Page, session: &Session) -> Result<&'p Workbench, Box<Response>> {
    let Some(workbench) = &page.workbench else {
        let message = "this page has no folder of recipes; start it with `regrind serve --recipes DIR`";
        return Err(Box::new(refused(StatusCode::NOT_FOUND, message)));
    };
    if !session.is_engineer() {
        let who = session.person.as_ref().map(ToString::to_string).unwrap_or_default();
        // The refusal is in the log of the page; it concerns no run.
        page.guard.refused(&format!("a request of the workbench from {who}"));
        return Err(Box::new(refused(StatusCode::FORBIDDEN, "only an engineer can use the recipes")));
    }
    Ok(workbench)
}

/// Returns the response with a text that is no page.
pub(super) fn plain(text: String) -> Response {
    ([(CONTENT_TYPE, "text/plain; charset=utf-8")], text).into_response()
}
