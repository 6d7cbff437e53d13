//! Hit lines: a measuring machine or an arm that prints a line for each touch, on a serial port or through a terminal server, and hears nothing.
//!
//! ```text
//!  format    what a line says, in eight formats, without any wire
//!  lines     bytes put together to lines
//!  list      what is to be touched, what was, and which touch a line is
//!  hearing   a measurement as far as lines have brought it: what each line does to it
//!  link      the port and the thread that listens to it
//!  machine, settings   what the cell sees of it, and what its file says
//! ```
//!
//! A person, or the machine's own part program, leads the probe; nothing is ever sent. docs/hit-lines.md is the page for the shop.

mod format;
mod hearing;
mod lines;
mod link;
mod list;
mod machine;
mod settings;

pub use format::{Hit, LineFlaw, LineFormat, Reading, Separator};
pub use lines::{Gathered, Lines};
pub use link::HitLine;
pub use list::Repeated;
pub use machine::HitLinesCmm;
pub use settings::{Axes, DataBits, HitLinesSettings, HitLinesWire, Mark};
