//! The formats of measured maps that are told by their first bytes.

use std::path::Path;

use super::error::FormatError;
use super::height_map::MapFormat;
use super::{metropro, sdf, whole, x3p};

/// Every format: another one is a file of its own and a line here.
const FORMATS: [MapFormat; 3] = [x3p::FORMAT, sdf::FORMAT, metropro::FORMAT];

/// Tells the format by the first bytes; none where it is no map.
pub(super) fn map_format(head: &[u8]) -> Option<&'static MapFormat> {
    FORMATS.iter().find(|format| (format.begins)(head))
}

/// Returns whether a file is a map of heights, whose points lie on the surface: X3P, SDF or MetroPro.
///
/// # Errors
/// A file that cannot be read.
pub fn is_map(path: impl AsRef<Path>) -> Result<bool, FormatError> {
    Ok(map_format(&whole::open(path.as_ref())?.head).is_some())
}
