//! What to measure, and can the probe be trusted?
//!
//! ```text
//!  nominal, pattern --targets--> where the probe shall touch, in the model frame
//!  centres on the reference sphere --fit_sphere--> the radius the probe really has
//!  points of a warm part --Expansion--> where they would be at 20 degrees Celsius
//! ```
//!
//! Pure: no file, no clock, no randomness. Units: millimetres. Frames: targets are in the model frame {M}, centres on the
//! sphere in the CMM frame {W}.

mod expansion;
mod pattern;
mod sphere;

pub use expansion::{Expansion, REFERENCE_C};
pub use pattern::{Layout, PatternError, Target, sphere_targets, targets};
pub use sphere::{SphereFit, SphereFitError, fit_sphere};
