//! A real measurement through a whole run of the program itself: raw files of a laser tracker, put into an inbox as a
//! person would do.
//!
//! The data are not part of the repository: the variable REGRIND_DATA names their folder.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::program::{Running, changed, only_run, run};
use regrind::journal;
use regrind_testutils::data::data;
use serde_json::Value;

const SESSION: &str = "20250824_M1_1";
const POINTS: usize = 1161;

/// Shop: a cell file with its folders, and a recipe.
struct Shop {
    home: tempfile::TempDir,
    recipe: PathBuf,
    cell: PathBuf,
}

impl Shop {
    /// Creates a shop from the shipped files, with its own folders. `hold` is the recipe's line of that name.
    fn new(data: &Path, hold: &str) -> Self {
        let home = tempfile::tempdir().unwrap();
        for machine in ["cmm", "grinder"] {
            for folder in ["in", "out"] {
                fs::create_dir_all(home.path().join("exchange").join(machine).join(folder)).unwrap();
            }
        }
        fs::create_dir(home.path().join("config")).unwrap();
        let nominal = data.join("nominal/reference.yaml");
        let inbox = "inbox = \"../exchange/grinder/in\"";
        let cell = changed(
            "config/laser-tracker.toml",
            &[
                ("../exchange/cmm/reference.yaml", nominal.to_str().unwrap()),
                ("stable_for_s = 2.0", "stable_for_s = 0.2"),
                (inbox, &format!("{inbox}\nstable_for_s = 0.2")),
            ],
        );
        // The number of points in the files, so that a measurement is never taken before the last file has arrived.
        let points = format!("points = {POINTS}");
        let recipe = changed(
            "recipes/telescope-panel.toml",
            &[("lock = [\"x\", \"y\", \"rz\"]", hold), ("points = 1100", &points)],
        );
        let (recipe_path, cell_path) = (home.path().join("mirror.toml"), home.path().join("config/cell.toml"));
        fs::write(&recipe_path, recipe).unwrap();
        fs::write(&cell_path, cell).unwrap();
        Self { home, recipe: recipe_path, cell: cell_path }
    }

    fn folder(&self, name: &str) -> PathBuf {
        self.home.path().join("exchange").join(name)
    }

    fn command(&self) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_regrind"));
        command.arg("run").arg(&self.recipe).arg("--cell").arg(&self.cell).args(["--part", "M1", "--loaded", "--json"]);
        command.arg("--runs").arg(self.home.path().join("runs"));
        command
    }

    fn run(&self) -> Running {
        Running::new(self.command())
    }

    /// Puts the raw files of all stations into the inbox, unchanged.
    fn deliver(&self, data: &Path) {
        for k in 1..=7 {
            for name in [format!("M1_{k}.txt"), format!("ref_{k}.yaml")] {
                fs::copy(data.join(SESSION).join(&name), self.folder("cmm/in").join(&name)).unwrap();
            }
        }
    }

    fn run_folder(&self) -> PathBuf {
        only_run(&self.home.path().join("runs"))
    }

    /// Returns the only hand-over in an outbox whose name has this ending.
    fn handed_over(&self, outbox: &str, ending: &str) -> Option<PathBuf> {
        let entries = fs::read_dir(self.folder(outbox)).unwrap().map(|e| e.unwrap().path());
        let mut found: Vec<_> = entries
            .filter(|path| {
                let name = path.file_name().unwrap().to_str().unwrap();
                !name.starts_with('.') && name.ends_with(ending)
            })
            .collect();
        assert!(found.len() < 2, "handed over twice: {found:?}");
        found.pop()
    }

    fn confirm(&self, what: &str, map: &str) -> (bool, String) {
        let folder = self.run_folder();
        let (code, told, errors) = run(&["confirm", what, "--map", map, folder.to_str().unwrap()], self.home.path());
        (code == 0, told + &errors)
    }
}

/// Returns the notices that a program with `--json` has printed.
fn notices_of(program: &Running) -> Vec<Value> {
    program.output_lines.iter().map(|line| serde_json::from_str(line).unwrap()).collect()
}

fn notices<'s>(said: &'s [Value], kind: &str) -> Vec<&'s Value> {
    said.iter().filter(|notice| notice["notice"] == kind).collect()
}

