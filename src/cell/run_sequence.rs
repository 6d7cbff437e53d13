//! Sequence of a run: its phases from the first cycle on, and how the cell enters them.

use super::alarm::AlarmId;
use super::cell::Cell;
use super::command::Command;
use super::phase_queries::restart_phase;
use super::plan::FirstStep;
use super::state::{Device, JobStep, Phase, State};

use Phase::{Compensate, Grind, Judge, Load, Measure, Register, Transfer};
use State::{Execute, Held, Holding, Starting, Suspended, Suspending, Unholding, Unsuspending};

impl Cell {
    pub(super) fn start_run(&mut self) {
        self.enter_state(Starting);
        for device in Device::BOTH {
            self.push(Command::Connect { device });
        }
    }

    pub(super) fn start_first_cycle(&mut self) {
        self.cycle = 1;
        // The person who loaded the part saw that both machines were clear of it.
        self.machines.iter_mut().for_each(|known| known.clear_confirmed = true);
        self.enter_phase(match self.plan.begin_with {
            FirstStep::Grind => Grind(JobStep::Send),
            FirstStep::Measure => Measure(JobStep::Send),
        });
    }

    /// Enters the phase `next`. If the cell is holding or held, it becomes held instead. If the cell is suspending or
    /// suspended, it becomes suspended instead. In these two cases, the cell continues later from the restart phase of
    /// `next` (see [`restart_phase`]).
    pub(super) fn advance(&mut self, next: Phase) {
        match self.state {
            Holding(_) | Held(_) => self.enter_state(Held(restart_phase(next))),
            Suspending(_) | Suspended(_) => self.enter_suspended(restart_phase(next)),
            _ => self.enter_phase(next),
        }
    }

    /// Enters `phase` and issues the command of this phase. There are two exceptions:
    ///
    /// - If a machine is in manual mode, the cell does not prepare or start a job. It becomes held.
    /// - If there is a cause of a suspension (a lost link or a missing condition), the cell does not enter a phase that
    ///   needs a machine. It becomes suspended.
    pub(super) fn enter_phase(&mut self, phase: Phase) {
        if matches!(phase.job(), Some((_, JobStep::Prepare | JobStep::Start))) && self.has_manual_machine() {
            self.raise_manual_mode();
            return self.enter_state(Held(restart_phase(phase)));
        }
        let alone = matches!(phase, Load | Register | Judge | Compensate);
        if !alone && !self.suspension_causes.is_empty() {
            return self.enter_state(Suspended(restart_phase(phase)));
        }
        self.enter_state(Execute(phase));
        let cycle = self.cycle;
        match phase {
            Load => self.push(Command::AskToLoad),
            Grind(JobStep::Start) => self.start_machine(Device::Grinder),
            Measure(JobStep::Start) => self.start_machine(Device::Cmm),
            Grind(JobStep::Send) => self.push(Command::LoadPass { cycle }),
            Measure(JobStep::Send) => self.push(Command::LoadPlan { cycle }),
            Transfer => self.verify_clear(Device::Grinder),
            Register => self.push(Command::Register { cycle }),
            Judge => self.judge_cycle(),
            Compensate => self.push(Command::Compensate { cycle }),
            Grind(step) => self.enter_step(Device::Grinder, step),
            Measure(step) => self.enter_step(Device::Cmm, step),
        }
    }

    fn enter_step(&mut self, device: Device, step: JobStep) {
        let cycle = self.cycle;
        match step {
            JobStep::Clear => self.verify_clear(device.other()),
            JobStep::Prepare => self.push(Command::Prepare { device, cycle }),
            JobStep::Reconcile => self.push(Command::Reconcile { device, cycle }),
            JobStep::Collect => self.push(Command::Collect { cycle }),
            JobStep::Qualify => self.push(Command::Qualify { cycle }),
            JobStep::Acknowledge | JobStep::Discard => self.push(Command::Acknowledge { device }),
            // The machine runs already, or `start_machine` starts it after the interlock check.
            JobStep::Run | JobStep::Send | JobStep::Start => {}
        }
    }

    /// Enters `state` and sets the deadline of this state. If a running job is being held or suspended, the deadline of
    /// the first HOLD remains valid, even if the cell enters holding or suspending again after a lost link. Withdraws
    /// the alarm about missing progress reports if it was raised.
    pub(super) fn enter_state(&mut self, state: State) {
        if std::mem::take(&mut self.stall_notified) {
            self.withdraw(AlarmId::ProgressStands);
        }
        self.state = state;
        if let Some((device, JobStep::Run)) = state.phase().and_then(Phase::job) {
            self.job_observed[device as usize] = true;
        }
        self.deadline = self.state_time_limit().map(|limit| self.now.saturating_add(limit));
        match (state, state.phase().and_then(Phase::job)) {
            (Holding(_) | Suspending(_), Some((_, JobStep::Run))) => {
                self.hold_deadline = self.hold_deadline.or(self.deadline);
                self.deadline = self.hold_deadline;
            }
            (Holding(_), Some((_, JobStep::Reconcile))) => self.deadline = self.hold_deadline.or(self.deadline),
            _ => self.hold_deadline = None,
        }
    }

    /// Returns the present state with `phase` in place of its phase. The states holding, held, unholding, suspending,
    /// suspended and unsuspending keep their kind. Any other state becomes `Execute(phase)`.
    pub(super) fn state_with_phase(&self, phase: Phase) -> State {
        match self.state {
            Holding(_) => Holding(phase),
            Held(_) => Held(phase),
            Unholding(_) => Unholding(phase),
            Suspending(_) => Suspending(phase),
            Suspended(_) => Suspended(phase),
            Unsuspending(_) => Unsuspending(phase),
            _ => Execute(phase),
        }
    }

    /// Updates the record of how far the cell has come in the run: the highest cycle number, and the furthest phase in
    /// this cycle. If the cell has come further while a machine has a job, resets the [`FailureSeries`] (failures in a
    /// row) of this machine. Does nothing in a state without a phase.
    pub(super) fn update_furthest_position(&mut self) {
        let Some(phase) = self.state.phase() else { return };
        let place = (self.cycle, phase.position());
        if place > self.furthest_position {
            self.furthest_position = place;
            if let Some((device, _)) = phase.job() {
                self.reset_failures(device);
            }
        }
    }
}
