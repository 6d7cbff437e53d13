//! Task of a run: its fixed data, and the knowledge about each of its cycles.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::cell::{Figures, PvPoints, Tolerance};
use crate::compensation::path::{PathError, PathSummary, Scallops, ToolPath};
use crate::compensation::{
    Correction, CorrectionLimits, ErrorMap, GainRule, LearningState, MachineSimilarity, MapOptions, NextPassError,
    ParameterCorrections, ParameterEstimation, ParameterKind, ParameterOptions, SurfacePoint, WheelTerm,
};
use crate::device::{CarefulStart, Coordinates, CorrectionMap, Identified, Pass, Plan, PlanTarget, TargetKind};
use crate::formats::gcode::GcodeError;
use crate::formats::run_files::CycleFile;
use crate::formats::{
    CellRun, CorrectionIdentities, FormatError, Learned, ResultFolder, SettingIdentity, write_correction,
};
use crate::geometry::{DeviationSample, Grid, Point, Pose, Vector};
use crate::measuring::{self, ThermalExpansion, sphere_targets};
use crate::model::{FIRST_BATCH, Form, Hyperparameters, MachineUncertainty, StoppingCriteria, farthest_points};
use crate::registration::{
    Deviation, MapLimits, Method, PointStatus, Registration, RegistrationError, RegistrationOptions, Start, register,
};
use crate::surface::Nominal;

use super::program::{ProgramError, Programs, describe_parameter_corrections};
use super::recorder::OutputFiles;

/// Free space that is reserved for the journal and the program of a pass.
const RESERVE_BYTES: u64 = 16 << 20;
/// Disk space of a measured point in all files of a cycle, and of a node of its maps.
const POINT_BYTES: u64 = 600;
const NODE_BYTES: u64 = 250;

/// Data that do not change during a run.
#[derive(Debug)]
pub struct Task {
    /// Name of the part, for people.
    pub part: String,
    /// Nominal surface.
    pub nominal: Arc<Nominal>,
    /// Source file of the nominal surface, for the record.
    pub nominal_path: PathBuf,
    /// Which of several surfaces of that file it is, in words.
    pub nominal_choice: Option<String>,
    /// SHA-256 of the source: identity of the part.
    pub part_identity: [u8; 32],
    /// Targets for the probe. Empty if the machine has no plan of this program.
    pub targets: Vec<measuring::Target>,
    /// Parameters of the probing.
    pub probing: Probing,
    /// Sphere on which the probe is checked.
    pub reference_sphere: Option<ReferenceSphere>,
    /// Pose of the part in the fixture.
    pub fixture_cmm_from_model: Pose,
    /// Options of the registration. The start and the level are set for each cycle.
    pub registration_options: RegistrationOptions,
    /// True if a registration starts from the fixture pose.
    pub start_at_fixture: bool,
    /// Expected kind of coordinates; `None` if each result states it.
    pub expected_coordinates: Option<Coordinates>,
    /// Options of the map.
    pub map_options: MapOptions,
    /// Rule for the gain.
    pub gain_rule: GainRule,
    /// Error (rms) that a pass adds by itself, if the recipe states it.
    pub repeatability_mm: Option<f64>,
    /// State that was learned in earlier runs: correction of the first pass, state of the learning, and priors of the
    /// error field.
    pub learned: Option<Learned>,
    /// Settings that two runs must share so that one can learn from the other.
    pub setting: SettingIdentity,
    /// Settings without the cell, which runs of two cells must share so that one can learn from the other.
    pub kind: SettingIdentity,
    /// Limits of a correction.
    pub correction_limits: CorrectionLimits,
    /// Parameters of the machine that are compensated; `None` if the map corrects the whole error.
    pub parameter_compensation: Option<ParameterCompensation>,
    /// Standard uncertainty of the fixture along the locked directions: of the position in mm and of the orientation in
    /// rad. `None` if the recipe does not state it.
    pub locked_sigmas: Option<[f64; 2]>,
    /// Maximum uncertainty of the position of a correction on the part.
    pub map_limits: MapLimits,
    /// Parameters of a pass. Level and identity are set for each cycle.
    pub pass: Pass,
    /// Half of the largest accepted PV: values within it about zero are drawn as in tolerance.
    pub plot_tolerance_mm: Option<f64>,
    /// Programs, or the reason why there are none.
    pub programs: Result<Programs, PathError>,
    /// Scallops between the tracks of a pass; `None` if no path can be computed.
    pub scallops: Option<Scallops>,
    /// Minimum share of the targets that must be touched.
    pub min_found_share: f64,
    /// Minimum and maximum temperature of a usable measurement, in °C, if the recipe has a window.
    pub temperature_range_c: Option<[f64; 2]>,
    /// Thermal expansion of part and scales, if the recipe states it for the part.
    pub expansion: Option<ThermalExpansion>,
    /// Standard uncertainties of the errors of the measuring machine that all points share, from the cell file.
    pub machine_uncertainty: MachineUncertainty,
    /// Accepted tolerance, as in the plan of the cell.
    pub tolerance: Tolerance,
    /// Options of adaptive touches; `None` if all targets are touched.
    pub adaptive: Option<AdaptiveOptions>,
    /// True if the cell is simulated; all stored data are marked.
    pub simulation: bool,
    /// True if people only play the machines: the plan itself may be returned as the measurement.
    pub rehearsal: bool,
}

