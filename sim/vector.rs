//! Vectors in space.

use crate::Vec3;

/// Returns the scalar product of two vectors.
pub(crate) fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Returns the vector product of two vectors.
pub(crate) fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Returns the length of a vector.
pub(crate) fn length(v: Vec3) -> f64 {
    dot(v, v).sqrt()
}

/// Returns the distance of two points.
pub(crate) fn distance(a: Vec3, b: Vec3) -> f64 {
    length(std::array::from_fn(|k| b[k] - a[k]))
}

/// Returns the unit normal of the plane that two vectors span.
pub(crate) fn unit_normal(tx: Vec3, ty: Vec3) -> Vec3 {
    let m = cross(tx, ty);
    let norm = length(m);
    m.map(|c| c / norm)
}
