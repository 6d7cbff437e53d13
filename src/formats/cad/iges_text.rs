//! Text of an IGES file (version 4 to 5.3, fixed ASCII form): its entities and their parameters.

use std::collections::HashMap;
use std::path::Path;

use super::super::error::{FormatError, excerpt};

/// Columns of a line that hold data; the last of the parameter section are the number of the entity.
const DATA: usize = 72;
const PARAMETER_DATA: usize = 64;

/// Entity of the directory section.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Entry {
    /// Line of the directory section at which it begins: its name for other entities.
    pub number: u64,
    pub kind: u64,
    pub form: u64,
    /// Number of the transformation that applies to it; 0 for none.
    pub transformation: u64,
    /// True if the file says that the entity is not to be shown.
    pub is_hidden: bool,
    /// Label in the directory; empty if it has none.
    pub label: String,
    /// First line of its parameters, and how many there are.
    lines: [usize; 2],
}

/// Parameter of an entity.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Parameter {
    Number(f64),
    Text(String),
    /// A parameter that is left out.
    Empty,
}

/// Entities of a file. The parameters of each are parsed when they are asked for.
pub(super) struct IgesText<'a> {
    path: &'a Path,
    /// Lines of the parameter section.
    parameter_lines: Vec<&'a [u8]>,
    /// Marks between parameters and after the last.
    marks: [u8; 2],
    /// Parameters of the global section.
    pub(super) global: Vec<Parameter>,
    entries: Vec<Entry>,
    places: HashMap<u64, usize>,
}

impl<'a> IgesText<'a> {
    /// Divides a file into its sections, and reads the directory. `path` only names the file in messages.
    ///
    /// # Errors
    /// Text that is not IGES in the fixed form; a directory that is not complete.
    pub(super) fn new(path: &'a Path, bytes: &'a [u8]) -> Result<Self, FormatError> {
        let mut global_text = Vec::new();
        let (mut directory, mut parameter_lines) = (Vec::new(), Vec::new());
        let mut ended = false;
        for (i, line) in bytes.split(|&b| b == b'\n').enumerate() {
            let line = line.strip_suffix(b"\r").unwrap_or(line);
            if line.trim_ascii().is_empty() || ended {
                continue;
            }
            let wrong = |expected: &str| unexpected(path, &format!("line {}", i + 1), expected, excerpt(line));
            let Some(&section) = line.get(DATA) else {
                return Err(wrong("a line of 80 columns with the letter of its section in column 73"));
            };
            match section {
                b'S' => {}
                b'G' => global_text.extend_from_slice(&line[..DATA]),
                b'D' => directory.push(line),
                b'P' => parameter_lines.push(line),
                b'T' => ended = true,
                b'C' | b'B' => return Err(wrong("the fixed form of IGES; export the file again without compression")),
                _ => return Err(wrong("S, G, D, P or T in column 73")),
            }
        }
        if !ended {
            let place = "end".to_owned();
            return Err(FormatError::Cut { path: path.to_owned(), place, expected: "the section T".to_owned() });
        }
        let (marks, global) = global_parameters(&global_text)
            .ok_or_else(|| unexpected(path, "global section", "its parameters", excerpt(&global_text)))?;
        let mut text = Self { path, parameter_lines, marks, global, entries: Vec::new(), places: HashMap::new() };
        if directory.len() % 2 != 0 {
            return Err(unexpected(path, "directory", "two lines for each entity", "an odd number".to_owned()));
        }
        for (i, pair) in directory.chunks_exact(2).enumerate() {
            let entry = text.entry(2 * i as u64 + 1, [pair[0], pair[1]])?;
            text.places.insert(entry.number, text.entries.len());
            text.entries.push(entry);
        }
        Ok(text)
    }

