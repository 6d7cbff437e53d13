//! Twin of the module of a plant in a program without the feature `plant`: there are no commands and no arguments of a
//! plant, and nothing to do for one.

use std::convert::Infallible;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use clap::Args;
use regrind::config::CellConfig;
use regrind::document::Problems;
use regrind::drive::Task;
use regrind::formats::Learned;
use regrind::journal::PublicKey;
use regrind::recipe::Recipe;
use regrind_sim::world::World;
use serde_json::Value;
use thiserror::Error;

use super::Outcome;
use super::failure::Failure;

/// Commands of a plant: none.
pub(super) type Commands = Infallible;

pub(super) fn run(command: &Commands) -> Result<Outcome, Failure> {
    match *command {}
}

/// Kinds of file of a plant: none.
pub(super) const FILE_KINDS: &[super::file_kind::FileKind] = &[];

/// Checks no plant file.
pub(super) fn check_plant(_: &Path) -> Option<Result<super::file_kind::CheckedPlantFile, Problems>> {
    None
}

/// Arguments of `regrind doctor` about the plant: none.
#[derive(Args, Debug)]
pub(super) struct DoctorArguments {}

impl DoctorArguments {
    /// Tries no receiver.
    pub(super) async fn try_receivers(&self) -> Result<Vec<(String, Result<String, String>)>, Failure> {
        Ok(Vec::new())
    }
}

/// Arguments of `regrind run` about the plant: none.
#[derive(Args, Debug)]
pub(super) struct RunArguments {}

impl RunArguments {
    /// Returns no knowledge of other cells.
    pub(super) fn query_knowledge(&self, _: &Task, _: &mut Vec<String>) -> Result<Option<Learned>, Failure> {
        Ok(None)
    }

    /// Starts no program.
    pub(super) fn start_processes(&self, _: &Path) -> Result<Option<Infallible>, Failure> {
        Ok(None)
    }

    /// Tells nobody that a part begins.
    pub(super) async fn begin_part(&self, _: &Path) -> Result<(), Failure> {
        Ok(())
    }

    /// Writes no file.
    pub(super) fn write_truth(&self, _: &World, _: &Recipe, _: &CellConfig) -> Result<(), Failure> {
        Ok(())
    }
}

/// Arguments of `regrind resume` about the plant: none.
#[derive(Args, Debug)]
pub(super) struct ResumeArguments {}

impl ResumeArguments {
    /// Returns no file.
    pub(super) fn plant_file(&self) -> Option<PathBuf> {
        None
    }
}

/// Starts no program.
pub(super) fn start_processes(_: &Path, _: Option<&Path>) -> Result<Option<Infallible>, Failure> {
    Ok(None)
}

/// Arguments of `regrind audit verify` about the plant: none.
#[derive(Args, Debug)]
pub(super) struct AuditArguments {}

impl AuditArguments {
    /// Verifies no copy.
    pub(super) fn prove(
        &self,
        _: Option<&Path>,
        _: &[PublicKey],
        _: bool,
    ) -> Result<ControlFlow<Outcome, Option<Value>>, Failure> {
        Ok(ControlFlow::Continue(None))
    }
}

/// Reason why a command of a plant failed: none.
#[derive(Debug, Error)]
#[error("no plant")]
pub(super) enum PlantFailure {}

impl PlantFailure {
    pub(super) fn exit_code(&self) -> u8 {
        match *self {}
    }
}
