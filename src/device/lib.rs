//! Machine drivers: the two traits of a measuring machine and of a grinder, and the types that they exchange.
//!
//! The cell decides, this crate acts. A driver knows one wire. It proves that the right machine is at the far end,
//! carries payloads there and reads them back, and gives commands that are values and not pulses. It distinguishes two
//! kinds of failure: *the communication failed* and *the machine refused*. A driver never guesses. If it cannot
//! determine whether a motion was begun, it returns [`DeviceError::StartUnknown`], and [`Machine::reconcile`] later
//! asks the machine itself.
//!
//! A job runs as follows, whatever the wire:
//!
//! ```text
//! connect -> claim -> load_plan / load_pass -> prepare -> (journal the Armed, synced) -> start -> status ...
//!         -> collect -> (journal the result) -> acknowledge
//! ```
//!
//! All values are in millimetres, seconds and degrees Celsius. No number that is not finite passes. This crate knows
//! nothing of recipes, cells, surfaces or journals. A value that a machine cannot report is unknown, and is never
//! filled in here.
//!
//! A driver is a folder of this crate and a line in [`table`](self::Wire). The folder owns the table `wire` of a cell
//! file ([`DriverFactory`]), its checks, and the machines that are made from it.
//!
//! One value of a driver is used by one task. Its futures may be dropped at any `.await`: a request that is under way
//! is completed, its answer is discarded, and the connection stays valid. A `start` that is dropped has to be
//! reconciled. To interrupt a long transfer in order, raise its [`Interrupt`].

mod driver_factory;
mod driver_table;
mod error;
pub mod file_exchange;
mod handshake;
pub mod hit_lines;
pub mod ippdme;
mod job_memory;
pub mod linuxcnc;
mod machine;
mod machine_table;
mod manual;
mod modbus;
mod network_address;
mod no_machine;
mod payload;
mod plan_mismatch;
mod range;

pub use driver_factory::{ConnectionCheck, DriverContext, DriverError, DriverFactory, Timing};
pub use driver_table::{AnyCmm, AnyGrinder, Wire};
pub use error::DeviceError;
use error::DeviceResult;
pub use handshake::{
    Answer, Armed, BatchId, Fault, Identity, Job, MachineCommand, MachineKind, MachineState, OperatorConfirmation,
    Outcome, Reconciled, SignalValue, Started, Status, digest,
};
pub use hit_lines::{HitLinesCmm, HitLinesSettings, HitLinesWire, HitSource};
pub use ippdme::{IppdmeCmm, IppdmeSettings, IppdmeWire, Scanning};
pub use linuxcnc::{LinuxcncGrinder, LinuxcncSettings, LinuxcncWire};
pub use machine::{Cmm, Grinder, Interrupt, Machine};
pub use machine_table::MachineTable;
pub use manual::{ManualMachine, ManualSettings, ManualWire};
#[cfg(fuzzing)]
pub use modbus::any_registers;
pub use modbus::{
    ConnectFuture, Connector, LineAddress, LineStream, Link, LinkStatistics, ModbusCmm, ModbusGrinder, ModbusMachine,
    ModbusSettings, Parity, RegisterMap, RtuWire, Signal, SignalTable, SignalType, TcpWire, WordOrder,
};
pub use payload::{
    CarefulStart, CorrectionMap, Identified, MeasuredPoint, Measurement, Pass, PassRecord, Plan, PlanTarget,
    PreliminaryPoints, TargetKind, TouchStatus,
};
pub use plan_mismatch::PlanMismatch;
pub use range::{RANGES, ValueRange};
pub use regrind_formats::result::Coordinates;
