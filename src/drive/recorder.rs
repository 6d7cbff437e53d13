//! Thread of the journal. The loop queues the entries in order and continues. An action that needs a record waits for
//! its [`RecordReceipt`]. An entry that cannot be written stays first in the queue and is retried until it can be
//! written.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use serde_json::Value;
use tokio::sync::{mpsc, oneshot};

use super::blocking_executor::{BlockingExecutor, BlockingWork};
use crate::cell::RecordFailure;
use crate::formats::run_files::CycleFile;
use crate::formats::{FormatError, ResultFolder};
use crate::journal::{Anchor, Artefact, Entry, Journal, JournalError, RecordKind};

/// Result of writing a record. It arrives when the record is on the disk, or when the record is given up.
pub(super) type RecordReceipt = oneshot::Receiver<Result<(), RecordFailure>>;

/// Interval between two checks of the record files while nothing is written.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// Interval between two attempts to write an entry.
const RETRY_INTERVAL: Duration = Duration::from_millis(100);
/// Number of failed attempts between two reports of the failure.
const ATTEMPTS_PER_REPORT: u32 = 10;
/// Maximum wait for the record at the end of a run.
pub(super) const CLOSE_TIMEOUT: Duration = Duration::from_secs(5);

/// Storage of a run's record. An acknowledged entry is on the disk. After an error the same entry may be given again;
/// it is stored once (idempotent).
#[expect(missing_docs, reason = "as Journal has them")]
pub trait JournalSink: Send {
    fn folder(&self) -> &Path;
    /// Returns the serial number of the part; empty if it is not known.
    fn serial(&self) -> &str {
        ""
    }
    fn append(&mut self, entry: Entry) -> Result<u64, JournalError>;
    fn intend(&mut self, entry: Entry) -> Result<u32, JournalError>;
    fn adopt_known(&mut self, found: Artefact, mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError>;
    fn end(&mut self, mono_ns: u64, cycle: u32, ending: Value) -> Result<Anchor, JournalError>;
    /// Returns an error if the files of the journal were removed or replaced after they were opened. The default checks
    /// nothing.
    fn is_in_place(&mut self) -> Result<(), JournalError> {
        Ok(())
    }
}

impl JournalSink for Journal {
    fn folder(&self) -> &Path {
        self.folder()
    }
    fn serial(&self) -> &str {
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
enum JournalTask {
    Append(Box<Entry>),
    /// Intent, with the number by which [`JournalTask::Outcome`] refers to it.
    Intent(u64, Box<Entry>),
    /// Outcome of an intent.
    Outcome(u64, Box<Entry>),
    Artefacts(Vec<Artefact>, Duration, u32),
    Close(Duration, u32, Value),
    /// Check that the record is where it was written.
    Check,
}

type QueuedTask = (JournalTask, oneshot::Sender<Result<(), RecordFailure>>);

/// Journal, as the loop uses it.
pub(super) struct Recorder {
    tasks: Option<mpsc::UnboundedSender<QueuedTask>>,
    /// Failures to write: the first one of each series, and repeated reports while it lasts.
    failures: mpsc::UnboundedReceiver<RecordFailure>,
    /// True if no action waits for records any more. An entry that cannot be written is then given up.
    abandoned: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    folder: PathBuf,
    intent_count: u64,
}

impl Recorder {
    /// Creates a recorder for `journal`. `open` are the commands without an outcome, by their numbers in the journal.
    /// The recorder gives these commands the intent numbers 1, 2, 3 and so on, in the order of `open`. `beside` is the
    /// executor on which the entries are written.
    pub(super) fn new(journal: Box<dyn JournalSink>, open: &[u32], beside: &BlockingExecutor) -> Self {
        let (given, jobs) = mpsc::unbounded_channel();
        let (failed, failures) = mpsc::unbounded_channel();
        let given_up = Arc::new(AtomicBool::new(false));
        let folder = journal.folder().to_owned();
        let scribe = JournalWriter {
            journal: Some(journal),
            command_ids: (1..).zip(open.iter().copied()).collect(),
            failures: failed,
            abandoned: given_up.clone(),
            closed: false,
            executor: beside.clone(),
        };
        let thread = beside.spawn_service("journal", scribe.run(jobs));
        Self { tasks: Some(given), failures, abandoned: given_up, thread, folder, intent_count: open.len() as u64 }
    }

    pub(super) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Waits until a record cannot be written, and returns the failure.
    pub(super) async fn next_failure(&mut self) -> RecordFailure {
        match self.failures.recv().await {
            Some(failure) => failure,
            None => std::future::pending().await,
        }
    }

    /// Queues an event to be recorded, and returns a receipt. The receipt completes when the event is on the disk or
    /// cannot be written.
    pub(super) fn append(&self, entry: Entry) -> RecordReceipt {
        self.enqueue(JournalTask::Append(Box::new(entry)))
    }

    /// Queues a command to be recorded before its execution (such a record is an intent). Returns the number of the
    /// intent, which [`Recorder::append_outcome`] requires. Also returns a receipt that completes when the intent is on
    /// the disk or cannot be written.
    pub(super) fn append_intent(&mut self, entry: Entry) -> (u64, RecordReceipt) {
        self.intent_count += 1;
        (self.intent_count, self.enqueue(JournalTask::Intent(self.intent_count, Box::new(entry))))
    }

    /// Queues the outcome of the command with the number `intent`, and returns a receipt that completes when it is on
    /// the disk or cannot be written.
    pub(super) fn append_outcome(&self, intent: u64, entry: Entry) -> RecordReceipt {
        self.enqueue(JournalTask::Outcome(intent, Box::new(entry)))
    }

    /// Queues a record of `files` of the run folder, with their lengths and hashes. Returns a receipt that completes
    /// when the record is on the disk or cannot be written. `now` is the time since the run began.
    pub(super) fn append_artefacts(&self, files: Vec<Artefact>, now: Duration, cycle: u32) -> RecordReceipt {
        self.enqueue(JournalTask::Artefacts(files, now, cycle))
    }

    /// Writes the last record of the run, with `ending` as its content, and closes the journal. `now` is the time since
    /// the run began.
    ///
    /// # Errors
    /// The record cannot be written, or is not written within [`CLOSE_TIMEOUT`].
    pub(super) async fn close(&mut self, now: Duration, cycle: u32, ending: Value) -> Result<(), RecordFailure> {
        let closed = tokio::time::timeout(CLOSE_TIMEOUT, self.enqueue(JournalTask::Close(now, cycle, ending))).await;
        self.abandoned.store(true, Ordering::Release);
        if let Ok(Ok(closed)) = closed {
            return closed;
        }
        // The thread may hang in the operating system, so do not wait for it.
        self.thread = None;
        let (folder, limit) = (self.folder.display(), CLOSE_TIMEOUT.as_secs());
        Err(RecordFailure::Unwritable(format!("{folder}: the record could not be closed within {limit} s")))
    }

    fn enqueue(&self, job: JournalTask) -> RecordReceipt {
        let (answer, ticket) = oneshot::channel();
        // A thread that has ended drops the ticket, which is a failure too.
        let _ = self.tasks.as_ref().expect("open until dropped").send((job, answer));
        ticket
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        // The lock on the run folder is free when this returns.
        self.abandoned.store(true, Ordering::Release);
        drop(self.tasks.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Writer of the journal.
struct JournalWriter {
    journal: Option<Box<dyn JournalSink>>,
    /// Command numbers of the intents that have no outcome yet.
    command_ids: HashMap<u64, u32>,
    failures: mpsc::UnboundedSender<RecordFailure>,
    abandoned: Arc<AtomicBool>,
    /// True if an entry was given up. After that no further entry is written.
    closed: bool,
    executor: BlockingExecutor,
}

impl JournalWriter {
    async fn run(mut self, mut jobs: mpsc::UnboundedReceiver<QueuedTask>) {
        loop {
            match tokio::time::timeout(CHECK_INTERVAL, jobs.recv()).await {
                Ok(Some((job, answer))) => {
                    // The person who asked may be gone; the record stays.
                    let _ = answer.send(self.write_with_retry(&job).await.map_err(record_failure));
                }
                Ok(None) => return,
                // A pass may continue for long without an event: still check its record.
                Err(_) => drop(self.write_with_retry(&JournalTask::Check).await),
            }
        }
    }

    /// Executes `job` (usually to write one entry) on the journal. If `job` fails for a temporary reason, for example a
    /// full disk, repeats it until it succeeds.
    ///
    /// Reports the failure to the loop of the run after the first attempt, and again after every tenth further attempt.
    ///
    /// # Errors
    /// The failure is not temporary, or the run has ended while the attempts were repeated.
    async fn write_with_retry(&mut self, job: &JournalTask) -> Result<(), JournalError> {
        let mut tries = 0_u32;
        loop {
            self.executor.wait_simulated_duration(BlockingWork::Record).await;
            let error = match self.write(job) {
                Ok(()) => return Ok(()),
                Err(error) if !error.may_pass() => {
                    // A missing event or command ends the record. A file that cannot be recorded does not.
                    self.closed |= !matches!(job, JournalTask::Artefacts(..) | JournalTask::Check);
                    return Err(error);
                }
                Err(error) if self.abandoned.load(Ordering::Acquire) => {
                    // Later entries would look as if nothing were missing before them.
                    self.closed |= !matches!(job, JournalTask::Check);
                    return Err(error);
                }
                Err(error) => error,
            };
            if tries.is_multiple_of(ATTEMPTS_PER_REPORT) {
                let _ = self.failures.send(record_failure(error));
            }
            tries = tries.wrapping_add(1);
            tokio::time::sleep(RETRY_INTERVAL).await;
        }
    }

    fn write(&mut self, job: &JournalTask) -> Result<(), JournalError> {
        let Some(journal) = self.journal.as_mut() else { return Ok(()) };
        if self.closed {
            return Err(JournalError::Closed { path: journal.folder().to_owned() });
        }
        match job {
            JournalTask::Append(entry) => journal.append(Entry::clone(entry)).map(drop),
            JournalTask::Intent(intent, entry) => {
                let id = journal.intend(Entry::clone(entry))?;
                self.command_ids.insert(*intent, id);
                Ok(())
            }
            JournalTask::Outcome(intent, entry) => {
                let command_id = self.command_ids.get(intent).copied();
                journal.append(Entry { kind: RecordKind::Outcome, command_id, ..Entry::clone(entry) })?;
                self.command_ids.remove(intent);
                Ok(())
            }
            JournalTask::Artefacts(files, now, cycle) => {
                files.iter().try_for_each(|file| journal.adopt_known(file.clone(), nanoseconds(*now), *cycle).map(drop))
            }
            JournalTask::Check => journal.is_in_place(),
            JournalTask::Close(now, cycle, ending) => {
                journal.end(nanoseconds(*now), *cycle, ending.clone())?;
                self.journal = None;
                Ok(())
            }
        }
    }
}

/// Converts a time since the run began into nanoseconds, the unit of the journal.
pub(super) fn nanoseconds(now: Duration) -> u64 {
    u64::try_from(now.as_nanos()).unwrap_or(u64::MAX)
}

/// Flushes the files `names` of a run folder to the disk and reads them back. Returns the name, length and hash of each
/// file, in the order of `names`, for [`Recorder::append_artefacts`]. Blocks the thread, and takes long for large
/// files.
///
/// # Errors
/// A file cannot be read, or the disk fails.
pub(super) fn sync_and_hash(folder: &Path, names: &[String]) -> Result<Vec<Artefact>, RecordFailure> {
    names.iter().map(|name| Artefact::from_file(folder, name).map_err(record_failure)).collect()
}

/// Files that a computation creates in one subfolder of the run folder. Those that exist when the computation ends are
/// recorded, whatever its result is.
pub(super) struct OutputFiles {
    run_folder: PathBuf,
    subfolder: String,
    /// Folder that replaces `subfolder` when the result of an adaptive measurement is final. Until then, `subfolder` is
    /// the folder of a batch of touches.
    final_subfolder: Option<String>,
    file_names: Vec<String>,
    /// Serial number of the part; empty if it is not known.
    serial: String,
}

impl OutputFiles {
    pub(super) fn new(run: PathBuf, below: String) -> Self {
        Self { run_folder: run, subfolder: below, final_subfolder: None, file_names: Vec::new(), serial: String::new() }
    }

    /// Sets the serial number of the part, which pictures show.
    pub(super) fn of_part(self, serial: &str) -> Self {
        Self { serial: serial.to_owned(), ..self }
    }

    pub(super) fn serial(&self) -> &str {
        &self.serial
    }

    /// Sets the subfolder for the final results of an adaptive measurement (targets are touched in batches until enough
    /// is known). `settled` is the path of this subfolder, relative to the run folder. Files still go to the subfolder
    /// of the current batch until [`OutputFiles::switch_to_final_subfolder`] is called.
    pub(super) fn with_final_subfolder(self, settled: String) -> Self {
        Self { final_subfolder: Some(settled), ..self }
    }

    /// Creates the subfolder for the final results of an adaptive measurement. All files that are added later go to
    /// this subfolder. [`OutputFiles::with_final_subfolder`] has set its path. Does nothing if no such subfolder was
    /// set, or if this method was already called.
    ///
    /// # Errors
    /// The subfolder cannot be created.
    pub(super) fn switch_to_final_subfolder(&mut self) -> Result<(), FormatError> {
        let Some(settled) = self.final_subfolder.take() else { return Ok(()) };
        self.subfolder = settled;
        ResultFolder::prepare(self.folder()).map(ResultFolder::keep)
    }

    pub(super) fn folder(&self) -> PathBuf {
        self.run_folder.join(&self.subfolder)
    }

    /// Adds a file, which the caller is about to write, to the list of files of this computation. Returns its path.
    pub(super) fn add_file(&mut self, file: CycleFile) -> PathBuf {
        self.add_named(file.name())
    }

    /// Adds a file as [`OutputFiles::add_file`] does, but by its name.
    pub(super) fn add_named(&mut self, name: &str) -> PathBuf {
        let name = if self.subfolder.is_empty() { name.to_owned() } else { format!("{}/{name}", self.subfolder) };
        let path = self.run_folder.join(&name);
        self.file_names.push(name);
        path
    }

    /// Returns the names of all files that were added, relative to the run folder. Some of them may not exist.
    pub(super) fn file_names(&self) -> &[String] {
        &self.file_names
    }

    /// Returns the names of the added files that exist, relative to the run folder.
    pub(super) fn into_existing(self) -> Vec<String> {
        let Self { run_folder: run, file_names: mut names, .. } = self;
        names.retain(|name| run.join(name).is_file());
        names
    }
}

/// Failure of a computation: its files cannot be written (`NotSaved`), or another reason (`Failed`).
pub(super) enum ComputationError<T> {
    NotSaved(RecordFailure),
    Failed(T),
}

/// Converts the error of a computation. If an error of the operating system caused it, the result was not saved
/// (`NotSaved`); otherwise the computation itself failed (`Failed`).
pub(super) fn classify_error<E: std::error::Error + 'static>(error: E) -> ComputationError<String> {
    let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(&error);
    while let Some(next) = cause {
        if let Some(io) = next.downcast_ref::<std::io::Error>() {
            use std::io::ErrorKind::{QuotaExceeded, StorageFull};
            let is_full = matches!(io.kind(), StorageFull | QuotaExceeded);
            let reason = if is_full { RecordFailure::DiskFull } else { RecordFailure::Unwritable };
            return ComputationError::NotSaved(reason(error.to_string()));
        }
        cause = next.source();
    }
    ComputationError::Failed(error.to_string())
}

fn record_failure(error: JournalError) -> RecordFailure {
    if error.is_disk_full() {
        RecordFailure::DiskFull(error.to_string())
    } else {
        RecordFailure::Unwritable(error.to_string())
    }
}
