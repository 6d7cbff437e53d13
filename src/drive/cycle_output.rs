//! Output of a cycle on the part's error: figures, the map as text, X3P and picture, and the points in colours.

use std::time::SystemTime;

use serde_json::{Value, json};

use super::recorder::{ComputationError, OutputFiles, classify_error};
use super::task::{CycleState, Task, deviation_samples, used_deviations};
use crate::compensation::{
    self, ErrorMap, EstimatedParameter, ParameterCorrections, ParameterEstimation, ParameterKind, Smoothing,
    SurfacePoint,
};
use crate::form::{FormOptions, RemovedParts, compute_figures, slope};
use crate::formats::run_files::CycleFile;
use crate::formats::{
    ErrorMapOrigin, FormatError, write_error_map, write_error_map_x3p, write_figures, write_json_atomic,
};
use crate::journal::utc_to_the_second;
use crate::model::{AreaOptions, Form};
use crate::registration::{Deviation, Registration};
use crate::report::{HeatMap, ReportError, save_coloured_ply};

/// Length over which slopes are computed, as a share of the cut-off of the map's filter. The map has no shorter waves.
const SLOPE_LENGTH_SHARE: f64 = 0.5;

/// Writes the file `figures.json` with the form figures of a cycle. The figures are computed from the deviations of the
/// points that the registration `found` used. If they cannot be computed, the file states the reason. `map` is the
/// error map, from which slopes are computed, and `form` the form that the error model estimated. Both may be `None`.
pub(super) fn save_figures(
    task: &Task,
    files: &mut OutputFiles,
    map: Option<&ErrorMap>,
    found: &Registration,
    form: Option<&Form>,
) -> Result<(), FormatError> {
    let options = FormOptions { aperture: task.nominal.outline().cloned(), ..FormOptions::default() };
    let made = compute_figures(&deviation_samples(found), &options);
    // Slopes of the form and of the map are compared, so both use the same length. The places of the form determine it.
    let slope_length_mm = form.and_then(|form| form.slope).map(|slope| slope.integration_mm);
    let integration_mm = slope_length_mm.unwrap_or(SLOPE_LENGTH_SHARE * task.map_options.cutoff_mm);
    let slopes = map.map(|map| slope(&map.nodes, integration_mm));
    let slopes = slopes.as_ref().map(Result::as_ref);
    write_figures(
        &files.add_file(CycleFile::Figures),
        (made.as_ref(), slopes, form),
        &removed_components(task),
        task.simulation,
    )
}

/// Returns the options for figures of an area. They contain the centre of the part's outline in mm, or `None` if the
/// part has no outline. They also contain the length in mm over which slopes are computed: half the cut-off wavelength
/// of the map's filter.
pub(super) fn area_options(task: &Task) -> AreaOptions {
    let middle = |[low, high]: [[f64; 2]; 2]| std::array::from_fn(|k| 0.5 * (low[k] + high[k]));
    AreaOptions {
        middle_mm: task.nominal.outline().map(|outline| middle(outline.bounds())),
        integration_mm: Some(SLOPE_LENGTH_SHARE * task.map_options.cutoff_mm),
    }
}

/// Describes in words what the registration (rigid motion) and the filter (short waves) remove from the deviations.
fn removed_components(task: &Task) -> RemovedParts {
    let names = ["x", "y", "z", "rx", "ry", "rz"].into_iter().zip(task.registration_options.locked);
    let held: Vec<&str> = names.filter(|(_, held)| *held).map(|(name, _)| name).collect();
    let motion = match held.len() {
        0 => "rigid motion (registration)".to_owned(),
        6 => "nothing (every direction is locked)".to_owned(),
        _ => format!("rigid motion except {} (registration)", held.join(", ")),
    };
    let smoothing = match task.map_options.smoothing {
        Smoothing::Gaussian => "Gaussian, ISO 16610-61",
        Smoothing::RobustGaussian => "robust Gaussian, ISO 16610-71",
        Smoothing::Spline => "smoothing B-splines",
    };
    RemovedParts { motion, filter: format!("waves below {} mm ({smoothing})", task.map_options.cutoff_mm) }
}

/// Estimates the errors of machine parameters from the deviations of the measured points. The parameters are the radius
/// of the wheel, the position of the wheel in x, y and z, the tilt of the part in the grinder, and the wear of the
/// wheel. Writes the estimates to `parameters.json` and returns them. If they cannot be estimated, writes the reason to
/// this file and returns `None`.
///
/// `contacts` are the measured points with their normals and deviations. `cycle` contains the parameter corrections
/// with which the measured pass was ground.
///
/// # Errors
/// The file cannot be written.
pub(super) fn save_parameters(
    task: &Task,
    files: &mut OutputFiles,
    cycle: &CycleState,
    contacts: &[SurfacePoint],
) -> Result<Option<ParameterEstimation>, FormatError> {
    let path = files.add_file(CycleFile::Parameters);
    let options = task.parameter_options(cycle.correction.parameters.as_ref());
    match compensation::estimate_parameters(contacts, None, &options) {
        Ok(told) => write_json_atomic(path, &parameter_document(task, &told)).map(|()| Some(told)),
        Err(error) => {
            let document = json!({ "simulation": task.simulation, "why_not": error.to_string() });
            write_json_atomic(path, &document).map(|()| None)
        }
    }
}

/// Returns the points that the registration `found` used, each with its normal and its deviation in mm. The result is
/// the input for the estimation of machine parameters. Outliers and points off the part are omitted.
pub(super) fn surface_points(found: &Registration) -> Vec<SurfacePoint> {
    let contact = |d: &Deviation| SurfacePoint { point: d.point, normal: d.normal, deviation_mm: d.deviation_mm };
    used_deviations(found).map(contact).collect()
}

