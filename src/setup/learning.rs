//! Texts that identify the settings under which a run may start from the results of an earlier run.

use std::fmt::Write as _;

use crate::config::CellConfig;
use crate::device::hex;
use crate::recipe::{Recipe, Tilt};
use crate::registration::Coordinate;

/// Returns a text that identifies all settings that affect the errors of a pass. The text consists of the name of the
/// cell and of `kind`, the text from [`learning_kind`]. In a simulated cell, the settings of the simulation are added.
/// A run can start from the results of an earlier run only if this text is the same for both runs.
pub(super) fn learning_setting(recipe: &Recipe, cell: &CellConfig, kind: &str) -> String {
    let mut said = format!("cell {:?}, {kind}", cell.name);
    // Another simulated world counts as another grinder.
    if let Some(world) = recipe.simulation.as_ref().filter(|_| cell.simulated) {
        let _ = write!(said, "; simulation {}", serde_json::json!(world));
    }
    said
}

/// Returns a text that identifies the settings that affect the errors of a pass, except the cell. These are the part
/// and the settings of grinding, measuring and compensation. A run can start from the results of a run in another cell
/// only if this text is the same for both runs.
///
/// `part` is the SHA-256 that identifies the nominal surface, `track_mm` the distance between the tracks of the wheel,
/// and `targets` the number of points to measure.
pub(super) fn learning_kind(recipe: &Recipe, part: &[u8; 32], track_mm: f64, targets: usize) -> String {
    let part = hex(part);
    let (grinding, measure, map) = (&recipe.grinding, &recipe.measure, &recipe.compensation);
    let mut said = format!(
        "part {part}, begin with {:?}; {:?}, feed {} mm/min, tracks {track_mm} mm, spark-out {}, depth {} mm; {targets} targets, probe {} mm, \
         held {:?}; cut-off {} mm, {:?}, gain {:?}",
        recipe.cycle.begin_with,
        grinding.wheel,
        grinding.feed_mm_min,
        grinding.spark_out_passes,
        map.depth_of_cut_um.mm(),
        measure.probe_radius_mm,
        Coordinate::locked_flags(&recipe.registration.lock),
        map.cutoff_mm,
        map.smoothing,
        map.gain()
    );
    if let Some(Tilt { lean, angle_deg }) = grinding.tilt {
        let _ = write!(said, "; tilt {lean:?} by {angle_deg} degrees");
    }
    // Default values are omitted, so that results learned before these keys existed stay valid.
    if (map.filter_order, map.roughness) != Default::default() {
        let _ = write!(said, "; order {:?}, {:?}", map.filter_order, map.roughness);
    }
    said
}
