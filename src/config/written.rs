//! A cell file as written. The comments here are what an editor shows beside a key; the ranges are what a file is held to.

use schemars::JsonSchema;
use serde::Deserialize;

use super::{Decimal, Parity, PointKind, RegisterMap, SignalKind, WordOrder};

/// A cell of Regrind: its machines, their wires, where the fixture holds the part, and what the machines can do.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct CellFile {
    /// The cell.
    #[schemars(extend("x-required" = true))]
    pub cell: CellTable,
    /// The measuring machine.
    #[schemars(extend("x-required" = true))]
    pub cmm: CmmTable,
    /// The grinder.
    #[schemars(extend("x-required" = true))]
    pub grinder: GrinderTable,
}

/// The cell.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct CellTable {
    /// Its name.
    #[schemars(length(min = 1, max = 80), extend("x-required" = true), example = "cell 1")]
    pub name: Option<String>,
    /// Whether its machines are simulated; everything recorded is marked so.
    #[schemars(extend("x-required" = true), example = false)]
    pub simulated: Option<bool>,
}

/// The measuring machine.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct CmmTable {
    /// Its wire.
    #[schemars(extend("x-required" = true))]
    pub wire: Option<WireTable>,
    /// The name that the machine must have in its identity block.
    #[schemars(length(min = 1, max = 32))]
    pub expected_name: Option<String>,
    /// How long to wait for what.
    pub timing: TimingTable,
    /// Where the blocks of its Modbus map stand.
    pub registers: Option<RegistersTable>,
    /// Further values that are read and recorded.
    #[schemars(length(max = 64))]
    pub signals: Vec<SignalTable>,
    /// Where the fixture holds the part.
    pub fixture: FixtureTable,
    /// The sphere on which the probe is checked.
    pub reference_sphere: Option<SphereTable>,
    /// The box that the probe's centre must not leave, in the CMM frame.
    pub travel: Option<TravelTable>,
}

/// The grinder.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct GrinderTable {
    /// Its wire.
    #[schemars(extend("x-required" = true))]
    pub wire: Option<WireTable>,
    /// The name that the machine must have in its identity block.
    #[schemars(length(min = 1, max = 32))]
    pub expected_name: Option<String>,
    /// How long to wait for what.
    pub timing: TimingTable,
    /// Where the blocks of its Modbus map stand.
    pub registers: Option<RegistersTable>,
    /// Further values that are read and recorded.
    #[schemars(length(max = 64))]
    pub signals: Vec<SignalTable>,
    /// What it can do.
    #[schemars(extend("x-required" = true))]
    pub limits: LimitsTable,
    /// The box that the wheel's centre must not leave, in the frame of its programs, which is the model's.
    pub travel: Option<TravelTable>,
}

/// A wire.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub(super) enum WireTable {
    /// Modbus over TCP.
    ModbusTcp(TcpTable),
    /// Modbus over a serial line.
    ModbusRtu(RtuTable),
    /// Files in two folders, and a person.
    FileExchange(ExchangeTable),
}

#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct TcpTable {
    /// Name or address.
    #[schemars(length(min = 1, max = 253), extend("x-required" = true), example = "192.168.0.10")]
    pub host: Option<String>,
    /// Port; 0, in a simulated cell only, for one that is free at the start.
    #[schemars(range(min = 0, max = 65535))]
    pub port: u16,
    /// Unit identifier.
    #[schemars(range(min = 0, max = 255))]
    pub unit: u8,
}

#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct RtuTable {
    /// Device of the line, as the operating system calls it.
    #[schemars(length(min = 1, max = 400), extend("x-required" = true), example = "/dev/ttyUSB0")]
    pub device: Option<String>,
    /// Bits a second.
    #[schemars(range(min = 1200, max = 4000000))]
    pub baud: u32,
    /// Parity.
    pub parity: Parity,
    /// Stop bits.
    #[schemars(range(min = 1, max = 2))]
    pub stop_bits: u8,
    /// Unit identifier.
    #[schemars(range(min = 1, max = 247))]
    pub unit: u8,
}

/// Unit of length of files.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq)]
#[serde(rename_all = "kebab-case")]
pub(super) enum LengthWord {
    #[default]
    Mm,
    Inch,
}

