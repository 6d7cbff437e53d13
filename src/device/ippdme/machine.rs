//! The measuring machine of an I++ DME server, as the cell sees it.
//!
//! The server stores no job. This driver stores the results of a job, and they outlive the connection: after a
//! reconnect the machine is stopped, and the job is held until it is resumed. The resumed job measures the remaining
//! targets. The results do not outlive this program.

use std::sync::{Arc, Mutex};

use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::Instant;

use super::response::values;
use super::route::Route;
use super::session::{Failure, Session};
use super::settings::{IppdmeSettings, name};
use super::text::Item;
use super::work::{Order, Shared, Wish, Work, Worker, ask_if_there, locked};
use crate::error::{Answered, DeviceError};
use crate::kept::Kept;
use crate::machine::{Cmm, Interrupt, Machine};
use crate::modbus::OfThisComputer;
use crate::payload::{Identified, MeasuredPoint, Measurement, Plan, Preliminary};
use crate::words::{
    Answer, Armed, Command, Fault, Identity, Job, MachineKind, Outcome, Reconciled, Started, State, Status, digest,
};
use crate::{Dial, Line};
use regrind_formats::result::Coordinates;

/// Word in the machine class of a simulated server.
const SIMULATED: &str = "Simulated";

/// Measuring machine of an I++ DME server.
#[derive(Debug)]
pub struct IppdmeCmm {
    name: Arc<str>,
    settings: Arc<IppdmeSettings>,
    shared: Arc<Mutex<Shared>>,
    aborts: watch::Sender<u64>,
    wish: watch::Sender<Wish>,
    /// Order channel of the task that owns the session; `None` without a session.
    orders: Option<mpsc::Sender<Order>>,
    identity: Option<Identity>,
    kept: Kept<Work>,
    /// Work and plan identity of the running or prepared job.
    work: Option<(Arc<Work>, [u8; 32])>,
    dial: Box<dyn Dial>,
    /// True if long computations run in turn with everything else, not on a thread of their own.
    in_turn: bool,
}

impl IppdmeCmm {
    /// Creates a machine; sends nothing to it yet.
    pub fn new(settings: IppdmeSettings) -> Self {
        Self::by(settings, Box::new(OfThisComputer), false)
    }

    /// Creates a machine that opens its connections with `dial` and computes on no other thread: for servers in the
    /// same process, and for simulated time.
    pub fn over(settings: IppdmeSettings, dial: Box<dyn Dial>) -> Self {
        Self::by(settings, dial, true)
    }

    fn by(settings: IppdmeSettings, dial: Box<dyn Dial>, in_turn: bool) -> Self {
        Self {
            name: name(&settings),
            settings: Arc::new(settings),
            shared: Arc::new(Mutex::new(Shared::new())),
            aborts: watch::Sender::new(0),
            wish: watch::Sender::new(Wish::GoOn),
            orders: None,
            identity: None,
            kept: Kept::none(),
            work: None,
            dial,
            in_turn,
        }
    }

    /// Opens a session and checks the identity of the machine. When the session is open, nothing moves: the server
    /// first finishes its current command, or aborts it if an abort was ordered that no session has sent. A motion left
    /// from our own job may last at most `silence_limit`.
    async fn open(&mut self) -> Answered<Identity> {
        let state = locked(&self.shared).state;
        let moved = state.moves() || self.kept.untold.is_some();
        // An abort that nobody has confirmed is sent again.
        let aborted = self.aborts.borrow().saturating_sub(u64::from(state == State::Aborting));
        let line = Line::Tcp { host: self.settings.host.clone(), port: self.settings.port };
        let (machine, aborts) = (Arc::clone(&self.name), self.aborts.subscribe());
        let mut session =
            Session::dial(machine, (&line, self.dial.as_mut()), self.settings.limits, (aborts, aborted)).await?;
        let identity = self.meet(&mut session, moved).await.map_err(|failure| self.in_words("the session", failure))?;
        let (orders, inbox) = mpsc::channel(4);
        let worker = Worker {
            session,
            shared: Arc::clone(&self.shared),
            orders: inbox,
            wish: self.wish.subscribe(),
            settings: Arc::clone(&self.settings),
            at_mm: None,
            speeds_mm_s: [0.0; 3],
        };
        {
            let mut shared = locked(&self.shared);
            shared.lost = None;
            shared.stands();
            shared.notes = worker.session.notes();
        }
        tokio::spawn(worker.attend());
        (self.orders, self.identity) = (Some(orders), Some(identity.clone()));
        Ok(identity)
    }

