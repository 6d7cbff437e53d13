//! Orders from another terminal in every phase: the commands on the wire, and the agreement of the journal with what
//! the machines received.
//!
//! `cargo bench --bench orders` measures the duration of an order.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use regrind::cell::{AlarmId, Ending};
use regrind::drive::{Drive, OrderSender, Request};
use regrind::journal::{Reader, RecordKind, verify};
use regrind_sim::command::CommandFrame;
use regrind_sim::event_log::HandshakeEvent;
use regrind_testcell::rig::{CMM, GRINDER, Ready, Rig, event, order};
use regrind_testcell::tries::{MOMENTS, attempt, attempt_with};
use serde_json::Value;

const DEVICES: [&str; 2] = ["cmm", "grinder"];

/// Returns the command of docs/modbus.md that an intent leads to, if there is one.
fn command_of(intent: &Value) -> Option<u16> {
    let names = [
        "connect",
        "prepare",
        "start_machine",
        "hold_machine",
        "resume_machine",
        "stop_machine",
        "abort_machine",
        "clear_machine",
        "acknowledge",
    ];
    names.iter().position(|name| intent["command"] == **name).map(|k| k as u16 + 1)
}

fn records(folder: &Path, kind: RecordKind) -> Vec<Value> {
    let reader = Reader::open(folder).unwrap();
    reader.records(1).map(Result::unwrap).filter(|r| r.kind == kind).map(|r| r.value()).collect()
}

fn intents(folder: &Path, machine: usize) -> Vec<(u16, Value)> {
    let of_it = records(folder, RecordKind::Intent).into_iter().filter(|value| value["device"] == DEVICES[machine]);
    of_it.filter_map(|value| Some((command_of(&value)?, value))).collect()
}

fn frames(rig: &Rig, machine: usize, from: usize) -> Vec<CommandFrame> {
    rig.servings[machine].machines()[0].1.with(|m| {
        let seen = m.log()[from..].iter();
        seen.filter_map(
            |seen| if let HandshakeEvent::Commanded { frame, .. } = &seen.event { Some(*frame) } else { None },
        )
        .collect()
    })
}

fn seen_so_far(rig: &Rig, machine: usize) -> usize {
    rig.servings[machine].machines()[0].1.with(|m| m.log().len())
}

/// Checks that every frame has its intent, in order, and that every intent has its frame unless an abort made it void.
fn compare(name: &str, frames: &[CommandFrame], intents: &[(u16, Value)]) {
    let mut next = 0;
    let commands: Vec<u16> = frames.iter().map(|f| f.command).collect();
    let intended: Vec<u16> = intents.iter().map(|(command, _)| *command).collect();
    let story = format!("{name}: intents {intended:?}, frames {commands:?}");
    for (k, frame) in frames.iter().enumerate() {
        // Two frames are part of another command: the one that gives the machine back at the end, and the one that
        // cancels an existing preparation before the next.
        let part_of_prepare = frame.command == 6 && commands.get(k + 1) == Some(&2);
        if frame.command == 10 || part_of_prepare {
            continue;
        }
        let skipped = intents[next..].iter().position(|(command, _)| *command == frame.command);
        let skipped = skipped.unwrap_or_else(|| panic!("{story}: frame {} has no intent", k + 1));
        for (command, _) in &intents[next..next + skipped] {
            // A result that does not exist needs no acknowledgement. An abort cancels the open question.
            assert!(*command == 9 || frame.command == 7, "{story}: intent {command} was not carried out");
        }
        next += skipped;
        let intent = &intents[next].1;
        if frame.command == 3 {
            let is = &intent["intent"];
            let told = (is["start_sequence"].as_u64(), is["token"].as_u64(), is["cycle"].as_u64());
            let meant = (Some(frame.sequence.into()), Some(frame.token.into()), Some(frame.cycle.into()));
            assert_eq!(told, meant, "{story}");
        }
        next += 1;
    }
    assert_eq!(next, intents.len(), "{story}: intents without a frame at the end");
}

