//! A map over x and y to correct a program by: `error_map.csv` or `correction.csv`.

use std::io::{BufRead, BufReader, Read as _};
use std::path::Path;

use sha2::{Digest, Sha256};

use super::GcodeError;
use crate::FormatError;
use regrind_core::geometry::grid_order::NO_POINT;
use regrind_core::geometry::{Grid, Point, recognise_grid};

/// Largest map that is read.
const MOST_BYTES: u64 = 512 << 20;

/// What the values of a map are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MapKind {
    /// The error of the part: positive stands proud, and is taken off.
    Error,
    /// The correction of the surface: positive leaves material.
    Correction,
}

/// What the program that a map is put on must have in it already.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MapBase {
    /// No correction: the map is absolute, it replaces what was before it.
    Nothing,
    /// This map: the error was measured after a pass that was ground with it.
    Map([u8; 32]),
    /// Whatever: the map does not say what it was measured after.
    Anything,
}

/// A map as read.
#[derive(Clone, Debug, PartialEq)]
pub struct ProgramMap {
    /// Where the nodes are.
    pub grid: Grid,
    /// The values in millimetres, row by row with x fastest.
    pub values_mm: Vec<f64>,
    /// Whether enough was measured around a node; all, where the file does not say.
    pub valid: Vec<bool>,
    /// What they are.
    pub kind: MapKind,
    /// The map's own identity, or the SHA-256 of the file where it states none.
    pub identity: [u8; 32],
    /// The part that it belongs to, where it says so.
    pub part: Option<[u8; 32]>,
    /// What the program must have in it already.
    pub base: MapBase,
    /// Whether it comes from a simulated cell.
    pub simulation: bool,
}

impl ProgramMap {
    /// Returns whether a place lies over a node around which enough was measured.
    pub fn covers(&self, place_mm: [f64; 2]) -> bool {
        let counts = self.grid.counts();
        let [column, row] = [0, 1].map(|k| ((place_mm[k] - self.grid.first_mm[k]) / self.grid.spacing_mm[k]).round());
        let inside = column >= 0.0 && row >= 0.0 && column < counts[0] as f64 && row < counts[1] as f64;
        inside && self.valid[row as usize * counts[0] + column as usize]
    }
}

/// Reads a map: a header `x_mm,y_mm,error_mm` or `x_mm,y_mm,correction_mm`, perhaps with further columns, and a row for every node of a
/// regular grid. A column `valid` says with 0 around which nodes too little was measured: a map that Regrind made has them levelled off, in another one their
/// values are not used, and the nearest valid ones stand there. Comments tell `part: sha256 ...`, `map: sha256 ...`, `ground with: sha256 ...` and `SIMULATION`.
///
/// # Errors
/// A file that cannot be read, other columns, rows that are no numbers, nodes that are no whole grid.
pub fn read_program_map(path: &Path) -> Result<ProgramMap, GcodeError> {
    let unreadable = |source| GcodeError::File(FormatError::Unreadable { path: path.to_owned(), source });
    let file = crate::system::open_to_read(path).map_err(unreadable)?;
    let mut reader = BufReader::new(file.take(MOST_BYTES + 1));
    let (mut lines, mut line, mut number, mut bytes) = (MapLines::default(), Vec::new(), 0u64, 0u64);
    loop {
        line.clear();
        // A file without lines is not read into one.
        let taken = (&mut reader).take(4096).read_until(b'\n', &mut line).map_err(unreadable)?;
        if taken == 0 {
            return lines.into_map(path);
        }
        (number, bytes) = (number + 1, bytes + taken as u64);
        if bytes > MOST_BYTES {
            let (path, found, limit, unit) = (path.to_owned(), bytes, MOST_BYTES, "bytes");
            return Err(GcodeError::File(FormatError::TooLarge { path, found, limit, unit }));
        }
        lines.take(&line).map_err(|what| {
            let remedy = "give the error_map.csv or correction.csv of a run, or a file like it";
            GcodeError::Line { path: path.to_owned(), line: number, what, remedy }
        })?;
    }
}

