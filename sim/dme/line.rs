//! Parser of received commands, implemented independently: an error must not be the same at both ends of the wire.

use std::fmt;

use super::faults::Fault;
use crate::Vec3;

/// Tag of a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tag {
    event: bool,
    number: u32,
}

impl Tag {
    /// Tag of a message that no command requested.
    pub const UNSOLICITED: Self = Self { event: true, number: 0 };

    /// Returns true if this is the tag of an event command, for example `E0001`. The server carries out an event
    /// command at once, before the queued commands.
    pub fn is_event(self) -> bool {
        self.event
    }
}

impl fmt::Display for Tag {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.event { write!(f, "E{:04}", self.number) } else { write!(f, "{:05}", self.number) }
    }
}

/// Error as it is sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DmeError {
    /// Severity: 1 warns, 2 and 3 stop, 9 ends.
    pub severity: u8,
    /// Number of the error.
    pub number: u16,
    /// Cause of the error.
    pub cause: String,
}

impl DmeError {
    /// Creates an error with the error number `number` of the I++ DME standard. The number determines the severity.
    /// `cause` is the command or the text that caused the error.
    pub fn new(number: u16, cause: &str) -> Self {
        let severity = match number {
            504 => 1,
            1 | 2 | 6 | 514 | 1001 | 1003 | 1006 | 1010 => 2,
            _ => 3,
        };
        Self { severity, number, cause: cause.to_owned() }
    }
}

impl fmt::Display for DmeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let text = match self.number {
            1 => "Illegal tag",
            2 => "No space at pos. 6",
            6 => "Transaction aborted (Use ClearAllErrors To Continue)",
            7 => "Illegal character",
            8 => "Protocol error",
            500 => "Emergency stop",
            501 => "Unsupported command",
            502 => "Incorrect arguments",
            504 => "Argument out of range",
            507 => "Illegal command",
            508 => "Bad context",
            509 => "Bad argument",
            510 => "Bad property",
            514 => "Use ClearAllErrors to continue",
            1001 => "Illegal touch",
            1005 => "Error during home",
            1006 => "Surface not found",
            1008 => "Target position out of machine volume",
            1010 => "Vector has no norm",
            1502 => "Tool not found",
            _ => "Error",
        };
        write!(f, "Error({}, {:04}, \"{}\", \"{text}\")", self.severity, self.number, self.cause.replace('"', "#"))
    }
}

/// Argument of a command.
#[derive(Clone, Debug, PartialEq)]
pub enum Argument {
    /// A number.
    Number(f64),
    /// A string.
    Text(String),
    /// Name, with the numbers in its parentheses if it has any.
    Name(String, Option<Vec<f64>>),
    /// Name with other names in its parentheses, for example the format of a curve.
    Names(String, Vec<String>),
}

/// Command with its arguments.
#[derive(Clone, Debug, PartialEq)]
pub struct Command {
    /// Name of the command.
    pub name: String,
    /// Arguments in its parentheses.
    pub arguments: Vec<Argument>,
    /// Fault of the command.
    pub fault: Option<Fault>,
}

impl Command {
    pub(super) fn with(self, fault: Option<Fault>) -> Self {
        Self { fault, ..self }
    }
}

type Refused = (Option<Tag>, DmeError);

/// Parses a command line, without its line end, into tag and command.
///
/// # Errors
/// Returns the error to send, and the tag if the line has a valid one.
pub fn read(line: &str) -> Result<(Tag, Command), Refused> {
    let bytes = line.as_bytes();
    if let Some(bad) = bytes.iter().find(|b| !(32..127).contains(*b)) {
        return Err((None, DmeError::new(7, &format!("byte {bad}"))));
    }
    let tag = tag(bytes).ok_or((None, DmeError::new(1, line)))?;
    if bytes.get(5) != Some(&b' ') {
        return Err((Some(tag), DmeError::new(2, line)));
    }
    let command = command(&line[6..]).map_err(|number| (Some(tag), DmeError::new(number, line)))?;
    if command.name.ends_with('E') != tag.event {
        return Err((Some(tag), DmeError::new(1, line)));
    }
    Ok((tag, command))
}

fn tag(bytes: &[u8]) -> Option<Tag> {
    let head = bytes.get(..5)?;
    let event = head[0] == b'E';
    let digits = std::str::from_utf8(&head[usize::from(event)..]).ok()?;
    let number = digits.bytes().all(|b| b.is_ascii_digit()).then(|| digits.parse().ok()).flatten()?;
    (number > 0).then_some(Tag { event, number })
}

