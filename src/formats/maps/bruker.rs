//! Maps of Bruker (`.opdx`): a tree of named items. The heights are in `/2D_Data/NAME/Matrix`, f32, the top row first,
//! with the extents and the scale beside it.

use std::ops::Range;
use std::path::Path;

use super::super::error::FormatError;
use super::super::height_map::{HeightMap, MapFormat, check_size};
use super::{Bytes, MARK, checked_factor, length_mm, map_from_top};

const MAGIC: &[u8] = b"VCA DATA\x01\x00\x00\x55";
const MAX_DEPTH: usize = 32;
const MAX_ITEMS: usize = 1_000_000;
/// Largest number of items that are kept. A map has eight.
const MAX_USED_ITEMS: usize = 10_000;
/// Longest name of an item or a type, in bytes. The path of an item repeats the names of the containers around it.
const MAX_NAME: usize = 256;
/// Depth of the containers in which items are used.
const USED_DEPTH: usize = 2;
/// Names of the items that are used. Other items are not kept, so that a file of many items needs little memory.
const USED: [&str; 8] = [
    "DataKind",
    "PrimaryData2D",
    "Matrix",
    "Dimension1Points",
    "Dimension2Points",
    "Dimension1Extent",
    "Dimension2Extent",
    "DataScale",
];

/// Format of Bruker, detected by its first bytes.
pub(in super::super) const FORMAT: MapFormat = MapFormat {
    begins: |head| head.starts_with(MAGIC),
    parse: |path, bytes, given_mm| parse_bruker(path, bytes, given_mm).map(Into::into),
};

/// Value of an item that is used.
enum Value {
    Text(String),
    Quantity {
        value: f64,
        symbol: String,
    },
    /// Matrix of f32: columns, rows, and its bytes in the file.
    Matrix {
        size: [usize; 2],
        bytes: Range<usize>,
    },
    /// Whole number of 32 bits.
    Whole(i64),
}

struct Reader<'a> {
    file: Bytes<'a>,
    at: usize,
    items: Vec<(String, Value)>,
    count: usize,
    /// Whether the item that is read is used.
    is_used: bool,
}

fn parse_bruker(path: &Path, bytes: &[u8], given_mm: Option<f64>) -> Result<HeightMap, FormatError> {
    let file = Bytes { path, bytes };
    let mut reader = Reader { file, at: MAGIC.len(), items: Vec::new(), count: 0, is_used: false };
    reader.read_items("", bytes.len(), 0)?;
    let item = |name: &str| reader.items.iter().find(|(path, _)| path == name).map(|(_, value)| value);
    let text = |name: &str| match item(name) {
        Some(Value::Text(text)) => Some(text.as_str()),
        _ => None,
    };
    if let Some(kind) = text("/MetaData/DataKind").filter(|kind| *kind != "Surface Height") {
        return Err(file.unexpected("/MetaData/DataKind", "Surface Height", kind));
    }
    let primary = text("/MetaData/PrimaryData2D").unwrap_or("Raw");
    let name = |key: &str| format!("/2D_Data/{primary}/{key}");
    let Some(Value::Matrix { size: [columns, rows], bytes: matrix }) = item(&name("Matrix")) else {
        return Err(file.unexpected(&name("Matrix"), "a matrix of heights", "none"));
    };
    let (columns, rows, begin) = (*columns, *rows, matrix.start);
    check_size(path, columns as u64, rows as u64)?;
    if matrix.len() != 4 * columns * rows {
        let expected = format!("{} bytes, as {columns} columns and {rows} rows have", 4 * columns * rows);
        return Err(file.unexpected(&name("Matrix"), &expected, format!("{} bytes", matrix.len())));
    }
    for (key, count) in [("Dimension1Points", rows), ("Dimension2Points", columns)] {
        match item(&name(key)) {
            Some(Value::Whole(stated)) if *stated != count as i64 => {
                let expected = format!("{count} points, as the matrix has");
                return Err(file.unexpected(&name(key), &expected, stated.to_string()));
            }
            _ => {}
        }
    }
    let quantity_mm = |key: &str| match item(&name(key)) {
        Some(Value::Quantity { value, symbol }) => {
            let unit = length_mm(symbol).ok_or_else(|| file.unexpected(&name(key), "a unit of length", symbol))?;
            Ok(unit * checked_factor(path, &name(key), "a quantity", *value)?)
        }
        _ => Err(file.unexpected(&name(key), "a quantity", "none")),
    };
    if columns < 2 || rows < 2 {
        // An extent of 0 says nothing of the distance of samples.
        return Err(file.unexpected(
            &name("Matrix"),
            "two columns and two rows, or more",
            format!("{columns} x {rows}"),
        ));
    }
    // Extents are from the first sample to the last.
    let pitch = |key: &str, count: usize| Ok(quantity_mm(key)? / (count - 1) as f64);
    let spacing_mm = [pitch("Dimension2Extent", columns)?, pitch("Dimension1Extent", rows)?];
    let scale_mm = quantity_mm("DataScale")?;
    map_from_top(path, [columns, rows], (spacing_mm, given_mm), |index| {
        let value = f64::from(file.f32(begin + 4 * index).ok()?);
        (value.abs() < MARK).then_some(value * scale_mm)
    })
}

