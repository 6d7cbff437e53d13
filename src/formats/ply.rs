//! Point clouds and meshes in PLY: ascii, binary little endian, binary big endian.
//!
//! The elements `vertex` and `face` are read, all others are skipped. Of their properties, x y z, nx ny nz and the list
//! of vertex indices are read. Counts in the header are trusted only as far as the file has bytes for them.
//! Format: G. Turk, The PLY Polygon File Format, 1994.

use std::cell::{Cell, RefCell};
use std::path::Path;

use regrind_core::geometry::{Point, Vector};

use super::columns::check_stated_unit;
use super::error::{FormatError, excerpt};
use super::number::{any_number, is_believable};
use super::unit::Unit;
use super::whole::{is_degenerate, open};

/// Content of a PLY file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlyFile {
    /// The vertices in the order of the file, in millimetres.
    pub points: Vec<Point>,
    /// One unit direction per vertex, or a zero vector for a vertex without one, if the file has nx, ny, nz.
    pub normals: Option<Vec<Vector>>,
    /// Corner indices of the triangles; a polygon is split into a fan from its first corner, which is correct for
    /// convex ones.
    pub triangles: Vec<[u32; 3]>,
    /// Number of triangles that were skipped because their area is 0.
    pub degenerate: usize,
}

/// Reads a PLY file of at most 1 GiB. Returns its vertices in millimetres, their normals if the file has them, and its
/// faces as triangles.
///
/// # Errors
/// A file that is not readable, not PLY, malformed or cut, or that has content after its end; a vertex that is not
/// finite or beyond 1e7 mm; a face with fewer than three corners or with a corner that is not a vertex.
pub fn read_ply(path: impl AsRef<Path>) -> Result<PlyFile, FormatError> {
    open(path.as_ref())?.parse(path.as_ref(), parse_ply)
}

/// Parses `bytes`, the content of a PLY file. Returns its vertices in millimetres, their normals if the file has them,
/// and its faces as triangles. `path` only names the file in messages.
///
/// # Errors
/// The same as for [`read_ply`].
pub fn parse_ply(path: &Path, bytes: &[u8]) -> Result<PlyFile, FormatError> {
    parse_ply_in(path, bytes, [Unit::Millimetre; 2])
}

/// Parses `bytes`, the content of a PLY file. Returns its vertices, their normals if the file has them, and its faces
/// as triangles. The coordinates stay in the unit of the file.
///
/// `units` holds two expected units: first the unit of all coordinates, then the unit of z. The file is rejected if a
/// comment in its header states another unit. `path` only names the file in messages.
///
/// # Errors
/// The same as for [`read_ply`]; a comment with another unit.
pub(super) fn parse_ply_in(path: &Path, bytes: &[u8], units: [Unit; 2]) -> Result<PlyFile, FormatError> {
    let header = Header::parse(path, bytes, units)?;
    let data = &bytes[header.length..];
    match header.encoding {
        Encoding::Ascii => header.read(path, &mut Words::new(data, header.lines)),
        Encoding::Little => header.read(path, &mut Bytes::<false>::new(data, header.length)),
        Encoding::Big => header.read(path, &mut Bytes::<true>::new(data, header.length)),
    }
}

