//! Point clouds as text: one point per line, with or without a header, with any separator that machines export.
//!
//! The file is streamed in batches that are parsed in parallel. Memory holds the points and a few megabytes, whatever
//! the size of the file. `quick_line` tries every line first: it knows only the plain case and reports no errors. Lines
//! that it declines go to `careful_line`, which alone decides what is an error.

use std::fs::File;
use std::io::{ErrorKind, Read};
use std::path::Path;

use rayon::prelude::*;

use super::columns::Table;
use super::error::{FormatError, excerpt};
use super::foreign::{check_is_ours, is_utf16};
use super::layout::{Fields, Layout, Preamble, Separator, are_empty_rows, is_comment};
use super::note::{NotedPoints, PointNote};
use super::number::{Decimal, NumberFault, coordinate, digits_after, has_both_marks, is_believable, looks_numeric};
use super::system;
use regrind_core::geometry::Point;

/// Largest text file that is read, in bytes.
const MAX_BYTES: u64 = 2 << 30;
/// Maximum number of points that are read: 2.4 GB of them.
const MAX_POINTS: u64 = 100_000_000;
/// Longest line that is read, in bytes.
const LONGEST_LINE: usize = 64 << 10;
/// Bytes that are checked before anything is parsed.
const HEAD: usize = 64 << 10;
/// Bytes read at a time, and the part of them that one thread parses.
const BATCH: usize = 4 << 20;
const SHARE: usize = 256 << 10;

/// Reads a point cloud from a text file, in millimetres and in the order of the file.
///
/// The file has one point per line:
///
/// - Columns are separated by comma, semicolon, tab or blanks. The line of the first point determines the separator,
///   and all lines must use it.
/// - Blank lines and comments (lines that begin with `#` or `//`) are skipped.
/// - A header names x, y and z once each. It can be a comment. Lines above the header are titles.
/// - A table with columns of both nominal and measured points is rejected. [`read_points_with_notes`] reads such a
///   table if its columns are given.
/// - A table without a header has three columns, or six if a unit normal follows the point.
/// - Decimal commas are accepted if the comma does not separate columns.
/// - Commas or points between thousands are accepted if the number also has its decimal mark.
/// - Blanks between thousands are accepted if a tab or a semicolon separates columns.
///
/// # Errors
/// A file that is not readable, not text, empty, too large or cut; a line with another number of columns; a coordinate
/// that is not a finite number of at most 1e7 mm; a header that states a unit other than mm, or whose columns x, y, z
/// are ambiguous.
pub fn read_points(path: impl AsRef<Path>) -> Result<Vec<Point>, FormatError> {
    read_points_with_notes(path, &Table::default()).map(|read| read.points)
}

/// Reads the points of a nominal surface from a text file, in millimetres and in the order of the file. The format is
/// that of [`read_points`], but the names of the columns can state that the points are nominal (such as `X_nom`).
/// `table` gives the columns and units that the file does not state.
///
/// # Errors
/// The same as for [`read_points`]; columns that do not exist.
pub fn read_nominal_points(path: impl AsRef<Path>, table: &Table) -> Result<Vec<Point>, FormatError> {
    let path = path.as_ref();
    let (file, length) = opened(path)?;
    let preamble = Preamble::new(path, true, table);
    Cloud { preamble, ..Cloud::new(path, length, table) }.read(file).map(|read| read.points)
}

fn opened(path: &Path) -> Result<(File, u64), FormatError> {
    let unreadable = |source| FormatError::Unreadable { path: path.to_owned(), source };
    let file = system::open_to_read(path).map_err(unreadable)?;
    let length = file.metadata().map_err(unreadable)?.len();
    Ok((file, length))
}

/// Reads a point cloud from a text file in the format of [`read_points`]. Returns the points in millimetres, with notes
/// on the content of the file that is ambiguous. `table` gives the columns and units that the file does not state.
///
/// # Errors
/// The same as for [`read_points`]; columns that do not exist.
pub fn read_points_with_notes(path: impl AsRef<Path>, table: &Table) -> Result<NotedPoints, FormatError> {
    let path = path.as_ref();
    let (file, length) = opened(path)?;
    Cloud::new(path, length, table).read(file)
}

