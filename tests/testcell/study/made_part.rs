//! Whole parts, ground and measured until they are accepted: with the whole pattern, or with touches that are chosen
//! batch by batch.

use crate::payloads::Encode;
use regrind::cell::PvPoints;
use regrind::compensation::{GainRule, map_from_model};
use regrind::drive::AdaptiveOptions;
use regrind::figures::FormFigures;
use regrind::geometry::{DeviationSample, Point, Vector};
use regrind::model::{self, FIRST_BATCH, Form, FormPoint, MIN_TOUCHES, ModelInputs, PartialMeasurement};
use regrind::registration::Registration;
use regrind_sim::body::{Payload, Payloads, Physics};
use regrind_sim::spec::WorldSpec;
use regrind_sim::world::World;

use super::{Bench, Line, Way};

/// How a part is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Measured {
    /// All targets of the recipe.
    Whole,
    /// Targets with the most information, until the stopping rule ends the measurement.
    Chosen,
}

/// Result of a part.
#[derive(Clone, Debug, Default)]
pub struct Made {
    /// Number of passes.
    pub passes: u32,
    /// Number of touches in all passes.
    pub touches: usize,
    /// Duration of all measurements.
    pub touching_s: f64,
    /// Duration of all passes.
    pub grinding_s: f64,
    /// True if the part was accepted.
    pub accepted: bool,
    /// RMS and PV of the truth after the last pass, at the targets, in µm, relative to its own best-fit pose.
    pub truth_um: [f64; 2],
    /// True if the truth is within the limits.
    pub conforms: bool,
    /// Number of touches after each pass, with the reason why they ended.
    pub told: Vec<String>,
}

impl Bench {
    /// Returns a recipe as shipped, whose grinder leaves scallops.
    pub fn as_shipped(name: &str) -> Self {
        let mut bench = Self::new(name);
        bench.spec.grinder.scallops = true;
        bench
    }

    /// Returns the same recipe with its limits multiplied by `times`.
    pub fn with_limits(mut self, times: f64) -> Self {
        self.plan.tolerance.pv_mm *= times;
        self.plan.tolerance.rms_mm *= times;
        self
    }

    /// Makes a part in its own world.
    pub fn make(&self, seed: u64, measured: Measured) -> Made {
        let world = World::new(WorldSpec { seed, ..self.spec.clone() }).unwrap();
        let mut line = Line::new(self, Way::Regrind(GainRule::Adaptive), &world, &world, None, 1);
        let mut made = Made::default();
        for cycle in 1..=self.plan.max_cycles {
            let level_mm = line.correction.level_mm;
            made.passes = cycle;
            made.grinding_s += line.ground(cycle as u16);
            let took = line.measured(level_mm, measured, seed, cycle);
            made.touches += took.touches;
            made.touching_s += took.seconds;
            made.told.push(format!("{} {}", took.touches, took.why));
            let deviations: Vec<f64> = world.deviations_mm(&line.places).iter().map(|d| d - level_mm).collect();
            let truth = line.without_motion(&deviations);
            (made.truth_um, made.conforms) = self.truth(&truth);
            if self.accepts(&took.figures) {
                made.accepted = true;
                break;
            }
            line.correct_by(&took.found, took.error);
        }
        made
    }

    /// Returns the limits in mm: with the PV of all points and the PV of most points.
    fn limits_mm(&self) -> [f64; 3] {
        let tolerance = &self.plan.tolerance;
        match tolerance.pv_points {
            PvPoints::All => [tolerance.pv_mm, f64::INFINITY, tolerance.rms_mm],
            PvPoints::MostPoints => [f64::INFINITY, tolerance.pv_mm, tolerance.rms_mm],
        }
    }

    fn accepts(&self, figures: &FormFigures) -> bool {
        let [pv, most, rms] = self.limits_mm();
        figures.pv.high_mm <= pv && figures.pv_998.high_mm <= most && figures.rms.high_mm <= rms
    }

    fn truth(&self, truth_mm: &[f64]) -> ([f64; 2], bool) {
        let mut sorted = truth_mm.to_vec();
        sorted.sort_by(f64::total_cmp);
        let (n, out) = (sorted.len(), sorted.len() / 1000);
        let rms = (truth_mm.iter().map(|v| v * v).sum::<f64>() / n as f64).sqrt();
        let [pv, most] = [sorted[n - 1] - sorted[0], sorted[n - 1 - out] - sorted[out]];
        let [pv_limit, max_limit, rms_limit] = self.limits_mm();
        let judged = if max_limit.is_finite() { most } else { pv };
        ([1e3 * rms, 1e3 * judged], pv <= pv_limit && most <= max_limit && rms <= rms_limit)
    }
}

