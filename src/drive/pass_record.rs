//! What a grinder says of a pass, held against what it was told: a figure that cannot be holds the cell before anything is made of it.

use serde_json::{Value, json};

use crate::device::{Job, Outcome, Pass, PassRecord};

/// Share of its stated radius by which a wheel may differ from the recipe's: wear and dressing, not another wheel.
const WHEEL_SHARE: f64 = 0.01;
/// Least share of the tracks over the whole rectangle that a pass travels: an aperture leaves corners and holes out.
const LEAST_PATH_SHARE: f64 = 0.25;
/// What a pass may have taken off beyond the most that it is planned with: scatter, and the rounding of who measured it.
const DEPTH_SHARE: f64 = 1.05;
const DEPTH_SLACK_MM: f64 = 0.01;

/// What a pass was to be.
pub(super) struct Told<'t> {
    pub(super) job: Job,
    pub(super) pass: &'t Pass,
    pub(super) map_identity: [u8; 32],
    /// The most that may be taken off in one pass anywhere.
    pub(super) largest_depth_mm: f64,
}

/// Names the first figure of a record that cannot be, with its limit; what was not told is not judged.
pub(super) fn flaw(told: &Told, record: &PassRecord) -> Option<String> {
    let Told { job, pass, map_identity, largest_depth_mm } = told;
    if (record.job, record.cycle) != (job.job, job.cycle) {
        let (is_job, is_cycle) = (record.job, record.cycle);
        return Some(format!("it is of job {is_job}, cycle {is_cycle}; {}, {} was ground", job.job, job.cycle));
    }
    if record.map_identity != *map_identity {
        let short = |identity: &[u8; 32]| identity[..4].iter().map(|b| format!("{b:02x}")).collect::<String>();
        let (is, told) = (short(&record.map_identity), short(map_identity));
        return Some(format!("map {is} was ground, and {told} was handed over"));
    }
    if record.outcome != Outcome::Complete {
        return None; // A pass that did not come to its end is judged by that alone.
    }
    let range = |value: Option<f64>, what: &str, least: f64, most: f64, unit: &str| {
        let value = value.filter(|value| !(least..=most).contains(value))?;
        let limits = match (least.is_finite(), most.is_finite()) {
            (true, true) => format!("{least:.3} to {most:.3} {unit} are possible"),
            (true, false) => format!("at least {least:.3} {unit} are needed"),
            _ => format!("at most {most:.3} {unit} are allowed"),
        };
        Some(format!("{what} is {value:.3} {unit}, and {limits}"))
    };
    let [width, height] = [pass.x_mm, pass.y_mm].map(|[low, high]| high - low);
    let least_path_mm = LEAST_PATH_SHARE * width * height / pass.track_spacing_mm;
    // Roughing and ways through the air may be faster than the feed; what the last tracks need, it needs at least.
    let least_s = least_path_mm / (pass.feed_mm_min / 60.0);
    // When a person says that a pass has begun and ended is no measure of it; who tells the path has a clock.
    let measured_s = record.duration_s.filter(|_| record.path_mm.is_some());
    let wheel = [1.0 - WHEEL_SHARE, 1.0 + WHEEL_SHARE].map(|share| share * pass.wheel_radius_mm);
    let any = f64::INFINITY;
    let most_mm = DEPTH_SHARE * largest_depth_mm + DEPTH_SLACK_MM;
    range(record.path_mm, "the path travelled", least_path_mm, any, "mm")
        .or_else(|| range(measured_s, "its duration", least_s, any, "s"))
        .or_else(|| range(record.deepest_mm, "the largest depth taken off", -any, most_mm, "mm"))
        .or_else(|| range(record.wheel_radius_mm, "the radius of the wheel", wheel[0], wheel[1], "mm"))
        .or_else(|| range(record.removed_mm3, "the volume removed", 0.0, any, "mm3"))
        .or_else(|| range(record.idle_share, "the share of the path that cut nothing", 0.0, 1.0, ""))
}

/// A pass record as the journal keeps it.
pub(super) fn document(record: &PassRecord) -> Value {
    json!({
        "path_mm": record.path_mm,
        "removed_mm3": record.removed_mm3,
        "deepest_mm": record.deepest_mm,
        "idle_share": record.idle_share,
        "spindle_load": record.spindle_load,
        "wheel_radius_mm": record.wheel_radius_mm,
        "temperature_c": record.temperature_c,
        "duration_s": record.duration_s,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pass() -> Pass {
        Pass {
            spark_out_passes: 1,
            wheel_radius_mm: 12.5,
            feed_mm_min: 1000.0,
            track_spacing_mm: 0.5,
            level_mm: 0.02,
            depth_of_cut_mm: 0.02,
            x_mm: [-51.0, 51.0],
            y_mm: [-31.0, 31.0],
            part_identity: [7; 32],
        }
    }

    fn record() -> PassRecord {
        PassRecord {
            outcome: Outcome::Complete,
            path_mm: Some(13_000.0),
            removed_mm3: Some(900.0),
            deepest_mm: Some(0.2),
            idle_share: Some(0.1),
            spindle_load: Some(0.4),
            wheel_radius_mm: Some(12.49),
            temperature_c: Some(20.0),
            duration_s: Some(780.0),
            map_identity: [3; 32],
            job: 41,
            cycle: 2,
            done: 9,
        }
    }

    fn judged(record: &PassRecord) -> Option<String> {
        let job = Job { job: 41, cycle: 2, digest: 0 };
        flaw(&Told { job, pass: &pass(), map_identity: [3; 32], largest_depth_mm: 0.5 }, record)
    }

    #[test]
    fn a_figure_that_cannot_be_is_named_with_its_limit() {
        assert_eq!(judged(&record()), None);
        let cases: [(PassRecord, &str); 9] = [
            (PassRecord { map_identity: [4; 32], ..record() }, "map 04040404 was ground, and 03030303 was handed over"),
            (PassRecord { job: 40, ..record() }, "it is of job 40, cycle 2; 41, 2 was ground"),
            (PassRecord { cycle: 1, ..record() }, "it is of job 41, cycle 1; 41, 2 was ground"),
            (PassRecord { deepest_mm: Some(3.0), ..record() }, "3.000 mm, and at most 0.535 mm are allowed"),
            (
                PassRecord { path_mm: Some(-1.0), ..record() },
                "the path travelled is -1.000 mm, and at least 3162.000 mm",
            ),
            (
                PassRecord { wheel_radius_mm: Some(11.0), ..record() },
                "is 11.000 mm, and 12.375 to 12.625 mm are possible",
            ),
            (PassRecord { duration_s: Some(0.0), ..record() }, "its duration is 0.000 s, and at least 189.720 s"),
            (PassRecord { idle_share: Some(1.5), ..record() }, "1.500 , and 0.000 to 1.000"),
            (PassRecord { removed_mm3: Some(-2.0), ..record() }, "the volume removed is -2.000 mm3"),
        ];
        for (record, words) in cases {
            let flaw = judged(&record).unwrap_or_else(|| panic!("nothing is found wrong, expected {words}"));
            assert!(flaw.contains(words), "{flaw:?} without {words:?}");
        }
    }

    #[test]
    fn what_was_not_told_is_not_judged_and_no_number_is_not_believed() {
        let untold = PassRecord {
            path_mm: None,
            removed_mm3: None,
            deepest_mm: None,
            idle_share: None,
            wheel_radius_mm: None,
            duration_s: None,
            ..record()
        };
        assert_eq!(judged(&untold), None);
        assert!(judged(&PassRecord { deepest_mm: Some(f64::NAN), ..record() }).is_some());
    }
}