    async fn meet(&self, session: &mut Session, moved: bool) -> Result<Identity, Failure> {
        session.open(moved.then_some(self.settings.silence_limit)).await?;
        let version = ask_if_there(session, "GetDMEVersion", Vec::new()).await?;
        let class = ask_if_there(session, "GetMachineClass", Vec::new()).await?;
        let said = |answer: &Option<super::session::Answer>, name: &str| match answer
            .as_ref()?
            .line()
            .and_then(|data| values(data, name))?
            .first()?
        {
            Item::Text(text) | Item::Name(text) => Some(text.clone()),
            _ => None,
        };
        let class = said(&class, "GetMachineClass").unwrap_or_else(|| "CMM of no stated class".to_owned());
        self.is_meant(&class).map_err(Failure::Wrong)?;
        let version = said(&version, "DMEVersion").map_or("I++ DME before 1.4".to_owned(), |v| format!("I++ DME {v}"));
        let tools = session.ask("EnumTools", Vec::new()).await?;
        let tools: Vec<String> = tools
            .data
            .into_iter()
            .flatten()
            .filter_map(|item| if let Item::Text(tool) = item { Some(tool) } else { None })
            .collect();
        if !tools.contains(&self.settings.tool) {
            let (tool, known) = (self.settings.tool.clone(), tools.join(", "));
            return Err(Failure::Wrong(DeviceError::NoTool { machine: Arc::clone(&self.name), tool, known }));
        }
        let simulation = class.contains(SIMULATED);
        Ok(Identity {
            kind: MachineKind::Cmm,
            name: format!("{class}, {version}"),
            boot_id: 0,
            simulation,
            silence_limit_s: Some(self.settings.silence_limit.as_secs_f64()),
        })
    }

    /// Checks the machine class against the cell file: simulated or real, and the expected name.
    fn is_meant(&self, class: &str) -> Answered<()> {
        let machine = || Arc::clone(&self.name);
        let simulation = class.contains(SIMULATED);
        if simulation != self.settings.simulated {
            return Err(DeviceError::WrongReality { machine: machine(), simulation });
        }
        match &self.settings.expected_name {
            Some(expected) if expected != class => {
                Err(DeviceError::WrongName { machine: machine(), expected: expected.clone(), found: class.to_owned() })
            }
            _ => Ok(()),
        }
    }

    fn in_words(&self, method: &'static str, failure: Failure) -> DeviceError {
        let machine = Arc::clone(&self.name);
        match failure {
            Failure::Link(error) | Failure::Wrong(error) => error,
            Failure::No(error) => DeviceError::MethodRefused { machine, method, error },
            Failure::Aborted => DeviceError::Disconnected { machine, what: "aborted while it was met" },
        }
    }

    /// Returns the status known so far, or the error of the connection if there is none.
    fn told(&self) -> Answered<Status> {
        let shared = locked(&self.shared);
        if let Some(error) = &shared.lost {
            return Err(error.clone());
        }
        if self.orders.is_none() {
            return Err(DeviceError::NotConnected { machine: Arc::clone(&self.name), what: "its status" });
        }
        Ok(self.status_of(&shared))
    }

