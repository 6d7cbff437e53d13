//! The record of a run as the quality department uses it: verified, shown and exported; and the table of states with
//! its picture.

use std::fs;
use std::path::{Path, PathBuf};

use crate::program::{Running, only_run, regrind, root, run, run_folders, small_recipe};
use regrind::cell::{
    Actor, Alarm, AlarmId, Command as Order, Device, Ending, Event, Figures, Judgement, Occupation, Role, Verdict,
    transition_table,
};
use regrind::journal::{AuditKey, Entry, Header, Journal, PublicKey, Reader, RecordKind, sha256_hex, verify};
use regrind::report::state_picture;
use serde_json::{Value, json};
use tempfile::TempDir;

/// Returns the standard output of a command that ends with this exit code.
fn printed(folder: &Path, arguments: &[&str], code: i32) -> String {
    ended(folder, arguments, code).0
}

/// Returns the error output of a command that ends with this exit code.
fn refused(folder: &Path, arguments: &[&str], code: i32) -> String {
    ended(folder, arguments, code).1
}

fn ended(folder: &Path, arguments: &[&str], code: i32) -> (String, String) {
    let (found, out, errors) = run(arguments, folder);
    assert_eq!(found, code, "{arguments:?}: {out}{errors}");
    (out, errors)
}

fn figures() -> Figures {
    Figures {
        pv_mm: 0.004_2,
        rms_mm: 0.000_812,
        form: None,
        pv_expanded_mm: 0.0005,
        rms_expanded_mm: 0.0001,
        coverage: 0.99,
        points: 812,
        outliers: 3,
        with_outliers: None,
        shift_mm: 0.1,
        rotation_rad: 0.01,
        weak_directions: Vec::new(),
        warnings: vec!["the part is warm".into()],
        forecast: None,
        pv_998_mm: None,
        response: None,
        removed_mm: Some(0.1),
        unstated: None,
        further_touches: None,
    }
}

fn events() -> Vec<Event> {
    let device = Device::Grinder;
    vec![
        Event::Start { actor: Actor { name: "Ada".into(), station: "console".into() } },
        Event::Connected { device, boot_id: 1, simulated: true, occupation: Occupation::Idle },
        Event::Fault { device, code: 5, message: "drive\u{1b}[2J too warm".into() },
        Event::Registered { cycle: 1, figures: figures() },
    ]
}

fn orders() -> Vec<Order> {
    let alarm = Alarm {
        id: AlarmId::MachineFault,
        event: "A machine is in fault: grinder.".into(),
        consequence: "The run is aborted.".into(),
        remedy: vec!["Look at it.".into()],
        cleared_by: Role::Operator,
    };
    vec![
        Order::StartMachine { device: Device::Grinder, cycle: 1 },
        Order::Raise(alarm),
        Order::Finish(Ending::Accepted { cycle: 1, reason: "in tolerance".into() }),
        Order::Announce(Judgement { cycle: 1, verdict: Verdict::Accept, reason: "in tolerance".into() }),
    ]
}

/// Map of two by two nodes, one of them without a measurement.
const MAP: &str =
    "# cycle: 1\nx_mm,y_mm,error_mm,sigma_mm,valid\n0,0,0.001,0,1\n1,0,-0.002,0,1\n0,1,0.0005,0,1\n1,1,0.5,0,0\n";

