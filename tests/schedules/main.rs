//! Whole parts under every fault that a seed can draw, in simulated time. The production cell, drive, stations, link
//! and record run unchanged on one thread, whose clock jumps from one event to the next.
//!
//! ```text
//!  person --> drive --> stations --> link --> net --> sim's servers --> machines   what they did --+
//!               |                              ^                                                   +--> checker
//!               +--> ledger --> journal        late, lost, twice, cut, dead        what is on record +
//! ```
//!
//! A failing seed prints the command that repeats it. Seeds that once failed are listed in [`KEPT`] and always run.

mod checker;
mod cue;
mod happening;
mod ledger;
mod life;
mod machines;
mod net;
mod outside;
mod part;
mod person;
mod programs;
mod schedule;
mod touches;
mod wire;

use std::panic::AssertUnwindSafe;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use cue::{Cue, When};
use schedule::{Act, FORGETFUL, FULL_DISK, LIARS, OTHER_WIRES, Schedule, Tally};

/// Seeds that detect a missing guard that few other seeds detect. A station checks again that the loop is alive (134).
/// A command that waited for a poll that found the link lost is not sent: START (163) and RESUME (181). No command
/// waits in the queue when a query is sent (264). An abort does not wait for a machine that does not move (585).
/// A cell that is being held sends HOLD if the disk fails as the link comes back (19,775).
const KEPT: &[u64] = &[134, 163, 181, 264, 585, 19_775];

/// Seeds of the same kind for machines with a protocol other than Modbus. The connection to linuxcncrsh was lost during
/// the query for the result of a START, and the link reported it as never established (1,000,075). A CMM moves on while
/// the program restarts and cannot connect to it, because it ignores the first AbortE (1,001,546).
const KEPT_BY_OTHER_WIRES: &[u64] = &[1_000_075, 1_001_546];

/// Number of seeds that a merge has time for.
const SAMPLE: u64 = 16;
const SAMPLE_BY_OTHER_WIRES: u64 = 10;

const SAMPLE_OF_FORGETFUL: u64 = 10;
const SAMPLE_OF_FULL_DISKS: u64 = 10;
const KEPT_OF_FULL_DISKS: &[u64] = &[3_000_338];
/// One seed for each fifth register of the two blocks; more draw each register.
const SAMPLE_OF_LIARS: u64 = 104;
const STRIDE_OF_LIARS: usize = 5;

/// Distance, in effects, between the points at which the program dies once.
const STRIDE: usize = 499;

/// Runs schedules on all processors; reports which seed broke which promise.
fn run_all(schedules: &[Schedule]) -> Tally {
    let next = AtomicU64::new(0);
    let workers = std::thread::available_parallelism().map_or(1, usize::from);
    let tallies: Vec<(Tally, Vec<String>)> = std::thread::scope(|scope| {
        let work = || {
            let (mut all, mut broken) = (Tally::default(), Vec::new());
            while let Some(schedule) = schedules.get(next.fetch_add(1, Ordering::Relaxed) as usize) {
                match std::panic::catch_unwind(AssertUnwindSafe(|| schedule.run())) {
                    Ok(Ok(tally)) => all.add(&tally),
                    Ok(Err(what)) => broken.push(format!("{schedule}: {what}")),
                    Err(_) => broken.push(format!("{schedule}: it panics")),
                }
            }
            (all, broken)
        };
        let workers: Vec<_> = (0..workers).map(|_| scope.spawn(work)).collect();
        workers.into_iter().map(|worker| worker.join().unwrap()).collect()
    });
    let mut all = Tally::default();
    let mut broken = Vec::new();
    for (tally, said) in tallies {
        all.add(&tally);
        broken.extend(said);
    }
    let again = "each is repeated by REGRIND_SCHEDULE=SEED, with REGRIND_DEATHS=A,B where it dies alone: \
                 cargo test --test schedules -- --nocapture --exact one_schedule";
    assert!(
        broken.is_empty(),
        "{} of {} broke a promise; {again}\n{}",
        broken.len(),
        schedules.len(),
        broken.join("\n")
    );
    all
}

fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|text| text.parse().unwrap_or_else(|_| panic!("{name} is no number")))
}

/// Runs the schedules of some seeds, and fails at the first broken promise.
fn hold_their_promises(seeds: impl Iterator<Item = u64>) {
    let schedules: Vec<Schedule> = seeds.map(Schedule::drawn).collect();
    let began = std::time::Instant::now();
    let tally = run_all(&schedules);
    println!("{} schedules in {:.1} s: {tally}", schedules.len(), began.elapsed().as_secs_f64());
}

#[test]
fn schedules_keep_promises() {
    let seeds = KEPT.iter().copied().chain(0..number("REGRIND_SCHEDULES").unwrap_or(SAMPLE));
    hold_their_promises(seeds);
}

