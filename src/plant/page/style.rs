//! `/plant.css`: style of the parts that the page of a cell does not have.

use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};

/// Path of the style sheet for the parts that the page of a cell does not have.
pub(super) const STYLE: &str = "/plant.css";

pub(super) async fn style() -> Response {
    ([(CONTENT_TYPE, "text/css; charset=utf-8"), (CACHE_CONTROL, "no-cache")], include_str!("plant.css"))
        .into_response()
}
