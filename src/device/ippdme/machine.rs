//! The measuring machine of an I++ DME server, as the cell sees it.
//!
//! The server stores no job. This driver stores the results of a job, and they outlive the connection: after a
//! reconnect the machine is stopped, and the job is held until it is resumed. The resumed job measures the remaining
//! targets. The results do not outlive this program.

use std::sync::{Arc, Mutex};

use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::Instant;

use super::job::{RoutedPlan, SharedState, Worker, WorkerOrder, locked, request_if_supported};
use super::link::{Failure, Session};
use super::response::values;
use super::route::Route;
use super::settings::{IppdmeSettings, name};
use super::syntax::Item;
use crate::error::{DeviceError, DeviceResult};
use crate::handshake::{
    Answer, Armed, Fault, Identity, Job, MachineCommand, MachineKind, MachineState, Outcome, Reconciled, Started,
    Status, digest,
};
use crate::job_memory::JobMemory;
use crate::machine::{Cmm, Interrupt, Machine};
use crate::modbus::SystemConnector;
use crate::payload::{Identified, MeasuredPoint, Measurement, Plan, PreliminaryPoints};
use crate::{Connector, LineAddress};
use regrind_formats::result::Coordinates;

/// Word in the machine class of a simulated server.
const SIMULATED: &str = "Simulated";

/// Measuring machine of an I++ DME server.
#[derive(Debug)]
pub struct IppdmeCmm {
    name: Arc<str>,
    settings: Arc<IppdmeSettings>,
    shared: Arc<Mutex<SharedState>>,
    aborts: watch::Sender<u64>,
    /// HOLD or STOP, which the task carries out at the next safe position of the probe; `None` to continue.
    job_request: watch::Sender<Option<MachineCommand>>,
    /// Order channel of the task that owns the session; `None` without a session.
    orders: Option<mpsc::Sender<WorkerOrder>>,
    identity: Option<Identity>,
    memory: JobMemory<RoutedPlan>,
    /// RoutedPlan and plan identity of the running or prepared job.
    work: Option<(Arc<RoutedPlan>, [u8; 32])>,
    connector: Box<dyn Connector>,
    /// True if long computations run in turn with everything else, not on a thread of their own.
    single_threaded: bool,
}

impl IppdmeCmm {
    /// Creates the driver of a machine. Sends nothing to the machine yet.
    pub fn new(settings: IppdmeSettings) -> Self {
        Self::build(settings, Box::new(SystemConnector), false)
    }

    /// Creates the driver of a machine. The driver opens its connections with `dial` and starts no extra threads for
    /// long computations. Use this function for a server in the same process or for simulated time.
    pub fn with_connector(settings: IppdmeSettings, dial: Box<dyn Connector>) -> Self {
        Self::build(settings, dial, true)
    }

    fn build(settings: IppdmeSettings, dial: Box<dyn Connector>, in_turn: bool) -> Self {
        Self {
            name: name(&settings),
            settings: Arc::new(settings),
            shared: Arc::new(Mutex::new(SharedState::new())),
            aborts: watch::Sender::new(0),
            job_request: watch::Sender::new(None),
            orders: None,
            identity: None,
            memory: JobMemory::new(),
            work: None,
            connector: dial,
            single_threaded: in_turn,
        }
    }

