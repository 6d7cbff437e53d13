//! Compensation of a part: the options of its map and the parameters of the machine.

use super::error::SetupError;
use super::grinding::{SurfaceAndOutline, pass};
use crate::compensation::path::PathError;
use crate::compensation::{CorrectionLimits, MapOptions, SurfacePoint, WheelTerm, contact_width_mm};
use crate::config::CellConfig;
use crate::device::Pass;
use crate::drive::{ParameterCompensation, correction_grid};
use crate::recipe::Recipe;
use crate::surface::Nominal;

/// Returns the limits of a correction in mm: those of the recipe, and the maximum depth of the grinder.
pub(super) fn correction_limits(recipe: &Recipe, cell: &CellConfig) -> CorrectionLimits {
    let compensation = &recipe.compensation;
    CorrectionLimits {
        max_depth_mm: cell.grinder.limits.max_depth_mm,
        min_depth_mm: compensation.min_depth_um.mm(),
        depth_of_cut_mm: compensation.depth_of_cut_um.mm(),
        max_correction_mm: compensation.max_correction_um.mm(),
        allowance_mm: recipe.grinding.allowance_um.mm(),
        removal_budget_mm: compensation.removal_budget_um.mm(),
    }
}

pub(super) fn map_options(recipe: &Recipe) -> MapOptions {
    let (wheel_radius_mm, compensation) = (recipe.grinding.wheel.radius_mm(), &recipe.compensation);
    MapOptions {
        level_off_mm: wheel_radius_mm,
        contact_width_mm: contact_width_mm(wheel_radius_mm, compensation.depth_of_cut_um.mm()),
        smoothing: compensation.smoothing,
        order: compensation.filter_order,
        spline_smoothness: compensation.roughness,
        ..MapOptions::new(compensation.cutoff_mm, compensation.spacing_mm)
    }
}

/// Returns the settings for the compensation of machine parameters. These are the tolerances of the parameters, the
/// direction in which an error of the wheel radius acts on the surface (along the normal or in height), and a point of
/// the surface for each node of the correction grid. `ground` is the surface to grind with the outline of the part, or
/// the reason why no path can be planned. Returns `None` if the recipe does not compensate parameters.
///
/// # Errors
/// Returns an error if the recipe compensates parameters and `ground` is an error.
pub(super) fn parameter_compensation(
    recipe: &Recipe,
    cell: &CellConfig,
    ground: &Result<SurfaceAndOutline, PathError>,
    nominal: &Nominal,
) -> Result<Option<ParameterCompensation>, SetupError> {
    let Some(parameters) = &recipe.compensation.parameters else { return Ok(None) };
    let (field, _) = ground
        .as_ref()
        .map_err(|source| SetupError::Tracks { recipe: recipe.path().to_owned(), source: source.clone() })?;
    let Pass { x_mm, y_mm, .. } = pass(recipe, nominal, [0; 32], 1.0);
    let grid = correction_grid([x_mm, y_mm], recipe.compensation.spacing_mm);
    // A program moves the centre of the wheel along the normals. A grinder with its own path is guided in height.
    let is_program = cell.grinder.link.wire.reads_run_folder();
    let wheel_term = if is_program { WheelTerm::AlongNormal } else { WheelTerm::InHeight };
    Ok(Some(ParameterCompensation {
        tolerances: parameters.tolerances(),
        wheel_term,
        node_points: SurfacePoint::under_nodes(field, &grid),
    }))
}

/// Returns the standard uncertainties of the part's position (mm) and rotation (rad) in the fixture. The standard
/// uncertainty of the position is half of `lock_uncertainty_um` of the recipe, which is an expanded uncertainty (k =
/// 2). The standard uncertainty of the rotation is that of the position divided by half the larger extent of the part
/// in x or y. Returns `None` if the recipe does not state `lock_uncertainty_um`.
pub(super) fn locked_sigmas(recipe: &Recipe, nominal: &Nominal) -> Option<[f64; 2]> {
    let Pass { x_mm, y_mm, .. } = pass(recipe, nominal, [0; 32], 1.0);
    let half_mm = [x_mm, y_mm].map(|[low, high]| 0.5 * (high - low));
    let shift_mm = 0.5 * recipe.registration.lock_uncertainty_um?.mm();
    Some([shift_mm, shift_mm / half_mm[0].max(half_mm[1])])
}
