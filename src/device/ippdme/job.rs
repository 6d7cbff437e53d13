//! Execution of a measuring job by this program, because an I++ DME server stores no job. One task owns the session. It
//! checks for hold, stop and abort between two commands, and for abort also within a command.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::{Instant, sleep};

use super::link::{CommandReply, Failure, Session};
use super::response::{ServerError, values};
use super::route::{Leg, Route, approach, point_on_normal};
use super::settings::IppdmeSettings;
use super::syntax::Item;
use crate::error::DeviceError;
use crate::handshake::{Fault, Job, MachineCommand, MachineState, Outcome};
use crate::payload::{MeasuredPoint, Plan, PlanTarget, TouchStatus};

/// Server errors of a touch that do not end the job: the next touch can succeed. Unexpected contact, illegal touch, no
/// surface found.
pub(super) const MISS_ERRORS: [u16; 3] = [1001, 1003, 1006];
/// Number of unreachable targets at which the job fails, because the part is not at its planned position.
const MAX_UNREACHED: u32 = 3;
/// Error numbers of a server that lacks a method or a property.
const UNSUPPORTED_ERRORS: [u16; 6] = [501, 502, 505, 506, 509, 510];
/// Maximum durations of the motion of a tool change and of homing.
const TOOL_CHANGE_TIMEOUT: Duration = Duration::from_secs(180);
const HOMING_TIMEOUT: Duration = Duration::from_secs(300);

/// Plan of a job and its route.
#[derive(Debug)]
pub(super) struct RoutedPlan {
    pub(super) plan: Plan,
    pub(super) route: Route,
}

/// Order to the task that owns the session.
#[derive(Debug)]
pub(super) enum WorkerOrder {
    Run(Arc<RoutedPlan>),
    Clear(oneshot::Sender<Result<(), DeviceError>>),
    CheckAlive(oneshot::Sender<()>),
}

/// State that the task and the machine's driver share.
#[derive(Debug)]
pub(super) struct SharedState {
    pub(super) state: MachineState,
    pub(super) job: Option<(Job, u32)>,
    pub(super) outcome: Outcome,
    pub(super) fault: Fault,
    pub(super) clear_of_part: Option<bool>,
    /// Points measured so far, in the order of the plan; `None` for a target not measured yet.
    pub(super) points: Vec<Option<MeasuredPoint>>,
    pub(super) radius_mm: Option<f64>,
    pub(super) measuring_time: Duration,
    /// Time of the last status request.
    pub(super) last_status_request: Instant,
    /// Reason why the session is over.
    pub(super) session_error: Option<DeviceError>,
    /// Reason why the machine is stopped, and the messages of the server.
    pub(super) stop_reason: Option<String>,
    pub(super) notes: Vec<String>,
}

impl SharedState {
    pub(super) fn new() -> Self {
        Self {
            state: MachineState::Idle,
            job: None,
            outcome: Outcome::None,
            fault: Fault::None,
            clear_of_part: None,
            points: Vec::new(),
            radius_mm: None,
            measuring_time: Duration::ZERO,
            last_status_request: Instant::now(),
            session_error: None,
            stop_reason: None,
            notes: Vec::new(),
        }
    }

    /// Changes a transitional state to the state at rest that follows it: ABORTING to ABORTED, STOPPING to COMPLETE,
    /// EXECUTE and HOLDING to HELD. Call it after the server has finished its command, so that nothing moves.
    pub(super) fn come_to_rest(&mut self) {
        (self.state, self.outcome) = match self.state {
            MachineState::Aborting => (MachineState::Aborted, Outcome::Aborted),
            MachineState::Stopping => (MachineState::Complete, Outcome::Stopped),
            MachineState::Execute | MachineState::Holding => (MachineState::Held, Outcome::None),
            other => (other, self.outcome),
        };
    }
}

/// Locks the shared state and returns the guard of the lock. Ignores a poisoned lock (a lock whose holder panicked),
/// because the shared state stays valid after a panic.
pub(super) fn locked(shared: &Mutex<SharedState>) -> MutexGuard<'_, SharedState> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Task that owns a session.
pub(super) struct Worker {
    pub(super) session: Session,
    pub(super) shared: Arc<Mutex<SharedState>>,
    pub(super) orders: mpsc::Receiver<WorkerOrder>,
    pub(super) job_request: watch::Receiver<Option<MachineCommand>>,
    pub(super) settings: Arc<IppdmeSettings>,
    /// Position of the probe's centre, if it is known.
    pub(super) position_mm: Option<[f64; 3]>,
    /// Speeds in force, in mm/s: travel, touching, scanning; 0 if not set yet.
    pub(super) speeds_mm_s: [f64; 3],
}

