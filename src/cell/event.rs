//! Events: orders of people, facts from machines, results of computations. The cell gets all its information as events,
//! so a run can be replayed from its journal.

use std::fmt;

use regrind_figures::{Forecast, FormFigures, PartResponse, number};
use serde::{Deserialize, Serialize};

use super::state::Device;

/// Person, and the terminal or computer from which the order came.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Actor {
    /// Name of the person, or of the program that acts for one.
    pub name: String,
    /// Terminal or computer.
    pub station: String,
}

/// Fact, order or result.
///
/// `device` is the machine that the event comes from or is about. `boot_id` identifies this start of its application.
/// `cycle` is in every event that belongs to a cycle; the cell refuses an event of another cycle. `actor` is the person
/// who gave the order, looked at the machine, or started the program. `reason`, which can be empty, and `evidence` are
/// this person's words. In an event from a machine or a computation, `reason` and `message` describe the observation,
/// with the value and the limit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the fields are told above")]
#[serde(tag = "event", rename_all = "snake_case")]
#[expect(clippy::large_enum_variant, reason = "events are few, and never stored in large numbers")]
pub enum Event {
    // Orders of people.
    /// Begin the run.
    Start { actor: Actor },
    /// The right part is loaded and clamped, and no machine touches it.
    LoadConfirmed { actor: Actor },
    /// Move to the next safe position and wait for a person.
    Hold { actor: Actor, reason: String },
    /// Go on from where the cell was held.
    Resume { actor: Actor, reason: String },
    /// End in order.
    Stop { actor: Actor, reason: String },
    /// End at once: the safe sequence only.
    Abort { actor: Actor, reason: String },
    /// A person has checked a machine that cannot report whether it is clear of the part: it is clear.
    ClearConfirmed { actor: Actor, device: Device },
    /// A person has checked a machine that cannot report the result of its START: the job is over, and the machine is
    /// at rest and clear of the part. The cell never repeats the START; the part is measured instead.
    DeclaredOver { actor: Actor, device: Device, evidence: String },
    /// The program was restarted in the middle of this run; the links are new.
    Restarted { actor: Actor },

    // Facts from machines.
    /// The machine is the right one, its signature is valid and this program owns it. Answers `Connect` and
    /// `ClearMachine`.
    Connected {
        device: Device,
        boot_id: u32,
        simulated: bool,
        #[serde(rename = "found")]
        occupation: Occupation,
    },
    /// The machine cannot be used. Answers `Connect`.
    NotConnected {
        device: Device,
        #[serde(rename = "why")]
        reason: ConnectionRefusal,
    },
    /// The machine cannot be reached, or its application does not run.
    LinkLost {
        device: Device,
        #[serde(rename = "why")]
        reason: String,
    },
    /// The link is open again; the signature and the synchronisation are verified.
    LinkBack { device: Device, boot_id: u32 },
    /// The task of this program that communicates with the machine has failed. No more requests reach the machine,
    /// which holds by its own silence limit.
    StationFailed {
        device: Device,
        #[serde(rename = "why")]
        reason: String,
    },
    /// A condition that the cell needs from outside is missing. Reported as a level: again after every reconnection.
    ConditionLost {
        device: Device,
        condition: Condition,
        #[serde(rename = "words")]
        message: String,
    },
    /// The condition is back. The reporting side applies the hysteresis.
    ConditionBack { device: Device, condition: Condition },
    /// The machine is not in automatic mode: a person may move it at its panel. Reported as a level: again after every
    /// reconnection.
    NotAutomatic {
        device: Device,
        #[serde(rename = "words")]
        message: String,
    },
    /// The machine is in automatic mode again.
    AutomaticAgain { device: Device },
    /// The grinder holds the pass and the map of this cycle, read back and compared. Answers `LoadPass`.
    PassLoaded { cycle: u32 },
    /// The CMM holds the plan of this cycle, read back and compared. Answers `LoadPlan`.
    PlanLoaded { cycle: u32 },
    /// The machine is prepared for this cycle. Answers `Prepare`.
    Prepared { device: Device, cycle: u32 },
    /// The machine has reported the job of this run before. Now it reports no job or another job, and no end of the
    /// job.
    JobVanished {
        device: Device,
        #[serde(rename = "why")]
        reason: String,
    },
    /// The machine has accepted START. Answers `StartMachine`.
    Started { device: Device, cycle: u32 },
    /// It is not known whether the machine has accepted START. Answers `StartMachine`.
    StartUnknown {
        device: Device,
        cycle: u32,
        #[serde(rename = "why")]
        reason: String,
    },
    /// The job makes progress: `done` of `total` points, or thousandths of the path. A machine that moves without a job
    /// also sends it.
    Progressed { device: Device, done: u32, total: u32 },
    /// The machine is in its safe position and at rest. Answers `HoldMachine`, also if the machine was held already.
    /// May also come without an order.
    MachineHeld { device: Device },
    /// The machine moves again. Answers `ResumeMachine`, or comes without an order.
    MachineResumed { device: Device },
    /// The job is over. For the grinder the pass record has been read. Also answers `StopMachine`, even if no job ran.
    Ended { device: Device, cycle: u32, result: JobResult },
    /// The pass record of the grinder is implausible, or belongs to another pass. Comes before `Ended` or `Reconciled`.
    RecordDoubted {
        cycle: u32,
        #[serde(rename = "why")]
        reason: String,
    },
    /// A fresh status shows that the machine is clear of the part. Answers `VerifyClear`.
    Cleared { device: Device },
    /// A fresh status shows that the machine is not clear of the part. Answers `VerifyClear`, or comes without a
    /// request.
    Obstructed {
        device: Device,
        #[serde(rename = "words")]
        message: String,
    },
    /// The machine is at rest, but no signal shows whether it is clear of the part. Answers `VerifyClear`.
    ClearUnknown { device: Device },
    /// The machine refused the request.
    Refused {
        device: Device,
        #[serde(rename = "what")]
        request: MachineRequest,
        #[serde(rename = "why")]
        reason: String,
    },
    /// The machine is in FAULTED. (A machine that held because the link was silent is `MachineHeld`.)
    Fault {
        device: Device,
        code: u16,
        #[serde(rename = "words")]
        message: String,
    },
    /// The machine has discarded its result and is idle. Answers `Acknowledge`.
    Acknowledged { device: Device },
    /// The machine has finished its own safe sequence and is at rest. Answers `AbortMachine`.
    AbortConfirmed { device: Device },
    /// Outcome of the job. Answers `Reconcile`.
    Reconciled { device: Device, cycle: u32, outcome: Reconciliation },

