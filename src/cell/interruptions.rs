//! Interruptions of a run: hold, suspend and resume, motion without an order, manual mode, missing conditions, and a
//! failed record.

use super::alarm::AlarmId;
use super::cell::{Cell, FailureSeries, SuspensionCause};
use super::command::Command;
use super::event::{Condition, RecordFailure};
use super::phase_queries::restart_phase;
use super::state::{Device, JobStep, Phase, State};

use Phase::Load;
use State::{Execute, Held, Holding, Starting, Suspended, Suspending, Unholding, Unsuspending};

impl Cell {
    /// Holds the cell at `phase`, on the order of a person or for a cause inside the cell. If a machine runs its job,
    /// orders it to hold. If the phase waits for a person, the cell is held at once. Any other phase runs to its end
    /// first.
    pub(super) fn hold(&mut self, phase: Phase) {
        match phase.job() {
            Some((device, JobStep::Run)) => {
                self.enter_state(Holding(phase));
                self.push(Command::HoldMachine { device });
            }
            _ if phase == Load || self.is_asking_whether_clear(phase) => self.enter_state(Held(restart_phase(phase))),
            _ => self.enter_state(Holding(phase)),
        }
    }

    /// Changes a suspended cell to held. If the state of the job is unknown (step Reconcile), the machine may still
    /// move, so the cell becomes holding and waits until the machine is at rest.
    pub(super) fn hold_suspended(&mut self, phase: Phase) {
        let unseen = matches!(phase.job(), Some((_, JobStep::Reconcile)));
        self.enter_state(if unseen { Holding(phase) } else { Held(phase) });
    }

    /// Suspends the cell at `phase`, because a condition (supplies or a required signal) is missing while a machine may
    /// move. The cell becomes suspending. If a machine runs its job, the cell orders it to hold.
    pub(super) fn suspend(&mut self, phase: Phase) {
        self.enter_state(Suspending(phase));
        if let Some((device, JobStep::Run)) = phase.job() {
            self.push(Command::HoldMachine { device });
        }
    }

    pub(super) fn enter_suspended(&mut self, phase: Phase) {
        self.enter_state(Suspended(phase));
        self.unsuspend_if_possible();
    }

    fn unsuspend_if_possible(&mut self) {
        let Suspended(phase) = self.state else { return };
        if !self.suspension_causes.is_empty() {
            return;
        }
        match phase.job() {
            Some((device, JobStep::Run)) => {
                self.enter_state(Unsuspending(phase));
                self.push(Command::ResumeMachine { device });
            }
            Some((device, JobStep::Reconcile)) => {
                self.enter_state(Unsuspending(phase));
                self.push(Command::Reconcile { device, cycle: self.cycle });
            }
            _ => self.enter_phase(restart_phase(phase)),
        }
    }

    pub(super) fn resume(&mut self, phase: Phase) -> Result<(), String> {
        if let Some((_, JobStep::Run)) = phase.job()
            && let Some(device) = Device::BOTH.into_iter().find(|device| self.machine(*device).manual)
        {
            return Err(format!(
                "the {device} is in manual mode; turn the mode key of this machine to automatic, then resume"
            ));
        }
        let absent: Vec<_> = Device::BOTH.into_iter().filter(|device| !self.machine(*device).ready).collect();
        if !absent.is_empty() && self.cycle == 0 {
            self.enter_state(Starting);
        }
        for device in &absent {
            self.push(Command::Connect { device: *device });
        }
        match absent.first() {
            None => self.resume_connected(phase),
            Some(_) if self.state == Starting => {}
            Some(device) => {
                let what = match self.machine(*device).boot_id {
                    Some(_) => "is not idle: end or clear its job at the panel of the machine",
                    None => "is not connected",
                };
                return Err(format!(
                    "the {device} {what}; the cell now connects to this machine again; when this machine is connected, resume again"
                ));
            }
        }
        Ok(())
    }

    fn resume_connected(&mut self, phase: Phase) {
        self.failure_series = [FailureSeries::default(); 2];
        self.machines.iter_mut().for_each(|known| known.moves_unordered = false);
        let standing: Vec<_> = self.active_alarms.keys().copied().collect();
        for alarm in standing {
            if !matches!(alarm, AlarmId::LinkLost | AlarmId::ConditionLost) || self.suspension_causes.is_empty() {
                self.withdraw(alarm);
            }
        }
        // While the link failed again and again, not every loss raised the alarm.
        if !self.active_alarms.contains_key(&AlarmId::LinkLost)
            && let Some(SuspensionCause::Link(device)) =
                self.suspension_causes.iter().find(|cause| matches!(cause, SuspensionCause::Link(_))).copied()
        {
            self.raise(AlarmId::LinkLost, &format!("{device}, it is still lost"));
        }
        match phase.job() {
            Some((_, JobStep::Run)) if !self.suspension_causes.is_empty() => self.enter_state(Suspended(phase)),
            Some((device, JobStep::Run)) => {
                self.enter_state(Unholding(phase));
                self.push(Command::ResumeMachine { device });
            }
            _ => self.enter_phase(restart_phase(phase)),
        }
    }

    /// Handles the report that the machine `device` moves while the cell is held or suspended at `phase`. Orders the
    /// machine to hold and raises an alarm. If the machine has an unfinished job in `phase`, the cell becomes holding.
    ///
    /// Does nothing if the machine has no such job and this motion was reported before.
    pub(super) fn on_motion_while_held(&mut self, phase: Phase, device: Device) {
        let astray = self.machine(device).moves_unordered;
        if phase.moving_device() == Some(device) {
            // A person then decides whether it continues, whatever the cause of the suspension was.
            self.enter_state(Holding(Phase::from_job(device, JobStep::Run)));
        } else if astray {
            return;
        }
        let known = self.machine_mut(device);
        (known.clear, known.moves_unordered) = (false, true);
        self.raise(AlarmId::MovesUnasked, &device.to_string());
        self.push(Command::HoldMachine { device });
    }

