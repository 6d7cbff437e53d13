//! Faces of CAD models: surfaces given by two parameters (u, v), evaluated exactly, and their outlines.
//!
//! ```text
//!  STEP, IGES --> Face { ParametricSurface, outline } --height_field--> z = f(x, y)   (as a formula)
//! ```
//!
//! Pure: no file, no clock. Lengths are in millimetres, in the frame of the model.

mod bspline;
mod curve;
mod face;
mod frame;
mod height_field;
mod parametric_surface;
mod trimmed_domain;

pub use bspline::{BSplineCurve, BSplineError, BSplineSurface, Knots, SurfacePoint};
pub use curve::Curve;
pub use face::{Face, FaceError, FaceFrame, FacePlacement, MAX_OUTLINE_PLACES, OUTLINE_TOLERANCE_MM};
pub use frame::Frame;
pub use height_field::HeightField;
pub use parametric_surface::{ParametricSurface, natural_outlines};
