//! Builds what a run needs from a recipe and a cell file: the nominal surface, the targets, the limits, the settings of
//! the wires.
//!
//! Recipe and cell file are each checked separately. This module finds the errors that only the two together show.

mod cell_plan;
mod checks;
mod compensation;
mod drivers;
mod error;
mod grinding;
mod learning;
mod measurement;
mod nominal;

use std::sync::Arc;

use crate::cell::CellPlan;
use crate::config::CellConfig;
use crate::drive::Task;
use crate::recipe::{Micrometres, Recipe, RegistrationStart};
use crate::registration::MapLimits;
use cell_plan::{cell_plan, tolerance, transfer_timeout};
use checks::{check_limits, check_sphere};
use compensation::{correction_limits, locked_sigmas, map_options, parameter_compensation};
pub use drivers::{check_machine, create_cmm, create_drivers, create_grinder, modbus_settings, poll_interval};
pub use error::SetupError;
pub use grinding::{MAX_SCALLOP_SHARE, track_for_tolerance_mm};
use grinding::{pass, programs, surface_and_outline, track_distance};
use learning::{learning_kind, learning_setting};
use measurement::{adaptive, expansion, lay_targets, min_found_share, probing, reference_sphere};
use nominal::{IdentifiedNominal, nominal_with_identity};
pub use nominal::{defined_from_file, nominal_from_file, nominal_table_format, plan_table_format, read_nominal};

/// Size of one target in the registers of a plan, in bytes. A point of a result is smaller.
const MAX_TARGET_BYTES: usize = 56;

/// Returns the task and the cell plan of a run. The task contains the data and the options of the computations. The
/// cell plan contains the parameters by which the cell decides, such as limits and timeouts.
///
/// # Errors
/// Returns an error if the nominal surface or the measuring pattern cannot be read or computed, or if the recipe and
/// the cell do not fit together, for example because a value of the recipe exceeds a limit of the cell.
pub fn prepare(recipe: &Recipe, cell: &CellConfig) -> Result<(Task, CellPlan), SetupError> {
    let IdentifiedNominal { nominal, path, choice, identity: part_identity } = nominal_with_identity(recipe)?;
    let side = recipe.measure.side.side().unwrap_or_default();
    let targets = lay_targets(recipe, &nominal, side)?;
    check_limits(recipe, cell, &targets)?;
    let sphere = reference_sphere(recipe, cell)?;
    if let Some(sphere) = &sphere {
        check_sphere(recipe, cell, &nominal, sphere)?;
    }
    let ground = surface_and_outline(recipe, &nominal);
    let (track_mm, scallops) = track_distance(recipe, cell, &nominal, &ground)?;
    let parameters = parameter_compensation(recipe, cell, &ground, &nominal)?;
    let datum = locked_sigmas(recipe, &nominal);
    let kind = learning_kind(recipe, &part_identity, track_mm, targets.len());
    let programs = ground.map(|ground| programs(recipe, cell, &nominal, part_identity, (ground, track_mm)));
    if let Ok(programs) = &programs {
        let said = |source| SetupError::Dialect { recipe: recipe.path().into(), cell: cell.path().into(), source };
        programs.check_dialect().map_err(said)?;
    }
    let task = Task {
        part: recipe.part.name.clone(),
        pass: pass(recipe, &nominal, part_identity, track_mm),
        programs,
        scallops,
        nominal: Arc::new(nominal),
        nominal_path: path,
        nominal_choice: choice,
        part_identity,
        probing: probing(recipe),
        reference_sphere: sphere,
        fixture_cmm_from_model: cell.cmm.fixture_cmm_from_model,
        registration_options: recipe.registration_options(cell.cmm.fixture_cmm_from_model),
        start_at_fixture: recipe.registration.start == RegistrationStart::Fixture,
        expected_coordinates: cell.cmm.link.wire.coordinates(),
        parameter_compensation: parameters,
        locked_sigmas: datum,
        map_limits: MapLimits { max_lateral_mm: recipe.compensation.max_displacement_mm, ..MapLimits::default() },
        map_options: map_options(recipe),
        gain_rule: recipe.compensation.gain(),
        repeatability_mm: recipe.compensation.repeatability_um.map(Micrometres::mm),
        learned: None,
        setting: learning_setting(recipe, cell, &kind),
        kind,
        targets,
        correction_limits: correction_limits(recipe, cell),
        plot_tolerance_mm: recipe.acceptance.pv_um.map(|pv| 0.5 * pv.mm()),
        min_found_share: recipe.measure.min_coverage,
        temperature_range_c: recipe.measure.temperature_c,
        expansion: expansion(recipe, cell),
        machine_uncertainty: cell.cmm.uncertainty,
        tolerance: tolerance(recipe),
        adaptive: adaptive(recipe),
        simulation: cell.is_marked_simulation(),
        rehearsal: cell.rehearsal,
    };
    let mut plan = cell_plan(recipe, cell);
    plan.gates.min_found_share = min_found_share(recipe);
    let [map, targets] = [8 * task.first_correction().grid.len(), MAX_TARGET_BYTES * task.targets.len()];
    for (link, bytes) in [(&cell.grinder.link, map), (&cell.cmm.link, targets)] {
        plan.deadlines.transfer = plan.deadlines.transfer.max(transfer_timeout(link, bytes));
    }
    Ok((task, plan))
}
