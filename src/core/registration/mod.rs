//! Registration: estimates the pose of the part from measured probe centres and the offset of the nominal surface.
//!
//! ```text
//!  start  ------->  correspond -> linearize -> solve  ------->  verdict
//!  (search,         (projections) (A, b)       (ball)           (covariance, weak directions, outliers)
//!   or given)          ^                          |
//!                      +------ iterate -----------+          (refit: once more without the rejected points)
//! ```
//!
//! The method is section 2 of the paper. It alternates between the projection of the points onto the offset surface and
//! a ball-constrained least-squares step of the pose, until the objective no longer falls.
//!
//! Pure: no file, no clock, no randomness. The same input gives the same bits on any number of threads. Frames:
//! measured points are in the CMM frame {W}, the nominal surface in the model frame {M}. Units: millimetres and
//! radians.

mod correspond;
mod degenerate;
mod deviation;
mod error;
mod isolated_touches;
mod iterate;
mod lateral;
mod linearize;
mod options;
mod part;
mod plausibility;
mod quality;
mod radius;
mod refit;
mod result;
mod robust_loss;
mod sampling_directions;
mod solve;
mod start;

use rayon::prelude::*;

use crate::geometry::Point;
use crate::surface::Nominal;

use correspond::{Correspondence, report_projections};
pub use deviation::{Deviation, PointStatus};
pub use error::RegistrationError;
pub use iterate::Iteration;
use iterate::{Descent, Problem};
pub use lateral::{LateralError, MapLimits, lateral_error, map_obstacle};
pub use options::{Coordinate, Method, ProbeSide, RegistrationOptions, Start};
use part::Part;
pub use quality::{RegistrationQuality, WeakDirection};
pub(crate) use refit::MIN_SIGMA_MM;
use refit::trim_and_refit;
pub use result::{FiguresWithOutliers, Registration};
pub use robust_loss::Loss;
pub(crate) use robust_loss::robust_median_and_sigma;
use start::{InitialPose, detect_mirror_image, free_rms, initial_pose, mirrored_rms};

/// Registers measured points to a nominal surface. Returns the pose, the deviation of each point, and the quality of
/// the fit.
///
/// Shapes: measured points in any order, at least one more than there are free coordinates of the pose; one deviation
/// per point, in the same order. Frames: the points are in the CMM frame, the surface in the model frame. The pose maps
/// the model frame to the CMM frame. Units: millimetres. Equations: (3), (7) to (15) of the paper.
///
/// # Errors
/// Returns an error in these cases:
///
/// - The points are too few, repeated, on one line or not finite.
/// - The size of the point cloud does not agree with the size of the surface.
/// - The probe radius is not positive, or is too large for the surface.
/// - The points do not determine the pose.
/// - Only the mirror image of the points fits the surface.
/// - The rms deviation exceeds the rms limit.
/// - The iteration does not converge.
pub fn register(
    nominal: &Nominal,
    measured: &[Point],
    options: &RegistrationOptions,
) -> Result<Registration, RegistrationError> {
    let part = Part::new(nominal, measured, options)?;
    degenerate::check_scan_line(measured, options)?;
    let mut registration =
        fit(&part, measured, options).map_err(|error| explain_by_mirror_image(&part, measured, options, error))?;
    check_fit(&part, &registration, measured, options)?;
    let doubts = plausibility::plausibility_warnings(&part, &registration, measured, options);
    registration.quality.warnings.extend(doubts);
    Ok(registration)
}

