//! Endpoint of the interface for programs: its address, its parameters and its answers. The same table routes the requests,
//! reads their parameters and describes itself in OpenAPI.

use std::future::Future;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;

use axum::Extension;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, HeaderValue, Uri};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, get};
use data_encoding::HEXLOWER;
use regrind_report::RunSummary;
use schemars::SchemaGenerator;
use serde::Serialize;
use serde_json::Value;
use sha2::{Digest, Sha256};
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;

use super::media::preferred;
use super::parameters::{Arguments, Parameter};
use crate::problem::{Problem, ProblemKind};
use crate::program_access::ProgramAccess;
use crate::shared::Shared;

/// Endpoint, which only reads.
pub(super) struct Endpoint {
    /// Address, with its parameters in braces.
    pub(super) path: &'static str,
    /// Name of the operation in OpenAPI.
    pub(super) id: &'static str,
    pub(super) summary: &'static str,
    pub(super) description: &'static str,
    pub(super) parameters: &'static [Parameter],
    /// Media types of the answer. The first one is preferred.
    pub(super) media: &'static [&'static str],
    /// Schema of the answer.
    pub(super) schema: fn(&mut SchemaGenerator) -> Value,
    /// Additional answers without content, with their meaning.
    pub(super) empty: &'static [(u16, &'static str)],
    /// Problems of this endpoint, in addition to those of every endpoint.
    pub(super) problems: &'static [ProblemKind],
    pub(super) handler: Handler,
}

/// Answer of a handler, which comes later.
pub(super) type Answer = Pin<Box<dyn Future<Output = Result<Response, Problem>> + Send>>;
/// Function that answers a request whose parameters were read.
pub(super) type Handler = fn(Call) -> Answer;

/// Request whose parameters were read.
pub(super) struct Call {
    pub(super) page: Shared,
    pub(super) access: ProgramAccess,
    pub(super) arguments: Arguments,
    pub(super) headers: HeaderMap,
    /// Media type that the client prefers.
    pub(super) media: &'static str,
}

/// Parameters of a path, as axum reads them.
type PathPairs = Result<Path<Vec<(String, String)>>, PathRejection>;

impl Endpoint {
    /// Returns the route of this endpoint. Every method other than GET and HEAD is refused.
    pub(super) fn route(&'static self) -> MethodRouter<Shared> {
        let answer = move |State(page): State<Shared>,
                           Extension(access): Extension<ProgramAccess>,
                           path: PathPairs,
                           uri: Uri,
                           headers: HeaderMap| async move {
            match self.call(page, access, path, &uri, headers) {
                Ok(call) => (self.handler)(call).await.unwrap_or_else(Problem::into_response),
                Err(problem) => problem.into_response(),
            }
        };
        get(answer).fallback(wrong_method)
    }

    /// Reads the parameters of a request, and chooses the media type of its answer.
    fn call(
        &self,
        page: Shared,
        access: ProgramAccess,
        path: PathPairs,
        uri: &Uri,
        headers: HeaderMap,
    ) -> Result<Call, Problem> {
        let media = acceptable(&headers, self.media)?;
        let Path(path) = path.map_err(|_| {
            Problem::new(ProblemKind::Parameter, "a parameter in the path is not percent-encoded UTF-8")
        })?;
        let arguments = Arguments::read(self.parameters, &path, uri.query(), &headers)?;
        Ok(Call { page, access, arguments, headers, media })
    }
}

