//! Figures of form, computed from the points themselves.

use serde::Serialize;

use super::FormError;
use super::error::check;
use super::fit::{PolynomialFit, fit_determined_terms};
use super::iso::{Iso10110, iso_10110};
use super::polynomial_basis::PolynomialBasis;
use super::removed_forms::{RemovedForm, pv, remove_forms};
use crate::geometry::{Aperture, DeviationSample, bounds};

/// Terms of the fit in PVr (Evans 2009: the first 36 Fringe Zernike polynomials).
const PVR_TERMS: usize = 36;
/// Divisor of the number of points that PV 99.8 % omits at each end: 1 of 1000, see [`pv_998`].
const PV_998_TRIM_DIVISOR: usize = 1000;
/// Maximum number of cells for the coverage, along the longer side of the bounds.
const MAX_CELLS: f64 = 64.0;
/// Average number of points in a cell of the coverage.
const POINTS_PER_CELL: f64 = 4.0;

/// Options of [`compute_figures`].
#[derive(Clone, Debug, PartialEq)]
pub struct FormOptions {
    /// Aperture of the polynomials and the coverage. `None` for the bounds of the points.
    pub aperture: Option<Aperture>,
    /// Forms to remove from the deviations by least squares before the figures are computed.
    pub removed: Vec<RemovedForm>,
    /// Wavelength that the ISO 10110-5 notation names.
    pub wavelength_nm: f64,
}

impl Default for FormOptions {
    fn default() -> Self {
        Self { aperture: None, removed: Vec::new(), wavelength_nm: 632.8 }
    }
}

/// Deviation and its position.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Extreme {
    /// Deviation in millimetres.
    pub value_mm: f64,
    /// x and y in the model frame, in millimetres.
    #[serde(rename = "at_mm")]
    pub place_mm: [f64; 2],
}

/// Robust peak to valley (PVr): PV of a fit plus three times the rms of its residuals.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RobustPv {
    /// PVr: `fit_pv_mm` plus 3 times `residual_rms_mm`.
    pub value_mm: f64,
    /// PV of the fit at the points, in millimetres.
    pub fit_pv_mm: f64,
    /// Root mean square of the residuals of the fit, in millimetres.
    pub residual_rms_mm: f64,
    /// Name of the polynomials.
    pub basis: &'static str,
    /// Number of terms that the points determine, 36 at most.
    pub terms: usize,
}

/// Measured part of the aperture.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Coverage {
    /// Share of the cells within the aperture that contain a point, from 0 to 1.
    pub share: f64,
    /// Side of a cell, in millimetres.
    pub cell_mm: f64,
}

/// Form figures of the deviations.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviationFigures {
    /// Number of points.
    pub points: usize,
    /// Forms removed from the deviations before the figures were computed.
    pub removed: Vec<RemovedForm>,
    /// Largest minus smallest deviation.
    pub pv_mm: f64,
    /// Robust peak to valley.
    pub pvr: RobustPv,
    /// PV of all points without the outermost 0.2 %, by [`pv_998`].
    pub pv_998_mm: f64,
    /// Root mean square of the deviations.
    pub rms_mm: f64,
    /// Mean deviation.
    pub mean_mm: f64,
    /// Highest point: stock left, if it is above 0.
    pub highest: Extreme,
    /// Lowest point: undercut, if it is below 0.
    pub lowest: Extreme,
    /// Measured part of the aperture.
    pub coverage: Coverage,
    /// Power, irregularity and the related figures of ISO 10110-5.
    pub iso_10110: Iso10110,
    /// Fit of Zernike polynomials on the smallest disc that contains the aperture; `None` if it fails.
    pub zernike: Option<PolynomialFit>,
    /// Fit of Legendre polynomials on the smallest rectangle that contains the aperture; `None` if it fails.
    pub legendre: Option<PolynomialFit>,
}

