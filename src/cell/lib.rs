//! State machine of the cell: it decides the next command.
//!
//! The input is [`Event`]s and the output is [`Command`]s. One function, [`Cell::handle`], maps the first to the second
//! by a transition table. It uses no clock, no network and no file. The time since the run began is an argument, and
//! [`Cell::next_deadline`] is the only timer. So a run can be replayed from its journal, and every pair of state and
//! event can be tested.
//!
//! Sequence of a run: *Starting* connects both machines. A cycle is Load (in the first cycle only), Grind, Transfer,
//! Measure, Register, Judge; after that comes Compensate and the next cycle, or the end. A job of a machine has these
//! steps: send the payload, check by a fresh status that the other machine is clear of the part, prepare, start, run,
//! collect, acknowledge.
//!
//! There are four different interruptions. *Hold* comes from inside or from a person. It lets a running job come to its
//! safe place, or a computation end, and waits for a person. *Suspend* comes from outside; the cell resumes by itself.
//! *Stop* ends in order. *Abort*, and every fault of a machine, runs only the safe sequence: both machines get ABORT,
//! and the cell then checks that they are clear, within bounded time. If they do not confirm, the alarm names the
//! machine's own emergency circuit.
//!
//! The cell starts a machine at most once for a cycle. Only the machine's own proof that START was not taken allows
//! another START. A measurement that failed its gate is repeated under the next cycle number. A pass is never repeated.

mod alarm;
mod cell;
mod command;
mod connections;
mod cycle_row;
mod ending;
mod event;
mod interruptions;
mod judge;
mod machine_job;
mod measurement;
mod phase_queries;
mod plan;
mod run_sequence;
mod state;
mod state_machine;
mod table;
mod time_limits;

pub use alarm::{Alarm, AlarmId, Role};
pub use cell::Cell;
pub use command::{Command, Ending, Judgement, Verdict};
pub use cycle_row::CycleRow;
pub use event::{
    Actor, CompensationRefusal, CompensationSummary, Condition, ConnectionRefusal, Event, Figures, FurtherTouches,
    GateFailure, GateResult, JobResult, MachineRequest, Occupation, OutlierFigures, Reconciliation, RecordFailure,
    RecordedParameter,
};
pub use judge::{ComparedFigure, Conformity};
pub use plan::{CellPlan, Deadlines, FirstStep, GateLimits, HoldOrStop, PvPoints, Tolerance};
pub use state::{Device, JobStep, Phase, State, StateName};
pub use table::{Reaction, TABLE_VERSION, TransitionRow, sample_events, transition_table};
