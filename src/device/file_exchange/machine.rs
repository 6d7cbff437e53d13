//! State machine of a machine that consists of two folders and a person.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError, TryLockError};
use std::time::Duration;

use tokio::time::{Instant, timeout};

use super::{ConfirmedStep, Exchange, ExchangeError, GrindOrder, HandOver, HandOverStatus, MeasureOrder, Permit};
use crate::{
    Answer, Armed, Cmm, CorrectionMap, DeviceError, DeviceResult, Grinder, Identified, Identity, Interrupt, Job,
    Machine, MachineCommand, MachineKind, MachineState, Measurement, OperatorConfirmation, Outcome, Pass, PassRecord,
    Plan, Reconciled, Started, Status, digest,
};
use regrind_formats::operator_step::OperatorStep;

/// Machine that is reached through two folders.
///
/// Every method does its work on a thread for blocking work and completes it, even if its future is dropped.
#[derive(Debug)]
pub struct ExchangeMachine<M: Exchange> {
    name: Arc<str>,
    timeout: Duration,
    made: Instant,
    machine: Arc<Mutex<FolderMachine<M>>>,
}

/// State of the machine, according to the content of the folders.
#[derive(Debug)]
struct FolderMachine<M: Exchange> {
    name: Arc<str>,
    kind: MachineKind,
    exchange: M,
    connected: bool,
    state: MachineState,
    /// Request that START will hand over, and its digest.
    loaded: Option<(M::Request, u32)>,
    /// Job that is prepared, running or finished, and its start number.
    job: Option<(Job, u32)>,
    /// All hand-overs in the folder, earlier ones included, the oldest first.
    hand_overs: Vec<HandOver>,
    outcome: Outcome,
    done: u32,
    answer: Option<M::Answer>,
    start_confirmed: bool,
    notes: Vec<String>,
    /// Step that the open hand-over asks of a person.
    step: Option<OperatorStep>,
    owned: bool,
    /// True if this machine cannot reach the part while the part is at the other machine.
    cannot_reach_part: bool,
    /// True if this machine is clear of the part; `None` if that is unknown. It becomes true when a person confirms the
    /// end of a pass. The arrival of a file does not make it true.
    clear_of_part: Option<bool>,
}

impl<M: Exchange> ExchangeMachine<M> {
    /// Creates a machine of the kind `kind` that is reached through two folders. `exchange` is the driver of these
    /// folders. `name` is the name of the machine in messages. If an access to the folders takes longer than
    /// `answers_within`, for example because of a lost network drive, the operation ends with a timeout error, and the
    /// machine counts as lost.
    pub fn new(name: impl Into<Arc<str>>, kind: MachineKind, exchange: M, answers_within: Duration) -> Self {
        let name = name.into();
        let machine = FolderMachine {
            name: Arc::clone(&name),
            kind,
            exchange,
            connected: false,
            state: MachineState::Idle,
            loaded: None,
            job: None,
            hand_overs: Vec::new(),
            outcome: Outcome::None,
            done: 0,
            answer: None,
            start_confirmed: false,
            notes: Vec::new(),
            step: None,
            owned: false,
            cannot_reach_part: false,
            clear_of_part: None,
        };
        Self { name, timeout: answers_within, made: Instant::now(), machine: Arc::new(Mutex::new(machine)) }
    }

    /// Sets whether this machine cannot reach the part while the part is at the other machine. If `apart` is true, the
    /// status of this machine always says that the machine is clear of the part. Returns the changed machine.
    #[must_use]
    pub fn apart(self, apart: bool) -> Self {
        self.machine.lock().unwrap_or_else(PoisonError::into_inner).cannot_reach_part = apart;
        self
    }

