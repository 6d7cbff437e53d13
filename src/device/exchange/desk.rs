//! The states of a machine that is two folders and a person.

use std::sync::{Arc, Mutex, PoisonError, TryLockError};
use std::time::Duration;

use tokio::time::{Instant, timeout};

use super::{CmmMailbox, GrindOrder, GrinderMailbox, HandOver, Mailbox, MailboxError, MeasureOrder, Standing, Step};
use crate::device::{
    Answer, Armed, Cmm, Command, CorrectionMap, DeviceError, Grinder, Identified, Identity, Interrupt, Job, Machine,
    MachineKind, Measurement, Outcome, Pass, PassRecord, Plan, Reconciled, Started, State, Status, Word, digest,
};

/// How long to wait for what.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExchangeTiming {
    /// For the folders to answer; a lost network drive may never do.
    pub request_timeout: Duration,
}

impl Default for ExchangeTiming {
    fn default() -> Self {
        Self { request_timeout: Duration::from_secs(10) }
    }
}

/// A machine behind two folders.
///
/// Every method does its work on a thread for blocking work and to its end, even if its future is dropped.
#[derive(Debug)]
pub struct ExchangeMachine<M: Mailbox> {
    name: Arc<str>,
    timing: ExchangeTiming,
    made: Instant,
    desk: Arc<Mutex<Desk<M>>>,
}

/// Where the machine stands, by what is in the folders.
#[derive(Debug)]
struct Desk<M: Mailbox> {
    name: Arc<str>,
    kind: MachineKind,
    mailbox: M,
    connected: bool,
    state: State,
    /// What would be handed over, and its digest.
    loaded: Option<(M::Request, u32)>,
    /// The job prepared, running or finished, and the number of its start.
    job: Option<(Job, u32)>,
    /// Every hand-over ever made, the oldest first.
    handed: Vec<HandOver>,
    outcome: Outcome,
    done: u32,
    answer: Option<M::Answer>,
    begun: bool,
    said: Vec<String>,
    owned: bool,
    /// Whether the machine cannot reach the part where the other one works.
    apart: bool,
    /// Whether it is clear of the part: a person who confirms the end of a pass says so, a file that arrives does not.
    clear: Option<bool>,
}

type Told<T> = Result<T, DeviceError>;

impl<M: Mailbox> ExchangeMachine<M> {
    /// Takes the folders of a machine; `name` is what messages call it.
    pub fn new(name: impl Into<Arc<str>>, kind: MachineKind, mailbox: M, timing: ExchangeTiming) -> Self {
        let name = name.into();
        let desk = Desk {
            name: Arc::clone(&name),
            kind,
            mailbox,
            connected: false,
            state: State::Idle,
            loaded: None,
            job: None,
            handed: Vec::new(),
            outcome: Outcome::None,
            done: 0,
            answer: None,
            begun: false,
            said: Vec::new(),
            owned: false,
            apart: false,
            clear: None,
        };
        Self { name, timing, made: Instant::now(), desk: Arc::new(Mutex::new(desk)) }
    }

    /// Says whether the machine stands apart, so that it is always clear of the part.
    #[must_use]
    pub fn apart(self, apart: bool) -> Self {
        self.desk.lock().unwrap_or_else(PoisonError::into_inner).apart = apart;
        self
    }

    /// What a person should know now: what is waited for, which files were left alone and why. Nothing while the folders are being
    /// looked at.
    pub fn notes(&self) -> Vec<String> {
        match self.desk.try_lock() {
            Ok(desk) => desk.said.clone(),
            Err(TryLockError::Poisoned(desk)) => desk.into_inner().said.clone(),
            Err(TryLockError::WouldBlock) => Vec::new(),
        }
    }

