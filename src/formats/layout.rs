//! Layout of a text cloud: separator, columns, decimal mark, units. It is detected in the first lines and then required
//! of all.

use std::borrow::Cow;
use std::path::Path;

use super::columns::{Axes, StatedUnits, Table, is_unit, split_unit, text_of};
use super::error::{FormatError, excerpt};
use super::number::{Decimal, Evidence, evidence, looks_numeric, without_blanks};
use super::unit::Unit;

/// Separator between two columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Separator {
    Comma,
    Semicolon,
    Tab,
    /// Any run of blanks and tabs.
    Blank,
}

impl Separator {
    /// All separators, in the order in which they are tried: a tab or a semicolon in a line is almost always the
    /// separator.
    const ALL: [Self; 4] = [Self::Tab, Self::Semicolon, Self::Comma, Self::Blank];

    /// Returns the byte that separates columns. For [`Self::Blank`] this is the blank, although a tab separates too.
    pub(super) fn byte(self) -> u8 {
        match self {
            Self::Comma => b',',
            Self::Semicolon => b';',
            Self::Tab => b'\t',
            Self::Blank => b' ',
        }
    }

    /// Returns true if `byte` is padding, which is removed before and after a field. Padding is the blank, and the tab
    /// unless the tab separates columns.
    pub(super) fn pads(self, byte: u8) -> bool {
        byte == b' ' || (byte == b'\t' && self != Self::Tab)
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Comma => "comma",
            Self::Semicolon => "semicolon",
            Self::Tab => "tab",
            Self::Blank => "blank",
        }
    }

    /// Returns `field` without the blanks between the thousands of its number: `1 234` becomes `1234`. Returns `field`
    /// unchanged if a comma or blanks separate the columns, or if `field` is not a number with such blanks.
    pub(super) fn ungrouped(self, field: &[u8]) -> Cow<'_, [u8]> {
        let may = matches!(self, Self::Tab | Self::Semicolon);
        may.then(|| without_blanks(field)).flatten().map_or(Cow::Borrowed(field), Cow::Owned)
    }

    fn separates(self, byte: u8) -> bool {
        byte == self.byte() || (self == Self::Blank && byte == b'\t')
    }
}

/// Columns of one line, trimmed and without their quotes.
pub(super) struct Fields<'a> {
    rest: Option<&'a [u8]>,
    separator: Separator,
}

impl<'a> Fields<'a> {
    pub(super) fn new(line: &'a [u8], separator: Separator) -> Self {
        let rest = if separator == Separator::Blank { line.trim_ascii() } else { line };
        Self { rest: Some(rest), separator }
    }
}

impl<'a> Iterator for Fields<'a> {
    type Item = &'a [u8];

    fn next(&mut self) -> Option<&'a [u8]> {
        let rest = self.rest?;
        let padding = rest.iter().take_while(|&&b| self.separator.pads(b)).count();
        let start = &rest[padding..];
        // A separator inside quotes does not count. A quote that is never closed stays in the field, and its parsing
        // reports it.
        let closing = match start {
            [b'"', inside @ ..] => inside.iter().position(|&b| b == b'"').map_or(0, |at| at + 1),
            _ => 0,
        };
        let end = start[closing..].iter().position(|&b| self.separator.separates(b)).map(|at| at + closing);
        self.rest = end.map(|at| &start[at + 1..]);
        let field = start[..end.unwrap_or(start.len())].trim_ascii();
        if self.separator == Separator::Blank {
            self.rest = self.rest.map(<[u8]>::trim_ascii_start);
        }
        Some(field.strip_prefix(b"\"").and_then(|f| f.strip_suffix(b"\"")).map_or(field, <[u8]>::trim_ascii))
    }
}

/// Layout that applies to every line of a cloud.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Layout {
    pub(super) separator: Separator,
    /// Columns of x, y and z, from 0.
    pub(super) columns: [usize; 3],
    /// Number of columns of every line.
    pub(super) count: usize,
    pub(super) decimal: Decimal,
    /// First line with data, from 1.
    pub(super) first_line: u64,
}

