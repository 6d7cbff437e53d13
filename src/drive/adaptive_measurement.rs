//! Adaptive measurement, in which the touches are chosen: evaluation after a batch, and choice of the next targets.

use super::task::{AdaptiveOptions, ControlPoint, CycleState, RepeatedTouches, Task, UsablePoints};
use crate::compensation::{ErrorMap, map_from_model};
use crate::device::BatchId;
use crate::geometry::{DeviationSample, Vector};
use crate::measuring::Target;
use crate::model::{
    self, Form, MAX_BATCHES, MIN_TOUCHES, ModelInputs, PartialMeasurement, Reason, farthest_points, short_tour,
};
use crate::registration::{Deviation, PointStatus, Registration};
use crate::surface::{FacetIndex, OffsetSurface, Side};

// After the maximum number of batches follows one with all remaining targets. The batch numbers must be unique.
const _: () = assert!(MAX_BATCHES < BatchId::MAX_BATCHES - 1);

/// Result of an evaluation.
pub(super) struct TouchEvaluation {
    /// Form over the whole pattern, or the reason why there is none.
    pub(super) form: Result<Form, String>,
    /// Next targets with the reason, or `None` if enough is known.
    pub(super) next: Option<(Vec<usize>, &'static str)>,
}

/// Evaluates an adaptive measurement (targets are touched in batches until enough is known) after one batch. Returns
/// the estimated form of the part. Also returns the indices of the next targets to touch, with the reason. The next
/// targets are `None` if no further touch is needed or no target is left.
///
/// `adaptive` contains the rules for the end of the measurement. `(number, cycle)` is the cycle with its number.
/// `points` are the usable points of all batches so far. `found` is the registration of these points, and `given` are
/// the inputs of the error model.
///
/// There are two special cases:
///
/// - After the first batch, no form is estimated. This batch only shows whether the part is at its expected place. The
///   form is then a text with this reason, and the next targets are as many as the first estimate requires.
/// - If no model fits the points, the form is a text with the reason, and the next targets are all targets that were
///   not tried.
pub(super) fn evaluate_touches(
    task: &Task,
    adaptive: &AdaptiveOptions,
    (number, cycle): (u32, &CycleState),
    points: &UsablePoints,
    (found, given): (&Registration, ModelInputs),
) -> TouchEvaluation {
    let places = task.target_places();
    let mut tried = vec![None; places.len()];
    for (batch, targets) in (0..).zip(&points.tried_targets) {
        targets.iter().for_each(|&target| tried[target] = Some(batch));
    }
    let open = |chosen: Vec<usize>| chosen.into_iter().filter(|&k| tried[k].is_none()).collect();
    let first: Vec<usize> = open(farthest_points(&places, MIN_TOUCHES));
    if points.tried_targets.len() == 1 && !first.is_empty() {
        let reason = "the first touches found the part at its expected place";
        return TouchEvaluation { form: Err(reason.to_owned()), next: Some((short_tour(&places, first), reason)) };
    }
    let so_far = PartialMeasurement { targets: &places, tried: &tried, touched: &points.point_targets };
    let purpose = adaptive.stopping_criteria(u32::from(cycle.correction.cycle) < adaptive.max_measurements);
    let given = ModelInputs {
        decision_risk: adaptive.decision_risk(),
        acceptance_probability: adaptive.tolerance.probability,
        ..given
    };
    match model::decide(found, &given, &so_far, &purpose, u64::from(number)) {
        Ok(look) => {
            let next = (!look.next.is_empty()).then(|| (look.next, reason_message(look.reason)));
            TouchEvaluation { form: Ok(look.form), next }
        }
        // If no model can be fitted, touch every target.
        Err(error) => {
            let rest: Vec<usize> = open((0..places.len()).collect());
            let next = (!rest.is_empty()).then_some((rest, "no model fits these points"));
            TouchEvaluation { form: Err(error.to_string()), next }
        }
    }
}

/// Plans to touch again the points that the registration `found` marks as outliers. Returns the outliers, the control
/// points (inliers that are touched again to detect a motion of the part), the largest allowed change of a control
/// point in mm, and the targets in the model frame.
///
/// The targets have this order: one for each outlier, then one for each control point, then up to four around each
/// outlier. The targets around an outlier lie between the outlier and its nearest inliers, in different directions. The
/// probe can reach such a target, because it has already touched the outlier and the inlier. The control points are as
/// far apart as possible.
///
/// `points` are the usable points of the measurement. `noise_sigma_mm` is the standard deviation of the noise of the
/// probe. It determines the allowed change.
///
/// Returns `None` if the task has no targets, if there is no outlier or more than 20, or if outliers were already
/// touched again so often that no number is left for another batch.
pub(super) fn plan_repeated_touches(
    task: &Task,
    found: &Registration,
    points: &UsablePoints,
    noise_sigma_mm: f64,
) -> Option<RepeatedTouches> {
    const MAX_OUTLIERS: usize = 20;
    const CONTROL_POINTS: usize = 6;
    /// Limit of the change of a control point, in standard deviations of the difference of two touches.
    const CONTROL_SIGMAS: f64 = 5.0;
    /// Change of a control point that is always allowed: the repeatability of a very good machine.
    const MIN_CHANGE_MM: f64 = 5e-5;
    const TARGETS_AROUND: usize = 4;
    /// Distance of a target from the outlier, as a share of the distance to the neighbour.
    const NEIGHBOUR_SHARE: f64 = 0.4;
    /// Cosine of the angle between two directions, above which a neighbour is in the same direction as another one.
    const SAME_DIRECTION_COSINE: f64 = 0.7;
    let alone: Vec<usize> = found.outliers().map(|(k, _)| k).collect();
    if task.targets.is_empty()
        || alone.is_empty()
        || alone.len() > MAX_OUTLIERS
        || points.repeat_rounds + 2 >= BatchId::MAX_BATCHES
    {
        return None;
    }
    let on_part: Vec<&Deviation> = found.deviations.iter().filter(|d| d.status != PointStatus::OffPart).collect();
    // Nominal contact point: the deviation of the touch is not a place on the part.
    let foot = |d: &Deviation| d.point - d.normal * d.deviation_mm;
    let mut targets: Vec<Target> = Vec::new();
    let mut around: Vec<Target> = Vec::new();
    let used: Vec<usize> =
        (0..found.deviations.len()).filter(|&k| found.deviations[k].status == PointStatus::Inlier).collect();
    let places: Vec<_> = used.iter().map(|&k| (foot(&found.deviations[k]), found.deviations[k].normal)).collect();
    let controls = farthest_points(&places, CONTROL_POINTS);
    for &k in &alone {
        let lone = &found.deviations[k];
        let at = foot(lone);
        targets.push(Target { point: at, normal: lone.normal });
        let mut near: Vec<(&Deviation, Vector)> = on_part.iter().map(|d| (*d, foot(d) - at)).collect();
        near.retain(|(d, way)| way.norm() > 0.0 && d.status == PointStatus::Inlier);
        near.sort_by(|a, b| a.1.norm_squared().total_cmp(&b.1.norm_squared()));
        let mut ways: Vec<Vector> = Vec::new();
        for (neighbour, way) in near {
            let unit = way.normalize();
            if ways.len() < TARGETS_AROUND && ways.iter().all(|other| other.dot(&unit) < SAME_DIRECTION_COSINE) {
                ways.push(unit);
                let normal = lone.normal.lerp(&neighbour.normal, NEIGHBOUR_SHARE).normalize();
                around.push(project_onto_nominal(task, &Target { point: at + way * NEIGHBOUR_SHARE, normal }));
            }
        }
    }
    targets.extend(controls.iter().map(|&k| Target { point: places[k].0, normal: places[k].1 }));
    targets.append(&mut around);
    let direction = |k: usize| found.cmm_from_model.transform_direction(&places[k].1);
    let controls = controls.iter().map(|&k| ControlPoint { point_index: used[k], normal: direction(k) }).collect();
    let max_control_change_mm = (CONTROL_SIGMAS * 2f64.sqrt() * noise_sigma_mm).max(MIN_CHANGE_MM);
    Some(RepeatedTouches { outlier_points: alone, control_points: controls, max_control_change_mm, targets })
}

/// Returns a target at the projection of `near` onto the nominal surface, with the normal of `near`. If the surface
/// cannot be built, returns `near`.
fn project_onto_nominal(task: &Task, near: &Target) -> Target {
    match OffsetSurface::new(&task.nominal, 0.0, Side::Normal) {
        Ok(surface) => {
            let foot = surface.project(&near.point, FacetIndex::UNKNOWN);
            Target { point: near.point - foot.normal * foot.distance_mm, normal: near.normal }
        }
        Err(_) => *near,
    }
}

fn reason_message(reason: Reason) -> &'static str {
    match reason {
        Reason::WithinLimits => "the part is in tolerance",
        Reason::FormKnown => "the form is known well enough for a correction",
        Reason::CorrectionPreferred => "another pass improves the part more than further touches do",
        Reason::AllTargetsTried => "every target was touched",
        Reason::TooFewTouches => "too few touches for a decision",
        Reason::LargeInnovations => "the last touches deviate from the prediction by more than expected",
        Reason::UnconfirmedOutlier => {
            "a touch is possibly an outlier, and too few touches are near this touch to confirm the outlier"
        }
        Reason::NarrowFeature => "the part has a narrow feature, so every target is touched",
        Reason::Undecided => "the touches do not yet show whether the part is in tolerance",
        Reason::FormUnknown => "the form is not known well enough for a correction",
        Reason::BeyondLimit => "the part is out of tolerance, and the recipe allows no further pass",
        Reason::MaxBatchesReached => {
            "the maximum number of touch batches is reached, so all remaining targets are touched"
        }
    }
}

/// Computes an error map (deviations in mm at the nodes of a grid) from the points at which the error model estimated
/// `form`. Returns `None` if these points do not determine a map.
pub(super) fn interpolate_form(task: &Task, form: &Form) -> Option<ErrorMap> {
    let of = |p: &model::FormPoint| {
        (DeviationSample { place_mm: p.place_mm, deviation_mm: p.form.mean_mm }, p.smooth_sigma_mm)
    };
    let told: Vec<_> = form.points.iter().map(of).collect();
    map_from_model(&told, &task.map_options, form.hyperparameters.noise_sigma_mm).ok()
}
