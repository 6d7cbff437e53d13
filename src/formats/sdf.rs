//! Maps in the surface data file format (`.sdf`), as text and binary: ISO 25178-71 of version 1.0 and 2.0, and the older
//! BCR (EUNA 15178, 1993).
//!
//! A header of thirteen fields, the heights profile by profile, and a trailer that is not read. Scales are in metres.
//! Text: `key = value` lines between the version and a line `*`; `BAD` marks a sample that was not measured, and `;` begins
//! a comment. Binary: 81 bytes, in version 2.0 85, little-endian. In ISO, samples that were not measured are NaN, the
//! infinities, and the minimum of a type (the maximum of unsigned ones); in BCR they are the maximum. The first profile is
//! at y = 0 in ISO, and at the largest y in BCR.

use std::path::Path;

use super::error::{FormatError, excerpt};
use super::foreign::check_is_ours;
use super::height_map::{HeightMap, MapFormat, check_size, sample_spacing_mm};
use super::whole::{MAX_BYTES, open};
use regrind_core::geometry::Grid;

/// Length of the binary header, and in version 2.0.
const HEADER: usize = 81;
const HEADER_2: usize = 85;
/// Some instruments write two additional words before the heights.
const EXTRA: usize = 8;
/// Fields of the header that are read, with their names in the text form.
const FIELDS: [&str; 8] =
    ["NumPoints", "NumProfiles", "Xscale", "Yscale", "Zscale", "Compression", "DataType", "CheckType"];

/// SDF format, detected by its first bytes.
pub(super) const FORMAT: MapFormat = MapFormat {
    begins: is_sdf,
    parse: |path, bytes, given_mm| {
        let map = parse_sdf(path, bytes)?;
        sample_spacing_mm(path, map.heights.grid.spacing_mm, given_mm)?;
        Ok(map.into())
    },
};

/// Reads an SDF map of at most 1 GiB. Returns the heights on a grid, in millimetres.
///
/// # Errors
/// A file that is not readable, not SDF, malformed, compressed or cut; text in place of a number.
pub fn read_sdf(path: impl AsRef<Path>) -> Result<HeightMap, FormatError> {
    let path = path.as_ref();
    let opened = open(path)?;
    check_version(path, &opened.head)?;
    parse_sdf(path, &opened.read_all(path, MAX_BYTES)?)
}

/// Parses `bytes`, the content of an SDF file. Returns the heights on a grid, in millimetres. `path` only names the
/// file in messages.
///
/// # Errors
/// The same as for [`read_sdf`], except that the file is not readable.
pub fn parse_sdf(path: &Path, bytes: &[u8]) -> Result<HeightMap, FormatError> {
    check_version(path, bytes)?;
    let version = version(bytes);
    let version = version.ok_or_else(|| unexpected(path, "byte 0", "a version of SDF", ""))?;
    let parse = if bytes[0].eq_ignore_ascii_case(&b'a') { parse_text } else { parse_binary };
    let mut map = parse(path, bytes, version)?;
    if version == Version::Bcr {
        map.notes.push(
            "BCR does not define the direction of the profiles; the first is taken as that of the largest y".to_owned(),
        );
    }
    Ok(map)
}

/// Version of the format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Version {
    Iso1,
    Iso2,
    Bcr,
}

/// Returns the version that the first eight bytes of a file state.
fn version(head: &[u8]) -> Option<Version> {
    let words: [u8; 8] = *head.first_chunk()?;
    if !matches!(words[0].to_ascii_lowercase(), b'a' | b'b') {
        return None;
    }
    match words[1..].to_ascii_uppercase()[..] {
        [b'I', b'S', b'O', b'-', b'1', b'.', b'0'] => Some(Version::Iso1),
        [b'I', b'S', b'O', b'-', b'2', b'.', b'0'] => Some(Version::Iso2),
        [b'B', b'C', b'R', b'-', b'0' | b'1', b'.', b'0'] => Some(Version::Bcr),
        _ => None,
    }
}

fn check_version(path: &Path, head: &[u8]) -> Result<(), FormatError> {
    if is_sdf(head) {
        return Ok(());
    }
    check_is_ours(path, head)?;
    Err(unexpected(path, "byte 0", "aISO-1.0 or bISO-1.0", excerpt(&head[..head.len().min(8)])))
}

