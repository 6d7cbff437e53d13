//! Results of a run for other quality systems: who measured which part and when, each judged figure with its limit and
//! uncertainty, and the verdict. Both formats are written from this data alone, so they cannot disagree.

use std::path::Path;

use regrind_cell::{Conformity, Ending, Figures, Tolerance, Verdict};
use regrind_journal::Record;

use super::ReportError;
use super::form::read_figures;
use super::run_history::{CycleHistory, Measurement, RunHistory};
use super::words::{ending_words, verdict_words};

/// Content of a file of results. Texts are the same as in the record. Times are RFC 3339 in UTC.
pub(super) struct Results {
    pub(super) run: String,
    pub(super) part: String,
    pub(super) name: String,
    /// Name of the recipe and the hash of its bytes.
    pub(super) recipe: [String; 2],
    /// Name of the cell and the hash of the bytes of its file.
    pub(super) cell: [String; 2],
    pub(super) operator: String,
    pub(super) station: String,
    pub(super) began: String,
    pub(super) ended: Option<String>,
    pub(super) software: String,
    pub(super) simulation: bool,
    pub(super) accepted: Option<bool>,
    pub(super) verdict: String,
    pub(super) decision_rule: Option<String>,
    /// Name and address of the measuring machine, as it reported them.
    pub(super) cmm: Option<[String; 2]>,
    /// Measurements of all cycles, in their order.
    pub(super) measured: Vec<Measured>,
    /// Hash of the last record.
    pub(super) head: String,
}

/// Measurement of the part.
pub(super) struct Measured {
    pub(super) cycle: u32,
    pub(super) utc: String,
    /// Figures; empty if the measurement is not usable.
    pub(super) figures: Vec<Figure>,
    pub(super) standing: LimitStatus,
    pub(super) verdict: String,
    pub(super) reason: String,
    /// Number of points used, and number of outliers.
    pub(super) points: Option<[u32; 2]>,
    pub(super) coverage: Option<f64>,
}

/// Figure of a measurement. Units: millimetres.
pub(super) struct Figure {
    pub(super) kind: Kind,
    pub(super) found_mm: f64,
    /// Expanded uncertainty, k = 2.
    pub(super) expanded_mm: f64,
    pub(super) standing: LimitStatus,
}

/// Kind of a figure: its name, its meaning and its limit.
pub(super) struct Kind {
    pub(super) name: &'static str,
    pub(super) what: &'static str,
    /// Limit; `None` if the figure has no limit.
    pub(super) limit_mm: Option<f64>,
}

/// Result of the comparison of a figure, or of all figures of a measurement, with its limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LimitStatus {
    Within,
    Undecided,
    Beyond,
    /// Not judged: there is no limit, or the run ended before the judgement.
    NotJudged,
}

impl Results {
    pub(super) fn from_history(story: &RunHistory, head: String) -> Self {
        let start = &story.start;
        let text = |text: &Option<String>| text.clone().unwrap_or_default();
        let [name, recipe, cell] = start.content.names();
        let part = start.content.part().cloned().unwrap_or_default();
        let of_begin = |field: fn(&Record) -> &String| story.begin.as_ref().map(field).cloned().unwrap_or_default();
        let tolerance = story.tolerance();
        let all = |(cycle, of): (&u32, &CycleHistory)| {
            let measured = |one: &Measurement| Measured::new(*cycle, one, tolerance.as_ref());
            of.measurements.iter().map(measured).collect::<Vec<_>>()
        };
        Self {
            run: text(&start.run),
            part: of_begin(|begin| &begin.part),
            name: name.unwrap_or_default().to_owned(),
            recipe: [recipe.unwrap_or_default().to_owned(), text(&part.recipe_sha256)],
            cell: [cell.unwrap_or_default().to_owned(), text(&part.cell_sha256)],
            operator: of_begin(|begin| &begin.actor),
            station: of_begin(|begin| &begin.station),
            began: of_begin(|begin| &begin.utc),
            ended: story.end.as_ref().map(|end| end.utc.clone()),
            software: text(&start.regrind),
            simulation: start.simulation == Some(true),
            accepted: story.ending.as_ref().map(|ending| matches!(ending, Ending::Accepted { .. })),
            verdict: story.ending.as_ref().map_or("The run has not ended.".to_owned(), ending_words),
            decision_rule: tolerance.as_ref().map(decision_rule),
            cmm: story.machines[regrind_cell::Device::Cmm as usize].clone(),
            measured: story.cycles.iter().flat_map(all).collect(),
            head,
        }
    }

