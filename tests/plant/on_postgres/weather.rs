//! Cells that make parts of one queue and publish live values to a broker, while the network is cut and database,
//! broker and cells are killed. Every record reaches the plant once, no part begins twice, and every cell is published
//! again.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use regrind::journal::{Reader, RecordKind, verify};
use regrind_testcell::outlived::{began_once, follow, on_serial_lines};

use super::work::approves;
use crate::Plant;
use crate::broker::Broker;
use crate::network::Network;
use crate::program::{PATIENCE, Running, changed, regrind};

/// Maximum number of kills of a cell's program for each part that it makes.
const KILLS_A_PART: usize = 2;

/// Returns the recipe of the parts: two or three seconds each, without confirmation by a person.
fn recipe() -> String {
    let changes = [
        ("columns = 60", "columns = 12"),
        ("rows = 30", "rows = 8"),
        ("accuracy_nm = 0.5", "spacing_mm = 1.0"),
        ("cutoff_mm = 5.0", "cutoff_mm = 20.0"),
        ("[simulation]\nseed = 1", "[simulation]\nseed = 1\nspeed = 2000.0"),
        ("\n[cycle]\n", "\n[cycle]\nconfirm_work = false\n"),
    ];
    changed("recipes/freeform-mirror.toml", &changes)
}

/// Cell and its folder.
struct Cell {
    name: String,
    home: PathBuf,
}

/// Returns a cell whose plant file points to the network, and its machines, which outlive its programs.
fn cell(plant: &Plant, number: usize, approvers: &str, broker: &Broker) -> (Cell, Running) {
    let name = format!("cell-{number}");
    let home = plant.path(&name);
    fs::create_dir(&home).unwrap();
    let machines = on_serial_lines(regrind, &home, recipe());
    let mut key = regrind(&["audit", "key"], &home);
    let made = key.env("REGRIND_KEY", home.join("audit.key")).output().unwrap();
    assert!(made.status.success());
    let public = home.join("public");
    fs::write(&public, &made.stdout).unwrap();
    plant.cell(&name, &["--key", public.to_str().unwrap()]);
    let file = fs::read_to_string(plant.path(&format!("{name}.toml"))).unwrap();
    let [direct, through] = [plant.postgres.socket(), plant.path("net")].map(|path| path.display().to_string());
    assert!(file.contains(&direct));
    let told = format!("\n[sparkplug]\nbroker = \"127.0.0.1\"\nport = {}\ngroup = \"plant\"\n", broker.port());
    fs::write(plant.path(&format!("{name}-through.toml")), file.replace(&direct, &through) + approvers + &told)
        .unwrap();
    (Cell { name, home }, machines)
}

impl Cell {
    fn runs(&self) -> PathBuf {
        self.home.join("runs")
    }

    fn does(&self, arguments: &[&str]) -> Running {
        let plant = format!("../{}-through.toml", self.name);
        let mut command = regrind(&[arguments, &["--plant", &plant]].concat(), &self.home);
        command.env("REGRIND_KEY", self.home.join("audit.key"));
        Running::new(command)
    }

    /// Returns the unfinished run, except those that were abandoned.
    fn open_run(&self, left: &BTreeSet<PathBuf>) -> Option<PathBuf> {
        let runs = fs::read_dir(self.runs()).ok()?.filter_map(|entry| Some(entry.ok()?.path()));
        let mut open = runs.filter(|run| {
            let hidden = run.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'));
            !hidden && !left.contains(run) && !is_over(run)
        });
        open.next()
    }

