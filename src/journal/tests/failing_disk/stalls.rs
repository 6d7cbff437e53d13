//! Tests of a disk that stalls: a writer waits, and a reader does not.

use std::ops::RangeInclusive;
use std::path::Path;
use std::thread;

use regrind_disk::{Disk, Operation};
use regrind_journal::{AuditKey, Entry, Journal, RecordKind, verify};
use serde_json::json;

use crate::life::{Home, header, read_acknowledged, verified, words};

fn note(k: u64) -> Entry {
    Entry::new(RecordKind::Note, k, 1, json!({ "words": words(k, 200) }))
}

/// Asserts that a reader sees all acknowledged records during the stall, and that the run is under way.
fn is_read(folder: &Path, records: RangeInclusive<usize>) {
    let found = verified(folder, "read while the disk stands still");
    assert!(found.under_way && !found.closed);
    let found = read_acknowledged(folder).len();
    assert!(records.contains(&found), "{found}");
}

#[test]
fn stalled_sync_blocks_writer_only() {
    // The next sync is that of the record in the log. With a log of one page it is brought into the database by those
    // that follow.
    for (pages, after) in [(1000, 0), (1, 0), (1, 1), (1, 2), (1, 3)] {
        let home = Home::new();
        let folder = home.folder("run");
        let disk = Disk::under(&folder, pages);
        let mut journal = Journal::create_with(&folder, header(), Some(AuditKey::new())).unwrap();
        for k in 0..3 {
            journal.append(note(k)).unwrap();
        }
        let stall = disk.stall(Operation::Sync, after);
        thread::scope(|scope| {
            let writer = scope.spawn(|| {
                let written: Result<Vec<_>, _> = (3..6).map(|k| journal.append(note(k))).collect();
                // A stall that was not reached by now never is.
                disk.heal();
                written
            });
            assert!(stall.is_reached());
            assert!(!writer.is_finished());
            // A record is there once its commit is, while the log is still brought into the database.
            is_read(&folder, 3..=if pages == 1 { 4 } else { 3 });
            stall.release();
            writer.join().unwrap().unwrap();
        });
        is_read(&folder, 6..=6);
        journal.close(9, 1, json!("accepted")).unwrap();
        assert!(verified(&folder, "afterwards").closed);
    }
}

#[test]
fn verify_refuses_run_being_created() {
    let home = Home::new();
    for after in 0..3 {
        let folder = home.folder(&after.to_string());
        let disk = Disk::under(&folder, 1000);
        let stall = disk.stall(Operation::Sync, after);
        thread::scope(|scope| {
            let writer = scope.spawn(|| {
                let created = Journal::create(&folder, header());
                disk.heal();
                created
            });
            assert!(stall.is_reached());
            let refused = verify(&folder).unwrap_err().to_string();
            assert!(refused.contains(&*folder.to_string_lossy()), "{refused}");
            stall.release();
            drop(writer.join().unwrap().unwrap());
        });
        assert_eq!(verified(&folder, "afterwards").records, 1);
    }
}
