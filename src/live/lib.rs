//! Live values of a cell for clients of Sparkplug B or OPC UA. Both interfaces are read-only: a command is refused and
//! reported.
//!
//! ```text
//!  Snapshot --> Told --> FIGURES --> Sparkplug B: births, values that change, deaths --> broker
//!                                 \-> OPC UA: nodes and events --> whoever looks
//!  News <-- what was refused, and whether somebody is there <---/
//! ```
#![cfg(feature = "plant")]

mod error;
mod figures;
mod publisher_event;
mod opcua;
mod packml;
mod settings;
mod sparkplug;
mod cell_status;
mod publisher_lock;

pub use error::LiveError;
pub use figures::{FIGURES, Figure, FigureKind, FigureValue};
pub use publisher_event::{PublisherEvent, EventSender, event_queue};
pub use opcua::UaServer;
pub use settings::{OpcUaSettings, SparkplugSettings};
pub use sparkplug::Node;
pub use cell_status::{EndedRun, RunStatus, CellStatus};
pub use publisher_lock::PublisherLock;
