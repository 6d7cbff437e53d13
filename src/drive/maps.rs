//! Output of a cycle on the part's error: figures, the map as text, X3P and picture, and the points in colours.

use std::time::SystemTime;

use serde_json::{Value, json};

use super::record::{Files, Unfinished, unfinished};
use super::task::{Cycle, Task, readings, used};
use crate::compensation::{self, Contact, ErrorMap, Parameter, ParameterKind, Parameters, Set, Smoothing};
use crate::form::{FormOptions, TakenOut, figures, slope};
use crate::formats::{
    ErrorMapOrigin, FormatError, write_error_map, write_error_map_x3p, write_figures, write_json_atomic,
};
use crate::journal::utc_to_the_second;
use crate::model::{AreaOptions, Form};
use crate::registration::{Deviation, Registration};
use crate::report::{HeatMap, ReportError, save_coloured_ply};

/// Length over which slopes are computed, as a share of the cut-off of the map's filter. The map has no shorter waves.
const INTEGRATION: f64 = 0.5;

/// Writes the figures of a cycle. If there are none, the file gives the reason.
pub(super) fn save_figures(
    task: &Task,
    files: &mut Files,
    map: Option<&ErrorMap>,
    found: &Registration,
    form: Option<&Form>,
) -> Result<(), FormatError> {
    let options = FormOptions { aperture: task.nominal.outline().cloned(), ..FormOptions::default() };
    let made = figures(&readings(found), &options);
    // Slopes of the form and of the map are compared, so both use the same length. The places of the form determine it.
    let slope_length_mm = form.and_then(|form| form.slope).map(|slope| slope.integration_mm);
    let integration_mm = slope_length_mm.unwrap_or(INTEGRATION * task.map.cutoff_mm);
    let slopes = map.map(|map| slope(&map.grid, &map.values_mm, &map.valid, integration_mm));
    let slopes = slopes.as_ref().map(Result::as_ref);
    write_figures(&files.place("figures.json"), (made.as_ref(), slopes, form), &taken_out(task), task.simulation)
}

/// Returns the options for the figures of an area: the middle of the aperture, and the length over which slopes are
/// computed.
pub(super) fn area(task: &Task) -> AreaOptions {
    let middle = |[low, high]: [[f64; 2]; 2]| std::array::from_fn(|k| 0.5 * (low[k] + high[k]));
    AreaOptions {
        middle_mm: task.nominal.outline().map(|outline| middle(outline.bounds())),
        integration_mm: Some(INTEGRATION * task.map.cutoff_mm),
    }
}

/// Returns in words what registration and filter remove from the deviations.
fn taken_out(task: &Task) -> TakenOut {
    let names = ["x", "y", "z", "rx", "ry", "rz"].into_iter().zip(task.registration.locked);
    let held: Vec<&str> = names.filter(|(_, held)| *held).map(|(name, _)| name).collect();
    let motion = match held.len() {
        0 => "rigid motion (registration)".to_owned(),
        6 => "nothing (every direction is locked)".to_owned(),
        _ => format!("rigid motion except {} (registration)", held.join(", ")),
    };
    let smoothing = match task.map.smoothing {
        Smoothing::Gaussian => "Gaussian, ISO 16610-61",
        Smoothing::RobustGaussian => "robust Gaussian, ISO 16610-71",
        Smoothing::Spline => "smoothing B-splines",
    };
    TakenOut { motion, filter: format!("waves below {} mm ({smoothing})", task.map.cutoff_mm) }
}

/// Separates the part of the deviations that parameters of the machine explain: radius and setting of the wheel, tilt
/// of the part, wear. An offered parameter is better corrected in the machine than ground with every map.
pub(super) fn parameters(
    task: &Task,
    files: &mut Files,
    cycle: &Cycle,
    contacts: &[Contact],
) -> Result<Option<Parameters>, FormatError> {
    let path = files.place("parameters.json");
    let options = task.parameter_options(cycle.correction.set.as_ref());
    match compensation::parameters(contacts, None, &options) {
        Ok(told) => write_json_atomic(path, &document(task, &told)).map(|()| Some(told)),
        Err(error) => {
            let document = json!({ "simulation": task.simulation, "why_not": error.to_string() });
            write_json_atomic(path, &document).map(|()| None)
        }
    }
}

