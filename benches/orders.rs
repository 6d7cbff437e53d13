//! How long an order from another terminal takes to the wire: HOLD, RESUME and ABORT at every phase, 200 tries.
//!
//! ```text
//! cargo bench --bench orders [TRIES]
//! ```
//! The time runs from before the order is written to the control socket to the command at the simulated machine.

#[path = "../tests/common/keep.rs"]
mod keep;
#[path = "../tests/common/rig.rs"]
mod rig;
#[path = "../tests/common/tries.rs"]
mod tries;

use std::collections::BTreeMap;
use std::time::Duration;

use rig::Rig;
use tries::{MOMENTS, attempt};

fn main() {
    // Cargo adds options of its own.
    let tries = std::env::args().skip(1).find_map(|argument| argument.parse().ok()).unwrap_or(200);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    runtime.block_on(measure(tries));
}

async fn measure(tries: usize) {
    let mut rig = Rig::new(rig::small(12, 8, 5000.0)).await;
    let mut times: BTreeMap<&str, Vec<Duration>> = BTreeMap::new();
    let mut states: BTreeMap<String, usize> = BTreeMap::new();
    let mut slowest: Vec<(Duration, &str, &str)> = Vec::new();
    for k in 0..tries {
        let moment = &MOMENTS[k % MOMENTS.len()];
        let (tried, _) = attempt(&mut rig, moment, (k / MOMENTS.len()).is_multiple_of(2)).await;
        let aborts = tried.abort.iter().zip(["abort, CMM", "abort, grinder"]);
        slowest.extend(aborts.map(|(time, what)| (*time, what, moment.name)));
        slowest.extend(tried.hold.map(|time| (time, "hold", moment.name)));
        assert!(tried.after_abort.is_empty(), "{tried:?}");
        *states.entry(tried.state).or_default() += 1;
        times.entry("abort, on the wire").or_default().extend(&tried.abort);
        times.entry("abort, answered").or_default().push(tried.abort_answered);
        times.entry("hold, on the wire").or_default().extend(tried.hold);
        times.entry("hold, answered").or_default().extend(tried.hold_answered);
        times.entry("resume, on the wire").or_default().extend(tried.resume);
        times.entry("resume, answered").or_default().extend(tried.resume_answered);
    }
    println!("{tries} tries\n\n{:22}{:>6}{:>10}{:>10}{:>10}  ms", "", "n", "p50", "p99", "max");
    for (what, mut times) in times {
        times.sort_unstable();
        let at = |share: f64| times.get(((times.len() as f64 * share).ceil() as usize).saturating_sub(1));
        let ms = |share: f64| at(share).map_or(f64::NAN, |time| 1e3 * time.as_secs_f64());
        println!("{what:22}{:>6}{:>10.2}{:>10.2}{:>10.2}", times.len(), ms(0.5), ms(0.99), ms(1.0));
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
