//! Effects that nobody knows, told beside a field that nobody knows either.

use nalgebra::{DMatrix, DVector};

use super::hypotheses::{FieldHypotheses, NoiseKind};
use super::posterior::Posterior;
use super::{DensePosterior, ModelError, Observed, Prior, Smoothness};

/// Points whose every pair is worked with, at most: what tells an effect of the whole part is wide, and more of them tell no more.
const MOST_TOGETHER: usize = 600;

/// A field that is less likely than this share of the most likely one counts for nothing.
const FEW: f64 = 1e-3;

/// Effects with their covariance.
#[derive(Clone, Debug)]
pub struct EffectEstimates {
    /// Each in units of its column.
    pub values: DVector<f64>,
    /// Their covariance, in which is what the field may have made of them.
    pub covariance: DMatrix<f64>,
}

impl EffectEstimates {
    /// Tells the effects by generalised least squares (Aitken 1935), b = (H'K^-1 H)^-1 H'K^-1 d with the covariance (H'K^-1 H)^-1.
    ///
    /// K is that of the fields that the points speak for whatever the effects are, each as much as it is spoken for: the
    /// covariance is the mean of theirs, and of how far their values lie apart.
    ///
    /// # Errors
    /// Too few points, columns that are alike, rows that do not belong together.
    pub fn estimate(observed: &Observed, priors: &Prior) -> Result<Self, ModelError> {
        priors.check()?;
        let n = observed.places.len();
        let most = n.min(MOST_TOGETHER);
        let chosen: Vec<usize> = (0..most).map(|k| k * n / most.max(1)).collect();
        let some = observed.subset(&chosen);
        let fields = FieldHypotheses::over(&some, NoiseKind::PLAIN)?;
        // A smooth field tells a rough form wrongly: the rougher ones are careful.
        let rough = |smoothness| smoothness == Smoothness::Once;
        let mut likely = Posterior::of(&fields, &some, Some(priors), None).weighted_hyperparameters(rough);
        likely.retain(|(_, weight)| *weight > FEW);
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
