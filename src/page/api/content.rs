//! Content of the answers for programs. Their JSON schemas are made from these types. Units are last in the names. A number
//! that is not known is null, never NaN.

use regrind_cell::{Alarm, AlarmId, ComparedFigure, Conformity, Device, PvPoints, Role, StateName, Tolerance};
use regrind_control::{JobProgress, Snapshot};
use regrind_report::{AlarmHistory, CycleSummary, RecordEntry, RunResult, RunSummary};
use schemars::JsonSchema;
use serde::Serialize;
use serde_json::Value;

use crate::history::Listed;
use crate::live::ObservedRun;

/// The cell now.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct CellNow {
    /// State of the cell, by its PackML name: that of its active run, and Idle if its last run has ended or there is no run.
    /// Null if the state is not known: several runs are active, or the program of the last run is gone without an end on
    /// record.
    pub(super) state: Option<StateName>,
    /// Names of the active runs. A cell has at most one; more belong to several cells that share a folder of runs.
    pub(super) active_runs: Vec<String>,
    /// State of the active run; null if none or several are active.
    pub(super) run: Option<RunState>,
    /// Run that began last; null if there is none.
    pub(super) last_run: Option<RunItem>,
}

/// State of a run.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub(super) struct RunState {
    /// Name of the run.
    pub(super) run: String,
    /// True if the program of the run answers.
    is_active: bool,
    /// State, by its PackML name. Null if it is not known: the program of the run is gone without an end on record, or the
    /// run brought machines home.
    state: Option<StateName>,
    /// Phase of the cycle in which the cell is or will continue, such as Grind; null in a state without a phase.
    phase: Option<&'static str>,
    /// Step of the machine's job in this phase, such as Run.
    step: Option<String>,
    /// Number of the state since the run began; null if the program of the run does not answer.
    state_number: Option<u64>,
    /// True if any machine of the run is simulated.
    simulation: bool,
    /// Serial number of the part; empty if it is not known.
    part: String,
    /// Name of the part.
    name: String,
    /// Name of the recipe.
    recipe: String,
    /// Person who started the run.
    operator: String,
    /// Result of the run.
    result: Outcome,
    /// Number of the cycle; 0 before the first.
    cycle: u32,
    /// Maximum number of the cycle; null if the program of the run does not answer.
    max_cycles: Option<u32>,
    /// Time since the run began; null if the program of the run does not answer.
    elapsed_s: Option<f64>,
    /// Progress of the current job; null if none runs.
    progress: Option<Progress>,
    /// Machines that have not confirmed that they are at rest, in a state in which the cell is considered to be at rest.
    unconfirmed: Vec<Device>,
    /// Active alarms.
    alarms: Vec<ActiveAlarm>,
    /// Items that a machine waits for, in words.
    waits_for: Vec<String>,
    /// Next step of a person, in words; empty if the program of the run does not answer.
    next_step: String,
    /// Figures of the last measurement; null before the first.
    figures: Option<CycleFigures>,
}

/// Progress of a job.
#[derive(Clone, Debug, Serialize, JsonSchema)]
struct Progress {
    /// Machine that performs the job.
    machine: Device,
    /// Completed points of a measurement, or parts of the path of a pass.
    done: u32,
    /// Total number of points or parts.
    total: u32,
    /// Minimum remaining time; null before a pace is known.
    remaining_min_s: Option<f64>,
    /// Maximum remaining time; null before a pace is known.
    remaining_max_s: Option<f64>,
}

/// Alarm that a person must see.
#[derive(Clone, Debug, Serialize, JsonSchema)]
struct ActiveAlarm {
    /// Kind of the alarm.
    code: AlarmId,
    /// Event, with the values of this case.
    event: String,
    /// Consequence of the event.
    consequence: String,
    /// Steps to take, in this order.
    remedy: Vec<String>,
    /// Role that may clear the alarm.
    cleared_by: Role,
}

/// Result of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub(super) enum Outcome {
    /// The run has no end on record.
    Open,
    /// The part is accepted.
    Accepted,
    /// The run is complete and the part is not accepted.
    NotAccepted,
    /// The run was stopped.
    Stopped,
    /// The run was aborted.
    Aborted,
    /// The run brought machines home and made no part.
    Recovery,
}

