//! Commands to a machine: each is sent by the driver, and its answer is reported to the cell as an event.

use tokio::time::Instant;

use super::MachineTask;
use super::driver::{MachinePayload, StationDriver};
use super::observed_state::ObservedState;
use super::start_intent::start_intent;
use super::translation::{describe_job, fault_message, gate_failure, job_result};
use crate::cell::{Command, Event, GateResult, MachineRequest, Reconciliation};
use crate::device::{BatchId, DeviceError, Fault, Job, Machine as _, MachineState, Reconciled};
use crate::record::EventDetail;

impl<B: StationDriver> MachineTask<B> {
    /// Executes a command of the cell to this machine.
    pub(super) async fn execute(&mut self, command: Command) {
        match command {
            Command::Connect { .. } => self.connect().await,
            Command::VerifyClear { .. } => self.verify_clear().await,
            Command::StartMachine { cycle, .. } => self.start(cycle).await,
            Command::HoldMachine { .. } => self.hold().await,
            Command::ResumeMachine { .. } => self.resume().await,
            Command::StopMachine { .. } => self.stop().await,
            Command::AbortMachine { .. } => self.abort().await,
            Command::ClearMachine { .. } => self.clear().await,
            Command::Reconcile { cycle, .. } => self.reconcile(cycle).await,
            Command::Collect { cycle } => self.collect(cycle).await,
            Command::Acknowledge { .. } => self.acknowledge().await,
            // The drive executes the others itself, or sends them with their data.
            other => unreachable!("{} is sent to no station", other.name()),
        }
    }

    pub(super) async fn load(&mut self, cycle: u32, load: &MachinePayload) {
        self.loaded_digest = None;
        match self.driver.load(load, &self.interrupt).await {
            Ok(digest) => {
                self.loaded_digest = Some(digest);
                let event = match load {
                    MachinePayload::Plan(_) => Event::PlanLoaded { cycle },
                    MachinePayload::Pass(..) => Event::PassLoaded { cycle },
                };
                let detail = EventDetail::Payload { digest: format!("{digest:08x}") };
                self.report_with_detail(event, Some(detail)).await;
            }
            Err(error) => self.report_failure(MachineRequest::Load, error).await,
        }
    }

    pub(super) async fn verify_clear(&mut self) {
        match self.driver.machine().status().await {
            Ok(status) => {
                self.report_mode(&status).await;
                let device = B::DEVICE;
                let name = self.driver.machine().name().to_owned();
                let message = |clear: &str| format!("{name} is {} and {clear}", status.state);
                self.report(match status.clear_of_part {
                    Some(false) => Event::Obstructed { device, message: message("not clear of the part") },
                    _ if status.state.is_moving() => Event::Obstructed { device, message: message("may be moving") },
                    Some(true) => Event::Cleared { device },
                    None => Event::ClearUnknown { device },
                })
                .await;
            }
            Err(error) => self.report_link_lost(&error).await,
        }
    }

    pub(super) async fn prepare(&mut self, number: BatchId) {
        let cycle = number.cycle;
        self.armed = None;
        let Some(digest) = self.loaded_digest else {
            let reason = "no payload was loaded".to_owned();
            return self.report(Event::Refused { device: B::DEVICE, request: MachineRequest::Prepare, reason }).await;
        };
        let job = Job { job: self.job, cycle: number.encode(), digest };
        let prepared = async {
            // A preparation whose answer was lost is still active but unknown here, so ask the machine.
            if self.driver.machine().status().await?.state == MachineState::Prepared {
                self.driver.machine().stop().await?;
            }
            self.driver.machine().prepare(job).await
        };
        match prepared.await {
            Ok(armed) => {
                let detail = EventDetail::Preparation(start_intent(&armed));
                self.armed = Some(armed);
                self.cycle = cycle;
                self.observed.state = Some(MachineState::Prepared);
                self.report_with_detail(Event::Prepared { device: B::DEVICE, cycle }, Some(detail)).await;
            }
            Err(error) => self.report_failure(MachineRequest::Prepare, error).await,
        }
    }