/// Parameters of the machine that are compensated.
#[derive(Clone, Debug, PartialEq)]
pub struct ParameterCompensation {
    /// Tolerance of each compensated parameter, in its unit, in the order of [`ParameterKind::ALL`].
    pub tolerances: [Option<f64>; ParameterKind::COUNT],
    /// Effect of an error of the wheel radius on a surface of this grinder: along the normal, or in height.
    pub wheel_term: WheelTerm,
    /// Surface under the nodes of a correction.
    pub node_points: Vec<SurfacePoint>,
}

/// Options of a measurement with adaptive touches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdaptiveOptions {
    /// Accepted tolerance, as in the plan of the cell.
    pub tolerance: Tolerance,
    /// Probability with which a part that is out of tolerance may be accepted.
    pub accepted_risk: f64,
    /// Maximum number of measurements of the part. After the last one no pass follows.
    pub max_measurements: u32,
}

impl AdaptiveOptions {
    /// Share of the first touches that are found if one of them misses the part.
    pub const FIRST_BATCH_MIN_SHARE: f64 = 1.0 - 1.0 / FIRST_BATCH as f64;
    /// Maximum number of evaluations of a measurement. Each may err with its share of the accepted risk.
    const MAX_DECISIONS: f64 = 5.0;
    /// Maximum uncertainty of the form, as a share of the rms tolerance, for a correction. It is negligible compared
    /// with what a pass adds.
    const MAX_FORM_UNCERTAINTY_SHARE: f64 = 0.17;
    /// Ratio of an rms limit to a PV limit that is equally hard to meet.
    const RMS_TO_PV_RATIO: f64 = 0.2;

    /// Returns the accepted probability, from 0 to 1, that one evaluation of an adaptive measurement accepts a part
    /// that is out of tolerance. This probability is `accepted_risk` divided by the maximum number of evaluations (5).
    ///
    /// The result is at most 1 minus `tolerance.probability`, the probability with which the final judgement must find
    /// the part in tolerance. With this limit, a part that an evaluation accepts is also accepted by the final
    /// judgement.
    pub fn decision_risk(&self) -> f64 {
        (self.accepted_risk / Self::MAX_DECISIONS).min(1.0 - self.tolerance.probability)
    }

    /// Returns the criteria by which an adaptive measurement stops: the limits of PV and RMS, and the maximum
    /// uncertainty of the form for a correction, all in mm.
    ///
    /// `may_grind` is true if another pass of the grinder is allowed. The measurement must then also be exact enough to
    /// compute a correction.
    pub fn stopping_criteria(&self, may_grind: bool) -> StoppingCriteria {
        let Tolerance { pv_mm, rms_mm, pv_points: pv_of, .. } = self.tolerance;
        let (pv_mm, pv_most_points_mm) = match pv_of {
            PvPoints::All => (pv_mm, f64::INFINITY),
            PvPoints::MostPoints => (f64::INFINITY, pv_mm),
        };
        let correction_mm =
            Self::MAX_FORM_UNCERTAINTY_SHARE * rms_mm.min(Self::RMS_TO_PV_RATIO * pv_mm.min(pv_most_points_mm));
        StoppingCriteria { pv_mm, pv_998_mm: pv_most_points_mm, rms_mm, correction_sigma_mm: correction_mm, may_grind }
    }
}

