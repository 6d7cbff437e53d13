//! Published state of a cell: its present state, and the result of its last run.

use regrind_control::Snapshot;

/// Published state of a cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CellStatus {
    /// Present state.
    pub run_status: RunStatus,
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
    /// A run is active.
    #[expect(missing_docs, reason = "named for what they are")]
    Active { run: String, snapshot: Box<Snapshot> },
}

/// Run that ended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct EndedRun {
    /// Name of the run.
    pub run: String,
    /// Result, in words for people.
    pub verdict: String,
    /// True if the part is accepted.
    pub accepted: bool,
}

impl CellStatus {
    /// Returns the name of the current run. This is a run that is active, a run whose program does not answer, or a run
    /// without an end record whose program is gone. Returns `None` if there is no such run.
    pub(crate) fn run(&self) -> Option<&str> {
        match &self.run_status {
            RunStatus::NoRun => None,
            RunStatus::Unresponsive { run } | RunStatus::ProgramGone { run, .. } | RunStatus::Active { run, .. } => {
                Some(run)
            }
        }
    }

    /// Returns the snapshot of the active run; `None` without an active run.
    pub(crate) fn snapshot(&self) -> Option<&Snapshot> {
        match &self.run_status {
            RunStatus::Active { snapshot, .. } => Some(snapshot),
            _ => None,
        }
    }
}