    /// Reads an entity of the directory: twenty fields of eight columns in two lines.
    fn entry(&self, number: u64, lines: [&[u8]; 2]) -> Result<Entry, FormatError> {
        let field = |line: usize, k: usize| {
            let columns = lines[line].get(8 * k..8 * k + 8).unwrap_or_default();
            std::str::from_utf8(columns).unwrap_or_default().trim()
        };
        let integer = |line: usize, k: usize| -> Result<u64, FormatError> {
            let text = field(line, k);
            let value = if text.is_empty() { Some(0) } else { text.parse::<i64>().ok() };
            let value = value.and_then(|value| u64::try_from(value.max(0)).ok());
            value.ok_or_else(|| self.wrong(number, &format!("an integer in field {}", 10 * line + k + 1), text))
        };
        let (first, count) = (integer(0, 1)? as usize, integer(1, 3)? as usize);
        let end = first.saturating_sub(1).saturating_add(count);
        if first == 0 || end > self.parameter_lines.len() {
            return Err(self.wrong(number, "lines of the parameter section", &format!("{count} lines from {first}")));
        }
        // Label and subscript; a subscript of 0 is none.
        let label = [field(1, 7), field(1, 8).trim_start_matches('0')].concat();
        Ok(Entry {
            number,
            kind: integer(0, 0)?,
            form: integer(1, 4)?,
            transformation: integer(0, 6)?,
            // The status number has eight digits; the first two are 01 for an entity that is not shown. Blanks are zeros.
            is_hidden: lines[0].get(64..66).is_some_and(|digits| digits.ends_with(b"1")),
            label: if field(1, 7).is_empty() { String::new() } else { label },
            lines: [first - 1, end],
        })
    }

    /// Returns the entities in the order of the directory.
    pub(super) fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Returns an entity by its number.
    ///
    /// # Errors
    /// Returns an error if there is no such entity.
    pub(super) fn entry_of(&self, number: u64) -> Result<&Entry, FormatError> {
        let entry = self.places.get(&number).map(|&at| &self.entries[at]);
        entry.ok_or_else(|| self.wrong(number, "an entity of the directory", "no entity of this number"))
    }

    /// Parses the parameters of an entity, without the number of its type. What stands behind the last is a comment.
    ///
    /// # Errors
    /// Parameters that do not end, or that are neither numbers nor texts.
    pub(super) fn parameters(&self, entry: &Entry) -> Result<Vec<Parameter>, FormatError> {
        let [first, end] = entry.lines;
        let mut text = Vec::with_capacity(PARAMETER_DATA * (end - first));
        for line in &self.parameter_lines[first..end] {
            let back = std::str::from_utf8(&line[PARAMETER_DATA..DATA]).unwrap_or_default().trim();
            if !back.is_empty() && back.parse() != Ok(entry.number) {
                return Err(self.wrong(entry.number, "its own number in columns 66 to 72 of its parameters", back));
            }
            text.extend_from_slice(&line[..PARAMETER_DATA]);
        }
        let mut parameters = parse_parameters(&text, self.marks)
            .map_err(|(expected, found)| self.wrong(entry.number, expected, &found))?;
        match parameters.first() {
            Some(Parameter::Number(kind)) if *kind == entry.kind as f64 => drop(parameters.remove(0)),
            other => {
                let expected = format!("the parameters of entity type {}", entry.kind);
                return Err(self.wrong(entry.number, &expected, &format!("{other:?}")));
            }
        }
        Ok(parameters)
    }

    /// Creates the error that an entity is not as expected.
    pub(super) fn wrong(&self, number: u64, expected: &str, found: &str) -> FormatError {
        unexpected(self.path, &format!("directory entry {number}"), expected, excerpt(found.as_bytes()))
    }

    pub(super) fn path(&self) -> &Path {
        self.path
    }
}

fn unexpected(path: &Path, place: &str, expected: &str, found: String) -> FormatError {
    let (place, expected) = (place.to_owned(), expected.to_owned());
    FormatError::Unexpected { path: path.to_owned(), place, expected, found }
}

/// Reads the global section: the two marks, then parameters that they separate.
fn global_parameters(text: &[u8]) -> Option<([u8; 2], Vec<Parameter>)> {
    // The first two parameters are the marks themselves; a default is written as nothing: `,,`.
    let text = text.trim_ascii_start();
    let (between, rest) = match text.strip_prefix(b"1H") {
        Some(rest) => (*rest.first()?, rest.get(1..)?),
        None => (b',', text),
    };
    let rest = rest.strip_prefix(&[between])?;
    let (last, rest) = match rest.trim_ascii_start().strip_prefix(b"1H") {
        Some(rest) => (*rest.first()?, rest.get(1..)?),
        None => (b';', rest),
    };
    let rest = rest.strip_prefix(&[between])?;
    let parameters = parse_parameters(rest, [between, last]).ok()?;
    Some(([between, last], [Parameter::Empty, Parameter::Empty].into_iter().chain(parameters).collect()))
}

