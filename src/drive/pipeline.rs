//! Computations between a measurement and the next pass: gates, figures, correction and learned state. The evaluation
//! of a measurement is in `evaluation.rs`.
//!
//! All functions here block and run off the asynchronous threads. They share their inputs. They return the event for
//! the cell and write the files of the run folder.

use std::borrow::Cow;
use std::collections::HashSet;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::cell::{
    CompensationRefusal, CompensationSummary, Event, Figures, GateFailure, GateResult, OutlierFigures,
    RecordedParameter,
};
use crate::compensation::{
    self, Correction, ErrorMap, LearningState, NextPassError, PassObservation, error_map, estimate_response,
};
use crate::device::{Coordinates, Identified, MeasuredPoint, Measurement, Plan, PlanMismatch, TargetKind, TouchStatus};
use crate::figures::statistics::rms;
use crate::figures::{Forecast, FormFigures, Interval, PartResponse};
use crate::form::pv_998;
use crate::formats::run_files::CycleFile;
use crate::formats::{FormatError, Learned, ResultFolder, write_json_atomic, write_points};
use crate::geometry::{Point, Vector};
use crate::measuring::fit_sphere;
use crate::model::{self, Form, PartPriors};
use crate::registration::{PointStatus as Fate, Registration, RegistrationQuality, map_obstacle};

use super::cycle_output;
use super::recorder::{ComputationError, OutputFiles, classify_error};
use super::task::{
    ComputationProduct, ControlPoint, CycleState, RepeatedTouches, Task, UsablePoints, deviation_samples,
    used_deviations,
};

/// Checks whether the measurement of cycle `number` can be used (this check is the gate). If it can, writes its points
/// to `files`. Returns the event for the cell, and the usable points if the gate accepts them and they are saved.
///
/// `cycle` is the state of this cycle, with the plan that was sent. `earlier` is the last measurement of an earlier
/// cycle, with the number of that cycle. The gate compares the two measurements, because a machine could return an old
/// result again.
pub(super) fn gate_cycle(
    task: &Task,
    files: &mut OutputFiles,
    number: u32,
    cycle: Option<&CycleState>,
    (earlier, measurement): (Option<&(u32, Arc<UsablePoints>)>, &Measurement),
) -> (Event, ComputationProduct) {
    let unplanned = || Plan { targets: Vec::new(), ..task.plan(0.0, &task.fixture_cmm_from_model, false) };
    let plan = cycle.and_then(|cycle| cycle.plan.as_deref()).map_or_else(|| Cow::Owned(unplanned()), Cow::Borrowed);
    let before = cycle.filter(|_| task.adaptive.is_some());
    let so_far = before.and_then(|cycle| cycle.points.as_deref());
    let again = cycle.and_then(|cycle| Some((cycle.repeated_touches.as_deref()?, cycle.points.as_deref()?)));
    let planned = plan.targets.iter().filter(|t| t.kind == TargetKind::Part).count() as u32;
    let planned = planned + so_far.map_or(0, |points| points.tried_targets.iter().map(Vec::len).sum::<usize>() as u32);
    let unusable = result_failure(task, &plan, measurement)
        .or_else(|| repeated_result_failure(task, earlier, measurement))
        .or_else(|| temperature_failure(task, measurement));
    let (found, usable) = match unusable {
        Some(failure) => (0, Err(failure)),
        None => {
            if let Some((again, points)) = again {
                merge_repeated_touches(again, points, measurement)
                    .map_or_else(|reason| (0, Err(reason)), |(points, found)| (found, Ok(points)))
            } else {
                let [part, sphere] = touched_points(&plan, planned, measurement);
                let told = (measurement.coordinates, measurement.temperature_c.filter(|told| told.is_finite()));
                let asked = before.map(|cycle| &cycle.batch_targets[..]).unwrap_or_default();
                let touches = TouchRecord::with_batch(so_far, asked, &plan, measurement);
                let (part, sphere) = match so_far {
                    Some(points) => ([&points.part[..], &part].concat(), points.sphere.clone()),
                    None => (part, sphere),
                };
                (part.len() as u32, gate_points(task, planned, part, sphere, told, touches))
            }
        }
    };
    let saved = usable.map_err(ComputationError::Failed).and_then(|points| {
        let made = ResultFolder::prepare(files.folder()).map(ResultFolder::keep);
        let saved = made.and_then(|()| write_measured_points(task, files, &points));
        saved.map(|()| points).map_err(|error| match classify_error(error) {
            ComputationError::NotSaved(reason) => ComputationError::NotSaved(reason),
            ComputationError::Failed(message) => ComputationError::Failed(GateFailure::Broken(message)),
        })
    });
    let (gate, product) = match saved {
        Ok(points) => (GateResult::Passed, ComputationProduct::Points(points)),
        Err(ComputationError::Failed(failure)) => (GateResult::Failed(failure), ComputationProduct::Nothing),
        Err(ComputationError::NotSaved(reason)) => {
            return (Event::NotSaved { cycle: number, reason }, ComputationProduct::Nothing);
        }
    };
    (Event::Collected { cycle: number, targets: planned.max(found), found, gate }, product)
}

