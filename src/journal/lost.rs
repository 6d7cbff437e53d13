//! Detects lost records from the files of a run folder: the newest records are only in the write-ahead log of the
//! database, and are lost with it.

use std::fs::{self, File};
use std::io::Read;
use std::path::Path;

use super::error::JournalError;
use super::names::{ANCHOR, DATABASE};
use super::verify::read_anchor;

/// Length in bytes of the header of the log, and of the header of a frame in it (sqlite.org/fileformat.html, "The
/// Write-Ahead Log").
const LOG_HEADER: usize = 32;
const FRAME_HEADER: usize = 24;
/// Magic numbers at the start of a log (checksums over little-endian or big-endian words), its version, and the allowed
/// page sizes in bytes.
const MAGIC: [u32; 2] = [0x377f_0682, 0x377f_0683];
const LOG_VERSION: u32 = 3_007_000;
const PAGES: std::ops::RangeInclusive<usize> = 512..=65_536;
/// Maximum number of bytes of the log that are examined.
const MAX_LOG_BYTES: u64 = 256 << 20;

/// Checks whether acknowledged records of an unfinished run can be lost. A record is acknowledged if the program has
/// seen that the record was on the disk. Returns the reason as a text: the anchor file is missing, or the write-ahead
/// log of the database is missing, empty or damaged. Returns `None` if there is no sign of a loss. Call this function
/// only while no process drives the run.
///
/// # Errors
/// A file cannot be read, or the anchor (number of records and hash of the last one) is invalid.
pub fn may_be_lost(folder: &Path) -> Result<Option<String>, JournalError> {
    if read_anchor(folder)?.is_none() {
        return Ok(Some(format!("{ANCHOR} is missing; every run writes it at its begin")));
    }
    let log = folder.join(format!("{DATABASE}-wal"));
    // A reader that opens a database without a log creates an empty log.
    if !fs::metadata(&log).is_ok_and(|found| found.is_file() && found.len() > 0) {
        return Ok(Some(format!(
            "{DATABASE}-wal is missing or empty; a program that ends during a run leaves it in the folder"
        )));
    }
    let mut bytes = Vec::new();
    let read = File::open(&log).and_then(|file| file.take(MAX_LOG_BYTES).read_to_end(&mut bytes));
    read.map_err(JournalError::file(&log, "reading it"))?;
    Ok(damage(&bytes).map(|what| format!("{DATABASE}-wal is damaged: {what}")))
}

