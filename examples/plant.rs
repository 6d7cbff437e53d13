//! Load test of a plant of many cells: speed of replicating records, and duration of the pages.
//!
//! ```text
//! cargo run --release --features plant --example plant -- ship OWNER.toml RUN [CELLS [RUNS]]
//! cargo run --release --features plant --example plant -- pages URL [TIMES [PATH...]]
//! ```
//! OWNER.toml is the plant file of the owner of a database that `regrind plant init` has laid out. Use a database for
//! this test only: the data remain in it. RUN is the folder of a finished run. Every run here repeats its records, in a
//! new hash chain, under another name, for another part. `ship` writes RUNS runs (20) into the folders of CELLS
//! cells (8), and ships all of them at once by the roles of these cells. `pages` requests every page of a plant that
//! `regrind plant fill` has filled, TIMES times (20), and prints the median. URL is the address that `regrind plant
//! serve` prints.

use std::path::{Path, PathBuf};
use std::time::Instant;

use regrind::config::PlantConfig;
use regrind::journal::{Reader, Record, RecordKind, restore, restore_file, sha256_hex};
use regrind_plant::{DatabaseLink, DatabaseSettings, NewMember, Replicator, enrol_cell};
use regrind_testcell::http::{Visitor, raw};

const PASSWORD: &str = "for-measuring";

#[tokio::main]
async fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |k: usize, otherwise: usize| arguments.get(k).map_or(otherwise, |n| n.parse().expect("a number"));
    let argument = |k: usize, what: &str| arguments.get(k).expect(what).as_str();
    match argument(0, "ship or pages") {
        "ship" => {
            let owner = argument(1, "the plant file of the owner");
            let plant = PlantConfig::read(Path::new(owner)).unwrap_or_else(|problems| panic!("{owner}: {problems:?}"));
            let like = Like::read(Path::new(argument(2, "the folder of a run")));
            ship(&plant.database.expect("[database]"), &like, number(3, 8), number(4, 20)).await;
        }
        "pages" => pages(argument(1, "the address of the page"), number(2, 20), arguments.get(3..).unwrap_or_default()),
        what => panic!("ship or pages, not {what}"),
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

    /// Returns the same records for a run with another name and part, in their own chain and without signatures.
    fn again(&self, name: &str, part: &str) -> Vec<Record> {
        let mut head = "0".repeat(64);
        let unsigned = self.records.iter().filter(|record| record.kind != RecordKind::Seal);
        let again = unsigned.enumerate().map(|(k, of)| {
            let mut record = Record { seq: k as u64 + 1, part: part.into(), ..of.clone() };
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
        let records = self.again(name, part);
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

/// Times the pages of a plant: each is requested once, then `times` times. `more` are further paths, such as that of a
/// run with whole records.
fn pages(url: &str, times: usize, more: &[String]) {
    let visitor = Visitor::with_key(url);
    let get = |path: &str| {
        let (host, cookies) = (visitor.host(), &visitor.cookies);
        let request =
            format!("GET {path} HTTP/1.0\r\nHost: {host}\r\nCookie: {cookies}\r\nAccept-Encoding: gzip\r\n\r\n");
        raw(&visitor.place, request.as_bytes())
    };
    let parts = visitor.get("/parts").text();
    let runs: Vec<&str> =
        parts.split("href=\"/runs/").skip(1).filter_map(|rest| rest.split('"').next()).take(4).collect();
    let maps = runs.iter().map(|run| format!("run={run}")).collect::<Vec<_>>().join("&");
    let trend = visitor.get("/trend").text();
    let chosen = |kind: &str| {
        let options =
            trend.split(&format!("<select name=\"{kind}\"")).nth(1).and_then(|rest| rest.split("</select>").next());
        let values = options.unwrap_or_default().split("option value=\"").filter_map(|rest| rest.split('"').next());
        values
            .filter(|value| !value.trim().is_empty() && !value.starts_with('>'))
            .last()
            .unwrap_or_default()
            .replace(' ', "%20")
    };
    let mut paths: Vec<String> = [
        "/",
        "/parts",
        "/parts?serial=SIMULATION-0000",
        "/trend",
        "/trend?recipe=",
        "/trend?at=first",
        "/cells",
        "/cells?recipe=",
        "/export.csv",
        "/export.csv?recipe=",
        "/trend.dfq",
        "/trend.dfq?recipe=",
    ]
    .map(str::to_owned)
    .into();
    for kind in ["cell", "grinder", "cmm", "wheel", "probe"] {
        paths.push(format!("/trend?recipe=&{kind}={}", chosen(kind)));
        paths.push(format!("/trend?{kind}={}&since=2000-01-01", chosen(kind)));
    }
    paths.extend([format!("/runs/{}", runs[0]), format!("/maps?{maps}")]);
    paths.extend_from_slice(more);
    println!("{:<60} {:>10} {:>10} {:>10} {:>10}", "page", "first, ms", "median", "slowest", "kB");
    for path in &paths {
        let timed = || {
            let began = Instant::now();
            let answer = get(path);
            assert_eq!(answer.status, 200, "{path}: {}", answer.text());
            (1e3 * began.elapsed().as_secs_f64(), answer.body.len())
        };
        let (first, bytes) = timed();
        let mut again: Vec<f64> = (0..times).map(|_| timed().0).collect();
        again.sort_by(f64::total_cmp);
        println!(
            "{path:<60} {first:>10.1} {:>10.1} {:>10.1} {:>10.1}",
            again[times / 2],
            again[times - 1],
            bytes as f64 / 1e3
        );
    }
}
