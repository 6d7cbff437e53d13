//! Job of a machine: from the check that the other machine is clear, over START, to the acknowledgement of the result.

use std::time::Duration;

use super::alarm::AlarmId;
use super::cell::{Cell, SuspensionCause};
use super::command::Command;
use super::event::{JobResult, MachineRequest, Reconciliation};
use super::phase_queries::{restart_phase, running_device};
use super::state::{Device, JobStep, Phase, State};

use Phase::{Grind, Measure, Register, Transfer};
use State::{Execute, Held, Holding, Stopping, Suspended, Suspending, Unholding, Unsuspending};

impl Cell {
    pub(super) fn verify_clear(&mut self, device: Device) {
        let known = self.machine_mut(device);
        (known.clear, known.clear_requested) = (false, false);
        self.push(Command::VerifyClear { device });
    }

    /// Handles the report that the machine `device` is clear of the part. `phase` was waiting for this report. If
    /// `phase` is part of a job, the cell continues with the preparation of this job. If `phase` is `Transfer`, the
    /// cell continues with the measurement. A cell that is being held becomes held at this point.
    pub(super) fn on_cleared(&mut self, phase: Phase, device: Device) {
        let known = self.machine_mut(device);
        (known.clear, known.clear_requested) = (true, false);
        self.advance(phase.job().map_or(Measure(JobStep::Send), |(job, _)| Phase::from_job(job, JobStep::Prepare)));
    }

    /// Handles the report that the machine `device` has no signal that shows whether it is clear of the part. `phase`
    /// is waiting for this information.
    ///
    /// If a person has confirmed that the machine is clear, and it was not started since then, it counts as clear.
    /// Otherwise the cell asks a person. A cell that is not in the state `Execute` becomes held instead.
    pub(super) fn on_clear_unknown(&mut self, phase: Phase, device: Device) {
        if self.machine(device).clear_confirmed {
            return self.on_cleared(phase, device);
        }
        match self.state {
            Execute(_) => {
                self.machine_mut(device).clear_requested = true;
                self.enter_state(self.state);
                self.push(Command::AskWhetherClear { device });
            }
            _ => self.enter_state(Held(restart_phase(phase))),
        }
    }

    pub(super) fn on_clear_confirmed(&mut self, device: Device) {
        self.machine_mut(device).clear_confirmed = true;
        if let Execute(phase) = self.state
            && self.is_asking_whether_clear(phase)
            && phase.device_awaited_clear() == Some(device)
        {
            self.on_cleared(phase, device);
        }
    }

    /// Returns true if `phase` waits until a machine is clear of the part, and the cell is asking a person whether this
    /// is so.
    pub(super) fn is_asking_whether_clear(&self, phase: Phase) -> bool {
        phase.device_awaited_clear().is_some_and(|device| self.machine(device).clear_requested)
    }

    /// Sends START to the machine `device` if the other machine is known to be clear of the part. The other machine was
    /// checked at the step Clear of this job. If it is no longer known to be clear, does not send START, raises an
    /// alarm and holds the cell.
    pub(super) fn start_machine(&mut self, device: Device) {
        let other = device.other();
        if !self.machine(other).clear {
            self.raise(
                AlarmId::NotClear,
                &format!("{other}, no longer clear of the part when the {device} was to start"),
            );
            return self.enter_state(Held(Phase::from_job(device, JobStep::Send)));
        }
        let known = self.machine_mut(device);
        (known.clear, known.clear_confirmed) = (false, false);
        self.pass_count += u32::from(device == Device::Grinder);
        self.pass_record_doubted = false;
        self.job_observed[device as usize] = false;
        (self.last_progress, self.max_progress_interval) = (None, Duration::ZERO);
        self.push(Command::StartMachine { device, cycle: self.cycle });
    }

    /// Decrements the number of started passes. Called after the grinder has proved that it did not execute a START.
    /// Does nothing for the measuring machine.
    fn uncount_pass(&mut self, device: Device) {
        self.pass_count = self.pass_count.saturating_sub(u32::from(device == Device::Grinder));
    }

    /// Enters `Execute` with the phase `run`, after a report that a machine runs its job. If a machine is in manual
    /// mode, raises an alarm and orders the job to hold. Otherwise, if a condition (supplies or a required signal) is
    /// missing, suspends the job.
    pub(super) fn enter_running(&mut self, run: Phase) {
        self.enter_state(Execute(run));
        // The time during which the machine was held is no measure of its pace.
        self.last_progress = None;
        if self.has_manual_machine() {
            self.raise_manual_mode();
            return self.hold(run);
        }
        if self.suspension_causes.iter().any(|cause| matches!(cause, SuspensionCause::Condition(..))) {
            self.suspend(run);
        }
    }

