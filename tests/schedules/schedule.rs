//! One schedule: everything that happens in it follows from its seed.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use regrind::cell::Ending;
use regrind::device::{Link, Machine as _, ModbusCmm, ModbusGrinder, ModbusSettings};
use regrind::drive::{Beside, Blocking, Drive, Interrupted, Orders, Request, Run};
use regrind::journal::{AuditKey, Header, Journal, Kind, Reader, RunLock, free_bytes, verify};
use regrind::setup;
use regrind_sim::command::{Frame, Mode};
use regrind_sim::options::Layout;
use regrind_sim::wire::SharedMachine;
use regrind_sim::wire::faults::{Fault, FaultPlan, Faults};
use regrind_sim::words::WordOrder;
use serde_json::json;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, sleep_until};

use crate::checker::{Evidence, Shown, check};
use crate::ledger::{Disk, Kept, SharedDisk, Written};
use crate::life::Life;
use crate::machines::Machines;
use crate::net::{Net, Weather};
use crate::part::{self, Wanted};
use crate::person::{Given, Person, actor, give, take_supplies};

/// Nothing is drawn to go wrong after this.
const CALM_AFTER: Duration = Duration::from_secs(90);
/// A run has come to its end this long after everything has become calm.
const ENDS_WITHIN: Duration = Duration::from_secs(1800);
/// The most lives of the program that are cut short.
const MOST_DEATHS: usize = 3;

/// What happens to the cell from outside.
#[derive(Clone, Debug)]
enum Act {
    Weather {
        wire: usize,
        weather: Weather,
        lasts: Duration,
    },
    Disk {
        disk: Disk,
        lasts: Duration,
    },
    Freeze {
        machine: usize,
        lasts: Duration,
    },
    Reboot {
        machine: usize,
    },
    Manual {
        machine: usize,
        lasts: Duration,
    },
    Supplies {
        machine: usize,
        lasts: Duration,
    },
    Stranger {
        machine: usize,
        aborts: bool,
    },
    /// Somebody writes a command under a number near the last that there is.
    HighNumber {
        machine: usize,
    },
    /// The computer sleeps; the machines do not.
    Suspend {
        lasts: Duration,
    },
    Order(&'static str),
}

/// The schedule of a seed.
#[derive(Clone, Debug)]
pub struct Schedule {
    seed: u64,
    /// Seconds of the machines' own time in one of the cell's: a pass takes from a third of a second to some ten.
    speed: f64,
    /// Bits a second of the one serial line that both machines are on; none where they are on a network.
    baud: Option<u32>,
    /// Share of the requests to the machines with which something goes wrong.
    fault_share: f64,
    faults: Vec<Fault>,
    acts: Vec<(Duration, Act)>,
    /// Before which of its effects each life of the program ends.
    deaths: Vec<u64>,
    /// Whether nothing else was drawn.
    dies_alone: bool,
}

impl fmt::Display for Schedule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "seed {}", self.seed)?;
        if self.dies_alone { write!(f, ", deaths {:?}", self.deaths) } else { Ok(()) }
    }
}

/// What schedules did.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    runs: u64,
    accepted: u64,
    lives: u64,
    passes: u64,
    records: u64,
    faults: u64,
    orders: u64,
    simulated: Duration,
}

impl Tally {
    pub fn has_one_life(&self) -> bool {
        self.lives == 1
    }

    pub fn add(&mut self, other: &Self) {
        self.runs += other.runs;
        self.accepted += other.accepted;
        self.lives += other.lives;
        self.passes += other.passes;
        self.records += other.records;
        self.faults += other.faults;
        self.orders += other.orders;
        self.simulated += other.simulated;
    }
}

impl fmt::Display for Tally {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { runs, accepted, lives, passes, records, faults, orders, simulated } = self;
        write!(
            f,
            "{runs} parts ({accepted} accepted) in {lives} lives of the program, {passes} passes, {records} records, {faults} faults of \
             the wire, {orders} orders, {:.1} h of the cell's time",
            simulated.as_secs_f64() / 3600.0
        )
    }
}

