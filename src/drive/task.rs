//! What a run is made of, and what is known of each of its cycles.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::cell::{Figures, PvOf, Tolerance};
use crate::compensation::path::{PathError, Scallops, Summary, ToolPath};
use crate::compensation::{
    Alike, Contact, Correction, CorrectionLimits, ErrorMap, GainRule, LearningState, MapOptions, NextPassError,
    ParameterKind, ParameterOptions, Parameters, Set, WheelTerm,
};
use crate::device::{Careful, Coordinates, CorrectionMap, Identified, Pass, Plan, Target, TargetKind};
use crate::formats::gcode::GcodeError;
use crate::formats::{CellRun, CorrectionIdentities, FormatError, Learned, ResultFolder, write_correction};
use crate::geometry::{Grid, Point, Pose, Sample, Vector};
use crate::measuring::{self, Expansion, sphere_targets};
use crate::model::{FIRST_BATCH, Form, Hyperparameters, MachineUncertainty, StoppingCriteria, farthest_points};
use crate::registration::{
    Deviation, MapLimits, Method, Options, PointStatus, Registration, RegistrationError, Start, register,
};
use crate::surface::Nominal;

use super::program::{ProgramError, Programs, set_in_words};
use super::record::Files;

/// What stays free for the journal and the program of a pass.
const RESERVE_BYTES: u64 = 16 << 20;
/// What a measured point takes in all the files of a cycle, and a node of its maps.
const POINT_BYTES: u64 = 600;
const NODE_BYTES: u64 = 250;

/// Everything that does not change during a run.
#[derive(Debug)]
pub struct Task {
    /// What the part is called, for people.
    pub part: String,
    /// The nominal surface.
    pub nominal: Arc<Nominal>,
    /// Where it came from, for the record.
    pub nominal_file: PathBuf,
    /// SHA-256 of what it came from: the identity of the part.
    pub part_identity: [u8; 32],
    /// Where the probe shall touch; none where the machine has no plan of ours.
    pub targets: Vec<measuring::Target>,
    /// How the probe goes about it.
    pub probing: Probing,
    /// The sphere on which the probe is checked.
    pub sphere: Option<Sphere>,
    /// Where the fixture holds the part.
    pub fixture_cmm_from_model: Pose,
    /// How measured points are registered; the start and the level are set for each cycle.
    pub registration: Options,
    /// Whether a registration begins where the fixture holds the part.
    pub start_at_fixture: bool,
    /// What the machine is expected to give; `None` where each result says it itself.
    pub coordinates: Option<Coordinates>,
    /// How a map is made.
    pub map: MapOptions,
    /// By what the share of an error that is taken back is chosen.
    pub gain: GainRule,
    /// What a pass adds by itself (rms), where the recipe knows it.
    pub repeatability_mm: Option<f64>,
    /// What an earlier run of this part found to come back in every pass.
    pub learned: Option<Learned>,
    /// What a run has to have in common with another to learn from it.
    pub setting: String,
    /// The same but for the cell: what a run of another cell has to have in common with it.
    pub kind: String,
    /// What a correction must keep to.
    pub limits: CorrectionLimits,
    /// Which parameters of the machine are taken back; none where all is left to the map.
    pub parameters: Option<TakenBack>,
    /// Standard uncertainty of where the datum holds the part, in millimetres, and of how it is turned, in radians, where the recipe states it.
    pub datum: Option<[f64; 2]>,
    /// What uncertainty of the place of a correction on the part is put up with.
    pub place: MapLimits,
    /// How a pass is ground; level and identity are set for each cycle.
    pub pass: Pass,
    /// Half the largest PV that is accepted: what lies within it about zero is drawn as in tolerance.
    pub tolerance_mm: Option<f64>,
    /// How programs are made, or why there are none.
    pub programs: Result<Programs, PathError>,
    /// What the tracks of a pass leave between them; unknown where no path can be laid.
    pub scallops: Option<Scallops>,
    /// Least share of the targets that must be touched.
    pub least_found: f64,
    /// Least and largest temperature of a measurement that is used, where the recipe has a window.
    pub temperature_c: Option<[f64; 2]>,
    /// How part and scales grow with their temperature, where the recipe tells it of the part.
    pub expansion: Option<Expansion>,
    /// What the measuring machine does to all points together, as its cell file states it.
    pub machine: MachineUncertainty,
    /// What is accepted, as the plan of the cell has it.
    pub tolerance: Tolerance,
    /// How touches are chosen; none where all targets are touched.
    pub adaptive: Option<Adaptive>,
    /// Whether the cell is simulated; everything stored is marked so.
    pub simulation: bool,
    /// Whether people only play the machines: the plan itself may come back as what was measured.
    pub rehearsal: bool,
}