/// Returns true if `head`, the beginning of a file, begins with the word `ply`.
pub(super) fn is_ply(head: &[u8]) -> bool {
    head.strip_prefix(b"ply").is_some_and(|rest| rest.trim_ascii_start().len() < rest.len() || rest.is_empty())
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Encoding {
    Ascii,
    Little,
    Big,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn named(name: &[u8]) -> Option<Self> {
        Some(match name {
            b"char" | b"int8" => Self::I8,
            b"uchar" | b"uint8" => Self::U8,
            b"short" | b"int16" => Self::I16,
            b"ushort" | b"uint16" => Self::U16,
            b"int" | b"int32" => Self::I32,
            b"uint" | b"uint32" => Self::U32,
            b"float" | b"float32" => Self::F32,
            b"double" | b"float64" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    fn is_integer(self) -> bool {
        !matches!(self, Self::F32 | Self::F64)
    }
}

/// Property of an element.
#[derive(Clone, Debug, PartialEq)]
struct Property {
    name: String,
    /// The type of the length, if it is a list.
    list: Option<Scalar>,
    scalar: Scalar,
}

#[derive(Clone, Debug, PartialEq)]
struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

impl Element {
    fn position(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|property| property.name == name)
    }

    /// Returns the indices of the three properties with these names; `None` if one of them does not exist or is a list.
    fn triple(&self, names: [&str; 3]) -> Option<[usize; 3]> {
        let found = names.map(|name| self.position(name).filter(|&at| self.properties[at].list.is_none()));
        if let [Some(a), Some(b), Some(c)] = found { Some([a, b, c]) } else { None }
    }

    /// Returns the minimum number of bytes, at least 1, that one item of this element (such as one vertex) has in a
    /// file with this `encoding`.
    fn min_size(&self, encoding: Encoding) -> usize {
        let size = |p: &Property| if encoding == Encoding::Ascii { 2 } else { p.list.unwrap_or(p.scalar).size() };
        self.properties.iter().map(size).sum::<usize>().max(1)
    }
}

/// Header of a file.
struct Header {
    encoding: Encoding,
    elements: Vec<Element>,
    /// Number of bytes and lines of the header.
    length: usize,
    lines: u64,
}

impl Header {
    fn parse(path: &Path, bytes: &[u8], units: [Unit; 2]) -> Result<Self, FormatError> {
        if bytes.is_empty() {
            return Err(FormatError::Empty { path: path.to_owned(), expected: "a PLY header" });
        }
        let mut header = Self { encoding: Encoding::Ascii, elements: Vec::new(), length: 0, lines: 0 };
        let mut encoding = None;
        loop {
            let line = header.next_line(path, &bytes[header.length..])?;
            let number = header.lines;
            let fault = |expected: &str| header_fault(path, number, expected, line);
            let words: Vec<&[u8]> = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()).collect();
            match words[..] {
                [b"ply"] if number == 1 => {}
                _ if number == 1 => return Err(fault("`ply` in a line of its own")),
                [b"format", name, b"1.0"] if encoding.is_none() => {
                    let known = "format ascii, binary_little_endian or binary_big_endian";
                    encoding = Some(Encoding::named(name).ok_or_else(|| fault(known))?);
                }
                [b"comment" | b"obj_info", ..] => check_stated_unit(path, number, line, units)?,
                [] => {}
                _ if encoding.is_none() => return Err(fault("`format ascii 1.0` or another format")),
                [b"end_header"] => break,
                _ => header.declare(&words).map_err(fault)?,
            }
        }
        header.encoding = encoding.unwrap_or(Encoding::Ascii);
        header.check(path)?;
        Ok(header)
    }

    /// Reads the next line of the header, and returns it without blanks at its ends. `rest` is the part of the file
    /// that is not yet read. `path` only names the file in messages.
    ///
    /// # Errors
    /// A line without a line end; a line or a header that is too long.
    fn next_line<'b>(&mut self, path: &Path, rest: &'b [u8]) -> Result<&'b [u8], FormatError> {
        let most = rest.len().min(LONGEST_LINE);
        let end = rest[..most].iter().position(|&b| b == b'\n');
        let line = rest[..end.unwrap_or(most)].trim_ascii();
        let number = self.lines + 1;
        let Some(end) = end else {
            let may_be_ply = number > 1 || b"ply".starts_with(line);
            return Err(if most < LONGEST_LINE && may_be_ply {
                let expected = "the rest of the header, up to `end_header`".to_owned();
                FormatError::Cut { path: path.to_owned(), place: format!("line {number}"), expected }
            } else if may_be_ply {
                header_fault(path, number, "a short line of a PLY header", line)
            } else {
                header_fault(path, number, "`ply` in a line of its own", line)
            });
        };
        self.length += end + 1;
        self.lines = number;
        if self.length > LONGEST_HEADER {
            return Err(header_fault(path, number, "a header of at most 32 KiB", b"a longer one"));
        }
        Ok(line)
    }

    /// Reads a line of the header that declares an element or a property, and adds it to this header. `words` are the
    /// words of the line.
    ///
    /// # Errors
    /// A line that is not a valid declaration. The error is a text that names the expected content.
    fn declare(&mut self, words: &[&[u8]]) -> Result<(), &'static str> {
        let text = |word: &[u8]| String::from_utf8_lossy(word).into_owned();
        let (name, list, scalar) = match *words {
            [b"element", name, count] => {
                let count = std::str::from_utf8(count).ok().and_then(|c| c.parse().ok());
                let count = count.ok_or("an element with a count, as `element vertex 100`")?;
                self.elements.push(Element { name: text(name), count, properties: Vec::new() });
                return Ok(());
            }
            [b"property", b"list", length, scalar, name] => {
                let length = Scalar::named(length).filter(|l| l.is_integer()).ok_or("a list with an integer length")?;
                (text(name), Some(length), scalar)
            }
            [b"property", scalar, name] => (text(name), None, scalar),
            _ => return Err("comment, element, property or end_header"),
        };
        let scalar = Scalar::named(scalar).ok_or("a type such as float, double, uchar or int")?;
        let element = self.elements.last_mut().ok_or("an element before its properties")?;
        if element.position(&name).is_some() {
            return Err("a property of another name than those before it");
        }
        element.properties.push(Property { name, list, scalar });
        Ok(())
    }

    /// Returns an error if the header does not declare exactly one element `vertex` with the scalar properties x, y and
    /// z, if it declares no vertices or too many, or if the vertex indices of faces do not have an integer type.
    fn check(&self, path: &Path) -> Result<(), FormatError> {
        let fault = |expected: &str, found: &str| FormatError::Unexpected {
            path: path.to_owned(),
            place: format!("header of {} lines", self.lines),
            expected: expected.to_owned(),
            found: found.to_owned(),
        };
        let vertices: Vec<&Element> = self.elements.iter().filter(|e| e.name == "vertex").collect();
        let [vertex] = vertices[..] else {
            return Err(fault("one element vertex", &format!("{} of them", vertices.len())));
        };
        if vertex.triple(["x", "y", "z"]).is_none() {
            return Err(fault("scalar properties x, y and z of element vertex", "others only"));
        }
        if vertex.count == 0 {
            return Err(FormatError::NoData { path: path.to_owned(), expected: "vertices" });
        }
        let limit = u64::from(u32::MAX);
        if vertex.count > limit {
            let (path, found) = (path.to_owned(), vertex.count);
            return Err(FormatError::TooLarge { path, found, limit, unit: "vertices" });
        }
        match self.elements.iter().find(|e| e.name == "face").and_then(indices_of) {
            Some(indices) if !indices.scalar.is_integer() => {
                Err(fault("vertex indices of an integer type", "a float type"))
            }
            _ => Ok(()),
        }
    }

    /// Reads the data of all elements from `source`, in the order in which the header declares them. Triangles of area
    /// 0 are omitted and counted. `path` only names the file in messages.
    ///
    /// # Errors
    /// Data that are not valid, that end too early, or that continue after the last element.
    fn read(&self, path: &Path, source: &mut impl Source) -> Result<PlyFile, FormatError> {
        let mut file = PlyFile::default();
        let vertices = self.elements.iter().find(|e| e.name == "vertex").map_or(0, |e| e.count);
        // An element without properties has no bytes, so nothing bounds its count.
        for element in self.elements.iter().filter(|e| !e.properties.is_empty()) {
            let reading = Reading { path, element, room: source.remaining() / element.min_size(self.encoding) };
            match element.name.as_str() {
                "vertex" => reading.vertices(source, &mut file)?,
                "face" if indices_of(element).is_some() => reading.faces(source, &mut file.triangles, vertices)?,
                _ => reading.each(source, |_, _, _| Ok(()), |_, _| Ok(()))?,
            }
        }
        source.finish().map_err(|fault| fault.into_error(path, "the end of the file".to_owned()))?;
        let before = file.triangles.len();
        let points = &file.points;
        file.triangles.retain(|t| !is_degenerate(t.map(|corner| &points[corner as usize])));
        file.degenerate = before - file.triangles.len();
        Ok(file)
    }
}

