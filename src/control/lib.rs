//! Control interface of a running cell: the state that it publishes, the requests that it accepts, and the socket
//! between it and its clients.
//!
//! ```text
//!  drive --> Snapshot --> Control ===socket in the run folder=== ask, watch --> terminal, page
//!        <-- Ordered <---/                                  Request -->
//! ```
//!
//! All clients use this one interface, so an order is recorded in the same way whoever gave it. The operating system
//! identifies the user of the client. A program that acts for other people names the person.

mod endpoint;
mod machine_status;
mod request;
mod snapshot;
mod socket;

pub use regrind_cell::CycleRow;

pub use machine_status::{MachineStatus, MachineValue, ValueKind};
pub use request::{OnBehalf, PreliminaryTouches, Reply, Request};
pub use snapshot::{JobProgress, NextStep, PartVerdict, PreviewStatistics, Snapshot};
pub use socket::{
    Control, EndpointChange, ReceivedOrder, StatusStream, is_live, is_live_at, send_request, send_request_at,
    send_request_on_behalf, watch,
};
