//! The content of records: the text of each payload, which readers of many years later rely on.
//!
//! `payloads.tsv` has one payload of each shape that runs have written, of all versions: its kind, a tab, its text.

use std::collections::BTreeSet;

use proptest::prelude::*;
use regrind_cell::{Command, Device, Ending, Event, sample_events};
use regrind_journal::{Record, RecordKind, canonical_json};
use regrind_record::{
    Answer, CommandRecord, Confirmation, Content, EventDetail, EventRecord, RunContent, RunEnd, StartIntent,
};
use serde_json::{Value, json};

const PAYLOADS: &str = include_str!("payloads.tsv");

fn payloads() -> impl Iterator<Item = (RecordKind, &'static str)> {
    PAYLOADS.lines().map(|line| {
        let (kind, payload) = line.split_once('\t').unwrap();
        (kind.parse().unwrap(), payload)
    })
}

fn read(kind: RecordKind, payload: Value) -> Content {
    Content::from_payload(kind, payload.clone()).unwrap_or_else(|error| panic!("{payload}: {error}"))
}

#[test]
fn every_payload_reads_and_writes_the_same_text() {
    let (mut kinds, mut earlier) = (Vec::new(), Vec::new());
    for (kind, text) in payloads() {
        let value: Value = serde_json::from_str(text).unwrap();
        assert_eq!(canonical_json(&value), text, "the sample is not in its canonical form");
        let content = read(kind, value);
        assert!(!matches!(content, Content::Unknown(_)), "{text}");
        assert_eq!(content.kind(), kind, "{text}");
        let written = content.payload();
        if canonical_json(&written) != text {
            assert!(keeps_all(&written, &serde_json::from_str(text).unwrap()), "{text}\n{written}");
            earlier.push(text);
        }
        kinds.push(kind);
    }
    for kind in RecordKind::ALL {
        assert!(kinds.contains(&kind), "no sample of {kind:?}");
    }
    // Later versions added keys to the start of a run, and to nothing else.
    assert_eq!(earlier.len(), 7);
    assert!(earlier.iter().all(|text| text.starts_with("{\"content\":")), "{earlier:?}");
}

/// Returns true if `written` has everything that `recorded` has, and besides that only keys with null.
fn keeps_all(written: &Value, recorded: &Value) -> bool {
    match (written, recorded) {
        (Value::Object(written), Value::Object(recorded)) => {
            recorded.iter().all(|(key, value)| written.get(key).is_some_and(|written| keeps_all(written, value)))
                && written.iter().all(|(key, value)| recorded.contains_key(key) || value.is_null())
        }
        (written, recorded) => written == recorded,
    }
}

#[test]
fn events_and_commands_share_no_key_with_what_the_record_adds() {
    for cycle in 1..4 {
        for event in sample_events(cycle) {
            let alone = serde_json::to_value(&event).unwrap();
            assert!(alone.get("detail").is_none(), "{alone}");
            let plain = Content::Event(Box::new(EventRecord { event: event.clone(), detail: None }));
            assert_eq!(plain.payload(), alone);
            assert_eq!(read(RecordKind::Event, alone.clone()).payload(), alone);
            for detail in details() {
                let content =
                    Content::Event(Box::new(EventRecord { event: event.clone(), detail: Some(detail.clone()) }));
                let payload = content.payload();
                assert_eq!(payload["detail"], serde_json::to_value(&detail).unwrap());
                assert_eq!(read(RecordKind::Event, payload.clone()).payload(), payload);
                let Content::Event(back) = read(RecordKind::Event, payload) else { panic!() };
                assert_eq!(back.detail, Some(detail));
            }
        }
    }
    let commands: Vec<Value> = payloads()
        .filter_map(|(_, text)| serde_json::from_str::<Value>(text).ok())
        .filter(|value| value.get("command").is_some())
        .collect();
    let names: BTreeSet<&str> = commands.iter().map(|value| value["command"].as_str().unwrap()).collect();
    for command in every_command() {
        let alone = serde_json::to_value(&command).unwrap();
        assert!(alone.get("intent").is_none(), "{alone}");
        let content = Content::Command(Box::new(CommandRecord::new(command.clone(), [Some(intent()), None])));
        let mut payload = content.payload();
        assert_eq!(read(content.kind(), payload.clone()), content);
        let expected = match &command {
            Command::StartMachine { device: Device::Cmm, .. } => Some(serde_json::to_value(intent()).unwrap()),
            Command::StartMachine { .. } => Some(Value::Null),
            _ => None,
        };
        assert_eq!(payload.as_object_mut().unwrap().remove("intent"), expected);
        assert_eq!(payload, alone);
    }
    assert!(names.len() >= 22, "{names:?}");
}

