//! Updates of an open page: pieces of HTML, sent only if they differ from the last ones sent.

use std::convert::Infallible;
use std::time::Duration;

use axum::Extension;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::sse::{Event, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream::unfold;
use serde_json::{Map, Value, json};
use tokio::sync::watch::Receiver;

use super::guard::Session;
use super::live::ObservedRun;
use super::pieces::{Piece, run_pieces};
use super::reader::language;
use super::shared::Shared;
use super::view;
use super::viewers::Viewer;
use regrind_language::Language;

/// Maximum time between two messages of the stream. A browser that gets no message for longer shows that its figures
/// are old.
const MAX_SILENCE: Duration = Duration::from_secs(1);

/// Browser that shows a run.
struct RunEventStream {
    page: Shared,
    session: Session,
    language: Language,
    run: Receiver<ObservedRun>,
    /// Last version of each piece that was sent.
    sent: Vec<(Piece, String)>,
    is_first: bool,
    _viewer: Viewer,
}

pub(crate) async fn events(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(run): Path<String>,
    headers: HeaderMap,
) -> Response {
    let Some(folder) = page.history.folder(&run) else { return StatusCode::NOT_FOUND.into_response() };
    let seen = page.run_watcher.subscribe(&folder);
    let language = language(&headers);
    let _viewer = page.viewers.enter();
    let looking = RunEventStream { page, session, language, run: seen, sent: Vec::new(), is_first: true, _viewer };
    let stream = unfold(looking, |mut looking| async {
        let event = looking.next().await?;
        Some((Ok::<_, Infallible>(event), looking))
    });
    Sse::new(stream).into_response()
}

impl RunEventStream {
    /// Waits until the run changes, at most one second, and returns the next message for the browser. The first message
    /// comes at once if the status of the run is known. A message contains the changed pieces of the page as HTML and
    /// the state of the run as JSON. Returns `None` if the watcher of the run has ended, or if the browser no longer
    /// has access.
    async fn next(&mut self) -> Option<Event> {
        if !self.is_first {
            if let Ok(Err(_)) = tokio::time::timeout(MAX_SILENCE, self.run.changed()).await {
                return None;
            }
        } else if self.run.borrow().summary.run.is_empty() {
            // Nothing is known yet, because the watcher has just started.
            let _ = tokio::time::timeout(MAX_SILENCE, self.run.changed()).await;
        }
        self.is_first = false;
        if !self.page.guard.has_access(&self.session) {
            return None;
        }
        let seen = self.run.borrow_and_update().clone();
        let has_control = self.page.guard.has_control(&self.session, false);
        let mut pieces = Map::new();
        for (piece, html) in run_pieces(&seen, has_control || !self.session.may("control"), self.language) {
            match self.sent.iter_mut().find(|(sent, _)| *sent == piece) {
                Some((_, sent)) if *sent == html => continue,
                Some((_, sent)) => sent.clone_from(&html),
                None => self.sent.push((piece, html.clone())),
            }
            pieces.insert(piece.id().into(), Value::String(html));
        }
        let data = json!({ "pieces": pieces, "state": view::state(&seen, &self.session, has_control) });
        Event::default().json_data(data).ok()
    }
}
