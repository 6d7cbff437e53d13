//! Fills a database with simulated runs, to try the page of a plant with the data of years.
//!
//! Everything is marked SIMULATION: the names of cells and runs, and the column `simulation` of each run. The figures
//! are drawn by the database from the seed. Runs with whole records repeat those of one finished simulated run, under
//! another name, part and day, in a chain of their own.

use std::fs;
use std::path::Path;
use std::time::SystemTime;

use data_encoding::HEXLOWER;
use jiff::{SignedDuration, Timestamp};
use regrind_journal::{Begin, Reader, Record, RecordKind, canonical_json, sha256_hex, utc, verify};
use serde_json::{Value, json};

use super::error::{PlantError, refused};
use super::link::DatabaseLink;
use super::replication::run_overview;

/// Number of runs that one statement makes, and of runs whose records one statement stores.
const RUNS: i64 = 10_000;
const WHOLE_RUNS: usize = 20;
/// Days of a year, on average, and seconds of a day.
const YEAR_DAYS: f64 = 365.25;
const DAY_S: f64 = 86_400.0;
/// Function of the session that draws a number from 0 to 1: the draw number `k` of the object `n`.
const DRAW: &str = "CREATE OR REPLACE FUNCTION pg_temp.draw(n bigint, k integer, seed bigint) RETURNS double precision LANGUAGE sql IMMUTABLE AS $$
        SELECT (pg_catalog.hashint8extended(n * 64 + k, seed) & 9007199254740991)::double precision / 9007199254740992.0 $$;
    SET statement_timeout = 0; SET jit = off";
/// Recipe of the parts that are given up. Nobody has signed it, so no cell takes a part of it.
const RECIPE: &str = "INSERT INTO recipe (sha256, name, version, text)
    VALUES (recipe_sha256('SIMULATION', 1, 'SIMULATION', '{}'), 'SIMULATION', 1, 'SIMULATION') ON CONFLICT DO NOTHING";
/// First object of the database that is not of such a filling, in words.
const FOREIGN: &str = "SELECT 'the cell ' || name FROM cell WHERE name NOT LIKE 'SIMULATION-%'
    UNION ALL (SELECT 'the run ' || name FROM run WHERE NOT simulation OR simulation IS NULL LIMIT 1) LIMIT 1";

/// Content of a database for trials.
#[derive(Clone, Copy, Debug)]
pub struct Filling {
    /// Number of cells that make the runs.
    pub cells: u32,
    /// Number of runs.
    pub runs: u32,
    /// Years before now over which the runs are spread.
    pub years: f64,
    /// Number of the runs that get whole records, spread over all of them.
    pub whole_runs: u32,
    /// Seed of the figures. The same seed gives the same figures.
    pub seed: u32,
}

/// Finished simulated run, the pattern for runs with whole records.
pub struct RunPattern {
    records: Vec<Record>,
    began: Timestamp,
    /// Files on record: name, SHA-256 and content.
    files: Vec<(String, Vec<u8>, Vec<u8>)>,
    overview: Value,
}

/// Size of a table: rows, bytes of its data, and bytes of its indexes.
#[derive(Clone, Debug)]
pub struct TableSize {
    /// Name of the table.
    pub table: String,
    /// Number of rows, as the statistics of the database have it.
    pub rows: i64,
    /// Bytes of the rows, including values that are stored elsewhere because of their length.
    pub data_bytes: i64,
    /// Bytes of the indexes.
    pub index_bytes: i64,
}

impl RunPattern {
    /// Reads the run in `folder` with its files, and verifies it.
    ///
    /// # Errors
    /// The record of the run is not valid, the run has not ended, or a machine of it was not simulated.
    pub fn read(folder: &Path) -> Result<Self, PlantError> {
        let unfit = |what: &str| PlantError::Fill {
            what: format!("{}: {what}", folder.display()),
            remedy: "name a finished run of simulated machines",
        };
        let verified = verify(folder)?;
        let records = Reader::open(folder)?.records(1).collect::<Result<Vec<_>, _>>()?;
        let begin = records.first().and_then(Begin::<Value>::read);
        if begin.and_then(|begin| begin.simulation) != Some(true) {
            return Err(unfit("its machines are not simulated"));
        }
        if !verified.closed {
            return Err(unfit("it has not ended"));
        }
        let began = records[0].utc.parse().map_err(|_| unfit("the time of its first record cannot be read"))?;
        let mut files = Vec::new();
        for record in records.iter().filter(|record| record.kind == RecordKind::Artefact) {
            let value = record.value();
            let [name, sha256] = ["name", "sha256"].map(|key| value[key].as_str().unwrap_or_default().to_owned());
            let content = fs::read(folder.join(&name))
                .map_err(|source| PlantError::Folder { path: folder.join(&name), source })?;
            // A file that was written twice is on record twice; only the newest content is there.
            if sha256_hex(&content) == sha256 {
                files.push((name, bytes_of(&sha256), content));
            }
        }
        Ok(Self { records, began, files, overview: run_overview(folder)? })
    }

