//! Adaptive measurement, in which the touches are chosen: evaluation after a batch, and choice of the next targets.

use super::task::{Adaptive, Again, ControlPoint, Cycle, Points, Task};
use crate::compensation::{ErrorMap, told_map};
use crate::device::BatchId;
use crate::geometry::{Sample, Vector};
use crate::measuring::Target;
use crate::model::{
    self, Form, MAX_BATCHES, MIN_TOUCHES, ModelInputs, PartialMeasurement, Reason, farthest_points, short_tour,
};
use crate::registration::{Deviation, PointStatus, Registration};
use crate::surface::{OffsetSurface, Place, Side};

// After the maximum number of batches follows one with all remaining targets. The batch numbers must be unique.
const _: () = assert!(MAX_BATCHES < BatchId::MAX_BATCHES - 1);

/// Result of an evaluation.
pub(super) struct Looked {
    /// Form over the whole pattern, or the reason why there is none.
    pub(super) form: Result<Form, String>,
    /// Next targets with the reason, or `None` if enough is known.
    pub(super) next: Option<(Vec<usize>, &'static str)>,
}

/// Evaluates the touches so far. After the first batch, which the gates check, asks for enough further targets that an
/// evaluation can decide.
pub(super) fn look(
    task: &Task,
    adaptive: &Adaptive,
    (number, cycle): (u32, &Cycle),
    points: &Points,
    (found, given): (&Registration, ModelInputs),
) -> Looked {
    let places = task.places();
    let mut tried = vec![None; places.len()];
    for (batch, targets) in (0..).zip(&points.tried) {
        targets.iter().for_each(|&target| tried[target] = Some(batch));
    }
    let open = |chosen: Vec<usize>| chosen.into_iter().filter(|&k| tried[k].is_none()).collect();
    let first: Vec<usize> = open(farthest_points(&places, MIN_TOUCHES));
    if points.tried.len() == 1 && !first.is_empty() {
        let why = "the part is at its expected place";
        return Looked { form: Err(why.to_owned()), next: Some((short_tour(&places, first), why)) };
    }
    let so_far = PartialMeasurement { targets: &places, tried: &tried, touched: &points.of };
    let purpose = adaptive.purpose(u32::from(cycle.correction.cycle) < adaptive.max_cycles);
    let given = ModelInputs { decision_risk: adaptive.look_risk(), acceptance_probability: adaptive.tolerance.probability, ..given };
    match model::decide(found, &given, &so_far, &purpose, u64::from(number)) {
        Ok(look) => {
            let next = (!look.next.is_empty()).then(|| (look.next, in_words(look.reason)));
            Looked { form: Ok(look.form), next }
        }
        // If no model can be fitted, touch every target.
        Err(error) => {
            let rest: Vec<usize> = open((0..places.len()).collect());
            let next = (!rest.is_empty()).then_some((rest, "no model fits these points"));
            Looked { form: Err(error.to_string()), next }
        }
    }
}

/// Returns the outliers and a few targets around each, to be touched again, with control points. Returns `None` if the
/// machine has no plan of this program, if there are no outliers, or if they are too many to be bad touches.
///
/// The targets around lie on the way to the nearest other touched points: if the probe can touch two points, it can
/// also reach the places between them. The control points are good touches as far apart as possible.
pub(super) fn again(task: &Task, found: &Registration, points: &Points, noise_sigma_mm: f64) -> Option<Again> {
    const MOST: usize = 20;
    const CONTROLS: usize = 6;
    /// Limit of the change of a control point, in standard deviations of the difference of two touches.
    const CONTROL_SIGMAS: f64 = 5.0;
    /// Change of a control point that is always allowed: the repeatability of a very good machine.
    const MIN_CHANGE_MM: f64 = 5e-5;
    const AROUND: usize = 4;
    /// Share of the way to the neighbour.
    const SHARE: f64 = 0.4;
    /// Cosine of the angle between two directions, above which a neighbour is in the same direction as another one.
    const SAME_WAY: f64 = 0.7;
    let alone: Vec<usize> = found.outliers().map(|(k, _)| k).collect();
    if task.targets.is_empty() || alone.is_empty() || alone.len() > MOST || points.rounds + 2 >= BatchId::MAX_BATCHES {
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
    let controls = farthest_points(&places, CONTROLS);
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
            if ways.len() < AROUND && ways.iter().all(|other| other.dot(&unit) < SAME_WAY) {
                ways.push(unit);
                let normal = lone.normal.lerp(&neighbour.normal, SHARE).normalize();
                around.push(on_nominal(task, &Target { point: at + way * SHARE, normal }));
            }
        }
    }
    targets.extend(controls.iter().map(|&k| Target { point: places[k].0, normal: places[k].1 }));
    targets.append(&mut around);
    let direction = |k: usize| found.cmm_from_model.transform_direction(&places[k].1);
    let controls = controls.iter().map(|&k| ControlPoint { point: used[k], normal: direction(k) }).collect();
    let max_control_change_mm = (CONTROL_SIGMAS * 2f64.sqrt() * noise_sigma_mm).max(MIN_CHANGE_MM);
    Some(Again { points: alone, controls, max_control_change_mm, targets })
}

/// Projects a target onto the nominal surface, along its normal.
fn on_nominal(task: &Task, near: &Target) -> Target {
    match OffsetSurface::new(&task.nominal, 0.0, Side::Normal) {
        Ok(surface) => {
            let foot = surface.project(&near.point, Place::UNKNOWN);
            Target { point: near.point - foot.normal * foot.distance_mm, normal: near.normal }
        }
        Err(_) => *near,
    }
}

fn in_words(why: Reason) -> &'static str {
    match why {
        Reason::WithinLimits => "the part is in tolerance",
        Reason::FormKnown => "the form is known well enough for a correction",
        Reason::CorrectionPreferred => "another pass improves more than further touches",
        Reason::AllTargetsTried => "every target was touched",
        Reason::TooFewTouches => "too few touches for a decision",
        Reason::LargeInnovations => "the last touches deviate from the prediction",
        Reason::UnconfirmedOutlier => "a touch is an outlier, and its surroundings are unknown",
        Reason::NarrowFeature => "the part has a narrow feature, so every target is touched",
        Reason::Undecided => "it is undecided whether the part is in tolerance",
        Reason::FormUnknown => "the form is not known well enough for a correction",
        Reason::BeyondLimit => "the part is out of tolerance, and no pass is left",
        Reason::MaxBatchesReached => "the limit of batches is reached, so all other targets are touched",
    }
}

/// Interpolates the form on the grid of the error map.
pub(super) fn map(task: &Task, form: &Form) -> Option<ErrorMap> {
    let of = |p: &model::FormPoint| (Sample { place_mm: p.place_mm, deviation_mm: p.form.mean_mm }, p.smooth_sigma_mm);
    let told: Vec<_> = form.points.iter().map(of).collect();
    told_map(&told, &task.map, form.hyperparameters.noise_sigma_mm).ok()
}
