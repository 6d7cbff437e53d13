//! Reader of a page: the person who has signed in, and the language of the browser.

use axum::extract::FromRequestParts;
use axum::http::header::{ACCEPT_LANGUAGE, COOKIE};
use axum::http::request::Parts;
use axum::http::{HeaderMap, StatusCode};
use regrind_language::Language;

use super::guard::{Session, text};

/// Reader of a page, as an argument of the handlers of a page. The guard must have let the request in.
#[derive(Clone)]
pub struct Reader {
    /// Session of the browser.
    pub session: Session,
    /// Language of the page for this browser.
    pub language: Language,
}

impl<S: Send + Sync> FromRequestParts<S> for Reader {
    type Rejection = StatusCode;

    async fn from_request_parts(parts: &mut Parts, _state: &S) -> Result<Self, StatusCode> {
        let session = parts.extensions.get::<Session>().cloned().ok_or(StatusCode::UNAUTHORIZED)?;
        Ok(Self { session, language: language(&parts.headers) })
    }
}

/// Returns the language of the page for a request. `headers` are the headers of the request. The first rule that gives
/// a language applies:
///
/// - the language that the person chose in this browser (stored in a cookie)
/// - the first supported language in the header `Accept-Language`
/// - English
pub(crate) fn language(headers: &HeaderMap) -> Language {
    let chosen = text(headers, COOKIE).and_then(|cookies| {
        let pair = cookies.split(';').find_map(|pair| pair.trim().strip_prefix("regrind_language="))?;
        Language::first_of(pair)
    });
    chosen.or_else(|| Language::first_of(text(headers, ACCEPT_LANGUAGE)?)).unwrap_or_default()
}
