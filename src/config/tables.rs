//! Cell file as written. Editors show the comments here as help for a key; a file is checked against the ranges.

use schemars::JsonSchema;
use serde::Deserialize;

use crate::device::{RegisterMap, SignalTable, Wire};

/// A cell of Regrind: its machines, their wires, the pose of the fixture, and the limits of the machines.
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
    /// Name of the cell.
    #[schemars(length(min = 1, max = 80), extend("x-required" = true), example = "cell 1")]
    pub name: Option<String>,
    /// Whether the machines are simulated; all records are then marked as simulation.
    #[schemars(extend("x-required" = true), example = false)]
    pub simulated: Option<bool>,
    /// Whether a run requires a key that signs its record.
    pub require_signature: bool,
}

/// The measuring machine.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct CmmTable {
    /// Wire to the machine.
    #[schemars(extend("x-required" = true))]
    pub wire: Option<Wire>,
    /// The name that the machine must have in its identity block.
    #[schemars(length(min = 1, max = 32))]
    pub expected_name: Option<String>,
    /// Day on which the calibration of the machine must be repeated. Regrind warns after it, and goes on.
    #[schemars(regex(pattern = r"^[0-9]{4}-[0-9]{2}-[0-9]{2}$"), example = &"2027-03-31")]
    pub calibration_due: Option<String>,
    /// Timeouts and intervals.
    pub timing: TimingTable,
    /// Addresses of the blocks of its Modbus map.
    pub registers: Option<RegisterMap>,
    /// Further values that are read and recorded.
    #[schemars(length(max = 64))]
    pub signals: Vec<SignalTable>,
    /// Temperature data of the machine, used if a recipe gives the expansion of its part.
    pub temperature: TemperatureTable,
    /// Standard uncertainties of the errors that all points share. An omitted one is not stated, and is assumed to be
    /// 0.
    pub uncertainty: UncertaintyTable,
    /// Pose of the part in the fixture.
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
    /// Wire to the machine.
    #[schemars(extend("x-required" = true))]
    pub wire: Option<Wire>,
    /// The name that the machine must have in its identity block.
    #[schemars(length(min = 1, max = 32))]
    pub expected_name: Option<String>,
    /// Day on which the calibration of the machine must be repeated. Regrind warns after it, and goes on.
    #[schemars(regex(pattern = r"^[0-9]{4}-[0-9]{2}-[0-9]{2}$"), example = &"2027-03-31")]
    pub calibration_due: Option<String>,
    /// Timeouts and intervals.
    pub timing: TimingTable,
    /// Addresses of the blocks of its Modbus map.
    pub registers: Option<RegisterMap>,
    /// Further values that are read and recorded.
    #[schemars(length(max = 64))]
    pub signals: Vec<SignalTable>,
    /// Format of its programs.
    pub program: ProgramTable,
    /// The rotary axis of a head that tilts the wheel, if it has one.
    pub rotary: Option<RotaryTable>,
    /// Limits of the machine.
    #[schemars(extend("x-required" = true))]
    pub limits: LimitsTable,
    /// The box that the wheel's centre must not leave, in the frame of its programs, which is the model's.
    pub travel: Option<TravelTable>,
}

/// Format of the programs of a grinder.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct ProgramTable {
    /// The dialect of its control: `linuxcnc`, `fanuc`, `sinumerik`, `heidenhain`, or a file of your own, relative to
    /// this file.
    #[schemars(length(min = 1, max = 400))]
    pub dialect: String,
    /// Tolerance with which the control rounds corners by a setting of its own, for dialects that cannot express it.
    #[schemars(range(min = 0.0, max = 1000.0), example = 0.1)]
    pub controller_tolerance_um: Option<f64>,
    /// Maximum distance of arcs from the path of the wheel, at most `grinding.chord_error_um`. Default: straight lines
    /// only.
    #[schemars(range(min = 0.0001, max = 1000.0), example = 0.05)]
    pub arcs_within_um: Option<f64>,
    /// Folder in which the control finds the program of each pass, for machines whose wire does not transfer it;
    /// relative to this file.
    #[schemars(length(min = 1, max = 400), example = &"/mnt/grinder/programs")]
    pub folder: Option<String>,
}

