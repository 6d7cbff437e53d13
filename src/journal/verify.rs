//! Verifies that a journal is what was written.

use std::collections::BTreeSet;
use std::fs;
use std::io::{self, Read};
use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::artefact::{Artefact, describe, path_within, temporary_name};
use super::content::{Begin, KeyField, Reopen, read_unique};
use super::error::JournalError;
use super::key::PublicKey;
use super::names::{ANCHOR, DATABASE, LOCK};
use super::reader::Reader;
use super::record::{Record, RecordKind};
use super::seal::{Seal, is_signed};

/// Length of the journal at some time, and the hash of its last record then. A copy kept elsewhere proves that no
/// record up to this one was cut off.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Anchor {
    /// Number of records.
    pub records: u64,
    /// Hash of the last record.
    pub head: String,
    /// Name of the run, if the head is signed. An anchor without a signature omits this field and the fields below.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub run: Option<String>,
    /// Public key of the signer, 64 hexadecimal digits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub key: Option<String>,
    /// Signature, 128 hexadecimal digits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub signature: Option<String>,
}

impl Anchor {
    /// Creates an anchor (length and last hash of a journal at some time) without a signature. `records` is the number
    /// of records. `head` is the hash of the last of these records.
    pub fn new(records: u64, head: String) -> Self {
        Self { records, head, run: None, key: None, signature: None }
    }

    /// Creates a signed anchor (length and last hash of a journal at some time) from `seal`, a signature record of the
    /// journal. `run` is the name of the run. The anchor gets the number of records, the hash, the public key and the
    /// signature of the seal.
    pub(super) fn sealed(run: &str, seal: &Seal) -> Self {
        Self {
            records: seal.records,
            head: seal.head.clone(),
            run: Some(run.to_owned()),
            key: Some(seal.key.clone()),
            signature: Some(seal.signature.clone()),
        }
    }
}

/// External evidence to verify a journal against, in addition to the journal itself and the anchor in its folder.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ExternalEvidence {
    /// Anchor that was kept elsewhere.
    pub anchor: Option<Anchor>,
    /// Keys that are trusted to sign. If empty, every key that the journal names is accepted.
    pub keys: Vec<PublicKey>,
}

/// Result of the verification of an intact journal.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Verified {
    /// Number of records.
    pub records: u64,
    /// Hash of the last record.
    pub head: String,
    /// Number of the last record up to which an anchor proves that nothing was cut; 0 without an anchor.
    pub anchored: u64,
    /// True if the run has its end record. If it has none, nothing proves that records after the anchor are complete.
    pub closed: bool,
    /// Number of recorded files. All of them exist and are unchanged.
    pub artefacts: u64,
    /// Numbers of the commands without an outcome.
    pub open_intents: Vec<u32>,
    /// True if a process drives the run now, so that its end is still to come.
    pub under_way: bool,
    /// Files of the folder that are in no record, sorted, without the journal's own files.
    pub unrecorded: Vec<String>,
    /// Keys that the run signed with, in the order in which the record names them; empty if the run is not signed.
    pub keys: Vec<PublicKey>,
    /// Number of seals.
    pub seals: u64,
    /// Number of the last record that a signature covers; 0 if none does.
    pub signed: u64,
}

impl Verified {
    /// Returns true if the end of a signed run is not signed. This means: the run names a public key and has an end
    /// record, but no seal (signature record) follows the end record. In this case, somebody without the secret key
    /// could have written the end record. While a process drives the run, this process can still add the seal.
    pub fn lacks_last_seal(&self) -> bool {
        !self.keys.is_empty() && self.closed && self.signed + 1 != self.records
    }
}

/// Verifies the journal of a run folder: the hash chain of the records, the signatures, and the content of the recorded
/// files. Also compares the journal with the anchor file in the folder, which states the number of records and the hash
/// of the last one. Returns a summary if the journal is intact.
///
/// # Errors
/// [`JournalError::Broken`] with the number of the first record that fails. The journal cannot be read.
pub fn verify(folder: impl AsRef<Path>) -> Result<Verified, JournalError> {
    verify_against(folder, &ExternalEvidence::default())
}

