//! Commands of the cell. The drive records each in the journal before it executes it. Large data is not in a command:
//! the cycle number refers to it.

use serde::{Deserialize, Serialize};

use super::alarm::{Alarm, AlarmId};
use super::event::Event;
use super::state::{Device, State};

/// Command to a machine or about a cycle, and the event that answers it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the fields are named for what they are")]
#[serde(tag = "command", rename_all = "snake_case")]
pub enum Command {
    /// Open the link and verify the identity of the machine. Answer: `Connected` or `NotConnected`.
    Connect { device: Device },
    /// Ask a person, or the recipe, for the part. Answer: `LoadConfirmed`.
    AskToLoad,
    /// Send the pass and the map of this cycle to the grinder, read them back and compare. Answer: `PassLoaded` or
    /// `Refused`.
    LoadPass { cycle: u32 },
    /// Send the plan of this cycle to the CMM, read it back and compare. Answer: `PlanLoaded` or `Refused`.
    LoadPlan { cycle: u32 },
    /// Read a fresh status without moving anything. Answer: `Cleared`, `Obstructed` or `ClearUnknown`.
    VerifyClear { device: Device },
    /// Ask a person to check that a machine is clear of the part, if the machine cannot report it. Answer:
    /// `ClearConfirmed`.
    AskWhetherClear { device: Device },
    /// Prepare the job. An earlier preparation that is still active is withdrawn first. Answer: `Prepared` or
    /// `Refused`.
    Prepare { device: Device, cycle: u32 },
    /// Start the prepared job, at most once. Answer: `Started`, `StartUnknown` or, if the machine refused, `Refused`.
    StartMachine { device: Device, cycle: u32 },
    /// Bring the machine to its safe position. Answer: `MachineHeld`, or `Ended` if the job was over before.
    HoldMachine { device: Device },
    /// Resume the held machine. Answer: `MachineResumed` or `Refused`.
    ResumeMachine { device: Device },
    /// End the job in order, even if it is only prepared. Answer: `Ended`.
    StopMachine { device: Device },
    /// End at once, by the machine's own safe sequence. Answer: `AbortConfirmed`.
    AbortMachine { device: Device },
    /// Bring a machine that was aborted or faulted in an earlier run back to idle. Answer: `Connected` or `Refused`.
    ClearMachine { device: Device },
    /// Ask the machine for the state of the job. Answer: `Reconciled`.
    Reconcile { device: Device, cycle: u32 },
    /// Read, check and store the points of this cycle. Answer: `Collected`.
    Collect { cycle: u32 },
    /// Compare the probe with the reference sphere. Answer: `Qualified`.
    Qualify { cycle: u32 },
    /// Let the machine discard its result, even if it has none. Answer: `Acknowledged`.
    Acknowledge { device: Device },
    /// Register the measurement of this cycle. Answer: `Registered` or `RegistrationFailed`.
    Register { cycle: u32 },
    /// Compute the map of the next pass from the measurement of this cycle. Answer: `Compensated` or
    /// `CompensationRefused`.
    Compensate { cycle: u32 },
    /// Announce the judgement of the cycle. No answer.
    Announce(Judgement),
    /// Show an alarm. No answer.
    Raise(Alarm),
    /// Withdraw an alarm. No answer.
    Withdraw { alarm: AlarmId },
    /// Report that an event did not fit in this state, and why, to the person who sent it. No answer.
    Refuse {
        event: Box<Event>,
        state: State,
        #[serde(rename = "why")]
        reason: String,
    },
    /// End the run: the last command. No answer.
    Finish(Ending),
}

/// Judgement of a cycle.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Judgement {
    /// The cycle.
    pub cycle: u32,
    /// Verdict.
    pub verdict: Verdict,
    /// Reason, for the operator.
    pub reason: String,
}

/// Verdict on the figures of a cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Verdict {
    /// In tolerance: the part is done.
    Accept,
    /// Not in tolerance yet: another pass.
    Continue,
    /// Worse than before.
    Diverging,
    /// Wrong response of the part to the map.
    WrongResponse,
    /// No better than before, or no improvement expected.
    Stalled,
    /// A limit lies within the uncertainty of a figure, and another pass would not help.
    Undecided,
    /// In tolerance only without the outliers: touch those places again.
    LeftOut,
    /// The maximum number of passes is reached.
    MaxCycles,
    /// The removal budget is spent.
    BudgetSpent,
}

/// Ending of a run, with the last cycle (0 if none had begun) and the reason, for the operator.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the fields are told above")]
#[serde(tag = "ending", rename_all = "snake_case")]
pub enum Ending {
    /// The part is accepted.
    Accepted { cycle: u32, reason: String },
    /// The run ended in order, but the part is not in tolerance or was never judged.
    NotAccepted { cycle: u32, reason: String },
    /// The run could not begin, or was stopped. `ordered` is true if a person ordered the stop.
    Stopped {
        cycle: u32,
        reason: String,
        #[serde(default)]
        ordered: bool,
    },
    /// The run was aborted. `confirmed` is true if both machines confirmed that they stand still.
    Aborted { cycle: u32, confirmed: bool, reason: String },
}

/// Formats the label of a command for the record: its name, followed by its machine if it has one.
pub(super) fn format_label((name, device): (&'static str, Option<Device>)) -> String {
    device.map_or(name.to_owned(), |device| format!("{name} {device}"))
}

impl Command {
    /// Returns the name of the command as it is recorded. The machine follows the name if the command has one, for
    /// example "prepare grinder".
    pub fn name(&self) -> String {
        format_label(self.label())
    }

    /// Returns true if an event is expected as the answer to the command. A command without an answer (such as an alarm)
    /// is complete when it is issued.
    pub fn expects_answer(&self) -> bool {
        !matches!(
            self,
            Self::Announce(_) | Self::Raise(_) | Self::Withdraw { .. } | Self::Refuse { .. } | Self::Finish(_)
        )
    }

    /// Returns the name of the kind of command, such as "prepare", and the machine that the command contains. The
    /// machine is `None` if the command contains none. [`Self::name`] joins name and machine into one text.
    pub fn label(&self) -> (&'static str, Option<Device>) {
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
