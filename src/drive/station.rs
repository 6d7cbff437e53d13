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

use serde::Serialize;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::words_of;
use crate::cell::{
    Asked, Condition, Device, Event, Gate, GateFailure, JobResult, Mismatch, Occupation, Reconciliation,
};
use crate::device::{
    Armed, BatchId, Cmm, CorrectionMap, DeviceError, Fault, Grinder, Identified, Interrupt, Job, Machine, Measurement,
    OperatorConfirmation, Outcome, Pass, PassRecord, Plan, PreliminaryPoints, Reconciled, SignalValue, State, Status,
    digest,
};

/// Request to a machine. The answers are the events that [`crate::cell::Command`] names.
pub(super) enum Ask {
    Connect,
    Load { cycle: u32, load: Load },
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
    Confirm { word: OperatorConfirmation, answer: oneshot::Sender<Result<(), String>> },
}

/// Payload for one machine or the other.
#[derive(Clone)]
pub(super) enum Load {
    Plan(Arc<Plan>),
    Pass(Arc<CorrectionMap>, Box<Pass>),
}

/// Result of a job.
pub(super) enum Fetched {
    /// Points, with the duration of their transfer.
    Points(Box<Measurement>, Duration),
    Record(Box<PassRecord>),
}

/// Present information about a machine for a person.
pub(super) struct Notes {
    pub(super) device: Device,
    pub(super) all: Vec<String>,
    /// Notes that were not reported before.
    pub(super) new: Vec<String>,
}

/// Fact, with the details that the journal stores.
#[derive(Default)]
pub(super) struct StationReport {
    /// `None` if the drive itself creates the event from the fetched result.
    pub(super) event: Option<Event>,
    pub(super) detail: Option<serde_json::Value>,
    pub(super) fetched: Option<Fetched>,
    /// Points that a CMM gives while it still measures.
    pub(super) preliminary: Option<PreliminaryPoints>,
    /// Information about a machine for a person, if it has changed.
    pub(super) notes: Option<Notes>,
    /// Files of the run folder that came with a person's confirmation, to be recorded.
    pub(super) files: Vec<String>,
}

/// Common interface of the drivers of both kinds of machine.
pub(super) trait StationDriver: Send + 'static {
    type Machine: Machine;
    const DEVICE: Device;
    fn machine(&mut self) -> &mut Self::Machine;
    /// Transfers the payloads and returns the digest of their identities.
    fn load(&mut self, load: &Load, interrupt: &Interrupt) -> impl Future<Output = Result<u32, DeviceError>> + Send;
    fn fetch(&mut self, job: Job, interrupt: &Interrupt) -> impl Future<Output = Result<Fetched, DeviceError>> + Send;
    /// Reads new preliminary data while the job still runs; see [`Cmm::read_ahead`].
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

    async fn load(&mut self, load: &Load, interrupt: &Interrupt) -> Result<u32, DeviceError> {
        let Load::Plan(plan) = load else { unreachable!("the drive gives a CMM plans only") };
        self.0.load_plan(plan, interrupt).await?;
        Ok(digest(&[plan.identity()]))
    }

    async fn fetch(&mut self, job: Job, interrupt: &Interrupt) -> Result<Fetched, DeviceError> {
        let began = Instant::now();
        let measurement = self.0.collect(job, interrupt).await?;
        Ok(Fetched::Points(Box::new(measurement), began.elapsed()))
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

    async fn load(&mut self, load: &Load, interrupt: &Interrupt) -> Result<u32, DeviceError> {
        let Load::Pass(map, pass) = load else { unreachable!("the drive gives a grinder passes only") };
        self.0.load_pass(map, pass, interrupt).await?;
        Ok(digest(&[map.identity(), pass.identity()]))
    }

    async fn fetch(&mut self, job: Job, interrupt: &Interrupt) -> Result<Fetched, DeviceError> {
        Ok(Fetched::Record(Box::new(self.0.collect(job, interrupt).await?)))
    }
}

/// Aborts on their way to a station. The drive counts each one before it sends the request; the station counts each one
/// that it takes.
pub(super) struct Aborts {
    ordered: watch::Receiver<u64>,
    taken: u64,
}

impl Aborts {
    pub(super) fn new(ordered: watch::Receiver<u64>) -> Self {
        Self { ordered, taken: 0 }
    }

    /// Waits until an abort is on its way that this station has not taken.
    async fn ordered(&mut self) {
        let taken = self.taken;
        if self.ordered.wait_for(|ordered| *ordered > taken).await.is_err() {
            // No sender is left that could order an abort.
            std::future::pending::<()>().await;
        }
    }
}

/// Heartbeat of the loop that decides. If it stops, no machine is polled, so none gets the sign of life of its client:
/// the machine holds by itself.
#[derive(Clone)]
pub(super) struct Pulse {
    began: Instant,
    last_ms: Arc<AtomicU64>,
}

impl Pulse {
    pub(super) fn new() -> Self {
        Self { began: Instant::now(), last_ms: Arc::default() }
    }

    pub(super) fn beat(&self) {
        self.last_ms.store(self.now_ms(), Ordering::Release);
    }