    /// Connects to the server, opens a session and checks the identity of the machine. Returns this identity. The
    /// machine does not move when the function returns, because the server first completes its current command. If that
    /// command may belong to a job of this client, it is aborted after `silence_limit`. If an abort was ordered and not
    /// confirmed, the abort is sent at once.
    ///
    /// # Errors
    /// Returns an error if the server cannot be reached, refuses the session, has a wrong identity, or does not have
    /// the tool.
    async fn open(&mut self) -> DeviceResult<Identity> {
        let state = locked(&self.shared).state;
        let moved = state.is_moving() || self.memory.unresolved.is_some();
        // An abort that nobody has confirmed is sent again.
        let aborted = self.aborts.borrow().saturating_sub(u64::from(state == MachineState::Aborting));
        let line = LineAddress::Tcp { host: self.settings.host.clone(), port: self.settings.port };
        let (machine, aborts) = (Arc::clone(&self.name), self.aborts.subscribe());
        let mut session =
            Session::connect(machine, (&line, self.connector.as_mut()), self.settings.limits, (aborts, aborted))
                .await?;
        let identity = self
            .start_session(&mut session, moved)
            .await
            .map_err(|failure| self.device_error("the session", failure))?;
        let (orders, inbox) = mpsc::channel(4);
        let worker = Worker {
            session,
            shared: Arc::clone(&self.shared),
            orders: inbox,
            job_request: self.job_request.subscribe(),
            settings: Arc::clone(&self.settings),
            position_mm: None,
            speeds_mm_s: [0.0; 3],
        };
        {
            let mut shared = locked(&self.shared);
            shared.session_error = None;
            shared.come_to_rest();
            shared.notes = worker.session.notes();
        }
        tokio::spawn(worker.serve_session());
        (self.orders, self.identity) = (Some(orders), Some(identity.clone()));
        Ok(identity)
    }

