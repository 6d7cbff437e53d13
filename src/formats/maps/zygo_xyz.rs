//! XYZ maps of Zygo (`.xyz`): a header, a line `#`, then the column, the row and the height in µm of each sample. The
//! words `No Data` mark samples that were not measured. Rows count downwards.

use std::path::Path;

use super::super::error::FormatError;
use super::super::height_map::{HeightMap, MapFormat, check_size};
use super::{map_from_top, unexpected};

/// Bytes of the shortest line of a sample: three numbers of one digit, with what separates them.
const SHORTEST_LINE: usize = "0 0 0\n".len();

/// XYZ format of Zygo, detected by its first bytes.
pub(in super::super) const FORMAT: MapFormat = MapFormat {
    begins: |head| head.starts_with(b"Zygo XYZ Data File"),
    parse: |path, bytes, given_mm| parse_zygo_xyz(path, bytes, given_mm).map(Into::into),
};

fn parse_zygo_xyz(path: &Path, bytes: &[u8], given_mm: Option<f64>) -> Result<HeightMap, FormatError> {
    let text = String::from_utf8_lossy(bytes);
    let lines = || text.lines().map(str::trim);
    let wrong = |line: usize, expected: &str| {
        unexpected(path, &format!("line {line}"), expected, lines().nth(line - 1).unwrap_or("the end"))
    };
    let numbers = |line: usize, count: usize| -> Result<Vec<f64>, FormatError> {
        let words = lines().nth(line - 1).map(|line| line.split_whitespace().take(count)).into_iter().flatten();
        let numbers: Option<Vec<f64>> = words.map(|word| word.parse().ok()).collect();
        let numbers = numbers.filter(|numbers| numbers.len() == count && numbers.iter().all(|n| n.is_finite()));
        numbers.ok_or_else(|| wrong(line, &format!("{count} numbers")))
    };
    // Phase: origin and size in the camera.
    let phase = numbers(4, 4)?;
    let (origin, size) = ([phase[0], phase[1]], [phase[2], phase[3]]);
    let is_whole = |n: &f64| *n >= 0.0 && n.fract() == 0.0 && *n < 1e6;
    if !size.iter().chain(&origin).all(is_whole) {
        return Err(wrong(4, "the origin and the size of the phase in samples"));
    }
    let [columns, rows] = size.map(|n| n as usize);
    check_size(path, columns as u64, rows as u64)?;
    if columns * rows > bytes.len() / SHORTEST_LINE {
        let place = format!("byte {}", bytes.len());
        let expected = format!("a line for each of {columns} times {rows} samples");
        return Err(FormatError::Cut { path: path.to_owned(), place, expected });
    }
    // Source, scale factor, wavelength, aperture, obliquity, magnification, resolution of the camera in metres.
    let pitch_mm = 1e3 * numbers(8, 7)?[6];
    let begin = lines().position(|line| line == "#").ok_or_else(|| wrong(lines().count().max(1), "a line #"))?;
    let mut heights: Vec<Option<f64>> = vec![None; columns * rows];
    let mut seen = vec![false; columns * rows];
    for (i, line) in lines().enumerate().skip(begin + 1) {
        if line == "#" {
            break;
        }
        let words: Vec<&str> = line.split_whitespace().collect();
        let (x, y, height) = match words[..] {
            [] => continue,
            [x, y, no, data] if no.eq_ignore_ascii_case("no") && data.eq_ignore_ascii_case("data") => (x, y, None),
            [x, y, z] => (x, y, Some(z)),
            _ => return Err(wrong(i + 1, "a column, a row and a height, or the words No Data")),
        };
        let index = |word: &str, k: usize| {
            let value: f64 = word.parse().ok()?;
            let at = value - origin[k];
            (at >= 0.0 && at < size[k] && at.fract() == 0.0).then_some(at as usize)
        };
        let (Some(column), Some(row)) = (index(x, 0), index(y, 1)) else {
            return Err(wrong(i + 1, "a column and a row of the phase"));
        };
        let at = row * columns + column;
        if std::mem::replace(&mut seen[at], true) {
            return Err(wrong(i + 1, "each sample once"));
        }
        heights[at] = match height {
            None => None,
            Some(word) => {
                let value: Option<f64> = word.parse().ok().filter(|value: &f64| value.is_finite());
                Some(1e-3 * value.ok_or_else(|| wrong(i + 1, "a height in µm"))?)
            }
        };
    }
    if let Some(missing) = seen.iter().position(|seen| !seen) {
        let place = format!("sample {} of row {}", missing % columns + 1, missing / columns + 1);
        return Err(FormatError::Cut { path: path.to_owned(), place, expected: "a line for each sample".to_owned() });
    }
    let mut map = map_from_top(path, [columns, rows], ([pitch_mm; 2], given_mm), |index| heights[index])?;
    map.notes.push("heights are taken in µm, as MetroPro writes them; Mx can be set to another unit".to_owned());
    Ok(map)
}
