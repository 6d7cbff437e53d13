//! What is to be done: imperatives. The drive journals each before it carries it out. Big data travels by the number of its
//! cycle only.

use serde::{Deserialize, Serialize};

use super::alarm::{Alarm, AlarmId};
use super::event::Event;
use super::state::{Device, State};

/// An imperative to a machine or about a cycle, and the event that answers it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the fields are named for what they are")]
#[serde(tag = "command", rename_all = "snake_case")]
pub enum Command {
    /// Open the link and prove which machine is there: `Connected` or `NotConnected`.
    Connect { device: Device },
    /// Ask a person, or the recipe, for the part: `LoadConfirmed`.
    AskToLoad,
    /// Send the pass and the map of this cycle to the grinder, read them back and compare: `PassLoaded` or `Refused`.
    LoadPass { cycle: u32 },
    /// Send the plan of this cycle to the CMM, read it back and compare: `PlanLoaded` or `Refused`.
    LoadPlan { cycle: u32 },
    /// Read a fresh status, moving nothing: `Cleared`, `Obstructed` or `ClearUnknown`.
    VerifyClear { device: Device },
    /// Ask a person to see whether a machine that cannot tell it is clear of the part: `ClearConfirmed`.
    AskWhetherClear { device: Device },
    /// Prepare the job; a preparation that still stands is taken back first: `Prepared` or `Refused`.
    Prepare { device: Device, cycle: u32 },
    /// Start the prepared job, at most once: `Started`, `StartUnknown` or, if the machine said no, `Refused`.
    StartMachine { device: Device, cycle: u32 },
    /// Bring the machine to its safe place: `MachineHeld`, or `Ended` if the job was over before.
    HoldMachine { device: Device },
    /// Let the held machine go on: `MachineResumed` or `Refused`.
    ResumeMachine { device: Device },
    /// End the job in order, also one that is only prepared: `Ended`.
    StopMachine { device: Device },
    /// End at once, by the machine's own safe sequence: `AbortConfirmed`.
    AbortMachine { device: Device },
    /// Bring a machine that was aborted or faulted in an earlier run back to idle: `Connected` or `Refused`.
    ClearMachine { device: Device },
    /// Find out what became of the job: `Reconciled`.
    Reconcile { device: Device, cycle: u32 },
    /// Read, check and store the points of this cycle: `Collected`.
    Collect { cycle: u32 },
    /// Compare the probe with the reference sphere: `Qualified`.
    Qualify { cycle: u32 },
    /// Let the machine forget its result, also where it has none: `Acknowledged`.
    Acknowledge { device: Device },
    /// Register the measurement of this cycle: `Registered` or `RegistrationFailed`.
    Register { cycle: u32 },
    /// Compute the map of the next pass from this cycle: `Compensated` or `CompensationRefused`.
    Compensate { cycle: u32 },
    /// Tell how the cycle was judged. No answer.
    Announce(Judgement),
    /// Show an alarm. No answer.
    Raise(Alarm),
    /// Take an alarm back. No answer.
    Withdraw { alarm: AlarmId },
    /// Tell that an event did not fit in this state, and why, for the person who sent it. No answer.
    Refuse { event: Box<Event>, state: State, why: String },
    /// The run is over: the last command. No answer.
    Finish(Ending),
}

/// How a cycle was judged.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Judgement {
    /// The cycle.
    pub cycle: u32,
    /// What follows.
    pub verdict: Verdict,
    /// Why, for the operator.
    pub reason: String,
}

/// What follows from the figures of a cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Verdict {
    /// In tolerance: the part is done.
    Accept,
    /// Another pass.
    Continue,
    /// Worse than before.
    Diverging,
    /// The part does not answer to the map as it should.
    WrongResponse,
    /// No better than before, or not going to be.
    Stalled,
    /// The uncertainty reaches over a limit, and another pass would not help.
    Undecided,
    /// In tolerance but for points that were left out: those places are to be touched again.
    LeftOut,
    /// No pass is left.
    MaxCycles,
    /// No material is left to take off.
    BudgetSpent,
}

/// How a run ended: the last cycle, 0 if none had begun, and why, for the operator.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the fields are told above")]
#[serde(tag = "ending", rename_all = "snake_case")]
pub enum Ending {
    /// The part is accepted.
    Accepted { cycle: u32, reason: String },
    /// The run came to its end in order and the part is not in tolerance, or was never judged to be.
    NotAccepted { cycle: u32, reason: String },
    /// The run could not begin, or was stopped; `ordered` where a person did.
    Stopped {
        cycle: u32,
        reason: String,
        #[serde(default)]
        ordered: bool,
    },
    /// The run was aborted; `confirmed` where both machines said that they stand.
    Aborted { cycle: u32, confirmed: bool, reason: String },
}

/// Spells a label as it is recorded.
pub(super) fn spelled((name, device): (&'static str, Option<Device>)) -> String {
    device.map_or(name.to_owned(), |device| format!("{name} {device}"))
}

impl Command {
    /// Returns the name of the command, as it is recorded, with the machine that it is for.
    pub fn name(&self) -> String {
        spelled(self.label())
    }

    /// Returns what [`Self::name`] is made of.
    pub(super) fn label(&self) -> (&'static str, Option<Device>) {
        let (name, device) = match self {
            Self::Connect { device } => ("connect", Some(device)),
            Self::AskToLoad => ("ask_to_load", None),
            Self::LoadPass { .. } => ("load_pass", None),
            Self::LoadPlan { .. } => ("load_plan", None),
            Self::VerifyClear { device } => ("verify_clear", Some(device)),
            Self::AskWhetherClear { device } => ("ask_whether_clear", Some(device)),
            Self::Prepare { device, .. } => ("prepare", Some(device)),
            Self::StartMachine { device, .. } => ("start_machine", Some(device)),
            Self::HoldMachine { device } => ("hold_machine", Some(device)),
            Self::ResumeMachine { device } => ("resume_machine", Some(device)),
            Self::StopMachine { device } => ("stop_machine", Some(device)),
            Self::AbortMachine { device } => ("abort_machine", Some(device)),
            Self::ClearMachine { device } => ("clear_machine", Some(device)),
            Self::Reconcile { device, .. } => ("reconcile", Some(device)),
            Self::Collect { .. } => ("collect", None),
            Self::Qualify { .. } => ("qualify", None),
            Self::Acknowledge { device } => ("acknowledge", Some(device)),
            Self::Register { .. } => ("register", None),
            Self::Compensate { .. } => ("compensate", None),
            Self::Announce(_) => ("announce", None),
            Self::Raise(_) => ("raise", None),
            Self::Withdraw { .. } => ("withdraw", None),
            Self::Refuse { .. } => ("refuse", None),
            Self::Finish(_) => ("finish", None),
        };
        (name, device.copied())
    }
}
