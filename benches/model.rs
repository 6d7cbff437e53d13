//! How long the model of the error takes: a batch of touches more, a whole measurement with its map and samples, a scan.
//!
//! ```text
//! cargo bench --bench model
//! ```

use divan::Bencher;
use divan::counter::ItemsCount;
use nalgebra::DMatrix;
use regrind::model::{Dense, Field, Hyper, Lattice, Observed, Priors, Sparse};

fn main() {
    divan::main();
}

const HYPER: Hyper = Hyper { field: Field { sigma_mm: 5e-3, range_mm: 30.0 }, scatter_mm: 3e-4 };

/// Points of a part of 102 x 62 mm with form, scatter, and the six motions of a part as effects.
fn measured(count: u32) -> Observed {
    let places: Vec<[f64; 2]> = (0..count)
        .map(|k| f64::from(k) + 0.5)
        .map(|k| [(0.754_877_666 * k).fract() * 102.0, (0.569_840_291 * k).fract() * 62.0])
        .collect();
    let shape = |[x, y]: [f64; 2]| 5e-3 * ((0.08 * x).sin() * (0.11 * y).cos() + 0.4 * (0.17 * x + 0.05 * y).sin());
    let scatter = |k: usize| 5e-4 * ((k as f64 * 12.9898).sin() * 43_758.545_3).fract();
    let deviations_mm = places.iter().enumerate().map(|(k, &place)| shape(place) + scatter(k)).collect();
    let row = |[x, y]: [f64; 2]| [0.02 * x, 0.03 * y, 1.0, y - 31.0, 51.0 - x, 1e-3 * x * y];
    let effects = DMatrix::from_fn(places.len(), 6, |r, c| row(places[r])[c]);
    Observed { places, deviations_mm, effects }
}

fn nodes(columns: u32, rows: u32) -> Vec<[f64; 2]> {
    let at = |k: u32| {
        [f64::from(k % columns) * 102.0 / f64::from(columns - 1), f64::from(k / columns) * 62.0 / f64::from(rows - 1)]
    };
    (0..columns * rows).map(at).collect()
}

/// What is told after 20 touches more, of 400: everything anew, the parameters kept.
#[divan::bench]
fn a_batch_after_400_points(bencher: Bencher) {
    let (all, map) = (measured(420), nodes(40, 25));
    bencher.bench(|| Dense::fit(&all, HYPER).unwrap().predict(&map));
}

#[divan::bench]
fn a_batch_after_400_points_by_the_grid(bencher: Bencher) {
    let (all, map) = (measured(420), nodes(40, 25));
    let lattice = Lattice::over(&all.places, HYPER.field.range_mm).unwrap();
    bencher.bench(|| Sparse::fit(&lattice, &all, HYPER).unwrap().predict(&map));
}

/// 1,800 points: motions, field, a map of 6,000 nodes with its sigma, 1,000 samples of it.
#[divan::bench(sample_count = 10)]
fn a_measurement_of_1800_points(bencher: Bencher) {
    let (all, map) = (measured(1800), nodes(100, 60));
    bencher.counter(ItemsCount::new(1000_u32)).bench(|| {
        let lattice = Lattice::over(&map, HYPER.field.range_mm).unwrap();
        let model = Sparse::fit(&lattice, &all, HYPER).unwrap();
        (model.predict(&map), model.samples(&map, 1000, 1).unwrap())
    });
}

#[divan::bench(sample_count = 5)]
fn a_scan_of_28476_points(bencher: Bencher) {
    let (all, map) = (measured(28_476), nodes(100, 60));
    bencher.bench(|| {
        let lattice = Lattice::over(&map, HYPER.field.range_mm).unwrap();
        let model = Sparse::fit(&lattice, &all, HYPER).unwrap();
        (model.predict(&map), model.samples(&map, 1000, 1).unwrap())
    });
}

/// What speaks for which parameters: 400 of the points.
#[divan::bench(sample_count = 5)]
fn the_parameters_of_1800_points(bencher: Bencher) {
    let all = measured(1800);
    bencher.bench(|| Hyper::of(&all, &Priors::of_size(102.0)).unwrap());
}
