//! Coverage of the intervals for form figures: simulated measurements compared with the planted truth.
//!
//! ```text
//! cargo run --release --example intervals [PARTS [POINTS [WORD]]]
//! ```
//! Each line simulates PARTS (400) parts, each with its own form, pose and noise. Each part is touched at POINTS (400)
//! of a free form of 60 x 40 mm, with noise of 0.3 um. WORD selects the lines whose names contain it. The figures are
//! the RMS and the PV of the touched points and the PV 99.8 % of the aperture. For each figure, the table gives the
//! percentage of 95 % intervals that contain the truth and the percentage of intervals that lie below it.
//! Then follows the median width of the intervals, relative to the median of the true figures. The last two columns
//! give how often a part was accepted, at a risk of 2.5 %, against a limit that is 5 % below its true figure.

use std::f64::consts::{PI, TAU};

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use regrind::figures::{Interval, statistics};
use regrind::geometry::{Point, Pose};
use regrind::model::{DecisionBounds, Form, ModelInputs};
use regrind::registration::{Deviation, PointStatus, RegistrationOptions, Start, register};
use regrind::surface::{Nominal, PlaneProjection};
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, add_noise};
use regrind_sim::shape::{FreeForm, Shape};
use regrind_sim::{Rng, Vec3};

const RADIUS_MM: f64 = 1.5;
const SCATTER_MM: f64 = 3e-4;
const HALF_MM: [f64; 2] = [30.0, 20.0];

/// Planted form, with an RMS of 1.
#[derive(Clone, Copy)]
enum Truth {
    /// Random field with a Gaussian correlation of 20 mm.
    Field,
    /// Zernike polynomials 4 to 15 over the circle around the part.
    Zernike,
    /// One bump, 8 mm wide.
    Bump,
    /// Random field with an exponential correlation of 20 mm.
    Exponential,
    /// Waves in any direction, with this length in mm.
    Waves(f64),
    /// Ridges, 4 mm wide.
    Ridges,
}

#[derive(Clone, Copy, PartialEq)]
enum Pattern {
    Grid,
    Spiral,
    Random,
    Radial,
    Lines,
    MissingQuarter,
}

#[derive(Clone, Copy, PartialEq)]
enum Noise {
    Normal,
    Drift,
    Laplace,
    Student,
    /// Two touches of a hundred are off by 10 to 100 times the noise. Each rejected touch
    /// is repeated once, with the same chance.
    Outliers,
}

#[derive(Clone, Copy)]
struct Line {
    name: &'static str,
    truth: Truth,
    ratio: f64,
    pattern: Pattern,
    noise: Noise,
}

fn lines() -> Vec<Line> {
    let plain = |name, truth, ratio| Line { name, truth, ratio, pattern: Pattern::Grid, noise: Noise::Normal };
    let on = |name, pattern| Line { pattern, ..plain(name, Truth::Field, 1.0) };
    let beside = |name, noise| Line { noise, ..plain(name, Truth::Field, 1.0) };
    vec![
        plain("no form", Truth::Field, 0.0),
        plain("field", Truth::Field, 0.25),
        plain("field", Truth::Field, 0.5),
        plain("field", Truth::Field, 1.0),
        plain("field", Truth::Field, 2.0),
        plain("field", Truth::Field, 5.0),
        plain("field", Truth::Field, 15.0),
        plain("zernike", Truth::Zernike, 0.5),
        plain("zernike", Truth::Zernike, 2.0),
        plain("zernike", Truth::Zernike, 15.0),
        plain("bump", Truth::Bump, 0.5),
        plain("bump", Truth::Bump, 2.0),
        plain("exponential", Truth::Exponential, 0.5),
        plain("exponential", Truth::Exponential, 2.0),
        plain("waves of 12 mm", Truth::Waves(12.0), 2.0),
        plain("ridges of 4 mm", Truth::Ridges, 2.0),
        beside("drift", Noise::Drift),
        beside("laplace", Noise::Laplace),
        beside("student t3", Noise::Student),
        beside("2 % outliers", Noise::Outliers),
        on("spiral", Pattern::Spiral),
        on("random", Pattern::Random),
        on("radial", Pattern::Radial),
        on("scan lines", Pattern::Lines),
        on("missing quarter", Pattern::MissingQuarter),
    ]
}