    /// Runs a piece of work on the folders, off the threads that must not wait.
    async fn at_desk<T: Send + 'static>(
        &self,
        what: &'static str,
        work: impl FnOnce(&mut Desk<M>, Duration) -> Told<T> + Send + 'static,
    ) -> Told<T> {
        let (desk, now) = (Arc::clone(&self.desk), self.made.elapsed());
        let job = tokio::task::spawn_blocking(move || {
            let mut desk = desk.lock().unwrap_or_else(PoisonError::into_inner);
            work(&mut desk, now)
        });
        let limit = self.timing.request_timeout;
        match timeout(limit, job).await {
            Ok(Ok(told)) => told,
            Ok(Err(broken)) if broken.is_panic() => std::panic::resume_unwind(broken.into_panic()),
            Ok(Err(_)) => Err(DeviceError::Disconnected { machine: Arc::clone(&self.name), what }),
            Err(_) => Err(DeviceError::TimedOut { machine: Arc::clone(&self.name), what, limit }),
        }
    }

    async fn command(
        &self,
        command: Command,
        work: impl FnOnce(&mut Desk<M>) -> Told<()> + Send + 'static,
    ) -> Told<Status> {
        self.at_desk("a command", move |desk, _| {
            desk.check_connected("a command")?;
            if !desk.owned && !matches!(command, Command::Claim | Command::Abort) {
                return Err(desk.refused(command, Answer::NotOwner));
            }
            work(desk)?;
            Ok(desk.status())
        })
        .await
    }

    async fn load(&self, request: M::Request, digest: u32) -> Told<()> {
        self.at_desk("a payload", move |desk, _| {
            desk.check_connected("a payload")?;
            if matches!(desk.state, State::Execute | State::Holding | State::Held) {
                return Err(desk.refused(Command::Prepare, Answer::WrongState));
            }
            desk.loaded = Some((request, digest));
            if desk.state == State::Prepared {
                (desk.state, desk.job) = (State::Idle, None);
            }
            Ok(())
        })
        .await
    }

    async fn answer(&self, job: Job) -> Told<(M::Answer, u32)> {
        self.at_desk("a result", move |desk, _| {
            let same = desk.job.is_some_and(|(own, _)| own == job);
            match &desk.answer {
                Some(answer) if desk.state == State::Complete && same => Ok((answer.clone(), desk.done)),
                _ => Err(DeviceError::NoResult { machine: Arc::clone(&desk.name), job, state: desk.state }),
            }
        })
        .await
    }
}

impl<M: Mailbox> ExchangeMachine<M> {
    /// Takes a person's word that the job whose map has this identity has begun.
    ///
    /// # Errors
    /// A map other than the one handed over, no open hand-over, a folder that cannot be written.
    pub async fn confirm_started(&self, map_identity: [u8; 32]) -> Told<()> {
        self.confirmed(Step::Started, map_identity).await
    }

    /// Takes a person's word that the job whose map has this identity has ended and the part is clear.
    ///
    /// # Errors
    /// Those of [`ExchangeMachine::confirm_started`].
    pub async fn confirm_done(&self, map_identity: [u8; 32]) -> Told<()> {
        self.confirmed(Step::Done, map_identity).await
    }

    async fn confirmed(&self, step: Step, map_identity: [u8; 32]) -> Told<()> {
        self.at_desk("a confirmation", move |desk, _| {
            desk.check_connected("a confirmation")?;
            if desk.kind == MachineKind::Cmm {
                return Err(DeviceError::TellsItself { machine: Arc::clone(&desk.name) });
            }
            let Some((job, _)) = desk.job.filter(|_| desk.state == State::Execute) else {
                return Err(desk.refused(Command::Start, Answer::WrongState));
            };
            desk.mailbox.confirm(job, step, map_identity).map_err(|error| desk.failed(Command::Start, error))
        })
        .await
    }
}

impl<M: Mailbox> Desk<M> {
    fn check_connected(&self, what: &'static str) -> Told<()> {
        if self.connected { Ok(()) } else { Err(DeviceError::NotConnected { machine: Arc::clone(&self.name), what }) }
    }

    fn refused(&self, command: Command, answer: Answer) -> DeviceError {
        DeviceError::Refused { machine: Arc::clone(&self.name), command, answer, state: self.state }
    }

    fn failed(&self, command: Command, error: MailboxError) -> DeviceError {
        let machine = Arc::clone(&self.name);
        let short = |identity: &[u8; 32]| identity[..8].iter().fold(0, |sum, &b| sum << 8 | u64::from(b));
        match error {
            MailboxError::HandedOver { .. } => self.refused(command, Answer::AlreadyBegun),
            MailboxError::NotOpen { .. } => self.refused(command, Answer::WrongState),
            MailboxError::OtherMap { expected, found } => DeviceError::Mismatch {
                machine,
                field: "the identity of the map",
                sent: short(&expected),
                held: short(&found),
            },
            MailboxError::Files { why } => DeviceError::Folder { machine, why },
        }
    }

    fn status(&self) -> Status {
        Status {
            state: self.state,
            job: self.job.map(|(job, _)| job),
            done: self.done,
            outcome: self.outcome,
            clear_of_part: if self.apart { Some(true) } else { self.clear },
            supplies: None,
            fault: None,
            progress: None,
            temperature_c: None,
            boot_id: None,
            signals: Vec::new(),
        }
    }

