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
mod compute;
mod cycle_output;
mod cycles;
mod display;
mod evaluation;
mod execute;
mod failure;
mod machine_monitor;
mod machine_reports;
mod machines;
mod measurement_forecast;
mod notice;
mod orders;
mod outcome;
mod pass_record;
mod pipeline;
mod preview;
mod program;
mod progress_estimator;
mod record_queue;
mod recorder;
mod recording;
pub mod recovery;
mod replay;
mod running_computations;
mod show;
mod snapshot;
mod station;
mod task;

use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use regrind_control::{Control, EndpointChange, ReceivedOrder};
pub use regrind_control::{CycleRow, JobProgress, PreviewStatistics, Reply, Request, Snapshot, is_live, send_request};
use serde_json::Value;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::Instant;

use crate::cell::{Actor, Cell, CellPlan, Command, Device, Ending, Event, Judgement, State, StateName};
use crate::device::{AnyCmm, AnyGrinder, Cmm, Grinder};
use crate::formats::run_files::RunFile;
use crate::record::{EventDetail, PartEnd, RunEnd, TouchCounts};
pub use blocking_executor::{BlockingExecutor, BlockingWork};
use cycles::Cycles;
use display::Display;
use failure::failure_message;
use machines::Machines;
pub use measurement_forecast::{MeasurementForecast, forecast_measurement};
pub use notice::Notice;
pub use program::{ProgramError, Programs};
use record_queue::{RunRecord, is_immediate, wait_for_first_record};
pub use recorder::JournalSink;
use recorder::{RecordReceipt, Recorder};
pub use replay::{InterruptedRun, ReplayError};
use running_computations::{ComputationResult, Computations};
use station::WATCHDOG_INTERVAL;
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
    cycles: Cycles,
    context: RunContext,
    machines: Machines,
    record: RunRecord,
    computations: Computations,
    display: Display,
    orders: mpsc::Receiver<ReceivedOrder>,
    control: Control,
    /// Judgement that the interrupted program did not write to a file, and its number within its cycle.
    unannounced_judgement: Option<(u32, Judgement)>,
    /// Files that the interrupted program did not record.
    unrecorded_files: Vec<String>,
    ending: Option<Ending>,
}

