//! Model of the error of a part: a rigid motion, a smooth random field, and the noise of the probe.
//!
//! ```text
//!  deviations at points --> FieldHypotheses: smoothness and range, --> Posterior: probability of each
//!                           one eigenproblem each                      with every variance ratio and noise
//!                                                                          |
//!                                                                          +--> samples: figures, map, frame
//! ```
//!
//! The deviation of point i is d_i = h_i' b + f(x_i) + e_i. The rows h_i are the motions that the registration was free
//! to make (its Jacobian). Their coefficients b have a flat prior. f is a field of unknown smoothness, range and
//! standard deviation. The noise e_i is independent, or correlated along the path if the probe drifts.
//!
//! The model estimates motion and field together. A direction of the pose that the surface does not constrain looks
//! like form. If one of the two is taken as known, the estimate of the other is biased.
//!
//! [`DensePosterior`] uses the covariance of every pair of points for one set of hyperparameters.
//! [`IncrementalPosterior`] does the same point by point, as the points arrive.
//!
//! [`Sessions`] separates the deviations that several measurements have in common from those of each single one.
//!
//! Frame: places lie in the plane of projection of the model {M}. Units: millimetres.

mod area_figures;
mod basis;
mod budget;
mod dense;
mod effects;
mod error;
mod field;
mod form;
mod hypotheses;
mod incremental;
mod intermediate;
mod machine_uncertainty;
mod matern;
mod nelder_mead;
mod noise_kind;
mod part_priors;
mod posterior;
mod prior;
mod random_normals;
mod sessions;
mod stopping;

pub use area_figures::{AngleInterval, AreaOptions, IsoFigures, SlopeFigures};
pub use budget::BudgetEntry;
pub use dense::{DensePosterior, Prediction};
pub use effects::EffectEstimates;
pub use error::ModelError;
pub use field::{Anisotropy, Field, Smoothness};
pub use form::{Form, FormFigures, FormPoint, Interval, ModelInputs};
pub use incremental::IncrementalPosterior;
pub use machine_uncertainty::{MachineUncertainty, UncertaintySource};
pub use part_priors::{PartFit, PartPriors};
pub use prior::Prior;
pub use sessions::{BetweenSessionVariance, PredictionInterval, Sessions};
pub use stopping::{
    FIRST_BATCH, MAX_BATCHES, MIN_TOUCHES, PartialMeasurement, Reason, StoppingCriteria, StoppingDecision, decide,
    farthest_points, short_tour,
};

use nalgebra::DMatrix;

use crate::geometry::bounds;

/// Hyperparameters of the Gaussian-process model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hyperparameters {
    /// Covariance of the field.
    pub field: Field,
    /// Standard deviation of the noise of a point, in mm.
    pub noise_sigma_mm: f64,
    /// Correlation of the noise of two neighbouring points of the path: 0 if the noise is independent, below 1 if the
    /// probe drifts. Points k steps apart have this correlation to the power of k.
    pub noise_autocorrelation: f64,
}

/// Observations at the measured points. Every field has one row for each point.
#[derive(Clone, Debug)]
pub struct Observations {
    /// Positions of the points in the plane of projection, in mm.
    pub places: Vec<[f64; 2]>,
    /// Signed deviations along the normal, in mm.
    pub deviations_mm: Vec<f64>,
    /// Deviation caused by a unit of each fixed effect, such as a motion of the part. Zero columns are allowed.
    pub fixed_effects: DMatrix<f64>,
    /// Deviation caused by one standard uncertainty of each random effect, such as a machine error. Zero columns are
    /// allowed.
    pub random_effects: DMatrix<f64>,
    /// Position of each point along the path, in steps; empty if the points do not follow a path.
    pub path: Vec<f64>,
}

impl Observations {
    /// Returns observations of the given places and deviations, without fixed effects, random effects and a path.
    pub fn without_effects(places: Vec<[f64; 2]>, deviations_mm: Vec<f64>) -> Self {
        let [effects, stated] = [0, 0].map(|columns| DMatrix::zeros(places.len(), columns));
        Self { places, deviations_mm, fixed_effects: effects, random_effects: stated, path: Vec::new() }
    }

    /// Returns the observations at the points with the indices `chosen`, in this order.
    fn subset(&self, chosen: &[usize]) -> Self {
        Self {
            places: chosen.iter().map(|&k| self.places[k]).collect(),
            deviations_mm: chosen.iter().map(|&k| self.deviations_mm[k]).collect(),
            fixed_effects: self.fixed_effects.select_rows(chosen),
            random_effects: self.random_effects.select_rows(chosen),
            path: if self.path.is_empty() { Vec::new() } else { chosen.iter().map(|&k| self.path[k]).collect() },
        }
    }

