//! Target surface of a pass: the nominal surface, shifted along its normals by the level (the remaining allowance)
//! plus the correction.
//!
//! P(x, y) = S(x, y) + d(x, y) N(x, y) with d = level + correction. The normals are those of P itself. They come from
//! the derivatives of the same interpolation that defines P: n ~ P_x x P_y, P_x = S_x + d_x N + d N_x. They therefore
//! include the slope of the correction. With the nominal normals a wheel of radius R would be off by R |grad d|^2 / 2
//! along the normal and by R |grad d| along the surface.

use crate::compensation::Correction;
use crate::geometry::{Grid, Point, Vector};

use super::PathError;
use super::height_field::{HeightField, Jet};

/// Maximum number of rings of nodes added around a correction.
const MAX_RINGS: f64 = 200.0;

/// Target surface of a pass.
#[derive(Clone, Debug)]
pub struct TargetSurface {
    nominal: HeightField,
    correction: HeightField,
    level_mm: f64,
}

/// Point of the target surface with its normal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Position, in the model frame, in millimetres.
    pub point: Point,
    /// Unit normal of the target surface, towards +z.
    pub normal: Vector,
}

/// Normal curvatures of the target surface at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SurfaceCurvature {
    /// Point and normal.
    pub contact: Contact,
    /// Two orthogonal unit tangents: along x, and across.
    pub tangents: [Vector; 2],
    /// Second fundamental form in these directions, in 1/mm, positive in a hollow: normal curvature along the first,
    /// mixed term, normal curvature along the second.
    pub second_form_per_mm: [f64; 3],
}

impl TargetSurface {
    /// Creates the target surface of a pass. Each point of the nominal surface is shifted along its normal by the level
    /// (the remaining allowance) plus the value of the correction. Outside the grid of the correction, its values are
    /// extrapolated and become constant within the distance `level_off_mm`, in millimetres.
    ///
    /// # Errors
    /// Returns [`PathError::Correction`] if a value of the correction is not finite.
    pub fn new(nominal: HeightField, correction: &Correction, level_off_mm: f64) -> Result<Self, PathError> {
        if let Some(node) = correction.values_mm.iter().position(|v| !v.is_finite()) {
            let [x_mm, y_mm] = correction.grid.place_mm(node);
            return Err(PathError::Correction { x_mm, y_mm });
        }
        Ok(Self { nominal, correction: correction_spline(correction, level_off_mm), level_mm: correction.level_mm })
    }

    /// Returns a point of the target surface and its unit normal: the nominal point at `place_mm` (x and y), shifted
    /// along the nominal normal. So x and y of the returned point can differ from `place_mm`.
    #[inline]
    pub fn at(&self, place_mm: [f64; 2]) -> Contact {
        let (point, tangents) = self.tangents(place_mm);
        Contact { point, normal: tangents[0].cross(&tangents[1]).normalize() }
    }

    /// Returns the point of the target surface that belongs to `place_mm`, the position `[x, y]` on the nominal surface
    /// in mm. Also returns the two tangent vectors: the derivatives of this point with respect to x and y of the
    /// nominal surface.
    #[inline]
    fn tangents(&self, place_mm: [f64; 2]) -> (Point, [Vector; 2]) {
        let e = self.correction.at(place_mm);
        self.offset_point(place_mm, &Jet { value: self.level_mm + e.value, ..e })
    }

    /// Shifts the nominal point at `place_mm` (`[x, y]`, in mm) along its normal. `e` holds the shift in millimetres
    /// and the slopes of the shift along x and y. Returns the shifted point, and its derivatives with respect to x and
    /// to y.
    #[inline]
    fn offset_point(&self, place_mm: [f64; 2], e: &Jet) -> (Point, [Vector; 2]) {
        let s = self.nominal.at(place_mm);
        let d = e.value;
        let [p, q] = s.slope;
        let w = 1.0 / (1.0 + p * p + q * q).sqrt();
        let normal = Vector::new(-p * w, -q * w, w);
        // N_x = (-r, -s, 0) w - N (p r + q s) w^2, and N_y likewise.
        let turned = |a: f64, b: f64| Vector::new(-a * w, -b * w, 0.0) - normal * ((p * a + q * b) * w * w);
        let [r, mixed, t] = s.second_derivatives;
        let by_x = Vector::new(1.0, 0.0, p) + normal * e.slope[0] + turned(r, mixed) * d;
        let by_y = Vector::new(0.0, 1.0, q) + normal * e.slope[1] + turned(mixed, t) * d;
        (Point::new(place_mm[0], place_mm[1], s.value) + normal * d, [by_x, by_y])
    }