fn intent() -> StartIntent {
    StartIntent { job: 7, cycle: 2, digest: 3_735_928_559, start_sequence: 9, token: 0, boot_id: 4_294_967_295 }
}

fn details() -> Vec<EventDetail> {
    vec![
        EventDetail::Preparation(intent()),
        EventDetail::Machine { name: "grinder".into(), address: "127.0.0.1:502".into() },
        EventDetail::Payload { digest: "deadbeef".into() },
        EventDetail::Start { start_sequence: 9 },
        EventDetail::Other(json!({ "later": [1, 2.5, null] })),
    ]
}

/// Returns one command of each kind, with each form of its fields.
fn every_command() -> Vec<Command> {
    let mut commands = vec![Command::AskToLoad];
    for cycle in [0, 3, u32::MAX] {
        commands.extend([
            Command::LoadPass { cycle },
            Command::LoadPlan { cycle },
            Command::Collect { cycle },
            Command::Qualify { cycle },
            Command::Register { cycle },
            Command::Compensate { cycle },
        ]);
        for device in Device::BOTH {
            commands.extend([
                Command::Connect { device },
                Command::VerifyClear { device },
                Command::AskWhetherClear { device },
                Command::Prepare { device, cycle },
                Command::StartMachine { device, cycle },
                Command::HoldMachine { device },
                Command::ResumeMachine { device },
                Command::StopMachine { device },
                Command::AbortMachine { device },
                Command::ClearMachine { device },
                Command::Reconcile { device, cycle },
                Command::Acknowledge { device },
            ]);
        }
    }
    // Announcements, alarms, refusals and endings are in the samples.
    let told =
        payloads().filter_map(|(kind, text)| (kind == RecordKind::Note).then(|| serde_json::from_str(text).ok())?);
    commands.extend(told);
    commands
}

#[test]
fn contents_of_earlier_versions_are_read() {
    // Names of keys that have changed, NaN as null, and missing keys.
    let event = json!({ "event": "condition_back", "device": "grinder", "condition": "temperature" });
    assert!(matches!(read(RecordKind::Event, event), Content::Event(_)));
    let event = json!({ "event": "qualified", "cycle": 1, "radius_error_mm": null });
    let Content::Event(record) = read(RecordKind::Event, event) else { panic!() };
    assert!(matches!(record.event, Event::Qualified { radius_error_mm, .. } if radius_error_mm.is_nan()));
    let note = json!({ "transfer": { "points": 12, "seconds": 0.5, "ms_per_point": 41.6 } });
    let Content::Transfer(note) = read(RecordKind::Note, note) else { panic!() };
    assert_eq!((note.transfer.points, note.transfer.coordinates), (12, None));
    let note = json!({ "confirmed": "done", "device": "grinder", "map": "1f2e" });
    let done = Confirmation::Done { device: Device::Grinder, map: Some("1f2e".into()), file: None };
    assert_eq!(read(RecordKind::Note, note), Content::Confirmation(done));
    // The ending alone, as a reader has always accepted it.
    let end = json!({ "ending": { "ending": "accepted", "cycle": 2, "reason": "within" } });
    let Content::End(end) = read(RecordKind::End, end) else { panic!() };
    assert!(matches!(end.ending, RunEnd::Bare(Ending::Accepted { cycle: 2, .. })));
    // A row of figures that cannot be read costs no other row.
    let row = json!({ "cycle": 1, "pv_um": 2.0, "rms_um": 0.5, "points": 9, "outliers": 0, "level_um": 1.0 });
    let end = json!({ "ending": { "simulation": true, "ending": { "ending": "accepted", "cycle": 2, "reason": "" }, "cycles": [{}, row] } });
    let Content::End(end) = read(RecordKind::End, end) else { panic!() };
    let RunEnd::Part(part) = &end.ending else { panic!("{end:?}") };
    assert_eq!((part.cycles.len(), part.cycles[0].cycle), (1, 1));
}