fn header_fault(path: &Path, line: u64, expected: &str, found: &[u8]) -> FormatError {
    let (path, place) = (path.to_owned(), format!("line {line}"));
    FormatError::Unexpected { path, place, expected: expected.to_owned(), found: excerpt(found) }
}

/// Maximum length of an incomplete number at a cut.
const LONGEST_WORD: usize = 64;
/// Maximum length of a line of the header.
const LONGEST_LINE: usize = 4096;
/// Maximum length of the header; less than the part of a file that is read first.
const LONGEST_HEADER: usize = 32 << 10;

impl Encoding {
    fn named(name: &[u8]) -> Option<Self> {
        match name {
            b"ascii" => Some(Self::Ascii),
            b"binary_little_endian" => Some(Self::Little),
            b"binary_big_endian" => Some(Self::Big),
            _ => None,
        }
    }
}

/// Returns the property `vertex_indices` or `vertex_index` of an element `face`; `None` if it has no such list.
fn indices_of(face: &Element) -> Option<&Property> {
    let is_indices = |p: &&Property| p.list.is_some() && matches!(p.name.as_str(), "vertex_indices" | "vertex_index");
    face.properties.iter().find(is_indices)
}

/// Element while it is read.
struct Reading<'a> {
    path: &'a Path,
    element: &'a Element,
    /// Maximum number of items that the remaining bytes can hold.
    room: usize,
}

