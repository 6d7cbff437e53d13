//! Time of a registration, in one process and without reading a file.
//!
//! `cargo bench --bench registration` runs all in about a minute. A name after `--` selects some, and
//! `REGRIND_BENCH_LARGE=1` adds the nominal surface of ten million points. A user waits for the nominal surface and the
//! registration together, so every sample builds a new surface: the first registration caches the normals in it, and a
//! second one would look faster than it is. The creation and copying of inputs and the dropping of results are not
//! timed.

use std::sync::LazyLock;

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use regrind::geometry::{Point, Pose};
use regrind::registration::{Registration, RegistrationOptions, Start, register};
use regrind::surface::{Nominal, PlaneProjection};
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, add_noise, centre};
use regrind_sim::shape::{FreeForm, Shape};

const RADIUS_MM: f64 = 1.5;
const FORM_PV_MM: f64 = 6.657e-3;
const NOISE_MM: f64 = 2e-4;

/// Columns and rows of the measurement of the trials: 28,476 points.
const SCAN: (usize, usize) = (226, 126);
/// Columns and rows of a measurement with as many points as the nominal surface: 451,401.
const DENSE: (usize, usize) = FreeForm::PAPER_GRID;

/// Misalignment within the repeatability of a fixture: shifts in mm, rotations in degrees.
const NEAR: ([f64; 3], [f64; 3]) = ([0.05, 0.02, -0.03], [0.01, 0.02, 0.03]);
/// Misalignment of a part that was laid down by hand: shifts in mm, rotations in degrees.
const FAR: ([f64; 3], [f64; 3]) = ([20.0, 10.0, 20.0], [20.0, 20.0, 10.0]);

static NOMINAL: LazyLock<Vec<Point>> = LazyLock::new(|| grid(DENSE));
static SCAN_NEAR: LazyLock<Vec<Point>> = LazyLock::new(|| measured(SCAN, &placement(NEAR)));
static SCAN_FAR: LazyLock<Vec<Point>> = LazyLock::new(|| measured(SCAN, &placement(FAR)));
static DENSE_NEAR: LazyLock<Vec<Point>> = LazyLock::new(|| measured(DENSE, &placement(NEAR)));
static DENSE_FAR: LazyLock<Vec<Point>> = LazyLock::new(|| measured(DENSE, &placement(FAR)));

fn main() {
    divan::main();
}

fn placement((translation_mm, angles_deg): ([f64; 3], [f64; 3])) -> Placement {
    Placement::new(translation_mm, angles_deg)
}

/// Returns the nominal points of the free form, row by row.
fn grid((columns, rows): (usize, usize)) -> Vec<Point> {
    let points = FreeForm::default().grid(FreeForm::WIDTH_MM, FreeForm::DEPTH_MM, columns, rows);
    points.into_iter().map(Point::from).collect()
}

/// Returns the centres of a probe on the ground part, with noise, in the frame of the measuring machine.
fn measured((columns, rows): (usize, usize), place: &Placement) -> Vec<Point> {
    let shape = FreeForm::default();
    let form = FormError::new(5, 30.0, FORM_PV_MM, FreeForm::WIDTH_MM, FreeForm::DEPTH_MM);
    // A millimetre inside the edge, so that the ball touches the part at any slope.
    let at = |i: usize, n: usize, size: f64| (size - 2.0) * (i as f64 / (n - 1) as f64 - 0.5);
    let mut centres: Vec<[f64; 3]> = (0..columns * rows)
        .map(|k| {
            let (x, y) = (at(k % columns, columns, FreeForm::WIDTH_MM), at(k / columns, rows, FreeForm::DEPTH_MM));
            place.apply(centre(&shape, &form, RADIUS_MM, x, y))
        })
        .collect();
    add_noise(&mut regrind_sim::rng(1), &mut centres, NOISE_MM);
    centres.into_iter().map(Point::from).collect()
}

fn gridded(points: Vec<Point>) -> Nominal {
    Nominal::from_points(points, PlaneProjection::Auto).expect("the free form is a surface")
}

fn scattered(points: Vec<Point>) -> Nominal {
    Nominal::from_triangulated_points(points, PlaneProjection::Auto).expect("the free form is a surface")
}

fn found(nominal: &Nominal, measured: &[Point], start: Start) -> Registration {
    let options = RegistrationOptions { start, ..RegistrationOptions::new(RADIUS_MM) };
    register(nominal, black_box(measured), &options).expect("the part is the free form")
}

const AT_IDENTITY: fn() -> Start = || Start::Pose(Pose::identity());

/// 451,401 nominal points on a grid, 28,476 measured close by.
#[divan::bench_group(sample_count = 20, sample_size = 1)]
mod near {
    use super::*;

    #[divan::bench]
    fn nominal_and_registration(bencher: Bencher) {
        let measured = &*SCAN_NEAR;
        bencher.with_inputs(|| NOMINAL.clone()).bench_values(|points| {
            let nominal = gridded(points);
            let registration = found(&nominal, measured, AT_IDENTITY());
            (nominal, registration)
        });
    }

    #[divan::bench]
    fn nominal_alone(bencher: Bencher) {
        bencher.with_inputs(|| NOMINAL.clone()).bench_values(gridded);
    }

    #[divan::bench]
    fn registration_alone(bencher: Bencher) {
        let measured = &*SCAN_NEAR;
        let fresh = || gridded(NOMINAL.clone());
        bencher.with_inputs(fresh).bench_refs(|nominal| found(nominal, measured, AT_IDENTITY()));
    }
}

