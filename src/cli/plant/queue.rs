//! `regrind plant queue|unqueue|work`: the queue of parts to be made.

use clap::Args;
use regrind::document::visible_line;
use regrind_plant::PlantRecipe;
use serde_json::json;

use super::super::failure::Failure;
use super::super::{Outcome, name};
use super::plant_file::{Where, open};

/// Queue parts to make by a recipe
#[derive(Args, Debug)]
#[command(after_help = "\
Cells take the parts with `regrind work`, in the order of their due dates. Nothing starts by itself: a person at the cell
confirms each part, unless the recipe has cycle.confirm_work = false.

Example:
  regrind plant queue SN-0042 SN-0043 --recipe freeform-mirror --due 2027-03-01 --plant planner.toml

Exit codes: 0 queued; 2 there is no such recipe, the recipe lacks the signatures of two people, or a part is
queued already; 3 the database cannot be reached.")]
pub(super) struct ToQueue {
    /// Serial numbers of the parts
    #[arg(value_name = "SERIAL", required = true, value_parser = name)]
    serials: Vec<String>,
    /// Name of the recipe in the plant
    #[arg(long, value_name = "NAME")]
    recipe: String,
    /// Version of the recipe; by default the newest
    #[arg(long, value_name = "N")]
    version: Option<i32>,
    /// Cell that makes the parts; by default the first cell that requests one
    #[arg(long, value_name = "NAME")]
    cell: Option<String>,
    /// Due date
    #[arg(long, value_name = "YYYY-MM-DD")]
    due: Option<jiff::civil::Date>,
    #[command(flatten)]
    plant: Where,
}

/// Remove a part from the queue, if it is not started
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind plant unqueue 17 --reason \"the blank is broken\" --plant planner.toml

Exit codes: 0 removed; 1 the part is started, or there is no such part; 2 the database refuses the command; 3 the
database cannot be reached.")]
pub(super) struct ToUnqueue {
    /// Number of the part in the queue, as `regrind plant work` lists it
    #[arg(value_name = "N")]
    work: i64,
    /// Reason, for the record
    #[arg(long, alias = "why", value_name = "WORDS", value_parser = name)]
    reason: String,
    #[command(flatten)]
    plant: Where,
}

/// List the parts that are queued or in work
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind plant work --plant planner.toml

Exit codes: 0 listed; 2 the database refuses the command; 3 the database cannot be reached.")]
pub(super) struct ToList {
    #[command(flatten)]
    plant: Where,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

pub(super) fn queue(arguments: &ToQueue) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let recipe = PlantRecipe::find(&link, &arguments.recipe, arguments.version).await?;
        recipe.check_signatures(&link).await?;
        let (sha256, due) = (recipe.sha256(), arguments.due.map(|due| due.to_string()));
        let text = "SELECT queue_work(s, decode($2, 'hex'), $3, $4::text::date) FROM unnest($1::text[]) AS s";
        // All parts are queued, or none.
        let made = link.query(text, &[&arguments.serials, &sha256, &arguments.cell, &due]).await?;
        let numbers: Vec<i64> = made.iter().map(|row| row.get(0)).collect();
        let lines = numbers.iter().zip(&arguments.serials).map(|(number, serial)| {
            let [serial, name] = [serial, &recipe.name].map(|field| visible_line(field));
            format!("{number:>6}  {serial}  to be made by version {} of the recipe {name}\n", recipe.version)
        });
        super::super::print(&lines.collect::<String>())?;
        Ok(Outcome::Accepted)
    })
}

pub(super) fn unqueue(arguments: &ToUnqueue) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    let ToUnqueue { work, reason, .. } = arguments;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let done = link.query("SELECT withdraw_work($1, $2)", &[work, reason]).await?;
        if done.first().is_some_and(|row| row.get(0)) {
            super::super::print(&format!("the part with number {work} is removed from the queue\n"))?;
            return Ok(Outcome::Accepted);
        }
        super::super::print(&format!(
            "no part was removed: part number {work} is already started or finished, or is not in the queue\n"
        ))?;
        Ok(Outcome::NotInTolerance)
    })
}

pub(super) fn list(arguments: &ToList) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let text = "SELECT id, serial, recipe, version, coalesce(due::text, ''), state, coalesce(cell, for_cell, ''), coalesce(run, '')
            FROM work_now ORDER BY due NULLS LAST, id";
        let found = link.query(text, &[]).await?;
        let mut told = Vec::new();
        let mut lines = String::new();
        for row in &found {
            let (id, version): (i64, i32) = (row.get(0), row.get(3));
            let [serial, recipe, due, state, cell, run]: [&str; 6] = [1, 2, 4, 5, 6, 7].map(|k| row.get(k));
            told.push(json!({
                "work": id, "serial": serial, "recipe": recipe, "version": version, "due": due, "state": state, "cell": cell, "run": run,
            }));
            let [serial, recipe, due, cell, run] = [serial, recipe, due, cell, run].map(visible_line);
            lines += &format!("{id:>6}  {serial:<16}  {recipe} {version}  {due:<10}  {state:<6}  {cell}  {run}\n");
        }
        match arguments.json {
            true => super::super::print_json(&told)?,
            false => super::super::print(&lines)?,
        }
        Ok(Outcome::Accepted)
    })
}
