//! `regrind schema`: the JSON schemas of recipes, cell files and dialects, for editors.

use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use regrind::{config, recipe};

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
    ("recipe", "Recipes", recipe::json_schema),
    ("cell", "Cell files", config::json_schema),
    ("dialect", "Dialects of programs", config::dialect_schema),
];

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let (_, _, schema) = arguments.of;
    super::print_json(schema())?;
    Ok(Outcome::Accepted)
}

/// Returns the parser of an argument that names a kind of file.
fn of_kind() -> impl TypedValueParser<Value = FileKind> {
    let kinds = || KINDS.into_iter().chain(plant::FILE_KIND);
    let words = kinds().map(|(name, help, _)| PossibleValue::new(name).help(help));
    PossibleValuesParser::new(words)
        .try_map(move |word| kinds().find(|(name, ..)| *name == word).ok_or("there is no such kind of file"))
}
