//! Speed of the path and of its program, by the number of points; `REGRIND_BENCH_LARGE=1` adds ten million.
//!
//! The part is a free form of 100 x 60 mm with a correction on a net of 1 mm. How many points there are is set by the distance of the
//! tracks; the chord error is 0.1 um. Growth in time is linear, and nothing but one chunk of text is held in memory.

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use regrind::compensation::path::{Field, Lattice, Move, PathOptions, ToolPath, Wanted, Wheel};
use regrind::compensation::{Correction, Net};
use regrind::formats::gcode::{PathMode, ProgramHeader, write_program};
use regrind::geometry::Aperture;

fn main() {
    divan::main();
}

/// Numbers of points that are asked for.
fn sizes() -> Vec<u64> {
    let mut sizes = vec![100_000, 1_000_000];
    if std::env::var_os("REGRIND_BENCH_LARGE").is_some() {
        sizes.push(10_000_000);
    }
    sizes
}

/// A path of about so many points.
fn path(points: u64) -> ToolPath {
    let on = Lattice { columns: 263, rows: 163, first_mm: [-52.4, -32.4], spacing_mm: [0.4, 0.4] };
    let form = |x: f64, y: f64| {
        let (s, c) = (0.042 * x + 0.016 * y + 0.4).sin_cos();
        let slope = [x / 210.0 + 0.294 * c, -y / 155.0 + 0.112 * c];
        (x * x / 420.0 - y * y / 310.0 + 7.0 * s, slope)
    };
    let place = |k: usize| ((k % 263) as f64 * 0.4 - 52.4, (k / 263) as f64 * 0.4 - 32.4);
    let (heights, slopes): (Vec<f64>, Vec<[f64; 2]>) = (0..263 * 163).map(place).map(|(x, y)| form(x, y)).unzip();
    let net = Net { columns: 101, rows: 61, first_mm: [-50.0, -30.0], spacing_mm: [1.0, 1.0] };
    let error = |[x, y]: [f64; 2]| 5e-3 * (0.3 * x).sin() * (0.25 * y).cos();
    let values_mm = (0..net.len()).map(|k| error(net.place_mm(k))).collect();
    let correction = Correction { net, values_mm, cycle: 2, level_mm: 0.02 };
    let wanted = Wanted::new(Field::hermite(on, &heights, &slopes), &correction, 12.5).expect("finite");
    // A track of 104 mm has some 450 points at 0.1 um.
    let track_mm = 60.0 * 450.0 / points as f64;
    let options = PathOptions::new(Wheel::Sphere { radius_mm: 12.5 }, track_mm, 1000.0);
    let outline = Aperture::Rectangle { centre_mm: [0.0; 2], width_mm: 100.0, height_mm: 60.0 };
    ToolPath::new(wanted, outline, options).expect("the wheel fits")
}

/// Lays the tracks and holds the wheel against the surface.
#[divan::bench(sample_count = 10)]
fn lay(bencher: Bencher) {
    bencher.bench(|| path(black_box(1_000_000)));
}

/// Walks all tracks at once: largest and least of everything.
#[divan::bench(args = sizes(), sample_count = 5)]
fn summary(bencher: Bencher, points: u64) {
    let path = path(points);
    bencher.counter(ItemsCount::new(points)).bench(|| path.summary());
}

/// The points one after the other, on one core.
#[divan::bench(args = sizes(), sample_count = 5)]
fn points(bencher: Bencher, points: u64) {
    let path = path(points);
    bencher.counter(ItemsCount::new(points)).bench(|| {
        path.moves().fold(0.0, |sum, one| match one {
            Move::Feed { at, .. } => sum + at.z,
            _ => sum,
        })
    });
}

/// The points and their text, into a file.
#[divan::bench(args = sizes(), sample_count = 3)]
fn program(bencher: Bencher, points: u64) {
    let (path, folder) = (path(points), tempfile::tempdir().expect("a folder"));
    let summary = path.summary().expect("a path");
    let header = ProgramHeader {
        part: "bench".into(),
        cycle: 2,
        base_identity: [1; 32],
        map_identity: [2; 32],
        level_mm: 0.02,
        wheel: path.options().wheel.words(),
        tracks: String::new(),
        spark_out_passes: 0,
        simulation: true,
        mode: PathMode::default(),
    };
    let file = folder.path().join("part.ngc");
    bencher
        .counter(ItemsCount::new(points))
        .bench(|| write_program(&file, &header, &summary, path.moves()).expect("a program"));
}
