//! Maps over x and y of the model frame as text: the measured error, and the correction for the grinder.

use std::path::Path;

use data_encoding::HEXLOWER;

use super::error::FormatError;
use super::registration::write_rows;
use regrind_core::compensation::{Correction, ErrorMap};

/// Columns of `error_map.csv`.
const ERROR_MAP_COLUMNS: &str = "x_mm,y_mm,error_mm,sigma_mm,valid";

/// Origin of a measured error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ErrorMapOrigin {
    /// SHA-256 of the part's nominal surface.
    pub part: [u8; 32],
    /// Cycle in which it was measured.
    pub cycle: u32,
    /// SHA-256 of the map of the previous pass, as sent to the grinder; `None` if that map was 0 everywhere.
    pub ground_with: Option<[u8; 32]>,
}

/// Writes `map`, the measured error on a grid, to `path` (`error_map.csv`). The columns are
/// `x_mm,y_mm,error_mm,sigma_mm,valid`, in the model frame. There is one row for each node of the grid; x changes
/// fastest.
///
/// A positive error means that material stands above the nominal surface. `sigma_mm` is the standard uncertainty of the
/// error due to the noise of the points, 0 if unknown. If `valid` is 0, nothing was measured at the node, and its
/// values are those of the nearest measured node. Comments above the columns give `origin` (the part, the cycle and the
/// previous correction), and `SIMULATION` if `simulation` is true.
///
/// # Errors
/// The same as for [`super::write_deviations`].
pub fn write_error_map(
    path: &Path,
    map: &ErrorMap,
    origin: &ErrorMapOrigin,
    simulation: bool,
) -> Result<(), FormatError> {
    let nodes = &map.nodes;
    let rows: Vec<([f64; 4], bool)> = (0..nodes.grid.len())
        .map(|k| (nodes.grid.place_mm(k), k))
        .map(|([x, y], k)| ([x, y, nodes.values_mm[k], map.sigma_mm[k]], nodes.valid[k]))
        .collect();
    let marked = if simulation { "# SIMULATION\n" } else { "" };
    let ground = match &origin.ground_with {
        Some(identity) => format!("with: sha256 {}", HEXLOWER.encode(identity)),
        None => "without a correction".into(),
    };
    let header = format!(
        "{marked}# part: sha256 {}\n# cycle: {}\n# the pass before was ground {ground}\n# frame: model; positive stands proud, along the outward \
         normal\n{ERROR_MAP_COLUMNS}",
        HEXLOWER.encode(&origin.part),
        origin.cycle
    );
    write_rows(path, &header, &rows, |(values, valid)| (*values, Some(*valid)))
}

/// Measured node of an error map, in the model frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapNode {
    /// Position of the node.
    pub at_mm: [f64; 2],
    /// Error; positive is proud.
    pub error_mm: f64,
    /// Standard uncertainty of the error, 0 if unknown.
    pub sigma_mm: f64,
}

impl MapNode {
    /// Returns x, y and the error of the node, in millimetres.
    pub fn error(&self) -> [f64; 3] {
        [self.at_mm[0], self.at_mm[1], self.error_mm]
    }

    /// Returns x, y and the standard uncertainty of the error of the node, in millimetres.
    pub fn sigma(&self) -> [f64; 3] {
        [self.at_mm[0], self.at_mm[1], self.sigma_mm]
    }
}

/// Reads an error map from the file `path`, which [`write_error_map`] wrote. Returns the measured nodes in the order of
/// the file. Nodes that were not measured are omitted.
///
/// # Errors
/// A file that cannot be read, or that does not have the columns of an error map; a row that is not finite numbers.
pub fn read_error_map(path: &Path) -> Result<Vec<MapNode>, FormatError> {
    let unreadable = |source| FormatError::Unreadable { path: path.to_owned(), source };
    parse_error_map(path, &std::fs::read_to_string(path).map_err(unreadable)?)
}

/// Parses an error map from `text`, the content of a file that [`write_error_map`] wrote. Returns the measured nodes in
/// the order of the file. Nodes that were not measured are omitted. `path` only names the file in messages.
///
/// # Errors
/// A text that does not have the columns of an error map; a row that is not finite numbers.
pub fn parse_error_map(path: &Path, text: &str) -> Result<Vec<MapNode>, FormatError> {
    let mut lines = text.lines().zip(1..).filter(|(line, _)| !line.starts_with('#') && !line.trim().is_empty());
    let unexpected = |found: &str, line: u64, expected: &str| FormatError::Unexpected {
        path: path.to_owned(),
        place: format!("line {line}"),
        expected: expected.to_owned(),
        found: found.to_owned(),
    };
    match lines.next() {
        Some((ERROR_MAP_COLUMNS, _)) => {}
        Some((other, line)) => return Err(unexpected(other, line, ERROR_MAP_COLUMNS)),
        None => return Err(FormatError::Empty { path: path.to_owned(), expected: "a map" }),
    }
    let mut nodes = Vec::new();
    for (text, line) in lines {
        let node = node(text).ok_or_else(|| unexpected(text, line, "a node of a map"))?;
        nodes.extend(node);
    }
    Ok(nodes)
}

