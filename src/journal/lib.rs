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
mod content;
mod copy;
mod error;
mod excerpt;
mod key;
mod locked_file;
mod lost;
mod machine;
mod names;
mod open;
mod reader;
mod record;
mod seal;
mod system;
mod verify;
mod write;

pub use artefact::Artefact;
pub use canonical::{canonical_json, sha256_hex};
pub use clock::{utc, utc_to_the_second};
pub use content::{Begin, End, KeyField, Reopen, or_none};
pub use copy::{restore, restore_file};
pub use error::JournalError;
pub use excerpt::Excerpt;
pub use key::{AuditKey, PublicKey};
pub use lost::may_be_lost;
pub use machine::MachineLock;
pub use names::{ANCHOR, DATABASE, LOCK, is_plain_name, is_plain_path};
pub use open::{free_bytes, is_open_to_all};
pub use reader::{Reader, Stamp, has_record, stamp};
pub use record::{Entry, Record, RecordKind, Records};
pub use seal::{SEALED_EVERY, Seal};
pub use verify::{Anchor, ExternalEvidence, Verified, anchor_of, is_driven, verify, verify_against};
pub use write::{Header, Journal, RunLock};
