//! What stands behind a machine's registers: the physics, told by the handshake when to move.

use std::fmt;

/// Which machine it is, as docs/modbus.md numbers them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A coordinate measuring machine.
    Cmm = 1,
    /// A grinding machine.
    Grinder = 2,
}

/// The payloads in force: their bytes, with words high first, and the identities they were sent with.
#[derive(Clone, Debug, Default)]
pub struct Payloads {
    /// Kind 1, for a CMM.
    pub plan: Option<Payload>,
    /// Kind 2, for a grinder.
    pub map: Option<Payload>,
    /// Kind 3, for a grinder.
    pub pass: Option<Payload>,
}

/// One payload.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Payload {
    /// The bytes, in the order of docs/modbus.md with the high word first.
    pub bytes: Vec<u8>,
    /// The SHA-256 it was sent with.
    pub identity: [u8; 32],
}

/// Why a job or a payload is not taken.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// The answer of docs/modbus.md: 8, 9 or 10.
    pub answer: u16,
    /// In words, for the log of the simulator.
    pub reason: String,
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (answer {})", self.reason, self.answer)
    }
}

/// How far a job is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Progress {
    /// Points measured, or thousandths of the path.
    pub done: u32,
    /// Of how many.
    pub total: u32,
    /// Nothing is left to do.
    pub finished: bool,
    /// A fault of docs/modbus.md that has just stopped the machine, 0 for none.
    pub fault: u16,
}

/// What a finished or stopped job leaves in the outbox.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// 4 points, 5 pass record.
    pub kind: u16,
    /// Format of the records.
    pub format: u16,
    /// The records, high word first.
    pub bytes: Vec<u8>,
    /// How many.
    pub records: u32,
    /// 1 probe centres, 2 contact points, 0 for a pass record.
    pub coordinates: u16,
    /// Radius the machine believes its probe to have, in millimetres.
    pub probe_radius_mm: f64,
    /// Millimetres per count of format 2; 1 for format 1.
    pub scale_mm: f64,
    /// Mean temperature during the job.
    pub temperature_c: f64,
    /// Seconds of the machine's own time.
    pub duration_s: f64,
}

/// The physics of one machine.
///
/// The handshake calls `prepare`, `begin`, then `advance` in small steps of the machine's own time while the state is EXECUTE;
/// `retract` when it must hold, stop or abort; `outcome` when the job has ended.
pub trait Body: Send {
    /// Returns which machine it is.
    fn kind(&self) -> Kind;
    /// Returns the name and serial number of the machine, at most 32 ASCII characters.
    fn name(&self) -> String;
    /// Looks at a payload that has just arrived, before it comes into force.
    ///
    /// # Errors
    /// A payload that is broken, of another part, or beyond the machine's limits.
    fn check(&self, kind: u16, payload: &Payload) -> Result<(), Refusal>;
    /// Makes ready for a job with the payloads in force.
    ///
    /// # Errors
    /// What is missing, or does not fit together.
    fn prepare(&mut self, job: u32, cycle: u16, payloads: &Payloads) -> Result<Progress, Refusal>;
    /// Begins the job that was prepared.
    fn begin(&mut self);
    /// Moves on by some seconds of the machine's own time.
    fn advance(&mut self, seconds: f64) -> Progress;
    /// Moves clear of the part; the job can go on with `advance` or end with `outcome`.
    fn retract(&mut self);
    /// Says whether [`Body::so_far`] tells anything.
    fn tells_so_far(&self) -> bool {
        false
    }
    /// Returns what the job that runs has left so far and will not change any more; none where it leaves all at its end.
    fn so_far(&self) -> Option<Outcome> {
        None
    }
    /// Ends the job, complete (1), stopped (2), aborted (3) or failed (4), and returns what it leaves.
    fn outcome(&mut self, result: u16) -> Outcome;
    /// Returns the interlock bits of docs/modbus.md; bit 1, clear of the part, too.
    fn interlocks(&self) -> u16;
    /// Returns the temperature shown in the status block, in degrees Celsius.
    fn temperature_c(&self) -> f64;
}
