//! Reasons why a page is not made, and the page that shows such a reason.

use std::time::Duration;

use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use maud::html;
use regrind_language::{Language, filled};
use regrind_page::{Reader, plant_document};

use super::super::error::PlantError;
use super::style::STYLE;
use super::texts::Text;
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
    NotHere(Message),
    /// The request is invalid.
    Nonsense(Message),
}

/// Message for the reader of a page.
pub(super) enum Message {
    /// Text of the page, with the values of its places.
    Text(Text, Vec<(&'static str, String)>),
    /// Words of another program part, in English.
    Words(String),
}

impl Message {
    fn to(&self, language: Language) -> String {
        match self {
            Self::Words(words) => words.clone(),
            Self::Text(text, values) => {
                let values: Vec<(&str, &dyn std::fmt::Display)> =
                    values.iter().map(|(name, value)| (*name, value as &dyn std::fmt::Display)).collect();
                filled(text.to(language), &values)
            }
        }
    }
}

impl PageError {
    /// Returns the reason that the plant has no such object.
    pub(super) fn not_here(text: Text, values: Vec<(&'static str, String)>) -> Self {
        Self::NotHere(Message::Text(text, values))
    }

    /// Returns the reason that the plant has no run with this number.
    pub(super) fn no_run(id: i32) -> Self {
        Self::not_here(Text::NoSuchRun, vec![("run", id.to_string())])
    }
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
/// 5 s. `reader` is the reader of the page.
pub(super) fn unmade(reader: &Reader, reason: &PageError) -> Response {
    let say = |text: Text| text.to(reader.language);
    let (status, again_s, title, words) = match reason {
        PageError::Plant(error) if error.may_pass() => {
            (StatusCode::SERVICE_UNAVAILABLE, Some(AGAIN_S), Text::DatabaseGone, error.to_string())
        }
        PageError::Plant(error) => (StatusCode::INTERNAL_SERVER_ERROR, None, Text::DatabaseRefused, error.to_string()),
        PageError::NotHere(what) => (StatusCode::NOT_FOUND, None, Text::NotFound, what.to(reader.language)),
        PageError::Nonsense(what) => (StatusCode::BAD_REQUEST, None, Text::InvalidRequest, what.to(reader.language)),
    };
    let main = html! {
        main .list .plant {
            h1 { (say(title)) }
            p role="alert" { (words::shown(&words)) }
            @if again_s.is_some() {
                p { (filled(say(Text::CellsGoOn), &[("seconds", &AGAIN_S)])) }
            }
        }
    };
    (status, plant_document(say(title), reader, again_s, STYLE, main)).into_response()
}
