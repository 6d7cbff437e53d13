//! Poses, apertures and grids: the words every other room speaks in.
//!
//! Pure: no file, no clock, no randomness. Lengths are millimetres, angles radians.

pub mod aperture;
pub mod grid;
pub mod grid_order;
mod nearest;
pub mod pose;
pub mod rigid;
pub mod sample;

pub use aperture::{Aperture, ApertureError};
pub use grid::{Grid, GridError};
pub use grid_order::{GridOrder, recognise_grid};
pub(crate) use nearest::Nearest;
pub use pose::{Pose, PoseError, Twist};
pub use rigid::{RigidError, RigidFit, fit_rigid};
pub use sample::Sample;

/// A position in space, in millimetres.
pub type Point = nalgebra::Point3<f64>;

/// A direction or a displacement in space.
pub type Vector = nalgebra::Vector3<f64>;
