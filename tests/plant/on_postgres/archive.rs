//! Runs of earlier months: from the database to folders that prove them, and back.

use std::fs;

use regrind::journal::{sha256_hex, verify};
use serde_json::Value;

use super::faults::{link, runtime};
use super::forged::Forged;
use super::records::made;
use super::rights::{journal, ship};
use crate::Plant;
use crate::postgres::{OWNER, Postgres};
use crate::program::{Running, regrind};

/// Makes all blocks so far, and what is in them, those of a month that is long over.
fn grow_old(plant: &Plant) {
    plant.sql("UPDATE month_block SET month = '2024-11-01' WHERE month <= now()");
    plant.sql("UPDATE run SET arrived_at = '2024-11-30'");
}

fn archived(plant: &Plant, code: i32, more: &[&str]) -> Value {
    let arguments = ["plant", "archive", "--json", "--plant", "owner.toml"];
    serde_json::from_str(&plant.ends(&[&arguments[..], more].concat(), code).0).unwrap()
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn archived_run_is_proven_and_comes_back() {
    let plant = Plant::new();
    let (_, name) = made(&plant);
    let ship_it = ["ship", "--once", "--plant", "cell-1.toml"];
    plant.does(&ship_it);
    let records: u64 = plant.sql("SELECT count(*) FROM record").parse().unwrap();
    let contents: u64 = plant.sql("SELECT count(*) FROM artefact").parse().unwrap();
    let shown = |text: &str| plant.sql(text);
    let figures = "SELECT id, cell, run, serial, result, pv_um, rms_um, records, head FROM part_run";
    let before = shown(figures);
    grow_old(&plant);

    // Nothing is older than this, and the table [archive] names no folder yet.
    assert_eq!(archived(&plant, 0, &["--before", "2024-11", "--out", "old"])["runs"], 0);
    let (_, told) = plant.ends(&["plant", "archive", "--plant", "owner.toml"], 2);
    assert!(told.contains("[archive]"), "{told}");
    for bad in ["2024", "2024-13", "2024-11-01", "November"] {
        plant.ends(&["plant", "archive", "--before", bad, "--out", "old", "--plant", "owner.toml"], 2);
    }
    fs::write(
        plant.path("owner.toml"),
        fs::read_to_string(plant.path("owner.toml")).unwrap() + "\n[archive]\nfolder = \"old\"\nkeep_months = 12\n",
    )
    .unwrap();
    let told = archived(&plant, 0, &[]);
    assert_eq!([&told["runs"], &told["records_removed"]], [1, records]);
    // The knowledge of a run, and nothing else, stays in the database.
    assert_eq!(
        told["files_removed"].as_u64().unwrap() + shown("SELECT count(*) FROM lesson").parse::<u64>().unwrap(),
        contents
    );
    assert_eq!(shown("SELECT count(*) FROM record"), "0");
    assert_eq!(
        shown("SELECT count(*) FROM pg_inherits WHERE inhparent = 'record'::regclass"),
        "2",
        "those of the first block, which is empty, and of the next month"
    );
    assert_eq!(shown(figures), before, "lists and trends are unchanged");

    // The folder proves the run without the plant.
    let folder = plant.path("old/2024-11/cell-1").join(&name);
    let key = fs::read_to_string(plant.path("audit.key")).is_ok();
    let proven = verify(&folder).unwrap();
    assert!(key && proven.records == records && proven.closed && proven.signed > 0, "{proven:?}");
    plant.does(&["audit", "verify", &folder.display().to_string()]);
    // The plant says where it is.
    for arguments in [
        &["audit", "verify", &name, "--plant", "owner.toml"][..],
        &["plant", "fetch", &name, "--plant", "owner.toml", "--out", "back"],
    ] {
        let (_, told) = plant.ends(arguments, 2);
        assert!(told.contains("archived to") && told.contains("old/2024-11/cell-1"), "{told}");
    }
    // The cell ships on: this run is there already, and another one arrives. The figures of an archived run stay.
    plant.does(&ship_it);
    let tell = format!(
        "SELECT tell_run({}, '{{\"result\":\"stopped\",\"cycles\":[{{\"cycle\":1,\"pv_um\":99}}]}}')",
        shown("SELECT id FROM run")
    );
    plant.asked_by("cell-1", &tell).unwrap();
    assert_eq!(shown(figures), before);
    assert_eq!(shown("SELECT count(*) FROM cycle WHERE pv_um = 99"), "0");
    // It is known among the runs that arrived.
    plant.does(&["plant", "runs", "--missing", "--plant", "owner.toml"]);
    journal(&plant, "runs", "run-2", "SN-2");
    plant.does(&ship_it);
    assert_eq!(shown("SELECT count(DISTINCT run) FROM record"), "1");
    assert_eq!(archived(&plant, 0, &[])["runs"], 0, "again");

    // A folder that was changed proves nothing; the true one brings the run back.
    let back = ["plant", "unarchive", &folder.display().to_string(), "--plant", "owner.toml"];
    let file = folder.join("recipe.toml");
    let text = fs::read(&file).unwrap();
    fs::write(&file, "[part]\n").unwrap();
    plant.ends(&back, 1);
    fs::write(&file, text).unwrap();
    assert_eq!(shown("SELECT count(*) FROM run WHERE archived_at IS NOT NULL"), "1");
    assert!(plant.does(&back).contains(&format!("{name} of cell-1 is back")));
    assert_eq!(
        shown("SELECT count(*) FROM artefact WHERE content IS NOT NULL AND octet_length(content) = bytes"),
        (contents + 1).to_string()
    );
    let proven = plant.does(&["audit", "verify", &name, "--plant", "owner.toml"]);
    assert!(proven.contains(&format!("{records} records")), "{proven}");
    plant.ends(&back, 2);
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn what_cannot_be_archived_stays() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    for (name, part) in [("run-1", "SN-1"), ("run-2", "SN-2"), ("run-3", "SN-3"), (".run-4", "SN-4")] {
        journal(&plant, "elsewhere", name, part);
    }
    // Whole, without its end, without its file, with a name that cannot be a folder's, and without any record.
    let records = |name: &str| {
        let reader = regrind::journal::Reader::open(plant.path("elsewhere").join(name)).unwrap();
        reader.records(1).map(Result::unwrap).collect::<Vec<_>>()
    };
    for (name, count) in [("run-1", 11), ("run-2", 5), ("run-3", 11), (".run-4", 11)] {
        let all = records(name);
        let run = plant.asked_by("cell-1", &format!("SELECT id FROM open_run('{name}')")).unwrap();
        plant.asked_by("cell-1", &ship(&run, 1, &all[..count.min(all.len())])).unwrap();
    }
    plant.asked_by("cell-1", "SELECT id FROM open_run('nothing')").unwrap();
    let content = fs::read(plant.path("elsewhere/run-1/cycle-1/points.csv")).unwrap();
    let hex: String = content.iter().map(|byte| format!("{byte:02x}")).collect();
    let give = format!("SELECT give_artefact(decode('{}', 'hex'), decode('{hex}', 'hex'))", sha256_hex(&content));
    plant.asked_by("cell-1", &give).unwrap();
    // The same content is the file of all three; another one is missing.
    plant.sql("UPDATE run_artefact SET sha256 = sha256('x') WHERE run = (SELECT id FROM run WHERE name = 'run-3')");
    grow_old(&plant);

    let told = archived(&plant, 1, &["--before", "2025-01", "--out", "old"]);
    assert_eq!((&told["runs"], &told["files_removed"]), (&Value::from(1), &Value::from(0)), "{told}");
    let kept: Vec<&str> = told["kept"].as_array().unwrap().iter().map(|of| of["run"].as_str().unwrap()).collect();
    assert_eq!(kept, ["run-2 of cell-1", "run-3 of cell-1", ".run-4 of cell-1"]);
    assert!(verify(plant.path("old/2024-11/cell-1/run-1")).is_ok());
    assert!(!plant.path("old/.archiving").exists());
    let left = "SELECT string_agg(DISTINCT r.name, ' ' ORDER BY r.name) FROM run r JOIN record e ON e.run = r.id";
    assert_eq!(plant.sql(left), ".run-4 run-2 run-3");
    assert_eq!(plant.sql("SELECT count(*) FROM artefact"), "1", "another run names it");
    assert_eq!(plant.sql("SELECT count(*) FROM run WHERE name = 'nothing'"), "0");
    // The run without its end goes on, as far as it is not archived.
    let run = plant.sql("SELECT id FROM run WHERE name = 'run-2'");
    let all = records("run-2");
    let said = plant.asked_by("cell-1", &ship(&run, 6, &all[5..])).unwrap();
    assert_eq!(said, format!("{}|", all.len()));
    let run = plant.sql("SELECT id FROM run WHERE name = 'run-1'");
    let said = plant.asked_by("cell-1", &ship(&run, records("run-1").len() as u64 + 1, &all[5..6])).unwrap();
    assert!(said.contains("archived to"), "{said}");
    let more = ["--before", "2025-01", "--out", "old"];
    assert_eq!(archived(&plant, 1, &more)["runs"], 0, "its last record arrived just now");
    grow_old(&plant);
    assert_eq!(archived(&plant, 1, &more)["runs"], 1);
    // Only the owner archives.
    plant.somebody("planner", "planner");
    plant.ends(&["plant", "archive", "--before", "2025-01", "--out", "old", "--plant", "planner.toml"], 2);
}

/// The tables of a month are dropped when nobody reads them. Meanwhile no reader and no cell waits for long.
#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn archive_waits_for_readers() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    plant.somebody("office", "reader");
    journal(&plant, "runs", "run-1", "SN-1");
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    grow_old(&plant);
    runtime().block_on(async {
        let mut reader = link(&plant, "office").await;
        let reads = reader.client_mut().transaction().await.unwrap();
        reads.query_one("SELECT count(*) FROM record", &[]).await.unwrap();
        let more = ["--before", "2025-01", "--out", "old", "--plant", "owner.toml"];
        let mut archive = Running::new(regrind(&[&["plant", "archive"], &more[..]].concat(), plant.home.path()));
        let tries = || plant.postgres.log().matches("due to lock timeout").count();
        archive.until("two tries", |_| (tries() > 1).then_some(()));
        reads.commit().await.unwrap();
        let (code, told) = archive.end();
        assert_eq!((code, &told[..]), (0, ""));
    });
    assert_eq!(plant.sql("SELECT count(*) FROM record"), "0");
}

