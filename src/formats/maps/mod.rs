//! Maps of heights in the files of instruments: Digital Surf, Wyko, Bruker, Zygo Mx, 4D, Alicona and Code V.
//!
//! Each file has a format; [`super::measured_map`] lists all formats of maps. Rows of a map go from the bottom up; most
//! instruments write the top row first.

pub(super) mod alicona;
pub(super) mod bruker;
pub(super) mod codev_interferogram;
pub(super) mod digital_surf;
pub(super) mod hdf5;
mod hdf5_value;
pub(super) mod wyko;
pub(super) mod wyko_ascii;
pub(super) mod zygo_xyz;

use std::path::Path;

use regrind_core::geometry::Grid;

use super::error::{FormatError, excerpt};
use super::height_map::{HeightMap, check_size, sample_spacing_mm};

/// Bytes of a file, little-endian, with its path for messages.
#[derive(Clone, Copy)]
struct Bytes<'a> {
    path: &'a Path,
    bytes: &'a [u8],
}

impl<'a> Bytes<'a> {
    /// Returns `length` bytes from `at` on.
    fn slice(&self, at: usize, length: usize) -> Result<&'a [u8], FormatError> {
        let end = at.checked_add(length);
        end.and_then(|end| self.bytes.get(at..end)).ok_or_else(|| FormatError::Cut {
            path: self.path.to_owned(),
            place: format!("byte {}", self.bytes.len()),
            expected: format!("{length} bytes from byte {at} on"),
        })
    }

    fn array<const N: usize>(&self, at: usize) -> Result<[u8; N], FormatError> {
        self.slice(at, N).map(|slice| std::array::from_fn(|k| slice[k]))
    }

    fn u16(&self, at: usize) -> Result<u16, FormatError> {
        self.array(at).map(u16::from_le_bytes)
    }

    fn i16(&self, at: usize) -> Result<i16, FormatError> {
        self.array(at).map(i16::from_le_bytes)
    }

    fn u32(&self, at: usize) -> Result<u32, FormatError> {
        self.array(at).map(u32::from_le_bytes)
    }

    fn i32(&self, at: usize) -> Result<i32, FormatError> {
        self.array(at).map(i32::from_le_bytes)
    }

    fn f32(&self, at: usize) -> Result<f32, FormatError> {
        self.array(at).map(f32::from_le_bytes)
    }

    fn f64(&self, at: usize) -> Result<f64, FormatError> {
        self.array(at).map(f64::from_le_bytes)
    }

    fn unexpected(&self, place: &str, expected: &str, found: impl Into<String>) -> FormatError {
        unexpected(self.path, place, expected, found)
    }
}

/// Magnitude from which on a height of 32 bits is a mark: programs write 1e38 in 32 bits, which is less than 1e38.
const MARK: f64 = 9e37;

/// Wavelengths of light, in nm, that a map can have been measured with.
const WAVELENGTHS_NM: std::ops::RangeInclusive<f64> = 100.0..=20_000.0;

/// Returns a wavelength in nm if it is one of light. `place` is for the message.
fn checked_wavelength_nm(path: &Path, place: &str, wavelength_nm: f64) -> Result<f64, FormatError> {
    if WAVELENGTHS_NM.contains(&wavelength_nm) {
        return Ok(wavelength_nm);
    }
    Err(unexpected(path, place, "a wavelength of light, from 100 to 20,000 nm", format!("{wavelength_nm} nm")))
}

fn unexpected(path: &Path, place: &str, expected: &str, found: impl Into<String>) -> FormatError {
    FormatError::Unexpected {
        path: path.to_owned(),
        place: place.to_owned(),
        expected: expected.to_owned(),
        found: excerpt(found.into().as_bytes()),
    }
}

/// Returns `factor` if it is finite and above 0. `place` and `expected` are for the message.
fn checked_factor(path: &Path, place: &str, expected: &str, factor: f64) -> Result<f64, FormatError> {
    if factor > 0.0 && factor.is_finite() {
        return Ok(factor);
    }
    Err(unexpected(path, place, &format!("{expected} that is finite and above 0"), factor.to_string()))
}

/// Returns the number of mm in a unit of length as instruments write it; `None` for another unit.
fn length_mm(unit: &str) -> Option<f64> {
    Some(match unit.trim_matches(['\0', ' ']) {
        "m" | "Meters" => 1e3,
        "cm" => 10.0,
        "mm" | "MilliMeters" => 1.0,
        "µm" | "μm" | "um" | "MicroMeters" => 1e-3,
        "nm" | "NanoMeters" => 1e-6,
        "pm" => 1e-9,
        "Å" | "A" | "Angstroms" => 1e-7,
        "in" | "in." | "inch" => 25.4,
        _ => return None,
    })
}

/// Creates the map from rows that go from the top down. The distances of its samples are those that the file states, or
/// the one that a person gives, as in [`sample_spacing_mm`].
fn map_from_top(
    path: &Path,
    [columns, rows]: [usize; 2],
    (stated_mm, given_mm): ([f64; 2], Option<f64>),
    height: impl Fn(usize) -> Option<f64>,
) -> Result<HeightMap, FormatError> {
    check_size(path, columns as u64, rows as u64)?;
    let spacing_mm = sample_spacing_mm(path, stated_mm, given_mm)?;
    let samples = (0..rows).rev().flat_map(|row| (0..columns).map(move |column| row * columns + column)).map(height);
    HeightMap::new(path, Grid { columns, rows, first_mm: [0.0; 2], spacing_mm }, samples)
}