/// Creates a folder with one run in `runs/`, as a drive would have recorded it.
fn recorded(simulation: bool) -> (TempDir, PathBuf) {
    let home = tempfile::tempdir().unwrap();
    let folder = home.path().join("runs/mirror-1");
    let header = Header {
        run: "mirror-1".into(),
        part: "SN 7".into(),
        actor: "Ada".into(),
        station: "console".into(),
        simulation,
        first_command_id: 1,
        content: json!({ "part_name": "Mirror <A> & B", "recipe": "recipes/mirror.toml" }),
    };
    let mut journal = Journal::create(&folder, header).unwrap();
    journal.store("recipe.toml", b"x = 1\n", 0, 0).unwrap();
    for (k, event) in events().into_iter().enumerate() {
        let payload = serde_json::to_value(event).unwrap();
        journal.append(Entry::new(RecordKind::Event, 10 + k as u64, 1, payload)).unwrap();
    }
    // Only a command that gets an answer is an intent. The cell's other notifications are notes.
    for order in orders() {
        let payload = serde_json::to_value(&order).unwrap();
        if matches!(order, Order::StartMachine { .. }) {
            journal.intend(Entry::new(RecordKind::Intent, 20, 2, payload)).unwrap();
        } else {
            journal.append(Entry::new(RecordKind::Note, 20, 2, payload)).unwrap();
        }
    }
    journal.append(Entry::new(RecordKind::Note, 30, 2, json!({ "pass_record": { "path_mm": 12.5 } }))).unwrap();
    journal.store("cycle-2/measured.csv", b"1,2,3\n", 40, 2).unwrap();
    journal.store("cycle-1/error_map.csv", MAP.as_bytes(), 40, 1).unwrap();
    let ending = Ending::Accepted { cycle: 2, reason: "in tolerance".into() };
    journal
        .close(
            50,
            2,
            json!({ "simulation": simulation, "ending": ending, "cycles": [{ "cycle": 1, "pv_um": 1.5, "rms_um": 0.5, "points": 9, "outliers": 0, "level_um": 12.5 }] }),
        )
        .unwrap();
    (home, folder)
}

#[test]
fn audit_verifies_sound_record() {
    let (home, folder) = recorded(true);
    let words = printed(home.path(), &["audit", "verify"], 0);
    assert!(words.starts_with("SIMULATION  runs/mirror-1\n"), "{words}");
    assert!(words.contains("14 records") && words.contains("3 files"), "{words}");
    let value: Value =
        serde_json::from_str(&printed(home.path(), &["audit", "verify", folder.to_str().unwrap(), "--json"], 0))
            .unwrap();
    assert_eq!((&value["sound"], &value["records"], &value["closed"]), (&json!(true), &json!(14), &json!(true)));
    assert!(words.contains(value["head"].as_str().unwrap()));
    fs::copy(folder.join("journal.anchor"), home.path().join("kept")).unwrap();
    printed(home.path(), &["audit", "verify", "--anchor", "kept"], 0);
    let (other, _) = recorded(false);
    let words = printed(other.path(), &["audit", "verify"], 0);
    assert!(!words.contains("SIMULATION"), "{words}");
    let kept = home.path().join("kept");
    printed(other.path(), &["audit", "verify", "--anchor", kept.to_str().unwrap()], 1);
}

#[test]
fn audit_names_broken_record() {
    let (home, folder) = recorded(true);
    fs::write(folder.join("cycle-2/measured.csv"), "1,2,4\n").unwrap();
    let error = refused(home.path(), &["audit", "verify"], 1);
    for piece in ["broken at record 12", "cycle-2/measured.csv", "changed"] {
        assert!(error.contains(piece), "{error}");
    }
    let value: Value = serde_json::from_str(&printed(home.path(), &["audit", "verify", "--json"], 1)).unwrap();
    assert_eq!((&value["sound"], &value["record"]), (&json!(false), &json!(12)));

    let (home, folder) = recorded(true);
    let database = rusqlite::Connection::open(folder.join("journal.sqlite")).unwrap();
    database.execute_batch("DROP TRIGGER record_is_not_changed; UPDATE record SET kind = 'x' WHERE seq = 4").unwrap();
    drop(database);
    for what in ["verify", "show", "export"] {
        let error = refused(home.path(), &["audit", what], 1);
        assert!(error.contains("broken at record 4"), "{what}: {error}");
    }
    assert_eq!(printed(home.path(), &["audit", "export"], 1).lines().count(), 3, "what stands before it is given");
}

#[test]
fn audit_detects_missing_anchor_or_end() {
    let (home, folder) = recorded(true);
    fs::remove_file(folder.join("journal.anchor")).unwrap();
    assert!(refused(home.path(), &["audit", "verify"], 1).contains("journal.anchor is missing"));

    // The end was cut off and the anchor rewritten to fit.
    let (home, folder) = recorded(true);
    let database = rusqlite::Connection::open(folder.join("journal.sqlite")).unwrap();
    database.execute_batch("DROP TRIGGER record_is_not_deleted; DELETE FROM record WHERE seq > 12").unwrap();
    let head: String = database.query_row("SELECT hash FROM record WHERE seq = 12", [], |row| row.get(0)).unwrap();
    drop(database);
    fs::write(folder.join("journal.anchor"), json!({ "records": 12, "head": head }).to_string()).unwrap();
    assert!(refused(home.path(), &["audit", "verify"], 1).contains("the run was interrupted"));
}

