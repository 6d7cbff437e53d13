//! State of a measurement, and its change by each line and each confirmation of a person.
//!
//! A refused line leads to HOLDING, because its touch may be lost. A person stops the machine, confirms that it does
//! not move, and continues with the remaining targets. Valid lines count until then, because the person or program that
//! leads the probe learns of a hold late.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use data_encoding::HEXLOWER;
use serde::Serialize;
use tokio::time::Instant;

use super::line_splitter::ReceivedLine;
use super::protocol::{LineError, LineParser};
use super::target_list::{TargetList, TouchAssignment};
use crate::error::DeviceError;
use crate::handshake::{Job, MachineState, Outcome};
use regrind_formats::JsonlAppender;

/// Number of refused lines kept for a person: the last ones.
const MAX_REFUSED_SHOWN: usize = 4;

/// Parameters of the check of received lines.
#[derive(Clone, Debug)]
pub(super) struct LineRules {
    pub(super) parser: LineParser,
    /// Required angle of the rotary table and its tolerance, in degrees.
    pub(super) rotary_deg: [f64; 2],
    /// Beginnings of lines that are ignored.
    pub(super) ignored_prefixes: Vec<String>,
}

/// Requested measurement, current or finished.
#[derive(Debug)]
pub(super) struct RequestedMeasurement {
    pub(super) job: Job,
    pub(super) sequence: u32,
    pub(super) plan_identity: [u8; 32],
    pub(super) list: TargetList,
    /// File that stores each received line.
    pub(super) line_log: Option<JsonlAppender>,
    pub(super) begun: Instant,
    pub(super) last_line: Instant,
    /// Number of lines since the measurement began.
    lines: u32,
    duplicate_lines: u32,
    refused_lines: VecDeque<String>,
}

/// State that the driver and the listening thread share.
#[derive(Debug)]
pub(super) struct MeasurementSession {
    rules: LineRules,
    pub(super) state: MachineState,
    pub(super) outcome: Outcome,
    pub(super) measurement: Option<RequestedMeasurement>,
    /// True if the probe is clear of the part, as a person confirmed or by the time in the cell file; `None` if
    /// unknown.
    pub(super) clear_of_part: Option<bool>,
    pub(super) duration: Duration,
    /// Error that ended the connection.
    pub(super) link_error: Option<DeviceError>,
    /// Number of lines that came without a request, and the last of them.
    unrequested_lines: (u32, String),
}

/// Record of a received line in its file.
#[derive(Serialize)]
struct LoggedLine<'a> {
    /// Seconds since the measurement began.
    at_s: f64,
    line: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    target: Option<u32>,
    #[serde(rename = "passed_over", skip_serializing_if = "Option::is_none")]
    ignored: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    refused: Option<&'a str>,
}

/// Locks the state `session`, which the driver and the listening thread share, and returns access to it. A panic in
/// another thread does not make this state invalid, so a poisoned lock is ignored.
pub(super) fn locked(session: &Mutex<MeasurementSession>) -> MutexGuard<'_, MeasurementSession> {
    session.lock().unwrap_or_else(PoisonError::into_inner)
}

impl RequestedMeasurement {
    pub(super) fn new(
        (job, sequence): (Job, u32),
        plan_identity: [u8; 32],
        list: TargetList,
        kept: Option<JsonlAppender>,
    ) -> Self {
        let (now, refused) = (Instant::now(), VecDeque::new());
        Self {
            job,
            sequence,
            plan_identity,
            list,
            line_log: kept,
            begun: now,
            last_line: now,
            lines: 0,
            duplicate_lines: 0,
            refused_lines: refused,
        }
    }

    fn log_line(&self, line: &str, target: Option<u32>, passed_over: Option<&str>, refused: Option<&str>) {
        let at_s = self.begun.elapsed().as_secs_f64();
        if let Some(kept) = &self.line_log {
            kept.append(&LoggedLine { at_s, line, target, ignored: passed_over, refused });
        }
    }

    fn refuse(&mut self, line: &str, reason: &str) {
        self.log_line(line, None, None, Some(reason));
        let shown: String = line.chars().take(80).collect();
        self.refused_lines.push_back(format!("REFUSED line {} of the measurement, {shown:?}: {reason}", self.lines));
        if self.refused_lines.len() > MAX_REFUSED_SHOWN {
            self.refused_lines.pop_front();
        }
    }
}

