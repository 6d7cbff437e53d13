//! Types of the handshake with a machine: its identity, its status and its answers.

use std::fmt;
use std::path::PathBuf;

/// Kind of a machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum MachineKind {
    /// Coordinate measuring machine.
    Cmm,
    /// Grinder.
    Grinder,
}

impl MachineKind {
    /// Returns `cmm` or `grinder`: the name of the machine's table in a cell file, and of the machine in commands.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Cmm => "cmm",
            Self::Grinder => "grinder",
        }
    }
}

impl fmt::Display for MachineKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Cmm => "measuring machine",
            Self::Grinder => "grinder",
        })
    }
}

/// Identity of the machine at the far end of the wire.
#[derive(Debug, Clone, PartialEq)]
pub struct Identity {
    /// Kind of the machine.
    pub kind: MachineKind,
    /// Name and serial number, as the machine reports them.
    pub name: String,
    /// Number that changes each time the application of the machine starts; 0 if the wire has no boot id.
    pub boot_id: u32,
    /// True if it is a simulation. This must be shown wherever its results are shown or stored.
    pub simulation: bool,
    /// Silence in s after which the machine regards its client as lost and holds.
    pub silence_limit_s: Option<f64>,
}

impl Identity {
    /// Returns the identity of a machine that a person operates. `name` is the name of the machine. The identity has no
    /// boot id and no silence limit: such a machine does not stop when this program is silent.
    pub(super) fn for_manual_machine(kind: MachineKind, name: &str) -> Self {
        Self { kind, name: name.to_owned(), boot_id: 0, simulation: false, silence_limit_s: None }
    }
}

/// Job of one machine: the run of the part, the cycle in it, and a checksum of its payloads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Job {
    /// Number of the run of the part; not 0.
    pub job: u32,
    /// Cycle with its batch, in the encoding of [`BatchId::encode`].
    pub cycle: u16,
    /// [`digest`] of the identities of the payloads, in the order plan, or map and pass.
    pub digest: u32,
}

impl Job {
    /// Returns the cycle of this job and the number of its batch. A measurement may be divided into several batches of
    /// touches; the first batch has the number 0.
    pub fn batch_id(&self) -> BatchId {
        BatchId::decode(self.cycle)
    }
}

impl fmt::Display for Job {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "job {} cycle {} (digest {:08x})", self.job, self.batch_id(), self.digest)
    }
}

/// Cycle, and batch of touches in it if a measurement is taken batch by batch. The batch is the number of batches
/// before it. A machine sees one number of 16 bits: the cycle plus 1024 for each earlier batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct BatchId {
    /// Cycle.
    pub cycle: u32,
    /// Number of earlier batches.
    pub batch: u32,
}

impl BatchId {
    /// Number of cycles that the encoding can distinguish; a run has fewer.
    pub const MAX_CYCLES: u32 = 1024;
    /// Number of batches that the encoding can distinguish; a measurement has fewer.
    pub const MAX_BATCHES: u32 = 64;

    /// Decodes the cycle and the batch from `seen`, the single number of 16 bits that a machine receives as its cycle.
    /// This is the inverse of [`BatchId::encode`].
    pub fn decode(seen: u16) -> Self {
        let seen = u32::from(seen);
        Self { cycle: seen % Self::MAX_CYCLES, batch: seen / Self::MAX_CYCLES }
    }

    /// Encodes the cycle and the batch as the single number of 16 bits that a machine receives as its cycle: cycle +
    /// 1024 · batch. The number is unique within a run if the cycle is less than 1024 and the batch less than 64.
    /// Larger values wrap around.
    pub fn encode(self) -> u16 {
        (self.cycle % Self::MAX_CYCLES + Self::MAX_CYCLES * (self.batch % Self::MAX_BATCHES)) as u16
    }
}

impl fmt::Display for BatchId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.batch {
            0 => self.cycle.fmt(f),
            before => write!(f, "{}, batch {}", self.cycle, before + 1),
        }
    }
}

