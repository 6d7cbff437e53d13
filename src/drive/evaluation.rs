//! Evaluation of a measurement that passed its gate, in the order of the method: fit the pose, judge the fit, estimate
//! the form, map the error, update the model of the machine, state the figures.
//!
//! ```text
//!  points -> fit_pose -> estimate_form -> map_error -> update_model -> evaluated_figures
//!               |             |              |              |
//!     registration.json   form.csv      figures.json   parameters.json
//!     deviations.csv      model.json    error_map.*
//! ```

use std::borrow::Cow;
use std::path::Path;

use super::adaptive_measurement;
use super::cycle_output;
use super::pipeline::{cell_figures, part_response, update_learning, write_measured_points};
use super::recorder::{ComputationError, OutputFiles, classify_error};
use super::task::{
    ComputationProduct, CycleState, RegistrationProduct, RepeatedTouches, Task, UsablePoints, deviation_samples,
};
use crate::cell::{Event, Figures, FurtherTouches};
use crate::compensation::{
    self, ErrorMap, LearningState, ParameterCorrections, ParameterEstimation, SurfacePoint, error_map,
};
use crate::device::Coordinates;
use crate::formats::run_files::CycleFile;
use crate::formats::{FormatError, NominalInput, RegistrationDocument, save_form, save_registration};
use crate::geometry::Point;
use crate::model::{Form, ModelInputs, PartFit, Prior};
use crate::registration::{Registration, RegistrationOptions};

/// Registers the points of cycle `number`, computes the form figures and the error map, and writes these results to
/// `files`. `before` is the last judged cycle of an earlier pass. Returns the event for the cell and the results. If
/// the registration fails or cannot be saved, the event states the reason, and there are no results.
pub(super) fn register_cycle(
    task: &Task,
    files: &mut OutputFiles,
    number: u32,
    cycle: &CycleState,
    before: Option<&CycleState>,
) -> (Event, ComputationProduct) {
    match register_and_evaluate(task, files, number, cycle, before) {
        Ok(found) => {
            let event = Event::Registered { cycle: number, figures: found.figures.clone() };
            (event, ComputationProduct::Registered(Box::new(found)))
        }
        Err(ComputationError::Failed(reason)) => {
            (Event::RegistrationFailed { cycle: number, reason }, ComputationProduct::Nothing)
        }
        Err(ComputationError::NotSaved(reason)) => {
            (Event::NotSaved { cycle: number, reason }, ComputationProduct::Nothing)
        }
    }
}

fn register_and_evaluate(
    task: &Task,
    files: &mut OutputFiles,
    number: u32,
    cycle: &CycleState,
    before: Option<&CycleState>,
) -> Result<RegistrationProduct, ComputationError<String>> {
    let none = || ComputationError::Failed("this cycle has no points".to_owned());
    let points = cycle.points.as_ref().ok_or_else(none)?;
    let reference = ReferencePoints::new(task, cycle, points);
    let (found, options) = fit_pose(task, points, &reference)?;
    let estimate = estimate_form(task, (number, cycle, before), points, (&found, reference.scale_sigma));
    save_fit(task, files, points, (&found, &options), &estimate)?;
    let error = map_error(task, &found, &estimate);
    cycle_output::save_figures(task, files, error.as_ref(), &found, estimate.form.as_ref().ok())
        .map_err(classify_error)?;
    let contacts = cycle_output::surface_points(&found);
    let told = cycle_output::save_parameters(task, files, cycle, &contacts).map_err(classify_error)?;
    // Every measurement leaves its map, whatever happens to the correction.
    error.as_ref().map_or(Ok(()), |map| cycle_output::save_error_map(task, files, (number, cycle), map, &found))?;
    let model = update_model(task, (cycle, before), (&found, error.as_ref()), told, &contacts);
    let mut figures = evaluated_figures(task, cycle, (&found, error.as_ref()), &estimate, &model);
    let repeated_touches = touches_to_repeat(task, points, &found, &estimate, &mut figures);
    let FormEstimate { form, next, .. } = estimate;
    let next_targets = next.map(|(next, _)| next);
    let field_hyperparameters =
        next_targets.is_none().then(|| form.as_ref().ok()?.hyperparameters_without_prior).flatten();
    Ok(RegistrationProduct {
        registration: found,
        form: form.ok(),
        field_hyperparameters,
        error_map: error,
        learning: model.learning,
        parameters: model.parameters,
        parameter_corrections: model.parameter_corrections,
        figures,
        next_targets,
        repeated_touches,
    })
}

