//! I++ DME over TCP: driver of a measuring machine whose server stores no job. This program carries out the plan, touch
//! by touch.
//!
//! ```text
//!  text, command, grammar, response   the lines, without any wire
//!  session                            commands one after another, and the abort, which waits for none
//!  route                              the route over the targets, checked against the volume before the first motion
//!  work, scan                         execution of a job by the task that owns the session: touches and scanned rows
//!  machine, settings                  the machine as the cell sees it, and its settings
//!  wire                               its table of the cell file, and the factory of its driver
//! ```
//!
//! Page for the shop: docs/ippdme.md.

mod command;
mod grammar;
mod job;
mod link;
mod machine;
mod response;
mod route;
mod scan;
mod settings;
mod syntax;
mod wire;

pub use command::{DmeCommand, MAX_LINE_LENGTH};
pub use link::Limits;
pub use machine::IppdmeCmm;
pub use response::{DmeResponse, ResponseContent, ServerError, value, values};
pub use settings::{IppdmeSettings, Scanning};
pub use syntax::{Item, SyntaxError, Tag, number};
pub use wire::IppdmeWire;

/// Returns the command name as a static string, for messages that hold no owned strings. Returns `"a command"` for an
/// unknown name.
fn static_command_name(name: &str) -> &'static str {
    grammar::names().find(|known| *known == name).unwrap_or("a command")
}