impl Reading<'_> {
    /// Reads all items of this element from `source`. Calls `value` for each number, with the index of its property,
    /// the number and `source`. Calls `done` after each item, with the index of the item (from 0) and `source`.
    ///
    /// # Errors
    /// Data that are not valid or end too early; the first error of `value` or `done`.
    fn each<S: Source>(
        &self,
        source: &mut S,
        mut value: impl FnMut(usize, f64, &S) -> Result<(), FormatError>,
        mut done: impl FnMut(u64, &S) -> Result<(), FormatError>,
    ) -> Result<(), FormatError> {
        let Element { name, count, properties } = self.element;
        for item in 0..*count {
            let expected = || format!("{name} {} of {count}", item + 1);
            let lost = |fault: Fault| fault.into_error(self.path, expected());
            source.begin_item().map_err(lost)?;
            for (at, property) in properties.iter().enumerate() {
                let Some(length_type) = property.list else {
                    value(at, source.scalar(property.scalar).map_err(lost)?, source)?;
                    continue;
                };
                let length = source.scalar(length_type).map_err(lost)?;
                if !(length >= 0.0 && length.fract() == 0.0) {
                    let wanted = format!("the length of list {} of {}", property.name, expected());
                    return Err(self.unexpected(source, wanted, format!("{length}")));
                }
                // A list that is longer than the file ends with the file, so its length needs no limit.
                for _ in 0..length as u64 {
                    value(at, source.scalar(property.scalar).map_err(lost)?, source)?;
                }
            }
            source.end_item().map_err(lost)?;
            done(item, source)?;
        }
        Ok(())
    }

    fn vertices(&self, source: &mut impl Source, file: &mut PlyFile) -> Result<(), FormatError> {
        let capacity = self.room.min(self.element.count as usize);
        let position = self.element.triple(["x", "y", "z"]).unwrap_or_default();
        let direction = self.element.triple(["nx", "ny", "nz"]);
        let mut points = Vec::with_capacity(capacity);
        let mut normals = Vec::with_capacity(if direction.is_some() { capacity } else { 0 });
        // x, y, z, nx, ny, nz of the current vertex; the normal stays zero if there is none.
        let columns = [position, direction.unwrap_or([usize::MAX; 3])].concat();
        let values = Cell::new([0.0; 6]);
        self.each(
            source,
            |at, value, source| {
                let Some(slot) = columns.iter().position(|&column| column == at) else { return Ok(()) };
                if !is_believable(value) {
                    let what = ["x", "y", "z", "nx", "ny", "nz"][slot];
                    let (path, place) = (self.path.to_owned(), source.place());
                    return Err(FormatError::BadCoordinate { path, place, what, value });
                }
                let mut all = values.get();
                all[slot] = value;
                values.set(all);
                Ok(())
            },
            |_, _| {
                let [x, y, z, nx, ny, nz] = values.get();
                points.push(Point::new(x, y, z));
                if direction.is_some() {
                    normals.push(Vector::new(nx, ny, nz).try_normalize(0.0).unwrap_or_default());
                }
                Ok(())
            },
        )?;
        file.points = points;
        file.normals = direction.map(|_| normals);
        Ok(())
    }

    fn faces(&self, source: &mut impl Source, triangles: &mut Vec<[u32; 3]>, vertices: u64) -> Result<(), FormatError> {
        let indices = self.element.properties.iter().position(|p| Some(p) == indices_of(self.element));
        let polygon = RefCell::new(Vec::new());
        self.each(
            source,
            |at, value, source| {
                if Some(at) == indices {
                    if !(value >= 0.0 && value < vertices as f64 && value.fract() == 0.0) {
                        let (path, place) = (self.path.to_owned(), source.place());
                        return Err(FormatError::IndexOutOfRange { path, place, index: value, vertices });
                    }
                    polygon.borrow_mut().push(value as u32);
                }
                Ok(())
            },
            |item, source| {
                let mut corners = polygon.borrow_mut();
                if corners.len() < 3 {
                    let wanted = format!("at least 3 corners of face {}", item + 1);
                    return Err(self.unexpected(source, wanted, format!("{}", corners.len())));
                }
                triangles.extend(corners[1..].windows(2).map(|edge| [corners[0], edge[0], edge[1]]));
                corners.clear();
                Ok(())
            },
        )
    }

    fn unexpected(&self, source: &impl Source, expected: String, found: String) -> FormatError {
        FormatError::Unexpected { path: self.path.to_owned(), place: source.place(), expected, found }
    }
}