impl Outcome {
    /// Names of the results in JSON, in the order of their definition.
    pub(super) const NAMES: [&'static str; 6] = ["open", "accepted", "not_accepted", "stopped", "aborted", "recovery"];

    /// Returns the name of the result in JSON.
    pub(super) fn name(self) -> &'static str {
        Self::NAMES[self as usize]
    }
}

impl From<RunResult> for Outcome {
    fn from(result: RunResult) -> Self {
        match result {
            RunResult::Open => Self::Open,
            RunResult::Accepted => Self::Accepted,
            RunResult::NotAccepted => Self::NotAccepted,
            RunResult::Stopped => Self::Stopped,
            RunResult::Aborted => Self::Aborted,
            RunResult::Recovery => Self::Recovery,
        }
    }
}

/// Page of the list of runs, from the newest to the oldest.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct RunsPage {
    /// Runs of this page.
    pub(super) runs: Vec<RunItem>,
    /// Value of the parameter `cursor` for the next page; null after the last run.
    pub(super) next_cursor: Option<String>,
    /// Names of the runs whose record cannot be read, in all pages.
    pub(super) unreadable: Vec<String>,
}

/// Run in a list.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct RunItem {
    /// Name of the run.
    run: String,
    /// True if a program drives the run.
    is_active: bool,
    /// Serial number of the part; empty if it is not known.
    part: String,
    /// Name of the part.
    name: String,
    /// Name of the recipe.
    recipe: String,
    /// Person who started the run.
    operator: String,
    /// Start of the run, RFC 3339 in UTC; empty if it is not on record.
    began: String,
    /// End of the run, RFC 3339 in UTC; null if it is not on record.
    ended: Option<String>,
    /// True if any machine of the run is simulated.
    simulation: bool,
    /// Result of the run.
    result: Outcome,
    /// Number of the cycles about which something is on record.
    cycles: usize,
    /// Number of alarms.
    alarms: usize,
    /// PV of the last measurement, as it was judged; null before the first.
    pv_um: Option<f64>,
    /// RMS of the last measurement, as it was judged; null before the first.
    rms_um: Option<f64>,
}

/// Run with its limits, its machines and its alarms.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct RunDetail {
    /// Run, as in the list of runs.
    #[serde(flatten)]
    item: RunItem,
    /// State of the run.
    state: RunState,
    /// Result in words; empty as long as the run is open.
    verdict: String,
    /// Limits of the figures; null if they are not on record.
    tolerance: Option<Limits>,
    /// Name that the measuring machine reported; null if it has not answered.
    cmm: Option<String>,
    /// Name that the grinder reported; null if it has not answered.
    grinder: Option<String>,
    /// Radius of the wheel that the grinder reported last.
    wheel_radius_mm: Option<f64>,
    /// Last error of the probe's radius on the reference sphere.
    probe_radius_error_um: Option<f64>,
    /// Alarms of the run, in the order in which they were raised.
    alarm_history: Vec<PastAlarm>,
    /// Time of the last record, RFC 3339 in UTC.
    last_record: String,
}

/// Limits of the figures.
#[derive(Debug, Serialize, JsonSchema)]
struct Limits {
    /// Largest accepted PV; null if it is not limited.
    pv_limit_um: Option<f64>,
    /// Largest accepted RMS; null if it is not limited.
    rms_limit_um: Option<f64>,
    /// Points from which the PV is taken.
    pv_points: PvPoints,
    /// True if the uncertainty of a figure counts in its judgement.
    with_uncertainty: bool,
    /// Probability with which a figure must be within its limit to be accepted.
    probability: f64,
}

/// Alarm in the record.
#[derive(Debug, Serialize, JsonSchema)]
struct PastAlarm {
    #[serde(flatten)]
    alarm: ActiveAlarm,
    /// Time at which the alarm was raised, RFC 3339 in UTC.
    raised: String,
    /// Time at which it was withdrawn, RFC 3339 in UTC; null if it was active until the end of the record.
    withdrawn: Option<String>,
    /// Person who has seen the alarm; null if nobody said so.
    acknowledged_by: Option<String>,
}

/// Figures of all cycles of a run.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct RunFigures {
    /// Name of the run.
    pub(super) run: String,
    /// True if any machine of the run is simulated.
    pub(super) simulation: bool,
    /// Cycles, in their order.
    pub(super) cycles: Vec<CycleFigures>,
}

