//! Files of a run that somebody moves away while it is on: nothing is started without its record, and nothing is lost where they come back.

use std::fs;
use std::path::Path;

use crate::program::{Running, records_with, regrind, root, run, small_recipe};

/// A run that grinds, and its folder.
fn grinding(home: &Path) -> (Running, std::path::PathBuf) {
    let recipe = small_recipe(home, 400.0).display().to_string();
    let cell = root().join("config/sim.toml").display().to_string();
    let mut running = Running::new(regrind(&["run", &recipe, "--cell", &cell, "--part", "SN-1"], home));
    let folder = running.folder(home);
    running.line("grinding", |line| line.contains("grinding"));
    (running, folder)
}

#[test]
fn a_record_that_is_moved_away_holds_what_moves_and_is_gone_on_with_when_it_is_back() {
    for name in ["journal.sqlite", "journal.sqlite-wal"] {
        let home = tempfile::tempdir().unwrap();
        let (mut running, folder) = grinding(home.path());
        let (there, away) = (folder.join(name), home.path().join("away"));
        fs::rename(&there, &away).unwrap();
        // Another file of that name is not the record.
        fs::write(&there, "").unwrap();
        running.line("the alarm", |line| line.contains("was deleted, renamed or exchanged"));
        let path = folder.display().to_string();
        let state = || run(&["status", &path], home.path()).1;
        let held = "SIMULATION  Held";
        running.until("a held cell", |_| state().starts_with(held).then_some(()));
        fs::rename(&away, &there).unwrap();
        running.until("a record that is written again", |_| {
            let is_held = state().starts_with(held);
            is_held.then(|| run(&["resume", &path], home.path()));
            (!is_held).then_some(())
        });
        let (code, errors) = running.end();
        assert_eq!(code, 0, "{name}: {errors}{:?}", running.said);
        let starts = records_with(&folder, "intent").into_iter().filter(|intent| intent["command"] == "start_machine");
        let passes: Vec<_> =
            starts.filter(|start| start["device"] == "grinder").map(|start| start["cycle"].clone()).collect();
        let mut once = passes.clone();
        once.dedup();
        assert!(!passes.is_empty() && passes == once, "{name}: {passes:?}");
        assert_eq!(run(&["audit", "verify", &path], home.path()).0, 0, "{name}");
    }
}

#[test]
fn a_record_that_is_deleted_ends_with_the_run_and_no_further_pass_is_started() {
    let home = tempfile::tempdir().unwrap();
    let (mut running, folder) = grinding(home.path());
    for name in ["journal.sqlite", "journal.sqlite-wal", "journal.sqlite-shm"] {
        fs::remove_file(folder.join(name)).unwrap();
    }
    running.line("the alarm", |line| line.contains("was deleted, renamed or exchanged"));
    let path = folder.display().to_string();
    running.until("a held cell", |_| run(&["status", &path], home.path()).1.contains("Held").then_some(()));
    // The order that makes safe is carried out, and the person is told that it is not on record.
    let (code, _, told) = run(&["abort", &path], home.path());
    assert!(code == 3 && told.contains("not on record"), "{told}");
    let (code, errors) = running.end();
    assert!(code != 0, "{errors}");
    let said = running.said.join("\n");
    assert!(!said.contains("ACCEPTED") && !said.contains("cycle 1: PV"), "{said}");
}