    fn status_of(&self, shared: &Shared) -> Status {
        let done = shared.points.iter().flatten().count() as u32;
        Status {
            job: shared.job.map(|(job, _)| job),
            done: shared.job.filter(|_| shared.outcome != Outcome::None).map_or(0, |(_, sequence)| sequence),
            outcome: shared.outcome,
            clear_of_part: shared.clear,
            fault: Some(shared.fault),
            progress: (!shared.points.is_empty()).then_some((done, shared.points.len() as u32)),
            ..Status::of(shared.state)
        }
    }

    fn refused(&self, command: Command, answer: Answer) -> DeviceError {
        let state = locked(&self.shared).state;
        DeviceError::Refused { machine: Arc::clone(&self.name), command, answer, state }
    }

    /// Changes the state to `to` and returns the status.
    ///
    /// # Errors
    /// Refuses with [`Answer::WrongState`] if the current state is not in `from`.
    fn go(&self, command: Command, from: &[State], to: State) -> Answered<Status> {
        self.told()?;
        let mut shared = locked(&self.shared);
        if !from.contains(&shared.state) {
            drop(shared);
            return Err(self.refused(command, Answer::WrongState));
        }
        shared.state = to;
        Ok(self.status_of(&shared))
    }

    async fn order(&self, order: Order) -> Answered<()> {
        let machine = Arc::clone(&self.name);
        let gone = DeviceError::Disconnected { machine, what: "its session is over" };
        let Some(orders) = &self.orders else { return Err(gone) };
        orders.send(order).await.map_err(|_| locked(&self.shared).lost.clone().unwrap_or(gone))
    }

    /// Checks that the server answers. While something moves, the task that owns the session does this check.
    async fn look(&self) -> Answered<()> {
        self.told()?;
        if locked(&self.shared).state.moves() {
            return Ok(());
        }
        let (answer, looked) = oneshot::channel();
        self.order(Order::Look(answer)).await?;
        // A missing answer has already marked the session as lost.
        let _ = looked.await;
        self.told().map(drop)
    }

    fn forget(&mut self) {
        let mut shared = locked(&self.shared);
        (shared.job, shared.outcome, shared.why) = (None, Outcome::None, None);
        shared.points.clear();
        drop(shared);
        self.work = None;
    }
}

impl Machine for IppdmeCmm {
    fn name(&self) -> &str {
        &self.name
    }

    fn notes(&self) -> Vec<String> {
        let shared = locked(&self.shared);
        let way = self.kept.loaded.as_ref().map(|(work, _)| {
            let Route { travel_m, plain_m, .. } = work.route;
            format!("the way across is {travel_m:.2} m, {plain_m:.2} m in the plan's order")
        });
        let why = shared.why.iter().cloned();
        why.chain(shared.notes.iter().cloned()).chain(way).collect()
    }

    async fn connect(&mut self) -> Answered<Identity> {
        // A server has one client: an intact session is kept.
        let whole = self.identity.clone().filter(|_| self.orders.is_some());
        if let Some(identity) = whole
            && self.look().await.is_ok()
        {
            return Ok(identity);
        }
        self.orders = None;
        self.open().await
    }

    async fn status(&mut self) -> Answered<Status> {
        locked(&self.shared).looked_at = Instant::now();
        self.told()
    }

    fn restore(&mut self, intended: &Armed) {
        self.kept.restore(intended);
    }

    async fn claim(&mut self) -> Answered<Status> {
        // A server has one client at a time.
        self.told()
    }

    async fn prepare(&mut self, job: Job) -> Answered<Armed> {
        let Some(work) = self.kept.ready_for(job) else {
            return Err(self.refused(Command::Prepare, Answer::PayloadMissing));
        };
        self.look().await?;
        self.go(Command::Prepare, &[State::Idle], State::Prepared)?;
        let armed = self.kept.prepared(job);
        let mut shared = locked(&self.shared);
        let points = vec![None; work.plan.targets.len()];
        *shared = Shared {
            state: State::Prepared,
            job: Some((job, armed.start_sequence)),
            clear: shared.clear,
            notes: std::mem::take(&mut shared.notes),
            points,
            ..Shared::new()
        };
        drop(shared);
        let identity = work.plan.identity();
        self.work = Some((work, identity));
        Ok(armed)
    }

