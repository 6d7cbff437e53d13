//! Notification: what one event of a run tells a receiver.

use regrind_document::schema_of;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::settings::EventKind;

/// Notification of one event of a run. It is the body of a request to a webhook. What the record does not tell is null.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Notification {
    /// Version of this form.
    pub version: u32,
    /// Identity of the event: the run and the number of its record. It is the same in each delivery, so a receiver can
    /// drop doubles. Also the header `webhook-id`.
    pub id: String,
    /// Kind of the event.
    pub event: EventKind,
    /// Time of the record, RFC 3339 in UTC.
    pub time: String,
    /// Event in a sentence for people. Begins with SIMULATION if any machine of the cell is simulated.
    pub text: String,
    /// Name of the cell.
    pub cell: String,
    /// True if any machine of the cell is simulated; null if the record does not tell it.
    pub simulation: Option<bool>,
    /// Name of the run.
    pub run: String,
    /// Number of the record of the event in the run.
    pub record: u64,
    /// Name of the part.
    pub part: Option<String>,
    /// Serial number of the part.
    pub serial: Option<String>,
    /// Number of the cycle; 0 before the first.
    pub cycle: u32,
    /// Phase of the cycle in which the cell is held.
    pub phase: Option<String>,
    /// Person who ordered the hold, the stop or the abort; null if no person did.
    pub by: Option<String>,
    /// Reason of the event, in words.
    pub reason: Option<String>,
    /// Alarm, for the event `alarm`.
    pub alarm: Option<AlarmNotice>,
    /// Judged figures of the last measured cycle, for the end of a run.
    pub figures: Option<FigureNotice>,
}

/// Alarm in a notification.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct AlarmNotice {
    /// Name of the kind of alarm, as docs/alarms.md lists them.
    pub id: String,
    /// Event, with the values of this case.
    pub what: String,
    /// Consequence of the event.
    pub consequence: String,
    /// Steps to take, in this order.
    pub remedy: Vec<String>,
    /// Role that may clear the alarm: nobody, operator or process_engineer.
    pub clears: String,
}

/// Figures of the form in a notification, in micrometres.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FigureNotice {
    /// Cycle to which the figures belong.
    pub cycle: u32,
    /// Peak to valley of the form, as it is judged.
    pub pv_um: f64,
    /// Root mean square of the form, as it is judged.
    pub rms_um: f64,
    /// Limit of PV; null if PV has no limit, or if the record does not tell it.
    pub pv_limit_um: Option<f64>,
    /// Limit of RMS; null if RMS has no limit, or if the record does not tell it.
    pub rms_limit_um: Option<f64>,
}

impl Notification {
    /// Version of the form of a notification.
    pub const VERSION: u32 = 1;

    /// Returns the identity of the event `event` of the record number `record` of the run `run`. It has only letters,
    /// digits, `-`, `_`, `%` and `:`, so it can stand in a header.
    pub fn identity(run: &str, record: u64, event: EventKind) -> String {
        let mut id = String::with_capacity(run.len() + 8);
        for byte in run.bytes() {
            match byte {
                b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'_' => id.push(byte.into()),
                _ => id.push_str(&format!("%{byte:02X}")),
            }
        }
        // Nobody recorded that the program has gone: the event belongs to the last record.
        let more = if event == EventKind::Interrupted { ":interrupted" } else { "" };
        format!("{id}:{record}{more}")
    }
}

/// Returns the JSON schema of a notification.
pub fn notification_schema() -> Value {
    let mut schema = schema_of::<Notification>();
    // The settings have no null; here null is the unknown.
    let Some(properties) = schema["properties"].as_object_mut() else { return schema };
    for name in ["simulation", "part", "serial", "phase", "by", "reason", "alarm", "figures"] {
        if let Some(property) = properties.get_mut(name) {
            or_null(property);
        }
    }
    if let Some(figures) = properties.get_mut("figures") {
        for of in figures["anyOf"].as_array_mut().into_iter().flatten() {
            for name in ["pv_limit_um", "rms_limit_um"] {
                if let Some(property) = of["properties"].as_object_mut().and_then(|of| of.get_mut(name)) {
                    or_null(property);
                }
            }
        }
    }
    let names: Vec<Value> = properties.keys().map(|name| name.as_str().into()).collect();
    schema["required"] = names.into();
    schema
}

/// Lets a property of a schema also be null.
fn or_null(property: &mut Value) {
    let Some(of) = property.as_object_mut() else { return };
    let description = of.remove("description");
    let only = Value::Object(std::mem::take(of));
    of.extend(description.map(|words| ("description".to_owned(), words)));
    of.insert("anyOf".into(), Value::Array(vec![only, serde_json::json!({ "type": "null" })]));
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Returns a notification of the record number `record`.
    pub(crate) fn notification(record: u64) -> Notification {
        Notification {
            version: Notification::VERSION,
            id: Notification::identity("a-run", record, EventKind::Held),
            event: EventKind::Held,
            time: "2027-03-31T10:00:00.000Z".into(),
            text: format!("SIMULATION cell-1: record {record}"),
            cell: "cell-1".into(),
            simulation: Some(true),
            run: "a-run".into(),
            record,
            part: Some("mirror".into()),
            serial: None,
            cycle: 1,
            phase: Some("Grind".into()),
            by: Some("A. Smith".into()),
            reason: None,
            alarm: None,
            figures: None,
        }
    }

    #[test]
    fn identity_is_unique_and_fits_in_a_header() {
        let of = |run: &str, record| Notification::identity(run, record, EventKind::Held);
        assert_eq!(of("mirror-20260704T120000Z", 17), "mirror-20260704T120000Z:17");
        assert_eq!(of("a.b c\u{e9}\r\n", 1), "a%2Eb%20c%C3%A9%0D%0A:1");
        assert_ne!(of("a:1", 1), of("a", 11));
        assert_eq!(Notification::identity("a", 3, EventKind::Interrupted), "a:3:interrupted");
    }

    #[test]
    fn schema_names_every_key_and_allows_null_for_the_unknown() {
        let schema = notification_schema();
        let written = serde_json::to_value(notification(1)).unwrap();
        for (key, value) in written.as_object().unwrap() {
            let property = &schema["properties"][key];
            let has_null = property["anyOf"].as_array().is_some_and(|of| of.iter().any(|of| of["type"] == "null"));
            assert!(property.is_object() && (has_null || !value.is_null()), "{key}: {property}");
            assert!(property["description"].is_string(), "{key}");
        }
        assert_eq!(schema["required"].as_array().unwrap().len(), written.as_object().unwrap().len());
    }

    #[test]
    fn book_shows_a_notification_and_every_event() {
        let book = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/notify.md")).unwrap();
        let example = book.split("```json\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
        let read: Notification = serde_json::from_str(example).unwrap();
        let written: Value = serde_json::from_str(example).unwrap();
        assert_eq!(serde_json::to_value(&read).unwrap(), written);
        assert_eq!(read.id, Notification::identity(&read.run, read.record, read.event));
        for event in EventKind::ALL {
            assert!(book.contains(&format!("| `{event}` |")), "docs/notify.md lacks {event}");
        }
    }
}
