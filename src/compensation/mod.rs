//! What to remove next? Turns deviations into a map, the map into a correction, and tells whether the part answered.
//!
//! ```text
//!  deviations --error_map--> ErrorMap --Correction::next--> Correction --(ground, measured)--> Response
//!  (scattered)               (filtered, on a net)           (absolute, versioned)              (did it answer as commanded?)
//! ```
//!
//! Pure: no file, no clock, no randomness. Frames: everything is over x and y of the model frame {M}. Units: millimetres. Signs:
//! a deviation is positive where material stands proud; a correction is positive where the surface is wanted higher, along the
//! outward normal, so that a correction takes back a deviation of the opposite sign.

mod correction;
mod map;
mod net;
pub mod path;
mod response;

pub use correction::{Correction, CorrectionLimits, Step, StepError};
pub use map::{ErrorMap, MapError, MapOptions, Reading, error_map};
pub use net::{Net, NetError};
pub use response::{Response, Sense, response};
