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

mod between;
mod budget;
mod dense;
mod effects;
mod error;
mod field;
mod fields;
mod figures;
mod form;
mod growing;
mod hill;
mod kind;
mod machine;
mod matern;
mod normals;
mod posterior;
mod priors;
mod sessions;
mod taught;
mod touches;
mod waves;

pub use budget::Share;
pub use dense::{Dense, Predicted};
pub use effects::Effects;
pub use error::ModelError;
pub use field::{Field, Lay, Smoothness};
pub use figures::{AngleInterval, AreaOptions, IsoFigures, SlopeFigures};
pub use form::{Form, FormFigures, FormPoint, Given, Interval};
pub use growing::Growing;
pub use machine::{Machine, Source};
pub use priors::Priors;
pub use sessions::{Between, Foretold, Sessions};
pub use taught::{Lesson, Taught};
pub use touches::{FEWEST, FIRST, Look, MOST_BATCHES, Purpose, SoFar, Why, look, short_way, spread};

use nalgebra::DMatrix;

/// What the model has to know before it can tell anything.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hyper {
    /// The field.
    pub field: Field,
    /// Standard deviation by which a point scatters by itself.
    pub scatter_mm: f64,
    /// How much of its scatter the next point along the path has, from 0, where each scatters on its own, to below 1: a scanning
    /// probe drifts. Points k steps apart share this to the power of k.
    pub drift: f64,
}

/// What was measured. All three have a row a point.
#[derive(Clone, Debug)]
pub struct Observed {
    /// Where.
    pub places: Vec<[f64; 2]>,
    /// What.
    pub deviations_mm: Vec<f64>,
    /// What a unit of each effect that nobody knows adds to it, such as the motions of the part; may have no column.
    pub effects: DMatrix<f64>,
    /// What a standard uncertainty of each effect that somebody states adds to it, such as those of the machine; may have no column.
    pub stated: DMatrix<f64>,
    /// Which point of a path each of them is; empty where they were not measured along one.
    pub path: Vec<f64>,
}

impl Observed {
    /// Deviations of which nothing moves them all.
    pub fn without_effects(places: Vec<[f64; 2]>, deviations_mm: Vec<f64>) -> Self {
        let [effects, stated] = [0, 0].map(|columns| DMatrix::zeros(places.len(), columns));
        Self { places, deviations_mm, effects, stated, path: Vec::new() }
    }

    /// Some of them.
    fn only(&self, chosen: &[usize]) -> Self {
        Self {
            places: chosen.iter().map(|&k| self.places[k]).collect(),
            deviations_mm: chosen.iter().map(|&k| self.deviations_mm[k]).collect(),
            effects: self.effects.select_rows(chosen),
            stated: self.stated.select_rows(chosen),
            path: self.path_of(chosen),
        }
    }

    /// The effects that nobody knows, and beside them those that are stated.
    fn all_effects(&self) -> DMatrix<f64> {
        let (n, p) = self.effects.shape();
        DMatrix::from_fn(
            n,
            p + self.stated.ncols(),
            |r, c| {
                if c < p { self.effects[(r, c)] } else { self.stated[(r, c - p)] }
            },
        )
    }

    fn path_of(&self, chosen: &[usize]) -> Vec<f64> {
        if self.path.is_empty() { Vec::new() } else { chosen.iter().map(|&k| self.path[k]).collect() }
    }

    /// Says what makes these no observations.
    fn check(&self) -> Result<(), ModelError> {
        let Self { places, deviations_mm, effects, stated, path } = self;
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

impl Hyper {
    /// Finds the parameters that what was measured speaks for, as one number each: the middle of those that may be.
    ///
    /// # Errors
    /// Rows that do not belong together, too few points, effects that cannot be told apart, expectations that cannot be.
    pub fn of(observed: &Observed, priors: Option<&Priors>) -> Result<Self, ModelError> {
        if let Some(priors) = priors {
            priors.check()?;
        }
        observed.check()?;
        let fields = posterior::laid(observed)?;
        Ok(posterior::Posterior::of(&fields, observed, priors, None).middle())
    }

    /// How much of their scatter two points share that are so many steps of the path apart.
    fn shared(&self, steps: f64) -> f64 {
        // Further apart nothing is left of it.
        const FAR: f64 = 36.0;
        if self.drift == 0.0 {
            return if steps == 0.0 { 1.0 } else { 0.0 };
        }
        let power = steps.abs() * self.drift.ln();
        if power < -FAR { 0.0 } else { power.exp() }
    }

    /// Says what makes these no parameters.
    fn check(&self) -> Result<(), ModelError> {
        let Self { field, scatter_mm, drift } = *self;
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
