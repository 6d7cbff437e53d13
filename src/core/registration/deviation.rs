//! What is found of one measured point.

use rayon::prelude::*;

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

/// How many points became what.
#[derive(Clone, Copy, Default)]
pub(super) struct Counts {
    pub(super) outliers: usize,
    pub(super) off_part: usize,
    /// Points on the part that the pose was not fitted to.
    pub(super) left: usize,
}

impl Counts {
    /// Counts on all threads: of many points most of the time is taken by memory.
    pub(super) fn of(deviations: &[Deviation]) -> Self {
        let of_one = |d: &Deviation| Self {
            outliers: usize::from(d.status == PointStatus::Outlier),
            off_part: usize::from(d.status == PointStatus::OffPart),
            left: usize::from(d.status != PointStatus::OffPart && !d.in_fit),
        };
        let add = |a: Self, b: Self| Self {
            outliers: a.outliers + b.outliers,
            off_part: a.off_part + b.off_part,
            left: a.left + b.left,
        };
        let of_some = |some: &[Deviation]| some.iter().map(of_one).fold(Self::default(), add);
        deviations.par_chunks(1 << 14).map(of_some).reduce(Self::default, add)
    }
}
