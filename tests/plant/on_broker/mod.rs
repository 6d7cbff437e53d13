//! Live values of a cell on a real broker, as an independent host of Sparkplug B sees them.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::broker::Broker;
use crate::held::{ended_run, held_run, move_run, until_recorded};
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
        Self::with("")
    }

    /// Returns a cell with additional lines in its table [sparkplug].
    fn with(more: &str) -> Self {
        let home = TempDir::new().unwrap();
        let broker = Broker::start();
        let lines = format!("broker = \"127.0.0.1\"\nport = {}\ngroup = \"plant\"\n{more}", broker.port());
        write_plant(home.path(), &lines);
        let mut host = Peer::start("sparkplug_host.py", &[&broker.port().to_string(), "plant", "cell-1"], home.path());
        listens(&mut host, 0);
        Self { home, broker, host }
    }

    fn publish(&self) -> Running {
        Running::new(regrind(&["tell", "--plant", "plant.toml", "--json"], self.home.path()))
    }

    /// Lets the broker go on. The host listens before the node is back: whoever subscribes late misses its birth.
    fn mend(&mut self, teller: &mut Running, from: usize) {
        teller.signal("STOP");
        self.broker.go_on();
        listens(&mut self.host, from);
        teller.signal("CONT");
    }

    /// Kills the broker, as a loss of power does, and waits until both ends know it.
    fn cut(&mut self, teller: &mut Running) -> usize {
        let from = self.host.place();
        self.broker.kill();
        self.host
            .until(from, "the end of the broker", |said| said.iter().any(|line| line["cut"] == true).then_some(()));
        teller.line("that nobody is told", |line| line.contains("\"waits\""));
        from
    }

    /// Waits until the file of the unpublished changes has a text.
    fn until_kept(&self, teller: &mut Running, text: &str) {
        let path = self.home.path().join("plant.live/changes");
        teller.until(text, |_| fs::read_to_string(&path).unwrap_or_default().contains(text).then_some(()));
    }

    /// Makes the primary host `scada` known as online or offline, at a time of its own.
    fn state(&mut self, online: bool, timestamp: u64) {
        self.host.does(&json!({ "state": { "host": "scada", "online": online, "timestamp": timestamp } }));
    }
}

/// Returns the values of a figure in the messages, in order: of the history or of the present, with their times.
fn values_told(said: &[Value], what: &str, name: &str) -> Vec<(Value, u64)> {
    let with = said.iter().filter(|line| line[what].get(name).is_some());
    with.map(|line| (line[what][name].clone(), line["times"][name].as_u64().unwrap())).collect()
}

