//! Sweeps the wheel along the program in the file and checks by closed forms alone that it leaves the corrected
//! surface.
//!
//! The surface is that of the simulator's shapes. The wheel has an independent distance function. The program is read
//! back from its text.

use crate::path::{Part, ProgramStep, correction, part, part_from_below, read, truth, truth_below, wheels, with};
use regrind::compensation::path::{PathOptions, TrackPattern, TrackSpacing, Wheel};
use regrind_testutils::sample::{cases, seeds};

const PARTS: [&str; 4] = ["freeform-mirror", "off-axis-asphere", "shallow-wave", "biconic"];
/// Tolerance of a touching place, in millimetres.
const WITHIN_MM: f64 = 2e-4;

/// Returns the distance of a point from a wheel; `d` is relative to the wheel's centre.
pub fn distance(wheel: &Wheel, d: [f64; 3]) -> f64 {
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    match *wheel {
        Wheel::Sphere { radius_mm } => dot(d, d).sqrt() - radius_mm,
        Wheel::Torus { ring_mm, tube_mm, spindle } | Wheel::Cup { ring_mm, tube_mm, spindle } => {
            let axial = dot(d, spindle.into());
            let radial = (dot(d, d) - axial * axial).max(0.0).sqrt();
            let outside =
                if matches!(wheel, Wheel::Torus { .. }) { (radial - ring_mm).max(0.0) } else { radial - ring_mm };
            let below = if matches!(wheel, Wheel::Cup { .. }) { axial.min(0.0) } else { axial };
            outside.hypot(below) - tube_mm
        }
    }
}

/// Program as swept by the wheel, and the bounding boxes of groups of successive moves.
pub struct Swept {
    pub steps: Vec<ProgramStep>,
    boxes: Vec<[[f64; 3]; 2]>,
}

/// Number of moves in a box.
const IN_A_BOX: usize = 64;

impl Swept {
    pub fn new(steps: Vec<ProgramStep>) -> Self {
        // Each box also contains the start of its first move.
        let boxes = (0..steps.len()).step_by(IN_A_BOX).map(|first| {
            let of = &steps[first..(first + IN_A_BOX + 1).min(steps.len())];
            // The first move has no x and y: NaN does not enlarge a box.
            let bound = |start: f64, of_two: fn(f64, f64) -> f64| {
                [0, 1, 2].map(|k| of.iter().map(|step| step.at[k]).fold(start, of_two))
            };
            [bound(f64::INFINITY, f64::min), bound(f64::NEG_INFINITY, f64::max)]
        });
        Self { boxes: boxes.collect(), steps }
    }

    /// Returns the moves of all boxes from which a wheel can touch a point.
    fn near(&self, q: [f64; 3], reach_mm: f64) -> impl Iterator<Item = [[f64; 3]; 2]> {
        let is_near = move |[least, most]: &[[f64; 3]; 2]| {
            (0..3).all(|k| q[k] >= least[k] - reach_mm && q[k] <= most[k] + reach_mm)
        };
        let of = |i: usize| &self.steps[i * IN_A_BOX..(i * IN_A_BOX + IN_A_BOX + 1).min(self.steps.len())];
        let boxes = self.boxes.iter().enumerate().filter(move |(_, corners)| is_near(corners));
        boxes.flat_map(move |(i, _)| of(i).windows(2).map(|pair| [pair[0].at, pair[1].at]))
    }
}

/// Returns the minimum distance of a point from a wheel that follows a program, rapid moves included.
pub fn clearance(wheel: &Wheel, program: &Swept, q: [f64; 3]) -> f64 {
    let reach = wheel.reach_mm() + 0.1;
    let mut nearest = f64::INFINITY;
    for [a, b] in program.near(q, reach) {
        let beyond =
            |k: usize| (q[k] < a[k] - reach && q[k] < b[k] - reach) || (q[k] > a[k] + reach && q[k] > b[k] + reach);
        if beyond(0) || beyond(1) || beyond(2) {
            continue;
        }
        // The first move has no x and y.
        if a.iter().any(|v| v.is_nan()) {
            continue;
        }
        let at = |t: f64| distance(wheel, [0, 1, 2].map(|k| q[k] - a[k] - t * (b[k] - a[k])));
        let (mut from, mut to) = (0.0, 1.0);
        // On such a short path the distance has one minimum; a long rapid move is far away or passes once.
        let length = (0..3).map(|k| (b[k] - a[k]).powi(2)).sum::<f64>().sqrt();
        if at(0.5) > nearest + length {
            continue;
        }
        for _ in 0..60 {
            let (u, v) = (from + (to - from) / 3.0, to - (to - from) / 3.0);
            if at(u) < at(v) { to = v } else { from = u }
        }
        nearest = nearest.min(at(from)).min(at(0.0)).min(at(1.0));
    }
    nearest
}

