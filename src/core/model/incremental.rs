//! Incremental posterior of the model: points arrive in batches, and each batch updates the posterior at a fixed set of
//! places.
//!
//! The Cholesky factor L of the covariance of all points so far gets a new row for each point, and so does A = L^-1
//! k(points, places). For a point at x with the deviation z, and v the whitened deviations before it:
//!
//! ```text
//!  l = L^-1 k(points, x)      d^2 = k(x, x) + s^2 - l'l      a = (k(x, places) - l'A) / d      w = (z - l'v) / d
//!  mean += w a                variance -= a^2
//! ```
//!
//! The cost of a further point is the number of points so far times the number of places; no system is solved again.
//! Fixed effects are part of the covariance, with a variance far beyond all measured values. The prediction at a place
//! is the sum of field and effects.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::field::PairCovariance;
use super::{Hyperparameters, ModelError, Observations, Prediction};

/// Standard deviation of a fixed effect, in units of that of the field. A larger value would lose the field in rounding
/// errors.
const FIXED_EFFECT_SIGMAS: f64 = 1e3;
/// Number of places that are processed at a time: with some hundred points, their data stay in the processor's cache.
const BLOCK: usize = 256;

/// Posterior at a fixed set of places, which is updated as points arrive.
#[derive(Clone)]
pub struct IncrementalPosterior {
    hyperparameters: Hyperparameters,
    pairs: PairCovariance,
    /// Number of fixed and random effects.
    columns: usize,
    /// Observed points, and the rows of L.
    observed_places: Vec<Place>,
    lower: Vec<Vec<f64>>,
    /// L^-1 times the deviations.
    whitened: Vec<f64>,
    blocks: Vec<PlaceBlock>,
}

/// Place with its row of effects.
#[derive(Clone)]
struct Place {
    at: [f64; 2],
    effects: Vec<f64>,
}

/// Block of consecutive places.
#[derive(Clone)]
struct PlaceBlock {
    places: Vec<Place>,
    mean_mm: Vec<f64>,
    variance_mm2: Vec<f64>,
    /// Part of A: a row per point, a column per place of the block.
    across: Vec<Vec<f64>>,
}

/// Returns one [`Place`] for each element of `places`: its position in mm and its row of effects. The row has first the
/// fixed effects, then the random effects.
///
/// Each random effect is divided by the prior standard deviation of the fixed effects. So one common prior variance
/// applies to fixed and random effects. The prior standard deviation of the fixed effects is [`FIXED_EFFECT_SIGMAS`]
/// times the standard deviation of the field in `hyperparameters`.
///
/// # Errors
/// Returns [`ModelError::Shape`] if the numbers of rows differ, or [`ModelError::NotFinite`] if a number is not finite.
fn joined(
    places: &[[f64; 2]],
    fixed_effects: &DMatrix<f64>,
    random_effects: &DMatrix<f64>,
    hyperparameters: &Hyperparameters,
) -> Result<Vec<Place>, ModelError> {
    let (points, rows) = (places.len(), fixed_effects.nrows());
    if rows != points || random_effects.nrows() != points {
        return Err(ModelError::Shape { points, deviations: points, rows });
    }
    let smaller = 1.0 / (FIXED_EFFECT_SIGMAS * hyperparameters.field.sigma_mm);
    let of = |k: usize| {
        let random = random_effects.row(k);
        let effects = fixed_effects.row(k).into_iter().copied().chain(random.iter().map(|of| smaller * of)).collect();
        Place { at: places[k], effects }
    };
    let all: Vec<Place> = (0..points).map(of).collect();
    let is_finite = |place: &Place| place.at.iter().chain(&place.effects).all(|value| value.is_finite());
    match all.iter().position(|place| !is_finite(place)) {
        Some(point) => Err(ModelError::NotFinite { point }),
        None => Ok(all),
    }
}

