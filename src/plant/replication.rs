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
use std::time::SystemTime;

use data_encoding::HEXLOWER;
use regrind_formats::run_files::RunFile;
use regrind_formats::{ResultFolder, write_atomic};
use regrind_journal::{JournalError, Reader, Record, RecordKind, Stamp, has_record, is_driven, sha256_hex, stamp};
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
    /// True if the runs were compared with those of the plant since the connection was made.
    is_compared: bool,
    /// Runs whose records are all at the plant.
    shipped: HashMap<String, ShippedRun>,
    /// Runs that cannot be replicated, with the reason.
    skipped: HashMap<String, String>,
    /// Runs whose journal could not be read in the last round, with the reason.
    unread: HashMap<String, String>,
    /// Flaws, by run and what is concerned, that were returned to the caller.
    reported: HashSet<(String, String)>,
}

/// Run at the cell whose records are all at the plant.
struct ShippedRun {
    /// Stamp of the journal before it was read.
    stamp: Stamp,
    /// Number and hash of its last record.
    last: (u64, String),
    /// Files on record that cannot be sent.
    lacks: Vec<LackingFile>,
}

/// File on record that cannot be sent.
struct LackingFile {
    path: PathBuf,
    /// State of the file when it was read.
    state: FileState,
    reason: String,
}

/// Time of the last change of a file and its length in bytes; `None` without a file.
type FileState = Option<(SystemTime, u64)>;

fn file_state(path: &Path) -> FileState {
    let found = fs::metadata(path).ok()?;
    Some((found.modified().ok()?, found.len()))
}

