//! Answers of a server. The parser accepts variants of their form, because servers differ wherever the standard only
//! gives an example.

use std::fmt;

use super::syntax::{Item, Reader, Strictness, SyntaxError, Tag};

/// Line from a server.
#[derive(Clone, Debug, PartialEq)]
pub struct DmeResponse {
    /// Tag of the command that it answers.
    pub tag: Tag,
    /// Content of the line.
    pub content: ResponseContent,
}

/// Content of a line from a server.
#[derive(Clone, Debug, PartialEq)]
pub enum ResponseContent {
    /// Acknowledgement: the command is in the queue.
    Acknowledged,
    /// Data of the command.
    Data(Vec<Item>),
    /// Error or warning.
    Error(ServerError),
    /// End of the command.
    Complete,
}

/// Error as the server reports it. Only its number is reliable; severity and text differ between servers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServerError {
    /// Severity: 0 information, 1 warning, 2 the client can continue, 3 an operator is needed, 9 the server cannot
    /// continue.
    pub severity: u8,
    /// Error number of the standard.
    pub number: u16,
    /// Cause.
    pub cause: String,
    /// Text in the server's words.
    pub text: String,
}

impl ServerError {
    /// Returns true if the severity is 0 (information) or 1 (warning). Such an error does not interrupt the work of the
    /// server.
    pub fn is_warning(&self) -> bool {
        self.severity < 2
    }
}

impl fmt::Display for ServerError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "error {:04}, severity {}: {}", self.number, self.severity, self.text)?;
        if self.cause.is_empty() { Ok(()) } else { write!(f, " ({})", self.cause) }
    }
}

impl DmeResponse {
    /// Parses a line of the server, without its line end: a tag, then an acknowledgement, data, an error or a
    /// completion.
    ///
    /// # Errors
    /// The line is none of these.
    pub fn read(line: &str) -> Result<Self, SyntaxError> {
        let none = |reason| SyntaxError { number: 8, reason };
        let tag = line.get(..5).and_then(Tag::read).ok_or(none("no tag"))?;
        let rest = line[5..].trim_start_matches(' ');
        let mut characters = rest.chars();
        let said = match characters.next() {
            Some('&') if characters.as_str().trim().is_empty() => ResponseContent::Acknowledged,
            Some('%') if characters.as_str().trim().is_empty() => ResponseContent::Complete,
            Some('#') => ResponseContent::Data(data(characters.as_str())?),
            Some('!') => {
                ResponseContent::Error(error(characters.as_str()).ok_or(none("an error without its numbers"))?)
            }
            _ => return Err(none("none of & # ! %")),
        };
        Ok(Self { tag, content: said })
    }
}

fn data(text: &str) -> Result<Vec<Item>, SyntaxError> {
    let mut reader = Reader::new(text, Strictness::Lenient);
    // A list in parentheses may come without a name.
    if reader.eat('(') {
        let items = reader.in_parentheses()?;
        return ended(reader, items);
    }
    let items = reader.items()?;
    ended(reader, items)
}

fn ended(mut reader: Reader<'_>, items: Vec<Item>) -> Result<Vec<Item>, SyntaxError> {
    let whole = reader.is_at_end() && !items.contains(&Item::Nothing);
    if whole { Ok(items) } else { Err(SyntaxError { number: 8, reason: "there is text between the data" }) }
}

/// Parses `Error(severity, number, cause, text)`. Cause and text may lack their quotes and may contain any characters.
/// Returns `None` if the severity or the number is missing or too large.
fn error(text: &str) -> Option<ServerError> {
    let inside = text.trim().strip_prefix("Error")?.trim_start().strip_prefix('(')?;
    let inside = inside.trim_end().strip_suffix(')').unwrap_or(inside);
    let mut parts = inside.splitn(3, ',').map(str::trim);
    let severity = parts.next()?.parse().ok().filter(|severity| *severity < 10)?;
    let number = parts.next()?.parse().ok().filter(|number| *number < 10_000)?;
    let rest = parts.next().unwrap_or_default();
    // The text is the last quoted string, or everything after the last comma.
    let (cause, text) = match rest.strip_suffix('"').and_then(|rest| rest.rsplit_once('"')) {
        Some((cause, text)) => (cause.trim_end().trim_end_matches(','), text),
        None => rest.rsplit_once(',').unwrap_or(("", rest)),
    };
    let bare = |text: &str| text.trim().trim_matches('"').to_owned();
    Some(ServerError { severity, number, cause: bare(cause), text: bare(text) })
}

