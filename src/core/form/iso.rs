//! Surface form in the notation of ISO 10110-5: `3/A(B/C) RMSt<D; RMSi<E; RMSa<F; lambda=G`.
//!
//! With the deviation d over the aperture, all fits by least squares (ISO 14999-4):
//!
//! ```text
//!  total          T = d - (piston, tilt)                RMSt = rms T
//!  power          c r^2 of the fit (piston, tilt, r^2)  A    = PV of c r^2
//!  irregularity   I = d - (piston, tilt, r^2)           B    = PV I     RMSi = rms I
//!  symmetric part S = even polynomial in r fitted to I  C    = PV S
//!  varying part   I - S                                 RMSa = rms (I - S)
//! ```

use regrind_figures::statistics::rms;
use serde::Serialize;

use super::FormError;
use super::error::check;
use super::fit::solve_least_squares;
use super::removed_forms::{RemovedForm, pv, remove_forms};
use crate::geometry::{Aperture, DeviationSample};

/// Degree of the symmetric part as a polynomial in r^2; its highest power is r^12.
pub(super) const MAX_SYMMETRIC_DEGREE: usize = 6;

/// Power, irregularity and the related figures of the surface by ISO 10110-5, in nanometres.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Iso10110 {
    /// A: PV of the power.
    pub power_nm: f64,
    /// Height of the power at the rim relative to the centre, positive if the rim is higher.
    pub power_rim_nm: f64,
    /// B: PV of the irregularity.
    pub irregularity_nm: f64,
    /// C: PV of the part of the irregularity that is symmetric about the centre.
    pub symmetric_nm: f64,
    /// RMSt: root mean square of the deviations without piston and tilt.
    pub rms_total_nm: f64,
    /// RMSi: root mean square of the irregularity.
    pub rms_irregularity_nm: f64,
    /// RMSa: root mean square of the part of the irregularity that is not symmetric about the centre.
    pub rms_varying_nm: f64,
    /// Wavelength in the notation.
    pub wavelength_nm: f64,
    /// Tightest indication that the surface meets: every value rounded up, in nanometres.
    pub notation: String,
}

/// Computes the ISO 10110-5 figures of the deviations of a surface, in nanometres. Piston and tilt are removed first.
/// The rest has these parts:
///
/// - total: the deviations without piston and tilt
/// - power: the part proportional to r^2, where r is the distance from the centre
/// - irregularity: the total without the power
/// - symmetric part: the part of the irregularity that is rotationally symmetric about the centre
/// - varying part: the irregularity without the symmetric part
///
/// Returns the PV of power, irregularity and symmetric part, and the RMS of total, irregularity and varying part. Also
/// returns the height of the power at the rim relative to the centre, and the notation of ISO 10110-5.
///
/// The positions and deviations of the samples are in the model frame, in millimetres. The centre is that of the
/// bounding box of `aperture`. `wavelength_nm` only appears in the notation and does not change the figures.
///
/// # Errors
/// Returns an error if there are fewer than four points, if they lie on a line, if a number is not finite, or if the
/// wavelength is not a finite number above 0.
pub fn iso_10110(samples: &[DeviationSample], aperture: &Aperture, wavelength_nm: f64) -> Result<Iso10110, FormError> {
    check(samples, 4)?;
    if !(wavelength_nm > 0.0 && wavelength_nm.is_finite()) {
        return Err(FormError::Wavelength { wavelength_nm });
    }
    let [low, high] = aperture.bounds();
    let middle: [f64; 2] = std::array::from_fn(|k| 0.5 * (low[k] + high[k]));
    let radius =
        samples.iter().map(|s| (s.place_mm[0] - middle[0]).hypot(s.place_mm[1] - middle[1])).fold(0.0, f64::max);
    let square = |s: &DeviationSample| {
        let [x, y]: [f64; 2] = std::array::from_fn(|k| (s.place_mm[k] - middle[k]) / radius);
        x * x + y * y
    };
    let total = remove_forms(&[RemovedForm::Piston, RemovedForm::Tilt], samples)?;
    let irregularity = remove_forms(&[RemovedForm::Piston, RemovedForm::Tilt, RemovedForm::Power], samples)?;
    // The coefficient of r^2. Its origin does not matter, because piston and tilt are fitted too.
    let power = solve_least_squares(4, samples, |_, s, row| {
        let [x, y]: [f64; 2] = std::array::from_fn(|k| (s.place_mm[k] - middle[k]) / radius);
        row.copy_from_slice(&[1.0, x, y, x * x + y * y]);
        Ok(())
    })?
    .coefficients[3];
    let symmetric = fit_symmetric_part(&irregularity, square)?;
    let varying = irregularity.iter().zip(&symmetric).map(|(s, even)| s.deviation_mm - even);
    let nm = |mm: f64| 1e6 * mm;
    let rms_varying_nm = nm(rms(varying));
    let mut found = Iso10110 {
        power_nm: nm(power.abs() * pv(samples.iter().map(square))),
        power_rim_nm: nm(power),
        irregularity_nm: nm(pv(irregularity.iter().map(|s| s.deviation_mm))),
        symmetric_nm: nm(pv(symmetric.into_iter())),
        rms_total_nm: nm(rms(total.iter().map(|s| s.deviation_mm))),
        rms_irregularity_nm: nm(rms(irregularity.iter().map(|s| s.deviation_mm))),
        rms_varying_nm,
        wavelength_nm,
        notation: String::new(),
    };
    found.notation = notation(&found);
    Ok(found)
}