/// Reads a point cloud from `reader`, a stream of text in the format of [`read_points`]. Returns the points in
/// millimetres, in the order of the stream. `path` only names the file in messages.
///
/// # Errors
/// The same as for [`read_points`].
pub fn parse_points(path: impl AsRef<Path>, reader: impl Read + Send) -> Result<Vec<Point>, FormatError> {
    Cloud::new(path.as_ref(), 0, &Table::default()).read(reader).map(|read| read.points)
}

/// Parses a point cloud from `text`, the content of a file in the format of [`read_points`]. Returns the points in
/// millimetres, in the order of the file. `table` gives the columns and units that the file does not state. `decimal`
/// is the decimal mark; if `decimal` is `None`, the mark is detected. `path` only names the file in messages.
///
/// # Errors
/// The same as for [`read_points`]; columns that do not exist.
pub(super) fn parse_points_with(
    path: &Path,
    text: &[u8],
    decimal: Option<Decimal>,
    table: &Table,
) -> Result<Vec<Point>, FormatError> {
    Cloud { decimal, ..Cloud::new(path, 0, table) }.read(text).map(|read| read.points)
}

/// Point cloud while it is read.
struct Cloud<'p> {
    path: &'p Path,
    /// Decimal mark, if it is known and need not be detected in the file.
    decimal: Option<Decimal>,
    table: &'p Table,
    /// Expected length of the file, only used to reserve memory.
    length: u64,
    preamble: Preamble<'p>,
    layout: Option<Layout>,
    /// Number of lines read.
    lines: u64,
    /// The first of the rows of empty cells after the last point.
    empty_from: Option<u64>,
    points: Vec<Point>,
    grouped: Grouped,
}

/// Numbers with a separator between thousands: how many lines have one (counted up to two), and the first of them.
#[derive(Default)]
struct Grouped {
    lines: usize,
    /// Number of lines before it in the text read, the number as written, and its value.
    first: Option<(u64, String, f64)>,
}

impl Grouped {
    /// Checks `line` for numbers with thousands separators (points or commas between thousands). If a coordinate in
    /// `line` has such separators, the counter of such lines increases by 1. The first such number in the text is
    /// stored, with its value and with `lines_before`, the number of lines before `line`. `layout` gives the columns
    /// and the decimal mark.
    ///
    /// Does nothing if two lines are already counted, because only the cases none, one and several lines matter.
    fn see(&mut self, line: &[u8], layout: &Layout, lines_before: u64) {
        if self.lines > 1 || !has_both_marks(line) {
            return;
        }
        let (fields, _) = layout.pick(line);
        let Some(field) = fields.into_iter().find(|field| has_both_marks(field)) else { return };
        self.lines += 1;
        if let (None, Ok(value)) = (&self.first, coordinate(field, layout.decimal)) {
            self.first = Some((lines_before, excerpt(field), value));
        }
    }

    /// Adds `share`, the result for one part of the file, to this result for the whole file. Each result has two
    /// values: the number of lines that contain numbers with thousands separators, and the first number with such
    /// separators. The two numbers of lines are added. The first number of `share` is stored only if no number is
    /// stored yet. `lines_before` is the number of lines of the file before this part.
    fn add(&mut self, share: Self, lines_before: u64) {
        self.lines += share.lines;
        let first = share.first.map(|(line, found, value)| (line + lines_before, found, value));
        self.first = self.first.take().or(first);
    }
}

/// Part of the file in memory.
struct Batch {
    bytes: Vec<u8>,
    /// Range of the bytes that is in use.
    begin: usize,
    end: usize,
}

impl Batch {
    /// Fills this batch with `left_over`, the unparsed end of the previous batch, and then with bytes from `reader`.
    /// Returns the number of bytes that were read from `reader`.
    fn read(&mut self, left_over: &[u8], reader: &mut impl Read) -> std::io::Result<usize> {
        self.bytes.resize(BATCH, 0);
        self.bytes[..left_over.len()].copy_from_slice(left_over);
        let read = fill(reader, &mut self.bytes[left_over.len()..])?;
        (self.begin, self.end) = (0, left_over.len() + read);
        Ok(read)
    }
}

/// Result of one thread for its share of a batch.
struct Share {
    points: Vec<Point>,
    /// Number of lines read without error.
    lines: u64,
    /// Start of the first bad line, if there is one.
    bad: Option<usize>,
    grouped: Grouped,
}

