//! Ends of a run: accepted, stopped in order, or aborted by the safe sequence.

use super::alarm::AlarmId;
use super::cell::Cell;
use super::command::{Command, Ending};
use super::state::{Device, JobStep, Phase, State};

use State::{Aborted, Aborting, Complete, Stopped, Stopping};

impl Cell {
    /// Ends the run in order. There are three cases:
    ///
    /// - A machine may have an unfinished job: the cell sends STOP and waits for the end of the job.
    /// - A machine has a result: the cell asks the machine to discard the result.
    /// - Neither: the run ends at once.
    ///
    /// `reason` is the reason that is recorded with the end of the run. `judged_out` is true if the run ends because
    /// the part is not accepted.
    pub(super) fn stop(&mut self, reason: &str, judged_out: bool) {
        reason.clone_into(&mut self.ending_reason);
        self.not_accepted = judged_out;
        let job = self.state.phase().and_then(Phase::job);
        self.stopping_machine = job.map(|(device, _)| device);
        match job {
            Some((device, JobStep::Prepare | JobStep::Start | JobStep::Run | JobStep::Reconcile)) => {
                self.enter_state(Stopping);
                self.push(Command::StopMachine { device });
            }
            Some((device, JobStep::Collect | JobStep::Qualify | JobStep::Acknowledge | JobStep::Discard)) => {
                self.enter_state(Stopping);
                self.push(Command::Acknowledge { device });
            }
            _ => self.finish_stopped(),
        }
    }

    pub(super) fn finish_stopped(&mut self) {
        self.enter_state(Stopped);
        let (cycle, reason) = (self.cycle, std::mem::take(&mut self.ending_reason));
        let (judged_out, ordered) = (self.not_accepted, self.end_ordered);
        let ending =
            if judged_out { Ending::NotAccepted { cycle, reason } } else { Ending::Stopped { cycle, reason, ordered } };
        self.push(Command::Finish(ending));
    }

    /// Begins the safe sequence: sends ABORT to every machine that was connected in this run. When a machine confirms,
    /// the cell checks whether this machine is clear of the part. If no machine was connected, the run ends at once.
    /// `reason` is the reason that is recorded with the end of the run.
    pub(super) fn abort(&mut self, reason: &str) {
        reason.clone_into(&mut self.ending_reason);
        self.abort_repeated = false;
        for known in &mut self.machines {
            (known.abort_confirmed, known.clear) = (false, false);
        }
        self.enter_state(Aborting);
        self.abort_unconfirmed();
        if self.machines.iter().all(|known| !known.was_connected) {
            self.finish_aborted(true);
        }
    }

    pub(super) fn abort_unconfirmed(&mut self) {
        for device in self.unconfirmed_aborts() {
            self.push(Command::AbortMachine { device });
        }
    }

    /// Connects the machines of this run and begins the safe sequence (ABORT) again. Called after a restart of this
    /// program that happened during an abort or a stop.
    pub(super) fn restart_abort(&mut self) {
        for device in Device::BOTH {
            if self.machine(device).was_connected {
                self.push(Command::Connect { device });
            }
        }
        let reason = std::mem::take(&mut self.ending_reason);
        self.abort(&reason);
    }

    pub(super) fn on_abort_confirmed(&mut self, device: Device) {
        self.machine_mut(device).abort_confirmed = true;
        self.verify_clear(device);
    }

    /// Handles the last check at the end of a run: is the machine `device` clear of the part? `clear` is the result,
    /// and `message` is the text for the alarm. Raises an alarm if the machine is not clear. In both cases the check of
    /// this machine is over. The run ends when the checks of all connected machines are over.
    pub(super) fn on_final_clearance(&mut self, device: Device, clear: bool, message: &str) {
        if !clear {
            self.raise(AlarmId::NotClear, &format!("{device}, {message}"));
        }
        self.machine_mut(device).clear = true;
        if self.machines.iter().any(|known| known.was_connected && !known.clear) {
            return;
        }
        match self.state {
            Aborting => self.finish_aborted(true),
            _ => self.finish_complete(),
        }
    }

    pub(super) fn finish_aborted(&mut self, confirmed: bool) {
        self.enter_state(Aborted);
        let (cycle, reason) = (self.cycle, std::mem::take(&mut self.ending_reason));
        self.push(Command::Finish(Ending::Aborted { cycle, confirmed, reason }));
    }

    pub(super) fn finish_complete(&mut self) {
        self.enter_state(Complete);
        let (cycle, reason) = (self.cycle, std::mem::take(&mut self.ending_reason));
        self.push(Command::Finish(Ending::Accepted { cycle, reason }));
    }
}
