//! History of a run from its journal, as far as a report shows it.

use std::collections::BTreeMap;
use std::path::Path;

use super::ReportError;
use super::words::{gate_words, words};
use regrind_cell::{
    Alarm, AlarmId, Command, Device, Ending, Event, Figures, GateResult, JobResult, Judgement, Reconciliation,
    RecordedParameter, Tolerance,
};
use regrind_formats::run_files::{CycleFile, CycleFolder};
use regrind_journal::{Reader, Record, RecordKind, Verified, verify};
use regrind_record::{
    Begin, Content, EventDetail, EventRecord, PartEnd, PassFigures, Remark, RunContent, RunEnd, TouchCounts,
};

#[derive(Default)]
pub(super) struct RunHistory {
    /// First record of the run.
    pub(super) begin: Option<Record>,
    /// Content of the first record.
    pub(super) start: Begin<RunContent>,
    pub(super) end: Option<Record>,
    pub(super) ending: Option<Ending>,
    /// Number of touches, if the measurement was adaptive.
    pub(super) touches: Option<TouchCounts>,
    /// For each machine, true if it came home; `None` if this is not the record of a recovery.
    pub(super) home: Option<[bool; 2]>,
    pub(super) cycles: BTreeMap<u32, CycleHistory>,
    /// Name and address of each machine, as it reported them.
    pub(super) machines: [Option<[String; 2]>; 2],
    /// Radius of the wheel that the grinder reported last.
    pub(super) wheel_radius_mm: Option<f64>,
    /// Cycle and value of the last error of the probe's radius on the reference sphere.
    pub(super) radius_error_mm: Option<(u32, f64)>,
    pub(super) alarms: Vec<AlarmHistory>,
    pub(super) orders: Vec<Order>,
    /// Number of orders before the last time that a machine was released at its own panel, which ends a hold.
    orders_before_hold: usize,
    /// Pass that was started last.
    pub(super) pass: Option<PassHistory>,
    /// Time of the last record.
    pub(super) last: String,
    /// Job of each machine that has started: the opening of the journal, and the time in nanoseconds since the run began.
    started: [Option<(String, u64)>; 2],
}

/// Progress of a pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct PassHistory {
    pub(super) cycle: u32,
    /// Ground part of its path and whole path, as the grinder reported them last.
    pub(super) ground: Option<[u32; 2]>,
    /// Result of the pass; `None` if it is not on record.
    pub(super) result: Option<JobResult>,
}

#[derive(Default)]
pub(super) struct CycleHistory {
    pub(super) measurements: Vec<Measurement>,
    /// Height of the target surface above the nominal one.
    pub(super) level_um: Option<f64>,
    /// Name of the map within the run folder, and the time at which it was recorded.
    pub(super) map: Option<(String, String)>,
    /// Name of the file of points with their deviations within the run folder.
    pub(super) deviations: Option<String>,
    /// Name of the registration file within the run folder.
    pub(super) registration: Option<String>,
    /// Name of the file of figures within the run folder.
    pub(super) form: Option<String>,
    /// PV and RMS that are expected after the next pass, in millimetres.
    pub(super) expected_mm: Option<[f64; 2]>,
    /// Figures of the pass, as the grinder reported them.
    pub(super) pass: Option<PassFigures>,
    /// Error of the probe's radius on the reference sphere, in millimetres.
    pub(super) radius_error_mm: Option<f64>,
    /// Estimates of the parameters of the machine.
    pub(super) parameters: Vec<RecordedParameter>,
    /// Name of the file of the conditions of the measurement within the run folder.
    pub(super) conditions: Option<String>,
    /// Root mean square of the error that is left for the map in addition to the parameters, in millimetres.
    pub(super) map_rms_mm: Option<f64>,
    /// Total duration of the jobs of each machine in seconds: CMM, grinder.
    pub(super) job_s: [Option<f64>; 2],
}

/// Measurement of a cycle: its figures, or the reason why there are none.
#[derive(Default)]
pub(super) struct Measurement {
    /// Time of the last record about the measurement.
    pub(super) utc: String,
    pub(super) figures: Option<Figures>,
    pub(super) unusable: Option<String>,
    /// Judgements in their order. A judgement can be amended; the last one counts.
    pub(super) judgements: Vec<Judgement>,
}

