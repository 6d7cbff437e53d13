//! Triangle meshes in STL, ascii and binary.
//!
//! STL repeats every vertex in every facet; vertices with bitwise equal coordinates are merged. The facet normals of
//! the file are ignored: they follow from the corners, and many programs write zeros. STL states no unit; millimetres
//! are assumed.

use std::collections::HashMap;
use std::path::Path;

use regrind_core::geometry::Point;

use super::columns::check_stated_unit;
use super::error::{FormatError, excerpt};
use super::number::{any_number, is_believable};
use super::unit::Unit;
use super::whole::{MAX_BYTES, is_degenerate, open};

/// Number of bytes before the first facet, and of one facet, in binary.
const BINARY_HEADER: usize = 84;
const BINARY_FACET: usize = 50;

/// Content of an STL file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StlFile {
    /// The merged vertices in the order of their first occurrence, in millimetres.
    pub points: Vec<Point>,
    /// Corner indices of the triangles.
    pub triangles: Vec<[u32; 3]>,
    /// Number of facets that were skipped because their area is 0.
    pub degenerate: usize,
}

/// Reads an STL file of at most 1 GiB. Returns its triangles with merged vertices, in millimetres.
///
/// A file is binary if its length matches its facet count, even if it begins with `solid`. Otherwise it is ascii if it
/// begins with `solid` and its first bytes are text.
///
/// # Errors
/// A file that is not readable, not STL, malformed or cut; no facet with an area; a vertex that is not finite or beyond
/// 1e7 mm.
pub fn read_stl(path: impl AsRef<Path>) -> Result<StlFile, FormatError> {
    let path = path.as_ref();
    let opened = open(path)?;
    if opened.length > opened.head.len() as u64 {
        // The beginning and the length decide, so that a large file of other content is not read.
        return match kind(path, &opened.head, opened.length)? {
            Kind::Binary => parse_stl(path, &opened.read_all(path, MAX_BYTES)?),
            Kind::Ascii => opened.parse(path, parse_ascii),
        };
    }
    parse_stl(path, &opened.read_all(path, MAX_BYTES)?)
}

/// Parses `bytes`, the content of an STL file. Returns the triangles with merged vertices, in millimetres. `path` only
/// names the file in messages.
///
/// # Errors
/// The same as for [`read_stl`], except that the file is not readable.
pub fn parse_stl(path: &Path, bytes: &[u8]) -> Result<StlFile, FormatError> {
    let kind = kind(path, bytes, bytes.len() as u64)?;
    let first_line = bytes[..bytes.len().min(80)].split(|&b| b == b'\n').next().unwrap_or_default();
    check_stated_unit(path, 1, first_line, [Unit::Millimetre; 2])?;
    match kind {
        Kind::Binary => parse_binary(path, bytes),
        Kind::Ascii => parse_ascii(path, bytes),
    }
}

/// Returns true if a file is STL. `head` is the beginning of the file, and `length` is the length of the whole file in
/// bytes. The file is STL if one of two conditions is true: `head` begins like ascii STL, or `head` is a binary header
/// whose number of facets is above 0 and matches `length`.
pub(super) fn is_stl(head: &[u8], length: u64) -> bool {
    looks_ascii(head) || (facets(head).is_some_and(|n| n > 0) && binary_length(head) == Some(length))
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Binary,
    Ascii,
}

fn kind(path: &Path, head: &[u8], length: u64) -> Result<Kind, FormatError> {
    if binary_length(head) == Some(length) {
        return Ok(Kind::Binary);
    }
    if looks_ascii(head) {
        return Ok(Kind::Ascii);
    }
    let path = path.to_owned();
    let Some(facets) = facets(head) else {
        return Err(if head.is_empty() {
            FormatError::Empty { path, expected: "an STL mesh" }
        } else {
            let expected = format!("`solid`, or a binary header of {BINARY_HEADER} bytes");
            FormatError::Cut { path, place: format!("byte {length}"), expected }
        });
    };
    let wanted = binary_length(head).unwrap_or(u64::MAX);
    let expected = format!("{wanted} bytes for the {facets} facets announced at byte 80");
    Err(if wanted > length {
        FormatError::Cut { path, place: format!("byte {length}"), expected }
    } else {
        FormatError::Unexpected { path, place: "byte 80".to_owned(), expected, found: format!("{length} bytes") }
    })
}

