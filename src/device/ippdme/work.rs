//! A job, carried out: this program is what other machines have within. One task owns the session; hold, stop and abort are seen between
//! two commands, and an abort within one.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::{Instant, sleep};

use super::response::{ServerError, values};
use super::route::{Leg, Route, along, approach};
use super::session::{Answer, Failure, Session};
use super::settings::IppdmeSettings;
use super::text::Item;
use crate::error::DeviceError;
use crate::payload::{MeasuredPoint, Plan, PointStatus, Target};
use crate::words::{Fault, Job, Outcome, State};

/// Errors of a touch after which the next may be well: no touch, an illegal one, no surface.
pub(super) const MISSES: [u16; 3] = [1001, 1003, 1006];
/// So many targets that cannot be reached mean that the part lies elsewhere.
const UNREACHED_MOST: u32 = 3;
/// What a server that lacks a method or a property answers.
const LACKING: [u16; 6] = [501, 502, 505, 506, 509, 510];
/// The farthest that a tool changer and a reference point are away, in time.
const CHANGE: Duration = Duration::from_secs(180);
const HOMING: Duration = Duration::from_secs(300);

/// What a job is about.
#[derive(Debug)]
pub(super) struct Work {
    pub(super) plan: Plan,
    pub(super) route: Route,
}

/// What is to become of the job at the next safe place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Wish {
    GoOn,
    Hold,
    Stop,
}

/// What the task is told to do.
#[derive(Debug)]
pub(super) enum Order {
    Run(Arc<Work>),
    Clear(oneshot::Sender<Result<(), DeviceError>>),
    Look(oneshot::Sender<()>),
}

/// What the task and the machine's driver share.
#[derive(Debug)]
pub(super) struct Shared {
    pub(super) state: State,
    pub(super) job: Option<(Job, u32)>,
    pub(super) outcome: Outcome,
    pub(super) fault: Fault,
    pub(super) clear: Option<bool>,
    /// The points that there are, in the order of the plan.
    pub(super) points: Vec<Option<MeasuredPoint>>,
    pub(super) radius_mm: Option<f64>,
    pub(super) worked: Duration,
    /// When somebody looked at it last.
    pub(super) looked_at: Instant,
    /// Why the session is over.
    pub(super) lost: Option<DeviceError>,
    /// Why the machine stands, and what the server had to say.
    pub(super) why: Option<String>,
    pub(super) notes: Vec<String>,
}

impl Shared {
    pub(super) fn new() -> Self {
        Self {
            state: State::Idle,
            job: None,
            outcome: Outcome::None,
            fault: Fault::None,
            clear: None,
            points: Vec::new(),
            radius_mm: None,
            worked: Duration::ZERO,
            looked_at: Instant::now(),
            lost: None,
            why: None,
            notes: Vec::new(),
        }
    }

    /// The server has carried out what it was at: nothing moves.
    pub(super) fn stands(&mut self) {
        (self.state, self.outcome) = match self.state {
            State::Aborting => (State::Aborted, Outcome::Aborted),
            State::Stopping => (State::Complete, Outcome::Stopped),
            State::Execute | State::Holding => (State::Held, Outcome::None),
            other => (other, self.outcome),
        };
    }
}

/// A panic elsewhere leaves what still holds.
pub(super) fn locked(shared: &Mutex<Shared>) -> MutexGuard<'_, Shared> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The task that owns a session.
pub(super) struct Worker {
    pub(super) session: Session,
    pub(super) shared: Arc<Mutex<Shared>>,
    pub(super) orders: mpsc::Receiver<Order>,
    pub(super) wish: watch::Receiver<Wish>,
    pub(super) settings: Arc<IppdmeSettings>,
    /// Where the probe's centre is, as far as that is known.
    pub(super) at_mm: Option<[f64; 3]>,
    /// Speeds in force: of travel, of touching and of scanning.
    pub(super) speeds_mm_s: [f64; 3],
}

impl Worker {
    /// Attends to the session until it is lost or nobody is left to give orders; then ends it.
    pub(super) async fn attend(mut self) {
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
        // A server that does not hear it ends the session with the connection.
        let _ = self.session.ask("EndSession", Vec::new()).await;
    }