/// Returns true if `head`, the beginning of a file, is that of SDF, binary or text.
fn is_sdf(head: &[u8]) -> bool {
    version(head).is_some()
}

fn unexpected(path: &Path, place: &str, expected: &str, found: impl Into<String>) -> FormatError {
    let (place, expected, found) = (place.to_owned(), expected.to_owned(), found.into());
    FormatError::Unexpected { path: path.to_owned(), place, expected, found }
}

/// Header fields that are used.
struct Header {
    size: [usize; 2],
    /// Length in metres of one step of x, of y and of z.
    scale_m: [f64; 3],
    kind: u8,
}

impl Header {
    /// Creates the header of an SDF map from `fields`, the values of its eight fields. The order of the values is that
    /// of the names in [`FIELDS`]: from `NumPoints` (number of columns) to `CheckType`. Returns an error if a value is
    /// impossible: a size that is not a whole number above 0 or is too large, a scale that is not a finite number above
    /// 0, compressed heights, an unknown check type, or an unknown data type. `path` only names the file in messages.
    fn new(path: &Path, fields: [f64; 8]) -> Result<Self, FormatError> {
        let [columns, rows, x, y, z, compression, kind, check] = fields;
        let field = |k: usize, expected: &str| unexpected(path, FIELDS[k], expected, fields[k].to_string());
        for (k, count) in [columns, rows].into_iter().enumerate() {
            if !(count >= 0.0 && count.fract() == 0.0 && count <= f64::from(u32::MAX)) {
                return Err(field(k, "a whole number"));
            }
        }
        check_size(path, columns as u64, rows as u64)?;
        for (k, scale) in [(2, x), (3, y), (4, z)] {
            if !(scale > 0.0 && scale.is_finite()) {
                return Err(field(k, "metres per step, above 0"));
            }
        }
        if compression != 0.0 {
            return Err(field(5, "0, as compressed heights are not read"));
        }
        if check != 0.0 {
            return Err(field(7, "0, as no other check is defined"));
        }
        if !(0.0..=7.0).contains(&kind) || kind.fract() != 0.0 {
            return Err(field(6, "a data type from 0 to 7"));
        }
        Ok(Self { size: [columns as usize, rows as usize], scale_m: [x, y, z], kind: kind as u8 })
    }

    fn map(
        &self,
        path: &Path,
        version: Version,
        samples: impl Iterator<Item = Result<Option<f64>, FormatError>>,
    ) -> Result<HeightMap, FormatError> {
        let [x, y, z] = self.scale_m.map(|scale| 1e3 * scale);
        let mut first_bad = None;
        // An error ends the samples and is reported as the fault of the file.
        let heights = samples.map_while(|sample| sample.map_err(|error| first_bad = Some(error)).ok());
        let [columns, rows] = self.size;
        let grid = Grid { columns, rows, first_mm: [0.0; 2], spacing_mm: [x, y] };
        let heights = heights.map(|raw| raw.map(|v| v * z));
        let made = if version == Version::Bcr {
            let mut heights: Vec<Option<f64>> = heights.take(columns * rows + 1).collect();
            if heights.len() == columns * rows {
                heights = heights.chunks_exact(columns).rev().flatten().copied().collect();
            }
            HeightMap::new(path, grid, heights)
        } else {
            HeightMap::new(path, grid, heights)
        };
        match first_bad {
            Some(error) => Err(error),
            None => made,
        }
    }
}