/// Data of a run that do not change.
struct RunContext {
    folder: PathBuf,
    /// The serial number of the part.
    serial: String,
    job: u32,
    actor: Actor,
    load_confirmed: bool,
    started_at: Instant,
    /// Duration of the run before it was interrupted.
    elapsed_before: Duration,
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
        let (orders, ordered) = mpsc::channel(16);
        let (status, seen) = watch::channel(Snapshot::default());
        let mut interrupted = run.interrupted.unwrap_or_else(|| InterruptedRun::new(run.plan));
        let (ids, open): (Vec<u32>, Vec<Command>) = std::mem::take(&mut interrupted.open_commands).into_iter().unzip();
        let serial = run.journal.serial().to_owned();
        let recorder = Recorder::new(run.journal, &ids, &run.executor);
        let folder = recorder.folder().to_owned();
        let control =
            Control::listen(&folder, orders.clone(), seen.clone(), matches!(run.executor, BlockingExecutor::Threads))?;
        let earlier = (Device::BOTH.map(|device| interrupted.last_preparation(device)), interrupted.armed);
        let drive = Self {
            cell: interrupted.cell,
            task: Arc::new(run.task),
            cycles: interrupted.cycles,
            context: RunContext {
                folder,
                serial,
                job: run.job,
                actor: run.actor,
                load_confirmed: run.load_confirmed,
                started_at: Instant::now(),
                elapsed_before: interrupted.elapsed,
            },
            machines: Machines::new((cmm, grinder), run.job, earlier, run.poll_intervals),
            record: RunRecord::new(recorder, open),
            computations: Computations::new(run.executor, interrupted.attempts),
            display: Display::new(status, run.notices, interrupted.state_changes),
            orders: ordered,
            control,
            unannounced_judgement: interrupted.unannounced_judgement,
            unrecorded_files: interrupted.unrecorded_files,
            ending: interrupted.ending,
        };
        drive.display.status.send_replace(drive.snapshot());
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
        self.context.elapsed_before + self.context.started_at.elapsed()
    }

    /// Executes the run until the cell reaches an end state, and returns the ending. The future is boxed (its type is
    /// erased), so that its code is compiled in this crate and not again in each calling crate.
    pub fn run(self) -> Pin<Box<dyn Future<Output = Ending> + Send>> {
        Box::pin(self.run_to_end())
    }

    async fn run_to_end(mut self) -> Ending {
        let first = match self.cell.state() {
            State::Idle => Event::Start { actor: self.context.actor.clone() },
            _ => Event::Restarted { actor: self.context.actor.clone() },
        };
        self.handle_event(first, None).await;
        let left = std::mem::take(&mut self.unrecorded_files);
        self.record_files(self.cell.cycle(), recorder::sync_and_hash(&self.context.folder, &left)).await;
        if let Some((which, judgement)) = self.unannounced_judgement.take() {
            self.write_judgement(which, &judgement).await;
        }
        let mut beats = tokio::time::interval(WATCHDOG_INTERVAL);
        while self.ending.is_none() {
            self.machines.watchdog.beat();
            let due = self
                .cell
                .next_deadline()
                .map(|at| self.context.started_at + at.saturating_sub(self.context.elapsed_before));
            let deadline = async {
                match due {
                    Some(at) => tokio::time::sleep_until(at).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                biased;
                Some(ordered) = self.orders.recv() => self.handle_order(ordered).await,
                reason = self.record.recorder.next_failure() => self.report_record_failure(reason).await,
                recorded = wait_for_first_record(&mut self.record.backlog) => self.handle_recorded(recorded).await,
                Some(computed) = self.computations.running.join_next_with_id() => match computed {
                    Ok((id, computed)) => {
                        self.computations.kinds.remove(&id);
                        self.handle_computed(computed).await;
                    }
                    Err(error) => self.handle_panic(error).await,
                },
                Some(report) = self.machines.reports.recv() => self.handle_report(report).await,
                change = self.control.changed() => drop(self.handle_event(control_event(change), None).await),
                () = deadline => drop(self.handle_event(Event::Deadline, None).await),
                _ = beats.tick() => {}
            }
            self.withdraw_pending_commands().await;
        }
        self.end_run().await
    }

    /// Writes the end of the record and the results of the run, and releases the machines. Returns the ending.
    async fn end_run(mut self) -> Ending {
        let ending = self.ending.take().expect("the loop ended with one");
        self.orders.close();
        self.finish_backlog().await;
        // Running computations still write files into the run folder, so wait for them.
        while let Some(computed) = self.computations.running.join_next().await {
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
        self.write_document(RunFile::Result.name().into(), self.cell.cycle(), &result).await;
        self.save_learned(&ending).await;
        if let Err(failure) = self.record.recorder.close(now, self.cell.cycle(), result).await {
            self.notify(Notice::RecordFailed { message: failure_message(&failure) });
        }
        self.notify(Notice::Finished { ending: ending.clone(), cycles: rows, touches });
        self.machines.release().await;
        ending
    }

    /// Records `event`, lets the cell handle it, and starts the execution of the resulting commands. `detail` is stored
    /// in the record of the event. Returns the reason if the cell refuses the event, otherwise `None`. Also returns a
    /// receipt that completes when the event is recorded or cannot be recorded.
    async fn handle_event(&mut self, event: Event, detail: Option<EventDetail>) -> (Option<String>, RecordReceipt) {
        let now = self.now();
        let ticket = self.record_event(now, &event, detail);
        let before = self.cell.state();
        let commands = self.cell.handle(now, event.clone());
        self.display.state_changes += u64::from(self.cell.state() != before);
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
        self.display.status.send_replace(self.snapshot());
        (refusal, ticket)
    }
}

/// Converts a change of the control endpoint (lost or created again) into an event.
fn control_event(change: EndpointChange) -> Event {
    match change {
        EndpointChange::Lost(reason) => Event::ControlLost { reason },
        EndpointChange::Restored => Event::ControlBack,
    }
}