    /// Returns the curvatures of the target surface at the place `place_mm` (`[x, y]`, in mm). The result contains the
    /// surface point, its normal, two orthogonal unit tangents, and the second fundamental form in these tangent
    /// directions, in 1/mm. A curvature is positive in a hollow.
    ///
    /// The curvatures come from central differences of the normals, with a step of a thousandth of the node spacing of
    /// the nominal surface.
    pub(super) fn curvature_at(&self, place_mm: [f64; 2]) -> SurfaceCurvature {
        let (point, [by_x, by_y]) = self.tangents(place_mm);
        let normal = by_x.cross(&by_y).normalize();
        let first = by_x.normalize();
        let along = [first, normal.cross(&first)];
        let steps = self.nominal.spacing_mm().map(|h| 1e-3 * h);
        // The shape operator: change of the normal per unit step along x and along y.
        let turn = |k: usize| {
            let mut sides = [place_mm; 2];
            sides[0][k] += steps[k];
            sides[1][k] -= steps[k];
            let [ahead, behind] = sides.map(|place| self.at(place).normal);
            (ahead - behind) / (2.0 * steps[k])
        };
        let (n_x, n_y) = (turn(0), turn(1));
        // Tangents in terms of the derivatives: along[0] = by_x / |by_x|, along[1] = a by_x + b by_y.
        let (length, slant) = (by_x.norm(), by_y.dot(&along[1]));
        let b = 1.0 / slant;
        let a = -by_y.dot(&along[0]) / (slant * length);
        let turned = [n_x / length, n_x * a + n_y * b];
        let of = |i: usize, j: usize| -turned[i].dot(&along[j]);
        // In a hollow the normal turns against the step, hence the minus sign in `of`.
        SurfaceCurvature {
            contact: Contact { point, normal },
            tangents: along,
            second_form_per_mm: [of(0, 0), 0.5 * (of(0, 1) + of(1, 0)), of(1, 1)],
        }
    }

    /// Returns the factor by which a step of the search for the projection of a point onto the surface must be
    /// multiplied. The search projects the point onto the tangent plane. On a curved surface this gives a step that is
    /// too short in a hollow and too long on a dome.
    ///
    /// Equation: 1 / (1 - h k), limited to 1.9. h is `height_mm`, the height of the point above the surface, in mm. k
    /// is the mean curvature of the surface at `place_mm` (`[x, y]`, in mm), in 1/mm, positive in a hollow.
    fn projection_factor(&self, place_mm: [f64; 2], height_mm: f64) -> f64 {
        let [a, _, c] = self.curvature_at(place_mm).second_form_per_mm;
        (1.0 / (1.0 - 0.5 * height_mm * (a + c)).max(0.05)).min(1.9)
    }

    /// Returns the smallest node spacing, along x or y, of the nominal field and of the correction field, in
    /// millimetres. The surface has no finer detail.
    pub(super) fn min_node_spacing_mm(&self) -> f64 {
        let [a, b] = [self.nominal.spacing_mm(), self.correction.spacing_mm()].map(|[x, y]| x.min(y));
        a.min(b)
    }
}