    /// Makes parts until none remains, whatever happens to its programs.
    fn works(&self, seed: u64, parts: &AtomicUsize) {
        let mut chance = StdRng::seed_from_u64(seed);
        let (mut kills, mut left) = (0, BTreeSet::new());
        let began = Instant::now();
        let make = ["work", "--cell", "cell.toml", "--json"];
        let mut running = self.does(&make);
        while parts.load(Ordering::SeqCst) > 0 {
            assert!(began.elapsed() < 12 * PATIENCE, "seed {seed}, {}: it comes to no end", self.name);
            let lines = if kills < KILLS_A_PART * 20 { chance.random_range(1..120) } else { usize::MAX };
            let code = follow(&mut running, &|| self.open_run(&left), lines);
            kills += usize::from(code.is_none());
            let told = running.error_text.clone();
            running = match self.open_run(&left) {
                // The program was killed before any request to a machine.
                Some(run) if told.contains("begin a new run") => {
                    assert!(left.insert(run.clone()), "seed {seed}: {told}");
                    let serial = Reader::open(&run).unwrap().last().unwrap().unwrap().part;
                    self.does(&["work", "--give-back", &serial])
                }
                Some(run) if run.join("journal.sqlite").is_file() => {
                    let run = run.strip_prefix(&self.home).unwrap().display().to_string();
                    self.resumed(&run)
                }
                // The program was killed before its run had a record.
                Some(run) => {
                    fs::remove_dir_all(run).unwrap();
                    self.does(&make)
                }
                None if told.contains("--give-back") => {
                    let serial = told.split(" was begun in run").next().unwrap().rsplit(' ').next().unwrap();
                    self.does(&["work", "--give-back", serial])
                }
                None => {
                    let waits = code == Some(0) || code == Some(3) || code.is_none() || told.contains("is not over");
                    assert!(waits || told.contains("part "), "seed {seed}, {}: {code:?} {told}", self.name);
                    // Other cells can return the parts that they have leased.
                    std::thread::park_timeout(Duration::from_millis(200));
                    self.does(&make)
                }
            };
        }
        // A program that is still running makes no more parts.
        running.signal("KILL");
        running.end();
    }

    /// Resumes an interrupted run.
    fn resumed(&self, run: &str) -> Running {
        let mut command = regrind(&["resume", run, "--json"], &self.home);
        command.env("REGRIND_KEY", self.home.join("audit.key"));
        Running::new(command)
    }
}

/// Returns true if the end of a run is on record. A record that is closed stays so, and is verified only once: the cells
/// ask again and again for all of their runs.
fn is_over(run: &Path) -> bool {
    static OVER: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());
    if OVER.lock().unwrap().contains(run) {
        return true;
    }
    let is_over = run.join("journal.sqlite").is_file() && verify(run).is_ok_and(|verified| verified.closed);
    if is_over {
        OVER.lock().unwrap().insert(run.to_owned());
    }
    is_over
}

