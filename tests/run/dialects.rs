//! Whole parts on a grinder that runs programs from a folder, each in the dialect of another control.

use std::fs;

use regrind_testutils::sample::cases;

use crate::program::{changed, only_run, run, small_recipe};

/// Returns the simulated cell with a `program` section and long timeouts. The grinder reads megabytes of a program
/// before it answers, and a stall of the computer must not look like a machine that is gone.
fn cell(program: &str) -> String {
    let patience = "[grinder.timing]\nrequest_timeout_ms = 10000\nlost_after_ms = 60000";
    changed("config/sim.toml", &[("[grinder.timing]", patience), ("[grinder.limits]", program)])
}

/// Makes the small mirror in a simulated cell whose control reads its programs from a folder.
fn made(dialect: &str, more: &str) -> (tempfile::TempDir, i32, String, String) {
    let home = tempfile::tempdir().unwrap();
    fs::create_dir(home.path().join("programs")).unwrap();
    let program =
        format!("[grinder.program]\ndialect = \"{dialect}\"\nfolder = \"programs\"\n{more}\n[grinder.limits]");
    fs::write(home.path().join("cell.toml"), cell(&program)).unwrap();
    let recipe = small_recipe(home.path(), 1e4).display().to_string();
    let (code, said, errors) = run(&["run", &recipe, "--cell", "cell.toml", "--runs", "runs", "--loaded"], home.path());
    (home, code, said, errors)
}

#[test]
fn part_accepted_in_every_dialect() {
    let all = [("fanuc", "nc", "controller_tolerance_um = 0.1"), ("sinumerik", "mpf", ""), ("heidenhain", "h", "")];
    for (dialect, extension, more) in cases(all, 3) {
        let (home, code, said, errors) = made(dialect, more);
        assert_eq!(code, 0, "{dialect}: {said}{errors}");
        assert!(said.contains("SIMULATION  ACCEPTED"), "{dialect}: {said}");
        let there = fs::read_dir(home.path().join("programs")).unwrap().map(|entry| entry.unwrap().path());
        let programs: Vec<_> = there.filter(|file| file.extension().is_some_and(|e| e == extension)).collect();
        // One program for each pass.
        assert!(programs.len() >= 2, "{dialect}: {programs:?}");
        let kept = only_run(&home.path().join("runs"));
        let of_first = fs::read(kept.join(format!("cycle-0/toolpath.{extension}"))).unwrap();
        assert!(programs.iter().any(|file| fs::read(file).unwrap() == of_first), "{dialect}");
    }
}

/// Makes the small mirror with a tilted wheel, in a simulated cell with this head.
fn tilted(tilt: &str, dialect: &str, rotary: &str) -> (tempfile::TempDir, i32, String, String) {
    let home = tempfile::tempdir().unwrap();
    fs::create_dir(home.path().join("programs")).unwrap();
    let program = format!("{dialect}\n{rotary}\n[grinder.limits]");
    fs::write(home.path().join("cell.toml"), cell(&program)).unwrap();
    let recipe = small_recipe(home.path(), 1e4);
    let text = fs::read_to_string(&recipe).unwrap();
    fs::write(&recipe, text.replace("[grinding.wheel]", &format!("{tilt}\n[grinding.wheel]"))).unwrap();
    let recipe = recipe.display().to_string();
    let (code, said, errors) = run(&["run", &recipe, "--cell", "cell.toml", "--runs", "runs", "--loaded"], home.path());
    (home, code, said, errors)
}

const FOLLOWING: &str = "[grinding.tilt]\nlean = \"following\"\nangle_deg = 25.0";
const HEAD: &str = "[grinder.rotary]\naxis = \"B\"\nreversed = true\nleast_deg = -80.0\nmost_deg = 80.0\nlargest_rate_deg_min = 36000.0";

#[test]
fn part_accepted_with_tilted_ball() {
    let all = [
        ("[grinder.program]\ndialect = \"sinumerik\"\nfolder = \"programs\"", HEAD.to_owned()),
        ("[grinder.program]\nfolder = \"programs\"", format!("{HEAD}\npivot_mm = [3.0, 0.0, 180.0]")),
    ];
    for (dialect, head) in cases(all, 2) {
        let (home, code, said, errors) = tilted(FOLLOWING, dialect, &head);
        assert_eq!(code, 0, "{dialect}: {said}{errors}");
        assert!(said.contains("SIMULATION  ACCEPTED"), "{dialect}: {said}");
        let program = fs::read_dir(home.path().join("programs")).unwrap().next().unwrap().unwrap().path();
        let text = fs::read_to_string(program).unwrap();
        assert!(text.lines().filter(|line| line.contains("B-")).count() > 1000, "{dialect}");
        // A table of Z values contains no tilt.
        let kept = only_run(&home.path().join("runs"));
        assert!(!kept.join("cycle-0/toolpath_z.csv").exists());
    }
}

#[test]
fn tilt_needs_capable_machine() {
    let folder = "[grinder.program]\nfolder = \"programs\"";
    let narrow = HEAD.replace("-80.0", "-20.0");
    for (dialect, head, why) in [
        (folder, "", "[grinder.rotary]"),
        (folder, narrow.as_str(), "grinding.tilt.angle_deg by"),
        ("", HEAD, "grinder.program.folder"),
    ] {
        let (home, code, said, errors) = tilted(FOLLOWING, dialect, head);
        assert_ne!(code, 0, "{said}");
        assert!(errors.contains(why), "{why}: {errors}{said}");
        assert!(fs::read_dir(home.path().join("programs")).unwrap().next().is_none());
    }
}

#[test]
fn part_accepted_along_arcs() {
    for (dialect, extension, word) in
        cases([("heidenhain", "h", " DR+"), ("fanuc", "nc", "G03 "), ("sinumerik", "mpf", "G3 ")], 3)
    {
        let (home, code, said, errors) = made(dialect, "controller_tolerance_um = 0.1\narcs_within_um = 0.1");
        assert_eq!(code, 0, "{dialect}: {said}{errors}");
        assert!(said.contains("SIMULATION  ACCEPTED"), "{dialect}: {said}");
        let there = fs::read_dir(home.path().join("programs")).unwrap().map(|entry| entry.unwrap().path());
        let programs: Vec<_> = there.filter(|file| file.extension().is_some_and(|e| e == extension)).collect();
        assert!(programs.len() >= 2, "{dialect}: {programs:?}");
        for program in programs {
            let text = fs::read_to_string(program).unwrap();
            assert!(text.lines().filter(|line| line.contains(word)).count() > 20, "{dialect}");
        }
    }
}

#[test]
fn arcs_beyond_tolerance_refused() {
    // Four decimals move points by 0.087 µm. The lines of the recipe are within 0.1 µm.
    for (dialect, um, told) in
        [("heidenhain", "0.05", "grinder.program.arcs_within_um"), ("sinumerik", "0.2", "grinding.chord_error_um")]
    {
        let (home, code, said, errors) = made(dialect, &format!("arcs_within_um = {um}"));
        assert_eq!(code, 2, "{said}{errors}");
        assert!(errors.contains(told) && errors.contains(um), "{errors}");
        assert!(!home.path().join("runs").exists());
    }
}

#[test]
fn fanuc_needs_controller_tolerance() {
    let (home, code, said, errors) = made("fanuc", "");
    assert_eq!(code, 2, "{said}{errors}");
    assert!(errors.contains("grinder.program.controller_tolerance_um"), "{errors}");
    assert!(!home.path().join("runs").exists() && fs::read_dir(home.path().join("programs")).unwrap().next().is_none());
}