    /// Handles a progress report of the running job: resets the failures of the machine, restarts the time limit, and
    /// stores the longest interval between two reports.
    pub(super) fn on_progressed(&mut self, device: Device) {
        self.reset_failures(device);
        if let Some(last) = self.last_progress.replace(self.now) {
            self.max_progress_interval = self.max_progress_interval.max(self.now.saturating_sub(last));
        }
        self.enter_state(self.state);
    }

    pub(super) fn on_machine_held(&mut self, device: Device) -> Result<(), String> {
        self.machine_mut(device).moves_unordered = false;
        let at_job = running_device(self.state) == Some(device);
        let run = Phase::from_job(device, JobStep::Run);
        match self.state {
            Stopping => {}
            Holding(_) if at_job => self.enter_state(Held(run)),
            Suspending(_) if at_job => self.enter_suspended(run),
            Execute(_) if at_job => {
                self.raise(AlarmId::MachineHeldItself, &device.to_string());
                self.enter_state(Held(run));
            }
            // It was held before RESUME is sent, and is seen held once more if its link has just come back.
            Unholding(_) | Unsuspending(_) if at_job => {}
            Held(_) | Suspended(_) if at_job => {}
            // It had no job, moved, and was ordered to hold.
            _ if !at_job && self.active_alarms.contains_key(&AlarmId::MovesUnasked) => {}
            state => {
                return Err(format!(
                    "the {device} reports a hold, but this machine has no job to hold while the cell is in the state {state}"
                ));
            }
        }
        Ok(())
    }

    pub(super) fn on_machine_resumed(&mut self, device: Device) -> Result<(), String> {
        let run = Phase::from_job(device, JobStep::Run);
        let at_run = self.state.phase() == Some(run);
        match self.state {
            Stopping => {}
            Unholding(_) | Unsuspending(_) if at_run => self.enter_running(run),
            Held(_) if at_run => {
                self.raise(AlarmId::MachineResumedItself, &device.to_string());
                self.enter_running(run);
            }
            Suspended(_) if at_run => self.suspend(run),
            Execute(_) | Holding(_) | Suspending(_) if at_run => {}
            state => {
                return Err(format!(
                    "the {device} reports a resume, but this machine has no job to resume while the cell is in the state {state}"
                ));
            }
        }
        Ok(())
    }

    pub(super) fn on_ended(&mut self, device: Device, result: JobResult) {
        match (result, device) {
            (JobResult::Complete, Device::Grinder) if std::mem::take(&mut self.pass_record_doubted) => {
                self.advance(Grind(JobStep::Discard));
            }
            (JobResult::Complete, Device::Grinder) => self.advance(Grind(JobStep::Acknowledge)),
            (JobResult::Complete, Device::Cmm) => self.advance(Measure(JobStep::Collect)),
            (JobResult::Stopped | JobResult::Failed, _) => {
                self.raise(AlarmId::JobFailed, &format!("{device}, {result}"));
                self.advance(Phase::from_job(device, JobStep::Discard));
            }
            (JobResult::Aborted, _) => {
                self.raise(AlarmId::JobFailed, &format!("{device}, aborted at the machine"));
                self.abort(&format!("the job of the {device} was aborted at the machine, not by the cell"));
            }
        }
    }

    pub(super) fn on_acknowledged(&mut self, phase: Phase) {
        match phase {
            Grind(JobStep::Acknowledge) => self.advance(Transfer),
            Grind(_) => self.enter_state(Held(Transfer)),
            Measure(JobStep::Acknowledge) => self.advance(Register),
            _ => self.repeat_measurement(),
        }
    }

    pub(super) fn on_refused(&mut self, phase: Phase, device: Device, what: MachineRequest, reason: &str) {
        if what == MachineRequest::Start {
            self.uncount_pass(device);
        }
        self.raise(AlarmId::MachineRefused, &format!("{device}, {what}: {reason}"));
        self.acknowledge_refused[device as usize] = what == MachineRequest::Acknowledge;
        // The machine still has the job that a person declared over: ask it once more.
        let still_there = what == MachineRequest::Discard && phase == Phase::from_job(device, JobStep::Discard);
        self.enter_state(Held(if still_there {
            Phase::from_job(device, JobStep::Reconcile)
        } else {
            restart_phase(phase)
        }));
    }

