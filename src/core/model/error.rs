//! Errors of the model.

use thiserror::Error;

/// Reason why a model cannot be fitted. Points count from 0.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum ModelError {
    #[error("{points} places, {deviations} deviations and {rows} rows of effects do not belong together")]
    Shape { points: usize, deviations: usize, rows: usize },
    #[error("a model needs {least} points at least, {points} were given")]
    TooFewPoints { points: usize, least: usize },
    #[error("point {} has a number that is none", point + 1)]
    NotFinite { point: usize },
    #[error("the {what} is {value} mm; it must be finite and above 0")]
    Hyper { what: &'static str, value: f64 },
    #[error(
        "the lay of the field goes along {along:?} and stretches it {stretch} times; it must be a unit vector, and 1 time at least"
    )]
    Lay { along: [f64; 2], stretch: f64 },
    #[error(
        "the standard uncertainty of the {what} is {value} (mm, rad or a share); it must be 0 at least and what a machine or a fixture can have: correct what is stated of it"
    )]
    Stated { what: &'static str, value: f64 },
    #[error(
        "the {what} is expected to be {median} by a factor of {factor}; the one must be finite and above 0, the other finite and above 1: nothing is known for certain beforehand"
    )]
    Expected { what: &'static str, median: f64, factor: f64 },
    #[error("the drift is {value}; it must be 0 at least and below 1")]
    Drift { value: f64 },
    #[error(
        "the covariance of the points is not definite: their scatter is too small beside the field, or places coincide"
    )]
    NotDefinite,
    #[error("the effects cannot be told apart by these points; leave out what the surface does not show")]
    EffectsAlike,
    #[error(
        "the points are of {sessions} session; what differs between sessions is told by {least} at least: measure once more, or from another station"
    )]
    TooFewSessions { sessions: usize, least: usize },
    #[error("{points} points and {sessions} numbers of their sessions do not belong together")]
    Sessions { points: usize, sessions: usize },
}
