//! Cells for tests, benches and examples: the program as a process, a simulated cell in the process of a test, and
//! cycles without wires. Every crate that uses it compiles it once.

pub mod browser;
pub mod http;
pub mod outlived;
pub mod program;
pub mod rig;
pub mod study;
mod through;
pub mod tries;

pub use regrind_testsim::{payloads, perfect, wire_faults};
