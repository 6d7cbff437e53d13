//! Errors of the form figures.

use thiserror::Error;

use crate::geometry::Sample;

/// Reason why a form figure cannot be computed.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum FormError {
    #[error("{points} points, and at least {least} are needed; measure more of them or ask for fewer terms")]
    TooFewPoints { points: usize, least: usize },
    #[error("point {} has a place or a deviation that is not a finite number; leave it out", index + 1)]
    NotFinite { index: usize },
    #[error("the points lie at one place or on a line, and a figure of an area needs an area; measure across the part")]
    NoArea,
    #[error(
        "the term {term} cannot be told from those before it by {points} points as they lie; measure more densely or ask for \
         fewer terms"
    )]
    Undetermined { term: String, points: usize },
    #[error("{terms} terms are asked for, and {basis} has 1 to {most}; ask for fewer")]
    Terms { terms: usize, basis: &'static str, most: usize },
    #[error(
        "point {} lies {distance_mm} mm from the middle of polynomials with a radius of {radius_mm} mm, beyond one and a half times it; \
         correct the aperture or leave the point out", index + 1
    )]
    FarOut { index: usize, distance_mm: f64, radius_mm: f64 },
    #[error("the wavelength is {wavelength_nm} nm; it must be a finite number above 0")]
    Wavelength { wavelength_nm: f64 },
    #[error("an integration length of {integration_mm} mm is asked for; it must be a finite number above 0")]
    Integration { integration_mm: f64 },
    #[error(
        "no node of the map has measured neighbours {integration_mm} mm apart along both axes; choose a shorter integration length or \
         measure more densely"
    )]
    NoSlope { integration_mm: f64 },
}

/// Rejects samples that are too few or not finite.
pub(super) fn check(samples: &[Sample], least: usize) -> Result<(), FormError> {
    if samples.len() < least {
        return Err(FormError::TooFewPoints { points: samples.len(), least });
    }
    match samples.iter().position(|sample| !sample.is_finite()) {
        Some(index) => Err(FormError::NotFinite { index }),
        None => Ok(()),
    }
}
