//! The only writer of a journal.

use std::collections::BTreeMap;
use std::fs::{OpenOptions, TryLockError};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use rusqlite::{Connection, OptionalExtension};
use serde_json::Value;

use super::artefact::{self, Artefact};
use super::canonical::{canonical_json, sha256_hex};
use super::clock::utc;
use super::content::{Begin, End, KeyField, Reopen};
use super::error::JournalError;
use super::key::AuditKey;
use super::locked_file::LockedFile;
use super::names::{ANCHOR, DATABASE, LOCK};
use super::record::{Entry, Record, RecordKind, Records, signed, whole};
use super::seal::{SEALED_EVERY, Seal};
use super::verify::{Anchor, read_anchor};
use super::{open, system};

/// Version of the program, as the records name it.
const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Content of the first record.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// Name of the run.
    pub run: String,
    /// Serial number of the part; every record carries it.
    pub part: String,
    /// Person or program that began the run.
    pub actor: String,
    /// Place of the actor.
    pub station: String,
    /// True if any machine of the cell is simulated.
    pub simulation: bool,
    /// Number of the first command.
    pub first_command_id: u32,
    /// Other content: versions, hashes of recipe and cell.
    pub content: Value,
}

/// Journal of a run, open for writing. While it lives, no other process can open it for writing.
#[derive(Debug)]
pub struct Journal {
    connection: Connection,
    folder: PathBuf,
    /// Held, not read.
    _lock: LockedFile,
    boot_id: String,
    run: String,
    part: String,
    first_command_id: u32,
    /// Key that signs the head; without a key nothing is signed.
    key: Option<AuditKey>,
    tail: Tail,
    /// Newest seal of this opening of the journal.
    seal: Option<Seal>,
    /// Number of records when the anchor was last written.
    anchored: u64,
    /// Record whose write failed: only the database knows whether it was stored.
    doubtful: Option<Record>,
    artefacts: BTreeMap<String, String>,
    /// Identity of each file that is written, as found at the first check.
    files: BTreeMap<PathBuf, system::FileIdentity>,
}

/// End of the chain.
#[derive(Clone, Debug)]
struct Tail {
    seq: u64,
    mono_ns: u64,
    cycle: u32,
    hash: String,
    last_command_id: Option<u32>,
    /// True if the run has its end record. Only a seal can follow it.
    closed: bool,
}

impl Tail {
    fn empty() -> Self {
        Self { seq: 0, mono_ns: 0, cycle: 0, hash: "0".repeat(64), last_command_id: None, closed: false }
    }
}

impl Journal {
    /// Creates the folder of a new run and its missing parents. Then creates the journal in the folder, with a first
    /// record from `header`. The journal is not signed.
    ///
    /// # Errors
    /// The folder is not empty or cannot be written, or the disk is full.
    pub fn create(folder: impl AsRef<Path>, header: Header) -> Result<Self, JournalError> {
        Self::create_with(folder, header, None)
    }

