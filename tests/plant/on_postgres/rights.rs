//! A cell account as an attacker on the plant: what it can read, and the results of its attempts.

use std::fs;

use regrind::journal::{AuditKey, Entry, Header, Journal, Reader, Record, RecordKind};
use serde_json::{Value, json};

use crate::Plant;

/// Text that ends an SQL string, and begins another statement.
const SQL: &str = "x'); DROP TABLE regrind.record CASCADE; --\" \\ $$ {} % \u{1}";

/// Writes a journal of a few records below a folder of runs.
pub fn journal(plant: &Plant, runs: &str, name: &str, part: &str) -> Vec<Record> {
    let folder = plant.path(runs).join(name);
    let header = Header {
        run: name.into(),
        part: part.into(),
        actor: SQL.into(),
        station: "console".into(),
        simulation: true,
        first_command_id: 1,
        content: json!({ "recipe": SQL, "recipe_sha256": "00", "part_name": SQL }),
    };
    let mut journal = Journal::create_with(&folder, header, Some(AuditKey::new())).unwrap();
    journal.store("cycle-1/points.csv", SQL.as_bytes(), 1, 1).unwrap();
    for k in 0..6 {
        journal.append(Entry::new(RecordKind::Note, k, 1, json!({ "said": SQL, "k": k }))).unwrap();
    }
    journal.close(10, 1, json!(SQL)).unwrap();
    Reader::open(&folder).unwrap().records(1).map(Result::unwrap).collect()
}

/// Returns the call that ships records, as written by hand.
pub fn ship(run: &str, from: u64, records: &[Record]) -> String {
    let hashes: Vec<String> = records.iter().map(|r| format!("decode('{}', 'hex')", r.hash)).collect();
    let texts: Vec<String> =
        records.iter().map(|r| format!("convert_from(decode('{}', 'hex'), 'UTF8')", hex(&r.text()))).collect();
    let [hashes, texts] = [hashes.join(","), texts.join(",")];
    format!("SELECT records, refused FROM ship({run}, {from}, ARRAY[{hashes}]::bytea[], ARRAY[{texts}]::text[])")
}

