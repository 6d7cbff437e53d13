//! Exact posterior for one set of hyperparameters, with the covariance of every pair of points.
//!
//! The covariance of the points is K = k(x_i, x_j) + s^2 R. R is the identity for independent noise. If the noise of
//! the probe is autocorrelated along a path, R is the autocorrelation to the power of the number of steps between two
//! points (an autoregression of the first order).
//!
//! The fixed effects b follow by generalised least squares, b = (H'K^-1 H)^-1 H'K^-1 d, with their columns H and the
//! deviations d. The field follows by kriging (Rasmussen and Williams 2006, 2.7, with a vague prior of b). At a place
//! with the covariances k to the points and the row h of effects, and with r = h - H'K^-1 k:
//!
//! ```text
//!  mean = h'b + k'K^-1 (d - H b)        variance = k(x, x) - k'K^-1 k + r'(H'K^-1 H)^-1 r
//! ```
//!
//! Random effects E are further columns after those of H and have a variance of 1. So 1 is added to the diagonal of
//! their part of H'K^-1 H. This is equivalent to E E' in K.

use faer::linalg::solvers::{Llt, Solve};
use faer::{Mat, Side};
use nalgebra::{DMatrix, DVector};

use super::{Hyperparameters, ModelError, Observations};

/// Prediction of the field at a place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prediction {
    /// Posterior mean of the field, which is also its most probable value.
    pub mean_mm: f64,
    /// Standard uncertainty of the field; it does not contain the noise of a further point.
    pub sigma_mm: f64,
}

/// Posterior of field and effects, given observed points and one set of hyperparameters.
pub struct DensePosterior {
    hyperparameters: Hyperparameters,
    places: Vec<[f64; 2]>,
    factor: Llt<f64>,
    /// Weights K^-1 (d - H b) of the points in the kriging mean.
    weights: Vec<f64>,
    /// Matrix K^-1 H: one row for each point, one column for each effect.
    effects: Mat<f64>,
    /// The estimated effects b, and their covariance.
    estimates: DVector<f64>,
    covariance: DMatrix<f64>,
    likelihood: f64,
}

impl DensePosterior {
    /// Estimates the effects and the field from the observed points, for the given hyperparameters. The method is
    /// generalised least squares for the effects and kriging for the field. The computing time grows with the cube of
    /// the number of points.
    ///
    /// # Errors
    /// Returns an error in each of these cases:
    ///
    /// - The fields of `observed` have different numbers of rows.
    /// - There are not more points than fixed effects.
    /// - A number is not finite, or a hyperparameter is out of range.
    /// - One effect is nearly a combination of others.
    /// - The covariance of the points is not positive definite.
    pub fn fit(observed: &Observations, hyperparameters: Hyperparameters) -> Result<Self, ModelError> {
        Self::with_shared_covariance(observed, hyperparameters, |_, _| 0.0)
    }

