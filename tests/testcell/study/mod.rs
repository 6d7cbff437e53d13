//! Cycles of one simulated part without wires: ground, touched, registered and compensated as in a run, and compared
//! with the truth.

pub mod identifiability;
pub mod made_part;
pub mod transfer;

use crate::payloads::{Encode, decode_points};
use crate::perfect::perfect_grinder;
use regrind::cell::CellPlan;
use regrind::compensation::{
    Correction, ErrorMap, GainRule, LearningState, MapOptions, NextPassError, ParameterCorrections,
    ParameterEstimation, ParameterExplainer, ParameterKind, PassObservation, SurfacePoint, error_map,
    estimate_parameters, estimate_response, explained_by_parameters,
};
use regrind::config::CellConfig;
use regrind::drive::Task;
use regrind::figures::statistics::rms;
use regrind::geometry::{DeviationSample, Grid, GridMap, Point, Vector};
use regrind::recipe::Recipe;
use regrind::registration::{Deviation, PointStatus, Registration};
use regrind::setup;
use regrind_sim::body::{Payload, Payloads, Physics};
use regrind_sim::grinder::Grinder;
use regrind_sim::payload::{Feature, Map, Pass, Plan, PointRecord, Status, Target};
use regrind_sim::spec::GrinderSpec;
use regrind_sim::spec::WorldSpec;
use regrind_sim::world::World;
use regrind_testutils::root;

/// All shipped recipes with a truth to simulate.
pub const RECIPES: [&str; 4] = ["freeform-mirror", "off-axis-asphere", "biconic", "shallow-wave"];

/// Method that computes the next correction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Way {
    /// Method of Regrind, with a rule for the gain.
    Regrind(GainRule),
    /// Method of a spreadsheet: subtracts the measured deviations from the map, by the nearest point and without a
    /// filter.
    Plain,
}

/// Errors of the machine in addition to the manual settings.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Machine {
    /// Small errors: slides on air or oil, within 0.1 µm over 25 mm, and a cooled spindle.
    #[default]
    Good,
    /// The errors of the recipe.
    AsShipped,
}

/// Truth after one pass, in µm, of the surface relative to its best-fit pose.
#[derive(Clone, Copy, Debug)]
pub struct After {
    /// RMS of the whole error.
    pub rms_um: f64,
    /// RMS of the repeatable error, which comes back in every pass.
    pub repeatable_um: f64,
    /// RMS of the error that this pass added by itself. No correction could have predicted it.
    pub floor_um: f64,
    /// Forecast after the previous pass of the RMS of this pass, its standard deviation, and the RMS that the CMM then
    /// measured.
    pub forecast_um: Option<[f64; 3]>,
}

/// A recipe with everything that a run derives from it.
pub struct Bench {
    /// Name of the recipe.
    pub name: String,
    task: Task,
    plan: CellPlan,
    spec: WorldSpec,
    machine: Machine,
    plan_of: Vec<(Point, Vector)>,
}

impl Bench {
    /// Prepares a shipped recipe on the simulated cell. Its grinder leaves no scallops.
    pub fn new(name: &str) -> Self {
        let recipe = Recipe::read(&root().join(format!("recipes/{name}.toml"))).unwrap();
        let cell = CellConfig::read(&root().join("config/sim.toml")).unwrap();
        let (task, plan) = setup::prepare(&recipe, &cell).unwrap();
        let mut spec: WorldSpec = recipe.simulation.clone().unwrap().try_into().unwrap();
        // No correction can remove the ridges between tracks. The study is about the effect of corrections.
        spec.grinder.scallops = false;
        let plan_of = task.targets.iter().map(|t| (t.point, t.normal)).collect();
        Self { name: name.to_owned(), task, plan, spec, machine: Machine::default(), plan_of }
    }