fn parse_binary(path: &Path, bytes: &[u8], version: Version) -> Result<HeightMap, FormatError> {
    let cut =
        |expected: String| FormatError::Cut { path: path.to_owned(), place: format!("byte {}", bytes.len()), expected };
    let header_length = if version == Version::Iso2 { HEADER_2 } else { HEADER };
    let head = bytes.get(..header_length).ok_or_else(|| cut(format!("a header of {header_length} bytes")))?;
    let two = |at: usize| f64::from(u16::from_le_bytes([head[at], head[at + 1]]));
    let four = |at: usize| f64::from(u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]));
    // Version 2.0 counts in 32 bits; what follows is four bytes later.
    let (counts, later) = if version == Version::Iso2 { ([four(42), four(46)], 4) } else { ([two(42), two(44)], 0) };
    let real = |at: usize| head[at + later..].first_chunk().map_or(f64::NAN, |b| f64::from_le_bytes(*b));
    let byte = |at: usize| f64::from(head[at + later]);
    // Zresolution, at 70, changes no value.
    let fields = [counts[0], counts[1], real(46), real(54), real(62), byte(78), byte(79), byte(80)];
    let header = Header::new(path, fields)?;
    let size = [1, 2, 4, 4, 1, 2, 4, 8][usize::from(header.kind)];
    let length = header.size[0] * header.size[1] * size;
    let has_extra = version == Version::Iso1 && bytes.len() == HEADER + length + EXTRA;
    let begin = if has_extra { HEADER + EXTRA } else { header_length };
    let expected = || format!("{} times {} heights of {size} bytes", header.size[0], header.size[1]);
    let raw = bytes.get(begin..begin + length).ok_or_else(|| cut(expected()))?;
    let kind = header.kind;
    header.map(path, version, raw.chunks_exact(size).map(|at| Ok(binary_value(kind, version, at))))
}

/// Parses one height of a binary SDF file from `at`, the bytes that begin with this height. Returns the height as a
/// number of steps, because the header of the file gives the length of one step. `kind` is the data type of SDF, a
/// number from 0 to 7. Returns `None` if the sample was not measured: the number is the one that the data type reserves
/// for this, or it is not finite.
fn binary_value(kind: u8, version: Version, at: &[u8]) -> Option<f64> {
    let is_bcr = version == Version::Bcr;
    let two = || at.first_chunk().copied().unwrap_or_default();
    let four = || at.first_chunk().copied().unwrap_or_default();
    let value = match kind {
        0 => Some(at[0]).filter(|v| !is_bcr || *v != u8::MAX)?.into(),
        1 => Some(u16::from_le_bytes(two())).filter(|v| *v != u16::MAX)?.into(),
        2 => Some(u32::from_le_bytes(four())).filter(|v| *v != u32::MAX)?.into(),
        3 => f32::from_le_bytes(four()).into(),
        // Version 1.0 of ISO has no mark for eight bits.
        4 => Some(i8::from_le_bytes([at[0]]))
            .filter(|v| match version {
                Version::Iso1 => true,
                Version::Iso2 => *v != i8::MIN,
                Version::Bcr => *v != i8::MAX,
            })?
            .into(),
        5 => Some(i16::from_le_bytes(two())).filter(|v| *v != if is_bcr { i16::MAX } else { i16::MIN })?.into(),
        6 => Some(i32::from_le_bytes(four())).filter(|v| *v != if is_bcr { i32::MAX } else { i32::MIN })?.into(),
        _ => f64::from_le_bytes(at.first_chunk().copied().unwrap_or_default()),
    };
    is_height(value).then_some(value)
}

/// Returns false for numbers that mark samples that were not measured: the limits of both sizes of real numbers.
fn is_height(value: f64) -> bool {
    const MARK: f64 = 3.4e38;
    value.is_finite() && value.abs() < MARK
}

