//! Results of other cells as prior knowledge for a first part: selected by what the parts have in common, and verified
//! here before use.

use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use data_encoding::HEXLOWER;
use regrind_formats::run_files::RunFile;
use regrind_formats::{CellRun, Learned, SettingIdentity};
use regrind_journal::{Excerpt, PublicKey, sha256_hex};
use serde::Deserialize;
use tokio_postgres::Row;
use tokio_postgres::types::ToSql;

use super::error::{PlantError, refused};
use super::link::DatabaseLink;
use super::settings::ArtefactSettings;

/// Maximum number of results of other cells. The database has the same limit for one query.
const MAX_RESULTS: usize = 8;
/// Maximum size of a file of learned results in bytes. The database has the same limit.
const MAX_BYTES: u64 = 4 << 20;

/// Prior knowledge of the plant for a first part of a kind.
#[derive(Default)]
pub struct Knowledge {
    /// Results of other cells for parts of this kind.
    pub results: Vec<(CellRun, Learned)>,
    /// Pairs of results of two cells for the same kind of part, which can be another kind than that of `results`. True
    /// if this cell is one of the two.
    pub pairs: Vec<([Learned; 2], bool)>,
    /// Reason for each result that was rejected.
    pub skipped: Vec<String>,
}

/// Result as the plant delivered it.
struct DeliveredResult {
    kind: String,
    is_own: bool,
    from: CellRun,
    learned: Learned,
}

/// Part of a result file that names the kind of parts to which the result applies.
#[derive(Deserialize)]
struct Head {
    kind: Option<String>,
}

impl Knowledge {
    /// Reads from the plant the results that other cells have learned for parts of the kind `kind`. If there is at
    /// least one such result, also reads pairs of results: two cells that have made the same kind of part, which can be
    /// another kind than `kind`. The pairs show how similar the machines are. If `simulation` is true, reads only
    /// results of simulated cells, otherwise only results of real cells. `artefacts` names the folder with the large
    /// files.
    ///
    /// # Errors
    /// The plant cannot be reached, or this computer did not sign in as a cell. An invalid result is not an error: the
    /// reason is added to `skipped`, the list of rejected results, and reported to the plant.
    pub async fn query(
        link: &DatabaseLink,
        artefacts: Option<&ArtefactSettings>,
        (kind, simulation): (&SettingIdentity, bool),
    ) -> Result<Self, PlantError> {
        let failed = refused("the learned errors of other cells");
        let mut knowledge = Self::default();
        let text =
            "SELECT $1::text, false, cell, run, sha256, content, place, before, texts, keys FROM lessons($1, $2)";
        // A cell with results of this version and of an earlier one is asked for those of this version.
        for kind in [&kind.id, &kind.earlier] {
            let mut rows = link.client().query(text, &[kind, &simulation]).await.map_err(&failed)?;
            rows.retain(|row| knowledge.results.iter().all(|(known, _)| known.cell != row.get::<_, String>(2)));
            rows.truncate(MAX_RESULTS.saturating_sub(knowledge.results.len()));
            let of_kind = knowledge.verify_results(link, artefacts, (rows, simulation)).await?;
            knowledge.results.extend(of_kind.into_iter().map(|given| (given.from, given.learned)));
        }
        knowledge.leave_out_contradicting(link).await?;
        if knowledge.results.is_empty() {
            return Ok(knowledge);
        }
        let text =
            "SELECT kind, is_own, cell, run, sha256, content, place, before, texts, keys FROM lessons_in_common($1)";
        let rows = link.client().query(text, &[&simulation]).await.map_err(&failed)?;
        let in_common = knowledge.verify_results(link, artefacts, (rows, simulation)).await?;
        for (k, one) in in_common.iter().enumerate() {
            let others = in_common[k + 1..].iter().filter(|other| other.kind == one.kind);
            knowledge
                .pairs
                .extend(others.map(|other| ([one.learned.clone(), other.learned.clone()], one.is_own || other.is_own)));
        }
        Ok(knowledge)
    }

    /// Checks the results of cells in the database rows `rows`, and returns the valid results. `simulation` is true if
    /// the results must come from simulated runs. `artefacts` names the folder with the large files. Reports the reason
    /// for each invalid result to the plant, and adds the reason to `skipped`, the list of rejected results.
    ///
    /// Returns an error if the plant cannot be reached.
    async fn verify_results(
        &mut self,
        link: &DatabaseLink,
        artefacts: Option<&ArtefactSettings>,
        (rows, simulation): (Vec<Row>, bool),
    ) -> Result<Vec<DeliveredResult>, PlantError> {
        let mut believed = Vec::new();
        for row in rows {
            let (cell, run): (String, String) = (row.get(2), row.get(3));
            match read_result(&row, artefacts, simulation) {
                Ok(given) => believed.push(given),
                Err(reason) => self.refuse(link, &CellRun { cell, run }, &reason).await?,
            }
        }
        Ok(believed)
    }

    /// Removes the results that contradict those of most other cells, and reports each to the plant. Of two cells that
    /// contradict each other, none teaches.
    ///
    /// Returns an error if the plant cannot be reached.
    async fn leave_out_contradicting(&mut self, link: &DatabaseLink) -> Result<(), PlantError> {
        let contradicting = Learned::contradicting(&self.results);
        for ((from, learned), contradicts) in std::mem::take(&mut self.results).into_iter().zip(contradicting) {
            match contradicts {
                false => self.results.push((from, learned)),
                true => {
                    self.refuse(link, &from, "it contradicts what most other cells have learned of such parts").await?
                }
            }
        }
        Ok(())
    }

