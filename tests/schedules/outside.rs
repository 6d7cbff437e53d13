//! What acts upon the cell from outside, as a schedule has drawn it.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use regrind::device::{Link, Machine as _, ModbusCmm, ModbusGrinder, ModbusSettings};
use regrind::drive::{Orders, Request};
use regrind_sim::command::{Frame, Mode};
use regrind_sim::options::Layout;
use regrind_sim::rsh::Controller;
use regrind_sim::wire::SharedMachine;
use regrind_sim::wire::dme::SharedServer;
use regrind_sim::wire::faults::{Fault, FaultPlan, Faults, When};
use regrind_sim::wire::rsh::SharedController;
use regrind_sim::words::WordOrder;
use tokio::time::{Instant, sleep};

use crate::ledger::{Disk, SharedDisk};
use crate::life::Life;
use crate::machines::Plant;
use crate::net::{Net, Weather};
use crate::person::{Given, give, take_supplies};
use crate::schedule::Act;

/// Where orders are taken, in the life of the program that is under way.
pub type Office = Arc<Mutex<Option<(Orders, Arc<Life>)>>>;

/// From when to when something was in the way of what is asked of the machines.
pub type Hindered = Arc<Mutex<Vec<(Instant, Instant)>>>;

/// A person sets a machine right that has stopped within this.
const SET_RIGHT: Duration = Duration::from_secs(3);

/// What acts upon the cell from outside.
pub struct Outside {
    pub plants: [Plant; 2],
    pub nets: [Net; 2],
    pub faults: [Faults; 2],
    pub disk: SharedDisk,
    pub orders: Office,
    pub given: Arc<Mutex<Vec<Given>>>,
    pub settings: [ModbusSettings; 2],
    pub is_serial: bool,
    pub hindered: Hindered,
    /// The folder of programs.
    pub programs: PathBuf,
    pub number: usize,
}

impl Outside {
    /// Lets it happen, and comes back when it is over.
    pub async fn act(self, act: Act) {
        let by_lines = self.plants.iter().any(|plant| plant.registers().is_none());
        if let Some(lasts) = act.hinders(by_lines) {
            let now = Instant::now();
            self.hindered.lock().unwrap().push((now, now + lasts));
        }
        match act {
            Act::Weather { wire, weather, lasts } => self.nets[wire].weather(weather, lasts).await,
            Act::Disk { disk, lasts } => {
                self.disk.set(disk);
                sleep(lasts).await;
                self.disk.set(Disk::SOUND);
            }
            // Their servers are frozen by a network that is silent.
            Act::Freeze { machine, lasts } if self.plants[machine].registers().is_none() => {
                self.nets[machine].weather(Weather { silent: true, ..Weather::FAIR }, lasts).await;
            }
            Act::EmergencyStop { machine } => self.stop_circuit(machine).await,
            Act::Freeze { machine, .. }
            | Act::Reboot { machine }
            | Act::Forget { machine }
            | Act::Manual { machine, .. }
            | Act::Supplies { machine, .. }
            | Act::Stranger { machine, .. }
            | Act::HighNumber { machine }
            | Act::Stray { machine, .. }
            | Act::PressStart { machine }
            | Act::Spoil { machine } => match self.plants[machine].clone() {
                Plant::Registers(of_registers) => self.at_registers(act, &of_registers, machine).await,
                Plant::Dme(server) => self.at_dme(&act, &server).await,
                Plant::Rsh(controller) => self.at_rsh(&act, &controller).await,
            },
            Act::Lie { machine, block, at, word, lasts } => {
                let lie = FaultPlan::new(0).always(When::Reading(block), Fault::Lie(vec![(at, word)]));
                self.faults[machine].set(lie);
                sleep(lasts).await;
                self.faults[machine].set(FaultPlan::new(0));
            }
            Act::Suspend { lasts } => tokio::time::advance(lasts).await,
            Act::Order(what) => self.order(what).await,
        }
    }

