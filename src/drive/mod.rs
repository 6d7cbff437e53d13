//! Drive: the only module where commands meet machines. One loop, one select.
//!
//! ```text
//!  orders (control socket, Ctrl-C) --+                       +--> stations: a task for each machine
//!  facts (stations, computations) ---+--> Cell::handle --> commands --> computations, off the asynchronous threads
//!  the deadline of the cell ---------+       ^      |        +--> notices, for whoever shows the run
//!                                            |      v
//!                                        journal: events before they are handled, commands before execution
//! ```
//!
//! The loop never waits for the disk. It decides on an event at once, and sends commands that make the cell safe at
//! once. Everything else waits in a queue until the journal has all earlier records; this includes the answer to the
//! person who gave an order.

mod adaptive_measurement;
mod blocking_executor;
mod comparison;
mod computation;
mod cycle_output;
mod cycles;
mod failure;
mod notice;
mod outcome;
mod pass_record;
mod pipeline;
mod preview;
mod program;
mod progress_estimator;
mod recorder;
pub mod recovery;
mod replay;
mod snapshot;
mod station;
mod task;

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use regrind_control::{Control, EndpointChange, ReceivedOrder};
pub use regrind_control::{CycleRow, JobProgress, PreviewStatistics, Reply, Request, Snapshot, is_live, send_request};
use serde::Serialize;
use serde_json::{Value, json};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::{JoinError, JoinSet};
use tokio::time::Instant;

use crate::cell::{
    Actor, Cell, CellPlan, Command, ComparedFigure, CompensationRefusal, Device, Ending, Event, GateFailure,
    GateResult, Judgement, MachineRequest, Phase, RecordFailure, State, StateName,
};
use crate::device::{
    AnyCmm, AnyGrinder, Armed, BatchId, Cmm, Grinder, Identified, Interrupt, Job, Measurement, OperatorConfirmation,
    PassRecord, PreliminaryPoints, hex,
};
use crate::formats::{LEARNED, write_json_atomic};
use crate::journal::{self, Artefact};
use crate::record::{
    self, CommandRecord, Confirmation, Content, EventDetail, EventRecord, PartEnd, Remark, RunEnd, StartIntent,
    TouchCounts, Transfer, TransferNote,
};
pub use blocking_executor::{BlockingExecutor, BlockingWork};
use computation::{Computation, batch_folder, create_folder, cycle_folder};
use cycles::Cycles;
use failure::{failure_message, panic_message};
pub use notice::Notice;
use preview::PreviewAccumulator;
pub use program::{ProgramError, Programs};
use progress_estimator::ProgressEstimator;
pub use recorder::JournalSink;
use recorder::{OutputFiles, RecordReceipt, Recorder, nanoseconds};
pub use replay::{InterruptedRun, ReplayError};
use station::{
    AbortCounter, CmmDriver, FetchedResult, GrinderDriver, LoopWatchdog, MachineNotes, MachinePayload, MachineTask,
    StationDriver, StationReport, StationRequest, WATCHDOG_INTERVAL,
};
use task::ComputationProduct;
pub(crate) use task::correction_grid;
pub use task::{AdaptiveOptions, ParameterCompensation, Probing, ReferenceSphere, Task};

/// Inputs of a run besides its machines.
pub struct RunInputs {
    /// Parameters by which the cell decides.
    pub plan: CellPlan,
    /// Data and options of the computations.
    pub task: Task,
    /// Journal of the run: a new one, or an open one of an interrupted run.
    pub journal: Box<dyn JournalSink>,
    /// Number of the run, which the machines get with each job.
    pub job: u32,
    /// Person who began the run.
    pub actor: Actor,
    /// True if the cell need not ask to load the part: the cell is simulated, or the person who begins the run has
    /// confirmed it.
    pub load_confirmed: bool,
    /// Poll interval of each machine: CMM, grinder.
    pub poll_intervals: [Duration; 2],
    /// Channel for notices.
    pub notices: mpsc::UnboundedSender<Notice>,
    /// Interrupted run to continue.
    pub interrupted: Option<InterruptedRun>,
    /// Executor of blocking work.
    pub executor: BlockingExecutor,
}

/// Channel for orders that come from this process: by Ctrl-C or at a prompt.
#[derive(Clone)]
pub struct OrderSender {
    orders: mpsc::Sender<ReceivedOrder>,
    status: watch::Receiver<Snapshot>,
}

impl OrderSender {
    /// Sends an order to the run, and does not wait for the answer. Does nothing if the run is over.
    pub async fn send(&self, request: Request, actor: Actor) {
        // A run that is over needs no orders.
        let _ = self.orders.send(ReceivedOrder { request, actor, answer: None }).await;
    }

    /// Sends the order `request` of `actor` to the run, and waits for the answer. A client of the control socket would
    /// get the same answer. Returns `None` if the run is over.
    pub async fn send_and_wait(&self, request: Request, actor: Actor) -> Option<Reply> {
        let (answer, answered) = oneshot::channel();
        self.orders.send(ReceivedOrder { request, actor, answer: Some(answer) }).await.ok()?;
        answered.await.ok()
    }

    /// Returns a receiver for the snapshots of the run. The receiver holds the latest snapshot and is notified of each
    /// new one.
    pub fn status(&self) -> watch::Receiver<Snapshot> {
        self.status.clone()
    }

    /// Returns true if the cell is in the state Execute. It is then neither held nor suspended, and in no transition to
    /// or from these states.
    pub fn is_executing(&self) -> bool {
        self.status.borrow().state == StateName::Execute
    }
}

