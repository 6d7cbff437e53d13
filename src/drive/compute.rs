//! Computations of a cycle: they run on threads for blocking work, and their results are events for the cell.

use std::sync::Arc;

use tokio::task::JoinError;

use super::Drive;
use super::Task;
use super::computation::{Computation, create_folder};
use super::evaluation;
use super::failure::{failure_message, panic_message};
use super::notice::Notice;
use super::pipeline;
use super::recorder::{self, OutputFiles};
use super::running_computations::ComputationResult;
use super::task::ComputationProduct;
use crate::cell::{CompensationRefusal, Event, GateFailure, GateResult};
use crate::device::{BatchId, Measurement};
use crate::formats::run_files::CycleFolder;

impl Drive {
    /// Starts the gate of a measurement: the check whether its points can be used. Also writes the points to files.
    pub(super) fn gate(&mut self, measurement: Box<Measurement>) {
        let number = BatchId::decode(measurement.cycle).cycle;
        let cycle = self.cycles.get(number).cloned();
        let earlier = self.cycles.previous_points(number);
        self.start_computation(Computation::Gate, number, move |task, files| {
            pipeline::gate_cycle(task, files, number, cycle.as_ref(), (earlier.as_ref(), &measurement))
        });
    }

    pub(super) fn qualify(&mut self, number: u32) {
        let stated = self.task.probing.probe_radius_mm;
        let found = self.cycles.get(number).and_then(|c| c.points.as_ref()?.probe_radius_mm);
        let radius_error_mm = found.map_or(0.0, |radius| radius - stated);
        self.queue_event(number, Event::Qualified { cycle: number, radius_error_mm });
    }

    pub(super) fn register(&mut self, number: u32) {
        let Some(cycle) = self.cycles.get(number).cloned() else { return };
        let before = self.cycles.previous_judged(number).cloned();
        self.start_computation(Computation::Registration, number, move |task, files| {
            evaluation::register_cycle(task, files, number, &cycle, before.as_ref())
        });
    }

    pub(super) fn compensate(&mut self, number: u32) {
        let Some(cycle) = self.cycles.get(number).cloned() else { return };
        self.start_computation(Computation::Compensation, number, move |task, files| {
            pipeline::compensate_cycle(task, files, number, &cycle)
        });
    }

    /// Starts the computation `work` of the kind `kind` for a cycle, on a thread for blocking work. `work` returns the
    /// event for the cell and the result to store. The same thread writes the created files to the disk and hashes
    /// them. These files can be large, and neither the loop nor the journal should wait for them.
    pub(super) fn start_computation(
        &mut self,
        kind: Computation,
        cycle: u32,
        work: impl FnOnce(&Task, &mut OutputFiles) -> (Event, ComputationProduct) + Send + 'static,
    ) {
        let (task, folder) = (Arc::clone(&self.task), self.context.folder.clone());
        let attempt = self.computations.attempts.entry((cycle, kind)).or_insert(0);
        *attempt += 1;
        let which = *attempt;
        let mut files = OutputFiles::new(folder.clone(), CycleFolder::Attempt { cycle, attempt: which }.to_string());
        if task.adaptive.is_some() && kind != Computation::Compensation {
            let settled =
                self.computations.attempts.get(&(cycle, Computation::FinalRegistration)).map_or(1, |before| before + 1);
            files = OutputFiles::new(folder.clone(), CycleFolder::Batch { cycle, batch: which }.to_string())
                .with_final_subfolder(CycleFolder::Attempt { cycle, attempt: settled }.to_string());
        }
        files = files.of_part(&self.context.serial);
        let computing = self.computations.executor.spawn_computation(&mut self.computations.running, move || {
            // A failure to create the folder shows as the error of the first file in it.
            let _ = create_folder(&files.folder());
            let (event, product) = work(&task, &mut files);
            ComputationResult {
                cycle,
                event: Some(event),
                product,
                files: recorder::sync_and_hash(&folder, &files.into_existing()),
            }
        });
        self.computations.kinds.insert(computing.id(), (cycle, kind));
    }

    /// Queues an event for the cell, as if it were the result of a computation of this cycle.
    pub(super) fn queue_event(&mut self, cycle: u32, event: Event) {
        let computed = ComputationResult {
            cycle,
            event: Some(event),
            product: ComputationProduct::Nothing,
            files: Ok(Vec::new()),
        };
        self.computations.running.spawn(std::future::ready(computed));
    }

    pub(super) async fn handle_computed(&mut self, computed: ComputationResult) {
        let ComputationResult { cycle: number, event, product, files } = computed;
        if matches!(&event, Some(Event::Registered { figures, .. }) if figures.further_touches.is_none()) {
            *self.computations.attempts.entry((number, Computation::FinalRegistration)).or_insert(0) += 1;
        }
        if let (Err(reason), Some(Event::Collected { .. } | Event::Registered { .. } | Event::Compensated { .. })) =
            (&files, &event)
        {
            // A result that is not recorded is not used. It is computed again after a person has repaired the disk.
            let event = Event::NotSaved { cycle: number, reason: reason.clone() };
            self.notify(Notice::RecordFailed { message: failure_message(reason) });
            self.handle_event(event, None).await;
            return;
        }
        self.cycles.store(number, product);
        self.record_files(number, files).await;
        if let Some(Event::RecordFailed { reason }) = &event {
            self.notify(Notice::RecordFailed { message: failure_message(reason) });
        }
        if let Some(event) = event {
            self.handle_event(event, None).await;
        }
    }

    /// Reports to the cell that a computation has failed because its task panicked. The reason in the report states
    /// that this is a fault of the program, so that nobody looks for a fault of the part. Does nothing if the task is
    /// not a known computation.
    pub(super) async fn handle_panic(&mut self, error: JoinError) {
        let Some((cycle, kind)) = self.computations.kinds.remove(&error.id()) else { return };
        let reason = format!(
            "the computation failed because of a fault of the program Regrind; report this fault: {}",
            panic_message(error)
        );
        let event = match kind {
            Computation::Gate => {
                let gate = GateResult::Failed(GateFailure::Broken(reason));
                Event::Collected { cycle, targets: 0, found: 0, gate }
            }
            Computation::Registration | Computation::FinalRegistration => Event::RegistrationFailed { cycle, reason },
            Computation::Compensation => {
                Event::CompensationRefused { cycle, reason: CompensationRefusal::Failed(reason) }
            }
        };
        self.handle_event(event, None).await;
    }
}
