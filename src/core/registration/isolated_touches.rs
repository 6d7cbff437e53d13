//! Classification of the points that lie far from the surface: a single faulty touch, or form of the part.
//!
//! The fit rejects each point that is far from the surface and from its neighbours: a chip would tilt the pose. But if
//! two neighbouring touches deviate to the same side of the surface, the deviation is form, at any height. Both points
//! then count in every figure. Only an isolated touch counts in no figure.

use rayon::prelude::*;
use regrind_figures::statistics::median;

use crate::geometry::{Point, PointTree};

use super::deviation::{Deviation, PointStatus, StatusCounts};
use super::quality::RegistrationQuality;
use super::refit::MIN_SIGMA_MM;
use super::robust_loss::robust_median_and_sigma;

/// Number of neighbours to compare with, and number of nearest points whose median distance is the length scale.
const NEIGHBOURS: usize = 8;
const SCALE_NEIGHBOURS: u32 = 64;
/// Maximum distance of a neighbour, in units of the distance of the third nearest neighbour. In a square pattern this
/// includes the points along the sides and the diagonals.
const MAX_NEIGHBOUR_DISTANCE: f64 = 1.5 + 1e-3;
/// Distance of two touches below which they are repeats at one place, as a share of the length scale. A repeat has the
/// same fault as the first touch, so it confirms nothing.
const SAME_PLACE: f64 = 0.05;
/// Minimum height of a neighbour that confirms a point, as a share of the height of the point. Both heights are
/// measured from the local level.
const MIN_HEIGHT_SHARE: f64 = 0.1;
/// Minimum height of a neighbour that confirms a point, as a share of the height of the point, if both heights are
/// measured from the surface. It is larger because a neighbour on a hump is above the surface too.
const MIN_SURFACE_HEIGHT_SHARE: f64 = 0.25;

/// Changes the status of confirmed outliers to inlier. An outlier is confirmed if a close neighbour deviates to the
/// same side of the surface: the deviation is then a form error of the part, and not a faulty touch.
///
/// Examines all outliers. Updates `verdict`, the quality of the registration, for the new inliers: number of inliers,
/// objective, RMS and PV. Changes nothing if no outlier is confirmed. `outlier_sigmas` is the limit for an outlier, in
/// robust standard deviations of the deviations.
pub(super) fn count_confirmed_outliers(
    deviations: &mut [Deviation],
    verdict: &mut RegistrationQuality,
    outlier_sigmas: f64,
) {
    if StatusCounts::count(deviations).outliers == 0 {
        return;
    }
    let left_out: Vec<usize> =
        (0..deviations.len()).filter(|&k| deviations[k].status == PointStatus::Outlier).collect();
    let around = NeighbourIndex::new(deviations, outlier_sigmas);
    let form: Vec<usize> = left_out.into_par_iter().filter(|&k| !around.is_isolated(k)).collect();
    if form.is_empty() {
        return;
    }
    for k in form {
        let height_mm = deviations[k].deviation_mm;
        deviations[k].status = PointStatus::Inlier;
        verdict.inliers += 1;
        verdict.objective_mm2 += height_mm * height_mm;
    }
    let used = deviations.iter().filter(|d| d.status == PointStatus::Inlier).map(|d| d.deviation_mm);
    let (low_mm, high_mm) =
        used.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), d| (f64::min(low, d), f64::max(high, d)));
    verdict.pv_mm = high_mm - low_mm;
    verdict.rms_mm = (verdict.objective_mm2 / verdict.inliers as f64).sqrt();
}

/// Counts the points that their neighbours contradict, and returns their number. Such a point is on the part and not in
/// the fit, but more than half of its eight nearest neighbours are in the fit.
pub(super) fn count_contradicted(deviations: &[Deviation]) -> usize {
    let around = NeighbourIndex::new(deviations, 0.0);
    let is_left = |k: &usize| !deviations[around.indices[*k]].in_fit;
    let among_others = |&k: &usize| {
        let near =
            around.tree.nearest(&around.projections[k], SCALE_NEIGHBOURS).filter(|(n, _)| *n != k).take(NEIGHBOURS);
        let (near, left) = near.fold((0, 0), |(near, left), (n, _)| (near + 1, left + usize::from(is_left(&n))));
        2 * left < near
    };
    (0..around.indices.len()).into_par_iter().filter(is_left).filter(among_others).count()
}