/// Checks that no command is on a wire before its intent is on the disk.
fn watch_the_disk(rig: &Rig, folder: &Arc<Mutex<PathBuf>>, broken: &Arc<Mutex<Vec<String>>>) {
    for machine in [CMM, GRINDER] {
        let (folder, broken) = (Arc::clone(folder), Arc::clone(broken));
        let mut of_run = PathBuf::new();
        let (mut counts, mut last) = ([0usize; 16], 0);
        rig.watch(
            machine,
            Box::new(move |command| {
                let folder = folder.lock().unwrap().clone();
                if of_run != folder {
                    (of_run, counts, last) = (folder.clone(), [0; 16], 0);
                }
                let number = usize::from(command).min(15);
                // A frame that was not acknowledged in time is sent again. No command is ever given twice in a row.
                counts[number] += usize::from(command != last);
                last = command;
                let on_disk = match command {
                    // Safety orders do not wait for the disk. Their cause is recorded as soon as possible.
                    4 | 6 | 7 | 10 => usize::MAX,
                    _ => intents(&folder, machine).iter().filter(|(intended, _)| *intended == command).count(),
                };
                if on_disk < counts[number] {
                    let times = counts[number];
                    broken.lock().unwrap().push(format!("command {command} came the {times}. time, on disk {on_disk}"));
                }
            }),
        );
    }
}