    /// Handles the event that the machine `device` no longer reports its running job. `reason` is the reason. Raises an
    /// alarm and asks the machine for the state of the job. The cell draws no conclusion before the answer.
    pub(super) fn on_job_vanished(&mut self, device: Device, reason: &str) {
        self.raise(AlarmId::JobVanished, &format!("{device}, {reason}"));
        let asked = Phase::from_job(device, JobStep::Reconcile);
        self.enter_state(match self.state {
            Execute(_) | Unholding(_) | Unsuspending(_) => Execute(asked),
            _ => Holding(asked),
        });
        self.push(Command::Reconcile { device, cycle: self.cycle });
    }

    pub(super) fn reconcile(&mut self, device: Device) {
        self.enter_state(self.state_with_phase(Phase::from_job(device, JobStep::Reconcile)));
        self.push(Command::Reconcile { device, cycle: self.cycle });
    }

    pub(super) fn on_reconciled(&mut self, device: Device, outcome: &Reconciliation) {
        let run = Phase::from_job(device, JobStep::Run);
        if !matches!(outcome, Reconciliation::NotStarted | Reconciliation::Unknown(_)) {
            self.withdraw(AlarmId::JobVanished);
        }
        self.job_observed[device as usize] |=
            !matches!(outcome, Reconciliation::NotStarted | Reconciliation::Unknown(_));
        match (outcome, self.state) {
            (Reconciliation::Running, Holding(_) | Suspending(_)) => {
                self.enter_state(self.state_with_phase(run));
                self.push(Command::HoldMachine { device });
            }
            (Reconciliation::Running, _) => self.enter_running(run),
            (Reconciliation::Held, Holding(_)) => self.enter_state(Held(run)),
            // It held itself, as it should when the link is silent. A person decides whether it moves again.
            (Reconciliation::Held, _) => {
                self.raise(AlarmId::MachineHeldItself, &device.to_string());
                self.enter_state(Held(run));
            }
            (Reconciliation::Ended(result), _) => self.on_ended(device, *result),
            // A machine that has forgotten its job gives this answer too. A second start would grind again what the
            // first one ground.
            (Reconciliation::NotStarted, _) if self.job_observed[device as usize] => {
                self.hold_unknown_outcome(
                    device,
                    "the machine reports that this job never began, but the cell saw the job begin",
                );
            }
            (Reconciliation::NotStarted, _) => {
                self.uncount_pass(device);
                let next = Phase::from_job(device, JobStep::Send);
                if self.count_failure(device) {
                    self.raise_recurring_failure(
                        device,
                        Phase::from_job(device, JobStep::Start),
                        "the machine reports that its job was not started",
                    );
                    return self.enter_state(Held(next));
                }
                self.advance(next);
            }
            (Reconciliation::Unknown(message), _) => self.hold_unknown_outcome(device, message),
        }
    }

    pub(super) fn hold_unknown_outcome(&mut self, device: Device, message: &str) {
        let id = if self.job_observed[device as usize] { AlarmId::JobVanished } else { AlarmId::StartUnknown };
        self.raise(id, &format!("{device}, {message}"));
        self.enter_state(Held(Phase::from_job(device, JobStep::Reconcile)));
    }

    /// Handles the declaration of a person that the job of the machine `device` is over. A person declares this if the
    /// machine cannot report the end of the job. The machine may still have the result of the job and would then refuse
    /// the next job. So the cell asks the machine to discard the result. If the machine is not connected, the cell
    /// becomes held and asks later.
    pub(super) fn on_declared_over(&mut self, device: Device) {
        let discard = Phase::from_job(device, JobStep::Discard);
        self.acknowledge_refused[device as usize] = false;
        if self.machine(device).ready && !self.suspension_causes.contains(&SuspensionCause::Link(device)) {
            self.enter_state(Holding(discard));
            self.push(Command::Acknowledge { device });
        } else {
            self.enter_state(Held(discard));
        }
    }

    /// Handles the declaration of a person that a machine need not discard the result of its job. The cell no longer
    /// asks the machine to do this. `phase` is the phase in which the cell asked. The cell becomes held before the next
    /// phase. If an unusable measurement was to be discarded, the next phase is its repetition.
    pub(super) fn on_result_given_up(&mut self, phase: Phase) {
        self.withdraw(AlarmId::MachineRefused);
        self.acknowledge_refused = [false; 2];
        match phase {
            Measure(JobStep::Acknowledge) => self.enter_state(Held(Register)),
            Measure(_) => self.repeat_measurement(),
            _ => self.enter_state(Held(Transfer)),
        }
    }
}
