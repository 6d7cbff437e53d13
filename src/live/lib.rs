//! Live values of a cell for clients of Sparkplug B or OPC UA, and for agents of MTConnect. All interfaces are read-only:
//! a command is refused and reported.
//!
//! ```text
//!  Snapshot --> TimedStatus --> FIGURES --> Sparkplug B: births, changed values, history, deaths --> broker
//!                                       \-> OPC UA: nodes and events --> clients
//!           TimedStatus --> ITEMS      --> MTConnect: lines of SHDR --> agents
//!  PublisherEvent <-- refused requests, and whether the publisher is connected <--/
//! ```
#![cfg(feature = "plant")]

mod cell_status;
mod error;
mod figures;
mod mtconnect;
mod opcua;
mod packml;
mod publisher_event;
mod publisher_lock;
mod settings;
mod sparkplug;
mod status_feed;

pub use cell_status::{CellStatus, EndedRun, RunStatus, TimedStatus};
pub use error::LiveError;
pub use figures::{FIGURES, Figure, FigureKind, FigureValue};
pub use mtconnect::{Adapter, devices_file};
pub use opcua::UaServer;
pub use publisher_event::{EventSender, PublisherEvent, event_queue};
pub use publisher_lock::PublisherLock;
pub use settings::{MtConnectSettings, OpcUaSettings, SparkplugSettings};
pub use sparkplug::Node;
pub use status_feed::{StatusReceiver, StatusSender, status_feed};
