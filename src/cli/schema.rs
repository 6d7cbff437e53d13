//! `regrind schema`: the JSON schemas of recipes, cell files and dialects, for editors.

use clap::{Args, ValueEnum};
use regrind::{config, recipe};

use super::Outcome;
use super::failure::Failure;

/// Print the JSON schema of recipes, cell files or dialects, for completion in an editor
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind schema recipe > recipe.schema.json

Exit codes: 0 printed; 2 bad arguments; 3 fault.")]
pub(super) struct Arguments {
    /// Kind of file
    #[arg(value_enum)]
    of: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// Recipes
    Recipe,
    /// Cell files
    Cell,
    /// Dialects of programs
    Dialect,
    /// Plant files
    #[cfg(feature = "plant")]
    Plant,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    super::print_json(match arguments.of {
        Kind::Recipe => recipe::json_schema(),
        Kind::Cell => config::json_schema(),
        Kind::Dialect => config::dialect_schema(),
        #[cfg(feature = "plant")]
        Kind::Plant => config::plant_schema(),
    })?;
    Ok(Outcome::Accepted)
}
