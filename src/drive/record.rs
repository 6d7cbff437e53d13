//! Thread of the journal. The loop queues the entries in order and continues. An action that needs a record waits for
//! its [`Ticket`]. An entry that cannot be written stays first in the queue and is retried until it can be written.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use serde_json::Value;
use tokio::sync::{mpsc, oneshot};

use super::beside::{Beside, Blocking};
use crate::cell::RecordFailure;
use crate::formats::{FormatError, ResultFolder};
use crate::journal::{Anchor, Artefact, Entry, Journal, JournalError, Kind};

/// Result of a record: resolves when it is on the disk, or when it is certain that it never will be.
pub(super) type Ticket = oneshot::Receiver<Result<(), RecordFailure>>;

/// Interval between two checks of the record files while nothing is written.
const BETWEEN_LOOKS: Duration = Duration::from_secs(1);
/// Interval between two attempts to write an entry.
const BETWEEN_TRIES: Duration = Duration::from_millis(100);
/// Number of failed attempts between two reports of the failure.
const TOLD_EVERY: u32 = 10;
/// Maximum wait for the record at the end of a run.
pub(super) const PATIENCE: Duration = Duration::from_secs(5);

/// Storage of a run's record. An acknowledged entry is on the disk. After an error the same entry may be given again;
/// it is stored once (idempotent).
#[expect(missing_docs, reason = "as Journal has them")]
pub trait Ledger: Send {
    fn folder(&self) -> &Path;
    /// Returns the serial number of the part; empty if it is not known.
    fn part(&self) -> &str {
        ""
    }
    fn append(&mut self, entry: Entry) -> Result<u64, JournalError>;
    fn intend(&mut self, entry: Entry) -> Result<u32, JournalError>;
    fn adopt_known(&mut self, found: Artefact, mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError>;
    fn end(&mut self, mono_ns: u64, cycle: u32, ending: Value) -> Result<Anchor, JournalError>;
    /// Checks that the record is where it was written.
    fn is_in_place(&mut self) -> Result<(), JournalError> {
        Ok(())
    }
}

impl Ledger for Journal {
    fn folder(&self) -> &Path {
        self.folder()
    }
    fn part(&self) -> &str {
        self.part()
    }
    fn append(&mut self, entry: Entry) -> Result<u64, JournalError> {
        self.append(entry)
    }
    fn intend(&mut self, entry: Entry) -> Result<u32, JournalError> {
        self.intend(entry)
    }
    fn adopt_known(&mut self, found: Artefact, mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError> {
        self.adopt_known(found, mono_ns, cycle)
    }
    fn end(&mut self, mono_ns: u64, cycle: u32, ending: Value) -> Result<Anchor, JournalError> {
        self.end(mono_ns, cycle, ending)
    }
    fn is_in_place(&mut self) -> Result<(), JournalError> {
        self.is_in_place()
    }
}

/// Work for the journal.
enum Job {
    Append(Box<Entry>),
    /// Intent, with the number by which [`Job::Outcome`] refers to it.
    Intend(u64, Box<Entry>),
    /// Outcome of an intent.
    Outcome(u64, Box<Entry>),
    Adopt(Vec<Artefact>, Duration, u32),
    Close(Duration, u32, Value),
    /// Check that the record is where it was written.
    Look,
}

type Given = (Job, oneshot::Sender<Result<(), RecordFailure>>);

/// Journal, as the loop uses it.
pub(super) struct Recorder {
    given: Option<mpsc::UnboundedSender<Given>>,
    /// Failures to write: the first one of each series, and repeated reports while it lasts.
    failures: mpsc::UnboundedReceiver<RecordFailure>,
    /// True if no one waits any more: an entry that cannot be written now is given up.
    given_up: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    folder: PathBuf,
    intents: u64,
}

impl Recorder {
    /// Creates a recorder for a journal. `open` are the numbers of the recorded commands that have no outcome yet. This
    /// recorder refers to them by 1, 2, 3 from now on.
    pub(super) fn new(journal: Box<dyn Ledger>, open: &[u32], beside: &Beside) -> Self {
        let (given, jobs) = mpsc::unbounded_channel();
        let (failed, failures) = mpsc::unbounded_channel();
        let given_up = Arc::new(AtomicBool::new(false));
        let folder = journal.folder().to_owned();
        let scribe = Scribe {
            journal: Some(journal),
            ids: (1..).zip(open.iter().copied()).collect(),
            failed,
            given_up: given_up.clone(),
            broken_off: false,
            beside: beside.clone(),
        };
        let thread = beside.attend("journal", scribe.keep(jobs));
        Self { given: Some(given), failures, given_up, thread, folder, intents: open.len() as u64 }
    }