    /// Returns the kinds of the figures (name, meaning and limit of each) that the file of results lists. These are the
    /// figures of the measurement that has the most figures, in the order of that measurement. The iterator is empty if
    /// there is no measurement.
    pub(super) fn kinds(&self) -> impl Iterator<Item = &Kind> {
        let most = self.measured.iter().max_by_key(|of| of.figures.len());
        most.into_iter().flat_map(|of| &of.figures).map(|figure| &figure.kind)
    }

    /// Adds the six figures of ISO 10110-5 (A, B, C, RMSt, RMSi and RMSa) to the last measurement of each cycle that
    /// has figures. Reads the six figures from the file `figures.json` of the cycle. `folder` is the run folder, and
    /// `story` is the history of the run, which contains the file names. Adds nothing to a cycle without this file, or
    /// if the file does not contain all six figures.
    ///
    /// # Errors
    /// Fails if a file `figures.json` that the history names cannot be read or is not JSON.
    pub(super) fn with_areas(mut self, story: &RunHistory, folder: &Path) -> Result<Self, ReportError> {
        for (cycle, of) in &story.cycles {
            let Some(name) = &of.form else { continue };
            let told = read_figures(&folder.join(name))?;
            let last = self.measured.iter_mut().rev().find(|one| one.cycle == *cycle && !one.figures.is_empty());
            if let Some(last) = last {
                last.figures.extend(areas(&told).unwrap_or_default());
            }
        }
        Ok(self)
    }
}

impl Measured {
    fn new(cycle: u32, of: &Measurement, tolerance: Option<&Tolerance>) -> Self {
        let judgement = of.judgements.last();
        let figures = of.figures.as_ref().map(|figures| figures_of(figures, tolerance, judgement.is_some()));
        let mut figures = figures.unwrap_or_default();
        if judgement.is_some_and(|last| last.verdict == Verdict::LeftOut) {
            // The result is undecided until those places are measured again.
            let within = figures.iter_mut().filter(|figure| figure.standing == LimitStatus::Within);
            within.for_each(|figure| figure.standing = LimitStatus::Undecided);
        }
        Self {
            cycle,
            utc: of.utc.clone(),
            standing: standing_of_all(&figures),
            figures,
            verdict: judgement.map(verdict_words).unwrap_or_default(),
            reason: judgement.map_or_else(|| of.unusable.clone().unwrap_or_default(), |last| last.reason.clone()),
            points: of.figures.as_ref().map(|figures| [figures.points, figures.outliers]),
            coverage: of.figures.as_ref().map(|figures| figures.coverage),
        }
    }
}

fn decision_rule(tolerance: &Tolerance) -> String {
    if tolerance.with_uncertainty {
        format!(
            "ISO 14253-1, JCGM 106: a figure is within its limit if the probability that the figure does not \
             exceed the limit is at least {:.1} %",
            1e2 * tolerance.probability
        )
    } else {
        "the figure is compared with its limit; the uncertainty of the figure is ignored".to_owned()
    }
}

/// Returns the figures of a measurement for the file of results.
///
/// With a `tolerance`, the list begins with the PV and the RMS that the decision rule compares with the limits. Each of
/// these two figures has its limit, if the tolerance contains one. Then follows the peak to valley (PV) of the measured
/// points, without a limit and for information only. This last figure is omitted if the first PV already is the PV of
/// all measured points.
///
/// Without a `tolerance`, the list contains the PV and the RMS of the measured points, without limits.
///
/// `judged` is true if the cell judged the measurement. If `judged` is false, the status of each figure is
/// [`LimitStatus::NotJudged`]. A figure without a limit always has this status.
fn figures_of(figures: &Figures, tolerance: Option<&Tolerance>, judged: bool) -> Vec<Figure> {
    let compared = tolerance.map(|tolerance| tolerance.compare(figures));
    // The form is judged. The figure of the points, which contains the noise of the probe, is added for information.
    let of_form = figures.form.is_some();
    let all_points = Figure {
        kind: Kind { name: if of_form { "PV as measured" } else { "PV" }, what: PV, limit_mm: None },
        found_mm: figures.pv_mm,
        expanded_mm: figures.pv_expanded_mm,
        standing: LimitStatus::NotJudged,
    };
    let Some(compared) = compared else {
        let kind = Kind { name: "RMS", what: RMS, limit_mm: None };
        let (found_mm, expanded_mm) = (figures.rms_mm, figures.rms_expanded_mm);
        return vec![all_points, Figure { kind, found_mm, expanded_mm, standing: LimitStatus::NotJudged }];
    };
    let of_all = !of_form && compared[0].name == "PV";
    let mut list: Vec<Figure> = compared
        .into_iter()
        .map(|compared| {
            let limit_mm = Some(compared.limit_mm).filter(|limit| limit.is_finite());
            let standing = match compared.conformity {
                _ if !judged || limit_mm.is_none() => LimitStatus::NotJudged,
                Conformity::Within => LimitStatus::Within,
                Conformity::Undecided => LimitStatus::Undecided,
                Conformity::Beyond => LimitStatus::Beyond,
            };
            Figure {
                kind: Kind { name: compared.name, what: what_of(compared.name, of_form), limit_mm },
                found_mm: compared.median_mm,
                expanded_mm: compared.expanded_mm,
                standing,
            }
        })
        .collect();
    if !of_all {
        list.push(all_points);
    }
    list
}

