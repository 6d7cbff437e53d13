//! What happened: orders of people, facts from machines, results of computations. Everything the cell ever learns comes
//! as one of these, so that a run can be replayed from its journal.

use serde::{Deserialize, Serialize};
use std::fmt;

use super::figure::Interval;
use super::state::Device;

/// A person, and where the order was given.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Actor {
    /// The name of the person, or of the program that acts for one.
    pub name: String,
    /// The terminal or the computer.
    pub station: String,
}

/// A fact, an order or a result.
///
/// `device` is the machine that it comes from or is about, and `boot_id` the number of this start of its application. `cycle` travels with
/// everything that belongs to one: what belongs to another cycle is refused. `actor` gave the order, looked, or started the program, and
/// says `reason`, which may be empty, and `evidence`. What was seen stands in words, with the value and the limit, in `why` and `message`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the fields are told above")]
#[serde(tag = "event", rename_all = "snake_case")]
#[expect(clippy::large_enum_variant, reason = "events are few, and never kept in numbers")]
pub enum Event {
    // Orders of people.
    /// Begin the run.
    Start { actor: Actor },
    /// The right part is loaded and clamped, and no machine touches it.
    LoadConfirmed { actor: Actor },
    /// Come to the next safe place and wait for a person.
    Hold { actor: Actor, reason: String },
    /// Go on from where the cell was held.
    Resume { actor: Actor, reason: String },
    /// End in order.
    Stop { actor: Actor, reason: String },
    /// End at once: the safe sequence only.
    Abort { actor: Actor, reason: String },
    /// A person has looked at a machine that cannot tell it: it is clear of the part.
    ClearConfirmed { actor: Actor, device: Device },
    /// A person has looked at a machine that cannot tell what became of its START: the job is over, the machine stands still and
    /// is clear of the part. The START is never repeated; the part is measured as it is.
    DeclaredOver { actor: Actor, device: Device, evidence: String },
    /// The program was started again in the middle of this run; the links are new.
    Restarted { actor: Actor },

    // Facts from machines.
    /// The machine is the right one, its signature is sound and it is owned. Answers `Connect` and `ClearMachine`.
    Connected { device: Device, boot_id: u32, simulated: bool, found: Occupation },
    /// The machine cannot be used. Answers `Connect`.
    NotConnected { device: Device, why: Mismatch },
    /// The machine cannot be reached, or its application stands still.
    LinkLost { device: Device, why: String },
    /// The link is open again, its signature and its sync are proven.
    LinkBack { device: Device, boot_id: u32 },
    /// What attends to the machine in this program has failed: nothing speaks to the machine any more, whose own silence limit holds it.
    StationFailed { device: Device, why: String },
    /// Something that the cell needs from outside is missing. Reported as a level: again after every reconnection.
    ConditionLost {
        device: Device,
        condition: Condition,
        #[serde(rename = "words")]
        message: String,
    },
    /// It is there again; hysteresis is the business of who reports.
    ConditionBack { device: Device, condition: Condition },
    /// The machine is not in automatic mode: a person may move it at its panel. Reported as a level, as a missing condition is.
    NotAutomatic {
        device: Device,
        #[serde(rename = "words")]
        message: String,
    },
    /// It is in automatic mode again.
    AutomaticAgain { device: Device },
    /// The grinder holds the pass and the map of this cycle, read back and compared. Answers `LoadPass`.
    PassLoaded { cycle: u32 },
    /// The CMM holds the plan of this cycle, read back and compared. Answers `LoadPlan`.
    PlanLoaded { cycle: u32 },
    /// The machine is prepared for this cycle. Answers `Prepare`.
    Prepared { device: Device, cycle: u32 },
    /// The machine was seen at this run's job, and shows now that it is at none, or at another one, and tells of no end.
    JobVanished { device: Device, why: String },
    /// START was taken. Answers `StartMachine`.
    Started { device: Device, cycle: u32 },
    /// It is not known whether START was taken. Answers `StartMachine`.
    StartUnknown { device: Device, cycle: u32, why: String },
    /// The job goes on: so many points measured, or thousandths of the path, of so many. Comes too from a machine that moves without one.
    Progressed { device: Device, done: u32, total: u32 },
    /// The machine stands in its safe place. Answers `HoldMachine`, also where it was held already, or comes by itself.
    MachineHeld { device: Device },
    /// The machine moves again. Answers `ResumeMachine`, or comes by itself.
    MachineResumed { device: Device },
    /// The job is over; for the grinder its pass record has been read. Answers `StopMachine` too, also where nothing ran.
    Ended { device: Device, cycle: u32, result: JobResult },
    /// What the grinder says of the pass that is over cannot be, or is of another pass. Comes before `Ended` or `Reconciled`.
    RecordDoubted { cycle: u32, why: String },
    /// A fresh status shows the machine standing clear of the part. Answers `VerifyClear`.
    Cleared { device: Device },
    /// A fresh status shows that it is not. Answers `VerifyClear`, or comes by itself.
    Obstructed {
        device: Device,
        #[serde(rename = "words")]
        message: String,
    },
    /// The machine stands, and nothing tells whether it is clear of the part. Answers `VerifyClear`.
    ClearUnknown { device: Device },
    /// The machine was asked and said no.
    Refused { device: Device, what: Asked, why: String },
    /// The machine is in FAULTED. (A machine that held itself because the link was silent is `MachineHeld`.)
    Fault {
        device: Device,
        code: u16,
        #[serde(rename = "words")]
        message: String,
    },
    /// The machine has forgotten its result and is idle. Answers `Acknowledge`.
    Acknowledged { device: Device },
    /// The machine has ended its own safe sequence and stands. Answers `AbortMachine`.
    AbortConfirmed { device: Device },
    /// What became of the job. Answers `Reconcile`.
    Reconciled { device: Device, cycle: u32, outcome: Reconciliation },

