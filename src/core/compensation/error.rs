//! Errors of the maps: of filter, spline and correction.

use thiserror::Error;

use super::filter::{MAX_FILTER_NODES, MIN_READINGS};
use super::spline::SplineError;
use crate::geometry::GridError;

/// Reason why no map can be computed.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum MapError {
    #[error(transparent)]
    Grid(#[from] GridError),
    #[error(transparent)]
    Spline(#[from] SplineError),
    #[error("the cut-off is {cutoff_mm} mm; it must be above 0")]
    Cutoff { cutoff_mm: f64 },
    #[error("{name} is {value}; it must be {wanted}")]
    Option { name: &'static str, value: f64, wanted: &'static str },
    #[error("deviation number {} is not a finite number; do not use this measurement", index + 1)]
    NotFinite { index: usize },
    #[error(
        "only {valid} of {nodes} nodes have {MIN_READINGS} measured points within the cut-off of {cutoff_mm} mm; \
         measure more densely or choose a longer cut-off"
    )]
    TooSparse { valid: usize, nodes: usize, cutoff_mm: f64 },
    #[error(
        "a cut-off of {cutoff_mm} mm on a grid of {width_mm:.1} x {depth_mm:.1} mm requires {nodes:.0} nodes for the \
         filter, more than {MAX_FILTER_NODES:.0}; choose a longer cut-off"
    )]
    CutoffTooShort { cutoff_mm: f64, width_mm: f64, depth_mm: f64, nodes: f64 },
    #[error(
        "the cut-off of {cutoff_mm:.3} mm is below {min_mm:.3} mm, twice the contact width of the wheel, \
         {contact_width_mm:.3} mm: the wheel cannot grind shorter waves; choose a longer cut-off or a smaller wheel"
    )]
    CutoffBelowContact { cutoff_mm: f64, min_mm: f64, contact_width_mm: f64 },
    #[error(
        "the cut-off of {cutoff_mm:.3} mm is below {min_mm:.3} mm, twice the distance between measured points, \
         {point_spacing_mm:.3} mm: the points do not show shorter waves; choose a longer cut-off or measure more \
         densely"
    )]
    CutoffBelowSpacing { cutoff_mm: f64, min_mm: f64, point_spacing_mm: f64 },
    #[error("{found} values are given for a grid of {nodes} nodes; give one for each node")]
    Shape { found: usize, nodes: usize },
}
