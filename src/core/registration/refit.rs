//! Descent from the initial pose to the reported one: descend, reject outliers, and fit again.

use rayon::prelude::*;
use regrind_figures::statistics::median;

use crate::geometry::{Point, PointTree, Pose};

use super::correspond::{Correspondence, EDGE_TOLERANCE_STEPS, beyond_steps, centroid_and_size};
use super::error::RegistrationError;
use super::iterate::{Descent, Iteration, Problem};
use super::options::RegistrationOptions;
use super::robust_loss::{Loss, ScaledLoss, robust_median_and_sigma};
use super::start::{InitialPose, sample_evenly};

/// Fits the pose to the measured points of `problem`, starting at `initial`. Repeats two steps until the set of fitted
/// points no longer changes, at most 16 times. First it minimises the objective (the sum of the squared distances or of
/// their robust loss). Then it rejects points beyond the edge of the surface and outliers.
///
/// Returns the result of the last minimisation. Updates `correspondences`, one per point, and appends the steps to
/// `trace`.
///
/// # Errors
/// Returns an error if the iteration does not converge, if fewer than half of the points are in the fit, or if the
/// surface determines no free direction of the pose.
pub(super) fn trim_and_refit(
    problem: &Problem,
    initial: &InitialPose,
    options: &RegistrationOptions,
    correspondences: &mut [Correspondence],
    trace: &mut Vec<Iteration>,
) -> Result<Descent, RegistrationError> {
    /// Number of rounds in which a rejected point can be accepted again. Later rounds only reject points, so that the
    /// sets cannot alternate for ever.
    const REVERSIBLE_ROUNDS: usize = 8;
    const MAX_ROUNDS: usize = 16;
    let mut problem = *problem;
    let mut pose = initial.cmm_from_model;
    if initial.is_refined {
        problem.ball_radius = problem.ball_radius.min(0.05);
    }
    let counts: &[usize] =
        if problem.surface.has_lazy_normals() { &COARSE_COUNTS_WITH_FITTED_NORMALS } else { &COARSE_COUNTS };
    for few in counts.iter().filter(|few| problem.measured.len() >= 2 * **few) {
        pose = descend_coarsely(&problem, pose, *few, if initial.is_refined { Some(options) } else { None }, trace)?;
    }
    prefetch(&problem, correspondences, &pose);
    let sums = problem.project_all(correspondences, &pose, &problem.scaling_at(&pose));
    let mut changed = reproject_far_points(&problem, correspondences, &pose);
    if initial.is_refined {
        changed += select_fit_points(&problem, options, correspondences, true);
    }
    let mut known = (changed == 0 && options.loss == Loss::None).then_some(sums);
    let mut round = 0;
    loop {
        rescale_loss(&mut problem, options, correspondences, round > 0 || initial.is_refined);
        let descent = problem.descend(pose, known.take(), correspondences, trace)?;
        if !descent.converged {
            let (iterations, objective_mm2) = (options.max_iterations, descent.objective_mm2);
            return Err(RegistrationError::NotConverged { iterations, objective_mm2 });
        }
        pose = descent.cmm_from_model;
        round += 1;
        let changed = reproject_far_points(&problem, correspondences, &pose)
            + select_fit_points(&problem, options, correspondences, round < REVERSIBLE_ROUNDS);
        let robust_settling = options.loss != Loss::None && round < 4;
        if (changed == 0 && !robust_settling) || round == MAX_ROUNDS {
            return check_descent(descent, correspondences.len(), options.locked == [true; 6]);
        }
    }
}

/// Numbers of points with which a dense cloud descends before all points do: first a few points far from the minimum,
/// then more points nearer to it.
const COARSE_COUNTS: [usize; 2] = [1024, 16_384];

/// The same numbers for a surface whose normals are fitted when they are first needed. Few points need few normals, and
/// all points then need only those near the final pose.
const COARSE_COUNTS_WITH_FITTED_NORMALS: [usize; 1] = [2048];

/// Prepares the projections of the measured points under `pose`. Fits the surface normals near all points at once, and
/// stores a start facet for the projection of each point in `correspondences`. Does nothing if the normals of the
/// surface are already known.
fn prefetch(problem: &Problem, correspondences: &mut [Correspondence], pose: &Pose) {
    if !problem.surface.has_lazy_normals() {
        return;
    }
    let model_from_cmm = pose.inverse();
    let points: Vec<Point> = problem.measured.par_iter().map(|p| model_from_cmm.transform_point(p)).collect();
    for (correspondence, place) in correspondences.iter_mut().zip(problem.surface.prefetch(&points)) {
        correspondence.facet = place;
    }
}