    // Results of computations.
    /// The points of this cycle, so many found of the planned, are read and stored. Answers `Collect`.
    Collected { cycle: u32, targets: u32, found: u32, gate: Gate },
    /// The radius of the probe was compared with the reference sphere: the one found minus the one in the recipe. Answers `Qualify`.
    Qualified {
        cycle: u32,
        #[serde(with = "super::number")]
        radius_error_mm: f64,
    },
    /// The measurement is registered. Answers `Register`.
    Registered { cycle: u32, figures: Figures },
    /// It could not be registered. Answers `Register`.
    RegistrationFailed { cycle: u32, why: String },
    /// The next map is computed and stored. Answers `Compensate`.
    Compensated { cycle: u32, summary: CompensationSummary },
    /// There is no next map. Answers `Compensate`.
    CompensationRefused { cycle: u32, why: CompensationRefusal },

    /// What was computed from a measurement cannot be written: nothing is made of it before it can. Answers `Collect`, `Register` and
    /// `Compensate`.
    NotSaved { cycle: u32, why: RecordFailure },

    /// The journal or the run folder cannot be written: nothing may begin to move.
    RecordFailed { why: RecordFailure },
    /// A command that is answered was not given, for it did not come on record.
    NotOnRecord { command: String },
    /// The way by which orders come in is gone: who gives them may not find the cell.
    ControlLost { why: String },
    /// It was made again.
    ControlBack,
    /// Time has passed; what is due is done.
    Deadline,
}

/// What a machine was found doing when it was connected.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Occupation {
    /// Idle, as it should be.
    Idle,
    /// Aborted or faulted in an earlier run; it can be cleared.
    ToClear,
    /// Busy with something that is not this run's, in words.
    Busy(String),
}

/// Why a machine cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mismatch {
    /// Nothing answers there.
    Unreachable(String),
    /// Something answers, but it is not this machine.
    WrongDevice(String),
    /// Its sentinels are scrambled: the order of words is not the one in the cell file.
    WordOrder(String),
    /// Its unit of length is the inch.
    Inches,
    /// Another client owns it.
    Owned(String),
    /// It is at the job of another run, which is left alone, also by an abort.
    AtAnotherJob(String),
}

/// Something that the cell needs from outside.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Condition {
    /// Air, coolant.
    Supplies,
    /// Every signal that the cell file asks for, a temperature for one, is within its range.
    #[serde(alias = "temperature")]
    Signals,
}