    // Results of computations.
    /// The points of this cycle are read and stored: `found` of the `targets` planned. Answers `Collect`.
    Collected { cycle: u32, targets: u32, found: u32, gate: GateResult },
    /// The radius of the probe was compared with the reference sphere. `radius_error_mm` is the radius found minus the
    /// radius in the recipe. Answers `Qualify`.
    Qualified {
        cycle: u32,
        #[serde(with = "number")]
        radius_error_mm: f64,
    },
    /// The measurement is registered. Answers `Register`.
    Registered { cycle: u32, figures: Figures },
    /// The measurement could not be registered. Answers `Register`.
    RegistrationFailed {
        cycle: u32,
        #[serde(rename = "why")]
        reason: String,
    },
    /// The next map is computed and stored. Answers `Compensate`.
    Compensated { cycle: u32, summary: CompensationSummary },
    /// There is no next map. Answers `Compensate`.
    CompensationRefused {
        cycle: u32,
        #[serde(rename = "why")]
        reason: CompensationRefusal,
    },

    /// The result of a computation cannot be written to the disk. The cell does not use a result before it is written.
    /// Answers `Collect`, `Register` and `Compensate`.
    NotSaved {
        cycle: u32,
        #[serde(rename = "why")]
        reason: RecordFailure,
    },

    /// The journal or the run folder cannot be written: no motion may begin.
    RecordFailed {
        #[serde(rename = "why")]
        reason: RecordFailure,
    },
    /// A command that expects an answer was not sent, because it could not be recorded.
    NotOnRecord { command: String },
    /// The channel for orders is lost: the sender of an order may not find the cell.
    ControlLost {
        #[serde(rename = "why")]
        reason: String,
    },
    /// The channel for orders is back.
    ControlBack,
    /// Time has passed. If the deadline of the cell is reached, the cell reacts to it.
    Deadline,
}

/// Occupation of a machine at the time of the connection.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Occupation {
    /// Idle, as it should be.
    Idle,
    /// Aborted or faulted in an earlier run; it can be cleared.
    ToClear,
    /// Busy, for example with the job of this run. Contains a description for people.
    Busy(String),
}

