//! Task for each machine, which alone talks to that machine. Requests come in, facts go out. Without a request it polls
//! the status.
//!
//! Requests are answered in order. A hold, a stop or an abort does not wait for a long transfer: the drive raises the
//! [`Interrupt`], the transfer ends between two requests, and the order is next. An abort also waits for nothing else:
//! the request in progress is given up where it is, because its result would not be used.

mod abort_counter;
mod commands;
mod connection;
mod driver;
mod loop_watchdog;
mod observed_state;
mod start_intent;
mod status_changes;
mod translation;

use std::time::Duration;

use tokio::sync::{mpsc, oneshot};
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::failure::panic_message;
use super::machine_monitor::MachineMonitor;
use crate::cell::{Command, Device, Event};
use crate::device::{Armed, BatchId, Interrupt, Machine as _, OperatorConfirmation, PreliminaryPoints};
use crate::formats::operator_step::OperatorStep;
use crate::record::EventDetail;
pub(super) use abort_counter::AbortCounter;
pub(super) use driver::{CmmDriver, FetchedResult, GrinderDriver, MachinePayload, StationDriver};
pub(super) use loop_watchdog::{LoopWatchdog, WATCHDOG_INTERVAL};
use observed_state::ObservedState;
pub(super) use start_intent::prepared_job;

/// Request to a machine. The answers are the events that [`Command`] names.
pub(super) enum StationRequest {
    /// Command of the cell that needs no other data.
    Command(Command),
    /// The command [`Command::LoadPass`] or [`Command::LoadPlan`], with the payload.
    Load { cycle: u32, payload: MachinePayload },
    /// The command [`Command::Prepare`], with the batch of the cycle.
    Prepare { number: BatchId },
    /// Confirmation of a person.
    Confirm { confirmation: OperatorConfirmation, answer: oneshot::Sender<Result<(), String>> },
}

/// Notes of a machine for a person, for example why it waits.
pub(super) struct MachineNotes {
    pub(super) device: Device,
    pub(super) all: Vec<String>,
    /// Notes that were not reported before.
    pub(super) new: Vec<String>,
    /// Step that the machine asks of a person now.
    pub(super) step: Option<OperatorStep>,
}

/// Report of a station to the drive: an event or data of a machine, with the details that the journal stores.
#[derive(Default)]
pub(super) struct StationReport {
    /// `None` if the drive itself creates the event from the fetched result.
    pub(super) event: Option<Event>,
    pub(super) detail: Option<EventDetail>,
    pub(super) fetched: Option<FetchedResult>,
    /// Points that a CMM gives while it still measures.
    pub(super) preliminary: Option<PreliminaryPoints>,
    /// Information about a machine for a person, if it has changed.
    pub(super) notes: Option<MachineNotes>,
    /// Files of the run folder that came with a person's confirmation, to be recorded.
    pub(super) files: Vec<String>,
}

/// Task for one machine.
pub(super) struct MachineTask<B> {
    driver: B,
    job: u32,
    interrupt: Interrupt,
    reports: mpsc::Sender<StationReport>,
    /// Digest of the payloads that were loaded last.
    loaded_digest: Option<u32>,
    armed: Option<Armed>,
    /// Cycle of the job that runs.
    cycle: u32,
    observed: ObservedState,
    monitor: MachineMonitor,
    /// Notes that were last reported to a person.
    reported_notes: Vec<String>,
    /// Step of a person that was last reported.
    reported_step: Option<OperatorStep>,
}

impl<B: StationDriver> MachineTask<B> {
    /// Creates the task of a machine. `job` is the number of the run. `intent` is the last START that an interrupted
    /// run prepared, with the number of its cycle. With `intent`, the task can ask the machine what became of this job
    /// (reconcile).
    pub(super) fn new(
        driver: B,
        job: u32,
        (interrupt, monitor): (Interrupt, MachineMonitor),
        reports: mpsc::Sender<StationReport>,
        intent: Option<(u32, Armed)>,
    ) -> Self {
        let (cycle, armed) = intent.unzip();
        let (cycle, seen, notes) = (cycle.unwrap_or(0), ObservedState::default(), Vec::new());
        Self {
            driver,
            job,
            interrupt,
            reports,
            loaded_digest: None,
            armed,
            cycle,
            observed: seen,
            monitor,
            reported_notes: notes,
            reported_step: None,
        }
    }

    /// Passes the last prepared job of an interrupted run to the driver, if there is one. Only this program was
    /// restarted, so the machine may still execute this job.
    pub(super) fn restore_preparation(mut self) -> Self {
        if let Some(armed) = &self.armed {
            self.driver.machine().restore(armed);
        }
        self
    }

    /// Serves the requests of the drive and polls the machine, until all senders of `asks` are dropped. `poll` is the
    /// interval between two polls, `aborts` counts the ordered aborts, and `pulse` shows whether the loop of the drive
    /// is alive. If it is not, the machine is not polled.
    ///
    /// If the task panics, which is a fault of this program, sends [`Event::StationFailed`]. The run then continues
    /// without communication with this machine.
    pub(super) async fn serve(
        self,
        asks: mpsc::Receiver<StationRequest>,
        poll: Duration,
        aborts: AbortCounter,
        pulse: LoopWatchdog,
    ) {
        let (reports, name) = (self.reports.clone(), B::DEVICE);
        let Err(error) = tokio::spawn(self.serve_requests(asks, poll, aborts, pulse)).await else { return };
        let reason = format!("a fault of the program Regrind; report this fault: {}", panic_message(error));
        let event = Some(Event::StationFailed { device: name, reason });
        let _ = reports.send(StationReport { event, ..StationReport::default() }).await;
    }

