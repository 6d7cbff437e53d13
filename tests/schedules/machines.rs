//! The two machines of a cell, their time, and what they did.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use regrind_sim::command::State;
use regrind_sim::options::MachineOptions;
use regrind_sim::registers::Machine;
use regrind_sim::seen::What;
use regrind_sim::spec::WorldSpec;
use regrind_sim::wire::{SharedMachine, Units};
use regrind_sim::world::World;
use serde::Deserialize;
use tokio::time::Instant;

use crate::cue::Cues;
use crate::part::{Wanted, setting};

/// How often their time passes.
const TICK: Duration = Duration::from_millis(10);

/// Something that a machine saw or did.
#[derive(Clone, Debug)]
pub struct Moment {
    pub at: Instant,
    /// 0 is the CMM, 1 the grinder.
    pub machine: usize,
    pub what: What,
}

/// What both did, in order.
pub type Log = Arc<Mutex<Vec<Moment>>>;

pub struct Machines {
    pub shared: [SharedMachine; 2],
    pub log: Log,
}

impl Machines {
    /// Switches both on, so many times as fast as real ones; trusting ones do not see to it themselves that nothing comes twice.
    pub fn new(seed: u64, speed: f64, trusting: bool, cues: &Cues) -> Self {
        let truth = setting(Wanted::Good).recipe.simulation.clone().unwrap();
        let mut spec = WorldSpec::deserialize(toml::Value::Table(truth)).unwrap();
        spec.seed = 1 + seed % 7;
        let world = World::new(spec).unwrap();
        let options = |seed| MachineOptions { speed, seed, trusting, ..MachineOptions::default() };
        let cmm = Machine::new(Box::new(world.cmm()), 71, options(seed ^ 0xC));
        let grinder = Machine::new(Box::new(world.grinder()), 72, options(seed ^ 0x6));
        let log = Log::default();
        let mut number = 0;
        let shared = [cmm, grinder].map(|mut machine| {
            let (log, of, cues) = (log.clone(), number, cues.clone());
            number += 1;
            machine.witness(Box::new(move |seen| {
                cues.see_machine(&seen.what);
                log.lock().unwrap().push(Moment { at: Instant::now(), machine: of, what: seen.what.clone() });
            }));
            SharedMachine::from(machine)
        });
        Self { shared, log }
    }

    /// Returns the units behind the wire of a machine.
    pub fn units(&self, which: usize) -> Units {
        vec![(which as u8 + 1, self.shared[which].clone())]
    }

    /// Lets their time pass.
    pub async fn live(shared: [SharedMachine; 2]) {
        let mut ticks = tokio::time::interval(TICK);
        loop {
            ticks.tick().await;
            shared.iter().for_each(|machine| machine.with(|machine| machine.tick(TICK)));
        }
    }
}

/// Whether a machine may be moving in a state.
pub fn moves(state: State) -> bool {
    matches!(state, State::Execute | State::Holding | State::Stopping | State::Aborting)
}
