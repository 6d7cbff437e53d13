//! The one writer of a journal.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::path::{Path, PathBuf};

use rusqlite::{Connection, OptionalExtension, params};
use serde_json::{Value, json};

use super::artefact::{self, Artefact};
use super::canonical::canonical_json;
use super::error::JournalError;
use super::record::{COLUMNS, Entry, Kind, Record, Records, whole};
use super::verify::{Anchor, read_anchor};
use super::{ANCHOR, DATABASE, LOCK, open};

/// What the first record tells.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// The name of the run.
    pub run: String,
    /// The serial number of the part; every record carries it.
    pub part: String,
    /// Who began the run.
    pub actor: String,
    /// Where.
    pub station: String,
    /// Whether any machine of the cell is simulated.
    pub simulation: bool,
    /// The number of the first command.
    pub first_command_id: u32,
    /// Anything else: versions, hashes of recipe and cell.
    pub content: Value,
}

/// The journal of a run, open for writing. While it lives no other process can open it so.
#[derive(Debug)]
pub struct Journal {
    connection: Connection,
    folder: PathBuf,
    /// Held, not read.
    _lock: File,
    boot_id: String,
    part: String,
    first_command_id: u32,
    tail: Tail,
    /// A record whose write failed: only the database knows whether it stands.
    doubtful: Option<Record>,
    artefacts: BTreeMap<String, String>,
}

/// The end of the chain.
#[derive(Clone, Debug)]
struct Tail {
    seq: u64,
    hash: String,
    last_command_id: Option<u32>,
    closed: bool,
}

impl Tail {
    fn of_nothing() -> Self {
        Self { seq: 0, hash: "0".repeat(64), last_command_id: None, closed: false }
    }
}

impl Journal {
    /// Makes the folder of a new run, with its parents, and its journal with the first record.
    ///
    /// # Errors
    /// A folder that is in use or cannot be written; a full disk.
    pub fn create(folder: impl AsRef<Path>, header: Header) -> Result<Self, JournalError> {
        let folder = folder.as_ref().to_owned();
        if !open::is_free(&folder)? {
            return Err(JournalError::Exists { path: folder });
        }
        fs::create_dir_all(&folder).map_err(JournalError::file(&folder, "creating the folder"))?;
        let lock = lock(&folder)?;
        let connection = open::create(&folder)?;
        open::sync_folder(&folder)?;
        folder.parent().map_or(Ok(()), open::sync_folder)?;
        let Header { run, part, actor, station, simulation, first_command_id, content } = header;
        let mut journal = Self {
            connection,
            folder,
            _lock: lock,
            boot_id: boot_id(),
            part,
            first_command_id,
            tail: Tail::of_nothing(),
            doubtful: None,
            artefacts: BTreeMap::new(),
        };
        let payload = json!({
            "run": run, "simulation": simulation, "first_command_id": first_command_id, "content": content,
            "regrind": env!("CARGO_PKG_VERSION"),
        });
        journal.append(Entry { actor, station, ..Entry::new(Kind::Begin, 0, 0, payload) })?;
        journal.anchor()?;
        Ok(journal)
    }

    /// Opens the journal of a run to go on with it, and records that. The chain is not verified here; see [`super::verify`].
    ///
    /// # Errors
    /// No journal there, one of another program, one that is in use, or closed.
    pub fn open(folder: impl AsRef<Path>) -> Result<Self, JournalError> {
        let folder = folder.as_ref().to_owned();
        if !folder.join(DATABASE).is_file() {
            return Err(JournalError::Absent { path: folder });
        }
        let lock = lock(&folder)?;
        let connection = open::read_write(&folder)?;
        let (part, first_command_id) = first_of(&connection, &folder)?;
        let artefacts = artefacts_of(&connection, &folder)?;
        let tail = read_tail(&connection, &folder)?;
        let doubtful = None;
        let boot_id = boot_id();
        let mut journal =
            Self { connection, folder, _lock: lock, boot_id, part, first_command_id, tail, doubtful, artefacts };
        journal.is_whole()?;
        journal.append(Entry::new(Kind::Reopen, 0, 0, json!({ "regrind": env!("CARGO_PKG_VERSION") })))?;
        Ok(journal)
    }

