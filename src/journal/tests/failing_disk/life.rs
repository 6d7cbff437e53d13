//! Life of a journal on a simulated disk, and checks of the journal after its end or after a cut.

use std::fs;
use std::path::{Path, PathBuf};

use regrind_disk::Disk;
use regrind_journal::{AuditKey, Entry, Header, Journal, JournalError, Reader, Record, RecordKind, Verified, verify};
use regrind_testutils::keep::KeepRunFolders;
use rusqlite::{Connection, OpenFlags};
use serde_json::{Value, json};
use tempfile::TempDir;

/// Number of log pages that starts a checkpoint. It is small, so that a short life has several checkpoints.
pub const CHECKPOINT_PAGES: u32 = 24;

/// Temporary folder, in memory if possible, because the simulated disk decides which bytes are kept.
/// Its journals are kept for the Python verifier on request.
pub struct Home {
    _kept: KeepRunFolders,
    home: TempDir,
}

impl Home {
    pub fn new() -> Self {
        let home = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap();
        Self { _kept: KeepRunFolders(home.path().to_owned()), home }
    }

    pub fn folder(&self, name: &str) -> PathBuf {
        self.home.path().join(name)
    }

    /// Creates an empty folder. Deletes an earlier folder of this name.
    pub fn empty(&self, name: &str) -> PathBuf {
        let folder = self.folder(name);
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir(&folder).unwrap();
        folder
    }
}

/// Returns the number of random draws at each place; `None` means a sample of the places.
/// .ci/long sets the number.
pub fn draws() -> Option<u64> {
    std::env::var("REGRIND_DISK_DRAWS").ok().and_then(|number| number.parse().ok())
}

pub fn header() -> Header {
    Header {
        run: "run-1".into(),
        part: "SN 7".into(),
        actor: "Ada".into(),
        station: "console".into(),
        simulation: true,
        first_command_id: 1,
        content: json!({ "recipe": "abc" }),
    }
}

/// Step in the life of a journal.
#[derive(Clone, Copy)]
pub enum Step {
    /// Note with this number of letters.
    Note(usize),
    Intend,
    Outcome,
    Store(usize),
    Reopen,
    End,
}

/// Returns the steps of a short life: about thirty records. Some records need pages of their own.
pub fn short() -> Vec<Step> {
    use Step::{End, Intend, Note, Outcome, Reopen, Store};
    let first = [Store(10), Note(0), Intend, Note(300), Outcome, Note(6000), Intend, Store(9000), Outcome, Note(20)];
    let second = [Note(700), Intend, Note(3000), Reopen, Note(40), Outcome, Intend, Note(100), Note(13_000), Outcome];
    let third = [Note(500), Intend, Outcome, Outcome, Store(100), Note(0), Reopen, Reopen, Intend, Note(900)];
    [&first[..], &second, &third, &[Note(60), Note(4000), Outcome, End]].concat()
}

/// Returns the steps of a long life. It is so long that the journal writes a seal in the middle.
pub fn long() -> Vec<Step> {
    use Step::{End, Intend, Note, Outcome};
    [&[Note(0); 252][..], &[Intend, Note(10), Outcome, Note(10), Intend, Outcome, End]].concat()
}

/// Record that the journal has acknowledged.
#[derive(Clone, Debug, PartialEq)]
pub struct AcknowledgedRecord {
    pub kind: RecordKind,
    pub mono_ns: u64,
    pub command_id: Option<u32>,
    /// Content of the record, or the member that identifies the record.
    pub payload: Value,
}

impl AcknowledgedRecord {
    pub fn from_record(record: &Record) -> Self {
        let value = record.value();
        let payload = match record.kind {
            RecordKind::Artefact => value["name"].clone(),
            RecordKind::End => value["ending"].clone(),
            _ => value,
        };
        Self { kind: record.kind, mono_ns: record.mono_ns, command_id: record.command_id, payload }
    }
}

/// Life of a journal on a disk, and its results.
pub struct Life<'d> {
    disk: &'d Disk,
    folder: PathBuf,
    key: Option<AuditKey>,
    /// Description of the trial for the message of a failure.
    at: String,
    /// Acknowledged records, in order.
    pub acknowledged: Vec<AcknowledgedRecord>,
    /// Errors that the journal returned.
    pub errors: Vec<JournalError>,
    /// Number of the last command.
    id: Option<u32>,
}

