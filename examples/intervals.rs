//! How often what is said of a part is true: figures, form and pose of simulated measurements, held against what was planted.
//!
//! ```text
//! cargo run --release --example intervals [REPEATS [POINTS]]
//! ```
//! REPEATS (250) measurements of POINTS (1200) of each of three shapes with each of four kinds of error. Every one has a form, a place and a scatter of
//! its own. Intervals are said with 95 %; where there is no form, PV and RMS are upper bounds. Behind it stands how wide they are, in the widths of
//! who knows the true covariance of form and scatter beforehand, and which points are outliers.

use nalgebra::{DMatrix, DVector, SymmetricEigen, Vector6};
use rayon::prelude::*;
use regrind::geometry::{Point, Pose};
use regrind::model::{Form, Given, Interval};
use regrind::registration::{Deviation, Options, PointStatus, Registration, Start, register};
use regrind::surface::{Nominal, Projection};
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, add_noise, centre};
use regrind_sim::shape::{FreeForm, Shape, Wave, XyPolynomial};
use regrind_sim::{Rng, Vec3};

const RADIUS_MM: f64 = 1.5;
const SCATTER_MM: f64 = 3e-4;
const HALF_MM: [f64; 2] = [48.0, 28.0];
const CORRELATION_MM: f64 = 30.0;

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

