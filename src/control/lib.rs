//! The door of a running cell: how it is told to people and programs, what they can ask of it, and the socket between.
//!
//! ```text
//!  drive --> Snapshot --> Control ===socket in the run folder=== ask, watch --> terminal, page
//!        <-- Ordered <---/                                  Request -->
//! ```
//!
//! Everybody comes through this one door, so an order is recorded alike whoever gave it: the operating system says who is at the
//! other end, and a program that speaks for others says for whom.

mod door;
mod request;
mod snapshot;
mod socket;

pub use request::{OnBehalf, Reply, Request};
pub use snapshot::{CycleRow, JobProgress, Next, PartVerdict, Snapshot, SoFar};
pub use socket::{Control, DoorChange, Ordered, Watch, ask, ask_at, ask_for, is_live, is_live_at, watch};
