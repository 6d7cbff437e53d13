//! The two machines of a cell, their time, and their actions.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use regrind_sim::command::State;
use regrind_sim::dme::event::MachineEvent;
use regrind_sim::dme::faults::CommandFaults as DmeFaults;
use regrind_sim::dme::{Server, machine as probe};
use regrind_sim::event_log::HandshakeEvent;
use regrind_sim::options::MachineOptions;
use regrind_sim::registers::SimulatedMachine;
use regrind_sim::rsh::Controller;
use regrind_sim::rsh::event::ControllerEvent;
use regrind_sim::rsh::faults::LineFaults as RshFaults;
use regrind_sim::spec::WorldSpec;
use regrind_sim::wire::SharedMachine;
use regrind_sim::wire::lines::SharedLineServer;
use regrind_sim::world::World;
use tokio::time::Instant;

use crate::cue::Cues;
use crate::net::Far;
use crate::part::{RequiredQuality, setting};
use crate::schedule::Schedule;

/// Time step of the machines.
const TICK: Duration = Duration::from_millis(10);

/// Observation or action of a machine.
#[derive(Clone, Debug)]
pub struct Moment {
    pub at: Instant,
    /// Index of the machine: 0 is the CMM, 1 the grinder.
    pub machine: usize,
    pub what: HandshakeEvent,
}

/// Actions of both machines, in order.
pub type Log = Arc<Mutex<Vec<Moment>>>;

/// Actions of a measuring machine by I++ DME, in order.
pub type Deeds = Arc<Mutex<Vec<(Instant, MachineEvent)>>>;

/// Actions of a grinder by LinuxCNC, in order.
pub type RshDeeds = Arc<Mutex<Vec<(Instant, ControllerEvent)>>>;

/// Speed of a program, relative to a pass of a register machine, which does its strokes within the pass.
const OF_PROGRAMS: f64 = 0.25;

/// Machine, with any protocol.
#[derive(Clone)]
pub enum Plant {
    Registers(SharedMachine),
    Dme(SharedLineServer<Server>),
    Rsh(SharedLineServer<Controller>),
}

impl Plant {
    /// Returns true if the machine is possibly moving.
    pub fn moves(&self) -> bool {
        match self {
            Self::Registers(machine) => moves(machine.with(|machine| machine.state())),
            Self::Dme(server) => server.with(|server| server.is_moving()),
            Self::Rsh(controller) => controller.with(|controller| controller.is_moving()),
        }
    }

    /// Returns true if a person who looks at the machine says that it has no job.
    pub fn is_over(&self) -> bool {
        match self {
            Self::Registers(machine) => {
                let state = machine.with(|machine| machine.state());
                matches!(state, State::Idle | State::Complete | State::Aborted | State::Faulted)
            }
            Self::Dme(server) => !server.with(|server| server.is_moving()),
            Self::Rsh(controller) => !controller.with(|controller| controller.is_busy()),
        }
    }

    /// Tells the machine that a person has moved it away from the part by hand.
    pub fn moved_away(&self) {
        match self {
            Self::Registers(_) => {}
            Self::Dme(server) => server.with(|server| server.machine().lift()),
            Self::Rsh(controller) => controller.with(Controller::lead_away),
        }
    }

    /// Returns the register machine, if it is one.
    pub fn registers(&self) -> Option<&SharedMachine> {
        if let Self::Registers(machine) = self { Some(machine) } else { None }
    }

    fn live(&self) {
        match self {
            Self::Registers(machine) => machine.with(|machine| machine.tick(TICK)),
            Self::Dme(server) => server.advance_time(),
            Self::Rsh(controller) => controller.advance_time(),
        }
    }
}

pub struct Machines {
    pub plants: [Plant; 2],
    pub log: Log,
    pub machine_events: Deeds,
    /// Remaining faults of the server of I++ DME.
    pub dme_faults: DmeFaults,
    pub rsh_events: RshDeeds,
    pub rsh_faults: RshFaults,
}

