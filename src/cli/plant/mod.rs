//! `regrind plant`: the database of many cells, its members and its content.

pub(super) mod audit;
mod confirmed_part;
pub(super) mod knowledge;
mod members;
mod plant_file;
mod queue;
mod recipes;
mod runs;
mod serve;
pub(super) mod studies;

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use super::Outcome;
use super::failure::Failure;
use clap::{Args, Subcommand};
pub(super) use confirmed_part::ConfirmedPart;
use plant_file::Where;
pub(super) use plant_file::{open, read};
pub(super) use recipes::is_below;

/// Manage the database of a plant of many cells
#[derive(Args, Debug)]
#[command(after_help = "\
A cell makes parts also without a plant. The plant never commands a motion. The database is PostgreSQL 15 or later;
a plant file (config/plant/plant.toml) gives its address and user. docs/plant.md shows the steps from one cell to four.

Examples:
  regrind plant init --plant owner.toml
  regrind plant enrol cell-1 --plant owner.toml --password-file cell-1.password --key cell-1.key
  regrind plant cells --plant planner.toml

Exit codes: 0 done; 1 a check failed, or something does not exist; 2 bad arguments, or the
database refuses the command; 3 the database cannot be reached.")]
pub(super) struct Arguments {
    #[command(subcommand)]
    what: PlantCommand,
}

#[derive(Debug, Subcommand)]
enum PlantCommand {
    Init(members::ToInit),
    Enrol(members::ToEnrol),
    Retire(members::ToRetire),
    Cells(members::ToList),
    Runs(runs::ToList),
    Fetch(runs::ToFetch),
    Incidents(runs::ToListIncidents),
    Propose(recipes::ToPropose),
    Approve(recipes::ToApprove),
    Withdraw(recipes::ToWithdraw),
    Recipes(recipes::ToList),
    Queue(queue::ToQueue),
    Unqueue(queue::ToUnqueue),
    Work(queue::ToList),
    Serve(serve::Arguments),
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    match &arguments.what {
        PlantCommand::Init(of) => members::init(of),
        PlantCommand::Enrol(of) => members::enrol(of),
        PlantCommand::Retire(of) => members::retire(of),
        PlantCommand::Cells(of) => members::list(of),
        PlantCommand::Runs(of) => runs::list(of),
        PlantCommand::Fetch(of) => runs::fetch(of),
        PlantCommand::Incidents(of) => runs::incidents(of),
        PlantCommand::Propose(of) => recipes::propose(of),
        PlantCommand::Approve(of) => recipes::approve(of),
        PlantCommand::Withdraw(of) => recipes::withdraw(of),
        PlantCommand::Recipes(of) => recipes::list(of),
        PlantCommand::Queue(of) => queue::queue(of),
        PlantCommand::Unqueue(of) => queue::unqueue(of),
        PlantCommand::Work(of) => queue::list(of),
        PlantCommand::Serve(of) => serve::serve(of),
    }
}

/// Programs that replicate and publish a run for the plant while it is active. They are separate processes, so they can
/// neither slow the run down nor stop it. They end shortly after the program that holds this value, because then their
/// standard input ends.
pub(super) struct PlantProcesses {
    _programs: Vec<Child>,
}

impl PlantProcesses {
    /// Starts the helper programs for the runs in the folder `runs`, each in a separate process. `plant` is the path of
    /// the plant file.
    ///
    /// - If the plant file has a table `[database]`, the program `ship` replicates the records to the plant.
    /// - If the plant file has a table `[sparkplug]` or `[opcua]`, the program `tell` publishes live values.
    ///
    /// The helper programs end shortly after the returned value is dropped. Returns an error if the plant file is
    /// invalid or a process cannot be started.
    pub(super) fn start(runs: &Path, plant: &Path) -> Result<Self, Failure> {
        // Errors of the file are reported here, before anything opens.
        let config = read(plant)?;
        let tells = config.sparkplug.is_some() || config.opcua.is_some();
        let wanted = [("ship", config.database.is_some()), ("tell", tells)];
        let begun = wanted.into_iter().filter(|(_, is_wanted)| *is_wanted).map(|(name, _)| {
            let mut command = Command::new(std::env::current_exe()?);
            command.args([name, "--while-stdin", "--plant"]).arg(plant).arg("--runs").arg(runs);
            super::outside::set_apart(&mut command);
            command.stdin(Stdio::piped()).stdout(Stdio::null()).spawn()
        });
        Ok(Self { _programs: begun.collect::<Result<_, _>>().map_err(Failure::Terminal)? })
    }
}