fn main() {
    let argument = |k: usize| std::env::args().nth(k);
    let number = |k: usize, otherwise: usize| argument(k).map_or(otherwise, |n| n.parse().expect("a number"));
    let (parts, points, word) = (number(1, 400), number(2, 400), argument(3).unwrap_or_default());
    let nominal = nominal();
    println!("{parts} parts a line, {points} points: held and below the truth of 100, median width over median truth");
    println!("{:18}{:>6}{:>27}{:>27}{:>27}{:>14}", "", "ratio", "RMS", "PV touched", "PV 99.8 % aperture", "accepted");
    for line in lines().into_iter().filter(|line| line.name.contains(&word)) {
        let of = |seed: usize| figures_and_intervals(&nominal, line, points, seed as u64);
        let all: Vec<[Estimated; 3]> = (0..parts).into_par_iter().filter_map(of).collect();
        print!("{:18}{:6}", line.name, line.ratio);
        for k in 0..3 {
            let share = |is: &dyn Fn(&Estimated) -> bool| {
                100.0 * all.iter().filter(|of| is(&of[k])).count() as f64 / all.len() as f64
            };
            let held = share(&|(truth, of, _)| (of.low_mm..=of.high_mm).contains(truth));
            let above = share(&|(truth, of, _)| *truth > of.high_mm);
            let width = median(all.iter().map(|of| of[k].1.high_mm - of[k].1.low_mm));
            let truth = median(all.iter().map(|of| of[k].0));
            print!("{held:9.1}{above:6.1}{:8.2}{:4}", width / truth.max(SCATTER_MM / 10.0), "");
        }
        let accepted = |k: usize| {
            let is = |of: &&[Estimated; 3]| of[k].2.acceptance_mm <= of[k].0 / 1.05;
            100.0 * all.iter().filter(is).count() as f64 / all.len() as f64
        };
        println!("{:8.1}{:6.1}", accepted(0), accepted(2));
    }
}

fn median(of: impl Iterator<Item = f64>) -> f64 {
    statistics::median(&mut of.collect::<Vec<f64>>()).expect("a part")
}

fn nominal() -> Nominal {
    let shape = FreeForm::default();
    let grid = shape.grid(2.0 * HALF_MM[0] + 6.0, 2.0 * HALF_MM[1] + 6.0, 265, 185);
    Nominal::from_points(grid.into_iter().map(Point::from).collect(), PlaneProjection::Auto).expect("a surface")
}

/// True figure of a part in mm, with its estimated interval and bounds.
type Estimated = (f64, Interval, DecisionBounds);

