//! The simulated machines: what they do to a part, and what stands on their wires.

mod closing_the_loop;
mod common;
mod counter;
mod desk;
mod executed;
mod grinding;
mod machines;
mod measuring;
mod payloads;
mod registers;
mod wires;
