//! `regrind plant`: the database of many cells, its members and its content.

use clap::{Args, Subcommand};

use super::super::Outcome;
use super::super::failure::Failure;
use super::{archive, fill, members, queue, quota, recipes, runs, serve};

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
pub(in crate::cli) struct Arguments {
    #[command(subcommand)]
    what: PlantCommand,
}

#[derive(Debug, Subcommand)]
enum PlantCommand {
    Init(members::ToInit),
    Enrol(members::ToEnrol),
    AddKey(members::ToAddKey),
    Retire(members::ToRetire),
    Quota(quota::ToSet),
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
    Archive(archive::ToArchive),
    Unarchive(archive::ToRestore),
    Serve(serve::Arguments),
    Fill(fill::Arguments),
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    match &arguments.what {
        PlantCommand::Init(of) => members::init(of),
        PlantCommand::Enrol(of) => members::enrol(of),
        PlantCommand::AddKey(of) => members::add_key(of),
        PlantCommand::Retire(of) => members::retire(of),
        PlantCommand::Quota(of) => quota::run(of),
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
        PlantCommand::Archive(of) => archive::archive(of),
        PlantCommand::Unarchive(of) => archive::unarchive(of),
        PlantCommand::Serve(of) => serve::serve(of),
        PlantCommand::Fill(of) => fill::fill(of),
    }
}