/// Parses a row of an error map. Returns `Some(None)` for a node that was not measured, and `None` for an invalid row.
fn node(row: &str) -> Option<Option<MapNode>> {
    let cells: Vec<&str> = row.split(',').map(str::trim).collect();
    let [x, y, error, sigma, valid] = cells[..] else { return None };
    let number = |text: &str| text.parse::<f64>().ok().filter(|value| value.is_finite());
    let node = MapNode { at_mm: [number(x)?, number(y)?], error_mm: number(error)?, sigma_mm: number(sigma)? };
    match valid {
        "1" => Some(Some(node)),
        "0" => Some(None),
        _ => None,
    }
}

/// Part, identity and predecessor of a correction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CorrectionIdentities {
    /// SHA-256 of the part's nominal surface.
    pub part: [u8; 32],
    /// SHA-256 of the map as sent to the grinder.
    pub map: [u8; 32],
    /// SHA-256 of the map of the previous pass.
    pub replaces: [u8; 32],
}

/// Writes `correction` to `path` (`correction.csv`), as the map that is sent to the grinder. The columns are
/// `x_mm,y_mm,correction_mm`, in the model frame. A positive correction leaves material.
///
/// Comments above the columns give the number of the pass and the height of the target surface above the nominal
/// surface. They also give `identities`: the SHA-256 of the part, of this map and of the previous map. Each text in
/// `parameters` is written as one further comment. Such a text describes a machine parameter (such as the wheel radius)
/// that is corrected in addition to the map. The comment `SIMULATION` is written if `simulation` is true.
///
/// # Errors
/// The same as for [`super::write_deviations`].
pub fn write_correction(
    path: &Path,
    correction: &Correction,
    (identities, parameters): (&CorrectionIdentities, &[String]),
    simulation: bool,
) -> Result<(), FormatError> {
    let map_mm = correction.map_mm();
    let rows: Vec<[f64; 3]> = (0..correction.grid.len())
        .map(|k| (correction.grid.place_mm(k), map_mm[k]))
        .map(|([x, y], value)| [x, y, value])
        .collect();
    let taken: String = parameters.iter().map(|taken| format!("# parameter: {taken}\n")).collect();
    let marked = if simulation { "# SIMULATION\n" } else { "" };
    let header = format!(
        "{marked}# for pass {}; absolute: it replaces the one before\n# frame: model; positive leaves material, along the outward normal\n# level over the \
         nominal surface: {} mm\n# part: sha256 {}\n# map: sha256 {}\n# replaces: sha256 {}\n{taken}x_mm,y_mm,correction_mm",
        correction.cycle,
        correction.level_mm,
        HEXLOWER.encode(&identities.part),
        HEXLOWER.encode(&identities.map),
        HEXLOWER.encode(&identities.replaces)
    );
    write_rows(path, &header, &rows, |values| (*values, None))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn error_map_read_skips_unmeasured() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("error_map.csv");
        let read = |text: &str| {
            std::fs::write(&path, text).unwrap();
            read_error_map(&path)
        };
        let whole = format!(
            "# SIMULATION\n# cycle: 2\n{ERROR_MAP_COLUMNS}\n-1.5,2,0.001,0.0002,1\n0,2,7,0,0\n1.5,2,-3e-4,0,1\n"
        );
        let nodes = read(&whole).unwrap();
        assert_eq!(nodes.iter().map(MapNode::error).collect::<Vec<_>>(), [[-1.5, 2.0, 0.001], [1.5, 2.0, -3e-4]]);
        assert_eq!(nodes.iter().map(MapNode::sigma).collect::<Vec<_>>(), [[-1.5, 2.0, 0.0002], [1.5, 2.0, 0.0]]);
        assert_eq!(read(&format!("{ERROR_MAP_COLUMNS}\n")).unwrap(), []);
        for (from, to, place) in [
            ("error_mm", "height_mm", "line 3"),
            ("0.001,", "NaN,", "line 4"),
            ("0.0002,", "", "line 4"),
            ("7,0,0", "7,0,2", "line 5"),
            ("-3e-4", "inf", "line 6"),
        ] {
            let message = read(&whole.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(message.contains(place), "{to}: {message}");
        }
        assert!(matches!(read("# nothing\n"), Err(FormatError::Empty { .. })));
        assert!(matches!(read_error_map(&folder.path().join("none")), Err(FormatError::Unreadable { .. })));
    }
}
