//! Maps over x and y for the correction of a program: `error_map.csv` or `correction.csv`.

use std::io::{BufRead, BufReader, Read as _};
use std::path::Path;

use data_encoding::HEXLOWER_PERMISSIVE;
use sha2::{Digest, Sha256};

use super::GcodeError;
use crate::FormatError;
use regrind_core::geometry::grid_recognition::NO_POINT;
use regrind_core::geometry::{Grid, GridMap, Point, recognise_grid};

/// Largest map that is read, in bytes.
const MAX_BYTES: u64 = 512 << 20;

/// Meaning of the values of a map.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MapKind {
    /// Error of the part: positive is proud, and is ground off.
    Error,
    /// Correction of the surface: positive leaves material.
    Correction,
}

/// Correction that a program must already contain before the map is applied to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MapBase {
    /// No correction: the map is absolute and replaces any previous one.
    Nothing,
    /// This map: the error was measured after a pass that was ground with it.
    Map([u8; 32]),
    /// Any correction: the map does not state after which pass it was measured.
    Anything,
}

/// Map as read from its file.
#[derive(Clone, Debug, PartialEq)]
pub struct ProgramMap {
    /// Values. A node is valid if it has enough measured points around it, or if the file does not state it.
    pub nodes: GridMap,
    /// Meaning of the values.
    pub kind: MapKind,
    /// Identity that the map states, or else the SHA-256 of the file.
    pub identity: [u8; 32],
    /// Part that the map belongs to, if it states one.
    pub part: Option<[u8; 32]>,
    /// Correction that the program must already contain.
    pub base: MapBase,
    /// True if the map comes from a simulated cell.
    pub simulation: bool,
}

/// Reads a map of errors or corrections from a CSV file. The header begins with `x_mm,y_mm,error_mm` or
/// `x_mm,y_mm,correction_mm`, and more columns can follow. The file has one row for every node of a regular grid.
///
/// A 0 in the optional column `valid` marks a node with too few measured points around it. If Regrind wrote the map,
/// the extrapolated value of such a node is used. In a map of another program, such a node receives the value of the
/// nearest valid node.
///
/// Comment lines (`#`) can state `part: sha256 ...`, `map: sha256 ...`, `ground with: sha256 ...` and `SIMULATION`.
///
/// # Errors
/// A file that cannot be read or is too large; other columns; rows that are not numbers; nodes that do not form a
/// complete grid; a map without a valid node.
pub fn read_program_map(path: &Path) -> Result<ProgramMap, GcodeError> {
    let unreadable = |source| GcodeError::File(FormatError::Unreadable { path: path.to_owned(), source });
    let file = crate::system::open_to_read(path).map_err(unreadable)?;
    let mut reader = BufReader::new(file.take(MAX_BYTES + 1));
    let (mut lines, mut line, mut number, mut bytes) = (MapLines::default(), Vec::new(), 0u64, 0u64);
    loop {
        line.clear();
        // A file without lines is not read into one.
        let taken = (&mut reader).take(4096).read_until(b'\n', &mut line).map_err(unreadable)?;
        if taken == 0 {
            return lines.into_map(path);
        }
        (number, bytes) = (number + 1, bytes + taken as u64);
        if bytes > MAX_BYTES {
            let (path, found, limit, unit) = (path.to_owned(), bytes, MAX_BYTES, "bytes");
            return Err(GcodeError::File(FormatError::TooLarge { path, found, limit, unit }));
        }
        lines.read_line(&line).map_err(|what| {
            let remedy = "give the error_map.csv or correction.csv of a run, or a file like it";
            GcodeError::Line { path: path.to_owned(), line: number, what, remedy }
        })?;
    }
}

/// Content of the lines of a map that were read so far.
#[derive(Default)]
struct MapLines {
    hash: Sha256,
    kind: Option<MapKind>,
    /// Index of the column that says whether a node is valid.
    valid_column: Option<usize>,
    nodes: Vec<Point>,
    valid: Vec<bool>,
    simulation: bool,
    part: Option<[u8; 32]>,
    /// Identity that the map states.
    stated: Option<[u8; 32]>,
    ground_with: Option<[u8; 32]>,
}

impl MapLines {
    /// Reads the next line of the map.
    ///
    /// # Errors
    /// The description of the fault of the line.
    fn read_line(&mut self, line: &[u8]) -> Result<(), String> {
        self.hash.update(line);
        let text = std::str::from_utf8(line).map_err(|_| "the line is not text")?.trim_start_matches('\u{feff}').trim();
        if let Some(comment) = text.strip_prefix('#') {
            self.simulation |= comment.trim() == "SIMULATION";
            self.part = self.part.or(identity_in(comment, "part:"));
            self.stated = self.stated.or(identity_in(comment, "map:"));
            self.ground_with = self.ground_with.or(identity_in(comment, "ground with:"));
        } else if !text.is_empty() && self.kind.is_none() {
            self.kind = Some(columns(text).ok_or_else(|| format!("the columns are {text:?}"))?);
            self.valid_column = text.split(',').position(|name| name.trim().eq_ignore_ascii_case("valid"));
        } else if !text.is_empty() {
            let cell = self.valid_column.map(|column| text.split(',').nth(column).map(str::trim));
            let valid = match cell.map(|cell| cell.unwrap_or_default().to_lowercase()).as_deref() {
                None | Some("1" | "1.0" | "true") => true,
                Some("0" | "0.0" | "false") => false,
                Some(other) => return Err(format!("the column `valid` has {other:?} instead of 1 or 0")),
            };
            self.nodes.push(node(text, valid).ok_or_else(|| format!("{text:?} is not a node of a map"))?);
            self.valid.push(valid);
        }
        Ok(())
    }

