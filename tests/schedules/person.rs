//! The person at the cell: gives the orders that the schedule draws, and resumes the cell wherever it waits for a
//! person.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use regrind::cell::{Actor, Device, StateName};
use regrind::drive::{OrderSender, Request};
use regrind_control::NextStep;
use regrind_sim::command::interlock;
use regrind_sim::wire::SharedMachine;
use tokio::time::Instant;

use crate::life::Life;
use crate::machines::Plant;

/// Number of resumes after which the person ends the run in order; after twice as many, the person aborts.
const PATIENCE: u32 = 40;

/// Time after which the person gives up an unfinished run too: waiting does not return a machine that another program
/// controls.
const NO_LONGER_THAN: Duration = Duration::from_secs(1200);

/// Order, and the cell's answer.
#[derive(Clone, Debug)]
pub struct GivenOrder {
    pub at: Instant,
    pub answered: Instant,
    pub what: &'static str,
    /// Reason that identifies the order in the record.
    pub reason: String,
    pub accepted: bool,
    /// True if the order was carried out, on record or not.
    pub done: bool,
    /// True for the grinder, and for the CMM, if it moved when the order was given.
    pub moved: [bool; 2],
}

pub fn actor() -> Actor {
    Actor { name: "a person".into(), station: "here".into() }
}

pub struct Person {
    pub plants: [Plant; 2],
    pub given: Arc<Mutex<Vec<GivenOrder>>>,
    chance: StdRng,
    resumes: u32,
    began: Instant,
}

impl Person {
    pub fn new(plants: [Plant; 2], seed: u64) -> Self {
        Self { plants, given: Arc::default(), chance: StdRng::seed_from_u64(seed), resumes: 0, began: Instant::now() }
    }

    /// Attends to the cell in one life of the program; never returns.
    pub async fn attend(&mut self, orders: &OrderSender, life: &Life) {
        let status = orders.status();
        loop {
            let pause = Duration::from_millis(self.chance.random_range(50..1500));
            tokio::time::sleep(pause).await;
            let (state, number, phase, next) = {
                let seen = status.borrow();
                (seen.state, seen.state_number, seen.phase, seen.next_step.clone())
            };
            if let NextStep::SeeClear { device } = next {
                self.see_clear(orders, life, device).await;
            }
            if state != StateName::Held {
                continue;
            }
            self.resumes += 1;
            let is_long = self.began.elapsed() > NO_LONGER_THAN;
            if self.resumes > 2 * PATIENCE || is_long {
                self.give(orders, life, "abort", |reason| Request::Abort { reason }).await;
            } else if self.resumes > PATIENCE {
                self.give(orders, life, "stop", |reason| Request::Stop { reason }).await;
            } else {
                if let Some(device) = phase.and_then(|phase| phase.moving_device()) {
                    self.look_at(orders, life, device).await;
                }
                self.give(orders, life, "resume", |reason| Request::Resume { reason, state_number: Some(number) })
                    .await;
            }
        }
    }

    /// Confirms that a machine is clear of the part, if it cannot report it: the person looks, moves it away, and
    /// confirms.
    async fn see_clear(&mut self, orders: &OrderSender, life: &Life, device: Device) {
        let plant = &self.plants[device as usize];
        if !plant.moves() {
            plant.moved_away();
            self.give(orders, life, "clear", |_| Request::Clear { device }).await;
        }
    }

    /// Confirms the end of a job that a machine cannot report: the person looks whether the machine is at a standstill,
    /// and confirms.
    async fn look_at(&mut self, orders: &OrderSender, life: &Life, device: Device) {
        if self.resumes.is_multiple_of(4) && self.plants[device as usize].is_over() {
            self.give(orders, life, "over", |evidence| Request::Over { device, evidence }).await;
        }
    }

    /// Gives an order and records the answer.
    pub async fn give(
        &mut self,
        orders: &OrderSender,
        life: &Life,
        what: &'static str,
        request: impl FnOnce(String) -> Request,
    ) {
        let number = self.given.lock().unwrap().len();
        give(orders, life, &self.given, (what, format!("order {number}")), &self.plants, request).await;
    }
}

/// Gives an order and records the answer, unless the program dies during it.
pub async fn give(
    orders: &OrderSender,
    life: &Life,
    given: &Mutex<Vec<GivenOrder>>,
    (what, reason): (&'static str, String),
    plants: &[Plant; 2],
    request: impl FnOnce(String) -> Request,
) {
    let at = Instant::now();
    let moved = [0, 1].map(|k: usize| plants[k].moves());
    let reply = orders.send_and_wait(request(reason.clone()), actor()).await;
    let Some(reply) = reply.filter(|_| !life.is_dead()) else { return };
    let accepted = reply.accepted;
    let done = accepted || reply.message.contains("make the cell safe");
    given.lock().unwrap().push(GivenOrder { at, answered: Instant::now(), what, reason, accepted, done, moved });
}

/// Opens the interlock of air and coolant of a machine.
pub fn take_supplies(machine: &SharedMachine, away: bool) {
    machine.with(|machine| machine.open_interlocks(if away { interlock::SUPPLIES } else { 0 }));
}