impl ShippedRun {
    /// Returns true if a file that could not be sent has changed since then.
    fn is_mended(&self) -> bool {
        self.lacks.iter().any(|file| file_state(&file.path) != file.state)
    }
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
        Self {
            runs,
            artefacts,
            is_compared: false,
            shipped: HashMap::new(),
            skipped: HashMap::new(),
            unread: HashMap::new(),
            reported: HashSet::new(),
        }
    }

    /// States that the next round has a new connection. The plant can then have another state, for example that of its
    /// backup. So the next round compares the runs with those of the plant first.
    pub fn reconnected(&mut self) {
        self.is_compared = false;
    }

    /// Returns the runs that are no longer replicated because they differ from the plant's copy, each with the reason.
    pub fn skipped(&self) -> impl Iterator<Item = (&str, &str)> {
        self.skipped.iter().map(|(run, reason)| (run.as_str(), reason.as_str()))
    }

    /// Returns the runs of which the plant lacks something that cannot be sent: a file that is missing or was changed, or
    /// a journal that cannot be read. Each has the reason. A run can occur several times.
    pub fn lacking(&self) -> impl Iterator<Item = (&str, &str)> {
        let files =
            self.shipped.iter().flat_map(|(run, shipped)| shipped.lacks.iter().map(move |file| (run, &file.reason)));
        files.chain(&self.unread).map(|(run, reason)| (run.as_str(), reason.as_str()))
    }

    /// Sends the records and files that the plant does not have yet, the run with the newest change first. Returns the
    /// numbers of records, files and runs that were sent, and the faults of single runs. In the first round of a
    /// connection, one query tells which runs are whole at the plant.
    ///
    /// # Errors
    /// Fails if the plant cannot be reached or refuses a request. A run that differs from the plant's copy is not an
    /// error: the result lists this run, and the other runs are still sent. A run whose journal cannot be read now is
    /// tried again in a later round.
    pub async fn round(&mut self, link: &DatabaseLink) -> Result<ReplicationResult, PlantError> {
        if !self.is_compared {
            self.compare_with_plant(link).await?;
            self.is_compared = true;
        }
        let mut shipped = ReplicationResult::default();
        self.unread.clear();
        for (name, stamp) in self.changed() {
            match self.replicate_run(link, (&name, stamp), &mut shipped).await {
                Ok(Some(run)) => drop(self.shipped.insert(name, run)),
                Ok(None) => {}
                Err(PlantError::Differs { run, what }) => {
                    self.skipped.insert(run.clone(), what.clone());
                    shipped.differ.push((run, what));
                }
                Err(error @ PlantError::Value { .. }) => {
                    let what = error.to_string();
                    complain(link, &name, "a run that is not accepted", &what, &what).await?;
                    self.skipped.insert(name.clone(), what.clone());
                    shipped.differ.push((name, what));
                }
                // The journal is being created, or cannot be read now: a later round retries.
                Err(error @ (PlantError::Journal(_) | PlantError::Report(_))) => {
                    self.take_unread(name, &error, &mut shipped);
                }
                Err(error) => return Err(error),
            }
        }
        Ok(shipped)
    }

    /// Takes notice of `error`, for which the journal of the run `name` cannot be read. Adds it to `shipped`, the result
    /// of the round, but only once for each reason. A program that drives the run possibly creates the journal now.
    fn take_unread(&mut self, name: String, error: &PlantError, shipped: &mut ReplicationResult) {
        if is_driven(&self.runs.join(&name)) {
            return;
        }
        let reason = error.to_string();
        if self.reported.insert((name.clone(), reason.clone())) {
            shipped.differ.push((name.clone(), reason.clone()));
        }
        self.unread.insert(name, reason);
    }

    /// Asks the plant once which runs of this cell it has as a whole: ended, with all files, with their result, and with
    /// what they have learned. A run whose end is not signed with a key of the cell teaches nothing, so no lesson of it is
    /// missed. Those runs are not read again if the last record of their journal is the last one that the plant has.
    /// Forgets all that was known about the runs before.
    ///
    /// Returns an error if the plant cannot be reached.
    async fn compare_with_plant(&mut self, link: &DatabaseLink) -> Result<(), PlantError> {
        self.shipped.clear();
        self.skipped.clear();
        let text = "SELECT r.name, r.records, r.head FROM run r
            WHERE r.cell = (SELECT own_cell()) AND r.ended IS NOT NULL AND r.result <> 'open'
            AND NOT EXISTS (SELECT FROM run_artefact a WHERE a.run = r.id
                AND NOT EXISTS (SELECT FROM artefact_of o WHERE o.cell = r.cell AND o.sha256 = a.sha256))
            AND NOT EXISTS (SELECT FROM run_artefact a WHERE a.run = r.id AND a.name = $1
                AND NOT EXISTS (SELECT FROM lesson l WHERE l.run = r.id)
                AND EXISTS (SELECT FROM record e JOIN cell_key k ON k.cell = r.cell WHERE e.run = r.id AND e.seq = r.records
                    AND e.text::json ->> 'kind' = 'seal' AND e.text::json -> 'payload' ->> 'key' = k.key))";
        let rows = link.client().query(text, &[&RunFile::Learned.name()]).await;
        for row in rows.map_err(refused("the query of the runs of this cell"))? {
            let (name, records, head): (String, i32, &[u8]) = (row.get(0), row.get(1), row.get(2));
            // The name of a run at the plant is used only as that of a folder which is there.
            if name.starts_with('.') || name.contains(['/', '\\']) || !has_record(&self.runs.join(&name)) {
                continue;
            }
            let stamp = stamp(&self.runs.join(&name));
            let last = (u64::try_from(records).unwrap_or(0), HEXLOWER.encode(head));
            if last_of(&self.runs.join(&name)).is_some_and(|found| found == last) {
                self.shipped.insert(name, ShippedRun { stamp, last, lacks: Vec::new() });
            }
        }
        Ok(())
    }

    /// Returns the runs of which something possibly is to be sent, the newest change first, each with the stamp of its
    /// journal (modification times and lengths). Omits runs that are skipped because they differ from the plant's copy,
    /// and those whose last record is at the plant and whose missing files are still missing.
    fn changed(&mut self) -> Vec<(String, Stamp)> {
        let entries = fs::read_dir(&self.runs).into_iter().flatten().filter_map(Result::ok);
        let named = entries.filter_map(|entry| entry.file_name().into_string().ok());
        let runs: Vec<String> = named
            .filter(|name| !name.starts_with('.') && !self.skipped.contains_key(name))
            .filter(|name| has_record(&self.runs.join(name)))
            .collect();
        let mut changed = Vec::new();
        for name in runs {
            let folder = self.runs.join(&name);
            let stamp = stamp(&folder);
            match self.shipped.get_mut(&name) {
                Some(run) if !run.is_mended() && run.stamp == stamp => {}
                // A stamp equals no other one soon after a change, or if the clock was set back: then the last record
                // shows whether there is a new one.
                Some(run)
                    if !run.is_mended()
                        && run.stamp.has_same_files(&stamp)
                        && last_of(&folder).as_ref() == Some(&run.last) =>
                {
                    run.stamp = stamp;
                }
                _ => changed.push((name, stamp)),
            }
        }
        changed.sort_by_key(|(_, stamp)| std::cmp::Reverse(stamp.changed_at()));
        changed
    }

    /// Sends the new records and files of the run named `name` to the plant. `stamp` is the stamp of its journal. Adds the
    /// counts of the sent records and files to `shipped`, the result of the current round. Returns the state of the run
    /// if the plant then has all records that the run had at the beginning of the call: its last record, and the files
    /// that cannot be sent. Returns `None` if the journal is still empty.
    ///
    /// Returns an error if the journal cannot be read, if it differs from the plant's copy, or if the plant cannot be
    /// reached.
    async fn replicate_run(
        &mut self,
        link: &DatabaseLink,
        (name, stamp): (&str, Stamp),
        shipped: &mut ReplicationResult,
    ) -> Result<Option<ShippedRun>, PlantError> {
        let folder = self.runs.join(name);
        let Some(last) = Reader::open(&folder)?.last()? else { return Ok(None) };
        let known = self.shipped.remove(name).filter(|run| (run.last.0, &run.last.1) == (last.seq, &last.hash));
        if let Some(run) = known {
            // There is no new record, but the files of the journal have changed.
            check_rewritten(link, &folder, name).await?;
            if !run.is_mended() {
                return Ok(Some(ShippedRun { stamp, ..run }));
            }
        }
        let mut there = open_run(link, name).await?;
        let began_with = there.records;
        compare_journal(link, &folder, name, &there).await?;
        while i64::from(there.records) < last.seq as i64 {
            let batch = batch(&folder, there.records)?;
            if batch.is_empty() {
                break;
            }
            there = send_records(link, name, there, &batch).await?;
        }
        let (given, lacks) = self.give_files(link, &folder, name, there.id, shipped).await?;
        let is_over =
            || Ok::<_, PlantError>(matches!(last.kind, RecordKind::End | RecordKind::Seal) && has_end(&folder, &last)?);
        if there.records > began_with || is_over()? {
            report_run(link, there.id, &run_overview(&folder)?).await?;
        }
        if lacks.is_empty() && is_over()? {
            self.teach(link, &folder, name, there.id, shipped).await?;
        }
        shipped.records += u64::try_from(there.records - began_with).unwrap_or(0);
        shipped.files += given;
        shipped.runs += u64::from(there.records > began_with || given > 0);
        let has_all = i64::from(there.records) >= last.seq as i64;
        Ok(has_all.then_some(ShippedRun { stamp, last: (last.seq, last.hash), lacks }))
    }

    /// Registers the file `learned.json` of a finished run in the plant, so that other cells can use what this cell has
    /// learned. `folder` is the run folder, `run` the name of the run, and `id` its id in the plant. If the plant
    /// refuses the file, adds the reason to `shipped`, the result of the current round, but only once for each run.
    /// Does nothing if the plant has refused the file already. Does nothing if the run has no such file, if the file
    /// cannot be read, if its content differs from the record, or if the file does not name its kind of part. Returns an
    /// error if the plant cannot be reached.
    async fn teach(
        &mut self,
        link: &DatabaseLink,
        folder: &Path,
        run: &str,
        id: i32,
        shipped: &mut ReplicationResult,
    ) -> Result<(), PlantError> {
        // A refusal is final, because the run and its files do not change any more.
        let text = "SELECT FROM incident WHERE cell = (SELECT own_cell()) AND run = left($1, 300) AND what = 'a lesson refused'
            AND NOT starts_with(words, 'the learned error of ')";
        let known = link.client().query(text, &[&run]).await.map_err(refused("the query of incidents"))?;
        if !known.is_empty() {
            return Ok(());
        }
        if let Some(reason) = teach(link, folder, id).await?
            && self.reported.insert((run.to_owned(), RunFile::Learned.name().to_owned()))
        {
            shipped.differ.push((run.to_owned(), reason));
        }
        Ok(())
    }

    /// Sends the files of a run whose contents the plant does not have. `folder` is the run folder, `run` the name of
    /// the run, and `id` its id in the plant. Returns the number of files that were sent, and the files that cannot be
    /// sent.
    ///
    /// If a file cannot be sent, reports this to the plant, once for each file, and adds the reason to `shipped`, the
    /// result of the current round, once for each file of this replicator. Returns an error if the plant cannot be
    /// reached.
    async fn give_files(
        &mut self,
        link: &DatabaseLink,
        folder: &Path,
        run: &str,
        id: i32,
        shipped: &mut ReplicationResult,
    ) -> Result<(u64, Vec<LackingFile>), PlantError> {
        let failed = refused("the query of missing files");
        let rows = link.client().query("SELECT name, sha256, bytes FROM missing_artefacts($1)", &[&id]).await;
        let (mut given, mut lacks) = (0, Vec::new());
        for row in rows.map_err(failed)? {
            let (name, sha256, bytes): (&str, &[u8], i64) = (row.get(0), row.get(1), row.get(2));
            let path = folder.join(name);
            let state = file_state(&path);
            let Some(what) = self.give_file(link, &path, sha256, bytes as u64).await? else {
                given += 1;
                continue;
            };
            let reason = format!("the file {name} {what}");
            if self.reported.insert((run.to_owned(), name.to_owned())) {
                complain(link, run, "a file that cannot be shipped", &reason, &format!("the file {name} ")).await?;
                shipped.differ.push((run.to_owned(), reason.clone()));
            }
            lacks.push(LackingFile { path, state, reason });
        }
        Ok((given, lacks))
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
            let given = link.client().query_one("SELECT give_artefact($1, $2)", &[&sha256, &content]).await;
            if !given.map_err(failed)?.get::<_, bool>(0) {
                return Ok(Some("was refused by the plant: it is larger than the quota file_bytes".into()));
            }
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
async fn compare_journal(
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
            complain(link, &run, "a journal that differs", &what, &what).await?;
            Err(PlantError::Differs { run, what })
        }
        other => other,
    }
}

