//! Cell whose machines are simulated: what its file and the recipe say of them, and the lines that serve them.
//!
//! A simulator reads the table `wire` of its machine itself, with its own types, like a person who sets a machine up by
//! the same papers.

use std::any::Any;
use std::path::PathBuf;

use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::body::Kind;
use crate::grinder::Programs;
use crate::wire::Units;
use crate::wire::executed_path::ExecutedPath;
use crate::world::World;

/// Machine of a cell, as the cell file describes it.
#[derive(Clone, Debug)]
pub struct MachineTable {
    /// Kind of the machine.
    pub kind: Kind,
    /// Table `wire`; its key `kind` is the protocol.
    pub wire: Value,
    /// Table `registers`.
    pub registers: Value,
}

impl MachineTable {
    /// Returns the protocol of the machine, or an empty text if the table `wire` names none.
    pub fn protocol(&self) -> &str {
        self.wire["kind"].as_str().unwrap_or_default()
    }
}

/// Reads the settings of a simulator from a table of the cell file.
///
/// # Errors
/// Returns the reason as text if a key is missing or has a wrong type.
pub(crate) fn settings<T: DeserializeOwned>(table: &Value) -> Result<T, String> {
    serde_json::from_value(table.clone()).map_err(|error| format!("a machine cannot be simulated: {error}"))
}

/// Wheel of the grinder, as the recipe requires it.
#[derive(Clone, Copy, Debug)]
pub struct RequiredWheel {
    /// Radius of the wheel, in mm.
    pub radius_mm: f64,
    /// True if the wheel is a ball.
    pub is_ball: bool,
    /// True if the programs tilt the wheel.
    pub is_tilted: bool,
    /// True if the tracks are parallel lines along x.
    pub has_straight_tracks: bool,
}

/// Everything that a simulator needs in addition to the table of its machine.
pub struct Simulation {
    /// The true part, and its errors.
    pub world: World,
    /// Folder of the cell file, to which its paths are relative.
    pub cell_folder: PathBuf,
    /// Radius of the probe, in mm.
    pub probe_radius_mm: f64,
    /// Wheel of the grinder.
    pub wheel: RequiredWheel,
    /// Programs that the control of the grinder reads, if the cell file names their folder; or the reason why no
    /// simulated control can read them.
    pub programs: Option<Result<Programs, String>>,
    /// Path that an external controller executes, until a measuring machine takes it to wait for it.
    pub executed_path: Option<ExecutedPath>,
}

/// Line that serves a machine of a cell, or both. It ends when this is dropped.
pub struct ServedLine {
    /// Address of the line, in words; `None` if another program serves it.
    pub place: Option<String>,
    /// Machines on the line.
    pub machines: Vec<ServedMachine>,
    /// Machines with registers, each with its unit id.
    pub units: Units,
    /// Server of the line.
    pub server: Box<dyn Any + Send>,
}

/// Machine that is served.
#[derive(Clone, Debug)]
pub struct ServedMachine {
    /// Kind of the machine.
    pub kind: Kind,
    /// Address of the machine: the keys of its table `wire` by which a client reaches it.
    pub address: Map<String, Value>,
    /// Other keys of its table `wire` that the simulator has chosen.
    pub chosen: Map<String, Value>,
}

impl ServedLine {
    /// Creates the line of one machine without registers. `address` are the keys of its table `wire` by which a client
    /// reaches it.
    pub(crate) fn of_one(kind: Kind, place: Option<String>, address: Value, server: impl Any + Send) -> Self {
        let machine = ServedMachine { kind, address: object(address), chosen: Map::new() };
        Self { place, machines: vec![machine], units: Vec::new(), server: Box::new(server) }
    }
}

/// Returns the keys of a JSON object.
pub(crate) fn object(value: Value) -> Map<String, Value> {
    if let Value::Object(map) = value { map } else { Map::new() }
}

/// Returns the message that the address `host`:`port` is not available.
pub(crate) fn unavailable(host: &str, port: u16, error: &std::io::Error) -> String {
    format!(
        "the simulated machine cannot use the address {host}:{port}: {error}; choose another port, or end the program that uses this port"
    )
}
