//! The program is killed in the middle of a run, as often as is drawn, and `regrind resume` goes on with it to its end.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Stdio;

use crate::program::{PATIENCE, Running, changed, records_with, regrind};
use crate::rig::{CMM, GRINDER, Rig, small};
use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use regrind::cell::StateName;
use regrind::drive::{Request, ask};
use regrind::journal::{Kind, Reader, verify};
use regrind_sim::seen::What;
use serde_json::Value;

/// How often a part's program is killed at most.
const MOST_KILLS: usize = 3;

/// A cell whose machines outlive the program, and files for the program to run it by.
async fn cell_that_stays() -> (Rig, PathBuf) {
    let rig = Rig::new(small(12, 8, 5000.0)).await;
    let home = rig.home.path().to_owned();
    let port = |k: usize| rig.servings[k].local_addr().unwrap().port().to_string();
    let cell = changed("config/modbus-tcp.toml", &[("15021", &port(CMM)), ("15022", &port(GRINDER))]);
    fs::write(home.join("cell.toml"), cell).unwrap();
    fs::write(home.join("part.toml"), rig.recipe.text()).unwrap();
    (rig, home)
}

/// Follows a program until it has said so much, and kills it then, or to its end; a person lets the cell go on wherever it holds.
/// Returns its exit code, if it came to its end.
fn follow(running: &mut Running, folder: &dyn Fn() -> Option<PathBuf>, lines: usize) -> Option<i32> {
    let began = std::time::Instant::now();
    loop {
        if running.has_said() >= lines {
            running.signal("KILL");
            running.end();
            return None;
        }
        if running.is_over() {
            return Some(running.end().0);
        }
        if let Some(status) = folder().and_then(|folder| ask(&folder, &Request::Status).ok())
            && status.status.state == StateName::Held
        {
            let resume = Request::Resume { reason: "seen".into(), seen: Some(status.status.number) };
            // It may have been killed meanwhile, or wait for a machine still.
            let _ = ask(&folder().unwrap(), &resume);
        }
        assert!(began.elapsed() < PATIENCE, "it comes to no end: {:#?}", running.said);
        std::thread::park_timeout(std::time::Duration::from_millis(5));
    }
}

/// Runs a part whose program is killed at drawn moments. Returns its folder and how often it was killed.
pub fn run_with_kills(home: &Path, seed: u64) -> (PathBuf, usize) {
    let mut chance = StdRng::seed_from_u64(seed);
    let runs = format!("runs-{seed}");
    let signed = |arguments: &[&str]| {
        let mut command = regrind(arguments, home);
        command.env("REGRIND_KEY", home.join("audit.key"));
        Running::new(command)
    };
    assert_eq!(signed(&["audit", "key"]).end().0, 0);
    let mut running = signed(&["run", "part.toml", "--cell", "cell.toml", "--runs", &runs, "--json"]);
    let folder = || fs::read_dir(home.join(&runs)).ok()?.next()?.ok().map(|entry| entry.path());
    let mut kills = 0;
    loop {
        let lines = if kills < MOST_KILLS { chance.random_range(1..50) } else { usize::MAX };
        let ended = follow(&mut running, &folder, lines);
        match ended {
            Some(0) => return (folder().unwrap(), kills),
            // Killed between the last record and its report.
            Some(_) if running.has_been_told("the run is over") => return (folder().unwrap(), kills),
            Some(code) => assert!(running.has_been_told("begin a new run"), "seed {seed}, {code}: {:#?}", running.told),
            None => kills += 1,
        }
        // It may have been killed before it had begun its record, or asked anything of a machine.
        let run = folder().filter(|_| ended.is_none());
        let arguments = match &run {
            Some(run) => vec!["resume", run.to_str().unwrap(), "--json"],
            None => {
                folder().map_or(Ok(()), fs::remove_dir_all).unwrap();
                vec!["run", "part.toml", "--cell", "cell.toml", "--runs", &runs, "--json"]
            }
        };
        running = signed(&arguments);
    }
}

