//! Maps of Zygo interferometers in MetroPro's binary format (`.dat`).
//!
//! A header of 834 or 4096 bytes, the intensities as 16-bit and the phases as 32-bit integers, all big-endian. The
//! height of a sample is raw * scale * obliquity * wavelength / R in metres, where R is 4096, 32768 or 131072 depending
//! on the phase resolution. A raw value of 2147483640 or more was not measured. Rows run from the top of the picture
//! downwards and are reversed here, so that the map is right-handed.
//! Format: Zygo, MetroPro Reference Guide, "Data format of MetroPro binary data files".

use std::path::Path;

use super::error::FormatError;
use super::height_map::{HeightMap, MapFormat, check_size, sample_spacing_mm};
use super::whole::open;
use regrind_core::geometry::Grid;

/// First raw value that means not measured.
const NOT_MEASURED: i32 = 2_147_483_640;
/// Valid combinations of magic number, header format and header length.
const HEADERS: [(u32, u16, u32); 3] = [(0x881b_036f, 1, 834), (0x881b_0370, 2, 834), (0x881b_0371, 3, 4096)];
/// Bytes of a header that contain all fields that are read.
const MIN_HEADER: usize = 834;

/// MetroPro format, detected by its first bytes.
pub(super) const FORMAT: MapFormat = MapFormat {
    begins: is_metropro,
    parse: |path, bytes, given_mm| parse_metropro_with(path, bytes, given_mm).map(Into::into),
};

/// Reads a MetroPro map of at most 1 GiB. Returns the heights on a grid, in millimetres.
///
/// # Errors
/// A file that is not readable, not MetroPro or cut; a file without phases (the measured heights of the interferometer)
/// or without the lateral scale (the distance of the samples); invalid numbers in its header.
pub fn read_metropro(path: impl AsRef<Path>) -> Result<HeightMap, FormatError> {
    open(path.as_ref())?.parse(path.as_ref(), parse_metropro)
}

/// Parses `bytes`, the content of a MetroPro file. Returns the heights on a grid, in millimetres. `path` only names the
/// file in messages.
///
/// # Errors
/// The same as for [`read_metropro`].
pub fn parse_metropro(path: &Path, bytes: &[u8]) -> Result<HeightMap, FormatError> {
    parse_metropro_with(path, bytes, None)
}

/// Parses as [`parse_metropro`]; `given_mm` is the distance of the samples for a file that states none.
fn parse_metropro_with(path: &Path, bytes: &[u8], given_mm: Option<f64>) -> Result<HeightMap, FormatError> {
    let header = Header::read(path, bytes)?;
    let [columns, rows] = header.size;
    let unit_mm = header.unit_mm(path)?;
    let spacing_mm = sample_spacing_mm(path, [1e3 * header.pitch_m; 2], given_mm)?;
    let raw = bytes.get(header.begin..header.begin + 4 * columns * rows).ok_or_else(|| FormatError::Cut {
        path: path.to_owned(),
        place: format!("byte {}", bytes.len()),
        expected: format!("{columns} times {rows} phases of 4 bytes from byte {} on", header.begin),
    })?;
    let height = |at: &[u8]| {
        let raw = at.first_chunk().map_or(NOT_MEASURED, |b| i32::from_be_bytes(*b));
        (raw < NOT_MEASURED).then(|| f64::from(raw) * unit_mm)
    };
    let samples = raw.chunks_exact(4 * columns).rev().flat_map(|row| row.chunks_exact(4).map(height));
    HeightMap::new(path, Grid { columns, rows, first_mm: [0.0; 2], spacing_mm }, samples)
}

/// Returns true if `head`, the beginning of a file, has the magic number of MetroPro.
fn is_metropro(head: &[u8]) -> bool {
    HEADERS.iter().any(|(magic, ..)| head.starts_with(&magic.to_be_bytes()))
}

/// Header fields that are used.
struct Header {
    /// Number of columns and rows of the phases.
    size: [usize; 2],
    /// First byte of the phases.
    begin: usize,
    scale: f64,
    wavelength_m: f64,
    obliquity: f64,
    pitch_m: f64,
    resolution: u16,
}

impl Header {
    fn read(path: &Path, bytes: &[u8]) -> Result<Self, FormatError> {
        let unexpected = |place: &str, expected: &str, found: String| FormatError::Unexpected {
            path: path.to_owned(),
            place: place.to_owned(),
            expected: expected.to_owned(),
            found,
        };
        let Some(head) = bytes.get(..MIN_HEADER) else {
            let expected = format!("a header of {MIN_HEADER} bytes");
            return Err(FormatError::Cut { path: path.to_owned(), place: format!("byte {}", bytes.len()), expected });
        };
        let half = |at: usize| u16::from_be_bytes([head[at], head[at + 1]]);
        let word = |at: usize| u32::from_be_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
        let real = |at: usize| f64::from(f32::from_bits(word(at)));
        let kind = (word(0), half(4), word(6));
        if !HEADERS.contains(&kind) {
            let found = format!("{:08x}, {}, {}", kind.0, kind.1, kind.2);
            let expected = "magic number, format and length of a MetroPro header (881b036f, 1, 834 or its like)";
            return Err(unexpected("bytes 0 to 9", expected, found));
        }
        let (size, phase_bytes) = ([half(68), half(70)], word(72));
        if phase_bytes == 0 {
            return Err(FormatError::NoData { path: path.to_owned(), expected: "phases" });
        }
        let [columns, rows] = size.map(u64::from);
        check_size(path, columns, rows)?;
        if u64::from(phase_bytes) != 4 * columns * rows {
            let expected = format!("{} bytes of phases, as {columns} times {rows} samples have", 4 * columns * rows);
            return Err(unexpected("bytes 68 to 75", &expected, phase_bytes.to_string()));
        }
        Ok(Self {
            size: size.map(usize::from),
            begin: kind.2 as usize + word(60) as usize,
            scale: real(164),
            wavelength_m: real(168),
            obliquity: real(176),
            pitch_m: real(184),
            resolution: half(218),
        })
    }

    /// Returns the height, in millimetres, of one unit of the phase values.
    ///
    /// # Errors
    /// An unknown phase resolution; a scale factor, wavelength or obliquity factor that is 0 or not finite.
    fn unit_mm(&self, path: &Path) -> Result<f64, FormatError> {
        let unexpected = |place: &str, expected: &str, found: String| FormatError::Unexpected {
            path: path.to_owned(),
            place: place.to_owned(),
            expected: expected.to_owned(),
            found,
        };
        let steps = match self.resolution {
            0 => 4096.0,
            1 => 32768.0,
            2 => 131_072.0,
            other => return Err(unexpected("byte 218", "a phase resolution of 0, 1 or 2", other.to_string())),
        };
        let factors = [
            ("byte 164", "interferometric scale factor", self.scale),
            ("byte 168", "wavelength in metres", self.wavelength_m),
            ("byte 176", "obliquity factor", self.obliquity),
        ];
        for (place, what, value) in factors {
            if value == 0.0 || !value.is_finite() {
                return Err(unexpected(place, &format!("the {what}, not 0"), value.to_string()));
            }
        }
        Ok(1e3 * self.scale * self.obliquity * self.wavelength_m / steps)
    }
}
