//! Interface of the driver to the folders, so that the driver itself writes no file.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use super::ExchangeError;
use crate::Job;

/// Two folders that represent a machine: one for hand-overs, one for answers.
///
/// Every operation except publishing is idempotent.
pub trait Exchange: std::fmt::Debug + Send + 'static {
    /// Request that is handed over.
    type Request: std::fmt::Debug + Send + 'static;
    /// Answer that comes back.
    type Answer: std::fmt::Debug + Clone + Send + 'static;

    /// Checks access to the outbox and the inbox. Returns every hand-over in the outbox, the oldest first. Hand-overs
    /// of earlier runs are included.
    fn open(&mut self) -> Result<Vec<HandOver>, ExchangeError>;

    /// Publishes a hand-over: all its files appear at once, by the rename of a folder. `sequence` is its start number.
    ///
    /// # Errors
    /// The job and cycle were published before, the permit was withdrawn before the rename, or the outbox cannot be
    /// written.
    fn publish(
        &mut self,
        job: Job,
        sequence: u32,
        request: &Self::Request,
        permit: &Permit,
    ) -> Result<(), ExchangeError>;

    /// Changes the status of the hand-over of a job to `standing`.
    fn mark(&mut self, job: Job, standing: HandOverStatus) -> Result<(), ExchangeError>;

    /// Looks in the inbox for the answer to the open hand-over of a job. `now` is the time since the driver was
    /// created.
    fn poll(&mut self, now: Duration, job: Job) -> Result<PollResult<Self::Answer>, ExchangeError>;

    /// Records the confirmation of a person that the job with this map identity has begun or has ended. The default
    /// returns an error, for machines that report a job only by files.
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
    /// Creates a permit for one publication.
    pub fn new() -> Self {
        Self::default()
    }

    /// Uses the permit for a publication. Returns false if it was withdrawn or used before: then nothing may be
    /// published.
    pub fn use_up(&self) -> bool {
        self.0.compare_exchange(VALID, USED, Ordering::AcqRel, Ordering::Acquire).is_ok()
    }

    /// Withdraws the permit. Returns true if it was not used yet. Returns false if it was used or withdrawn before:
    /// then the hand-over may have been published.
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
