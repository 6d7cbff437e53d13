//! With chosen touches, a fault of the measurement is found within the first ten, whether the results come over a
//! serial line or as files.

use std::fs;
use std::path::{Path, PathBuf};

use crate::program::{Running, changed, records_with, regrind, run, run_folders};
use regrind::recipe::Recipe;
use regrind_sim::payload::{Feature, Plan, PointRecord, Status, Target};
use regrind_sim::spec::WorldSpec;
use regrind_sim::world::World;
use regrind_testcell::outlived::on_serial_lines;
use regrind_testcell::study::touch;
use serde_json::Value;

/// Fault, the replacement in the recipe's world that causes it, and the alarm that reports it.
const WRONG: [(&str, [&str; 2], &str); 4] = [
    (
        "mirrored",
        ["[simulation.part]", "[simulation.faults]\ncmm_mirrored = true\n\n[simulation.part]"],
        "registration_failed",
    ),
    ("inches", ["[simulation.part]", "[simulation.faults]\ninches = true\n\n[simulation.part]"], "inches"),
    (
        "wrong radius",
        ["[simulation.part]", "[simulation.cmm]\nprobe_radius_error_um = 50.0\n\n[simulation.part]"],
        "probe_radius",
    ),
    (
        "wrong part",
        [
            "j = 4, value_mm = 1.2 },\n]",
            "j = 4, value_mm = 1.2 },\n{ i = 3, j = 0, value_mm = 0.8 }]\n\n[simulation.faults]\nwrong_shape = true",
        ],
        "registration_failed",
    ),
];

/// Returns the free-form recipe with chosen touches, for a part that is measured first, in a world with this
/// replacement.
fn recipe([from, to]: [&str; 2]) -> String {
    changed(
        "recipes/freeform-mirror.toml",
        &[
            ("[registration]", "[measuring]\nmode = \"adaptive\"\naccepted_risk = 0.025\n\n[registration]"),
            ("[cycle]\n", "[cycle]\nbegin_with = \"measure\"\n"),
            ("seed = 1\n", "seed = 1\nspeed = 3000.0\n"),
            (from, to),
        ],
    )
}

/// Waits for the alarm of a run and ends the run. Returns how many targets of the part were touched by then.
fn touched_until(running: &mut Running, folder: &Path, alarm: &str, what: &str) -> u64 {
    let name = format!("\"{alarm}\"");
    running.line("alarm", |line| line.contains("\"clears\""));
    let said = running.output_lines.last().unwrap().clone();
    assert!(said.contains(&name), "{what}: {said}");
    let home = folder.parent().unwrap().parent().unwrap();
    let (code, _, told) = run(&["stop", &folder.display().to_string()], home);
    assert_eq!(code, 0, "{what}: {told}\n{}", running.output_lines.join("\n"));
    running.end();
    let collected = records_with(folder, "targets").into_iter().filter(|event| event["event"] == "collected");
    collected.map(|event| event["targets"].as_u64().unwrap()).sum()
}

/// Waits for the run below a home folder and returns its folder.
fn begun_run(home: &Path, running: &mut Running) -> PathBuf {
    running.until("a run folder", |_| run_folders(&home.join("runs")).pop())
}

#[test]
fn faults_found_over_serial_line() {
    for (what, world, alarm) in WRONG {
        let home = tempfile::tempdir().unwrap();
        let _machines = on_serial_lines(regrind, home.path(), recipe(world));
        let mut running =
            Running::new(regrind(&["run", "part.toml", "--cell", "cell.toml", "--loaded", "--json"], home.path()));
        let folder = begun_run(home.path(), &mut running);
        let touched = touched_until(&mut running, &folder, alarm, what);
        assert!((1..=10).contains(&touched), "{what}: {touched} touches");
    }
}

#[test]
fn faults_found_by_file_exchange() {
    for (what, world, alarm) in WRONG {
        let home = tempfile::tempdir().unwrap();
        let text = recipe(world);
        fs::write(home.path().join("part.toml"), &text).unwrap();
        file_cell(home.path());
        let table = Recipe::read(&home.path().join("part.toml")).unwrap().simulation.unwrap();
        let world = World::new(table.try_into::<WorldSpec>().unwrap()).unwrap();
        let mut running =
            Running::new(regrind(&["run", "part.toml", "--cell", "cell.toml", "--loaded", "--json"], home.path()));
        let folder = begun_run(home.path(), &mut running);
        measure_once(&mut running, home.path(), &world);
        let touched = touched_until(&mut running, &folder, alarm, what);
        assert!((1..=10).contains(&touched), "{what}: {touched} touches");
    }
}

