//! Cell file as written. Editors show the comments here as help for a key; a file is checked against the ranges.

use schemars::JsonSchema;
use serde::Deserialize;

use crate::device::{RegisterMap, SignalTable, Wire};

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
    /// Whether no run is begun without a key that signs its record.
    pub require_signature: bool,
}

/// The measuring machine.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct CmmTable {
    /// Its wire.
    #[schemars(extend("x-required" = true))]
    pub wire: Option<Wire>,
    /// The name that the machine must have in its identity block.
    #[schemars(length(min = 1, max = 32))]
    pub expected_name: Option<String>,
    /// How long to wait for what.
    pub timing: TimingTable,
    /// Where the blocks of its Modbus map stand.
    pub registers: Option<RegisterMap>,
    /// Further values that are read and recorded.
    #[schemars(length(max = 64))]
    pub signals: Vec<SignalTable>,
    /// What it knows of temperatures; looked at where a recipe tells how its part grows.
    pub temperature: TemperatureTable,
    /// What it does to all points together, as standard uncertainties; what is left out is not stated, and taken for 0.
    pub uncertainty: UncertaintyTable,
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
    pub wire: Option<Wire>,
    /// The name that the machine must have in its identity block.
    #[schemars(length(min = 1, max = 32))]
    pub expected_name: Option<String>,
    /// How long to wait for what.
    pub timing: TimingTable,
    /// Where the blocks of its Modbus map stand.
    pub registers: Option<RegisterMap>,
    /// Further values that are read and recorded.
    #[schemars(length(max = 64))]
    pub signals: Vec<SignalTable>,
    /// How its programs are written.
    pub program: ProgramTable,
    /// The rotary axis of a head that tilts the wheel, if it has one.
    pub rotary: Option<RotaryTable>,
    /// What it can do.
    #[schemars(extend("x-required" = true))]
    pub limits: LimitsTable,
    /// The box that the wheel's centre must not leave, in the frame of its programs, which is the model's.
    pub travel: Option<TravelTable>,
}

/// How the programs of a grinder are written.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct ProgramTable {
    /// The dialect of its control: `linuxcnc`, `fanuc`, `sinumerik`, `heidenhain`, or a file of your own, relative to this file.
    #[schemars(length(min = 1, max = 400))]
    pub dialect: String,
    /// How far the control rounds corners off by a setting of its own, for dialects that cannot say it.
    #[schemars(range(min = 0.0, max = 1000.0), example = 0.1)]
    pub controller_tolerance_um: Option<f64>,
    /// How far arcs may be from the path of the wheel; left out, programs have straight lines only. No more than
    /// `grinding.chord_error_um`.
    #[schemars(range(min = 0.0001, max = 1000.0), example = 0.05)]
    pub arcs_within_um: Option<f64>,
    /// Folder in which the control finds the program of each pass, for machines that are not given it by their wire; relative to this file.
    #[schemars(length(min = 1, max = 400), example = &"/mnt/grinder/programs")]
    pub folder: Option<String>,
}

impl Default for ProgramTable {
    fn default() -> Self {
        Self { dialect: "linuxcnc".to_owned(), controller_tolerance_um: None, arcs_within_um: None, folder: None }
    }
}

/// What programs call a rotary axis.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema, PartialEq, Eq)]
#[allow(missing_docs, reason = "each is told where the key is")]
pub enum RotaryLetter {
    A,
    B,
}

/// What a rotary axis turns.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Eq)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Turns {
    /// The head with the wheel.
    #[default]
    Head,
    /// The table with the part: no programs are made for it.
    Table,
}

