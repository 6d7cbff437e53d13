//! Figures of the form as `figures.json` lists them: each with its median and 95 % credible interval, and with the same
//! figure of the measured deviations, called raw.

use serde::Serialize;

use regrind_core::form::{DeviationFigures, Iso10110, RemovedParts, Slope, iso_10110_notation};
use regrind_core::model::{AngleInterval, Form, IsoFigures};
use regrind_figures::Interval;

/// Figure of the form.
#[derive(Serialize)]
pub(super) struct FormFigureRow {
    /// Name of the figure.
    name: &'static str,
    /// Median of the posterior.
    median: f64,
    /// Quantile of 2.5 %; 0 if only an upper bound of the figure is known.
    low: f64,
    /// Quantile of 97.5 %.
    high: f64,
    /// The same figure of the measured deviations, which include the noise of the probe; `None` if it was not computed.
    raw: Option<f64>,
    unit: &'static str,
    /// Terms that were removed before.
    removed: String,
    /// Definition of the figure, if its name does not give it.
    made: String,
}

const POINTS: &str = "of the form at all points";
const POWER: &str = "A of ISO 10110-5: PV of the best sphere";
const RIM: &str = "height of the best sphere at the rim above its middle; positive if the rim is proud";
const IRREGULARITY: &str = "B of ISO 10110-5: PV of the form without piston, tilt and power";
const SYMMETRIC: &str = "C of ISO 10110-5: PV of the part of the irregularity that is symmetric about the middle";
const RMS_TOTAL: &str = "of the form without piston and tilt";
const RMS_IRREGULARITY: &str = "of the form without piston, tilt and power";
const RMS_VARYING: &str = "of the part of the irregularity that is not symmetric about the middle";

/// Returns the figures of a form, in the order of a report: PV and RMS, then slopes, then figures of ISO 10110-5. Each
/// row holds the median and the limits of the credible interval. PV and RMS are in micrometres, slopes in microradians,
/// and figures of ISO 10110-5 in nanometres. Slopes and ISO figures are omitted if `form` has none.
///
/// `raw` holds the same figures of the measured deviations, which include the noise of the probe. `slope` holds the
/// slopes of the error map. Both only fill the column for comparison, and can be `None`. `taken_out` names the terms
/// that were removed before the figures were computed.
pub(super) fn form_figure_rows(
    form: &Form,
    raw: Option<&DeviationFigures>,
    slope: Option<&Slope>,
    taken_out: &RemovedParts,
) -> Vec<FormFigureRow> {
    let removed = taken_out.describe(raw.map_or(&[], |raw| &raw.removed));
    let row = |name, [median, low, high]: [f64; 3], raw, unit, made: &str| FormFigureRow {
        name,
        median,
        low,
        high,
        raw,
        unit,
        removed: removed.clone(),
        made: made.to_owned(),
    };
    let um = |name, of: Interval, raw_mm: Option<f64>, made| {
        row(name, values(of).map(|mm| 1e3 * mm), raw_mm.map(|mm| 1e3 * mm), "um", made)
    };
    let figures = form.figures;
    let most = "of the form over the aperture, without the outermost 0.1 % between the points at either end";
    let mut rows = vec![
        um("PV", figures.pv, raw.map(|raw| raw.pv_mm), POINTS),
        um("PV 99.8 %", figures.pv_998, raw.map(|raw| raw.pv_998_mm), most),
        um("RMS", figures.rms, raw.map(|raw| raw.rms_mm), POINTS),
    ];
    if let Some(of) = form.slope {
        let made = format!(
            "of the smooth form, over {:.3} mm, at {} positions with neighbours on all sides; raw: of the map",
            of.integration_mm, of.places
        );
        let urad = |name, of: AngleInterval, raw_rad: Option<f64>| {
            let values = [of.median_rad, of.low_rad, of.high_rad].map(|rad| 1e6 * rad);
            row(name, values, raw_rad.map(|rad| 1e6 * rad), "urad", &made)
        };
        rows.push(urad("slope RMS", of.rms, slope.map(|raw| raw.rms_rad)));
        rows.push(urad("slope, largest", of.max, slope.map(|raw| raw.max_rad)));
    }
    if let Some(of) = form.iso {
        let raw = raw.map(|raw| &raw.iso_10110);
        let nm = |name, of: Interval, raw_nm: fn(&Iso10110) -> f64, made| {
            row(name, values(of).map(|mm| 1e6 * mm), raw.map(raw_nm), "nm", made)
        };
        rows.extend([
            nm("power", of.power, |raw| raw.power_nm, POWER),
            nm("power at the rim", of.power_rim, |raw| raw.power_rim_nm, RIM),
            nm("irregularity", of.irregularity, |raw| raw.irregularity_nm, IRREGULARITY),
            nm("symmetric irregularity", of.symmetric, |raw| raw.symmetric_nm, SYMMETRIC),
            nm("RMSt", of.rms_total, |raw| raw.rms_total_nm, RMS_TOTAL),
            nm("RMSi", of.rms_irregularity, |raw| raw.rms_irregularity_nm, RMS_IRREGULARITY),
            nm("RMSa", of.rms_varying, |raw| raw.rms_varying_nm, RMS_VARYING),
        ]);
    }
    rows
}

fn values(of: Interval) -> [f64; 3] {
    [of.median_mm, of.low_mm, of.high_mm]
}

/// Returns the upper limits of the form error in the notation of ISO 10110-5 for drawings: `3/A(B/C) RMSt<D; RMSi<E;
/// RMSa<F; lambda=G`. `of` holds the figures of the form, each with its credible interval.
///
/// A is the limit of the power (the spherical part of the error), B of the irregularity and C of the rotationally
/// symmetric irregularity. D, E and F are the limits of the three RMS figures. Each of the values A to F is the upper
/// limit of the credible interval of its figure, in nanometres. The true figure is below this limit with a probability
/// of 97.5 %. G is `wavelength_nm`.
pub(super) fn notation(of: &IsoFigures, wavelength_nm: f64) -> String {
    let most = |of: Interval| 1e6 * of.high_mm;
    iso_10110_notation(
        [of.power, of.irregularity, of.symmetric].map(most),
        [of.rms_total, of.rms_irregularity, of.rms_varying].map(most),
        wavelength_nm,
    )
}
