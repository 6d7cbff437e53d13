//! The journal's own thread: the loop asks it and waits for the disk, the asynchronous threads do not.

use std::path::PathBuf;
use std::thread::JoinHandle;
use std::time::Duration;

use serde_json::Value;
use tokio::sync::{mpsc, oneshot};

use crate::cell::RecordFailure;
use crate::journal::{Artefact, Entry, Journal, JournalError, Kind};

/// One thing for the journal to do.
enum Errand {
    Append(Box<Entry>, oneshot::Sender<Result<(), RecordFailure>>),
    Intend(Box<Entry>, oneshot::Sender<Result<u32, RecordFailure>>),
    Adopt(Vec<Artefact>, Duration, u32, oneshot::Sender<Result<(), RecordFailure>>),
    Close(Duration, u32, Value, oneshot::Sender<Result<(), RecordFailure>>),
}

/// The journal as the loop sees it.
pub(super) struct Recorder {
    errands: Option<mpsc::UnboundedSender<Errand>>,
    thread: Option<JoinHandle<()>>,
    folder: PathBuf,
}

impl Recorder {
    pub(super) fn new(journal: Journal) -> Self {
        let (errands, asked) = mpsc::unbounded_channel();
        let folder = journal.folder().to_owned();
        let thread = std::thread::Builder::new().name("journal".into()).spawn(move || keep(journal, asked));
        Self { errands: Some(errands), thread: Some(thread.expect("a thread can be had")), folder }
    }

    pub(super) fn folder(&self) -> &std::path::Path {
        &self.folder
    }

    /// Records what happened; on return it is on the disk.
    pub(super) async fn append(&self, entry: Entry) -> Result<(), RecordFailure> {
        self.ask(|answer| Errand::Append(Box::new(entry), answer)).await
    }

    /// Records a command before it is carried out and returns its number.
    pub(super) async fn intend(&self, entry: Entry) -> Result<u32, RecordFailure> {
        self.ask(|answer| Errand::Intend(Box::new(entry), answer)).await
    }

    /// Brings files of the run folder on record.
    pub(super) async fn adopt(&self, files: Vec<Artefact>, now: Duration, cycle: u32) -> Result<(), RecordFailure> {
        self.ask(|answer| Errand::Adopt(files, now, cycle, answer)).await
    }

    /// Writes the last record.
    pub(super) async fn close(&self, now: Duration, cycle: u32, ending: Value) -> Result<(), RecordFailure> {
        self.ask(|answer| Errand::Close(now, cycle, ending, answer)).await
    }

    async fn ask<T>(
        &self,
        errand: impl FnOnce(oneshot::Sender<Result<T, RecordFailure>>) -> Errand,
    ) -> Result<T, RecordFailure> {
        let gone = || RecordFailure::Unwritable("the thread of the journal has ended".into());
        let (answer, answered) = oneshot::channel();
        let errands = self.errands.as_ref().expect("open until dropped");
        errands.send(errand(answer)).map_err(|_| gone())?;
        answered.await.map_err(|_| gone())?
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        // The lock on the run folder is free once this returns.
        drop(self.errands.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn keep(journal: Journal, mut asked: mpsc::UnboundedReceiver<Errand>) {
    let mut journal = Some(journal);
    // Who asked may have gone; the record stands all the same.
    while let Some(errand) = asked.blocking_recv() {
        let Some(open) = journal.as_mut() else { continue };
        match errand {
            Errand::Append(entry, answer) => drop(answer.send(open.append(*entry).map(|_| ()).map_err(failure))),
            Errand::Intend(entry, answer) => drop(answer.send(open.intend(*entry).map_err(failure))),
            Errand::Adopt(files, now, cycle, answer) => {
                let mut files = files.into_iter();
                let adopted = files.try_for_each(|file| open.adopt_known(file, nanoseconds(now), cycle).map(|_| ()));
                drop(answer.send(adopted.map_err(failure)));
            }
            Errand::Close(now, cycle, ending, answer) => {
                let open = journal.take().expect("it was open");
                drop(answer.send(open.close(nanoseconds(now), cycle, ending).map(|_| ()).map_err(failure)));
            }
        }
    }
}

/// Time since the run began as the journal counts it.
pub(super) fn nanoseconds(now: Duration) -> u64 {
    u64::try_from(now.as_nanos()).unwrap_or(u64::MAX)
}

/// Brings files of a run folder to the disk and reads them, for [`Recorder::adopt`]. Blocks, and takes its time for large ones.
pub(super) fn describe(folder: &std::path::Path, names: &[String]) -> Result<Vec<Artefact>, RecordFailure> {
    names.iter().map(|name| Artefact::of(folder, name).map_err(failure)).collect()
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