/// What a machine was asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Asked {
    /// To take a payload.
    Load,
    /// To prepare.
    Prepare,
    /// To start. It says no for certain: nothing moves.
    Start,
    /// To hold.
    Hold,
    /// To resume.
    Resume,
    /// To stop.
    Stop,
    /// To abort.
    Abort,
    /// To be cleared.
    Clear,
    /// To give its result.
    Collect,
    /// To forget its result.
    Acknowledge,
    /// To forget the result of a job at which it still is.
    Discard,
}

/// How a job of a machine ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobResult {
    /// It was carried out.
    Complete,
    /// It was stopped in order.
    Stopped,
    /// It was aborted.
    Aborted,
    /// It failed.
    Failed,
}

/// What became of a job whose machine was out of sight.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reconciliation {
    /// It was taken and runs.
    Running,
    /// It was taken, and the machine holds.
    Held,
    /// It was taken and is over.
    Ended(JobResult),
    /// It was proven not to have been taken.
    NotStarted,
    /// The machine cannot tell; a person must look. In words.
    Unknown(String),
}

/// Whether a measurement may be used.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Gate {
    /// It may.
    Passed,
    /// It may not.
    Failed(GateFailure),
}

/// Why a measurement may not be used.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GateFailure {
    /// Too few points were found, or too little of the aperture is covered. In words, with the value and the limit.
    Coverage(String),
    /// Nothing was touched where the part should be.
    NoPart,
    /// The coordinates are contact points, or look like them.
    Contacts,
    /// The coordinates are in inches, or look like it.
    Inches,
    /// The result is of another part, plan or cycle.
    Foreign(String),
    /// The result is broken: its CRC, its count, a number that is none.
    Broken(String),
    /// The temperature was outside its window.
    Temperature(String),
}

/// What a registration found, as far as the cell decides upon it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// Peak to valley of the deviations.
    #[serde(with = "super::number")]
    pub pv_mm: f64,
    /// Peak to valley of all deviations but the outermost 0.2 %; none where it was not worked out.
    #[serde(default, with = "super::number::optional")]
    pub pv_robust_mm: Option<f64>,
    /// Root mean square of the deviations.
    #[serde(with = "super::number")]
    pub rms_mm: f64,
    /// The figures of the part itself, which are judged: the scatter of the probe is taken off them. None in records of earlier versions,
    /// which judged those of the points.
    #[serde(default)]
    pub form: Option<FormFigures>,
    /// Expanded measuring uncertainty (k = 2) of the peak to valley.
    #[serde(with = "super::number")]
    pub pv_expanded_mm: f64,
    /// Expanded measuring uncertainty (k = 2) of the root mean square.
    #[serde(with = "super::number")]
    pub rms_expanded_mm: f64,
    /// Share of the aperture that is covered, 0 to 1.
    #[serde(with = "super::number")]
    pub coverage: f64,
    /// Points used.
    pub points: u32,
    /// Points left out as outliers.
    pub outliers: u32,
    /// The figures with those points, and where they lie; none where there are none, and in records of earlier versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub left_out: Option<Box<LeftOut>>,
    /// How far the part lies from where it was expected.
    #[serde(with = "super::number")]
    pub shift_mm: f64,
    /// How far it is turned from how it was expected.
    #[serde(with = "super::number")]
    pub turn_rad: f64,
    /// The directions in which the surface does not hold the part, in words.
    pub weak_directions: Vec<String>,
    /// What else a person should know.
    pub warnings: Vec<String>,
    /// How the part answered to the map before; none before the second pass.
    pub response: Option<Response>,
    /// What another pass is expected to leave; none where nobody can tell.
    #[serde(default)]
    pub forecast: Option<Forecast>,
    /// The most that was taken off anywhere since the run began; none where nobody knows.
    #[serde(default, with = "super::number::optional")]
    pub removed_mm: Option<f64>,
    /// How many contributions to the uncertainty nobody states, and of how many: they are taken for 0. None where nothing is told of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unstated: Option<[u32; 2]>,
    /// What is to be touched before anything is decided; none where enough is known, and where all is touched at once.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub touch_on: Option<Box<TouchOn>>,
}

