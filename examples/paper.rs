//! Repeats sections 3 and 4 of the paper on a simulated free-form mirror: the numbers as a table, the figures as files.
//!
//! ```text
//! cargo run --release --example paper
//! ```
//!
//! The figures are written to `target/paper/`. The picture in docs/figures.md was made by this program and `cp
//! target/paper/fig11b.svg docs/error-map.svg`.
//!
//! The surface, its normals, the form errors and the contact of the probe come from `regrind-sim` in closed form. That
//! crate shares no code with the registration. The paper's own part is not published. The simulated part has its size,
//! slopes and sampling.

use std::error::Error;
use std::f64::consts::TAU;
use std::fs;
use std::path::Path;
use std::time::Instant;

use nabo::{KDTree, NotNan};
use nalgebra::{Matrix6, Vector6};
use rayon::prelude::*;
use regrind::figures::statistics::rms;
use regrind::geometry::{Point, Pose, Twist, Vector, fit_rigid};
use regrind::registration::{
    Deviation, Method, PointStatus, ProbeSide, Registration, RegistrationError, RegistrationOptions, Start, register,
};
use regrind::report::{Axis, ColourMap, HeatMap, Plot, Scale, Series};
use regrind::surface::{DistanceModel, FacetIndex, Nominal, OffsetSurface, PlaneProjection, Side};
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, centre};
use regrind_sim::shape::{FreeForm, Shape};

type Outcome<T = ()> = Result<T, Box<dyn Error>>;

const PROBE_RADIUS_MM: f64 = 1.5;
const CORRELATION_LENGTH_MM: f64 = 30.0;
/// Measured area, in mm. It ends inside the part's edge by the lateral offset of a probe, so that form error cannot
/// push a projection over the edge.
const MEASURED_MM: [f64; 2] = [101.9, 61.9];

fn main() -> Outcome {
    let started = Instant::now();
    let figures = Path::new("target/paper");
    fs::create_dir_all(figures)?;
    println!("{:<66} | {:>18} | here", "what", "paper");

    shape_of_the_surface(figures)?;
    validity_of_the_distance(figures)?;
    let nominal = nominal(FreeForm::PAPER_GRID)?;
    row("nominal points", "451401", nominal.len());
    robustness(&nominal, figures)?;
    let after = corrective_grinding(&nominal, figures)?;
    closest_points(&nominal, &after)?;
    equivalence(&nominal, &after, figures)?;
    subtracting_the_radius(&nominal, &after, figures)?;

    println!("\n{:.1} s; the figures are in {}", started.elapsed().as_secs_f64(), figures.display());
    Ok(())
}

fn row(what: &str, paper: &str, here: impl std::fmt::Display) {
    println!("{what:<66} | {paper:>18} | {here}");
}

fn heading(title: &str) {
    println!("--- {title}");
}

/// Samples the free form on a grid that covers it.
fn nominal((columns, rows): (usize, usize)) -> Outcome<Nominal> {
    let points = FreeForm::default().grid(FreeForm::WIDTH_MM, FreeForm::DEPTH_MM, columns, rows);
    Ok(Nominal::from_points(points.into_iter().map(Point::from).collect(), PlaneProjection::Auto)?)
}

/// Returns the nodes of a grid over a rectangle centred on the origin, row by row, x fastest.
fn nodes(columns: usize, rows: usize, [width, depth]: [f64; 2]) -> Vec<[f64; 2]> {
    let at = |i: usize, n: usize, size: f64| size * (i as f64 / (n - 1) as f64 - 0.5);
    (0..rows).flat_map(|j| (0..columns).map(move |i| [at(i, columns, width), at(j, rows, depth)])).collect()
}

fn pv(values: impl Iterator<Item = f64>) -> f64 {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    high - low
}