/// Figures of a cycle.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub(super) struct CycleFigures {
    /// Number of the cycle, from 1.
    cycle: u32,
    /// Verdict, in lower-case words such as `wrong response`; null if the cycle was not judged.
    verdict: Option<String>,
    /// Reason for the verdict, or the reason why the measurement cannot be used.
    reason: String,
    /// Peak to valley, as it is judged; null if nothing was measured, or if the limits are not on record.
    pv: Option<Figure>,
    /// Root mean square, as it is judged; null if nothing was measured, or if the limits are not on record.
    rms: Option<Figure>,
    /// Number of points used; null if nothing was measured.
    points: Option<u32>,
    /// Number of outliers, which the figures do not include; null if nothing was measured.
    outliers: Option<u32>,
    /// PV that is expected after the correction made from this cycle; null if no correction was made.
    expected_pv_um: Option<f64>,
    /// RMS that is expected after the correction made from this cycle; null if no correction was made.
    expected_rms_um: Option<f64>,
    /// Duration of the pass; null if it is not on record.
    pass_duration_s: Option<f64>,
    /// Duration of the measurement; null if it is not on record.
    measurement_duration_s: Option<f64>,
    /// Volume that the pass removed, as the grinder reported it; null if it did not.
    removed_mm3: Option<f64>,
    /// Largest depth that the pass removed, as the grinder reported it; null if it did not.
    max_depth_um: Option<f64>,
    /// Radius of the wheel in the pass, as the grinder reported it; null if it did not.
    wheel_radius_mm: Option<f64>,
    /// Error of the probe's radius on the reference sphere; null if it was not measured.
    probe_radius_error_um: Option<f64>,
    /// True if there is an error map of the cycle.
    has_map: bool,
}

/// Figure with its 95 % credible interval, its limit and its conformity.
#[derive(Clone, Debug, Serialize, JsonSchema)]
struct Figure {
    /// Name of the figure, such as `PV 99.8 %`.
    name: &'static str,
    /// Median.
    median_um: f64,
    /// Lower end of the 95 % credible interval; 0 if only an upper bound of the figure is known.
    low_um: f64,
    /// Upper end of the 95 % credible interval.
    high_um: f64,
    /// Expanded measuring uncertainty (k = 2): half of the width of the interval.
    expanded_um: f64,
    /// Largest accepted value; null if the figure is not limited.
    limit_um: Option<f64>,
    /// Probability that the figure is within its limit, from 0.001 to 0.999; null if the figure is not limited.
    probability_in_tolerance: Option<f64>,
    /// Conformity with the limit.
    conformity: Standing,
}

/// Conformity of a figure with its limit (ISO 14253-1): proven within the limit, proven beyond the limit, or neither.
#[derive(Clone, Copy, Debug, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
enum Standing {
    /// Within the limit, for certain.
    Within,
    /// The limit lies within the uncertainty of the figure: nothing is proven.
    Undecided,
    /// Beyond the limit, for certain.
    Beyond,
}

/// Maps of a run.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct RunMaps {
    /// Name of the run.
    pub(super) run: String,
    /// Maps, in the order of the cycles.
    pub(super) maps: Vec<MapLinks>,
}

/// Map of a cycle, and its files.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct MapLinks {
    /// Number of the cycle.
    pub(super) cycle: u32,
    /// Address of the map as JSON.
    pub(super) href: String,
    /// Files of the map that exist now.
    pub(super) files: Vec<FileLink>,
}

/// File of a cycle.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct FileLink {
    /// Name of the file.
    pub(super) name: &'static str,
    /// Media type of the file.
    pub(super) media_type: &'static str,
    /// Length of the file, in bytes.
    pub(super) bytes: u64,
    /// Address of the file.
    pub(super) href: String,
}