    async fn carry_out(&mut self, order: Order) -> Result<(), Failure> {
        match order {
            // One that an abort has overtaken is not begun.
            Order::Run(_) if !locked(&self.shared).state.moves() || self.session.is_abort_ordered() => Ok(()),
            Order::Run(work) => {
                let began = Instant::now();
                let ran = self.run(&work).await;
                locked(&self.shared).worked += began.elapsed();
                ran
            }
            Order::Clear(answer) => {
                let cleared = self.session.clear_errors(1).await;
                let told = match &cleared {
                    Ok(()) => Ok(()),
                    Err(failure) => Err(self.in_words(failure)),
                };
                // Who asked may have gone.
                let _ = answer.send(told);
                cleared
            }
            Order::Look(answer) => {
                let looked = self.session.ask("GetErrStatusE", Vec::new()).await;
                let _ = answer.send(());
                looked.map(drop)
            }
        }
    }

    /// Takes in that something went wrong, and says whether the session is lost by it.
    fn failed(&mut self, failure: Failure) -> bool {
        let why = self.in_words(&failure);
        self.at_mm = None;
        let mut shared = locked(&self.shared);
        shared.clear = None;
        match failure {
            Failure::Aborted => {
                (shared.state, shared.outcome) = (State::Aborted, Outcome::Aborted);
                return false;
            }
            Failure::Link(_) => {
                shared.lost = Some(why);
                return true;
            }
            Failure::No(error) => shared.fault = fault(error.number),
            Failure::Wrong(_) => shared.fault = Fault::Tool,
        }
        let of_job = shared.state.moves() || shared.state == State::Held;
        shared.outcome = if of_job { Outcome::Failed } else { shared.outcome };
        (shared.state, shared.why) = (State::Faulted, Some(why.to_string()));
        false
    }

    fn in_words(&self, failure: &Failure) -> DeviceError {
        let machine = Arc::clone(&self.session.machine);
        match failure {
            Failure::Link(error) | Failure::Wrong(error) => error.clone(),
            Failure::No(error) => DeviceError::MethodRefused { machine, method: "the job", error: error.clone() },
            Failure::Aborted => DeviceError::Disconnected { machine, what: "aborted" },
        }
    }

    // ---- a job ------------------------------------------------------------------------------------------------------------------------

