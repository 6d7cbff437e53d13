//! Archive of a plant: the runs of earlier months as run folders, which `audit verify` proves without the plant.
//!
//! ```text
//!  record, run_artefact, artefact --fetch, prove--> FOLDER/2024-11/CELL/RUN     the run keeps its row and its figures
//!                                 <--prove, restore--
//! ```
//!
//! A run leaves the database after its folder is on the disk and proven. A run that has not ended, or whose copy cannot
//! be proven, stays.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use data_encoding::HEXLOWER;
use regrind_formats::{ScratchFolder, move_folder};
use regrind_journal::{Artefact, JournalError, Reader, Record, RecordKind, is_plain_name};
use tokio_postgres::Transaction;
use tokio_postgres::error::SqlState;
use tokio_postgres::types::ToSql;

use super::copy::PlantRun;
use super::error::{PlantError, refused};
use super::link::DatabaseLink;
use super::settings::ArtefactSettings;

/// Number of records that are restored at once.
const BATCH: usize = 1000;
/// Maximum number of tries to remove what is archived, and the time between two.
const MAX_TRIES: usize = 120;
const BETWEEN_TRIES: Duration = Duration::from_millis(500);
/// Number of contents that are removed at once.
const CONTENTS: i32 = 1000;

/// Result of an archiving.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ArchiveResult {
    /// Number of runs that were written to the archive.
    pub runs: u64,
    /// Number of records that were removed from the database.
    pub records: u64,
    /// Number of contents of files that were removed from the database.
    pub contents: u64,
    /// Runs that stay in the database, with the reason.
    pub kept: Vec<(String, String)>,
}

/// Run of an earlier month.
struct OldRun {
    id: i32,
    cell: String,
    name: String,
    /// First day of its month, `YYYY-MM`.
    month: String,
    /// True if the run has ended, and no record has arrived for a day.
    is_over: bool,
}

/// Writes the runs of all months before `before` to `folder`, each to `folder/YYYY-MM/CELL/RUN`, and removes their
/// records and files from the database. `before` is the first month that stays, as `YYYY-MM`. The month of a run is that
/// of its first arrival at the plant. `artefacts` names the folder with the large files, which stay there. The database
/// role must be the owner.
///
/// # Errors
/// The plant cannot be reached, or refuses a step. A folder cannot be written. A single run that cannot be archived is not
/// an error: the result names it with the reason.
pub async fn archive_runs(
    link: &mut DatabaseLink,
    artefacts: Option<&ArtefactSettings>,
    (folder, before): (&Path, &str),
) -> Result<ArchiveResult, PlantError> {
    let mut result = ArchiveResult::default();
    for block in blocks(link, before).await? {
        for run in old_runs(link, block).await? {
            match archive_run(link, artefacts, folder, &run).await {
                Ok(None) => result.runs += 1,
                Ok(Some(reason)) => result.kept.push((format!("{} of {}", run.name, run.cell), reason)),
                // A wrong copy must not keep the others in the database.
                Err(error @ (PlantError::Journal(_) | PlantError::Differs { .. })) => {
                    result.kept.push((format!("{} of {}", run.name, run.cell), error.to_string()));
                }
                Err(error) => return Err(error),
            }
        }
        result.records += count(&while_in_use(link, "SELECT remove_records($1)", &[&block]).await?, 0);
    }
    result.contents = remove_contents(link).await?;
    Ok(result)
}

/// Removes the contents of files from the database that only archived runs name. Returns their number.
async fn remove_contents(link: &DatabaseLink) -> Result<u64, PlantError> {
    while_in_use(link, "SELECT wait_for_writers()", &[]).await?;
    let failed = refused("the removal of archived files");
    link.client().execute("SELECT keep_named_contents()", &[]).await.map_err(&failed)?;
    let mut contents = 0;
    loop {
        let text = "SELECT looked, removed FROM remove_contents($1)";
        let row = link.client().query_one(text, &[&CONTENTS]).await.map_err(&failed)?;
        contents += count(&row, 1);
        if count(&row, 0) == 0 {
            return Ok(contents);
        }
    }
}

/// Runs a query that needs tables for a moment. Tries again while cells and readers hold them.
async fn while_in_use(
    link: &DatabaseLink,
    text: &str,
    values: &[&(dyn ToSql + Sync)],
) -> Result<super::Row, PlantError> {
    let passes = |error: &tokio_postgres::Error| {
        error.code().is_some_and(|code| [SqlState::T_R_DEADLOCK_DETECTED, SqlState::LOCK_NOT_AVAILABLE].contains(code))
    };
    let failed = refused("a step of the archive");
    for _ in 1..MAX_TRIES {
        match link.client().query_one(text, values).await {
            Err(error) if passes(&error) => tokio::time::sleep(BETWEEN_TRIES).await,
            other => return other.map_err(failed),
        }
    }
    link.client().query_one(text, values).await.map_err(failed)
}

