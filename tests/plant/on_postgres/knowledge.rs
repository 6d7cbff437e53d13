//! Use of one cell's learning at another cell that grinds the same recipe for the first time.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::Plant;
use crate::program::{records_with, replaced, small_recipe};

/// Enrols a cell with the key that signs its records.
fn cell(plant: &Plant, name: &str) {
    let file = format!("{name}.key");
    let told: Value = serde_json::from_str(&plant.does(&["audit", "key", "--key", &file, "--json"])).unwrap();
    plant.cell(name, &["--key", told["public_key"].as_str().unwrap()]);
}

/// Returns a plant of two cells, of which the first has made a part and published its learning.
fn taught() -> (Plant, String) {
    let plant = Plant::new();
    ["cell-1", "cell-2"].iter().for_each(|name| cell(&plant, name));
    let recipe = small_recipe(plant.home.path(), 1e5);
    let text = fs::read_to_string(&recipe).unwrap();
    fs::write(&recipe, replaced(&text, "cutoff_mm = 14.0", "cutoff_mm = 14.0\nlearn = true")).unwrap();
    let (folder, said) = made(&plant, "cell-1", "1");
    assert!(said.contains("begins without knowledge"), "{said}");
    plant.does(&["ship", "--once", "--plant", "cell-1.toml", "--runs", "cell-1"]);
    assert_eq!(plant.sql("SELECT count(*) FROM lesson"), "1");
    let name = folder.file_name().unwrap().to_string_lossy().into_owned();
    (plant, name)
}

/// Lets a cell make a part of a world, signed with its key; returns its folder, and its output.
fn made(plant: &Plant, cell: &str, seed: &str) -> (PathBuf, String) {
    made_with(plant, cell, seed, &plant.path(&format!("{cell}.key")).display().to_string())
}

/// Lets a cell make a part of a world. Its record is signed with `key`, or with none if this is empty.
fn made_with(plant: &Plant, cell: &str, seed: &str, key: &str) -> (PathBuf, String) {
    let folders = || fs::read_dir(plant.path(cell)).into_iter().flatten().map(|entry| entry.unwrap().path());
    let before: Vec<PathBuf> = folders().collect();
    let file = format!("{cell}.toml");
    let arguments = ["run", "small.toml", "--cell", "sim", "--seed", seed, "--runs", cell, "--plant", &file];
    let mut command = crate::program::regrind(&arguments, plant.home.path());
    command.env("REGRIND_KEY", key);
    let (code, out, errors) = crate::program::run_to_end(command, plant.home.path());
    assert!(matches!(code, 0 | 1), "{out}{errors}");
    let new = folders().find(|folder| !before.contains(folder) && folder.join("journal.sqlite").is_file());
    (new.expect("a run"), format!("{out}{errors}"))
}

fn states(plant: &Plant, rms_share: &str) {
    let file = plant.path("cell-2.toml");
    let text = fs::read_to_string(&file).unwrap();
    let stated = format!("[plant]\nmachines_differ = {rms_share}");
    fs::write(file, replaced(&text, "[plant]", &stated)).unwrap();
}

