//! Text of a STEP file (ISO 10303-21): its entities by number, and their values.

use std::cell::OnceCell;
use std::collections::HashMap;
use std::path::Path;

use super::super::error::{FormatError, excerpt};

/// Maximum depth of lists within lists.
const MAX_DEPTH: usize = 32;

/// Maximum number of entities; a file of 1 GiB can have about as many.
const MAX_ENTITIES: usize = 40_000_000;

/// Value of an attribute.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    /// Number without a decimal point.
    Integer(i64),
    /// Number with a decimal point.
    Real(f64),
    /// Text in apostrophes, decoded.
    Text(String),
    /// Word between points, such as `.T.`, without the points.
    Word(String),
    /// Number of another entity.
    Reference(u64),
    /// Values in parentheses.
    List(Vec<Value>),
    /// Value with the name of its type, such as `LENGTH_MEASURE(25.4)`.
    Typed(String, Vec<Value>),
    /// `$`, `*` or binary data: nothing that is used.
    Nothing,
}

/// Type of an entity with its attributes. A complex entity has several.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Record {
    /// Name of the type in upper case.
    pub name: String,
    pub values: Vec<Value>,
}

/// Entities of a file. Each is parsed when it is asked for.
pub(super) struct StepText<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    /// Where the content of each entity begins, after `=`.
    places: HashMap<u64, usize>,
    /// The numbers in the order of the file.
    order: Vec<u64>,
    /// Ends of the lines. The first error that names a line finds them.
    line_ends: OnceCell<Vec<usize>>,
}

impl<'a> StepText<'a> {
    /// Finds all entities in the data sections of a file. `path` only names the file in messages.
    ///
    /// # Errors
    /// Text that is not STEP; an entity that is not complete; a number that is given twice.
    pub(super) fn new(path: &'a Path, bytes: &'a [u8]) -> Result<Self, FormatError> {
        let mut text = Self { path, bytes, places: HashMap::new(), order: Vec::new(), line_ends: OnceCell::new() };
        let mut cursor = Cursor { path, bytes, at: 0 };
        cursor.skip_mark();
        cursor.expect_word("ISO-10303-21")?;
        cursor.expect(b';')?;
        loop {
            let word = cursor.word();
            match word.as_str() {
                "DATA" => {
                    cursor.skip_to_semicolon()?;
                    text.index_section(&mut cursor)?;
                }
                // Anchors and references name entities for other files; a signature covers the text.
                "HEADER" | "ANCHOR" | "REFERENCE" | "SIGNATURE" => {
                    while cursor.word() != "ENDSEC" {
                        cursor.skip_to_semicolon()?;
                    }
                    cursor.expect(b';')?;
                }
                "END-ISO-10303-21" => break,
                // Some programs leave the last line out.
                "" if cursor.is_at_end() && !text.order.is_empty() => break,
                _ => return Err(cursor.unexpected("a section such as DATA;")),
            }
        }
        Ok(text)
    }

    /// Notes the entities up to the end of a section.
    fn index_section(&mut self, cursor: &mut Cursor<'a>) -> Result<(), FormatError> {
        loop {
            cursor.skip_blanks()?;
            if cursor.peek() != Some(b'#') {
                if cursor.word() != "ENDSEC" {
                    return Err(cursor.unexpected("an entity such as #1=..., or ENDSEC;"));
                }
                return cursor.expect(b';');
            }
            let number = cursor.reference()?;
            cursor.expect(b'=')?;
            if self.places.insert(number, cursor.at).is_some() {
                return Err(cursor.unexpected(&format!("each entity once; #{number} is given twice")));
            }
            if self.order.len() == MAX_ENTITIES {
                let limit = MAX_ENTITIES as u64;
                return Err(FormatError::TooLarge {
                    path: self.path.to_owned(),
                    found: limit + 1,
                    limit,
                    unit: "entities",
                });
            }
            self.order.push(number);
            cursor.skip_to_semicolon()?;
        }
    }