fn command(text: &str) -> Result<Command, u16> {
    let (name, rest) = text.split_once('(').ok_or(502u16)?;
    let name = name.trim_end();
    if name.is_empty() || !name.bytes().all(|b| b.is_ascii_alphanumeric()) {
        return Err(507);
    }
    let inside = rest.trim_end().strip_suffix(')').ok_or(507u16)?;
    let arguments = if inside.trim().is_empty() { Vec::new() } else { arguments(inside)? };
    Ok(Command { name: name.to_owned(), arguments, fault: None })
}

/// Parses the arguments of a command. `inside` is the text between the parentheses of the command. Arguments are
/// separated by commas. A comma in a string or in inner parentheses is part of an argument.
///
/// # Errors
/// Returns an error number of the I++ DME standard. The number is 502 if a string or a parenthesis is not closed.
/// Otherwise it is the error number of the first invalid argument.
fn arguments(inside: &str) -> Result<Vec<Argument>, u16> {
    let (mut depth, mut quoted, mut from, mut parts) = (0i32, false, 0, Vec::new());
    for (at, c) in inside.char_indices() {
        match c {
            '"' => quoted = !quoted,
            '(' if !quoted => depth += 1,
            ')' if !quoted => depth -= 1,
            ',' if !quoted && depth == 0 => {
                parts.push(&inside[from..at]);
                from = at + 1;
            }
            _ => {}
        }
    }
    parts.push(&inside[from..]);
    if depth != 0 || quoted { Err(502) } else { parts.into_iter().map(argument).collect() }
}

fn argument(text: &str) -> Result<Argument, u16> {
    let text = text.trim();
    if let Some(body) = text.strip_prefix('"') {
        return body.strip_suffix('"').filter(|body| !body.is_empty()).map(|b| Argument::Text(b.to_owned())).ok_or(509);
    }
    if text.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c)) {
        return number(text).map(Argument::Number);
    }
    let Some((name, rest)) = text.split_once('(') else { return Ok(Argument::Name(text.to_owned(), None)) };
    let inside = rest.strip_suffix(')').ok_or(502u16)?;
    if inside.starts_with(|c: char| c.is_ascii_alphabetic()) {
        let names = inside.split(',').map(|name| name.trim().to_owned()).collect();
        return Ok(Argument::Names(name.trim_end().to_owned(), names));
    }
    let numbers = inside.split(',').filter(|_| !inside.trim().is_empty()).map(|n| number(n.trim()));
    Ok(Argument::Name(name.trim_end().to_owned(), Some(numbers.collect::<Result<_, _>>()?)))
}

fn number(text: &str) -> Result<f64, u16> {
    let mantissa = text.split(['E', 'e']).next().unwrap_or(text);
    let digits = mantissa.bytes().filter(u8::is_ascii_digit).count();
    let plain = text.bytes().all(|b| b.is_ascii_digit() || b"+-.Ee".contains(&b));
    if !plain || digits > 16 {
        return Err(509);
    }
    text.parse().ok().filter(|n: &f64| n.is_finite()).ok_or(509)
}

/// Line of a scan.
#[derive(Clone, Debug)]
pub(super) struct Scanned {
    /// Time at which it is sent, in the machine's time from the beginning, in s.
    pub(super) seconds: f64,
    /// Position of the probe at that time.
    pub(super) at_mm: Vec3,
    /// Points, each as its fields.
    pub(super) points: Vec<Vec<String>>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dme_line_parses_or_gives_error_code() {
        let (tag, command) = read("00014 PtMeas(X(10), Y(20.5) ,IJK(0,0,1))").unwrap();
        assert_eq!(tag.to_string(), "00014");
        let point = Argument::Name("X".into(), Some(vec![10.0]));
        assert_eq!((command.name.as_str(), &command.arguments[0]), ("PtMeas", &point));
        for (line, number) in [
            ("A2345 GoTo(X(1))", 1),
            ("012345 GoTo(X(1))", 2),
            ("00001 AbortE()", 1),
            ("00001 GoTo(X(12345678901234567))", 509),
            ("00001 GoTo(X(1)", 502),
            ("00001 GoTo(X(1))2", 507),
            ("00001 GoTo(X(1)\t)", 7),
        ] {
            assert_eq!(read(line).unwrap_err().1.number, number, "{line}");
        }
    }
}