#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct ExchangeTable {
    /// Folder into which Regrind writes what the machine shall do; relative to this file.
    #[schemars(length(min = 1, max = 400), extend("x-required" = true), example = "exchange/cmm/out")]
    pub outbox: Option<String>,
    /// Folder in which results appear; relative to this file.
    #[schemars(length(min = 1, max = 400), extend("x-required" = true), example = "exchange/cmm/in")]
    pub inbox: Option<String>,
    /// A file that has not changed for so long is complete.
    #[schemars(range(min = 0.05, max = 3600.0))]
    pub stable_for_s: f64,
    /// What the coordinates of results are, where the files do not say so themselves; said nowhere, they are refused.
    pub what: Option<PointKind>,
    /// Decimal mark of results.
    pub decimal: Decimal,
    /// Unit of length of results.
    pub unit: LengthWord,
    /// Stations of a measurement, each with its own frame.
    #[schemars(length(max = 64))]
    pub stations: Vec<StationTable>,
    /// File of the reference points in the CMM frame, to which stations are merged; relative to this file.
    #[schemars(length(min = 1, max = 400))]
    pub reference_points: Option<String>,
    /// Name of the group of reference points within the file.
    #[schemars(length(min = 1, max = 80))]
    pub reference_group: Option<String>,
    /// By how much a reference point may be off after the best fit of its station.
    #[schemars(range(min = 0.0001, max = 100.0))]
    pub reference_limit_mm: f64,
    /// Names of result files: `{part}`, `{job}` and `{cycle}` are filled in, one `*` stands for any characters.
    #[schemars(length(min = 1, max = 200))]
    pub result: String,
    /// Whether files may be taken that lay in the inbox before the plan was handed over.
    pub take_earlier: bool,
    /// By how much the probe radius that a file states may differ from the recipe's.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub probe_tolerance_mm: f64,
}

/// A station of a measurement.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct StationTable {
    /// File of its points in the inbox; one `*` stands for any characters.
    #[schemars(length(min = 1, max = 200), extend("x-required" = true), example = "M1_*.txt")]
    pub points: Option<String>,
    /// File of the reference points as it sees them, in the inbox; `*` for the same characters.
    #[schemars(length(min = 1, max = 200), extend("x-required" = true), example = "ref_*.yaml")]
    pub reference: Option<String>,
}

/// How long to wait for what.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct TimingTable {
    /// For the answer to one request.
    #[schemars(range(min = 10, max = 60000))]
    pub request_timeout_ms: u64,
    /// How often a request is repeated after the first time.
    #[schemars(range(max = 20))]
    pub retries: u8,
    /// Between two looks at the status.
    #[schemars(range(min = 5, max = 1000))]
    pub poll_ms: u64,
    /// Between two beats.
    #[schemars(range(min = 20, max = 500))]
    pub heartbeat_ms: u64,
    /// Without an answer, after which the machine is lost.
    #[schemars(range(min = 200, max = 600000))]
    pub lost_after_ms: u64,
    /// Of silence after a broken answer, so that late bytes die out.
    #[schemars(range(min = 0, max = 60000))]
    pub quarantine_ms: u64,
}

/// Where the blocks of docs/modbus.md stand: 0-based addresses.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct RegistersTable {
    /// Which word of a value of several registers comes first: big is the high one.
    pub word_order: WordOrder,
    /// Identity, 32 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub identity: u16,
    /// Sync, 4 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub sync: u16,
    /// Beat, 1 register.
    #[schemars(range(min = 0, max = 65535))]
    pub beat: u16,
    /// Command, 20 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub command: u16,
    /// Status, 48 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub status: u16,
    /// In force, 72 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub in_force: u16,
    /// Inbox header, 24 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub inbox_header: u16,
    /// Inbox page, 120 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub inbox_page: u16,
    /// Inbox state, 12 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub inbox_state: u16,
    /// Outbox header, 56 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub outbox_header: u16,
    /// Outbox select, 2 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub outbox_select: u16,
    /// Outbox page, 116 registers.
    #[schemars(range(min = 0, max = 65535))]
    pub outbox_page: u16,
}

/// A further value, read only.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct SignalTable {
    /// Its name.
    #[schemars(length(min = 1, max = 60), extend("x-required" = true), example = &"spindle_load")]
    pub name: Option<String>,
    /// Address of its first register, from 0.
    #[schemars(range(min = 0, max = 65535), extend("x-required" = true), example = 1000)]
    pub address: Option<u16>,
    /// How it is coded.
    #[serde(rename = "type")]
    #[schemars(extend("x-required" = true), example = &"u16")]
    pub kind: Option<SignalKind>,
    /// Which word comes first; as `registers.word_order` when left out.
    pub word_order: Option<WordOrder>,
    /// What the number is multiplied by.
    pub scale: f64,
    /// Its unit after that.
    #[schemars(length(max = 20))]
    pub unit: String,
    /// Least and largest value that is believed.
    #[schemars(extend("x-required" = true), example = [0.0, 100.0])]
    pub range: Option<[f64; 2]>,
}

/// Where the fixture holds the part: CMM coordinates are the turned model coordinates plus the translation.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct FixtureTable {
    /// Where the model's origin lies in the CMM frame.
    #[schemars(inner(range(min = -1e5, max = 1e5)))]
    pub translation_mm: [f64; 3],
    /// Turns about the CMM's x axis, then its y axis, then its z axis.
    #[schemars(inner(range(min = -360.0, max = 360.0)))]
    pub rotation_deg: [f64; 3],
}

