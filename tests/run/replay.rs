//! Replay of a run's record: without a difference from any point where the run broke off, and with the first difference
//! named if there is one.

use std::fs;
use std::path::{Path, PathBuf};

use regrind::cell::{CellPlan, HoldOrStop};
use regrind::drive::{Drive, InterruptedRun, OrderSender, ReplayError, Request, Task};
use regrind::journal::{Reader, verify};
use regrind::setup;
use regrind_testcell::rig::{PATIENCE, Ready, Rig, event, small, until};
use regrind_testutils::sample::cases;

/// Runs a part of three passes, with a hold during the run. Returns the rig and the folder of the run.
async fn finished() -> (Rig, PathBuf) {
    let mut rig = Rig::new(small(12, 8, 5000.0)).await;
    let Ready { mut run, cmm, grinder, mut notices, folder } = rig.next(true);
    never_content(&mut run.plan);
    let actor = run.actor.clone();
    let (drive, orders): (_, OrderSender) = Drive::new(run, cmm, grinder).unwrap();
    let running = tokio::spawn(drive.run());
    event(&mut notices, "registered", 1).await;
    orders.send(Request::Hold { reason: "tea".into(), state_number: None }, actor.clone()).await;
    until(&folder, |words| words.starts_with("Held")).await;
    orders.send(Request::Resume { reason: "tea is over".into(), state_number: None }, actor).await;
    tokio::time::timeout(PATIENCE, running).await.expect("it ends").unwrap();
    assert!(verify(&folder).unwrap().closed);
    crate::contents::assert_known(&folder);
    (rig, folder)
}

/// Changes the plan so that no result is accepted and nothing holds. The run then goes on to the last pass that the
/// plan allows.
fn never_content(plan: &mut CellPlan) {
    (plan.tolerance.pv_mm, plan.max_cycles, plan.stall_share) = (1e-6, 3, -1e9);
    (plan.on_stall, plan.on_divergence, plan.on_refusal) = (HoldOrStop::Stop, HoldOrStop::Stop, HoldOrStop::Stop);
}

/// Reads the record as the program that wrote it would.
fn again(
    rig: &Rig,
    folder: &Path,
    change: impl FnOnce(&mut Task, &mut CellPlan),
) -> Result<InterruptedRun, ReplayError> {
    let (mut task, mut plan) = setup::prepare(&rig.recipe, &rig.cell).unwrap();
    never_content(&mut plan);
    change(&mut task, &mut plan);
    InterruptedRun::read(folder, plan, &task)
}

/// Copies the record of a run up to a record, with all files: the state of the folder if the program ended after that
/// record.
fn broken_off(folder: &Path, at: u64) -> tempfile::TempDir {
    let copy = tempfile::tempdir().unwrap();
    copy_files(folder, copy.path());
    let database = rusqlite::Connection::open(copy.path().join("journal.sqlite")).unwrap();
    // The database guards records against change. To cut the copy, the guards must be removed.
    let guards: Vec<String> = database
        .prepare("SELECT name FROM sqlite_schema WHERE type = 'trigger'")
        .and_then(|mut names| names.query_map([], |row| row.get(0))?.collect())
        .unwrap();
    guards.iter().for_each(|name| database.execute_batch(&format!("DROP TRIGGER {name}")).unwrap());
    database.execute("DELETE FROM record WHERE seq > ?1", [at as i64]).unwrap();
    copy
}

fn copy_files(from: &Path, to: &Path) {
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let to = to.join(entry.file_name());
        let kind = entry.file_type().unwrap();
        if kind.is_dir() {
            fs::create_dir(&to).unwrap();
            copy_files(&entry.path(), &to);
        } else if kind.is_file() {
            fs::copy(entry.path(), to).unwrap();
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn replay_agrees_at_every_break() {
    let (rig, folder) = finished().await;
    let last = verify(&folder).unwrap().records;
    let whole = again(&rig, &folder, |_, _| ()).unwrap_or_else(|error| panic!("{error}"));
    assert!(whole.describe_state().starts_with("Stopped"), "{}", whole.describe_state());
    assert!(!folder.join("replay").exists(), "what was computed again is taken away");
    let mut states = std::collections::BTreeSet::new();
    for at in cases((1..last).step_by(7), 2).chain([last - 1]) {
        let copy = broken_off(&folder, at);
        let found =
            again(&rig, copy.path(), |_, _| ()).unwrap_or_else(|error| panic!("cut behind record {at}: {error}"));
        states.insert(found.describe_state());
    }
    assert!(states.len() > 15, "{states:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn replay_names_first_difference() {
    let (rig, folder) = finished().await;
    let said = |change: fn(&mut Task, &mut CellPlan)| {
        let error = again(&rig, &folder, change).err().expect("it differs");
        assert!(matches!(error, ReplayError::Differs { .. }), "{error}");
        error.to_string()
    };
    let decided = said(|_, plan| plan.max_cycles = 2);
    assert!(decided.contains("max_cycles") && decided.contains("the record has"), "{decided}");
    let computed = said(|task, _| task.map_options.cutoff_mm *= 1.01);
    assert!(computed.contains("repeated computation"), "{computed}");
    // No figure depends on this value. Only the plan that the machine received contains it.
    let planned = said(|task, _| task.probing.safe_height_mm += 1.0);
    assert!(planned.contains("the CMM was prepared"), "{planned}");
    for words in [decided, computed, planned] {
        assert!(words.contains("at record") && words.contains("regrind recover"), "{words}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn replay_detects_changed_event() {
    let (rig, folder) = finished().await;
    let reader = Reader::open(&folder).unwrap();
    let records: Vec<_> = reader.records(0).map(Result::unwrap).collect();
    let registered = records.iter().find(|r| r.value()["event"] == "registered").unwrap();
    let copy = broken_off(&folder, registered.seq);
    let changed = registered.payload.replacen("\"coverage\":", "\"coverage\":0.5,\"was\":", 1);
    assert_ne!(changed, registered.payload);
    let database = rusqlite::Connection::open(copy.path().join("journal.sqlite")).unwrap();
    database.execute("UPDATE record SET payload = ?1 WHERE seq = ?2", (changed, registered.seq as i64)).unwrap();
    drop(database);
    let error = again(&rig, copy.path(), |_, _| ()).err().expect("it differs").to_string();
    assert!(error.contains(&format!("at record {}", registered.seq)), "{error}");
}