/// Parameters of the probing.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct Probing {
    pub probe_radius_mm: f64,
    pub approach_mm: f64,
    pub search_mm: f64,
    pub speed_mm_s: f64,
    pub safe_height_mm: f64,
}

/// Reference sphere, in the CMM frame.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct ReferenceSphere {
    pub centre: Point,
    pub radius_mm: f64,
    pub points: usize,
}

/// Knowledge about one cycle.
#[derive(Clone, Debug)]
pub(super) struct CycleState {
    pub(super) correction: Arc<Correction>,
    pub(super) plan: Option<Arc<Plan>>,
    /// Pose of the part that the plan assumes.
    pub(super) plan_pose: Pose,
    /// Number of the batch of touches that the plan belongs to, and indices of its targets (`batch_targets`), in an
    /// adaptive measurement.
    pub(super) batch: u32,
    pub(super) batch_targets: Arc<Vec<usize>>,
    /// Targets of the next batch.
    pub(super) next_targets: Option<Arc<Vec<usize>>>,
    /// Touches to repeat, in a measurement that is not adaptive.
    pub(super) repeated_touches: Option<Arc<RepeatedTouches>>,
    pub(super) points: Option<Arc<UsablePoints>>,
    pub(super) registration: Option<Arc<Registration>>,
    pub(super) form: Option<Arc<Form>>,
    /// Hyperparameters of the error field, estimated from the points of this cycle without a prior. `None` if the
    /// points show no field.
    pub(super) field_hyperparameters: Option<Hyperparameters>,
    pub(super) error_map: Option<Arc<ErrorMap>>,
    /// State of the learning with this cycle included.
    pub(super) learning: Option<Arc<LearningState>>,
    /// Parameters of the machine that explain the error.
    pub(super) parameters: Option<Arc<ParameterEstimation>>,
    /// Parameter corrections for the next pass.
    pub(super) parameter_corrections: Option<Arc<ParameterCorrections>>,
    pub(super) figures: Option<Figures>,
    /// Number of judgements. 0 for a measurement that a gate refused, which carries no information about the grinder.
    pub(super) judgement_count: u32,
}

impl CycleState {
    /// Returns the state of a cycle whose pass is not ground yet. `correction` is the correction for this pass. All
    /// results of the cycle are still empty.
    pub(super) fn new(correction: Correction) -> Self {
        Self {
            correction: Arc::new(correction),
            plan: None,
            plan_pose: Pose::identity(),
            batch: 0,
            batch_targets: Arc::default(),
            next_targets: None,
            repeated_touches: None,
            points: None,
            registration: None,
            form: None,
            field_hyperparameters: None,
            error_map: None,
            learning: None,
            parameters: None,
            parameter_corrections: None,
            figures: None,
            judgement_count: 0,
        }
    }

    pub(super) fn is_judged(&self) -> bool {
        self.judgement_count > 0
    }

    /// Stores `product`, the result of one computation (such as the usable points or the registration), in the fields
    /// of this cycle.
    pub(super) fn store(&mut self, product: ComputationProduct) {
        match product {
            ComputationProduct::Points(points) => self.points = Some(Arc::new(points)),
            ComputationProduct::Registered(found) => {
                let RegistrationProduct {
                    registration,
                    form,
                    field_hyperparameters: field,
                    error_map: error,
                    learning: known,
                    parameters,
                    parameter_corrections: set,
                    figures,
                    next_targets: next,
                    repeated_touches: again,
                } = *found;
                self.next_targets = next.map(Arc::new);
                self.repeated_touches = again.map(Arc::new);
                self.registration = Some(Arc::new(registration));
                self.form = form.map(Arc::new);
                self.field_hyperparameters = field;
                self.error_map = error.map(Arc::new);
                self.learning = known.map(Arc::new);
                self.parameters = parameters.map(Arc::new);
                self.parameter_corrections = set.map(Arc::new);
                self.figures = Some(figures);
            }
            ComputationProduct::Correction(_) | ComputationProduct::Nothing => {}
        }
    }
}

/// Result of a computation that later computations use, in addition to its event and its files.
pub(super) enum ComputationProduct {
    Nothing,
    Points(UsablePoints),
    Registered(Box<RegistrationProduct>),
    /// Correction of the next cycle.
    Correction(Correction),
}

