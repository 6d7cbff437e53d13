//! The table.

use std::time::Duration;

use super::command::Command;
use super::event::Event;
use super::plan::CellPlan;
use super::state::State;

/// A cell in the middle of a run.
#[derive(Clone, Debug)]
pub struct Cell {
    plan: CellPlan,
    state: State,
    cycle: u32,
    deadline: Option<Duration>,
}

impl Cell {
    /// Returns a cell that waits for `Event::Start`.
    pub fn new(plan: CellPlan) -> Self {
        Self { plan, state: State::Idle, cycle: 0, deadline: None }
    }

    /// Returns the state.
    pub fn state(&self) -> State {
        self.state
    }

    /// Returns the number of the cycle; 0 before the first.
    pub fn cycle(&self) -> u32 {
        self.cycle
    }

    /// Returns the plan.
    pub fn plan(&self) -> &CellPlan {
        &self.plan
    }

    /// Returns when `Event::Deadline` is due, as time since the run began.
    pub fn next_deadline(&self) -> Option<Duration> {
        self.deadline
    }

    /// Takes an event in and returns what is to be done, in this order. After an end state that is nothing.
    pub fn handle(&mut self, _now: Duration, event: Event) -> Vec<Command> {
        let why = "the table is not written yet".to_owned();
        vec![Command::Refuse { event: Box::new(event), state: self.state, why }]
    }
}
