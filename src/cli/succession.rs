//! Runs of a folder in the order in which they began. Each run has a number and the hash of the record of the previous
//! run. A removed or renamed run is therefore detected.

use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use regrind::formats::ResultFolder;
use regrind::journal::{Anchor, ExternalEvidence, JournalError, PublicKey, Reader, anchor_of, verify_against};
use regrind::record::{PreviousRun, begin_of};
use serde_json::{Value, json};

use super::Outcome;
use super::completeness::is_whole;
use super::control::folders;
use super::failure::Failure;

/// Number of newest runs, by each criterion, whose numbers are read when the next run begins.
const NEWEST: usize = 200;
/// Timeout for other runs that begin in the same folder, and time between two tries.
const TURN_COMES_WITHIN: Duration = Duration::from_secs(5);
const ASKED_EVERY: Duration = Duration::from_millis(20);

/// Position of a run in the sequence of the runs of a folder.
#[derive(Debug, Default, PartialEq)]
pub(super) struct RunPlace {
    /// Number of the run, from 1.
    pub(super) number: u64,
    /// State of the previous run when this run began; `None` if there was no previous run, or if its anchor could not
    /// be read.
    pub(super) before: Option<PreviousRun>,
}

/// Lock that keeps other runs from beginning in a folder until it is dropped, so that two simultaneous runs receive
/// different numbers. `None` if the system cannot lock folders.
pub(super) struct SuccessionLock(Option<File>);

impl Drop for SuccessionLock {
    fn drop(&mut self) {
        // Unlocks explicitly. After a plain close, a child that another thread has just forked would share the lock
        // until its exec.
        self.0.iter().for_each(|folder| drop(folder.unlock()));
    }
}

impl RunPlace {
    /// Returns the place of the next run in the folder `runs`: its number (from 1), and the state of the previous run
    /// (name, number of records and last hash), if there is one. Creates `runs` if the folder is missing. Also returns
    /// a lock of the folder, which keeps other runs from receiving the same number. The caller must keep this lock
    /// until the new run has written its first record. Returns an error if the folder cannot be created.
    pub(super) fn next(runs: &Path) -> Result<(Self, SuccessionLock), Failure> {
        ResultFolder::prepare(runs).map(ResultFolder::keep).map_err(Failure::File)?;
        // Any user can hold this lock. It does not prevent a run, but without it the run can receive the number of
        // another run.
        let folder = File::open(runs).ok().filter(is_ours_in_time);
        let last = newest_with_numbers(runs).into_iter().max_by_key(|(number, _)| *number);
        let before = last.as_ref().and_then(|(_, folder)| {
            let Anchor { records, head, .. } = anchor_of(folder).ok()??;
            Some(PreviousRun { run: name_of(folder), records, head })
        });
        let number = last.map_or(0, |(number, _)| number).saturating_add(1);
        Ok((Self { number, before }, SuccessionLock(folder)))
    }

    /// Reads the place of the run in `folder` from its first record: the number of the run, and the state of its
    /// previous run. Returns `None` if the record cannot be read or has no number, as in runs of early versions of the
    /// program.
    fn read(folder: &Path) -> Option<Self> {
        let begin = begin_of(folder).ok()?;
        let (number, before) = begin.content.place()?;
        Some(Self { number, before: before.cloned() })
    }
}

/// Returns the hash of record number `seq` of a run; `None` if there is no such record.
fn hash_of(folder: &Path, seq: u64) -> Option<String> {
    let record = Reader::open(folder).ok()?.records(seq).next()?.ok()?;
    (record.seq == seq).then_some(record.hash)
}