/// A pipe in place of a report has no end. `audit verify` does not wait for it, and still proves the record.
#[cfg(unix)]
#[test]
fn audit_does_not_wait_for_pipes() {
    let (home, folder) = recorded(true);
    for name in ["report.html", "report.pdf", "label.svg"] {
        let pipe = folder.join(name);
        let _ = fs::remove_file(&pipe);
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let mut verifying = Running::new(regrind(&["audit", "verify"], home.path()));
        verifying.line("the record", |line| line.starts_with("sound"));
        assert_eq!(verifying.end().0, 0, "{name}");
        fs::remove_file(&pipe).unwrap();
    }
}

#[test]
fn audit_lists_unrecorded_files() {
    let (home, folder) = recorded(true);
    printed(home.path(), &["report"], 0);
    let words = printed(home.path(), &["audit", "verify"], 0);
    assert!(!words.contains("beside") && !words.contains("report.html"), "{words}");
    fs::write(folder.join("cycle-2/more.csv"), "1,2,3\n").unwrap();
    let html = fs::read_to_string(folder.join("report.html")).unwrap();
    fs::write(folder.join("report.html"), html.replace("0.812", "0.212")).unwrap();
    let words = printed(home.path(), &["audit", "verify"], 0);
    assert!(words.contains("cycle-2/more.csv") && words.contains("report.html differs"), "{words}");
}

#[test]
fn audit_refuses_folder_without_record() {
    let home = tempfile::tempdir().unwrap();
    for what in ["verify", "show", "export"] {
        for arguments in [vec!["audit", what], vec!["audit", what, "nowhere"], vec!["audit", what, "."]] {
            let (out, error) = ended(home.path(), &arguments, 2);
            assert!(out.is_empty() && error.contains("folder of a run"), "{arguments:?}: {out}{error}");
        }
    }
    let (home, _) = recorded(true);
    fs::write(home.path().join("text"), "x").unwrap();
    for anchor in ["text", "absent"] {
        let error = refused(home.path(), &["audit", "verify", "--anchor", anchor], 2);
        assert!(error.contains("journal.anchor"), "{error}");
    }
}

#[test]
fn audit_show_prints_marked_table() {
    let (home, _) = recorded(true);
    let shown = printed(home.path(), &["audit", "show"], 0);
    assert!(shown.starts_with("SIMULATION  runs/mirror-1; Mirror <A> & B\n"), "{shown}");
    // The pieces of one row each. The texts of fault, alarm and warning are those of the events.
    let said: [&[&str]; 11] = [
        &["begin         -", "SIMULATION", "run mirror-1", "Mirror <A> & B", "recipes/mirror.toml"],
        &["artefact      -", "recipe.toml, 6 bytes", "sha256 "],
        &["event         1  start"],
        &["grinder: connected", "simulation", "idle"],
        &["grinder: fault, 5", "drive [2J too warm"],
        &["PV 4.20 µm", "RMS 0.812 µm", "812 points", "3 outliers", "the part is warm"],
        &["intent        2", "grinder: start"],
        &["ALARM ", "fault: grinder", "aborted"],
        &["judged", "accept: in tolerance"],
        &["pass: path 12.5 mm"],
        &["end           2", "ACCEPTED: in tolerance"],
    ];
    for pieces in said {
        let is_shown = shown.lines().any(|line| pieces.iter().all(|piece| line.contains(piece)));
        assert!(is_shown, "{pieces:?}\n{shown}");
    }
    assert!(!shown.contains('\u{1b}'), "a machine's words control no terminal");
    let rows =
        |arguments: &[&str]| printed(home.path(), &[&["audit", "show"], arguments].concat(), 0).lines().count() - 2;
    assert_eq!(rows(&[]), 14);
    assert_eq!(rows(&["--kind", "intent"]), 1);
    assert_eq!(rows(&["--kind", "intent,note", "--cycle", "2"]), 5);
    assert_eq!(rows(&["--cycle", "9"]), 0);
    assert_eq!(printed(home.path(), &["audit", "show", "--kind", "event", "--json"], 0).lines().count(), 4);
    let error = refused(home.path(), &["audit", "show", "--kind", "evnt"], 2);
    assert!(error.contains("begin, reopen, intent"), "{error}");
}

