//! Compensation: turns deviations into a map and the map into a correction, and checks the response of the part.
//!
//! ```text
//!  deviations --error_map--> ErrorMap --next_pass--> Correction --(ground, measured)--> Response
//!  (scattered)               (filtered, on a grid)   (absolute, versioned)              (change as commanded?)
//!      |
//!      +--estimate_parameters--> ParameterEstimation --from_values--> ParameterCorrections (not part of the map)
//! ```
//!
//! Pure: no file, no clock, no randomness. Frames: everything is over x and y of the model frame {M}. Units:
//! millimetres. Signs: a deviation is positive where material stands proud. A correction is positive where the
//! surface is to be higher along the outward normal, so that a correction compensates a deviation of the opposite
//! sign.

mod correction;
mod cutoff_limits;
mod error;
mod filter;
mod inliers;
mod learning;
mod level_off;
mod machine_transfer;
mod map;
mod next_pass;
mod parameters;
pub mod path;
mod response;
mod robust_filter;
mod spline;

pub use correction::Correction;
pub use cutoff_limits::{contact_width_mm, point_spacing_mm};
pub use error::MapError;
pub use filter::FilterOrder;
pub use learning::{GainRule, LearningState, ParameterExplainer, PassObservation};
pub use machine_transfer::{MachineSimilarity, TransferredState, contradicting_machines};
pub use map::{ErrorMap, FilteredGrid, MapOptions, Smoothing, error_map, filter_grid, map_from_model};
pub use next_pass::{CorrectionLimits, NextPass, NextPassError};
pub use parameters::{
    EstimatedParameter, ExplainedDeviation, ParameterCorrections, ParameterError, ParameterEstimation, ParameterKind,
    ParameterOptions, SurfacePoint, WheelTerm, estimate_parameters, explained_by_parameters,
};
pub use response::{Response, estimate_response};
pub use spline::{SplineError, SplineSmoothness};
