//! A whole run, without hardware, with a measuring machine that prints its hits on a serial line.
#![cfg(unix)]

use std::fs;

use crate::program::{Running, changed, regrind, root, run};

#[test]
fn part_made_from_hit_lines() {
    let home = tempfile::tempdir().unwrap();
    let recipe = home.path().join("wave.toml");
    fs::write(
        &recipe,
        changed("recipes/shallow-wave.toml", &[("[simulation]\nseed = 1", "[simulation]\nseed = 1\nspeed = 2000.0")]),
    )
    .unwrap();
    let cell = root().join("config/hit-lines.toml");
    let typed = ["run", recipe.to_str().unwrap(), "--cell", cell.to_str().unwrap(), "--runs", "runs"];
    let mut program = Running::new(regrind(&typed, home.path()));
    let folder = program.folder(home.path());
    program.line("the end", |line| line.contains("ACCEPTED"));
    let (code, errors) = program.end();
    assert_eq!(code, 0, "{}\n{errors}", program.output_lines.join("\n"));
    assert!(
        program.output_lines.iter().any(|line| line.contains("cycle-1/plan.csv")),
        "{}",
        program.output_lines.join("\n")
    );
    // Each line is stored as it arrived, with the target that it was assigned to.
    let lines = fs::read_to_string(folder.join("cycle-1/hits.jsonl")).unwrap();
    let targets = fs::read_to_string(folder.join("cycle-1/plan.csv")).unwrap();
    let targets = targets.lines().filter(|line| line.starts_with(|c: char| c.is_ascii_digit())).count();
    assert_eq!(lines.lines().filter(|line| line.contains("\"target\":")).count(), targets);
    let (code, told, _) = run(&["audit", "verify"], home.path());
    assert_eq!(code, 0, "{told}");
}
