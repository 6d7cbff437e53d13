//! Learning of the repeatable error of a grinder over many simulated worlds.
//! The remaining error falls to the noise of the mean, and the state estimates the noise.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use regrind_core::compensation::{Correction, ErrorMap, GainRule, LearningState, MapOptions, PassObservation};
use regrind_core::geometry::Grid;
use regrind_figures::statistics::rms;

const GRID: Grid = Grid { columns: 41, rows: 31, first_mm: [-20.0, -15.0], spacing_mm: [1.0, 1.0] };
const NOISE_MM: f64 = 1e-3;
const SEED: u64 = 20_260;
const WORLDS: u64 = 40;

/// Returns a sum of waves of 6 to 40 mm with random directions and phases.
fn random_waves(random: &mut StdRng, rms_mm: f64) -> Vec<f64> {
    let waves: Vec<[f64; 3]> = (0..40)
        .map(|_| {
            let turn = random.random_range(0.0..std::f64::consts::TAU);
            let number = std::f64::consts::TAU / random.random_range(6.0..40.0);
            [number * f64::cos(turn), number * f64::sin(turn), random.random_range(0.0..std::f64::consts::TAU)]
        })
        .collect();
    let at = |[x, y]: [f64; 2]| waves.iter().map(|[a, b, phase]| (a * x + b * y + phase).sin()).sum::<f64>();
    (0..GRID.len()).map(|k| at(GRID.place_mm(k)) * rms_mm * (2.0f64 / 40.0).sqrt()).collect()
}

#[test]
fn learning_error_falls_as_sqrt_passes() {
    // k passes leave N / sqrt(k) of an error that stands far above N; and N itself is told.
    for rule in [GainRule::Wavelength, GainRule::Adaptive] {
        let (mut left, mut told) = ([0.0; 6], 0.0);
        for world in 0..WORLDS {
            let mut random = StdRng::seed_from_u64(SEED + world);
            let form = random_waves(&mut random, 0.02);
            let mut known = LearningState::new(rule, &MapOptions::new(2.5, 1.0), [40.0, 30.0], None);
            let mut correction = Correction::zero(GRID, 0.0);
            for left in &mut left {
                let scatter = random_waves(&mut random, NOISE_MM);
                let sum = |k: usize| form[k] + correction.values_mm[k] + scatter[k];
                let error = ErrorMap::exact(GRID, (0..GRID.len()).map(sum).collect(), vec![true; GRID.len()]);
                known = known.updated(&PassObservation {
                    correction: &correction,
                    error: &error,
                    response: None,
                    explained: None,
                });
                correction = correction.compensating(&known, None);
                let rest: Vec<f64> = form.iter().zip(&correction.values_mm).map(|(r, u)| r + u).collect();
                *left += rms(&rest).powi(2) / WORLDS as f64;
            }
            told += known.repeatability_mm().expect("six passes tell it") / WORLDS as f64;
        }
        for (k, left) in (1..).zip(left) {
            let found = left.sqrt() / (NOISE_MM / f64::from(k).sqrt());
            assert!((found - 1.0).abs() < 0.1, "{rule:?}: {k} passes leave {found} of N / sqrt(k), seed {SEED}");
        }
        assert!((told / NOISE_MM - 1.0).abs() < 0.1, "{rule:?}: {told}, seed {SEED}");
    }
}