impl Worker {
    /// Executes the orders of the driver, one after the other. While no order arrives, asks the server at regular
    /// intervals whether it still answers. Interrupts a running order if an abort is ordered. Returns when the
    /// connection fails or when the driver closes the channel of orders. In the second case, first ends the session at
    /// the server.
    pub(super) async fn serve_session(mut self) {
        loop {
            let done = tokio::select! {
                biased;
                () = self.session.abort_ordered() => Err(self.session.abort().await),
                order = self.orders.recv() => match order {
                    Some(order) => self.carry_out(order).await,
                    None => break,
                },
                () = sleep(self.settings.limits.alive) => self.session.ask("GetErrStatusE", Vec::new()).await.map(drop),
            };
            let lost = done.err().is_some_and(|failure| self.failed(failure));
            locked(&self.shared).notes = self.session.notes();
            if lost {
                return;
            }
        }
        // A server that does not receive this ends the session when the connection closes.
        let _ = self.session.ask("EndSession", Vec::new()).await;
    }

    async fn carry_out(&mut self, order: WorkerOrder) -> Result<(), Failure> {
        match order {
            // An abort came first, so the job does not begin.
            WorkerOrder::Run(_) if !locked(&self.shared).state.is_moving() || self.session.is_abort_ordered() => Ok(()),
            WorkerOrder::Run(work) => {
                let began = Instant::now();
                let ran = self.run(&work).await;
                locked(&self.shared).measuring_time += began.elapsed();
                ran
            }
            WorkerOrder::Clear(answer) => {
                let cleared = self.session.clear_errors(1).await;
                let told = match &cleared {
                    Ok(()) => Ok(()),
                    Err(failure) => Err(self.device_error(failure)),
                };
                // The requester may have dropped its receiver.
                let _ = answer.send(told);
                cleared
            }
            WorkerOrder::CheckAlive(answer) => {
                let looked = self.session.ask("GetErrStatusE", Vec::new()).await;
                let _ = answer.send(());
                looked.map(drop)
            }
        }
    }

    /// Stores `failure` in the shared state. After an abort, the state becomes ABORTED. After a refused command or an
    /// implausible answer, the state becomes FAULTED. After a failed connection, the state stays the same and the error
    /// is stored as the end of the session. Returns true if the connection failed, otherwise false.
    fn failed(&mut self, failure: Failure) -> bool {
        let reason = self.device_error(&failure);
        self.position_mm = None;
        let mut shared = locked(&self.shared);
        shared.clear_of_part = None;
        match failure {
            Failure::Aborted => {
                (shared.state, shared.outcome) = (MachineState::Aborted, Outcome::Aborted);
                return false;
            }
            Failure::Link(_) => {
                shared.session_error = Some(reason);
                return true;
            }
            Failure::Refused(error) => shared.fault = fault(error.number),
            Failure::Implausible(_) => shared.fault = Fault::Tool,
        }
        let of_job = shared.state.is_moving() || shared.state == MachineState::Held;
        shared.outcome = if of_job { Outcome::Failed } else { shared.outcome };
        (shared.state, shared.stop_reason) = (MachineState::Faulted, Some(reason.to_string()));
        false
    }

    fn device_error(&self, failure: &Failure) -> DeviceError {
        let machine = Arc::clone(&self.session.machine);
        match failure {
            Failure::Link(error) | Failure::Implausible(error) => error.clone(),
            Failure::Refused(error) => DeviceError::MethodRefused { machine, method: "the job", error: error.clone() },
            Failure::Aborted => DeviceError::Disconnected { machine, operation: "aborted" },
        }
    }

    // ---- a job ------------------------------------------------------------------------------------------------------------------------