/// The sphere on which the probe is checked.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct SphereTable {
    /// Its centre in the CMM frame.
    #[schemars(extend("x-required" = true), inner(range(min = -1e5, max = 1e5)), example = [0.0, -80.0, 20.0])]
    pub centre_mm: Option<[f64; 3]>,
    /// Its radius.
    #[schemars(range(min = 0.5, max = 200.0), extend("x-required" = true), example = 12.5)]
    pub radius_mm: Option<f64>,
    /// How many points are taken on it.
    #[schemars(range(min = 5, max = 1000))]
    pub points: u16,
}

/// A box: in the CMM frame for the probe, in the model frame for the wheel.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct TravelTable {
    /// Least x, y, z.
    #[schemars(extend("x-required" = true), inner(range(min = -1e5, max = 1e5)), example = [-300.0, -300.0, -200.0])]
    pub least_mm: Option<[f64; 3]>,
    /// Largest x, y, z.
    #[schemars(extend("x-required" = true), inner(range(min = -1e5, max = 1e5)), example = [300.0, 300.0, 200.0])]
    pub most_mm: Option<[f64; 3]>,
}

/// What a grinder can do.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct LimitsTable {
    /// Largest feed.
    #[schemars(range(min = 0.1, max = 1000000.0), extend("x-required" = true), example = 3000.0)]
    pub largest_feed_mm_min: Option<f64>,
    /// Smallest radius of a wheel.
    #[schemars(range(min = 0.1, max = 1000.0), extend("x-required" = true), example = 2.0)]
    pub least_wheel_radius_mm: Option<f64>,
    /// Largest radius of a wheel.
    #[schemars(range(min = 0.1, max = 1000.0), extend("x-required" = true), example = 100.0)]
    pub largest_wheel_radius_mm: Option<f64>,
    /// Most that one pass may take off.
    #[schemars(range(min = 0.00001, max = 100.0), extend("x-required" = true), example = 0.2)]
    pub largest_depth_mm: Option<f64>,
    /// Largest speed of an axis.
    #[schemars(range(min = 0.01, max = 100000.0))]
    pub largest_speed_mm_s: Option<f64>,
    /// Largest acceleration of an axis.
    #[schemars(range(min = 0.1, max = 10000000.0))]
    pub largest_acceleration_mm_s2: Option<f64>,
}

impl Default for TcpTable {
    fn default() -> Self {
        Self { host: None, port: 502, unit: 1 }
    }
}

impl Default for RtuTable {
    fn default() -> Self {
        Self { device: None, baud: 115_200, parity: Parity::Even, stop_bits: 1, unit: 1 }
    }
}

impl Default for ExchangeTable {
    fn default() -> Self {
        Self {
            outbox: None,
            inbox: None,
            stable_for_s: 2.0,
            what: None,
            decimal: Decimal::Auto,
            unit: LengthWord::Mm,
            stations: Vec::new(),
            reference_points: None,
            reference_group: None,
            reference_limit_mm: 0.1,
            result: "{part}_c{cycle}.*".to_owned(),
            take_earlier: false,
            probe_tolerance_mm: 0.001,
        }
    }
}

impl Default for TimingTable {
    fn default() -> Self {
        Self {
            request_timeout_ms: 500,
            retries: 3,
            poll_ms: 50,
            heartbeat_ms: 250,
            lost_after_ms: 3000,
            quarantine_ms: 100,
        }
    }
}

impl Default for SignalTable {
    fn default() -> Self {
        Self { name: None, address: None, kind: None, word_order: None, scale: 1.0, unit: String::new(), range: None }
    }
}

impl Default for SphereTable {
    fn default() -> Self {
        Self { centre_mm: None, radius_mm: None, points: 25 }
    }
}

impl Default for RegistersTable {
    fn default() -> Self {
        let map = RegisterMap::default();
        Self {
            word_order: map.word_order,
            identity: map.identity,
            sync: map.sync,
            beat: map.beat,
            command: map.command,
            status: map.status,
            in_force: map.in_force,
            inbox_header: map.inbox_header,
            inbox_page: map.inbox_page,
            inbox_state: map.inbox_state,
            outbox_header: map.outbox_header,
            outbox_select: map.outbox_select,
            outbox_page: map.outbox_page,
        }
    }
}

impl From<&RegistersTable> for RegisterMap {
    fn from(written: &RegistersTable) -> Self {
        Self {
            word_order: written.word_order,
            identity: written.identity,
            sync: written.sync,
            beat: written.beat,
            command: written.command,
            status: written.status,
            in_force: written.in_force,
            inbox_header: written.inbox_header,
            inbox_page: written.inbox_page,
            inbox_state: written.inbox_state,
            outbox_header: written.outbox_header,
            outbox_select: written.outbox_select,
            outbox_page: written.outbox_page,
        }
    }
}
