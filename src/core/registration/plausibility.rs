//! Warnings about a fit that succeeded: a probe radius that does not match the ball, and too few usable points.

use super::deviation::{Deviation, PointStatus, StatusCounts};
use super::isolated_touches::count_contradicted;
use super::options::{Method, RegistrationOptions, Start};
use super::part::Part;
use super::quality::format_length;
use super::result::{FiguresWithOutliers, Registration};
use super::start::sample_evenly;
use crate::geometry::Point;

/// Maximum ratio of the rms with another radius to the rms with the given radius, at which the given radius is doubted.
/// On a free-form surface of 64 mm radius, half the radius leaves a quarter in addition to the form error of a ground
/// part. Double the radius leaves less.
const MAX_RMS_SHARE: f64 = 0.65;

/// Minimum relative error of the radius at which it is doubted. A diameter in place of a radius, or the wrong ball,
/// exceeds it. The form error of a worn wheel has the same shape as the effect of a wrong radius: in one case the
/// estimate was 0.25 mm less than the 1.5 mm of the ball.
const MIN_RELATIVE_ERROR: f64 = 0.4;

/// Minimum rms that a wrong radius explains, as a share of the cloud's size, at which the radius is doubted: 7 µm on a
/// part of 100 x 60 mm. A ground part has less form error of this shape. The limit also excludes surfaces that hardly
/// determine the radius.
const MIN_RMS_PER_SIZE: f64 = 2e-4;

/// Share of the given radius below which an estimated radius means contact points. The estimate is then only form
/// error.
const MAX_CONTACT_RADIUS_SHARE: f64 = 0.25;

/// Minimum radius of a ball, in mm. A smaller value is an intended offset above the nominal surface, not a ball.
const MIN_BALL_RADIUS_MM: f64 = 0.1;

/// Minimum number of points in excess of the seven unknowns. With fewer points the estimated radius is chance.
const MIN_DEGREES_OF_FREEDOM: usize = 20;

/// Number of points to which another radius is fitted.
const REFIT_POINTS: usize = 2048;

/// Limits above or below which a warning is given: shares of the points, and covered share of the surface.
const MAX_OUTLIER_SHARE: f64 = 0.05;
const MAX_OFF_PART_SHARE: f64 = 0.2;
const MIN_COVERAGE: f64 = 0.5;

/// Returns the warnings, one text each, about the successful registration `found`. The warnings concern rejected
/// points, points that cover too little of the surface, noise of the nominal points, and a doubtful probe radius.
/// Returns an empty list if there are none.
pub(super) fn plausibility_warnings(
    part: &Part,
    found: &Registration,
    measured: &[Point],
    options: &RegistrationOptions,
) -> Vec<String> {
    let mut doubts = point_warnings(found);
    doubts.extend(nominal_noise_warning(part, found));
    doubts.extend(radius_warning(part, found, measured, options));
    doubts
}

/// Returns warnings about the points of the registration `found`, one text each. It warns about any outlier, about more
/// than 5 % outliers, and about points that contradict their neighbours. It also warns about more than 20 % points
/// beyond the edge, about points over a gap of the nominal surface, and about a coverage below 50 %.
fn point_warnings(found: &Registration) -> Vec<String> {
    let points = found.deviations.len();
    let StatusCounts { outliers, off_part, .. } = StatusCounts::count(&found.deviations);
    let share = |n: usize| n as f64 / points as f64;
    let mut doubts: Vec<String> = outlier_warning(found).into_iter().collect();
    doubts.extend(found.unjudgeable_reason());
    if share(outliers) > MAX_OUTLIER_SHARE {
        doubts.push(format!(
            "{outliers} of {points} points ({:.0} %) are rejected as outliers: look for dirt or coolant on the part, \
             a probe that slipped or wears, points of a fixture, or steps and edges that the nominal surface does \
             not have",
            100.0 * share(outliers),
        ));
    }
    let in_gaps = if off_part > 0 { count_in_gaps(found, off_part) } else { 0 };
    if share(off_part - in_gaps) > MAX_OFF_PART_SHARE {
        doubts.push(format!(
            "{} of {points} points ({:.0} %) lie beyond the edge of the nominal surface and are not used: check that \
             the nominal surface covers the part, and that the cloud belongs to it",
            off_part - in_gaps,
            100.0 * share(off_part - in_gaps),
        ));
    }
    if in_gaps > 0 {
        doubts.push(format!(
            "{in_gaps} of {points} points ({:.0} %) lie over a gap of the nominal surface, where it has no points, \
             and are not used: add nominal points there, if the part has a surface there",
            100.0 * share(in_gaps),
        ));
    }
    let coverage = found.quality.coverage;
    if coverage < MIN_COVERAGE {
        doubts.push(format!(
            "the {} points used cover only {:.0} % of the nominal surface, and the rest is unknown: check whether \
             the measurement or its file is cut short, or the nominal surface is larger than the part",
            points - outliers - off_part,
            100.0 * coverage,
        ));
    }
    doubts
}

