//! Transfer of learning between machines: how near the floor the first pass of a second machine comes with the
//! knowledge of a first one, and whether that knowledge ever makes it worse.
//!
//! ```text
//! cargo run --release --example shared [WORLDS [FIRST [PARTS [DIFFER]]]]
//! ```
//! The program draws WORLDS (200) worlds from number FIRST (1) on for each way in which machines differ, in turn for
//! each recipe that ships with a truth. Both machines have experience with one other recipe, the next of the list. The
//! first machine has made PARTS (2) of the recipe. DIFFER selects the lines whose names begin with it.

use rayon::prelude::*;
use regrind_testcell::study::transfer::{Differ, Pair, TAUGHT_BY, TransferResult};
use regrind_testcell::study::{After, Bench, RECIPES};

/// Maximum ratio of the first pass to the floor.
const MAX: f64 = 1.3;

fn main() {
    let number = |k: usize, otherwise: u64| std::env::args().nth(k).map_or(otherwise, |n| n.parse().expect("a number"));
    let (worlds, first) = (number(1, 200), number(2, 1));
    let parts = number(3, TAUGHT_BY.into()) as u32;
    let wanted = std::env::args().nth(4).unwrap_or_default();
    let benches: Vec<Bench> = RECIPES.iter().map(|name| Bench::new(name).commissioned()).collect();
    let by = |share, waviness_um| Differ::By { share, waviness_um };
    let ways = [
        ("1 %, 0.05 um", by(0.01, 0.05)),
        ("2 %, 0.1 um", by(0.02, 0.1)),
        ("5 %, 0.2 um", by(0.05, 0.2)),
        ("10 %, 0.8 um", by(0.1, 0.8)),
        ("unrelated", Differ::Unrelated),
    ];
    println!(
        "rms of the true error after the first pass over that of what it added by itself; {worlds} worlds for each line\n"
    );
    println!(
        "machines differ by    all  apart  median    mean   95 %  <= 1.3 | without | bands differ | with over without, pass by pass"
    );
    for (name, differ) in ways.into_iter().filter(|(name, _)| name.starts_with(&wanted)) {
        let world = |seed: u64| {
            let k = seed as usize % benches.len();
            Pair { taught: &benches[k], in_common: &benches[(k + 1) % benches.len()] }.world(seed, differ, parts, 3)
        };
        let all: Vec<TransferResult> = (first..first + worlds).into_par_iter().map(world).collect();
        print_line(name, &all);
        for (k, bench) in benches.iter().enumerate() {
            let of = all.iter().zip(first..).filter(|(_, seed)| *seed as usize % benches.len() == k);
            print_line(&format!("  {}", bench.name), &of.map(|(of, _)| of.clone()).collect::<Vec<_>>());
        }
    }
}

fn ratio(after: &After) -> f64 {
    after.rms_um / after.floor_um
}

fn print_line(name: &str, all: &[TransferResult]) {
    let sorted = |of: &dyn Fn(&TransferResult) -> f64| {
        let mut values: Vec<f64> = all.iter().map(of).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let n = all.len();
    if n == 0 {
        return;
    }
    let with = sorted(&|of| ratio(&of.with[0]));
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let at = |values: &[f64], share: f64| values[((share * n as f64) as usize).min(n - 1)];
    let near = with.iter().filter(|ratio| **ratio <= MAX).count();
    let (bands, differ) = (mean(&sorted(&|of| of.bands as f64)), at(&sorted(&|of| of.differ), 0.5));
    print!(
        "{name:18}{:>7.2}{:>7.2}{:>8.2}{:>8.2}{:>7.2}{:>6.0} % |{:>8.2} |{bands:>6.1}{:>7.0} % |",
        together(all, |of| &of.with[0]),
        apart(all),
        at(&with, 0.5),
        mean(&with),
        at(&with, 0.95),
        100.0 * near as f64 / n as f64,
        together(all, |of| &of.without[0]),
        100.0 * differ
    );
    for pass in 0..all[0].with.len() {
        let against = sorted(&|of| of.with[pass].rms_um / of.without[pass].rms_um);
        let worse = against.iter().filter(|ratio| **ratio > 1.0).count();
        let all_together = together(all, |of| &of.with[pass]) / together(all, |of| &of.without[pass]);
        print!("  {all_together:.2} ({worse} worse, by {:.2} at most)", against[n - 1]);
    }
    println!();
}

/// Returns the root mean square over all worlds, divided by that of the floor.
fn together(all: &[TransferResult], after: impl Fn(&TransferResult) -> &After) -> f64 {
    let sum = |of: fn(&After) -> f64| all.iter().map(|world| of(after(world)).powi(2)).sum::<f64>();
    (sum(|a| a.rms_um) / sum(|a| a.floor_um)).sqrt()
}

/// Returns the ratio that the first pass would have if everything about the first machine were known and used for the
/// second.
fn apart(all: &[TransferResult]) -> f64 {
    let floor2: f64 = all.iter().map(|world| world.with[0].floor_um.powi(2)).sum();
    let apart2: f64 = all.iter().map(|world| world.apart_um.powi(2)).sum();
    (1.0 + apart2 / floor2).sqrt()
}
