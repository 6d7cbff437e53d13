//! Changes of figures: what an edge node publishes, now or later.

use serde_json::{Map, Value as Json, json};

use crate::figures::{FIGURES, Figure, FigureKind, FigureValue};

/// Values of the figures, in their order.
pub(super) type Values = Vec<Option<FigureValue>>;

/// Figures that changed at one time.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Change {
    /// Time of the change, in milliseconds since 1970 in UTC.
    pub(super) at_ms: u64,
    /// Changed figures: the place of each in the list of figures, and its new value.
    pub(super) values: Vec<(usize, Option<FigureValue>)>,
}

impl Change {
    /// Returns the change from the values `before` to the values `now`, at the time `at_ms`. Returns `None` if no value
    /// differs.
    pub(super) fn between(before: &Values, now: &Values, at_ms: u64) -> Option<Self> {
        let changed = now.iter().zip(before).enumerate().filter(|(_, (now, before))| now != before);
        let values: Vec<_> = changed.map(|(of, (now, _))| (of, now.clone())).collect();
        (!values.is_empty()).then_some(Self { at_ms, values })
    }

    /// Returns the change as JSON: its time, and an object with the names and values of the figures.
    pub(super) fn to_json(&self) -> Json {
        let named =
            self.values.iter().filter_map(|(of, value)| Some((FIGURES.get(*of)?.name.to_owned(), json_of(value))));
        json!({ "at_ms": self.at_ms, "values": named.collect::<Map<_, _>>() })
    }

    /// Returns the change that [`Self::to_json`] has written. Returns `None` if the JSON has another form, a figure that
    /// does not exist, or a value of another kind.
    pub(super) fn from_json(json: &Json) -> Option<Self> {
        let named = json["values"].as_object()?.iter().map(|(name, value)| {
            let of = FIGURES.iter().position(|figure| figure.name == name)?;
            Some((of, value_of(&FIGURES[of], value)?))
        });
        let values: Vec<_> = named.collect::<Option<_>>()?;
        (!values.is_empty()).then_some(Self { at_ms: json["at_ms"].as_u64()?, values })
    }
}

fn json_of(value: &Option<FigureValue>) -> Json {
    match value {
        None => Json::Null,
        Some(FigureValue::Whole(value)) => json!(value),
        Some(FigureValue::Number(value)) => json!(value),
        Some(FigureValue::Truth(value)) => json!(value),
        Some(FigureValue::Text(value)) => json!(value),
    }
}

fn value_of(figure: &Figure, json: &Json) -> Option<Option<FigureValue>> {
    if json.is_null() {
        return Some(None);
    }
    let value = match figure.kind {
        FigureKind::Whole => FigureValue::Whole(u32::try_from(json.as_u64()?).ok()?),
        FigureKind::Number => FigureValue::Number(json.as_f64()?),
        FigureKind::Truth => FigureValue::Truth(json.as_bool()?),
        FigureKind::Text => FigureValue::Text(json.as_str()?.to_owned()),
    };
    Some(Some(value))
}
