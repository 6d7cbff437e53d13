//! Reports of the machines: events, messages, points, and records of passes.

use std::time::Duration;

use super::Drive;
use super::notice::Notice;
use super::pass_record;
use super::recorder;
use super::station::{FetchedResult, MachineNotes, StationReport};
use crate::cell::Event;
use crate::device::{BatchId, Identified, Job, Measurement, PassRecord, PreliminaryPoints};
use crate::record::{self, Content, EventDetail, Transfer, TransferNote};

impl Drive {
    pub(super) async fn handle_report(&mut self, report: StationReport) {
        let StationReport { event, detail, fetched, preliminary, notes, files } = report;
        self.record_files(self.cell.cycle(), recorder::sync_and_hash(&self.context.folder, &files)).await;
        if let Some(MachineNotes { device, all, new: messages, step }) = notes {
            (self.machines.notes[device as usize], self.machines.steps[device as usize]) = (all, step);
            self.display.status.send_replace(self.snapshot());
            if !messages.is_empty() {
                let notes = record::MachineNotes { device, notes: messages.clone() };
                self.record_note(&device.to_string(), &Content::MachineNotes(notes));
                self.notify(Notice::Note { device, messages });
            }
        }
        if let Some(preliminary) = preliminary {
            self.update_preview(&preliminary);
        }
        if let Some(FetchedResult::Record(record)) = &fetched {
            self.record_note("grinder", &Content::Pass(pass_record::pass_note(record)));
            if let Some(reason) = self.pass_record_flaw(record) {
                self.handle_event(Event::RecordDoubted { cycle: self.cell.cycle(), reason }, None).await;
            }
        }
        if let Some(FetchedResult::Points(measurement, taken)) = fetched {
            self.record_transfer(&measurement, taken).await;
            return self.gate(measurement);
        }
        if let Some(event) = event {
            if let Event::Prepared { device, .. } = &event {
                self.machines.prepared[*device as usize] = match detail {
                    Some(EventDetail::Preparation(intent)) => Some(intent),
                    _ => None,
                };
            }
            self.handle_event(event, detail).await;
        }
    }

    /// Adds the points of a running measurement to the preview (preliminary figures for display), and publishes the new
    /// snapshot. If the points belong to another job or batch than the one that the CMM now measures, they are ignored
    /// and the preview is deleted. A batch is a part of a measurement that is sent as a plan of its own.
    pub(super) fn update_preview(&mut self, preliminary: &PreliminaryPoints) {
        let number = self.cell.cycle();
        let asked = BatchId { cycle: number, batch: self.cycles.batch(number) };
        let plan = self.cycles.get(number).and_then(|cycle| Some((cycle.plan.clone()?, cycle.plan_pose)));
        match plan.filter(|_| preliminary.job.job == self.context.job && preliminary.job.batch_id() == asked) {
            Some((plan, pose)) => self.display.preview_statistics.add_points(&plan, &pose, preliminary),
            None => self.display.preview_statistics.reset(),
        }
        self.display.status.send_replace(self.snapshot());
    }

    /// Compares a pass record with the pass that was commanded in the current cycle. Returns a text about the first
    /// implausible value or the first difference. Returns `None` if there is none. If the current cycle has no pass,
    /// returns a text that states this.
    pub(super) fn pass_record_flaw(&self, record: &PassRecord) -> Option<String> {
        let number = self.cell.cycle();
        let Some(cycle) = self.cycles.get(number) else { return Some(format!("cycle {number} has no pass")) };
        let (map, pass) = self.task.payloads(&cycle.correction);
        let job = Job { job: self.context.job, cycle: number as u16, digest: 0 };
        let max_depth_mm = self.task.correction_limits.max_depth_mm;
        let outline = self.task.nominal.outline();
        let told = pass_record::CommandedPass { job, pass: &pass, map_identity: map.identity(), max_depth_mm, outline };
        pass_record::implausible_figure(&told, record)
    }

    /// Records how long the transfer of the points of a measurement took (`taken`), and notifies people of the number
    /// of points, the time in s, and the time per point in ms.
    pub(super) async fn record_transfer(&mut self, measurement: &Measurement, taken: Duration) {
        let cycle = BatchId::decode(measurement.cycle).cycle;
        let (points, seconds) = (measurement.points.len(), taken.as_secs_f64());
        let ms_per_point = 1e3 * seconds / points.max(1) as f64;
        let coordinates = Some(measurement.coordinates);
        let transfer = Transfer { points, seconds, ms_per_point: Some(ms_per_point), coordinates };
        self.record_note("cmm", &Content::Transfer(TransferNote { transfer }));
        self.notify(Notice::Transferred { cycle, points, seconds, ms_per_point });
    }
}
