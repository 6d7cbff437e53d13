//! Surface errors on a grid in interferogram files of Code V (`.int`).
//!
//! Lines that begin with `!` are comments. A title can follow, then a line of parameters, `GRD 5 5 SUR WVL 0.6328 SSZ 1000
//! NDA 32767`: the size of the grid, the kind of data, the wavelength in µm, the number of counts for a wave, and the mark
//! of samples that were not measured. Then the counts follow, row by row. No public document says in which order the rows
//! are, or which of the two numbers of `GRD` is that of the rows.

use std::path::Path;

use super::super::error::FormatError;
use super::super::height_map::{HeightMap, MapFormat, check_size};
use super::{checked_factor, checked_wavelength_nm, map_from_top, unexpected};

/// Format of interferograms of Code V, detected by its line of parameters.
pub(in super::super) const FORMAT: MapFormat = MapFormat {
    begins: |head| header_line(&String::from_utf8_lossy(&head[..head.len().min(HEAD_BYTES)])).is_some(),
    parse: |path, bytes, given_mm| parse_interferogram(path, bytes, given_mm).map(Into::into),
};

/// Number of bytes in which the line of parameters begins.
const HEAD_BYTES: usize = 4096;

/// Mark of samples that were not measured, if the file states none.
const NOT_MEASURED: f64 = 32767.0;

/// Returns the number, from 0, and the text of the line of parameters: the first or the second one that is no comment.
fn header_line(text: &str) -> Option<(usize, &str)> {
    let lines = text.lines().enumerate().map(|(number, line)| (number, line.trim()));
    let mut lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('!')).take(2);
    lines.find(|(_, line)| {
        let words: Vec<&str> = line.split_whitespace().take(3).collect();
        matches!(words[..], [grid, columns, rows] if grid.eq_ignore_ascii_case("GRD")
            && [columns, rows].iter().all(|number| number.parse::<f64>().is_ok()))
    })
}

/// Parameters of a grid.
#[derive(Default)]
struct Parameters {
    size: Option<usize>,
    is_surface: bool,
    wavelength_um: Option<f64>,
    counts: Option<f64>,
    mark: Option<f64>,
}

impl Parameters {
    fn read(path: &Path, number: usize, line: &str) -> Result<Self, FormatError> {
        let place = format!("line {}", number + 1);
        let wrong = |expected: &str, found: &str| unexpected(path, &place, expected, found);
        let mut found = Self::default();
        let upper = line.to_ascii_uppercase();
        let mut words = upper.split_whitespace();
        while let Some(word) = words.next() {
            let mut value = || {
                let value = words.next().unwrap_or_default();
                value.parse::<f64>().map_err(|_| wrong(&format!("a number behind {word}"), value))
            };
            match word {
                "GRD" => {
                    let size = [value()?, value()?];
                    // Which of the two is that of the rows is not known.
                    if size[0] != size[1] || size[0].fract() != 0.0 || !(2.0..=1e5).contains(&size[0]) {
                        return Err(wrong("a grid of as many rows as columns", &format!("{} x {}", size[0], size[1])));
                    }
                    found.size = Some(size[0] as usize);
                }
                "SUR" => found.is_surface = true,
                "WVL" => found.wavelength_um = Some(value()?),
                "SSZ" => found.counts = Some(value()?),
                "NDA" => found.mark = Some(value()?),
                other => return Err(wrong("GRD, SUR, WVL, SSZ and NDA alone", other)),
            }
        }
        if !found.is_surface {
            return Err(wrong("SUR, the error of a surface: a wavefront is no surface", line));
        }
        Ok(found)
    }
}

fn parse_interferogram(path: &Path, bytes: &[u8], given_mm: Option<f64>) -> Result<HeightMap, FormatError> {
    let text = String::from_utf8_lossy(bytes);
    let missing = |expected: &str| unexpected(path, "the parameters", expected, "none");
    let (number, line) = header_line(&text).ok_or_else(|| missing("a line GRD"))?;
    let parameters = Parameters::read(path, number, line)?;
    let size = parameters.size.ok_or_else(|| missing("GRD"))?;
    check_size(path, size as u64, size as u64)?;
    let wavelength_um = parameters.wavelength_um.ok_or_else(|| missing("WVL"))?;
    let counts = checked_factor(path, "SSZ", "a number", parameters.counts.ok_or_else(|| missing("SSZ"))?)?;
    let count_mm = 1e-6 * checked_wavelength_nm(path, "WVL", 1e3 * wavelength_um)? / counts;
    let mark = parameters.mark.unwrap_or(NOT_MEASURED);
    let mut heights = Vec::new();
    for (number, line) in text.lines().enumerate().skip(number + 1).filter(|(_, line)| !line.trim().starts_with('!')) {
        for word in line.split_whitespace() {
            let value = word.parse::<f64>().ok().filter(|value| value.fract() == 0.0 && value.abs() <= 1e9);
            let value =
                value.ok_or_else(|| unexpected(path, &format!("line {}", number + 1), "a whole number", word))?;
            if heights.len() == size * size {
                let expected = format!("{size} x {size} counts");
                return Err(unexpected(path, &format!("line {}", number + 1), &expected, "more"));
            }
            heights.push((value != mark).then_some(value * count_mm));
        }
    }
    if heights.len() != size * size {
        let (place, expected) = (format!("count {}", heights.len() + 1), format!("{size} x {size} counts"));
        return Err(FormatError::Cut { path: path.to_owned(), place, expected });
    }
    let mut map = map_from_top(path, [size; 2], ([0.0; 2], given_mm), |index| heights[index])?;
    map.notes.push(
        "files of Code V say neither which row is the top one nor where material is; the first row is taken as the top \
         one, and a positive count as material"
            .to_owned(),
    );
    Ok(map)
}
