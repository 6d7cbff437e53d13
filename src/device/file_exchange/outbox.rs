//! Folder of the hand-overs, which also stores all earlier hand-overs.
//!
//! A hand-over is a folder of its own. It is written under a hidden name, synced to the disk and then renamed, so that
//! it is always visible as a whole. Its name contains the part, the job and the cycle. The ending of the name shows its
//! status:
//!
//! ```text
//! SN-7_j3_c2           open
//! SN-7_j3_c2.held      withdrawn temporarily, by HOLD
//! SN-7_j3_c2.stopped   withdrawn permanently, by STOP
//! SN-7_j3_c2.aborted   withdrawn permanently, by ABORT
//! SN-7_j3_c2.done      its answer was acknowledged
//! ```

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use data_encoding::{HEXLOWER, HEXLOWER_PERMISSIVE};
use serde::{Deserialize, Serialize};

use super::watch::{FileStamp, Watch};
use super::{ExchangeError, HandOver, HandOverStatus, Permit, file_word};
use crate::Job;
use regrind_formats::{FormatError, read_whole, sync_folder, try_writing, write_atomic, write_json_atomic};

/// File in every folder of a hand-over.
const HEADER_FILE: &str = "handover.json";
/// File in the folder of a hand-over. It lists the files that were accepted as the answer.
const ACCEPTED_FILE: &str = "taken.json";
/// Maximum size of these files, in bytes.
const MAX_BYTES: u64 = 16 << 20;

const ENDINGS: [(HandOverStatus, &str); 5] = [
    (HandOverStatus::Open, ""),
    (HandOverStatus::Held, ".held"),
    (HandOverStatus::Stopped, ".stopped"),
    (HandOverStatus::Aborted, ".aborted"),
    (HandOverStatus::Closed, ".done"),
];

/// Content of the header file of a hand-over.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct HandOverHeader {
    /// Version of the layout of this file: 1.
    pub format: u16,
    pub part: String,
    pub job: u32,
    pub cycle: u16,
    pub digest: u32,
    pub start_number: u32,
    /// Identity of the plan or of the map, 64 hexadecimal digits.
    pub identity: String,
    /// Radius of the probe, or of the wheel.
    pub tool_radius_mm: f64,
    /// Files that were in the inbox before the hand-over: name, length in bytes, time of change in ns since 1970.
    pub earlier: Vec<(String, u64, u128)>,
}

impl HandOverHeader {
    /// Creates the header of a hand-over. `identity` is the SHA-256 of the plan or map that is handed over.
    /// `tool_radius_mm` is the radius of the probe or of the wheel. The header lists the files that are in `inbox` now,
    /// so that these earlier files can be told apart from later answers. Returns an error if `inbox` cannot be read.
    pub(super) fn new(
        part: &str,
        job: Job,
        start_number: u32,
        identity: &[u8; 32],
        tool_radius_mm: f64,
        inbox: &Path,
    ) -> Result<Self, ExchangeError> {
        let earlier = Watch::new(inbox, Duration::ZERO).scan(Duration::ZERO)?.into_iter();
        Ok(Self {
            format: 1,
            part: part.to_owned(),
            job: job.job,
            cycle: job.cycle,
            digest: job.digest,
            start_number,
            identity: HEXLOWER.encode(identity),
            tool_radius_mm,
            earlier: earlier.map(|file| (file.name, file.stamp.bytes, nanoseconds(file.stamp.modified))).collect(),
        })
    }

    pub(super) fn job(&self) -> Job {
        Job { job: self.job, cycle: self.cycle, digest: self.digest }
    }

    /// Returns true if the file `name` was already in the inbox when the hand-over was created and has not changed
    /// since. `look` contains the present size of the file and the time of its last change. The file counts as
    /// unchanged if both are still the same.
    pub(super) fn is_earlier(&self, name: &str, look: &FileStamp) -> bool {
        self.earlier.iter().any(|(n, bytes, at)| n == name && *bytes == look.bytes && *at == nanoseconds(look.modified))
    }
}

/// Returns the time from the start of 1970 (UTC) to `at`, in ns. Returns 0 if `at` is earlier.
fn nanoseconds(at: SystemTime) -> u128 {
    at.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |d| d.as_nanos())
}

/// Files that were accepted as the answer to a hand-over.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct AcceptedFiles {
    pub job: u32,
    pub cycle: u16,
    /// The files and the SHA-256 of their bytes.
    pub files: Vec<(String, String)>,
}