/// Writes a program and reads it back.
fn program(part: &Part) -> (Swept, f64) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("part.ngc");
    let correction = correction(part.half_mm);
    let (path, _) = part.programs.path(&correction).unwrap();
    part.programs.write(&file, &correction, [3; 32]).unwrap();
    (Swept::new(read(&std::fs::read_to_string(file).unwrap())), path.track_mm())
}

/// Returns places on some tracks of a raster, offset sideways by a fraction of the track distance.
pub fn places(part: &Part, track_mm: f64, beside: f64) -> Vec<[f64; 2]> {
    let [a, b] = part.half_mm;
    let rows = (2.0 * b / track_mm).round() as usize;
    (0..seeds(16) as usize)
        .map(|k| {
            let row = (k * 7919) % rows;
            let y = -b + (row as f64 + beside) * track_mm;
            let x = a * (2.0 * (k as f64 * 0.618_034).fract() - 1.0);
            [x, y]
        })
        .filter(|[x, y]| part.programs.surface_and_outline.1.contains(*x, *y))
        .collect()
}

/// Returns each wheel on each part, or every second combination: all parts and all wheels are among them.
fn parts_and_wheels() -> impl Iterator<Item = (&'static str, (&'static str, Wheel))> {
    cases(PARTS.into_iter().flat_map(|name| wheels(0.8).map(|wheel| (name, wheel))), 2)
}

#[test]
fn every_wheel_leaves_surface_on_tracks() {
    for name in PARTS {
        let mut part = part(name);
        let plain = part.programs.options;
        for (wheel_name, wheel) in wheels(0.8) {
            part.programs.options = with(&plain, wheel, 4.0);
            let (swept, track_mm) = program(&part);
            for place in places(&part, track_mm, 0.0) {
                let off = clearance(&wheel, &swept, truth(&part, 0.02, place));
                assert!(off.abs() < WITHIN_MM, "{name}, {wheel_name}, {place:?}: {:.3} um", 1e3 * off);
            }
        }
    }
}

#[test]
fn wheel_from_below_leaves_surface() {
    for name in PARTS {
        let mut part = part_from_below(name);
        let plain = part.programs.options;
        for (wheel_name, wheel) in wheels(0.8) {
            part.programs.options = with(&plain, wheel, 4.0);
            let (swept, track_mm) = program(&part);
            // In the model frame the spindle points the other way.
            let stands = wheel.mirrored();
            for place in places(&part, track_mm, 0.0) {
                let off = clearance(&stands, &swept, truth_below(&part, 0.02, place));
                assert!(off.abs() < WITHIN_MM, "{name}, {wheel_name}, {place:?}: {:.3} um", 1e3 * off);
            }
            for place in places(&part, track_mm, 0.4) {
                let off = clearance(&stands, &swept, truth_below(&part, 0.02, place));
                assert!(off > -WITHIN_MM, "{name}, {wheel_name}: {:.3} um too deep at {place:?}", -1e3 * off);
            }
            // The wheel travels below everything that it grinds.
            let least =
                |feed: bool| swept.steps.iter().filter(|s| s.feed == feed).fold(f64::INFINITY, |z, s| z.min(s.at[2]));
            assert!(least(false) < least(true), "{name}, {wheel_name}");
        }
    }
}

#[test]
fn ridge_height_between_tracks() {
    let height_mm = 1e-2;
    for (name, (wheel_name, wheel)) in parts_and_wheels() {
        let mut part = part(name);
        part.programs.options = with(&part.programs.options, wheel, 4.0);
        part.programs.options.spacing = TrackSpacing::Scallop { max_height_mm: height_mm, max_track_mm: 20.0 };
        let (swept, track_mm) = program(&part);
        let mut highest = f64::NEG_INFINITY;
        for beside in [0.1, 0.3, 0.5] {
            for place in places(&part, track_mm, beside) {
                let off = clearance(&wheel, &swept, truth(&part, 0.02, place));
                assert!(off > -WITHIN_MM, "{name}, {wheel_name}: {:.3} um too deep at {place:?}", -1e3 * off);
                // The formula approximates the ridge by a parabola; the next order is a few percent of it here.
                assert!(
                    off < 1.05 * height_mm + WITHIN_MM,
                    "{name}, {wheel_name}: a ridge of {:.3} um at {place:?}",
                    1e3 * off
                );
                highest = highest.max(off);
            }
        }
        assert!(highest > 0.3 * height_mm, "{name}, {wheel_name}: {highest}");
    }
}

