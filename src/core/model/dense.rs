//! The model by one set of parameters and the covariance of every pair of points.
//!
//! With K = k(x_i, x_j) + s^2 R, where R is 1 and, between points of a path on which the probe drifts, the drift to the power of their steps
//! (an autoregression of the first order), the effects b by generalised least squares, b = (H'K^-1 H)^-1 H'K^-1 d, and what is left told by kriging
//! (Rasmussen and Williams 2006, 2.7, with a vague prior of b): mean h'b + k'K^-1 (d - H b), variance
//! k(x, x) - k'K^-1 k + r'(H'K^-1 H)^-1 r with r = h - H'K^-1 k. Effects E that are stated stand beside those of H and have a variance of 1, so their
//! part of H'K^-1 H has 1 added to its diagonal; that is the same as E E' in K.

use faer::linalg::solvers::{Llt, Solve};
use faer::{Mat, Side};
use nalgebra::{DMatrix, DVector};

use super::{Hyperparameters, ModelError, Observed};

/// What the model says of a place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prediction {
    /// The field, the most probable value.
    pub mean_mm: f64,
    /// Its standard uncertainty; the scatter of a further point is not in it.
    pub sigma_mm: f64,
}

/// A model that knows some points.
pub struct DensePosterior {
    hyperparameters: Hyperparameters,
    places: Vec<[f64; 2]>,
    factor: Llt<f64>,
    /// K^-1 (d - H b).
    weights: Vec<f64>,
    /// K^-1 H.
    effects: Mat<f64>,
    /// The effects, and their covariance.
    found: DVector<f64>,
    covariance: DMatrix<f64>,
    likelihood: f64,
}

impl DensePosterior {
    /// Fits the effects and the field to what was measured; takes time as the cube of the number of points.
    ///
    /// # Errors
    /// Rows that do not belong together, numbers that are none, parameters that are not above 0, effects that cannot be told apart.
    pub fn fit(observed: &Observed, hyperparameters: Hyperparameters) -> Result<Self, ModelError> {
        Self::with(observed, hyperparameters, |_, _| 0.0)
    }

    /// The same with what else pairs of observed points have in common, which no other place has a part of.
    pub(super) fn with(
        observed: &Observed,
        hyperparameters: Hyperparameters,
        shared_mm2: impl Fn(usize, usize) -> f64,
    ) -> Result<Self, ModelError> {
        let Observed { places, deviations_mm, .. } = observed;
        let Solved { effects, factor, solved, gram, towards, log_det, .. } =
            Solved::with(observed, &hyperparameters, shared_mm2)?;
        let (n, p, vague) = (places.len(), effects.ncols(), observed.fixed_effects.ncols());
        let gram = checked_cholesky(with_stated(gram, vague))?;
        let found = gram.solve(&towards);
        let mut weights = solved.col_as_slice(p).to_vec();
        for a in 0..p {
            weights.iter_mut().zip(solved.col_as_slice(a)).for_each(|(weight, of)| *weight -= of * found[a]);
        }
        let squares = dot(deviations_mm, &weights);
        let log_gram: f64 = 2.0 * gram.l_dirty().diagonal().iter().map(|v| v.ln()).sum::<f64>();
        Ok(Self {
            hyperparameters,
            places: places.clone(),
            weights,
            effects: solved.subcols(0, p).to_owned(),
            found,
            covariance: gram.inverse(),
            likelihood: -0.5 * (log_det + log_gram + squares + (n - vague) as f64 * std::f64::consts::TAU.ln()),
            factor,
        })
    }

    /// Returns the logarithm of the likelihood of what was measured, whatever the effects are (restricted likelihood, Patterson and
    /// Thompson 1971): by it parameters are compared.
    pub fn log_likelihood(&self) -> f64 {
        self.likelihood
    }

    /// The squares of the whitened residuals, d'K^-1 (d - H b).
    pub(super) fn whitened_squares(&self, observed: &Observed) -> f64 {
        observed.deviations_mm.iter().zip(&self.weights).map(|(d, w)| d * w).sum()
    }

