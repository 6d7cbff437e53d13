//! The outline of a part in the plane.
