//! Snapshot of the cell: its state, what it waits for, and the next action of a person.

use regrind_control::{NextStep, PartVerdict, Snapshot};

use super::Drive;
use crate::cell::{Cell, Device, Phase, State};
use crate::formats::operator_step::{OperatorStep, run_argument};

impl Drive {
    /// Returns the present status of the run for the clients of the control socket: for example the state of the cell,
    /// the progress of the job, the alarms, and the next action of a person.
    pub(super) fn snapshot(&self) -> Snapshot {
        let state = self.cell.state();
        let step = self.operator_step();
        let step_lines = step.as_ref().map_or_else(Vec::new, |(device, step)| {
            step.lines(&device.to_string().to_lowercase(), &run_argument(&self.context.folder))
        });
        let waits_for: Vec<String> = match state.phase().and_then(Phase::job) {
            Some((device, _)) => {
                let notes = self.machines.notes[device as usize].iter();
                notes.filter(|note| !step_lines.contains(note)).cloned().collect()
            }
            None => Vec::new(),
        };
        let next_step = next_step(&self.cell, step.as_ref().map(|(device, _)| *device), &waits_for);
        let next = match &next_step {
            NextStep::AtMachine { .. } => step_lines.join("\n"),
            other => other.to_string(),
        };
        Snapshot {
            simulation: self.task.simulation,
            part: self.task.part.clone(),
            serial: self.context.serial.clone(),
            state: state.name(),
            phase: state.phase(),
            unconfirmed: self.cell.unconfirmed(),
            message: self.cell.in_words(),
            verdict: PartVerdict::from_state(state.name()),
            state_number: self.display.state_changes,
            cycle: self.cell.cycle(),
            max_cycles: self.cell.plan().max_cycle_number(),
            elapsed_s: self.now().as_secs_f64(),
            progress: self.display.progress_estimator.progress(),
            preview: self.display.preview_statistics.statistics(),
            tolerance: Some(self.cell.plan().tolerance),
            cycles: self.cycles.rows(&self.cell.plan().tolerance),
            alarms: self.cell.alarms().cloned().collect(),
            next,
            next_step,
            operator_step: step.map(|(_, step)| step),
            waits_for,
        }
    }

    /// Returns the step that a machine asks of a person now, with this machine. While the cell stops, each machine can
    /// ask for a step; the step of the CMM is then the first one.
    fn operator_step(&self) -> Option<(Device, OperatorStep)> {
        let of = |device: Device| Some((device, self.machines.steps[device as usize].clone()?));
        match self.cell.state().phase().and_then(Phase::job) {
            Some((device, _)) => of(device),
            None => Device::BOTH.into_iter().find_map(of),
        }
    }
}

/// Returns the next action that the cell needs from a person. `asks` is the machine that asks a person for a step.
/// `waits_for` are the texts in which the machine of the current job states what it waits for. If no other action is
/// needed, the action is the first of these texts. If there is also no such text, no action is needed.
fn next_step(cell: &Cell, asks: Option<Device>, waits_for: &[String]) -> NextStep {
    if let (State::Execute(_), Some(device)) = (cell.state(), cell.clear_confirmation_device()) {
        return NextStep::SeeClear { device };
    }
    let alarms = cell.alarms().next().is_some();
    match (cell.state(), &cell.unconfirmed()[..], waits_for) {
        (State::Execute(Phase::Load), ..) => NextStep::Load,
        (State::Aborted, [_, ..], _) => NextStep::EmergencyCircuit,
        (State::Held(_), [device, ..], _) => NextStep::SeeWhetherItStands { device: *device },
        (State::Held(_), ..) if alarms => NextStep::ClearAlarm,
        (State::Held(_), ..) => NextStep::ResumeOrStop,
        (State::Suspended(_), ..) => NextStep::SeeToAlarm,
        // A machine that a person operates has no safe sequence of its own.
        (State::Aborting, ..) if asks.is_none() => NextStep::KeepAway,
        (State::Stopped | State::Aborted | State::Complete, ..) => NextStep::ReadReport,
        (_, _, waits_for) => match (asks, waits_for) {
            (Some(device), _) => NextStep::AtMachine { device },
            (None, [first, ..]) => NextStep::Bring { what: first.clone() },
            (None, []) => NextStep::Nothing,
        },
    }
}
