//! Errors of the plant: why it cannot be reached or why it refuses, with the remedy.

use std::io;
use std::path::PathBuf;

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
    #[error("the database refused {what}: {reason}{hint}")]
    Refused { what: &'static str, reason: String, hint: String },
    #[error("the tables of the database have layout {found}, but this program requires layout {known}; {remedy}")]
    Layout { found: i32, known: i32, remedy: &'static str },
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
    #[error("{}: the folder for large files cannot be used: {source}; check that it exists, and that you have the \
             right to write in it", .path.display())]
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
    /// Returns true if a retry makes sense: the plant cannot be reached now, and this can change without a person.
    /// Returns false for every other error.
    pub fn may_pass(&self) -> bool {
        matches!(self, Self::Unreachable { .. })
    }
}

/// Returns a function that converts an error of the database into a [`PlantError`]. `what` names the request in the
/// message, if the database refuses it. An error that a retry can solve, for example a restarting server, becomes
/// [`PlantError::Unreachable`].
pub(crate) fn refused(what: &'static str) -> impl Fn(tokio_postgres::Error) -> PlantError {
    move |error| {
        let Some(said) = error.as_db_error() else {
            return PlantError::Unreachable { place: "the server".into(), what: in_words(&error) };
        };
        // Errors that can pass: classes 57 (the server shuts down or starts), 53 (no space, too many connections), 08,
        // and 40 (a lost race).
        let passes = ["57", "53", "40", "08"].iter().any(|class| said.code().code().starts_with(class));
        if passes {
            return PlantError::Unreachable { place: "the server".into(), what: said.message().to_owned() };
        }
        let hint = said.hint().map_or(String::new(), |hint| format!("; {hint}"));
        PlantError::Refused { what, reason: said.message().to_owned(), hint }
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
    words
}
