//! Replication of the journals of a cell to the plant. Records are sent at least once, and stored exactly once.
//!
//! ```text
//!  runs/<id>/journal.sqlite --records--> ship() --+--> record      the chain is verified on arrival
//!                  recorded files --by hash-----> +--> artefact    each content is stored once
//!                  summary of the run ----------> +--> run, cycle
//! ```
//!
//! The plant alone stores how far a run is replicated. After any loss, a round therefore continues from the plant's
//! state. A journal that is shorter than the plant's copy, or differs from it, was cut or rewritten; it is reported and
//! not replicated further.

use std::collections::{HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};

use data_encoding::HEXLOWER;
use regrind_formats::run_files::RunFile;
use regrind_formats::{ResultFolder, write_atomic};
use regrind_journal::{Reader, Record, RecordKind, Stamp, has_record, sha256_hex, stamp};
use regrind_report::{RunResult, RunSummary, run_summary};
use serde_json::{Value, json};
use tokio_postgres::types::ToSql;

use super::copy::PlantRun;
use super::error::{PlantError, refused};
use super::knowledge::teach;
use super::link::DatabaseLink;
use super::settings::ArtefactSettings;

/// Maximum number of records, and of bytes of text, in one batch.
const MAX_RECORDS: usize = 1000;
const MAX_BYTES: usize = 1 << 20;
/// Maximum size of the content of a file in the database, in bytes.
const MAX_CONTENT_BYTES: u64 = 256 << 20;

/// Replicates the runs of a folder.
pub struct Replicator {
    runs: PathBuf,
    artefacts: Option<ArtefactSettings>,
    /// Runs that are completely replicated, with the stamp of their files at that time.
    settled: HashMap<String, Stamp>,
    /// Runs that cannot be replicated, with the reason.
    skipped: HashMap<String, String>,
    /// Files, by run and name, that cannot be replicated and were reported.
    reported: HashSet<(String, String)>,
}

/// Result of one round.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ReplicationResult {
    /// Number of records that the plant did not have.
    pub records: u64,
    /// Number of file contents that the plant did not have.
    pub files: u64,
    /// Number of runs of which something was sent.
    pub runs: u64,
    /// Runs that differ from the plant's copy, or that have a file which cannot be sent, with the reason. Each is
    /// reported once.
    pub differ: Vec<(String, String)>,
}

/// State of a run in the plant.
struct PlantRunState {
    id: i32,
    records: i32,
    head: Vec<u8>,
}

impl Replicator {
    /// Creates a replicator for `runs`, the folder that contains the run folders of a cell. `artefacts` names the
    /// folder for files that are too large for the plant's database; it is `None` if there is no such folder. Sends
    /// nothing yet.
    pub fn new(runs: PathBuf, artefacts: Option<ArtefactSettings>) -> Self {
        Self { runs, artefacts, settled: HashMap::new(), skipped: HashMap::new(), reported: HashSet::new() }
    }

    /// Returns the runs that are no longer replicated because they differ from the plant's copy, each with the reason.
    pub fn skipped(&self) -> impl Iterator<Item = (&str, &str)> {
        self.skipped.iter().map(|(run, reason)| (run.as_str(), reason.as_str()))
    }

