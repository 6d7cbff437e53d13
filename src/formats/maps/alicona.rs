//! Depth images of Alicona (`.al3d`): tags of 52 bytes, then heights as f32 in metres, the top row first, rows padded to
//! eight bytes. Heights from InvalidPixelValue on were not measured.

use std::path::Path;

use super::super::error::FormatError;
use super::super::height_map::{HeightMap, MapFormat, check_size};
use super::{Bytes, map_from_top};

const MAGIC: &[u8] = b"AliconaImaging\0\r\n";
const TAG: usize = 52;
const MAX_TAGS: usize = 1000;
/// Index of the tag with the number of tags behind it.
const COUNT_TAG: usize = 1;
/// Largest size or offset in a tag; every whole number up to it is exact.
const MAX_WHOLE: f64 = 1e15;

/// Format of Alicona, detected by its first bytes.
pub(in super::super) const FORMAT: MapFormat = MapFormat {
    begins: |head| head.starts_with(MAGIC),
    parse: |path, bytes, given_mm| parse_alicona(path, bytes, given_mm).map(Into::into),
};

fn parse_alicona(path: &Path, bytes: &[u8], given_mm: Option<f64>) -> Result<HeightMap, FormatError> {
    let file = Bytes { path, bytes };
    let text = |slice: &[u8]| {
        let end = slice.iter().position(|&b| b == 0).unwrap_or(slice.len());
        String::from_utf8_lossy(&slice[..end]).trim().to_owned()
    };
    let tag = |index: usize| -> Result<(String, String), FormatError> {
        let tag = file.slice(MAGIC.len() + TAG * index, TAG)?;
        Ok((text(&tag[..20]), text(&tag[20..50])))
    };
    let (name, value) = tag(COUNT_TAG)?;
    let more = value.parse::<usize>().ok().filter(|more| name == "TagCount" && *more <= MAX_TAGS);
    let more = more.ok_or_else(|| file.unexpected("tag TagCount", "a number up to 1000", format!("{name} {value}")))?;
    let count = COUNT_TAG + 1 + more;
    let tags: Vec<(String, String)> = (0..count).map(tag).collect::<Result<_, _>>()?;
    let number = |key: &str| -> Result<f64, FormatError> {
        let value = tags.iter().find(|(name, _)| name == key).map_or("", |(_, value)| value);
        let parsed = value.parse::<f64>().ok().filter(|value| value.is_finite());
        parsed.ok_or_else(|| file.unexpected(&format!("tag {key}"), "a number", value))
    };
    let whole = |key: &str| -> Result<usize, FormatError> {
        let value = number(key)?;
        let is_whole = (0.0..=MAX_WHOLE).contains(&value) && value.fract() == 0.0;
        if is_whole {
            return Ok(value as usize);
        }
        Err(file.unexpected(&format!("tag {key}"), "a whole number from 0 to 1e15", value.to_string()))
    };
    let [columns, rows] = [whole("Cols")?, whole("Rows")?];
    check_size(path, columns as u64, rows as u64)?;
    let (begin, mark) = (whole("DepthImageOffset")?, number("InvalidPixelValue")?);
    let end_of_tags = MAGIC.len() + TAG * count;
    if begin < end_of_tags {
        let expected = format!("an image of depths from byte {end_of_tags} on, behind the tags");
        return Err(file.unexpected("tag DepthImageOffset", &expected, begin.to_string()));
    }
    let stride = (4 * columns).div_ceil(8) * 8;
    // The padding of the last row can be missing.
    file.slice(begin, stride * (rows - 1) + 4 * columns)?;
    let height = |index: usize| {
        let value = f64::from(file.f32(begin + stride * (index / columns) + 4 * (index % columns)).ok()?);
        // The mark is written with fewer digits than a number of 32 bits has.
        (value.is_finite() && value < mark * (1.0 - 1e-6)).then_some(1e3 * value)
    };
    map_from_top(
        path,
        [columns, rows],
        ([1e3 * number("PixelSizeXMeter")?, 1e3 * number("PixelSizeYMeter")?], given_mm),
        height,
    )
}