    pub(super) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Waits for a failure to write a record.
    pub(super) async fn failure(&mut self) -> RecordFailure {
        match self.failures.recv().await {
            Some(failure) => failure,
            None => std::future::pending().await,
        }
    }

    /// Records an event.
    pub(super) fn append(&self, entry: Entry) -> Ticket {
        self.give(Job::Append(Box::new(entry)))
    }

    /// Records a command before it is executed. Returns the number by which [`Recorder::outcome`] refers to it.
    pub(super) fn intend(&mut self, entry: Entry) -> (u64, Ticket) {
        self.intents += 1;
        (self.intents, self.give(Job::Intend(self.intents, Box::new(entry))))
    }

    /// Records the outcome of an intent.
    pub(super) fn outcome(&self, intent: u64, entry: Entry) -> Ticket {
        self.give(Job::Outcome(intent, Box::new(entry)))
    }

    /// Records files of the run folder.
    pub(super) fn adopt(&self, files: Vec<Artefact>, now: Duration, cycle: u32) -> Ticket {
        self.give(Job::Adopt(files, now, cycle))
    }

    /// Writes the last record, within a bounded time.
    pub(super) async fn close(&mut self, now: Duration, cycle: u32, ending: Value) -> Result<(), RecordFailure> {
        let closed = tokio::time::timeout(PATIENCE, self.give(Job::Close(now, cycle, ending))).await;
        self.given_up.store(true, Ordering::Release);
        if let Ok(Ok(closed)) = closed {
            return closed;
        }
        // The thread may hang in the operating system, so do not wait for it.
        self.thread = None;
        let (folder, limit) = (self.folder.display(), PATIENCE.as_secs());
        Err(RecordFailure::Unwritable(format!("{folder}: the record could not be closed within {limit} s")))
    }