#[test]
fn schedules_on_other_wires() {
    let seeds = KEPT_BY_OTHER_WIRES.iter().copied();
    let seeds = seeds.chain((0..number("REGRIND_SCHEDULES").unwrap_or(SAMPLE_BY_OTHER_WIRES)).map(|k| OTHER_WIRES + k));
    hold_their_promises(seeds);
}

/// Checks machines that restart with their old boot id and report that their job never began.
#[test]
fn schedules_with_forgotten_job() {
    let seeds = (0..number("REGRIND_SCHEDULES").unwrap_or(SAMPLE_OF_FORGETFUL)).map(|k| FORGETFUL + k);
    hold_their_promises(seeds);
}

/// Checks a disk that is temporarily full: the cell is held in the meantime, does not wait for an answer to a request
/// that it has not sent, and continues afterwards.
#[test]
fn schedules_with_full_disk() {
    // A stop that overtook the preparation of a cycle was not recognized as done.
    let seeds = KEPT_OF_FULL_DISKS.iter().copied();
    let seeds = seeds.chain((0..number("REGRIND_SCHEDULES").unwrap_or(SAMPLE_OF_FULL_DISKS)).map(|k| FULL_DISK + k));
    hold_their_promises(seeds);
}

/// Checks machines that report false values, in turn in each register of the status and of the header of a result. No
/// START is intended again for a job that was seen to begin, no job begins without a record, and the run finishes.
#[test]
fn schedules_with_false_status() {
    let stride = if number("REGRIND_SCHEDULES").is_some() { 1 } else { STRIDE_OF_LIARS };
    let seeds = (0..number("REGRIND_SCHEDULES").unwrap_or(SAMPLE_OF_LIARS)).map(|k| LIARS + k).step_by(stride);
    hold_their_promises(seeds);
}

/// Kills the program once before each of its effects on the world, and before some pairs of them.
#[test]
fn death_before_effect_keeps_promises() {
    let stride = if number("REGRIND_SCHEDULES").is_some() { 1 } else { STRIDE };
    let began = std::time::Instant::now();
    let effects = Schedule::with_deaths(1, Vec::new()).effects();
    let single = (1..=effects).step_by(stride).map(|effect| vec![effect]);
    let pairs = (1..=effects).step_by(11 * stride).map(|effect| vec![effect, 1 + effect * 7 % 90]);
    let schedules: Vec<Schedule> = single.chain(pairs).map(|deaths| Schedule::with_deaths(1, deaths)).collect();
    let tally = run_all(&schedules);
    println!("{effects} effects; {} schedules in {:.1} s: {tally}", schedules.len(), began.elapsed().as_secs_f64());
}

/// Lets the computer sleep once, at moments of all kinds: the run goes on afterwards, and makes all of its passes.
#[test]
fn suspended_computer_continues() {
    let cues = [Cue::Loaded, Cue::Prepared, Cue::StartOnRecord, Cue::Begins, Cue::Complete];
    let moments = cues.into_iter().flat_map(|cue| [1, 3].map(|nth| (cue, nth)));
    let schedule = |(i, (cue, nth)): (usize, (Cue, u32))| {
        let pause = Duration::from_millis([0, 30, 200, 700][i % 4]);
        let sleep = Act::Suspend { lasts: Duration::from_millis(2100 + 900 * (i as u64 % 5)) };
        Schedule { acts: vec![(When::After(cue, nth, pause), sleep)], ..Schedule::with_deaths(1, Vec::new()) }
    };
    let schedules: Vec<Schedule> = moments.enumerate().map(schedule).collect();
    let [undisturbed, disturbed] = [&[Schedule::with_deaths(1, Vec::new())][..], &schedules].map(run_all);
    assert_eq!(disturbed.passes, undisturbed.passes * schedules.len() as u64, "{disturbed}");
}

#[test]
fn one_schedule() {
    let seed = number("REGRIND_SCHEDULE").unwrap_or(0);
    let deaths = std::env::var("REGRIND_DEATHS").ok();
    let deaths = deaths.map(|text| text.split(',').map(|number| number.trim().parse().unwrap()).collect());
    let schedule = deaths.map_or_else(|| Schedule::drawn(seed), |deaths| Schedule::with_deaths(seed, deaths));
    println!("{schedule:?}");
    schedule.traced().iter().for_each(|line| println!("{line}"));
    match schedule.run() {
        Ok(tally) => println!("{tally}"),
        Err(what) => panic!("seed {seed}: {what}"),
    }
}

#[test]
fn seed_repeats_schedule() {
    for seed in (0..4).chain(OTHER_WIRES..OTHER_WIRES + 4) {
        let [first, second] = [(); 2].map(|()| Schedule::drawn(seed).traced());
        assert!(first.len() > 50, "seed {seed}: {} lines", first.len());
        let differs = first.iter().zip(&second).position(|(a, b)| a != b);
        if let Some(k) = differs {
            panic!("seed {seed} differs at line {k}:\n{}\n{}", first[k], second[k]);
        }
        assert_eq!(first.len(), second.len(), "seed {seed}");
    }
}