    /// Returns the numbers of all entities in the order of the file.
    pub(super) fn numbers(&self) -> &[u64] {
        &self.order
    }

    /// Returns the name of the first type of an entity, without parsing its attributes.
    pub(super) fn type_name(&self, number: u64) -> Option<String> {
        let mut cursor = Cursor { path: self.path, bytes: self.bytes, at: *self.places.get(&number)? };
        cursor.skip_blanks().ok()?;
        if cursor.peek() == Some(b'(') {
            cursor.at += 1;
        }
        Some(cursor.word())
    }

    /// Parses an entity. Returns its types with their attributes: one, or several for a complex entity.
    ///
    /// # Errors
    /// An entity that does not exist or is not well formed.
    pub(super) fn entity(&self, number: u64) -> Result<Vec<Record>, FormatError> {
        let Some(&at) = self.places.get(&number) else {
            return Err(self.unexpected(number, "an entity", "no entity of this number"));
        };
        let mut cursor = Cursor { path: self.path, bytes: self.bytes, at };
        cursor.skip_blanks()?;
        if cursor.peek() != Some(b'(') {
            return Ok(vec![cursor.record()?]);
        }
        cursor.at += 1;
        let mut records = Vec::new();
        loop {
            cursor.skip_blanks()?;
            if cursor.peek() == Some(b')') {
                return Ok(records);
            }
            records.push(cursor.record()?);
        }
    }

    /// Creates the error that an entity is not as expected.
    pub(super) fn unexpected(&self, number: u64, expected: &str, found: &str) -> FormatError {
        let ends = || self.bytes.iter().enumerate().filter(|(_, b)| **b == b'\n').map(|(at, _)| at).collect();
        let line_of = |at: usize| 1 + self.line_ends.get_or_init(ends).partition_point(|end| *end < at);
        let line = self.places.get(&number).map(|&at| line_of(at));
        let place = line.map_or_else(|| format!("entity #{number}"), |line| format!("line {line}, entity #{number}"));
        FormatError::Unexpected {
            path: self.path.to_owned(),
            place,
            expected: expected.to_owned(),
            found: excerpt(found.as_bytes()),
        }
    }
}

fn line_of(bytes: &[u8], at: usize) -> usize {
    1 + bytes[..at.min(bytes.len())].iter().filter(|&&b| b == b'\n').count()
}

/// Place in the text.
struct Cursor<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    at: usize,
}

