//! Live values of a cell by OPC UA, as an independent client sees them.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::held::{ended_run, held_run, move_run, until_recorded};
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

/// Asserts that each of the times `names` of `value` lies between `from` and `to`, all in seconds since 1970.
fn within(value: &Value, names: &[&str], from: &Value, to: &Value) {
    for name in names {
        let [time, from, to] = [&value[name], from, to].map(|time| time.as_f64().unwrap_or(f64::NAN));
        assert!(from <= time && time <= to, "{name}: {value} is not between {from} and {to}");
    }
}

#[test]
#[ignore = "needs Python with venv, and asyncua: see REGRIND_PYTHON"]
fn opcua_times_are_true() {
    const CURRENT_TIME: &str = "i=2258";
    const SERVER_STATUS: &str = "i=2256";
    let home = home();
    let (mut teller, url) = start_publishing(home.path());
    let mut client = client(home.path(), &url);
    let look = |client: &mut Peer, names: &[&str]| asked(client, &json!({ "read": names }), "read");

    // The clock of the server runs, and each time belongs to it.
    let start = look(&mut client, &["Message"]);
    for _ in 0..2 {
        let read = look(&mut client, &[CURRENT_TIME, SERVER_STATUS]);
        for name in [CURRENT_TIME, SERVER_STATUS] {
            within(&read["read"][name], &["value", "source", "server"], &read["before"], &read["after"]);
        }
    }
    let began = asked(&mut client, &json!({ "clock": true }), "clock")["began"].take();
    for name in ["CurrentTime", "ServerStatus"] {
        let times = client.until(0, &format!("three times of {name}"), |said| {
            let times: Vec<_> = said.iter().filter(|line| line["changed"] == name).cloned().collect();
            (times.len() >= 3).then_some(times)
        });
        for time in &times {
            within(time, &["value", "source", "server"], &began, &time["received"]);
        }
        assert!(times.is_sorted_by(|a, b| a["value"].as_f64() < b["value"].as_f64()), "{times:?}");
    }

    // A value that does not change keeps the time of its change, and the server knows it to hold later.
    let first = start["read"]["Message"].clone();
    within(&first, &["source", "server"], &json!(0), &start["after"]);
    loop {
        let later = look(&mut client, &["Message"])["read"]["Message"].take();
        assert_eq!((&later["value"], &later["source"]), (&first["value"], &first["source"]));
        assert!(later["server"].as_f64() >= first["server"].as_f64(), "{later} {first}");
        if later["server"].as_f64() > first["server"].as_f64() {
            break;
        }
    }
    // A fixed property too.
    let unit = look(&mut client, &["Figures/PV/EngineeringUnits"]);
    within(&unit["read"]["Figures/PV/EngineeringUnits"], &["source", "server"], &json!(1e9), &unit["after"]);

    // A change has the time at which it happened.
    asked(&mut client, &json!({ "subscribe": LOOKED_AT, "events": "Cell" }), "subscribed");
    let before = look(&mut client, &["Message"])["after"].take();
    let (mut running, folder, _) = held_run(home.path(), 200.0);
    let held = client.until(0, "that it is held", |said| {
        said.iter().find(|line| line["changed"] == "Status/StateCurrent" && line["value"] == 11).cloned()
    });
    within(&held, &["source", "server"], &before, &held["received"]);
    let from = client.place();
    let (code, out, errors) = run(&["stop", &folder.display().to_string(), "--reason", "seen"], home.path());
    assert_eq!(code, 0, "{out}{errors}");
    running.end();
    client.until(from, "that no run is on", |said| {
        said.iter().any(|line| line["changed"] == "Status/StateCurrent" && line["value"] == 4).then_some(())
    });
    let summary = regrind::report::run_summary(&folder).unwrap();
    let ended: jiff::Timestamp = summary.ended.unwrap().parse().unwrap();
    let last = read(&mut client, &["Last Run/Verdict"])["Last Run/Verdict"].take();
    assert_eq!(last["value"], json!(summary.verdict));
    let source_ms = (1e3 * last["source"].as_f64().unwrap()).round();
    assert_eq!(source_ms, ended.as_millisecond() as f64, "the time of the end, in ms");
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
}