    /// Runs the operation `work` in a thread that may block, and returns its result. `work` receives the state of the
    /// machine and the time since the driver was created. `what` names the operation in errors. Returns a timeout error
    /// if the operation takes longer than the timeout of this machine; the operation itself continues in this case.
    async fn run_blocking<T: Send + 'static>(
        &self,
        what: &'static str,
        work: impl FnOnce(&mut FolderMachine<M>, Duration) -> DeviceResult<T> + Send + 'static,
    ) -> DeviceResult<T> {
        let (machine, now) = (Arc::clone(&self.machine), self.made.elapsed());
        let job = tokio::task::spawn_blocking(move || {
            let mut machine = machine.lock().unwrap_or_else(PoisonError::into_inner);
            work(&mut machine, now)
        });
        let limit = self.timeout;
        match timeout(limit, job).await {
            Ok(Ok(told)) => told,
            Ok(Err(broken)) if broken.is_panic() => std::panic::resume_unwind(broken.into_panic()),
            Ok(Err(_)) => Err(DeviceError::Disconnected { machine: Arc::clone(&self.name), operation: what }),
            Err(_) => Err(DeviceError::TimedOut { machine: Arc::clone(&self.name), operation: what, limit }),
        }
    }

    async fn command(
        &self,
        command: MachineCommand,
        work: impl FnOnce(&mut FolderMachine<M>) -> DeviceResult<()> + Send + 'static,
    ) -> DeviceResult<Status> {
        self.run_blocking("a command", move |machine, _| {
            machine.check_connected("a command")?;
            if !machine.owned && !matches!(command, MachineCommand::Claim | MachineCommand::Abort) {
                return Err(machine.refused(command, Answer::NotOwner));
            }
            work(machine)?;
            Ok(machine.status())
        })
        .await
    }

    async fn load(&self, request: M::Request, digest: u32) -> DeviceResult<()> {
        self.run_blocking("a payload", move |machine, _| {
            machine.check_connected("a payload")?;
            if matches!(machine.state, MachineState::Execute | MachineState::Holding | MachineState::Held) {
                return Err(machine.refused(MachineCommand::Prepare, Answer::WrongState));
            }
            machine.loaded = Some((request, digest));
            if machine.state == MachineState::Prepared {
                (machine.state, machine.job) = (MachineState::Idle, None);
            }
            Ok(())
        })
        .await
    }

    async fn answer(&self, job: Job) -> DeviceResult<(M::Answer, u32)> {
        self.run_blocking("a result", move |machine, _| {
            let same = machine.job.is_some_and(|(own, _)| own == job);
            match &machine.answer {
                Some(answer) if machine.state == MachineState::Complete && same => Ok((answer.clone(), machine.done)),
                _ => Err(DeviceError::NoResult { machine: Arc::clone(&machine.name), job, state: machine.state }),
            }
        })
        .await
    }
}

impl<M: Exchange> FolderMachine<M> {
    fn check_connected(&self, what: &'static str) -> DeviceResult<()> {
        if self.connected {
            Ok(())
        } else {
            Err(DeviceError::NotConnected { machine: Arc::clone(&self.name), operation: what })
        }
    }

    fn refused(&self, command: MachineCommand, answer: Answer) -> DeviceError {
        DeviceError::Refused { machine: Arc::clone(&self.name), command, answer, state: self.state }
    }

    fn failed(&self, command: MachineCommand, error: ExchangeError) -> DeviceError {
        let machine = Arc::clone(&self.name);
        let short = |identity: &[u8; 32]| identity[..8].iter().fold(0, |sum, &b| sum << 8 | u64::from(b));
        match error {
            ExchangeError::HandedOver { .. } => self.refused(command, Answer::AlreadyBegun),
            ExchangeError::NotOpen { .. } => self.refused(command, Answer::WrongState),
            ExchangeError::OtherMap { expected, found } => DeviceError::Mismatch {
                machine,
                field: "the identity of the map",
                sent: short(&expected),
                found: short(&found),
            },
            error => DeviceError::Folder { machine, reason: error.to_string() },
        }
    }

    fn status(&self) -> Status {
        Status {
            job: self.job.map(|(job, _)| job),
            done: self.done,
            outcome: self.outcome,
            clear_of_part: if self.cannot_reach_part { Some(true) } else { self.clear_of_part },
            ..Status::from_state(self.state)
        }
    }