/// A copy of the run folder of another cell, and a run that arrived before its cell had a key.
#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn same_run_of_two_cells_comes_back_to_each() {
    let plant = Plant::new();
    ["cell-1", "cell-2"].iter().for_each(|name| plant.cell(name, &[]));
    Forged::named("run-1").write(&plant.path("runs/run-1"), 3);
    for cell in ["cell-1", "cell-2"] {
        plant.does(&["ship", "--once", "--plant", &format!("{cell}.toml")]);
    }
    let key = "ab".repeat(32);
    plant.does(&["plant", "add-key", "cell-2", "--key", &key, "--plant", "owner.toml"]);
    grow_old(&plant);
    assert_eq!(archived(&plant, 0, &["--before", "2025-01", "--out", "old"])["runs"], 2);
    let states = "SELECT c.name, archived_at IS NULL FROM run r JOIN cell c ON c.id = r.cell ORDER BY 1";
    for (cell, then) in [("cell-2", "cell-1|f\ncell-2|t"), ("cell-1", "cell-1|t\ncell-2|t")] {
        let folder = plant.path("old/2024-11").join(cell).join("run-1").display().to_string();
        plant.does(&["plant", "unarchive", &folder, "--plant", "owner.toml"]);
        assert_eq!(plant.sql(states), then);
    }
    // The program ended between the mark and the removal: the records are still there.
    plant.sql("UPDATE run SET archived_at = now(), archive = 'x' WHERE cell = 1");
    let folder = plant.path("old/2024-11/cell-1/run-1").display().to_string();
    plant.does(&["plant", "unarchive", &folder, "--plant", "owner.toml"]);
    plant.does(&["audit", "verify", "run-1", "--plant", "cell-1.toml"]);
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn new_month_gets_its_own_block() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    let open = |name: &str| plant.asked_by("cell-1", &format!("SELECT id FROM open_run('{name}')")).unwrap();
    assert_eq!([open("run-1"), open("run-2"), open("run-1")], ["1", "2", "1"]);
    // The plant stood still for months: the month of today, and the next one, have no block.
    plant.sql("UPDATE month_block SET month = month - interval '1 year'");
    let blocks = "SELECT count(*) FILTER (WHERE month = date_trunc('month', now() AT TIME ZONE 'UTC')), count(*) FROM month_block";
    assert_eq!(open("run-3"), "4000001");
    assert_eq!(plant.sql(blocks), "1|5", "this month and the next one");
    // A block that is full.
    plant.sql("SELECT setval('month_4000001', 6000000)");
    assert_eq!(open("run-4"), "8000001");
    let all = journal(&plant, "elsewhere", "run-4", "SN-4");
    assert_eq!(plant.asked_by("cell-1", &ship("8000001", 1, &all)).unwrap(), format!("{}|", all.len()));
    let place = "SELECT DISTINCT tableoid::regclass FROM record";
    assert_eq!(plant.sql(place), "record_8000001");
    // Nobody reads a partition by itself.
    for table in ["record_8000001", "record_before", "run_artefact_1"] {
        let refused = plant.asked_by("cell-1", &format!("SELECT * FROM {table}")).unwrap_err();
        assert!(refused.contains("permission denied"), "{table}: {refused}");
    }
}

