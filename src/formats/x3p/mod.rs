//! Maps and point lists in X3P (ISO 25178-72, formerly ISO 5436-2): a zip container of XML and binary heights.
//!
//! ```text
//!  main.xml          axes, instrument, size; the heights themselves, or where they are
//!  bindata/data.bin  heights, or (x, y, z) with as many axes as are absolute; little-endian; metres after the axes' increments
//!  bindata/valid.bin one bit a sample, the least significant first, 1 where it was measured
//!  md5checksum.hex   MD5 of main.xml; those of the binary parts stand in main.xml
//! ```
//!
//! Files are accepted as programs write them: entries in a folder of their own, next to files that an operating system
//! adds; NaN and infinity for samples that were not measured; checksums in upper or lower case; any dash in the
//! revision. Content that can mean another surface than it appears to is rejected: a wrong checksum, layers, profiles,
//! a rotated frame, heights of unknown unit.

mod document;
mod write;

use std::io::{Cursor, Read};
use std::path::Path;

use zip::ZipArchive;

use super::error::{FormatError, excerpt};
use super::height_map::{HeightMap, MapFormat, MapPoints, sample_spacing_mm};
use super::number::is_believable;
use super::whole::{MAX_BYTES, open};
use document::{Axis, Extent, Main, Record, Samples, Sealed, is_sum};
use regrind_core::geometry::{Grid, Point};
pub use write::{MapRecord, escaped, write_error_map_x3p, write_x3p};

/// Largest `main.xml` including heights, in bytes.
const MAX_XML_BYTES: u64 = 64 << 20;
/// Entry with the checksum of `main.xml`, if the document does not name another one.
const SEAL: &str = "md5checksum.hex";
/// Largest entry with a checksum, in bytes.
const MAX_SEAL_BYTES: u64 = 4096;
/// Maximum number of entries of a container.
const MAX_ENTRIES: usize = 10_000;

/// Content of an X3P file.
#[derive(Clone, Debug, PartialEq)]
pub enum X3pFile {
    /// Heights over a regular grid.
    Map(HeightMap),
    /// Points in millimetres, without those that were not measured.
    Points(Vec<Point>),
}

/// X3P format, detected by its first bytes.
pub(super) const FORMAT: MapFormat = MapFormat {
    begins: is_zip,
    parse: |path, bytes, given_mm| {
        let file = parse_x3p(path, bytes)?;
        match (&file, given_mm) {
            (X3pFile::Map(map), _) => {
                sample_spacing_mm(path, map.heights.grid.spacing_mm, given_mm)?;
            }
            (X3pFile::Points(_), Some(_)) => return Err(FormatError::NotAMap { path: path.to_owned() }),
            (X3pFile::Points(_), None) => {}
        }
        Ok(file.into())
    },
};

impl From<X3pFile> for MapPoints {
    fn from(file: X3pFile) -> Self {
        match file {
            X3pFile::Map(map) => map.into(),
            X3pFile::Points(points) => Self { points, notes: Vec::new() },
        }
    }
}

/// Reads an X3P file (surface data of ISO 25178-72) of at most 1 GiB. Returns a height map if the samples are on a
/// regular grid, otherwise a list of points in millimetres.
///
/// # Errors
/// The file cannot be read, or it is not a zip container, damaged or encrypted. `main.xml` or the measured data are
/// missing. A checksum differs from the recorded one. The number of samples differs from the stated size. The file
/// contains a profile, several layers, or a rotated frame.
pub fn read_x3p(path: impl AsRef<Path>) -> Result<X3pFile, FormatError> {
    let path = path.as_ref();
    let opened = open(path)?;
    if !is_zip(&opened.head) {
        let found = excerpt(&opened.head[..opened.head.len().min(8)]);
        let (place, expected) = ("byte 0".to_owned(), "a zip container".to_owned());
        return Err(FormatError::Unexpected { path: path.to_owned(), place, expected, found });
    }
    parse_x3p(path, &opened.read_all(path, MAX_BYTES)?)
}

