//! Summary of a run for a list of runs, and the names of its maps.

use std::path::Path;

use super::ReportError;
use super::run_history::{AlarmHistory, CycleHistory, HoldOrder, RunHistory};
use super::words::{ending_words, home_words, recorded_name};
use regrind_cell::{ComparedFigure, Device, Ending, Tolerance, Verdict};
use regrind_journal::{Reader, Record};
use regrind_record::PassFigures;

/// Summary of the record of a run. The record is read but not verified; `regrind audit verify` and the report verify
/// it.
#[derive(Clone, Debug, Default)]
pub struct RunSummary {
    /// Name of the run.
    pub run: String,
    /// Serial number of the part.
    pub part: String,
    /// Name of the part.
    pub name: String,
    /// Name of the recipe.
    pub recipe: String,
    /// Operator who started the run.
    pub operator: String,
    /// Time of the start, RFC 3339 in UTC.
    pub began: String,
    /// Time of the end; `None` if the end is not on record.
    pub ended: Option<String>,
    /// True if any machine of the run is simulated.
    pub simulation: bool,
    /// True if the program that ran the run also simulated its machines, so that they ended with the program.
    pub machines_within: bool,
    /// Result of the run.
    pub result: RunResult,
    /// Result in words, for people.
    pub verdict: String,
    /// Tolerance that the figures are judged by.
    pub tolerance: Option<Tolerance>,
    /// Cycles about which something is on record.
    pub cycles: Vec<CycleSummary>,
    /// Alarms, in the order in which they were raised.
    pub alarms: Vec<AlarmHistory>,
    /// Time of the last record, RFC 3339 in UTC.
    pub last: String,
    /// Names that the measuring machine and the grinder reported; `None` for a machine that has not answered.
    pub machines: [Option<String>; 2],
    /// Radius of the wheel that the grinder reported last, in millimetres.
    pub wheel_radius_mm: Option<f64>,
    /// Last error of the probe's radius on the reference sphere, in micrometres.
    pub probe_off_um: Option<f64>,
    /// Cycle of the pass that was started last; `None` before the first pass.
    pub pass_cycle: Option<u32>,
    /// Order of a person that holds the cell; `None` if there is none, or if the cell was resumed since.
    pub hold: Option<HoldOrder>,
}

/// Result of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum RunResult {
    /// The run has no end on record.
    #[default]
    Open,
    /// The part is accepted.
    Accepted,
    /// The run is complete and the part is not accepted.
    NotAccepted,
    /// The run was stopped.
    Stopped,
    /// The run was aborted.
    Aborted,
    /// The run was a recovery: it brought machines home and made no part.
    Recovery,
}

impl RunResult {
    /// Returns the name of the result in files and in addresses of the page, such as "NotAccepted".
    pub fn name(self) -> &'static str {
        match self {
            Self::Open => "Open",
            Self::Accepted => "Accepted",
            Self::NotAccepted => "NotAccepted",
            Self::Stopped => "Stopped",
            Self::Aborted => "Aborted",
            Self::Recovery => "Recovery",
        }
    }
}

/// Summary of a cycle. Units: micrometres.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CycleSummary {
    /// Number of the cycle, from 1.
    pub cycle: u32,
    /// Verdict; `None` if the cycle was not judged.
    pub verdict: Option<Verdict>,
    /// Reason for the verdict.
    pub reason: String,
    /// PV and RMS, each with its expanded uncertainty, as they were judged; `None` if nothing was measured.
    pub figures: Option<[[f64; 2]; 2]>,
    /// PV and RMS, each with its interval, its limit and its conformity; `None` if nothing was measured, or if the tolerance
    /// is not on record. Unit: millimetres.
    pub judged: Option<[ComparedFigure; 2]>,
    /// Number of points used, and number of outliers; `None` if nothing was measured.
    pub points: Option<[u32; 2]>,
    /// Outliers that these figures do not include, with their positions and deviations; `None` if all points are
    /// included.
    pub left_out: Option<String>,
    /// PV and RMS that are expected after the correction made from this cycle; `None` if no correction was made.
    pub expected: Option<[f64; 2]>,
    /// Name of the error map within the run folder.
    pub map: Option<String>,
    /// Name of the file of points within the run folder.
    pub deviations: Option<String>,
    /// Figures of the pass, as the grinder reported them; `None` if they are not on record.
    pub pass: Option<PassFigures>,
    /// Error of the probe's radius on the reference sphere; `None` if it was not measured.
    pub radius_error_um: Option<f64>,
    /// Total duration of the jobs of each machine in seconds (CMM, grinder), by the times of their records; `None` if no
    /// job has a start and an end that one program recorded.
    pub job_s: [Option<f64>; 2],
}

