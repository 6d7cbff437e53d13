//! Errors of reading and writing files, worded so that the reader of a message can repair the file.

use std::io;
use std::path::PathBuf;

use thiserror::Error;

use super::number::LIMIT_MM;
use super::unit::Unit;

/// Reason why a file could not be read or written. Lines, columns and rows count from 1, bytes and vertices from 0.
/// `place` is a text that names a line, a byte or an element. `found` is a shortened piece of the file.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum FormatError {
    /// The file could not be opened or read.
    #[error("{path}: cannot be read: {source}; check the name and the permissions")]
    Unreadable { path: PathBuf, source: io::Error },
    /// The name of a recipe is not plain.
    #[error(
        "`{}` is no name for a recipe; write letters, digits, spaces or signs except / \\ : * ? < > | and \", at most 95 bytes, and `.toml` at the end",
        name.escape_debug()
    )]
    RecipeName { name: String },
    /// A recipe that another person or program has changed since it was read.
    #[error("{path}: the file was changed meanwhile; compare your text with the present one, then save again")]
    ChangedMeanwhile { path: PathBuf },
    /// A file that is no recipe.
    #[error("{path}: this is no recipe, because it has no table [part]; this page opens and saves recipes only")]
    NoRecipe { path: PathBuf },
    /// A link to a file that is not in the folder of the recipes.
    #[error("{path}: this link leads out of the folder of the recipes, or nowhere; replace it by the file itself")]
    RecipeElsewhere { path: PathBuf },
    /// A recipe that another program saves or has locked.
    #[error("{path}: another program has locked this recipe for more than 3 s; end that program, then save again")]
    RecipeBusy { path: PathBuf },
    /// A saved version that differs from its description.
    #[error("{path}: this saved version was changed; take another version, or restore the file from a backup")]
    ChangedVersion { path: PathBuf },
    /// The file has more bytes, points or triangles (`unit` says which) than are read.
    #[error("{path}: the file has {found} {unit}, more than the limit of {limit}; reduce or split the file")]
    TooLarge { path: PathBuf, found: u64, limit: u64, unit: &'static str },
    /// The file has no content at all.
    #[error("{path}: the file is empty, expected {expected}; export the file again")]
    Empty { path: PathBuf, expected: &'static str },
    /// The file is well formed, but contains no data.
    #[error("{path}: the file has no {expected}; export the file again with its data")]
    NoData { path: PathBuf, expected: &'static str },
    /// A byte that does not occur in a text file.
    #[error(
        "{path}, line {line}: expected text, found byte 0x{value:02x}: the file is binary or damaged; export the \
         points as text, one point per line, or as PLY"
    )]
    NotText { path: PathBuf, line: u64, value: u8 },
    /// Text with two bytes per character.
    #[error("{path}: expected plain text, found UTF-16; save the file as UTF-8")]
    Utf16 { path: PathBuf },
    /// A line that is too long for a point.
    #[error("{path}, line {line}: the line is longer than {limit_bytes} bytes; write one point per line")]
    LineTooLong { path: PathBuf, line: u64, limit_bytes: usize },
    /// Text where a number should be.
    #[error(
        "{path}, line {line}, column {column}: expected a number in mm, found {}; remove the text or give the column \
         a header",
        quoted(found)
    )]
    NotANumber { path: PathBuf, line: u64, column: usize, found: String },
    /// NaN or an infinity.
    #[error("{path}, line {line}, column {column}: expected a finite number in mm, found `{found}`; remove the line")]
    NotFinite { path: PathBuf, line: u64, column: usize, found: String },
    /// A number that is too large for a coordinate of a part.
    #[error(
        "{path}, line {line}, column {column}: expected a number of at most {LIMIT_MM:e} mm, found `{found}`; correct the number \
         or the unit"
    )]
    OutOfRange { path: PathBuf, line: u64, column: usize, found: String },
    /// A comma that separates either decimals or thousands: ambiguous.
    #[error(
        "{path}, line {line}, column {column}: the comma of `{found}` can be a decimal mark or a thousands separator; write all \
         numbers with a decimal point and without thousands separators"
    )]
    AmbiguousComma { path: PathBuf, line: u64, column: usize, found: String },
    /// Decimal points and decimal commas in the same file.
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
    /// A line whose number of columns differs from that of the first line.
    #[error(
        "{path}, line {line}: expected {expected} columns separated by {separator} as in line {first_line}, found {found}; \
         correct or remove the line"
    )]
    ColumnCount { path: PathBuf, line: u64, found: usize, expected: usize, separator: &'static str, first_line: u64 },
    /// A header that does not match the data below it.
    #[error(
        "{path}, line {line}: the header has {found} columns separated by {separator}, the data under it has {expected}; \
         give every column one name"
    )]
    HeaderColumns { path: PathBuf, line: u64, found: usize, expected: usize, separator: &'static str },
    /// A header that does not identify the three coordinates.
    #[error(
        "{path}, line {line}: the header {reason}; name exactly one column each x, y and z, or give --columns if the \
         command has it"
    )]
    HeaderNames { path: PathBuf, line: u64, reason: String },
    /// A table with more than three columns and no statement of which ones hold the coordinates.
    #[error(
        "{path}, line {line}: {columns} columns without names, so x, y and z are unknown; add a header line with the \
         names, or give --columns if the command has it"
    )]
    UnnamedColumns { path: PathBuf, line: u64, columns: usize },
    /// A unit other than the one in which the table is read.
    #[error(
        "{path}, line {line}: expected coordinates in {unit}, found the unit {}; convert the file to {unit}, or give \
         --unit, or --height-unit for z alone, if the command has it",
        quoted(found)
    )]
    Unit { path: PathBuf, line: u64, found: String, unit: Unit },
    /// A text file that ends in the middle of a line.
    #[error(
        "{path}, line {line}: the file ends too early, in the middle of a line, found {}; copy or export the file again",
        quoted(found)
    )]
    CutLine { path: PathBuf, line: u64, found: String },
    /// A file that ends before the amount of data that it announced.
    #[error("{path}, {place}: the file ends too early, expected {expected}; copy or export the file again")]
    Cut { path: PathBuf, place: String, expected: String },
    /// Content that differs from what the format requires.
    #[error("{path}, {place}: expected {expected}, found {}; export the file again", quoted(found))]
    Unexpected { path: PathBuf, place: String, expected: String, found: String },
    /// A face that refers to a vertex that does not exist.
    #[error(
        "{path}, {place}: a face refers to vertex {index}, but the mesh has {vertices} vertices, counted from 0; export the mesh again"
    )]
    IndexOutOfRange { path: PathBuf, place: String, index: f64, vertices: u64 },
    /// A vertex that is not a valid position.
    #[error(
        "{path}, {place}: expected {what} as a finite number of at most {LIMIT_MM:e} mm, found {value}; correct the mesh or its \
         unit"
    )]
    BadCoordinate { path: PathBuf, place: String, what: &'static str, value: f64 },
    /// The file is a valid file of another format.
    #[error("{path}: expected {expected}, found {found}; {remedy}")]
    WrongKind { path: PathBuf, expected: &'static str, found: &'static str, remedy: &'static str },
    /// The file is of a version of its format that is not read.
    #[error("{path}: expected {expected}, found {found}; {remedy}")]
    Version { path: PathBuf, expected: &'static str, found: String, remedy: &'static str },
    /// A container that is damaged, encrypted or compressed by an unsupported method.
    #[error("{path}: the zip container cannot be read: {source}; copy or export the file again")]
    Container { path: PathBuf, source: zip::result::ZipError },
    /// A container without an entry that it requires.
    #[error("{path}: the container has no {expected}; export the file again")]
    Missing { path: PathBuf, expected: String },
    /// Text that is not well-formed XML.
    #[error("{path}, {entry}: not readable as XML: {source}; export the file again")]
    Xml { path: PathBuf, entry: String, source: roxmltree::Error },
    /// Bytes whose checksum differs from the recorded one; the checksums are in lower case.
    #[error(
        "{path}: {entry} was changed or damaged after it was written: its MD5 is {found}, expected {expected}; copy \
         or export the file again"
    )]
    Checksum { path: PathBuf, entry: String, expected: String, found: String },
    /// A map whose scale (lateral size) is unknown.
    #[error(
        "{path}: the map has no lateral scale (the resolution in the file is {found} m per pixel), so its size in x \
         and y is unknown; calibrate the lateral resolution in the instrument's program and save the map again, or \
         give the distance of its samples (--sample-spacing, or sample_spacing_mm in the cell file)"
    )]
    NoLateralScale { path: PathBuf, found: f64 },
    /// A distance of the samples that is given for a map that states its own.
    #[error(
        "{path}: a distance of the samples of {given} mm is given, but the map states its own ({} mm along x, {} mm \
         along y); remove the given one (--sample-spacing, or sample_spacing_mm in the cell file)",
        stated_mm[0],
        stated_mm[1]
    )]
    LateralScaleStated { path: PathBuf, stated_mm: [f64; 2], given: f64 },
    /// A distance of the samples that is given for a file that is no map over a regular grid.
    #[error(
        "{path}: a distance of the samples is given, but the file is not a map of heights over a regular grid; remove \
         the distance (--sample-spacing, or sample_spacing_mm in the cell file)"
    )]
    NotAMap { path: PathBuf },
    /// A file could not be written; an existing file of that name is unchanged.
    #[error("{path}: {action} failed: {source}; check the name, the permissions and the free space")]
    Unwritable { path: PathBuf, action: &'static str, source: io::Error },
    /// A row to be written holds NaN or an infinity.
    #[error(
        "{path}: row {row} of the result has {value}, which is not a finite number; nothing was written; report this fault with the input files"
    )]
    RowNotFinite { path: PathBuf, row: usize, value: f64 },
    /// A value that JSON cannot express.
    #[error("{path}: cannot be written as JSON: {source}; report this fault with the input files")]
    Json { path: PathBuf, source: serde_json::Error },
    /// A statement such as `# cycle: 3` with an impossible value.
    #[error("{path}, line {line}: `{key}` is `{found}`, expected {expected}; correct the line")]
    Statement { path: PathBuf, line: u64, key: &'static str, found: String, expected: &'static str },
    /// The file contradicts another file: the cell file or the plan.
    #[error("{path}: {key}: {found} in this file, but {expected} in the {by}; correct one of them")]
    Contradiction { path: PathBuf, key: &'static str, found: String, by: &'static str, expected: String },
    /// A target number that the plan does not have, or that occurred before.
    #[error(
        "{path}, line {line}: index `{found}` {reason}; export the result again, with the target numbers of the plan as the index"
    )]
    Index { path: PathBuf, line: u64, found: String, reason: &'static str },
    /// More than one probe in the same file.
    #[error(
        "{path}, line {line}: the probe is `{found}`, but `{first}` in the lines above; export one file for each probe"
    )]
    ProbeVaries { path: PathBuf, line: u64, found: String, first: String },
    /// A file of reference points that cannot be understood.
    #[error("{path}, line {line}: expected {expected}, found {found}; correct the file of reference points")]
    Reference { path: PathBuf, line: usize, expected: &'static str, found: String },
    /// A group of reference points that does not exist or is not unique.
    #[error(
        "{path}: there is not exactly one group `{wanted}` of reference points; there are {there}; name one of them \
         in the cell file"
    )]
    Group { path: PathBuf, wanted: String, there: String },
}

