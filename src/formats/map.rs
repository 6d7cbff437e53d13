//! Maps over x and y of the model frame as text: what was found, and what the grinder was asked for.

use std::path::Path;

use super::error::FormatError;
use super::gcode::hex;
use super::registration::write_rows;
use regrind_core::compensation::{Correction, ErrorMap};

/// What an error was measured on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ErrorMapOrigin {
    /// SHA-256 of the part's nominal surface.
    pub part: [u8; 32],
    /// The cycle that measured it.
    pub cycle: u32,
    /// SHA-256 of the map of the pass before, as the grinder got it; `None` where that was 0 everywhere.
    pub ground_with: Option<[u8; 32]>,
}

/// Writes `error_map.csv`: `x_mm,y_mm,error_mm,sigma_mm,valid`, a row per node, row by row with x fastest.
///
/// Positive stands proud; `sigma_mm` is the standard uncertainty that the scatter of the points leaves in the error, 0 where
/// that is not known. Where `valid` is 0 nothing was measured and the values are those of the nearest node with some. Comments tell what was
/// measured.
///
/// # Errors
/// Those of [`super::write_deviations`].
pub fn write_error_map(
    path: &Path,
    map: &ErrorMap,
    origin: &ErrorMapOrigin,
    simulation: bool,
) -> Result<(), FormatError> {
    let rows: Vec<([f64; 4], bool)> = (0..map.grid.len())
        .map(|k| (map.grid.place_mm(k), k))
        .map(|([x, y], k)| ([x, y, map.values_mm[k], map.sigma_mm[k]], map.valid[k]))
        .collect();
    let marked = if simulation { "# SIMULATION\n" } else { "" };
    let ground = match &origin.ground_with {
        Some(identity) => format!("with: sha256 {}", hex(identity)),
        None => "without a correction".into(),
    };
    let header = format!(
        "{marked}# part: sha256 {}\n# cycle: {}\n# the pass before was ground {ground}\n# frame: model; positive stands proud, along the outward \
         normal\nx_mm,y_mm,error_mm,sigma_mm,valid",
        hex(&origin.part),
        origin.cycle
    );
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
    let rows: Vec<[f64; 3]> = (0..correction.grid.len())
        .map(|k| (correction.grid.place_mm(k), correction.values_mm[k]))
        .map(|([x, y], value)| [x, y, value])
        .collect();
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