/// 451,401 measured points, the part 20/10/20 mm and 20/20/10 degrees off; the registration alone.
#[divan::bench_group(sample_count = 6, sample_size = 1)]
mod far {
    use super::*;

    fn time(bencher: Bencher, measured: &[Point], start: Start) {
        let fresh = || gridded(NOMINAL.clone());
        bencher.with_inputs(fresh).bench_refs(|nominal| found(nominal, measured, start));
    }

    #[divan::bench]
    fn from_identity(bencher: Bencher) {
        time(bencher, &DENSE_FAR, AT_IDENTITY());
    }

    #[divan::bench]
    fn from_a_search(bencher: Bencher) {
        time(bencher, &DENSE_FAR, Start::Search);
    }

    /// Registers 28,476 of the points.
    #[divan::bench(sample_count = 20)]
    fn a_scan_from_identity(bencher: Bencher) {
        time(bencher, &SCAN_FAR, AT_IDENTITY());
    }

    #[divan::bench(sample_count = 20)]
    fn a_scan_from_a_search(bencher: Bencher) {
        time(bencher, &SCAN_FAR, Start::Search);
    }
}

/// 451,401 nominal points in no order, 28,476 measured close by.
#[divan::bench_group(sample_count = 8, sample_size = 1)]
mod without_a_grid {
    use super::*;

    /// Returns as many points as the grid has, evenly distributed without any order (the R2 sequence): no four of them
    /// on one circle.
    fn strewn() -> Vec<Point> {
        let place = |k: usize, step: f64, size: f64| size * ((0.5 + k as f64 * step).fract() - 0.5);
        (0..NOMINAL.len())
            .map(|k| {
                (
                    place(k, 0.754_877_666_246_693, FreeForm::WIDTH_MM),
                    place(k, 0.569_840_290_998_053, FreeForm::DEPTH_MM),
                )
            })
            .map(|(x, y)| Point::from(FreeForm::default().point(x, y)))
            .collect()
    }

    #[divan::bench]
    fn nominal_and_registration(bencher: Bencher) {
        let (points, measured) = (strewn(), &*SCAN_NEAR);
        bencher.with_inputs(|| points.clone()).bench_values(|points| {
            let nominal = scattered(points);
            let registration = found(&nominal, measured, AT_IDENTITY());
            (nominal, registration)
        });
    }

    #[divan::bench]
    fn nominal_alone(bencher: Bencher) {
        let points = strewn();
        bencher.with_inputs(|| points.clone()).bench_values(scattered);
    }
}

/// Registers 2,000 points in any pose. The argument is the seed of the pose.
#[divan::bench(sample_count = 10, sample_size = 1, args = [1, 2, 3])]
fn search_of_any_pose(bencher: Bencher, seed: u64) {
    let place = Placement::random(&mut regrind_sim::rng(seed), 100.0);
    let measured = measured((50, 40), &place);
    let fresh = || gridded(NOMINAL.clone());
    bencher.with_inputs(fresh).bench_refs(|nominal| found(nominal, &measured, Start::Search));
}

/// Returns the columns and rows of nominal grids, each ten times as large as the one before.
fn grids() -> Vec<usize> {
    let large = std::env::var_os("REGRIND_BENCH_LARGE").is_some_and(|v| v == "1");
    [10_000, 100_000, 1_000_000].into_iter().chain(large.then_some(10_000_000)).collect()
}

/// Measures a growing nominal grid and 28,476 points close by, built and registered together.
#[divan::bench(sample_count = 8, sample_size = 1, args = grids())]
fn growth_with_nominal_points(bencher: Bencher, count: usize) {
    let columns = [(10_000, 125), (100_000, 400), (1_000_000, 1250), (10_000_000, 4000)]
        .into_iter()
        .find_map(|(n, columns)| (n == count).then_some(columns))
        .expect("a grid of the list");
    let (points, measured) = (grid((columns, count / columns)), &*SCAN_NEAR);
    bencher.with_inputs(|| points.clone()).bench_values(|points| {
        let nominal = gridded(points);
        let registration = found(&nominal, measured, AT_IDENTITY());
        (nominal, registration)
    });
}

/// Measures the time of one point in one pass after the iteration has settled. The argument is the distance of the
/// start, in micrometres.
///
/// An item is one point in one pass, so 1000 divided by the printed Mitem/s is the time in ns. This time includes the
/// checks before the iteration, the side of the probe and the verdict after it, so it is an upper limit of the pass.
/// The farther start takes more passes and the same rest. The difference of the two is the time of the passes alone.
#[divan::bench(sample_count = 10, sample_size = 1, args = [0, 5])]
fn settled_pass(bencher: Bencher, off_um: u32) {
    let nominal = gridded(NOMINAL.clone());
    let fitted = found(&nominal, &DENSE_NEAR, AT_IDENTITY()).cmm_from_model;
    let off_mm = f64::from(off_um) * 1e-3;
    let start = Start::Pose(fitted * Pose::exp(&[off_mm, off_mm, off_mm, 0.0, 0.0, 0.0].into()));
    // The evaluation at the start pose is a pass too.
    let passes = 1 + found(&nominal, &DENSE_NEAR, start).trace.len();
    bencher.counter(ItemsCount::new(DENSE_NEAR.len() * passes)).bench(|| found(&nominal, &DENSE_NEAR, start));
}
