//! Formats of measured maps that are detected by their first bytes.

use std::path::Path;

use regrind_core::geometry::Point;

use super::error::FormatError;
use super::height_map::MapFormat;
use super::maps::{alicona, bruker, codev_interferogram, digital_surf, hdf5, wyko, wyko_ascii, zygo_xyz};
use super::{metropro, sdf, whole, x3p};

/// All formats of maps. A new format needs its own source file and an entry here.
const FORMATS: [MapFormat; 11] = [
    x3p::FORMAT,
    sdf::FORMAT,
    metropro::FORMAT,
    digital_surf::FORMAT,
    wyko::FORMAT,
    wyko_ascii::FORMAT,
    bruker::FORMAT,
    zygo_xyz::FORMAT,
    hdf5::FORMAT,
    alicona::FORMAT,
    codev_interferogram::FORMAT,
];

/// Detects the format of a measured map from `head`, the first bytes of a file. Returns `None`
/// for any other file.
pub(super) fn map_format(head: &[u8]) -> Option<&'static MapFormat> {
    FORMATS.iter().find(|format| (format.begins)(head))
}

/// Parses the content of a map of any format. Returns its measured samples as points in millimetres. `path` only names
/// the file in messages. `sample_spacing_mm` is the distance of the samples along x and y for a map that does not state
/// it.
///
/// # Errors
/// Bytes of no known format, or that are not valid; heights that look like marks of samples that were not measured; a
/// distance of the samples that is neither stated nor given, or both.
pub fn parse_map(path: &Path, bytes: &[u8], sample_spacing_mm: Option<f64>) -> Result<Vec<Point>, FormatError> {
    let Some(format) = map_format(bytes) else {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "map of a known format" });
    };
    format.parse_points(path, bytes, sample_spacing_mm).map(|map| map.points)
}

/// Returns true if a file is a map of heights, judged by its first bytes.
///
/// # Errors
/// A file that cannot be read.
pub fn is_map(path: impl AsRef<Path>) -> Result<bool, FormatError> {
    Ok(map_format(&whole::open(path.as_ref())?.head).is_some())
}