#[test]
fn scallop_figures_match_swept_wheel() {
    for (name, (wheel_name, wheel), pattern) in [
        ("freeform-mirror", wheels(0.8)[0], TrackPattern::Raster),
        ("freeform-mirror", wheels(0.8)[1], TrackPattern::Raster),
        ("off-axis-asphere", wheels(0.8)[0], TrackPattern::Spiral),
    ] {
        let mut part = part(name);
        part.programs.options = PathOptions { pattern, ..with(&part.programs.options, wheel, 1.0) };
        let (swept, _) = program(&part);
        let told = part.programs.path(&correction(part.half_mm)).unwrap().0.scallops();
        // Grooves all over the part, each looked at from its one side to the other: as far as two tracks are apart,
        // wherever that begins.
        const GROOVES: [usize; 2] = [9, 6];
        const PLACES: usize = 10;
        let (mut highest, mut squares, mut sum, mut grooves) = (0.0f64, 0.0, 0.0, 0.0);
        for k in 0..GROOVES[0] * GROOVES[1] {
            let share = [(k % GROOVES[0]) as f64 / GROOVES[0] as f64, (k / GROOVES[0]) as f64 / GROOVES[1] as f64];
            let at: [f64; 2] = [0, 1].map(|i| part.half_mm[i] * (2.0 * share[i] + 1.0 / GROOVES[i] as f64 - 1.0));
            if !part.programs.surface_and_outline.1.contains(at[0], at[1]) {
                continue;
            }
            let across = match pattern {
                TrackPattern::Raster => [0.0, 1.0],
                TrackPattern::Spiral => at.map(|c| c / at[0].hypot(at[1]).max(1e-9)),
            };
            let off: Vec<f64> = (0..PLACES)
                .map(|i| told.track_mm * (i as f64 / PLACES as f64 - 0.5))
                .map(|t| clearance(&wheel, &swept, truth(&part, 0.02, [0, 1].map(|i| at[i] + t * across[i]))))
                .collect();
            let mean = off.iter().sum::<f64>() / PLACES as f64;
            highest = off.iter().fold(highest, |most, h| most.max(*h));
            squares += off.iter().map(|h| (h - mean).powi(2)).sum::<f64>() / PLACES as f64;
            (sum, grooves) = (sum + mean, grooves + 1.0);
        }
        let found = [highest, (squares / grooves).sqrt(), sum / grooves];
        let of = [told.height_mm, told.rms_mm, told.mean_mm];
        let close = |k: usize, within: f64| (found[k] / of[k] - 1.0).abs() < within;
        // The highest place of all need not be among the sampled places.
        assert!(close(0, 0.1) && close(1, 0.03) && close(2, 0.03), "{name}, {wheel_name}: {found:?} for {told:?}");
    }
}

#[test]
fn spiral_ridges_within_spacing() {
    let mut part = part("off-axis-asphere");
    let wheel = Wheel::Sphere { radius_mm: 12.5 };
    part.programs.options = with(&part.programs.options, wheel, 0.4);
    part.programs.options.pattern = TrackPattern::Spiral;
    let (swept, _) = program(&part);
    // h = s^2 / 8 (1 / R - k): hollow with 180 mm and more; on a slope s grows.
    let most = 0.4f64.powi(2) / 8.0 / 12.5 * 1.1;
    for k in 0..200 {
        let (r, angle) = (29.9 * (k as f64 / 200.0).sqrt(), 2.4 * k as f64);
        let off = clearance(&wheel, &swept, truth(&part, 0.02, [r * angle.cos(), r * angle.sin()]));
        assert!(off > -WITHIN_MM && off < most + WITHIN_MM, "{:.3} um at {r} {angle}", 1e3 * off);
    }
}

#[test]
fn spiral_never_cuts_too_deep() {
    for (name, (wheel_name, wheel)) in parts_and_wheels() {
        let mut part = part(name);
        part.programs.options =
            PathOptions { pattern: TrackPattern::Spiral, ..with(&part.programs.options, wheel, 3.0) };
        let (swept, _) = program(&part);
        let [a, b] = part.half_mm;
        for k in 0..150 {
            let (r, angle) = ((k as f64 / 150.0).sqrt(), 2.4 * k as f64);
            let place = [a * r * angle.cos(), b * r * angle.sin()];
            let off = clearance(&wheel, &swept, truth(&part, 0.02, place));
            assert!(off > -WITHIN_MM, "{name}, {wheel_name}: {:.3} um too deep at {place:?}", -1e3 * off);
        }
    }
}

#[test]
fn sweep_detects_correction_along_z() {
    // The check must be able to fail: it detects a ball whose correction was added along z alone.
    let part = part("freeform-mirror");
    let correction = correction(part.half_mm);
    let flat = regrind::compensation::Correction { values_mm: vec![0.0; correction.grid.len()], ..correction };
    let (path, _) = part.programs.path(&flat).unwrap();
    let steps = path
        .moves()
        .filter_map(|one| match one {
            regrind::compensation::path::Move::Feed { to: at, .. } => {
                Some(ProgramStep { at: [at.x, at.y, at.z + crate::path::error_mm(at.x, at.y)], feed: true })
            }
            _ => None,
        })
        .collect();
    let swept = Swept::new(steps);
    let wheel = part.programs.options.wheel;
    let worst = places(&part, path.track_mm(), 0.0)
        .into_iter()
        .map(|place| clearance(&wheel, &swept, truth(&part, 0.02, place)).abs())
        .fold(0.0, f64::max);
    assert!(worst > 5.0 * WITHIN_MM, "{worst}");
}