    /// Reads the folders' memory; what stands open there is what this machine is doing.
    fn open(&mut self) -> Told<()> {
        self.handed = self.mailbox.open().map_err(|error| self.failed(Command::Claim, error))?;
        if !self.connected
            && let Some(last) = self.handed.last().filter(|h| matches!(h.standing, Standing::Open | Standing::Held))
        {
            self.job = Some((last.job, last.sequence));
            self.state = if last.standing == Standing::Open { State::Execute } else { State::Held };
        }
        self.connected = true;
        Ok(())
    }

    /// Looks for the answer while one is waited for.
    fn look(&mut self, now: Duration) -> Told<()> {
        let Some((job, sequence)) = self.job.filter(|_| self.state == State::Execute) else { return Ok(()) };
        let look = self.mailbox.look(now, job).map_err(|error| self.failed(Command::Start, error))?;
        self.said = look.said;
        self.begun = look.begun;
        if look.answer.is_some() {
            self.answer = look.answer;
            self.clear = (self.kind == MachineKind::Grinder).then_some(true);
            self.finish(Outcome::Complete, sequence);
        }
        Ok(())
    }

    fn finish(&mut self, outcome: Outcome, sequence: u32) {
        (self.state, self.outcome, self.done) = (State::Complete, outcome, sequence);
    }

    fn prepare(&mut self, job: Job) -> Told<Armed> {
        if self.state != State::Idle {
            return Err(self.refused(Command::Prepare, Answer::WrongState));
        }
        match &self.loaded {
            None => return Err(self.refused(Command::Prepare, Answer::PayloadMissing)),
            Some((_, digest)) if *digest != job.digest => {
                return Err(self.refused(Command::Prepare, Answer::OtherJob));
            }
            Some(_) => {}
        }
        self.open()?;
        if self.handed.iter().any(|h| (h.job.job, h.job.cycle) == (job.job, job.cycle)) {
            return Err(self.refused(Command::Prepare, Answer::AlreadyBegun));
        }
        let start_sequence = self.handed.last().map_or(0, |h| h.sequence) + 1;
        (self.job, self.state) = (Some((job, start_sequence)), State::Prepared);
        (self.outcome, self.answer, self.begun) = (Outcome::None, None, false);
        Ok(Armed { job, start_sequence, token: 0, boot_id: 0 })
    }

    fn start(&mut self, armed: &Armed) -> Told<Started> {
        if self.state != State::Prepared {
            return Err(self.refused(Command::Start, Answer::WrongState));
        }
        let (job, sequence) = (armed.job, armed.start_sequence);
        let Some((request, _)) = self.loaded.as_ref().filter(|_| self.job == Some((job, sequence))) else {
            return Err(self.refused(Command::Start, Answer::OtherJob));
        };
        if let Err(error) = self.mailbox.publish(job, sequence, request) {
            return self.after_failed_start(armed, error);
        }
        self.handed.push(HandOver { job, sequence, standing: Standing::Open });
        self.started(armed)
    }

    fn started(&mut self, armed: &Armed) -> Told<Started> {
        (self.state, self.clear) = (State::Execute, None);
        self.said = vec!["handed over; waiting for the answer".to_owned()];
        Ok(Started { job: armed.job, start_sequence: armed.start_sequence, status: self.status() })
    }

    /// Something went wrong while the hand-over was published: whether it is there is read from the folder.
    fn after_failed_start(&mut self, armed: &Armed, error: MailboxError) -> Told<Started> {
        let why = self.failed(Command::Start, error);
        match self.mailbox.open() {
            Ok(handed) => {
                self.handed = handed;
                let ours = |h: &HandOver| (h.job, h.sequence) == (armed.job, armed.start_sequence);
                if self.handed.iter().any(ours) {
                    return self.started(armed);
                }
                (self.state, self.job) = (State::Idle, None);
                Err(why)
            }
            Err(_) => Err(DeviceError::StartUnknown {
                machine: Arc::clone(&self.name),
                job: armed.job,
                sequence: armed.start_sequence,
                why: Box::new(why),
            }),
        }
    }

    fn mark(&mut self, command: Command, standing: Standing) -> Told<()> {
        let Some((job, sequence)) = self.job else { return Err(self.refused(command, Answer::WrongState)) };
        self.mailbox.mark(job, standing).map_err(|error| self.failed(command, error))?;
        for handed in self.handed.iter_mut().filter(|h| h.sequence == sequence) {
            handed.standing = standing;
        }
        Ok(())
    }

    fn hold(&mut self) -> Told<()> {
        if self.state != State::Execute {
            return Err(self.refused(Command::Hold, Answer::WrongState));
        }
        self.mark(Command::Hold, Standing::Held)?;
        self.state = State::Held;
        self.said = self.taken_back();
        Ok(())
    }

