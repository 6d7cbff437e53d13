//! A touch that no neighbour agrees with is repeated before any person is called, and the part is judged by the
//! repeated touch.

use std::fs;
use std::path::Path;

use crate::program::{Running, changed, records_with, regrind, replaced, run};
use regrind_testcell::outlived::{began_once, follow, on_serial_lines};
use serde_json::Value;

/// Number of good touches that are repeated as controls.
const CONTROLS: u64 = 6;

/// Returns the free-form recipe on its simulated cell, whose probe gives a false trigger now and then.
fn recipe(home: &Path, seed: u64, speed: f64) -> String {
    let text = changed(
        "recipes/freeform-mirror.toml",
        &[
            ("seed = 1\n", &format!("seed = {seed}\nspeed = {speed:.1}\n")),
            (
                "[simulation.part]\n",
                "[simulation.cmm]\noutlier_share = 0.002\noutlier_um = 60.0\n\n[simulation.part]\n",
            ),
        ],
    );
    let path = home.join("part.toml");
    fs::write(&path, text).unwrap();
    path.display().to_string()
}

fn registered(folder: &Path) -> Vec<Value> {
    records_with(folder, "figures").into_iter().filter(|event| event["event"] == "registered").collect()
}

/// Returns the rows of a file of points.
fn rows(path: &Path) -> Vec<String> {
    fs::read_to_string(path).unwrap().lines().filter(|line| !line.starts_with(['#', 'x'])).map(str::to_owned).collect()
}

#[test]
fn false_trigger_is_touched_again() {
    let home = tempfile::tempdir().unwrap();
    let recipe = recipe(home.path(), 1, 20_000.0);
    let mut running = Running::new(regrind(&["run", &recipe], home.path()));
    let folder = running.folder(home.path());
    let (code, said) = running.end();
    assert_eq!(code, 0, "{said}");

    let figures: Vec<Value> = registered(&folder).into_iter().map(|event| event["figures"].clone()).collect();
    let first = figures.iter().position(|of| of["touch_on"].is_object()).expect("a touch that stands alone");
    let [before, after] = [&figures[first], &figures[first + 1]];
    assert_eq!(before["left_out"]["again"], true);
    let targets = before["touch_on"]["targets"].as_u64().unwrap();
    let alone = before["outliers"].as_u64().unwrap();
    let around = targets - alone - CONTROLS;
    assert!(alone >= 1 && (1..=4 * alone).contains(&around), "{targets} targets for {alone} touches");
    assert!(after["outliers"].as_u64().unwrap() < alone, "{after}");
    assert_eq!(figures.len(), first + 2, "accepted at once");

    // Only those touches are replaced. The touches around them are appended after all others.
    let cycle = figures.len() - 1;
    let [whole, again] =
        ["", "/attempt-2"].map(|attempt| rows(&folder.join(format!("cycle-{cycle}{attempt}/measured.csv"))));
    let changed = whole.iter().zip(&again).filter(|(a, b)| a != b).count() as u64;
    assert_eq!((changed, again.len() as u64), (alone, whole.len() as u64 + around));
    let told: Value = serde_json::from_str(
        &fs::read_to_string(folder.join(format!("cycle-{cycle}/attempt-2/touched_again.json"))).unwrap(),
    )
    .unwrap();
    assert_eq!(told["rounds"], 1);
    assert_eq!(run(&["audit", "verify", &folder.display().to_string()], home.path()).0, 0);
}

#[test]
fn killed_during_retouch_resumes() {
    let home = tempfile::tempdir().unwrap();
    let few = [
        ("columns = 60", "columns = 20"),
        ("rows = 30", "rows = 15"),
        ("accuracy_nm = 0.5", "spacing_mm = 0.5"),
        ("cutoff_mm = 5.0", "cutoff_mm = 11.0"),
        ("outlier_share = 0.002", "outlier_share = 0.02"),
        // With so few touches, the form between them is poorly known.
        ("pv_um = 7.0", "pv_um = 10.0"),
    ];
    let text = fs::read_to_string(recipe(home.path(), 1, 2_000.0)).unwrap();
    let text = few.iter().fold(text, |text, (from, to)| replaced(&text, from, to));
    let _machines = on_serial_lines(regrind, home.path(), text);
    let begin = ["run", "part.toml", "--cell", "cell.toml", "--loaded"];
    let mut running = Running::new(regrind(&begin, home.path()));
    let folder = running.folder(home.path());
    running.until("a touch that stands alone", |_| {
        registered(&folder).iter().any(|event| event["figures"]["touch_on"].is_object()).then_some(())
    });
    running.signal("KILL");
    running.end();
    let mut resumed = Running::new(regrind(&["resume", &folder.display().to_string(), "--json"], home.path()));
    assert_eq!(follow(&mut resumed, &|| Some(folder.clone()), usize::MAX), Some(0), "{}", resumed.error_text);
    // Each job that started was commanded, and no job was commanded twice.
    let commands = records_with(&folder, "command");
    let starts = commands.iter().filter(|of| of["command"] == "start_machine").count();
    let (began, measured) = (began_once(home.path()), registered(&folder).len());
    assert!(began == starts && began > measured, "{began} of {starts} began, {measured} were measured");
}
