//! Simulated world of a cell. It is created only here, and the cell sees it only through the wires.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::SystemTime;

use regrind::compensation::path::TrackPattern;
use regrind::config::{CellConfig, LinkConfig, RotaryLetter};
use regrind::device::{Coordinates, HitLinesWire, HitSource, IppdmeWire, LineAddress, RegisterMap, Wire};
use regrind::formats::{FormatError, JsonlAppender, ResultFolder, ScratchFolder, place_link, remove_link};
use regrind::journal::utc;
use regrind::recipe::{Recipe, WheelDimensions};
use regrind_sim::cmm::TouchProbe;
use regrind_sim::event_log::LogEntry;
use regrind_sim::grinder::Programs;
use regrind_sim::head::Head;
use regrind_sim::options::{MachineOptions, RegisterLayout};
use regrind_sim::program::Control;
use regrind_sim::register_encoding;
use regrind_sim::registers::SimulatedMachine;
use regrind_sim::spec::WorldSpec;
use regrind_sim::wire::executed_path::ExecutedPath;
use regrind_sim::wire::faults::SharedFaultPlan;
use regrind_sim::wire::hits::ServingHits;
use regrind_sim::wire::lines::ServingLines;
use regrind_sim::wire::rtu;
use regrind_sim::wire::{Serving, SharedMachine};
use regrind_sim::world::World;
use regrind_sim::{dme, hits};
use serde::{Deserialize, Serialize};

use super::failure::Failure;

