//! Time of the model of the form: one more batch of touches, a whole measurement, a scan.
//!
//! ```text
//! cargo bench --bench model
//! ```

use divan::Bencher;
use nalgebra::DMatrix;
use regrind::geometry::{Point, Pose};
use regrind::model::{DensePosterior, Field, Form, Hyperparameters, IncrementalPosterior, ModelInputs, Observations};
use regrind::registration::{Registration, RegistrationOptions, Start, register};
use regrind::surface::{Nominal, PlaneProjection};
use regrind_sim::form::FormError;
use regrind_sim::probe::{add_noise, centre};
use regrind_sim::shape::{FreeForm, Shape};

fn main() {
    divan::main();
}

const HYPER: Hyperparameters =
    Hyperparameters { field: Field::new(5e-3, 30.0), noise_sigma_mm: 3e-4, noise_autocorrelation: 0.0 };

/// Returns points of a part of 102 x 62 mm with form, noise, and the six motions of a part as effects.
fn measured(count: u32) -> Observations {
    let places: Vec<[f64; 2]> = (0..count)
        .map(|k| f64::from(k) + 0.5)
        .map(|k| [(0.754_877_666 * k).fract() * 102.0, (0.569_840_291 * k).fract() * 62.0])
        .collect();
    let shape = |[x, y]: [f64; 2]| 5e-3 * ((0.08 * x).sin() * (0.11 * y).cos() + 0.4 * (0.17 * x + 0.05 * y).sin());
    let scatter = |k: usize| 5e-4 * ((k as f64 * 12.9898).sin() * 43_758.545_3).fract();
    let deviations_mm = places.iter().enumerate().map(|(k, &place)| shape(place) + scatter(k)).collect();
    let effects = motions(&places);
    Observations { fixed_effects: effects, ..Observations::without_effects(places, deviations_mm) }
}

/// Returns the displacement at each place by each of the six motions of a part that is curved in both directions.
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

/// Measures the posterior after 20 more touches, in addition to 400: all recomputed, with the hyperparameters fixed.
#[divan::bench]
fn a_batch_after_400_points(bencher: Bencher) {
    let (all, map) = (measured(420), nodes(40, 25));
    bencher.bench(|| DensePosterior::fit(&all, HYPER).unwrap().predict(&map));
}

/// Measures the same update in place, with 6,000 nodes: the posterior of every node is updated.
#[divan::bench]
fn a_batch_after_400_points_in_place(bencher: Bencher) {
    let (all, map) = (measured(420), nodes(100, 60));
    let only = |from: usize, until: usize| Observations {
        places: all.places[from..until].to_vec(),
        deviations_mm: all.deviations_mm[from..until].to_vec(),
        fixed_effects: all.fixed_effects.rows(from, until - from).into_owned(),
        random_effects: DMatrix::zeros(until - from, 0),
        path: Vec::new(),
    };
    let effects = motions(&map);
    let mut before = IncrementalPosterior::at_places(&map, &effects, &DMatrix::zeros(map.len(), 0), HYPER).unwrap();
    before.update(&only(0, 400)).unwrap();
    let batch = only(400, 420);
    bencher.with_inputs(|| before.clone()).bench_values(|mut model| {
        model.update(&batch).unwrap();
        model
    });
}

/// Measures the complete evaluation of a measurement: fields fitted over the pattern, 1,000 forms drawn from them,
/// figures, slopes and budget.
#[divan::bench(sample_count = 10)]
fn a_measurement_of_1800_points(bencher: Bencher) {
    let found = registered(52, 35);
    bencher.bench(|| Form::estimate(&found, &ModelInputs::default()).unwrap());
}

#[divan::bench(sample_count = 5)]
fn a_scan_of_28476_points(bencher: Bencher) {
    let found = registered(226, 126);
    bencher.bench(|| Form::estimate(&found, &ModelInputs::default()).unwrap());
}

/// Returns the registration of a free form with an error of 1 um, touched in rows.
fn registered(columns: usize, rows: usize) -> Registration {
    const RADIUS_MM: f64 = 1.5;
    let shape = FreeForm::default();
    let points = |of: Vec<[f64; 3]>| of.into_iter().map(Point::from).collect::<Vec<_>>();
    let nominal = Nominal::from_points(points(shape.grid(66.0, 46.0, 265, 185)), PlaneProjection::Auto).unwrap();
    let mut rng = regrind_sim::rng(1);
    let form = FormError::with_rms(&mut rng, 20.0, 1e-3);
    let at = |k: usize, n: usize, size_mm: f64| size_mm * (k as f64 / (n - 1) as f64 - 0.5);
    let place = |k: usize| [at(k % columns, columns, 60.0), at(k / columns, rows, 40.0)];
    let touch = |k: usize| centre(&shape, &form, RADIUS_MM, place(k)[0], place(k)[1]);
    let mut centres: Vec<[f64; 3]> = (0..columns * rows).map(touch).collect();
    add_noise(&mut rng, &mut centres, 3e-4);
    let options = RegistrationOptions { start: Start::Pose(Pose::identity()), ..RegistrationOptions::new(RADIUS_MM) };
    register(&nominal, &points(centres), &options).unwrap()
}

/// Measures the search for hyperparameters: all fields are fitted to the points, and the mean over the plausible ones
/// is returned.
#[divan::bench(sample_count = 5)]
fn the_parameters_of_1800_points(bencher: Bencher) {
    let all = measured(1800);
    bencher.bench(|| Hyperparameters::estimate(&all, None).unwrap());
}

/// Measures the same for points that were measured along a path, for which the drift is searched too.
#[divan::bench(sample_count = 5)]
fn the_parameters_of_1800_points_along_a_path(bencher: Bencher) {
    let all = measured(1800);
    let all = Observations { path: (0..1800).map(f64::from).collect(), ..all };
    bencher.bench(|| Hyperparameters::estimate(&all, None).unwrap());
}