    pub(super) async fn start(&mut self, cycle: u32) {
        let armed = self.armed.clone().filter(|armed| armed.job.batch_id().cycle == cycle);
        let Some(armed) = armed else {
            let reason = "it is not prepared".to_owned();
            return self.report(Event::Refused { device: B::DEVICE, request: MachineRequest::Start, reason }).await;
        };
        if self.observed.link_lost {
            return self.refuse_unsent(MachineRequest::Start).await;
        }
        let ObservedState { supplies_missing, manual, signal_out_of_range: signal_out, signals_good_since, .. } =
            self.observed;
        self.observed = ObservedState {
            connected: true,
            running: true,
            supplies_missing,
            manual,
            signal_out_of_range: signal_out,
            signals_good_since,
            ..ObservedState::default()
        };
        match self.driver.machine().start(armed).await {
            Ok(started) => {
                self.observed.state = Some(MachineState::Execute);
                self.observed.at_job = started.status.state.is_moving();
                let detail = EventDetail::Start { start_sequence: started.start_sequence };
                self.report_with_detail(Event::Started { device: B::DEVICE, cycle }, Some(detail)).await;
            }
            Err(error @ (DeviceError::Refused { .. } | DeviceError::Faulted { .. })) => {
                self.observed.running = false;
                self.report_failure(MachineRequest::Start, error).await;
            }
            // After any other error, the machine may have received the START.
            Err(error) => {
                self.report(Event::StartUnknown { device: B::DEVICE, cycle, reason: error.to_string() }).await;
            }
        }
    }

    pub(super) async fn hold(&mut self) {
        match self.driver.machine().hold().await {
            Ok(status) => self.report_changes(&status).await,
            Err(error) if error.is_link() => self.report_link_lost(&error).await,
            // Not in EXECUTE: the status shows if the machine holds already, has ended, or never ran.
            Err(error) => match self.driver.machine().status().await {
                Ok(status) if status.state == MachineState::Held => {
                    self.report(Event::MachineHeld { device: B::DEVICE }).await
                }
                // Already on its way to HELD, by its key or a button: the next status reads see it arrive.
                Ok(status) if status.state == MachineState::Holding => self.report_changes(&status).await,
                Ok(status) if status.state == MachineState::Complete && self.observed.running => {
                    self.report_changes(&status).await
                }
                Ok(status) if !status.state.is_moving() => self.report(Event::MachineHeld { device: B::DEVICE }).await,
                Ok(_) => self.report_failure(MachineRequest::Hold, error).await,
                Err(error) => self.report_link_lost(&error).await,
            },
        }
    }

    pub(super) async fn resume(&mut self) {
        if self.observed.link_lost {
            return self.refuse_unsent(MachineRequest::Resume).await;
        }
        match self.driver.machine().resume().await {
            Ok(status) => self.report_changes(&status).await,
            Err(error) => self.report_failure(MachineRequest::Resume, error).await,
        }
    }

    pub(super) async fn stop(&mut self) {
        self.observed.stopping = true;
        match self.driver.machine().stop().await {
            Ok(status) => {
                self.observed.stop_accepted_at = Some(Instant::now());
                self.report_changes(&status).await;
            }
            Err(error) if error.is_link() => self.report_link_lost(&error).await,
            Err(error) => match self.driver.machine().status().await {
                Ok(status) if !status.state.is_moving() => self.report_changes(&status).await,
                _ => self.report_failure(MachineRequest::Stop, error).await,
            },
        }
    }

    pub(super) async fn abort(&mut self) {
        self.observed.aborting = true;
        if !self.observed.connected
            && let Err(reason) = self.connect_for_abort().await
        {
            let device = B::DEVICE;
            return self.report(Event::Refused { device, request: MachineRequest::Abort, reason }).await;
        }
        match self.driver.machine().abort().await {
            Ok(status) => self.report_changes(&status).await,
            Err(error) => self.report_failure(MachineRequest::Abort, error).await,
        }
    }

    pub(super) async fn clear(&mut self) {
        self.observed.clearing = true;
        match self.driver.machine().clear().await {
            Ok(status) => self.report_changes(&status).await,
            Err(error) => self.report_failure(MachineRequest::Clear, error).await,
        }
    }

