//! What acts upon the cell from outside, as a schedule has drawn it.

use std::sync::{Arc, Mutex};

use regrind::device::{Link, Machine as _, ModbusCmm, ModbusGrinder, ModbusSettings};
use regrind::drive::{Orders, Request};
use regrind_sim::command::{Frame, Mode};
use regrind_sim::options::Layout;
use regrind_sim::wire::SharedMachine;
use regrind_sim::words::WordOrder;
use tokio::time::{Instant, sleep};

use crate::ledger::{Disk, SharedDisk};
use crate::life::Life;
use crate::net::Net;
use crate::person::{Given, give, take_supplies};
use crate::schedule::Act;

/// Where orders are taken, in the life of the program that is under way.
pub type Office = Arc<Mutex<Option<(Orders, Arc<Life>)>>>;

/// From when to when something was in the way of what is asked of the machines.
pub type Hindered = Arc<Mutex<Vec<(Instant, Instant)>>>;

/// What acts upon the cell from outside.
pub struct Outside {
    pub shared: [SharedMachine; 2],
    pub nets: [Net; 2],
    pub disk: SharedDisk,
    pub orders: Office,
    pub given: Arc<Mutex<Vec<Given>>>,
    pub settings: [ModbusSettings; 2],
    pub is_serial: bool,
    pub hindered: Hindered,
    pub number: usize,
}

impl Outside {
    /// Lets it happen, and comes back when it is over.
    pub async fn act(self, act: Act) {
        if let Some(lasts) = act.hinders() {
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
            Act::Stray { machine, lasts } => {
                self.shared[machine].with(|machine| machine.stray(true));
                sleep(lasts).await;
                self.shared[machine].with(|machine| machine.stray(false));
            }
            Act::PressStart { machine } => self.shared[machine].with(|machine| machine.press_start()),
            Act::Spoil { machine } => self.shared[machine].with(|machine| machine.spoil()),
            Act::Suspend { lasts } => tokio::time::advance(lasts).await,
            Act::Order(what) => self.order(what).await,
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
        give(&orders, &life, &self.given, (what, reason), &self.shared, |reason| match what {
            "hold" => Request::Hold { reason },
            "resume" => Request::Resume { reason, seen: None },
            "stop" => Request::Stop { reason },
            _ => Request::Abort { reason },
        })
        .await;
    }
}
