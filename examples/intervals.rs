//! How often what is said of a part is true: figures, form and pose of simulated measurements, held against what was planted.
//!
//! ```text
//! cargo run --release --example intervals [REPEATS [POINTS]]
//! ```
//! REPEATS (250) measurements of POINTS (1200) of each of three shapes with each of four kinds of error. Every one has a form, a place and a scatter of
//! its own. Intervals are said with 95 %; where there is no form, PV and RMS are upper bounds.

use nalgebra::{DMatrix, DVector, Vector6};
use rayon::prelude::*;
use regrind::geometry::{Point, Pose};
use regrind::model::{Form, Given, Interval};
use regrind::registration::{Options, PointStatus, Registration, Start, register};
use regrind::surface::{Nominal, Projection};
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, add_noise, centre};
use regrind_sim::shape::{FreeForm, Shape, Wave, XyPolynomial};
use regrind_sim::{Rng, Vec3};

const RADIUS_MM: f64 = 1.5;
const SCATTER_MM: f64 = 3e-4;
const HALF_MM: [f64; 2] = [48.0, 28.0];

/// What is wrong with a part and its measurement.
#[derive(Clone, Copy)]
struct Kind {
    name: &'static str,
    form_rms_mm: f64,
    /// How much of the scatter of a point the next one on the path has.
    drift: f64,
    /// Share of points that are far off.
    outliers: f64,
}

const KINDS: [Kind; 4] = [
    Kind { name: "white scatter", form_rms_mm: 0.0, drift: 0.0, outliers: 0.0 },
    Kind { name: "form of 5 um", form_rms_mm: 5e-3, drift: 0.0, outliers: 0.0 },
    Kind { name: "drift of a scan", form_rms_mm: 5e-3, drift: 0.7, outliers: 0.0 },
    Kind { name: "1 % outliers", form_rms_mm: 5e-3, drift: 0.0, outliers: 0.01 },
];

/// Whether what was said of one measurement is true.
struct Held {
    rms: bool,
    pv: bool,
    /// Share of the points whose interval holds the form there.
    points: f64,
    /// Of the six coordinates of the frame.
    pose: [bool; 6],
}

fn main() {
    let number =
        |k: usize, otherwise: usize| std::env::args().nth(k).map_or(otherwise, |n| n.parse().expect("a number"));
    let (repeats, points) = (number(1, 250), number(2, 1200));
    let shapes: [(&str, Box<dyn Shape + Sync>); 3] = [
        ("free form", Box::new(FreeForm::default())),
        ("wave", Box::new(Wave { height_mm: 2.0 })),
        ("steep free form", Box::new(steep())),
    ];
    println!("{repeats} measurements of {points} points each; of 100 the interval of 95 % holds");
    println!("{:18}{:18}{:>8}{:>8}{:>8}{:>8}", "", "", "RMS", "PV", "form", "pose");
    for (name, shape) in &shapes {
        let nominal = nominal(shape.as_ref());
        for kind in KINDS {
            let of = |seed: usize| measured(shape.as_ref(), &nominal, kind, points, seed as u64);
            let held: Vec<Held> = (0..repeats).into_par_iter().map(of).collect();
            let share = |of: &dyn Fn(&Held) -> f64| 100.0 * held.iter().map(of).sum::<f64>() / repeats as f64;
            let pose = |held: &Held| held.pose.iter().filter(|held| **held).count() as f64 / 6.0;
            let [rms, pv] = [share(&|held| f64::from(held.rms)), share(&|held| f64::from(held.pv))];
            let (form, pose) = (share(&|held| held.points), share(&pose));
            println!("{name:18}{:18}{rms:8.1}{pv:8.1}{form:8.1}{pose:8.1}", kind.name);
        }
    }
}

fn steep() -> XyPolynomial {
    let terms = vec![(2, 0, 14.0), (1, 1, 4.0), (0, 2, 9.0), (3, 0, 2.0), (0, 3, -2.0)];
    XyPolynomial { normalisation_radius_mm: 50.0, terms }
}

fn nominal(shape: &dyn Shape) -> Nominal {
    let grid = shape.grid(2.0 * HALF_MM[0] + 6.0, 2.0 * HALF_MM[1] + 6.0, 409, 249);
    Nominal::from_points(grid.into_iter().map(Point::from).collect(), Projection::Auto).expect("a surface")
}

