//! The program is killed in the middle of a run, a random number of times, and `regrind resume` continues it to its
//! end.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Stdio;

use crate::program::{Running, changed, only_run, records_with, regrind, run_folders};
use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use regrind::journal::{Reader, RecordKind, verify};
use regrind_sim::event_log::HandshakeEvent;
use regrind_testcell::outlived::{began_once, follow, on_serial_lines};
use regrind_testcell::rig::{CMM, GRINDER, Rig, small};
use regrind_testutils::sample::seeds;

/// Maximum number of kills of a part's program.
const MAX_KILLS: usize = 3;

/// Starts a cell whose machines outlive the program, and writes the files that the program needs to run it.
async fn cell_that_stays() -> (Rig, PathBuf) {
    let rig = Rig::new(small(12, 8, 5000.0)).await;
    let home = rig.home.path().to_owned();
    let port = |k: usize| rig.servings[k].local_addr().unwrap().port().to_string();
    let cell = changed("config/modbus-tcp.toml", &[("15021", &port(CMM)), ("15022", &port(GRINDER))]);
    fs::write(home.join("cell.toml"), cell).unwrap();
    fs::write(home.join("part.toml"), rig.recipe.text()).unwrap();
    (rig, home)
}

/// Runs a part whose program is killed at random moments. Returns its folder and the number of kills.
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
    let folder = || run_folders(&home.join(&runs)).pop();
    let mut kills = 0;
    loop {
        let lines = if kills < MAX_KILLS { chance.random_range(1..50) } else { usize::MAX };
        let ended = follow(&mut running, &folder, lines);
        match ended {
            Some(0) => return (folder().unwrap(), kills),
            // Killed between the last record and its report.
            Some(_) if running.has_error_text("the run is over") => return (folder().unwrap(), kills),
            Some(code) => {
                assert!(running.has_error_text("begin a new run"), "seed {seed}, {code}: {:#?}", running.error_text)
            }
            None => kills += 1,
        }
        // The program may have been killed before it started its record, or before it sent anything to a machine.
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

/// Checks that the record is complete and contains every file, and that no START was accepted twice.
fn is_whole(folder: &Path, seed: u64) {
    crate::contents::assert_known(folder);
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

/// Checks that every pass and every measurement started at most once, in the record and at the machines.
fn hold_against(rig: &Rig, folder: &Path, seed: u64) {
    is_whole(folder, seed);
    let begun = &Reader::open(folder).unwrap().records(0).next().unwrap().unwrap().value()["content"];
    let job = begun["job"].as_u64().unwrap() as u32;
    for (machine, device) in [(CMM, "cmm"), (GRINDER, "grinder")] {
        let mut began: BTreeMap<u16, u32> = BTreeMap::new();
        rig.servings[machine].machines()[0].1.with(|m| {
            for seen in m.log() {
                if let HandshakeEvent::Began { job: of, cycle, .. } = seen.event
                    && of == job
                {
                    *began.entry(cycle).or_default() += 1;
                }
            }
        });
        assert!(began.values().all(|times| *times == 1), "seed {seed}, {device}: {began:?}");
        let passes: Vec<_> = began.keys().copied().collect();
        let reader = Reader::open(folder).unwrap();
        let intents = reader.records(0).map(Result::unwrap).filter(|r| r.kind == RecordKind::Intent).map(|r| r.value());
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
async fn killed_program_resumes_each_pass_once() {
    killed(1..=seeds(3)).await;
}

#[test]
fn killed_program_resumes_on_serial_line() {
    let home = tempfile::tempdir().unwrap();
    let _serving = on_serial_lines(regrind, home.path(), small(12, 8, 2000.0).text());
    let (folder, kills) = run_with_kills(home.path(), 21);
    println!("{kills} kills");
    is_whole(&folder, 21);
    // Two machines and at least two passes. The first program may have been killed before it had a record of its part.
    assert!(began_once(home.path()) >= 4);
}

/// Runs a part whose program is killed while it grinds, and returns the folder of the run.
fn killed_at_work(home: &Path) -> PathBuf {
    let arguments = ["run", "part.toml", "--cell", "cell.toml", "--json"];
    let mut running = Running::new(regrind(&arguments, home));
    let folder = || run_folders(&home.join("runs")).pop();
    assert_eq!(follow(&mut running, &folder, 14), None, "it is killed in the middle");
    folder().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unrecorded_file_decides_nothing() {
    let (_rig, home) = cell_that_stays().await;
    tokio::task::spawn_blocking(move || {
        let folder = killed_at_work(&home);
        // Somebody adds the file with which a run starts that has learned from another run.
        fs::write(folder.join("learned_from.json"), "{}").unwrap();
        let path = folder.to_str().unwrap();
        let mut running = Running::new(regrind(&["resume", path, "--json"], &home));
        let found = || Some(folder.clone());
        assert_eq!(follow(&mut running, &found, usize::MAX), Some(0), "{}", running.error_text);
        let verified = verify(&folder).unwrap();
        assert!(verified.closed && verified.unrecorded.contains(&"learned_from.json".to_owned()), "{verified:?}");
    })
    .await
    .unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn resume_refuses_lost_records() {
    let (_rig, home) = cell_that_stays().await;
    tokio::task::spawn_blocking(move || {
        let folder = killed_at_work(&home);
        let path = folder.to_str().unwrap().to_owned();
        let resumed = |more: &[&str]| {
            let mut running = Running::new(regrind(&[&["resume", &path], more].concat(), &home));
            running.end()
        };
        for name in ["journal.sqlite-wal", "journal.anchor"] {
            let (there, away) = (folder.join(name), home.join("away"));
            fs::rename(&there, &away).unwrap();
            let (code, told) = resumed(&[]);
            assert!(code == 1 && told.contains("may be lost") && told.contains("regrind recover"), "{name}: {told}");
            fs::rename(&away, &there).unwrap();
        }
        // A cycle that is not in the record.
        fs::create_dir(folder.join("cycle-7")).unwrap();
        let (code, told) = resumed(&[]);
        assert!(code == 1 && told.contains("files of cycle 7"), "{told}");
        let mut running = Running::new(regrind(&["resume", &path, "--despite-loss", "--json"], &home));
        let found = || Some(folder.clone());
        assert_eq!(follow(&mut running, &found, usize::MAX), Some(0), "{}", running.error_text);
        let remarks = records_with(&folder, "remark");
        let said = remarks.iter().filter_map(|record| record["remark"].as_str());
        assert_eq!(
            said.filter(|said| said.contains("--despite-loss") && said.contains("cycle 7")).count(),
            1,
            "{remarks:?}"
        );
    })
    .await
    .unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "takes minutes: for .ci/long"]
async fn two_hundred_kills() {
    killed(1000..1105).await;
}

/// Runs a part until the machine of a job moves, and kills the program. Returns the folder of the run.
fn killed_while(home: &Path, moment: &str) -> PathBuf {
    let mut running = Running::new(regrind(&["run", "part.toml", "--cell", "cell.toml", "--json"], home));
    running.line(moment, |line| line.contains(moment));
    running.signal("KILL");
    running.end();
    only_run(&home.join("runs"))
}

fn recover(home: &Path, typed: &str) -> (i32, String) {
    let mut command = regrind(&["recover", "--cell", "cell.toml"], home);
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    // The program may read none of the input.
    let _ = child.stdin.take().unwrap().write_all(typed.as_bytes());
    let output = child.wait_with_output().unwrap();
    let said = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap()).join("");
    (output.status.code().unwrap_or(-1), said)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn recover_clears_machines_stepwise() {
    let (_rig, home) = cell_that_stays().await;
    tokio::task::spawn_blocking(move || {
        let run = killed_while(&home, "\"event\":\"started\"");
        let name = run.file_name().unwrap().to_str().unwrap().to_owned();
        fs::rename(&run, home.join("kept")).unwrap();
        // An invalid confirmation has no effect.
        let (code, said) = recover(&home, "yes\nyes\n");
        assert_eq!(code, 3, "{said}");
        assert!(!said.contains(&name), "{said}");
        let (code, said) = recover(&home, &"STOP\nACKNOWLEDGE\nCLEAR\n".repeat(4));
        assert!(code == 0 || code == 3, "{said}");
        // In whatever state the CMM is by then, one confirmation after the other recovers it in the end.
        for _ in 0..4 {
            for word in ["STOP\n", "ACKNOWLEDGE\n", "CLEAR\n"] {
                recover(&home, word);
            }
        }
        let (code, said) = recover(&home, "");
        assert!(code == 0 && said.matches("IDLE").count() == 2, "{said}");
        for folder in run_folders(&home.join("runs")) {
            crate::contents::assert_known(&folder);
            let verified = verify(folder).unwrap();
            assert!(verified.closed && verified.open_intents.is_empty(), "{verified:?}");
        }
    })
    .await
    .unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn resume_refuses_changed_run() {
    let (rig, home) = cell_that_stays().await;
    let commands =
        |rig: &Rig| [CMM, GRINDER].map(|k| rig.came[k].lock().unwrap().iter().filter(|c| c.command.is_some()).count());
    let (run, home) =
        tokio::task::spawn_blocking(move || (killed_while(&home, "\"event\":\"started\""), home)).await.unwrap();
    let before = commands(&rig);
    let resumed = |arguments: &[&str]| {
        let all: Vec<&str> = ["resume"].iter().chain(arguments).copied().collect();
        crate::program::run(&all, &home)
    };
    let run = run.to_str().unwrap();
    // Another part than the one that the run started with.
    let recipe = Path::new(run).join("recipe.toml");
    let text = fs::read_to_string(&recipe).unwrap();
    fs::write(&recipe, text.replacen("rows = 8", "rows = 9", 1)).unwrap();
    let (code, _, said) = resumed(&[run]);
    assert!(code == 1 && said.contains("recipe.toml was changed"), "{said}");
    fs::write(&recipe, text).unwrap();
    let (code, _, said) = resumed(&["nowhere"]);
    assert!(code == 2 && said.contains("nowhere"), "{said}");
    assert_eq!(commands(&rig), before, "nothing was commanded");

    // A run whose machines were part of the program itself.
    let own = crate::program::changed("config/sim.toml", &[]);
    fs::write(home.join("sim.toml"), own).unwrap();
    let mut running =
        Running::new(regrind(&["run", "part.toml", "--cell", "sim.toml", "--runs", "own", "--json"], &home));
    running.line("a pass", |line| line.contains("\"event\":\"started\""));
    running.signal("KILL");
    running.end();
    let own = only_run(&home.join("own"));
    let (code, _, said) = resumed(&[own.to_str().unwrap()]);
    assert!(code == 2 && said.contains("simulated machines"), "{said}");
}
