//! Lines of the record of a run, for a person who reads them in a browser.

use std::collections::VecDeque;
use std::path::Path;

use regrind_journal::{JournalError, Reader, Record, RecordKind, verify};

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