    /// Returns the records of the run `name` of the part `part` that began at `began`: those of the pattern in a chain
    /// of their own, without signatures.
    fn repeated(&self, name: &str, part: &str, began: Timestamp) -> Vec<Record> {
        let mut head = "0".repeat(64);
        let later = began.duration_since(self.began);
        let unsigned = self.records.iter().filter(|record| record.kind != RecordKind::Seal);
        let repeated = unsigned.enumerate().map(|(k, of)| {
            let mut record = Record {
                seq: k as u64 + 1,
                part: part.to_owned(),
                utc: shifted(&of.utc, later),
                prev_hash: head.clone(),
                ..of.clone()
            };
            let mut content = of.value();
            match of.kind {
                RecordKind::Begin => (content["run"], content["key"]) = (name.into(), Value::Null),
                RecordKind::Reopen => content["key"] = Value::Null,
                RecordKind::End => {
                    (content["records_before"], content["head_before"]) = (json!(k), head.as_str().into())
                }
                _ => {}
            }
            record.payload = canonical_json(&content);
            record.hash = sha256_hex(format!("regrind journal record 1\n{head}\n{}", record.text()).as_bytes());
            head.clone_from(&record.hash);
            record
        });
        repeated.collect()
    }
}

/// Returns the time `utc` moved by `by`, or the same text if it is no time.
fn shifted(utc_text: &str, by: SignedDuration) -> String {
    let moved = utc_text.parse::<Timestamp>().ok().and_then(|at| at.checked_add(by).ok());
    moved.map_or_else(|| utc_text.to_owned(), |at| utc(SystemTime::from(at)))
}

fn bytes_of(digits: &str) -> Vec<u8> {
    HEXLOWER.decode(digits.as_bytes()).unwrap_or_default()
}

impl Filling {
    /// Makes the cells and the runs in the database, as its owner. `pattern` is the run that the runs with whole records
    /// repeat. `progress` gets the number of runs that are made so far.
    ///
    /// # Errors
    /// The database has a cell or a run that such a filling did not make, or it has runs of this seed. Whole runs are
    /// asked for without a pattern. The role is not the owner, or the database cannot be reached.
    pub async fn make(
        &self,
        link: &DatabaseLink,
        pattern: Option<&RunPattern>,
        mut progress: impl FnMut(u32),
    ) -> Result<(), PlantError> {
        self.check(link).await?;
        let failed = refused("the simulated runs");
        link.client().batch_execute(DRAW).await.map_err(&failed)?;
        link.client().batch_execute(RECIPE).await.map_err(&failed)?;
        let (cells, seed, runs) = (self.cells as i32, i64::from(self.seed), i64::from(self.runs));
        link.query(include_str!("fill/cells.sql"), &[&cells, &seed]).await?;
        let (until, span_s) = (Timestamp::now().to_string(), self.years * YEAR_DAYS * DAY_S);
        for from in (1..=runs).step_by(RUNS as usize) {
            let to = (from + RUNS - 1).min(runs);
            link.query(include_str!("fill/runs.sql"), &[&from, &to, &runs, &cells, &span_s, &until, &seed]).await?;
            progress(to as u32);
        }
        link.query(include_str!("fill/given_up.sql"), &[&self.prefix()]).await?;
        if let Some(pattern) = pattern {
            self.make_whole(link, pattern).await?;
        }
        link.client().batch_execute("VACUUM (ANALYZE) cell, cell_state, run, cycle, record, run_artefact, artefact, artefact_of, work, work_step, parts_of_day")
            .await
            .map_err(failed)
    }

    /// Checks that the database has nothing but runs of such fillings, and none with this seed.
    async fn check(&self, link: &DatabaseLink) -> Result<(), PlantError> {
        if let Some(row) = link.query(FOREIGN, &[]).await?.first() {
            let what = format!("the database has {}, which no filling made", row.get::<_, &str>(0));
            return Err(PlantError::Fill { what, remedy: "make another database for trials" });
        }
        let text = "SELECT EXISTS (SELECT FROM run r JOIN cell c ON c.id = r.cell WHERE starts_with(r.name, $1))";
        if link.query(text, &[&self.prefix()]).await?[0].get(0) {
            let what = format!("the database has runs of the seed {}", self.seed);
            return Err(PlantError::Fill { what, remedy: "name another seed" });
        }
        Ok(())
    }

    /// Returns the beginning of the names of all runs of this filling.
    fn prefix(&self) -> String {
        format!("SIMULATION-{}-", self.seed)
    }

