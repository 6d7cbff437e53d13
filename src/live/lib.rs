//! Live values of a cell for clients of Sparkplug B or OPC UA. Both interfaces are read-only: a command is refused and
//! reported.
//!
//! ```text
//!  Snapshot --> CellStatus --> FIGURES --> Sparkplug B: births, changed values, deaths --> broker
//!                                       \-> OPC UA: nodes and events --> clients
//!  PublisherEvent <-- refused requests, and whether the publisher is connected <--/
//! ```
#![cfg(feature = "plant")]

mod cell_status;
mod error;
mod figures;
mod opcua;
mod packml;
mod publisher_event;
mod publisher_lock;
mod settings;
mod sparkplug;

pub use cell_status::{CellStatus, EndedRun, RunStatus};
pub use error::LiveError;
pub use figures::{FIGURES, Figure, FigureKind, FigureValue};
pub use opcua::UaServer;
pub use publisher_event::{EventSender, PublisherEvent, event_queue};
pub use publisher_lock::PublisherLock;
pub use settings::{OpcUaSettings, SparkplugSettings};
pub use sparkplug::Node;
