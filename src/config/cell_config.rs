//! Checked settings of a cell.

use std::path::PathBuf;

use super::tables::RotaryLetter;
use crate::device::{RegisterMap, Signal, Timing, Wire};
use crate::formats::gcode::Dialect;
use crate::geometry::{Point, Pose};
use crate::model::MachineUncertainty;

/// Checked configuration of a cell.
#[derive(Clone, Debug)]
pub struct CellConfig {
    /// Name of the cell.
    pub name: String,
    /// True if the machines are simulated. Every record is then marked SIMULATION.
    pub simulated: bool,
    /// True in a rehearsal: people act as the machines, and no part exists. Records are then marked like those of
    /// simulated machines, and the plan itself is accepted as a measurement. The caller that begins the run sets this;
    /// the cell file has no key for it.
    pub rehearsal: bool,
    /// True if a run needs a key that signs its record.
    pub require_signature: bool,
    /// The measuring machine.
    pub cmm: CmmConfig,
    /// The grinder.
    pub grinder: GrinderConfig,
    pub(super) path: PathBuf,
    pub(super) text: String,
    pub(super) source_sha256: [u8; 32],
    /// Notes on keys that have a new name.
    pub(super) renamed: Vec<String>,
}

/// A measuring machine.
#[derive(Clone, Debug, PartialEq)]
pub struct CmmConfig {
    /// Connection to the machine.
    pub link: LinkConfig,
    /// Pose of the part in the fixture. It maps model coordinates to CMM coordinates.
    pub fixture_cmm_from_model: Pose,
    /// Thermal expansion of its scales in µm/(m K), as far as the machine does not compensate it.
    pub scale_expansion_um_m_k: f64,
    /// Standard uncertainty of the part temperature that the machine reports, in K.
    pub temperature_uncertainty_k: f64,
    /// Standard uncertainties of the machine errors that are common to all points.
    pub uncertainty: MachineUncertainty,
    /// Reference sphere on which the probe is checked.
    pub reference_sphere: Option<ReferenceSphere>,
    /// Travel limits of the probe's centre.
    pub travel: Option<TravelLimits>,
}

/// A grinder.
#[derive(Clone, Debug, PartialEq)]
pub struct GrinderConfig {
    /// Connection to the machine.
    pub link: LinkConfig,
    /// Limits of the machine.
    pub limits: GrinderLimits,
    /// Format and settings of its programs.
    pub program: ProgramConfig,
    /// The rotary axis of its head, if it has one.
    pub rotary: Option<RotaryConfig>,
}

/// Rotary axis of a head that tilts the wheel, in units of its own scale. [`crate::compensation::path::RotaryAxis`] is
/// the same axis in the form that paths use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotaryConfig {
    /// Letter of the axis in programs: A turns about x, B about y.
    pub letter: RotaryLetter,
    /// True if the scale counts left-handed.
    pub reversed: bool,
    /// Minimum and maximum angle on its scale.
    pub range_deg: [f64; 2],
    /// Maximum rate.
    pub max_rate_deg_min: f64,
    /// Vector from the wheel's centre to the pivot with the head upright. `None` if the control itself keeps the centre
    /// in place.
    pub pivot_mm: Option<[f64; 3]>,
}

/// Format and settings of the programs of a grinder.
#[derive(Clone, Debug, PartialEq)]
pub struct ProgramConfig {
    /// Dialect of its control.
    pub dialect: Dialect,
    /// One note for each key that the dialect file has under its old name.
    pub dialect_renamed_keys: Vec<String>,
    /// Tolerance with which the control rounds corners by its own setting, if known.
    pub controller_tolerance_mm: Option<f64>,
    /// Maximum distance of an arc from the path. `None` if programs have lines only.
    pub arcs_within_mm: Option<f64>,
    /// Folder in which the control finds the program of each pass.
    pub folder: Option<PathBuf>,
}

/// Connection to a machine.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkConfig {
    /// Wire to the machine.
    pub wire: Wire,
    /// Timeouts and polling times.
    pub timing: Timing,
    /// Addresses of the blocks of its Modbus map.
    pub registers: RegisterMap,
    /// Further values that are read and recorded.
    pub signals: Vec<Signal>,
    /// Name that the machine must report in its identity block.
    pub expected_name: Option<String>,
    /// Day on which the calibration of the machine must be repeated, `2027-03-31`.
    pub calibration_due: Option<String>,
}

/// Reference sphere on which the probe is checked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReferenceSphere {
    /// Centre in the CMM frame.
    pub centre: Point,
    /// Radius.
    pub radius_mm: f64,
    /// Number of points that the probe touches on the sphere.
    pub points: u16,
}

/// Box of allowed positions: in the CMM frame for the probe, in the model frame for the wheel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TravelLimits {
    /// Minimum x, y, z.
    pub min_mm: [f64; 3],
    /// Maximum x, y, z.
    pub max_mm: [f64; 3],
}

/// Limits of a grinder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GrinderLimits {
    /// Maximum feed.
    pub max_feed_mm_min: f64,
    /// Minimum and maximum radius of a wheel.
    pub wheel_radius_mm: [f64; 2],
    /// Maximum depth that one pass removes.
    pub max_depth_mm: f64,
    /// Maximum speed of an axis, if known.
    pub max_speed_mm_s: Option<f64>,
    /// Maximum acceleration of an axis, if known.
    pub max_acceleration_mm_s2: Option<f64>,
    /// Maximum jerk of an axis, if known.
    pub max_jerk_mm_s3: Option<f64>,
    /// Travel limits of the wheel's centre in the model frame, if known.
    pub travel: Option<TravelLimits>,
}
