//! Proof of a run: the plant's copy of the run is fetched into a temporary folder, verified there, and its report and
//! QIF results are made.

use std::path::Path;
use std::sync::Arc;

use data_encoding::HEXLOWER;
use jiff::Timestamp;
use regrind_formats::{FormatError, ScratchFolder};
use regrind_report::{ReportError, ReportOptions, ResultsFormat, run_report, run_results};
use tokio::task::spawn_blocking;

use super::super::copy::PlantRun;
use super::super::error::{PlantError, refused};
use super::super::replication::run_overview;
use super::super::reported::Reported;
use super::proofs::Proof;
use super::shared::PlantPage;

/// Time limit of a query, set in SQL. A whole run is fetched here, so the limit is longer than for other pages. Only
/// one run is fetched at a time.
const ANSWER: &str = "SET statement_timeout = '60s'";

/// Verifies the plant's copy of a run, or returns a result from the cache that is less than 60 s old. `id` is the id of
/// the run in the plant, `cell` the name of its cell, and `name` the name of the run. `head` is the hash of the last
/// record that the plant has of this run.
///
/// # Errors
/// Fails if the plant cannot be reached or has no such run. A copy that does not pass the verification is not an error:
/// the returned [`Proof`] then contains the reason.
pub(super) async fn proven(
    plant: &PlantPage,
    id: i32,
    cell: &str,
    name: &str,
    head: &str,
) -> Result<Arc<Proof>, PlantError> {
    if let Some(known) = plant.proofs.known(id, head) {
        return Ok(known);
    }
    let gone = || PlantError::Unreachable { place: "the other end".into(), what: "the page is closing".into() };
    let _turn = plant.proofs.turn.acquire().await.map_err(|_| gone())?;
    // Another request may have made the proof while this one waited for the lock.
    if let Some(known) = plant.proofs.known(id, head) {
        return Ok(known);
    }
    let proof = Arc::new(prove(plant, cell, name).await?);
    plant.proofs.keep(id, head, &proof);
    Ok(proof)
}

async fn prove(plant: &PlantPage, cell: &str, name: &str) -> Result<Proof, PlantError> {
    let link = plant.pool.open().await?;
    link.client().batch_execute(ANSWER).await.map_err(refused("to wait longer"))?;
    let run = PlantRun::find(&link, Some(cell), name).await?;
    let reported = Reported::read(&link, run.id).await?;
    let scratch = Arc::new(ScratchFolder::at(std::env::temp_dir().join(format!("regrind-page-{}", random_word()?)))?);
    // The name of a run comes from a cell, so it is not used as the name of a folder.
    let folder = scratch.path().join("run");
    match run.fetch(&link, plant.artefacts.as_ref(), &folder).await {
        Ok(()) => {}
        Err(error) if error.may_pass() => return Err(error),
        Err(error) => return Ok(Proof::failed(&run, &without(&folder, &error.to_string()))),
    }
    let made = spawn_blocking(move || {
        let _kept_until_here = Arc::clone(&scratch);
        let found = run.prove(&folder, &[]).map_err(|error| without(&folder, &error.to_string()));
        let words = |error: ReportError| without(&folder, &error.to_string());
        // Without an overview of the copy nothing can be compared, and the reason is that of the report.
        let overview = run_overview(&folder).unwrap_or_default();
        Proof {
            at: now(),
            keys: run.keys.len(),
            differences: reported.differences(&overview),
            report: run_report(&folder, &ReportOptions::default()).map_err(words),
            qif: run_results(&folder, ResultsFormat::Qif).map_err(words),
            dfq: run_results(&folder, ResultsFormat::Dfq).map_err(words),
            outcome: found,
        }
    });
    let failed =
        |_| PlantError::Unreachable { place: "this computer".into(), what: "the verification was interrupted".into() };
    made.await.map_err(failed)
}

impl Proof {
    fn failed(run: &PlantRun, reason: &str) -> Self {
        let reason = reason.to_owned();
        let none = || Err(reason.clone());
        let (outcome, differences) = (Err(reason.clone()), Vec::new());
        Self { at: now(), outcome, keys: run.keys.len(), differences, report: none(), qif: none(), dfq: none() }
    }
}

/// Returns the message `words`, with the path `folder` replaced by "the copy". `folder` is a temporary folder of the
/// server, which a reader of the page cannot open.
fn without(folder: &Path, words: &str) -> String {
    words.replace(&folder.display().to_string(), "the copy")
}

fn now() -> String {
    Timestamp::now().strftime("%Y-%m-%d %H:%M:%S").to_string()
}

/// Returns a random name for a temporary folder: 32 hexadecimal digits. Nobody can guess the name, so no other program
/// can have created this folder before. Returns an error if the operating system supplies no random bytes.
fn random_word() -> Result<String, PlantError> {
    let mut bytes = [0; 16];
    let failed = |error: getrandom::Error| FormatError::Unwritable {
        path: std::env::temp_dir(),
        action: "naming a folder in it",
        source: std::io::Error::other(error.to_string()),
    };
    getrandom::fill(&mut bytes).map_err(failed)?;
    Ok(HEXLOWER.encode(&bytes))
}
