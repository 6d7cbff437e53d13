//! The figures of the points themselves.

use serde::Serialize;

use super::FormError;
use super::basis::Basis;
use super::error::check;
use super::fit::{Fit, fit_most};
use super::iso::{Iso10110, iso_10110};
use super::removed::{Removed, pv, without};
use crate::geometry::{Aperture, Sample, bounds};

/// Terms of the fit in PVr (Evans 2009: the first 36 Fringe Zernike polynomials).
const PVR_TERMS: usize = 36;
/// PV 99.8 % leaves out one point of so many at either end.
const LEFT_OUT: usize = 1000;
/// Cells over the bounds that coverage is counted in, along the longer side, at most.
const MOST_CELLS: f64 = 64.0;
/// Points that a cell of the coverage holds on average.
const POINTS_A_CELL: f64 = 4.0;

/// How figures are made.
#[derive(Clone, Debug, PartialEq)]
pub struct FormOptions {
    /// The aperture that the polynomials and the coverage are meant on; without one the bounds of the points.
    pub aperture: Option<Aperture>,
    /// What is taken off by least squares before anything else.
    pub removed: Vec<Removed>,
    /// The wavelength that ISO 10110-5 names.
    pub wavelength_nm: f64,
}

impl Default for FormOptions {
    fn default() -> Self {
        Self { aperture: None, removed: Vec::new(), wavelength_nm: 632.8 }
    }
}

/// A deviation and where it is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Extreme {
    /// The deviation in millimetres.
    pub value_mm: f64,
    /// x and y in the model frame.
    pub at_mm: [f64; 2],
}

/// The robust peak to valley: PV of a fit, and three times the rms of what it leaves.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RobustPv {
    /// The sum of both.
    pub value_mm: f64,
    /// PV of the fit at the points.
    pub fit_pv_mm: f64,
    /// Root mean square of what it leaves.
    pub residual_rms_mm: f64,
    /// The polynomials.
    pub basis: &'static str,
    /// How many terms the points carried, 36 at most.
    pub terms: usize,
}

/// How much of the aperture was measured.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Coverage {
    /// Share of the cells within the aperture that hold a point.
    pub share: f64,
    /// Side of a cell.
    pub cell_mm: f64,
}

/// What is left on the part.
#[derive(Clone, Debug, PartialEq)]
pub struct Figures {
    /// How many points.
    pub points: usize,
    /// What was taken off before anything else.
    pub removed: Vec<Removed>,
    /// Largest less least.
    pub pv_mm: f64,
    /// The robust peak to valley.
    pub pvr: RobustPv,
    /// PV of all points but the outermost 0.2 %, as [`pv_of_most`] has it.
    pub pv998_mm: f64,
    /// Root mean square about zero.
    pub rms_mm: f64,
    /// The mean.
    pub mean_mm: f64,
    /// The highest point: stock left, where it is above 0.
    pub highest: Extreme,
    /// The lowest point: undercut, where it is below 0.
    pub lowest: Extreme,
    /// How much of the aperture was measured.
    pub coverage: Coverage,
    /// Power, irregularity and their like.
    pub iso_10110: Iso10110,
    /// Zernike polynomials on the smallest disc that holds the aperture.
    pub zernike: Option<Fit>,
    /// Legendre polynomials on the smallest rectangle that holds it.
    pub legendre: Option<Fit>,
}

/// Makes the figures of deviations.
///
/// Shapes: samples in any order, those that took no part left out. Frame: x and y of the model frame. Units: millimetres. The
/// polynomials of PVr are those that suit the aperture: Zernike's or Legendre's ([`Basis::of`]).
///
/// # Errors
/// Fewer than four points, points on a line, numbers that are not finite, a point far outside of the aperture, a wavelength that is none.
pub fn figures(samples: &[Sample], options: &FormOptions) -> Result<Figures, FormError> {
    check(samples, 4)?;
    let aperture = match &options.aperture {
        Some(aperture) => aperture.clone(),
        None => rectangle(bounds(samples.iter().map(|s| s.at_mm)))?,
    };
    let mut removed = options.removed.clone();
    removed.sort();
    removed.dedup();
    let samples = without(&removed, samples)?;
    let points = samples.len();
    let by_value = |a: &&Sample, b: &&Sample| a.deviation_mm.total_cmp(&b.deviation_mm);
    let extreme = |s: &Sample| Extreme { value_mm: s.deviation_mm, at_mm: s.at_mm };
    let (Some(highest), Some(lowest)) = (samples.iter().max_by(by_value), samples.iter().min_by(by_value)) else {
        return Err(FormError::TooFewPoints { points, least: 4 });
    };
    let mean = |f: fn(f64) -> f64| samples.iter().map(|s| f(s.deviation_mm)).sum::<f64>() / points as f64;
    let basis = Basis::of(&aperture);
    let suited = fit_most(&basis, PVR_TERMS, &samples)?;
    let of_kind = |wanted: Basis| {
        if wanted == basis { Some(suited.clone()) } else { fit_most(&wanted, PVR_TERMS, &samples).ok() }
    };
    Ok(Figures {
        points,
        pv_mm: highest.deviation_mm - lowest.deviation_mm,
        pvr: robust_pv(&suited, &samples)?,
        pv998_mm: pv_of_most(samples.iter().map(|s| s.deviation_mm)).unwrap_or_default(),
        rms_mm: mean(|d| d * d).sqrt(),
        mean_mm: mean(|d| d),
        highest: extreme(highest),
        lowest: extreme(lowest),
        coverage: coverage(&aperture, &samples),
        iso_10110: iso_10110(&samples, &aperture, options.wavelength_nm)?,
        zernike: of_kind(Basis::zernike(&aperture)),
        legendre: of_kind(Basis::legendre(aperture.bounds())),
        removed,
    })
}

fn rectangle([low, high]: [[f64; 2]; 2]) -> Result<Aperture, FormError> {
    let has_area = (0..2).all(|k| high[k] - low[k] > 0.0);
    if has_area { Ok(Aperture::between([low, high])) } else { Err(FormError::NoArea) }
}

fn robust_pv(fit: &Fit, samples: &[Sample]) -> Result<RobustPv, FormError> {
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

/// Returns the peak to valley of all values but the outermost 0.2 %, half of them at either end: PV 99.8 %.
///
/// Whole values are left out, never more than that share: of fewer than a thousand none. None where there are no values.
pub fn pv_of_most(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    let beyond = values.len() / LEFT_OUT;
    Some(values.get(values.len().checked_sub(1 + beyond)?)? - values.get(beyond)?)
}

/// Counts the cells within the aperture that hold a point; the cells are as large as four points take on average.
fn coverage(aperture: &Aperture, samples: &[Sample]) -> Coverage {
    let [low, high] = aperture.bounds();
    let size: [f64; 2] = std::array::from_fn(|k| high[k] - low[k]);
    let wanted = (POINTS_A_CELL * size[0] * size[1] / samples.len() as f64).sqrt();
    let cell_mm = wanted.max(size[0].max(size[1]) / MOST_CELLS);
    let count: [usize; 2] = std::array::from_fn(|k| (size[k] / cell_mm).ceil().max(1.0) as usize);
    let mut held = vec![false; count[0] * count[1]];
    for sample in samples {
        let place: [f64; 2] = std::array::from_fn(|k| (sample.at_mm[k] - low[k]) / cell_mm);
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
