//! Shipping of runs that are not as they should be: files that are missing, clocks that are wrong, runs that never come.
//! And of many runs that are whole at the plant already.

use std::fs;

use regrind::journal::{Reader, stamp};
use regrind_plant::{ReplicationResult, Replicator};
use serde_json::{Value, json};

use super::faults::{link, runtime};
use super::forged::{Forged, records, rewrite, set_clock};
use crate::program::{run, small_recipe};
use crate::{Plant, only_run};

const SHIP: [&str; 4] = ["ship", "--once", "--plant", "cell-1.toml"];

/// Lets the server log each statement of a cell.
fn log_statements(plant: &Plant) {
    plant.sql("ALTER ROLE cell_1 SET log_statement = 'all'");
}

/// Returns the number of statements of the cell that the server has logged.
fn statements(plant: &Plant) -> usize {
    plant.postgres.log().matches("LOG:  execute ").count()
}

/// Makes a part at the cell while there is no plant.
fn made_alone(plant: &Plant) -> (std::path::PathBuf, String) {
    let recipe = small_recipe(plant.home.path(), 1000.0).display().to_string();
    let (code, out, errors) = run(&["run", &recipe, "--cell", "sim", "--part", "SN-0042"], plant.home.path());
    assert_eq!(code, 0, "{out}{errors}");
    only_run(&plant.path("runs"))
}

