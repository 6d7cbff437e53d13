//! Work orders and their recipes, between planners, approvers, cells, and attackers who want a part to be made by
//! another recipe.

use std::fs;
use std::process::Stdio;

use regrind::journal::{Entry, Header, Journal, RecordKind};
use serde_json::{Value, json};

use crate::Plant;
use crate::program::{Running, regrind, small_recipe};

/// Sets up a plant with two approvers, a planner and a recipe that both have signed; returns the table of approvers for
/// plant files.
fn approved(plant: &Plant) -> String {
    plant.somebody("planner", "planner");
    let recipe = small_recipe(plant.home.path(), 1000.0).display().to_string();
    plant.does(&["plant", "propose", &recipe, "--plant", "planner.toml"]);
    ["Ada", "Bob"].map(|person| approves(plant, person, "small")).concat()
}

/// Signs a recipe as a person; returns the person's entry for a plant file.
pub fn approves(plant: &Plant, person: &str, recipe: &str) -> String {
    let file = format!("{person}.key");
    let told: Value = serde_json::from_str(&plant.does(&["audit", "key", "--key", &file, "--json"])).unwrap();
    plant.does(&["plant", "approve", recipe, "--person", person, "--key", &file, "--plant", "planner.toml"]);
    format!("\n[[approver]]\nname = \"{person}\"\nkey = {}\n", told["public_key"])
}

/// Enrols a cell that knows approvers.
fn cell(plant: &Plant, name: &str, approvers: &str) {
    plant.cell(name, &[]);
    let file = plant.path(&format!("{name}.toml"));
    let text = fs::read_to_string(&file).unwrap();
    fs::write(file, text + approvers).unwrap();
}

fn queue(plant: &Plant, serial: &str, more: &[&str]) {
    plant.does(&[&["plant", "queue", serial, "--recipe", "small", "--plant", "planner.toml"], more].concat());
}

