//! Live values of a cell by OPC UA, as an independent client sees them.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::held::{held_run, until_recorded};
use crate::peers::Peer;
use crate::program::{Running, regrind, run};

/// Values that the client polls all the time.
const LOOKED_AT: [&str; 3] = ["Status/StateCurrent", "Message", "Figures/PV"];

fn home() -> TempDir {
    let home = TempDir::new().unwrap();
    let text = "[plant]\ncell = \"cell-1\"\n\n[opcua]\nlisten = \"127.0.0.1:0\"\n";
    fs::write(home.path().join("plant.toml"), text).unwrap();
    home
}

/// Starts publishing; returns the address.
fn start_publishing(home: &Path) -> (Running, String) {
    let mut teller = Running::new(regrind(&["tell", "--plant", "plant.toml", "--json"], home));
    let line = teller.line("address", |line| line.contains("\"tells\""));
    let said: Value = serde_json::from_str(&line).unwrap();
    (teller, said["tells"].as_str().unwrap().to_owned())
}

fn client(home: &Path, url: &str) -> Peer {
    let mut client = Peer::start("opcua_client.py", &[url], home);
    answer(&mut client, 0, "connected");
    client
}

/// Waits for an answer of a kind after a position.
fn answer(client: &mut Peer, from: usize, kind: &str) -> Value {
    client.until(from, kind, |said| {
        let ended = said.iter().find(|line| !line["ended"].is_null());
        assert!(ended.is_none(), "{ended:?}");
        said.iter().find(|line| !line[kind].is_null()).cloned()
    })
}

fn asked(client: &mut Peer, what: &Value, kind: &str) -> Value {
    let from = client.place();
    client.does(what);
    answer(client, from, kind)
}

fn read(client: &mut Peer, names: &[&str]) -> Value {
    asked(client, &json!({ "read": names }), "read")["read"].take()
}

fn until_changed(client: &mut Peer, name: &str, wanted: &Value) {
    client.until(0, &format!("{name} = {wanted}"), |said| {
        said.iter().any(|line| line["changed"] == name && line["value"] == *wanted).then_some(())
    });
}

fn events(client: &mut Peer, what: &str, is_it: impl Fn(&Value) -> bool) -> Vec<Value> {
    client.until(0, what, |said| {
        let found: Vec<_> =
            said.iter().filter(|line| is_it(&line["event"])).map(|line| line["event"].clone()).collect();
        (!found.is_empty()).then_some(found)
    })
}

#[test]
#[ignore = "needs Python with venv, and asyncua: see REGRIND_PYTHON"]
fn opcua_values_and_refused_writes() {
    let home = home();
    let (mut teller, url) = start_publishing(home.path());
    let mut client = client(home.path(), &url);

    let browsed = asked(&mut client, &json!({ "browse": true }), "browse");
    let all = browsed["browse"].as_array().unwrap();
    let packml = browsed["packml"].as_u64().unwrap();
    for (path, kind) in [
        ("", 6),
        ("/Status", 4),
        ("/Admin", 5),
        ("/BaseStateMachine", 3),
        ("/BaseStateMachine/MachineState", 2),
        ("/BaseStateMachine/MachineState/ExecuteState", 1),
    ] {
        let node = all.iter().find(|node| node["path"] == format!("/cell-1{path}")).expect(path);
        assert_eq!(node["definition"], format!("ns={packml};i={kind}"), "{path}");
    }
    assert!(all.iter().all(|node| node["class"] != "Method"), "there is nothing to call");
    for node in all.iter().filter(|node| node["class"] == "Variable") {
        assert_eq!(
            (&node["access"], &node["user_access"]),
            (&json!(["CurrentRead"]), &json!(["CurrentRead"])),
            "{node}"
        );
    }

    let values = read(
        &mut client,
        &["Status/StateCurrent", "Message", "Figures/PV", "Figures/PV/EngineeringUnits", "Status/MachSpeed"],
    );
    assert_eq!(
        (&values["Status/StateCurrent"]["value"], &values["Status/StateCurrent"]["type"]),
        (&json!(4), &json!("UInt32"))
    );
    assert_eq!(values["Message"]["value"], "no run is on");
    for nobody_knows in ["Figures/PV", "Status/MachSpeed"] {
        assert_eq!(
            (&values[nobody_knows]["value"], &values[nobody_knows]["status"]),
            (&Value::Null, &json!("BadNoData"))
        );
    }
    assert_eq!(values["Figures/PV/EngineeringUnits"]["value"], json!({ "unit": "um", "id": 13384 }));
    asked(&mut client, &json!({ "subscribe": LOOKED_AT, "events": "Cell" }), "subscribed");

    let (mut running, folder, held) = held_run(home.path(), 200.0);
    let run_name = folder.file_name().unwrap().to_str().unwrap().to_owned();
    until_changed(&mut client, "Status/StateCurrent", &json!(11));
    let row = &held["cycles"][0];
    let judged = |judged: &str, all: &str| if row[judged].is_null() { row[all].clone() } else { row[judged].clone() };
    let [pv, rms] = [judged("judged_pv_um", "pv_um"), judged("judged_rms_um", "rms_um")];
    until_changed(&mut client, "Figures/PV", &pv);
    let machine = "BaseStateMachine/CurrentState";
    let (middle, inner) =
        ("BaseStateMachine/MachineState/CurrentState", "BaseStateMachine/MachineState/ExecuteState/CurrentState");
    let (id, number) = (format!("{inner}/Id"), format!("{inner}/Number"));
    let names = [
        "Status/StateName",
        "Status/UnitModeCurrent",
        "Simulation",
        "Run",
        "Serial",
        "Message",
        "Figures/Cycle",
        "Figures/RMS",
        "Limits/PV",
        "Alarms/Count",
        machine,
        middle,
        inner,
        &*id,
        &*number,
    ];
    let values = read(&mut client, &names);
    for (name, wanted) in [
        ("Status/StateName", json!("Held")),
        ("Status/UnitModeCurrent", json!(16)),
        ("Simulation", json!(true)),
        ("Run", json!(run_name)),
        ("Serial", json!("SN-0042")),
        ("Message", held["words"].clone()),
        ("Figures/Cycle", json!(1)),
        ("Figures/RMS", rms.clone()),
        ("Limits/PV", json!(7.0)),
        ("Alarms/Count", json!(held["alarms"].as_array().map_or(0, Vec::len))),
        (machine, json!("Cleared")),
        (middle, json!("Running")),
        (inner, json!("Held")),
        (&*id, json!(format!("ns={packml};i=34"))),
        (&*number, json!(11)),
    ] {
        assert_eq!((&values[name]["value"], &values[name]["status"]), (&wanted, &json!("Good")), "{name}");
    }
    let results = events(&mut client, "result of cycle 1", |event| event["Cycle"] == 1);
    assert_eq!(results.len(), 1, "{results:?}");
    for (field, wanted) in [
        ("Run", json!(run_name)),
        ("Serial", json!("SN-0042")),
        ("PV", pv),
        ("RMS", rms),
        ("PVLimit", json!(7.0)),
        ("Simulation", json!(true)),
        ("SourceName", json!("cell-1")),
    ] {
        assert_eq!(results[0][field], wanted, "{field}");
    }

    for (name, kind, value) in [
        ("Status/StateCurrent", "UInt32", json!(2)),
        ("Figures/PV", "Double", json!(0.1)),
        ("Message", "String", json!("all is well")),
    ] {
        let told = asked(&mut client, &json!({ "write": name, "type": kind, "value": value }), "write");
        assert_eq!(told["result"], "BadNotWritable");
        let refused = format!("{name} = ");
        teller.line(&refused, |line| line.contains("\"refused\"") && line.contains(&refused));
        let station = until_recorded(&mut running, &folder, &refused);
        assert!(station.contains("urn:example.org:FreeOpcUa"), "{station}");
    }
    assert_ne!(asked(&mut client, &json!({ "call": "Start" }), "call")["result"], "Good");
    assert_eq!(read(&mut client, &["Status/StateCurrent"])["Status/StateCurrent"]["value"], 11);

    let (code, out, errors) = run(&["resume", &folder.display().to_string()], home.path());
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(running.end().0, 0);
    let summary = regrind::report::run_summary(&folder).unwrap();
    let ended = events(&mut client, "end of the run", |event| event["Verdict"] == json!(summary.verdict));
    assert_eq!((&ended[0]["Accepted"], &ended[0]["Run"]), (&json!(true), &json!(run_name)));
    until_changed(&mut client, "Message", &json!("no run is on"));
    let results = events(&mut client, "result of the last cycle", |event| event["Cycle"] == summary.cycles.len());
    assert_eq!(results[0]["PV"], read_pv(&summary), "{results:?}");
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    answer(&mut client, 0, "lost");
}

