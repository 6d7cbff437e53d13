//! Transitions of the cell: the actions that the arms of the table call.

use std::sync::Arc;
use std::time::Duration;

use super::alarm::{Alarm, AlarmId};
use super::cell::{Cell, FailureSeries, MachineStatus, SuspensionCause};
use super::command::{Command, Ending, Judgement, Verdict};
use super::event::{
    CompensationRefusal, Condition, ConnectionRefusal, Figures, GateFailure, GateResult, JobResult, MachineRequest,
    Occupation, PartResponse, Reconciliation, RecordFailure,
};
use super::judge::{self, ReasonedVerdict, format_um};
use super::plan::{Deadlines, FirstStep, HoldOrStop};
use super::state::{Device, JobStep, Phase, State};

use Phase::{Compensate, Grind, Judge, Load, Measure, Register, Transfer};
use State::{
    Aborted, Aborting, Complete, Completing, Execute, Held, Holding, Idle, Starting, Stopped, Stopping, Suspended,
    Suspending, Unholding, Unsuspending,
};

/// Minimum number of failures in a series before the time limit
/// `recurring_failure_time` of [`Deadlines`] can end the retries.
const MIN_RECURRING_FAILURES: u32 = 3;

// Basic operations, which the other blocks build on.
impl Cell {
    pub(super) fn push(&mut self, command: Command) {
        self.commands.push(command);
    }

    pub(super) fn machine(&self, device: Device) -> &MachineStatus {
        &self.machines[device as usize]
    }

    pub(super) fn machine_mut(&mut self, device: Device) -> &mut MachineStatus {
        &mut self.machines[device as usize]
    }

    pub(super) fn raise(&mut self, id: AlarmId, case: &str) {
        let alarm = Alarm::new(id, case);
        self.active_alarms.insert(id, Arc::new(alarm.clone()));
        self.push(Command::Raise(alarm));
    }

