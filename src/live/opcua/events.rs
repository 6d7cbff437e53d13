//! Events of a cell: a measured cycle, a raised alarm, the end of a run.

use opcua_nodes::{BaseEventType, Event};
use opcua_server::EventField;
use opcua_types::{
    AttributeId, ByteString, DataTypeId, DateTime, Guid, LocalizedText, NodeId, NumericRange, QualifiedName, Variant,
};
use regrind_cell::Alarm;
use regrind_control::{CycleRow, Snapshot};

use crate::cell_status::{CellStatus, RunStatus, TimedStatus};

/// Severities of events, from 1 to 1000.
const OF_INTEREST: u16 = 100;
const TO_BE_SEEN_TO: u16 = 700;

/// Base type of all events of a cell. A client subscribes to it to get all events.
pub(super) const ALL: &str = "CellEventType";

/// Type of event, with its fields in addition to the fields of every event.
pub(super) struct EventKind {
    pub(super) name: &'static str,
    pub(super) fields: &'static [(&'static str, DataTypeId)],
}

const RESULT: EventKind = EventKind {
    name: "CycleResultEventType",
    fields: &[
        ("Run", DataTypeId::String),
        ("Part", DataTypeId::String),
        ("Serial", DataTypeId::String),
        ("Simulation", DataTypeId::Boolean),
        ("Cycle", DataTypeId::UInt32),
        ("PV", DataTypeId::Double),
        ("RMS", DataTypeId::Double),
        ("PVLimit", DataTypeId::Double),
        ("RMSLimit", DataTypeId::Double),
    ],
};
const ALARM: EventKind = EventKind {
    name: "CellAlarmEventType",
    fields: &[
        ("Run", DataTypeId::String),
        ("Simulation", DataTypeId::Boolean),
        ("Consequence", DataTypeId::String),
        ("Remedy", DataTypeId::String),
    ],
};
const RUN_ENDED: EventKind = EventKind {
    name: "RunEndedEventType",
    fields: &[("Run", DataTypeId::String), ("Verdict", DataTypeId::String), ("Accepted", DataTypeId::Boolean)],
};

/// All types of events.
pub(super) const KINDS: [&EventKind; 3] = [&RESULT, &ALARM, &RUN_ENDED];

impl EventKind {
    /// Returns the node id of this type of event. `own` is the index of the cell's namespace.
    pub(super) fn node(&self, own: u16) -> NodeId {
        NodeId::new(own, self.name)
    }
}

/// Event of a cell.
pub(super) struct CellEvent {
    base: BaseEventType,
    own: u16,
    fields: Vec<(&'static str, Variant)>,
}

/// Returns the events that happened between two published statuses of a cell: new cycle results, new alarms, and the
/// end of a run. `before` is the last published status, and `now` is the new status. `own` is the index of the cell's
/// OPC UA namespace, and `cell` is the name of the cell.
///
/// `on` is the last published status with an active run. It can be older than `before`, because the run can be
/// interrupted. If `on` belongs to the same run as `now`, only results and alarms that are not in `on` are returned. A
/// run that continues after an interruption therefore repeats no event.
pub(super) fn events_between(
    [before, on]: [&CellStatus; 2],
    now: &TimedStatus,
    own: u16,
    cell: &str,
) -> Vec<CellEvent> {
    let from = |kind: &EventKind, severity, message: String, values: Vec<Variant>| {
        let mut event = CellEvent::new((kind, own), cell, severity, &message, values);
        event.base.time = super::nodes::time(now.at_ms);
        event
    };
    let now = &now.status;
    let mut events = Vec::new();
    if let RunStatus::Active { run, snapshot } = &now.run_status {
        let earlier = on.snapshot().filter(|_| on.run() == Some(run));
        for row in new_rows(earlier, snapshot) {
            let [pv_um, rms_um] = row.judged_um();
            let message = format!("cycle {}: PV {pv_um:.2} um, RMS {rms_um:.3} um", row.cycle);
            events.push(from(&RESULT, OF_INTEREST, message, result(run, snapshot, row)));
        }
        for alarm in new_alarms(earlier, snapshot) {
            let remedy = alarm.remedy.join("\n");
            let values = vec![text(run), snapshot.simulation.into(), text(&alarm.consequence), text(&remedy)];
            events.push(from(&ALARM, TO_BE_SEEN_TO, alarm.event.clone(), values));
        }
    }
    if let Some(last) = now.last_run.as_ref().filter(|last| before.last_run.as_ref() != Some(last)) {
        let values = vec![text(&last.run), text(&last.verdict), last.accepted.into()];
        events.push(from(&RUN_ENDED, OF_INTEREST, last.verdict.clone(), values));
    }
    events
}

fn result(run: &str, now: &Snapshot, row: &CycleRow) -> Vec<Variant> {
    let [pv_um, rms_um] = row.judged_um();
    let limit = |mm: Option<f64>| mm.filter(|mm| mm.is_finite()).map_or(Variant::Empty, |mm| (1e3 * mm).into());
    vec![
        text(run),
        if_known(&now.part),
        if_known(&now.serial),
        now.simulation.into(),
        row.cycle.into(),
        pv_um.into(),
        rms_um.into(),
        limit(now.tolerance.map(|limits| limits.pv_mm)),
        limit(now.tolerance.map(|limits| limits.rms_mm)),
    ]
}

fn text(text: &str) -> Variant {
    text.into()
}

fn if_known(name: &str) -> Variant {
    if name.is_empty() { Variant::Empty } else { name.into() }
}

/// Returns the rows of `now`, one per cycle, that are not in the snapshot `earlier` or have changed since. Without
/// `earlier`, returns all rows.
fn new_rows<'a>(earlier: Option<&'a Snapshot>, now: &'a Snapshot) -> impl Iterator<Item = &'a CycleRow> {
    let known = move |row: &CycleRow| earlier.is_some_and(|then| then.cycles.contains(row));
    now.cycles.iter().filter(move |row| !known(row))
}

fn new_alarms<'a>(earlier: Option<&'a Snapshot>, now: &'a Snapshot) -> impl Iterator<Item = &'a Alarm> {
    now.alarms.iter().filter(move |alarm| !earlier.is_some_and(|then| then.alarms.contains(alarm)))
}

impl CellEvent {
    fn new((kind, own): (&EventKind, u16), cell: &str, severity: u16, message: &str, values: Vec<Variant>) -> Self {
        let base = BaseEventType {
            event_id: ByteString::from(Guid::new().to_bytes().to_vec()),
            event_type: kind.node(own),
            source_node: super::nodes::cell_node(own),
            source_name: cell.into(),
            time: DateTime::now(),
            receive_time: DateTime::now(),
            message: LocalizedText::new("en", message),
            severity,
            ..BaseEventType::default()
        };
        Self { base, own, fields: kind.fields.iter().map(|(name, _)| *name).zip(values).collect() }
    }
}

impl Event for CellEvent {
    fn get_field(
        &self,
        _type_definition_id: &NodeId,
        attribute_id: AttributeId,
        index_range: &NumericRange,
        browse_path: &[QualifiedName],
    ) -> Variant {
        self.get_value(attribute_id, index_range, browse_path)
    }

