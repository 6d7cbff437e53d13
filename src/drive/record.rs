//! The journal's own thread: the loop asks it and waits for the disk, the asynchronous threads do not.

use std::path::{Path, PathBuf};
use std::thread::JoinHandle;
use std::time::Duration;

use serde_json::Value;
use tokio::sync::{mpsc, oneshot};

use crate::cell::RecordFailure;
use crate::journal::{Artefact, Entry, Journal, JournalError, Kind};

/// What the thread of the journal is asked to do, while there is one that is open.
type JournalWork = Box<dyn FnOnce(&mut Option<Journal>) + Send>;

/// The journal as the loop sees it.
pub(super) struct Recorder {
    requests: Option<mpsc::UnboundedSender<JournalWork>>,
    thread: Option<JoinHandle<()>>,
    folder: PathBuf,
}

impl Recorder {
    pub(super) fn new(journal: Journal) -> Self {
        let (requests, asked) = mpsc::unbounded_channel();
        let folder = journal.folder().to_owned();
        let thread = std::thread::Builder::new().name("journal".into()).spawn(move || keep(journal, asked));
        Self { requests: Some(requests), thread: Some(thread.expect("a thread can be had")), folder }
    }

    pub(super) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Records what happened; on return it is on the disk.
    pub(super) async fn append(&self, entry: Entry) -> Result<(), RecordFailure> {
        self.ask(|journal| Some(journal.as_mut()?.append(entry).map(|_| ()))).await
    }

    /// Records a command before it is carried out and returns its number.
    pub(super) async fn intend(&self, entry: Entry) -> Result<u32, RecordFailure> {
        self.ask(|journal| Some(journal.as_mut()?.intend(entry))).await
    }

    /// Brings files of the run folder on record.
    pub(super) async fn adopt(&self, files: Vec<Artefact>, now: Duration, cycle: u32) -> Result<(), RecordFailure> {
        self.ask(move |journal| {
            let open = journal.as_mut()?;
            let mut files = files.into_iter();
            Some(files.try_for_each(|file| open.adopt_known(file, nanoseconds(now), cycle).map(|_| ())))
        })
        .await
    }

    /// Writes the last record.
    pub(super) async fn close(&self, now: Duration, cycle: u32, ending: Value) -> Result<(), RecordFailure> {
        self.ask(move |journal| Some(journal.take()?.close(nanoseconds(now), cycle, ending).map(|_| ()))).await
    }

    /// Has the journal's thread do some work, and returns what came of it; none comes of a journal that is closed.
    async fn ask<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Option<Journal>) -> Option<Result<T, JournalError>> + Send + 'static,
    ) -> Result<T, RecordFailure> {
        let gone = || RecordFailure::Unwritable("the thread of the journal has ended".into());
        let (answer, answered) = oneshot::channel();
        let work = move |journal: &mut Option<Journal>| {
            // Who asked may have gone; the record stands all the same.
            let _ = work(journal).map(|done| answer.send(done.map_err(failure)));
        };
        let requests = self.requests.as_ref().expect("open until dropped");
        requests.send(Box::new(work)).map_err(|_| gone())?;
        answered.await.map_err(|_| gone())?
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        // The lock on the run folder is free once this returns.
        drop(self.requests.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn keep(journal: Journal, mut asked: mpsc::UnboundedReceiver<JournalWork>) {
    let mut journal = Some(journal);
    while let Some(work) = asked.blocking_recv() {
        work(&mut journal);
    }
}

/// Time since the run began as the journal counts it.
pub(super) fn nanoseconds(now: Duration) -> u64 {
    u64::try_from(now.as_nanos()).unwrap_or(u64::MAX)
}

/// Brings files of a run folder to the disk and reads them, for [`Recorder::adopt`]. Blocks, and takes its time for large ones.
pub(super) fn describe(folder: &Path, names: &[String]) -> Result<Vec<Artefact>, RecordFailure> {
    names.iter().map(|name| Artefact::of(folder, name).map_err(failure)).collect()
}

/// The files that a computation makes in one folder. What of them is there when it is over goes on record, however it ended.
pub(super) struct Files {
    folder: PathBuf,
    names: Vec<&'static str>,
}

impl Files {
    pub(super) fn new(folder: PathBuf) -> Self {
        Self { folder, names: Vec::new() }
    }

    pub(super) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Keeps the name of a file that is about to be written, and returns where it goes.
    pub(super) fn place(&mut self, name: &'static str) -> PathBuf {
        self.names.push(name);
        self.folder.join(name)
    }

    /// Returns the names of those that were made.
    pub(super) fn made(self) -> Vec<&'static str> {
        let Self { folder, mut names } = self;
        names.retain(|name| folder.join(name).is_file());
        names
    }
}

fn failure(error: JournalError) -> RecordFailure {
    if error.is_disk_full() {
        RecordFailure::DiskFull(error.to_string())
    } else {
        RecordFailure::Unwritable(error.to_string())
    }
}

/// Returns an entry for something that happened.
pub(super) fn entry(kind: Kind, now: Duration, cycle: u32, actor: (String, String), payload: Value) -> Entry {
    let (actor, station) = actor;
    Entry { actor, station, ..Entry::new(kind, nanoseconds(now), cycle, payload) }
}
