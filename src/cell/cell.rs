//! State that the cell keeps between two events.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use super::alarm::{Alarm, AlarmId};
use super::command::Command;
use super::event::{Condition, Figures};
use super::plan::CellPlan;
use super::state::{Device, JobStep, Phase, State};

/// Cause of a suspension.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum SuspensionCause {
    Link(Device),
    Condition(Device, Condition),
}

/// State of one machine as far as the cell knows it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct MachineStatus {
    /// Boot id of the connection. `None` before the first one and after a restart of this program.
    pub(super) boot_id: Option<u32>,
    /// True if the machine was connected at any time in this run. An abort is then also sent to this machine.
    pub(super) was_connected: bool,
    /// True if the machine is connected, and is idle or busy with the job of this run.
    pub(super) ready: bool,
    /// True if a fresh status has shown it clear of the part, and it has not been started since.
    pub(super) clear: bool,
    /// True if a person has confirmed it clear of the part, and it has not been started since.
    pub(super) clear_confirmed: bool,
    /// True if the machine cannot report whether it is clear of the part, and a person is being asked.
    pub(super) clear_requested: bool,
    /// True if it has ended its safe sequence.
    pub(super) abort_confirmed: bool,
    /// True if it is in manual mode.
    pub(super) manual: bool,
    /// True if the machine moved without an order, was then ordered to hold, and has not yet confirmed that it is at
    /// rest.
    pub(super) moves_unordered: bool,
}

/// Series of failures of a machine without progress in between.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct FailureSeries {
    pub(super) failures: u32,
    /// Time of the first and of the last failure.
    pub(super) first: Duration,
    pub(super) last: Duration,
    /// True if the series was reported to a person.
    pub(super) reported: bool,
}

/// Cell during a run. Copies of a cell share its large fields, because [`super::transition_table()`] creates millions
/// of copies.
#[derive(Clone, Debug)]
pub struct Cell {
    pub(super) plan: Arc<CellPlan>,
    pub(super) state: State,
    pub(super) cycle: u32,
    /// Number of passes that the grinder has begun.
    pub(super) pass_count: u32,
    /// True if the pass record of this cycle is implausible.
    pub(super) pass_record_doubted: bool,
    /// True for each machine that has reported that it executes the last job requested by the cell. A later report
    /// without this job does not reset the flag.
    pub(super) job_observed: [bool; 2],
    pub(super) machines: [MachineStatus; 2],
    pub(super) suspension_causes: BTreeSet<SuspensionCause>,
    pub(super) active_alarms: BTreeMap<AlarmId, Arc<Alarm>>,
    /// Figures of this cycle before its judgement (`figures`), and figures of the last judged cycle (`previous`).
    pub(super) figures: Option<Arc<Figures>>,
    pub(super) previous: Option<Arc<Figures>>,
    /// Cycle that came nearest to acceptance, and its figures.
    pub(super) best_cycle: Option<(u32, Arc<Figures>)>,
    /// Number of consecutive cycles that were worse than the one before.
    pub(super) diverging_cycles: u32,
    /// Reason of the ending, stored until the run ends (`ending_reason`). `not_accepted` is true if the ending is
    /// `NotAccepted`.
    pub(super) ending_reason: String,
    pub(super) not_accepted: bool,
    /// True if a person ordered the ending.
    pub(super) end_ordered: bool,
    pub(super) abort_repeated: bool,
    /// Machine that is being stopped, while the cell is being stopped.
    pub(super) stopping_machine: Option<Device>,
    /// True for each machine that refused the request to discard its result.
    pub(super) acknowledge_refused: [bool; 2],
    /// Time of the event that is being handled, and time of the next deadline.
    pub(super) now: Duration,
    pub(super) deadline: Option<Duration>,
    /// Time by which a machine that was ordered to hold must be at rest.
    pub(super) hold_deadline: Option<Duration>,
    /// Time of the last progress report of the running job, and longest time between two reports. `stall_notified` is
    /// true if a person was notified that the reports have stopped.
    pub(super) last_progress: Option<Duration>,
    pub(super) max_progress_interval: Duration,
    pub(super) stall_notified: bool,
    /// Furthest position that the cell has reached: number of the cycle, and position in this cycle
    /// ([`Phase::position`]).
    pub(super) furthest_position: (u32, u8),
    /// Failure series of each machine.
    pub(super) failure_series: [FailureSeries; 2],
    pub(super) commands: Vec<Command>,
}

