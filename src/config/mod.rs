//! A cell: which machines there are, on which wires they answer, where the fixture holds the part, and what they can do.
//!
//! ```text
//!  text -> CellFile (as written, src/config/written.rs) -> CellConfig (checked: mm, rad, s; no contradiction)
//! ```
//!
//! Everything that is wrong with a file is told at once ([`crate::document::Problems`]), each thing at its line and column.

mod check;
mod written;

use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use std::time::Duration;

use crate::document::{Document, Problems, problem_at, read_text, schema_of, sha256};
use crate::geometry::{Point, Pose};

/// A cell, checked.
#[derive(Clone, Debug)]
pub struct CellConfig {
    /// Name of the cell.
    pub name: String,
    /// Whether its machines are simulated; everything recorded is marked so.
    pub simulated: bool,
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

/// The wire to a machine.
#[derive(Clone, Debug, PartialEq)]
pub enum Wire {
    /// Modbus over TCP.
    ModbusTcp {
        /// Name or address.
        host: String,
        /// Port; 0, in a simulated cell only, for one that is free at the start.
        port: u16,
        /// Unit identifier.
        unit: u8,
    },
    /// Modbus over a serial line, eight data bits.
    ModbusRtu {
        /// Device of the line, as the operating system calls it.
        device: String,
        /// Bits a second.
        baud: u32,
        /// Parity.
        parity: Parity,
        /// Stop bits, 1 or 2.
        stop_bits: u8,
        /// Unit identifier, 1 to 247.
        unit: u8,
    },
    /// Files in two folders, and a person.
    FileExchange(FileExchange),
}

/// Parity of a serial line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Parity {
    /// None.
    None,
    /// Even.
    Even,
    /// Odd.
    Odd,
}

/// Files in two folders.
#[derive(Clone, Debug, PartialEq)]
pub struct FileExchange {
    /// Where Regrind writes what the machine shall do.
    pub outbox: PathBuf,
    /// Where results appear.
    pub inbox: PathBuf,
    /// A file that has not changed for so long is complete.
    pub stable_for: Duration,
    /// How results are written.
    pub content: Content,
    /// The stations of a measurement, each with its own frame; empty for a machine that has one.
    pub stations: Vec<Station>,
    /// The reference points in the CMM frame, to which the stations are merged.
    pub reference_points: Option<PathBuf>,
    /// Name of the group of reference points within the file.
    pub reference_group: Option<String>,
    /// By how much a reference point may be off after the best fit of its station.
    pub reference_limit_mm: f64,
    /// Names of result files, with `{part}`, `{job}`, `{cycle}` and one `*`.
    pub result: String,
    /// Whether files may be taken that lay in the inbox before the plan was handed over.
    pub take_earlier: bool,
    /// By how much the probe radius that a file states may differ from the recipe's.
    pub probe_tolerance_mm: f64,
}

/// How result files are written.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Content {
    /// What the coordinates are; `None` where each file has to say it.
    pub what: Option<PointKind>,
    /// The decimal mark.
    pub decimal: Decimal,
    /// Millimetres per unit of length of the files.
    pub unit_mm: f64,
}

/// What measured coordinates are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum PointKind {
    /// Centres of the probe.
    Centres,
    /// Points of the surface.
    Contacts,
}

/// The decimal mark of numbers in files.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Decimal {
    /// Told from the file.
    #[default]
    Auto,
    /// A point; commas group thousands.
    Point,
    /// A comma; points group thousands.
    Comma,
}

/// One station of a measurement.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Station {
    /// Its points: a name in the inbox, `*` for any characters.
    pub points: String,
    /// The reference points as this station sees them: a name in the inbox, `*` for any characters.
    pub reference: String,
}

/// How long to wait for what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timing {
    /// For the answer to one request.
    pub request_timeout: Duration,
    /// How often a request is repeated after the first time.
    pub retries: u8,
    /// Between two looks at the status.
    pub poll: Duration,
    /// Between two beats.
    pub heartbeat: Duration,
    /// Without an answer, after which the machine is lost.
    pub lost_after: Duration,
    /// Of silence after a broken answer, so that late bytes die out.
    pub quarantine: Duration,
}

/// Where the blocks of docs/modbus.md stand: 0-based addresses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub struct RegisterMap {
    pub word_order: WordOrder,
    pub identity: u16,
    pub sync: u16,
    pub beat: u16,
    pub command: u16,
    pub status: u16,
    pub in_force: u16,
    pub inbox_header: u16,
    pub inbox_page: u16,
    pub inbox_state: u16,
    pub outbox_header: u16,
    pub outbox_select: u16,
    pub outbox_page: u16,
}

impl RegisterMap {
    /// Returns every block: its key in a cell file, its first register, and how many it has.
    pub fn blocks(&self) -> [(&'static str, u16, u16); 12] {
        [
            ("identity", self.identity, 32),
            ("sync", self.sync, 4),
            ("beat", self.beat, 1),
            ("command", self.command, 20),
            ("status", self.status, 48),
            ("in_force", self.in_force, 72),
            ("inbox_header", self.inbox_header, 24),
            ("inbox_page", self.inbox_page, 120),
            ("inbox_state", self.inbox_state, 12),
            ("outbox_header", self.outbox_header, 56),
            ("outbox_select", self.outbox_select, 2),
            ("outbox_page", self.outbox_page, 116),
        ]
    }
}

impl Default for RegisterMap {
    fn default() -> Self {
        Self {
            word_order: WordOrder::Big,
            identity: 0,
            sync: 32,
            beat: 36,
            command: 40,
            status: 64,
            in_force: 120,
            inbox_header: 200,
            inbox_page: 224,
            inbox_state: 350,
            outbox_header: 400,
            outbox_select: 460,
            outbox_page: 462,
        }
    }
}

/// Which word of a value of several registers comes first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum WordOrder {
    /// The high one.
    #[default]
    Big,
    /// The low one.
    Little,
}

/// A further value of a machine, read only.
#[derive(Clone, Debug, PartialEq)]
pub struct Signal {
    /// Its name.
    pub name: String,
    /// Address of its first register.
    pub address: u16,
    /// How it is coded.
    pub kind: SignalKind,
    /// Which word comes first.
    pub word_order: WordOrder,
    /// What the number is multiplied by.
    pub scale: f64,
    /// Its unit after that.
    pub unit: String,
    /// Least and largest value that is believed.
    pub range: [f64; 2],
}

/// How a further value is coded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[allow(missing_docs)]
pub enum SignalKind {
    U16,
    I16,
    U32,
    I32,
    F32,
    F64,
}

impl SignalKind {
    /// Returns how many registers a value takes.
    pub fn registers(self) -> u16 {
        match self {
            Self::U16 | Self::I16 => 1,
            Self::U32 | Self::I32 | Self::F32 => 2,
            Self::F64 => 4,
        }
    }
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
    /// Where the wheel's centre may be, in the model frame, where it is known.
    pub travel: Option<Travel>,
}

static SCHEMA: LazyLock<serde_json::Value> = LazyLock::new(schema_of::<written::CellFile>);

/// Returns the JSON schema of a cell file.
pub fn json_schema() -> &'static serde_json::Value {
    &SCHEMA
}

impl CellConfig {
    /// Reads a cell file.
    ///
    /// # Errors
    /// A file that cannot be read, and everything that is wrong with its text.
    pub fn read(path: &Path) -> Result<Self, Problems> {
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