/// Reason why a machine cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ConnectionRefusal {
    /// No device answers at the address.
    Unreachable(String),
    /// A device answers, but it is not this machine.
    WrongDevice(String),
    /// The sentinels have another word order than the cell file.
    WordOrder(String),
    /// Its unit of length is the inch.
    Inches,
    /// Another client owns it.
    Owned(String),
    /// It runs the job of another run. The cell sends no order to it, not even an abort.
    AtAnotherJob(String),
}

/// Condition that the cell needs from outside.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Condition {
    /// Air, coolant.
    Supplies,
    /// Every signal that the cell file requires, for example a temperature, is within its range.
    #[serde(alias = "temperature")]
    Signals,
}

/// Request of the cell that a machine can refuse, under its name in the record. It has no CLAIM and no RELEASE: these
/// commands belong to the driver of a machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MachineRequest {
    /// To take a payload.
    Load,
    /// To prepare.
    Prepare,
    /// To start. A refusal is certain: nothing moves.
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
    /// To discard its result.
    Acknowledge,
    /// To discard the result of a job that it still has.
    Discard,
}

/// Result of a job of a machine.
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

/// Outcome of a job after a time in which the cell had no reports from the machine.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reconciliation {
    /// The machine has started the job and runs it.
    Running,
    /// The machine has started the job and holds.
    Held,
    /// The machine has started the job, and the job is over.
    Ended(JobResult),
    /// The machine has proved that it did not start the job.
    NotStarted,
    /// The machine cannot report the outcome, so a person must check the machine. Contains the reason.
    Unknown(String),
}

/// Verdict of the gate on a measurement.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GateResult {
    /// The measurement can be used.
    Passed,
    /// The measurement cannot be used.
    Failed(GateFailure),
}

/// Reason why a measurement cannot be used.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GateFailure {
    /// Too few points were found, or too little of the aperture is covered. In words, with the value and the limit.
    Coverage(String),
    /// The probe touched nothing at the expected place of the part.
    NoPart,
    /// The coordinates are contact points, or look like contact points.
    Contacts,
    /// The coordinates are in inches, or look like inches.
    Inches,
    /// The result is of another part, plan or cycle.
    Foreign(String),
    /// The result is invalid: a wrong CRC, a wrong number of points, or an impossible value. Contains the reason.
    Broken(String),
    /// The temperature was outside its window.
    Temperature(String),
    /// Repeated touches differ from the first touches: the part, its frame or its temperature has changed. In words,
    /// with the value and the limit.
    Moved(String),
}

/// Figures of a registration on which the cell decides.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// Peak to valley of the deviations.
    #[serde(with = "number")]
    pub pv_mm: f64,
    /// Peak to valley of all deviations but the outermost 0.2 %. `None` if it was not computed.
    #[serde(rename = "pv_robust_mm", default, with = "number::optional")]
    pub pv_998_mm: Option<f64>,
    /// Root mean square of the deviations.
    #[serde(with = "number")]
    pub rms_mm: f64,
    /// Figures of the form of the part, without the noise of the probe. The cell judges these figures. `None` in
    /// records of earlier versions, in which the figures of the points are judged.
    #[serde(default)]
    pub form: Option<FormFigures>,
    /// Expanded measuring uncertainty (k = 2) of the peak to valley.
    #[serde(with = "number")]
    pub pv_expanded_mm: f64,
    /// Expanded measuring uncertainty (k = 2) of the root mean square.
    #[serde(with = "number")]
    pub rms_expanded_mm: f64,
    /// Share of the aperture that the measured points cover, 0 to 1.
    #[serde(with = "number")]
    pub coverage: f64,
    /// Points used.
    pub points: u32,
    /// Points left out as outliers.
    pub outliers: u32,
    /// Figures with the outliers included, and the places of the outliers. `None` if there are no outliers, and in
    /// records of earlier versions.
    #[serde(rename = "left_out", default, skip_serializing_if = "Option::is_none")]
    pub with_outliers: Option<Box<OutlierFigures>>,
    /// Distance of the part from its expected place.
    #[serde(with = "number")]
    pub shift_mm: f64,
    /// Angle of the part from its expected orientation.
    #[serde(rename = "turn_rad", with = "number")]
    pub rotation_rad: f64,
    /// Directions of the pose that the surface determines weakly, in words.
    pub weak_directions: Vec<String>,
    /// Other warnings for a person.
    pub warnings: Vec<String>,
    /// Response of the part to the previous map. `None` before the second pass.
    pub response: Option<PartResponse>,
    /// Expected result of another pass. `None` if it cannot be predicted.
    #[serde(default)]
    pub forecast: Option<Forecast>,
    /// Maximum removal at any place since the run began. `None` if it is not known.
    #[serde(default, with = "number::optional")]
    pub removed_mm: Option<f64>,
    /// Number of contributions to the uncertainty without a stated value, and number of all contributions. A
    /// contribution without a stated value counts as 0. `None` if there is no uncertainty budget.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unstated: Option<[u32; 2]>,
    /// Further targets that the measurement requires before the cell decides. `None` if no further targets are
    /// required.
    #[serde(rename = "touch_on", default, skip_serializing_if = "Option::is_none")]
    pub further_touches: Option<Box<FurtherTouches>>,
}

