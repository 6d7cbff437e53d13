//! A cell: which machines there are, on which wires they answer, where the fixture holds the part, and what they can do.
//!
//! ```text
//!  text -> CellFile (as written, src/config/written.rs) -> CellConfig (checked: mm, rad, s; no contradiction)
//! ```
//!
//! Everything that is wrong with a file is told at once ([`crate::document::Problems`]), each thing at its line and column.

mod check;
mod dialect;
#[cfg(feature = "plant")]
mod plant;
mod written;

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use crate::device::{RegisterMap, Signal, Timing, Wire};
use crate::document::{Document, Problems, problem_at, read_text, schema_of, sha256};
use crate::formats::gcode::Dialect;
use crate::geometry::{Point, Pose};
use crate::model::MachineUncertainty;

pub use dialect::{dialect_schema, dialects, parse_dialect, read_dialect};
#[cfg(feature = "plant")]
pub use plant::{PlantConfig, plant_schema};
pub use written::RotaryLetter;

/// A cell, checked.
#[derive(Clone, Debug)]
pub struct CellConfig {
    /// Name of the cell.
    pub name: String,
    /// Whether its machines are simulated; everything recorded is marked so.
    pub simulated: bool,
    /// Whether people only play its machines, with no part: everything recorded is marked as that of simulated machines is, and the plan itself may be
    /// given back as what was measured. No cell file says it; who begins the run does.
    pub rehearsal: bool,
    /// Whether no run is begun without a key that signs its record.
    pub require_signature: bool,
    /// The measuring machine.
    pub cmm: Cmm,
    /// The grinder.
    pub grinder: Grinder,
    path: PathBuf,
    text: String,
    source_sha256: [u8; 32],
}

/// A measuring machine.
#[derive(Clone, Debug, PartialEq)]
pub struct Cmm {
    /// How to talk to it.
    pub link: Link,
    /// Where the fixture holds the part: takes model coordinates to CMM coordinates.
    pub fixture_cmm_from_model: Pose,
    /// Expansion of its scales in millionths per kelvin, as far as it does not correct that by itself.
    pub scale_expansion_um_m_k: f64,
    /// Standard uncertainty of the temperature of the part that it tells.
    pub temperature_uncertainty_k: f64,
    /// What it does to all points together, as standard uncertainties.
    pub uncertainty: MachineUncertainty,
    /// The sphere on which the probe is checked.
    pub reference_sphere: Option<ReferenceSphere>,
    /// The box that the probe's centre must not leave.
    pub travel: Option<Travel>,
}

/// A grinder.
#[derive(Clone, Debug, PartialEq)]
pub struct Grinder {
    /// How to talk to it.
    pub link: Link,
    /// What it can do.
    pub limits: GrinderLimits,
    /// How its programs are written.
    pub program: Programming,
    /// The rotary axis of its head, if it has one.
    pub rotary: Option<Rotary>,
}

/// The rotary axis of a head that tilts the wheel, in the terms of its scale; [`crate::compensation::path::Rotary`] is the same as paths have it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rotary {
    /// What programs call it: an A turns about x, a B about y.
    pub letter: RotaryLetter,
    /// Whether its scale counts left-handed.
    pub reversed: bool,
    /// Least and largest angle on its scale.
    pub range_deg: [f64; 2],
    /// Largest rate.
    pub largest_rate_deg_min: f64,
    /// From the wheel's centre to the pivot with the head upright; `None` where the control keeps the centre by itself.
    pub pivot_mm: Option<[f64; 3]>,
}

/// How the programs of a grinder are written.
#[derive(Clone, Debug, PartialEq)]
pub struct Programming {
    /// The dialect of its control.
    pub dialect: Dialect,
    /// How far the control rounds corners off by a setting of its own, where that is known.
    pub controller_tolerance_mm: Option<f64>,
    /// How far arcs may be from the path; none for lines alone.
    pub arcs_within_mm: Option<f64>,
    /// The folder in which the control finds the program of each pass.
    pub folder: Option<PathBuf>,
}