impl Layout {
    /// Returns the texts of x, y and z in `line`, and the number of columns of `line`. The text of a coordinate is
    /// empty if `line` does not have its column.
    pub(super) fn pick<'a>(&self, line: &'a [u8]) -> ([&'a [u8]; 3], usize) {
        let mut picked = [&line[..0]; 3];
        let mut count = 0;
        for field in Fields::new(line, self.separator) {
            if let Some(axis) = self.columns.iter().position(|&column| column == count) {
                picked[axis] = field;
            }
            count += 1;
        }
        (picked, count)
    }

    /// Determines the decimal mark of a file (point or comma) and stores it in `self.decimal`. `text` is the rest of
    /// the file from the first line of data. The first coordinate with an unambiguous mark decides: `2.5`, `0,123` or
    /// `2,512.1`, but not `2,512`. `self.decimal` stays unchanged if no coordinate has a mark, or if a comma separates
    /// the columns and `text` contains no quotes. `path` only names the file in messages.
    ///
    /// # Errors
    /// Coordinates with a comma, none of which shows whether the comma is the decimal mark or separates thousands. The
    /// error names the first of these coordinates.
    pub(super) fn settle_decimal(&mut self, path: &Path, text: &[u8]) -> Result<(), FormatError> {
        if self.separator == Separator::Comma && !text.contains(&b'"') {
            return Ok(());
        }
        let mut doubtful = None;
        for (number, line) in (self.first_line..).zip(text.split(|&b| b == b'\n')) {
            if is_comment(line) {
                continue;
            }
            let (fields, _) = self.pick(line);
            for (field, column) in fields.iter().zip(self.columns) {
                match evidence(&self.separator.ungrouped(field)) {
                    Evidence::Says(decimal) => {
                        self.decimal = decimal;
                        return Ok(());
                    }
                    Evidence::Ambiguous => doubtful = doubtful.or(Some((number, column + 1, *field))),
                    Evidence::Nothing => {}
                }
            }
        }
        doubtful.map_or(Ok(()), |(line, column, field)| {
            Err(FormatError::AmbiguousComma { path: path.to_owned(), line, column, found: excerpt(field) })
        })
    }
}

/// Returns true if a line is a comment: it begins with `#` or `//`, after blanks.
pub(super) fn is_comment(line: &[u8]) -> bool {
    let line = line.trim_ascii_start();
    line.starts_with(b"#") || line.starts_with(b"//")
}

/// Lines above the data, collected until the first point shows the layout.
#[derive(Debug)]
pub(super) struct Preamble<'p> {
    path: &'p Path,
    /// True if nominal points are wanted.
    of_nominal: bool,
    /// Columns and unit that a person gave.
    table: &'p Table,
    /// Last comment that names x, y and z: many programs write their header as a comment.
    comment: Option<(u64, Vec<u8>)>,
    header: Option<(u64, Vec<u8>)>,
    /// Line of units below the header.
    units: Option<(u64, Vec<String>)>,
    /// Error for a line of words and numbers; the line is a title, and no error, if a header follows it.
    title: Option<FormatError>,
}

impl<'p> Preamble<'p> {
    pub(super) fn new(path: &'p Path, of_nominal: bool, table: &'p Table) -> Self {
        Self { path, of_nominal, table, comment: None, header: None, units: None, title: None }
    }

    /// Returns the names of the columns, in lower case. They are read from the header, or else from the last comment
    /// that can be a header. `separator` separates the columns. Returns an empty list if there is no header and no such
    /// comment.
    pub(super) fn names(&self, separator: Separator) -> Vec<String> {
        let header = self.header.as_ref().or(self.comment.as_ref());
        header.map_or(Vec::new(), |(_, line)| names(line, separator))
    }

