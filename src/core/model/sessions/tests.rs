use nalgebra::{DMatrix, DVector};

use super::super::random_normals::NormalGenerator;
use super::*;

const COMMON: Hyperparameters =
    Hyperparameters { field: Field::new(5e-3, 40.0), noise_sigma_mm: 1e-3, noise_autocorrelation: 0.0 };
const SESSION_FIELD: Field = Field::new(4e-3, 150.0);
const POINTS_PER_SESSION: usize = 40;

/// Simulates measurements of one part of 102 x 62 mm in several sessions. Each session has 40 points and an additional
/// random field with the standard deviation `own_mm`. `known` and `unseen` are the numbers of sessions in the two
/// groups. Returns the known sessions, then the unseen sessions.
fn planted(own_mm: f64, known: u32, unseen: u32, seed: u64) -> [Sessions; 2] {
    let n = POINTS_PER_SESSION * (known + unseen) as usize;
    let places: Vec<[f64; 2]> = (0..n)
        .map(|k| k as f64 + 0.5)
        .map(|k| [(0.754_877_666 * k).fract() * 102.0, (0.569_840_291 * k).fract() * 62.0])
        .collect();
    let session = |k: usize| (k / POINTS_PER_SESSION) as u32;
    let own = Field { sigma_mm: own_mm, ..SESSION_FIELD };
    let covariance = DMatrix::from_fn(n, n, |r, c| {
        let of_session = if session(r) == session(c) { own.covariance_mm2(places[r], places[c]) } else { 0.0 };
        COMMON.field.covariance_mm2(places[r], places[c]) + of_session + if r == c { 1e-13 } else { 0.0 }
    });
    let mut normals = NormalGenerator::new(seed, 0);
    let field = covariance.cholesky().unwrap().l() * DVector::from_fn(n, |_, _| normals.next());
    let found: Vec<f64> = field.iter().map(|f| f + COMMON.noise_sigma_mm * normals.next()).collect();
    let of = |sessions: std::ops::Range<u32>| {
        let parts: Vec<Observations> = sessions.clone().map(|s| fitted(&places, &found, s as usize)).collect();
        let numbers = sessions.flat_map(|s| [s; POINTS_PER_SESSION]).collect();
        Sessions::new(joined(&parts), numbers).unwrap()
    };
    [of(0..known), of(known..known + unseen)]
}

/// Returns the observations of one session. A best fit of height and two tilts is subtracted from its deviations.
/// `places` and `found` have the positions and the deviations of all sessions, in mm. `session` is the index of the
/// session.
fn fitted(places: &[[f64; 2]], found: &[f64], session: usize) -> Observations {
    let rows = session * POINTS_PER_SESSION..(session + 1) * POINTS_PER_SESSION;
    let (places, found) = (&places[rows.clone()], &found[rows]);
    let effects = DMatrix::from_fn(POINTS_PER_SESSION, 3, |r, c| [1.0, places[r][0], places[r][1]][c]);
    let left = BestFitBasis::new(&effects).after_best_fit(found);
    Observations { fixed_effects: effects, ..Observations::without_effects(places.to_vec(), left) }
}

/// Returns the share (0 to 1) of the deviations of the unseen sessions that lie within their 95 % prediction intervals.
/// The intervals are predicted from the known sessions. `between` has the hyperparameters of the prediction: those of
/// the common field, of the noise, and of the field of a session.
fn within(between: &BetweenSessionVariance, [known, unseen]: &[Sessions; 2]) -> f64 {
    let told = between.predict(known, unseen).unwrap();
    let hit = told.iter().zip(unseen.deviations_mm());
    hit.filter(|(told, found)| (*found - told.mean_mm).abs() <= told.half_width_mm()).count() as f64 / told.len() as f64
}