    fn resume(&mut self) -> Told<()> {
        if self.state != State::Held {
            return Err(self.refused(Command::Resume, Answer::WrongState));
        }
        self.mark(Command::Resume, Standing::Open)?;
        self.state = State::Execute;
        Ok(())
    }

    fn stop(&mut self) -> Told<()> {
        match (self.state, self.job) {
            (State::Prepared, _) => (self.state, self.job) = (State::Idle, None),
            (State::Execute | State::Held, Some((_, sequence))) => {
                self.mark(Command::Stop, Standing::Stopped)?;
                self.said = self.taken_back();
                self.finish(Outcome::Stopped, sequence);
            }
            _ => return Err(self.refused(Command::Stop, Answer::WrongState)),
        }
        Ok(())
    }

    fn abort(&mut self) -> Told<()> {
        let was = std::mem::replace(&mut self.state, State::Aborted);
        let lies = |h: &&HandOver| matches!(h.standing, Standing::Open | Standing::Held);
        let ours = self.job.filter(|(_, sequence)| self.handed.iter().filter(lies).any(|h| h.sequence == *sequence));
        if was == State::Prepared || ours.is_none() {
            return Ok(());
        }
        self.said = self.taken_back();
        (self.outcome, self.answer) = (Outcome::Aborted, None);
        // ABORTED is entered even if the folder cannot be reached; the error says that the hand-over may still lie there.
        self.mark(Command::Abort, Standing::Aborted)
    }

    fn taken_back(&self) -> Vec<String> {
        let words = match (self.begun, self.kind) {
            (true, MachineKind::Grinder) => {
                "the hand-over was taken back, but the start was confirmed: stop the grinder at its own panel"
            }
            (_, MachineKind::Grinder) => {
                "the hand-over was taken back; if the grinder runs on it, stop it at its own panel"
            }
            (_, MachineKind::Cmm) => {
                "the plan was taken back; if the measuring machine runs on it, stop it at its own panel"
            }
        };
        vec![words.to_owned()]
    }

    fn acknowledge(&mut self, done: u32) -> Told<()> {
        if self.state != State::Complete {
            return Err(self.refused(Command::Acknowledge, Answer::WrongState));
        }
        if done != self.done {
            return Err(self.refused(Command::Acknowledge, Answer::OtherResult));
        }
        if self.outcome == Outcome::Complete {
            self.mark(Command::Acknowledge, Standing::Closed)?;
        }
        (self.state, self.job, self.answer) = (State::Idle, None, None);
        (self.outcome, self.done, self.begun) = (Outcome::None, 0, false);
        self.said.clear();
        Ok(())
    }

    fn reconcile(&mut self, intended: &Armed) -> Told<Reconciled> {
        self.open()?;
        let Job { job, cycle, .. } = intended.job;
        let Some(handed) = self.handed.iter().find(|h| (h.job.job, h.job.cycle) == (job, cycle)).copied() else {
            return Ok(Reconciled::NotStarted(self.status()));
        };
        if handed.job != intended.job || handed.sequence != intended.start_sequence {
            let why = format!(
                "the folder holds a hand-over of {} with number {}, meant was {} with number {}",
                handed.job, handed.sequence, intended.job, intended.start_sequence
            );
            return Ok(Reconciled::Unknown { why });
        }
        self.job = Some((handed.job, handed.sequence));
        Ok(match handed.standing {
            Standing::Open | Standing::Held if self.state == State::Complete => Reconciled::Finished(self.status()),
            Standing::Open => {
                self.state = State::Execute;
                Reconciled::Running(self.status())
            }
            Standing::Held => {
                self.state = State::Held;
                Reconciled::Running(self.status())
            }
            Standing::Stopped => {
                self.finish(Outcome::Stopped, handed.sequence);
                Reconciled::Finished(self.status())
            }
            Standing::Aborted => {
                (self.state, self.outcome, self.done) = (State::Aborted, Outcome::Aborted, handed.sequence);
                Reconciled::Finished(self.status())
            }
            Standing::Closed => {
                (self.state, self.job) = (State::Idle, None);
                let why = "its result was acknowledged before; it must stand in the journal".to_owned();
                Reconciled::Unknown { why }
            }
        })
    }
}

impl<M: Mailbox> Machine for ExchangeMachine<M> {
    fn name(&self) -> &str {
        &self.name
    }

    fn notes(&self) -> Vec<String> {
        Self::notes(self)
    }

    async fn connect(&mut self) -> Told<Identity> {
        self.at_desk("who it is", |desk, _| {
            desk.open()?;
            Ok(Identity {
                kind: desk.kind,
                name: desk.name.to_string(),
                boot_id: 0,
                simulation: false,
                // A person is never lost by silence.
                silence_limit_s: None,
            })
        })
        .await
    }