    async fn start(&mut self, armed: Armed) -> Answered<Started> {
        let Armed { job, start_sequence, .. } = armed;
        self.told()?;
        let ours = locked(&self.shared).job == Some((job, start_sequence));
        let Some((work, _)) = self.work.clone().filter(|_| ours) else {
            return Err(self.refused(Command::Start, Answer::OtherJob));
        };
        self.wish.send_replace(Wish::GoOn);
        locked(&self.shared).looked_at = Instant::now();
        let status = self.go(Command::Start, &[State::Prepared], State::Execute)?;
        self.kept.begun = start_sequence;
        if let Err(error) = self.order(Order::Run(work)).await {
            // The task did not take the order: nothing was sent.
            locked(&self.shared).state = State::Prepared;
            return Err(error);
        }
        Ok(Started { job, start_sequence, status })
    }

    async fn hold(&mut self) -> Answered<Status> {
        let status = self.go(Command::Hold, &[State::Execute], State::Holding)?;
        self.wish.send_replace(Wish::Hold);
        Ok(status)
    }

    async fn resume(&mut self) -> Answered<Status> {
        let Some((work, _)) = self.work.clone() else {
            return Err(self.refused(Command::Resume, Answer::WrongState));
        };
        self.wish.send_replace(Wish::GoOn);
        locked(&self.shared).looked_at = Instant::now();
        let status = self.go(Command::Resume, &[State::Held], State::Execute)?;
        locked(&self.shared).why = None;
        self.order(Order::Run(work)).await?;
        Ok(status)
    }

    async fn stop(&mut self) -> Answered<Status> {
        if let Some(untold) = self.kept.untold.take() {
            // The session is open, so the machine is stopped.
            self.told()?;
            let mut shared = locked(&self.shared);
            (shared.job, shared.state, shared.outcome) = (Some(untold), State::Complete, Outcome::Stopped);
            return Ok(self.status_of(&shared));
        }
        let state = locked(&self.shared).state;
        match state {
            State::Prepared => {
                self.forget();
                self.go(Command::Stop, &[State::Prepared], State::Idle)
            }
            State::Held => {
                locked(&self.shared).outcome = Outcome::Stopped;
                self.go(Command::Stop, &[State::Held], State::Complete)
            }
            _ => {
                let status = self.go(Command::Stop, &[State::Execute, State::Holding], State::Stopping)?;
                self.wish.send_replace(Wish::Stop);
                Ok(status)
            }
        }
    }

    async fn abort(&mut self) -> Answered<Status> {
        let untold = self.kept.untold.take();
        {
            let mut shared = locked(&self.shared);
            shared.job = shared.job.or(untold);
            (shared.state, shared.outcome) = (State::Aborting, Outcome::Aborted);
        }
        // The owner of the session sends it at once, whatever it waits for.
        self.aborts.send_modify(|ordered| *ordered += 1);
        let lost = locked(&self.shared).lost.is_some();
        if lost || self.orders.is_none() {
            // A new session begins only after the server has finished its current command.
            self.connect().await?;
        }
        self.told()
    }

    async fn clear(&mut self) -> Answered<Status> {
        let state = locked(&self.shared).state;
        if !matches!(state, State::Aborted | State::Faulted) {
            return Err(self.refused(Command::Clear, Answer::WrongState));
        }
        let (answer, cleared) = oneshot::channel();
        self.order(Order::Clear(answer)).await?;
        cleared.await.unwrap_or_else(|_| self.told().map(drop))?;
        self.forget();
        locked(&self.shared).fault = Fault::None;
        self.go(Command::Clear, &[State::Aborted, State::Faulted], State::Idle)
    }