impl Cursor<'_> {
    fn peek(&self) -> Option<u8> {
        self.bytes.get(self.at).copied()
    }

    /// Skips a byte order mark.
    fn skip_mark(&mut self) {
        if self.bytes.starts_with(b"\xef\xbb\xbf") {
            self.at = 3;
        }
    }

    /// Skips blanks, ends of lines, and comments.
    fn skip_blanks(&mut self) -> Result<(), FormatError> {
        loop {
            match self.peek() {
                Some(b' ' | b'\t' | b'\r' | b'\n' | 0x0c) => self.at += 1,
                Some(b'/') if self.bytes.get(self.at + 1) == Some(&b'*') => {
                    let rest = &self.bytes[self.at + 2..];
                    let Some(length) = rest.windows(2).position(|pair| pair == b"*/") else {
                        return Err(self.cut("the end of a comment"));
                    };
                    self.at += length + 4;
                }
                _ => return Ok(()),
            }
        }
    }

    fn is_at_end(&mut self) -> bool {
        self.skip_blanks().is_ok() && self.peek().is_none_or(|b| b == 0 || b == 0x1a)
    }

    /// Returns the next word in upper case; empty if there is none.
    fn word(&mut self) -> String {
        if self.skip_blanks().is_err() {
            return String::new();
        }
        let rest = &self.bytes[self.at..];
        let is_part = |b: &u8| b.is_ascii_alphanumeric() || *b == b'_' || *b == b'-' || *b == b'!';
        let length = rest.iter().position(|b| !is_part(b)).unwrap_or(rest.len());
        self.at += length;
        rest[..length].iter().map(|b| b.to_ascii_uppercase() as char).collect()
    }

    fn expect_word(&mut self, expected: &str) -> Result<(), FormatError> {
        if self.word() == expected { Ok(()) } else { Err(self.unexpected(expected)) }
    }

    fn expect(&mut self, byte: u8) -> Result<(), FormatError> {
        self.skip_blanks()?;
        match self.peek() {
            Some(found) if found == byte => {
                self.at += 1;
                Ok(())
            }
            Some(_) => Err(self.unexpected(&format!("`{}`", byte as char))),
            None => Err(self.cut(&format!("`{}`", byte as char))),
        }
    }

    /// Skips everything up to the next semicolon that is not in a text or a comment, and this semicolon.
    fn skip_to_semicolon(&mut self) -> Result<(), FormatError> {
        loop {
            self.skip_blanks()?;
            match self.peek() {
                None => return Err(self.cut("`;`")),
                Some(b';') => {
                    self.at += 1;
                    return Ok(());
                }
                Some(b'\'') => drop(self.text()?),
                Some(_) => self.at += 1,
            }
        }
    }

    fn reference(&mut self) -> Result<u64, FormatError> {
        self.expect(b'#')?;
        let rest = &self.bytes[self.at..];
        let length = rest.iter().position(|b| !b.is_ascii_digit()).unwrap_or(rest.len());
        let number = std::str::from_utf8(&rest[..length]).ok().and_then(|digits| digits.parse().ok());
        let number = number.ok_or_else(|| self.unexpected("the number of an entity"))?;
        self.at += length;
        Ok(number)
    }

    /// Parses `NAME(values)`.
    fn record(&mut self) -> Result<Record, FormatError> {
        let name = self.word();
        if name.is_empty() {
            return Err(self.unexpected("the type of an entity"));
        }
        self.expect(b'(')?;
        Ok(Record { name, values: self.values(0)? })
    }

    /// Parses values up to the closing parenthesis.
    fn values(&mut self, depth: usize) -> Result<Vec<Value>, FormatError> {
        if depth > MAX_DEPTH {
            return Err(self.unexpected("lists within lists to a depth of at most 32"));
        }
        let mut values = Vec::new();
        self.skip_blanks()?;
        if self.peek() == Some(b')') {
            self.at += 1;
            return Ok(values);
        }
        loop {
            values.push(self.value(depth)?);
            self.skip_blanks()?;
            match self.peek() {
                Some(b',') => self.at += 1,
                Some(b')') => {
                    self.at += 1;
                    return Ok(values);
                }
                Some(_) => return Err(self.unexpected("`,` or `)`")),
                None => return Err(self.cut("`)`")),
            }
        }
    }

    fn value(&mut self, depth: usize) -> Result<Value, FormatError> {
        self.skip_blanks()?;
        match self.peek() {
            Some(b'$' | b'*') => {
                self.at += 1;
                Ok(Value::Nothing)
            }
            Some(b'#') => self.reference().map(Value::Reference),
            Some(b'(') => {
                self.at += 1;
                self.values(depth + 1).map(Value::List)
            }
            Some(b'\'') => self.text().map(Value::Text),
            Some(b'"') => {
                let rest = &self.bytes[self.at + 1..];
                let Some(length) = rest.iter().position(|&b| b == b'"') else { return Err(self.cut("`\"`")) };
                self.at += length + 2;
                Ok(Value::Nothing)
            }
            Some(b'.') if self.bytes.get(self.at + 1).is_some_and(u8::is_ascii_alphabetic) => {
                self.at += 1;
                let word = self.word();
                self.expect(b'.')?;
                Ok(Value::Word(word))
            }
            Some(b) if b.is_ascii_alphabetic() || b == b'!' => {
                let name = self.word();
                self.expect(b'(')?;
                Ok(Value::Typed(name, self.values(depth + 1)?))
            }
            Some(_) => self.number(),
            None => Err(self.cut("a value")),
        }
    }

    /// Parses a number. A `D` is taken as an exponent too, as some programs write it.
    fn number(&mut self) -> Result<Value, FormatError> {
        let rest = &self.bytes[self.at..];
        let is_part = |b: &u8| b.is_ascii_digit() || b"+-.eEdD".contains(b);
        let length = rest.iter().position(|b| !is_part(b)).unwrap_or(rest.len());
        let digits = std::str::from_utf8(&rest[..length]).unwrap_or_default();
        let value = if digits.contains(['.', 'e', 'E', 'd', 'D']) {
            let parsed: Option<f64> = digits.replace(['d', 'D'], "E").parse().ok();
            parsed.filter(|number| number.is_finite()).map(Value::Real)
        } else {
            digits.parse().ok().map(Value::Integer)
        };
        let value = value.ok_or_else(|| self.unexpected("a value"))?;
        self.at += length;
        Ok(value)
    }

    /// Parses a text in apostrophes.
    fn text(&mut self) -> Result<String, FormatError> {
        let begin = self.at + 1;
        let mut at = begin;
        loop {
            match self.bytes.get(at) {
                None => return Err(self.cut("the end of a text in apostrophes")),
                Some(b'\'') if self.bytes.get(at + 1) == Some(&b'\'') => at += 2,
                Some(b'\'') => break,
                Some(_) => at += 1,
            }
        }
        self.at = at + 1;
        Ok(decoded(&self.bytes[begin..at]))
    }

    fn unexpected(&self, expected: &str) -> FormatError {
        let rest = &self.bytes[self.at.min(self.bytes.len())..];
        FormatError::Unexpected {
            path: self.path.to_owned(),
            place: format!("line {}", line_of(self.bytes, self.at)),
            expected: expected.to_owned(),
            found: excerpt(&rest[..rest.len().min(40)]),
        }
    }

    fn cut(&self, expected: &str) -> FormatError {
        let place = format!("line {}", line_of(self.bytes, self.bytes.len()));
        FormatError::Cut { path: self.path.to_owned(), place, expected: expected.to_owned() }
    }
}

