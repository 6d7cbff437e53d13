//! State of the cell: the states of PackML, and inside them the phases of a cycle and the steps of a machine's job.

use std::fmt;

use serde::{Deserialize, Serialize};

/// One of the two machines of a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Device {
    /// The coordinate measuring machine.
    Cmm,
    /// The grinder.
    Grinder,
}

impl Device {
    /// Both machines, in the order in which they get commands.
    pub const BOTH: [Self; 2] = [Self::Cmm, Self::Grinder];

    /// Returns the name of the machine as it is recorded: "cmm" or "grinder".
    pub fn name(self) -> &'static str {
        match self {
            Self::Cmm => "cmm",
            Self::Grinder => "grinder",
        }
    }

    /// Returns the other one of the two machines.
    pub fn other(self) -> Self {
        match self {
            Self::Cmm => Self::Grinder,
            Self::Grinder => Self::Cmm,
        }
    }
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Cmm => "CMM",
            Self::Grinder => "grinder",
        })
    }
}

/// Step of a job of a machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobStep {
    /// The payload is being sent: the pass and its map to the grinder, the plan to the CMM.
    Send,
    /// A fresh status must show that the other machine is clear of the part.
    Clear,
    /// The machine checks its payload and interlocks.
    Prepare,
    /// START is on its way. From now on the machine may move.
    Start,
    /// The machine moves.
    Run,
    /// The state of the job is unknown; the cell asks the machine for it.
    Reconcile,
    /// The result is being read and gated (CMM only).
    Collect,
    /// The radius of the probe is being compared with the reference sphere (CMM only).
    Qualify,
    /// The machine gets the order to discard its result. The cell uses the result.
    Acknowledge,
    /// The machine gets the order to discard its result. The cell does not use the result.
    Discard,
}

impl fmt::Display for JobStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Send => "Send",
            Self::Clear => "Clear",
            Self::Prepare => "Prepare",
            Self::Start => "Start",
            Self::Run => "Run",
            Self::Reconcile => "Reconcile",
            Self::Collect => "Collect",
            Self::Qualify => "Qualify",
            Self::Acknowledge => "Acknowledge",
            Self::Discard => "Discard",
        })
    }
}

/// Phase of a cycle. [`super::Cell::cycle`] has the number of the cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// A person, or the recipe, confirms that the right part is loaded.
    Load,
    /// A pass of the grinder.
    Grind(JobStep),
    /// The grinder leaves the part free for the CMM.
    Transfer,
    /// A measurement.
    Measure(JobStep),
    /// The measurement is registered to the nominal surface.
    Register,
    /// The figures are judged. The cell leaves this phase at once, unless it is held before the judgement.
    Judge,
    /// The next map is computed.
    Compensate,
}

impl Phase {
    /// Returns the phase in which the machine `device` is at the step `step` of its job. This is `Measure(step)` for
    /// the CMM and `Grind(step)` for the grinder.
    pub(super) fn from_job(device: Device, step: JobStep) -> Self {
        match device {
            Device::Cmm => Self::Measure(step),
            Device::Grinder => Self::Grind(step),
        }
    }

    /// Returns the machine and the step of its job; `None` if this phase is not the job of a machine.
    pub fn job(self) -> Option<(Device, JobStep)> {
        match self {
            Self::Grind(step) => Some((Device::Grinder, step)),
            Self::Measure(step) => Some((Device::Cmm, step)),
            _ => None,
        }
    }

    /// Returns the machine that may be moving in this phase. This is the machine of the job at the steps Start, Run and
    /// Reconcile. Returns `None` in any other phase.
    pub fn moving_device(self) -> Option<Device> {
        self.job()
            .filter(|(_, step)| matches!(step, JobStep::Start | JobStep::Run | JobStep::Reconcile))
            .map(|(device, _)| device)
    }

    /// Returns a number for the position of the phase in a cycle. A later phase has a higher number. The step Reconcile
    /// has a lower number than Run, because it is not known whether the job runs.
    pub(super) fn position(self) -> u8 {
        let step = |step: JobStep| match step {
            JobStep::Send => 0,
            JobStep::Clear => 1,
            JobStep::Prepare => 2,
            JobStep::Start => 3,
            JobStep::Reconcile => 4,
            JobStep::Run => 5,
            JobStep::Collect => 6,
            JobStep::Qualify => 7,
            JobStep::Acknowledge => 8,
            JobStep::Discard => 9,
        };
        match self {
            Self::Load => 0,
            Self::Grind(of) => 10 + step(of),
            Self::Transfer => 20,
            Self::Measure(of) => 30 + step(of),
            Self::Register => 40,
            Self::Judge => 41,
            Self::Compensate => 42,
        }
    }