    /// Reads all hand-overs in the outbox. The first call also restores the state of this machine after a restart. If
    /// the newest hand-over is open, its job becomes the job of this machine with the state EXECUTE. If it is held, the
    /// state becomes HELD. Returns an error if the folders are not accessible.
    fn open(&mut self) -> DeviceResult<()> {
        self.hand_overs = self.exchange.open().map_err(|error| self.failed(MachineCommand::Claim, error))?;
        if !self.connected
            && let Some(last) =
                self.hand_overs.last().filter(|h| matches!(h.status, HandOverStatus::Open | HandOverStatus::Held))
        {
            self.job = Some((last.job, last.sequence));
            self.state = if last.status == HandOverStatus::Open { MachineState::Execute } else { MachineState::Held };
        }
        self.connected = true;
        Ok(())
    }

    /// Looks for the answer in the inbox if the state of this machine is EXECUTE; does nothing in any other state. If
    /// the answer has arrived, stores it and changes the state to COMPLETE. `now` is the time since the driver was
    /// created.
    fn poll_answer(&mut self, now: Duration) -> DeviceResult<()> {
        self.step = None;
        let Some((job, sequence)) = self.job.filter(|_| self.state == MachineState::Execute) else { return Ok(()) };
        let look = self.exchange.poll(now, job).map_err(|error| self.failed(MachineCommand::Start, error))?;
        self.notes = look.notes;
        self.start_confirmed = look.start_confirmed;
        if look.answer.is_some() {
            self.answer = look.answer;
            self.clear_of_part = (self.kind == MachineKind::Grinder).then_some(true);
            self.finish(Outcome::Complete, sequence);
        } else {
            // Without the step, the notes still say what is awaited.
            self.step = self.exchange.step(job, self.start_confirmed).unwrap_or_default();
        }
        Ok(())
    }

    fn finish(&mut self, outcome: Outcome, sequence: u32) {
        (self.state, self.outcome, self.done) = (MachineState::Complete, outcome, sequence);
    }

    fn prepare(&mut self, job: Job) -> DeviceResult<Armed> {
        if self.state != MachineState::Idle {
            return Err(self.refused(MachineCommand::Prepare, Answer::WrongState));
        }
        match &self.loaded {
            None => return Err(self.refused(MachineCommand::Prepare, Answer::PayloadMissing)),
            Some((_, digest)) if *digest != job.digest => {
                return Err(self.refused(MachineCommand::Prepare, Answer::OtherJob));
            }
            Some(_) => {}
        }
        self.open()?;
        if self.hand_overs.iter().any(|h| (h.job.job, h.job.cycle) == (job.job, job.cycle)) {
            return Err(self.refused(MachineCommand::Prepare, Answer::AlreadyBegun));
        }
        let start_sequence = self.hand_overs.last().map_or(0, |h| h.sequence) + 1;
        (self.job, self.state) = (Some((job, start_sequence)), MachineState::Prepared);
        (self.outcome, self.answer, self.start_confirmed) = (Outcome::None, None, false);
        Ok(Armed { job, start_sequence, token: 0, boot_id: 0 })
    }

    fn start(&mut self, armed: &Armed, permit: &Permit) -> DeviceResult<Started> {
        if permit.is_withdrawn() {
            return Err(self.refused(MachineCommand::Start, Answer::DeadToken));
        }
        if self.state != MachineState::Prepared {
            return Err(self.refused(MachineCommand::Start, Answer::WrongState));
        }
        let (job, sequence) = (armed.job, armed.start_sequence);
        let Some((request, _)) = self.loaded.as_ref().filter(|_| self.job == Some((job, sequence))) else {
            return Err(self.refused(MachineCommand::Start, Answer::OtherJob));
        };
        if let Err(error) = self.exchange.publish(job, sequence, request, permit) {
            return self.after_failed_start(armed, error, permit);
        }
        self.hand_overs.push(HandOver { job, sequence, status: HandOverStatus::Open });
        if permit.is_withdrawn() {
            return self.take_back_late(armed);
        }
        self.started(armed)
    }

    /// Stops a hand-over that was published too late: the client had already stopped waiting and withdrawn its permit.
    /// Changes the status of the hand-over to stopped. The client may have continued without this hand-over, so the
    /// hand-over must not stay open. `armed` contains the job and the start number of the hand-over.
    ///
    /// # Errors
    /// Always returns an error: the refusal [`Answer::DeadToken`], or the error that occurred when the status was
    /// changed.
    fn take_back_late(&mut self, armed: &Armed) -> DeviceResult<Started> {
        self.mark(MachineCommand::Start, HandOverStatus::Stopped)?;
        self.notes = self.withdrawal_notes();
        self.finish(Outcome::Stopped, armed.start_sequence);
        Err(self.refused(MachineCommand::Start, Answer::DeadToken))
    }