impl<'p> Cloud<'p> {
    fn new(path: &'p Path, length: u64, table: &'p Table) -> Self {
        let (preamble, points, grouped) = (Preamble::new(path, false, table), Vec::new(), Grouped::default());
        Self { path, table, decimal: None, length, preamble, layout: None, lines: 0, empty_from: None, points, grouped }
    }

    fn read(mut self, mut reader: impl Read + Send) -> Result<NotedPoints, FormatError> {
        let path = self.path;
        let unreadable = |source| FormatError::Unreadable { path: path.to_owned(), source };
        self.check_size(self.length)?;
        let mut batch = Batch { bytes: vec![0; BATCH], begin: 0, end: 0 };
        batch.end = fill(&mut reader, &mut batch.bytes[..HEAD]).map_err(unreadable)?;
        self.check_head(&batch.bytes[..batch.end])?;
        batch.end += fill(&mut reader, &mut batch.bytes[batch.end..]).map_err(unreadable)?;
        batch.begin = if batch.bytes.starts_with(b"\xef\xbb\xbf") { 3 } else { 0 };
        let mut next = Batch { bytes: Vec::new(), begin: 0, end: 0 };
        let mut total = batch.end as u64;
        while batch.end == BATCH {
            // One thread reads ahead while the others parse.
            let lines = self.whole_lines(&batch)?;
            let (text, tail) = batch.bytes[batch.begin..].split_at(lines);
            let (taken, read) = rayon::join(|| self.parse_lines(text, total), || next.read(tail, &mut reader));
            taken?;
            total += read.map_err(unreadable)? as u64;
            self.check_size(total)?;
            std::mem::swap(&mut batch, &mut next);
        }
        let text = &batch.bytes[batch.begin..batch.end];
        self.parse_lines(text, total)?;
        let notes = self.notes(text);
        Ok(NotedPoints { notes, points: self.finish()? })
    }

    /// Returns notes on ambiguous content of the file: thousands separators in only one line of the file, and a last
    /// line without a line end. `text` is the last part of the file.
    fn notes(&mut self, text: &[u8]) -> Vec<PointNote> {
        let mut notes = Vec::new();
        if let (1, Some((before, found, value_mm))) = (self.grouped.lines, self.grouped.first.take()) {
            notes.push(PointNote::OneThousandsMark { path: self.path.to_owned(), line: before + 1, found, value_mm });
        }
        notes.extend(self.note_of_end(text));
        notes
    }

    /// Returns a note if the last line of `text` contains a point but has no line end, because the file may be cut. The
    /// note states whether the last number of this line has fewer digits than the last number of every line above.
    /// Returns `None` if the last line has a line end, contains no point or is a comment. `text` is the last part of
    /// the file.
    fn note_of_end(&self, text: &[u8]) -> Option<PointNote> {
        /// Number of lines above whose digits are compared with the last line, and the minimum number required.
        const ABOVE: usize = 1000;
        const MIN: usize = 3;
        let (layout, point) = (self.layout.as_ref()?, *self.points.last().filter(|_| self.empty_from.is_none())?);
        let mut lines = text.rsplit(|&b| b == b'\n');
        let last =
            lines.next().filter(|line| line.last().is_some_and(|b| !b.is_ascii_whitespace()) && !is_comment(line))?;
        let number = |line| Fields::new(line, layout.separator).last().unwrap_or_default();
        let data = lines.filter(|line| !line.trim_ascii().is_empty() && !is_comment(line)).take(ABOVE);
        let above: Vec<[usize; 2]> =
            data.filter(|line| looks_numeric(number(line))).map(|line| digits_after(number(line))).collect();
        let found = number(last);
        let here = digits_after(found);
        let fewer = |k: usize| above.iter().map(|digits| digits[k]).min().filter(|least| here[k] < *least);
        let fewer_digits = (0..2).filter(|_| above.len() >= MIN).find_map(|k| fewer(k).map(|least| [here[k], least]));
        let (path, line, found) = (self.path.to_owned(), self.lines, excerpt(found));
        Some(PointNote::NoLineEnd { path, line, found, point, fewer_digits })
    }