/// Fits the pose to a sample of `count` measured points, starting at `pose`. Returns a pose so good that all points
/// together need only one or two more steps. Appends the steps to `trace`.
///
/// If `screened` contains options, outliers of the sample are rejected before the fit, with the limit in these options.
/// Use this only if `pose` is near the minimum. Far from the minimum, outliers cannot be distinguished from other
/// points.
///
/// # Errors
/// Returns an error if fewer points of the sample are in the fit than coordinates of the pose are free.
fn descend_coarsely(
    problem: &Problem,
    pose: Pose,
    count: usize,
    screened: Option<&RegistrationOptions>,
    trace: &mut Vec<Iteration>,
) -> Result<Pose, RegistrationError> {
    let few: Vec<Point> = sample_evenly(problem.measured, count).copied().collect();
    let mut correspondences = vec![Correspondence::INITIAL; few.len()];
    let (middle, size_mm) = centroid_and_size(&few);
    let coarse = Problem { measured: &few, centroid: middle, size_mm, ..*problem };
    prefetch(&coarse, &mut correspondences, &pose);
    if let Some(options) = screened {
        coarse.project_all(&mut correspondences, &pose, &coarse.scaling_at(&pose));
        select_fit_points(&coarse, options, &mut correspondences, true);
    }
    Ok(coarse.descend(pose, None, &mut correspondences, trace)?.cmm_from_model)
}

/// Returns `descent` unchanged if its fit is usable. `points` is the number of all points; `is_held` is true if all
/// directions of the pose are locked.
///
/// # Errors
/// Returns [`RegistrationError::TooFewUsed`] if fewer than half of the points are in the fit, and
/// [`RegistrationError::Undetermined`] if the surface determines no direction although not all are locked.
fn check_descent(descent: Descent, points: usize, is_held: bool) -> Result<Descent, RegistrationError> {
    if descent.sums.points * 2 < points {
        return Err(RegistrationError::TooFewUsed { used: descent.sums.points, points });
    }
    if descent.rank == 0 && !is_held {
        return Err(RegistrationError::Undetermined);
    }
    Ok(descent)
}

/// Sets the scale of a robust loss to the robust standard deviation of the current distances. Does nothing if the
/// distances are not yet `known`, or if `options` select no robust loss.
fn rescale_loss(problem: &mut Problem, options: &RegistrationOptions, correspondences: &[Correspondence], known: bool) {
    // Before the first distances are known there is no scale, and every point counts by its square.
    if known && options.loss != Loss::None {
        problem.residual.loss = ScaledLoss::new(options.loss, robust_distance_sigma(correspondences).1);
    }
}

/// Minimum standard deviation of the noise, in mm. No CMM repeats better, and the noise of a file can be rounding only.
pub(crate) const MIN_SIGMA_MM: f64 = 1e-5;

/// Returns the median of the distances of the points on the part, and their robust standard deviation (from the median
/// absolute deviation), both in mm. Uses a sample of a large cloud. The second value is at least [`MIN_SIGMA_MM`].
fn robust_distance_sigma(correspondences: &[Correspondence]) -> (f64, f64) {
    // A sample gives the sigma of many points to a percent.
    let stride = correspondences.len().div_ceil(1 << 16);
    let on_part = correspondences.iter().step_by(stride).filter(|t| !t.is_off_part()).map(|t| t.distance_mm);
    let (median, sigma) = robust_median_and_sigma(on_part);
    (median, sigma.max(MIN_SIGMA_MM))
}