fn measured(shape: &dyn Shape, nominal: &Nominal, kind: Kind, count: usize, seed: u64) -> Held {
    let mut rng = regrind_sim::rng(1_000_000 + seed);
    let form = if kind.form_rms_mm > 0.0 {
        FormError::with_rms(&mut regrind_sim::rng(seed), 30.0, kind.form_rms_mm)
    } else {
        FormError::none()
    };
    let placement = Placement::new([1.0, -2.0, 0.5], [0.3, -0.2, 0.5]);
    let cloud = touched(shape, &form, &placement, kind, count, &mut rng);
    let truth = pose(&placement);
    let options = Options { start: Start::Pose(truth), ..Options::new(RADIUS_MM) };
    let found = register(nominal, &cloud, &options).expect("a registration");
    let told = Form::of(&found, &Given::default()).expect("a model");
    let planted = after_best_fit(&form, &found);
    let n = planted.len() as f64;
    let rms = (planted.norm_squared() / n).sqrt();
    let holds = |of: Interval, value: f64| (of.low_mm..=of.high_mm).contains(&value);
    let near =
        |(at, truth): (&regrind::model::FormPoint, &f64)| (at.form.mean_mm - truth).abs() <= 1.96 * at.form.sigma_mm;
    let off = Vector6::from_iterator((truth.inverse() * found.cmm_from_model).log().iter().copied());
    Held {
        rms: holds(told.figures.rms, rms),
        pv: holds(told.figures.pv, planted.max() - planted.min()),
        points: told.points.iter().zip(planted.iter()).filter(|pair| near(*pair)).count() as f64 / n,
        pose: std::array::from_fn(|k| off[k].abs() <= 1.96 * told.frame_covariance[(k, k)].sqrt()),
    }
}

/// Centres over a pattern that is run to and fro, in the frame of the machine.
fn touched(
    shape: &dyn Shape,
    form: &FormError,
    placement: &Placement,
    kind: Kind,
    count: usize,
    rng: &mut Rng,
) -> Vec<Point> {
    let columns = (count as f64 * HALF_MM[0] / HALF_MM[1]).sqrt().round() as usize;
    let rows = count / columns;
    let mut noise = [0.0; 3];
    let mut cloud = Vec::with_capacity(columns * rows);
    for k in 0..columns * rows {
        let (row, place) = (k / columns, k % columns);
        let column = if row % 2 == 0 { place } else { columns - 1 - place };
        let at = |k: usize, count: usize, half: f64| half * (2.0 * k as f64 / (count - 1) as f64 - 1.0);
        let [x, y] = [at(column, columns, HALF_MM[0]), at(row, rows, HALF_MM[1])];
        let fresh = (1.0 - kind.drift * kind.drift).sqrt() * SCATTER_MM;
        let mut drawn = [[0.0; 3]; 2];
        add_noise(rng, &mut drawn, 1.0);
        let [draws, [far, ..]] = drawn;
        noise = std::array::from_fn(|axis| kind.drift * noise[axis] + fresh * draws[axis]);
        let is_far = ((k * 7919 + 13) % 10_000) as f64 <= 10_000.0 * kind.outliers;
        let away = if is_far && kind.outliers > 0.0 { 0.05 + 0.05 * far.abs() } else { 0.0 };
        let on: Vec3 = centre(shape, form, RADIUS_MM + away, x, y);
        let seen = placement.apply(on);
        cloud.push(Point::from(std::array::from_fn::<f64, 3, _>(|axis| seen[axis] + noise[axis])));
    }
    cloud
}

/// The planted form at the points used, after its own best fit.
fn after_best_fit(form: &FormError, found: &Registration) -> DVector<f64> {
    let used: Vec<_> = found.deviations.iter().filter(|d| d.status == PointStatus::Used).collect();
    let planted = DVector::from_iterator(used.len(), used.iter().map(|d| form.height(d.point.x, d.point.y)));
    let motions = DMatrix::from_fn(used.len(), 6, |r, c| {
        let arm = used[r].point.coords.cross(&used[r].normal) / 30.0;
        [used[r].normal.x, used[r].normal.y, used[r].normal.z, arm.x, arm.y, arm.z][c]
    });
    let base = motions.qr().q();
    &planted - &base * base.tr_mul(&planted)
}

fn pose(placement: &Placement) -> Pose {
    let [r, t] = [&placement.rotation, &[placement.translation_mm; 3]];
    let row = |k: usize| [r[k][0], r[k][1], r[k][2], t[0][k]];
    Pose::from_rows([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]).expect("a pose")
}
