//! Parser of arguments that name a variant of an enum. The names are those of serde, and the help texts are the doc
//! comments.

use std::ffi::OsStr;
use std::marker::PhantomData;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use schemars::JsonSchema;
use serde::de::DeserializeOwned;
use serde::de::value::{Error, StrDeserializer};
use serde_json::Value;

/// Parser of a command-line argument that names a variant of the enum `T`.
pub(super) struct WordOf<T>(PhantomData<fn() -> T>);

/// Returns a command-line parser that converts the name of a variant into the enum `T`.
pub(super) fn word_of<T>() -> WordOf<T> {
    WordOf(PhantomData)
}

impl<T> Clone for WordOf<T> {
    fn clone(&self) -> Self {
        word_of()
    }
}

impl<T: Clone + DeserializeOwned + JsonSchema + Send + Sync + 'static> TypedValueParser for WordOf<T> {
    type Value = T;

    fn parse_ref(&self, command: &clap::Command, name: Option<&clap::Arg>, value: &OsStr) -> Result<T, clap::Error> {
        let read = |word: &str| T::deserialize(StrDeserializer::<Error>::new(word)).ok();
        // clap reports an unknown word with the allowed words and the most similar one.
        match value.to_str().and_then(read) {
            Some(known) => Ok(known),
            None => PossibleValuesParser::new(words::<T>())
                .parse_ref(command, name, value)
                .and_then(|word| read(&word).ok_or_else(|| clap::Error::new(clap::error::ErrorKind::InvalidValue))),
        }
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new(words::<T>().into_iter()))
    }
}

/// Returns the names of the variants of the enum `T`, each with its doc comment as help text. Both are taken from the
/// JSON schema of `T`.
fn words<T: JsonSchema>() -> Vec<PossibleValue> {
    let schema = schemars::schema_for!(T).to_value();
    let list = |of: &Value, key: &str| of.get(key).and_then(Value::as_array).cloned().unwrap_or_default();
    let mut words: Vec<(Value, Value)> = list(&schema, "enum").into_iter().map(|word| (word, Value::Null)).collect();
    for one in list(&schema, "oneOf") {
        words.extend(list(&one, "enum").into_iter().map(|word| (word, Value::Null)));
        words.extend(one.get("const").map(|word| (word.clone(), one["description"].clone())));
    }
    let value = |(word, help): (Value, Value)| {
        let value = PossibleValue::new(word.as_str()?.to_owned());
        let help = help.as_str().map(|help| help.replace('\n', " ").trim_end_matches('.').to_owned());
        Some(if let Some(help) = help { value.help(help) } else { value })
    };
    words.into_iter().filter_map(value).collect()
}

#[cfg(test)]
mod tests {
    use regrind::registration::{Coordinate, Loss, ProbeSide};

    use super::*;

    fn read<T: Clone + DeserializeOwned + JsonSchema + Send + Sync + 'static>(word: &str) -> Result<T, String> {
        word_of().parse_ref(&clap::Command::new("x"), None, OsStr::new(word)).map_err(|error| error.to_string())
    }

    #[test]
    fn possible_values_match_enum() {
        let words = words::<Loss>();
        assert_eq!(words.iter().map(PossibleValue::get_name).collect::<Vec<_>>(), ["none", "huber", "tukey"]);
        assert!(words.iter().all(|word| word.get_help().is_some_and(|help| !help.to_string().is_empty())));
        assert_eq!(super::words::<Coordinate>().len(), 6);
        assert_eq!(read::<Loss>("huber"), Ok(Loss::Huber));
        assert_eq!(read::<ProbeSide>("opposite"), Ok(ProbeSide::Below), "another name of the same");
        assert!(read::<Loss>("hubert").unwrap_err().contains("none, huber, tukey"));
    }
}
