//! Figures of a cell that are published: name, kind and unit of each. All publishers use the same list.
//!
//! An unknown figure has no value: neither 0 nor an empty text.

use regrind_control::{CycleRow, JobProgress, Snapshot};

use crate::cell_status::{CellStatus, RunStatus};
use crate::packml::{PRODUCTION, SIMULATION, state_number};

/// Figure that is published.
#[derive(Clone, Copy, Debug)]
pub struct Figure {
    /// Name: a path of words separated by `/`. If PackML has a tag for the figure, the name is that tag.
    pub name: &'static str,
    /// Kind of the values.
    pub kind: FigureKind,
    /// Unit of the values.
    pub unit: Option<&'static str>,
    /// Description, for people.
    pub about: &'static str,
    read: fn(&CellStatus) -> Option<FigureValue>,
}

/// Kind of the values of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "named for what they are")]
pub enum FigureKind {
    Whole,
    Number,
    Truth,
    Text,
}

/// Value of a figure.
#[derive(Clone, Debug, PartialEq)]
#[expect(missing_docs, reason = "named for what they are")]
pub enum FigureValue {
    Whole(u32),
    Number(f64),
    Truth(bool),
    Text(String),
}

impl Figure {
    /// Returns the value of this figure (a published quantity of a cell) for the cell status `told`. Returns `None` if
    /// the value is unknown or not finite.
    pub fn value(&self, told: &CellStatus) -> Option<FigureValue> {
        (self.read)(told).filter(|value| !matches!(value, FigureValue::Number(number) if !number.is_finite()))
    }
}

const fn whole(name: &'static str, about: &'static str, of: fn(&CellStatus) -> Option<FigureValue>) -> Figure {
    Figure { name, kind: FigureKind::Whole, unit: None, about, read: of }
}

const fn number(
    name: &'static str,
    unit: &'static str,
    about: &'static str,
    of: fn(&CellStatus) -> Option<FigureValue>,
) -> Figure {
    Figure { name, kind: FigureKind::Number, unit: Some(unit), about, read: of }
}

const fn truth(name: &'static str, about: &'static str, of: fn(&CellStatus) -> Option<FigureValue>) -> Figure {
    Figure { name, kind: FigureKind::Truth, unit: None, about, read: of }
}

const fn text(name: &'static str, about: &'static str, of: fn(&CellStatus) -> Option<FigureValue>) -> Figure {
    Figure { name, kind: FigureKind::Text, unit: None, about, read: of }
}

