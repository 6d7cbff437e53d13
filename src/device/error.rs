//! What can go wrong with a machine: could not talk, or was told no.

use std::sync::Arc;
use std::time::Duration;

use super::{Answer, Command, Fault, Job, MachineKind, State};

/// Why a machine could not be asked, or what it refused.
///
/// [`DeviceError::is_link`] parts the two layers. Nothing here ever means "the job was not begun", save where a variant says so.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DeviceError {
    // ---- could not talk ----------------------------------------------------------------------------------------------------------
    /// There is no connection, and none could be made in time.
    #[error(
        "{machine} cannot be reached ({}) within {} ms: check that it is switched on, its cable, and address and port in the cell file",
        kind_in_words(*.why), .limit.as_millis()
    )]
    Unreachable {
        /// The machine.
        machine: Arc<str>,
        /// What the operating system said.
        why: std::io::ErrorKind,
        /// How long it was tried.
        limit: Duration,
    },
    /// The connection is there, but no answer came.
    #[error(
        "{machine} did not answer ({what}) within {} ms: check the line and its load, unit number and, on a serial line, baud rate and \
         parity",
        .limit.as_millis()
    )]
    TimedOut {
        /// The machine.
        machine: Arc<str>,
        /// What was asked.
        what: &'static str,
        /// The limit.
        limit: Duration,
    },
    /// The machine or something between closed the connection.
    #[error(
        "{machine} closed the connection ({what}): another client may have taken its only place, or it was restarted"
    )]
    Disconnected {
        /// The machine.
        machine: Arc<str>,
        /// What was being asked.
        what: &'static str,
    },
    /// What came does not add up: wrong length, echo, check number, or page.
    #[error(
        "{machine} sent a {what} that does not hold: expected {expected:#x}, found {found:#x}; nothing of it was used. If it happens \
         again check cable, shielding and end resistors, and that no second client is on the line"
    )]
    Corrupt {
        /// The machine.
        machine: Arc<str>,
        /// What was looked at.
        what: &'static str,
        /// What it had to be.
        expected: u64,
        /// What it was.
        found: u64,
    },
    /// The connection is alive, the machine's application is not.
    #[error(
        "{machine} answers, but its application stands: its beat has been {beat} for {} ms (limit {} ms). Look at the machine; what it \
         says cannot be relied on",
        .still.as_millis(), .limit.as_millis()
    )]
    Frozen {
        /// The machine.
        machine: Arc<str>,
        /// The beat that does not advance.
        beat: u16,
        /// For how long.
        still: Duration,
        /// The limit.
        limit: Duration,
    },
    /// A command was written several times and never acknowledged, and it is known that the machine did not act upon it later than this.
    #[error(
        "{machine} did not acknowledge {command} number {sequence} (its last is {acknowledged}) after {tries} tries: its application may \
         stand, or its program does not follow docs/modbus.md"
    )]
    NotAcknowledged {
        /// The machine.
        machine: Arc<str>,
        /// The command.
        command: Command,
        /// Its number.
        sequence: u32,
        /// What the machine has acknowledged.
        acknowledged: u32,
        /// How often it was written.
        tries: u32,
    },
    /// It cannot be told whether the job was begun. Never repeated; see [`Machine::reconcile`](super::Machine::reconcile).
    #[error(
        "{machine}: it is not known whether {job} was begun by START number {sequence} ({why}). It is not sent again; the machine has to \
         be asked, or looked at"
    )]
    StartUnknown {
        /// The machine.
        machine: Arc<str>,
        /// The job.
        job: Job,
        /// The number of the START.
        sequence: u32,
        /// What broke off the start.
        why: Box<DeviceError>,
    },
    /// The transfer was broken off by its [`Interrupt`](super::Interrupt).
    #[error(
        "{machine}: the transfer of the {what} was broken off after {done} of {of} pages, as asked; nothing of it is in force"
    )]
    Interrupted {
        /// The machine.
        machine: Arc<str>,
        /// What was carried.
        what: &'static str,
        /// Pages carried.
        done: u32,
        /// Pages in all.
        of: u32,
    },
    /// The driver was asked before [`Machine::connect`](super::Machine::connect).
    #[error("{machine} was asked ({what}) before it was connected")]
    NotConnected {
        /// The machine.
        machine: Arc<str>,
        /// What was asked.
        what: &'static str,
    },

    /// The right kind of machine, but not the one that the cell file names.
    #[error(
        "{machine} calls itself {found:?}, and the cell file expects {expected:?}: check address and port, or correct expected_name"
    )]
    WrongName {
        /// The machine.
        machine: Arc<str>,
        /// What the cell file says.
        expected: String,
        /// What the machine says.
        found: String,
    },
    /// A simulation where the cell file has a real machine, or the other way round.
    #[error(
        "{machine} says that it is {}, and the cell file says simulated = {}: nothing was sent to it. Check address and port, or correct \
         cell.simulated",
        if *.simulation { "a simulation" } else { "a real machine" }, !.simulation
    )]
    WrongReality {
        /// The machine.
        machine: Arc<str>,
        /// Whether it says that it is simulated.
        simulation: bool,
    },
    /// A person's word was given for a machine that needs none.
    #[error("{machine} tells itself when a job begins and ends; nothing is confirmed by hand")]
    TellsItself {
        /// The machine.
        machine: Arc<str>,
    },
    /// A person's word did not say which map the machine works by.
    #[error("{machine} takes a word only with the map that it is about: --map and the first 8 digits of it, or more")]
    MapUnnamed {
        /// The machine.
        machine: Arc<str>,
    },
    /// A file that a person named is not the measurement that was asked for, or could not be kept.
    #[error("{machine}: {why}")]
    NotTaken {
        /// The machine.
        machine: Arc<str>,
        /// The reason and the remedy, in words.
        why: String,
    },

    /// The folders that stand for the machine cannot be read or written, or hold something that must not be touched.
    #[error("{machine}: {why}")]
    Folder {
        /// The machine.
        machine: Arc<str>,
        /// The file, the reason and the remedy, in words of the room that reads and writes files.
        why: String,
    },

    // ---- was told no, or the wrong thing -----------------------------------------------------------------------------------------
    /// The machine refused a command.
    #[error("{machine} refused {command} in {state}: {answer}")]
    Refused {
        /// The machine.
        machine: Arc<str>,
        /// The command.
        command: Command,
        /// Its answer.
        answer: Answer,
        /// The state it was in.
        state: State,
    },
    /// The machine has a fault.
    #[error("{machine} is {state} with a fault: {fault}")]
    Faulted {
        /// The machine.
        machine: Arc<str>,
        /// The state it is in.
        state: State,
        /// The fault.
        fault: Fault,
    },
    /// The machine refused a payload.
    #[error("{machine} refused the {what}: {answer}")]
    PayloadRefused {
        /// The machine.
        machine: Arc<str>,
        /// What was carried.
        what: &'static str,
        /// Its reason.
        answer: Answer,
    },
    /// A Modbus exception.
    #[error("{machine} answered exception {code} ({}) to {what} at register {address}: compare the register map of the cell file with the machine's", exception_in_words(*.code))]
    Exception {
        /// The machine.
        machine: Arc<str>,
        /// What was asked.
        what: &'static str,
        /// The 0-based address of the first register.
        address: u16,
        /// The exception.
        code: u8,
    },
    /// Something answers that is not a machine of this kind.
    #[error(
        "{machine} is not a {expected} of a Regrind cell: register {address} holds {found:#06x}, {required:#06x} was expected. Check \
         address, port and unit number in the cell file, and the base of the identity block; nothing was written to it"
    )]
    WrongDevice {
        /// The machine.
        machine: Arc<str>,
        /// What was expected.
        expected: MachineKind,
        /// The 0-based address that gave it away.
        address: u16,
        /// What it had to hold.
        required: u16,
        /// What it holds.
        found: u16,
    },
    /// The cell file names the machine as one kind, and it is the other.
    #[error(
        "{machine} is a {found}, and the cell file has it as the {expected}: the two addresses may be exchanged; nothing was written to it"
    )]
    WrongKind {
        /// The machine.
        machine: Arc<str>,
        /// What was expected.
        expected: MachineKind,
        /// What it says it is.
        found: MachineKind,
    },
    /// The sentinels read right in the other word order, or in none.
    #[error(
        "{machine} sends its words in another order than the cell file says (word_order = \"{configured}\"): {}; nothing was written to it",
        match .fits { Some(order) => format!("write word_order = \"{order}\""), None => "neither \"big\" nor \"little\" fits its sentinels".into() }
    )]
    WrongWordOrder {
        /// The machine.
        machine: Arc<str>,
        /// The order in the cell file.
        configured: &'static str,
        /// The order that fits, if one does.
        fits: Option<&'static str>,
    },
    /// The machine speaks another version of the map.
    #[error(
        "{machine} speaks version {found} of the register map, this program version {required}: bring the older of the two up to date"
    )]
    WrongVersion {
        /// The machine.
        machine: Arc<str>,
        /// Ours.
        required: u16,
        /// Theirs.
        found: u16,
    },
    /// The machine works in inches, or does not say what it works in.
    #[error("{machine} gives lengths in {}, and this program takes millimetres only: set the machine to millimetres", if *.unit == 2 { "inches" } else { "an unknown unit" })]
    Inches {
        /// The machine.
        machine: Arc<str>,
        /// The unit code: 1 mm, 2 inch.
        unit: u16,
    },
    /// The machine was restarted behind our back.
    #[error(
        "{machine} was restarted (boot id {was:08x}, now {is:08x}): what it was doing is not known; look at the machine, then connect anew"
    )]
    Restarted {
        /// The machine.
        machine: Arc<str>,
        /// The boot id known.
        was: u32,
        /// The boot id found.
        is: u32,
    },
    /// A number came that is none.
    #[error("{machine}: {field} is {value}, which is not a finite number; refused")]
    NotFinite {
        /// The machine.
        machine: Arc<str>,
        /// Which value.
        field: String,
        /// What it was, in words.
        value: f64,
    },
    /// A number came that cannot be.
    #[error(
        "{machine}: {field} is {value} {unit}, allowed is {least} to {most} {unit}: check scale, type and word order in the cell file, and the sensor"
    )]
    OutOfRange {
        /// The machine.
        machine: Arc<str>,
        /// Which value.
        field: String,
        /// What it was.
        value: f64,
        /// The least allowed.
        least: f64,
        /// The most allowed.
        most: f64,
        /// Its unit.
        unit: String,
    },
    /// A code came that the contract does not have.
    #[error(
        "{machine}: {field} is {found}, which docs/modbus.md does not list: the machine's program does not follow it"
    )]
    Unlisted {
        /// The machine.
        machine: Arc<str>,
        /// Which field.
        field: &'static str,
        /// What it holds.
        found: u32,
    },
    /// There are more or fewer than there should be.
    #[error("{machine}: {found} {what}, {expected} were expected; nothing of it was used")]
    Count {
        /// The machine.
        machine: Arc<str>,
        /// What was counted.
        what: &'static str,
        /// How many there had to be.
        expected: u64,
        /// How many there are.
        found: u64,
    },
    /// The machine holds something else than was sent, or something of another job.
    #[error(
        "{machine}: {field} is {held:#x} at the machine, {sent:#x} here: it would work on something else than was meant. Load it again"
    )]
    Mismatch {
        /// The machine.
        machine: Arc<str>,
        /// Which field.
        field: &'static str,
        /// What was sent or is meant.
        sent: u64,
        /// What the machine holds.
        held: u64,
    },
    /// A result was asked for when there is none.
    #[error(
        "{machine} is in {state} and has no finished result of {job}: a result stands from COMPLETE until it is acknowledged"
    )]
    NoResult {
        /// The machine.
        machine: Arc<str>,
        /// What was asked for.
        job: Job,
        /// The state it is in.
        state: State,
    },
    /// A payload was given to the driver that no machine could take.
    #[error("{machine}: the {what} cannot be sent: {field} is {value}, allowed is {limit}")]
    BadPayload {
        /// The machine.
        machine: Arc<str>,
        /// Which payload.
        what: &'static str,
        /// Which field.
        field: String,
        /// Its value.
        value: f64,
        /// What is allowed, in words.
        limit: &'static str,
    },
}

impl DeviceError {
    /// Whether it is the talking that failed, so that the machine itself may be as well as before. The other layer is a clear *no*.
    pub fn is_link(&self) -> bool {
        matches!(
            self,
            Self::Unreachable { .. }
                | Self::TimedOut { .. }
                | Self::Disconnected { .. }
                | Self::Corrupt { .. }
                | Self::Frozen { .. }
                | Self::NotAcknowledged { .. }
                | Self::StartUnknown { .. }
                // Busy, a gateway that finds nobody, a memory error: asked again it may go well.
                | Self::Exception { code: 4 | 5 | 6 | 8 | 10 | 11, .. }
                | Self::Folder { .. }
        )
    }
}

fn kind_in_words(kind: std::io::ErrorKind) -> String {
    kind.to_string()
}

fn exception_in_words(code: u8) -> &'static str {
    match code {
        1 => "unknown function",
        2 => "no such register, or not to be written",
        3 => "content refused",
        4 => "failure of the device",
        5 => "accepted, not finished",
        6 => "busy",
        8 => "memory parity error",
        10 => "gateway: no path",
        11 => "gateway: the device behind it does not answer",
        _ => "not in the standard",
    }
}
