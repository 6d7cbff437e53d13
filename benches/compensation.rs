//! Time from deviations to an error map, stage by stage, in one process and without reading a file.
//!
//! `cargo bench --bench compensation` runs all; a name after `--` selects some. The part is the free form of the trials
//! with 28,476 measured points over 100 x 60 mm, ground to a few micrometres, with 0.3 um of noise and 1 % of spikes.
//! The cut-off is 5 mm.

use std::sync::LazyLock;

use divan::{Bencher, black_box};
use rand::RngExt;
use regrind::compensation::{
    Correction, CorrectionLimits, GainRule, LearningState, MapOptions, ParameterOptions, PassObservation, Smoothing,
    SurfacePoint, error_map, estimate_parameters, point_spacing_mm,
};
use regrind::geometry::{DeviationSample, Point, Vector};
use regrind_sim::form::FormError;
use regrind_sim::shape::{FreeForm, Shape};

const CUTOFF_MM: f64 = 5.0;
/// Columns and rows of the measurement of the trials: 28,476 points.
const SCAN: (usize, usize) = (226, 126);
/// Node spacings of the maps, in mm.
const SPACINGS_MM: [f64; 2] = [1.0, 0.5];

static CONTACTS: LazyLock<Vec<SurfacePoint>> = LazyLock::new(measured);
static READINGS: LazyLock<Vec<DeviationSample>> = LazyLock::new(|| {
    let reading = |c: &SurfacePoint| DeviationSample { place_mm: [c.point.x, c.point.y], deviation_mm: c.deviation_mm };
    CONTACTS.iter().map(reading).collect()
});

fn main() {
    divan::main();
}

fn measured() -> Vec<SurfacePoint> {
    let shape = FreeForm::default();
    let form = FormError::new(5, 30.0, 6.657e-3, FreeForm::WIDTH_MM, FreeForm::DEPTH_MM);
    let mut rng = regrind_sim::rng(1);
    let mut random = move || rng.random::<f64>() - 0.5;
    (0..SCAN.0 * SCAN.1)
        .map(|k| {
            let at = |i: usize, n: usize, size: f64| (size - 2.0) * (i as f64 / (n - 1) as f64 - 0.5);
            let (x, y) = (at(k % SCAN.0, SCAN.0, FreeForm::WIDTH_MM), at(k / SCAN.0, SCAN.1, FreeForm::DEPTH_MM));
            // Four uniform numbers between -1/2 and 1/2 have a sum with a standard deviation of 0.577.
            let noise = 3e-4 / 0.577 * (0..4).map(|_| random()).sum::<f64>();
            let spike = if random() > 0.49 { 8e-3 } else { 0.0 };
            let normal = Vector::from(shape.normal(x, y));
            let wheel = -0.02 * (1.0 / normal.z - 1.0);
            let deviation_mm = form.height(x, y) + noise + spike + wheel;
            SurfacePoint { point: Point::from(shape.point(x, y)), normal, deviation_mm }
        })
        .collect()
}

fn plain(spacing_mm: f64) -> MapOptions {
    MapOptions { outlier_limit: None, ..MapOptions::new(CUTOFF_MM, spacing_mm) }
}

/// Measures the search for the spacing of neighbouring points, the first step of every map.
#[divan::bench]
fn spacing_of_points(bencher: Bencher) {
    let readings = &*READINGS;
    bencher.bench(|| point_spacing_mm(black_box(readings)));
}

/// Measures the Gaussian filter alone.
#[divan::bench(args = SPACINGS_MM)]
fn filter(bencher: Bencher, spacing_mm: f64) {
    let readings = &*READINGS;
    bencher.bench(|| error_map(black_box(readings), &plain(spacing_mm)));
}

/// Measures outlier rejection and then the filter, as in a cycle.
#[divan::bench(args = SPACINGS_MM)]
fn outliers_and_filter(bencher: Bencher, spacing_mm: f64) {
    let readings = &*READINGS;
    bencher.bench(|| error_map(black_box(readings), &MapOptions::new(CUTOFF_MM, spacing_mm)));
}

/// Measures the robust filter alone.
#[divan::bench(args = SPACINGS_MM)]
fn robust_filter(bencher: Bencher, spacing_mm: f64) {
    let readings = &*READINGS;
    let options = MapOptions { smoothing: Smoothing::RobustGaussian, ..plain(spacing_mm) };
    bencher.bench(|| error_map(black_box(readings), &options));
}

/// Measures a filter whose cut-off is a third of the part.
#[divan::bench(args = SPACINGS_MM)]
fn long_filter(bencher: Bencher, spacing_mm: f64) {
    let readings = &*READINGS;
    let options = MapOptions { cutoff_mm: 20.0, ..plain(spacing_mm) };
    bencher.bench(|| error_map(black_box(readings), &options));
}

/// Measures the smoothing spline with its uncertainty, and the filter that finds which nodes were measured.
#[divan::bench(args = SPACINGS_MM)]
fn spline(bencher: Bencher, spacing_mm: f64) {
    let readings = &*READINGS;
    let options = MapOptions { smoothing: Smoothing::Spline, ..plain(spacing_mm) };
    bencher.bench(|| error_map(black_box(readings), &options));
}

/// Measures the learning from a second pass, by octaves, and the correction for the third.
#[divan::bench(args = SPACINGS_MM)]
fn correction(bencher: Bencher, spacing_mm: f64) {
    let options = MapOptions::new(CUTOFF_MM, spacing_mm);
    let error = error_map(&READINGS, &options).expect("a map");
    let now = Correction::zero(error.nodes.grid, 0.06);
    let begin = LearningState::new(GainRule::Wavelength, &options, [FreeForm::WIDTH_MM, FreeForm::DEPTH_MM], None);
    let seen = PassObservation { correction: &now, error: &error, response: None, explained: None };
    let known = begin.updated(&seen);
    let limits = CorrectionLimits {
        depth_of_cut_mm: 0.01,
        min_depth_mm: 0.0005,
        max_correction_mm: 0.1,
        allowance_mm: 0.06,
        removal_budget_mm: 1.0,
        max_depth_mm: 1.0,
    };
    bencher.bench(|| now.next_pass(&error, &black_box(&known).updated(&seen), None, &limits).expect("a correction"));
}

/// Measures the separation of wheel, setting and wear from form.
#[divan::bench]
fn separation_of_parameters(bencher: Bencher) {
    let contacts = &*CONTACTS;
    let options = ParameterOptions::new(12.5);
    bencher.bench(|| estimate_parameters(black_box(contacts), None, &options));
}