/// Runs this number of cells and parts under faults that are drawn from a seed.
fn weather(seed: u64, cells: usize, parts: usize) {
    println!("seed {seed}");
    let mut plant = Plant::new();
    fs::create_dir(plant.path("net")).unwrap();
    let socket = plant.postgres.socket_file();
    let network = Network::between(&plant.path("net").join(socket.file_name().unwrap()), socket.clone());
    plant.somebody("planner", "planner");
    fs::write(plant.path("small.toml"), recipe()).unwrap();
    plant.does(&["plant", "propose", "small.toml", "--plant", "planner.toml"]);
    let approvers = ["Ada", "Bob"].map(|person| approves(&plant, person, "small")).concat();
    let serials: Vec<String> = (1..=parts).map(|n| format!("SN-{n}")).collect();
    let serials: Vec<&str> = serials.iter().map(String::as_str).collect();
    plant.does(&[&["plant", "queue", "--recipe", "small", "--plant", "planner.toml"], &serials[..]].concat());
    let study = Study::begin(&plant, parts);
    let mut broker = Broker::start();
    let (cells, _machines): (Vec<Cell>, Vec<Running>) =
        (1..=cells).map(|number| cell(&plant, number, &approvers, &broker)).unzip();

    let left = AtomicUsize::new(parts);
    let events = std::thread::scope(|scope| {
        for (k, cell) in cells.iter().enumerate() {
            let left = &left;
            scope.spawn(move || cell.works(seed * 100 + k as u64, left));
        }
        let mut chance = StdRng::seed_from_u64(seed);
        let mut events = 0;
        let began = Instant::now();
        while left.load(Ordering::SeqCst) > 0 {
            assert!(began.elapsed() < 12 * PATIENCE, "seed {seed}: {} parts are left", left.load(Ordering::SeqCst));
            let a_while = Duration::from_millis(chance.random_range(50..1500));
            match chance.random_range(0..5) {
                0 => {
                    network.cut();
                    std::thread::park_timeout(a_while);
                    network.mend();
                }
                1 => {
                    plant.postgres.kill();
                    std::thread::park_timeout(a_while);
                    plant.postgres.go_on();
                }
                2 => {
                    broker.kill();
                    std::thread::park_timeout(a_while);
                    broker.go_on();
                }
                3 => archive(&plant),
                _ => {}
            }
            std::thread::park_timeout(2 * a_while);
            events += 1;
            // The lease of a killed cell expires a little faster here.
            plant.sql("UPDATE work SET leased_until = now() - interval '1 second' WHERE state = 'leased' AND leased_until < now() + interval '290 seconds'");
            left.store(open_parts(&plant, &cells, parts), Ordering::SeqCst);
        }
        events
    });
    network.mend();
    println!("seed {seed}: {events} events of the weather");
    study.finish(&plant, parts);
    let archived = unarchive(&plant);
    println!("seed {seed}: {archived} runs were archived meanwhile");
    is_once_and_whole(&plant, &cells, parts, seed);
    cells.iter().for_each(|cell| is_told(cell, &broker));
}

/// Study whose worker makes runs beside the cells, through the same network.
struct Study {
    worker: Running,
}

impl Study {
    fn begin(plant: &Plant, seeds: usize) -> Self {
        plant.somebody("farm-1", "worker");
        let file = fs::read_to_string(plant.path("farm-1.toml")).unwrap();
        let [direct, through] = [plant.postgres.socket(), plant.path("net")].map(|path| path.display().to_string());
        fs::write(plant.path("farm-1.toml"), file.replace(&direct, &through)).unwrap();
        let seeds = format!("1..{seeds}");
        plant.does(&["study", "begin", "small.toml", "--name", "beside", "--seeds", &seeds, "--plant", "planner.toml"]);
        let work = ["study", "work", "--wait", "--plant", "farm-1.toml"];
        Self { worker: Running::new(regrind(&work, plant.home.path())) }
    }

    /// Waits for the end of the study. Asserts that the worker has survived everything, and that each of the `seeds` runs of the study has a result. The
    /// cells can have kept the worker from the processors, so it has time as long as it makes runs.
    fn finish(mut self, plant: &Plant, seeds: usize) {
        let count = |state: &str| plant.sql(&format!("SELECT count(*) FROM study_job WHERE state IN ({state})"));
        let mut open = count("'open', 'leased'");
        println!("{open} of {seeds} runs of the study are left");
        while open != "0" {
            let before = open;
            open = self
                .worker
                .until("another run of the study", |_| Some(count("'open', 'leased'")).filter(|open| *open != before));
        }
        let failed = plant.sql("SELECT string_agg(result ->> 'error', '; ') FROM study_job WHERE state = 'failed'");
        assert_eq!((count("'done'"), failed.as_str()), (seeds.to_string(), ""));
        self.worker.signal("KILL");
        self.worker.end();
    }
}

/// Archives what has ended so far, as if it were of a month long past. A run that is under way stays, and the database can
/// be gone.
fn archive(plant: &Plant) {
    plant.sql("UPDATE month_block SET month = '2024-11-01' WHERE month <= now()");
    plant.sql(
        "UPDATE run r SET arrived_at = '2024-11-30' FROM record e
         WHERE e.run = r.id AND e.seq = r.records AND e.text LIKE '%\"kind\":\"seal\"%' AND r.ended IS NOT NULL",
    );
    let arguments = ["plant", "archive", "--before", "2025-01", "--out", "old", "--plant", "owner.toml"];
    let (code, out, errors) = crate::run(&arguments, plant.home.path());
    assert!(matches!(code, 0 | 1), "{code}: {out}{errors}");
}