    pub(super) fn withdraw(&mut self, alarm: AlarmId) {
        if self.active_alarms.remove(&alarm).is_some() {
            self.push(Command::Withdraw { alarm });
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

    /// Resets the [`FailureSeries`] (failures in a row) of the machine `device`, which has made progress. If the cell
    /// had raised the alarm [`AlarmId::FailsAgain`] for this series, also withdraws the alarm. The alarm remains if the
    /// other machine has a series for which it was raised.
    fn reset_failures(&mut self, device: Device) {
        let was_told = std::mem::take(&mut self.failure_series[device as usize]).reported;
        if was_told && !self.failure_series.iter().any(|series| series.reported) {
            self.withdraw(AlarmId::FailsAgain);
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
    fn count_failure(&mut self, device: Device) -> bool {
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

    fn raise_recurring_failure(&mut self, device: Device, phase: Phase, reason: &str) {
        self.failure_series[device as usize].reported = true;
        let FailureSeries { failures, first: since, .. } = self.failure_series[device as usize];
        let seconds = self.now.saturating_sub(since).as_secs();
        self.raise(
            AlarmId::FailsAgain,
            &format!("{device}, {phase}, {failures} failures in {seconds} s, last reason: {reason}"),
        );
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

    /// Returns the time limit of the present state; a progress report restarts it. `None` means no limit.
    fn state_time_limit(&self) -> Option<Duration> {
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

    pub(super) fn is_deadline_reached(&self) -> bool {
        self.deadline.is_some_and(|deadline| self.now >= deadline)
    }
}

// The sequence of a run.
impl Cell {
    pub(super) fn start_run(&mut self) {
        self.enter_state(Starting);
        for device in Device::BOTH {
            self.push(Command::Connect { device });
        }
    }

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
    fn enter_phase(&mut self, phase: Phase) {
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

    fn verify_clear(&mut self, device: Device) {
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
    fn start_machine(&mut self, device: Device) {
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

    pub(super) fn on_acknowledged(&mut self, phase: Phase) {
        match phase {
            Grind(JobStep::Acknowledge) => self.advance(Transfer),
            Grind(_) => self.enter_state(Held(Transfer)),
            Measure(JobStep::Acknowledge) => self.advance(Register),
            _ => self.repeat_measurement(),
        }
    }

    /// Prepares a repetition of the measurement: takes the next cycle number, and holds the cell before the plan is
    /// sent. A person resumes the cell. The measurement gets a new number, so that no START is sent twice for one
    /// cycle.
    pub(super) fn repeat_measurement(&mut self) {
        self.cycle += 1;
        self.enter_state(Held(Measure(JobStep::Send)));
    }

    pub(super) fn on_collected(&mut self, targets: u32, found: u32, gate: &GateResult) {
        let share = f64::from(found) / f64::from(targets.max(1));
        let gate = match gate {
            GateResult::Failed(reason) => Some(gate_alarm(reason)),
            GateResult::Passed if found > targets || share < self.plan.gates.min_found_share => {
                let least = 100.0 * self.plan.gates.min_found_share;
                Some((
                    AlarmId::Coverage,
                    format!(
                        "the probe found {found} of {targets} planned points, allowed are {least:.0} % to 100 % of the planned points"
                    ),
                ))
            }
            GateResult::Passed => None,
        };
        match gate {
            Some((id, case)) => {
                self.raise(id, &case);
                self.advance(Measure(JobStep::Discard));
            }
            None if self.plan.gates.max_radius_error_mm.is_some() => self.advance(Measure(JobStep::Qualify)),
            None => self.advance(Measure(JobStep::Acknowledge)),
        }
    }

    pub(super) fn on_qualified(&mut self, radius_error_mm: f64) {
        let most = self.plan.gates.max_radius_error_mm.unwrap_or(f64::INFINITY);
        if radius_error_mm.abs() <= most {
            return self.advance(Measure(JobStep::Acknowledge));
        }
        let case = format!("the difference is {}, limit {}", format_um(radius_error_mm), format_um(most));
        self.raise(AlarmId::ProbeRadius, &case);
        self.advance(Measure(JobStep::Discard));
    }

    /// Rejects a measurement that cannot be used. Raises the alarm `id`, in which `case` describes the fault, and
    /// prepares a repetition of the measurement. The cell is then held until a person resumes it.
    pub(super) fn reject_measurement(&mut self, id: AlarmId, case: &str) {
        self.raise(id, case);
        self.repeat_measurement();
    }

    pub(super) fn on_registered(&mut self, figures: &Figures) {
        let gates = self.plan.gates;
        let (shift, turn) = (figures.shift_mm, figures.rotation_rad.to_degrees());
        if !figures.are_valid() {
            self.reject_measurement(
                AlarmId::RegistrationFailed,
                "a figure of the registration is negative or not a number",
            );
        } else if figures.further_touches.is_none() && figures.coverage < gates.min_coverage {
            let (found, least) = (100.0 * figures.coverage, 100.0 * gates.min_coverage);
            self.reject_measurement(
                AlarmId::Coverage,
                &format!("{found:.0} % of the aperture is covered, at least {least:.0} % is required"),
            );
        } else if shift > gates.max_shift_mm || figures.rotation_rad > gates.max_rotation_rad {
            let (most, max_turn) = (gates.max_shift_mm, gates.max_rotation_rad.to_degrees());
            let case = format!("shift {shift:.3} mm, limit {most:.3} mm; turn {turn:.2}°, limit {max_turn:.2}°");
            self.reject_measurement(AlarmId::PartMisplaced, &case);
        } else if figures.further_touches.is_some() {
            // More points of the same measurement follow. A partial measurement is not judged.
            self.advance(Measure(JobStep::Send));
        } else {
            self.figures = Some(Arc::new(figures.clone()));
            self.advance(Judge);
        }
    }

    fn judge_cycle(&mut self) {
        let Some(figures) = self.figures.take() else { return self.enter_state(Held(Register)) };
        let ReasonedVerdict { verdict, mut reason } =
            judge::judge(&self.plan, self.previous.as_deref(), &figures, self.pass_count);
        let response = figures.response;
        if verdict == Verdict::LeftOut {
            // The figures of the part are not known yet, so nothing is compared with them.
            self.push(Command::Announce(Judgement { cycle: self.cycle, verdict, reason: reason.clone() }));
            if !figures.with_outliers.as_ref().is_some_and(|left_out| left_out.can_repeat) {
                return self.reject_measurement(AlarmId::LeftOut, &reason);
            }
            // Touch only the named places again, in the same measurement. A point that is not touched again keeps its
            // value.
            self.raise(AlarmId::LeftOut, &reason);
            return self.enter_state(Held(Measure(JobStep::Send)));
        }
        let distance = |of: &Figures| judge::distance_to_acceptance(&self.plan, of);
        match &self.best_cycle {
            Some((cycle, best)) if distance(best) < distance(&figures) && *cycle != self.cycle => {
                if !matches!(verdict, Verdict::Accept | Verdict::Continue | Verdict::WrongResponse) {
                    reason += &judge::best_in_words(&self.plan, *cycle, best);
                }
            }
            _ => self.best_cycle = Some((self.cycle, Arc::clone(&figures))),
        }
        self.previous = Some(figures);
        self.diverging_cycles = if verdict == Verdict::Diverging { self.diverging_cycles + 1 } else { 0 };
        self.push(Command::Announce(Judgement { cycle: self.cycle, verdict, reason: reason.clone() }));
        match verdict {
            Verdict::Accept => self.accept(reason),
            Verdict::LeftOut => {}
            Verdict::Continue => self.advance(Compensate),
            Verdict::MaxCycles => self.stop_not_accepted(AlarmId::MaxCycles, &reason),
            Verdict::BudgetSpent => self.stop_not_accepted(AlarmId::BudgetSpent, &reason),
            Verdict::Diverging => {
                self.raise(AlarmId::Diverging, &reason);
                if self.diverging_cycles < 2 {
                    self.advance(Compensate)
                } else {
                    self.hold_or_stop(self.plan.on_divergence, &reason)
                }
            }
            Verdict::Stalled => {
                self.raise(AlarmId::Stalled, &reason);
                self.hold_or_stop(self.plan.on_stall, &reason);
            }
            Verdict::Undecided => {
                self.raise(AlarmId::Undecided, &reason);
                self.hold_or_stop(self.plan.on_stall, &reason);
            }
            Verdict::WrongResponse => {
                self.raise(response.map_or(AlarmId::NoEffect, response_alarm), &reason);
                self.enter_state(Held(Compensate));
            }
        }
    }

    fn accept(&mut self, reason: String) {
        self.ending_reason = reason;
        self.enter_state(Completing);
        for device in Device::BOTH {
            self.verify_clear(device);
        }
    }

    fn stop_not_accepted(&mut self, id: AlarmId, reason: &str) {
        self.raise(id, reason);
        self.stop(reason, true);
    }

    fn hold_or_stop(&mut self, disposal: HoldOrStop, reason: &str) {
        match disposal {
            HoldOrStop::Hold => self.enter_state(Held(Compensate)),
            HoldOrStop::Stop => self.stop(reason, true),
        }
    }

    pub(super) fn on_compensation_refused(&mut self, refusal: &CompensationRefusal) {
        match refusal {
            CompensationRefusal::BudgetSpent(message) => {
                let (cycle, verdict, reason) = (self.cycle, Verdict::BudgetSpent, message.clone());
                self.push(Command::Announce(Judgement { cycle, verdict, reason }));
                self.stop_not_accepted(AlarmId::BudgetSpent, message);
            }
            CompensationRefusal::WeakDirections(directions) => {
                let case = directions.join(", ");
                self.raise(AlarmId::WeakDirections, &case);
                self.hold_or_stop(self.plan.on_refusal, &format!("no correction is computed: {case}"));
            }
            CompensationRefusal::Failed(message) => {
                self.raise(AlarmId::CompensationFailed, message);
                self.hold_or_stop(self.plan.on_refusal, message);
            }
        }
    }
}

// Interruptions.
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

    /// Returns true if a machine is in manual mode.
    fn has_manual_machine(&self) -> bool {
        self.machines.iter().any(|known| known.manual)
    }

    fn raise_manual_mode(&mut self) {
        let names: Vec<_> =
            Device::BOTH.into_iter().filter(|device| self.machine(*device).manual).map(|d| d.to_string()).collect();
        self.raise(AlarmId::NotAutomatic, &format!("{} in manual mode", names.join(" and ")));
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

    /// Handles a progress report of the running job: resets the failures of the machine, restarts the time limit, and
    /// stores the longest interval between two reports.
    pub(super) fn on_progressed(&mut self, device: Device) {
        self.reset_failures(device);
        if let Some(last) = self.last_progress.replace(self.now) {
            self.max_progress_interval = self.max_progress_interval.max(self.now.saturating_sub(last));
        }
        self.enter_state(self.state);
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

    /// Suspends the cell at `phase`, because a condition (supplies or a required signal) is missing while a machine may
    /// move. The cell becomes suspending. If a machine runs its job, the cell orders it to hold.
    pub(super) fn suspend(&mut self, phase: Phase) {
        self.enter_state(Suspending(phase));
        if let Some((device, JobStep::Run)) = phase.job() {
            self.push(Command::HoldMachine { device });
        }
    }

    fn enter_suspended(&mut self, phase: Phase) {
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

    pub(super) fn on_condition_lost(&mut self, device: Device, condition: Condition, message: &str) {
        if self.suspension_causes.insert(SuspensionCause::Condition(device, condition)) {
            self.raise(AlarmId::ConditionLost, &format!("{device}, {condition}, {message}"));
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

    pub(super) fn remove_cause(&mut self, cause: SuspensionCause, alarm: AlarmId) {
        self.suspension_causes.remove(&cause);
        let is_link = |cause: &SuspensionCause| matches!(cause, SuspensionCause::Link(_));
        if !self.suspension_causes.iter().any(|other| is_link(other) == is_link(&cause)) {
            self.withdraw(alarm);
        }
        self.unsuspend_if_possible();
    }

    pub(super) fn raise_record_failed(&mut self, reason: &RecordFailure) {
        let (id, message) = match reason {
            RecordFailure::DiskFull(message) => (AlarmId::DiskFull, message),
            RecordFailure::Unwritable(message) => (AlarmId::JournalUnwritable, message),
        };
        self.raise(id, message);
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

    fn hold_unknown_outcome(&mut self, device: Device, message: &str) {
        let id = if self.job_observed[device as usize] { AlarmId::JobVanished } else { AlarmId::StartUnknown };
        self.raise(id, &format!("{device}, {message}"));
        self.enter_state(Held(Phase::from_job(device, JobStep::Reconcile)));
    }

    pub(super) fn reconcile(&mut self, device: Device) {
        self.enter_state(self.state_with_phase(Phase::from_job(device, JobStep::Reconcile)));
        self.push(Command::Reconcile { device, cycle: self.cycle });
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
}

// The ends, and time.
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

    fn abort_unconfirmed(&mut self) {
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

    fn finish_aborted(&mut self, confirmed: bool) {
        self.enter_state(Aborted);
        let (cycle, reason) = (self.cycle, std::mem::take(&mut self.ending_reason));
        self.push(Command::Finish(Ending::Aborted { cycle, confirmed, reason }));
    }

    fn finish_complete(&mut self) {
        self.enter_state(Complete);
        let (cycle, reason) = (self.cycle, std::mem::take(&mut self.ending_reason));
        self.push(Command::Finish(Ending::Accepted { cycle, reason }));
    }

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
}

/// Returns the phase from which to restart `phase` after an interruption. At the steps Clear, Prepare and Start of a
/// job, this is the step Send of the same job. In all other cases, it is `phase` itself.
pub(super) fn restart_phase(phase: Phase) -> Phase {
    match phase.job() {
        Some((device, JobStep::Clear | JobStep::Prepare | JobStep::Start)) => Phase::from_job(device, JobStep::Send),
        _ => phase,
    }
}

/// Returns the phase from which to restart `phase` after a lost link or a restart of the program. If a machine may be
/// moving, this is the step Reconcile of its job; otherwise it is the result of [`restart_phase`].
fn phase_after_link_loss(phase: Phase) -> Phase {
    match phase.moving_device() {
        Some(device) => Phase::from_job(device, JobStep::Reconcile),
        None => restart_phase(phase),
    }
}

/// Returns the machine whose result this phase acknowledges or discards; `None` for any other phase.
pub(super) fn device_awaiting_acknowledge(phase: Phase) -> Option<Device> {
    phase.job().filter(|(_, step)| matches!(step, JobStep::Acknowledge | JobStep::Discard)).map(|(device, _)| device)
}

/// Returns true if `phase` waits for the answer of the machine `device` to the request `what`. Returns false if `phase`
/// is not a job of this machine.
pub(super) fn awaits_answer(phase: Phase, device: Device, what: MachineRequest) -> bool {
    let steps: &[JobStep] = match what {
        MachineRequest::Load => &[JobStep::Send],
        MachineRequest::Prepare => &[JobStep::Prepare],
        MachineRequest::Start => &[JobStep::Start],
        MachineRequest::Collect => &[JobStep::Collect],
        MachineRequest::Acknowledge | MachineRequest::Discard => &[JobStep::Acknowledge, JobStep::Discard],
        MachineRequest::Hold
        | MachineRequest::Resume
        | MachineRequest::Stop
        | MachineRequest::Abort
        | MachineRequest::Clear => &[],
    };
    phase.job().is_some_and(|(job, step)| job == device && steps.contains(&step))
}

/// Returns the machine that may be moving in the phase of `state`; `None` if no machine may.
pub(super) fn running_device(state: State) -> Option<Device> {
    state.phase().and_then(Phase::moving_device)
}

/// Returns the machine that the cell is asking for the unknown state of its job (step Reconcile). Returns `None` in any
/// other phase, and also while the cell is held or suspended.
pub(super) fn reconciling_device(state: State) -> Option<Device> {
    match state {
        Execute(phase) | Holding(phase) | Suspending(phase) | Unsuspending(phase) | Unholding(phase) => {
            phase.job().filter(|(_, step)| *step == JobStep::Reconcile).map(|(device, _)| device)
        }
        _ => None,
    }
}

/// Returns the text ", because " with `reason` after it. `reason` is the reason that a person gave. Returns an empty
/// string if `reason` is empty.
pub(super) fn reason_clause(reason: &str) -> String {
    if reason.is_empty() { String::new() } else { format!(", because {reason}") }
}

fn gate_alarm(reason: &GateFailure) -> (AlarmId, String) {
    match reason {
        GateFailure::Coverage(message) => (AlarmId::Coverage, message.clone()),
        GateFailure::NoPart => (AlarmId::NoPart, String::new()),
        GateFailure::Contacts => (AlarmId::Contacts, String::new()),
        GateFailure::Inches => (AlarmId::Inches, "the points of the CMM".to_owned()),
        GateFailure::Foreign(message) => (AlarmId::ForeignResult, message.clone()),
        GateFailure::Broken(message) => (AlarmId::BrokenResult, message.clone()),
        GateFailure::Temperature(message) => (AlarmId::Temperature, message.clone()),
        GateFailure::Moved(message) => (AlarmId::PartMoved, message.clone()),
    }
}

fn response_alarm(response: PartResponse) -> AlarmId {
    match response {
        PartResponse::SignFlipped => AlarmId::SignFlipped,
        PartResponse::Mirrored => AlarmId::Mirrored,
        PartResponse::Doubled => AlarmId::Doubled,
        PartResponse::NoEffect | PartResponse::Expected | PartResponse::Unclear => AlarmId::NoEffect,
    }
}
