//! One model of the error of a part: a rigid motion, a smooth random field, and the scatter of the probe.
//!
//! ```text
//!  deviations at points --> Fields: smoothness and range, one eigenproblem each --> Posterior: each with every strength and scatter, and its
//!                                                                                        |            probability
//!                                                                                        +--> forms drawn from all of them: figures, map, frame
//! ```
//!
//! The deviation of point i is d_i = h_i' b + f(x_i) + e_i. The rows h_i are what the registration could still move (its Jacobian), with
//! no knowledge of b beforehand; f is a field whose smoothness, range and strength nobody knows; e_i is independent, or shared
//! with the points before it along the path where the probe drifts. Motion and field are told together, for a
//! direction in which the surface does not hold the part looks like form: whoever takes one for known gives the other a lie.
//!
//! [`Dense`] has the covariance of every pair of points by one set of parameters, [`Growing`] the same as points come.
//!
//! [`Sessions`] tells what comes back in several measurements from what is of each alone.
//!
//! Frame: places lie in the plane of projection of the model {M}. Units: millimetres.

mod basis;
mod budget;
mod dense;
mod effects;
mod error;
mod field;
mod figures;
mod form;
mod hypotheses;
mod incremental;
mod intermediate;
mod machine_uncertainty;
mod matern;
mod nelder_mead;
mod noise_kind;
mod normals;
mod part_priors;
mod posterior;
mod priors;
mod sessions;
mod stopping;

pub use budget::BudgetEntry;
pub use dense::{DensePosterior, Prediction};
pub use effects::EffectEstimates;
pub use error::ModelError;
pub use field::{Anisotropy, Field, Smoothness};
pub use figures::{AngleInterval, AreaOptions, IsoFigures, SlopeFigures};
pub use form::{Form, FormFigures, FormPoint, Interval, ModelInputs};
pub use incremental::IncrementalPosterior;
pub use machine_uncertainty::{MachineUncertainty, UncertaintySource};
pub use part_priors::{PartFit, PartPriors};
pub use priors::Prior;
pub use sessions::{BetweenSessionVariance, PredictionInterval, Sessions};
pub use stopping::{
    FIRST_BATCH, MAX_BATCHES, MIN_TOUCHES, PartialMeasurement, Reason, StoppingCriteria, StoppingDecision, decide,
    farthest_points, short_tour,
};

use nalgebra::DMatrix;

/// What the model has to know before it can tell anything.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hyperparameters {
    /// The field.
    pub field: Field,
    /// Standard deviation by which a point scatters by itself.
    pub noise_sigma_mm: f64,
    /// How much of its scatter the next point along the path has, from 0, where each scatters on its own, to below 1: a scanning
    /// probe drifts. Points k steps apart share this to the power of k.
    pub noise_autocorrelation: f64,
}

/// What was measured. All three have a row a point.
#[derive(Clone, Debug)]
pub struct Observed {
    /// Where.
    pub places: Vec<[f64; 2]>,
    /// What.
    pub deviations_mm: Vec<f64>,
    /// What a unit of each effect that nobody knows adds to it, such as the motions of the part; may have no column.
    pub fixed_effects: DMatrix<f64>,
    /// What a standard uncertainty of each effect that somebody states adds to it, such as those of the machine; may have no column.
    pub random_effects: DMatrix<f64>,
    /// Which point of a path each of them is; empty where they were not measured along one.
    pub path: Vec<f64>,
}

impl Observed {
    /// Deviations of which nothing moves them all.
    pub fn without_effects(places: Vec<[f64; 2]>, deviations_mm: Vec<f64>) -> Self {
        let [effects, stated] = [0, 0].map(|columns| DMatrix::zeros(places.len(), columns));
        Self { places, deviations_mm, fixed_effects: effects, random_effects: stated, path: Vec::new() }
    }

    /// Some of them.
    fn subset(&self, chosen: &[usize]) -> Self {
        Self {
            places: chosen.iter().map(|&k| self.places[k]).collect(),
            deviations_mm: chosen.iter().map(|&k| self.deviations_mm[k]).collect(),
            fixed_effects: self.fixed_effects.select_rows(chosen),
            random_effects: self.random_effects.select_rows(chosen),
            path: self.path_of(chosen),
        }
    }

    /// The effects that nobody knows, and beside them those that are stated.
    fn all_effects(&self) -> DMatrix<f64> {
        let (n, p) = self.fixed_effects.shape();
        DMatrix::from_fn(n, p + self.random_effects.ncols(), |r, c| {
            if c < p { self.fixed_effects[(r, c)] } else { self.random_effects[(r, c - p)] }
        })
    }

    fn path_of(&self, chosen: &[usize]) -> Vec<f64> {
        if self.path.is_empty() { Vec::new() } else { chosen.iter().map(|&k| self.path[k]).collect() }
    }

    /// Says what makes these no observations.
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
            return Err(ModelError::TooFewPoints { points, least: columns + 1 });
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

/// How far apart the points of a part lie, as if each had as much of the rectangle around them.
fn spacing_mm(places: &[[f64; 2]]) -> f64 {
    let span = |axis: usize| {
        let of = places.iter().map(|place| place[axis]);
        of.clone().fold(f64::NEG_INFINITY, f64::max) - of.fold(f64::INFINITY, f64::min)
    };
    (span(0) * span(1) / places.len() as f64).sqrt()
}

impl Hyperparameters {
    /// Finds the parameters that what was measured speaks for, as one number each: the middle of those that may be.
    ///
    /// # Errors
    /// Rows that do not belong together, too few points, effects that cannot be told apart, expectations that cannot be.
    pub fn estimate(observed: &Observed, priors: Option<&Prior>) -> Result<Self, ModelError> {
        if let Some(priors) = priors {
            priors.check()?;
        }
        observed.check()?;
        let fields = posterior::select_hypotheses(observed)?;
        Ok(posterior::Posterior::of(&fields, observed, priors, None).mean_hyperparameters())
    }

    /// How much of their scatter two points share that are so many steps of the path apart.
    fn noise_correlation(&self, steps: f64) -> f64 {
        // Further apart nothing is left of it.
        const FAR: f64 = 36.0;
        if self.noise_autocorrelation == 0.0 {
            return if steps == 0.0 { 1.0 } else { 0.0 };
        }
        let power = steps.abs() * self.noise_autocorrelation.ln();
        if power < -FAR { 0.0 } else { power.exp() }
    }

    /// Says what makes these no parameters.
    fn check(&self) -> Result<(), ModelError> {
        let Self { field, noise_sigma_mm: scatter_mm, noise_autocorrelation: drift } = *self;
        field.check()?;
        if !(scatter_mm.is_finite() && scatter_mm > 0.0) {
            return Err(ModelError::Hyper { what: "scatter", value: scatter_mm });
        }
        if !(0.0..1.0).contains(&drift) {
            return Err(ModelError::Drift { value: drift });
        }
        Ok(())
    }
}