    fn give(&self, job: Job) -> Ticket {
        let (answer, ticket) = oneshot::channel();
        // A thread that has ended drops the ticket, which is a failure too.
        let _ = self.given.as_ref().expect("open until dropped").send((job, answer));
        ticket
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        // The lock on the run folder is free when this returns.
        self.given_up.store(true, Ordering::Release);
        drop(self.given.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Writer of the journal.
struct Scribe {
    journal: Option<Box<dyn Ledger>>,
    /// Command numbers of the intents that have no outcome yet.
    ids: HashMap<u64, u32>,
    failed: mpsc::UnboundedSender<RecordFailure>,
    given_up: Arc<AtomicBool>,
    /// True if an entry was given up. After that nothing is written.
    broken_off: bool,
    beside: Beside,
}

impl Scribe {
    async fn keep(mut self, mut jobs: mpsc::UnboundedReceiver<Given>) {
        loop {
            match tokio::time::timeout(BETWEEN_LOOKS, jobs.recv()).await {
                Ok(Some((job, answer))) => {
                    // The person who asked may be gone; the record stays.
                    let _ = answer.send(self.until_written(&job).await.map_err(failure));
                }
                Ok(None) => return,
                // A pass may continue for long without an event: still check its record.
                Err(_) => drop(self.until_written(&Job::Look).await),
            }
        }
    }

    /// Writes a job, with as many attempts as necessary. Reports the failure to the loop, and again as long as it
    /// lasts, because an earlier report may be about an earlier job.
    async fn until_written(&mut self, job: &Job) -> Result<(), JournalError> {
        let mut tries = 0_u32;
        loop {
            self.beside.take_its_time(Blocking::Record).await;
            let error = match self.write(job) {
                Ok(()) => return Ok(()),
                Err(error) if !error.may_pass() => {
                    // A missing event or command ends the record. A file that cannot be recorded does not.
                    self.broken_off |= !matches!(job, Job::Adopt(..) | Job::Look);
                    return Err(error);
                }
                Err(error) if self.given_up.load(Ordering::Acquire) => {
                    // Later entries would look as if nothing were missing before them.
                    self.broken_off |= !matches!(job, Job::Look);
                    return Err(error);
                }
                Err(error) => error,
            };
            if tries.is_multiple_of(TOLD_EVERY) {
                let _ = self.failed.send(failure(error));
            }
            tries = tries.wrapping_add(1);
            tokio::time::sleep(BETWEEN_TRIES).await;
        }
    }

    fn write(&mut self, job: &Job) -> Result<(), JournalError> {
        let Some(journal) = self.journal.as_mut() else { return Ok(()) };
        if self.broken_off {
            return Err(JournalError::Closed { path: journal.folder().to_owned() });
        }
        match job {
            Job::Append(entry) => journal.append(Entry::clone(entry)).map(drop),
            Job::Intend(intent, entry) => {
                let id = journal.intend(Entry::clone(entry))?;
                self.ids.insert(*intent, id);
                Ok(())
            }
            Job::Outcome(intent, entry) => {
                let command_id = self.ids.get(intent).copied();
                journal.append(Entry { kind: Kind::Outcome, command_id, ..Entry::clone(entry) })?;
                self.ids.remove(intent);
                Ok(())
            }
            Job::Adopt(files, now, cycle) => {
                files.iter().try_for_each(|file| journal.adopt_known(file.clone(), nanoseconds(*now), *cycle).map(drop))
            }
            Job::Look => journal.is_in_place(),
            Job::Close(now, cycle, ending) => {
                journal.end(nanoseconds(*now), *cycle, ending.clone())?;
                self.journal = None;
                Ok(())
            }
        }
    }
}

/// Returns the time since the run began in the unit of the journal, ns.
pub(super) fn nanoseconds(now: Duration) -> u64 {
    u64::try_from(now.as_nanos()).unwrap_or(u64::MAX)
}

/// Writes files of a run folder to the disk and reads them, for [`Recorder::adopt`]. Blocks, and takes long for large
/// files.
pub(super) fn describe(folder: &Path, names: &[String]) -> Result<Vec<Artefact>, RecordFailure> {
    names.iter().map(|name| Artefact::of(folder, name).map_err(failure)).collect()
}

/// Files that a computation makes in one folder below that of the run. Those that exist when the computation ends are
/// recorded, whatever its result is.
pub(super) struct Files {
    run: PathBuf,
    below: String,
    /// Folder that replaces `below` when the result is settled. Before that, `below` is the folder of a batch of
    /// touches.
    settled: Option<String>,
    names: Vec<String>,
}

impl Files {
    pub(super) fn new(run: PathBuf, below: String) -> Self {
        Self { run, below, settled: None, names: Vec::new() }
    }

    /// Sets the folder that [`Files::settle`] switches to.
    pub(super) fn then(self, settled: String) -> Self {
        Self { settled: Some(settled), ..self }
    }

    /// Switches to the folder of the result on which the cell decides, and creates it if it is another one.
    pub(super) fn settle(&mut self) -> Result<(), FormatError> {
        let Some(settled) = self.settled.take() else { return Ok(()) };
        self.below = settled;
        ResultFolder::prepare(self.folder()).map(ResultFolder::keep)
    }

    pub(super) fn folder(&self) -> PathBuf {
        self.run.join(&self.below)
    }

    /// Stores the name of a file that is about to be written, and returns its path.
    pub(super) fn place(&mut self, name: &str) -> PathBuf {
        let name = if self.below.is_empty() { name.to_owned() } else { format!("{}/{name}", self.below) };
        let path = self.run.join(&name);
        self.names.push(name);
        path
    }

    /// Returns the names of all planned files, below the folder of the run.
    pub(super) fn names(&self) -> &[String] {
        &self.names
    }

    /// Returns the names of the files that exist.
    pub(super) fn made(self) -> Vec<String> {
        let Self { run, mut names, .. } = self;
        names.retain(|name| run.join(name).is_file());
        names
    }
}

/// Failure of a computation: its files cannot be written, or another reason.
pub(super) enum Unfinished<T> {
    NotSaved(RecordFailure),
    For(T),
}

/// Distinguishes a write error from other errors, by the error of the operating system.
pub(super) fn unfinished<E: std::error::Error + 'static>(error: E) -> Unfinished<String> {
    let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(&error);
    while let Some(next) = cause {
        if let Some(io) = next.downcast_ref::<std::io::Error>() {
            use std::io::ErrorKind::{QuotaExceeded, StorageFull};
            let is_full = matches!(io.kind(), StorageFull | QuotaExceeded);
            let why = if is_full { RecordFailure::DiskFull } else { RecordFailure::Unwritable };
            return Unfinished::NotSaved(why(error.to_string()));
        }
        cause = next.source();
    }
    Unfinished::For(error.to_string())
}

fn failure(error: JournalError) -> RecordFailure {
    if error.is_disk_full() {
        RecordFailure::DiskFull(error.to_string())
    } else {
        RecordFailure::Unwritable(error.to_string())
    }
}

/// Creates an entry for an event.
pub(super) fn entry(kind: Kind, now: Duration, cycle: u32, actor: (String, String), payload: Value) -> Entry {
    let (actor, station) = actor;
    Entry { actor, station, ..Entry::new(kind, nanoseconds(now), cycle, payload) }
}
