//! Parameters of the machine estimated from the deviations: wheel radius, setting of the wheel, tilt of the part,
//! wear along the path.
//!
//! ```text
//!  contacts --columns--> motions | slides | parameters --GLS--> value +- U --tolerance--> compensated --> next pass
//!                           (nuisance)     (with a field)                     \-- beyond it: a person decides
//! ```
//!
//! A parameter changes the surface in a known way (p and q are the slopes of the nominal surface, n its unit normal):
//!
//! ```text
//!  wheel radius   -dR (1/nz - 1)     dR the true radius minus the stated one: a larger wheel cuts deeper on slopes
//!  setting        ex p nz, ey q nz   offset of the wheel along x or y;  ez nz  the wheel is set too high
//!  tilt           -(r x n) a         the part tilted in the grinder by a, about x or y
//!  wear           w t                t the progress along the path, 0 to 1: the surface rises as the wheel wears
//! ```
//!
//! Registration has removed from the deviations every part that a motion of the part explains, so the free motions
//! are fitted too, as nuisance. This loses effects that look like a motion. A spherical wheel that is offset along x
//! leaves exactly the surface of a part that is offset along x. It is only visible where a datum locks the part, and
//! only as well as the position of the datum is known. Slides that are not straight are fitted too, with their second
//! and third order along either axis: on a shallow part a bent slide looks very similar to a wheel of another radius.
//!
//! **Uncertainty.** The residuals are form, not noise: neighbouring points deviate together, and the usual formula
//! would give far too small uncertainties. Generalised least squares estimates the values together with the field of
//! the model of the error ([`EffectEstimates`]). The points determine the strength and range of this field, whatever
//! the parameters are.
//!
//! **Compensation.** A value beyond its expanded uncertainty is compensated by its expectation, given its stated
//! tolerance: value (1 + s^2 / t^2)^-1 for one parameter with the standard uncertainty s and the tolerance 2 t. Any
//! other value is left to the map. More than the tolerance is not compensated without a person.

mod columns;
mod corrections;
mod error;
mod fit;
mod kinds;
mod texts;

pub use columns::Extent;
use columns::{OrthonormalBasis, candidates, motions, slides};
pub use corrections::{ExplainedDeviation, ParameterCorrections};
pub use error::ParameterError;
use fit::Columns;
pub use kinds::{EstimatedParameter, ParameterKind, ParameterOptions, SurfacePoint, WheelTerm};
use kinds::{MIN_NZ, MIN_POINTS};

use regrind_figures::statistics::rms;

use crate::geometry::Grid;

/// Estimated parameters, and the residuals without those that are offered.
#[derive(Clone, Debug, PartialEq)]
pub struct ParameterEstimation {
    /// Parameters in the order of [`ParameterKind::ALL`].
    pub estimates: Vec<EstimatedParameter>,
    /// Root mean square of the deviations without the part that the free motions explain, in millimetres.
    pub rms_mm: f64,
    /// Root mean square of `residuals_mm`, in millimetres: as `rms_mm`, but also without the offered parameters.
    pub residual_rms_mm: f64,
    /// Residual at every point after correction of the offered parameters and a new registration, in millimetres:
    /// form and noise.
    pub residuals_mm: Vec<f64>,
    /// Part of the deviations that parameters and slides explain together, however it divides between them.
    pub explained: ExplainedDeviation,
}

