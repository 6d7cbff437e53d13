//! Transition table: the reaction to an event in a state.

use std::time::Duration;

use super::alarm::AlarmId;
use super::cell::{Cell, SuspensionCause};
use super::command::Command;
use super::event::{Event, JobResult, MachineRequest};
use super::phase_queries::{
    awaits_answer, device_awaiting_acknowledge, reconciling_device, restart_phase, running_device,
};
use super::state::{Device, JobStep, Phase, State};

use Phase::{Compensate, Grind, Load, Measure, Register};
use State::{
    Aborting, Completing, Execute, Held, Holding, Idle, Starting, Stopping, Suspended, Suspending, Unholding,
    Unsuspending,
};

impl Cell {
    /// Handles `event`, which occurred at the time `now` since the run began. Changes the state of the cell and returns
    /// the commands to execute, in this order. In an end state, returns no command.
    ///
    /// If the present state does not accept the event, the last command is [`Command::Refuse`] with the reason.
    pub fn handle(&mut self, now: Duration, event: Event) -> Vec<Command> {
        if let Err(reason) = self.apply_event(now, &event) {
            let (event, state) = (Box::new(event), self.state);
            let reason = reason.unwrap_or_else(|| format!("{} is not accepted in the state {state}", event.in_words()));
            self.commands.push(Command::Refuse { event, state, reason });
        }
        std::mem::take(&mut self.commands)
    }

    /// Handles `event`, which occurred at the time `now` since the run began. Appends the resulting commands to the
    /// field `commands` of the cell. Does nothing in an end state.
    ///
    /// # Errors
    /// The cell refuses the event. `Some` contains the reason for people. `None` means that the present state has no
    /// reaction to the event. The state of the cell is then unchanged, and the caller writes the reason.
    pub(super) fn apply_event(&mut self, now: Duration, event: &Event) -> Result<(), Option<String>> {
        if self.state.is_end() {
            return Ok(());
        }
        self.now = now;
        let asked = self.state.phase().and_then(Phase::job);
        let answered = self.foreign_reason(event).map_or_else(|| self.transition(event), |reason| Err(Some(reason)));
        if let (Some((device, JobStep::Start | JobStep::Run | JobStep::Reconcile)), Ok(())) = (asked, &answered) {
            self.job_observed[device as usize] |= shows_job(event, device);
        }
        if self.state.is_end() {
            self.deadline = None;
        }
        self.update_furthest_position();
        answered
    }

    /// Returns the reason to refuse `event` if it belongs to another cycle than the current one. Returns `None` if the
    /// event belongs to the current cycle or to no cycle.
    ///
    /// There is one exception: [`Event::Ended`] of the machine that is being stopped is never refused here. STOP can
    /// reach the machine while it still has the job of the previous cycle.
    fn foreign_reason(&self, event: &Event) -> Option<String> {
        // A STOP does not wait for the record. It can reach the machine before the preparation of this cycle: the
        // machine then still has the job of the cycle before.
        if matches!((self.state, event), (Stopping, Event::Ended { device, .. }) if self.stopping_machine == Some(*device))
        {
            return None;
        }
        let cycle = event.cycle().filter(|cycle| *cycle != self.cycle);
        cycle.map(|cycle| format!("this event belongs to cycle {cycle}, but the current cycle is {}", self.cycle))
    }

