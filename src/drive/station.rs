//! Task for each machine, which alone talks to that machine. Requests come in, facts go out. Without a request it polls
//! the status.
//!
//! Requests are answered in order. A hold, a stop or an abort does not wait for a long transfer: the drive raises the
//! [`Interrupt`], the transfer ends between two requests, and the order is next. An abort also waits for nothing else:
//! the request in progress is given up where it is, because its result would not be used.

use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::failure::panic_message;
use crate::cell::{
    Condition, ConnectionRefusal, Device, Event, GateFailure, GateResult, JobResult, MachineRequest, Occupation,
    Reconciliation,
};
use crate::device::{
    Armed, BatchId, Cmm, CorrectionMap, DeviceError, Fault, Grinder, Identified, Interrupt, Job, Machine, MachineState,
    Measurement, OperatorConfirmation, Outcome, Pass, PassRecord, Plan, PreliminaryPoints, Reconciled, SignalValue,
    Status, digest,
};
use crate::record::{EventDetail, StartIntent};

/// Request to a machine. The answers are the events that [`crate::cell::Command`] names.
pub(super) enum StationRequest {
    Connect,
    Load { cycle: u32, payload: MachinePayload },
    VerifyClear,
    Prepare { number: BatchId },
    Start { cycle: u32 },
    Hold,
    Resume,
    Stop,
    Abort,
    Clear,
    Reconcile { cycle: u32 },
    Collect { cycle: u32 },
    Acknowledge,
    Confirm { confirmation: OperatorConfirmation, answer: oneshot::Sender<Result<(), String>> },
}

/// Payload of a machine: a plan for the CMM, or a map and a pass for the grinder.
#[derive(Clone)]
pub(super) enum MachinePayload {
    Plan(Arc<Plan>),
    Pass(Arc<CorrectionMap>, Box<Pass>),
}

/// Result of a job, as read from the machine.
pub(super) enum FetchedResult {
    /// Points, with the duration of their transfer.
    Points(Box<Measurement>, Duration),
    Record(Box<PassRecord>),
}

/// Notes of a machine for a person, for example why it waits.
pub(super) struct MachineNotes {
    pub(super) device: Device,
    pub(super) all: Vec<String>,
    /// Notes that were not reported before.
    pub(super) new: Vec<String>,
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

/// Common interface of the drivers of both kinds of machine.
pub(super) trait StationDriver: Send + 'static {
    type Machine: Machine;
    const DEVICE: Device;
    fn machine(&mut self) -> &mut Self::Machine;
    /// Transfers a payload (the pass with its correction map, or the measuring plan) to the machine. Returns the digest
    /// (a short hash) of the identities of its contents. A job names the payload by this digest. `interrupt` cancels
    /// the transfer.
    fn load(
        &mut self,
        load: &MachinePayload,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Result<u32, DeviceError>> + Send;
    fn fetch(
        &mut self,
        job: Job,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Result<FetchedResult, DeviceError>> + Send;
    /// Reads new preliminary points of a job that still runs. See [`Cmm::read_ahead`]. The default implementation
    /// always returns `None`.
    fn read_ahead(&mut self, _job: Job, _: &Interrupt) -> impl Future<Output = Option<PreliminaryPoints>> + Send {
        std::future::ready(None)
    }
}

pub(super) struct CmmDriver<C>(pub(super) C);
pub(super) struct GrinderDriver<G>(pub(super) G);

impl<C: Cmm + 'static> StationDriver for CmmDriver<C> {
    type Machine = C;
    const DEVICE: Device = Device::Cmm;

    fn machine(&mut self) -> &mut C {
        &mut self.0
    }

    async fn load(&mut self, load: &MachinePayload, interrupt: &Interrupt) -> Result<u32, DeviceError> {
        let MachinePayload::Plan(plan) = load else { unreachable!("the drive gives a CMM plans only") };
        self.0.load_plan(plan, interrupt).await?;
        Ok(digest(&[plan.identity()]))
    }

    async fn fetch(&mut self, job: Job, interrupt: &Interrupt) -> Result<FetchedResult, DeviceError> {
        let began = Instant::now();
        let measurement = self.0.collect(job, interrupt).await?;
        Ok(FetchedResult::Points(Box::new(measurement), began.elapsed()))
    }

    fn read_ahead(
        &mut self,
        job: Job,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Option<PreliminaryPoints>> + Send {
        self.0.read_ahead(job, interrupt)
    }
}

impl<G: Grinder + 'static> StationDriver for GrinderDriver<G> {
    type Machine = G;
    const DEVICE: Device = Device::Grinder;

    fn machine(&mut self) -> &mut G {
        &mut self.0
    }

    async fn load(&mut self, load: &MachinePayload, interrupt: &Interrupt) -> Result<u32, DeviceError> {
        let MachinePayload::Pass(map, pass) = load else { unreachable!("the drive gives a grinder passes only") };
        self.0.load_pass(map, pass, interrupt).await?;
        Ok(digest(&[map.identity(), pass.identity()]))
    }

    async fn fetch(&mut self, job: Job, interrupt: &Interrupt) -> Result<FetchedResult, DeviceError> {
        Ok(FetchedResult::Record(Box::new(self.0.collect(job, interrupt).await?)))
    }
}

/// Number of aborts that were ordered and handled. The drive counts an abort before it sends the request; the station
/// counts an abort when it receives the request.
pub(super) struct AbortCounter {
    ordered_count: watch::Receiver<u64>,
    handled_count: u64,
}

impl AbortCounter {
    pub(super) fn new(ordered: watch::Receiver<u64>) -> Self {
        Self { ordered_count: ordered, handled_count: 0 }
    }

