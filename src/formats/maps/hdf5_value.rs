//! Values of attributes and tables in HDF5 files, also compound ones.

use hdf5_reader::group::Group;
use hdf5_reader::messages::datatype::{StringSize, VarLenKind};
use hdf5_reader::{Attribute, ByteOrder, Dataset, Datatype};

/// Largest number of values of one attribute or table that is decoded, with those within lists and records.
const MAX_VALUES: usize = 100_000;

/// Largest number of bytes of all texts, lists and names of members of one attribute or table.
const MAX_CONTENT_BYTES: usize = 16 << 20;

/// Value of an attribute, or of a cell of a table.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    Number(f64),
    Text(String),
    List(Vec<Value>),
    /// Members of a compound by their names.
    Record(Vec<(String, Value)>),
    Other,
}

impl Value {
    /// Returns the number, or the first of a list.
    pub(super) fn number(&self) -> Option<f64> {
        match self {
            Self::Number(number) => Some(*number),
            Self::List(list) => list.first().and_then(Self::number),
            _ => None,
        }
    }

    pub(super) fn text(&self) -> Option<&str> {
        match self {
            Self::Text(text) => Some(text),
            Self::List(list) => list.first().and_then(Self::text),
            _ => None,
        }
    }

    pub(super) fn member(&self, name: &str) -> Option<&Self> {
        match self {
            Self::Record(members) => members.iter().find(|(key, _)| key == name).map(|(_, value)| value),
            Self::List(list) => list.first().and_then(|first| first.member(name)),
            _ => None,
        }
    }
}

/// Decodes an attribute.
pub(super) fn attribute(attribute: &Attribute, group: &Group) -> Result<Value, String> {
    let is_text =
        matches!(attribute.datatype, Datatype::VarLen { kind: VarLenKind::String, .. } | Datatype::String { .. });
    if is_text {
        // The crate resolves texts of variable length in different ways; this one covers all.
        let texts = attribute.read_strings().map_err(|error| error.to_string())?;
        let texts = texts.into_iter().map(|text| Value::Text(text.trim_end_matches(['\0', ' ']).to_owned()));
        return Ok(Value::List(texts.take(MAX_VALUES).collect()));
    }
    Decoder::new(group).elements(&attribute.datatype, &attribute.raw_data).map(Value::List)
}

/// Decodes a table, an element a row.
pub(super) fn table(dataset: &Dataset, group: &Group) -> Result<Vec<Value>, String> {
    let bytes = dataset.read_raw_bytes().map_err(|error| error.to_string())?;
    Decoder::new(group).elements(dataset.dtype(), &bytes)
}

/// Returns all numbers of a dataset as f64.
pub(super) fn numbers(dataset: &Dataset) -> Result<Vec<f64>, String> {
    let words = |error: hdf5_reader::error::Error| error.to_string();
    Ok(match dataset.dtype() {
        Datatype::FloatingPoint { size: 4, .. } => {
            dataset.read_array::<f32>().map_err(words)?.iter().map(|&value| f64::from(value)).collect()
        }
        Datatype::FloatingPoint { size: 8, .. } => {
            dataset.read_array::<f64>().map_err(words)?.iter().copied().collect()
        }
        Datatype::FixedPoint { size: 4, signed: true, .. } => {
            dataset.read_array::<i32>().map_err(words)?.iter().map(|&value| f64::from(value)).collect()
        }
        other => return Err(format!("heights of the type {other:?}")),
    })
}

/// Returns the bytes of an element in the file.
fn size_of(datatype: &Datatype, reference: usize) -> usize {
    match datatype {
        Datatype::FixedPoint { size, .. }
        | Datatype::FloatingPoint { size, .. }
        | Datatype::Bitfield { size, .. }
        | Datatype::Reference { size, .. } => usize::from(*size),
        Datatype::String { size: StringSize::Fixed(size), .. } => *size as usize,
        Datatype::String { size: StringSize::Variable, .. } | Datatype::VarLen { .. } => reference,
        Datatype::Compound { size, .. } | Datatype::Opaque { size, .. } => *size as usize,
        Datatype::Array { base, dims } => {
            dims.iter().fold(size_of(base, reference), |size, &count| size.saturating_mul(count as usize))
        }
        Datatype::Enum { base, .. } => size_of(base, reference),
    }
}

/// Decoder of one attribute or table. Different values can refer to the same bytes of the file, so that its length bounds
/// neither their number nor their bytes.
struct Decoder<'a> {
    group: &'a Group,
    /// Bytes of a reference to a value of variable length: its length, and where it is.
    reference: usize,
    /// Values, and bytes of contents, that may still be decoded.
    values: usize,
    content_bytes: usize,
}

impl<'a> Decoder<'a> {
    fn new(group: &'a Group) -> Self {
        let reference = 8 + usize::from(group.offset_size());
        Self { group, reference, values: MAX_VALUES, content_bytes: MAX_CONTENT_BYTES }
    }

    fn elements(&mut self, datatype: &Datatype, bytes: &[u8]) -> Result<Vec<Value>, String> {
        let size = size_of(datatype, self.reference);
        if size == 0 {
            return Ok(Vec::new());
        }
        bytes.chunks_exact(size).map(|element| self.decoded(datatype, element, 0)).collect()
    }

    fn count_bytes(&mut self, count: usize) -> Result<(), String> {
        let left = self.content_bytes.checked_sub(count);
        self.content_bytes = left.ok_or_else(|| format!("more than {MAX_CONTENT_BYTES} bytes of texts and lists"))?;
        Ok(())
    }

