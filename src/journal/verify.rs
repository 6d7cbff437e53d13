//! Is the journal what was written?

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::artefact::{Artefact, describe, path_within};
use super::error::JournalError;
use super::record::{Kind, Record};
use super::{ANCHOR, DATABASE, LOCK, Reader};

/// How long the journal was at some time, and the hash of its last record then. Kept elsewhere it proves that nothing was cut.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Anchor {
    /// The number of records.
    pub records: u64,
    /// The hash of the last.
    pub head: String,
}

/// What a journal that can be believed holds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Verified {
    /// The number of records.
    pub records: u64,
    /// The hash of the last.
    pub head: String,
    /// Up to which record an anchor proves that nothing was cut; 0 if there is no anchor.
    pub anchored: u64,
    /// Whether the run came to its end; the end of one that did not proves nothing behind its anchor.
    pub closed: bool,
    /// The files on record, all there and unchanged.
    pub artefacts: u64,
    /// The numbers of the commands without an outcome.
    pub open_intents: Vec<u32>,
    /// Whether a process drives the run now, so that its end is still to come.
    pub under_way: bool,
    /// Files of the folder that stand in no record, in order; the journal's own left out.
    pub unrecorded: Vec<String>,
}

/// Verifies the journal of a run folder, the files on record, and the anchor beside it.
///
/// # Errors
/// [`JournalError::Broken`] with the first record that cannot be believed; a journal that cannot be read.
pub fn verify(folder: impl AsRef<Path>) -> Result<Verified, JournalError> {
    let folder = folder.as_ref();
    let anchor = read_anchor(folder)?;
    examine(folder, anchor.as_ref())
}

/// Verifies a journal against an anchor that was kept elsewhere, besides the one beside it.
///
/// # Errors
/// As [`verify`].
pub fn verify_against(folder: impl AsRef<Path>, anchor: &Anchor) -> Result<Verified, JournalError> {
    let folder = folder.as_ref();
    let beside = verify(folder)?;
    let kept = examine(folder, Some(anchor))?;
    Ok(if beside.anchored > kept.anchored { beside } else { kept })
}

/// Reads the anchor beside a journal.
pub(super) fn read_anchor(folder: &Path) -> Result<Option<Anchor>, JournalError> {
    let path = folder.join(ANCHOR);
    match fs::read(&path) {
        Ok(bytes) => {
            serde_json::from_slice(&bytes).map(Some).map_err(|_| broken(folder, 0, "journal.anchor is no anchor"))
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(JournalError::file(&path, "reading it")(error)),
    }
}

fn broken(folder: &Path, seq: u64, what: impl Into<String>) -> JournalError {
    JournalError::Broken { path: folder.to_owned(), seq, what: what.into() }
}

/// What has been seen of a journal so far.
struct Seen<'a> {
    folder: &'a Path,
    records: u64,
    head: String,
    closed: bool,
    artefacts: u64,
    names: BTreeSet<String>,
    last_intent: Option<u32>,
    open: BTreeSet<u32>,
    answered: BTreeSet<u32>,
}

fn examine(folder: &Path, anchor: Option<&Anchor>) -> Result<Verified, JournalError> {
    let reader = Reader::open(folder)?;
    let head = "0".repeat(64);
    let (names, open, answered) = (BTreeSet::new(), BTreeSet::new(), BTreeSet::new());
    let mut seen =
        Seen { folder, records: 0, head, closed: false, artefacts: 0, names, last_intent: None, open, answered };
    let mut anchored = 0;
    for record in reader.records(0) {
        seen.take(&record?)?;
        if let Some(anchor) = anchor.filter(|anchor| anchor.records == seen.records) {
            if anchor.head != seen.head {
                return Err(broken(
                    folder,
                    seen.records,
                    "its hash is not the one of the anchor: the journal was rewritten",
                ));
            }
            anchored = seen.records;
        }
    }
    if seen.records == 0 {
        return Err(broken(folder, 1, "there is no record"));
    }
    if let Some(anchor) = anchor.filter(|anchor| anchor.records > seen.records) {
        let what =
            format!("{} records were written, and {} are there: the end was cut off", anchor.records, seen.records);
        return Err(broken(folder, seen.records + 1, what));
    }
    let Seen { records, head, closed, artefacts, names, open, .. } = seen;
    let mut unrecorded = Vec::new();
    files_below(folder, "", &mut unrecorded)?;
    unrecorded.retain(|name| !names.contains(name));
    unrecorded.sort();
    let open_intents = open.into_iter().collect();
    let under_way = is_driven(folder);
    Ok(Verified { records, head, anchored, closed, artefacts, open_intents, under_way, unrecorded })
}