    fn started(&mut self, armed: &Armed) -> DeviceResult<Started> {
        (self.state, self.clear_of_part) = (MachineState::Execute, None);
        self.notes = vec!["handed over; waiting for the answer".to_owned()];
        Ok(Started { job: armed.job, start_sequence: armed.start_sequence, status: self.status() })
    }

    /// Decides whether a job has been started although the publication of its hand-over returned `error`. `armed`
    /// contains the job and the start number of the hand-over. Reads the outbox again for this decision.
    ///
    /// If the outbox contains the hand-over and `permit` is not withdrawn, the start counts as successful. If the
    /// outbox contains the hand-over and `permit` is withdrawn, stops the hand-over.
    ///
    /// # Errors
    /// Returns the refusal [`Answer::DeadToken`] if the hand-over was stopped. Returns `error`, as the error of this
    /// machine, if the outbox does not contain the hand-over. Returns [`DeviceError::StartUnknown`] if the outbox
    /// cannot be read.
    fn after_failed_start(&mut self, armed: &Armed, error: ExchangeError, permit: &Permit) -> DeviceResult<Started> {
        let reason = self.failed(MachineCommand::Start, error);
        match self.exchange.open() {
            Ok(handed) => {
                self.hand_overs = handed;
                let ours = |h: &HandOver| (h.job, h.sequence) == (armed.job, armed.start_sequence);
                if self.hand_overs.iter().any(ours) {
                    return if permit.is_withdrawn() { self.take_back_late(armed) } else { self.started(armed) };
                }
                (self.state, self.job) = (MachineState::Idle, None);
                Err(reason)
            }
            Err(_) => Err(DeviceError::StartUnknown {
                machine: Arc::clone(&self.name),
                job: armed.job,
                sequence: armed.start_sequence,
                cause: Box::new(reason),
            }),
        }
    }

    fn mark(&mut self, command: MachineCommand, standing: HandOverStatus) -> DeviceResult<()> {
        let Some((job, sequence)) = self.job else { return Err(self.refused(command, Answer::WrongState)) };
        self.exchange.mark(job, standing).map_err(|error| self.failed(command, error))?;
        for handed in self.hand_overs.iter_mut().filter(|h| h.sequence == sequence) {
            handed.status = standing;
        }
        Ok(())
    }

    fn hold(&mut self) -> DeviceResult<()> {
        if self.state != MachineState::Execute {
            return Err(self.refused(MachineCommand::Hold, Answer::WrongState));
        }
        self.mark(MachineCommand::Hold, HandOverStatus::Held)?;
        self.state = MachineState::Held;
        self.notes = self.withdrawal_notes();
        Ok(())
    }

    fn resume(&mut self) -> DeviceResult<()> {
        if self.state != MachineState::Held {
            return Err(self.refused(MachineCommand::Resume, Answer::WrongState));
        }
        self.mark(MachineCommand::Resume, HandOverStatus::Open)?;
        self.state = MachineState::Execute;
        Ok(())
    }

    fn stop(&mut self) -> DeviceResult<()> {
        match (self.state, self.job) {
            (MachineState::Prepared, _) => (self.state, self.job) = (MachineState::Idle, None),
            (MachineState::Execute | MachineState::Held, Some((_, sequence))) => {
                self.mark(MachineCommand::Stop, HandOverStatus::Stopped)?;
                self.notes = self.withdrawal_notes();
                self.finish(Outcome::Stopped, sequence);
            }
            _ => return Err(self.refused(MachineCommand::Stop, Answer::WrongState)),
        }
        Ok(())
    }

