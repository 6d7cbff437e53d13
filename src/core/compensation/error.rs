//! Errors of the maps: of filter, spline and correction.

use thiserror::Error;

use super::filter::{LEAST_READINGS, MOST_WORKED};
use super::spline::SplineError;
use crate::geometry::GridError;

/// Error that prevents a map.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum MapError {
    #[error(transparent)]
    Grid(#[from] GridError),
    #[error(transparent)]
    Spline(#[from] SplineError),
    #[error("a cut-off of {cutoff_mm} mm is asked for; it must be above 0")]
    Cutoff { cutoff_mm: f64 },
    #[error("{name} of {value} is asked for; it must be {wanted}")]
    Option { name: &'static str, value: f64, wanted: &'static str },
    #[error("deviation {} is not finite; the measurement must not be used", index + 1)]
    NotFinite { index: usize },
    #[error(
        "only {valid} of {nodes} nodes have {LEAST_READINGS} measured points around them within the cut-off of {cutoff_mm} mm; measure more \
         densely or choose a longer cut-off"
    )]
    TooSparse { valid: usize, nodes: usize, cutoff_mm: f64 },
    #[error(
        "a cut-off of {cutoff_mm} mm on a grid of {width_mm:.1} x {depth_mm:.1} mm needs {nodes:.0} nodes to filter on, more than \
         {MOST_WORKED:.0}; choose a longer cut-off"
    )]
    CutoffTooShort { cutoff_mm: f64, width_mm: f64, depth_mm: f64, nodes: f64 },
    #[error(
        "a cut-off of {cutoff_mm:.3} mm is below {least_mm:.3} mm, twice the width of {contact_width_mm:.3} mm over which the wheel touches: \
         shorter waves cannot be ground; choose a longer cut-off or a smaller wheel"
    )]
    CutoffBelowContact { cutoff_mm: f64, least_mm: f64, contact_width_mm: f64 },
    #[error(
        "a cut-off of {cutoff_mm:.3} mm is below {least_mm:.3} mm, twice the distance of {point_spacing_mm:.3} mm between measured points: \
         shorter waves are not seen; choose a longer cut-off or measure more densely"
    )]
    CutoffBelowSpacing { cutoff_mm: f64, least_mm: f64, point_spacing_mm: f64 },
    #[error("{found} values are given for a grid of {nodes} nodes; there must be one for each")]
    Shape { found: usize, nodes: usize },
}