/// Points on the part, indexed by their projections onto the surface. The height of a point does not change the
/// position of its projection.
struct NeighbourIndex {
    tree: PointTree,
    heights_mm: Vec<f64>,
    /// Index of each of these points among all measured points, ascending.
    indices: Vec<usize>,
    projections: Vec<Point>,
    /// Median of the heights, and half of the limit for an outlier.
    median_height_mm: f64,
    half_limit_mm: f64,
}

impl NeighbourIndex {
    /// Indexes the points on the part by their projections onto the surface. The limit for an outlier is
    /// `outlier_sigmas` times the robust standard deviation of the deviations.
    fn new(deviations: &[Deviation], outlier_sigmas: f64) -> Self {
        let on_part = |k: &usize| deviations[*k].status != PointStatus::OffPart;
        let of: Vec<usize> = (0..deviations.len()).filter(on_part).collect();
        let heights_mm: Vec<f64> = of.iter().map(|&k| deviations[k].deviation_mm).collect();
        let feet: Vec<Point> =
            of.iter().map(|&k| deviations[k].point - deviations[k].normal * deviations[k].deviation_mm).collect();
        let (surface_mm, sigma_mm) = robust_median_and_sigma(heights_mm.iter().copied());
        let min_mm = 0.5 * outlier_sigmas * sigma_mm.max(MIN_SIGMA_MM);
        Self {
            tree: PointTree::new(feet.iter().copied()),
            heights_mm,
            indices: of,
            projections: feet,
            median_height_mm: surface_mm,
            half_limit_mm: min_mm,
        }
    }

    /// Returns true if no neighbour confirms the deviation of the measured point with the index `k`. For this, two
    /// conditions must hold:
    ///
    /// - The deviation of the point differs from the median deviation of its eight neighbours by more than half the
    ///   limit for an outlier.
    /// - No close neighbour deviates clearly to the same side. A neighbour is close if it is at most 1.5 times as far
    ///   away as the third nearest neighbour.
    ///
    /// Touches at nearly the same place as the point are not neighbours. Also returns true if the point is off the part
    /// or has no neighbours.
    fn is_isolated(&self, k: usize) -> bool {
        let Ok(own) = self.indices.binary_search(&k) else { return true };
        let near: Vec<(usize, f64)> = self
            .tree
            .nearest(&self.projections[own], SCALE_NEIGHBOURS)
            .filter(|(n, _)| *n != own)
            .map(|(n, square)| (n, square.sqrt()))
            .collect();
        let Some((_, usual_mm)) = near.get(near.len() / 2) else { return true };
        let others: Vec<(usize, f64)> =
            near.iter().filter(|(_, apart)| *apart > SAME_PLACE * usual_mm).take(NEIGHBOURS).copied().collect();
        let Some((_, apart_mm)) = others.get(2).or(others.last()) else { return true };
        let mut around: Vec<f64> = others.iter().map(|(n, _)| self.heights_mm[*n]).collect();
        let Some(level_mm) = median(&mut around) else { return true };
        // Compare with the local level. If the defect itself covers most of the neighbourhood, compare with the
        // surface.
        let is_same = |n: usize, from_mm: f64, share: f64| {
            let [own_mm, other_mm] = [own, n].map(|k| self.heights_mm[k] - from_mm);
            own_mm.signum() * other_mm > self.half_limit_mm.max(share * own_mm.abs())
        };
        let agrees = |(n, apart): &(usize, f64)| {
            *apart <= MAX_NEIGHBOUR_DISTANCE * apart_mm
                && (is_same(*n, level_mm, MIN_HEIGHT_SHARE)
                    || is_same(*n, self.median_height_mm, MIN_SURFACE_HEIGHT_SHARE))
        };
        (self.heights_mm[own] - level_mm).abs() > self.half_limit_mm && !others.iter().any(agrees)
    }
}
