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
}
