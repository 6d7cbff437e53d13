//! Errors of the plant: why it cannot be reached or why it refuses, with the remedy.

use std::io;
use std::path::{Path, PathBuf};

use regrind_document::visible_line;
use regrind_formats::FormatError;
use regrind_journal::JournalError;
use regrind_report::ReportError;
use regrind_trust::TrustError;
use thiserror::Error;

/// Reason why the plant cannot be reached or refuses.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "the messages tell them")]
#[non_exhaustive]
pub enum PlantError {
    #[error(transparent)]
    Trust(#[from] TrustError),
    /// The database cannot be reached now; a retry can succeed.
    #[error(
        "the database at {place} cannot be reached: {what}; check that the database runs and that the network connection works"
    )]
    Unreachable { place: String, what: String },
    /// The server does not prove that it is the database of the plant.
    #[error("the database at {place} does not prove its identity: {what}; {remedy}")]
    Certificate { place: String, what: String, remedy: &'static str },
    /// The disk of the database has no room; a retry can succeed.
    #[error("the disk of the database is full: {what}; make free space on the disk of the computer of the database")]
    DatabaseFull { what: String },
    /// The computer of the database has reached a limit or has a fault; a retry can succeed.
    #[error("the database cannot do this now: {what}; {remedy}")]
    DatabaseFault { what: String, remedy: &'static str },
    #[error("the database refused {what}: {reason}{hint}")]
    Refused { what: &'static str, reason: String, hint: String },
    #[error("the tables of the database have layout {found}, but this program requires layout {known}; {remedy}")]
    Layout { found: i32, known: i32, remedy: &'static str },
    /// The database does not accept a value of these data, and possibly accepts others.
    #[error("the database refused {what}: {reason}{hint}")]
    Value { what: &'static str, reason: String, hint: String },
    #[error(
        "the layout of the database was changed: migration {version} has another text; restore the database from its \
         backup"
    )]
    ForeignLayout { version: i32 },
    /// The records in the plant and those at the cell disagree.
    #[error(
        "{run}: {what}; do not change the journal of the run or its copy in the database of the plant; to compare both: regrind audit verify --plant"
    )]
    Differs { run: String, what: String },
    #[error("the database of the plant has no run {name:?} of the cell {cell:?}; to list the runs: regrind plant runs")]
    NoRun { cell: String, name: String },
    #[error(
        "{run} of {cell} was archived to {place}; verify it there (regrind audit verify {place}), or bring it back: regrind plant unarchive"
    )]
    Archived { cell: String, run: String, place: String },
    #[error(
        "{}: the plant has no archived run with this name and this record; to list the runs: regrind plant runs", .folder.display()
    )]
    NotArchived { folder: PathBuf },
    #[error(
        "{run:?} of the cell {cell:?} is not fetched: {name:?} is no plain name and can lead to another folder; no program of Regrind writes such a \
         name: ask who keeps this cell, and do not use the run"
    )]
    UnsafeName { cell: String, run: String, name: String },
    #[error("{0}")]
    Recipe(String),
    #[error("{name}: {what}")]
    Member { name: String, what: String },
    #[error("part {work} of the queue: {reason}; to take another part: regrind work")]
    Work { work: i64, reason: String },
    #[error("{}: the folder for large files cannot be used: {source}; check that it exists, that its disk \
             has free space, and that you have the right to write in it", .path.display())]
    Folder { path: PathBuf, source: io::Error },
    /// A database or a run that simulated runs cannot be made in, or of.
    #[error("{what}; {remedy}")]
    Fill { what: String, remedy: &'static str },
    #[error(transparent)]
    Journal(#[from] JournalError),
    #[error(transparent)]
    Report(#[from] ReportError),
    #[error(transparent)]
    File(#[from] FormatError),
}

impl PlantError {
    /// Returns true if a retry makes sense: the cause of the error can end without a change at this computer. The plant
    /// cannot be reached now, its database has no room or a fault, or the folder for large files has no room or cannot
    /// be reached. Returns false for every other error.
    pub fn may_pass(&self) -> bool {
        match self {
            Self::Unreachable { .. } | Self::DatabaseFull { .. } | Self::DatabaseFault { .. } => true,
            Self::Folder { source, .. } => is_passing(source.kind()),
            _ => false,
        }
    }

    /// Returns the error of the folder for large files at `path`. `source` is the error of writing a file in it.
    pub(crate) fn folder(path: &Path, source: FormatError) -> Self {
        let cause = std::error::Error::source(&source).and_then(|cause| cause.downcast_ref::<io::Error>());
        match cause.map(io::Error::kind) {
            Some(kind) => Self::Folder { path: path.to_owned(), source: io::Error::new(kind, source.to_string()) },
            None => Self::File(source),
        }
    }
}

/// Returns true if an error of a folder can end by itself or by a person elsewhere: a full disk, or a network share that
/// is gone.
fn is_passing(kind: io::ErrorKind) -> bool {
    use io::ErrorKind::*;
    matches!(
        kind,
        StorageFull
            | QuotaExceeded
            | TimedOut
            | HostUnreachable
            | NetworkUnreachable
            | NetworkDown
            | StaleNetworkFileHandle
            | ResourceBusy
            | Interrupted
    )
}

/// Returns a function that converts an error of the database into a [`PlantError`]. `what` names the request in the
/// message, if the database refuses it. An error that a retry can solve, for example a restarting server, becomes
/// [`PlantError::Unreachable`], [`PlantError::DatabaseFull`] or [`PlantError::DatabaseFault`]. A value that the database
/// does not accept becomes [`PlantError::Value`].
pub(crate) fn refused(what: &'static str) -> impl Fn(tokio_postgres::Error) -> PlantError {
    move |error| {
        let Some(said) = error.as_db_error() else {
            return PlantError::Unreachable { place: "the server".into(), what: in_words(&error) };
        };
        let (code, reason) = (said.code().code(), visible_line(said.message()));
        if let Some(passing) = passing("the server", code, &reason) {
            return passing;
        }
        let hint = said.hint().map_or(String::new(), |hint| format!("; {}", visible_line(hint)));
        // Classes 22 (a value of the data) and 23 (a rule of a table).
        if ["22", "23"].iter().any(|class| code.starts_with(class)) {
            return PlantError::Value { what, reason, hint };
        }
        PlantError::Refused { what, reason, hint }
    }
}

/// Returns the error for the SQLSTATE `code` if its cause can end without a change at this computer; otherwise `None`.
/// `place` is the address of the database, and `said` its message.
pub(crate) fn passing(place: &str, code: &str, said: &str) -> Option<PlantError> {
    let what = visible_line(said);
    let is_of = |classes: &[&str]| classes.iter().any(|class| code.starts_with(class));
    let fault = |remedy| Some(PlantError::DatabaseFault { what: visible_line(said), remedy });
    match code {
        "53100" => Some(PlantError::DatabaseFull { what }),
        "53300" => fault("end other programs that use the database, or let it accept more (max_connections)"),
        // A standby that is not the database of the plant yet.
        "25006" => fault("the server is a standby: make it the primary, or name the primary in the plant file"),
        // Classes 53 (a limit of the server) and 58 (an error of its operating system).
        _ if is_of(&["53", "58"]) => fault("look into the log of the database"),
        // Classes 57 (the server shuts down or starts), 08 (the connection), and 40 (a lost race).
        _ if is_of(&["57", "08", "40", "55P03"]) => Some(PlantError::Unreachable { place: place.to_owned(), what }),
        _ => None,
    }
}

/// Returns the message of an error of the database client, followed by the messages of its causes.
pub(crate) fn in_words(error: &tokio_postgres::Error) -> String {
    let mut words = error.to_string();
    let mut behind = std::error::Error::source(error);
    while let Some(source) = behind {
        let more = source.to_string();
        if !words.contains(&more) {
            words = format!("{words}: {more}");
        }
        behind = source.source();
    }
    visible_line(&words)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn full_disk_of_folder_may_pass() {
        let error = |kind| {
            let source = FormatError::Unreadable { path: "a".into(), source: io::Error::from(kind) };
            PlantError::folder(Path::new("files"), source)
        };
        use io::ErrorKind::*;
        for (kind, may_pass) in
            [(StorageFull, true), (StaleNetworkFileHandle, true), (PermissionDenied, false), (NotFound, false)]
        {
            let error = error(kind);
            assert_eq!(error.may_pass(), may_pass, "{error}");
            assert!(matches!(error, PlantError::Folder { .. }), "{error}");
        }
    }

    #[test]
    fn sqlstate_tells_what_may_pass() {
        let found = |code| passing("here", code, "said");
        assert!(matches!(found("53100"), Some(PlantError::DatabaseFull { .. })));
        for code in ["53200", "53300", "53400", "58030", "58P01", "25006"] {
            assert!(matches!(found(code), Some(PlantError::DatabaseFault { .. })), "{code}");
        }
        for code in ["57P01", "57P02", "57P03", "57014", "08006", "40001", "40P01"] {
            assert!(matches!(found(code), Some(PlantError::Unreachable { .. })), "{code}");
        }
        for code in ["22007", "23505", "28P01", "42501", "3D000", "25001"] {
            assert!(found(code).is_none(), "{code}");
        }
    }
}
