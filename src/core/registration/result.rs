//! Result of a registration.

use crate::geometry::Pose;
use crate::surface::Side;

use super::deviation::{Deviation, PointStatus, StatusCounts};
use super::iterate::Iteration;
use super::quality::RegistrationQuality;

/// Result of a registration.
#[derive(Clone, Debug)]
pub struct Registration {
    /// Pose that maps model coordinates to CMM coordinates: g in the paper.
    pub cmm_from_model: Pose,
    /// Deviations, one for each measured point, in the order of the points.
    pub deviations: Vec<Deviation>,
    /// Trace of the iteration, including the steps that were undone.
    pub trace: Vec<Iteration>,
    /// Side of the nominal surface on which the probe was.
    pub side: Side,
    /// Uncertainty of the pose, figures and warnings.
    pub quality: RegistrationQuality,
}

/// Figures of the deviations that include the outliers on the part.
#[derive(Clone, Debug, PartialEq)]
pub struct FiguresWithOutliers {
    /// Number of outliers.
    pub outliers: usize,
    /// Root mean square of the deviations of all points on the part, in millimetres.
    pub rms_mm: f64,
    /// Largest minus smallest deviation of all points on the part, in millimetres.
    pub pv_mm: f64,
    /// Text that names the first outliers, with their places in the model frame and their deviations.
    pub description: String,
}

/// Number of outliers that are named one by one; the rest are counted.
const MAX_NAMED: usize = 5;

impl Registration {
    /// Returns the outliers, each with its index in the list of measured points, counted from 0.
    pub fn outliers(&self) -> impl Iterator<Item = (usize, &Deviation)> {
        self.deviations.iter().enumerate().filter(|(_, d)| d.status == PointStatus::Outlier)
    }

    /// Returns RMS and PV, in mm, of all points on the part including the outliers, with the number and a description
    /// of the outliers. Returns `None` if there are no outliers.
    pub fn figures_with_outliers(&self) -> Option<FiguresWithOutliers> {
        let points = StatusCounts::count(&self.deviations).outliers;
        if points == 0 {
            return None;
        }
        let named = self.outliers().take(MAX_NAMED).map(|(k, d)| {
            format!("point {k} at ({:.1}, {:.1}) mm by {:+.1} µm", d.point.x, d.point.y, 1e3 * d.deviation_mm)
        });
        let more = (points > MAX_NAMED).then(|| format!("and {} more", points - MAX_NAMED));
        let places = named.chain(more).collect::<Vec<_>>().join(", ");
        let on_part = self.deviations.iter().filter(|d| d.status != PointStatus::OffPart).map(|d| d.deviation_mm);
        let add =
            |(low, high, squares, n): (f64, f64, f64, usize), d: f64| (low.min(d), high.max(d), squares + d * d, n + 1);
        let (low, high, squares, n) = on_part.fold((f64::INFINITY, f64::NEG_INFINITY, 0.0, 0), add);
        Some(FiguresWithOutliers {
            outliers: points,
            rms_mm: (squares / n as f64).sqrt(),
            pv_mm: high - low,
            description: places,
        })
    }
}
