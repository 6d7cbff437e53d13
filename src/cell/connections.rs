//! Connections of the machines: the first one, a lost and a restored link, and a restart of a machine or of this
//! program.

use super::alarm::AlarmId;
use super::cell::{Cell, FailureSeries, MachineStatus, SuspensionCause};
use super::command::Command;
use super::event::{ConnectionRefusal, Occupation};
use super::phase_queries::{phase_after_link_loss, restart_phase};
use super::plan::Deadlines;
use super::state::{Device, JobStep, Phase, State};

use Phase::Load;
use State::{Completing, Execute, Held, Holding, Starting, Suspended, Unholding, Unsuspending};

/// Minimum number of failures in a series before the time limit
/// `recurring_failure_time` of [`Deadlines`] can end the retries.
const MIN_RECURRING_FAILURES: u32 = 3;

impl Cell {
    pub(super) fn on_connected(&mut self, device: Device, boot_id: u32, found: &Occupation) {
        let known = self.machine_mut(device);
        (known.was_connected, known.boot_id) = (true, Some(boot_id));
        match found {
            Occupation::Idle => known.ready = true,
            Occupation::ToClear if self.plan.clear_at_start => self.push(Command::ClearMachine { device }),
            Occupation::ToClear | Occupation::Busy(_) => self.reject_not_idle(device, &found.to_string()),
        }
        if self.state == Starting && self.machines.iter().all(|known| known.ready) {
            self.enter_phase(Load);
        }
    }

    fn reject_not_idle(&mut self, device: Device, message: &str) {
        self.raise(AlarmId::NotIdle, &format!("{device}, {message}"));
        self.stop(&format!("the {device} is not idle: {message}"), false);
    }

    /// Handles the connection of the machine `device` while the cell is holding or held at `phase`. `boot_id`
    /// identifies the last start of the machine's control. `found` describes what the machine is doing.
    ///
    /// If `phase` contains no job of this machine and the machine is not idle, raises an alarm. If the cell is held and
    /// the job of this machine has an unknown state (step Reconcile), the cell becomes holding and asks the machine for
    /// the state of the job.
    pub(super) fn on_reconnected(&mut self, phase: Phase, device: Device, boot_id: u32, found: &Occupation) {
        let ours = phase.job().is_some_and(|(job, _)| job == device);
        let known = self.machine_mut(device);
        (known.was_connected, known.boot_id) = (true, Some(boot_id));
        known.ready = ours || *found == Occupation::Idle;
        if !known.ready {
            self.raise(AlarmId::NotIdle, &format!("{device}, {found}"));
        }
        // In HELD nothing may move. So first find out what became of a job that was out of sight, and hold it if it
        // runs. Only after that ask a person.
        if matches!(self.state, Held(_)) && phase.job() == Some((device, JobStep::Reconcile)) {
            self.enter_state(Holding(phase));
            self.push(Command::Reconcile { device, cycle: self.cycle });
        }
    }

    pub(super) fn on_not_connected(&mut self, device: Device, reason: &ConnectionRefusal) {
        let (id, message) = match reason {
            ConnectionRefusal::Unreachable(message) => (AlarmId::Unreachable, message.as_str()),
            ConnectionRefusal::WrongDevice(message) => (AlarmId::WrongDevice, message.as_str()),
            ConnectionRefusal::WordOrder(message) => (AlarmId::WordOrder, message.as_str()),
            ConnectionRefusal::Inches => (AlarmId::Inches, "the machine reports this unit"),
            ConnectionRefusal::Owned(message) => (AlarmId::Owned, message.as_str()),
            ConnectionRefusal::AtAnotherJob(message) => {
                let known = self.machine_mut(device);
                (known.was_connected, known.ready) = (false, false);
                if self.state == Starting {
                    return self.reject_not_idle(device, message);
                }
                (AlarmId::NotIdle, message.as_str())
            }
        };
        let case = format!("{device}, {message}");
        self.raise(id, &case);
        if self.state == Starting {
            self.stop(&case, false);
        }
    }

