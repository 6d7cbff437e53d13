//! Part small enough to be ground, measured and registered in some milliseconds: the shipped free-form mirror, on a
//! coarse grid.

use std::path::Path;
use std::sync::OnceLock;
use std::time::Duration;

use regrind::cell::CellPlan;
use regrind::config::CellConfig;
use regrind::drive::Task;
use regrind::recipe::Recipe;
use regrind::setup;
use regrind_testcell::rig::changed;

pub struct Setting {
    pub recipe: Recipe,
    pub cell: CellConfig,
}

/// Required quality of a part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RequiredQuality {
    /// Quality that a part reaches after two or three cycles.
    Good,
    /// Quality that a part never reaches: the run uses all five cycles.
    Perfect,
}

/// Returns recipe and cell, which differ only in the required quality.
pub fn setting(wanted: RequiredQuality) -> &'static Setting {
    static SETTINGS: [OnceLock<Setting>; 2] = [OnceLock::new(), OnceLock::new()];
    SETTINGS[wanted as usize].get_or_init(|| {
        let [pv_um, rms_um] = match wanted {
            RequiredQuality::Good => ["pv_um = 12.0", "rms_um = 2.0"],
            RequiredQuality::Perfect => ["pv_um = 0.1", "rms_um = 0.01"],
        };
        let text = changed(
            "recipes/freeform-mirror.toml",
            &[
                ("accuracy_nm = 0.5", "spacing_mm = 3.0"),
                ("columns = 60", "columns = 9"),
                ("rows = 30", "rows = 6"),
                ("cutoff_mm = 5.0", "cutoff_mm = 10.0"),
                ("width_mm = 102.0", "width_mm = 32.0"),
                ("height_mm = 62.0", "height_mm = 22.0"),
                ("half_x_mm = 51.0", "half_x_mm = 16.0"),
                ("half_y_mm = 31.0", "half_y_mm = 11.0"),
                ("spacing_mm = 1.0", "spacing_mm = 2.0"),
                ("track_mm = 0.24", "track_mm = 6.0\nchord_error_um = 10.0"),
                ("start = \"search\"", "start = \"fixture\"\nlock = [\"x\", \"y\", \"rz\"]"),
                ("pv_um = 7.0", pv_um),
                ("rms_um = 1.0", rms_um),
                ("on_stall = \"stop\"", "on_stall = \"hold\""),
                // Each of these fields of random waves is drawn again in every pass. Only the repeatable error of the
                // grinder remains.
                ("form_error_um = 20.0", "form_error_um = 0.0"),
                (
                    "[simulation.part]",
                    "[simulation.grinder]\nscallops = false\nwaviness_um = 0.0\nrepeatability_um = 0.0\n\n[simulation.part]",
                ),
            ],
        );
        let recipe = Recipe::parse(Path::new("recipes/part.toml"), &text).unwrap_or_else(|p| panic!("{p:?}"));
        let text = changed("config/modbus-tcp.toml", &[("points = 25", "points = 8")]);
        let cell = CellConfig::parse(Path::new("cell.toml"), &text).unwrap_or_else(|p| panic!("{p:?}"));
        Setting { recipe, cell }
    })
}

/// Returns the inputs of a run's computations and of its cell's decisions.
pub fn task(wanted: RequiredQuality) -> (Task, CellPlan) {
    let Setting { recipe, cell } = setting(wanted);
    setup::prepare(recipe, cell).unwrap()
}

/// Returns the interval between two polls of each machine.
pub fn poll() -> [Duration; 2] {
    let cell = &setting(RequiredQuality::Good).cell;
    [cell.cmm.link.timing.poll, cell.grinder.link.timing.poll]
}

/// Returns the height at which the centre of an I++ DME probe travels above the highest target of a plan.
pub fn clearance_mm() -> f64 {
    let measure = &setting(RequiredQuality::Good).recipe.measure;
    measure.safe_height_mm + measure.probe_radius_mm
}
