//! Notes: what people confirmed, and what machines and programs reported besides events.

use regrind_cell::{AlarmId, Device};
use regrind_formats::result::Coordinates;
use regrind_journal::or_none;
use serde::{Deserialize, Serialize};

/// Confirmation of a person about a machine that cannot report its own state.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "confirmed", rename_all = "snake_case")]
pub enum Confirmation {
    /// The machine has started its job.
    Started {
        /// Machine.
        device: Device,
        /// First digits of the identity of the map, as the person typed them.
        #[serde(default)]
        map: Option<String>,
    },
    /// The machine has ended its job and is clear of the part.
    Done {
        /// Machine.
        device: Device,
        /// First digits of the identity of the map, as the person typed them.
        #[serde(default)]
        map: Option<String>,
        /// Path of the result of a measurement.
        #[serde(default)]
        file: Option<String>,
    },
    /// The machine is at rest.
    Still {
        /// Machine.
        device: Device,
    },
}

impl Confirmation {
    /// Returns the machine, the name of the confirmed state, the digits of the map and the path of the file.
    pub fn parts(&self) -> (Device, &'static str, Option<&str>, Option<&str>) {
        match self {
            Self::Started { device, map } => (*device, "started", map.as_deref(), None),
            Self::Done { device, map, file } => (*device, "done", map.as_deref(), file.as_deref()),
            Self::Still { device } => (*device, "still", None, None),
        }
    }
}

/// Messages of a machine for people.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MachineNotes {
    /// Machine.
    pub device: Device,
    /// Messages that were not recorded before.
    pub notes: Vec<String>,
}

/// Remark for the record.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Remark {
    /// Text.
    pub remark: String,
    /// Alarm that the person acknowledges with this remark.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub alarm: Option<AlarmId>,
}

/// Note with the report of the grinder about a pass.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PassNote {
    /// Figures of the pass.
    pub pass_record: PassFigures,
}

/// Figures of a pass; each is `None` if the grinder does not report it, or if it cannot be read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct PassFigures {
    /// Path travelled, in mm.
    #[serde(deserialize_with = "or_none")]
    pub path_mm: Option<f64>,
    /// Volume removed, in mm³.
    #[serde(deserialize_with = "or_none")]
    pub removed_mm3: Option<f64>,
    /// Largest depth removed, in mm.
    #[serde(rename = "deepest_mm", deserialize_with = "or_none")]
    pub max_depth_mm: Option<f64>,
    /// Share of the path in the air, 0 to 1.
    #[serde(deserialize_with = "or_none")]
    pub idle_share: Option<f64>,
    /// Mean spindle load; 1 is full load.
    #[serde(deserialize_with = "or_none")]
    pub spindle_load: Option<f64>,
    /// Radius of the wheel, in mm.
    #[serde(deserialize_with = "or_none")]
    pub wheel_radius_mm: Option<f64>,
    /// Temperature of the part, in °C.
    #[serde(deserialize_with = "or_none")]
    pub temperature_c: Option<f64>,
    /// Duration, in s.
    #[serde(deserialize_with = "or_none")]
    pub duration_s: Option<f64>,
}

/// Note with the transfer of the points of a measurement.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TransferNote {
    /// Transfer.
    pub transfer: Transfer,
}

/// Transfer of the points of a measurement.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Transfer {
    /// Number of points.
    pub points: usize,
    /// Duration, in s.
    pub seconds: f64,
    /// Duration for each point, in ms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ms_per_point: Option<f64>,
    /// Meaning of the coordinates. `None` in records of early versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub coordinates: Option<Coordinates>,
}

/// Step that a person ordered to bring a machine to idle.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecoveryOrder {
    /// Name of the step: STOP, ACKNOWLEDGE or CLEAR.
    pub recover: String,
    /// Machine.
    pub device: Device,
    /// State of the machine that the person saw.
    #[serde(default)]
    pub seen: Option<String>,
}
