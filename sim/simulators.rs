//! Table of the simulators, one line for each protocol.

use crate::simulated_cell::{MachineTable, ServedLine, Simulation};
use crate::{dme, hits, modbus, rsh};

/// Serves machines that have the protocol `protocol`, at the addresses in their tables.
///
/// # Errors
/// Returns the reason as text if nothing simulates this protocol, or if its simulator cannot serve these machines.
async fn simulator(
    protocol: &str,
    machines: Vec<MachineTable>,
    simulation: &mut Simulation,
) -> Result<Vec<ServedLine>, String> {
    match protocol {
        "modbus-tcp" | "modbus-rtu" => modbus::simulator(machines, simulation).await,
        "ippdme" => each(machines, simulation, dme::simulator::simulator).await,
        "hit-lines" => each(machines, simulation, hits::simulator::simulator).await,
        "linuxcnc" => each(machines, simulation, rsh::simulator::simulator).await,
        _ => Err("a machine that a person operates cannot be simulated; operate this machine yourself, for example with --rehearsal".into()),
    }
}

/// Serves machines that never share a line, one after the other.
async fn each(
    machines: Vec<MachineTable>,
    simulation: &mut Simulation,
    simulator: impl AsyncFn(MachineTable, &mut Simulation) -> Result<ServedLine, String>,
) -> Result<Vec<ServedLine>, String> {
    let mut lines = Vec::new();
    for machine in machines {
        lines.push(simulator(machine, simulation).await?);
    }
    Ok(lines)
}

/// Serves the measuring machine and the grinder of a cell. Two machines with the same protocol may share a line.
///
/// # Errors
/// Returns the reason as text if an address is not available, or if a machine, or this pair of machines, cannot be
/// simulated.
pub async fn serve([cmm, grinder]: [MachineTable; 2], simulation: &mut Simulation) -> Result<Vec<ServedLine>, String> {
    let [of_cmm, of_grinder] = [&cmm, &grinder].map(|machine| machine.protocol().to_owned());
    if of_cmm == of_grinder {
        return simulator(&of_cmm, vec![cmm, grinder], simulation).await;
    }
    // The measuring machine waits for the path that the grinder's controller executes.
    let grinder = simulator(&of_grinder, vec![grinder], simulation).await?;
    let mut lines = simulator(&of_cmm, vec![cmm], simulation).await?;
    lines.extend(grinder);
    if simulation.executed_path.is_some() {
        return Err("a simulated cell with LinuxCNC requires a measuring machine with I++ DME; change cmm.wire in the cell file, or do not simulate".into());
    }
    Ok(lines)
}