/// Verifies the journal of a run folder as [`verify`] does, and also compares the journal with the external evidence
/// `against`. This evidence is an anchor (number of records and hash of the last one) that was kept elsewhere, and the
/// keys that are trusted to sign. If no keys are given, the author is not checked.
///
/// # Errors
/// Those of [`verify`]. [`JournalError::NoAuthor`] if the journal is intact, but the run was begun or resumed without
/// one of the trusted keys.
pub fn verify_against(folder: impl AsRef<Path>, against: &ExternalEvidence) -> Result<Verified, JournalError> {
    let folder = folder.as_ref();
    let beside = read_anchor(folder)?;
    let anchors: Vec<&Anchor> = beside.iter().chain(&against.anchor).collect();
    examine(folder, &anchors, &against.keys)
}

/// Reads the anchor file of a run folder. The anchor states the number of records and the hash of the last one. Returns
/// `None` if the file does not exist.
///
/// # Errors
/// The file cannot be read, or it is not a valid anchor.
pub fn anchor_of(folder: &Path) -> Result<Option<Anchor>, JournalError> {
    read_anchor(folder)
}

/// Reads the anchor file of a run folder. The anchor states the number of records and the hash of the last one. Returns
/// `None` if the file does not exist.
///
/// # Errors
/// The file cannot be read, or it is not a valid anchor.
pub(super) fn read_anchor(folder: &Path) -> Result<Option<Anchor>, JournalError> {
    let path = folder.join(ANCHOR);
    match read_few(&path) {
        Ok(bytes) => serde_json::from_slice(&bytes)
            .map(Some)
            .map_err(|_| broken(folder, 0, "journal.anchor is not a valid anchor")),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(JournalError::file(&path, "reading it")(error)),
    }
}

/// Maximum length of an anchor file, in bytes.
const MAX_ANCHOR_BYTES: u64 = 4096;

/// Reads at most the first [`MAX_ANCHOR_BYTES`] bytes of the file `path`.
///
/// # Errors
/// `path` is not a regular file: other kinds, such as devices, could deliver bytes without end. The file cannot be
/// read.
fn read_few(path: &Path) -> io::Result<Vec<u8>> {
    if !fs::metadata(path)?.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "it is not a file"));
    }
    let mut bytes = Vec::new();
    fs::File::open(path)?.take(MAX_ANCHOR_BYTES).read_to_end(&mut bytes)?;
    Ok(bytes)
}

fn broken(folder: &Path, seq: u64, what: impl Into<String>) -> JournalError {
    JournalError::Broken { path: folder.to_owned(), seq, what: what.into() }
}

/// State of the verification after the records read so far.
#[derive(Clone)]
struct VerifierState<'a> {
    folder: &'a Path,
    /// Keys that are trusted to sign. If empty, every key that the journal names is accepted.
    trusted: &'a [PublicKey],
    records: u64,
    head: String,
    /// Number of the end record.
    ended: Option<u64>,
    run: String,
    /// Key that the newest begin or reopen record names.
    key: Option<PublicKey>,
    /// Reason why the trusted keys do not prove the author, from the first record where this is so.
    no_author: Option<String>,
    keys: Vec<PublicKey>,
    seals: u64,
    signed: u64,
    names: BTreeSet<String>,
    artefacts: u64,
    last_intent: Option<u32>,
    open: BTreeSet<u32>,
    answered: BTreeSet<u32>,
}