    /// Serves the requests from `asks` and polls the machine every `poll`. An ordered abort cancels the request or the
    /// poll in progress. Releases the machine and returns when no sender of requests is left.
    async fn serve_requests(
        mut self,
        mut asks: mpsc::Receiver<StationRequest>,
        poll: Duration,
        mut aborts: AbortCounter,
        pulse: LoopWatchdog,
    ) {
        let mut ticks = interval(poll);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                biased;
                ask = asks.recv() => match ask {
                    Some(abort @ StationRequest::Command(Command::AbortMachine { .. })) => {
                        aborts.handled_count += 1;
                        self.handle_request(abort).await;
                    }
                    Some(ask) => tokio::select! {
                        biased;
                        () = aborts.wait_for_abort() => {}
                        () = self.handle_request(ask) => {}
                    },
                    None => break,
                },
                // Checked at each tick: a loop that has hung may continue.
                _ = ticks.tick(), if self.observed.connected => if pulse.is_alive() {
                    tokio::select! {
                        biased;
                        () = aborts.wait_for_abort() => {}
                        () = self.poll() => {}
                    }
                },
            }
        }
        if self.observed.connected && !self.observed.link_lost {
            // Optional: a machine whose owner is silent can be claimed by the next client.
            let _ = self.driver.machine().release().await;
        }
    }

    async fn handle_request(&mut self, ask: StationRequest) {
        use Command::{AbortMachine, HoldMachine, StopMachine};
        let urgent =
            matches!(ask, StationRequest::Command(HoldMachine { .. } | StopMachine { .. } | AbortMachine { .. }));
        if urgent {
            self.interrupt.lower();
        }
        match ask {
            StationRequest::Command(command) => self.execute(command).await,
            StationRequest::Load { cycle, payload: load } => self.load(cycle, &load).await,
            StationRequest::Prepare { number } => self.prepare(number).await,
            StationRequest::Confirm { confirmation: word, answer } => {
                let told = match self.driver.machine().confirm(word).await {
                    Ok(files) => {
                        let _ = self.reports.send(StationReport { files, ..StationReport::default() }).await;
                        Ok(())
                    }
                    Err(error) => Err(error.to_string()),
                };
                // The person who asked may be gone.
                let _ = answer.send(told);
            }
        }
        if urgent {
            // Taking back files stops no machine: report this before the run is over.
            self.report_notes().await;
        }
    }

    /// Reads the status of the machine and reports its changes. If the link is lost, tries to connect again instead.
    async fn poll(&mut self) {
        if self.observed.link_lost {
            return self.reconnect().await;
        }
        let asked_at = Instant::now();
        match self.driver.machine().status().await {
            Ok(status) => {
                self.monitor.add_status(self.driver.machine().name(), &status, asked_at.elapsed());
                self.report_notes().await;
                self.report_changes(&status).await;
                self.read_ahead().await;
            }
            Err(error) => self.report_link_lost(&error).await,
        }
    }

    /// Reads the points that the machine has measured so far in a running job, and sends new ones to the drive for
    /// display. An urgent request (HOLD, STOP or ABORT) interrupts this transfer. Does nothing if no job runs.
    async fn read_ahead(&mut self) {
        let Some(armed) = self.armed.as_ref().filter(|_| self.observed.running && !self.observed.end_reported) else {
            return;
        };
        let preliminary = self.driver.read_ahead(armed.job, &self.interrupt).await;
        if preliminary.is_some() {
            let _ = self.reports.send(StationReport { preliminary, ..StationReport::default() }).await;
        }
    }

    /// Sends the texts in which the machine informs people (for example why it waits) to the drive, if they have
    /// changed since the last report.
    async fn report_notes(&mut self) {
        let (notes, step) = (self.driver.machine().notes(), self.driver.machine().operator_step());
        let new: Vec<String> = notes.iter().filter(|message| !self.reported_notes.contains(message)).cloned().collect();
        let changed = self.reported_notes != notes || self.reported_step != step;
        (self.reported_notes, self.reported_step) = (notes, step.clone());
        if changed {
            let notes = Some(MachineNotes { device: B::DEVICE, all: self.reported_notes.clone(), new, step });
            let _ = self.reports.send(StationReport { notes, ..StationReport::default() }).await;
        }
    }

    async fn report(&mut self, event: Event) {
        self.report_with_detail(event, None).await;
    }

    async fn report_with_detail(&mut self, event: Event, detail: Option<EventDetail>) {
        // The drive listens until it drops the last ask; after that no one needs the event.
        let _ = self.reports.send(StationReport { event: Some(event), detail, ..StationReport::default() }).await;
    }

    async fn send_fetched(&mut self, fetched: FetchedResult) {
        // The drive listens as long as a sender of requests exists.
        let _ = self.reports.send(StationReport { fetched: Some(fetched), ..StationReport::default() }).await;
    }
}