/// Which parameters of the machine are taken back.
#[derive(Clone, Debug, PartialEq)]
pub struct TakenBack {
    /// The tolerance of each that is, in its unit, in the order of [`ParameterKind::ALL`].
    pub tolerances: [Option<f64>; ParameterKind::COUNT],
    /// How another radius of the wheel comes out on this grinder.
    pub wheel_term: WheelTerm,
    /// The surface under the nodes of a correction.
    pub nodes: Vec<Contact>,
}

/// What a measurement goes by whose touches are chosen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Adaptive {
    /// What is accepted, as the plan of the cell has it.
    pub tolerance: Tolerance,
    /// The probability with which a part that is not in tolerance may be accepted.
    pub accepted_risk: f64,
    /// The most passes of the grinder.
    pub most_cycles: u32,
}

impl Adaptive {
    /// Share of the first touches that is left where one of them finds nothing.
    pub const ONE_MAY_MISS: f64 = 1.0 - 1.0 / FIRST_BATCH as f64;
    /// Looks that are taken at a measurement, most often: each may err with its share of the accepted risk.
    const LOOKS: f64 = 5.0;
    /// Share of the tolerance of the rms to which a form has to be known to be corrected: beside what a pass adds that is next to nothing.
    const KNOWN: f64 = 0.17;
    /// An rms that is as hard to keep as a peak to valley of 1.
    const RMS_OF_PV: f64 = 0.2;

    /// The probability with which one look may err: a share of the accepted risk, and no more than who judges may, so that what a look takes for within
    /// is accepted.
    pub fn look_risk(&self) -> f64 {
        (self.accepted_risk / Self::LOOKS).min(1.0 - self.tolerance.probability)
    }

    /// What a measurement after a pass is to tell.
    pub fn purpose(&self, may_grind: bool) -> StoppingCriteria {
        let Tolerance { pv_mm, rms_mm, pv_of, .. } = self.tolerance;
        let (pv_mm, pv_most_points_mm) = match pv_of {
            PvOf::All => (pv_mm, f64::INFINITY),
            PvOf::MostPoints => (f64::INFINITY, pv_mm),
        };
        let correction_mm = Self::KNOWN * rms_mm.min(Self::RMS_OF_PV * pv_mm.min(pv_most_points_mm));
        StoppingCriteria { pv_mm, pv_most_points_mm, rms_mm, correction_mm, may_grind }
    }
}

/// How the probe goes about it.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct Probing {
    pub probe_radius_mm: f64,
    pub approach_mm: f64,
    pub search_mm: f64,
    pub speed_mm_s: f64,
    pub safe_height_mm: f64,
}

/// The reference sphere, in the CMM frame.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct Sphere {
    pub centre: Point,
    pub radius_mm: f64,
    pub points: usize,
}

/// What is known of one cycle.
#[derive(Clone, Debug)]
pub(super) struct Cycle {
    pub(super) correction: Arc<Correction>,
    pub(super) plan: Option<Arc<Plan>>,
    /// Which batch of touches the plan is of, and which targets it has, where they are chosen.
    pub(super) batch: u32,
    pub(super) asked: Arc<Vec<usize>>,
    /// The targets of the batch that comes next.
    pub(super) next: Option<Arc<Vec<usize>>>,
    /// What is to be touched again, where all targets are touched at once.
    pub(super) again: Option<Arc<Again>>,
    pub(super) points: Option<Arc<Points>>,
    pub(super) registration: Option<Arc<Registration>>,
    pub(super) form: Option<Arc<Form>>,
    /// What its points alone tell of the field of its error; none where they show none.
    pub(super) field: Option<Hyperparameters>,
    pub(super) error: Option<Arc<ErrorMap>>,
    /// What is known of the grinder with this cycle taken in.
    pub(super) known: Option<Arc<LearningState>>,
    /// What parameters of the machine make of the error.
    pub(super) parameters: Option<Arc<Parameters>>,
    /// What of it is taken back by telling them to the next pass.
    pub(super) set: Option<Arc<Set>>,
    pub(super) figures: Option<Figures>,
    /// How often it was judged; a measurement that a gate refused never was, and tells nothing of the grinder.
    pub(super) judgements: u32,
}

