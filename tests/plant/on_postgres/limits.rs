//! A cell that brings too much, or something that would harm another cell: it is refused, counted, or has to wait.

use regrind::journal::{Record, RecordKind, sha256_hex};
use serde_json::Value;

use super::rights::{journal, ship};
use crate::Plant;

fn quota(plant: &Plant, setting: &str) {
    plant.does(&["plant", "quota", "--set", setting, "--plant", "owner.toml"]);
}

/// Returns the number of rows of incidents of a kind, and how often they happened.
fn counted(plant: &Plant, what: &str) -> String {
    plant.sql(&format!("SELECT count(*), coalesce(sum(times), 0) FROM incident WHERE what = '{what}'"))
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn oversized_state_is_refused() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    let tell = |bytes: usize| {
        let text = format!("SELECT tell_state('run-1', jsonb_build_object('words', repeat('x', {bytes})))");
        plant.asked_by("cell-1", &text).unwrap();
    };
    tell(1000);
    tell(100_000_000);
    assert_eq!(plant.sql("SELECT length(words) FROM cell_now"), "1000", "the last one stays");
    assert_eq!(counted(&plant, "a state refused"), "1|1");
    // The largest that is taken.
    quota(&plant, "state_bytes=2000");
    tell(2000 - "{\"words\": \"\"}".len());
    assert_eq!(plant.sql("SELECT octet_length(snapshot::text) FROM cell_now"), "2000");
    tell(2001);
    assert_eq!(plant.sql("SELECT octet_length(snapshot::text) FROM cell_now"), "2000");
    // The report of a run, and a record.
    let cycles = "SELECT tell_run(id, jsonb_build_object('cycles', (SELECT jsonb_agg(jsonb_build_object('cycle', n)) FROM generate_series(1, 1001) n))) FROM open_run('run-1')";
    plant.asked_by("cell-1", cycles).unwrap();
    plant.asked_by("cell-1", "SELECT tell_run(id, '{\"cycles\": 7}') FROM open_run('run-1')").unwrap();
    assert_eq!(counted(&plant, "a report refused"), "2|2");
    assert_eq!(plant.sql("SELECT count(*) FROM cycle"), "0");
    // A report replaces the one before; its texts are cut.
    for first in [1, 500] {
        let told = format!(
            "SELECT tell_run(id, jsonb_build_object('cycles', (SELECT jsonb_agg(jsonb_build_object('cycle', n, 'map', repeat('m', 5000))) FROM generate_series({first}, {first} + 2) n))) FROM open_run('run-1')"
        );
        plant.asked_by("cell-1", &told).unwrap();
        assert_eq!(plant.sql("SELECT min(cycle), count(*), max(length(map)) FROM cycle"), format!("{first}|3|300"));
    }
    let long = "SELECT refused FROM open_run('run-1') o CROSS JOIN LATERAL ship(o.id, 1, ARRAY['\\x00'::bytea], ARRAY[repeat('x', 9000000)])";
    assert!(plant.asked_by("cell-1", long).unwrap().contains("9000000 bytes"));
    quota(&plant, "file_bytes=10");
    let file = "SELECT give_artefact(sha256(c), c) FROM (SELECT convert_to(repeat('x', {}), 'UTF8') AS c) of";
    let give = |bytes: &str| plant.asked_by("cell-1", &file.replace("{}", bytes)).unwrap();
    assert_eq!((give("10"), give("11")), ("t".into(), "f".into()));
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn flood_of_incidents_is_counted() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    plant.cell("cell-2", &[]);
    quota(&plant, "incidents_per_day=5");
    // Each in a transaction of its own, as a program that repeats itself.
    let flood = |by: &str, what: &str, times: usize| {
        plant
            .asked_by(
                by,
                &format!(
                    "DO $$ BEGIN FOR n IN 1..{times} LOOP PERFORM complain('run', '{what}', {{}}); END LOOP; END $$"
                )
                .replace("{}", if what == "same" { "'words'" } else { "'words ' || n" }),
            )
            .unwrap();
    };
    flood("cell-1", "same", 1000);
    assert_eq!(counted(&plant, "same"), "1|1000");
    flood("cell-1", "other", 1000);
    assert_eq!(counted(&plant, "other"), "4|4");
    assert_eq!(counted(&plant, "too many incidents"), "1|996", "each is counted");
    // One that is known counts, and another cell has a quota of its own.
    flood("cell-1", "same", 1);
    assert_eq!(counted(&plant, "same"), "1|1001");
    flood("cell-2", "another", 2);
    assert_eq!(counted(&plant, "another"), "2|2");
    // Two cells that say the same are two.
    flood("cell-2", "same", 1);
    assert_eq!(counted(&plant, "same"), "2|1002");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn used_up_quota_makes_cell_wait() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    plant.somebody("planner", "planner");
    let count = journal(&plant, "runs", "run-1", "SN-1").len() + journal(&plant, "runs", "run-2", "SN-2").len();
    quota(&plant, "runs_per_day=1");
    let once = ["ship", "--once", "--plant", "cell-1.toml"];
    let (_, told) = plant.ends(&once, 3);
    assert!(told.contains("begun to send 1 runs today"), "{told}");
    assert_eq!(plant.sql("SELECT count(*) FROM run"), "1");
    quota(&plant, "runs_per_day=2");
    quota(&plant, "bytes_per_day=100");
    plant.ends(&once, 3);
    quota(&plant, "bytes_per_day=1000000");
    plant.does(&once);
    assert_eq!(plant.sql("SELECT count(*) FROM record"), count.to_string(), "nothing is lost");
    // Only the owner changes a quota; planners see it.
    let by_planner = ["plant", "quota", "--set", "runs_per_day=9", "--plant", "planner.toml"];
    plant.ends(&by_planner, 2);
    let listed: Value =
        serde_json::from_str(&plant.does(&["plant", "quota", "--json", "--plant", "planner.toml"])).unwrap();
    let runs = listed.as_array().unwrap().iter().find(|of| of["name"] == "runs_per_day").unwrap();
    assert_eq!(runs["most"], 2);
    plant.ends(&["plant", "quota", "--set", "nothing=1", "--plant", "owner.toml"], 1);
    for bad in ["runs_per_day=0", "runs_per_day", "runs_per_day=x"] {
        plant.ends(&["plant", "quota", "--set", bad, "--plant", "owner.toml"], 2);
    }
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn stated_place_keeps_no_content_out() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    plant.cell("cell-2", &[]);
    let records = journal(&plant, "runs", "run-1", "SN-1");
    let file = records.iter().find(|record| record.kind == RecordKind::Artefact).unwrap().value();
    // Another cell says first that this file lies in the folder of the plant, where it is not.
    let place = format!("SELECT place_artefact(decode('{}', 'hex'), 77)", file["sha256"].as_str().unwrap());
    assert_eq!(plant.asked_by("cell-2", &place).unwrap(), "t");
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    let stored = plant.sql("SELECT octet_length(content), bytes FROM artefact");
    assert_eq!(stored, format!("{0}|{0}", file["bytes"]));
    let proven = plant.does(&["audit", "verify", "run-1", "--plant", "owner.toml"]);
    assert!(proven.contains("1 files"), "{proven}");
    // To state a place is not to have the content.
    assert_eq!(plant.asked_by("cell-2", "SELECT count(*) FROM record").unwrap(), "0");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn long_names_are_cut_and_connections_are_few() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    let long = "n".repeat(100_000);
    journal(&plant, "runs", "run-1", &long);
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    assert_eq!(plant.sql("SELECT length(part), records > 8 FROM run"), "300|t");
    plant.does(&["audit", "verify", "run-1", "--plant", "cell-1.toml"]);
    assert_eq!(plant.sql("SELECT rolconnlimit FROM pg_roles WHERE rolname = 'cell_1'"), "12");
}