fn hex(text: &str) -> String {
    text.bytes().map(|byte| format!("{byte:02x}")).collect()
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn cell_account_reads_only_its_own() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    plant.cell("cell-2", &[]);
    let of_1 = journal(&plant, "runs-1", "run-1", "SN-1");
    journal(&plant, "runs-2", "run-2", "SN-2");
    for cell in ["1", "2"] {
        plant.does(&["ship", "--once", "--plant", &format!("cell-{cell}.toml"), "--runs", &format!("runs-{cell}")]);
    }
    let all = 2 * of_1.len();
    assert_eq!(plant.sql("SELECT count(*) FROM record"), all.to_string());
    let tables = [
        "cell",
        "cell_key",
        "run",
        "record",
        "cycle",
        "run_artefact",
        "artefact",
        "artefact_of",
        "cell_state",
        "incident",
        "work",
        "lesson",
    ];
    for table in tables {
        let seen = plant.asked_by("cell-2", &format!("SELECT * FROM {table}")).unwrap();
        assert!(!seen.contains("SN-1") && !seen.contains("run-1") && !seen.contains("cell-1"), "{table}: {seen}");
        for change in [
            "DELETE FROM {}",
            "TRUNCATE {}",
            "INSERT INTO {} DEFAULT VALUES",
            "DROP TABLE {}",
            "ALTER TABLE {} DISABLE ROW LEVEL SECURITY",
        ] {
            let change = change.replace("{}", table);
            let refused = plant.asked_by("cell-2", &change).unwrap_err();
            assert!(refused.contains("permission denied") || refused.contains("must be owner"), "{change}: {refused}");
        }
    }
    assert_eq!(plant.asked_by("cell-2", "SELECT count(*) FROM record").unwrap(), of_1.len().to_string());
    let tries = [
        "SELECT * FROM recipe",
        "SELECT * FROM approval",
        "SELECT * FROM work_step",
        "SELECT * FROM part_run",
        "UPDATE record SET text = ''",
        "UPDATE run SET cell = 1",
        "UPDATE incident SET words = ''",
        "SET ROLE owner",
        "SET ROLE cell_1",
        "SET SESSION AUTHORIZATION cell_1",
        "ALTER ROLE cell_2 SUPERUSER",
        "GRANT regrind_reader TO cell_2",
        "CREATE TABLE regrind.mine (a int)",
        "CREATE FUNCTION regrind.own_cell2() RETURNS int LANGUAGE sql AS 'SELECT 1'",
        "SELECT flaw_of(NULL, 1, NULL, NULL)",
        "SELECT told_by(NULL, NULL)",
        "SELECT queue_work('SN', '', NULL, NULL)",
        "SELECT sign_recipe('', 'Ada', '', '', true)",
        "SELECT set_quota('runs_per_day', 1)",
        "SELECT count_usage(1, 1, 1)",
        "SELECT * FROM quota",
        "SELECT * FROM cell_usage",
        "SELECT leave_queue('')",
        "SELECT pg_read_file('/etc/passwd')",
        "COPY record FROM PROGRAM 'true'",
    ];
    for text in tries {
        assert!(plant.asked_by("cell-2", text).is_err(), "{text}");
    }
    // The functions of the plant do not see an attacker's table with the same name as one of the plant's.
    let shadow = "CREATE TEMP TABLE cell (id int, role name, retired_at timestamptz); INSERT INTO pg_temp.cell VALUES (1, 'cell_2', NULL); SELECT regrind.own_cell()";
    assert!(plant.asked_by("cell-2", shadow).unwrap_err().contains("temporary"), "nobody makes temporary tables");
    plant.sql("GRANT TEMPORARY ON DATABASE regrind TO cell_2");
    assert_eq!(plant.asked_by("cell-2", shadow).unwrap(), "2");
    // A function of a trigger serves no table of a member.
    let triggered = "CREATE TEMP TABLE t (id int, cell int, name text, recipe text, simulation boolean, ended timestamptz, result text, cycles int);
        CREATE TRIGGER t AFTER INSERT ON t REFERENCING NEW TABLE AS new_run FOR EACH STATEMENT EXECUTE FUNCTION regrind.runs_changed();
        INSERT INTO t VALUES (1, 1, 'n', 'r', false, now(), 'not accepted', 1)";
    assert!(plant.asked_by("cell-2", triggered).unwrap_err().contains("permission denied"));
    plant.sql("REVOKE TEMPORARY ON DATABASE regrind FROM cell_2");
    let open = "SELECT string_agg(p.oid::regprocedure::text, ', ') FROM pg_proc p WHERE p.pronamespace = 'regrind'::regnamespace
        AND has_function_privilege('public', p.oid, 'EXECUTE')";
    assert_eq!(plant.sql(open), "", "everybody may execute these");
    // Nobody else can sign in.
    assert!(plant.postgres.ask_as("cell_2", "wrong", "regrind", "SELECT 1").is_err());
    plant.does(&["plant", "retire", "cell-2", "--plant", "owner.toml"]);
    let (_, told) = plant.ends(&["ship", "--once", "--plant", "cell-2.toml", "--runs", "runs-2"], 2);
    assert!(told.contains("login") && told.contains("\"cell_2\""), "{told}");
    assert_eq!(plant.sql("SELECT count(*) FROM record"), all.to_string());
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn forged_records_become_incidents() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    plant.cell("cell-2", &[]);
    let good = journal(&plant, "runs-1", "run-1", "SN-1");
    plant.does(&["ship", "--once", "--plant", "cell-1.toml", "--runs", "runs-1"]);
    let other = journal(&plant, "elsewhere", "run-3", "SN-3");
    let run = plant.asked_by("cell-1", "SELECT id FROM open_run('run-3')").unwrap();
    let [count, stands] = [good.len(), 2];
    let begun = plant.asked_by("cell-1", &ship(&run, 1, &other[..stands])).unwrap();
    assert_eq!(begun, format!("{stands}|"));

    let behind = |k: usize| other[k].clone();
    let mut wrong_text = behind(stands);
    wrong_text.payload = "{}".into();
    let mut wrong_number = behind(stands);
    wrong_number.seq += 1;
    let another_run = journal(&plant, "elsewhere", "run-4", "SN-4");
    let forged: [(&str, &str, u64, Vec<Record>); 6] = [
        ("a text that was changed", &run, 3, vec![wrong_text]),
        ("a record left out", &run, 3, vec![behind(stands + 1)]),
        ("two in another order", &run, 3, vec![behind(stands + 1), behind(stands)]),
        ("another run's", &run, 3, another_run[2..].to_vec()),
        ("behind the end", "1", count as u64 + 1, vec![behind(stands)]),
        ("a number that is not its place's", &run, 3, vec![wrong_number]),
    ];
    // The same flaw twice is one incident that happened twice.
    let counted = || plant.sql("SELECT coalesce(sum(times), 0) FROM incident").parse::<u64>().unwrap();
    for (what, run, from, records) in &forged {
        let before = counted();
        let said = plant.asked_by("cell-1", &ship(run, *from, records)).unwrap();
        let (stands, refused) = said.split_once('|').unwrap();
        assert!(!refused.is_empty() && [2, count].contains(&stands.parse().unwrap()), "{what}: {said}");
        assert_eq!(counted(), before + 1, "{what}");
        let incidents = plant.incidents();
        let is_told = |of: &Value| of["what"] == "a broken chain" && of["by"] == "cell-1" && of["words"] == *refused;
        assert!(incidents.iter().any(is_told), "{what}: {incidents:?}");
    }
    // A valid chain of another run under the name of this one.
    let run_4 = plant.asked_by("cell-1", "SELECT id FROM open_run('another')").unwrap();
    let said = plant.asked_by("cell-1", &ship(&run_4, 1, &another_run)).unwrap();
    assert!(said.contains("record 1 ") && said.contains("than another"), "{said}");
    // The other cell appends to a run that is not its own; the answer and the incident show it.
    let said = plant.asked_by("cell-2", &ship(&run, 3, &other[2..])).unwrap();
    assert!(said.contains(&format!("run {run},")) && said.contains("this cell"), "{said}");
    plant.asked_by("cell-2", "SELECT tell_run(1, '{\"cycles\":[],\"result\":\"accepted\"}')").unwrap();
    assert_eq!(plant.sql("SELECT count(*) FROM incident WHERE what = 'a foreign run'"), "2");
    assert_eq!(plant.sql("SELECT result IS NULL OR result <> 'accepted' FROM run WHERE id = 1"), "t");
    // Records that exist already change nothing, whatever their content; the rest must continue the chain.
    let said = plant.asked_by("cell-1", &ship(&run, 1, &another_run)).unwrap();
    assert_eq!(said, format!("{stands}|"));
    let said = plant.asked_by("cell-1", &ship(&run, 3, &other[2..])).unwrap();
    assert_eq!(said, format!("{}|", other.len()));
    // Knowledge of the hash of another cell's file does not give access to its content.
    let known = plant.sql("SELECT encode(sha256, 'hex') FROM artefact LIMIT 1");
    assert_eq!(plant.asked_by("cell-2", &format!("SELECT place_artefact(decode('{known}', 'hex'), 1)")).unwrap(), "f");
    assert_eq!(plant.asked_by("cell-2", "SELECT count(*) FROM artefact").unwrap(), "0");
    // A content under a wrong hash.
    let given = plant.asked_by("cell-1", "SELECT give_artefact(decode(repeat('00', 32), 'hex'), 'x')").unwrap();
    assert_eq!(given, "f");
    assert_eq!(plant.incidents().last().unwrap()["what"], "a wrong file");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn sql_injection_stays_text() {
    let plant = Plant::new();
    let name = "cell'; DROP TABLE regrind.cell; --";
    let enrol = ["plant", "enrol", name, "--plant", "owner.toml", "--password-file", "cell.password"];
    plant.does(&enrol);
    let role = plant.sql("SELECT role FROM cell");
    plant.write_file("cell", &role, name);
    let run = "run'); DROP TABLE regrind.run; --";
    journal(&plant, "runs", run, SQL);
    plant.does(&["ship", "--once", "--plant", "cell.toml"]);
    assert_eq!(plant.sql("SELECT part FROM run").replace("\\x01", "\u{1}"), SQL);
    assert_eq!(
        plant.sql(
            "SELECT count(*) FROM run_artefact a JOIN artefact USING (sha256) WHERE a.bytes = octet_length(content)"
        ),
        "1"
    );
    for found in [vec!["plant", "runs", "--part", SQL], vec!["plant", "cells"], vec!["plant", "incidents"]] {
        plant.does(&[&found[..], &["--plant", "owner.toml", "--json"]].concat());
    }
    let listed = plant.does(&["plant", "runs", "--part", "x')", "--plant", "owner.toml", "--json"]);
    assert!(listed.contains("DROP TABLE"), "{listed}");
    let (_, told) = plant.ends(&["audit", "verify", SQL, "--plant", "owner.toml"], 2);
    assert!(told.contains("has no run"), "{told}");
    plant.does(&["plant", "fetch", run, "--plant", "owner.toml", "--out", "back"]);
    let back = fs::read(plant.path("back").join(run).join("cycle-1/points.csv")).unwrap();
    assert_eq!(back, SQL.as_bytes());
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn enrolment_takes_over_no_role() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    plant.somebody("planner", "planner");
    let password = || plant.password("cell-1");
    let signs_in = || plant.asked_by("cell-1", "SELECT name FROM cell") == Ok("cell-1".into());
    let enrol = |name: &str, more: &[&str]| {
        let file = format!("{name}.password");
        let arguments = ["plant", "enrol", name, "--plant", "owner.toml", "--password-file", &file];
        crate::program::run(&[&arguments[..], more].concat(), plant.home.path())
    };
    let first = password();
    // A refused enrolment changes neither the password file nor the database.
    let names = [crate::postgres::OWNER, "postgres", "cell_1"];
    for (name, more, found) in [
        ("cell-1", &[][..], "--again"),
        ("cell-1", &["--as", "reader", "--again"], "is that of a cell"),
        ("planner", &["--again"], "is that of a planner"),
        ("cell-2", &["--again"], "leave out --again"),
        (names[0], &["--as", "reader", "--again"], "did not make"),
        (names[1], &["--as", "planner"], "did not make"),
        (names[2], &["--again"], "has the role cell_1 already"),
    ] {
        let (code, _, told) = enrol(name, more);
        assert!(code == 2 && told.contains(found), "{name} {more:?}: {code} {told}");
        assert!(!plant.path(&format!("{name}.password.new")).exists(), "{name}");
        assert!(password() == first && signs_in(), "{name} {more:?}");
    }
    assert!(plant.asked_by("planner", "SELECT count(*) FROM run").is_ok());
    // A new password replaces the old one in the file and in the database.
    assert_eq!(enrol("cell-1", &["--again"]).0, 0);
    assert!(password() != first && signs_in());
    let old = plant.postgres.ask_as("cell_1", &first, "regrind", "SELECT 1");
    assert!(old.is_err(), "{old:?}");
    // A further key, with the password as it is.
    let key = "ab".repeat(32);
    assert!(plant.does(&["plant", "add-key", "cell-1", "--key", &key, "--plant", "owner.toml"]).contains("1 key"));
    assert_eq!(plant.sql("SELECT count(*) FROM cell_key"), "1");
    assert!(signs_in());
    plant.ends(&["plant", "add-key", "cell-9", "--key", &key, "--plant", "owner.toml"], 1);
    // A cell that was retired comes back.
    plant.does(&["plant", "retire", "cell-1", "--plant", "owner.toml"]);
    assert!(!signs_in());
    assert_eq!(enrol("cell-1", &["--again"]).0, 0);
    assert!(signs_in());
    assert_eq!(plant.sql("SELECT count(*) FROM cell_key"), "1", "its keys stay");
}
