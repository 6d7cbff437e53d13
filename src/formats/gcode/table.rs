//! The table for controllers that compensate by one: an offset of Z over X and Y.

use std::path::Path;

use super::hex;
use crate::FormatError;
use crate::registration::write_rows;
use regrind_core::geometry::Grid;

/// Writes `toolpath_z.csv`: `x_mm,y_mm,dz_mm`, a row per node, row by row with x fastest.
///
/// x and y are where the axes have the wheel's centre; dz is added to Z. It corrects a program of the nominal surface at the same level: sag
/// compensation over two axes, levelling meshes. A program that holds the correction already must not be given the table too.
///
/// # Errors
/// Those of [`crate::write_deviations`].
pub fn write_axis_table(
    path: &Path,
    grid: &Grid,
    offsets_mm: &[f64],
    map_identity: &[u8; 32],
    simulation: bool,
) -> Result<(), FormatError> {
    let rows: Vec<[f64; 3]> =
        offsets_mm.iter().enumerate().map(|(k, dz)| (grid.place_mm(k), *dz)).map(|([x, y], dz)| [x, y, dz]).collect();
    let marked = if simulation { "# SIMULATION\n" } else { "" };
    let header = format!(
        "{marked}# offset of Z over the places of the axes X and Y, for the program of the nominal surface alone; toolpath.ngc holds it already\n# map: \
         sha256 {}\nx_mm,y_mm,dz_mm",
        hex(map_identity)
    );
    write_rows(path, &header, &rows, |values| (*values, None))
}