async fn at_every_phase(hold: bool) {
    let mut rig = Rig::new(regrind_testcell::rig::small(12, 8, 5000.0)).await;
    let (folder, broken) = (Arc::default(), Arc::default());
    watch_the_disk(&rig, &folder, &broken);
    for moment in &MOMENTS {
        let from = [CMM, GRINDER].map(|machine| seen_so_far(&rig, machine));
        let ready = rig.next(moment.loaded);
        folder.lock().unwrap().clone_from(&ready.folder);
        let (tried, folder) = attempt_with(&rig, ready, moment, hold).await;
        println!("{:22} {tried:?}", moment.name);
        assert!(tried.after_abort.is_empty(), "{}: after an abort nothing but the safe sequence", moment.name);
        for machine in [CMM, GRINDER] {
            let (frames, intents) = (frames(&rig, machine, from[machine]), intents(&folder, machine));
            compare(&format!("{}, {}", moment.name, DEVICES[machine]), &frames, &intents);
        }
        let verified = verify(&folder).unwrap();
        assert!(verified.records > 0);
        assert_eq!(*broken.lock().unwrap(), Vec::<String>::new(), "{}", moment.name);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn hold_and_resume_at_every_phase() {
    at_every_phase(true).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn abort_at_every_phase() {
    at_every_phase(false).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn abort_while_journal_is_locked() {
    let mut rig = Rig::new(regrind_testcell::rig::small(12, 8, 100.0)).await;
    let Ready { run, cmm, grinder, mut notices, folder } = rig.next(true);
    let (drive, _orders) = Drive::new(run, cmm, grinder).unwrap();
    let running = tokio::spawn(drive.run());
    event(&mut notices, "started", 1).await;

    let other = rusqlite::Connection::open(folder.join("journal.sqlite")).unwrap();
    other.busy_timeout(regrind_testcell::rig::PATIENCE).unwrap();
    other.execute_batch("BEGIN IMMEDIATE").unwrap();
    let since = std::time::Instant::now();
    let ordered = tokio::spawn({
        let folder = folder.clone();
        async move { order(&folder, Request::Abort { reason: "smoke".into() }).await.0 }
    });
    let aborted = async {
        while [CMM, GRINDER].iter().any(|machine| rig.command_at(*machine, 7, since).is_none()) {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(regrind_testcell::rig::PATIENCE, aborted).await.expect("both machines hear of the abort");
    let on_record = |folder: &Path| records(folder, RecordKind::Event).iter().any(|event| event["event"] == "abort");
    assert!(!on_record(&folder), "the journal cannot have it yet");

    other.execute_batch("ROLLBACK").unwrap();
    drop(other);
    // A person who had to wait too long learns that the order is not on record. No person learns that it is on record
    // before it is.
    let reply = ordered.await.unwrap();
    assert!(if reply.accepted { on_record(&folder) } else { reply.message.contains("not recorded") }, "{reply:?}");
    let ending = tokio::time::timeout(regrind_testcell::rig::PATIENCE, running).await.expect("it ends").unwrap();
    assert!(matches!(ending, Ending::Aborted { confirmed: true, .. }), "{ending:?}");
    assert!(on_record(&folder) && verify(&folder).unwrap().closed);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn abort_ends_run_with_broken_journal() {
    let mut rig = Rig::new(regrind_testcell::rig::small(12, 8, 100.0)).await;
    let Ready { run, cmm, grinder, mut notices, folder } = rig.next(true);
    let actor = run.actor.clone();
    let (drive, orders): (_, OrderSender) = Drive::new(run, cmm, grinder).unwrap();
    let running = tokio::spawn(drive.run());
    event(&mut notices, "started", 1).await;
    let damage = "PRAGMA writable_schema = ON; UPDATE sqlite_schema SET sql = 'no table at all';
        PRAGMA schema_version = 1000";
    rusqlite::Connection::open(folder.join("journal.sqlite")).unwrap().execute_batch(damage).unwrap();
    // Progress is recorded, so the loop detects the failure by itself. It reports the failure once, and not again for
    // each further record.
    event(&mut notices, "record_failed", 1).await;
    orders.send(Request::Abort { reason: "the record is gone".into() }, actor).await;
    let ending = tokio::time::timeout(regrind_testcell::rig::PATIENCE, running).await.expect("it ends").unwrap();
    assert!(matches!(ending, Ending::Aborted { confirmed: true, .. }), "{ending:?}");
    let mut told = 0;
    while let Some(notice) = notices.recv().await {
        told += u32::from(matches!(&notice, regrind::drive::Notice::State { event, .. } if event == "record_failed"));
    }
    assert!(told <= 1, "the same failure was told {told} times more");
}

/// Collects every file of a folder and its subfolders, by its path relative to the first folder.
fn files_below(folder: &Path, name: &str, files: &mut BTreeSet<String>) {
    for entry in std::fs::read_dir(folder.join(name)).unwrap().map(Result::unwrap) {
        let below = Path::new(name).join(entry.file_name()).to_str().unwrap().to_owned();
        if entry.path().is_dir() {
            files_below(folder, &below, files);
        } else {
            files.insert(below);
        }
    }
}

/// Checks that every file of a finished run is on record except the journal's own, and that at least these files exist.
fn all_on_record(folder: &Path, least: &[&str]) {
    let mut files = BTreeSet::new();
    files_below(folder, "", &mut files);
    files.retain(|name| !["journal.sqlite", "journal.anchor", ".lock"].contains(&name.as_str()));
    let names = records(folder, RecordKind::Artefact).into_iter().map(|file| file["name"].as_str().unwrap().to_owned());
    let recorded: BTreeSet<String> = names.collect();
    let unrecorded: Vec<_> = files.difference(&recorded).collect();
    assert!(unrecorded.is_empty(), "files that are not on record: {unrecorded:?}");
    for name in least {
        assert!(recorded.contains(*name), "{name} is not among {recorded:?}");
    }
    verify(folder).unwrap();
}

/// Runs a cell that a person stops where it holds.
async fn run_to_its_end(ready: Ready) -> (Ending, PathBuf) {
    let Ready { run, cmm, grinder, mut notices, folder } = ready;
    let actor = run.actor.clone();
    let (drive, orders): (_, OrderSender) = Drive::new(run, cmm, grinder).unwrap();
    let running = tokio::spawn(drive.run());
    while let Some(notice) = notices.recv().await {
        if matches!(&notice, regrind::drive::Notice::State { state, .. } if state.starts_with("Held")) {
            orders.send(Request::Stop { reason: "seen enough".into() }, actor.clone()).await;
        }
    }
    (tokio::time::timeout(regrind_testcell::rig::PATIENCE, running).await.expect("it ends").unwrap(), folder)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unsaved_result_is_recomputed() {
    let mut rig = Rig::new(regrind_testcell::rig::small(12, 8, 5000.0)).await;
    let Ready { run, cmm, grinder, mut notices, folder } = rig.next(true);
    // A folder is in the place of the deviations file of the first cycle.
    std::fs::create_dir_all(folder.join("cycle-1/deviations.csv")).unwrap();
    let actor = run.actor.clone();
    let (drive, orders): (_, OrderSender) = Drive::new(run, cmm, grinder).unwrap();
    let running = tokio::spawn(drive.run());
    event(&mut notices, "not_saved", 1).await;
    orders.send(Request::Resume { reason: "the disk is well again".into(), state_number: None }, actor).await;
    let ending = tokio::time::timeout(regrind_testcell::rig::PATIENCE, running).await.expect("it ends").unwrap();
    assert!(matches!(ending, Ending::Accepted { .. } | Ending::NotAccepted { .. }), "{ending:?}");
    assert!(folder.join("cycle-1/attempt-2/deviations.csv").is_file());
    let raised = records(&folder, RecordKind::Note).into_iter().filter(|note| note["command"] == "raise");
    let alarms: Vec<_> = raised.map(|note| note["id"].clone()).collect();
    assert_eq!(alarms.first(), Some(&Value::from("journal_unwritable")), "{alarms:?}");
    // The report describes the failure, and that the resumption took it back.
    regrind::report::write_run_report(&folder, &regrind::report::ReportOptions::default()).unwrap();
    let alarms = crate::reports::Page::read(&folder).rows("alarms");
    assert!(alarms[1][0].starts_with(AlarmId::JournalUnwritable.head()), "{alarms:?}");
    assert!(alarms[0][1].ends_with("UTC"), "{alarms:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn amended_verdict_leaves_first_file() {
    let mut rig = Rig::new(regrind_testcell::rig::small(12, 8, 5000.0)).await;
    let mut ready = rig.next(true);
    // Another pass is needed, and then the remaining material is not enough.
    ready.run.task.correction_limits.removal_budget_mm = 1e-6;
    let (ending, folder) = run_to_its_end(ready).await;
    assert!(matches!(ending, Ending::NotAccepted { .. }), "{ending:?}");
    all_on_record(&folder, &["result.json", "cycle-1/result.json", "cycle-1/attempt-2/result.json"]);
    let announced = records(&folder, RecordKind::Note).into_iter().filter(|note| note["command"] == "announce");
    let verdicts: Vec<_> = announced.map(|note| note["verdict"].clone()).collect();
    assert_eq!(verdicts, ["continue", "budget_spent"]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_run_file_is_on_record() {
    let mut rig = Rig::new(regrind_testcell::rig::small(12, 8, 5000.0)).await;
    let ready = rig.next(true);
    let (ending, folder) = run_to_its_end(ready).await;
    assert!(matches!(ending, Ending::Accepted { .. } | Ending::NotAccepted { .. }), "{ending:?}");
    all_on_record(&folder, &["result.json", "learned.json", "cycle-1/error_map.csv", "cycle-1/toolpath.ngc"]);

    // Points that are too far apart for the filter give no map.
    let mut ready = rig.next(true);
    ready.run.task.map_options.cutoff_mm = 0.5;
    let (_, folder) = run_to_its_end(ready).await;
    assert!(!folder.join("cycle-1/error_map.csv").exists());
    all_on_record(&folder, &["result.json", "cycle-1/measured.csv", "cycle-1/figures.json", "cycle-1/parameters.json"]);

    for name in ["measure, collect", "register", "judge and compensate", "grind again"] {
        let moment = MOMENTS.iter().find(|moment| moment.name == name).unwrap();
        let (_, folder) = attempt(&mut rig, moment, false).await;
        all_on_record(&folder, &["result.json"]);
    }
}
