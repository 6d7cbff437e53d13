//! The simulated machines: what they do to a part, and what stands on their wires.

#[path = "../../../tests/common/payloads.rs"]
mod client_payloads;
mod closing_the_loop;
mod common;
mod counter;
mod desk;
mod executed;
mod grinding;
mod machines;
mod measuring;
mod payloads;
#[path = "../../../tests/common/perfect.rs"]
mod perfect;
mod registers;
#[path = "../../../tests/common/wire_faults.rs"]
mod wire_faults;
mod wires;
