//! One record, and the iteration over all records.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use rusqlite::{Connection, Row, params};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::canonical::{canonical_json, chain, write_string};
use super::error::JournalError;

/// Kind of a record.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordKind {
    /// First record of a run.
    Begin,
    /// The journal was opened again after a crash or a hold.
    Reopen,
    /// A command, recorded before it is executed. Has a command number.
    Intent,
    /// Result of a command. Has the command number of its intent.
    Outcome,
    /// An event that the cell received.
    Event,
    /// A file of the run folder and its SHA-256.
    Artefact,
    /// Any other message for the reader.
    Note,
    /// Signature of the number of records before it and the hash of the last of them. Only the journal itself writes
    /// it.
    Seal,
    /// End of a run, with the number of records before it. If the run is signed, exactly one seal follows.
    End,
}

impl RecordKind {
    /// All kinds.
    pub const ALL: [Self; 9] = [
        Self::Begin,
        Self::Reopen,
        Self::Intent,
        Self::Outcome,
        Self::Event,
        Self::Artefact,
        Self::Note,
        Self::Seal,
        Self::End,
    ];

    /// Returns the name of this record kind as the database stores it, such as `begin`.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Begin => "begin",
            Self::Reopen => "reopen",
            Self::Intent => "intent",
            Self::Outcome => "outcome",
            Self::Event => "event",
            Self::Artefact => "artefact",
            Self::Note => "note",
            Self::Seal => "seal",
            Self::End => "end",
        }
    }
}

impl FromStr for RecordKind {
    type Err = ();

    fn from_str(word: &str) -> Result<Self, ()> {
        Self::ALL.into_iter().find(|kind| kind.as_str() == word).ok_or(())
    }
}

/// Content of a record to be written.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// Time since the run began, in nanoseconds, of a monotonic clock.
    pub mono_ns: u64,
    /// Person or machine that acts, or the cell.
    pub actor: String,
    /// Place of the actor: a terminal, a computer or an address.
    pub station: String,
    /// Kind of the record.
    pub kind: RecordKind,
    /// Number of the cycle; 0 before the first.
    pub cycle: u32,
    /// Number of the command that this record belongs to. [`super::Journal::intend`] assigns the number of an intent.
    pub command_id: Option<u32>,
    /// Reason in words; can be empty.
    pub reason: String,
    /// Content of the record.
    pub payload: Value,
}

impl Entry {
    /// Creates an entry (content of a record to be written) with the actor `cell`, the station `regrind`, no command
    /// number and an empty reason. `mono_ns` is the time since the run began, in nanoseconds. `cycle` is the number of
    /// the cycle, 0 before the first. `payload` is the content of the record: a JSON value, or a type that is written as
    /// one.
    pub fn new(kind: RecordKind, mono_ns: u64, cycle: u32, payload: impl Serialize) -> Self {
        let (actor, station) = ("cell".to_owned(), "regrind".to_owned());
        // Fails only for a key that is not a text, and for a path that is not Unicode: the types of records have neither.
        let payload = serde_json::to_value(payload).unwrap_or_default();
        Self { mono_ns, actor, station, kind, cycle, command_id: None, reason: String::new(), payload }
    }
}

/// Record of the journal.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Record {
    /// Number of the record, from 1.
    pub seq: u64,
    /// Time of day, RFC 3339 in UTC. Records are ordered by `seq`, never by this time.
    pub utc: String,
    /// Random identifier of one opening of the journal. Values of `mono_ns` are comparable only within the same
    /// opening.
    pub boot_id: String,
    /// Time since the run began, in nanoseconds.
    pub mono_ns: u64,
    /// Person or machine that acts, or the cell.
    pub actor: String,
    /// Place of the actor.
    pub station: String,
    /// Kind of the record.
    pub kind: RecordKind,
    /// Serial number of the part.
    pub part: String,
    /// Number of the cycle; 0 before the first.
    pub cycle: u32,
    /// Number of the command that this record belongs to.
    pub command_id: Option<u32>,
    /// Reason in words.
    pub reason: String,
    /// Content, in canonical JSON.
    pub payload: String,
    /// Hash of the record before; 64 zeros for the first record.
    pub prev_hash: String,
    /// Hash of this record.
    pub hash: String,
}

impl Record {
    /// Returns true if this record has the same kind, cycle, actor, station, time and payload (content) as `entry`.
    /// Does not compare the reason and the command number.
    pub(super) fn is_of(&self, entry: &Entry) -> bool {
        (self.kind, self.cycle, &self.actor, &self.station) == (entry.kind, entry.cycle, &entry.actor, &entry.station)
            && self.mono_ns == entry.mono_ns.min(i64::MAX as u64)
            && self.payload == canonical_json(&entry.payload)
    }