    fn is_felt(&self) -> bool {
        self.now_ms().saturating_sub(self.last_ms.load(Ordering::Acquire)) < HUNG_AFTER.as_millis() as u64
    }

    fn now_ms(&self) -> u64 {
        self.began.elapsed().as_millis() as u64
    }
}

/// Task for one machine.
pub(super) struct MachineTask<B> {
    driver: B,
    job: u32,
    interrupt: Interrupt,
    reports: mpsc::Sender<StationReport>,
    /// Digest of the payloads that were loaded last.
    loaded: Option<u32>,
    armed: Option<Armed>,
    /// Cycle of the job that runs.
    cycle: u32,
    seen: Seen,
    /// Notes that were last reported to a person.
    notes: Vec<String>,
}

/// State that the last status read showed, so that only changes are reported.
#[derive(Default)]
struct Seen {
    connected: bool,
    lost: bool,
    state: Option<State>,
    progress: Option<(u32, u32)>,
    told_progress: Option<Instant>,
    supplies_missing: bool,
    manual: bool,
    /// True if it was clear of the part; `None` if it does not report this.
    clear: Option<bool>,
    /// True if a signal of the cell file is outside its range; and since when all have been within it, until that is
    /// accepted.
    signal_out: bool,
    signals_good_since: Option<Instant>,
    aborting: bool,
    stopping: bool,
    clearing: bool,
    /// True if the end of the running job was reported.
    ended: bool,
    /// True if a START was taken and its end has not been reported.
    running: bool,
    next_try: Option<Instant>,
    tries: u32,
    /// Time at which the link last came back.
    back: Option<Instant>,
    /// True if the machine was seen at the job since START was sent or the job was reconciled.
    at_job: bool,
    /// Number of status reads in a row without the job.
    absent: u32,
    /// Number of status reads with progress that rose since the one before, although the machine reports HELD.
    rises: u32,
    /// Time at which STOP was taken.
    stop_taken: Option<Instant>,
}

/// Interval between two beats of the loop that decides.
pub(super) const PULSE_EVERY: Duration = Duration::from_millis(250);
/// Time without a beat after which the loop counts as hung.
const HUNG_AFTER: Duration = Duration::from_secs(2);
/// Maximum time between two attempts to reach a lost machine.
const LONGEST_PAUSE: Duration = Duration::from_secs(5);
/// Time for which signals must be within their ranges before they count as good. Prevents flapping of a signal at its
/// limit.
const BELIEVED_AFTER: Duration = Duration::from_secs(1);
/// Duration of a link after which a new loss does not belong to the same series of losses.
const STEADY_AFTER: Duration = Duration::from_secs(10);
/// Number of status reads without the job before the job counts as vanished.
const ABSENT_AFTER: u32 = 2;
/// Number of rises of the progress at HELD before the machine counts as moving. It may still count what it has just
/// ended.
const RISES_AFTER: u32 = 3;
/// Time after which a machine that took a STOP must have left EXECUTE.
const STOPS_WITHIN: Duration = Duration::from_secs(5);
/// Minimum share of the path that a machine must have travelled when it reports its job complete.
const COMPLETE_FROM: f64 = 0.95;
/// Minimum interval between two reports of progress, so that the journal stays readable.
const PROGRESS_EVERY: Duration = Duration::from_millis(250);

impl<B: StationDriver> MachineTask<B> {
    /// Creates the task of a machine for a job. With the intent of an interrupted run, the job can be reconciled.
    pub(super) fn new(
        driver: B,
        job: u32,
        interrupt: Interrupt,
        reports: mpsc::Sender<StationReport>,
        intent: Option<(u32, Armed)>,
    ) -> Self {
        let (cycle, armed) = intent.unzip();
        let (cycle, seen, notes) = (cycle.unwrap_or(0), Seen::default(), Vec::new());
        Self { driver, job, interrupt, reports, loaded: None, armed, cycle, seen, notes }
    }

    /// Restores the last preparation into the driver. The machine may still run it since before this program began.
    pub(super) fn may_be_at_work(mut self) -> Self {
        if let Some(armed) = &self.armed {
            self.driver.machine().restore(armed);
        }
        self
    }

    /// Serves requests until no sender is left. If the task panics, which is a fault of this program, reports that as
    /// an event. The run then continues without the machine, to which nothing talks any more.
    pub(super) async fn attend(self, asks: mpsc::Receiver<Ask>, poll: Duration, aborts: Aborts, pulse: Pulse) {
        let (reports, name) = (self.reports.clone(), B::DEVICE);
        let Err(error) = tokio::spawn(self.attends(asks, poll, aborts, pulse)).await else { return };
        let why = format!("a fault of the program; report it: {}", words_of(error));
        let event = Some(Event::StationFailed { device: name, why });
        let _ = reports.send(StationReport { event, ..StationReport::default() }).await;
    }

