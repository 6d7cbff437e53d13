//! Observations of a field, and its hyperparameters.

use nalgebra::DMatrix;

use super::error::ModelError;
use super::field::Field;
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
    pub(super) fn subset(&self, chosen: &[usize]) -> Self {
        Self {
            places: chosen.iter().map(|&k| self.places[k]).collect(),
            deviations_mm: chosen.iter().map(|&k| self.deviations_mm[k]).collect(),
            fixed_effects: self.fixed_effects.select_rows(chosen),
            random_effects: self.random_effects.select_rows(chosen),
            path: if self.path.is_empty() { Vec::new() } else { chosen.iter().map(|&k| self.path[k]).collect() },
        }
    }

    /// Returns one matrix with all effects: the columns of the fixed effects, then those of the random effects.
    pub(super) fn all_effects(&self) -> DMatrix<f64> {
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
    pub(super) fn check(&self) -> Result<(), ModelError> {
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
pub(super) fn orthonormal_base(columns: DMatrix<f64>) -> DMatrix<f64> {
    if columns.ncols() > 0 { columns.qr().q() } else { columns }
}

/// Returns the typical spacing of the places, in mm: the square root of the area per place, with the area of the
/// bounding rectangle of all places.
pub(super) fn spacing_mm(places: &[[f64; 2]]) -> f64 {
    let [low, high] = bounds(places.iter().copied());
    ((high[0] - low[0]) * (high[1] - low[1]) / places.len() as f64).sqrt()
}
