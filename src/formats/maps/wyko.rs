//! Maps of Wyko Vision (`.opd`): a directory of blocks, then their contents.
//!
//! The array of the heights has its columns one after the other, each from the bottom up. The height in nm is the value
//! times the wavelength over `Mult`. Samples that were not measured are 1e38 and more, or 32766 and more.

use std::path::Path;

use super::super::error::FormatError;
use super::super::height_map::{HeightMap, MapFormat, check_size};
use super::{Bytes, MARK, checked_factor, checked_wavelength_nm, map_from_top};

const MAGIC: &[u8] = b"\x01\x00Directory";
const ENTRY: usize = 24;
const MAX_BLOCKS: usize = 100_000;

/// Name of a block whose length some versions of the program state wrongly, and that length.
const MISSTATED: (&str, usize) = ("ImageModificat~0", 40);

/// Names of the arrays that have heights; others have intensities.
const HEIGHTS: [&str; 5] = ["RAW_DATA", "RAW DATA", "OPD", "Raw", "SAMPLE_DATA"];

/// Format of Wyko Vision, detected by its first bytes.
pub(in super::super) const FORMAT: MapFormat = MapFormat {
    begins: |head| head.starts_with(MAGIC),
    parse: |path, bytes, given_mm| parse_wyko(path, bytes, given_mm).map(Into::into),
};

/// Block of the file.
struct Block {
    name: String,
    kind: i16,
    begin: usize,
    length: usize,
}

fn parse_wyko(path: &Path, bytes: &[u8], given_mm: Option<f64>) -> Result<HeightMap, FormatError> {
    let file = Bytes { path, bytes };
    let blocks = blocks(&file)?;
    let number = |name: &str| -> Result<Option<f64>, FormatError> {
        let Some(block) = blocks.iter().find(|block| block.name == name) else { return Ok(None) };
        Ok(Some(match (block.kind, block.length) {
            (6, 2) => f64::from(file.i16(block.begin)?),
            (6 | 12, 4) => f64::from(file.i32(block.begin)?),
            (7, 4) => f64::from(file.f32(block.begin)?),
            (8, 8) => file.f64(block.begin)?,
            other => return Err(file.unexpected(name, "a number", format!("{other:?}"))),
        }))
    };
    let needed = |name: &str| number(name)?.ok_or_else(|| file.unexpected(name, "a block of this name", "none"));
    let checked = |name: &str, value: f64| checked_factor(path, name, "a number", value);
    let pitch_mm = checked("Pixel_size", needed("Pixel_size")?)?;
    let wavelength_nm = checked_wavelength_nm(path, "Wavelength", needed("Wavelength")?)?;
    let aspect = checked("Aspect", number("Aspect")?.unwrap_or(1.0))?;
    let mult = checked("Mult", number("Mult")?.unwrap_or(1.0))?;
    let is_height = |block: &&Block| block.kind == 3 && HEIGHTS.contains(&block.name.as_str());
    let mut arrays = blocks.iter().filter(is_height);
    let (Some(array), None) = (arrays.next(), arrays.next()) else {
        return Err(file.unexpected("arrays", "one array of heights", "none, or several"));
    };
    let [columns, rows, size] = [0, 2, 4].map(|at| file.u16(array.begin + at).map(usize::from));
    let ([columns, rows], size) = ([columns?, rows?], size?);
    check_size(path, columns as u64, rows as u64)?;
    if !matches!(size, 1 | 2 | 4) || 6 + columns * rows * size > array.length {
        return Err(file.unexpected(&array.name, "as many heights as it says", format!("{columns} x {rows} x {size}")));
    }
    let unit_mm = 1e-6 * wavelength_nm / mult;
    let height = |index: usize| {
        // Columns one after the other, each from the bottom up.
        let (column, row) = (index % columns, rows - 1 - index / columns);
        let at = array.begin + 6 + size * (column * rows + row);
        let value = match size {
            1 => file.slice(at, 1).map(|b| f64::from(b[0])).ok()?,
            2 => file.i16(at).ok().filter(|raw| *raw < 32766).map(f64::from)?,
            _ => file.f32(at).ok().map(f64::from).filter(|value| value.abs() < MARK)?,
        };
        value.is_finite().then_some(value * unit_mm)
    };
    map_from_top(path, [columns, rows], ([pitch_mm, pitch_mm * aspect], given_mm), height)
}

/// Reads the directory.
fn blocks(file: &Bytes<'_>) -> Result<Vec<Block>, FormatError> {
    let entry = |k: usize| -> Result<Block, FormatError> {
        let at = 2 + ENTRY * k;
        let name = file.slice(at, 16)?;
        let end = name.iter().position(|&b| b == 0).unwrap_or(16);
        let name = String::from_utf8_lossy(&name[..end]).trim().to_owned();
        let length = usize::try_from(file.i32(at + 18)?).unwrap_or(0);
        Ok(Block { name, kind: file.i16(at + 16)?, begin: 0, length })
    };
    let directory = entry(0)?;
    let count = directory.length / ENTRY;
    if count == 0 || count > MAX_BLOCKS {
        return Err(file.unexpected("directory", "1 to 100000 blocks", count.to_string()));
    }
    let mut blocks: Vec<Block> = Vec::new();
    for k in 1..count {
        let block = entry(k)?;
        if !block.name.is_empty() && block.length > 0 {
            blocks.push(block);
        }
    }
    let contents = 2 + directory.length;
    let end = |blocks: &[Block]| blocks.iter().fold(contents, |end, block| end.saturating_add(block.length));
    if end(&blocks) != file.bytes.len() {
        // Some versions state 40 bytes for this number of four bytes.
        for block in blocks.iter_mut().filter(|block| (block.name.as_str(), block.length) == MISSTATED) {
            block.length = 4;
        }
    }
    let end = end(&blocks);
    if end > file.bytes.len() {
        return Err(FormatError::Cut {
            path: file.path.to_owned(),
            place: format!("byte {}", file.bytes.len()),
            expected: format!("{end} bytes, as the directory says"),
        });
    }
    if end < file.bytes.len() {
        let expected = format!("blocks up to the end of the file at byte {}", file.bytes.len());
        return Err(file.unexpected("directory", &expected, format!("blocks up to byte {end}")));
    }
    let mut begin = contents;
    for block in &mut blocks {
        block.begin = begin;
        begin += block.length;
    }
    Ok(blocks)
}