/// Returns the number of facets that a binary header states; `None` if `head` is shorter than a binary header.
fn facets(head: &[u8]) -> Option<u32> {
    head.get(80..BINARY_HEADER).and_then(|bytes| bytes.try_into().ok()).map(u32::from_le_bytes)
}

fn binary_length(head: &[u8]) -> Option<u64> {
    facets(head).map(|n| BINARY_HEADER as u64 + u64::from(n) * BINARY_FACET as u64)
}

/// Returns true if `head`, the beginning of a file, is the word `solid` followed by text without control characters.
fn looks_ascii(head: &[u8]) -> bool {
    let text = head.trim_ascii_start();
    let solid = text.get(..5).is_some_and(|word| word.eq_ignore_ascii_case(b"solid"));
    let set_off = text.get(5).is_none_or(u8::is_ascii_whitespace);
    let control = |b: &u8| *b < b' ' && !b.is_ascii_whitespace();
    solid && set_off && !text.iter().take(512).any(control)
}

fn parse_binary(path: &Path, bytes: &[u8]) -> Result<StlFile, FormatError> {
    let facets = bytes[BINARY_HEADER..].chunks_exact(BINARY_FACET);
    let mut mesh = Welder::with_capacity(facets.len());
    for (facet, record) in facets.enumerate() {
        let mut corners = [Point::origin(); 3];
        // The first twelve bytes are the normal, the last two are attributes.
        for (k, four) in record[12..48].chunks_exact(4).enumerate() {
            let value = f64::from(f32::from_le_bytes([four[0], four[1], four[2], four[3]]));
            if !is_believable(value) {
                let place = format!("byte {}", BINARY_HEADER + facet * BINARY_FACET + 12 + 4 * k);
                let what = ["x", "y", "z"][k % 3];
                return Err(FormatError::BadCoordinate { path: path.to_owned(), place, what, value });
            }
            corners[k / 3][k % 3] = value;
        }
        mesh.facet(corners);
    }
    mesh.finish(path)
}

fn parse_ascii(path: &Path, bytes: &[u8]) -> Result<StlFile, FormatError> {
    let mut words = Words { path, rest: bytes, line: 1 };
    let mut mesh = Welder::with_capacity(bytes.len() / 250);
    words.expect("solid")?;
    words.skip_line();
    loop {
        match words.one_of(["facet", "endsolid", "solid"])? {
            0 => mesh.facet(words.facet()?),
            1 => {
                words.skip_line();
                if words.rest.trim_ascii().is_empty() {
                    return mesh.finish(path);
                }
            }
            _ => words.skip_line(),
        }
    }
}

/// Words of an ascii file.
struct Words<'a> {
    path: &'a Path,
    rest: &'a [u8],
    line: u64,
}

