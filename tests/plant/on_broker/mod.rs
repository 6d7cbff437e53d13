//! Live values of a cell on a real broker, as an independent host of Sparkplug B sees them.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::broker::Broker;
use crate::held::{held_run, until_recorded};
use crate::only_run;
use crate::peers::Peer;
use crate::program::{Running, regrind, run, small_recipe};

/// Cell that publishes to a broker, and a host that listens there.
struct PublishingCell {
    home: TempDir,
    broker: Broker,
    host: Peer,
}

impl PublishingCell {
    fn new() -> Self {
        let home = TempDir::new().unwrap();
        let broker = Broker::start();
        let lines = format!("broker = \"127.0.0.1\"\nport = {}\ngroup = \"plant\"\n", broker.port());
        write_plant(home.path(), &lines);
        let mut host = Peer::start("sparkplug_host.py", &[&broker.port().to_string(), "plant", "cell-1"], home.path());
        listens(&mut host, 0);
        Self { home, broker, host }
    }

    fn publish(&self) -> Running {
        Running::new(regrind(&["tell", "--plant", "plant.toml", "--json"], self.home.path()))
    }
}

fn write_plant(home: &Path, lines: &str) {
    fs::write(home.join("plant.toml"), format!("[plant]\ncell = \"cell-1\"\n\n[sparkplug]\n{lines}")).unwrap();
}

fn listens(host: &mut Peer, from: usize) {
    host.until(from, "subscription", |said| said.iter().any(|line| line["listens"] == true).then_some(()));
}

/// Waits for a message of a kind after a position.
fn heard(host: &mut Peer, from: usize, kind: &str) -> Value {
    host.until(from, kind, |said| said.iter().find(|line| line["heard"] == kind).cloned())
}

/// Returns the values that the host has after all messages that it received.
fn values(said: &[Value]) -> serde_json::Map<String, Value> {
    let mut values = serde_json::Map::new();
    for line in said {
        match line["heard"].as_str() {
            Some("NBIRTH") => values = line["metrics"].as_object().unwrap().clone(),
            Some("NDATA") => values.extend(line["metrics"].as_object().unwrap().clone()),
            Some("NDEATH") => values.clear(),
            _ => {}
        }
    }
    values
}

/// Waits until a value is published; returns all values at that moment.
fn until_value(host: &mut Peer, name: &str, wanted: &Value) -> serde_json::Map<String, Value> {
    host.until(0, &format!("{name} = {wanted}"), |said| {
        let told = (0..said.len()).find(|last| said[*last]["metrics"].get(name) == Some(wanted));
        told.map(|last| values(&said[..=last]))
    })
}

fn no_fault(host: &mut Peer) {
    let faults: Vec<_> = host.said().into_iter().filter(|line| !line["fault"].is_null()).collect();
    assert!(faults.is_empty(), "{faults:?}");
}

#[test]
#[ignore = "needs mosquitto (Debian package), and Python with venv: see REGRIND_PYTHON"]
fn sparkplug_values_and_refused_commands() {
    let mut told = PublishingCell::new();
    let mut teller = told.publish();
    let birth = heard(&mut told.host, 0, "NBIRTH");
    let metrics = &birth["metrics"];
    assert_eq!(
        (&birth["seq"], &metrics["bdSeq"], &metrics["Node Control/Rebirth"]),
        (&json!(0), &json!(0), &json!(false))
    );
    assert_eq!(metrics["Status/StateCurrent"], 4);
    assert_eq!(metrics["Message"], "no run is on");
    for (name, kind, unit) in [
        ("Figures/PV", "DOUBLE", Some("um")),
        ("Job/Least Time Left", "DOUBLE", Some("s")),
        ("Cycle", "UINT32", None),
        ("Simulation", "BOOLEAN", None),
        ("Run", "STRING", None),
    ] {
        assert_eq!(birth["types"][name], kind, "{name}");
        assert_eq!(birth["units"][name].as_str(), unit, "{name}");
        assert!(birth["nulls"].as_array().unwrap().contains(&json!(name)), "nothing is known of {name}");
    }

    let (mut running, folder, held) = held_run(told.home.path(), 200.0);
    let values = until_value(&mut told.host, "Status/StateCurrent", &json!(11));
    let row = &held["cycles"][0];
    let judged = |judged: &str, all: &str| if row[judged].is_null() { row[all].clone() } else { row[judged].clone() };
    for (name, wanted) in [
        ("Status/StateName", json!("Held")),
        ("Status/UnitModeCurrent", json!(16)),
        ("Simulation", json!(true)),
        ("Serial", json!("SN-0042")),
        ("Run", json!(folder.file_name().unwrap().to_str().unwrap())),
        ("Part", held["part"].clone()),
        ("Message", held["words"].clone()),
        ("Next Step", held["next"].clone()),
        ("Cycle", held["cycle"].clone()),
        ("Max Cycles", held["max_cycles"].clone()),
        ("Figures/Cycle", row["cycle"].clone()),
        ("Figures/PV", judged("judged_pv_um", "pv_um")),
        ("Figures/RMS", judged("judged_rms_um", "rms_um")),
        ("Limits/PV", json!(1e3 * held["tolerance"]["pv_mm"].as_f64().unwrap())),
        ("Alarms/Count", json!(held["alarms"].as_array().map_or(0, Vec::len))),
    ] {
        assert_eq!(values[name], wanted, "{name}");
    }

    let from = told.host.place();
    told.host.does(&json!({ "name": "Status/StateCurrent", "type": "UINT32", "value": 2 }));
    told.host.does(&json!({ "name": "Hold", "type": "BOOLEAN", "value": true, "device": "cell" }));
    told.host.does(&json!({ "raw": "ff00ff" }));
    for (kind, refused) in
        [("NCMD: ", "Status/StateCurrent = 2"), ("DCMD: ", "Hold = true"), ("NCMD: ", "Sparkplug B command")]
    {
        teller.line(refused, |line| ["\"refused\"", kind, refused].iter().all(|piece| line.contains(piece)));
        let station = until_recorded(&mut running, &folder, refused);
        assert!(station.contains("broker 127.0.0.1"), "{station}");
    }
    told.host.does(&json!({ "name": "Node Control/Rebirth", "type": "BOOLEAN", "value": true }));
    let again = heard(&mut told.host, from, "NBIRTH");
    assert_eq!(
        (&again["seq"], &again["metrics"]["bdSeq"], &again["metrics"]["Status/StateCurrent"]),
        (&json!(0), &json!(0), &json!(11))
    );

    let (code, out, errors) = run(&["resume", &folder.display().to_string()], told.home.path());
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(running.end().0, 0);
    let summary = regrind::report::run_summary(&folder).unwrap();
    let last = until_value(&mut told.host, "Last Run/Verdict", &json!(summary.verdict));
    assert_eq!(
        (&last["Last Run/Accepted"], &last["Status/StateCurrent"], &last["Figures/PV"]),
        (&json!(true), &json!(4), &Value::Null)
    );
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    assert_eq!(heard(&mut told.host, from, "NDEATH")["metrics"]["bdSeq"], 0);
    no_fault(&mut told.host);
}

