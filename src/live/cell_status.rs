//! Published state of a cell: its present state, and the result of its last run.

use std::time::{SystemTime, UNIX_EPOCH};

use regrind_cell::StateName;
use regrind_control::Snapshot;

/// Published state of a cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CellStatus {
    /// Present state.
    pub run_status: RunStatus,
    /// True if the snapshot was built from the record of a run that has ended. It lacks what the record does not tell.
    pub from_record: bool,
    /// Last run that ended.
    pub last_run: Option<EndedRun>,
}

/// Present state of a cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum RunStatus {
    /// There is no active run.
    #[default]
    NoRun,
    /// The program of the run exists but does not answer: the state of the machines is unknown.
    #[expect(missing_docs, reason = "named for what it is")]
    Unresponsive { run: String },
    /// The run has no end on record, and its program is gone: the state of the machines is unknown.
    ProgramGone {
        /// Name of the run.
        run: String,
        /// True if that program simulated its machines, so that they are gone too.
        machines_within: bool,
    },
    /// A run is active, or has just ended. In the second case the snapshot has the state Complete, Stopped or Aborted.
    #[expect(missing_docs, reason = "named for what they are")]
    Active { run: String, snapshot: Box<Snapshot> },
}

/// Run that ended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct EndedRun {
    /// Name of the run.
    pub run: String,
    /// Name of the result: Accepted, NotAccepted, Stopped or Aborted.
    pub result: &'static str,
    /// Result, in words for people.
    pub verdict: String,
    /// True if the part is accepted.
    pub accepted: bool,
    /// Time of the end, in milliseconds since 1970 in UTC.
    pub ended_ms: u64,
}

/// Status of a cell at a time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TimedStatus {
    /// Status.
    pub status: CellStatus,
    /// Time at which the status held, in milliseconds since 1970 in UTC.
    pub at_ms: u64,
}

impl TimedStatus {
    /// Returns the status `status` with the present time.
    pub fn now(status: CellStatus) -> Self {
        Self { status, at_ms: now_ms() }
    }
}

impl CellStatus {
    /// Returns the name of the current run. The current run has one of three states: it is active, its program does not
    /// answer, or its program has ended without an end record. Returns `None` if there is no current run.
    pub(crate) fn run(&self) -> Option<&str> {
        match &self.run_status {
            RunStatus::NoRun => None,
            RunStatus::Unresponsive { run } | RunStatus::ProgramGone { run, .. } | RunStatus::Active { run, .. } => {
                Some(run)
            }
        }
    }

    /// Returns the snapshot (the state of the running cell at one time) of the active run. Returns `None` if no run is
    /// active. A run whose program does not answer or has ended is not active.
    pub(crate) fn snapshot(&self) -> Option<&Snapshot> {
        match &self.run_status {
            RunStatus::Active { snapshot, .. } => Some(snapshot),
            _ => None,
        }
    }

    /// Returns the PackML state of the cell: Idle if there is no run. Returns `None` if the program of the run does not
    /// answer or is gone, because the state is then unknown.
    pub(crate) fn state(&self) -> Option<StateName> {
        match &self.run_status {
            RunStatus::NoRun => Some(StateName::Idle),
            RunStatus::Unresponsive { .. } | RunStatus::ProgramGone { .. } => None,
            RunStatus::Active { snapshot, .. } => Some(snapshot.state),
        }
    }
}

/// Returns the present time in milliseconds since 1970 in UTC.
pub(crate) fn now_ms() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}