fn count(row: &super::Row, column: usize) -> u64 {
    u64::try_from(row.get::<_, i64>(column)).unwrap_or(0)
}

async fn blocks(link: &DatabaseLink, before: &str) -> Result<Vec<i32>, PlantError> {
    let text = "SELECT first FROM month_block WHERE month < ($1::text || '-01')::date ORDER BY month, first";
    let rows = link.client().query(text, &[&before]).await.map_err(refused("the months of the archive"))?;
    Ok(rows.iter().map(|row| row.get(0)).collect())
}

async fn old_runs(link: &DatabaseLink, block: i32) -> Result<Vec<OldRun>, PlantError> {
    let text = "SELECT id, cell, run, to_char(month, 'YYYY-MM'), is_over FROM archivable WHERE block = $1 ORDER BY id";
    let rows = link.client().query(text, &[&block]).await.map_err(refused("the runs of a month"))?;
    let run = |row: &super::Row| OldRun {
        id: row.get(0),
        cell: row.get(1),
        name: row.get(2),
        month: row.get(3),
        is_over: row.get(4),
    };
    Ok(rows.iter().map(run).collect())
}

/// Writes one run to the archive in `folder`, proves what was written, and marks the run as archived. Returns the reason
/// if the run stays in the database.
async fn archive_run(
    link: &DatabaseLink,
    artefacts: Option<&ArtefactSettings>,
    folder: &Path,
    run: &OldRun,
) -> Result<Option<String>, PlantError> {
    if !run.is_over {
        return Ok(Some("it has not ended, or its last record arrived less than a day ago".into()));
    }
    let [cell, name] =
        [&run.cell, &run.name].map(|name| (is_plain_name(name) && !name.starts_with('.')).then_some(name));
    let Some((cell, name)) = cell.zip(name) else {
        return Ok(Some("the name of the cell or of the run cannot be the name of a folder".into()));
    };
    let place = folder.join(&run.month).join(cell).join(name);
    let found = PlantRun::find(link, Some(&run.cell), &run.name).await?;
    if !place.exists() {
        let scratch = ScratchFolder::at(folder.join(format!(".archiving-{}", std::process::id())))?;
        // The name of the folder is that of the run, as the record says.
        let copy = scratch.path().join(name);
        found.fetch(link, artefacts, &copy).await?;
        prove(link, &found, &copy).await?;
        move_folder(&copy, &place)?;
    }
    // An earlier call can have ended between the move and the mark.
    prove(link, &found, &place).await?;
    let place = fs::canonicalize(&place).unwrap_or(place).display().to_string();
    let head = HEXLOWER.decode(found.head.as_bytes()).unwrap_or_default();
    let mark = "UPDATE run SET archived_at = now(), archive = $2 WHERE id = $1 AND head = $3 AND archived_at IS NULL";
    let values: [&(dyn ToSql + Sync); 3] = [&run.id, &place, &head];
    match link.client().execute(mark, &values).await.map_err(refused("the mark of an archived run"))? {
        0 => Ok(Some("records arrived while it was archived; archive it again".into())),
        _ => Ok(None),
    }
}

/// Proves a run folder with the keys of its cell. A run that arrived before its cell had a key is proven by its chain alone,
/// if it is not signed.
async fn prove(link: &DatabaseLink, run: &PlantRun, folder: &Path) -> Result<(), PlantError> {
    let proven = run.prove(folder, &[]);
    if !matches!(proven, Err(PlantError::Journal(JournalError::NoAuthor { .. }))) {
        return proven.map(drop);
    }
    let text =
        "SELECT r.arrived_at < (SELECT min(k.since) FROM cell_key k WHERE k.cell = r.cell) FROM run r WHERE r.id = $1";
    let row = link.client().query_one(text, &[&run.id]).await.map_err(refused("the keys of a cell"))?;
    let without_keys = PlantRun { keys: Vec::new(), ..run.clone() };
    match row.get::<_, Option<bool>>(0) {
        Some(true) => without_keys.prove(folder, &[]).and_then(|verified| match verified.signed {
            0 => Ok(()),
            _ => proven.map(drop),
        }),
        _ => proven.map(drop),
    }
}