    /// Measures all targets of the plan in `work` that have no point yet, in the order of the route. Before each target
    /// or scan, checks for a requested hold or stop; if there is one, ends the measurement early. Then raises the probe
    /// and sets the state COMPLETE or HELD.
    ///
    /// # Errors
    /// Returns a failure if an abort is ordered, if the connection fails, if the server refuses a command, if an answer
    /// is implausible, or if too many targets cannot be reached.
    async fn run(&mut self, work: &RoutedPlan) -> Result<(), Failure> {
        self.set_up(work).await?;
        let mut unreached = 0;
        'job: for leg in &work.route.legs {
            if let Leg::Scan(row) = leg
                && locked(&self.shared).points[row.clone()].iter().any(Option::is_none)
            {
                if self.current_request().is_some() {
                    break;
                }
                if self.scan(work, row.clone()).await? {
                    continue;
                }
            }
            for k in leg.targets() {
                if self.current_request().is_some() {
                    break 'job;
                }
                if locked(&self.shared).points[k].is_some() {
                    continue;
                }
                self.set_speeds(work, k).await?;
                let point = self.touch(work, &work.plan.targets[k]).await?;
                locked(&self.shared).points[k] = Some(point);
                unreached += u32::from(point.status == TouchStatus::NotReached);
                if unreached >= MAX_UNREACHED {
                    return self.fail_unreachable(work, unreached).await;
                }
            }
        }
        self.rise(work).await?;
        let wish = *self.job_request.borrow();
        let mut shared = locked(&self.shared);
        if shared.state == MachineState::Aborting {
            return Ok(()); // The abort is next.
        }
        shared.clear_of_part = Some(true);
        (shared.state, shared.outcome) = match wish {
            _ if shared.points.iter().all(Option::is_some) => (MachineState::Complete, Outcome::Complete),
            Some(MachineCommand::Stop) => (MachineState::Complete, Outcome::Stopped),
            // Held, or resumed at the last moment.
            _ => (MachineState::Held, Outcome::None),
        };
        Ok(())
    }

    /// Raises the probe to the clearance height and then returns a failure. The failure states that too many targets
    /// could not be reached; `unreached` is their number.
    ///
    /// # Errors
    /// Always returns a failure. If the upward motion fails, returns the failure of this motion instead.
    async fn fail_unreachable(&mut self, work: &RoutedPlan, unreached: u32) -> Result<(), Failure> {
        self.rise(work).await?;
        let text = format!("{unreached} targets could not be reached: check the position of the part");
        Err(Failure::Refused(ServerError { severity: 3, number: 2504, cause: String::new(), text }))
    }

    /// Returns the current request of the client for the job: HOLD, STOP, or `None` to continue. Returns HOLD and
    /// changes the state to HOLDING if the state is EXECUTE and the last status request is older than `silence_limit`:
    /// the client is then assumed to be lost.
    fn current_request(&self) -> Option<MachineCommand> {
        let mut shared = locked(&self.shared);
        if shared.state == MachineState::Execute && shared.last_status_request.elapsed() > self.settings.silence_limit {
            shared.state = MachineState::Holding;
            shared.stop_reason =
                Some("the machine holds, because Regrind sent no status request within the time limit".to_owned());
            return Some(MachineCommand::Hold);
        }
        *self.job_request.borrow()
    }

    /// Prepares the server for the job. Homes the machine if it is not homed, sets the coordinate system, raises the
    /// probe, and changes the tool. Checks the tool radius. Sets the approach, search and retract distances of the
    /// plan, and the values that the server reports for each touch. Sets all these values again for every job, because
    /// another client can have changed them.
    ///
    /// # Errors
    /// Returns a failure if the server refuses a step, if an answer is implausible, if an abort is ordered, or if the
    /// connection fails.
    async fn set_up(&mut self, work: &RoutedPlan) -> Result<(), Failure> {
        let homed = self.session.ask("IsHomed", Vec::new()).await?;
        if homed.value("IsHomed") != Some(1.0) {
            self.session.request_motion("Home", Vec::new(), HOMING_TIMEOUT).await?;
        }
        self.set_frame().await?;
        self.read_position().await?;
        self.rise(work).await?;
        let tool = vec![Item::Text(self.settings.tool.clone())];
        self.session.request_motion("ChangeTool", tool, TOOL_CHANGE_TIMEOUT).await?;
        self.read_position().await?;
        self.check_tool_radius(work).await?;
        self.speeds_mm_s = [0.0; 3];
        let Plan { approach_mm, search_mm, .. } = work.plan;
        self.set(&[
            ("PtMeasPar.Approach", approach_mm),
            ("PtMeasPar.Search", search_mm),
            ("PtMeasPar.Retract", approach_mm),
        ])
        .await?;
        if work.route.legs.iter().any(|leg| matches!(leg, Leg::Scan(_))) {
            self.set_up_scans(work).await?;
        }
        let report = |names: &[&str]| names.iter().map(|name| Item::property_query(name)).collect::<Vec<_>>();
        // Not every version of the standard has a quality and the radius of a touch.
        for names in [&["X", "Y", "Z", "IJK", "ER", "Q"][..], &["X", "Y", "Z", "IJK", "ER"], &["X", "Y", "Z"]] {
            if self.request_if_supported("OnPtMeasReport", report(names)).await?.is_some() {
                return Ok(());
            }
        }
        Err(Failure::Implausible(self.missing_value("OnPtMeasReport", "the coordinates of a touch")))
    }

    async fn set_frame(&mut self) -> Result<(), Failure> {
        let frame = match self.settings.part_frame {
            None => "MachineCsy",
            Some(numbers) => {
                let numbers = numbers.iter().map(|number| Item::Number(*number));
                let arguments = [Item::Name("PartCsy".to_owned())].into_iter().chain(numbers).collect();
                self.session.ask("SetCsyTransformation", arguments).await?;
                "PartCsy"
            }
        };
        self.session.ask("SetCoordSystem", vec![Item::Name(frame.to_owned())]).await?;
        let told = self.session.ask("GetCoordSystem", Vec::new()).await?;
        let told = told.line().and_then(|data| values(data, "CoordSystem"));
        match told.as_deref() {
            Some([Item::Name(name) | Item::Text(name)]) if name == frame => Ok(()),
            _ => Err(Failure::Implausible(self.missing_value("GetCoordSystem", "the frame in force"))),
        }
    }

    /// Compares the tool radius that the server reports with the probe radius of the plan. If the server cannot report
    /// a tool radius, adds a note for the operator and returns `Ok`.
    ///
    /// # Errors
    /// Returns a failure if the two radii differ by more than `probe_tolerance_mm`, if the reported value is missing,
    /// or if the request fails.
    async fn check_tool_radius(&mut self, work: &RoutedPlan) -> Result<(), Failure> {
        let told = self.request_if_supported("GetProp", vec![Item::property_query("Tool.AvrRadius")]).await?;
        let Some(told) = told else {
            self.session
                .note("the machine does not report the radius of the tool; Regrind checks the radius that the machine reports for each touch".to_owned());
            return Ok(());
        };
        let missing = || self.missing_value("GetProp", "Tool.AvrRadius");
        let told_mm = told.value("Tool.AvrRadius").ok_or_else(|| Failure::Implausible(missing()))?;
        self.compare_radius(told_mm, work)?;
        locked(&self.shared).radius_mm = Some(told_mm);
        Ok(())
    }

    pub(super) fn compare_radius(&self, told_mm: f64, work: &RoutedPlan) -> Result<(), Failure> {
        let (plan_mm, limit_mm) = (work.plan.probe_radius_mm, self.settings.probe_tolerance_mm);
        if (told_mm - plan_mm).abs() <= limit_mm {
            return Ok(());
        }
        let (machine, tool) = (Arc::clone(&self.session.machine), self.settings.tool.clone());
        Err(Failure::Implausible(DeviceError::ProbeRadius { machine, tool, reported_mm: told_mm, plan_mm, limit_mm }))
    }

    /// Sets parameters of the tool at the server, then reads the values back. `parameters` contains names without the
    /// prefix `Tool.`, each with its requested value. Returns the values that the server now uses, in the same order.
    /// If the server uses a lower speed than requested, accepts this speed and adds a note for the operator.
    ///
    /// # Errors
    /// Returns a failure if any other value differs from the request, if a value is missing in the answer, if the
    /// server refuses the parameters, if an abort is ordered, or if the connection fails.
    pub(super) async fn set(&mut self, parameters: &[(&str, f64)]) -> Result<Vec<f64>, Failure> {
        let named = |name: &str| format!("Tool.{name}");
        let wanted = parameters.iter().map(|(name, value)| Item::property(&named(name), *value)).collect();
        self.session.ask("SetProp", wanted).await?;
        let asked = parameters.iter().map(|(name, _)| Item::property_query(&named(name))).collect();
        let told = self.session.ask("GetProp", asked).await?;
        let mut in_force = Vec::new();
        for (name, wanted) in parameters {
            let property = named(name);
            let value = told
                .value(&property)
                .ok_or_else(|| Failure::Implausible(self.missing_value("GetProp", "the values that were set")))?;
            // A lower speed only costs time. Any other difference changes the measurement.
            let slower = name.ends_with("Speed") && value > 0.0 && value < *wanted;
            if slower {
                let note = format!("the machine limits {property} to {value} mm/s; {wanted} mm/s was requested");
                self.session.note(note);
            } else if (value - wanted).abs() > 1e-4 * wanted.abs() + 1e-6 {
                let machine = Arc::clone(&self.session.machine);
                return Err(Failure::Implausible(DeviceError::NotSet {
                    machine,
                    property,
                    requested: *wanted,
                    in_force: value,
                }));
            }
            in_force.push(value);
        }
        Ok(in_force)
    }

    /// Sets the travel speed and the touch speed for the target with index `k` in the plan. Sends nothing if the server
    /// already uses these speeds. The plan can have a careful start: its first targets are then approached and touched
    /// at a lower speed.
    ///
    /// # Errors
    /// Returns a failure if the server refuses the speeds or uses a higher speed than requested, if an abort is
    /// ordered, or if the connection fails.
    pub(super) async fn set_speeds(&mut self, work: &RoutedPlan, k: usize) -> Result<(), Failure> {
        let careful = work.plan.careful_start.filter(|careful| k < careful.target_count as usize);
        let touching = careful.map_or(work.plan.speed_mm_s, |careful| careful.speed_mm_s);
        let travel = careful.map_or(self.settings.travel_speed_mm_s, |careful| careful.speed_mm_s);
        if self.speeds_mm_s[..2] == [travel, touching] {
            return Ok(());
        }
        self.set(&[("GoToPar.Speed", travel), ("PtMeasPar.Speed", touching)]).await?;
        self.speeds_mm_s = [travel, touching, self.speeds_mm_s[2]];
        Ok(())
    }

    // ---- motion -----------------------------------------------------------------------------------------------------------------------

    /// Touches `target` and returns the measured point. If the probe finds no surface or meets an obstacle, repeats the
    /// touch up to `retries` times. If all attempts miss, returns a point with the status `NotFound` or `NotReached`.
    ///
    /// # Errors
    /// Returns a failure if the server reports another error, if the answer is implausible, if an abort is ordered, or
    /// if the connection fails.
    async fn touch(&mut self, work: &RoutedPlan, target: &PlanTarget) -> Result<MeasuredPoint, Failure> {
        let mut missed = TouchStatus::NotFound;
        for _ in 0..=self.settings.retries {
            self.move_above(work, target).await?;
            let [x, y, z] = target.point_mm;
            let [i, j, k] = target.normal.map(Item::Number);
            let normal = Item::Call("IJK".to_owned(), vec![i, j, k]);
            let arguments = vec![Item::property("X", x), Item::property("Y", y), Item::property("Z", z), normal];
            let depth_mm = 2.0 * (work.plan.approach_mm + work.plan.search_mm);
            let motion = self.motion_time(depth_mm, 1);
            match self.session.request_motion("PtMeas", arguments, motion).await {
                Ok(answer) => match missed_by(&answer) {
                    None => return self.point(work, target, &answer),
                    Some(number) => missed = status_of(number),
                },
                Err(Failure::Refused(error)) if MISS_ERRORS.contains(&error.number) && error.severity <= 2 => {
                    missed = status_of(error.number);
                    self.session.note(format!("target {}: {error}", target.index));
                    self.session.clear_errors(1).await?;
                }
                Err(other) => return Err(other),
            }
            self.read_position().await?;
            self.rise(work).await?;
        }
        Ok(MeasuredPoint { index: target.index, status: missed, quality: 100, position_mm: [0.0; 3] })
    }

    /// Converts `answer`, the reply of the server to a touch of `target`, to the measured point. Uses the three
    /// coordinates of the probe's centre, and the quality if the server reports it. Stores the approach point of the
    /// target as the present position of the probe.
    ///
    /// # Errors
    /// Returns a failure if a coordinate is missing, if the reported tool radius is not that of the plan, or if the
    /// point is too far from its target.
    fn point(
        &mut self,
        work: &RoutedPlan,
        target: &PlanTarget,
        answer: &CommandReply,
    ) -> Result<MeasuredPoint, Failure> {
        let missing = || Failure::Implausible(self.missing_value("PtMeas", "X, Y and Z, each once"));
        let mut at_mm = [0.0; 3];
        for (at, name) in at_mm.iter_mut().zip(["X", "Y", "Z"]) {
            *at = answer.value(name).ok_or_else(missing)?;
        }
        if let Some(radius_mm) = answer.value("ER") {
            self.compare_radius(radius_mm, work)?;
        }
        self.check_touch_position(work, target, at_mm)?;
        let quality = answer.value("Q").map_or(0, |quality| quality.clamp(0.0, 100.0) as u16);
        self.position_mm = Some(approach(target, &work.plan));
        Ok(MeasuredPoint { index: target.index, status: TouchStatus::Touched, quality, position_mm: at_mm })
    }

    /// Checks the distance between `at_mm` and the expected position of the probe's centre at `target`, in mm. The
    /// distance must not exceed the sum of the approach distance, the search distance and `probe_tolerance_mm`.
    ///
    /// # Errors
    /// Returns a failure if the distance is larger.
    pub(super) fn check_touch_position(
        &self,
        work: &RoutedPlan,
        target: &PlanTarget,
        at_mm: [f64; 3],
    ) -> Result<(), Failure> {
        let plan = &work.plan;
        let off_mm = distance(point_on_normal(target, plan.probe_radius_mm), at_mm);
        let most = plan.approach_mm + plan.search_mm + self.settings.probe_tolerance_mm;
        if off_mm <= most {
            return Ok(());
        }
        let field = format!("the distance of the touch from the target {}", target.index);
        let (machine, unit) = (Arc::clone(&self.session.machine), "mm".to_owned());
        Err(Failure::Implausible(DeviceError::OutOfRange { machine, field, value: off_mm, min: 0.0, max: most, unit }))
    }

    /// Moves the probe to the approach point of `target`. This point lies on the normal of the target; the touch begins
    /// there. The probe moves in three steps: up to the clearance height, horizontally until it is above the approach
    /// point, and down to the approach point.
    ///
    /// # Errors
    /// Returns a failure if the server refuses a motion, if an abort is ordered, or if the connection fails.
    pub(super) async fn move_above(&mut self, work: &RoutedPlan, target: &PlanTarget) -> Result<(), Failure> {
        self.rise(work).await?;
        let [x, y, z] = approach(target, &work.plan);
        self.go_to([x, y, work.route.clearance_mm]).await?;
        self.go_to([x, y, z]).await
    }

    /// Moves the probe straight up to the clearance height of the route. Does nothing if the probe is already at this
    /// height or higher, or if the position of the probe is unknown.
    ///
    /// # Errors
    /// Returns a failure if the server refuses the motion, if an abort is ordered, or if the connection fails.
    pub(super) async fn rise(&mut self, work: &RoutedPlan) -> Result<(), Failure> {
        let Some([x, y, z]) = self.position_mm else { return Ok(()) };
        let clearance_mm = work.route.clearance_mm;
        if z >= clearance_mm {
            return Ok(());
        }
        locked(&self.shared).clear_of_part = Some(false);
        self.go_to([x, y, clearance_mm]).await
    }

    async fn go_to(&mut self, to_mm: [f64; 3]) -> Result<(), Failure> {
        let way_mm = self.position_mm.map_or(self.settings.diagonal_mm(), |at| distance(at, to_mm));
        let arguments = ["X", "Y", "Z"].iter().zip(to_mm).map(|(axis, mm)| Item::property(axis, mm)).collect();
        let motion = self.motion_time(way_mm, 0);
        self.session.request_motion("GoTo", arguments, motion).await?;
        self.position_mm = Some(to_mm);
        Ok(())
    }

    /// Returns the time limit for a motion of length `way_mm`, in mm: twice the length divided by the speed. The factor
    /// 2 allows for acceleration and deceleration. `speed` is an index into `speeds_mm_s`: 0 for travel, 1 for
    /// touching, 2 for scanning. Assumes 1 mm/s if this speed is not set yet, because the default speed of the machine
    /// is unknown and can be low.
    pub(super) fn motion_time(&self, way_mm: f64, speed: usize) -> Duration {
        const MIN_SPEED_MM_S: f64 = 1.0;
        let speed = self.speeds_mm_s[speed];
        let speed = if speed > 0.0 { speed } else { MIN_SPEED_MM_S };
        // Factor 2: half of the time may go into acceleration and deceleration.
        Duration::try_from_secs_f64(2.0 * way_mm / speed).unwrap_or(Duration::from_secs(3600))
    }

    pub(super) async fn read_position(&mut self) -> Result<(), Failure> {
        let told = self.session.ask("Get", ["X", "Y", "Z"].map(Item::property_query).to_vec()).await?;
        let at = ["X", "Y", "Z"].map(|axis| told.value(axis));
        let [Some(x), Some(y), Some(z)] = at else {
            return Err(Failure::Implausible(self.missing_value("Get", "the position of the probe")));
        };
        self.position_mm = Some([x, y, z]);
        Ok(())
    }

    /// Sends the command `name` with `arguments` to the server and returns the reply. Not every server supports this
    /// command. If the server refuses it as unknown or not supported, adds a note for the operator, clears the errors
    /// of the server and returns `None`.
    ///
    /// # Errors
    /// Returns a failure if the server refuses the command for another reason, if an abort is ordered, or if the
    /// connection fails.
    pub(super) async fn request_if_supported(
        &mut self,
        name: &str,
        arguments: Vec<Item>,
    ) -> Result<Option<CommandReply>, Failure> {
        request_if_supported(&mut self.session, name, arguments).await
    }

    pub(super) fn missing_value(&self, method: &'static str, missing: &'static str) -> DeviceError {
        DeviceError::ValueMissing { machine: Arc::clone(&self.session.machine), method, missing }
    }
}

