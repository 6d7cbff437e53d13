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
//! recipes, cells, surfaces or journals. What a machine cannot tell is unknown, and is never filled in here.
//!
//! A driver is a folder of this room and a line in [`table`](self::Wire): the folder owns what a cell file says of it ([`Wired`]), how
//! that is checked, and the machines that are made of it.
//!
//! One value of a driver is used by one task. Its futures may be dropped at any `.await`: a request that is on its way is finished and
//! its answer forgotten, the connection stays in order (but a `start` that is dropped has to be reconciled). To break off a long transfer
//! politely raise its [`Interrupt`].

mod beside_plan;
mod error;
pub mod exchange;
pub mod hit_lines;
pub mod ippdme;
mod kept;
pub mod linuxcnc;
mod machine;
mod manual;
mod modbus;
mod no_machine;
mod payload;
mod place;
mod range;
mod table;
mod wiring;
mod words;

pub use beside_plan::BesidePlan;
use error::Answered;
pub use error::DeviceError;
pub use hit_lines::{HitLine, HitLinesCmm, HitLinesSettings, HitLinesWire};
pub use ippdme::{IppdmeCmm, IppdmeSettings, IppdmeWire, Scanning};
pub use linuxcnc::{LinuxcncGrinder, LinuxcncSettings, LinuxcncWire};
pub use machine::{Cmm, Grinder, Interrupt, Machine};
pub use manual::{ManualMachine, ManualSettings, ManualWire};
#[cfg(fuzzing)]
pub use modbus::any_registers;
pub use modbus::{
    Dial, Dialled, Line, LineStream, Link, LinkFigures, ModbusCmm, ModbusGrinder, ModbusMachine, ModbusSettings,
    Parity, RegisterMap, RtuWire, Signal, SignalTable, SignalType, TcpWire, WordOrder,
};
pub use payload::{
    Careful, CorrectionMap, Identified, MeasuredPoint, Measurement, Pass, PassRecord, Plan, PointStatus, Preliminary,
    Target, TargetKind,
};
pub use place::Place;
pub use range::{RANGES, Range};
pub use regrind_formats::result::Coordinates;
pub use table::{AnyCmm, AnyGrinder, Wire};
pub use wiring::{Making, MakingError, Timing, Wired};
pub use words::hex;
pub use words::{
    Answer, Armed, Command, Fault, Identity, Job, MachineKind, Number, Outcome, Reconciled, SignalValue, Started,
    State, Status, Word, digest,
};
