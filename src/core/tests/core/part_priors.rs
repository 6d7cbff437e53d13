//! Effect of the priors from earlier parts on simulated parts with few measured points.

use nalgebra::{DMatrix, DVector};
use rand::SeedableRng;
use rand::rngs::StdRng;
use regrind_testutils::sample::seeds;

use crate::common::{RADIUS_MM, free_form, normal, placed, points, pose};
use regrind_core::geometry::{Point, Vector};
use regrind_core::model::{
    Field, Form, Hyperparameters, ModelInputs, Observations, PartFit, PartPriors, Prior, farthest_points,
};
use regrind_core::registration::{Registration, RegistrationOptions, Start, register};
use regrind_figures::Interval;
use regrind_sim::form::FormError;
use regrind_sim::probe::Placement;
use regrind_sim::shape::{FreeForm, Shape};

const NOISE_MM: f64 = 3e-4;
const TOUCHES: usize = 45;

/// Part with a pattern of 22 by 14 targets, and the registration of its measured points.
struct Part {
    targets: Vec<(Point, Vector)>,
    form: FormError,
    registration: Registration,
}

impl Part {
    fn new(seed: u64, length_mm: f64, rms_mm: f64) -> Self {
        let shape = FreeForm::default();
        let places = (0..22 * 14).map(|k| [f64::from(k % 22) / 21.0, f64::from(k / 22) / 13.0]);
        let on_part = |[x, y]: [f64; 2]| {
            let [p, q] = shape.gradient(x, y);
            (Point::new(x, y, shape.height(x, y)), Vector::new(-p, -q, 1.0).normalize())
        };
        let targets: Vec<_> = places.map(|[u, v]| on_part([96.0 * u - 48.0, 56.0 * v - 28.0])).collect();
        let form = FormError::with_rms(&mut regrind_sim::rng(seed), length_mm, rms_mm);
        let placement = Placement::new([1.0, -2.0, 0.5], [0.3, -0.2, 0.5]);
        let mut rng = StdRng::seed_from_u64(seed);
        let mut centre = |k: usize| {
            let (at, n) = targets[k];
            let c = at + (RADIUS_MM + form.height(at.x, at.y)) * n;
            [c.x, c.y, c.z].map(|v| v + NOISE_MM * normal(&mut rng))
        };
        let touched: Vec<[f64; 3]> = farthest_points(&targets, TOUCHES).into_iter().map(&mut centre).collect();
        let options =
            RegistrationOptions { start: Start::Pose(pose(&placement)), ..RegistrationOptions::new(RADIUS_MM) };
        let found = register(&free_form(205, 125), &points(&placed(&placement, &touched)), &options).unwrap();
        Self { targets, form, registration: found }
    }

    fn model(&self, lesson: Option<PartFit>) -> Form {
        Form::estimate_at(&self.registration, &inputs_with_prior(lesson), &self.targets).unwrap()
    }

    /// Returns RMS and PV of the true form at all targets, after its own best fit.
    fn truth(&self) -> [f64; 2] {
        let rows = DMatrix::from_fn(self.targets.len(), 6, |r, c| {
            let (at, n) = self.targets[r];
            let arm = at.coords.cross(&n) / 30.0;
            [n.x, n.y, n.z, arm.x, arm.y, arm.z][c]
        });
        let form = DVector::from_fn(self.targets.len(), |r, _| {
            let at = self.targets[r].0;
            self.form.height(at.x, at.y)
        });
        let base = rows.qr().q();
        let left = &form - &base * base.tr_mul(&form);
        [(left.norm_squared() / left.len() as f64).sqrt(), left.max() - left.min()]
    }
}

fn inputs_with_prior(lesson: Option<PartFit>) -> ModelInputs {
    let priors = lesson.map(|lesson| lesson.prior());
    ModelInputs { prior: priors, probe_noise_mm: [NOISE_MM, 0.15], ..ModelInputs::default() }
}

fn parts() -> u64 {
    seeds(5)
}

/// Counts the parts whose RMS and PV intervals cover the truth.
/// Returns both counts, and the mean width of both intervals relative to the true values.
fn coverage(length_mm: f64, rms_mm: f64, lesson: Option<PartFit>) -> ([u64; 2], [f64; 2]) {
    let (mut held, mut wide) = ([0; 2], [0.0; 2]);
    for seed in 0..parts() {
        let part = Part::new(1000 + seed, length_mm, rms_mm);
        let figures = part.model(lesson).figures;
        let of = |interval: Interval, truth: f64| {
            (
                u64::from((interval.low_mm..=interval.high_mm).contains(&truth)),
                (interval.high_mm - interval.low_mm) / truth,
            )
        };
        for (k, (interval, truth)) in [figures.rms, figures.pv].into_iter().zip(part.truth()).enumerate() {
            let (is_held, width) = of(interval, truth);
            held[k] += is_held;
            wide[k] += width / parts() as f64;
        }
    }
    (held, wide)
}

fn hyperparameters(range_mm: f64, ratio: f64) -> Hyperparameters {
    Hyperparameters { field: Field::new(2e-3, range_mm), noise_sigma_mm: 2e-3 * ratio, noise_autocorrelation: 0.0 }
}

