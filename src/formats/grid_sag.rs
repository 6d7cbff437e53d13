//! Grid of sags of Zemax OpticStudio (`.dat`): heights of a surface over a rectangular grid.
//!
//! The first line has the numbers of columns and rows, the steps along x and y, the unit (0 mm, 1 cm, 2 inch, 3 m) and
//! the shift of the grid. A line for each node follows: the sag, its slopes and its cross derivative, and 1 if the node has
//! no data. The first node is that of the least x and the largest y; x runs first (OpticStudio manual, Grid Sag).

use std::path::Path;

use regrind_core::geometry::Point;

use super::error::{FormatError, excerpt};
use super::whole::read_whole;

/// Largest file that is read, in bytes.
const MAX_BYTES: u64 = 1 << 30;

/// Least number of columns and of rows.
const MIN_NODES: f64 = 5.0;

/// Largest number of nodes.
const MAX_NODES: usize = 50_000_000;

/// First line of a file.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Header {
    counts: [usize; 2],
    steps_mm: [f64; 2],
    shift_mm: [f64; 2],
    unit_mm: f64,
}

/// Returns true if `head`, the beginning of a file, is a grid of sags: a line of seven numbers, of which those of the
/// nodes and the unit are whole, and a line of four or five numbers.
pub(super) fn is_grid_sag(head: &[u8]) -> bool {
    let text = String::from_utf8_lossy(head);
    let mut lines = content(&text);
    let header = lines.next().and_then(|(_, line)| header(line));
    let node = lines.next().and_then(|(_, line)| numbers(line));
    header.is_some() && node.is_some_and(|node| (4..=5).contains(&node.len()))
}

/// Reads the nodes of a grid of sags that have data, as points on the surface in millimetres.
///
/// # Errors
/// A file that cannot be read; another number of nodes than the first line states; a node that is not four numbers, or five.
pub(super) fn read_grid_sag(path: &Path) -> Result<Vec<Point>, FormatError> {
    parse_grid_sag(path, &read_whole(path, MAX_BYTES)?)
}

fn parse_grid_sag(path: &Path, bytes: &[u8]) -> Result<Vec<Point>, FormatError> {
    let text = String::from_utf8_lossy(bytes);
    let wrong = |line: usize, expected: &str, found: &str| FormatError::Unexpected {
        path: path.to_owned(),
        place: format!("line {line}"),
        expected: expected.to_owned(),
        found: excerpt(found.as_bytes()),
    };
    let mut lines = content(&text);
    let (number, first) = lines.next().unwrap_or((1, ""));
    let grid = header(first).ok_or_else(|| wrong(number, "numbers of nodes, steps, unit and shift", first))?;
    let [columns, rows] = grid.counts;
    let count = columns.saturating_mul(rows);
    if count > MAX_NODES {
        return Err(wrong(number, "at most 50000000 nodes", first));
    }
    let mut points = Vec::new();
    for k in 0..count {
        let cut = || {
            let place = format!("node {} of {count}", k + 1);
            FormatError::Cut { path: path.to_owned(), place, expected: "a line for each node".to_owned() }
        };
        let (number, line) = lines.next().ok_or_else(cut)?;
        let node = numbers(line).filter(|node| (4..=5).contains(&node.len()));
        let node = node.ok_or_else(|| wrong(number, "sag, two slopes, cross derivative, and 1 for no data", line))?;
        let has_data = match node.get(4) {
            None | Some(0.0) => true,
            Some(1.0) => false,
            Some(_) => return Err(wrong(number, "0 or 1 as the fifth number", line)),
        };
        if has_data {
            let (i, j) = ((k % columns) as f64, (k / columns) as f64);
            let x = (i - 0.5 * (columns as f64 - 1.0)) * grid.steps_mm[0] + grid.shift_mm[0];
            let y = (0.5 * (rows as f64 - 1.0) - j) * grid.steps_mm[1] + grid.shift_mm[1];
            points.push(Point::new(x, y, node[0] * grid.unit_mm));
        }
    }
    match lines.next() {
        Some((number, line)) => Err(wrong(number, &format!("the end after {count} nodes"), line)),
        None => Ok(points),
    }
}

