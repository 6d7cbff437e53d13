//! Notifications of one run, from its records. The states of the cell are those of its state machine, to which the
//! recorded events are given again. A state that cannot be known is not notified.

use std::collections::VecDeque;
use std::time::Duration;

use regrind::cell::{Actor, Alarm, Cell, Command, Ending, Event, Phase, StateName, Tolerance};
use regrind::journal::{Record, RecordKind};
use regrind::record::{Content, PartEnd, RunContent, RunEnd};
use regrind::report::ending_words;
use regrind_notify::{AlarmNotice, EventKind, FigureNotice, Notification};

/// Knowledge of a run from the records that were read.
#[derive(Default)]
pub(super) struct RecordEvents {
    /// Name of the run; empty before its first record.
    pub(super) run: String,
    /// Name of the cell in the plant.
    cell_name: String,
    part: Option<String>,
    serial: Option<String>,
    simulation: Option<bool>,
    tolerance: Option<Tolerance>,
    /// True if the record is that of a recovery, which makes no part.
    pub(super) is_recovery: bool,
    /// True if the end of the run was read.
    pub(super) is_over: bool,
    /// State machine of the run; `None` if its state is not known.
    cell: Option<Cell>,
    /// Commands that followed from the last event and were not read yet.
    due: VecDeque<Command>,
    /// Person who ordered the present hold, the stop or the abort, with the reason.
    order: Option<(Actor, String)>,
    cycle: u32,
    /// Number and time of the last record.
    pub(super) last: Option<(u64, String)>,
}

impl RecordEvents {
    /// Returns a run of which no record was read. `cell_name` is the name of its cell in the plant.
    pub(super) fn new(cell_name: &str) -> Self {
        Self { cell_name: cell_name.to_owned(), ..Self::default() }
    }

    /// Returns true if the states of the cell are known from the record.
    pub(super) fn has_states(&self) -> bool {
        self.cell.is_some()
    }

    /// Adds the next record of the run. Returns the notification of its event, if it has one.
    pub(super) fn add_record(&mut self, record: &Record) -> Option<Notification> {
        self.last = Some((record.seq, record.utc.clone()));
        self.cycle = self.cycle.max(record.cycle);
        let Ok(content) = Content::read(record) else {
            if matches!(record.kind, RecordKind::Begin | RecordKind::Event | RecordKind::Intent) {
                // It decides something that this version does not know.
                self.cell = None;
            }
            return None;
        };
        match content {
            Content::Begin(begin) => {
                self.run = begin.run.unwrap_or_default();
                self.is_recovery = begin.content.is_recovery();
                self.part = begin.content.names()[0].map(ToOwned::to_owned);
                self.serial = Some(record.part.clone()).filter(|serial| !serial.is_empty());
                self.simulation = begin.simulation;
                self.begin(&begin.content);
                Some(self.notification(record, EventKind::Started, format!("the run {} has begun", self.run)))
            }
            Content::Event(event) => self.add_event(record, event.event),
            Content::Command(command) => self.add_command(record, command.command),
            Content::Reopen(_) => {
                // Decisions that the program had not recorded when it ended were not executed.
                self.due.clear();
                None
            }
            Content::End(end) => {
                self.is_over = true;
                match end.ending {
                    RunEnd::Part(end) => Some(self.end(record, &end.ending, Some(&end))),
                    RunEnd::Bare(ending) => Some(self.end(record, &ending, None)),
                    RunEnd::Recovery(_) | RunEnd::Other(_) => None,
                }
            }
            _ => None,
        }
    }

    /// Returns the notification that the program of the run has gone before the end of the run.
    pub(super) fn interrupted(&self) -> Option<Notification> {
        let (seq, utc) = self.last.clone()?;
        let words = "the program of the run has gone before the end of the run: the state of the machines is unknown; \
                     inspect them, then: regrind resume";
        let mut found = self.bare(seq, utc, EventKind::Interrupted);
        found.text = self.sentence(words);
        found.reason = Some(words.to_owned());
        Some(found)
    }

    fn begin(&mut self, content: &RunContent) {
        let plan = content.part().map(|start| &start.plan);
        self.tolerance = plan.and_then(|plan| plan.tolerance());
        self.cell = plan.and_then(|plan| plan.cell_plan()).map(Cell::new);
    }

    fn add_event(&mut self, record: &Record, event: Event) -> Option<Notification> {
        let order = match &event {
            Event::Hold { actor, reason } | Event::Stop { actor, reason } | Event::Abort { actor, reason } => {
                Some((actor.clone(), reason.clone()))
            }
            _ => None,
        };
        if !self.due.is_empty() {
            // The program would have sent a command that is not on record.
            self.cell = None;
        }
        let cell = self.cell.as_mut()?;
        let before = cell.state().name();
        self.due = cell.handle(Duration::from_nanos(record.mono_ns), event).into();
        let (state, phase) = (cell.state().name(), cell.state().phase());
        self.cycle = cell.cycle();
        if state == before {
            return None;
        }
        let is_still_followed = order.is_none() && ordered(before).is_some() && ordered(before) == ordered(state);
        self.order = if is_still_followed { self.order.take() } else { order };
        let alarms: Vec<_> = cell.alarms().map(|alarm| alarm.event.clone()).collect();
        (state == StateName::Held).then(|| self.held(record, phase, &alarms))
    }