    /// Handles the loss of the link to the machine `device`. `reason` is the reason. `phase` is the present phase of
    /// the cell.
    ///
    /// If `phase` needs this machine, the cell enters the state `wait` (held or suspended), with the phase from which
    /// it can restart. If the link fails too often, the cell is held in any case. While the cell is being held and this
    /// machine may move, the cell stays holding until the machine confirms that it is at rest.
    ///
    /// If `phase` does not need this machine, the cell continues.
    pub(super) fn on_link_lost(&mut self, phase: Phase, device: Device, reason: &str, wait: fn(Phase) -> State) {
        self.set_link_lost(device, true);
        let needed = phase.job().map(|(job, _)| job) == Some(device) || phase.device_awaited_clear() == Some(device);
        let fails_again = self.count_failure(device);
        // The cell continues without a machine that it does not need.
        let is_vain = fails_again && needed;
        // A failure that was already reported as recurring is not reported each time.
        let was_told = self.failure_series[device as usize].reported
            && (!needed || self.active_alarms.contains_key(&AlarmId::FailsAgain));
        if !(fails_again && was_told) {
            self.raise(AlarmId::LinkLost, &format!("{device}, {reason}"));
            if is_vain {
                self.raise_recurring_failure(device, phase, reason);
            }
            self.failure_series[device as usize].reported = fails_again;
        }
        let wait = if is_vain { Held } else { wait };
        let stands = matches!(self.state, Held(_) | Suspended(_));
        let is_holding = matches!(self.state, Holding(_)) || is_vain && !stands;
        if is_holding && phase.moving_device() == Some(device) {
            self.enter_state(Holding(phase_after_link_loss(phase)));
            if is_vain {
                // Keep this deadline, however often the link comes back meanwhile.
                self.hold_deadline = self.hold_deadline.or(self.deadline);
                self.deadline = self.hold_deadline;
            }
        } else if needed {
            self.enter_state(wait(phase_after_link_loss(phase)));
        }
    }

    pub(super) fn on_link_back(&mut self, device: Device, boot_id: u32) {
        let known = self.machine_mut(device);
        let same = known.boot_id.replace(boot_id).is_none_or(|before| before == boot_id);
        if self.state == Starting {
            self.set_link_lost(device, false);
            return self.push(Command::Connect { device });
        }
        if !same {
            self.on_machine_restarted(device);
        }
        self.remove_cause(SuspensionCause::Link(device), AlarmId::LinkLost);
        match self.state {
            Holding(phase) | Held(phase)
                if same
                    && phase.job() == Some((device, JobStep::Reconcile))
                    && !(matches!(self.state, Held(_)) && self.failure_series[device as usize].reported) =>
            {
                self.enter_state(Holding(phase));
                self.push(Command::Reconcile { device, cycle: self.cycle });
            }
            _ => {}
        }
    }

    fn on_machine_restarted(&mut self, device: Device) {
        self.raise(AlarmId::MachineRestarted, &device.to_string());
        let Some(phase) = self.state.phase() else { return };
        let Some((_, step)) = restart_phase(phase).job().filter(|(job, _)| *job == device) else { return };
        match step {
            JobStep::Send => {}
            // The job is known to be over. The answer to a later request shows whether its result is still there.
            JobStep::Acknowledge | JobStep::Discard => self.enter_state(Held(phase)),
            _ => self.enter_state(Held(Phase::from_job(device, JobStep::Reconcile))),
        }
    }

    /// Handles the failure of a station: the task of this program that communicates with the machine `device`. `reason`
    /// is the reason. A station does not recover by itself, so the cell raises an alarm and waits for a person.
    ///
    /// If the cell is starting, the run is stopped. If the present phase needs this machine, the cell becomes held at
    /// once. Otherwise an executing cell is held after the present phase. If the other machine runs its job, the cell
    /// orders it to hold.
    pub(super) fn on_station_failed(&mut self, device: Device, reason: &str) {
        self.set_link_lost(device, true);
        let case = format!("{device}, {reason}");
        self.raise(AlarmId::ProgramFailed, &case);
        match self.state {
            Starting => self.stop(&case, false),
            state => {
                let Some(phase) = state.phase() else { return };
                let needed =
                    phase.job().map(|(job, _)| job) == Some(device) || phase.device_awaited_clear() == Some(device);
                if needed {
                    self.enter_state(Held(phase_after_link_loss(phase)));
                } else if let Execute(_) | Unholding(_) | Unsuspending(_) = state {
                    self.hold(phase);
                }
            }
        }
    }