fn name_of(folder: &Path) -> String {
    folder.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Locks a folder. Waits at most [`TURN_COMES_WITHIN`] for another process. Returns false if the folder could not be
/// locked.
fn is_ours_in_time(folder: &File) -> bool {
    let began = Instant::now();
    loop {
        match folder.try_lock() {
            Ok(()) => return true,
            Err(TryLockError::WouldBlock) if began.elapsed() < TURN_COMES_WITHIN => thread::sleep(ASKED_EVERY),
            Err(_) => return false,
        }
    }
}

/// Returns the newest runs in the folder `runs`, each with its number. Omits runs without a number. The result is not
/// sorted by time.
///
/// Takes the [`NEWEST`] runs with the latest modification time of their folder, and the [`NEWEST`] runs with the latest
/// time in their folder name. Both criteria are needed: copying a folder changes its modification time, and a folder
/// name need not contain a time.
fn newest_with_numbers(runs: &Path) -> Vec<(u64, PathBuf)> {
    let changed = |folder: &PathBuf| fs::metadata(folder).and_then(|found| found.modified()).ok();
    let mut all: Vec<PathBuf> = folders(runs).collect();
    all.sort_by_cached_key(|folder| Reverse(changed(folder)));
    let mut newest: BTreeSet<PathBuf> = all.iter().take(NEWEST).cloned().collect();
    all.sort_by_cached_key(|folder| Reverse(time_in(&name_of(folder)).map(str::to_owned)));
    newest.extend(all.into_iter().take(NEWEST));
    newest.into_iter().filter_map(|folder| Some((RunPlace::read(&folder)?.number, folder))).collect()
}

/// Returns the time in the folder name of a run, in the form 20260704T120000Z; `None` if the name contains no time.
fn time_in(name: &str) -> Option<&str> {
    let is_time = |text: &str| {
        let of = |at: usize, byte: u8| {
            if at == 8 {
                byte == b'T'
            } else if at == 15 {
                byte == b'Z'
            } else {
                byte.is_ascii_digit()
            }
        };
        text.bytes().enumerate().all(|(at, byte)| of(at, byte))
    };
    (0..name.len()).rev().filter_map(|at| name.get(at..at + 16)).find(|text| is_time(text))
}

/// Verification of the runs of a folder: flaws, and the state of each run.
#[derive(Debug, Default)]
struct Proof {
    records: Vec<Value>,
    flaws: Vec<String>,
    are_under_way: bool,
}

/// Verifies the records of all runs in the folder `runs` with `keys`, and prints the result, as JSON if `json` is true.
/// Also checks the sequence of the runs: no run is missing or renamed, and each run agrees with the hash that the next
/// run has stored.
///
/// Returns `Accepted` if there is no fault, and `UnderWay` if a run has not ended. Returns an error with the number of
/// faults and the first fault if there is any.
pub(super) fn prove(runs: &Path, keys: &[PublicKey], json: bool) -> Result<Outcome, Failure> {
    let mut proof = Proof::default();
    let mut all: Vec<(Option<RunPlace>, PathBuf)> =
        folders(runs).map(|folder| (RunPlace::read(&folder), folder)).collect();
    all.sort_by_key(|(place, folder)| (place.as_ref().map_or(0, |place| place.number), folder.clone()));
    let mut last: Option<(u64, &Path)> = None;
    for (place, folder) in &all {
        proof.verify_run(place.as_ref(), folder, keys);
        let Some(RunPlace { number, before }) = place else { continue };
        proof.follows((*number, folder), before.as_ref(), last);
        last = Some((*number, folder));
    }
    let Proof { records, flaws, are_under_way } = &proof;
    if json {
        super::print_json(&json!({ "runs": runs, "sound": flaws.is_empty(), "flaws": flaws, "each": records }))?;
    } else {
        let lines = records
            .iter()
            .map(|records| format!("{}\n", records["words"].as_str().unwrap_or_default()))
            .collect::<String>();
        super::print(&format!("{lines}{} runs, {} flaws\n", records.len(), flaws.len()))?;
    }
    match flaws.first() {
        Some(first) => Err(Failure::RunsLack { runs: runs.to_owned(), flaws: flaws.len(), first: first.clone() }),
        None if *are_under_way => Ok(Outcome::UnderWay),
        None => Ok(Outcome::Accepted),
    }
}

impl Proof {
    /// Verifies the record of the run in `folder` with `keys`. Adds the result to the list of runs in `self`, and each
    /// fault to the list of flaws. `place` is the number of the run and the state of its previous run; `None` if the
    /// record does not contain them. Does nothing if the folder contains no record.
    fn verify_run(&mut self, place: Option<&RunPlace>, folder: &Path, keys: &[PublicKey]) {
        let name = name_of(folder);
        let number = place.map_or("-".to_owned(), |place| place.number.to_string());
        let stands = match verify_against(folder, &ExternalEvidence { anchor: None, keys: keys.to_vec() }) {
            Err(JournalError::Absent { .. }) => return,
            Err(error) => {
                self.flaws.push(error.to_string());
                "not sound".to_owned()
            }
            Ok(found) if let Err(lacks) = is_whole(&found, keys) => {
                self.flaws.push(format!("{name}: {lacks}"));
                "not whole".to_owned()
            }
            Ok(found) if is_whole(&found, keys) == Ok(false) => {
                self.are_under_way = true;
                "sound so far, under way".to_owned()
            }
            Ok(found) => {
                format!("sound, {} records{}", found.records, if found.keys.is_empty() { ", not signed" } else { "" })
            }
        };
        let begun_as = begin_of(folder).ok().and_then(|begin| begin.run);
        if let Some(begun_as) = begun_as.filter(|begun_as| *begun_as != name) {
            self.flaws.push(format!("{name}: the run began with the name {begun_as}: its folder was renamed"));
        }
        let words = format!("{number:>6}  {name}  {stands}");
        self.records
            .push(json!({ "number": place.map(|place| place.number), "run": name, "stands": stands, "words": words }));
    }

    /// Checks that a run follows the run `last` in the sequence of runs, and adds each fault to the list of flaws. The
    /// checked run is given by its number and its folder. `last` is the run before it in the sequence, also with number
    /// and folder; `None` means that there is none. `before` is the information about the previous run that the checked
    /// run has stored: name, number of records, and hash of the last record.
    ///
    /// The number of the checked run must be the number of `last` plus 1, or 1 if `last` is `None`. If the number is
    /// correct and both `before` and `last` are given, also checks `last`:
    ///
    /// - The name of `last` must be the stored name.
    /// - The stored number of records is the number of a record in `last`. This record must have the stored hash.
    fn follows(&mut self, (number, folder): (u64, &Path), before: Option<&PreviousRun>, last: Option<(u64, &Path)>) {
        let name = name_of(folder);
        let due = last.map_or(1, |(last, _)| last.saturating_add(1));
        if number > due {
            let named = before.map_or(String::new(), |before| {
                format!("; the last missing run was {} with at least {} records", before.run, before.records)
            });
            let missing = if number == due + 1 {
                format!("number {due} is missing")
            } else {
                format!("numbers {due} to {} are missing", number - 1)
            };
            self.flaws.push(format!("{missing} before {name}{named}"));
        } else if number < due {
            self.flaws.push(format!("{name}: another run has the same number {number}"));
        }
        let Some(PreviousRun { run, records, head }) = before else { return };
        let Some((_, last)) = last.filter(|_| number == due) else { return };
        let last_name = name_of(last);
        if last_name != *run {
            self.flaws.push(format!(
                "{last_name}: by number, this run comes before {name}, but {name} names another predecessor: {run}"
            ));
        } else if hash_of(last, *records).as_deref() != Some(head) {
            let what = format!("record {records} does not have the hash that {name} stores");
            self.flaws
                .push(format!("{run}: this run differs from the run that {name} names as its predecessor: {what}"));
        }
    }
}