/// Measurement of one pass.
struct Took {
    touches: usize,
    seconds: f64,
    why: String,
    figures: FormFigures,
    found: Registration,
    error: regrind::compensation::ErrorMap,
}

impl Line<'_> {
    /// Grinds one pass and returns its duration in seconds.
    pub(super) fn ground(&mut self, cycle: u16) -> f64 {
        let (map, pass) = (self.payload(), super::pass_of(&self.bench.task, self.correction.level_mm));
        let payload = |bytes: Vec<u8>, kind: u8| Some(Payload { bytes, identity: [kind; 32] });
        let payloads = Payloads { plan: None, map: payload(map.encode(), 2), pass: payload(pass.encode(), 3) };
        let grinder = &mut self.grinders[0];
        grinder.prepare(self.job, cycle, &payloads).unwrap();
        grinder.begin();
        while !grinder.advance(1000.0).finished {}
        grinder.end_job(1).duration_s
    }

    fn measured(&self, level_mm: f64, measured: Measured, seed: u64, cycle: u32) -> Took {
        match measured {
            Measured::Whole => self.whole(level_mm),
            Measured::Chosen => self.chosen(level_mm, seed, cycle),
        }
    }

    fn whole(&self, level_mm: f64) -> Took {
        let all: Vec<usize> = (0..self.bench.plan_of.len()).collect();
        let (touched, seconds) = self.touch(level_mm, &all);
        let points: Vec<Point> = touched.iter().map(|(_, point)| *point).collect();
        let found = self.registered(&points, level_mm);
        let figures = Form::estimate(&found, &self.given()).unwrap().figures;
        let error = self.error(&found);
        Took { touches: all.len(), seconds, why: String::new(), figures, found, error }
    }

    /// Returns the model inputs, with the probe data from the reference sphere.
    fn given(&self) -> ModelInputs {
        ModelInputs { probe_noise_mm: [1e-3 * self.bench.spec.cmm.noise_um, 0.15], ..ModelInputs::default() }
    }

    fn chosen(&self, level_mm: f64, seed: u64, cycle: u32) -> Took {
        let targets: &[(Point, Vector)] = &self.bench.plan_of;
        let (tolerance, max_cycles) = (self.bench.plan.tolerance, self.bench.plan.max_cycles);
        let adaptive = AdaptiveOptions { tolerance, accepted_risk: 0.025, max_measurements: max_cycles };
        let purpose = adaptive.stopping_criteria(cycle < max_cycles);
        let given = ModelInputs { decision_risk: adaptive.decision_risk(), ..self.given() };
        let mut tried = vec![None; targets.len()];
        let (mut all, mut seconds, mut path) = (Vec::new(), 0.0, Vec::new());
        let mut next = model::short_tour(targets, model::farthest_points(targets, FIRST_BATCH));
        for batch in 0.. {
            let (touched, took_s) = self.touch(level_mm, &next);
            next.iter().for_each(|&k| tried[k] = Some(batch));
            seconds += took_s;
            all.extend(touched);
            let points: Vec<Point> = all.iter().map(|(_, point)| *point).collect();
            let of: Vec<usize> = all.iter().map(|(k, _)| *k).collect();
            if batch == 0 {
                // The gates check these first. Then come enough more points for a useful decision.
                let more: Vec<usize> =
                    model::farthest_points(targets, MIN_TOUCHES).into_iter().filter(|&k| tried[k].is_none()).collect();
                next = model::short_tour(targets, more);
                continue;
            }
            let found = self.registered(&points, level_mm);
            let so_far = PartialMeasurement { targets, tried: &tried, touched: &of };
            let look = model::decide(&found, &given, &so_far, &purpose, seed).unwrap();
            path.push(format!("{}{:?}", all.len(), look.reason));
            if look.next.is_empty() {
                let form = &look.form;
                let of = |p: &FormPoint| {
                    (DeviationSample { place_mm: p.place_mm, deviation_mm: p.form.mean_mm }, p.smooth_sigma_mm)
                };
                let told: Vec<_> = form.points.iter().map(of).collect();
                let error =
                    map_from_model(&told, &self.bench.task.map_options, form.hyperparameters.noise_sigma_mm).unwrap();
                let why = path.join(" ");
                return Took { touches: all.len(), seconds, why, figures: form.figures, found, error };
            }
            next = look.next;
        }
        unreachable!()
    }
}