/// Returns the true figures of a part and what was estimated for them.
fn figures_and_intervals(nominal: &Nominal, line: Line, points: usize, seed: u64) -> Option<[Estimated; 3]> {
    let mut rng = regrind_sim::rng(1_000_000 + seed);
    let shape = FreeForm::default();
    let places = places(line.pattern, points, &mut rng);
    let form = planted(line.truth, &places, line.ratio * SCATTER_MM, &mut rng);
    let placement = Placement::new([1.0, -2.0, 0.5], [0.3, -0.2, 0.5]);
    let noise = scatter(line.noise, places.len(), &mut rng);
    let touch = |(&[x, y], noise): (&[f64; 2], &Vec3)| {
        let (on, normal) = (shape.point(x, y), shape.normal(x, y));
        let away = RADIUS_MM + form(x, y);
        let seen = placement.apply(std::array::from_fn(|k| on[k] + away * normal[k]));
        Point::from(std::array::from_fn::<f64, 3, _>(|k| seen[k] + noise[k]))
    };
    let mut cloud: Vec<Point> = places.iter().zip(&noise).map(touch).collect();
    let options = RegistrationOptions { start: Start::Pose(pose(&placement)), ..RegistrationOptions::new(RADIUS_MM) };
    let mut found = register(nominal, &cloud, &options).ok()?;
    if line.noise == Noise::Outliers {
        let again = scatter(line.noise, places.len(), &mut rng);
        let left_out = (0..places.len()).filter(|k| found.deviations[*k].status == PointStatus::Outlier);
        left_out.for_each(|k| cloud[k] = touch((&places[k], &again[k])));
        found = register(nominal, &cloud, &options).ok()?;
    }
    let told = Form::estimate(&found, &ModelInputs::default()).ok()?;
    // The same part without noise, at the registered pose: a tilt moves the projections, and on strong forms this
    // effect is not of first order.
    let held = RegistrationOptions { start: Start::Pose(found.cmm_from_model), locked: [true; 6], ..options };
    let true_at = |places: &[[f64; 2]]| {
        let cloud: Vec<Point> = places.iter().map(|place| touch((place, &[0.0; 3]))).collect();
        Some(register(nominal, &cloud, &held).ok()?.deviations)
    };
    let heights = |of: &[Deviation]| DVector::from_iterator(of.len(), of.iter().map(|d| d.deviation_mm));
    let used = found.deviations.iter().zip(&places).filter(|(d, _)| d.status == PointStatus::Inlier);
    let touched = true_at(&used.map(|(_, place)| *place).collect::<Vec<_>>())?;
    let factor = motions(&touched).qr();
    let moved = factor.r().solve_upper_triangular(&factor.q().tr_mul(&heights(&touched)))?;
    let after_best_fit = |of: &[Deviation]| heights(of) - motions(of) * &moved;
    let left = after_best_fit(&touched);
    let rms = (left.norm_squared() / left.len() as f64).sqrt();
    // The aperture: the whole area that the points enclose.
    const ACROSS: usize = 160;
    let step_mm = 2.0 * HALF_MM[0] / ACROSS as f64;
    let reach_mm = (4.0 * HALF_MM[0] * HALF_MM[1] / places.len() as f64).sqrt();
    let near = |[x, y]: [f64; 2]| places.iter().any(|at| (at[0] - x).hypot(at[1] - y) < reach_mm);
    let inside = |[x, y]: [f64; 2]| match line.pattern {
        Pattern::MissingQuarter => x < 0.0 || y < 0.0,
        Pattern::Spiral | Pattern::Radial => (x / HALF_MM[0]).hypot(y / HALF_MM[1]) < 1.0,
        Pattern::Random => near([x, y]),
        _ => true,
    };
    let all = (0..=ACROSS).flat_map(|i| (0..=ACROSS * 2 / 3).map(move |j| [i, j]));
    let all = all.map(|at| [0, 1].map(|k: usize| at[k] as f64 * step_mm - HALF_MM[k])).filter(|at| inside(*at));
    let mut between: Vec<f64> = after_best_fit(&true_at(&all.collect::<Vec<_>>())?).iter().copied().collect();
    between.sort_by(f64::total_cmp);
    let left_out = between.len() / 1000;
    // No touched place is left out.
    let aperture = between[between.len() - 1 - left_out].max(left.max()) - between[left_out].min(left.min());
    let pv = left.max() - left.min();
    let (figures, bounds) = (told.figures, told.bounds);
    Some([(rms, figures.rms, bounds.rms), (pv, figures.pv, bounds.pv), (aperture, figures.pv_998, bounds.pv_998)])
}