/// All published figures of a cell.
pub const FIGURES: &[Figure] = &[
    whole("Status/StateCurrent", "Number of the state in PackML; 4 (Idle) if no run is active", |told| {
        told.state().map(|state| FigureValue::Whole(state_number(state)))
    }),
    text("Status/StateName", "Name of the state by PackML", |told| {
        told.state().map(|state| FigureValue::Text(state.to_string()))
    }),
    whole("Status/UnitModeCurrent", "Number of the mode by PackML: 1 production, 16 simulation", |told| {
        told.snapshot().map(|now| FigureValue::Whole(if now.simulation { SIMULATION } else { PRODUCTION }))
    }),
    text("Status/UnitModeName", "Name of the mode", |told| {
        told.snapshot().map(|now| in_words(if now.simulation { "Simulation" } else { "Production" }))
    }),
    truth("Simulation", "True if any machine of the cell is simulated", |told| {
        told.snapshot().map(|now| FigureValue::Truth(now.simulation))
    }),
    text("Message", "State and phase, for people", |told| match &told.run_status {
        RunStatus::NoRun => Some(in_words("no run is on")),
        RunStatus::Unresponsive { run } => Some(FigureValue::Text(format!(
            "the program of {run} does not answer: the state of the machines is unknown; inspect them"
        ))),
        RunStatus::ProgramGone { run, machines_within: true } => Some(FigureValue::Text(format!(
            "the program of {run} has gone before its end, and its simulated machines with it"
        ))),
        RunStatus::ProgramGone { run, machines_within: false } => Some(FigureValue::Text(format!(
            "the program of {run} ended before the end of the run: the state of the machines is unknown; inspect them, then: regrind resume"
        ))),
        RunStatus::Active { snapshot, .. } => Some(in_words(&snapshot.message)),
    }),
    text("Next Step", "Next action of a person", |told| live(told).map(|now| in_words(&now.next))),
    text("Phase", "Phase of the cycle that the cell executes, or that it will continue", |told| {
        told.snapshot()?.phase.map(|phase| in_words(phase.name()))
    }),
    text("Run", "Name of the run", |told| told.run().map(in_words)),
    text("Part", "Name of the part", |told| told.snapshot().and_then(|now| if_known(&now.part))),
    text("Serial", "Serial number of the part", |told| told.snapshot().and_then(|now| if_known(&now.serial))),
    whole("Cycle", "Number of the cycle; 0 before the first", |told| {
        told.snapshot().map(|now| FigureValue::Whole(now.cycle))
    }),
    whole("Max Cycles", "Maximum number of cycles", |told| {
        told.snapshot().map(|now| now.max_cycles).filter(|most| *most > 0).map(FigureValue::Whole)
    }),
    text("Job/Machine", "Machine that executes a job: cmm or grinder", |told| {
        job(told).map(|job| in_words(job.device.name()))
    }),
    whole("Job/Done", "Completed steps of the job: points measured, or parts of the path ground", |told| {
        job(told).map(|job| FigureValue::Whole(job.done))
    }),
    whole("Job/Total", "All steps of the job: points, or parts of the path", |told| {
        job(told).map(|job| FigureValue::Whole(job.total))
    }),
    number("Job/Progress", "%", "Progress of the job", |told| {
        job(told)
            .filter(|job| job.total > 0)
            .map(|job| FigureValue::Number(100.0 * f64::from(job.done) / f64::from(job.total)))
    }),
    number("Job/Least Time Left", "s", "Minimum remaining time of the job", |told| time_left_s(told, 0)),
    number("Job/Most Time Left", "s", "Maximum remaining time of the job", |told| time_left_s(told, 1)),
    whole("Figures/Cycle", "Last measured cycle, to which PV and RMS belong", |told| {
        measured(told).map(|row| FigureValue::Whole(row.cycle))
    }),
    number("Figures/PV", "um", "Peak to valley of the form, as it is judged", |told| {
        measured(told).map(|row| FigureValue::Number(row.judged_um()[0]))
    }),
    number("Figures/RMS", "um", "Root mean square of the form, as it is judged", |told| {
        measured(told).map(|row| FigureValue::Number(row.judged_um()[1]))
    }),
    number("Limits/PV", "um", "Limit of PV; no value if PV has no limit", |told| {
        told.snapshot()?.tolerance.map(|limits| FigureValue::Number(1e3 * limits.pv_mm))
    }),
    number("Limits/RMS", "um", "Limit of RMS; no value if RMS has no limit", |told| {
        told.snapshot()?.tolerance.map(|limits| FigureValue::Number(1e3 * limits.rms_mm))
    }),
    whole("Alarms/Count", "Number of active alarms", |told| {
        told.snapshot().map(|now| FigureValue::Whole(u32::try_from(now.alarms.len()).unwrap_or(u32::MAX)))
    }),
    text("Alarms/Text", "Texts of the active alarms, one on each line; empty without an alarm", |told| {
        told.snapshot().map(|now| listed(now.alarms.iter().map(|alarm| &*alarm.event), "\n"))
    }),
    text(
        "Unconfirmed",
        "Machines that have not confirmed that they are at rest, in a state where the cell is considered to be at rest",
        |told| live(told).map(|now| listed(now.unconfirmed.iter().map(|device| device.name()), ", ")),
    ),
    text("Last Run/Name", "Name of the last run that ended", |told| {
        told.last_run.as_ref().map(|last| in_words(&last.run))
    }),
    text("Last Run/Result", "Result of that run: Accepted, NotAccepted, Stopped or Aborted", |told| {
        told.last_run.as_ref().map(|last| in_words(last.result))
    }),
    text("Last Run/Verdict", "Result of the last run that ended", |told| {
        told.last_run.as_ref().map(|last| in_words(&last.verdict))
    }),
    truth("Last Run/Accepted", "True if the part of the last run that ended is accepted", |told| {
        told.last_run.as_ref().map(|last| FigureValue::Truth(last.accepted))
    }),
];