    /// Handles a restart of this program by `actor`. Forgets the reported states of the machines, raises an alarm,
    /// holds the cell and connects both machines. The machines may still run the job of this run. If a machine may be
    /// moving, the cell therefore continues at the step Reconcile, which asks for the state of the job.
    ///
    /// If the part was accepted already, raises an alarm and ends the run instead.
    pub(super) fn on_restarted(&mut self, actor: &str) {
        if self.state == Completing {
            self.raise(
                AlarmId::NotClear,
                "the program ended before the confirmation that both machines are clear of the part",
            );
            return self.finish_complete();
        }
        for known in &mut self.machines {
            *known = MachineStatus { was_connected: known.was_connected, ..MachineStatus::default() };
        }
        self.suspension_causes.clear();
        self.withdraw(AlarmId::LinkLost);
        self.withdraw(AlarmId::ConditionLost);
        self.raise(AlarmId::ProgramRestarted, &format!("by {actor}"));
        let phase = self.state.phase().unwrap_or(Load);
        self.enter_state(Held(phase_after_link_loss(phase)));
        for device in Device::BOTH {
            self.push(Command::Connect { device });
        }
    }

    pub(super) fn set_link_lost(&mut self, device: Device, lost: bool) {
        if lost {
            self.suspension_causes.insert(SuspensionCause::Link(device));
            self.machine_mut(device).clear = false;
        } else {
            self.suspension_causes.remove(&SuspensionCause::Link(device));
        }
    }

    /// Adds a failure at the present time to the [`FailureSeries`] (failures in a row) of the machine `device`.
    /// `recurring_failure_time` in the deadlines of the plan is the maximum duration of such a series. Begins a new
    /// series if the last failure was too long ago. This is the case after more than twice `recurring_failure_time`, or
    /// after more than half of `recurring_failure_time` if the machine is running its job.
    ///
    /// Returns true if the cell must stop retrying. This is the case if the series has the maximum number of failures,
    /// `max_recurring_failures`. It is also the case if the series has at least [`MIN_RECURRING_FAILURES`] failures and
    /// lasts at least `recurring_failure_time`.
    pub(super) fn count_failure(&mut self, device: Device) -> bool {
        let Deadlines { recurring_failure_time, max_recurring_failures, .. } = self.plan.deadlines;
        let now = self.now;
        let in_sight = matches!(self.state, Execute(phase) if phase == Phase::from_job(device, JobStep::Run));
        let FailureSeries { failures, first: since, last, .. } = &mut self.failure_series[device as usize];
        // An old failure has nothing to do with this one. Nor has one after which the job was seen running for a while.
        let over = if in_sight { recurring_failure_time / 2 } else { recurring_failure_time.saturating_mul(2) };
        if *failures == 0 || now.saturating_sub(*last) > over {
            (*failures, *since) = (0, now);
        }
        (*failures, *last) = (*failures + 1, now);
        *failures >= max_recurring_failures
            || *failures >= MIN_RECURRING_FAILURES && now.saturating_sub(*since) >= recurring_failure_time
    }

    /// Resets the [`FailureSeries`] (failures in a row) of the machine `device`, which has made progress. If the cell
    /// had raised the alarm [`AlarmId::FailsAgain`] for this series, also withdraws the alarm. The alarm remains if the
    /// other machine has a series for which it was raised.
    pub(super) fn reset_failures(&mut self, device: Device) {
        let was_told = std::mem::take(&mut self.failure_series[device as usize]).reported;
        if was_told && !self.failure_series.iter().any(|series| series.reported) {
            self.withdraw(AlarmId::FailsAgain);
        }
    }

    pub(super) fn raise_recurring_failure(&mut self, device: Device, phase: Phase, reason: &str) {
        self.failure_series[device as usize].reported = true;
        let FailureSeries { failures, first: since, .. } = self.failure_series[device as usize];
        let seconds = self.now.saturating_sub(since).as_secs();
        self.raise(
            AlarmId::FailsAgain,
            &format!("{device}, {phase}, {failures} failures in {seconds} s, last reason: {reason}"),
        );
    }
}
