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
mod inputs;
mod intermediate;
mod interval;
mod machine_uncertainty;
mod matern;
mod nelder_mead;
mod noise_kind;
mod observations;
mod part_priors;
mod posterior;
mod prior;
mod random_normals;
mod sampled_forms;
mod sessions;
mod stopping;
mod tridiagonal;

pub use area_figures::{AngleInterval, IsoFigures, SlopeFigures};
pub use budget::BudgetEntry;
pub use dense::{DensePosterior, Prediction};
pub use effects::EffectEstimates;
pub use error::ModelError;
pub use field::{Anisotropy, Field};
pub use form::Form;
pub use incremental::IncrementalPosterior;
pub use inputs::{AreaOptions, ModelInputs};
pub use interval::DecisionBounds;
pub use machine_uncertainty::{MachineUncertainty, UncertaintySource};
pub use matern::Smoothness;
pub use observations::{Hyperparameters, Observations};
use observations::{orthonormal_base, spacing_mm};
pub use part_priors::{PartFit, PartPriors};
pub use prior::Prior;
pub use sampled_forms::{FormBounds, FormPoint};
pub use sessions::{BetweenSessionVariance, PredictionInterval, Sessions};
pub use stopping::{
    FIRST_BATCH, MAX_BATCHES, MIN_TOUCHES, PartialMeasurement, Reason, StoppingCriteria, StoppingDecision, decide,
    farthest_points, short_tour,
};

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