    fn abort(&mut self) -> DeviceResult<()> {
        let was = std::mem::replace(&mut self.state, MachineState::Aborted);
        let lies = |h: &&HandOver| matches!(h.status, HandOverStatus::Open | HandOverStatus::Held);
        let ours =
            self.job.filter(|(_, sequence)| self.hand_overs.iter().filter(lies).any(|h| h.sequence == *sequence));
        if was == MachineState::Prepared || ours.is_none() {
            return Ok(());
        }
        self.notes = self.withdrawal_notes();
        (self.outcome, self.answer) = (Outcome::Aborted, None);
        // The state becomes ABORTED even if the folder cannot be reached. The error says that the hand-over may still
        // be there.
        self.mark(MachineCommand::Abort, HandOverStatus::Aborted)
    }

    fn withdrawal_notes(&self) -> Vec<String> {
        let words = match (self.start_confirmed, self.kind) {
            (true, MachineKind::Grinder) => {
                "the hand-over was withdrawn after the start was confirmed: stop the grinder at its own panel"
            }
            (_, MachineKind::Grinder) => {
                "the hand-over was withdrawn; if the grinder already runs, stop the grinder at its own panel"
            }
            (_, MachineKind::Cmm) => {
                "the plan was withdrawn; if the machine already measures, stop the machine at its own panel"
            }
        };
        vec![words.to_owned()]
    }

    fn acknowledge(&mut self, done: u32) -> DeviceResult<()> {
        if self.state != MachineState::Complete {
            return Err(self.refused(MachineCommand::Acknowledge, Answer::WrongState));
        }
        if done != self.done {
            return Err(self.refused(MachineCommand::Acknowledge, Answer::OtherResult));
        }
        if self.outcome == Outcome::Complete {
            self.mark(MachineCommand::Acknowledge, HandOverStatus::Closed)?;
        }
        (self.state, self.job, self.answer) = (MachineState::Idle, None, None);
        (self.outcome, self.done, self.start_confirmed) = (Outcome::None, 0, false);
        self.notes.clear();
        Ok(())
    }

    /// Accepts the confirmation of a step of the running job by a person. `what` states the step: the machine has
    /// begun, or the machine has ended and is clear of the part. `map_identity` is the SHA-256 of the correction map
    /// that the person names. Always returns an empty list of files.
    ///
    /// # Errors
    /// Returns an error if the machine is not connected, if it is a CMM, if no job runs, or if `map_identity` is not
    /// that of the running job.
    fn confirm(&mut self, what: ConfirmedStep, map_identity: [u8; 32]) -> DeviceResult<Vec<String>> {
        self.check_connected("a confirmation")?;
        if self.kind == MachineKind::Cmm {
            return Err(DeviceError::ConfirmationNotNeeded { machine: Arc::clone(&self.name) });
        }
        let Some((job, _)) = self.job.filter(|_| self.state == MachineState::Execute) else {
            return Err(self.refused(MachineCommand::Start, Answer::WrongState));
        };
        self.exchange.confirm(job, what, map_identity).map_err(|error| self.failed(MachineCommand::Start, error))?;
        Ok(Vec::new())
    }

    /// Puts the file `file` of a person into the inbox. Always returns an empty list of files.
    ///
    /// # Errors
    /// Returns an error if the machine is not connected, if it measures nothing, or if the file cannot be put there.
    fn take_file(&mut self, file: &Path) -> DeviceResult<Vec<String>> {
        self.check_connected("a file")?;
        if self.kind == MachineKind::Grinder {
            let reason = "--file is allowed only for a measurement: remove --file".to_owned();
            return Err(DeviceError::NotAccepted { machine: Arc::clone(&self.name), reason });
        }
        let Some((job, _)) = self.job.filter(|_| self.state == MachineState::Execute) else {
            return Err(self.refused(MachineCommand::Start, Answer::WrongState));
        };
        let not_accepted = |error: ExchangeError| DeviceError::NotAccepted {
            machine: Arc::clone(&self.name),
            reason: error.to_string(),
        };
        self.exchange.take_file(job, file).map_err(not_accepted)?;
        Ok(Vec::new())
    }