/// Writes a cell file with file-exchange machines next to the recipe, aligned as the simulated machines are.
pub(crate) fn file_cell(home: &Path) {
    for folder in ["cmm/in", "cmm/out", "grinder/in", "grinder/out"] {
        fs::create_dir_all(home.join("exchange").join(folder)).unwrap();
    }
    let text = changed(
        "config/file-exchange.toml",
        &[
            ("../exchange", "exchange"),
            ("stable_for_s = 2.0", "stable_for_s = 0.05"),
            ("[0.0, 0.0, 3600.0]", "[0.0, 0.0, 0.0]"),
            ("[-26.56505117707799, 0.0, 0.0]", "[0.0, 0.0, 0.0]"),
            ("max_feed_mm_min = 6000.0", "max_feed_mm_min = 20000.0"),
            (
                "[grinder.wire]",
                "[cmm.reference_sphere]\ncentre_mm = [0.0, 120.0, 20.0]\nradius_mm = 12.5\npoints = 25\n\n[grinder.wire]",
            ),
        ],
    );
    fs::write(home.join("cell.toml"), text).unwrap();
}

/// Does the work of the person at the measuring machine: takes the plan, touches, and hands in the result.
fn measure_once(running: &mut Running, home: &Path, world: &World) {
    let handed_over = open_plan(running, home);
    let result = measured(&handed_over, world);
    hand_in(home, &result);
}

/// Waits for a plan in the outbox and returns its folder.
pub(crate) fn open_plan(running: &mut Running, home: &Path) -> PathBuf {
    let outbox = home.join("exchange/cmm/out");
    running.until("a plan in the outbox", |_| {
        let names = fs::read_dir(&outbox).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
        // The folder gets its final name when it is complete, and another suffix when it is finished.
        names.filter(|name| !name.contains('.')).map(|name| outbox.join(name)).next()
    })
}

/// Touches the targets of a plan and returns the result file: one row per point, with index and ball centre.
pub(crate) fn measured(handed_over: &Path, world: &World) -> String {
    let told: Value = serde_json::from_slice(&fs::read(handed_over.join("plan.json")).unwrap()).unwrap();
    let rows = fs::read_to_string(handed_over.join("plan.csv")).unwrap();
    let number = |key: &str| told[key].as_f64().unwrap_or_else(|| panic!("{key} in {told}"));
    let plan = Plan {
        probe_radius_mm: number("probe_radius_mm"),
        approach_mm: number("approach_mm"),
        search_mm: number("search_mm"),
        speed_mm_s: number("speed_mm_s"),
        safe_height_mm: number("safe_height_mm"),
        careful: (0, 0.0),
        targets: rows.lines().filter(|row| !row.starts_with('#')).skip(1).map(target).collect(),
    };
    let row = |found: PointRecord| {
        let [x, y, z] = found.position_mm;
        format!("{},{x},{y},{z}\n", found.index)
    };
    let found = touch(world, 1, &plan).into_iter().filter(|found| found.status == Status::Touched);
    format!("# plan: {}\nindex,x,y,z\n{}", told["plan"].as_str().unwrap(), found.map(row).collect::<String>())
}

/// Puts a result into the inbox, and gives it its final name when it is complete.
pub(crate) fn hand_in(home: &Path, result: &str) {
    fs::write(home.join("result.csv"), result).unwrap();
    fs::rename(home.join("result.csv"), home.join("exchange/cmm/in/result.csv")).unwrap();
}

/// Parses a row of a plan: index, point, normal, and the object that it belongs to.
fn target(row: &str) -> Target {
    let cells: Vec<&str> = row.split(',').collect();
    let three = |from: usize| std::array::from_fn(|k| cells[from + k].parse().unwrap());
    let feature = if cells[7] == "2" { Feature::ReferenceSphere } else { Feature::Part };
    Target { index: cells[0].parse().unwrap(), feature, point_mm: three(1), normal: three(4) }
}
