//! Driver of a grinder under LinuxCNC: linuxcncrsh over TCP, which knows programs but no jobs.
//!
//! ```text
//!  protocol          the lines, without any wire
//!  program           the program in a frame that records its progress
//!  link, controller  the connection, and the exchange over it
//!  folder            the folder that this computer and the controller see
//!  work              state of the job, from the observed state and the record
//!  machine, settings           the machine as the cell sees it, and its settings
//!  wire                        its table of the cell file, and the factory of its driver
//! ```
//!
//! The driver moves the machine only by a program: it does not home, jog, switch a drive on or reset a stop. Page for
//! the shop: docs/linuxcnc.md.

mod controller;
mod folder;
mod job;
mod link;
mod machine;
mod program;
mod protocol;
mod settings;
mod wire;

pub use machine::LinuxcncGrinder;
pub use program::{FramedProgram, ProgramInputs, ProgramRecord};
pub use protocol::{ControllerMode, Get, LineMatch, LineSplitter, PendingRequests, RshReply, RshRequest, Set};
pub use settings::LinuxcncSettings;
pub use wire::LinuxcncWire;
