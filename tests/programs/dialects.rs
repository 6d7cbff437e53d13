//! Programs in every dialect, read back by controls that share no code with the writer: those of the simulator, written
//! from the manufacturers' documentation.

use std::path::Path;

use crate::path::{Part, ProgramStep, correction, part, truth, wheels, with};
use crate::sweep::{Swept, clearance, places};
use regrind::compensation::path::{Move, PathMode, Wheel};
use regrind::config::read_dialect;
use regrind::formats::gcode::Dialect;
use regrind_sim::motion::Waypoint;
use regrind_sim::program::{Control, Program};

const DIALECTS: [&str; 4] = ["linuxcnc", "fanuc", "sinumerik", "heidenhain"];
/// Tolerance of a touching place in a program with unrounded points, in millimetres.
const WITHIN_MM: f64 = 2e-4;

/// Tolerance of arcs from the path, in millimetres: the same as for lines in these recipes.
const ARCS_WITHIN_MM: f64 = 1e-4;

fn dialect(name: &str) -> Dialect {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("config/dialects/{name}.toml"));
    read_dialect(&file).unwrap_or_else(|problems| panic!("{problems}")).dialect
}

/// Writes the program of a part in a dialect, and reads it with the control of that dialect.
fn read_back(part: &mut Part, name: &str) -> (Program, String) {
    part.programs.dialect = dialect(name);
    part.programs.controller_tolerance_mm = Some(part.programs.path_tolerance_mm);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("part");
    part.programs.write(&file, &correction(part.half_mm), [0xa5; 32]).unwrap();
    let text = std::fs::read_to_string(file).unwrap();
    let program = Control::named(name).unwrap().read(&text).unwrap_or_else(|why| panic!("{name}: {why}"));
    (program, text)
}

/// Returns half of the last digit that a dialect writes.
fn half_a_step_mm(name: &str) -> f64 {
    0.5 * 10f64.powi(-i32::from(dialect(name).numbers.decimals))
}

#[test]
fn controls_read_back_planned_path() {
    for name in DIALECTS {
        let mut part = part("freeform-mirror");
        part.programs.options = with(&part.programs.options, Wheel::Sphere { radius_mm: 12.5 }, 4.0);
        let (program, text) = read_back(&mut part, name);
        let (path, summary) = part.programs.path(&correction(part.half_mm)).unwrap();
        assert_eq!(program.waypoints.len() as u64, summary.moves, "{name}");
        // Read both from the dialect's file once, not for each of a hundred thousand lines.
        let (within_mm, max_line_length) = (half_a_step_mm(name) * (1.0 + 1e-6), dialect(name).text.max_line_length);
        let mut at = [f64::NAN; 3];
        for (planned, stop) in path.moves().zip(&program.waypoints) {
            let feed = match planned {
                Move::RapidZ(z) => {
                    at[2] = z;
                    None
                }
                Move::RapidXy([x, y]) => {
                    (at[0], at[1]) = (x, y);
                    None
                }
                Move::RapidTilted { .. } | Move::FeedTilted { .. } => unreachable!("the wheel stays upright"),
                Move::Feed { to, feed_mm_min } => {
                    at = to.into();
                    Some(feed_mm_min)
                }
            };
            let off = (0..3).filter(|k| !at[*k].is_nan()).map(|k| (at[k] - stop.at_mm[k]).abs()).fold(0.0, f64::max);
            assert!(off < within_mm && stop.feed_mm_min == feed, "{name}: {at:?} {stop:?}");
        }
        assert_eq!(program.tolerance_mm, (name != "fanuc").then_some(part.programs.path_tolerance_mm), "{name}");
        let says = |words: &str| program.comments.iter().any(|comment| comment.to_ascii_lowercase() == words);
        assert!(says(&format!("map: sha256 {}", "a5".repeat(32))) && says("simulation"), "{name}");
        assert!(text.lines().all(|line| line.len() <= max_line_length), "{name}");
    }
}

/// Returns the distance of a place from the path between two stops.
fn off_the_way(stop: &Waypoint, from: [f64; 3], place: [f64; 3]) -> f64 {
    let off = |share: f64| {
        let at = stop.position_at(from, share);
        (0..3).map(|k| (at[k] - place[k]).powi(2)).sum::<f64>().sqrt()
    };
    // On such a short path there is only one nearest place.
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..60 {
        let (u, v) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
        if off(u) < off(v) { high = v } else { low = u }
    }
    off(low)
}