impl MeasurementSession {
    pub(super) fn new(judging: LineRules) -> Self {
        Self {
            rules: judging,
            state: MachineState::Idle,
            outcome: Outcome::None,
            measurement: None,
            clear_of_part: None,
            duration: Duration::ZERO,
            link_error: None,
            unrequested_lines: (0, String::new()),
        }
    }

    /// Processes `gathered`, the next data from the machine. If the data are a line, evaluates the line as a touch. If
    /// the data exceed the maximum length of a line without a line end, rejects them.
    pub(super) fn process(&mut self, gathered: ReceivedLine) {
        match gathered {
            ReceivedLine::Line(line) => self.line(&line),
            ReceivedLine::Endless(text) => {
                self.reject_line(&text, "the line has no line end: check baud rate, parity and the cable")
            }
        }
    }

    /// Rejects the incomplete line `text`, whose end did not arrive in time. A measurement in the state EXECUTE then
    /// changes to HOLDING, because the touch in this line may be lost.
    pub(super) fn cut_short(&mut self, text: &str) {
        self.reject_line(text, "the line is incomplete, because its end did not arrive: touch this point again");
    }

    fn line(&mut self, line: &str) {
        let begins =
            self.rules.ignored_prefixes.iter().any(|beginning| line.trim_start().starts_with(beginning.as_str()));
        if begins {
            if let Some(asked) = self.measurement.as_mut().filter(|_| self.state.is_moving()) {
                asked.lines += 1;
                asked.log_line(line, None, Some("the line begins with a prefix that the cell file ignores"), None);
            }
            return;
        }
        let judging = &self.rules;
        let read = judging.parser.read(line).map_err(|flaw| format!("{flaw}; touch this point again"));
        let hit = match read {
            Ok(hit) => hit,
            Err(reason) => return self.reject_line(line, &reason),
        };
        if let Some(stands_deg) = hit.rotary_deg
            && !(stands_deg - judging.rotary_deg[0]).abs().le(&judging.rotary_deg[1])
        {
            let [wanted_deg, within_deg] = judging.rotary_deg;
            let reason = format!(
                "the rotary table is at {stands_deg}°; {wanted_deg}° ± {within_deg}° is required: turn the table \
                 back, and touch the point again"
            );
            return self.reject_line(line, &reason);
        }
        let Some(asked) = self.measurement.as_mut().filter(|_| self.state.is_moving()) else {
            return self.reject_line(line, "");
        };
        asked.lines += 1;
        asked.last_line = Instant::now();
        match asked.list.assign(line, hit.position_mm, asked.begun.elapsed()) {
            Ok(TouchAssignment::First(index) | TouchAssignment::Repeated(index)) => {
                asked.log_line(line, Some(index), None, None)
            }
            Ok(TouchAssignment::DuplicateLine) => {
                asked.duplicate_lines += 1;
                asked.log_line(line, None, Some("the line repeats the line before"), None);
            }
            Err(reason) => self.refuse(line, &reason),
        }
    }

    /// Processes a line that cannot be used as a touch. `reason` is the reason, for the list of refused lines. The
    /// effect depends on the state:
    ///
    /// - While the machine may be moving, lists the line as refused. A measurement in the state EXECUTE changes to
    ///   HOLDING.
    /// - In the state HELD, lists the line as refused because it arrived too late.
    /// - In any other case, only counts the line and stores it as the last unrequested one.
    fn reject_line(&mut self, line: &str, reason: &str) {
        match (&mut self.measurement, self.state) {
            (Some(asked), state) if state.is_moving() => {
                asked.lines += 1;
                asked.last_line = Instant::now();
                self.refuse(line, reason);
            }
            (Some(asked), MachineState::Held) => {
                asked.lines += 1;
                let held = "the line arrived after `regrind confirm still`: resume, then touch this point again";
                asked.refuse(line, held);
            }
            _ => self.unrequested_lines = (self.unrequested_lines.0 + 1, line.chars().take(80).collect()),
        }
    }

    fn refuse(&mut self, line: &str, reason: &str) {
        if let Some(asked) = &mut self.measurement {
            asked.refuse(line, reason);
        }
        if self.state == MachineState::Execute {
            self.state = MachineState::Holding;
        }
    }

