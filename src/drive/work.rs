//! What is computed between a measurement and the next pass: plan, gates, registration, map, correction.
//!
//! Everything here blocks and is called off the asynchronous threads; what it needs is shared, what it returns is the event that
//! the cell gets and the files for the run folder.

use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::cell::{CompensationRefusal, CompensationSummary, Event, Figures, Forecast, Gate, GateFailure, Response};
use crate::compensation::path::{PathError, Summary, ToolPath};
use crate::compensation::{
    self, Correction, CorrectionLimits, ErrorMap, GainRule, LearningState, MapOptions, NextPassError, Seen, Sense,
    error_map, response,
};
use crate::device::{Coordinates, CorrectionMap, Identified, Measurement, Pass, Plan, PointStatus, Target, TargetKind};
use crate::formats::gcode::GcodeError;
use crate::formats::{
    CorrectionIdentities, FormatError, Learned, NominalInput, RegistrationDocument, ResultFolder, save_registration,
    write_correction, write_points,
};
use crate::geometry::{Grid, Point, Pose, Sample, Vector};
use crate::measuring::{self, fit_sphere, sphere_targets};
use crate::registration::{
    MapLimits, Method, Options, PointStatus as Fate, Registration, RegistrationError, Start, register,
    weak_for_compensation,
};
use crate::surface::{Nominal, Side};

use super::maps;
use super::program::{PROGRAM_FILE, ProgramError, Programs};
use super::record::Files;

/// Everything that does not change during a run.
#[derive(Debug)]
pub struct Task {
    /// The nominal surface.
    pub nominal: Arc<Nominal>,
    /// Where it came from, for the record.
    pub nominal_file: PathBuf,
    /// SHA-256 of what it came from: the identity of the part.
    pub part_identity: [u8; 32],
    /// Where the probe shall touch; none where the machine has no plan of ours.
    pub targets: Vec<measuring::Target>,
    /// The side of the nominal surface on which the probe is.
    pub side: Side,
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
    /// What a correction must keep to.
    pub limits: CorrectionLimits,
    /// What uncertainty of the place of a correction on the part is put up with.
    pub place: MapLimits,
    /// How a pass is ground; level and identity are set for each cycle.
    pub pass: Pass,
    /// Half the largest PV that is accepted: what lies within it about zero is drawn as in tolerance.
    pub tolerance_mm: Option<f64>,
    /// How programs are made, or why there are none.
    pub programs: Result<Programs, PathError>,
    /// Least share of the targets that must be touched.
    pub least_found: f64,
    /// Whether the cell is simulated; everything stored is marked so.
    pub simulation: bool,
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
    pub(super) points: Option<Arc<Points>>,
    pub(super) registration: Option<Arc<Registration>>,
    pub(super) error: Option<Arc<ErrorMap>>,
    /// What is known of the grinder with this cycle taken in.
    pub(super) known: Option<Arc<LearningState>>,
    pub(super) figures: Option<Figures>,
    /// Whether it was judged: a measurement that a gate refused tells nothing of the grinder.
    pub(super) judged: bool,
}

impl Cycle {
    /// A cycle of which nothing is known but how its pass is corrected.
    pub(super) fn new(correction: Correction) -> Self {
        Self {
            correction: Arc::new(correction),
            plan: None,
            points: None,
            registration: None,
            error: None,
            known: None,
            figures: None,
            judged: false,
        }
    }