    /// Estimates the effects and the field from the observed points, with an additional covariance of these points.
    /// `shared_mm2(a, b)` returns this covariance in mm^2 for the points with the indices `a` and `b`. For example,
    /// points of the same measuring session have a common error.
    ///
    /// The additional covariance applies only to the observed points. [`Self::predict`] predicts the field without it.
    ///
    /// # Errors
    /// Returns the errors of [`Self::fit`].
    pub(super) fn with_shared_covariance(
        observed: &Observations,
        hyperparameters: Hyperparameters,
        shared_mm2: impl Fn(usize, usize) -> f64,
    ) -> Result<Self, ModelError> {
        observed.check()?;
        hyperparameters.check()?;
        let covariance = covariance_mm2(observed, &hyperparameters, shared_mm2);
        let factor = Llt::new(covariance.as_ref(), Side::Lower).map_err(|_| ModelError::NotDefinite)?;
        let Observations { places, deviations_mm, .. } = observed;
        let effects = observed.all_effects();
        let (n, p, vague) = (places.len(), effects.ncols(), observed.fixed_effects.ncols());
        let mut right = Mat::zeros(n, p + 1);
        (0..p).for_each(|c| right.col_as_slice_mut(c).copy_from_slice(effects.column(c).as_slice()));
        right.col_as_slice_mut(p).copy_from_slice(deviations_mm);
        let solved = factor.solve(&right);
        let mut gram = DMatrix::from_fn(p, p, |a, b| dot(right.col_as_slice(a), solved.col_as_slice(b)));
        // The random effects have the prior precision 1, the fixed effects have none.
        (vague..p).for_each(|k| gram[(k, k)] += 1.0);
        let gram = checked_cholesky(gram)?;
        let found = gram.solve(&DVector::from_fn(p, |a, _| dot(right.col_as_slice(a), solved.col_as_slice(p))));
        let mut weights = solved.col_as_slice(p).to_vec();
        for a in 0..p {
            weights.iter_mut().zip(solved.col_as_slice(a)).for_each(|(weight, of)| *weight -= of * found[a]);
        }
        let squares = dot(deviations_mm, &weights);
        let diagonal = factor.L().diagonal();
        let log_det: f64 = 2.0 * (0..n).map(|k| diagonal[k].ln()).sum::<f64>();
        let log_gram: f64 = 2.0 * gram.l_dirty().diagonal().iter().map(|v| v.ln()).sum::<f64>();
        Ok(Self {
            hyperparameters,
            places: places.clone(),
            weights,
            effects: solved.subcols(0, p).to_owned(),
            estimates: found,
            covariance: gram.inverse(),
            likelihood: -0.5 * (log_det + log_gram + squares + (n - vague) as f64 * std::f64::consts::TAU.ln()),
            factor,
        })
    }

    /// Returns the logarithm of the restricted likelihood of the observed deviations: the likelihood integrated over
    /// the fixed effects (Patterson and Thompson 1971). Of two sets of hyperparameters, the one with the higher value
    /// fits better.
    pub fn log_likelihood(&self) -> f64 {
        self.likelihood
    }

    /// Returns the generalised residual sum of squares d'K^-1 (d - H b), without unit. Here d are the deviations in
    /// `observed`, K is their covariance, H has the effects as columns, and b are the estimated effects. `observed`
    /// must be the same as in the fit.
    pub(super) fn whitened_squares(&self, observed: &Observations) -> f64 {
        observed.deviations_mm.iter().zip(&self.weights).map(|(d, w)| d * w).sum()
    }

    /// Returns the estimates of the effects, and the covariance of these estimates. Both have the fixed effects first,
    /// then the random effects. The unit of an estimate is that of its effect.
    ///
    /// The covariance includes the uncertainty due to the unknown field. If the fixed effects are the motions of the
    /// part, their estimates are the pose of the nominal frame of the part.
    pub fn estimated_effects(&self) -> (&DVector<f64>, &DMatrix<f64>) {
        (&self.estimates, &self.covariance)
    }

    /// Predicts the field at each of `places` (x and y in mm). Returns the posterior mean and the standard uncertainty
    /// of each value, in mm. Neither the effects nor the noise of a further measured point are included.
    pub fn predict(&self, places: &[[f64; 2]]) -> Vec<Prediction> {
        let p = self.estimates.len();
        let across = self.hyperparameters.field.pair_covariance().cross_covariance(&self.places, places);
        let solved = self.factor.solve(&across);
        let sigma2 = self.hyperparameters.field.sigma_mm * self.hyperparameters.field.sigma_mm;
        (0..places.len())
            .map(|c| {
                let column = across.col_as_slice(c);
                let mean_mm = dot(column, &self.weights);
                let known = dot(column, solved.col_as_slice(c));
                let moved = DVector::from_fn(p, |a, _| dot(self.effects.col_as_slice(a), column));
                let by_effects = if p == 0 { 0.0 } else { moved.dot(&(&self.covariance * &moved)) };
                Prediction { mean_mm, sigma_mm: (sigma2 - known + by_effects).max(0.0).sqrt() }
            })
            .collect()
    }

