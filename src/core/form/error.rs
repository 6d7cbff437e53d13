//! Errors of the form figures.

use thiserror::Error;

use crate::geometry::DeviationSample;

/// Reason why a form figure cannot be computed.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum FormError {
    #[error(
        "there are {points} points; at least {min_points} are required; measure more points or request fewer terms"
    )]
    TooFewPoints { points: usize, min_points: usize },
    #[error("point {} has a position or a deviation that is not a finite number; remove this point", index + 1)]
    NotFinite { index: usize },
    #[error("the points lie at one place or on a line; a form figure requires an area; measure points across the part")]
    NoArea,
    #[error(
        "the positions of the {points} points do not separate the term {term} from the terms before it; measure more \
         densely or request fewer terms"
    )]
    Undetermined { term: String, points: usize },
    #[error("{terms} terms of {basis} polynomials are requested; request from 1 to {max_terms} terms")]
    Terms { terms: usize, basis: &'static str, max_terms: usize },
    #[error(
        "point {} lies {distance_mm} mm from the centre of the Zernike disc; the limit is 1.5 times the radius of the \
         disc, which is {radius_mm} mm; correct the aperture or remove the point", index + 1
    )]
    FarOut { index: usize, distance_mm: f64, radius_mm: f64 },
    #[error("the wavelength is {wavelength_nm} nm; it must be a finite number above 0")]
    Wavelength { wavelength_nm: f64 },
    #[error("the integration length is {integration_mm} mm; it must be a finite number above 0")]
    Integration { integration_mm: f64 },
    #[error(
        "no node of the map has measured neighbours {integration_mm} mm apart along both axes; choose a shorter integration length or \
         measure more densely"
    )]
    NoSlope { integration_mm: f64 },
}

/// Returns [`FormError::TooFewPoints`] if there are fewer than `least` samples, or [`FormError::NotFinite`] with the
/// index of the first sample whose position or deviation is not a finite number; otherwise `Ok`.
pub(super) fn check(samples: &[DeviationSample], least: usize) -> Result<(), FormError> {
    if samples.len() < least {
        return Err(FormError::TooFewPoints { points: samples.len(), min_points: least });
    }
    match samples.iter().position(|sample| !sample.is_finite()) {
        Some(index) => Err(FormError::NotFinite { index }),
        None => Ok(()),
    }
}