impl Reader<'_> {
    /// Reads items up to `end`. `parent` is the path of the container.
    fn read_items(&mut self, parent: &str, end: usize, depth: usize) -> Result<(), FormatError> {
        if depth > MAX_DEPTH {
            return Err(self.file.unexpected(parent, "containers to a depth of 32", "deeper ones"));
        }
        while self.at < end {
            self.count += 1;
            if self.count > MAX_ITEMS {
                return Err(self.file.unexpected(parent, "at most 1000000 items", "more"));
            }
            let name = self.name()?;
            self.is_used = depth <= USED_DEPTH && USED.contains(&name.as_str());
            let name = format!("{parent}/{name}");
            let kind = self.byte()?;
            // The end of a container.
            if kind == 0x7f {
                self.at = end;
                return Ok(());
            }
            self.read_value(&name, kind, depth)?;
        }
        Ok(())
    }

    fn read_value(&mut self, name: &str, kind: u8, depth: usize) -> Result<(), FormatError> {
        match kind {
            0x01 => self.skip(1),
            0x04 | 0x05 => self.skip(2),
            0x06 | 0x07 => {
                let whole = if kind == 0x06 { self.file.i32(self.at)?.into() } else { self.file.u32(self.at)?.into() };
                self.keep(name, Value::Whole(whole))?;
                self.skip(4)
            }
            0x0c => self.skip(4),
            0x0a | 0x0b | 0x0d => self.skip(8),
            0x12 => {
                let length = self.length()?;
                let text = self.file.slice(self.at, length)?;
                self.keep(name, Value::Text(String::from_utf8_lossy(text).into_owned()))?;
                self.skip(length)
            }
            0x13 => {
                let end = self.end()?;
                let value = self.file.f64(self.at)?;
                self.at += 8;
                self.name()?;
                let symbol = self.name()?;
                self.keep(name, Value::Quantity { value, symbol })?;
                self.at = end;
                Ok(())
            }
            0x15 => self.skip(9),
            0x18 => self.skip_to_end(),
            0x0e | 0x40 | 0x42 | 0x7c => {
                self.name()?;
                self.skip_to_end()
            }
            0x00 | 0x45 => {
                self.name()?;
                if kind == 0x00 {
                    self.skip(4)?;
                    self.name()?;
                }
                let end = self.end()?;
                let [rows, columns] = [self.file.u32(self.at)? as usize, self.file.u32(self.at + 4)? as usize];
                let bytes = (self.at + 8).min(end)..end;
                self.keep(name, Value::Matrix { size: [columns, rows], bytes })?;
                self.at = end;
                Ok(())
            }
            0x46 | 0x47 | 0x7d => {
                let end = self.end()?;
                self.read_items(name, end, depth + 1)
            }
            other => Err(self.file.unexpected(name, "a known type of item", format!("type {other:#04x}"))),
        }
    }

    fn byte(&mut self) -> Result<u8, FormatError> {
        let byte = self.file.slice(self.at, 1)?[0];
        self.at += 1;
        Ok(byte)
    }

    fn skip(&mut self, length: usize) -> Result<(), FormatError> {
        self.file.slice(self.at, length)?;
        self.at += length;
        Ok(())
    }

    /// Keeps the value of an item that is used.
    fn keep(&mut self, name: &str, value: Value) -> Result<(), FormatError> {
        if !self.is_used {
            return Ok(());
        }
        if self.items.len() == MAX_USED_ITEMS {
            return Err(self.file.unexpected(name, "at most 10000 items of maps", "more"));
        }
        self.items.push((name.to_owned(), value));
        Ok(())
    }

    fn name(&mut self) -> Result<String, FormatError> {
        let length = self.file.u32(self.at)? as usize;
        if length > MAX_NAME {
            let place = format!("byte {}", self.at);
            return Err(self.file.unexpected(&place, "a name of at most 256 bytes", length.to_string()));
        }
        let name = self.file.slice(self.at.saturating_add(4), length)?;
        self.at += 4 + length;
        Ok(String::from_utf8_lossy(name).into_owned())
    }

    /// Reads a length, whose own size stands before it.
    fn length(&mut self) -> Result<usize, FormatError> {
        let size = self.byte()?;
        let length = match size {
            1 => usize::from(self.file.slice(self.at, 1)?[0]),
            2 => usize::from(self.file.u16(self.at)?),
            4 => self.file.u32(self.at)? as usize,
            other => {
                let place = format!("byte {}", self.at);
                return Err(self.file.unexpected(&place, "a length of 1, 2 or 4 bytes", other.to_string()));
            }
        };
        self.at += usize::from(size);
        Ok(length)
    }

    /// Reads a length, and returns where it ends.
    fn end(&mut self) -> Result<usize, FormatError> {
        let length = self.length()?;
        self.file.slice(self.at, length)?;
        Ok(self.at + length)
    }

    fn skip_to_end(&mut self) -> Result<(), FormatError> {
        self.at = self.end()?;
        Ok(())
    }
}