/// Simulates a field at 50 places of a part of 102 x 62 mm. The offset and the tilt are unknown to the model.
fn simulated(hyperparameters: &Hyperparameters, seed: u64) -> Observations {
    let places: Vec<[f64; 2]> = (0..50)
        .map(|k| f64::from(k) + 0.5)
        .map(|k| [(0.754_877_666 * k).fract() * 102.0, (0.569_840_291 * k).fract() * 62.0])
        .collect();
    let n = places.len();
    let covariance = DMatrix::from_fn(n, n, |r, c| {
        hyperparameters.field.covariance_mm2(places[r], places[c])
            + if r == c { hyperparameters.noise_sigma_mm.powi(2) } else { 0.0 }
    });
    let mut rng = StdRng::seed_from_u64(seed);
    let deviations = covariance.cholesky().unwrap().l() * DVector::from_fn(n, |_, _| normal(&mut rng));
    let effects = DMatrix::from_fn(n, 3, |r, c| [1.0, places[r][0], places[r][1]][c]);
    Observations {
        fixed_effects: effects,
        ..Observations::without_effects(places, deviations.iter().copied().collect())
    }
}

#[test]
fn part_priors_improve_few_points() {
    let mut gains = Vec::new();
    for planted in [hyperparameters(30.0, 0.1), hyperparameters(20.0, 0.3)] {
        let every = Prior::for_size(102.0 / 3.0);
        let mut taught = PartPriors::default();
        (0..6).for_each(|seed| {
            taught.update(true, &Hyperparameters::estimate(&simulated(&planted, seed), Some(&every)).unwrap())
        });
        let lesson = taught.fit(true).unwrap();
        let off = |priors: &Prior| {
            let of = |seed: u64| {
                let found = Hyperparameters::estimate(&simulated(&planted, 100 + seed), Some(priors)).unwrap();
                let ratio =
                    |hyperparameters: &Hyperparameters| hyperparameters.noise_sigma_mm / hyperparameters.field.sigma_mm;
                let off = [found.field.range_mm / planted.field.range_mm, ratio(&found) / ratio(&planted)];
                off.map(|off| off.ln().powi(2))
            };
            let all: Vec<[f64; 2]> = (0..16).map(of).collect();
            [0, 1].map(|k| (all.iter().map(|off| off[k]).sum::<f64>() / 16.0).sqrt())
        };
        let (untaught, told) = (off(&every), off(&lesson.prior()));
        println!("{lesson:?}: off by {told:.2?} of their logarithms, untaught by {untaught:.2?}");
        // A range that is no wider than the points are apart is told by neither.
        assert!(told[0] < 1.05 * untaught[0] && told[1] < 0.95 * untaught[1], "{told:?} {untaught:?}");
        gains.push(told[1] / untaught[1]);
    }
    assert!(gains.iter().sum::<f64>() < 0.8 * gains.len() as f64, "{gains:?}");
}

#[test]
#[ignore = "worlds are drawn, for .ci/long"]
fn part_priors_preserve_coverage() {
    // Four parts of a recipe teach; those that follow are like them.
    let mut taught = PartPriors::default();
    for seed in 0..4 {
        let part = Part::new(seed, 15.0, 2e-3);
        if let Some(field) =
            Form::estimate(&part.registration, &inputs_with_prior(None)).unwrap().hyperparameters_without_prior
        {
            taught.update(true, &field);
        }
    }
    let lesson = taught.fit(true);
    let ((plain, wide), (held, narrow)) = (coverage(15.0, 2e-3, None), coverage(15.0, 2e-3, lesson));
    println!("{lesson:?}: held {held:?} of {}, {narrow:.3?} wide; untaught {plain:?}, {wide:.3?}", parts());
    assert!(held.iter().zip(plain).all(|(held, plain)| held + 1 >= plain.min(parts() - 1)), "{held:?} {plain:?}");
    assert!((0..2).all(|k| narrow[k] < 1.05 * wide[k]), "{narrow:?} {wide:?}");
}

#[test]
#[ignore = "worlds are drawn, for .ci/long"]
fn unlike_part_overrides_priors() {
    // Twenty parts have taught that a form is narrow and next to the scatter; this one is wide and strong, and the
    // other way round.
    let many = |range_mm: f64, ratio: f64| {
        (0..20).fold(None, |lesson, _| Some(PartFit::updated(lesson, &hyperparameters(range_mm, ratio))))
    };
    for (length_mm, rms_mm, lesson) in [(30.0, 5e-3, many(8.0, 1.0)), (15.0, 1e-3, many(200.0, 0.01))] {
        let ((plain, wide), (held, narrow)) = (coverage(length_mm, rms_mm, None), coverage(length_mm, rms_mm, lesson));
        println!("{lesson:?}: held {held:?} of {}, {narrow:.3?} wide; untaught {plain:?}, {wide:.3?}", parts());
        // Among many parts, some are held by one of the two alone.
        let slack = 1.max(3 * parts() / 100);
        let is_as_good = |(held, plain): (&u64, u64)| held + slack >= plain.min(parts() - 1);
        assert!(held.iter().zip(plain).all(is_as_good), "{held:?} {plain:?}");
    }
}