fn places(pattern: Pattern, count: usize, rng: &mut Rng) -> Vec<[f64; 2]> {
    let [a, b] = HALF_MM;
    let n = count as f64;
    let grid = |columns: usize, rows: usize| {
        let at = move |k: usize| {
            let (row, place) = (k / columns, k % columns);
            let column = if row.is_multiple_of(2) { place } else { columns - 1 - place };
            [(column, columns, a), (row, rows, b)]
                .map(|(k, count, half)| half * (2.0 * k as f64 / (count - 1) as f64 - 1.0))
        };
        (0..columns * rows).map(at).collect::<Vec<_>>()
    };
    match pattern {
        Pattern::Grid => {
            grid((n * 1.5).sqrt().round() as usize, n.sqrt().mul_add(1.0 / 1.5f64.sqrt(), 0.0).round() as usize)
        }
        Pattern::Lines => grid(count / 8, 8),
        Pattern::MissingQuarter => {
            let n = n * 4.0 / 3.0;
            grid((n * 1.5).sqrt().round() as usize, (n / 1.5).sqrt().round() as usize)
                .into_iter()
                .filter(|[x, y]| *x < 0.0 || *y < 0.0)
                .collect()
        }
        Pattern::Spiral => {
            let turns = (n / PI).sqrt();
            let of = |k: usize| {
                let r = ((k as f64 + 0.5) / n).sqrt();
                let angle = TAU * turns * r;
                [a * r * angle.cos(), b * r * angle.sin()]
            };
            (0..count).map(of).collect()
        }
        Pattern::Radial => {
            let spokes = (n.sqrt() * 1.2) as usize;
            let a_spoke = count / spokes;
            let of = |k: usize| {
                let (angle, r) =
                    (TAU * (k / a_spoke) as f64 / spokes as f64, ((k % a_spoke) as f64 + 0.5) / a_spoke as f64);
                [a * r * angle.cos(), b * r * angle.sin()]
            };
            (0..spokes * a_spoke).map(of).collect()
        }
        Pattern::Random => {
            let u = uniforms(rng, 2 * count);
            (0..count).map(|k| [a * (2.0 * u[2 * k] - 1.0), b * (2.0 * u[2 * k + 1] - 1.0)]).collect()
        }
    }
}

fn normals(rng: &mut Rng, count: usize) -> Vec<f64> {
    let mut drawn = vec![[0.0; 3]; count.div_ceil(3)];
    add_noise(rng, &mut drawn, 1.0);
    drawn.into_iter().flatten().take(count).collect()
}

fn uniforms(rng: &mut Rng, count: usize) -> Vec<f64> {
    let z = normals(rng, 2 * count);
    (0..count).map(|k| (z[2 * k].atan2(z[2 * k + 1]) / TAU).rem_euclid(1.0)).collect()
}

/// Returns the noise that is added to each coordinate of a touch.
fn scatter(noise: Noise, count: usize, rng: &mut Rng) -> Vec<Vec3> {
    const DRIFT: f64 = 0.7;
    let mut last = [0.0; 3];
    let mut one = || -> Vec3 {
        let z = normals(rng, 12);
        let off = match noise {
            Noise::Outliers => Some(uniforms(rng, 2)).filter(|u| u[0] < 0.02).map_or(0.0, |u| 10.0 + 90.0 * u[1]),
            _ => 0.0,
        };
        let of = |k: usize| match noise {
            Noise::Normal => z[k],
            Noise::Drift => DRIFT * last[k] + (1.0 - DRIFT * DRIFT).sqrt() * z[k],
            // A normal number times the root of an exponential one, or divided by the root of a chi-squared one.
            Noise::Laplace => z[k] * ((z[k + 3].powi(2) + z[k + 6].powi(2)) / 2.0).sqrt(),
            // Along the direction of the touch.
            Noise::Outliers => z[k] + if k == 2 { off * z[3].signum() } else { 0.0 },
            Noise::Student => z[k] / (z[k + 3].powi(2) + z[k + 6].powi(2) + z[k + 9].powi(2)).sqrt(),
        };
        last = std::array::from_fn(of);
        last.map(|of| SCATTER_MM * of)
    };
    (0..count).map(|_| one()).collect()
}