/// Merges touches that were repeated (`measurement`) into the earlier points of the same part (`points`). `again` is
/// the plan of the repetition: the outliers, the control points (good touches that were repeated as a check) and the
/// limit of their change. Returns the merged points, and the number of touches in `measurement` that found a surface.
///
/// - An outlier is replaced by its repeated touch. If the repeated touch did not find the part, the outlier stays
///   unchanged.
/// - The touches around the outliers are added.
/// - The control points keep their earlier coordinates.
///
/// # Errors
/// One of the two sets contains probe centres and the other contact points, the measurement has too few points, or the
/// control points have changed. In the last case the part may have moved between the two sets.
fn merge_repeated_touches(
    again: &RepeatedTouches,
    points: &UsablePoints,
    measurement: &Measurement,
) -> Result<(UsablePoints, u32), GateFailure> {
    if measurement.coordinates != points.coordinates {
        let message = "one measurement cannot mix probe centres and contact points; measure again";
        return Err(GateFailure::Broken(message.to_owned()));
    }
    let (outliers, planned) = (again.outlier_points.len(), again.outlier_points.len() + again.control_points.len());
    if measurement.points.len() < planned {
        let found = measurement.points.len();
        return Err(GateFailure::Broken(format!(
            "the machine returned {found} points, but at least {planned} points are required"
        )));
    }
    let found = measurement.points.iter().filter(|point| point.status == TouchStatus::Touched).count();
    let (repeated, rest) = measurement.points.split_at(outliers);
    let (controls, around) = rest.split_at(again.control_points.len());
    check_control_points(again, points, controls)?;
    let mut all = points.clone();
    all.repeat_rounds += 1;
    for (point, &number) in repeated.iter().zip(&again.outlier_points).filter(|(p, _)| p.status == TouchStatus::Touched)
    {
        all.part[number] = point.position_mm.into();
    }
    all.part.extend(around.iter().filter(|p| p.status == TouchStatus::Touched).map(|p| Point::from(p.position_mm)));
    Ok((all, found as u32))
}

/// Checks with the control points (good touches that were repeated as a check) that the part has not moved between two
/// measurements. `points` are the points of the first measurement. `repeated` are the repeated touches of the control
/// points, in the order of the control points in `again`. `again` contains the control points and the limit of their
/// change in mm.
///
/// The change of a control point is the distance between its two touches along the surface normal. Only the second
/// largest change is compared with the limit, because one control point may be a wrong touch.
///
/// # Errors
/// The second largest change exceeds the limit, or fewer than two control points were touched again.
fn check_control_points(
    again: &RepeatedTouches,
    points: &UsablePoints,
    repeated: &[MeasuredPoint],
) -> Result<(), GateFailure> {
    let pairs = again.control_points.iter().zip(repeated).filter(|(_, p)| p.status == TouchStatus::Touched);
    let change_mm = |control: &ControlPoint, now: &MeasuredPoint| {
        (Point::from(now.position_mm) - points.part[control.point_index]).dot(&control.normal).abs()
    };
    let mut changes_mm: Vec<f64> = pairs.map(|(control, now)| change_mm(control, now)).collect();
    changes_mm.sort_by(|a, b| b.total_cmp(a));
    let limit_mm = again.max_control_change_mm;
    match changes_mm.get(1) {
        Some(&second_mm) if second_mm <= limit_mm => Ok(()),
        Some(&second_mm) => Err(GateFailure::Moved(format!(
            "{} control points were touched again, and the second touch is too far from the first touch; the second largest distance is {:.2} µm, limit {:.2} µm",
            changes_mm.iter().filter(|&&change| change > limit_mm).count(),
            1e3 * second_mm,
            1e3 * limit_mm,
        ))),
        None => Err(GateFailure::Moved(format!(
            "{} of {} control points were touched again, but at least 2 are required",
            changes_mm.len(),
            again.control_points.len()
        ))),
    }
}

/// Returns the touched points in the CMM frame in mm: first those on the part, then those on the reference sphere.
/// `planned` is the number of planned targets on the part. If it is 0, the plan has no targets, and all touched points
/// count as points on the part.
fn touched_points(plan: &Plan, planned: u32, measurement: &Measurement) -> [Vec<Point>; 2] {
    let taken = measurement.points.iter().filter(|p| p.status == TouchStatus::Touched).map(|p| p.position_mm.into());
    let of = |kind: TargetKind| -> Vec<Point> {
        let pairs = measurement.points.iter().zip(&plan.targets);
        let touched = pairs.filter(|(p, t)| p.status == TouchStatus::Touched && t.kind == kind);
        touched.map(|(p, _)| p.position_mm.into()).collect()
    };
    let part = if planned == 0 { taken.collect() } else { of(TargetKind::Part) };
    [part, of(TargetKind::ReferenceSphere)]
}