/// What the lines of a map have told so far.
#[derive(Default)]
struct MapLines {
    hash: Sha256,
    kind: Option<MapKind>,
    /// Which column says whether a node is valid.
    valid_column: Option<usize>,
    nodes: Vec<Point>,
    valid: Vec<bool>,
    simulation: bool,
    part: Option<[u8; 32]>,
    /// The map's own identity.
    stated: Option<[u8; 32]>,
    ground_with: Option<[u8; 32]>,
}

impl MapLines {
    /// Takes one line; the error says what is wrong with it.
    fn take(&mut self, line: &[u8]) -> Result<(), String> {
        self.hash.update(line);
        let text = std::str::from_utf8(line).map_err(|_| "the line is no text")?.trim_start_matches('\u{feff}').trim();
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
                Some(other) => return Err(format!("{other:?} says neither 1 nor 0 of a node")),
            };
            self.nodes.push(node(text, valid).ok_or_else(|| format!("{text:?} is no node of a map"))?);
            self.valid.push(valid);
        }
        Ok(())
    }

    /// Lays the nodes on their grid once all lines are told.
    fn into_map(self, path: &Path) -> Result<ProgramMap, GcodeError> {
        let remedy = "every node of a regular grid of three rows and three columns at least needs its row";
        let no_grid = |what: String| GcodeError::Program { path: path.to_owned(), what, remedy };
        let kind = self.kind.ok_or_else(|| no_grid("the map is empty".into()))?;
        let (grid, order) =
            grid(&self.nodes).ok_or_else(|| no_grid(format!("its {} nodes are no whole grid", self.nodes.len())))?;
        let mut values_mm: Vec<f64> = order.iter().map(|&point| self.nodes[point].z).collect();
        let valid: Vec<bool> = order.iter().map(|&point| self.valid[point]).collect();
        if !valid.contains(&true) {
            return Err(no_grid("none of its nodes is valid".into()));
        }
        // A map of ours is levelled off; of another one what stands at a node that is not valid means nothing.
        let is_ours = self.stated.is_some() || self.part.is_some();
        let is_known = |(value, valid): (&f64, &bool)| *valid || (is_ours && value.is_finite());
        let known: Vec<bool> = values_mm.iter().zip(&valid).map(is_known).collect();
        level_off(&mut values_mm, &known, grid.columns);
        Ok(ProgramMap {
            grid,
            values_mm,
            valid,
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

/// Reads the node of a row; the value of one that is not valid may be anything.
fn node(row: &str, valid: bool) -> Option<Point> {
    let mut cells = row.split(',').map(|cell| cell.trim().parse::<f64>().ok().filter(|v| v.abs() < 1e7));
    Some(Point::new(cells.next()??, cells.next()??, cells.next()?.or((!valid).then_some(f64::NAN))?))
}

/// The grid of the nodes, and which of them stands at each of its places.
fn grid(points: &[Point]) -> Option<(Grid, Vec<usize>)> {
    let order = recognise_grid(points)?;
    if order.point_at.contains(&NO_POINT) {
        return None;
    }
    let at = |node: usize| points[order.point_at[node] as usize];
    let (first, last) = (at(0), at(order.columns * order.rows - 1));
    let spacing_mm = [(last.x - first.x) / (order.columns - 1) as f64, (last.y - first.y) / (order.rows - 1) as f64];
    let grid = Grid { columns: order.columns, rows: order.rows, first_mm: [first.x, first.y], spacing_mm };
    Some((grid, (0..grid.len()).map(|k| order.point_at[k] as usize).collect()))
}

/// Gives nodes whose value is not known that of the nearest one whose is, by steps along rows and columns.
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

/// Finds an identity after a name in a comment.
pub(super) fn identity_in(comment: &str, name: &str) -> Option<[u8; 32]> {
    let digits = comment.split_once(name)?.1.trim_start().strip_prefix("sha256")?.trim_start().get(..64)?;
    let mut bytes = [0; 32];
    for (k, byte) in bytes.iter_mut().enumerate() {
        *byte = u8::from_str_radix(digits.get(2 * k..2 * k + 2)?, 16).ok()?;
    }
    Some(bytes)
}
