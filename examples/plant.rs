//! Load test of a plant of many cells: speed of replicating records, size of the data of a thousand cells, and duration
//! of the page's queries.
//!
//! ```text
//! cargo run --release --features plant --example plant -- ship OWNER.toml RUN [CELLS [RUNS]]
//! cargo run --release --features plant --example plant -- fill OWNER.toml RUN [CELLS [RUNS [WITH_RECORDS [REPEATED]]]]
//! ```
//! OWNER.toml is the plant file of the owner of a database that `regrind plant init` has laid out. Use a database for
//! this test only: the data remain in it. RUN is the folder of a finished run. Every run here repeats its records, in a
//! new hash chain, under another name, for another part and day. `ship` writes RUNS runs (20) into the folders of CELLS
//! cells (8), and ships all of them at once by the roles of these cells. `fill` writes RUNS runs (518,000: 10^8 records
//! of the shipped free-form mirror) of CELLS cells (1,000) into the tables of runs and cycles, and the records of the
//! first WITH_RECORDS (50,000) of them into the table of records. The server copies the records of the first run into
//! the REPEATED (0) runs that follow, with other hashes: the same number of bytes in a tenth of the time, but no valid
//! chain.

use std::path::{Path, PathBuf};
use std::time::Instant;

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use regrind::config::PlantConfig;
use regrind::journal::{Reader, Record, RecordKind, restore, restore_file, sha256_hex};
use regrind_plant::{DatabaseLink, DatabaseSettings, NewMember, Replicator, enrol_cell};

const PASSWORD: &str = "for-measuring";

#[tokio::main]
async fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |k: usize, otherwise: usize| arguments.get(k).map_or(otherwise, |n| n.parse().expect("a number"));
    let [what, owner, run] = [0, 1, 2].map(|k| arguments.get(k).expect("what to do, plant file, and run").as_str());
    let plant = PlantConfig::read(Path::new(owner)).unwrap_or_else(|problems| panic!("{owner}: {problems:?}"));
    let database = plant.database.expect("[database]");
    let like = Like::read(Path::new(run));
    match what {
        "ship" => ship(&database, &like, number(3, 8), number(4, 20)).await,
        "fill" => fill(&database, &like, number(3, 1000), number(4, 518_000), [number(5, 50_000), number(6, 0)]).await,
        _ => panic!("ship or fill, not {what}"),
    }
}

/// Finished run, the pattern for the other runs.
struct Like {
    folder: PathBuf,
    records: Vec<Record>,
}

impl Like {
    fn read(folder: &Path) -> Self {
        let reader = Reader::open(folder).expect("a run");
        Self { folder: folder.to_owned(), records: reader.records(1).map(Result::unwrap).collect() }
    }

    /// Returns the same records for a run with another name, part and day, in their own chain and without signatures.
    fn again(&self, name: &str, part: &str, days: usize) -> Vec<Record> {
        let mut head = "0".repeat(64);
        let day = |utc: &str| {
            let at: jiff::Timestamp = utc.parse().unwrap();
            (at - jiff::SignedDuration::from_hours(24 * days as i64)).to_string()
        };
        let unsigned = self.records.iter().filter(|record| record.kind != RecordKind::Seal);
        let again = unsigned.enumerate().map(|(k, of)| {
            let mut record = Record { seq: k as u64 + 1, part: part.into(), utc: day(&of.utc), ..of.clone() };
            if of.kind == RecordKind::Begin {
                let mut content = of.value();
                content["run"] = name.into();
                content["key"] = serde_json::Value::Null;
                record.payload = regrind::journal::canonical_json(&content);
            }
            if of.kind == RecordKind::End {
                let mut content = of.value();
                content["records_before"] = (k as u64).into();
                record.payload = regrind::journal::canonical_json(&content);
            }
            record.prev_hash = head.clone();
            record.hash = sha256_hex(format!("regrind journal record 1\n{head}\n{}", record.text()).as_bytes());
            head = record.hash.clone();
            record
        });
        again.collect()
    }

