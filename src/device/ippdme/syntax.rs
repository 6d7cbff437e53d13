//! Elements of the lines of I++ DME: tags, numbers, strings, names, and lists in parentheses.

use std::fmt::{self, Write as _};

/// Maximum number of digits of a number.
const MAX_DIGITS: usize = 16;
/// Maximum depth of nested parentheses; the standard uses two.
const MAX_DEPTH: u32 = 8;

/// Tag that links an answer to its command.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Tag {
    /// Tag of a command that waits in the queue: 1 to 99999.
    Command(u32),
    /// Tag of a command that runs while others run: 1 to 9999. 0 is for the server's own messages.
    Event(u16),
}

impl Tag {
    /// Tag of messages that the server sends unasked.
    pub const UNSOLICITED: Self = Self::Event(0);

    /// Parses a tag: five digits, or for an event command `E` and four digits. Returns `None` for any other text.
    pub fn read(text: &str) -> Option<Self> {
        let digits = |text: &str| text.bytes().all(|b| b.is_ascii_digit()).then(|| text.parse().ok()).flatten();
        match text.strip_prefix('E') {
            _ if text.len() != 5 => None,
            Some(number) => digits(number).map(|n: u32| Self::Event(n as u16)),
            None => digits(text).map(Self::Command),
        }
    }
}

impl fmt::Display for Tag {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Command(number) => write!(f, "{number:05}"),
            Self::Event(number) => write!(f, "E{number:04}"),
        }
    }
}

/// Reason why a line is refused: the error number of the standard that a server answers, and a text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SyntaxError {
    /// Error number of the standard.
    pub number: u16,
    /// Explanation in words.
    pub reason: &'static str,
}

/// Returns the error 502, "incorrect arguments", with the reason `reason`.
pub(super) const fn arguments(reason: &'static str) -> SyntaxError {
    SyntaxError { number: 502, reason }
}

/// Returns the error 509, "bad argument", with the reason `reason`.
pub(super) const fn bad(reason: &'static str) -> SyntaxError {
    SyntaxError { number: 509, reason }
}

/// Argument or data item, between two commas.
#[derive(Clone, Debug, PartialEq)]
pub enum Item {
    /// Finite number.
    Number(f64),
    /// String, without its quotes.
    Text(String),
    /// Tag of an event command, which identifies a daemon.
    Tag(Tag),
    /// Name alone, for example `PartCsy`.
    Name(String),
    /// Name, with or without dots, and the items in its parentheses: `Tool.PtMeasPar.Speed(4)`.
    Call(String, Vec<Item>),
    /// Empty item: nothing follows a comma.
    Nothing,
}

impl Item {
    /// Creates a property with one number, for example `X(1.5)`.
    pub fn property(name: &str, value: f64) -> Self {
        Self::Call(name.to_owned(), vec![Self::Number(value)])
    }

    /// Creates a request for a property, for example `X()`.
    pub fn property_query(name: &str) -> Self {
        Self::Call(name.to_owned(), Vec::new())
    }

    /// Returns the value of the item if it is a number, otherwise `None`.
    pub fn number(&self) -> Option<f64> {
        if let Self::Number(value) = self { Some(*value) } else { None }
    }
}

impl fmt::Display for Item {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(value) => f.write_str(&number(*value)),
            Self::Text(text) => write!(f, "\"{text}\""),
            Self::Tag(tag) => tag.fmt(f),
            Self::Name(name) => f.write_str(name),
            Self::Call(name, items) => write!(f, "{name}({})", list(items)),
            Self::Nothing => Ok(()),
        }
    }
}

/// Formats items as they appear in parentheses, separated by a comma and a blank.
pub(super) fn list(items: &[Item]) -> String {
    let mut text = String::new();
    for (k, item) in items.iter().enumerate() {
        // Writing to a string cannot fail.
        let _ = write!(text, "{}{item}", if k > 0 { ", " } else { "" });
    }
    text
}