    async fn acknowledge(&mut self, done: u32) -> Answered<Status> {
        if locked(&self.shared).job.is_none_or(|(_, sequence)| sequence != done) {
            return Err(self.refused(Command::Acknowledge, Answer::OtherResult));
        }
        self.go(Command::Acknowledge, &[State::Complete], State::Idle)?;
        self.forget();
        self.told()
    }

    async fn release(&mut self) -> Answered<Status> {
        let status = self.told()?;
        // The task ends the session when no sender of orders is left.
        self.orders = None;
        Ok(status)
    }

    async fn reconcile(&mut self, intended: &Armed) -> Answered<Reconciled> {
        self.look().await?;
        let key = Some((intended.job, intended.start_sequence));
        let mut shared = locked(&self.shared);
        if shared.job == key {
            return Ok(match shared.state {
                State::Prepared => Reconciled::NotStarted(self.status_of(&shared)),
                State::Complete | State::Aborted | State::Faulted => Reconciled::Finished(self.status_of(&shared)),
                _ => Reconciled::Running(self.status_of(&shared)),
            });
        }
        if self.kept.untold.take_if(|untold| Some(*untold) == key).is_some() && shared.state == State::Idle {
            let gone =
                "the server keeps no job: the machine stands, and what it had touched for the interrupted run is gone";
            (shared.job, shared.state, shared.outcome) = (key, State::Complete, Outcome::Failed);
            (shared.why, shared.clear) = (Some(gone.to_owned()), None);
            return Ok(Reconciled::Finished(self.status_of(&shared)));
        }
        let why = "the server keeps no job, and this program has none of that number".to_owned();
        Ok(Reconciled::Unknown { why })
    }
}

impl Cmm for IppdmeCmm {
    async fn load_plan(&mut self, plan: &Plan, _: &Interrupt) -> Answered<()> {
        self.kept.loaded = None;
        let (owned, volume_mm, machine) = (plan.clone(), self.settings.volume_mm, Arc::clone(&self.name));
        let scan = self.settings.scan;
        let find = move || Route::over(&owned, scan, &volume_mm, &machine).map(|route| Work { plan: owned, route });
        // Ordering many targets takes time.
        let work = match self.in_turn {
            true => find(),
            false => {
                let found = tokio::task::spawn_blocking(find).await;
                found.unwrap_or_else(|panicked| std::panic::resume_unwind(panicked.into_panic()))
            }
        }?;
        self.kept.loaded = Some((Arc::new(work), digest(&[plan.identity()])));
        Ok(())
    }

    async fn read_ahead(&mut self, job: Job, _: &Interrupt) -> Option<Preliminary> {
        let shared = locked(&self.shared);
        let ours = shared.job.is_some_and(|(own, _)| own == job);
        let from = self.kept.told_ahead;
        let ready = shared.points.iter().skip(from).map_while(|point| *point);
        let points: Vec<MeasuredPoint> = if ours { ready.collect() } else { Vec::new() };
        drop(shared);
        self.kept.told_ahead += points.len();
        let there = !points.is_empty();
        there.then_some(Preliminary { job, from, points, coordinates: Coordinates::Centres })
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> Answered<Measurement> {
        let shared = locked(&self.shared);
        let complete = shared.state == State::Complete && shared.outcome == Outcome::Complete;
        let own = shared.job.filter(|(own, _)| *own == job && complete);
        let points: Option<Vec<MeasuredPoint>> = shared.points.iter().copied().collect();
        match (own, points, &self.work) {
            (Some((_, done)), Some(points), Some((_, plan_identity))) => Ok(Measurement {
                points,
                coordinates: Coordinates::Centres,
                probe_radius_mm: shared.radius_mm,
                temperature_c: None,
                duration_s: Some(shared.worked.as_secs_f64()),
                plan_identity: *plan_identity,
                job: job.job,
                cycle: job.cycle,
                done,
            }),
            _ => Err(DeviceError::NoResult { machine: Arc::clone(&self.name), job, state: shared.state }),
        }
    }
}
