//! Interface of the physics behind a machine's registers. The handshake calls it when the machine has to move.

use std::fmt;

/// Kind of machine, numbered as in docs/modbus.md.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A coordinate measuring machine.
    Cmm = 1,
    /// A grinding machine.
    Grinder = 2,
}

/// Payloads in force: their bytes, high word first, and the identities with which they were sent.
#[derive(Clone, Debug, Default)]
pub struct Payloads {
    /// Kind 1, for a CMM.
    pub plan: Option<Payload>,
    /// Kind 2, for a grinder.
    pub map: Option<Payload>,
    /// Kind 3, for a grinder.
    pub pass: Option<Payload>,
}

/// Payload.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Payload {
    /// Bytes, in the order of docs/modbus.md with the high word first.
    pub bytes: Vec<u8>,
    /// SHA-256 with which it was sent.
    pub identity: [u8; 32],
}

/// Reason why a job or a payload is refused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// Answer of docs/modbus.md: 8, 9 or 10.
    pub answer: u16,
    /// Reason in words, for the log of the simulator.
    pub reason: String,
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (answer {})", self.reason, self.answer)
    }
}

/// Progress of a job.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Progress {
    /// Points measured, or thousandths of the path.
    pub done: u32,
    /// Total number of points, or 1000 for a path.
    pub total: u32,
    /// True if nothing is left to do.
    pub finished: bool,
    /// Fault of docs/modbus.md that has just stopped the machine; 0 for none.
    pub fault: u16,
}

/// Result that a finished or stopped job puts into the outbox.
#[derive(Clone, Debug, PartialEq)]
pub struct ResultData {
    /// Kind: 4 points, 5 pass record.
    pub kind: u16,
    /// Format of the records.
    pub format: u16,
    /// The records, high word first.
    pub bytes: Vec<u8>,
    /// Number of records.
    pub records: u32,
    /// Coordinates: 1 probe centres, 2 contact points, 0 for a pass record.
    pub coordinates: u16,
    /// Radius of the probe that the machine assumes, in mm.
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
/// The handshake calls `prepare`, `begin`, then `advance` in small steps of the machine's own time while the state is
/// EXECUTE. It calls `retract` when the machine must hold, stop or abort, and `outcome` when the job has ended.
pub trait Physics: Send {
    /// Returns the kind of machine.
    fn kind(&self) -> Kind;
    /// Returns the name and serial number of the machine, at most 32 ASCII characters.
    fn name(&self) -> String;
    /// Checks a payload after its arrival, before the machine uses it. `kind` is the number of the payload's kind in
    /// docs/modbus.md: 1 plan, 2 map, 3 pass.
    ///
    /// # Errors
    /// Returns a refusal if the bytes of the payload are invalid, if the payload is for a different part, or if a value
    /// exceeds the limits of the machine.
    fn check(&self, kind: u16, payload: &Payload) -> Result<(), Refusal>;
    /// Prepares cycle number `cycle` of the job `job`, without motion. `payloads` are the payloads in force: the
    /// checked plan, map or pass that the machine stores. Returns the progress before the start.
    ///
    /// # Errors
    /// Returns a refusal in these cases:
    ///
    /// - A payload is missing or exceeds the limits of the machine.
    /// - The payloads are for different parts.
    /// - The part is in the other machine of the cell (the CMM or the grinder).
    fn prepare(&mut self, job: u32, cycle: u16, payloads: &Payloads) -> Result<Progress, Refusal>;
    /// Begins to carry out the prepared job.
    fn begin(&mut self);
    /// Advances the running job by `seconds` of simulated time, and returns its progress.
    fn advance(&mut self, seconds: f64) -> Progress;
    /// Moves the wheel or the probe clear of the part. The job can then continue with [`Physics::advance`] or end with
    /// [`Physics::end_job`].
    fn retract(&mut self);
    /// Returns true if this kind of machine can return the finished records of its result while the job still runs.
    /// [`Physics::partial_result`] returns these records, for example the points measured so far. The default is false.
    fn has_partial_result(&self) -> bool {
        false
    }
    /// Returns the finished part of the result while the job still runs. This part does not change any more. Returns
    /// `None` if no job runs, or if the machine has a result only after the end of a job. The default is `None`.
    fn partial_result(&self) -> Option<ResultData> {
        None
    }
    /// Ends the job as complete (1), stopped (2), aborted (3) or failed (4), and returns its result.
    fn end_job(&mut self, result: u16) -> ResultData;
    /// Returns the interlocks of the machine as bits, numbered from 0 as in docs/modbus.md. A bit is 1 if its interlock
    /// is closed (good). The bit number 1 is the interlock "clear of the part": it is closed if the wheel or the probe
    /// is clear of the part.
    fn interlocks(&self) -> u16;
    /// Returns the temperature in °C that the machine reports in its status block.
    fn temperature_c(&self) -> f64;
}