impl Cell {
    /// Returns a cell in the state `Idle` that follows `plan`. It waits for `Event::Start`.
    pub fn new(plan: CellPlan) -> Self {
        Self {
            plan: Arc::new(plan),
            state: State::Idle,
            cycle: 0,
            pass_count: 0,
            pass_record_doubted: false,
            job_observed: [false; 2],
            machines: [MachineStatus::default(); 2],
            suspension_causes: BTreeSet::new(),
            active_alarms: BTreeMap::new(),
            figures: None,
            previous: None,
            best_cycle: None,
            diverging_cycles: 0,
            ending_reason: String::new(),
            not_accepted: false,
            end_ordered: false,
            abort_repeated: false,
            stopping_machine: None,
            acknowledge_refused: [false; 2],
            now: Duration::ZERO,
            deadline: None,
            hold_deadline: None,
            last_progress: None,
            max_progress_interval: Duration::ZERO,
            stall_notified: false,
            furthest_position: (0, 0),
            failure_series: [FailureSeries::default(); 2],
            commands: Vec::new(),
        }
    }

    /// Returns the present state of the cell: a PackML state, with the phase of the cycle if the state has one.
    pub fn state(&self) -> State {
        self.state
    }

    /// Returns a description of the state for people. The description also names each machine that should be at rest in
    /// this state but has not confirmed it.
    pub fn in_words(&self) -> String {
        match (self.state, &self.unconfirmed()[..]) {
            (State::Aborted, [device]) => format!("{}: the {device} has not confirmed that it is at rest", self.state),
            (State::Aborted, [_, _]) => format!("{}: neither machine has confirmed that it is at rest", self.state),
            (state, _) => state.to_string(),
        }
    }

    /// Returns the machines that should be at rest in the present state but have not confirmed it:
    ///
    /// - In the state `Aborted`: each machine that was connected in this run and has not confirmed ABORT.
    /// - In the states `Held` and `Suspended`: the machine whose job has an unknown state.
    ///
    /// The list is empty in all other cases.
    pub fn unconfirmed(&self) -> Vec<Device> {
        match self.state {
            State::Aborted => self.unconfirmed_aborts(),
            state => state.unconfirmed().into_iter().collect(),
        }
    }

    pub(super) fn unconfirmed_aborts(&self) -> Vec<Device> {
        let known = |device: Device| self.machines[device as usize];
        Device::BOTH
            .into_iter()
            .filter(|device| known(*device).was_connected && !known(*device).abort_confirmed)
            .collect()
    }

    /// Returns the number of the present cycle (one pass with its measurement). Returns 0 before the first cycle.
    pub fn cycle(&self) -> u32 {
        self.cycle
    }

    /// Returns the plan of the run: its first step, tolerance, limits and deadlines.
    pub fn plan(&self) -> &CellPlan {
        &self.plan
    }

    /// Returns the figures (such as PV and RMS) of the last registered measurement. Returns `None` before the first
    /// one.
    pub fn figures(&self) -> Option<&Figures> {
        self.figures.as_deref().or(self.previous.as_deref())
    }

    /// Returns true if `command` must still be executed after it was written to the journal. The state of the cell may
    /// have changed in the meantime. There are three rules:
    ///
    /// - START and RESUME cause motion. They are executed only if the cell is still in the state that issued them.
    /// - If the run is ending, only two kinds of command are executed: those that belong to the way in which it ends
    ///   (for example ABORT while the cell is aborting, or STOP while it is stopping), and the announcement of a
    ///   verdict. If the run has ended, only the announcement of a verdict is executed.
    /// - Every other command is executed.
    pub fn still_requires(&self, command: &Command) -> bool {
        let at = |device, step| self.state.phase() == Some(Phase::from_job(device, step));
        match (self.state, command) {
            (State::Aborting, Command::Connect { .. } | Command::AbortMachine { .. } | Command::VerifyClear { .. }) => {
                true
            }
            (State::Stopping, Command::StopMachine { .. } | Command::Acknowledge { .. }) => true,
            (State::Completing, Command::VerifyClear { .. }) => true,
            (state, _) if state.is_end() => matches!(command, Command::Announce(_)),
            (State::Aborting | State::Stopping | State::Completing, _) => matches!(command, Command::Announce(_)),
            (State::Execute(_), Command::StartMachine { device, cycle }) => {
                at(*device, JobStep::Start) && *cycle == self.cycle
            }
            (State::Unholding(_) | State::Unsuspending(_), Command::ResumeMachine { device }) => {
                at(*device, JobStep::Run)
            }
            (_, Command::StartMachine { .. } | Command::ResumeMachine { .. }) => false,
            _ => true,
        }
    }

    /// Returns the alarms that were raised and not withdrawn yet, in the order of [`AlarmId`].
    pub fn alarms(&self) -> impl Iterator<Item = &Alarm> + '_ {
        self.active_alarms.values().map(AsRef::as_ref)
    }

    /// Returns the machine about which the cell is asking a person: "is this machine clear of the part?". Returns
    /// `None` if the cell is not asking this.
    pub fn clear_confirmation_device(&self) -> Option<Device> {
        self.state.phase().filter(|phase| self.is_asking_whether_clear(*phase)).and_then(Phase::device_awaited_clear)
    }

    /// Returns the time at which the caller must send `Event::Deadline`, measured from the beginning of the run.
    /// Returns `None` if the present state has no time limit.
    pub fn next_deadline(&self) -> Option<Duration> {
        self.deadline
    }

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
}
