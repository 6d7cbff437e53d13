//! What can be wrong with a file, said so that the reader of the message can mend it.

use std::io;
use std::path::PathBuf;

use thiserror::Error;

use super::columns::Unit;
use super::number::LIMIT_MM;

/// Why a file could not be read or written. Lines, columns and rows count from 1, bytes and vertices from 0; a place is a line or
/// a byte in words, and what was found is shortened.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum FormatError {
    /// The file could not be opened or read.
    #[error("{path}: cannot be read: {source}; check the name and the permissions")]
    Unreadable { path: PathBuf, source: io::Error },
    /// More of something, which the unit names, than is read at all: bytes, points, triangles.
    #[error("{path}: {found} is more than the limit of {limit} {unit}; thin the file out or split it")]
    TooLarge { path: PathBuf, found: u64, limit: u64, unit: &'static str },
    /// The file has no content at all.
    #[error("{path}: the file is empty, expected {expected}; export it again")]
    Empty { path: PathBuf, expected: &'static str },
    /// The file is well formed and holds nothing.
    #[error("{path}: a header but no {expected} after it; export the file again with its data")]
    NoData { path: PathBuf, expected: &'static str },
    /// A byte that no text file holds.
    #[error(
        "{path}, line {line}: expected text, found byte 0x{value:02x}: the file is binary or damaged; export the points as \
         text, one point a line, or as PLY"
    )]
    NotText { path: PathBuf, line: u64, value: u8 },
    /// Text of two bytes a character.
    #[error("{path}: expected plain text, found UTF-16; save the file as UTF-8")]
    Utf16 { path: PathBuf },
    /// A line so long that it cannot be a point.
    #[error("{path}, line {line}: longer than {limit_bytes} bytes; expected one point a line")]
    LineTooLong { path: PathBuf, line: u64, limit_bytes: usize },
    /// Text where a number should be.
    #[error(
        "{path}, line {line}, column {column}: expected a number in millimetres, found {}; remove the text or give the \
         column a header",
        quoted(found)
    )]
    NotANumber { path: PathBuf, line: u64, column: usize, found: String },
    /// NaN or an infinity.
    #[error(
        "{path}, line {line}, column {column}: expected a finite number in millimetres, found `{found}`; remove the line"
    )]
    NotFinite { path: PathBuf, line: u64, column: usize, found: String },
    /// A number no part is large enough for.
    #[error(
        "{path}, line {line}, column {column}: expected at most {LIMIT_MM:e} mm in size, found `{found}`; correct the number \
         or the unit"
    )]
    OutOfRange { path: PathBuf, line: u64, column: usize, found: String },
    /// A comma that may separate decimals or thousands.
    #[error(
        "{path}, line {line}, column {column}: `{found}` may have a decimal comma or a thousands comma; write all numbers with a \
         decimal point and without thousands separators"
    )]
    AmbiguousComma { path: PathBuf, line: u64, column: usize, found: String },
    /// Decimal points and decimal commas in one file.
    #[error(
        "{path}, line {line}, column {column}: expected a number with a decimal {expected} like those before it, found \
         `{found}`; write all numbers with a decimal point"
    )]
    DecimalMark { path: PathBuf, line: u64, column: usize, found: String, expected: &'static str },
    /// Too few columns for a point.
    #[error(
        "{path}, line {line}: expected three columns x, y, z separated by comma, semicolon, tab or blank, found {columns}: \
         {}; export the points with one of these separators",
        quoted(found)
    )]
    TooFewColumns { path: PathBuf, line: u64, columns: usize, found: String },
    /// A line with another number of columns than the first one.
    #[error(
        "{path}, line {line}: expected {expected} columns separated by {separator} as in line {first_line}, found {found}; \
         correct or remove the line"
    )]
    ColumnCount { path: PathBuf, line: u64, found: usize, expected: usize, separator: &'static str, first_line: u64 },
    /// A header that does not fit the data under it.
    #[error(
        "{path}, line {line}: the header has {found} columns separated by {separator}, the data under it has {expected}; \
         give every column one name"
    )]
    HeaderColumns { path: PathBuf, line: u64, found: usize, expected: usize, separator: &'static str },
    /// A header from which the three coordinates cannot be told.
    #[error(
        "{path}, line {line}: the header {reason}; name exactly one column each x, y and z, or give --columns where a command takes it"
    )]
    HeaderNames { path: PathBuf, line: u64, reason: String },
    /// A table of more columns than three, and nothing says which hold what.
    #[error(
        "{path}, line {line}: {columns} columns without names, and x, y and z may be any of them; put a line above them that names \
         them, or give --columns where a command takes it"
    )]
    UnnamedColumns { path: PathBuf, line: u64, columns: usize },
    /// A unit other than the one that the table is read in.
    #[error(
        "{path}, line {line}: expected coordinates in {unit}, found the unit {}; convert the file to {unit}, or give --unit, or --height-unit for z alone, where a command takes it",
        quoted(found)
    )]
    Unit { path: PathBuf, line: u64, found: String, unit: Unit },
    /// A text file that stops in the middle.
    #[error(
        "{path}, line {line}: the file is cut in the middle of a line, found {}; copy or export it again",
        quoted(found)
    )]
    CutLine { path: PathBuf, line: u64, found: String },
    /// A file that stops before what it announced.
    #[error("{path}, {place}: the file is cut, expected {expected}; copy or export it again")]
    Cut { path: PathBuf, place: String, expected: String },
    /// Something else than the format asks for.
    #[error("{path}, {place}: expected {expected}, found {}; export the file again", quoted(found))]
    Unexpected { path: PathBuf, place: String, expected: String, found: String },
    /// A face that names a vertex which is not there.
    #[error(
        "{path}, {place}: face names vertex {index}, but there are {vertices}, counted from 0; export the mesh again"
    )]
    IndexOutOfRange { path: PathBuf, place: String, index: f64, vertices: u64 },
    /// A vertex that is no position.
    #[error(
        "{path}, {place}: expected {what} as a finite number of at most {LIMIT_MM:e} mm, found {value}; repair the mesh or the \
         unit"
    )]
    BadCoordinate { path: PathBuf, place: String, what: &'static str, value: f64 },
    /// The file is a good one of another kind.
    #[error("{path}: expected {expected}, found {found}; {remedy}")]
    WrongKind { path: PathBuf, expected: &'static str, found: &'static str, remedy: &'static str },
    /// A container that is damaged, encrypted or packed in a way that is not read.
    #[error("{path}: the zip container cannot be read: {source}; copy or export the file again")]
    Container { path: PathBuf, source: zip::result::ZipError },
    /// A container without something that belongs into it.
    #[error("{path}: the container has no {expected}; export the file again")]
    Missing { path: PathBuf, expected: String },
    /// XML that is none.
    #[error("{path}, {entry}: no readable XML: {source}; export the file again")]
    Xml { path: PathBuf, entry: String, source: roxmltree::Error },
    /// Bytes that are not those that were sealed; the sums are in lower case.
    #[error(
        "{path}: {entry} was changed or damaged after it was written: its MD5 is {found}, sealed was {expected}; copy or export \
         the file again"
    )]
    Checksum { path: PathBuf, entry: String, expected: String, found: String },
    /// A map of which nobody knows how large it is.
    #[error(
        "{path}: the map has no lateral scale (the resolution in the file is {found} m a pixel), so that its size in x and y is \
         not known; calibrate the lateral resolution in the instrument's program and save the map again"
    )]
    NoLateralScale { path: PathBuf, found: f64 },
    /// A file could not be written; nothing of that name was changed.
    #[error("{path}: cannot be written, {action}: {source}; check the name, the permissions and the space left")]
    Unwritable { path: PathBuf, action: &'static str, source: io::Error },
    /// A row to be written holds NaN or an infinity.
    #[error("{path}: row {row} of the result holds {value}, which is not a finite number; nothing was written")]
    RowNotFinite { path: PathBuf, row: usize, value: f64 },
    /// A value has no form in JSON.
    #[error("{path}: cannot be written as JSON: {source}")]
    Json { path: PathBuf, source: serde_json::Error },
    /// A statement such as `# cycle: 3` that says something impossible.
    #[error("{path}, line {line}: `{key}` says `{found}`, expected {expected}; correct the line")]
    Statement { path: PathBuf, line: u64, key: &'static str, found: String, expected: &'static str },
    /// The file contradicts another one: the cell file, the plan.
    #[error("{path}: the file says that {key} is {found}, the {by} says {expected}; correct one of them")]
    Contradiction { path: PathBuf, key: &'static str, found: String, by: &'static str, expected: String },
    /// A number of a target that the plan does not have, or that came before.
    #[error("{path}, line {line}: index `{found}` {why}; export the measurement of this plan")]
    Index { path: PathBuf, line: u64, found: String, why: &'static str },
    /// More than one probe in one file.
    #[error("{path}, line {line}: probe `{found}`, the lines above have `{first}`; export one file a probe")]
    ProbeVaries { path: PathBuf, line: u64, found: String, first: String },
    /// A file of reference points that cannot be understood.
    #[error("{path}, line {line}: expected {expected}, found {found}; correct the file of reference points")]
    Reference { path: PathBuf, line: usize, expected: &'static str, found: String },
    /// A group of reference points that is not there or not unique.
    #[error(
        "{path}: no single group `{wanted}` of reference points; there are {there}; name one of them in the cell file"
    )]
    Group { path: PathBuf, wanted: String, there: String },
}

