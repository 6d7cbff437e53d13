//! Programs of a wheel on a tilting head. Independent controls read them back, the rotation of the head is undone from
//! the machine's own dimensions, and the tilted wheel is swept over the part.

use std::path::Path;

use crate::path::{Part, correction, error_mm, part, truth, wheels, with};
use crate::sweep::{distance, places};
use regrind::compensation::path::{HeightField, PathError, PathOptions, RotaryAxis, RotationAxis, TiltMode, Wheel};
use regrind::config::read_dialect;
use regrind::geometry::{Aperture, Grid, Vector};
use regrind_sim::motion::Waypoint;
use regrind_sim::program::{Control, Program};

/// Tolerance of a touching place, in millimetres.
const WITHIN_MM: f64 = 2e-4;
/// Vector from the wheel's centre to the pivot.
const PIVOT_MM: [f64; 3] = [12.0, -7.0, 180.0];

/// Returns a head with a wide range.
fn head(about: RotationAxis, pivot_mm: Option<[f64; 3]>, angle_decimals: i32) -> RotaryAxis {
    RotaryAxis {
        letter: if about == RotationAxis::X { 'A' } else { 'B' },
        axis: about,
        reversed: about == RotationAxis::X,
        range_rad: [-2.0, 2.0],
        rate_rad_s: 1e3,
        step_rad: 10f64.powi(-angle_decimals).to_radians(),
        pivot_mm: pivot_mm.map(Vector::from),
    }
}

/// Writes the program of a part in a dialect, and reads it with the control of that dialect.
fn written(part: &mut Part, name: &str) -> (Program, String) {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("config/dialects/{name}.toml"));
    part.programs.dialect = read_dialect(&file).unwrap_or_else(|problems| panic!("{problems}")).dialect;
    part.programs.controller_tolerance_mm = Some(part.programs.path_tolerance_mm);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("part");
    part.programs.write(&file, &correction(part.half_mm), [0xa5; 32]).unwrap_or_else(|why| panic!("{name}: {why}"));
    let text = std::fs::read_to_string(file).unwrap();
    let program = Control::named(name).unwrap().read(&text).unwrap_or_else(|why| panic!("{name}: {why}"));
    (program, text)
}

/// Returns a vector rotated by an angle about x for an A axis, about y for a B axis.
fn turned(letter: char, [x, y, z]: [f64; 3], angle: f64) -> [f64; 3] {
    let (s, c) = angle.sin_cos();
    if letter == 'A' { [x, c * y - s * z, s * y + c * z] } else { [c * x + s * z, y, c * z - s * x] }
}

/// Returns the distance of a place from the wheel at a fraction of the path between two stops, along which slides and
/// head move in proportion.
fn off_mm(
    wheel: &Wheel,
    pivot_mm: Option<[f64; 3]>,
    letter: char,
    [from, to]: [&Waypoint; 2],
    share: f64,
    q: [f64; 3],
) -> f64 {
    // The A axis counts left-handed here.
    let hand = if letter == 'A' { -1.0 } else { 1.0 };
    let [a, b] = [from, to].map(|stop| hand * stop.rotary_deg.unwrap_or(0.0).to_radians());
    let angle = a + share * (b - a);
    let arm = pivot_mm.unwrap_or_default();
    let arm_turned = turned(letter, arm, angle);
    let from_centre = std::array::from_fn(|k| {
        let slide = from.at_mm[k] + share * (to.at_mm[k] - from.at_mm[k]);
        q[k] - (slide + arm[k] - arm_turned[k])
    });
    distance(wheel, turned(letter, from_centre, -angle))
}

