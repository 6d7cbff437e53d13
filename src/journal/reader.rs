//! Read-only view of a journal, also while another process writes it.

use std::path::Path;
use std::time::SystemTime;

use rusqlite::Connection;

use super::error::JournalError;
use super::names::DATABASE;
use super::open;
use super::record::{Record, Records};

/// Read-only journal. It can be read while another process writes it. The process that writes the journal must read it
/// with [`super::Journal::records`] instead: when a process closes a file, it releases all locks that it has on that file.
#[derive(Debug)]
pub struct Reader {
    connection: Connection,
    folder: std::path::PathBuf,
}

impl Reader {
    /// Opens the journal of a run folder for reading.
    ///
    /// # Errors
    /// The folder has no journal; the file is not a journal, or was written by a later version.
    pub fn open(folder: impl AsRef<Path>) -> Result<Self, JournalError> {
        let folder = folder.as_ref().to_owned();
        Ok(Self { connection: open::read_only(&folder)?, folder })
    }

    /// Returns the run folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Returns an iterator over the records, in order, beginning with the record number `from`.
    pub fn records(&self, from: u64) -> Records<'_> {
        Records::new(&self.connection, &self.folder, from)
    }

    /// Returns the last record, or `None` if there is no record.
    ///
    /// # Errors
    /// The last record cannot be read.
    pub fn last(&self) -> Result<Option<Record>, JournalError> {
        let failed = JournalError::database(&self.folder);
        let number = self.connection.query_row("SELECT max(seq) FROM record", [], |row| row.get::<_, Option<i64>>(0));
        match number.map_err(failed)?.and_then(|number| u64::try_from(number).ok()) {
            None => Ok(None),
            Some(number) => self.records(number).next().transpose(),
        }
    }

    /// Returns the lowest record number that is less than 1, or `None` if no record has such a number. The journal
    /// numbers its records from 1, so a lower number proves that somebody changed the database.
    pub(super) fn number_before_the_first(&self) -> Result<Option<i64>, JournalError> {
        let least = self.connection.query_row("SELECT min(seq) FROM record WHERE seq < 1", [], |row| row.get(0));
        least.map_err(JournalError::database(&self.folder))
    }
}

/// Returns true if the folder contains the database of a journal. Its content is not checked.
pub fn has_record(folder: &Path) -> bool {
    folder.join(DATABASE).is_file()
}

/// Modification time and length in bytes of the database and of its log. A stamp differs from an earlier one if a
/// record was added in between.
pub type Stamp = [Option<(SystemTime, u64)>; 2];

/// Returns the modification time and the length in bytes of two files of a run folder: the database, and the
/// write-ahead log of the database. If the result differs from that of an earlier call, a record was added in between.
/// The item of a file that does not exist is `None`.
pub fn stamp(folder: &Path) -> Stamp {
    [DATABASE.to_owned(), format!("{DATABASE}-wal")].map(|name| {
        let metadata = std::fs::metadata(folder.join(name)).ok()?;
        Some((metadata.modified().ok()?, metadata.len()))
    })
}