/// Decodes a text of ISO 10303-21: doubled apostrophes, `\S\` for the upper half of ISO 8859, `\X\` for one byte, `\X2\`
/// and `\X4\` for UTF-16 and UTF-32. Bytes of UTF-8 stay, as newer programs write them.
fn decoded(bytes: &[u8]) -> String {
    let raw = String::from_utf8_lossy(bytes).replace("''", "'").replace("\\\\", "\u{1}");
    let mut text = String::new();
    let mut rest = raw.as_str();
    while let Some(at) = rest.find('\\') {
        text.push_str(&rest[..at]);
        rest = &rest[at..];
        let (piece, after) = directive(rest).unwrap_or_else(|| ("\\".to_owned(), &rest[1..]));
        text.push_str(&piece);
        rest = after;
    }
    text.push_str(rest);
    text.replace('\u{1}', "\\")
}

/// Decodes the directive at the begin of `text`. Returns its characters, and the text behind it.
fn directive(text: &str) -> Option<(String, &str)> {
    if let Some(rest) = text.strip_prefix("\\S\\") {
        let c = rest.chars().next()?;
        let upper = char::from_u32(c as u32 + 128)?;
        return Some((upper.to_string(), &rest[c.len_utf8()..]));
    }
    if let Some(rest) = text.strip_prefix("\\X\\") {
        let code = u32::from_str_radix(rest.get(..2)?, 16).ok()?;
        return Some((char::from_u32(code)?.to_string(), &rest[2..]));
    }
    let digits = if text.starts_with("\\X2\\") { 4 } else { 8 };
    let rest = text.strip_prefix("\\X2\\").or_else(|| text.strip_prefix("\\X4\\"))?;
    let end = rest.find("\\X0\\")?;
    let codes = rest.as_bytes()[..end]
        .chunks(digits)
        .map(|code| std::str::from_utf8(code).ok().and_then(|code| u32::from_str_radix(code, 16).ok()));
    let codes: Option<Vec<u32>> = codes.collect();
    let piece = if digits == 4 {
        let units: Vec<u16> = codes?.into_iter().map(|code| code as u16).collect();
        String::from_utf16_lossy(&units)
    } else {
        codes?.into_iter().map(|code| char::from_u32(code).unwrap_or('\u{fffd}')).collect()
    };
    Some((piece, &rest[end + 4..]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with(data: &str) -> String {
        format!("ISO-10303-21;\nHEADER;FILE_NAME('a;b');ENDSEC;\nDATA;\n{data}\nENDSEC;\nEND-ISO-10303-21;\n")
    }

    #[test]
    fn entities_by_hand() {
        let text = with("/* #9=A(); */ #2=POINT('o''k;',(1.,-2.5E-3,3.D0),$,*,.T.,#1,L(7));\n#1 = ( B(1) C() ) ;");
        let path = Path::new("a.stp");
        let step = StepText::new(path, text.as_bytes()).unwrap();
        assert_eq!(step.numbers(), [2, 1]);
        let [point] = &step.entity(2).unwrap()[..] else { panic!("one record") };
        assert_eq!(point.name, "POINT");
        let numbers = Value::List(vec![Value::Real(1.0), Value::Real(-0.0025), Value::Real(3.0)]);
        let expected = [
            Value::Text("o'k;".into()),
            numbers,
            Value::Nothing,
            Value::Nothing,
            Value::Word("T".into()),
            Value::Reference(1),
            Value::Typed("L".into(), vec![Value::Integer(7)]),
        ];
        assert_eq!(point.values, expected);
        let complex = step.entity(1).unwrap();
        assert_eq!(complex.iter().map(|record| record.name.as_str()).collect::<Vec<_>>(), ["B", "C"]);
        assert_eq!(step.type_name(1).as_deref(), Some("B"));
    }

    #[test]
    fn text_is_decoded() {
        assert_eq!(decoded(b"Spiegel \\X2\\00D8\\X0\\40"), "Spiegel \u{d8}40");
        assert_eq!(decoded(b"\\X\\D8 \\S\\X \\X4\\0001F600\\X0\\"), "\u{d8} \u{d8} \u{1f600}");
        assert_eq!(decoded(b"C:\\\\a\\b"), "C:\\a\\b");
    }

    #[test]
    fn damaged_text_is_refused() {
        let path = Path::new("a.stp");
        for text in ["", "ISO-10303-21", "ISO-10303-22;", "ISO-10303-21;HEADER;ENDSEC;DATA;#1=A(;"] {
            assert!(StepText::new(path, text.as_bytes()).is_err(), "{text}");
        }
        for data in ["#1=A('x;", "#1=A();#1=B();", "#1=A() /* ;", "1=A();"] {
            assert!(StepText::new(path, with(data).as_bytes()).is_err(), "{data}");
        }
        let deep = with(&format!("#1=A({}{});", "(".repeat(60), ")".repeat(60)));
        for data in ["#1=A(1..);", "#1=A(1e999);", "#1=A(,);", "#1=(A()", "#1=A(.T);"] {
            let text = with(data);
            let step = StepText::new(path, text.as_bytes());
            assert!(
                step.is_err_and(|_| true) || StepText::new(path, text.as_bytes()).unwrap().entity(1).is_err(),
                "{data}"
            );
        }
        let step = StepText::new(path, deep.as_bytes()).unwrap();
        assert!(step.entity(1).is_err() && step.entity(5).is_err());
    }
}
