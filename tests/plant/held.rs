//! Run that is held while a test examines it, and runs that have ended.

use std::path::{Path, PathBuf};

use regrind::journal::Reader;
use serde_json::Value;

use crate::only_run;
use crate::program::{Running, regrind, run, small_recipe};

/// Starts a run of the small recipe, with machines of this speed, and holds it after its first cycle. Returns the
/// process, its folder, and its state.
pub fn held_run(home: &Path, speed: f64) -> (Running, PathBuf, Value) {
    let recipe = small_recipe(home, speed).display().to_string();
    let mut running = Running::new(regrind(&["run", &recipe, "--cell", "sim", "--part", "SN-0042"], home));
    let folder = running.folder(home);
    let name = folder.display().to_string();
    until(&mut running, &name, home, |now| now["cycles"].as_array().is_some_and(|cycles| !cycles.is_empty()));
    let (code, out, errors) = run(&["hold", &name, "--reason", "looked at"], home);
    assert_eq!(code, 0, "{out}{errors}");
    let held = until(&mut running, &name, home, |now| now["state"] == "Held");
    (running, folder, held)
}

/// Makes a whole run below `home`, which ends as `how` says: accepted, stopped or aborted. Returns its name.
pub fn ended_run(home: &Path, how: &str) -> String {
    if how == "accepted" {
        let recipe = small_recipe(home, 1000.0).display().to_string();
        let (code, out, errors) = run(&["run", &recipe, "--cell", "sim", "--part", "SN-0042"], home);
        assert_eq!(code, 0, "{out}{errors}");
        return only_run(&home.join("runs")).1;
    }
    let (mut running, folder, _) = held_run(home, 200.0);
    let order = if how == "stopped" { "stop" } else { "abort" };
    let (code, out, errors) = run(&[order, &folder.display().to_string(), "--reason", "seen"], home);
    assert_eq!(code, 0, "{out}{errors}");
    running.end();
    folder.file_name().unwrap().to_str().unwrap().to_owned()
}

/// Moves the run with this name from the runs below one folder to the runs below another, at once: nobody there has seen
/// it alive.
pub fn move_run(from: &Path, name: &str, to: &Path) {
    std::fs::create_dir_all(to.join("runs")).unwrap();
    std::fs::rename(from.join("runs").join(name), to.join("runs").join(name)).unwrap();
}

/// Waits until a refusal of somebody is on record; returns the station of that record.
pub fn until_recorded(running: &mut Running, folder: &Path, refused: &str) -> String {
    running.until(refused, |_| {
        let reader = Reader::open(folder).unwrap();
        let mut records = reader.records(1).map(Result::unwrap);
        records
            .find(|record| record.payload.contains("remark") && record.payload.contains(refused))
            .map(|record| record.station)
    })
}

/// Waits until the state of a run satisfies a condition.
fn until(running: &mut Running, name: &str, home: &Path, is_so: impl Fn(&Value) -> bool) -> Value {
    running.until("a state", |_| {
        let (code, out, _) = run(&["status", name, "--json"], home);
        let status = (code == 0).then(|| serde_json::from_str::<Value>(&out).unwrap()["status"].take())?;
        is_so(&status).then_some(status)
    })
}