/// Points of a measurement at the reference temperature, and the ball that touched them.
struct ReferencePoints<'a> {
    part: Cow<'a, [Point]>,
    /// Distance of the points from the nominal surface: the radius of the ball plus the level of the target surface.
    offset_mm: f64,
    /// Relative standard uncertainty of lengths from the temperature.
    scale_sigma: f64,
}

impl<'a> ReferencePoints<'a> {
    fn new(task: &Task, cycle: &CycleState, points: &'a UsablePoints) -> Self {
        // The target surface of this pass is above the nominal one by its level, and the ball rolls on it.
        let radius_mm = points.probe_radius_mm.unwrap_or(task.probing.probe_radius_mm);
        let ball_mm = if points.coordinates == Coordinates::Contacts { 0.0 } else { radius_mm };
        let (ball_mm, part, scale_sigma) = match task.expansion.as_ref().zip(points.temperature_c) {
            Some((expansion, told_c)) => {
                let part = Cow::Owned(expansion.at_reference(&points.part, told_c));
                (ball_mm / expansion.length_factor(told_c), part, expansion.length_factor_sigma(told_c))
            }
            None => (ball_mm, Cow::Borrowed(&points.part[..]), 0.0),
        };
        Self { part, offset_mm: (ball_mm + cycle.correction.level_mm).max(0.0), scale_sigma }
    }
}

/// Registers the points to the nominal surface. Returns an error if no pose fits, or if the fit cannot be judged.
fn fit_pose(
    task: &Task,
    points: &UsablePoints,
    reference: &ReferencePoints<'_>,
) -> Result<(Registration, RegistrationOptions), ComputationError<String>> {
    // The first few touches show only if the right part is in the right place. A search on them would be a guess.
    let at_fixture = task.start_at_fixture || points.tried_targets.len() == 1;
    let (mut found, options) =
        task.register_with_start(&reference.part, reference.offset_mm, at_fixture).map_err(classify_error)?;
    if let Some(reason) = found.unjudgeable_reason() {
        return Err(ComputationError::Failed(reason));
    }
    found.add_radius_uncertainty(points.probe_radius_sigma_mm.hypot(task.machine_uncertainty.reference_sphere_mm));
    Ok((found, options))
}

