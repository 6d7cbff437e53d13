//! Speed of the tool path and of its program, by the number of points; `REGRIND_BENCH_LARGE=1` adds ten million.
//!
//! The part is a free form of 100 x 60 mm with a correction on a grid of 1 mm. The distance of the tracks sets the
//! number of points. The chord error is 0.1 um. The time grows linearly, and memory holds only one chunk of text.

use std::path::Path;

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use regrind::compensation::path::{
    HeightField, Move, PathMode, PathOptions, PathSummary, TargetSurface, ToolPath, Wheel,
};
use regrind::compensation::{
    Correction, CorrectionLimits, GainRule, LearningState, MapOptions, PassObservation, error_map,
};
use regrind::config::read_dialect;
use regrind::formats::gcode::{Exactness, ProgramHeader, write_program};
use regrind::geometry::{Aperture, DeviationSample, Grid};

fn main() {
    divan::main();
}

/// Returns the numbers of points to request.
fn sizes() -> Vec<u64> {
    let mut sizes = vec![100_000, 1_000_000];
    if std::env::var_os("REGRIND_BENCH_LARGE").is_some() {
        sizes.push(10_000_000);
    }
    sizes
}

/// Returns a path of about this number of points.
fn path(points: u64) -> ToolPath {
    let grid = Grid { columns: 101, rows: 61, first_mm: [-50.0, -30.0], spacing_mm: [1.0, 1.0] };
    let values_mm = (0..grid.len()).map(|k| error_mm(grid.place_mm(k))).collect();
    path_of(nominal(), &Correction { grid, values_mm, cycle: 2, level_mm: 0.02, parameters: None }, points)
}

/// Returns the error that the grinder left, in millimetres.
fn error_mm([x, y]: [f64; 2]) -> f64 {
    5e-3 * (0.3 * x).sin() * (0.25 * y).cos()
}

fn nominal() -> HeightField {
    let on = Grid { columns: 263, rows: 163, first_mm: [-52.4, -32.4], spacing_mm: [0.4, 0.4] };
    let form = |x: f64, y: f64| {
        let (s, c) = (0.042 * x + 0.016 * y + 0.4).sin_cos();
        let slope = [x / 210.0 + 0.294 * c, -y / 155.0 + 0.112 * c];
        (x * x / 420.0 - y * y / 310.0 + 7.0 * s, slope)
    };
    let place = |k: usize| ((k % 263) as f64 * 0.4 - 52.4, (k / 263) as f64 * 0.4 - 32.4);
    let (heights, slopes): (Vec<f64>, Vec<[f64; 2]>) = (0..263 * 163).map(place).map(|(x, y)| form(x, y)).unzip();
    HeightField::hermite(on, &heights, &slopes)
}

fn path_of(nominal: HeightField, correction: &Correction, points: u64) -> ToolPath {
    let wanted = TargetSurface::new(nominal, correction, 12.5).expect("finite");
    // A track of 104 mm has about 450 points at 0.1 um.
    let track_mm = 60.0 * 450.0 / points as f64;
    let options = PathOptions::new(Wheel::Sphere { radius_mm: 12.5 }, track_mm, 1000.0);
    let outline = Aperture::Rectangle { centre_mm: [0.0; 2], width_mm: 100.0, height_mm: 60.0 };
    ToolPath::new(wanted, outline, options).expect("the wheel fits")
}

/// Measures laying the tracks and placing the wheel against the surface.
#[divan::bench(sample_count = 10)]
fn lay(bencher: Bencher) {
    bencher.bench(|| path(black_box(1_000_000)));
}

/// Measures a walk over all tracks in parallel, for the maximum and minimum of every quantity.
#[divan::bench(args = sizes(), sample_count = 5)]
fn summary(bencher: Bencher, points: u64) {
    let path = path(points);
    bencher.counter(ItemsCount::new(points)).bench(|| path.summary());
}

/// Measures the generation of the points in sequence, on one core.
#[divan::bench(args = sizes(), sample_count = 5)]
fn points(bencher: Bencher, points: u64) {
    let path = path(points);
    bencher.counter(ItemsCount::new(points)).bench(|| {
        path.moves().fold(0.0, |sum, one| match one {
            Move::Feed { to, .. } => sum + to.z,
            _ => sum,
        })
    });
}

/// Measures the points and their text, written into a file.
#[divan::bench(args = sizes(), sample_count = 3)]
fn program(bencher: Bencher, points: u64) {
    let (path, folder) = (path(points), tempfile::tempdir().expect("a folder"));
    let (summary, file) = (path.summary().expect("a path"), folder.path().join("part.ngc"));
    bencher.counter(ItemsCount::new(points)).bench(|| write(&path, &summary, &file));
}

fn write(path: &ToolPath, summary: &PathSummary, file: &Path) {
    let header = ProgramHeader {
        part: "bench".into(),
        cycle: 2,
        base_identity: [1; 32],
        map_identity: [2; 32],
        uncorrected: false,
        level_mm: 0.02,
        from_below: false,
        rotary: None,
        lean: String::new(),
        wheel: path.options().wheel.description(),
        parameters: Vec::new(),
        tracks: String::new(),
        spark_out_passes: 0,
        simulation: true,
        exactness: Exactness {
            mode: PathMode::Blend,
            tolerance_mm: 1e-4,
            controller_mm: None,
            chord_error_mm: 1e-4,
            arcs_within_mm: None,
        },
    };
    let dialect = read_dialect(Path::new("config/dialects/linuxcnc.toml")).expect("a dialect that ships").dialect;
    write_program(file, &header, &dialect, summary, path).expect("a program");
}

/// Measures the whole chain: 28,476 deviations, their map, what the learning takes from them, the correction, the path
/// and its program of a million points.
#[divan::bench(sample_count = 5)]
fn from_deviations_to_a_program(bencher: Bencher) {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("part.ngc");
    let readings: Vec<DeviationSample> = (0..226 * 126)
        .map(|k| [(k % 226) as f64 * 100.0 / 225.0 - 50.0, (k / 226) as f64 * 60.0 / 125.0 - 30.0])
        .map(|at_mm| DeviationSample {
            place_mm: at_mm,
            deviation_mm: error_mm(at_mm) + 3e-4 * (1e4 * (at_mm[0] + 3.0 * at_mm[1])).sin(),
        })
        .collect();
    let options = MapOptions::new(5.0, 1.0);
    let limits = CorrectionLimits {
        depth_of_cut_mm: 0.01,
        min_depth_mm: 0.0005,
        max_correction_mm: 0.1,
        allowance_mm: 0.06,
        removal_budget_mm: 1.0,
        max_depth_mm: 1.0,
    };
    let begin = LearningState::new(GainRule::Wavelength, &options, [100.0, 60.0], None);
    bencher.bench(|| {
        let error = error_map(black_box(&readings), &options).expect("a map");
        let now = Correction::zero(error.nodes.grid, 0.06);
        let known =
            begin.updated(&PassObservation { correction: &now, error: &error, response: None, explained: None });
        let step = now.next_pass(&error, &known, None, &limits).expect("a correction");
        let path = path_of(nominal(), &step.correction, 1_000_000);
        write(&path, &path.summary().expect("a path"), &file);
    });
}
