//! Programs as LinuxCNC's own interpreter reads them: `rs274 -g` of the package linuxcnc-uspace.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use crate::compensate::Shop;
use crate::generated::Move;
use crate::path::{correction, error_mm, part, read, wheels, with};
use regrind::compensation::path::{PathMode, PathOptions, RotaryAxis, RotationAxis, TiltMode, TrackPattern};
use regrind::geometry::Vector;
use regrind_sim::program::Control;

/// Runs the interpreter on a program. Returns its canonical commands, or its error message. It writes files into the
/// program's folder.
fn interpret(program: &Path) -> Result<String, String> {
    let folder = program.parent().expect("a program stands in a folder");
    let mut command = Command::new("rs274");
    // The interpreter maps its tool file in the home folder into memory: two processes with the same home kill each
    // other (SIGBUS). The tool has no length, so that G43 finds one.
    fs::write(folder.join("tool.tbl"), "T1 P1 Z0.0 D1.0\n").unwrap();
    command.args(["-t", "tool.tbl", "-g"]).arg(program).current_dir(folder).env("HOME", folder).stdin(Stdio::null());
    let output = command.output().expect("rs274 starts: apt-get install linuxcnc-uspace");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    match output.status.success() {
        true => Ok(text(&output.stdout)),
        false => Err(format!("{}: {}", output.status, text(&output.stderr))),
    }
}

/// End of a straight feed (true) or of a rapid (false).
type End = ([f64; 3], bool);

/// Returns the ends of the interpreter's moves, or its error message.
fn interpreted(file: &Path) -> Result<Vec<End>, String> {
    let ends = |text: String| {
        let ends = text.lines().filter_map(|line| {
            let (call, rest) = line.split_once("STRAIGHT_")?.1.split_once('(')?;
            let mut numbers = rest.trim_end_matches(')').split(',').map(|n| n.trim().parse::<f64>().unwrap());
            Some(([numbers.next()?, numbers.next()?, numbers.next()?], call == "FEED"))
        });
        ends.collect()
    };
    interpret(file).map(ends)
}

#[test]
#[ignore = "needs the interpreter of LinuxCNC: Debian package linuxcnc-uspace"]
fn rs274_reads_every_program() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["freeform-mirror", "off-axis-asphere", "shallow-wave", "biconic"] {
        let mut part = part(name);
        let plain = part.programs.options;
        for (wheel_name, wheel) in wheels(0.8) {
            for (pattern, one_way) in
                [(TrackPattern::Raster, false), (TrackPattern::Raster, true), (TrackPattern::Spiral, false)]
            {
                let spaced = if pattern == TrackPattern::Spiral { 3.0 } else { 6.0 };
                part.programs.options =
                    regrind::compensation::path::PathOptions { pattern, one_way, ..with(&plain, wheel, spaced) };
                let file = folder.path().join("part.ngc");
                part.programs.write(&file, &correction(part.half_mm), [9; 32]).unwrap();
                let text = fs::read_to_string(&file).unwrap();
                let ends = interpreted(&file);
                let ends = ends.unwrap_or_else(|said| panic!("{name}, {wheel_name}, {pattern:?}: {said}"));
                let ours: Vec<_> = read(&text);
                assert_eq!(ends.len(), ours.len(), "{name}, {wheel_name}, {pattern:?}");
                for (theirs, step) in ends.iter().zip(&ours).filter(|(_, step)| !step.at[0].is_nan()) {
                    // The interpreter prints four decimals.
                    let off = (0..3).map(|k| (theirs.0[k] - step.at[k]).abs()).fold(0.0, f64::max);
                    assert!(off < 0.6e-4 && theirs.1 == step.feed, "{name}, {wheel_name}: {theirs:?} {step:?}");
                }
            }
        }
    }
}

/// Returns the arcs of the interpreter in order: the numbers of its call, which are ordered by plane.
fn arcs(said: &str) -> Vec<([usize; 3], Vec<f64>)> {
    let mut axes = [0, 1, 2];
    let mut found = Vec::new();
    for line in said.lines() {
        if let Some((_, plane)) = line.split_once("SELECT_PLANE(CANON_PLANE_") {
            axes = match &plane[..2] {
                "XY" => [0, 1, 2],
                "XZ" => [2, 0, 1],
                _ => [1, 2, 0],
            };
        } else if let Some((_, numbers)) = line.split_once("ARC_FEED(") {
            found.push((axes, numbers.trim_end_matches(')').split(',').map(|n| n.trim().parse().unwrap()).collect()));
        }
    }
    found
}