/// Draws a time up to so many seconds.
fn up_to(chance: &mut StdRng, seconds: f64) -> Duration {
    Duration::from_secs_f64(seconds * chance.random::<f64>())
}

impl Schedule {
    /// Draws the schedule of a seed. Every kind of fault is in some schedules and not in others, so that none hides another.
    pub fn drawn(seed: u64) -> Self {
        let mut chance = StdRng::seed_from_u64(seed);
        let speed = [2000.0, 2000.0, 400.0, 60.0][chance.random_range(0..4)];
        // A run without faults takes about so long.
        let span_s = 8.0 + 2400.0 / speed;
        let baud = (chance.random::<f64>() < 0.25).then(|| [115_200, 57_600][chance.random_range(0..2)]);
        let fault_share = [0.0, 0.0, 0.003, 0.02, 0.08][chance.random_range(0..5)];
        let faults = faults(&mut chance, baud.is_some());
        let count = chance.random_range(0..8);
        let acts = (0..count).map(|_| (up_to(&mut chance, span_s), act(&mut chance))).collect();
        let deaths = if chance.random::<f64>() < 0.5 { chance.random_range(1..=MOST_DEATHS) } else { 0 };
        let deaths = (0..deaths).map(|_| chance.random_range(1..700)).collect();
        Self { seed, speed, baud, fault_share, faults, acts, deaths, dies_alone: false }
    }

    /// A schedule in which nothing goes wrong but that the program dies before certain effects.
    pub fn with_deaths(seed: u64, deaths: Vec<u64>) -> Self {
        Self {
            seed,
            speed: 2000.0,
            baud: None,
            fault_share: 0.0,
            faults: Vec::new(),
            acts: Vec::new(),
            deaths,
            dies_alone: true,
        }
    }

    fn wanted(&self) -> Wanted {
        if self.dies_alone { Wanted::Perfect } else { Wanted::Good }
    }

    /// Runs it and holds what happened against the promises.
    ///
    /// # Errors
    /// Which was broken.
    pub fn run(&self) -> Result<Tally, String> {
        let (evidence, home) = self.happen();
        let checked = check(&evidence);
        crate::keep::keep(home.path());
        checked.map(|()| evidence.tally.clone())
    }

    /// Runs it and returns everything that happened, line by line.
    pub fn traced(&self) -> Vec<String> {
        self.happen().0.trace()
    }

    /// Returns how many effects the program had, where nothing kills it.
    pub fn effects(&self) -> u64 {
        self.happen().0.effects
    }

    fn happen(&self) -> (Evidence, tempfile::TempDir) {
        // In memory, where there is room for what a run asks for: nothing here is to outlast the process.
        let memory = Path::new("/dev/shm");
        let has_room = free_bytes(memory).is_ok_and(|bytes| bytes > 48 << 20);
        let home = has_room.then(|| tempfile::tempdir_in(memory).ok()).flatten();
        let home = home.unwrap_or_else(|| tempfile::tempdir().unwrap());
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().start_paused(true).build().unwrap();
        let evidence = runtime.block_on(async { Happening::new(self, home.path()).go().await });
        (evidence, home)
    }
}

/// Draws which faults of the wire a schedule has.
fn faults(chance: &mut StdRng, is_serial: bool) -> Vec<Fault> {
    let all = [
        Fault::DropRequest,
        Fault::DropReply,
        Fault::DelayReply(Duration::from_millis(300)),
        Fault::DelayReply(Duration::from_millis(900)),
        Fault::DuplicateReply,
        Fault::Truncate(5),
        Fault::Extra(vec![0, 1, 2]),
        Fault::Noise(vec![9, 9, 9]),
        Fault::WrongTransaction,
        Fault::WrongUnit,
        Fault::WrongFunction,
        Fault::Exception(6),
        Fault::Exception(4),
        Fault::Exception(2),
        Fault::Split(Duration::from_millis(2)),
        Fault::FlipCrc,
        Fault::Disconnect(0),
        Fault::Disconnect(8),
        Fault::TornStatus,
        Fault::CarryOutAgain(3),
    ];
    let mut drawn: Vec<Fault> = all.into_iter().filter(|_| chance.random::<f64>() < 0.4).collect();
    if !is_serial && chance.random::<f64>() < 0.3 {
        drawn.push(Fault::Silence);
    }
    drawn
}