impl Default for ProgramTable {
    fn default() -> Self {
        Self { dialect: "linuxcnc".to_owned(), controller_tolerance_um: None, arcs_within_um: None, folder: None }
    }
}

/// Letter of a rotary axis in programs.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema, PartialEq, Eq)]
#[allow(missing_docs, reason = "each is told where the key is")]
pub enum RotaryLetter {
    A,
    B,
}

/// Part of the machine that a rotary axis turns.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Eq)]
#[serde(rename_all = "kebab-case")]
pub(super) enum RotatedElement {
    /// The head with the wheel.
    #[default]
    Head,
    /// The table with the part: Regrind writes no programs for it.
    Table,
}

/// The rotary axis of a head that tilts the wheel; one axis only.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct RotaryTable {
    /// Letter of the axis: A turns about x, and B about y of the model frame.
    #[schemars(extend("x-required" = true), example = &"B")]
    pub axis: Option<RotaryLetter>,
    /// Part of the machine that the axis turns.
    pub turns: RotatedElement,
    /// Whether the scale of the axis counts left-handed.
    pub reversed: bool,
    /// Minimum angle on the scale of the axis.
    #[schemars(range(min = -360.0, max = 360.0), extend("x-required" = true), example = -60.0)]
    pub min_deg: Option<f64>,
    /// Maximum angle on the scale of the axis.
    #[schemars(range(min = -360.0, max = 360.0), extend("x-required" = true), example = 60.0)]
    pub max_deg: Option<f64>,
    /// Maximum rate, in °/min.
    #[schemars(range(min = 0.01, max = 10000000.0), extend("x-required" = true), example = 3600.0)]
    pub max_rate_deg_min: Option<f64>,
    /// Vector from the wheel's centre to the pivot with the head upright, in the model frame. With this key, programs
    /// contain the positions of the slides. Default: the control keeps the wheel's centre in place, and programs
    /// contain the positions of the wheel's centre.
    #[schemars(inner(range(min = -10000.0, max = 10000.0)), example = [0.0, 0.0, 180.0])]
    pub pivot_mm: Option<[f64; 3]>,
}

/// Timeouts and intervals.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct TimingTable {
    /// Timeout of the answer to one request.
    #[schemars(range(min = 10, max = 60000))]
    pub request_timeout_ms: u64,
    /// Number of retries of a request.
    #[schemars(range(max = 20))]
    pub retries: u8,
    /// Interval between two reads of the status.
    #[schemars(range(min = 5, max = 1000))]
    pub poll_ms: u64,
    /// Interval between two heartbeats.
    #[schemars(range(min = 20, max = 500))]
    pub heartbeat_ms: u64,
    /// Time without an answer after which the machine is lost.
    #[schemars(range(min = 200, max = 600000))]
    pub lost_after_ms: u64,
    /// Silence after a corrupt answer, in which late bytes may still arrive.
    #[schemars(range(min = 0, max = 60000))]
    pub quarantine_ms: u64,
}

/// Temperature data of a measuring machine.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct TemperatureTable {
    /// Thermal expansion of its scales in millionths per kelvin, as far as the machine does not correct it.
    #[schemars(range(min = -20.0, max = 100.0))]
    pub scale_expansion_um_m_k: f64,
    /// Standard uncertainty of the temperature of the part that the machine reports.
    #[schemars(range(min = 0.0, max = 20.0))]
    pub uncertainty_k: f64,
}

impl Default for TemperatureTable {
    fn default() -> Self {
        Self { scale_expansion_um_m_k: 0.0, uncertainty_k: 0.5 }
    }
}