/// Returns the number of the property `name` in the data, at any position. Returns `None` if the property is missing,
/// occurs twice or does not have one number.
pub fn value(data: &[Item], name: &str) -> Option<f64> {
    match &values(data, name)?[..] {
        [Item::Number(value)] => Some(*value),
        _ => None,
    }
}

/// Returns the items in the parentheses of the property `name` in the data. Returns `None` if the property is missing
/// or occurs twice.
pub fn values(data: &[Item], name: &str) -> Option<Vec<Item>> {
    let mut found = data.iter().filter_map(|item| match item {
        Item::Call(called, values) if called == name => Some(values),
        _ => None,
    });
    let first = found.next()?;
    found.next().is_none().then(|| first.clone())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(line: &str) -> ResponseContent {
        DmeResponse::read(line).unwrap().content
    }

    #[test]
    fn response_parses_four_kinds() {
        assert_eq!(said("00001 &"), ResponseContent::Acknowledged);
        assert_eq!(said("00001 % "), ResponseContent::Complete);
        assert_eq!(DmeResponse::read("E0000 # KeyPress(\"Done\")").unwrap().tag, Tag::UNSOLICITED);
        for nothing in ["", "00001", "00001 ?", "0001 &", "00001 & more", "00001 # X(1) Y(2)", "00001 ! Error(x)"] {
            assert!(DmeResponse::read(nothing).is_err(), "{nothing}");
        }
    }

    #[test]
    fn response_properties_by_name() {
        let ResponseContent::Data(data) = said("00014 # Q(0), Z(5.12) ,X( 1.5E1),IJK(0,0,1), Tool.AvrRadius(1.5)")
        else {
            panic!()
        };
        assert_eq!((value(&data, "X"), value(&data, "Z"), value(&data, "Y")), (Some(15.0), Some(5.12), None));
        assert_eq!(value(&data, "Tool.AvrRadius"), Some(1.5));
        assert_eq!(values(&data, "IJK").map(|v| v.len()), Some(3));
    }

    #[test]
    fn duplicate_property_is_none() {
        let ResponseContent::Data(data) = said("00014 # X(1), X(2)") else { panic!() };
        assert_eq!(value(&data, "X"), None);
    }

    #[test]
    fn response_refuses_deep_nesting() {
        assert!(DmeResponse::read(&format!("00001 # {}", "A(".repeat(30_000))).is_err());
    }

    proptest::proptest! {
        /// No line from a server makes a parser panic. A line that parses as a command is written back as the same
        /// command.
        #[test]
        fn response_parse_never_panics(line in "([0-9E]{5} [&#!%]? ?)?[A-Za-z0-9().,+\\-\" E]{0,60}|\\PC{0,40}") {
            let _ = DmeResponse::read(&line);
            if let Ok((tag, command)) = crate::ippdme::DmeCommand::read(&line) {
                let written = command.line(tag);
                let again = crate::ippdme::DmeCommand::read(written.trim_end());
                proptest::prop_assert_eq!(again, Ok((tag, command)));
            }
        }
    }

    #[test]
    fn response_error_quoting_variants() {
        let read = |line: &str| match said(line) {
            ResponseContent::Error(error) => (error.severity, error.number, error.cause, error.text),
            other => panic!("{other:?}"),
        };
        let (cause, text) = ("00070 GoTo(X(2), Y(3))".to_owned(), "Transaction aborted".to_owned());
        assert_eq!(
            read("00070 ! Error(2, 0006, \"00070 GoTo(X(2), Y(3))\", \"Transaction aborted\")"),
            (2, 6, cause, text)
        );
        assert_eq!(read("00003 ! Error(3,500,GoTo,E stop)"), (3, 500, "GoTo".into(), "E stop".into()));
        assert_eq!(read("00003 ! Error(1,0504)"), (1, 504, String::new(), String::new()));
    }
}