/// Computes the form figures of a surface from its deviations: PV, PVr, RMS, coverage, ISO 10110-5 and polynomial fits.
///
/// The samples are the measured points in any order, without the rejected points. Their x and y are in the model frame,
/// in millimetres. The forms in [`FormOptions::removed`] are removed from the deviations first. PVr uses the
/// polynomials that [`PolynomialBasis::for_aperture`] selects.
///
/// # Errors
/// Returns an error if there are fewer than four points, if they lie on a line or do not determine a removed form, if a
/// number is not finite, if a point lies more than 1.5 radii from the centre of a round or elliptical aperture, or if
/// the wavelength is not a finite number above 0.
pub fn compute_figures(samples: &[DeviationSample], options: &FormOptions) -> Result<DeviationFigures, FormError> {
    check(samples, 4)?;
    let aperture = match &options.aperture {
        Some(aperture) => aperture.clone(),
        None => rectangle_from_bounds(bounds(samples.iter().map(|s| s.place_mm)))?,
    };
    let mut removed = options.removed.clone();
    removed.sort();
    removed.dedup();
    let samples = remove_forms(&removed, samples)?;
    let points = samples.len();
    let by_value = |a: &&DeviationSample, b: &&DeviationSample| a.deviation_mm.total_cmp(&b.deviation_mm);
    let extreme = |s: &DeviationSample| Extreme { value_mm: s.deviation_mm, place_mm: s.place_mm };
    let (Some(highest), Some(lowest)) = (samples.iter().max_by(by_value), samples.iter().min_by(by_value)) else {
        return Err(FormError::TooFewPoints { points, min_points: 4 });
    };
    let mean = |f: fn(f64) -> f64| samples.iter().map(|s| f(s.deviation_mm)).sum::<f64>() / points as f64;
    let basis = PolynomialBasis::for_aperture(&aperture);
    let suited = fit_determined_terms(&basis, PVR_TERMS, &samples)?;
    let of_kind = |wanted: PolynomialBasis| {
        if wanted == basis { Some(suited.clone()) } else { fit_determined_terms(&wanted, PVR_TERMS, &samples).ok() }
    };
    Ok(DeviationFigures {
        points,
        pv_mm: highest.deviation_mm - lowest.deviation_mm,
        pvr: robust_pv(&suited, &samples)?,
        pv_998_mm: pv_998(samples.iter().map(|s| s.deviation_mm)).unwrap_or_default(),
        rms_mm: mean(|d| d * d).sqrt(),
        mean_mm: mean(|d| d),
        highest: extreme(highest),
        lowest: extreme(lowest),
        coverage: coverage(&aperture, &samples),
        iso_10110: iso_10110(&samples, &aperture, options.wavelength_nm)?,
        zernike: of_kind(PolynomialBasis::zernike(&aperture)),
        legendre: of_kind(PolynomialBasis::legendre(aperture.bounds())),
        removed,
    })
}

fn rectangle_from_bounds([low, high]: [[f64; 2]; 2]) -> Result<Aperture, FormError> {
    let has_area = (0..2).all(|k| high[k] - low[k] > 0.0);
    if has_area { Ok(Aperture::from_corners([low, high])) } else { Err(FormError::NoArea) }
}

/// Computes PVr (robust peak to valley, Evans 2009): the PV of the fitted polynomials `fit` at the positions of the
/// samples, plus three times the RMS of the residuals of the fit.
///
/// # Errors
/// Returns an error if a sample lies more than 1.5 radii from the centre of a Zernike disc.
fn robust_pv(fit: &PolynomialFit, samples: &[DeviationSample]) -> Result<RobustPv, FormError> {
    let values = fit.values_mm(samples)?;
    let fit_pv_mm = pv(values.into_iter());
    let residual_rms_mm = fit.residual_rms_mm;
    Ok(RobustPv {
        value_mm: fit_pv_mm + 3.0 * residual_rms_mm,
        fit_pv_mm,
        residual_rms_mm,
        basis: fit.basis.name(),
        terms: fit.coefficients_mm.len(),
    })
}

/// Returns PV 99.8 %: the peak to valley of the values without the lowest 0.1 % and the highest 0.1 % of them.
///
/// The number of values omitted at each end is rounded down: with fewer than 1000 values, none is omitted. Returns
/// `None` if there are no values.
pub fn pv_998(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    let beyond = values.len() / PV_998_TRIM_DIVISOR;
    Some(values.get(values.len().checked_sub(1 + beyond)?)? - values.get(beyond)?)
}

/// Computes the share of the aperture that is measured, from 0 to 1. The bounding box of the aperture is divided into
/// square cells. The share is the number of cells that contain a sample, divided by the number of all cells. Cells
/// whose centre is outside the aperture are not counted.
///
/// The size of a cell is chosen so that a cell contains four samples on average. The side of a cell is at least 1/64 of
/// the longer side of the bounding box.
fn coverage(aperture: &Aperture, samples: &[DeviationSample]) -> Coverage {
    let [low, high] = aperture.bounds();
    let size: [f64; 2] = std::array::from_fn(|k| high[k] - low[k]);
    let wanted = (POINTS_PER_CELL * size[0] * size[1] / samples.len() as f64).sqrt();
    let cell_mm = wanted.max(size[0].max(size[1]) / MAX_CELLS);
    let count: [usize; 2] = std::array::from_fn(|k| (size[k] / cell_mm).ceil().max(1.0) as usize);
    let mut held = vec![false; count[0] * count[1]];
    for sample in samples {
        let place: [f64; 2] = std::array::from_fn(|k| (sample.place_mm[k] - low[k]) / cell_mm);
        if place.iter().all(|p| *p >= 0.0) {
            let [i, j]: [usize; 2] = std::array::from_fn(|k| (place[k] as usize).min(count[k] - 1));
            held[j * count[0] + i] = true;
        }
    }
    let middle = |k: usize, index: usize| low[k] + (index as f64 + 0.5) * cell_mm;
    let within = |k: &usize| aperture.contains(middle(0, k % count[0]), middle(1, k / count[0]));
    let cells: Vec<usize> = (0..held.len()).filter(within).collect();
    let share = cells.iter().filter(|k| held[**k]).count() as f64 / cells.len().max(1) as f64;
    Coverage { share, cell_mm }
}
