//! Depth images of Alicona (`.al3d`): tags of 52 bytes, then heights as f32 in metres, the top row first, rows padded to
//! eight bytes. Heights from InvalidPixelValue on were not measured.

use std::path::Path;

use super::super::error::FormatError;
use super::super::height_map::{HeightMap, MapFormat, check_size};
use super::{Bytes, map_from_top, read_with};

const MAGIC: &[u8] = b"AliconaImaging\0\r\n";
const TAG: usize = 52;
const MAX_TAGS: usize = 1000;

/// Format of Alicona, detected by its first bytes.
pub(in super::super) const FORMAT: MapFormat = MapFormat {
    begins: |head| head.starts_with(MAGIC),
    read: |path| read_with(path, parse_alicona),
    parse: |path, bytes| parse_alicona(path, bytes).map(Into::into),
};

fn parse_alicona(path: &Path, bytes: &[u8]) -> Result<HeightMap, FormatError> {
    let file = Bytes { path, bytes };
    let text = |slice: &[u8]| {
        let end = slice.iter().position(|&b| b == 0).unwrap_or(slice.len());
        String::from_utf8_lossy(&slice[..end]).trim().to_owned()
    };
    let mut tags: Vec<(String, String)> = Vec::new();
    let mut count = 2;
    while tags.len() < count.min(MAX_TAGS) {
        let tag = file.slice(MAGIC.len() + TAG * tags.len(), TAG)?;
        tags.push((text(&tag[..20]), text(&tag[20..50])));
        if tags.len() == 2 {
            count += tags[1].1.parse::<usize>().unwrap_or(0);
        }
    }
    let number = |key: &str| -> Result<f64, FormatError> {
        let value = tags.iter().find(|(name, _)| name == key).map_or("", |(_, value)| value);
        let parsed = value.parse::<f64>().ok().filter(|value| value.is_finite());
        parsed.ok_or_else(|| file.unexpected(&format!("tag {key}"), "a number", value))
    };
    let whole = |key: &str| number(key).map(|value| value.clamp(0.0, 1e15) as usize);
    let [columns, rows] = [whole("Cols")?, whole("Rows")?];
    check_size(path, columns as u64, rows as u64)?;
    let (begin, mark) = (whole("DepthImageOffset")?, number("InvalidPixelValue")?);
    let stride = (4 * columns).div_ceil(8) * 8;
    // The padding of the last row can be missing.
    file.slice(begin, stride * (rows - 1) + 4 * columns)?;
    let height = |index: usize| {
        let value = f64::from(file.f32(begin + stride * (index / columns) + 4 * (index % columns)).ok()?);
        // The mark is written with fewer digits than a number of 32 bits has.
        (value.is_finite() && value < mark * (1.0 - 1e-6)).then_some(1e3 * value)
    };
    map_from_top(path, [columns, rows], [1e3 * number("PixelSizeXMeter")?, 1e3 * number("PixelSizeYMeter")?], height)
}