    /// Returns the number of bytes in `batch` from the beginning of its text to the end of the last complete line.
    /// `batch` must be full.
    ///
    /// # Errors
    /// An incomplete last line that is longer than the limit for a line. Before this error is returned, the complete
    /// lines are parsed, and an error in one of them is returned instead.
    fn whole_lines(&mut self, batch: &Batch) -> Result<usize, FormatError> {
        let text = &batch.bytes[batch.begin..];
        let lines = text.iter().rposition(|&b| b == b'\n').map_or(0, |at| at + 1);
        if text.len() - lines <= LONGEST_LINE {
            return Ok(lines);
        }
        // The lines before it can contain an earlier error, and are needed to count its line number.
        self.parse_lines(&text[..lines], BATCH as u64)?;
        let line = self.lines + 1;
        Err(FormatError::LineTooLong { path: self.path.to_owned(), line, limit_bytes: LONGEST_LINE })
    }

    /// Parses `text`, a part of the file that consists of complete lines, and stores its points. Only the last line of
    /// the file can be incomplete. `bytes_so_far` is the number of bytes of the file up to the end of the batch that
    /// contains `text`.
    ///
    /// # Errors
    /// The first line that is not valid; too many points; too much text before the first point.
    fn parse_lines(&mut self, text: &[u8], bytes_so_far: u64) -> Result<(), FormatError> {
        let rest = self.take_preamble(text)?;
        let Some(layout) = &self.layout else { return self.check_preamble(bytes_so_far) };
        if let Some(line) = self.empty_from {
            let (path, column, found) = (self.path.to_owned(), layout.columns[0] + 1, String::new());
            let not_the_end = FormatError::NotANumber { path, line, column, found };
            return if are_empty_rows(rest, layout.separator) { Ok(()) } else { Err(not_the_end) };
        }
        let mut shares: Vec<Share> = if rest.len() <= SHARE {
            vec![read_share(rest, layout)]
        } else {
            split_at_lines(rest).into_par_iter().map(|share| read_share(share, layout)).collect()
        };
        let mut offset = 0;
        for (share, text) in shares.iter_mut().zip(split_at_lines(rest)) {
            self.grouped.add(std::mem::take(&mut share.grouped), self.lines);
            self.lines += share.lines;
            if let Some(bad) = share.bad {
                let rest = &rest[offset + bad..];
                let (line, _, ended) = first_line(rest);
                // Rows of empty cells end a sheet.
                if !are_empty_rows(rest, layout.separator) {
                    return careful_line(self.path, self.lines + 1, line, layout, ended).map(|_| ());
                }
                self.empty_from = Some(self.lines + 1);
                break;
            }
            offset += text.len();
        }
        if self.points.is_empty() {
            let found: usize = shares.iter().map(|share| share.points.len()).sum();
            self.points.reserve(expected_points(found, bytes_so_far, self.length));
        }
        shares.iter().for_each(|share| self.points.extend_from_slice(&share.points));
        let (found, limit) = (self.points.len() as u64, MAX_POINTS);
        let too_many = || FormatError::TooLarge { path: self.path.to_owned(), found, limit, unit: "points" };
        if found > limit { Err(too_many()) } else { Ok(()) }
    }