    /// Returns the name of the phase, without its step.
    pub fn name(self) -> &'static str {
        match self {
            Self::Load => "Load",
            Self::Grind(_) => "Grind",
            Self::Transfer => "Transfer",
            Self::Measure(_) => "Measure",
            Self::Register => "Register",
            Self::Judge => "Judge",
            Self::Compensate => "Compensate",
        }
    }

    /// Returns the machine that must be clear of the part before this phase can end. At the step Clear of a job, this
    /// is the machine without the job. In the phase Transfer, it is the grinder. Returns `None` for any other phase.
    pub(crate) fn device_awaited_clear(self) -> Option<Device> {
        match self.job() {
            Some((device, JobStep::Clear)) => Some(device.other()),
            None if self == Self::Transfer => Some(Device::Grinder),
            _ => None,
        }
    }
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.job() {
            Some((_, step)) => write!(f, "{}, {step}", self.name()),
            None => f.write_str(self.name()),
        }
    }
}

/// State of the cell, with the name of PackML. A phase in a state shows where the cycle continues.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// No command has been given yet.
    Idle,
    /// Both machines are being connected and checked.
    Starting,
    /// A cycle runs.
    Execute(Phase),
    /// Being held, by a person or by a cause inside the cell: a moving machine first moves to its safe position.
    Holding(Phase),
    /// Held. A person must resume.
    Held(Phase),
    /// The held machine is being resumed.
    Unholding(Phase),
    /// Being suspended by a cause outside the cell (a link, supplies, a signal): a moving machine first moves to its
    /// safe position.
    Suspending(Phase),
    /// Suspended; resumes by itself when the cause is gone.
    Suspended(Phase),
    /// The cause is gone: the machine is asked about its state, or resumed.
    Unsuspending(Phase),
    /// An orderly end is in progress.
    Stopping,
    /// Ended in order, without an accepted part. An end state.
    Stopped,
    /// The safe sequence runs.
    Aborting,
    /// The safe sequence is over. An end state.
    Aborted,
    /// Accepted; the cell checks that both machines are clear of the part.
    Completing,
    /// Ended with an accepted part. An end state.
    Complete,
}

impl State {
    /// Returns true if the run is over. No command follows after that.
    pub fn is_end(self) -> bool {
        matches!(self, Self::Stopped | Self::Aborted | Self::Complete)
    }

    /// Returns the phase of the cycle that the cell executes. If the cell is held or suspended, this is the phase in
    /// which it will continue. Returns `None` in a state without a phase.
    pub fn phase(self) -> Option<Phase> {
        match self {
            Self::Execute(phase)
            | Self::Holding(phase)
            | Self::Held(phase)
            | Self::Unholding(phase)
            | Self::Suspending(phase)
            | Self::Suspended(phase)
            | Self::Unsuspending(phase) => Some(phase),
            _ => None,
        }
    }

    /// Returns the machine that has not confirmed that it is at rest, while the cell is held or suspended. This is the
    /// machine whose job has an unknown state (step Reconcile). Returns `None` in all other cases.
    pub fn unconfirmed(self) -> Option<Device> {
        match self {
            Self::Held(phase) | Self::Suspended(phase) => {
                phase.job().filter(|(_, step)| *step == JobStep::Reconcile).map(|(device, _)| device)
            }
            _ => None,
        }
    }

    /// Returns the name of the state in PackML.
    pub fn name(self) -> StateName {
        match self {
            Self::Idle => StateName::Idle,
            Self::Starting => StateName::Starting,
            Self::Execute(_) => StateName::Execute,
            Self::Holding(_) => StateName::Holding,
            Self::Held(_) => StateName::Held,
            Self::Unholding(_) => StateName::Unholding,
            Self::Suspending(_) => StateName::Suspending,
            Self::Suspended(_) => StateName::Suspended,
            Self::Unsuspending(_) => StateName::Unsuspending,
            Self::Stopping => StateName::Stopping,
            Self::Stopped => StateName::Stopped,
            Self::Aborting => StateName::Aborting,
            Self::Aborted => StateName::Aborted,
            Self::Completing => StateName::Completing,
            Self::Complete => StateName::Complete,
        }
    }
}

/// Names of the states in PackML, without their phases.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[allow(missing_docs)]
pub enum StateName {
    #[default]
    Idle,
    Starting,
    Execute,
    Holding,
    Held,
    Unholding,
    Suspending,
    Suspended,
    Unsuspending,
    Stopping,
    Stopped,
    Aborting,
    Aborted,
    Completing,
    Complete,
}

impl StateName {
    /// All states.
    pub const ALL: [Self; 15] = [
        Self::Idle,
        Self::Starting,
        Self::Execute,
        Self::Holding,
        Self::Held,
        Self::Unholding,
        Self::Suspending,
        Self::Suspended,
        Self::Unsuspending,
        Self::Stopping,
        Self::Stopped,
        Self::Aborting,
        Self::Aborted,
        Self::Completing,
        Self::Complete,
    ];
}

impl fmt::Display for StateName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self, f)
    }
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.phase(), self.unconfirmed()) {
            (Some(phase), Some(device)) => {
                write!(f, "{} ({phase}): the {device} has not confirmed that it is at rest", self.name())
            }
            (Some(phase), None) => write!(f, "{} ({phase})", self.name()),
            (None, _) => self.name().fmt(f),
        }
    }
}