impl Cycle {
    /// A cycle of which nothing is known but how its pass is corrected.
    pub(super) fn new(correction: Correction) -> Self {
        Self {
            correction: Arc::new(correction),
            plan: None,
            batch: 0,
            asked: Arc::default(),
            next: None,
            again: None,
            points: None,
            registration: None,
            form: None,
            field: None,
            error: None,
            known: None,
            parameters: None,
            set: None,
            figures: None,
            judgements: 0,
        }
    }

    pub(super) fn is_judged(&self) -> bool {
        self.judgements > 0
    }

    /// Takes what a computation found.
    pub(super) fn take(&mut self, product: Product) {
        match product {
            Product::Points(points) => self.points = Some(Arc::new(points)),
            Product::Registered(found) => {
                let Registered { registration, form, field, error, known, parameters, set, figures, next, again } =
                    *found;
                self.next = next.map(Arc::new);
                self.again = again.map(Arc::new);
                self.registration = Some(Arc::new(registration));
                self.form = form.map(Arc::new);
                self.field = field;
                self.error = error.map(Arc::new);
                self.known = known.map(Arc::new);
                self.parameters = parameters.map(Arc::new);
                self.set = set.map(Arc::new);
                self.figures = Some(figures);
            }
            Product::Correction(_) | Product::Nothing => {}
        }
    }
}

/// What a computation leaves for those that follow, besides its event and its files.
pub(super) enum Product {
    Nothing,
    Points(Points),
    Registered(Box<Registered>),
    /// The correction of the next cycle.
    Correction(Correction),
}

/// What a registration gives besides its event.
pub(super) struct Registered {
    pub(super) registration: Registration,
    /// What the model of the error says of it; none where it can say nothing.
    pub(super) form: Option<Form>,
    /// What the points alone tell of the field of the error.
    pub(super) field: Option<Hyperparameters>,
    pub(super) error: Option<ErrorMap>,
    pub(super) known: Option<LearningState>,
    pub(super) parameters: Option<Parameters>,
    pub(super) set: Option<Set>,
    pub(super) figures: Figures,
    /// The targets to touch next; none where enough is known.
    pub(super) next: Option<Vec<usize>>,
    /// What can be touched again.
    pub(super) again: Option<Again>,
}

/// Touches that no neighbour agrees with, to be made again with a few around each.
#[derive(Clone, Debug)]
pub(super) struct Again {
    /// The points whose touches are made again, by their numbers.
    pub(super) points: Vec<usize>,
    /// Where: a target for each of these points, and then those around.
    pub(super) targets: Vec<measuring::Target>,
}

/// The points of a measurement that may be used.
#[derive(Clone, Debug)]
pub(super) struct Points {
    pub(super) part: Vec<Point>,
    pub(super) sphere: Vec<Point>,
    /// Radius that the probe really has, where a sphere was touched.
    pub(super) radius_mm: Option<f64>,
    /// Centres of the probe, or points of contact.
    pub(super) coordinates: Coordinates,
    /// Standard uncertainty of that; 0 where the radius is the recipe's, which states none.
    pub(super) radius_sigma_mm: f64,
    /// How far the probe scatters by what it found on the sphere, and to what share of it that is known; 0 where none was touched.
    pub(super) probe_scatter_mm: [f64; 2],
    /// Temperature of the part in degrees Celsius, where the machine told it.
    pub(super) temperature_c: Option<f64>,
    /// Which targets were tried, batch by batch, and which each point of the part is of; empty where all are touched at once.
    pub(super) tried: Vec<Vec<usize>>,
    pub(super) of: Vec<usize>,
    /// How often places were touched again that no neighbour agreed with.
    pub(super) rounds: u32,
}

