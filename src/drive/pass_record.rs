//! Plausibility check of a grinder's pass record against the commanded pass. An implausible figure holds the cell
//! before anything is done with it.

use data_encoding::HEXLOWER;

use crate::device::{Job, Outcome, Pass, PassRecord};
use crate::geometry::Aperture;
use crate::record::{PassFigures, PassNote};

/// Maximum relative difference of the wheel radius from the recipe. A larger one means another wheel; wear and dressing
/// stay below it.
const MAX_WHEEL_RADIUS_DIFFERENCE: f64 = 0.01;
/// Minimum path of a pass, as a share of the length of the tracks over the part. If the part has no outline, the tracks
/// over its bounding rectangle count, and the share is smaller because the part may have no corners and may have holes.
const MIN_PATH_SHARE: f64 = 0.5;
const MIN_RECTANGLE_PATH_SHARE: f64 = 0.25;
/// Maximum path of a pass, as a multiple of the length of its tracks, for each time that the wheel goes over the part.
/// It includes moves in the air and beyond the edges.
const MAX_PATH_FACTOR: f64 = 20.0;
/// Maximum ratio of the area of a surface that the wheel can follow to the area of its bounding rectangle.
const MAX_SURFACE_FACTOR: f64 = 2.0;
/// Maximum removal beyond the planned one: allows for noise and for rounding of the measurement.
const MAX_DEPTH_FACTOR: f64 = 1.05;
const DEPTH_MARGIN_MM: f64 = 0.01;

/// Commanded pass.
pub(super) struct CommandedPass<'t> {
    pub(super) job: Job,
    pub(super) pass: &'t Pass,
    pub(super) map_identity: [u8; 32],
    /// Maximum removal of one pass at any place.
    pub(super) max_depth_mm: f64,
    /// Outline of the part, if one was stated.
    pub(super) outline: Option<&'t Aperture>,
}

/// Compares the pass record of the grinder with the commanded pass `told`. Returns a text about the first
/// contradiction: another job, another map, a figure outside its limits, or two figures that contradict each other.
/// Returns `None` if there is none. The figures are not checked if the pass did not complete. A figure that the grinder
/// did not report is not checked either.
pub(super) fn implausible_figure(told: &CommandedPass, record: &PassRecord) -> Option<String> {
    let CommandedPass { job, pass, map_identity, max_depth_mm, outline } = told;
    if (record.job, record.cycle) != (job.job, job.cycle) {
        let (is_job, is_cycle) = (record.job, record.cycle);
        return Some(format!(
            "the record belongs to job {is_job}, cycle {is_cycle}, but the pass belongs to job {}, cycle {}",
            job.job, job.cycle
        ));
    }
    if record.map_identity != *map_identity {
        let short = |identity: &[u8; 32]| HEXLOWER.encode(&identity[..4]);
        let (is, told) = (short(&record.map_identity), short(map_identity));
        return Some(format!("the grinder used map {is}, but map {told} was sent"));
    }
    if record.outcome != Outcome::Complete {
        return None; // A pass that did not come to its end is judged by that alone.
    }
    if let Some(flaw) = record.range_violation() {
        return Some(flaw);
    }
    let range = |value: Option<f64>, what: &str, least: f64, most: f64, unit: &str| {
        let value = value.filter(|value| !(least..=most).contains(value))?;
        let limits = match (least.is_finite(), most.is_finite()) {
            (true, true) => format!("limits {} to {} {unit}", format_figure(least), format_figure(most)),
            (true, false) => format!("minimum {} {unit}", format_figure(least)),
            _ => format!("maximum {} {unit}", format_figure(most)),
        };
        Some(format!("{what} is {} {unit}, {limits}", format_figure(value)))
    };
    let [width, height] = [pass.x_mm, pass.y_mm].map(|[low, high]| high - low);
    let tracks_mm = width * height / pass.track_spacing_mm;
    let min_path_mm = match outline {
        Some(outline) => MIN_PATH_SHARE * outline.area_mm2().min(width * height) / pass.track_spacing_mm,
        None => MIN_RECTANGLE_PATH_SHARE * tracks_mm,
    };
    // The pass crosses the part once for each cut of the removal, once to finish, and then to spark out.
    let times = (max_depth_mm / pass.depth_of_cut_mm).ceil() + 1.0 + f64::from(pass.spark_out_passes);
    let max_path_mm = MAX_PATH_FACTOR * tracks_mm * times;
    // Roughing and moves in the air may be faster than the feed. The last tracks need at least this time.
    let min_s = min_path_mm / (pass.feed_mm_min / 60.0);
    // Manual reports of start and end are no measure of the duration. A machine that reports a path has a clock.
    let measured_s = record.duration_s.filter(|_| record.path_mm.is_some());
    let wheel = [1.0 - MAX_WHEEL_RADIUS_DIFFERENCE, 1.0 + MAX_WHEEL_RADIUS_DIFFERENCE]
        .map(|share| share * pass.wheel_radius_mm);
    let any = f64::INFINITY;
    let max_mm = MAX_DEPTH_FACTOR * max_depth_mm + DEPTH_MARGIN_MM;
    let max_mm3 = MAX_SURFACE_FACTOR * width * height * max_mm;
    range(record.path_mm, "the path travelled", min_path_mm, any, "mm")
        .or_else(|| range(record.path_mm, "the path travelled", -any, max_path_mm, "mm"))
        .or_else(|| range(measured_s, "its duration", min_s, any, "s"))
        .or_else(|| range(record.max_depth_mm, "the largest removed depth", -any, max_mm, "mm"))
        .or_else(|| range(record.wheel_radius_mm, "the radius of the wheel", wheel[0], wheel[1], "mm"))
        .or_else(|| range(record.removed_mm3, "the removed volume", 0.0, max_mm3, "mm³"))
        .or_else(|| contradiction(record))
}