/// Parses `bytes`, the content of an X3P file. Returns a height map if the samples are on a regular grid, otherwise a
/// list of points in millimetres. `path` is the name of the file in error messages; nothing is read from this path.
///
/// # Errors
/// The errors of [`read_x3p`], except those of opening and reading the file.
pub fn parse_x3p(path: &Path, bytes: &[u8]) -> Result<X3pFile, FormatError> {
    let mut container = Container::open(path, bytes)?;
    let xml = container.entry("main.xml", MAX_XML_BYTES)?;
    // A modified document is reported as modified, before its content is used.
    container.check_sealed(SEAL, &xml)?;
    let (main, samples) = Main::parse(path, &container.name("main.xml"), &xml)?;
    if let Some(seal) = main.checksum_file.as_deref().filter(|seal| *seal != SEAL) {
        container.check_sealed(seal, &xml)?;
    }
    drop(xml);
    let count = main.extent.count(path)?;
    let records = match samples {
        Samples::Inline(records) => records,
        Samples::Linked { data, valid } => linked(&mut container, &main.axes, &data, valid.as_ref(), count)?,
    };
    if records.len() != count {
        let (place, expected) = ("Record3".to_owned(), format!("{count} samples, as its dimension says"));
        return Err(FormatError::Unexpected {
            path: path.to_owned(),
            place,
            expected,
            found: records.len().to_string(),
        });
    }
    assembled(path, &main, &records)
}

/// Returns true if `head`, the beginning of a file, is that of a zip container, even an empty one.
fn is_zip(head: &[u8]) -> bool {
    head.starts_with(b"PK\x03\x04") || head.starts_with(b"PK\x05\x06")
}

/// Reads `count` samples from the binary entry `data` of the container. `valid` is the entry with the bit mask of the
/// measured samples; without this entry, all samples count as measured. `axes` gives the number type of x, y and z.
/// Returns one item per sample, in the order of the file. An item is `None` if its sample was not measured or has a
/// value that is not finite.
///
/// # Errors
/// An entry is missing or damaged, or has another length or another checksum.
fn linked(
    container: &mut Container<'_>,
    axes: &[Axis; 3],
    data: &Sealed,
    valid: Option<&Sealed>,
    count: usize,
) -> Result<Vec<Record>, FormatError> {
    let width: usize = axes.iter().filter(|axis| axis.absolute).map(|axis| axis.kind.bytes()).sum();
    let bytes = container.sealed(data, (count * width) as u64)?;
    let mask = valid.map(|valid| container.sealed(valid, count.div_ceil(8) as u64)).transpose()?;
    let is_valid = |k: usize| mask.as_ref().is_none_or(|mask| mask[k / 8] >> (k % 8) & 1 == 1);
    let record = |mut at: &[u8]| {
        let mut values = [0.0; 3];
        for (value, axis) in values.iter_mut().zip(axes).filter(|(_, axis)| axis.absolute) {
            let (own, rest) = at.split_at(axis.kind.bytes());
            (*value, at) = (axis.kind.value(own), rest);
        }
        // Instruments write NaN or infinity for samples that they could not measure.
        values.iter().all(|v| v.is_finite()).then_some(values)
    };
    Ok(bytes.chunks_exact(width).enumerate().map(|(k, at)| if is_valid(k) { record(at) } else { None }).collect())
}

