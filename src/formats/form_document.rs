//! Results of the error model for a registered measurement, as files.

use std::path::Path;

use serde::Serialize;

use super::document::StandardUncertainty;
use super::error::FormatError;
use super::registration::{write_json_atomic, write_rows};
use super::run_files::CycleFile;
use regrind_core::model::{BudgetEntry, Form, FormPoint, IsoFigures, SlopeFigures};
use regrind_core::registration::Registration;
use regrind_figures::Interval;

/// Columns of `form.csv`.
const FORM_HEADER: &str = "x_mm,y_mm,form_mm,sigma_mm";

/// Content of `model.json`. Lengths in millimetres.
#[derive(Serialize)]
struct FormDocument<'a> {
    /// True if the part comes from a simulated cell; absent if that is unknown.
    #[serde(skip_serializing_if = "Option::is_none")]
    simulation: Option<bool>,
    /// Standard deviation and range of the form; `scatter_mm` below is the noise of a single point.
    form_sigma_mm: f64,
    form_range_mm: f64,
    /// Number of times that the form is differentiable: once or without limit.
    form_smoothness: &'static str,
    /// Anisotropy of the form: the ratio of the range along the lay to that across it, and the angle of the lay from x.
    form_lay_stretch: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    form_lay_deg: Option<f64>,
    scatter_mm: f64,
    /// Autocorrelation of the noise from a point to the next one along the path.
    scatter_drift: f64,
    /// True if a form error is detectable; if not, the figures are only upper bounds.
    form_is_seen: bool,
    /// Degrees of freedom of the residuals of the fit; below 20, only a reference sphere can separate the form from the
    /// noise.
    degrees_of_freedom: f64,
    /// Figures of the form after its own best fit: median and 95 % credible interval.
    rms: Interval,
    pv: Interval,
    pv_99_8: Interval,
    /// Contributions to the standard uncertainties of the figures; their squares add up.
    budget: &'a [BudgetEntry],
    /// Slopes of the smooth form, and its figures by ISO 10110-5; absent if there are too few points.
    #[serde(skip_serializing_if = "Option::is_none")]
    slope: Option<SlopeFigures>,
    #[serde(skip_serializing_if = "Option::is_none")]
    iso_10110_5: Option<IsoFigures>,
    /// The same figures of the measured deviations, which include the noise of the probe.
    raw_rms_mm: f64,
    raw_pv_mm: f64,
    /// Standard uncertainty of the pose of the nominal frame. The `covariance` in registration.json describes only the
    /// repeatability of the pose.
    frame_standard_uncertainty: StandardUncertainty,
    frame_covariance: [[f64; 6]; 6],
}

/// Writes the result of the form model into `folder`. `model.json` receives the parameters and the figures. `form.csv`
/// receives one row for each point of `form`, in the same order: x, y, the form and its standard uncertainty, in mm.
/// `simulation` is written to `model.json` unchanged.
///
/// # Errors
/// A file that cannot be written.
pub fn save_form(
    folder: &Path,
    form: &Form,
    registration: &Registration,
    simulation: Option<bool>,
) -> Result<(), FormatError> {
    let covariance = form.frame_covariance;
    let sigma = |k: usize| covariance[(k, k)].max(0.0).sqrt();
    let document = FormDocument {
        simulation,
        form_sigma_mm: form.hyperparameters.field.sigma_mm,
        form_range_mm: form.hyperparameters.field.range_mm,
        form_smoothness: form.hyperparameters.field.smoothness.name(),
        form_lay_stretch: form.hyperparameters.field.anisotropy.stretch,
        form_lay_deg: form.hyperparameters.field.anisotropy.angle_rad().map(f64::to_degrees),
        scatter_mm: form.hyperparameters.noise_sigma_mm,
        scatter_drift: form.hyperparameters.noise_autocorrelation,
        form_is_seen: form.is_detected,
        degrees_of_freedom: form.degrees_of_freedom,
        rms: without_quantiles(form.figures.rms),
        pv: without_quantiles(form.figures.pv),
        pv_99_8: without_quantiles(form.figures.pv_998),
        budget: &form.budget,
        slope: form.slope,
        iso_10110_5: form.iso,
        raw_rms_mm: registration.quality.rms_mm,
        raw_pv_mm: registration.quality.pv_mm,
        frame_standard_uncertainty: StandardUncertainty {
            x_mm: sigma(0),
            y_mm: sigma(1),
            z_mm: sigma(2),
            rx_rad: sigma(3),
            ry_rad: sigma(4),
            rz_rad: sigma(5),
        },
        frame_covariance: std::array::from_fn(|r| std::array::from_fn(|c| covariance[(r, c)])),
    };
    write_json_atomic(folder.join(CycleFile::Model.name()), &document)?;
    let row = |of: &FormPoint| [of.place_mm[0], of.place_mm[1], of.form.mean_mm, of.form.sigma_mm];
    let rows: Vec<[f64; 4]> = form.points.iter().map(row).collect();
    write_rows(&folder.join(CycleFile::Form.name()), FORM_HEADER, &rows, |row| (*row, None))
}

fn without_quantiles(of: Interval) -> Interval {
    Interval { quantiles_mm: None, ..of }
}
