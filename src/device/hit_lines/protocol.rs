//! Content of a line of a hit: three coordinates, and the angle of a rotary table if there is one.
//!
//! The eight formats are those of generic machines ("Support for Generic CMM" of PC-DMIS): numbers with a decimal mark,
//! or whole numbers in micrometres and tenths of a degree; with or without the letters of the axes before them. Nothing
//! in a line proves that it is complete, so everything in it is required: the number of values, the letters, and the
//! number of decimals.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Letters of the axes, in order.
const LETTERS: [char; 4] = ['X', 'Y', 'Z', 'W'];
/// Maximum coordinate and angle that are accepted.
const MAX_COORDINATE_MM: f64 = 1e5;
const MAX_ANGLE_DEG: f64 = 36_000.0;
/// Maximum number of digits before the decimal mark, and after it.
const MAX_DIGITS: usize = 9;

/// Format of a hit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LineFormat {
    /// `100.000,200.000,300.000`
    Decimal,
    /// `100000,200000,300000`, in micrometres
    Integer,
    /// `X100.000,Y200.000,Z300.000`
    LetteredDecimal,
    /// `X100000,Y200000,Z300000`, in micrometres
    LetteredInteger,
    /// `100.000,200.000,300.000,245.5`
    DecimalRotary,
    /// `100000,200000,300000,2455`, in micrometres and tenths of a degree
    IntegerRotary,
    /// `X100.000,Y200.000,Z300.000,W245.5`
    LetteredDecimalRotary,
    /// `X100000,Y200000,Z300000,W2455`, in micrometres and tenths of a degree
    LetteredIntegerRotary,
}

impl LineFormat {
    /// All formats, with their names in a cell file.
    pub const ALL: [(Self, &'static str); 8] = [
        (Self::Decimal, "decimal"),
        (Self::Integer, "integer"),
        (Self::LetteredDecimal, "lettered-decimal"),
        (Self::LetteredInteger, "lettered-integer"),
        (Self::DecimalRotary, "decimal-rotary"),
        (Self::IntegerRotary, "integer-rotary"),
        (Self::LetteredDecimalRotary, "lettered-decimal-rotary"),
        (Self::LetteredIntegerRotary, "lettered-integer-rotary"),
    ];

    /// Returns true if a line in this format contains integers: coordinates in micrometres and angles in tenths of a
    /// degree. Returns false if a line contains decimal numbers in millimetres and degrees.
    pub fn is_integer(self) -> bool {
        use LineFormat::*;
        matches!(self, Integer | LetteredInteger | IntegerRotary | LetteredIntegerRotary)
    }

    /// Returns true if each number of a line in this format begins with the letter of its axis, for example `X100.000`.
    pub fn is_lettered(self) -> bool {
        use LineFormat::*;
        matches!(self, LetteredDecimal | LetteredInteger | LetteredDecimalRotary | LetteredIntegerRotary)
    }

    /// Returns true if a line in this format has a fourth value, the angle of a rotary table.
    pub fn has_rotary(self) -> bool {
        use LineFormat::*;
        matches!(self, DecimalRotary | IntegerRotary | LetteredDecimalRotary | LetteredIntegerRotary)
    }

    /// Returns the name of the format in a cell file.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(format, _)| *format == self).map_or("", |(_, name)| name)
    }
}

/// Separator between two values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[expect(missing_docs, reason = "the names say it")]
pub enum Separator {
    #[default]
    Comma,
    Semicolon,
    Tab,
    Blank,
}

/// Parameters of the parsing of lines.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LineParser {
    /// Format of a line.
    pub format: LineFormat,
    /// Separator between two values.
    pub separator: Separator,
    /// Decimal mark.
    pub mark: char,
    /// Number of digits after the decimal mark of a coordinate.
    pub decimals: usize,
    /// Unit of a coordinate with a decimal mark, in mm.
    pub unit_mm: f64,
    /// Axis of each value: 0 for x.
    pub axes: [usize; 3],
}

impl Default for LineParser {
    fn default() -> Self {
        Self {
            format: LineFormat::Decimal,
            separator: Separator::Comma,
            mark: '.',
            decimals: 3,
            unit_mm: 1.0,
            axes: [0, 1, 2],
        }
    }
}