    /// Predicts the field at several places together. Returns the posterior means in mm, and the posterior covariance
    /// of every pair of places in mm^2. The effects and the noise of a touch are not included.
    pub(super) fn predict_together(&self, places: &[[f64; 2]]) -> (Vec<f64>, Mat<f64>) {
        let p = self.estimates.len();
        let pairs = self.hyperparameters.field.pair_covariance();
        let across = pairs.cross_covariance(&self.places, places);
        let solved = self.factor.solve(&across);
        let moved = self.effects.transpose() * &across;
        let known = Mat::from_fn(p, p, |r, c| self.covariance[(r, c)]);
        let prior = pairs.cross_covariance(places, places);
        let covariance = prior - across.transpose() * &solved + moved.transpose() * &known * &moved;
        let mean_of = |c: usize| dot(across.col_as_slice(c), &self.weights);
        ((0..places.len()).map(mean_of).collect(), covariance)
    }
}

/// Computes the covariance matrix of the deviations of all observed points, in mm^2. The covariance is the sum of three
/// terms: the field, the noise, and `shared_mm2(a, b)` for the points with the indices `a` and `b`. The effects are not
/// included. Only the lower triangle of the matrix is filled.
fn covariance_mm2(
    observed: &Observations,
    hyperparameters: &Hyperparameters,
    shared_mm2: impl Fn(usize, usize) -> f64,
) -> Mat<f64> {
    let Observations { places, path, .. } = observed;
    let scatter2 = hyperparameters.noise_sigma_mm * hyperparameters.noise_sigma_mm;
    let pairs = hyperparameters.field.pair_covariance();
    let mut covariance = Mat::zeros(places.len(), places.len());
    for c in 0..places.len() {
        let column = &mut covariance.col_as_slice_mut(c)[c..];
        pairs.column(places[c], &places[c..], column);
        column.iter_mut().zip(c..).for_each(|(v, r)| *v += shared_mm2(r, c));
        match path.is_empty() {
            true => column[0] += scatter2,
            false => column
                .iter_mut()
                .zip(&path[c..])
                .for_each(|(v, at)| *v += scatter2 * hyperparameters.noise_correlation(at - path[c])),
        }
    }
    covariance
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Computes the Cholesky factor of `gram`. This is the matrix of the products of all pairs of effects: H'K^-1 H or H'H,
/// where H has the effects as columns and K is the covariance of the points.
///
/// # Errors
/// Returns [`ModelError::CollinearEffects`] if one effect is nearly a combination of the others. The criterion: after
/// `gram` is scaled to a unit diagonal, its smallest eigenvalue is at most 1e-12.
pub(super) fn checked_cholesky(gram: DMatrix<f64>) -> Result<nalgebra::Cholesky<f64, nalgebra::Dyn>, ModelError> {
    const MIN_PIVOT: f64 = 1e-12;
    if gram.nrows() == 0 {
        return gram.cholesky().ok_or(ModelError::CollinearEffects);
    }
    // Effects have different units, so the test scales them: only their correlation counts.
    let scales = DVector::from_iterator(gram.nrows(), gram.diagonal().iter().map(|v| v.sqrt()));
    let alike = DMatrix::from_fn(gram.nrows(), gram.ncols(), |a, b| gram[(a, b)] / (scales[a] * scales[b]));
    let least = alike.symmetric_eigenvalues().iter().copied().fold(f64::INFINITY, f64::min);
    if least.is_nan() || least <= MIN_PIVOT {
        return Err(ModelError::CollinearEffects);
    }
    gram.cholesky().ok_or(ModelError::CollinearEffects)
}

#[cfg(test)]
mod tests {
    use super::super::Field;
    use super::*;

    const HYPERPARAMETERS: Hyperparameters =
        Hyperparameters { field: Field::new(2.0, 20.0), noise_sigma_mm: 0.5, noise_autocorrelation: 0.0 };

    #[test]
    fn dense_one_point_by_hand() {
        // By hand, k = 4 and s^2 = 0.25: mean = 4 / 4.25 * 3, variance = 4 - 16 / 4.25.
        let model =
            DensePosterior::fit(&Observations::without_effects(vec![[1.0, 2.0]], vec![3.0]), HYPERPARAMETERS).unwrap();
        let [at, far] = model.predict(&[[1.0, 2.0], [1e4, 0.0]])[..] else { panic!() };
        assert!((at.mean_mm - 12.0 / 4.25).abs() < 1e-14 && (at.sigma_mm.powi(2) - (4.0 - 16.0 / 4.25)).abs() < 1e-14);
        assert_eq!(far, Prediction { mean_mm: 0.0, sigma_mm: 2.0 });
        let by_hand = -0.5 * (4.25_f64.ln() + 9.0 / 4.25 + std::f64::consts::TAU.ln());
        assert!((model.log_likelihood() - by_hand).abs() < 1e-14);
    }

    #[test]
    fn dense_random_effect_by_hand() {
        // By hand, k = 4, s^2 = 0.25 and e^2 = 2.25: the field gets the share 4 / 6.5 of the deviation 3.
        let stated = DMatrix::from_element(1, 1, 1.5);
        let model = DensePosterior::fit(
            &Observations { random_effects: stated, ..Observations::without_effects(vec![[1.0, 2.0]], vec![3.0]) },
            HYPERPARAMETERS,
        )
        .unwrap();
        let told = model.predict(&[[1.0, 2.0]])[0];
        assert!(
            (told.mean_mm - 12.0 / 6.5).abs() < 1e-14 && (told.sigma_mm.powi(2) - (4.0 - 16.0 / 6.5)).abs() < 1e-13
        );
        let by_hand = -0.5 * (6.5_f64.ln() + 9.0 / 6.5 + std::f64::consts::TAU.ln());
        assert!((model.log_likelihood() - by_hand).abs() < 1e-14);
    }

    #[test]
    fn dense_noise_autocorrelation_by_hand() {
        // Both points lie at one place, so the field is the same at both. With a noise autocorrelation of 0.5, K =
        // [4.25 4.125; 4.125 4.25]; its elements sum to 16.75.
        let drifting = Hyperparameters { noise_autocorrelation: 0.5, ..HYPERPARAMETERS };
        let at = |path: [f64; 2]| Observations {
            path: path.to_vec(),
            ..Observations::without_effects(vec![[1.0, 2.0]; 2], vec![3.0, 1.0])
        };
        let model = DensePosterior::fit(&at([7.0, 8.0]), drifting).unwrap();
        let told = model.predict(&[[1.0, 2.0]])[0];
        // mean = 4 (w1 + w2), w1 + w2 = (3 + 1) / (4.25 + 4.125); variance = 4 - 16 * 2 / 8.375.
        assert!((told.mean_mm - 4.0 * 4.0 / 8.375).abs() < 1e-13, "{told:?}");
        assert!((told.sigma_mm.powi(2) - (4.0 - 32.0 / 8.375)).abs() < 1e-13, "{told:?}");
        // Far apart on the path, the noise of the two points is independent.
        let apart = DensePosterior::fit(&at([7.0, 900.0]), drifting).unwrap();
        let alone = DensePosterior::fit(&at([7.0, 8.0]), HYPERPARAMETERS).unwrap();
        assert!((apart.log_likelihood() - alone.log_likelihood()).abs() < 1e-13);
    }

    fn wave(places: &[[f64; 2]]) -> Vec<f64> {
        places.iter().map(|[x, y]| (0.1 * x).sin() + 0.5 * (0.13 * y).cos()).collect()
    }

    fn places(count: u32) -> Vec<[f64; 2]> {
        (0..count).map(f64::from).map(|k| [(7.31 * k) % 60.0, (13.7 * k) % 40.0]).collect()
    }

    #[test]
    fn dense_estimates_fixed_effects() {
        let places = places(120);
        let effects = DMatrix::from_fn(120, 3, |r, c| [1.0, places[r][0], places[r][1]][c]);
        let planted = DVector::from_column_slice(&[40.0, 0.3, -0.2]);
        let still = wave(&places);
        let moved: Vec<f64> = still.iter().zip((&effects * &planted).iter()).map(|(d, m)| d + m).collect();
        let with = |deviations_mm| Observations {
            places: places.clone(),
            deviations_mm,
            fixed_effects: effects.clone(),
            ..Observations::without_effects(places.clone(), Vec::new())
        };
        let [a, b] = [still, moved].map(|d| DensePosterior::fit(&with(d), HYPERPARAMETERS).unwrap());
        // The fit returns the planted effects in addition to the component that the field itself has along them.
        assert!((b.estimated_effects().0 - a.estimated_effects().0 - &planted).norm() < 1e-9);
        let asked = [[30.0, 20.0], [70.0, 10.0]];
        for (p, q) in a.predict(&asked).into_iter().zip(b.predict(&asked)) {
            assert!((p.mean_mm - q.mean_mm).abs() < 1e-9 && (p.sigma_mm - q.sigma_mm).abs() < 1e-12);
        }
        // With a field of 2 mm, and a range of a third of the part, the uncertainty of the part's height is much larger
        // than that due to the noise of its points.
        let height = a.estimated_effects().1[(0, 0)].sqrt();
        assert!(height > 10.0 * 0.5 / 120.0_f64.sqrt(), "{height}");
    }

    #[test]
    fn dense_is_translation_invariant() {
        let at = places(80);
        let away: Vec<[f64; 2]> = at.iter().map(|[x, y]| [x + 1e4, y - 3e3]).collect();
        let fit = |places: &[[f64; 2]]| {
            DensePosterior::fit(&Observations::without_effects(places.to_vec(), wave(&at)), HYPERPARAMETERS).unwrap()
        };
        let (here, there) = (fit(&at).predict(&[[11.0, 12.0]])[0], fit(&away).predict(&[[10_011.0, -2988.0]])[0]);
        assert!((here.mean_mm - there.mean_mm).abs() < 1e-9 && (here.sigma_mm - there.sigma_mm).abs() < 1e-9);
    }

    #[test]
    fn dense_refuses_bad_input() {
        let of =
            |observed: &Observations, hyperparameters| DensePosterior::fit(observed, hyperparameters).err().unwrap();
        let two = Observations::without_effects(vec![[0.0; 2]; 2], vec![1.0, f64::NAN]);
        assert_eq!(of(&two, HYPERPARAMETERS), ModelError::NotFinite { point: 1 });
        let none = Observations::without_effects(vec![], vec![]);
        assert_eq!(of(&none, HYPERPARAMETERS), ModelError::TooFewPoints { points: 0, min_points: 1 });
        let odd = Observations::without_effects(vec![[0.0; 2]; 2], vec![1.0]);
        assert!(matches!(of(&odd, HYPERPARAMETERS), ModelError::Shape { points: 2, deviations: 1, .. }));
        let good = Observations::without_effects(vec![[0.0; 2]; 2], vec![1.0; 2]);
        let noiseless = of(&good, Hyperparameters { noise_sigma_mm: 0.0, ..HYPERPARAMETERS });
        assert!(matches!(noiseless, ModelError::Hyperparameter { value, .. } if value == 0.0), "{noiseless}");
        for noise_autocorrelation in [1.0, -0.1, f64::NAN] {
            let refused = of(&good, Hyperparameters { noise_autocorrelation, ..HYPERPARAMETERS });
            assert!(matches!(refused, ModelError::NoiseAutocorrelation { .. }), "{refused}");
        }
        for path in [vec![0.0; good.places.len() + 1], vec![f64::NAN; good.places.len()]] {
            let refused = of(&Observations { path, ..good.clone() }, HYPERPARAMETERS);
            assert!(matches!(refused, ModelError::Shape { points: 2, deviations: 2, .. }), "{refused}");
        }
        let alike = Observations {
            fixed_effects: DMatrix::from_element(9, 2, 1.0),
            ..Observations::without_effects(places(9), vec![0.0; 9])
        };
        assert_eq!(of(&alike, HYPERPARAMETERS), ModelError::CollinearEffects);
        assert!(DensePosterior::fit(&good, HYPERPARAMETERS).is_ok(), "two points at one place");
    }
}