    /// Makes one part after another in its own world. Returns the truth after every pass, for each part.
    ///
    /// A second part starts from the state that was learned on the first.
    pub fn parts(&self, seed: u64, way: Way, parts: usize, passes: u16) -> Vec<Vec<After>> {
        let spec = WorldSpec { seed, ..self.spec.clone() };
        let twin = random_alone(&spec);
        let (world, twin) = (World::new(spec).unwrap(), World::new(twin).unwrap());
        let mut learned: Option<(Correction, LearningState)> = None;
        (0..parts)
            .map(|part| {
                let mut line = Line::new(self, way, &world, &twin, learned.take(), part as u32 + 1);
                let after = (1..=passes).map(|cycle| line.pass(cycle)).collect();
                learned = line.learned();
                after
            })
            .collect()
    }
}

/// Returns the world with the same random part of every pass and no other error: the residual of the best correction.
fn random_alone(spec: &WorldSpec) -> WorldSpec {
    let grinder = GrinderSpec {
        repeatability_um: spec.grinder.repeatability_um,
        repeatability_correlation_mm: spec.grinder.repeatability_correlation_mm,
        error_copying: spec.grinder.error_copying,
        ..perfect_grinder()
    };
    WorldSpec { grinder, ..spec.clone() }
}

/// Part in progress.
struct Line<'a> {
    bench: &'a Bench,
    way: Way,
    worlds: [&'a World; 2],
    grinders: [Grinder; 2],
    /// Copy of the twin without the random part. The difference between the two is random only, also where a datum
    /// makes the height observable.
    still: Option<(&'a World, Grinder)>,
    job: u32,
    places: Vec<[f64; 2]>,
    correction: Correction,
    known: LearningState,
    before: Option<(Correction, ErrorMap)>,
    forecast: Option<[f64; 2]>,
    /// Parameters that were estimated after the first pass.
    told: Option<ParameterEstimation>,
}

impl<'a> Line<'a> {
    fn new(
        bench: &'a Bench,
        way: Way,
        world: &'a World,
        twin: &'a World,
        learned: Option<(Correction, LearningState)>,
        job: u32,
    ) -> Self {
        let task = &bench.task;
        let corners = [[task.pass.x_mm[0], task.pass.y_mm[0]], [task.pass.x_mm[1], task.pass.y_mm[1]]];
        let grid = Grid::over(corners.into_iter(), task.map_options.spacing_mm).unwrap();
        let size_mm = [corners[1][0] - corners[0][0], corners[1][1] - corners[0][1]];
        let rule = if let Way::Regrind(rule) = way { rule } else { GainRule::Fixed(1.0) };
        let none = Correction::zero(grid, task.correction_limits.allowance_mm);
        let (correction, known) = match learned {
            Some((correction, known)) => {
                (Correction { values_mm: correction.values_mm, ..none }, known.for_next_part())
            }
            None => (none, LearningState::new(rule, &task.map_options, size_mm, task.repeatability_mm)),
        };
        if job > 1 {
            world.load_blank();
            twin.load_blank();
        }
        let places = bench.plan_of.iter().map(|(p, _)| [p.x, p.y]).collect();
        let (worlds, grinders) = ([world, twin], [world.grinder(), twin.grinder()]);
        let (still, before, forecast, told) = (None, None, None, None);
        Self { bench, way, worlds, grinders, still, job, places, correction, known, before, forecast, told }
    }

    /// Grinds and measures once, and computes the correction of the next pass.
    fn pass(&mut self, cycle: u16) -> After {
        let level_mm = self.correction.level_mm;
        let map = self.payload();
        let flat = Map { values_mm: vec![0.0; map.values_mm.len()], ..map.clone() };
        let [real, twin] = &mut self.grinders;
        let set = self.correction.parameters.as_ref();
        let wheel_radius_mm = self.bench.task.wheel_radius_mm(set);
        let told = Pass { wheel_radius_mm, ..pass_of(&self.bench.task, level_mm) };
        grind(real, self.job, cycle, &map, &told);
        grind(twin, self.job, cycle, &flat, &pass_of(&self.bench.task, level_mm));
        if let Some((_, still)) = &mut self.still {
            grind(still, self.job, cycle, &flat, &pass_of(&self.bench.task, level_mm));
        }
        let left = |world: &World| {
            let deviations: Vec<f64> = world.deviations_mm(&self.places).iter().map(|d| d - level_mm).collect();
            self.without_motion(&deviations)
        };
        let [whole, mut alone] = self.worlds.map(left);
        if let Some((still, _)) = &self.still {
            alone.iter_mut().zip(left(still)).for_each(|(of, still)| *of -= still);
        }
        let difference: Vec<f64> = whole.iter().zip(&alone).map(|(a, b)| a - b).collect();
        let found = self.register(level_mm);
        let seen_um = 1e3 * found.quality.rms_mm;
        let after = After {
            rms_um: rms_um(&whole),
            repeatable_um: rms_um(&self.without_motion(&difference)),
            floor_um: rms_um(&alone),
            forecast_um: self.forecast.map(|[rms, sigma]| [rms, sigma, seen_um]),
        };
        self.correct(&found);
        after
    }

    fn payload(&self) -> Map {
        let Grid { columns, rows, first_mm, spacing_mm } = self.correction.grid;
        Map {
            columns: columns as u32,
            rows: rows as u32,
            first_mm,
            spacing_mm,
            nominal: [7; 32],
            values_mm: self.correction.map_mm().into_owned(),
        }
    }

    /// Touches the part where the recipe says, and registers the measured points.
    fn register(&self, level_mm: f64) -> Registration {
        let all: Vec<usize> = (0..self.bench.plan_of.len()).collect();
        let (touched, _) = self.touch(level_mm, &all);
        let points: Vec<Point> = touched.into_iter().map(|(_, point)| point).collect();
        self.registered(&points, level_mm)
    }

    /// Touches some of the targets. Returns the points that were found, and the duration in seconds.
    fn touch(&self, level_mm: f64, chosen: &[usize]) -> (Vec<(usize, Point)>, f64) {
        let task = &self.bench.task;
        let target = |(index, k): (usize, &usize)| {
            let (p, n) = self.bench.plan_of[*k];
            let at = task.fixture_cmm_from_model.transform_point(&(p + level_mm * n));
            let normal = task.fixture_cmm_from_model.transform_direction(&n);
            Target { index: index as u32, feature: Feature::Part, point_mm: at.into(), normal: normal.into() }
        };
        let plan = Plan {
            probe_radius_mm: task.probing.probe_radius_mm,
            approach_mm: task.probing.approach_mm,
            search_mm: task.probing.search_mm,
            speed_mm_s: task.probing.speed_mm_s,
            safe_height_mm: task.probing.safe_height_mm,
            careful: (0, 0.0),
            targets: chosen.iter().enumerate().map(target).collect(),
        };
        let (records, took_s) = touched_in(self.worlds[0], self.job, &plan);
        let found = records.iter().filter(|r| r.status == Status::Touched);
        (found.map(|r| (chosen[r.index as usize], Point::from(r.position_mm))).collect(), took_s)
    }

    fn registered(&self, points: &[Point], level_mm: f64) -> Registration {
        let task = &self.bench.task;
        // The true radius, as the reference sphere gives it in a run.
        let true_radius_mm = task.probing.probe_radius_mm + 1e-3 * self.bench.spec.cmm.probe_radius_error_um;
        task.register(points, true_radius_mm + level_mm).unwrap().0
    }

    /// Computes the next correction from the registration.
    fn correct(&mut self, found: &Registration) {
        let error = self.error(found);
        self.correct_by(found, error);
    }

    fn error(&self, found: &Registration) -> ErrorMap {
        let task = &self.bench.task;
        let used = || found.deviations.iter().filter(|d| d.status == PointStatus::Inlier);
        let readings: Vec<DeviationSample> = used()
            .map(|d| DeviationSample { place_mm: [d.point.x, d.point.y], deviation_mm: d.deviation_mm })
            .collect();
        match self.way {
            Way::Regrind(_) => error_map(&readings, &task.map_options).unwrap(),
            Way::Plain => unfiltered(&readings, &task.map_options),
        }
    }

    fn correct_by(&mut self, found: &Registration, error: ErrorMap) {
        let task = &self.bench.task;
        let used = found.deviations.iter().filter(|d| d.status == PointStatus::Inlier);
        let places: Vec<(Point, Vector)> = used.map(|d| (d.point, d.normal)).collect();
        let answer = self.before.as_ref().map(|(correction, earlier)| {
            let scatter_mm = earlier.point_sigma_mm.hypot(error.point_sigma_mm);
            estimate_response([earlier, &error], [correction, &self.correction], &places, scatter_mm)
        });
        let answer = answer.filter(|_| self.way != Way::Plain);
        let (contacts, set) = self.estimate_parameters(found);
        let options = task.parameter_options(self.correction.parameters.as_ref());
        let grid = self.correction.grid;
        let smoother = task.parameter_compensation.as_ref().map(|taken| {
            move |values: &[f64]| explained_by_parameters(values, &grid, [&contacts, &taken.node_points], &options)
        });
        let smooth = smoother.as_ref().map(|smoother| smoother as ParameterExplainer<'_>);
        let seen = PassObservation { correction: &self.correction, error: &error, response: answer, explained: smooth };
        self.known = self.known.updated(&seen);
        let forecast = self.known.forecast(&error, 0.0);
        self.forecast = Some([1e3 * forecast.rms_mm, 1e3 * forecast.sigma_mm]);
        let next = match self.correction.next_pass(&error, &self.known, set.as_ref(), &task.correction_limits) {
            Ok(step) => step.correction,
            // The study goes on where the material budget of a recipe would be spent. Here only the form counts.
            Err(NextPassError::BudgetSpent { .. }) => {
                let changed = self.correction.compensating(&self.known, set.as_ref());
                Correction {
                    level_mm: changed.level_mm - task.correction_limits.depth_of_cut_mm,
                    cycle: changed.cycle + 1,
                    ..changed
                }
            }
            Err(error) => panic!("{}: {error}", self.bench.name),
        };
        self.before = Some((std::mem::replace(&mut self.correction, next), error));
    }

    /// Estimates the parameters after the first pass, as a run does. Returns the contacts, and the parameter
    /// corrections that the next pass uses.
    fn estimate_parameters(&mut self, found: &Registration) -> (Vec<SurfacePoint>, Option<ParameterCorrections>) {
        let task = &self.bench.task;
        let used = found.deviations.iter().filter(|d| d.status == PointStatus::Inlier);
        let contact = |d: &Deviation| SurfacePoint { point: d.point, normal: d.normal, deviation_mm: d.deviation_mm };
        let contacts: Vec<SurfacePoint> = used.map(contact).collect();
        let before = self.correction.parameters.clone();
        let Some(taken) = task.parameter_compensation.as_ref().filter(|_| self.before.is_none()) else {
            return (contacts, before);
        };
        let options = task.parameter_options(before.as_ref());
        let told = estimate_parameters(&contacts, None, &options).unwrap();
        let mut values = before.map_or([0.0; ParameterKind::COUNT], |set| set.values);
        values.iter_mut().zip(&told.estimates).for_each(|(value, of)| *value += of.compensated);
        let set = ParameterCorrections::from_values(
            values,
            self.correction.cycle + 1,
            [&contacts, &taken.node_points],
            &options,
        );
        self.told = Some(told);
        (contacts, set)
    }

    /// Returns the state from which a next part would start.
    fn learned(&self) -> Option<(Correction, LearningState)> {
        Some((self.correction.clone(), self.known.clone()))
    }

    /// Returns the deviations at the positions without the component that a rigid motion of the part can explain.
    fn without_motion(&self, deviations_mm: &[f64]) -> Vec<f64> {
        let size = 50.0;
        let row = |(p, n): &(Point, Vector)| {
            let turn = p.coords.cross(n) / size;
            let row = nalgebra::Vector6::new(n.x, n.y, n.z, turn.x, turn.y, turn.z);
            row.map_with_location(|k, _, v| if self.bench.task.registration_options.locked[k] { 0.0 } else { v })
        };
        let rows: Vec<_> = self.bench.plan_of.iter().map(row).collect();
        let gram: nalgebra::Matrix6<f64> = rows.iter().map(|row| row * row.transpose()).sum();
        let right: nalgebra::Vector6<f64> = rows.iter().zip(deviations_mm).map(|(row, d)| row * *d).sum();
        let parts = gram.symmetric_eigen();
        let least = 1e-9 * parts.eigenvalues.max();
        let motion: nalgebra::Vector6<f64> = (0..6)
            .filter(|&k| parts.eigenvalues[k] > least)
            .map(|k| {
                let v = parts.eigenvectors.column(k);
                v * (v.dot(&right) / parts.eigenvalues[k])
            })
            .sum();
        rows.iter().zip(deviations_mm).map(|(row, d)| d - row.dot(&motion)).collect()
    }
}

fn pass_of(task: &Task, level_mm: f64) -> Pass {
    Pass {
        spark_out: task.pass.spark_out_passes,
        wheel_radius_mm: task.pass.wheel_radius_mm,
        feed_mm_min: task.pass.feed_mm_min,
        track_spacing_mm: task.pass.track_spacing_mm,
        level_mm,
        depth_of_cut_mm: task.pass.depth_of_cut_mm,
        extent_mm: [task.pass.x_mm[0], task.pass.x_mm[1], task.pass.y_mm[0], task.pass.y_mm[1]],
        nominal: [7; 32],
    }
}

/// Measures a part by a plan.
pub fn touch(world: &World, job: u32, plan: &Plan) -> Vec<PointRecord> {
    touched_in(world, job, plan).0
}

/// Measures a part by a plan. Also returns the duration in seconds.
fn touched_in(world: &World, job: u32, plan: &Plan) -> (Vec<PointRecord>, f64) {
    let mut cmm = world.cmm();
    let payload = Payload { bytes: plan.encode(), identity: [1; 32] };
    cmm.prepare(job, 0, &Payloads { plan: Some(payload), ..Payloads::default() }).unwrap();
    cmm.begin();
    while !cmm.advance(1000.0).finished {}
    let outcome = cmm.end_job(1);
    let records = decode_points(&outcome.bytes, (outcome.format == 2).then_some(outcome.scale_mm)).unwrap();
    (records, outcome.duration_s)
}

/// Grinds a part once, by a map.
pub fn grind(grinder: &mut Grinder, job: u32, cycle: u16, map: &Map, pass: &Pass) {
    let payload = |bytes: Vec<u8>, kind: u8| Some(Payload { bytes, identity: [kind; 32] });
    let payloads = Payloads { plan: None, map: payload(map.encode(), 2), pass: payload(pass.encode(), 3) };
    grinder.prepare(job, cycle, &payloads).unwrap();
    grinder.begin();
    loop {
        let progress = grinder.advance(1000.0);
        assert_eq!(progress.fault, 0);
        if progress.finished {
            break;
        }
    }
    grinder.end_job(1);
}

/// Returns the measured deviations as a map, by the nearest point.
fn unfiltered(readings: &[DeviationSample], options: &MapOptions) -> ErrorMap {
    let grid = Grid::over(readings.iter().map(|r| r.place_mm), options.spacing_mm).unwrap();
    let nearest = |[x, y]: [f64; 2]| {
        let distance = |r: &&DeviationSample| (r.place_mm[0] - x).powi(2) + (r.place_mm[1] - y).powi(2);
        readings.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap().deviation_mm
    };
    let values_mm = (0..grid.len()).map(|k| nearest(grid.place_mm(k))).collect();
    ErrorMap { nodes: GridMap::all_valid(grid, values_mm), ..error_map(readings, options).unwrap() }
}

fn rms_um(values_mm: &[f64]) -> f64 {
    1e3 * rms(values_mm)
}