/// Hand-over as it was read from the folder.
#[derive(Clone, Debug)]
pub(super) struct StoredHandover {
    pub path: PathBuf,
    pub header: HandOverHeader,
    pub status: HandOverStatus,
    pub accepted: Option<AcceptedFiles>,
}

/// Folder of the hand-overs.
#[derive(Clone, Debug)]
pub(super) struct Outbox {
    pub folder: PathBuf,
}

impl Outbox {
    /// Checks that this outbox (the folder of the hand-overs) can be written and that `inbox` (the folder of the
    /// answers) can be read. Returns every hand-over in the outbox, with the oldest first. Returns an error if a folder
    /// is not accessible, or if a hand-over cannot be read.
    pub(super) fn open(&self, inbox: &mut Watch) -> Result<Vec<HandOver>, ExchangeError> {
        try_writing(&self.folder)?;
        inbox.scan(Duration::ZERO)?;
        let handed = self.list()?.into_iter();
        let hand_over = |StoredHandover { header: ticket, status: standing, .. }| HandOver {
            job: ticket.job(),
            sequence: ticket.start_number,
            status: standing,
        };
        Ok(handed.map(hand_over).collect())
    }

    /// Reads every hand-over in the outbox and returns them in ascending order of their start numbers. Ignores hidden
    /// folders and everything that has no header file. Returns an error if a file of a hand-over cannot be read, or if
    /// somebody has changed the name of its folder.
    pub(super) fn list(&self) -> Result<Vec<StoredHandover>, ExchangeError> {
        let unreadable = |source| FormatError::Unreadable { path: self.folder.clone(), source };
        let mut found = Vec::new();
        for entry in fs::read_dir(&self.folder).map_err(unreadable)? {
            let path = entry.map_err(unreadable)?.path();
            let Some(name) = path.file_name().and_then(|n| n.to_str()) else { continue };
            if name.starts_with('.') || !path.join(HEADER_FILE).is_file() {
                continue;
            }
            let ticket: HandOverHeader = read_json(&path.join(HEADER_FILE))?;
            let taken =
                if path.join(ACCEPTED_FILE).is_file() { Some(read_json(&path.join(ACCEPTED_FILE))?) } else { None };
            let ending = name.strip_prefix(base_name(&ticket.part, ticket.job()).as_str());
            let Some(standing) = ENDINGS.iter().find(|(_, e)| Some(*e) == ending).map(|(s, _)| *s) else {
                let expected = "a folder with its original name, or with the ending .held, .stopped, .aborted or .done";
                let found = name.to_owned();
                return Err(FormatError::Unexpected {
                    path,
                    place: "name".to_owned(),
                    expected: expected.to_owned(),
                    found,
                }
                .into());
            };
            found.push(StoredHandover { path, header: ticket, status: standing, accepted: taken });
        }
        found.sort_by_key(|stored| stored.header.start_number);
        Ok(found)
    }

    /// Returns the hand-over in the outbox that has the run number and the cycle of `job`. Returns `None` if there is
    /// no such hand-over. Returns an error if the outbox cannot be read.
    fn find(&self, job: Job) -> Result<Option<StoredHandover>, ExchangeError> {
        Ok(self.list()?.into_iter().find(|l| (l.header.job, l.header.cycle) == (job.job, job.cycle)))
    }

    /// Returns the hand-over in the outbox that has the run number and the cycle of `job`.
    ///
    /// # Errors
    /// Returns an error if there is no such hand-over, or if the outbox cannot be read.
    pub(super) fn handed_over(&self, job: Job) -> Result<StoredHandover, ExchangeError> {
        self.find(job)?.ok_or_else(|| ExchangeError::Missing { folder: self.folder.clone() })
    }

