//! The plan that results from a recipe and a cell file, before a run starts.

use std::path::Path;
use std::time::Duration;

use regrind::config::CellConfig;
use regrind::setup;
use regrind_testcell::rig::{changed, recipe};

fn cell(file: &str, changes: &[(&str, &str)]) -> CellConfig {
    CellConfig::parse(Path::new("cell.toml"), &changed(file, changes)).unwrap_or_else(|p| panic!("{p:?}"))
}

#[test]
fn transfer_timeout_from_line_speed() {
    let recipe = recipe(&[]);
    let transfer = |cell: &CellConfig| {
        let (task, plan) = setup::prepare(&recipe, cell).unwrap();
        let bytes = (8 * task.first_correction().grid.len()).max(56 * task.targets.len());
        (plan.deadlines.transfer, bytes.div_ceil(224) as f64)
    };
    let (on_tcp, _) = transfer(&cell("config/modbus-tcp.toml", &[]));
    assert_eq!(on_tcp, Duration::from_secs(120));
    let slow = cell("config/serial-rtu.toml", &[("baud = 115200", "baud = 9600"), ("baud = 115200", "baud = 9600")]);
    let (on_rtu, pages) = transfer(&slow);
    let three_times_s = 3.0 * pages * (257.0 * 11.0 / 9600.0 + 0.05);
    assert!(three_times_s > 120.0, "{three_times_s} s is not longer than anything has");
    assert!((on_rtu.as_secs_f64() - three_times_s).abs() < 1e-6, "{on_rtu:?} of {three_times_s} s");
}

#[test]
fn reference_sphere_in_part_refused() {
    let recipe = recipe(&[]);
    let mut cell = cell("config/modbus-tcp.toml", &[]);
    setup::prepare(&recipe, &cell).unwrap();
    let sphere = cell.cmm.reference_sphere.as_mut().unwrap();
    sphere.centre = cell.cmm.fixture_cmm_from_model.transform_point(&regrind::geometry::Point::new(3.0, 2.0, 0.0));
    let at = format!("{:.1}, {:.1}, {:.1}", sphere.centre.x, sphere.centre.y, sphere.centre.z);
    let refused = setup::prepare(&recipe, &cell).unwrap_err().to_string();
    assert!(refused.contains(&at), "{at} is missing in: {refused}");
}