#[test]
fn begin_without_known_fields_is_read_field_by_field() {
    for (content, is_part) in
        [(json!(null), false), (json!("x"), false), (json!({}), true), (json!({ "job": "seven" }), true)]
    {
        let begin = json!({ "run": "r", "simulation": "yes", "first_command_id": -1, "content": content });
        let Content::Begin(begin) = read(RecordKind::Begin, begin) else { panic!() };
        assert_eq!((begin.run.as_deref(), begin.simulation, begin.first_command_id), (Some("r"), None, None));
        assert_eq!(begin.content.part().is_some(), is_part);
        assert!(begin.content.part().is_none_or(|part| part.job.is_none() && part.plan.is_missing()));
        assert_eq!(begin.content.place(), None);
    }
    let begins = payloads().filter(|(kind, _)| *kind == RecordKind::Begin);
    let plans: Vec<_> = begins
        .filter_map(|(kind, text)| match read(kind, serde_json::from_str(text).unwrap()) {
            Content::Begin(begin) => begin.content.part().map(|part| part.plan.clone()),
            _ => None,
        })
        .filter(|plan| !plan.is_missing())
        .collect();
    assert!(plans.len() > 5 && plans.iter().all(|plan| plan.tolerance().is_some_and(|limits| limits.pv_mm > 0.0)));
    let begin = json!({ "content": { "recover": true, "cell": "cell.toml", "number": 3, "before": null } });
    let Content::Begin(begin) = read(RecordKind::Begin, begin) else { panic!() };
    assert!(begin.content.is_recovery());
    assert_eq!(begin.content.place(), Some((3, None)));
    assert!(matches!(begin.content, RunContent::Recovery(_)));
}

#[test]
fn unknown_contents_stay_as_they_are_and_false_ones_are_errors() {
    for kind in [RecordKind::Note, RecordKind::Intent, RecordKind::Outcome] {
        for payload in [json!({}), json!({ "later": 1 }), json!(null), json!("text"), json!([1])] {
            assert_eq!(read(kind, payload.clone()), Content::Unknown(payload));
        }
    }
    for (kind, payload) in [
        (RecordKind::Event, json!({ "event": "no such event" })),
        (RecordKind::Event, json!({ "device": "cmm" })),
        (RecordKind::Intent, json!({ "command": "no such command" })),
        (RecordKind::Intent, json!({ "command": 7 })),
        (RecordKind::Note, json!({ "confirmed": "perhaps", "device": "cmm" })),
        (RecordKind::Note, json!({ "confirmed": "still" })),
        (RecordKind::Note, json!({ "transfer": { "points": 1, "seconds": 1.0, "coordinates": "sideways" } })),
        (RecordKind::Note, json!({ "pass_record": "far" })),
        (RecordKind::Artefact, json!({ "name": "a" })),
        (RecordKind::Seal, json!({})),
    ] {
        assert!(Content::from_payload(kind, payload.clone()).is_err(), "{payload}");
    }
}

#[test]
fn unreadable_figure_of_a_pass_costs_no_other() {
    let Content::Pass(pass) =
        read(RecordKind::Note, json!({ "pass_record": { "path_mm": "far", "wheel_radius_mm": 12.5 } }))
    else {
        panic!()
    };
    assert_eq!((pass.pass_record.path_mm, pass.pass_record.wheel_radius_mm), (None, Some(12.5)));
}