/// Returns the displacement vector, in mm, of the centre of a ball when the surface that the ball touches is shifted
/// along its normals. Returns `None` if the projection of the centre onto the surface does not converge.
///
/// `nominal` is the surface before the shift. `centre` is the centre of the ball in contact with `nominal`. `shift` is
/// the shift along the normals, in millimetres.
///
/// Equation: P + e n + R n' - `centre`. P is the projection of the centre onto `nominal`, R is the distance from P to
/// the centre, n is the normal at P, e is the shift at P, and n' is the normal of the shifted surface.
pub fn ball_displacement(nominal: &TargetSurface, shift: &HeightField, centre: &Point) -> Option<Vector> {
    let mut place = [centre.x, centre.y];
    for _ in 0..STEPS {
        let (point, [by_x, by_y]) = nominal.tangents(place);
        let arm = centre - point;
        let normal = by_x.cross(&by_y).normalize();
        // Project the centre onto the tangent plane at this place; the next step starts there.
        let (a, b, c) = (by_x.norm_squared(), by_x.dot(&by_y), by_y.norm_squared());
        let (u, v) = (arm.dot(&by_x), arm.dot(&by_y));
        let determinant = a * c - b * b;
        let step = [(c * u - b * v) / determinant, (a * v - b * u) / determinant];
        // The tangent plane ignores the height of the centre above a curved surface. The factor corrects the step:
        // shorter over a dome, longer in a hollow.
        let bend = nominal.projection_factor(place, arm.dot(&normal));
        place = [place[0] + step[0] * bend, place[1] + step[1] * bend];
        if !(place[0] + place[1]).is_finite() {
            return None;
        }
        if step[0].hypot(step[1]) < 1e-9 {
            let e = shift.at(place);
            let (moved, [by_x, by_y]) = nominal.offset_point(place, &Jet { value: nominal.level_mm + e.value, ..e });
            let radius = arm.dot(&normal);
            return Some(moved + by_x.cross(&by_y).normalize() * radius - centre);
        }
    }
    None
}

/// Maximum number of steps to a projection. Each step leaves only a small share of the error, because the steps allow
/// for the curvature.
const STEPS: usize = 100;

