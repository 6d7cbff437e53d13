//! What is found of one measured point.

use crate::geometry::{Point, Vector};

/// One measured point against the nominal surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Deviation {
    /// The contact point in the model frame: the centre moved back by the probe radius along the normal.
    pub point: Point,
    /// Unit normal of the nominal surface at the foot, towards the probe.
    pub normal: Vector,
    /// Signed distance in millimetres, positive where material stands proud.
    pub deviation_mm: f64,
    /// Standard uncertainty of the deviation in millimetres: the residual noise and the pose together.
    pub uncertainty_mm: f64,
    /// What became of the point.
    pub status: PointStatus,
    /// Whether the pose was fitted to it: not to what is far from the surface, be it form or a touch gone wrong.
    pub in_fit: bool,
}

/// What became of a measured point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PointStatus {
    /// It counts in every figure.
    Used,
    /// It is far from the surface, and no neighbour found the same.
    Outlier,
    /// Its foot lies beyond the edge of the nominal surface.
    OffPart,
}