fn gate_points(
    task: &Task,
    planned: u32,
    part: Vec<Point>,
    sphere: Vec<Point>,
    (coordinates, temperature_c): (Coordinates, Option<f64>),
    TouchRecord { tried_targets: tried, point_targets: of, .. }: TouchRecord,
) -> Result<UsablePoints, GateFailure> {
    if part.is_empty() {
        return Err(GateFailure::NoPart);
    }
    let ball = fit_probe_radius(task, &sphere)?;
    let (found, share) = (part.len(), part.len() as f64 / f64::from(planned.max(1)));
    // In a small batch one touch may miss.
    let spared = if tried.is_empty() { 0.0 } else { 1.0 / f64::from(planned.max(1)) };
    if planned > 0 && share + spared < task.min_found_share {
        let limit = 100.0 * task.min_found_share;
        return Err(GateFailure::Coverage(format!(
            "{found} of {planned} points were found ({:.1} %), at least {limit:.1} % are required (min_coverage)",
            100.0 * share
        )));
    }
    let (radius_mm, radius_sigma_mm) = (ball.map(|b| b[0]), ball.map_or(0.0, |b| b[1]));
    let probe_scatter_mm = ball.map_or([0.0; 2], |[.., rms_mm]| probe_noise(rms_mm, sphere.len()));
    Ok(UsablePoints {
        part,
        sphere,
        probe_radius_mm: radius_mm,
        probe_radius_sigma_mm: radius_sigma_mm,
        probe_noise_mm: probe_scatter_mm,
        temperature_c,
        coordinates,
        tried_targets: tried,
        point_targets: of,
        repeat_rounds: 0,
    })
}

/// Estimates the noise of the probe from a sphere fit with `points` points. `rms_mm` is the RMS of the residuals.
/// Returns the standard deviation of the noise in mm, and the relative standard uncertainty of this standard deviation.
///
/// With f = `points` - 4 (but at least 1) degrees of freedom, the standard deviation is rms (points / f)^(1/2), and its
/// relative uncertainty is (2 f)^(-1/2).
fn probe_noise(rms_mm: f64, points: usize) -> [f64; 2] {
    const FITTED: f64 = 4.0;
    let free = (points as f64 - FITTED).max(1.0);
    [rms_mm * (points as f64 / free).sqrt(), 1.0 / (2.0 * free).sqrt()]
}

/// Targets of an adaptive measurement that were tried, and those that were found.
#[derive(Default, Serialize, Deserialize)]
pub(super) struct TouchRecord {
    simulation: bool,
    /// Targets of each batch, by their positions in the pattern.
    #[serde(rename = "tried")]
    tried_targets: Vec<Vec<usize>>,
    /// Target of each point that was found.
    #[serde(rename = "of")]
    point_targets: Vec<usize>,
}

impl TouchRecord {
    /// Returns a record that lists the targets that the probe tried to touch in each batch of an adaptive measurement,
    /// and the target of each point that was found. `so_far` contains the earlier batches, or is `None` for the first
    /// batch. `asked` are the indices of the targets of the new batch in the list of all targets of the part. `plan`
    /// and `measurement` are the plan and the result of the new batch.
    ///
    /// If `asked` is empty, the measurement is not adaptive, and no batch is added.
    fn with_batch(so_far: Option<&UsablePoints>, asked: &[usize], plan: &Plan, measurement: &Measurement) -> Self {
        let (mut tried, mut of) =
            so_far.map(|points| (points.tried_targets.clone(), points.point_targets.clone())).unwrap_or_default();
        if !asked.is_empty() {
            let pairs = measurement.points.iter().zip(&plan.targets).filter(|(_, t)| t.kind == TargetKind::Part);
            let found = pairs.zip(asked).filter(|((p, _), _)| p.status == TouchStatus::Touched);
            of.extend(found.map(|(_, target)| *target));
            tried.push(asked.to_vec());
        }
        Self { simulation: false, tried_targets: tried, point_targets: of }
    }
}

/// Restores the usable points of a measurement that an interrupted program had accepted. The arguments come from the
/// recorded files.
///
/// `part` and `sphere` are the touched points on the part and on the reference sphere, in mm. `told` is the kind of
/// coordinates (probe centres or contact points) and the temperature in °C. `touches` are the targets of an adaptive
/// measurement. `rounds` is the number of times that outliers were touched again.
///
/// # Errors
/// The points do not pass the gate (the check whether they can be used).
pub(super) fn gate_recorded_points(
    task: &Task,
    part: Vec<Point>,
    sphere: Vec<Point>,
    told: (Coordinates, Option<f64>),
    (touches, rounds): (Option<TouchRecord>, u32),
) -> Result<UsablePoints, GateFailure> {
    let points = gate_points(task, 0, part, sphere, told, touches.unwrap_or_default())?;
    Ok(UsablePoints { repeat_rounds: rounds, ..points })
}

/// Maximum relative difference of a qualified probe's radius from the stated one. A larger one means another stylus.
const MAX_PROBE_RADIUS_DIFFERENCE: f64 = 0.01;

