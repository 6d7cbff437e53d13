//! Checks and plans a text while it is written, in a child program.

use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;

use axum::Extension;
use axum::body::{Body, Bytes};
use axum::extract::{Path, State};
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use futures_util::stream::unfold;
use regrind_formats::RecipeFolder;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::process::{Child, ChildStdout, Command};
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::{Instant, timeout_at};

use super::super::guard::{Session, foreign_origin};
use super::super::shared::Shared;
use super::access::{for_engineer, refused};

/// Maximum duration of the check and plan of one text.
const MAX_DURATION: Duration = Duration::from_secs(120);
/// Maximum size of the answer of the child program, in bytes.
const MAX_ANSWER_BYTES: usize = 32 << 20;
/// Size of a piece of the answer, in bytes.
const PIECE_BYTES: usize = 64 << 10;

/// Child program whose output goes to a browser. It ends when the browser has gone, because the value is dropped.
struct Answer {
    _child: Child,
    _permit: OwnedSemaphorePermit,
    output: ChildStdout,
    until: Instant,
    left_bytes: usize,
}

impl Answer {
    /// Returns the next piece of the output; `None` at its end, at the time limit and at the size limit.
    async fn next(&mut self) -> Option<Bytes> {
        let mut piece = vec![0; PIECE_BYTES.min(self.left_bytes)];
        let read = timeout_at(self.until, self.output.read(&mut piece)).await.ok()?.ok()?;
        piece.truncate(read);
        self.left_bytes -= read;
        (read > 0).then(|| piece.into())
    }
}

/// Checks and plans the text in `body` as the recipe named `name`. The response is the output of the child program:
/// lines of JSON, each as soon as it is known. A browser that ends the connection ends the child program.
pub(crate) async fn draft(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(name): Path<String>,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    // Nothing is changed, so no token is used up; but another page must not start programs.
    if let Some(what) = foreign_origin(&page.guard, &headers) {
        page.guard.refused(&what);
        return refused(StatusCode::FORBIDDEN, what);
    }
    let workbench = match for_engineer(&page, &session) {
        Ok(workbench) => workbench,
        Err(response) => return *response,
    };
    let Some(path) = workbench.recipes.file(&name) else {
        return refused(StatusCode::NOT_FOUND, "this is no name for a recipe");
    };
    if body.len() as u64 > RecipeFolder::MAX_BYTES {
        return refused(StatusCode::PAYLOAD_TOO_LARGE, "the text of a recipe has at most 1 MiB");
    }
    let Ok(permit) = Arc::clone(&workbench.drafts).acquire_owned().await else {
        return StatusCode::SERVICE_UNAVAILABLE.into_response();
    };
    match started(workbench.programs.draft(&path).into(), body, permit) {
        Ok(answer) => {
            let pieces = unfold(answer, |mut answer| async {
                let piece = answer.next().await?;
                Some((Ok::<_, std::convert::Infallible>(piece), answer))
            });
            ([(CONTENT_TYPE, "application/x-ndjson")], Body::from_stream(pieces)).into_response()
        }
        Err(error) => {
            refused(StatusCode::INTERNAL_SERVER_ERROR, format!("the program that checks recipes cannot start: {error}"))
        }
    }
}

/// Starts the child program `command` with `text` on its standard input.
fn started(mut command: Command, text: Bytes, permit: OwnedSemaphorePermit) -> std::io::Result<Answer> {
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null()).kill_on_drop(true);
    let mut child = command.spawn()?;
    let missing = || std::io::Error::other("it has no standard input or output");
    let mut input = child.stdin.take().ok_or_else(missing)?;
    let output = child.stdout.take().ok_or_else(missing)?;
    // A program that does not read is ended with its time.
    tokio::spawn(async move { input.write_all(&text).await });
    let until = Instant::now() + MAX_DURATION;
    Ok(Answer { _child: child, _permit: permit, output, until, left_bytes: MAX_ANSWER_BYTES })
}