    /// Writes a run with this name into a folder of runs, with its files.
    fn lay(&self, runs: &Path, name: &str, part: &str) -> usize {
        let records = self.again(name, part, 0);
        let folder = runs.join(name);
        let (count, files) = (records.len(), records.iter().filter(|record| record.kind == RecordKind::Artefact));
        let files: Vec<String> = files.map(|record| record.value()["name"].as_str().unwrap().to_owned()).collect();
        restore(&folder, records, None).unwrap();
        for name in files {
            restore_file(&folder, &name, &std::fs::read(self.folder.join(&name)).unwrap()).unwrap();
        }
        count
    }
}

async fn ship(database: &DatabaseSettings, like: &Like, cells: usize, runs: usize) {
    let home = tempfile::tempdir().unwrap();
    let mut records = 0;
    let stamp = jiff::Timestamp::now().as_second();
    let mut owner = DatabaseLink::open(database).await.unwrap();
    let mut shippers = Vec::new();
    for cell in 1..=cells {
        let (name, folder) = (format!("measured-{cell}"), home.path().join(cell.to_string()));
        let role = format!("measured_{cell}");
        let member = NewMember { name: &name, role: &role, password: PASSWORD, is_again: false };
        // A run before this one has left the cell there.
        if enrol_cell(&mut owner, member, &[]).await.is_err() {
            enrol_cell(&mut owner, NewMember { is_again: true, ..member }, &[]).await.unwrap();
        }
        for run in 1..=runs {
            records += like.lay(&folder, &format!("run-{stamp}-{run}"), &format!("SN-{cell}-{run}"));
        }
        let password = home.path().join(format!("{cell}.password"));
        regrind::formats::write_private(&password, PASSWORD.as_bytes()).unwrap();
        let settings = DatabaseSettings { user: role, password_file: Some(password), ..database.clone() };
        shippers.push((Replicator::new(folder, None), settings));
    }
    println!("{cells} cells, {runs} runs each, {records} records, and {} files of each run", files_of(like));
    let began = Instant::now();
    let shipping = shippers.into_iter().map(|(mut shipper, settings)| {
        tokio::spawn(async move {
            let link = DatabaseLink::open(&settings).await.unwrap();
            shipper.round(&link).await.unwrap()
        })
    });
    let mut shipped = 0;
    for one in shipping.collect::<Vec<_>>() {
        shipped += one.await.unwrap().records;
    }
    let seconds = began.elapsed().as_secs_f64();
    println!("{shipped} records in {seconds:.2} s: {:.0} a second", shipped as f64 / seconds);
    assert_eq!(shipped as usize, records);
}

fn files_of(like: &Like) -> usize {
    like.records.iter().filter(|record| record.kind == RecordKind::Artefact).count()
}