    async fn status(&mut self) -> Told<Status> {
        self.at_desk("its status", |desk, now| {
            desk.check_connected("its status")?;
            desk.look(now)?;
            Ok(desk.status())
        })
        .await
    }

    async fn claim(&mut self) -> Told<Status> {
        self.command(Command::Claim, |desk| {
            desk.owned = true;
            Ok(())
        })
        .await
    }

    async fn prepare(&mut self, job: Job) -> Told<Armed> {
        self.at_desk("PREPARE", move |desk, _| {
            desk.check_connected("PREPARE")?;
            if !desk.owned {
                return Err(desk.refused(Command::Prepare, Answer::NotOwner));
            }
            desk.prepare(job)
        })
        .await
    }

    async fn start(&mut self, armed: Armed) -> Told<Started> {
        let (job, sequence) = (armed.job, armed.start_sequence);
        let told = self
            .at_desk("START", move |desk, _| {
                desk.check_connected("START")?;
                desk.start(&armed)
            })
            .await;
        match told {
            // The work goes on behind the time-out.
            Err(why @ (DeviceError::TimedOut { .. } | DeviceError::Disconnected { .. })) => {
                let machine = Arc::clone(&self.name);
                Err(DeviceError::StartUnknown { machine, job, sequence, why: Box::new(why) })
            }
            told => told,
        }
    }

    async fn hold(&mut self) -> Told<Status> {
        self.command(Command::Hold, Desk::hold).await
    }

    async fn resume(&mut self) -> Told<Status> {
        self.command(Command::Resume, Desk::resume).await
    }

    async fn stop(&mut self) -> Told<Status> {
        self.command(Command::Stop, Desk::stop).await
    }

    async fn abort(&mut self) -> Told<Status> {
        self.command(Command::Abort, Desk::abort).await
    }

    async fn clear(&mut self) -> Told<Status> {
        self.command(Command::Clear, |desk| {
            if !matches!(desk.state, State::Aborted | State::Faulted) {
                return Err(desk.refused(Command::Clear, Answer::WrongState));
            }
            (desk.state, desk.job, desk.outcome) = (State::Idle, None, Outcome::None);
            desk.said.clear();
            Ok(())
        })
        .await
    }

    async fn acknowledge(&mut self, done: u32) -> Told<Status> {
        self.command(Command::Acknowledge, move |desk| desk.acknowledge(done)).await
    }

    async fn release(&mut self) -> Told<Status> {
        self.command(Command::Release, |desk| {
            if desk.state == State::Execute {
                return Err(desk.refused(Command::Release, Answer::WrongState));
            }
            desk.owned = false;
            Ok(())
        })
        .await
    }

    async fn reconcile(&mut self, intended: &Armed) -> Told<Reconciled> {
        let intended = intended.clone();
        self.at_desk("what became of a start", move |desk, _| desk.reconcile(&intended)).await
    }

    async fn confirm(&mut self, word: Word) -> Told<Vec<String>> {
        let (step, map_identity) = match word {
            Word::Started { map_identity } => (Step::Started, map_identity),
            Word::Done { map_identity, .. } => (Step::Done, map_identity),
            Word::Still => return Err(DeviceError::TellsItself { machine: Arc::clone(&self.name) }),
        };
        let map_identity = map_identity.ok_or_else(|| DeviceError::MapUnnamed { machine: Arc::clone(&self.name) })?;
        self.confirmed(step, map_identity).await.map(|()| Vec::new())
    }
}

impl<M: CmmMailbox> Cmm for ExchangeMachine<M> {
    async fn load_plan(&mut self, plan: &Plan, _: &Interrupt) -> Told<()> {
        let plan_identity = plan.identity();
        self.load(MeasureOrder { plan: plan.clone(), plan_identity }, digest(&[plan_identity])).await
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> Told<Measurement> {
        let (measurement, done) = self.answer(job).await?;
        Ok(Measurement { done, ..measurement })
    }
}

impl<M: GrinderMailbox> Grinder for ExchangeMachine<M> {
    async fn load_pass(&mut self, map: &CorrectionMap, pass: &Pass, _: &Interrupt) -> Told<()> {
        let map_identity = map.identity();
        let order = GrindOrder { map: map.clone(), pass: *pass, map_identity };
        self.load(order, digest(&[map_identity, pass.identity()])).await
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> Told<PassRecord> {
        let (record, done) = self.answer(job).await?;
        Ok(PassRecord { done, ..record })
    }
}