fn examine(folder: &Path, anchors: &[&Anchor], trusted: &[PublicKey]) -> Result<Verified, JournalError> {
    let reader = Reader::open(folder)?;
    // Checked before anything is read: a run that no process drives does not change any more.
    let under_way = is_driven(folder);
    let mut seen = VerifierState::new(folder, trusted);
    let mut anchored = 0;
    for record in reader.records(1) {
        seen.check_record(&record?)?;
        for anchor in anchors.iter().filter(|anchor| anchor.records == seen.records) {
            seen.check_anchor(anchor)?;
            anchored = seen.records;
        }
    }
    if seen.records == 0 {
        return Err(broken(folder, 1, "there is no record"));
    }
    if let Some(anchor) = anchors.iter().find(|anchor| anchor.records > seen.records) {
        let what =
            format!("{} records were written, and {} are present: the end was cut off", anchor.records, seen.records);
        return Err(broken(folder, seen.records + 1, what));
    }
    if let Some(number) = reader.number_before_the_first()? {
        return Err(broken(folder, 0, format!("a record with the number {number} precedes the first")));
    }
    if let Some(what) = seen.no_author {
        return Err(JournalError::NoAuthor { path: folder.to_owned(), what });
    }
    let VerifierState { records, head, ended, artefacts, names, open, keys, seals, signed, .. } = seen;
    Ok(Verified {
        records,
        head,
        anchored,
        closed: ended.is_some(),
        artefacts,
        open_intents: open.into_iter().collect(),
        under_way,
        unrecorded: unrecorded(folder, &names)?,
        keys,
        seals,
        signed,
    })
}

/// Returns true if a process drives the run in a folder. Such a process holds the lock file of the folder as long as it
/// drives the run. Returns false if there is no lock file, or if the lock file cannot be opened.
pub fn is_driven(folder: &Path) -> bool {
    let path = folder.join(LOCK);
    if !fs::metadata(&path).is_ok_and(|found| found.is_file()) {
        return false;
    }
    let lock = fs::File::open(path);
    lock.is_ok_and(|lock| matches!(lock.try_lock_shared(), Err(fs::TryLockError::WouldBlock)))
}

/// Returns the sorted names of the files in a run folder that are not in `recorded`. The journal's own files are
/// omitted.
fn unrecorded(folder: &Path, recorded: &BTreeSet<String>) -> Result<Vec<String>, JournalError> {
    let mut names = Vec::new();
    files_below(folder, "", &mut names)?;
    names.retain(|name| !recorded.contains(name));
    names.sort();
    Ok(names)
}

/// Adds the files of the subfolder `below` and of all its subfolders to `found`, as paths relative to `folder`, the run
/// folder. `below` is empty for the run folder itself, otherwise a relative path that ends with `/`. Omits the
/// journal's own files, and everything that is not a regular file.
///
/// # Errors
/// A folder cannot be read.
fn files_below(folder: &Path, below: &str, found: &mut Vec<String>) -> Result<(), JournalError> {
    let at = folder.join(below);
    for entry in fs::read_dir(&at).map_err(JournalError::file(&at, "inspecting it"))? {
        let entry = entry.map_err(JournalError::file(&at, "inspecting it"))?;
        let name = format!("{below}{}", entry.file_name().to_string_lossy());
        match entry.file_type().map_err(JournalError::file(&at, "inspecting it"))? {
            kind if kind.is_dir() => files_below(folder, &format!("{name}/"), found)?,
            kind if kind.is_file() && !is_own(&name) => found.push(name),
            _ => {}
        }
    }
    Ok(())
}

/// Returns true if `name` is a file that the journal itself writes into the run folder: the database with its
/// additional files, the anchor, the lock file, or the temporary file of the anchor, which a crash can leave.
fn is_own(name: &str) -> bool {
    name.starts_with(DATABASE) || [ANCHOR, LOCK, &temporary_name(ANCHOR)].contains(&name)
}

impl<'a> VerifierState<'a> {
    fn new(folder: &'a Path, trusted: &'a [PublicKey]) -> Self {
        Self {
            folder,
            trusted,
            records: 0,
            head: "0".repeat(64),
            ended: None,
            run: String::new(),
            key: None,
            no_author: None,
            keys: Vec::new(),
            seals: 0,
            signed: 0,
            names: BTreeSet::new(),
            artefacts: 0,
            last_intent: None,
            open: BTreeSet::new(),
            answered: BTreeSet::new(),
        }
    }