async fn fill(
    database: &DatabaseSettings,
    like: &Like,
    cells: usize,
    runs: usize,
    [with_records, repeated]: [usize; 2],
) {
    let link = DatabaseLink::open(database).await.unwrap();
    let began = Instant::now();
    let text = "INSERT INTO cell (name, role) SELECT 'cell-' || n, 'cell_' || n FROM generate_series(1, $1) n ON CONFLICT DO NOTHING";
    link.query(text, &[&(cells as i32)]).await.unwrap();
    let first = link.query("SELECT coalesce(max(id), 0) FROM run", &[]).await.unwrap()[0].get::<_, i32>(0);
    // About 500 parts of a thousand cells in an hour. A fifth of the recipes is made much more often than the others.
    let text = "WITH made AS (
            INSERT INTO run (cell, name, part, part_name, recipe, recipe_sha256, operator, simulation, began, ended, result, verdict, pv_limit_um,
                rms_limit_um, grinder, cmm, wheel, probe, alarms, cycles, pv_um, pv_u_um, rms_um, rms_u_um, records)
            SELECT c.id, 'run-' || n, 'SN-' || n, 'mirror', 'recipe-' || floor(40 * random() ^ 2), '00', 'operator-' || n % 70, false, t,
                t + interval '20 minutes', CASE WHEN random() < 0.93 THEN 'accepted' ELSE 'not accepted' END, 'in tolerance', 0.5, 0.1,
                'grinder-' || c.id % 9, 'cmm-' || c.id % 5, 'R ' || 18 + c.id % 4 || '.000 mm', 'R 1.500 mm', (random() < 0.05)::int, k,
                0.3 + 0.1 * random(), 0.05, 0.06, 0.01, 0
            FROM generate_series($1::int, $2::int) n
                CROSS JOIN LATERAL (SELECT id FROM cell WHERE name = 'cell-' || 1 + n % $3::int) c
                CROSS JOIN LATERAL (SELECT now() - make_interval(secs => 7.2 * (($4::int - n)::float8)) AS t, 1 + floor(3 * random())::int AS k) x
            RETURNING id, cycles, pv_um)
        INSERT INTO cycle (run, cycle, verdict, reason, pv_um, pv_u_um, rms_um, rms_u_um)
            SELECT id, k, CASE WHEN k = cycles THEN 'accept' ELSE 'grind again' END, '', pv_um * (1 + cycles - k), 0.05, 0.06, 0.01
            FROM made CROSS JOIN LATERAL generate_series(1, cycles) k";
    for from in (1..=runs).step_by(10_000) {
        let [from, to] = [from, (from + 9_999).min(runs)].map(|n| first + n as i32);
        link.query(text, &[&from, &to, &(cells as i32), &(first + runs as i32)]).await.unwrap();
    }
    let made = link.query("SELECT id, name FROM run WHERE id > $1 ORDER BY id", &[&first]).await.unwrap();
    let ids: Vec<i32> = made.iter().map(|row| row.get(0)).collect();
    let mut random = StdRng::seed_from_u64(1);
    let mut records = 0;
    let (chained, others) = made.split_at(with_records.min(runs));
    for row in chained {
        let name: String = row.get(1);
        let again = like.again(&name, &name.replace("run", "SN"), random.random_range(0..40));
        let hashes: Vec<Vec<u8>> = again.iter().map(|record| bytes_of(&record.hash)).collect();
        let texts: Vec<String> = again.iter().map(Record::text).collect();
        let text = "INSERT INTO record (run, seq, hash, text)
            SELECT $1, n, hash, text FROM unnest($2::bytea[], $3::text[]) WITH ORDINALITY AS u (hash, text, n)";
        link.query(text, &[&row.get::<_, i32>(0), &hashes, &texts]).await.unwrap();
        records += again.len();
    }
    let each = records / chained.len().max(1);
    let text = "INSERT INTO record (run, seq, hash, text)
        SELECT id, seq, sha256(hash || int4send(id)), text FROM unnest($1::int[]) id CROSS JOIN record WHERE run = $2";
    let others = &ids[chained.len()..][..repeated.min(others.len())];
    for some in others.chunks(100) {
        link.query(text, &[&some, &ids[0]]).await.unwrap();
        records += each * some.len();
    }
    let with_all = chained.len() + others.len();
    link.query("ANALYZE", &[]).await.unwrap();
    let bytes = |table: &str| {
        let text = format!("SELECT pg_total_relation_size('{table}'), pg_relation_size('{table}')");
        let link = &link;
        async move {
            let row = &link.query(&text, &[]).await.unwrap()[0];
            [row.get::<_, i64>(0), row.get(1)].map(|bytes| bytes as f64)
        }
    };
    println!(
        "{runs} runs of {cells} cells, {records} records of {with_all}, in {:.0} s",
        began.elapsed().as_secs_f64()
    );
    for (table, rows) in [("record", records), ("run", runs), ("cycle", 2 * runs)] {
        let [total, heap] = bytes(table).await;
        let rows = rows.max(1) as f64;
        println!(
            "{table:<8} {:>9.1} MB, {:.0} bytes a row, of which {:.0} are indexes",
            total / 1e6,
            total / rows,
            (total - heap) / rows
        );
    }
}

fn bytes_of(digits: &str) -> Vec<u8> {
    data_encoding::HEXLOWER.decode(digits.as_bytes()).unwrap()
}