/// Error map of a cycle on a regular grid over x and y of the model frame.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct MapGrid {
    /// Name of the run.
    pub(super) run: String,
    /// Number of the cycle.
    pub(super) cycle: u32,
    /// True if any machine of the run is simulated.
    pub(super) simulation: bool,
    /// Number of columns, along x.
    pub(super) columns: usize,
    /// Number of rows, along y.
    pub(super) rows: usize,
    /// Position of the first column.
    pub(super) first_x_mm: f64,
    /// Position of the first row.
    pub(super) first_y_mm: f64,
    /// Distance of two columns.
    pub(super) spacing_x_mm: f64,
    /// Distance of two rows.
    pub(super) spacing_y_mm: f64,
    /// Errors, row by row, to a millionth of a micrometre; positive where material stands above the nominal surface. Null
    /// where nothing was measured.
    pub(super) error_um: Vec<Vec<Option<f64>>>,
    /// Standard uncertainties of the errors, in the same order.
    pub(super) sigma_um: Vec<Vec<Option<f64>>>,
}

/// Page of the record of a run.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct EventsPage {
    /// Name of the run.
    pub(super) run: String,
    /// Records, in their order.
    pub(super) events: Vec<RecordedEvent>,
    /// Value of the parameter `after` for the next page.
    pub(super) next_after: u64,
    /// Number of the last record now; 0 if there is none.
    pub(super) last: u64,
}

/// Record of a run.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct RecordedEvent {
    /// Number of the record, from 1.
    pub(super) sequence: u64,
    /// Time of day, RFC 3339 in UTC. The order is that of the numbers, not of the times.
    utc: String,
    /// Kind of the record.
    kind: &'static str,
    /// Person or machine that acted, or the cell.
    actor: String,
    /// Computer of a person; empty for the program and the machines.
    station: String,
    /// Number of the cycle; 0 before the first.
    cycle: u32,
    /// Number of the command that the record belongs to.
    command: Option<u32>,
    /// Reason in words; can be empty.
    reason: String,
    /// Content in words.
    words: String,
    /// Content, as it is recorded. Its form is in the chapter on the record.
    content: Value,
    /// Hash of the record in the chain of the record.
    hash: String,
}

/// End of the stream of a run that has ended.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct EndOfRecord {
    /// Number of the last record.
    pub(super) last: u64,
}

impl RunState {
    /// Returns the state of the run named `run` from `seen`, the current knowledge about it.
    pub(super) fn new(run: &str, seen: &ObservedRun) -> Self {
        let summary = &*seen.summary;
        let live = seen.snapshot.as_deref().filter(|_| seen.answers);
        let phase = live.and_then(|live| live.phase);
        let (part, name) = match live {
            Some(live) if summary.run.is_empty() => (live.serial.clone(), live.part.clone()),
            _ => (summary.part.clone(), summary.name.clone()),
        };
        let last_cycle = summary.cycles.last().map_or(0, |of| of.cycle);
        let measured = summary.cycles.iter().rev().find(|of| of.figures.is_some());
        Self {
            run: run.to_owned(),
            is_active: live.is_some(),
            state: live.map_or_else(|| state_after_end(summary), |live| Some(live.state)),
            phase: phase.map(|phase| phase.name()),
            step: phase.and_then(|phase| phase.job()).map(|(_, step)| step.to_string()),
            state_number: live.map(|live| live.state_number),
            simulation: live.map_or(summary.simulation, |live| live.simulation),
            part,
            name,
            recipe: summary.recipe.clone(),
            operator: summary.operator.clone(),
            result: summary.result.into(),
            cycle: live.map_or(last_cycle, |live| live.cycle),
            max_cycles: live.map(|live| live.max_cycles),
            elapsed_s: live.and_then(|live| finite(live.elapsed_s)),
            progress: live.and_then(|live| live.progress).map(Progress::from),
            unconfirmed: live.map_or_else(Vec::new, |live| live.unconfirmed.clone()),
            alarms: live.map_or_else(Vec::new, |live| live.alarms.iter().map(ActiveAlarm::from).collect()),
            waits_for: live.map_or_else(Vec::new, |live| live.waits_for.clone()),
            next_step: live.map(next_step).unwrap_or_default(),
            figures: measured.map(CycleFigures::from),
        }
    }

    /// Returns the state by its PackML name; `None` if it is not known.
    pub(super) fn state(&self) -> Option<StateName> {
        self.state
    }
}

fn next_step(live: &Snapshot) -> String {
    if live.next.is_empty() { live.next_step.to_string() } else { live.next.clone() }
}

