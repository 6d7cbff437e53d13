//! What is known of each run that somebody looks at: one watcher a run, however many look.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use regrind_control::{Snapshot, watch};
use regrind_report::{RunResult, RunSummary};
use tokio::sync::watch::{Receiver, Sender};
use tokio::task::spawn_blocking;

use super::history::History;

/// Between two tries to find the program of a run that does not answer.
const BETWEEN_TRIES: Duration = Duration::from_secs(1);

/// What is known of a run.
#[derive(Clone, Default)]
pub(crate) struct Seen {
    /// What its program told last; none where none was heard.
    pub(crate) snapshot: Option<Arc<Snapshot>>,
    /// Whether that program is there.
    pub(crate) answers: bool,
    pub(crate) summary: Arc<RunSummary>,
}

impl Seen {
    /// Whether the run has neither an end on record nor a program that answers: what its machines do is not known.
    pub(crate) fn is_lost(&self) -> bool {
        !self.answers && self.summary.ended.is_none()
    }
}

pub(crate) struct Live {
    history: Arc<History>,
    watched: Mutex<HashMap<PathBuf, Sender<Seen>>>,
}

impl Live {
    pub(crate) fn new(history: Arc<History>) -> Self {
        Self { history, watched: Mutex::default() }
    }

    /// Returns what is known of a run, and what becomes known of it.
    pub(crate) fn look(self: &Live, folder: &Path) -> Receiver<Seen> {
        let mut watched = self.watched.lock().unwrap_or_else(PoisonError::into_inner);
        watched.retain(|_, seen| seen.receiver_count() > 0);
        if let Some(seen) = watched.get(folder) {
            return seen.subscribe();
        }
        let (seen, looked) = tokio::sync::watch::channel(Seen::default());
        watched.insert(folder.to_owned(), seen.clone());
        tokio::spawn(keep_watching(folder.to_owned(), Arc::clone(&self.history), seen));
        looked
    }
}

/// Watches a run until nobody looks any more.
async fn keep_watching(folder: PathBuf, history: Arc<History>, seen: Sender<Seen>) {
    let watching = async {
        loop {
            // Whatever ends it, the program may come again: a run is gone on with by another.
            let _ = follow(&folder, &history, &seen).await;
            let summary = read(&folder, &history).await;
            seen.send_if_modified(|now| {
                let changed = now.answers || now.summary.ended != summary.ended || now.summary.run != summary.run;
                (now.answers, now.summary) = (false, summary);
                changed
            });
            tokio::time::sleep(BETWEEN_TRIES).await;
        }
    };
    tokio::select! {
        () = watching => {}
        () = seen.closed() => {}
    }
}

/// Follows the program of a run for as long as it answers.
async fn follow(folder: &Path, history: &Arc<History>, seen: &Sender<Seen>) -> std::io::Result<()> {
    let mut watch = watch(folder).await?;
    let mut read_at = None;
    while let Some(snapshot) = watch.next().await? {
        // Measurements, judgements and alarms come with a new state.
        let at = (snapshot.number, snapshot.cycles.len());
        let summary = match read_at {
            Some(before) if before == at => Arc::clone(&seen.borrow().summary),
            _ => read(folder, history).await,
        };
        read_at = Some(at);
        let snapshot = Some(Arc::new(snapshot));
        seen.send_if_modified(|now| {
            let changed = now.snapshot != snapshot || !now.answers;
            *now = Seen { snapshot, answers: true, summary };
            changed
        });
    }
    Ok(())
}

async fn read(folder: &Path, history: &Arc<History>) -> Arc<RunSummary> {
    let (folder, history) = (folder.to_owned(), Arc::clone(history));
    spawn_blocking(move || history.summary(&folder)).await.ok().flatten().unwrap_or_default()
}

/// Returns whether a part was accepted, was not, or is not told.
pub(crate) fn verdict(seen: &Seen) -> Option<bool> {
    match seen.summary.result {
        RunResult::Accepted => Some(true),
        RunResult::NotAccepted | RunResult::Aborted | RunResult::Stopped => Some(false),
        _ => None,
    }
}