/// Estimates how many points lie over a gap inside the nominal surface. `off_part` is the number of all points off the
/// part: points whose projection is beyond an edge of the surface. A point off the part lies either over a gap or
/// outside the outer edge.
///
/// A point lies over a gap if there are points on the part in all directions around it. For this test, the xy plane of
/// the model frame around the point is divided into eight sectors, and each sector must contain a point on the part.
/// Examines at most 2000 points off the part and at most 2000 points on the part, and scales the result to `off_part`
/// points.
fn count_in_gaps(found: &Registration, off_part: usize) -> usize {
    /// Number of directions in the xy plane of the model frame.
    const SECTORS: usize = 8;
    /// Maximum number of points on the part, and of points off the part, that are examined.
    const MAX_EXAMINED: usize = 2000;
    let some_of = |is_off: bool, count: usize| -> Vec<[f64; 2]> {
        let of = found.deviations.iter().filter(|d| (d.status == PointStatus::OffPart) == is_off);
        of.step_by(count.div_ceil(MAX_EXAMINED).max(1)).map(|d| [d.point.x, d.point.y]).collect()
    };
    let (looked_at, some) = (some_of(true, off_part), some_of(false, found.deviations.len() - off_part));
    let is_surrounded = |place: &&[f64; 2]| {
        let mut seen = [false; SECTORS];
        for other in &some {
            let angle = (other[1] - place[1]).atan2(other[0] - place[0]);
            let turn = (angle / std::f64::consts::TAU).rem_euclid(1.0);
            seen[((turn * SECTORS as f64) as usize).min(SECTORS - 1)] = true;
        }
        seen.iter().all(|seen| *seen)
    };
    let surrounded = looked_at.iter().filter(is_surrounded).count();
    (surrounded * off_part) / looked_at.len().max(1)
}

impl Registration {
    /// Returns a message that explains why the measured points allow no verdict about the part. Returns `None` if a
    /// verdict is possible.
    ///
    /// No verdict is possible if more than 10 % of the points on the part contradict their neighbours. Such a point was
    /// excluded from the fit, although most of its eight nearest neighbours were fitted. It is then unknown which of
    /// the two groups of points shows the part.
    pub fn unjudgeable_reason(&self) -> Option<String> {
        /// Maximum number of contradicting points, as a share of the points on the part.
        const MAX_CONTRADICTED_SHARE: f64 = 0.1;
        let StatusCounts { off_part, left_out_of_fit: left, .. } = StatusCounts::count(&self.deviations);
        if left as f64 <= MAX_CONTRADICTED_SHARE * (self.deviations.len() - off_part) as f64 {
            return None;
        }
        let on_part: Vec<&Deviation> = self.deviations.iter().filter(|d| d.status != PointStatus::OffPart).collect();
        let contradicted = count_contradicted(&self.deviations);
        if contradicted as f64 <= MAX_CONTRADICTED_SHARE * on_part.len() as f64 {
            return None;
        }
        let figures = |some: &mut dyn Iterator<Item = f64>| {
            let add = |(low, high, squares, n): (f64, f64, f64, usize), d: f64| {
                (f64::min(low, d), f64::max(high, d), squares + d * d, n + 1)
            };
            let (low, high, squares, n) = some.fold((f64::INFINITY, f64::NEG_INFINITY, 0.0, 0), add);
            format!("PV {} and RMS {}", format_length(high - low), format_length((squares / n.max(1) as f64).sqrt()))
        };
        let with = figures(&mut on_part.iter().map(|d| d.deviation_mm));
        let without = figures(&mut on_part.iter().filter(|d| d.in_fit).map(|d| d.deviation_mm));
        Some(format!(
            "{contradicted} of {} points ({:.0} %) contradict their neighbours, limit 10 %, so no verdict is possible: \
             with them {with}, without them {without}; clean the part, check the probe, and measure again",
            on_part.len(),
            100.0 * contradicted as f64 / on_part.len() as f64,
        ))
    }
}

