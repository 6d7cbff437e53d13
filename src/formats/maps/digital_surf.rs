//! Maps of Digital Surf (`.sur`), as MountainsMap writes them: little-endian, plain or compressed.
//!
//! A header of 512 bytes, a comment, private data, and the heights as integers row by row, the top row first. The height
//! is (raw * step + offset) in the unit of the step. If the header says so, Zmin - 2 marks samples that were not measured.

use std::io::Read;
use std::path::Path;

use super::super::error::FormatError;
use super::super::height_map::{HeightMap, MapFormat, check_size};
use super::{Bytes, checked_factor, length_mm, map_from_top};

/// Places of the steps along x, y and z.
const STEPS: [&str; 3] = ["step of x (byte 120)", "step of y (byte 124)", "step of z (byte 128)"];

const HEADER: usize = 512;
const PLAIN: &[u8] = b"DIGITAL SURF";
const COMPRESSED: &[u8] = b"DSCOMPRESSED";

/// Format of Digital Surf, detected by its first bytes.
pub(in super::super) const FORMAT: MapFormat = MapFormat {
    begins: |head| head.starts_with(PLAIN) || head.starts_with(COMPRESSED),
    parse: |path, bytes, given_mm| parse_digital_surf(path, bytes, given_mm).map(Into::into),
};

/// Parses the first object of a file.
fn parse_digital_surf(path: &Path, bytes: &[u8], given_mm: Option<f64>) -> Result<HeightMap, FormatError> {
    let file = Bytes { path, bytes };
    let must = |at: usize, name: &str, allowed: &[i16]| -> Result<i16, FormatError> {
        let found = file.i16(at)?;
        let words: Vec<String> = allowed.iter().map(ToString::to_string).collect();
        if allowed.contains(&found) {
            Ok(found)
        } else {
            Err(file.unexpected(name, &words.join(" or "), found.to_string()))
        }
    };
    file.slice(0, HEADER)?;
    must(12, "byte order (byte 12)", &[0])?;
    // Surfaces, also those with an intensity or a picture behind the heights.
    must(18, "type of the object (byte 18)", &[1, 2, 11, 13, 16])?;
    let has_marks = must(86, "special points (byte 86)", &[0, 1])? == 1;
    let bits = must(98, "bits of a height (byte 98)", &[16, 32])?;
    must(290, "inversion (byte 290)", &[0])?;
    if file.i32(94)? > 1 {
        return Err(file.unexpected("spectral points (byte 94)", "0 or 1", file.i32(94)?.to_string()));
    }
    let [columns, rows] = [file.i32(108)?, file.i32(112)?].map(|count| usize::try_from(count).unwrap_or(0));
    check_size(path, columns as u64, rows as u64)?;
    let [zmin, zmax] = [file.i32(100)?, file.i32(104)?];
    let mut units = [0.0; 3];
    let mut steps_mm = [0.0; 3];
    for k in 0..3 {
        let unit = unit(file.slice(180 + 16 * k, 16)?);
        units[k] =
            length_mm(&unit).ok_or_else(|| file.unexpected("unit of a step (byte 180)", "a unit of length", unit))?;
        let step = f64::from(file.f32(120 + 4 * k)?);
        steps_mm[k] = units[k] * checked_factor(path, STEPS[k], "a step", step)?;
    }
    let offset_mm = f64::from(file.f32(474)?) * units[2];
    if !offset_mm.is_finite() {
        return Err(file.unexpected("offset of z (byte 474)", "a finite number", file.f32(474)?.to_string()));
    }
    let begin = HEADER + usize::from(file.u16(334)?) + usize::from(file.u16(336)?);
    let length = columns * rows * usize::from(bits.unsigned_abs()) / 8;
    let unpacked;
    let heights = if bytes.starts_with(COMPRESSED) {
        unpacked = unpack(&file, begin, length)?;
        &unpacked[..]
    } else {
        file.slice(begin, length)?
    };
    let values = Bytes { path, bytes: heights };
    let height = |index: usize| {
        let raw = if bits == 16 { values.i16(2 * index).map(i32::from).ok()? } else { values.i32(4 * index).ok()? };
        // Saturated samples are beyond the range too.
        let is_mark = has_marks && (raw < zmin || raw > zmax);
        (!is_mark).then(|| f64::from(raw) * steps_mm[2] + offset_mm)
    };
    map_from_top(path, [columns, rows], ([steps_mm[0], steps_mm[1]], given_mm), height)
}

/// Decodes a unit: Latin-1, the code page 437 or UTF-8.
fn unit(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|&b| b == 0).unwrap_or(bytes.len());
    let text = match std::str::from_utf8(&bytes[..end]) {
        Ok(text) => text.to_owned(),
        Err(_) => bytes[..end].iter().map(|&b| if b == 0xe6 { 'µ' } else { b as char }).collect(),
    };
    text.trim().to_owned()
}

/// Unpacks the streams of the heights.
fn unpack(file: &Bytes<'_>, begin: usize, length: usize) -> Result<Vec<u8>, FormatError> {
    const MAX_STREAMS: u32 = 4096;
    let count = file.u32(begin)?;
    if count == 0 || count > MAX_STREAMS {
        return Err(file.unexpected("packed streams", "1 to 4096", count.to_string()));
    }
    let mut at = begin + 4 + 8 * count as usize;
    let mut heights = Vec::new();
    for stream in 0..count as usize {
        let size = file.u32(begin + 8 + 8 * stream)? as usize;
        let packed = file.slice(at, size)?;
        let room = (length + 1).saturating_sub(heights.len()) as u64;
        let read = flate2::read::ZlibDecoder::new(packed).take(room).read_to_end(&mut heights);
        read.map_err(|error| file.unexpected("packed heights", "a stream of zlib", error.to_string()))?;
        at += size;
    }
    if heights.len() == length {
        return Ok(heights);
    }
    Err(file.unexpected("packed heights", &format!("{length} bytes"), format!("{} bytes", heights.len())))
}