/// Brings a run back from its folder in the archive. The folder must prove the run with the keys of its cell, and must
/// have the records that the plant had. Returns the name of the run with that of its cell. The database role must be the
/// owner.
///
/// # Errors
/// The folder proves nothing, the plant has no archived run with this record, or the plant cannot be reached.
pub async fn restore_run(link: &mut DatabaseLink, folder: &Path) -> Result<String, PlantError> {
    let records: Vec<Record> = Reader::open(folder)?.records(1).collect::<Result<_, _>>()?;
    let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let head = records.last().map(|last| last.hash.clone()).unwrap_or_default();
    let text = "SELECT c.name, r.id, r.cell, r.archive FROM run r JOIN cell c ON c.id = r.cell
        WHERE r.name = $1 AND r.head = decode($2, 'hex') AND r.archived_at IS NOT NULL";
    let rows = link.client().query(text, &[&name, &head]).await.map_err(refused("to find a run"))?;
    // Two cells can have the same run. Then its place in the archive decides.
    let place = fs::canonicalize(folder).unwrap_or_else(|_| folder.to_owned()).display().to_string();
    let is_here = |row: &&super::Row| row.get::<_, Option<&str>>(3) == Some(&place);
    let row = rows.iter().find(is_here).or_else(|| rows.first().filter(|_| rows.len() == 1));
    let row = row.ok_or_else(|| PlantError::NotArchived { folder: folder.to_owned() })?;
    let (cell, id, cell_id): (String, i32, i32) = (row.get(0), row.get(1), row.get(2));
    prove(link, &PlantRun::find(link, Some(&cell), &name).await?, folder).await?;
    while_in_use(link, "SELECT restore_partitions($1)", &[&id]).await?;
    let step = link.client_mut().transaction().await.map_err(refused("a run from the archive"))?;
    for batch in records.chunks(BATCH) {
        put_records(&step, id, batch).await?;
    }
    for record in records.iter().filter(|record| record.kind == RecordKind::Artefact) {
        if let Ok(file) = serde_json::from_str::<Artefact>(&record.payload) {
            put_file(&step, (id, cell_id), folder, &file).await?;
        }
    }
    let mark = "UPDATE run SET archived_at = NULL, archive = NULL, numbering = NULL WHERE id = $1";
    step.execute(mark, &[&id]).await.map_err(refused("the mark of a run"))?;
    step.commit().await.map_err(refused("a run from the archive"))?;
    Ok(format!("{name} of {cell}"))
}

async fn put_records(step: &Transaction<'_>, run: i32, records: &[Record]) -> Result<(), PlantError> {
    let seqs: Vec<i32> = records.iter().map(|record| i32::try_from(record.seq).unwrap_or(i32::MAX)).collect();
    let hashes: Vec<Vec<u8>> =
        records.iter().map(|record| HEXLOWER.decode(record.hash.as_bytes()).unwrap_or_default()).collect();
    let texts: Vec<String> = records.iter().map(Record::text).collect();
    let put = "INSERT INTO record (run, seq, hash, text) SELECT $1, seq, hash, text
        FROM unnest($2::int[], $3::bytea[], $4::text[]) AS u (seq, hash, text) ON CONFLICT DO NOTHING";
    let values: [&(dyn ToSql + Sync); 4] = [&run, &seqs, &hashes, &texts];
    step.execute(put, &values).await.map(drop).map_err(refused("records from the archive"))
}

/// Puts the entry of a file of a run back, and its content where the database has none. The run folder is proven.
async fn put_file(
    step: &Transaction<'_>,
    (run, cell): (i32, i32),
    folder: &Path,
    file: &Artefact,
) -> Result<(), PlantError> {
    let path: PathBuf = folder.join(&file.name);
    let failed = refused("a file from the archive");
    let content = fs::read(&path).map_err(|source| PlantError::Folder { path, source })?;
    let (sha256, bytes) = (HEXLOWER.decode(file.sha256.as_bytes()).unwrap_or_default(), file.bytes as i64);
    let values: [&(dyn ToSql + Sync); 4] = [&run, &file.name, &sha256, &bytes];
    let put = "INSERT INTO run_artefact (run, name, sha256, bytes) VALUES ($1, $2, $3, $4) ON CONFLICT DO NOTHING";
    step.execute(put, &values).await.map_err(&failed)?;
    let put = "INSERT INTO artefact (sha256, bytes, content) VALUES ($1, $2, $3) ON CONFLICT DO NOTHING";
    step.execute(put, &[&sha256, &bytes, &content]).await.map_err(&failed)?;
    let put = "INSERT INTO artefact_of (cell, sha256) VALUES ($1, $2) ON CONFLICT DO NOTHING";
    step.execute(put, &[&cell, &sha256]).await.map(drop).map_err(&failed)
}