fn act(chance: &mut StdRng) -> Act {
    let machine = chance.random_range(0..2);
    let lasts = if chance.random::<f64>() < 0.3 { up_to(chance, 20.0) } else { up_to(chance, 4.0) };
    let second = Duration::from_secs(1);
    match chance.random_range(0..17) {
        0 => Act::Weather { wire: machine, weather: Weather { down: true, ..Weather::FAIR }, lasts },
        1 => Act::Weather { wire: machine, weather: Weather { silent: true, ..Weather::FAIR }, lasts },
        2 | 3 => {
            let slow_share = [0.02, 0.2, 1.0][chance.random_range(0..3)];
            let slow = second.mul_f64([0.4, 1.2, 6.0][chance.random_range(0..3)]);
            Act::Weather { wire: machine, weather: Weather { slow_share, slow, ..Weather::FAIR }, lasts }
        }
        4 => Act::Disk { disk: Disk { failing_share: 1.0, ..Disk::SOUND }, lasts },
        5 => Act::Disk { disk: Disk { failing_share: 0.2, unknown_share: 0.2, ..Disk::SOUND }, lasts },
        6 => Act::Disk { disk: Disk { slow_share: 0.5, slow: 8 * second, ..Disk::SOUND }, lasts },
        7 => Act::Freeze { machine, lasts },
        8 => Act::Reboot { machine },
        9 => Act::Manual { machine, lasts },
        10 => Act::Supplies { machine, lasts },
        11 => Act::Stranger { machine, aborts: chance.random::<f64>() < 0.2 },
        12 => Act::Order("hold"),
        13 => Act::HighNumber { machine },
        14 => Act::Suspend { lasts },
        _ => Act::Order(["abort", "abort", "stop", "resume"][chance.random_range(0..4)]),
    }
}

/// Where orders are taken, in the life of the program that is under way.
type Office = Arc<Mutex<Option<(Orders, Arc<Life>)>>>;

/// A schedule while it happens.
struct Happening<'s> {
    schedule: &'s Schedule,
    home: &'s Path,
    began: Instant,
    machines: Machines,
    faults: [Faults; 2],
    nets: [Net; 2],
    disk: SharedDisk,
    person: Person,
    shown: Arc<Mutex<Vec<Shown>>>,
    written: Written,
    /// The orders of the life that is under way, for who gives them from outside.
    orders: Office,
    job: u32,
    lives: u64,
    effects: u64,
    background: JoinSet<()>,
}

/// How a life of the program ended.
enum Ended {
    Died,
    Over(Ending),
    /// It came to no end.
    Never,
}

impl<'s> Happening<'s> {
    fn new(schedule: &'s Schedule, home: &'s Path) -> Self {
        let seed = schedule.seed;
        let machines = Machines::new(seed, schedule.speed);
        let faults = [1, 2].map(|k| {
            let plan = FaultPlan::seeded(seed ^ k, schedule.fault_share, schedule.faults.clone());
            Faults::from(plan)
        });
        let nets = match schedule.baud {
            // Both are on one line.
            Some(_) => {
                let units = [machines.units(0), machines.units(1)].concat();
                let line = Net::new(units, faults[0].clone(), schedule.baud, seed ^ 0x10);
                [line.clone(), line]
            }
            None => [0, 1].map(|k| Net::new(machines.units(k), faults[k].clone(), None, seed ^ (0x10 + k as u64))),
        };
        let person = Person::new(machines.shared.clone(), seed ^ 0x20);
        let mut background = JoinSet::new();
        background.spawn(Machines::live(machines.shared.clone()));
        Self {
            schedule,
            home,
            began: Instant::now(),
            machines,
            faults,
            nets,
            disk: SharedDisk::new(seed ^ 0x30),
            person,
            shown: Arc::default(),
            written: Arc::default(),
            orders: Arc::default(),
            job: 1,
            lives: 0,
            effects: 0,
            background,
        }
    }

