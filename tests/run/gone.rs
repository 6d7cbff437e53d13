//! Files of a run that somebody moves away while it is active: nothing starts without its record, and nothing is lost
//! if they come back.

use std::fs;
use std::path::Path;

use crate::program::{Running, records_with, regrind, root, run, small_recipe};

/// Starts a run that grinds, and returns it with its folder.
fn grinding(home: &Path) -> (Running, std::path::PathBuf) {
    let recipe = small_recipe(home, 400.0).display().to_string();
    let cell = root().join("config/sim.toml").display().to_string();
    let mut running = Running::new(regrind(&["run", &recipe, "--cell", &cell, "--part", "SN-1"], home));
    let folder = running.folder(home);
    running.line("grinding", |line| line.contains("grinding"));
    (running, folder)
}

/// Returns true for the line of the alarm that a file of the record is gone.
fn is_alarm_of_lost_journal(line: &str) -> bool {
    ["ALARM", "journal.sqlite", "deleted"].iter().all(|piece| line.contains(piece))
}

#[test]
fn moved_journal_holds_cell_until_back() {
    for name in ["journal.sqlite", "journal.sqlite-wal"] {
        let home = tempfile::tempdir().unwrap();
        let (mut running, folder) = grinding(home.path());
        let (there, away) = (folder.join(name), home.path().join("away"));
        fs::rename(&there, &away).unwrap();
        // Another file of that name is not the record.
        fs::write(&there, "").unwrap();
        running.line("the alarm", is_alarm_of_lost_journal);
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
        assert_eq!(code, 0, "{name}: {errors}{:?}", running.output_lines);
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
fn deleted_journal_starts_no_pass() {
    let home = tempfile::tempdir().unwrap();
    let (mut running, folder) = grinding(home.path());
    for name in ["journal.sqlite", "journal.sqlite-wal", "journal.sqlite-shm"] {
        fs::remove_file(folder.join(name)).unwrap();
    }
    running.line("the alarm", is_alarm_of_lost_journal);
    let path = folder.display().to_string();
    running.until("a held cell", |_| run(&["status", &path], home.path()).1.contains("Held").then_some(()));
    // The safety order is carried out, and the person learns that it is not on record.
    let (code, _, told) = run(&["abort", &path], home.path());
    assert!(code == 3 && told.contains("not recorded"), "{told}");
    let (code, errors) = running.end();
    assert!(code != 0, "{errors}");
    let said = running.output_lines.join("\n");
    assert!(!said.contains("ACCEPTED") && !said.contains("cycle 1: PV"), "{said}");
}

#[cfg(unix)]
#[test]
fn deleted_control_socket_is_recreated() {
    let home = tempfile::tempdir().unwrap();
    let (mut running, folder) = grinding(home.path());
    let (socket, path) = (folder.join("control.sock"), folder.display().to_string());
    fs::remove_file(&socket).unwrap();
    // While the folder has no socket, the order goes through the socket next to the lock of the machines.
    let (code, told, errors) = run(&["hold", &path, "--reason", "the socket is gone"], home.path());
    assert_eq!(code, 0, "{told}{errors}");
    let alarms = || {
        let commands = records_with(&folder, "command").into_iter().filter(|command| command["command"] == "raise");
        commands.filter(|alarm| alarm["id"] == "control_lost").count()
    };
    running.until("the alarm", |_| (alarms() == 1).then_some(()));
    running.until("a socket that is made again", |_| socket.exists().then_some(()));
    // Another file in place of the socket is not a socket, and is left alone.
    fs::remove_file(&socket).unwrap();
    fs::write(&socket, "mine").unwrap();
    running.until("another alarm", |_| (alarms() == 2).then_some(()));
    assert_eq!(fs::read_to_string(&socket).unwrap(), "mine");
    let (code, told, errors) = run(&["resume", &path], home.path());
    assert_eq!(code, 0, "{told}{errors}");
    let (code, errors) = running.end();
    assert_eq!(code, 0, "{errors}{:?}", running.output_lines);
    let orders = records_with(&folder, "event").into_iter().filter(|event| event["event"] == "hold");
    assert_eq!(orders.map(|hold| hold["reason"].clone()).collect::<Vec<_>>(), ["the socket is gone"]);
}

#[cfg(unix)]
#[test]
fn moved_runs_folder_accepts_abort() {
    let home = tempfile::tempdir().unwrap();
    let (mut running, folder) = grinding(home.path());
    fs::rename(home.path().join("runs"), home.path().join("moved")).unwrap();
    // The run is found by its machines, without its name. The abort is carried out, and the person learns that it is
    // not on record.
    let (code, told, errors) = run(&["abort"], home.path());
    assert!(code == 3 && errors.contains("not recorded"), "{code} {told}{errors}");
    let (code, errors) = running.end();
    assert!(code != 0 && !running.output_lines.join("\n").contains("ACCEPTED"), "{errors}");
    let (code, told, errors) = run(&["status", &folder.display().to_string()], home.path());
    assert_eq!(code, 2, "{told}{errors}");
}

#[cfg(unix)]
#[test]
fn orders_to_suspended_process_expire() {
    let home = tempfile::tempdir().unwrap();
    let (mut running, folder) = grinding(home.path());
    let path = folder.display().to_string();
    running.signal("STOP");
    let (code, told, errors) = run(&["hold", &path, "--reason", "nobody hears this"], home.path());
    running.signal("CONT");
    assert!(code == 3 && errors.contains("did not answer"), "{code} {told}{errors}");
    assert_eq!(run(&["stop", &path], home.path()).0, 0);
    running.end();
    let events = records_with(&folder, "event");
    assert!(!events.iter().any(|event| event["event"] == "hold"), "{events:?}");
    assert!(events.iter().any(|event| event["event"] == "stop"));
}