/// Asserts that the messages after the first `from` have the end of each run, each once, in order, with its result, and
/// not before the time of its record. `what` says where: in the history or in the present.
fn ends_told(said: &[Value], from: usize, what: &str, ends: &[(&Path, u32, &str)]) {
    let mut now = serde_json::Map::new();
    let mut found = Vec::new();
    for (k, line) in said.iter().enumerate().filter(|(_, line)| !line["heard"].is_null()) {
        let told = line[if k < from { "metrics" } else { what }].as_object().unwrap();
        now.extend(told.clone());
        if k >= from && line["heard"] == "NDATA" && told.contains_key("Last Run/Name") {
            found.push((now.clone(), line["times"]["Last Run/Name"].as_u64().unwrap()));
        }
    }
    assert_eq!(found.len(), ends.len(), "{found:?}");
    for ((now, at_ms), (folder, state, result)) in found.iter().zip(ends) {
        let summary = regrind::report::run_summary(folder).unwrap();
        let name = json!(folder.file_name().unwrap().to_str().unwrap());
        assert_eq!((&now["Status/StateCurrent"], &now["Run"], &now["Last Run/Name"]), (&json!(state), &name, &name));
        assert_eq!((&now["Last Run/Verdict"], &now["Last Run/Result"]), (&json!(summary.verdict), &json!(result)));
        let ended: jiff::Timestamp = summary.ended.unwrap().parse().unwrap();
        assert!(i64::try_from(*at_ms).unwrap() >= ended.as_millisecond(), "{at_ms} before {ended}");
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
    assert_eq!((&last["Last Run/Accepted"], &last["Status/StateCurrent"]), (&json!(true), &json!(17)));
    assert_eq!(last["Figures/PV"], json!(summary.cycles.last().unwrap().figures.unwrap()[0][0]));
    told.host.until(from, "that no run is on", |said| {
        said.iter().any(|line| line["metrics"]["Status/StateCurrent"] == 4).then_some(())
    });
    let last = self::values(&told.host.said());
    assert_eq!((&last["Last Run/Accepted"], &last["Figures/PV"]), (&json!(true), &Value::Null));
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
    let said = told.host.said();
    let complete = ["metrics", "history"].map(|what| values_told(&said, what, "Status/StateCurrent"));
    assert!(complete.iter().flatten().any(|(state, _)| *state == 17), "{complete:?}");

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
fn sparkplug_end_states_without_a_look() {
    let mut cell = PublishingCell::new();
    let elsewhere = [(); 5].map(|()| TempDir::new().unwrap());
    let hows = ["accepted", "stopped", "aborted", "accepted", "accepted"];
    let [accepted, stopped, aborted, fourth, fifth] = std::array::from_fn(|k| ended_run(elsewhere[k].path(), hows[k]));
    let runs = cell.home.path().join("runs");
    let folder = |name: &str| runs.join(name);
    let mut teller = cell.publish();
    heard(&mut cell.host, 0, "NBIRTH");
    for (home, name) in elsewhere.iter().zip([&accepted, &stopped, &aborted]) {
        move_run(home.path(), name, cell.home.path());
        until_value(&mut cell.host, "Last Run/Name", &json!(name));
    }
    until_value(&mut cell.host, "Status/StateCurrent", &json!(9));
    let idle_after =
        |said: &[Value]| said.last()?["metrics"].get("Status/StateCurrent").is_some_and(|now| *now == 4).then_some(());
    cell.host.until(1, "that no run is on", idle_after);
    let ends =
        [(&*folder(&accepted), 17, "Accepted"), (&*folder(&stopped), 2, "Stopped"), (&*folder(&aborted), 9, "Aborted")];
    ends_told(&cell.host.said(), 0, "metrics", &ends);
    assert!(values_told(&cell.host.said(), "history", "Status/StateCurrent").is_empty());

    // A run that ends while nobody publishes is history after that; nothing is told twice.
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    move_run(elsewhere[3].path(), &fourth, cell.home.path());
    let from = cell.host.place();
    let mut teller = cell.publish();
    let birth = heard(&mut cell.host, from, "NBIRTH");
    assert_eq!(birth["history"], json!({}));
    cell.host.until(from, "the fourth run", |said| {
        said.iter().any(|line| line["history"]["Last Run/Name"] == json!(fourth)).then_some(())
    });
    move_run(elsewhere[4].path(), &fifth, cell.home.path());
    cell.host.until(from, "the fifth run", |said| {
        said.iter().any(|line| line["metrics"]["Last Run/Name"] == json!(fifth)).then_some(())
    });
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    heard(&mut cell.host, from, "NDEATH");
    let said = cell.host.said();
    ends_told(&said, from, "history", &[(&*folder(&fourth), 17, "Accepted")]);
    ends_told(&said, from, "metrics", &[(&*folder(&fifth), 17, "Accepted")]);
    let summary = regrind::report::run_summary(&folder(&fourth)).unwrap();
    let ended: jiff::Timestamp = summary.ended.unwrap().parse().unwrap();
    let states = values_told(&said[from..], "history", "Status/StateCurrent");
    assert_eq!(states[0], (json!(17), u64::try_from(ended.as_millisecond()).unwrap()));
    no_fault(&mut cell.host);
}

#[test]
#[ignore = "needs mosquitto (Debian package), and Python with venv: see REGRIND_PYTHON"]
fn sparkplug_history_after_a_cut() {
    let mut cell = PublishingCell::new();
    let mut teller = cell.publish();
    let (mut running, folder, _) = held_run(cell.home.path(), 200.0);
    until_value(&mut cell.host, "Status/StateCurrent", &json!(11));
    let name = folder.file_name().unwrap().to_str().unwrap().to_owned();

    let from = cell.cut(&mut teller);
    let (code, out, errors) = run(&["resume", &folder.display().to_string()], cell.home.path());
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(running.end().0, 0);
    cell.until_kept(&mut teller, "\"Last Run/Name\"");
    // The program ends while the broker is cut: what it has kept outlives it.
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    cell.broker.go_on();
    listens(&mut cell.host, from);
    let mut teller = cell.publish();
    cell.host.until(from, "the end in the history", |said| {
        said.iter().any(|line| line["history"]["Last Run/Name"] == json!(name)).then_some(())
    });

    let said = cell.host.said();
    let heard: Vec<_> = said[from..].iter().filter(|line| !line["heard"].is_null()).collect();
    assert_eq!((&heard[0]["heard"], &heard[0]["metrics"]["Status/StateCurrent"]), (&json!("NBIRTH"), &json!(4)));
    for message in &heard[1..] {
        assert_eq!(
            (&message["heard"], &message["retained"], &message["qos"]),
            (&json!("NDATA"), &json!(false), &json!(0))
        );
    }
    ends_told(&said, from, "history", &[(&folder, 17, "Accepted")]);
    let states = values_told(&said[from..], "history", "Status/StateCurrent");
    let born = heard[0]["sent"].as_u64().unwrap();
    assert!(states.iter().any(|(state, _)| *state == 6), "it went on: {states:?}");
    assert!(states.iter().all(|(_, at_ms)| *at_ms < born), "{states:?} before {born}");
    let cycles = values_told(&said[from..], "history", "Figures/Cycle");
    assert!(cycles.iter().any(|(cycle, _)| *cycle == 2), "{cycles:?}");

    // Nothing is told again: neither after another cut nor by another program.
    let from = cell.cut(&mut teller);
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    cell.broker.go_on();
    listens(&mut cell.host, from);
    let mut teller = cell.publish();
    self::heard(&mut cell.host, from, "NBIRTH");
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    self::heard(&mut cell.host, from, "NDEATH");
    let said = cell.host.said();
    assert!(said[from..].iter().all(|line| line["heard"] != "NDATA"), "{:?}", &said[from..]);
    no_fault(&mut cell.host);
}

#[test]
#[ignore = "needs mosquitto (Debian package), and Python with venv: see REGRIND_PYTHON"]
fn sparkplug_oldest_changes_dropped() {
    let mut cell = PublishingCell::with("keep_changes = 3\n");
    let mut teller = cell.publish();
    heard(&mut cell.host, 0, "NBIRTH");
    let from = cell.cut(&mut teller);
    let (mut running, folder, _) = held_run(cell.home.path(), 200.0);
    let (code, out, errors) = run(&["stop", &folder.display().to_string(), "--reason", "seen"], cell.home.path());
    assert_eq!(code, 0, "{out}{errors}");
    running.end();
    cell.until_kept(&mut teller, "\"Stopped\"");
    cell.mend(&mut teller, from);
    cell.host.until(from, "the end", |said| {
        said.iter().any(|line| line["history"]["Last Run/Result"] == "Stopped").then_some(())
    });
    teller.signal("TERM");
    let (code, errors) = teller.end();
    assert_eq!(code, 0, "{errors}");
    let dropped = |line: &String| serde_json::from_str::<Value>(line).ok()?["dropped"].as_u64();
    let count: u64 = teller.output_lines.iter().filter_map(dropped).sum();
    assert!(count > 0, "{:?}", teller.output_lines);
    heard(&mut cell.host, from, "NDEATH");
    let said = cell.host.said();
    let history = said[from..].iter().filter(|line| line["history"].as_object().is_some_and(|of| !of.is_empty()));
    assert!(history.count() <= 3);
    no_fault(&mut cell.host);
}

#[test]
#[ignore = "needs mosquitto (Debian package), and Python with venv: see REGRIND_PYTHON"]
fn sparkplug_born_for_primary_host() {
    let mut cell = PublishingCell::with("primary_host = \"scada\"\n");
    let births = |host: &mut Peer| host.said().iter().filter(|line| line["heard"] == "NBIRTH").count();
    let mut teller = cell.publish();
    teller.line("that the host is missing", |line| line.contains("\"waits\"") && line.contains("primary host"));
    cell.state(false, 100);
    cell.host.does(&json!({ "name": "Node Control/Rebirth", "type": "BOOLEAN", "value": true }));
    cell.host.does(&json!({ "name": "Hold", "type": "BOOLEAN", "value": true }));
    // The node has read the command, so the state and the request before it too.
    teller.line("Hold", |line| line.contains("\"refused\"") && line.contains("Hold"));
    assert_eq!(births(&mut cell.host), 0);
    cell.state(true, 101);
    let birth = heard(&mut cell.host, 0, "NBIRTH");
    assert_eq!(birth["seq"], 0);
    let first = birth["metrics"]["bdSeq"].as_u64().unwrap();

    // A state that is older than the last one is none.
    cell.state(false, 100);
    let from = cell.host.place();
    let (mut running, folder, _) = held_run(cell.home.path(), 200.0);
    until_value(&mut cell.host, "Status/StateCurrent", &json!(11));
    assert_eq!(births(&mut cell.host), 1);
    cell.state(false, 101);
    assert_eq!(heard(&mut cell.host, from, "NDEATH")["metrics"]["bdSeq"], first);

    // The changes while the host is away are history for it.
    teller.line("that the host is away", |line| line.contains("\"waits\"") && line.contains("offline"));
    teller.line("that the host is missing", |line| line.contains("\"waits\"") && line.contains("not online yet"));
    cell.state(true, 90);
    let (code, out, errors) = run(&["resume", &folder.display().to_string()], cell.home.path());
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(running.end().0, 0);
    cell.until_kept(&mut teller, "\"Last Run/Name\"");
    let from = cell.host.place();
    assert_eq!(births(&mut cell.host), 1);
    cell.state(true, 102);
    assert_eq!(heard(&mut cell.host, from, "NBIRTH")["metrics"]["bdSeq"], first + 1);
    let name = json!(folder.file_name().unwrap().to_str().unwrap());
    cell.host.until(from, "the end in the history", |said| {
        said.iter().any(|line| line["history"]["Last Run/Name"] == name).then_some(())
    });
    ends_told(&cell.host.said(), from, "history", &[(&folder, 17, "Accepted")]);
    teller.signal("TERM");
    assert_eq!(teller.end().0, 0);
    assert_eq!(heard(&mut cell.host, from, "NDEATH")["metrics"]["bdSeq"], first + 1);
    no_fault(&mut cell.host);
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
