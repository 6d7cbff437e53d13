//! The words of a machine's handshake: who it is, what it is doing, what it answers.

use std::fmt;
use std::path::PathBuf;

/// What a machine is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum MachineKind {
    /// A coordinate measuring machine.
    Cmm,
    /// A grinder.
    Grinder,
}

impl MachineKind {
    /// Returns its table in a cell file, and its name in commands.
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

/// Who answers at the far end of the wire.
#[derive(Debug, Clone, PartialEq)]
pub struct Identity {
    /// What it is for.
    pub kind: MachineKind,
    /// Its name and serial number, as it gives them.
    pub name: String,
    /// A number that changes whenever the machine's application starts; 0 where the wire has no such number.
    pub boot_id: u32,
    /// Whether it is a simulation. Has to be said wherever its results are shown or stored.
    pub simulation: bool,
    /// After how many seconds of silence the machine takes its client for lost and holds.
    pub silence_limit_s: Option<f64>,
}

impl Identity {
    /// A machine whose wire is a person, who is never lost by silence.
    pub(super) fn by_person(kind: MachineKind, name: &str) -> Self {
        Self { kind, name: name.to_owned(), boot_id: 0, simulation: false, silence_limit_s: None }
    }
}

/// One run of one machine: the part's run, the cycle in it, and a check number of the payloads it is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Job {
    /// The number of the part's run; not 0.
    pub job: u32,
    /// The cycle.
    pub cycle: u16,
    /// [`digest`] of the identities of the payloads, in the order plan, or map and pass.
    pub digest: u32,
}

impl Job {
    /// Returns which batch of touches of which cycle it is.
    pub fn number(&self) -> Number {
        Number::of(self.cycle)
    }
}

impl fmt::Display for Job {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "job {} cycle {} (digest {:08x})", self.job, self.number(), self.digest)
    }
}

/// A cycle, and which batch of touches of it where a measurement is taken batch by batch: the batches before it. A machine sees one number of
/// 16 bits: the cycle, and 1024 for each batch before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Number {
    /// The cycle.
    pub cycle: u32,
    /// The batches before.
    pub batch: u32,
}

impl Number {
    /// The cycles of a run, and the batches of a measurement, are fewer.
    pub const CYCLES: u32 = 1024;
    /// The batches of a measurement.
    pub const BATCHES: u32 = 64;

    /// Takes apart what a machine sees.
    pub fn of(seen: u16) -> Self {
        let seen = u32::from(seen);
        Self { cycle: seen % Self::CYCLES, batch: seen / Self::CYCLES }
    }

    /// Returns what a machine sees, which is another for every batch as long as the limits are kept.
    pub fn seen(self) -> u16 {
        (self.cycle % Self::CYCLES + Self::CYCLES * (self.batch % Self::BATCHES)) as u16
    }
}

impl fmt::Display for Number {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.batch {
            0 => self.cycle.fmt(f),
            before => write!(f, "{}, batch {}", self.cycle, before + 1),
        }
    }
}

/// The check number of payloads: the CRC-32 over their identities, in rising order of their kinds (plan; or map, pass).
pub fn digest(identities: &[[u8; 32]]) -> u32 {
    let mut crc = crc32fast::Hasher::new();
    for identity in identities {
        crc.update(identity);
    }
    crc.finalize()
}

/// Returns bytes as hexadecimal digits.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

/// A job that the machine has checked and would begin: the intent, to be journaled before [`start`](super::Machine::start).
///
/// After a restart it is put together again from the journal and given to [`reconcile`](super::Machine::reconcile).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Armed {
    /// What was prepared.
    pub job: Job,
    /// The number that the START will carry, and no other command.
    pub start_sequence: u32,
    /// The machine's one-time word for this start; 0 where the wire has none.
    pub token: u32,
    /// The machine's boot id when it was prepared.
    pub boot_id: u32,
}

/// A job that the machine has begun.
#[derive(Debug, Clone, PartialEq)]
pub struct Started {
    /// What was begun.
    pub job: Job,
    /// The START that began it.
    pub start_sequence: u32,
    /// The status that said so.
    pub status: Status,
}

