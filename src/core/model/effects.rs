//! Effects that nobody knows, told beside a field that nobody knows either.

use nalgebra::{DMatrix, DVector};

use super::likelihood::ON_A_GRID;
use super::{Dense, Hyper, ModelError, Observed, Priors};

/// Points whose every pair is worked with, at most: what tells an effect of the whole part is wide, and more of them tell no more.
const MOST_TOGETHER: usize = 600;
/// What is less likely than this counts for nothing.
const FEW: f64 = 1e-3;

/// Effects with their covariance.
#[derive(Clone, Debug)]
pub struct Effects {
    /// Each in units of its column.
    pub values: DVector<f64>,
    /// Their covariance, in which is what the field may have made of them.
    pub covariance: DMatrix<f64>,
}

impl Effects {
    /// Tells the effects by generalised least squares (Aitken 1935), b = (H'K^-1 H)^-1 H'K^-1 d with the covariance (H'K^-1 H)^-1.
    ///
    /// K is that of the fields that the points speak for whatever the effects are (restricted likelihood), each as much as it is spoken for: the
    /// covariance is the mean of theirs, and of how far their values lie apart.
    ///
    /// # Errors
    /// Too few points, columns that are alike, rows that do not belong together.
    pub fn of(observed: &Observed, priors: &Priors) -> Result<Self, ModelError> {
        let told = Hyper::told(observed, priors, &ON_A_GRID)?;
        let n = observed.places.len();
        let most = n.min(MOST_TOGETHER);
        let chosen: Vec<usize> = (0..most).map(|k| k * n / most).collect();
        let some = observed.only(&chosen);
        let whole: f64 = told.wide.iter().map(|(_, weight)| weight).sum();
        let p = observed.effects.ncols() + observed.stated.ncols();
        let (mut values, mut squares) = (DVector::zeros(p), DMatrix::zeros(p, p));
        let mut counted = 0.0;
        for (hyper, weight) in told.wide.iter().filter(|(_, weight)| *weight > FEW * whole) {
            let model = Dense::fit(&some, *hyper)?;
            let (found, covariance) = model.effects();
            values += found * *weight;
            squares += (covariance + found * found.transpose()) * *weight;
            counted += weight;
        }
        values /= counted;
        let covariance = squares / counted - &values * values.transpose();
        Ok(Self { values, covariance })
    }
}