/// How to talk to a machine.
#[derive(Clone, Debug, PartialEq)]
pub struct Link {
    /// The wire.
    pub wire: Wire,
    /// How long to wait for what.
    pub timing: Timing,
    /// Where the blocks of its Modbus map stand.
    pub registers: RegisterMap,
    /// Further values that are read and recorded.
    pub signals: Vec<Signal>,
    /// The name that the machine must have in its identity block.
    pub expected_name: Option<String>,
}

/// The sphere on which the probe is checked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReferenceSphere {
    /// Its centre in the CMM frame.
    pub centre: Point,
    /// Its radius.
    pub radius_mm: f64,
    /// How many points are taken on it.
    pub points: u16,
}

/// A box: in the CMM frame for the probe, in the model frame for the wheel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Travel {
    /// Least x, y, z.
    pub least_mm: [f64; 3],
    /// Largest x, y, z.
    pub most_mm: [f64; 3],
}

/// What a grinder can do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GrinderLimits {
    /// Largest feed.
    pub largest_feed_mm_min: f64,
    /// Smallest and largest radius of a wheel.
    pub wheel_radius_mm: [f64; 2],
    /// Most that one pass may take off.
    pub largest_depth_mm: f64,
    /// Largest speed of an axis, where it is known.
    pub largest_speed_mm_s: Option<f64>,
    /// Largest acceleration of an axis, where it is known.
    pub largest_acceleration_mm_s2: Option<f64>,
    /// Largest change of the acceleration of an axis in time, where it is known.
    pub largest_jerk_mm_s3: Option<f64>,
    /// Where the wheel's centre may be, in the model frame, where it is known.
    pub travel: Option<Travel>,
}

/// What the simulated cell is called that comes with the program.
pub const BUILT_IN: &str = "sim";

static SCHEMA: LazyLock<serde_json::Value> = LazyLock::new(schema_of::<written::CellFile>);

/// Returns the JSON schema of a cell file.
pub fn json_schema() -> &'static serde_json::Value {
    &SCHEMA
}

impl CellConfig {
    /// Reads a cell file; [`BUILT_IN`] is no file but the simulated cell that comes with the program.
    ///
    /// # Errors
    /// A file that cannot be read, and everything that is wrong with its text.
    pub fn read(path: &Path) -> Result<Self, Problems> {
        if path == Path::new(BUILT_IN) {
            return Self::parse(path, include_str!("../../config/sim.toml"));
        }
        let text = read_text(path)?;
        Self::parse(path, &text)
    }

    /// Reads a cell file from its text; the path is for messages, and relative folders are relative to its folder.
    ///
    /// # Errors
    /// Everything that is wrong with the text.
    pub fn parse(path: &Path, text: &str) -> Result<Self, Problems> {
        let mut document = Document::parse(path, text)?;
        document.hold_against(&SCHEMA);
        let checked = document.as_written().map(|written| check::check(&written, path, &mut document));
        document.finish()?;
        let cell = checked.and_then(|checked| checked.into_cell(path, text, sha256(text)));
        cell.ok_or_else(|| {
            Problems::whole(path, text, "something is missing".into(), "compare it with config/sim.toml")
        })
    }

    /// Returns a problem with a key of this file that somebody else has found, at its place in the text.
    pub fn problem(&self, key: &str, found: &str, allowed: &str, remedy: &str) -> Problems {
        problem_at(&self.path, &self.text, key, [found, allowed, remedy])
    }

    /// Returns what a person should know of the wires on this computer: serial ports that are not there. It makes the file no worse, which
    /// may be checked on another computer than the cell's.
    pub fn notes(&self) -> Vec<String> {
        let mut notes = [self.cmm.link.wire.notes(), self.grinder.link.wire.notes()].concat();
        notes.dedup();
        notes
    }

    /// Whether everything recorded is marked SIMULATION: its machines are simulated, or people only play them.
    pub fn is_marked(&self) -> bool {
        self.simulated || self.rehearsal
    }

    /// Whether people serve both machines.
    pub fn is_by_person(&self) -> bool {
        [&self.cmm.link, &self.grinder.link].iter().all(|link| link.wire.is_by_person())
    }

    /// Returns the path that the cell file was read from.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the exact text of the cell file.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Returns the SHA-256 of the text.
    pub fn source_sha256(&self) -> &[u8; 32] {
        &self.source_sha256
    }
}