/// Converts `records`, the samples of an X3P file as stored, to millimetres. `main` is the content of `main.xml`, which
/// has the offset and the scale of each axis and the size of the map. `path` only names the file in messages.
///
/// Returns a height map if the file stores a matrix of heights only. The column then gives x, and the row gives y.
/// Otherwise the file stores x or y of each sample, or a list of samples. Then returns a list of points, and omits
/// samples that were not measured.
fn assembled(path: &Path, main: &Main, records: &[Record]) -> Result<X3pFile, FormatError> {
    let [x, y, z] = &main.axes;
    let mm = |axis: &Axis, raw: f64| 1e3 * (axis.offset_m + raw * axis.increment);
    let Extent::Matrix([columns, rows]) = main.extent else {
        return points(path, records.iter().flatten().map(|[a, b, c]| [mm(x, *a), mm(y, *b), mm(z, *c)]));
    };
    if x.absolute || y.absolute {
        let place = |axis: &Axis, raw: f64, index: usize| mm(axis, if axis.absolute { raw } else { index as f64 });
        let samples = records.iter().enumerate().filter_map(|(k, r)| r.map(|r| (k, r)));
        return points(
            path,
            samples.map(|(k, [a, b, c])| [place(x, a, k % columns), place(y, b, k / columns), mm(z, c)]),
        );
    }
    let heights = |k: usize| records[k].map(|[.., raw]| mm(z, raw));
    let grid =
        Grid { columns, rows, first_mm: [mm(x, 0.0), mm(y, 0.0)], spacing_mm: [1e3 * x.increment, 1e3 * y.increment] };
    let mut map = if main.rows_from_north {
        let order = (0..rows).rev().flat_map(|row| (0..columns).map(move |column| row * columns + column));
        HeightMap::new(path, grid, order.map(heights))?
    } else {
        HeightMap::new(path, grid, (0..records.len()).map(heights))?
    };
    map.notes.clone_from(&main.notes);
    Ok(X3pFile::Map(map))
}

fn points(path: &Path, places: impl Iterator<Item = [f64; 3]>) -> Result<X3pFile, FormatError> {
    let mut points = Vec::new();
    for (k, [x, y, z]) in places.enumerate() {
        for (what, value) in [("x", x), ("y", y), ("z", z)] {
            if !is_believable(value) {
                let place = format!("measured point {}", k + 1);
                return Err(FormatError::BadCoordinate { path: path.to_owned(), place, what, value });
            }
        }
        points.push(Point::new(x, y, z));
    }
    if points.is_empty() {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "point that was measured" });
    }
    Ok(X3pFile::Points(points))
}

fn check_sum(path: &Path, entry: &str, bytes: &[u8], expected: &str) -> Result<(), FormatError> {
    let found = write::sum(bytes);
    if found.eq_ignore_ascii_case(expected) {
        return Ok(());
    }
    let (entry, expected) = (entry.to_owned(), expected.to_lowercase());
    Err(FormatError::Checksum { path: path.to_owned(), entry, expected, found })
}

/// Zip container of a file.
struct Container<'a> {
    path: &'a Path,
    zip: ZipArchive<Cursor<&'a [u8]>>,
    /// Folder that contains all entries, with its slash; usually empty.
    folder: String,
}

impl<'a> Container<'a> {
    /// Opens the zip container in `bytes`, and finds the folder of its only `main.xml`.
    ///
    /// # Errors
    /// A damaged container; too many entries; no `main.xml`, or more than one.
    fn open(path: &'a Path, bytes: &'a [u8]) -> Result<Self, FormatError> {
        let zip = ZipArchive::new(Cursor::new(bytes))
            .map_err(|source| FormatError::Container { path: path.to_owned(), source })?;
        if zip.len() > MAX_ENTRIES {
            let (found, limit) = (zip.len() as u64, MAX_ENTRIES as u64);
            return Err(FormatError::TooLarge { path: path.to_owned(), found, limit, unit: "entries of a container" });
        }
        let mut folders: Vec<String> = Vec::new();
        for name in (0..zip.len()).filter_map(|k| zip.name_for_index(k)) {
            let name = name.map_err(|source| FormatError::Container { path: path.to_owned(), source })?;
            let name = name.replace('\\', "/");
            // Files that macOS adds for the entries have the same names.
            if name.starts_with("__MACOSX/") || name.contains("/__MACOSX/") {
                continue;
            }
            if let Some(folder) = name.strip_suffix("main.xml").filter(|f| f.is_empty() || f.ends_with('/')) {
                folders.push(folder.to_owned());
            }
        }
        match folders.len() {
            1 => Ok(Self { path, zip, folder: folders.remove(0) }),
            0 => Err(FormatError::WrongKind {
                path: path.to_owned(),
                expected: "an X3P map with a main.xml",
                found: "a zip archive without a main.xml",
                remedy: "unpack it and give the file that is in it, or export the map again",
            }),
            _ => Err(FormatError::Unexpected {
                path: path.to_owned(),
                place: "the container".to_owned(),
                expected: "one main.xml".to_owned(),
                found: format!("{} of them", folders.len()),
            }),
        }
    }

