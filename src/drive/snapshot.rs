//! Snapshot of the cell: its state, what it waits for, and the next action of a person.

use regrind_control::{Next, PartVerdict, Snapshot};

use super::Drive;
use crate::cell::{Cell, Phase, State};

impl Drive {
    /// Returns the snapshot of the cell for the control socket.
    pub(super) fn snapshot(&self) -> Snapshot {
        let state = self.cell.state();
        let waits_for: Vec<String> = match state.phase().and_then(Phase::job) {
            Some((device, _)) => self.notes[device as usize].clone(),
            None => Vec::new(),
        };
        let next_step = next(&self.cell, &waits_for);
        Snapshot {
            simulation: self.task.simulation,
            part: self.task.part.clone(),
            serial: self.serial.clone(),
            state: state.name(),
            phase: state.phase(),
            unconfirmed: self.cell.unconfirmed(),
            message: self.cell.in_words(),
            verdict: PartVerdict::at(state.name()),
            number: self.states,
            cycle: self.cell.cycle(),
            max_cycles: self.cell.plan().max_cycles,
            seconds: self.now().as_secs_f64(),
            progress: self.pace.progress(),
            so_far: self.touching.so_far(),
            tolerance: Some(self.cell.plan().tolerance),
            cycles: self.cycles.rows(&self.cell.plan().tolerance),
            alarms: self.cell.alarms().cloned().collect(),
            next: next_step.to_string(),
            next_step,
            waits_for,
        }
    }
}

/// Returns the next action of a person.
fn next(cell: &Cell, waits_for: &[String]) -> Next {
    if let (State::Execute(_), Some(device)) = (cell.state(), cell.asks_whether_clear_of()) {
        return Next::SeeClear { device };
    }
    let alarms = cell.alarms().next().is_some();
    match (cell.state(), &cell.unconfirmed()[..], waits_for) {
        (State::Execute(Phase::Load), ..) => Next::Load,
        (State::Aborted, [_, ..], _) => Next::EmergencyCircuit,
        (State::Held(_), [device, ..], _) => Next::SeeWhetherItStands { device: *device },
        (State::Held(_), ..) if alarms => Next::ClearAlarm,
        (State::Held(_), ..) => Next::ResumeOrStop,
        (State::Suspended(_), ..) => Next::SeeToAlarm,
        (State::Aborting, ..) => Next::KeepAway,
        (State::Stopped | State::Aborted | State::Complete, ..) => Next::ReadReport,
        (_, _, [first, ..]) => Next::Bring { what: first.clone() },
        _ => Next::Nothing,
    }
}