    fn check_record(&mut self, record: &Record) -> Result<(), JournalError> {
        let due = self.records + 1;
        let wrong = |what: &str| Err(broken(self.folder, due, what));
        if let Some(flaw) = record.successor_flaw(self.records, &self.head) {
            return wrong(&flaw);
        }
        if (record.kind == RecordKind::Begin) != (due == 1) {
            return wrong("only the first record can begin a run, and it must");
        }
        // Only one seal can follow the end.
        if self.ended.is_some_and(|end| record.kind != RecordKind::Seal || end < self.records) {
            return wrong("it follows the end of the run");
        }
        if serde_json::from_str::<serde::de::IgnoredAny>(&record.payload).is_err() {
            return wrong("its payload is not JSON");
        }
        match record.kind {
            RecordKind::Begin | RecordKind::Reopen => self.check_key(record)?,
            RecordKind::Intent | RecordKind::Outcome => self.check_command(record)?,
            RecordKind::Artefact => self.check_artefact(record)?,
            RecordKind::Seal => self.check_seal(record)?,
            RecordKind::Event | RecordKind::Note | RecordKind::End => {}
        }
        self.records = due;
        self.head.clone_from(&record.hash);
        if record.kind == RecordKind::End {
            self.ended = Some(due);
        }
        Ok(())
    }

    fn check_key(&mut self, record: &Record) -> Result<(), JournalError> {
        let wrong = |what: String| Err(broken(self.folder, record.seq, what));
        let Some(Reopen { key, .. }) = Reopen::read(record) else {
            return wrong("it is not a JSON object".to_owned());
        };
        if record.kind == RecordKind::Begin {
            self.run = Begin::<Value>::read(record).and_then(|begin| begin.run).unwrap_or_default();
        }
        self.key = match key {
            None => None,
            Some(KeyField::Key(key)) => Some(key),
            Some(KeyField::Invalid(_)) => return wrong("it names an invalid key".to_owned()),
        };
        let no_author = match self.key {
            _ if self.trusted.is_empty() => None,
            Some(key) if self.trusted.contains(&key) => None,
            Some(key) => Some(format!("record {} names the key {key}, which is not one of the given keys", record.seq)),
            None if record.kind == RecordKind::Begin => Some("the run is not signed".to_owned()),
            None => Some(format!("it was resumed at record {} without a key", record.seq)),
        };
        self.no_author = self.no_author.take().or(no_author);
        self.keys.extend(self.key.filter(|key| !self.keys.contains(key)));
        Ok(())
    }

    fn check_seal(&mut self, record: &Record) -> Result<(), JournalError> {
        let wrong = |what: &str| Err(broken(self.folder, record.seq, what));
        let Some(seal) = read_unique::<Seal>(record) else { return wrong("it is not a valid seal") };
        let Some(key) = self.key.filter(|key| key.to_string() == seal.key) else {
            return wrong("its key is not the one that the run names");
        };
        if (seal.records, &seal.head) != (self.records, &self.head) {
            return wrong("it does not seal the record before it");
        }
        if !is_signed(&key, &self.run, seal.records, &seal.head, &seal.signature) {
            return wrong(
                "its signature is wrong: the author of this seal or of the records before it did not have the key",
            );
        }
        self.seals += 1;
        self.signed = self.records;
        Ok(())
    }

    /// Compares `anchor` (number of records and hash of the last one) with the records read so far. Call this function
    /// when the number of records read is that of the anchor.
    ///
    /// # Errors
    /// The anchor belongs to another run, its hash differs from that of the last record read, or its signature is
    /// missing or wrong. The signature is checked only if the run names a key.
    fn check_anchor(&self, anchor: &Anchor) -> Result<(), JournalError> {
        let wrong = |what: &str| Err(broken(self.folder, self.records, what));
        if anchor.run.as_ref().is_some_and(|run| *run != self.run) {
            return wrong("the anchor is of another run");
        }
        if anchor.head != self.head {
            return wrong("its hash differs from that of the anchor: the journal was rewritten");
        }
        let Some(key) = &self.key else { return Ok(()) };
        match (&anchor.key, &anchor.signature) {
            (Some(by), Some(signature)) if *by == key.to_string() => {
                match is_signed(key, &self.run, anchor.records, &anchor.head, signature) {
                    true => Ok(()),
                    false => wrong("the signature of the anchor is wrong"),
                }
            }
            _ => wrong("the anchor is not signed with the key that the run names"),
        }
    }

