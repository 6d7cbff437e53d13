//! Programs as LinuxCNC's own interpreter reads them: `rs274 -g` of the package linuxcnc-uspace.
//!
//! Where the interpreter is not installed the tests say so and leave themselves out, unless REGRIND_LINUXCNC is set.

mod common {
    pub mod path;
    pub mod rs274;
}

use std::fs;
use std::path::Path;

use common::path::{correction, part, read, wheels, with};
use common::rs274::interpret;
use regrind::compensation::path::{PathError, Pattern};
use regrind::config::CellConfig;
use regrind::formats::gcode::PathMode;
use regrind::recipe::Recipe;
use regrind::setup;

/// Where a straight feed (true) or a rapid (false) ends.
type End = ([f64; 3], bool);

/// Where the interpreter's moves end, or what it says against the program.
fn interpreted(file: &Path) -> Option<Result<Vec<End>, String>> {
    let ends = |text: String| {
        let ends = text.lines().filter_map(|line| {
            let (call, rest) = line.split_once("STRAIGHT_")?.1.split_once('(')?;
            let mut numbers = rest.trim_end_matches(')').split(',').map(|n| n.trim().parse::<f64>().unwrap());
            Some(([numbers.next()?, numbers.next()?, numbers.next()?], call == "FEED"))
        });
        ends.collect()
    };
    Some(interpret(file)?.map(ends))
}

#[test]
fn every_program_of_every_recipe_is_read_point_by_point() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["freeform-mirror", "off-axis-asphere", "shallow-wave", "biconic"] {
        let mut part = part(name);
        let plain = part.programs.options;
        for (wheel_name, wheel) in wheels(0.8) {
            for pattern in [Pattern::Raster { one_way: false }, Pattern::Raster { one_way: true }, Pattern::Spiral] {
                let spaced = if pattern == Pattern::Spiral { 3.0 } else { 6.0 };
                part.programs.options =
                    regrind::compensation::path::PathOptions { pattern, ..with(&plain, wheel, spaced) };
                let file = folder.path().join("part.ngc");
                part.programs.write(&file, &correction(part.half_mm), [9; 32]).unwrap();
                let text = fs::read_to_string(&file).unwrap();
                let Some(ends) = interpreted(&file) else { return };
                let ends = ends.unwrap_or_else(|said| panic!("{name}, {wheel_name}, {pattern:?}: {said}"));
                let ours: Vec<_> = read(&text);
                assert_eq!(ends.len(), ours.len(), "{name}, {wheel_name}, {pattern:?}");
                for (theirs, step) in ends.iter().zip(&ours).filter(|(_, step)| !step.at[0].is_nan()) {
                    // It prints four decimals.
                    let off = (0..3).map(|k| (theirs.0[k] - step.at[k]).abs()).fold(0.0, f64::max);
                    assert!(off < 0.6e-4 && theirs.1 == step.feed, "{name}, {wheel_name}: {theirs:?} {step:?}");
                }
            }
        }
    }
}

#[test]
fn every_path_mode_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("part.ngc");
    let mut part = part("shallow-wave");
    part.programs.options = with(&part.programs.options, part.programs.options.wheel, 6.0);
    let rounded = PathMode::Blend { tolerance_mm: 0.01, naive_mm: 0.001 };
    for mode in [PathMode::default(), rounded, PathMode::ExactPath, PathMode::ExactStop] {
        part.programs.mode = mode;
        part.programs.write(&file, &correction(part.half_mm), [9; 32]).unwrap();
        let Some(ends) = interpreted(&file) else { return };
        assert!(!ends.unwrap_or_else(|said| panic!("{mode:?}: {said}")).is_empty());
    }
}

#[test]
fn a_part_that_is_worked_on_from_below_has_no_program() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let recipe = Recipe::read(&root.join("recipes/telescope-panel.toml")).unwrap();
    let cell = CellConfig::read(&root.join("config/file-exchange.toml")).unwrap();
    let (task, _) = setup::prepare(&recipe, &cell).unwrap();
    assert_eq!(task.programs.err(), Some(PathError::OtherSide));
}

#[test]
fn the_interpreter_is_one_that_refuses() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bad.ngc");
    fs::write(&file, "G21 G90\nG1 X1 F100\nG1 X1.5e3\nM2\n").unwrap();
    let Some(ends) = interpreted(&file) else { return };
    let said = ends.unwrap_err();
    assert!(said.contains("G1 X1.5e3"), "it names the line: {said}");
}

#[test]
fn a_header_says_what_a_person_needs_and_counts_right() {
    let part = part("freeform-mirror");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("part.ngc");
    let summary = part.programs.write(&file, &correction(part.half_mm), [9; 32]).unwrap();
    let text = fs::read_to_string(&file).unwrap();
    assert!(text.starts_with("(SIMULATION)\n"));
    let hash = "09".repeat(32);
    let lines = text.lines().count();
    for words in [
        "(part: free-form mirror)",
        "(cycle: 2)",
        &format!(
            "(part: sha256 {})",
            part.programs.part_identity.iter().map(|b| format!("{b:02x}")).collect::<String>()
        ),
        &format!("(map: sha256 {hash})"),
        "(level over the nominal surface: 0.02 mm)",
        "(feed: 1000 mm/min)",
        &format!("(points: {})", summary.points),
        &format!("(lines: {lines})"),
        "G21 G90 G94 G17 G40 G49 G80 G54",
        "G64 P0.0001 Q0",
    ] {
        assert!(text.lines().any(|line| line == words), "{words} is missing");
    }
    assert!(text.ends_with("\nM2\n"));
    assert!(text.lines().all(|line| line.len() < 256 && line.matches('(').count() <= 1 && line.is_ascii()));
    let steps = read(&text);
    for k in 0..3 {
        let within = |v: f64| v >= summary.least_mm[k] - 1e-6 && v <= summary.most_mm[k] + 1e-6;
        assert!(steps.iter().all(|s| s.at[k].is_nan() || within(s.at[k])));
    }
    // The wheel comes down and goes up beyond the edge of the part, and travels above it.
    assert!(text.lines().filter(|line| line.starts_with("G0")).count() > 100);
}