/// What became of a start.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Reconciled {
    /// It was taken and the job is not at its end; the state in the status says whether it runs, holds or is ending.
    Running(Status),
    /// It was taken and has ended; `done` and `outcome` in the status say how.
    Finished(Status),
    /// It provably was not taken, seen twice with a second between: prepare anew.
    NotStarted(Status),
    /// It cannot be told from here. A person has to look at the machine; nothing may be repeated.
    Unknown {
        /// What does not fit, in words.
        why: String,
    },
}

/// A command of the handshake.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u16)]
#[expect(missing_docs, reason = "the same words as the methods of `Machine`")]
pub enum Command {
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

impl fmt::Display for Command {
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

/// Where a machine stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum State {
    /// Nothing prepared, nothing running.
    Idle,
    /// A job is checked; START would begin it.
    Prepared,
    /// A job runs.
    Execute,
    /// On the way to a safe place.
    Holding,
    /// At a safe place in the middle of a job.
    Held,
    /// Ending the job in order.
    Stopping,
    /// A job has ended; its result waits to be acknowledged.
    Complete,
    /// Running the safe sequence.
    Aborting,
    /// Ended at once; needs CLEAR.
    Aborted,
    /// Stands because of a fault; needs CLEAR.
    Faulted,
}

impl State {
    /// Whether something may be moving.
    pub fn moves(self) -> bool {
        matches!(self, Self::Execute | Self::Holding | Self::Stopping | Self::Aborting)
    }
}

impl fmt::Display for State {
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

/// What a machine answers to a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Answer {
    /// None yet.
    None,
    /// Accepted.
    Accepted,
    /// The client is not the owner, or has an old epoch.
    NotOwner,
    /// Not allowed in the present state.
    WrongState,
    /// The machine does not know the command.
    UnknownCommand,
    /// The token is wrong or dead.
    DeadToken,
    /// Job, cycle or digest are not what was prepared or is in force.
    OtherJob,
    /// This job and cycle were begun already.
    AlreadyBegun,
    /// A payload is missing, broken or of another part.
    PayloadMissing,
    /// An interlock is open or the machine is not in automatic mode.
    InterlockOpen,
    /// A value of a payload is outside the machine's limits.
    OutsideLimits,
    /// The acknowledged number is not that of the finished job.
    OtherResult,
    /// A number that is not in the contract.
    Unlisted(u16),
}

impl fmt::Display for Answer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::None => "no answer yet",
            Self::Accepted => "accepted",
            Self::NotOwner => {
                "another client owns the machine, or has since this one started: end the other client, then claim again"
            }
            Self::WrongState => "the machine does not allow it in its present state",
            Self::UnknownCommand => "the machine does not know the command: compare its program with docs/modbus.md",
            Self::DeadToken => "the token of the prepared job is dead (30 s passed, or an interlock opened): prepare again",
            Self::OtherJob => "job, cycle or payloads are not those that were prepared: load and prepare again",
            Self::AlreadyBegun => "this job and cycle were begun before and are never begun twice",
            Self::PayloadMissing => "a payload is missing, broken, or made for another part: load it again, check the part",
            Self::InterlockOpen => {
                "an interlock is open or the machine is not in automatic mode: close the guards, check clamping and supplies"
            }
            Self::OutsideLimits => "a value of the payload is outside the machine's limits",
            Self::OtherResult => "the result is not the one that was acknowledged: collect it again",
            Self::Unlisted(number) => return write!(f, "answer {number}, which docs/modbus.md does not list"),
        })
    }
}

/// Why a machine stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Fault {
    /// No fault.
    None,
    /// The stop circuit is open.
    StopCircuit,
    /// A collision or an unexpected touch.
    Collision,
    /// Air, coolant or power is missing.
    Supplies,
    /// A limit of travel was met.
    TravelLimit,
    /// A drive has failed.
    Drive,
    /// The probe or the spindle has failed.
    Tool,
    /// The client was silent for too long.
    ClientSilent,
    /// Another fault, by its number.
    Other(u16),
}