    fn check_command(&mut self, record: &Record) -> Result<(), JournalError> {
        let wrong = |what: &str| Err(broken(self.folder, record.seq, what));
        match (record.kind, record.command_id) {
            (RecordKind::Intent, None) => return wrong("a command has no number"),
            (RecordKind::Intent, Some(id)) => {
                if self.last_intent.is_some_and(|last| id <= last) {
                    return wrong("its command number was already used");
                }
                self.last_intent = Some(id);
                self.open.insert(id);
            }
            (_, Some(id)) if self.open.remove(&id) || self.answered.contains(&id) => {
                self.answered.insert(id);
            }
            _ => return wrong("it is the outcome of a command that is not on record"),
        }
        Ok(())
    }

    fn check_artefact(&mut self, record: &Record) -> Result<(), JournalError> {
        let wrong = |what: String| Err(broken(self.folder, record.seq, what));
        let Some(known) = read_unique::<Artefact>(record) else {
            return wrong("it names no file".to_owned());
        };
        let Ok(path) = path_within(self.folder, &known.name) else {
            return wrong(format!("{:?} cannot be the name of a file in a run folder", known.name));
        };
        if !path.is_file() {
            return wrong(format!("the file {} is missing", known.name));
        }
        // A file of another length is not read: it could have no end.
        let length = fs::metadata(&path).map(|found| found.len()).unwrap_or_default();
        if length != known.bytes || describe(&path, &known.name)? != known {
            return wrong(format!("the file {} was changed", known.name));
        }
        self.artefacts += 1;
        self.names.insert(known.name);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use rusqlite::types::Value as Field;
    use rusqlite::{Connection, params};
    use serde_json::json;

    use super::super::key::AuditKey;
    use super::super::open::SCHEMA;
    use super::super::record::{COLUMNS, Entry, Records};
    use super::super::write::{Header, Journal};
    use super::*;

    /// Writes a signed run of a hundred records.
    fn run_of_a_hundred(folder: &Path) {
        let header = Header {
            run: "run-1".into(),
            part: "SN 7".into(),
            actor: "Ada".into(),
            station: "console".into(),
            simulation: true,
            first_command_id: 1,
            content: json!({ "recipe": "abc" }),
        };
        let mut journal = Journal::create_with(folder, header, Some(AuditKey::new())).unwrap();
        for k in 0..48 {
            let entry = |kind| Entry { reason: "why \u{b5}".into(), ..Entry::new(kind, k, 1, json!({ "k": k })) };
            let id = journal.intend(entry(RecordKind::Intent)).unwrap();
            match k {
                7 => drop(journal.store("points.csv", b"1,2\n", k, 1).unwrap()),
                _ => drop(journal.append(Entry { command_id: Some(id), ..entry(RecordKind::Outcome) }).unwrap()),
            }
        }
        journal.close(99, 1, json!("accepted")).unwrap();
    }

    /// Returns all values that differ from `value` in a single bit.
    fn flipped(value: &Field) -> Vec<Field> {
        match value {
            Field::Integer(number) => (0..64).map(|bit| Field::Integer(number ^ 1_i64 << bit)).collect(),
            Field::Text(text) => (0..8 * text.len())
                .map(|bit| {
                    let mut bytes = text.clone().into_bytes();
                    bytes[bit / 8] ^= 1 << (bit % 8);
                    Field::Blob(bytes)
                })
                .collect(),
            _ => Vec::new(),
        }
    }

    /// Returns the number of the record at which the verification fails, continued from an earlier state.
    fn breaks_at(connection: &Connection, seen: &VerifierState<'_>, records: u64) -> Option<u64> {
        let mut seen = seen.clone();
        for record in Records::new(connection, seen.folder, seen.records + 1) {
            if let Err(JournalError::Broken { seq, .. }) = record.and_then(|record| seen.check_record(&record)) {
                return Some(seq);
            }
        }
        // The anchor shows that the end is missing.
        (seen.records < records).then_some(seen.records + 1)
    }

    #[test]
    fn every_bit_flip_is_located() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join("run");
        run_of_a_hundred(&folder);
        let records = verify(&folder).unwrap().records;
        assert_eq!(records, 100);
        // Records are changed and restored in memory, by SQL.
        let database = Connection::open_in_memory().unwrap();
        let schema = SCHEMA.split("CREATE INDEX").next().unwrap();
        database.execute_batch(schema).unwrap();
        let file = folder.join(DATABASE);
        database.execute("ATTACH ?1 AS written", [file.to_str().unwrap()]).unwrap();
        database.execute_batch("INSERT INTO main.record SELECT * FROM written.record").unwrap();
        let mut seen = VerifierState::new(&folder, &[]);
        let (mut bits, mut impossible) = (0, 0);
        for seq in 1..=records {
            for column in COLUMNS.split(", ") {
                let ask = format!("SELECT {column} FROM main.record WHERE seq = ?1");
                let value: Field = database.query_row(&ask, [seq as i64], |row| row.get(0)).unwrap();
                let is_text = matches!(value, Field::Text(_));
                let text = if is_text { "CAST(?1 AS TEXT)" } else { "?1" };
                let change = format!("UPDATE main.record SET {column} = {text} WHERE seq = ?2");
                let mut change = database.prepare(&change).unwrap();
                for other in flipped(&value) {
                    // Two records cannot have the same number.
                    let Ok(1) = change.execute(params![other, seq as i64]) else {
                        impossible += 1;
                        continue;
                    };
                    assert_eq!(breaks_at(&database, &seen, records), Some(seq), "{column} of {seq}: {other:?}");
                    let now = match (column, &other) {
                        ("seq", Field::Integer(number)) => *number,
                        _ => seq as i64,
                    };
                    change.execute(params![value, now]).unwrap();
                    bits += 1;
                }
            }
            let record = Records::new(&database, &folder, seq).next().unwrap().unwrap();
            seen.check_record(&record).unwrap();
        }
        assert!(bits > 190_000 && impossible < 1_000, "{bits} bits, {impossible} impossible");
    }