/// Formats `value` as I++ DME text with at most 16 digits. Uses plain notation if 16 digits are enough, otherwise an
/// exponent with `E`. Leading zeros also count as digits, because a strict server counts them.
pub fn number(value: f64) -> String {
    let value = if value == 0.0 { 0.0 } else { value };
    let digits = |text: &str| text.bytes().filter(u8::is_ascii_digit).count();
    let short = format!("{value:e}");
    let mantissa = |text: &str| digits(text.split('e').next().unwrap_or(text));
    let short = if mantissa(&short) > MAX_DIGITS { format!("{value:.15e}") } else { short };
    // The plain form is written from the value rounded to 16 digits.
    let plain = short.parse::<f64>().map_or(String::new(), |rounded| rounded.to_string());
    let is_plain = !plain.is_empty() && digits(&plain) <= MAX_DIGITS;
    if is_plain { plain } else { short.replace('e', "E") }
}

/// Strictness with which a line is checked against the grammar.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Strictness {
    /// Strict, as a server must be.
    Strict,
    /// Lenient: allows blanks between any two elements, and numbers of any length.
    Lenient,
}

/// Parser of items, character by character.
pub(super) struct Reader<'a> {
    rest: &'a str,
    strictness: Strictness,
    depth: u32,
}

impl<'a> Reader<'a> {
    pub(super) fn new(rest: &'a str, strictness: Strictness) -> Self {
        Self { rest, strictness, depth: 0 }
    }

    pub(super) fn rest(&self) -> &'a str {
        self.rest
    }

    pub(super) fn is_at_end(&mut self) -> bool {
        self.skip_blanks();
        self.rest.is_empty()
    }

    fn skip_blanks(&mut self) {
        self.rest = self.rest.trim_start_matches(' ');
    }

    pub(super) fn eat(&mut self, wanted: char) -> bool {
        self.skip_blanks();
        let after = self.rest.strip_prefix(wanted);
        self.rest = after.unwrap_or(self.rest);
        after.is_some()
    }

    /// Parses the items up to the next closing parenthesis, and consumes this parenthesis. The caller must have
    /// consumed the opening parenthesis before. Returns an empty list if nothing is between the parentheses.
    ///
    /// # Errors
    /// Returns an error if an item is invalid, or if the closing parenthesis is missing.
    pub(super) fn in_parentheses(&mut self) -> Result<Vec<Item>, SyntaxError> {
        if self.eat(')') {
            return Ok(Vec::new());
        }
        let items = self.items()?;
        if self.eat(')') { Ok(items) } else { Err(arguments("a comma or ) is missing")) }
    }

    /// Parses at least one item, and further items as long as a comma follows. An item can be empty. Stops at the first
    /// character after an item that is not a comma.
    ///
    /// # Errors
    /// Returns an error if an item is invalid.
    pub(super) fn items(&mut self) -> Result<Vec<Item>, SyntaxError> {
        let mut items = vec![self.item()?];
        while self.eat(',') {
            items.push(self.item()?);
        }
        Ok(items)
    }

    fn item(&mut self) -> Result<Item, SyntaxError> {
        self.skip_blanks();
        match self.rest.chars().next() {
            None | Some(',' | ')') => Ok(Item::Nothing),
            Some('"') => self.text(),
            Some('0'..='9' | '+' | '-' | '.') => self.number().map(Item::Number),
            Some('A'..='Z' | 'a'..='z') => self.named(),
            Some(_) => Err(arguments("an unexpected character")),
        }
    }

    fn text(&mut self) -> Result<Item, SyntaxError> {
        let body = &self.rest[1..];
        let end = body.find('"').ok_or(bad("a string that does not end"))?;
        if end == 0 && self.strictness == Strictness::Strict {
            return Err(bad("an empty string"));
        }
        self.rest = &body[end + 1..];
        Ok(Item::Text(body[..end].to_owned()))
    }

    fn take_while(&mut self, of: impl Fn(u8) -> bool) -> &'a str {
        let end = self.rest.bytes().position(|b| !of(b)).unwrap_or(self.rest.len());
        let (taken, rest) = self.rest.split_at(end);
        self.rest = rest;
        taken
    }

    fn number(&mut self) -> Result<f64, SyntaxError> {
        let all = self.rest;
        if self.rest.starts_with(['+', '-']) {
            self.rest = &self.rest[1..];
        }
        let mantissa = self.take_while(|b| b.is_ascii_digit() || b == b'.');
        let digits = mantissa.bytes().filter(u8::is_ascii_digit).count();
        if mantissa.len() - digits > 1 {
            return Err(bad("a number with two decimal points"));
        }
        if digits == 0 {
            return Err(bad("a number without a digit"));
        }
        if digits > MAX_DIGITS && self.strictness == Strictness::Strict {
            return Err(bad("a number with more than 16 digits"));
        }
        if self.rest.starts_with(['E', 'e']) {
            self.rest = &self.rest[1..];
            if self.rest.starts_with(['+', '-']) {
                self.rest = &self.rest[1..];
            }
            if !(1..=3).contains(&self.take_while(|b| b.is_ascii_digit()).len()) {
                return Err(bad("an exponent that does not have 1 to 3 digits"));
            }
        }
        let value = all[..all.len() - self.rest.len()].parse().ok().filter(|value: &f64| value.is_finite());
        value.ok_or(bad("a number that is too large"))
    }

    fn named(&mut self) -> Result<Item, SyntaxError> {
        let name = self.take_while(|b| b.is_ascii_alphanumeric() || b == b'.' || b == b'_');
        if name.ends_with('.') || name.contains("..") {
            return Err(arguments("a dot without a name"));
        }
        if let Some(tag @ Tag::Event(_)) = Tag::read(name) {
            return Ok(Item::Tag(tag));
        }
        if !self.eat('(') {
            return Ok(Item::Name(name.to_owned()));
        }
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err(arguments("parentheses nested too deep"));
        }
        let items = self.in_parentheses()?;
        self.depth -= 1;
        Ok(Item::Call(name.to_owned(), items))
    }
}

