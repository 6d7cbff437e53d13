//! The machine that decides what to do next.
//!
//! Facts come in as [`Event`]s, imperatives go out as [`Command`]s, and between them stands one table: [`Cell::handle`]. It has no
//! clock, no wire and no file; the time since the run began comes in as an argument, [`Cell::next_deadline`] is its only timer.
//! So a run can be replayed from its journal, and every pair of state and event can be tried.
//!
//! A run: *Starting* connects both machines. A cycle is Load (the first only), Grind, Transfer, Measure, Register, Judge, and
//! then Compensate and the next cycle, or the end. A job of a machine goes in steps: send the payload, see by a fresh status that
//! the other machine is clear of the part, prepare, start, run, collect, acknowledge.
//!
//! Four ways to interrupt it are kept apart. *Hold* comes from inside or from a person, lets what runs come to its safe place or
//! the computation to its end, and waits for a person. *Suspend* comes from outside and goes on by itself. *Stop* ends in
//! order. *Abort*, and every fault of a machine, sends the safe sequence and nothing else: both machines are told to abort, then
//! seen to be clear, within bounded time; if they do not confirm, the alarm names the machine's own emergency circuit.
//!
//! A machine is started at most once for a cycle. Only the machine's own proof that START was not taken allows another; a
//! measurement that failed its gate is repeated under the next number, and a pass is never repeated.

mod act;
mod alarm;
mod command;
mod event;
mod figure;
mod judge;
mod machine;
mod memory;
mod number;
mod plan;
mod state;
mod table;

pub use alarm::{Alarm, AlarmId, Role};
pub use command::{Command, Ending, Judgement, Verdict};
pub use event::{
    Actor, Asked, CompensationRefusal, CompensationSummary, Condition, Event, Figures, Forecast, FormFigures, Gate,
    GateFailure, JobResult, LeftOut, Mismatch, Occupation, ParameterTold, Reconciliation, RecordFailure, Response,
    TouchOn,
};
pub use figure::Interval;
pub use judge::{Compared, Conformity};
pub use memory::Cell;
pub use plan::{Beginning, CellPlan, Deadlines, Disposal, Gates, PvOf, Tolerance};
pub use state::{Device, JobStep, Phase, State, StateName};
pub use table::{Answer, Row, TABLE_VERSION, samples, table};
