//! Arguments of `regrind run` about the plant, and their effect on the run.

use std::path::{Path, PathBuf};

use clap::Args;
use regrind::config::CellConfig;
use regrind::drive::Task;
use regrind::formats::Learned;
use regrind::recipe::Recipe;
use regrind_sim::world::World;

use super::super::failure::Failure;
use super::confirmed_part::ConfirmedPart;
use super::knowledge::query_knowledge;
use super::processes::PlantProcesses;
use super::truth::write_truth;

/// Plant of a run.
#[derive(Args, Debug)]
pub(in super::super) struct RunArguments {
    /// Also replicate the record to the plant of this file, as `regrind ship` does
    #[arg(long, value_name = "FILE")]
    pub(super) plant: Option<PathBuf>,
    /// Part from the queue of the plant that this run makes
    #[arg(skip)]
    pub(super) work: Option<Box<ConfirmedPart>>,
    /// File for the true state of the simulated part at the end
    #[arg(long, hide = true)]
    pub(super) truth: Option<PathBuf>,
}

/// Plant of a run that is resumed.
#[derive(Args, Debug)]
pub(in super::super) struct ResumeArguments {
    /// Also replicate the record to the plant of this file, as `regrind run --plant` does, if the run is resumed in this
    /// terminal
    #[arg(long, value_name = "FILE")]
    plant: Option<PathBuf>,
}

impl ResumeArguments {
    /// Returns the path of the plant file, independent of the working folder, which the resumed run changes.
    pub(in super::super) fn plant_file(&self) -> Option<PathBuf> {
        self.plant.as_ref().map(|plant| std::path::absolute(plant).unwrap_or_else(|_| plant.clone()))
    }
}

/// Starts the programs that replicate and publish the runs in the folder `runs`, if there is a plant file. Returns an
/// error if the plant file is invalid or a process cannot be started.
pub(in super::super) fn start_processes(runs: &Path, plant: Option<&Path>) -> Result<Option<PlantProcesses>, Failure> {
    plant.map(|plant| PlantProcesses::start(runs, plant)).transpose()
}

impl RunArguments {
    /// Returns the results of other cells of the plant from which `task` can start. Returns `None` if no plant is given,
    /// if it has no usable results, or if it does not answer. Adds messages for the operator to `messages`. Returns an
    /// error if the plant file is invalid.
    pub(in super::super) fn query_knowledge(
        &self,
        task: &Task,
        messages: &mut Vec<String>,
    ) -> Result<Option<Learned>, Failure> {
        self.plant.as_ref().map_or(Ok(None), |plant| query_knowledge(plant, task, messages))
    }

    /// Starts the programs that replicate and publish the runs in the folder `runs`, if a plant is given. Returns an
    /// error if the plant file is invalid or a process cannot be started.
    pub(in super::super) fn start_processes(&self, runs: &Path) -> Result<Option<PlantProcesses>, Failure> {
        start_processes(runs, self.plant.as_deref())
    }

    /// Tells the plant that the run in the folder `run` makes the part from its queue, if there is such a part. Returns
    /// an error if the plant refuses this or cannot be reached.
    pub(in super::super) async fn begin_part(&self, run: &Path) -> Result<(), Failure> {
        match &self.work {
            Some(work) => work.begin(run).await,
            None => Ok(()),
        }
    }

    /// Writes the true PV and RMS of the part in `world` to the file of the argument `--truth`, if it is given. Returns
    /// an error if the fit fails or the file cannot be written.
    pub(in super::super) fn write_truth(
        &self,
        world: &World,
        recipe: &Recipe,
        cell: &CellConfig,
    ) -> Result<(), Failure> {
        self.truth.as_ref().map_or(Ok(()), |path| write_truth(world, recipe, cell, path))
    }
}
