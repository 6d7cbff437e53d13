//! Hit lines: driver of a measuring machine or an arm that prints a line for each touch, on a serial port or through a
//! terminal server, and receives nothing.
//!
//! ```text
//!  format    content of a line, in eight formats, without any I/O
//!  lines     splitting of bytes into lines
//!  list      targets, touches, and the assignment of lines to targets
//!  hearing   state of a measurement, and its change by each line
//!  link      the port and the thread that listens to it
//!  machine, settings   the machine as the cell sees it, and its settings
//!  wire                its table of the cell file, and the factory of its driver
//! ```
//!
//! A person, or the machine's own part program, leads the probe; nothing is ever sent. Page for the shop:
//! docs/hit-lines.md.

mod job;
mod line_splitter;
mod link;
mod machine;
mod protocol;
mod settings;
mod target_list;
mod wire;

pub use line_splitter::{LineSplitter, ReceivedLine};
pub use link::HitSource;
pub use machine::HitLinesCmm;
pub use protocol::{Hit, LineError, LineFormat, LineParser, Separator};
pub use settings::HitLinesSettings;
pub use target_list::Repeated;
pub use wire::{Axes, DataBits, HitLinesWire, Mark};