    /// Reads the next line of a table. Returns the layout of the table if `line` contains the first point. Returns
    /// `None` if `line` is above the first point: a blank line, a comment, a title, a header or a line of units.
    /// `number` is the line number, from 1.
    ///
    /// # Errors
    /// A line that is neither a point nor one of these; a unit other than the unit in which the table is read; a table
    /// whose columns x, y and z are ambiguous.
    pub(super) fn read_line(&mut self, line: &[u8], number: u64) -> Result<Option<Layout>, FormatError> {
        let content = line.trim_ascii();
        if content.is_empty() || (number == 1 && is_separator_line(content)) {
            return Ok(None);
        }
        if is_comment(content) {
            self.take_comment(content, number)?;
            return Ok(None);
        }
        let Some(separator) = data_separator(line) else {
            return self.read_words(line, number).map(|()| None);
        };
        if let Some(title) = self.title.take() {
            return Err(title);
        }
        let count = Fields::new(line, separator).count();
        let columns = self.columns(separator, (line, count), number)?;
        self.check_unit_line(columns, count)?;
        Ok(Some(Layout { separator, columns, count, decimal: Decimal::Point, first_line: number }))
    }

    /// Stores `line`, a line without a point, as the header, the units of the columns, or a title (a line above the
    /// header). `number` is the line number. Returns an error if `line` is below the header and does not contain units,
    /// or if a title states a unit other than the unit in which the table is read.
    fn read_words(&mut self, line: &[u8], number: u64) -> Result<(), FormatError> {
        let likely = likely_separator(line);
        let fields: Vec<&[u8]> = Fields::new(line, likely).collect();
        let has_header = self.header.as_ref().is_some_and(|(_, header)| self.is_understood(header));
        if has_header && self.take_units(&fields, number) {
            return Ok(());
        }
        if !has_header && !self.is_understood(line) {
            self.check_title(line, number)?;
        }
        if !has_header && !fields.iter().any(|field| looks_numeric(field)) {
            // Lines above the header are titles.
            self.header = Some((number, line.to_vec()));
            if self.is_understood(line) {
                self.title = None;
            }
            return Ok(());
        }
        let error = self.no_point(line, number);
        if has_header {
            return Err(error);
        }
        self.title = self.title.take().or(Some(error));
        Ok(())
    }

    /// Returns the error for `line`, which contains no point. The error states that `line` has fewer than three
    /// columns, or else names the first field that is not a number. `number` is the line number.
    fn no_point(&self, line: &[u8], number: u64) -> FormatError {
        let path = self.path.to_owned();
        let fields: Vec<&[u8]> = Fields::new(line, likely_separator(line)).collect();
        let wrong = fields.iter().position(|field| !looks_numeric(field)).unwrap_or(0);
        match fields.len() < 3 {
            true => FormatError::TooFewColumns { path, line: number, columns: fields.len(), found: excerpt(line) },
            false => FormatError::NotANumber { path, line: number, column: wrong + 1, found: excerpt(fields[wrong]) },
        }
    }

    /// Returns the error for a file in which no point was found. The error names the first line that is neither a point
    /// nor a header. If there is no such line, the error states that the file has only a header, or that the file is
    /// empty.
    pub(super) fn without_points(mut self) -> FormatError {
        let path = self.path.to_owned();
        match (self.title.take(), &self.header) {
            (Some(title), _) => title,
            (None, Some((number, header))) if !self.is_understood(header) => self.no_point(header, *number),
            (None, Some(_)) => FormatError::NoData { path, expected: "points" },
            (None, None) => FormatError::Empty { path, expected: "points" },
        }
    }

    /// Returns true if `header` can be the header of the table. If a person gave no columns, `header` must name x, y
    /// and z. If a person gave columns by their names, `header` must contain each of these names once. If a person gave
    /// all columns by their numbers, `header` must have at least three columns.
    fn is_understood(&self, header: &[u8]) -> bool {
        let names = names(header, likely_separator(header));
        match &self.table.columns {
            Some(columns) if columns.are_numbers() => names.len() > 2,
            Some(columns) => columns.are_in(&names),
            None => Axes::from_names(&names).are_named(),
        }
    }