    /// Returns the payload as a JSON value, or null if it is not valid JSON.
    pub fn value(&self) -> Value {
        serde_json::from_str(&self.payload).unwrap_or(Value::Null)
    }

    /// Inserts this record into the database.
    ///
    /// # Errors
    /// The database rejects a record whose number does not follow the last one, or cannot write it.
    pub(super) fn put_into(&self, connection: &Connection) -> rusqlite::Result<()> {
        let sql = format!(
            "INSERT INTO record ({COLUMNS}) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11, ?12, ?13, ?14)"
        );
        let mut statement = connection.prepare_cached(&sql)?;
        let values = params![
            signed(self.seq),
            self.utc,
            self.boot_id,
            signed(self.mono_ns),
            self.actor,
            self.station,
            self.kind.as_str(),
            self.part,
            self.cycle,
            self.command_id,
            self.reason,
            self.payload,
            self.prev_hash,
            self.hash
        ];
        statement.execute(values).map(drop)
    }

    /// Returns the text from which the hash of the record is computed: all fields except the hashes, as JSON with
    /// sorted keys.
    pub fn text(&self) -> String {
        let mut text = String::with_capacity(self.payload.len() + 256);
        let string = |text: &mut String, key: &str, value: &str| {
            text.push_str(key);
            write_string(text, value);
        };
        string(&mut text, "{\"actor\":", &self.actor);
        string(&mut text, ",\"boot_id\":", &self.boot_id);
        // Writing into a string does not fail.
        let _ = match self.command_id {
            Some(id) => write!(text, ",\"command_id\":{id}"),
            None => write!(text, ",\"command_id\":null"),
        };
        let _ = write!(text, ",\"cycle\":{}", self.cycle);
        string(&mut text, ",\"kind\":", self.kind.as_str());
        let _ = write!(text, ",\"mono_ns\":{}", self.mono_ns);
        string(&mut text, ",\"part\":", &self.part);
        text.push_str(",\"payload\":");
        text.push_str(&self.payload);
        string(&mut text, ",\"reason\":", &self.reason);
        let _ = write!(text, ",\"seq\":{}", self.seq);
        string(&mut text, ",\"station\":", &self.station);
        string(&mut text, ",\"utc\":", &self.utc);
        text.push('}');
        text
    }

    /// Returns the hash that this record should have, computed from its content and `prev_hash`.
    pub(super) fn expected_hash(&self) -> String {
        chain(&self.prev_hash, &self.text())
    }

    /// Returns the names of the columns as a row of CSV (RFC 4180), without a line ending.
    pub fn csv_head() -> String {
        COLUMNS.replace(", ", ",")
    }

    /// Returns the record as a row of CSV (RFC 4180), without a line ending. The payload is its JSON text. A missing
    /// command number is an empty field.
    pub fn csv_row(&self) -> String {
        let id = self.command_id.map_or(String::new(), |id| id.to_string());
        let (seq, mono_ns, cycle) = (self.seq.to_string(), self.mono_ns.to_string(), self.cycle.to_string());
        let kind = self.kind.as_str();
        let fields: [&str; 14] = [
            &seq,
            &self.utc,
            &self.boot_id,
            &mono_ns,
            &self.actor,
            &self.station,
            kind,
            &self.part,
            &cycle,
            &id,
            &self.reason,
            &self.payload,
            &self.prev_hash,
            &self.hash,
        ];
        fields.map(csv_field).join(",")
    }

    /// Checks whether this record can follow the first `records` records of a journal. `head` is the hash of the last
    /// of these records. Returns a description of the fault: the record number is not `records` + 1, the hash of the
    /// record before is not `head`, or the hash of this record does not match its content. Returns `None` if there is
    /// no fault.
    pub(super) fn successor_flaw(&self, records: u64, head: &str) -> Option<String> {
        let due = records + 1;
        if self.seq != due {
            Some(format!("it is missing: record {} follows {records}", self.seq))
        } else if self.prev_hash != head {
            Some("it does not follow the record before it: one of them was changed, moved, inserted or removed".into())
        } else if self.hash != self.expected_hash() {
            Some("its content was changed".into())
        } else {
            None
        }
    }

    /// Returns the record as one line of JSON without a line ending: the fields of [`Record::text`], then the two
    /// hashes.
    pub fn json_line(&self) -> String {
        let mut line = self.text();
        line.pop();
        line.push_str(&format!(",\"prev_hash\":\"{}\",\"hash\":\"{}\"}}", self.prev_hash, self.hash));
        line
    }
}

