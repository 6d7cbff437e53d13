//! Messages of an edge node: births, changes and deaths; and the requests in a host's command.

use srad_types::constants::{BDSEQ, NODE_CONTROL_REBIRTH};
use srad_types::payload::metric::Value;
use srad_types::payload::{DataType, Message as _, Metric, Payload, PropertySet, PropertyValue, property_value};

use super::change::{Change, Values};
use crate::cell_status::now_ms;
use crate::figures::{FIGURES, Figure, FigureKind, FigureValue};

/// Encodes a Sparkplug birth certificate (NBIRTH). The message contains every figure (a quantity that the cell
/// publishes) with its value, type and properties. `values` holds the values in the order of the figures, which held at
/// the time `at_ms`, in milliseconds since 1970. `connection` is the number of the connection (bdSeq). The sequence
/// number of the message is 0.
pub(super) fn birth(values: &Values, at_ms: u64, connection: u8) -> Vec<u8> {
    let rebirth =
        Metric { value: Some(Value::BooleanValue(false)), ..plain(NODE_CONTROL_REBIRTH, DataType::Boolean, now_ms()) };
    let mut metrics = vec![number_of(connection), rebirth];
    let told = FIGURES.iter().zip(values);
    metrics.extend(
        told.map(|(figure, value)| Metric { properties: Some(properties(figure)), ..metric(figure, value, at_ms) }),
    );
    encoded(metrics, Some(0))
}

/// Encodes a Sparkplug data message (NDATA) with the values of `change` and their own time. `sequence` is the sequence
/// number of the message. `historical` is true for values that a host must not take for the present ones.
pub(super) fn data(change: &Change, sequence: u8, historical: bool) -> Vec<u8> {
    let told = change.values.iter().filter_map(|(of, value)| Some((FIGURES.get(*of)?, value)));
    let metrics = told.map(|(figure, value)| Metric {
        is_historical: historical.then_some(true),
        ..metric(figure, value, change.at_ms)
    });
    encoded(metrics.collect(), Some(sequence))
}

/// Encodes a Sparkplug death certificate (NDEATH) as bytes. This message tells host applications that the published
/// values are no longer valid. `connection` is the number of the connection that ends (bdSeq).
pub(super) fn death(connection: u8) -> Vec<u8> {
    encoded(vec![number_of(connection)], None)
}

/// Decodes `payload`, a Sparkplug command from a host application. The returned flag is true if the command requests a
/// rebirth (a new birth certificate). The returned list describes each other request in the command. If the payload is
/// not a valid command or contains no request, the flag is false, and the list contains one sentence about this error.
pub(super) fn read_requests(payload: &[u8]) -> (bool, Vec<String>) {
    let Ok(Payload { metrics, .. }) = Payload::decode(payload) else {
        return (false, vec!["a message that is not a Sparkplug B command".into()]);
    };
    let wants_birth = |metric: &Metric| {
        metric.name.as_deref() == Some(NODE_CONTROL_REBIRTH) && metric.value == Some(Value::BooleanValue(true))
    };
    let others: Vec<_> = metrics.iter().filter(|metric| !wants_birth(metric)).map(in_words).collect();
    let reborn = others.len() < metrics.len();
    let is_empty = metrics.is_empty();
    (reborn, if is_empty { vec!["a command without a metric".into()] } else { others })
}

fn in_words(metric: &Metric) -> String {
    let name = match (&metric.name, metric.alias) {
        (Some(name), _) => name.clone(),
        (None, Some(alias)) => format!("the metric {alias}"),
        (None, None) => "a metric without a name".into(),
    };
    match &metric.value {
        Some(Value::IntValue(value)) => format!("{name} = {value}"),
        Some(Value::LongValue(value)) => format!("{name} = {value}"),
        Some(Value::FloatValue(value)) => format!("{name} = {value}"),
        Some(Value::DoubleValue(value)) => format!("{name} = {value}"),
        Some(Value::BooleanValue(value)) => format!("{name} = {value}"),
        Some(Value::StringValue(value)) => format!("{name} = {value:?}"),
        Some(_) => format!("{name} = a value that is neither a number nor a text"),
        None => format!("{name} = nothing"),
    }
}

fn number_of(connection: u8) -> Metric {
    Metric { value: Some(Value::LongValue(connection.into())), ..plain(BDSEQ, DataType::Int64, now_ms()) }
}

fn metric(figure: &Figure, value: &Option<FigureValue>, at_ms: u64) -> Metric {
    let kind = match figure.kind {
        FigureKind::Whole => DataType::UInt32,
        FigureKind::Number => DataType::Double,
        FigureKind::Truth => DataType::Boolean,
        FigureKind::Text => DataType::String,
    };
    let mut metric = plain(figure.name, kind, at_ms);
    metric.value = value.as_ref().map(|value| match value {
        FigureValue::Whole(value) => Value::IntValue(*value),
        FigureValue::Number(value) => Value::DoubleValue(*value),
        FigureValue::Truth(value) => Value::BooleanValue(*value),
        FigureValue::Text(value) => Value::StringValue(value.clone()),
    });
    metric.is_null = metric.value.is_none().then_some(true);
    metric
}

fn plain(name: &str, kind: DataType, at_ms: u64) -> Metric {
    let mut metric = Metric::new();
    metric.set_name(name.to_owned()).set_datatype(kind).set_timestamp(at_ms);
    metric
}

/// Returns the Sparkplug properties that a birth certificate contains for `figure` (a quantity that the cell
/// publishes): `readOnly`, `documentation` and, if the figure has a unit, `engUnit`.
fn properties(figure: &Figure) -> PropertySet {
    let text = |text: &str| {
        let value = Some(property_value::Value::StringValue(text.to_owned()));
        PropertyValue { r#type: Some(DataType::String as u32), is_null: None, value }
    };
    let read_only = PropertyValue {
        r#type: Some(DataType::Boolean as u32),
        is_null: None,
        value: Some(property_value::Value::BooleanValue(true)),
    };
    let mut properties = PropertySet { keys: Vec::new(), values: Vec::new() };
    let unit = figure.unit.map(|unit| ("engUnit", text(unit)));
    for (key, value) in [("readOnly", read_only), ("documentation", text(figure.about))].into_iter().chain(unit) {
        properties.keys.push(key.to_owned());
        properties.values.push(value);
    }
    properties
}

fn encoded(metrics: Vec<Metric>, sequence: Option<u8>) -> Vec<u8> {
    let seq = sequence.map(u64::from);
    Payload { timestamp: Some(now_ms()), metrics, seq, uuid: None, body: None }.encode_to_vec()
}
