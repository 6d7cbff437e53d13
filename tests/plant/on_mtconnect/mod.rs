//! Live values of a cell at an agent of MTConnect, as an independent reader of SHDR sees them.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::held::{held_run, until_recorded};
use crate::peers::Peer;
use crate::program::{Running, regrind, run};

fn write_plant(home: &Path, listen: &str) {
    let text = format!("[plant]\ncell = \"cell-1\"\n\n[mtconnect]\nlisten = \"{listen}\"\n");
    fs::write(home.join("plant.toml"), text).unwrap();
}

/// Starts the adapter at a free port, and an agent that reads its devices file. Returns both.
fn connected(home: &Path) -> (Running, Peer) {
    write_plant(home, "127.0.0.1:0");
    let (code, out, errors) = run(&["tell", "--plant", "plant.toml", "--devices", "Devices.xml"], home);
    assert_eq!(code, 0, "{out}{errors}");
    let mut teller = Running::new(regrind(&["tell", "--plant", "plant.toml", "--json"], home));
    let line = teller.line("an address", |line| line.contains("shdr://"));
    let line: Value = serde_json::from_str(&line).unwrap();
    let port = line["tells"].as_str().unwrap().trim_start_matches("shdr://127.0.0.1:").trim_end_matches('/');
    let agent = Peer::start("mtconnect_agent.py", &[port, "Devices.xml"], home);
    (teller, agent)
}

/// Returns the last value of each data item.
fn values(said: &[Value]) -> serde_json::Map<String, Value> {
    said.iter().filter_map(|line| Some((line["key"].as_str()?.to_owned(), line["value"].clone()))).collect()
}

/// Waits until a data item has a value; returns all values at that moment.
fn until_value(agent: &mut Peer, name: &str, wanted: &str) -> serde_json::Map<String, Value> {
    agent.until(0, &format!("{name} = {wanted}"), |said| {
        let told = (0..said.len()).find(|last| said[*last]["key"] == name && said[*last]["value"] == wanted);
        told.map(|last| {
            // All that changed at this time belongs to it.
            let time = &said[last]["time"];
            let end = said.iter().rposition(|line| &line["time"] == time).unwrap();
            values(&said[..=end])
        })
    })
}

fn no_fault(agent: &mut Peer) {
    let faults: Vec<_> = agent.said().into_iter().filter(|line| !line["fault"].is_null()).collect();
    assert!(faults.is_empty(), "{faults:#?}");
}

#[test]
#[ignore = "needs Python with venv, and pymtconnect: see REGRIND_PYTHON"]
fn mtconnect_values_of_a_run() {
    let home = TempDir::new().unwrap();
    let (mut teller, mut agent) = connected(home.path());
    let idle = until_value(&mut agent, "message", "no run is on");
    let items = agent.until(0, "the data items", |said| said.iter().find_map(|line| line["items"].as_array().cloned()));
    assert!(items.iter().all(|name| idle.contains_key(name.as_str().unwrap())), "{items:?}: {idle:?}");
    for (name, wanted) in [
        ("availability", "AVAILABLE"),
        ("execution", "READY"),
        ("alarms", "NORMAL"),
        ("form_pv", "UNAVAILABLE"),
        ("run", "UNAVAILABLE"),
        ("functional_mode", "UNAVAILABLE"),
    ] {
        assert_eq!(idle[name], wanted, "{name}");
    }

    agent.does(&json!({ "send": "* PING\n" }));
    agent.until(0, "a sign of life", |said| said.iter().any(|line| line["command"] == "* PONG 10000").then_some(()));

    let (mut running, folder, held) = held_run(home.path(), 200.0);
    let values = until_value(&mut agent, "execution", "INTERRUPTED");
    let row = &held["cycles"][0];
    let mm = |judged: &str, all: &str| {
        let um = if row[judged].is_null() { &row[all] } else { &row[judged] };
        1e-3 * um.as_f64().unwrap()
    };
    for (name, wanted) in [
        ("run", folder.file_name().unwrap().to_str().unwrap()),
        ("part", held["part"].as_str().unwrap()),
        ("serial", "SN-0042"),
        ("functional_mode", "PROCESS_DEVELOPMENT"),
        ("dry_run", "ON"),
        ("process_state", "INTERRUPTED"),
        ("part_status", "UNAVAILABLE"),
    ] {
        assert_eq!(values[name], wanted, "{name}");
    }
    for (name, wanted) in [("form_pv", mm("judged_pv_um", "pv_um")), ("form_rms", mm("judged_rms_um", "rms_um"))] {
        let found: f64 = values[name].as_str().unwrap().parse().unwrap();
        assert!((found - wanted).abs() <= 1e-6, "{name}: {found} of {wanted} mm");
    }

    // An agent has nothing to say here.
    agent.does(&json!({ "send": "* HOLD now\n" }));
    let station = until_recorded(&mut running, &folder, "SHDR: * HOLD now");
    assert!(station.contains("agent 127.0.0.1"), "{station}");

    let (code, out, errors) = run(&["resume", &folder.display().to_string()], home.path());
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(running.end().0, 0);
    let end = until_value(&mut agent, "execution", "PROGRAM_COMPLETED");
    assert_eq!((&end["part_status"], &end["process_state"]), (&json!("PASS"), &json!("COMPLETE")));
    until_value(&mut agent, "run", "UNAVAILABLE");
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    agent.until(0, "the end", |said| said.iter().any(|line| line["closed"] == true).then_some(()));
    no_fault(&mut agent);
}

#[test]
fn mtconnect_listens_on_this_computer_only() {
    let home = TempDir::new().unwrap();
    write_plant(home.path(), "0.0.0.0:7878");
    let (code, _, errors) = run(&["tell", "--plant", "plant.toml"], home.path());
    assert!(code == 2 && errors.contains("0.0.0.0:7878") && errors.contains("ssh -L"), "{code} {errors}");
}
