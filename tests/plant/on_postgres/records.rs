//! Records of a cell: replication to the plant, use as evidence there, and retrieval.

use std::fs;
use std::path::Path;

use regrind::journal::{Reader, Record, verify};
use rusqlite::Connection;
use serde_json::Value;

use crate::program::{Running, regrind, run, small_recipe};
use crate::{Plant, only_run};

/// Makes a part of the small recipe at cell-1, signed, and shipped in the meantime.
pub fn made(plant: &Plant) -> (std::path::PathBuf, String) {
    let key = plant.path("audit.key").display().to_string();
    let told: Value = serde_json::from_str(&plant.does(&["audit", "key", "--key", &key, "--json"])).unwrap();
    plant.cell("cell-1", &["--key", told["public_key"].as_str().unwrap()]);
    let recipe = small_recipe(plant.home.path(), 1000.0).display().to_string();
    let arguments =
        ["run", &recipe, "--cell", "sim", "--part", "SN-0042", "--operator", "Ada", "--plant", "cell-1.toml"];
    let mut command = regrind(&arguments, plant.home.path());
    command.env("REGRIND_KEY", &key);
    let mut run = Running::new(command);
    let (code, errors) = run.end();
    assert_eq!(code, 0, "{errors}");
    only_run(&plant.path("runs"))
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn cell_of_killed_run_is_not_idle() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    let told = || plant.sql("SELECT count(*) FROM cell_now WHERE told_at IS NOT NULL");
    let (mut running, _, _) = crate::held::held_run(plant.home.path(), 200.0);
    running.signal("KILL");
    running.end();
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    assert_eq!(told(), "0", "what it does is not known");
    // A person who made another part has prepared the machines.
    let recipe = small_recipe(plant.home.path(), 1000.0).display().to_string();
    let (code, out, errors) = run(&["run", &recipe, "--cell", "sim"], plant.home.path());
    assert!(code == 0 && told() == "0", "{out}{errors}");
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    assert_eq!(plant.sql("SELECT words FROM cell_now"), "no run is on");
}