/// Reason why the next value could not be read.
struct Fault {
    place: String,
    /// Text at the place; `None` at the end of the file.
    found: Option<String>,
}

impl Fault {
    fn into_error(self, path: &Path, expected: String) -> FormatError {
        let (path, place) = (path.to_owned(), self.place);
        match self.found {
            Some(found) => FormatError::Unexpected { path, place, expected, found },
            None => FormatError::Cut { path, place, expected },
        }
    }
}

/// Source of values, one after the other.
trait Source {
    fn begin_item(&mut self) -> Result<(), Fault>;
    fn scalar(&mut self, scalar: Scalar) -> Result<f64, Fault>;
    fn end_item(&mut self) -> Result<(), Fault>;
    /// Returns an error if content remains after the last value.
    fn finish(&mut self) -> Result<(), Fault>;
    fn remaining(&self) -> usize;
    fn place(&self) -> String;
}

/// Values in binary form.
struct Bytes<'a, const BIG: bool> {
    data: &'a [u8],
    at: usize,
    /// Start of the last value.
    last: usize,
    /// Start of the data in the file.
    start: usize,
}

impl<'a, const BIG: bool> Bytes<'a, BIG> {
    fn new(data: &'a [u8], start: usize) -> Self {
        Self { data, at: 0, last: 0, start }
    }

    fn read_bytes<const N: usize>(&mut self) -> Result<[u8; N], Fault> {
        let Some(bytes) = self.data[self.at..].first_chunk::<N>() else {
            return Err(Fault { place: format!("byte {}", self.start + self.data.len()), found: None });
        };
        self.last = self.at;
        self.at += N;
        let mut bytes = *bytes;
        if BIG {
            bytes.reverse();
        }
        Ok(bytes)
    }
}