/// Returns a warning if the noise of the nominal points exceeds both 0.1 µm and 10 % of the rms deviation; otherwise
/// `None`.
fn nominal_noise_warning(part: &Part, found: &Registration) -> Option<String> {
    /// Limits for the warning; both must be exceeded. A file with four digits of a millimetre has a noise of 0.03 um.
    const MIN_NOISE_MM: f64 = 1e-4;
    const MIN_RMS_SHARE: f64 = 0.1;
    let scatter_mm = part.nominal.noise_sigma_mm();
    (scatter_mm > MIN_NOISE_MM.max(MIN_RMS_SHARE * found.quality.rms_mm)).then(|| {
        format!(
            "the nominal points have a noise of {} about a smooth surface, and each deviation has about as much: \
             export them with more digits, or give the formula or mesh that they come from",
            format_length(scatter_mm),
        )
    })
}

/// Returns a warning that lists the first five outliers, and gives RMS and PV of all points on the part including the
/// outliers. Returns `None` if there are no outliers.
fn outlier_warning(found: &Registration) -> Option<String> {
    let FiguresWithOutliers { outliers: points, rms_mm, pv_mm, description: places } = found.figures_with_outliers()?;
    let were = if points == 1 { "1 point was".to_owned() } else { format!("{points} points were") };
    Some(format!(
        "{were} rejected, because no neighbour confirms the deviation: {places}; with all points PV is {} and RMS \
         {}: clean the part there and measure the point again",
        format_length(pv_mm),
        format_length(rms_mm),
    ))
}

/// Returns a warning if another probe radius fits the points much better than the given radius. Also tests the radius
/// zero: the points are then contact points, not probe centres. Returns `None` if the given radius is plausible, or if
/// the points cannot test the radius.
pub(super) fn radius_warning(
    part: &Part,
    found: &Registration,
    measured: &[Point],
    options: &RegistrationOptions,
) -> Option<String> {
    let given_mm = options.probe_radius_mm;
    if !is_radius_testable(part, found, options) {
        return None;
    }
    let sample: Vec<Point> = sample_evenly(measured, REFIT_POINTS).copied().collect();
    let told_mm = converged_radius_mm(given_mm + found.estimate_radius()?.difference_mm, given_mm, &|radius_mm| {
        refit_with_radius(part, found, &sample, options, radius_mm)
    })?;
    let is_contact = told_mm.abs() < MAX_CONTACT_RADIUS_SHARE * given_mm;
    if (told_mm - given_mm).abs() < MIN_RELATIVE_ERROR * given_mm {
        return None;
    }
    let other = refit_with_radius(part, found, &sample, options, if is_contact { 0.0 } else { told_mm })?;
    let (rms_mm, other_rms_mm) = (found.quality.rms_mm, other.quality.rms_mm);
    is_better(part, rms_mm, other_rms_mm).then(|| {
        let (rms, other_rms) = (format_length(rms_mm), format_length(other_rms_mm));
        if is_contact {
            format!(
                "the points look like contact points on the surface, not like centres of a ball of {given_mm} mm: as \
                 contact points they fit to {other_rms} rms instead of {rms}; if the CMM has already subtracted the \
                 radius, register with the method `contact`"
            )
        } else {
            let side = if told_mm < 0.0 { " on the other side of the surface" } else { "" };
            format!(
                "a probe radius of about {:.2} mm{side} fits the points to {other_rms} rms, the given {given_mm} mm \
                 to {rms}: check which ball was in the probe, and that the value is its radius, not its diameter; \
                 otherwise the part itself has this form error, for example from a wheel of another radius",
                told_mm.abs()
            )
        }
    })
}

