//! How a running cell is, as the control socket and the terminal tell it: where it stands, what it waits for, and what a person does next.

use serde::{Deserialize, Serialize};

use super::Drive;
use super::notice::CycleRow;
use super::pace::JobProgress;
use crate::cell::{Alarm, Cell, Device, Phase, State, StateName, Tolerance};

/// How a running cell is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// Whether any machine of it is simulated.
    pub simulation: bool,
    /// What the part is called.
    #[serde(default)]
    pub part: String,
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
    /// What a person does next, as a sentence.
    #[serde(default)]
    pub next: String,
}

impl Drive {
    /// How the cell is, as the control socket tells it.
    pub(super) fn snapshot(&self) -> Snapshot {
        let state = self.cell.state();
        let waits_for: Vec<String> = match state.phase().and_then(Phase::job) {
            Some((device, _)) => self.notes[device as usize].clone(),
            None => Vec::new(),
        };
        Snapshot {
            simulation: self.task.simulation,
            part: self.task.part.clone(),
            state: state.name(),
            phase: state.phase(),
            unconfirmed: self.cell.unconfirmed(),
            message: self.cell.in_words(),
            number: self.states,
            cycle: self.cell.cycle(),
            max_cycles: self.cell.plan().max_cycles,
            seconds: self.now().as_secs_f64(),
            progress: self.pace.progress(),
            tolerance: Some(self.cell.plan().tolerance),
            cycles: self.cycles.rows(&self.cell.plan().tolerance),
            alarms: self.cell.alarms().cloned().collect(),
            next: next(&self.cell, &waits_for),
            waits_for,
        }
    }
}

/// Says what a person does next.
fn next(cell: &Cell, waits_for: &[String]) -> String {
    if let (State::Execute(_), Some(device)) = (cell.state(), cell.asks_whether_clear_of()) {
        let name = device.to_string().to_lowercase();
        return format!("see that the {device} is clear of the part; then: regrind confirm clear --machine {name}");
    }
    let alarms = cell.alarms().next().is_some();
    match (cell.state(), &cell.unconfirmed()[..], waits_for) {
        (State::Execute(Phase::Load), ..) => {
            "load the part, clamp it, see that wheel and probe are clear of it; then: regrind confirm loaded".to_owned()
        }
        (State::Aborted, [_, ..], _) => {
            "use the emergency circuit of each machine that has not confirmed that it stands".to_owned()
        }
        (State::Held(_), [device, ..], _) => format!(
            "see whether the {device} stands; then: regrind resume, which asks it what became of its job; where it cannot tell: \
             regrind confirm over --machine {} --evidence \"what you saw\"",
            device.to_string().to_lowercase()
        ),
        (State::Held(_), ..) if alarms => "do what the alarm says; then: regrind resume, or regrind stop".to_owned(),
        (State::Held(_), ..) => "regrind resume goes on, regrind stop ends the run".to_owned(),
        (State::Suspended(_), ..) => {
            "see to what the alarm says; the cell goes on by itself when that is gone".to_owned()
        }
        (State::Aborting, ..) => "keep away from both machines: they run their safe sequence".to_owned(),
        (State::Stopped | State::Aborted | State::Complete, ..) => "the run is over: see its report.html".to_owned(),
        (_, _, [first, ..]) => first.clone(),
        _ => "nothing: the cell works by itself".to_owned(),
    }
}