/// Run that is ready to begin.
pub struct Drive {
    cell: Cell,
    task: Arc<Task>,
    recorder: Recorder,
    folder: PathBuf,
    /// The serial number of the part.
    serial: String,
    job: u32,
    actor: Actor,
    load_confirmed: bool,
    started_at: Instant,
    /// Duration of the run before it was interrupted.
    elapsed_before: Duration,
    requests: [mpsc::Sender<StationRequest>; 2],
    interrupts: [Interrupt; 2],
    /// Number of aborts ordered for each station. When the number increases, the station cancels the request in
    /// progress.
    abort_counts: [watch::Sender<u64>; 2],
    watchdog: LoopWatchdog,
    reports: mpsc::Receiver<StationReport>,
    executor: BlockingExecutor,
    computations: JoinSet<ComputationResult>,
    /// Cycle and kind of each computation.
    running_computations: HashMap<tokio::task::Id, (u32, Computation)>,
    orders: mpsc::Receiver<ReceivedOrder>,
    status: watch::Sender<Snapshot>,
    notices: mpsc::UnboundedSender<Notice>,
    cycles: Cycles,
    progress_estimator: ProgressEstimator,
    preview_statistics: PreviewAccumulator,
    /// Notes of each machine on why it waits, in words.
    notes: [Vec<String>; 2],
    /// Disk usage of the files of each cycle, and the maximum of all.
    cycle_bytes: BTreeMap<u32, u64>,
    max_cycle_bytes: u64,
    /// Number of changes of state of the cell.
    state_changes: u64,
    /// Number of attempts of each computation of each cycle.
    attempts: BTreeMap<(u32, Computation), u32>,
    /// Last preparation of each machine: CMM, grinder.
    armed: [Option<StartIntent>; 2],
    /// Commands without an answering event so far, by the numbers of the recorder.
    open_commands: Vec<(u64, Command)>,
    /// Entries that wait to be recorded, in order.
    backlog: VecDeque<PendingRecord>,
    /// Reason why nothing can be recorded at present; `None` if records are written.
    record_failure_reason: Option<String>,
    /// Judgement that the interrupted program did not write to a file, and its number within its cycle.
    unannounced_judgement: Option<(u32, Judgement)>,
    /// Files that the interrupted program did not record.
    unrecorded_files: Vec<String>,
    ending: Option<Ending>,
    station_tasks: Vec<tokio::task::JoinHandle<()>>,
    control: Control,
}

/// Record that is not yet written, and the action that follows it.
struct PendingRecord {
    receipt: RecordReceipt,
    action: RecordAction,
}

enum RecordAction {
    Nothing,
    Execute(Box<Command>),
    Answer { answer: oneshot::Sender<Reply>, accepted: bool, message: String },
    Confirm { device: Device, confirmation: OperatorConfirmation, answer: oneshot::Sender<Result<(), String>> },
}

/// Converts a change of the control endpoint (lost or created again) into an event.
fn control_event(change: EndpointChange) -> Event {
    match change {
        EndpointChange::Lost(reason) => Event::ControlLost { reason },
        EndpointChange::Restored => Event::ControlBack,
    }
}

/// Result of a computation.
struct ComputationResult {
    cycle: u32,
    /// `None` if no event follows.
    event: Option<Event>,
    product: ComputationProduct,
    /// Files that the computation created, written to the disk and read back.
    files: Result<Vec<Artefact>, RecordFailure>,
}

impl Drive {
    /// Prepares a run with the machine drivers that a cell file selects. Does the same as [`Drive::new`], but is not
    /// generic. Therefore the code of a run is compiled once in this crate, and not in every crate that calls it.
    ///
    /// # Errors
    /// Those of [`Drive::new`].
    pub fn with_cell(run: RunInputs, cmm: AnyCmm, grinder: AnyGrinder) -> std::io::Result<(Self, OrderSender)> {
        Self::new(run, cmm, grinder)
    }

    /// Prepares a run with the drivers `cmm` and `grinder`. Creates a task for each machine, the control socket in the
    /// run folder, and the recorder of the journal. Sends no command to a machine. Returns the run, and a sender with
    /// which this process gives orders to the run.
    ///
    /// # Errors
    /// The control socket cannot be created in the run folder.
    pub fn new<C: Cmm + 'static, G: Grinder + 'static>(
        run: RunInputs,
        cmm: C,
        grinder: G,
    ) -> std::io::Result<(Self, OrderSender)> {
        let (reports, reported) = mpsc::channel(64);
        let (orders, ordered) = mpsc::channel(16);
        let (status, seen) = watch::channel(Snapshot::default());
        let mut interrupted = run.interrupted.unwrap_or_else(|| InterruptedRun::new(run.plan));
        let (ids, open): (Vec<u32>, Vec<Command>) = std::mem::take(&mut interrupted.open_commands).into_iter().unzip();
        let serial = run.journal.serial().to_owned();
        let recorder = Recorder::new(run.journal, &ids, &run.executor);
        let folder = recorder.folder().to_owned();
        let control =
            Control::listen(&folder, orders.clone(), seen.clone(), matches!(run.executor, BlockingExecutor::Threads))?;
        let interrupts = [Interrupt::new(), Interrupt::new()];
        let aborts = [watch::Sender::new(0), watch::Sender::new(0)];
        let pulse = LoopWatchdog::new();
        let [of_cmm, of_grinder] = Device::BOTH.map(|device| interrupted.last_preparation(device));
        let [poll_cmm, poll_grinder] = run.poll_intervals;
        let (cmm, cmm_task) =
            spawn_station(CmmDriver(cmm), run.job, (&interrupts[0], &aborts[0], &pulse), &reports, of_cmm, poll_cmm);
        let (grinder, grinder_task) = spawn_station(
            GrinderDriver(grinder),
            run.job,
            (&interrupts[1], &aborts[1], &pulse),
            &reports,
            of_grinder,
            poll_grinder,
        );
        let drive = Self {
            serial,
            cell: interrupted.cell,
            task: Arc::new(run.task),
            recorder,
            folder,
            job: run.job,
            actor: run.actor,
            load_confirmed: run.load_confirmed,
            started_at: Instant::now(),
            elapsed_before: interrupted.elapsed,
            requests: [cmm, grinder],
            interrupts,
            abort_counts: aborts,
            watchdog: pulse,
            reports: reported,
            executor: run.executor,
            computations: JoinSet::new(),
            running_computations: HashMap::new(),
            orders: ordered,
            status,
            notices: run.notices,
            cycles: interrupted.cycles,
            progress_estimator: ProgressEstimator::default(),
            preview_statistics: PreviewAccumulator::default(),
            notes: [Vec::new(), Vec::new()],
            cycle_bytes: BTreeMap::new(),
            max_cycle_bytes: 0,
            state_changes: interrupted.state_changes,
            attempts: interrupted.attempts,
            armed: interrupted.armed,
            open_commands: (1..).zip(open).collect(),
            backlog: VecDeque::new(),
            record_failure_reason: None,
            unannounced_judgement: interrupted.unannounced_judgement,
            unrecorded_files: interrupted.unrecorded_files,
            ending: interrupted.ending,
            station_tasks: vec![cmm_task, grinder_task],
            control,
        };
        drive.status.send_replace(drive.snapshot());
        Ok((drive, OrderSender { orders, status: seen }))
    }

    /// Accepts orders also at the socket path `place`. Clients can then reach the cell even if its run folder is gone.
    /// Does nothing on Windows.
    ///
    /// # Errors
    /// Returns an error if no socket can be created at that path.
    pub fn listen_also_at(&mut self, place: &Path) -> std::io::Result<()> {
        self.control.listen_also_at(place)
    }

    fn now(&self) -> Duration {
        self.elapsed_before + self.started_at.elapsed()
    }

