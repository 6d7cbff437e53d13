//! Execution of a schedule: the machines live on, and the program is restarted after each death until its run has
//! finished.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use regrind::cell::{AlarmId, Device, Ending};
use regrind::device::ippdme::Limits;
use regrind::device::{
    AnyCmm, AnyGrinder, IppdmeCmm, IppdmeSettings, IppdmeWire, Link, LinuxcncGrinder, LinuxcncSettings, LinuxcncWire,
    ModbusCmm, ModbusGrinder, ModbusSettings,
};
use regrind::drive::{BlockingExecutor, BlockingWork, Drive, InterruptedRun, OrderSender, RunInputs};
use regrind::journal::{AuditKey, Header, Journal, Reader, RecordKind, RunLock, verify};
use regrind::setup;
use regrind_sim::event_log::HandshakeEvent;
use serde_json::json;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, sleep_until};

use crate::checker::{Evidence, Shown};
use crate::cue::Cues;
use crate::ledger::{Disk, LifeJournal, SharedDisk, Written};
use crate::life::Life;
use crate::machines::{Machines, Plant};
use crate::net::{Net, Weather};
use crate::outside::{Hindered, Office, Outside};
use crate::part::{self, RequiredQuality};
use crate::person::{GivenOrder, Person, actor};
use crate::schedule::{Act, Schedule, Tally};
use crate::wire::Wires;
use regrind_testcell::wire_faults::{FaultPlan, SharedFaultPlan};

/// Time after which no fault is drawn.
const CALM_AFTER: Duration = Duration::from_secs(90);
/// Longest duration of a fault.
const AT_MOST: Duration = Duration::from_secs(21);
/// Time limit for the end of a run after the last fault.
const ENDS_WITHIN: Duration = Duration::from_secs(1800);

/// Volume that the probe's centre must not leave, in mm.
const VOLUME_MM: [[f64; 3]; 2] = [[-500.0, -500.0, -300.0], [500.0, 500.0, 400.0]];

/// Schedule in execution.
pub struct Happening<'s> {
    schedule: &'s Schedule,
    home: &'s Path,
    began: Instant,
    machines: Machines,
    faults: [SharedFaultPlan; 2],
    nets: [Net; 2],
    disk: SharedDisk,
    person: Person,
    shown: Arc<Mutex<Vec<Shown>>>,
    written: Written,
    wires: Wires,
    cues: Cues,
    /// Intervals in which requests to the machines were possibly delayed.
    hindered: Hindered,
    /// Orders of the current life, for tasks that give them from outside.
    orders: Office,
    job: u32,
    lives: u64,
    effects: u64,
    background: JoinSet<()>,
}

/// End of a life of the program.
enum Ended {
    Died,
    Over(Ending),
    /// It did not end.
    Never,
}