    /// Takes what a computation found.
    pub(super) fn take(&mut self, product: Product) {
        match product {
            Product::Points(points) => self.points = Some(Arc::new(points)),
            Product::Registered(found) => {
                let Registered { registration, error, known, figures } = *found;
                self.registration = Some(Arc::new(registration));
                self.error = error.map(Arc::new);
                self.known = known.map(Arc::new);
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
    pub(super) error: Option<ErrorMap>,
    pub(super) known: Option<LearningState>,
    pub(super) figures: Figures,
}

/// The points of a measurement that may be used.
#[derive(Debug)]
pub(super) struct Points {
    pub(super) part: Vec<Point>,
    pub(super) sphere: Vec<Point>,
    /// Radius that the probe really has, where a sphere was touched.
    pub(super) radius_mm: Option<f64>,
    /// Centres of the probe, or points of contact.
    pub(super) coordinates: Coordinates,
    /// Standard uncertainty of that; 0 where the radius is the recipe's, which states none.
    pub(super) radius_sigma_mm: f64,
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

    /// Writes correction and program of a first pass that begins with what was learned; returns the names of the files.
    ///
    /// # Errors
    /// Those of [`Task::first_path`], and files that cannot be written.
    pub fn save_first(&self, folder: &Path) -> Result<Vec<&'static str>, ProgramError> {
        ResultFolder::prepare(folder).map_err(GcodeError::from)?.keep();
        let (first, none) = (self.first_correction(), self.uncorrected());
        let mut files = Files::new(folder.to_owned());
        save_correction(self, &mut files, &first, &none).map_err(GcodeError::from)?;
        save_program(self, &mut files, &first)?;
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
        let corners = [[self.pass.x_mm[0], self.pass.y_mm[0]], [self.pass.x_mm[1], self.pass.y_mm[1]]];
        let grid = Grid::over(corners.into_iter(), self.map.spacing_mm).unwrap_or(Grid {
            columns: 2,
            rows: 2,
            first_mm: corners[0],
            spacing_mm: [corners[1][0] - corners[0][0], corners[1][1] - corners[0][1]],
        });
        Correction::none(grid, self.limits.allowance_mm)
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

    /// What is known of the grinder before the first pass.
    fn beginning(&self) -> LearningState {
        let Pass { x_mm, y_mm, .. } = self.pass;
        let size_mm = [x_mm[1] - x_mm[0], y_mm[1] - y_mm[0]];
        let fresh = || LearningState::new(self.gain, &self.map, size_mm, self.repeatability_mm);
        self.learned.as_ref().map_or_else(fresh, |learned| learned.known.for_next_part())
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
        let at_fixture = Start::Pose(self.fixture_cmm_from_model);
        let start = if self.start_at_fixture { at_fixture } else { Start::Search };
        // Without a ball and at the nominal surface, or below it by the last in-feed, there is no offset: the points lie on the surface.
        let method = if probe_radius_mm == 0.0 { Method::Contact } else { self.registration.method };
        let options = Options { probe_radius_mm, method, start, ..self.registration };
        let found = register(&self.nominal, points, &options)?;
        if self.start_at_fixture || !found.verdict.weak_directions.iter().any(|weak| weak.held) {
            return Ok((found, options));
        }
        let options = Options { start: at_fixture, ..options };
        Ok((register(&self.nominal, points, &options)?, options))
    }

    /// Returns the identity of the map that a pass is given.
    pub fn map_identity(&self, correction: &Correction) -> [u8; 32] {
        self.payloads(correction).0.identity()
    }

    /// Returns the payloads of a pass.
    pub(super) fn payloads(&self, correction: &Correction) -> (CorrectionMap, Pass) {
        let map = CorrectionMap {
            grid: correction.grid,
            values_mm: correction.values_mm.clone(),
            part_identity: self.part_identity,
        };
        (map, Pass { level_mm: correction.level_mm, part_identity: self.part_identity, ..self.pass })
    }

    /// Lays the plan: the reference sphere first, then the part where it was found last, at the level it was ground to.
    pub(super) fn plan(&self, level_mm: f64, cmm_from_model: &Pose) -> Plan {
        let sphere = self.sphere.iter().flat_map(|s| sphere_targets(s.centre, s.radius_mm, s.points));
        let sphere = sphere.map(|t| (TargetKind::ReferenceSphere, t.point, t.normal));
        let part = self.targets.iter().map(|t| {
            let point = cmm_from_model.point(&(t.point + level_mm * t.normal));
            (TargetKind::Part, point, cmm_from_model.direction(&t.normal))
        });
        let targets = sphere.chain(part).enumerate().map(|(index, (what, point, normal))| Target {
            index: index as u32,
            what,
            point_mm: point.into(),
            normal: normal.into(),
        });
        let Probing { probe_radius_mm, approach_mm, search_mm, speed_mm_s, safe_height_mm } = self.probing;
        Plan { targets: targets.collect(), probe_radius_mm, approach_mm, search_mm, speed_mm_s, safe_height_mm }
    }
}

/// Looks whether the measurement of a cycle may be used, and writes its points.
pub(super) fn gate_cycle(
    task: &Task,
    files: &mut Files,
    number: u32,
    plan: Option<&Plan>,
    measurement: &Measurement,
) -> (Event, Product) {
    let unplanned = || Plan { targets: Vec::new(), ..task.plan(0.0, &task.fixture_cmm_from_model) };
    let plan = plan.map_or_else(|| Cow::Owned(unplanned()), Cow::Borrowed);
    let planned = plan.targets.iter().filter(|t| t.what == TargetKind::Part).count() as u32;
    let (found, usable) = match foreign(task, &plan, measurement) {
        Some(failure) => (0, Err(failure)),
        None => {
            let [part, sphere] = touched(&plan, planned, measurement);
            (part.len() as u32, gate(task, planned, part, sphere, measurement.coordinates))
        }
    };
    let saved = usable.and_then(|points| {
        let made = ResultFolder::prepare(files.folder()).map(ResultFolder::keep);
        let saved = made.and_then(|()| save_points(files, &points, task.simulation));
        saved.map(|()| points).map_err(|error| GateFailure::Broken(error.to_string()))
    });
    let (gate, product) = match saved {
        Ok(points) => (Gate::Passed, Product::Points(points)),
        Err(failure) => (Gate::Failed(failure), Product::Nothing),
    };
    (Event::Collected { cycle: number, targets: planned.max(found), found, gate }, product)
}

/// Returns what was touched of the part and of the reference sphere. A machine without a plan of ours gives what the operator took.
fn touched(plan: &Plan, planned: u32, measurement: &Measurement) -> [Vec<Point>; 2] {
    let taken = measurement.points.iter().filter(|p| p.status == PointStatus::Touched).map(|p| p.at_mm.into());
    let of = |kind: TargetKind| -> Vec<Point> {
        let pairs = measurement.points.iter().zip(&plan.targets);
        let touched = pairs.filter(|(p, t)| p.status == PointStatus::Touched && t.what == kind);
        touched.map(|(p, _)| p.at_mm.into()).collect()
    };
    let part = if planned == 0 { taken.collect() } else { of(TargetKind::Part) };
    [part, of(TargetKind::ReferenceSphere)]
}

fn gate(
    task: &Task,
    planned: u32,
    part: Vec<Point>,
    sphere: Vec<Point>,
    coordinates: Coordinates,
) -> Result<Points, GateFailure> {
    if part.is_empty() {
        return Err(GateFailure::NoPart);
    }
    let ball = radius(task, &sphere)?;
    let (found, share) = (part.len(), part.len() as f64 / f64::from(planned.max(1)));
    if planned > 0 && share < task.least_found {
        let limit = 100.0 * task.least_found;
        return Err(GateFailure::Coverage(format!(
            "{found} of {planned} points were found, {:.1} %, and the recipe asks for {limit:.1} % (minimum_coverage)",
            100.0 * share
        )));
    }
    let (radius_mm, radius_sigma_mm) = (ball.map(|b| b[0]), ball.map_or(0.0, |b| b[1]));
    Ok(Points { part, sphere, radius_mm, radius_sigma_mm, coordinates })
}

/// A result that belongs to another plan, or whose numbers cannot be.
fn foreign(task: &Task, plan: &Plan, measurement: &Measurement) -> Option<GateFailure> {
    if measurement.plan_identity != plan.identity() {
        return Some(GateFailure::Foreign("the machine names another plan than the one it was given".into()));
    }
    match (measurement.coordinates, task.coordinates) {
        (Coordinates::Contacts, Some(Coordinates::Centres)) => return Some(GateFailure::Contacts),
        (Coordinates::Centres, Some(Coordinates::Contacts)) => {
            let message = "the machine gives probe centres where the cell file expects contact points";
            return Some(GateFailure::Broken(message.into()));
        }
        _ => {}
    }
    if !plan.targets.is_empty() && measurement.points.len() != plan.targets.len() {
        let (found, planned) = (measurement.points.len(), plan.targets.len());
        return Some(GateFailure::Broken(format!("{found} points came for {planned} targets")));
    }
    let order = measurement.points.iter().zip(&plan.targets).position(|(p, t)| p.index != t.index);
    if let Some(k) = order {
        let (found, planned) = (measurement.points[k].index, plan.targets[k].index);
        return Some(GateFailure::Broken(format!("point {} is of target {found}, and target {planned} is due", k + 1)));
    }
    let touched = |p: &&crate::device::MeasuredPoint| p.status == PointStatus::Touched;
    let wrong = measurement.points.iter().filter(touched).find(|p| !p.at_mm.iter().all(|v| v.is_finite()))?;
    Some(GateFailure::Broken(format!("the coordinates of target {} are not finite numbers", wrong.index)))
}

/// Finds the radius of the probe and its standard uncertainty from the reference sphere: it tells contact points and inches from centres in millimetres.
fn radius(task: &Task, points: &[Point]) -> Result<Option<[f64; 2]>, GateFailure> {
    let Some(sphere) = task.sphere else { return Ok(None) };
    let fit = fit_sphere(points).map_err(|error| GateFailure::Broken(error.to_string()))?;
    let (stated, found) = (task.probing.probe_radius_mm, fit.radius_mm - sphere.radius_mm);
    // Contact points lie on the sphere itself; inches make it 25.4 times smaller.
    if found.abs() < 0.2 * stated {
        return Err(GateFailure::Contacts);
    }
    if (fit.radius_mm * 25.4 / (sphere.radius_mm + stated) - 1.0).abs() < 0.05 {
        return Err(GateFailure::Inches);
    }
    Ok(Some([found, fit.radius_sigma_mm]))
}

/// Registers the points of a cycle and writes what was found; `before` is the last measurement of an earlier pass that was judged.
pub(super) fn register_cycle(
    task: &Task,
    files: &mut Files,
    number: u32,
    cycle: &Cycle,
    before: Option<&Cycle>,
) -> (Event, Product) {
    match registered(task, files, number, cycle, before) {
        Ok(found) => {
            let event = Event::Registered { cycle: number, figures: found.figures.clone() };
            (event, Product::Registered(Box::new(found)))
        }
        Err(why) => (Event::RegistrationFailed { cycle: number, why }, Product::Nothing),
    }
}

fn registered(
    task: &Task,
    files: &mut Files,
    number: u32,
    cycle: &Cycle,
    before: Option<&Cycle>,
) -> Result<Registered, String> {
    let points = cycle.points.as_ref().ok_or("there are no points of this cycle")?;
    // The surface wanted by this pass stands above the nominal one by its level, and the ball rolls on that.
    let radius_mm = points.radius_mm.unwrap_or(task.probing.probe_radius_mm);
    let ball_mm = if points.coordinates == Coordinates::Contacts { 0.0 } else { radius_mm };
    let probe_radius_mm = (ball_mm + cycle.correction.level_mm).max(0.0);
    let (mut found, options) = task.register(&points.part, probe_radius_mm).map_err(|error| error.to_string())?;
    found.allow_for_radius(points.radius_sigma_mm);
    save(task, files, &found, &options).map_err(|error| error.to_string())?;
    let error = error_map(&readings(&found), &task.map).ok();
    maps::save_figures(task, files, error.as_ref(), &found).map_err(|error| error.to_string())?;
    let offered = maps::parameters(task, files, &found).map_err(|error| error.to_string())?;
    // Every measurement leaves its map, whatever becomes of the correction.
    error.as_ref().map_or(Ok(()), |map| maps::save(task, files, (number, cycle), map, &found))?;
    let answer = error.as_ref().and_then(|error| answer(before?, cycle, &found, error));
    let known = error.as_ref().map(|error| learned_from(task, cycle, before, error, answer));
    let forecast = known.as_ref().zip(error.as_ref()).map(|(known, error)| known.forecast(error));
    let mut figures = figures(task, cycle, &found, error.as_ref(), answer, forecast);
    figures.warnings.extend(error.iter().flat_map(|map| map.advice.iter().cloned()).chain(offered));
    Ok(Registered { registration: found, error, known, figures })
}

/// Takes a measured pass into what is known of the grinder.
fn learned_from(
    task: &Task,
    cycle: &Cycle,
    before: Option<&Cycle>,
    error: &ErrorMap,
    answer: Option<compensation::Response>,
) -> LearningState {
    let earlier = before.and_then(|before| before.known.as_deref().cloned()).unwrap_or_else(|| task.beginning());
    earlier.after(&Seen { correction: &cycle.correction, error, answer })
}

fn save(task: &Task, files: &mut Files, found: &Registration, options: &Options) -> Result<(), FormatError> {
    let nominal = NominalInput {
        file: &task.nominal_file,
        points: task.nominal.len(),
        kind: format!("{:?}", task.nominal.kind()),
    };
    let mut document = RegistrationDocument::new(found, options, nominal, Path::new("measured.csv"));
    document.simulation = Some(task.simulation);
    for name in ["deviations.csv", "deviation_uncertainty.csv", "registration.json"] {
        files.place(name);
    }
    save_registration(files.folder(), &document, &found.deviations)
}

fn readings(found: &Registration) -> Vec<Sample> {
    let used = found.deviations.iter().filter(|d| d.status == Fate::Used);
    used.map(|d| Sample { at_mm: [d.point.x, d.point.y], deviation_mm: d.deviation_mm }).collect()
}

fn figures(
    task: &Task,
    cycle: &Cycle,
    found: &Registration,
    error: Option<&ErrorMap>,
    answer: Option<compensation::Response>,
    forecast: Option<compensation::Forecast>,
) -> Figures {
    let verdict = &found.verdict;
    let moved = task.fixture_cmm_from_model.inverse() * found.cmm_from_model;
    let outliers = found.deviations.iter().filter(|d| d.status == Fate::Outlier).count() as u32;
    // What the filter takes out is what a point scatters by: noise of the probe and the finest texture.
    let scatter_mm = error.map_or(verdict.residual_sigma_mm, |map| map.point_sigma_mm);
    let points = verdict.used.max(1) as f64;
    Figures {
        pv_mm: verdict.pv_mm,
        pv_robust_mm: pv_of_most(found),
        rms_mm: verdict.rms_mm,
        // Of two extreme points, each uncertain by the scatter; k = 2.
        pv_expanded_mm: 2.0 * 2f64.sqrt() * scatter_mm,
        // The rms of n values that scatter by s is uncertain by s / sqrt(2 n), whatever their form; k = 2.
        rms_expanded_mm: 2.0 * scatter_mm / (2.0 * points).sqrt(),
        coverage: verdict.coverage,
        points: verdict.used as u32,
        outliers,
        shift_mm: moved.translation_mm.norm(),
        turn_rad: moved.angle_rad(),
        weak_directions: verdict.weak_directions.iter().map(|w| w.words.clone()).collect(),
        warnings: verdict.warnings.clone(),
        response: answer.map(|answer| in_words_of_the_cell(answer.sense)),
        forecast: forecast.map(|f| Forecast { rms_mm: f.rms_mm, sigma_mm: f.sigma_mm, floor_mm: f.floor_mm }),
        removed_mm: Some(task.limits.allowance_mm - cycle.correction.level_mm),
    }
}

/// Peak to valley without the outermost 0.2 % of the points, half at each end.
fn pv_of_most(found: &Registration) -> Option<f64> {
    let used = found.deviations.iter().filter(|d| d.status == Fate::Used);
    let mut values: Vec<f64> = used.map(|d| d.deviation_mm).collect();
    values.sort_unstable_by(f64::total_cmp);
    let beyond = values.len() / 1000;
    Some(values.get(values.len().checked_sub(1 + beyond)?)? - values.get(beyond)?)
}

fn answer(before: &Cycle, cycle: &Cycle, found: &Registration, error: &ErrorMap) -> Option<compensation::Response> {
    let earlier = before.error.as_ref()?;
    let used = found.deviations.iter().filter(|d| d.status == Fate::Used);
    let places: Vec<(Point, Vector)> = used.map(|d| (d.point, d.normal)).collect();
    let scatter_mm = earlier.point_sigma_mm.hypot(error.point_sigma_mm);
    Some(response([earlier, error], [&before.correction, &cycle.correction], &places, scatter_mm))
}

fn in_words_of_the_cell(sense: Sense) -> Response {
    match sense {
        Sense::AsCommanded => Response::Expected,
        Sense::Flipped => Response::SignFlipped,
        Sense::MirroredX | Sense::MirroredY | Sense::Turned => Response::Mirrored,
        Sense::NoEffect => Response::NoEffect,
        Sense::Doubled => Response::Doubled,
        Sense::Unclear => Response::Unclear,
    }
}

/// Makes the correction of the next pass and writes it.
pub(super) fn compensate_cycle(task: &Task, files: &mut Files, number: u32, cycle: &Cycle) -> (Event, Product) {
    match compensated(task, files, cycle) {
        Ok((summary, next)) => (Event::Compensated { cycle: number, summary }, Product::Correction(next)),
        Err(why) => (Event::CompensationRefused { cycle: number, why }, Product::Nothing),
    }
}

fn compensated(
    task: &Task,
    files: &mut Files,
    cycle: &Cycle,
) -> Result<(CompensationSummary, Correction), CompensationRefusal> {
    let failed = |why: &dyn std::fmt::Display| CompensationRefusal::Failed(why.to_string());
    let found =
        cycle.registration.as_ref().ok_or_else(|| failed(&"the measurement of this cycle is not registered"))?;
    // Where the part may slide in its own surface, nobody knows where on the part a map would be ground in.
    if let Some(why) = weak_for_compensation(found, &task.place) {
        return Err(CompensationRefusal::WeakDirections(vec![why]));
    }
    let map = match &cycle.error {
        Some(map) => Arc::clone(map),
        None => Arc::new(error_map(&readings(found), &task.map).map_err(|error| failed(&error))?),
    };
    let known = match &cycle.known {
        Some(known) => Arc::clone(known),
        None => Arc::new(learned_from(task, cycle, None, &map, None)),
    };
    let step = cycle.correction.next(&map, &known, &task.limits).map_err(|error| match error {
        NextPassError::BudgetSpent { .. } => CompensationRefusal::BudgetSpent(error.to_string()),
        error => failed(&error),
    })?;
    // A pass that cannot be ground leaves no correction that somebody might take for one.
    let warning = save_program(task, files, &step.correction)
        .map_err(|error| failed(&format_args!("the next pass cannot be ground: {error}")))?;
    save_correction(task, files, &step.correction, &cycle.correction).map_err(|error| failed(&error))?;
    let largest_mm = step.correction.values_mm.iter().fold(0.0f64, |most, v| most.max(v.abs()));
    let ratio = found.verdict.pv_mm / found.verdict.rms_mm.max(f64::MIN_POSITIVE);
    let forecast = known.forecast(&map);
    let summary = CompensationSummary {
        largest_mm,
        depth_mm: step.depth_mm,
        predicted_pv_mm: forecast.rms_mm * ratio,
        predicted_rms_mm: forecast.rms_mm,
        air_share: step.air_share,
        gains: known.gains(),
        response: known.response()[0],
        warnings: warning.into_iter().collect(),
    };
    Ok((summary, step.correction))
}

fn save_correction(
    task: &Task,
    files: &mut Files,
    correction: &Correction,
    base: &Correction,
) -> Result<(), FormatError> {
    let [identity, replaces] = [correction, base].map(|correction| task.map_identity(correction));
    let identities = CorrectionIdentities { part: task.part_identity, map: identity, replaces };
    write_correction(&files.place("correction.csv"), correction, &identities, task.simulation)
}

/// Writes the program of the next pass, if there is one, and returns why not all of it is there: a pass without it can be ground all the
/// same, as the grinder gets the map.
///
/// # Errors
/// A surface that the wheel cannot grind, limits of the grinder that the path goes beyond, files that cannot be written.
fn save_program(task: &Task, files: &mut Files, correction: &Correction) -> Result<Option<String>, ProgramError> {
    match &task.programs {
        Ok(programs) => programs.keep(files, correction, task.map_identity(correction)),
        Err(error) if error.is_ours() => Ok(Some(format!("there is no {PROGRAM_FILE}: {error}"))),
        Err(error) => Err(error.clone().into()),
    }
}

/// What the next part of this kind can begin with; none where this run did not get so far.
pub(super) fn learned(task: &Task, run: String, cycle: &Cycle) -> Option<Learned> {
    let known = cycle.known.as_deref()?;
    let wrong = [Response::SignFlipped, Response::Mirrored, Response::NoEffect, Response::Doubled];
    if cycle.figures.as_ref()?.response.is_some_and(|response| wrong.contains(&response)) {
        return None;
    }
    let (setting, simulation) = (task.setting.clone(), task.simulation);
    let correction = cycle.correction.changed(known);
    Some(Learned::new(simulation, setting, run, correction, known.clone()))
}

/// Writes the points of a measurement, in the CMM frame.
fn save_points(files: &mut Files, points: &Points, simulation: bool) -> Result<(), FormatError> {
    let header = if simulation { "# SIMULATION\nx_mm,y_mm,z_mm" } else { "x_mm,y_mm,z_mm" };
    if !points.sphere.is_empty() {
        write_points(files.place("reference_sphere.csv"), header, &points.sphere)?;
    }
    write_points(files.place("measured.csv"), header, &points.part)
}
