//! State of a running cell: its phase, what it waits for, and the next step of a person.

use std::fmt;

use regrind_cell::{Alarm, CycleRow, Device, Phase, StateName, Tolerance};
use regrind_formats::operator_step::OperatorStep;
use serde::{Deserialize, Serialize};

/// State of a running cell at one time.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// True if any machine of the cell is simulated.
    pub simulation: bool,
    /// Name of the part.
    #[serde(default)]
    pub part: String,
    /// Serial number of the part; empty if unknown.
    #[serde(default)]
    pub serial: String,
    /// State, by its PackML name.
    pub state: StateName,
    /// Phase in which the cell is or will continue, and the step of a machine's job in it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub phase: Option<Phase>,
    /// Machines that have not confirmed that they are at rest, in a state where the cell is considered to be at rest.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unconfirmed: Vec<Device>,
    /// State and phase, for people.
    #[serde(rename = "words")]
    pub message: String,
    /// Current verdict on the part. The acceptance of an order has no effect on it.
    #[serde(default)]
    pub verdict: PartVerdict,
    /// Counter of the states since the run began, so that an order can name the state it is meant for.
    #[serde(rename = "number", default)]
    pub state_number: u64,
    /// Number of the cycle; 0 before the first.
    pub cycle: u32,
    /// Maximum number of the cycle. It is one more than the passes if the run begins with a measurement.
    #[serde(default)]
    pub max_cycles: u32,
    /// Time since the run began, in seconds.
    #[serde(rename = "seconds")]
    pub elapsed_s: f64,
    /// Progress of the current job.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<JobProgress>,
    /// Preliminary result of the current measurement, if the CMM reports touches before the end.
    #[serde(rename = "so_far", default, skip_serializing_if = "Option::is_none")]
    pub preview: Option<PreviewStatistics>,
    /// Tolerance against which the figures of a cycle are judged.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tolerance: Option<Tolerance>,
    /// Results of each cycle.
    pub cycles: Vec<CycleRow>,
    /// Active alarms.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub alarms: Vec<Alarm>,
    /// Items that a machine waits for, which a person or another program must provide.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub waits_for: Vec<String>,
    /// Step that a machine asks of a person, if a person operates it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub operator_step: Option<OperatorStep>,
    /// Next step of a person.
    #[serde(default)]
    pub next_step: NextStep,
    /// The next step as a sentence, with the commands of the terminal.
    #[serde(default)]
    pub next: String,
}

/// Verdict on a part.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PartVerdict {
    /// No verdict yet: the run continues.
    #[default]
    Open,
    /// The part is accepted.
    Accepted,
    /// The run has ended and the part is not accepted.
    NotAccepted,
}

impl PartVerdict {
    /// Returns the verdict on the part that follows from the state of the cell: accepted after Complete, not accepted
    /// after Stopped or Aborted, otherwise open.
    pub fn from_state(state: StateName) -> Self {
        match state {
            StateName::Complete => Self::Accepted,
            StateName::Stopped | StateName::Aborted => Self::NotAccepted,
            _ => Self::Open,
        }
    }
}

/// Next step of a person.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "step", rename_all = "snake_case")]
#[non_exhaustive]
pub enum NextStep {
    /// No action needed.
    #[default]
    Nothing,
    /// Load the part, and confirm it.
    Load,
    /// Check that a machine is clear of the part, and confirm it.
    #[expect(missing_docs, reason = "named for what it is")]
    SeeClear { device: Device },
    /// Do the step that a machine asks for, [`Snapshot::operator_step`].
    #[expect(missing_docs, reason = "named for what it is")]
    AtMachine { device: Device },
    /// Provide the item that a machine waits for.
    #[expect(missing_docs, reason = "named for what it is")]
    Bring { what: String },
    /// Remove the cause of an alarm; the cell then continues by itself.
    SeeToAlarm,
    /// Do what the alarm requires, then resume or stop.
    ClearAlarm,
    /// Resume or stop.
    ResumeOrStop,
    /// Check whether a machine is at rest, because it has not confirmed this.
    #[expect(missing_docs, reason = "named for what it is")]
    SeeWhetherItStands { device: Device },
    /// Keep away from both machines: they run their safe sequence.
    KeepAway,
    /// Use the emergency circuit of each machine that has not confirmed that it is at rest.
    EmergencyCircuit,
    /// Read the report: the run is over.
    ReadReport,
}

impl fmt::Display for NextStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Nothing => "no action needed",
            Self::Load => {
                "load and clamp the part; check that wheel and probe are clear of the part; then: regrind confirm \
                 loaded"
            }
            Self::SeeClear { device } => {
                let name = device.to_string().to_lowercase();
                return write!(
                    f,
                    "check that the {device} is clear of the part; then: regrind confirm clear --machine {name}"
                );
            }
            Self::AtMachine { device } => return write!(f, "do what the {device} asks for"),
            Self::Bring { what } => what,
            Self::SeeToAlarm => "remove the cause of the alarm; the cell then continues by itself",
            Self::ClearAlarm => "follow the steps of the alarm; then: regrind resume, or regrind stop",
            Self::ResumeOrStop => "to continue: regrind resume; to end the run: regrind stop",
            Self::SeeWhetherItStands { device } => {
                let name = device.to_string().to_lowercase();
                return write!(
                    f,
                    "check that the {device} is at rest; then: regrind resume. The cell asks the machine for the state \
                     of its job. If the machine cannot answer, declare the job ended with the command: regrind confirm \
                     over --machine {name} --evidence \"what you saw\""
                );
            }
            Self::KeepAway => "keep away from both machines: they run their safe sequence",
            Self::EmergencyCircuit => {
                "use the emergency circuit of each machine that has not yet confirmed its standstill"
            }
            Self::ReadReport => "the run is over: read its report.html",
        })
    }
}

/// Progress of a job.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct JobProgress {
    /// Machine that performs the job.
    pub device: Device,
    /// Completed points of a measurement, or completed parts of the path of a pass, in the unit in which the machine
    /// counts.
    pub done: u32,
    /// Total number of points or parts.
    pub total: u32,
    /// Minimum and maximum remaining time, in seconds. The bounds come from the average pace since the machine began to
    /// move and from the recent pace. `None` before a pace is known, and while the machine is at rest.
    #[serde(rename = "left_s", default, skip_serializing_if = "Option::is_none")]
    pub remaining_s: Option<[f64; 2]>,
}

/// Preliminary statistics of the touches of a measurement that still runs. Deviations refer to the planned position of
/// the part, so they include its placement error on the table. No gate has checked them, and no verdict uses them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PreviewStatistics {
    /// Number of touches of the part so far.
    #[serde(rename = "touched")]
    pub touch_count: u32,
    /// Root mean square of their deviations along the normals, in µm.
    pub rms_um: f64,
    /// Minimum deviation, in µm; positive if material is above the surface.
    #[serde(rename = "least_um")]
    pub min_um: f64,
    /// Maximum deviation, in µm; positive if material is above the surface.
    #[serde(rename = "most_um")]
    pub max_um: f64,
}
