//! Tests of a power cut at every moment of a journal's life.

use std::path::Path;

use regrind_disk::{Cut, Disk, Fault, Operation, Outcome, SeededNumbers};
use regrind_journal::{AuditKey, Entry, Journal, JournalError, Reader, RecordKind, verify};
use rusqlite::Connection;
use serde_json::json;

use crate::life::{
    AcknowledgedRecord, CHECKPOINT_PAGES, Home, Life, draws, header, is_gone_on_with, long, read_acknowledged, records,
    short, verified,
};

/// Asserts that every record that was acknowledged before a cut exists after it.
/// The record in progress at the cut exists completely or not at all. Returns true if the run can be resumed.
fn is_sound(folder: &Path, cut: &Cut, told: &[AcknowledgedRecord], at: &str) -> bool {
    if cut.mark == 0 {
        // Nobody was told that there is a run. What can be believed nevertheless has begun.
        return verify(folder).is_ok_and(|verified| verified.records > 0);
    }
    let acknowledged = cut.mark as usize - 1;
    let verified = verified(folder, at);
    let found = read_acknowledged(folder);
    assert!(found.len() >= acknowledged, "{at}: {acknowledged} were acknowledged and {} are there", found.len());
    assert!(found.len() <= acknowledged + 1, "{at}: {} are there, and {acknowledged} were acknowledged", found.len());
    assert_eq!(found[..], told[..found.len()], "{at}");
    if acknowledged == told.len() {
        assert!(verified.closed && !verified.lacks_last_seal(), "{at}: {verified:?}");
    }
    !verified.closed
}

fn note(k: u64) -> Entry {
    Entry::new(RecordKind::Note, k, 1, json!({ "k": k }))
}

/// Returns the outcomes to try for one cut.
fn outcomes(drawn: &mut SeededNumbers) -> Vec<Outcome> {
    match draws() {
        Some(draws) => Outcome::ALL.into_iter().chain((1..draws).map(|_| Outcome::Torn)).collect(),
        None => vec![drawn.one(&[Outcome::Lost, Outcome::Kept, Outcome::Torn, Outcome::Torn])],
    }
}

/// Tests one cut: restores the files, verifies the journal and resumes the run.
fn is_survived(
    home: &Home,
    cut: &Cut,
    told: &[AcknowledgedRecord],
    key: Option<&AuditKey>,
    outcome: Outcome,
    at: &str,
    seed: u64,
) {
    let after = home.empty("after");
    cut.restore(&after, outcome, &mut SeededNumbers::new(seed)).unwrap();
    if is_sound(&after, cut, told, at) {
        is_gone_on_with(&after, key, at);
    }
}

#[test]
fn power_cut_loses_no_record() {
    let mut drawn = SeededNumbers::new(11);
    // Of a long life, whose cuts are alike, the share that is tried is smaller.
    for (key, steps, share) in
        [(Some(AuditKey::new()), short(), 1), (None, short(), 1), (Some(AuditKey::new()), long(), 20)]
    {
        let home = Home::new();
        let folder = home.folder("run");
        let disk = Disk::remembering(&folder, CHECKPOINT_PAGES);
        let (life, begun) = Life::led(&disk, &folder, key.clone(), &steps, "a life");
        assert!(begun && life.errors.is_empty());
        let cuts = disk.cuts();
        life.is_whole();
        assert!(cuts.len() > 300, "{} cuts", cuts.len());
        let step = if draws().is_some() { share } else { 3 * share };
        let first = drawn.below(step) as usize;
        for (number, cut) in cuts.iter().enumerate().skip(first).step_by(step as usize) {
            for outcome in outcomes(&mut drawn) {
                let seed = drawn.below(u64::MAX);
                let at = format!("cut {number}, {}, mark {}, {outcome:?}, seed {seed}", cut.during, cut.mark);
                is_survived(&home, cut, &life.acknowledged, key.as_ref(), outcome, &at, seed);
            }
        }
        println!("{} cuts, every {step}, signed: {}", cuts.len(), key.is_some());
    }
}

#[test]
fn power_cut_during_recovery() {
    let (mut drawn, key) = (SeededNumbers::new(12), AuditKey::new());
    let home = Home::new();
    let folder = home.folder("run");
    let disk = Disk::remembering(&folder, CHECKPOINT_PAGES);
    let (life, _) = Life::led(&disk, &folder, Some(key.clone()), &short(), "a life");
    let cuts: Vec<_> = disk.cuts().into_iter().filter(|cut| cut.mark > 0).collect();
    let (mut tried, tries) = (0, draws().map_or(6, |draws| 20 * draws));
    while tried < tries {
        let cut = &cuts[drawn.below(cuts.len() as u64) as usize];
        let (outcome, seed) = (drawn.one(&Outcome::ALL), drawn.below(u64::MAX));
        let at = format!("{}, mark {}, {outcome:?}, seed {seed}", cut.during, cut.mark);
        let again = home.empty("again");
        cut.restore(&again, outcome, &mut SeededNumbers::new(seed)).unwrap();
        if !is_sound(&again, cut, &life.acknowledged, &at) {
            continue;
        }
        tried += 1;
        let before = records(&again);
        // As found: looking at it has changed the files.
        let again = home.empty("again");
        let disk = Disk::remembering(&again, CHECKPOINT_PAGES);
        cut.restore(&again, outcome, &mut SeededNumbers::new(seed)).unwrap();
        drop(Journal::open_with(&again, Some(key.clone())).unwrap());
        let second = disk.cuts();
        drop(disk);
        for (number, again) in second.iter().enumerate().step_by(if draws().is_some() { 1 } else { 4 }) {
            let (outcome, seed) = (drawn.one(&Outcome::ALL), drawn.below(u64::MAX));
            let at = format!("{at}; cut {number}, {}, {outcome:?}, seed {seed}", again.during);
            let after = home.empty("after");
            again.restore(&after, outcome, &mut SeededNumbers::new(seed)).unwrap();
            verified(&after, &at);
            let found = records(&after);
            assert_eq!(found[..before.len()], before, "{at}");
            is_gone_on_with(&after, Some(&key), &at);
        }
    }
}