/// Returns the digest of a job: the CRC-32 of the identities (SHA-256) of its payloads, in the given order. The payload
/// of a CMM job is the plan. The payloads of a grinder job are the correction map and then the pass.
pub fn digest(identities: &[[u8; 32]]) -> u32 {
    let mut crc = crc32fast::Hasher::new();
    for identity in identities {
        crc.update(identity);
    }
    crc.finalize()
}

/// Job that the machine has checked, with the data of the START that would begin it. Write it to the journal before
/// [`start`](super::Machine::start).
///
/// After a restart it is rebuilt from the journal and passed to [`reconcile`](super::Machine::reconcile).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Armed {
    /// Prepared job.
    pub job: Job,
    /// Sequence number of the START; no other command carries it.
    pub start_sequence: u32,
    /// One-time token of the machine for this start; 0 if the wire has none.
    pub token: u32,
    /// Boot id of the machine when the job was prepared.
    pub boot_id: u32,
}

/// Job that the machine has begun.
#[derive(Debug, Clone, PartialEq)]
pub struct Started {
    /// Job that was begun.
    pub job: Job,
    /// Sequence number of the START that began it.
    pub start_sequence: u32,
    /// Status that confirms the start.
    pub status: Status,
}

/// Outcome of a start.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Reconciled {
    /// The start was accepted and the job has not ended. The state in the status shows if it runs, holds or is ending.
    Running(Status),
    /// The start was accepted and the job has ended; `done` and `outcome` in the status show how.
    Finished(Status),
    /// The start was not accepted: two statuses, at least a second apart, show this. Prepare again.
    NotStarted(Status),
    /// The outcome cannot be determined from here. A person must look at the machine; nothing may be repeated.
    Unknown {
        /// Reason why the outcome cannot be determined.
        reason: String,
    },
}

impl Reconciled {
    /// Returns an unknown outcome with its reason.
    pub(crate) fn unknown(reason: &str) -> Self {
        Self::Unknown { reason: reason.to_owned() }
    }
}

/// Command of the handshake between a driver and its machine, with its number on the Modbus wire. It has no transfer of
/// a payload or a result: these are no commands of the machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u16)]
#[expect(missing_docs, reason = "the same words as the methods of `Machine`")]
pub enum MachineCommand {
    Claim = 1,
    Prepare = 2,
    Start = 3,
    Hold = 4,
    Resume = 5,
    Stop = 6,
    Abort = 7,
    Clear = 8,
    Acknowledge = 9,
    Release = 10,
}

impl fmt::Display for MachineCommand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Claim => "CLAIM",
            Self::Prepare => "PREPARE",
            Self::Start => "START",
            Self::Hold => "HOLD",
            Self::Resume => "RESUME",
            Self::Stop => "STOP",
            Self::Abort => "ABORT",
            Self::Clear => "CLEAR",
            Self::Acknowledge => "ACKNOWLEDGE",
            Self::Release => "RELEASE",
        })
    }
}

/// State of a machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum MachineState {
    /// Nothing is prepared and nothing runs.
    Idle,
    /// A job is checked; START would begin it.
    Prepared,
    /// A job runs.
    Execute,
    /// The machine moves to a safe position.
    Holding,
    /// The machine is at a safe position, and its job has not ended.
    Held,
    /// The machine ends the job in order.
    Stopping,
    /// A job has ended; its result waits for the acknowledgement.
    Complete,
    /// The machine runs the safe sequence.
    Aborting,
    /// The job was ended at once; the machine needs CLEAR.
    Aborted,
    /// The machine stopped because of a fault; it needs CLEAR.
    Faulted,
}

impl MachineState {
    /// Returns true if the machine may be moving in this state.
    pub fn is_moving(self) -> bool {
        matches!(self, Self::Execute | Self::Holding | Self::Stopping | Self::Aborting)
    }
}

impl fmt::Display for MachineState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Idle => "IDLE",
            Self::Prepared => "PREPARED",
            Self::Execute => "EXECUTE",
            Self::Holding => "HOLDING",
            Self::Held => "HELD",
            Self::Stopping => "STOPPING",
            Self::Complete => "COMPLETE",
            Self::Aborting => "ABORTING",
            Self::Aborted => "ABORTED",
            Self::Faulted => "FAULTED",
        })
    }
}

