//! The record of truth of one run: what was asked, decided and done, in the order in which it became known.
//!
//! A run folder holds `journal.sqlite`, and the journal refers to the other files of the folder by their SHA-256. A record that
//! was acknowledged is on the disk: the database writes ahead (WAL) with `synchronous = FULL`, set and read back. There is one
//! writer: it holds `.lock` in the folder for as long as it lives.
//!
//! Records form a chain. Each holds the hash of the one before, and its own hash is
//! `SHA-256("regrind journal record 1\n" || prev_hash || "\n" || text)`, with `prev_hash` in 64 small hexadecimal digits and `text` the JSON
//! object of its other fields with sorted keys and no blanks, the payload as it stands in the database. So any change,
//! deletion, insertion or reordering is found by [`verify`]. A cut of the tail is found with an [`Anchor`]: the number of records
//! and the hash of the last, kept in `journal.anchor` and wherever else somebody wrote it down.
//!
//! Where the computer has an [`AuditKey`], the head is signed with it (Ed25519) every [`SEALED_EVERY`] records and at the end, in a
//! record of its own, and the anchor is moved along with each: who wants to change what was written has to have the key too.
//!
//! All of it stands in docs/journal.md, for who wants to prove a record without this program.
//!
//! Calls block until the disk has answered; the drive calls from a thread of its own. What a call that failed was to write may be given again,
//! and stands once.
//!
//! All this is tried on a disk that fails, beneath SQLite, by tests/failing_disk: docs/reliability.md says what is, and what is not.

mod artefact;
mod canonical;
mod clock;
mod copy;
mod error;
mod held;
mod key;
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
pub use record::{Entry, Kind, Record, Records};
pub use seal::SEALED_EVERY;
pub use verify::{Against, Anchor, Verified, anchor_of, is_driven, verify, verify_against};
pub use write::{Header, Journal, RunLock};

use std::path::Path;
use std::time::SystemTime;

use rusqlite::Connection;

/// The database in a run folder.
pub const DATABASE: &str = "journal.sqlite";
/// The anchor in a run folder.
pub const ANCHOR: &str = "journal.anchor";
/// The lock in a run folder.
pub const LOCK: &str = ".lock";

/// When the files that hold a record were changed last, and how long they are: another one, where something was put on it.
pub type Stamp = [Option<(SystemTime, u64)>; 2];

/// Returns the stamp of a run folder.
pub fn stamp(folder: &Path) -> Stamp {
    [DATABASE.to_owned(), format!("{DATABASE}-wal")].map(|name| {
        let metadata = std::fs::metadata(folder.join(name)).ok()?;
        Some((metadata.modified().ok()?, metadata.len()))
    })
}

/// A journal that is only read. It may be read while another process writes it. Who writes it himself reads it by [`Journal::records`]: a
/// process that closes a file gives back all locks that it has on it.
#[derive(Debug)]
pub struct Reader {
    connection: Connection,
    folder: std::path::PathBuf,
}

impl Reader {
    /// Opens the journal of a run folder for reading.
    ///
    /// # Errors
    /// No journal there, or a file that is none.
    pub fn open(folder: impl AsRef<Path>) -> Result<Self, JournalError> {
        let folder = folder.as_ref().to_owned();
        Ok(Self { connection: open::read_only(&folder)?, folder })
    }

    /// Returns the run folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Returns the records from a number on, in order.
    pub fn records(&self, from: u64) -> Records<'_> {
        Records::new(&self.connection, &self.folder, from)
    }

    /// Returns the last record; none where there is no record.
    ///
    /// # Errors
    /// A record that cannot be read.
    pub fn last(&self) -> Result<Option<Record>, JournalError> {
        let failed = JournalError::database(&self.folder);
        let number = self.connection.query_row("SELECT max(seq) FROM record", [], |row| row.get::<_, Option<i64>>(0));
        match number.map_err(failed)?.and_then(|number| u64::try_from(number).ok()) {
            None => Ok(None),
            Some(number) => self.records(number).next().transpose(),
        }
    }

    /// Returns the least number of a record that stands before the first; none in a journal that was left as it is.
    fn number_before_the_first(&self) -> Result<Option<i64>, JournalError> {
        let least = self.connection.query_row("SELECT min(seq) FROM record WHERE seq < 1", [], |row| row.get(0));
        least.map_err(JournalError::database(&self.folder))
    }
}