#[test]
fn power_cut_after_disk_fault() {
    let (mut drawn, key) = (SeededNumbers::new(13), AuditKey::new());
    let (mut cut, mut tried) = (0, 0);
    for number in 0..draws().map_or(8, |draws| 100 * draws) {
        let home = Home::new();
        let folder = home.folder("run");
        let disk = Disk::remembering(&folder, CHECKPOINT_PAGES);
        let operation = drawn.one(&[Operation::Write, Operation::Sync, Operation::Sync, Operation::Truncate]);
        let faults = operation.faults(&mut drawn);
        let fault: Fault = drawn.one(&faults);
        let (after, times) = (drawn.below(if operation == Operation::Truncate { 2 } else { 60 }), 1 + drawn.below(3));
        disk.spoil(operation, after, times, fault);
        let life_at = format!("life {number}, {fault:?} in {operation:?} {after}, {times} times");
        let (life, begun) = Life::led(&disk, &folder, Some(key.clone()), &short(), &life_at);
        if !begun {
            continue;
        }
        tried += 1;
        let cuts = disk.cuts();
        disk.heal();
        let key = Some(&key);
        for _ in 0..16 {
            let at = drawn.below(cuts.len() as u64) as usize;
            let (outcome, seed) = (drawn.one(&Outcome::ALL), drawn.below(u64::MAX));
            let during = &cuts[at].during;
            let words = format!("{life_at}, cut {at}, {during}, mark {}, {outcome:?}, seed {seed}", cuts[at].mark);
            is_survived(&home, &cuts[at], &life.acknowledged, key, outcome, &words, seed);
            cut += 1;
        }
    }
    println!("{tried} lives with a fault, cut {cut} times");
}

#[test]
fn failed_sync_rewritten_before_resume() {
    let home = Home::new();
    let mut refused = 0;
    // What a program leaves that was killed: its records stand in the log only.
    let first = home.folder("first");
    let disk = Disk::remembering(&first, CHECKPOINT_PAGES);
    Journal::create(&first, header()).unwrap().append(note(1)).unwrap();
    let left = disk.cuts().into_iter().rev().find(|cut| cut.during.contains("sync of journal.sqlite-wal")).unwrap();
    for (after, times) in (0..8).flat_map(|after| [(after, 1), (after, 2), (after, 3)]) {
        let folder = home.empty("run");
        let disk = Disk::remembering(&folder, CHECKPOINT_PAGES);
        left.restore(&folder, Outcome::Kept, &mut SeededNumbers::new(0)).unwrap();
        // The log is given up by the system, and not forgotten by its memory.
        disk.spoil(Operation::Sync, after, times, Fault::Forget(after + times));
        let mut journal = (0..5).find_map(|_| {
            let opened = Journal::open(&folder).ok();
            refused += usize::from(opened.is_none());
            opened
        });
        let journal = journal.as_mut().expect("the disk is well again");
        while journal.append(note(2)).is_err() {}
        disk.heal();
        for outcome in Outcome::ALL {
            let at = format!("{after}, {times} times, {outcome:?}");
            let after = home.empty("after");
            disk.cuts().last().unwrap().restore(&after, outcome, &mut SeededNumbers::new(1)).unwrap();
            verified(&after, &at);
            let found: Vec<_> = read_acknowledged(&after).iter().map(|told| told.mono_ns).collect();
            assert_eq!(found, [1, 2], "{at}");
            is_gone_on_with(&after, None, &at);
        }
    }
    assert!(refused > 5, "{refused}");
}

#[test]
fn uncommitted_record_is_not_read() {
    // As a program would leave it that was stopped while it wrote to a database without a log: the journal beside it
    // takes back what stands in the file. A reader that may not write cannot do that.
    let home = Home::new();
    let folder = home.folder("run");
    drop(Journal::create(&folder, header()).unwrap());
    let path = folder.join("journal.sqlite");
    let database = Connection::open(&path).unwrap();
    database.query_row("PRAGMA journal_mode = delete", [], |_| Ok(())).unwrap();
    drop(database);
    let disk = Disk::remembering(&folder, CHECKPOINT_PAGES);
    let database = Connection::open(&path).unwrap();
    let sql = "INSERT INTO record SELECT 2, utc, boot_id, 5, actor, station, 'note', part, cycle, command_id, reason, payload, hash, 'x' FROM record";
    database.execute_batch(sql).unwrap();
    let cuts = disk.cuts();
    drop(database);
    // The database is brought to the disk, and the journal is still there.
    let cut = cuts.iter().rev().find(|cut| cut.during.contains("deletion")).unwrap();
    let after = home.empty("after");
    cut.restore(&after, Outcome::Lost, &mut SeededNumbers::new(0)).unwrap();
    assert!(after.join("journal.sqlite-journal").exists());
    let refused = Reader::open(&after).map(|_| ());
    assert!(matches!(refused, Err(JournalError::Foreign { .. })), "{refused:?}");
    drop(Journal::open(&after).unwrap());
    is_gone_on_with(&after, None, "taken back by a writer");
    assert!(read_acknowledged(&after).iter().all(|told| told.mono_ns != 5), "it was never committed");
}