/// Number of errors after which the disk has no fault any more.
const PATIENCE: usize = 5;

impl<'d> Life<'d> {
    /// Leads a life from its beginning to its end. Retries each refused step, as the drive does.
    /// Returns false if the journal cannot be created.
    pub fn led(disk: &'d Disk, folder: &Path, key: Option<AuditKey>, steps: &[Step], at: &str) -> (Self, bool) {
        let mut life = Self {
            disk,
            folder: folder.to_owned(),
            key: key.clone(),
            at: at.to_owned(),
            acknowledged: Vec::new(),
            errors: Vec::new(),
            id: None,
        };
        // Who cannot begin a run begins another, in a folder of its own.
        let mut journal = match Journal::create_with(folder, header(), key) {
            Ok(journal) => journal,
            Err(error) => {
                life.errors.push(error);
                return (life, false);
            }
        };
        disk.mark(1);
        for (number, step) in (1..).zip(steps) {
            journal = life.perform(journal, number, *step);
        }
        (life, true)
    }

    fn perform(&mut self, mut journal: Journal, number: u64, step: Step) -> Journal {
        let entry = |kind, payload: Value| Entry::new(kind, number, 1, payload);
        let (told, id) = match step {
            Step::Reopen => {
                let mode = mode(&self.folder);
                assert!(mode.as_ref().is_none_or(|mode| mode == "wal"), "{}: no log is written: {mode:?}", self.at);
                drop(journal);
                return self.reopened();
            }
            Step::Note(letters) => {
                let payload = json!({ "words": words(number, letters) });
                self.until_written(|| journal.append(entry(RecordKind::Note, payload.clone())));
                (AcknowledgedRecord { kind: RecordKind::Note, mono_ns: number, command_id: None, payload }, self.id)
            }
            Step::Intend => {
                let payload = json!({ "command": "register" });
                let id = self.until_written(|| journal.intend(entry(RecordKind::Intent, payload.clone())));
                assert!(Some(id) > self.id, "{}: command {id} after {:?}", self.at, self.id);
                (
                    AcknowledgedRecord { kind: RecordKind::Intent, mono_ns: number, command_id: Some(id), payload },
                    Some(id),
                )
            }
            Step::Outcome => {
                let (payload, command_id) = (json!({ "event": "registered" }), self.id);
                let entry = Entry { command_id, ..entry(RecordKind::Outcome, payload.clone()) };
                self.until_written(|| journal.append(entry.clone()));
                (AcknowledgedRecord { kind: RecordKind::Outcome, mono_ns: number, command_id, payload }, self.id)
            }
            Step::Store(letters) => {
                let (name, bytes) = (format!("cycle-1/{number}.csv"), words(number, letters));
                self.until_written(|| journal.store(&name, bytes.as_bytes(), number, 1));
                (
                    AcknowledgedRecord {
                        kind: RecordKind::Artefact,
                        mono_ns: number,
                        command_id: None,
                        payload: json!(name),
                    },
                    self.id,
                )
            }
            Step::End => {
                self.until_written(|| journal.end(number, 1, json!("accepted")));
                (
                    AcknowledgedRecord {
                        kind: RecordKind::End,
                        mono_ns: number,
                        command_id: None,
                        payload: json!("accepted"),
                    },
                    self.id,
                )
            }
        };
        self.acknowledged.push(told);
        self.id = id;
        self.disk.mark(1 + self.acknowledged.len() as u64);
        journal
    }

    /// Retries a write until it succeeds, as the drive's journal thread does.
    /// Asserts that each error can be temporary.
    fn until_written<T>(&mut self, mut write: impl FnMut() -> Result<T, JournalError>) -> T {
        loop {
            match write() {
                Ok(written) => return written,
                Err(error) => {
                    assert!(error.may_pass(), "{}: the drive would give up for ever: {error:?}", self.at);
                    self.refused(error);
                }
            }
        }
    }