/// Estimates the pose of `part` and the deviation of each point of `measured`. Does not check whether the points fit
/// well enough; [`check_fit`] does that.
///
/// # Errors
/// Returns an error if the probe ball does not fit into a concave area of the surface, or if the points fit the other
/// side of the surface much better than the side in `options`. Returns an error if fewer than half of the points take
/// part in the fit, if no direction of the pose is determined, or if the iteration does not converge.
fn fit(part: &Part, measured: &[Point], options: &RegistrationOptions) -> Result<Registration, RegistrationError> {
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

/// Explains `error`, the error of a failed registration. Returns [`RegistrationError::Mirrored`] if only the mirror
/// image of the measured points fits the part. Otherwise returns `error` unchanged.
///
/// The mirror image is tested only for the errors `TooFewUsed`, `NotConverged`, `WrongSide` and `Undetermined`.
fn explain_by_mirror_image(
    part: &Part,
    measured: &[Point],
    options: &RegistrationOptions,
    error: RegistrationError,
) -> RegistrationError {
    use RegistrationError::{NotConverged, TooFewUsed, Undetermined, WrongSide};
    if !matches!(error, TooFewUsed { .. } | NotConverged { .. } | WrongSide { .. } | Undetermined) {
        return error;
    }
    match detect_mirror_image(part, measured, options) {
        Some((rms_mm, mirrored_rms_mm)) => RegistrationError::Mirrored { rms_mm, mirrored_rms_mm },
        None => error,
    }
}

/// Builds the registration that is reported: pose, deviations, trace and quality with coverage. `descent` is the result
/// of the last minimisation. `correspondences` contains the projection of each measured point. `trace` contains the
/// steps of all minimisations. `initial` gives the side of the probe and the other poses that fit.
///
/// # Errors
/// Returns [`crate::surface::SurfaceError::OffsetFolds`] if a point projects to a facet at which the offset surface
/// folds: there the probe ball is larger than the concave radius of curvature.
fn build_registration(
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
const ROUNDING_MM: f64 = 1e-12;

/// Returns `trace`, the steps of the iteration, with the reported state as its last entry. `verdict` is the reported
/// quality.
///
/// Appends an entry with step 0 in two cases: the last step was undone, or the last accepted step differs from
/// `verdict` in the number of points or in the objective. The entry takes the radius of the ball from the last step, or
/// from `options` if `trace` is empty.
fn with_final_state(
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

/// Rejects the registration `found` if its fit is too poor, or if its inliers form a strip too narrow to determine the
/// pose.
///
/// # Errors
/// Returns [`RegistrationError::Narrow`] for a strip of points that is too narrow. Returns
/// [`RegistrationError::Mirrored`] if the mirror image of the points fits within the rms limit, with less than 0.3
/// times the rms of the points. Returns [`RegistrationError::DoesNotFit`] if the rms deviation exceeds the limit.
fn check_fit(
    part: &Part,
    found: &Registration,
    measured: &[Point],
    options: &RegistrationOptions,
) -> Result<(), RegistrationError> {
    degenerate::check_strip(&found.deviations, options)?;
    let rms_mm = found.quality.rms_mm;
    let limit_mm = part.rms_limit_mm(options);
    let doubtful = rms_mm > limit_mm || rms_mm > (0.02 * part.nominal.relief_mm()).max(10.0 * MIN_SIGMA_MM);
    if !doubtful {
        return Ok(());
    }
    // A locked pose cannot distinguish a mirror image from a part that lies elsewhere. A defect on a tenth of the
    // points cannot be distinguished from another surface. So both clouds are fitted with nothing locked, and compared
    // by the same trimmed rms.
    let is_held = options.locked.contains(&true);
    let free_rms_mm = free_rms(part, measured, options, found.side).unwrap_or(rms_mm);
    if let Some(mirrored_rms_mm) = mirrored_rms(part, measured, options, found.side)
        && mirrored_rms_mm < 0.3 * free_rms_mm
        && mirrored_rms_mm <= limit_mm
    {
        return Err(RegistrationError::Mirrored { rms_mm: free_rms_mm, mirrored_rms_mm });
    }
    if rms_mm > limit_mm {
        let elsewhere = || {
            (is_held && free_rms_mm <= limit_mm).then(|| {
                format!(
                    "without locks they fit to {free_rms_mm:.4} mm: the part is not at the locked pose; correct that \
                     pose, or unlock more directions"
                )
            })
        };
        let remedy = plausibility::radius_warning(part, found, measured, options)
            .or_else(elsewhere)
            .unwrap_or_else(|| "check part, units and probe radius, or raise the limit".to_owned());
        return Err(RegistrationError::DoesNotFit { rms_mm, limit_mm, remedy });
    }
    Ok(())
}