    /// Creates the folder and the journal of a new run as [`Journal::create`] does. `key` is the secret key that signs
    /// the journal. With a `key`, the journal is signed at its beginning, again each time [`SEALED_EVERY`] more records
    /// (256) are written, and at its end. Without a `key`, nothing is signed.
    ///
    /// # Errors
    /// Those of [`Journal::create`].
    pub fn create_with(folder: impl AsRef<Path>, header: Header, key: Option<AuditKey>) -> Result<Self, JournalError> {
        let folder = folder.as_ref().to_owned();
        if !open::is_free(&folder)? {
            return Err(JournalError::Exists { path: folder });
        }
        system::create_run_folder(&folder).map_err(JournalError::file(&folder, "creating the folder"))?;
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
            run,
            part,
            first_command_id,
            key,
            tail: Tail::empty(),
            seal: None,
            anchored: 0,
            doubtful: None,
            artefacts: BTreeMap::new(),
            files: BTreeMap::new(),
        };
        let begin = Begin {
            run: Some(journal.run.clone()),
            simulation: Some(simulation),
            first_command_id: Some(first_command_id),
            content,
            regrind: Some(VERSION.to_owned()),
            key: journal.key.as_ref().map(KeyField::new),
        };
        journal.append(Entry { actor, station, ..Entry::new(RecordKind::Begin, 0, 0, begin) })?;
        journal.anchor()?;
        Ok(journal)
    }

    /// Opens the journal of a run to continue the run, and adds a record of the opening. New records are not signed.
    ///
    /// Before that, checks the hash chain of the records. If there is an anchor file (number of records and hash of the
    /// last one), checks only the records from the last record of the anchor on. Without an anchor file, checks all
    /// records. [`super::verify()`] always checks all records.
    ///
    /// # Errors
    /// The folder has no journal. The journal is in use by another process, ended, damaged or changed, or the database
    /// belongs to another program.
    pub fn open(folder: impl AsRef<Path>) -> Result<Self, JournalError> {
        Self::open_with(folder, None)
    }

    /// Opens the journal of a run to continue the run, as [`Journal::open`] does. With a `key`, the new records are
    /// signed. The key can differ from the key at the beginning of the run, because the record of the opening names the
    /// new key.
    ///
    /// # Errors
    /// Those of [`Journal::open`].
    pub fn open_with(folder: impl AsRef<Path>, key: Option<AuditKey>) -> Result<Self, JournalError> {
        Self::open_locked(RunLock::acquire(folder)?, key)
    }

    /// Opens the journal of a run to continue the run, as [`Journal::open_with`] does. The caller has already acquired
    /// `lock`, the lock of the run.
    ///
    /// # Errors
    /// Those of [`Journal::open_with`], except that the journal is in use.
    pub fn open_locked(lock: RunLock, key: Option<AuditKey>) -> Result<Self, JournalError> {
        let RunLock { file: lock, folder } = lock;
        let connection = open::read_write(&folder)?;
        let (run, part, first_command_id) = first_of(&connection, &folder)?;
        let mut journal = Self {
            boot_id: boot_id(),
            run,
            part,
            first_command_id,
            key,
            tail: read_tail(&connection, &folder)?,
            seal: None,
            anchored: 0,
            doubtful: None,
            artefacts: artefacts_of(&connection, &folder)?,
            files: BTreeMap::new(),
            connection,
            folder,
            _lock: lock,
        };
        journal.is_whole()?;
        let reopen = Reopen { regrind: Some(VERSION.to_owned()), key: journal.key.as_ref().map(KeyField::new) };
        journal.append(Entry::new(RecordKind::Reopen, 0, journal.tail.cycle, reopen))?;
        journal.anchor()?;
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

    /// Checks that three files of the journal were not removed or replaced: the database, its write-ahead log and the
    /// lock file. The first call only remembers which files are present. Each later call compares the files with these.
    /// This check is necessary because the operating system accepts writes to a deleted file that is still open, but
    /// the written content is lost.
    ///
    /// # Errors
    /// [`JournalError::Gone`] with the path of a file that is missing or was replaced. A file cannot be inspected.
    pub fn is_in_place(&mut self) -> Result<(), JournalError> {
        for name in [DATABASE.to_owned(), format!("{DATABASE}-wal"), LOCK.to_owned()] {
            let path = self.folder.join(name);
            match (system::identity(&path), self.files.get(&path)) {
                (Ok(found), Some(known)) if found == *known => {}
                (Ok(found), None) => drop(self.files.insert(path, found)),
                // The log is created with the first record.
                (Err(error), None) if error.kind() == std::io::ErrorKind::NotFound => {}
                (Err(error), _) if error.kind() != std::io::ErrorKind::NotFound => {
                    return Err(JournalError::file(&path, "finding it")(error));
                }
                _ => return Err(JournalError::Gone { path }),
            }
        }
        Ok(())
    }

    /// Returns the number of the last record; 0 if there is none.
    pub fn last_seq(&self) -> u64 {
        self.tail.seq
    }

    /// Returns an iterator over the records, in order, beginning with the record number `from`.
    pub fn records(&self, from: u64) -> Records<'_> {
        Records::new(&self.connection, &self.folder, from)
    }

    /// Appends a record and returns its number. On return the record is on the disk. Idempotent: after an error the
    /// caller can give the same entry again, and the record is written only once.
    ///
    /// # Errors
    /// The disk is full or not writable: then no action that needs this record may be performed. A file of the journal
    /// was removed. The run has ended. The entry is not allowed: a seal, a second begin record, an outcome without a
    /// command number, or an intent (use [`Journal::intend`]).
    pub fn append(&mut self, entry: Entry) -> Result<u64, JournalError> {
        let wrong = |what| Err(JournalError::Entry { kind: entry.kind.as_str(), what });
        match (entry.kind, entry.command_id) {
            (RecordKind::Intent, _) => wrong("gets its command number from `intend`"),
            (RecordKind::Outcome, None) => wrong("requires the command number of its intent"),
            (RecordKind::Begin, _) if self.tail.seq > 0 => wrong("must be the first"),
            (RecordKind::Seal, _) => wrong("is written by the journal itself"),
            _ => self.insert(entry).map(|record| record.seq),
        }
    }

    /// Records a command before the command is executed. Returns the new number of the command. The record always has
    /// the kind `intent`, whatever the kind of `entry` is. Idempotent: after an error the caller can give the same
    /// entry again, and the command gets only one number.
    ///
    /// # Errors
    /// Those of [`Journal::append`], or all command numbers are used. The command must then not be executed.
    pub fn intend(&mut self, entry: Entry) -> Result<u32, JournalError> {
        let entry = Entry { kind: RecordKind::Intent, ..entry };
        let stands = self.reread_tail()?.filter(|record| record.is_of(&entry));
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

    /// Returns the records of all commands without a recorded outcome, in the order of their command numbers. After a
    /// crash, the result of each of these commands must be determined before any other action.
    ///
    /// # Errors
    /// The journal cannot be read.
    pub fn open_intents(&self) -> Result<Vec<Record>, JournalError> {
        open_intents(&self.connection, &self.folder)
    }

    /// Writes `bytes` to the file `name` in the run folder, and then adds a record with the name, length and hash of
    /// the file. `mono_ns` is the time since the run began, in nanoseconds. `cycle` is the number of the cycle, 0
    /// before the first. Idempotent: a second call with the same content is not an error and adds no second record.
    ///
    /// # Errors
    /// The name is not a plain relative path. A file with this name and another content is already recorded. The disk
    /// is full or not writable.
    pub fn store(&mut self, name: &str, bytes: &[u8], mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError> {
        let path = artefact::path_within(&self.folder, name)?;
        let sha256 = sha256_hex(bytes);
        if self.artefacts.get(name).is_some_and(|known| *known != sha256) {
            return Err(JournalError::Recorded { path });
        }
        artefact::write_file(&path, bytes)?;
        self.register(Artefact { name: name.to_owned(), bytes: bytes.len() as u64, sha256 }, mono_ns, cycle)
    }

    /// Adds a record of the file `name`, which another part of the program wrote into the run folder. The record has
    /// the name, length and hash of the file. Before that, flushes the file to the disk. `mono_ns` is the time since
    /// the run began, in nanoseconds. `cycle` is the number of the cycle, 0 before the first.
    ///
    /// # Errors
    /// Those of [`Journal::store`]. The file cannot be read.
    pub fn adopt(&mut self, name: &str, mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError> {
        self.adopt_known(Artefact::from_file(&self.folder, name)?, mono_ns, cycle)
    }

    /// Adds a record of the file that `found` describes (name, length and hash). The caller got `found` from
    /// [`Artefact::from_file`], which has already flushed the file to the disk. Does not read the file again. `mono_ns`
    /// is the time since the run began, in nanoseconds. `cycle` is the number of the cycle, 0 before the first.
    ///
    /// # Errors
    /// Those of [`Journal::store`].
    pub fn adopt_known(&mut self, found: Artefact, mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError> {
        let path = artefact::path_within(&self.folder, &found.name)?;
        if self.artefacts.get(&found.name).is_some_and(|known| *known != found.sha256) {
            return Err(JournalError::Recorded { path });
        }
        self.register(found, mono_ns, cycle)
    }

    /// Writes the anchor file: the number of records, the hash of the last of these records, and, if the journal has a
    /// key, the signature of both. With a key, first adds a signature record if records were added since the last one.
    /// Returns the anchor, so that the caller can store a copy elsewhere.
    ///
    /// # Errors
    /// The disk is full or not writable.
    pub fn anchor(&mut self) -> Result<Anchor, JournalError> {
        self.reread_tail()?;
        self.seal()?;
        self.write_anchor()
    }

    /// Ends the run: writes the end record with the content `ending`, signs the journal if it has a key, and writes the
    /// anchor file. Returns the anchor (number of records, hash of the last one, and signature). No further record can
    /// be appended. `mono_ns` is the time since the run began, in nanoseconds. `cycle` is the number of the cycle, 0
    /// before the first.
    ///
    /// # Errors
    /// Those of [`Journal::append`].
    pub fn close(mut self, mono_ns: u64, cycle: u32, ending: Value) -> Result<Anchor, JournalError> {
        self.end(mono_ns, cycle, ending)
    }

    /// Ends the run as [`Journal::close`] does, but does not consume the journal. After an error the caller can
    /// therefore call this function again; the end record is written only once. Returns the anchor (number of records,
    /// hash of the last one, and signature).
    ///
    /// # Errors
    /// Those of [`Journal::append`].
    pub fn end(&mut self, mono_ns: u64, cycle: u32, ending: Value) -> Result<Anchor, JournalError> {
        self.reread_tail()?;
        if !self.tail.closed {
            let end = End { ending, records_before: Some(self.tail.seq), head_before: Some(self.tail.hash.clone()) };
            self.append(Entry::new(RecordKind::End, mono_ns, cycle, end))?;
        }
        let anchor = self.anchor()?;
        // The run is complete: from now on, closing the database writes the log into it.
        open::keep_the_log(&self.connection, false).map_err(JournalError::database(&self.folder))?;
        Ok(anchor)
    }

    fn register(&mut self, artefact: Artefact, mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError> {
        if !self.artefacts.contains_key(&artefact.name) {
            self.append(Entry::new(RecordKind::Artefact, mono_ns, cycle, &artefact))?;
            self.artefacts.insert(artefact.name.clone(), artefact.sha256.clone());
        }
        Ok(artefact)
    }

    /// Adds a seal: a record with the signature of the number of records and the hash of the last record. Does nothing
    /// if the journal has no key, or if no record was added since the last seal.
    fn seal(&mut self) -> Result<(), JournalError> {
        let Some(key) = self.key.as_ref().filter(|_| self.tail.seq > self.sealed()) else { return Ok(()) };
        let seal = Seal::new(key, &self.run, self.tail.seq, &self.tail.hash);
        self.put(Entry::new(RecordKind::Seal, self.tail.mono_ns, self.tail.cycle, &seal))?;
        self.seal = Some(seal);
        Ok(())
    }

    /// Returns the record number of the newest seal (signature record) that was written since the journal was opened.
    /// Returns 0 if there is none.
    fn sealed(&self) -> u64 {
        self.seal.as_ref().map_or(0, |seal| seal.records + 1)
    }

    /// Writes the anchor file (number of records, hash of the last one, and optionally a signature), and returns this
    /// anchor. If a seal (signature record) was written since the journal was opened, the number, the hash and the
    /// signature are those of the newest seal. Otherwise the anchor has the number and the hash of the last record, and
    /// no signature.
    fn write_anchor(&mut self) -> Result<Anchor, JournalError> {
        let anchor = match &self.seal {
            Some(seal) => Anchor::sealed(&self.run, seal),
            None => Anchor::new(self.tail.seq, self.tail.hash.clone()),
        };
        let mut text = canonical_json(&serde_json::to_value(&anchor).unwrap_or_default());
        text.push('\n');
        artefact::write_file(&self.folder.join(ANCHOR), text.as_bytes())?;
        self.anchored = self.tail.seq;
        Ok(anchor)
    }

    /// Adds a seal (signature record) if the journal has a key and at least [`SEALED_EVERY`] records (256) were added
    /// since the last seal. Writes the anchor file (number of records and hash of the last one) if at least
    /// [`SEALED_EVERY`] records were added since the last anchor. Does nothing after the end record.
    ///
    /// Ignores errors, because they do not affect the records already written. The next append, or the end of the run,
    /// tries again.
    fn seal_when_due(&mut self) {
        if self.tail.closed {
            return;
        }
        if self.tail.seq >= self.sealed() + SEALED_EVERY && self.seal().is_err() {
            return;
        }
        if self.tail.seq >= self.anchored + SEALED_EVERY {
            let _ = self.write_anchor();
        }
    }

    fn insert(&mut self, entry: Entry) -> Result<Record, JournalError> {
        let record = self.put(entry)?;
        self.seal_when_due();
        Ok(record)
    }

    fn put(&mut self, entry: Entry) -> Result<Record, JournalError> {
        if let Some(stands) = self.reread_tail()?.filter(|record| record.is_of(&entry)) {
            return Ok(stands);
        }
        if self.tail.closed && entry.kind != RecordKind::Seal {
            return Err(JournalError::Closed { path: self.folder.clone() });
        }
        self.is_in_place()?;
        let record = self.record_of(entry);
        if let Err(error) = self.write(&record) {
            self.doubtful = Some(record);
            return Err(error);
        }
        self.tail.seq = record.seq;
        self.tail.hash.clone_from(&record.hash);
        self.tail.closed |= record.kind == RecordKind::End;
        (self.tail.mono_ns, self.tail.cycle) = (record.mono_ns, record.cycle);
        if record.kind == RecordKind::Intent {
            self.tail.last_command_id = record.command_id;
        }
        Ok(record)
    }

    fn record_of(&self, entry: Entry) -> Record {
        let mut record = Record {
            seq: self.tail.seq + 1,
            utc: utc(SystemTime::now()),
            boot_id: self.boot_id.clone(),
            // Clamped, so that the stored value is the hashed value.
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
        record.hash = record.expected_hash();
        record
    }

    /// Writes a record to the database. On return it is on the disk, because one statement is one transaction.
    fn write(&self, r: &Record) -> Result<(), JournalError> {
        r.put_into(&self.connection).map_err(JournalError::database(&self.folder))
    }

    /// Checks whether a record was stored although its write reported an error. Does nothing and returns `None` if the
    /// last write had no error. Otherwise reads the last record of the database again. Returns the record of the failed
    /// write if it is the last record of the database. Returns `None` if that record was not stored.
    fn reread_tail(&mut self) -> Result<Option<Record>, JournalError> {
        let Some(record) = &self.doubtful else { return Ok(None) };
        self.tail = read_tail(&self.connection, &self.folder)?;
        let stands = self.tail.hash == record.hash;
        let stands = self.doubtful.take().filter(|_| stands);
        if let Some(record) = stands.as_ref().filter(|record| record.kind == RecordKind::Seal) {
            self.seal = serde_json::from_str(&record.payload).ok();
        }
        Ok(stands)
    }

    /// Checks that no record was removed or changed since the anchor file (number of records and hash of the last one)
    /// was written. Without an anchor file, checks the hash chain of all records. A journal that fails this check must
    /// not be continued, because the next signature would cover the changed records.
    ///
    /// # Errors
    /// [`JournalError::Broken`] with the number of the first wrong record. A record or the anchor cannot be read.
    fn is_whole(&self) -> Result<(), JournalError> {
        let broken = |seq, what| Err(JournalError::Broken { path: self.folder.clone(), seq, what });
        let (mut records, mut head) = (0, Tail::empty().hash);
        if let Some(anchor) = read_anchor(&self.folder)? {
            if anchor.records > self.tail.seq {
                let what = format!("{} records were written, and {} are present", anchor.records, self.tail.seq);
                return broken(self.tail.seq + 1, what);
            }
            let last = self.records(anchor.records).next().transpose()?.filter(|r| r.seq == anchor.records);
            if last.is_none_or(|record| record.hash != anchor.head) {
                return broken(
                    anchor.records,
                    "its hash differs from that of the anchor: the journal was rewritten".into(),
                );
            }
            (records, head) = (anchor.records, anchor.head);
        }
        for record in self.records(records + 1) {
            let record = record?;
            if let Some(flaw) = record.successor_flaw(records, &head) {
                return broken(records + 1, flaw);
            }
            (records, head) = (record.seq, record.hash);
        }
        Ok(())
    }
}

/// Lock of a run. While it lives, no other process can continue the run.
#[derive(Debug)]
pub struct RunLock {
    file: LockedFile,
    folder: PathBuf,
}

impl RunLock {
    /// Locks the run in a folder. The lock lasts until the returned value is dropped.
    ///
    /// # Errors
    /// The folder has no journal, or another process drives the run.
    pub fn acquire(folder: impl AsRef<Path>) -> Result<Self, JournalError> {
        let folder = folder.as_ref().to_owned();
        if !folder.join(DATABASE).is_file() {
            return Err(JournalError::Absent { path: folder });
        }
        Ok(Self { file: lock(&folder)?, folder })
    }
}

fn lock(folder: &Path) -> Result<LockedFile, JournalError> {
    let path = folder.join(LOCK);
    let failed = JournalError::file(&path, "creating it");
    let file = OpenOptions::new().write(true).create(true).truncate(false).open(&path).map_err(&failed)?;
    LockedFile::lock(file).map_err(|error| match error {
        TryLockError::WouldBlock => JournalError::Busy { path: folder.to_owned() },
        TryLockError::Error(error) => JournalError::file(&path, "locking it")(error),
    })
}

fn boot_id() -> String {
    format!("{:016x}", rand::random::<u64>())
}

/// Returns three values of the first record: the name of the run, the serial number of the part, and the first command
/// number.
///
/// # Errors
/// There is no record, or the first record is not the beginning of a run.
fn first_of(connection: &Connection, folder: &Path) -> Result<(String, String, u32), JournalError> {
    let broken = |what: &str| JournalError::Broken { path: folder.to_owned(), seq: 1, what: what.to_owned() };
    let first = Records::new(connection, folder, 0).next().ok_or_else(|| broken("there is no record"))??;
    if first.kind != RecordKind::Begin {
        return Err(broken("it is not the beginning of a run"));
    }
    let begin = Begin::<Value>::read(&first).ok_or_else(|| broken("it is not a JSON object"))?;
    let run = begin.run.ok_or_else(|| broken("it names no run"))?;
    let id = begin.first_command_id.ok_or_else(|| broken("it names no first command number"))?;
    Ok((run, first.part, id))
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
    let sql = "SELECT seq, mono_ns, cycle, hash FROM record ORDER BY seq DESC LIMIT 1";
    let last = connection.query_row(sql, [], |row| {
        let (seq, mono_ns, cycle, hash) = (whole(row, 0)?, whole(row, 1)?, row.get(2)?, row.get(3)?);
        Ok(Tail { seq, mono_ns, cycle, hash, ..Tail::empty() })
    });
    let Some(tail) = last.optional().map_err(&failed)? else { return Ok(Tail::empty()) };
    let ask = |sql| connection.prepare_cached(sql).map_err(&failed);
    let last_command_id =
        ask("SELECT max(command_id) FROM record NOT INDEXED")?.query_row([], |row| row.get(0)).map_err(&failed)?;
    // The end record is the last record, or the one before its seal.
    let ended = "SELECT count(*) FROM record WHERE seq >= ?1 AND kind = 'end'";
    let ends = ask(ended)?.query_row([signed(tail.seq) - 1], |row| row.get::<_, u32>(0)).map_err(&failed)?;
    Ok(Tail { last_command_id, closed: ends > 0, ..tail })
}

/// Returns the records of all commands without a recorded outcome, in the order of their command numbers. Reads the
/// table of records and does not use the database index, because the hash chain does not protect the index.
pub(super) fn open_intents(connection: &Connection, folder: &Path) -> Result<Vec<Record>, JournalError> {
    let failed = JournalError::database(folder);
    let sql = "SELECT seq, command_id, kind = 'intent' FROM record NOT INDEXED
        WHERE kind IN ('intent', 'outcome') AND command_id IS NOT NULL ORDER BY seq";
    let mut statement = connection.prepare(sql).map_err(&failed)?;
    let mut rows = statement.query([]).map_err(&failed)?;
    let mut open = BTreeMap::new();
    while let Some(row) = rows.next().map_err(&failed)? {
        let (seq, id) = (whole(row, 0).map_err(&failed)?, row.get::<_, u32>(1).map_err(&failed)?);
        match row.get(2).map_err(&failed)? {
            true => drop(open.insert(id, seq)),
            false => drop(open.remove(&id)),
        }
    }
    let first = |seq| Records::new(connection, folder, seq).next().transpose();
    open.into_values().filter_map(|seq| first(seq).transpose()).collect()
}