#[test]
fn answers_have_one_key() {
    let event = Content::Answer(Answer::Event { event: "cleared".into() });
    assert_eq!(canonical_json(&event.payload()), r#"{"event":"cleared"}"#);
    let found = Content::Answer(Answer::Found { found: "idle".into() });
    assert_eq!(canonical_json(&found.payload()), r#"{"found":"idle"}"#);
}

#[test]
fn record_of_any_text_is_read_or_refused() {
    let record = |payload: &str| Record {
        seq: 1,
        utc: String::new(),
        boot_id: String::new(),
        mono_ns: 0,
        actor: String::new(),
        station: String::new(),
        kind: RecordKind::Event,
        part: String::new(),
        cycle: 0,
        command_id: None,
        reason: String::new(),
        payload: payload.to_owned(),
        prev_hash: String::new(),
        hash: String::new(),
    };
    assert!(Content::read(&record("")).is_err());
    assert!(Content::read(&record("{")).is_err());
    assert!(Content::read(&record(r#"{"event":"control_back"}"#)).is_ok());
}

/// Adds the keys of `value` and of everything in it to `keys`.
fn add_keys<'a>(value: &'a Value, keys: &mut BTreeSet<&'a str>) {
    match value {
        Value::Object(members) => members.iter().for_each(|(key, value)| {
            keys.insert(key);
            // The plan, and runs of other cells, are data of their own.
            if !["plan", "taught_by"].contains(&key.as_str()) {
                add_keys(value, keys);
            }
        }),
        Value::Array(items) => items.iter().for_each(|item| add_keys(item, keys)),
        _ => {}
    }
}

#[test]
fn document_names_every_key() {
    let document = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/journal.md")).unwrap();
    let kinds = &document[document.find("## Kinds").unwrap()..document.find("## The anchor").unwrap()];
    let values: Vec<Value> = payloads().map(|(_, text)| serde_json::from_str(text).unwrap()).collect();
    let mut keys = BTreeSet::new();
    for value in &values {
        match (value.get("event").filter(|_| value.get("detail").is_none()), value.get("command")) {
            // The data of events and commands are those of the cell.
            (Some(_), _) => drop(keys.insert("event")),
            (None, Some(_)) => add_keys(value.get("intent").unwrap_or(&Value::Null), &mut keys),
            (None, None) if value.get("detail").is_some() => add_keys(&value["detail"], &mut keys),
            (None, None) => add_keys(value, &mut keys),
        }
    }
    assert!(keys.len() > 70, "{}", keys.len());
    let missing: Vec<&&str> = keys.iter().filter(|key| !kinds.contains(&format!("`{key}`"))).collect();
    assert!(missing.is_empty(), "docs/journal.md does not name {missing:?}");
}

/// Replaces the value at a place within `value`, or removes it if `with` is `None`. `way` chooses the place.
fn damage(value: &mut Value, way: &[prop::sample::Index], with: Option<Value>) {
    let (place, rest) = match way {
        [place, rest @ ..] => (place, rest),
        [] => return,
    };
    match value {
        Value::Object(members) if !members.is_empty() => {
            let key = members.keys().nth(place.index(members.len())).unwrap().clone();
            match (rest, with) {
                ([], Some(with)) => drop(members.insert(key, with)),
                ([], None) => drop(members.remove(&key)),
                (rest, with) => damage(members.get_mut(&key).unwrap(), rest, with),
            }
        }
        Value::Array(items) if !items.is_empty() => {
            let at = place.index(items.len());
            damage(&mut items[at], rest, with);
        }
        _ => {}
    }
}

/// Returns a value of any kind that a payload can have.
fn any_value() -> impl Strategy<Value = Option<Value>> {
    prop_oneof![
        Just(None),
        Just(Some(Value::Null)),
        any::<bool>().prop_map(|value| Some(json!(value))),
        any::<i64>().prop_map(|value| Some(json!(value))),
        any::<f64>().prop_map(|value| Some(json!(value))),
        "[a-z_]{0,12}".prop_map(|value| Some(json!(value))),
        Just(Some(json!([]))),
        Just(Some(json!({}))),
        Just(Some(json!([[1, 2], { "a": null }]))),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, failure_persistence: None, ..ProptestConfig::default() })]

    /// A damaged payload is refused, or read to a content that is written and read again to the same payload.
    #[test]
    fn damaged_payloads_are_refused_or_stable(
        which in any::<prop::sample::Index>(),
        way in prop::collection::vec(any::<prop::sample::Index>(), 1..5),
        with in any_value(),
        as_kind in prop::option::weighted(0.1, 0..RecordKind::ALL.len()),
    ) {
        let samples: Vec<_> = payloads().collect();
        let (kind, text) = samples[which.index(samples.len())];
        let kind = as_kind.map_or(kind, |k| RecordKind::ALL[k]);
        let mut value: Value = serde_json::from_str(text).unwrap();
        damage(&mut value, &way, with);
        let Ok(content) = Content::from_payload(kind, value) else { return Ok(()) };
        let written = content.payload();
        let again = Content::from_payload(kind, written.clone());
        prop_assert!(again.is_ok(), "{written}");
        prop_assert_eq!(again.unwrap().payload(), written);
    }
}