/// Returns how many incidents tell of a file.
fn incidents_of(plant: &Plant, file: &str) -> String {
    plant.sql(&format!("SELECT count(*) FROM incident WHERE words LIKE '%file {file} %'"))
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn missing_file_ends_with_1_and_is_one_incident() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    let (folder, _) = made_alone(&plant);
    let [gone, other] = ["cycle-1/measured.csv", "recipe.toml"].map(|name| folder.join(name));
    let kept = [&gone, &other].map(|path| fs::read(path).unwrap());
    fs::remove_file(&gone).unwrap();
    fs::write(&other, "changed").unwrap();
    for _ in 0..3 {
        let (_, told) = plant.ends(&SHIP, 1);
        assert!(told.contains("cycle-1/measured.csv") && told.contains("recipe.toml"), "{told}");
        assert_eq!([incidents_of(&plant, "cycle-1/measured.csv"), incidents_of(&plant, "recipe.toml")], ["1", "1"]);
    }
    // The same file, with another flaw.
    fs::remove_file(&other).unwrap();
    plant.ends(&SHIP, 1);
    assert_eq!(incidents_of(&plant, "recipe.toml"), "1");
    for (path, content) in [gone, other].iter().zip(kept) {
        fs::write(path, content).unwrap();
    }
    plant.does(&SHIP);
    assert_eq!(plant.sql("SELECT count(*) FROM incident"), "2");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn rounds_with_missing_file_ask_nothing_again() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    let folder = plant.path("runs/run-1");
    let forged = Forged { files: &["a.csv"], ..Forged::named("run-1") };
    forged.write(&folder, 20);
    log_statements(&plant);
    runtime().block_on(async {
        let link = link(&plant, "cell-1").await;
        let mut replicator = Replicator::new(plant.path("runs"), None);
        let first = replicator.round(&link).await.unwrap();
        assert_eq!((first.files, first.differ.len()), (0, 1), "{first:?}");
        // Soon after a change of a file its stamp is not settled.
        loop {
            let before = statements(&plant);
            assert_eq!(replicator.round(&link).await.unwrap(), ReplicationResult::default());
            assert_eq!(statements(&plant), before);
            assert_eq!(replicator.lacking().count(), 1);
            if stamp(&folder) == stamp(&folder) {
                break;
            }
        }
        fs::write(folder.join("a.csv"), "hello").unwrap();
        assert_eq!(replicator.round(&link).await.unwrap().files, 1);
        assert_eq!(replicator.lacking().count(), 0);
    });
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn start_with_settled_runs_asks_once() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    log_statements(&plant);
    let make = |from: usize, to: usize, notes| {
        for k in from..to {
            let name = format!("run-{k}");
            Forged::named(&name).write(&plant.path("runs").join(&name), notes);
        }
        plant.does(&SHIP);
        let before = statements(&plant);
        plant.does(&SHIP);
        statements(&plant) - before
    };
    let of_two = make(0, 2, 3);
    let of_eight = make(2, 8, 200);
    assert_eq!(of_two, of_eight, "statements of a start with 2 short runs, and with 8 runs");
    assert!(of_two > 0);
    assert_eq!(plant.sql("SELECT count(*), bool_and(result = 'recovery') FROM run"), "8|t");
    // A record that is changed in the middle: ship compares the last record only, and the verification all of them.
    let journal = rusqlite::Connection::open(plant.path("runs/run-1/journal.sqlite")).unwrap();
    journal.execute_batch("DROP TRIGGER record_is_not_changed; UPDATE record SET reason = 'x' WHERE seq = 2").unwrap();
    drop(journal);
    plant.ends(&["audit", "verify", "runs/run-1", "--plant", "cell-1.toml"], 1);
    // A record that was chained anew has another last hash.
    rewrite(&plant.path("runs/run-2"), 2, |record| record.reason = "another".into());
    let (_, told) = plant.ends(&SHIP, 1);
    assert!(told.contains("run-2") && !told.contains("run-3"), "{told}");
    plant.ends(&SHIP, 1);
    assert_eq!(plant.sql("SELECT count(*) FROM incident WHERE what = 'a journal that differs'"), "1");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn plant_that_lost_records_gets_them_after_reconnection() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    Forged::named("run-1").write(&plant.path("runs/run-1"), 5);
    runtime().block_on(async {
        let mut replicator = Replicator::new(plant.path("runs"), None);
        let sent = replicator.round(&link(&plant, "cell-1").await).await.unwrap().records;
        // Restored from a backup that is older than the run.
        plant.sql("TRUNCATE record, run_artefact, cycle; DELETE FROM run");
        replicator.reconnected();
        let again = replicator.round(&link(&plant, "cell-1").await).await.unwrap();
        assert_eq!(again.records, sent);
    });
    assert_eq!(plant.sql("SELECT count(*) FROM record"), "7");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn wrong_clocks_stop_no_other_run() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    plant.somebody("office", "reader");
    let clocks = ["9999-12-31T23:59:59.999999999Z", "+10000-01-01T00:00:00Z", "2026-13-45T00:00:00Z", "no time"];
    for (k, utc) in clocks.iter().enumerate() {
        let name = format!("run-{k}");
        let folder = plant.path("runs").join(&name);
        Forged::named(&name).write(&folder, 1);
        set_clock(&folder, 1, utc);
    }
    Forged::named("run-8").write(&plant.path("runs/run-8"), 1);
    // Each arrives, and the wrong times are put down.
    plant.does(&SHIP);
    assert_eq!(plant.sql("SELECT string_agg(records::text, ' ') FROM run"), "3 3 3 3 3");
    let wrong = plant.sql("SELECT string_agg(run, ' ' ORDER BY run) FROM incident WHERE what = 'a wrong clock'");
    assert_eq!(wrong, "run-0 run-1 run-2 run-3");
    // They are listed by their arrival.
    let told = plant.does(&["plant", "runs", "--max-rows", "1", "--json", "--plant", "office.toml"]);
    assert_eq!(told.trim(), "[]", "recoveries are no parts");
    plant.sql("UPDATE run SET result = 'accepted' WHERE began IS NOT NULL");
    let all = plant.does(&["plant", "runs", "--plant", "office.toml"]);
    assert!(all.lines().count() == 5 && !all.contains("9999"), "{all}");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn journal_that_cannot_be_read_is_not_counted_as_shipped() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    Forged::named("run-1").write(&plant.path("runs/run-1"), 1);
    Forged::named("run-2").write(&plant.path("runs/run-2"), 1);
    fs::write(plant.path("runs/run-1/journal.sqlite"), "no database").unwrap();
    for _ in 0..2 {
        let (_, told) = plant.ends(&SHIP, 1);
        assert!(told.contains("run-1") && !told.contains("run-2:"), "{told}");
    }
    assert_eq!(plant.sql("SELECT name FROM run WHERE records > 0"), "run-2");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn record_rewritten_while_shipping_is_found() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    for name in ["run-1", "run-2"] {
        Forged::named(name).write(&plant.path("runs").join(name), 5);
    }
    runtime().block_on(async {
        let link = link(&plant, "cell-1").await;
        let mut replicator = Replicator::new(plant.path("runs"), None);
        assert_eq!(replicator.round(&link).await.unwrap().runs, 2);
        // Not chained anew: the last record is the same.
        let journal = rusqlite::Connection::open(plant.path("runs/run-1/journal.sqlite")).unwrap();
        let change = "DROP TRIGGER record_is_not_changed; UPDATE record SET reason = 'x' WHERE seq = 3";
        journal.execute_batch(change).unwrap();
        drop(journal);
        let differ = replicator.round(&link).await.unwrap().differ;
        assert!(differ.len() == 1 && differ[0].0 == "run-1" && differ[0].1.contains("record 3"), "{differ:?}");
        assert_eq!(replicator.skipped().map(|(run, _)| run).collect::<Vec<_>>(), ["run-1"]);
        assert_eq!(replicator.round(&link).await.unwrap(), ReplicationResult::default());
    });
    assert_eq!(plant.sql("SELECT run FROM incident WHERE what = 'a journal that differs'"), "run-1");
}

