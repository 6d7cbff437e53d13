//! Poses, apertures and grids: the basic types of all other modules.
//!
//! Pure: no file, no clock, no randomness. Lengths are in millimetres, angles in radians.

pub mod aperture;
pub mod deviation_sample;
mod far_off;
pub mod grid;
mod grid_map;
pub mod grid_recognition;
mod point_tree;
pub mod pose;
pub mod rigid;

pub use aperture::{Aperture, ApertureError};
pub use deviation_sample::DeviationSample;
pub(crate) use far_off::find_far_off;
pub use grid::{Grid, GridError};
pub use grid_map::GridMap;
pub use grid_recognition::{GriddedCloud, recognise_grid};
pub(crate) use point_tree::PointTree;
pub use pose::{Pose, PoseError, Twist};
pub use rigid::{RigidError, RigidFit, fit_rigid};

/// A position in space, in millimetres.
pub type Point = nalgebra::Point3<f64>;

/// A direction or a displacement in space.
pub type Vector = nalgebra::Vector3<f64>;

/// Returns the smallest rectangle along the axes that contains all `places`: `[[x min, y min], [x max, y max]]`.
/// Without places, the minima are +infinity and the maxima -infinity.
pub(crate) fn bounds(places: impl Iterator<Item = [f64; 2]>) -> [[f64; 2]; 2] {
    places.fold([[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]], |[low, high], [x, y]| {
        [[low[0].min(x), low[1].min(y)], [high[0].max(x), high[1].max(y)]]
    })
}
