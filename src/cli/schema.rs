//! `regrind schema`: the JSON schemas of recipes, cell files and dialects, for editors, and of notifications.

use std::sync::LazyLock;

use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use regrind::document::schema_of;
use regrind::{config, recipe};
use regrind_sim::spec::WorldSpec;
use serde_json::Value;

use super::Outcome;
use super::failure::Failure;
use super::file_kind::FileKind;
use super::plant;

/// Print the JSON schema of recipes, cell files or dialects, for completion in an editor
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind schema recipe > recipe.schema.json

Exit codes: 0 printed; 2 bad arguments; 3 fault.")]
pub(super) struct Arguments {
    /// Kind of file
    #[arg(value_parser = of_kind())]
    of: FileKind,
}

const KINDS: [FileKind; 3] = [
    ("recipe", "Recipes", recipe_schema),
    ("cell", "Cell files", config::json_schema),
    ("dialect", "Dialects of programs", config::dialect_schema),
];

/// Returns the JSON schema of a recipe, with the keys of its table `[simulation]`. The simulator declares these keys.
pub(super) fn recipe_schema() -> &'static Value {
    static SCHEMA: LazyLock<Value> = LazyLock::new(|| {
        let mut schema = recipe::json_schema().clone();
        let mut simulation = schema_of::<WorldSpec>();
        let about = &mut schema["properties"]["simulation"];
        simulation["description"] = about["description"].take();
        if let Some(simulation) = simulation.as_object_mut() {
            simulation.remove("$schema");
        }
        *about = simulation;
        schema
    });
    &SCHEMA
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let (_, _, schema) = arguments.of;
    super::print_json(schema())?;
    Ok(Outcome::Accepted)
}

/// Returns the parser of an argument that names a kind of file.
fn of_kind() -> impl TypedValueParser<Value = FileKind> {
    let kinds = || KINDS.into_iter().chain(plant::FILE_KINDS.iter().copied());
    let words = kinds().map(|(name, help, _)| PossibleValue::new(name).help(help));
    PossibleValuesParser::new(words)
        .try_map(move |word| kinds().find(|(name, ..)| *name == word).ok_or("there is no such kind of file"))
}