fn records(folder: &Path) -> Vec<Record> {
    Reader::open(folder).unwrap().records(1).map(Result::unwrap).collect()
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn run_replicated_verified_and_fetched() {
    let plant = Plant::new();
    let (folder, name) = made(&plant);
    let before = records(&folder);
    for _ in 0..2 {
        plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
        assert_eq!(plant.sql("SELECT count(*), min(seq), max(seq) FROM record"), format!("{0}|1|{0}", before.len()));
        assert_eq!(plant.sql("SELECT count(*) FROM missing_artefacts(1)"), "0", "as the owner, who is no cell");
        let files = "SELECT count(*) > 8, count(*) FILTER (WHERE o.sha256 IS NULL) FROM run_artefact a LEFT JOIN artefact_of o USING (sha256)";
        assert_eq!(plant.sql(files), "t|0");
    }
    assert_eq!(plant.sql("SELECT encode(head, 'hex') FROM run"), before.last().unwrap().hash);

    // The summary agrees with the record.
    let shown = regrind::report::run_summary(&folder).unwrap();
    let [[pv, pv_u], [rms, rms_u]] = shown.cycles.last().unwrap().figures.unwrap();
    let row = plant.sql(
        "SELECT cell, serial, operator, simulation, result, cycles, pv_um, pv_u_um, rms_um, rms_u_um FROM part_run",
    );
    let count = shown.cycles.len();
    assert_eq!(row, format!("cell-1|SN-0042|Ada|t|accepted|{count}|{pv}|{pv_u}|{rms}|{rms_u}"));
    let named = plant.sql("SELECT recipe, part_name, cmm IS NOT NULL, grinder IS NOT NULL, wheel, probe FROM part_run");
    assert!(named.starts_with("small|") && named.contains("|t|t|R ") && named.ends_with("|R 1.500 mm"), "{named}");
    // A database has a resolution of microseconds.
    let ended = format!("{}Z", plant.sql("SELECT ended AT TIME ZONE 'UTC' FROM part_run").replace(' ', "T"));
    let [there, here] = [ended, shown.ended.unwrap()].map(|at| at.parse::<jiff::Timestamp>().unwrap().as_nanosecond());
    assert!((there - here).abs() <= 1000, "{there} {here}");

    // The copy is evidence alone, and together with the journal of the cell.
    let both = plant.does(&["audit", "verify", "--plant", "cell-1.toml"]);
    assert!(both.contains("local journal") && both.contains("sound       "), "{both}");
    let told: Value =
        serde_json::from_str(&plant.does(&["audit", "verify", "--plant", "cell-1.toml", "--json"])).unwrap();
    assert!(
        told["head"] == told["plant"]["head"] && told["plant"]["cell"] == "cell-1" && told["plant"]["sound"] == true,
        "{told}"
    );
    let copy = ["audit", "verify", &name, "--plant", "owner.toml"];
    fs::rename(plant.path("runs"), plant.path("elsewhere")).unwrap();
    let alone = plant.does(&copy);
    assert!(alone.contains(&format!("{} records", before.len())) && alone.contains("enrolled for cell-1"), "{alone}");

    plant.does(&["plant", "fetch", &name, "--plant", "owner.toml", "--out", "back"]);
    let back = plant.path("back").join(&name);
    assert_eq!(records(&back), before);
    let there = verify(plant.path("elsewhere").join(&name)).unwrap();
    let here = verify(&back).unwrap();
    assert_eq!((here.artefacts, here.closed, here.signed), (there.artefacts, true, there.signed));
    plant.does(&["report", &back.display().to_string()]);
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn large_files_in_folder_are_repaired() {
    let plant = Plant::new();
    let (folder, name) = made(&plant);
    let files = plant.path("files");
    fs::create_dir(&files).unwrap();
    for who in ["cell-1", "owner"] {
        let file = plant.path(&format!("{who}.toml"));
        let text = fs::read_to_string(&file).unwrap();
        fs::write(file, format!("{text}\n[artefacts]\nfolder = \"files\"\nfrom_mb = 0.001\n")).unwrap();
    }
    // Remove from the database what the run itself has stored, as if nothing had been shipped.
    plant.sql("TRUNCATE artefact_of, artefact, record; UPDATE run SET records = 0, head = decode(repeat('00', 32), 'hex'), ended = NULL");
    plant.sql("TRUNCATE run_artefact");
    // Another program with write access to the folder has replaced a content.
    let recipe = regrind::journal::sha256_hex(&fs::read(folder.join("recipe.toml")).unwrap());
    fs::create_dir(files.join(&recipe[..2])).unwrap();
    fs::write(files.join(&recipe[..2]).join(&recipe), "another").unwrap();
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    let where_they_are = "SELECT count(*) FILTER (WHERE place IS NOT NULL) > 4, bool_and((place IS NOT NULL) = (bytes >= 1000)) FROM artefact";
    assert_eq!(plant.sql(where_they_are), "t|t");
    plant.does(&["plant", "fetch", &name, "--plant", "owner.toml", "--out", "back"]);
    assert!(verify(plant.path("back").join(&name)).unwrap().artefacts > 8);
    fs::write(files.join(&recipe[..2]).join(&recipe), "another").unwrap();
    let (_, told) = plant.ends(&["audit", "verify", "--plant", "owner.toml"], 1);
    assert!(told.contains("recipe.toml"), "{told}");
}

/// Cuts the end off a journal as an expert attacker does: together with the anchor.
fn cut(folder: &Path, keeps: usize) {
    let journal = Connection::open(folder.join("journal.sqlite")).unwrap();
    for trigger in ["record_is_not_changed", "record_is_not_deleted"] {
        journal.execute_batch(&format!("DROP TRIGGER {trigger}")).unwrap();
    }
    journal.execute("DELETE FROM record WHERE seq > ?1", [keeps as i64]).unwrap();
    fs::remove_file(folder.join("journal.anchor")).unwrap();
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn plant_detects_truncated_journal() {
    let plant = Plant::new();
    let (folder, name) = made(&plant);
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    let all = records(&folder).len();
    cut(&folder, all / 2);

    let (_, told) = plant.ends(&["ship", "--once", "--plant", "cell-1.toml"], 1);
    let pieces = [format!("plant has {all} records"), format!("journal has {}:", all / 2), "cut off".to_owned()];
    let is_cut = |text: &str| pieces.iter().all(|piece| text.contains(piece));
    assert!(is_cut(&told), "{told}");
    let (_, told) = plant.ends(&["audit", "verify", "--plant", "cell-1.toml"], 1);
    assert!(is_cut(&told), "{told}");
    let incidents = plant.incidents();
    let last = incidents.last().unwrap();
    assert_eq!((last["by"].as_str(), last["run"].as_str()), (Some("cell-1"), Some(&*name)), "{last}");
    assert!(last["what"] == "a journal that differs" && is_cut(last["words"].as_str().unwrap()), "{last}");
    // The copy of the plant is unchanged, and verifies.
    plant.does(&["plant", "fetch", &name, "--plant", "owner.toml", "--out", "back"]);
    assert_eq!(records(&plant.path("back").join(&name)).len(), all);
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn verify_detects_changed_plant() {
    let plant = Plant::new();
    let (_, name) = made(&plant);
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    let verify = ["audit", "verify", &name, "--plant", "owner.toml"];
    fs::rename(plant.path("runs"), plant.path("elsewhere")).unwrap();
    let all: usize = plant.sql("SELECT count(*) FROM record").parse().unwrap();
    // Manipulations by an attacker with all rights, each with the statement that undoes it.
    let harm = [
        (
            "SET text = replace(text, 'Ada', 'Eve') WHERE seq = 1",
            "SET text = replace(text, 'Eve', 'Ada') WHERE seq = 1",
            1,
        ),
        ("SET text = text || ' ' WHERE seq = 3", "SET text = rtrim(text) WHERE seq = 3", 3),
        ("SET seq = -seq WHERE seq = 5", "SET seq = -seq WHERE seq = -5", 6),
    ];
    for (does, undoes, at) in harm {
        plant.sql(&format!("UPDATE record {does}"));
        let (_, told) = plant.ends(&verify, 1);
        assert!(told.contains(&format!("record {at}")), "{does}: {told}");
        plant.sql(&format!("UPDATE record {undoes}"));
    }
    plant.sql("DELETE FROM record");
    plant.sql("UPDATE run SET records = 0, head = decode(repeat('00', 32), 'hex'), ended = NULL");
    fs::rename(plant.path("elsewhere"), plant.path("runs")).unwrap();
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    assert_eq!(plant.sql("SELECT count(*) FROM record").parse(), Ok(all), "shipped anew");
    fs::rename(plant.path("runs"), plant.path("elsewhere")).unwrap();
    plant.does(&verify);
    plant.sql("UPDATE artefact SET content = 'other' WHERE sha256 = (SELECT sha256 FROM run_artefact WHERE name = 'recipe.toml')");
    let (_, told) = plant.ends(&verify, 1);
    assert!(told.contains("recipe.toml"), "{told}");
}
