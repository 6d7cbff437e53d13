//! Time that a cycle needs to report the residual error of the part: figures, and the map as X3P and picture.
//!
//! ```text
//! cargo bench --bench maps
//! ```

use std::path::{Path, PathBuf};

use divan::{Bencher, black_box};
use regrind::compensation::ErrorMap;
use regrind::form::{FormOptions, compute_figures};
use regrind::formats::{parse_x3p, write_error_map_x3p};
use regrind::geometry::{Aperture, DeviationSample, Grid};
use regrind::report::HeatMap;

fn main() {
    divan::main();
}

/// Returns samples of a rough surface over the free form's aperture.
fn samples(points: usize) -> Vec<DeviationSample> {
    let columns = (points as f64 * 102.0 / 62.0).sqrt().round() as usize;
    let rows = points.div_ceil(columns);
    let place = |k: usize| {
        [
            (k % columns) as f64 * 102.0 / (columns - 1) as f64 - 51.0,
            (k / columns) as f64 * 62.0 / (rows - 1) as f64 - 31.0,
        ]
    };
    let rough = |[x, y]: [f64; 2]| 1e-3 * (0.2 * x).sin() * (0.3 * y).cos() + 1e-4 * (5.0 * x + 7.0 * y).sin();
    (0..columns * rows)
        .map(place)
        .map(|at_mm| DeviationSample { place_mm: at_mm, deviation_mm: rough(at_mm) })
        .collect()
}

fn error_map(nodes: usize) -> ErrorMap {
    let columns = (nodes as f64).sqrt() as usize;
    let grid = Grid {
        columns,
        rows: columns,
        first_mm: [-51.0, -31.0],
        spacing_mm: [102.0 / columns as f64, 62.0 / columns as f64],
    };
    let values_mm = (0..grid.len()).map(|k| 1e-3 * (k as f64 * 0.01).sin()).collect();
    ErrorMap::exact(grid, values_mm, (0..grid.len()).map(|k| k % 11 != 3).collect())
}

fn written(map: &ErrorMap) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("maps.x3p");
    write_error_map_x3p(&path, map, "2026-03-01T12:00:00Z", true).unwrap();
    path
}

#[divan::bench(args = [1_800, 28_476, 451_401], sample_count = 10)]
fn all_figures(bencher: Bencher, points: usize) {
    let samples = samples(points);
    let aperture = Some(Aperture::Rectangle { centre_mm: [0.0; 2], width_mm: 102.0, height_mm: 62.0 });
    let options = FormOptions { aperture, ..FormOptions::default() };
    bencher.bench_local(|| compute_figures(black_box(&samples), &options).unwrap());
}

#[divan::bench(args = [6_400, 1_000_000], sample_count = 10)]
fn x3p_written(bencher: Bencher, nodes: usize) {
    let map = error_map(nodes);
    bencher.bench_local(|| written(black_box(&map)));
}

#[divan::bench(args = [6_400, 1_000_000], sample_count = 10)]
fn x3p_read(bencher: Bencher, nodes: usize) {
    let path = written(&error_map(nodes));
    let bytes = std::fs::read(&path).unwrap();
    bencher.bench_local(|| parse_x3p(&path, black_box(&bytes)).unwrap());
}

#[divan::bench(args = [6_400, 1_000_000], sample_count = 10)]
fn picture(bencher: Bencher, nodes: usize) {
    let map = error_map(nodes).nodes.samples_mm().collect::<Vec<_>>();
    let drawn = || HeatMap::of_lengths("map", "deviation", black_box(&map)).unwrap().with_tolerance(2e-4).unwrap();
    bencher.bench_local(|| drawn().to_svg().unwrap());
}