#[test]
#[ignore = "needs the interpreter of LinuxCNC: Debian package linuxcnc-uspace"]
fn rs274_arcs_match_simulated_control() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("part.ngc");
    for (name, pattern) in [
        ("freeform-mirror", TrackPattern::Raster),
        ("biconic", TrackPattern::Raster),
        ("shallow-wave", TrackPattern::Raster),
        ("off-axis-asphere", TrackPattern::Spiral),
    ] {
        let mut part = part(name);
        let options = with(&part.programs.options, part.programs.options.wheel, 4.0);
        part.programs.options = regrind::compensation::path::PathOptions { pattern, ..options };
        part.programs.arcs_within_mm = Some(1e-4);
        part.programs.write(&file, &correction(part.half_mm), [9; 32]).unwrap();
        let ours = Control::Linuxcnc.read(&fs::read_to_string(&file).unwrap()).unwrap();
        let said = interpret(&file).unwrap_or_else(|said| panic!("{name}: {said}"));
        let theirs = arcs(&said);
        let turns: Vec<_> = ours.waypoints.windows(2).filter(|pair| pair[1].arc.is_some()).collect();
        assert!(turns.len() == theirs.len() && turns.len() > 100, "{name}: {} {}", turns.len(), theirs.len());
        for (pair, ([a, b, c], arc)) in turns.iter().zip(&theirs) {
            let (from, to) = (pair[0].at_mm, pair[1].at_mm);
            // The interpreter prints four decimals: ends first, then the centre, the turns (counter-clockwise is
            // positive) and the third axis.
            let near = |x: f64, y: f64| (x - y).abs() < 0.6e-4;
            assert!(near(arc[0], to[*a]) && near(arc[1], to[*b]) && near(arc[5], to[*c]), "{name}: {arc:?} {to:?}");
            let middle = pair[1].position_at(from, 0.5);
            let arm = |at: [f64; 3]| [at[*a] - arc[2], at[*b] - arc[3]];
            let [[x, y], [u, v]] = [arm(from), arm(middle)];
            assert!((x.hypot(y) - u.hypot(v)).abs() < 1e-4, "{name}: {arc:?}");
            assert!(arc[4].abs() == 1.0 && (x * v - y * u).signum() == arc[4], "{name}: {arc:?}");
        }
    }
}

#[test]
#[ignore = "needs the interpreter of LinuxCNC: Debian package linuxcnc-uspace"]
fn rs274_reads_tilted_programs() {
    let folder = tempfile::tempdir().unwrap();
    let mut part = part("freeform-mirror");
    let plain = part.programs.options;
    for (about, pivot_mm, lead_rad) in [
        (RotationAxis::Y, None, 0.35),
        (RotationAxis::Y, Some(Vector::new(0.0, 0.0, 180.0)), 0.35),
        (RotationAxis::X, Some(Vector::new(5.0, 0.0, 180.0)), -0.5),
    ] {
        let letter = if about == RotationAxis::X { 'A' } else { 'B' };
        let rotary = RotaryAxis {
            letter,
            axis: about,
            reversed: false,
            range_rad: [-2.0, 2.0],
            rate_rad_s: 1e3,
            step_rad: 1e-6f64.to_radians(),
            pivot_mm,
        };
        let lean = Some(TiltMode::Following { lead_rad });
        part.programs.options = PathOptions { rotary: Some(rotary), tilt: lean, ..with(&plain, wheels(0.8)[0].1, 6.0) };
        let file = folder.path().join("part.ngc");
        part.programs.write(&file, &correction(part.half_mm), [9; 32]).unwrap();
        let calls = interpret(&file).unwrap_or_else(|said| panic!("{letter}: {said}"));
        assert_eq!(fs::read_to_string(&file).unwrap().contains("\nG93\n"), pivot_mm.is_some(), "{letter}");
        let theirs: Vec<[f64; 4]> = calls
            .lines()
            .filter_map(|line| line.split_once("STRAIGHT_")?.1.split_once('('))
            .map(|(_, rest)| rest.trim_end_matches(')').split(',').map(|n| n.trim().parse::<f64>().unwrap()).collect())
            .map(|numbers: Vec<f64>| [numbers[0], numbers[1], numbers[2], numbers[if letter == 'A' { 3 } else { 4 }]])
            .collect();
        let ours = Control::Linuxcnc.read(&fs::read_to_string(&file).unwrap()).unwrap().waypoints;
        assert_eq!(theirs.len(), ours.len(), "{letter}");
        for (theirs, stop) in theirs.iter().zip(&ours).filter(|(_, stop)| stop.rotary_deg.is_some()) {
            // The interpreter prints four decimals.
            let [x, y, z] = stop.at_mm;
            let off =
                [x, y, z, stop.rotary_deg.unwrap()].iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(off < 0.6e-4, "{letter}: {theirs:?} {stop:?}");
        }
    }
}

#[test]
#[ignore = "needs the interpreter of LinuxCNC: Debian package linuxcnc-uspace"]
fn rs274_reads_every_path_mode() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("part.ngc");
    let mut part = part("shallow-wave");
    part.programs.options = with(&part.programs.options, part.programs.options.wheel, 6.0);
    let blend = PathMode::Blend;
    for (mode, tolerance_mm) in [(blend, 1e-4), (blend, 0.01), (PathMode::ExactPath, 0.0), (PathMode::ExactStop, 0.0)] {
        (part.programs.mode, part.programs.path_tolerance_mm) = (mode, tolerance_mm);
        part.programs.write(&file, &correction(part.half_mm), [9; 32]).unwrap();
        let ends = interpreted(&file);
        assert!(!ends.unwrap_or_else(|said| panic!("{mode:?}: {said}")).is_empty());
    }
}

