//! Part of a cell file that a driver owns: its table `wire`, the checks of it, and the machines that are made from it.

use std::path::{Path, PathBuf};
use std::time::Duration;

use thiserror::Error;

use super::handshake::MachineKind;
use super::machine::{Cmm, Grinder};
use super::machine_table::MachineTable;
use super::modbus::{LineAddress, Link, RegisterMap, Signal};
use regrind_document::Document;
use regrind_formats::FormatError;
use regrind_formats::result::Coordinates;

/// Timing of the communication with a machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timing {
    /// Timeout for the answer to one request.
    pub request_timeout: Duration,
    /// Number of retries of a request after the first attempt.
    pub retries: u8,
    /// Interval between two reads of the status.
    pub poll: Duration,
    /// Interval between two heartbeats.
    pub heartbeat: Duration,
    /// Time without an answer after which the machine is lost.
    pub lost_after: Duration,
    /// Silence after a corrupt answer, in which late bytes may still arrive.
    pub quarantine: Duration,
}

/// Data from which a driver is created, in addition to the table `wire`.
#[derive(Clone, Copy, Debug)]
pub struct DriverContext<'a> {
    /// Name of the part in files and prompts.
    pub part: &'a str,
    /// Folder of the cell file, to which its paths are relative.
    pub cell_folder: &'a Path,
    /// Folder of the run.
    pub run_folder: &'a Path,
    /// True if the machines of the cell are simulations.
    pub simulated: bool,
    /// Number of this client, for machines that several clients can reach.
    pub owner: u32,
    /// Epoch of this client; it increases with each start.
    pub epoch: u32,
    /// Minimum number of points, if any number of points is allowed; `None` if each target of a plan needs one point.
    pub min_free_points: Option<usize>,
    /// Minimum fraction of the targets of a plan that need a point in a measurement.
    pub min_coverage: f64,
    /// True if people only act as the machines: the plan itself may be returned as the measurement.
    pub rehearsal: bool,
    /// Timing of the communication.
    pub timing: &'a Timing,
    /// Addresses of the blocks of its Modbus map.
    pub registers: &'a RegisterMap,
    /// Additional values that are read and recorded.
    pub signals: &'a [Signal],
    /// Name that the machine must report.
    pub expected_name: Option<&'a str>,
    /// Box that the centre of the probe must not leave: its minimum and maximum corner, in mm.
    pub volume_mm: Option<[[f64; 3]; 2]>,
    /// Line of the other machine, which this machine can share.
    pub shared_link: Option<&'a Link>,
}

/// Check of the connection to a machine that a program can make without a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConnectionCheck {
    /// The driver requests the identity and the status, and closes the connection.
    Session,
    /// The driver listens for lines of text that the machine sends by itself.
    Listen,
    /// The machine is a Modbus device, to which the tables `registers` and `signals` apply. Its blocks of registers are
    /// read one by one.
    Registers,
    /// There is no data connection.
    Nothing,
}

/// Table `wire` of a cell file, with the driver that belongs to it.
pub trait DriverFactory {
    /// Measuring machine on this wire.
    type Cmm: Cmm + std::fmt::Debug;
    /// Grinder on this wire.
    type Grinder: Grinder + std::fmt::Debug;

    /// True if a person operates the machine. Then a job takes as long as the person needs, and nothing simulates the
    /// machine.
    const BY_PERSON: bool = false;
    /// True if its results may contain their temperature.
    const REPORTS_TEMPERATURE: bool = true;
    /// True if the grinder works from the program and the map in the folder of the run, also for the first pass of a
    /// run.
    const READS_RUN_FOLDER: bool = false;
    /// Check of the connection without a job.
    const CHECK: ConnectionCheck = ConnectionCheck::Nothing;
    /// Advice for a person who must end a job of the machine, if no program can do that.
    const END_OF_JOB: &'static str = "this machine has no data connection; bring the machine to idle by hand";