    #[test]
    fn begin_and_reopen_must_be_objects() {
        let forged = |kind, seq, head: &str, payload: &str| {
            let mut record = Record {
                seq,
                utc: "2026-01-01T00:00:00.000000Z".into(),
                boot_id: "0".repeat(16),
                mono_ns: 0,
                actor: "cell".into(),
                station: "regrind".into(),
                kind,
                part: "SN 7".into(),
                cycle: 0,
                command_id: None,
                reason: String::new(),
                payload: payload.into(),
                prev_hash: head.into(),
                hash: String::new(),
            };
            record.hash = record.expected_hash();
            record
        };
        let folder = Path::new("run");
        for payload in ["[]", "null", "7", "\"run\"", "[\"run-1\",true,1,null,\"0.1.0\",null]"] {
            let zeros = "0".repeat(64);
            let begin = forged(RecordKind::Begin, 1, &zeros, payload);
            let error = VerifierState::new(folder, &[]).check_record(&begin).unwrap_err();
            assert!(matches!(error, JournalError::Broken { seq: 1, .. }), "{payload}: {error}");
            let mut seen = VerifierState::new(folder, &[]);
            let begin = forged(RecordKind::Begin, 1, &zeros, "{\"run\":\"run-1\"}");
            seen.check_record(&begin).unwrap();
            let error = seen.check_record(&forged(RecordKind::Reopen, 2, &begin.hash, payload)).unwrap_err();
            assert!(matches!(error, JournalError::Broken { seq: 2, .. }), "{payload}: {error}");
        }
        // The fields of a file and of a seal as lists: an object is due.
        for (kind, payload) in [
            (RecordKind::Artefact, "[\"a\",0,\"e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855\"]"),
            (RecordKind::Seal, "[1,\"h\",\"k\",\"s\"]"),
        ] {
            let mut seen = VerifierState::new(folder, &[]);
            let begin = forged(RecordKind::Begin, 1, &"0".repeat(64), "{\"run\":\"run-1\"}");
            seen.check_record(&begin).unwrap();
            let error = seen.check_record(&forged(kind, 2, &begin.hash, payload)).unwrap_err();
            let JournalError::Broken { what, .. } = error else { panic!("{error}") };
            assert!(["it names no file", "it is not a valid seal"].contains(&&*what), "{what}");
        }
    }
}