#[test]
#[ignore = "needs Python with venv, and asyncua: see REGRIND_PYTHON"]
fn opcua_end_state_without_a_look() {
    let home = home();
    let (mut teller, url) = start_publishing(home.path());
    let mut client = client(home.path(), &url);
    asked(&mut client, &json!({ "subscribe": ["Status/StateCurrent", "Run"], "events": "Cell" }), "subscribed");
    let elsewhere = TempDir::new().unwrap();
    let name = ended_run(elsewhere.path(), "accepted");
    let summary = regrind::report::run_summary(&elsewhere.path().join("runs").join(&name)).unwrap();
    move_run(elsewhere.path(), &name, home.path());
    until_changed(&mut client, "Status/StateCurrent", &json!(17));
    until_changed(&mut client, "Run", &json!(name));
    let ended =
        events(&mut client, "end of the run", |event| event["Run"] == json!(name) && !event["Verdict"].is_null());
    assert_eq!((&ended[0]["Verdict"], &ended[0]["Accepted"]), (&json!(summary.verdict), &json!(true)));
    let results = events(&mut client, "results", |event| !event["Cycle"].is_null());
    assert_eq!(results.len(), summary.cycles.len(), "{results:?}");
    assert_eq!(results.last().unwrap()["PV"], read_pv(&summary));
    client.until(0, "that no run is on", |said| {
        let states = said.iter().filter(|line| line["changed"] == "Status/StateCurrent");
        let states: Vec<_> = states.map(|line| line["value"].as_u64().unwrap()).collect();
        (states.last() == Some(&4) && states.len() > 1).then(|| assert_eq!(states, [4, 17, 4]))
    });
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
}

#[test]
#[ignore = "needs Python with venv, and asyncua: see REGRIND_PYTHON"]
fn opcua_refused_calls_recorded() {
    let home = home();
    let (mut teller, url) = start_publishing(home.path());
    let mut client = client(home.path(), &url);
    let (mut running, folder, _) = held_run(home.path(), 200.0);
    let write = |node: &str| json!({ "write": node, "type": "Double", "value": 1.5 });
    // The first eight in a minute are recorded one by one.
    for (order, kind, refused) in [
        (json!({ "call": "Start", "with": [7] }), "call", "call: ns=3;s=Start of ns=3;s=Cell (7)"),
        (json!({ "call": "Figures/PV", "of": "Figures" }), "call", "call: ns=3;s=Figures/PV of ns=3;s=Figures ()"),
        (json!({ "call": "ns=77;i=5", "of": "ns=78;i=6" }), "call", "call: ns=77;i=5 of ns=78;i=6 ()"),
        // A method of the standard that changes the server, and the type of an object.
        (json!({ "call": "i=12873", "of": "i=2253" }), "call", "call: i=12873 of i=2253 ()"),
        (write("Absent"), "write", "write: ns=3;s=Absent = 1.5"),
        (write("ns=77;s=Absent"), "write", "write: ns=77;s=Absent = 1.5"),
        (write("i=2258"), "write", "write: i=2258 = 1.5"),
        (json!({ "add": "New" }), "add", "New below ns=3;s=Cell"),
    ] {
        let told = asked(&mut client, &order, kind);
        assert_ne!(told["result"], "Good", "{told}");
        teller.line(refused, |line| line.contains("\"refused\"") && line.contains(refused));
        let station = until_recorded(&mut running, &folder, refused);
        assert!(station.contains("urn:example.org:FreeOpcUa"), "{station}");
    }
    // The others are counted.
    let told = asked(&mut client, &json!({ "delete": "Figures/PV" }), "delete");
    assert!(told["result"].as_array().unwrap().iter().all(|code| code != "Good"), "{told}");
    teller.line("the number", |line| line.contains("\"refused\"") && line.contains("1 further requests"));
    until_recorded(&mut running, &folder, "1 further requests");
    assert_eq!(read(&mut client, &["Status/StateCurrent"])["Status/StateCurrent"]["value"], 11);
    running.signal("KILL");
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
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