fn work(plant: &Plant) -> Vec<Value> {
    serde_json::from_str(&plant.does(&["plant", "work", "--json", "--plant", "planner.toml"])).unwrap()
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn queue_runs_parts_by_due_date() {
    let plant = Plant::new();
    let approvers = approved(&plant);
    cell(&plant, "cell-1", &approvers);
    queue(&plant, "SN-3", &[]);
    queue(&plant, "SN-2", &["--due", "2027-02-01"]);
    queue(&plant, "SN-1", &["--due", "2027-01-01"]);
    queue(&plant, "SN-0", &["--cell", "cell-1", "--due", "2026-12-01"]);
    let (_, told) = plant.ends(&["plant", "queue", "SN-1", "--recipe", "small", "--plant", "planner.toml"], 2);
    for piece in ["part SN-1", "in the queue"] {
        assert!(told.contains(piece), "{piece}: {told}");
    }
    let (_, told) =
        plant.ends(&["plant", "queue", "SN-9", "--recipe", "small", "--cell", "cell-9", "--plant", "planner.toml"], 2);
    assert!(told.contains("there is no cell cell-9"), "{told}");

    // By serial number on the command line, by typed input, and by wrong typed input.
    let said = plant.does(&["work", "--plant", "cell-1.toml", "--part", "SN-0", "--once"]);
    let offered = said.lines().find(|line| line.starts_with("SN-0  ")).unwrap_or_else(|| panic!("{said}"));
    for piece in ["version 1", "small", "Ada and Bob", "2026-12-01"] {
        assert!(offered.contains(piece), "{piece}: {offered}");
    }
    for (typed, does, ends) in
        [("SN-2", "the part is given back", 1), ("", "the part is given back", 1), ("SN-1", "record in", 0)]
    {
        let mut command = regrind(&["work", "--plant", "cell-1.toml", "--once"], plant.home.path());
        command.stdin(Stdio::piped());
        let mut at_cell = Running::new(command);
        at_cell.line("part", |line| line.starts_with("SN-1  ") && line.contains("version 1"));
        std::io::Write::write_all(&mut at_cell.keys(), format!("{typed}\n").as_bytes()).unwrap();
        let (code, told) = at_cell.end();
        assert!(
            code == ends && at_cell.output_lines.iter().any(|line| line.contains(does)),
            "{typed}: {told} {:?}",
            at_cell.output_lines
        );
    }
    plant.does(&["plant", "unqueue", "2", "--reason", "broken", "--plant", "planner.toml"]);
    plant.ends(&["plant", "unqueue", "3", "--why", "broken", "--plant", "planner.toml"], 1);
    let left: Vec<_> = work(&plant).into_iter().filter(|part| part["state"] == "open").collect();
    assert!(left.len() == 1 && left[0]["serial"] == "SN-3", "{left:?}");
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    assert_eq!(
        plant.sql("SELECT string_agg(serial || ' ' || state, ', ' ORDER BY serial) FROM work"),
        "SN-0 ended, SN-1 ended, SN-2 withdrawn, SN-3 open"
    );
    assert_eq!(
        plant.sql(
            "SELECT count(*) FROM work w JOIN run r ON r.name = w.run WHERE r.part = w.serial AND r.result = 'accepted'"
        ),
        "2"
    );
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn queue_runs_without_confirmation() {
    let plant = Plant::new();
    plant.somebody("planner", "planner");
    let recipe = small_recipe(plant.home.path(), 1000.0);
    let text = fs::read_to_string(&recipe).unwrap();
    assert!(text.contains("\n[cycle]\n"));
    fs::write(&recipe, text.replace("\n[cycle]\n", "\n[cycle]\nconfirm_work = false\n")).unwrap();
    plant.does(&["plant", "propose", "small.toml", "--plant", "planner.toml"]);
    let approvers = ["Ada", "Bob"].map(|person| approves(&plant, person, "small")).concat();
    cell(&plant, "cell-1", &approvers);
    ["SN-1", "SN-2"].iter().for_each(|serial| queue(&plant, serial, &[]));
    let said = plant.does(&["work", "--plant", "cell-1.toml"]);
    assert!(said.lines().last().unwrap_or_default().contains("no part is waiting"), "{said}");
    assert_eq!(plant.sql("SELECT count(*) FROM work WHERE state IN ('begun', 'ended')"), "2");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn unsigned_recipe_refused_as_incident() {
    let plant = Plant::new();
    let approvers = approved(&plant);
    cell(&plant, "cell-1", &approvers);
    let make = ["work", "--plant", "cell-1.toml", "--part", "SN-1", "--once"];
    let refused = |pieces: &[&str]| {
        let before = plant.incidents().len();
        let (_, told) = plant.ends(&make, 2);
        for piece in pieces {
            assert!(told.contains(*piece), "{piece}: {told}");
        }
        let incidents = plant.incidents();
        let last = incidents.last().unwrap();
        assert!(incidents.len() > before && last["what"] == "recipe refused" && last["by"] == "cell-1", "{last}");
    };
    // Nobody can propose an old recipe under a new name, or sign twice.
    let again = ["plant", "propose", "small.toml", "--name", "panel", "--plant", "planner.toml"];
    let (_, told) = plant.ends(&again, 2);
    for piece in ["panel", "version 1 of small"] {
        assert!(told.contains(piece), "{piece}: {told}");
    }
    assert_eq!(plant.incidents().last().unwrap()["what"], "recipe refused");
    let (_, told) =
        plant.ends(&["plant", "approve", "small", "--person", "Ada", "--key", "Bob.key", "--plant", "planner.toml"], 2);
    for piece in ["version 1 of small", "already signed by Bob with this key", "--replace"] {
        assert!(told.contains(piece), "{piece}: {told}");
    }

    // An attacker with all rights in the database gives an old recipe a new name, changes a text, and forges a
    // signature.
    queue(&plant, "SN-1", &[]);
    plant.sql("CREATE TABLE kept AS SELECT * FROM recipe; ALTER TABLE recipe DROP CONSTRAINT recipe_check");
    for (harm, named) in [
        ("name = 'panel'", "version 1 of panel"),
        ("version = 7", "version 7 of small"),
        ("text = replace(text, 'columns = 16', 'columns = 17')", "version 1 of small"),
    ] {
        plant.sql(&format!("UPDATE recipe SET {harm}"));
        refused(&[named, "hash", "was changed"]);
        plant.sql("UPDATE recipe r SET (name, version, text) = (SELECT k.name, k.version, k.text FROM kept k)");
    }
    plant.sql("UPDATE approval SET signature = repeat('ab', 64) WHERE person = 'Bob'");
    refused(&["version 1 of small", "is signed by Ada of", "two signatures"]);
    let listed = plant.does(&["plant", "recipes", "--plant", "planner.toml"]);
    assert!(listed.contains("signed by Ada; WRONG SIGNATURE of Bob"), "{listed}");
    let json: Value =
        serde_json::from_str(&plant.does(&["plant", "recipes", "--json", "--plant", "planner.toml"])).unwrap();
    assert_eq!([&json[0]["signed_by"], &json[0]["wrong_signatures"]], [&json!(["Ada"]), &json!(["Bob"])]);
    let queue = ["plant", "queue", "SN-2", "--recipe", "small", "--plant", "planner.toml"];
    let (_, told) = plant.ends(&queue, 2);
    assert!(told.contains("has 1 of the 2 required signatures, and 1 wrong"), "{told}");
    // A cell that knows only one of the two approvers.
    let one = approvers.split("\n[[approver]]").nth(1).unwrap();
    cell(&plant, "cell-2", &format!("\n[[approver]]{one}"));
    plant.ends(&["work", "--plant", "cell-2.toml", "--once", "--part", "SN-1"], 2);
    // The part remains available to a cell that is allowed to make it, and nobody has begun it.
    assert_eq!(work(&plant)[0]["state"], "open");
    plant.does(&["plant", "withdraw", "small", "--version", "1", "--reason", "wrong wheel", "--plant", "planner.toml"]);
    let said = plant.does(&make);
    assert!(said.contains("no part is waiting"), "{said}");
    let (_, told) = plant.ends(&["plant", "propose", "small.toml", "--name", "panel", "--plant", "planner.toml"], 2);
    for piece in ["panel", "version 1 of small", "withdrawn: wrong wheel"] {
        assert!(told.contains(piece), "{piece}: {told}");
    }
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn expired_lease_is_refused() {
    let plant = Plant::new();
    let approvers = approved(&plant);
    ["cell-1", "cell-2"].iter().for_each(|name| cell(&plant, name, &approvers));
    queue(&plant, "SN-1", &[]);
    let by = |cell: &str, text: &str| plant.asked_by(cell, text).unwrap();
    assert_eq!(by("cell-1", "SELECT id, lease FROM take_work(60)"), "1|1");
    assert_eq!(by("cell-2", "SELECT id FROM take_work(60)"), "", "it is leased");
    plant.sql("UPDATE work SET leased_until = now() - interval '1 second'");
    assert!(by("cell-1", "SELECT begin_work(1, 1, 'run-1')").contains("its lease ended at"));
    assert_eq!(by("cell-2", "SELECT id, lease FROM take_work(60)"), "1|2");
    // A replay of the old lease, and of that of the other cell.
    for (cell, lease) in [("cell-1", 1), ("cell-1", 2), ("cell-2", 1)] {
        for step in ["begin_work(1, {}, 'run-1')", "renew_work(1, {}, 60)", "return_work(1, {}, 'why')"] {
            let before = plant.incidents().len();
            let said = by(cell, &format!("SELECT {}", step.replace("{}", &lease.to_string())));
            assert!(said.contains("its lease is over"), "{cell} {step}: {said}");
            let incidents = plant.incidents();
            assert!(
                incidents.len() == before + 1
                    && incidents[before]["what"] == "work refused"
                    && incidents[before]["by"] == *cell
            );
        }
    }
    for _ in 0..2 {
        assert_eq!(by("cell-2", "SELECT begin_work(1, 2, 'run-1')"), "", "the same again has the same answer");
    }
    assert!(by("cell-2", "SELECT begin_work(1, 2, 'run-2')").contains("begun, by run run-1"));
    assert!(by("cell-1", "SELECT begin_work(99, 1, 'run-1')").contains("there is no such part"));
    plant.sql("UPDATE work SET leased_until = now() - interval '1 day'");
    assert_eq!(by("cell-1", "SELECT id FROM take_work(60)"), "", "what was begun belongs to its run");

    // The cell died before the run began: it takes no more parts until a person has checked.
    let make = ["work", "--plant", "cell-2.toml", "--part", "SN-1", "--once"];
    let (_, told) = plant.ends(&make, 1);
    for piece in ["SN-1", "run run-1", "no record in runs"] {
        assert!(told.contains(piece), "{piece}: {told}");
    }
    plant.ends(&["work", "--plant", "cell-1.toml", "--give-back", "SN-1"], 1);
    plant.does(&["work", "--plant", "cell-2.toml", "--give-back", "SN-1"]);
    plant.does(&make);
    let run = plant.sql("SELECT run FROM work");
    // Its run has begun: nobody can return the part.
    plant.does(&["ship", "--once", "--plant", "cell-2.toml"]);
    plant.sql("UPDATE work SET state = 'begun'");
    let said = by("cell-2", &format!("SELECT give_back_work(1, '{run}', 'why')"));
    for piece in ["give back of part 1", &run] {
        assert!(said.contains(piece), "{piece}: {said}");
    }
    assert_eq!(plant.incidents().last().unwrap()["what"], "work refused");
}

/// Simulates a part that cell-1 has begun in a run whose program died, with this number of events on record.
fn begun_and_died(plant: &Plant, run: &str, events: usize) {
    assert_eq!(
        plant
            .asked_by("cell-1", "SELECT begin_work(id, lease, '{}') FROM take_work(60)".replace("{}", run).as_str())
            .unwrap(),
        ""
    );
    let header = Header {
        run: run.into(),
        part: "SN-1".into(),
        actor: "Ada".into(),
        station: "console".into(),
        simulation: true,
        first_command_id: 1,
        content: json!({}),
    };
    let mut journal = Journal::create(plant.path("runs").join(run), header).unwrap();
    for k in 0..events {
        journal.append(Entry::new(RecordKind::Event, k as u64, 1, json!({ "event": "start" }))).unwrap();
    }
    drop(journal);
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn dead_run_does_not_block_queue() {
    let plant = Plant::new();
    let approvers = approved(&plant);
    cell(&plant, "cell-1", &approvers);
    queue(&plant, "SN-1", &[]);
    let make = ["work", "--plant", "cell-1.toml", "--part", "SN-1", "--once"];
    let back = ["work", "--plant", "cell-1.toml", "--give-back", "SN-1"];
    let up = ["work", "--plant", "cell-1.toml", "--give-up", "SN-1", "--reason", "its program is gone"];
    // No request was sent to a machine: the part is unchanged.
    begun_and_died(&plant, "run-1", 0);
    let (_, told) = plant.ends(&make, 1);
    for piece in ["run run-1", "no request", "--give-back SN-1"] {
        assert!(told.contains(piece), "{piece}: {told}");
    }
    plant.does(&back);
    assert_eq!(work(&plant)[0]["state"], "open");
    // A request was sent: the part belongs to this run for good. A planner decides whether it is made again.
    begun_and_died(&plant, "run-2", 3);
    let (_, told) = plant.ends(&make, 1);
    for piece in ["run run-2 of SN-1", "regrind resume", "--give-up SN-1"] {
        assert!(told.contains(piece), "{piece}: {told}");
    }
    let (_, told) = plant.ends(&back, 1);
    for piece in ["SN-1", "run run-2", "has a record here"] {
        assert!(told.contains(piece), "{piece}: {told}");
    }
    let said = plant.asked_by("cell-1", "SELECT give_back_work(1, 'run-2', 'why')").unwrap();
    for piece in ["give back of part 1", "run run-2"] {
        assert!(said.contains(piece), "{piece}: {said}");
    }
    assert_eq!(plant.incidents().last().unwrap()["what"], "work refused");
    plant.does(&up);
    assert_eq!(plant.sql("SELECT state || ' ' || run FROM work"), "ended run-2");
    assert_eq!(plant.sql("SELECT words FROM work_step WHERE step = 'given up'"), "its program is gone");
    assert!(plant.does(&make).contains("no part is waiting"));
    plant.ends(&up, 1);
    queue(&plant, "SN-1", &[]);
    plant.does(&make);
}

/// A part that is due first has a recipe that this cell cannot prove: it makes the next one. The others are not held up by
/// a cell that leases all parts.
#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn unprovable_part_and_hoarder_hold_nobody_up() {
    let plant = Plant::new();
    let approvers = approved(&plant);
    cell(&plant, "cell-1", &approvers);
    cell(&plant, "cell-2", &approvers);
    fs::write(plant.path("panel.toml"), fs::read_to_string(plant.path("small.toml")).unwrap() + "\n# another one\n")
        .unwrap();
    plant.does(&["plant", "propose", "panel.toml", "--plant", "planner.toml"]);
    ["Ada", "Eve"].iter().for_each(|person| drop(approves(&plant, person, "panel")));
    let panel = ["plant", "queue", "SN-1", "--recipe", "panel", "--due", "2027-01-01", "--plant", "planner.toml"];
    plant.does(&panel);
    queue(&plant, "SN-2", &[]);
    let state = |serial: &str| plant.sql(&format!("SELECT state FROM work WHERE serial = '{serial}'"));
    let make = ["work", "--plant", "cell-1.toml", "--once", "--part", "SN-2"];
    plant.does(&make);
    assert_eq!([state("SN-1"), state("SN-2")], ["open", "ended"]);
    // With nothing else in the queue the refusal is told, and is tried again after another signature.
    let (_, told) = plant.ends(&["work", "--plant", "cell-1.toml", "--once", "--part", "SN-1"], 2);
    assert!(told.contains("version 1 of panel"), "{told}");
    approves(&plant, "Bob", "panel");
    plant.does(&["work", "--plant", "cell-1.toml", "--once", "--part", "SN-1"]);
    assert_eq!(state("SN-1"), "ended");

    for k in 3..9 {
        queue(&plant, &format!("SN-{k}"), &[]);
    }
    for k in 1..=3 {
        assert_ne!(plant.asked_by("cell-2", "SELECT id FROM take_work(86400)").unwrap(), "", "{k}");
    }
    let refused = plant.asked_by("cell-2", "SELECT id FROM take_work(86400)").unwrap_err();
    assert!(refused.contains("has 3 parts leased"), "{refused}");
    plant.does(&["work", "--plant", "cell-1.toml", "--once", "--part", "SN-6"]);
    assert_eq!(state("SN-6"), "ended");

    // A run that cannot begin, such as that of a second program, gives its part back at once.
    plant.ends(&["work", "--plant", "cell-1.toml", "--once", "--part", "SN-7", "--cell", "nowhere.toml"], 2);
    assert_eq!(state("SN-7"), "open");
}

/// A name that was typed wrongly is replaced, and costs no version.
#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn wrong_name_of_signer_is_replaced() {
    let plant = Plant::new();
    let approvers = approved(&plant);
    cell(&plant, "cell-1", &approvers);
    fs::write(plant.path("panel.toml"), fs::read_to_string(plant.path("small.toml")).unwrap() + "\n# another one\n")
        .unwrap();
    plant.does(&["plant", "propose", "panel.toml", "--plant", "planner.toml"]);
    let sign = |person: &str, key: &str, more: &[&str]| {
        let file = format!("{key}.key");
        let arguments = ["plant", "approve", "panel", "--person", person, "--key", &file, "--plant", "planner.toml"];
        crate::run(&[&arguments[..], more].concat(), plant.home.path()).0
    };
    // Bob signs as Ada, which keeps Ada out until one of them says that the other name was wrong.
    assert_eq!(sign("Ada", "Bob", &[]), 0);
    assert_eq!(sign("Ada", "Bob", &["--replace"]), 2, "the same again");
    assert_eq!(sign("Ada", "Ada", &[]), 2);
    let queue = || plant_queue(&plant, "SN-1", "panel");
    assert_eq!(queue(), 2, "one signature");
    assert_eq!(sign("Ada", "Ada", &["--replace"]), 0);
    assert_eq!(queue(), 2, "two keys, and one name");
    assert_eq!(sign("Bob", "Bob", &[]), 2);
    assert_eq!(sign("Bob", "Bob", &["--replace"]), 0);
    assert_eq!(plant.sql("SELECT person || ' ' || length(signature) FROM approval_replaced"), "Ada 128");
    assert_eq!(plant.sql("SELECT count(*) FROM incident WHERE what = 'a signature replaced'"), "1");
    assert_eq!(queue(), 0);
    plant.does(&["work", "--plant", "cell-1.toml", "--part", "SN-1", "--once"]);
}

fn plant_queue(plant: &Plant, serial: &str, recipe: &str) -> i32 {
    crate::run(&["plant", "queue", serial, "--recipe", recipe, "--plant", "planner.toml"], plant.home.path()).0
}

/// The parts of a recipe that is withdrawn leave the queue, and its text can come back as another version.
#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn withdrawn_recipe_can_come_back() {
    let plant = Plant::new();
    let approvers = approved(&plant);
    cell(&plant, "cell-1", &approvers);
    ["SN-1", "SN-2", "SN-3"].iter().for_each(|serial| queue(&plant, serial, &[]));
    assert_eq!(plant.asked_by("cell-1", "SELECT serial FROM take_work(60)").unwrap(), "SN-1");
    assert_eq!(plant.asked_by("cell-1", "SELECT begin_work(1, 1, 'run-1')").unwrap(), "");
    assert_eq!(plant.asked_by("cell-1", "SELECT serial FROM take_work(60)").unwrap(), "SN-2");
    let withdraw =
        ["plant", "withdraw", "small", "--version", "1", "--reason", "wrong wheel", "--plant", "planner.toml"];
    let said = plant.does(&withdraw);
    assert!(said.contains("2 parts left the queue") && said.ends_with("  SN-2\n  SN-3\n"), "{said}");
    plant.ends(&withdraw, 1);
    // The leased one is refused at its beginning; the begun one belongs to its run.
    assert!(plant.asked_by("cell-1", "SELECT begin_work(2, 1, 'run-2')").unwrap().contains("it was withdrawn"));
    let states = "SELECT string_agg(serial || ' ' || state, ', ' ORDER BY id) FROM work";
    assert_eq!(plant.sql(states), "SN-1 begun, SN-2 withdrawn, SN-3 withdrawn");
    assert_eq!(plant.sql("SELECT count(*) FROM work_step WHERE step = 'withdrawn'"), "2");
    // One that is given back now would wait for ever.
    assert_eq!(plant.asked_by("cell-1", "SELECT give_back_work(1, 'run-1', 'why')").unwrap(), "");
    assert_eq!(plant.sql("SELECT state FROM work WHERE id = 1"), "withdrawn");

    plant.does(&["plant", "propose", "small.toml", "--plant", "planner.toml"]);
    assert_eq!(plant_queue(&plant, "SN-2", "small"), 2, "the earlier signatures do not count");
    for person in ["Ada", "Bob"] {
        let key = format!("{person}.key");
        plant.does(&["plant", "approve", "small", "--person", person, "--key", &key, "--plant", "planner.toml"]);
    }
    queue(&plant, "SN-2", &[]);
    assert_eq!(work(&plant).iter().filter(|part| part["version"] == 2).count(), 1);
    // The same text is proposed once while it is in force.
    plant.ends(&["plant", "propose", "small.toml", "--plant", "planner.toml"], 2);
}