    /// Executes the run until the cell reaches an end state, and returns the ending. The future is boxed (its type is
    /// erased), so that its code is compiled in this crate and not again in each calling crate.
    pub fn run(self) -> Pin<Box<dyn Future<Output = Ending> + Send>> {
        Box::pin(self.run_to_end())
    }

    async fn run_to_end(mut self) -> Ending {
        let first = match self.cell.state() {
            State::Idle => Event::Start { actor: self.actor.clone() },
            _ => Event::Restarted { actor: self.actor.clone() },
        };
        self.handle_event(first, None).await;
        let left = std::mem::take(&mut self.unrecorded_files);
        self.record_files(self.cell.cycle(), recorder::sync_and_hash(&self.folder, &left)).await;
        if let Some((which, judgement)) = self.unannounced_judgement.take() {
            self.write_judgement(which, &judgement).await;
        }
        let mut beats = tokio::time::interval(WATCHDOG_INTERVAL);
        while self.ending.is_none() {
            self.watchdog.beat();
            let due = self.cell.next_deadline().map(|at| self.started_at + at.saturating_sub(self.elapsed_before));
            let deadline = async {
                match due {
                    Some(at) => tokio::time::sleep_until(at).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                biased;
                Some(ordered) = self.orders.recv() => self.handle_order(ordered).await,
                reason = self.recorder.next_failure() => self.report_record_failure(reason).await,
                recorded = wait_for_first_record(&mut self.backlog) => self.handle_recorded(recorded).await,
                Some(computed) = self.computations.join_next_with_id() => match computed {
                    Ok((id, computed)) => {
                        self.running_computations.remove(&id);
                        self.handle_computed(computed).await;
                    }
                    Err(error) => self.handle_panic(error).await,
                },
                Some(report) = self.reports.recv() => self.handle_report(report).await,
                change = self.control.changed() => drop(self.handle_event(control_event(change), None).await),
                () = deadline => drop(self.handle_event(Event::Deadline, None).await),
                _ = beats.tick() => {}
            }
            self.withdraw_pending_commands().await;
        }
        self.end_run().await
    }

    /// Reports to the cell that a computation has failed because its task panicked. The reason in the report states
    /// that this is a fault of the program, so that nobody looks for a fault of the part. Does nothing if the task is
    /// not a known computation.
    async fn handle_panic(&mut self, error: JoinError) {
        let Some((cycle, kind)) = self.running_computations.remove(&error.id()) else { return };
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

    /// Handles the oldest entry of the queue of entries that wait to be recorded, and removes it from this queue.
    /// `recorded` is the result of the attempt to record this entry.
    ///
    /// If the entry was recorded, does the action that waited for the record. This action is to execute a command, to
    /// answer an order, or to pass the confirmation of a person to the driver of a machine. A command is executed only
    /// if the cell still requires it.
    ///
    /// If the entry was not recorded, does not do this action, and reports the reason.
    async fn handle_recorded(&mut self, recorded: Result<(), RecordFailure>) {
        let Some(PendingRecord { action: then, .. }) = self.backlog.pop_front() else { return };
        match recorded {
            Ok(()) => self.record_failure_reason = None,
            Err(why) => {
                let reason = failure_message(&why);
                match then {
                    RecordAction::Execute(command) => self.report_not_recorded(*command).await,
                    RecordAction::Answer { answer, message, .. } => {
                        let message = format!("{message}; not recorded: {reason}");
                        drop(answer.send(Reply { accepted: false, message, status: self.snapshot() }));
                    }
                    RecordAction::Confirm { answer, .. } => drop(answer.send(Err(format!("not recorded: {reason}")))),
                    RecordAction::Nothing => {}
                }
                return self.report_record_failure(why).await;
            }
        }
        match then {
            RecordAction::Nothing => {}
            RecordAction::Execute(command) if self.cell.still_requires(&command) => self.execute(*command).await,
            RecordAction::Execute(command) => self.report_start_not_sent(*command).await,
            // The person who asked may be gone.
            RecordAction::Answer { answer, accepted, message } => {
                drop(answer.send(Reply { accepted, message, status: self.snapshot() }))
            }
            RecordAction::Confirm { device, confirmation: word, answer } => {
                self.send_request(device, StationRequest::Confirm { confirmation: word, answer }).await
            }
        }
    }

    /// Reports to the cell that a START was refused, because it was not sent. Either the START could not be recorded,
    /// or the cell changed its state before the record was written. Does nothing for other commands.
    async fn report_start_not_sent(&mut self, command: Command) {
        if let Command::StartMachine { device, .. } = command {
            let reason = "START was not sent, because START could not be recorded, or because the cell was held before START was recorded".to_owned();
            self.handle_event(Event::Refused { device, request: MachineRequest::Start, reason }, None).await;
        }
    }

    /// Reports to the cell that `command` was not sent, because it could not be recorded. A START is always reported,
    /// as refused. Any other command is reported only if the cell still requires it and expects an answer to it.
    async fn report_not_recorded(&mut self, command: Command) {
        if !self.cell.still_requires(&command) && !matches!(command, Command::StartMachine { .. }) {
            return;
        }
        match command {
            Command::StartMachine { .. } => self.report_start_not_sent(command).await,
            command if command.expects_answer() => {
                drop(self.handle_event(Event::NotOnRecord { command: command.name() }, None).await);
            }
            _ => {}
        }
    }

    /// Reports the failure `why` to write a record. Notifies people and the cell only of the first failure in a row.
    /// Then answers all orders that wait for their record.
    async fn report_record_failure(&mut self, reason: RecordFailure) {
        let message = failure_message(&reason);
        let is_known = self.record_failure_reason.replace(message.clone()).is_some();
        // The consequences of a failure fail too, including the record of the failure itself. They bring nothing new.
        if !is_known {
            self.notify(Notice::RecordFailed { message });
            self.handle_event(Event::RecordFailed { reason }, None).await;
        }
        self.answer_unrecorded_orders();
    }

    /// Withdraws the commands that wait for their record and to which the cell expects an answer, and reports this to
    /// the cell. Otherwise the cell would wait for these answers until the disk works again. The cell issues a command
    /// again if it still needs it. Does nothing while records can be written, or after the end of the run.
    async fn withdraw_pending_commands(&mut self) {
        if self.record_failure_reason.is_none() || self.ending.is_some() {
            return;
        }
        let leads_on = |then: &RecordAction| matches!(then, RecordAction::Execute(command) if command.expects_answer());
        let waiting = self.backlog.iter_mut().filter(|waiting| leads_on(&waiting.action));
        let withdrawn: Vec<RecordAction> =
            waiting.map(|waiting| std::mem::replace(&mut waiting.action, RecordAction::Nothing)).collect();
        for then in withdrawn {
            if let RecordAction::Execute(command) = then {
                self.report_not_recorded(*command).await;
            }
        }
    }

    /// Answers all orders that wait for their record with a refusal, so that no client waits for long. The message
    /// states that only steps to make the cell safe were carried out, and why the order was not recorded. Does nothing
    /// while records can be written.
    fn answer_unrecorded_orders(&mut self) {
        let Some(reason) = &self.record_failure_reason else { return };
        let status = self.snapshot();
        for waiting in &mut self.backlog {
            match std::mem::replace(&mut waiting.action, RecordAction::Nothing) {
                RecordAction::Answer { answer, message, .. } => {
                    let message = format!(
                        "{message}; only the steps that make the cell safe were carried out, because the order was not recorded: {reason}"
                    );
                    // The person who asked may be gone.
                    drop(answer.send(Reply { accepted: false, message, status: status.clone() }));
                }
                then => waiting.action = then,
            }
        }
    }

    /// Writes the end of the record and the results of the run, and releases the machines. Returns the ending.
    async fn end_run(mut self) -> Ending {
        let ending = self.ending.take().expect("the loop ended with one");
        self.orders.close();
        self.finish_backlog().await;
        // Running computations still write files into the run folder, so wait for them.
        while let Some(computed) = self.computations.join_next().await {
            if let Ok(ComputationResult { cycle, files, .. }) = computed {
                self.record_files(cycle, files).await;
            }
        }
        let rows: Vec<CycleRow> = self.cycles.rows(&self.cell.plan().tolerance);
        let touches = self.task.adaptive.map(|_| self.cycles.touch_counts(&self.task));
        let result = Value::from(RunEnd::Part(PartEnd {
            simulation: self.task.simulation,
            ending: ending.clone(),
            cycles: rows.clone(),
            touches: touches.map(|[taken, whole_patterns]| TouchCounts { taken, whole_patterns }),
        }));
        let now = self.now();
        self.write_document("result.json".into(), self.cell.cycle(), &result).await;
        self.save_learned(&ending).await;
        if let Err(failure) = self.recorder.close(now, self.cell.cycle(), result).await {
            self.notify(Notice::RecordFailed { message: failure_message(&failure) });
        }
        self.notify(Notice::Finished { ending: ending.clone(), cycles: rows, touches });
        // No more asks: each station gives its machine back and ends.
        self.requests = [mpsc::channel(1).0, mpsc::channel(1).0];
        for station in self.station_tasks.drain(..) {
            let _ = tokio::time::timeout(Duration::from_secs(2), station).await;
        }
        ending
    }

    /// Handles the order `request` of `actor`. Most orders go to the cell as events. A remark is only recorded, and a
    /// confirmation about a machine goes to the driver of this machine. Sends the reply through `answer`, if there is
    /// one, after the order is recorded.
    ///
    /// Refuses a resume if the state of the cell has changed since the person saw it. Does nothing for the requests
    /// `Status` and `Watch`.
    async fn handle_order(&mut self, ReceivedOrder { request, actor, answer }: ReceivedOrder) {
        if let Request::Resume { state_number: Some(seen), .. } = request
            && seen != self.state_changes
        {
            let message = format!(
                "the state of the cell changed before your order arrived; the state is now {}; check this state, then resume",
                self.cell.in_words()
            );
            // The person who asked may be gone.
            if let Some(answer) = answer {
                drop(answer.send(Reply { accepted: false, message, status: self.snapshot() }));
            }
            return;
        }
        let event = match request {
            Request::Started { .. } | Request::Done { .. } | Request::Still { .. } => {
                return self.handle_confirmation(&request, &actor, answer);
            }
            Request::Remark { what } => return self.record_remark(&what, &actor, answer),
            Request::Clear { device } => Event::ClearConfirmed { actor, device },
            Request::Hold { reason } => Event::Hold { actor, reason },
            Request::Resume { reason, .. } => Event::Resume { actor, reason },
            Request::Stop { reason } => Event::Stop { actor, reason },
            Request::Abort { reason } => Event::Abort { actor, reason },
            Request::Loaded => Event::LoadConfirmed { actor },
            Request::Over { device, evidence } => Event::DeclaredOver { actor, device, evidence },
            Request::Status | Request::Watch => return,
        };
        let (refusal, ticket) = self.handle_event(event, None).await;
        if let Some(answer) = answer {
            let accepted = refusal.is_none();
            let message = refusal.unwrap_or_else(|| self.cell.in_words());
            self.backlog.push_back(PendingRecord {
                receipt: ticket,
                action: RecordAction::Answer { answer, accepted, message },
            });
            self.answer_unrecorded_orders();
        }
    }

    /// Records the text `what` of a [`Request::Remark`]. Answers the program that sent the request through `answer`,
    /// after the text is recorded.
    fn record_remark(&mut self, what: &str, actor: &Actor, answer: Option<oneshot::Sender<Reply>>) {
        let ticket = self.append(self.now(), origin(actor), &Content::Remark(Remark { remark: what.to_owned() }));
        if let Some(answer) = answer {
            let then = RecordAction::Answer { answer, accepted: true, message: "recorded".into() };
            self.backlog.push_back(PendingRecord { receipt: ticket, action: then });
            self.answer_unrecorded_orders();
        }
    }

    /// Records the confirmation of a person about a machine that cannot report its own state, and then passes it to the
    /// driver of this machine. Sends the result through `answer`, if there is one. The reply is a refusal if the
    /// confirmation does not fit the run, cannot be recorded, or is refused by the driver.
    fn handle_confirmation(&mut self, request: &Request, actor: &Actor, answer: Option<oneshot::Sender<Reply>>) {
        let asked = self.operator_confirmation(request).map(|(confirmed, word)| {
            let (device, ..) = confirmed.parts();
            let ticket = self.append(self.now(), origin(actor), &Content::Confirmation(confirmed));
            let (told, taken) = oneshot::channel();
            self.backlog.push_back(PendingRecord {
                receipt: ticket,
                action: RecordAction::Confirm { device, confirmation: word, answer: told },
            });
            taken
        });
        let status = self.snapshot();
        // The station answers in its turn; the loop does not wait for it.
        tokio::spawn(async move {
            let told = match asked {
                Ok(taken) => taken.await.unwrap_or_else(|_| Err("the run is over".into())),
                Err(reason) => Err(reason),
            };
            let message = told.as_ref().err().unwrap_or(&status.message).clone();
            let reply = Reply { accepted: told.is_ok(), message, status };
            if let Some(answer) = answer {
                let _ = answer.send(reply);
            }
        });
    }

    /// Converts the confirmation of a person (started, done, or at rest) into a confirmation for the driver of a
    /// machine. Returns the confirmation for the record, and the confirmation for the driver.
    ///
    /// # Errors
    /// Returns a message for the person:
    ///
    /// - For "started" and "done": no job is in progress, or the person gave digits that are not the first digits of
    ///   the SHA-256 of the correction map.
    /// - For "at rest": the person names no machine, and no job is in progress.
    /// - For every other request: it is not a confirmation.
    fn operator_confirmation(&self, request: &Request) -> Result<(Confirmation, OperatorConfirmation), String> {
        let at_work = self.cell.state().phase().and_then(Phase::moving_device);
        let job = || at_work.ok_or("no machine has a job in progress, so there is no job to confirm");
        let identity = |map: &Option<String>| map.as_ref().map(|digits| self.map_identity(digits)).transpose();
        Ok(match request {
            Request::Started { map } => (
                Confirmation::Started { device: job()?, map: map.clone() },
                OperatorConfirmation::Started { map_identity: identity(map)? },
            ),
            Request::Done { map, file } => {
                let recorded = file.as_ref().map(|file| file.to_string_lossy().into_owned());
                (
                    Confirmation::Done { device: job()?, map: map.clone(), file: recorded },
                    OperatorConfirmation::Done { map_identity: identity(map)?, file: file.clone() },
                )
            }
            Request::Still { device } => {
                let device =
                    device.or(at_work).ok_or("name the machine that is at rest: --machine cmm or --machine grinder")?;
                (Confirmation::Still { device }, OperatorConfirmation::Still)
            }
            _ => return Err("this order is not a confirmation for a machine".into()),
        })
    }

    /// Returns the SHA-256 of the correction map of the pass in progress. `digits` are at least the first 8 hexadecimal
    /// digits of this hash, as a person reads them at the grinder. Returns an error if `digits` are fewer than 8 or
    /// differ from the hash, or if no pass is in progress.
    fn map_identity(&self, digits: &str) -> Result<[u8; 32], String> {
        let digits = digits.trim().to_lowercase();
        let grinds = self.cell.state().phase().and_then(Phase::moving_device) == Some(Device::Grinder);
        let cycle = self.cycles.get(self.cell.cycle()).filter(|_| grinds);
        let Some(cycle) = cycle else { return Err("no pass is in progress".into()) };
        let identity = self.task.payloads(&cycle.correction).0.identity();
        let whole = hex(&identity);
        if digits.len() < 8 {
            return Err(
                "give at least the first 8 digits of the map identity; the file correction.json has this identity"
                    .into(),
            );
        }
        if !whole.starts_with(&digits) {
            let (given, handed) = (digits.get(..8).unwrap_or(&digits), &whole[..8]);
            return Err(format!(
                "map {handed} was sent, but the confirmation names map {given}; check which map is set up at the grinder"
            ));
        }
        Ok(identity)
    }

    async fn handle_report(&mut self, report: StationReport) {
        let StationReport { event, detail, fetched, preliminary, notes, files } = report;
        self.record_files(self.cell.cycle(), recorder::sync_and_hash(&self.folder, &files)).await;
        if let Some(MachineNotes { device, all, new: messages }) = notes {
            self.notes[device as usize] = all;
            self.status.send_replace(self.snapshot());
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
                self.armed[*device as usize] = match detail {
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
    fn update_preview(&mut self, preliminary: &PreliminaryPoints) {
        let number = self.cell.cycle();
        let asked = BatchId { cycle: number, batch: self.cycles.batch(number) };
        let plan = self.cycles.get(number).and_then(|cycle| cycle.plan.clone());
        match plan.filter(|_| preliminary.job.job == self.job && preliminary.job.batch_id() == asked) {
            Some(plan) => self.preview_statistics.add_points(&plan, preliminary),
            None => self.preview_statistics.reset(),
        }
        self.status.send_replace(self.snapshot());
    }

    /// Compares a pass record with the pass that was commanded in the current cycle. Returns a text about the first
    /// implausible value or the first difference. Returns `None` if there is none. If the current cycle has no pass,
    /// returns a text that states this.
    fn pass_record_flaw(&self, record: &PassRecord) -> Option<String> {
        let number = self.cell.cycle();
        let Some(cycle) = self.cycles.get(number) else { return Some(format!("cycle {number} has no pass")) };
        let (map, pass) = self.task.payloads(&cycle.correction);
        let job = Job { job: self.job, cycle: number as u16, digest: 0 };
        let max_depth_mm = self.task.correction_limits.max_depth_mm;
        let outline = self.task.nominal.outline();
        let told = pass_record::CommandedPass { job, pass: &pass, map_identity: map.identity(), max_depth_mm, outline };
        pass_record::implausible_figure(&told, record)
    }

    /// Records how long the transfer of the points of a measurement took (`taken`), and notifies people of the number
    /// of points, the time in s, and the time per point in ms.
    async fn record_transfer(&mut self, measurement: &Measurement, taken: Duration) {
        let cycle = BatchId::decode(measurement.cycle).cycle;
        let (points, seconds) = (measurement.points.len(), taken.as_secs_f64());
        let ms_per_point = 1e3 * seconds / points.max(1) as f64;
        let coordinates = Some(measurement.coordinates);
        let transfer = Transfer { points, seconds, ms_per_point: Some(ms_per_point), coordinates };
        self.record_note("cmm", &Content::Transfer(TransferNote { transfer }));
        self.notify(Notice::Transferred { cycle, points, seconds, ms_per_point });
    }

    async fn handle_computed(&mut self, computed: ComputationResult) {
        let ComputationResult { cycle: number, event, product, files } = computed;
        if matches!(&event, Some(Event::Registered { figures, .. }) if figures.further_touches.is_none()) {
            *self.attempts.entry((number, Computation::FinalRegistration)).or_insert(0) += 1;
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

    /// Adds files of a cycle to the record. If `files` is an error, reports that they could not be written.
    async fn record_files(&mut self, cycle: u32, files: Result<Vec<Artefact>, RecordFailure>) {
        match files {
            Ok(files) if files.is_empty() => {}
            Ok(files) => {
                let bytes = self.cycle_bytes.entry(cycle).or_insert(0);
                *bytes += files.iter().map(|file| file.bytes).sum::<u64>();
                self.max_cycle_bytes = self.max_cycle_bytes.max(*bytes);
                let ticket = self.recorder.append_artefacts(files, self.now(), cycle);
                self.backlog.push_back(PendingRecord { receipt: ticket, action: RecordAction::Nothing });
            }
            // A failure to write the loop's own final files is only shown, because the run is over.
            Err(reason) if self.ending.is_some() => {
                self.notify(Notice::RecordFailed { message: failure_message(&reason) })
            }
            Err(reason) => Box::pin(self.report_record_failure(reason)).await,
        }
    }

    /// Records `event`, lets the cell handle it, and starts the execution of the resulting commands. `detail` is stored
    /// in the record of the event. Returns the reason if the cell refuses the event, otherwise `None`. Also returns a
    /// receipt that completes when the event is recorded or cannot be recorded.
    async fn handle_event(&mut self, event: Event, detail: Option<EventDetail>) -> (Option<String>, RecordReceipt) {
        let now = self.now();
        let ticket = self.record_event(now, &event, detail);
        let before = self.cell.state();
        let commands = self.cell.handle(now, event.clone());
        self.state_changes += u64::from(self.cell.state() != before);
        for command in commands.iter().filter(|command| is_immediate(command)) {
            self.execute(command.clone()).await;
        }
        let refusal = commands.iter().find_map(|command| match command {
            Command::Refuse { reason, .. } => Some(reason.clone()),
            _ => None,
        });
        // A refused order changed nothing: only the refusal is shown.
        if refusal.is_none() || !event.is_order() {
            self.show_event(now, &event);
        }
        for command in commands {
            self.queue_command(command);
        }
        self.status.send_replace(self.snapshot());
        (refusal, ticket)
    }

    fn record_event(&mut self, now: Duration, event: &Event, detail: Option<EventDetail>) -> RecordReceipt {
        let content = EventRecord { event: event.clone(), detail };
        let ticket = self.append(now, event.origin(), &Content::Event(Box::new(content)));
        // Record the outcome of each command that the event answers.
        let (answered, open): (Vec<_>, Vec<_>) =
            std::mem::take(&mut self.open_commands).into_iter().partition(|(_, c)| outcome::answers(event, c));
        self.open_commands = open;
        for (intent, _) in answered {
            let answer = Content::Answer(record::Answer::Event { event: event.name().to_owned() });
            let entry = answer.entry(nanoseconds(now), self.cell.cycle(), event.origin());
            let ticket = self.recorder.append_outcome(intent, entry);
            self.backlog.push_back(PendingRecord { receipt: ticket, action: RecordAction::Nothing });
        }
        ticket
    }

    /// Queues a record of what the machine `actor` reported besides events.
    fn record_note(&mut self, actor: &str, content: &Content) {
        let ticket = self.append(self.now(), (actor.to_owned(), "wire".to_owned()), content);
        self.backlog.push_back(PendingRecord { receipt: ticket, action: RecordAction::Nothing });
    }

    /// Queues a record with `content`. `now` is the time since the run began. `origin` is the person or machine that
    /// caused the content, and its place.
    fn append(&self, now: Duration, origin: (String, String), content: &Content) -> RecordReceipt {
        self.recorder.append(content.entry(nanoseconds(now), self.cell.cycle(), origin))
    }

    /// Writes `document` as JSON to the file `name`, relative to the run folder, and records the file. If it cannot be
    /// written, only notifies people.
    async fn write_document(&mut self, name: String, cycle: u32, document: &impl Serialize) {
        let path = self.folder.join(&name);
        let made = create_folder(path.parent().unwrap_or(&self.folder));
        match made.and_then(|()| write_json_atomic(path, document)) {
            Ok(()) => self.record_files(cycle, recorder::sync_and_hash(&self.folder, &[name])).await,
            Err(error) => self.notify(Notice::RecordFailed { message: error.to_string() }),
        }
    }

    /// Queues a command to be recorded, and executed after that. An immediate command ([`is_immediate`]) is only
    /// recorded here, because [`Self::handle_event`] has already executed it.
    fn queue_command(&mut self, command: Command) {
        let content = Content::Command(Box::new(CommandRecord::new(command.clone(), self.armed)));
        let origin = ("cell".to_owned(), "regrind".to_owned());
        let ticket = if command.expects_answer() {
            let entry = content.entry(nanoseconds(self.now()), self.cell.cycle(), origin);
            let (intent, ticket) = self.recorder.append_intent(entry);
            self.open_commands.push((intent, command.clone()));
            ticket
        } else {
            self.append(self.now(), origin, &content)
        };
        let then =
            if is_immediate(&command) { RecordAction::Nothing } else { RecordAction::Execute(Box::new(command)) };
        self.backlog.push_back(PendingRecord { receipt: ticket, action: then });
    }

    /// Waits after the end of the run until all queued entries are recorded. In this time, still writes judgements and
    /// answers orders, but executes no other command. Gives up after [`recorder::CLOSE_TIMEOUT`], and then answers the
    /// remaining orders with the reason.
    async fn finish_backlog(&mut self) {
        let by = Instant::now() + recorder::CLOSE_TIMEOUT;
        while !self.backlog.is_empty() {
            let recorded = tokio::select! {
                biased;
                recorded = wait_for_first_record(&mut self.backlog) => recorded,
                reason = self.recorder.next_failure() => {
                    self.record_failure_reason = Some(failure_message(&reason));
                    self.answer_unrecorded_orders();
                    continue;
                }
                () = tokio::time::sleep_until(by) => {
                    self.record_failure_reason.get_or_insert_with(|| "the disk does not answer".to_owned());
                    return self.answer_unrecorded_orders();
                }
            };
            match self.backlog.front().map(|next| &next.action) {
                Some(RecordAction::Execute(command)) if matches!(**command, Command::Announce(_)) => {
                    self.handle_recorded(recorded).await
                }
                Some(RecordAction::Answer { .. }) => self.handle_recorded(recorded).await,
                _ => drop(self.backlog.pop_front()),
            }
        }
    }

    async fn execute(&mut self, command: Command) {
        match command {
            Command::Connect { device } => self.send_request(device, StationRequest::Connect).await,
            Command::AskToLoad => self.ask_to_load().await,
            Command::LoadPass { cycle } => self.load_pass(cycle).await,
            Command::LoadPlan { cycle } => self.load_plan(cycle).await,
            Command::VerifyClear { device } => self.send_request(device, StationRequest::VerifyClear).await,
            Command::AskWhetherClear { device } => self.notify(Notice::AskWhetherClear { device }),
            Command::Prepare { device, cycle } => {
                let batch = if device == Device::Cmm { self.cycles.batch(cycle) } else { 0 };
                self.send_request(device, StationRequest::Prepare { number: BatchId { cycle, batch } }).await;
            }
            Command::StartMachine { device, cycle } => self.send_request(device, StationRequest::Start { cycle }).await,
            Command::HoldMachine { device } => self.send_urgent_request(device, StationRequest::Hold).await,
            Command::ResumeMachine { device } => self.send_request(device, StationRequest::Resume).await,
            Command::StopMachine { device } => self.send_urgent_request(device, StationRequest::Stop).await,
            Command::AbortMachine { device } => {
                self.abort_counts[device as usize].send_modify(|ordered| *ordered += 1);
                self.send_urgent_request(device, StationRequest::Abort).await;
            }
            Command::ClearMachine { device } => self.send_request(device, StationRequest::Clear).await,
            Command::Reconcile { device, cycle } => {
                self.send_request(device, StationRequest::Reconcile { cycle }).await
            }
            Command::Collect { cycle } => self.send_request(Device::Cmm, StationRequest::Collect { cycle }).await,
            Command::Qualify { cycle } => self.qualify(cycle),
            Command::Acknowledge { device } => self.send_request(device, StationRequest::Acknowledge).await,
            Command::Register { cycle } => self.register(cycle),
            Command::Compensate { cycle } => self.compensate(cycle),
            Command::Announce(judgement) => self.announce(judgement).await,
            Command::Raise(alarm) => self.notify(Notice::Alarm(alarm)),
            Command::Withdraw { alarm } => self.notify(Notice::AlarmGone { alarm }),
            Command::Refuse { event, reason, .. } if event.is_order() => self.notify(Notice::Refused { reason }),
            // A late fact from a machine is recorded, but a person has nothing to do.
            Command::Refuse { .. } => {}
            Command::Finish(ending) => self.ending = Some(ending),
        }
    }

    /// Writes the judgement of a cycle to the file `result.json` in the folder of this cycle, and notifies people. A
    /// second judgement of the same cycle goes to a subfolder of its own.
    async fn announce(&mut self, judgement: Judgement) {
        let which = self.cycles.count_judgement(judgement.cycle);
        self.write_judgement(which, &judgement).await;
        self.notify(Notice::Judged(judgement));
    }

    async fn write_judgement(&mut self, which: u32, judgement: &Judgement) {
        let number = judgement.cycle;
        let cycle = self.cycles.get(number);
        let judged = cycle.and_then(|c| c.figures.as_ref()).map(|figures| self.cell.plan().tolerance.compare(figures));
        let mut result = json!({
            "simulation": self.task.simulation,
            "cycle": number,
            "verdict": judgement.verdict,
            "reason": judgement.reason,
            "figures": cycle.and_then(|c| c.figures.as_ref()),
            "judged": judged.map(|judged| judged.map(|of| judged_figure(&of))),
            "level_mm": cycle.map(|c| c.correction.level_mm),
        });
        if self.task.parameter_compensation.is_some() {
            result["parameters"] = json!(cycle.map(|cycle| pipeline::recorded_parameters(&self.task, cycle)));
        }
        self.write_document(format!("{}/result.json", cycle_folder(number, which)), number, &result).await;
    }

    /// Writes the learned state of this run to the file [`LEARNED`]. The next part of this kind can begin with this
    /// state. Does nothing if the run was stopped or aborted, or if no cycle gives a usable state.
    async fn save_learned(&mut self, ending: &Ending) {
        if !matches!(ending, Ending::Accepted { .. } | Ending::NotAccepted { .. }) {
            return;
        }
        let run = self.folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let last = self.cycles.last_with_learning().cloned();
        let fields = self.cycles.part_priors(&self.task);
        let Some(learned) = last.and_then(|cycle| pipeline::learned_state(&self.task, run, (&cycle, fields))) else {
            return;
        };
        self.write_document(LEARNED.into(), self.cell.cycle(), &learned).await;
    }

    async fn send_request(&mut self, device: Device, request: StationRequest) {
        // A station lives as long as the drive; its channel is large enough for the work of one cell.
        let _ = self.requests[device as usize].send(request).await;
    }

    async fn send_urgent_request(&mut self, device: Device, request: StationRequest) {
        self.interrupts[device as usize].raise();
        self.send_request(device, request).await;
    }

    async fn ask_to_load(&mut self) {
        if self.load_confirmed {
            let simulation = || Actor { name: "simulation".into(), station: "regrind".into() };
            let actor = if self.task.simulation { simulation() } else { self.actor.clone() };
            self.queue_event(0, Event::LoadConfirmed { actor });
        } else {
            self.notify(Notice::LoadPart);
        }
    }

    /// Starts a check whether the disk has enough free space for the files of `cycle`. If it has not, reports this to
    /// the cell, which then holds before a machine moves. Data may still be sent to the machine before the result of
    /// the check arrives.
    fn check_disk_space(&mut self, cycle: u32) {
        let (folder, needed) = (self.folder.clone(), self.task.cycle_bytes().max(2 * self.max_cycle_bytes));
        self.executor.spawn_computation(&mut self.computations, move || {
            let short = require_free_space(&folder, needed).err();
            let event = short.map(|reason| Event::RecordFailed { reason });
            ComputationResult { cycle, event, product: ComputationProduct::Nothing, files: Ok(Vec::new()) }
        });
    }

    async fn load_pass(&mut self, number: u32) {
        self.check_disk_space(number);
        let (map, pass) = self.cycles.pass_payloads(&self.task, number);
        let load = MachinePayload::Pass(Arc::new(map), Box::new(pass));
        self.send_request(Device::Grinder, StationRequest::Load { cycle: number, payload: load }).await;
    }

    async fn load_plan(&mut self, number: u32) {
        self.check_disk_space(number);
        let load = MachinePayload::Plan(self.cycles.create_plan(&self.task, number));
        self.send_request(Device::Cmm, StationRequest::Load { cycle: number, payload: load }).await;
    }

    /// Starts the gate of a measurement: the check whether its points can be used. Also writes the points to files.
    fn gate(&mut self, measurement: Box<Measurement>) {
        let number = BatchId::decode(measurement.cycle).cycle;
        let cycle = self.cycles.get(number).cloned();
        let earlier = self.cycles.previous_points(number);
        self.start_computation(Computation::Gate, number, move |task, files| {
            pipeline::gate_cycle(task, files, number, cycle.as_ref(), (earlier.as_ref(), &measurement))
        });
    }

    fn qualify(&mut self, number: u32) {
        let stated = self.task.probing.probe_radius_mm;
        let found = self.cycles.get(number).and_then(|c| c.points.as_ref()?.probe_radius_mm);
        let radius_error_mm = found.map_or(0.0, |radius| radius - stated);
        self.queue_event(number, Event::Qualified { cycle: number, radius_error_mm });
    }

    fn register(&mut self, number: u32) {
        let Some(cycle) = self.cycles.get(number).cloned() else { return };
        let before = self.cycles.previous_judged(number).cloned();
        self.start_computation(Computation::Registration, number, move |task, files| {
            pipeline::register_cycle(task, files, number, &cycle, before.as_ref())
        });
    }

    fn compensate(&mut self, number: u32) {
        let Some(cycle) = self.cycles.get(number).cloned() else { return };
        self.start_computation(Computation::Compensation, number, move |task, files| {
            pipeline::compensate_cycle(task, files, number, &cycle)
        });
    }

    /// Starts the computation `work` of the kind `kind` for a cycle, on a thread for blocking work. `work` returns the
    /// event for the cell and the result to store. The same thread writes the created files to the disk and hashes
    /// them. These files can be large, and neither the loop nor the journal should wait for them.
    fn start_computation(
        &mut self,
        kind: Computation,
        cycle: u32,
        work: impl FnOnce(&Task, &mut OutputFiles) -> (Event, ComputationProduct) + Send + 'static,
    ) {
        let (task, folder) = (Arc::clone(&self.task), self.folder.clone());
        let attempt = self.attempts.entry((cycle, kind)).or_insert(0);
        *attempt += 1;
        let which = *attempt;
        let mut files = OutputFiles::new(folder.clone(), cycle_folder(cycle, which));
        if task.adaptive.is_some() && kind != Computation::Compensation {
            let settled = self.attempts.get(&(cycle, Computation::FinalRegistration)).map_or(1, |before| before + 1);
            files = OutputFiles::new(folder.clone(), batch_folder(cycle, which))
                .with_final_subfolder(cycle_folder(cycle, settled));
        }
        let computing = self.executor.spawn_computation(&mut self.computations, move || {
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
        self.running_computations.insert(computing.id(), (cycle, kind));
    }

    /// Queues an event for the cell, as if it were the result of a computation of this cycle.
    fn queue_event(&mut self, cycle: u32, event: Event) {
        let computed = ComputationResult {
            cycle,
            event: Some(event),
            product: ComputationProduct::Nothing,
            files: Ok(Vec::new()),
        };
        self.computations.spawn(std::future::ready(computed));
    }

    fn notify(&self, notice: Notice) {
        // The receiver may be gone; the run continues.
        let _ = self.notices.send(notice);
    }

    fn state_notice(&self, event: &Event) -> Notice {
        let (state, cycle, at_job) =
            (self.cell.in_words(), self.cell.cycle(), self.progress_estimator.progress().is_some());
        Notice::State { state, cycle, event: event.name().to_owned(), has_progress: at_job }
    }

    /// Notifies people of `event`, and updates the progress of the job and the preview of the points. Must be called
    /// after the cell has handled the event. `now` is the time since the run began.
    fn show_event(&mut self, now: Duration, event: &Event) {
        self.progress_estimator.update_state(self.cell.state());
        if self.progress_estimator.progress().is_none_or(|progress| progress.device != Device::Cmm) {
            self.preview_statistics.reset();
        }
        let notice = match event {
            Event::Progressed { device, done, total } => {
                let cycle = self.cell.cycle();
                self.progress_estimator.record_progress(now, (*device, cycle), *done, *total);
                self.progress_estimator.update_state(self.cell.state());
                let remaining_s = self.progress_estimator.progress().and_then(|progress| progress.remaining_s);
                Notice::Progress { device: *device, cycle, done: *done, total: *total, remaining_s }
            }
            Event::Registered { cycle, figures } => {
                self.notify(Notice::Figures { cycle: *cycle, figures: figures.clone() });
                // No other notice of the state may follow: the result of a computation may hold the cell.
                self.state_notice(event)
            }
            Event::Compensated { cycle, summary } => {
                self.notify(Notice::Compensated { cycle: *cycle, summary: summary.clone() });
                self.state_notice(event)
            }
            event => self.state_notice(event),
        };
        self.notify(notice);
    }
}

fn spawn_station<D: StationDriver>(
    driver: D,
    job: u32,
    (interrupt, aborts, pulse): (&Interrupt, &watch::Sender<u64>, &LoopWatchdog),
    reports: &mpsc::Sender<StationReport>,
    (armed, may_be_at_work): (Option<(u32, Armed)>, bool),
    poll: Duration,
) -> (mpsc::Sender<StationRequest>, tokio::task::JoinHandle<()>) {
    let (asks, asked) = mpsc::channel(16);
    let station = MachineTask::new(driver, job, interrupt.clone(), reports.clone(), armed);
    let station = if may_be_at_work { station.restore_preparation() } else { station };
    (asks, tokio::spawn(station.serve(asked, poll, AbortCounter::new(aborts.subscribe()), pulse.clone())))
}

/// Returns the name of a person and the place of the person, as a record has them.
fn origin(actor: &Actor) -> (String, String) {
    (actor.name.clone(), actor.station.clone())
}

/// Returns true for a command that is executed at once, before it is recorded: it brings machines to rest, only reads a
/// status, informs people, or ends the run.
fn is_immediate(command: &Command) -> bool {
    matches!(
        command,
        Command::HoldMachine { .. }
            | Command::StopMachine { .. }
            | Command::AbortMachine { .. }
            | Command::VerifyClear { .. }
            | Command::Raise(_)
            | Command::Withdraw { .. }
            | Command::Refuse { .. }
            | Command::Finish(_)
    )
}

/// Returns an error if the disk of `folder` has less free space than `needed` bytes.
fn require_free_space(folder: &Path, needed: u64) -> Result<(), RecordFailure> {
    // If the free space is unknown, try to write.
    let free = journal::free_bytes(folder).unwrap_or(u64::MAX);
    if free >= needed {
        return Ok(());
    }
    let [free, needed] = [free, needed].map(|bytes| bytes.div_ceil(1 << 20));
    let disk = folder.display();
    Err(RecordFailure::DiskFull(format!("the disk of {disk} has {free} MB free, but a cycle needs up to {needed} MB")))
}

/// Waits until the first entry of the queue is recorded, and returns the result. Returns an error if the entry cannot
/// be recorded, or if the journal writer has ended. Never returns if the queue is empty.
async fn wait_for_first_record(backlog: &mut VecDeque<PendingRecord>) -> Result<(), RecordFailure> {
    match backlog.front_mut() {
        Some(next) => (&mut next.receipt).await.unwrap_or_else(|_| {
            Err(RecordFailure::Unwritable(
                "the journal writer of Regrind has stopped, so nothing can be recorded; report this fault".into(),
            ))
        }),
        None => std::future::pending().await,
    }
}

/// Converts a form figure that was compared with its limit (such as the PV) into JSON for the result file of a cycle.
/// The JSON contains the name, the value, the expanded uncertainty and the limit in mm, and the probability (0 to 1)
/// that the figure is within the limit. The limit is null if it is not finite.
fn judged_figure(of: &ComparedFigure) -> Value {
    json!({
        "name": of.name,
        "found_mm": of.median_mm,
        "expanded_mm": of.expanded_mm,
        "limit_mm": Some(of.limit_mm).filter(|limit| limit.is_finite()),
        "probability_within": of.probability_in_tolerance,
    })
}