/// Returns the minimum distance of a place from the tilted wheel along a program.
fn clearance(wheel: &Wheel, pivot_mm: Option<[f64; 3]>, program: &Program, q: [f64; 3]) -> f64 {
    let letter = program.axis.expect("a head that turns");
    let mut nearest = f64::INFINITY;
    for pair in program.waypoints.windows(2).filter(|pair| pair[1].feed_mm_min.is_some()) {
        let at = |share: f64| off_mm(wheel, pivot_mm, letter, [&pair[0], &pair[1]], share, q);
        // No step goes farther than a few millimetres.
        if at(0.5) > nearest.min(4.0) + 4.0 {
            continue;
        }
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..40 {
            let (u, v) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
            if at(u) < at(v) { high = v } else { low = u }
        }
        nearest = nearest.min(at(low)).min(at(0.0)).min(at(1.0));
    }
    nearest
}

fn leaning(part: &Part, wheel: Wheel, rotary: RotaryAxis, lean: TiltMode, track_mm: f64) -> PathOptions {
    PathOptions { rotary: Some(rotary), tilt: Some(lean), ..with(&part.programs.options, wheel, track_mm) }
}

#[test]
fn tilted_wheel_leaves_surface() {
    let ways = [
        ("linuxcnc", None, 6),
        ("linuxcnc", Some(PIVOT_MM), 6),
        ("fanuc", None, 4),
        ("fanuc", Some(PIVOT_MM), 4),
        ("sinumerik", None, 6),
        ("sinumerik", Some(PIVOT_MM), 6),
        ("heidenhain", None, 4),
    ];
    let leans = [
        (RotationAxis::Y, TiltMode::Following { lead_rad: 0.35 }),
        (RotationAxis::X, TiltMode::Following { lead_rad: -0.5 }),
        (RotationAxis::Y, TiltMode::Constant { angle_rad: -0.4 }),
    ];
    let mut part = part("freeform-mirror");
    let plain = part.programs.options;
    for (k, (name, pivot_mm, decimals)) in ways.into_iter().enumerate() {
        for (i, (wheel_name, wheel)) in wheels(0.5).into_iter().enumerate() {
            // Each lean with each wheel, and with each dialect.
            let (about, lean) = leans[(i + k) % 3];
            let is_cup_aside = wheel_name == "cup" && (about, lean) != leans[2];
            let wheel = if is_cup_aside { Wheel::tilted_cup(8.0, 2.0, 1.3) } else { wheel };
            part.programs.options = plain;
            part.programs.options = leaning(&part, wheel, head(about, pivot_mm, decimals), lean, 8.0);
            let (program, _) = written(&mut part, name);
            assert_eq!(program.keeps_centre, pivot_mm.is_none() && name != "linuxcnc", "{name}");
            let half_a_step_mm = 0.5 * 10f64.powi(-i32::from(part.programs.dialect.numbers.decimals));
            let track_mm = part.programs.path(&correction(part.half_mm)).unwrap().0.track_mm();
            for (places, touches) in [(places(&part, track_mm, 0.0), true), (places(&part, track_mm, 0.4), false)] {
                for place in places.into_iter().take(30) {
                    let off = clearance(&wheel, pivot_mm, &program, truth(&part, 0.02, place));
                    let within = WITHIN_MM + 2.0 * half_a_step_mm;
                    let why = format!("{name}, {wheel_name}, {lean:?}, {place:?}: {:.3} um", 1e3 * off);
                    assert!(off > -within && (off < within || !touches), "{why}");
                }
            }
        }
    }
}

/// Ridge whose flank falls by 3.4 mm per millimetre at its foot: z = -0.1 y^2 for y to 17 mm.
const FALL_PER_MM: f64 = 0.1;

fn steep(part: &mut Part) {
    let on = Grid { columns: 25, rows: 201, first_mm: [-12.0, -2.0], spacing_mm: [1.0, 0.1] };
    let places = (0..on.len()).map(|k| on.place_mm(k));
    let (z, slopes): (Vec<f64>, Vec<[f64; 2]>) =
        places.map(|[_, y]| (-FALL_PER_MM * y * y, [0.0, -2.0 * FALL_PER_MM * y])).unzip();
    let outline = Aperture::Rectangle { centre_mm: [0.0, 9.0], width_mm: 16.0, height_mm: 16.0 };
    part.programs.surface_and_outline = (HeightField::hermite(on, &z, &slopes), outline);
    part.half_mm = [8.0, 17.0];
}

