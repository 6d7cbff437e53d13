//! Published state of a cell: its present state, and the result of its last run.

use regrind_control::Snapshot;

/// Published state of a cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Told {
    /// Present state.
    pub now: Now,
    /// Last run that ended.
    pub last: Option<Ended>,
}

/// Present state of a cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum Now {
    /// There is no active run.
    #[default]
    NoRun,
    /// The program of the run exists but does not answer: the state of the machines is unknown.
    #[expect(missing_docs, reason = "named for what it is")]
    Silent { run: String },
    /// The run has no end on record, and its program is gone: the state of the machines is unknown.
    Gone {
        /// Name of the run.
        run: String,
        /// True if that program simulated its machines, so that they are gone too.
        machines_within: bool,
    },
    /// A run is active.
    #[expect(missing_docs, reason = "named for what they are")]
    On { run: String, snapshot: Box<Snapshot> },
}

/// Run that ended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Ended {
    /// Name of the run.
    pub run: String,
    /// Result, in words for people.
    pub verdict: String,
    /// True if the part is accepted.
    pub accepted: bool,
}

impl Told {
    /// Returns the name of the run that is active, does not answer, or whose program is gone.
    pub(crate) fn run(&self) -> Option<&str> {
        match &self.now {
            Now::NoRun => None,
            Now::Silent { run } | Now::Gone { run, .. } | Now::On { run, .. } => Some(run),
        }
    }

    /// Returns the snapshot of the active run.
    pub(crate) fn snapshot(&self) -> Option<&Snapshot> {
        match &self.now {
            Now::On { snapshot, .. } => Some(snapshot),
            _ => None,
        }
    }
}