    pub(super) async fn reconcile(&mut self, cycle: u32) {
        let Some(armed) = self.armed.clone().filter(|armed| armed.job.batch_id().cycle == cycle) else {
            // The machine cannot be asked about a job that this program has not prepared, and nothing is concluded.
            let reason =
                "Regrind has not prepared the machine in this cycle, so Regrind cannot ask the machine about the job"
                    .to_owned();
            let outcome = Reconciliation::Unknown(reason);
            return self.report(Event::Reconciled { device: B::DEVICE, cycle, outcome }).await;
        };
        let outcome = match self.driver.machine().reconcile(&armed).await {
            Ok(Reconciled::Running(status)) if status.state == MachineState::Held => Reconciliation::Held,
            Ok(Reconciled::Running(_)) => Reconciliation::Running,
            Ok(Reconciled::Finished(status)) => {
                if status.state == MachineState::Complete && self.fetch_pass_record().await.is_err() {
                    return;
                }
                self.check_early_end(&status).await;
                self.observed.end_reported = true;
                Reconciliation::Ended(job_result(status.outcome))
            }
            Ok(Reconciled::NotStarted(_)) => {
                self.observed.running = false;
                Reconciliation::NotStarted
            }
            Ok(Reconciled::Unknown { reason }) => Reconciliation::Unknown(reason),
            Ok(answer) => Reconciliation::Unknown(format!("unknown answer: {answer:?}")),
            Err(error) if error.is_link() => return self.report_link_lost(&error).await,
            Err(error) => Reconciliation::Unknown(error.to_string()),
        };
        if matches!(outcome, Reconciliation::Running | Reconciliation::Held) {
            self.observed.running = true;
            self.observed.end_reported = false;
            (self.observed.at_job, self.observed.reads_without_job) = (true, 0);
        }
        self.report(Event::Reconciled { device: B::DEVICE, cycle, outcome }).await;
    }

    pub(super) async fn collect(&mut self, cycle: u32) {
        let armed = self.armed.as_ref().filter(|armed| armed.job.batch_id().cycle == cycle);
        let Some(job) = armed.map(|armed| armed.job) else {
            let reason =
                "Regrind has not prepared the machine for a job of this cycle, so there is no result to collect"
                    .to_owned();
            return self.report(Event::Refused { device: B::DEVICE, request: MachineRequest::Collect, reason }).await;
        };
        match self.driver.fetch(job, &self.interrupt).await {
            // The drive checks the points and reports to the cell; this only hands them over.
            Ok(fetched) => self.send_fetched(fetched).await,
            Err(error) => match gate_failure(&error) {
                Some(failure) => {
                    let (targets, found) = (0, 0);
                    self.report(Event::Collected { cycle, targets, found, gate: GateResult::Failed(failure) }).await;
                }
                None => self.report_failure(MachineRequest::Collect, error).await,
            },
        }
    }

    pub(super) async fn acknowledge(&mut self) {
        let acknowledged = async {
            let status = self.driver.machine().status().await?;
            match status.state {
                MachineState::Complete => self.driver.machine().acknowledge(status.done).await,
                _ => Ok(status),
            }
        };
        match acknowledged.await {
            // A result that does not exist yet is not acknowledged.
            Ok(status) if status.state.is_moving() || status.state == MachineState::Held => {
                let (device, reason) =
                    (B::DEVICE, format!("{} is still {}", self.driver.machine().name(), describe_job(&status)));
                self.report(Event::Refused { device, request: MachineRequest::Discard, reason }).await;
            }
            Ok(status) => {
                self.observed.state = Some(status.state);
                self.observed.running = false;
                self.report(Event::Acknowledged { device: B::DEVICE }).await;
            }
            Err(error) => self.report_failure(MachineRequest::Acknowledge, error).await,
        }
    }

    /// Reports a command as refused that the station did not send, because the link was lost after the cell had issued
    /// it. It is not sent later either, so it cannot move the machine.
    async fn refuse_unsent(&mut self, request: MachineRequest) {
        let reason = "the link is lost, so the command was not sent".to_owned();
        self.report(Event::Refused { device: B::DEVICE, request, reason }).await;
    }

    /// Reports to the cell that the request `request` failed with `error`. If the link is lost, reports the loss first.
    /// Then reports a fault of the machine as a fault, and every other error as a refusal of the request.
    async fn report_failure(&mut self, request: MachineRequest, error: DeviceError) {
        if error.is_link() {
            self.report_link_lost(&error).await;
        }
        match error {
            DeviceError::Faulted { fault, .. } if fault != Fault::None => {
                let (device, message) = (B::DEVICE, fault_message(B::DEVICE, fault));
                self.report(Event::Fault { device, code: fault.number(), message }).await;
            }
            _ => self.report(Event::Refused { device: B::DEVICE, request, reason: error.to_string() }).await,
        }
    }
}