#[test]
fn audit_export_chain_is_verifiable() {
    let (home, _) = recorded(false);
    let mut previous = "0".repeat(64);
    let lines = printed(home.path(), &["audit", "export"], 0);
    assert_eq!(lines.lines().count(), 14);
    for line in lines.lines() {
        let (hashed, chain) = line.split_once(",\"prev_hash\":\"").unwrap();
        let (prev_hash, rest) = chain.split_once('"').unwrap();
        assert_eq!(prev_hash, previous);
        let due = sha256_hex(format!("regrind journal record 1\n{previous}\n{hashed}}}").as_bytes());
        assert_eq!(rest, format!(",\"hash\":\"{due}\"}}"));
        assert!(serde_json::from_str::<Value>(line).unwrap()["payload"].is_object());
        previous = due;
    }
}

/// Parses CSV strictly by RFC 4180.
fn rows_of_csv(text: &str) -> Vec<Vec<String>> {
    let (mut rows, mut row, mut field) = (Vec::new(), Vec::new(), String::new());
    let mut letters = text.chars().peekable();
    while let Some(letter) = letters.next() {
        match letter {
            '"' if field.is_empty() => loop {
                match letters.next().expect("a quote is closed") {
                    '"' if letters.peek() == Some(&'"') => field.extend(letters.next()),
                    '"' => break,
                    other => field.push(other),
                }
            },
            ',' => row.push(std::mem::take(&mut field)),
            '\r' => {
                assert_eq!(letters.next(), Some('\n'));
                row.push(std::mem::take(&mut field));
                rows.push(std::mem::take(&mut row));
            }
            plain => {
                assert!(plain != '"' && plain != '\n');
                field.push(plain);
            }
        }
    }
    assert!(row.is_empty() && field.is_empty(), "the last line has its end");
    rows
}

#[test]
fn audit_export_csv_is_exact() {
    let (home, folder) = recorded(false);
    let rows = rows_of_csv(&printed(home.path(), &["audit", "export", "--format", "csv"], 0));
    let head = "seq utc boot_id mono_ns actor station kind part cycle command_id reason payload prev_hash hash";
    assert_eq!(rows[0], head.split(' ').collect::<Vec<_>>());
    let records: Vec<_> = Reader::open(&folder).unwrap().records(1).map(Result::unwrap).collect();
    assert_eq!(rows.len(), records.len() + 1);
    for (row, record) in rows[1..].iter().zip(records) {
        let id = record.command_id.map_or(String::new(), |id| id.to_string());
        let numbers = [record.seq.to_string(), record.mono_ns.to_string(), record.cycle.to_string()];
        assert_eq!([&row[0], &row[3], &row[8]], numbers.each_ref());
        let texts = [&record.utc, &record.boot_id, &record.actor, &record.station, &record.part, &id, &record.reason];
        assert_eq!([1, 2, 4, 5, 7, 9, 10].map(|k| &row[k]), texts);
        assert_eq!([&row[11], &row[12], &row[13]], [&record.payload, &record.prev_hash, &record.hash]);
        assert_eq!(row[6], record.kind.as_str());
    }
    assert!(refused(home.path(), &["audit", "export", "--format", "xml"], 2).contains("jsonl"));
}

/// Returns the output, the error output and the exit code of a command with REGRIND_KEY set to a file.
fn with_key(home: &Path, key: &Path, arguments: &[&str]) -> (i32, String, String) {
    let done = regrind(arguments, home).env("REGRIND_KEY", key).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (done.status.code().unwrap(), text(done.stdout), text(done.stderr))
}