    /// Records that the connection was lost with `error`. A measurement in the state EXECUTE changes to HOLDING,
    /// because later touches cannot be received. `begun` is the incomplete last line, or `None`; this line is rejected.
    pub(super) fn link_lost(&mut self, error: DeviceError, begun: Option<String>) {
        if let Some(text) = begun {
            self.cut_short(&text);
        }
        if let Some(asked) = self.measurement.as_mut().filter(|_| self.state.is_moving()) {
            asked.refuse("", "the connection was lost; later touches did not arrive: touch the targets still listed");
            self.state = if self.state == MachineState::Execute { MachineState::Holding } else { self.state };
        }
        self.link_error = Some(error);
    }

    /// Ends the running measurement if every target is touched and the time `clear_after` has passed since the last
    /// line. The probe needs this time to move clear of the part. Then the state is COMPLETE and the probe counts as
    /// clear of the part. Does nothing if `clear_after` is `None` or the state is not EXECUTE.
    pub(super) fn finish_if_clear(&mut self, clear_after: Option<Duration>) {
        let (Some(asked), Some(clear_after), MachineState::Execute) = (&self.measurement, clear_after, self.state)
        else {
            return;
        };
        if asked.list.is_complete() && asked.last_line.elapsed() >= clear_after {
            self.finish(Outcome::Complete);
            self.clear_of_part = Some(true);
        }
    }

    pub(super) fn finish(&mut self, outcome: Outcome) {
        (self.state, self.outcome) = (MachineState::Complete, outcome);
        self.duration = self.measurement.as_ref().map_or(Duration::ZERO, |asked| asked.begun.elapsed());
    }

    pub(super) fn forget(&mut self) {
        (self.measurement, self.outcome) = (None, Outcome::None);
    }

    // ---- words ------------------------------------------------------------------------------------------------------------------------

    /// Returns notes for the operator about received lines that were not used:
    ///
    /// - The last refused lines, at most four.
    /// - The number of lines that arrived twice, if all targets are touched.
    /// - The last line that arrived while no measurement was requested, with the line formats that match it.
    ///
    /// Returns an empty list if there are no such lines.
    pub(super) fn refusals(&self) -> Vec<String> {
        let asked = self.measurement.as_ref();
        let refused = asked.into_iter().flat_map(|asked| asked.refused_lines.iter().cloned());
        let duplicate_lines = asked.filter(|asked| asked.duplicate_lines > 0 && asked.list.is_complete());
        let duplicate_lines =
            duplicate_lines.map(|asked| format!("{} lines arrived twice and were used once", asked.duplicate_lines));
        let (count, last) = &self.unrequested_lines;
        let unrequested_lines = (*count > 0).then(|| {
            let fitting = LineParser::fitting(last);
            let fits = match &fitting[..] {
                [] => "this line matches none of the eight formats".to_owned(),
                several => {
                    let formats: Vec<String> = several.iter().map(ToString::to_string).collect();
                    format!("this line matches {}", formats.join("; or "))
                }
            };
            let ours = &self.rules.parser;
            let (last, read) = (LineError::whole_line(format!("{last:?}")), ours.read(last).err());
            let read = read.map_or("this format accepts the line".to_owned(), |flaw| {
                format!("this format rejects the line: {flaw}")
            });
            format!(
                "lines arrived while no measurement was requested; these lines were not used. The last line is {last}; \
                 {fits}. The format in the cell file is `{ours}`; {read}"
            )
        });
        refused.chain(duplicate_lines).chain(unrequested_lines).collect()
    }

    /// Returns a text with the number of targets that are not touched yet, and the first 12 of them. Returns an empty
    /// text without a measurement.
    pub(super) fn remaining_targets(&self) -> String {
        const SOME: usize = 12;
        let Some(asked) = &self.measurement else { return String::new() };
        let left: Vec<u32> = asked.list.remaining().collect();
        let first: Vec<String> = left.iter().take(SOME).map(ToString::to_string).collect();
        let more = if left.len() > SOME { ", ..." } else { "" };
        match left.len() {
            0 => "no targets remain".to_owned(),
            count => format!("{count} targets remain: {}{more}", first.join(", ")),
        }
    }

    pub(super) fn plan_digits(&self) -> String {
        self.measurement.as_ref().map_or(String::new(), |asked| HEXLOWER.encode(&asked.plan_identity[..4]))
    }
}

