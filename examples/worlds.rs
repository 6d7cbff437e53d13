//! Cost of making a part in many worlds: touches, hours and results, with the whole pattern and with chosen touches.
//!
//! ```text
//! cargo run --release --example worlds [WORLDS [FIRST [LIMITS [RECIPE]]]]
//! ```
//! The program runs WORLDS (50) worlds for each recipe that ships with one, from seed FIRST (1) on, with limits that
//! are LIMITS (1.0) times those of the recipe. Every part is made twice, from the same blank on the same machines.

use rayon::prelude::*;
use regrind_testcell::study::made_part::{Made, Measured};
use regrind_testcell::study::{Bench, RECIPES};

fn main() {
    let number = |k: usize, otherwise: u64| std::env::args().nth(k).map_or(otherwise, |n| n.parse().expect("a number"));
    let (worlds, first) = (number(1, 50), number(2, 1));
    let limits: f64 = std::env::args().nth(3).map_or(1.0, |times| times.parse().expect("a number"));
    let only = std::env::args().nth(4);
    println!(
        "| recipe | touches a part | passes | touching, h | grinding, h | accepted | wrongly | true RMS, um | true PV, um |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    for name in RECIPES.into_iter().filter(|name| only.as_deref().is_none_or(|only| only == *name)) {
        let bench = Bench::as_shipped(name).with_limits(limits);
        for measured in [Measured::Whole, Measured::Chosen] {
            let parts: Vec<Made> =
                (first..first + worlds).into_par_iter().map(|seed| bench.make(seed, measured)).collect();
            if worlds <= 4 {
                parts.iter().for_each(|part| eprintln!("{name} {measured:?}: {part:?}"));
            }
            let mean = |of: &dyn Fn(&Made) -> f64| parts.iter().map(of).sum::<f64>() / parts.len() as f64;
            let accepted: Vec<&Made> = parts.iter().filter(|part| part.accepted).collect();
            let of_accepted =
                |k: usize| accepted.iter().map(|part| part.truth_um[k]).sum::<f64>() / accepted.len().max(1) as f64;
            let wrongly = accepted.iter().filter(|part| !part.conforms).count();
            println!(
                "| {name}, {} | {:.0} | {:.2} | {:.2} | {:.2} | {} of {} | {wrongly} | {:.3} | {:.2} |",
                if measured == Measured::Whole { "whole pattern" } else { "chosen" },
                mean(&|part| part.touches as f64),
                mean(&|part| f64::from(part.passes)),
                mean(&|part| part.touching_s / 3600.0),
                mean(&|part| part.grinding_s / 3600.0),
                accepted.len(),
                parts.len(),
                of_accepted(0),
                of_accepted(1),
            );
        }
    }
}
