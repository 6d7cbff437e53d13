//! Table for controllers that compensate by a table: an offset of Z over X and Y.

use std::path::Path;

use data_encoding::HEXLOWER;

use crate::FormatError;
use crate::registration::write_rows;
use regrind_core::geometry::Grid;

/// Writes a table of offsets for axis Z to the CSV file `path` (`toolpath_z.csv`). The columns are `x_mm,y_mm,dz_mm`.
/// The table has one row per node of `grid`, row by row with x fastest. `offsets_mm` holds dz of each node in this
/// order. The header states `map_identity`, the SHA-256 of the map. If `simulation` is true, the header marks the file
/// as simulated.
///
/// x and y are the positions of the wheel's centre on the machine axes. The controller adds dz to Z, as in sag
/// compensation over two axes or with levelling meshes. The table corrects a program of the nominal surface at the same
/// level. Do not use the table with a program that already contains the correction.
///
/// # Errors
/// The same as for [`crate::write_deviations`].
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
        HEXLOWER.encode(map_identity)
    );
    write_rows(path, &header, &rows, |values| (*values, None))
}