/// Answer of a machine to a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Answer {
    /// No answer yet.
    None,
    /// Accepted.
    Accepted,
    /// The client is not the owner, or has an old epoch.
    NotOwner,
    /// The present state does not allow the command.
    WrongState,
    /// The machine does not know the command.
    UnknownCommand,
    /// The token is wrong or has expired.
    DeadToken,
    /// Job, cycle or digest differ from those that are prepared or in force.
    OtherJob,
    /// This job and cycle were already begun.
    AlreadyBegun,
    /// A payload is missing, corrupt or made for another part.
    PayloadMissing,
    /// An interlock is open or the machine is not in automatic mode.
    InterlockOpen,
    /// A value of a payload is outside the limits of the machine.
    OutsideLimits,
    /// The acknowledged number is not the number of the finished job.
    OtherResult,
    /// The answer number is not in the contract.
    Unlisted(u16),
}

impl fmt::Display for Answer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::None => "no answer yet",
            Self::Accepted => "accepted",
            Self::NotOwner => {
                "another client owns the machine, or owned the machine after Regrind had connected: end that client, \
                 then let Regrind connect to the machine again"
            }
            Self::WrongState => "the machine does not allow this command in its present state",
            Self::UnknownCommand => {
                "the machine does not know the command: compare the machine's program with docs/modbus.md"
            }
            Self::DeadToken => {
                "the token of the prepared job has expired (30 s passed, or an interlock opened): resume, and Regrind \
                 prepares the job again"
            }
            Self::OtherJob => {
                "job, cycle or payloads differ from the prepared ones: resume, and Regrind sends the payloads and \
                 prepares the job again"
            }
            Self::AlreadyBegun => {
                "this cycle of the job has already begun; the machine does not begin the same cycle twice"
            }
            Self::PayloadMissing => {
                "a payload is missing, damaged, or for another part: check the part; then resume, and Regrind sends \
                 the payload again"
            }
            Self::InterlockOpen => {
                "an interlock is open or the machine is not in automatic mode: close the guards, select \
                 automatic mode, check the clamping and the supplies"
            }
            Self::OutsideLimits => {
                "a value of the payload is outside the machine's limits: compare the recipe with these limits"
            }
            Self::OtherResult => {
                "Regrind acknowledged another result than the present result of the machine: check which job the \
                 machine ran"
            }
            Self::Unlisted(number) => {
                return write!(f, "answer {number}, which docs/modbus.md does not list: correct the machine's program");
            }
        })
    }
}

/// Fault of a machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Fault {
    /// No fault.
    None,
    /// The stop circuit is open.
    StopCircuit,
    /// A collision or an unexpected touch occurred.
    Collision,
    /// Air, coolant or power is missing.
    Supplies,
    /// An axis reached a limit of travel.
    TravelLimit,
    /// A drive has failed.
    Drive,
    /// The probe or the spindle has failed.
    Tool,
    /// The client was silent for too long.
    ClientSilent,
    /// Another fault, with its number.
    Other(u16),
}

impl Fault {
    /// Faults with their numbers in docs/modbus.md.
    const NUMBERS: [(Self, u16); 8] = [
        (Self::None, 0),
        (Self::StopCircuit, 1),
        (Self::Collision, 2),
        (Self::Supplies, 3),
        (Self::TravelLimit, 4),
        (Self::Drive, 5),
        (Self::Tool, 6),
        (Self::ClientSilent, 20),
    ];

    /// Returns the fault with this number in docs/modbus.md, or [`Fault::Other`] for a number that is not listed there.
    pub fn from_number(number: u16) -> Self {
        Self::NUMBERS.iter().find(|(_, known)| *known == number).map_or(Self::Other(number), |(fault, _)| *fault)
    }

    /// Returns the number of the fault in docs/modbus.md.
    pub fn number(self) -> u16 {
        match self {
            Self::Other(number) => number,
            listed => Self::NUMBERS.iter().find(|(fault, _)| *fault == listed).map_or(0, |(_, number)| *number),
        }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::None => "no fault",
            Self::StopCircuit => "the stop circuit is open: close the circuit at the machine, then clear the fault",
            Self::Collision => "collision or unexpected touch: check part and probe or wheel, then clear the fault",
            Self::Supplies => "air, coolant or power is missing",
            Self::TravelLimit => "an axis reached its limit of travel: check the position of the part",
            Self::Drive => "a drive has failed: see the machine's own panel",
            Self::Tool => "the probe or the spindle has failed: see the machine's own panel",
            Self::ClientSilent => {
                "the machine received nothing from Regrind for too long, so the machine holds: check the cable"
            }
            Self::Other(number) => return write!(f, "fault {number}: see the machine's own panel"),
        })
    }
}