fn parameter_document(task: &Task, told: &ParameterEstimation) -> Value {
    let um = |mm: f64| 1e3 * mm;
    let parameter = |p: &EstimatedParameter| {
        let units = p.kind.display_units_per_unit();
        json!({
            "kind": p.kind, "unit": p.kind.unit(), "value": units * p.value, "expanded": 2.0 * units * p.sigma,
            "own_share": p.own_share, "alike": p.inseparable_from, "offered": p.is_offered, "taken": units * p.compensated, "beyond": p.exceeds_tolerance,
            "removes_rms_um": um(p.rms_reduction_mm), "words": p.message,
        })
    };
    json!({
        "simulation": task.simulation, "rms_um": um(told.rms_mm), "rest_rms_um": um(told.residual_rms_mm),
        "parameters": told.estimates.iter().map(parameter).collect::<Vec<_>>(),
    })
}

/// Returns the parameter corrections for the next pass: the corrections of the measured pass, plus the compensation
/// that the estimate `told` adds. `cycle` is the measured cycle, and `contacts` are its measured points. Returns `None`
/// if the recipe compensates no parameter, or if all corrections are 0.
pub(super) fn next_parameter_corrections(
    task: &Task,
    cycle: &CycleState,
    contacts: &[SurfacePoint],
    told: &ParameterEstimation,
) -> Option<ParameterCorrections> {
    let taken = task.parameter_compensation.as_ref()?;
    let before = cycle.correction.parameters.as_ref();
    let mut values = before.map_or([0.0; ParameterKind::COUNT], |set| set.values);
    values.iter_mut().zip(&told.estimates).for_each(|(value, of)| *value += of.compensated);
    if before.is_some_and(|before| before.values == values) {
        return before.cloned();
    }
    ParameterCorrections::from_values(
        values,
        cycle.correction.cycle + 1,
        [contacts, &taken.node_points],
        &task.parameter_options(before),
    )
}

/// Returns a function that finds the effect of the machine parameters in a map. The argument of this function is a map
/// in mm, with one value for each node of the correction's grid. The result is how much of each value, in mm at the
/// same node, errors of the machine parameters explain ([`compensation::explained_by_parameters`]).
///
/// `contacts` are the measured points, and `cycle` is the measured cycle. Returns `None` if the recipe compensates no
/// parameter.
pub(super) fn parameter_explainer<'t>(
    task: &'t Task,
    cycle: &'t CycleState,
    contacts: &'t [SurfacePoint],
) -> Option<impl Fn(&[f64]) -> Vec<f64> + use<'t>> {
    let taken = task.parameter_compensation.as_ref()?;
    let options = task.parameter_options(cycle.correction.parameters.as_ref());
    let grid = cycle.correction.grid;
    Some(move |values_mm: &[f64]| {
        compensation::explained_by_parameters(values_mm, &grid, [contacts, &taken.node_points], &options)
    })
}

/// Writes the error map `map` of cycle `number` as CSV, X3P, SVG and PNG files. Also writes the deviations of the
/// points that the registration `found` used as a coloured PLY file.
///
/// # Errors
/// Returns `NotSaved` if the operating system reports an error, and `Failed` for every other error.
pub(super) fn save_error_map(
    task: &Task,
    files: &mut OutputFiles,
    (number, cycle): (u32, &CycleState),
    map: &ErrorMap,
    found: &Registration,
) -> Result<(), ComputationError<String>> {
    let ground_with = (!cycle.correction.is_zero()).then(|| task.map_identity(&cycle.correction));
    let origin = ErrorMapOrigin { part: task.part_identity, cycle: number, ground_with };
    let date = utc_to_the_second(SystemTime::now());
    write_error_map(&files.add_file(CycleFile::ErrorMap), map, &origin, task.simulation)
        .and_then(|()| write_error_map_x3p(&files.add_file(CycleFile::ErrorMapX3p), map, &date, task.simulation))
        .map_err(classify_error)?;
    save_pictures(task, files, number, map).and_then(|()| save_deviations(task, files, found)).map_err(classify_error)
}

/// Writes the error map as pictures, on the scale of the report.
fn save_pictures(task: &Task, files: &mut OutputFiles, number: u32, map: &ErrorMap) -> Result<(), ReportError> {
    let samples: Vec<[f64; 3]> = map.nodes.samples_mm().collect();
    let identity = match files.serial() {
        "" => task.part.clone(),
        serial => format!("{}, serial {serial}", task.part),
    };
    let sign = "Red stands proud of the nominal surface, blue lies below it. The map is filtered.";
    let mut picture = HeatMap::of_lengths(&format!("Error of form, cycle {number}"), "deviation", &samples)?
        .of_nodes()
        .with_round_limit()
        .with_lines(vec![identity, sign.to_owned()])
        .with_simulation(task.simulation);
    if let Some(outline) = task.nominal.outline() {
        picture = picture.within(outline);
    }
    picture.save_svg(&files.add_file(CycleFile::ErrorMapSvg))?;
    picture.save_png(&files.add_file(CycleFile::ErrorMapPng))
}

fn save_deviations(task: &Task, files: &mut OutputFiles, found: &Registration) -> Result<(), ReportError> {
    let rows: Vec<[f64; 4]> =
        used_deviations(found).map(|d| [d.point.x, d.point.y, d.point.z, d.deviation_mm]).collect();
    let remarks: &[&str] = if task.simulation { &["SIMULATION", "frame: model"] } else { &["frame: model"] };
    save_coloured_ply(
        &files.add_file(CycleFile::ColouredDeviations),
        "Deviations",
        &rows,
        &[],
        task.plot_tolerance_mm,
        remarks,
    )
}
