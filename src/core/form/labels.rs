//! Labels of figures: each number states the removed forms, its direction and its cut-off.

use serde::Serialize;

use super::figures::DeviationFigures;
use super::removed_forms::RemovedForm;
use super::slope::Slope;

/// Direction label of all figures.
pub const DIRECTION: &str = "along the outward normal of the nominal surface, positive where material stands proud";

/// Figure with its label.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LabelledFigure {
    /// Name of the figure.
    pub name: &'static str,
    /// Value of the figure.
    pub value: f64,
    /// Unit of the value.
    pub unit: &'static str,
    /// Motions and forms removed from the deviations before the figure was computed, in words.
    pub removed: String,
    /// Direction of the deviations, in words: [`DIRECTION`].
    pub direction: &'static str,
    /// Part removed by the filter, or a note that there was no filter.
    pub cut_off: String,
    /// Method of computation, if the name does not give it.
    #[serde(rename = "made")]
    pub method: String,
    /// Position on the part in the model frame, in mm; `None` if the figure does not belong to one place.
    #[serde(rename = "at_mm")]
    pub place_mm: Option<[f64; 2]>,
}

/// Motions and forms removed from the deviations before any figure is computed.
#[derive(Clone, Debug, PartialEq)]
pub struct RemovedParts {
    /// Motions removed by the registration, in words.
    pub motion: String,
    /// Part removed by the filter of the map, in words.
    pub filter: String,
}

impl RemovedParts {
    /// Returns a text for a label: the motions that the registration removed ([`RemovedParts::motion`]), then the names
    /// of the removed `forms`, separated by commas.
    pub fn describe(&self, forms: &[RemovedForm]) -> String {
        let words = std::iter::once(self.motion.as_str()).chain(forms.iter().map(|form| form.name()));
        words.collect::<Vec<_>>().join(", ")
    }
}

/// Cut-off label of figures that are computed from the points, without a filter.
pub const NO_CUT_OFF: &str = "none: every point used";

/// Converts the form figures of measured points into labelled figures for a report: PV, PVr, PV 99.8 %, RMS, mean,
/// highest and lowest point, and coverage. The ISO 10110-5 figures are not included.
///
/// `taken_out` states, in words, the motions that the registration removed from the deviations. Units: micrometres;
/// coverage in percent.
pub fn label_figures(figures: &DeviationFigures, taken_out: &RemovedParts) -> Vec<LabelledFigure> {
    let DeviationFigures { pvr, highest, lowest, coverage, .. } = figures;
    let removed = taken_out.describe(&figures.removed);
    let um = |name, mm: f64, made: &str| labelled_figure(name, 1e3 * mm, "um", &removed, NO_CUT_OFF, made);
    let of_fit = format!(
        "robust: PV of {} {} terms fitted to all points, {:.4} um, plus 3 times the rms of the residuals, {:.4} um",
        pvr.terms,
        pvr.basis,
        1e3 * pvr.fit_pv_mm,
        1e3 * pvr.residual_rms_mm
    );
    let cells = format!("share of the cells of {:.3} mm within the aperture that contain a point", coverage.cell_mm);
    vec![
        um("PV of the points", figures.pv_mm, "of all points: largest minus smallest"),
        um("PVr", pvr.value_mm, &of_fit),
        um(
            "PV 99.8 % of the points",
            figures.pv_998_mm,
            "of all points but the outermost 0.1 % at either end: largest minus smallest",
        ),
        um("RMS of the points", figures.rms_mm, "of all points, about zero"),
        um("mean", figures.mean_mm, "of all points"),
        LabelledFigure {
            place_mm: Some(highest.place_mm),
            ..um("highest (stock left)", highest.value_mm, "the highest point")
        },
        LabelledFigure {
            place_mm: Some(lowest.place_mm),
            ..um("lowest (undercut)", lowest.value_mm, "the lowest point")
        },
        labelled_figure("coverage", 100.0 * coverage.share, "%", "nothing", NO_CUT_OFF, &cells),
    ]
}

/// Converts the slopes of a map into two labelled figures for a report: the RMS slope and the largest slope, in
/// microradians.
///
/// `taken_out` states, in words, the motions that the registration removed and the part that the filter of the map
/// removed.
pub fn label_slope(slope: &Slope, taken_out: &RemovedParts) -> Vec<LabelledFigure> {
    let [x, y] = slope.integration_mm;
    let made = format!("from the map, over {x:.3} mm along x and {y:.3} mm along y, at {} nodes", slope.nodes);
    let urad = |name, rad: f64| labelled_figure(name, 1e6 * rad, "urad", &taken_out.motion, &taken_out.filter, &made);
    vec![urad("slope RMS", slope.rms_rad), urad("slope, largest", slope.max_rad)]
}

fn labelled_figure(
    name: &'static str,
    value: f64,
    unit: &'static str,
    removed: &str,
    cut_off: &str,
    made: &str,
) -> LabelledFigure {
    LabelledFigure {
        name,
        value,
        unit,
        removed: removed.to_owned(),
        direction: DIRECTION,
        cut_off: cut_off.to_owned(),
        method: made.to_owned(),
        place_mm: None,
    }
}
