//! Share of the repeatable error that one correction removes, and how close to the floor the cycles end, by the truth
//! of the world.
//!
//! Only a few worlds: `cargo run --release --example convergence` draws fifty for each recipe and prints the figures.

use rayon::prelude::*;
use regrind::compensation::GainRule;
use regrind::figures::statistics::rms;
use regrind_testcell::study::{After, Bench, RECIPES, Way};
use regrind_testutils::sample::seeds;

const PASSES: u16 = 3;

fn runs(way: Way, parts: usize) -> Vec<(String, Vec<Vec<After>>)> {
    let benches: Vec<Bench> = RECIPES.iter().map(|name| Bench::new(name)).collect();
    // Number of worlds of each recipe.
    let drawn = seeds(2);
    let each = (0..benches.len() as u64 * drawn).into_par_iter().map(|k| {
        let (bench, seed) = (&benches[(k / drawn) as usize], 1 + k % drawn);
        (format!("{}, seed {seed}", bench.name), bench.parts(seed, way, parts, PASSES))
    });
    each.collect()
}

#[test]
#[ignore = "worlds are drawn, for .ci/long"]
fn cycles_converge_to_repeatability() {
    let runs = runs(Way::Regrind(GainRule::Wavelength), 2);
    for (name, parts) in &runs {
        println!("{name}: {:.3?}", parts[0]);
        let (first, last) = (parts[0][0], parts[0][usize::from(PASSES) - 1]);
        assert!(last.rms_um < first.rms_um, "{name} ended worse than it began");
        let taken_back = first.repeatable_um / parts[0][1].repeatable_um;
        // The correction is made from one pass, and grinds in the random error of this pass.
        let limit_um = (first.repeatable_um / 5.0).max(2.0 * first.floor_um);
        assert!(parts[0][1].repeatable_um < limit_um, "{name}: one correction took back {taken_back} times");
    }
    let over = |part: usize, pass: usize| {
        let all = || runs.iter().map(move |(_, parts)| parts[part][pass]);
        rms(all().map(|a| a.rms_um)) / rms(all().map(|a| a.floor_um))
    };
    let taken_back = rms(runs.iter().map(|(_, parts)| parts[0][0].repeatable_um))
        / rms(runs.iter().map(|(_, parts)| parts[0][1].repeatable_um));
    println!(
        "taken back {taken_back:.1}; over the floor {:.2}, {:.2}; next part {:.2}",
        over(0, 1),
        over(0, 2),
        over(1, 0)
    );
    assert!(taken_back > 8.0, "{taken_back}");
    assert!(over(0, 2) < 1.4 && over(0, 2) < over(0, 1), "{} then {}", over(0, 1), over(0, 2));
    assert!(over(1, 0) < 1.5, "the second part began at {} of the floor", over(1, 0));
}