/// Content of a line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Position of the touch in the machine's frame, in mm.
    pub position_mm: [f64; 3],
    /// Angle of the rotary table, in degrees.
    pub rotary_deg: Option<f64>,
}

/// Reason why a line is refused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LineError {
    /// Number of the value, from 1; 0 for the whole line.
    pub value: usize,
    /// Explanation in words.
    pub reason: String,
}

impl LineError {
    pub(super) fn whole_line(reason: impl Into<String>) -> Self {
        Self { value: 0, reason: reason.into() }
    }
}

impl fmt::Display for LineError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.value {
            0 => f.write_str(&self.reason),
            value => write!(f, "value {value} of the line {}", self.reason),
        }
    }
}

impl LineParser {
    /// Parses a line from the machine. `line` has no line end. Returns the position in mm, and the angle of the rotary
    /// table in degrees if the format has one.
    ///
    /// # Errors
    /// Returns an error if the line has a wrong number of values, if a value does not match the format, or if a value
    /// exceeds its limit.
    pub fn read(&self, line: &str) -> Result<Hit, LineError> {
        if let Some((at, c)) = line.chars().enumerate().find(|(_, c)| !matches!(c, '\t' | ' '..='~')) {
            let reason = format!("character {} of the line is {c:?}, which is not plain text", at + 1);
            return Err(LineError::whole_line(reason));
        }
        let fields = self.fields(line)?;
        let mut at_mm = [0.0; 3];
        for (k, field) in fields.iter().take(3).enumerate() {
            at_mm[self.axes[k]] = self.coordinate(k, field)?;
        }
        let rotary_deg = fields.get(3).map(|field| self.angle(field)).transpose()?;
        Ok(Hit { position_mm: at_mm, rotary_deg })
    }

    fn fields<'l>(&self, line: &'l str) -> Result<Vec<&'l str>, LineError> {
        let line = line.trim_matches(' ');
        let fields: Vec<&str> = match self.separator {
            Separator::Comma => line.split(',').collect(),
            Separator::Semicolon => line.split(';').collect(),
            Separator::Tab => line.split('\t').collect(),
            Separator::Blank => line.split(' ').filter(|field| !field.is_empty()).collect(),
        };
        let expected = if self.format.has_rotary() { 4 } else { 3 };
        let reason = match fields.len() {
            found if found < expected => "the line is incomplete, or has another format",
            found if found > expected => "two lines are joined, or the line has another format",
            _ => return Ok(fields),
        };
        Err(LineError::whole_line(format!("the line has {} values instead of {expected}: {reason}", fields.len())))
    }

    /// Returns the number in `field` as text, without blanks and without the axis letter. `field` is the text between
    /// two separators. `k` is the index of the value in the line, from 0; the letter must belong to this index.
    ///
    /// # Errors
    /// Returns an error if the format requires an axis letter and `field` does not begin with this letter.
    fn number<'f>(&self, k: usize, field: &'f str) -> Result<&'f str, LineError> {
        let field = field.trim_matches(' ');
        if !self.format.is_lettered() {
            return Ok(field);
        }
        let letter = LETTERS[k];
        let number = field.strip_prefix(letter).or(field.strip_prefix(letter.to_ascii_lowercase()));
        number.ok_or_else(|| LineError { value: k + 1, reason: format!("is {field:?}, but must begin with {letter}") })
    }

    fn coordinate(&self, k: usize, field: &str) -> Result<f64, LineError> {
        let number = self.number(k, field)?;
        let flaw = |reason: String| LineError { value: k + 1, reason: format!("is {field:?}, {reason}") };
        let (digits, scale_mm) = match self.format.is_integer() {
            true => (0, 1e-3),
            false => (self.decimals, self.unit_mm),
        };
        let value = exact(number, self.mark, digits, digits).ok_or_else(|| match digits {
            0 => flaw("but must be a whole number".to_owned()),
            _ => flaw(format!("but must be a number with {digits} digits after a {:?}", self.mark)),
        })?;
        let value_mm = if scale_mm == 1e-3 { value / 1e3 } else { value * scale_mm };
        if value_mm.abs() > MAX_COORDINATE_MM {
            return Err(flaw(format!("but the limit is {MAX_COORDINATE_MM} mm")));
        }
        Ok(value_mm)
    }

    fn angle(&self, field: &str) -> Result<f64, LineError> {
        let number = self.number(3, field)?;
        let flaw = |reason: &str| LineError { value: 4, reason: format!("is {field:?}, {reason}") };
        let angle = match self.format.is_integer() {
            true => exact(number, self.mark, 0, 0).map(|tenths| tenths / 10.0),
            false => exact(number, self.mark, 1, MAX_DIGITS),
        };
        let angle = angle.ok_or_else(|| flaw("and not an angle"))?;
        if angle.abs() > MAX_ANGLE_DEG {
            return Err(flaw("but the limit is 36000°"));
        }
        Ok(angle)
    }

    /// Returns every parser that accepts `line`. Tries all combinations of format, separator, decimal mark and number
    /// of decimals (1 to 9). The unit and the order of the axes keep their defaults. The author of a cell file can use
    /// the result to find the right settings. Returns an empty list if no parser accepts the line.
    pub fn fitting(line: &str) -> Vec<Self> {
        let marks = [('.', Separator::Comma), ('.', Separator::Semicolon), ('.', Separator::Tab)];
        let commas = [(',', Separator::Semicolon), (',', Separator::Tab), (',', Separator::Blank)];
        let marks = marks.into_iter().chain([('.', Separator::Blank)]).chain(commas);
        let all = marks.flat_map(|(mark, separator)| {
            LineFormat::ALL.into_iter().flat_map(move |(format, _)| {
                // Whole numbers have no decimal mark, so only one mark is tried.
                let decimals = if format.is_integer() { 0..=if mark == '.' { 0 } else { -1 } } else { 1..=9 };
                decimals.map(move |decimals: i32| Self {
                    format,
                    separator,
                    mark,
                    decimals: decimals as usize,
                    ..Self::default()
                })
            })
        });
        all.filter(|reading| reading.read(line).is_ok()).collect()
    }
}