impl<'a> Words<'a> {
    /// Reads and returns the next word of the file. `expected` is the expected content, for the error message.
    ///
    /// # Errors
    /// The end of the file.
    fn next(&mut self, expected: &str) -> Result<&'a [u8], FormatError> {
        let blanks = self.rest.iter().take_while(|b| b.is_ascii_whitespace()).count();
        self.line += self.rest[..blanks].iter().filter(|&&b| b == b'\n').count() as u64;
        let word = &self.rest[blanks..];
        let end = word.iter().position(u8::is_ascii_whitespace).unwrap_or(word.len());
        self.rest = &word[end..];
        if end == 0 {
            let (path, place) = (self.path.to_owned(), format!("line {}", self.line));
            return Err(FormatError::Cut { path, place, expected: expected.to_owned() });
        }
        Ok(&word[..end])
    }

    /// Reads the next word of the file, and returns its index in `wanted`. Upper and lower case are not distinguished.
    ///
    /// # Errors
    /// A word that is not in `wanted`; the end of the file.
    fn one_of(&mut self, wanted: [&str; 3]) -> Result<usize, FormatError> {
        let word = self.next(wanted[0])?;
        let found = wanted.iter().position(|w| word.eq_ignore_ascii_case(w.as_bytes()));
        found.ok_or_else(|| self.unexpected(&format!("`{}` or `{}`", wanted[0], wanted[1]), word, wanted))
    }

    fn expect(&mut self, wanted: &str) -> Result<(), FormatError> {
        let word = self.next(wanted)?;
        let right = word.eq_ignore_ascii_case(wanted.as_bytes());
        if right { Ok(()) } else { Err(self.unexpected(&format!("`{wanted}`"), word, [wanted; 3])) }
    }

    /// Returns an error that reports `word`, a word of the file that is not in `wanted`, the permitted words.
    /// `expected` describes the expected content in the message. If the file ends after `word`, and `word` is the
    /// beginning of a permitted word, the error reports a cut file.
    fn unexpected(&self, expected: &str, word: &[u8], wanted: [&str; 3]) -> FormatError {
        let (path, place) = (self.path.to_owned(), format!("line {}", self.line));
        let begun = |w: &str| w.as_bytes().get(..word.len()).is_some_and(|part| part.eq_ignore_ascii_case(word));
        if self.rest.is_empty() && wanted.into_iter().any(begun) {
            return FormatError::Cut { path, place, expected: expected.to_owned() };
        }
        FormatError::Unexpected { path, place, expected: expected.to_owned(), found: excerpt(word) }
    }

    /// Skips the rest of the current line. This is used after the words `solid` and `endsolid`, where the line can
    /// contain the name of the solid.
    fn skip_line(&mut self) {
        let end = self.rest.iter().position(|&b| b == b'\n').unwrap_or(self.rest.len());
        self.rest = &self.rest[end..];
    }

    /// Reads a facet, whose first word `facet` is already read, until its last word `endfacet`. Returns the three
    /// corners, in millimetres. The three numbers of the normal are skipped. Returns an error if a word is not the
    /// expected one, a coordinate is not valid, or the file ends.
    fn facet(&mut self) -> Result<[Point; 3], FormatError> {
        self.expect("normal")?;
        for _ in 0..3 {
            self.next("a facet normal")?;
        }
        self.expect("outer")?;
        self.expect("loop")?;
        let mut corners = [Point::origin(); 3];
        for corner in &mut corners {
            self.expect("vertex")?;
            for (axis, what) in ["x", "y", "z"].into_iter().enumerate() {
                corner[axis] = self.coordinate(what)?;
            }
        }
        self.expect("endloop")?;
        self.expect("endfacet")?;
        Ok(corners)
    }

    fn coordinate(&mut self, what: &'static str) -> Result<f64, FormatError> {
        let word = self.next("a coordinate")?;
        let (path, place) = (|| self.path.to_owned(), format!("line {}", self.line));
        let begun = |w: &[u8]| w.iter().all(|b| matches!(b, b'+' | b'-' | b'.' | b'0'..=b'9' | b'e' | b'E'));
        match any_number(word) {
            Some(value) if is_believable(value) => Ok(value),
            Some(value) => Err(FormatError::BadCoordinate { path: path(), place, what, value }),
            None if self.rest.is_empty() && begun(word) => {
                Err(FormatError::Cut { path: path(), place, expected: "a coordinate".to_owned() })
            }
            None => {
                let expected = format!("coordinate {what} in millimetres");
                Err(FormatError::Unexpected { path: path(), place, expected, found: excerpt(word) })
            }
        }
    }
}

/// Mesh that is built facet by facet, with equal vertices merged.
struct Welder {
    /// The keys are the bits of the coordinates. The standard hasher has a random key, so that no file can make it
    /// slow.
    known: HashMap<[u64; 3], u32>,
    mesh: StlFile,
}

impl Welder {
    fn with_capacity(facets: usize) -> Self {
        let mesh = StlFile { triangles: Vec::with_capacity(facets), ..StlFile::default() };
        Self { known: HashMap::with_capacity(facets / 2 + 3), mesh }
    }

    fn facet(&mut self, corners: [Point; 3]) {
        // Adding zero turns -0 into 0, which is the same position.
        let corners = corners.map(|corner| corner.map(|v| v + 0.0));
        if is_degenerate(corners.each_ref()) {
            self.mesh.degenerate += 1;
            return;
        }
        let triangle = corners.map(|corner| {
            let next = self.mesh.points.len() as u32;
            let index = *self.known.entry([corner.x, corner.y, corner.z].map(f64::to_bits)).or_insert(next);
            if index == next {
                self.mesh.points.push(corner);
            }
            index
        });
        self.mesh.triangles.push(triangle);
    }

    fn finish(self, path: &Path) -> Result<StlFile, FormatError> {
        if self.mesh.triangles.is_empty() {
            return Err(FormatError::NoData { path: path.to_owned(), expected: "facets with an area" });
        }
        Ok(self.mesh)
    }
}