    /// Sends the records and files that the plant does not have yet, the run with the newest change first. Returns the
    /// numbers of records, files and runs that were sent, and the faults of single runs.
    ///
    /// # Errors
    /// Fails if the plant cannot be reached or refuses a request. A run that differs from the plant's copy is not an
    /// error: the result lists this run, and the other runs are still sent. A run whose journal cannot be read now is
    /// tried again in a later round.
    pub async fn round(&mut self, link: &DatabaseLink) -> Result<ReplicationResult, PlantError> {
        let mut shipped = ReplicationResult::default();
        for (name, stamp) in self.unsettled() {
            match self.replicate_run(link, &name, &mut shipped).await {
                Ok(true) => drop(self.settled.insert(name, stamp)),
                Ok(false) => {}
                Err(PlantError::Differs { run, what }) => {
                    self.skipped.insert(run.clone(), what.clone());
                    shipped.differ.push((run, what));
                }
                // The journal is being created, or cannot be read now: a later round retries.
                Err(PlantError::Journal(_) | PlantError::Report(_)) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(shipped)
    }

    /// Returns the runs whose journal has changed since the run was last replicated completely, the newest change
    /// first. Omits runs that are skipped because they differ from the plant's copy. The stamp of a run contains the
    /// modification times and lengths of its journal files.
    fn unsettled(&self) -> Vec<(String, Stamp)> {
        let entries = fs::read_dir(&self.runs).into_iter().flatten().filter_map(Result::ok);
        let named = entries.filter_map(|entry| entry.file_name().into_string().ok());
        let mut open: Vec<(String, Stamp)> = named
            .filter(|name| !name.starts_with('.') && has_record(&self.runs.join(name)))
            .map(|name| (stamp(&self.runs.join(&name)), name))
            .filter(|(at, name)| self.settled.get(name) != Some(at) && !self.skipped.contains_key(name))
            .map(|(stamp, name)| (name, stamp))
            .collect();
        open.sort_by_key(|(_, stamp)| std::cmp::Reverse(stamp.changed_at()));
        open
    }

    /// Sends the new records and files of the run named `name` to the plant. Adds the counts of the sent records and
    /// files to `shipped`, the result of the current round. Returns true if the plant then has all records and files
    /// that the run had at the beginning of the call. Returns false if a file cannot be sent, or if the journal is
    /// still empty.
    ///
    /// Returns an error if the journal cannot be read, if it differs from the plant's copy, or if the plant cannot be
    /// reached.
    async fn replicate_run(
        &mut self,
        link: &DatabaseLink,
        name: &str,
        shipped: &mut ReplicationResult,
    ) -> Result<bool, PlantError> {
        let folder = self.runs.join(name);
        let Some(last) = Reader::open(&folder)?.last()? else { return Ok(false) };
        let mut there = open_run(link, name).await?;
        let began_with = there.records;
        compare_with_plant(link, &folder, name, &there).await?;
        while i64::from(there.records) < last.seq as i64 {
            let batch = batch(&folder, there.records)?;
            if batch.is_empty() {
                break;
            }
            there = send_records(link, name, there, &batch).await?;
        }
        let [given, missing] = self.give_files(link, &folder, name, there.id, shipped).await?;
        let is_over =
            || Ok::<_, PlantError>(matches!(last.kind, RecordKind::End | RecordKind::Seal) && has_end(&folder, &last)?);
        if there.records > began_with || is_over()? {
            report_run(link, there.id, &run_overview(&folder)?).await?;
        }
        if missing == 0 && is_over()? {
            self.teach(link, &folder, name, there.id, shipped).await?;
        }
        shipped.records += u64::try_from(there.records - began_with).unwrap_or(0);
        shipped.files += given;
        shipped.runs += u64::from(there.records > began_with || given > 0);
        Ok(missing == 0 && i64::from(there.records) >= last.seq as i64)
    }

    /// Registers the file `learned.json` of a finished run in the plant, so that other cells can use what this cell has
    /// learned. `folder` is the run folder, `run` the name of the run, and `id` its id in the plant. If the plant
    /// refuses the file, adds the reason to `shipped`, the result of the current round, but only once for each run.
    /// Does nothing if the run has no such file, if the file cannot be read, if its content differs from the record, or
    /// if the file does not name its kind of part. Returns an error if the plant cannot be reached.
    async fn teach(
        &mut self,
        link: &DatabaseLink,
        folder: &Path,
        run: &str,
        id: i32,
        shipped: &mut ReplicationResult,
    ) -> Result<(), PlantError> {
        if let Some(reason) = teach(link, folder, id).await?
            && self.reported.insert((run.to_owned(), RunFile::Learned.name().to_owned()))
        {
            shipped.differ.push((run.to_owned(), reason));
        }
        Ok(())
    }

    /// Sends the files of a run whose contents the plant does not have. `folder` is the run folder, `run` the name of
    /// the run, and `id` its id in the plant. Returns two counts: first the number of files that were sent, then the
    /// number of files that cannot be sent.
    ///
    /// If a file cannot be sent, reports this to the plant and adds the reason to `shipped`, the result of the current
    /// round. This is done only once for each file. Returns an error if the plant cannot be reached.
    async fn give_files(
        &mut self,
        link: &DatabaseLink,
        folder: &Path,
        run: &str,
        id: i32,
        shipped: &mut ReplicationResult,
    ) -> Result<[u64; 2], PlantError> {
        let failed = refused("the query of missing files");
        let rows = link.client().query("SELECT name, sha256, bytes FROM missing_artefacts($1)", &[&id]).await;
        let mut files = [0; 2];
        for row in rows.map_err(failed)? {
            let (name, sha256, bytes): (&str, &[u8], i64) = (row.get(0), row.get(1), row.get(2));
            let Some(what) = self.give_file(link, &folder.join(name), sha256, bytes as u64).await? else {
                files[0] += 1;
                continue;
            };
            files[1] += 1;
            if self.reported.insert((run.to_owned(), name.to_owned())) {
                let what = format!("the file {name} {what}");
                complain(link, run, "a file that cannot be shipped", &what).await?;
                shipped.differ.push((run.to_owned(), what));
            }
        }
        Ok(files)
    }

    /// Sends the content of the file at `path` to the plant. `sha256` and `bytes` are the hash and the length that the
    /// journal recorded. Puts a large file into the folder for large files, if there is one.
    ///
    /// Returns `None` if the file was sent. Returns the reason if the file cannot be sent: it cannot be read, its
    /// length or hash differs from the record, or it is too large for the database. Returns an error if the plant
    /// cannot be reached, or if the folder for large files cannot be written.
    async fn give_file(
        &self,
        link: &DatabaseLink,
        path: &Path,
        sha256: &[u8],
        bytes: u64,
    ) -> Result<Option<String>, PlantError> {
        let read = match fs::metadata(path) {
            Ok(found) if found.len() == bytes => fs::read(path),
            Ok(_) => return Ok(Some("was changed".into())),
            Err(error) => Err(error),
        };
        let content = match read {
            Ok(content) => content,
            Err(error) => return Ok(Some(format!("cannot be read: {error}"))),
        };
        if sha256_hex(&content) != HEXLOWER.encode(sha256) {
            return Ok(Some("was changed".into()));
        }
        let failed = refused("the content of a file");
        if let Some(kept) = self.artefacts.as_ref().filter(|kept| bytes as f64 >= kept.from_mb * 1e6) {
            put_aside(&kept.folder, sha256, &content)?;
            let placed = link.client().query_one("SELECT place_artefact($1, $2)", &[&sha256, &(bytes as i64)]).await;
            if placed.map_err(&failed)?.get(0) {
                return Ok(None);
            }
        }
        if bytes > MAX_CONTENT_BYTES {
            let most = MAX_CONTENT_BYTES >> 20;
            return Ok(Some(format!(
                "has {} MB, and the database accepts at most {most} MB: name a folder in [artefacts]",
                bytes >> 20
            )));
        } else {
            link.client().query_one("SELECT give_artefact($1, $2)", &[&sha256, &content]).await.map_err(failed)?;
        }
        Ok(None)
    }
}

/// Writes `content` to a file in `folder`, the folder for large files. The name of the file is `sha256` in hexadecimal
/// digits, in a subfolder that is named by its first two digits. Does nothing if the file already has this content, and
/// otherwise replaces it.
fn put_aside(folder: &Path, sha256: &[u8], content: &[u8]) -> Result<(), PlantError> {
    let name = HEXLOWER.encode(sha256);
    let path = folder.join(&name[..2]).join(&name);
    if fs::read(&path).is_ok_and(|found| found == content) {
        return Ok(());
    }
    let parent = folder.join(&name[..2]);
    let failed = |error| PlantError::folder(folder, error);
    ResultFolder::prepare(&parent).map_err(failed)?.keep();
    write_atomic(&path, content).map_err(failed)
}

async fn open_run(link: &DatabaseLink, name: &str) -> Result<PlantRunState, PlantError> {
    let row = link.client().query_one("SELECT id, records, head FROM open_run($1)", &[&name]).await;
    let row = row.map_err(refused("to open a run"))?;
    Ok(PlantRunState { id: row.get(0), records: row.get(1), head: row.get(2) })
}

/// Checks that the journal of a run at the cell agrees with the plant's copy. `folder` is the run folder, and `run` is
/// the name of the run. `there` is the state of the plant's copy: the number of records that the plant has, and the
/// hash of the last of these records. The journal must contain the record with this number, and this record must have
/// this hash. If the plant has no records yet, there is no check.
///
/// If the check fails, the journal was cut or rewritten. The function then reports this to the plant and returns an
/// error. Also returns an error if the journal cannot be read.
async fn compare_with_plant(
    link: &DatabaseLink,
    folder: &Path,
    run: &str,
    there: &PlantRunState,
) -> Result<(), PlantError> {
    let copy = PlantRun {
        id: there.id,
        cell: String::new(),
        name: run.to_owned(),
        records: u64::try_from(there.records).unwrap_or(0),
        head: HEXLOWER.encode(&there.head),
        keys: Vec::new(),
        archive: None,
    };
    match copy.check_local_journal(folder) {
        Err(PlantError::Differs { run, what }) => {
            complain(link, &run, "a journal that differs", &what).await?;
            Err(PlantError::Differs { run, what })
        }
        other => other,
    }
}

/// Reads the next records to send from the journal in `folder`, beginning with record number `records` + 1. Stops after
/// 1000 records, or after the record with which the size exceeds 1 MiB. Returns an empty list if there are no more
/// records.
fn batch(folder: &Path, records: i32) -> Result<Vec<Record>, PlantError> {
    let mut batch = Vec::new();
    let mut bytes = 0;
    let reader = Reader::open(folder)?;
    for record in reader.records(u64::try_from(records).unwrap_or(0) + 1) {
        let record = record?;
        bytes += record.payload.len() + 300;
        batch.push(record);
        if batch.len() == MAX_RECORDS || bytes > MAX_BYTES {
            break;
        }
    }
    Ok(batch)
}

/// Sends the records `batch` of the run `run` to the plant. `there` is the state of the run in the plant before.
/// Returns the new state: the number of records that the plant has, and the hash of the last of them.
///
/// Returns an error if the plant refuses the records or cannot be reached. If only the answer is lost, the next round
/// queries the state again.
async fn send_records(
    link: &DatabaseLink,
    run: &str,
    there: PlantRunState,
    batch: &[Record],
) -> Result<PlantRunState, PlantError> {
    let hashes: Vec<Vec<u8>> =
        batch.iter().map(|record| HEXLOWER.decode(record.hash.as_bytes()).unwrap_or_default()).collect();
    let texts: Vec<String> = batch.iter().map(Record::text).collect();
    let from = there.records + 1;
    let values: [&(dyn ToSql + Sync); 4] = [&there.id, &from, &hashes, &texts];
    let row = link.client().query_one("SELECT records, head, refused FROM ship($1, $2, $3, $4)", &values).await;
    let row = row.map_err(refused("records"))?;
    match row.get::<_, Option<String>>(2) {
        Some(what) => Err(PlantError::Differs { run: run.to_owned(), what: format!("the plant refuses it: {what}") }),
        None => Ok(PlantRunState { records: row.get(0), head: row.get(1), ..there }),
    }
}

/// Returns true if the journal of a run contains the record of the end of the run. `last` is the last record of the
/// journal. Checks `last` and the record before it, because one seal (a record with a signature) follows the end of a
/// signed run.
fn has_end(folder: &Path, last: &Record) -> Result<bool, PlantError> {
    if last.kind == RecordKind::End {
        return Ok(true);
    }
    let before = Reader::open(folder)?.records(last.seq - 1).next().transpose()?;
    Ok(before.is_some_and(|before| before.kind == RecordKind::End))
}

async fn complain(link: &DatabaseLink, run: &str, what: &str, words: &str) -> Result<(), PlantError> {
    let told = link.client().query_one("SELECT complain($1, $2, $3)", &[&run, &what, &words]).await;
    told.map(drop).map_err(refused("the report of a problem"))
}

async fn report_run(link: &DatabaseLink, id: i32, told: &Value) -> Result<(), PlantError> {
    let text = told.to_string();
    let asked = link.client().execute("SELECT tell_run($1, $2::text::jsonb)", &[&id, &text]).await;
    asked.map(drop).map_err(refused("the status of a run"))
}

/// Returns a summary of the run in `folder` as JSON: result, verdict, limits, machines, number of alarms, and the
/// figures of each cycle. PV and RMS and their limits are in µm. A value that is not on record is `null`.
///
/// # Errors
/// Fails if the journal of the run cannot be read.
pub fn run_overview(folder: &Path) -> Result<Value, PlantError> {
    let RunSummary { result, verdict, tolerance, cycles, alarms, machines, wheel_radius_mm, .. } = run_summary(folder)?;
    // A missing limit is infinite, which JSON cannot represent.
    let limit = |mm: f64| mm.is_finite().then_some(1e3 * mm);
    let cycles = cycles.iter().map(|of| {
        let [[pv, pv_u], [rms, rms_u]] = of.figures.map_or([[None; 2]; 2], |figures| figures.map(|of| of.map(Some)));
        let [expected_pv, expected_rms] = of.expected.map_or([None; 2], |of| of.map(Some));
        json!({
            "cycle": of.cycle, "verdict": of.recorded_verdict(), "reason": of.reason, "pv_um": pv, "pv_u_um": pv_u, "rms_um": rms, "rms_u_um": rms_u,
            "expected_pv_um": expected_pv, "expected_rms_um": expected_rms, "map": of.map,
        })
    });
    let [cmm, grinder] = machines;
    Ok(json!({
        "result": result_word(result), "verdict": verdict, "alarms": alarms.len(), "cmm": cmm, "grinder": grinder,
        "wheel": wheel_radius_mm.map(|mm| format!("R {mm:.3} mm")), "probe": probe_of(folder).map(|mm| format!("R {mm:.3} mm")),
        "pv_limit_um": tolerance.and_then(|of| limit(of.pv_mm)), "rms_limit_um": tolerance.and_then(|of| limit(of.rms_mm)),
        "cycles": cycles.collect::<Vec<_>>(),
    }))
}

/// Returns the radius of the probe in mm, from the file `recipe.toml` in the run folder `folder`. Returns `None` if the
/// file cannot be read or contains no radius.
fn probe_of(folder: &Path) -> Option<f64> {
    let recipe: toml::Table = fs::read_to_string(folder.join(RunFile::Recipe.name())).ok()?.parse().ok()?;
    recipe.get("measure")?.get("probe_radius_mm")?.as_float()
}

fn result_word(result: RunResult) -> &'static str {
    match result {
        RunResult::Open => "open",
        RunResult::Accepted => "accepted",
        RunResult::NotAccepted => "not accepted",
        RunResult::Stopped => "stopped",
        RunResult::Aborted => "aborted",
        RunResult::Recovery => "recovery",
    }
}
