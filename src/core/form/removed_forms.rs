//! Simple forms that are removed from the deviations before figures are computed.

use serde::{Deserialize, Serialize};

use super::FormError;
use super::error::check;
use super::fit::solve_least_squares;
use crate::geometry::{DeviationSample, bounds};

/// Simple form that is removed from the deviations before figures are computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum RemovedForm {
    /// A constant.
    Piston,
    /// A tilt about any axis: the terms x and y.
    Tilt,
    /// The term x^2 + y^2: the effect of an error of the radius of curvature.
    Power,
    /// The terms x^2 - y^2 and 2 x y.
    Astigmatism,
    /// The terms (x^2 + y^2) x and (x^2 + y^2) y.
    Coma,
    /// The term (x^2 + y^2)^2.
    Spherical,
}

impl RemovedForm {
    /// Returns the name of the form for a label, such as `astigmatism`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Piston => "piston",
            Self::Tilt => "tilt",
            Self::Power => "power",
            Self::Astigmatism => "astigmatism",
            Self::Coma => "coma",
            Self::Spherical => "spherical",
        }
    }
}

/// Removes the forms in `removed`, such as a tilt, from the deviations. All forms are fitted together by least squares.
///
/// Returns `samples` with the fit subtracted from the deviations. Returns them unchanged if `removed` is empty.
///
/// # Errors
/// Returns an error if there are fewer samples than terms of the forms, if a number is not finite, if all samples have
/// the same position, or if the samples do not determine a form.
pub(super) fn remove_forms(
    removed: &[RemovedForm],
    samples: &[DeviationSample],
) -> Result<Vec<DeviationSample>, FormError> {
    let [low, high] = bounds(samples.iter().map(|s| s.place_mm));
    let middle: [f64; 2] = std::array::from_fn(|k| 0.5 * (low[k] + high[k]));
    let half = 0.5 * (high[0] - low[0]).max(high[1] - low[1]);
    if removed.is_empty() {
        return Ok(samples.to_vec());
    }
    if half == 0.0 {
        return Err(FormError::NoArea);
    }
    // Lengths in half sizes of the part, so that every term is of order 1.
    let values = |sample: &DeviationSample| {
        let [x, y]: [f64; 2] = std::array::from_fn(|k| (sample.place_mm[k] - middle[k]) / half);
        let q = x * x + y * y;
        removed.iter().flat_map(move |form| {
            let (first, second) = match form {
                RemovedForm::Piston => (1.0, None),
                RemovedForm::Tilt => (x, Some(y)),
                RemovedForm::Power => (q, None),
                RemovedForm::Astigmatism => (x * x - y * y, Some(2.0 * x * y)),
                RemovedForm::Coma => (q * x, Some(q * y)),
                RemovedForm::Spherical => (q * q, None),
            };
            [Some(first), second].into_iter().flatten()
        })
    };
    let terms = values(&samples[0]).count();
    check(samples, terms)?;
    let solved = solve_least_squares(terms, samples, |_, sample, row| {
        row.iter_mut().zip(values(sample)).for_each(|(slot, value)| *slot = value);
        Ok(())
    })?;
    if let Some(k) = solved.undetermined {
        let names = removed.iter().flat_map(|form| std::iter::repeat_n(form.name(), term_count(*form)));
        let term = names.collect::<Vec<_>>()[k].to_owned();
        return Err(FormError::Undetermined { term, points: samples.len() });
    }
    let left = |sample: &DeviationSample| {
        let form: f64 = values(sample).zip(&solved.coefficients).map(|(value, c)| value * c).sum();
        DeviationSample { deviation_mm: sample.deviation_mm - form, ..*sample }
    };
    Ok(samples.iter().map(left).collect())
}

/// Returns the number of terms of a form: 2 for tilt, astigmatism and coma, otherwise 1.
fn term_count(form: RemovedForm) -> usize {
    if matches!(form, RemovedForm::Tilt | RemovedForm::Astigmatism | RemovedForm::Coma) { 2 } else { 1 }
}

/// Returns the largest minus the smallest value, or 0 if there are no values.
pub(super) fn pv(values: impl Iterator<Item = f64>) -> f64 {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if high >= low { high - low } else { 0.0 }
}
