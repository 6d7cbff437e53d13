//! Simulated world of a cell. It is created only here, and the cell sees it only through the wires.

use std::path::Path;
use std::time::SystemTime;

use regrind::compensation::path::TrackPattern;
use regrind::config::{CellConfig, LinkConfig, RotaryLetter};
use regrind::formats::{FormatError, JsonlAppender};
use regrind::journal::utc;
use regrind::recipe::{Recipe, WheelDimensions};
use regrind_sim::body::Kind;
use regrind_sim::event_log::LogEntry;
use regrind_sim::grinder::Programs;
use regrind_sim::head::Head;
use regrind_sim::program::Control;
use regrind_sim::simulated_cell::{MachineTable, RequiredWheel, ServedLine, ServedMachine, Simulation};
use regrind_sim::simulators;
use regrind_sim::spec::WorldSpec;
use regrind_sim::world::World;
use serde::Serialize;

use super::failure::Failure;

/// Simulated machines of a cell, served until this value is dropped.
pub(super) struct SimulatedCell {
    lines: Vec<ServedLine>,
    /// World with the true shape of the part. It lives as long as the machines, and is read only on request.
    pub(super) world: World,
}

/// Line of the log of simulated machines.
#[derive(Serialize)]
struct Witnessed<'a> {
    utc: String,
    machine: &'a str,
    unit: u8,
    #[serde(flatten)]
    seen: &'a LogEntry,
}

/// Starts servers for the simulated machines of the cell `cell`, at the addresses in the cell file. `spec` defines the
/// simulated part and machines. If a port is 0, the system assigns a free port, which is then stored in `cell`. The
/// servers end when the returned value is dropped.
///
/// `recipe` gives two radii: that of the probe of a simulated measuring machine without a plan, and that of the wheel
/// of a simulated grinder without passes.
///
/// # Errors
/// Returns an error if an address is not available, or if this machine or recipe cannot be simulated.
pub(super) async fn serve(spec: WorldSpec, cell: &mut CellConfig, recipe: &Recipe) -> Result<SimulatedCell, Failure> {
    let path = cell.path().to_owned();
    let failed = |reason: String| Failure::Simulation { path: path.clone(), reason };
    let world = World::new(spec).map_err(|e| failed(e.to_string()))?;
    let grinding = &recipe.grinding;
    let mut simulation = Simulation {
        world: world.clone(),
        cell_folder: path.parent().unwrap_or(Path::new("")).to_owned(),
        probe_radius_mm: recipe.measure.probe_radius_mm,
        wheel: RequiredWheel {
            radius_mm: grinding.wheel.radius_mm(),
            is_ball: matches!(grinding.wheel, WheelDimensions::Sphere { .. }),
            is_tilted: grinding.tilt.is_some(),
            has_straight_tracks: matches!(grinding.pattern, TrackPattern::Raster),
        },
        programs: by_programs(cell),
        executed_path: None,
    };
    let table = |kind, link: &LinkConfig| {
        let (wire, registers) = (serde_json::to_value(&link.wire)?, serde_json::to_value(link.registers)?);
        Ok(MachineTable { kind, wire, registers })
    };
    let read = |tables: serde_json::Result<MachineTable>| tables.map_err(|e| failed(e.to_string()));
    let tables = [read(table(Kind::Cmm, &cell.cmm.link))?, read(table(Kind::Grinder, &cell.grinder.link))?];
    let lines = simulators::serve(tables, &mut simulation).await.map_err(failed)?;
    for ServedMachine { kind, address, chosen } in lines.iter().flat_map(|line| &line.machines) {
        let link = match kind {
            Kind::Cmm => &mut cell.cmm.link,
            Kind::Grinder => &mut cell.grinder.link,
        };
        let keys = address.clone().into_iter().chain(chosen.clone());
        link.wire.set_keys(keys.collect()).map_err(|e| failed(e.to_string()))?;
    }
    Ok(SimulatedCell { lines, world })
}

/// Returns the settings with which the simulated grinder reads grinding programs. The settings are the program folder,
/// the kind of the simulated control, and the rotary axis of the wheel. The kind follows from the dialect (the program
/// format of a machine control) in the cell file.
///
/// Returns `None` if the cell file names no program folder. The inner result is the reason as text if no simulated
/// control reads this dialect.
fn by_programs(cell: &CellConfig) -> Option<Result<Programs, String>> {
    let program = &cell.grinder.program;
    let folder = program.folder.clone()?;
    let name = &program.dialect.dialect.name;
    let Some(control) = Control::named(name) else {
        return Some(Err(format!(
            "the simulated grinder cannot read grinding programs in the dialect `{name}`; remove grinder.program.folder from the simulated cell"
        )));
    };
    let head = cell.grinder.rotary.map(|axis| Head {
        letter: if axis.letter == RotaryLetter::A { 'A' } else { 'B' },
        left_handed: axis.reversed,
        range_deg: axis.range_deg,
        pivot_mm: axis.pivot_mm,
    });
    Some(Ok(Programs { folder, control, head }))
}

impl SimulatedCell {
    /// Returns the address of each line of the machines, in words.
    pub(super) fn places(&self) -> impl Iterator<Item = &str> {
        self.lines.iter().filter_map(|line| line.place.as_deref())
    }

    /// Returns the address of the simulated machine of the kind `kind` as a JSON object: host and port, or serial
    /// device.
    pub(super) fn address(&self, kind: Kind) -> serde_json::Value {
        let mut machines = self.lines.iter().flat_map(|line| &line.machines);
        machines.find(|machine| machine.kind == kind).map(|machine| machine.address.clone()).into()
    }

    /// Writes each future event of the simulated Modbus machines to the file `path`, when the event occurs. Each event
    /// is a line of JSON.
    ///
    /// # Errors
    /// Returns an error if the file cannot be opened.
    pub(super) fn log_to(&self, path: &Path) -> Result<(), FormatError> {
        let lines = JsonlAppender::open(path)?;
        for (unit, machine) in self.lines.iter().flat_map(|line| &line.units) {
            let (unit, lines) = (*unit, lines.clone());
            machine.with(|machine| {
                let name = machine.name();
                machine.set_observer(Box::new(move |seen| {
                    let utc = utc(SystemTime::now());
                    lines.append(&Witnessed { utc, machine: &name, unit, seen });
                }));
            });
        }
        Ok(())
    }
}