fn first_rms_mm(run: &Path) -> f64 {
    let document: Value = serde_json::from_slice(&fs::read(run.join("cycle-1/registration.json")).unwrap()).unwrap();
    document["rms_mm"].as_f64().unwrap()
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn second_cell_starts_from_learned_error() {
    let (mut plant, taught_by) = taught();
    // The similarity of the machines is unknown. In that case the learned form has no weight, and does no harm.
    let (alone, said) = made(&plant, "cell-2", "2");
    for piece in ["form statistics", &format!("cell-1 (run {taught_by})")] {
        assert!(said.contains(piece), "{piece}: {said}");
    }
    assert!(said.contains("unknown") && said.contains("machines_differ"), "{said}");
    fs::rename(plant.path("cell-2"), plant.path("aside")).unwrap();
    let alone = plant.path("aside").join(alone.file_name().unwrap());

    states(&plant, "0.1");
    let (second, said) = made(&plant, "cell-2", "2");
    for piece in ["begins with", &format!("cell-1 (run {taught_by})"), "assumed"] {
        assert!(said.contains(piece), "{piece}: {said}");
    }
    let [without, with] = [&alone, &second].map(|run| first_rms_mm(run));
    assert!(with < 0.5 * without, "{with} mm after the first pass, {without} mm without");
    // The origin is on record, and the run depends only on its own files.
    let begin = &records_with(&second, "content")[0]["content"];
    assert_eq!(begin["taught_by"]["runs"][0]["run"], *taught_by, "{begin}");
    let kept: Value = serde_json::from_slice(&fs::read(second.join("learned_from.json")).unwrap()).unwrap();
    assert_eq!(kept["taught_by"]["runs"][0]["cell"], "cell-1");
    plant.does(&["audit", "verify", &second.display().to_string()]);
    // Its next part begins with its own learning, which it publishes in turn, as a comparison of the two machines.
    let (_, said) = made(&plant, "cell-2", "2");
    assert!(said.contains("begins with the error") && said.contains("found in every pass"), "{said}");
    plant.does(&["ship", "--once", "--plant", "cell-2.toml", "--runs", "cell-2"]);
    assert_eq!(plant.asked_by("cell-2", "SELECT count(DISTINCT cell) FROM lessons_in_common(true)").unwrap(), "2");
    assert_eq!(plant.asked_by("cell-2", "SELECT count(*) FROM lessons_in_common(false)").unwrap(), "0");

    // A cell never needs the plant.
    fs::rename(plant.path("cell-2"), plant.path("aside-2")).unwrap();
    plant.postgres.kill();
    let (_, said) = made(&plant, "cell-2", "2");
    for piece in ["no learned results", "begins without knowledge"] {
        assert!(said.contains(piece), "{piece}: {said}");
    }
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn learned_error_access_rights() {
    let (plant, _) = taught();
    assert_eq!(plant.asked_by("cell-2", "SELECT * FROM lesson").unwrap(), "");
    for by_hand in ["SELECT * FROM newest_lesson", "INSERT INTO lesson SELECT * FROM lesson", "DELETE FROM lesson"] {
        let refused = plant.asked_by("cell-2", by_hand).unwrap_err();
        assert!(refused.contains("permission denied"), "{by_hand}: {refused}");
    }
    let given = "SELECT cell FROM lessons((SELECT kind FROM lesson_kind_for_test), true)";
    plant.sql("CREATE VIEW lesson_kind_for_test AS SELECT kind FROM lesson; GRANT SELECT ON lesson_kind_for_test TO regrind_cell");
    assert_eq!(plant.asked_by("cell-2", given).unwrap(), "cell-1");
    assert_eq!(plant.asked_by("cell-1", given).unwrap(), "", "its own is no news to it");
    // Learning that belongs to another's run, and learning that is not on record.
    let before = plant.incidents().len();
    let sha256 = plant.sql("SELECT encode(sha256, 'hex') FROM lesson");
    let foreign = format!("SELECT teach(1, 'all', decode('{sha256}', 'hex'))");
    assert!(plant.asked_by("cell-2", &foreign).unwrap().contains("none of this cell's"));
    let invented = "SELECT teach(1, 'all', sha256('x'))";
    assert!(plant.asked_by("cell-1", invented).unwrap().contains("not on its record"));
    let incidents = plant.incidents();
    assert_eq!(incidents.len(), before + 2);
    assert!(incidents[before..].iter().all(|of| of["what"] == "a lesson refused"), "{incidents:?}");
    assert_eq!(plant.sql("SELECT count(*) FROM lesson"), "1");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn forged_learned_error_is_ignored() {
    let (plant, taught_by) = taught();
    states(&plant, "0.1");
    // An attacker with all rights to the database: a content under a wrong hash, and under the right one.
    let broken = "jsonb_set(convert_from(content, 'UTF8')::jsonb, '{known,response,0}', '7')::text";
    let tries = [
        (broken, false, "differs from the record"),
        (broken, true, "do not name its file"),
        ("'{'", true, "do not name its file"),
    ];
    for (k, (forged, is_hashed, words)) in tries.into_iter().enumerate() {
        plant.sql(&format!(
            "UPDATE artefact SET content = convert_to({forged}, 'UTF8') WHERE sha256 = (SELECT sha256 FROM lesson WHERE cell = 1)"
        ));
        if is_hashed {
            plant.sql(
                "INSERT INTO artefact (sha256, bytes, content) SELECT sha256(a.content), length(a.content), a.content
                     FROM artefact a JOIN lesson USING (sha256) WHERE lesson.cell = 1 ON CONFLICT DO NOTHING;
                 UPDATE lesson l SET sha256 = sha256(a.content) FROM artefact a WHERE a.sha256 = l.sha256 AND l.cell = 1",
            );
        }
        let (_, said) = made(&plant, "cell-2", "2");
        assert!(said.contains(&format!("{taught_by} of cell-1")) && said.contains("is ignored"), "{said}");
        assert!(said.contains(words) && said.contains("begins without knowledge"), "{said}");
        let last = plant.incidents().pop().unwrap();
        assert!(last["what"] == "a lesson refused" && last["by"] == "cell-2", "{last}");
        fs::rename(plant.path("cell-2"), plant.path(&format!("aside-{k}"))).unwrap();
    }
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn only_signed_runs_teach() {
    let (plant, _) = taught();
    states(&plant, "0.1");
    let lessons = || plant.sql("SELECT count(*) FROM lesson");
    let ship = |cell: &str| {
        let file = format!("{cell}.toml");
        crate::run(&["ship", "--once", "--plant", &file, "--runs", cell], plant.home.path())
    };
    // A cell without a key, one with a key that nobody knows, and one whose key signs for another cell.
    plant.cell("cell-3", &[]);
    let unknown = plant.path("unknown.key").display().to_string();
    plant.does(&["audit", "key", "--key", &unknown]);
    let of_another = plant.path("cell-2.key").display().to_string();
    for (seed, key) in [("3", ""), ("4", &unknown[..]), ("5", &of_another[..])] {
        // The run says it, or the first service that ships the rest of it.
        let (_, said) = made_with(&plant, "cell-3", seed, key);
        let (code, out, errors) = ship("cell-3");
        assert!(
            code == 0 && format!("{said}{errors}").contains("it teaches no other cell"),
            "{key}: {code} {said}{out}{errors}"
        );
        assert_eq!(lessons(), "1", "{key}");
        // It is whole at the plant, so a later start does not read it again.
        let (code, out, errors) = ship("cell-3");
        assert!(code == 0 && errors.is_empty() && out.is_empty(), "{key}: {code} {out}{errors}");
    }
    assert_eq!(plant.sql("SELECT count(*) FROM incident"), "0", "a cell without a key is no incident");
    // A seal with the name of a known key and the signature of nobody passes the database, and no cell.
    plant.sql(
        "INSERT INTO cell_key SELECT id, key FROM cell CROSS JOIN (SELECT key FROM cell_key LIMIT 1) k WHERE name = 'cell-3';
         UPDATE record SET text = regexp_replace(text, '\"key\":\"[0-9a-f]{64}\"', '\"key\":\"' || (SELECT key FROM cell_key LIMIT 1) || '\"')
            WHERE text LIKE '%\"kind\":\"seal\"%' AND run IN (SELECT r.id FROM run r JOIN cell c ON c.id = r.cell WHERE c.name = 'cell-3')",
    );
    let taught = "SELECT count(teach(r.id, l.kind, a.sha256)) FROM run r JOIN run_artefact a ON a.run = r.id AND a.name = 'learned.json'
        CROSS JOIN (SELECT kind FROM kind_for_test) l JOIN record e ON e.run = r.id AND e.seq = r.records AND e.text LIKE '%\"kind\":\"seal\"%'";
    plant.sql("CREATE VIEW kind_for_test AS SELECT kind FROM lesson WHERE cell = 1; GRANT SELECT ON kind_for_test TO regrind_cell");
    assert_eq!(plant.asked_by("cell-3", taught).unwrap(), "0", "none is refused");
    assert_eq!(lessons(), "3");
    let (_, said) = made(&plant, "cell-2", "2");
    assert!(
        said.contains("of cell-3 is ignored: ") && said.contains("is not signed with one of the given keys"),
        "{said}"
    );
    assert!(said.contains("begins with"), "the signed one teaches: {said}");
    assert_eq!(plant.incidents().last().unwrap()["what"], "a lesson refused");
    // A cell that was retired teaches nothing more.
    plant.does(&["plant", "retire", "cell-1", "--plant", "owner.toml"]);
    assert_eq!(
        plant.asked_by("cell-2", "SELECT cell FROM lessons((SELECT kind FROM kind_for_test), true)").unwrap(),
        "cell-3"
    );
}