    async fn start_session(&self, session: &mut Session, moved: bool) -> Result<Identity, Failure> {
        session.open(moved.then_some(self.settings.silence_limit)).await?;
        let version = request_if_supported(session, "GetDMEVersion", Vec::new()).await?;
        let class = request_if_supported(session, "GetMachineClass", Vec::new()).await?;
        let said = |answer: &Option<super::link::CommandReply>, name: &str| match answer
            .as_ref()?
            .line()
            .and_then(|data| values(data, name))?
            .first()?
        {
            Item::Text(text) | Item::Name(text) => Some(text.clone()),
            _ => None,
        };
        let class = said(&class, "GetMachineClass").unwrap_or_else(|| "CMM of no stated class".to_owned());
        self.check_identity(&class).map_err(Failure::Implausible)?;
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
            return Err(Failure::Implausible(DeviceError::NoTool { machine: Arc::clone(&self.name), tool, known }));
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

    /// Checks `class`, the machine class that the server reports, against the settings of the cell file.
    ///
    /// # Errors
    /// Returns an error in each of these cases:
    ///
    /// - The machine is simulated and the cell is not, or the reverse.
    /// - The cell file states an expected name, and `class` differs from it.
    fn check_identity(&self, class: &str) -> DeviceResult<()> {
        let machine = || Arc::clone(&self.name);
        let simulation = class.contains(SIMULATED);
        if simulation != self.settings.simulated {
            return Err(DeviceError::SimulationMismatch { machine: machine(), simulation });
        }
        match &self.settings.expected_name {
            Some(expected) if expected != class => {
                Err(DeviceError::WrongName { machine: machine(), expected: expected.clone(), found: class.to_owned() })
            }
            _ => Ok(()),
        }
    }

    fn device_error(&self, method: &'static str, failure: Failure) -> DeviceError {
        let machine = Arc::clone(&self.name);
        match failure {
            Failure::Link(error) | Failure::Implausible(error) => error,
            Failure::Refused(error) => DeviceError::MethodRefused { machine, method, error },
            Failure::Aborted => DeviceError::Disconnected { machine, operation: "aborted during the connection" },
        }
    }

    /// Returns the last known status. Without a session, returns the error that ended the session or
    /// [`DeviceError::NotConnected`].
    fn current_status(&self) -> DeviceResult<Status> {
        let shared = locked(&self.shared);
        if let Some(error) = &shared.session_error {
            return Err(error.clone());
        }
        if self.orders.is_none() {
            return Err(DeviceError::NotConnected { machine: Arc::clone(&self.name), operation: "its status" });
        }
        Ok(self.status_of(&shared))
    }

    fn status_of(&self, shared: &SharedState) -> Status {
        let done = shared.points.iter().flatten().count() as u32;
        Status {
            job: shared.job.map(|(job, _)| job),
            done: shared.job.filter(|_| shared.outcome != Outcome::None).map_or(0, |(_, sequence)| sequence),
            outcome: shared.outcome,
            clear_of_part: shared.clear_of_part,
            fault: Some(shared.fault),
            progress: (!shared.points.is_empty()).then_some((done, shared.points.len() as u32)),
            ..Status::from_state(shared.state)
        }
    }

    fn refused(&self, command: MachineCommand, answer: Answer) -> DeviceError {
        let state = locked(&self.shared).state;
        DeviceError::Refused { machine: Arc::clone(&self.name), command, answer, state }
    }

    /// Changes the state of the machine from one of the states in `from` to `to`. Returns the new status. `command` is
    /// the command of the client that causes the change; the error names this command.
    ///
    /// # Errors
    /// Returns the refusal [`Answer::WrongState`] if the current state is not in `from`. The state then does not
    /// change. Returns an error if the session is lost or not open.
    fn transition(&self, command: MachineCommand, from: &[MachineState], to: MachineState) -> DeviceResult<Status> {
        self.current_status()?;
        let mut shared = locked(&self.shared);
        if !from.contains(&shared.state) {
            drop(shared);
            return Err(self.refused(command, Answer::WrongState));
        }
        shared.state = to;
        Ok(self.status_of(&shared))
    }

    async fn order(&self, order: WorkerOrder) -> DeviceResult<()> {
        let machine = Arc::clone(&self.name);
        let gone = DeviceError::Disconnected { machine, operation: "its session is over" };
        let Some(orders) = &self.orders else { return Err(gone) };
        orders.send(order).await.map_err(|_| locked(&self.shared).session_error.clone().unwrap_or(gone))
    }

    /// Checks that the server answers. Sends nothing while the machine moves, because the task that owns the session
    /// then makes this check.
    ///
    /// # Errors
    /// The session is lost or not open.
    async fn check_alive(&self) -> DeviceResult<()> {
        self.current_status()?;
        if locked(&self.shared).state.is_moving() {
            return Ok(());
        }
        let (answer, looked) = oneshot::channel();
        self.order(WorkerOrder::CheckAlive(answer)).await?;
        // A missing answer has already marked the session as lost.
        let _ = looked.await;
        self.current_status().map(drop)
    }

    fn forget(&mut self) {
        let mut shared = locked(&self.shared);
        (shared.job, shared.outcome, shared.stop_reason) = (None, Outcome::None, None);
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
        let way = self.memory.loaded.as_ref().map(|(work, _)| {
            let Route { travel_m, plan_order_m: plain_m, .. } = work.route;
            format!("the travel between targets is {travel_m:.2} m; in the order of the plan, the travel would be {plain_m:.2} m")
        });
        let reason = shared.stop_reason.iter().cloned();
        reason.chain(shared.notes.iter().cloned()).chain(way).collect()
    }

    async fn connect(&mut self) -> DeviceResult<Identity> {
        // A server has one client: an intact session is kept.
        let whole = self.identity.clone().filter(|_| self.orders.is_some());
        if let Some(identity) = whole
            && self.check_alive().await.is_ok()
        {
            return Ok(identity);
        }
        self.orders = None;
        self.open().await
    }

    async fn status(&mut self) -> DeviceResult<Status> {
        locked(&self.shared).last_status_request = Instant::now();
        self.current_status()
    }

    fn restore(&mut self, intended: &Armed) {
        self.memory.restore(intended);
    }

    async fn claim(&mut self) -> DeviceResult<Status> {
        // A server has one client at a time.
        self.current_status()
    }

    async fn prepare(&mut self, job: Job) -> DeviceResult<Armed> {
        let Some(work) = self.memory.payload_for(job) else {
            return Err(self.refused(MachineCommand::Prepare, Answer::PayloadMissing));
        };
        self.check_alive().await?;
        self.transition(MachineCommand::Prepare, &[MachineState::Idle], MachineState::Prepared)?;
        let armed = self.memory.arm(job);
        let mut shared = locked(&self.shared);
        let points = vec![None; work.plan.targets.len()];
        *shared = SharedState {
            state: MachineState::Prepared,
            job: Some((job, armed.start_sequence)),
            clear_of_part: shared.clear_of_part,
            notes: std::mem::take(&mut shared.notes),
            points,
            ..SharedState::new()
        };
        drop(shared);
        let identity = work.plan.identity();
        self.work = Some((work, identity));
        Ok(armed)
    }

    async fn start(&mut self, armed: Armed) -> DeviceResult<Started> {
        let Armed { job, start_sequence, .. } = armed;
        self.current_status()?;
        let ours = locked(&self.shared).job == Some((job, start_sequence));
        let Some((work, _)) = self.work.clone().filter(|_| ours) else {
            return Err(self.refused(MachineCommand::Start, Answer::OtherJob));
        };
        self.job_request.send_replace(None);
        locked(&self.shared).last_status_request = Instant::now();
        let status = self.transition(MachineCommand::Start, &[MachineState::Prepared], MachineState::Execute)?;
        self.memory.last_start_sequence = start_sequence;
        if let Err(error) = self.order(WorkerOrder::Run(work)).await {
            // The task did not take the order: nothing was sent.
            locked(&self.shared).state = MachineState::Prepared;
            return Err(error);
        }
        Ok(Started { job, start_sequence, status })
    }

    async fn hold(&mut self) -> DeviceResult<Status> {
        let status = self.transition(MachineCommand::Hold, &[MachineState::Execute], MachineState::Holding)?;
        self.job_request.send_replace(Some(MachineCommand::Hold));
        Ok(status)
    }

    async fn resume(&mut self) -> DeviceResult<Status> {
        let Some((work, _)) = self.work.clone() else {
            return Err(self.refused(MachineCommand::Resume, Answer::WrongState));
        };
        self.job_request.send_replace(None);
        locked(&self.shared).last_status_request = Instant::now();
        let status = self.transition(MachineCommand::Resume, &[MachineState::Held], MachineState::Execute)?;
        locked(&self.shared).stop_reason = None;
        self.order(WorkerOrder::Run(work)).await?;
        Ok(status)
    }

    async fn stop(&mut self) -> DeviceResult<Status> {
        if let Some(untold) = self.memory.unresolved.take() {
            // The session is open, so the machine is stopped.
            self.current_status()?;
            let mut shared = locked(&self.shared);
            (shared.job, shared.state, shared.outcome) = (Some(untold), MachineState::Complete, Outcome::Stopped);
            return Ok(self.status_of(&shared));
        }
        let state = locked(&self.shared).state;
        match state {
            MachineState::Prepared => {
                self.forget();
                self.transition(MachineCommand::Stop, &[MachineState::Prepared], MachineState::Idle)
            }
            MachineState::Held => {
                locked(&self.shared).outcome = Outcome::Stopped;
                self.transition(MachineCommand::Stop, &[MachineState::Held], MachineState::Complete)
            }
            _ => {
                let status = self.transition(
                    MachineCommand::Stop,
                    &[MachineState::Execute, MachineState::Holding],
                    MachineState::Stopping,
                )?;
                self.job_request.send_replace(Some(MachineCommand::Stop));
                Ok(status)
            }
        }
    }

    async fn abort(&mut self) -> DeviceResult<Status> {
        let untold = self.memory.unresolved.take();
        {
            let mut shared = locked(&self.shared);
            shared.job = shared.job.or(untold);
            (shared.state, shared.outcome) = (MachineState::Aborting, Outcome::Aborted);
        }
        // The owner of the session sends it at once, whatever it waits for.
        self.aborts.send_modify(|ordered| *ordered += 1);
        let lost = locked(&self.shared).session_error.is_some();
        if lost || self.orders.is_none() {
            // A new session begins only after the server has finished its current command.
            self.connect().await?;
        }
        self.current_status()
    }

    async fn clear(&mut self) -> DeviceResult<Status> {
        let state = locked(&self.shared).state;
        if !matches!(state, MachineState::Aborted | MachineState::Faulted) {
            return Err(self.refused(MachineCommand::Clear, Answer::WrongState));
        }
        let (answer, cleared) = oneshot::channel();
        self.order(WorkerOrder::Clear(answer)).await?;
        cleared.await.unwrap_or_else(|_| self.current_status().map(drop))?;
        self.forget();
        locked(&self.shared).fault = Fault::None;
        self.transition(MachineCommand::Clear, &[MachineState::Aborted, MachineState::Faulted], MachineState::Idle)
    }

    async fn acknowledge(&mut self, done: u32) -> DeviceResult<Status> {
        if locked(&self.shared).job.is_none_or(|(_, sequence)| sequence != done) {
            return Err(self.refused(MachineCommand::Acknowledge, Answer::OtherResult));
        }
        self.transition(MachineCommand::Acknowledge, &[MachineState::Complete], MachineState::Idle)?;
        self.forget();
        self.current_status()
    }

    async fn release(&mut self) -> DeviceResult<Status> {
        let status = self.current_status()?;
        // The task ends the session when no sender of orders is left.
        self.orders = None;
        Ok(status)
    }

    async fn reconcile(&mut self, intended: &Armed) -> DeviceResult<Reconciled> {
        self.check_alive().await?;
        let key = Some((intended.job, intended.start_sequence));
        let mut shared = locked(&self.shared);
        if shared.job == key {
            return Ok(match shared.state {
                MachineState::Prepared => Reconciled::NotStarted(self.status_of(&shared)),
                MachineState::Complete | MachineState::Aborted | MachineState::Faulted => {
                    Reconciled::Finished(self.status_of(&shared))
                }
                _ => Reconciled::Running(self.status_of(&shared)),
            });
        }
        if self.memory.unresolved.take_if(|untold| Some(*untold) == key).is_some() && shared.state == MachineState::Idle
        {
            let gone = "the machine has stopped, and the touches of the interrupted run are lost, because an I++ DME server does not store a job";
            (shared.job, shared.state, shared.outcome) = (key, MachineState::Complete, Outcome::Failed);
            (shared.stop_reason, shared.clear_of_part) = (Some(gone.to_owned()), None);
            return Ok(Reconciled::Finished(self.status_of(&shared)));
        }
        let reason = "an I++ DME server does not store a job, and Regrind has no record of a job with this START number: check at the machine whether the job was done".to_owned();
        Ok(Reconciled::Unknown { reason })
    }
}

impl Cmm for IppdmeCmm {
    async fn load_plan(&mut self, plan: &Plan, _: &Interrupt) -> DeviceResult<()> {
        self.memory.loaded = None;
        let (owned, volume_mm, machine) = (plan.clone(), self.settings.volume_mm, Arc::clone(&self.name));
        let scan = self.settings.scan;
        let find =
            move || Route::find(&owned, scan, &volume_mm, &machine).map(|route| RoutedPlan { plan: owned, route });
        // Ordering many targets takes time.
        let work = match self.single_threaded {
            true => find(),
            false => {
                let found = tokio::task::spawn_blocking(find).await;
                found.unwrap_or_else(|panicked| std::panic::resume_unwind(panicked.into_panic()))
            }
        }?;
        self.memory.loaded = Some((Arc::new(work), digest(&[plan.identity()])));
        Ok(())
    }