/// Returns true if `text` contains a blank that the grammar of I++ DME does not allow. Blanks are allowed before and
/// after commas and parentheses, within strings, and at the ends of `text`. A blank within a name or a number is not
/// allowed.
pub(super) fn has_stray_blank(text: &str) -> bool {
    let (mut before, mut quoted, mut blank) = ('(', false, false);
    for c in text.chars() {
        let ends_gap = blank && c != ' ' && !quoted;
        if ends_gap && !matches!(before, ',' | '(' | ')') && !matches!(c, ',' | '(' | ')') {
            return true;
        }
        (quoted, blank) = (quoted ^ (c == '"'), c == ' ' && !quoted);
        before = if c == ' ' { before } else { c };
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decimal_16_digits_round_trip() {
        for (value, text) in [
            (0.0, "0"),
            (-0.0, "0"),
            (5.1, "5.1"),
            (-123.0, "-123"),
            (1_234_567_890_123_456.0, "1234567890123456"),
            (1e20, "1E20"),
            (1.234_567_890_123_456e-123, "1.234567890123456E-123"),
            (0.1 + 0.2, "0.3"),
            (1.0 / 3.0, "3.333333333333333E-1"),
        ] {
            assert_eq!(number(value), text);
        }
        for k in 1..2000 {
            let value = f64::from(k).sqrt() * 10f64.powi(k % 30 - 15);
            let text = number(value);
            let mantissa = text.split('E').next().unwrap();
            assert!(mantissa.bytes().filter(u8::is_ascii_digit).count() <= 16, "{text}");
            let back = Reader::new(&text, Strictness::Strict).number().unwrap();
            assert!((back - value).abs() <= 1e-15 * value, "{text} for {value}");
        }
    }

    #[test]
    fn tags_have_five_characters() {
        assert_eq!(Tag::read("00007"), Some(Tag::Command(7)));
        assert_eq!(Tag::read("E0000"), Some(Tag::UNSOLICITED));
        assert_eq!(Tag::Event(12).to_string(), "E0012");
        for none in ["0007", "000007", "E00", "A2345", "+1234", "E+123"] {
            assert_eq!(Tag::read(none), None, "{none}");
        }
    }
}
