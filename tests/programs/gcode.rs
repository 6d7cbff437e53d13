//! Contents of a program, and which parts have none.

use crate::path::{correction, part, part_from_below, read};
use std::fs;

#[test]
fn header_marks_program_from_below() {
    let part = part_from_below("shallow-wave");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("part.ngc");
    part.programs.write(&file, &correction(part.half_mm), [9; 32]).unwrap();
    let text = fs::read_to_string(&file).unwrap();
    let frame = text.lines().find(|line| line.starts_with("(frame: model")).expect("a frame");
    for piece in ["z into the part", "from -z", "G54"] {
        assert!(frame.contains(piece), "{piece}: {text:.2000}");
    }
}

#[test]
fn header_content_and_counts() {
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
        let within = |v: f64| v >= summary.min_mm[k] - 1e-6 && v <= summary.max_mm[k] + 1e-6;
        assert!(steps.iter().all(|s| s.at[k].is_nan() || within(s.at[k])));
    }
    // The wheel lowers and lifts beyond the edge of the part, and travels above it.
    assert!(text.lines().filter(|line| line.starts_with("G0")).count() > 100);
}
