//! How long the model of the error takes: a batch of touches more, a whole measurement with its map and samples, a scan.
//!
//! ```text
//! cargo bench --bench model
//! ```

use divan::Bencher;
use divan::counter::ItemsCount;
use nalgebra::DMatrix;
use regrind::model::{Dense, Field, Growing, Hyper, Lattice, Observed, Priors, Sparse};

fn main() {
    divan::main();
}

const HYPER: Hyper = Hyper { field: Field::new(5e-3, 30.0), scatter_mm: 3e-4, drift: 0.0 };

/// Points of a part of 102 x 62 mm with form, scatter, and the six motions of a part as effects.
fn measured(count: u32) -> Observed {
    let places: Vec<[f64; 2]> = (0..count)
        .map(|k| f64::from(k) + 0.5)
        .map(|k| [(0.754_877_666 * k).fract() * 102.0, (0.569_840_291 * k).fract() * 62.0])
        .collect();
    let shape = |[x, y]: [f64; 2]| 5e-3 * ((0.08 * x).sin() * (0.11 * y).cos() + 0.4 * (0.17 * x + 0.05 * y).sin());
    let scatter = |k: usize| 5e-4 * ((k as f64 * 12.9898).sin() * 43_758.545_3).fract();
    let deviations_mm = places.iter().enumerate().map(|(k, &place)| shape(place) + scatter(k)).collect();
    let effects = motions(&places);
    Observed { effects, ..Observed::without_effects(places, deviations_mm) }
}

/// What the six motions of a part that is bent both ways add at each place.
fn motions(places: &[[f64; 2]]) -> DMatrix<f64> {
    let row = |[x, y]: [f64; 2]| {
        let (x, y) = (x - 51.0, y - 31.0);
        let z = 0.004 * x * x - 0.005 * y * y + 4e-5 * x * x * x;
        let n = [-0.008 * x - 1.2e-4 * x * x, 0.01 * y, 1.0];
        let arm = [x / 50.0, y / 50.0, z / 50.0];
        let turn = |a: usize, b: usize| arm[a] * n[b] - arm[b] * n[a];
        [n[0], n[1], n[2], turn(1, 2), turn(2, 0), turn(0, 1)]
    };
    DMatrix::from_fn(places.len(), 6, |r, c| row(places[r])[c])
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

/// The same in place, beside 6,000 nodes: what is known of every one is brought up to date.
#[divan::bench]
fn a_batch_after_400_points_in_place(bencher: Bencher) {
    let (all, map) = (measured(420), nodes(100, 60));
    let only = |from: usize, until: usize| Observed {
        places: all.places[from..until].to_vec(),
        deviations_mm: all.deviations_mm[from..until].to_vec(),
        effects: all.effects.rows(from, until - from).into_owned(),
        stated: DMatrix::zeros(until - from, 0),
        path: Vec::new(),
    };
    let effects = motions(&map);
    let mut before = Growing::over(map, effects, HYPER).unwrap();
    before.tell(&only(0, 400)).unwrap();
    let batch = only(400, 420);
    bencher.with_inputs(|| before.clone()).bench_values(|mut model| {
        model.tell(&batch).unwrap();
        model
    });
}

#[divan::bench]
fn a_batch_after_400_points_by_the_grid(bencher: Bencher) {
    let (all, map) = (measured(420), nodes(40, 25));
    let lattice = Lattice::over(&all.places, &HYPER.field).unwrap();
    bencher.bench(|| Sparse::fit(&lattice, &all, HYPER).unwrap().predict(&map));
}

/// 1,800 points: motions, field, a map of 6,000 nodes with its sigma, 1,000 samples of it.
#[divan::bench(sample_count = 10)]
fn a_measurement_of_1800_points(bencher: Bencher) {
    let (all, map) = (measured(1800), nodes(100, 60));
    bencher.counter(ItemsCount::new(1000_u32)).bench(|| {
        let lattice = Lattice::over(&map, &HYPER.field).unwrap();
        let model = Sparse::fit(&lattice, &all, HYPER).unwrap();
        (model.predict(&map), model.samples(&map, 1000, 1).unwrap())
    });
}

#[divan::bench(sample_count = 5)]
fn a_scan_of_28476_points(bencher: Bencher) {
    let (all, map) = (measured(28_476), nodes(100, 60));
    bencher.bench(|| {
        let lattice = Lattice::over(&map, &HYPER.field).unwrap();
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

/// The same of points that were measured along a path, whose drift is searched too.
#[divan::bench(sample_count = 5)]
fn the_parameters_of_1800_points_along_a_path(bencher: Bencher) {
    let all = measured(1800);
    let all = Observed { path: (0..1800).map(f64::from).collect(), ..all };
    bencher.bench(|| Hyper::of(&all, &Priors::of_size(102.0)).unwrap());
}