impl Measurement {
    /// Returns true if this measurement is not complete: its last evaluation requested that the probe touches further
    /// points. The further points become part of the same measurement. Returns false if the measurement has no figures
    /// yet.
    fn expects_more_touches(&self) -> bool {
        self.figures.as_ref().is_some_and(|figures| figures.further_touches.is_some())
    }
}

/// Alarm from the record.
#[derive(Clone, Debug, PartialEq)]
pub struct AlarmHistory {
    /// Alarm itself.
    pub alarm: Alarm,
    /// Time at which it was raised, RFC 3339 in UTC.
    pub raised: String,
    /// Time at which it was withdrawn; `None` if it was active until the end of the record.
    pub withdrawn: Option<String>,
    /// Last acknowledgement by a person while the alarm was active.
    pub acknowledged: Option<AlarmAcknowledgement>,
}

/// Acknowledgement of an alarm: somebody has seen it and takes care.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AlarmAcknowledgement {
    /// Name of the person.
    pub by: String,
    /// Time, RFC 3339 in UTC.
    pub at: String,
    /// Remark of the person; empty if none was given.
    pub remark: String,
}

/// Order of a person to hold the cell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HoldOrder {
    /// Name of the person.
    pub by: String,
    /// Time of the order, RFC 3339 in UTC.
    pub at: String,
    /// Reason in this person's words; empty if none was given.
    pub reason: String,
}

/// Order of a person, or confirmation of the state of a machine.
pub(super) struct Order {
    pub(super) record: Record,
    /// Event that the cell processed; `None` for an order that goes directly to a machine, past the cell.
    pub(super) event: Option<Event>,
    pub(super) refused: Option<String>,
}

impl RunHistory {
    /// Verifies the record in the run folder `folder`. Returns the history of the run and the result of the
    /// verification. Records that were written after the verification are not read.
    ///
    /// # Errors
    /// Fails if the record cannot be read or does not pass verification.
    pub(super) fn read_verified(folder: &Path) -> Result<(Self, Verified), ReportError> {
        let verified = verify(folder)?;
        let mut story = Self::default();
        for record in Reader::open(folder)?.records(0).take(verified.records as usize) {
            story.add_record(record?);
        }
        Ok((story, verified))
    }

    pub(super) fn add_record(&mut self, record: Record) {
        self.last.clone_from(&record.utc);
        let Ok(content) = Content::read(&record) else {
            // An end that this version cannot read is still the end of the run.
            if record.kind == RecordKind::End {
                self.end = Some(record);
            }
            return;
        };
        match content {
            Content::Begin(start) => {
                self.start = *start;
                self.begin = Some(record);
            }
            Content::Command(told) => self.add_command(record, told.command),
            Content::Event(told) => self.add_event(record, *told),
            Content::Confirmation(_) | Content::Recovery(_) => {
                self.orders.push(Order { record, event: None, refused: None })
            }
            Content::Artefact(file) => self.add_file(&record, &file.name),
            Content::End(end) => {
                match end.ending {
                    RunEnd::Part(PartEnd { ending, cycles, touches, .. }) => {
                        cycles.iter().for_each(|row| self.cycle(row.cycle).level_um = Some(row.level_um));
                        (self.ending, self.touches) = (Some(ending), touches);
                    }
                    RunEnd::Bare(ending) => self.ending = Some(ending),
                    RunEnd::Recovery(end) => self.home = Some([end.cmm_home, end.grinder_home]),
                    RunEnd::Other(_) => {}
                }
                self.end = Some(record);
            }
            Content::Remark(Remark { remark, alarm }) => {
                alarm.into_iter().for_each(|id| self.add_acknowledgement(&record, id, &remark));
            }
            Content::Pass(pass) => {
                self.wheel_radius_mm = pass.pass_record.wheel_radius_mm.or(self.wheel_radius_mm);
                self.cycle(record.cycle).pass = Some(pass.pass_record);
            }
            Content::Reopen(_)
            | Content::Answer(_)
            | Content::MachineNotes(_)
            | Content::Transfer(_)
            | Content::Seal(_)
            | Content::Unknown(_) => {}
        }
    }