/// Result of a registration, in addition to its event.
pub(super) struct RegistrationProduct {
    pub(super) registration: Registration,
    /// Form from the model of the error; `None` if the model fails.
    pub(super) form: Option<Form>,
    /// Hyperparameters of the error field, estimated from the points without a prior.
    pub(super) field_hyperparameters: Option<Hyperparameters>,
    pub(super) error_map: Option<ErrorMap>,
    pub(super) learning: Option<LearningState>,
    pub(super) parameters: Option<ParameterEstimation>,
    pub(super) parameter_corrections: Option<ParameterCorrections>,
    pub(super) figures: Figures,
    /// Next targets to touch; `None` if enough is known.
    pub(super) next_targets: Option<Vec<usize>>,
    /// Touches that can be repeated.
    pub(super) repeated_touches: Option<RepeatedTouches>,
}

/// Outliers to be touched again, with a few targets around each and control points elsewhere.
#[derive(Clone, Debug)]
pub(super) struct RepeatedTouches {
    /// Indices of the points to touch again.
    pub(super) outlier_points: Vec<usize>,
    /// Control points, which show whether part, frame and temperature are those of the first touches.
    pub(super) control_points: Vec<ControlPoint>,
    /// Largest change of a control point that the noise of two touches explains.
    pub(super) max_control_change_mm: f64,
    /// Targets: one for each outlier, one for each control point, then those around the outliers.
    pub(super) targets: Vec<measuring::Target>,
}

/// Good touch that is repeated as a control.
#[derive(Clone, Copy, Debug)]
pub(super) struct ControlPoint {
    /// Index of the point among the points of the part.
    pub(super) point_index: usize,
    /// Normal of the nominal surface at the point, in the CMM frame.
    pub(super) normal: Vector,
}

/// Usable points of a measurement.
#[derive(Clone, Debug)]
pub(super) struct UsablePoints {
    pub(super) part: Vec<Point>,
    pub(super) sphere: Vec<Point>,
    /// Radius of the probe, measured on the reference sphere; `None` if no sphere was touched.
    pub(super) probe_radius_mm: Option<f64>,
    /// Kind of coordinates: centres of the probe, or contact points.
    pub(super) coordinates: Coordinates,
    /// Standard uncertainty of the radius; 0 if it is the radius of the recipe, which states none.
    pub(super) probe_radius_sigma_mm: f64,
    /// Standard deviation of the probe's noise on the reference sphere, and the relative uncertainty of this deviation.
    /// Both are 0 if no sphere was touched.
    pub(super) probe_noise_mm: [f64; 2],
    /// Temperature of the part in °C, if the machine reported it.
    pub(super) temperature_c: Option<f64>,
    /// Indices of the targets of each batch (`tried_targets`), and index of the target of each point in `part`
    /// (`point_targets`). Empty if the measurement is not adaptive.
    pub(super) tried_targets: Vec<Vec<usize>>,
    pub(super) point_targets: Vec<usize>,
    /// Number of rounds in which outliers were touched again.
    pub(super) repeat_rounds: u32,
}

impl Task {
    /// Makes `learned` the initial state of the learning in this run. `learned` comes from an earlier part or from
    /// other cells. The first pass is then ground with the correction in `learned`.
    ///
    /// # Errors
    /// Returns an error if this correction exceeds the maximum correction at a node. Also returns an error if the first
    /// pass with this correction would remove more material than the removal budget of this run (a depth in mm). The
    /// task is unchanged after an error.
    pub fn start_from_learned(&mut self, learned: Learned) -> Result<(), NextPassError> {
        let before = self.learned.replace(learned);
        let within = self.first_correction().removed_mm(&self.correction_limits).map_err(|error| match error {
            NextPassError::BudgetSpent { removed_mm, budget_mm } => {
                NextPassError::BudgetAtOnce { removed_mm, budget_mm }
            }
            error => error,
        });
        if within.is_err() {
            self.learned = before;
        }
        within.map(|_| ())
    }

    /// Combines the learned states of other machines into one initial state for this task. Each entry of `others` names
    /// a run of another cell and holds the learned state of that run. `alike` is the similarity of the machines. The
    /// more similar the machines are, the more of their learned error is used.
    ///
    /// The learning treats the error of the surface separately in several bands of wavelengths. Returns `None` if no
    /// state in `others` contains a learned error in the same bands as this task.
    pub fn learned_from_others(&self, others: &[(CellRun, Learned)], alike: &MachineSimilarity) -> Option<Learned> {
        let of_this = (self.simulation, self.setting.id.clone());
        Learned::from_others(others, alike, of_this, (&self.new_learning(), self.zero_correction()))
    }