    /// Serves requests until no sender is left, then releases the machine.
    async fn attends(mut self, mut asks: mpsc::Receiver<Ask>, poll: Duration, mut aborts: Aborts, pulse: Pulse) {
        let mut ticks = interval(poll);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                biased;
                ask = asks.recv() => match ask {
                    Some(Ask::Abort) => {
                        aborts.taken += 1;
                        self.act(Ask::Abort).await;
                    }
                    Some(ask) => tokio::select! {
                        biased;
                        () = aborts.ordered() => {}
                        () = self.act(ask) => {}
                    },
                    None => break,
                },
                // Checked at each tick: a loop that has hung may continue.
                _ = ticks.tick(), if self.seen.connected => if pulse.is_felt() {
                    tokio::select! {
                        biased;
                        () = aborts.ordered() => {}
                        () = self.look() => {}
                    }
                },
            }
        }
        if self.seen.connected && !self.seen.lost {
            // Optional: a machine whose owner is silent can be claimed by the next client.
            let _ = self.driver.machine().release().await;
        }
    }

    async fn tell(&mut self, event: Event) {
        self.tell_with(event, None).await;
    }

    async fn tell_with(&mut self, event: Event, detail: Option<serde_json::Value>) {
        // The drive listens until it drops the last ask; after that no one needs the event.
        let _ = self.reports.send(StationReport { event: Some(event), detail, ..StationReport::default() }).await;
    }

    async fn act(&mut self, ask: Ask) {
        let urgent = matches!(ask, Ask::Hold | Ask::Stop | Ask::Abort);
        if urgent {
            self.interrupt.lower();
        }
        match ask {
            Ask::Connect => self.connect().await,
            Ask::Load { cycle, load } => self.load(cycle, &load).await,
            Ask::VerifyClear => self.verify_clear().await,
            Ask::Prepare { number } => self.prepare(number).await,
            Ask::Start { cycle } => self.start(cycle).await,
            Ask::Hold => self.hold().await,
            Ask::Resume => self.resume().await,
            Ask::Stop => self.stop().await,
            Ask::Abort => self.abort().await,
            Ask::Clear => self.clear().await,
            Ask::Reconcile { cycle } => self.reconcile(cycle).await,
            Ask::Collect { cycle } => self.collect(cycle).await,
            Ask::Acknowledge => self.acknowledge().await,
            Ask::Confirm { word, answer } => {
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
            self.pass_on_notes().await;
        }
    }

    async fn connect(&mut self) {
        let connected = async {
            let identity = self.driver.machine().connect().await?;
            let status = self.driver.machine().status().await?;
            // Do not take over a machine that runs the job of another run.
            if self.is_at_another_job(&status) {
                return Ok((identity, Err(at_work(&status))));
            }
            let status = self.driver.machine().claim().await?;
            Ok::<_, DeviceError>((identity, Ok(status)))
        };
        match connected.await {
            Ok((_, Err(found))) => {
                self.tell(Event::NotConnected { device: B::DEVICE, why: Mismatch::AtAnotherJob(found) }).await;
            }
            Ok((identity, Ok(status))) => {
                self.seen.connected = true;
                self.seen.state = Some(status.state);
                let found = self.found(&status).await;
                let (device, boot_id, simulated) = (B::DEVICE, identity.boot_id, identity.simulation);
                let detail = serde_json::json!({ "name": identity.name, "address": self.driver.machine().name() });
                self.tell_with(Event::Connected { device, boot_id, simulated, found }, Some(detail)).await;
            }
            Err(error) => self.tell(Event::NotConnected { device: B::DEVICE, why: mismatch(&error) }).await,
        }
    }

    fn is_at_another_job(&self, status: &Status) -> bool {
        let at_a_job = status.state.is_moving() || matches!(status.state, State::Held | State::Complete);
        at_a_job && status.job.is_none_or(|job| job.job != self.job)
    }

    /// Returns the occupation of a machine at the connection. A preparation of a client that is gone is taken back.
    async fn found(&mut self, status: &Status) -> Occupation {
        match status.state {
            State::Idle => Occupation::Idle,
            State::Aborted | State::Faulted => Occupation::ToClear,
            State::Prepared => match self.driver.machine().stop().await {
                Ok(_) => Occupation::Idle,
                Err(error) => Occupation::Busy(error.to_string()),
            },
            _ => Occupation::Busy(at_work(status)),
        }
    }

    async fn load(&mut self, cycle: u32, load: &Load) {
        self.loaded = None;
        match self.driver.load(load, &self.interrupt).await {
            Ok(digest) => {
                self.loaded = Some(digest);
                let event = match load {
                    Load::Plan(_) => Event::PlanLoaded { cycle },
                    Load::Pass(..) => Event::PassLoaded { cycle },
                };
                let detail = serde_json::json!({ "digest": format!("{digest:08x}") });
                self.tell_with(event, Some(detail)).await;
            }
            Err(error) => self.failed(Asked::Load, error).await,
        }
    }

    async fn verify_clear(&mut self) {
        match self.driver.machine().status().await {
            Ok(status) => {
                self.note_mode(&status).await;
                let device = B::DEVICE;
                let name = self.driver.machine().name().to_owned();
                let message = |clear: &str| format!("{name} is {} and {clear}", status.state);
                self.tell(match status.clear_of_part {
                    Some(false) => Event::Obstructed { device, message: message("not clear of the part") },
                    _ if status.state.is_moving() => Event::Obstructed { device, message: message("may be moving") },
                    Some(true) => Event::Cleared { device },
                    None => Event::ClearUnknown { device },
                })
                .await;
            }
            Err(error) => self.lost(&error).await,
        }
    }

    async fn prepare(&mut self, number: BatchId) {
        let cycle = number.cycle;
        self.armed = None;
        let Some(digest) = self.loaded else {
            let why = "no payload was loaded".to_owned();
            return self.tell(Event::Refused { device: B::DEVICE, what: Asked::Prepare, why }).await;
        };
        let job = Job { job: self.job, cycle: number.encode(), digest };
        let prepared = async {
            // A preparation whose answer was lost is still active but unknown here, so ask the machine.
            if self.driver.machine().status().await?.state == State::Prepared {
                self.driver.machine().stop().await?;
            }
            self.driver.machine().prepare(job).await
        };
        match prepared.await {
            Ok(armed) => {
                let detail = intent(&armed);
                self.armed = Some(armed);
                self.cycle = cycle;
                self.seen.state = Some(State::Prepared);
                self.tell_with(Event::Prepared { device: B::DEVICE, cycle }, Some(detail)).await;
            }
            Err(error) => self.failed(Asked::Prepare, error).await,
        }
    }

    async fn start(&mut self, cycle: u32) {
        let armed = self.armed.clone().filter(|armed| armed.job.batch_id().cycle == cycle);
        let Some(armed) = armed else {
            let why = "it is not prepared".to_owned();
            return self.tell(Event::Refused { device: B::DEVICE, what: Asked::Start, why }).await;
        };
        if self.seen.lost {
            return self.not_sent(Asked::Start).await;
        }
        let Seen { supplies_missing, manual, signal_out, signals_good_since, .. } = self.seen;
        self.seen = Seen {
            connected: true,
            running: true,
            supplies_missing,
            manual,
            signal_out,
            signals_good_since,
            ..Seen::default()
        };
        match self.driver.machine().start(armed).await {
            Ok(started) => {
                self.seen.state = Some(State::Execute);
                self.seen.at_job = started.status.state.is_moving();
                let detail = serde_json::json!({ "start_sequence": started.start_sequence });
                self.tell_with(Event::Started { device: B::DEVICE, cycle }, Some(detail)).await;
            }
            Err(error @ (DeviceError::Refused { .. } | DeviceError::Faulted { .. })) => {
                self.seen.running = false;
                self.failed(Asked::Start, error).await;
            }
            // After any other error, the machine may have received the START.
            Err(error) => {
                self.tell(Event::StartUnknown { device: B::DEVICE, cycle, why: error.to_string() }).await;
            }
        }
    }

    /// Refuses a command if the link was lost after the cell had requested it: nothing moves by this order until the
    /// machine is connected again.
    async fn not_sent(&mut self, what: Asked) {
        let why = "the link is lost, and the command was not sent".to_owned();
        self.tell(Event::Refused { device: B::DEVICE, what, why }).await;
    }

    async fn hold(&mut self) {
        match self.driver.machine().hold().await {
            Ok(status) => self.note(&status).await,
            Err(error) if error.is_link() => self.lost(&error).await,
            // Not in EXECUTE: the status shows if the machine holds already, has ended, or never ran.
            Err(error) => match self.driver.machine().status().await {
                Ok(status) if status.state == State::Held => self.tell(Event::MachineHeld { device: B::DEVICE }).await,
                // Already on its way to HELD, by its key or a button: the next status reads see it arrive.
                Ok(status) if status.state == State::Holding => self.note(&status).await,
                Ok(status) if status.state == State::Complete && self.seen.running => self.note(&status).await,
                Ok(status) if !status.state.is_moving() => self.tell(Event::MachineHeld { device: B::DEVICE }).await,
                Ok(_) => self.failed(Asked::Hold, error).await,
                Err(error) => self.lost(&error).await,
            },
        }
    }

    async fn resume(&mut self) {
        if self.seen.lost {
            return self.not_sent(Asked::Resume).await;
        }
        match self.driver.machine().resume().await {
            Ok(status) => self.note(&status).await,
            Err(error) => self.failed(Asked::Resume, error).await,
        }
    }

    async fn stop(&mut self) {
        self.seen.stopping = true;
        match self.driver.machine().stop().await {
            Ok(status) => {
                self.seen.stop_taken = Some(Instant::now());
                self.note(&status).await;
            }
            Err(error) if error.is_link() => self.lost(&error).await,
            Err(error) => match self.driver.machine().status().await {
                Ok(status) if !status.state.is_moving() => self.note(&status).await,
                _ => self.failed(Asked::Stop, error).await,
            },
        }
    }

    async fn abort(&mut self) {
        self.seen.aborting = true;
        if !self.seen.connected
            && let Err(why) = self.meet().await
        {
            let device = B::DEVICE;
            return self.tell(Event::Refused { device, what: Asked::Abort, why }).await;
        }
        match self.driver.machine().abort().await {
            Ok(status) => self.note(&status).await,
            Err(error) => self.failed(Asked::Abort, error).await,
        }
    }

    /// Connects a machine that a restarted program has not seen yet before an abort. Refuses another device, and a
    /// machine that runs the job of another run. A machine that cannot be reached now is left to the abort itself.
    async fn meet(&mut self) -> Result<(), String> {
        let met = async {
            self.driver.machine().connect().await?;
            self.driver.machine().status().await
        };
        match met.await {
            Ok(status) if self.is_at_another_job(&status) => {
                Err(format!("it has a job of another run: {}", at_work(&status)))
            }
            Ok(_) => {
                self.seen.connected = true;
                Ok(())
            }
            Err(error) if error.is_link() => Ok(()),
            Err(error) => Err(error.to_string()),
        }
    }

    async fn clear(&mut self) {
        self.seen.clearing = true;
        match self.driver.machine().clear().await {
            Ok(status) => self.note(&status).await,
            Err(error) => self.failed(Asked::Clear, error).await,
        }
    }

    async fn reconcile(&mut self, cycle: u32) {
        let Some(armed) = self.armed.clone().filter(|armed| armed.job.batch_id().cycle == cycle) else {
            // The machine cannot be asked about a job that this program has not prepared, and nothing is concluded.
            let why = "this program has no preparation of this cycle".to_owned();
            let outcome = Reconciliation::Unknown(why);
            return self.tell(Event::Reconciled { device: B::DEVICE, cycle, outcome }).await;
        };
        let outcome = match self.driver.machine().reconcile(&armed).await {
            Ok(Reconciled::Running(status)) if status.state == State::Held => Reconciliation::Held,
            Ok(Reconciled::Running(_)) => Reconciliation::Running,
            Ok(Reconciled::Finished(status)) => {
                if status.state == State::Complete && self.fetch_record().await.is_err() {
                    return;
                }
                self.doubt_early_end(&status).await;
                self.seen.ended = true;
                Reconciliation::Ended(job_result(status.outcome))
            }
            Ok(Reconciled::NotStarted(_)) => {
                self.seen.running = false;
                Reconciliation::NotStarted
            }
            Ok(Reconciled::Unknown { reason: why }) => Reconciliation::Unknown(why),
            Ok(answer) => Reconciliation::Unknown(format!("unknown answer: {answer:?}")),
            Err(error) if error.is_link() => return self.lost(&error).await,
            Err(error) => Reconciliation::Unknown(error.to_string()),
        };
        if matches!(outcome, Reconciliation::Running | Reconciliation::Held) {
            self.seen.running = true;
            self.seen.ended = false;
            (self.seen.at_job, self.seen.absent) = (true, 0);
        }
        self.tell(Event::Reconciled { device: B::DEVICE, cycle, outcome }).await;
    }

    async fn collect(&mut self, cycle: u32) {
        let armed = self.armed.as_ref().filter(|armed| armed.job.batch_id().cycle == cycle);
        let Some(job) = armed.map(|armed| armed.job) else {
            let why = "this program has no job of this cycle for it".to_owned();
            return self.tell(Event::Refused { device: B::DEVICE, what: Asked::Collect, why }).await;
        };
        match self.driver.fetch(job, &self.interrupt).await {
            // The drive checks the points and reports to the cell; this only hands them over.
            Ok(fetched) => self.hand_over(fetched).await,
            Err(error) => match unusable(&error) {
                Some(failure) => {
                    let (targets, found) = (0, 0);
                    self.tell(Event::Collected { cycle, targets, found, gate: Gate::Failed(failure) }).await;
                }
                None => self.failed(Asked::Collect, error).await,
            },
        }
    }

    async fn hand_over(&mut self, fetched: Fetched) {
        // The drive listens as long as a sender of requests exists.
        let _ = self.reports.send(StationReport { fetched: Some(fetched), ..StationReport::default() }).await;
    }

    async fn acknowledge(&mut self) {
        let acknowledged = async {
            let status = self.driver.machine().status().await?;
            match status.state {
                State::Complete => self.driver.machine().acknowledge(status.done).await,
                _ => Ok(status),
            }
        };
        match acknowledged.await {
            // A result that does not exist yet is not acknowledged.
            Ok(status) if status.state.is_moving() || status.state == State::Held => {
                let (device, why) =
                    (B::DEVICE, format!("{} is still {}", self.driver.machine().name(), at_work(&status)));
                self.tell(Event::Refused { device, what: Asked::Discard, why }).await;
            }
            Ok(status) => {
                self.seen.state = Some(status.state);
                self.seen.running = false;
                self.tell(Event::Acknowledged { device: B::DEVICE }).await;
            }
            Err(error) => self.failed(Asked::Acknowledge, error).await,
        }
    }

    /// Reports that the machine refused, or that it cannot be reached.
    async fn failed(&mut self, what: Asked, error: DeviceError) {
        if error.is_link() {
            self.lost(&error).await;
        }
        match error {
            DeviceError::Faulted { fault, .. } if fault != Fault::None => {
                let (device, message) = (B::DEVICE, fault_words(B::DEVICE, fault));
                self.tell(Event::Fault { device, code: fault.number(), message }).await;
            }
            _ => self.tell(Event::Refused { device: B::DEVICE, what, why: error.to_string() }).await,
        }
    }

    async fn lost(&mut self, error: &DeviceError) {
        if !std::mem::replace(&mut self.seen.lost, true) {
            if self.seen.back.is_none_or(|back| back.elapsed() > STEADY_AFTER) {
                self.seen.tries = 0;
            } else {
                self.pause_before_next_try();
            }
            let answers = if error.is_link() {
                ""
            } else {
                "the machine answers, but not as the cell file and docs/modbus.md define it: "
            };
            self.tell(Event::LinkLost { device: B::DEVICE, why: format!("{answers}{error}") }).await;
        }
    }

    /// Polls the status, or tries to reach a lost machine.
    async fn look(&mut self) {
        if self.seen.lost {
            return self.reach().await;
        }
        match self.driver.machine().status().await {
            Ok(status) => {
                self.pass_on_notes().await;
                self.note(&status).await;
                self.read_ahead().await;
            }
            Err(error) => self.lost(&error).await,
        }
    }

    /// Reads points of a running job while no other request waits: an order raises the interrupt and comes first.
    async fn read_ahead(&mut self) {
        let Some(armed) = self.armed.as_ref().filter(|_| self.seen.running && !self.seen.ended) else { return };
        let preliminary = self.driver.read_ahead(armed.job, &self.interrupt).await;
        if preliminary.is_some() {
            let _ = self.reports.send(StationReport { preliminary, ..StationReport::default() }).await;
        }
    }

    /// Reports changes of the notes for a person.
    async fn pass_on_notes(&mut self) {
        let notes = self.driver.machine().notes();
        let new: Vec<String> = notes.iter().filter(|message| !self.notes.contains(message)).cloned().collect();
        let changed = self.notes != notes;
        self.notes = notes;
        if changed {
            let notes = Some(Notes { device: B::DEVICE, all: self.notes.clone(), new });
            let _ = self.reports.send(StationReport { notes, ..StationReport::default() }).await;
        }
    }

    async fn reach(&mut self) {
        if self.seen.next_try.is_some_and(|at| Instant::now() < at) {
            return;
        }
        let reached = async {
            let identity = self.driver.machine().connect().await?;
            // An abort needs no owner, and neither does the check of its effect.
            if !self.seen.aborting {
                self.driver.machine().claim().await?;
            }
            Ok::<_, DeviceError>(identity)
        };
        match reached.await {
            Ok(identity) => {
                self.seen.lost = false;
                self.seen.back = Some(Instant::now());
                self.seen.state = None;
                self.tell(Event::LinkBack { device: B::DEVICE, boot_id: identity.boot_id }).await;
            }
            Err(_) => self.pause_before_next_try(),
        }
    }

    fn pause_before_next_try(&mut self) {
        let pause = Duration::from_millis(100) * 2u32.saturating_pow(self.seen.tries.min(10));
        self.seen.tries += 1;
        self.seen.next_try = Some(Instant::now() + pause.min(LONGEST_PAUSE));
    }

    /// Reports the changes since the last status.
    async fn note(&mut self, status: &Status) {
        let before = self.seen.state.replace(status.state);
        self.note_mode(status).await;
        self.note_clear(status).await;
        self.note_supplies(status).await;
        self.note_signals(status).await;
        self.note_absence(status).await;
        self.note_contradiction(before, status).await;
        match status.state {
            State::Execute => {
                if before == Some(State::Held) {
                    self.tell(Event::MachineResumed { device: B::DEVICE }).await;
                }
                self.note_progress(status).await;
            }
            State::Held if before != Some(State::Held) => self.tell(Event::MachineHeld { device: B::DEVICE }).await,
            State::Complete => self.note_end(status).await,
            State::Idle if self.seen.stopping => {
                self.seen.stopping = false;
                self.seen.running = false;
                self.end(JobResult::Stopped).await;
            }
            State::Idle if self.seen.clearing => {
                self.seen.clearing = false;
                let (device, boot_id) = (B::DEVICE, status.boot_id.unwrap_or_default());
                self.tell(Event::Connected { device, boot_id, simulated: false, found: Occupation::Idle }).await;
            }
            State::Aborted => self.note_abort(before).await,
            State::Faulted if before != Some(State::Faulted) => {
                let fault = status.fault.unwrap_or(Fault::Other(0));
                let (device, code, message) = (B::DEVICE, fault.number(), fault_words(B::DEVICE, fault));
                self.tell(Event::Fault { device, code, message }).await;
            }
            _ => {}
        }
    }

    /// Reports when a machine that was seen at the job of this run shows no job or another one, and no end.
    async fn note_absence(&mut self, status: &Status) {
        let Seen { running, ended, stopping, clearing, aborting, .. } = self.seen;
        if !running || ended || stopping || clearing || aborting {
            return;
        }
        let is_another = status.job.is_some_and(|job| job.job != self.job);
        let at_a_job = status.state.is_moving() || matches!(status.state, State::Held | State::Complete);
        if at_a_job && !is_another {
            (self.seen.at_job, self.seen.absent) = (true, 0);
        }
        if !self.seen.at_job || !(matches!(status.state, State::Idle | State::Prepared) || at_a_job && is_another) {
            return;
        }
        self.seen.absent += 1;
        if self.seen.absent == ABSENT_AFTER {
            self.tell(Event::JobVanished { device: B::DEVICE, why: format!("it is {}", at_work(status)) }).await;
        }
    }

    /// Reports a contradiction in the status of a machine: it reports HELD but makes progress, or took a STOP and
    /// continues.
    async fn note_contradiction(&mut self, before: Option<State>, status: &Status) {
        let device = B::DEVICE;
        let is_held = status.state == State::Held && before == Some(State::Held);
        match status.progress.filter(|_| is_held) {
            Some((done, total)) => {
                let (last, _) = self.seen.progress.replace((done, total)).unwrap_or((done, total));
                self.seen.rises += u32::from(done > last);
                if done > last && self.seen.running && self.seen.rises.is_multiple_of(RISES_AFTER) {
                    let why = format!("it reports HELD, but its progress has risen to {done} of {total}");
                    self.tell(Event::Refused { device, what: Asked::Hold, why }).await;
                }
            }
            None => self.seen.rises = 0,
        }
        let is_late = self.seen.stop_taken.is_some_and(|taken| taken.elapsed() > STOPS_WITHIN);
        if self.seen.stopping && is_late && status.state == State::Execute {
            self.seen.stop_taken = None;
            let why = format!("it took the STOP, but is still EXECUTE {} s later", STOPS_WITHIN.as_secs());
            self.tell(Event::Refused { device, what: Asked::Stop, why }).await;
        }
    }

    /// Reports a pass that the grinder calls complete before the path is travelled.
    async fn doubt_early_end(&mut self, status: &Status) {
        let (Device::Grinder, Outcome::Complete, Some((done, total))) = (B::DEVICE, status.outcome, status.progress)
        else {
            return;
        };
        if f64::from(done) < COMPLETE_FROM * f64::from(total) {
            let why = format!("the grinder reports the pass as complete at a progress of {done} of {total}");
            self.tell(Event::RecordDoubted { cycle: self.cycle, why }).await;
        }
    }

    /// Reports when a machine leaves automatic mode, and when it returns.
    async fn note_mode(&mut self, status: &Status) {
        let Some(manual) = status.automatic.map(|automatic| !automatic) else { return };
        if std::mem::replace(&mut self.seen.manual, manual) == manual {
            return;
        }
        let device = B::DEVICE;
        let event = if manual {
            let message = format!("{} reports manual mode", self.driver.machine().name());
            Event::NotAutomatic { device, message }
        } else {
            Event::AutomaticAgain { device }
        };
        self.tell(event).await;
    }

    /// Reports when a machine without a job is no longer clear of the part: a person has moved it.
    async fn note_clear(&mut self, status: &Status) {
        let Some(clear) = status.clear_of_part else { return };
        let before = self.seen.clear.replace(clear);
        if before == Some(true) && !clear && !self.seen.running {
            let message =
                format!("{} is {} and no longer clear of the part", self.driver.machine().name(), status.state);
            self.tell(Event::Obstructed { device: B::DEVICE, message }).await;
        }
    }

    async fn note_supplies(&mut self, status: &Status) {
        let Some(missing) = status.supplies.map(|there| !there) else { return };
        if std::mem::replace(&mut self.seen.supplies_missing, missing) == missing {
            return;
        }
        let (device, condition) = (B::DEVICE, Condition::Supplies);
        let event = if missing {
            let message = format!("{} reports that air or coolant is missing", self.driver.machine().name());
            Event::ConditionLost { device, condition, message }
        } else {
            Event::ConditionBack { device, condition }
        };
        self.tell(event).await;
    }

    /// Reports when a signal leaves its range, and when all signals have been in range for a while.
    async fn note_signals(&mut self, status: &Status) {
        let flaws: Vec<String> = status.signals.iter().filter_map(SignalValue::problem).collect();
        let (device, condition) = (B::DEVICE, Condition::Signals);
        if !flaws.is_empty() {
            self.seen.signals_good_since = None;
            if !std::mem::replace(&mut self.seen.signal_out, true) {
                self.tell(Event::ConditionLost { device, condition, message: flaws.join("; ") }).await;
            }
        } else if self.seen.signal_out {
            let since = *self.seen.signals_good_since.get_or_insert_with(Instant::now);
            if since.elapsed() >= BELIEVED_AFTER {
                self.seen.signal_out = false;
                self.tell(Event::ConditionBack { device, condition }).await;
            }
        }
    }

    async fn note_progress(&mut self, status: &Status) {
        let (Some(progress), now) = (status.progress, Instant::now()) else { return };
        let due = self.seen.told_progress.is_none_or(|at| now - at >= PROGRESS_EVERY);
        if due && self.seen.progress != Some(progress) {
            (self.seen.progress, self.seen.told_progress) = (Some(progress), Some(now));
            let (done, total) = progress;
            self.tell(Event::Progressed { device: B::DEVICE, done, total }).await;
        }
    }

    /// Reports that the job is over. The record of a pass is read first.
    async fn note_end(&mut self, status: &Status) {
        if self.seen.ended && !self.seen.stopping {
            return;
        }
        if !self.seen.running && !self.seen.stopping {
            return;
        }
        if !self.seen.ended && self.fetch_record().await.is_err() {
            return; // The next look tries again.
        }
        if !self.seen.ended {
            self.doubt_early_end(status).await;
        }
        self.seen.stopping = false;
        self.seen.running = false;
        self.end(job_result(status.outcome)).await;
    }

    /// Reads the record of a finished pass and hands it over. A record that does not belong to this job is reported as
    /// doubtful.
    ///
    /// # Errors
    /// A lost link, which has been reported.
    async fn fetch_record(&mut self) -> Result<(), ()> {
        let (Device::Grinder, Some(armed)) = (B::DEVICE, &self.armed) else { return Ok(()) };
        // Short: one or two pages. No interrupt is needed; an abort gives the request up.
        match self.driver.fetch(armed.job, &Interrupt::new()).await {
            Ok(record) => self.hand_over(record).await,
            Err(error) if error.is_link() => {
                self.lost(&error).await;
                return Err(());
            }
            Err(error) => self.tell(Event::RecordDoubted { cycle: self.cycle, why: error.to_string() }).await,
        }
        Ok(())
    }

    async fn end(&mut self, result: JobResult) {
        self.seen.ended = true;
        self.tell(Event::Ended { device: B::DEVICE, cycle: self.cycle, result }).await;
    }

    async fn note_abort(&mut self, before: Option<State>) {
        if std::mem::replace(&mut self.seen.aborting, false) {
            self.seen.running = false;
            self.tell(Event::AbortConfirmed { device: B::DEVICE }).await;
        } else if before != Some(State::Aborted) && self.seen.running
            || std::mem::replace(&mut self.seen.stopping, false)
        {
            self.seen.running = false;
            self.end(JobResult::Aborted).await;
        }
    }
}