impl Fault {
    /// The numbers of docs/modbus.md.
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

    /// The fault with a number.
    pub fn of(number: u16) -> Self {
        Self::NUMBERS.iter().find(|(_, known)| *known == number).map_or(Self::Other(number), |(fault, _)| *fault)
    }

    /// The number of a fault.
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
            Self::StopCircuit => "the stop circuit is open: close it at the machine, then clear",
            Self::Collision => "collision or unexpected touch: look at the part and the probe or wheel before clearing",
            Self::Supplies => "air, coolant or power is missing",
            Self::TravelLimit => "a limit of travel was met: check where the part is clamped",
            Self::Drive => "a drive has failed: see the machine's own panel",
            Self::Tool => "the probe or the spindle has failed: see the machine's own panel",
            Self::ClientSilent => "the machine heard nothing from its client for too long and holds",
            Self::Other(number) => return write!(f, "fault {number}: see the machine's own panel"),
        })
    }
}

/// How a job ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Outcome {
    /// It has not.
    None,
    /// To its end.
    Complete,
    /// By STOP.
    Stopped,
    /// By ABORT.
    Aborted,
    /// By a fault.
    Failed,
}

/// A signal that a cell file asks for besides the contract's own: its value and whether that is good come apart.
#[derive(Debug, Clone, PartialEq)]
pub struct SignalValue {
    /// Its name in the cell file.
    pub name: String,
    /// Its value in its unit; none where the machine gives no number.
    pub value: Option<f64>,
    /// Its unit, as written in the cell file.
    pub unit: String,
    /// Least and most that it may be.
    pub range: [f64; 2],
    /// What explains a value that is not there or cannot be, in words.
    pub cause: Option<String>,
}

impl SignalValue {
    /// Says what is wrong with it, if anything is.
    pub fn flaw(&self) -> Option<String> {
        let Self { name, value, unit, range: [least, most], cause } = self;
        let flaw = match value {
            None => format!("{name}: the machine gives no number"),
            Some(value) if (least..=most).contains(&value) => return None,
            Some(value) => format!("{name} is {value} {unit}, and {least} to {most} {unit} are wanted"),
        };
        Some(cause.iter().fold(flaw, |flaw, cause| format!("{flaw}: {cause}")))
    }
}

/// What a machine says of itself, all of one moment; `None` is what it cannot tell, and nobody fills that in: what has to be known
/// and is not, a person is asked.
#[derive(Debug, Clone, PartialEq)]
pub struct Status {
    /// Where it stands.
    pub state: State,
    /// The job prepared, running or finished.
    pub job: Option<Job>,
    /// The number of the START whose job ended last; 0 when there is none.
    pub done: u32,
    /// How that job ended.
    pub outcome: Outcome,
    /// Whether wheel or probe is clear of the part.
    pub clear_of_part: Option<bool>,
    /// Whether air, coolant and the like are there.
    pub supplies: Option<bool>,
    /// Whether it is in automatic mode; in manual mode a person may move it at its panel.
    pub automatic: Option<bool>,
    /// Why it stands.
    pub fault: Option<Fault>,
    /// Points measured, or thousandths of the path, and of how many.
    pub progress: Option<(u32, u32)>,
    /// Temperature of the part or the machine.
    pub temperature_c: Option<f64>,
    /// The number that changes whenever the machine's application starts.
    pub boot_id: Option<u32>,
    /// The signals that the cell file asks for besides.
    pub signals: Vec<SignalValue>,
}

impl Status {
    /// The status of a machine that tells nothing but where it stands.
    pub(super) fn of(state: State) -> Self {
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

/// A person's word about a machine that cannot tell it itself.
#[derive(Debug, Clone, PartialEq, Eq)]
#[expect(missing_docs, reason = "the fields are told above them")]
pub enum Word {
    /// It has begun its job, by this map where one was named.
    Started { map_identity: Option<[u8; 32]> },
    /// It has ended its job, by this map where one was named, and is clear of the part; a measurement came as a file.
    Done { map_identity: Option<[u8; 32]>, file: Option<PathBuf> },
    /// It stands still.
    Still,
}
