//! Drivers of docs/modbus.md: a measuring machine and a grinder with Modbus registers.
//!
//! Both machines differ only in their payloads, so nearly everything is in [`ModbusMachine`]. It follows the page
//! literally:
//!
//! * A command is a value with a number. It is written until it is acknowledged.
//! * Payloads are sent in pages. The slots in force are read back and compared.
//! * Results are read in pages between two readings of their header.
//!
//! Only START is never repeated under a new number. Its frame may be written again with the same number. If that does
//! not give an answer either, the outcome is unknown and stays unknown until the machine is asked.

#[cfg(any(test, fuzzing))]
mod any_registers;
mod commands;
mod drivers;
mod link;
mod machine;
mod pages_ahead;
mod parity;
mod payload_transfer;
mod protocol;
mod read_ahead;
mod result_header;
mod result_transfer;
pub(crate) mod serial_port;
mod settings;
mod signal;
mod status_block;
mod unit;
mod wire;

#[cfg(fuzzing)]
pub use any_registers::any_registers;
pub use drivers::{ModbusCmm, ModbusGrinder};
pub(crate) use link::SystemConnector;
pub use link::{ConnectFuture, Connector, LineStream, Link, LinkStatistics};
pub use machine::ModbusMachine;
pub use parity::Parity;
pub use settings::{
    LineAddress, ModbusSettings, RegisterMap, RtuWire, Signal, SignalTable, SignalType, TcpWire, WordOrder,
};