    /// Publishes a hand-over in the outbox. The hand-over is a folder that contains the header `ticket` and the
    /// `files`. Each file is a pair of its name and its bytes.
    ///
    /// # Errors
    /// Returns an error if this job and cycle were published before, if `permit` was withdrawn, or if the outbox cannot
    /// be written. Nothing is published then, with one exception: the hand-over may have appeared if only the flush to
    /// the disk failed after the rename.
    pub(super) fn publish(
        &self,
        ticket: &HandOverHeader,
        files: &[(&str, Vec<u8>)],
        permit: &Permit,
    ) -> Result<(), ExchangeError> {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        if let Some(before) = self.find(ticket.job())? {
            return Err(ExchangeError::HandedOver { job: ticket.job, cycle: ticket.cycle, folder: before.path });
        }
        let target = self.folder.join(base_name(&ticket.part, ticket.job()));
        let hidden = format!(".draft-{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let draft = DraftFolder::create(self.folder.join(hidden))?;
        for (name, bytes) in files {
            write_atomic(&draft.0.join(name), bytes)?;
        }
        write_json_atomic(draft.0.join(HEADER_FILE), ticket)?;
        if !permit.use_up() {
            return Err(ExchangeError::Withdrawn { job: ticket.job, cycle: ticket.cycle });
        }
        rename(&draft.0, &target)?;
        Ok(())
    }

    /// Renames the folder of the hand-over of `job`, so that the ending of its name shows the status `standing`. Does
    /// nothing if the name is already right. Returns an error if the hand-over does not exist or cannot be renamed.
    pub(super) fn mark(&self, job: Job, standing: HandOverStatus) -> Result<(), ExchangeError> {
        let stored = self.handed_over(job)?;
        let ending = ENDINGS.iter().find(|(s, _)| *s == standing).map_or("", |(_, e)| *e);
        let target = self.folder.join(base_name(&stored.header.part, stored.header.job()) + ending);
        if target != stored.path { Ok(rename(&stored.path, &target)?) } else { Ok(()) }
    }

    /// Writes the list `taken` of the accepted files to the folder of the hand-over `stored`. Does nothing if `stored`
    /// already has the same list.
    pub(super) fn record_accepted(&self, stored: &StoredHandover, taken: &AcceptedFiles) -> Result<(), ExchangeError> {
        if stored.accepted.as_ref() == Some(taken) {
            return Ok(());
        }
        Ok(write_json_atomic(stored.path.join(ACCEPTED_FILE), taken)?)
    }
}

/// Returns a path that programs with another working folder can use too.
pub(super) fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

fn base_name(part: &str, job: Job) -> String {
    format!("{}_j{}_c{}", file_word(part), job.job, job.cycle)
}

/// Draft of a folder, which is deleted unless it is renamed.
struct DraftFolder(PathBuf);

impl DraftFolder {
    fn create(path: PathBuf) -> Result<Self, FormatError> {
        let failed = |source| FormatError::Unwritable { path: path.clone(), action: "creating the folder", source };
        fs::create_dir(&path).map_err(failed)?;
        Ok(Self(path))
    }
}

impl Drop for DraftFolder {
    fn drop(&mut self) {
        // After the rename there is nothing to delete. Otherwise the error that led here is the one to report.
        let _ = fs::remove_dir_all(&self.0);
    }
}

pub(super) fn rename(from: &Path, to: &Path) -> Result<(), FormatError> {
    let failed = |action| move |source| FormatError::Unwritable { path: to.to_owned(), action, source };
    if to.exists() {
        return Err(failed("renaming it")(io::Error::from(io::ErrorKind::AlreadyExists)));
    }
    fs::rename(from, to).map_err(failed("renaming it"))?;
    sync_folder(to).map_err(failed("flushing it to the disk"))
}

/// Reads the JSON file at `path`, at most 16 MiB, and converts it to the type `T`. Returns an error if the file cannot
/// be read or does not have this content.
pub(super) fn read_json<T: for<'de> Deserialize<'de>>(path: &Path) -> Result<T, FormatError> {
    let bytes = read_whole(path, MAX_BYTES)?;
    serde_json::from_slice(&bytes).map_err(|error| FormatError::Unexpected {
        path: path.to_owned(),
        place: format!("line {}", error.line()),
        expected: "JSON as it was handed over".to_owned(),
        found: error.to_string(),
    })
}

/// Returns the text of a JSON value as the bytes of a file: indented, with a line end after the last line.
pub(super) fn json_lines(value: &serde_json::Value) -> Vec<u8> {
    format!("{value:#}\n").into_bytes()
}

/// Decodes an identity from 64 hexadecimal digits. Other text gives zeros, which match no identity.
pub(super) fn unhex(digits: &str) -> [u8; 32] {
    let decoded = HEXLOWER_PERMISSIVE.decode(digits.as_bytes()).ok();
    decoded.and_then(|bytes| bytes.try_into().ok()).unwrap_or_default()
}
