//! Maps over x and y of the model frame as text: what was found, and what the grinder was asked for.

use std::path::Path;

use super::error::FormatError;
use super::registration::write_rows;
use crate::compensation::{Correction, ErrorMap};

/// Writes `error_map.csv`: `x_mm,y_mm,error_mm,valid`, a row per node, row by row with x fastest.
///
/// Positive stands proud. Where `valid` is 0 nothing was measured and the value is that of the nearest node with one.
///
/// # Errors
/// Those of [`super::write_deviations`].
pub fn write_error_map(path: &Path, map: &ErrorMap, simulation: bool) -> Result<(), FormatError> {
    let rows: Vec<([f64; 3], bool)> = (0..map.net.len())
        .map(|k| (map.net.place_mm(k), k))
        .map(|([x, y], k)| ([x, y, map.values_mm[k]], map.valid[k]))
        .collect();
    let marked = if simulation { "# SIMULATION\n" } else { "" };
    let header =
        format!("{marked}# frame: model; positive stands proud, along the outward normal\nx_mm,y_mm,error_mm,valid");
    write_rows(path, &header, &rows, |(values, valid)| (*values, Some(*valid)))
}

/// What a correction is for, what it is, and what it takes the place of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CorrectionIdentities {
    /// SHA-256 of the part's nominal surface.
    pub part: [u8; 32],
    /// SHA-256 of the map as the grinder gets it.
    pub map: [u8; 32],
    /// That of the map of the pass before.
    pub replaces: [u8; 32],
}

/// Writes `correction.csv`: `x_mm,y_mm,correction_mm`, with part, cycle, level and identities in comments.
///
/// # Errors
/// Those of [`super::write_deviations`].
pub fn write_correction(
    path: &Path,
    correction: &Correction,
    identities: &CorrectionIdentities,
    simulation: bool,
) -> Result<(), FormatError> {
    let rows: Vec<[f64; 3]> = (0..correction.net.len())
        .map(|k| (correction.net.place_mm(k), correction.values_mm[k]))
        .map(|([x, y], value)| [x, y, value])
        .collect();
    let hex = |bytes: &[u8; 32]| bytes.iter().map(|b| format!("{b:02x}")).collect::<String>();
    let marked = if simulation { "# SIMULATION\n" } else { "" };
    let header = format!(
        "{marked}# for pass {}; absolute: it replaces the one before\n# frame: model; positive leaves material, along the outward normal\n# level over the \
         nominal surface: {} mm\n# part: sha256 {}\n# map: sha256 {}\n# replaces: sha256 {}\nx_mm,y_mm,correction_mm",
        correction.cycle,
        correction.level_mm,
        hex(&identities.part),
        hex(&identities.map),
        hex(&identities.replaces)
    );
    write_rows(path, &header, &rows, |values| (*values, None))
}
