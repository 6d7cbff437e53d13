//! True form of a simulated part, for the studies of a plant.

use std::path::Path;

use regrind::config::CellConfig;
use regrind::recipe::Recipe;
use regrind_sim::world::World;

use super::super::failure::Failure;

/// Writes the true PV and RMS of the simulated part in `world`, in µm, to the JSON file `path`. Takes the true deviations at
/// the targets (the planned measuring points), fits the pose to them, and computes PV and RMS from the residuals.
/// Returns an error if the fit fails or the file cannot be written.
pub(super) fn write_truth(world: &World, recipe: &Recipe, cell: &CellConfig, path: &Path) -> Result<(), Failure> {
    let (task, _) = regrind::setup::prepare(recipe, cell).map_err(Failure::Setup)?;
    let places: Vec<[f64; 2]> = task.targets.iter().map(|target| [target.point.x, target.point.y]).collect();
    let stands_mm = world.deviations_mm(&places);
    let level_mm = stands_mm.iter().sum::<f64>() / stands_mm.len().max(1) as f64;
    let points: Vec<_> = (task.targets.iter().zip(&stands_mm))
        .map(|(target, mm)| task.fixture_cmm_from_model.transform_point(&(target.point + *mm * target.normal)))
        .collect();
    let failed = |source| Failure::of_registration(source, recipe.path(), recipe.path());
    let (found, _) = task.register(&points, level_mm).map_err(failed)?;
    let [pv_um, rms_um] = [found.quality.pv_mm, found.quality.rms_mm].map(|mm| 1e3 * mm);
    let truth = serde_json::json!({ "pv_um": pv_um, "rms_um": rms_um });
    Ok(regrind::formats::write_json_atomic(path, &truth)?)
}