    /// Returns the notification that the cell is held in `phase`, by the present order or with these alarms.
    fn held(&self, record: &Record, phase: Option<Phase>, alarms: &[String]) -> Notification {
        let by = self.order.as_ref().map(|(actor, reason)| (actor.name.clone(), reason.clone()));
        let reason = match by.as_ref().map(|(_, reason)| reason).filter(|reason| !reason.is_empty()) {
            Some(reason) => Some(reason.clone()),
            None => Some(alarms.join("; ")).filter(|words| !words.is_empty()),
        };
        let of = by.as_ref().map_or(String::new(), |(name, _)| format!(" by {name}"));
        let at = phase.map_or(String::new(), |phase| format!(" in {}", phase.name()));
        let why = reason.as_ref().map_or(String::new(), |reason| format!(": {reason}"));
        let mut found = self.notification(record, EventKind::Held, format!("held{at}{of}{why}"));
        found.phase = phase.map(|phase| phase.name().to_owned());
        (found.by, found.reason) = (by.map(|(name, _)| name), reason);
        found
    }

    fn add_command(&mut self, record: &Record, command: Command) -> Option<Notification> {
        let due = self.due.pop_front();
        if self.cell.is_some() && due.map(|due| due.name()) != Some(command.name()) {
            self.cell = None;
        }
        let Command::Raise(alarm) = command else { return None };
        let mut found = self.notification(record, EventKind::Alarm, format!("alarm: {}", alarm.event));
        found.reason = Some(alarm.event.clone());
        found.alarm = Some(notice(alarm));
        Some(found)
    }

    fn end(&self, record: &Record, ending: &Ending, end: Option<&PartEnd>) -> Notification {
        let (event, reason) = match ending {
            Ending::Accepted { reason, .. } => (EventKind::Accepted, reason),
            Ending::NotAccepted { reason, .. } => (EventKind::NotAccepted, reason),
            Ending::Stopped { reason, .. } => (EventKind::Stopped, reason),
            Ending::Aborted { reason, .. } => (EventKind::Aborted, reason),
        };
        let mut found = self.notification(record, event, ending_words(ending));
        found.reason = Some(reason.clone());
        if matches!(event, EventKind::Stopped | EventKind::Aborted) {
            found.by = self.order.as_ref().map(|(actor, _)| actor.name.clone());
        }
        found.figures = end.and_then(|end| end.cycles.last()).map(|row| {
            let [pv_um, rms_um] = row.judged_um();
            let limit =
                |mm: fn(&Tolerance) -> f64| self.tolerance.as_ref().map(|of| 1e3 * mm(of)).filter(|um| um.is_finite());
            FigureNotice {
                cycle: row.cycle,
                pv_um,
                rms_um,
                pv_limit_um: limit(|of| of.pv_mm),
                rms_limit_um: limit(|of| of.rms_mm),
            }
        });
        found
    }

    fn notification(&self, record: &Record, event: EventKind, words: String) -> Notification {
        Notification { text: self.sentence(&words), ..self.bare(record.seq, record.utc.clone(), event) }
    }

    /// Returns a notification without the words of its event.
    fn bare(&self, record: u64, time: String, event: EventKind) -> Notification {
        Notification {
            version: Notification::VERSION,
            id: Notification::identity(&self.run, record, event),
            event,
            time,
            text: String::new(),
            cell: self.cell_name.clone(),
            simulation: self.simulation,
            run: self.run.clone(),
            record,
            part: self.part.clone(),
            serial: self.serial.clone(),
            cycle: self.cycle,
            phase: None,
            by: None,
            reason: None,
            alarm: None,
            figures: None,
        }
    }

    /// Returns a sentence for people: the words of an event with the cell and its part.
    fn sentence(&self, words: &str) -> String {
        let mark = if self.simulation == Some(true) { "SIMULATION " } else { "" };
        let part: Vec<_> = [&self.part, &self.serial].into_iter().flatten().map(String::as_str).collect();
        let part = if part.is_empty() { String::new() } else { format!(", {}", part.join(" ")) };
        format!("{mark}{}{part}: {words}", self.cell_name)
    }
}

/// Returns the state that an order leads to, if the cell is in it or on the way to it: Held, Stopped or Aborted.
fn ordered(state: StateName) -> Option<StateName> {
    match state {
        StateName::Holding | StateName::Held => Some(StateName::Held),
        StateName::Stopping | StateName::Stopped => Some(StateName::Stopped),
        StateName::Aborting | StateName::Aborted => Some(StateName::Aborted),
        _ => None,
    }
}

/// Returns the content of `alarm` in a notification.
fn notice(alarm: Alarm) -> AlarmNotice {
    let name = |value: serde_json::Result<serde_json::Value>| {
        value.ok().and_then(|value| value.as_str().map(ToOwned::to_owned)).unwrap_or_default()
    };
    AlarmNotice {
        id: name(serde_json::to_value(alarm.id)),
        what: alarm.event,
        consequence: alarm.consequence,
        remedy: alarm.remedy,
        clears: name(serde_json::to_value(alarm.cleared_by)),
    }
}