    /// Returns the effects and their covariance, those that are stated behind the others: with the motions of the part as effects, where its nominal frame is, and how well
    /// that is known beside a field that nobody knows either.
    pub fn estimated_effects(&self) -> (&DVector<f64>, &DMatrix<f64>) {
        (&self.found, &self.covariance)
    }

    /// Tells the field at some places, the effects taken off.
    pub fn predict(&self, places: &[[f64; 2]]) -> Vec<Prediction> {
        let p = self.found.len();
        let across = self.hyperparameters.field.pairs().across(&self.places, places);
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

    /// The same, with the covariance of every pair of the places.
    pub(super) fn predict_together(&self, places: &[[f64; 2]]) -> (Vec<f64>, Mat<f64>) {
        let p = self.found.len();
        let pairs = self.hyperparameters.field.pairs();
        let across = pairs.across(&self.places, places);
        let solved = self.factor.solve(&across);
        let moved = self.effects.transpose() * &across;
        let known = Mat::from_fn(p, p, |r, c| self.covariance[(r, c)]);
        let prior = pairs.across(places, places);
        let covariance = prior - across.transpose() * &solved + moved.transpose() * &known * &moved;
        let mean_of = |c: usize| dot(across.col_as_slice(c), &self.weights);
        ((0..places.len()).map(mean_of).collect(), covariance)
    }
}

/// What the covariance of points makes of what was measured.
struct Solved {
    /// H, and behind it E.
    effects: DMatrix<f64>,
    factor: Llt<f64>,
    /// K^-1 of these, and behind them K^-1 d.
    solved: Mat<f64>,
    /// H'K^-1 H and H'K^-1 d with E behind H, K without E.
    gram: DMatrix<f64>,
    towards: DVector<f64>,
    log_det: f64,
}

impl Solved {
    fn with(
        observed: &Observed,
        hyperparameters: &Hyperparameters,
        shared_mm2: impl Fn(usize, usize) -> f64,
    ) -> Result<Self, ModelError> {
        observed.check()?;
        hyperparameters.check()?;
        let Observed { places, deviations_mm, path, .. } = observed;
        let effects = observed.all_effects();
        let (n, p) = (places.len(), effects.ncols());
        let scatter2 = hyperparameters.noise_sigma_mm * hyperparameters.noise_sigma_mm;
        let pairs = hyperparameters.field.pairs();
        let mut covariance = Mat::zeros(n, n);
        for c in 0..n {
            // Only the lower triangle is read.
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
        let factor = Llt::new(covariance.as_ref(), Side::Lower).map_err(|_| ModelError::NotDefinite)?;
        let mut right = Mat::zeros(n, p + 1);
        (0..p).for_each(|c| right.col_as_slice_mut(c).copy_from_slice(effects.column(c).as_slice()));
        right.col_as_slice_mut(p).copy_from_slice(deviations_mm);
        let solved = factor.solve(&right);
        let gram = DMatrix::from_fn(p, p, |a, b| dot(right.col_as_slice(a), solved.col_as_slice(b)));
        let towards = DVector::from_fn(p, |a, _| dot(right.col_as_slice(a), solved.col_as_slice(p)));
        let diagonal = factor.L().diagonal();
        let log_det: f64 = 2.0 * (0..n).map(|k| diagonal[k].ln()).sum::<f64>();
        Ok(Self { effects, factor, solved, gram, towards, log_det })
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Takes in that effects behind the first, which nobody knows, have a variance of 1.
fn with_stated(mut gram: DMatrix<f64>, vague: usize) -> DMatrix<f64> {
    (vague..gram.nrows()).for_each(|k| gram[(k, k)] += 1.0);
    gram
}

/// The factor of H'K^-1 H; none where a direction of it is nothing beside the others.
pub(super) fn checked_cholesky(gram: DMatrix<f64>) -> Result<nalgebra::Cholesky<f64, nalgebra::Dyn>, ModelError> {
    const LEAST: f64 = 1e-12;
    if gram.nrows() == 0 {
        return gram.cholesky().ok_or(ModelError::EffectsAlike);
    }
    // Effects have units of their own: what counts is how alike they are.
    let scales = DVector::from_iterator(gram.nrows(), gram.diagonal().iter().map(|v| v.sqrt()));
    let alike = DMatrix::from_fn(gram.nrows(), gram.ncols(), |a, b| gram[(a, b)] / (scales[a] * scales[b]));
    let least = alike.symmetric_eigenvalues().iter().copied().fold(f64::INFINITY, f64::min);
    if least.is_nan() || least <= LEAST {
        return Err(ModelError::EffectsAlike);
    }
    gram.cholesky().ok_or(ModelError::EffectsAlike)
}

#[cfg(test)]
mod tests {
    use super::super::Field;
    use super::*;

    const HYPER: Hyperparameters =
        Hyperparameters { field: Field::new(2.0, 20.0), noise_sigma_mm: 0.5, noise_autocorrelation: 0.0 };

    #[test]
    fn of_one_point_it_is_what_is_worked_out_by_hand() {
        // k = 4, s^2 = 0.25: mean = 4 / 4.25 * 3, variance = 4 - 16 / 4.25.
        let model = DensePosterior::fit(&Observed::without_effects(vec![[1.0, 2.0]], vec![3.0]), HYPER).unwrap();
        let [at, far] = model.predict(&[[1.0, 2.0], [1e4, 0.0]])[..] else { panic!() };
        assert!((at.mean_mm - 12.0 / 4.25).abs() < 1e-14 && (at.sigma_mm.powi(2) - (4.0 - 16.0 / 4.25)).abs() < 1e-14);
        assert_eq!(far, Prediction { mean_mm: 0.0, sigma_mm: 2.0 });
        let by_hand = -0.5 * (4.25_f64.ln() + 9.0 / 4.25 + std::f64::consts::TAU.ln());
        assert!((model.log_likelihood() - by_hand).abs() < 1e-14);
    }

    #[test]
    fn what_is_stated_of_one_point_is_what_is_worked_out_by_hand() {
        // k = 4, s^2 = 0.25, e^2 = 2.25: of the 3 that were found the field has 4 / 6.5.
        let stated = DMatrix::from_element(1, 1, 1.5);
        let model = DensePosterior::fit(
            &Observed { random_effects: stated, ..Observed::without_effects(vec![[1.0, 2.0]], vec![3.0]) },
            HYPER,
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
    fn of_two_points_of_a_path_it_is_what_is_worked_out_by_hand() {
        // No step of the field between them: K = [4.25 4.125; 4.125 4.25] by a drift of a half, and so the sum has 16.75 for 12 of the field.
        let drifting = Hyperparameters { noise_autocorrelation: 0.5, ..HYPER };
        let at = |path: [f64; 2]| Observed {
            path: path.to_vec(),
            ..Observed::without_effects(vec![[1.0, 2.0]; 2], vec![3.0, 1.0])
        };
        let model = DensePosterior::fit(&at([7.0, 8.0]), drifting).unwrap();
        let told = model.predict(&[[1.0, 2.0]])[0];
        // mean = 4 (w1 + w2), w1 + w2 = (3 + 1) / (4.25 + 4.125); variance = 4 - 16 * 2 / 8.375.
        assert!((told.mean_mm - 4.0 * 4.0 / 8.375).abs() < 1e-13, "{told:?}");
        assert!((told.sigma_mm.powi(2) - (4.0 - 32.0 / 8.375)).abs() < 1e-13, "{told:?}");
        // Far apart on the path they scatter on their own.
        let apart = DensePosterior::fit(&at([7.0, 900.0]), drifting).unwrap();
        let alone = DensePosterior::fit(&at([7.0, 8.0]), HYPER).unwrap();
        assert!((apart.log_likelihood() - alone.log_likelihood()).abs() < 1e-13);
    }

    fn wave(places: &[[f64; 2]]) -> Vec<f64> {
        places.iter().map(|[x, y]| (0.1 * x).sin() + 0.5 * (0.13 * y).cos()).collect()
    }

    fn places(count: u32) -> Vec<[f64; 2]> {
        (0..count).map(f64::from).map(|k| [(7.31 * k) % 60.0, (13.7 * k) % 40.0]).collect()
    }

    #[test]
    fn effects_take_off_what_moves_all_points_and_say_how_well_they_are_known() {
        let places = places(120);
        let effects = DMatrix::from_fn(120, 3, |r, c| [1.0, places[r][0], places[r][1]][c]);
        let planted = DVector::from_column_slice(&[40.0, 0.3, -0.2]);
        let still = wave(&places);
        let moved: Vec<f64> = still.iter().zip((&effects * &planted).iter()).map(|(d, m)| d + m).collect();
        let with = |deviations_mm| Observed {
            places: places.clone(),
            deviations_mm,
            fixed_effects: effects.clone(),
            ..Observed::without_effects(places.clone(), Vec::new())
        };
        let [a, b] = [still, moved].map(|d| DensePosterior::fit(&with(d), HYPER).unwrap());
        // What is planted comes back on top of what the field itself has along it.
        assert!((b.estimated_effects().0 - a.estimated_effects().0 - &planted).norm() < 1e-9);
        let asked = [[30.0, 20.0], [70.0, 10.0]];
        for (p, q) in a.predict(&asked).into_iter().zip(b.predict(&asked)) {
            assert!((p.mean_mm - q.mean_mm).abs() < 1e-9 && (p.sigma_mm - q.sigma_mm).abs() < 1e-12);
        }
        // The place of a part with a field of 2 mm and a range of a third of it is known to much worse than its points scatter.
        let height = a.estimated_effects().1[(0, 0)].sqrt();
        assert!(height > 10.0 * 0.5 / 120.0_f64.sqrt(), "{height}");
    }

    #[test]
    fn moving_everything_moves_nothing() {
        let at = places(80);
        let away: Vec<[f64; 2]> = at.iter().map(|[x, y]| [x + 1e4, y - 3e3]).collect();
        let fit = |places: &[[f64; 2]]| {
            DensePosterior::fit(&Observed::without_effects(places.to_vec(), wave(&at)), HYPER).unwrap()
        };
        let (here, there) = (fit(&at).predict(&[[11.0, 12.0]])[0], fit(&away).predict(&[[10_011.0, -2988.0]])[0]);
        assert!((here.mean_mm - there.mean_mm).abs() < 1e-9 && (here.sigma_mm - there.sigma_mm).abs() < 1e-9);
    }

    #[test]
    fn what_is_no_model_is_refused_in_words() {
        let of = |observed: &Observed, hyperparameters| {
            DensePosterior::fit(observed, hyperparameters).err().unwrap().to_string()
        };
        let two = Observed::without_effects(vec![[0.0; 2]; 2], vec![1.0, f64::NAN]);
        assert_eq!(of(&two, HYPER), "point 2 has a number that is none");
        let none = Observed::without_effects(vec![], vec![]);
        assert!(of(&none, HYPER).contains("needs 1 points at least, 0"));
        let odd = Observed::without_effects(vec![[0.0; 2]; 2], vec![1.0]);
        assert!(of(&odd, HYPER).contains("do not belong together"));
        let good = Observed::without_effects(vec![[0.0; 2]; 2], vec![1.0; 2]);
        assert!(of(&good, Hyperparameters { noise_sigma_mm: 0.0, ..HYPER }).contains("the scatter is 0 mm"));
        for noise_autocorrelation in [1.0, -0.1, f64::NAN] {
            assert!(of(&good, Hyperparameters { noise_autocorrelation, ..HYPER }).contains("below 1"));
        }
        for path in [vec![0.0; good.places.len() + 1], vec![f64::NAN; good.places.len()]] {
            assert!(of(&Observed { path, ..good.clone() }, HYPER).contains("belong together"));
        }
        let alike = Observed {
            fixed_effects: DMatrix::from_element(9, 2, 1.0),
            ..Observed::without_effects(places(9), vec![0.0; 9])
        };
        assert!(of(&alike, HYPER).contains("cannot be told apart"));
        assert!(DensePosterior::fit(&good, HYPER).is_ok(), "two points at one place");
    }
}