/// Returns a failure of the gate if `measurement` belongs to another plan than `plan`, or if it contradicts the plan,
/// the cell file or the recipe. Examples are another kind of coordinates, another probe radius, a wrong number or order
/// of points, and a value out of range. Returns `None` if no contradiction is found.
fn result_failure(task: &Task, plan: &Plan, measurement: &Measurement) -> Option<GateFailure> {
    if measurement.plan_identity != plan.identity() {
        return Some(GateFailure::Foreign(
            "the result of the machine names another plan than the plan that was sent".into(),
        ));
    }
    match (measurement.coordinates, task.expected_coordinates) {
        (Coordinates::Contacts, Some(Coordinates::Centres)) => return Some(GateFailure::Contacts),
        (Coordinates::Centres, Some(Coordinates::Contacts)) => {
            let message = "the machine returns probe centres, but the cell file expects contact points";
            return Some(GateFailure::Broken(message.into()));
        }
        _ => {}
    }
    let stated_mm = task.probing.probe_radius_mm;
    let told = measurement.probe_radius_mm.filter(|told| *told > 0.0);
    if let Some(told_mm) = told.filter(|told| (told - stated_mm).abs() > MAX_PROBE_RADIUS_DIFFERENCE * stated_mm) {
        let message =
            format!("the probe radius of the measurement is {told_mm:.4} mm, but the recipe has {stated_mm:.4} mm");
        return Some(GateFailure::Broken(message));
    }
    if !plan.targets.is_empty() && measurement.points.len() != plan.targets.len() {
        let (found, planned) = (measurement.points.len(), plan.targets.len());
        return Some(GateFailure::Broken(format!(
            "the machine returned {found} points, but the plan has {planned} targets"
        )));
    }
    if let Some(flaw) = measurement.range_violation() {
        return Some(GateFailure::Broken(flaw));
    }
    let order = measurement.points.iter().zip(&plan.targets).position(|(p, t)| p.index != t.index);
    if let Some(k) = order {
        let (found, planned) = (measurement.points[k].index, plan.targets[k].index);
        return Some(GateFailure::Broken(format!(
            "point {} of the result belongs to target {found}, but the plan has target {planned} at this place",
            k + 1
        )));
    }
    match plan.check(measurement).err()? {
        PlanMismatch::EqualsPlan if task.rehearsal => None,
        given_back @ PlanMismatch::EqualsPlan => Some(GateFailure::Foreign(given_back.to_string())),
        elsewhere => Some(GateFailure::Broken(elsewhere.to_string())),
    }
}

/// Minimum number of touches for a comparison of two results. Fewer touches can be equal by chance, if a machine
/// reports coarse steps.
const MIN_COMPARED_TOUCHES: usize = 8;

/// Returns a failure of the gate (the check whether a measurement can be used) if the machine has returned an old
/// result again. This is the case if the touched points contain all points of the measurement `earlier`, equal in every
/// bit. Two real measurements never agree so exactly. `earlier` is an older measurement with the number of its cycle.
///
/// Returns `None` if the points differ. Also returns `None` if there is no earlier measurement, if it has fewer than
/// [`MIN_COMPARED_TOUCHES`] points, or in a rehearsal (a run in which people act as the machines and no part exists).
fn repeated_result_failure(
    task: &Task,
    earlier: Option<&(u32, Arc<UsablePoints>)>,
    measurement: &Measurement,
) -> Option<GateFailure> {
    let (number, points) = earlier.filter(|_| !task.rehearsal)?;
    let touched = || measurement.points.iter().filter(|point| point.status == TouchStatus::Touched);
    // Ignore the order of the plan and the points of the reference sphere.
    let bits = |at_mm: [f64; 3]| at_mm.map(f64::to_bits);
    let old: HashSet<_> = points.part.iter().map(|point| bits([point.x, point.y, point.z])).collect();
    let is_same = touched().filter(|point| old.contains(&bits(point.position_mm))).count() >= old.len();
    (is_same && old.len() >= MIN_COMPARED_TOUCHES).then(|| {
        let message =
            format!("all points are identical to the points of cycle {number}: the machine returned its old result");
        GateFailure::Foreign(message)
    })
}

/// Returns a failure if the temperature of a measurement is outside the limits of the recipe, or if it is missing
/// although the limits or the thermal expansion require it. Returns `None` otherwise.
fn temperature_failure(task: &Task, measurement: &Measurement) -> Option<GateFailure> {
    if task.expansion.is_some() && measurement.temperature_c.is_none() {
        let message = "the measurement has no temperature, but the compensation of the thermal expansion requires a temperature (part.expansion_um_m_k)";
        return Some(GateFailure::Temperature(message.to_owned()));
    }
    let [least, most] = task.temperature_range_c?;
    let wanted = format!("limits {least:.2} to {most:.2} °C (measure.temperature_c)");
    match measurement.temperature_c {
        Some(told) if (least..=most).contains(&told) => None,
        Some(told) => Some(GateFailure::Temperature(format!("it was {told:.2} °C, {wanted}"))),
        None => Some(GateFailure::Temperature(format!("the measurement has no temperature, {wanted}"))),
    }
}

/// Measures the radius of the probe. Fits a sphere to `points`, the touched points on the reference sphere, and
/// subtracts the radius of the reference sphere. Returns the probe radius, its standard uncertainty, and the RMS of the
/// residuals, all in mm. Returns `None` if the recipe has no reference sphere.
///
/// # Errors
/// - No sphere can be fitted.
/// - The fitted radius is nearly the radius of the reference sphere. Then the points are contact points instead of
///   probe centres.
/// - The fitted radius is about 25.4 times too small. Then the coordinates are in inches instead of mm.
fn fit_probe_radius(task: &Task, points: &[Point]) -> Result<Option<[f64; 3]>, GateFailure> {
    let Some(sphere) = task.reference_sphere else { return Ok(None) };
    let fit = fit_sphere(points).map_err(|error| GateFailure::Broken(error.to_string()))?;
    let (stated, found) = (task.probing.probe_radius_mm, fit.radius_mm - sphere.radius_mm);
    // Contact points lie on the sphere itself; inches make it 25.4 times smaller.
    if found.abs() < 0.2 * stated {
        return Err(GateFailure::Contacts);
    }
    if (fit.radius_mm * 25.4 / (sphere.radius_mm + stated) - 1.0).abs() < 0.05 {
        return Err(GateFailure::Inches);
    }
    Ok(Some([found, fit.radius_sigma_mm, fit.rms_mm]))
}