    /// Gives `whole_runs` of the runs of this filling the records and the files of the pattern.
    async fn make_whole(&self, link: &DatabaseLink, pattern: &RunPattern) -> Result<(), PlantError> {
        for (_, sha256, content) in &pattern.files {
            let text = "INSERT INTO artefact (sha256, bytes, content) VALUES ($1, $2, $3) ON CONFLICT DO NOTHING";
            link.query(text, &[sha256, &(content.len() as i64), content]).await?;
        }
        let hashes: Vec<&[u8]> = pattern.files.iter().map(|(_, sha256, _)| sha256.as_slice()).collect();
        let text = "INSERT INTO artefact_of (cell, sha256) SELECT c.id, f.sha256 FROM cell c CROSS JOIN unnest($1::bytea[]) AS f (sha256) ON CONFLICT DO NOTHING";
        link.query(text, &[&hashes]).await?;
        // Spread over all runs that ended.
        let text = "SELECT id, name, part, to_char(began AT TIME ZONE 'UTC', 'YYYY-MM-DD\"T\"HH24:MI:SS.US\"Z\"') FROM (
                SELECT *, row_number() OVER (ORDER BY name) AS n, count(*) OVER () AS ended_runs FROM run WHERE starts_with(name, $1) AND ended IS NOT NULL) r
            WHERE n % greatest(ended_runs / greatest($2::bigint, 1), 1) = 0 ORDER BY n LIMIT $2";
        let chosen = link.query(text, &[&self.prefix(), &i64::from(self.whole_runs)]).await?;
        for some in chosen.chunks(WHOLE_RUNS) {
            WholeRuns::new(pattern, some).store(link, pattern).await?;
        }
        Ok(())
    }
}

/// Runs whose records are stored by one statement, as its columns.
#[derive(Default)]
struct WholeRuns {
    ids: Vec<i32>,
    firsts: Vec<String>,
    ended: Vec<String>,
    counts: Vec<i32>,
    heads: Vec<Vec<u8>>,
    record_runs: Vec<i32>,
    record_numbers: Vec<i32>,
    hashes: Vec<Vec<u8>>,
    texts: Vec<String>,
}

impl WholeRuns {
    fn new(pattern: &RunPattern, rows: &[super::Row]) -> Self {
        let mut whole = Self::default();
        for row in rows {
            let began = row.get::<_, &str>(3).parse().unwrap_or(pattern.began);
            let records = pattern.repeated(row.get(1), row.get(2), began);
            let Some(last) = records.last() else { continue };
            let id = row.get(0);
            whole.ids.push(id);
            whole.ended.push(records.iter().rfind(|record| record.kind == RecordKind::End).unwrap_or(last).utc.clone());
            whole.counts.push(records.len() as i32);
            whole.heads.push(bytes_of(&last.hash));
            whole.firsts.push(records[0].text());
            for record in &records {
                whole.record_runs.push(id);
                whole.record_numbers.push(record.seq as i32);
                whole.hashes.push(bytes_of(&record.hash));
                whole.texts.push(record.text());
            }
        }
        whole
    }

    async fn store(&self, link: &DatabaseLink, pattern: &RunPattern) -> Result<(), PlantError> {
        let text = "INSERT INTO record (run, seq, hash, text) SELECT * FROM unnest($1::integer[], $2::integer[], $3::bytea[], $4::text[])";
        link.query(text, &[&self.record_runs, &self.record_numbers, &self.hashes, &self.texts]).await?;
        let names: Vec<&str> = pattern.files.iter().map(|(name, ..)| name.as_str()).collect();
        let hashes: Vec<&[u8]> = pattern.files.iter().map(|(_, sha256, _)| sha256.as_slice()).collect();
        let bytes: Vec<i64> = pattern.files.iter().map(|(.., content)| content.len() as i64).collect();
        let text = "INSERT INTO run_artefact (run, name, sha256, bytes)
            SELECT r.id, f.* FROM unnest($1::integer[]) AS r (id) CROSS JOIN unnest($2::text[], $3::bytea[], $4::bigint[]) AS f ON CONFLICT DO NOTHING";
        link.query(text, &[&self.ids, &names, &hashes, &bytes]).await?;
        let told = pattern.overview.to_string();
        let text = include_str!("fill/whole_runs.sql");
        link.query(text, &[&self.ids, &self.firsts, &self.ended, &self.counts, &self.heads, &told]).await?;
        Ok(())
    }
}

/// Returns the sizes of all tables of the plant that have rows, the largest first. The partitions of a table are counted
/// with it.
///
/// # Errors
/// The role may not read them, or the database cannot be reached.
pub async fn table_sizes(link: &DatabaseLink) -> Result<Vec<TableSize>, PlantError> {
    let text = "SELECT top.relname::text, sum(greatest(leaf.reltuples, 0))::bigint, sum(pg_table_size(leaf.oid))::bigint, sum(pg_indexes_size(leaf.oid))::bigint
        FROM pg_class leaf JOIN pg_class top ON top.oid = coalesce(pg_partition_root(leaf.oid), leaf.oid)
        WHERE leaf.relkind = 'r' AND top.relnamespace = 'regrind'::regnamespace
        GROUP BY 1 HAVING sum(greatest(leaf.reltuples, 0)) > 0 ORDER BY sum(pg_total_relation_size(leaf.oid)) DESC";
    let rows = link.query(text, &[]).await?;
    let size = |row: &super::Row| TableSize {
        table: row.get(0),
        rows: row.get(1),
        data_bytes: row.get(2),
        index_bytes: row.get(3),
    };
    Ok(rows.iter().map(size).collect())
}