    /// Returns the name of an entry in the container: the folder of `main.xml`, then `entry`.
    fn name(&self, entry: &str) -> String {
        format!("{}{entry}", self.folder)
    }

    fn find(&self, entry: &str) -> Option<usize> {
        let wanted = self.name(entry.trim_start_matches("./"));
        let is_it =
            |k: &usize| self.zip.name_for_index(*k).is_some_and(|n| n.is_ok_and(|n| n.replace('\\', "/") == wanted));
        (0..self.zip.len()).find(is_it)
    }

    /// Decompresses the entry `entry` of the zip container, and returns its bytes. Stops if the entry has more than
    /// `limit` bytes. The container also states a length for each entry, but this length can be wrong and is not used.
    ///
    /// # Errors
    /// An entry that is missing or damaged, or that has more than `limit` bytes.
    fn entry(&mut self, entry: &str, limit: u64) -> Result<Vec<u8>, FormatError> {
        let missing = || FormatError::Missing { path: self.path.to_owned(), expected: entry.to_owned() };
        let index = self.find(entry).ok_or_else(missing)?;
        let path = self.path;
        let damaged = |source| FormatError::Container { path: path.to_owned(), source };
        let packed = self.zip.by_index(index).map_err(damaged)?;
        let mut bytes = Vec::new();
        packed.take(limit + 1).read_to_end(&mut bytes).map_err(|error| damaged(error.into()))?;
        let found = bytes.len() as u64;
        if found > limit {
            return Err(FormatError::TooLarge { path: path.to_owned(), found, limit, unit: "bytes unpacked" });
        }
        Ok(bytes)
    }

    /// Decompresses an entry of the container, and verifies its MD5 checksum. `sealed` has the name of the entry and
    /// the expected checksum; without a checksum, only the length is verified. The entry must have `length` bytes.
    ///
    /// # Errors
    /// The entry is missing or damaged, or has another length or another checksum.
    fn sealed(&mut self, sealed: &Sealed, length: u64) -> Result<Vec<u8>, FormatError> {
        let bytes = self.entry(&sealed.entry, length)?;
        if bytes.len() as u64 != length {
            let (place, expected) = (sealed.entry.clone(), format!("{length} bytes for the dimension in main.xml"));
            let found = bytes.len().to_string();
            return Err(FormatError::Unexpected { path: self.path.to_owned(), place, expected, found });
        }
        match &sealed.md5 {
            Some(expected) => check_sum(self.path, &sealed.entry, &bytes, expected).map(|()| bytes),
            None => Ok(bytes),
        }
    }

    /// Verifies the MD5 checksum of `main.xml`. `xml` is the content of `main.xml`. `seal` is the name of the entry
    /// that contains the expected checksum. If this entry is missing or contains no checksum, nothing is verified.
    ///
    /// # Errors
    /// The checksums differ, or the entry `seal` is damaged or too long.
    fn check_sealed(&mut self, seal: &str, xml: &[u8]) -> Result<(), FormatError> {
        if self.find(seal).is_none() {
            return Ok(());
        }
        let text = String::from_utf8_lossy(&self.entry(seal, MAX_SEAL_BYTES)?).into_owned();
        match text.split_whitespace().find(|word| is_sum(word)) {
            Some(expected) => check_sum(self.path, "main.xml", xml, expected),
            None => Ok(()),
        }
    }
}