fn is_about(found: f64, expected: f64) -> bool {
    (found / expected - 1.0).abs() < 0.01
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn weak_mirror_judged_not_corrected() {
    let data = data("lat-freeform-mirror");
    let shop = Shop::new(&data, "");
    let mut program = shop.run();
    let plan = program.until("the plan", |_| shop.handed_over("cmm/out", ""));
    assert_eq!(plan.file_name().unwrap().to_str().unwrap().split("_j").next(), Some("M1"));
    shop.deliver(&data);
    let (code, _) = program.end();
    let said = notices_of(&program);
    // The run ended in order, but not in tolerance.
    assert_eq!(code, 1, "{said:#?}");
    let figures = &notices(&said, "figures")[0]["figures"];
    let (rms_um, pv_um) = (1e3 * figures["rms_mm"].as_f64().unwrap(), 1e3 * figures["pv_mm"].as_f64().unwrap());
    println!("rms {rms_um:.2} um, PV {pv_um:.1} um, {} points", figures["points"]);
    assert!(is_about(rms_um, 65.3) && is_about(pv_um, 870.1), "rms {rms_um} um, PV {pv_um} um");
    let stations = notices(&said, "note").iter().flat_map(|n| n["words"].as_array().unwrap().clone()).count();
    assert!(stations >= 7, "a line for every station");
    let alarm = notices(&said, "alarm").into_iter().find(|a| a["id"] == "weak_directions").expect("an alarm");
    let what = alarm["what"].as_str().unwrap();
    println!("{what}");
    for words in ["x and y position", "only to 3.", "rotation about z", "registration.lock", "displaced by"] {
        assert!(what.contains(words), "{words}: {what}");
    }
    let folder = shop.run_folder();
    let measured = fs::read_to_string(folder.join("cycle-1/measured.csv")).unwrap();
    assert_eq!(measured.lines().filter(|l| l.starts_with(|c: char| c.is_ascii_digit() || c == '-')).count(), POINTS);
    for (name, there) in [("error_map.csv", true), ("error_map.png", true), ("correction.csv", false)] {
        assert_eq!(folder.join("cycle-1").join(name).is_file(), there, "{name}");
    }
    assert!(shop.handed_over("grinder/out", "").is_none(), "nothing is ground");
    assert!(shop.handed_over("cmm/out", ".done").is_some());
    let verified = journal::verify(&folder).unwrap();
    println!("{verified:?}");
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn locked_mirror_map_handed_over_once() {
    let data = data("lat-freeform-mirror");
    let shop = Shop::new(&data, "lock = [\"x\", \"y\", \"rz\"]");
    let mut program = shop.run();
    program.until("the plan", |_| shop.handed_over("cmm/out", ""));
    shop.deliver(&data);
    let handed = program.until("the map", |_| shop.handed_over("grinder/out", "_c2"));
    let folder = shop.run_folder();
    let json: Value = serde_json::from_slice(&fs::read(handed.join("correction.json")).unwrap()).unwrap();
    let map = json["map"].as_str().unwrap().to_owned();
    assert_eq!(map.len(), 64);
    // The grinder gets the correction that is in the record.
    let kept = fs::read_to_string(folder.join("cycle-1/correction.csv")).unwrap();
    assert!(kept.contains(&map), "the record names the same map");
    let values = |text: &str| -> Vec<f64> {
        let rows = text.lines().filter(|l| l.starts_with(|c: char| c.is_ascii_digit() || c == '-'));
        rows.map(|row| row.rsplit(',').next().unwrap().parse().unwrap()).collect()
    };
    let correction = values(&fs::read_to_string(handed.join("correction.csv")).unwrap());
    assert_eq!(correction.len(), (json["columns"].as_u64().unwrap() * json["rows"].as_u64().unwrap()) as usize);
    let max_um = correction.iter().fold(0.0f64, |most, v| most.max(1e3 * v.abs()));
    println!("{} nodes, up to {max_um:.1} um", correction.len());
    // One target is 630 µm low in three touches, and one neighbour agrees: half of that is in the map.
    assert!(max_um > 20.0 && max_um < 500.0);
    assert!(folder.join("cycle-1/error_map.csv").is_file());
    // The confirmation of a person who works by another map is refused.
    program.until("a pass that is under way", |_| match shop.confirm("started", "00000000") {
        (false, text) if text.contains("the confirmation names") => Some(()),
        (false, text) if text.contains("no pass is in progress") => None,
        told => panic!("{told:?}"),
    });
    program.until("the start to be confirmed", |_| shop.confirm("started", &map[..8]).0.then_some(()));
    assert!(shop.folder("grinder/in").join("started.json").is_file());
    // The end is reported in the other way: the file of the hand-over, copied by hand.
    fs::copy(handed.join("done.json"), shop.folder("grinder/in").join("done.json")).unwrap();
    program.until("the pass to be over", |_| shop.handed_over("grinder/out", "_c2.done"));
    // The next plan. The old files are not an answer to it.
    program.until("the next plan", |_| shop.handed_over("cmm/out", "_c2"));
    let left_alone = |line: &String| line.contains("before the plan");
    program.until("the old files to be left alone", |said| said.iter().any(left_alone).then_some(()));
    assert_eq!(run(&["stop", folder.to_str().unwrap()], shop.home.path()).0, 0);
    let (code, _) = program.end();
    let said = notices_of(&program);
    assert_eq!(code, 1, "a stop is no fault: {said:#?}");
    assert_eq!(notices(&said, "figures").len(), 1, "one measurement");
    let notes: Vec<String> = notices(&said, "note").iter().map(|note| note["words"].to_string()).collect();
    let how = format!("regrind confirm started --map {}", &map[..8]);
    for words in [how.as_str(), "before the plan", "machine at its own panel"] {
        assert!(notes.iter().any(|note| note.contains(words)), "{words}: {notes:#?}");
    }
    assert!(shop.handed_over("cmm/out", "_c2.stopped").is_some());
    assert_eq!(fs::read_dir(shop.folder("grinder/out")).unwrap().count(), 1, "one pass was handed over");
    journal::verify(&folder).unwrap();
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn missing_exchange_folder_refused() {
    let data = data("lat-freeform-mirror");
    let shop = Shop::new(&data, "");
    fs::remove_dir(shop.folder("grinder/in")).unwrap();
    let output = shop.command().output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{told}");
    assert!(told.contains("grinder.wire.inbox") && told.contains("mkdir -p"), "{told}");
    assert!(!shop.home.path().join("runs").exists(), "no run was begun");
}