    /// Returns one matrix with all effects: the columns of the fixed effects, then those of the random effects.
    fn all_effects(&self) -> DMatrix<f64> {
        let (n, p) = self.fixed_effects.shape();
        DMatrix::from_fn(n, p + self.random_effects.ncols(), |r, c| {
            if c < p { self.fixed_effects[(r, c)] } else { self.random_effects[(r, c - p)] }
        })
    }

    /// Checks the observations before a fit.
    ///
    /// # Errors
    /// Returns [`ModelError::Shape`] if the numbers of rows differ or a position on the path is not finite,
    /// [`ModelError::TooFewPoints`] if there are not more points than fixed effects, and [`ModelError::NotFinite`] for
    /// the first point with a number that is not finite.
    fn check(&self) -> Result<(), ModelError> {
        let Self { places, deviations_mm, fixed_effects: effects, random_effects: stated, path } = self;
        let (points, columns) = (places.len(), effects.ncols());
        let has_path = path.len() == points && path.iter().all(|value| value.is_finite());
        if deviations_mm.len() != points
            || effects.nrows() != points
            || stated.nrows() != points
            || !(path.is_empty() || has_path)
        {
            return Err(ModelError::Shape { points, deviations: deviations_mm.len(), rows: effects.nrows() });
        }
        if points <= columns {
            return Err(ModelError::TooFewPoints { points, min_points: columns + 1 });
        }
        let finite = |k: usize| {
            let effects = effects.row(k).into_iter().chain(&stated.row(k)).all(|value| value.is_finite());
            effects && places[k].iter().chain(&deviations_mm[k..=k]).all(|value| value.is_finite())
        };
        match (0..points).find(|&k| !finite(k)) {
            Some(point) => Err(ModelError::NotFinite { point }),
            None => Ok(()),
        }
    }
}

/// Returns orthonormal columns that span the same space as `columns` (the matrix Q of the QR decomposition).
fn orthonormal_base(columns: DMatrix<f64>) -> DMatrix<f64> {
    if columns.ncols() > 0 { columns.qr().q() } else { columns }
}

/// Returns the typical spacing of the places, in mm: the square root of the area per place, with the area of the
/// bounding rectangle of all places.
fn spacing_mm(places: &[[f64; 2]]) -> f64 {
    let [low, high] = bounds(places.iter().copied());
    ((high[0] - low[0]) * (high[1] - low[1]) / places.len() as f64).sqrt()
}

impl Hyperparameters {
    /// Estimates the hyperparameters from the observations. Returns the geometric mean of each hyperparameter, weighted
    /// with the posterior probability. Only fields with the most probable smoothness are averaged.
    ///
    /// `priors` is the prior of two hyperparameters: the range of the field, and the ratio of the standard deviations
    /// of noise and field. With `None`, a prior from the Fisher information is used.
    ///
    /// # Errors
    /// Returns an error if the numbers of rows differ, if a number is not finite, if there are not more points than
    /// fixed effects, if the fixed effects are linearly dependent, or if the prior is invalid.
    pub fn estimate(observed: &Observations, priors: Option<&Prior>) -> Result<Self, ModelError> {
        if let Some(priors) = priors {
            priors.check()?;
        }
        observed.check()?;
        let fields = posterior::select_hypotheses(observed)?;
        Ok(posterior::Posterior::new(&fields, observed, priors, None).mean_hyperparameters())
    }

    /// Returns the correlation of the noise of two points that are `steps` steps of the path apart: the noise
    /// autocorrelation to the power of `steps`.
    fn noise_correlation(&self, steps: f64) -> f64 {
        // A correlation below exp(-36) is below the rounding error of a double, and counts as zero.
        const MAX_STEPS: f64 = 36.0;
        if self.noise_autocorrelation == 0.0 {
            return if steps == 0.0 { 1.0 } else { 0.0 };
        }
        let power = steps.abs() * self.noise_autocorrelation.ln();
        if power < -MAX_STEPS { 0.0 } else { power.exp() }
    }

    /// Checks that the field is valid, the standard deviation of the noise is finite and above 0, and the noise
    /// autocorrelation is at least 0 and below 1.
    ///
    /// # Errors
    /// Returns [`ModelError::Anisotropy`], [`ModelError::Hyperparameter`] or [`ModelError::NoiseAutocorrelation`] with
    /// the wrong value.
    fn check(&self) -> Result<(), ModelError> {
        let Self { field, noise_sigma_mm: scatter_mm, noise_autocorrelation: drift } = *self;
        field.check()?;
        if !(scatter_mm.is_finite() && scatter_mm > 0.0) {
            return Err(ModelError::Hyperparameter { what: "standard deviation of the noise", value: scatter_mm });
        }
        if !(0.0..1.0).contains(&drift) {
            return Err(ModelError::NoiseAutocorrelation { value: drift });
        }
        Ok(())
    }
}
