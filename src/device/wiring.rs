//! What a driver owns of a cell file: its table `wire`, how that is checked, and how machines are made of it.

use std::path::{Path, PathBuf};
use std::time::Duration;

use thiserror::Error;

use super::hit_lines::HitLine;
use super::machine::{Cmm, Grinder};
use super::modbus::{Line, Link, RegisterMap, Signal};
use super::place::Place;
use super::words::MachineKind;
use regrind_document::Document;
use regrind_formats::FormatError;
use regrind_formats::result::Coordinates;

/// How long to wait for what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timing {
    /// For the answer to one request.
    pub request_timeout: Duration,
    /// How often a request is repeated after the first time.
    pub retries: u8,
    /// Between two looks at the status.
    pub poll: Duration,
    /// Between two beats.
    pub heartbeat: Duration,
    /// Without an answer, after which the machine is lost.
    pub lost_after: Duration,
    /// Of silence after a broken answer, so that late bytes die out.
    pub quarantine: Duration,
}

/// What a machine is made of besides its wire.
#[derive(Clone, Copy, Debug)]
pub struct Making<'a> {
    /// The part, as files and prompts call it.
    pub part: &'a str,
    /// The folder of the cell file, to which its paths are relative.
    pub cell_folder: &'a Path,
    /// The folder of the run.
    pub run_folder: &'a Path,
    /// Whether the machines of the cell are simulations.
    pub simulated: bool,
    /// The number of this client, for machines that more than one can reach.
    pub owner: u32,
    /// Rises with each start of this client.
    pub epoch: u32,
    /// Where any number of points will do, and not one for each target of a plan: the least of them.
    pub free_points: Option<usize>,
    /// The share of a plan's targets of which a measurement must have a point.
    pub least_found: f64,
    /// Whether people only play the machines: the plan itself may come back as what was measured.
    pub rehearsal: bool,
    /// How long to wait for what.
    pub timing: &'a Timing,
    /// Where the blocks of its Modbus map stand.
    pub registers: &'a RegisterMap,
    /// Further values that are read and recorded.
    pub signals: &'a [Signal],
    /// The name that it must give of itself.
    pub expected_name: Option<&'a str>,
    /// The box that a probe's centre must not leave, its least and its largest corner.
    pub volume_mm: Option<[[f64; 3]; 2]>,
    /// The line of the other machine, which may be its own too.
    pub beside: Option<&'a Link>,
}

/// The table `wire` of a cell file, and the driver that goes with it.
pub trait Wired {
    /// The measuring machine at the end of such a wire.
    type Cmm: Cmm + std::fmt::Debug;
    /// The grinder at the end of such a wire.
    type Grinder: Grinder + std::fmt::Debug;

    /// Whether a person serves the machine: then it takes as long as people take, and nothing simulates it.
    const BY_PERSON: bool = false;
    /// Whether its results may state their temperature.
    const TELLS_TEMPERATURE: bool = true;
    /// Whether the tables `registers` and `signals` say something of it.
    const HAS_REGISTERS: bool = false;
    /// Whether the grinder works by the program and the map that lie in the folder of the run, the first of a run too.
    const WORKS_FROM_RUN: bool = false;

    /// Tells what is wrong with the table beyond what the schema holds it to.
    fn check(&self, _place: &Place<'_>, _document: &mut Document) {}

    /// Tells what is wrong with this wire, the CMM's, beside that of the grinder.
    fn check_beside(&self, _grinder: &Self, _document: &mut Document) {}

    /// What a person should know of it on this computer, which makes the cell file no worse.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }

    /// What the coordinates of a measurement are; none where each result says so itself.
    fn coordinates(&self) -> Option<Coordinates> {
        Some(Coordinates::Centres)
    }

    /// Makes the driver of a measuring machine; nothing is asked of the machine yet.
    ///
    /// # Errors
    /// A wire that cannot be opened, a folder that is not there, a file that cannot be read.
    fn cmm(&self, making: &Making<'_>) -> Result<Self::Cmm, MakingError>;

    /// Makes the driver of a grinder; nothing is asked of the machine yet.
    ///
    /// # Errors
    /// Those of [`Wired::cmm`].
    fn grinder(&self, making: &Making<'_>) -> Result<Self::Grinder, MakingError>;

    /// The line that another machine may share.
    fn link(_cmm: &Self::Cmm) -> Option<&Link> {
        None
    }

    /// Host and port of a server of I++ DME, where it is one.
    fn dme(&self) -> Option<(String, u16)> {
        None
    }

    /// Where lines of hits are heard, where it is such a wire.
    fn hit_line(&self) -> Option<HitLine> {
        None
    }

    /// Host and port of linuxcncrsh, where it is one.
    fn rsh(&self) -> Option<(String, u16)> {
        None
    }

    /// The Modbus line and the unit on it, where it is one: what a simulated machine is served on.
    fn line(&self) -> Option<(Line, u8)> {
        None
    }
}

/// Why a machine cannot be made of what a cell file says.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "the message of each tells what its fields are")]
#[non_exhaustive]
pub enum MakingError {
    /// A folder that must be there.
    #[error(
        "{key}: the folder {path} is not there; make it where the {machine} finds it (mkdir -p {path}), or correct the cell file"
    )]
    Folder { key: String, path: PathBuf, machine: MachineKind },
    /// A file of reference points that is not good.
    #[error("cmm.wire.reference_points: {source}")]
    References { source: Box<FormatError> },
    /// A serial port that is not there.
    #[error("{missing}; connect it, or name one of these in the cell file")]
    NoPort { missing: String },
    /// A machine whose positions are to be held against its volume, and nobody says what that is.
    #[error(
        "cmm.travel is missing: every position is held against it before {machine} moves; add the box that its probe must not leave"
    )]
    NoVolume { machine: String },
    /// A machine that this wire has no driver for.
    #[error("{table}.wire: kind = {kind:?} is for the other machine of a cell; name another wire")]
    NoDriver { table: &'static str, kind: &'static str },
    /// A line that cannot be opened.
    #[error("{line} cannot be opened: {source}; check the cell file and the machine")]
    Line { line: String, source: std::io::Error },
}
