//! Data items of a cell for MTConnect: the type, the unit and the value of each.
//!
//! An unknown value is UNAVAILABLE, as the standard wants it.

use regrind_cell::{Phase, StateName};
use regrind_control::{PartVerdict, Snapshot};

use crate::cell_status::{CellStatus, RunStatus};

/// Data item that is an event or a sample. The alarms are the only condition.
pub(super) struct Item {
    /// Name, which is the key in SHDR.
    pub(super) name: &'static str,
    /// Place in the device.
    pub(super) place: Place,
    /// Type, with its sub-type.
    pub(super) kind: &'static str,
    pub(super) sub_type: Option<&'static str>,
    /// Unit; a data item with a unit of length is a sample.
    pub(super) units: Option<&'static str>,
    read: fn(&CellStatus) -> Option<String>,
}

/// Component to which a data item belongs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    Device,
    Controller,
    Path,
}

/// Name of the condition with the alarms of the cell.
pub(super) const ALARMS: &str = "alarms";
/// Value of a data item of which nothing is known.
pub(super) const UNAVAILABLE: &str = "UNAVAILABLE";
const MILLIMETER: &str = "MILLIMETER";

impl Item {
    /// Returns the value for the status `told`; `None` if it is unknown.
    pub(super) fn value(&self, told: &CellStatus) -> Option<String> {
        (self.read)(told)
    }

    /// Returns the category of the data item.
    pub(super) fn category(&self) -> &'static str {
        if self.units == Some(MILLIMETER) { "SAMPLE" } else { "EVENT" }
    }

    /// Returns true if the data item is a message, which has a native code before its text.
    pub(super) fn is_message(&self) -> bool {
        self.kind == "MESSAGE"
    }
}

const fn event(name: &'static str, place: Place, kind: &'static str, read: fn(&CellStatus) -> Option<String>) -> Item {
    Item { name, place, kind, sub_type: None, units: None, read }
}