/// Checks that the records of a journal follow each other. `folder` is the run folder, and `run` is the name of the run.
///
/// If a record was changed, the function reports this to the plant and returns an error. Also returns an error if the
/// journal cannot be read.
async fn check_rewritten(link: &DatabaseLink, folder: &Path, run: &str) -> Result<(), PlantError> {
    match Reader::open(folder)?.check_chain() {
        Err(JournalError::Broken { seq, what, .. }) => {
            let what = format!("record {seq} of the journal was changed after replication: {what}");
            complain(link, run, "a journal that differs", &what, &what).await?;
            Err(PlantError::Differs { run: run.to_owned(), what })
        }
        other => Ok(other?),
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

/// Returns the number and the hash of the last record of a journal; `None` if there is none, or if it cannot be read.
fn last_of(folder: &Path) -> Option<(u64, String)> {
    let last = Reader::open(folder).ok()?.last().ok()??;
    Some((last.seq, last.hash))
}

/// Reports an incident of the run `run` to the plant: its kind `what`, and `words` about it. Does nothing if the plant
/// has an incident of this kind of the run already whose words begin with `known`, also from an earlier program.
async fn complain(link: &DatabaseLink, run: &str, what: &str, words: &str, known: &str) -> Result<(), PlantError> {
    let text = "SELECT complain($1, $2, $3) WHERE NOT EXISTS (SELECT FROM incident i WHERE i.cell = (SELECT own_cell())
        AND i.run = left($1, 300) AND i.what = left($2, 80) AND starts_with(i.words, left($4, 2000)))";
    let told = link.client().execute(text, &[&run, &what, &words, &known]).await;
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