    async fn read_ahead(&mut self, job: Job, _: &Interrupt) -> Option<PreliminaryPoints> {
        let shared = locked(&self.shared);
        let ours = shared.job.is_some_and(|(own, _)| own == job);
        let from = self.memory.reported_points;
        let ready = shared.points.iter().skip(from).map_while(|point| *point);
        let points: Vec<MeasuredPoint> = if ours { ready.collect() } else { Vec::new() };
        drop(shared);
        self.memory.reported_points += points.len();
        let there = !points.is_empty();
        there.then_some(PreliminaryPoints { job, first_index: from, points, coordinates: Coordinates::Centres })
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> DeviceResult<Measurement> {
        let shared = locked(&self.shared);
        let complete = shared.state == MachineState::Complete && shared.outcome == Outcome::Complete;
        let own = shared.job.filter(|(own, _)| *own == job && complete);
        let points: Option<Vec<MeasuredPoint>> = shared.points.iter().copied().collect();
        match (own, points, &self.work) {
            (Some((_, done)), Some(points), Some((_, plan_identity))) => Ok(Measurement {
                points,
                coordinates: Coordinates::Centres,
                probe_radius_mm: shared.radius_mm,
                temperature_c: None,
                duration_s: Some(shared.measuring_time.as_secs_f64()),
                plan_identity: *plan_identity,
                job: job.job,
                cycle: job.cycle,
                done,
            }),
            _ => Err(DeviceError::NoResult { machine: Arc::clone(&self.name), job, state: shared.state }),
        }
    }
}