/// What the figures are with the points that were left out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LeftOut {
    /// Peak to valley of the deviations.
    #[serde(with = "super::number")]
    pub pv_mm: f64,
    /// Root mean square of the deviations.
    #[serde(with = "super::number")]
    pub rms_mm: f64,
    /// Which points, where they lie and how far off they are, in words.
    pub places: String,
    /// Whether these places can be touched again by themselves; else the whole part is measured again.
    #[serde(default)]
    pub again: bool,
}

/// More that is to be touched.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TouchOn {
    /// How many targets are next.
    pub targets: u32,
    /// Why, in words.
    pub why: String,
}

/// The figures of the form of a part.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FormFigures {
    /// Peak to valley.
    pub pv: Interval,
    /// Peak to valley of the aperture: the touched points and the places between them, without the outermost 0.1 % of these at either end.
    pub pv_robust: Interval,
    /// Root mean square.
    pub rms: Interval,
    /// How far a single point scatters (rms).
    #[serde(with = "super::number")]
    pub scatter_mm: f64,
}

/// What another pass is expected to leave.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Forecast {
    /// Root mean square of the deviations.
    #[serde(with = "super::number")]
    pub rms_mm: f64,
    /// Its standard deviation.
    #[serde(with = "super::number")]
    pub sigma_mm: f64,
    /// What no correction can go below, as far as the passes have told.
    #[serde(default, with = "super::number::optional")]
    pub floor_mm: Option<f64>,
}

/// How the part answered to the last map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Response {
    /// As it should.
    Expected,
    /// The map was too small, or its effect too noisy, to tell.
    Unclear,
    /// The other way round: the sign of the map is wrong.
    SignFlipped,
    /// As to a mirrored or turned map: an axis points another way.
    Mirrored,
    /// Not at all.
    NoEffect,
    /// Twice: the map was applied two times.
    Doubled,
}

/// What the next map will do.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CompensationSummary {
    /// Largest absolute value of the map.
    #[serde(with = "super::number")]
    pub largest_mm: f64,
    /// The most that the next pass takes off anywhere.
    #[serde(with = "super::number")]
    pub depth_mm: f64,
    /// The PV that is expected after it.
    #[serde(with = "super::number")]
    pub predicted_pv_mm: f64,
    /// The RMS that is expected after it.
    #[serde(default, with = "super::number")]
    pub predicted_rms_mm: f64,
    /// Share of the part where the wheel will cut air, as far as it can be foreseen.
    #[serde(default, with = "super::number")]
    pub air_share: f64,
    /// Share of the error that is taken back, with the wavelength in millimetres from which each counts.
    #[serde(default, with = "super::number::pairs")]
    pub gains: Vec<[f64; 2]>,
    /// Share of a correction that the part answers with.
    #[serde(default, with = "super::number")]
    pub response: f64,
    /// What else a person should know.
    pub warnings: Vec<String>,
    /// Parameters of the machine that the recipe has taken back beside the map, as far as they are told.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub parameters: Vec<ParameterTold>,
    /// Root mean square of what is left for the map, where parameters are taken back beside it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub map_rms_mm: Option<f64>,
    /// What of them a person is to agree to first, in words: more than the recipe's tolerance.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub asks: Vec<String>,
}

/// What a measurement told of a parameter of the machine, and what of it is taken back.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterTold {
    /// What it is called.
    pub name: String,
    /// The unit of all its values.
    pub unit: String,
    /// How far it is off, beside what the pass was told of it already.
    pub off: f64,
    /// The expanded uncertainty of that (k = 2).
    pub expanded: f64,
    /// What of it is taken back.
    pub taken: f64,
    /// How far the next pass is told that it is off what the recipe states, in all.
    pub told: f64,
    /// By how much the root mean square falls by it, in micrometres.
    pub removes_rms_um: f64,
}

impl ParameterTold {
    /// For people.
    pub fn in_words(&self) -> String {
        let Self { name, unit, off, expanded, taken, told, removes_rms_um } = self;
        let found = format!("{name}: off by {off:.2} \u{b1} {expanded:.2} {unit}");
        if *taken == 0.0 && *told == 0.0 {
            return format!("{found}, no clear error: left to the map");
        }
        format!("{found}, {taken:.2} {unit} taken back ({told:.2} in all), which removes {removes_rms_um:.2} um rms")
    }
}

