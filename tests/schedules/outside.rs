//! External acts on the cell, as drawn by a schedule.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use regrind::device::{Link, Machine as _, ModbusCmm, ModbusGrinder, ModbusSettings};
use regrind::drive::{OrderSender, Request};
use regrind_sim::command::{CommandFrame, Mode};
use regrind_sim::dme::Server;
use regrind_sim::options::RegisterLayout;
use regrind_sim::register_encoding::WordOrder;
use regrind_sim::rsh::Controller;
use regrind_sim::wire::SharedMachine;
use regrind_sim::wire::lines::SharedLineServer;
use tokio::time::{Instant, sleep};

use crate::ledger::{Disk, SharedDisk};
use crate::life::Life;
use crate::machines::Plant;
use crate::net::{Net, Weather};
use crate::person::{GivenOrder, give, take_supplies};
use crate::schedule::Act;
use regrind_testcell::wire_faults::{Fault, FaultPlan, SharedFaultPlan, When};

/// Receiver of orders in the current life of the program.
pub type Office = Arc<Mutex<Option<(OrderSender, Arc<Life>)>>>;

/// Intervals in which something obstructed requests to the machines.
pub type Hindered = Arc<Mutex<Vec<(Instant, Instant)>>>;

/// Time limit within which a person restores a machine that has stopped.
const SET_RIGHT: Duration = Duration::from_secs(3);

/// External influence on the cell.
pub struct Outside {
    pub plants: [Plant; 2],
    pub nets: [Net; 2],
    pub faults: [SharedFaultPlan; 2],
    pub disk: SharedDisk,
    pub orders: Office,
    pub given: Arc<Mutex<Vec<GivenOrder>>>,
    pub settings: [ModbusSettings; 2],
    pub is_serial: bool,
    pub hindered: Hindered,
    /// Folder of programs.
    pub programs: PathBuf,
    pub number: usize,
}

impl Outside {
    /// Performs an act, and returns when it is over.
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
            // A silent network has the effect of a frozen server.
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

    /// Performs an act on a register machine.
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
            // A second master on a serial line would corrupt the answers to the first: there is only one master on this
            // type of line.
            Act::Stranger { aborts, .. } if !self.is_serial => self.stranger(machine, aborts).await,
            Act::HighNumber { .. } => {
                let frame =
                    CommandFrame { sequence: u32::MAX - 3, command: 1, owner: 99, epoch: 1, ..CommandFrame::default() };
                let at = RegisterLayout::default().command;
                // The write is acknowledged, and the command is refused.
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

    /// Performs an act on a server of I++ DME: a restart. It ignores all others.
    async fn at_dme(&self, act: &Act, server: &SharedLineServer<Server>) {
        if let Act::Reboot { .. } = act {
            let now = server.now();
            server.with(|server| server.restart(now));
            let down = Weather { down: true, ..Weather::FAIR };
            self.nets[0].weather(down, Duration::from_millis(500)).await;
        }
    }

    /// Performs an act on a controller of programs, or an act of people at it.
    async fn at_rsh(&self, act: &Act, controller: &SharedLineServer<Controller>) {
        match act {
            Act::Reboot { .. } => {
                controller.with(Controller::kill);
                let down = Weather { down: true, ..Weather::FAIR };
                self.nets[1].weather(down, Duration::from_secs(1)).await;
                sleep(SET_RIGHT).await;
                controller.with(Controller::make_ready);
            }
            Act::Manual { lasts, .. } => {
                controller.with(|controller| controller.set_mode("MANUAL"));
                sleep(*lasts).await;
                controller.with(|controller| controller.set_mode("AUTO"));
            }
            Act::Supplies { lasts, .. } => {
                controller.with(Controller::switch_off);
                sleep(*lasts).await;
                controller.with(Controller::make_ready);
            }
            Act::Stranger { aborts, .. } => controller.with(|controller| controller.steal(None, *aborts)),
            Act::PressStart { .. } => controller.with(Controller::press_resume),
            // Somebody opens their own program.
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

    /// Tries to take the machine from another program, and possibly aborts it.
    async fn stranger(&self, which: usize, aborts: bool) {
        let life = Arc::new(Life::new(u64::MAX));
        let settings = ModbusSettings { owner: 99, epoch: 1, ..self.settings[which].clone() };
        let seed = self.number as u64;
        let dial = self.nets[which].connect(&life, None);
        let link =
            Link::with_connector(settings.line.clone(), settings.request_timeout, settings.quarantine, dial, seed);
        // The command is refused if the machine has an owner that is alive; its content does not matter here.
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
            "hold" => Request::Hold { reason, state_number: None },
            "resume" => Request::Resume { reason, state_number: None },
            "stop" => Request::Stop { reason },
            _ => Request::Abort { reason },
        })
        .await;
    }
}
