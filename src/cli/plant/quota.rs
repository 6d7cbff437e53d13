//! `regrind plant quota`: limits of what one cell can send to the plant.

use clap::Args;
use serde_json::json;

use super::super::Outcome;
use super::super::failure::Failure;
use super::plant_file::{Where, open};

/// List the limits of what one cell can send, or change one of them as the owner
#[derive(Args, Debug)]
#[command(after_help = "\
A cell that has used up the quota of a day waits for the next day, and keeps its records. Days are those of UTC.

Examples:
  regrind plant quota --plant planner.toml
  regrind plant quota --set runs_per_day=20000 --plant owner.toml

Exit codes: 0 listed or changed; 1 there is no quota of that name; 2 the database refuses the command; 3 the database
cannot be reached.")]
pub(super) struct ToSet {
    /// Name of a quota and its new value
    #[arg(long, value_name = "NAME=N", value_parser = new_value)]
    set: Option<(String, i64)>,
    #[command(flatten)]
    plant: Where,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

fn new_value(text: &str) -> Result<(String, i64), String> {
    let words = || "give the name of a quota and a whole number above 0, such as runs_per_day=20000".to_owned();
    let (name, most) = text.split_once('=').ok_or_else(words)?;
    let most = most.trim().parse().ok().filter(|most| *most > 0).ok_or_else(words)?;
    Ok((name.trim().to_owned(), most))
}

pub(super) fn run(arguments: &ToSet) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        if let Some((name, most)) = &arguments.set {
            let done = link.query("SELECT set_quota($1, $2)", &[name, most]).await?;
            if !done.first().is_some_and(|row| row.get(0)) {
                super::super::print(&format!("there is no quota {name:?}; to see all: regrind plant quota\n"))?;
                return Ok(Outcome::NotInTolerance);
            }
        }
        let found = link.query("SELECT name, most, meaning FROM quota ORDER BY name", &[]).await?;
        let quotas = found.iter().map(|row| (row.get(0), row.get(1), row.get(2)));
        let quotas: Vec<(&str, i64, &str)> = quotas.collect();
        if arguments.json {
            let told =
                quotas.iter().map(|(name, most, meaning)| json!({ "name": name, "most": most, "meaning": meaning }));
            super::super::print_json(&told.collect::<Vec<_>>())?;
        } else {
            let line = |(name, most, meaning): &(&str, i64, &str)| format!("{name:<18}  {most:>14}  {meaning}\n");
            super::super::print(&regrind::document::visible(&quotas.iter().map(line).collect::<String>()))?;
        }
        Ok(Outcome::Accepted)
    })
}