impl FormatError {
    /// Returns true if the only fault of the file is that it is empty or that its end is missing. The part of the file
    /// that exists is then valid.
    pub fn is_cut(&self) -> bool {
        matches!(self, Self::Cut { .. } | Self::CutLine { .. } | Self::Empty { .. })
    }
}

/// Returns `found`, a piece of a file, in backquotes, or the word `nothing` if it is empty.
fn quoted(found: &str) -> String {
    if found.is_empty() { "nothing".to_owned() } else { format!("`{found}`") }
}

/// Returns the first 40 characters of a piece of a file, for a message. Control characters are escaped. `...` marks a
/// longer piece.
pub(super) fn excerpt(bytes: &[u8]) -> String {
    const LONGEST: usize = 40;
    let text = String::from_utf8_lossy(&bytes[..bytes.len().min(4 * LONGEST)]);
    let mut short: String = text.trim_end().chars().take(LONGEST).flat_map(printable).collect();
    if text.chars().count() > LONGEST {
        short.push_str("...");
    }
    short
}

/// Returns `c` unchanged, or its escape sequence if it is a control character, which could disturb a terminal.
fn printable(c: char) -> impl Iterator<Item = char> {
    let escaped = if c.is_control() { Some(c.escape_default()) } else { None };
    let plain = if c.is_control() { None } else { Some(c) };
    escaped.into_iter().flatten().chain(plain)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn excerpt_escapes_control_characters() {
        assert_eq!(excerpt(b"abc \r\n"), "abc");
        assert_eq!(excerpt(b"\x1b[2J\xff"), "\\u{1b}[2J\u{fffd}");
        assert_eq!(excerpt(&[b'a'; 1000]).len(), 43);
        assert_eq!(quoted(""), "nothing");
    }
}
