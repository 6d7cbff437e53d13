//! Values of attributes and tables in HDF5 files, also compound ones.

use hdf5_reader::group::Group;
use hdf5_reader::messages::datatype::{StringSize, VarLenKind};
use hdf5_reader::{Attribute, ByteOrder, Dataset, Datatype};

/// Largest number of values of one attribute or table that is decoded.
const MAX_VALUES: usize = 100_000;

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
    elements(&attribute.datatype, &attribute.raw_data, group).map(Value::List)
}

/// Decodes a table, an element a row.
pub(super) fn table(dataset: &Dataset, group: &Group) -> Result<Vec<Value>, String> {
    let bytes = dataset.read_raw_bytes().map_err(|error| error.to_string())?;
    elements(dataset.dtype(), &bytes, group)
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

fn elements(datatype: &Datatype, bytes: &[u8], group: &Group) -> Result<Vec<Value>, String> {
    let size = size_of(datatype, reference_size(group));
    if size == 0 {
        return Ok(Vec::new());
    }
    bytes.chunks_exact(size).take(MAX_VALUES).map(|element| decoded(datatype, element, group, 0)).collect()
}

/// Returns the bytes of a reference to a value of variable length: its length, and where it is.
fn reference_size(group: &Group) -> usize {
    8 + usize::from(group.offset_size())
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

fn decoded(datatype: &Datatype, bytes: &[u8], group: &Group, depth: usize) -> Result<Value, String> {
    const MAX_DEPTH: usize = 16;
    let reference = reference_size(group);
    let size = size_of(datatype, reference);
    // The places of members are not checked when a file is opened: a damaged one can name any.
    let bytes = bytes.get(..size).filter(|_| depth < MAX_DEPTH).ok_or("a value beyond the end of its element")?;
    let resolved = |size: usize| group.resolve_vlen_reference_bytes(bytes, size).map_err(|error| error.to_string());
    Ok(match datatype {
        Datatype::FixedPoint { signed, byte_order, .. } => Value::Number(integer(bytes, *signed, is_big(byte_order))),
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
        Datatype::String { size: StringSize::Fixed(_), .. } => Value::Text(text(bytes)),
        Datatype::String { size: StringSize::Variable, .. } | Datatype::VarLen { kind: VarLenKind::String, .. } => {
            Value::Text(text(&resolved(1)?))
        }
        Datatype::VarLen { base, .. } => {
            let size = size_of(base, reference).max(1);
            let bytes = resolved(size)?;
            let values = bytes.chunks_exact(size).take(MAX_VALUES).map(|part| decoded(base, part, group, depth + 1));
            Value::List(values.collect::<Result<_, _>>()?)
        }
        Datatype::Array { base, .. } => {
            let size = size_of(base, reference).max(1);
            let values = bytes.chunks_exact(size).take(MAX_VALUES).map(|part| decoded(base, part, group, depth + 1));
            Value::List(values.collect::<Result<_, _>>()?)
        }
        Datatype::Compound { fields, .. } => {
            let member = |field: &hdf5_reader::messages::datatype::CompoundField| {
                let part = bytes.get(field.byte_offset as usize..).ok_or("a member beyond the end of its compound")?;
                Ok::<_, String>((field.name.clone(), decoded(&field.datatype, part, group, depth + 1)?))
            };
            Value::Record(fields.iter().map(member).collect::<Result<_, _>>()?)
        }
        Datatype::Enum { base, .. } => decoded(base, bytes, group, depth + 1)?,
        _ => Value::Other,
    })
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