impl IncrementalPosterior {
    /// Creates a model that predicts the deviation at each of `places`, before any point is observed. `places` are
    /// positions in the plane of projection, in mm.
    ///
    /// `fixed_effects` and `random_effects` have one row for each place, and one column for each effect. An element is
    /// a deviation at the place, in mm. It belongs to one unit of a fixed effect, or to one standard uncertainty of a
    /// random effect.
    ///
    /// # Errors
    /// Returns an error if the numbers of rows differ, if a number is not finite, or if a hyperparameter is out of
    /// range.
    pub fn at_places(
        places: &[[f64; 2]],
        fixed_effects: &DMatrix<f64>,
        random_effects: &DMatrix<f64>,
        hyperparameters: Hyperparameters,
    ) -> Result<Self, ModelError> {
        hyperparameters.check()?;
        let mut growing = Self {
            hyperparameters,
            pairs: hyperparameters.field.pair_covariance(),
            columns: fixed_effects.ncols() + random_effects.ncols(),
            observed_places: Vec::new(),
            lower: Vec::new(),
            whitened: Vec::new(),
            blocks: Vec::new(),
        };
        let places = joined(places, fixed_effects, random_effects, &hyperparameters)?;
        let block = |places: &[Place]| PlaceBlock {
            places: places.to_vec(),
            mean_mm: vec![0.0; places.len()],
            variance_mm2: places.iter().map(|place| growing.covariance_mm2(place, place)).collect(),
            across: Vec::new(),
        };
        growing.blocks = places.chunks(BLOCK).map(block).collect();
        Ok(growing)
    }

    /// Adds the points of `observed` to the model, and updates the prediction at every place of [`Self::at_places`].
    ///
    /// # Errors
    /// Returns an error and adds no point if a number is not finite, if the numbers of rows differ, or if the number of
    /// effects differs from that of the model. Returns [`ModelError::NotDefinite`] if the covariance of the points is
    /// not positive definite. In this case a part of the points can already be added, and the predictions are not
    /// updated.
    pub fn update(&mut self, observed: &Observations) -> Result<(), ModelError> {
        let places = self.places_of(observed)?;
        let known = self.observed_places.len();
        for (place, deviation_mm) in places.into_iter().zip(&observed.deviations_mm) {
            self.append_point(place, Some(*deviation_mm))?;
        }
        self.update_places(known);
        Ok(())
    }

    /// Adds an imagined touch to the model. `place` is the index of the touched place in [`Self::at_places`]. The
    /// deviation of this touch is exactly the predicted mean.
    ///
    /// The predicted means do not change. The predicted standard deviations become those after a real touch, because a
    /// standard deviation does not depend on the value that a touch finds (hallucinated updates, Desautels, Krause and
    /// Burdick 2014). Panics if there is no place with this index.
    ///
    /// # Errors
    /// Returns [`ModelError::NotDefinite`] if the covariance of the points is no longer positive definite.
    pub fn update_with_expected(&mut self, place: usize) -> Result<(), ModelError> {
        let known = self.observed_places.len();
        self.append_point(self.blocks[place / BLOCK].places[place % BLOCK].clone(), None)?;
        self.update_places(known);
        Ok(())
    }