impl<'s> Happening<'s> {
    pub fn new(schedule: &'s Schedule, home: &'s Path) -> Self {
        let seed = schedule.seed;
        let cues = Cues::new();
        let machines = Machines::new(schedule, &cues);
        let faults = [1, 2].map(|k| {
            let plan = FaultPlan::seeded(seed ^ k, schedule.fault_share, schedule.faults.clone());
            SharedFaultPlan::from(plan)
        });
        let nets = match schedule.baud {
            // Both machines are on one line.
            Some(_) => {
                let line = Net::new(machines.both(), faults[0].clone(), schedule.baud, seed ^ 0x10);
                [line.clone(), line]
            }
            None => [0, 1].map(|k| Net::new(machines.far(k), faults[k].clone(), None, seed ^ (0x10 + k as u64))),
        };
        let person = Person::new(machines.plants.clone(), seed ^ 0x20);
        let mut background = JoinSet::new();
        background.spawn(Machines::live(machines.plants.clone()));
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
            wires: Arc::default(),
            cues,
            hindered: Arc::default(),
            orders: Arc::default(),
            job: 1,
            lives: 0,
            effects: 0,
            background,
        }
    }

    pub async fn go(mut self) -> Evidence {
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
                // The disk did not accept its end: the program resumes to record it.
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
        // Everybody who has a machine to give back has done so by now.
        sleep(Duration::from_secs(5)).await;
        self.evidence(folder, ending)
    }

    fn is_closed(&self) -> bool {
        self.written.lock().unwrap().iter().any(|recorded| recorded.payload == "end")
    }

    fn folder(&self) -> PathBuf {
        self.home.join(format!("run-{}", self.job))
    }

    /// Begins or resumes the run, until it ends or the program dies.
    async fn live(&mut self, folder: &Path, life: &Arc<Life>) -> (Ended, bool) {
        self.lives += 1;
        let (task, plan) = part::task(self.schedule.wanted);
        let begins = !folder.exists();
        let (journal, interrupted) = if begins {
            let mut journal = Journal::create_with(folder, self.header(), Some(AuditKey::new())).unwrap();
            if self.schedule.rsh.is_some() {
                // As `regrind run` does for a grinder that reads files from the folder of the run.
                for name in task.save_first_pass(&folder.join("cycle-0")).unwrap() {
                    journal.adopt(&format!("cycle-0/{name}"), 0, 0).unwrap();
                }
            }
            (journal, None)
        } else {
            let lock = RunLock::acquire(folder).unwrap();
            verify(folder).unwrap();
            let interrupted =
                InterruptedRun::read(folder, plan.clone(), &task).unwrap_or_else(|error| panic!("{error}"));
            (Journal::open_locked(lock, None).unwrap(), Some(interrupted))
        };
        let kept = LifeJournal::new(journal, &self.disk, life, &self.written, &self.cues);
        let journal = kept.shared();
        let (notices, _) = mpsc::unbounded_channel();
        let disk = self.disk.clone();
        let mut computing = StdRng::seed_from_u64(self.schedule.seed ^ 0x50 ^ self.lives);
        let computing = Mutex::new(move || up_to(&mut computing, 0.8));
        let takes = move |what| match what {
            BlockingWork::Record => disk.write_takes(),
            _ => computing.lock().unwrap()(),
        };
        let run = RunInputs {
            plan,
            task,
            journal: Box::new(kept),
            job: self.job,
            actor: actor(),
            load_confirmed: true,
            poll_intervals: part::poll(),
            notices,
            interrupted,
            executor: BlockingExecutor::SimulatedTime(Arc::new(takes)),
        };
        let (cmm, grinder) = self.drivers(life, folder);
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
        // A dead program shows no cell.
        self.shown.lock().unwrap().push(Shown {
            at: Instant::now(),
            state: None,
            phase: None,
            unconfirmed: [false; 2],
            asks_to_check: false,
        });
        *self.orders.lock().unwrap() = None;
        life.end();
        self.nets.iter().for_each(Net::hang_up);
        // A dead program holds no lock.
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
        let cell = &part::setting(RequiredQuality::Good).cell;
        let link = if which == 0 { &cell.cmm.link } else { &cell.grinder.link };
        setup::modbus_settings(link, true, 7, self.lives as u32).unwrap()
    }

    /// Returns the folder of programs, which the controller sees too.
    fn programs(&self) -> PathBuf {
        self.home.join("nc")
    }

    /// Returns the settings of linuxcncrsh: the defaults of a cell file.
    fn rsh_settings(&self, folder: &Path) -> LinuxcncSettings {
        let programs = self.programs();
        fs::create_dir_all(&programs).unwrap();
        let wire = LinuxcncWire { host: "grinder".into(), ..LinuxcncWire::default() };
        let ms = |ms: u32| Duration::from_millis(ms.into());
        LinuxcncSettings {
            host: wire.host,
            port: wire.port,
            connect_password: wire.connect_password,
            control_password: wire.control_password,
            run_folder: folder.to_owned(),
            programs_at_controller: programs.display().to_string(),
            programs,
            joints: wire.joints.into(),
            answer_timeout: ms(wire.answer_timeout_ms),
            settle_timeout: ms(wire.settle_timeout_ms),
            record_timeout: ms(wire.record_timeout_ms),
            expected_name: None,
            simulated: true,
        }
    }

    /// Returns the drivers of a life of the program.
    fn drivers(&self, life: &Arc<Life>, folder: &Path) -> (AnyCmm, AnyGrinder) {
        let [of_cmm, of_grinder] = self.links(life);
        let wires = (self.wires.clone(), self.cues.clone());
        let grinder = match self.schedule.rsh {
            None => AnyGrinder::ModbusTcp(ModbusGrinder::on(of_grinder, self.settings(1))),
            Some(_) => {
                let dial = self.nets[1].connect(life, Some(&wires));
                let seed = self.schedule.seed ^ 0x70 ^ (self.lives << 8);
                AnyGrinder::Linuxcnc(LinuxcncGrinder::with_connector(self.rsh_settings(folder), dial, seed))
            }
        };
        let cmm = match self.schedule.dme {
            None => AnyCmm::ModbusTcp(ModbusCmm::on(of_cmm, self.settings(0))),
            Some(_) => {
                let dial = self.nets[0].connect(life, Some(&wires));
                AnyCmm::Ippdme(IppdmeCmm::with_connector(dme_settings(), dial))
            }
        };
        (cmm, grinder)
    }

    fn links(&self, life: &Arc<Life>) -> [Link; 2] {
        let link = |which: usize| {
            let mut settings = self.settings(which);
            if let Some(baud) = self.schedule.baud {
                let parity = regrind::device::Parity::Even;
                settings.line = regrind::device::LineAddress::Rtu { device: "line".into(), baud, parity, stop_bits: 1 };
            }
            let seed = self.schedule.seed ^ (0x60 + which as u64) ^ (self.lives << 8);
            Link::with_connector(
                settings.line,
                settings.request_timeout,
                settings.quarantine,
                self.nets[which].connect(life, Some(&(self.wires.clone(), self.cues.clone()))),
                seed,
            )
        };
        if self.schedule.baud.is_some() {
            let line = link(0);
            return [line.clone(), line];
        }
        [link(0), link(1)]
    }

    /// Spawns the acts of the schedule.
    fn spawn_acts(&mut self) {
        let latest = self.began + CALM_AFTER - AT_MOST;
        for (number, (when, act)) in self.schedule.acts.iter().cloned().enumerate() {
            let outside = Outside {
                plants: self.machines.plants.clone(),
                nets: self.nets.clone(),
                faults: self.faults.clone(),
                disk: self.disk.clone(),
                orders: self.orders.clone(),
                given: self.person.given.clone(),
                settings: [self.settings(0), self.settings(1)],
                is_serial: self.schedule.baud.is_some(),
                hindered: self.hindered.clone(),
                programs: self.programs(),
                number,
            };
            let cues = self.cues.clone();
            self.background.spawn(async move {
                cues.wait(when).await;
                if Instant::now() < latest {
                    outside.act(act).await;
                }
            });
        }
        let (faults, nets, disk) = (self.faults.clone(), self.nets.clone(), self.disk.clone());
        let (plants, of_dme) = (self.machines.plants.clone(), self.machines.dme_faults.clone());
        let of_rsh = self.machines.rsh_faults.clone();
        self.background.spawn(async move {
            sleep(CALM_AFTER).await;
            faults.iter().for_each(|faults| faults.set(FaultPlan::new(0)));
            for net in &nets {
                net.set(Weather::FAIR);
            }
            disk.set(Disk::SOUND);
            of_dme.clear();
            of_rsh.clear();
            let by_registers = plants.iter().filter_map(Plant::registers);
            by_registers.for_each(|machine| machine.with(|machine| machine.freeze(false)));
        });
    }

    fn evidence(self, folder: PathBuf, ending: Option<Ending>) -> Evidence {
        let log = self.machines.log.lock().unwrap().clone();
        let given: Vec<GivenOrder> = self.person.given.lock().unwrap().clone();
        let written = self.written.lock().unwrap().clone();
        let fired = self.faults.iter().map(|faults| faults.fired().len() as u64).sum();
        let passes = log.iter().filter(|m| matches!(m.what, HandshakeEvent::Began { .. })).count() as u64;
        let accepted = u64::from(matches!(&ending, Some(Ending::Accepted { .. })));
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
        let is_plain =
            self.schedule.baud.is_none() && self.schedule.fault_share == 0.0 && self.schedule.servers_go_well();
        let hindered = is_plain.then(|| self.hindered.lock().unwrap().clone());
        let wires = self.wires.lock().unwrap().clone();
        // The program can have died with its end on record, before anybody received it.
        let finish = written.iter().rev().find(|recorded| recorded.payload["command"] == "finish");
        let told = ending.as_ref().and_then(|ending| serde_json::to_value(ending).ok());
        let told = told.as_ref().or(finish.map(|finish| &finish.payload)).and_then(|told| told["ending"].as_str());
        let ended_well = match (told, self.schedule.wanted) {
            (Some("accepted"), RequiredQuality::Good) | (Some("not_accepted"), RequiredQuality::Perfect) => true,
            // A wheel under program control leaves more between tracks that are 6 mm apart than the limits of this part
            // allow: RMS 2.5 um, limit 2.
            (Some("not_accepted"), RequiredQuality::Good) if self.schedule.rsh.is_some() => true,
            // A fault can have ended it.
            _ => !self.schedule.dies_alone(),
        };
        let shown = self.shown.lock().unwrap().clone();
        Evidence {
            began: self.began,
            job: self.job,
            folder,
            log,
            machine_events: self.machines.machine_events.lock().unwrap().clone(),
            rsh_events: self.machines.rsh_events.lock().unwrap().clone(),
            given,
            written,
            shown,
            tally,
            wires,
            hindered,
            clearance_mm: part::clearance_mm(),
            disk_alone: self.schedule.disk_fails_alone(),
            lies: self.schedule.lies(),
            freezes: self.schedule.acts.iter().any(|(_, act)| matches!(act, Act::Freeze { .. })),
            ended_well,
            effects: self.effects,
        }
    }
}

