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
use serde::Deserialize;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::process::{Child, ChildStdout, Command};
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::{Instant, timeout, timeout_at};

use super::super::guard::{Session, foreign_origin};
use super::super::shared::Shared;
use super::access::{TOO_LONG, for_engineer, refused};
use super::state::Workbench;

/// Maximum duration of the check and plan of one text.
const MAX_DURATION: Duration = Duration::from_secs(120);
/// Maximum size of the answer of the child program, in bytes.
const MAX_ANSWER_BYTES: usize = 32 << 20;
/// Size of a piece of the answer, in bytes.
const PIECE_BYTES: usize = 64 << 10;

/// Maximum time for which a text waits for the checks of other texts.
const MAX_WAIT: Duration = Duration::from_secs(15);
/// Maximum duration of the check of a text that is to be saved, without its plan.
const MAX_CHECK_DURATION: Duration = Duration::from_secs(20);

/// Child program whose output goes to a browser. It ends when the browser has gone, because the value is dropped.
struct Answer {
    _child: Child,
    _permits: [OwnedSemaphorePermit; 2],
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
/// lines of JSON, each as soon as it is known. A browser that ends the connection ends the child program. A second text of
/// the same person waits for the first, so one person cannot stop the checks of others.
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
        return refused(StatusCode::PAYLOAD_TOO_LARGE, TOO_LONG);
    }
    let (own_turn, of_all) = (workbench.turn_of(&session.key_of_person()), Arc::clone(&workbench.drafts));
    let permits =
        timeout(
            MAX_WAIT,
            async move { Some([own_turn.acquire_owned().await.ok()?, of_all.acquire_owned().await.ok()?]) },
        );
    let Ok(Some(permits)) = permits.await else {
        return refused(StatusCode::SERVICE_UNAVAILABLE, "other texts are checked; wait a moment");
    };
    let started = started(workbench.programs.draft(&path).into(), body).map(|(child, output)| Answer {
        _child: child,
        _permits: permits,
        output,
        until: Instant::now() + MAX_DURATION,
        left_bytes: MAX_ANSWER_BYTES,
    });
    match started {
        Ok(answer) => {
            let pieces = unfold(answer, |mut answer| async {
                let piece = answer.next().await?;
                Some((Ok::<_, std::convert::Infallible>(piece), answer))
            });
            ([(CONTENT_TYPE, "application/x-ndjson")], Body::from_stream(pieces)).into_response()
        }
        Err(error) => refused(StatusCode::INTERNAL_SERVER_ERROR, cannot_start(&error)),
    }
}

fn cannot_start(error: &std::io::Error) -> String {
    format!("the program that checks recipes cannot start: {error}")
}

/// Checks a text that is to be saved as the recipe at `path`, without its plan.
///
/// # Errors
/// Returns the response to the browser if the text has a problem or cannot be checked.
pub(super) async fn checked(workbench: &Workbench, path: &std::path::Path, text: &str) -> Result<(), Response> {
    let failed = |words: String| refused(StatusCode::INTERNAL_SERVER_ERROR, words);
    let (_child, output) = started(workbench.programs.draft(path).into(), Bytes::copy_from_slice(text.as_bytes()))
        .map_err(|error| failed(cannot_start(&error)))?;
    let mut line = String::new();
    let mut output = BufReader::new(output.take(MAX_ANSWER_BYTES as u64));
    let read = timeout(MAX_CHECK_DURATION, output.read_line(&mut line)).await;
    let Ok(Checked { problems }) = serde_json::from_str(&line) else {
        let reason = if read.is_err() { "was not checked within 20 s" } else { "could not be checked" };
        return Err(failed(format!(
            "the text {reason}, so it is not saved; simplify it or its files, then save again"
        )));
    };
    match problems.first() {
        None => Ok(()),
        Some(first) => {
            let words = format!(
                "the text has a problem, so it is not saved: line {}: {} {}",
                first.line, first.key, first.found
            );
            Err(refused(StatusCode::UNPROCESSABLE_ENTITY, words))
        }
    }
}

/// First line of the output of the program that checks a text.
#[derive(Deserialize)]
struct Checked {
    problems: Vec<FoundProblem>,
}

#[derive(Deserialize)]
struct FoundProblem {
    line: usize,
    #[serde(default)]
    key: String,
    found: String,
}

/// Starts the child program `command` with `text` on its standard input. Returns it with its standard output.
fn started(mut command: Command, text: Bytes) -> std::io::Result<(Child, ChildStdout)> {
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null()).kill_on_drop(true);
    let mut child = command.spawn()?;
    let missing = || std::io::Error::other("it has no standard input or output");
    let mut input = child.stdin.take().ok_or_else(missing)?;
    let output = child.stdout.take().ok_or_else(missing)?;
    // A program that does not read is ended with its time.
    tokio::spawn(async move { input.write_all(&text).await });
    Ok((child, output))
}