    /// Handles the report that the machine `device` moves without an order of the cell. `phase` is the phase of the
    /// cell. Raises an alarm and orders the machine to hold. Also holds the cell and, with it, the job of the other
    /// machine if one runs. If this motion was reported before, does not repeat these steps.
    pub(super) fn on_unordered_motion(&mut self, phase: Phase, device: Device) {
        let known = self.machine_mut(device);
        known.clear = false;
        if std::mem::replace(&mut known.moves_unordered, true) {
            return;
        }
        let what = phase.moving_device().map_or(String::new(), |moves| format!(", while the {moves} runs its job"));
        self.raise(AlarmId::MovesUnasked, &format!("{device}{what}"));
        self.push(Command::HoldMachine { device });
        match self.state {
            Execute(_) | Unholding(_) | Unsuspending(_) => self.hold(phase),
            Suspending(_) => self.enter_state(Holding(phase)),
            _ => {}
        }
    }

    /// Handles the report that the machine `device` has left automatic mode. `message` describes this for the alarm. If
    /// a machine may be moving in the present phase and the cell is not held, raises an alarm and holds the cell. This
    /// includes a suspended cell: it would otherwise resume without a person.
    ///
    /// In other cases, only stores that the machine is in manual mode.
    pub(super) fn on_manual_mode(&mut self, device: Device, message: &str) {
        self.machine_mut(device).manual = true;
        let Some((phase, moving)) = self.state.phase().and_then(|phase| Some((phase, phase.moving_device()?))) else {
            return;
        };
        if matches!(self.state, Held(_)) {
            return;
        }
        let beside = if moving == device { String::new() } else { format!(", while the {moving} runs its job") };
        self.raise(AlarmId::NotAutomatic, &format!("{device}, {message}{beside}"));
        match self.state {
            Execute(_) | Unholding(_) | Unsuspending(_) => self.hold(phase),
            Suspending(_) => self.enter_state(Holding(phase)),
            Suspended(_) => self.hold_suspended(phase),
            _ => {}
        }
    }

    pub(super) fn on_automatic_mode(&mut self, device: Device) {
        self.machine_mut(device).manual = false;
        if !self.has_manual_machine() {
            self.withdraw(AlarmId::NotAutomatic);
        }
    }

    /// Returns true if a machine is in manual mode.
    pub(super) fn has_manual_machine(&self) -> bool {
        self.machines.iter().any(|known| known.manual)
    }

    pub(super) fn raise_manual_mode(&mut self) {
        let names: Vec<_> =
            Device::BOTH.into_iter().filter(|device| self.machine(*device).manual).map(|d| d.to_string()).collect();
        self.raise(AlarmId::NotAutomatic, &format!("{} in manual mode", names.join(" and ")));
    }

    pub(super) fn on_condition_lost(&mut self, device: Device, condition: Condition, message: &str) {
        if self.suspension_causes.insert(SuspensionCause::Condition(device, condition)) {
            self.raise(AlarmId::ConditionLost, &format!("{device}, {condition}, {message}"));
        }
    }

    pub(super) fn remove_cause(&mut self, cause: SuspensionCause, alarm: AlarmId) {
        self.suspension_causes.remove(&cause);
        let is_link = |cause: &SuspensionCause| matches!(cause, SuspensionCause::Link(_));
        if !self.suspension_causes.iter().any(|other| is_link(other) == is_link(&cause)) {
            self.withdraw(alarm);
        }
        self.unsuspend_if_possible();
    }

    /// Handles a command that was not sent, because it could not be written to the journal. No machine will answer this
    /// command, so the cell becomes held at `phase`. There are three exceptions:
    ///
    /// - A machine runs its job, and the cell is executing, holding or suspending: nothing is done. HOLD is sent even
    ///   if it is not recorded.
    /// - The step Start: nothing is done. A START that was not sent is reported as refused.
    /// - The step Reconcile: the machine may be moving, and was not asked for its state. The cell becomes holding, and
    ///   sends HOLD, until the machine confirms that it is at rest.
    pub(super) fn on_not_recorded(&mut self, phase: Phase) {
        match (self.state, phase.job()) {
            // HOLD is sent whether it is recorded or not.
            (Execute(_) | Holding(_) | Suspending(_), Some((_, JobStep::Run))) => {}
            // A START that was not sent is reported as a refusal. Without that report the machine may have moved.
            (_, Some((_, JobStep::Start))) => {}
            (state, Some((device, JobStep::Reconcile))) => {
                if !matches!(state, Holding(_)) {
                    self.enter_state(Holding(phase));
                }
                self.push(Command::HoldMachine { device });
            }
            _ => self.enter_state(Held(restart_phase(phase))),
        }
    }

    pub(super) fn on_record_failed(&mut self, reason: &RecordFailure) {
        self.raise_record_failed(reason);
        match self.state {
            Execute(phase) | Unholding(phase) | Unsuspending(phase) => self.hold(phase),
            Suspending(phase) => self.enter_state(Holding(phase)),
            Suspended(phase) => self.hold_suspended(phase),
            Starting => self.enter_state(Held(Load)),
            _ => {}
        }
    }

    pub(super) fn raise_record_failed(&mut self, reason: &RecordFailure) {
        let (id, message) = match reason {
            RecordFailure::DiskFull(message) => (AlarmId::DiskFull, message),
            RecordFailure::Unwritable(message) => (AlarmId::JournalUnwritable, message),
        };
        self.raise(id, message);
    }
}