/// Brings every archived run back. Returns their number.
fn unarchive(plant: &Plant) -> usize {
    let places = plant.sql("SELECT archive FROM run WHERE archived_at IS NOT NULL");
    let places: Vec<&str> = places.lines().collect();
    for place in &places {
        plant.does(&["audit", "verify", place]);
        plant.does(&["plant", "unarchive", place, "--plant", "owner.toml"]);
    }
    places.len()
}

/// Asserts that a cell publishes another birth to the broker, whatever happened to the network and to the broker.
fn is_told(cell: &Cell, broker: &Broker) {
    let births = || broker.log().matches(&format!("spBv1.0/plant/NBIRTH/{}'", cell.name)).count();
    let (before, began) = (births(), Instant::now());
    let _tells = cell.does(&["tell"]);
    while births() == before {
        assert!(began.elapsed() < PATIENCE, "{} is not told:\n{}", cell.name, broker.log());
        std::thread::park_timeout(Duration::from_millis(50));
    }
}

#[test]
#[ignore = "needs PostgreSQL and mosquitto (Debian packages)"]
fn resumed_run_is_shipped_while_it_runs() {
    let plant = Plant::new();
    fs::create_dir(plant.path("net")).unwrap();
    let socket = plant.postgres.socket_file();
    let _network = Network::between(&plant.path("net").join(socket.file_name().unwrap()), socket.clone());
    plant.somebody("planner", "planner");
    fs::write(plant.path("small.toml"), recipe()).unwrap();
    plant.does(&["plant", "propose", "small.toml", "--plant", "planner.toml"]);
    let approvers = ["Ada", "Bob"].map(|person| approves(&plant, person, "small")).concat();
    plant.does(&["plant", "queue", "SN-1", "--recipe", "small", "--plant", "planner.toml"]);
    let broker = Broker::start();
    let (cell, _machines) = cell(&plant, 1, &approvers, &broker);
    let none = BTreeSet::new();
    let mut running = cell.does(&["work", "--cell", "cell.toml", "--json", "--once"]);
    assert_eq!(follow(&mut running, &|| cell.open_run(&none), 25), None, "killed in the middle");
    // The programs that ship and tell end with the program that they serve.
    let began = Instant::now();
    while plant.sql("SELECT count(*) FROM pg_stat_activity WHERE usename = 'cell_1'") != "0" {
        assert!(began.elapsed() < PATIENCE, "they do not end");
        std::thread::park_timeout(Duration::from_millis(50));
    }
    let shipped = |plant: &Plant| plant.sql("SELECT records FROM run").parse::<u64>().unwrap();
    let before = shipped(&plant);
    let run = cell.open_run(&none).unwrap();
    let name = run.strip_prefix(&cell.home).unwrap().display().to_string();
    let mut running = cell.does(&["resume", &name, "--json"]);
    running.until("records that arrive while the run is on", |_| (shipped(&plant) > before).then_some(()));
    assert!(!is_over(&run) && !running.is_over());
    assert_eq!(follow(&mut running, &|| Some(run.clone()), usize::MAX), Some(0));
    let began = Instant::now();
    while plant.sql("SELECT state FROM work") != "ended" {
        assert!(began.elapsed() < PATIENCE, "the end of the part does not arrive");
        std::thread::park_timeout(Duration::from_millis(50));
    }
    let steps =
        "SELECT count(*) FILTER (WHERE step = 'begun'), count(*) FILTER (WHERE step = 'given back') FROM work_step";
    assert_eq!(plant.sql(steps), "1|0", "the part stays with its run");
    assert_eq!(shipped(&plant), Reader::open(&run).unwrap().last().unwrap().unwrap().seq);
}