/// Content of a first record with a number and the run before it.
fn place(number: u64, before: Option<&str>) -> Value {
    let before = before.map(|run| json!({ "run": run, "records": 7, "head": "ab".repeat(32) }));
    json!({ "recover": true, "cell": "sim", "number": number, "before": before })
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn runs_that_never_came_are_listed() {
    let plant = Plant::new();
    for cell in ["cell-1", "cell-2"] {
        plant.cell(cell, &[]);
    }
    plant.somebody("office", "reader");
    let ship = |cell: &str, name: &str, content: Value| {
        assert_eq!(Forged { content, ..Forged::named(name) }.ship(&plant, cell), Ok(String::new()), "{name}");
    };
    let missing = ["plant", "runs", "--missing", "--plant", "office.toml"];
    ship("cell-1", "old", json!({ "recover": true, "cell": "sim" }));
    ship("cell-1", "a1", place(1, None));
    ship("cell-1", "a2", place(2, Some("a1")));
    // Another folder of the same cell, and the first one after it was restored from its backup.
    ship("cell-1", "b1", place(1, None));
    ship("cell-1", "b2", place(2, Some("b1")));
    ship("cell-1", "a2-restored", place(2, Some("a1")));
    plant.does(&missing);
    ship("cell-1", "a5", place(5, Some("a4")));
    ship("cell-2", "c2", place(2, Some("c1")));
    let lists = |with: &[&str], code| {
        let (out, _) = plant.ends(&[&missing[..], with].concat(), code);
        serde_json::from_str::<Value>(&out).unwrap()
    };
    let found = lists(&["--json"], 1);
    let gap = |cell: &str, numbers: [u64; 2], before: Value, after: &str, named: &str| json!({ "cell": cell, "first": numbers[0], "last": numbers[1], "after": before, "before": after, "named": named, "records": 7 });
    let [one, two] =
        [gap("cell-1", [3, 4], found[0]["after"].clone(), "a5", "a4"), gap("cell-2", [1, 1], Value::Null, "c2", "c1")];
    assert_eq!(found, json!([one, two]));
    assert!(["a2", "b2", "a2-restored"].contains(&found[0]["after"].as_str().unwrap()), "{found}");
    ship("cell-2", "c1", place(1, None));
    ship("cell-1", "a4", place(4, Some("a3")));
    ship("cell-1", "a3", place(3, Some("a2")));
    plant.does(&missing);
    // A person at a cell sees the runs of this cell alone.
    plant.does(&["plant", "runs", "--missing", "--plant", "cell-2.toml"]);
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn records_of_shipped_run_are_those_of_the_cell() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    let folder = plant.path("runs/run-1");
    // More than one batch, and a clock of the year 9999 that PostgreSQL takes.
    Forged::named("run-1").write(&folder, 1100);
    set_clock(&folder, 3, "9999-12-31T23:59:59.999999999Z");
    plant.does(&SHIP);
    let last = Reader::open(&folder).unwrap().last().unwrap().unwrap();
    assert_eq!(
        plant.sql("SELECT records, encode(head, 'hex') FROM run"),
        format!("{}|{}", records(&folder).len(), last.hash)
    );
}