#[test]
#[ignore = "needs mosquitto (Debian package), and Python with venv: see REGRIND_PYTHON"]
fn sparkplug_births_survive_restarts() {
    let mut told = PublishingCell::new();
    let mut teller = told.publish();
    heard(&mut told.host, 0, "NBIRTH");

    let from = told.host.place();
    told.broker.kill();
    told.host.until(from, "the end of the broker", |said| said.iter().any(|line| line["cut"] == true).then_some(()));
    teller.line("that nobody is told", |line| line.contains("\"waits\""));
    told.broker.go_on();
    listens(&mut told.host, from);
    // The host requests a rebirth, as one does that has possibly missed the birth.
    told.host.does(&json!({ "name": "Node Control/Rebirth", "type": "BOOLEAN", "value": true }));
    assert_eq!(heard(&mut told.host, from, "NBIRTH")["metrics"]["bdSeq"], 1);

    let from = told.host.place();
    teller.signal("KILL");
    assert_eq!(heard(&mut told.host, from, "NDEATH")["metrics"]["bdSeq"], 1, "the broker tells it");
    let from = told.host.place();
    let mut teller = told.publish();
    assert_eq!(heard(&mut told.host, from, "NBIRTH")["metrics"]["bdSeq"], 2);

    // Two publishers of the same cell take turns instead of interfering.
    let mut second = told.publish();
    let from = told.host.place();
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    assert_eq!(heard(&mut told.host, from, "NDEATH")["metrics"]["bdSeq"], 2);
    assert_eq!(heard(&mut told.host, from, "NBIRTH")["metrics"]["bdSeq"], 3);
    second.signal("TERM");
    assert_eq!(second.end().0, 0);
    no_fault(&mut told.host);
}

#[test]
#[ignore = "needs mosquitto (Debian package), and Python with venv: see REGRIND_PYTHON"]
fn sparkplug_killed_run_is_not_idle() {
    let mut told = PublishingCell::new();
    let recipe = small_recipe(told.home.path(), 1000.0).display().to_string();
    let (code, out, errors) = run(&["run", &recipe, "--cell", "sim", "--plant", "plant.toml"], told.home.path());
    assert_eq!(code, 0, "{out}{errors}");
    assert!(!errors.contains("error"), "{errors}");
    let (_, name) = only_run(&told.home.path().join("runs"));
    let values = until_value(&mut told.host, "Last Run/Name", &json!(name));
    assert_eq!(values["Last Run/Accepted"], true);
    heard(&mut told.host, 0, "NDEATH");

    let mut teller = told.publish();
    let (running, folder, _) = held_run(told.home.path(), 200.0);
    until_value(&mut told.host, "Status/StateCurrent", &json!(11));
    running.signal("KILL");
    let values = until_value(&mut told.host, "Status/StateCurrent", &Value::Null);
    assert_eq!(values["Run"], json!(folder.file_name().unwrap().to_str().unwrap()));
    let message = values["Message"].as_str().unwrap();
    for piece in [folder.file_name().unwrap().to_str().unwrap(), "simulated machines"] {
        assert!(message.contains(piece), "{piece}: {message}");
    }
    assert_eq!(
        (&values["Figures/PV"], &values["Status/StateName"], &values["Last Run/Name"]),
        (&Value::Null, &Value::Null, &json!(name))
    );
    // Nor after a report of another run, or after a new folder.
    let (code, _, errors) = run(&["report", &format!("runs/{name}")], told.home.path());
    assert_eq!(code, 0, "{errors}");
    fs::create_dir(told.home.path().join("runs/empty")).unwrap();
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    let from = told.host.place();
    let mut teller = told.publish();
    let born = heard(&mut told.host, from, "NBIRTH");
    assert!(born["nulls"].as_array().unwrap().contains(&json!("Status/StateCurrent")), "{born}");
    assert_eq!(born["metrics"]["Run"], json!(folder.file_name().unwrap().to_str().unwrap()));
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    no_fault(&mut told.host);
}

