//! Fit of the pose, and the registration that follows from it.

use rayon::prelude::*;

use super::correspond::{Correspondence, report_projections};
use super::error::RegistrationError;
use super::iterate::Iteration;
use super::iterate::{Descent, Problem};
use super::options::{ProbeSide, RegistrationOptions};
use super::part::Part;
use super::quality::RegistrationQuality;
use super::refit::trim_and_refit;
use super::result::Registration;
use super::start::{InitialPose, initial_pose};
use super::{isolated_touches, quality, sampling_directions};
use crate::geometry::Point;

/// Estimates the pose of `part` and the deviation of each point of `measured`. Does not check whether the points fit
/// well enough; [`super::check_fit`] does that.
///
/// # Errors
/// Returns an error if the probe ball does not fit into a concave area of the surface, or if the points fit the other
/// side of the surface much better than the side in `options`. Returns an error if fewer than half of the points take
/// part in the fit, if no direction of the pose is determined, or if the iteration does not converge.
pub(super) fn fit(
    part: &Part,
    measured: &[Point],
    options: &RegistrationOptions,
) -> Result<Registration, RegistrationError> {
    if let Some(side) = options.side.side() {
        part.check_fold(options, side)?;
    }
    let initial = initial_pose(part, measured, options)?;
    if options.side == ProbeSide::Auto {
        part.check_fold(options, initial.side)?;
    }
    let problem = part.problem(measured, options, initial.side);
    let mut trace = Vec::new();
    let mut correspondences: Vec<Correspondence> = measured.par_iter().map(|_| Correspondence::INITIAL).collect();
    let descent = trim_and_refit(&problem, &initial, options, &mut correspondences, &mut trace)?;
    if let Some(min_share) = sampling_directions::sampling_share(&problem, &descent, &correspondences) {
        return fit(&Part { min_singular_share: min_share, ..*part }, measured, options);
    }
    build_registration(part, &problem, descent, correspondences, trace, &initial, options)
}

/// Builds the registration that is reported: pose, deviations, trace and quality with coverage. `descent` is the result
/// of the last minimisation. `correspondences` contains the projection of each measured point. `trace` contains the
/// steps of all minimisations. `initial` gives the side of the probe and the other poses that fit.
///
/// # Errors
/// Returns [`crate::surface::SurfaceError::OffsetFolds`] if a point projects to a facet at which the offset surface
/// folds: there the probe ball is larger than the concave radius of curvature.
pub(super) fn build_registration(
    part: &Part,
    problem: &Problem,
    descent: Descent,
    correspondences: Vec<Correspondence>,
    trace: Vec<Iteration>,
    initial: &InitialPose,
    options: &RegistrationOptions,
) -> Result<Registration, RegistrationError> {
    if let Some(fold) = problem.surface.find_fold_among(correspondences.iter().map(|t| t.facet)) {
        return Err(fold.into());
    }
    let mut verdict = quality::assess_quality(problem, &descent, &correspondences, initial, trace.len());
    let reporter = quality::DeviationReporter::new(part, &descent.scaling, &verdict, options);
    let pose = &descent.cmm_from_model;
    let mut deviations =
        report_projections(&problem.surface, problem.measured, &correspondences, pose, &descent.scaling, &reporter);
    isolated_touches::count_confirmed_outliers(&mut deviations, &mut verdict, options.outlier_sigmas);
    verdict.coverage = quality::coverage(part.nominal, &deviations);
    let trace = with_final_state(trace, &verdict, options);
    Ok(Registration { cmm_from_model: descent.cmm_from_model, deviations, trace, side: initial.side, quality: verdict })
}

/// Difference of two distances that is only rounding, in mm.
pub(super) const ROUNDING_MM: f64 = 1e-12;

/// Returns `trace`, the steps of the iteration, with the reported state as its last entry. `verdict` is the reported
/// quality.
///
/// Appends an entry with step 0 in two cases: the last step was undone, or the last accepted step differs from
/// `verdict` in the number of points or in the objective. The entry takes the radius of the ball from the last step, or
/// from `options` if `trace` is empty.
pub(super) fn with_final_state(
    mut trace: Vec<Iteration>,
    verdict: &RegistrationQuality,
    options: &RegistrationOptions,
) -> Vec<Iteration> {
    let RegistrationQuality { objective_mm2, inliers: used, .. } = *verdict;
    let is_told = |taken: &&Iteration| {
        let off_mm2 = (taken.objective_mm2 - objective_mm2).abs();
        // Sums in another order differ by rounding. If the points lie on the surface, the sums contain nothing else.
        taken.points == used && off_mm2 <= 1e-9 * objective_mm2 + used as f64 * ROUNDING_MM * ROUNDING_MM
    };
    let told = trace.iter().rfind(|turn| turn.accepted).filter(is_told).map(|turn| turn.objective_mm2);
    if told.is_none() || !trace.last().is_some_and(|last| last.accepted) {
        let (ball_radius, objective_mm2) =
            (trace.last().map_or(options.ball_radius, |last| last.ball_radius), told.unwrap_or(objective_mm2));
        trace.push(Iteration { objective_mm2, step: 0.0, ball_radius, accepted: true, points: used });
    }
    trace
}