impl<const BIG: bool> Source for Bytes<'_, BIG> {
    fn begin_item(&mut self) -> Result<(), Fault> {
        Ok(())
    }

    #[inline]
    fn scalar(&mut self, scalar: Scalar) -> Result<f64, Fault> {
        Ok(match scalar {
            Scalar::I8 => i8::from_le_bytes(self.read_bytes()?).into(),
            Scalar::U8 => u8::from_le_bytes(self.read_bytes()?).into(),
            Scalar::I16 => i16::from_le_bytes(self.read_bytes()?).into(),
            Scalar::U16 => u16::from_le_bytes(self.read_bytes()?).into(),
            Scalar::I32 => i32::from_le_bytes(self.read_bytes()?).into(),
            Scalar::U32 => u32::from_le_bytes(self.read_bytes()?).into(),
            Scalar::F32 => f32::from_le_bytes(self.read_bytes()?).into(),
            Scalar::F64 => f64::from_le_bytes(self.read_bytes()?),
        })
    }

    fn end_item(&mut self) -> Result<(), Fault> {
        Ok(())
    }

    fn finish(&mut self) -> Result<(), Fault> {
        // A newline after the data is harmless; more content means that the counts are wrong.
        let rest = self.data[self.at..].trim_ascii();
        let found = format!("{} bytes more", rest.len());
        if rest.is_empty() {
            Ok(())
        } else {
            Err(Fault { place: format!("byte {}", self.start + self.at), found: Some(found) })
        }
    }

    fn remaining(&self) -> usize {
        self.data.len() - self.at
    }

    fn place(&self) -> String {
        format!("byte {}", self.start + self.last)
    }
}

/// Values as words, one item per line.
struct Words<'a> {
    /// Remaining lines.
    rest: &'a [u8],
    /// Rest of the current line.
    line: &'a [u8],
    /// True if the current line has its newline.
    ended: bool,
    number: u64,
}

impl<'a> Words<'a> {
    fn new(rest: &'a [u8], header_lines: u64) -> Self {
        Self { rest, line: &[], ended: true, number: header_lines }
    }

    /// Moves to the next line that is not blank. Returns false if there is none.
    fn next_line(&mut self) -> bool {
        while !self.rest.is_empty() {
            let end = self.rest.iter().position(|&b| b == b'\n').unwrap_or(self.rest.len());
            self.line = self.rest[..end].trim_ascii();
            self.ended = end < self.rest.len();
            self.rest = self.rest.get(end + 1..).unwrap_or_default();
            self.number += 1;
            if !self.line.is_empty() {
                return true;
            }
        }
        false
    }

    fn fault(&self, found: &[u8]) -> Fault {
        Fault { place: self.place(), found: Some(excerpt(found)) }
    }
}

impl Source for Words<'_> {
    fn begin_item(&mut self) -> Result<(), Fault> {
        if self.next_line() { Ok(()) } else { Err(Fault { place: self.place(), found: None }) }
    }

    fn scalar(&mut self, scalar: Scalar) -> Result<f64, Fault> {
        let end = self.line.iter().position(u8::is_ascii_whitespace).unwrap_or(self.line.len());
        let (word, rest) = self.line.split_at(end);
        if word.is_empty() && self.rest.is_empty() {
            return Err(Fault { place: self.place(), found: None });
        }
        let value = any_number(word).filter(|v| !scalar.is_integer() || v.fract() == 0.0);
        // An incomplete word at the end of a file means that the file is cut, not that it contains foreign text.
        let cut = || Fault { place: self.place(), found: None };
        let value = value.ok_or_else(|| {
            if rest.is_empty() && !self.ended && end < LONGEST_WORD { cut() } else { self.fault(word) }
        })?;
        self.line = rest.trim_ascii_start();
        Ok(value)
    }

    fn end_item(&mut self) -> Result<(), Fault> {
        if self.line.is_empty() { Ok(()) } else { Err(self.fault(self.line)) }
    }

    fn finish(&mut self) -> Result<(), Fault> {
        if self.next_line() { Err(self.fault(self.line)) } else { Ok(()) }
    }

    fn remaining(&self) -> usize {
        self.rest.len()
    }

    fn place(&self) -> String {
        format!("line {}", self.number)
    }
}
