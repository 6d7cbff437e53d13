//! Grinder of a simulated cell that has a LinuxCNC controller: a LinuxCNC without a machine that runs elsewhere, or the
//! simulated controller.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde::Deserialize;
use serde_json::json;

use super::Controller;
use super::faults::LineFaults;
use crate::simulated_cell::{MachineTable, ServedLine, Simulation, settings, unavailable};
use crate::wire::executed_path::ExecutedPath;
use crate::wire::lines::ServingLines;

/// Table `wire` of the grinder.
#[derive(Deserialize)]
struct WireSettings {
    host: String,
    port: u16,
    connect_password: String,
    control_password: String,
    executed_path: Option<Vec<String>>,
}

/// Simulates the grinder. If the cell file names a program that reports the executed path, the wheel follows the path
/// that this program reports, and a LinuxCNC elsewhere serves the address. Otherwise serves linuxcncrsh at the address
/// itself.
///
/// # Errors
/// Returns the reason as text if the recipe requires a tilted wheel, a wheel that is not a ball, or tracks that are not
/// parallel lines along x. Also returns the reason if the program cannot be started, or if the address is not
/// available.
pub(crate) async fn simulator(table: MachineTable, simulation: &mut Simulation) -> Result<ServedLine, String> {
    let required = simulation.wheel;
    if required.is_tilted {
        return Err("the simulated wheel of LinuxCNC stays upright, but the recipe has grinding.tilt; remove grinding.tilt, or do not simulate".into());
    }
    if !(required.is_ball && required.has_straight_tracks) {
        return Err("the simulated wheel is spherical and its tracks are along x, but the recipe requires another wheel or pattern; use another recipe, or do not simulate".into());
    }
    let wheel = simulation.world.wheel(required.radius_mm).map_err(|error| error.to_string())?;
    let WireSettings { host, port, connect_password, control_password, executed_path } = settings(&table.wire)?;
    let line = |port: u16, place, server| {
        let address = json!({ "host": host, "port": port, "kind": "linuxcnc" });
        ServedLine::of_one(table.kind, place, address, server)
    };
    if let Some([program, arguments @ ..]) = executed_path.as_deref() {
        let mut command = Command::new(resolved(program, &simulation.cell_folder));
        command.args(arguments);
        let path = ExecutedPath::follow(command, wheel).map_err(|error| {
            format!("grinder.wire.executed_path: {program} cannot be started: {error}; correct the cell file")
        })?;
        simulation.executed_path = Some(path);
        return Ok(line(port, None, None));
    }
    let mut controller = Controller::new(wheel, simulation.world.spec().speed, LineFaults::none());
    controller.set_passwords([connect_password, control_password]);
    let serving = ServingLines::tcp((host.as_str(), port), controller);
    let serving = serving.await.map_err(|error| unavailable(&host, port, &error))?;
    let port = serving.local_addr().port();
    Ok(line(port, Some(format!("LinuxCNC {host}:{port}")), Some(serving)))
}

/// Returns the path of a program. A path that contains a folder and is relative starts at `cell_folder`.
fn resolved(program: &str, cell_folder: &Path) -> PathBuf {
    let path = Path::new(program);
    if path.components().count() > 1 { cell_folder.join(path) } else { path.to_owned() }
}
