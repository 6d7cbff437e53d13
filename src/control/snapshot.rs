//! How a running cell is: where it stands, what it waits for, and what a person does next.

use std::fmt;

use regrind_cell::{Alarm, Device, Phase, StateName, Tolerance};
use serde::{Deserialize, Serialize};

/// How a running cell is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// Whether any machine of it is simulated.
    pub simulation: bool,
    /// What the part is called.
    #[serde(default)]
    pub part: String,
    /// Its serial number; empty where nobody knows.
    #[serde(default)]
    pub serial: String,
    /// The state, by PackML's name.
    pub state: StateName,
    /// The phase in which it is or will go on, and the step of a machine's job in it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub phase: Option<Phase>,
    /// The machines that have not confirmed that they stand, in a state that is taken for standing still.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unconfirmed: Vec<Device>,
    /// State and phase, for people.
    #[serde(rename = "words")]
    pub message: String,
    /// The verdict on the part by now: an order that is taken says nothing of it.
    #[serde(default)]
    pub verdict: PartVerdict,
    /// Counts the states since the run began, so that an order can say which one it is meant for.
    #[serde(default)]
    pub number: u64,
    /// The number of the cycle; 0 before the first.
    pub cycle: u32,
    /// How many cycles there are at most.
    #[serde(default)]
    pub max_cycles: u32,
    /// Time since the run began.
    pub seconds: f64,
    /// How far the job under way is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<JobProgress>,
    /// What the touches of the measurement under way say so far, where the CMM gives them before its end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub so_far: Option<SoFar>,
    /// What the figures of a cycle are judged by.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tolerance: Option<Tolerance>,
    /// What is known of each cycle.
    pub cycles: Vec<CycleRow>,
    /// The alarms that stand.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub alarms: Vec<Alarm>,
    /// What a machine waits for that a person or another program has to bring.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub waits_for: Vec<String>,
    /// What a person does next.
    #[serde(default)]
    pub next_step: Next,
    /// The same as a sentence, with the commands of the terminal.
    #[serde(default)]
    pub next: String,
}

/// The verdict on a part.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PartVerdict {
    /// The run goes on.
    #[default]
    Open,
    /// It is accepted.
    Accepted,
    /// The run has ended without.
    NotAccepted,
}

impl PartVerdict {
    /// Only a part that is accepted completes a run.
    pub fn at(state: StateName) -> Self {
        match state {
            StateName::Complete => Self::Accepted,
            StateName::Stopped | StateName::Aborted => Self::NotAccepted,
            _ => Self::Open,
        }
    }
}

/// What a person does next.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "step", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Next {
    /// Nothing: the cell works by itself.
    #[default]
    Nothing,
    /// Load the part, and confirm it.
    Load,
    /// See that a machine is clear of the part, and confirm it.
    #[expect(missing_docs, reason = "named for what it is")]
    SeeClear { device: Device },
    /// Bring what a machine waits for.
    #[expect(missing_docs, reason = "named for what it is")]
    Bring { what: String },
    /// See to what an alarm says; the cell goes on by itself then.
    SeeToAlarm,
    /// Do what an alarm says, then resume, or stop.
    ClearAlarm,
    /// Resume, or stop.
    ResumeOrStop,
    /// See whether a machine stands, which has not confirmed it.
    #[expect(missing_docs, reason = "named for what it is")]
    SeeWhetherItStands { device: Device },
    /// Keep away from both machines: they run their safe sequence.
    KeepAway,
    /// Use the emergency circuit of each machine that has not confirmed that it stands.
    EmergencyCircuit,
    /// Read the report: the run is over.
    ReadReport,
}

impl fmt::Display for Next {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Nothing => "nothing: the cell works by itself",
            Self::Load => {
                "load the part, clamp it, see that wheel and probe are clear of it; then: regrind confirm loaded"
            }
            Self::SeeClear { device } => {
                let name = device.to_string().to_lowercase();
                return write!(
                    f,
                    "see that the {device} is clear of the part; then: regrind confirm clear --machine {name}"
                );
            }
            Self::Bring { what } => what,
            Self::SeeToAlarm => "see to what the alarm says; the cell goes on by itself when that is gone",
            Self::ClearAlarm => "do what the alarm says; then: regrind resume, or regrind stop",
            Self::ResumeOrStop => "regrind resume goes on, regrind stop ends the run",
            Self::SeeWhetherItStands { device } => {
                let name = device.to_string().to_lowercase();
                return write!(
                    f,
                    "see whether the {device} stands; then: regrind resume, which asks it what became of its job; where it cannot \
                     tell: regrind confirm over --machine {name} --evidence \"what you saw\""
                );
            }
            Self::KeepAway => "keep away from both machines: they run their safe sequence",
            Self::EmergencyCircuit => "use the emergency circuit of each machine that has not confirmed that it stands",
            Self::ReadReport => "the run is over: see its report.html",
        })
    }
}

/// How far a job is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct JobProgress {
    /// The machine that is at it.
    pub device: Device,
    /// Points of a measurement; of a pass, as many parts of the path as the machine counts.
    pub done: u32,
    /// How many there are.
    pub total: u32,
    /// Least and most time that it will still take, in seconds: at the pace since it began to move, and at that of late. None before
    /// there is a pace, and while it stands.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub left_s: Option<[f64; 2]>,
}

/// What the touches of a measurement say that still runs: preliminary. They are counted from where the plan has the part, so that its place
/// on the table is in them; no gate has seen them, and nothing is judged by them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SoFar {
    /// How many touches of the part have come.
    pub touched: u32,
    /// The quadratic mean of their deviations, along the normals; positive where material stands proud.
    pub rms_um: f64,
    /// The least deviation.
    pub least_um: f64,
    /// The largest.
    pub most_um: f64,
}

/// A cycle in the table at the end of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct CycleRow {
    pub cycle: u32,
    /// Of all points that were used.
    pub pv_um: f64,
    /// As it is judged.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub judged_pv_um: Option<f64>,
    /// Of all points that were used.
    pub rms_um: f64,
    /// As it is judged.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub judged_rms_um: Option<f64>,
    pub points: u32,
    pub outliers: u32,
    /// Height of the surface that was wanted over the nominal one.
    pub level_um: f64,
}

impl CycleRow {
    /// Returns PV and RMS as they are judged; those of the points where nobody said which.
    pub fn judged_um(&self) -> [f64; 2] {
        [self.judged_pv_um.unwrap_or(self.pv_um), self.judged_rms_um.unwrap_or(self.rms_um)]
    }
}