#[test]
fn steep_flank_ground_by_following_tilt() {
    let mut part = part("freeform-mirror");
    steep(&mut part);
    let plain = part.programs.options;
    let cup = Wheel::tilted_cup(8.0, 2.0, 0.3);
    let ball = Wheel::Sphere { radius_mm: 6.0 };
    let disc = Wheel::Torus { ring_mm: 10.0, tube_mm: 3.0, spindle: Vector::y() };
    part.programs.options = with(&plain, ball, 2.0);
    let refused = part.programs.path(&correction(part.half_mm)).unwrap_err().to_string();
    assert!(refused.contains("slopes by"), "{refused}");
    part.programs.options.rotary = Some(head(RotationAxis::X, None, 6));
    let told = part.programs.path(&correction(part.half_mm)).unwrap_err();
    // Towards +y is a negative turn about x.
    assert!(matches!(told, PathError::NeedsTilt { angle_deg, .. } if angle_deg < 0.0), "{told}");
    for (wheel, lead_rad) in [(ball, 0.4), (disc, 0.2), (cup, 0.0)] {
        for pivot_mm in [None, Some(PIVOT_MM)] {
            let lean = TiltMode::Following { lead_rad };
            part.programs.options = plain;
            part.programs.options = leaning(&part, wheel, head(RotationAxis::X, pivot_mm, 6), lean, 2.0);
            let (program, _) = written(&mut part, "linuxcnc");
            let turns: Vec<f64> = program.waypoints.iter().filter_map(|stop| stop.rotary_deg).collect();
            assert!(turns.iter().copied().fold(0.0, f64::max) > 45.0, "{wheel:?}");
            let track_mm = part.programs.path(&correction(part.half_mm)).unwrap().0.track_mm();
            for k in 0..24 {
                let (row, x) = ((k * 5 % 9) as f64, -7.5 + 15.0 * (k as f64 * 0.618_034).fract());
                for (y, touches) in [(1.0 + row * track_mm, true), (1.0 + (row + 0.5) * track_mm, false)] {
                    let off = clearance(&wheel, pivot_mm, &program, steep_truth(x, y.min(17.0)));
                    let touches = touches && y <= 17.0;
                    let why = format!("{wheel:?}, {x} {y}: {:.3} um", 1e3 * off);
                    assert!(off > -WITHIN_MM && (off < WITHIN_MM || !touches), "{why}");
                }
            }
        }
    }
}

/// Returns a point of the steep surface, moved along its normals by level and correction.
fn steep_truth(x: f64, y: f64) -> [f64; 3] {
    let slope = -2.0 * FALL_PER_MM * y;
    let w = 1.0 / (1.0 + slope * slope).sqrt();
    let d = 0.02 + error_mm(x, y);
    [x, y - slope * w * d, -FALL_PER_MM * y * y + w * d]
}

#[test]
fn zero_tilt_equals_upright_program() {
    for name in ["linuxcnc", "fanuc", "sinumerik", "heidenhain"] {
        let mut part = part("shallow-wave");
        let plain = with(&part.programs.options, part.programs.options.wheel, 8.0);
        part.programs.options = plain;
        let (_, upright) = written(&mut part, name);
        let lean = TiltMode::Constant { angle_rad: 0.0 };
        let decimals = i32::from(part.programs.dialect.numbers.angle_decimals);
        part.programs.options = leaning(&part, plain.wheel, head(RotationAxis::Y, None, decimals), lean, 8.0);
        let (program, tilted) = written(&mut part, name);
        assert_eq!(program.axis, Some('B'), "{name}");
        let word = if name == "heidenhain" {
            format!("B+{:.decimals$}", 0.0, decimals = decimals as usize)
        } else {
            format!("B{:.decimals$}", 0.0, decimals = decimals as usize)
        };
        // Block numbers count the lines of the axis too. Ignore comments, names, and words that only concern the head.
        let is_move = |line: &&str| {
            let is_told =
                ["PGM", "ORI", "TCPM", "; "].iter().any(|word| line.contains(word)) || line.starts_with(['(', ';']);
            line.contains(['X', 'Z']) && !is_told
        };
        let bare = |line: &str| {
            let numbered = name == "sinumerik" || name == "heidenhain";
            let line = if numbered { line.split_once(' ').map_or(line, |(_, rest)| rest) } else { line };
            line.replace(&format!(" {word}"), "").replace(&word, "")
        };
        let moves = |text: &str| text.lines().filter(is_move).map(bare).collect::<Vec<_>>();
        let [without, with] = [&upright, &tilted].map(|text| moves(text));
        assert!(without.len() > 1000 && without == with, "{name}");
        assert!(tilted.contains(&word) && !upright.contains(&word), "{name}");
    }
}