    /// Returns the accepted order that holds the cell, if the cell was not resumed since. A further order to hold the
    /// same cell only states the reason; a person who states it for another is named.
    pub(super) fn hold_order(&self) -> Option<HoldOrder> {
        let since = self.orders.get(self.orders_before_hold..).unwrap_or_default();
        let accepted = since.iter().filter(|order| order.refused.is_none());
        accepted.fold(None, |held: Option<HoldOrder>, order| match (&order.event, held) {
            (Some(Event::Resume { .. }), _) => None,
            (Some(Event::Hold { actor, reason }), None) => {
                Some(HoldOrder { by: actor.name.clone(), at: order.record.utc.clone(), reason: reason.clone() })
            }
            (Some(Event::Hold { actor, reason }), Some(held)) if !reason.is_empty() => {
                let by = if actor.name == held.by { String::new() } else { format!(" ({})", actor.name) };
                Some(HoldOrder { reason: format!("{reason}{by}"), ..held })
            }
            (_, held) => held,
        })
    }

    /// Adds the acknowledgement of the alarm `id`, if this alarm is active.
    fn add_acknowledgement(&mut self, record: &Record, id: AlarmId, remark: &str) {
        let standing = |alarm: &&mut AlarmHistory| alarm.alarm.id == id && alarm.withdrawn.is_none();
        if let Some(alarm) = self.alarms.iter_mut().rev().find(standing) {
            let (by, at) = (record.actor.clone(), record.utc.clone());
            alarm.acknowledged = Some(AlarmAcknowledgement { by, at, remark: remark.to_owned() });
        }
    }

    fn add_command(&mut self, record: Record, command: Command) {
        match command {
            Command::LoadPass { cycle } | Command::LoadPlan { cycle } => drop(self.cycle(cycle)),
            Command::Announce(judgement) => self.measurement(judgement.cycle).judgements.push(judgement),
            Command::Raise(alarm) => {
                self.alarms.push(AlarmHistory { alarm, raised: record.utc, withdrawn: None, acknowledged: None });
            }
            Command::Withdraw { alarm } => {
                let standing = |a: &&mut AlarmHistory| a.alarm.id == alarm && a.withdrawn.is_none();
                self.alarms.iter_mut().filter(standing).for_each(|a| a.withdrawn = Some(record.utc.clone()));
            }
            Command::Refuse { event, reason, .. } => {
                let given = |order: &&mut Order| order.event.as_ref() == Some(&*event) && order.refused.is_none();
                if let Some(order) = self.orders.iter_mut().rev().find(given) {
                    order.refused = Some(reason);
                }
            }
            Command::Finish(ending) => self.ending = Some(ending),
            _ => {}
        }
    }

    /// Adds the start or the end of a job to the durations of its cycle. The times of two records are comparable only if
    /// the same program wrote both.
    fn add_job_time(&mut self, record: &Record, event: &Event) {
        match event {
            Event::Started { device, .. } => {
                self.started[*device as usize] = Some((record.boot_id.clone(), record.mono_ns));
            }
            Event::Ended { device, cycle, .. } => {
                let Some((boot_id, since_ns)) = self.started[*device as usize].take() else { return };
                let Some(ns) = record.mono_ns.checked_sub(since_ns).filter(|_| boot_id == record.boot_id) else {
                    return;
                };
                *self.cycle(*cycle).job_s[*device as usize].get_or_insert(0.0) += 1e-9 * ns as f64;
            }
            _ => {}
        }
    }