fn parse_text(path: &Path, bytes: &[u8], version: Version) -> Result<HeightMap, FormatError> {
    let mut fields = [f64::NAN; 8];
    let mut lines = bytes.split(|&b| b == b'\n').map(<[u8]>::trim_ascii).zip(1u64..).skip(1);
    let mut offset = bytes.iter().position(|&b| b == b'\n').map_or(bytes.len(), |at| at + 1);
    let first_line = loop {
        let Some((line, number)) = lines.next() else {
            let place = "the end of the header".to_owned();
            return Err(FormatError::Cut { path: path.to_owned(), place, expected: "a line `*`".to_owned() });
        };
        offset += bytes[offset..].iter().position(|&b| b == b'\n').map_or(bytes.len() - offset, |at| at + 1);
        if line.starts_with(b"*") {
            break number + 1;
        }
        read_field(path, line, number, &mut fields)?;
    };
    if let Some(k) = fields.iter().position(|field| field.is_nan()) {
        return Err(unexpected(path, "the header", &format!("a line `{} = ...`", FIELDS[k]), ""));
    }
    let header = Header::new(path, fields)?;
    let count = header.size[0] * header.size[1];
    let words = || {
        let lines = bytes[offset..].split(|&b| b == b'\n').zip(first_line..);
        let words = lines.flat_map(|(line, number)| {
            let words = without_comment(line).split(|b| b.is_ascii_whitespace()).filter(|word| !word.is_empty());
            words.map(move |word| (word, number))
        });
        // What follows the last height is the trailer.
        words.take_while(|(word, _)| !word.starts_with(b"*")).take(count + 1)
    };
    let found = words().count();
    if found < count {
        let (place, expected) = (format!("height {}", found + 1), format!("{count} heights"));
        return Err(FormatError::Cut { path: path.to_owned(), place, expected });
    }
    let mark = if version == Version::Bcr { largest(header.kind) } else { f64::INFINITY };
    let value = |(word, number)| text_value(path, word, number).map(|value| value.filter(|v| *v < mark));
    header.map(path, version, words().map(value))
}

fn read_field(path: &Path, line: &[u8], number: u64, fields: &mut [f64; 8]) -> Result<(), FormatError> {
    let before = *fields;
    read_value(path, line, number, fields)?;
    // A field can be repeated, but not with another value.
    match (0..fields.len()).find(|&k| !before[k].is_nan() && before[k] != fields[k]) {
        Some(k) => {
            Err(unexpected(path, &format!("line {number}"), &format!("{} {}", FIELDS[k], before[k]), excerpt(line)))
        }
        None => Ok(()),
    }
}

fn read_value(path: &Path, line: &[u8], number: u64, fields: &mut [f64; 8]) -> Result<(), FormatError> {
    let line = without_comment(line);
    let at = line.iter().position(|&b| b == b'=').unwrap_or(line.len());
    let key = line[..at].trim_ascii();
    let Some(k) = FIELDS.iter().position(|name| key.eq_ignore_ascii_case(name.as_bytes())) else { return Ok(()) };
    let value = line.get(at + 1..).unwrap_or_default().trim_ascii();
    // BCR has words for the data types, and for none.
    let word = TYPE_WORDS.iter().position(|word| value.eq_ignore_ascii_case(word));
    let none = [&b"NULL"[..], b"NONE"].iter().any(|word| value.eq_ignore_ascii_case(word));
    if let (6, Some(kind)) = (k, word) {
        fields[k] = kind as f64;
        return Ok(());
    }
    if matches!(k, 5 | 7) && none {
        fields[k] = 0.0;
        return Ok(());
    }
    match fast_float2::parse::<f64, _>(value) {
        Ok(value) if value.is_finite() => fields[k] = value,
        _ => return Err(unexpected(path, &format!("line {number}"), "a number", excerpt(value))),
    }
    Ok(())
}

/// Words of BCR for the data types 0 to 7.
const TYPE_WORDS: [&[u8]; 8] =
    [b"UCHAR", b"UINTEGER", b"ULONGINT", b"FLOAT", b"CHAR", b"INTEGER", b"LONGINT", b"DOUBLE"];

/// Returns the largest number of a data type, which marks samples that were not measured in BCR.
fn largest(kind: u8) -> f64 {
    match kind {
        0 => u8::MAX.into(),
        1 => u16::MAX.into(),
        2 => u32::MAX.into(),
        4 => i8::MAX.into(),
        5 => i16::MAX.into(),
        6 => i32::MAX.into(),
        _ => 3.4e38,
    }
}

fn without_comment(line: &[u8]) -> &[u8] {
    let end = line.iter().position(|&b| b == b';').unwrap_or(line.len());
    line[..end].trim_ascii()
}

fn text_value(path: &Path, word: &[u8], number: u64) -> Result<Option<f64>, FormatError> {
    if word.eq_ignore_ascii_case(b"bad") {
        return Ok(None);
    }
    match fast_float2::parse::<f64, _>(word) {
        Ok(value) => Ok(Some(value).filter(|v| is_height(*v))),
        Err(_) => Err(unexpected(path, &format!("line {number}"), "a height or `BAD`", excerpt(word))),
    }
}
