//! What a list of runs shows of each, and where its maps are.

use std::path::Path;

use super::ReportError;
use super::story::{AlarmStory, CycleStory, Story};
use super::words::{ending_words, home_words, verdict_words};
use regrind_cell::{Ending, Tolerance};
use regrind_journal::{Reader, Record};

/// What the record of a run tells at a glance. It is read and not proven: `regrind audit verify` does that, and so does the report.
#[derive(Clone, Debug, Default)]
pub struct RunSummary {
    /// What the run is called.
    pub run: String,
    /// The serial number of the part.
    pub part: String,
    /// What the part is.
    pub name: String,
    /// Name of the recipe.
    pub recipe: String,
    /// Who began it.
    pub operator: String,
    /// When it began, RFC 3339 in UTC.
    pub began: String,
    /// When it ended; none where that is not on record.
    pub ended: Option<String>,
    /// Whether any machine of it is simulated.
    pub simulation: bool,
    /// Whether its machines were simulated by the program that ran it, and ended with that.
    pub machines_within: bool,
    /// How it ended.
    pub result: RunResult,
    /// The same for people.
    pub verdict: String,
    /// What its figures are judged by.
    pub tolerance: Option<Tolerance>,
    /// Each cycle of which something is known.
    pub cycles: Vec<CycleSummary>,
    /// The alarms that were raised, in that order.
    pub alarms: Vec<AlarmStory>,
    /// When the last record was written, RFC 3339 in UTC.
    pub last: String,
    /// What each machine called itself: the measuring machine, the grinder; none where it has not answered.
    pub machines: [Option<String>; 2],
    /// The radius of the wheel as the grinder told it last, in millimetres.
    pub wheel_radius_mm: Option<f64>,
    /// By how much the probe's radius was off on the reference sphere last, in micrometres.
    pub probe_off_um: Option<f64>,
}

/// How a run ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum RunResult {
    /// It has no end on record.
    #[default]
    Open,
    /// The part is accepted.
    Accepted,
    /// It came to its end, and the part is not accepted.
    NotAccepted,
    /// It was stopped.
    Stopped,
    /// It was aborted.
    Aborted,
    /// It brought machines home, and made no part.
    Recovery,
}

/// What is known of a cycle. Units: micrometres.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CycleSummary {
    /// Its number, from 1.
    pub cycle: u32,
    /// How it was judged; none where it was not.
    pub verdict: Option<String>,
    /// Why.
    pub reason: String,
    /// PV, RMS and the expanded uncertainty of each, as they were judged; none where nothing was measured.
    pub figures: Option<[[f64; 2]; 2]>,
    /// The points that were left out of these, where they are and by how much; none where all count.
    pub left_out: Option<String>,
    /// PV and RMS that the correction made from it is expected to leave; none where none was made.
    pub expected: Option<[f64; 2]>,
    /// Name of its error map within the run folder.
    pub map: Option<String>,
    /// Name of its points within the run folder.
    pub deviations: Option<String>,
}

/// Reads what a list shows of a run.
///
/// # Errors
/// No record of a run, and one that cannot be read.
pub fn run_summary(folder: &Path) -> Result<RunSummary, ReportError> {
    let mut story = Story::default();
    for record in Reader::open(folder)?.records(0) {
        story.take(record?);
    }
    Ok(summary(&story))
}

fn summary(story: &Story) -> RunSummary {
    let begin = story.begin.as_ref().map(Record::value).unwrap_or_default();
    let text = |value: &serde_json::Value| value.as_str().unwrap_or_default().to_owned();
    let of_begin = |field: fn(&Record) -> &String| story.begin.as_ref().map(field).cloned().unwrap_or_default();
    let (result, verdict) = match (&story.ending, story.home) {
        (Some(ending), _) => (result_of(ending), ending_words(ending)),
        (None, Some(home)) => (RunResult::Recovery, home_words(home)),
        (None, None) => (RunResult::Open, String::new()),
    };
    let tolerance = story.tolerance();
    let recipe = text(&begin["content"]["recipe"]);
    RunSummary {
        run: text(&begin["run"]),
        part: of_begin(|begin| &begin.part),
        name: text(&begin["content"]["part_name"]),
        recipe: Path::new(&recipe).file_stem().map_or(recipe.clone(), |stem| stem.to_string_lossy().into_owned()),
        operator: of_begin(|begin| &begin.actor),
        began: of_begin(|begin| &begin.utc),
        ended: story.end.as_ref().map(|end| end.utc.clone()),
        simulation: begin["simulation"] == true,
        machines_within: begin["content"]["machines_within"] == true,
        result,
        verdict,
        cycles: story.cycles.iter().map(|(number, cycle)| cycle_summary(*number, cycle, tolerance.as_ref())).collect(),
        tolerance,
        alarms: story.alarms.clone(),
        last: story.last.clone(),
        machines: story.machines.clone().map(|machine| machine.map(|[name, _]| name)),
        wheel_radius_mm: story.wheel_radius_mm,
        probe_off_um: story.radius_error_mm.map(|(_, mm)| 1e3 * mm),
    }
}

fn result_of(ending: &Ending) -> RunResult {
    match ending {
        Ending::Accepted { .. } => RunResult::Accepted,
        Ending::NotAccepted { .. } => RunResult::NotAccepted,
        Ending::Stopped { .. } => RunResult::Stopped,
        Ending::Aborted { .. } => RunResult::Aborted,
    }
}

fn cycle_summary(cycle: u32, story: &CycleStory, tolerance: Option<&Tolerance>) -> CycleSummary {
    let last = story.measurements.last();
    let judgement = last.and_then(|of| of.judgements.last());
    let unusable = || last.and_then(|of| of.unusable.clone()).unwrap_or_default();
    let figures = last.and_then(|of| of.figures.as_ref()).map(|figures| {
        let points = [[figures.pv_mm, figures.pv_expanded_mm], [figures.rms_mm, figures.rms_expanded_mm]];
        let of = |tolerance: &Tolerance| tolerance.compare(figures).map(|of| [of.found_mm, of.expanded_mm]);
        tolerance.map_or(points, of).map(|figure| figure.map(|mm| 1e3 * mm))
    });
    CycleSummary {
        cycle,
        verdict: judgement.map(verdict_words),
        reason: judgement.map_or_else(unusable, |judgement| judgement.reason.clone()),
        figures,
        left_out: last.and_then(|of| of.figures.as_ref()?.left_out.as_ref()).map(|of| of.places.clone()),
        expected: story.expected_mm.map(|figures| figures.map(|mm| 1e3 * mm)),
        map: story.map.as_ref().map(|(name, _)| name.clone()),
        deviations: story.deviations.clone(),
    }
}