    async fn go(mut self) -> Evidence {
        self.spawn_acts();
        let mut deaths = self.schedule.deaths.iter();
        let mut chance = StdRng::seed_from_u64(self.schedule.seed ^ 0x40);
        let mut folder = self.folder();
        let ending = loop {
            let life = Arc::new(Life::new(deaths.next().copied().unwrap_or(u64::MAX)));
            let (ended, is_begun) = self.live(&folder, &life).await;
            self.effects += life.effects();
            match ended {
                Ended::Over(ending) if self.is_closed() => break Some(ending),
                // The disk did not take its end: it is gone on with to bring it there.
                Ended::Over(_) if self.began.elapsed() < CALM_AFTER => sleep(CALM_AFTER).await,
                Ended::Over(_) | Ended::Never => break None,
                Ended::Died => sleep(up_to(&mut chance, 8.0)).await,
            }
            if self.is_closed() {
                break None;
            }
            if !is_begun && !has_events(&folder) {
                fs::remove_dir_all(&folder).unwrap();
                self.job += 1;
                folder = self.folder();
            }
        };
        // Whoever has given a machine back has done so by now.
        sleep(Duration::from_secs(5)).await;
        self.evidence(folder, ending)
    }

    fn is_closed(&self) -> bool {
        self.written.lock().unwrap().iter().any(|recorded| recorded.payload == "end")
    }

    fn folder(&self) -> PathBuf {
        self.home.join(format!("run-{}", self.job))
    }

    /// Begins or goes on with the run, until it ends or the program dies.
    async fn live(&mut self, folder: &Path, life: &Arc<Life>) -> (Ended, bool) {
        self.lives += 1;
        let (task, plan) = part::task(self.schedule.wanted());
        let begins = !folder.exists();
        let (journal, interrupted) = if begins {
            (Journal::create_with(folder, self.header(), Some(AuditKey::new())).unwrap(), None)
        } else {
            let lock = RunLock::take(folder).unwrap();
            verify(folder).unwrap();
            let interrupted = Interrupted::read(folder, plan.clone(), &task).unwrap_or_else(|error| panic!("{error}"));
            (Journal::open_locked(lock, None).unwrap(), Some(interrupted))
        };
        let kept = Kept::new(journal, &self.disk, life, &self.written);
        let journal = kept.shared();
        let (notices, _) = mpsc::unbounded_channel();
        let disk = self.disk.clone();
        let mut computing = StdRng::seed_from_u64(self.schedule.seed ^ 0x50 ^ self.lives);
        let computing = Mutex::new(move || up_to(&mut computing, 0.8));
        let takes = move |what| match what {
            Blocking::Record => disk.write_takes(),
            _ => computing.lock().unwrap()(),
        };
        let run = Run {
            plan,
            task,
            journal: Box::new(kept),
            job: self.job,
            actor: actor(),
            loaded: true,
            poll: part::poll(),
            notices,
            interrupted,
            beside: Beside::InTurn(Arc::new(takes)),
        };
        let [of_cmm, of_grinder] = self.links(life);
        let settings = |which| self.settings(which);
        let cmm = ModbusCmm::on(of_cmm, settings(0));
        let grinder = ModbusGrinder::on(of_grinder, settings(1));
        let (drive, orders) = Drive::new(run, cmm, grinder).unwrap();
        *self.orders.lock().unwrap() = Some((orders.clone(), life.clone()));
        let watching = tokio::spawn(watch(orders.clone(), life.clone(), self.shown.clone()));
        let by = self.began + CALM_AFTER + ENDS_WITHIN;
        let ended = tokio::select! {
            biased;
            () = life.died() => Ended::Died,
            ending = drive.run() => Ended::Over(ending),
            () = sleep_until(by) => Ended::Never,
            () = self.person.attend(&orders, life) => unreachable!("a person does not go"),
        };
        watching.abort();
        // Nobody sees the cell of a program that is not there.
        self.shown.lock().unwrap().push(Shown { at: Instant::now(), state: None });
        *self.orders.lock().unwrap() = None;
        life.end();
        self.nets.iter().for_each(Net::hang_up);
        // The dead keep no lock.
        drop(journal.lock().unwrap().take());
        (ended, !begins)
    }

