//! Errors of a machine: the communication failed, or the machine refused.

use std::sync::Arc;
use std::time::Duration;

use super::{Answer, Fault, Job, MachineCommand, MachineKind, MachineState};

/// Result of a request to a machine.
pub(super) type DeviceResult<T> = Result<T, DeviceError>;

/// Error of the communication with a machine, or refusal by the machine.
///
/// [`DeviceError::is_link`] separates the two layers. No error means "the job was not begun", except where a variant
/// says so.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the message of each tells what its fields are")]
#[non_exhaustive]
pub enum DeviceError {
    // ---- communication failed
    // ----------------------------------------------------------------------------------------------------
    /// There is no connection, and none could be made within the time limit.
    #[error(
        "{machine} cannot be reached ({}) within {} ms: check its power and its cable, and address and port in the \
         cell file",
        kind_in_words(*.kind), .limit.as_millis()
    )]
    Unreachable { machine: Arc<str>, kind: std::io::ErrorKind, limit: Duration },
    /// The connection exists, but no answer arrived in time.
    #[error(
        "{machine} did not answer ({operation}) within {} ms. Check the cable, the traffic on the line and the \
         unit number. On a serial line, also check baud rate and parity",
        .limit.as_millis()
    )]
    TimedOut { machine: Arc<str>, operation: &'static str, limit: Duration },
    /// The machine, or a device between, closed the connection.
    #[error(
        "{machine} closed the connection ({operation}). Check whether another client uses the only connection that \
         the machine allows, or whether the machine was restarted"
    )]
    Disconnected { machine: Arc<str>, operation: &'static str },
    /// The received data are inconsistent: wrong length, echo, checksum or page.
    #[error(
        "{machine} sent an inconsistent {data}: expected {expected:#x}, found {found:#x}; the data were not used. If \
         this repeats, check cable, shielding and terminating resistors. Also check that no second client uses the line"
    )]
    Corrupt { machine: Arc<str>, data: &'static str, expected: u64, found: u64 },
    /// The connection works, but the machine's application has stopped.
    #[error(
        "{machine} answers, but the machine's program has stopped: its heartbeat counter has stayed at {beat} for \
         {} ms (limit {} ms). Check the machine; do not rely on its values",
        .unchanged_for.as_millis(), .limit.as_millis()
    )]
    Frozen { machine: Arc<str>, beat: u16, unchanged_for: Duration, limit: Duration },
    /// A command was written several times and never acknowledged. The driver knows that the machine did not act upon
    /// it later.
    #[error(
        "{machine} did not acknowledge {command} number {sequence} after {tries} tries; the last acknowledged number \
         is {acknowledged}. Check that the machine's program runs and follows docs/modbus.md"
    )]
    NotAcknowledged { machine: Arc<str>, command: MachineCommand, sequence: u32, acknowledged: u32, tries: u32 },
    /// It is unknown whether the job was begun. The start is never repeated; see
    /// [`Machine::reconcile`](super::Machine::reconcile).
    #[error(
        "{machine}: it is unknown whether START number {sequence} began {job} ({cause}). START is not sent again; \
         check at the machine whether the job runs"
    )]
    StartUnknown { machine: Arc<str>, job: Job, sequence: u32, cause: Box<DeviceError> },
    /// The transfer was interrupted by its [`Interrupt`](super::Interrupt).
    #[error(
        "{machine}: the transfer of the {payload} was interrupted on request after {done} of {total} pages; the \
         machine uses no part of the transferred data"
    )]
    Interrupted { machine: Arc<str>, payload: &'static str, done: u32, total: u32 },
    /// The driver was used before [`Machine::connect`](super::Machine::connect).
    #[error("{machine} was used ({operation}) before Regrind connected to the machine; connect first")]
    NotConnected { machine: Arc<str>, operation: &'static str },

    /// The machine is of the right kind, but it is not the one that the cell file names.
    #[error(
        "{machine} has the name {found:?}, but the cell file expects {expected:?}: check address and port, or \
         correct expected_name"
    )]
    WrongName { machine: Arc<str>, expected: String, found: String },
    /// The machine is a simulation and the cell file has a real machine, or the reverse.
    #[error(
        "{machine} reports that it is {}, but the cell file has simulated = {}. Nothing was sent to the machine. Check \
         address and port, or correct cell.simulated",
        if *.simulation { "a simulation" } else { "a real machine" }, !.simulation
    )]
    SimulationMismatch { machine: Arc<str>, simulation: bool },
    /// An operator confirmation was given for a machine that needs none.
    #[error(
        "the confirmation was not used, because {machine} itself reports the begin and the end of a job; no \
         confirmation is required"
    )]
    ConfirmationNotNeeded { machine: Arc<str> },
    /// An operator confirmation did not name the map with which the machine works.
    #[error(
        "a confirmation for {machine} must name the map: add --map with at least the first 8 digits of the map identity"
    )]
    MapNotNamed { machine: Arc<str> },
    /// A file that the operator named is not the requested measurement, or it could not be stored.
    #[error("{machine}: {reason}")]
    NotAccepted { machine: Arc<str>, reason: String },

    /// The machine sent a line that has no meaning, or that belongs to no request.
    #[error(
        "{machine} sent a line that cannot be used ({reason}): {line:?}; the line was not used, and the connection was \
         closed. If this repeats, compare the version of the protocol at the machine with the page of this protocol in docs"
    )]
    Unreadable { machine: Arc<str>, line: String, reason: &'static str },

    /// A line to send would not be one plain line of the protocol of the machine.
    #[error(
        "{machine}: {operation} was not sent, because the line would contain a character that is not plain text. \
         Correct the cell file"
    )]
    Unsendable { machine: Arc<str>, operation: &'static str },
    /// Another client has taken control; the machine does not say which client.
    #[error(
        "{machine} is now controlled by another client. Find that client, and let that client release the machine. \
         Regrind takes control back only with an abort, or when an interrupted run is resumed"
    )]
    ControlTaken { machine: Arc<str> },

    /// The folders of a machine cannot be read or written, or they contain something that must not be changed.
    #[error("{machine}: {reason}")]
    Folder { machine: Arc<str>, reason: String },

    // ---- refused, or wrong content
    // -----------------------------------------------------------------------------------------------
    /// The machine refused a command.
    #[error("{machine} refused {command} in {state}: {answer}")]
    Refused { machine: Arc<str>, command: MachineCommand, answer: Answer, state: MachineState },
    /// The machine has a fault.
    #[error("{machine} is {state} with a fault: {fault}")]
    Faulted { machine: Arc<str>, state: MachineState, fault: Fault },
    /// The machine refused a payload.
    #[error("{machine} refused the {payload}: {answer}")]
    PayloadRefused { machine: Arc<str>, payload: &'static str, answer: Answer },
    /// The machine answered with a Modbus exception. Addresses count from 0.
    #[error(
        "{machine} answered a request ({operation}, register {address}) with the Modbus exception {code} ({}): {}",
        exception_in_words(*.code), exception_remedy(*.code)
    )]
    Exception { machine: Arc<str>, operation: &'static str, address: u16, code: u8 },
    /// The device that answers is not a machine of this kind. The register at this address, counted from 0, shows it.
    #[error(
        "{machine} is not a {expected} of a Regrind cell: register {address} has {found:#06x}, expected \
         {required:#06x}. Nothing was written to the device. Check address, port, unit number and the base of the \
         identity block in the cell file"
    )]
    WrongDevice { machine: Arc<str>, expected: MachineKind, address: u16, required: u16, found: u16 },
    /// The identity block of the map has a wrong layout: exchanged bytes, or addresses off by one.
    #[error("{machine} sends the correct identity block, but {description}; nothing was written to the machine")]
    WrongLayout { machine: Arc<str>, description: std::borrow::Cow<'static, str> },
    /// The cell file names one kind of machine, and this is the other kind.
    #[error(
        "{machine} is a {found}, but the cell file expects a {expected} at this address. Check whether the two \
         addresses are swapped. Nothing was written to the machine"
    )]
    WrongKind { machine: Arc<str>, expected: MachineKind, found: MachineKind },
    /// The sentinels are correct in the other word order, or in none.
    #[error(
        "{machine} sends its values in another word order than the cell file expects (word_order = \"{configured}\"): \
         {}; nothing was written to the machine",
        match .matching { Some(order) => format!("write word_order = \"{order}\""), None => "the test values (sentinels) of the machine fit neither \"big\" nor \"little\"".into() }
    )]
    WrongWordOrder { machine: Arc<str>, configured: &'static str, matching: Option<&'static str> },
    /// The machine uses another version of the map.
    #[error(
        "{machine} has version {found} of the register map, but Regrind requires version {required}: {}; nothing was \
         written to the machine",
        version_in_words(*.found, *.required)
    )]
    WrongVersion { machine: Arc<str>, required: u16, found: u16 },
    /// Another client than this one owns the machine, or no client does (0).
    #[error(
        "{machine} belongs to {}",
        match .owner {
            0 => "no client now: the machine no longer knows Regrind as its client, for example after a restart of \
                  the machine's program; check the machine before the run continues".to_owned(),
            owner => format!("another client now (owner {owner:08x}, this client is {ours:08x}): find that client; one \
                              of the two clients must release the machine"),
        }
    )]
    OwnedByOther { machine: Arc<str>, ours: u32, owner: u32 },
    /// The machine works in inches (unit code 2), or gives no known unit (1 is mm).
    #[error(
        "{machine} gives lengths in {}, but Regrind accepts only mm: set the machine to mm",
        if *.unit == 2 { "inches" } else { "an unknown unit" }
    )]
    WrongLengthUnit { machine: Arc<str>, unit: u16 },
    /// The machine was restarted without our knowledge.
    #[error(
        "{machine} was restarted (boot id {old_boot_id:08x}, now {new_boot_id:08x}): its last action is unknown; \
         check the machine, then connect again"
    )]
    Restarted { machine: Arc<str>, old_boot_id: u32, new_boot_id: u32 },
    /// A received value is not a finite number.
    #[error(
        "{machine}: {field} is {value}, which is not a finite number; the value was rejected. Check that the \
         machine's program sets this value, in the same word order as its test values (sentinels, docs/modbus.md)"
    )]
    NotFinite { machine: Arc<str>, field: String, value: f64 },
    /// A received value is outside its possible range.
    #[error(
        "{machine}: {field} is {value} {unit}; the allowed range is {min} to {max} {unit}. Check scale, type and word \
         order in the cell file. Also check the sensor"
    )]
    OutOfRange { machine: Arc<str>, field: String, value: f64, min: f64, max: f64, unit: String },
    /// A received code is not in the contract.
    #[error("{machine}: {field} is {found}, which docs/modbus.md does not list: correct the machine's program")]
    Unlisted { machine: Arc<str>, field: &'static str, found: u32 },
    /// The number of elements is not the expected one.
    #[error(
        "{machine}: {found} {elements}, but {expected} are expected; the data were not used. Check the machine's \
         program"
    )]
    WrongCount { machine: Arc<str>, elements: &'static str, expected: u64, found: u64 },
    /// The machine holds something else than was sent, or something of another job.
    #[error(
        "{machine}: {field} is {found:#x} at the machine, but {sent:#x} in Regrind. The two values \
         must be equal: the machine has other data than Regrind. Check which job the machine has"
    )]
    Mismatch { machine: Arc<str>, field: &'static str, sent: u64, found: u64 },
    /// A result was requested, but there is none.
    #[error(
        "{machine} is in {state} and has no finished result of {job}: a result exists only from the state COMPLETE \
         until the result is acknowledged"
    )]
    NoResult { machine: Arc<str>, job: Job, state: MachineState },
    /// An I++ DME server refused a method with an error number.
    #[error(
        "{machine} refused {method} with {error}; read the message at the panel of the machine and remove the cause, \
         then clear the error"
    )]
    MethodRefused { machine: Arc<str>, method: &'static str, error: crate::ippdme::ServerError },
    /// An I++ DME server did not return the requested value.
    #[error(
        "{machine} answered {method} without {missing}; the answer was not used. Check the I++ DME server of the \
         machine"
    )]
    ValueMissing { machine: Arc<str>, method: &'static str, missing: &'static str },
    /// An I++ DME server does not know the tool that the cell file names.
    #[error("{machine} has no tool {tool:?}; the known tools are {known}. Correct cmm.wire.tool")]
    NoTool { machine: Arc<str>, tool: String, known: String },
    /// The probe of the machine is not the probe of the plan.
    #[error(
        "{machine} reports a radius of {reported_mm} mm for the tool {tool:?}; the plan has {plan_mm} mm, and the \
         limit of the difference is {limit_mm} mm: qualify the probe, or correct the tool in the cell file or the \
         radius in the recipe"
    )]
    ProbeRadius { machine: Arc<str>, tool: String, reported_mm: f64, plan_mm: f64, limit_mm: f64 },
    /// A property was set, but another value is in force.
    #[error(
        "{machine} was set to {property} = {requested}, but reports {in_force}: correct the recipe or the cell file"
    )]
    NotSet { machine: Arc<str>, property: String, requested: f64, in_force: f64 },
    /// A plan moves the probe out of the volume of the machine. This is checked before anything moves.
    #[error(
        "{machine}: the {motion} target {target} would move the probe's centre to {axis} = {value_mm} mm; \
         [cmm.travel] allows {min_mm} to {max_mm} mm; nothing was moved. Move the part in [cmm.fixture], lower \
         measure.safe_height_mm, or correct [cmm.travel]"
    )]
    OutOfVolume {
        machine: Arc<str>,
        motion: &'static str,
        target: u32,
        axis: char,
        value_mm: f64,
        min_mm: f64,
        max_mm: f64,
    },
    /// A controller does not answer as linuxcncrsh does.
    #[error(
        "{machine} does not answer like linuxcncrsh: the answer to {request} was {reply:?}. Regrind \
         sent only queries, which change nothing at the machine. Check host and port in the cell file"
    )]
    NotLinuxcnc { machine: Arc<str>, request: &'static str, reply: String },
    /// A controller refused a password.
    #[error("{machine} refused the password: correct grinder.wire.{key}, or the options of linuxcncrsh (-w, -e)")]
    Password { machine: Arc<str>, key: &'static str },
    /// The machine is not ready for a job, and only a person can make it ready.
    #[error("{machine} is not ready: {reason}")]
    NotReady { machine: Arc<str>, reason: &'static str },
    /// A controller reported errors.
    #[error("{machine} reported errors when {occasion}: {errors}")]
    ControllerErrors { machine: Arc<str>, occasion: &'static str, errors: String },
    /// The driver was given a payload that no machine could accept.
    #[error("{machine}: the {payload} cannot be sent: {field} is {value}; it must be {limit}")]
    BadPayload { machine: Arc<str>, payload: &'static str, field: String, value: f64, limit: &'static str },
}

/// Modbus exception codes: the machine is busy, the gateway finds no machine, memory error.
const BUSY: [u8; 6] = [4, 5, 6, 8, 10, 11];

impl DeviceError {
    /// Returns true if the error concerns only the access to the machine, so that the machine itself may be unaffected.
    /// Examples are a timeout, a lost connection, a folder that cannot be read, another client that took control, or a
    /// Modbus exception that says that the machine is busy. Returns false for every other error, for example if the
    /// machine refuses a command.
    pub fn is_link(&self) -> bool {
        self.is_busy()
            || matches!(
                self,
                Self::Unreachable { .. }
                    | Self::TimedOut { .. }
                    | Self::Disconnected { .. }
                    | Self::Corrupt { .. }
                    | Self::Frozen { .. }
                    | Self::NotAcknowledged { .. }
                    | Self::StartUnknown { .. }
                    | Self::OwnedByOther { .. }
                    | Self::Folder { .. }
                    | Self::Unreadable { .. }
                    | Self::ControlTaken { .. }
            )
    }

    /// Returns true if the error is a Modbus exception that says that the request cannot be carried out now. The
    /// machine, or a gateway between this computer and the machine, sends such an exception. A retry may succeed.
    pub(super) fn is_busy(&self) -> bool {
        matches!(self, Self::Exception { code, .. } if BUSY.contains(code))
    }
}

/// Returns a text that explains why the version `found` of the register map of a machine does not fit the version
/// `required` of this program, and what to update.
fn version_in_words(found: u16, required: u16) -> String {
    if found > required {
        return "this version of Regrind is older than the map and does not know this map: update Regrind".to_owned();
    }
    let lacks = [
        "a heartbeat that names its owner (without the owner, the heartbeat of any client keeps the machine moving)",
        "a CLAIM command that makes the machine refuse a late START with a lower number",
        "an ABORT command that the machine accepts from any client, with any sequence number",
        "a register `done` whose value remains after CLEAR and is the number of the START of the ended job",
        "a measuring plan whose first targets can have a slow speed, because the part may be displaced there",
    ];
    format!(
        "the machine's program lacks {}; update it to version {required} (docs/modbus.md, \"What version 2 changed\")",
        lacks.join("; ")
    )
}

fn kind_in_words(kind: std::io::ErrorKind) -> String {
    kind.to_string()
}

/// Returns a text that tells a person how to correct the cause of the Modbus exception with this code.
fn exception_remedy(code: u8) -> &'static str {
    match code {
        1..=3 => {
            "compare the register map in the cell file with the register map of the machine (docs/modbus.md): the \
             version of the map, and the base addresses, which count from 0 (40001 is register 0)"
        }
        10 | 11 => "check the gateway, and the unit number in the cell file",
        _ => "check the machine",
    }
}

fn exception_in_words(code: u8) -> &'static str {
    match code {
        1 => "unknown function",
        2 => "unknown or read-only register",
        3 => "content refused",
        4 => "failure of the device",
        5 => "accepted, not finished",
        6 => "busy",
        8 => "memory parity error",
        10 => "gateway: no path",
        11 => "gateway: its device does not answer",
        _ => "not in the standard",
    }
}