#[test]
fn audit_key_is_created_once() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("settings/audit.key");
    let (code, said, errors) = with_key(home.path(), &path, &["audit", "key"]);
    assert_eq!((code, errors.as_str()), (0, ""));
    let public = PublicKey::from_text(&said).unwrap();
    assert!(said.contains("created now") && said.contains(&public.fingerprint()) && said.contains("quality"), "{said}");
    let (_, said, _) = with_key(home.path(), &path, &["audit", "key", "--json"]);
    let value: Value = serde_json::from_str(&said).unwrap();
    assert_eq!((&value["public_key"], &value["made"]), (&json!(public), &json!(false)));
    assert_eq!(AuditKey::read(&path).unwrap().public(), public);
    // The default place, and a place that is named.
    let done = regrind(&["audit", "key", "--json"], home.path())
        .env_remove("REGRIND_KEY")
        .env("XDG_CONFIG_HOME", home.path())
        .output();
    let value: Value = serde_json::from_slice(&done.unwrap().stdout).unwrap();
    assert_eq!(value["file"], json!(home.path().join("regrind/audit.key")));
    let done = regrind(&["audit", "key"], home.path())
        .env_remove("REGRIND_KEY")
        .env_remove("XDG_CONFIG_HOME")
        .env("HOME", home.path())
        .output();
    assert!(done.unwrap().status.success() && home.path().join(".config/regrind/audit.key").is_file());
    printed(home.path(), &["audit", "key", "--key", "here.key"], 0);
    assert!(refused(home.path(), &["audit", "key"], 2).contains("name the file with --key"), "REGRIND_KEY is empty");
    fs::write(home.path().join("broken.key"), "x").unwrap();
    std::os::unix::fs::symlink("/nowhere/at/all", home.path().join("dangling.key")).unwrap();
    for file in ["broken.key", "dangling.key", "here.key/below.key", "."] {
        let error = refused(home.path(), &["audit", "key", "--key", file], 2);
        assert!(error.contains(file), "{error}");
    }
}

#[test]
fn signed_run_verifies_with_public_key() {
    let home = tempfile::tempdir().unwrap();
    let key = home.path().join("audit.key");
    let kept = with_key(home.path(), &key, &["audit", "key"]).1;
    fs::write(home.path().join("kept"), &kept).unwrap();
    let public = PublicKey::from_text(&kept).unwrap();
    let recipe = small_recipe(home.path(), 1e4);
    let cell = root().join("config/sim.toml");
    let arguments = ["run", recipe.to_str().unwrap(), "--cell", cell.to_str().unwrap(), "--runs", "runs"];
    let (code, said, errors) = with_key(home.path(), &key, &arguments);
    assert_eq!(code, 0, "{said}{errors}");
    for given in ["kept".to_owned(), public.to_string()] {
        let words = printed(home.path(), &["audit", "verify", "--key", &given], 0);
        assert!(words.contains("signed      to its end") && words.contains("as given"), "{words}");
        assert!(words.contains(&public.fingerprint()), "{words}");
    }
    assert!(printed(home.path(), &["audit", "verify"], 0).contains("only --key proves"));
    let value: Value = serde_json::from_str(&printed(home.path(), &["audit", "verify", "--json"], 0)).unwrap();
    assert_eq!(value["keys"], json!([public]));
    assert_eq!(value["signed"].as_u64().unwrap() + 1, value["records"].as_u64().unwrap());
    let other = AuditKey::new().public().to_string();
    let error = refused(home.path(), &["audit", "verify", "--key", &other], 1);
    assert!(error.contains("record 1 names the key") && !error.contains("broken"), "{error}");
    let asked = ["audit", "verify", "--json", "--key", &other];
    let told: Value = serde_json::from_str(&printed(home.path(), &asked, 1)).unwrap();
    assert_eq!((&told["sound"], &told["record"]), (&json!(false), &Value::Null));
    printed(home.path(), &["audit", "verify", "--key", &other, "--key", "kept"], 0);
    let shown = printed(home.path(), &["audit", "show", "--kind", "seal"], 0);
    let key = &public.to_string()[..12];
    assert!(shown.lines().any(|line| line.contains("to record 1 ") && line.contains(key)), "{shown}");
    for wrong in ["", "abc", "absent", "small.toml"] {
        let error = refused(home.path(), &["audit", "verify", "--key", wrong], 2);
        assert!(error.contains("regrind audit key"), "{wrong}: {error}");
    }
    assert!(fs::read_to_string(report_in(home.path())).unwrap().contains(&public.to_string()));
}

/// Returns the report of the only run in a folder.
fn report_in(home: &Path) -> PathBuf {
    let run = only_run(&home.join("runs"));
    run.join("report.html")
}