/// The rotary axis of a head that tilts the wheel; one alone.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct RotaryTable {
    /// Its letter: an A turns about x, a B about y of the model frame.
    #[schemars(extend("x-required" = true), example = &"B")]
    pub axis: Option<RotaryLetter>,
    /// What it turns.
    pub turns: Turns,
    /// Whether its scale counts left-handed.
    pub reversed: bool,
    /// Least angle on its scale.
    #[schemars(range(min = -360.0, max = 360.0), extend("x-required" = true), example = -60.0)]
    pub min_deg: Option<f64>,
    /// Largest angle on its scale.
    #[schemars(range(min = -360.0, max = 360.0), extend("x-required" = true), example = 60.0)]
    pub max_deg: Option<f64>,
    /// Largest rate, in degrees a minute.
    #[schemars(range(min = 0.01, max = 10000000.0), extend("x-required" = true), example = 3600.0)]
    pub max_rate_deg_min: Option<f64>,
    /// From the wheel's centre to the pivot with the head upright, in the model frame: programs then have the places of the slides. Left out, the
    /// control keeps the wheel's centre by itself, and programs have its places.
    #[schemars(inner(range(min = -10000.0, max = 10000.0)), example = [0.0, 0.0, 180.0])]
    pub pivot_mm: Option<[f64; 3]>,
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

/// What a measuring machine knows of temperatures.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct TemperatureTable {
    /// Expansion of its scales in millionths per kelvin, as far as it does not correct that by itself.
    #[schemars(range(min = -20.0, max = 100.0))]
    pub scale_expansion_um_m_k: f64,
    /// Standard uncertainty of the temperature of the part that it tells.
    #[schemars(range(min = 0.0, max = 20.0))]
    pub uncertainty_k: f64,
}

impl Default for TemperatureTable {
    fn default() -> Self {
        Self { scale_expansion_um_m_k: 0.0, uncertainty_k: 0.5 }
    }
}

/// What a measuring machine does to all points together, as standard uncertainties: half of what a certificate states with k = 2. Points cannot show it.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct UncertaintyTable {
    /// Of the lengths along its x, y and z axes, in millionths.
    #[schemars(inner(range(min = 0.0, max = 1000.0)), example = [0.5, 0.5, 0.5])]
    pub scale_ppm: [f64; 3],
    /// Of the angles between its axes, xy, xz and yz.
    #[schemars(inner(range(min = 0.0, max = 10000.0)), example = [1.0, 1.0, 1.0])]
    pub squareness_urad: [f64; 3],
    /// Of the error of the probe in any one direction, beside its radius.
    #[schemars(range(min = 0.0, max = 1000.0), example = 0.2)]
    pub probe_um: f64,
    /// Of the radius of the sphere that the probe is qualified on.
    #[schemars(range(min = 0.0, max = 1000.0), example = 0.05)]
    pub reference_sphere_um: f64,
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
    pub min_mm: Option<[f64; 3]>,
    /// Largest x, y, z.
    #[schemars(extend("x-required" = true), inner(range(min = -1e5, max = 1e5)), example = [300.0, 300.0, 200.0])]
    pub max_mm: Option<[f64; 3]>,
}

/// What a grinder can do.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct LimitsTable {
    /// Largest feed.
    #[schemars(range(min = 0.1, max = 1000000.0), extend("x-required" = true), example = 3000.0)]
    pub max_feed_mm_min: Option<f64>,
    /// Smallest radius of a wheel.
    #[schemars(range(min = 0.1, max = 1000.0), extend("x-required" = true), example = 2.0)]
    pub min_wheel_radius_mm: Option<f64>,
    /// Largest radius of a wheel.
    #[schemars(range(min = 0.1, max = 1000.0), extend("x-required" = true), example = 100.0)]
    pub max_wheel_radius_mm: Option<f64>,
    /// Most that one pass may take off.
    #[schemars(range(min = 0.00001, max = 100.0), extend("x-required" = true), example = 0.2)]
    pub max_depth_mm: Option<f64>,
    /// Largest speed of an axis.
    #[schemars(range(min = 0.01, max = 100000.0))]
    pub max_speed_mm_s: Option<f64>,
    /// Largest acceleration of an axis.
    #[schemars(range(min = 0.1, max = 10000000.0))]
    pub max_acceleration_mm_s2: Option<f64>,
    /// Largest change of the acceleration of an axis in time, its jerk.
    #[schemars(range(min = 0.1, max = 1000000000.0))]
    pub max_jerk_mm_s3: Option<f64>,
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

impl Default for SphereTable {
    fn default() -> Self {
        Self { centre_mm: None, radius_mm: None, points: 25 }
    }
}