/// Returns a form with the given RMS at the places, after its mean is subtracted.
fn planted(truth: Truth, places: &[[f64; 2]], rms_mm: f64, rng: &mut Rng) -> Box<dyn Fn(f64, f64) -> f64> {
    if rms_mm == 0.0 {
        return Box::new(|_, _| 0.0);
    }
    let form: Box<dyn Fn(f64, f64) -> f64> = match truth {
        Truth::Field => {
            let field = FormError::with_rms(rng, 20.0, 1.0);
            Box::new(move |x, y| field.height(x, y))
        }
        Truth::Zernike => {
            let (z, radius) = (normals(rng, 12), HALF_MM[0].hypot(HALF_MM[1]));
            Box::new(move |x, y| {
                let (r, t) = (x.hypot(y) / radius, y.atan2(x));
                let (r2, r3, r4) = (r * r, r.powi(3), r.powi(4));
                let of = [
                    2.0 * r2 - 1.0,
                    r2 * (2.0 * t).cos(),
                    r2 * (2.0 * t).sin(),
                    (3.0 * r3 - 2.0 * r) * t.cos(),
                    (3.0 * r3 - 2.0 * r) * t.sin(),
                    r3 * (3.0 * t).cos(),
                    r3 * (3.0 * t).sin(),
                    6.0 * r4 - 6.0 * r2 + 1.0,
                    (4.0 * r4 - 3.0 * r2) * (2.0 * t).cos(),
                    (4.0 * r4 - 3.0 * r2) * (2.0 * t).sin(),
                    r4 * (4.0 * t).cos(),
                    r4 * (4.0 * t).sin(),
                ];
                of.iter().zip(&z).map(|(of, z)| of * z).sum()
            })
        }
        Truth::Bump => {
            let u = uniforms(rng, 2);
            let at = [0, 1].map(|k| 0.8 * HALF_MM[k] * (2.0 * u[k] - 1.0));
            // 8 mm wide at half of its height.
            Box::new(move |x, y| (-(2.0f64.ln()) * ((x - at[0]).powi(2) + (y - at[1]).powi(2)) / 16.0).exp())
        }
        Truth::Exponential => {
            // Plane waves whose wave numbers follow the spectral density of exp(-r / 20): the direction of three normal
            // numbers.
            let waves: Vec<[f64; 3]> = (0..400)
                .map(|_| {
                    let (z, u) = (normals(rng, 3), uniforms(rng, 1));
                    let by = 1.0 / (20.0 * z[2].abs().max(1e-9));
                    [z[0] * by, z[1] * by, TAU * u[0]]
                })
                .collect();
            Box::new(move |x, y| waves.iter().map(|[a, b, phase]| (a * x + b * y + phase).cos()).sum())
        }
        Truth::Waves(length_mm) => {
            let u = uniforms(rng, 2);
            let (c, s) = ((PI * u[0]).cos() * TAU / length_mm, (PI * u[0]).sin() * TAU / length_mm);
            let phase = TAU * u[1];
            Box::new(move |x, y| (c * x + s * y + phase).cos())
        }
        Truth::Ridges => {
            // Three ridges, each 4 mm wide at half of its height and as long as the part.
            let u = uniforms(rng, 6);
            let of: Vec<[f64; 3]> = (0..3)
                .map(|k| {
                    let angle = PI * u[2 * k];
                    [angle.cos(), angle.sin(), 0.6 * HALF_MM[1] * (2.0 * u[2 * k + 1] - 1.0)]
                })
                .collect();
            Box::new(move |x, y| {
                of.iter().map(|[c, s, at]| (-(2.0f64.ln()) * (c * x + s * y - at).powi(2) / 4.0).exp()).sum()
            })
        }
    };
    let heights: Vec<f64> = places.iter().map(|[x, y]| form(*x, *y)).collect();
    let mean = heights.iter().sum::<f64>() / heights.len() as f64;
    let rms = (heights.iter().map(|h| (h - mean).powi(2)).sum::<f64>() / heights.len() as f64).sqrt();
    Box::new(move |x, y| form(x, y) * rms_mm / rms)
}

/// Returns the change in each point's distance from the surface per unit of each coordinate of the twist.
fn motions(of: &[Deviation]) -> DMatrix<f64> {
    let rows: Vec<[f64; 6]> = of
        .iter()
        .map(|d| {
            let arm = d.point.coords.cross(&d.normal) / HALF_MM[0];
            [d.normal.x, d.normal.y, d.normal.z, arm.x, arm.y, arm.z]
        })
        .collect();
    DMatrix::from_fn(rows.len(), 6, |r, c| rows[r][c])
}

fn pose(placement: &Placement) -> Pose {
    let [r, t] = [&placement.rotation, &[placement.translation_mm; 3]];
    let row = |k: usize| [r[k][0], r[k][1], r[k][2], t[0][k]];
    Pose::from_rows([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]).expect("a pose")
}