/// Returns the number of parts without a finished run, by the records at the cells.
fn open_parts(plant: &Plant, cells: &[Cell], parts: usize) -> usize {
    let begun: usize = plant.sql("SELECT count(*) FROM work WHERE state IN ('begun', 'ended')").parse().unwrap();
    let over = cells.iter().flat_map(|cell| runs_of(&cell.runs())).filter(|run| is_over(run));
    parts - over.count().min(begun)
}

fn runs_of(runs: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(runs).into_iter().flatten().flatten().map(|entry| entry.path());
    entries.filter(|run| run.join("journal.sqlite").is_file()).collect()
}

fn is_once_and_whole(plant: &Plant, cells: &[Cell], parts: usize, seed: u64) {
    let mut made = BTreeSet::new();
    let mut all = 0;
    for cell in cells {
        let file = format!("{}.toml", cell.name);
        let runs = cell.runs().display().to_string();
        if cell.runs().is_dir() {
            plant.does(&["ship", "--once", "--plant", &file, "--runs", &runs]);
        }
        for run in runs_of(&cell.runs()) {
            let name = run.file_name().unwrap().to_string_lossy().into_owned();
            let records: Vec<_> = Reader::open(&run).unwrap().records(1).map(Result::unwrap).collect();
            let last = records.last().unwrap();
            let there = plant.sql(&format!(
                "SELECT r.records || ' ' || encode(r.head, 'hex') || ' ' || (SELECT count(*) FROM record e WHERE e.run = r.id)
                FROM run r JOIN cell c ON c.id = r.cell WHERE c.name = '{}' AND r.name = '{name}'",
                cell.name
            ));
            assert_eq!(there, format!("{0} {1} {0}", records.len(), last.hash), "seed {seed}, {name}");
            let was_driven = records.iter().any(|record| matches!(record.kind, RecordKind::Intent | RecordKind::Event));
            assert!(!was_driven || made.insert(last.part.clone()), "seed {seed}: {} was begun twice", last.part);
            all += records.len();
        }
        // The machines' own logs show that each pass and each measurement began once.
        began_once(&cell.home);
    }
    assert_eq!((made.len(), plant.sql("SELECT count(*) FROM record")), (parts, all.to_string()), "seed {seed}");
    let missing = "SELECT count(*) FROM run_artefact a JOIN run r ON r.id = a.run
        WHERE NOT EXISTS (SELECT FROM artefact_of o WHERE o.cell = r.cell AND o.sha256 = a.sha256)";
    assert_eq!(plant.sql(missing), "0", "seed {seed}");
    let begun = "SELECT count(*) FROM (SELECT work, count(*) FILTER (WHERE step = 'begun') - count(*) FILTER (WHERE step = 'given back') AS n
        FROM work_step GROUP BY work) s WHERE n <> 1";
    assert_eq!(
        (plant.sql(begun), plant.sql("SELECT count(*) FROM work WHERE state <> 'ended'")),
        ("0".into(), "0".into()),
        "seed {seed}"
    );
    let incidents = plant.sql("SELECT string_agg(DISTINCT what, ', ') FROM incident");
    assert!(["", "work refused"].contains(&incidents.as_str()), "seed {seed}: {incidents}");
    println!("seed {seed}: {parts} parts, {all} records");
}

#[test]
#[ignore = "needs PostgreSQL and mosquitto (Debian packages)"]
fn failures_duplicate_no_record_or_part() {
    weather(1, 2, 2);
}

#[test]
#[ignore = "takes half an hour, for .ci/long; needs PostgreSQL and mosquitto (Debian packages)"]
fn two_hundred_parts_of_eight_cells() {
    // REGRIND_PARTS: another number of parts.
    let parts = std::env::var("REGRIND_PARTS").map_or(200, |parts| parts.parse().unwrap());
    weather(2, 8, parts);
}