    /// Writes the files of the first pass into `folder`: the correction, the program and the axis table. The program
    /// and the table are omitted if they cannot be computed. Creates `folder` if it does not exist. Returns the names
    /// of the written files.
    ///
    /// The function is meant for a run that begins with a learned state.
    ///
    /// # Errors
    /// Those of [`Task::first_path`]; a file that cannot be written; a program that is too long, if the cell file names
    /// a program folder of the controller.
    pub fn save_first_pass(&self, folder: &Path) -> Result<Vec<String>, ProgramError> {
        ResultFolder::prepare(folder).map_err(GcodeError::from)?.keep();
        let (first, none) = (self.first_correction(), self.zero_correction());
        let mut files = OutputFiles::new(folder.to_owned(), String::new());
        self.save_correction(&mut files, &first, &none).map_err(GcodeError::from)?;
        self.save_program(&mut files, &first)?;
        Ok(files.into_existing())
    }

    /// Returns the correction of the first pass. If the run begins with a learned state, this is the correction in that
    /// state, resampled to the grid of this task. Otherwise the correction is 0 at all nodes.
    pub fn first_correction(&self) -> Correction {
        let none = self.zero_correction();
        match &self.learned {
            Some(learned) => learned.first_correction(none),
            None => none,
        }
    }

    fn zero_correction(&self) -> Correction {
        let grid = correction_grid([self.pass.x_mm, self.pass.y_mm], self.map_options.spacing_mm);
        Correction::zero(grid, self.correction_limits.allowance_mm)
    }

    /// Returns the estimated disk space, in bytes, for the files and the journal of one cycle.
    pub fn cycle_bytes(&self) -> u64 {
        let (points, nodes) = (self.targets.len() as u64, self.zero_correction().grid.len() as u64);
        RESERVE_BYTES + POINT_BYTES * points + NODE_BYTES * nodes
    }

    /// Computes the path of the wheel for the first pass. Returns the path with its summary.
    ///
    /// Returns `None` if Regrind cannot plan a path for this part. The field `programs` of the task then contains the
    /// reason. The controller of the grinder may still be able to plan a path from the correction map.
    ///
    /// # Errors
    /// A surface that the wheel cannot grind; a path that exceeds the limits of the grinder.
    pub fn first_path(&self) -> Result<Option<(ToolPath, PathSummary)>, PathError> {
        match &self.programs {
            Ok(programs) => programs.path(&self.first_correction()).map(Some),
            Err(error) if error.is_planning_failure() => Ok(None),
            Err(error) => Err(error.clone()),
        }
    }

    /// Returns the root mean square, in mm, of the scallops (the ridges between the tracks of the wheel). Returns 0 if
    /// no path can be computed, because the scallops are then unknown.
    pub(super) fn scallops_rms_mm(&self) -> f64 {
        self.scallops.map_or(0.0, |scallops| scallops.rms_mm)
    }

    /// Returns the state of the learning before the first pass. If the run begins with a learned state, the result
    /// contains the learned error of that state with an increased uncertainty, because the part is a new one. Otherwise
    /// the result is a state without any learned error.
    pub(super) fn initial_learning(&self) -> LearningState {
        self.learned.as_ref().map_or_else(|| self.new_learning(), |learned| learned.known.for_next_part())
    }

    fn new_learning(&self) -> LearningState {
        let Pass { x_mm, y_mm, .. } = self.pass;
        let size_mm = [x_mm[1] - x_mm[0], y_mm[1] - y_mm[0]];
        LearningState::new(self.gain_rule, &self.map_options, size_mm, self.repeatability_mm)
    }

    /// Registers the measured `points` (CMM frame) to the nominal surface. Returns the registration, and the options
    /// with which it was computed. `probe_radius_mm` is the distance of the points from the surface, such as the radius
    /// of the probe ball. It is 0 for contact points.
    ///
    /// The field `start_at_fixture` of the task selects the start. If it is true, the registration starts at the
    /// fixture pose. Otherwise it starts with a search over poses.
    ///
    /// A search can end in a pose with a direction that the surface does not determine, for example the rotation about
    /// an axis of symmetry. The position in this direction is then arbitrary, and the correction would be ground at the
    /// wrong place. In this case the registration is repeated with a start at the fixture pose.
    ///
    /// # Errors
    /// Those of [`register`].
    pub fn register(
        &self,
        points: &[Point],
        probe_radius_mm: f64,
    ) -> Result<(Registration, RegistrationOptions), RegistrationError> {
        self.register_with_start(points, probe_radius_mm, self.start_at_fixture)
    }

