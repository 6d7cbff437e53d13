//! Measuring machine of a simulated cell that prints a line for each touch.

use std::io;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::{Value, json};

use super::faults::PrintFaults;
use super::print::Style;
use super::{Options, PartProgram};
use crate::simulated_cell::{MachineTable, ServedLine, Simulation, object, settings, unavailable};
use crate::wire::hits::ServingHits;
use crate::wire::terminal_link::TerminalLink;

/// Device in a cell file that means a new pseudo-terminal.
const AUTO: &str = "auto";

/// Table `wire` of the machine.
#[derive(Deserialize)]
struct WireSettings {
    device: Option<String>,
    host: Option<String>,
    port: u16,
    format: String,
    coordinates: Option<String>,
    decimals: usize,
    decimal: String,
    separator: String,
    unit: String,
    axes: String,
    rotary_deg: f64,
    plan_folder: Option<PathBuf>,
}

/// Serves the measuring machine at its address. It measures each list of points in the plan folder, and prints its
/// touches. If the cell file names no plan folder, creates a temporary one.
///
/// # Errors
/// Returns the reason as text if the address is not available, or if a folder or a link cannot be created.
pub(crate) async fn simulator(table: MachineTable, simulation: &mut Simulation) -> Result<ServedLine, String> {
    let wire: WireSettings = settings(&table.wire)?;
    let options = Options {
        style: wire.style()?,
        radius_mm: simulation.probe_radius_mm,
        contacts: wire.coordinates.as_deref() == Some("contacts"),
        search_mm: [2.0, 2.0],
    };
    let (folder, temporary) = match &wire.plan_folder {
        Some(folder) => (simulation.cell_folder.join(folder), None),
        None => {
            let own = TemporaryFolder::create().map_err(|error| format!("no folder can be created: {error}"))?;
            (own.0.clone(), Some(own))
        }
    };
    let (mut serving, link, place, address) = open(&wire).await?;
    let program = PartProgram::new(simulation.world.touch_probe(), options, PrintFaults::none());
    serving.run(program, &folder, simulation.world.spec().speed);
    let place = Some(format!("hit lines {place}"));
    let mut line = ServedLine::of_one(table.kind, place, address, (serving, link, temporary));
    line.machines[0].chosen = object(json!({ "plan_folder": folder.display().to_string() }));
    Ok(line)
}

impl WireSettings {
    /// Returns the format in which the machine prints its hits.
    ///
    /// # Errors
    /// Returns the reason as text if a key has an unknown value.
    fn style(&self) -> Result<Style, String> {
        let unknown =
            |key: &str, value: &str| format!("the simulated machine cannot print hits with {key} = {value:?}");
        let axis = |k: usize| "xyz".find(self.axes.chars().nth(k)?);
        let axes = [axis(0), axis(1), axis(2)];
        let [Some(first), Some(second), Some(third)] = axes else { return Err(unknown("axes", &self.axes)) };
        Ok(Style {
            letters: self.format.starts_with("lettered"),
            whole: self.format.contains("integer"),
            rotary_deg: self.format.ends_with("rotary").then_some(self.rotary_deg),
            decimals: self.decimals,
            mark: if self.decimal == "comma" { ',' } else { '.' },
            separator: match self.separator.as_str() {
                "comma" => ',',
                "semicolon" => ';',
                "tab" => '\t',
                "blank" => ' ',
                other => return Err(unknown("separator", other)),
            },
            unit_mm: match self.unit.as_str() {
                "nm" => 1e-6,
                "um" => 1e-3,
                "mm" => 1.0,
                "cm" => 10.0,
                "m" => 1000.0,
                "inch" => 25.4,
                other => return Err(unknown("unit", other)),
            },
            axes: [first, second, third],
        })
    }
}

/// Opens the line of a machine. Returns the printer at its far end, the link to its pseudo-terminal if there is one,
/// and the address of the line, in words and as keys of the table `wire`.
///
/// # Errors
/// Returns the reason as text if the address is not available, or if a link cannot be created.
async fn open(wire: &WireSettings) -> Result<(ServingHits, Option<TerminalLink>, String, Value), String> {
    let kind = "hit-lines";
    let Some(device) = &wire.device else {
        let host = wire.host.as_deref().unwrap_or_default();
        let serving = ServingHits::tcp((host, wire.port)).await;
        let serving = serving.map_err(|error| unavailable(host, wire.port, &error))?;
        let port = serving.local_addr().map_or(wire.port, |address| address.port());
        return Ok((serving, None, format!("{host}:{port}"), json!({ "host": host, "port": port, "kind": kind })));
    };
    let serving = ServingHits::serial().map_err(|error| format!("no pseudo-terminal can be created: {error}"))?;
    let terminal = serving.path().unwrap_or(Path::new("")).to_owned();
    let (link, device) = match device.as_str() {
        AUTO => (None, terminal.display().to_string()),
        device => (Some(TerminalLink::place(&terminal, device)?), device.to_owned()),
    };
    let address = json!({ "device": device, "kind": kind });
    Ok((serving, link, device, address))
}

/// Temporary folder. It is removed with its content when this is dropped.
struct TemporaryFolder(PathBuf);

impl TemporaryFolder {
    fn create() -> io::Result<Self> {
        let path = std::env::temp_dir().join(format!("regrind-list-{:016x}", rand::random::<u64>()));
        std::fs::create_dir(&path)?;
        Ok(Self(path))
    }
}

impl Drop for TemporaryFolder {
    fn drop(&mut self) {
        // An error is harmless: nothing in the folder is needed.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
