//! A grinder by LinuxCNC: linuxcncrsh over TCP, which knows programs and no jobs.
//!
//! ```text
//!  protocol          the lines, without any wire
//!  program           the program in the frame by which it writes itself down
//!  link, controller  the connection, and the conversation over it
//!  folder            the folder that both see
//!  work              where the job stands, by what is seen and what is written down
//!  machine, settings           what the cell sees of it, and what its file says
//! ```
//!
//! The driver moves nothing but by a program: it neither homes nor jogs, switches no drive on and takes no stop back. docs/linuxcnc.md is
//! the page for the shop.

mod controller;
mod folder;
mod link;
mod machine;
mod program;
mod protocol;
mod settings;
mod work;

pub use machine::LinuxcncGrinder;
pub use program::{Order, Program, Record};
pub use protocol::{Get, Lines, Mode, Place, Reply, Request, Set, Waiting};
pub use settings::{LinuxcncSettings, LinuxcncWire};