#[cfg(test)]
mod tests {
    use super::super::target_list::tests::{RULES, plan};
    use super::*;
    use regrind_formats::result::Coordinates;

    fn new_session(targets: u32) -> MeasurementSession {
        let judging = LineRules {
            parser: LineParser::default(),
            rotary_deg: [0.0, 0.05],
            ignored_prefixes: vec!["PROBE".to_owned()],
        };
        let mut session = MeasurementSession::new(judging);
        let list = TargetList::new(&plan(targets), Coordinates::Centres, false, RULES);
        let job = Job { job: 7, cycle: 1, digest: 1 };
        session.measurement = Some(RequestedMeasurement::new((job, 1), [0; 32], list, None));
        session.state = MachineState::Execute;
        session
    }

    fn hear(session: &mut MeasurementSession, line: &str) {
        session.process(ReceivedLine::Line(line.to_owned()));
    }

    fn touched(session: &MeasurementSession) -> usize {
        session.measurement.as_ref().unwrap().list.progress().0
    }

    #[test]
    fn refused_line_holds_session() {
        let mut session = new_session(4);
        hear(&mut session, "0.000,0.000,1.500");
        hear(&mut session, "PROBE 1");
        assert_eq!((session.state, touched(&session)), (MachineState::Execute, 1));
        hear(&mut session, "5.000,0.000,1.50010.000,0.000,1.500");
        assert_eq!((session.state, touched(&session)), (MachineState::Holding, 1));
        let refusals = session.refusals();
        assert!(refusals[0].starts_with("REFUSED line 3 ") && refusals[0].contains("two lines are joined"));
        // The person who leads the probe does not know of the hold yet.
        hear(&mut session, "15.000,0.000,1.500");
        assert_eq!((session.state, touched(&session)), (MachineState::Holding, 2));
        let remaining = session.remaining_targets();
        assert!(remaining.contains("2 targets") && remaining.contains("101, 102"), "{remaining}");
        // A machine at rest touches nothing.
        session.state = MachineState::Held;
        hear(&mut session, "5.000,0.000,1.500");
        assert_eq!((session.state, touched(&session)), (MachineState::Held, 2));
        assert!(session.refusals()[1].contains("confirm still"));
    }

    #[test]
    fn session_completes_when_probe_clear() {
        let mut session = new_session(1);
        session.finish_if_clear(Some(Duration::ZERO));
        assert_eq!(session.state, MachineState::Execute);
        hear(&mut session, "0.000,0.000,1.500");
        session.finish_if_clear(None);
        session.finish_if_clear(Some(Duration::from_secs(3600)));
        assert_eq!((session.state, session.clear_of_part), (MachineState::Execute, None));
        session.finish_if_clear(Some(Duration::ZERO));
        assert_eq!(
            (session.state, session.outcome, session.clear_of_part),
            (MachineState::Complete, Outcome::Complete, Some(true))
        );
    }

    #[test]
    fn session_reports_rotary_and_stray_line() {
        let mut session = new_session(2);
        session.rules.parser.format = super::super::LineFormat::DecimalRotary;
        hear(&mut session, "0.000,0.000,1.500,0.0");
        assert_eq!((session.state, touched(&session)), (MachineState::Execute, 1));
        hear(&mut session, "5.000,0.000,1.500,245.5");
        assert_eq!((session.state, touched(&session)), (MachineState::Holding, 1));
        assert!(session.refusals()[0].contains("is at 245.5°"));
        let mut session = new_session(2);
        session.state = MachineState::Idle;
        session.measurement = None;
        hear(&mut session, "X1.0,Y2.0,Z3.0");
        let told = session.refusals().pop().unwrap();
        for piece in ["\"lettered-decimal\"", "decimals = 1", "format = \"decimal\""] {
            assert!(told.contains(piece), "{told}");
        }
    }

    #[test]
    fn link_lost_preserves_points() {
        let mut session = new_session(3);
        hear(&mut session, "0.000,0.000,1.500");
        let gone = DeviceError::Disconnected { machine: "x".into(), operation: "reading" };
        session.link_lost(gone, Some("5.000,0.0".to_owned()));
        assert_eq!((session.state, touched(&session)), (MachineState::Holding, 1));
        assert!(session.refusals()[0].contains("incomplete") && session.refusals()[1].contains("did not arrive"));
    }
}
