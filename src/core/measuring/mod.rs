//! Measuring: the targets of the probe, its real radius, and the temperature of the part.
//!
//! ```text
//!  nominal, pattern --targets--> where the probe touches, in the model frame
//!  centres on the reference sphere --fit_sphere--> the real radius of the probe
//!  points of a warm part --Expansion--> the same points at 20 degrees Celsius
//! ```
//!
//! Pure: no file, no clock, no randomness. Units: millimetres. Frames: targets are in the model frame {M}, and centres
//! on the sphere are in the CMM frame {W}.

mod pattern;
mod sphere;
mod thermal_expansion;

pub use pattern::{Layout, PatternError, Target, sphere_targets, targets};
pub use sphere::{SphereFit, SphereFitError, fit_sphere};
pub use thermal_expansion::{REFERENCE_TEMPERATURE_C, ThermalExpansion};
