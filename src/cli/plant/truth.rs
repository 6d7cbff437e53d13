//! True form of a simulated part, for the studies of a plant.

use std::path::Path;

use regrind::config::CellConfig;
use regrind::recipe::Recipe;
use regrind::registration::Coordinate;
use regrind_sim::world::World;

use super::super::failure::Failure;

/// Writes the true PV and RMS of the simulated part in `world`, in µm, to the JSON file `path`. The world computes them at
/// the targets (the planned measuring points). Nothing of the registration takes part, because the study judges it.
/// Returns an error if the file cannot be written.
pub(super) fn write_truth(world: &World, recipe: &Recipe, cell: &CellConfig, path: &Path) -> Result<(), Failure> {
    let (task, _) = regrind::setup::prepare(recipe, cell).map_err(Failure::Setup)?;
    let places: Vec<[f64; 2]> = task.targets.iter().map(|target| [target.point.x, target.point.y]).collect();
    let form = world.true_form(&places, Coordinate::locked_flags(&recipe.registration.lock));
    let [pv_um, rms_um] = [form.pv_mm, form.rms_mm].map(|mm| 1e3 * mm);
    let truth = serde_json::json!({ "pv_um": pv_um, "rms_um": rms_um });
    Ok(regrind::formats::write_json_atomic(path, &truth)?)
}
