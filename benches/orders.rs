//! Latency of an order from another terminal to the machine: HOLD, RESUME and ABORT in every phase, 200 tries.
//!
//! ```text
//! cargo bench --bench orders [TRIES]
//! cargo bench --features plant --bench orders -- TRIES PLANT.toml
//! ```
//! The time runs from before the order is written to the control socket until the command reaches the simulated
//! machine. With the plant file of a cell, every second round runs while `regrind ship` replicates the record and, if
//! the file names a broker, `regrind tell` publishes live values. The times of the other rounds are printed next to it.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use regrind_testcell::rig::{self, Rig};
use regrind_testcell::tries::{MOMENTS, attempt};

fn main() {
    // Cargo adds options of its own.
    let tries = std::env::args().skip(1).find_map(|argument| argument.parse().ok()).unwrap_or(200);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let plant = std::env::args().skip(1).find(|argument| argument.ends_with(".toml"));
    runtime.block_on(measure(tries, plant.as_deref()));
}

/// Plant processes that run in parallel with the runs below a folder. They end when this value is dropped.
struct PlantProcesses(Vec<Child>);

impl PlantProcesses {
    fn begin(plant: &str, runs: &Path) -> Self {
        let file = std::fs::read_to_string(plant).expect("a plant file");
        let tells = ["[sparkplug]", "[opcua]"].iter().any(|table| file.lines().any(|line| line == *table));
        let programs = ["ship", "tell"].into_iter().filter(|name| *name == "ship" || tells);
        let begun = programs.map(|name| {
            let mut program = Command::new(env!("CARGO_BIN_EXE_regrind"));
            program.args([name, "--plant", plant, "--runs"]).arg(runs).stdin(Stdio::null()).stdout(Stdio::null());
            program.spawn().expect("a program with the feature `plant`")
        });
        Self(begun.collect())
    }
}

impl Drop for PlantProcesses {
    fn drop(&mut self) {
        for child in &mut self.0 {
            // The process has possibly ended already.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

async fn measure(tries: usize, plant: Option<&str>) {
    let mut rig = Rig::new(rig::small(12, 8, 5000.0)).await;
    let mut times: BTreeMap<String, Vec<Duration>> = BTreeMap::new();
    let mut states: BTreeMap<String, usize> = BTreeMap::new();
    let mut slowest: Vec<(Duration, &str, &str)> = Vec::new();
    let mut beside = None;
    for k in 0..tries {
        let moment = &MOMENTS[k % MOMENTS.len()];
        let round = k / MOMENTS.len();
        let ships = plant.filter(|_| !round.is_multiple_of(2));
        if k % MOMENTS.len() == 0 {
            beside = ships.map(|plant| PlantProcesses::begin(plant, rig.home.path()));
        }
        // The same with and without a plant.
        let holds = if plant.is_some() { round / 2 } else { round }.is_multiple_of(2);
        let (tried, _) = attempt(&mut rig, moment, holds).await;
        let aborts = tried.abort.iter().zip(["abort, CMM", "abort, grinder"]);
        slowest.extend(aborts.map(|(time, what)| (*time, what, moment.name)));
        slowest.extend(tried.hold.map(|time| (time, "hold", moment.name)));
        assert!(tried.after_abort.is_empty(), "{tried:?}");
        *states.entry(tried.state).or_default() += 1;
        let mut take = |what: &str, took: &mut dyn Iterator<Item = Duration>| {
            let with = if ships.is_some() { ", with a plant" } else { "" };
            times.entry(format!("{what}{with}")).or_default().extend(took);
        };
        take("abort, on the wire", &mut tried.abort.iter().copied());
        take("abort, answered", &mut std::iter::once(tried.abort_answered));
        take("hold, on the wire", &mut tried.hold.into_iter());
        take("hold, answered", &mut tried.hold_answered.into_iter());
        take("resume, on the wire", &mut tried.resume.into_iter());
        take("resume, answered", &mut tried.resume_answered.into_iter());
    }
    drop(beside);
    println!("{tries} tries\n\n{:32}{:>6}{:>10}{:>10}{:>10}  ms", "", "n", "p50", "p99", "max");
    for (what, mut times) in times {
        times.sort_unstable();
        let at = |share: f64| times.get(((times.len() as f64 * share).ceil() as usize).saturating_sub(1));
        let ms = |share: f64| at(share).map_or(f64::NAN, |time| 1e3 * time.as_secs_f64());
        println!("{what:32}{:>6}{:>10.2}{:>10.2}{:>10.2}", times.len(), ms(0.5), ms(0.99), ms(1.0));
    }
    slowest.sort_unstable_by(|a, b| b.cmp(a));
    println!("\nslowest on the wire");
    for (time, what, moment) in slowest.iter().take(8) {
        println!("{:>8.2} ms  {what}, at: {moment}", 1e3 * time.as_secs_f64());
    }
    println!("\nstates after the first order");
    for (state, count) in states {
        println!("{count:>5}  {state}");
    }
}
