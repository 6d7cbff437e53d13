//! `figures.json`: the figures of the residual error of the part, each with its labels.

use std::path::Path;

use serde::Serialize;

use super::error::FormatError;
use super::form_figures::{FormFigureRow, form_figure_rows, notation};
use super::registration::write_json_atomic;
use regrind_core::form::{
    DIRECTION, DeviationFigures, FormError, FormOptions, Iso10110, LabelledFigure, NO_CUT_OFF, PolynomialBasis,
    PolynomialFit, RemovedParts, Slope, label_figures, label_slope,
};
use regrind_core::model::Form;

/// Content of the file for the figures of one cycle.
#[derive(Serialize)]
struct FiguresDocument<'a> {
    simulation: bool,
    frame: &'static str,
    /// Number of points that the figures are computed from.
    points: Option<usize>,
    /// Form of the part: each figure with its credible interval, and the raw figure.
    form: Vec<FormFigureRow>,
    /// ISO 10110-5 indication that the form meets in each of its values with a probability of 97.5 %.
    form_iso_10110_5: Option<String>,
    /// Figures of the measured deviations, which include the noise of the probe.
    figures: Vec<LabelledFigure>,
    iso_10110_5: Option<OfPoints<&'a Iso10110>>,
    zernike: Option<OfPoints<SeriesDocument>>,
    legendre: Option<OfPoints<SeriesDocument>>,
    /// Figures that do not exist, each with the reason.
    missing: Vec<String>,
}

/// Quantity computed from the points, with the labels needed to interpret it.
#[derive(Serialize)]
struct OfPoints<T> {
    removed: String,
    direction: &'static str,
    cut_off: &'static str,
    #[serde(flatten)]
    what: T,
}

/// Polynomials fitted to the deviations.
#[derive(Serialize)]
struct SeriesDocument {
    polynomials: &'static str,
    normalisation: &'static str,
    centre_mm: [f64; 2],
    /// Radius of the disc (twice), or half of the width and of the height of the rectangle.
    half_size_mm: [f64; 2],
    points: usize,
    residual_rms_nm: f64,
    terms: Vec<TermDocument>,
}

#[derive(Serialize)]
struct TermDocument {
    term: String,
    /// Coefficient of the least-squares fit of all terms together.
    coefficient_nm: f64,
    /// Signed root mean square that the term removes after it is made orthogonal, on the points, to the terms before
    /// it.
    orthogonal_nm: f64,
}

/// Results of a cycle: the figures of the points, the slopes of the map, and the form; `None` if there is no map or no
/// form.
pub type CycleFigures<'a> =
    (Result<&'a DeviationFigures, &'a FormError>, Option<Result<&'a Slope, &'a FormError>>, Option<&'a Form>);

/// Writes all figures of a cycle (values such as PV and RMS) to the JSON file `path` (`figures.json`). `figures` holds
/// the figures of the measured points, `slope` the slopes of the error map, and `form` the form with its figures. If
/// one of them does not exist, the file states the reason.
///
/// `taken_out` names the terms, such as piston and tilt, that were removed before the figures were computed. The file
/// repeats these names for the figures. If `simulation` is true, the file is marked as simulated.
///
/// # Errors
/// A file that cannot be written.
pub fn write_figures(
    path: &Path,
    (figures, slope, form): CycleFigures<'_>,
    taken_out: &RemovedParts,
    simulation: bool,
) -> Result<(), FormatError> {
    let (mut rows, mut missing) = (Vec::new(), Vec::new());
    match figures {
        Ok(figures) => rows.extend(label_figures(figures, taken_out)),
        Err(reason) => missing.push(format!("figures of the points: {reason}")),
    }
    match slope {
        Some(Ok(slope)) => rows.extend(label_slope(slope, taken_out)),
        Some(Err(reason)) => missing.push(format!("slopes: {reason}")),
        None => missing.push("slopes: there is no map".to_owned()),
    }
    let found = figures.ok();
    match form {
        None => missing.push("figures of the form: form and noise cannot be separated".to_owned()),
        Some(Form { slope: None, .. }) => missing.push("slopes of the form: there are too few places".to_owned()),
        Some(_) => {}
    }
    let wavelength_nm = found.map_or(FormOptions::default().wavelength_nm, |found| found.iso_10110.wavelength_nm);
    let removed = taken_out.describe(found.map_or(&[], |f| &f.removed));
    let document = FiguresDocument {
        simulation,
        frame: "model",
        points: found.map(|f| f.points),
        form: form.map(|form| form_figure_rows(form, found, slope.and_then(Result::ok), taken_out)).unwrap_or_default(),
        form_iso_10110_5: form.and_then(|form| form.iso).map(|iso| notation(&iso, wavelength_nm)),
        figures: rows,
        iso_10110_5: found.map(|f| of_points(&removed, &f.iso_10110)),
        zernike: found.and_then(|f| f.zernike.as_ref()).map(|fit| of_points(&removed, series(fit))),
        legendre: found.and_then(|f| f.legendre.as_ref()).map(|fit| of_points(&removed, series(fit))),
        missing,
    };
    write_json_atomic(path, &document)
}

fn of_points<T>(removed: &str, what: T) -> OfPoints<T> {
    OfPoints { removed: removed.to_owned(), direction: DIRECTION, cut_off: NO_CUT_OFF, what }
}

fn series(fit: &PolynomialFit) -> SeriesDocument {
    let (normalisation, centre_mm, half_size_mm) = match fit.basis {
        PolynomialBasis::Zernike { centre_mm, radius_mm, .. } => {
            ("mean square 1 over the full disc", centre_mm, [radius_mm; 2])
        }
        PolynomialBasis::Legendre { centre_mm, half_mm } => {
            ("mean square 1 over the full rectangle", centre_mm, half_mm)
        }
    };
    let pairs = fit.coefficients_mm.iter().zip(&fit.orthogonal_mm).enumerate();
    let term = |(k, (coefficient, orthogonal)): (usize, (&f64, &f64))| TermDocument {
        term: fit.basis.term_name(k),
        coefficient_nm: 1e6 * coefficient,
        orthogonal_nm: 1e6 * orthogonal,
    };
    SeriesDocument {
        polynomials: fit.basis.name(),
        normalisation,
        centre_mm,
        half_size_mm,
        points: fit.points,
        residual_rms_nm: 1e6 * fit.residual_rms_mm,
        terms: pairs.map(term).collect(),
    }
}
