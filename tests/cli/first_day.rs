//! Steps of a first day at the terminal: each says the way on, and none goes on in silence.

use std::fs;

use serde_json::Value;

use crate::program::{run, run_folders, small_recipe};

#[test]
fn folder_for_machines_of_people_can_be_planned() {
    let home = tempfile::tempdir().unwrap();
    let (code, said, errors) = run(&["init", "shop", "--machines", "manual"], home.path());
    assert_eq!(code, 0, "{said}{errors}");
    let (code, said, errors) = run(&["plan", "recipe.toml", "--cell", "cell.toml"], &home.path().join("shop"));
    assert!(code == 0 && said.contains("cycles"), "{said}{errors}");
}

#[test]
fn folder_of_other_part_keeps_nothing_of_the_example() {
    let home = tempfile::tempdir().unwrap();
    let (code, said, _) = run(&["init", "lens", "--part", "Linse Ø40"], home.path());
    assert!(code == 0 && said.contains("the surface in recipe.toml is still that of the example"), "{said}");
    let recipe = fs::read_to_string(home.path().join("lens/recipe.toml")).unwrap();
    assert!(recipe.contains("name = \"Linse Ø40\"") && recipe.contains("# The surface of the example"), "{recipe}");
    assert!(!recipe.contains("FFM-102-062") && !recipe.contains("fused silica"), "{recipe}");
    assert_eq!(run(&["check", "lens/recipe.toml"], home.path()).0, 0);
    let (_, said, _) = run(&["init", "example"], home.path());
    assert!(!said.contains("still that of the example"), "{said}");
}

/// Each mistake is named with the way on, in one line.
#[test]
fn mistakes_are_named_with_the_way_on() {
    let home = tempfile::tempdir().unwrap();
    assert_eq!(run(&["init", "shop"], home.path()).0, 0);
    let rows: String = (0..300).map(|k| format!("{k},{k},{k}\n")).collect();
    fs::write(home.path().join("points.csv"), format!("# mm\n{rows}")).unwrap();
    for (arguments, words) in [
        (&["doctor", "shop/recipe.toml"][..], "regrind doctor --recipe shop/recipe.toml"),
        (&["audit", "verify", "nope"], "no such folder"),
        (&["report", "nope"], "no such folder"),
        (&["serve", "--runs", "nope", "--listen", "127.0.0.1:0"], "mkdir nope"),
        (&["check", "points.csv"], "regrind accuracy"),
    ] {
        let (code, said, errors) = run(arguments, home.path());
        let all = format!("{said}{errors}");
        assert!(code == 2 && all.contains(words), "{arguments:?}: {code} {all}");
        assert!(all.lines().count() <= 2, "{all}");
    }
}

/// The place of the report is printed, and a part that was accepted before is not made again without a word.
#[test]
fn accepted_part_is_named_when_it_is_made_again() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e5).display().to_string();
    let make = |serial: &str| run(&["run", &recipe, "--cell", "sim", "--part", serial], home.path());
    let (code, first, _) = make("SN-1");
    assert!(code == 0 && !first.contains("ACCEPTED before"), "{first}");
    let folder = run_folders(&home.path().join("runs")).remove(0);
    if !cfg!(feature = "pdf") {
        let (code, _, errors) = run(&["report", "--pdf"], home.path());
        assert!(code == 2 && errors.contains("--features pdf"), "{errors}");
    }
    let name = folder.file_name().unwrap().to_str().unwrap();
    assert!(first.contains(&format!("report   runs/{name}/report.html")), "{first}");
    let (_, again, _) = make("SN-1");
    assert!(again.contains(&format!("SN-1 was ACCEPTED before, in runs/{name}")), "{again}");
    assert!(!make("SN-2").1.contains("ACCEPTED before"));
}

/// A pipe gets one line for each phase and one row for each cycle, and at the end the first lines of the report with the
/// figures of the results. No line has a code for colours.
#[test]
fn piped_run_has_a_line_a_phase_and_a_row_a_cycle() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e5).display().to_string();
    let (code, said, errors) = run(&["run", &recipe, "--part", "SN-1"], home.path());
    assert!(code == 0 && !said.contains('\x1b') && !errors.contains('\x1b'), "{said}{errors}");
    let folder = run_folders(&home.path().join("runs")).remove(0);
    let result: Value = serde_json::from_slice(&fs::read(folder.join("result.json")).unwrap()).unwrap();
    let cycles = result["cycles"].as_array().unwrap();
    let lines: Vec<&str> = said.lines().collect();
    for cycle in cycles {
        let number = &cycle["cycle"];
        // A job that is over at once reports no progress, and has no line.
        for (phase, least) in [("grinding", 0), ("measuring, ", 0), ("217 points fetched", 1)] {
            let begin = format!("cycle {number}: {phase}");
            let count = lines.iter().filter(|line| line.starts_with(&begin)).count();
            assert!((least..=1).contains(&count), "{begin}: {said}");
        }
        let of = |key: &str| cycle[key].as_f64().unwrap();
        let [pv, rms] = [format!("{:.2} \u{b1} ", of("judged_pv_um")), format!("{:.3} \u{b1} ", of("judged_rms_um"))];
        let is_row = |line: &&&str| {
            line.starts_with(&format!("{:>5} ", number.as_u64().unwrap())) && line.contains(&pv) && line.contains(&rms)
        };
        assert_eq!(lines.iter().filter(is_row).count(), 1, "{pv} {rms}: {said}");
    }
    let last = cycles.last().unwrap();
    let table = lines.iter().position(|line| line.starts_with("figure ")).unwrap();
    for (line, key) in lines[table + 1..].iter().zip(["judged_pv_um", "judged_rms_um"]) {
        assert!(line.contains(&format!(" {:.2} ", last[key].as_f64().unwrap())), "{key}: {line}");
        assert!(line.ends_with("within the limit") && line.chars().count() <= 80, "{line}");
    }
    assert!(lines.last().unwrap().starts_with("report   runs/"), "{said}");
}