    /// Registers the measured `points` (CMM frame) to the nominal surface, with a start that the caller selects.
    /// Returns the registration, and the options with which it was computed. `probe_radius_mm` is the distance of the
    /// points from the surface. It is 0 for contact points.
    ///
    /// If `start_at_fixture` is true, the registration starts at the fixture pose. Otherwise it starts with a search
    /// over poses. If the search ends in a pose with a direction that the surface does not determine, the registration
    /// is repeated with a start at the fixture pose.
    ///
    /// # Errors
    /// Those of [`register`].
    pub fn register_with_start(
        &self,
        points: &[Point],
        probe_radius_mm: f64,
        start_at_fixture: bool,
    ) -> Result<(Registration, RegistrationOptions), RegistrationError> {
        let at_fixture = Start::Pose(self.fixture_cmm_from_model);
        let start = if start_at_fixture { at_fixture } else { Start::Search };
        // Contact points, or a level below the nominal surface: there is no offset, so the points lie on the surface.
        let method = if probe_radius_mm == 0.0 { Method::Contact } else { self.registration_options.method };
        let options = RegistrationOptions { probe_radius_mm, method, start, ..self.registration_options };
        let found = register(&self.nominal, points, &options)?;
        if start_at_fixture || !found.quality.weak_directions.iter().any(|weak| weak.is_undetermined) {
            return Ok((found, options));
        }
        let options = RegistrationOptions { start: at_fixture, ..options };
        Ok((register(&self.nominal, points, &options)?, options))
    }

    /// Returns the standard uncertainty of the fixture in each direction of the part's pose that the fixture locks. The
    /// order is x, y, z in mm, then rx, ry, rz in rad. The value is 0 for a direction that is not locked. The value is
    /// also 0 for a locked direction if the recipe states no uncertainty.
    ///
    /// Returns `None` if no direction is locked.
    pub fn locked_direction_sigmas(&self) -> Option<[f64; 6]> {
        let [shift_mm, turn_rad] = self.locked_sigmas.unwrap_or_default();
        let of = |k: usize| if k < 3 { shift_mm } else { turn_rad };
        let locked = self.registration_options.locked;
        locked.contains(&true).then(|| std::array::from_fn(|k| if locked[k] { of(k) } else { 0.0 }))
    }

    /// Returns the options for the estimation of machine parameters (such as the wheel radius) from a measurement.
    /// `told` holds the corrections of these parameters with which the measured pass was ground. `told` is `None` if
    /// the pass had no such corrections.
    pub fn parameter_options(&self, told: Option<&ParameterCorrections>) -> ParameterOptions {
        ParameterOptions {
            free_motions: self.registration_options.locked.map(|locked| !locked),
            locked_sigmas: self.locked_sigmas,
            tolerances: self
                .parameter_compensation
                .as_ref()
                .map_or([None; ParameterKind::COUNT], |taken| taken.tolerances),
            wheel_term: self.parameter_compensation.as_ref().map_or(WheelTerm::default(), |taken| taken.wheel_term),
            ..ParameterOptions::new(self.wheel_radius_mm(told))
        }
    }

    /// Returns the wheel radius, in mm, with which a pass is ground. This is the radius of the recipe plus the
    /// correction of the wheel radius in `told`, the parameter corrections of the pass. If `told` is `None`, the radius
    /// of the recipe is returned.
    pub fn wheel_radius_mm(&self, told: Option<&ParameterCorrections>) -> f64 {
        self.pass.wheel_radius_mm + told.map_or(0.0, |set| set.value(ParameterKind::WheelRadius))
    }

    /// Returns the SHA-256 that identifies a correction map. This map is the one that the grinder receives for a pass
    /// with `correction`.
    pub fn map_identity(&self, correction: &Correction) -> [u8; 32] {
        self.payloads(correction).0.identity()
    }