/// Returns the settings of a server of I++ DME: the defaults of a cell file.
fn dme_settings() -> IppdmeSettings {
    let cell = &part::setting(RequiredQuality::Good).cell;
    let wire = IppdmeWire { host: "cmm".into(), tool: "Probe1".into(), ..IppdmeWire::default() };
    let ms = |ms: u32| Duration::from_millis(ms.into());
    IppdmeSettings {
        host: wire.host,
        port: wire.port,
        tool: wire.tool,
        probe_tolerance_mm: wire.probe_tolerance_mm,
        travel_speed_mm_s: wire.travel_speed_mm_s,
        scan: None,
        part_frame: None,
        retries: wire.retries,
        volume_mm: VOLUME_MM,
        limits: Limits {
            answer: ms(wire.answer_timeout_ms),
            completion: ms(wire.completion_timeout_ms),
            abort: ms(wire.abort_timeout_ms),
            after_abort: ms(wire.delay_after_abort_ms),
            alive: ms(wire.alive_every_ms),
        },
        silence_limit: cell.cmm.link.timing.lost_after,
        expected_name: None,
        simulated: true,
    }
}

/// Returns true if a run has begun, by the same check as `regrind resume`.
fn has_events(folder: &Path) -> bool {
    Reader::open(folder).is_ok_and(|reader| reader.records(0).flatten().any(|record| record.kind == RecordKind::Event))
}

/// Records the states that the cell shows.
async fn watch(orders: OrderSender, life: Arc<Life>, shown: Arc<Mutex<Vec<Shown>>>) {
    let mut status = orders.status();
    loop {
        let (state, phase, unconfirmed, asks_to_check) = {
            let seen = status.borrow_and_update();
            let asks = |id| matches!(id, AlarmId::StartUnknown | AlarmId::JobVanished);
            let asks_to_check = seen.alarms.iter().any(|alarm| asks(alarm.id));
            (seen.state, seen.phase, Device::BOTH.map(|device| seen.unconfirmed.contains(&device)), asks_to_check)
        };
        if life.is_dead() {
            return;
        }
        shown.lock().unwrap().push(Shown { at: Instant::now(), state: Some(state), phase, unconfirmed, asks_to_check });
        if status.changed().await.is_err() {
            return;
        }
    }
}

/// Draws a duration up to this many seconds.
fn up_to(chance: &mut StdRng, seconds: f64) -> Duration {
    Duration::from_secs_f64(seconds * chance.random::<f64>())
}