    /// Returns the run folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Returns the serial number of the part.
    pub fn part(&self) -> &str {
        &self.part
    }

    /// Returns the number of the last record.
    pub fn last_seq(&self) -> u64 {
        self.tail.seq
    }

    /// Returns the records from a number on, in order.
    pub fn records(&self, from: u64) -> Records<'_> {
        Records::new(&self.connection, &self.folder, from)
    }

    /// Records something and returns its number. On return it is on the disk. After an error the same entry may be given again: it
    /// is written once, whatever became of the first try.
    ///
    /// # Errors
    /// A full or unwritable disk: then nothing may be done that needed this record. A closed journal.
    pub fn append(&mut self, entry: Entry) -> Result<u64, JournalError> {
        let wrong = |what| Err(JournalError::Entry { kind: entry.kind.as_str(), what });
        match (entry.kind, entry.command_id) {
            (Kind::Intent, _) => wrong("gets its command number from `intend`"),
            (Kind::Outcome, None) => wrong("needs the command number of its intent"),
            (Kind::Begin, _) if self.tail.seq > 0 => wrong("stands first only"),
            _ => self.insert(entry).map(|record| record.seq),
        }
    }

    /// Records a command before it is carried out, under the next command number, which is returned. No number is used twice.
    ///
    /// # Errors
    /// As [`Journal::append`]: then the command must not be carried out.
    pub fn intend(&mut self, entry: Entry) -> Result<u32, JournalError> {
        let entry = Entry { kind: Kind::Intent, ..entry };
        let stands = self.ask_where_it_ends()?.filter(|record| record.is_of(&entry));
        if let Some(id) = stands.and_then(|record| record.command_id) {
            return Ok(id);
        }
        let id = match self.tail.last_command_id {
            None => self.first_command_id,
            Some(last) => last.checked_add(1).ok_or(JournalError::CommandNumbers { limit: u32::MAX })?,
        };
        self.insert(Entry { command_id: Some(id), ..entry })?;
        Ok(id)
    }

    /// Returns the commands that are on record without an outcome, in order. After a crash they are reconciled before anything
    /// else is done.
    ///
    /// # Errors
    /// A journal that cannot be read.
    pub fn open_intents(&self) -> Result<Vec<Record>, JournalError> {
        open_intents(&self.connection, &self.folder)
    }

    /// Brings a file to the disk, then on record. The same content again is no error and no second record.
    ///
    /// # Errors
    /// A name that is no plain relative path, another content under a name that is on record, a full or unwritable disk.
    pub fn store(&mut self, name: &str, bytes: &[u8], mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError> {
        let path = artefact::path_within(&self.folder, name)?;
        let sha256 = super::sha256_hex(bytes);
        if self.artefacts.get(name).is_some_and(|known| *known != sha256) {
            return Err(JournalError::Recorded { path });
        }
        artefact::write_file(&path, bytes)?;
        self.register(Artefact { name: name.to_owned(), bytes: bytes.len() as u64, sha256 }, mono_ns, cycle)
    }

    /// Brings a file that was written into the run folder by another room on record, after bringing it to the disk.
    ///
    /// # Errors
    /// As [`Journal::store`].
    pub fn adopt(&mut self, name: &str, mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError> {
        self.adopt_known(Artefact::of(&self.folder, name)?, mono_ns, cycle)
    }

    /// Brings a file on record that was brought to the disk and read already, by [`Artefact::of`].
    ///
    /// # Errors
    /// As [`Journal::store`].
    pub fn adopt_known(&mut self, found: Artefact, mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError> {
        let path = artefact::path_within(&self.folder, &found.name)?;
        if self.artefacts.get(&found.name).is_some_and(|known| *known != found.sha256) {
            return Err(JournalError::Recorded { path });
        }
        self.register(found, mono_ns, cycle)
    }

    /// Writes the number of records and the hash of the last beside the journal, and returns them to be kept elsewhere too.
    ///
    /// # Errors
    /// A full or unwritable disk.
    pub fn anchor(&mut self) -> Result<Anchor, JournalError> {
        self.ask_where_it_ends()?;
        let anchor = Anchor { records: self.tail.seq, head: self.tail.hash.clone() };
        let mut text = canonical_json(&json!({ "records": anchor.records, "head": anchor.head }));
        text.push('\n');
        artefact::write_file(&self.folder.join(ANCHOR), text.as_bytes())?;
        Ok(anchor)
    }

    /// Writes the last record of the run and the anchor. Nothing can be recorded after it.
    ///
    /// # Errors
    /// As [`Journal::append`].
    pub fn close(mut self, mono_ns: u64, cycle: u32, ending: Value) -> Result<Anchor, JournalError> {
        self.end(mono_ns, cycle, ending)
    }

    /// As [`Journal::close`], for who may have to try again.
    ///
    /// # Errors
    /// As [`Journal::append`].
    pub fn end(&mut self, mono_ns: u64, cycle: u32, ending: Value) -> Result<Anchor, JournalError> {
        self.ask_where_it_ends()?;
        if !self.tail.closed {
            let payload = json!({ "ending": ending, "records_before": self.tail.seq, "head_before": self.tail.hash });
            self.append(Entry::new(Kind::End, mono_ns, cycle, payload))?;
        }
        self.anchor()
    }

    fn register(&mut self, artefact: Artefact, mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError> {
        if !self.artefacts.contains_key(&artefact.name) {
            let payload = json!({ "name": artefact.name, "bytes": artefact.bytes, "sha256": artefact.sha256 });
            self.append(Entry::new(Kind::Artefact, mono_ns, cycle, payload))?;
            self.artefacts.insert(artefact.name.clone(), artefact.sha256.clone());
        }
        Ok(artefact)
    }

    fn insert(&mut self, entry: Entry) -> Result<Record, JournalError> {
        if let Some(stands) = self.ask_where_it_ends()?.filter(|record| record.is_of(&entry)) {
            return Ok(stands);
        }
        if self.tail.closed {
            return Err(JournalError::Closed { path: self.folder.clone() });
        }
        let record = self.record_of(entry);
        if let Err(error) = self.write(&record) {
            self.doubtful = Some(record);
            return Err(error);
        }
        self.tail.seq = record.seq;
        self.tail.hash.clone_from(&record.hash);
        self.tail.closed = record.kind == Kind::End;
        if record.kind == Kind::Intent {
            self.tail.last_command_id = record.command_id;
        }
        Ok(record)
    }

    fn record_of(&self, entry: Entry) -> Record {
        let mut record = Record {
            seq: self.tail.seq + 1,
            utc: jiff::Timestamp::now().to_string(),
            boot_id: self.boot_id.clone(),
            // What does not fit the database would not be what was hashed.
            mono_ns: entry.mono_ns.min(i64::MAX as u64),
            actor: entry.actor,
            station: entry.station,
            kind: entry.kind,
            part: self.part.clone(),
            cycle: entry.cycle,
            command_id: entry.command_id,
            reason: entry.reason,
            payload: canonical_json(&entry.payload),
            prev_hash: self.tail.hash.clone(),
            hash: String::new(),
        };
        record.hash = record.hash_due();
        record
    }

    /// One statement is one transaction: when it returns, it is committed and synced.
    fn write(&self, r: &Record) -> Result<(), JournalError> {
        let failed = JournalError::database(&self.folder);
        let sql = format!(
            "INSERT INTO record ({COLUMNS}) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11, ?12, ?13, ?14)"
        );
        let mut statement = self.connection.prepare_cached(&sql).map_err(&failed)?;
        let kind = r.kind.as_str();
        let values = params![
            signed(r.seq),
            r.utc,
            r.boot_id,
            signed(r.mono_ns),
            r.actor,
            r.station,
            kind,
            r.part,
            r.cycle,
            r.command_id,
            r.reason,
            r.payload,
            r.prev_hash,
            r.hash
        ];
        statement.execute(values).map(|_| ()).map_err(failed)
    }

    /// After a failed write the record may stand or not; the database is asked. Returns it if it does.
    fn ask_where_it_ends(&mut self) -> Result<Option<Record>, JournalError> {
        let Some(record) = &self.doubtful else { return Ok(None) };
        self.tail = read_tail(&self.connection, &self.folder)?;
        let stands = self.tail.hash == record.hash;
        Ok(self.doubtful.take().filter(|_| stands))
    }

    /// A journal that ends before its anchor was cut, and is not gone on with.
    fn is_whole(&self) -> Result<(), JournalError> {
        match read_anchor(&self.folder)? {
            Some(anchor) if anchor.records > self.tail.seq => Err(JournalError::Broken {
                path: self.folder.clone(),
                seq: self.tail.seq + 1,
                what: format!("{} records were written, and {} are there", anchor.records, self.tail.seq),
            }),
            _ => Ok(()),
        }
    }
}

fn lock(folder: &Path) -> Result<File, JournalError> {
    let path = folder.join(LOCK);
    let failed = JournalError::file(&path, "creating it");
    let file = OpenOptions::new().write(true).create(true).truncate(false).open(&path).map_err(&failed)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(JournalError::Busy { path: folder.to_owned() }),
        Err(TryLockError::Error(error)) => Err(JournalError::file(&path, "locking it")(error)),
    }
}

/// The database counts with a sign; 292 years of nanoseconds fit.
fn signed(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

fn boot_id() -> String {
    format!("{:016x}", rand::random::<u64>())
}

fn first_of(connection: &Connection, folder: &Path) -> Result<(String, u32), JournalError> {
    let broken = |what: &str| JournalError::Broken { path: folder.to_owned(), seq: 1, what: what.to_owned() };
    let first = Records::new(connection, folder, 0).next().ok_or_else(|| broken("there is no record"))??;
    if first.kind != Kind::Begin {
        return Err(broken("it is not the beginning of a run"));
    }
    let id = first.value()["first_command_id"].as_u64().and_then(|id| u32::try_from(id).ok());
    Ok((first.part, id.ok_or_else(|| broken("it names no first command number"))?))
}

fn artefacts_of(connection: &Connection, folder: &Path) -> Result<BTreeMap<String, String>, JournalError> {
    let failed = JournalError::database(folder);
    let mut statement = connection.prepare("SELECT payload FROM record WHERE kind = 'artefact'").map_err(&failed)?;
    let payloads = statement.query_map([], |row| row.get::<_, String>(0)).map_err(&failed)?;
    let mut known = BTreeMap::new();
    for payload in payloads {
        if let Ok(artefact) = serde_json::from_str::<Artefact>(&payload.map_err(&failed)?) {
            known.insert(artefact.name, artefact.sha256);
        }
    }
    Ok(known)
}

fn read_tail(connection: &Connection, folder: &Path) -> Result<Tail, JournalError> {
    let failed = JournalError::database(folder);
    let last = connection
        .query_row("SELECT seq, hash, kind FROM record ORDER BY seq DESC LIMIT 1", [], |row| {
            Ok((whole(row, 0)?, row.get::<_, String>(1)?, row.get::<_, String>(2)?))
        })
        .optional()
        .map_err(&failed)?;
    let Some((seq, hash, kind)) = last else { return Ok(Tail::of_nothing()) };
    let last_command_id =
        connection.query_row("SELECT max(command_id) FROM record", [], |row| row.get(0)).map_err(&failed)?;
    Ok(Tail { seq, hash, last_command_id, closed: kind == Kind::End.as_str() })
}

/// Returns the intents without an outcome, in order.
pub(super) fn open_intents(connection: &Connection, folder: &Path) -> Result<Vec<Record>, JournalError> {
    let failed = JournalError::database(folder);
    let sql = "SELECT seq FROM record AS intent WHERE kind = 'intent' AND NOT EXISTS
        (SELECT 1 FROM record WHERE kind = 'outcome' AND command_id = intent.command_id) ORDER BY seq";
    let mut statement = connection.prepare(sql).map_err(&failed)?;
    let numbers = statement.query_map([], |row| whole(row, 0)).map_err(&failed)?;
    let mut open = Vec::new();
    for seq in numbers {
        open.extend(Records::new(connection, folder, seq.map_err(&failed)?).next().transpose()?);
    }
    Ok(open)
}