    /// Returns the two messages that the grinder receives for a pass with `correction`. The first message is the
    /// correction map. The second message contains the parameters of the pass, such as the corrected wheel radius and
    /// the level (the height of the target surface above the nominal surface).
    pub(super) fn payloads(&self, correction: &Correction) -> (CorrectionMap, Pass) {
        let map = CorrectionMap {
            grid: correction.grid,
            values_mm: correction.map_mm().into_owned(),
            part_identity: self.part_identity,
        };
        let wheel_radius_mm = self.wheel_radius_mm(correction.parameters.as_ref());
        let pass = Pass { level_mm: correction.level_mm, part_identity: self.part_identity, ..self.pass };
        (map, Pass { wheel_radius_mm, ..pass })
    }

    /// Creates the complete measuring plan in the CMM frame: first the reference sphere, if the task has one, then all
    /// targets on the part. `cmm_from_model` is the last measured pose of the part; it transforms the model frame to
    /// the CMM frame. `level_mm` is the height, in mm, of the ground surface above the nominal surface.
    ///
    /// If `seated_anew` is true, the part may have been clamped again. The plan then begins with a few targets on the
    /// part that are far apart from each other. These targets are touched at low speed, to detect a displaced part. The
    /// reference sphere and the remaining targets follow.
    pub fn plan(&self, level_mm: f64, cmm_from_model: &Pose, seated_anew: bool) -> Plan {
        let first = if seated_anew { farthest_points(&self.target_places(), CAREFUL_TARGETS) } else { Vec::new() };
        let rest = (0..self.targets.len()).filter(|k| !first.contains(k)).collect();
        self.plan_by_index(level_mm, cmm_from_model, (first, rest), true)
    }

    /// Returns the position (in mm) and the unit normal of each target on the nominal surface, in the model frame. The
    /// error model uses them.
    pub(super) fn target_places(&self) -> Vec<(Point, Vector)> {
        self.targets.iter().map(|target| (target.point, target.normal)).collect()
    }

    /// Creates a measuring plan for some targets of the task. `first` and `rest` are indices into the targets of the
    /// task. The plan begins with the targets in `first`, touched at low speed, and ends with those in `rest`. If
    /// `with_sphere` is true, the targets of the reference sphere come between these two groups.
    ///
    /// `cmm_from_model` is the pose of the part. `level_mm` is the height, in mm, of the ground surface above the
    /// nominal surface.
    pub(super) fn plan_by_index(
        &self,
        level_mm: f64,
        cmm_from_model: &Pose,
        (first, rest): (Vec<usize>, Vec<usize>),
        with_sphere: bool,
    ) -> Plan {
        let [first, rest] = [first, rest].map(|of| of.iter().map(|k| &self.targets[*k]).collect());
        self.plan_targets(level_mm, cmm_from_model, (first, rest), with_sphere)
    }

    /// Creates a measuring plan for any targets, also for targets that do not belong to the task. The plan begins with
    /// the targets in `first`, touched at low speed, and ends with those in `rest`. If `with_sphere` is true, the
    /// targets of the reference sphere come between these two groups.
    ///
    /// `cmm_from_model` is the pose of the part. `level_mm` is the height, in mm, of the ground surface above the
    /// nominal surface.
    pub(super) fn plan_targets(
        &self,
        level_mm: f64,
        cmm_from_model: &Pose,
        (first, rest): (Vec<&measuring::Target>, Vec<&measuring::Target>),
        with_sphere: bool,
    ) -> Plan {
        let sphere = self.reference_sphere.iter().filter(|_| with_sphere);
        let sphere = sphere.flat_map(|s| sphere_targets(s.centre, s.radius_mm, s.points));
        let sphere = sphere.map(|t| (TargetKind::ReferenceSphere, t.point, t.normal));
        let on_part = |t: &measuring::Target| {
            let point = cmm_from_model.transform_point(&(t.point + level_mm * t.normal));
            (TargetKind::Part, point, cmm_from_model.transform_direction(&t.normal))
        };
        let begin = first.iter().map(|t| on_part(t));
        let rest = rest.iter().map(|t| on_part(t));
        let targets = begin.chain(sphere).chain(rest).enumerate().map(|(index, (what, point, normal))| PlanTarget {
            index: index as u32,
            kind: what,
            point_mm: point.into(),
            normal: normal.into(),
        });
        let Probing { probe_radius_mm, approach_mm, search_mm, speed_mm_s, safe_height_mm } = self.probing;
        let targets: Vec<_> = targets.collect();
        let slowly = CarefulStart { target_count: first.len() as u32, speed_mm_s: CAREFUL_SPEED_SHARE * speed_mm_s };
        let careful = (!first.is_empty()).then_some(slowly);
        Plan { targets, probe_radius_mm, approach_mm, search_mm, speed_mm_s, safe_height_mm, careful_start: careful }
    }