/// Estimate of the form of the part.
struct FormEstimate {
    /// Form, or the reason why there is none.
    form: Result<Form, String>,
    /// Next targets to touch with the reason; `None` if enough is known.
    next: Option<(Vec<usize>, &'static str)>,
    /// True if the touches were chosen: the form is then that of the whole pattern.
    is_adaptive: bool,
}

/// Estimates the form of the part from the registration `found`. If the measurement is adaptive, also decides whether
/// further targets are touched. `scale_sigma` is the relative standard uncertainty of lengths.
fn estimate_form(
    task: &Task,
    (number, cycle, before): (u32, &CycleState, Option<&CycleState>),
    points: &UsablePoints,
    (found, scale_sigma): (&Registration, f64),
) -> FormEstimate {
    let given = ModelInputs {
        machine: task.machine_uncertainty,
        prior: field_prior(task, cycle, before),
        radius_sigma_mm: points.probe_radius_sigma_mm,
        scale_sigma,
        locked_sigmas: task.locked_direction_sigmas(),
        is_corrected: !cycle.correction.is_zero(),
        probe_noise_mm: points.probe_noise_mm,
        area: cycle_output::area_options(task),
        ..ModelInputs::default()
    };
    match task.adaptive.as_ref().filter(|_| !points.tried_targets.is_empty()) {
        Some(adaptive) => {
            let adaptive_measurement::TouchEvaluation { form, next } =
                adaptive_measurement::evaluate_touches(task, adaptive, (number, cycle), points, (found, given));
            FormEstimate { form, next, is_adaptive: true }
        }
        None => {
            let form = Form::estimate(found, &given).map_err(|error| error.to_string());
            FormEstimate { form, next: None, is_adaptive: false }
        }
    }
}

/// Writes the registration and the form to `files`. If an adaptive measurement is complete, its files go to the folder
/// of the cycle, and all its points are written there too.
fn save_fit(
    task: &Task,
    files: &mut OutputFiles,
    points: &UsablePoints,
    (found, options): (&Registration, &RegistrationOptions),
    estimate: &FormEstimate,
) -> Result<(), ComputationError<String>> {
    if estimate.is_adaptive && estimate.next.is_none() {
        files
            .switch_to_final_subfolder()
            .and_then(|()| write_measured_points(task, files, points))
            .map_err(classify_error)?;
    }
    write_registration(task, files, found, options).map_err(classify_error)?;
    if let Ok(form) = &estimate.form {
        for file in [CycleFile::Form, CycleFile::Model] {
            files.add_file(file);
        }
        save_form(&files.folder(), form, found, Some(task.simulation)).map_err(classify_error)?;
    }
    Ok(())
}

/// Returns the map of the error of the part; `None` if there is none. If touches were chosen, the map is the estimated
/// form between them. Otherwise it is the filtered deviations.
fn map_error(task: &Task, found: &Registration, estimate: &FormEstimate) -> Option<ErrorMap> {
    match &estimate.form {
        Ok(form) if estimate.is_adaptive => adaptive_measurement::interpolate_form(task, form),
        Err(_) if estimate.is_adaptive => None,
        _ => error_map(&deviation_samples(found), &task.map_options).ok(),
    }
}

/// State of what the run knows of its machine after a measured pass.
struct PassModel {
    /// Response of the part to the correction, if it was estimated.
    response: Option<compensation::Response>,
    /// Parameters of the machine, if this is the first pass of the run.
    parameters: Option<ParameterEstimation>,
    parameter_corrections: Option<ParameterCorrections>,
    learning: Option<LearningState>,
}

/// Updates the model of the machine by the registration and the error map of a pass. `told` are the parameters of the
/// machine that were estimated from `contacts`, the measured points.
fn update_model(
    task: &Task,
    (cycle, before): (&CycleState, Option<&CycleState>),
    (found, error): (&Registration, Option<&ErrorMap>),
    told: Option<ParameterEstimation>,
    contacts: &[SurfacePoint],
) -> PassModel {
    let response = error.and_then(|error| part_response(before?, cycle, found, error));
    // Only the first pass of a run reveals parameters of the machine. Later changes are wear and drift, which the
    // learning covers.
    let parameters = told.filter(|_| before.is_none());
    let parameter_corrections = match &parameters {
        Some(told) => cycle_output::next_parameter_corrections(task, cycle, contacts, told),
        None => cycle.correction.parameters.clone(),
    };
    let learning = error.map(|error| update_learning(task, cycle, before, error, (response, contacts)));
    PassModel { response, parameters, parameter_corrections, learning }
}

/// Returns the figures of a measurement for the cell, with the warnings of the map, the model and the form.
fn evaluated_figures(
    task: &Task,
    cycle: &CycleState,
    (found, error): (&Registration, Option<&ErrorMap>),
    estimate: &FormEstimate,
    model: &PassModel,
) -> Figures {
    let FormEstimate { form, next, .. } = estimate;
    let forecast =
        model.learning.as_ref().zip(error).map(|(known, error)| known.forecast(error, task.scallops_rms_mm()));
    let mut figures = cell_figures(task, cycle, found, form.as_ref().ok(), error, model.response, forecast);
    let offered = model.parameters.iter().flat_map(offered_messages);
    figures.warnings.extend(error.iter().flat_map(|map| map.advice.iter().cloned()).chain(offered));
    if task.expansion.is_some() && cycle.points.as_ref().is_none_or(|points| points.temperature_c.is_none()) {
        let message = "the measurement has no temperature, so the thermal expansion of the part is not compensated (part.expansion_um_m_k)";
        figures.warnings.push(message.to_owned());
    }
    if let (None, Err(error)) = (next, form) {
        figures.warnings.push(format!(
            "the form error of the part and the noise of the probe cannot be separated, so the stated uncertainty is too small: {error}"
        ));
    }
    figures.further_touches = next.as_ref().map(|(next, reason)| {
        Box::new(FurtherTouches { target_count: next.len() as u32, reason: (*reason).to_owned() })
    });
    if next.is_some() && form.is_err() {
        // The first few touches have six motions fitted: their residuals say nothing about the form.
        figures.form = None;
    }
    figures
}

/// Returns the touches that can be repeated because outliers decide the result. Before a person is called, the machine
/// checks these touches: `figures` gets the order to repeat them.
fn touches_to_repeat(
    task: &Task,
    points: &UsablePoints,
    found: &Registration,
    estimate: &FormEstimate,
    figures: &mut Figures,
) -> Option<RepeatedTouches> {
    // Without a model, the residuals of the fit bound the noise from above.
    let noise_sigma_mm =
        estimate.form.as_ref().map_or(found.quality.residual_sigma_mm, |form| form.hyperparameters.noise_sigma_mm);
    let again = match estimate.is_adaptive {
        true => None,
        false => adaptive_measurement::plan_repeated_touches(task, found, points, noise_sigma_mm),
    };
    if let Some(left_out) = figures.with_outliers.as_mut() {
        left_out.can_repeat = again.is_some();
    }
    let again = again.filter(|_| task.tolerance.outliers_decide(figures));
    if let Some(again) = again.as_ref().filter(|_| points.repeat_rounds == 0) {
        let targets = again.targets.len() as u32;
        let reason =
            "a touch is an outlier, so this touch is repeated, with a few touches near the same place".to_owned();
        figures.further_touches = Some(Box::new(FurtherTouches { target_count: targets, reason }));
    }
    again
}

/// Returns one message for people for each machine parameter, such as the wheel radius, whose error should be corrected
/// at its cause. A parameter is included if its effect differs from all other effects in the fit, and if its estimated
/// error is larger than the expanded uncertainty of this estimate.
fn offered_messages(told: &compensation::ParameterEstimation) -> impl Iterator<Item = String> {
    told.estimates.iter().filter(|p| p.is_offered).map(|p| p.message.clone())
}

/// Returns the prior of the error model for a cycle. A pass with a correction and a pass without one have different
/// priors. The prior learned from earlier parts is preferred. Without one, the prior comes from the cycle `before`, if
/// its pass is of the same kind. Returns `None` if neither gives a prior.
fn field_prior(task: &Task, cycle: &CycleState, before: Option<&CycleState>) -> Option<Prior> {
    let is_corrected = !cycle.correction.is_zero();
    let taught = task.learned.as_ref().and_then(|learned| learned.fields.fit(is_corrected));
    let alike = before.filter(|before| before.correction.is_zero() != is_corrected);
    let of_this_part = || Some(PartFit::updated(None, &alike?.field_hyperparameters?));
    taught.or_else(of_this_part).map(|lesson| lesson.prior())
}

fn write_registration(
    task: &Task,
    files: &mut OutputFiles,
    found: &Registration,
    options: &RegistrationOptions,
) -> Result<(), FormatError> {
    let choice = task.nominal_choice.iter().map(|choice| format!("{choice}; ")).collect::<String>();
    let kind = format!("{choice}{}", task.nominal.kind());
    let nominal = NominalInput { file: &task.nominal_path, points: task.nominal.len(), kind };
    let mut document = RegistrationDocument::new(found, options, nominal, Path::new(CycleFile::Measured.name()));
    document.simulation = Some(task.simulation);
    for file in [CycleFile::Deviations, CycleFile::DeviationUncertainty, CycleFile::Registration] {
        files.add_file(file);
    }
    save_registration(&files.folder(), &document, &found.deviations)
}
