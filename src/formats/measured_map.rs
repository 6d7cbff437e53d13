//! Formats of measured maps that are detected by their first bytes.

use std::path::Path;

use super::error::FormatError;
use super::height_map::MapFormat;
use super::{metropro, sdf, whole, x3p};

/// All formats of maps. A new format needs its own source file and an entry here.
const FORMATS: [MapFormat; 3] = [x3p::FORMAT, sdf::FORMAT, metropro::FORMAT];

/// Detects the format of a measured map (X3P, SDF or MetroPro) from `head`, the first bytes of a file. Returns `None`
/// for any other file.
pub(super) fn map_format(head: &[u8]) -> Option<&'static MapFormat> {
    FORMATS.iter().find(|format| (format.begins)(head))
}

/// Returns true if a file is a map of heights (X3P, SDF or MetroPro), judged by its first bytes.
///
/// # Errors
/// A file that cannot be read.
pub fn is_map(path: impl AsRef<Path>) -> Result<bool, FormatError> {
    Ok(map_format(&whole::open(path.as_ref())?.head).is_some())
}
