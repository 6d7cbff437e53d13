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
mod news;
mod opcua;
mod packml;
mod settings;
mod sparkplug;
mod told;
mod turn;

pub use error::LiveError;
pub use figures::{FIGURES, Figure, FigureKind, FigureValue};
pub use news::{News, Notes, notes};
pub use opcua::UaServer;
pub use settings::{OpcUaSettings, SparkplugSettings};
pub use sparkplug::Node;
pub use told::{Ended, Now, Told};
pub use turn::Turn;
