//! Measurement of a part: its targets, the reference sphere, the thermal expansion and an adaptive selection.

use super::cell_plan::tolerance;
use super::error::SetupError;
use super::nominal::plan_table_format;
use crate::config::CellConfig;
use crate::drive::{AdaptiveOptions, Probing, ReferenceSphere};
use crate::formats;
use crate::measuring::{Layout, Target, ThermalExpansion, targets};
use crate::recipe::{MeasuringPattern, Recipe, SelectionMode};
use crate::surface::{Nominal, Side};

pub(super) fn lay_targets(recipe: &Recipe, nominal: &Nominal, side: Side) -> Result<Vec<Target>, SetupError> {
    let layout = match &recipe.pattern {
        MeasuringPattern::Generated(layout) => layout,
        MeasuringPattern::File { path, table } => {
            let table = plan_table_format(table).map_err(|(key, what)| SetupError::Table {
                path: recipe.path().to_owned(),
                key,
                what,
            })?;
            &Layout::Points(formats::read_plan(path, &table)?)
        }
        MeasuringPattern::Free { .. } => return Ok(Vec::new()),
    };
    targets(nominal, side, layout, recipe.measure.edge_margin_mm)
        .map_err(|source| SetupError::Pattern { path: recipe.path().to_owned(), source })
}

pub(super) fn probing(recipe: &Recipe) -> Probing {
    let measure = &recipe.measure;
    Probing {
        probe_radius_mm: measure.probe_radius_mm,
        approach_mm: measure.approach_mm,
        search_mm: measure.search_mm,
        speed_mm_s: measure.speed_mm_s,
        safe_height_mm: measure.safe_height_mm,
    }
}

pub(super) fn reference_sphere(recipe: &Recipe, cell: &CellConfig) -> Result<Option<ReferenceSphere>, SetupError> {
    match (recipe.measure.qualify, &cell.cmm.reference_sphere) {
        (false, _) => Ok(None),
        (true, Some(sphere)) => Ok(Some(ReferenceSphere {
            centre: sphere.centre,
            radius_mm: sphere.radius_mm,
            points: usize::from(sphere.points),
        })),
        (true, None) => Err(SetupError::NoSphere { recipe: recipe.path().to_owned(), cell: cell.path().to_owned() }),
    }
}

/// Returns the thermal expansion coefficients, in 1/K, of the part and of the scales of the CMM. The result also
/// contains two standard uncertainties: that of the part's coefficient in 1/K, and that of the temperature in K. If the
/// recipe does not state the uncertainty of the part's coefficient, the uncertainty is 10 % of the coefficient. Returns
/// `None` if the recipe does not state the coefficient of the part.
pub(super) fn expansion(recipe: &Recipe, cell: &CellConfig) -> Option<ThermalExpansion> {
    const MILLIONTH: f64 = 1e-6;
    let of_part = recipe.part.expansion_um_m_k?;
    let uncertainty = recipe.part.expansion_uncertainty_um_m_k.unwrap_or(0.1 * of_part.abs());
    Some(ThermalExpansion {
        part_per_k: MILLIONTH * of_part,
        part_sigma_per_k: MILLIONTH * uncertainty,
        scales_per_k: MILLIONTH * cell.cmm.scale_expansion_um_m_k,
        temperature_sigma_k: cell.cmm.temperature_uncertainty_k,
    })
}

/// Returns the options of an adaptive measurement: the tolerance, the accepted risk, and the maximum number of cycles.
/// The accepted risk is the probability of accepting a part that is out of tolerance. Returns `None` if the measuring
/// mode of the recipe is not adaptive, or if the recipe does not state `accepted_risk`.
pub(super) fn adaptive(recipe: &Recipe) -> Option<AdaptiveOptions> {
    let accepted_risk = recipe.measure.accepted_risk.filter(|_| recipe.measure.mode == SelectionMode::Adaptive)?;
    Some(AdaptiveOptions {
        tolerance: tolerance(recipe),
        accepted_risk,
        max_measurements: recipe.cycle.begin_with.max_cycle_number(u32::from(recipe.cycle.max_cycles)),
    })
}

/// Returns the minimum share (0 to 1) of the planned targets at which the probe must find a point. The share is
/// `min_coverage` of the recipe. For an adaptive measurement, `min_coverage` is multiplied by
/// [`AdaptiveOptions::FIRST_BATCH_MIN_SHARE`]. Thus one touch of the first batch can miss the part.
pub(super) fn min_found_share(recipe: &Recipe) -> f64 {
    // One of the first touches can miss. The task checks the share of all touches.
    let share =
        if recipe.measure.mode == SelectionMode::Adaptive { AdaptiveOptions::FIRST_BATCH_MIN_SHARE } else { 1.0 };
    share * recipe.measure.min_coverage
}