    /// Returns the prediction at each place, in the order of [`Self::at_places`]. A prediction has the mean and the
    /// standard deviation, in mm, of the sum of the field and the effects. The noise of a touch is not included.
    pub fn predictions(&self) -> impl Iterator<Item = Prediction> + '_ {
        let of =
            |(mean_mm, variance): (&f64, &f64)| Prediction { mean_mm: *mean_mm, sigma_mm: variance.max(0.0).sqrt() };
        self.blocks.iter().flat_map(move |block| block.mean_mm.iter().zip(&block.variance_mm2).map(of))
    }

    /// Returns the standardized innovation of each point of `observed`, without a unit. It is the deviation minus the
    /// predicted mean, divided by the predicted standard deviation. This standard deviation includes the noise of the
    /// probe. The points are not added to the model.
    ///
    /// # Errors
    /// Returns an error if the numbers of rows differ, if the number of effects differs from that of the model, or if a
    /// number is not finite.
    pub fn standardized_innovations(&self, observed: &Observations) -> Result<Vec<f64>, ModelError> {
        let places = self.places_of(observed)?;
        let of = |(place, deviation_mm): (&Place, &f64)| {
            let (_, mean_mm, sigma_mm) = self.predicted(place);
            (deviation_mm - mean_mm) / sigma_mm
        };
        Ok(places.par_iter().zip(&observed.deviations_mm).map(of).collect())
    }

    fn places_of(&self, observed: &Observations) -> Result<Vec<Place>, ModelError> {
        let Observations { places, deviations_mm, fixed_effects, random_effects, .. } = observed;
        let (points, deviations, rows) = (places.len(), deviations_mm.len(), fixed_effects.nrows());
        if deviations != points || fixed_effects.ncols() + random_effects.ncols() != self.columns {
            return Err(ModelError::Shape { points, deviations, rows });
        }
        if let Some(point) = deviations_mm.iter().position(|deviation| !deviation.is_finite()) {
            return Err(ModelError::NotFinite { point });
        }
        joined(places, fixed_effects, random_effects, &self.hyperparameters)
    }

    /// Returns the prior covariance of the deviations at two places, in mm^2: that of the field plus that of the
    /// effects, without noise.
    fn covariance_mm2(&self, a: &Place, b: &Place) -> f64 {
        let effects: f64 = a.effects.iter().zip(&b.effects).map(|(a, b)| a * b).sum();
        self.pairs.covariance_mm2(a.at, b.at)
            + (FIXED_EFFECT_SIGMAS * self.hyperparameters.field.sigma_mm).powi(2) * effects
    }

    /// Predicts the deviation that a touch at `place` will find. Returns three values:
    ///
    /// - L^-1 k, the off-diagonal elements of the row that `place` would add to the Cholesky factor L. L factorizes the
    ///   covariance of the observed points, and k are the covariances of `place` with all observed points.
    /// - The mean of the deviation, in mm.
    /// - The standard deviation of the deviation, in mm. It includes the noise of a touch.
    fn predicted(&self, place: &Place) -> (Vec<f64>, f64, f64) {
        let mut l: Vec<f64> = Vec::with_capacity(self.observed_places.len() + 1);
        for (told, lower) in self.observed_places.iter().zip(&self.lower) {
            let before: f64 = lower.iter().zip(&l).map(|(a, b)| a * b).sum();
            l.push((self.covariance_mm2(place, told) - before) / lower[l.len()]);
        }
        let mean_mm = l.iter().zip(&self.whitened).map(|(l, w)| l * w).sum();
        let noise_mm2 = self.hyperparameters.noise_sigma_mm.powi(2);
        let left_mm2 = self.covariance_mm2(place, place) + noise_mm2 - l.iter().map(|l| l * l).sum::<f64>();
        // A variance below that of the noise is rounding error.
        (l, mean_mm, left_mm2.max(noise_mm2).sqrt())
    }

    /// Adds one point to the Cholesky factor of the covariance of the observed points. The predictions at the places
    /// are not updated; [`Self::update_places`] does this. If `deviation_mm` is `None`, the predicted mean is used as
    /// the deviation of the point.
    ///
    /// # Errors
    /// Returns [`ModelError::NotDefinite`] if the predicted standard deviation of the point is not a finite number
    /// above 0.
    fn append_point(&mut self, place: Place, deviation_mm: Option<f64>) -> Result<(), ModelError> {
        let (mut l, mean_mm, d) = self.predicted(&place);
        if !(d.is_finite() && d > 0.0) {
            return Err(ModelError::NotDefinite);
        }
        self.whitened.push(deviation_mm.map_or(0.0, |deviation_mm| (deviation_mm - mean_mm) / d));
        l.push(d);
        self.lower.push(l);
        self.observed_places.push(place);
        Ok(())
    }

    /// Updates the predicted mean and variance at all places of [`Self::at_places`] with the observed points from the
    /// index `from` on. Earlier points must already be included in the predictions.
    fn update_places(&mut self, from: usize) {
        let mut blocks = std::mem::take(&mut self.blocks);
        blocks.par_iter_mut().for_each(|block| {
            for k in from..self.observed_places.len() {
                let told = &self.observed_places[k];
                let mut row: Vec<f64> = block.places.iter().map(|place| self.covariance_mm2(told, place)).collect();
                for (l, across) in self.lower[k].iter().zip(&block.across) {
                    row.iter_mut().zip(across).for_each(|(value, across)| *value -= l * across);
                }
                let d = self.lower[k][k];
                for (at, value) in row.iter_mut().enumerate() {
                    *value /= d;
                    block.mean_mm[at] += self.whitened[k] * *value;
                    block.variance_mm2[at] -= *value * *value;
                }
                block.across.push(row);
            }
        });
        self.blocks = blocks;
    }
}