/// Simulated machines of a cell, served until this value is dropped.
pub(super) struct SimulatedCell {
    /// Server of each wire.
    pub(super) servings: Vec<Serving>,
    /// Address of each machine, in words.
    pub(super) places: Vec<String>,
    /// Measuring machine with an I++ DME server.
    dme: Option<ServingLines<dme::Server>>,
    /// Measuring machine that prints its hits, and the folder for its list if the cell file names none.
    hits: Option<(ServingHits, Option<ScratchFolder>)>,
    /// Paths of the links to pseudo-terminals, which take the place of the serial devices.
    links: Vec<PathBuf>,
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

impl Drop for SimulatedCell {
    fn drop(&mut self) {
        for link in &self.links {
            // If removal fails, the next simulation replaces the link.
            let _ = remove_link(link);
        }
    }
}

/// Reads the properties of the simulated part and machines, such as the true shape of the part, from the table
/// `[simulation]` of `recipe`. If `seed` is given, it replaces the seed of the random numbers in this table.
///
/// # Errors
/// Returns an error if the recipe has no table `[simulation]`, or an invalid one.
pub(super) fn world_spec(recipe: &Recipe, seed: Option<u64>) -> Result<WorldSpec, Failure> {
    let none = || {
        Failure::Simulation {
        path: recipe.path().to_owned(),
        reason: "the recipe has no table [simulation], which defines the true shape of the simulated part; add this table, or use a cell of real machines".into(),
    }
    };
    let table = recipe.simulation.clone().ok_or_else(none)?;
    let failed = |reason: String| Failure::Simulation { path: recipe.path().to_owned(), reason };
    let mut spec =
        WorldSpec::deserialize(toml::Value::Table(table)).map_err(|e| failed(format!("[simulation]: {e}")))?;
    spec.seed = seed.unwrap_or(spec.seed);
    spec.check().map_err(|e| failed(format!("[simulation]: {e}")))?;
    Ok(spec)
}

/// Starts servers for the simulated machines of the cell `cell`, at the addresses in the cell file. `spec` defines the
/// simulated part and machines. If a port is 0, the system assigns a free port, which is then stored in `cell`. The
/// servers end when the returned value is dropped.
///
/// `recipe` gives two radii. A simulated measuring machine that uses I++ DME, or prints one line for each touch, has
/// the probe radius of `recipe`. A simulated grinder that uses LinuxCNC has the wheel radius of `recipe`.
///
/// # Errors
/// Returns an error if an address is not available, or if this machine or recipe cannot be simulated.
pub(super) async fn serve(spec: WorldSpec, cell: &mut CellConfig, recipe: &Recipe) -> Result<SimulatedCell, Failure> {
    let probe_radius_mm = recipe.measure.probe_radius_mm;
    let path = cell.path().to_owned();
    let failed = |reason: String| Failure::Simulation { path: path.clone(), reason };
    let speed = spec.speed;
    let seed = spec.seed;
    let world = World::new(spec).map_err(|e| failed(e.to_string()))?;
    let (servings, places, links) = (Vec::new(), Vec::new(), Vec::new());
    let mut simulated = SimulatedCell { servings, places, dme: None, hits: None, links, world: world.clone() };
    if let Wire::Linuxcnc(grinder) = &cell.grinder.link.wire {
        let folder = path.parent().unwrap_or(Path::new(""));
        let path = grinder.executed_path(folder).map(|command| executed(command, &world, recipe));
        let path = path.transpose().map_err(&failed)?;
        let Wire::Ippdme(wire) = &mut cell.cmm.link.wire else {
            return Err(failed("a simulated cell with LinuxCNC requires a measuring machine with I++ DME; change cmm.wire in the cell file, or do not simulate".into()));
        };
        simulated.serve_dme(wire, world.touch_probe(), speed, probe_radius_mm, path).await.map_err(&failed)?;
        return Ok(simulated);
    }
    let line = |link: &LinkConfig| {
        let none = "a machine that a person operates cannot be simulated; operate this machine yourself, for example with --rehearsal";
        link.wire.modbus_line().ok_or_else(|| failed(none.into()))
    };
    if recipe.grinding.tilt.is_some() && cell.grinder.program.folder.is_none() {
        let why = "the recipe has a tilted wheel (grinding.tilt), but the simulated grinder tilts the wheel only in grinding programs; write grinder.program.folder into the cell file";
        return Err(failed(why.into()));
    }
    let grinder = match by_programs(cell).map_err(&failed)? {
        Some(programs) => world.grinder().by_programs(programs),
        None => world.grinder(),
    };
    let grinder = SimulatedMachine::new(Box::new(grinder), boot_id(), options(&cell.grinder.link, speed, seed + 1));
    let (of_grinder, unit) = line(&cell.grinder.link)?;
    let grinder = (unit, grinder.into());
    if let Wire::Ippdme(wire) = &mut cell.cmm.link.wire {
        simulated.serve_dme(wire, world.touch_probe(), speed, probe_radius_mm, None).await.map_err(&failed)?;
        let port = simulated.serve(&of_grinder, vec![grinder]).await.map_err(&failed)?;
        set_port(&mut cell.grinder.link.wire, port);
        return Ok(simulated);
    }
    if let Wire::HitLines(wire) = &mut cell.cmm.link.wire {
        let folder = path.parent().unwrap_or(Path::new(""));
        simulated.serve_hits(wire, folder, world.touch_probe(), [speed, probe_radius_mm]).await.map_err(&failed)?;
        let port = simulated.serve(&of_grinder, vec![grinder]).await.map_err(&failed)?;
        set_port(&mut cell.grinder.link.wire, port);
        return Ok(simulated);
    }
    let cmm = SimulatedMachine::new(Box::new(world.cmm()), boot_id(), options(&cell.cmm.link, speed, seed));
    let (of_cmm, unit) = line(&cell.cmm.link)?;
    let cmm = (unit, cmm.into());
    if of_cmm == of_grinder {
        let port = simulated.serve(&of_cmm, vec![cmm, grinder]).await.map_err(failed)?;
        set_port(&mut cell.cmm.link.wire, port);
        set_port(&mut cell.grinder.link.wire, port);
    } else {
        let port = simulated.serve(&of_cmm, vec![cmm]).await.map_err(&failed)?;
        set_port(&mut cell.cmm.link.wire, port);
        let port = simulated.serve(&of_grinder, vec![grinder]).await.map_err(&failed)?;
        set_port(&mut cell.grinder.link.wire, port);
    }
    Ok(simulated)
}

/// Starts the external controller with `command`, and returns the path on which this controller moves the simulated
/// wheel. The wheel grinds the part in `world`, and has the radius in `recipe`.
///
/// Returns the reason as text if `recipe` requires a tilted wheel, a wheel that is not a sphere, or tracks that are not
/// parallel lines along x. Also returns the reason if `command` cannot be started.
fn executed(command: Command, world: &World, recipe: &Recipe) -> Result<ExecutedPath, String> {
    let grinding = &recipe.grinding;
    if grinding.tilt.is_some() {
        return Err("the simulated wheel of LinuxCNC stays upright, but the recipe has grinding.tilt; remove grinding.tilt, or do not simulate".into());
    }
    let (WheelDimensions::Sphere { radius_mm }, TrackPattern::Raster) = (grinding.wheel, grinding.pattern) else {
        return Err(
            "the simulated wheel is spherical and its tracks are along x, but the recipe requires another wheel or pattern; use another recipe, or do not simulate"
                .into(),
        );
    };
    let wheel = world.wheel(radius_mm).map_err(|error| error.to_string())?;
    let program = command.get_program().to_string_lossy().into_owned();
    ExecutedPath::follow(command, wheel).map_err(|error| {
        format!("grinder.wire.executed_path: {program} cannot be started: {error}; correct the cell file")
    })
}

/// Returns the settings with which the simulated grinder reads grinding programs. The settings are the program folder,
/// the kind of the simulated control, and the rotary axis of the wheel. The kind follows from the dialect (the program
/// format of a machine control) in the cell file.
///
/// Returns `None` if the cell file names no program folder. Returns the reason as text if no simulated control reads
/// this dialect.
fn by_programs(cell: &CellConfig) -> Result<Option<Programs>, String> {
    let program = &cell.grinder.program;
    let Some(folder) = program.folder.clone() else { return Ok(None) };
    let name = &program.dialect.dialect.name;
    let control = Control::named(name).ok_or_else(|| {
        format!(
            "the simulated grinder cannot read grinding programs in the dialect `{name}`; remove grinder.program.folder from the simulated cell"
        )
    })?;
    let head = cell.grinder.rotary.map(|axis| Head {
        letter: if axis.letter == RotaryLetter::A { 'A' } else { 'B' },
        left_handed: axis.reversed,
        range_deg: axis.range_deg,
        pivot_mm: axis.pivot_mm,
    });
    Ok(Some(Programs { folder, control, head }))
}

impl SimulatedCell {
    /// Writes each future event of the simulated Modbus machines to the file `path`, when the event occurs. Each event
    /// is a line of JSON.
    ///
    /// # Errors
    /// Returns an error if the file cannot be opened.
    pub(super) fn log_to(&self, path: &Path) -> Result<(), FormatError> {
        let lines = JsonlAppender::open(path)?;
        let machines = self.servings.iter().flat_map(|serving| serving.machines());
        for (unit, machine) in machines {
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

    /// Starts the server of a simulated measuring machine with the protocol I++ DME, at the address in `wire`. Writes
    /// the assigned port into `wire`. `probe` touches the simulated part, and `radius_mm` is the radius of the probe.
    /// `speed` is the factor by which the simulation is faster than reality. `grinder` is the path of the simulated
    /// wheel if LinuxCNC grinds; otherwise `None`. Returns the reason as text if the address is not available.
    async fn serve_dme(
        &mut self,
        wire: &mut IppdmeWire,
        probe: TouchProbe,
        speed: f64,
        radius_mm: f64,
        grinder: Option<ExecutedPath>,
    ) -> Result<(), String> {
        let tools = vec![("NoTool".to_owned(), 0.0), (wire.tool.clone(), radius_mm)];
        let machine = dme::machine::DmeMachine::new(probe, dme::machine::Options { tools, ..Default::default() });
        let server = dme::Server::new(machine, speed, dme::faults::CommandFaults::none());
        let (host, port) = (wire.host.clone(), wire.port);
        let serving = ServingLines::tcp_after((host.as_str(), port), server, grinder).await.map_err(|e| {
            format!("the simulated machine cannot use the address {host}:{port}: {e}; choose another port, or end the program that uses this port")
        })?;
        wire.port = serving.local_addr().port();
        self.places.push(format!("I++ DME {host}:{}", wire.port));
        self.dme = Some(serving);
        Ok(())
    }

    /// Starts a simulated measuring machine that prints a line of text for each hit (touch), at the address in `wire`.
    /// The machine measures each list of points that Regrind writes to the plan folder of `wire`. A relative plan
    /// folder starts at `cell_folder`. If `wire` names no plan folder, creates a temporary one. Stores the plan folder
    /// and the assigned address in `wire`. `probe` touches the simulated part. The last parameter contains the speed
    /// factor of the simulation and the probe radius in mm. Returns the reason as text if the address is not available.
    async fn serve_hits(
        &mut self,
        wire: &mut HitLinesWire,
        cell_folder: &Path,
        probe: TouchProbe,
        [speed, radius_mm]: [f64; 2],
    ) -> Result<(), String> {
        let own = match &wire.plan_folder {
            Some(_) => None,
            None => Some(list_folder().map_err(|e| e.to_string())?),
        };
        let folder = match (&own, &wire.plan_folder) {
            (None, Some(folder)) => cell_folder.join(folder),
            (own, _) => own.as_ref().map(|own| own.path().to_owned()).unwrap_or_default(),
        };
        wire.plan_folder = Some(folder.display().to_string());
        let mut serving = match wire.source() {
            HitSource::Tcp { host, port } => {
                let serving = ServingHits::tcp((host.as_str(), port)).await.map_err(|e| {
                    format!("the simulated machine cannot use the address {host}:{port}: {e}; choose another port, or end the program that uses this port")
                })?;
                wire.port = serving.local_addr().map_or(port, |address| address.port());
                self.places.push(format!("hit lines {host}:{}", wire.port));
                serving
            }
            HitSource::Serial { device, .. } => {
                let serving = ServingHits::serial().map_err(|e| format!("no pseudo-terminal can be created: {e}"))?;
                let terminal = serving.path().map(Path::to_owned).unwrap_or_default();
                if wire.has_dynamic_address() {
                    wire.device = Some(terminal.display().to_string());
                } else {
                    self.link(&terminal, &device)?;
                }
                self.places.push(format!("hit lines {}", wire.device.as_deref().unwrap_or_default()));
                serving
            }
        };
        let options = hits::Options {
            style: style(wire),
            radius_mm,
            contacts: wire.coordinates == Some(Coordinates::Contacts),
            search_mm: [2.0, 2.0],
        };
        serving.run(hits::PartProgram::new(probe, options, hits::faults::PrintFaults::none()), &folder, speed);
        self.hits = Some((serving, own));
        Ok(())
    }

    /// Creates a symbolic link at the path `device` to `terminal`, the pseudo-terminal that simulates the serial line.
    /// Stores the path of the link, so that the link is removed when `self` is dropped. Returns the reason as text if
    /// the link cannot be created.
    fn link(&mut self, terminal: &Path, device: &str) -> Result<(), String> {
        place_link(terminal, Path::new(device)).map_err(|e| {
            format!(
                "a link at {device} to {} cannot be created: {e}; remove the file at this path, or name another device",
                terminal.display()
            )
        })?;
        self.links.push(device.into());
        Ok(())
    }

    async fn serve(&mut self, line: &LineAddress, units: Vec<(u8, SharedMachine)>) -> Result<u16, String> {
        let names: Vec<String> = units.iter().map(|(unit, _)| format!("unit {unit}")).collect();
        match line {
            LineAddress::Tcp { host, port } => {
                let serving = Serving::tcp((host.as_str(), *port), units).await.map_err(|e| {
                    format!("the simulated machine cannot use the address {host}:{port}: {e}; choose another port, or end the program that uses this port")
                })?;
                let bound = serving.local_addr().map_or(*port, |address| address.port());
                self.places.push(format!("Modbus TCP {host}:{bound}, {}", names.join(" and ")));
                self.servings.push(serving);
                Ok(bound)
            }
            LineAddress::Rtu { device, baud, .. } => {
                let serving = Serving::rtu(units, rtu::Line::paced(*baud), SharedFaultPlan::none())
                    .map_err(|e| format!("no pseudo-terminal can be created for {device}: {e}"))?;
                let terminal = serving.path().map(Path::to_owned).unwrap_or_default();
                self.link(&terminal, device)?;
                self.places.push(format!("Modbus RTU {device} at {baud} baud, {}", names.join(" and ")));
                self.servings.push(serving);
                Ok(0)
            }
        }
    }
}

/// Creates a temporary folder for the lists of points that the simulated measuring machine reads. It is used if the
/// cell file names no folder. The folder is removed when the returned value is dropped.
fn list_folder() -> Result<ScratchFolder, FormatError> {
    let path = std::env::temp_dir().join(format!("regrind-list-{:016x}", rand::random::<u64>()));
    let folder = ScratchFolder::at(path)?;
    ResultFolder::prepare(folder.path())?.keep();
    Ok(folder)
}

/// Returns the format in which the simulated measuring machine prints its hits. The format has the separator, the unit,
/// the axes and the decimals that the cell file in `wire` prescribes, so that this program can read the hits.
fn style(wire: &HitLinesWire) -> hits::print::Style {
    use regrind::device::hit_lines::Separator;
    let reading = wire.parser();
    hits::print::Style {
        letters: reading.format.is_lettered(),
        whole: reading.format.is_integer(),
        rotary_deg: reading.format.has_rotary().then_some(wire.rotary_deg),
        decimals: reading.decimals,
        mark: reading.mark,
        separator: match reading.separator {
            Separator::Comma => ',',
            Separator::Semicolon => ';',
            Separator::Tab => '\t',
            Separator::Blank => ' ',
        },
        unit_mm: reading.unit_mm,
        axes: reading.axes,
    }
}

/// Returns a random number above 0 that identifies this start of a simulated machine. A real machine also has a new
/// number after each start.
fn boot_id() -> u32 {
    rand::random::<u32>().max(1)
}

fn options(link: &LinkConfig, speed: f64, seed: u64) -> MachineOptions {
    let RegisterMap { word_order, .. } = link.registers;
    MachineOptions {
        word_order: if word_order.is_low_first() {
            register_encoding::WordOrder::Little
        } else {
            register_encoding::WordOrder::Big
        },
        swaps_bytes: word_order.swaps_bytes(),
        layout: layout(&link.registers),
        speed,
        seed,
        ..MachineOptions::default()
    }
}

fn layout(r: &RegisterMap) -> RegisterLayout {
    RegisterLayout {
        identity: r.identity,
        sync: r.sync,
        beat: r.beat,
        command: r.command,
        status: r.status,
        in_force: r.in_force,
        inbox_header: r.inbox_header,
        inbox_page: r.inbox_page,
        inbox_state: r.inbox_state,
        outbox_header: r.outbox_header,
        outbox_select: r.outbox_select,
        outbox_page: r.outbox_page,
    }
}

fn set_port(wire: &mut Wire, bound: u16) {
    if let Wire::ModbusTcp(tcp) = wire {
        tcp.port = bound;
    }
}