/// Fits a rotationally symmetric form to the deviations by least squares. Returns the value of this form at each
/// sample, in millimetres.
///
/// `square` returns (r/R)^2 of a sample. r is the distance of the sample from the centre, and R is the largest such
/// distance. The form is a weighted sum of the seven polynomials of [`even_terms`]. The polynomials of the highest
/// degrees are omitted if there are fewer than 28 samples, or if the samples do not determine all seven.
fn fit_symmetric_part(
    samples: &[DeviationSample],
    square: impl Fn(&DeviationSample) -> f64 + Sync,
) -> Result<Vec<f64>, FormError> {
    let values = |s: &DeviationSample| even_terms(square(s));
    let mut terms = (MAX_SYMMETRIC_DEGREE + 1).min(samples.len() / 4).max(1);
    loop {
        let solved = solve_least_squares(terms, samples, |_, s, row| {
            row.copy_from_slice(&values(s)[..row.len()]);
            Ok(())
        })?;
        if solved.undetermined.is_none() || terms == 1 {
            let even =
                |s: &DeviationSample| values(s).iter().zip(&solved.coefficients).map(|(value, c)| value * c).sum();
            return Ok(samples.iter().map(even).collect());
        }
        terms -= 1;
    }
}

/// Evaluates the Legendre polynomials P_0 to P_6 at 2 `square` - 1.
///
/// `square` is (r/R)^2, from 0 to 1. r is the distance of a point from the centre, and R is the largest such distance.
/// Except for a constant factor, these polynomials are the rotationally symmetric Zernike terms.
pub(super) fn even_terms(square: f64) -> [f64; MAX_SYMMETRIC_DEGREE + 1] {
    let t = 2.0 * square - 1.0;
    let mut row = [1.0; MAX_SYMMETRIC_DEGREE + 1];
    row[1] = t;
    for n in 1..MAX_SYMMETRIC_DEGREE {
        let k = n as f64;
        row[n + 1] = ((2.0 * k + 1.0) * t * row[n] - k * row[n - 1]) / (k + 1.0);
    }
    row
}

fn notation(found: &Iso10110) -> String {
    let Iso10110 { power_nm, irregularity_nm, symmetric_nm, .. } = *found;
    let rms_nm = [found.rms_total_nm, found.rms_irregularity_nm, found.rms_varying_nm];
    iso_10110_notation([power_nm, irregularity_nm, symmetric_nm], rms_nm, found.wavelength_nm)
}

/// Formats the figures of a surface as an ISO 10110-5 indication: `3/A(B/C) RMSt<D; RMSi<E; RMSa<F; lambda=G`.
///
/// The first array holds three PV values: of the power (A), of the irregularity (B), and of the rotationally symmetric
/// part of the irregularity (C). The second array holds three RMS values: of the total (D), of the irregularity (E),
/// and of the part of the irregularity that is not symmetric (F). See [`Iso10110`]. `wavelength_nm` is G. All values
/// are in nanometres. A to F are rounded up; the wavelength is not rounded.
pub fn iso_10110_notation([a, b, c]: [f64; 3], [total, irregularity, varying]: [f64; 3], wavelength_nm: f64) -> String {
    let [a, b, c, total, irregularity, varying] = [a, b, c, total, irregularity, varying].map(format_rounded_up);
    format!("3/{a}({b}/{c}) RMSt<{total}; RMSi<{irregularity}; RMSa<{varying}; lambda={wavelength_nm}")
}

/// Formats `value_nm` rounded up: to a whole nanometre if it is at least 10 nm, otherwise to 0.01 nm. A negative value
/// gives `0`.
fn format_rounded_up(value_nm: f64) -> String {
    // The rounding error of a zero must not become a hundredth, and a zero has no sign.
    let steps = if value_nm >= 10.0 { 1.0 } else { 100.0 };
    format!("{}", ((value_nm * steps - 1e-6).ceil().max(0.0) + 0.0) / steps)
}
