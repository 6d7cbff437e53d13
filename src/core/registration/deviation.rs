//! Deviation of one measured point.

use rayon::prelude::*;

use crate::geometry::{Point, Vector};

/// Deviation of one measured point from the nominal surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Deviation {
    /// Contact point in the model frame: the centre moved back by the probe radius along the normal.
    pub point: Point,
    /// Unit normal of the nominal surface at the projection, towards the probe.
    pub normal: Vector,
    /// Signed deviation in millimetres, positive where material is above the nominal surface.
    pub deviation_mm: f64,
    /// Standard uncertainty of the deviation in millimetres: residual noise and pose uncertainty combined.
    pub uncertainty_mm: f64,
    /// Status of the point.
    pub status: PointStatus,
    /// True if the pose was fitted to this point. False if the point is far from the surface, because of form or of a
    /// faulty touch.
    pub in_fit: bool,
}

/// Status of a measured point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PointStatus {
    /// Inlier: it counts in every figure.
    Inlier,
    /// Outlier: it is far from the surface, and no neighbour confirms it.
    Outlier,
    /// The projection is beyond the edge of the nominal surface.
    OffPart,
}

/// Number of points of each status.
#[derive(Clone, Copy, Default)]
pub(super) struct StatusCounts {
    pub(super) outliers: usize,
    pub(super) off_part: usize,
    /// Points on the part that were left out of the fit.
    pub(super) left_out_of_fit: usize,
}

impl StatusCounts {
    /// Counts the points of each status. Runs on all threads, because with many points memory access takes most of the
    /// time.
    pub(super) fn count(deviations: &[Deviation]) -> Self {
        let of_one = |d: &Deviation| Self {
            outliers: usize::from(d.status == PointStatus::Outlier),
            off_part: usize::from(d.status == PointStatus::OffPart),
            left_out_of_fit: usize::from(d.status != PointStatus::OffPart && !d.in_fit),
        };
        let add = |a: Self, b: Self| Self {
            outliers: a.outliers + b.outliers,
            off_part: a.off_part + b.off_part,
            left_out_of_fit: a.left_out_of_fit + b.left_out_of_fit,
        };
        let of_some = |some: &[Deviation]| some.iter().map(of_one).fold(Self::default(), add);
        deviations.par_chunks(1 << 14).map(of_some).reduce(Self::default, add)
    }
}