    /// Reads the lines of `text` above the first point, until the layout of the table is known. Returns the rest of
    /// `text`, which begins with the line of the first point. Returns all of `text` if the layout is already known, and
    /// an empty rest if `text` contains no point.
    fn take_preamble<'t>(&mut self, text: &'t [u8]) -> Result<&'t [u8], FormatError> {
        let mut rest = text;
        while self.layout.is_none() && !rest.is_empty() {
            let (line, used, _) = first_line(rest);
            let number = self.lines + 1;
            check_line(self.path, number, line)?;
            if let Some(mut layout) = self.preamble.read_line(line, number)? {
                match self.decimal {
                    Some(decimal) => layout.decimal = decimal,
                    None => layout.settle_decimal(self.path, rest)?,
                }
                self.layout = Some(layout);
                break;
            }
            self.lines = number;
            rest = &rest[used..];
        }
        Ok(rest)
    }

    fn finish(mut self) -> Result<Vec<Point>, FormatError> {
        if !self.points.is_empty() {
            self.table.to_mm(&mut self.points);
            return Ok(self.points);
        }
        Err(self.preamble.without_points())
    }

    /// Returns an error if `bytes`, the number of bytes read without finding a point, is at least the size of one batch
    /// (4 MiB).
    fn check_preamble(&self, bytes: u64) -> Result<(), FormatError> {
        let (path, limit, unit) = (self.path, BATCH as u64 - 1, "bytes before the first point");
        let too_large = || FormatError::TooLarge { path: path.to_owned(), found: bytes, limit, unit };
        if bytes > limit { Err(too_large()) } else { Ok(()) }
    }

    fn check_size(&self, bytes: u64) -> Result<(), FormatError> {
        let (path, limit) = (self.path, MAX_BYTES);
        let too_large = || FormatError::TooLarge { path: path.to_owned(), found: bytes, limit, unit: "bytes" };
        if bytes > limit { Err(too_large()) } else { Ok(()) }
    }

    /// Returns an error if `head`, the beginning of a file, is not text that can be parsed: a known format that this
    /// program does not read, UTF-16, lines that end with CR only, or control characters.
    fn check_head(&self, head: &[u8]) -> Result<(), FormatError> {
        check_is_ours(self.path, head)?;
        if is_utf16(head) {
            return Err(FormatError::Utf16 { path: self.path.to_owned() });
        }
        let text = without_end_of_file(head);
        if text.contains(&b'\r') && !text.contains(&b'\n') {
            let (expected, found) = ("lines that end with LF or CR LF", "lines that end with CR only");
            let remedy = "save the file with one of those line ends";
            return Err(FormatError::WrongKind { path: self.path.to_owned(), expected, found, remedy });
        }
        let Some(at) = text.iter().position(|&b| b < b' ' && !b.is_ascii_whitespace()) else { return Ok(()) };
        let line = 1 + head[..at].iter().filter(|&&b| b == b'\n').count() as u64;
        Err(FormatError::NotText { path: self.path.to_owned(), line, value: head[at] })
    }
}

/// Returns `text` without the end-of-file marks (0x1A) of old systems at its end.
fn without_end_of_file(text: &[u8]) -> &[u8] {
    let end = text.iter().rposition(|b| *b != 0x1a && !b.is_ascii_whitespace()).map_or(0, |at| at + 1);
    if text[end..].contains(&0x1a) { &text[..end] } else { text }
}