/// Whether what was said of one measurement is true, and how wide it is.
struct Held {
    rms: bool,
    pv: bool,
    /// Share of the points whose interval holds the form there.
    points: f64,
    /// Of the six coordinates of the frame.
    pose: [bool; 6],
    /// The widths of RMS, PV, form and pose, and those of who knows the field.
    widths: [[f64; 4]; 2],
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
    println!(
        "{:18}{:18}{:>8}{:>8}{:>8}{:>8}    width, in those of who knows the field",
        "", "", "RMS", "PV", "form", "pose"
    );
    for (name, shape) in &shapes {
        let nominal = nominal(shape.as_ref());
        for kind in KINDS {
            let best = Best::of(shape.as_ref(), &nominal, kind, points);
            let of = |seed: usize| measured((shape.as_ref(), &nominal), &best, kind, points, seed as u64);
            let held: Vec<Held> = (0..repeats).into_par_iter().map(of).collect();
            let share = |of: &dyn Fn(&Held) -> f64| 100.0 * held.iter().map(of).sum::<f64>() / repeats as f64;
            let pose = |held: &Held| held.pose.iter().filter(|held| **held).count() as f64 / 6.0;
            let [rms, pv] = [share(&|held| f64::from(held.rms)), share(&|held| f64::from(held.pv))];
            let (form, pose) = (share(&|held| held.points), share(&pose));
            print!("{name:18}{:18}{rms:8.1}{pv:8.1}{form:8.1}{pose:8.1}", kind.name);
            let ratio = |k: usize| share(&|held| held.widths[0][k]) / share(&|held| held.widths[1][k]);
            let ratios =
                (0..4).map(|k| if kind.form_rms_mm > 0.0 { format!("{:8.2}", ratio(k)) } else { String::new() });
            println!("    {}", ratios.collect::<String>());
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

/// The error of the form of a kind.
fn drawn(kind: Kind, seed: u64) -> FormError {
    if kind.form_rms_mm == 0.0 {
        return FormError::none();
    }
    FormError::with_rms(&mut regrind_sim::rng(seed), CORRELATION_MM, kind.form_rms_mm)
}

fn measured((shape, nominal): (&dyn Shape, &Nominal), best: &Best, kind: Kind, count: usize, seed: u64) -> Held {
    let mut rng = regrind_sim::rng(1_000_000 + seed);
    let form = drawn(kind, seed);
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
    let width = |of: Interval| of.high_mm - of.low_mm;
    let widths = [
        width(told.figures.rms),
        width(told.figures.pv),
        told.points.iter().map(|at| at.form.sigma_mm).sum::<f64>() / told.points.len() as f64,
        (0..6).map(|k| told.frame_covariance[(k, k)].sqrt() / best.pose[k]).sum::<f64>() / 6.0,
    ];
    let off = Vector6::from_iterator((truth.inverse() * found.cmm_from_model).log().iter().copied());
    Held {
        rms: holds(told.figures.rms, rms),
        pv: holds(told.figures.pv, planted.max() - planted.min()),
        points: told.points.iter().zip(planted.iter()).filter(|pair| near(*pair)).count() as f64 / n,
        pose: std::array::from_fn(|k| off[k].abs() <= 1.96 * told.frame_covariance[(k, k)].sqrt()),
        widths: [widths, best.widths(&form, seed)],
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

/// Who knows how form and scatter vary, and from how far points are to be taken; not what they are.
struct Best {
    places: Vec<[f64; 2]>,
    /// The motions of the part at the points, orthonormal.
    base: DMatrix<f64>,
    /// Takes deviations after their best fit to the form, and independent normal numbers to what is not known of it.
    gain: DMatrix<f64>,
    unknown: DMatrix<f64>,
    /// Takes normal numbers to a scatter.
    scatter: DMatrix<f64>,
    form_sigma_mm: f64,
    /// Standard uncertainties of the place of the nominal frame, as who fits by least squares finds it.
    pose: [f64; 6],
}

impl Best {
    fn of(shape: &dyn Shape, nominal: &Nominal, kind: Kind, count: usize) -> Self {
        let clean = Kind { form_rms_mm: 0.0, outliers: 0.0, ..kind };
        let here = Placement::new([0.0; 3], [0.0; 3]);
        let cloud = touched(shape, &FormError::none(), &here, clean, count, &mut regrind_sim::rng(0));
        let options = Options { start: Start::Pose(pose(&here)), ..Options::new(RADIUS_MM) };
        let found = register(nominal, &cloud, &options).expect("a registration");
        let all: Vec<&Deviation> = found.deviations.iter().collect();
        let (n, motions) = (all.len(), motions(&all));
        let places: Vec<[f64; 2]> = all.iter().map(|d| [d.point.x, d.point.y]).collect();
        let field = DMatrix::from_fn(n, n, |r, c| {
            let apart_mm = (places[r][0] - places[c][0]).hypot(places[r][1] - places[c][1]);
            kind.form_rms_mm.powi(2) * (-(apart_mm / CORRELATION_MM).powi(2)).exp()
        });
        let noise = DMatrix::from_fn(n, n, |r, c| match r.abs_diff(c) {
            0 => SCATTER_MM.powi(2),
            steps => SCATTER_MM.powi(2) * kind.drift.powi(steps as i32),
        });
        let fit = motions.clone().pseudo_inverse(1e-14).expect("motions");
        let place = &fit * (&field + &noise) * fit.transpose();
        let base = motions.qr().q();
        let fitted = |of: &DMatrix<f64>| {
            let rows: DMatrix<f64> = of - &base * base.tr_mul(of);
            &rows - (&rows * &base) * base.transpose()
        };
        let [form, noise_left] = [fitted(&field), fitted(&noise)];
        // What the fit took has a variance of its own, and nothing to do with the rest.
        let all = &form + &noise_left + &base * base.transpose() * SCATTER_MM.powi(2);
        let gain = all.cholesky().expect("a covariance").solve(&form).transpose();
        let unknown = root(&form - &gain * &form);
        Self {
            form_sigma_mm: unknown.row_iter().map(|row| row.norm()).sum::<f64>() / n as f64,
            scatter: root(noise),
            pose: std::array::from_fn(|k| place[(k, k)].sqrt()),
            places,
            base,
            gain,
            unknown,
        }
    }

    /// The widths of RMS, PV and form that are told of another measurement of the same part, and 1 for the pose.
    fn widths(&self, form: &FormError, seed: u64) -> [f64; 4] {
        const DRAWN: usize = 500;
        let mut rng = regrind_sim::rng(2_000_000 + seed);
        let mut normal = |rows: usize, columns: usize| {
            let mut drawn = vec![[0.0; 3]; (rows * columns).div_ceil(3)];
            add_noise(&mut rng, &mut drawn, 1.0);
            DMatrix::from_iterator(rows, columns, drawn.into_iter().flatten().take(rows * columns))
        };
        let planted = self.places.iter().map(|[x, y]| form.height(*x, *y));
        let seen = DVector::from_iterator(self.places.len(), planted)
            + &self.scatter * normal(self.scatter.ncols(), 1).column(0);
        let told = &self.gain * (&seen - &self.base * self.base.tr_mul(&seen));
        let forms = &self.unknown * normal(self.unknown.ncols(), DRAWN);
        let figures = forms.column_iter().map(|unknown| {
            let form = &told + unknown;
            [(form.norm_squared() / form.len() as f64).sqrt(), form.max() - form.min()]
        });
        let figures: Vec<[f64; 2]> = figures.collect();
        let width = |k: usize| {
            let mut values: Vec<f64> = figures.iter().map(|of| of[k]).collect();
            values.sort_by(f64::total_cmp);
            let at = |share: f64| values[(share * (DRAWN - 1) as f64).round() as usize];
            at(0.975) - at(0.025)
        };
        [width(0), width(1), self.form_sigma_mm, 1.0]
    }
}

/// A matrix that gives a covariance times its own transpose, as narrow as it can be.
fn root(covariance: DMatrix<f64>) -> DMatrix<f64> {
    let SymmetricEigen { eigenvalues, eigenvectors } = covariance.symmetric_eigen();
    let largest = eigenvalues.max();
    let seen: Vec<usize> = (0..eigenvalues.len()).filter(|&k| eigenvalues[k] > 1e-9 * largest).collect();
    let scales = DVector::from_iterator(seen.len(), seen.iter().map(|&k| eigenvalues[k].sqrt()));
    eigenvectors.select_columns(&seen) * DMatrix::from_diagonal(&scales)
}

/// The planted form at the points used, after its own best fit.
fn after_best_fit(form: &FormError, found: &Registration) -> DVector<f64> {
    let used: Vec<_> = found.deviations.iter().filter(|d| d.status == PointStatus::Used).collect();
    let planted = DVector::from_iterator(used.len(), used.iter().map(|d| form.height(d.point.x, d.point.y)));
    let base = motions(&used).qr().q();
    &planted - &base * base.tr_mul(&planted)
}

/// What a unit of each coordinate of the twist adds to the distance of each point from the surface.
fn motions(of: &[&Deviation]) -> DMatrix<f64> {
    DMatrix::from_fn(of.len(), 6, |r, c| {
        let arm = of[r].point.coords.cross(&of[r].normal);
        [of[r].normal.x, of[r].normal.y, of[r].normal.z, arm.x, arm.y, arm.z][c]
    })
}

fn pose(placement: &Placement) -> Pose {
    let [r, t] = [&placement.rotation, &[placement.translation_mm; 3]];
    let row = |k: usize| [r[k][0], r[k][1], r[k][2], t[0][k]];
    Pose::from_rows([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]).expect("a pose")
}
