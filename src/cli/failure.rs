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
use thiserror::Error;

use super::outcome::{BAD_INPUT, FAULT, NOT_AS_IT_SHOULD_BE};
use super::plant::PlantFailure;

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
    #[error("{recipe} with the cell file {cell}: {source}")]
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
    #[error("--probe-radius is missing; give the radius of the probe in mm, or --method contact")]
    NoProbeRadius,
    #[error("{path}: a map has points of the surface, not centres of a probe; give --method contact")]
    MapOfContacts { path: PathBuf },
    #[error("there are {maps} --measured and {places} --place; give one pose for each map, in the same order, or none")]
    Places { maps: usize, places: usize },
    #[error("{path}: {source}")]
    Stitching { path: PathBuf, source: regrind::stitching::StitchingError },
    #[error("{path}: --projection applies only to points, but this file is {what}; remove --projection")]
    Projection { path: PathBuf, what: &'static str },
    #[error(
        "{path}: this file has no pose: {reason}; give the 16 numbers of a 4 x 4 matrix, row by row, as text or JSON, \
         or the registration.json of an earlier run"
    )]
    Initial { path: PathBuf, reason: String },
    #[error("{bad} of {files} files {} problems; the problems are listed above", if *bad == 1 { "has" } else { "have" })]
    Checked { bad: usize, files: usize },
    #[error(transparent)]
    Setup(SetupError),
    #[error(
        "the run cannot start with the correction of the error that run {run} learned: {source}. Another remedy: write learn = false in the recipe, to start without this correction"
    )]
    TooMuchLearned { run: String, source: NextPassError },
    #[error("{path}: {reason}")]
    Simulation { path: PathBuf, reason: String },
    /// The record was read. It was changed, or its author is not proven.
    #[error(transparent)]
    Broken(JournalError),
    #[error("{}: the check of the runs in this folder found {flaws} flaw(s); the first flaw: {first}", .runs.display())]
    RunsLack { runs: PathBuf, flaws: usize, first: String },
    #[error(
        "{}: the cell file requires a signed record (cell.require_signature), and this user has no key; make one \
         with `regrind audit key`",
        .cell.display()
    )]
    Unsigned { cell: PathBuf },
    #[error("{}: the record is incomplete: {lacks}", .run.display())]
    NotWhole { run: PathBuf, lacks: &'static str },
    #[error("{path}: {reason}; give a copy of the journal.anchor of this run")]
    Anchor { path: PathBuf, reason: String },
    #[error(
        "the file of the key is unknown: REGRIND_KEY is empty, or neither REGRIND_KEY nor HOME is set; name the file \
         with --key"
    )]
    NoPlaceForKey,
    #[error(transparent)]
    Report(ReportError),
    #[error("--state {name}: no state has a name that begins with this text; give one of {known}")]
    NoState { name: String, known: String },
    #[error(transparent)]
    Journal(JournalError),
    #[error(transparent)]
    Machine(JournalError),
    #[error("{path}: no control socket can be created there: {source}; {}", socket_remedy(.source))]
    ControlSocket { path: PathBuf, source: io::Error },
    #[error("{path}: this path contains no run; name the folder of a run")]
    NoRun { path: PathBuf },
    #[error("{}: there is no such folder of recipes; create it, or name another one with --recipes", .path.display())]
    NoRecipesFolder { path: PathBuf },
    #[error(
        "{}: this folder does not exist; give the folder of the runs, or create it: mkdir {0}", .path.display()
    )]
    NoRunsFolder { path: PathBuf },
    #[error("{}: this is neither a recipe nor a cell file nor a dialect: it has no table of one; for a file of points: regrind accuracy, or regrind register", .path.display())]
    NotToCheck { path: PathBuf },
    #[error("{}: this is a recipe, and `regrind doctor` checks a cell; write: regrind doctor --recipe {0}", .path.display())]
    RecipeForCell { path: PathBuf },
    #[error("{}: this header of a report cannot be used: {reason}; `regrind report --help` shows its keys", .path.display())]
    ShopHeader { path: PathBuf, reason: String },
    #[error("{}: there is no such folder; give the folder of a run; `regrind runs` lists them", .path.display())]
    NoSuchFolder { path: PathBuf },
    #[error("{path}: this run is not active ({source}); to see how the run ended: `regrind audit show`")]
    NotRunning { path: PathBuf, source: io::Error },
    #[error(
        "{path}: it is unknown whether this run is active, because this user has no permission to connect to the run \
         ({source}). Give the command as the user who started the run"
    )]
    MayNotAsk { path: PathBuf, source: io::Error },
    #[error(
        "{path}: the program that runs the cell did not answer in time. The program will not execute this request, \
         also if the program continues later. The program is stopped (SIGSTOP, a debugger), or the computer is \
         overloaded. A machine that receives nothing from the program holds by itself: check both machines"
    )]
    NoAnswer { path: PathBuf },
    #[error("{} runs are active: name one of {}", .runs.len(), .runs.iter().map(|run| run.display().to_string()).collect::<Vec<_>>().join(", "))]
    SeveralRuns { runs: Vec<PathBuf> },
    #[error("{}: the run is over and cannot continue; to see how it ended: `regrind report`", .run.display())]
    Over { run: PathBuf },
    #[error(
        "{path}: the disk has {} MB free, but the first cycle can require {} MB; delete or move files, or name a \
         folder on another disk with --runs",
        .free >> 20, .needed.div_ceil(1 << 20)
    )]
    NoSpace { path: PathBuf, free: u64, needed: u64 },
    #[error(
        "the page cannot be shown at {address}: {source}; choose another port with --listen, or 0 for any free port"
    )]
    Page { address: SocketAddr, source: io::Error },
    #[error(
        "{address} is open to other computers; give the page a certificate (--certificate FILE --key FILE) and users \
         (--users FILE). Or show the page at 127.0.0.1, and connect from another computer through a tunnel: \
         ssh -L 7373:127.0.0.1:7373 CELL (CELL is the name of this computer)"
    )]
    ForOthers { address: SocketAddr },
    #[error(transparent)]
    Tls(#[from] regrind_page::TlsError),
    #[error(transparent)]
    Users(#[from] regrind_page::UsersError),
    #[error(transparent)]
    Plant(#[from] PlantFailure),
    #[error("{}: there is no user {name:?}; to see all users: `regrind users list`", .path.display())]
    NoUser { name: String, path: PathBuf },
    #[error("the two passwords differ; nothing was changed")]
    NotAlike,
    #[error(
        "{}: the last records of this run may be lost: {what}. A machine may have a job that is not in the record, so \
         the run is not resumed. Check both machines. Then bring the machines to idle with `regrind recover` and \
         begin a new run, or continue this run with `regrind resume --despite-loss`",
        .run.display()
    )]
    MayBeLost { run: PathBuf, what: String },
    #[error("{}: the program of this run ended before its first request to a machine, so there is nothing to resume; begin a new run", .run.display())]
    NotBegun { run: PathBuf },
    #[error(
        "{}: a rehearsal requires machines that people operate, but this cell has a machine with a data connection; \
         remove --rehearsal, or write `simulated = true` into the cell file and simulate the machine",
        .cell.display()
    )]
    NoRehearsal { cell: PathBuf },
    #[error("{}: a draft of a recipe runs on simulated machines only, and this cell has others; use the built-in cell `sim`", .cell.display())]
    DraftNeedsSimulation { cell: PathBuf },
    #[error("{}: the simulated machines ended with the program of this run, so the run cannot be resumed; begin a new run", .run.display())]
    WorldGone { run: PathBuf },
    #[error(
        "{}: the run was started by Regrind {program}, and this version cannot resume the run ({what}). Resume the run with the earlier version. Or \
         bring the machines to idle with `regrind recover`, and begin a new run",
        .run.display()
    )]
    EarlierRun { run: PathBuf, program: String, what: String },
    #[error(
        "{}: {what} changed since the run began; restore the files that the recipe and the cell file name",
        .run.display()
    )]
    OtherTask { run: PathBuf, what: &'static str },
    #[error(
        "the connection to the {device} cannot be opened: {source}; check the cable, and the address in the cell file"
    )]
    Port { device: regrind::cell::Device, source: io::Error },
    #[error("{device}: {source}")]
    Recover { device: regrind::cell::Device, source: regrind::drive::recovery::RecoveryError },
    #[error(
        "it is unknown whether both machines are idle; run `regrind recover` again; if a machine has no data connection, inspect the machine yourself"
    )]
    NotHome,
    #[error(transparent)]
    Learned(regrind::formats::LearnedError),
    #[error(transparent)]
    Replay(regrind::drive::ReplayError),
    #[error("the cell did not accept the order: {message}")]
    OrderRefused { message: String },
    #[error(
        "the command `confirm over` requires two options: --machine with the machine that you checked, and --evidence with your finding"
    )]
    Evidence,
    #[error(
        "--map is too short: give at least the first 8 digits of the hash of the map that the grinder uses; the hash is in correction.csv"
    )]
    ShortMap,
    #[error("the command `confirm clear` requires the option --machine with the machine that you checked")]
    NoMachine,
    #[error("the command `confirm seen` requires the option --alarm with the name of the alarm that you saw")]
    NoAlarm,
    #[error("{path} already exists; choose another folder, or move the existing one away")]
    IsThere { path: PathBuf },
    #[error("the model of the error cannot be computed: {0}")]
    NoModel(regrind::model::ModelError),
    #[error(
        "the name of the new folder is missing; give a name, for example: regrind init mirrors --machines modbus-tcp"
    )]
    NoFolder,
    #[error("{path}: {source}; give the folder of the runs with --runs")]
    NoRuns { path: PathBuf, source: std::io::Error },
    #[error("{path} cannot be found: {source}; name the file of the measurement")]
    NoFile { path: PathBuf, source: std::io::Error },
    #[error("the run did not finish: {reason}")]
    Ended { reason: String },
    #[error(
        "the result cannot be given: {what} is not a finite number; please report this fault with the input files of the command"
    )]
    NotFinite { what: &'static str },
    /// The input was valid and the output folder was writable at the start, but writing the result failed.
    #[error("the result could not be saved: {0}")]
    NotSaved(FormatError),
    #[error("signals of the operating system cannot be received: {0}")]
    Signals(io::Error),
    #[error("the terminal cannot be used: {0}")]
    Terminal(io::Error),
}