fn read_pv(summary: &regrind::report::RunSummary) -> Value {
    json!(summary.cycles.last().unwrap().figures.unwrap()[0][0])
}

#[test]
#[ignore = "needs Python with venv, and asyncua: see REGRIND_PYTHON"]
fn opcua_reconnects_after_server_kill() {
    let home = home();
    let (teller, url) = start_publishing(home.path());
    let mut first = client(home.path(), &url);
    teller.signal("KILL");
    answer(&mut first, 0, "lost");

    // At the same address, because the client reconnects to it.
    let address = url.trim_start_matches("opc.tcp://").trim_end_matches('/');
    let text = fs::read_to_string(home.path().join("plant.toml")).unwrap().replace("127.0.0.1:0", address);
    fs::write(home.path().join("plant.toml"), text).unwrap();
    let (running, folder, held) = held_run(home.path(), 200.0);
    let (mut teller, again) = start_publishing(home.path());
    assert_eq!(again, url);
    let mut second = client(home.path(), &url);
    asked(&mut second, &json!({ "subscribe": LOOKED_AT, "events": Value::Null }), "subscribed");
    until_changed(&mut second, "Status/StateCurrent", &json!(11));
    until_changed(&mut second, "Message", &held["words"]);

    running.signal("KILL");
    second.until(0, "that nobody knows the state", |said| {
        said.iter().any(|line| line["changed"] == "Status/StateCurrent" && line["status"] == "BadNoData").then_some(())
    });
    let values = read(&mut second, &["Message", "Run", "BaseStateMachine/CurrentState"]);
    let (message, run_name) = (values["Message"]["value"].as_str().unwrap(), folder.file_name().unwrap());
    let run_name = run_name.to_str().unwrap();
    assert!(message.contains(run_name) && message.contains("simulated machines"), "{values}");
    assert_eq!(values["Run"]["value"], run_name);
    assert_eq!(values["BaseStateMachine/CurrentState"]["status"], "BadNoData");
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
}

#[test]
fn opcua_refuses_public_address() {
    let home = home();
    let text = "[plant]\ncell = \"cell-1\"\n\n[opcua]\nlisten = \"0.0.0.0:4840\"\n";
    fs::write(home.path().join("plant.toml"), text).unwrap();
    let (code, out, errors) = run(&["tell", "--plant", "plant.toml"], home.path());
    assert_eq!(code, 2, "{out}{errors}");
    assert!(errors.contains("0.0.0.0:4840") && errors.contains("ssh -L 4840:127.0.0.1:4840"), "{errors}");
}