#[test]
#[ignore = "needs the interpreter of LinuxCNC: Debian package linuxcnc-uspace"]
fn rs274_refuses_bad_program() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bad.ngc");
    fs::write(&file, "G21 G90\nG1 X1 F100\nG1 X1.5e3\nM2\n").unwrap();
    let ends = interpreted(&file);
    let said = ends.unwrap_err();
    assert!(said.contains("G1 X1.5e3"), "it names the line: {said}");
}

#[test]
#[ignore = "needs the interpreter of LinuxCNC: Debian package linuxcnc-uspace"]
fn rs274_reads_corrected_programs() {
    let program = "%\nG21 G90 G17 G64 P0.001\nG0 Z5\nG0 X-10 Y0\nG1 Z0 F300\nG1 X10\nG2 X-10 Y0 I-10 J0\nG18 G3 X10 Z0 R10.0\nG17 G91 G1 X1 Y1\nG90 G0 Z5\nM2\n%\n";
    for error in [|_: f64, _: f64| 0.004, error_mm] {
        let bench = Shop::new(error, program);
        bench.compensate(&[]).unwrap();
        for name in ["base.ngc", "out.ngc"] {
            let calls = interpret(&bench.path(name));
            calls.unwrap_or_else(|said| panic!("{name}: {said}"));
        }
    }
}

/// Returns the ends of the interpreter's moves at feed, in millimetres.
fn ends_of_feeds(said: &str) -> Vec<[f64; 3]> {
    let (mut unit, mut axes, mut found) = (1.0, [0, 1, 2], Vec::new());
    for line in said.lines() {
        let numbers = |call: &str| -> Option<Vec<f64>> {
            let numbers = line.split_once(call)?.1.trim_end_matches(')');
            numbers.split(',').map(|n| n.trim().parse().ok()).collect()
        };
        if let Some((_, name)) = line.split_once("USE_LENGTH_UNITS(CANON_UNITS_") {
            unit = if name.starts_with("IN") { 25.4 } else { 1.0 };
        } else if let Some((_, plane)) = line.split_once("SELECT_PLANE(CANON_PLANE_") {
            axes = match &plane[..2] {
                "XY" => [0, 1, 2],
                "XZ" => [2, 0, 1],
                _ => [1, 2, 0],
            };
        } else if let Some(arc) = numbers("ARC_FEED(") {
            let mut at = [0.0; 3];
            [(axes[0], arc[0]), (axes[1], arc[1]), (axes[2], arc[5])].into_iter().for_each(|(k, v)| at[k] = unit * v);
            found.push(at);
        } else if let Some(straight) = numbers("STRAIGHT_FEED(") {
            found.push([0, 1, 2].map(|k| unit * straight[k]));
        }
    }
    found
}

#[test]
#[ignore = "needs the interpreter of LinuxCNC: Debian package linuxcnc-uspace"]
fn rs274_reads_drawn_programs() {
    let (mut read, mut moves) = (0, 0);
    for seed in 0..regrind_testutils::sample::seeds(25) {
        let drawn = crate::generated::drawn(seed);
        let bench = Shop::new(error_mm, &drawn.text);
        // A program that the interpreter refuses (it has another rule for a small arc) is not a base to correct.
        let Ok(base) = interpret(&bench.path("base.ngc")) else { continue };
        let Ok(text) = bench.compensate(&["--tolerance-um", "0.1"]) else {
            assert!(drawn.refused.is_some(), "seed {seed}\n{}", drawn.text);
            continue;
        };
        // The interpreter reads the base as it was drawn.
        let ends = |moves: &[Move]| -> Vec<[f64; 3]> {
            let ways = moves.iter().filter_map(|step| match step {
                Move::Feed(way) => Some(way.to),
                _ => None,
            });
            ways.collect()
        };
        let said = interpret(&bench.path("out.ngc")).unwrap_or_else(|said| panic!("seed {seed}: {said}\n{text}"));
        let corrected = ends(&crate::generated::read(&text));
        for (name, said, ours) in [("base", &base, ends(&drawn.moves)), ("corrected", &said, corrected)] {
            let theirs = ends_of_feeds(said);
            assert_eq!(theirs.len(), ours.len(), "seed {seed}, {name}\n{}", drawn.text);
            for (is, should) in theirs.iter().zip(&ours) {
                // The interpreter prints four decimals, in inches too.
                let off = (0..3).map(|k| (is[k] - should[k]).abs()).fold(0.0, f64::max);
                assert!(off < 0.6e-4 * 25.4, "seed {seed}, {name}: {is:?} {should:?}\n{}", drawn.text);
            }
            moves += ours.len();
        }
        read += 1;
    }
    println!("{read} programs, {moves} moves at feed");
    assert!(read > 10);
}