impl fmt::Display for LineParser {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "format = {:?}", self.format.name())?;
        if !self.format.is_integer() {
            write!(f, ", decimals = {}", self.decimals)?;
        }
        if self.mark == ',' {
            f.write_str(", decimal = \"comma\"")?;
        }
        match self.separator {
            Separator::Comma => Ok(()),
            Separator::Semicolon => f.write_str(", separator = \"semicolon\""),
            Separator::Tab => f.write_str(", separator = \"tab\""),
            Separator::Blank => f.write_str(", separator = \"blank\""),
        }
    }
}

/// Parses a decimal number with an optional sign. The number needs 1 to 9 digits before the decimal mark `mark`, and
/// `least` to `most` digits after the mark. The mark may be absent only if `least` is 0. If `most` is 0, no mark is
/// allowed. Returns `None` for any other text.
fn exact(text: &str, mark: char, least: usize, most: usize) -> Option<f64> {
    let digits = text.strip_prefix(['+', '-']).unwrap_or(text);
    let (whole, behind) = match digits.split_once(mark) {
        Some((whole, behind)) if most > 0 => (whole, behind),
        None if least == 0 => (digits, ""),
        _ => return None,
    };
    let are_digits = |text: &str| text.bytes().all(|b| b.is_ascii_digit());
    let fits = (1..=MAX_DIGITS).contains(&whole.len()) && (least..=most).contains(&behind.len());
    if !fits || !are_digits(whole) || !are_digits(behind) {
        return None;
    }
    let value: f64 = format!("{whole}.{behind}0").parse().ok()?;
    Some(if text.starts_with('-') { -value } else { value })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Examples of the page that the formats come from.
    const EXAMPLES: [(LineFormat, &str); 8] = [
        (LineFormat::Decimal, "100.000,200.000,300.000"),
        (LineFormat::Integer, "100000,200000,300000"),
        (LineFormat::LetteredDecimal, "X100.000,Y200.000,Z300.000"),
        (LineFormat::LetteredInteger, "X100000,Y200000,Z300000"),
        (LineFormat::DecimalRotary, "100.000,200.000,300.000,245.5"),
        (LineFormat::IntegerRotary, "100000,200000,300000,2455"),
        (LineFormat::LetteredDecimalRotary, "X100.000,Y200.000,Z300.000,W245.5"),
        (LineFormat::LetteredIntegerRotary, "X100000,Y200000,Z300000,W2455"),
    ];

    #[test]
    fn line_format_examples_are_distinct() {
        for (format, line) in EXAMPLES {
            for (other, _) in EXAMPLES {
                let read = LineParser { format: other, ..LineParser::default() }.read(line);
                if other == format {
                    let rotary_deg = format.has_rotary().then_some(245.5);
                    assert_eq!(read, Ok(Hit { position_mm: [100.0, 200.0, 300.0], rotary_deg }), "{line}");
                } else {
                    assert!(read.is_err(), "{line} as {other:?}: {read:?}");
                }
            }
            let fitting = LineParser::fitting(line);
            assert_eq!(fitting.len(), 1, "{line}: {fitting:?}");
            assert_eq!(fitting[0].format, format);
        }
        assert_eq!(LineParser::fitting(EXAMPLES[0].1)[0].to_string(), "format = \"decimal\", decimals = 3");
    }

    #[test]
    fn line_parser_refuses_damaged_line() {
        let reading = LineParser::default();
        for (line, reason) in [
            ("100.000,200.000", "the line has 2 values instead of 3: the line is incomplete"),
            ("100.000,200.000,300.00", "value 3 of the line is \"300.00\", but must be a number with 3 digits"),
            ("100.000,200.000,300.000100.000,200.000,300.000", "the line has 5 values instead of 3: two lines"),
            ("100.000,200.000,300.0001", "value 3 of the line"),
            ("100.000,,300.000", "value 2 of the line is \"\""),
            ("1OO.000,200.000,300.000", "value 1 of the line"),
            (".000,200.000,300.000", "value 1 of the line"),
            ("100.000,200.000,3e2", "value 3 of the line"),
            ("100.000,200.000,NaN", "value 3 of the line"),
            ("100.000,2\u{0}0.000,300.000", "character 10 of the line"),
            ("100.000,200 .000,300.000", "value 2 of the line"),
            ("--1.000,200.000,300.000", "value 1 of the line"),
            ("999999.000,200.000,300.000", "the limit is 100000 mm"),
            ("PROBE 1 QUALIFIED", "the line has 1 values"),
            ("", "the line has 1 values"),
        ] {
            let flaw = reading.read(line).unwrap_err().to_string();
            assert!(flaw.contains(reason), "{line:?}: {flaw}");
        }
        let lettered = LineParser { format: LineFormat::LetteredDecimal, ..reading };
        for line in ["X1.000,Z2.000,Y3.000", "1.000,2.000,3.000", "X1.000,Y2.000,Z3.000,W1.0"] {
            assert!(lettered.read(line).is_err(), "{line}");
        }
        assert_eq!(lettered.read(" x-1.000, y+2.000,  z0.500").unwrap().position_mm, [-1.0, 2.0, 0.5]);
    }

    #[test]
    fn line_parser_detects_lost_character() {
        let reading = LineParser::default();
        let line = "-12.345,0.007,123.400";
        let whole = reading.read(line).unwrap().position_mm;
        for lost in 0..line.len() {
            let short: String = line.chars().enumerate().filter(|(k, _)| *k != lost).map(|(_, c)| c).collect();
            if let Ok(hit) = reading.read(&short) {
                // A sign, or a digit before the mark, is missing: the error is then millimetres.
                let away = (0..3).map(|k| (hit.position_mm[k] - whole[k]).abs()).fold(0.0, f64::max);
                assert!(away >= 1.0, "{short}: {away}");
            }
        }
    }

    #[test]
    fn line_parser_follows_cell_file() {
        let german = LineParser { mark: ',', separator: Separator::Semicolon, ..LineParser::default() };
        assert_eq!(german.read("1,500;-2,250;0,125").unwrap().position_mm, [1.5, -2.25, 0.125]);
        assert!(german.read("1.500;-2.250;0.125").is_err());
        let blanks = LineParser { separator: Separator::Blank, decimals: 4, unit_mm: 25.4, ..LineParser::default() };
        assert_eq!(blanks.read("  1.0000   2.0000 -0.5000 ").unwrap().position_mm, [25.4, 50.8, -12.7]);
        let turned = LineParser { axes: [1, 2, 0], ..LineParser::default() };
        assert_eq!(turned.read("1.000,2.000,3.000").unwrap().position_mm, [3.0, 1.0, 2.0]);
        assert_eq!(LineParser::fitting("1,500;-2,250;0,125")[0], german);
    }
}
