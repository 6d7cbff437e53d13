//! Serialization of a number that can be missing or not finite. JSON has no NaN and no infinity, so these values are
//! recorded as text. A replay then reads the recorded value.
//!
//! For a field of a struct: `#[serde(with = "regrind_figures::number")]`.

use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Number as it is recorded.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum RecordedNumber {
    Number(f64),
    Word(String),
    /// NaN in records of earlier versions.
    Nothing(()),
}

impl RecordedNumber {
    fn new(value: f64) -> Self {
        if value.is_finite() { Self::Number(value) } else { Self::Word(value.to_string()) }
    }

    fn into_value<E: Error>(self) -> Result<f64, E> {
        match self {
            Self::Number(value) => Ok(value),
            Self::Word(word) => word.parse().map_err(|_| E::custom(format!("{word:?} is not a number"))),
            Self::Nothing(()) => Ok(f64::NAN),
        }
    }
}

/// Serializes a number.
///
/// # Errors
/// The error of the serializer.
pub fn serialize<S: Serializer>(value: &f64, to: S) -> Result<S::Ok, S::Error> {
    RecordedNumber::new(*value).serialize(to)
}

/// Deserializes a number. The value `null` becomes NaN.
///
/// # Errors
/// A value that is not a number in a known form.
pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    RecordedNumber::deserialize(from)?.into_value()
}

/// Serialization of a number that can be missing.
pub mod optional {
    use super::{Deserialize, Deserializer, RecordedNumber, Serialize, Serializer};

    /// Serializes a number that can be missing.
    ///
    /// # Errors
    /// The error of the serializer.
    pub fn serialize<S: Serializer>(value: &Option<f64>, to: S) -> Result<S::Ok, S::Error> {
        value.map(RecordedNumber::new).serialize(to)
    }

    /// Deserializes a number that can be missing.
    ///
    /// # Errors
    /// A value that is not a number in a known form.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<f64>, D::Error> {
        Option::<RecordedNumber>::deserialize(from)?.map(RecordedNumber::into_value).transpose()
    }
}

/// Deserializes a limit. The value `null` becomes an infinite limit (no limit), because JSON has no infinity.
///
/// # Errors
/// A value that is not a number in a known form.
pub fn limit<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Option::<RecordedNumber>::deserialize(from)?.map_or(Ok(f64::INFINITY), RecordedNumber::into_value)
}

/// Serialization of pairs of numbers.
pub mod pairs {
    use super::{Deserialize, Deserializer, RecordedNumber, Serialize, Serializer};

    /// Serializes pairs of numbers.
    ///
    /// # Errors
    /// The error of the serializer.
    pub fn serialize<S: Serializer>(pairs: &[[f64; 2]], to: S) -> Result<S::Ok, S::Error> {
        let recorded: Vec<_> = pairs.iter().map(|pair| pair.map(RecordedNumber::new)).collect();
        recorded.serialize(to)
    }

    /// Deserializes pairs of numbers.
    ///
    /// # Errors
    /// A value that is not a number in a known form.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<[f64; 2]>, D::Error> {
        let recorded = Vec::<[RecordedNumber; 2]>::deserialize(from)?;
        recorded.into_iter().map(|[a, b]| Ok([a.into_value()?, b.into_value()?])).collect()
    }
}
