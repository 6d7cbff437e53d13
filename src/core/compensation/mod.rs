//! Compensation: turns deviations into a map and the map into a correction, and checks the response of the part.
//!
//! ```text
//!  deviations --error_map--> ErrorMap --Correction::next--> Correction --(ground, measured)--> Response
//!  (scattered)               (filtered, on a grid)           (absolute, versioned)              (answer as commanded?)
//!      |
//!      +--parameters--> Parameters --Set--> (wheel radius, setting, tilt: corrected as such, not baked into the map)
//! ```
//!
//! Pure: no file, no clock, no randomness. Frames: everything is over x and y of the model frame {M}. Units:
//! millimetres. Signs: a deviation is positive where material stands proud. A correction is positive where the
//! surface is to be higher along the outward normal, so that a correction compensates a deviation of the opposite
//! sign.

mod correction;
mod error;
mod filter;
mod kept;
mod learning;
mod level;
mod map;
mod next_pass;
mod parameters;
pub mod path;
mod response;
mod robust;
mod sampling;
mod shared;
mod spline;

pub use correction::Correction;
pub use error::MapError;
pub use filter::Order;
pub use learning::{Forecast, GainRule, LearningState, Seen, Smoother};
pub use map::{ErrorMap, FilteredGrid, MapOptions, Smoothing, error_map, filter_grid, told_map};
pub use next_pass::{CorrectionLimits, NextPass, NextPassError};
pub use parameters::{
    Contact, Parameter, ParameterError, ParameterKind, ParameterOptions, Parameters, Set, Smooth, WheelTerm,
    parameters, smooth_of,
};
pub use response::{Response, Sense, response};
pub use sampling::{contact_width_mm, point_spacing_mm};
pub use shared::{Alike, Shared};
pub use spline::{Roughness, SplineError};