/// Reads from `reader` until `buffer` is full or the stream ends. Returns the number of bytes read.
pub(super) fn fill(reader: &mut impl Read, buffer: &mut [u8]) -> std::io::Result<usize> {
    let mut filled = 0;
    while filled < buffer.len() {
        match reader.read(&mut buffer[filled..]) {
            Ok(0) => break,
            Ok(read) => filled += read,
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(filled)
}

/// Returns the number of points for which memory is reserved, at most a quarter of [`MAX_POINTS`]. It is extrapolated
/// from `found`, the number of points in the first `bytes_so_far` bytes, to a file of `length` bytes.
fn expected_points(found: usize, bytes_so_far: u64, length: u64) -> usize {
    let ratio = length.max(bytes_so_far) as f64 / bytes_so_far.max(1) as f64;
    // Without this bound, a batch of very short points would reserve many times the memory that a file with a long tail
    // of comments needs.
    ((found as f64 * ratio * 1.02) as usize).min(MAX_POINTS as usize / 4)
}

/// Splits `text` at line ends into parts of about 256 KiB, so that threads can parse them in parallel. Only the last
/// part can end with an incomplete line.
fn split_at_lines(text: &[u8]) -> Vec<&[u8]> {
    let mut shares = Vec::with_capacity(text.len() / SHARE + 1);
    let mut rest = text;
    while rest.len() > SHARE {
        let Some(end) = rest[SHARE..].iter().position(|&b| b == b'\n') else { break };
        let (share, after) = rest.split_at(SHARE + end + 1);
        shares.push(share);
        rest = after;
    }
    shares.push(rest);
    shares
}

/// Returns the first line of `text` without its line end, its length with the line end, and true if it has a line end.
fn first_line(text: &[u8]) -> (&[u8], usize, bool) {
    match text.iter().position(|&b| b == b'\n') {
        Some(end) => (text[..end].strip_suffix(b"\r").unwrap_or(&text[..end]), end + 1, true),
        None => (text, text.len(), false),
    }
}

fn read_share(text: &[u8], layout: &Layout) -> Share {
    let mut share =
        Share { points: Vec::with_capacity(text.len() / 40), lines: 0, bad: None, grouped: Grouped::default() };
    let quick = layout.decimal == Decimal::Point && layout.columns == [0, 1, 2];
    let mut at = 0;
    while at < text.len() {
        let rest = &text[at..];
        if rest[0] == b'\n' {
            at += 1;
        } else if let Some((point, used)) = if quick { quick_line(rest, layout) } else { None } {
            share.points.push(point);
            at += used;
        } else {
            let (line, used, ended) = first_line(rest);
            match careful_line(Path::new(""), 0, line, layout, ended) {
                Ok(Some(point)) => {
                    share.grouped.see(line, layout, share.lines);
                    share.points.push(point);
                }
                Ok(None) => {}
                Err(_) => {
                    share.bad = Some(at);
                    break;
                }
            }
            at += used;
        }
        share.lines += 1;
    }
    share
}

/// Parses the first line of `text` if its first three columns are x, y and z as numbers with a decimal point. Returns
/// the point, in the unit of the file, and the length of the line with its line end, in bytes. Returns `None` for any
/// other line and for a line without a line end. [`careful_line`] then parses this line.
#[inline]
fn quick_line(text: &[u8], layout: &Layout) -> Option<(Point, usize)> {
    let separator = layout.separator;
    let mut at = skip_padding(text, 0, separator);
    let mut values = [0.0; 3];
    for (axis, value) in values.iter_mut().enumerate() {
        if axis > 0 {
            at = skip_separator(text, at, separator)?;
        }
        let (number, used) = fast_float2::parse_partial::<f64, _>(text.get(at..)?).ok()?;
        if !is_believable(number) {
            return None;
        }
        *value = number;
        at += used;
    }
    at = if layout.count == 3 { skip_padding(text, at, separator) } else { skip_columns(text, at, layout)? };
    at += usize::from(text.get(at) == Some(&b'\r'));
    let ended = text.get(at) == Some(&b'\n') && at <= LONGEST_LINE;
    ended.then_some((Point::new(values[0], values[1], values[2]), at + 1))
}

#[inline]
fn skip_padding(text: &[u8], mut at: usize, separator: Separator) -> usize {
    while text.get(at).is_some_and(|&b| separator.pads(b)) {
        at += 1;
    }
    at
}

#[inline]
fn skip_separator(text: &[u8], at: usize, separator: Separator) -> Option<usize> {
    let end = skip_padding(text, at, separator);
    if separator == Separator::Blank {
        return (end > at).then_some(end);
    }
    (text.get(end) == Some(&separator.byte())).then(|| skip_padding(text, end + 1, separator))
}

/// Skips the columns after the third column of a line. `text` begins with the line, and `at` is the byte index after
/// its third column. Returns the byte index after the last column and the blanks that follow. Returns `None` if the
/// line has fewer columns than `layout`, or has a column with quotes or control characters.
fn skip_columns(text: &[u8], mut at: usize, layout: &Layout) -> Option<usize> {
    for _ in 3..layout.count {
        at = skip_separator(text, at, layout.separator)?;
        let stop = |&b: &u8| b == layout.separator.byte() || b < b' ' || b == b'"';
        let width = text[at..].iter().position(stop)?;
        // With blanks as separator there is no empty column, only blanks at the end of the line.
        if width == 0 && layout.separator == Separator::Blank {
            return None;
        }
        at += width;
    }
    Some(skip_padding(text, at, layout.separator))
}

/// Rejects a line that is longer than [`LONGEST_LINE`] or has a zero byte. `number` is its line number.
fn check_line(path: &Path, number: u64, line: &[u8]) -> Result<(), FormatError> {
    if line.len() > LONGEST_LINE {
        return Err(FormatError::LineTooLong { path: path.to_owned(), line: number, limit_bytes: LONGEST_LINE });
    }
    if line.contains(&0) {
        return Err(FormatError::NotText { path: path.to_owned(), line: number, value: 0 });
    }
    Ok(())
}

/// Parses `line`, any line of data. Returns its point in the unit of the file, or `None` if `line` is blank or a
/// comment. `number` is the line number. `ended` is true if the line has a line end in the file.
///
/// # Errors
/// A number of columns other than in `layout`; a coordinate that is not a number; a line that is cut at the end of the
/// file; a line that is too long or has a zero byte.
fn careful_line(
    path: &Path,
    number: u64,
    line: &[u8],
    layout: &Layout,
    ended: bool,
) -> Result<Option<Point>, FormatError> {
    check_line(path, number, line)?;
    if line.trim_ascii().is_empty() || is_comment(line) {
        return Ok(None);
    }
    let (fields, count) = layout.pick(line);
    if count != layout.count {
        return Err(wrong_count(path, number, line, layout, count, ended));
    }
    let mut values = [0.0; 3];
    for ((value, field), column) in values.iter_mut().zip(fields).zip(layout.columns) {
        *value = coordinate(&layout.separator.ungrouped(field), layout.decimal).map_err(|fault| {
            // An incomplete number at the very end of a file means that the file is cut, not that it contains foreign
            // text.
            let begun = field.iter().all(|b| matches!(b, b'0'..=b'9' | b'+' | b'-' | b'.' | b',' | b'e' | b'E'));
            if !ended && fault == NumberFault::Text && begun {
                return FormatError::CutLine { path: path.to_owned(), line: number, found: excerpt(line) };
            }
            number_error(path, number, column + 1, field, layout.decimal, fault)
        })?;
    }
    Ok(Some(Point::from(values)))
}

fn wrong_count(path: &Path, line: u64, text: &[u8], layout: &Layout, found: usize, ended: bool) -> FormatError {
    let path = path.to_owned();
    if !ended && found < layout.count {
        return FormatError::CutLine { path, line, found: excerpt(text) };
    }
    let (expected, separator, first_line) = (layout.count, layout.separator.name(), layout.first_line);
    FormatError::ColumnCount { path, line, found, expected, separator, first_line }
}

fn number_error(
    path: &Path,
    line: u64,
    column: usize,
    field: &[u8],
    decimal: Decimal,
    fault: NumberFault,
) -> FormatError {
    let (path, found) = (path.to_owned(), excerpt(field));
    match fault {
        NumberFault::Text => FormatError::NotANumber { path, line, column, found },
        NumberFault::NotFinite => FormatError::NotFinite { path, line, column, found },
        NumberFault::OutOfRange => FormatError::OutOfRange { path, line, column, found },
        NumberFault::AmbiguousComma => FormatError::AmbiguousComma { path, line, column, found },
        NumberFault::OtherMark => {
            let expected = if decimal == Decimal::Point { "point" } else { "comma" };
            FormatError::DecimalMark { path, line, column, found, expected }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const COMMAS: Layout =
        Layout { separator: Separator::Comma, columns: [0, 1, 2], count: 3, decimal: Decimal::Point, first_line: 1 };

    #[test]
    fn split_at_lines_loses_nothing() {
        for (line, count) in [("1,2,3\n", 200_000), ("\n", 600_000), ("no end", 90_000)] {
            let text = line.repeat(count).into_bytes();
            let shares = split_at_lines(&text);
            assert_eq!(shares.concat(), text);
            assert!(shares[..shares.len() - 1].iter().all(|share| share.ends_with(b"\n")));
        }
    }

    #[test]
    fn quick_line_declines_odd_lines() {
        let quick = |line: &str| quick_line(line.as_bytes(), &COMMAS);
        assert_eq!(quick(" 1,2 , 3\r\nrest"), Some((Point::new(1.0, 2.0, 3.0), 10)));
        let others = [
            "1,2,3",
            "1,2\n",
            "1,2,3,4\n",
            "1,2,nan\n",
            "1,2,1e8\n",
            "#1,2,3\n",
            "1,2,3x\n",
            "\"1\",2,3\n",
            "",
            "1,2,\n",
        ];
        for line in others {
            assert_eq!(quick(line), None, "{line:?}");
        }
        let five = Layout { separator: Separator::Blank, count: 5, ..COMMAS };
        let quick = |line: &str| quick_line(line.as_bytes(), &five);
        assert_eq!(quick("1 2 3 a  b \n").map(|(_, used)| used), Some(12));
        for line in ["1 2 3 a \n", "1 2 3 a b c\n", "1 2 3\n", "1 2 3 \"a b\" c\n"] {
            assert_eq!(quick(line), None, "{line:?}");
        }
    }

    #[test]
    fn parse_points_refuses_only_comments() {
        let comments = "# nothing but comments\n".repeat(200_000);
        assert!(matches!(parse_points("c", comments.as_bytes()), Err(FormatError::TooLarge { .. })));
        let mut blank = vec![b'\n'; 5 << 20];
        blank[..6].copy_from_slice(b"1,2,3\n");
        assert_eq!(parse_points("b", &blank[..]).unwrap().len(), 1);
    }
}