/// Returns the lines that are neither blank nor comments, with their numbers from 1.
fn content(text: &str) -> impl Iterator<Item = (usize, &str)> {
    (1..).zip(text.lines().map(str::trim)).filter(|(_, line)| !line.is_empty() && !line.starts_with('!'))
}

fn numbers(line: &str) -> Option<Vec<f64>> {
    let number = |word: &str| word.parse::<f64>().ok().filter(|number| number.is_finite());
    line.split_whitespace().map(number).collect()
}

fn header(line: &str) -> Option<Header> {
    let &[columns, rows, dx, dy, unit, x, y] = &numbers(line)?[..] else { return None };
    let whole = |value: f64| (value.fract() == 0.0 && (MIN_NODES..1e9).contains(&value)).then_some(value as usize);
    let unit_mm = match unit {
        0.0 => 1.0,
        1.0 => 10.0,
        2.0 => 25.4,
        3.0 => 1e3,
        _ => return None,
    };
    let steps_mm = [dx, dy].map(|step| step.abs() * unit_mm);
    (steps_mm[0] > 0.0 && steps_mm[1] > 0.0).then_some(())?;
    Some(Header { counts: [whole(columns)?, whole(rows)?], steps_mm, shift_mm: [x * unit_mm, y * unit_mm], unit_mm })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 7 x 6 nodes of z = x + 10 y in mm, the first without data.
    fn file(unit: f64, flag: u32) -> String {
        let mut text =
            format!("! a comment\n7 6 {} {} {flag} {} {}\n", 3.0 / unit, 2.0 / unit, 1.25 / unit, -0.5 / unit);
        for k in 0..42 {
            let (x, y) = (f64::from(k % 7 - 3) * 3.0 + 1.25, (2.5 - f64::from(k / 7)) * 2.0 - 0.5);
            text += &format!("{} 1 10 0 {}\n", (x + 10.0 * y) / unit, u8::from(k == 0));
        }
        text
    }

    fn parse(text: &str) -> Result<Vec<Point>, FormatError> {
        parse_grid_sag(Path::new("grid.dat"), text.as_bytes())
    }

    #[test]
    fn nodes_are_at_their_places_in_every_unit() {
        for (unit, flag) in [(1.0, 0), (10.0, 1), (25.4, 2), (1e3, 3)] {
            let text = file(unit, flag);
            assert!(is_grid_sag(text.as_bytes()));
            let points = parse(&text).unwrap();
            assert_eq!(points.len(), 41);
            assert!((points[0] - Point::new(-4.75, 4.5, 40.25)).norm() < 1e-12);
            assert!((points[40] - Point::new(10.25, -5.5, -44.75)).norm() < 1e-12);
        }
    }

    #[test]
    fn damaged_grids_are_refused() {
        let text = file(1.0, 0);
        // Cut at the end of a line, and within one.
        let last_line = text.trim_end().rfind('\n').unwrap();
        assert!(matches!(parse(&text[..last_line]), Err(FormatError::Cut { .. })));
        assert!(matches!(parse(&text[..last_line + 5]), Err(FormatError::Unexpected { .. })));
        for damaged in [
            text.clone() + "1 0 0 0\n",
            text.replacen(" 1 10 0 0", " 1 10 0 2", 1),
            text.replacen(" 1 10 0 0", " 1 x 0 0", 1),
            text.replacen(" 1 10 0 0", " 1 NaN 0 0", 1),
            text.replacen("7 6 3", "99999 99999 3", 1),
        ] {
            assert!(matches!(parse(&damaged), Err(FormatError::Unexpected { .. })));
        }
    }

    /// Tables of points are no grids.
    #[test]
    fn other_numbers_are_no_grid() {
        for text in [
            "7 6 3 2 0 1 0\n1 2 3\n",
            "7 6 3 2 4 1 0\n1 2 3 4\n",
            "7.5 6 3 2 0 1 0\n1 2 3 4\n",
            "4 6 3 2 0 1 0\n1 2 3 4\n",
            "7 6 0 2 0 1 0\n1 2 3 4\n",
            "1 2 3\n4 5 6\n",
            "",
        ] {
            assert!(!is_grid_sag(text.as_bytes()), "{text}");
        }
    }
}
