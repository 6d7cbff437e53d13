//! Estimates of unknown effects in the presence of an unknown field.

use nalgebra::{DMatrix, DVector};

use super::hypotheses::{FieldHypotheses, NoiseKind};
use super::posterior::Posterior;
use super::{DensePosterior, ModelError, Observations, Prior, Smoothness};

/// Maximum number of points, as the model uses every pair of them. Effects on the whole part are wide, so more points
/// give no more information.
const MAX_POINTS: usize = 600;

/// Minimum probability of a field, as a share of that of the most probable one; others are ignored.
const MIN_PROBABILITY_SHARE: f64 = 1e-3;

/// Estimated effects with their covariance.
#[derive(Clone, Debug)]
pub struct EffectEstimates {
    /// Estimate of each effect, in units of its column.
    pub values: DVector<f64>,
    /// Covariance of the estimates, including the uncertainty due to the field.
    pub covariance: DMatrix<f64>,
}

impl EffectEstimates {
    /// Estimates the fixed and random effects in `observed` in the presence of an unknown form. The form is a random
    /// field with an unknown standard deviation, range and smoothness. `priors` is the prior of these hyperparameters.
    /// Returns the estimates with their covariance.
    ///
    /// For one set of hyperparameters, the method is generalised least squares (Aitken 1935): b = (H'K^-1 H)^-1 H'K^-1
    /// d with the covariance (H'K^-1 H)^-1. The columns of H are the effects, d are the deviations, K is the covariance
    /// of the points, and b are the estimates. The result is the mean over the probable sets of hyperparameters,
    /// weighted with their posterior probabilities (Bayesian model averaging). The covariance includes the differences
    /// between the estimates of these sets.
    ///
    /// # Errors
    /// Returns an error if the prior is invalid, if there are too few points, if one effect is a combination of others,
    /// if a number is not finite, or if the matrices and lists in `observed` have different numbers of rows.
    pub fn estimate(observed: &Observations, priors: &Prior) -> Result<Self, ModelError> {
        priors.check()?;
        let n = observed.places.len();
        let most = n.min(MAX_POINTS);
        let chosen: Vec<usize> = (0..most).map(|k| k * n / most.max(1)).collect();
        let some = observed.subset(&chosen);
        // A smooth field is overconfident if the form is rough; rougher fields are conservative.
        let rough = |smoothness| smoothness == Smoothness::Matern2;
        let fields = FieldHypotheses::of_smoothness(&some, NoiseKind::PLAIN, rough)?;
        let mut likely = Posterior::new(&fields, &some, Some(priors), None).weighted_hyperparameters(rough);
        likely.retain(|(_, weight)| *weight > MIN_PROBABILITY_SHARE);
        let whole: f64 = likely.iter().map(|(_, weight)| weight).sum();
        let p = observed.fixed_effects.ncols() + observed.random_effects.ncols();
        let (mut values, mut squares) = (DVector::zeros(p), DMatrix::zeros(p, p));
        for (hyperparameters, weight) in likely {
            let model = DensePosterior::fit(&some, hyperparameters)?;
            let (found, covariance) = model.estimated_effects();
            values += found * (weight / whole);
            squares += (covariance + found * found.transpose()) * (weight / whole);
        }
        let covariance = squares - &values * values.transpose();
        Ok(Self { values, covariance })
    }
}