    fn add_event(&mut self, record: Record, told: EventRecord) {
        let EventRecord { event, detail } = told;
        self.add_job_time(&record, &event);
        match event {
            Event::Collected { cycle, gate, .. } => {
                let unusable = Some(&gate).filter(|gate| **gate != GateResult::Passed).map(gate_words);
                let measurements = &mut self.cycle(cycle).measurements;
                match measurements.last_mut().filter(|last| last.expects_more_touches()) {
                    // Further touches belong to the same measurement. Its earlier result stays valid until more is
                    // known.
                    Some(last) if unusable.is_none() => last.utc = record.utc,
                    Some(last) => *last = Measurement { utc: record.utc, unusable, ..Measurement::default() },
                    None => measurements.push(Measurement { utc: record.utc, unusable, ..Measurement::default() }),
                }
            }
            Event::Registered { cycle, figures } => {
                // A judged measurement keeps its figures.
                if self.measurement(cycle).figures.is_some() && !self.measurement(cycle).expects_more_touches() {
                    self.cycle(cycle).measurements.push(Measurement::default());
                }
                let measurement = self.measurement(cycle);
                measurement.figures = Some(figures);
                measurement.utc = record.utc;
            }
            Event::Connected { device, .. } => {
                self.machines[device as usize] = Some(match detail {
                    Some(EventDetail::Machine { name, address }) => [name, address],
                    _ => ["not reported".to_owned(), "not reported".to_owned()],
                });
            }
            Event::Started { device: Device::Grinder, cycle } => {
                self.pass = Some(PassHistory { cycle, ground: None, result: None });
            }
            Event::Progressed { device: Device::Grinder, done, total } => {
                let under_way = self.pass.as_mut().filter(|pass| pass.result.is_none());
                under_way.into_iter().for_each(|pass| pass.ground = Some([done, total]));
            }
            Event::Ended { device: Device::Grinder, cycle, result }
            | Event::Reconciled { device: Device::Grinder, cycle, outcome: Reconciliation::Ended(result) } => {
                let of_it = self.pass.as_mut().filter(|pass| pass.cycle == cycle);
                of_it.into_iter().for_each(|pass| pass.result = Some(result));
            }
            Event::Qualified { cycle, radius_error_mm } => {
                self.radius_error_mm = Some((cycle, radius_error_mm));
                self.cycle(cycle).radius_error_mm = Some(radius_error_mm);
            }
            Event::Compensated { cycle, summary } => {
                let story = self.cycle(cycle);
                story.expected_mm = Some([summary.predicted_pv_mm, summary.predicted_rms_mm]);
                (story.parameters, story.map_rms_mm) = (summary.parameters, summary.map_rms_mm);
            }
            Event::RegistrationFailed { cycle, reason } => {
                self.measurement(cycle).unusable = Some(format!("not registered: {reason}"));
            }
            Event::MachineResumed { .. } => self.orders_before_hold = self.orders.len(),
            event if event.actor().is_some() => {
                self.orders.push(Order { record, event: Some(event), refused: None });
            }
            _ => {}
        }
    }

    fn add_file(&mut self, record: &Record, name: &str) {
        // Results computed again after an interruption are in a separate folder. The last ones count.
        if CycleFolder::cycle_of(name) != Some(record.cycle) {
            return;
        }
        let file = name.rsplit('/').next().and_then(CycleFile::from_name);
        let name = name.to_owned();
        match file {
            Some(CycleFile::ErrorMap) => self.cycle(record.cycle).map = Some((name, record.utc.clone())),
            Some(CycleFile::Deviations) => self.cycle(record.cycle).deviations = Some(name),
            Some(CycleFile::Registration) => self.cycle(record.cycle).registration = Some(name),
            Some(CycleFile::Conditions) => self.cycle(record.cycle).conditions = Some(name),
            Some(CycleFile::Figures) => self.cycle(record.cycle).form = Some(name),
            _ => {}
        }
    }

    fn cycle(&mut self, number: u32) -> &mut CycleHistory {
        self.cycles.entry(number).or_default()
    }

    /// Returns the last measurement of the cycle `number`; creates an empty one if the cycle has none.
    fn measurement(&mut self, number: u32) -> &mut Measurement {
        let measurements = &mut self.cycle(number).measurements;
        if measurements.is_empty() {
            measurements.push(Measurement::default());
        }
        let last = measurements.len() - 1;
        &mut measurements[last]
    }

    /// Returns the tolerance of the recipe, from the first record of the run. Returns `None` if it is not on record.
    pub(super) fn tolerance(&self) -> Option<Tolerance> {
        self.start.content.part()?.plan.tolerance()
    }

    /// Returns the last measurement that has figures: the number of its cycle, the measurement, and its figures.
    /// Returns `None` if there is none.
    pub(super) fn last_measured(&self) -> Option<(u32, &Measurement, &Figures)> {
        let all = self.cycles.iter().flat_map(|(cycle, story)| story.measurements.iter().map(|of| (*cycle, of)));
        all.rev().find_map(|(cycle, of)| Some((cycle, of, of.figures.as_ref()?)))
    }
}

impl Order {
    pub(super) fn words(&self) -> String {
        words(&self.record)
    }
}
