//! Measuring machine of a simulated cell that has a server of I++ DME.

use serde::Deserialize;
use serde_json::json;

use super::Server;
use super::faults::CommandFaults;
use super::machine::{DmeMachine, Options};
use crate::simulated_cell::{MachineTable, ServedLine, Simulation, settings, unavailable};
use crate::wire::lines::ServingLines;

/// Table `wire` of the machine.
#[derive(Deserialize)]
struct WireSettings {
    host: String,
    port: u16,
    tool: String,
}

/// Serves the measuring machine at its address. It waits for the path of an external controller, if there is one.
///
/// # Errors
/// Returns the reason as text if the address is not available.
pub(crate) async fn simulator(table: MachineTable, simulation: &mut Simulation) -> Result<ServedLine, String> {
    let WireSettings { host, port, tool } = settings(&table.wire)?;
    let tools = vec![("NoTool".to_owned(), 0.0), (tool, simulation.probe_radius_mm)];
    let machine = DmeMachine::new(simulation.world.touch_probe(), Options { tools, ..Default::default() });
    let server = Server::new(machine, simulation.world.spec().speed, CommandFaults::none());
    let serving = ServingLines::tcp_after((host.as_str(), port), server, simulation.executed_path.take());
    let serving = serving.await.map_err(|error| unavailable(&host, port, &error))?;
    let port = serving.local_addr().port();
    let address = json!({ "host": host, "port": port, "kind": "ippdme" });
    Ok(ServedLine::of_one(table.kind, Some(format!("I++ DME {host}:{port}")), address, serving))
}