/// Draws figures 4 and 5: the surface, its slope and its Gaussian curvature.
fn shape_of_the_surface(figures: &Path) -> Outcome {
    heading("section 3: the surface");
    let shape = FreeForm::default();
    let places = nodes(481, 293, [FreeForm::WIDTH_MM, FreeForm::DEPTH_MM]);
    let slope = |x: f64, y: f64| {
        let [p, q] = shape.gradient(x, y);
        p.hypot(q).atan().to_degrees() // eq. (16), as an angle
    };
    let curvature = |x: f64, y: f64| {
        const H: f64 = 1e-3;
        let along = |dx: f64, dy: f64| {
            let (a, b) = (shape.gradient(x + dx, y + dy), shape.gradient(x - dx, y - dy));
            [(a[0] - b[0]) / (2.0 * H), (a[1] - b[1]) / (2.0 * H)]
        };
        let ([zxx, zxy], [_, zyy]) = (along(H, 0.0), along(0.0, H));
        let [p, q] = shape.gradient(x, y);
        1e6 * (zxx * zyy - zxy * zxy) / (1.0 + p * p + q * q).powi(2)
    };
    let sampled =
        |f: &dyn Fn(f64, f64) -> f64| -> Vec<[f64; 3]> { places.iter().map(|&[x, y]| [x, y, f(x, y)]).collect() };
    let height = sampled(&|x, y| shape.height(x, y));
    let (slope, curvature) = (sampled(&slope), sampled(&curvature));
    let sequential = |title: &str, quantity: &str, unit: &str, samples: &[[f64; 3]]| {
        HeatMap::new(title, quantity, unit, samples).map(|m| m.with_colours(ColourMap::Sequential))
    };
    sequential("Nominal surface (fig. 4)", "height", "mm", &height)?.save_svg(&figures.join("fig4.svg"))?;
    sequential("Slope (fig. 5a)", "slope", "°", &slope)?.save_svg(&figures.join("fig5a.svg"))?;
    HeatMap::new("Gaussian curvature (fig. 5b)", "curvature", "m⁻²", &curvature)?
        .save_svg(&figures.join("fig5b.svg"))?;
    let steepest = slope.iter().map(|s| s[2]).fold(0.0, f64::max);
    row("steepest slope / degrees", "fig. 5a", format!("{steepest:.1}"));
    row("Gaussian curvature, PV / m^-2", "fig. 5b", format!("{:.0}", pv(curvature.iter().map(|s| s[2]))));
    Ok(())
}

/// Returns one place in each cell of a grid over the part, evenly distributed over all positions within a cell.
fn places_in_cells(columns: usize, rows: usize) -> Vec<[f64; 2]> {
    // Steps of the plastic number (R2 sequence): the most even sequence known in two dimensions.
    let within = |k: usize, step: f64| (0.5 + k as f64 * step).fract();
    let at = |i: usize, t: f64, n: usize, size: f64| size * ((i as f64 + t) / n as f64 - 0.5);
    (0..columns * rows)
        .map(|k| {
            let (u, v) = (within(k, 0.754_877_666_246_692_8), within(k, 0.569_840_290_998_053_3));
            [at(k % columns, u, columns, FreeForm::WIDTH_MM), at(k / columns, v, rows, FreeForm::DEPTH_MM)]
        })
        .collect()
}