#[test]
fn run_refuses_unusable_audit_key() {
    use std::os::unix::fs::PermissionsExt;
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e4);
    let cell = root().join("config/sim.toml");
    let key = home.path().join("audit.key");
    AuditKey::make(&key).unwrap();
    fs::set_permissions(&key, fs::Permissions::from_mode(0o644)).unwrap();
    fs::write(home.path().join("broken.key"), "x").unwrap();
    fs::set_permissions(home.path().join("broken.key"), fs::Permissions::from_mode(0o600)).unwrap();
    for (file, says) in [("audit.key", "chmod 600"), ("broken.key", "not an audit key"), ("absent.key", "absent.key")] {
        let arguments = ["run", recipe.to_str().unwrap(), "--cell", cell.to_str().unwrap(), "--runs", "runs"];
        let (code, said, errors) = with_key(home.path(), &home.path().join(file), &arguments);
        assert_eq!(code, 2, "{file}: {said}");
        assert!(errors.contains(says), "{file}: {errors}");
        assert!(!home.path().join("runs").exists(), "{file}: a run was begun");
    }
}

#[test]
fn audit_detects_unsigned_end() {
    let home = tempfile::tempdir().unwrap();
    let folder = home.path().join("runs/r");
    let header = Header {
        run: "r".into(),
        part: "SN 7".into(),
        actor: "Ada".into(),
        station: "console".into(),
        simulation: false,
        first_command_id: 1,
        content: Value::Null,
    };
    let journal = Journal::create_with(&folder, header, Some(AuditKey::new())).unwrap();
    assert!(printed(home.path(), &["audit", "verify"], 4).contains("record 1 of 2"));
    journal.close(0, 0, json!("stopped")).unwrap();
    printed(home.path(), &["audit", "verify"], 0);
    let database = rusqlite::Connection::open(folder.join("journal.sqlite")).unwrap();
    database.execute_batch("DROP TRIGGER record_is_not_deleted; DELETE FROM record WHERE seq = 4").unwrap();
    drop(database);
    assert!(verify(&folder).unwrap().lacks_last_seal());
    let error = refused(home.path(), &["audit", "verify"], 1);
    assert!(error.contains("end of the record") && error.contains("not signed"), "{error}");
    let (home, _) = recorded(false);
    assert!(printed(home.path(), &["audit", "verify"], 0).contains("signed      no"));
}

#[test]
fn report_is_self_contained() {
    let (home, folder) = recorded(true);
    assert_eq!(printed(home.path(), &["report"], 0), "runs/mirror-1/report.html\n");
    let html = fs::read_to_string(folder.join("report.html")).unwrap();
    let document = roxmltree::Document::parse(html.strip_prefix("<!DOCTYPE html>\n").unwrap()).unwrap();
    let all: String = document.descendants().filter_map(|node| node.text()).collect();
    let head = fs::read_to_string(folder.join("journal.anchor")).unwrap();
    let head: Value = serde_json::from_str(&head).unwrap();
    let said = [
        "SIMULATION",
        "Mirror <A> & B",
        "SN 7",
        "recipes/mirror.toml",
        "Ada at console",
        "ACCEPTED: in tolerance",
        "4.20 \u{b1} 0.50",
        "0.812 \u{b1} 0.100",
        "12.5",
        "A machine is in fault: grinder. The run is aborted. Look at it.",
        head["head"].as_str().unwrap(),
    ];
    for words in said {
        assert!(all.contains(words), "{words}\n{all}");
    }
    assert!(all.contains("3 nodes") && all.contains("own scale"), "{all}");
    let image = document.descendants().find(|node| node.has_tag_name("image")).unwrap();
    assert!(image.attribute("href").unwrap().starts_with("data:image/png;base64,iVBORw"));
    assert!(!html.contains("http"), "nothing is fetched");
    printed(home.path(), &["audit", "verify"], 0);
    let (other, _) = recorded(false);
    printed(other.path(), &["report"], 0);
    assert!(!fs::read_to_string(other.path().join("runs/mirror-1/report.html")).unwrap().contains("SIMULATION"));
    fs::remove_file(folder.join("cycle-1/error_map.csv")).unwrap();
    assert!(refused(home.path(), &["report"], 1).contains("cycle-1/error_map.csv is missing"));
    printed(home.path(), &["report", "."], 2);
}

