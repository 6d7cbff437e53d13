//! I++ DME over TCP: a measuring machine whose server keeps no job, so that this program carries out the plan, touch by touch.
//!
//! ```text
//!  text, command, grammar, response   the lines, without any wire
//!  session                            one command after another, and the abort that waits for none
//!  route                              the way over the targets, held against the volume before the first motion
//!  work, scan                         a job, carried out by the task that owns the session: touches, and rows that are scanned
//!  machine, settings                  what the cell sees of it, and what its file says
//! ```
//!
//! docs/ippdme.md is the page for the shop.

mod command;
mod grammar;
mod machine;
mod response;
mod route;
mod scan;
mod session;
mod settings;
mod text;
mod work;

pub use command::{Command, LONGEST_LINE};
pub use machine::IppdmeCmm;
pub use response::{Response, Said, ServerError, value, values};
pub use session::Limits;
pub use settings::{IppdmeSettings, IppdmeWire, Scanning};
pub use text::{Flaw, Item, Tag, number};

/// The name of a command, for messages that keep no strings.
fn known(name: &str) -> &'static str {
    grammar::names().find(|known| *known == name).unwrap_or("a command")
}