/// Parses parameters up to the mark after the last. Returns what was expected and found in their place.
fn parse_parameters(text: &[u8], [between, last]: [u8; 2]) -> Result<Vec<Parameter>, (&'static str, String)> {
    let mut parameters = Vec::new();
    let mut at = 0;
    loop {
        while text.get(at).is_some_and(u8::is_ascii_whitespace) {
            at += 1;
        }
        let digits = text[at..].iter().position(|b| !b.is_ascii_digit()).unwrap_or(text.len() - at);
        let (parameter, end) = if digits > 0 && text.get(at + digits) == Some(&b'H') {
            let begin = at + digits + 1;
            let length =
                std::str::from_utf8(&text[at..at + digits]).ok().and_then(|digits| digits.parse::<usize>().ok());
            let piece = length.and_then(|length| text.get(begin..begin.checked_add(length)?));
            let piece = piece.ok_or_else(|| ("a text as long as it says", excerpt(&text[at..])))?;
            (Parameter::Text(String::from_utf8_lossy(piece).trim().to_owned()), begin + piece.len())
        } else {
            let rest = &text[at..];
            let length = rest.iter().position(|&b| b == between || b == last);
            let length = length.ok_or_else(|| ("the mark after the last parameter", excerpt(rest)))?;
            (number(&rest[..length]).ok_or_else(|| ("a number", excerpt(&rest[..length])))?, at + length)
        };
        parameters.push(parameter);
        at = end;
        while text.get(at).is_some_and(u8::is_ascii_whitespace) {
            at += 1;
        }
        match text.get(at) {
            Some(&b) if b == last => return Ok(parameters),
            Some(&b) if b == between => at += 1,
            _ => return Err(("a mark between parameters", excerpt(&text[at.min(text.len())..]))),
        }
    }
}

/// Parses a number; a `D` is an exponent too. Blanks within it do not count.
fn number(text: &[u8]) -> Option<Parameter> {
    let plain: String = text.iter().filter(|b| !b.is_ascii_whitespace()).map(|&b| b as char).collect();
    if plain.is_empty() {
        return Some(Parameter::Empty);
    }
    let is_number = plain.bytes().all(|b| b.is_ascii_digit() || b"+-.eEdD".contains(&b));
    let value: f64 = plain.replace(['d', 'D'], "E").parse().ok().filter(|_| is_number)?;
    value.is_finite().then_some(Parameter::Number(value))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_by_hand() {
        let found = parse_parameters(b"110,1.5D0, -2.E-1,,3Hab;,7 ;comment", [b',', b';']).unwrap();
        let number = Parameter::Number;
        let expected =
            [number(110.0), number(1.5), number(-0.2), Parameter::Empty, Parameter::Text("ab;".into()), number(7.0)];
        assert_eq!(found, expected);
        for text in ["110,1", "110,abc;", "9Hab;", "110,1.5.2;", "110,inf;"] {
            assert!(parse_parameters(text.as_bytes(), [b',', b';']).is_err(), "{text}");
        }
    }

    #[test]
    fn marks_of_global_section() {
        let (marks, global) = global_parameters(b"1H,,1H;,4Hcase,2,;").unwrap();
        assert_eq!(marks, [b',', b';']);
        assert_eq!(global[2..], [Parameter::Text("case".into()), Parameter::Number(2.0), Parameter::Empty]);
        let (marks, global) = global_parameters(b"1H//1H#/3Ha,b/5#").unwrap();
        assert_eq!(marks, [b'/', b'#']);
        assert_eq!(global[3], Parameter::Number(5.0));
        assert_eq!(global_parameters(b",,5;").unwrap().0, [b',', b';']);
        assert!(global_parameters(b"").is_none());
    }
}