fn in_words(words: &str) -> FigureValue {
    FigureValue::Text(words.to_owned())
}

fn listed<'a>(words: impl Iterator<Item = &'a str>, between: &str) -> FigureValue {
    FigureValue::Text(words.collect::<Vec<_>>().join(between))
}

fn if_known(name: &str) -> Option<FigureValue> {
    Some(name).filter(|name| !name.is_empty()).map(in_words)
}

/// Returns the snapshot if the program of the run has sent it. A record does not tell all that such a snapshot tells.
fn live(told: &CellStatus) -> Option<&Snapshot> {
    told.snapshot().filter(|_| !told.from_record)
}

fn job(told: &CellStatus) -> Option<JobProgress> {
    told.snapshot()?.progress
}

fn time_left_s(told: &CellStatus, which: usize) -> Option<FigureValue> {
    job(told)?.remaining_s.map(|left_s| FigureValue::Number(left_s[which]))
}

fn measured(told: &CellStatus) -> Option<&CycleRow> {
    told.snapshot()?.cycles.last()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn on(snapshot: Snapshot) -> CellStatus {
        CellStatus {
            run_status: RunStatus::Active { run: "a run".into(), snapshot: Box::new(snapshot) },
            ..CellStatus::default()
        }
    }

    fn value(name: &str, told: &CellStatus) -> Option<FigureValue> {
        FIGURES.iter().find(|figure| figure.name == name).unwrap().value(told)
    }

    #[test]
    fn figures_documented_in_live_md() {
        let book = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/live.md")).unwrap();
        for Figure { name, kind, unit, about, .. } in FIGURES {
            let kind = match kind {
                FigureKind::Whole => "UInt32",
                FigureKind::Number => "Double",
                FigureKind::Truth => "Boolean",
                FigureKind::Text => "String",
            };
            let row = format!("| `{name}` | {kind} | {} | {about} |", unit.unwrap_or_default());
            assert!(book.contains(&row), "docs/live.md lacks {row}");
        }
    }

    #[test]
    fn unknown_figures_have_no_value() {
        let nothing = on(Snapshot::default());
        for name in
            ["Figures/PV", "Limits/PV", "Job/Progress", "Job/Least Time Left", "Part", "Serial", "Max Cycles", "Phase"]
        {
            assert_eq!(value(name, &nothing), None, "{name}");
        }
        let limits = regrind_cell::Tolerance {
            pv_mm: f64::INFINITY,
            rms_mm: 1e-3,
            with_uncertainty: false,
            probability: 0.975,
            pv_points: regrind_cell::PvPoints::All,
        };
        let told = on(Snapshot { tolerance: Some(limits), ..Snapshot::default() });
        assert_eq!(value("Limits/PV", &told), None, "it is not limited");
        assert_eq!(value("Limits/RMS", &told), Some(FigureValue::Number(1.0)));
    }

    #[test]
    fn gone_run_has_no_state() {
        let gone = CellStatus {
            run_status: RunStatus::ProgramGone { run: "a run".into(), machines_within: false },
            ..CellStatus::default()
        };
        assert_eq!((value("Status/StateCurrent", &gone), value("Status/StateName", &gone)), (None, None));
        assert_eq!(value("Status/StateCurrent", &CellStatus::default()), Some(FigureValue::Whole(4)));
        assert_eq!(value("Run", &gone), Some(FigureValue::Text("a run".into())));
    }
}