    /// Touches what is left of the plan.
    async fn run(&mut self, work: &Work) -> Result<(), Failure> {
        self.set_up(work).await?;
        let mut unreached = 0;
        'job: for leg in &work.route.legs {
            if let Leg::Scan(row) = leg
                && locked(&self.shared).points[row.clone()].iter().any(Option::is_none)
            {
                if self.wished() != Wish::GoOn {
                    break;
                }
                if self.scan(work, row.clone()).await? {
                    continue;
                }
            }
            for k in leg.targets() {
                if self.wished() != Wish::GoOn {
                    break 'job;
                }
                if locked(&self.shared).points[k].is_some() {
                    continue;
                }
                self.keep_speeds(work, k).await?;
                let point = self.touch(work, &work.plan.targets[k]).await?;
                locked(&self.shared).points[k] = Some(point);
                unreached += u32::from(point.status == PointStatus::NotReached);
                if unreached >= UNREACHED_MOST {
                    return self.lies_elsewhere(work, unreached).await;
                }
            }
        }
        self.rise(work).await?;
        let wish = *self.wish.borrow();
        let mut shared = locked(&self.shared);
        if shared.state == State::Aborting {
            return Ok(()); // The abort is next.
        }
        shared.clear = Some(true);
        (shared.state, shared.outcome) = match wish {
            _ if shared.points.iter().all(Option::is_some) => (State::Complete, Outcome::Complete),
            Wish::Stop => (State::Complete, Outcome::Stopped),
            // Held, or told to go on again at the last moment.
            Wish::Hold | Wish::GoOn => (State::Held, Outcome::None),
        };
        Ok(())
    }

    /// Gives a job up whose targets are not where the plan has them.
    async fn lies_elsewhere(&mut self, work: &Work, unreached: u32) -> Result<(), Failure> {
        self.rise(work).await?;
        let text = format!("{unreached} targets could not be reached: see how the part lies");
        Err(Failure::No(ServerError { severity: 3, number: 2504, cause: String::new(), text }))
    }

    /// What is to become of the job. Where nobody has looked for long it holds by itself, as a machine does that misses its client.
    fn wished(&self) -> Wish {
        let mut shared = locked(&self.shared);
        if shared.state == State::Execute && shared.looked_at.elapsed() > self.settings.silence_limit {
            shared.state = State::Holding;
            shared.why = Some("nobody looked at it for too long, and it held by itself".to_owned());
            return Wish::Hold;
        }
        *self.wish.borrow()
    }

    /// Sees to it that everything is as the plan needs it, whoever was at the machine before.
    async fn set_up(&mut self, work: &Work) -> Result<(), Failure> {
        let homed = self.session.ask("IsHomed", Vec::new()).await?;
        if homed.value("IsHomed") != Some(1.0) {
            self.session.move_by("Home", Vec::new(), HOMING).await?;
        }
        self.set_frame().await?;
        self.find_place().await?;
        self.rise(work).await?;
        let tool = vec![Item::Text(self.settings.tool.clone())];
        self.session.move_by("ChangeTool", tool, CHANGE).await?;
        self.find_place().await?;
        self.check_radius(work).await?;
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
        let report = |names: &[&str]| names.iter().map(|name| Item::asked(name)).collect::<Vec<_>>();
        // A quality, and the radius of a touch, are not in every version.
        for names in [&["X", "Y", "Z", "IJK", "ER", "Q"][..], &["X", "Y", "Z", "IJK", "ER"], &["X", "Y", "Z"]] {
            if self.ask_if_there("OnPtMeasReport", report(names)).await?.is_some() {
                return Ok(());
            }
        }
        Err(Failure::Wrong(self.untold("OnPtMeasReport", "the coordinates of a touch")))
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
            _ => Err(Failure::Wrong(self.untold("GetCoordSystem", "the frame that was set"))),
        }
    }

    /// Holds the radius of the tool against that of the plan.
    async fn check_radius(&mut self, work: &Work) -> Result<(), Failure> {
        let told = self.ask_if_there("GetProp", vec![Item::asked("Tool.AvrRadius")]).await?;
        let Some(told) = told else {
            self.session.note("it does not tell the radius of its tool; that of each touch is looked at".to_owned());
            return Ok(());
        };
        let missing = || self.untold("GetProp", "Tool.AvrRadius");
        let told_mm = told.value("Tool.AvrRadius").ok_or_else(|| Failure::Wrong(missing()))?;
        self.hold_radius(told_mm, work)?;
        locked(&self.shared).radius_mm = Some(told_mm);
        Ok(())
    }

    pub(super) fn hold_radius(&self, told_mm: f64, work: &Work) -> Result<(), Failure> {
        let (plan_mm, limit_mm) = (work.plan.probe_radius_mm, self.settings.probe_tolerance_mm);
        if (told_mm - plan_mm).abs() <= limit_mm {
            return Ok(());
        }
        let (machine, tool) = (Arc::clone(&self.session.machine), self.settings.tool.clone());
        Err(Failure::Wrong(DeviceError::ProbeRadius { machine, tool, told_mm, plan_mm, limit_mm }))
    }

    /// Sets parameters of the tool, and takes what is in force from the machine: it may keep them within its own limits.
    pub(super) async fn set(&mut self, parameters: &[(&str, f64)]) -> Result<Vec<f64>, Failure> {
        let named = |name: &str| format!("Tool.{name}");
        let wanted = parameters.iter().map(|(name, value)| Item::with(&named(name), *value)).collect();
        self.session.ask("SetProp", wanted).await?;
        let asked = parameters.iter().map(|(name, _)| Item::asked(&named(name))).collect();
        let told = self.session.ask("GetProp", asked).await?;
        let mut in_force = Vec::new();
        for (name, wanted) in parameters {
            let property = named(name);
            let value = told.value(&property).ok_or_else(|| Failure::Wrong(self.untold("GetProp", "what was set")))?;
            // Slower than asked for costs time; anything else is another measurement.
            let slower = name.ends_with("Speed") && value > 0.0 && value < *wanted;
            if slower {
                self.session.note(format!("{property} is {value}, and not {wanted} as was asked"));
            } else if (value - wanted).abs() > 1e-4 * wanted.abs() + 1e-6 {
                let machine = Arc::clone(&self.session.machine);
                return Err(Failure::Wrong(DeviceError::NotSet { machine, property, wanted: *wanted, told: value }));
            }
            in_force.push(value);
        }
        Ok(in_force)
    }

    /// Sets the speeds where they change: the first targets of a careful plan are touched slowly.
    pub(super) async fn keep_speeds(&mut self, work: &Work, k: usize) -> Result<(), Failure> {
        let careful = work.plan.careful.filter(|careful| k < careful.targets as usize);
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

    /// Touches one target, again where it was missed.
    async fn touch(&mut self, work: &Work, target: &Target) -> Result<MeasuredPoint, Failure> {
        let mut missed = PointStatus::NotFound;
        for _ in 0..=self.settings.retries {
            self.go_over(work, target).await?;
            let [x, y, z] = target.point_mm;
            let [i, j, k] = target.normal.map(Item::Number);
            let normal = Item::Call("IJK".to_owned(), vec![i, j, k]);
            let arguments = vec![Item::with("X", x), Item::with("Y", y), Item::with("Z", z), normal];
            let depth_mm = 2.0 * (work.plan.approach_mm + work.plan.search_mm);
            let motion = self.lasts(depth_mm, 1);
            match self.session.move_by("PtMeas", arguments, motion).await {
                Ok(answer) => match missed_by(&answer) {
                    None => return self.point(work, target, &answer),
                    Some(number) => missed = status_of(number),
                },
                Err(Failure::No(error)) if MISSES.contains(&error.number) && error.severity <= 2 => {
                    missed = status_of(error.number);
                    self.session.note(format!("target {}: {error}", target.index));
                    self.session.clear_errors(1).await?;
                }
                Err(other) => return Err(other),
            }
            self.find_place().await?;
            self.rise(work).await?;
        }
        Ok(MeasuredPoint { index: target.index, status: missed, quality: 100, at_mm: [0.0; 3] })
    }

    /// Takes the answer to a touch as a point, if it can be one of this target.
    fn point(&mut self, work: &Work, target: &Target, answer: &Answer) -> Result<MeasuredPoint, Failure> {
        let missing = || Failure::Wrong(self.untold("PtMeas", "X, Y and Z, each once"));
        let mut at_mm = [0.0; 3];
        for (at, name) in at_mm.iter_mut().zip(["X", "Y", "Z"]) {
            *at = answer.value(name).ok_or_else(missing)?;
        }
        if let Some(radius_mm) = answer.value("ER") {
            self.hold_radius(radius_mm, work)?;
        }
        self.hold_place(work, target, at_mm)?;
        let quality = answer.value("Q").map_or(0, |quality| quality.clamp(0.0, 100.0) as u16);
        self.at_mm = Some(approach(target, &work.plan));
        Ok(MeasuredPoint { index: target.index, status: PointStatus::Touched, quality, at_mm })
    }

    /// Holds where a point lies against where the probe was sent.
    pub(super) fn hold_place(&self, work: &Work, target: &Target, at_mm: [f64; 3]) -> Result<(), Failure> {
        let plan = &work.plan;
        let off_mm = distance(along(target, plan.probe_radius_mm), at_mm);
        let most = plan.approach_mm + plan.search_mm + self.settings.probe_tolerance_mm;
        if off_mm <= most {
            return Ok(());
        }
        let field = format!("the distance of the touch of target {} from where it was sent", target.index);
        let (machine, unit) = (Arc::clone(&self.session.machine), "mm".to_owned());
        Err(Failure::Wrong(DeviceError::OutOfRange { machine, field, value: off_mm, least: 0.0, most, unit }))
    }

    /// Travels over a target at the height of the clearance, and down to where the probe turns into the normal.
    pub(super) async fn go_over(&mut self, work: &Work, target: &Target) -> Result<(), Failure> {
        self.rise(work).await?;
        let [x, y, z] = approach(target, &work.plan);
        self.go_to([x, y, work.route.clearance_mm]).await?;
        self.go_to([x, y, z]).await
    }

    /// Goes straight up to the height of the clearance, if it is not there.
    pub(super) async fn rise(&mut self, work: &Work) -> Result<(), Failure> {
        let Some([x, y, z]) = self.at_mm else { return Ok(()) };
        let clearance_mm = work.route.clearance_mm;
        if z >= clearance_mm {
            return Ok(());
        }
        locked(&self.shared).clear = Some(false);
        self.go_to([x, y, clearance_mm]).await
    }

    async fn go_to(&mut self, to_mm: [f64; 3]) -> Result<(), Failure> {
        let way_mm = self.at_mm.map_or(self.settings.diagonal_mm(), |at| distance(at, to_mm));
        let arguments = ["X", "Y", "Z"].iter().zip(to_mm).map(|(axis, mm)| Item::with(axis, mm)).collect();
        let motion = self.lasts(way_mm, 0);
        self.session.move_by("GoTo", arguments, motion).await?;
        self.at_mm = Some(to_mm);
        Ok(())
    }

    /// How long a way lasts at most, by a speed in force; one that was not set yet is the machine's own and may be slow.
    pub(super) fn lasts(&self, way_mm: f64, speed: usize) -> Duration {
        const SLOWEST_MM_S: f64 = 1.0;
        let speed = self.speeds_mm_s[speed];
        let speed = if speed > 0.0 { speed } else { SLOWEST_MM_S };
        // Half of the way may be spent on getting to speed and down from it.
        Duration::try_from_secs_f64(2.0 * way_mm / speed).unwrap_or(Duration::from_secs(3600))
    }

    pub(super) async fn find_place(&mut self) -> Result<(), Failure> {
        let told = self.session.ask("Get", ["X", "Y", "Z"].map(Item::asked).to_vec()).await?;
        let at = ["X", "Y", "Z"].map(|axis| told.value(axis));
        let [Some(x), Some(y), Some(z)] = at else {
            return Err(Failure::Wrong(self.untold("Get", "where the probe is")));
        };
        self.at_mm = Some([x, y, z]);
        Ok(())
    }

    /// Asks for what not every server has; none where this one has it not.
    pub(super) async fn ask_if_there(&mut self, name: &str, arguments: Vec<Item>) -> Result<Option<Answer>, Failure> {
        ask_if_there(&mut self.session, name, arguments).await
    }

    pub(super) fn untold(&self, method: &'static str, missing: &'static str) -> DeviceError {
        DeviceError::Untold { machine: Arc::clone(&self.session.machine), method, missing }
    }
}

/// Asks for what not every server has; none where this one has it not.
pub(super) async fn ask_if_there(
    session: &mut Session,
    name: &str,
    arguments: Vec<Item>,
) -> Result<Option<Answer>, Failure> {
    match session.ask(name, arguments).await {
        Ok(answer) => Ok(Some(answer)),
        Err(Failure::No(error)) if LACKING.contains(&error.number) => {
            session.note(format!("it has no {name} as it was asked: {error}"));
            session.clear_errors(1).await?;
            Ok(None)
        }
        Err(other) => Err(other),
    }
}

/// The miss that a server only warned of.
fn missed_by(answer: &Answer) -> Option<u16> {
    let numbers = answer.warnings.iter().map(|warning| warning.number);
    numbers.into_iter().find(|number| MISSES.contains(number)).filter(|_| answer.data.is_empty())
}

fn status_of(number: u16) -> PointStatus {
    if number == 1001 { PointStatus::NotReached } else { PointStatus::NotFound }
}

pub(super) fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt()
}

/// What an error is at a machine, whatever its severity and its words.
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