impl Machines {
    /// Switches both machines on, at a multiple of the real speed. A trusting machine does not itself prevent
    /// duplicates.
    pub fn new(schedule: &Schedule, cues: &Cues) -> Self {
        let Schedule { seed, speed, trusting, .. } = *schedule;
        let truth = setting(RequiredQuality::Good).recipe.simulation.clone().unwrap();
        let mut spec = truth.try_into::<WorldSpec>().unwrap();
        spec.seed = 1 + seed % 7;
        if schedule.dme.is_some() {
            spec.cmm.not_found_share = 0.01;
        }
        let world = World::new(spec).unwrap();
        let (log, machine_events, dme_faults) = (Log::default(), Deeds::default(), DmeFaults::none());
        let options = |seed| MachineOptions { speed, seed, trusting, ..MachineOptions::default() };
        let by_registers = |number: usize, mut machine: SimulatedMachine| {
            let (log, cues) = (log.clone(), cues.clone());
            machine.set_observer(Box::new(move |seen| {
                cues.see_machine(&seen.event);
                log.lock().unwrap().push(Moment { at: Instant::now(), machine: number, what: seen.event.clone() });
            }));
            Plant::Registers(SharedMachine::from(machine))
        };
        let cmm = match &schedule.dme {
            None => by_registers(0, SimulatedMachine::new(Box::new(world.cmm()), 71, options(seed ^ 0xC))),
            Some(faults) => {
                for (method, skip, fault) in faults {
                    dme_faults.add(*method, *skip, fault.clone());
                }
                Plant::Dme(by_lines(&world, speed, dme_faults.clone(), (&log, &machine_events, cues)))
            }
        };
        let (rsh_events, rsh_faults) = (RshDeeds::default(), RshFaults::none());
        let grinder = match &schedule.rsh {
            None => by_registers(1, SimulatedMachine::new(Box::new(world.grinder()), 72, options(seed ^ 0x6))),
            Some(faults) => {
                for (begins, skip, fault) in faults {
                    rsh_faults.add(*begins, *skip, fault.clone());
                }
                let speed = OF_PROGRAMS * speed;
                Plant::Rsh(by_programs(&world, speed, rsh_faults.clone(), (&log, &rsh_events, cues)))
            }
        };
        Self { plants: [cmm, grinder], log, machine_events, dme_faults, rsh_events, rsh_faults }
    }

    /// Returns the far end of the connection of a machine.
    pub fn far(&self, which: usize) -> Far {
        match &self.plants[which] {
            Plant::Registers(machine) => Far::Registers(vec![(which as u8 + 1, machine.clone())]),
            Plant::Dme(server) => Far::Dme(server.clone()),
            Plant::Rsh(controller) => Far::Rsh(controller.clone()),
        }
    }

    /// Returns both machines, as on one line.
    pub fn both(&self) -> Far {
        let units = self.plants.iter().enumerate();
        Far::Registers(units.filter_map(|(k, plant)| Some((k as u8 + 1, plant.registers()?.clone()))).collect())
    }

    /// Advances the time of the machines.
    pub async fn live(plants: [Plant; 2]) {
        let mut ticks = tokio::time::interval(TICK);
        loop {
            ticks.tick().await;
            plants.iter().for_each(Plant::live);
        }
    }
}

/// Returns a measuring machine with a server of I++ DME.
fn by_lines(
    world: &World,
    speed: f64,
    faults: DmeFaults,
    (log, machine_events, cues): (&Log, &Deeds, &Cues),
) -> SharedLineServer<Server> {
    let mut server = Server::new(probe::DmeMachine::new(world.touch_probe(), probe::Options::default()), speed, faults);
    let (log, machine_events, cues) = (log.clone(), machine_events.clone(), cues.clone());
    server.set_observer(Box::new(move |event| {
        let at = Instant::now();
        machine_events.lock().unwrap().push((at, event.clone()));
        let (from, to) = match event {
            MachineEvent::MotionStarted { command, .. } => {
                if command == "ChangeTool" {
                    cues.begin();
                }
                (State::Idle, State::Execute)
            }
            MachineEvent::MotionEnded { .. } => (State::Execute, State::Idle),
            _ => return,
        };
        log.lock().unwrap().push(Moment { at, machine: 0, what: HandshakeEvent::Changed { from, to } });
    }));
    server.into()
}

/// Returns a grinder with linuxcncrsh.
fn by_programs(
    world: &World,
    speed: f64,
    faults: RshFaults,
    (log, machine_events, cues): (&Log, &RshDeeds, &Cues),
) -> SharedLineServer<Controller> {
    let radius_mm = setting(RequiredQuality::Good).recipe.grinding.wheel.radius_mm();
    let mut controller = Controller::new(world.wheel(radius_mm).unwrap(), speed, faults);
    let (log, machine_events, cues) = (log.clone(), machine_events.clone(), cues.clone());
    controller.set_observer(Box::new(move |event| {
        let at = Instant::now();
        machine_events.lock().unwrap().push((at, event.clone()));
        let (from, to) = match event {
            ControllerEvent::Began { .. } => return cues.begin(),
            ControllerEvent::MotionStarted => (State::Idle, State::Execute),
            ControllerEvent::MotionEnded => (State::Execute, State::Idle),
            _ => return,
        };
        log.lock().unwrap().push(Moment { at, machine: 1, what: HandshakeEvent::Changed { from, to } });
    }));
    controller.into()
}

/// Returns true if a machine in this state is possibly moving.
pub fn moves(state: State) -> bool {
    matches!(state, State::Execute | State::Holding | State::Stopping | State::Aborting)
}