    /// Rejects `found`, the unit that line number `line` states, unless it is `unit`, the unit in which the table is
    /// read.
    fn check_unit(&self, line: u64, found: String, unit: Unit) -> Result<(), FormatError> {
        if unit.is(&found) { Ok(()) } else { Err(FormatError::Unit { path: self.path.to_owned(), line, found, unit }) }
    }

    /// Rejects `text`, the content of line number `line`, if it states a unit other than the unit in which the table is
    /// read. A unit for all coordinates is compared with the unit of x and y. A unit for the heights is compared with
    /// the unit of z.
    fn check_stated(&self, line: u64, text: &[u8]) -> Result<(), FormatError> {
        self.check_heights(line, text)?;
        let of_all = StatedUnits::found_in(&text_of(text)).of_all;
        of_all.map_or(Ok(()), |found| self.check_unit(line, found, self.table.units()[0]))
    }

    /// Rejects `text`, the content of line number `line`, if it states a unit for the heights that is not the unit in
    /// which z is read. For example, `height in um` is rejected if z is read in millimetres.
    fn check_heights(&self, line: u64, text: &[u8]) -> Result<(), FormatError> {
        let of_heights = StatedUnits::found_in(&text_of(text)).of_heights;
        of_heights.map_or(Ok(()), |found| self.check_unit(line, found, self.table.units()[2]))
    }

    /// Rejects `title`, a line above the header, if it states a unit other than the unit in which the table is read. A
    /// unit for the heights is always checked. A unit for all coordinates is checked only if no person gave the unit of
    /// the table. `number` is the line number of the title.
    fn check_title(&self, title: &[u8], number: u64) -> Result<(), FormatError> {
        if self.table.unit.is_some() { self.check_heights(number, title) } else { self.check_stated(number, title) }
    }

    /// Rejects a header that states, for x, y or z, a unit other than the unit in which this coordinate is read.
    /// `names` are the names of all columns, with their units. `columns` are the indices of x, y and z in `names`.
    /// `line` is the line number of the header.
    fn check_units(&self, line: u64, columns: [usize; 3], names: &[String]) -> Result<(), FormatError> {
        let stated = |column: usize| split_unit(names.get(column)?).1;
        let pairs = columns.into_iter().zip(self.table.units());
        pairs
            .filter_map(|(column, unit)| Some((stated(column)?, unit)))
            .try_for_each(|(found, unit)| self.check_unit(line, found, unit))
    }

    /// Rejects a table if the line of units below its header contains a unit other than the unit in which the table is
    /// read. Accepts a table without such a line. `columns` are the indices of x, y and z, and `count` is the number of
    /// columns of the table.
    ///
    /// If the line has one unit for each column, only the units of x, y and z are compared, each with the unit of its
    /// coordinate. Otherwise all units in the line are compared with the unit of x and y.
    fn check_unit_line(&self, columns: [usize; 3], count: usize) -> Result<(), FormatError> {
        let Some((line, units)) = &self.units else { return Ok(()) };
        let of_axes = self.table.units();
        let unit_of = |column: usize| match columns.iter().position(|of| *of == column) {
            Some(axis) if units.len() == count => Some(of_axes[axis]),
            Some(_) => Some(of_axes[0]),
            // A column other than the coordinates has its own unit.
            None => (units.len() != count).then_some(of_axes[0]),
        };
        let stated = units.iter().enumerate().filter(|(_, found)| !found.is_empty());
        stated
            .filter_map(|(column, found)| Some((found, unit_of(column)?)))
            .try_for_each(|(found, unit)| self.check_unit(*line, found.clone(), unit))
    }

    /// Stores `fields`, the fields of a line below the header, as the units of the columns, and returns true. A field
    /// can be empty. Returns false, and stores nothing, if a field is neither empty nor a unit of length, if all fields
    /// are empty, or if units are already stored. `number` is the line number.
    fn take_units(&mut self, fields: &[&[u8]], number: u64) -> bool {
        let unit = |field: &&[u8]| text_of(field).trim_matches(['[', ']', '(', ')', ' ']).to_lowercase();
        let units: Vec<String> = fields.iter().map(unit).collect();
        let is_one = self.units.is_none()
            && units.iter().any(|unit| !unit.is_empty())
            && units.iter().all(|unit| unit.is_empty() || is_unit(unit));
        if is_one {
            self.units = Some((number, units));
        }
        is_one
    }