    /// Creates the map from all lines that were read. `path` only names the file in messages.
    ///
    /// # Errors
    /// Nodes that do not form a complete grid; no header; no valid node.
    fn into_map(self, path: &Path) -> Result<ProgramMap, GcodeError> {
        let remedy = "give a row for every node of a regular grid of at least three rows and three columns";
        let no_grid = |what: String| GcodeError::Program { path: path.to_owned(), what, remedy };
        let kind = self.kind.ok_or_else(|| no_grid("the map is empty".into()))?;
        let (grid, order) = grid(&self.nodes)
            .ok_or_else(|| no_grid(format!("its {} nodes are not a complete grid", self.nodes.len())))?;
        let mut values_mm: Vec<f64> = order.iter().map(|&point| self.nodes[point].z).collect();
        let valid: Vec<bool> = order.iter().map(|&point| self.valid[point]).collect();
        if !valid.contains(&true) {
            return Err(no_grid("none of its nodes is valid".into()));
        }
        // A map written by Regrind is levelled off already. In another map the value of an invalid node has no meaning.
        let is_ours = self.stated.is_some() || self.part.is_some();
        let is_known = |(value, valid): (&f64, &bool)| *valid || (is_ours && value.is_finite());
        let known: Vec<bool> = values_mm.iter().zip(&valid).map(is_known).collect();
        level_off(&mut values_mm, &known, grid.columns);
        Ok(ProgramMap {
            nodes: GridMap { grid, values_mm, valid },
            kind,
            identity: self.stated.unwrap_or_else(|| self.hash.finalize().into()),
            part: self.part,
            base: match (kind, self.ground_with) {
                (MapKind::Correction, _) => MapBase::Nothing,
                (MapKind::Error, Some(identity)) => MapBase::Map(identity),
                (MapKind::Error, None) => MapBase::Anything,
            },
            simulation: self.simulation,
        })
    }
}

fn columns(header: &str) -> Option<MapKind> {
    let mut names = header.split(',').map(str::trim);
    match (names.next()?, names.next()?, names.next()?) {
        ("x_mm", "y_mm", "error_mm") => Some(MapKind::Error),
        ("x_mm", "y_mm", "correction_mm") => Some(MapKind::Correction),
        _ => None,
    }
}

/// Reads the first three values of a CSV row, x, y and the value of the node, and returns them as a point in
/// millimetres. If `valid` is false, a third value that cannot be read becomes NaN.
///
/// Returns `None` if x or y, or the value of a valid node, is missing, is not a number, or is not below 1e7 mm in
/// magnitude.
fn node(row: &str, valid: bool) -> Option<Point> {
    let mut cells = row.split(',').map(|cell| cell.trim().parse::<f64>().ok().filter(|v| v.abs() < 1e7));
    Some(Point::new(cells.next()??, cells.next()??, cells.next()?.or((!valid).then_some(f64::NAN))?))
}

/// Returns the regular grid on which the points lie, and for each node of the grid the index of its point. Returns
/// `None` if the points do not form a complete grid.
fn grid(points: &[Point]) -> Option<(Grid, Vec<usize>)> {
    let order = recognise_grid(points)?;
    if order.point_indices.contains(&NO_POINT) {
        return None;
    }
    let at = |node: usize| points[order.point_indices[node] as usize];
    let (first, last) = (at(0), at(order.columns * order.rows - 1));
    let spacing_mm = [(last.x - first.x) / (order.columns - 1) as f64, (last.y - first.y) / (order.rows - 1) as f64];
    let grid = Grid { columns: order.columns, rows: order.rows, first_mm: [first.x, first.y], spacing_mm };
    Some((grid, (0..grid.len()).map(|k| order.point_indices[k] as usize).collect()))
}

/// Fills nodes without a known value. Each value that is not `known` is replaced by the value of the nearest known
/// node. The distance is the number of steps along rows and columns. The nodes are stored row by row, with `columns`
/// nodes in a row.
fn level_off(values_mm: &mut [f64], known: &[bool], columns: usize) {
    let mut known = known.to_vec();
    let mut next: std::collections::VecDeque<usize> = (0..known.len()).filter(|&k| known[k]).collect();
    while let Some(from) = next.pop_front() {
        let column = from % columns;
        let beside = [
            (column > 0).then(|| from - 1),
            (column + 1 < columns).then_some(from + 1),
            from.checked_sub(columns),
            Some(from + columns).filter(|&k| k < known.len()),
        ];
        for k in beside.into_iter().flatten() {
            if !std::mem::replace(&mut known[k], true) {
                values_mm[k] = values_mm[from];
                next.push_back(k);
            }
        }
    }
}

/// Returns the SHA-256 that `comment` states after the word `name`. For example, `name` is `map:`, and `comment`
/// contains `map: sha256 5f3c...`. Returns `None` if `comment` does not contain `name` with a complete SHA-256 after
/// it.
pub(super) fn identity_in(comment: &str, name: &str) -> Option<[u8; 32]> {
    let digits = comment.split_once(name)?.1.trim_start().strip_prefix("sha256")?.trim_start().get(..64)?;
    HEXLOWER_PERMISSIVE.decode(digits.as_bytes()).ok()?.try_into().ok()
}
