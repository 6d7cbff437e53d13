//! Bytes and machines: the two traits behind which a measuring machine and a grinder stand, and the words spoken across them.
//!
//! The cell decides, this room acts. A driver knows one wire: it proves that the right machine is at the far end, carries payloads there
//! and reads them back, gives commands that are values and not pulses, and tells the two kinds of failure apart: *could not talk* and
//! *was told no*. A driver never guesses. When it cannot tell whether a motion was begun it says [`DeviceError::StartUnknown`], and
//! [`Machine::reconcile`] later asks the machine itself.
//!
//! A job runs like this, whatever the wire:
//!
//! ```text
//! connect -> claim -> load_plan / load_pass -> prepare -> (journal the Armed, synced) -> start -> status ... -> collect
//!         -> (journal the result) -> acknowledge
//! ```
//!
//! Everything is in millimetres, seconds and degrees Celsius, and no number that is not finite comes through. This room knows nothing of
//! recipes, cells, surfaces or journals.
//!
//! One value of a driver is used by one task. Its futures may be dropped at any `.await`: a request that is on its way is finished and
//! its answer forgotten, the connection stays in order (but a `start` that is dropped has to be reconciled). To break off a long transfer
//! politely raise its [`Interrupt`].

mod any;
mod codec;
mod error;
pub mod exchange;
mod link;
mod machine;
mod modbus;
mod payload;
mod station;
mod words;

pub use any::{AnyCmm, AnyGrinder};
pub use codec::WordOrder;
pub use error::DeviceError;
pub use link::{Link, LinkFigures, Parity, Wire};
pub use machine::{Cmm, Grinder, Interrupt, Machine};
pub use modbus::{ModbusCmm, ModbusGrinder, ModbusMachine, ModbusSettings, RegisterMap, Signal, SignalType};
pub use payload::{
    Coordinates, CorrectionMap, Identified, MeasuredPoint, Measurement, Pass, PassRecord, Plan, PointStatus, Target,
    TargetKind,
};
pub use words::{
    Answer, Armed, Beats, Command, Fault, Identity, Interlocks, Job, MachineKind, Mode, Outcome, Reading, Reconciled,
    Started, State, Status, digest,
};