/// Estimates the machine parameters (wheel radius, wheel setting, tilt of the part, wear) from the deviations of the
/// part. The method is generalised least squares, with a Gaussian random field as the model of the form error.
///
/// Returns the value and the uncertainty of each parameter, and the residuals after correction of the significant
/// parameters.
///
/// `contacts` are the measured points with normal and deviation, in any order. `progress` is the progress along the
/// grinding path at each contact, from 0 (start) to 1 (end). With `None` the path is a raster whose tracks follow each
/// other along y.
///
/// Frame: the model frame. Units: millimetres, radians. Equation: deviation = motion of the part + bent guideways + sum
/// of (parameter times its effect) + random field + noise.
///
/// # Errors
/// Returns an error in each of these cases:
///
/// - There are fewer than 30 points.
/// - A coordinate, normal, deviation or progress is not finite.
/// - `progress` and `contacts` have different lengths.
/// - The z component of a normal is below 0.05.
/// - The wheel radius or a tolerance is not a finite number above 0.
/// - An uncertainty of the datum is negative or not finite.
/// - The points do not determine the random field.
pub fn estimate_parameters(
    contacts: &[SurfacePoint],
    progress: Option<&[f64]>,
    options: &ParameterOptions,
) -> Result<ParameterEstimation, ParameterError> {
    check(contacts, progress, options)?;
    let extent = Extent::from_places(contacts.iter().map(|c| [c.point.x, c.point.y]));
    let columns = Columns {
        motions: motions(contacts, options.free_motions),
        slides: slides(contacts, &extent),
        candidates: candidates(contacts, progress, options.wheel_term, &extent),
    };
    let deviations: Vec<f64> = contacts.iter().map(|c| c.deviation_mm).collect();
    let unseen = OrthonormalBasis::new(columns.motions.iter().map(|m| &m.values));
    let rms_mm = rms(unseen.orthogonal_part(&deviations));
    let (told, own_shares) = columns.separability();
    let fitted = columns.fitted(contacts, &told, rms_mm, options)?;
    let alike = |k: usize| {
        if told[k] && !options.lacks_locked_sigma(k) { Vec::new() } else { columns.inseparable_from(k, options) }
    };
    let alike = (0..ParameterKind::COUNT).map(alike).collect();
    let mut found = fitted.parameters(alike, &own_shares, options);
    let left = |but: Option<usize>| {
        let mut rest = deviations.clone();
        for (k, parameter) in found.iter().enumerate().filter(|(k, p)| p.is_offered && Some(*k) != but) {
            rest.iter_mut().zip(&columns.candidates[k].values).for_each(|(r, c)| *r -= parameter.value * c);
        }
        unseen.orthogonal_part(&rest)
    };
    let rest_mm = left(None);
    let rest_rms_mm = rms(&rest_mm);
    let removes: Vec<f64> =
        (0..found.len()).map(|k| if found[k].is_offered { rms(left(Some(k))) - rest_rms_mm } else { 0.0 }).collect();
    for (parameter, removes_rms_mm) in found.iter_mut().zip(removes) {
        parameter.rms_reduction_mm = removes_rms_mm;
        parameter.message = texts::message(parameter, rest_rms_mm, options);
    }
    let smooth = ExplainedDeviation::new(contacts, &extent, options, &fitted);
    Ok(ParameterEstimation {
        estimates: found,
        rms_mm,
        residual_rms_mm: rest_rms_mm,
        residuals_mm: rest_mm,
        explained: smooth,
    })
}

fn check(
    contacts: &[SurfacePoint],
    progress: Option<&[f64]>,
    options: &ParameterOptions,
) -> Result<(), ParameterError> {
    let points = contacts.len();
    let radius_mm = options.wheel_radius_mm;
    if !(radius_mm > 0.0 && radius_mm.is_finite()) {
        return Err(ParameterError::WheelRadius { radius_mm });
    }
    if let Some(value) = options.tolerances.into_iter().flatten().find(|t| !(*t > 0.0 && t.is_finite())) {
        return Err(ParameterError::Stated { what: "a tolerance of a parameter", value, limit: "above 0" });
    }
    if let Some(value) = options.locked_sigmas.into_iter().flatten().find(|u| !(*u >= 0.0 && u.is_finite())) {
        return Err(ParameterError::Stated { what: "an uncertainty of the datum", value, limit: "at least 0" });
    }
    if let Some(progress) = progress.filter(|p| p.len() != points) {
        return Err(ParameterError::Progress { found: progress.len(), points });
    }
    let finite = |k: usize| {
        let SurfacePoint { point, normal, deviation_mm } = contacts[k];
        let along = progress.map_or(0.0, |p| p[k]);
        (point.coords.sum() + normal.sum() + deviation_mm + along).is_finite()
    };
    if let Some(index) = (0..points).find(|&k| !finite(k)) {
        return Err(ParameterError::NotFinite { index });
    }
    if points < MIN_POINTS {
        return Err(ParameterError::TooFew { points });
    }
    match contacts.iter().position(|c| c.normal.z < MIN_NZ) {
        Some(index) => Err(ParameterError::Normal { index, nz: contacts[index].normal.z }),
        None => Ok(()),
    }
}

/// Returns the part of an error map that machine parameters and bent guideways explain, in millimetres, with one value
/// for each of `nodes`. Returns 0 for all nodes if the parameters cannot be estimated.
///
/// Shapes: `values_mm` is the map at the nodes of `grid`. `contacts` are the points at which the part was measured; the
/// parameters are estimated from the map at these points. `nodes` are the points of the surface at the x and y of the
/// nodes of `grid`. `options` are the options of the estimation.
pub fn explained_by_parameters(
    values_mm: &[f64],
    grid: &Grid,
    [contacts, nodes]: [&[SurfacePoint]; 2],
    options: &ParameterOptions,
) -> Vec<f64> {
    let on_part =
        |c: &SurfacePoint| SurfacePoint { deviation_mm: grid.interpolate(values_mm, [c.point.x, c.point.y]), ..*c };
    let told = estimate_parameters(&contacts.iter().map(on_part).collect::<Vec<_>>(), None, options);
    told.map_or_else(|_| vec![0.0; nodes.len()], |told| nodes.iter().map(|node| told.explained.at(node)).collect())
}
