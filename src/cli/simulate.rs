//! `regrind simulate`: serves the simulated machines of a cell on their wires, for another process.

use std::path::PathBuf;

use clap::Args;
use regrind::config::CellConfig;
use regrind::recipe::Recipe;
use regrind::setup;
use regrind_sim::body::Kind;
use serde_json::json;

use super::check::or_show;
use super::failure::Failure;
use super::{Outcome, simulated, truth};

/// Serve the simulated CMM and grinder of a cell on their wires until stopped
#[derive(Args, Debug)]
#[command(after_help = "\
Both machines share one simulated part. The table [simulation] of the recipe defines the true shape of
this part.

Example:
  regrind simulate --cell config/modbus-tcp.toml --log machines.jsonl
  regrind run recipes/freeform-mirror.toml --cell config/modbus-tcp.toml      # in another terminal

Exit codes: 0 stopped by Ctrl-C; 2 bad files; 3 fault.")]
pub(super) struct Arguments {
    /// Recipe whose part is simulated
    #[arg(value_name = "RECIPE", default_value = "recipes/freeform-mirror.toml")]
    recipe: PathBuf,
    /// Cell whose machines are simulated
    #[arg(long, value_name = "FILE", default_value = "config/modbus-tcp.toml")]
    cell: PathBuf,
    /// Seed of another part and another run
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Write the events of the machines to this file, a line of JSON for each event
    #[arg(long, value_name = "FILE")]
    log: Option<PathBuf>,
    /// Print the addresses of the machines as one line of JSON; port 0 in the cell file selects a free port
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let recipe = or_show(Recipe::read(&arguments.recipe))?;
    let mut cell = or_show(CellConfig::read(&arguments.cell))?;
    let nominal = setup::read_nominal(&recipe).map_err(Failure::Setup)?;
    let spec = or_show(truth::world_spec(&recipe, &nominal, arguments.seed))?;
    super::runtime()?.block_on(async {
        let serving = simulated::serve(spec, &mut cell, &recipe).await?;
        arguments.log.as_deref().map_or(Ok(()), |log| serving.log_to(log))?;
        if arguments.json {
            let [cmm, grinder] = [Kind::Cmm, Kind::Grinder].map(|kind| serving.address(kind));
            let wires = json!({ "simulation": true, "cmm": cmm, "grinder": grinder });
            super::print(&format!("{wires}\n"))?;
            return until_stopped().await;
        }
        super::print(&format!("SIMULATION: the part of {}\n", recipe.path().display()))?;
        for place in serving.places() {
            super::print(&format!("SIMULATION: {place}\n"))?;
        }
        super::print("Ctrl-C ends it.\n")?;
        until_stopped().await
    })
}

async fn until_stopped() -> Result<Outcome, Failure> {
    tokio::signal::ctrl_c().await.map_err(Failure::Terminal)?;
    Ok(Outcome::Accepted)
}