/// Whether somebody holds the lock of a run folder.
fn is_driven(folder: &Path) -> bool {
    let lock = fs::File::open(folder.join(LOCK));
    lock.is_ok_and(|lock| matches!(lock.try_lock_shared(), Err(fs::TryLockError::WouldBlock)))
}

/// Finds the files in a run folder, by their paths from it; those of the journal itself are left out, and what is no file.
fn files_below(folder: &Path, below: &str, found: &mut Vec<String>) -> Result<(), JournalError> {
    let at = folder.join(below);
    for entry in fs::read_dir(&at).map_err(JournalError::file(&at, "looking into it"))? {
        let entry = entry.map_err(JournalError::file(&at, "looking into it"))?;
        let name = format!("{below}{}", entry.file_name().to_string_lossy());
        match entry.file_type().map_err(JournalError::file(&at, "looking into it"))? {
            kind if kind.is_dir() => files_below(folder, &format!("{name}/"), found)?,
            kind if kind.is_file() && !name.starts_with(DATABASE) && name != ANCHOR && name != LOCK => found.push(name),
            _ => {}
        }
    }
    Ok(())
}

impl Seen<'_> {
    fn take(&mut self, record: &Record) -> Result<(), JournalError> {
        let due = self.records + 1;
        let wrong = |what: &str| Err(broken(self.folder, due, what));
        if record.seq != due {
            return wrong(&format!("it is missing: record {} follows {}", record.seq, self.records));
        }
        if record.prev_hash != self.head {
            return wrong(
                "it does not follow the record before it: one of them was changed, moved, inserted or taken away",
            );
        }
        if record.hash != record.hash_due() {
            return wrong("its content is not what was written");
        }
        if (record.kind == Kind::Begin) != (due == 1) {
            return wrong("a run begins with its first record, and only there");
        }
        if self.closed {
            return wrong("it stands behind the end of the run");
        }
        if serde_json::from_str::<serde::de::IgnoredAny>(&record.payload).is_err() {
            return wrong("its payload is no JSON");
        }
        self.take_command(record)?;
        self.take_artefact(record)?;
        self.records = due;
        self.head.clone_from(&record.hash);
        self.closed = record.kind == Kind::End;
        Ok(())
    }

    fn take_command(&mut self, record: &Record) -> Result<(), JournalError> {
        let wrong = |what: &str| Err(broken(self.folder, record.seq, what));
        match (record.kind, record.command_id) {
            (Kind::Intent, None) => return wrong("a command has no number"),
            (Kind::Intent, Some(id)) => {
                if self.last_intent.is_some_and(|last| id <= last) {
                    return wrong("its command number was used before");
                }
                self.last_intent = Some(id);
                self.open.insert(id);
            }
            (Kind::Outcome, Some(id)) if self.open.contains(&id) || self.answered.contains(&id) => {
                self.open.remove(&id);
                self.answered.insert(id);
            }
            (Kind::Outcome, _) => return wrong("it is the outcome of a command that is not on record"),
            _ => {}
        }
        Ok(())
    }

    fn take_artefact(&mut self, record: &Record) -> Result<(), JournalError> {
        if record.kind != Kind::Artefact {
            return Ok(());
        }
        let wrong = |what: String| Err(broken(self.folder, record.seq, what));
        let Ok(known) = serde_json::from_str::<Artefact>(&record.payload) else {
            return wrong("it names no file".to_owned());
        };
        let path = path_within(self.folder, &known.name)?;
        if !path.is_file() {
            return wrong(format!("the file {} is missing", known.name));
        }
        if describe(&path, &known.name)? != known {
            return wrong(format!("the file {} is not what was written", known.name));
        }
        self.artefacts += 1;
        self.names.insert(known.name);
        Ok(())
    }
}