    /// Checks this table `wire` of the cell file, which describes the connection to one machine. Reports each error
    /// that the schema of the cell file does not detect. The errors are added to the list of problems in `_document`,
    /// which is the cell file while it is checked. `_place` states whether the table belongs to the CMM or to the
    /// grinder. The default reports no error.
    fn check(&self, _place: &MachineTable<'_>, _document: &mut Document) {}

    /// Compares this table `wire`, which describes the connection to the CMM, with the table `_grinder`, which
    /// describes the connection to the grinder. Reports each conflict, for example a folder that both machines use. The
    /// conflicts are added to the list of problems in `_document`, which is the cell file while it is checked. The
    /// default reports no conflict.
    fn check_against_grinder(&self, _grinder: &Self, _document: &mut Document) {}

    /// Returns notes for a person about this connection on this computer, for example that a serial port does not
    /// exist. These notes are not errors of the cell file. The default returns an empty list.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }

    /// Returns whether the points of a measurement through this connection are probe centres or contact points. Returns
    /// `None` if the connection does not determine this; each result must then state it. The default is probe centres.
    fn coordinates(&self) -> Option<Coordinates> {
        Some(Coordinates::Centres)
    }

    /// Creates the driver of a measuring machine from this table `wire` and the other data in `context`. Sends nothing
    /// to the machine yet.
    ///
    /// # Errors
    /// Returns an error if this kind of connection has no driver for a measuring machine, if the connection cannot be
    /// opened, if a folder does not exist, if a file cannot be read, or if the cell file lacks a required value.
    fn create_cmm(&self, context: &DriverContext<'_>) -> Result<Self::Cmm, DriverError>;

    /// Creates the driver of a grinder from this table `wire` and the other data in `context`. Sends nothing to the
    /// machine yet.
    ///
    /// # Errors
    /// Returns an error if this kind of connection has no driver for a grinder. Otherwise the errors are those of
    /// [`DriverFactory::create_cmm`].
    fn create_grinder(&self, context: &DriverContext<'_>) -> Result<Self::Grinder, DriverError>;

    /// Returns the Modbus line that the driver `_cmm` uses. The driver of the other machine may share this line.
    /// Returns `None` if the connection is not Modbus.
    fn link(_cmm: &Self::Cmm) -> Option<&Link> {
        None
    }

    /// Returns the address of the machine in words, by which this computer tells it from all other machines. Returns
    /// `None` if the connection has no address, for example because a person operates the machine.
    fn address(&self) -> Option<String> {
        None
    }

    /// Returns true if the address of the machine is assigned only when a simulated machine starts, for example with
    /// port 0.
    fn has_open_address(&self) -> bool {
        false
    }

    /// Returns the address of the Modbus line and the unit id of the machine on this line. The address is a host and a
    /// TCP port, or a serial port. If the machine is simulated, the simulator listens at the same address. Returns
    /// `None` if the connection is not Modbus.
    fn modbus_line(&self) -> Option<(LineAddress, u8)> {
        None
    }
}

/// Reason why a machine cannot be made from the cell file.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "the message of each tells what its fields are")]
#[non_exhaustive]
pub enum DriverError {
    /// A required folder does not exist.
    #[error(
        "{key}: the folder {path} does not exist; create this folder (mkdir -p {path}) and give the {machine} access \
         to this folder, or correct the cell file"
    )]
    Folder { key: String, path: PathBuf, machine: MachineKind },
    /// The file of reference points is not valid.
    #[error("cmm.wire.reference_points: {source}")]
    References { source: Box<FormatError> },
    /// A serial port does not exist.
    #[error("{missing}; connect the missing port, or name an existing port in the cell file")]
    NoPort { missing: String },
    /// The positions of the machine must be checked against its volume, but the cell file gives no volume.
    #[error(
        "cmm.travel is missing: Regrind must check every position against the travel limits before {machine} moves; \
         add [cmm.travel] with the minimum and the maximum x, y and z of the probe centre"
    )]
    NoVolume { machine: String },
    /// This wire has no driver for this machine.
    #[error(
        "{table}.wire: kind = {kind:?} cannot be used for this machine, only for the other machine of the cell; name \
         another kind"
    )]
    NoDriver { table: &'static str, kind: &'static str },
    /// The line cannot be opened.
    #[error("{line} cannot be opened: {source}; check the cell file and the machine")]
    Line { line: String, source: std::io::Error },
}