/// Repeats section 3.1 and figure 6: computes the distance of points whose distance is known.
///
/// There is one point in each cell of the grid, at any position within it. On the nodes of the grid every distance
/// would be exact. The error of flat triangles grows with the curvature and with the square of the spacing. It depends
/// on the position of a point in its cell, which the paper does not give for its own points.
fn validity_of_the_distance(figures: &Path) -> Outcome {
    heading("section 3.1: validity of the distance, grid of 1021 x 1241 points");
    let shape = FreeForm::default();
    let error = FormError::new(6, CORRELATION_LENGTH_MM, 6.657e-3, FreeForm::WIDTH_MM, FreeForm::DEPTH_MM);
    let (columns, rows) = (1021, 1241);
    let nominal = nominal((columns, rows))?;
    let places = places_in_cells(columns - 1, rows - 1);
    let exact: Vec<[f64; 3]> = places.par_iter().map(|&[x, y]| [x, y, error.height(x, y)]).collect();
    row("surface error, PV / um", "6.657", format!("{:.3}", 1e3 * pv(exact.iter().map(|s| s[2]))));
    HeatMap::of_lengths("Surface error put on (fig. 6a)", "error", &exact)?.save_svg(&figures.join("fig6a.svg"))?;

    let cases = [
        (DistanceModel::Triangle, 0.0, "flat", "residual, flat triangles on the nominal surface, PV / nm", "5"),
        (
            DistanceModel::Triangle,
            PROBE_RADIUS_MM,
            "flat-offset",
            "residual, flat triangles on the offset surface, PV / nm",
            "-",
        ),
        (DistanceModel::Curved, 0.0, "curved", "residual, curved triangles on the nominal surface, PV / nm", "-"),
        (
            DistanceModel::Curved,
            PROBE_RADIUS_MM,
            "curved-offset",
            "residual, curved triangles on the offset surface, PV / nm",
            "-",
        ),
    ];
    for (distance, radius_mm, name, what, paper) in cases {
        let surface = OffsetSurface::new(&nominal, radius_mm, Side::Normal)?.with_distance_model(distance);
        let residual = |&[x, y, e]: &[f64; 3]| {
            let (s, n) = (shape.point(x, y), shape.normal(x, y));
            let point = Point::from(std::array::from_fn::<f64, 3, _>(|k| s[k] + (radius_mm + e) * n[k]));
            [x, y, surface.project(&point, FacetIndex::UNKNOWN).distance_mm - e]
        };
        let residuals: Vec<[f64; 3]> = exact.par_iter().map(residual).collect();
        row(what, paper, format!("{:.4}", 1e6 * pv(residuals.iter().map(|s| s[2]))));
        let title = format!("Distance less error put on, {name} (fig. 6b)");
        HeatMap::of_lengths(&title, "residual", &residuals)?.save_svg(&figures.join(format!("fig6b-{name}.svg")))?;
    }
    Ok(())
}

