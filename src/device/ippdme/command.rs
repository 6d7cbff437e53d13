//! Commands of I++ DME: the client writes them strictly and reads them as a server does.

use std::fmt;

use super::grammar;
use super::syntax::{Item, Reader, Strictness, SyntaxError, Tag, arguments, has_stray_blank, list};

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

    /// Parses a command line from a client, as strictly as an I++ DME server must. `line` has no line end. Returns the
    /// tag and the command.
    ///
    /// # Errors
    /// Returns the I++ DME error number with which a server refuses the line, and the reason.
    pub fn read(line: &str) -> Result<(Tag, Self), SyntaxError> {
        if line.len() > MAX_LINE_LENGTH {
            return Err(SyntaxError { number: 8, reason: "a line of more than 65536 characters" });
        }
        if !line.bytes().all(|b| (32..=126).contains(&b)) {
            return Err(SyntaxError { number: 7, reason: "a character that is not ASCII 32 to 126" });
        }
        let (tag, rest) = tagged(line)?;
        if has_stray_blank(rest) {
            return Err(arguments("a blank that is not allowed"));
        }
        let mut reader = Reader::new(rest, Strictness::Strict);
        let command = Self::untagged(&mut reader)?;
        if !reader.is_at_end() {
            return Err(SyntaxError { number: 507, reason: "there is text after the command" });
        }
        if command.is_event() != matches!(tag, Tag::Event(_)) {
            return Err(SyntaxError { number: 1, reason: "only a command whose name ends in E has an event tag" });
        }
        grammar::check(&command)?;
        Ok((tag, command))
    }

    fn untagged(reader: &mut Reader<'_>) -> Result<Self, SyntaxError> {
        let illegal = |reason| SyntaxError { number: 507, reason };
        let text = reader.rest();
        let end = text.bytes().position(|b| !b.is_ascii_alphanumeric()).unwrap_or(text.len());
        let name = &text[..end];
        if !grammar::is_known(name) {
            return Err(illegal("an unknown command"));
        }
        *reader = Reader::new(&text[end..], Strictness::Strict);
        if !reader.eat('(') {
            return Err(arguments("a command without parentheses"));
        }
        Ok(Self::new(name, reader.in_parentheses()?))
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

/// Splits `line` into the tag and the rest of the line. The tag has five characters, and one blank follows.
///
/// # Errors
/// Returns an error if the tag is invalid, if its number is 0, or if no blank follows the tag.
fn tagged(line: &str) -> Result<(Tag, &str), SyntaxError> {
    let illegal = SyntaxError { number: 1, reason: "an invalid tag" };
    let tag = line.get(..5).and_then(Tag::read).ok_or(illegal)?;
    if matches!(tag, Tag::Command(0) | Tag::Event(0)) {
        return Err(SyntaxError { number: 1, reason: "tags count from 1" });
    }
    let rest = line[5..].strip_prefix(' ').ok_or(SyntaxError { number: 2, reason: "no blank after the tag" })?;
    Ok((tag, rest))
}
