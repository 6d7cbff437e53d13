//! Errors of opening, writing and verifying a journal, each with its remedy.

use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

/// Error of opening, writing or verifying a journal.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "the message of each tells what its fields are")]
#[non_exhaustive]
pub enum JournalError {
    /// The run folder is in use by an earlier run.
    #[error(
        "{path}: a run folder must be new or empty, and this one is not; give the run another name, or resume the \
         run in it"
    )]
    Exists { path: PathBuf },
    /// The folder has no journal.
    #[error("{path}: there is no journal.sqlite in this folder; give the folder of a run")]
    Absent { path: PathBuf },
    /// The file is not a journal.
    #[error("{path}: this file is not a journal of Regrind: {what}; give the folder of a run")]
    Foreign { path: PathBuf, what: &'static str },
    /// The journal was made by a later version.
    #[error(
        "{path}: the journal has layout {found}, and this program reads at most {limit}; use the version of Regrind \
         that wrote it or a later one"
    )]
    Newer { path: PathBuf, found: u32, limit: u32 },
    /// Another process drives the run.
    #[error(
        "{path}: another process controls this run; wait until that process ends, or send an order to the run with `regrind hold` or `regrind stop`"
    )]
    Busy { path: PathBuf },
    /// Another run has the machine.
    #[error(
        "{address}: another run uses this machine: {holder}; wait until it ends, or stop it with `regrind stop` and \
         the folder of that run"
    )]
    MachineTaken { address: String, holder: String },
    /// The folder for the locks of machines is not safe to use: another user could have created it.
    #[error("{path}: this folder is for the lock files of the machines, but the folder is not safe: {what}; {remedy}")]
    LockFolder { path: PathBuf, what: String, remedy: String },
    /// The run is over.
    #[error("{path}: the journal is closed, because its run is over; begin another run")]
    Closed { path: PathBuf },
    /// The folder or a file in it cannot be written or read.
    #[error(
        "{path}: {action} failed: {source}; check that the folder exists, that you have the right to write in it, \
         and that its disk works"
    )]
    File { path: PathBuf, action: &'static str, source: io::Error },
    /// The disk is full.
    #[error("{path}: the disk is full; make free space on this disk, then continue the run with `regrind resume`")]
    DiskFull { path: PathBuf },
    /// The database did not accept a setting that the guarantees depend on.
    #[error(
        "{path}: the database did not accept {setting} = {wanted} (it has {found}); put the run folder on a local \
         disk"
    )]
    Setting { path: PathBuf, setting: &'static str, wanted: &'static str, found: String },
    /// The database reported an error.
    #[error(
        "{path}: the database failed: {source}; check that you have the right to write in the folder, and that its \
         disk works"
    )]
    Database { path: PathBuf, source: rusqlite::Error },
    /// The journal was changed, or the disk has damaged it.
    #[error(
        "{path}: the journal is broken at record {seq}: {what}; do not change the folder of the run; compare the journal with the copies of the journal"
    )]
    Broken { path: PathBuf, seq: u64, what: String },
    /// The record is intact, but it is not signed with one of the given keys.
    #[error(
        "{path}: the record is intact, but its author is not proven: {what}; give with --key the public keys of all \
         who signed the run, or omit --key: then the author is not checked"
    )]
    NoAuthor { path: PathBuf, what: String },
    /// The content of a recorded file differs from the record.
    #[error(
        "{path}: this file differs from the recorded one, and was not used; restore the recorded file from a copy of \
         the run"
    )]
    OtherFile { path: PathBuf },
    /// A file of the record is no longer at its path: everything written to it now would be lost.
    #[error(
        "{path}: this file of the record was deleted, renamed or replaced during the run; put it back, or stop the \
         run"
    )]
    Gone { path: PathBuf },
    /// The file of an audit key contains no valid key.
    #[error(
        "{path}: this is not an audit key: {what}; restore it from a copy, or move it away and make another with \
         `regrind audit key`"
    )]
    Key { path: PathBuf, what: &'static str },
    /// Other users can read or exchange the audit key.
    #[error(
        "{path}: other users can read or replace this audit key ({how}); {remedy}; if somebody may have a copy of \
         it, make another one with `regrind audit key`"
    )]
    KeyIsOpen { path: PathBuf, how: String, remedy: String },
    /// The name could lead out of the run folder.
    #[error(
        "`{name}` cannot be the name of a file in a run folder; give a relative path of plain file names, without `..`"
    )]
    Name { name: String },
    /// The file is already on record with a different content.
    #[error(
        "{path}: this file is already recorded with another content, and a recorded file is never overwritten; write the new content under another name"
    )]
    Recorded { path: PathBuf },
    /// The entry is not allowed at this place of the journal.
    #[error("a record of the kind {kind} cannot be written: this record {what}; report this fault of the program")]
    Entry { kind: &'static str, what: &'static str },
    /// All command numbers are used up.
    #[error(
        "this run has used all command numbers up to {limit}, and cannot send another command to a machine; begin another run"
    )]
    CommandNumbers { limit: u32 },
}

impl JournalError {
    /// Returns true if the error is a full disk.
    pub fn is_disk_full(&self) -> bool {
        matches!(self, Self::DiskFull { .. })
    }

    /// Returns true if a later attempt of the same write can succeed, because the cause of the error can be temporary.
    /// Such causes are: the disk is full, a file cannot be written or read, the database reports an error, or a file of
    /// the journal is missing.
    pub fn may_pass(&self) -> bool {
        matches!(self, Self::DiskFull { .. } | Self::File { .. } | Self::Database { .. } | Self::Gone { .. })
    }

    /// Returns a function that converts an I/O error at `path`, during `action`, to a journal error.
    pub(super) fn file(path: &Path, action: &'static str) -> impl Fn(io::Error) -> Self + use<> {
        let path = path.to_owned();
        move |source| match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Self::DiskFull { path: path.clone() },
            _ => Self::File { path: path.clone(), action, source },
        }
    }

    /// Returns a function that converts an error of the database at `path` to a journal error.
    pub(super) fn database(path: &Path) -> impl Fn(rusqlite::Error) -> Self + use<> {
        let path = path.to_owned();
        move |source| match source.sqlite_error_code() {
            Some(rusqlite::ErrorCode::DiskFull) => Self::DiskFull { path: path.clone() },
            Some(rusqlite::ErrorCode::NotADatabase) => {
                Self::Foreign { path: path.clone(), what: "it is not an SQLite database" }
            }
            Some(rusqlite::ErrorCode::DatabaseCorrupt) => {
                Self::Broken { path: path.clone(), seq: 0, what: "the database file itself is damaged".to_owned() }
            }
            _ => Self::Database { path: path.clone(), source },
        }
    }
}