    /// Returns the bytes that a reference leads to: its count of elements of `size` bytes.
    fn resolved(&mut self, reference: &[u8], size: usize) -> Result<Vec<u8>, String> {
        let bytes = self.group.resolve_vlen_reference_bytes(reference, size).map_err(|error| error.to_string())?;
        self.count_bytes(bytes.len())?;
        Ok(bytes)
    }

    fn decoded(&mut self, datatype: &Datatype, bytes: &[u8], depth: usize) -> Result<Value, String> {
        const MAX_DEPTH: usize = 16;
        let size = size_of(datatype, self.reference);
        // The places of members are not checked when a file is opened: a damaged one can name any.
        let bytes = bytes.get(..size).filter(|_| depth < MAX_DEPTH).ok_or("a value beyond the end of its element")?;
        self.values = self.values.checked_sub(1).ok_or_else(|| format!("more than {MAX_VALUES} values"))?;
        Ok(match datatype {
            Datatype::FixedPoint { signed, byte_order, .. } => {
                Value::Number(integer(bytes, *signed, is_big(byte_order)))
            }
            Datatype::FloatingPoint { byte_order, .. } => {
                let mut raw = bytes.to_vec();
                if is_big(byte_order) {
                    raw.reverse();
                }
                match raw[..] {
                    [a, b, c, d] => Value::Number(f64::from(f32::from_le_bytes([a, b, c, d]))),
                    [a, b, c, d, e, f, g, h] => Value::Number(f64::from_le_bytes([a, b, c, d, e, f, g, h])),
                    _ => Value::Other,
                }
            }
            Datatype::String { size: StringSize::Fixed(_), .. } => {
                self.count_bytes(bytes.len())?;
                Value::Text(text(bytes))
            }
            Datatype::String { size: StringSize::Variable, .. } | Datatype::VarLen { kind: VarLenKind::String, .. } => {
                Value::Text(text(&self.resolved(bytes, 1)?))
            }
            Datatype::VarLen { base, .. } => {
                let size = size_of(base, self.reference).max(1);
                let bytes = self.resolved(bytes, size)?;
                let values = bytes.chunks_exact(size).map(|part| self.decoded(base, part, depth + 1));
                Value::List(values.collect::<Result<_, _>>()?)
            }
            Datatype::Array { base, .. } => {
                let size = size_of(base, self.reference).max(1);
                let values = bytes.chunks_exact(size).map(|part| self.decoded(base, part, depth + 1));
                Value::List(values.collect::<Result<_, _>>()?)
            }
            Datatype::Compound { fields, .. } => {
                let mut member = |field: &hdf5_reader::messages::datatype::CompoundField| {
                    let part =
                        bytes.get(field.byte_offset as usize..).ok_or("a member beyond the end of its compound")?;
                    self.count_bytes(field.name.len())?;
                    Ok::<_, String>((field.name.clone(), self.decoded(&field.datatype, part, depth + 1)?))
                };
                Value::Record(fields.iter().map(&mut member).collect::<Result<_, _>>()?)
            }
            Datatype::Enum { base, .. } => self.decoded(base, bytes, depth + 1)?,
            _ => Value::Other,
        })
    }
}

fn is_big(order: &ByteOrder) -> bool {
    *order == ByteOrder::BigEndian
}

fn integer(bytes: &[u8], is_signed: bool, is_big: bool) -> f64 {
    let mut raw = bytes.to_vec();
    if is_big {
        raw.reverse();
    }
    let is_negative = is_signed && raw.last().is_some_and(|last| last & 0x80 != 0);
    let mut wide = [if is_negative { 0xff } else { 0 }; 8];
    let count = raw.len().min(8);
    wide[..count].copy_from_slice(&raw[..count]);
    if is_signed { i64::from_le_bytes(wide) as f64 } else { u64::from_le_bytes(wide) as f64 }
}

fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|&b| b == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).trim_end().to_owned()
}

#[cfg(test)]
mod tests {
    use hdf5_reader::Hdf5File;
    use hdf5_reader::messages::datatype::CompoundField;

    use super::*;

    /// Members of a record that lie over each other make more values, or names, than the element has bytes.
    #[test]
    fn overlapping_members_are_bounded() {
        let bytes = include_bytes!("../tests/fixtures/maps/datx-earliest-contiguous-fringes.datx");
        let file = Hdf5File::from_bytes(bytes).unwrap();
        let root = file.root_group().unwrap();
        let decode = |count: usize, values: u64, name: &str| {
            let number = Datatype::FixedPoint { size: 1, signed: false, byte_order: ByteOrder::LittleEndian };
            let datatype = Datatype::Array { base: Box::new(number), dims: vec![values] };
            let member = CompoundField { name: name.to_owned(), byte_offset: 0, datatype };
            let record = Datatype::Compound { size: 200, fields: vec![member; count] };
            Decoder::new(&root).elements(&record, &[7; 200])
        };
        let Ok(rows) = decode(400, 200, "a") else { panic!("80801 values") };
        assert_eq!(rows[0].member("a").and_then(Value::number), Some(7.0));
        assert!(decode(600, 200, "a").is_err(), "120001 values");
        let name = "x".repeat(1 << 20);
        assert!(decode(15, 1, &name).is_ok() && decode(17, 1, &name).is_err());
    }
}