/// Why there is no next map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CompensationRefusal {
    /// The next pass would take off more than the recipe allows in all. In words, with the value and the limit.
    BudgetSpent(String),
    /// The pose is undetermined along these directions, so a map would be at the wrong place.
    WeakDirections(Vec<String>),
    /// Another reason, in words.
    Failed(String),
}

/// Why the record cannot be kept.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordFailure {
    /// The disk is full.
    DiskFull(String),
    /// The journal or a file cannot be written.
    Unwritable(String),
}

impl fmt::Display for Actor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} at {}", self.name, self.station)
    }
}

impl fmt::Display for Occupation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Idle => f.write_str("idle"),
            Self::ToClear => f.write_str("it was aborted or is in fault"),
            Self::Busy(message) => f.write_str(message),
        }
    }
}

impl fmt::Display for Condition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Supplies => "supplies",
            Self::Signals => "signals",
        })
    }
}

impl fmt::Display for Asked {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Load => "to take its payload",
            Self::Prepare => "to prepare",
            Self::Start => "to start",
            Self::Hold => "to hold",
            Self::Resume => "to resume",
            Self::Stop => "to stop",
            Self::Abort => "to abort",
            Self::Clear => "to be cleared",
            Self::Collect => "to give its result",
            Self::Acknowledge => "to forget its result",
            Self::Discard => "to forget a job at which it still is",
        })
    }
}

impl fmt::Display for JobResult {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Complete => "complete",
            Self::Stopped => "stopped",
            Self::Aborted => "aborted",
            Self::Failed => "failed",
        })
    }
}

impl Event {
    /// Returns the cycle that the event belongs to, if it belongs to one.
    pub fn cycle(&self) -> Option<u32> {
        match self {
            Self::PassLoaded { cycle }
            | Self::PlanLoaded { cycle }
            | Self::Prepared { cycle, .. }
            | Self::Started { cycle, .. }
            | Self::StartUnknown { cycle, .. }
            | Self::Ended { cycle, .. }
            | Self::RecordDoubted { cycle, .. }
            | Self::NotSaved { cycle, .. }
            | Self::Reconciled { cycle, .. }
            | Self::Collected { cycle, .. }
            | Self::Qualified { cycle, .. }
            | Self::Registered { cycle, .. }
            | Self::RegistrationFailed { cycle, .. }
            | Self::Compensated { cycle, .. }
            | Self::CompensationRefused { cycle, .. } => Some(*cycle),
            _ => None,
        }
    }

    /// Returns the machine that it comes from or is about.
    pub fn device(&self) -> Option<Device> {
        match self {
            Self::DeclaredOver { device, .. }
            | Self::ClearConfirmed { device, .. }
            | Self::ClearUnknown { device }
            | Self::Connected { device, .. }
            | Self::NotConnected { device, .. }
            | Self::LinkLost { device, .. }
            | Self::LinkBack { device, .. }
            | Self::StationFailed { device, .. }
            | Self::ConditionLost { device, .. }
            | Self::ConditionBack { device, .. }
            | Self::NotAutomatic { device, .. }
            | Self::AutomaticAgain { device }
            | Self::Prepared { device, .. }
            | Self::Started { device, .. }
            | Self::StartUnknown { device, .. }
            | Self::JobVanished { device, .. }
            | Self::Progressed { device, .. }
            | Self::MachineHeld { device }
            | Self::MachineResumed { device }
            | Self::Ended { device, .. }
            | Self::Cleared { device }
            | Self::Obstructed { device, .. }
            | Self::Refused { device, .. }
            | Self::Fault { device, .. }
            | Self::Acknowledged { device }
            | Self::AbortConfirmed { device }
            | Self::Reconciled { device, .. } => Some(*device),
            _ => None,
        }
    }

    /// Returns whether a person gave it as an order.
    pub fn is_order(&self) -> bool {
        self.actor().is_some() && !matches!(self, Self::Restarted { .. })
    }