/// Outcome of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Outcome {
    /// The job has not ended.
    None,
    /// The job was completed.
    Complete,
    /// STOP ended the job.
    Stopped,
    /// ABORT ended the job.
    Aborted,
    /// A fault ended the job.
    Failed,
}

/// Additional signal that a cell file requests. The value is given even if it is not good; [`Self::problem`] judges it.
#[derive(Debug, Clone, PartialEq)]
pub struct SignalValue {
    /// Name in the cell file.
    pub name: String,
    /// Value in its unit; `None` if the machine gives no number.
    pub value: Option<f64>,
    /// Unit, as written in the cell file.
    pub unit: String,
    /// Minimum and maximum allowed value.
    pub range: [f64; 2],
    /// Cause of a missing or impossible value, in words.
    pub cause: Option<String>,
}

impl SignalValue {
    /// Returns a text for a person that states why the value of this signal is missing or outside of its range. Returns
    /// `None` if the value is within the range; the limits themselves are allowed.
    pub fn problem(&self) -> Option<String> {
        let Self { name, value, unit, range: [least, most], cause } = self;
        let flaw = match value {
            None => format!("{name}: the machine gives no value"),
            Some(value) if (least..=most).contains(&value) => return None,
            Some(value) => format!("{name} is {value} {unit}, limits {least} to {most} {unit}"),
        };
        Some(cause.iter().fold(flaw, |flaw, cause| format!("{flaw}: {cause}")))
    }
}

/// Status of a machine, all of one moment. `None` marks a value that the machine cannot report; no other value is put
/// in its place. If the value is required, a person is asked.
#[derive(Debug, Clone, PartialEq)]
pub struct Status {
    /// State of the machine.
    pub state: MachineState,
    /// Job that is prepared, running or finished.
    pub job: Option<Job>,
    /// Sequence number of the START whose job ended last; 0 if there is none.
    pub done: u32,
    /// Outcome of that job.
    pub outcome: Outcome,
    /// True if the wheel or probe is clear of the part.
    pub clear_of_part: Option<bool>,
    /// True if air, coolant and other supplies are present.
    pub supplies: Option<bool>,
    /// True if it is in automatic mode; in manual mode a person may move it at its panel.
    pub automatic: Option<bool>,
    /// Fault of the machine.
    pub fault: Option<Fault>,
    /// Progress `(done, total)`: points measured, or thousandths of the path.
    pub progress: Option<(u32, u32)>,
    /// Temperature of the part or the machine, in °C.
    pub temperature_c: Option<f64>,
    /// Number that changes each time the application of the machine starts.
    pub boot_id: Option<u32>,
    /// Values of the additional signals that the cell file requests.
    pub signals: Vec<SignalValue>,
}

impl Status {
    /// Returns a status that contains only the state of the machine; all other values are unknown.
    pub fn from_state(state: MachineState) -> Self {
        Self {
            state,
            job: None,
            done: 0,
            outcome: Outcome::None,
            clear_of_part: None,
            supplies: None,
            automatic: None,
            fault: None,
            progress: None,
            temperature_c: None,
            boot_id: None,
            signals: Vec::new(),
        }
    }
}

/// Operator confirmation of a fact that a machine cannot report itself.
#[derive(Debug, Clone, PartialEq, Eq)]
#[expect(missing_docs, reason = "the fields are told above them")]
pub enum OperatorConfirmation {
    /// The machine has begun its job, with this map if one was named.
    Started { map_identity: Option<[u8; 32]> },
    /// The machine has ended its job, with this map if one was named, and is clear of the part. A measurement came as a
    /// file.
    Done { map_identity: Option<[u8; 32]>, file: Option<PathBuf> },
    /// The machine does not move.
    Still,
}