/// Figures with the outliers included.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OutlierFigures {
    /// Peak to valley of the deviations.
    #[serde(with = "number")]
    pub pv_mm: f64,
    /// Root mean square of the deviations.
    #[serde(with = "number")]
    pub rms_mm: f64,
    /// Outliers: which points, where they are and how large their deviations are, in words.
    #[serde(rename = "places")]
    pub description: String,
    /// True if only the outliers can be touched again. If false, the whole part is measured again.
    #[serde(rename = "again", default)]
    pub can_repeat: bool,
}

/// Further points to touch.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FurtherTouches {
    /// Number of targets to touch next.
    #[serde(rename = "targets")]
    pub target_count: u32,
    /// Reason, in words.
    #[serde(rename = "why")]
    pub reason: String,
}

/// Expected effect of the next map.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CompensationSummary {
    /// Largest absolute value of the map.
    #[serde(rename = "largest_mm", with = "number")]
    pub max_correction_mm: f64,
    /// Maximum removal of the next pass at any place.
    #[serde(with = "number")]
    pub depth_mm: f64,
    /// Expected PV after the next pass.
    #[serde(with = "number")]
    pub predicted_pv_mm: f64,
    /// Expected RMS after the next pass.
    #[serde(default, with = "number")]
    pub predicted_rms_mm: f64,
    /// Share of the part where the wheel will not cut, as far as it can be predicted.
    #[serde(default, with = "number")]
    pub air_share: f64,
    /// Gains, as pairs: shortest wavelength of a band in millimetres, and share of the error in this band that the
    /// correction removes.
    #[serde(default, with = "number::pairs")]
    pub gains: Vec<[f64; 2]>,
    /// Response of the part: change of the part as a share of the commanded correction.
    #[serde(rename = "response", default, with = "number")]
    pub responded_share: f64,
    /// Other warnings for a person.
    pub warnings: Vec<String>,
    /// Parameters of the machine that the recipe compensates in addition to the map, as far as they are estimated.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub parameters: Vec<RecordedParameter>,
    /// Root mean square of the residual error for the map, if parameters are compensated in addition.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub map_rms_mm: Option<f64>,
    /// Questions to a person before the next pass: one for each parameter whose correction exceeds the tolerance of the
    /// recipe.
    #[serde(rename = "asks", default, skip_serializing_if = "Vec::is_empty")]
    pub confirmations_required: Vec<String>,
}

/// Estimate of a parameter of the machine from a measurement, and its compensation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RecordedParameter {
    /// Name of the parameter.
    pub name: String,
    /// Unit of all its values.
    pub unit: String,
    /// Estimated error of the parameter, in addition to the correction that the pass already had.
    #[serde(rename = "off")]
    pub estimate: f64,
    /// Expanded uncertainty of the estimate (k = 2).
    #[serde(rename = "expanded")]
    pub expanded_uncertainty: f64,
    /// Part of the error that is compensated.
    #[serde(rename = "taken")]
    pub compensated: f64,
    /// Total correction that the next pass gets, relative to the value of the recipe.
    #[serde(rename = "told")]
    pub total_correction: f64,
    /// Reduction of the root mean square by the compensation, in micrometres.
    #[serde(rename = "removes_rms_um")]
    pub rms_reduction_um: f64,
}

impl RecordedParameter {
    /// Returns a sentence for people: the parameter with its estimated error, the expanded uncertainty (k = 2), and how
    /// much of the error is compensated. If nothing is compensated, the sentence says that the error is not
    /// significant.
    pub fn in_words(&self) -> String {
        let Self {
            name,
            unit,
            estimate,
            expanded_uncertainty: expanded,
            compensated,
            total_correction,
            rms_reduction_um: removes_rms_um,
        } = self;
        let found = format!("{name}: error {estimate:.2} \u{b1} {expanded:.2} {unit}");
        if *compensated == 0.0 && *total_correction == 0.0 {
            return format!(
                "{found}; this error is not significant, so this parameter is not corrected; the map corrects the whole error"
            );
        }
        format!(
            "{found}; the next pass compensates {compensated:.2} {unit} of this error (total correction of the parameter, in the same unit: {total_correction:.2}); this lowers the RMS by {removes_rms_um:.2} \u{b5}m"
        )
    }
}

