//! Benefit of one machine's learned state for a second machine's first part of the same recipe: a few of the worlds of
//! `examples/shared.rs`.

use rayon::prelude::*;
use regrind_testcell::study::transfer::{Differ, Pair, TAUGHT_BY, TransferResult};
use regrind_testcell::study::{After, Bench, RECIPES};

/// Computes one world of each recipe.
fn worlds(differ: Differ) -> Vec<TransferResult> {
    let benches: Vec<Bench> = RECIPES.iter().map(|name| Bench::new(name).commissioned()).collect();
    let pair = |k: usize| Pair { taught: &benches[k], in_common: &benches[(k + 1) % benches.len()] };
    (0..benches.len()).into_par_iter().map(|k| pair(k).world(k as u64 + 1, differ, TAUGHT_BY, 2)).collect()
}

/// Returns the root mean square error over all worlds, divided by the RMS of what the passes add by themselves.
fn together(worlds: &[TransferResult], after: impl Fn(&TransferResult) -> After) -> f64 {
    let [rms, floor] =
        worlds.iter().map(after).fold([0.0; 2], |[rms, floor], a| [rms + a.rms_um.powi(2), floor + a.floor_um.powi(2)]);
    (rms / floor).sqrt()
}

#[test]
fn shared_learning_reaches_floor() {
    let worlds = worlds(Differ::By { share: 0.02, waviness_um: 0.1 });
    let [with, without] = [together(&worlds, |of| of.with[0]), together(&worlds, |of| of.without[0])];
    assert!(with < 1.4 && without > 5.0, "{with} times the floor with what was taught, {without} without");
    assert!(worlds.iter().all(|of| of.with[0].rms_um < 0.5 * of.without[0].rms_um));
    let [with, without] = [together(&worlds, |of| of.with[1]), together(&worlds, |of| of.without[1])];
    assert!(with < 1.02 * without, "after the second pass {with} and {without}");
}

#[test]
#[ignore = "worlds are drawn, for .ci/long"]
fn unrelated_machine_does_no_harm() {
    let worlds = worlds(Differ::Unrelated);
    for of in &worlds {
        assert!(of.with[0].rms_um < 1.02 * of.without[0].rms_um, "{of:?}");
    }
    let [with, without] = [together(&worlds, |of| of.with[1]), together(&worlds, |of| of.without[1])];
    assert!(with < 1.1 * without, "after the second pass {with} and {without}");
}
