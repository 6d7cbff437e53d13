//! Tests of the drivers, each against machines at the far end of its real connection.

regrind_testcell::program!();

mod contract;
mod exchange;
mod hit_lines;
mod interop;
mod ippdme;
mod modbus;
mod read_ahead;
mod toy;