    fn header(&self) -> Header {
        Header {
            run: format!("run {}", self.job),
            part: "SN-1".into(),
            actor: actor().name,
            station: actor().station,
            simulation: true,
            first_command_id: 1,
            content: json!({ "job": self.job }),
        }
    }

    fn settings(&self, which: usize) -> ModbusSettings {
        let cell = &part::setting(Wanted::Good).cell;
        let link = if which == 0 { &cell.cmm.link } else { &cell.grinder.link };
        setup::modbus(link, true, 7, self.lives as u32).unwrap()
    }

    fn links(&self, life: &Arc<Life>) -> [Link; 2] {
        let link = |which: usize| {
            let mut settings = self.settings(which);
            if let Some(baud) = self.schedule.baud {
                let parity = regrind::device::Parity::Even;
                settings.line = regrind::device::Line::Rtu { device: "line".into(), baud, parity, stop_bits: 1 };
            }
            let seed = self.schedule.seed ^ (0x60 + which as u64) ^ (self.lives << 8);
            Link::over(settings.line, settings.request_timeout, settings.quarantine, self.nets[which].dial(life), seed)
        };
        if self.schedule.baud.is_some() {
            let line = link(0);
            return [line.clone(), line];
        }
        [link(0), link(1)]
    }

    /// Lets happen what the schedule has.
    fn spawn_acts(&mut self) {
        for (number, (at, act)) in self.schedule.acts.iter().cloned().enumerate() {
            let outside = Outside {
                shared: self.machines.shared.clone(),
                nets: self.nets.clone(),
                disk: self.disk.clone(),
                orders: self.orders.clone(),
                given: self.person.given.clone(),
                settings: [self.settings(0), self.settings(1)],
                is_serial: self.schedule.baud.is_some(),
                number,
            };
            self.background.spawn(async move {
                sleep(at).await;
                outside.act(act).await;
            });
        }
        let (faults, nets, disk, shared) =
            (self.faults.clone(), self.nets.clone(), self.disk.clone(), self.machines.shared.clone());
        self.background.spawn(async move {
            sleep(CALM_AFTER).await;
            faults.iter().for_each(|faults| faults.set(FaultPlan::new(0)));
            nets.iter().for_each(|net| net.set(Weather::FAIR));
            disk.set(Disk::SOUND);
            shared.iter().for_each(|machine| machine.with(|machine| machine.freeze(false)));
        });
    }

    fn evidence(self, folder: PathBuf, ending: Option<Ending>) -> Evidence {
        let log = self.machines.log.lock().unwrap().clone();
        let given: Vec<Given> = self.person.given.lock().unwrap().clone();
        let written = self.written.lock().unwrap().clone();
        let fired = self.faults.iter().map(|faults| faults.fired().len() as u64).sum();
        let passes = log.iter().filter(|m| matches!(m.what, regrind_sim::seen::What::Began { .. })).count() as u64;
        let accepted = u64::from(matches!(ending, Some(Ending::Accepted { .. })));
        let tally = Tally {
            runs: 1,
            accepted,
            lives: self.lives,
            passes,
            records: written.len() as u64,
            faults: fired,
            orders: given.len() as u64,
            simulated: self.began.elapsed(),
        };
        let is_steady = self.schedule.baud.is_none()
            && self.schedule.fault_share == 0.0
            && !self.schedule.acts.iter().any(|(_, act)| {
                matches!(
                    act,
                    Act::Weather { .. }
                        | Act::Freeze { .. }
                        | Act::Reboot { .. }
                        | Act::Stranger { .. }
                        | Act::HighNumber { .. }
                        | Act::Suspend { .. }
                )
            });
        let shown = self.shown.lock().unwrap().clone();
        Evidence {
            began: self.began,
            job: self.job,
            folder,
            log,
            given,
            written,
            shown,
            tally,
            is_steady,
            effects: self.effects,
        }
    }
}

/// Whether a run has begun, as `regrind resume` asks.
fn has_events(folder: &Path) -> bool {
    Reader::open(folder).is_ok_and(|reader| reader.records(0).flatten().any(|record| record.kind == Kind::Event))
}