#[test]
fn audit_reports_open_run() {
    let home = tempfile::tempdir().unwrap();
    let header = Header {
        run: "r".into(),
        part: "SN 7".into(),
        actor: "Ada".into(),
        station: "console".into(),
        simulation: false,
        first_command_id: 1,
        content: Value::Null,
    };
    let mut journal = Journal::create(home.path().join("runs/r"), header).unwrap();
    journal.append(Entry::new(RecordKind::Note, 0, 0, json!("a word"))).unwrap();
    let proven = printed(home.path(), &["audit", "verify"], 4);
    assert!(proven.contains("not closed") && proven.contains("up to record 1"), "{proven}");
    assert!(printed(home.path(), &["audit", "show"], 0).ends_with("-  a word\n"));
}

#[test]
fn audit_lock_does_not_make_run_sound() {
    let home = tempfile::tempdir().unwrap();
    let folder = home.path().join("runs/r");
    let header = || Header {
        run: "r".into(),
        part: "SN 7".into(),
        actor: "Ada".into(),
        station: "console".into(),
        simulation: false,
        first_command_id: 1,
        content: Value::Null,
    };
    let key = AuditKey::new();
    let public = key.public().to_string();
    drop(Journal::create_with(&folder, header(), Some(key)).unwrap());
    // Somebody without the key continued the run and ended it.
    Journal::open(&folder).unwrap().close(9, 1, json!("accepted")).unwrap();
    let path = folder.display().to_string();
    let verified = |arguments: &[&str]| run(&[&["audit", "verify", &path], arguments].concat(), home.path()).0;
    assert_eq!((verified(&[]), verified(&["--key", &public])), (1, 1));
    // Anybody who can read the folder can hold its lock.
    let lock = fs::File::open(folder.join(".lock")).unwrap();
    lock.lock_shared().unwrap();
    lock.unlock().unwrap();
    lock.lock().unwrap();
    assert_eq!(verified(&["--key", &public]), 1, "with the key at hand an end that nobody signed is not believed");
    assert_eq!(verified(&[]), 4, "without it the seal may still be on its way");
    // This does not prove a run complete that broke off.
    let broken_off = home.path().join("runs/s");
    drop(Journal::create(&broken_off, header()).unwrap());
    let path = broken_off.display().to_string();
    assert_eq!(run(&["audit", "verify", &path], home.path()).0, 1);
    let lock = fs::File::open(broken_off.join(".lock")).unwrap();
    lock.lock().unwrap();
    assert_eq!(run(&["audit", "verify", &path], home.path()).0, 4);
}

#[test]
fn state_table_and_picture_are_current() {
    let home = tempfile::tempdir().unwrap();
    let idle = printed(home.path(), &["states", "--state", "idle"], 0);
    assert!(idle.starts_with("Idle\n"), "{idle}");
    assert!(idle.contains("  start                          -> Starting"), "{idle}");
    assert!(!idle.contains("refuse"), "{idle}");
    let unknown = refused(home.path(), &["states", "--state", "x"], 2);
    assert!(unknown.contains("Idle, Starting, Execute"), "{unknown}");

    printed(home.path(), &["states", "--svg", "states.svg"], 0);
    let drawn = fs::read_to_string(home.path().join("states.svg")).unwrap();
    let kept = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/states.svg");
    let current = fs::read_to_string(kept).unwrap_or_default();
    assert!(drawn == current, "docs/states.svg is not what the cell does: regrind states --svg docs/states.svg");
}

#[test]
fn state_picture_names_each_state_once() {
    let rows = transition_table();
    let picture = state_picture(&rows);
    let document = roxmltree::Document::parse(&picture).unwrap();
    let texts: Vec<&str> = document.descendants().filter(|n| n.has_tag_name("text")).filter_map(|n| n.text()).collect();
    for row in &rows {
        assert_eq!(texts.iter().filter(|text| **text == row.state.name().to_string()).count(), 1, "{}", row.state);
    }
    let steps = rows.iter().filter_map(|row| row.state.phase()).map(|phase| phase.to_string());
    for step in steps.filter(|step| step != "Judge") {
        let words = step.split(", ").last().unwrap();
        assert!(texts.contains(&words), "{step}");
    }
    // With an empty table there are boxes, and no arrows except those of the colour legend.
    let empty = state_picture(&[]);
    assert_eq!(empty.matches("<path").count(), 6);
}

