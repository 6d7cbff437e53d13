//! Shared functions of the tests: point clouds from the simulated truth, and the error of a pose.

use rand::RngExt;
use rand::rngs::StdRng;
use regrind_core::geometry::{Point, Pose};
use regrind_core::surface::{Nominal, PlaneProjection};
use regrind_sim::Vec3;
use regrind_sim::form::FormError;
use regrind_sim::probe::{Placement, centre};
use regrind_sim::shape::{FreeForm, Shape};

/// Radius of the probe in millimetres.
pub const RADIUS_MM: f64 = 1.5;

/// Converts points of the simulator to points of the library.
pub fn points(from: &[Vec3]) -> Vec<Point> {
    from.iter().copied().map(Point::from).collect()
}

/// Converts a placement of the simulator to a pose of the library.
pub fn pose(placement: &Placement) -> Pose {
    let [r, t] = [&placement.rotation, &[placement.translation_mm; 3]];
    Pose::from_rows([
        [r[0][0], r[0][1], r[0][2], t[0][0]],
        [r[1][0], r[1][1], r[1][2], t[0][1]],
        [r[2][0], r[2][1], r[2][2], t[0][2]],
        [0.0, 0.0, 0.0, 1.0],
    ])
    .unwrap()
}

/// Returns the free form as a gridded nominal surface.
pub fn free_form(columns: usize, rows: usize) -> Nominal {
    let grid = FreeForm::default().grid(FreeForm::WIDTH_MM, FreeForm::DEPTH_MM, columns, rows);
    Nominal::from_points(points(&grid), PlaneProjection::Auto).unwrap()
}

/// Returns probe centres over a rectangle of a shape, in the model frame: columns x rows.
/// Two corners give the rectangle.
pub fn centres(
    shape: &dyn Shape,
    form: &FormError,
    [low, high]: [[f64; 2]; 2],
    [columns, rows]: [usize; 2],
) -> Vec<Vec3> {
    let at = |k: usize, n: usize, c: usize| low[c] + (high[c] - low[c]) * k as f64 / (n - 1) as f64;
    (0..rows)
        .flat_map(|j| (0..columns).map(move |i| (i, j)))
        .map(|(i, j)| centre(shape, form, RADIUS_MM, at(i, columns, 0), at(j, rows, 1)))
        .collect()
}

/// Draws a number from the standard normal distribution.
pub fn normal(rng: &mut StdRng) -> f64 {
    let (u, v): (f64, f64) = (rng.random(), rng.random());
    (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// Moves centres into the CMM frame.
pub fn placed(placement: &Placement, centres: &[Vec3]) -> Vec<Vec3> {
    centres.iter().map(|c| placement.apply(*c)).collect()
}

/// Returns the pose error: the largest distance, in mm, between a corner of the free form by `found` and by `truth`.
pub fn pose_error_mm(found: &Pose, truth: &Pose) -> f64 {
    [[-50.0, -30.0], [50.0, -30.0], [-50.0, 30.0], [50.0, 30.0]]
        .iter()
        .map(|[x, y]| Point::new(*x, *y, FreeForm::default().height(*x, *y)))
        .map(|p| (found.transform_point(&p) - truth.transform_point(&p)).norm())
        .fold(0.0, f64::max)
}
