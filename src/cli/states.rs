//! `regrind states`: the reaction of the cell to every event in every state, as a table and as a diagram.

use std::fmt::Write as _;
use std::path::PathBuf;

use clap::Args;
use regrind::cell::{Reaction, TransitionRow, transition_table};
use regrind::report::{save_text, state_picture};
use serde_json::{Value, json};

use super::Outcome;
use super::failure::Failure;

/// Print the response of the cell to every event in every state
#[derive(Args, Debug)]
#[command(after_help = "\
The table is computed from every event in every reachable state. A line has an event, the next state, and the commands of
the cell. If an event has several lines, the next state or the commands depend on the values of the event or on earlier
events.

Examples:
  regrind states --state Held
  regrind states --svg states.svg

Exit codes: 0 printed; 2 bad arguments, or the picture cannot be written; 3 fault.")]
pub(super) struct Arguments {
    /// Only states whose name begins with this text
    #[arg(long, value_name = "NAME")]
    state: Option<String>,
    /// Also print events that are refused or have no effect
    #[arg(long)]
    all: bool,
    /// Draw the states into this file instead
    #[arg(long, value_name = "FILE", conflicts_with_all = ["state", "all", "json"])]
    svg: Option<PathBuf>,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let rows = transition_table();
    if let Some(path) = &arguments.svg {
        save_text(path, &state_picture(&rows)).map_err(Failure::Report)?;
        return Ok(Outcome::Accepted);
    }
    let wanted = arguments.state.as_deref().unwrap_or_default().to_lowercase();
    let chosen: Vec<&TransitionRow> =
        rows.iter().filter(|row| row.state.to_string().to_lowercase().starts_with(&wanted)).collect();
    if chosen.is_empty() {
        let mut known: Vec<String> = rows.iter().map(|row| row.state.name().to_string()).collect();
        known.dedup();
        return Err(Failure::NoState { name: wanted, known: known.join(", ") });
    }
    if arguments.json {
        super::print_json(&document(&chosen, arguments.all))?;
    } else {
        super::print(&text(&chosen, arguments.all))?;
    }
    Ok(Outcome::Accepted)
}

/// Returns true if an event has an effect: the cell accepts the event, and changes the state or issues a command. `row`
/// contains a state and an event of the transition table. `answer` is one possible reaction of the cell to this event.
fn acts(row: &TransitionRow, answer: &Reaction) -> bool {
    !answer.is_refusal() && (answer.next != row.state || !answer.commands.is_empty())
}

fn shown(row: &TransitionRow, all: bool) -> impl Iterator<Item = &Reaction> {
    row.answers.iter().filter(move |answer| all || acts(row, answer))
}

fn document(rows: &[&TransitionRow], all: bool) -> Value {
    let rows = rows.iter().filter(|row| shown(row, all).next().is_some()).map(|row| {
        let answers: Vec<Value> = shown(row, all)
            .map(|answer| json!({ "next": answer.next.to_string(), "commands": answer.commands }))
            .collect();
        json!({ "state": row.state.to_string(), "event": row.event, "answers": answers })
    });
    rows.collect()
}

fn text(rows: &[&TransitionRow], all: bool) -> String {
    let mut text = String::new();
    let mut state = None;
    for row in rows {
        if state != Some(row.state) {
            let gap = if state.is_some() { "\n" } else { "" };
            let end = if row.state.is_end() { ": final state" } else { "" };
            let _ = writeln!(text, "{gap}{}{end}", row.state);
            state = Some(row.state);
        }
        let mut event = row.event.as_str();
        for answer in shown(row, all) {
            let next = if answer.next == row.state { "stays".to_owned() } else { format!("-> {}", answer.next) };
            let commands = answer.commands.join(", ");
            let _ = writeln!(text, "{}", format!("  {event:<30} {next:<34} {commands}").trim_end());
            event = "";
        }
    }
    text
}
