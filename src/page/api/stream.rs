//! Events of a run as a stream (server-sent events): each record as it is written, and the state while the run is under way.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::path::PathBuf;
use std::time::Duration;

use axum::http::StatusCode;
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream::unfold;
use regrind_report::{RecordChoice, RecordStamp, RunSummary, record_count, record_entries, record_stamp};
use serde::Serialize;
use tokio::sync::OwnedSemaphorePermit;
use tokio::sync::watch::Receiver;

use super::content::{EndOfRecord, RecordedEvent, RunState};
use super::endpoint::{Call, blocking, unreadable_record};
use super::runs::{MAX_PAGE_BYTES, choice, live, observed};
use crate::live::ObservedRun;
use crate::problem::{Problem, ProblemKind};
use crate::program_access::ProgramAccess;
use crate::shared::Shared;

/// Maximum time between two looks at the record, and between two checks of the access.
const LOOKS_AGAIN: Duration = Duration::from_secs(1);
/// Maximum time without a line. A client that gets none for longer can take the connection as lost.
const MAX_SILENCE: Duration = Duration::from_secs(15);
/// Maximum number of records that are read at once.
const RECORDS_AT_ONCE: usize = 100;

/// Client that follows a run.
struct RunStream {
    page: Shared,
    access: ProgramAccess,
    run: String,
    folder: PathBuf,
    show: RecordChoice,
    changes: Receiver<ObservedRun>,
    seen: ObservedRun,
    /// Number of the last record that was looked at.
    after: u64,
    /// Stamp of the record before it was read to its end; `None` if there is more to read.
    read_to_end_at: Option<RecordStamp>,
    /// Events that are not yet sent.
    events: VecDeque<Event>,
    /// State that was sent last.
    state: String,
    is_first: bool,
    is_over: bool,
    _permit: OwnedSemaphorePermit,
}

/// Answers with the stream of a run. A client that reconnects continues after the last record that it has. Responds with the
/// status 204 if the run has ended and the client has all of its records: it need not reconnect.
pub(super) async fn stream(call: Call) -> Result<Response, Problem> {
    let (folder, summary) = call.summary().await?;
    let (run, arguments) = (call.run(), &call.arguments);
    // A browser that reconnects repeats the address, so its header is newer.
    let after = arguments.number("Last-Event-ID").or_else(|| arguments.number("after")).unwrap_or_default();
    let last = {
        let (run, folder) = (run.clone(), folder.clone());
        blocking(move || record_count(&folder).map_err(|_| unreadable_record(&run))).await?
    };
    if after > last {
        let detail = format!("the client has records up to the number {after}; the record ends with the number {last}");
        return Err(Problem::new(ProblemKind::BeyondRecord, detail));
    }
    let is_live = live(&folder).await?;
    if after == last && is_complete(&summary, is_live) {
        return Ok(StatusCode::NO_CONTENT.into_response());
    }
    let permit = call.page.streams.clone().try_acquire_owned().map_err(|_| {
        Problem::new(ProblemKind::TooManyStreams, "as many streams are open as this page serves at a time")
    })?;
    let seen = observed(&call.page, &folder, &summary, is_live).await;
    let stream = RunStream {
        changes: call.page.run_watcher.subscribe(&folder),
        show: choice(arguments.text("show")),
        page: call.page,
        access: call.access,
        run,
        folder,
        seen,
        after,
        read_to_end_at: None,
        events: VecDeque::new(),
        state: String::new(),
        is_first: true,
        is_over: false,
        _permit: permit,
    };
    let stream = unfold(stream, |mut stream| async {
        let event = stream.next().await?;
        Some((Ok::<_, Infallible>(event), stream))
    });
    Ok(Sse::new(stream).keep_alive(KeepAlive::new().interval(MAX_SILENCE)).into_response())
}

/// Returns true if a run has ended, so that its record grows no more.
fn is_complete(summary: &RunSummary, is_live: bool) -> bool {
    summary.ended.is_some() && !is_live
}

impl RunStream {
    /// Waits for the next event of the run and returns it. Returns `None` after the last event of a run that has ended, and
    /// if the client no longer has access.
    async fn next(&mut self) -> Option<Event> {
        loop {
            if let Some(event) = self.events.pop_front() {
                return Some(event);
            }
            if self.is_over {
                return None;
            }
            if !std::mem::take(&mut self.is_first) && self.read_to_end_at.is_some() {
                self.wait().await?;
            }
            if !self.access.holds(&self.page.guard) {
                return None;
            }
            if let Err(problem) = self.read().await {
                self.is_over = true;
                return event("problem", &problem);
            }
        }
    }

    /// Waits until the run changes, at most [`LOOKS_AGAIN`]. Returns `None` if the watcher of the run has ended.
    async fn wait(&mut self) -> Option<()> {
        if let Ok(Err(_)) = tokio::time::timeout(LOOKS_AGAIN, self.changes.changed()).await {
            return None;
        }
        let seen = self.changes.borrow_and_update().clone();
        // The watcher has just started.
        if !seen.summary.last.is_empty() {
            self.seen = seen;
        }
        Some(())
    }

    /// Reads the next records of the run, and its state if all records are read.
    async fn read(&mut self) -> Result<(), Problem> {
        let (run, folder, show, after) = (self.run.clone(), self.folder.clone(), self.show, self.after);
        let known = self.read_to_end_at;
        // The end is on record before the program of the run goes.
        let is_complete = is_complete(&self.seen.summary, self.seen.answers);
        let (stamp, read) = blocking(move || {
            let stamp = record_stamp(&folder);
            if known == Some(stamp) {
                return Ok((stamp, (Vec::new(), after)));
            }
            let found = record_entries(&folder, show, after, (RECORDS_AT_ONCE, MAX_PAGE_BYTES));
            Ok((stamp, found.map_err(|_| unreadable_record(&run))?))
        })
        .await?;
        let (entries, after) = read;
        self.read_to_end_at = entries.is_empty().then_some(stamp);
        self.after = after;
        for entry in entries.into_iter().map(RecordedEvent::from) {
            let number = entry.sequence.to_string();
            self.events.extend(event("record", &entry).map(|event| event.id(number)));
        }
        if self.read_to_end_at.is_some() {
            self.add_state();
            if is_complete {
                // With the number of the last record, a browser that reconnects is told that there is no more.
                let end = event("end", &EndOfRecord { last: self.after });
                self.events.extend(end.map(|event| event.id(self.after.to_string())));
                self.is_over = true;
            }
        }
        Ok(())
    }

    /// Adds the state of the run to the events, if it differs from the state that was sent last.
    fn add_state(&mut self) {
        let state = serde_json::to_string(&RunState::new(&self.run, &self.seen)).unwrap_or_default();
        if state != self.state {
            self.events.push_back(Event::default().event("state").data(&state));
            self.state = state;
        }
    }
}

/// Returns an event with `content` as JSON.
fn event(name: &str, content: &impl Serialize) -> Option<Event> {
    Event::default().event(name).json_data(content).ok()
}