/// A database with the layout of version 0.2.0 of Regrind and data in it is brought to the newest layout.
#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn data_of_earlier_layout_migrate() {
    let postgres = Postgres::start();
    let plant = Plant { postgres, home: tempfile::TempDir::new().unwrap() };
    plant.postgres.write_owner_password(&plant.path("owner.password"));
    plant.write_file("owner", OWNER, "");
    // Layout 8 by its own scripts, as the owner.
    plant.postgres.sql(
        "regrind",
        "CREATE ROLE regrind_cell; CREATE ROLE regrind_reader; CREATE ROLE regrind_planner; CREATE ROLE regrind_worker",
    );
    let as_owner = |text: &str| {
        let text = format!("SET search_path = regrind; {text}");
        plant
            .postgres
            .ask_as(OWNER, &plant.password("owner"), "regrind", &text)
            .unwrap_or_else(|e| panic!("{text}: {e}"))
    };
    as_owner(
        "CREATE SCHEMA regrind; CREATE TABLE migration (version integer PRIMARY KEY, sha256 text NOT NULL, applied_at timestamptz NOT NULL DEFAULT now())",
    );
    let mut scripts: Vec<_> = fs::read_dir(crate::program::root().join("src/plant/migrations"))
        .unwrap()
        .map(|of| of.unwrap().path())
        .collect();
    scripts.sort();
    for (version, script) in (1..).zip(&scripts[..8]) {
        let text = fs::read_to_string(script).unwrap();
        as_owner(&text);
        as_owner(&format!(
            "INSERT INTO migration (version, sha256) VALUES ({version}, '{}')",
            sha256_hex(text.as_bytes())
        ));
    }
    // Two cells with runs, an unsigned lesson, a part that waits for a withdrawn recipe, and a state that is too large.
    plant.sql("CREATE ROLE cell_1 LOGIN PASSWORD 'of-cell-1' IN ROLE regrind_cell");
    fs::write(plant.path("cell-1.password"), "of-cell-1\n").unwrap();
    std::fs::set_permissions(plant.path("cell-1.password"), std::os::unix::fs::PermissionsExt::from_mode(0o600))
        .unwrap();
    plant.write_file("cell-1", "cell_1", "cell-1");
    as_owner(
        "GRANT USAGE ON SCHEMA regrind TO regrind_cell, regrind_reader; INSERT INTO cell (name, role) VALUES ('cell-1', 'cell_1')",
    );
    let all = journal(&plant, "runs", "run-1", "SN-1");
    let run = plant.asked_by("cell-1", "SELECT id FROM open_run('run-1')").unwrap();
    let stands = 4;
    plant.asked_by("cell-1", &ship(&run, 1, &all[..stands])).unwrap();
    plant.asked_by("cell-1", "SELECT tell_state('run-1', jsonb_build_object('words', repeat('x', 300000)))").unwrap();
    as_owner("INSERT INTO recipe (sha256, name, version, text, withdrawn_at) VALUES (recipe_sha256('a', 1, 't', '{}'), 'a', 1, 't', now());
        INSERT INTO work (serial, recipe) SELECT 'SN-9', sha256 FROM recipe;
        INSERT INTO lesson (run, cell, kind, simulation, sha256) VALUES (1, 1, 'k', true, sha256('x'))");

    let said = plant.does(&["plant", "init", "--plant", "owner.toml"]);
    assert!(said.contains("it had 8"), "{said}");
    assert_eq!(plant.sql("SELECT state FROM work"), "withdrawn");
    assert_eq!(plant.sql("SELECT (SELECT count(*) FROM lesson), (SELECT count(*) FROM cell_state)"), "0|0");
    // The run of the earlier layout goes on, and a new one follows in another partition.
    journal(&plant, "runs", "run-2", "SN-2");
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    let places = "SELECT run, tableoid::regclass, count(*) FROM record GROUP BY 1, 2 ORDER BY 1";
    assert_eq!(plant.sql(places), format!("1|record_before|{0}\n2|record_2|{0}", all.len()));
    for name in ["run-1", "run-2"] {
        plant.does(&["audit", "verify", name, "--plant", "owner.toml"]);
    }
    assert!(plant.does(&["plant", "init", "--plant", "owner.toml"]).contains("unchanged"));
}