#[test]
fn tilted_program_needs_rotary_axis() {
    let mut part = part("shallow-wave");
    let lean = TiltMode::Constant { angle_rad: 0.3 };
    let wheel = part.programs.options.wheel;
    part.programs.options = leaning(&part, wheel, head(RotationAxis::Y, Some(PIVOT_MM), 6), lean, 20.0);
    let (program, text) = written(&mut part, "linuxcnc");
    assert!(text.contains("(tilt: constant by 17.18") && text.contains("G93"), "{}", &text[..2000]);
    assert!(program.clone().with_head(None).unwrap_err().contains("no rotary axis"));
    let head =
        regrind_sim::head::Head { letter: 'B', left_handed: false, range_deg: [-20.0, 20.0], pivot_mm: Some(PIVOT_MM) };
    assert!(program.clone().with_head(Some(head)).is_ok());
    for (head, what) in [
        (regrind_sim::head::Head { letter: 'A', ..head }, "turns B"),
        (regrind_sim::head::Head { range_deg: [-10.0, 10.0], ..head }, "beyond -10"),
    ] {
        assert!(program.clone().with_head(Some(head)).unwrap_err().contains(what));
    }
    // Arcs are for wheels without tilt.
    assert!(part.programs.check_dialect().is_ok());
    part.programs.arcs_within_mm = Some(1e-4);
    let refused = part.programs.check_dialect().unwrap_err().to_string();
    assert!(refused.contains("grinder.program.arcs_within_um") && refused.contains("grinding.tilt"), "{refused}");
    part.programs.arcs_within_mm = None;
    // A control that has no words for the tilt.
    part.programs.dialect =
        read_dialect(&Path::new(env!("CARGO_MANIFEST_DIR")).join("config/dialects/heidenhain.toml")).unwrap().dialect;
    let refused = part.programs.check_dialect().unwrap_err().to_string();
    assert!(refused.contains("[rotary.slides]") && refused.contains("grinder.rotary.pivot_mm"), "{refused}");
}

#[test]
fn inverse_time_feed_matches_duration() {
    let mut part = part("freeform-mirror");
    let (wheel, lean) = (Wheel::Sphere { radius_mm: 12.5 }, TiltMode::Following { lead_rad: 0.35 });
    part.programs.options = leaning(&part, wheel, head(RotationAxis::Y, Some(PIVOT_MM), 6), lean, 8.0);
    let (program, _) = written(&mut part, "linuxcnc");
    let minutes: f64 = program.waypoints.iter().filter_map(|stop| stop.minutes).sum();
    let (_, summary) = part.programs.path(&correction(part.half_mm)).unwrap();
    // The header has the time without the descent, a millimetre for each track.
    let down = part.programs.path(&correction(part.half_mm)).unwrap().0.track_count() as f64 / summary.feed_mm_min;
    assert!(
        (minutes - down - summary.duration_s / 60.0).abs() < 1e-6 * minutes,
        "{minutes} {}",
        summary.duration_s / 60.0
    );
    // The slides themselves travel far while the head turns.
    assert!(
        program.waypoints.iter().filter_map(|stop| stop.feed_mm_min).fold(0.0, f64::max) > 1.2 * summary.feed_mm_min
    );
}
