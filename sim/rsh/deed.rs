//! What a controller did, in order, for a test to hold against what its client has on record.

/// One thing that a controller did.
#[derive(Clone, Debug, PartialEq)]
pub enum Deed {
    /// It has opened a program.
    Opened {
        /// Its path.
        path: String,
    },
    /// It has begun to run a program.
    Began {
        /// Its path.
        path: String,
        /// What it runs.
        text: String,
    },
    /// It moves.
    Moves,
    /// It stands.
    Stands,
    /// The program has come to its end.
    Ended {
        /// Its path.
        path: String,
    },
    /// A client has aborted it.
    Aborted,
    /// Its stop circuit opened, or its drives went off.
    Stopped,
    /// It ended, and began anew with nothing.
    Killed,
}

/// Who is told of everything as it happens.
pub type Witness = Box<dyn FnMut(&Deed) + Send>;
