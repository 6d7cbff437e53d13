//! Parameters of the machine in many worlds: how often they are told within their uncertainty, and what taking them back saves.

#[path = "../tests/run/study.rs"]
mod study;

use rayon::prelude::*;
use study::told_apart::{Compared, corrections};
use study::{After, Bench};

fn main() {
    let number = |k: usize, otherwise: u64| std::env::args().nth(k).map_or(otherwise, |n| n.parse().expect("a number"));
    let (worlds, first) = (number(1, 200), number(2, 1));
    let only = std::env::args().nth(3);
    for name in ["freeform-mirror", "off-axis-asphere", "biconic", "shallow-wave"] {
        if only.as_deref().is_some_and(|only| only != name) {
            continue;
        }
        for held in [[false; 6], [true, true, true, false, false, false], [false, false, false, true, true, false]] {
            let bench = Bench::new(name).held(held);
            let made: Vec<Compared> =
                (first..first + worlds).into_par_iter().map(|seed| bench.told_apart(seed, 4)).collect();
            println!("{name} held {held:?}");
            let kinds: Vec<_> = made[0].told.iter().map(|t| t.kind).collect();
            for kind in kinds {
                let told: Vec<_> = made.iter().flat_map(|w| &w.told).filter(|t| t.kind == kind).collect();
                let n = told.len() as f64;
                let within = told.iter().filter(|t| t.off.abs() <= 1.0).count() as f64 / n;
                let expanded = told.iter().map(|t| t.expanded).sum::<f64>() / n;
                let z = (told.iter().map(|t| 4.0 * t.off * t.off).sum::<f64>() / n).sqrt();
                let bias = told.iter().map(|t| 2.0 * t.off).sum::<f64>() / n;
                let taken = told.iter().filter(|t| t.taken != 0.0).count();
                let beyond = told.iter().filter(|t| t.is_beyond).count();
                let off = (told.iter().map(|t| t.truth * t.truth).sum::<f64>() / n).sqrt();
                println!(
                    "  {kind:?}: within {:.1} %, U {expanded:.2}, z rms {z:.2} mean {bias:.2}, truth rms {off:.1}, taken {taken}, beyond {beyond}",
                    100.0 * within
                );
            }
            let ratio = |of: fn(&Compared) -> &Vec<After>, pass: usize| {
                let mean = |f: fn(&After) -> f64| made.iter().map(|w| f(&of(w)[pass]).powi(2)).sum::<f64>().sqrt();
                mean(|a| a.rms_um) / mean(|a| a.floor_um)
            };
            for (what, of) in [("with", (|w| &w.with) as fn(&Compared) -> &Vec<After>), ("alone", |w| &w.alone)] {
                let ratios: Vec<String> = (0..4).map(|p| format!("{:.2}", ratio(of, p))).collect();
                let c: f64 = made.iter().map(|w| corrections(of(w)) as f64).sum::<f64>() / made.len() as f64;
                println!("  {what}: {} corrections {c:.2}", ratios.join(" "));
            }
            let worse = made.iter().filter(|w| corrections(&w.with) > corrections(&w.alone)).count();
            let better = made.iter().filter(|w| corrections(&w.with) < corrections(&w.alone)).count();
            let worse1 = made.iter().filter(|w| w.with[1].rms_um > 1.02 * w.alone[1].rms_um).count();
            println!("  fewer in {better}, more in {worse}; worse after the first correction in {worse1}");
        }
    }
}