/// Reason why there is no next map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CompensationRefusal {
    /// The next pass would exceed the total removal that the recipe allows. In words, with the value and the limit.
    BudgetSpent(String),
    /// The pose is undetermined in these directions, so a map would be displaced on the part.
    WeakDirections(Vec<String>),
    /// Another reason, in words.
    Failed(String),
}

/// Reason why the record cannot be kept.
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

impl fmt::Display for MachineRequest {
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
            Self::Acknowledge => "to discard its result",
            Self::Discard => "to discard the result of its unfinished job",
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
    /// Returns the number of the cycle that the event belongs to; `None` for an event without a cycle.
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

    /// Returns the machine that the event comes from or is about; `None` if it concerns no machine.
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

    /// Returns true if the event is an order or a confirmation of a person.
    pub fn is_order(&self) -> bool {
        self.actor().is_some() && !matches!(self, Self::Restarted { .. })
    }

    /// Returns who or what caused the event, as a pair of texts for the record:
    ///
    /// - An event of a person: the name and the station of the [`Actor`].
    /// - An event of a machine: the name of the machine, and "wire".
    /// - Any other event: "cell" and "regrind".
    pub fn origin(&self) -> (String, String) {
        match (self.actor(), self.device()) {
            (Some(Actor { name, station }), _) => (name.clone(), station.clone()),
            (None, Some(device)) => (device.name().to_owned(), "wire".to_owned()),
            (None, None) => ("cell".to_owned(), "regrind".to_owned()),
        }
    }

    /// Returns a short noun phrase for the event, such as "the order to hold" or "a report of the grinder". It is used
    /// in the message that refuses an event that the current state does not accept.
    pub(super) fn in_words(&self) -> String {
        match self {
            Self::LoadConfirmed { .. } => "the confirmation that the part is loaded".to_owned(),
            Self::ClearConfirmed { device, .. } => format!("the confirmation that the {device} is clear of the part"),
            Self::DeclaredOver { device, .. } => format!("the confirmation that the job of the {device} is over"),
            event if event.is_order() => format!("the order to {}", event.name()),
            event => match event.device() {
                Some(device) => format!("a report of the {device}"),
                None => "a result".to_owned(),
            },
        }
    }

    /// Returns the person who gave the order, made the confirmation or restarted the program; `None` for other events.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::sample_events;

    #[test]
    fn event_serde_round_trip() {
        let recorded = |event: &Event| serde_json::to_string(event).unwrap();
        for event in sample_events(3) {
            let text = recorded(&event);
            let back: Event = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{text}: {error}"));
            assert_eq!(recorded(&back), text);
        }
        for (value, stands) in [(f64::NAN, "\"NaN\""), (f64::INFINITY, "\"inf\""), (-0.1, "-0.1"), (5e-324, "5e-324")] {
            let text = recorded(&Event::Qualified { cycle: 1, radius_error_mm: value });
            assert!(text.contains(&format!(":{stands}")), "{text}");
            let Ok(Event::Qualified { radius_error_mm: back, .. }) = serde_json::from_str(&text) else { panic!() };
            assert!(back == value || back.is_nan() && value.is_nan());
        }
        let old = r#"{"event":"qualified","cycle":1,"radius_error_mm":null}"#;
        let Ok(Event::Qualified { radius_error_mm, .. }) = serde_json::from_str(old) else { panic!() };
        assert!(radius_error_mm.is_nan());
        assert!(serde_json::from_str::<Event>(&old.replace("null", "\"much\"")).is_err());
    }

    #[test]
    fn figures_none_and_nan_round_trip() {
        let Some(Event::Registered { figures, .. }) =
            sample_events(1).into_iter().find(|event| matches!(event, Event::Registered { .. }))
        else {
            panic!("there is one")
        };
        for removed_mm in [None, Some(f64::NAN), Some(0.25)] {
            let text = serde_json::to_string(&Figures { removed_mm, ..figures.clone() }).unwrap();
            let back: Figures = serde_json::from_str(&text).unwrap();
            assert_eq!(format!("{:?}", back.removed_mm), format!("{removed_mm:?}"));
        }
    }
}
