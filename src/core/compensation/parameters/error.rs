//! Errors of the estimation of machine parameters.

use thiserror::Error;

use super::kinds::{MIN_NZ, MIN_POINTS};
use crate::model::ModelError;

/// Reason why the parameters cannot be estimated.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum ParameterError {
    #[error(
        "{points} points are too few to separate the machine parameters from the form of the part; measure at least \
         {MIN_POINTS} points"
    )]
    TooFew { points: usize },
    #[error(
        "point number {} has a coordinate, normal or deviation that is not a finite number; do not use this \
         measurement",
        index + 1
    )]
    NotFinite { index: usize },
    #[error(
        "the surface normal at point number {} has the z component {nz:.4}; this component must be at least {MIN_NZ}, \
         because the wheel comes from above; check the orientation of the part",
        index + 1
    )]
    Normal { index: usize, nz: f64 },
    #[error(
        "{found} values of the progress along the path are given for {points} points; give one value for each point"
    )]
    Progress { found: usize, points: usize },
    #[error("the wheel radius is {radius_mm} mm; it must be above 0")]
    WheelRadius { radius_mm: f64 },
    #[error("{what} is {value}; it must be finite and {limit}")]
    Stated { what: &'static str, value: f64, limit: &'static str },
    #[error("the machine parameters cannot be separated from the form of the part: {0}")]
    Field(#[from] ModelError),
}
