//! A wheel whose radius is not the stated one. With the radius compensated as a parameter, the part is good after fewer
//! passes than with the map alone, and the record shows which part of the error each of the two compensates.

use std::fs;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use regrind_testcell::study::identifiability::Compared;
use regrind_testcell::study::{After, Bench};
use regrind_testutils::sample::seeds;
use serde_json::Value;

use crate::program::{Running, changed, only_run, regrind, root, run, run_folders};

/// A good machine with a wheel whose radius is 0.4 mm too large. The part has at most 1.6 touches per square
/// centimetre.
const GRINDER: &str = "[simulation.grinder]\nwheel_radius_error_um = 400.0\nstraightness_x_um = [0.2, -0.2]\nstraightness_y_um = [-0.2, 0.1]\n\
                       waviness_um = 0.15\nperiodic_um = 0.05\nwear_um = 0.6\nbreak_in_um = 0.2\nthermal_um = 0.8\nfollowing_um = 0.05\nscallops = false\n";
const TAKEN: &str = "[compensation.parameters]\nwheel_radius_um = 600.0\n\n";

fn recipe(parameters: &str, accepted_um: f64) -> String {
    let (grinding, accepted) = (format!("{parameters}[grinding]\n"), format!("rms_um = {accepted_um:.2}"));
    let simulation = format!("[simulation]\nseed = 9\nspeed = 1e6\n\n{GRINDER}");
    let changes = [
        ("columns = 60", "columns = 14"),
        ("rows = 30", "rows = 9"),
        ("accuracy_nm = 0.5", "spacing_mm = 0.5"),
        ("cutoff_mm = 5.0", "cutoff_mm = 22.0\nrepeatability_um = 0.4"),
        ("max_correction_um = 60.0", "max_correction_um = 120.0"),
        ("pv_um = 7.0\n", ""),
        ("rms_um = 1.0", &accepted),
        ("[grinding]\n", &grinding),
        ("[simulation]\nseed = 1\n", &simulation),
    ];
    changed("recipes/freeform-mirror.toml", &changes)
}

/// Runs a recipe to its end. Returns its folder and all output.
fn ran(home: &Path, recipe: &str) -> (PathBuf, String) {
    fs::write(home.join("mirror.toml"), recipe).unwrap();
    let cell = root().join("config/sim.toml");
    let (_, out, err) = run(&["run", "mirror.toml", "--cell", cell.to_str().unwrap()], home);
    let folder = run_folders(&home.join("runs")).pop().unwrap_or_else(|| panic!("{out}{err}"));
    (folder, out + &err)
}

fn rms_um(folder: &Path, cycle: usize) -> Option<f64> {
    let result = fs::read(folder.join(format!("cycle-{cycle}/result.json"))).ok()?;
    let result: Value = serde_json::from_slice(&result).unwrap();
    Some(1e3 * result["figures"]["form"]["rms"]["median_mm"].as_f64()?)
}

#[test]
fn wheel_radius_compensated_in_run() {
    let told = ["", TAKEN].map(|parameters| {
        let home = tempfile::tempdir().unwrap();
        let (folder, said) = ran(home.path(), &recipe(parameters, 0.7));
        let passes: Vec<f64> = (1..).map_while(|cycle| rms_um(&folder, cycle)).collect();
        println!("{passes:.3?}\n{said}");
        if !parameters.is_empty() {
            let read = |name: &str| fs::read_to_string(folder.join(name)).unwrap();
            let result: Value = serde_json::from_str(&read("cycle-1/result.json")).unwrap();
            let radius = &result["parameters"][0];
            let [off, expanded, taken] = ["off", "expanded", "taken"].map(|key| radius[key].as_f64().unwrap());
            assert!((off - 400.0).abs() <= expanded && taken > 0.8 * off, "{radius}");
            let correction = read("cycle-1/correction.csv");
            assert!(correction.contains("# parameter: wheel"), "{}", &correction[..900]);
            assert!(read("cycle-1/toolpath.ngc").contains("parameter: wheel radius"));
            let is_rest = |line: &str| ["cycle ", "correction map", "µm RMS"].iter().all(|piece| line.contains(piece));
            assert!(said.lines().any(is_rest), "{said}");
        }
        passes
    });
    let [alone, with] = told;
    assert!(with.len() < alone.len() && with[1] < alone[1], "{with:?} beside {alone:?}");
}

#[test]
fn parameter_beyond_tolerance_holds_cell() {
    let home = tempfile::tempdir().unwrap();
    let parameters = TAKEN.replace("600.0", "300.0");
    fs::write(home.path().join("mirror.toml"), recipe(&parameters, 0.7)).unwrap();
    let cell = root().join("config/sim.toml");
    let typed = ["run", "mirror.toml", "--cell", cell.to_str().unwrap(), "--runs", "runs", "--json"];
    let mut program = Running::new(regrind(&typed, home.path()));
    program.until("the question, and that it is held", |said| {
        let notices: Vec<Value> = said.iter().map(|line| serde_json::from_str(line).unwrap()).collect();
        let asked = notices.iter().any(|n| n["notice"] == "alarm" && n["id"] == "parameter_beyond");
        let shown = notices.iter().rfind(|n| n["notice"] == "state").map(|n| n["state"].to_string());
        (asked && shown.is_some_and(|state| state.starts_with("\"Held"))).then_some(())
    });
    let folder = only_run(&home.path().join("runs"));
    assert_eq!(run(&["resume", folder.to_str().unwrap(), "--reason", "measured"], home.path()).0, 0);
    let (code, errors) = program.end();
    assert_eq!(code, 0, "{errors}\n{}", program.output_lines.join("\n"));
}

/// Draws a few worlds; `cargo run --release --example parameters` draws two hundred.
#[test]
#[ignore = "worlds are drawn, for .ci/long"]
fn parameters_compensated_in_drawn_worlds() {
    let bench = Bench::new("freeform-mirror").held([false; 6]);
    let made: Vec<Compared> = (1..=seeds(4)).into_par_iter().map(|seed| bench.told_apart(seed, 2)).collect();
    let within = made.iter().flat_map(|world| &world.parameters).filter(|told| told.off.abs() <= 1.0).count();
    let over = |of: fn(&Compared) -> &Vec<After>| {
        let sum = |f: fn(&After) -> f64| made.iter().map(|world| f(&of(world)[1]).powi(2)).sum::<f64>();
        (sum(|a| a.rms_um) / sum(|a| a.floor_um)).sqrt()
    };
    let [with, alone] = [over(|world| &world.with), over(|world| &world.alone)];
    let worlds = made.len();
    println!("within U: {within} of {worlds}; over the floor {with:.2}, by the map alone {alone:.2}");
    assert!(6 * within >= 5 * worlds && with < 1.2 && with < 0.95 * alone, "{within} of {worlds}, {with} and {alone}");
}