#[test]
fn arcs_pass_plan_points_in_tolerance() {
    for (name, recipe, fewer) in [
        ("linuxcnc", "shallow-wave", 5),
        ("fanuc", "freeform-mirror", 2),
        ("sinumerik", "off-axis-asphere", 2),
        ("sinumerik", "biconic", 2),
        ("heidenhain", "shallow-wave", 1),
    ] {
        let mut part = part(recipe);
        part.programs.options = with(&part.programs.options, part.programs.options.wheel, 4.0);
        part.programs.arcs_within_mm = Some(ARCS_WITHIN_MM);
        let (program, text) = read_back(&mut part, name);
        let (path, summary) = part.programs.path(&correction(part.half_mm)).unwrap();
        let told = part.programs.arc_summary(&path).unwrap().unwrap();
        assert_eq!(program.waypoints.len() as u64, told.moves, "{name}");
        assert_eq!(program.waypoints.iter().filter(|stop| stop.arc.is_some()).count() as u64, told.arcs, "{name}");
        assert!(told.arcs > 50 && fewer * (told.arcs + told.lines) < summary.points, "{name}: {told:?}");
        let counted = format!("lines: {}", text.lines().count());
        assert!(program.comments.iter().any(|comment| comment.to_ascii_lowercase() == counted), "{name}");
        let step_mm = half_a_step_mm(name) * 2.0;
        // The points in their order: each block passes some of them and ends at the last.
        let mut points = path.moves().filter_map(|one| {
            if let Move::Feed { to: at, feed_mm_min } = one { Some((at, feed_mm_min)) } else { None }
        });
        let mut last = [f64::NAN; 3];
        for stop in &program.waypoints {
            let mut ended = stop.feed_mm_min.is_none();
            while !ended {
                let (at, feed) = points.next().unwrap_or_else(|| panic!("{name}: {stop:?} is no point"));
                assert_eq!(stop.feed_mm_min, Some(feed), "{name}");
                ended = (0..3).all(|k| (at[k] - stop.at_mm[k]).abs() <= 0.51 * step_mm);
                if stop.arc.is_some() {
                    let off = off_the_way(stop, last, at.into());
                    // The behaviour of controls between two different radii is their own.
                    assert!(off < ARCS_WITHIN_MM + 2.0 * step_mm, "{name}: {off} at {at}");
                } else {
                    assert!(ended, "{name}: {at} {stop:?}");
                }
            }
            last = stop.at_mm;
        }
        assert!(points.next().is_none(), "{name}");
    }
}

#[test]
fn wheel_on_arcs_leaves_surface() {
    for (name, recipe) in [
        ("linuxcnc", "freeform-mirror"),
        ("fanuc", "biconic"),
        ("sinumerik", "off-axis-asphere"),
        ("sinumerik", "shallow-wave"),
        ("heidenhain", "shallow-wave"),
    ] {
        for (wheel_name, wheel) in wheels(0.8) {
            let mut part = part(recipe);
            part.programs.options = with(&part.programs.options, wheel, 4.0);
            part.programs.arcs_within_mm = Some(ARCS_WITHIN_MM);
            let (program, _) = read_back(&mut part, name);
            assert!(program.waypoints.iter().any(|stop| stop.arc.is_some()), "{name}, {wheel_name}");
            let mut steps: Vec<ProgramStep> = Vec::new();
            for stop in &program.waypoints {
                let from = steps.last().map_or(stop.at_mm, |step| step.at);
                let feed = stop.feed_mm_min.is_some();
                steps.extend(stop.in_chords(from, 1e-6).into_iter().map(|at| ProgramStep { at, feed }));
            }
            let swept = Swept::new(steps);
            let track_mm = part.programs.path(&correction(part.half_mm)).unwrap().0.track_mm();
            for place in places(&part, track_mm, 0.0) {
                let off = clearance(&wheel, &swept, truth(&part, 0.02, place));
                let within = WITHIN_MM + 2.0 * half_a_step_mm(name);
                assert!(off.abs() < within, "{name}, {wheel_name}, {place:?}: {:.3} um", 1e3 * off);
            }
        }
    }
}

#[test]
fn wheel_on_read_path_leaves_surface() {
    for name in DIALECTS {
        let mut part = part("freeform-mirror");
        let wheel = Wheel::Sphere { radius_mm: 12.5 };
        part.programs.options = with(&part.programs.options, wheel, 4.0);
        let (program, _) = read_back(&mut part, name);
        let steps: Vec<ProgramStep> =
            program.waypoints.iter().map(|s| ProgramStep { at: s.at_mm, feed: s.feed_mm_min.is_some() }).collect();
        let swept = Swept::new(steps);
        let track_mm = part.programs.path(&correction(part.half_mm)).unwrap().0.track_mm();
        for place in places(&part, track_mm, 0.0) {
            let off = clearance(&wheel, &swept, truth(&part, 0.02, place));
            assert!(off.abs() < WITHIN_MM + 2.0 * half_a_step_mm(name), "{name}, {place:?}: {:.3} um", 1e3 * off);
        }
    }
}

#[test]
fn path_modes_readable_by_control() {
    for name in DIALECTS {
        let mut part = part("shallow-wave");
        part.programs.options = with(&part.programs.options, part.programs.options.wheel, 20.0);
        for mode in [PathMode::Blend, PathMode::ExactPath, PathMode::ExactStop] {
            part.programs.mode = mode;
            part.programs.dialect = dialect(name);
            part.programs.controller_tolerance_mm = Some(part.programs.path_tolerance_mm);
            if part.programs.check_dialect().is_ok() {
                assert!(!read_back(&mut part, name).0.waypoints.is_empty());
            } else {
                assert!(mode == PathMode::ExactPath && name != "linuxcnc" || name == "heidenhain", "{name} {mode:?}");
            }
        }
    }
}

#[test]
fn control_refuses_other_dialects() {
    let mut part = part("shallow-wave");
    part.programs.options = with(&part.programs.options, part.programs.options.wheel, 20.0);
    for name in DIALECTS {
        let (_, text) = read_back(&mut part, name);
        for other in DIALECTS.into_iter().filter(|other| *other != name) {
            assert!(Control::named(other).unwrap().read(&text).is_err(), "{other} reads {name}");
        }
    }
}