/// Returns the points used in a registration, as the separation of parameters needs them.
pub(super) fn contacts(found: &Registration) -> Vec<Contact> {
    let contact = |d: &Deviation| Contact { point: d.point, normal: d.normal, deviation_mm: d.deviation_mm };
    used(found).map(contact).collect()
}

fn document(task: &Task, told: &Parameters) -> Value {
    let um = |mm: f64| 1e3 * mm;
    let parameter = |p: &Parameter| {
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

/// Returns the parameter corrections of the next pass: those of this pass plus those now compensated.
pub(super) fn set(task: &Task, cycle: &Cycle, contacts: &[Contact], told: &Parameters) -> Option<Set> {
    let taken = task.parameters.as_ref()?;
    let before = cycle.correction.set.as_ref();
    let mut values = before.map_or([0.0; ParameterKind::COUNT], |set| set.values);
    values.iter_mut().zip(&told.estimates).for_each(|(value, of)| *value += of.compensated);
    if before.is_some_and(|before| before.values == values) {
        return before.cloned();
    }
    Set::from_values(values, cycle.correction.cycle + 1, [contacts, &taken.nodes], &task.parameter_options(before))
}

/// Returns a function that extracts, from values at the nodes of the correction, the part that parameters and slides
/// explain. Returns `None` if no parameter is compensated.
pub(super) fn smoother<'t>(
    task: &'t Task,
    cycle: &'t Cycle,
    contacts: &'t [Contact],
) -> Option<impl Fn(&[f64]) -> Vec<f64> + use<'t>> {
    let taken = task.parameters.as_ref()?;
    let options = task.parameter_options(cycle.correction.set.as_ref());
    let grid = cycle.correction.grid;
    Some(move |values_mm: &[f64]| compensation::smooth_of(values_mm, &grid, [contacts, &taken.nodes], &options))
}

/// Writes the error map of a cycle and the points from which it was computed.
pub(super) fn save(
    task: &Task,
    files: &mut Files,
    (number, cycle): (u32, &Cycle),
    map: &ErrorMap,
    found: &Registration,
) -> Result<(), Unfinished<String>> {
    let ground_with = (!cycle.correction.is_zero()).then(|| task.map_identity(&cycle.correction));
    let origin = ErrorMapOrigin { part: task.part_identity, cycle: number, ground_with };
    let date = utc_to_the_second(SystemTime::now());
    write_error_map(&files.place("error_map.csv"), map, &origin, task.simulation)
        .and_then(|()| write_error_map_x3p(&files.place("error_map.x3p"), map, &date, task.simulation))
        .map_err(unfinished)?;
    save_pictures(task, files, map).and_then(|()| save_points(task, files, found)).map_err(unfinished)
}

fn save_pictures(task: &Task, files: &mut Files, map: &ErrorMap) -> Result<(), ReportError> {
    let title =
        if task.simulation { "Error of the part, filtered (SIMULATION)" } else { "Error of the part, filtered" };
    let mut picture = HeatMap::of_lengths(title, "deviation", &map.samples_mm())?.of_nodes();
    if let Some(outline) = task.nominal.outline() {
        picture = picture.within(outline);
    }
    if let Some(tolerance_mm) = task.tolerance_mm {
        picture = picture.with_tolerance(tolerance_mm)?;
    }
    picture.save_svg(&files.place("error_map.svg"))?;
    let pixels = files.place("error_map.png");
    if task.simulation { picture.save_simulated_png(&pixels) } else { picture.save_png(&pixels) }
}

fn save_points(task: &Task, files: &mut Files, found: &Registration) -> Result<(), ReportError> {
    let rows: Vec<[f64; 4]> = used(found).map(|d| [d.point.x, d.point.y, d.point.z, d.deviation_mm]).collect();
    let remarks: &[&str] = if task.simulation { &["SIMULATION", "frame: model"] } else { &["frame: model"] };
    save_coloured_ply(&files.place("deviations.ply"), "Deviations", &rows, &[], task.tolerance_mm, remarks)
}
