//! Lines of SHDR: `time|key|value`, and `time|key|level|native code|native severity|qualifier|text` for a condition. The
//! first line after a connection and the signs of life begin with `*`.

use std::collections::BTreeMap;

use jiff::Timestamp;
use regrind_cell::Role;
use regrind_document::visible_line;

use super::items::{ALARMS, ITEMS, UNAVAILABLE};
use crate::cell_status::{CellStatus, TimedStatus};

/// Returns the lines with which an adapter introduces itself.
pub(super) fn greeting() -> String {
    format!("* adapterVersion: {}\n* shdrVersion: 1.0\n", env!("CARGO_PKG_VERSION"))
}

/// Returns true if `line` is the sign of life of an agent.
pub(super) fn is_ping(line: &str) -> bool {
    line.trim() == "* PING"
}

/// Returns the answer to a sign of life. The agent sends the next one within `heartbeat_ms` milliseconds.
pub(super) fn pong(heartbeat_ms: u32) -> String {
    format!("* PONG {heartbeat_ms}\n")
}

/// Active alarm: its level and its text.
type ActiveAlarm = (&'static str, String);

/// Lines for one agent, which has the values of the lines before.
#[derive(Debug, Default)]
pub(super) struct Lines {
    /// Values that the agent has; empty before the first status.
    values: Vec<String>,
    /// Alarms that the agent has, by their native codes. `None` within if the agent has the unknown.
    alarms: Option<Option<BTreeMap<String, ActiveAlarm>>>,
}

impl Lines {
    /// Returns the lines that tell the agent what differs in `told`: all values the first time. The text is empty if
    /// nothing differs.
    pub(super) fn changed(&mut self, told: &TimedStatus) -> String {
        let TimedStatus { status, at_ms } = told;
        let time = i64::try_from(*at_ms).ok().and_then(|ms| Timestamp::from_millisecond(ms).ok()).unwrap_or_default();
        let mut text = String::new();
        let values: Vec<_> =
            ITEMS.iter().map(|item| item.value(status).map_or_else(unavailable, |text| field(&text))).collect();
        for (k, (item, value)) in ITEMS.iter().zip(&values).enumerate() {
            if self.values.get(k) != Some(value) {
                let native_code = if item.is_message() { "|" } else { "" };
                text.push_str(&format!("{time}|{}|{native_code}{value}\n", item.name));
            }
        }
        self.values = values;
        for line in self.alarm_lines(status) {
            text.push_str(&format!("{time}|{ALARMS}|{line}\n"));
        }
        text
    }

    /// Returns the fields of the lines about the alarms that differ.
    fn alarm_lines(&mut self, status: &CellStatus) -> Vec<String> {
        let now = active_alarms(status);
        let before = self.alarms.replace(now.clone());
        let Some(now) = now else {
            // The agent may know already that nothing is known.
            return if matches!(before, Some(None)) { Vec::new() } else { vec![format!("{UNAVAILABLE}||||")] };
        };
        let before = match before {
            Some(Some(before)) => before,
            // A normal condition without a native code clears all that the agent has.
            _ => {
                let lines = std::iter::once("NORMAL||||".to_owned());
                return lines.chain(now.iter().map(|(code, alarm)| raised(code, alarm))).collect();
            }
        };
        let cleared = before.keys().filter(|code| !now.contains_key(*code)).map(|code| format!("NORMAL|{code}|||"));
        let changed = now.iter().filter(|(code, alarm)| before.get(*code) != Some(alarm));
        cleared.chain(changed.map(|(code, alarm)| raised(code, alarm))).collect()
    }
}

fn unavailable() -> String {
    UNAVAILABLE.to_owned()
}

fn raised(code: &str, (level, text): &ActiveAlarm) -> String {
    format!("{level}|{code}|||{text}")
}

/// Returns the active alarms by their native codes; `None` if they are not known.
fn active_alarms(status: &CellStatus) -> Option<BTreeMap<String, ActiveAlarm>> {
    // The cell is known, and without a run it has no alarm.
    status.state()?;
    let alarms = status.snapshot().into_iter().flat_map(|now| &now.alarms);
    let active = alarms.map(|alarm| {
        let code = serde_json::to_value(alarm.id).ok();
        let code = code.and_then(|code| code.as_str().map(field)).unwrap_or_default();
        // An alarm that clears by itself needs nobody.
        let level = if alarm.cleared_by == Role::Nobody { "WARNING" } else { "FAULT" };
        (code, (level, field(&alarm.event)))
    });
    Some(active.collect())
}

/// Returns a text as the field of a line. A separator, a line feed and a quotation mark at its begin would have another
/// meaning there.
fn field(text: &str) -> String {
    let line = visible_line(&text.replace(['\r', '\n', '\t'], " ")).replace('|', "/");
    let line = line.trim();
    match line.strip_prefix('"') {
        Some(rest) => format!("'{rest}"),
        None => line.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use regrind_cell::{Alarm, AlarmId};
    use regrind_control::Snapshot;

    use super::*;
    use crate::cell_status::RunStatus;

    fn alarm(id: AlarmId, cleared_by: Role) -> Alarm {
        Alarm {
            id,
            event: "the link | is \"lost\"\nhere".into(),
            consequence: String::new(),
            remedy: Vec::new(),
            cleared_by,
        }
    }

    fn active(alarms: Vec<Alarm>, cycle: u32) -> TimedStatus {
        let snapshot = Box::new(Snapshot { alarms, cycle, ..Snapshot::default() });
        let run_status = RunStatus::Active { run: "a-run".into(), snapshot };
        TimedStatus { status: CellStatus { run_status, ..CellStatus::default() }, at_ms: 1_806_487_200_123 }
    }

    fn sent(lines: &mut Lines, status: &TimedStatus) -> Vec<String> {
        lines.changed(status).lines().map(ToOwned::to_owned).collect()
    }

    #[test]
    fn all_values_first_and_changes_afterwards() {
        let mut lines = Lines::default();
        let first = sent(&mut lines, &active(Vec::new(), 1));
        assert_eq!(first.len(), ITEMS.len() + 1, "{first:#?}");
        assert!(first.iter().all(|line| line.starts_with("2027-03-31T10:00:00.123Z|")), "{first:#?}");
        assert!(first.contains(&"2027-03-31T10:00:00.123Z|form_pv|UNAVAILABLE".to_owned()), "{first:#?}");
        assert!(sent(&mut lines, &active(Vec::new(), 1)).is_empty());
        assert_eq!(sent(&mut lines, &active(Vec::new(), 2)), ["2027-03-31T10:00:00.123Z|cycle|2"]);
    }

    #[test]
    fn alarms_are_conditions_with_native_codes() {
        let mut lines = Lines::default();
        let fields = |lines: &mut Lines, status: &TimedStatus| -> Vec<String> {
            let all = sent(lines, status).into_iter();
            all.filter_map(|line| line.split_once("|alarms|").map(|(_, fields)| fields.to_owned())).collect()
        };
        assert_eq!(fields(&mut lines, &active(Vec::new(), 1)), ["NORMAL||||"]);
        let two = vec![alarm(AlarmId::LinkLost, Role::Nobody), alarm(AlarmId::MachineFault, Role::Operator)];
        let raised =
            ["WARNING|link_lost|||the link / is \"lost\" here", "FAULT|machine_fault|||the link / is \"lost\" here"];
        assert_eq!(fields(&mut lines, &active(two.clone(), 1)), raised);
        assert_eq!(fields(&mut lines, &active(two[1..].to_vec(), 1)), ["NORMAL|link_lost|||"]);
        let gone = RunStatus::Unresponsive { run: "a-run".into() };
        let gone = TimedStatus { status: CellStatus { run_status: gone, ..CellStatus::default() }, at_ms: 0 };
        assert_eq!(fields(&mut lines, &gone), ["UNAVAILABLE||||"]);
        assert_eq!(fields(&mut lines, &gone), [""; 0]);
        assert_eq!(fields(&mut lines, &active(two[1..].to_vec(), 1)), ["NORMAL||||", raised[1]]);
    }

    #[test]
    fn texts_of_people_stay_in_their_field() {
        for (text, wanted) in [("a|b", "a/b"), ("a\r\n* PONG 1", "a  * PONG 1"), ("\"a\" b", "'a\" b"), ("  ", "")] {
            let found = field(text);
            assert!(!found.contains(['\n', '\r', '|']), "{found:?}");
            assert_eq!(found.replace("  ", " "), wanted.replace("  ", " "));
        }
    }
}