    /// What happens to a machine that is reached by registers.
    async fn at_registers(&self, act: Act, of: &SharedMachine, machine: usize) {
        match act {
            Act::Freeze { lasts, .. } => {
                of.with(|machine| machine.freeze(true));
                sleep(lasts).await;
                of.with(|machine| machine.freeze(false));
            }
            Act::Reboot { .. } => of.with(|machine| machine.reboot()),
            Act::Forget { .. } => of.with(|machine| machine.forget()),
            Act::Manual { lasts, .. } => {
                of.with(|machine| machine.set_mode(Mode::Manual));
                sleep(lasts).await;
                of.with(|machine| machine.set_mode(Mode::Automatic));
            }
            Act::Supplies { lasts, .. } => {
                take_supplies(of, true);
                sleep(lasts).await;
                take_supplies(of, false);
            }
            // A second master on a serial line would talk into the answers of the first: there is one master on such a line.
            Act::Stranger { aborts, .. } if !self.is_serial => self.stranger(machine, aborts).await,
            Act::HighNumber { .. } => {
                let frame = Frame { sequence: u32::MAX - 3, command: 1, owner: 99, epoch: 1, ..Frame::default() };
                let at = Layout::default().command;
                // It is acknowledged, and refused.
                let _ = of.with(|machine| machine.write(at, &frame.registers(WordOrder::Big)));
            }
            Act::Stray { lasts, .. } => {
                of.with(|machine| machine.stray(true));
                sleep(lasts).await;
                of.with(|machine| machine.stray(false));
            }
            Act::PressStart { .. } => of.with(|machine| machine.press_start()),
            Act::Spoil { .. } => of.with(|machine| machine.spoil()),
            _ => {}
        }
    }

    /// What happens to a server of I++ DME: it is started anew. Of the rest it has nothing.
    async fn at_dme(&self, act: &Act, server: &SharedServer) {
        if let Act::Reboot { .. } = act {
            let now = server.now();
            server.with(|server| server.restart(now));
            let down = Weather { down: true, ..Weather::FAIR };
            self.nets[0].weather(down, Duration::from_millis(500)).await;
        }
    }

    /// What happens to a controller of programs, and what people do at it.
    async fn at_rsh(&self, act: &Act, controller: &SharedController) {
        match act {
            Act::Reboot { .. } => {
                controller.with(Controller::kill);
                let down = Weather { down: true, ..Weather::FAIR };
                self.nets[1].weather(down, Duration::from_secs(1)).await;
                sleep(SET_RIGHT).await;
                controller.with(Controller::make_ready);
            }
            Act::Manual { lasts, .. } => {
                controller.with(|controller| controller.turn_to("MANUAL"));
                sleep(*lasts).await;
                controller.with(|controller| controller.turn_to("AUTO"));
            }
            Act::Supplies { lasts, .. } => {
                controller.with(Controller::switch_off);
                sleep(*lasts).await;
                controller.with(Controller::make_ready);
            }
            Act::Stranger { aborts, .. } => controller.with(|controller| controller.steal(None, *aborts)),
            Act::PressStart { .. } => controller.with(Controller::press_resume),
            // Somebody opens a program of his own.
            Act::Spoil { .. } => {
                let other = self.programs.join("other.ngc");
                std::fs::write(&other, "G21 G90\nG1 X5 F60\nM2\n").unwrap();
                controller.with(|controller| controller.steal(other.to_str(), false));
            }
            _ => {}
        }
    }

    async fn stop_circuit(&self, machine: usize) {
        match &self.plants[machine] {
            Plant::Registers(_) => {}
            Plant::Rsh(controller) => {
                controller.with(Controller::emergency_stop);
                sleep(SET_RIGHT).await;
                controller.with(Controller::make_ready);
            }
            Plant::Dme(server) => {
                let now = server.now();
                server.with(|server| server.emergency_stop(now));
            }
        }
    }

    /// Another program tries to take the machine, and may abort it.
    async fn stranger(&self, which: usize, aborts: bool) {
        let life = Arc::new(Life::new(u64::MAX));
        let settings = ModbusSettings { owner: 99, epoch: 1, ..self.settings[which].clone() };
        let seed = self.number as u64;
        let dial = self.nets[which].dial(&life, None);
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
        give(&orders, &life, &self.given, (what, reason), &self.plants, |reason| match what {
            "hold" => Request::Hold { reason },
            "resume" => Request::Resume { reason, seen: None },
            "stop" => Request::Stop { reason },
            _ => Request::Abort { reason },
        })
        .await;
    }
}