fn csv_field(field: &str) -> Cow<'_, str> {
    match field.contains(['"', ',', '\r', '\n']) {
        true => format!("\"{}\"", field.replace('"', "\"\"")).into(),
        false => field.into(),
    }
}

/// Columns, in the order in which they are read and written.
pub(super) const COLUMNS: &str =
    "seq, utc, boot_id, mono_ns, actor, station, kind, part, cycle, command_id, reason, payload, prev_hash, hash";

/// Returns the integer in a column of a row.
///
/// # Errors
/// The value is negative or no integer.
pub(super) fn whole(row: &Row<'_>, column: usize) -> rusqlite::Result<u64> {
    let number: i64 = row.get(column)?;
    u64::try_from(number).map_err(|_| rusqlite::Error::IntegralValueOutOfRange(column, number))
}

fn record_of(row: &Row<'_>) -> rusqlite::Result<Record> {
    let word: String = row.get(6)?;
    let kind = word.parse().map_err(|()| rusqlite::Error::InvalidColumnName(format!("kind {word:?}")))?;
    Ok(Record {
        seq: whole(row, 0)?,
        utc: row.get(1)?,
        boot_id: row.get(2)?,
        mono_ns: whole(row, 3)?,
        actor: row.get(4)?,
        station: row.get(5)?,
        kind,
        part: row.get(7)?,
        cycle: row.get(8)?,
        command_id: row.get(9)?,
        reason: row.get(10)?,
        payload: row.get(11)?,
        prev_hash: row.get(12)?,
        hash: row.get(13)?,
    })
}

/// Maximum number of records that are read at once.
const MAX_PAGE_RECORDS: u32 = 512;

/// Iterator over the records of a journal, in order. It reads one page at a time and keeps no transaction open between
/// two pages. So it never blocks a writer, and it finds the records that a writer adds in the meantime.
#[derive(Debug)]
pub struct Records<'j> {
    connection: &'j Connection,
    folder: PathBuf,
    /// Records that are read and not yet returned.
    page: VecDeque<Result<Record, JournalError>>,
    /// Number of the next record to read.
    next: u64,
    /// Number of records of the next page. It grows from 1, so that a single record costs one row.
    size: u32,
    over: bool,
}

impl<'j> Records<'j> {
    pub(super) fn new(connection: &'j Connection, folder: &Path, from: u64) -> Self {
        Self { connection, folder: folder.to_owned(), page: VecDeque::new(), next: from.max(1), size: 1, over: false }
    }

    /// Reads the next group of records (at most 512) from the database into the buffer. If an error occurs, the
    /// iterator returns the records read before the error, then the error, and then ends.
    fn turn(&mut self) {
        if let Err(error) = self.read() {
            self.page.push_back(Err(error));
            self.over = true;
        }
        self.over |= self.page.is_empty();
        self.size = (2 * self.size).min(MAX_PAGE_RECORDS);
    }

    fn read(&mut self) -> Result<(), JournalError> {
        let sql = format!("SELECT {COLUMNS} FROM record WHERE seq >= ?1 ORDER BY seq LIMIT ?2");
        let failed = JournalError::database(&self.folder);
        let mut statement = self.connection.prepare_cached(&sql).map_err(&failed)?;
        // A number too large for the database is past its end.
        let Ok(from) = i64::try_from(self.next) else { return Ok(()) };
        let mut rows = statement.query(params![from, self.size]).map_err(&failed)?;
        loop {
            let row = rows.next().map_err(|error| match failed(error) {
                JournalError::Broken { path, what, .. } => JournalError::Broken { path, seq: self.next, what },
                other => other,
            })?;
            let Some(row) = row else { return Ok(()) };
            let record = record_of(row).map_err(|unreadable| JournalError::Broken {
                path: self.folder.clone(),
                seq: self.next,
                what: format!("a field cannot be read ({unreadable})"),
            })?;
            self.next = record.seq.saturating_add(1);
            self.page.push_back(Ok(record));
        }
    }
}

impl Iterator for Records<'_> {
    type Item = Result<Record, JournalError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.page.is_empty() && !self.over {
            self.turn();
        }
        self.page.pop_front()
    }
}

/// Converts `number` to a signed 64-bit integer, because the database has no unsigned integers. A number above
/// [`i64::MAX`] is replaced by [`i64::MAX`]. For a time in nanoseconds, this limit is 292 years.
pub(super) fn signed(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}