    /// Retries to open the journal until it succeeds, as a person does who resumes a run.
    fn reopened(&mut self) -> Journal {
        loop {
            match Journal::open_with(&self.folder, self.key.clone()) {
                Ok(journal) => return journal,
                Err(error) => {
                    let accuses = matches!(
                        error,
                        JournalError::Broken { .. } | JournalError::Foreign { .. } | JournalError::Closed { .. }
                    );
                    assert!(!accuses, "{}: a disk that fails is told as a record that is wrong: {error:?}", self.at);
                    self.refused(error);
                }
            }
        }
    }

    fn refused(&mut self, error: JournalError) {
        let text = error.to_string();
        assert!(text.contains(&*self.folder.to_string_lossy()), "{}: no place in {text}", self.at);
        self.errors.push(error);
        if self.errors.len() >= PATIENCE {
            self.disk.heal();
        }
        assert!(self.errors.len() < 4 * PATIENCE, "{}: refused for ever: {:?}", self.at, self.errors);
    }

    /// Asserts that the journal is closed and has every acknowledged record exactly once.
    pub fn is_whole(&self) {
        let verified = verified(&self.folder, &self.at);
        assert!(verified.closed && !verified.lacks_last_seal(), "{}: {verified:?}", self.at);
        assert_eq!(read_acknowledged(&self.folder), self.acknowledged, "{}", self.at);
    }
}

/// Returns the journal mode in the file of a database, if the disk permits the read.
pub fn mode(folder: &Path) -> Option<String> {
    let database = Connection::open_with_flags(folder.join("journal.sqlite"), OpenFlags::SQLITE_OPEN_READ_ONLY).ok()?;
    database.query_row("SELECT count(*) FROM record", [], |_| Ok(())).ok()?;
    database.query_row("PRAGMA journal_mode", [], |row| row.get(0)).ok()
}

pub fn words(number: u64, letters: usize) -> String {
    let letter = char::from(b'a' + (number % 26) as u8);
    letter.to_string().repeat(letters)
}

pub fn verified(folder: &Path, at: &str) -> Verified {
    verify(folder).unwrap_or_else(|error| panic!("{at}: {error}"))
}

pub fn records(folder: &Path) -> Vec<Record> {
    Reader::open(folder).unwrap().records(0).map(Result::unwrap).collect()
}

/// Returns the records of a journal without the records that the journal writes by itself.
pub fn read_acknowledged(folder: &Path) -> Vec<AcknowledgedRecord> {
    let own = [RecordKind::Begin, RecordKind::Reopen, RecordKind::Seal];
    records(folder).iter().filter(|record| !own.contains(&record.kind)).map(AcknowledgedRecord::from_record).collect()
}

/// Asserts that the run can be resumed and closed, and that no command number is used twice.
pub fn is_gone_on_with(folder: &Path, key: Option<&AuditKey>, at: &str) {
    let before = records(folder);
    let mut journal = Journal::open_with(folder, key.cloned()).unwrap_or_else(|error| panic!("{at}: {error}"));
    let open: Vec<_> = journal.open_intents().unwrap().iter().map(|record| record.command_id).collect();
    let answered = |id| before.iter().any(|record| record.kind == RecordKind::Outcome && record.command_id == id);
    let intents: Vec<_> =
        before.iter().filter(|r| r.kind == RecordKind::Intent).map(|record| record.command_id).collect();
    let unanswered: Vec<_> = intents.iter().copied().filter(|id| !answered(*id)).collect();
    assert_eq!(open, unanswered, "{at}");
    let id = journal.intend(Entry::new(RecordKind::Intent, 1000, 2, json!({ "command": "measure" }))).unwrap();
    assert!(intents.iter().all(|used| *used < Some(id)), "{at}: {id} after {intents:?}");
    journal.store("gone-on.csv", b"1,2\n", 1001, 2).unwrap();
    journal.append(Entry::new(RecordKind::Note, 1002, 2, json!({ "words": words(1002, 5000) }))).unwrap();
    journal.close(1003, 2, json!("accepted")).unwrap();
    let verified = verified(folder, at);
    assert!(verified.closed && !verified.lacks_last_seal(), "{at}: {verified:?}");
    let after = records(folder);
    assert_eq!(after[..before.len()], before, "{at}: what stood before is there as it was");
}
