//! Serialization of a number that can be missing or not finite. JSON has no NaN and no infinity, so these values are
//! recorded as text. A replay then reads the recorded value.

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

pub(super) fn serialize<S: Serializer>(value: &f64, to: S) -> Result<S::Ok, S::Error> {
    RecordedNumber::new(*value).serialize(to)
}

pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    RecordedNumber::deserialize(from)?.into_value()
}

/// Serialization of a number that can be missing.
pub(super) mod optional {
    use super::{Deserialize, Deserializer, RecordedNumber, Serialize, Serializer};

    pub(in super::super) fn serialize<S: Serializer>(value: &Option<f64>, to: S) -> Result<S::Ok, S::Error> {
        value.map(RecordedNumber::new).serialize(to)
    }

    pub(in super::super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<f64>, D::Error> {
        Option::<RecordedNumber>::deserialize(from)?.map(RecordedNumber::into_value).transpose()
    }
}

/// Deserializes a limit. The value `null` becomes an infinite limit (no limit), because JSON has no infinity. Returns
/// an error if the value is not a number in a known form.
pub(super) fn limit<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Option::<RecordedNumber>::deserialize(from)?.map_or(Ok(f64::INFINITY), RecordedNumber::into_value)
}

/// Serialization of pairs of numbers.
pub(super) mod pairs {
    use super::{Deserialize, Deserializer, RecordedNumber, Serialize, Serializer};

    pub(in super::super) fn serialize<S: Serializer>(pairs: &[[f64; 2]], to: S) -> Result<S::Ok, S::Error> {
        let recorded: Vec<_> = pairs.iter().map(|pair| pair.map(RecordedNumber::new)).collect();
        recorded.serialize(to)
    }

    pub(in super::super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<[f64; 2]>, D::Error> {
        let recorded = Vec::<[RecordedNumber; 2]>::deserialize(from)?;
        recorded.into_iter().map(|[a, b]| Ok([a.into_value()?, b.into_value()?])).collect()
    }
}

#[cfg(test)]
mod tests {
    use crate::event::{Event, Figures};
    use crate::table::sample_events;

    #[test]
    fn event_serde_round_trip() {
        let recorded = |event: &Event| serde_json::to_string(event).unwrap();
        for event in sample_events(3) {
            let text = recorded(&event);
            let back: Event = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{text}: {error}"));
            assert_eq!(recorded(&back), text);
        }
        for (value, stands) in [(f64::NAN, "\"NaN\""), (f64::INFINITY, "\"inf\""), (-0.1, "-0.1"), (5e-324, "5e-324")] {
            let text = recorded(&Event::Qualified { cycle: 1, radius_error_mm: value });
            assert!(text.contains(&format!(":{stands}")), "{text}");
            let Ok(Event::Qualified { radius_error_mm: back, .. }) = serde_json::from_str(&text) else { panic!() };
            assert!(back == value || back.is_nan() && value.is_nan());
        }
        let old = r#"{"event":"qualified","cycle":1,"radius_error_mm":null}"#;
        let Ok(Event::Qualified { radius_error_mm, .. }) = serde_json::from_str(old) else { panic!() };
        assert!(radius_error_mm.is_nan());
        assert!(serde_json::from_str::<Event>(&old.replace("null", "\"much\"")).is_err());
    }

    #[test]
    fn figures_none_and_nan_round_trip() {
        let Some(Event::Registered { figures, .. }) =
            sample_events(1).into_iter().find(|event| matches!(event, Event::Registered { .. }))
        else {
            panic!("there is one")
        };
        for removed_mm in [None, Some(f64::NAN), Some(0.25)] {
            let text = serde_json::to_string(&Figures { removed_mm, ..figures.clone() }).unwrap();
            let back: Figures = serde_json::from_str(&text).unwrap();
            assert_eq!(format!("{:?}", back.removed_mm), format!("{removed_mm:?}"));
        }
    }
}