    fn time(&self) -> &DateTime {
        &self.base.time
    }

    fn event_type_id(&self) -> &NodeId {
        &self.base.event_type
    }
}

impl EventField for CellEvent {
    fn get_value(&self, attribute_id: AttributeId, index_range: &NumericRange, path: &[QualifiedName]) -> Variant {
        match path {
            [name] if name.namespace_index == self.own && attribute_id == AttributeId::Value => {
                let field = self.fields.iter().find(|(field, _)| *field == name.name.as_ref());
                field.map_or(Variant::Empty, |(_, value)| value.clone())
            }
            _ => self.base.get_value(attribute_id, index_range, path),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn on(run: &str, cycles: u32) -> CellStatus {
        let row = |cycle| CycleRow {
            cycle,
            pv_um: 3.0,
            judged_pv_um: Some(2.0),
            rms_um: 1.0,
            judged_rms_um: None,
            points: 9,
            outliers: 0,
            level_um: 0.0,
        };
        let snapshot = Snapshot { cycles: (1..=cycles).map(row).collect(), ..Snapshot::default() };
        let run_status = RunStatus::Active { run: run.into(), snapshot: Box::new(snapshot) };
        CellStatus { run_status, ..CellStatus::default() }
    }

    fn cycles(before: &CellStatus, now: &CellStatus) -> Vec<Variant> {
        cycles_since([before, before], now)
    }

    fn cycles_since(before: [&CellStatus; 2], now: &CellStatus) -> Vec<Variant> {
        let name = [QualifiedName::new(2, "Cycle")];
        let now = TimedStatus { status: now.clone(), at_ms: 0 };
        let events = events_between(before, &now, 2, "cell-1");
        events.iter().map(|event| event.get_value(AttributeId::Value, &NumericRange::None, &name)).collect()
    }

    #[test]
    fn cycle_events_once_per_run() {
        assert_eq!(cycles(&on("a", 1), &on("a", 3)), [Variant::UInt32(2), Variant::UInt32(3)]);
        assert!(cycles(&on("a", 3), &on("a", 3)).is_empty());
        assert_eq!(cycles(&on("a", 3), &on("b", 1)), [Variant::UInt32(1)]);
        assert_eq!(cycles(&CellStatus::default(), &on("b", 1)), [Variant::UInt32(1)]);
        let gone = CellStatus {
            run_status: RunStatus::ProgramGone { run: "a".into(), machines_within: false },
            ..CellStatus::default()
        };
        assert!(cycles_since([&gone, &on("a", 2)], &on("a", 2)).is_empty(), "it was left, and is gone on with");
        // A cycle that was measured again has other results.
        let mut again = on("a", 1);
        let RunStatus::Active { snapshot, .. } = &mut again.run_status else { unreachable!() };
        snapshot.cycles[0].pv_um = 2.5;
        assert_eq!(cycles(&on("a", 1), &again), [Variant::UInt32(1)]);
    }
}