/// Sends the command `name` with `arguments` on `session` and returns the reply. Not every server supports this
/// command. If the server refuses it as unknown or not supported, adds a note for the operator, clears the errors of
/// the server and returns `None`.
///
/// # Errors
/// Returns a failure if the server refuses the command for another reason, if an abort is ordered, or if the connection
/// fails.
pub(super) async fn request_if_supported(
    session: &mut Session,
    name: &str,
    arguments: Vec<Item>,
) -> Result<Option<CommandReply>, Failure> {
    match session.ask(name, arguments).await {
        Ok(answer) => Ok(Some(answer)),
        Err(Failure::Refused(error)) if UNSUPPORTED_ERRORS.contains(&error.number) => {
            session.note(format!("the server does not support this {name} request: {error}"));
            session.clear_errors(1).await?;
            Ok(None)
        }
        Err(other) => Err(other),
    }
}

/// Returns the error number of a missed touch, if `answer` reports the miss only as a warning. Some servers do this. A
/// touch is missed if the probe finds no surface or meets an obstacle. Returns `None` if `answer` contains data or has
/// no such warning.
fn missed_by(answer: &CommandReply) -> Option<u16> {
    let numbers = answer.warnings.iter().map(|warning| warning.number);
    numbers.into_iter().find(|number| MISS_ERRORS.contains(number)).filter(|_| answer.data.is_empty())
}

fn status_of(number: u16) -> TouchStatus {
    if number == 1001 { TouchStatus::NotReached } else { TouchStatus::NotFound }
}

pub(super) fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt()
}

/// Converts `number`, an error number of the I++ DME standard, to a machine fault. Returns [`Fault::Other`] with the
/// number if no special fault belongs to it.
fn fault(number: u16) -> Fault {
    match number {
        500 => Fault::StopCircuit,
        1001 | 2001 | 2504 => Fault::Collision,
        1009 => Fault::Supplies,
        1008 | 2500 => Fault::TravelLimit,
        503 | 1002 | 2501..=2503 => Fault::Drive,
        1500..=1503 | 2000 | 2002 => Fault::Tool,
        other => Fault::Other(other),
    }
}
