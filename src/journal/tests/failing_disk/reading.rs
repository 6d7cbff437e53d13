//! A disk that fails while a record is read: what is said of the record is true, or it is an error.

use std::path::Path;

use regrind_disk::{Disk, Fault, Operation, SeededNumbers};
use regrind_journal::{AuditKey, JournalError, Reader, Record, Verified, verify};

use crate::life::{CHECKPOINT_PAGES, Home, Life, draws, records, short};

/// A run that came to its end, and one that was left in the middle with records in its log only.
fn folders(home: &Home) -> Vec<std::path::PathBuf> {
    let folder = home.folder("run");
    let disk = Disk::remembering(&folder, CHECKPOINT_PAGES);
    Life::led(&disk, &folder, Some(AuditKey::new()), &short(), "a life").0.is_whole();
    let cuts = disk.cuts();
    drop(disk);
    let middle = home.folder("middle");
    // The newest before its second reopening.
    let cut = cuts.iter().rev().find(|cut| cut.mark == 25).unwrap();
    cut.restore(&middle, regrind_disk::Outcome::Kept, &mut SeededNumbers::new(0)).unwrap();
    vec![folder, middle]
}

/// Every operation of a reading, spoilt.
fn spoilt(folder: &Path, faults: &[(Operation, Fault)], read: &mut dyn FnMut(&str)) {
    let disk = Disk::under(folder, CHECKPOINT_PAGES);
    for &(operation, fault) in faults {
        for after in 0.. {
            disk.spoil(operation, after, 1, fault);
            read(&format!("{fault:?} in {operation:?} {after} of {}", folder.display()));
            if disk.struck() == 0 {
                break;
            }
        }
        disk.heal();
    }
}

const ERRORS: [(Operation, Fault); 8] = [
    (Operation::Open, Fault::Error),
    (Operation::Read, Fault::Error),
    (Operation::Size, Fault::Error),
    (Operation::Lock, Fault::Busy),
    (Operation::IndexLock, Fault::Busy),
    (Operation::IndexMap, Fault::Error),
    (Operation::IndexMap, Fault::Full),
    (Operation::Access, Fault::Error),
];

fn is_true_or_an_error(found: Result<Verified, JournalError>, truth: &Verified, folder: &Path, at: &str) {
    match found {
        Ok(found) => assert_eq!(&found, truth, "{at}"),
        Err(error) => {
            let accuses = matches!(error, JournalError::Broken { .. } | JournalError::Foreign { .. });
            assert!(!accuses, "{at}: a disk that fails is told as a record that is wrong: {error:?}");
            assert!(error.to_string().contains(&*folder.to_string_lossy()), "{at}: no place in {error}");
        }
    }
}

/// Everything is given, or an error stands behind what is.
fn is_all_or_an_error(folder: &Path, truth: &[Record], at: &str) {
    let Ok(reader) = Reader::open(folder) else { return };
    let given: Vec<_> = reader.records(0).collect();
    let failed = given.last().is_some_and(Result::is_err);
    let given: Vec<_> = given.into_iter().filter_map(Result::ok).collect();
    assert_eq!(given[..], truth[..given.len()], "{at}");
    assert!(failed || given.len() == truth.len(), "{at}: {} of {} and no word of it", given.len(), truth.len());
}

#[test]
fn read_fault_is_reported_as_error() {
    let home = Home::new();
    for folder in folders(&home) {
        let (truth, all) = (verify(&folder).unwrap(), records(&folder));
        spoilt(&folder, &ERRORS, &mut |at| is_true_or_an_error(verify(&folder), &truth, &folder, at));
        spoilt(&folder, &ERRORS, &mut |at| is_all_or_an_error(&folder, &all, at));
        assert_eq!(verify(&folder).unwrap(), truth, "nothing was changed");
    }
}

#[test]
fn silent_read_corruption_is_found() {
    let home = Home::new();
    let folder = &folders(&home)[0];
    let (truth, mut drawn) = (verify(folder).unwrap(), SeededNumbers::new(31));
    let mut found = 0;
    for _ in 0..draws().unwrap_or(3) {
        let (zeros, flipped) = (Fault::Zeros(drawn.below(1 << 40)), Fault::Flipped(drawn.below(1 << 40)));
        spoilt(folder, &[(Operation::Read, zeros), (Operation::Read, flipped)], &mut |at| match verify(folder) {
            Ok(verified) => assert_eq!(verified, truth, "{at}"),
            Err(_) => found += 1,
        });
    }
    assert!(found > 0);
}
