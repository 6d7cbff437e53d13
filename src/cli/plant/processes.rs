//! Programs that replicate and publish a run for the plant while it is active.

use std::path::Path;
use std::process::{Child, Command, Stdio};

use super::super::failure::Failure;
use super::super::outside;
use super::plant_file::read;

/// Programs that replicate and publish a run for the plant while it is active. They are separate processes, so they can
/// neither slow the run down nor stop it. They end shortly after the program that holds this value, because then their
/// standard input ends.
pub(in super::super) struct PlantProcesses {
    _programs: Vec<Child>,
}

impl PlantProcesses {
    /// Starts the helper programs for the runs in the folder `runs`, each in a separate process. `plant` is the path of
    /// the plant file.
    ///
    /// - If the plant file has a table `[database]`, the program `ship` replicates the records to the plant.
    /// - If the plant file has a table `[sparkplug]`, `[opcua]` or `[mtconnect]`, the program `tell` publishes live values.
    /// - If the plant file has a table `[notify]`, the program `notify` notifies its receivers.
    ///
    /// The helper programs end shortly after the returned value is dropped. Returns an error if the plant file is
    /// invalid or a process cannot be started.
    pub(super) fn start(runs: &Path, plant: &Path) -> Result<Self, Failure> {
        // Errors of the file are reported here, before anything opens.
        let config = read(plant)?;
        let tells = config.sparkplug.is_some() || config.opcua.is_some() || config.mtconnect.is_some();
        let wanted = [("ship", config.database.is_some()), ("tell", tells), ("notify", config.notify.is_some())];
        let begun = wanted.into_iter().filter(|(_, is_wanted)| *is_wanted).map(|(name, _)| {
            let mut command = Command::new(std::env::current_exe()?);
            command.args([name, "--while-stdin", "--plant"]).arg(plant).arg("--runs").arg(runs);
            outside::set_apart(&mut command);
            command.stdin(Stdio::piped()).stdout(Stdio::null()).spawn()
        });
        Ok(Self { _programs: begun.collect::<Result<_, _>>().map_err(Failure::Terminal)? })
    }
}