    /// Returns who is behind it, as it is recorded: the person, the machine or the cell itself, and where.
    pub fn origin(&self) -> (String, String) {
        match (self.actor(), self.device()) {
            (Some(Actor { name, station }), _) => (name.clone(), station.clone()),
            (None, Some(device)) => (device.name().to_owned(), "wire".to_owned()),
            (None, None) => ("cell".to_owned(), "regrind".to_owned()),
        }
    }

    /// Says what it is to a person whom it did not fit.
    pub(super) fn in_words(&self) -> String {
        match self {
            Self::LoadConfirmed { .. } => "the word that the part is loaded".to_owned(),
            Self::ClearConfirmed { device, .. } => format!("the word that the {device} is clear of the part"),
            Self::DeclaredOver { device, .. } => format!("the word that the job of the {device} is over"),
            event if event.is_order() => format!("the order to {}", event.name()),
            event => match event.device() {
                Some(device) => format!("what the {device} tells"),
                None => "a result".to_owned(),
            },
        }
    }

    /// Returns the person who gave the order.
    pub fn actor(&self) -> Option<&Actor> {
        match self {
            Self::Start { actor }
            | Self::LoadConfirmed { actor }
            | Self::Hold { actor, .. }
            | Self::Resume { actor, .. }
            | Self::Stop { actor, .. }
            | Self::Abort { actor, .. }
            | Self::DeclaredOver { actor, .. }
            | Self::ClearConfirmed { actor, .. }
            | Self::Restarted { actor } => Some(actor),
            _ => None,
        }
    }

    /// Returns the name of the event, as it is recorded.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Start { .. } => "start",
            Self::LoadConfirmed { .. } => "load_confirmed",
            Self::Hold { .. } => "hold",
            Self::Resume { .. } => "resume",
            Self::Stop { .. } => "stop",
            Self::Abort { .. } => "abort",
            Self::DeclaredOver { .. } => "declared_over",
            Self::Restarted { .. } => "restarted",
            Self::Connected { .. } => "connected",
            Self::NotConnected { .. } => "not_connected",
            Self::LinkLost { .. } => "link_lost",
            Self::LinkBack { .. } => "link_back",
            Self::StationFailed { .. } => "station_failed",
            Self::ConditionLost { .. } => "condition_lost",
            Self::ConditionBack { .. } => "condition_back",
            Self::NotAutomatic { .. } => "not_automatic",
            Self::AutomaticAgain { .. } => "automatic_again",
            Self::PassLoaded { .. } => "pass_loaded",
            Self::PlanLoaded { .. } => "plan_loaded",
            Self::Prepared { .. } => "prepared",
            Self::Started { .. } => "started",
            Self::StartUnknown { .. } => "start_unknown",
            Self::JobVanished { .. } => "job_vanished",
            Self::Progressed { .. } => "progressed",
            Self::MachineHeld { .. } => "machine_held",
            Self::MachineResumed { .. } => "machine_resumed",
            Self::Ended { .. } => "ended",
            Self::RecordDoubted { .. } => "record_doubted",
            Self::Cleared { .. } => "cleared",
            Self::Obstructed { .. } => "obstructed",
            Self::ClearUnknown { .. } => "clear_unknown",
            Self::ClearConfirmed { .. } => "clear_confirmed",
            Self::Refused { .. } => "refused",
            Self::Fault { .. } => "fault",
            Self::Acknowledged { .. } => "acknowledged",
            Self::AbortConfirmed { .. } => "abort_confirmed",
            Self::Reconciled { .. } => "reconciled",
            Self::Collected { .. } => "collected",
            Self::Qualified { .. } => "qualified",
            Self::Registered { .. } => "registered",
            Self::RegistrationFailed { .. } => "registration_failed",
            Self::Compensated { .. } => "compensated",
            Self::CompensationRefused { .. } => "compensation_refused",
            Self::NotSaved { .. } => "not_saved",
            Self::RecordFailed { .. } => "record_failed",
            Self::NotOnRecord { .. } => "not_on_record",
            Self::ControlLost { .. } => "control_lost",
            Self::ControlBack => "control_back",
            Self::Deadline => "deadline",
        }
    }
}
