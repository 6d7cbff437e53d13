//! JSON schema of a kind of file, generated from the structs that it is deserialized into.

use schemars::generate::SchemaSettings;
use schemars::transform::{RecursiveTransform, Transform};
use schemars::{JsonSchema, Schema};
use serde_json::Value;

/// Returns the JSON schema of the settings file that is deserialized into `File`. Optional and required keys are
/// treated as follows:
///
/// - An optional key is an `Option`. TOML has no null, so null is removed from the types of the key.
/// - A required key is added to the list of required keys. In `File` it also has a default, so that a missing key is
///   reported with all other problems. Such a key is marked by the default NaN, which JSON writes as null, or by
///   `x-required`.
pub fn schema_of<File: JsonSchema>() -> Value {
    let settings = SchemaSettings::draft2020_12().with(|settings| settings.inline_subschemas = true);
    let mut schema = settings.into_generator().into_root_schema_for::<File>();
    RecursiveTransform(tidy).transform(&mut schema);
    schema.to_value()
}

fn tidy(schema: &mut Schema) {
    without_null(schema);
    // The keys of a table have their own defaults.
    if schema.get("default").is_some_and(|default| default.is_null() || default.is_object()) {
        schema.remove("default");
    }
    schema.remove("format");
    schema.remove("title");
    let Some(properties) = schema.get("properties").and_then(Value::as_object) else { return };
    // The schema of an `Option` lists more than one type, so it is not matched here.
    let is_nan = |value: &Value| value["type"] == "number" && value.get("default").is_some_and(Value::is_null);
    let by_type = schema.get("required").and_then(Value::as_array).cloned().unwrap_or_default();
    let must = |(key, value): &(&String, &Value)| {
        let is_said = value.get("x-required").is_some() || value.get("const").is_some();
        is_said || is_nan(value) || by_type.iter().any(|name| name == *key)
    };
    let required: Vec<Value> = properties.iter().filter(must).map(|(key, _)| Value::from(key.as_str())).collect();
    schema.remove("required");
    if !required.is_empty() {
        schema.insert("required".into(), Value::Array(required));
    }
    if let Some(properties) = schema.get_mut("properties").and_then(Value::as_object_mut) {
        properties.values_mut().filter_map(Value::as_object_mut).for_each(|property| {
            // A required key has no default.
            if property.remove("x-required").is_some() {
                property.remove("default");
            }
        });
    }
}

fn without_null(schema: &mut Schema) {
    if let Some(Value::Array(types)) = schema.get_mut("type") {
        types.retain(|name| name != "null");
        if let [only] = types.as_slice() {
            let only = only.clone();
            schema.insert("type".into(), only);
        }
    }
    if let Some(Value::Array(values)) = schema.get_mut("enum") {
        values.retain(|value| !value.is_null());
    }
    let Some(Value::Array(of)) = schema.get("anyOf") else { return };
    let left: Vec<&Value> = of.iter().filter(|one| one.get("type").is_none_or(|name| name != "null")).collect();
    if let [Value::Object(only)] = left.as_slice() {
        let only = only.clone();
        schema.remove("anyOf");
        for (key, value) in only {
            // The description of the key takes precedence over that of its type.
            if schema.get(&key).is_none() {
                schema.insert(key, value);
            }
        }
    }
}

/// Returns the words that a schema allows, if it allows only certain words; `None` for any other schema.
pub fn choices(schema: &Value) -> Option<Vec<&str>> {
    if let Some(values) = schema.get("enum").and_then(Value::as_array) {
        return values.iter().map(Value::as_str).collect();
    }
    if let Some(word) = schema.get("const").and_then(Value::as_str) {
        return Some(vec![word]);
    }
    let mut words = Vec::new();
    for one in schema.get("oneOf")?.as_array()? {
        if one.get("properties").is_some() {
            return None;
        }
        words.extend(choices(one)?);
    }
    Some(words)
}