    fn take_comment(&mut self, comment: &[u8], number: u64) -> Result<(), FormatError> {
        let text = comment.trim_ascii_start();
        let text = text.strip_prefix(b"//").unwrap_or(text).trim_ascii_start();
        let start = text.iter().position(|&b| b != b'#').unwrap_or(text.len());
        let text = text[start..].trim_ascii();
        self.check_stated(number, text)?;
        if self.is_understood(text) {
            self.comment = Some((number, text.to_vec()));
        }
        Ok(())
    }

    /// Returns the indices, from 0, of the columns x, y and z. Columns that a person gave have priority over the names
    /// in the header. A table without given columns and without a header must have three columns, or six columns of
    /// which the last three are a unit normal. In this case, the first three columns are x, y and z.
    ///
    /// `separator` separates the columns. `data` is the first line with a point, `count` the number of its columns and
    /// `data_line` its line number.
    ///
    /// # Errors
    /// Given columns that do not exist; a header that does not name x, y and z once each; a header with another number
    /// of columns than `data`, or with a unit other than the unit in which the table is read; a table without a header
    /// that has another number of columns than three or six.
    fn columns(
        &self,
        separator: Separator,
        (data, count): (&[u8], usize),
        data_line: u64,
    ) -> Result<[usize; 3], FormatError> {
        let path = || self.path.to_owned();
        if let Some(columns) = self.table.columns.as_ref().filter(|columns| columns.are_numbers()) {
            let refused = |reason| FormatError::HeaderNames { path: path(), line: data_line, reason };
            let places = columns.places(&[], count).map_err(refused)?;
            let header = self.header.as_ref().or(self.comment.as_ref());
            let named = header.map(|(line, header)| (*line, names(header, separator))).filter(|of| of.1.len() == count);
            return match named {
                Some((line, names)) => self.check_units(line, places, &names).map(|()| places),
                None => Ok(places),
            };
        }
        let (line, names) = match (&self.header, &self.comment) {
            (Some((line, header)), _) => (*line, names(header, separator)),
            (None, Some((line, comment))) => {
                let own = if comment.contains(&separator.byte()) { separator } else { Separator::Blank };
                (*line, names(comment, own))
            }
            (None, None) if self.table.columns.is_some() => (data_line, Vec::new()),
            (None, None) => {
                let is_clear = count == 3 || (count == 6 && has_normal(data, separator));
                let refused = FormatError::UnnamedColumns { path: path(), line: data_line, columns: count };
                return if is_clear { Ok([0, 1, 2]) } else { Err(refused) };
            }
        };
        let columns = match &self.table.columns {
            Some(columns) => columns.places(&names, count),
            None => Axes::from_names(&names).chosen(self.of_nominal),
        };
        if names.len() != count && !names.is_empty() {
            // A comment can be a sentence that names the three columns of a table in their order.
            let is_sentence = self.header.is_none() && count == 3 && names.len() > count;
            if is_sentence && columns.as_ref().is_ok_and(|columns| columns.is_sorted()) {
                return Ok([0, 1, 2]);
            }
            let separator = separator.name();
            return Err(FormatError::HeaderColumns {
                path: path(),
                line,
                found: names.len(),
                expected: count,
                separator,
            });
        }
        let columns = columns.map_err(|reason| FormatError::HeaderNames { path: path(), line, reason })?;
        self.check_units(line, columns, &names)?;
        Ok(columns)
    }
}

/// Returns true if the last three of the six columns of a line are a vector of length 1.
fn has_normal(line: &[u8], separator: Separator) -> bool {
    const OFF: f64 = 1e-3;
    let last = Fields::new(line, separator).skip(3);
    let squares: Option<Vec<f64>> =
        last.map(|field| std::str::from_utf8(field).ok()?.parse().ok().map(|value: f64| value * value)).collect();
    squares.is_some_and(|squares| (squares.iter().sum::<f64>() - 1.0).abs() < OFF)
}

