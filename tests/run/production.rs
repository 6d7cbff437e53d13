//! Production for a chosen time: one program makes part after part, against machines in another program that outlive
//! every part, at a hundred times real speed. Only a long production shows growth of memory, open files that are not
//! closed, and drift.
//!
//! The program that makes the parts is this test in its own process, where no other test runs. For each part it does
//! the same as `regrind run`: it takes the machines, starts a record, drives to the end and writes the report.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use crate::program::{PATIENCE, Running, changed, regrind, small_recipe};
use regrind::cell::{Actor, Ending};
use regrind::config::{CellConfig, LinkConfig};
use regrind::device::MachineKind;
use regrind::drive::{BlockingExecutor, Drive, RunInputs};
use regrind::journal::{Header, Journal, MachineLock, verify};
use regrind::recipe::Recipe;
use regrind::setup;
use serde_json::{Value, json};
use tokio::sync::mpsc;

/// Seconds of machine time per second.
const SPEED: f64 = 100.0;
/// Duration of the production in minutes, unless REGRIND_PRODUCTION_MINUTES is set. There are always at least some
/// parts more than the warm-up.
const MINUTES: f64 = 30.0;
/// Variables for the process that makes the parts: the folder of the recipe, the cell and the machines' log; and the
/// id of the machines' process.
const HOME: &str = "REGRIND_PRODUCTION_HOME";
const MACHINES: &str = "REGRIND_PRODUCTION_MACHINES";
const NAME: &str = "production::thirty_minutes_of_production";
/// Line that follows the last part.
const OVER: &str = "production is over";

/// Number of parts before memory is first examined. By then, everything that is allocated once and kept has been
/// allocated.
const WARM_UP: usize = 5;
/// Number of parts in each of the two compared groups. The memory of a process after a part varies by some per cent
/// with the memory that it has just freed. The test therefore compares the median of this many parts after the warm-up
/// with the median of as many at the end.
const COMPARED: usize = 10;
/// Upper bound of the growth of memory, in %.
const GROWTH_PERCENT: f64 = 5.0;
/// Upper bound of the time between two heartbeats of its owner at a machine, in s: half the time after which the
/// machine holds itself.
const LONGEST_SILENCE_S: f64 = 1.5;
/// Upper bound of the difference, in %, between the mean heartbeat period in the last tenth of the jobs and in the
/// first tenth.
const DRIFT_PERCENT: f64 = 5.0;

#[test]
#[ignore = "takes half an hour: for .ci/long; six minutes with REGRIND_PRODUCTION_MINUTES=0"]
fn thirty_minutes_of_production() {
    match std::env::var_os(HOME) {
        Some(home) => Production::new(Path::new(&home)).go_on(),
        None => in_processes_of_their_own(),
    }
}

/// Starts the machines, then the program that makes the parts, and waits for the end of both.
fn in_processes_of_their_own() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), SPEED);
    let open = changed("config/modbus-tcp.toml", &[("15021", "0"), ("15022", "0")]);
    fs::write(home.path().join("open.toml"), open).unwrap();
    let simulate = ["simulate", recipe.to_str().unwrap(), "--cell", "open.toml", "--json", "--log", "machines.jsonl"];
    let mut serving = Running::new(frugal(regrind(&simulate, home.path())));
    let wires: Value = serde_json::from_str(&serving.line("wires", |_| true)).unwrap();
    let port = |machine: &str| wires[machine]["port"].to_string();
    let bound = changed("config/modbus-tcp.toml", &[("15021", &port("cmm")), ("15022", &port("grinder"))]);
    fs::write(home.path().join("cell.toml"), bound).unwrap();

    let mut making = Command::new(std::env::current_exe().unwrap());
    making.args(["--exact", NAME, "--ignored", "--nocapture"]).current_dir(home.path());
    making.env(HOME, home.path()).env(MACHINES, serving.id().to_string());
    let mut making = Running::new(frugal(making));
    loop {
        let line = making.line("part", |line| line.contains("part ") || line.contains(OVER));
        println!("{line}");
        if line.contains(OVER) {
            break;
        }
    }
    let (code, told) = making.end();
    making.output_lines.iter().skip_while(|line| !line.contains(OVER)).skip(1).for_each(|line| println!("{line}"));
    assert_eq!(code, 0, "{told}");
    serving.interrupt();
    assert_eq!(serving.end().0, 0, "{}", serving.error_text);
}

/// Makes the allocator of a program return freed memory at once. The test measures the memory that the program uses,
/// not the memory that its allocator keeps for later, which varies by a tenth.
fn frugal(mut command: Command) -> Command {
    command.env("MALLOC_ARENA_MAX", "1").env("MALLOC_TOP_PAD_", "0");
    command.env("MALLOC_TRIM_THRESHOLD_", "0").env("MALLOC_MMAP_THRESHOLD_", "65536");
    command
}

/// Resources of a process, as the operating system reports them.
#[derive(Clone, Copy, Debug)]
struct Held {
    resident_kb: u64,
    peak_kb: u64,
    descriptors: usize,
    threads: u64,
}

