//! Whether what is far from the surface is one touch gone wrong, or on the part.
//!
//! The fit leaves out what is far from the surface and from its neighbours: a chip would tilt it. But what two neighbouring touches found
//! on one side of the surface is form, at any height, and counts in every figure. Only a touch that is alone counts in none.

use rayon::prelude::*;

use crate::geometry::{Nearest, Point};

use super::deviation::{Counts, Deviation, PointStatus};
use super::refit::LEAST_SIGMA_MM;
use super::robust::robust_sigma;
use super::verdict::Verdict;

/// Neighbours that are asked, and of how many the distances are looked at.
const ASKED: usize = 8;
const NEAREST: u32 = 64;
/// Neighbours are those within this many distances of the third nearest: in a square pattern those along its sides and diagonals.
const BESIDE: f64 = 1.5 + 1e-3;
/// Touches nearer than this share of the distances around were made at one place, and repeat its mistake.
const SAME_PLACE: f64 = 0.05;
/// A neighbour that found less than this share of a height did not find the same.
const LEAST_SHARE: f64 = 0.1;
/// The same where it is told from the surface: a neighbour on a hump is above it too.
const LEAST_SHARE_OF_ALL: f64 = 0.25;

/// Has the points count that were left out of the fit and are not alone: in the number of points used, the objective, RMS and PV.
pub(super) fn count_what_agrees(deviations: &mut [Deviation], verdict: &mut Verdict, outlier_sigmas: f64) {
    if Counts::of(deviations).outliers == 0 {
        return;
    }
    let left_out: Vec<usize> =
        (0..deviations.len()).filter(|&k| deviations[k].status == PointStatus::Outlier).collect();
    let around = Around::of(deviations, outlier_sigmas);
    let form: Vec<usize> = left_out.into_par_iter().filter(|&k| !around.is_alone(k)).collect();
    if form.is_empty() {
        return;
    }
    for k in form {
        let height_mm = deviations[k].deviation_mm;
        deviations[k].status = PointStatus::Used;
        verdict.used += 1;
        verdict.objective_mm2 += height_mm * height_mm;
    }
    let used = deviations.iter().filter(|d| d.status == PointStatus::Used).map(|d| d.deviation_mm);
    let (low_mm, high_mm) =
        used.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), d| (f64::min(low, d), f64::max(high, d)));
    verdict.pv_mm = high_mm - low_mm;
    verdict.rms_mm = (verdict.objective_mm2 / verdict.used as f64).sqrt();
}

/// Counts the points on the part that the pose was not fitted to although it was fitted to most of their neighbours.
pub(super) fn contradicted(deviations: &[Deviation]) -> usize {
    let around = Around::of(deviations, 0.0);
    let is_left = |k: &usize| !deviations[around.of[*k]].in_fit;
    let among_others = |&k: &usize| {
        let near = around.tree.to(&around.feet[k], NEAREST).filter(|(n, _)| *n != k).take(ASKED);
        let (near, left) = near.fold((0, 0), |(near, left), (n, _)| (near + 1, left + usize::from(is_left(&n))));
        2 * left < near
    };
    (0..around.of.len()).into_par_iter().filter(is_left).filter(among_others).count()
}

/// The points on the part by the places of their feet: how high one is moves it to no other place.
struct Around {
    tree: Nearest,
    heights_mm: Vec<f64>,
    /// The numbers of these points among all, ascending.
    of: Vec<usize>,
    feet: Vec<Point>,
    /// The median of the heights, and half of what makes an outlier.
    surface_mm: f64,
    least_mm: f64,
}

impl Around {
    fn of(deviations: &[Deviation], outlier_sigmas: f64) -> Self {
        let on_part = |k: &usize| deviations[*k].status != PointStatus::OffPart;
        let of: Vec<usize> = (0..deviations.len()).filter(on_part).collect();
        let heights_mm: Vec<f64> = of.iter().map(|&k| deviations[k].deviation_mm).collect();
        let feet: Vec<Point> =
            of.iter().map(|&k| deviations[k].point - deviations[k].normal * deviations[k].deviation_mm).collect();
        let (surface_mm, sigma_mm) = robust_sigma(heights_mm.iter().copied());
        let least_mm = 0.5 * outlier_sigmas * sigma_mm.max(LEAST_SIGMA_MM);
        Self { tree: Nearest::of(feet.iter().copied()), heights_mm, of, feet, surface_mm, least_mm }
    }

    /// Whether no neighbour found what this point did, beside what is usual around it.
    fn is_alone(&self, k: usize) -> bool {
        let Ok(own) = self.of.binary_search(&k) else { return true };
        let near: Vec<(usize, f64)> = self
            .tree
            .to(&self.feet[own], NEAREST)
            .filter(|(n, _)| *n != own)
            .map(|(n, square)| (n, square.sqrt()))
            .collect();
        let Some((_, usual_mm)) = near.get(near.len() / 2) else { return true };
        let others: Vec<(usize, f64)> =
            near.iter().filter(|(_, apart)| *apart > SAME_PLACE * usual_mm).take(ASKED).copied().collect();
        let Some((_, apart_mm)) = others.get(2).or(others.last()) else { return true };
        let mut around: Vec<f64> = others.iter().map(|(n, _)| self.heights_mm[*n]).collect();
        around.sort_unstable_by(f64::total_cmp);
        let level_mm = around[around.len() / 2];
        // Beside what is usual around, and, where most of that is the defect itself, beside the surface.
        let is_same = |n: usize, from_mm: f64, share: f64| {
            let [own_mm, other_mm] = [own, n].map(|k| self.heights_mm[k] - from_mm);
            own_mm.signum() * other_mm > self.least_mm.max(share * own_mm.abs())
        };
        let agrees = |(n, apart): &(usize, f64)| {
            *apart <= BESIDE * apart_mm
                && (is_same(*n, level_mm, LEAST_SHARE) || is_same(*n, self.surface_mm, LEAST_SHARE_OF_ALL))
        };
        (self.heights_mm[own] - level_mm).abs() > self.least_mm && !others.iter().any(agrees)
    }
}
