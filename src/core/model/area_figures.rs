//! Figures of sampled forms that belong to an area: slopes, and power, irregularity and related figures of ISO 10110-5.
//!
//! Each sampled form has figures of its own. The median over all forms and the interval that contains 95 % of them are
//! the result. Everything that depends on the places alone is computed once: [`IsoFits`], [`SlopeOperator`].

use nalgebra::DMatrix;
use rayon::prelude::*;
use regrind_figures::Interval;
use serde::Serialize;

use super::interval::FigureSamples;
use crate::form::{IsoFits, IsoFormValues, SlopeOperator};

/// Slopes of the smooth form. Their uncertainty includes the uncertainty of the pose and the noise of the probe. Form
/// that is too narrow to be distinguished from noise is not included, because its slope cannot be measured.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SlopeFigures {
    /// Root mean square of the length of the gradient.
    pub rms: AngleInterval,
    /// Maximum length of the gradient.
    #[serde(rename = "largest")]
    pub max: AngleInterval,
    /// Integration length of the slopes.
    pub integration_mm: f64,
    /// Number of places with a slope; places at an edge have none.
    pub places: usize,
}

/// Median of a slope, and its 95 % credible interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct AngleInterval {
    /// Median: the slope is above and below it with equal probability.
    pub median_rad: f64,
    /// Lower end: the slope is below it with a probability of 2.5 %.
    pub low_rad: f64,
    /// Upper end: the slope is above it with a probability of 2.5 %.
    pub high_rad: f64,
}

/// Figures of ISO 10110-5 of the form; [`crate::form::Iso10110`] has the same figures of points.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct IsoFigures {
    /// A: PV of the power. The interval begins at 0 if the sign of the power is uncertain.
    pub power: Interval,
    /// Height of the power at the rim over the centre: above 0 if the rim is higher.
    pub power_rim: Interval,
    /// B: PV of the irregularity.
    pub irregularity: Interval,
    /// C: PV of the part of the irregularity that is symmetric about the centre.
    pub symmetric: Interval,
    /// RMSt: root mean square of the form without piston and tilt.
    pub rms_total: Interval,
    /// RMSi: root mean square of the irregularity.
    pub rms_irregularity: Interval,
    /// RMSa: root mean square of the asymmetric part.
    pub rms_varying: Interval,
}

impl SlopeFigures {
    /// Computes the slope figures (RMS and maximum slope) with their credible intervals, from random samples of the
    /// form. `slopes` computes the slopes of one sample. Each matrix of `forms` has one column for each sample and one
    /// row for each place of `slopes`, in mm.
    ///
    /// The first matrix has samples of the posterior. They give the median and the interval of each figure. The second
    /// matrix has samples of fields with an increased variance, whose extremes are larger. They can only raise the
    /// upper end of the interval of the maximum slope.
    ///
    /// `is_seen` is true if a form was detected. If it is false, the lower ends of the intervals are 0.
    pub(super) fn from_forms(slopes: &SlopeOperator, forms: &[DMatrix<f64>; 2], is_seen: bool) -> Self {
        let found = forms.each_ref().map(|forms| map_columns(forms, |form| slopes.evaluate(form)));
        let [rms, largest] = [0, 1].map(|k| {
            let values = |of: usize| found[of].iter().map(|of| of[k]).collect();
            let higher = (k == 1).then(|| values(1)).into_iter();
            let of = FigureSamples::new(values(0), (Vec::new(), higher), is_seen.then_some(1.0)).interval();
            AngleInterval { median_rad: of.median_mm, low_rad: of.low_mm, high_rad: of.high_mm }
        });
        Self { rms, max: largest, integration_mm: slopes.integration_mm, places: slopes.nodes }
    }
}

impl IsoFigures {
    /// Computes the ISO 10110-5 figures with their credible intervals, from random samples of the form. `fits` computes
    /// the figures of one sample. Each matrix of `forms` has one column for each sample and one row for each place of
    /// `fits`, in mm.
    ///
    /// The first matrix has samples of the posterior. They give the median and the interval of each figure. The second
    /// matrix has samples of fields with an increased variance, whose extremes are larger. They can only raise the
    /// upper ends of two intervals: the PV of the irregularity, and the PV of its symmetric part.
    ///
    /// `is_seen` is true if a form was detected. If it is false, the lower ends of all intervals are 0, except that of
    /// `power_rim` (height of the power at the rim over the centre). The lower end of `power` is also 0 if the sign of
    /// the power is uncertain.
    pub(super) fn from_forms(fits: &IsoFits, forms: &[DMatrix<f64>; 2], is_seen: bool) -> Self {
        let found = forms.each_ref().map(|forms| map_columns(forms, |form| fits.evaluate(form)));
        let values = |k: usize, of: fn(&IsoFormValues) -> f64| found[k].iter().map(of).collect::<Vec<f64>>();
        let interval = |of: fn(&IsoFormValues) -> f64, has_low: bool| {
            FigureSamples::new(values(0, of), (Vec::new(), std::iter::empty()), has_low.then_some(1.0)).interval()
        };
        let extreme = |of: fn(&IsoFormValues) -> f64| {
            let higher = std::iter::once(values(1, of));
            FigureSamples::new(values(0, of), (Vec::new(), higher), is_seen.then_some(1.0)).interval()
        };
        let power_rim = interval(|of| of.power_rim_mm, true);
        let has_sign = power_rim.low_mm * power_rim.high_mm > 0.0;
        Self {
            power: interval(|of| of.power_mm, is_seen && has_sign),
            power_rim,
            irregularity: extreme(|of| of.irregularity_mm),
            symmetric: extreme(|of| of.symmetric_mm),
            rms_total: interval(|of| of.rms_total_mm, is_seen),
            rms_irregularity: interval(|of| of.rms_irregularity_mm, is_seen),
            rms_varying: interval(|of| of.rms_varying_mm, is_seen),
        }
    }
}

/// Calls `make` with each column of `forms`, in parallel. Returns the results in the order of the columns.
fn map_columns<T: Send>(forms: &DMatrix<f64>, make: impl Fn(&[f64]) -> T + Send + Sync) -> Vec<T> {
    forms.as_slice().par_chunks(forms.nrows().max(1)).map(make).collect()
}