const PV: &str = "largest deviation minus smallest deviation of all points from the nominal surface, along the normal of the nominal surface";
const RMS: &str = "root mean square of the deviations of the points from the nominal surface, along the normal of the nominal surface";

const FORM_PV: &str = "largest deviation minus smallest deviation of the form from the nominal surface, along the normal of the nominal \
                       surface, after the best fit of the form, without the noise of the probe";
const FORM_PV_998: &str = "largest deviation minus smallest deviation of the form from the nominal surface, along the normal of the nominal \
                         surface, after the best fit of the form, without the noise of the probe; over the aperture (the measured points and the \
                         positions between the points); the lowest 0.1 % and the highest 0.1 % are left out, but never a measured point";
const FORM_RMS: &str = "root mean square of the deviations of the form from the nominal surface, along the normal of the nominal surface, \
                        after the best fit of the form, without the noise of the probe";
const PV_998: &str = "largest deviation minus smallest deviation along the normal of the surface, without the lowest 0.1 % \
                      and the highest 0.1 % of the deviations";

fn what_of(name: &str, of_form: bool) -> &'static str {
    match (name, of_form) {
        ("RMS", false) => RMS,
        ("RMS", true) => FORM_RMS,
        ("PV", false) => PV,
        ("PV", true) => FORM_PV,
        (_, false) => PV_998,
        (_, true) => FORM_PV_998,
    }
}

/// Lengths of ISO 10110-5, with their names in `figures.json`.
const AREAS: [(&str, &str, &str); 6] = [
    ("power", "ISO 10110-5 A", "peak to valley of the sphere that fits the form best"),
    ("irregularity", "ISO 10110-5 B", "peak to valley of the form without piston, tilt and power"),
    (
        "symmetric irregularity",
        "ISO 10110-5 C",
        "peak to valley of the rotationally symmetric component of the irregularity (symmetric about the centre)",
    ),
    ("RMSt", "ISO 10110-5 RMSt", "root mean square of the form without piston and tilt"),
    ("RMSi", "ISO 10110-5 RMSi", "root mean square of the form without piston, tilt and power"),
    (
        "RMSa",
        "ISO 10110-5 RMSa",
        "root mean square of the component of the irregularity that is not rotationally symmetric about the centre",
    ),
];

/// Returns the six figures of ISO 10110-5 (A, B, C, RMSt, RMSi and RMSa) in millimetres, each with its expanded
/// uncertainty and without a limit. `told` is the JSON content of `figures.json`, which gives each figure in nanometres
/// with its median and its 95 % credible interval. The expanded uncertainty is half the width of this interval. Returns
/// `None` if one of the six figures, or one of its numbers, is missing.
fn areas(told: &serde_json::Value) -> Option<Vec<Figure>> {
    const MM_OF_NM: f64 = 1e-6;
    let rows = told["form"].as_array()?;
    let figure = |(named, name, what): (&str, &'static str, &'static str)| {
        let row = rows.iter().find(|row| row["name"] == named && row["unit"] == "nm")?;
        let [median, low, high] = ["median", "low", "high"].map(|key| row[key].as_f64());
        Some(Figure {
            kind: Kind { name, what, limit_mm: None },
            found_mm: MM_OF_NM * median?,
            expanded_mm: MM_OF_NM * 0.5 * (high? - low?),
            standing: LimitStatus::NotJudged,
        })
    };
    AREAS.into_iter().map(figure).collect()
}

/// Returns the status of a measurement: [`LimitStatus::Beyond`] if any figure is beyond its limit, otherwise
/// [`LimitStatus::Undecided`] if any is undecided, otherwise [`LimitStatus::Within`] if any is within its limit,
/// otherwise [`LimitStatus::NotJudged`].
fn standing_of_all(figures: &[Figure]) -> LimitStatus {
    let any = |standing| figures.iter().any(|figure| figure.standing == standing);
    [LimitStatus::Beyond, LimitStatus::Undecided, LimitStatus::Within]
        .into_iter()
        .find(|one| any(*one))
        .unwrap_or(LimitStatus::NotJudged)
}
