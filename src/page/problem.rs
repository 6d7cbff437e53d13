//! Refusals for programs: problem documents (RFC 9457), each with its place, value, limit and remedy.

use axum::http::header::{ALLOW, CONTENT_TYPE, RETRY_AFTER, WWW_AUTHENTICATE};
use axum::http::{HeaderName, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use schemars::JsonSchema;
use serde::Serialize;

/// Media type of a problem document.
pub(crate) const MEDIA_TYPE: &str = "application/problem+json";
/// Maximum number of characters of a value from a client in a problem document.
const MAX_VALUE_CHARACTERS: usize = 80;

/// Returns true if the address `path` belongs to the interface for programs, whose refusals are problem documents.
pub(crate) fn is_for_programs(path: &str) -> bool {
    path == "/metrics" || path == "/api" || path.starts_with("/api/")
}

/// Defines the kinds of problems, each with its status, its name in the type of the document, its title and its remedy.
macro_rules! kinds {
    ($($(#[$doc:meta])* $kind:ident = $status:ident, $name:literal, $title:literal, $remedy:literal;)+) => {
        /// Kind of a problem.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(crate) enum ProblemKind {
            $($(#[$doc])* $kind,)+
        }

        impl ProblemKind {
            /// Returns the status, the name, the title and the remedy of this kind.
            const fn entry(self) -> (StatusCode, &'static str, &'static str, &'static str) {
                match self {
                    $(Self::$kind => (StatusCode::$status, $name, $title, $remedy),)+
                }
            }
        }
    };
}

kinds! {
    /// Parameter that is unknown, given twice, or outside its limits.
    Parameter = BAD_REQUEST, "parameter", "A parameter cannot be used",
        "give only the parameters of /api/openapi.json, each once and within its limits";
    /// Request without a token and without the session of a browser.
    NoAccess = UNAUTHORIZED, "no-access", "The request has no token",
        "send the header Authorization: Bearer TOKEN; make a token with: regrind users token NAME; on a page without users, the token is the key in its address";
    /// Token that the page does not know.
    WrongToken = UNAUTHORIZED, "wrong-token", "The token is not valid", "make a new token with: regrind users token NAME";
    /// Further wrong token after too many within a minute.
    TooManyTokens = TOO_MANY_REQUESTS, "too-many-wrong-tokens", "Too many wrong tokens came from this address",
        "wait one minute, and send a valid token";
    /// Host that is not this page.
    OtherHost = MISDIRECTED_REQUEST, "other-host", "The request names another host",
        "use the address that `regrind serve` printed, or a name in the certificate of the page";
    /// Address that does not exist.
    UnknownAddress = NOT_FOUND, "unknown-address", "This address does not exist", "see /api/openapi.json for all addresses";
    /// Run that does not exist.
    UnknownRun = NOT_FOUND, "unknown-run", "This run does not exist", "see /api/v1/runs for the names of all runs";
    /// Cycle of which nothing is on record.
    UnknownCycle = NOT_FOUND, "unknown-cycle", "The run has no such cycle",
        "see /api/v1/runs/{run}/figures for the cycles of the run";
    /// Map or file that the cycle does not have.
    NoFile = NOT_FOUND, "no-file", "The cycle has no such file", "see /api/v1/runs/{run}/maps for the files of the run";
    /// Position in a record after its last record.
    BeyondRecord = CONFLICT, "beyond-record", "The record has no such number yet",
        "check that the run is the same as before, and verify its record with: regrind audit verify";
    /// Method other than GET and HEAD.
    WrongMethod = METHOD_NOT_ALLOWED, "wrong-method", "This interface only reads", "use GET or HEAD; give orders at the page or a terminal";
    /// No media type that the client accepts.
    NotAcceptable = NOT_ACCEPTABLE, "not-acceptable", "The answer has none of the accepted media types",
        "accept one of the media types in `allowed`";
    /// Map with more nodes than an answer can have.
    TooLarge = UNPROCESSABLE_ENTITY, "too-large", "The map is too large for JSON", "read the file error_map.csv of the cycle instead";
    /// File of a cycle that cannot be understood.
    UnreadableFile = INTERNAL_SERVER_ERROR, "unreadable-file", "A file of the run cannot be read",
        "verify the record with: regrind audit verify";
    /// Record that cannot be read.
    UnreadableRecord = INTERNAL_SERVER_ERROR, "unreadable-record", "The record of the run cannot be read",
        "verify the record with: regrind audit verify";
    /// Fault of this program.
    Fault = INTERNAL_SERVER_ERROR, "fault", "The page failed", "report this fault of the Regrind program";
    /// Stream after the last one that the page serves at a time.
    TooManyStreams = SERVICE_UNAVAILABLE, "too-many-streams", "Too many streams are open", "close a stream, or try again later";
}

/// Problem: the reason why a program gets no answer.
#[derive(Debug, Serialize)]
#[serde(transparent)]
pub(crate) struct Problem(Box<ProblemDocument>);

/// Problem document (RFC 9457).
#[derive(Debug, Serialize, JsonSchema)]
#[schemars(rename = "Problem")]
pub(crate) struct ProblemDocument {
    #[serde(skip)]
    kind: ProblemKind,
    /// Kind of the problem: `urn:regrind:problem:` and its name.
    #[schemars(extend("format" = "uri"), example = "urn:regrind:problem:unknown-run")]
    r#type: String,
    /// Kind of the problem in words.
    title: &'static str,
    /// Status of the response.
    #[schemars(range(min = 400, max = 599))]
    status: u16,
    /// Event, with the value and the limit.
    detail: String,
    /// Remedy.
    remedy: &'static str,
    /// Name of the parameter that cannot be used.
    #[serde(skip_serializing_if = "Option::is_none")]
    parameter: Option<String>,
    /// Value that cannot be used; at most 80 characters of it.
    #[serde(skip_serializing_if = "Option::is_none")]
    value: Option<String>,
    /// Allowed values.
    #[serde(skip_serializing_if = "Option::is_none")]
    allowed: Option<String>,
}

impl Problem {
    /// Returns a problem of this kind. `detail` says what happened, with the value and the limit.
    pub(crate) fn new(kind: ProblemKind, detail: impl Into<String>) -> Self {
        let (status, name, title, remedy) = kind.entry();
        Self(Box::new(ProblemDocument {
            kind,
            r#type: format!("urn:regrind:problem:{name}"),
            title,
            status: status.as_u16(),
            detail: detail.into(),
            remedy,
            parameter: None,
            value: None,
            allowed: None,
        }))
    }

    /// Returns a problem with the parameter `parameter`, which has the value `value`. `allowed` are the allowed values.
    pub(crate) fn with_parameter(parameter: &str, value: &str, allowed: impl Into<String>) -> Self {
        let (value, allowed) = (shortened(value), allowed.into());
        let detail = format!("the parameter {:?} has the value {value:?}; allowed: {allowed}", shortened(parameter));
        let mut problem =
            Self::new(ProblemKind::Parameter, detail).with_parameter_name(parameter).with_allowed(allowed);
        problem.0.value = Some(value);
        problem
    }

    /// Returns this problem with the name of a parameter from a client.
    pub(crate) fn with_parameter_name(mut self, parameter: &str) -> Self {
        self.0.parameter = Some(shortened(parameter));
        self
    }

    /// Returns this problem with the allowed values.
    pub(crate) fn with_allowed(mut self, allowed: impl Into<String>) -> Self {
        self.0.allowed = Some(allowed.into());
        self
    }
}

/// Returns the beginning of a text from a client.
pub(crate) fn shortened(text: &str) -> String {
    text.chars().take(MAX_VALUE_CHARACTERS).collect()
}

impl ProblemKind {
    /// Returns the status of the response.
    pub(crate) const fn status(self) -> StatusCode {
        self.entry().0
    }

    /// Returns the title.
    pub(crate) const fn title(self) -> &'static str {
        self.entry().2
    }

    /// Returns the additional header of the response, if this kind has one.
    pub(crate) const fn header(self) -> Option<(HeaderName, &'static str)> {
        match self {
            Self::NoAccess => Some((WWW_AUTHENTICATE, "Bearer realm=\"regrind\"")),
            Self::WrongToken => Some((WWW_AUTHENTICATE, "Bearer realm=\"regrind\", error=\"invalid_token\"")),
            Self::TooManyTokens => Some((RETRY_AFTER, "60")),
            Self::TooManyStreams => Some((RETRY_AFTER, "10")),
            Self::WrongMethod => Some((ALLOW, "GET, HEAD")),
            _ => None,
        }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        // A problem contains only texts and a number, so the conversion to JSON cannot fail.
        let body = serde_json::to_string(&self).unwrap_or_default();
        let kind = self.0.kind;
        let mut response = (kind.status(), [(CONTENT_TYPE, MEDIA_TYPE)], body).into_response();
        if let Some((name, value)) = kind.header() {
            response.headers_mut().insert(name, HeaderValue::from_static(value));
        }
        response
    }
}