/// Returns the records with other times, in their own chain.
fn at(records: &[Record], utc: &str) -> Vec<Record> {
    let mut head = "0".repeat(64);
    let again = records.iter().filter(|record| record.kind != RecordKind::Seal).enumerate().map(|(k, of)| {
        let mut record = Record { seq: k as u64 + 1, utc: utc.into(), prev_hash: head.clone(), ..of.clone() };
        record.hash = sha256_hex(format!("regrind journal record 1\n{head}\n{}", record.text()).as_bytes());
        head.clone_from(&record.hash);
        record
    });
    again.collect()
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn wrong_clock_does_not_hide_other_runs() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    let clocks = [
        ("9999-12-31T23:59:59.999999Z", false),
        ("1970-01-01T00:00:00.000000Z", false),
        ("+12026-01-01T00:00:00Z", false),
        ("294277-01-01T00:00:00Z", false),
        ("yesterday?", false),
        ("", false),
        ("2026-01-01T00:00:00.000000Z", true),
    ];
    for (k, (utc, is_kept)) in clocks.into_iter().enumerate() {
        let name = format!("run-{k}");
        let records = at(&journal(&plant, "elsewhere", &name, "SN-1"), utc);
        let run = plant.asked_by("cell-1", &format!("SELECT id FROM open_run('{name}')")).unwrap();
        assert_eq!(plant.asked_by("cell-1", &ship(&run, 1, &records)).unwrap(), format!("{}|", records.len()), "{utc}");
        let shown = plant.sql(&format!(
            "SELECT began = arrived_at, ended = arrived_at, began = '2026-01-01 00:00:00+00' FROM run WHERE id = {run}"
        ));
        assert_eq!(shown, if is_kept { "f|f|t" } else { "t|t|f" }, "{utc}");
        let incidents =
            plant.sql(&format!("SELECT count(*) FROM incident WHERE what = 'a wrong clock' AND run = '{name}'"));
        assert_eq!(incidents, if is_kept { "0" } else { "1" }, "{utc}");
    }
    // The record itself keeps what it says.
    assert_eq!(plant.sql("SELECT text::json ->> 'utc' FROM record WHERE run = 1 AND seq = 1"), clocks[0].0);
}