/// Fits a bicubic spline through the values of a correction, in millimetres, and extends the spline beyond the grid.
/// Outside the grid the spline becomes constant within the distance `length_mm` (L).
///
/// At a distance s outside the grid, the extended value is the value at the border plus g L (t - t^3 + t^4 / 2). Here g
/// is the slope at the border, in the direction away from the grid, and t is s / L, at most 1. So the slope is
/// continuous at the border and 0 from L on.
pub fn correction_spline(correction: &Correction, length_mm: f64) -> HeightField {
    let grid = correction.grid;
    let spacing_mm = [0, 1].map(|k| {
        let nodes = grid.counts()[k];
        // A single row or column is constant across.
        if nodes < 2 || grid.spacing_mm[k] <= 0.0 { length_mm } else { grid.spacing_mm[k] }
    });
    let rings = spacing_mm.map(|h| (length_mm / h).ceil().clamp(1.0, MAX_RINGS) as usize);
    let reach = [0, 1].map(|k| length_mm.min(rings[k] as f64 * spacing_mm[k]));
    let fade = |k: usize, steps: usize| {
        let t = (steps as f64 * spacing_mm[k] / reach[k]).min(1.0);
        reach[k] / spacing_mm[k] * (t - t.powi(3) + 0.5 * t.powi(4))
    };
    let along = |line: &[f64], k: usize| -> Vec<f64> {
        let n = line.len();
        let rise = |end: usize, next: usize, third: usize| match n {
            1 => 0.0,
            2 => line[end] - line[next],
            _ => 1.5 * line[end] - 2.0 * line[next] + 0.5 * line[third],
        };
        let (before, after) =
            (rise(0, 1.min(n - 1), 2.min(n - 1)), rise(n - 1, n.saturating_sub(2), n.saturating_sub(3)));
        let left = (1..=rings[k]).rev().map(|s| line[0] + before * fade(k, s));
        let right = (1..=rings[k]).map(|s| line[n - 1] + after * fade(k, s));
        left.chain(line.iter().copied()).chain(right).collect()
    };
    let wide: Vec<Vec<f64>> = correction.values_mm.chunks(grid.columns).map(|row| along(row, 0)).collect();
    let columns = grid.columns + 2 * rings[0];
    let tall: Vec<Vec<f64>> =
        (0..columns).map(|i| along(&wide.iter().map(|row| row[i]).collect::<Vec<f64>>(), 1)).collect();
    let rows = grid.rows + 2 * rings[1];
    let values: Vec<f64> = (0..rows).flat_map(|j| tall.iter().map(move |line| line[j])).collect();
    let first_mm = [0, 1].map(|k| grid.first_mm[k] - rings[k] as f64 * spacing_mm[k]);
    HeightField::spline(Grid { columns, rows, first_mm, spacing_mm }, &values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Grid;

    /// Returns the height field of a hollow sphere.
    fn bowl(radius_mm: f64) -> HeightField {
        let on = Grid { columns: 81, rows: 81, first_mm: [-10.0, -10.0], spacing_mm: [0.25, 0.25] };
        let places = (0..81 * 81).map(|k| [-10.0 + (k % 81) as f64 * 0.25, -10.0 + (k / 81) as f64 * 0.25]);
        let (z, slopes): (Vec<f64>, Vec<[f64; 2]>) = places
            .map(|[x, y]| {
                let root = (radius_mm * radius_mm - x * x - y * y).sqrt();
                (radius_mm - root, [x / root, y / root])
            })
            .unzip();
        HeightField::hermite(on, &z, &slopes)
    }

    fn correction(value: impl Fn(f64, f64) -> f64) -> Correction {
        let grid = Grid { columns: 17, rows: 17, first_mm: [-8.0, -8.0], spacing_mm: [1.0, 1.0] };
        let values_mm = (0..grid.len()).map(|k| grid.place_mm(k)).map(|[x, y]| value(x, y)).collect();
        Correction { grid, values_mm, cycle: 2, level_mm: 0.02, parameters: None }
    }

    #[test]
    fn target_surface_offsets_sphere() {
        let wanted = TargetSurface::new(bowl(40.0), &correction(|_, _| 0.0), 5.0).unwrap();
        for place in [[0.1, 0.2], [7.3, -5.5], [-9.9, 3.0]] {
            let Contact { point, normal } = wanted.at(place);
            let centre = Point::new(0.0, 0.0, 40.0);
            assert!(((point - centre).norm() - 39.98).abs() < 1e-8, "{}", (point - centre).norm());
            assert!((normal - (centre - point).normalize()).norm() < 1e-6);
            let [a, mixed, c] = wanted.curvature_at(place).second_form_per_mm;
            assert!(
                (a - 1.0 / 39.98).abs() < 1e-5 && (c - 1.0 / 39.98).abs() < 1e-5 && mixed.abs() < 1e-5,
                "{a} {mixed} {c}"
            );
        }
    }

    #[test]
    fn target_surface_normals_by_differences() {
        let e = |x: f64, y: f64| 0.01 * (0.5 * x).sin() + 0.003 * y;
        let wanted = TargetSurface::new(bowl(40.0), &correction(e), 5.0).unwrap();
        for [x, y] in [[1.3, 2.2], [-6.7, 0.4], [7.9, 9.1], [9.4, -2.0]] {
            let h = 1e-5;
            let by_x = wanted.at([x + h, y]).point - wanted.at([x - h, y]).point;
            let by_y = wanted.at([x, y + h]).point - wanted.at([x, y - h]).point;
            let normal = by_x.cross(&by_y).normalize();
            assert!((normal - wanted.at([x, y]).normal).norm() < 1e-8, "{x} {y}");
        }
    }

    #[test]
    fn correction_levels_off_beyond_grid() {
        let field = correction_spline(&correction(|x, _| 0.002 * x), 3.0);
        assert!((field.at([2.2, 0.0]).value - 0.0044).abs() < 1e-7);
        let far = field.at([11.0, 0.0]);
        assert!((far.value - (0.016 + 0.002 * 3.0 * 0.5)).abs() < 1e-5, "{far:?}");
        assert_eq!(field.at([30.0, 0.0]).value, field.at([11.0, 0.0]).value);
        let steepest =
            (0..400).map(|k| field.at([7.0 + 0.01 * f64::from(k), 3.0]).slope[0]).fold(0.0f64, |m, s| m.max(s.abs()));
        assert!(steepest < 0.0021, "{steepest}");
        let one = Correction {
            grid: Grid { columns: 1, rows: 1, first_mm: [0.0; 2], spacing_mm: [0.0; 2] },
            values_mm: vec![0.007],
            cycle: 1,
            level_mm: 0.0,
            parameters: None,
        };
        assert!((correction_spline(&one, 2.0).at([5.0, -9.0]).value - 0.007).abs() < 1e-15);
    }

    #[test]
    fn target_surface_refuses_nan_correction() {
        let broken = correction(|x, _| if x == 3.0 { f64::NAN } else { 0.0 });
        assert!(matches!(TargetSurface::new(bowl(40.0), &broken, 5.0), Err(PathError::Correction { x_mm: 3.0, .. })));
    }
}