    /// Applies the transition table: selects the reaction to `event` in the present state and carries it out. The first
    /// matching entry counts. Entries for abort and fault come first. After these come orders of people, interruptions,
    /// the normal sequence of a run, and deadlines.
    ///
    /// # Errors
    /// The cell refuses the event. `Some` contains the reason. `None` means that the table has no entry for this state
    /// and event.
    fn transition(&mut self, event: &Event) -> Result<(), Option<String>> {
        match (self.state, event) {
            // The safe sequence.
            (Aborting, Event::Abort { .. } | Event::Fault { .. }) => {}
            (_, Event::Abort { actor, reason }) => self.abort(&format!("{actor} ordered the abort{}", reason_clause(reason))),
            (_, Event::Fault { device, code, message }) => {
                let case = format!("{device}, fault {code}, {message}");
                self.raise(AlarmId::MachineFault, &case);
                self.abort(&case);
            }
            (Aborting, Event::AbortConfirmed { device }) => self.on_abort_confirmed(*device),
            (Aborting, Event::Cleared { device }) if self.machine(*device).abort_confirmed => self.on_final_clearance(*device, true, ""),
            (Aborting, Event::Obstructed { device, message }) if self.machine(*device).abort_confirmed => {
                self.on_final_clearance(*device, false, message);
            }
            (Aborting, Event::ClearUnknown { device }) if self.machine(*device).abort_confirmed => {
                self.on_final_clearance(*device, self.machine(*device).clear_confirmed, "no signal shows whether the machine is clear of the part");
            }
            (Aborting, Event::LinkLost { device, .. } | Event::LinkBack { device, .. }) => {
                let lost = matches!(event, Event::LinkLost { .. });
                self.set_link_lost(*device, lost);
                if !lost && !self.machine(*device).abort_confirmed {
                    self.push(Command::AbortMachine { device: *device });
                }
            }
            (Aborting, Event::Restarted { .. }) => self.restart_abort(),
            (Aborting, Event::Deadline) => self.on_deadline(),
            // A machine may still report what was in progress when the abort came. It has no effect.
            (Aborting, event) if !event.is_order() => {}

            // Orders.
            (Idle, Event::Start { .. }) => self.start_run(),
            (_, Event::Stop { actor, reason }) if !matches!(self.state, Stopping | Completing | Aborting) => {
                self.end_ordered = true;
                self.stop(&format!("{actor} stopped the run{}", reason_clause(reason)), false);
            }
            (Starting, Event::Hold { .. }) => self.enter_state(Held(Load)),
            (Execute(phase) | Unholding(phase) | Unsuspending(phase), Event::Hold { .. }) => self.hold(phase),
            (Suspending(phase), Event::Hold { .. }) => self.enter_state(Holding(phase)),
            (Suspended(phase), Event::Hold { .. }) => self.hold_suspended(phase),
            (Holding(_) | Held(_), Event::Hold { .. }) => {}
            (Held(phase), Event::Resume { .. }) => self.resume(phase)?,
            (Held(Grind(JobStep::Reconcile)), Event::DeclaredOver { device: device @ Device::Grinder, .. })
            // If the result is lost, with the machine's memory or a file, the part is also measured once more.
            | (
                Held(Measure(JobStep::Reconcile | JobStep::Collect)),
                Event::DeclaredOver { device: device @ Device::Cmm, .. },
            ) => self.on_declared_over(*device),
            // The machine does not discard its result: the next preparation shows whether the result is gone.
            (Held(phase), Event::DeclaredOver { device, .. }) if device_awaiting_acknowledge(phase) == Some(*device) => {
                let was_asked = self.acknowledge_refused[*device as usize] || phase == Phase::from_job(*device, JobStep::Acknowledge);
                if was_asked { self.on_result_given_up(phase) } else { self.on_declared_over(*device) }
            }
            (Execute(Load), Event::LoadConfirmed { .. }) => self.start_first_cycle(),
            (state, Event::ClearConfirmed { device, .. })
                if state.phase().is_some() && running_device(state) != Some(*device) =>
            {
                self.on_clear_confirmed(*device);
            }
            (Idle, Event::Restarted { .. }) => {}
            (Stopping, Event::Restarted { .. }) => {
                self.ending_reason = "the program was restarted while the run was being stopped".to_owned();
                self.restart_abort();
            }
            (_, Event::Restarted { actor }) => self.on_restarted(&actor.to_string()),

            // Failures of the record, and conditions outside.
            (_, Event::RecordFailed { reason }) => self.on_record_failed(reason),
            (Execute(phase), Event::LinkLost { device, reason }) => self.on_link_lost(phase, *device, reason, Suspended),
            (
                Unholding(phase) | Unsuspending(phase) | Suspending(phase) | Suspended(phase),
                Event::LinkLost { device, reason },
            ) => {
                self.on_link_lost(phase, *device, reason, Suspended);
            }
            (Holding(phase) | Held(phase), Event::LinkLost { device, reason }) => {
                self.on_link_lost(phase, *device, reason, Held)
            }
            (_, Event::LinkLost { device, reason }) => {
                self.set_link_lost(*device, true);
                self.raise(AlarmId::LinkLost, &format!("{device}, {reason}"));
            }
            (_, Event::StationFailed { device, reason }) => self.on_station_failed(*device, reason),
            (_, Event::LinkBack { device, boot_id }) => self.on_link_back(*device, *boot_id),
            (Execute(phase), Event::ConditionLost { device, condition, message }) => {
                self.on_condition_lost(*device, *condition, message);
                if phase.moving_device().is_some() {
                    self.suspend(phase);
                }
            }
            (_, Event::ConditionLost { device, condition, message }) => {
                self.on_condition_lost(*device, *condition, message)
            }
            (_, Event::ConditionBack { device, condition }) => {
                self.remove_cause(SuspensionCause::Condition(*device, *condition), AlarmId::ConditionLost)
            }

            (Starting, Event::NotOnRecord { .. }) => self.enter_state(Held(Load)),
            (
                Execute(phase) | Holding(phase) | Suspending(phase) | Unholding(phase) | Unsuspending(phase),
                Event::NotOnRecord { .. },
            ) => self.on_not_recorded(phase),
            // The result stays at the machine, which gets the acknowledgement in the next run.
            (Stopping, Event::NotOnRecord { command }) if command.starts_with("acknowledge") => self.finish_stopped(),
            (_, Event::NotOnRecord { .. }) => {}
            (_, Event::ControlLost { reason }) => self.raise(AlarmId::ControlLost, reason),
            (_, Event::ControlBack) => self.withdraw(AlarmId::ControlLost),

            (_, Event::NotAutomatic { device, message }) => self.on_manual_mode(*device, message),
            (_, Event::AutomaticAgain { device }) => self.on_automatic_mode(*device),

            // Connecting.
            (Starting, Event::Connected { device, boot_id, occupation, .. }) => self.on_connected(*device, *boot_id, occupation),
            (Held(phase) | Holding(phase), Event::Connected { device, boot_id, occupation, .. }) => {
                self.on_reconnected(phase, *device, *boot_id, occupation);
            }
            (Starting | Held(_) | Holding(_), Event::NotConnected { device, reason }) => self.on_not_connected(*device, reason),
            (Starting, Event::Refused { device, request: MachineRequest::Clear, reason }) => {
                self.raise(AlarmId::NotIdle, &format!("{device}, {reason}"));
                self.stop(&format!("the {device} did not clear its old job or fault: {reason}"), false);
            }

            // Job of a machine, in its steps. `advance` continues, or stays at the border of the phase if the cell is
            // being held.
            (Execute(p) | Holding(p), Event::PassLoaded { .. }) if p == Grind(JobStep::Send) => {
                self.advance(Grind(JobStep::Clear))
            }
            (Execute(p) | Holding(p), Event::PlanLoaded { .. }) if p == Measure(JobStep::Send) => {
                self.advance(Measure(JobStep::Clear));
            }
            (Execute(p) | Holding(p), Event::Cleared { device }) if p.device_awaited_clear() == Some(*device) => {
                self.on_cleared(p, *device);
            }
            (Execute(p) | Holding(p), Event::ClearUnknown { device }) if p.device_awaited_clear() == Some(*device) => {
                self.on_clear_unknown(p, *device);
            }
            (Execute(p) | Holding(p), Event::Obstructed { device, message }) if p.device_awaited_clear() == Some(*device) => {
                self.raise(AlarmId::NotClear, &format!("{device}, {message}"));
                self.enter_state(Held(restart_phase(p)));
            }
            (Execute(p) | Holding(p), Event::Prepared { device, .. })
                if p.job() == Some((*device, JobStep::Prepare)) =>
            {
                self.advance(Phase::from_job(*device, JobStep::Start));
            }
            (Execute(p), Event::Started { device, .. }) if p.job() == Some((*device, JobStep::Start)) => {
                self.enter_running(Phase::from_job(*device, JobStep::Run));
            }
            (Holding(p) | Suspending(p), Event::Started { device, .. })
                if p.job() == Some((*device, JobStep::Start)) =>
            {
                self.enter_state(self.state_with_phase(Phase::from_job(*device, JobStep::Run)));
                self.push(Command::HoldMachine { device: *device });
            }
            // A late answer to a request that the cell already clarifies: the job was taken.
            (state, Event::Started { device, .. }) if reconciling_device(state) == Some(*device) => {}
            (Execute(p) | Holding(p) | Suspending(p), Event::StartUnknown { device, .. })
                if p.job() == Some((*device, JobStep::Start)) =>
            {
                self.reconcile(*device);
            }
            (state, Event::JobVanished { device, reason }) if state.phase() == Some(Phase::from_job(*device, JobStep::Run)) => {
                self.on_job_vanished(*device, reason);
            }
            // The cell already asks the machine, or knows the end of the job.
            (_, Event::JobVanished { .. }) => {}
            (Execute(p), Event::Progressed { device, .. }) if p.job() == Some((*device, JobStep::Run)) => {
                self.on_progressed(*device)
            }
            (
                Execute(p) | Holding(p) | Suspending(p) | Unholding(p) | Unsuspending(p),
                Event::Progressed { device, .. },
            ) if p.moving_device() == Some(*device) => {}
            (Held(p) | Suspended(p), Event::Progressed { device, .. }) => self.on_motion_while_held(p, *device),
            (
                Execute(p) | Holding(p) | Suspending(p) | Unholding(p) | Unsuspending(p),
                Event::Progressed { device, .. },
            ) => self.on_unordered_motion(p, *device),
            (_, Event::MachineHeld { device }) => self.on_machine_held(*device)?,
            (_, Event::MachineResumed { device }) => self.on_machine_resumed(*device)?,
            (Stopping, Event::Ended { device, result, .. }) if *result != JobResult::Aborted => {
                self.push(Command::Acknowledge { device: *device });
            }
            (state, Event::Ended { device, result, .. }) if running_device(state) == Some(*device) => {
                self.on_ended(*device, *result)
            }
            (state, Event::RecordDoubted { reason, .. }) if running_device(state) == Some(Device::Grinder) => {
                self.pass_record_doubted = true;
                self.raise(AlarmId::PassRecord, reason);
            }
            (Stopping, Event::RecordDoubted { reason, .. }) => self.raise(AlarmId::PassRecord, reason),
            (state, Event::Reconciled { device, outcome, .. }) if reconciling_device(state) == Some(*device) => {
                self.on_reconciled(*device, outcome);
            }
            (Execute(p) | Holding(p), Event::Collected { targets, found, gate, .. })
                if p == Measure(JobStep::Collect) =>
            {
                self.on_collected(*targets, *found, gate);
            }
            (Execute(p) | Holding(p), Event::Qualified { radius_error_mm, .. }) if p == Measure(JobStep::Qualify) => {
                self.on_qualified(*radius_error_mm);
            }
            (Execute(p) | Holding(p), Event::Acknowledged { device }) if device_awaiting_acknowledge(p) == Some(*device) => {
                self.on_acknowledged(p);
            }
            (Stopping, Event::Acknowledged { .. }) => self.finish_stopped(),
            (Execute(p) | Holding(p), Event::Refused { device, request, reason }) if awaits_answer(p, *device, *request) => {
                self.on_refused(p, *device, *request, reason);
            }
            (
                Holding(_) | Suspending(_) | Held(_) | Suspended(_),
                Event::Refused { device, request: MachineRequest::Hold, reason },
            ) => {
                self.raise(AlarmId::HoldNotConfirmed, &format!("{device}, {reason}"));
                self.abort(&format!("the {device} refused to hold: {reason}"));
            }
            (Unholding(p) | Unsuspending(p), Event::Refused { device, request: MachineRequest::Resume, reason })
                if p.moving_device() == Some(*device) =>
            {
                self.raise(AlarmId::MachineRefused, &format!("{device}, resume: {reason}"));
                self.enter_state(Held(p));
            }
            (Stopping, Event::Refused { device, request: MachineRequest::Stop | MachineRequest::Acknowledge | MachineRequest::Discard, reason }) => {
                self.raise(AlarmId::StopNotConfirmed, &format!("{device}, {reason}"));
                self.abort(&format!("the {device} refused to stop: {reason}"));
            }
            (Execute(p), Event::Obstructed { device, message }) if p.moving_device() == Some(device.other()) => {
                self.machine_mut(*device).clear = false;
                self.raise(AlarmId::NotClear, &format!("{device}, {message}, while the {} moves", device.other()));
                self.hold(p);
            }
            (Completing, Event::Obstructed { device, message }) => self.on_final_clearance(*device, false, message),
            (_, Event::Obstructed { device, .. }) => self.machine_mut(*device).clear = false,
            // Nothing is started any more: the person who takes the part out can see whether the machine is clear.
            (Completing, Event::ClearUnknown { device }) => self.on_final_clearance(*device, true, ""),
            (_, Event::ClearUnknown { device }) => self.machine_mut(*device).clear = false,

            // Computations.
            (Execute(Register) | Holding(Register), Event::Registered { figures, .. }) => self.on_registered(figures),
            (Execute(Register) | Holding(Register), Event::RegistrationFailed { reason, .. }) => {
                self.reject_measurement(AlarmId::RegistrationFailed, reason);
            }
            (
                Execute(p @ (Register | Compensate | Measure(JobStep::Collect)))
                | Holding(p @ (Register | Compensate | Measure(JobStep::Collect))),
                Event::NotSaved { reason, .. },
            ) => {
                self.raise_record_failed(reason);
                self.enter_state(Held(p));
            }
            (Execute(Compensate) | Holding(Compensate), Event::Compensated { summary, .. }) => {
                self.cycle += 1;
                if summary.confirmations_required.is_empty() {
                    self.advance(Grind(JobStep::Send));
                } else {
                    self.raise(AlarmId::ParameterBeyond, &summary.confirmations_required.join("; "));
                    self.enter_state(Held(Grind(JobStep::Send)));
                }
            }
            (Execute(Compensate) | Holding(Compensate), Event::CompensationRefused { reason, .. }) => self.on_compensation_refused(reason),

            // The end, and time.
            (Completing, Event::Cleared { device }) => self.on_final_clearance(*device, true, ""),
            (_, Event::Deadline) => self.on_deadline(),
            _ => return Err(None),
        }
        Ok(())
    }
}

/// Returns true if `event` shows that the machine `of` has begun its job: it started, made progress, held, resumed or
/// ended the job.
fn shows_job(event: &Event, of: Device) -> bool {
    match event {
        Event::Started { device, .. }
        | Event::Progressed { device, .. }
        | Event::MachineHeld { device }
        | Event::MachineResumed { device }
        | Event::Ended { device, .. } => *device == of,
        _ => false,
    }
}

/// Returns the text ", because " with `reason` after it. `reason` is the reason that a person gave. Returns an empty
/// string if `reason` is empty.
fn reason_clause(reason: &str) -> String {
    if reason.is_empty() { String::new() } else { format!(", because {reason}") }
}