/// Standard uncertainties of the errors of a measuring machine that all points share: half of the values that a
/// certificate states with k = 2. The points cannot show these errors.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct UncertaintyTable {
    /// Standard uncertainty of the lengths along its x, y and z axes, in millionths.
    #[schemars(inner(range(min = 0.0, max = 1000.0)), example = [0.5, 0.5, 0.5])]
    pub scale_ppm: [f64; 3],
    /// Standard uncertainty of the angles between its axes, xy, xz and yz.
    #[schemars(inner(range(min = 0.0, max = 10000.0)), example = [1.0, 1.0, 1.0])]
    pub squareness_urad: [f64; 3],
    /// Standard uncertainty of the error of the probe in any one direction, in addition to its radius.
    #[schemars(range(min = 0.0, max = 1000.0), example = 0.2)]
    pub probe_um: f64,
    /// Standard uncertainty of the radius of the sphere on which the probe is qualified.
    #[schemars(range(min = 0.0, max = 1000.0), example = 0.05)]
    pub reference_sphere_um: f64,
}

/// Pose of the part in the fixture: CMM coordinates are the rotated model coordinates plus the translation.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct FixtureTable {
    /// Origin of the model in the CMM frame.
    #[schemars(inner(range(min = -1e5, max = 1e5)))]
    pub translation_mm: [f64; 3],
    /// Rotations about the CMM's x axis, then its y axis, then its z axis.
    #[schemars(inner(range(min = -360.0, max = 360.0)))]
    pub rotation_deg: [f64; 3],
}

/// The sphere on which the probe is checked.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct SphereTable {
    /// Centre of the sphere in the CMM frame.
    #[schemars(extend("x-required" = true), inner(range(min = -1e5, max = 1e5)), example = [0.0, -80.0, 20.0])]
    pub centre_mm: Option<[f64; 3]>,
    /// Radius of the sphere.
    #[schemars(range(min = 0.5, max = 200.0), extend("x-required" = true), example = 12.5)]
    pub radius_mm: Option<f64>,
    /// Number of points on the sphere.
    #[schemars(range(min = 5, max = 1000))]
    pub points: u16,
}

/// A box: in the CMM frame for the probe, in the model frame for the wheel.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct TravelTable {
    /// Minimum x, y, z.
    #[schemars(extend("x-required" = true), inner(range(min = -1e5, max = 1e5)), example = [-300.0, -300.0, -200.0])]
    pub min_mm: Option<[f64; 3]>,
    /// Maximum x, y, z.
    #[schemars(extend("x-required" = true), inner(range(min = -1e5, max = 1e5)), example = [300.0, 300.0, 200.0])]
    pub max_mm: Option<[f64; 3]>,
}

/// Limits of a grinder.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct LimitsTable {
    /// Maximum feed.
    #[schemars(range(min = 0.1, max = 1000000.0), extend("x-required" = true), example = 3000.0)]
    pub max_feed_mm_min: Option<f64>,
    /// Minimum radius of a wheel.
    #[schemars(range(min = 0.1, max = 1000.0), extend("x-required" = true), example = 2.0)]
    pub min_wheel_radius_mm: Option<f64>,
    /// Maximum radius of a wheel.
    #[schemars(range(min = 0.1, max = 1000.0), extend("x-required" = true), example = 100.0)]
    pub max_wheel_radius_mm: Option<f64>,
    /// Maximum removal of one pass.
    #[schemars(range(min = 0.00001, max = 100.0), extend("x-required" = true), example = 0.2)]
    pub max_depth_mm: Option<f64>,
    /// Maximum speed of an axis.
    #[schemars(range(min = 0.01, max = 100000.0))]
    pub max_speed_mm_s: Option<f64>,
    /// Maximum acceleration of an axis.
    #[schemars(range(min = 0.1, max = 10000000.0))]
    pub max_acceleration_mm_s2: Option<f64>,
    /// Maximum jerk of an axis, the change of its acceleration over time.
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