impl FormatError {
    /// Returns whether the file merely ended too early: all there is of it is good.
    pub fn is_cut(&self) -> bool {
        matches!(self, Self::Cut { .. } | Self::CutLine { .. } | Self::Empty { .. })
    }
}

/// Puts a piece of a file in backquotes; nothing there is called nothing.
fn quoted(found: &str) -> String {
    if found.is_empty() { "nothing".to_owned() } else { format!("`{found}`") }
}

/// Returns the beginning of a piece of a file, fit for a message: at most 40 characters, nothing unprintable.
pub(super) fn excerpt(bytes: &[u8]) -> String {
    const LONGEST: usize = 40;
    let text = String::from_utf8_lossy(&bytes[..bytes.len().min(4 * LONGEST)]);
    let mut short: String = text.trim_end().chars().take(LONGEST).flat_map(printable).collect();
    if text.chars().count() > LONGEST {
        short.push_str("...");
    }
    short
}

/// Returns a character as it is, or escaped if it would disturb a terminal.
fn printable(c: char) -> impl Iterator<Item = char> {
    let escaped = if c.is_control() { Some(c.escape_default()) } else { None };
    let plain = if c.is_control() { None } else { Some(c) };
    escaped.into_iter().flatten().chain(plain)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_piece_of_a_file_cannot_disturb_a_terminal() {
        assert_eq!(excerpt(b"abc \r\n"), "abc");
        assert_eq!(excerpt(b"\x1b[2J\xff"), "\\u{1b}[2J\u{fffd}");
        assert_eq!(excerpt(&[b'a'; 1000]).len(), 43);
        assert_eq!(quoted(""), "nothing");
    }
}