/// Returns the state in which a run has ended; `None` if its end is not on record, or if it was a recovery.
fn state_after_end(summary: &RunSummary) -> Option<StateName> {
    match summary.result {
        RunResult::Accepted => Some(StateName::Complete),
        RunResult::NotAccepted | RunResult::Stopped => Some(StateName::Stopped),
        RunResult::Aborted => Some(StateName::Aborted),
        RunResult::Open | RunResult::Recovery => None,
    }
}

impl From<JobProgress> for Progress {
    fn from(progress: JobProgress) -> Self {
        let remaining = |k: usize| progress.remaining_s.and_then(|remaining| finite(remaining[k]));
        let JobProgress { device: machine, done, total, .. } = progress;
        Self { machine, done, total, remaining_min_s: remaining(0), remaining_max_s: remaining(1) }
    }
}

impl From<&Alarm> for ActiveAlarm {
    fn from(alarm: &Alarm) -> Self {
        let Alarm { id, event, consequence, remedy, cleared_by } = alarm.clone();
        Self { code: id, event, consequence, remedy, cleared_by }
    }
}

impl From<&AlarmHistory> for PastAlarm {
    fn from(of: &AlarmHistory) -> Self {
        Self {
            alarm: ActiveAlarm::from(&of.alarm),
            raised: of.raised.clone(),
            withdrawn: of.withdrawn.clone(),
            acknowledged_by: of.acknowledged.as_ref().map(|acknowledged| acknowledged.by.clone()),
        }
    }
}

impl RunItem {
    pub(super) fn new(run: &str, is_active: bool, summary: &RunSummary) -> Self {
        let figures = summary.cycles.iter().rev().find_map(|of| of.figures);
        Self {
            run: run.to_owned(),
            is_active,
            part: summary.part.clone(),
            name: summary.name.clone(),
            recipe: summary.recipe.clone(),
            operator: summary.operator.clone(),
            began: summary.began.clone(),
            ended: summary.ended.clone(),
            simulation: summary.simulation,
            result: summary.result.into(),
            cycles: summary.cycles.len(),
            alarms: summary.alarms.len(),
            pv_um: figures.and_then(|[[pv_um, _], _]| finite(pv_um)),
            rms_um: figures.and_then(|[_, [rms_um, _]]| finite(rms_um)),
        }
    }
}

impl From<&Listed> for RunItem {
    fn from(listed: &Listed) -> Self {
        Self::new(&listed.id, listed.is_live, &listed.summary)
    }
}

impl RunDetail {
    /// Returns the details of the run named `run` from `seen`, the current knowledge about it.
    pub(super) fn new(run: &str, seen: &ObservedRun) -> Self {
        let summary = &*seen.summary;
        let [cmm, grinder] = summary.machines.clone();
        Self {
            item: RunItem::new(run, seen.answers, summary),
            state: RunState::new(run, seen),
            verdict: summary.verdict.clone(),
            tolerance: summary.tolerance.as_ref().map(Limits::from),
            cmm,
            grinder,
            wheel_radius_mm: summary.wheel_radius_mm.and_then(finite),
            probe_radius_error_um: summary.probe_off_um.and_then(finite),
            alarm_history: summary.alarms.iter().map(PastAlarm::from).collect(),
            last_record: summary.last.clone(),
        }
    }
}

impl From<&Tolerance> for Limits {
    fn from(tolerance: &Tolerance) -> Self {
        Self {
            pv_limit_um: finite(1e3 * tolerance.pv_mm),
            rms_limit_um: finite(1e3 * tolerance.rms_mm),
            pv_points: tolerance.pv_points,
            with_uncertainty: tolerance.with_uncertainty,
            probability: tolerance.probability,
        }
    }
}

impl From<&CycleSummary> for CycleFigures {
    fn from(of: &CycleSummary) -> Self {
        let judged = of.judged.map(|judged| judged.map(|figure| Figure::new(&figure)));
        let [pv, rms] = judged.unwrap_or_default();
        Self {
            cycle: of.cycle,
            verdict: of.recorded_verdict(),
            reason: of.reason.clone(),
            pv,
            rms,
            points: of.points.map(|[points, _]| points),
            outliers: of.points.map(|[_, outliers]| outliers),
            expected_pv_um: of.expected.and_then(|[pv_um, _]| finite(pv_um)),
            expected_rms_um: of.expected.and_then(|[_, rms_um]| finite(rms_um)),
            pass_duration_s: of.pass_s().and_then(finite),
            measurement_duration_s: of.measurement_s().and_then(finite),
            removed_mm3: of.pass.and_then(|pass| finite(pass.removed_mm3?)),
            max_depth_um: of.pass.and_then(|pass| finite(1e3 * pass.max_depth_mm?)),
            wheel_radius_mm: of.pass.and_then(|pass| finite(pass.wheel_radius_mm?)),
            probe_radius_error_um: of.radius_error_um.and_then(finite),
            has_map: of.map.is_some(),
        }
    }
}