    fn reconcile(&mut self, intended: &Armed) -> DeviceResult<Reconciled> {
        self.open()?;
        let Job { job, cycle, .. } = intended.job;
        let Some(handed) = self.hand_overs.iter().find(|h| (h.job.job, h.job.cycle) == (job, cycle)).copied() else {
            // It will not be handed over later either: the prepared job is discarded.
            if self.state == MachineState::Prepared {
                (self.state, self.job) = (MachineState::Idle, None);
            }
            return Ok(Reconciled::NotStarted(self.status()));
        };
        if handed.job != intended.job || handed.sequence != intended.start_sequence {
            let reason = format!(
                "the folder has a hand-over of {} with START number {}, but {} with START number {} is expected",
                handed.job, handed.sequence, intended.job, intended.start_sequence
            );
            return Ok(Reconciled::Unknown { reason });
        }
        self.job = Some((handed.job, handed.sequence));
        Ok(match handed.status {
            HandOverStatus::Open | HandOverStatus::Held if self.state == MachineState::Complete => {
                Reconciled::Finished(self.status())
            }
            HandOverStatus::Open => {
                self.state = MachineState::Execute;
                Reconciled::Running(self.status())
            }
            HandOverStatus::Held => {
                self.state = MachineState::Held;
                Reconciled::Running(self.status())
            }
            HandOverStatus::Stopped => {
                self.finish(Outcome::Stopped, handed.sequence);
                Reconciled::Finished(self.status())
            }
            HandOverStatus::Aborted => {
                (self.state, self.outcome, self.done) = (MachineState::Aborted, Outcome::Aborted, handed.sequence);
                Reconciled::Finished(self.status())
            }
            HandOverStatus::Closed => {
                (self.state, self.job) = (MachineState::Idle, None);
                let reason =
                    "the result of this job was already acknowledged: see the journal for the result".to_owned();
                Reconciled::Unknown { reason }
            }
        })
    }
}

/// Guard that withdraws a permit when nobody waits for its hand-over any more.
struct WithdrawOnDrop(Permit);

impl Drop for WithdrawOnDrop {
    fn drop(&mut self) {
        self.0.withdraw();
    }
}

impl<M: Exchange> Machine for ExchangeMachine<M> {
    fn name(&self) -> &str {
        &self.name
    }

    /// Returns the present notes for a person, for example which files are awaited. Does not wait: returns an empty
    /// list while another thread works on the folders.
    fn notes(&self) -> Vec<String> {
        match self.machine.try_lock() {
            Ok(machine) => machine.notes.clone(),
            Err(TryLockError::Poisoned(machine)) => machine.into_inner().notes.clone(),
            Err(TryLockError::WouldBlock) => Vec::new(),
        }
    }

    fn operator_step(&self) -> Option<OperatorStep> {
        match self.machine.try_lock() {
            Ok(machine) => machine.step.clone(),
            Err(_) => None,
        }
    }

    async fn connect(&mut self) -> DeviceResult<Identity> {
        self.run_blocking("its identity", |machine, _| {
            machine.open()?;
            Ok(Identity::for_manual_machine(machine.kind, &machine.name))
        })
        .await
    }

    async fn status(&mut self) -> DeviceResult<Status> {
        self.run_blocking("its status", |machine, now| {
            machine.check_connected("its status")?;
            machine.poll_answer(now)?;
            Ok(machine.status())
        })
        .await
    }

    async fn claim(&mut self) -> DeviceResult<Status> {
        self.command(MachineCommand::Claim, |machine| {
            machine.owned = true;
            Ok(())
        })
        .await
    }

    async fn prepare(&mut self, job: Job) -> DeviceResult<Armed> {
        self.run_blocking("PREPARE", move |machine, _| {
            machine.check_connected("PREPARE")?;
            if !machine.owned {
                return Err(machine.refused(MachineCommand::Prepare, Answer::NotOwner));
            }
            machine.prepare(job)
        })
        .await
    }

    async fn start(&mut self, armed: Armed) -> DeviceResult<Started> {
        let (job, sequence) = (armed.job, armed.start_sequence);
        let permit = Permit::new();
        let kept = permit.clone();
        // A client that drops this future no longer waits.
        let _until_here = WithdrawOnDrop(permit.clone());
        let told = self
            .run_blocking("START", move |machine, _| {
                machine.check_connected("START")?;
                machine.start(&armed, &kept)
            })
            .await;
        match told {
            // The work continues after the timeout, but no hand-over appears any more.
            Err(reason @ (DeviceError::TimedOut { .. } | DeviceError::Disconnected { .. })) if permit.withdraw() => {
                Err(reason)
            }
            // The hand-over may have appeared in this moment; then it is taken back.
            Err(reason @ (DeviceError::TimedOut { .. } | DeviceError::Disconnected { .. })) => {
                let machine = Arc::clone(&self.name);
                Err(DeviceError::StartUnknown { machine, job, sequence, cause: Box::new(reason) })
            }
            told => told,
        }
    }

