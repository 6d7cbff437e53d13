//! What the driver asks of the folders, so that it writes no file itself.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use super::ExchangeError;
use crate::Job;

/// Two folders that stand for a machine: one that hand-overs are put into, one that answers come out of.
///
/// Everything may be asked again: publishing apart, asking twice is the same as asking once.
pub trait Exchange: std::fmt::Debug + Send + 'static {
    /// What is handed over.
    type Request: std::fmt::Debug + Send + 'static;
    /// What comes back.
    type Answer: std::fmt::Debug + Clone + Send + 'static;

    /// Tries both folders, and returns every hand-over that was ever made there, the oldest first.
    fn open(&mut self) -> Result<Vec<HandOver>, ExchangeError>;

    /// Makes a hand-over appear, whole, by one rename. Never a second time for a job and cycle, and not where the permit for it was
    /// withdrawn before that rename.
    fn publish(
        &mut self,
        job: Job,
        sequence: u32,
        request: &Self::Request,
        permit: &Permit,
    ) -> Result<(), ExchangeError>;

    /// Moves a hand-over on to where it stands now.
    fn mark(&mut self, job: Job, standing: Standing) -> Result<(), ExchangeError>;

    /// Looks for what has come back for a hand-over that is open. `now` is the time since the driver was made.
    fn look(&mut self, now: Duration, job: Job) -> Result<Look<Self::Answer>, ExchangeError>;

    /// Writes down that a person has begun or ended the job whose map has this identity; where jobs are told by files alone, no job
    /// is open for it.
    fn confirm(&mut self, job: Job, _what: Confirmed, _map_identity: [u8; 32]) -> Result<(), ExchangeError> {
        Err(ExchangeError::NotOpen { job: job.job, cycle: job.cycle })
    }
}

/// Whether a hand-over may still appear. Who waits for it and gives up withdraws the permit; who makes it appear uses the permit up in the
/// moment before. So a hand-over that nobody waits for any more either never appears, or it is known that it did.
#[derive(Debug, Clone, Default)]
pub struct Permit(Arc<AtomicU8>);

const GIVEN: u8 = 0;
const USED: u8 = 1;
const WITHDRAWN: u8 = 2;

impl Permit {
    /// A permit that holds.
    pub fn new() -> Self {
        Self::default()
    }

    /// Uses the permit up; false where it was withdrawn.
    pub fn use_up(&self) -> bool {
        self.0.compare_exchange(GIVEN, USED, Ordering::AcqRel, Ordering::Acquire).is_ok()
    }

    /// Withdraws it; returns false where it was used before, so that the hand-over may have appeared.
    pub(super) fn withdraw(&self) -> bool {
        self.0.swap(WITHDRAWN, Ordering::AcqRel) == GIVEN
    }

    /// Whether nobody waits any more for what it was given for.
    pub(super) fn is_withdrawn(&self) -> bool {
        self.0.load(Ordering::Acquire) == WITHDRAWN
    }
}

/// What a person confirms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Confirmed {
    /// The machine has begun.
    Started,
    /// The machine has ended, the part is clear.
    Done,
}

/// A hand-over that was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HandOver {
    /// What for.
    pub job: Job,
    /// The number of its start; rises from one to the next.
    pub sequence: u32,
    /// What became of it.
    pub standing: Standing,
}

/// What became of a hand-over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Standing {
    /// It waits for its answer.
    Open,
    /// It was taken back for a while.
    Held,
    /// It was taken back for good, in order.
    Stopped,
    /// It was taken back for good, at once.
    Aborted,
    /// Its answer was acknowledged.
    Closed,
}

/// What a look at the folders found.
#[derive(Debug, Clone, PartialEq)]
pub struct Look<A> {
    /// The answer, if it is there, complete and right.
    pub answer: Option<A>,
    /// Whether a person has confirmed that the machine has begun.
    pub begun: bool,
    /// What a person should know: files left alone, and why; what is waited for.
    pub notes: Vec<String>,
}