/// Returns the state of the learning (the estimate of how the part responds to corrections) after a measured pass.
/// Updates the state of `before`, the previous judged cycle. If `before` has none, updates the initial state of the
/// run. `error` is the error map of this cycle. `answer` is the response of the part to the correction, if it was
/// estimated. `contacts` are the measured points.
pub(super) fn update_learning(
    task: &Task,
    cycle: &CycleState,
    before: Option<&CycleState>,
    error: &ErrorMap,
    (answer, contacts): (Option<compensation::Response>, &[compensation::SurfacePoint]),
) -> LearningState {
    let earlier =
        before.and_then(|before| before.learning.as_deref().cloned()).unwrap_or_else(|| task.initial_learning());
    let smoother = cycle_output::parameter_explainer(task, cycle, contacts);
    let smooth = smoother.as_ref().map(|smoother| smoother as compensation::ParameterExplainer<'_>);
    earlier.updated(&PassObservation { correction: &cycle.correction, error, response: answer, explained: smooth })
}

pub(super) fn cell_figures(
    task: &Task,
    cycle: &CycleState,
    found: &Registration,
    form: Option<&Form>,
    error: Option<&ErrorMap>,
    answer: Option<compensation::Response>,
    forecast: Option<Forecast>,
) -> Figures {
    let verdict = &found.quality;
    let moved = task.fixture_cmm_from_model.inverse() * found.cmm_from_model;
    let outliers = found.deviations.iter().filter(|d| d.status == Fate::Outlier).count() as u32;
    // The filter removes the noise of a point: noise of the probe and the finest texture.
    let filtered_mm = error.map_or(verdict.residual_sigma_mm, |map| map.point_sigma_mm);
    let scatter_mm = form.map_or(filtered_mm, |form| form.hyperparameters.noise_sigma_mm);
    let pv_robust_mm = pv_998(used_deviations(found).map(|d| d.deviation_mm));
    // Difference of two extreme points, each with this noise; k = 2.
    let pv_expanded_mm = 2.0 * 2f64.sqrt() * scatter_mm;
    // The peak to valley is not negative.
    let pv_about = |mm| {
        let of = Interval::from_expanded(mm, pv_expanded_mm);
        Interval { low_mm: of.low_mm.max(0.0), ..of }
    };
    let by_points = FormFigures {
        pv: pv_about(verdict.pv_mm),
        pv_998: pv_about(pv_robust_mm.unwrap_or(verdict.pv_mm)),
        rms: rms_without_noise(scatter_mm, verdict),
        noise_sigma_mm: scatter_mm,
    };
    let told = form.map_or(by_points, |form| form.figures);
    // The forecast must be of the same figure: the filtered map still contains the noise of the probe, and the part
    // does not.
    let bare = |mm: f64| subtract_in_quadrature(scatter_mm, mm);
    Figures {
        pv_mm: verdict.pv_mm,
        pv_998_mm: pv_robust_mm,
        rms_mm: verdict.rms_mm,
        form: Some(told),
        pv_expanded_mm,
        rms_expanded_mm: by_points.rms.expanded_mm(),
        coverage: verdict.coverage,
        points: verdict.inliers as u32,
        outliers,
        with_outliers: found.figures_with_outliers().map(|of| {
            Box::new(OutlierFigures {
                pv_mm: of.pv_mm,
                rms_mm: of.rms_mm,
                description: of.description,
                can_repeat: false,
            })
        }),
        shift_mm: moved.translation_mm.norm(),
        rotation_rad: moved.angle_rad(),
        weak_directions: verdict.weak_directions.iter().map(|w| w.description.clone()).collect(),
        warnings: verdict.warnings.clone(),
        response: answer.map(|answer| answer.kind),
        forecast: forecast.map(|f| Forecast { rms_mm: bare(f.rms_mm), floor_mm: f.floor_mm.map(bare), ..f }),
        removed_mm: Some(task.correction_limits.allowance_mm - cycle.correction.level_mm),
        unstated: form.and_then(|form| unstated_contributions(task, form)),
        further_touches: None,
    }
}

/// Counts the contributions to the uncertainty of the form. Returns two numbers: the contributions without a stated
/// value, and all contributions. The uncertainty of the datum is counted only if it has a stated value or the recipe
/// locks a direction of the pose. Returns `None` if there is no contribution.
fn unstated_contributions(task: &Task, form: &Form) -> Option<[u32; 2]> {
    let counts = |share: &&model::BudgetEntry| {
        share.is_stated || share.source != model::UncertaintySource::Datum || task.locked_direction_sigmas().is_some()
    };
    let all: Vec<_> = form.budget.iter().filter(counts).collect();
    let some = all.iter().filter(|share| !share.is_stated).count();
    (!all.is_empty()).then_some([some as u32, all.len() as u32])
}

/// Subtracts the independent contribution `scatter_mm` (a standard deviation) from the root mean square `rms_mm`.
/// Returns the square root of rms_mm^2 - scatter_mm^2, in mm. Returns 0 if this difference is negative.
fn subtract_in_quadrature(scatter_mm: f64, rms_mm: f64) -> f64 {
    (rms_mm * rms_mm - scatter_mm * scatter_mm).max(0.0).sqrt()
}

/// Returns the interval (k = 2) in mm of F, the root mean square of the form without the noise of the probe.
/// `scatter_mm` is s, the standard deviation of this noise. `verdict` contains RMS, the root mean square of the
/// deviations, and n, the number of points that the registration used.
///
/// With p = 6 degrees of freedom of the registration, F^2 = RMS^2 - s^2 (1 - p/n). Its uncertainty u is given by
/// u^2(F^2) = 4 F^2 s^2 / n + 2 s^4 / n.
fn rms_without_noise(scatter_mm: f64, verdict: &RegistrationQuality) -> Interval {
    const MOTIONS: f64 = 6.0;
    let n = (verdict.inliers as f64).max(MOTIONS + 1.0);
    let scatter2 = scatter_mm * scatter_mm;
    let form2 = (verdict.rms_mm.powi(2) - scatter2 * (1.0 - MOTIONS / n)).max(0.0);
    let expanded2 = 2.0 * ((4.0 * form2 * scatter2 + 2.0 * scatter2 * scatter2) / n).sqrt();
    Interval {
        median_mm: form2.sqrt(),
        low_mm: (form2 - expanded2).max(0.0).sqrt(),
        high_mm: (form2 + expanded2).sqrt(),
        quantiles_mm: None,
    }
}

pub(super) fn part_response(
    before: &CycleState,
    cycle: &CycleState,
    found: &Registration,
    error: &ErrorMap,
) -> Option<compensation::Response> {
    let earlier = before.error_map.as_ref()?;
    let places: Vec<(Point, Vector)> = used_deviations(found).map(|d| (d.point, d.normal)).collect();
    let scatter_mm = earlier.point_sigma_mm.hypot(error.point_sigma_mm);
    Some(estimate_response([earlier, error], [&before.correction, &cycle.correction], &places, scatter_mm))
}

/// Computes the correction for the pass after cycle `number`, and writes it to `files`. Returns the event for the cell
/// (compensated, refused or not saved) and the correction.
pub(super) fn compensate_cycle(
    task: &Task,
    files: &mut OutputFiles,
    number: u32,
    cycle: &CycleState,
) -> (Event, ComputationProduct) {
    match compute_correction(task, files, cycle) {
        Ok((summary, next)) => (Event::Compensated { cycle: number, summary }, ComputationProduct::Correction(next)),
        Err(ComputationError::Failed(reason)) => {
            (Event::CompensationRefused { cycle: number, reason }, ComputationProduct::Nothing)
        }
        Err(ComputationError::NotSaved(reason)) => {
            (Event::NotSaved { cycle: number, reason }, ComputationProduct::Nothing)
        }
    }
}

fn compute_correction(
    task: &Task,
    files: &mut OutputFiles,
    cycle: &CycleState,
) -> Result<(CompensationSummary, Correction), ComputationError<CompensationRefusal>> {
    let failed =
        |reason: &dyn std::fmt::Display| ComputationError::Failed(CompensationRefusal::Failed(reason.to_string()));
    let found = cycle.registration.as_ref().ok_or_else(|| {
        failed(&"the measurement of this cycle has no registration, so no correction can be computed")
    })?;
    // If the part may slide within its own surface, the place of the map on the part is unknown.
    let covariance = cycle.form.as_ref().map_or(&found.quality.covariance, |form| &form.frame_covariance);
    if let Some(reason) = map_obstacle(found, covariance, &task.map_limits) {
        return Err(ComputationError::Failed(CompensationRefusal::WeakDirections(vec![reason])));
    }
    let map = match &cycle.error_map {
        Some(map) => Arc::clone(map),
        None => Arc::new(error_map(&deviation_samples(found), &task.map_options).map_err(|error| failed(&error))?),
    };
    let known = match &cycle.learning {
        Some(known) => Arc::clone(known),
        None => Arc::new(update_learning(task, cycle, None, &map, (None, &cycle_output::surface_points(found)))),
    };
    let step = cycle
        .correction
        .next_pass(&map, &known, cycle.parameter_corrections.as_deref(), &task.correction_limits)
        .map_err(|error| match error {
            NextPassError::BudgetSpent { .. } => {
                ComputationError::Failed(CompensationRefusal::BudgetSpent(error.to_string()))
            }
            error => failed(&error),
        })?;
    // A pass that cannot be ground must leave no correction that could be mistaken for one.
    let warning = task.save_program(files, &step.correction).map_err(|error| match classify_error(error) {
        ComputationError::Failed(reason) => failed(&format_args!("the next pass cannot be ground: {reason}")),
        ComputationError::NotSaved(reason) => ComputationError::NotSaved(reason),
    })?;
    task.save_correction(files, &step.correction, &cycle.correction).map_err(|error| match classify_error(error) {
        ComputationError::Failed(reason) => failed(&reason),
        ComputationError::NotSaved(reason) => ComputationError::NotSaved(reason),
    })?;
    let max_mm = step.correction.values_mm.iter().fold(0.0f64, |most, v| most.max(v.abs()));
    let told = cycle.figures.as_ref().and_then(|figures| figures.form);
    let [pv_mm, rms_mm, scatter_mm] = told.map_or([found.quality.pv_mm, found.quality.rms_mm, 0.0], |form| {
        [form.pv_998.median_mm, form.rms.median_mm, form.noise_sigma_mm]
    });
    let expected_mm = subtract_in_quadrature(scatter_mm, known.forecast(&map, task.scallops_rms_mm()).rms_mm);
    let summary = CompensationSummary {
        max_correction_mm: max_mm,
        depth_mm: step.depth_mm,
        predicted_pv_mm: expected_mm * pv_mm / rms_mm.max(f64::MIN_POSITIVE),
        predicted_rms_mm: expected_mm,
        air_share: step.air_share,
        gains: known.gains(),
        responded_share: known.response()[0],
        warnings: warning.into_iter().collect(),
        map_rms_mm: task.parameter_compensation.as_ref().map(|_| rms(&step.correction.values_mm)),
        parameters: recorded_parameters(task, cycle),
        confirmations_required: parameter_questions(cycle),
    };
    Ok((summary, step.correction))
}

/// Returns the estimated errors of the machine parameters that the recipe compensates, as the cell records them (in the
/// display unit of each parameter). Parameters that cannot be separated from other effects are omitted. Returns an
/// empty list for a later pass, because only the error after the first pass of a run is used for the estimate.
pub(super) fn recorded_parameters(task: &Task, cycle: &CycleState) -> Vec<RecordedParameter> {
    let Some(taken) = &task.parameter_compensation else { return Vec::new() };
    let told = cycle.parameters.iter().flat_map(|told| told.estimates.iter().enumerate());
    let wanted = told.filter(|(k, p)| taken.tolerances[*k].is_some() && p.inseparable_from.is_empty());
    let told = |(k, p): (usize, &compensation::EstimatedParameter)| {
        let units = p.kind.display_units_per_unit();
        RecordedParameter {
            name: p.kind.name().to_owned(),
            unit: p.kind.unit().to_owned(),
            estimate: units * p.value,
            expanded_uncertainty: 2.0 * units * p.sigma,
            compensated: units * p.compensated,
            total_correction: units * cycle.parameter_corrections.as_ref().map_or(0.0, |set| set.values[k]),
            rms_reduction_um: 1e3 * p.rms_reduction_mm,
        }
    };
    wanted.map(told).collect()
}

/// Returns one text for each machine parameter for which a person must decide before the next pass. These are the
/// parameters whose compensation exceeds the limit for this parameter in the recipe. The text states the estimated
/// error, its expanded uncertainty and the compensation.
fn parameter_questions(cycle: &CycleState) -> Vec<String> {
    let beyond = cycle.parameters.iter().flat_map(|told| &told.estimates).filter(|p| p.exceeds_tolerance);
    let question = |p: &compensation::EstimatedParameter| {
        let (units, unit) = (p.kind.display_units_per_unit(), p.kind.unit());
        let key = p.kind.recipe_key().unwrap_or_default();
        format!(
            "{}: error {:.2} \u{b1} {:.2} {unit}; the compensation of {:.2} {unit} for this error exceeds the limit compensation.parameters.{key}",
            p.kind.name(),
            units * p.value,
            2.0 * units * p.sigma,
            units * p.compensated
        )
    };
    beyond.map(question).collect()
}

/// Returns the learned state of a run, with which the next part of this kind can begin. `run` is the name of the run,
/// `cycle` its last judged cycle, and `fields` the priors of the error model for later parts.
///
/// Returns `None` if the cycle has no learning state or no figures. Also returns `None` if the part responded wrongly
/// to the correction: with the wrong sign, mirrored, doubled, or not at all.
pub(super) fn learned_state(task: &Task, run: String, (cycle, fields): (&CycleState, PartPriors)) -> Option<Learned> {
    let known = cycle.learning.as_deref()?;
    let wrong = [PartResponse::SignFlipped, PartResponse::Mirrored, PartResponse::NoEffect, PartResponse::Doubled];
    if cycle.figures.as_ref()?.response.is_some_and(|response| wrong.contains(&response)) {
        return None;
    }
    let (setting, simulation) = (task.setting.id.clone(), task.simulation);
    let correction = cycle.correction.compensating(known, cycle.parameter_corrections.as_deref());
    Some(
        Learned::new(simulation, setting, run, correction, known.clone())
            .with_fields(fields)
            .with_kind(task.kind.id.clone()),
    )
}

/// Number of rounds in which outliers of a measurement were touched again.
#[derive(Serialize, Deserialize)]
pub(super) struct RepeatedTouchesRecord {
    simulation: bool,
    pub(super) rounds: u32,
}

/// Conditions of a measurement, as far as the registration uses them.
#[derive(Serialize, Deserialize)]
pub(super) struct MeasurementConditions {
    simulation: bool,
    /// Temperature of the part, in °C.
    pub(super) temperature_c: f64,
}

/// Writes the points of a measurement as CSV files: those on the part, and those on the reference sphere if there are
/// any. The coordinates are in the CMM frame in mm. Also writes JSON files: the temperature if the thermal expansion is
/// compensated, the targets of an adaptive measurement, and the number of times that outliers were touched again, if it
/// is not 0.
///
/// # Errors
/// A file cannot be written.
pub(super) fn write_measured_points(
    task: &Task,
    files: &mut OutputFiles,
    points: &UsablePoints,
) -> Result<(), FormatError> {
    if let Some(temperature_c) = points.temperature_c.filter(|_| task.expansion.is_some()) {
        let conditions = MeasurementConditions { simulation: task.simulation, temperature_c };
        write_json_atomic(files.add_file(CycleFile::Conditions), &conditions)?;
    }
    if points.repeat_rounds > 0 {
        let again = RepeatedTouchesRecord { simulation: task.simulation, rounds: points.repeat_rounds };
        write_json_atomic(files.add_file(CycleFile::RepeatedTouches), &again)?;
    }
    if !points.tried_targets.is_empty() {
        let (tried, of) = (points.tried_targets.clone(), points.point_targets.clone());
        write_json_atomic(
            files.add_file(CycleFile::Touches),
            &TouchRecord { simulation: task.simulation, tried_targets: tried, point_targets: of },
        )?;
    }
    let header = if task.simulation { "# SIMULATION\nx_mm,y_mm,z_mm" } else { "x_mm,y_mm,z_mm" };
    if !points.sphere.is_empty() {
        write_points(files.add_file(CycleFile::ReferenceSphere), header, &points.sphere)?;
    }
    write_points(files.add_file(CycleFile::Measured), header, &points.part)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Standard limit of the tests: changes of control points up to 2 µm are noise.
    const LIMIT_MM: f64 = 2e-3;

    /// Returns five points in a row on a plane, of which the last is an outlier and the others are control points.
    fn first_touches() -> (RepeatedTouches, UsablePoints) {
        let part: Vec<Point> = (0..5).map(|k| Point::new(f64::from(k), 0.0, 1.0)).collect();
        let normal = Vector::z();
        let again = RepeatedTouches {
            outlier_points: vec![4],
            control_points: (0..4).map(|point| ControlPoint { point_index: point, normal }).collect(),
            max_control_change_mm: LIMIT_MM,
            targets: Vec::new(),
        };
        let points = UsablePoints {
            part,
            sphere: Vec::new(),
            probe_radius_mm: None,
            coordinates: Coordinates::Centres,
            probe_radius_sigma_mm: 0.0,
            probe_noise_mm: [0.0; 2],
            temperature_c: None,
            tried_targets: Vec::new(),
            point_targets: Vec::new(),
            repeat_rounds: 0,
        };
        (again, points)
    }

    /// Returns a repetition: the outlier, the four control points, and one point around the outlier. `None` is a miss.
    fn repeated_measurement(heights_mm: [Option<f64>; 6]) -> Measurement {
        let x_mm = [4.0, 0.0, 1.0, 2.0, 3.0, 3.6];
        let points = heights_mm.iter().zip(x_mm).zip(0..).map(|((height, x), index)| MeasuredPoint {
            index,
            position_mm: [x, 0.0, height.unwrap_or(0.0)],
            status: if height.is_some() { TouchStatus::Touched } else { TouchStatus::NotFound },
            quality: 0,
        });
        Measurement {
            points: points.collect(),
            coordinates: Coordinates::Centres,
            probe_radius_mm: None,
            temperature_c: None,
            duration_s: None,
            plan_identity: [0; 32],
            job: 1,
            cycle: 1,
            done: 1,
        }
    }

    fn heights(controls_mm: [f64; 4]) -> [Option<f64>; 6] {
        let [a, b, c, d] = controls_mm;
        [Some(0.5), Some(a), Some(b), Some(c), Some(d), Some(0.75)]
    }

    #[test]
    fn repeat_touches_replace_outliers() {
        let (again, points) = first_touches();
        let (all, found) = merge_repeated_touches(&again, &points, &repeated_measurement(heights([1.001; 4]))).unwrap();
        assert_eq!((found, all.repeat_rounds, all.part.len()), (6, 1, 6));
        assert_eq!(all.part[4], Point::new(4.0, 0.0, 0.5));
        assert_eq!(all.part[5], Point::new(3.6, 0.0, 0.75));
        assert_eq!(all.part[..4], points.part[..4]);
    }

    #[test]
    fn repeat_touches_missed_uses_first() {
        let (again, points) = first_touches();
        let missed = [None, Some(1.0), Some(1.0), Some(1.0), Some(1.0), None];
        let (all, found) = merge_repeated_touches(&again, &points, &repeated_measurement(missed)).unwrap();
        assert_eq!((found, all.part), (4, points.part));
    }

    #[test]
    fn repeat_touches_refuse_moved_part() {
        let (again, points) = first_touches();
        // A tilt changes only the far control points.
        for controls in [[1.0021; 4], [0.9979; 4], [1.0, 1.001, 1.0022, 1.0033]] {
            let refused = merge_repeated_touches(&again, &points, &repeated_measurement(heights(controls)));
            assert!(matches!(refused, Err(GateFailure::Moved(_))), "{controls:?}");
        }
        // A single wrong touch says nothing about the part.
        assert!(merge_repeated_touches(&again, &points, &repeated_measurement(heights([1.0, 1.0, 9.0, 1.0]))).is_ok());
    }

    #[test]
    fn repeat_touches_require_two_controls() {
        let (again, points) = first_touches();
        let missed = [Some(1.0), Some(1.0), None, None, None, Some(1.0)];
        assert!(matches!(
            merge_repeated_touches(&again, &points, &repeated_measurement(missed)),
            Err(GateFailure::Moved(_))
        ));
    }

    #[test]
    fn repeat_touches_refuse_mixed_kinds() {
        let (again, points) = first_touches();
        let contacts = Measurement { coordinates: Coordinates::Contacts, ..repeated_measurement(heights([1.0; 4])) };
        assert!(matches!(merge_repeated_touches(&again, &points, &contacts), Err(GateFailure::Broken(_))));
    }
}