#[cfg(test)]
mod tests {
    use super::super::{DensePosterior, Field};
    use super::*;

    const HYPERPARAMETERS: Hyperparameters =
        Hyperparameters { field: Field::new(5e-3, 30.0), noise_sigma_mm: 3e-4, noise_autocorrelation: 0.0 };

    fn observed(count: u32, effects: usize) -> Observations {
        let places: Vec<[f64; 2]> = (0..count).map(f64::from).map(|k| [(7.31 * k) % 60.0, (13.7 * k) % 40.0]).collect();
        let deviations_mm = places.iter().map(|[x, y]| 5e-3 * ((0.1 * x).sin() + 0.5 * (0.13 * y).cos())).collect();
        let effects =
            DMatrix::from_fn(places.len(), effects, |r, c| [1.0, places[r][0] / 30.0, places[r][1] / 30.0][c]);
        Observations { fixed_effects: effects, ..Observations::without_effects(places, deviations_mm) }
    }

    fn requested(effects: usize) -> (Vec<[f64; 2]>, DMatrix<f64>) {
        let places: Vec<[f64; 2]> = (0..600).map(|k| [2.7 * f64::from(k % 25), 1.9 * f64::from(k / 25)]).collect();
        let rows = DMatrix::from_fn(places.len(), effects, |r, c| [1.0, places[r][0] / 30.0, places[r][1] / 30.0][c]);
        (places, rows)
    }

    fn updated_in_batches(observed: &Observations, batches: &[usize]) -> IncrementalPosterior {
        let (places, effects) = requested(observed.fixed_effects.ncols());
        let none = DMatrix::zeros(places.len(), 0);
        let mut growing = IncrementalPosterior::at_places(&places, &effects, &none, HYPERPARAMETERS).unwrap();
        let mut first = 0;
        for count in batches {
            let chosen: Vec<usize> = (first..first + count).collect();
            growing.update(&observed.subset(&chosen)).unwrap();
            first += count;
        }
        assert_eq!(first, observed.places.len());
        growing
    }

    #[test]
    fn incremental_batches_match_dense() {
        let observed = observed(120, 0);
        let growing = updated_in_batches(&observed, &[10, 1, 49, 60]);
        let exact = DensePosterior::fit(&observed, HYPERPARAMETERS).unwrap().predict(&requested(0).0);
        for (a, b) in exact.iter().zip(growing.predictions()) {
            assert!((a.mean_mm - b.mean_mm).abs() < 1e-10 && (a.sigma_mm - b.sigma_mm).abs() < 1e-10, "{a:?} {b:?}");
        }
    }

    #[test]
    fn incremental_effects_match_dense() {
        let observed = observed(120, 3);
        let growing = updated_in_batches(&observed, &[60, 60]);
        let dense = DensePosterior::fit(&observed, HYPERPARAMETERS).unwrap();
        let (found, _) = dense.estimated_effects();
        let (places, effects) = requested(3);
        let moved = effects * found;
        for (k, (a, b)) in dense.predict(&places).iter().zip(growing.predictions()).enumerate() {
            assert!((a.mean_mm + moved[k] - b.mean_mm).abs() < 1e-7, "{k}: {a:?} {b:?}");
            assert!(b.sigma_mm < HYPERPARAMETERS.field.sigma_mm && b.sigma_mm > 0.0, "{k}: {b:?}");
        }
    }

