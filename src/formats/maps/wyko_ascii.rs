//! ASCII maps of Wyko Vision (`.asc`): a header of names and values, then one line for each x, with the values from the
//! bottom up. The word `Bad` marks samples that were not measured.

use std::path::Path;

use super::super::error::FormatError;
use super::super::height_map::{HeightMap, MapFormat, check_size};
use super::{checked_factor, checked_wavelength_nm, map_from_top, unexpected};

/// Names of the arrays that have heights.
const HEIGHTS: [&str; 5] = ["RAW_DATA", "RAW DATA", "OPD", "Raw", "SAMPLE_DATA"];

/// Cells of a line, counted from 0, that have the value of a block and the size of the map.
const VALUE_CELL: usize = 3;
const SIZE_CELL: usize = 1;

/// ASCII format of Wyko Vision, detected by its first bytes.
pub(in super::super) const FORMAT: MapFormat = MapFormat {
    begins: |head| head.starts_with(b"Wyko ASCII Data File"),
    parse: |path, bytes, given_mm| parse_wyko_ascii(path, bytes, given_mm).map(Into::into),
};

/// Values of the header.
#[derive(Default)]
struct Header {
    size: [Option<usize>; 2],
    pitch_mm: Option<f64>,
    wavelength_nm: Option<f64>,
    aspect: Option<f64>,
    mult: Option<f64>,
}

fn parse_wyko_ascii(path: &Path, bytes: &[u8], given_mm: Option<f64>) -> Result<HeightMap, FormatError> {
    let text = String::from_utf8_lossy(bytes);
    let mut lines = (1usize..).zip(text.lines());
    let wrong = |line: usize, expected: &str, found: &str| unexpected(path, &format!("line {line}"), expected, found);
    let (_, first) = lines.next().unwrap_or((1, ""));
    let flags: Vec<&str> = first.trim_start_matches("Wyko ASCII Data File").split_whitespace().collect();
    let (is_matrix, is_nm) = match flags[..] {
        ["Format", form, real @ ("0" | "1"), _] => (form == "0", real == "1"),
        _ => return Err(wrong(1, "the word Format and three numbers, the second of which is 0 or 1", first)),
    };
    if !is_matrix {
        return Err(wrong(1, "a matrix (format 0); export the map so", first));
    }
    let mut header = Header::default();
    for (number, line) in lines.by_ref() {
        let cells: Vec<&str> = line.split('\t').map(str::trim).collect();
        let cell = |at: usize| cells.get(at).copied().unwrap_or_default();
        // A block has its type and its length before the value.
        let value = || -> Result<f64, FormatError> {
            cell(VALUE_CELL).parse().map_err(|_| wrong(number, "name, type, length and a number", line))
        };
        let size = || -> Result<usize, FormatError> {
            cell(SIZE_CELL).parse().map_err(|_| wrong(number, "a whole number of samples", line))
        };
        match cells[0] {
            "X Size" => header.size[0] = Some(size()?),
            "Y Size" => header.size[1] = Some(size()?),
            "Pixel_size" => header.pitch_mm = Some(value()?),
            "Wavelength" => header.wavelength_nm = Some(value()?),
            "Aspect" => header.aspect = Some(value()?),
            "Mult" => header.mult = Some(value()?),
            name if HEIGHTS.contains(&name) => return header.map(path, (is_nm, given_mm), lines),
            _ => {}
        }
    }
    Err(wrong(text.lines().count(), "an array of heights such as RAW_DATA", "the end"))
}

impl Header {
    fn map<'a>(
        &self,
        path: &Path,
        (is_nm, given_mm): (bool, Option<f64>),
        lines: impl Iterator<Item = (usize, &'a str)>,
    ) -> Result<HeightMap, FormatError> {
        let missing = |name: &str| unexpected(path, "the header", &format!("a line {name}"), "none");
        let columns = self.size[0].ok_or_else(|| missing("X Size"))?;
        let rows = self.size[1].ok_or_else(|| missing("Y Size"))?;
        check_size(path, columns as u64, rows as u64)?;
        let pitch_mm = self.pitch_mm.ok_or_else(|| missing("Pixel_size"))?;
        let pitch_mm = checked_factor(path, "Pixel_size", "a number of mm", pitch_mm)?;
        let aspect = checked_factor(path, "Aspect", "a ratio", self.aspect.unwrap_or(1.0))?;
        // Two readers disagree whether heights are divided by it or multiplied.
        if let Some(mult) = self.mult.filter(|mult| *mult != 1.0) {
            return Err(unexpected(path, "Mult", "1", mult.to_string()));
        }
        let unit_mm = if is_nm {
            1e-6
        } else {
            let wavelength_nm = self.wavelength_nm.ok_or_else(|| missing("Wavelength"))?;
            1e-6 * checked_wavelength_nm(path, "Wavelength", wavelength_nm)?
        };
        let mut values: Vec<Option<f64>> = Vec::new();
        for (number, line) in lines.take(columns) {
            let wrong = |expected: &str, found: &str| unexpected(path, &format!("line {number}"), expected, found);
            let words: Vec<&str> = line.split_whitespace().collect();
            if words.len() != rows {
                return Err(wrong(&format!("{rows} heights, as Y Size says"), &format!("{} values", words.len())));
            }
            for word in words {
                let value: Option<f64> = if word.eq_ignore_ascii_case("bad") {
                    None
                } else {
                    Some(word.parse().map_err(|_| wrong("a height or `Bad`", word))?)
                };
                values.push(value.filter(|value| value.is_finite()));
            }
        }
        if values.len() != columns * rows {
            let expected = format!("{columns} lines of heights, as X Size says");
            let found = values.len() / rows;
            return Err(FormatError::Cut {
                path: path.to_owned(),
                place: format!("line {found} of the heights"),
                expected,
            });
        }
        let spacing_mm = [pitch_mm, pitch_mm * aspect];
        map_from_top(path, [columns, rows], (spacing_mm, given_mm), |index| {
            let (column, row) = (index % columns, rows - 1 - index / columns);
            values[column * rows + row].map(|value| value * unit_mm)
        })
    }
}