/// Returns the separator that divides `line` into fields of which the first three are numbers. If there is none,
/// returns a separator that divides `line` into fields of which any three are numbers. The separators are tried in the
/// order tab, semicolon, comma, blank. Returns `None` if no separator gives three numbers.
fn data_separator(line: &[u8]) -> Option<Separator> {
    let numbers = |separator: Separator, first: usize| {
        let fields = Fields::new(line, separator).take(first);
        fields.filter(|field| looks_numeric(&separator.ungrouped(field))).count()
    };
    let first_three = Separator::ALL.into_iter().find(|&separator| numbers(separator, 3) == 3);
    first_three.or_else(|| Separator::ALL.into_iter().find(|&separator| numbers(separator, usize::MAX) >= 3))
}

/// Returns the first of tab, semicolon and comma that a line contains, or else the blank.
fn likely_separator(line: &[u8]) -> Separator {
    let there = |separator: &Separator| line.contains(&separator.byte());
    Separator::ALL.into_iter().find(there).unwrap_or(Separator::Blank)
}

/// Returns the names of the columns in `header`, converted to lower case. If blanks separate the columns, a unit in
/// brackets is appended to the name before it: `x [mm]` is one name.
fn names(header: &[u8], separator: Separator) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for field in Fields::new(header, separator) {
        let name = text_of(field).to_lowercase();
        match names.last_mut() {
            Some(last) if separator == Separator::Blank && name.starts_with(['[', '(']) => *last += &name,
            _ => names.push(name),
        }
    }
    names
}

/// Returns true if a line only states the separator of the table, as Excel writes it: `sep=;`.
pub(super) fn is_separator_line(line: &[u8]) -> bool {
    let line = line.trim_ascii();
    line.len() <= 5 && line.get(..4).is_some_and(|word| word.eq_ignore_ascii_case(b"sep="))
}

/// Returns true if `lines` contains no data: only separators, quotes, blanks, line ends and the end-of-file marks of
/// old systems (0x1A).
pub(super) fn are_empty_rows(lines: &[u8], separator: Separator) -> bool {
    lines.iter().all(|b| b"\"\x1a \t\r\n".contains(b) || separator.separates(*b))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fields(line: &str, separator: Separator) -> Vec<String> {
        Fields::new(line.as_bytes(), separator).map(|f| String::from_utf8_lossy(f).into_owned()).collect()
    }

    #[test]
    fn fields_split_outside_quotes() {
        assert_eq!(fields(" 1 , \"2,5\",3", Separator::Comma), ["1", "2,5", "3"]);
        assert_eq!(fields("\ta b\t\t", Separator::Tab), ["", "a b", "", ""]);
        assert_eq!(fields("  1 \t 2   3  ", Separator::Blank), ["1", "2", "3"]);
        assert_eq!(fields("1;\"2;3", Separator::Semicolon), ["1", "\"2", "3"]);
        assert_eq!(fields("", Separator::Comma), [""]);
    }

    #[test]
    fn data_separator_yields_a_point() {
        let cases = [
            ("1,2,3", Separator::Comma),
            ("1, 2, 3", Separator::Comma),
            ("1,5;2,5;3,5", Separator::Semicolon),
            ("1,5 2,5 3,5", Separator::Blank),
            ("1,5\t2,5\t3,5", Separator::Tab),
            ("\t1 2 3", Separator::Blank),
            ("P1\tok\t2,512.1\t2,217.6\t2,370.7", Separator::Tab),
            ("nan inf 1", Separator::Blank),
        ];
        for (line, separator) in cases {
            assert_eq!(data_separator(line.as_bytes()), Some(separator), "{line}");
        }
        assert_eq!(data_separator(b"x,y,z"), None);
        assert_eq!(data_separator(b"1,2"), None);
    }
}