/// The record is whole and all on it, and no START was taken twice.
fn is_whole(folder: &Path, seed: u64) {
    let verified = verify(folder).unwrap();
    assert!(
        verified.closed && verified.unrecorded.iter().all(|name| name == "report.html"),
        "seed {seed}: {verified:?}"
    );
    let events = records_with(folder, "device").into_iter();
    let mut started: Vec<_> = events.filter(|event| event["event"] == "started").collect();
    started.iter_mut().for_each(|event| drop(event.as_object_mut().unwrap().remove("detail")));
    let all = started.len();
    started.sort_by_key(ToString::to_string);
    started.dedup();
    assert_eq!(started.len(), all, "seed {seed}: a START was taken twice");
}

/// Every pass and every measurement began at most once, in the record and at the machines.
fn hold_against(rig: &Rig, folder: &Path, seed: u64) {
    is_whole(folder, seed);
    let begun = &Reader::open(folder).unwrap().records(0).next().unwrap().unwrap().value()["content"];
    let job = begun["job"].as_u64().unwrap() as u32;
    for (machine, device) in [(CMM, "cmm"), (GRINDER, "grinder")] {
        let mut began: BTreeMap<u16, u32> = BTreeMap::new();
        rig.servings[machine].machines()[0].1.with(|m| {
            for seen in m.log() {
                if let What::Began { job: of, cycle, .. } = seen.what
                    && of == job
                {
                    *began.entry(cycle).or_default() += 1;
                }
            }
        });
        assert!(began.values().all(|times| *times == 1), "seed {seed}, {device}: {began:?}");
        let passes: Vec<_> = began.keys().copied().collect();
        let reader = Reader::open(folder).unwrap();
        let intents = reader.records(0).map(Result::unwrap).filter(|r| r.kind == Kind::Intent).map(|r| r.value());
        let starts = intents.filter(|v| v["command"] == "start_machine" && v["device"] == device);
        let mut intended: Vec<u16> = starts.map(|v| v["cycle"].as_u64().unwrap() as u16).collect();
        intended.dedup();
        assert_eq!(intended, passes, "seed {seed}, {device}: what was intended and what began");
    }
    assert!(!records_with(folder, "transfer").is_empty());
}

async fn killed(seeds: impl Iterator<Item = u64>) {
    for seed in seeds {
        let (rig, home) = cell_that_stays().await;
        let (folder, kills) = tokio::task::spawn_blocking(move || run_with_kills(&home, seed)).await.unwrap();
        println!("seed {seed}: {kills} kills");
        hold_against(&rig, &folder, seed);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_program_is_taken_up_again_and_starts_every_pass_once() {
    killed(1..=13).await;
}

/// Machines on serial lines, played by the program itself, beside a cell for them and this recipe.
pub fn on_serial_lines(home: &Path, recipe: &str) -> Running {
    fs::write(home.join("part.toml"), recipe).unwrap();
    let devices = format!("device = \"{}/", home.display());
    let cell = changed("config/serial-rtu.toml", &[("device = \"/tmp/regrind-", &devices)]);
    fs::write(home.join("cell.toml"), cell).unwrap();
    let mut serving =
        Running::new(regrind(&["simulate", "part.toml", "--cell", "cell.toml", "--log", "machines.jsonl"], home));
    serving.line("its last word", |line| line.starts_with("Ctrl-C"));
    serving
}

/// By the log of those machines, each pass and each measurement began once. Returns how many there were.
pub fn began_once(home: &Path) -> usize {
    let log = fs::read_to_string(home.join("machines.jsonl")).unwrap();
    let seen = log.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    let began = seen.filter(|seen| seen["what"] == "began");
    let mut began: Vec<_> = began.map(|b| format!("{} {} {}", b["machine"], b["job"], b["cycle"])).collect();
    let all = began.len();
    began.sort();
    began.dedup();
    assert_eq!(began.len(), all, "{log}");
    all
}

#[test]
fn over_a_serial_line_too() {
    let home = tempfile::tempdir().unwrap();
    let _serving = on_serial_lines(home.path(), &small(12, 8, 2000.0).text());
    let (folder, kills) = run_with_kills(home.path(), 21);
    println!("{kills} kills");
    is_whole(&folder, 21);
    // Two machines, two passes at least; the first program may have been killed before it had a record of its part.
    assert!(began_once(home.path()) >= 4);
}
