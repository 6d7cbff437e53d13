//! Convergence of the cycles to the repeatability floor of the grinder: how fast and how far, by gain, for every
//! recipe.
//!
//! ```text
//! cargo run --release --example convergence [SEEDS [PASSES [WAY]]]
//! ```
//! The program draws SEEDS (50) worlds for each recipe that ships with a truth, and grinds PASSES (4) passes in each.
//! Everything between the surfaces is as in a run: a ball that touches the true surface, registration, map, correction.
//! Only the communication with the machines is left out. WAY selects the lines whose names begin with it. The figure is
//! written to `target/convergence/convergence.svg`.

use std::fs;

use rayon::prelude::*;
use regrind::compensation::GainRule;
use regrind::report::{Axis, Plot, Scale, Series};
use regrind_testcell::study::{After, Bench, RECIPES, Way};

fn main() {
    let number = |k: usize, otherwise: u64| std::env::args().nth(k).map_or(otherwise, |n| n.parse().expect("a number"));
    let (seeds, passes) = (number(1, 50), number(2, 4) as u16);
    let benches: Vec<Bench> = RECIPES.iter().map(|name| Bench::new(name)).collect();
    let ways = [
        ("by wavelength", Way::Regrind(GainRule::Wavelength)),
        ("adaptive", Way::Regrind(GainRule::Adaptive)),
        ("fixed 0.6", Way::Regrind(GainRule::Fixed(0.6))),
        ("fixed 0.8", Way::Regrind(GainRule::Fixed(0.8))),
        ("fixed 1.0", Way::Regrind(GainRule::Fixed(1.0))),
        ("fixed 1.2", Way::Regrind(GainRule::Fixed(1.2))),
        ("subtract the map", Way::Plain),
    ];
    println!(
        "rms of the true error over that of what the passes added by themselves; {seeds} worlds for each of {} recipes\n",
        benches.len()
    );
    print!("{:18}", "pass");
    (1..=passes).for_each(|pass| print!("{pass:>8}"));
    println!("{:>14}{:>14}", "worst of all", "taken back");
    let mut series = Vec::new();
    let wanted = std::env::args().nth(3).unwrap_or_default();
    for (name, way) in ways.into_iter().filter(|(name, _)| name.starts_with(&wanted)) {
        let parts = if name == "by wavelength" { 2 } else { 1 };
        let runs: Vec<Vec<Vec<After>>> = (0..benches.len() as u64 * seeds)
            .into_par_iter()
            .map(|k| benches[(k / seeds) as usize].parts(1 + k % seeds, way, parts, passes))
            .collect();
        let ratios = ratios(&runs, 0);
        print!("{name:18}");
        ratios.iter().for_each(|ratio| print!("{ratio:>8.2}"));
        println!("{:>14.2}{:>14.1}", worst_end(&runs), taken_back(&runs).0);
        if name == "by wavelength" {
            tell_more(&benches, seeds as usize, &runs);
        }
        let points = ratios.iter().enumerate().map(|(k, ratio)| [(k + 1) as f64, *ratio]).collect();
        series.push(Series { name: name.to_owned(), points });
    }
    fs::create_dir_all("target/convergence").expect("a folder below target");
    let axis = |label: &str, scale| Axis { label: label.to_owned(), scale };
    let plot = Plot {
        title: "Cycles to the floor (SIMULATION)".into(),
        x: axis("pass", Scale::Linear),
        y: axis("true rms over that of what a pass adds by itself", Scale::Log),
        series,
    };
    plot.save_svg("target/convergence/convergence.svg".as_ref()).expect("the figure can be drawn and saved");
}

/// Returns, pass by pass, the root mean square over all runs of a part, divided by that of the floor.
fn ratios(runs: &[Vec<Vec<After>>], part: usize) -> Vec<f64> {
    let mean = |pass: usize, of: fn(&After) -> f64| {
        (runs.iter().map(|run| of(&run[part][pass]).powi(2)).sum::<f64>() / runs.len() as f64).sqrt()
    };
    (0..runs[0][part].len()).map(|pass| mean(pass, |a| a.rms_um) / mean(pass, |a| a.floor_um)).collect()
}

/// Returns the largest ratio of the error at the end of a run to the error at its beginning. Above 1, a run ended worse
/// than it began.
fn worst_end(runs: &[Vec<Vec<After>>]) -> f64 {
    let ends = runs.iter().map(|run| run[0].last().expect("passes").rms_um / run[0][0].rms_um);
    ends.fold(0.0, f64::max)
}

/// Returns the factor by which one correction lowers the reproducible error: over all runs together, and in the worst
/// run.
fn taken_back(runs: &[Vec<Vec<After>>]) -> (f64, f64) {
    let sum = |pass: usize| runs.iter().map(|run| run[0][pass].repeatable_um.powi(2)).sum::<f64>();
    let each = runs.iter().map(|run| run[0][0].repeatable_um / run[0][1].repeatable_um);
    ((sum(0) / sum(1)).sqrt(), each.fold(f64::INFINITY, f64::min))
}

fn tell_more(benches: &[Bench], seeds: usize, runs: &[Vec<Vec<After>>]) {
    for (bench, runs) in benches.iter().zip(runs.chunks(seeds)) {
        let (all, worst) = taken_back(runs);
        let list = |ratios: Vec<f64>| ratios.iter().map(|r| format!("{r:.2}")).collect::<Vec<_>>().join(" ");
        println!(
            "  {:16} {}; one correction takes back {all:.1} (worst {worst:.1}) times; the second part {}",
            bench.name,
            list(ratios(runs, 0)),
            list(ratios(runs, 1))
        );
    }
    let told: Vec<f64> = runs
        .iter()
        .flat_map(|run| &run[0])
        .filter_map(|a| a.forecast_um)
        .map(|[rms, sigma, seen]| (seen - rms) / sigma)
        .collect();
    let within = |k: f64| told.iter().filter(|z| z.abs() <= k).count() as f64 / told.len() as f64;
    println!(
        "  forecasts: {:.0} % within one, {:.0} % within two of their standard deviations",
        100.0 * within(1.0),
        100.0 * within(2.0)
    );
}