impl CycleSummary {
    /// Returns the total duration of the measurements of the cycle, in seconds; `None` if it is not known.
    pub fn measurement_s(&self) -> Option<f64> {
        self.job_s[Device::Cmm as usize]
    }

    /// Returns the duration of the pass of the cycle, in seconds; `None` if it is not known.
    pub fn pass_s(&self) -> Option<f64> {
        self.job_s[Device::Grinder as usize]
    }
}

impl CycleSummary {
    /// Returns the verdict as it is recorded, in lower-case words such as "wrong response"; `None` if the cycle was not
    /// judged.
    pub fn recorded_verdict(&self) -> Option<String> {
        self.verdict.as_ref().map(recorded_name)
    }
}

/// Reads the record in the run folder `folder`, without verifying it, and returns its summary for a list of runs.
///
/// # Errors
/// Fails if the folder contains no record of a run, or if the record cannot be read.
pub fn run_summary(folder: &Path) -> Result<RunSummary, ReportError> {
    let mut story = RunHistory::default();
    for record in Reader::open(folder)?.records(0) {
        story.add_record(record?);
    }
    Ok(summary(&story))
}

fn summary(story: &RunHistory) -> RunSummary {
    let start = &story.start;
    let [name, recipe, _] = start.content.names().map(|text| text.unwrap_or_default().to_owned());
    let of_begin = |field: fn(&Record) -> &String| story.begin.as_ref().map(field).cloned().unwrap_or_default();
    let (result, verdict) = match (&story.ending, story.home) {
        (Some(ending), _) => (result_of(ending), ending_words(ending)),
        (None, Some(home)) => (RunResult::Recovery, home_words(home)),
        (None, None) => (RunResult::Open, String::new()),
    };
    let tolerance = story.tolerance();
    RunSummary {
        run: start.run.clone().unwrap_or_default(),
        part: of_begin(|begin| &begin.part),
        name,
        recipe: Path::new(&recipe).file_stem().map_or(recipe.clone(), |stem| stem.to_string_lossy().into_owned()),
        operator: of_begin(|begin| &begin.actor),
        began: of_begin(|begin| &begin.utc),
        ended: story.end.as_ref().map(|end| end.utc.clone()),
        simulation: start.simulation == Some(true),
        machines_within: start.content.part().is_some_and(|part| part.machines_within == Some(true)),
        result,
        verdict,
        cycles: story.cycles.iter().map(|(number, cycle)| cycle_summary(*number, cycle, tolerance.as_ref())).collect(),
        tolerance,
        alarms: story.alarms.clone(),
        last: story.last.clone(),
        machines: story.machines.clone().map(|machine| machine.map(|[name, _]| name)),
        wheel_radius_mm: story.wheel_radius_mm,
        probe_off_um: story.radius_error_mm.map(|(_, mm)| 1e3 * mm),
        pass_cycle: story.pass.map(|pass| pass.cycle),
        hold: story.hold_order(),
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

fn cycle_summary(cycle: u32, story: &CycleHistory, tolerance: Option<&Tolerance>) -> CycleSummary {
    let last = story.measurements.last();
    let judgement = last.and_then(|of| of.judgements.last());
    let unusable = || last.and_then(|of| of.unusable.clone()).unwrap_or_default();
    let found = last.and_then(|of| of.figures.as_ref());
    let figures = found.map(|figures| {
        let points = [[figures.pv_mm, figures.pv_expanded_mm], [figures.rms_mm, figures.rms_expanded_mm]];
        let of = |tolerance: &Tolerance| tolerance.compare(figures).map(|of| [of.median_mm, of.expanded_mm]);
        tolerance.map_or(points, of).map(|figure| figure.map(|mm| 1e3 * mm))
    });
    CycleSummary {
        cycle,
        verdict: judgement.map(|judgement| judgement.verdict),
        reason: judgement.map_or_else(unusable, |judgement| judgement.reason.clone()),
        figures,
        judged: found.zip(tolerance).map(|(figures, tolerance)| tolerance.compare(figures)),
        points: found.map(|figures| [figures.points, figures.outliers]),
        left_out: found.and_then(|figures| figures.with_outliers.as_ref()).map(|of| of.description.clone()),
        expected: story.expected_mm.map(|figures| figures.map(|mm| 1e3 * mm)),
        map: story.map.as_ref().map(|(name, _)| name.clone()),
        deviations: story.deviations.clone(),
        pass: story.pass,
        radius_error_um: story.radius_error_mm.map(|mm| 1e3 * mm),
        job_s: story.job_s,
    }
}