impl Task {
    /// Begins with what an earlier part told of the grinder: the first pass is ground with its correction.
    ///
    /// # Errors
    /// A first correction beyond the limits of this run; the task is left as it was.
    pub fn begin_with(&mut self, learned: Learned) -> Result<(), NextPassError> {
        let before = self.learned.replace(learned);
        let within = self.first_correction().removed_mm(&self.limits).map_err(|error| match error {
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

    /// Makes what this task can begin with of what other cells found, as far as machines are alike; `None` where they tell nothing of it.
    pub fn from_others(&self, others: &[(CellRun, Learned)], alike: &Alike) -> Option<Learned> {
        let of_this = (self.simulation, self.setting.clone());
        Learned::from_others(others, alike, of_this, (&self.fresh(), self.uncorrected()))
    }

    /// Writes correction and program of a first pass that begins with what was learned; returns the names of the files.
    ///
    /// # Errors
    /// Those of [`Task::first_path`], and files that cannot be written.
    pub fn save_first(&self, folder: &Path) -> Result<Vec<String>, ProgramError> {
        ResultFolder::prepare(folder).map_err(GcodeError::from)?.keep();
        let (first, none) = (self.first_correction(), self.uncorrected());
        let mut files = Files::new(folder.to_owned(), String::new());
        self.save_correction(&mut files, &first, &none).map_err(GcodeError::from)?;
        self.save_program(&mut files, &first)?;
        Ok(files.made())
    }

    /// Returns the correction of the first pass: none, or what an earlier part left.
    pub fn first_correction(&self) -> Correction {
        let none = self.uncorrected();
        match &self.learned {
            Some(learned) => learned.first_correction(none),
            None => none,
        }
    }

    fn uncorrected(&self) -> Correction {
        let grid = correction_grid([self.pass.x_mm, self.pass.y_mm], self.map.spacing_mm);
        Correction::none(grid, self.limits.allowance_mm)
    }

    /// Returns how much room a cycle takes on the disk, as far as it can be told beforehand, and the journal beside it.
    pub fn cycle_bytes(&self) -> u64 {
        let (points, nodes) = (self.targets.len() as u64, self.uncorrected().grid.len() as u64);
        RESERVE_BYTES + POINT_BYTES * points + NODE_BYTES * nodes
    }

    /// Lays the path of the first pass; `None` where only the grinder's controller can, and `programs` says why.
    ///
    /// # Errors
    /// A surface that the wheel cannot grind, and limits of the grinder that the path goes beyond.
    pub fn first_path(&self) -> Result<Option<(ToolPath, Summary)>, PathError> {
        match &self.programs {
            Ok(programs) => programs.path(&self.first_correction()).map(Some),
            Err(error) if error.is_ours() => Ok(None),
            Err(error) => Err(error.clone()),
        }
    }

    /// Returns the rms of the scallops, as far as they are known.
    pub(super) fn scallops_rms_mm(&self) -> f64 {
        self.scallops.map_or(0.0, |scallops| scallops.rms_mm)
    }

    /// What is known of the grinder before the first pass.
    pub(super) fn beginning(&self) -> LearningState {
        self.learned.as_ref().map_or_else(|| self.fresh(), |learned| learned.known.for_next_part())
    }

    fn fresh(&self) -> LearningState {
        let Pass { x_mm, y_mm, .. } = self.pass;
        let size_mm = [x_mm[1] - x_mm[0], y_mm[1] - y_mm[0]];
        LearningState::new(self.gain, &self.map, size_mm, self.repeatability_mm)
    }

    /// Registers points to the surface offset by a radius, and returns the options that it was done with.
    ///
    /// A search leaves the part anywhere along a direction that the surface cannot see, and a correction would be ground in there. Only
    /// the fixture knows better, so that is begun at then.
    ///
    /// # Errors
    /// Those of [`register`].
    pub fn register(
        &self,
        points: &[Point],
        probe_radius_mm: f64,
    ) -> Result<(Registration, Options), RegistrationError> {
        self.register_from(points, probe_radius_mm, self.start_at_fixture)
    }

    /// Does the same, from where the fixture holds the part if that is wanted.
    ///
    /// # Errors
    /// Those of [`register`].
    pub fn register_from(
        &self,
        points: &[Point],
        probe_radius_mm: f64,
        start_at_fixture: bool,
    ) -> Result<(Registration, Options), RegistrationError> {
        let at_fixture = Start::Pose(self.fixture_cmm_from_model);
        let start = if start_at_fixture { at_fixture } else { Start::Search };
        // Without a ball and at the nominal surface, or below it by the last in-feed, there is no offset: the points lie on the surface.
        let method = if probe_radius_mm == 0.0 { Method::Contact } else { self.registration.method };
        let options = Options { probe_radius_mm, method, start, ..self.registration };
        let found = register(&self.nominal, points, &options)?;
        if start_at_fixture || !found.verdict.weak_directions.iter().any(|weak| weak.held) {
            return Ok((found, options));
        }
        let options = Options { start: at_fixture, ..options };
        Ok((register(&self.nominal, points, &options)?, options))
    }

    /// Standard uncertainties of where the fixture holds the part, where it holds it at all; 0 where nobody states them.
    pub fn held(&self) -> Option<[f64; 6]> {
        let [shift_mm, turn_rad] = self.datum.unwrap_or_default();
        let of = |k: usize| if k < 3 { shift_mm } else { turn_rad };
        let locked = self.registration.locked;
        locked.contains(&true).then(|| std::array::from_fn(|k| if locked[k] { of(k) } else { 0.0 }))
    }

    /// What is asked of the separation of parameters, for a pass that was told these.
    pub fn parameter_options(&self, told: Option<&Set>) -> ParameterOptions {
        ParameterOptions {
            free_motions: self.registration.locked.map(|locked| !locked),
            datum: self.datum,
            tolerances: self.parameters.as_ref().map_or([None; ParameterKind::COUNT], |taken| taken.tolerances),
            wheel_term: self.parameters.as_ref().map_or(WheelTerm::default(), |taken| taken.wheel_term),
            ..ParameterOptions::new(self.wheel_radius_mm(told))
        }
    }

    /// Returns the radius of the wheel that a pass is told: that of the recipe, or what measurements made of it.
    pub fn wheel_radius_mm(&self, told: Option<&Set>) -> f64 {
        self.pass.wheel_radius_mm + told.map_or(0.0, |set| set.value(ParameterKind::WheelRadius))
    }

    /// Returns the identity of the map that a pass is given.
    pub fn map_identity(&self, correction: &Correction) -> [u8; 32] {
        self.payloads(correction).0.identity()
    }

    /// Returns the payloads of a pass.
    pub(super) fn payloads(&self, correction: &Correction) -> (CorrectionMap, Pass) {
        let map = CorrectionMap {
            grid: correction.grid,
            values_mm: correction.map_mm().into_owned(),
            part_identity: self.part_identity,
        };
        let wheel_radius_mm = self.wheel_radius_mm(correction.set.as_ref());
        let pass = Pass { level_mm: correction.level_mm, part_identity: self.part_identity, ..self.pass };
        (map, Pass { wheel_radius_mm, ..pass })
    }

    /// Lays the plan: the reference sphere first, then the part where it was found last, at the level it was ground to.
    ///
    /// Where the part may have been seated anew, a few targets as far apart as the part has them come first, and slowly: what lies
    /// otherwise than expected is met at them.
    pub fn plan(&self, level_mm: f64, cmm_from_model: &Pose, seated_anew: bool) -> Plan {
        let first = if seated_anew { farthest_points(&self.places(), CAREFUL_TARGETS) } else { Vec::new() };
        let rest = (0..self.targets.len()).filter(|k| !first.contains(k)).collect();
        self.plan_of(level_mm, cmm_from_model, (first, rest), true)
    }

    /// The targets as the model of the error takes them.
    pub(super) fn places(&self) -> Vec<(Point, Vector)> {
        self.targets.iter().map(|target| (target.point, target.normal)).collect()
    }

    /// Lays a plan of some targets, the first of them slowly; the reference sphere, where it is wanted, between them.
    pub(super) fn plan_of(
        &self,
        level_mm: f64,
        cmm_from_model: &Pose,
        (first, rest): (Vec<usize>, Vec<usize>),
        with_sphere: bool,
    ) -> Plan {
        let [first, rest] = [first, rest].map(|of| of.iter().map(|k| &self.targets[*k]).collect());
        self.plan_at(level_mm, cmm_from_model, (first, rest), with_sphere)
    }

    /// Does the same for targets wherever they are.
    pub(super) fn plan_at(
        &self,
        level_mm: f64,
        cmm_from_model: &Pose,
        (first, rest): (Vec<&measuring::Target>, Vec<&measuring::Target>),
        with_sphere: bool,
    ) -> Plan {
        let sphere = self.sphere.iter().filter(|_| with_sphere);
        let sphere = sphere.flat_map(|s| sphere_targets(s.centre, s.radius_mm, s.points));
        let sphere = sphere.map(|t| (TargetKind::ReferenceSphere, t.point, t.normal));
        let on_part = |t: &measuring::Target| {
            let point = cmm_from_model.point(&(t.point + level_mm * t.normal));
            (TargetKind::Part, point, cmm_from_model.direction(&t.normal))
        };
        let begin = first.iter().map(|t| on_part(t));
        let rest = rest.iter().map(|t| on_part(t));
        let targets = begin.chain(sphere).chain(rest).enumerate().map(|(index, (what, point, normal))| Target {
            index: index as u32,
            what,
            point_mm: point.into(),
            normal: normal.into(),
        });
        let Probing { probe_radius_mm, approach_mm, search_mm, speed_mm_s, safe_height_mm } = self.probing;
        let targets: Vec<_> = targets.collect();
        let slowly = Careful { targets: first.len() as u32, speed_mm_s: CAREFUL_SHARE * speed_mm_s };
        let careful = (!first.is_empty()).then_some(slowly);
        Plan { targets, probe_radius_mm, approach_mm, search_mm, speed_mm_s, safe_height_mm, careful }
    }

    /// Writes the correction of a pass beside the one that it replaces.
    pub(super) fn save_correction(
        &self,
        files: &mut Files,
        correction: &Correction,
        base: &Correction,
    ) -> Result<(), FormatError> {
        let [identity, replaces] = [correction, base].map(|correction| self.map_identity(correction));
        let identities = CorrectionIdentities { part: self.part_identity, map: identity, replaces };
        let set = set_in_words(correction, self.pass.wheel_radius_mm);
        write_correction(&files.place("correction.csv"), correction, (&identities, &set), self.simulation)
    }

    /// Writes the program of the next pass, if there is one, and returns why not all of it is there: a pass without it can be ground all the
    /// same, as the grinder gets the map.
    ///
    /// # Errors
    /// A surface that the wheel cannot grind, limits of the grinder that the path goes beyond, files that cannot be written.
    pub(super) fn save_program(
        &self,
        files: &mut Files,
        correction: &Correction,
    ) -> Result<Option<String>, ProgramError> {
        match &self.programs {
            Ok(programs) => programs.keep(files, correction, self.map_identity(correction)),
            Err(error) if error.is_ours() => Ok(Some(format!("there is no program: {error}"))),
            Err(error) => Err(error.clone().into()),
        }
    }
}

/// The grid of the corrections of a part with these least and most x and y.
pub(crate) fn correction_grid([x_mm, y_mm]: [[f64; 2]; 2], spacing_mm: f64) -> Grid {
    let corners = [[x_mm[0], y_mm[0]], [x_mm[1], y_mm[1]]];
    Grid::over(corners.into_iter(), spacing_mm).unwrap_or(Grid {
        columns: 2,
        rows: 2,
        first_mm: corners[0],
        spacing_mm: [corners[1][0] - corners[0][0], corners[1][1] - corners[0][1]],
    })
}

/// With so many targets a plan begins where the part may have been seated anew.
const CAREFUL_TARGETS: usize = 9;
/// At this share of the recipe's speed.
const CAREFUL_SHARE: f64 = 0.2;

/// The points that took part in a registration.
pub(super) fn used(found: &Registration) -> impl Iterator<Item = &Deviation> {
    found.deviations.iter().filter(|d| d.status == PointStatus::Used)
}

/// What they deviate, over the plane of the model frame.
pub(super) fn readings(found: &Registration) -> Vec<Sample> {
    used(found).map(|d| Sample { at_mm: [d.point.x, d.point.y], deviation_mm: d.deviation_mm }).collect()
}
