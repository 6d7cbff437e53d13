//! Commands of I++ DME: the client writes them strictly and reads them as a server does.

use std::fmt;

use super::syntax::{Item, Tag, list};

/// Maximum number of characters in a line, without the line end.
pub const MAX_LINE_LENGTH: usize = 65_536;

/// Command without its tag.
#[derive(Clone, Debug, PartialEq)]
pub struct DmeCommand {
    /// Name of the command, for example `PtMeas`.
    pub name: String,
    /// Arguments in its parentheses.
    pub arguments: Vec<Item>,
}

impl DmeCommand {
    /// Creates a command from its name and arguments.
    pub fn new(name: &str, arguments: Vec<Item>) -> Self {
        Self { name: name.to_owned(), arguments }
    }

    /// Returns true for an event command: its name ends in a capital E, and the server executes it while other commands
    /// run.
    pub fn is_event(&self) -> bool {
        self.name.ends_with('E')
    }

    /// Returns the command as a line, with its tag and its line end.
    pub fn line(&self, tag: Tag) -> String {
        format!("{tag} {self}\r\n")
    }
}

impl fmt::Display for DmeCommand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}({})", self.name, list(&self.arguments))
    }
}
