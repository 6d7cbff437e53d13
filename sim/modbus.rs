//! Modbus machines of a simulated cell: from their tables in the cell file to the lines that serve them.

use serde::Deserialize;
use serde_json::{Map, json};

use crate::body::{Kind, Physics};
use crate::options::{MachineOptions, RegisterLayout};
use crate::register_encoding::WordOrder;
use crate::registers::SimulatedMachine;
use crate::simulated_cell::{MachineTable, ServedLine, ServedMachine, Simulation, object, settings, unavailable};
use crate::wire::{NoFaults, Serving, Units, rtu};

/// Table `wire` of a Modbus machine.
#[derive(Deserialize)]
struct WireSettings {
    #[serde(flatten)]
    line: LineSettings,
    unit: u8,
}

/// Line of a Modbus machine.
#[derive(Clone, PartialEq, Deserialize)]
#[serde(untagged)]
enum LineSettings {
    Tcp { host: String, port: u16 },
    Rtu { device: String, baud: u32 },
}

/// Table `registers` of a Modbus machine, beside the addresses of the blocks.
#[derive(Deserialize)]
struct EncodingSettings {
    word_order: String,
}

/// Serves one Modbus machine, or both. Machines with the same line share it.
///
/// # Errors
/// Returns the reason as text if a line cannot be served, or if the recipe requires a wheel that the simulated grinder
/// cannot tilt.
pub(crate) async fn simulator(
    machines: Vec<MachineTable>,
    simulation: &mut Simulation,
) -> Result<Vec<ServedLine>, String> {
    let mut lines: Vec<(LineSettings, Units, Vec<Kind>)> = Vec::new();
    for table in machines {
        let WireSettings { line, unit } = settings(&table.wire)?;
        let machine = (unit, machine(&table, simulation)?.into());
        match lines.iter_mut().find(|(other, ..)| *other == line) {
            Some((_, units, kinds)) => {
                units.push(machine);
                kinds.push(table.kind);
            }
            None => lines.push((line, vec![machine], vec![table.kind])),
        }
    }
    let mut served = Vec::new();
    for (line, units, kinds) in lines {
        served.push(serve(line, units, kinds).await?);
    }
    Ok(served)
}

/// Creates the machine of a table, which has just been switched on.
fn machine(table: &MachineTable, simulation: &Simulation) -> Result<SimulatedMachine, String> {
    let (world, spec) = (&simulation.world, simulation.world.spec());
    let (body, seed): (Box<dyn Physics>, u64) = match table.kind {
        Kind::Cmm => (Box::new(world.cmm()), spec.seed),
        Kind::Grinder if simulation.wheel.is_tilted && simulation.programs.is_none() => {
            return Err("the recipe has a tilted wheel (grinding.tilt), but the simulated grinder tilts the wheel only in grinding programs; write grinder.program.folder into the cell file".into());
        }
        Kind::Grinder => match simulation.programs.clone() {
            Some(programs) => (Box::new(world.grinder().by_programs(programs?)), spec.seed + 1),
            None => (Box::new(world.grinder()), spec.seed + 1),
        },
    };
    let EncodingSettings { word_order } = settings(&table.registers)?;
    let options = MachineOptions {
        word_order: if matches!(word_order.as_str(), "little" | "dcba") { WordOrder::Little } else { WordOrder::Big },
        swaps_bytes: matches!(word_order.as_str(), "badc" | "dcba"),
        layout: settings::<RegisterLayout>(&table.registers)?,
        speed: spec.speed,
        seed,
        ..MachineOptions::default()
    };
    // A real machine also has a new boot id after each start.
    Ok(SimulatedMachine::new(body, rand::random::<u32>().max(1), options))
}

async fn serve(line: LineSettings, units: Units, kinds: Vec<Kind>) -> Result<ServedLine, String> {
    let numbers: Vec<u8> = units.iter().map(|(unit, _)| *unit).collect();
    let names = numbers.iter().map(|unit| format!("unit {unit}")).collect::<Vec<_>>().join(" and ");
    let (serving, place, address) = match line {
        LineSettings::Tcp { host, port } => {
            let serving = Serving::tcp((host.as_str(), port), units);
            let serving = serving.await.map_err(|error| unavailable(&host, port, &error))?;
            let port = serving.local_addr().map_or(port, |address| address.port());
            (serving, format!("Modbus TCP {host}:{port}, {names}"), json!({ "host": host, "port": port }))
        }
        LineSettings::Rtu { device, baud } => {
            let mut serving = Serving::rtu(units, rtu::Line::paced(baud), NoFaults)
                .map_err(|error| format!("no pseudo-terminal can be created for {device}: {error}"))?;
            serving.link(&device)?;
            let place = format!("Modbus RTU {device} at {baud} baud, {names}");
            (serving, place, json!({ "device": device, "baud": baud }))
        }
    };
    let address = |unit: u8| {
        let mut address = object(address.clone());
        address.insert("unit".into(), unit.into());
        address
    };
    let machines = kinds.into_iter().zip(numbers);
    let machines = machines.map(|(kind, unit)| ServedMachine { kind, address: address(unit), chosen: Map::new() });
    let units = serving.machines().clone();
    Ok(ServedLine { place: Some(place), machines: machines.collect(), units, server: Box::new(serving) })
}