    /// Writes `correction`, the correction of a pass, to the file `correction.csv` in `files`. `base` is the earlier
    /// correction that `correction` replaces. Comments in the file state the SHA-256 of the correction map that each of
    /// these two corrections gives.
    ///
    /// # Errors
    /// Those of `write_correction`, such as a file that cannot be written.
    pub(super) fn save_correction(
        &self,
        files: &mut OutputFiles,
        correction: &Correction,
        base: &Correction,
    ) -> Result<(), FormatError> {
        let [identity, replaces] = [correction, base].map(|correction| self.map_identity(correction));
        let identities = CorrectionIdentities { part: self.part_identity, map: identity, replaces };
        let set = describe_parameter_corrections(correction, self.pass.wheel_radius_mm);
        write_correction(&files.add_file(CycleFile::Correction), correction, (&identities, &set), self.simulation)
    }

    /// Writes the program and the axis table for the pass with `correction` into `files`. The axis table contains the
    /// offset of axis Z at each node of the correction.
    ///
    /// Returns `None` if both files were written. Otherwise returns the reason why a file was omitted:
    ///
    /// - Regrind cannot plan the path. Both files are omitted.
    /// - The program is too long, and the cell file names no program folder of the controller. Both files are omitted.
    /// - The table cannot be computed. Only the table is omitted.
    ///
    /// The grinder can then still grind from the correction map.
    ///
    /// # Errors
    /// A surface that the wheel cannot grind; a path that exceeds the limits of the grinder; a file that cannot be
    /// written; a copy in the program folder that differs from the program; a program that is too long, if the cell
    /// file names a program folder.
    pub(super) fn save_program(
        &self,
        files: &mut OutputFiles,
        correction: &Correction,
    ) -> Result<Option<String>, ProgramError> {
        match &self.programs {
            Ok(programs) => programs.save(files, correction, self.map_identity(correction)),
            Err(error) if error.is_planning_failure() => Ok(Some(format!("no program was written: {error}"))),
            Err(error) => Err(error.clone().into()),
        }
    }
}

/// Returns the grid of nodes for the corrections of a part. `x_mm` and `y_mm` are the minimum and the maximum of x and
/// of y on the part. The distance of neighbouring nodes is at most `spacing_mm`.
///
/// If this grid would have too many nodes, or if `spacing_mm` is not a finite number above 0, the result has only four
/// nodes: the corners of the rectangle from `x_mm` and `y_mm`.
pub(crate) fn correction_grid([x_mm, y_mm]: [[f64; 2]; 2], spacing_mm: f64) -> Grid {
    let corners = [[x_mm[0], y_mm[0]], [x_mm[1], y_mm[1]]];
    Grid::over(corners.into_iter(), spacing_mm).unwrap_or(Grid {
        columns: 2,
        rows: 2,
        first_mm: corners[0],
        spacing_mm: [corners[1][0] - corners[0][0], corners[1][1] - corners[0][1]],
    })
}

/// Number of targets with which a plan begins if the part may have been clamped again.
const CAREFUL_TARGETS: usize = 9;
/// Speed for [`CAREFUL_TARGETS`], as a share of the recipe's speed.
const CAREFUL_SPEED_SHARE: f64 = 0.2;

/// Returns the deviations of the points that a registration used. Outliers and points off the part are omitted.
pub(super) fn used_deviations(found: &Registration) -> impl Iterator<Item = &Deviation> {
    found.deviations.iter().filter(|d| d.status == PointStatus::Inlier)
}

/// Returns the points that a registration used, each as its x and y in the model frame and its deviation, in mm.
/// Outliers and points off the part are omitted.
pub(super) fn deviation_samples(found: &Registration) -> Vec<DeviationSample> {
    used_deviations(found)
        .map(|d| DeviationSample { place_mm: [d.point.x, d.point.y], deviation_mm: d.deviation_mm })
        .collect()
}
