//! Reason why a command failed, in one sentence with its remedy, and its exit code.

use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use regrind::compensation::NextPassError;
use regrind::device::DriverError;
use regrind::formats::FormatError;
use regrind::journal::JournalError;
use regrind::registration::RegistrationError;
use regrind::report::ReportError;
use regrind::setup::SetupError;
use regrind::surface::{DefinitionError, SurfaceError};
#[cfg(feature = "plant")]
use regrind_plant::PlantError;
use thiserror::Error;

/// Exit code if the checked object is not as it must be.
const NOT_AS_IT_SHOULD_BE: u8 = 1;
/// Exit code for invalid arguments, recipe or data.
const BAD_INPUT: u8 = 2;
/// Exit code for a fault of the machine or of the program.
pub(super) const FAULT: u8 = 3;

/// Reason why a command ended without a result.
#[derive(Debug, Error)]
pub(super) enum Failure {
    #[error(transparent)]
    File(#[from] FormatError),
    #[error("{path}: {source}")]
    Definition { path: PathBuf, source: DefinitionError },
    #[error(transparent)]
    Program(regrind::formats::gcode::GcodeError),
    #[error(transparent)]
    Programs(regrind::drive::ProgramError),
    #[error("{recipe} in the cell of {cell}: {source}")]
    FirstPath { recipe: PathBuf, cell: PathBuf, source: regrind::compensation::path::PathError },
    #[error("{path}: {source}")]
    Path { path: PathBuf, source: regrind::compensation::path::PathError },
    #[error("{path}: {source}")]
    Nominal { path: PathBuf, source: SurfaceError },
    #[error("{path}: {source}")]
    Measured { path: PathBuf, source: RegistrationError },
    #[error("{measured} against {nominal}: {source}{hint}")]
    Registration { measured: PathBuf, nominal: PathBuf, source: RegistrationError, hint: &'static str },
    #[error("--probe-radius: {source}")]
    ProbeRadius { source: RegistrationError },
    #[error("--probe-radius is missing; give the radius of the probe in millimetres, or --method contact")]
    NoProbeRadius,
    #[error("{path}: a map holds points of the surface and no centres of a probe; give --method contact")]
    MapOfContacts { path: PathBuf },
    #[error("{path}: --projection is for points, and this is {what}; leave it out")]
    Projection { path: PathBuf, what: &'static str },
    #[error(
        "{path}: no pose: {reason}; give 16 numbers, row by row, as text or JSON, or the registration.json of an earlier run"
    )]
    Initial { path: PathBuf, reason: String },
    #[error("{bad} of {files} files {} problems; they are listed above", if *bad == 1 { "has" } else { "have" })]
    Checked { bad: usize, files: usize },
    #[error(transparent)]
    Setup(SetupError),
    #[error("what {run} learned cannot be begun with: {source}; or write learn = false")]
    TooMuchLearned { run: String, source: NextPassError },
    #[error("{path}: {reason}")]
    Simulation { path: PathBuf, reason: String },
    /// The record was read and is not trustworthy.
    #[error(transparent)]
    Broken(JournalError),
    #[error("{}: {flaws} flaw(s) among the runs, the first: {first}", .runs.display())]
    RunsLack { runs: PathBuf, flaws: usize, first: String },
    #[error(
        "{}: the cell file asks for a record that is signed (cell.require_signature), and this user has no key; `regrind audit key` makes one",
        .cell.display()
    )]
    Unsigned { cell: PathBuf },
    #[error("{}: the record is not whole: {lacks}", .run.display())]
    NotWhole { run: PathBuf, lacks: &'static str },
    #[error("{path}: {reason}; give a copy of the journal.anchor of this run")]
    Anchor { path: PathBuf, reason: String },
    #[error(
        "there is no place for a key: REGRIND_KEY is empty, or neither it nor HOME is set; name the file with --key"
    )]
    NoPlaceForKey,
    #[error(transparent)]
    Report(ReportError),
    #[error("--state {name}: no state begins so; give one of {known}")]
    NoState { name: String, known: String },
    #[error(transparent)]
    Journal(JournalError),
    #[error(transparent)]
    Machine(JournalError),
    #[error("{path}: no control socket can be made there: {source}; give --runs a local folder with a shorter name")]
    ControlSocket { path: PathBuf, source: io::Error },
    #[error("{path}: no run was made there; name the folder of a run")]
    NoRun { path: PathBuf },
    #[error("{path}: no cell runs there ({source}); `regrind audit show` tells how the run ended")]
    NotRunning { path: PathBuf, source: io::Error },
    #[error(
        "{path}: whether a cell runs there is not known: this user may not ask it ({source}); ask as the user who runs the cell"
    )]
    MayNotAsk { path: PathBuf, source: io::Error },
    #[error(
        "{path}: the program of the cell is there and does not answer; what was asked is not carried out once it does. Its process stands \
         still (SIGSTOP, a debugger) or the computer is overloaded. A machine that hears nothing of it holds by itself: look at both machines"
    )]
    NoAnswer { path: PathBuf },
    #[error("{} runs go on: name one of {}", .runs.len(), .runs.iter().map(|run| run.display().to_string()).collect::<Vec<_>>().join(", "))]
    SeveralRuns { runs: Vec<PathBuf> },
    #[error("{}: the run is over, there is nothing to go on with; `regrind report` tells how it ended", .run.display())]
    Over { run: PathBuf },
    #[error(
        "{path}: the disk has {} MB left, and the first cycle may take {} MB; make room, or name another folder by --runs",
        .free >> 20, .needed.div_ceil(1 << 20)
    )]
    NoSpace { path: PathBuf, free: u64, needed: u64 },
    #[error(
        "the page cannot be shown at {address}: {source}; choose another port with --listen, or 0 for any that is free"
    )]
    Page { address: SocketAddr, source: io::Error },
    #[error(
        "{address} is open to other computers; give the page a certificate (--certificate FILE --key FILE) and users (--users FILE), or \
         show it at 127.0.0.1 and reach it from elsewhere through a tunnel: ssh -L 7373:127.0.0.1:7373 CELL"
    )]
    ForOthers { address: SocketAddr },
    #[error(transparent)]
    Tls(#[from] regrind_page::TlsError),
    #[error(transparent)]
    Users(#[from] regrind_page::UsersError),
    #[cfg(feature = "plant")]
    #[error("{why}")]
    OpenWork { why: String },
    #[cfg(feature = "plant")]
    #[error("{}: it cannot be read: {source}; check that it is there, and yours to read", .path.display())]
    Unreadable { path: PathBuf, source: io::Error },
    #[cfg(feature = "plant")]
    #[error(transparent)]
    Plant(Box<PlantError>),
    #[cfg(feature = "plant")]
    #[error(transparent)]
    Live(#[from] regrind_live::LiveError),
    #[error("{}: there is no user {name:?}; `regrind users list` tells who is there", .path.display())]
    NoUser { name: String, path: PathBuf },
    #[error("the two passwords are not alike; nothing was changed")]
    NotAlike,
    #[error(
        "{}: the end of its record may be lost: {what}. A machine may be at a job that the record does not know, so the run is not gone on with: look at \
         both machines, bring them home by `regrind recover` and begin a new run; or go on by `regrind resume --despite-loss`",
        .run.display()
    )]
    MayBeLost { run: PathBuf, what: String },
    #[error("{}: its program ended before anything was asked of a machine; begin a new run", .run.display())]
    NotBegun { run: PathBuf },
    #[error(
        "{}: a rehearsal is played at machines that people serve, and a wire reaches one of this cell; write `simulated = true` into the cell file and \
         simulate it, or leave --rehearsal out",
        .cell.display()
    )]
    NoRehearsal { cell: PathBuf },
    #[error("{}: its simulated machines ended with the program that ran it; begin a new run", .run.display())]
    WorldGone { run: PathBuf },
    #[error(
        "{}: it was begun by regrind {program}, and this program cannot go on with it ({what}); go on with that one, or bring the machines home \
         by `regrind recover` and begin a new run",
        .run.display()
    )]
    EarlierRun { run: PathBuf, program: String, what: String },
    #[error("{}: {what} is not what the run began with; put back the files that the recipe and the cell file name", .run.display())]
    OtherTask { run: PathBuf, what: &'static str },
    #[error("the port of the {device} cannot be had: {source}")]
    Port { device: regrind::cell::Device, source: io::Error },
    #[error("{device}: {source}")]
    Recover { device: regrind::cell::Device, source: regrind::drive::recover::RecoverError },
    #[error("not both machines are known to be idle; begin again, or see to the one that tells nothing over a wire")]
    NotHome,
    #[error(transparent)]
    Learned(regrind::formats::LearnedError),
    #[error(transparent)]
    Replay(regrind::drive::ReplayError),
    #[error("the order is not acknowledged: {message}")]
    OrderRefused { message: String },
    #[error("`confirm over` needs --machine and --evidence: which machine was looked at, and what was seen")]
    Evidence,
    #[error("--map is too short: the first 8 digits, or more, of the map at the grinder, as in correction.json")]
    ShortMap,
    #[error("`confirm clear` needs --machine: which machine was looked at")]
    NoMachine,
    #[error("{path} is there already; choose another folder, or move it away")]
    IsThere { path: PathBuf },
    #[error("no model of the error: {0}")]
    NoModel(regrind::model::ModelError),
    #[error("no folder to make is named; give it as in: regrind init mirrors --machines modbus-tcp")]
    NoFolder,
    #[error("{path}: {source}; --runs names the folder of the runs")]
    NoRuns { path: PathBuf, source: std::io::Error },
    #[error("{path} cannot be found: {source}; name the file of the measurement")]
    NoFile { path: PathBuf, source: std::io::Error },
    #[error("the run did not come to its end: {reason}")]
    Ended { reason: String },
    #[error("the result cannot be told: {what} is not a finite number; please report it with the files that led to it")]
    NotFinite { what: &'static str },
    /// The input was valid and the place was writable before, but writing failed.
    #[error("the result could not be saved: {0}")]
    NotSaved(FormatError),
    #[error("signals of the operating system cannot be heard: {0}")]
    Signals(io::Error),
    #[error("the terminal cannot be written to: {0}")]
    Terminal(io::Error),
}

#[cfg(feature = "plant")]
impl From<PlantError> for Failure {
    fn from(error: PlantError) -> Self {
        // Boxed because it is large and rare.
        Self::Plant(Box::new(error))
    }
}

impl Failure {
    /// Returns the failure for a cell that cannot be reached. If this user has no permission, it is unknown whether a
    /// cell runs there.
    pub(super) fn unreached(folder: &std::path::Path, source: io::Error) -> Self {
        let path = folder.to_owned();
        match source.kind() {
            io::ErrorKind::PermissionDenied => Self::MayNotAsk { path, source },
            io::ErrorKind::TimedOut => Self::NoAnswer { path },
            _ => Self::NotRunning { path, source },
        }
    }

    /// Returns the exit code of the program.
    pub(super) fn exit_code(&self) -> u8 {
        match self {
            Self::NotFinite { .. }
            | Self::NotSaved(_)
            | Self::Machine(_)
            | Self::Port { .. }
            | Self::Recover { .. }
            | Self::NotHome
            | Self::Signals(_)
            | Self::Terminal(_)
            | Self::OrderRefused { .. }
            | Self::NoAnswer { .. }
            | Self::Setup(SetupError::Machine {
                source: DriverError::Line { .. } | DriverError::NoPort { .. }, ..
            })
            | Self::Ended { .. } => FAULT,
            Self::Broken(_)
            | Self::NotWhole { .. }
            | Self::RunsLack { .. }
            | Self::MayBeLost { .. }
            | Self::Report(ReportError::Record(JournalError::Broken { .. })) => NOT_AS_IT_SHOULD_BE,
            #[cfg(feature = "plant")]
            Self::OpenWork { .. } => NOT_AS_IT_SHOULD_BE,
            #[cfg(feature = "plant")]
            Self::Plant(error) if error.may_pass() => FAULT,
            #[cfg(feature = "plant")]
            Self::Plant(error)
                if matches!(
                    **error,
                    PlantError::Differs { .. }
                        | PlantError::Journal(JournalError::Broken { .. } | JournalError::NoAuthor { .. })
                ) =>
            {
                NOT_AS_IT_SHOULD_BE
            }
            _ => BAD_INPUT,
        }
    }

    /// Returns the failure of a registration with the name of the file or argument that caused it.
    pub(super) fn of_registration(source: RegistrationError, nominal: &Path, measured: &Path) -> Self {
        use RegistrationError::*;
        let hint = match source {
            DoesNotFit { .. } => " (--max-rms)",
            NotConverged { .. } => " (--initial), or hold the directions that the part does not tell (--lock)",
            TooFewUsed { .. } => " (--initial)",
            WrongSide { .. } => " (--side)",
            Undetermined => " (--lock)",
            Size { remedy, .. } if !remedy.contains("millimetres") => " (both files must be in millimetres)",
            _ => "",
        };
        let (nominal, measured) = (nominal.to_owned(), measured.to_owned());
        match source {
            Surface(source) => Self::Nominal { path: nominal, source },
            ProbeRadius { .. } => Self::ProbeRadius { source },
            TooFewPoints { .. } | NotFinite { .. } | Collinear { .. } | Repeated { .. } => {
                Self::Measured { path: measured, source }
            }
            _ => Self::Registration { measured, nominal, source, hint },
        }
    }
}
