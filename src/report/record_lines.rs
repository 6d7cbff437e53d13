//! Lines of the record of a run, for a person who reads them in a browser.

use std::collections::VecDeque;
use std::path::Path;

use regrind_journal::{JournalError, Reader, Record, RecordKind, verify};
use serde_json::Value;

use super::words;

/// Stations of records that no person has caused: the program itself, and a machine on its wire.
const STATIONS_OF_PROGRAM: [&str; 2] = ["regrind", "wire"];

/// Choice of the records of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RecordChoice {
    /// All records.
    #[default]
    All,
    /// Orders, confirmations and remarks of people: the log of a shift.
    People,
    /// Events of the cell: what happened, without commands, answers and files.
    Events,
}

impl RecordChoice {
    fn includes(self, record: &Record) -> bool {
        match self {
            Self::All => true,
            Self::People => {
                !STATIONS_OF_PROGRAM.contains(&record.station.as_str()) && record.kind != RecordKind::Outcome
            }
            Self::Events => record.kind == RecordKind::Event,
        }
    }
}

/// Record of a run as a line for a person.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecordLine {
    /// Number of the record, from 1.
    pub number: u64,
    /// Time of day, RFC 3339 in UTC.
    pub utc: String,
    /// Person or machine that acted, or the cell.
    pub who: String,
    /// Computer of a person; empty for the program and the machines.
    pub station: String,
    /// Kind of the record, such as `event`.
    pub kind: &'static str,
    /// Number of the cycle; 0 before the first.
    pub cycle: u32,
    /// Content in words.
    pub words: String,
}

/// Returns the last `count` records of the run in `folder` that `choice` includes, from the newest to the oldest. Only
/// records before the record number `before` are used, if it is given.
///
/// # Errors
/// Returns an error if the journal cannot be read.
pub fn record_lines(
    folder: &Path,
    choice: RecordChoice,
    before: Option<u64>,
    count: usize,
) -> Result<Vec<RecordLine>, JournalError> {
    let mut kept: VecDeque<Record> = VecDeque::with_capacity(count + 1);
    let reader = Reader::open(folder)?;
    for record in reader.records(1) {
        let record = record?;
        if before.is_some_and(|before| record.seq >= before) {
            break;
        }
        if choice.includes(&record) {
            if kept.len() == count {
                kept.pop_front();
            }
            kept.push_back(record);
        }
    }
    Ok(kept.iter().rev().map(line).collect())
}

fn line(record: &Record) -> RecordLine {
    let is_person = !STATIONS_OF_PROGRAM.contains(&record.station.as_str());
    RecordLine {
        number: record.seq,
        utc: record.utc.clone(),
        who: record.actor.clone(),
        station: if is_person { record.station.clone() } else { String::new() },
        kind: record.kind.as_str(),
        cycle: record.cycle,
        words: words(record),
    }
}

/// Record of a run for a program that reads it.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordEntry {
    /// Record as a line for a person.
    pub line: RecordLine,
    /// Number of the command that the record belongs to.
    pub command_id: Option<u32>,
    /// Reason in words; can be empty.
    pub reason: String,
    /// Content, as it is recorded.
    pub content: Value,
    /// Hash of the record.
    pub hash: String,
}

/// Returns the records of the run in `folder` that `choice` includes, from the record after the number `after` on, in
/// their order. Returns at most `count` of them, and ends earlier as soon as their contents have more than `max_bytes`.
/// Also returns the number of the last record that was looked at; it is `after` if there is no further one.
///
/// # Errors
/// Returns an error if the journal cannot be read.
pub fn record_entries(
    folder: &Path,
    choice: RecordChoice,
    after: u64,
    (count, max_bytes): (usize, usize),
) -> Result<(Vec<RecordEntry>, u64), JournalError> {
    let (mut entries, mut last, mut bytes) = (Vec::new(), after, 0);
    let reader = Reader::open(folder)?;
    for record in reader.records(after.saturating_add(1)) {
        let record = record?;
        last = record.seq;
        if choice.includes(&record) {
            bytes += record.payload.len();
            entries.push(entry(record));
        }
        if entries.len() >= count || bytes > max_bytes {
            break;
        }
    }
    Ok((entries, last))
}

/// Returns the number of the last record of the run in `folder`; 0 if it has none.
///
/// # Errors
/// Returns an error if the journal cannot be read.
pub fn record_count(folder: &Path) -> Result<u64, JournalError> {
    Ok(Reader::open(folder)?.last()?.map_or(0, |record| record.seq))
}

fn entry(record: Record) -> RecordEntry {
    let (line, content) = (line(&record), record.value());
    let Record { command_id, reason, hash, .. } = record;
    RecordEntry { line, command_id, reason, content, hash }
}

/// Result of the verification of the record of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RecordVerification {
    /// The record and its files are as they were written.
    Intact {
        /// Number of records.
        records: u64,
        /// Number of the last record that a signature covers; 0 if none does.
        signed: u64,
    },
    /// The record is not as it was written, or cannot be read, with the reason.
    Broken(String),
}

/// Verifies the record of the run in `folder`: the chain of its records, its signatures and its files.
pub fn verify_record(folder: &Path) -> RecordVerification {
    match verify(folder) {
        Ok(found) => RecordVerification::Intact { records: found.records, signed: found.signed },
        Err(error) => RecordVerification::Broken(error.to_string()),
    }
}
