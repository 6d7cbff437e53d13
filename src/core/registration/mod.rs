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
mod fit;
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

pub use deviation::{Deviation, PointStatus};
pub use error::RegistrationError;
use fit::fit;
pub use iterate::Iteration;
pub use lateral::{LateralError, MapLimits, lateral_error, map_obstacle};
pub use options::{Coordinate, Method, ProbeSide, RegistrationOptions, Start};
use part::Part;
pub use quality::{RegistrationQuality, WeakDirection};
pub(crate) use refit::MIN_SIGMA_MM;
pub use result::{FiguresWithOutliers, Registration};
pub use robust_loss::Loss;
pub(crate) use robust_loss::robust_median_and_sigma;
use start::{detect_mirror_image, free_rms, mirrored_rms};

use crate::geometry::Point;
use crate::surface::Nominal;

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