impl Held {
    fn by(process: u32) -> Self {
        let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap();
        let figure = |name: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(name)).unwrap();
            line.split_whitespace().next().unwrap().parse().unwrap()
        };
        Self {
            resident_kb: figure("VmRSS:"),
            peak_kb: figure("VmHWM:"),
            descriptors: fs::read_dir(format!("/proc/{process}/fd")).unwrap().count(),
            threads: figure("Threads:"),
        }
    }

    /// Polls until a process has no more open files and threads than before. The resources of a part are released soon
    /// after its end, not at once.
    fn again_by(process: u32, before: &Self, part: usize) -> Self {
        let began = Instant::now();
        loop {
            let now = Self::by(process);
            if (now.descriptors, now.threads) == (before.descriptors, before.threads) {
                return now;
            }
            assert!(
                began.elapsed() < PATIENCE,
                "process {process} after part {part}: {now}; before the first: {before}"
            );
            std::thread::park_timeout(Duration::from_millis(20));
        }
    }
}

impl fmt::Display for Held {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { resident_kb, peak_kb, descriptors, threads } = self;
        write!(f, "{resident_kb} kB, at most {peak_kb} kB, {descriptors} descriptors, {threads} threads")
    }
}

/// Program that makes the parts.
struct Production {
    home: PathBuf,
    recipe: Recipe,
    cell: CellConfig,
    /// This process, and that of the machines.
    processes: [(&'static str, u32); 2],
    runtime: tokio::runtime::Runtime,
}

impl Production {
    fn new(home: &Path) -> Self {
        let machines = std::env::var(MACHINES).unwrap().parse().unwrap();
        let mut cell = CellConfig::read(&home.join("cell.toml")).unwrap();
        for link in [&mut cell.cmm.link, &mut cell.grinder.link] {
            // A stall of the computer must not look like a machine that is gone.
            link.timing.request_timeout = Duration::from_secs(5);
            link.timing.lost_after = Duration::from_secs(60);
        }
        // Same as in `regrind run`, except that a thread ends at once after a computation. Otherwise the test could
        // count it as a leaked thread.
        let mut runtime = tokio::runtime::Builder::new_multi_thread();
        runtime.worker_threads(2).thread_keep_alive(Duration::from_millis(1)).enable_all();
        Self {
            home: home.to_owned(),
            recipe: Recipe::read(&home.join("small.toml")).unwrap(),
            cell,
            processes: [("controller", std::process::id()), ("machines", machines)],
            runtime: runtime.build().unwrap(),
        }
    }

    /// Makes parts until the time is over, measures the resources after each, and checks them all against the bounds.
    fn go_on(&self) {
        let minutes = std::env::var("REGRIND_PRODUCTION_MINUTES").map_or(MINUTES, |text| text.parse().unwrap());
        // Starts the threads that are created once and stay before the first part.
        rayon::broadcast(|_| ());
        self.runtime.block_on(async { tokio::spawn(async {}).await }).unwrap();
        let before = self.processes.map(|(_, process)| Held::by(process));
        let (began, mut after, mut cycles) = (Instant::now(), Vec::new(), 0);
        while after.len() < WARM_UP + 2 || began.elapsed().as_secs_f64() < 60.0 * minutes {
            let part = after.len() + 1;
            let ending = self.runtime.block_on(self.make(part));
            let (Ending::Accepted { cycle, .. } | Ending::NotAccepted { cycle, .. }) = ending else {
                panic!("part {part}: {ending:?}")
            };
            cycles += cycle;
            after.push([0, 1].map(|k| Held::again_by(self.processes[k].1, &before[k], part)));
            let at_min = began.elapsed().as_secs_f64() / 60.0;
            let [controller, machines] = &after[part - 1];
            println!("part {part}, {at_min:.1} min: controller {controller}; machines {machines}");
        }
        let production_min = began.elapsed().as_secs_f64() / 60.0;
        println!(
            "\n{OVER}: {} parts, {cycles} cycles in {production_min:.1} min at {SPEED} times the speed",
            after.len()
        );
        self.hold_against_bounds(&before, &after);
    }

    fn hold_against_bounds(&self, before: &[Held; 2], after: &[[Held; 2]]) {
        // A run that is too short for the comparison prints its measurements, and its memory is not judged.
        let compared = COMPARED.min((after.len() - WARM_UP) / 2);
        let mut grown = Vec::new();
        for (k, (name, _)) in self.processes.iter().enumerate() {
            let median_kb = |parts: &[[Held; 2]]| {
                let mut kb: Vec<u64> = parts.iter().map(|held| held[k].resident_kb).collect();
                *kb.select_nth_unstable(parts.len() / 2).1
            };
            let first_kb = median_kb(&after[WARM_UP..WARM_UP + compared]);
            let last_kb = median_kb(&after[after.len() - compared..]);
            let growth_percent = 100.0 * (last_kb as f64 / first_kb as f64 - 1.0);
            println!("{name}, before the first part: {}", before[k]);
            println!("{name}, after the last part: {}", after[after.len() - 1][k]);
            println!(
                "{name}, memory: {first_kb} kB in the {compared} parts after the first {WARM_UP}, {last_kb} kB in the last \
                 {compared}, {growth_percent:+.1} %"
            );
            grown.push((name, growth_percent));
        }
        let beats = ["cmm", "grinder"].map(|kind| (kind, Beats::heard_by(kind, &self.home.join("machines.jsonl"))));
        beats.iter().for_each(|(kind, beats)| println!("{kind}: {beats}"));
        for (name, growth_percent) in grown {
            let is_judged = compared == COMPARED;
            assert!(!is_judged || growth_percent < GROWTH_PERCENT, "{name}: memory grew by {growth_percent:.1} %");
        }
        for (kind, beats) in beats {
            assert!(beats.longest_silence_s < LONGEST_SILENCE_S, "{kind}: {beats}");
            assert!(100.0 * (beats.last_mean_s / beats.first_mean_s - 1.0).abs() < DRIFT_PERCENT, "{kind}: {beats}");
        }
    }

    /// Makes one part as `regrind run` does, verifies its record, and removes it.
    async fn make(&self, part: usize) -> Ending {
        let (recipe, cell) = (&self.recipe, &self.cell);
        let (task, plan) = setup::prepare(recipe, cell).unwrap();
        let folder = self.home.join("runs").join(part.to_string());
        let take = |kind: MachineKind, link: &LinkConfig| {
            let (line, unit) = link.wire.modbus_line().unwrap();
            MachineLock::acquire(&format!("{kind} at {line}, unit {unit}"), &folder).unwrap()
        };
        let taken = [take(MachineKind::Cmm, &cell.cmm.link), take(MachineKind::Grinder, &cell.grinder.link)];
        let job = u32::try_from(part).unwrap();
        let client = [0x5247, MachineLock::epoch(taken.iter(), job)];
        let name = format!("SN-{part}");
        let (cmm, grinder) = setup::create_drivers(recipe, cell, &name, &folder, client).unwrap();
        let actor = Actor { name: "production".into(), station: "here".into() };
        let header = Header {
            run: part.to_string(),
            part: name,
            actor: actor.name.clone(),
            station: actor.station.clone(),
            simulation: true,
            first_command_id: 1,
            content: json!({}),
        };
        let journal = Journal::create_with(&folder, header, None).unwrap();
        let poll = [setup::poll_interval(&cell.cmm.link), setup::poll_interval(&cell.grinder.link)];
        let (notices, mut shown) = mpsc::unbounded_channel();
        let showing = tokio::spawn(async move { while shown.recv().await.is_some() {} });
        let (journal, beside) = (Box::new(journal), BlockingExecutor::Threads);
        let run = RunInputs {
            plan,
            task,
            journal,
            job,
            actor,
            load_confirmed: true,
            poll_intervals: poll,
            notices,
            interrupted: None,
            executor: beside,
        };
        let (drive, orders) = Drive::with_cell(run, cmm, grinder).unwrap();
        let ending = drive.run().await;
        drop(orders);
        showing.await.unwrap();
        regrind::report::write_run_report(&folder, &regrind::report::ReportOptions::default()).unwrap();
        let verified = verify(&folder).unwrap();
        assert!(verified.closed && verified.open_intents.is_empty(), "part {part}: {verified:?}");
        fs::remove_dir_all(&folder).unwrap();
        ending
    }
}

/// Heartbeats of the drive as a machine received them, by the machine's log.
struct Beats {
    heard: u64,
    longest_silence_s: f64,
    /// Mean heartbeat period in the first tenth of its jobs and in the last.
    first_mean_s: f64,
    last_mean_s: f64,
}

impl Beats {
    fn heard_by(kind: &str, log: &Path) -> Self {
        let text = fs::read_to_string(log).unwrap();
        let seen = text.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
        let is_here = |seen: &Value| seen["what"] == "ended" && (seen["unit"] == 1) == (kind == "cmm");
        let jobs: Vec<Value> = seen.filter(is_here).collect();
        let tenth = jobs.len().div_ceil(10);
        let figure = |job: &Value, name: &str| job[name].as_f64().unwrap();
        let mean = |jobs: &[Value]| jobs.iter().map(|job| figure(job, "mean_beat_s")).sum::<f64>() / jobs.len() as f64;
        Self {
            heard: jobs.iter().map(|job| job["beats"].as_u64().unwrap()).sum(),
            longest_silence_s: jobs.iter().map(|job| figure(job, "longest_silence_s")).fold(0.0, f64::max),
            first_mean_s: mean(&jobs[..tenth]),
            last_mean_s: mean(&jobs[jobs.len() - tenth..]),
        }
    }
}

impl fmt::Display for Beats {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { heard, longest_silence_s, first_mean_s, last_mean_s } = self;
        write!(
            f,
            "{heard} beats, {first_mean_s:.3} s apart in the first tenth of its jobs and {last_mean_s:.3} s in the last, no \
             silence longer than {longest_silence_s:.2} s"
        )
    }
}