    async fn hold(&mut self) -> DeviceResult<Status> {
        self.command(MachineCommand::Hold, FolderMachine::hold).await
    }

    async fn resume(&mut self) -> DeviceResult<Status> {
        self.command(MachineCommand::Resume, FolderMachine::resume).await
    }

    async fn stop(&mut self) -> DeviceResult<Status> {
        self.command(MachineCommand::Stop, FolderMachine::stop).await
    }

    async fn abort(&mut self) -> DeviceResult<Status> {
        self.command(MachineCommand::Abort, FolderMachine::abort).await
    }

    async fn clear(&mut self) -> DeviceResult<Status> {
        self.command(MachineCommand::Clear, |machine| {
            if !matches!(machine.state, MachineState::Aborted | MachineState::Faulted) {
                return Err(machine.refused(MachineCommand::Clear, Answer::WrongState));
            }
            (machine.state, machine.job, machine.outcome) = (MachineState::Idle, None, Outcome::None);
            machine.notes.clear();
            Ok(())
        })
        .await
    }

    async fn acknowledge(&mut self, done: u32) -> DeviceResult<Status> {
        self.command(MachineCommand::Acknowledge, move |machine| machine.acknowledge(done)).await
    }

    async fn release(&mut self) -> DeviceResult<Status> {
        self.command(MachineCommand::Release, |machine| {
            if machine.state == MachineState::Execute {
                return Err(machine.refused(MachineCommand::Release, Answer::WrongState));
            }
            machine.owned = false;
            Ok(())
        })
        .await
    }

    async fn reconcile(&mut self, intended: &Armed) -> DeviceResult<Reconciled> {
        let intended = intended.clone();
        self.run_blocking("the outcome of a start", move |machine, _| machine.reconcile(&intended)).await
    }

    async fn confirm(&mut self, word: OperatorConfirmation) -> DeviceResult<Vec<String>> {
        let (what, map_identity) = match word {
            OperatorConfirmation::Done { file: Some(file), .. } => {
                return self.run_blocking("a file", move |machine, _| machine.take_file(&file)).await;
            }
            OperatorConfirmation::Started { map_identity } => (ConfirmedStep::Started, map_identity),
            OperatorConfirmation::Done { map_identity, .. } => (ConfirmedStep::Done, map_identity),
            OperatorConfirmation::Still => {
                return Err(DeviceError::ConfirmationNotNeeded { machine: Arc::clone(&self.name) });
            }
        };
        let map_identity = map_identity.ok_or_else(|| DeviceError::MapNotNamed { machine: Arc::clone(&self.name) })?;
        self.run_blocking("a confirmation", move |machine, _| machine.confirm(what, map_identity)).await
    }
}

impl<M: Exchange<Request = MeasureOrder, Answer = Measurement>> Cmm for ExchangeMachine<M> {
    async fn load_plan(&mut self, plan: &Plan, _: &Interrupt) -> DeviceResult<()> {
        let plan_identity = plan.identity();
        self.load(MeasureOrder { plan: plan.clone(), plan_identity }, digest(&[plan_identity])).await
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> DeviceResult<Measurement> {
        let (measurement, done) = self.answer(job).await?;
        Ok(Measurement { done, ..measurement })
    }
}

impl<M: Exchange<Request = GrindOrder, Answer = PassRecord>> Grinder for ExchangeMachine<M> {
    async fn load_pass(&mut self, map: &CorrectionMap, pass: &Pass, _: &Interrupt) -> DeviceResult<()> {
        let map_identity = map.identity();
        let order = GrindOrder { map: map.clone(), pass: *pass, map_identity };
        self.load(order, digest(&[map_identity, pass.identity()])).await
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> DeviceResult<PassRecord> {
        let (record, done) = self.answer(job).await?;
        Ok(PassRecord { done, ..record })
    }
}
