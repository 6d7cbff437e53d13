//! What the cell keeps between two events.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use super::alarm::{Alarm, AlarmId};
use super::command::Command;
use super::event::{Condition, Figures};
use super::plan::CellPlan;
use super::state::{Device, JobStep, Phase, State};

/// Why the cell is suspended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Cause {
    Link(Device),
    Condition(Device, Condition),
}

/// What the cell knows of one machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Known {
    /// The boot id of the connection; none before the first and after a restart of this program.
    pub(super) boot_id: Option<u32>,
    /// Whether it was ever connected in this run, so that an abort must reach it.
    pub(super) met: bool,
    /// Whether it is connected and idle, or busy with this run's job.
    pub(super) ready: bool,
    /// Whether a fresh status has shown it clear of the part, and it has not been started since.
    pub(super) clear: bool,
    /// Whether a person has seen it clear of the part, and it has not been started since.
    pub(super) said_clear: bool,
    /// Whether it cannot tell, and a person is being asked.
    pub(super) asked_clear: bool,
    /// Whether it has ended its safe sequence.
    pub(super) stands: bool,
    /// Whether it is in manual mode.
    pub(super) manual: bool,
    /// Whether it moves without an order, was told to hold, and has not said yet that it stands.
    pub(super) astray: bool,
}

/// The failures of a machine in a row, without getting any further.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Vain {
    pub(super) failures: u32,
    /// When the first and the last of them were.
    pub(super) since: Duration,
    pub(super) last: Duration,
    /// Whether a person was told that it fails again and again.
    pub(super) told: bool,
}

/// A cell in the middle of a run. What is large is shared by its copies, of which [`super::table()`] makes millions.
#[derive(Clone, Debug)]
pub struct Cell {
    pub(super) plan: Arc<CellPlan>,
    pub(super) state: State,
    pub(super) cycle: u32,
    /// Passes of the grinder begun.
    pub(super) passes: u32,
    /// What the grinder said of the pass of this cycle cannot be.
    pub(super) doubted: bool,
    /// Whether each machine was seen at the job for which it was asked last: no answer of the machine undoes that.
    pub(super) begun: [bool; 2],
    pub(super) known: [Known; 2],
    pub(super) causes: BTreeSet<Cause>,
    pub(super) raised: BTreeMap<AlarmId, Arc<Alarm>>,
    /// The figures of this cycle, and of the last one that was judged.
    pub(super) figures: Option<Arc<Figures>>,
    pub(super) previous: Option<Arc<Figures>>,
    /// The cycle that came nearest to what is accepted, and its figures.
    pub(super) best: Option<(u32, Arc<Figures>)>,
    /// Cycles in a row that were worse than the one before.
    pub(super) worse: u32,
    /// How the run ends when the state that leads to the end is over.
    pub(super) reason: String,
    pub(super) judged_out: bool,
    /// Whether a person ordered it.
    pub(super) ordered: bool,
    pub(super) repeated: bool,
    /// The machine that is being stopped, while the cell is.
    pub(super) stopping: Option<Device>,
    /// Whether each machine was asked to give its result back, and would not.
    pub(super) keeps: [bool; 2],
    /// The time of the event that is being handled, and when the next deadline is due.
    pub(super) now: Duration,
    pub(super) deadline: Option<Duration>,
    /// When a machine that was told to hold has to stand.
    pub(super) hold_due: Option<Duration>,
    /// When the running job gave its last sign of progress, the longest that it took for one, and whether a person was told that none comes.
    pub(super) progressed: Option<Duration>,
    pub(super) pace: Duration,
    pub(super) still: bool,
    /// How far the cell has come: the cycle, and the place in it.
    pub(super) furthest: (u32, u8),
    /// The failures of each machine.
    pub(super) vain: [Vain; 2],
    pub(super) commands: Vec<Command>,
}

impl Cell {
    /// Returns a cell that waits for `Event::Start`.
    pub fn new(plan: CellPlan) -> Self {
        Self {
            plan: Arc::new(plan),
            state: State::Idle,
            cycle: 0,
            passes: 0,
            doubted: false,
            begun: [false; 2],
            known: [Known::default(); 2],
            causes: BTreeSet::new(),
            raised: BTreeMap::new(),
            figures: None,
            previous: None,
            best: None,
            worse: 0,
            reason: String::new(),
            judged_out: false,
            ordered: false,
            repeated: false,
            stopping: None,
            keeps: [false; 2],
            now: Duration::ZERO,
            deadline: None,
            hold_due: None,
            progressed: None,
            pace: Duration::ZERO,
            still: false,
            furthest: (0, 0),
            vain: [Vain::default(); 2],
            commands: Vec::new(),
        }
    }

    /// Returns the state.
    pub fn state(&self) -> State {
        self.state
    }

    /// Returns the state in words for people. Whatever has not confirmed that it stands is named beside a state that says so.
    pub fn in_words(&self) -> String {
        match (self.state, &self.unconfirmed()[..]) {
            (State::Aborted, [device]) => format!("{}: the {device} has not confirmed that it stands", self.state),
            (State::Aborted, [_, _]) => format!("{}: neither machine has confirmed that it stands", self.state),
            (state, _) => state.to_string(),
        }
    }

    /// Returns the machines that have not confirmed that they stand, in a state that is taken for standing still.
    pub fn unconfirmed(&self) -> Vec<Device> {
        match self.state {
            State::Aborted => self.met_and_not_standing(),
            state => state.unconfirmed().into_iter().collect(),
        }
    }

    pub(super) fn met_and_not_standing(&self) -> Vec<Device> {
        let known = |device: Device| self.known[device as usize];
        Device::BOTH.into_iter().filter(|device| known(*device).met && !known(*device).stands).collect()
    }

    /// Returns the number of the cycle; 0 before the first.
    pub fn cycle(&self) -> u32 {
        self.cycle
    }

    /// Returns the plan.
    pub fn plan(&self) -> &CellPlan {
        &self.plan
    }

    /// Returns the figures of the last measurement that was registered.
    pub fn figures(&self) -> Option<&Figures> {
        self.figures.as_deref().or(self.previous.as_deref())
    }

    /// Returns whether a command that was given earlier, and has waited, is still to be carried out. What sets something in motion is
    /// wanted in the very state that asked for it only; on the way to an end nothing is that does not lead there.
    pub fn wants(&self, command: &Command) -> bool {
        let at = |device, step| self.state.phase() == Some(Phase::of(device, step));
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

    /// Returns the alarms that stand.
    pub fn alarms(&self) -> impl Iterator<Item = &Alarm> + '_ {
        self.raised.values().map(AsRef::as_ref)
    }

    /// Returns the machine of which a person is being asked whether it is clear of the part.
    pub fn asks_whether_clear_of(&self) -> Option<Device> {
        self.state.phase().filter(|phase| self.asks_whether_clear(*phase)).and_then(super::act::awaits_clear)
    }

    /// Returns when `Event::Deadline` is due, as time since the run began.
    pub fn next_deadline(&self) -> Option<Duration> {
        self.deadline
    }
}
