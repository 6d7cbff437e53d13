//! Simulated machines for tests: the client's end of their payloads, machines without errors, and faults of a wire.

pub mod payloads;
pub mod perfect;
pub mod wire_faults;