#[test]
#[ignore = "needs mosquitto (Debian package), and Python with venv: see REGRIND_PYTHON"]
fn sparkplug_silent_run_is_unknown() {
    let mut told = PublishingCell::new();
    let mut teller = told.publish();
    let (running, folder, _) = held_run(told.home.path(), 200.0);
    until_value(&mut told.host, "Status/StateCurrent", &json!(11));
    running.signal("STOP");
    let values = until_value(&mut told.host, "Status/StateCurrent", &Value::Null);
    assert_eq!(values["Run"], json!(folder.file_name().unwrap().to_str().unwrap()));
    assert!(values["Message"].as_str().unwrap().contains("does not answer"), "{values:?}");
    let from = told.host.place();
    running.signal("CONT");
    told.host.until(from, "that it is held", |said| {
        said.iter().any(|line| line["metrics"]["Status/StateCurrent"] == 11).then_some(())
    });
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    no_fault(&mut told.host);
}

#[test]
#[ignore = "needs mosquitto (Debian package), and Python with venv: see REGRIND_PYTHON"]
fn broker_certificate_is_verified() {
    let [its, foreign] = [(), ()].map(|()| rcgen::generate_simple_self_signed(["localhost".to_owned()]).unwrap());
    let lines =
        "allow_anonymous false\npassword_file FOLDER/passwords\ncertfile FOLDER/cert.pem\nkeyfile FOLDER/key.pem\n";
    let broker = Broker::with(lines, |folder| {
        fs::write(folder.join("cert.pem"), its.cert.pem()).unwrap();
        fs::write(folder.join("key.pem"), its.signing_key.serialize_pem()).unwrap();
        let mut passwd = Command::new("mosquitto_passwd");
        passwd.args(["-c", "-b"]).arg(folder.join("passwords")).args(["cell-1", "of-the-cell"]);
        assert!(passwd.status().expect("Debian package mosquitto").success());
    });
    let home = TempDir::new().unwrap();
    let port = broker.port().to_string();
    fs::write(home.path().join("its.pem"), its.cert.pem()).unwrap();
    fs::write(home.path().join("foreign.pem"), foreign.cert.pem()).unwrap();
    fs::write(home.path().join("password"), "of-the-cell\n").unwrap();
    let plant = |more: &str| {
        let lines =
            format!("port = {port}\ngroup = \"plant\"\nuser = \"cell-1\"\npassword_file = \"password\"\n{more}");
        write_plant(home.path(), &lines);
    };
    let refused = |pieces: [&str; 2]| {
        let (code, out, errors) = run(&["tell", "--plant", "plant.toml"], home.path());
        assert!(code == 2 && pieces.iter().all(|piece| errors.contains(piece)), "{code} {out}{errors}");
    };
    let readable = |mode| fs::set_permissions(home.path().join("password"), fs::Permissions::from_mode(mode)).unwrap();

    plant("broker = \"plant.example\"\n");
    refused(["plant.example", "`certificates`"]);
    plant("broker = \"localhost\"\ncertificates = \"its.pem\"\n");
    readable(0o644);
    refused(["password", "chmod"]);
    readable(0o600);

    plant("broker = \"localhost\"\ncertificates = \"foreign.pem\"\n");
    let tell = || Running::new(regrind(&["tell", "--plant", "plant.toml", "--json"], home.path()));
    let mut teller = tell();
    let waits = teller.line("that it is not believed", |line| line.contains("\"waits\""));
    assert!(waits.contains("ertificate"), "{waits}");
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);

    plant("broker = \"localhost\"\ncertificates = \"its.pem\"\n");
    let its = home.path().join("its.pem").display().to_string();
    let who = [&*port, "plant", "cell-1", &its, "cell-1", "of-the-cell"];
    let mut host = Peer::start("sparkplug_host.py", &who, home.path());
    listens(&mut host, 0);
    let mut teller = tell();
    assert_eq!(heard(&mut host, 0, "NBIRTH")["metrics"]["Status/StateName"], "Idle");
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    no_fault(&mut host);
}
