//! The journal's own thread. The loop gives it what is to be recorded, in order, and goes on; what may only be done once it is on
//! record waits for its [`Ticket`]. What cannot be written stays first in the queue and is tried again until it can.

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

/// Resolves once what was given is on the disk, or is known never to come there.
pub(super) type Ticket = oneshot::Receiver<Result<(), RecordFailure>>;

/// Between two looks for the files of the record, where nothing is to be written.
const BETWEEN_LOOKS: Duration = Duration::from_secs(1);
/// Between two tries to write what could not be written.
const BETWEEN_TRIES: Duration = Duration::from_millis(100);
/// Every so many tries it is told that they fail.
const TOLD_EVERY: u32 = 10;
/// How long the end of a run waits for its record.
pub(super) const PATIENCE: Duration = Duration::from_secs(5);

/// Where a run is recorded. What is acknowledged is on the disk; after an error the same may be given again, and stands once.
#[expect(missing_docs, reason = "as Journal has them")]
pub trait Ledger: Send {
    fn folder(&self) -> &Path;
    /// The serial number of the part; empty where nobody knows.
    fn part(&self) -> &str {
        ""
    }
    fn append(&mut self, entry: Entry) -> Result<u64, JournalError>;
    fn intend(&mut self, entry: Entry) -> Result<u32, JournalError>;
    fn adopt_known(&mut self, found: Artefact, mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError>;
    fn end(&mut self, mono_ns: u64, cycle: u32, ending: Value) -> Result<Anchor, JournalError>;
    /// Sees that the record lies where it is written.
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

/// What is to be recorded.
enum Job {
    Append(Box<Entry>),
    /// With the number by which [`Job::Outcome`] names it.
    Intend(u64, Box<Entry>),
    /// What became of an intent.
    Outcome(u64, Box<Entry>),
    Adopt(Vec<Artefact>, Duration, u32),
    Close(Duration, u32, Value),
    /// Sees that the record lies where it is written.
    Look,
}

type Given = (Job, oneshot::Sender<Result<(), RecordFailure>>);

/// The journal as the loop sees it.
pub(super) struct Recorder {
    given: Option<mpsc::UnboundedSender<Given>>,
    /// Hears of the first failure of each row of failures.
    failures: mpsc::UnboundedReceiver<RecordFailure>,
    /// Nobody waits any more: what cannot be written now is given up.
    given_up: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    folder: PathBuf,
    intents: u64,
}

impl Recorder {
    /// Takes a journal, with the numbers of the commands on it that no outcome has named, which are named by 1, 2, 3 from here on.
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

    /// Waits for a failure to record.
    pub(super) async fn failure(&mut self) -> RecordFailure {
        match self.failures.recv().await {
            Some(failure) => failure,
            None => std::future::pending().await,
        }
    }

    /// Records what happened.
    pub(super) fn append(&self, entry: Entry) -> Ticket {
        self.give(Job::Append(Box::new(entry)))
    }

    /// Records a command before it is carried out. Returns the number by which [`Recorder::outcome`] names it.
    pub(super) fn intend(&mut self, entry: Entry) -> (u64, Ticket) {
        self.intents += 1;
        (self.intents, self.give(Job::Intend(self.intents, Box::new(entry))))
    }

    /// Records what became of an intent.
    pub(super) fn outcome(&self, intent: u64, entry: Entry) -> Ticket {
        self.give(Job::Outcome(intent, Box::new(entry)))
    }

    /// Brings files of the run folder on record.
    pub(super) fn adopt(&self, files: Vec<Artefact>, now: Duration, cycle: u32) -> Ticket {
        self.give(Job::Adopt(files, now, cycle))
    }

    /// Writes the last record, if that can be done within a bounded time.
    pub(super) async fn close(&mut self, now: Duration, cycle: u32, ending: Value) -> Result<(), RecordFailure> {
        let closed = tokio::time::timeout(PATIENCE, self.give(Job::Close(now, cycle, ending))).await;
        self.given_up.store(true, Ordering::Release);
        if let Ok(Ok(closed)) = closed {
            return closed;
        }
        // It may hang in the operating system, and is not waited for.
        self.thread = None;
        let (folder, limit) = (self.folder.display(), PATIENCE.as_secs());
        Err(RecordFailure::Unwritable(format!("{folder}: the record could not be brought to its end within {limit} s")))
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
        // The lock on the run folder is free once this returns.
        self.given_up.store(true, Ordering::Release);
        drop(self.given.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Who writes.
struct Scribe {
    journal: Option<Box<dyn Ledger>>,
    /// The command numbers of the intents that no outcome has named.
    ids: HashMap<u64, u32>,
    failed: mpsc::UnboundedSender<RecordFailure>,
    given_up: Arc<AtomicBool>,
    /// Something was given up, and nothing is written behind it.
    broken_off: bool,
    beside: Beside,
}

impl Scribe {
    async fn keep(mut self, mut jobs: mpsc::UnboundedReceiver<Given>) {
        loop {
            match tokio::time::timeout(BETWEEN_LOOKS, jobs.recv()).await {
                Ok(Some((job, answer))) => {
                    // Who asked may have gone; the record stands all the same.
                    let _ = answer.send(self.until_written(&job).await.map_err(failure));
                }
                Ok(None) => return,
                // A pass may go on for long without a word: its record is looked for all the same.
                Err(_) => drop(self.until_written(&Job::Look).await),
            }
        }
    }

    /// Writes a job, however often that has to be tried. The loop is told that it does not go on, and again as long as that is so: what it
    /// hears in between may be of an earlier job.
    async fn until_written(&mut self, job: &Job) -> Result<(), JournalError> {
        let mut tries = 0_u32;
        loop {
            self.beside.take_its_time(Blocking::Record).await;
            let error = match self.write(job) {
                Ok(()) => return Ok(()),
                Err(error) if !error.may_pass() => {
                    // A gap among events and commands is the end of the record; a file that cannot come on it is none.
                    self.broken_off |= !matches!(job, Job::Adopt(..) | Job::Look);
                    return Err(error);
                }
                Err(error) if self.given_up.load(Ordering::Acquire) => {
                    // What follows would stand in the record as if nothing were missing before it.
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

/// Time since the run began as the journal counts it.
pub(super) fn nanoseconds(now: Duration) -> u64 {
    u64::try_from(now.as_nanos()).unwrap_or(u64::MAX)
}

/// Brings files of a run folder to the disk and reads them, for [`Recorder::adopt`]. Blocks, and takes its time for large ones.
pub(super) fn describe(folder: &Path, names: &[String]) -> Result<Vec<Artefact>, RecordFailure> {
    names.iter().map(|name| Artefact::of(folder, name).map_err(failure)).collect()
}

/// The files that a computation makes in one folder below that of the run. What of them is there when it is over goes on record, however it
/// ended.
pub(super) struct Files {
    run: PathBuf,
    below: String,
    /// Where what is not decided by yet goes in place of that: a batch of touches.
    settled: Option<String>,
    names: Vec<String>,
}

impl Files {
    pub(super) fn new(run: PathBuf, below: String) -> Self {
        Self { run, below, settled: None, names: Vec::new() }
    }

    /// The same, with the folder that [`Files::settle`] goes on to.
    pub(super) fn then(self, settled: String) -> Self {
        Self { settled: Some(settled), ..self }
    }

    /// Goes on to the folder of what the cell decides by, and makes it where it is another.
    pub(super) fn settle(&mut self) -> Result<(), FormatError> {
        let Some(settled) = self.settled.take() else { return Ok(()) };
        self.below = settled;
        ResultFolder::prepare(self.folder()).map(ResultFolder::keep)
    }

    pub(super) fn folder(&self) -> PathBuf {
        self.run.join(&self.below)
    }

    /// Keeps the name of a file that is about to be written, and returns where it goes.
    pub(super) fn place(&mut self, name: &str) -> PathBuf {
        let name = if self.below.is_empty() { name.to_owned() } else { format!("{}/{name}", self.below) };
        let path = self.run.join(&name);
        self.names.push(name);
        path
    }

    /// Returns the names of all that were to be made, below the folder of the run.
    pub(super) fn names(&self) -> &[String] {
        &self.names
    }

    /// Returns the names of those that were made.
    pub(super) fn made(self) -> Vec<String> {
        let Self { run, mut names, .. } = self;
        names.retain(|name| run.join(name).is_file());
        names
    }
}

/// Why a computation brought nothing: its files cannot be written, or for a reason of its own.
pub(super) enum Unfinished<T> {
    NotSaved(RecordFailure),
    For(T),
}

/// Tells an error of writing from any other by what the operating system said.
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

/// Returns an entry for something that happened.
pub(super) fn entry(kind: Kind, now: Duration, cycle: u32, actor: (String, String), payload: Value) -> Entry {
    let (actor, station) = actor;
    Entry { actor, station, ..Entry::new(kind, nanoseconds(now), cycle, payload) }
}