/// Searches the whole surface for better projections of far points. A point is far if its projection is beyond the edge
/// of the surface, or if its distance differs from the median distance by more than 0.2 mm and by more than six robust
/// standard deviations. Returns the number of points with a better projection.
///
/// A new projection is better if it lies on the part, and either the old one was beyond the edge or the distance is
/// less than half of the old distance. The usual search moves from facet to facet, and ends at the edge of a gap. The
/// correct facet can lie beyond this gap.
fn reproject_far_points(problem: &Problem, correspondences: &mut [Correspondence], pose: &Pose) -> usize {
    /// Distance in mm that no touch on the part exceeds when the pose is nearly right.
    const FAR_MM: f64 = 0.2;
    let may_be = |t: &Correspondence| t.is_off_part() || t.distance_mm.abs() > FAR_MM;
    if !correspondences.par_chunks(1 << 13).any(|some| some.iter().any(may_be)) {
        return 0;
    }
    let (median, sigma) = robust_distance_sigma(correspondences);
    let far = |t: &Correspondence| (t.distance_mm - median).abs() > FAR_MM.max(6.0 * sigma);
    let model_from_cmm = pose.inverse();
    let again = |(t, p): (&mut Correspondence, &Point)| {
        if !t.is_off_part() && !far(t) {
            return false;
        }
        let p = model_from_cmm.transform_point(p);
        let foot = problem.surface.project_without_start(&p);
        let distance_mm = foot.distance_mm - problem.residual.subtract_mm;
        let beyond_steps = beyond_steps(&problem.surface, &p, &foot);
        let is_on_part = beyond_steps <= EDGE_TOLERANCE_STEPS;
        let is_nearer = is_on_part && (t.is_off_part() || distance_mm.abs() < 0.5 * t.distance_mm.abs());
        if is_nearer {
            (t.facet, t.distance_mm, t.beyond_steps) = (foot.facet, distance_mm, beyond_steps);
        }
        is_nearer
    };
    correspondences.par_iter_mut().zip(problem.measured).filter_map(|both| again(both).then_some(())).count()
}

/// Decides for each point whether it takes part in the fit, and stores the decision in `correspondences`. Returns the
/// number of points whose decision changed. If `both_ways` is false, points can only be rejected; a rejected point
/// stays rejected.
///
/// Rejects two kinds of points: points whose projection is beyond the edge of the surface, and outliers. The limit for
/// outliers is `options.outlier_sigmas` times the robust standard deviation of the distances. A point is an outlier in
/// two cases:
///
/// - Its distance differs from the median distance by more than the limit, and from the median distance of its
///   neighbours by more than half the limit.
/// - Its distance differs from the median distance by more than four times the limit.
///
/// So a large but smooth form error gives no outlier below four times the limit. After the fit,
/// [`super::isolated_touches`] changes an outlier back to an inlier if its neighbours confirm a form error.
fn select_fit_points(
    problem: &Problem,
    options: &RegistrationOptions,
    correspondences: &mut [Correspondence],
    both_ways: bool,
) -> usize {
    let (median, sigma) = robust_distance_sigma(correspondences);
    let limit = options.outlier_sigmas * sigma;
    let far = |t: &Correspondence| (t.distance_mm - median).abs() > limit;
    let suspects: Vec<usize> = (0..correspondences.len()).filter(|&k| far(&correspondences[k])).collect();
    let isolated = if suspects.is_empty() {
        Vec::new()
    } else {
        isolated_flags(problem.measured, correspondences, &suspects, 0.5 * limit)
    };
    let mut outlier = vec![false; if suspects.is_empty() { 0 } else { correspondences.len() }];
    for (&k, isolated) in suspects.iter().zip(isolated) {
        outlier[k] = isolated || (correspondences[k].distance_mm - median).abs() > 4.0 * limit;
    }
    let mut changed = 0;
    for (k, correspondence) in correspondences.iter_mut().enumerate() {
        let fits = !correspondence.is_off_part() && !outlier.get(k).copied().unwrap_or(false);
        if fits != correspondence.in_fit && (both_ways || !fits) {
            correspondence.in_fit = fits;
            changed += 1;
        }
    }
    changed
}

/// Returns one flag for each index in `suspects`, the points that may be outliers. A flag is true if the distance of
/// the point from the surface differs by more than `limit_mm` from the median distance of its eight nearest neighbours.
///
/// Points nearer than half of the mean point spacing do not count as neighbours. They are repeated touches at the same
/// place, and can have the same fault. The flag is true if none of the 64 nearest points counts as a neighbour.
fn isolated_flags(
    measured: &[Point],
    correspondences: &[Correspondence],
    suspects: &[usize],
    limit_mm: f64,
) -> Vec<bool> {
    const NEIGHBOURS: usize = 8;
    const SEARCHED: u32 = 64;
    let tree = PointTree::new(measured.iter().copied());
    // Points spread over a square of rms size s are s sqrt(6 / n) apart.
    let twin_mm = 0.5 * centroid_and_size(measured).1 * (6.0 / measured.len() as f64).sqrt();
    let is_isolated = |&k: &usize| {
        let others = tree.nearest(&measured[k], SEARCHED).filter(|(_, square)| *square > twin_mm * twin_mm);
        let mut around: Vec<f64> = others.take(NEIGHBOURS).map(|(n, _)| correspondences[n].distance_mm).collect();
        median(&mut around).is_none_or(|usual_mm| (correspondences[k].distance_mm - usual_mm).abs() > limit_mm)
    };
    suspects.par_iter().map(is_isolated).collect()
}
