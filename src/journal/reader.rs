//! Read-only view of a journal, also while another process writes it.

use std::path::Path;
use std::time::{Duration, SystemTime};

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

    /// Checks that each record follows the one before it by its number and hash, and has the content that was hashed. Does
    /// not check signatures, files and anchors: [`super::verify()`] does this.
    ///
    /// # Errors
    /// [`JournalError::Broken`] for the first record that does not. The journal cannot be read.
    pub fn check_chain(&self) -> Result<(), JournalError> {
        let mut head = "0".repeat(64);
        for (record, before) in self.records(1).zip(0..) {
            let record = record?;
            if let Some(what) = record.successor_flaw(before, &head) {
                return Err(JournalError::Broken { path: self.folder.clone(), seq: before + 1, what });
            }
            head = record.hash;
        }
        Ok(())
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

/// Time after a change of a file during which a reader may not see the change yet. The database writes a record into its
/// log first. Readers see the record only when the disk has it.
const UNSETTLED: Duration = Duration::from_secs(5);

/// Modification time and length in bytes of the database and of its log, for a cache of what was read.
///
/// A stamp equals an earlier one if no record was added in between, and if a reader at the earlier time saw all records.
/// Soon after a change, a stamp equals no other one, not even itself.
#[derive(Clone, Copy, Debug)]
pub struct Stamp {
    files: [Option<(SystemTime, u64)>; 2],
    is_settled: bool,
}

impl Stamp {
    /// Returns true if the files have the same times and lengths as those of `other`. Soon after a change this does not
    /// show that no record was added.
    pub fn has_same_files(&self, other: &Self) -> bool {
        self.files == other.files
    }

    /// Returns the time of the last change; `None` if there are no files.
    pub fn changed_at(&self) -> Option<SystemTime> {
        self.files.iter().flatten().map(|(at, _)| *at).max()
    }
}

impl PartialEq for Stamp {
    fn eq(&self, other: &Self) -> bool {
        self.is_settled && other.is_settled && self.files == other.files
    }
}

/// Returns the modification time and the length in bytes of two files of a run folder: the database, and the
/// write-ahead log of the database. Take the stamp before you read the record, and keep both. What you have read is the
/// whole record as long as the stamp equals a new one.
pub fn stamp(folder: &Path) -> Stamp {
    stamp_at(folder, SystemTime::now())
}

fn stamp_at(folder: &Path, now: SystemTime) -> Stamp {
    let files = [DATABASE.to_owned(), format!("{DATABASE}-wal")].map(|name| {
        let metadata = std::fs::metadata(folder.join(name)).ok()?;
        Some((metadata.modified().ok()?, metadata.len()))
    });
    let is_old = |at: &SystemTime| now.duration_since(*at).is_ok_and(|age| age > UNSETTLED);
    Stamp { files, is_settled: files.iter().flatten().all(|(at, _)| is_old(at)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fresh_stamp_equals_no_other() {
        let home = tempfile::tempdir().unwrap();
        let nothing = stamp(home.path());
        assert!(nothing == stamp(home.path()) && nothing.changed_at().is_none());
        std::fs::write(home.path().join(DATABASE), "one").unwrap();
        let changed = stamp(home.path()).changed_at().unwrap();
        let at = |seconds: u64| stamp_at(home.path(), changed + Duration::from_secs(seconds));
        for (a, b, is_same) in [(0, 0, false), (1, 60, false), (60, 70, true)] {
            assert_eq!(at(a) == at(b), is_same, "{a} s and {b} s after the change");
            assert!(at(a).has_same_files(&at(b)));
        }
        // A clock that was set back: the file seems to be from the future.
        assert!(stamp_at(home.path(), changed - Duration::from_secs(60)) != at(60));
        let before = at(60);
        std::fs::write(home.path().join(DATABASE), "longer").unwrap();
        let changed = stamp(home.path()).changed_at().unwrap();
        let after = stamp_at(home.path(), changed + Duration::from_secs(60));
        assert!(before != after && !before.has_same_files(&after));
    }
}