const fn sub_event(
    name: &'static str,
    place: Place,
    [kind, sub_type]: [&'static str; 2],
    read: fn(&CellStatus) -> Option<String>,
) -> Item {
    Item { name, place, kind, sub_type: Some(sub_type), units: None, read }
}

const fn length(name: &'static str, read: fn(&CellStatus) -> Option<String>) -> Item {
    Item { name, place: Place::Path, kind: "DISPLACEMENT", sub_type: None, units: Some(MILLIMETER), read }
}

/// All events and samples of a cell.
pub(super) const ITEMS: &[Item] = &[
    event("availability", Place::Device, "AVAILABILITY", |told| told.state().map(|_| "AVAILABLE".to_owned())),
    event("functional_mode", Place::Device, "FUNCTIONAL_MODE", |told| {
        told.snapshot().map(|now| if now.simulation { "PROCESS_DEVELOPMENT" } else { "PRODUCTION" }.to_owned())
    }),
    sub_event("dry_run", Place::Controller, ["CONTROLLER_MODE_OVERRIDE", "DRY_RUN"], |told| {
        told.snapshot().map(|now| if now.simulation { "ON" } else { "OFF" }.to_owned())
    }),
    event("controller_mode", Place::Controller, "CONTROLLER_MODE", |told| {
        let now = told.snapshot().filter(|now| PartVerdict::from_state(now.state) == PartVerdict::Open)?;
        // A step of a person is part of the job of a machine.
        Some(if now.operator_step.is_some() { "SEMI_AUTOMATIC" } else { "AUTOMATIC" }.to_owned())
    }),
    event("execution", Place::Path, "EXECUTION", |told| execution(told).map(ToOwned::to_owned)),
    event("process_state", Place::Path, "PROCESS_STATE", |told| {
        told.snapshot().and_then(|now| process_state(now.state)).map(ToOwned::to_owned)
    }),
    event("run", Place::Path, "PROCESS_OCCURRENCE_ID", |told| told.run().map(ToOwned::to_owned)),
    sub_event("part", Place::Path, ["PART_KIND_ID", "PART_NAME"], |told| {
        told.snapshot().and_then(|now| known(&now.part))
    }),
    sub_event("serial", Place::Path, ["PART_UNIQUE_ID", "SERIAL_NUMBER"], |told| {
        told.snapshot().and_then(|now| known(&now.serial))
    }),
    event("part_status", Place::Path, "PART_STATUS", |told| {
        // A run can end before the part is judged, so its end alone is no failure of the part.
        told.snapshot().filter(|now| now.verdict == PartVerdict::Accepted).map(|_| "PASS".to_owned())
    }),
    sub_event("cycle", Place::Path, ["CYCLE_COUNT", "ALL"], |told| told.snapshot().map(|now| now.cycle.to_string())),
    sub_event("max_cycles", Place::Path, ["CYCLE_COUNT", "TARGET"], |told| {
        told.snapshot().map(|now| now.max_cycles).filter(|most| *most > 0).map(|most| most.to_string())
    }),
    event("phase", Place::Path, "VARIABLE", |told| told.snapshot()?.phase.map(|phase| phase.name().to_owned())),
    Item {
        name: "job_progress",
        place: Place::Path,
        kind: "VARIABLE",
        sub_type: None,
        units: Some("PERCENT"),
        read: |told| {
            let job = told.snapshot()?.progress.filter(|job| job.total > 0)?;
            Some(number(100.0 * f64::from(job.done) / f64::from(job.total)))
        },
    },
    length("form_pv", |told| Some(number(1e-3 * told.snapshot()?.cycles.last()?.judged_um()[0]))),
    length("form_rms", |told| Some(number(1e-3 * told.snapshot()?.cycles.last()?.judged_um()[1]))),
    length("pv_limit", |told| limit(told.snapshot()?.tolerance?.pv_mm)),
    length("rms_limit", |told| limit(told.snapshot()?.tolerance?.rms_mm)),
    event("message", Place::Path, "MESSAGE", message),
];

/// Returns a number without an exponent, to 0.001 nm or 0.000001 %.
fn number(value: f64) -> String {
    let text = format!("{value:.6}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

fn limit(mm: f64) -> Option<String> {
    mm.is_finite().then(|| number(mm))
}

fn known(name: &str) -> Option<String> {
    Some(name).filter(|name| !name.is_empty()).map(ToOwned::to_owned)
}

fn message(told: &CellStatus) -> Option<String> {
    match &told.run_status {
        RunStatus::NoRun => Some("no run is on".to_owned()),
        RunStatus::Unresponsive { run } => {
            Some(format!("the program of {run} does not answer: the state of the machines is unknown; inspect them"))
        }
        RunStatus::ProgramGone { run, .. } => Some(format!("the program of {run} ended before the end of the run")),
        RunStatus::Active { snapshot, .. } => Some(marked(snapshot)),
    }
}

fn marked(now: &Snapshot) -> String {
    format!("{}{}", if now.simulation { "SIMULATION " } else { "" }, now.message)
}

/// Returns the EXECUTION of MTConnect for the state of the cell.
fn execution(told: &CellStatus) -> Option<&'static str> {
    Some(match told.state()? {
        StateName::Idle => "READY",
        // A person loads the part.
        StateName::Execute if told.snapshot().is_some_and(|now| now.phase == Some(Phase::Load)) => "WAIT",
        StateName::Starting
        | StateName::Execute
        | StateName::Unholding
        | StateName::Unsuspending
        | StateName::Completing => "ACTIVE",
        StateName::Holding | StateName::Held => "INTERRUPTED",
        StateName::Suspending | StateName::Suspended => "WAIT",
        StateName::Stopping | StateName::Aborting | StateName::Stopped | StateName::Aborted => "STOPPED",
        StateName::Complete => "PROGRAM_COMPLETED",
    })
}

/// Returns the PROCESS_STATE of MTConnect for the state of a run.
fn process_state(state: StateName) -> Option<&'static str> {
    Some(match state {
        StateName::Idle => return None,
        StateName::Starting => "INITIALIZING",
        StateName::Execute | StateName::Unholding | StateName::Unsuspending | StateName::Completing => "ACTIVE",
        StateName::Holding | StateName::Held | StateName::Suspending | StateName::Suspended => "INTERRUPTED",
        StateName::Stopping | StateName::Stopped | StateName::Aborting | StateName::Aborted => "ABORTED",
        StateName::Complete => "COMPLETE",
    })
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

    fn value(name: &str, told: &CellStatus) -> Option<String> {
        ITEMS.iter().find(|item| item.name == name).unwrap().value(told)
    }

    #[test]
    fn items_documented_in_live_md() {
        let book = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/live.md")).unwrap();
        for Item { name, kind, sub_type, units, .. } in ITEMS {
            let kind = sub_type.map_or((*kind).to_owned(), |sub_type| format!("{kind}, {sub_type}"));
            let row = format!("| `{name}` | {kind} | {} |", units.unwrap_or_default());
            assert!(book.contains(&row), "docs/live.md lacks {row}");
        }
    }

    #[test]
    fn unknown_is_no_value() {
        let gone = CellStatus {
            run_status: RunStatus::ProgramGone { run: "a run".into(), machines_within: false },
            ..CellStatus::default()
        };
        for name in ["availability", "execution", "functional_mode", "dry_run", "cycle", "form_pv"] {
            assert_eq!(value(name, &gone), None, "{name}");
        }
        assert_eq!(value("run", &gone).as_deref(), Some("a run"));
        let nothing = on(Snapshot::default());
        for name in ["form_pv", "pv_limit", "job_progress", "part", "serial", "max_cycles", "phase", "part_status"] {
            assert_eq!(value(name, &nothing), None, "{name}");
        }
        let idle = CellStatus::default();
        assert_eq!(value("execution", &idle).as_deref(), Some("READY"));
        assert_eq!(value("controller_mode", &idle), None);
    }

    #[test]
    fn simulated_part_is_no_production() {
        for (simulation, mode, dry_run) in [(true, "PROCESS_DEVELOPMENT", "ON"), (false, "PRODUCTION", "OFF")] {
            let told = on(Snapshot { simulation, ..Snapshot::default() });
            assert_eq!(value("functional_mode", &told).as_deref(), Some(mode));
            assert_eq!(value("dry_run", &told).as_deref(), Some(dry_run));
        }
    }

    #[test]
    fn lengths_are_millimetres_without_exponent() {
        assert_eq!(
            ["0.000012", "0.0123", "1", "0"].map(|text| number(text.parse().unwrap())),
            ["0.000012", "0.0123", "1", "0"]
        );
    }
}