    #[test]
    fn update_with_expected_lowers_sigma() {
        let observed = observed(60, 3);
        let mut growing = updated_in_batches(&observed, &[60]);
        let before: Vec<Prediction> = growing.predictions().collect();
        let place = requested(3).0[77];
        growing.update_with_expected(77).unwrap();
        let imagined: Vec<Prediction> = growing.predictions().collect();
        assert!(before.iter().zip(&imagined).all(|(a, b)| (a.mean_mm - b.mean_mm).abs() < 1e-12));
        assert!(
            imagined[77].sigma_mm < HYPERPARAMETERS.noise_sigma_mm && imagined[77].sigma_mm < 0.9 * before[77].sigma_mm
        );
        // A real touch at the same place finds a different deviation.
        let mut touched = updated_in_batches(&observed, &[60]);
        let effects = DMatrix::from_row_slice(1, 3, &[1.0, place[0] / 30.0, place[1] / 30.0]);
        touched
            .update(&Observations { fixed_effects: effects, ..Observations::without_effects(vec![place], vec![0.1]) })
            .unwrap();
        for (a, b) in touched.predictions().zip(&imagined) {
            assert!((a.sigma_mm - b.sigma_mm).abs() < 1e-12);
        }
    }

    #[test]
    fn standardized_innovation_of_outlier() {
        let observed = observed(121, 3);
        let first: Vec<usize> = (0..120).collect();
        let growing = updated_in_batches(&observed.subset(&first), &[120]);
        let mut last = observed.subset(&[120]);
        assert!(growing.standardized_innovations(&last).unwrap()[0].abs() < 2.0);
        last.deviations_mm[0] += 10.0 * HYPERPARAMETERS.noise_sigma_mm;
        assert!(growing.standardized_innovations(&last).unwrap()[0] > 5.0);
    }

    #[test]
    fn incremental_random_effect_by_hand() {
        let hyperparameters =
            Hyperparameters { field: Field::new(2.0, 20.0), noise_sigma_mm: 0.5, noise_autocorrelation: 0.0 };
        let (place, stated) = (vec![[1.0, 2.0]], DMatrix::from_element(1, 1, 1.5));
        let mut growing =
            IncrementalPosterior::at_places(&place, &DMatrix::zeros(1, 0), &stated, hyperparameters).unwrap();
        growing
            .update(&Observations { random_effects: stated, ..Observations::without_effects(place, vec![3.0]) })
            .unwrap();
        // The prior variance of field and effect together is 4 + 2.25; the noise variance of the observed point is
        // 0.25.
        let told = growing.predictions().next().unwrap();
        assert!((told.mean_mm - 6.25 / 6.5 * 3.0).abs() < 1e-12, "{told:?}");
        assert!((told.sigma_mm.powi(2) - (6.25 - 6.25 * 6.25 / 6.5)).abs() < 1e-12, "{told:?}");
    }

    #[test]
    fn incremental_refuses_mismatch() {
        let (places, effects) = requested(3);
        let none = DMatrix::zeros(places.len(), 0);
        assert!(IncrementalPosterior::at_places(&places, &DMatrix::zeros(7, 3), &none, HYPERPARAMETERS).is_err());
        let mut growing = IncrementalPosterior::at_places(&places, &effects, &none, HYPERPARAMETERS).unwrap();
        assert!(growing.update(&observed(5, 2)).is_err());
        let mut wrong = observed(5, 3);
        wrong.deviations_mm[4] = f64::NAN;
        assert!(growing.update(&wrong).unwrap_err().to_string().contains("point 5 "));
    }
}
