//! A part small enough to be ground, measured and registered in some milliseconds: the shipped free-form mirror, coarsely.

use std::path::Path;
use std::sync::OnceLock;
use std::time::Duration;

use regrind::cell::CellPlan;
use regrind::config::CellConfig;
use regrind::drive::Task;
use regrind::recipe::Recipe;
use regrind::setup;

pub struct Setting {
    pub recipe: Recipe,
    pub cell: CellConfig,
}

fn changed(file: &str, changes: &[(&str, &str)]) -> String {
    let mut text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).unwrap();
    for (from, to) in changes {
        assert!(text.contains(from), "{file} has no {from:?}");
        text = text.replacen(from, to, 1);
    }
    text
}

/// How good a part has to be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// As it is after two or three cycles.
    Good,
    /// As it never becomes: all five cycles are gone through.
    Perfect,
}

/// Returns recipe and cell, which are the same for all but for what is wanted.
pub fn setting(wanted: Wanted) -> &'static Setting {
    static SETTINGS: [OnceLock<Setting>; 2] = [OnceLock::new(), OnceLock::new()];
    SETTINGS[wanted as usize].get_or_init(|| {
        let [pv_um, rms_um] = match wanted {
            Wanted::Good => ["pv_um = 12.0", "rms_um = 2.0"],
            Wanted::Perfect => ["pv_um = 0.1", "rms_um = 0.01"],
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
                ("start = \"search\"", "start = \"fixture\"\nhold = [\"x\", \"y\", \"rz\"]"),
                ("pv_um = 7.0", pv_um),
                ("rms_um = 1.0", rms_um),
                ("on_stall = \"stop\"", "on_stall = \"hold\""),
                // Each of these is a field of random waves that is drawn anew; what the grinder does wrong in every pass is left.
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

/// Makes what a run computes from, and what its cell decides by.
pub fn task(wanted: Wanted) -> (Task, CellPlan) {
    let Setting { recipe, cell } = setting(wanted);
    setup::prepare(recipe, cell).unwrap()
}

/// Time between two looks at each machine.
pub fn poll() -> [Duration; 2] {
    let cell = &setting(Wanted::Good).cell;
    [cell.cmm.link.timing.poll, cell.grinder.link.timing.poll]
}

/// How far over the highest target of a plan the centre of a probe travels that is led by lines.
pub fn clearance_mm() -> f64 {
    let measure = &setting(Wanted::Good).recipe.measure;
    measure.safe_height_mm + measure.probe_radius_mm
}
