//! Tests of the drivers, each against machines at the far end of its real connection.

mod contract;
mod exchange;
mod hit_lines;
mod interop;
mod ippdme;
#[path = "../common/keep.rs"]
mod keep;
mod modbus;
#[path = "../common/perfect.rs"]
mod perfect;
#[path = "../common/program.rs"]
mod program;
mod read_ahead;
mod toy;
#[path = "../common/wire_faults.rs"]
mod wire_faults;