#[test]
fn between_session_variance_recovered() {
    const PARTS: u32 = 12;
    let (mut strength, mut scatter, mut covered) = (0.0, 0.0, 0.0);
    for seed in 0..PARTS {
        let sessions = planted(SESSION_FIELD.sigma_mm, 6, 2, u64::from(seed));
        let between = sessions[0].between_session_variance(&Prior::for_size(102.0)).unwrap();
        // Each session is after its best fit: only strength and range together determine what remains of its field.
        let bent = |field: Field| field.sigma_mm / field.range_mm.powi(2);
        strength += (bent(between.session_field) / bent(SESSION_FIELD)).ln() / f64::from(PARTS);
        scatter += (between.hyperparameters.noise_sigma_mm / COMMON.noise_sigma_mm).ln() / f64::from(PARTS);
        covered += within(&between, &sessions) / f64::from(PARTS);
    }
    assert!(strength.abs() < 0.4 && scatter.abs() < 0.2, "{strength} {scatter}");
    assert!((0.93..=0.97).contains(&covered), "{covered}");
}

#[test]
fn between_session_variance_near_zero() {
    let sessions = planted(1e-12, 5, 1, 3);
    let between = sessions[0].between_session_variance(&Prior::for_size(102.0)).unwrap();
    let own = between.predict(&sessions[0], &sessions[1]).unwrap();
    let sure = BetweenSessionVariance { session_field: Field { sigma_mm: 1e-12, ..between.session_field }, ..between };
    let none = sure.predict(&sessions[0], &sessions[1]).unwrap();
    let mean = |of: &[PredictionInterval]| of.iter().map(|f| f.sigma_mm).sum::<f64>() / of.len() as f64;
    assert!(mean(&own) < 1.2 * mean(&none), "{} {}", mean(&own), mean(&none));
}

#[test]
fn session_prediction_by_hand() {
    // By hand: common variance 4, session variance 1, noise variance 0.25, and two sessions with a point each at one
    // place. So K = 4 + 1.25 I, mean = 4 (d1 + d2) / 9.25.
    let one = |deviations: Vec<f64>, of: Vec<u32>| {
        Sessions::new(Observations::without_effects(vec![[1.0, 2.0]; deviations.len()], deviations), of).unwrap()
    };
    let own_u = 0.25;
    let between = BetweenSessionVariance {
        hyperparameters: Hyperparameters {
            field: Field::new(2.0, 20.0),
            noise_sigma_mm: 0.5,
            noise_autocorrelation: 0.0,
        },
        session_field: Field::new(1.0, 20.0),
        session_log_sigma_u: own_u,
        sessions: 2,
    };
    let known = one(vec![3.0, 1.0], vec![0, 1]);
    let told = between.predict(&known, &one(vec![0.0], vec![0])).unwrap()[0];
    let variance = 4.0 - 2.0 * 16.0 / 9.25 + 1.0 + 0.25;
    assert!((told.mean_mm - 16.0 / 9.25).abs() < 1e-13 && (told.sigma_mm.powi(2) - variance).abs() < 1e-13, "{told:?}");
    assert!((told.degrees_of_freedom - 2.0 * (variance / (2.0 * own_u)).powi(2)).abs() < 1e-9, "{told:?}");
    // In a single session the same two points have less information: K = 5 + 0.25 I.
    let together = between.predict(&one(vec![3.0, 1.0], vec![0, 0]), &one(vec![0.0], vec![0])).unwrap()[0];
    assert!((together.mean_mm - 16.0 / 10.25).abs() < 1e-13, "{together:?}");
}

#[test]
fn sessions_refuse_mismatch() {
    let points = || Observations::without_effects(vec![[0.0; 2], [9.0, 1.0]], vec![1.0, 2.0]);
    let odd = Sessions::new(points(), vec![1]).err().unwrap().to_string();
    assert_eq!(odd, "2 points and 1 session numbers do not match; give one session number for each point");
    let one =
        Sessions::new(points(), vec![4, 4]).unwrap().between_session_variance(&Prior::for_size(10.0)).err().unwrap();
    assert!(one.to_string().contains("1 session; at least 2 are required"), "{one}");
}