/// Checks `log`, the content of a write-ahead log of SQLite. Returns a message if the header of the log is invalid, or
/// if changes that were already on the disk follow an invalid frame: SQLite cannot read these changes any more. Returns
/// `None` if all frames are valid, or if only the end of the log is invalid, as after a power failure.
///
/// An invalid end is harmless, because SQLite flushes each transaction to the disk before it writes the first frame of
/// the next transaction.
fn damage(log: &[u8]) -> Option<String> {
    if log.len() <= LOG_HEADER {
        return None;
    }
    let word = |at: usize| u32::from_be_bytes(log[at..at + 4].try_into().expect("four bytes"));
    let (magic, version, page) = (word(0), word(4), word(8) as usize);
    let is_header = MAGIC.contains(&magic) && version == LOG_VERSION && page.is_power_of_two() && PAGES.contains(&page);
    let sum = |[mut a, mut b]: [u32; 2], bytes: &[u8]| {
        for pair in bytes.as_chunks::<8>().0 {
            let [x, y] = [0, 4].map(|at| {
                let four = pair[at..at + 4].try_into().expect("four bytes");
                if magic == MAGIC[1] { u32::from_be_bytes(four) } else { u32::from_le_bytes(four) }
            });
            a = a.wrapping_add(x).wrapping_add(b);
            b = b.wrapping_add(y).wrapping_add(a);
        }
        [a, b]
    };
    let mut so_far = sum([0, 0], &log[..24]);
    // SQLite syncs the header before it writes the first frame.
    if !is_header || so_far != [word(24), word(28)] {
        return Some("its header is invalid, and nothing after it can be read".to_owned());
    }
    let (mut holds, mut committed, mut synced) = (true, 0, 0);
    for frame in log[LOG_HEADER..].chunks_exact(FRAME_HEADER + page) {
        // Frames of an earlier use of the log have other salts. A frame with a damaged header can also have other
        // salts; then the frames after it do not match either.
        let is_of_this = frame[8..16] == log[16..24];
        if holds {
            let sum = sum(sum(so_far, &frame[..8]), &frame[FRAME_HEADER..]);
            let stated = [16, 20].map(|at| u32::from_be_bytes(frame[at..at + 4].try_into().expect("four bytes")));
            (holds, so_far) = (is_of_this && sum == stated, sum);
            if holds {
                continue;
            }
        }
        if is_of_this {
            synced = committed;
            committed += usize::from(frame[4..8] != [0; 4]);
        }
    }
    (synced > 0).then(|| format!("at least {synced} changes that were on the disk follow an invalid part"))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::record::{Entry, RecordKind};
    use super::super::write::{Header, Journal};
    use super::*;

    /// Creates the folder of an interrupted run, and returns the content of its log.
    fn broken_off(records: u64) -> (tempfile::TempDir, std::path::PathBuf, Vec<u8>) {
        let home = tempfile::tempdir().unwrap();
        let driven = home.path().join("driven");
        let header = Header {
            run: "run-1".into(),
            part: "SN 7".into(),
            actor: "Ada".into(),
            station: "console".into(),
            simulation: true,
            first_command_id: 1,
            content: json!({}),
        };
        let mut journal = Journal::create(&driven, header).unwrap();
        for k in 0..records {
            journal.append(Entry::new(RecordKind::Note, k, 1, json!({ "k": k }))).unwrap();
        }
        // Copies the folder while the journal is open: the same state as after a kill.
        let folder = home.path().join("run");
        fs::create_dir(&folder).unwrap();
        for entry in fs::read_dir(&driven).unwrap().map(Result::unwrap) {
            fs::copy(entry.path(), folder.join(entry.file_name())).unwrap();
        }
        let log = fs::read(folder.join("journal.sqlite-wal")).unwrap();
        (home, folder, log)
    }

    #[test]
    fn may_be_lost_detects_damaged_wal() {
        let (_home, folder, log) = broken_off(12);
        assert_eq!(may_be_lost(&folder).unwrap(), None);
        let path = folder.join("journal.sqlite-wal");
        let told = |bytes: &[u8]| {
            fs::write(&path, bytes).unwrap();
            may_be_lost(&folder).unwrap()
        };
        // A power failure that tears the end of the log leaves no committed change after the torn place.
        assert_eq!(told(&log[..log.len() - 700]), None);
        let mut flipped = log.clone();
        flipped[LOG_HEADER + FRAME_HEADER + 77] ^= 1;
        let what = told(&flipped).expect("one flipped bit in the first frame");
        assert!(what.contains("is damaged"), "{what}");
        let mut header = log.clone();
        header[17] ^= 1;
        assert!(told(&header).is_some(), "one flipped bit in the header");
        // A frame that is no longer read, whichever part of it is damaged; and a block of zeros, as read from a bad
        // sector or a lost extent.
        let frame = FRAME_HEADER + u32::from_be_bytes(log[8..12].try_into().unwrap()) as usize;
        for at in [LOG_HEADER + 8, LOG_HEADER + frame * 5 + 9, LOG_HEADER + frame * 5 + 20] {
            let mut damaged = log.clone();
            damaged[at] ^= 1;
            assert!(told(&damaged).is_some(), "one flipped bit at {at}");
        }
        for zeros in [0..4096, 4096..8192, 0..log.len()] {
            let mut damaged = log.clone();
            damaged[zeros.clone()].fill(0);
            assert!(told(&damaged).is_some(), "{zeros:?} zero");
        }
        // The power failed during the write of the last transaction: its end is there, and a part before the end is
        // missing.
        let last = log.len() - frame;
        let mut torn = log.clone();
        torn[last - frame + FRAME_HEADER + 3] ^= 1;
        let begins = |from: usize| log[from + 4..from + 8] != [0; 4];
        assert_eq!(told(&torn).is_some(), begins(last - frame), "the frame before is a transaction of its own, or not");
        let mut torn = log.clone();
        torn[last + FRAME_HEADER + 3] ^= 1;
        assert_eq!(told(&torn), None);
        assert_eq!(told(&log), None);
        fs::remove_file(&path).unwrap();
        assert!(may_be_lost(&folder).unwrap().unwrap().contains("-wal is missing or empty"));
        fs::remove_file(folder.join(ANCHOR)).unwrap();
        assert!(may_be_lost(&folder).unwrap().unwrap().contains("journal.anchor is missing"));
    }
}
