//! `regrind audit verify --plant`: verifies the plant's copy of a record, and compares it with the local journal.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use clap::Args;
use regrind::document::visible_line;
use regrind::formats::ScratchFolder;
use regrind::journal::PublicKey;
use regrind_plant::{PlantError, PlantRun, Reported, run_overview};
use serde_json::{Value, json};

use super::super::Outcome;
use super::super::control::folder_of;
use super::super::failure::Failure;
use super::plant_file::{open, read};

/// Plant whose copy of a run is verified.
#[derive(Args, Debug)]
pub(in super::super) struct AuditArguments {
    /// Also verify the copy at the plant of this file, and compare the journal with it; RUN may then be the name of a
    /// run that is not on this computer
    #[arg(long, value_name = "FILE", conflicts_with = "anchor")]
    plant: Option<PathBuf>,
}

impl AuditArguments {
    /// Verifies the copy of a run in the database of the plant, if a plant is given. The parameters and errors are those
    /// of [`prove`]. Returns the result of the verification, or the outcome of the command if the run is not on this
    /// computer, so that nothing is left to verify.
    pub(in super::super) fn prove(
        &self,
        run: Option<&Path>,
        keys: &[PublicKey],
        json: bool,
    ) -> Result<ControlFlow<Outcome, Option<Value>>, Failure> {
        let Some(plant) = &self.plant else { return Ok(ControlFlow::Continue(None)) };
        let Copy { is_here, content } = prove(plant, run, keys, json)?;
        Ok(if is_here { ControlFlow::Continue(Some(content)) } else { ControlFlow::Break(Outcome::Accepted) })
    }
}

/// Result of the verification of the plant's copy of a run.
struct Copy {
    /// True if the run is also stored on this computer.
    is_here: bool,
    content: Value,
}

/// Fetches the copy of a run from the database of the plant, and verifies this copy. `keys` are the public keys for the
/// signatures of the copy. `plant` is the path of the plant file. `run` is the folder or the name of the run. If `run`
/// is `None`, uses the newest run in the folder `runs`. If the run folder exists on this computer, also checks that the
/// local journal still contains the records of the copy.
///
/// Returns the result, and prints it in two cases:
///
/// - If `json` is false, prints the result as text.
/// - If `json` is true and the run folder does not exist on this computer, prints the result as JSON.
///
/// In the remaining case the caller prints the result.
///
/// # Errors
/// The plant cannot be reached or does not have the run, the copy is not valid, or the local journal differs from the
/// copy.
fn prove(plant: &Path, run: Option<&Path>, keys: &[PublicKey], json: bool) -> Result<Copy, Failure> {
    let config = read(plant)?;
    let folder = match run {
        Some(run) if !run.is_dir() => None,
        run => Some(folder_of(run)?),
    };
    let named = folder.as_deref().or(run).and_then(Path::file_name).unwrap_or_default().to_string_lossy().into_owned();
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let found = PlantRun::find(&link, config.cell.as_deref(), &named).await?;
        let place = std::env::temp_dir().join(format!("regrind-{:032x}", rand::random::<u128>()));
        let scratch = ScratchFolder::at(place)?;
        // The name of a run comes from a cell, so it is not used as the name of a folder.
        let copy = scratch.path().join("run");
        found.fetch(&link, config.artefacts.as_ref(), &copy).await?;
        let proven = found.prove(&copy, keys)?;
        let differences = Reported::read(&link, found.id).await?.differences(&run_overview(&copy)?);
        if !differences.is_empty() {
            let what = format!("what the cell reported is not what its record says: {}", differences.join("; "));
            return Err(PlantError::Differs { run: found.name, what }.into());
        }
        if let Some(folder) = &folder {
            found.check_local_journal(folder)?;
        }
        let content = json!({
            "run": found.name, "cell": found.cell, "sound": true, "records": proven.records, "head": proven.head,
            "closed": proven.closed, "artefacts": proven.artefacts, "keys": proven.keys, "seals": proven.seals, "signed": proven.signed,
        });
        if json && folder.is_none() {
            super::super::print_json(&content)?;
        } else if !json {
            let signed = match proven.signed {
                0 => "not signed".to_owned(),
                signed => format!("signatures up to record {signed}, with a key that is enrolled for {}", visible_line(&found.cell)),
            };
            let signed = if found.keys.is_empty() && proven.signed > 0 { "signed with a key that is not enrolled at the plant".to_owned() } else { signed };
            super::super::print(&format!(
                "plant       {} records and {} files of {}, {signed}{}\n",
                proven.records,
                proven.artefacts,
                visible_line(&found.cell),
                if folder.is_some() { "; the local journal contains these records" } else { "" }
            ))?;
        }
        Ok(Copy { is_here: folder.is_some(), content })
    })
}
