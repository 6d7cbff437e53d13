//! `regrind plant fill`: fills a database with simulated runs, to try the page of a plant with the data of years.

use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use clap::builder::RangedU64ValueParser;
use regrind_plant::{Filling, RunPattern, TableSize, table_sizes};

use super::super::Outcome;
use super::super::failure::Failure;
use super::super::words::{count, counted};
use super::plant_file::{Where, open};

/// Fill a database for trials with simulated runs of many cells
#[derive(Args, Debug)]
#[command(after_help = "\
Sign in as the owner of a database that `regrind plant init` has set up. The command makes cells that nobody can sign in as, and
runs that are marked SIMULATION in their names and in every list. It refuses a database that has other cells or runs.
Runs with whole records repeat those of a finished simulated run; `regrind audit verify --plant` proves them.

Examples:
  regrind plant fill --cells 1000 --runs 1000000 --years 5 --plant owner.toml
  regrind plant fill --runs 20000 --records 500 --like runs/freeform-mirror-20260704T120000Z --plant owner.toml

Exit codes: 0 filled; 2 bad arguments, or the database has other cells or runs; 3 the database cannot be reached.")]
pub(super) struct Arguments {
    /// Number of cells
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = RangedU64ValueParser::<u32>::new().range(1..=9999))]
    cells: u32,
    /// Number of runs
    #[arg(long, value_name = "N", default_value_t = 100_000, value_parser = RangedU64ValueParser::<u32>::new().range(1..=50_000_000))]
    runs: u32,
    /// Years before now over which the runs are spread
    #[arg(long, value_name = "YEARS", default_value_t = 5.0, value_parser = years)]
    years: f64,
    /// Number of the runs that get whole records and files
    #[arg(long, value_name = "N", default_value_t = 0, requires = "like", value_parser = RangedU64ValueParser::<u32>::new().range(..=1_000_000))]
    records: u32,
    /// Folder of the finished simulated run whose records and files are repeated
    #[arg(long, value_name = "RUN", requires = "records")]
    like: Option<PathBuf>,
    /// Seed of the figures; the same seed gives the same figures [default: a random one, which is printed]
    #[arg(long, value_name = "N")]
    seed: Option<u32>,
    #[command(flatten)]
    plant: Where,
}

/// Parses a number of years, from a day to a century.
fn years(text: &str) -> Result<f64, String> {
    let years = text.parse::<f64>().ok().filter(|years| (0.002..=100.0).contains(years));
    years.ok_or_else(|| "a number of years from 0.002 to 100 is needed".to_owned())
}

pub(super) fn fill(arguments: &Arguments) -> Result<Outcome, Failure> {
    let Arguments { cells, runs, years, records, like, seed, plant } = arguments;
    let config = plant.read()?;
    let pattern = like.as_deref().map(RunPattern::read).transpose()?;
    let seed = seed.unwrap_or_else(rand::random);
    let filling = Filling { cells: *cells, runs: *runs, years: *years, whole_runs: *records, seed };
    super::super::print(&format!("SIMULATION, seed {seed}\n"))?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let began = Instant::now();
        filling.make(&link, pattern.as_ref(), |made| eprintln!("{} of {}", count(made as usize), counted(*runs as usize, "run"))).await?;
        let sizes: String = table_sizes(&link).await?.iter().map(line).collect();
        super::super::print(&format!(
            "{} of {} in {years} years, {} with whole records, in {:.0} s\n{:<14} {:>12} {:>10} {:>10} {:>12} {:>12}\n{sizes}",
            counted(*runs as usize, "run"),
            counted(*cells as usize, "cell"),
            count(*records as usize),
            began.elapsed().as_secs_f64(),
            "table",
            "rows",
            "data MB",
            "index MB",
            "data B/row",
            "index B/row",
        ))?;
        Ok(Outcome::Accepted)
    })
}

fn line(size: &TableSize) -> String {
    let TableSize { table, rows, data_bytes, index_bytes } = size;
    let [data, index] = [data_bytes, index_bytes].map(|bytes| *bytes as f64);
    let rows_f64 = (*rows).max(1) as f64;
    format!(
        "{table:<14} {:>12} {:>10.1} {:>10.1} {:>12.0} {:>12.0}\n",
        count(*rows as usize),
        data / 1e6,
        index / 1e6,
        data / rows_f64,
        index / rows_f64
    )
}