    /// Waits until an abort is ordered that this station (the task of one machine) has not yet handled. Never returns
    /// if no sender is left that could order one.
    async fn wait_for_abort(&mut self) {
        let taken = self.handled_count;
        if self.ordered_count.wait_for(|ordered| *ordered > taken).await.is_err() {
            // No sender is left that could order an abort.
            std::future::pending::<()>().await;
        }
    }
}

/// Watchdog of the loop of the drive. If the loop hangs, the stations stop polling, so the machines get no heartbeat of
/// their client. They then hold by themselves.
#[derive(Clone)]
pub(super) struct LoopWatchdog {
    started_at: Instant,
    last_beat_ms: Arc<AtomicU64>,
}

impl LoopWatchdog {
    pub(super) fn new() -> Self {
        Self { started_at: Instant::now(), last_beat_ms: Arc::default() }
    }

    pub(super) fn beat(&self) {
        self.last_beat_ms.store(self.elapsed_ms(), Ordering::Release);
    }

    fn is_alive(&self) -> bool {
        self.elapsed_ms().saturating_sub(self.last_beat_ms.load(Ordering::Acquire))
            < WATCHDOG_TIMEOUT.as_millis() as u64
    }

    fn elapsed_ms(&self) -> u64 {
        self.started_at.elapsed().as_millis() as u64
    }
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
    /// Notes that were last reported to a person.
    reported_notes: Vec<String>,
}

/// State that the last status read showed, so that only changes are reported.
#[derive(Default)]
struct ObservedState {
    connected: bool,
    link_lost: bool,
    state: Option<MachineState>,
    progress: Option<(u32, u32)>,
    progress_reported_at: Option<Instant>,
    supplies_missing: bool,
    manual: bool,
    /// True if the machine reported that it was clear of the part; `None` if it does not report this.
    clear: Option<bool>,
    /// True if a signal of the cell file is outside its range (`signal_out_of_range`). While this is true,
    /// `signals_good_since` is the time since which all signals have been within their ranges again.
    signal_out_of_range: bool,
    signals_good_since: Option<Instant>,
    aborting: bool,
    stopping: bool,
    clearing: bool,
    /// True if the end of the running job was reported.
    end_reported: bool,
    /// True if a START was sent and the end of its job has not been reported.
    running: bool,
    next_attempt: Option<Instant>,
    attempts: u32,
    /// Time at which the link last came back.
    reconnected_at: Option<Instant>,
    /// True if the machine has reported the job since START was sent or since the job was reconciled.
    at_job: bool,
    /// Number of status reads in a row without the job.
    reads_without_job: u32,
    /// Number of status reads in which the progress had increased although the machine reports HELD.
    progress_rises_at_held: u32,
    /// Time at which the machine accepted STOP.
    stop_accepted_at: Option<Instant>,
}

/// Interval between two beats of the loop of the drive.
pub(super) const WATCHDOG_INTERVAL: Duration = Duration::from_millis(250);
/// Time without a beat after which the loop of the drive counts as hung.
const WATCHDOG_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum time between two attempts to reach a lost machine.
const MAX_RETRY_INTERVAL: Duration = Duration::from_secs(5);
/// Time for which signals must be within their ranges before they count as good. Prevents flapping of a signal at its
/// limit.
const SIGNAL_SETTLING_TIME: Duration = Duration::from_secs(1);
/// Minimum duration of a link after which a new loss starts a new series of losses.
const STABLE_LINK_TIME: Duration = Duration::from_secs(10);
/// Number of status reads without the job before the job counts as vanished.
const VANISHED_AFTER_READS: u32 = 2;
/// Number of increases of the progress at HELD before the machine counts as moving. A machine may count a few completed
/// items late.
const MOVING_AFTER_RISES: u32 = 3;
/// Time after which a machine that accepted a STOP must have left EXECUTE.
const STOP_TIMEOUT: Duration = Duration::from_secs(5);
/// Minimum share of the path that a machine must have travelled when it reports its job complete.
const MIN_COMPLETE_SHARE: f64 = 0.95;
/// Minimum interval between two reports of progress, so that the journal stays readable.
const MIN_PROGRESS_INTERVAL: Duration = Duration::from_millis(250);

impl<B: StationDriver> MachineTask<B> {
    /// Creates the task of a machine. `job` is the number of the run. `intent` is the last START that an interrupted
    /// run prepared, with the number of its cycle. With `intent`, the task can ask the machine what became of this job
    /// (reconcile).
    pub(super) fn new(
        driver: B,
        job: u32,
        interrupt: Interrupt,
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
            reported_notes: notes,
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
                    Some(StationRequest::Abort) => {
                        aborts.handled_count += 1;
                        self.handle_request(StationRequest::Abort).await;
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

    async fn report(&mut self, event: Event) {
        self.report_with_detail(event, None).await;
    }

    async fn report_with_detail(&mut self, event: Event, detail: Option<EventDetail>) {
        // The drive listens until it drops the last ask; after that no one needs the event.
        let _ = self.reports.send(StationReport { event: Some(event), detail, ..StationReport::default() }).await;
    }

    async fn handle_request(&mut self, ask: StationRequest) {
        let urgent = matches!(ask, StationRequest::Hold | StationRequest::Stop | StationRequest::Abort);
        if urgent {
            self.interrupt.lower();
        }
        match ask {
            StationRequest::Connect => self.connect().await,
            StationRequest::Load { cycle, payload: load } => self.load(cycle, &load).await,
            StationRequest::VerifyClear => self.verify_clear().await,
            StationRequest::Prepare { number } => self.prepare(number).await,
            StationRequest::Start { cycle } => self.start(cycle).await,
            StationRequest::Hold => self.hold().await,
            StationRequest::Resume => self.resume().await,
            StationRequest::Stop => self.stop().await,
            StationRequest::Abort => self.abort().await,
            StationRequest::Clear => self.clear().await,
            StationRequest::Reconcile { cycle } => self.reconcile(cycle).await,
            StationRequest::Collect { cycle } => self.collect(cycle).await,
            StationRequest::Acknowledge => self.acknowledge().await,
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

    async fn connect(&mut self) {
        let connected = async {
            let identity = self.driver.machine().connect().await?;
            let status = self.driver.machine().status().await?;
            // Do not take over a machine that runs the job of another run.
            if self.has_foreign_job(&status) {
                return Ok((identity, Err(describe_job(&status))));
            }
            let status = self.driver.machine().claim().await?;
            Ok::<_, DeviceError>((identity, Ok(status)))
        };
        match connected.await {
            Ok((_, Err(occupation))) => {
                self.report(Event::NotConnected {
                    device: B::DEVICE,
                    reason: ConnectionRefusal::AtAnotherJob(occupation),
                })
                .await;
            }
            Ok((identity, Ok(status))) => {
                self.observed.connected = true;
                self.observed.state = Some(status.state);
                let occupation = self.occupation(&status).await;
                let (device, boot_id, simulated) = (B::DEVICE, identity.boot_id, identity.simulation);
                let (name, address) = (identity.name.clone(), self.driver.machine().name().to_string());
                let detail = EventDetail::Machine { name, address };
                self.report_with_detail(Event::Connected { device, boot_id, simulated, occupation }, Some(detail))
                    .await;
            }
            Err(error) => self.report(Event::NotConnected { device: B::DEVICE, reason: mismatch(&error) }).await,
        }
    }

    fn has_foreign_job(&self, status: &Status) -> bool {
        let at_a_job = status.state.is_moving() || matches!(status.state, MachineState::Held | MachineState::Complete);
        at_a_job && status.job.is_none_or(|job| job.job != self.job)
    }

    /// Returns whether a machine that was just connected is idle, busy, or must be cleared. If an earlier client has
    /// prepared a job but not started it, sends STOP to withdraw this preparation. The machine is then idle, or busy if
    /// STOP fails.
    async fn occupation(&mut self, status: &Status) -> Occupation {
        match status.state {
            MachineState::Idle => Occupation::Idle,
            MachineState::Aborted | MachineState::Faulted => Occupation::ToClear,
            MachineState::Prepared => match self.driver.machine().stop().await {
                Ok(_) => Occupation::Idle,
                Err(error) => Occupation::Busy(error.to_string()),
            },
            _ => Occupation::Busy(describe_job(status)),
        }
    }

    async fn load(&mut self, cycle: u32, load: &MachinePayload) {
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

    async fn verify_clear(&mut self) {
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

    async fn prepare(&mut self, number: BatchId) {
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

    async fn start(&mut self, cycle: u32) {
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

    /// Reports a command as refused that the station did not send, because the link was lost after the cell had issued
    /// it. It is not sent later either, so it cannot move the machine.
    async fn refuse_unsent(&mut self, request: MachineRequest) {
        let reason = "the link is lost, so the command was not sent".to_owned();
        self.report(Event::Refused { device: B::DEVICE, request, reason }).await;
    }

    async fn hold(&mut self) {
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

    async fn resume(&mut self) {
        if self.observed.link_lost {
            return self.refuse_unsent(MachineRequest::Resume).await;
        }
        match self.driver.machine().resume().await {
            Ok(status) => self.report_changes(&status).await,
            Err(error) => self.report_failure(MachineRequest::Resume, error).await,
        }
    }

    async fn stop(&mut self) {
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

    async fn abort(&mut self) {
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

    /// Connects to a machine before an abort, if this program has not connected to it yet. Returns an error if the
    /// machine has a job of another run, or refuses the connection. Returns `Ok` if the machine cannot be reached,
    /// because the abort itself then reports the failure.
    async fn connect_for_abort(&mut self) -> Result<(), String> {
        let met = async {
            self.driver.machine().connect().await?;
            self.driver.machine().status().await
        };
        match met.await {
            Ok(status) if self.has_foreign_job(&status) => {
                Err(format!("the machine has a job of another run: {}", describe_job(&status)))
            }
            Ok(_) => {
                self.observed.connected = true;
                Ok(())
            }
            Err(error) if error.is_link() => Ok(()),
            Err(error) => Err(error.to_string()),
        }
    }

    async fn clear(&mut self) {
        self.observed.clearing = true;
        match self.driver.machine().clear().await {
            Ok(status) => self.report_changes(&status).await,
            Err(error) => self.report_failure(MachineRequest::Clear, error).await,
        }
    }

    async fn reconcile(&mut self, cycle: u32) {
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

    async fn collect(&mut self, cycle: u32) {
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

    async fn send_fetched(&mut self, fetched: FetchedResult) {
        // The drive listens as long as a sender of requests exists.
        let _ = self.reports.send(StationReport { fetched: Some(fetched), ..StationReport::default() }).await;
    }

    async fn acknowledge(&mut self) {
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

    async fn report_link_lost(&mut self, error: &DeviceError) {
        if !std::mem::replace(&mut self.observed.link_lost, true) {
            if self.observed.reconnected_at.is_none_or(|back| back.elapsed() > STABLE_LINK_TIME) {
                self.observed.attempts = 0;
            } else {
                self.schedule_next_attempt();
            }
            let answers = if error.is_link() {
                ""
            } else {
                "the machine answers, but its answer contradicts the cell file or docs/modbus.md: "
            };
            self.report(Event::LinkLost { device: B::DEVICE, reason: format!("{answers}{error}") }).await;
        }
    }

    /// Reads the status of the machine and reports its changes. If the link is lost, tries to connect again instead.
    async fn poll(&mut self) {
        if self.observed.link_lost {
            return self.reconnect().await;
        }
        match self.driver.machine().status().await {
            Ok(status) => {
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
        let notes = self.driver.machine().notes();
        let new: Vec<String> = notes.iter().filter(|message| !self.reported_notes.contains(message)).cloned().collect();
        let changed = self.reported_notes != notes;
        self.reported_notes = notes;
        if changed {
            let notes = Some(MachineNotes { device: B::DEVICE, all: self.reported_notes.clone(), new });
            let _ = self.reports.send(StationReport { notes, ..StationReport::default() }).await;
        }
    }

    async fn reconnect(&mut self) {
        if self.observed.next_attempt.is_some_and(|at| Instant::now() < at) {
            return;
        }
        let reached = async {
            let identity = self.driver.machine().connect().await?;
            // An abort needs no owner, and neither does the check of its effect.
            if !self.observed.aborting {
                self.driver.machine().claim().await?;
            }
            Ok::<_, DeviceError>(identity)
        };
        match reached.await {
            Ok(identity) => {
                self.observed.link_lost = false;
                self.observed.reconnected_at = Some(Instant::now());
                self.observed.state = None;
                self.report(Event::LinkBack { device: B::DEVICE, boot_id: identity.boot_id }).await;
            }
            Err(_) => self.schedule_next_attempt(),
        }
    }

    fn schedule_next_attempt(&mut self) {
        let pause = Duration::from_millis(100) * 2u32.saturating_pow(self.observed.attempts.min(10));
        self.observed.attempts += 1;
        self.observed.next_attempt = Some(Instant::now() + pause.min(MAX_RETRY_INTERVAL));
    }

    /// Compares `status` with the previous status of the machine, and reports each change to the cell as an event.
    /// Examples are another operating mode, a signal out of its range, a held or resumed job, progress, the end of a
    /// job, and a fault.
    async fn report_changes(&mut self, status: &Status) {
        let before = self.observed.state.replace(status.state);
        self.report_mode(status).await;
        self.report_clear(status).await;
        self.report_supplies(status).await;
        self.report_signals(status).await;
        self.report_absence(status).await;
        self.report_contradiction(before, status).await;
        match status.state {
            MachineState::Execute => {
                if before == Some(MachineState::Held) {
                    self.report(Event::MachineResumed { device: B::DEVICE }).await;
                }
                self.report_progress(status).await;
            }
            MachineState::Held if before != Some(MachineState::Held) => {
                self.report(Event::MachineHeld { device: B::DEVICE }).await
            }
            MachineState::Complete => self.finish_job(status).await,
            MachineState::Idle if self.observed.stopping => {
                self.observed.stopping = false;
                self.observed.running = false;
                self.report_end(JobResult::Stopped).await;
            }
            MachineState::Idle if self.observed.clearing => {
                self.observed.clearing = false;
                let (device, boot_id) = (B::DEVICE, status.boot_id.unwrap_or_default());
                self.report(Event::Connected { device, boot_id, simulated: false, occupation: Occupation::Idle }).await;
            }
            MachineState::Aborted => self.report_abort(before).await,
            MachineState::Faulted if before != Some(MachineState::Faulted) => {
                let fault = status.fault.unwrap_or(Fault::Other(0));
                let (device, code, message) = (B::DEVICE, fault.number(), fault_message(B::DEVICE, fault));
                self.report(Event::Fault { device, code, message }).await;
            }
            _ => {}
        }
    }

    /// Reports that a machine has lost the job of this run, after [`VANISHED_AFTER_READS`] status reads without it. The
    /// job counts as lost if the machine reported it before, now reports no job or a job of another run, and has not
    /// reported the end of the job. Does nothing while a stop, clear or abort is in progress.
    async fn report_absence(&mut self, status: &Status) {
        let ObservedState { running, end_reported: ended, stopping, clearing, aborting, .. } = self.observed;
        if !running || ended || stopping || clearing || aborting {
            return;
        }
        let is_another = status.job.is_some_and(|job| job.job != self.job);
        let at_a_job = status.state.is_moving() || matches!(status.state, MachineState::Held | MachineState::Complete);
        if at_a_job && !is_another {
            (self.observed.at_job, self.observed.reads_without_job) = (true, 0);
        }
        if !self.observed.at_job
            || !(matches!(status.state, MachineState::Idle | MachineState::Prepared) || at_a_job && is_another)
        {
            return;
        }
        self.observed.reads_without_job += 1;
        if self.observed.reads_without_job == VANISHED_AFTER_READS {
            self.report(Event::JobVanished { device: B::DEVICE, reason: format!("it is {}", describe_job(status)) })
                .await;
        }
    }

    /// Reports a status that contradicts an accepted command, as a refusal of this command. For HOLD: the machine
    /// reports HELD, but its progress has increased [`MOVING_AFTER_RISES`] times. For STOP: the machine accepted it,
    /// but is still in EXECUTE after [`STOP_TIMEOUT`]. `before` is the state in the previous status.
    async fn report_contradiction(&mut self, before: Option<MachineState>, status: &Status) {
        let device = B::DEVICE;
        let is_held = status.state == MachineState::Held && before == Some(MachineState::Held);
        match status.progress.filter(|_| is_held) {
            Some((done, total)) => {
                let (last, _) = self.observed.progress.replace((done, total)).unwrap_or((done, total));
                self.observed.progress_rises_at_held += u32::from(done > last);
                if done > last
                    && self.observed.running
                    && self.observed.progress_rises_at_held.is_multiple_of(MOVING_AFTER_RISES)
                {
                    let reason =
                        format!("the machine reports HELD, but the progress of the job has risen to {done} of {total}");
                    self.report(Event::Refused { device, request: MachineRequest::Hold, reason }).await;
                }
            }
            None => self.observed.progress_rises_at_held = 0,
        }
        let is_late = self.observed.stop_accepted_at.is_some_and(|taken| taken.elapsed() > STOP_TIMEOUT);
        if self.observed.stopping && is_late && status.state == MachineState::Execute {
            self.observed.stop_accepted_at = None;
            let reason =
                format!("the machine accepted STOP, but is still in EXECUTE {} s later", STOP_TIMEOUT.as_secs());
            self.report(Event::Refused { device, request: MachineRequest::Stop, reason }).await;
        }
    }

    /// Reports the record of a pass as doubtful if the grinder reports the pass as complete, but the reported progress
    /// is below the share [`MIN_COMPLETE_SHARE`] of its total. Does nothing for a CMM, or if the grinder reports no
    /// progress.
    async fn check_early_end(&mut self, status: &Status) {
        let (Device::Grinder, Outcome::Complete, Some((done, total))) = (B::DEVICE, status.outcome, status.progress)
        else {
            return;
        };
        if f64::from(done) < MIN_COMPLETE_SHARE * f64::from(total) {
            let reason =
                format!("the grinder reports the pass as complete, but the progress is only {done} of {total}");
            self.report(Event::RecordDoubted { cycle: self.cycle, reason }).await;
        }
    }

    /// Reports if a machine has changed to manual mode, or back to automatic mode.
    async fn report_mode(&mut self, status: &Status) {
        let Some(manual) = status.automatic.map(|automatic| !automatic) else { return };
        if std::mem::replace(&mut self.observed.manual, manual) == manual {
            return;
        }
        let device = B::DEVICE;
        let event = if manual {
            let message = format!("{} reports manual mode", self.driver.machine().name());
            Event::NotAutomatic { device, message }
        } else {
            Event::AutomaticAgain { device }
        };
        self.report(event).await;
    }

    /// Reports that a machine without a running job is no longer clear of the part (out of its way), for example
    /// because a person has moved the machine. Does nothing if the machine does not report whether it is clear.
    async fn report_clear(&mut self, status: &Status) {
        let Some(clear) = status.clear_of_part else { return };
        let before = self.observed.clear.replace(clear);
        if before == Some(true) && !clear && !self.observed.running {
            let message = format!(
                "{} is in {} without a running job, but is no longer clear of the part",
                self.driver.machine().name(),
                status.state
            );
            self.report(Event::Obstructed { device: B::DEVICE, message }).await;
        }
    }

    async fn report_supplies(&mut self, status: &Status) {
        let Some(missing) = status.supplies.map(|there| !there) else { return };
        if std::mem::replace(&mut self.observed.supplies_missing, missing) == missing {
            return;
        }
        let (device, condition) = (B::DEVICE, Condition::Supplies);
        let event = if missing {
            let message = format!("{} reports that air or coolant is missing", self.driver.machine().name());
            Event::ConditionLost { device, condition, message }
        } else {
            Event::ConditionBack { device, condition }
        };
        self.report(event).await;
    }

    /// Reports once that signals of the machine have left their ranges in the cell file. Reports again when all signals
    /// have been within their ranges for [`SIGNAL_SETTLING_TIME`].
    async fn report_signals(&mut self, status: &Status) {
        let flaws: Vec<String> = status.signals.iter().filter_map(SignalValue::problem).collect();
        let (device, condition) = (B::DEVICE, Condition::Signals);
        if !flaws.is_empty() {
            self.observed.signals_good_since = None;
            if !std::mem::replace(&mut self.observed.signal_out_of_range, true) {
                self.report(Event::ConditionLost { device, condition, message: flaws.join("; ") }).await;
            }
        } else if self.observed.signal_out_of_range {
            let since = *self.observed.signals_good_since.get_or_insert_with(Instant::now);
            if since.elapsed() >= SIGNAL_SETTLING_TIME {
                self.observed.signal_out_of_range = false;
                self.report(Event::ConditionBack { device, condition }).await;
            }
        }
    }

    async fn report_progress(&mut self, status: &Status) {
        let (Some(progress), now) = (status.progress, Instant::now()) else { return };
        let due = self.observed.progress_reported_at.is_none_or(|at| now - at >= MIN_PROGRESS_INTERVAL);
        if due && self.observed.progress != Some(progress) {
            (self.observed.progress, self.observed.progress_reported_at) = (Some(progress), Some(now));
            let (done, total) = progress;
            self.report(Event::Progressed { device: B::DEVICE, done, total }).await;
        }
    }

    /// Reports to the cell that a job has ended. For a pass, first reads the pass record from the grinder. If the link
    /// is lost during this reading, does not report the end, and the next poll tries again.
    ///
    /// Does nothing if no job was running and no stop is in progress. Also does nothing if the end of the job was
    /// already reported and no stop is in progress.
    async fn finish_job(&mut self, status: &Status) {
        if self.observed.end_reported && !self.observed.stopping {
            return;
        }
        if !self.observed.running && !self.observed.stopping {
            return;
        }
        if !self.observed.end_reported && self.fetch_pass_record().await.is_err() {
            return; // The next look tries again.
        }
        if !self.observed.end_reported {
            self.check_early_end(status).await;
        }
        self.observed.stopping = false;
        self.observed.running = false;
        self.report_end(job_result(status.outcome)).await;
    }

    /// Reads the pass record of the finished pass from the grinder, and sends it to the drive. Does nothing for a CMM.
    /// A record that cannot be read, or that belongs to another job, is reported as doubtful.
    ///
    /// # Errors
    /// Returns an error if the link is lost. The loss has then been reported.
    async fn fetch_pass_record(&mut self) -> Result<(), ()> {
        let (Device::Grinder, Some(armed)) = (B::DEVICE, &self.armed) else { return Ok(()) };
        // Short: one or two pages. No interrupt is needed; an abort gives the request up.
        match self.driver.fetch(armed.job, &Interrupt::new()).await {
            Ok(record) => self.send_fetched(record).await,
            Err(error) if error.is_link() => {
                self.report_link_lost(&error).await;
                return Err(());
            }
            Err(error) => self.report(Event::RecordDoubted { cycle: self.cycle, reason: error.to_string() }).await,
        }
        Ok(())
    }

    async fn report_end(&mut self, result: JobResult) {
        self.observed.end_reported = true;
        self.report(Event::Ended { device: B::DEVICE, cycle: self.cycle, result }).await;
    }

    async fn report_abort(&mut self, before: Option<MachineState>) {
        if std::mem::replace(&mut self.observed.aborting, false) {
            self.observed.running = false;
            self.report(Event::AbortConfirmed { device: B::DEVICE }).await;
        } else if before != Some(MachineState::Aborted) && self.observed.running
            || std::mem::replace(&mut self.observed.stopping, false)
        {
            self.observed.running = false;
            self.report_end(JobResult::Aborted).await;
        }
    }
}

/// Describes the state and job of a machine.
fn describe_job(status: &Status) -> String {
    match status.job {
        Some(job) => format!("{} with {job}", status.state),
        None => status.state.to_string(),
    }
}

fn job_result(outcome: Outcome) -> JobResult {
    match outcome {
        Outcome::Complete => JobResult::Complete,
        Outcome::Stopped => JobResult::Stopped,
        Outcome::Aborted => JobResult::Aborted,
        // No outcome, failed, or an unknown one.
        _ => JobResult::Failed,
    }
}

/// Returns the text of a fault for people. For a collision of the probe, the text tells a person to check the position
/// of the part first.
fn fault_message(device: Device, fault: Fault) -> String {
    match (device, fault) {
        // A probe that meets material where only air should be is not at fault: the part is in another place.
        (Device::Cmm, Fault::Collision) => {
            "the probe touched material where the plan expects only air: check the position of the part. Is this the right \
             part, in the right seat, and not turned? Check the probe, then clear the fault of the machine"
                .to_owned()
        }
        (_, fault) => fault.to_string(),
    }
}

/// Returns the failure of the gate (the check whether a measurement can be used) if a measurement arrived, but its data
/// are invalid or belong to another job. Returns `None` for every other error.
fn gate_failure(error: &DeviceError) -> Option<GateFailure> {
    match error {
        DeviceError::NotFinite { .. }
        | DeviceError::OutOfRange { .. }
        | DeviceError::Unlisted { .. }
        | DeviceError::WrongCount { .. } => Some(GateFailure::Broken(error.to_string())),
        DeviceError::Mismatch { .. } => Some(GateFailure::Foreign(error.to_string())),
        _ => None,
    }
}

fn mismatch(error: &DeviceError) -> ConnectionRefusal {
    let message = error.to_string();
    match error {
        DeviceError::WrongWordOrder { .. } => ConnectionRefusal::WordOrder(message),
        DeviceError::WrongLengthUnit { .. } => ConnectionRefusal::Inches,
        DeviceError::Refused { answer: crate::device::Answer::NotOwner, .. } => ConnectionRefusal::Owned(message),
        error if error.is_link() => ConnectionRefusal::Unreachable(message),
        _ => ConnectionRefusal::WrongDevice(message),
    }
}

/// Converts a recorded intent of a START into the data of the prepared job that a driver uses, for example to reconcile
/// the job.
pub(super) fn prepared_job(intent: StartIntent) -> Armed {
    let job = Job { job: intent.job, cycle: intent.cycle, digest: intent.digest };
    Armed { job, start_sequence: intent.start_sequence, token: intent.token, boot_id: intent.boot_id }
}

/// Converts a prepared job into the intent of its START, as the journal stores it.
fn start_intent(armed: &Armed) -> StartIntent {
    let Armed { job: Job { job, cycle, digest }, start_sequence, token, boot_id } = *armed;
    StartIntent { job, cycle, digest, start_sequence, token, boot_id }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn watchdog_detects_hung_loop() {
        let pulse = LoopWatchdog::new();
        assert!(pulse.is_alive());
        tokio::time::advance(WATCHDOG_TIMEOUT).await;
        assert!(!pulse.is_alive());
        pulse.beat();
        assert!(pulse.clone().is_alive());
    }
}
