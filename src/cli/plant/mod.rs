//! Commands and arguments of a plant of many cells: its database, and the live values of a cell. The program has them
//! only with the feature `plant`; `without_plant.rs` is the twin of this module without it.

mod archive;
mod audit;
mod cell_monitor;
mod check;
mod confirmed_part;
mod doctor;
mod failure;
mod fill;
mod knowledge;
mod manage;
mod members;
mod notify;
mod plant_file;
mod processes;
mod publish;
mod queue;
mod quota;
mod recipes;
mod replicate;
mod run_arguments;
mod run_queue;
mod runs;
mod serve;
mod studies;
mod truth;

use clap::Subcommand;
use regrind_live::LiveError;
use regrind_plant::PlantError;

use super::Outcome;
use super::failure::Failure;
pub(super) use audit::AuditArguments;
pub(super) use check::check_plant;
pub(super) use doctor::DoctorArguments;
pub(super) use failure::PlantFailure;
pub(super) use run_arguments::{ResumeArguments, RunArguments, start_processes};

/// Commands of a plant.
#[derive(Debug, Subcommand)]
pub(super) enum Commands {
    Ship(replicate::Arguments),
    Work(run_queue::Arguments),
    Study(studies::Arguments),
    Tell(publish::Arguments),
    Notify(notify::Arguments),
    Plant(manage::Arguments),
}

pub(super) fn run(command: &Commands) -> Result<Outcome, Failure> {
    match command {
        Commands::Ship(arguments) => replicate::run(arguments),
        Commands::Work(arguments) => run_queue::run(arguments),
        Commands::Study(arguments) => studies::run(arguments),
        Commands::Tell(arguments) => publish::run(arguments),
        Commands::Notify(arguments) => notify::run(arguments),
        Commands::Plant(arguments) => manage::run(arguments),
    }
}

/// Kinds of file of a plant: the name of each on the command line, its description, and its JSON schema.
pub(super) const FILE_KINDS: &[super::file_kind::FileKind] = &[
    ("plant", "Plant files", regrind::config::plant_schema),
    ("notification", "Notifications, the bodies of requests to webhooks", notification_schema),
];

fn notification_schema() -> &'static serde_json::Value {
    static SCHEMA: std::sync::LazyLock<serde_json::Value> =
        std::sync::LazyLock::new(regrind_notify::notification_schema);
    &SCHEMA
}

impl From<PlantError> for Failure {
    fn from(error: PlantError) -> Self {
        Self::Plant(error.into())
    }
}

impl From<LiveError> for Failure {
    fn from(error: LiveError) -> Self {
        Self::Plant(error.into())
    }
}