/// Returns a text if the record reports a removed depth but a removed volume of 0; otherwise `None`.
fn contradiction(record: &PassRecord) -> Option<String> {
    let (removed_mm3, max_depth_mm) = (record.removed_mm3?, record.max_depth_mm?);
    (removed_mm3 == 0.0 && max_depth_mm > 0.0)
        .then(|| format!("the removed volume is 0 mm³, but the largest removed depth is {max_depth_mm:.4} mm"))
}

/// Formats a figure for a message, with few digits even if its value is very large.
fn format_figure(value: f64) -> String {
    if value.abs() < 1e9 { format!("{value:.3}") } else { format!("{value:e}") }
}

/// Converts a pass record into the note that the journal stores.
pub(super) fn pass_note(record: &PassRecord) -> PassNote {
    PassNote {
        pass_record: PassFigures {
            path_mm: record.path_mm,
            removed_mm3: record.removed_mm3,
            max_depth_mm: record.max_depth_mm,
            idle_share: record.idle_share,
            spindle_load: record.spindle_load,
            wheel_radius_mm: record.wheel_radius_mm,
            temperature_c: record.temperature_c,
            duration_s: record.duration_s,
        },
    }
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
            max_depth_mm: Some(0.2),
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

    fn checked(record: &PassRecord) -> Option<String> {
        checked_with_outline(
            Some(&Aperture::Rectangle { centre_mm: [0.0; 2], width_mm: 102.0, height_mm: 62.0 }),
            record,
        )
    }

    fn checked_with_outline(outline: Option<&Aperture>, record: &PassRecord) -> Option<String> {
        let job = Job { job: 41, cycle: 2, digest: 0 };
        implausible_figure(
            &CommandedPass { job, pass: &pass(), map_identity: [3; 32], max_depth_mm: 0.5, outline },
            record,
        )
    }

    #[test]
    fn pass_record_path_limit_by_aperture() {
        let ring = Aperture::Annulus { centre_mm: [0.0; 2], inner_radius_mm: 27.0, outer_radius_mm: 31.0 };
        let of_path = |path_mm| PassRecord { path_mm: Some(path_mm), duration_s: None, ..record() };
        // 728.8 mm2 with tracks every 0.5 mm.
        assert_eq!(checked_with_outline(Some(&ring), &of_path(740.0)), None);
        assert!(
            checked_with_outline(Some(&ring), &of_path(700.0)).is_some_and(|flaw| flaw.contains("minimum 728.849 mm"))
        );
        assert_eq!(checked_with_outline(None, &of_path(3200.0)), None);
        assert!(checked_with_outline(None, &of_path(3100.0)).is_some_and(|flaw| flaw.contains("minimum 3162.000 mm")));
    }

    #[test]
    fn pass_record_names_violated_limit() {
        assert_eq!(checked(&record()), None);
        let cases = [
            (
                PassRecord { map_identity: [4; 32], ..record() },
                "the grinder used map 04040404, but map 03030303 was sent",
            ),
            (
                PassRecord { job: 40, ..record() },
                "the record belongs to job 40, cycle 2, but the pass belongs to job 41, cycle 2",
            ),
            (
                PassRecord { cycle: 1, ..record() },
                "the record belongs to job 41, cycle 1, but the pass belongs to job 41, cycle 2",
            ),
            (PassRecord { max_depth_mm: Some(3.0), ..record() }, "3.000 mm, maximum 0.535 mm"),
            (PassRecord { path_mm: Some(-1.0), ..record() }, "the path travelled is -1.000 mm, minimum 6324.000 mm"),
            (
                PassRecord { path_mm: Some(6000.0), ..record() },
                "the path travelled is 6000.000 mm, minimum 6324.000 mm",
            ),
            (PassRecord { path_mm: Some(1e300), ..record() }, "the path travelled is 1e300 mm"),
            (PassRecord { removed_mm3: Some(1e30), ..record() }, "the removed volume is 1e30 mm³"),
            (PassRecord { removed_mm3: Some(0.0), ..record() }, "is 0 mm³, but the largest removed depth is 0.2000 mm"),
            (PassRecord { spindle_load: Some(-1.0), ..record() }, "the spindle load is -1, limits 0 to 10"),
            (PassRecord { temperature_c: Some(-327.0), ..record() }, "the temperature is -327 degrees Celsius"),
            (PassRecord { wheel_radius_mm: Some(11.0), ..record() }, "is 11.000 mm, limits 12.375 to 12.625 mm"),
            (PassRecord { duration_s: Some(0.0), ..record() }, "its duration is 0.000 s, minimum 379.440 s"),
            (PassRecord { idle_share: Some(1.5), ..record() }, "is 1.5, limits 0 to 1"),
            (PassRecord { removed_mm3: Some(-2.0), ..record() }, "the removed volume is -2.000 mm³"),
        ];
        for (record, words) in cases {
            let flaw = checked(&record).unwrap_or_else(|| panic!("nothing is found wrong, expected {words}"));
            assert!(flaw.contains(words), "{flaw:?} without {words:?}");
        }
    }

    #[test]
    fn pass_record_allows_absent_refuses_nan() {
        let untold = PassRecord {
            path_mm: None,
            removed_mm3: None,
            max_depth_mm: None,
            idle_share: None,
            wheel_radius_mm: None,
            duration_s: None,
            ..record()
        };
        assert_eq!(checked(&untold), None);
        assert!(checked(&PassRecord { max_depth_mm: Some(f64::NAN), ..record() }).is_some());
    }
}
