//! Time limits of the states, and what the cell does when one is over.

use std::time::Duration;

use super::alarm::AlarmId;
use super::cell::Cell;
use super::phase_queries::restart_phase;
use super::state::{Device, JobStep, Phase, State};

use Phase::{Compensate, Judge, Load, Register};
use State::{
    Aborted, Aborting, Complete, Completing, Execute, Held, Holding, Idle, Starting, Stopped, Stopping, Suspended,
    Suspending, Unholding, Unsuspending,
};

impl Cell {
    /// Handles the end of a time limit. If the deadline of the present state is reached, raises an alarm or notifies
    /// people, and then does the next safe step: for example holds, stops or aborts the run. Does nothing if the
    /// deadline is not reached yet or if there is none.
    pub(super) fn on_deadline(&mut self) {
        if !self.is_deadline_reached() {
            return;
        }
        match self.state {
            Starting => {
                self.raise(AlarmId::Unreachable, "at least one machine did not connect in time");
                self.stop("at least one machine did not connect in time", false);
            }
            Held(_) | Execute(Load) => {
                self.raise(AlarmId::WaitedTooLong, "");
                self.stop("no person answered in time", false);
            }
            Execute(phase) | Holding(phase) | Suspending(phase) | Unholding(phase) | Unsuspending(phase) => {
                self.on_phase_deadline(phase);
            }
            Suspended(phase) => {
                self.raise(AlarmId::StaysSuspended, "");
                self.enter_state(Held(phase));
            }
            Stopping => {
                let names = self.stopping_machine.map_or("no machine".to_owned(), |device| device.to_string());
                self.raise(AlarmId::StopNotConfirmed, &format!("{names}, no report within the time limit for a stop"));
                self.abort("the machine did not confirm the ordered stop in time");
            }
            Aborting => self.on_abort_deadline(),
            Completing => {
                self.raise(AlarmId::NotClear, "no confirmation in time that both machines are clear of the part");
                self.finish_complete();
            }
            Idle | Stopped | Aborted | Complete => {}
        }
    }

    fn on_phase_deadline(&mut self, phase: Phase) {
        match (phase.job(), self.state) {
            (Some((device, JobStep::Run | JobStep::Reconcile)), Holding(_) | Suspending(_))
                if self.hold_deadline.is_some() =>
            {
                self.raise(AlarmId::HoldNotConfirmed, &device.to_string());
                self.abort(&format!("the {device} did not confirm the hold in time"));
            }
            (Some((device, JobStep::Run)), Execute(_)) if self.needs_stall_notice(device) => self.notify_stall(device),
            (Some((device, JobStep::Run)), _) => {
                self.raise(AlarmId::NoAnswer, &format!("{device}, no report of its job"));
                self.hold(phase);
            }
            (Some((device, JobStep::Start)), _) => self.reconcile(device),
            (Some((device, JobStep::Reconcile)), _) => self.hold_unknown_outcome(device, "it gave no answer in time"),
            _ if matches!(phase, Register | Compensate) => {
                self.raise(AlarmId::ComputationLate, phase.name());
                self.enter_state(Held(phase));
            }
            _ => {
                self.raise(AlarmId::NoAnswer, &phase.to_string());
                self.enter_state(Held(restart_phase(phase)));
            }
        }
    }

    fn on_abort_deadline(&mut self) {
        let unconfirmed = self.unconfirmed_aborts();
        if unconfirmed.is_empty() {
            self.raise(AlarmId::NotClear, "no confirmation in time that both machines are clear of the part");
            return self.finish_aborted(true);
        }
        if self.abort_repeated {
            return self.finish_aborted(false);
        }
        self.abort_repeated = true;
        let names: Vec<_> = unconfirmed.iter().map(Device::to_string).collect();
        self.raise(AlarmId::StopNotConfirmed, &names.join(" and "));
        self.enter_state(Aborting);
        self.abort_unconfirmed();
    }

    /// Returns true if the next step after missing progress reports of the machine `device` is to notify people. This
    /// requires that nobody was notified yet and that the plan has a notification time below the time limit of the job.
    fn needs_stall_notice(&self, device: Device) -> bool {
        !self.stall_notified && self.progress_limit(device) < self.plan.deadlines.progress[device as usize]
    }

    fn notify_stall(&mut self, device: Device) {
        let told = self.progress_limit(device);
        self.stall_notified = true;
        let left = self.progress_limit(device);
        self.raise(
            AlarmId::ProgressStands,
            &format!(
                "{device}, no progress for {} s; without progress, the cell holds this machine in {} s",
                told.as_secs(),
                left.as_secs()
            ),
        );
        self.deadline = Some(self.now.saturating_add(left));
    }

    fn is_deadline_reached(&self) -> bool {
        self.deadline.is_some_and(|deadline| self.now >= deadline)
    }

    /// Returns the time limit of the present state; a progress report restarts it. `None` means no limit.
    pub(super) fn state_time_limit(&self) -> Option<Duration> {
        let limits = &self.plan.deadlines;
        let job = self.state.phase().and_then(Phase::job).map(|(_, step)| step);
        match (self.state, job) {
            (Execute(phase), _) if self.is_asking_whether_clear(phase) => limits.load,
            (Idle | Stopped | Aborted | Complete | Execute(Judge), _) => None,
            (Starting, _) => Some(limits.connect),
            (Execute(Load), _) => limits.load,
            (Held(_), _) => limits.held,
            (Suspended(_), _) => Some(limits.suspended),
            (Stopping, _) => self.stopping_machine.map(|device| limits.stop[device as usize]),
            (Aborting, _) => Some(limits.abort),
            (Execute(phase), Some(JobStep::Run)) => phase.moving_device().map(|device| self.progress_limit(device)),
            (Holding(phase) | Suspending(phase), Some(JobStep::Run)) => {
                phase.moving_device().map(|device| limits.hold[device as usize])
            }
            (_, Some(JobStep::Send | JobStep::Collect)) => Some(limits.transfer),
            (_, Some(JobStep::Qualify)) => Some(limits.compute),
            (Execute(Register | Compensate) | Holding(Register | Compensate), _) => Some(limits.compute),
            _ => Some(limits.answer),
        }
    }

    /// Returns the time without a progress report after which the cell must react, while the machine `device` runs its
    /// job. There are three cases:
    ///
    /// - People were not notified yet, and the notification time is below the time limit of the job: the notification
    ///   time. It is at least three times the longest interval between two reports.
    /// - People were notified: the rest of the time limit. The cell then holds the job.
    /// - There is no notification time below the time limit: the whole time limit. The cell then holds the job.
    fn progress_limit(&self, device: Device) -> Duration {
        let limit = self.plan.deadlines.progress[device as usize];
        let notice =
            self.plan.deadlines.progress_notice[device as usize].map(|least| least.max(3 * self.max_progress_interval));
        match notice.filter(|notice| *notice < limit) {
            Some(notice) if self.stall_notified => limit - notice,
            Some(notice) => notice,
            None => limit,
        }
    }
}