/// Registers the points `sample` again, with the probe radius `radius_mm` in place of the radius in `given`. Starts at
/// the pose of the registration `found`.
///
/// A negative `radius_mm` means a ball on the other side of the surface. A magnitude below 0.1 mm means contact points.
/// Returns `None` if the registration fails.
fn refit_with_radius(
    part: &Part,
    found: &Registration,
    sample: &[Point],
    given: &RegistrationOptions,
    radius_mm: f64,
) -> Option<Registration> {
    let is_ball = radius_mm.abs() >= MIN_BALL_RADIUS_MM;
    let options = RegistrationOptions {
        probe_radius_mm: if is_ball { radius_mm.abs() } else { 0.0 },
        method: if is_ball { given.method } else { Method::Contact },
        start: Start::Pose(found.cmm_from_model),
        side: if is_ball && radius_mm < 0.0 { found.side.other() } else { found.side }.into(),
        ..*given
    };
    let part = Part::new(part.nominal, sample, &options).ok()?;
    super::fit::fit(&part, sample, &options).ok()
}

/// Returns true if `other_rms_mm`, the rms deviation with another probe radius, is much smaller than `rms_mm`, the rms
/// deviation with the given radius. The ratio must be at most 0.65. The decrease of the squared rms must be at least
/// the square of 2e-4 times the rms size of the measured points. Form error of the part does not explain such a
/// decrease.
fn is_better(part: &Part, rms_mm: f64, other_rms_mm: f64) -> bool {
    let taken2 = rms_mm * rms_mm - other_rms_mm * other_rms_mm;
    other_rms_mm <= MAX_RMS_SHARE * rms_mm && taken2 >= (MIN_RMS_PER_SIZE * part.size_mm).powi(2)
}

/// Returns true if a registration with another probe radius is worth its time. The linear estimate of the radius must
/// promise a much smaller rms deviation. The estimated radius must also differ from the given radius by more than five
/// standard uncertainties of the estimate, and by about 35 % of the given radius or more.
///
/// Returns false for contact points, for a radius below 0.1 mm, if a coordinate is locked, for fewer than 27 inliers,
/// or if the rms deviation is already very small.
fn is_radius_testable(part: &Part, found: &Registration, options: &RegistrationOptions) -> bool {
    /// Margin of this test over the final test. The model is linear and a wrong radius is far off, so this test is less
    /// strict.
    const MARGIN: f64 = 1.15;
    let (given_mm, rms_mm) = (options.probe_radius_mm, found.quality.rms_mm);
    // With a locked coordinate, a wrong position of the fixture would look like a wrong radius.
    let is_ball =
        options.method != Method::Contact && given_mm >= MIN_BALL_RADIUS_MM && !options.locked.contains(&true);
    if !is_ball || found.quality.inliers < 7 + MIN_DEGREES_OF_FREEDOM || rms_mm < MIN_RMS_PER_SIZE * part.size_mm {
        return false;
    }
    found.estimate_radius().is_some_and(|told| {
        let off_mm = told.difference_mm.abs();
        MARGIN * off_mm >= MIN_RELATIVE_ERROR * given_mm
            && off_mm > 5.0 * told.sigma_mm
            && is_better(part, MARGIN * rms_mm, told.rms_share * rms_mm)
    })
}

/// Estimates the probe radius iteratively, and returns it in mm. Starts at `first_mm`. In each round `refit` registers
/// the points with the last radius, and [`Registration::estimate_radius`] gives the correction of the radius. The
/// iteration ends after five rounds, or if a correction is below 1 % of `given_mm`, the given radius.
///
/// A negative radius means a ball on the other side of the surface. A magnitude below 0.1 mm counts as 0. Returns
/// `None` if a registration fails or gives no estimate.
fn converged_radius_mm(first_mm: f64, given_mm: f64, refit: &impl Fn(f64) -> Option<Registration>) -> Option<f64> {
    const MAX_ITERATIONS: usize = 5;
    let mut radius_mm = first_mm;
    for _ in 0..MAX_ITERATIONS {
        if radius_mm.abs() < MIN_BALL_RADIUS_MM {
            radius_mm = 0.0;
        }
        let more_mm = refit(radius_mm)?.estimate_radius()?.difference_mm * if radius_mm < 0.0 { -1.0 } else { 1.0 };
        radius_mm += more_mm;
        if more_mm.abs() < 0.01 * given_mm {
            break;
        }
    }
    Some(radius_mm)
}
