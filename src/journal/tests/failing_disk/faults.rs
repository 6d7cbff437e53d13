//! One thing after the other goes wrong, everywhere.

use std::collections::BTreeMap;

use regrind_disk::{Disk, Fault, Operation, SeededNumbers};
use regrind_journal::{AuditKey, Journal, verify};

use crate::life::{CHECKPOINT_PAGES, Home, Life, draws, header, mode, short};

/// A fault at one place.
#[derive(Clone, Copy, Debug)]
struct Place {
    operation: Operation,
    after: u64,
    times: u64,
    fault: Fault,
}

/// Every fault at every operation of a life; where only a sample is wanted, as many of each kind.
fn places(key: &AuditKey, drawn: &mut SeededNumbers) -> Vec<Place> {
    let home = Home::new();
    let folder = home.folder("run");
    let disk = Disk::under(&folder, CHECKPOINT_PAGES);
    let (life, begun) = Life::led(&disk, &folder, Some(key.clone()), &short(), "a life");
    let asked: BTreeMap<_, _> = Operation::ALL.map(|operation| (operation, disk.asked(operation))).into();
    assert!(begun && life.errors.is_empty());
    life.is_whole();
    println!("operations in a life: {asked:?}");
    let mut places = Vec::new();
    for (operation, count) in asked {
        let mut of_this = Vec::new();
        for after in 0..count {
            for fault in operation.faults(drawn) {
                let times = drawn.one(&[1, 1, 1, 2, 7, u64::MAX]);
                of_this.push(Place { operation, after, times, fault });
            }
        }
        match draws() {
            Some(_) => places.append(&mut of_this),
            None => places.extend((0..12).map(|_| of_this[drawn.below(of_this.len() as u64) as usize])),
        }
    }
    places
}

#[test]
fn disk_faults_lose_no_record() {
    let (mut drawn, key) = (SeededNumbers::new(21), AuditKey::new());
    let places = places(&key, &mut drawn);
    let (mut struck, mut refused, mut unbegun) = (0, 0, 0);
    for (number, place) in places.iter().enumerate() {
        let at = format!("{number}: {place:?}");
        let home = Home::new();
        let folder = home.folder("run");
        let disk = Disk::under(&folder, CHECKPOINT_PAGES);
        disk.spoil(place.operation, place.after, place.times, place.fault);
        let (life, begun) = Life::led(&disk, &folder, Some(key.clone()), &short(), &at);
        struck += usize::from(disk.struck() > 0);
        disk.heal();
        refused += usize::from(!life.errors.is_empty());
        match begun {
            true => life.is_whole(),
            false => {
                unbegun += 1;
                // What cannot be begun has no end, and is nothing that anybody rests on.
                assert!(verify(&folder).map_or(true, |found| !found.closed && found.records <= 2), "{at}");
            }
        }
    }
    // The time of day and the hashes are others in each life, and with them now and then the pages that are written.
    assert!(10 * struck > 9 * places.len(), "{struck} of {} were come to", places.len());
    println!("{} places, refused at {refused}, not begun at {unbegun}", places.len());
}

#[test]
fn create_on_failing_disk_uses_wal() {
    // Without one a commit would be taken back by a power cut, for the file that does so is only deleted then.
    let (home, mut drawn) = (Home::new(), SeededNumbers::new(22));
    for operation in Operation::ALL {
        for after in 0.. {
            let folder = home.empty("run");
            let disk = Disk::under(&folder, CHECKPOINT_PAGES);
            for fault in operation.faults(&mut drawn) {
                let folder = home.empty("run");
                disk.spoil(operation, after, 1, fault);
                let created = Journal::create(&folder, header());
                let at = format!("{fault:?} in {operation:?} {after}");
                disk.heal();
                match created {
                    Ok(_) => assert_eq!(mode(&folder).as_deref(), Some("wal"), "{at}"),
                    Err(error) => assert!(error.to_string().contains(&*folder.to_string_lossy()), "{at}: {error}"),
                }
            }
            if disk.struck() == 0 {
                break;
            }
        }
    }
}