/// Describes the state and job of a machine.
fn at_work(status: &Status) -> String {
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

/// Describes a fault for this machine.
fn fault_words(device: Device, fault: Fault) -> String {
    match (device, fault) {
        // A probe that meets material where only air should be is not at fault: the part is in another place.
        (Device::Cmm, Fault::Collision) => {
            "the probe touched material where only air is expected: before clearing, check the position of the part (turned, \
             in another seat, another part) and the probe"
                .to_owned()
        }
        (_, fault) => fault.to_string(),
    }
}

/// Returns the reason if a result arrived but cannot be used. Returns `None` if it did not arrive.
fn unusable(error: &DeviceError) -> Option<GateFailure> {
    match error {
        DeviceError::NotFinite { .. }
        | DeviceError::OutOfRange { .. }
        | DeviceError::Unlisted { .. }
        | DeviceError::WrongCount { .. } => Some(GateFailure::Broken(error.to_string())),
        DeviceError::Mismatch { .. } => Some(GateFailure::Foreign(error.to_string())),
        _ => None,
    }
}

fn mismatch(error: &DeviceError) -> Mismatch {
    let message = error.to_string();
    match error {
        DeviceError::WrongWordOrder { .. } => Mismatch::WordOrder(message),
        DeviceError::WrongLengthUnit { .. } => Mismatch::Inches,
        DeviceError::Refused { answer: crate::device::Answer::NotOwner, .. } => Mismatch::Owned(message),
        error if error.is_link() => Mismatch::Unreachable(message),
        _ => Mismatch::WrongDevice(message),
    }
}

/// Intent of a START, as the journal stores it.
#[derive(Serialize, serde::Deserialize)]
pub(super) struct Intent {
    pub(super) job: u32,
    pub(super) cycle: u16,
    pub(super) digest: u32,
    pub(super) start_sequence: u32,
    pub(super) token: u32,
    pub(super) boot_id: u32,
}

impl Intent {
    /// Restores the preparation.
    pub(super) fn armed(&self) -> Armed {
        let job = Job { job: self.job, cycle: self.cycle, digest: self.digest };
        Armed { job, start_sequence: self.start_sequence, token: self.token, boot_id: self.boot_id }
    }
}

fn intent(armed: &Armed) -> serde_json::Value {
    let Armed { job: Job { job, cycle, digest }, start_sequence, token, boot_id } = *armed;
    serde_json::to_value(Intent { job, cycle, digest, start_sequence, token, boot_id }).expect("numbers are JSON")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_loop_that_hangs_is_not_felt() {
        let pulse = Pulse::new();
        assert!(pulse.is_felt());
        tokio::time::advance(HUNG_AFTER).await;
        assert!(!pulse.is_felt());
        pulse.beat();
        assert!(pulse.clone().is_felt());
    }
}
