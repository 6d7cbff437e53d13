//! `regrind schema`: the JSON schemas of recipes and cell files, for editors.

use clap::{Args, ValueEnum};
use regrind::{config, recipe};

use super::Outcome;
use super::failure::Failure;

/// Print the JSON schema of recipes or of cell files, for completion in an editor
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind schema recipe > recipe.schema.json

Exit codes: 0 printed; 2 bad arguments; 3 fault.")]
pub(super) struct Arguments {
    /// Which schema
    #[arg(value_enum)]
    of: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// Of recipes
    Recipe,
    /// Of cell files
    Cell,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    super::print_json(match arguments.of {
        Kind::Recipe => recipe::json_schema(),
        Kind::Cell => config::json_schema(),
    })?;
    Ok(Outcome::Accepted)
}
