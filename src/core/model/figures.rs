//! The figures of drawn forms that are made of an area: slopes, and power, irregularity and their like after ISO 10110-5.
//!
//! Each form has its own; over all forms they are a median and the interval that holds 95 % of them. What depends on the places alone is made once:
//! [`IsoFits`], [`SlopesAt`].

use nalgebra::DMatrix;
use rayon::prelude::*;
use serde::Serialize;

use super::{Interval, ModelInputs};
use crate::form::{IsoFits, IsoOfForm, SlopesAt};

/// What figures of an area go by.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AreaOptions {
    /// The middle that symmetry is meant about, x and y of the model frame; without one the middle of the bounds of the places.
    pub middle_mm: Option<[f64; 2]>,
    /// The length over which slopes are taken; it is longer where the places are too far apart for it, and without one as short as they allow.
    pub integration_mm: Option<f64>,
}

/// The slopes of the smooth form, its pose and the scatter of the probe in their uncertainty. What is too narrow to be told from scatter has a height and no slope
/// that could be told, and is not in them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SlopeFigures {
    /// Root mean square of the gradient's length.
    pub rms: AngleInterval,
    /// Largest length of the gradient.
    pub largest: AngleInterval,
    /// Length over which a slope was taken.
    pub integration_mm: f64,
    /// At how many places it was taken; at edges it is not.
    pub places: usize,
}

/// A median, and the interval that holds the slope with a probability of 95 %.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct AngleInterval {
    /// As probably above as below.
    pub median_rad: f64,
    /// Below it with a probability of 2.5 %.
    pub low_rad: f64,
    /// Above it with a probability of 2.5 %.
    pub high_rad: f64,
}

/// ISO 10110-5 of the form, as [`crate::form::Iso10110`] has it of points.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct IsoFigures {
    /// A: PV of the power. It begins at 0 where the power may have either sign.
    pub power: Interval,
    /// Height of the power at the rim over the middle: above 0 where the rim stands proud.
    pub power_rim: Interval,
    /// B: PV of the irregularity.
    pub irregularity: Interval,
    /// C: PV of the part of the irregularity that is symmetric about the middle.
    pub symmetric: Interval,
    /// RMSt: root mean square of the total.
    pub rms_total: Interval,
    /// RMSi: root mean square of the irregularity.
    pub rms_irregularity: Interval,
    /// RMSa: root mean square of what is not symmetric.
    pub rms_varying: Interval,
}

impl SlopeFigures {
    /// Of smooth forms, a column each, and of those that tell extremes from above.
    pub(super) fn of(slopes: &SlopesAt, forms: &[DMatrix<f64>; 2], (is_seen, inputs): (bool, &ModelInputs)) -> Self {
        let found = forms.each_ref().map(|forms| each(forms, |form| slopes.of(form)));
        let [rms, largest] = [0, 1].map(|k| {
            let values = |of: usize| found[of].iter().map(|of| of[k]).collect();
            let of = Interval::of(values(0), (Vec::new(), (k == 1).then(|| values(1)).into_iter()), is_seen, inputs);
            AngleInterval { median_rad: of.median_mm, low_rad: of.low_mm, high_rad: of.high_mm }
        });
        Self { rms, largest, integration_mm: slopes.integration_mm, places: slopes.nodes }
    }
}

impl IsoFigures {
    /// Of forms, a column each, and of those that tell extremes from above.
    pub(super) fn of(fits: &IsoFits, forms: &[DMatrix<f64>; 2], is_seen: bool, inputs: &ModelInputs) -> Self {
        let found = forms.each_ref().map(|forms| each(forms, |form| fits.of(form)));
        let values = |k: usize, of: fn(&IsoOfForm) -> f64| found[k].iter().map(of).collect::<Vec<f64>>();
        let interval = |of: fn(&IsoOfForm) -> f64, has_low: bool| {
            Interval::of(values(0, of), (Vec::new(), std::iter::empty()), has_low, inputs)
        };
        let extreme = |of: fn(&IsoOfForm) -> f64| {
            Interval::of(values(0, of), (Vec::new(), std::iter::once(values(1, of))), is_seen, inputs)
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

/// What is made of each column, in their order.
fn each<T: Send>(forms: &DMatrix<f64>, make: impl Fn(&[f64]) -> T + Send + Sync) -> Vec<T> {
    forms.as_slice().par_chunks(forms.nrows().max(1)).map(make).collect()
}