impl Figure {
    /// Returns a figure in micrometres; `None` if a number of it is not finite.
    fn new(of: &ComparedFigure) -> Option<Self> {
        let [low_mm, high_mm] = of.interval_mm;
        let um = |mm: f64| finite(1e3 * mm);
        Some(Self {
            name: of.name,
            median_um: um(of.median_mm)?,
            low_um: um(low_mm)?,
            high_um: um(high_mm)?,
            expanded_um: um(of.expanded_mm)?,
            limit_um: um(of.limit_mm),
            probability_in_tolerance: of.probability_in_tolerance.and_then(finite),
            conformity: match of.conformity {
                Conformity::Within => Standing::Within,
                Conformity::Undecided => Standing::Undecided,
                Conformity::Beyond => Standing::Beyond,
            },
        })
    }
}

impl From<RecordEntry> for RecordedEvent {
    fn from(entry: RecordEntry) -> Self {
        let RecordEntry { line, command_id, reason, content, hash } = entry;
        Self {
            sequence: line.number,
            utc: line.utc,
            kind: line.kind,
            actor: line.who,
            station: line.station,
            cycle: line.cycle,
            command: command_id,
            reason,
            words: line.words,
            content,
            hash,
        }
    }
}

/// Returns `value` if it is finite.
pub(super) fn finite(value: f64) -> Option<f64> {
    Some(value).filter(|value| value.is_finite())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn outcome_names_are_serialised() {
        use Outcome::{Aborted, Accepted, NotAccepted, Open, Recovery, Stopped};
        for outcome in [Open, Accepted, NotAccepted, Stopped, Aborted, Recovery] {
            assert_eq!(serde_json::to_value(outcome).unwrap(), outcome.name());
        }
    }

    /// Numbers that no document may contain become null.
    #[test]
    fn json_has_no_nan() {
        let cycle = CycleSummary {
            cycle: 1,
            figures: Some([[f64::NAN, 1.0], [f64::INFINITY, 1.0]]),
            expected: Some([f64::NAN; 2]),
            radius_error_um: Some(f64::NAN),
            job_s: [Some(f64::NAN), Some(2.0)],
            judged: Some(["PV", "RMS"].map(|name| ComparedFigure {
                name,
                median_mm: if name == "PV" { f64::NAN } else { 0.001 },
                expanded_mm: 0.0001,
                interval_mm: [0.0009, 0.0011],
                limit_mm: f64::INFINITY,
                probability_in_tolerance: None,
                compared_mm: [0.0009, 0.0011],
                conformity: Conformity::Within,
            })),
            ..CycleSummary::default()
        };
        let summary =
            Arc::new(RunSummary { cycles: vec![cycle], wheel_radius_mm: Some(f64::NAN), ..RunSummary::default() });
        let snapshot = Snapshot { elapsed_s: f64::NAN, ..Snapshot::default() };
        let seen = ObservedRun { snapshot: Some(Arc::new(snapshot)), answers: true, summary, ..ObservedRun::default() };
        let found = serde_json::to_value(RunDetail::new("a", &seen)).unwrap();
        for pointer in [
            "/pv_um",
            "/rms_um",
            "/wheel_radius_mm",
            "/state/elapsed_s",
            "/state/figures/pv",
            "/state/figures/expected_pv_um",
        ] {
            assert!(found.pointer(pointer).is_some_and(Value::is_null), "{pointer}: {found}");
        }
        let cycle = &found["state"]["figures"];
        assert!(cycle["measurement_duration_s"].is_null() && cycle["pass_duration_s"] == 2.0, "{cycle}");
        assert_eq!((&cycle["rms"]["median_um"], &cycle["rms"]["limit_um"]), (&Value::from(1.0), &Value::Null));
    }
}