impl Failure {
    /// Returns the failure to report if the cell of the run in `folder` did not answer a request. `source` is the error
    /// of the connection, and its kind selects the failure:
    ///
    /// - Permission denied: it is unknown whether a cell runs in `folder`.
    /// - Timeout: a cell listens, but does not answer.
    /// - Other errors: no cell runs in `folder`.
    pub(super) fn unreached(folder: &std::path::Path, source: io::Error) -> Self {
        let path = folder.to_owned();
        match source.kind() {
            io::ErrorKind::PermissionDenied => Self::MayNotAsk { path, source },
            io::ErrorKind::TimedOut => Self::NoAnswer { path },
            _ => Self::NotRunning { path, source },
        }
    }

    /// Returns the exit code of the program for this failure:
    ///
    /// - 1: a check has failed, for example because a record is broken or incomplete, or a copy differs from its
    ///   record, or work is unfinished.
    /// - 2: an argument, a recipe or data are invalid.
    /// - 3: a machine or the program has a fault.
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
            Self::Plant(failure) => failure.exit_code(),
            _ => BAD_INPUT,
        }
    }

    /// Converts the error of a registration into a failure that names its cause: the nominal file, the measured file,
    /// or the command-line option to change. `nominal` and `measured` are the paths of the two files.
    pub(super) fn of_registration(source: RegistrationError, nominal: &Path, measured: &Path) -> Self {
        use RegistrationError::*;
        let hint = match source {
            DoesNotFit { .. } => " (--max-rms)",
            NotConverged { .. } => " (--initial), or lock the directions that the part does not determine (--lock)",
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

/// Returns the remedy for a control socket that could not be created.
fn socket_remedy(source: &io::Error) -> &'static str {
    match source.kind() {
        // The path has more bytes than the address of a socket can hold.
        io::ErrorKind::InvalidInput => "give --runs a folder with a shorter name",
        io::ErrorKind::ReadOnlyFilesystem | io::ErrorKind::StorageFull => {
            "check this disk, or give --runs a folder on another disk"
        }
        _ => "give --runs a folder on a local disk in which this user may create a socket",
    }
}