/// Misalignment of section 3.2: name, shifts in millimetres, rotations in degrees.
type Misalignment = (&'static str, [f64; 3], [f64; 3]);

const MISALIGNMENTS: [Misalignment; 8] = [
    ("shift X 20 mm", [20.0, 0.0, 0.0], [0.0; 3]),
    ("shift Y 10 mm", [0.0, 10.0, 0.0], [0.0; 3]),
    ("shift Z 20 mm", [0.0, 0.0, 20.0], [0.0; 3]),
    ("rotation X 20°", [0.0; 3], [20.0, 0.0, 0.0]),
    ("rotation Y 20°", [0.0; 3], [0.0, 20.0, 0.0]),
    ("rotation Z 10°", [0.0; 3], [0.0, 0.0, 10.0]),
    ("all of them", [20.0, 10.0, 20.0], [20.0, 20.0, 10.0]),
    ("all, negated", [-20.0, -10.0, -20.0], [-20.0, -20.0, -10.0]),
];

/// Returns the options of the method as the paper describes it: start from the identity, known side, every point used.
fn as_in_the_paper(distance: DistanceModel) -> RegistrationOptions {
    RegistrationOptions {
        start: Start::Pose(Pose::identity()),
        side: ProbeSide::Above,
        outlier_sigmas: f64::INFINITY,
        distance_model: distance,
        ..RegistrationOptions::new(PROBE_RADIUS_MM)
    }
}

/// Repeats section 3.2 and figures 7 and 8: every fourth point, in both directions, of the offset surface, misaligned.
fn robustness(nominal: &Nominal, figures: &Path) -> Outcome {
    heading("section 3.2: robustness against misalignment, from the identity");
    let places = nodes(226, 126, [FreeForm::WIDTH_MM, FreeForm::DEPTH_MM]);
    let none = FormError::none();
    let exact: Vec<[f64; 3]> =
        places.iter().map(|&[x, y]| centre(&FreeForm::default(), &none, PROBE_RADIUS_MM, x, y)).collect();
    row("measured points", "nominal / 16", exact.len());
    let mut series = Vec::new();
    for (name, shift_mm, degrees) in MISALIGNMENTS {
        let placement = Placement::new(shift_mm, degrees);
        let measured: Vec<Point> = exact.iter().map(|&p| Point::from(placement.apply(p))).collect();
        let options = as_in_the_paper(DistanceModel::Curved);
        let found = register(nominal, &measured, &options)?;
        let flat = register(nominal, &measured, &as_in_the_paper(DistanceModel::Triangle));
        row(&format!("{name}: PV / nm (iterations, objective rises)"), "< 1e-6", in_short(&found));
        row(
            &format!("{name}: the same with flat triangles"),
            "< 1e-6",
            flat.map_or_else(|e| e.to_string(), |f| in_short(&f)),
        );
        let start = (0.0, objective_mm2(nominal, &measured, DistanceModel::Curved)?);
        let taken = found.trace.iter().filter(|i| i.accepted).zip(1..).map(|(i, k)| (f64::from(k), i.objective_mm2));
        series.push(Series {
            name: name.into(),
            points: std::iter::once(start).chain(taken).map(<[f64; 2]>::from).collect(),
        });
    }
    let plot = Plot {
        title: "Registration from the identity (fig. 8)".into(),
        x: Axis { label: "iteration".into(), scale: Scale::Linear },
        y: Axis { label: "objective / mm²".into(), scale: Scale::Log },
        series,
    };
    plot.save_svg(&figures.join("fig8.svg"))?;
    Ok(())
}

fn in_short(found: &Registration) -> String {
    let rises = found.trace.iter().filter(|i| i.accepted).map(|i| i.objective_mm2).collect::<Vec<_>>();
    let rises = rises.windows(2).filter(|w| w[1] > w[0]).count();
    format!("{:.1e} ({}, {rises})", 1e6 * found.quality.pv_mm, found.quality.iterations)
}

/// Returns the objective before any step, in mm²: eq. (7) at the identity.
fn objective_mm2(nominal: &Nominal, measured: &[Point], distance: DistanceModel) -> Outcome<f64> {
    let surface = OffsetSurface::new(nominal, PROBE_RADIUS_MM, Side::Normal)?.with_distance_model(distance);
    Ok(measured.iter().map(|p| surface.project(p, FacetIndex::UNKNOWN).distance_mm.powi(2)).sum())
}

/// Simulated measurement of a ground part on the machine: the planted truth, and the points that the probe reports.
struct Measurement {
    /// Touched places, in the model frame.
    places: Vec<[f64; 2]>,
    /// Form error at these places, in millimetres.
    planted_mm: Vec<f64>,
    /// Planted pose.
    cmm_from_model: Pose,
    /// Probe centres in the frame of the machine.
    centres: Vec<Point>,
    /// Points where the probe's axis met the ground surface, S + e n, in the frame of the machine.
    contacts: Vec<Point>,
}

/// Returns the rotation and translation of eq. (17), as angles about x, y and z, and as a pose.
fn misaligned() -> (Placement, Pose) {
    let translation_mm = [-0.068_855_10, 0.065_761_94, 0.195_463_77];
    let angles_deg = [-8.0055, 1.1274, -0.1656].map(|mrad: f64| mrad * 360.0 / (1e3 * TAU));
    let placement = Placement::new(translation_mm, angles_deg);
    let rotation = nalgebra::Matrix3::from_fn(|i, j| placement.rotation[i][j]);
    (placement, Pose { rotation, translation_mm: Vector::from(translation_mm) })
}

fn measure(error: &FormError) -> Measurement {
    let places = nodes(226, 126, MEASURED_MM);
    let (placement, cmm_from_model) = misaligned();
    let probe = |&[x, y]: &[f64; 2]| placement.apply(centre(&FreeForm::default(), error, PROBE_RADIUS_MM, x, y));
    let centres = places.par_iter().map(|p| Point::from(probe(p))).collect();
    let planted_mm: Vec<f64> = places.iter().map(|&[x, y]| error.height(x, y)).collect();
    let touched = |(&[x, y], e): (&[f64; 2], &f64)| {
        let (s, n) = (FreeForm::default().point(x, y), FreeForm::default().normal(x, y));
        Point::from(placement.apply(std::array::from_fn(|k| s[k] + e * n[k])))
    };
    let contacts = places.iter().zip(&planted_mm).map(touched).collect();
    Measurement { places, planted_mm, cmm_from_model, centres, contacts }
}

/// Computes the result that the best fit must find, from the planted error alone: the rigid motion in it, and the
/// remaining map.
///
/// A fit cannot distinguish a shift or a tilt of the error from one of the part. The motion is the least-squares twist
/// of the linear model n.(v + w x s) on the exact normals. At a few micrometres its second-order terms are below a
/// nanometre.
fn best_fit(measured: &Measurement) -> Option<(Twist, Vec<f64>)> {
    let shape = FreeForm::default();
    let rows: Vec<Vector6<f64>> = measured
        .places
        .iter()
        .map(|&[x, y]| {
            let (n, s) = (Vector::from(shape.normal(x, y)), Vector::from(shape.point(x, y)));
            let m = s.cross(&n);
            Vector6::new(n.x, n.y, n.z, m.x, m.y, m.z)
        })
        .collect();
    let (mut normal, mut right) = (Matrix6::zeros(), Vector6::zeros());
    for (a, e) in rows.iter().zip(&measured.planted_mm) {
        normal += a * a.transpose();
        right += a * *e;
    }
    let twist = normal.cholesky()?.solve(&right);
    let left = rows.iter().zip(&measured.planted_mm).map(|(a, e)| e - a.dot(&twist)).collect();
    Some((twist, left))
}

/// Repeats section 4 and figure 11: measures and registers the first grinding and the compensated one.
fn corrective_grinding(nominal: &Nominal, figures: &Path) -> Outcome<(Measurement, Registration)> {
    heading("section 4: corrective grinding, misaligned as in eq. (17)");
    // The planted error has no shorter waves: those would remain after the correction, which removes only what it can
    // follow.
    let before = measure(&ground(11, CORRELATION_LENGTH_MM, 27.3e-3)?);
    let first = registered(nominal, &before, "before correction", ["27.3", "-"])?;
    let after = measure(&ground(3, 10.0, 6.9e-3)?);
    let second = registered(nominal, &after, "after correction", ["6.9", "1.0"])?;
    for (title, name, found) in [
        ("Surface error before corrective grinding (fig. 11a)", "fig11a", &first),
        ("Surface error after corrective grinding (fig. 11b)", "fig11b", &second),
    ] {
        save(&HeatMap::of_deviations(title, &found.deviations)?, figures, name)?;
    }
    Ok((after, second))
}

/// Returns a form error that has the given peak to valley after the best fit. The rest is shift and tilt, which no fit
/// can distinguish from those of the part.
fn ground(seed: u64, correlation_length_mm: f64, pv_left_mm: f64) -> Outcome<FormError> {
    let of = |pv_mm| FormError::new(seed, correlation_length_mm, pv_mm, FreeForm::WIDTH_MM, FreeForm::DEPTH_MM);
    let (_, left) = best_fit(&measure(&of(pv_left_mm))).ok_or("the part has a symmetry")?;
    Ok(of(pv_left_mm * pv_left_mm / pv(left.into_iter())))
}

fn save(map: &HeatMap, figures: &Path, name: &str) -> Outcome {
    map.save_svg(&figures.join(name).with_extension("svg"))?;
    map.save_png(&figures.join(name).with_extension("png"))?;
    Ok(())
}

fn registered(nominal: &Nominal, measured: &Measurement, when: &str, paper: [&str; 2]) -> Outcome<Registration> {
    let found = register(nominal, &measured.centres, &as_in_the_paper(DistanceModel::Curved))?;
    let (twist, left) = best_fit(measured).ok_or("the part has a symmetry")?;
    let expected = measured.cmm_from_model * Pose::exp(&twist);
    let off = (expected.inverse() * found.cmm_from_model).log();
    let map_off = found.deviations.iter().zip(&left).map(|(d, e)| d.deviation_mm - e);
    let before = objective_mm2(nominal, &measured.centres, DistanceModel::Curved)?;
    let um = |mm: f64| format!("{:.3}", 1e3 * mm);
    row(&format!("{when}: surface error, PV / um"), paper[0], um(found.quality.pv_mm));
    row(&format!("{when}: surface error, RMS / um"), paper[1], um(found.quality.rms_mm));
    row(
        &format!("{when}: objective / mm^2 (iterations)"),
        if when.starts_with("after") { "3.2383 to 0.0566 (2)" } else { "-" },
        format!("{before:.4} to {:.4} ({})", found.quality.objective_mm2, found.quality.iterations),
    );
    row(&format!("{when}: pose against the exact best fit / um, urad"), "-", shift_and_turn(&off));
    row(&format!("{when}: map against the planted one, RMS / nm"), "-", format!("{:.2}", 1e6 * rms(map_off)));
    Ok(found)
}

fn shift_and_turn(twist: &Twist) -> String {
    let shift_um = 1e3 * twist.fixed_rows::<3>(0).norm();
    let turn_urad = 1e6 * twist.fixed_rows::<3>(3).norm();
    format!("{shift_um:.4}, {turn_urad:.4}")
}

/// Repeats the method that section 1 advises against: pairs the centres with the closest points of the offset cloud
/// (Besl and McKay, 1992). The two sampling grids slide along each other.
fn closest_points(nominal: &Nominal, (measured, after): &(Measurement, Registration)) -> Outcome {
    const MAX_TURNS: usize = 500;
    heading("section 1: centres to the closest points of the offset cloud");
    let cloud: Vec<Point> = nominal.offset_points(PROBE_RADIUS_MM).collect();
    let tree = KDTree::new(&cloud.iter().map(Entry::from).collect::<Vec<_>>());
    let (mut pose, mut before, mut turns) = (Pose::identity(), f64::INFINITY, 0);
    loop {
        let inverse = pose.inverse();
        let nearest =
            |y: &Point| tree.knn(1, &Entry::from(&inverse.transform_point(y))).pop().expect("the cloud has points");
        let nearest: Vec<(Point, f64)> =
            measured.centres.par_iter().map(nearest).map(|n| (cloud[n.index as usize], *n.dist2)).collect();
        let objective = nearest.iter().map(|n| n.1).sum::<f64>();
        if 1.0 - objective / before <= 1e-9 || turns == MAX_TURNS {
            break;
        }
        let closest: Vec<Point> = nearest.iter().map(|n| n.0).collect();
        pose = fit_rigid(&closest, &measured.centres)?.pose;
        (before, turns) = (objective, turns + 1);
    }
    let (twist, _) = best_fit(measured).ok_or("the part has a symmetry")?;
    let off = ((measured.cmm_from_model * Pose::exp(&twist)).inverse() * pose).log();
    row(
        &format!("pose against the exact best fit / um, urad ({turns} turns)"),
        "considerable error",
        shift_and_turn(&off),
    );
    let surface = OffsetSurface::new(nominal, PROBE_RADIUS_MM, Side::Normal)?;
    let inverse = pose.inverse();
    let map_off = measured.centres.iter().zip(&after.deviations);
    let map_off = map_off
        .map(|(y, d)| surface.project(&inverse.transform_point(y), FacetIndex::UNKNOWN).distance_mm - d.deviation_mm);
    row("map against the right one, PV / um", "-", format!("{:.3}", 1e3 * pv(map_off)));
    Ok(())
}

/// Point in the form that the tree of closest points requires.
#[derive(Default)]
struct Entry([NotNan<f64>; 3]);

impl From<&Point> for Entry {
    fn from(p: &Point) -> Self {
        Self(<[f64; 3]>::from(*p).map(|c| NotNan::new(c).expect("points are finite")))
    }
}

impl nabo::Point<f64> for Entry {
    const DIM: u32 = 3;

    fn set(&mut self, axis: u32, value: NotNan<f64>) {
        self.0[axis as usize] = value;
    }

    fn get(&self, axis: u32) -> NotNan<f64> {
        self.0[axis as usize]
    }
}

/// Repeats eq. (18) and figure 12a: the contact points found are already aligned with the nominal surface.
fn equivalence(nominal: &Nominal, (measured, after): &(Measurement, Registration), figures: &Path) -> Outcome {
    heading("eq. (18): contact points, registered to the nominal surface");
    let contacts: Vec<Point> = after.deviations.iter().map(|d| d.point).collect();
    let options = RegistrationOptions { method: Method::Contact, ..as_in_the_paper(DistanceModel::Curved) };
    let found = register(nominal, &contacts, &options)?;
    let largest = (found.cmm_from_model.rotation - nalgebra::Matrix3::identity()).amax();
    row(
        "largest entry of the translation / mm",
        "3.7e-5",
        format!("{:.1e}", found.cmm_from_model.translation_mm.amax()),
    );
    row("largest entry of the rotation less the identity", "2.3e-6", format!("{largest:.1e}"));
    row(
        "map against that of the centres, PV / nm",
        "almost identical",
        format!("{:.1e}", 1e6 * maps_apart(&found, after)),
    );
    row("length of the one step tried / rad and cloud sizes (taken)", "-", steps(&found));
    // The second-order error of eq. (6) is visible only against the true contact points, which only the simulation has.
    let truly = register(nominal, &measured.contacts, &options)?;
    row(
        "true contact points: map against that of the centres, PV / nm",
        "second order",
        format!("{:.2}", 1e6 * maps_apart(&truly, after)),
    );
    save(
        &HeatMap::of_deviations("Contact points on the nominal surface (fig. 12a)", &found.deviations)?,
        figures,
        "fig12a",
    )
}

fn steps(found: &Registration) -> String {
    let steps: Vec<String> = found.trace.iter().map(|i| format!("{:.1e} ({})", i.step, i.accepted)).collect();
    if steps.is_empty() { "none to try".into() } else { steps.join(", ") }
}

/// Returns the PV of the difference of two maps, over the points that both used.
fn maps_apart(a: &Registration, b: &Registration) -> f64 {
    let used = |(a, b): &(&Deviation, &Deviation)| a.status == PointStatus::Inlier && b.status == PointStatus::Inlier;
    pv(a.deviations.iter().zip(&b.deviations).filter(used).map(|(a, b)| a.deviation_mm - b.deviation_mm))
}

/// Repeats figure 12b: subtracts the radius from distances to the nominal surface (Xiong and Li), with the triangle
/// looked up below the centre.
fn subtracting_the_radius(
    nominal: &Nominal,
    (measured, after): &(Measurement, Registration),
    figures: &Path,
) -> Outcome {
    heading("fig. 12b: centres on the nominal surface, the radius subtracted");
    for (distance, name) in [(DistanceModel::Triangle, "flat triangles"), (DistanceModel::Curved, "curved triangles")] {
        let options = RegistrationOptions {
            method: Method::SubtractRadius,
            rms_limit_mm: Some(10.0),
            ..as_in_the_paper(distance)
        };
        let found: Result<_, RegistrationError> = register(nominal, &measured.centres, &options);
        let found = match found {
            Ok(found) => found,
            Err(error) => {
                row(&format!("{name}: refused"), "incorrect", error);
                continue;
            }
        };
        row(&format!("{name}: surface error, PV / um"), "incorrect", format!("{:.3}", 1e3 * found.quality.pv_mm));
        row(
            &format!("{name}: map against the right one, PV / um"),
            "-",
            format!("{:.3}", 1e3 * maps_apart(&found, after)),
        );
        if distance == DistanceModel::Triangle {
            save(&HeatMap::of_deviations("The radius subtracted (fig. 12b)", &found.deviations)?, figures, "fig12b")?;
        }
    }
    Ok(())
}