/// Returns the media type of `offered` that the client prefers.
///
/// # Errors
/// The client accepts none of them.
pub(super) fn acceptable(headers: &HeaderMap, offered: &[&'static str]) -> Result<&'static str, Problem> {
    preferred(headers, offered).ok_or_else(|| {
        let allowed = offered.join(", ");
        let detail = format!("the answer has the media type {allowed}");
        Problem::new(ProblemKind::NotAcceptable, detail).with_allowed(allowed)
    })
}

/// Refuses a method that this interface does not have.
pub(super) async fn wrong_method() -> Problem {
    Problem::new(ProblemKind::WrongMethod, "this address has only the methods GET and HEAD")
}

/// Refuses an address that does not exist.
pub(super) async fn unknown_address() -> Problem {
    Problem::new(ProblemKind::UnknownAddress, "nothing is at this address")
}

impl Call {
    /// Returns the name of the run that the request names.
    pub(super) fn run(&self) -> String {
        self.arguments.text("run").unwrap_or_default().to_owned()
    }

    /// Returns the folder of the run that the request names.
    ///
    /// # Errors
    /// There is no such run.
    pub(super) fn folder(&self) -> Result<PathBuf, Problem> {
        let run = self.run();
        self.page.history.folder(&run).ok_or_else(|| unknown_run(&run))
    }

    /// Returns the folder and the summary of the run that the request names.
    ///
    /// # Errors
    /// There is no such run, or its record cannot be read.
    pub(super) async fn summary(&self) -> Result<(PathBuf, Arc<RunSummary>), Problem> {
        let (page, run) = (Shared::clone(&self.page), self.run());
        blocking(move || {
            let folder = page.history.folder(&run).ok_or_else(|| unknown_run(&run))?;
            let summary = page.history.summary(&folder).ok_or_else(|| unreadable_record(&run))?;
            Ok((folder, summary))
        })
        .await
    }
}

/// Returns the problem that the run named `run` does not exist.
fn unknown_run(run: &str) -> Problem {
    Problem::new(ProblemKind::UnknownRun, format!("there is no run {:?}", crate::problem::shortened(run)))
}

/// Returns the problem that the record of the run named `run` cannot be read.
pub(super) fn unreadable_record(run: &str) -> Problem {
    Problem::new(ProblemKind::UnreadableRecord, format!("the record of the run {run:?} cannot be read"))
}

/// Permits to read records and files. A map takes much memory, and a further reader waits.
static READERS: Semaphore = Semaphore::const_new(16);

/// Runs `read` in a separate thread, because it can block, and returns its result. At most 16 of them run at a time.
///
/// # Errors
/// The error of `read`, or a fault of the program.
pub(super) async fn blocking<T: Send + 'static>(
    read: impl FnOnce() -> Result<T, Problem> + Send + 'static,
) -> Result<T, Problem> {
    let fault = || Problem::new(ProblemKind::Fault, "a part of the page failed");
    let _permit = READERS.acquire().await.map_err(|_| fault())?;
    spawn_blocking(read).await.unwrap_or_else(|_| Err(fault()))
}

/// Returns a response with `content` as JSON, which changes at any time.
pub(super) fn json(content: &impl Serialize) -> Result<Response, Problem> {
    Ok(response("application/json", "no-store", to_json(content)?))
}

/// Returns `content` as JSON.
///
/// # Errors
/// A fault of the program: the content has a key that is not a text.
pub(super) fn to_json(content: &impl Serialize) -> Result<Vec<u8>, Problem> {
    serde_json::to_vec(content).map_err(|error| Problem::new(ProblemKind::Fault, error.to_string()))
}

/// Returns a response with the bytes `body`.
pub(super) fn response(media: &'static str, cache: &'static str, body: Vec<u8>) -> Response {
    use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
    ([(CONTENT_TYPE, media), (CACHE_CONTROL, cache)], body).into_response()
}

/// Returns a response with the bytes `body`, which change rarely. Returns the status 304 (not modified) without a body if
/// the client has them already, as `headers` say.
pub(super) fn unless_known(headers: &HeaderMap, media: &'static str, body: Vec<u8>) -> Response {
    use axum::http::StatusCode;
    use axum::http::header::{CONTENT_TYPE, ETAG, IF_NONE_MATCH};
    let hash = HEXLOWER.encode(&Sha256::digest(&body)[..16]);
    let given = headers.get_all(IF_NONE_MATCH).iter().filter_map(|value| value.to_str().ok());
    let is_known = given.flat_map(|value| value.split(',')).any(|tag| {
        let tag = tag.trim();
        tag == "*" || tag.trim_start_matches("W/").trim_matches('"') == hash
    });
    let mut response = response(media, "private, no-cache", if is_known { Vec::new() } else { body });
    if is_known {
        *response.status_mut() = StatusCode::NOT_MODIFIED;
        response.headers_mut().remove(CONTENT_TYPE);
    }
    // Compression changes the bytes and not their content, so the tag is weak.
    if let Ok(tag) = HeaderValue::from_str(&format!("W/\"{hash}\"")) {
        response.headers_mut().insert(ETAG, tag);
    }
    response
}
