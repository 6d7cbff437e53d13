//! Interface of the driver to the folders, so that the driver itself writes no file.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use super::ExchangeError;
use crate::Job;
use regrind_formats::operator_step::OperatorStep;

/// Two folders that represent a machine: one for hand-overs, one for answers.
///
/// Every operation except publishing is idempotent.
pub trait Exchange: std::fmt::Debug + Send + 'static {
    /// Request that is handed over.
    type Request: std::fmt::Debug + Send + 'static;
    /// Answer that comes back.
    type Answer: std::fmt::Debug + Clone + Send + 'static;

    /// Checks that the outbox can be written and the inbox can be read. The outbox is the folder of the hand-overs
    /// (requests to the machine); the inbox is the folder of the answers. Returns every hand-over in the outbox, also
    /// those of earlier runs, with the oldest first. Returns an error if one of the folders is not accessible, or if a
    /// hand-over cannot be read.
    fn open(&mut self) -> Result<Vec<HandOver>, ExchangeError>;

    /// Publishes `request` in the outbox as a hand-over (a folder with the files for the machine). The files are first
    /// written to a hidden folder. The folder is then renamed, so that all files appear at once. `job` is the job of
    /// the request. `sequence` is the start number of the hand-over, which increases from one hand-over to the next.
    /// `permit` allows the rename. A client that stops waiting can withdraw `permit` until the rename.
    ///
    /// # Errors
    /// Returns an error if this job and cycle were published before, if `permit` was withdrawn before the rename, or if
    /// the outbox cannot be written.
    fn publish(
        &mut self,
        job: Job,
        sequence: u32,
        request: &Self::Request,
        permit: &Permit,
    ) -> Result<(), ExchangeError>;

    /// Changes the status of the hand-over of `job` to `standing`, for example to held or stopped. Returns an error if
    /// the hand-over does not exist or cannot be changed.
    fn mark(&mut self, job: Job, standing: HandOverStatus) -> Result<(), ExchangeError>;

    /// Checks the inbox for the answer to the open hand-over of `job`. Returns the answer, or no answer if it is
    /// missing, incomplete or wrong. Also returns whether a person has confirmed that the machine has begun, and notes
    /// for a person, for example which files are awaited. `now` is the time since the driver was created. See
    /// [`PollResult`].
    fn poll(&mut self, now: Duration, job: Job) -> Result<PollResult<Self::Answer>, ExchangeError>;

    /// Returns the step that the open hand-over of `job` asks of a person. `start_confirmed` is true if the machine has
    /// begun. Returns `None` if this exchange describes what it waits for by notes alone.
    ///
    /// # Errors
    /// Returns an error if the hand-over cannot be read.
    fn step(&mut self, job: Job, start_confirmed: bool) -> Result<Option<OperatorStep>, ExchangeError>;

    /// Puts the file `_file` of a person into the inbox, as an answer to `job`. It is then checked like each file there.
    ///
    /// # Errors
    /// The default always returns an error: a confirmation needs no file.
    fn take_file(&mut self, job: Job, _file: &Path) -> Result<(), ExchangeError> {
        Err(ExchangeError::NotOpen { job: job.job, cycle: job.cycle })
    }

    /// Records that a person has confirmed a step of `job`. `_what` states the step: the machine has begun, or the
    /// machine has ended and the part is clear. `_map_identity` is the SHA-256 of the correction map of the job.
    ///
    /// The default always returns an error. The default is for machines that report their jobs only by files, without a
    /// confirmation by a person.
    fn confirm(&mut self, job: Job, _what: ConfirmedStep, _map_identity: [u8; 32]) -> Result<(), ExchangeError> {
        Err(ExchangeError::NotOpen { job: job.job, cycle: job.cycle })
    }
}

/// Permit to publish a hand-over. The client that waits for the hand-over withdraws the permit when it stops waiting.
/// The publishing thread uses the permit up immediately before the rename. After a withdrawal, the hand-over therefore
/// either never appears, or `withdraw` has returned that it may have appeared.
#[derive(Debug, Clone, Default)]
pub struct Permit(Arc<AtomicU8>);

const VALID: u8 = 0;
const USED: u8 = 1;
const WITHDRAWN: u8 = 2;

impl Permit {
    /// Creates a valid permit to publish one hand-over.
    pub fn new() -> Self {
        Self::default()
    }

    /// Uses up the permit immediately before a hand-over is published. Returns true if the permit was valid. Returns
    /// false if the permit was already used or withdrawn; then nothing may be published.
    pub fn use_up(&self) -> bool {
        self.0.compare_exchange(VALID, USED, Ordering::AcqRel, Ordering::Acquire).is_ok()
    }

    /// Withdraws the permit. Returns true if the permit was still valid; then the hand-over never appears. Returns
    /// false if the permit was already used or withdrawn; then the hand-over may have been published.
    pub(super) fn withdraw(&self) -> bool {
        self.0.swap(WITHDRAWN, Ordering::AcqRel) == VALID
    }

    /// Returns true if the permit was withdrawn.
    pub(super) fn is_withdrawn(&self) -> bool {
        self.0.load(Ordering::Acquire) == WITHDRAWN
    }
}

/// Fact that a person confirms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ConfirmedStep {
    /// The machine has begun.
    Started,
    /// The machine has ended, and the part is clear.
    Done,
}

/// Job, start number and status of a hand-over in the folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HandOver {
    /// Job that was handed over.
    pub job: Job,
    /// Start number; it increases from one hand-over to the next.
    pub sequence: u32,
    /// Status of the hand-over.
    pub status: HandOverStatus,
}

/// Status of a hand-over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum HandOverStatus {
    /// It waits for its answer.
    Open,
    /// It was withdrawn temporarily, by HOLD.
    Held,
    /// It was withdrawn permanently, by STOP.
    Stopped,
    /// It was withdrawn permanently, by ABORT.
    Aborted,
    /// Its answer was acknowledged.
    Closed,
}

/// Result of a check of the folders.
#[derive(Debug, Clone, PartialEq)]
pub struct PollResult<A> {
    /// Answer, if it is there, complete and correct.
    pub answer: Option<A>,
    /// True if a person has confirmed that the machine has begun.
    pub start_confirmed: bool,
    /// Notes for a person: which files were ignored and why, and which are awaited.
    pub notes: Vec<String>,
}
