//! Errors of the model.

use thiserror::Error;

/// Reason why a model cannot be fitted. Points count from 0.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum ModelError {
    #[error(
        "{points} places, {deviations} deviations and {rows} rows of effects do not match; give, for each place, one \
         deviation, one row of fixed and of random effects, and one finite position on the path, if there is a path"
    )]
    Shape { points: usize, deviations: usize, rows: usize },
    #[error("the model requires at least {min_points} points; {points} are given; measure more points")]
    TooFewPoints { points: usize, min_points: usize },
    #[error("point {} has a number that is not finite; remove this point", point + 1)]
    NotFinite { point: usize },
    #[error("the {what} is {value} mm; it must be finite and above 0")]
    Hyperparameter { what: &'static str, value: f64 },
    #[error(
        "the lay (anisotropy) of the field has the direction {along:?} and the stretch {stretch}; the direction must \
         be a unit vector, and the stretch, the ratio of the ranges along and across it, at least 1"
    )]
    Anisotropy { along: [f64; 2], stretch: f64 },
    #[error(
        "the standard uncertainty of the {what} is {value} (mm, rad or a share); it must be at least 0, and at most \
         0.1 for scale, squareness and temperature or 10 for the others; correct the stated value"
    )]
    StatedUncertainty { what: &'static str, value: f64 },
    #[error(
        "the prior of the {what} has the median {median} and the factor {factor}; the median must be finite and \
         above 0, the factor finite and above 1"
    )]
    Prior { what: &'static str, median: f64, factor: f64 },
    #[error("the noise autocorrelation is {value}; it must be at least 0 and below 1")]
    NoiseAutocorrelation { value: f64 },
    #[error(
        "the covariance of the points is not positive definite: their noise is too small compared with the field, or \
         places coincide; remove repeated points or state a larger noise"
    )]
    NotDefinite,
    #[error(
        "these points do not separate the effects: at these points, one effect is nearly a combination of the others; \
         remove this effect, or measure points at which it differs"
    )]
    CollinearEffects,
    #[error(
        "the eigenproblem of a field with the range {range_mm} mm has no solution in floating-point numbers; remove \
         points whose deviations or places differ by many orders of magnitude from the others"
    )]
    Eigenproblem { range_mm: f64 },
    #[error(
        "the points belong to {sessions} session; at least {min_sessions} are required for the variance between \
         sessions; measure once more, or from another station"
    )]
    TooFewSessions { sessions: usize, min_sessions: usize },
    #[error("{points} points and {sessions} session numbers do not match; give one session number for each point")]
    Sessions { points: usize, sessions: usize },
}
