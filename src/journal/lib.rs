//! The journal of one run: every request, decision and action, in the order in which it became known.
//!
//! A run folder holds `journal.sqlite`. The journal refers to the other files of the folder by their SHA-256. An
//! acknowledged record is on the disk: the database uses a write-ahead log (WAL) with `synchronous = FULL`, which is
//! set and read back. There is one writer. It holds `.lock` in the folder for as long as it lives.
//!
//! Records form a hash chain. Each record holds the hash of the record before it. Its own hash is `SHA-256("regrind
//! journal record 1\n" || prev_hash || "\n" || text)`. `prev_hash` has 64 lowercase hexadecimal digits. `text` is the
//! JSON object of the other fields of the record, with sorted keys and no whitespace; the payload is the text in the
//! database, unchanged. [`verify()`] therefore finds every change, deletion, insertion and reordering. A cut of the
//! tail is found with an [`Anchor`]: the number of records and the hash of the last one. The anchor is kept in
//! `journal.anchor`, and in every other place where somebody stored a copy.
//!
//! If the computer has an [`AuditKey`], the journal signs its head with that key (Ed25519) every [`SEALED_EVERY`]
//! records and at the end. Each signature is a record of its own, and the anchor is updated with it. To change the
//! history without detection, an attacker also needs the key.
//!
//! docs/journal.md specifies the format, so that a record can be verified without this program.
//!
//! Calls block until the disk has answered. The drive therefore calls from a thread of its own. Writes are idempotent:
//! after a failed call the same entry can be given again, and it is recorded once.
//!
//! tests/failing_disk tests this with a failing disk below SQLite. docs/reliability.md lists what is tested and what is
//! not.

mod artefact;
mod canonical;
mod clock;
mod copy;
mod error;
mod key;
mod locked_file;
mod lost;
mod machine;
mod open;
mod record;
mod seal;
mod system;
mod verify;
mod write;

pub use artefact::Artefact;
pub use canonical::{canonical_json, sha256_hex};
pub use clock::{utc, utc_to_the_second};
pub use copy::{restore, restore_file};
pub use error::JournalError;
pub use key::{AuditKey, PublicKey};
pub use lost::{may_be_lost, newest_cycle};
pub use machine::MachineLock;
pub use open::{free_bytes, is_open_to_all};
pub use record::{Entry, Record, RecordKind, Records};
pub use seal::SEALED_EVERY;
pub use verify::{Anchor, ExternalEvidence, Verified, anchor_of, is_driven, verify, verify_against};
pub use write::{Header, Journal, RunLock};

use std::path::Path;
use std::time::SystemTime;

use rusqlite::Connection;

/// Name of the database file in a run folder.
pub const DATABASE: &str = "journal.sqlite";
/// Name of the anchor file in a run folder.
pub const ANCHOR: &str = "journal.anchor";
/// Name of the lock file in a run folder.
pub const LOCK: &str = ".lock";

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

/// Read-only journal. It can be read while another process writes it. The process that writes the journal must read it
/// with [`Journal::records`] instead: when a process closes a file, it releases all locks that it has on that file.
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
    fn number_before_the_first(&self) -> Result<Option<i64>, JournalError> {
        let least = self.connection.query_row("SELECT min(seq) FROM record WHERE seq < 1", [], |row| row.get(0));
        least.map_err(JournalError::database(&self.folder))
    }
}
