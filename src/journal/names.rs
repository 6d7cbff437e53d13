//! Names of the files that the journal writes into a run folder.

/// Name of the database file in a run folder.
pub const DATABASE: &str = "journal.sqlite";
/// Name of the anchor file in a run folder.
pub const ANCHOR: &str = "journal.anchor";
/// Name of the lock file in a run folder.
pub const LOCK: &str = ".lock";
