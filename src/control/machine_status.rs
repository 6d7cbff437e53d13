//! Status of a machine of the cell, with the course of its values, for display.

use regrind_cell::Device;
use serde::{Deserialize, Serialize};

/// Status of a machine as its last answer showed it, with the course of its values since the program began.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MachineStatus {
    /// Machine.
    pub device: Device,
    /// Name of the machine in messages, with its address.
    pub name: String,
    /// Name of its state in the protocol, such as `EXECUTE`; `None` before its first answer.
    pub state: Option<String>,
    /// True if the last request was answered.
    pub is_connected: bool,
    /// Number of times that the link was lost.
    pub lost_links: u32,
    /// Time since the last answer, in s; `None` before the first one.
    pub answer_age_s: Option<f64>,
    /// True if the machine is in automatic mode; `None` if it does not report this.
    pub is_automatic: Option<bool>,
    /// True if it is clear of the part; `None` if it does not report this.
    pub is_clear: Option<bool>,
    /// True if it has air, coolant and other supplies; `None` if it does not report this.
    pub has_supplies: Option<bool>,
    /// Values that the machine reports, and the time that it takes to answer.
    pub values: Vec<MachineValue>,
}

/// Value of a machine with its course.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MachineValue {
    /// Meaning of the value.
    pub kind: ValueKind,
    /// Name in the cell file; empty unless the value is a signal.
    pub name: String,
    /// Unit of the value.
    pub unit: String,
    /// Minimum and maximum allowed value; `None` if the cell file states none.
    pub range: Option<[f64; 2]>,
    /// Last value; `None` if the machine gave no number.
    pub value: Option<f64>,
    /// Course of the value, from the oldest sample on. A sample is the age of its beginning in s, and the minimum and
    /// maximum until the next sample begins.
    pub samples: Vec<[f64; 3]>,
}

/// Meaning of a value of a machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ValueKind {
    /// Time between a status request and its answer, in ms.
    AnswerTime,
    /// Temperature of the part or of the machine, in °C.
    Temperature,
    /// Signal that the cell file names.
    Signal,
}
