//! What a registration found.

use crate::geometry::Pose;
use crate::surface::Side;

use super::deviation::{Counts, Deviation, PointStatus};
use super::iterate::Iteration;
use super::verdict::Verdict;

/// What a registration found.
#[derive(Clone, Debug)]
pub struct Registration {
    /// Takes model coordinates to CMM coordinates: the paper's g.
    pub cmm_from_model: Pose,
    /// One for each measured point, in the order given.
    pub deviations: Vec<Deviation>,
    /// The trace of the iteration, steps taken back included.
    pub trace: Vec<Iteration>,
    /// The side on which the probe was.
    pub side: Side,
    /// How well the pose is known, and what to think of it.
    pub verdict: Verdict,
}

/// The figures of the deviations with those points that were left out although they lie on the part.
#[derive(Clone, Debug, PartialEq)]
pub struct WithLeftOut {
    /// How many were left out.
    pub points: usize,
    /// Root mean square of the deviations of the points used and of these, in millimetres.
    pub rms_mm: f64,
    /// Largest less least of them, in millimetres.
    pub pv_mm: f64,
    /// The first of them with their places in the model frame and their deviations, in words.
    pub places: String,
}

/// Points left out that are named one by one; the rest are counted.
const NAMED: usize = 5;

impl Registration {
    /// Returns the points that were left out as outliers, by their number.
    pub fn left_out(&self) -> impl Iterator<Item = (usize, &Deviation)> {
        self.deviations.iter().enumerate().filter(|(_, d)| d.status == PointStatus::Outlier)
    }

    /// Returns the figures with the outliers; none where there are none.
    pub fn with_left_out(&self) -> Option<WithLeftOut> {
        let points = Counts::of(&self.deviations).outliers;
        if points == 0 {
            return None;
        }
        let named = self.left_out().take(NAMED).map(|(k, d)| {
            format!("point {k} at ({:.1}, {:.1}) mm by {:+.1} um", d.point.x, d.point.y, 1e3 * d.deviation_mm)
        });
        let more = (points > NAMED).then(|| format!("and {} more", points - NAMED));
        let places = named.chain(more).collect::<Vec<_>>().join(", ");
        let on_part = self.deviations.iter().filter(|d| d.status != PointStatus::OffPart).map(|d| d.deviation_mm);
        let add =
            |(low, high, squares, n): (f64, f64, f64, usize), d: f64| (low.min(d), high.max(d), squares + d * d, n + 1);
        let (low, high, squares, n) = on_part.fold((f64::INFINITY, f64::NEG_INFINITY, 0.0, 0), add);
        Some(WithLeftOut { points, rms_mm: (squares / n as f64).sqrt(), pv_mm: high - low, places })
    }
}