/// Creates a folder of signed runs, one for each part, in order of their numbers.
fn runs_of(home: &Path, key: &Path, parts: &[&str]) -> Vec<PathBuf> {
    let recipe = small_recipe(home, 1e5).display().to_string();
    for part in parts {
        let (code, said, errors) = with_key(home, key, &["run", &recipe, "--cell", "sim", "--part", part]);
        assert_eq!(code, 0, "{said}{errors}");
    }
    let number = |run: &PathBuf| {
        let first = Reader::open(run).unwrap().records(0).next().unwrap().unwrap().value();
        first["content"]["number"].as_u64().unwrap()
    };
    let mut runs = run_folders(&home.join("runs"));
    runs.sort_by_key(number);
    assert_eq!(runs.iter().map(number).collect::<Vec<_>>(), (1..=parts.len() as u64).collect::<Vec<_>>());
    runs
}

#[test]
fn audit_detects_removed_or_renamed_run() {
    let [home, elsewhere] = [(), ()].map(|()| tempfile::tempdir().unwrap());
    let (home, elsewhere) = (home.path(), elsewhere.path());
    let key = home.join("audit.key");
    assert_eq!(with_key(home, &key, &["audit", "key"]).0, 0);
    let runs = runs_of(home, &key, &["SN-1", "SN-2", "SN-3"]);
    let flaws = || -> Vec<String> {
        let (code, told, errors) = run(&["audit", "verify", "runs", "--json"], home);
        let told: Value = serde_json::from_str(&told).unwrap_or_else(|error| panic!("{error}: {told}{errors}"));
        let flaws: Vec<String> = serde_json::from_value(told["flaws"].clone()).unwrap();
        assert_eq!(code, i32::from(!flaws.is_empty()), "{told}{errors}");
        flaws
    };
    assert_eq!(flaws(), Vec::<String>::new(), "each names the signed one before");
    let aside = home.join("aside");
    // Removed.
    fs::rename(&runs[1], &aside).unwrap();
    assert!(flaws().iter().any(|flaw| flaw.contains("number 2 is missing")), "{:?}", flaws());
    // Another valid run with the same number in its place, signed with the same key.
    let others = runs_of(elsewhere, &key, &["SN-1", "SN-2"]);
    let in_its_place = home.join("runs").join("another");
    for (from, to) in [(&others[1], home.join("runs").join(others[1].file_name().unwrap())), (&others[1], in_its_place)]
    {
        fs::rename(from, &to).unwrap();
        let found = flaws();
        assert!(
            found.iter().any(|flaw| flaw.contains("this run comes before") || flaw.contains("this run differs from")),
            "{found:?}"
        );
        fs::rename(&to, from).unwrap();
    }
    // Renamed.
    fs::rename(&aside, home.join("runs").join("renamed")).unwrap();
    assert!(flaws().iter().any(|flaw| flaw.contains("its folder was renamed")), "{:?}", flaws());
    fs::rename(home.join("runs").join("renamed"), &runs[1]).unwrap();
    assert_eq!(flaws(), Vec::<String>::new());
    // An anchor belongs to one run.
    assert_eq!(run(&["audit", "verify", "runs", "--anchor", "runs"], home).0, 2);
    // A lock on the runs folder, held by anybody, does not block a run.
    let held = fs::File::open(home.join("runs")).unwrap();
    held.lock().unwrap();
    let recipe = small_recipe(home, 1e5).display().to_string();
    assert_eq!(with_key(home, &key, &["run", &recipe, "--cell", "sim", "--part", "SN-4"]).0, 0);
    held.unlock().unwrap();
    // A missing anchor is a flaw, no matter who holds the lock of the run.
    let lock = fs::File::options().read(true).write(true).open(runs[0].join(".lock")).unwrap();
    lock.lock().unwrap();
    fs::rename(runs[0].join("journal.anchor"), &aside).unwrap();
    assert!(flaws().iter().any(|flaw| flaw.contains("journal.anchor is missing")), "{:?}", flaws());
    lock.unlock().unwrap();
}
