//! Content of the records that the journal itself writes: begin, reopen and end. [`super::Artefact`] and
//! [`super::Seal`] are the content of the two others.
//!
//! A reader gets each field by itself: a field that is missing or has another type is `None`, and the others are read.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::Value;

use super::key::{AuditKey, PublicKey};
use super::record::Record;

/// Content of the first record of a run. `C` is the content that the program which began the run added.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(bound(deserialize = "C: DeserializeOwned + Default"))]
pub struct Begin<C = Value> {
    /// Name of the run.
    #[serde(default, deserialize_with = "or_none")]
    pub run: Option<String>,
    /// True if any machine of the cell is simulated.
    #[serde(default, deserialize_with = "or_none")]
    pub simulation: Option<bool>,
    /// Number of the first command.
    #[serde(default, deserialize_with = "or_none")]
    pub first_command_id: Option<u32>,
    /// Content that the program which began the run added.
    #[serde(default)]
    pub content: C,
    /// Version of the program.
    #[serde(default, deserialize_with = "or_none")]
    pub regrind: Option<String>,
    /// Key that signs the records; `None` if they are not signed. Layout 1 of the database has no key.
    #[serde(default)]
    pub key: Option<KeyField>,
}

/// Content of the record of a further opening of the journal.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Reopen {
    /// Version of the program.
    #[serde(default, deserialize_with = "or_none")]
    pub regrind: Option<String>,
    /// Key that signs the records that follow; `None` if they are not signed.
    #[serde(default)]
    pub key: Option<KeyField>,
}

/// Content of the last record of a run. `E` is the result of the run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(bound(deserialize = "E: DeserializeOwned + Default"))]
pub struct End<E = Value> {
    /// Result of the run.
    #[serde(default)]
    pub ending: E,
    /// Number of records before this one.
    #[serde(default, deserialize_with = "or_none")]
    pub records_before: Option<u64>,
    /// Hash of the record before this one.
    #[serde(default, deserialize_with = "or_none")]
    pub head_before: Option<String>,
}

/// Public key as a record names it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum KeyField {
    /// Valid public key.
    Key(PublicKey),
    /// Anything else. The record is then not valid.
    Invalid(Value),
}

impl KeyField {
    /// Returns the public key that belongs to `key`, as a record names it.
    pub(super) fn new(key: &AuditKey) -> Self {
        Self::Key(key.public())
    }
}

impl<C: DeserializeOwned + Default> Begin<C> {
    /// Reads the content of the first record of a run. Returns `None` if the payload is not a JSON object, or if
    /// `content` cannot be read.
    pub fn read(record: &Record) -> Option<Self> {
        read_object(record)
    }
}

impl Reopen {
    /// Reads the two fields of a further opening from a record of this kind, or from the first record of a run.
    /// Returns `None` if the payload is not a JSON object.
    pub(super) fn read(record: &Record) -> Option<Self> {
        read_object(record)
    }
}

/// Reads the payload of a record. Returns `None` if it is not a JSON object, or lacks a field that `T` requires. serde
/// alone would also read a struct from a list.
fn read_object<T: DeserializeOwned>(record: &Record) -> Option<T> {
    Some(record.value()).filter(Value::is_object).and_then(|value| serde_json::from_value(value).ok())
}

/// Reads the payload of a record, which must be a JSON object in which no field of `T` stands twice.
pub(super) fn read_unique<T: DeserializeOwned>(record: &Record) -> Option<T> {
    if record.value().is_object() { serde_json::from_str(&record.payload).ok() } else { None }
}

/// Deserializes a field. The result is `None` if the field has another type.
///
/// # Errors
/// The input is not valid.
pub fn or_none<'de, T: DeserializeOwned, D: Deserializer<'de>>(deserializer: D) -> Result<Option<T>, D::Error> {
    Ok(serde_json::from_value(Value::deserialize(deserializer)?).ok())
}