/// Keeps what the cell shows of itself.
async fn watch(orders: Orders, life: Arc<Life>, shown: Arc<Mutex<Vec<Shown>>>) {
    let mut status = orders.status();
    loop {
        let state = status.borrow_and_update().state;
        if life.is_dead() {
            return;
        }
        shown.lock().unwrap().push(Shown { at: Instant::now(), state: Some(state) });
        if status.changed().await.is_err() {
            return;
        }
    }
}

/// What acts upon the cell from outside.
struct Outside {
    shared: [SharedMachine; 2],
    nets: [Net; 2],
    disk: SharedDisk,
    orders: Office,
    given: Arc<Mutex<Vec<Given>>>,
    settings: [ModbusSettings; 2],
    is_serial: bool,
    number: usize,
}

impl Outside {
    async fn act(self, act: Act) {
        match act {
            Act::Weather { wire, weather, lasts } => {
                self.nets[wire].set(weather);
                sleep(lasts).await;
                self.nets[wire].set(Weather::FAIR);
            }
            Act::Disk { disk, lasts } => {
                self.disk.set(disk);
                sleep(lasts).await;
                self.disk.set(Disk::SOUND);
            }
            Act::Freeze { machine, lasts } => {
                self.shared[machine].with(|machine| machine.freeze(true));
                sleep(lasts).await;
                self.shared[machine].with(|machine| machine.freeze(false));
            }
            Act::Reboot { machine } => self.shared[machine].with(|machine| machine.reboot()),
            Act::Manual { machine, lasts } => {
                self.shared[machine].with(|machine| machine.set_mode(Mode::Manual));
                sleep(lasts).await;
                self.shared[machine].with(|machine| machine.set_mode(Mode::Automatic));
            }
            Act::Supplies { machine, lasts } => {
                take_supplies(&self.shared[machine], true);
                sleep(lasts).await;
                take_supplies(&self.shared[machine], false);
            }
            // A second master on a serial line would talk into the answers of the first: there is one master on such a line.
            Act::Stranger { machine, aborts } if !self.is_serial => self.stranger(machine, aborts).await,
            Act::Stranger { .. } => {}
            Act::HighNumber { machine } => {
                let frame = Frame { sequence: u32::MAX - 3, command: 1, owner: 99, epoch: 1, ..Frame::default() };
                let at = Layout::default().command;
                // It is acknowledged, and refused.
                let _ = self.shared[machine].with(|machine| machine.write(at, &frame.registers(WordOrder::Big)));
            }
            Act::Suspend { lasts } => tokio::time::advance(lasts).await,
            Act::Order(what) => self.order(what).await,
        }
    }

    /// Another program tries to take the machine, and may abort it.
    async fn stranger(&self, which: usize, aborts: bool) {
        let life = Arc::new(Life::new(u64::MAX));
        let settings = ModbusSettings { owner: 99, epoch: 1, ..self.settings[which].clone() };
        let seed = self.number as u64;
        let dial = self.nets[which].dial(&life);
        let link = Link::over(settings.line.clone(), settings.request_timeout, settings.quarantine, dial, seed);
        // It is refused wherever the machine has an owner that is alive; what it is told does not matter here.
        if which == 0 {
            let mut machine = ModbusCmm::on(link, settings);
            let _ = machine.connect().await;
            let _ = machine.claim().await;
            if aborts {
                let _ = machine.abort().await;
            }
        } else {
            let mut machine = ModbusGrinder::on(link, settings);
            let _ = machine.connect().await;
            let _ = machine.claim().await;
            if aborts {
                let _ = machine.abort().await;
            }
        }
    }

    async fn order(&self, what: &'static str) {
        let Some((orders, life)) = self.orders.lock().unwrap().clone() else { return };
        let reason = format!("drawn {}", self.number);
        give(&orders, &life, &self.given, (what, reason), &self.shared, |reason| match what {
            "hold" => Request::Hold { reason },
            "resume" => Request::Resume { reason, seen: None },
            "stop" => Request::Stop { reason },
            _ => Request::Abort { reason },
        })
        .await;
    }
}
