//! What is told of a cell: how it is, and how the last of its runs ended.

use regrind_control::Snapshot;

/// What is told of a cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Told {
    /// How it is.
    pub now: Now,
    /// The last run that came to its end.
    pub last: Option<Ended>,
}

/// How a cell is.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum Now {
    /// No run is on.
    #[default]
    NoRun,
    /// A run's program is there and does not answer: what the machines do is not known.
    #[expect(missing_docs, reason = "named for what it is")]
    Silent { run: String },
    /// A run has no end on record, and its program has gone: what the machines do is not known.
    Gone {
        /// Its name.
        run: String,
        /// Whether its machines were simulated by that program, and have gone with it.
        machines_within: bool,
    },
    /// A run is on.
    #[expect(missing_docs, reason = "named for what they are")]
    On { run: String, snapshot: Box<Snapshot> },
}

/// A run that came to its end.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Ended {
    /// What it is called.
    pub run: String,
    /// How it ended, for people.
    pub verdict: String,
    /// Whether the part is accepted.
    pub accepted: bool,
}

impl Told {
    /// Returns the run that is on, does not answer, or whose program has gone.
    pub(crate) fn run(&self) -> Option<&str> {
        match &self.now {
            Now::NoRun => None,
            Now::Silent { run } | Now::Gone { run, .. } | Now::On { run, .. } => Some(run),
        }
    }

    /// Returns how the run is that is on.
    pub(crate) fn snapshot(&self) -> Option<&Snapshot> {
        match &self.now {
            Now::On { snapshot, .. } => Some(snapshot),
            _ => None,
        }
    }
}