    /// Reports to the plant that the result `from` is not used, and adds the reason to `skipped`.
    ///
    /// Returns an error if the plant cannot be reached.
    async fn refuse(&mut self, link: &DatabaseLink, from: &CellRun, reason: &str) -> Result<(), PlantError> {
        let words = format!("the learned error of {} of {} is ignored: {reason}", from.run, from.cell);
        let values: [&(dyn ToSql + Sync); 3] = [&from.run, &"a lesson refused", &words];
        let told = link.client().query_one("SELECT complain($1, $2, $3)", &values).await;
        told.map_err(refused("the report of a problem"))?;
        self.skipped.push(words);
        Ok(())
    }
}

/// Reads the learned result of a cell from `row`, a row of the database. If the row does not contain the content of the
/// result file, reads the content from the folder of large files, which `artefacts` names. `simulation` is true if the
/// run of this cell is simulated. Checks that the content has the SHA-256 hash in `row` and that the result fits the
/// kind of part in `row`.
///
/// Returns the reason as a text if the result cannot be used.
fn read_result(row: &Row, artefacts: Option<&ArtefactSettings>, simulation: bool) -> Result<DeliveredResult, String> {
    let (kind, is_own): (String, bool) = (row.get(0), row.get(1));
    let from = CellRun { cell: row.get(2), run: row.get(3) };
    let sha256: &[u8] = row.get(4);
    let content = match (row.get::<_, Option<Vec<u8>>>(5), artefacts) {
        (Some(content), _) => content,
        (None, Some(kept)) => {
            let name = HEXLOWER.encode(sha256);
            bounded(&kept.folder.join(&name[..2]).join(&name)).map_err(|error| error.to_string())?
        }
        (None, None) => return Err("its file is in a folder that [artefacts] of this plant file does not name".into()),
    };
    if sha256_hex(&content) != HEXLOWER.encode(sha256) {
        return Err("it differs from the record".into());
    }
    check_signature(row, &from.run)?;
    let place: PathBuf = [&from.cell, &from.run, RunFile::Learned.name()].iter().collect();
    let stated = SettingIdentity { id: kind.clone(), earlier: kind.clone() };
    let learned = Learned::read_other(&place, &content, &stated, simulation).map_err(|error| error.to_string())?;
    Ok(DeliveredResult { kind, is_own, from, learned })
}

/// Checks that the cell has signed the result in `row`: the last records of its run name the file `learned.json` with the
/// SHA-256 hash in `row`, and end with a seal that one of the keys of the cell has made. `run` is the name of the run.
///
/// Returns the reason as a text if this is not proven.
fn check_signature(row: &Row, run: &str) -> Result<(), String> {
    let sha256 = HEXLOWER.encode(row.get(4));
    let before = HEXLOWER.encode(row.get(7));
    let texts: Vec<String> = row.get(8);
    let keys: Vec<PublicKey> = row.get::<_, Vec<String>>(9).iter().filter_map(|key| key.parse().ok()).collect();
    let files = Excerpt { run, before: &before, texts: &texts }.verify(&keys).map_err(|error| error.to_string())?;
    match files.iter().any(|file| file.name == RunFile::Learned.name() && file.sha256 == sha256) {
        true => Ok(()),
        false => Err("the signed records do not name its file".into()),
    }
}

/// Reads a file. Returns an error if it is longer than [`MAX_BYTES`].
fn bounded(path: &Path) -> io::Result<Vec<u8>> {
    let mut content = Vec::new();
    fs::File::open(path)?.take(MAX_BYTES + 1).read_to_end(&mut content)?;
    match content.len() as u64 {
        0..=MAX_BYTES => Ok(content),
        _ => Err(io::Error::other(format!("it is larger than the limit of {MAX_BYTES} bytes"))),
    }
}

/// Registers the learned result of a finished run in the plant, so that other cells can use it. The learned result is
/// the file `learned.json` in the run folder `folder`. `id` is the id of the run in the plant. All files of the run
/// must have arrived at the plant before.
///
/// Returns `Ok(None)` if the result is registered. Also returns `Ok(None)` if the run has no such file, if the file
/// cannot be read, if its content differs from the record, or if the file does not name its kind of part. Returns
/// `Ok(Some(reason))` if the plant refuses the result. Returns an error if the plant cannot be reached.
pub(crate) async fn teach(link: &DatabaseLink, folder: &Path, id: i32) -> Result<Option<String>, PlantError> {
    let failed = refused("the learned error of a run");
    let text = "SELECT a.sha256 FROM run_artefact a WHERE a.run = $1 AND a.name = $2 AND NOT EXISTS (SELECT FROM lesson l WHERE l.run = $1)";
    let Some(row) = link.client().query_opt(text, &[&id, &RunFile::Learned.name()]).await.map_err(&failed)? else {
        return Ok(None);
    };
    let sha256: &[u8] = row.get(0);
    // A file that differs from its record was reported elsewhere, and is not used for learning.
    let Ok(content) = fs::read(folder.join(RunFile::Learned.name())) else { return Ok(None) };
    if sha256_hex(&content) != HEXLOWER.encode(sha256) {
        return Ok(None);
    }
    // A file of an earlier version does not name its kind of parts, so it is not used either.
    let Ok(Head { kind: Some(kind) }) = serde_json::from_slice(&content) else { return Ok(None) };
    let row = link.client().query_one("SELECT teach($1, $2, $3)", &[&id, &kind, &sha256]).await;
    Ok(row.map_err(&failed)?.get(0))
}
