//! Nominal surface through given points: a local cubic fit of its own, so that the truth shares no computation with the
//! code under test.
//!
//! At (x, y) the nearest points are fitted by a polynomial of degree three, weighted by their distance r:
//!
//! ```text
//!  w = (1 - (r / R)^2)^4      R: a little more than the distance of the farthest of the points
//!  z(x + u, y + v) = c0 + c1 u + c2 v + c3 u^2 + c4 u v + c5 v^2 + c6 u^3 + c7 u^2 v + c8 u v^2 + c9 v^3
//! ```
//!
//! The height is c0, the gradient (c1, c2), the second derivatives (2 c3, c4, 2 c5) (moving least squares, Lancaster and
//! Salkauskas 1981).

use crate::Vec3;
use crate::shape::Shape;

/// Number of points of a fit. A cubic has ten coefficients.
const NEAREST: usize = 28;
const TERMS: usize = 10;
/// Share by which the radius of the weights exceeds the farthest of the nearest points.
const MARGIN: f64 = 1.15;

/// Distance, in sizes of a cell, beyond which no point is near: there the surface goes on along a tangent.
const FAR_CELLS: f64 = 1.5;

/// Surface through points that are given as heights over the plane. The default has no points and is the plane z = 0.
#[derive(Clone, Debug, Default)]
pub struct PointSurface {
    points: Vec<Vec3>,
    first_mm: [f64; 2],
    cell_mm: f64,
    columns: usize,
    rows: usize,
    /// Index of the first point of each cell in `order`, and the number of all points at the end.
    begins: Vec<usize>,
    order: Vec<usize>,
}

impl PointSurface {
    /// Creates the surface through points (x, y, z) in mm. The order is free. Returns `None` if there are fewer than
    /// [`NEAREST`] points, if a coordinate is not finite, or if the points have no extent in x or y.
    pub fn through(points: Vec<Vec3>) -> Option<Self> {
        if points.len() < NEAREST || points.iter().flatten().any(|value| !value.is_finite()) {
            return None;
        }
        let bound = |k: usize, better: fn(f64, f64) -> f64| points.iter().map(|p| p[k]).reduce(better).unwrap_or(0.0);
        let first_mm = [bound(0, f64::min), bound(1, f64::min)];
        let size_mm = [bound(0, f64::max) - first_mm[0], bound(1, f64::max) - first_mm[1]];
        if size_mm.iter().any(|size| *size <= 0.0) {
            return None;
        }
        // About four points in a cell.
        let cell_mm = (4.0 * size_mm[0] * size_mm[1] / points.len() as f64).sqrt();
        let [columns, rows] = size_mm.map(|size| (size / cell_mm) as usize + 1);
        let mut surface =
            Self { points, first_mm, cell_mm, columns, rows, begins: vec![0; columns * rows + 1], order: Vec::new() };
        let cells: Vec<usize> = surface.points.iter().map(|p| surface.cell_at(p[0], p[1])).collect();
        for cell in &cells {
            surface.begins[cell + 1] += 1;
        }
        for k in 0..columns * rows {
            surface.begins[k + 1] += surface.begins[k];
        }
        let mut next = surface.begins.clone();
        surface.order = vec![0; cells.len()];
        for (point, cell) in cells.iter().enumerate() {
            surface.order[next[*cell]] = point;
            next[*cell] += 1;
        }
        Some(surface)
    }

    /// Returns the column and the row of a place, within the grid of cells.
    fn place_of(&self, x: f64, y: f64) -> [usize; 2] {
        let at =
            |value: f64, first: f64, count: usize| (((value - first) / self.cell_mm).max(0.0) as usize).min(count - 1);
        [at(x, self.first_mm[0], self.columns), at(y, self.first_mm[1], self.rows)]
    }

    fn cell_at(&self, x: f64, y: f64) -> usize {
        let [column, row] = self.place_of(x, y);
        row * self.columns + column
    }

    /// Returns the place within the box of the points that is nearest to (x, y).
    fn clamped(&self, x: f64, y: f64) -> [f64; 2] {
        let last = [self.columns, self.rows].map(|count| count as f64 * self.cell_mm);
        [0, 1].map(|k| [x, y][k].clamp(self.first_mm[k], self.first_mm[k] + last[k]))
    }

    /// Returns the squared distance and the index of each of the nearest points, the farthest last.
    fn nearest(&self, x: f64, y: f64) -> Vec<(f64, usize)> {
        let [column, row] = self.place_of(x, y);
        let mut found: Vec<(f64, usize)> = Vec::with_capacity(4 * NEAREST);
        for ring in 0.. {
            let rows = row.saturating_sub(ring)..=(row + ring).min(self.rows - 1);
            for r in rows {
                let columns = column.saturating_sub(ring)..=(column + ring).min(self.columns - 1);
                for c in columns.filter(|c| r.abs_diff(row) == ring || c.abs_diff(column) == ring) {
                    let cell = r * self.columns + c;
                    for &point in &self.order[self.begins[cell]..self.begins[cell + 1]] {
                        let [px, py, _] = self.points[point];
                        found.push(((px - x).powi(2) + (py - y).powi(2), point));
                    }
                }
            }
            let is_all = ring > self.columns.max(self.rows);
            if found.len() >= NEAREST || is_all {
                if found.len() > NEAREST {
                    // Where many rings are empty, sorting all that they have would take most of the time.
                    found.select_nth_unstable_by(NEAREST - 1, |a, b| a.0.total_cmp(&b.0));
                    found.truncate(NEAREST);
                }
                let far2 = found.iter().fold(0.0, |far2: f64, (d2, _)| far2.max(*d2));
                // A point outside the rings is at least this far away, for a place within the grid.
                let safe_mm = ring as f64 * self.cell_mm;
                if is_all || far2 <= safe_mm * safe_mm {
                    found.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
                    return found;
                }
            }
        }
        found
    }

    /// Returns the coefficients c0 to c9 of the surface at a place. Far from all points it is the tangent plane at the
    /// nearest one, because a cubic grows without limit where no point holds it.
    fn coefficients(&self, x: f64, y: f64) -> [f64; TERMS] {
        if self.points.is_empty() {
            return [0.0; TERMS];
        }
        let reach_mm = FAR_CELLS * self.cell_mm;
        // Outside the box of the points, the search begins at its border: from a place far away it would pass all cells
        // between.
        let clamped = self.clamped(x, y);
        let is_outside = (x - clamped[0]).hypot(y - clamped[1]) > reach_mm;
        let [sx, sy] = if is_outside { clamped } else { [x, y] };
        let nearest = self.nearest(sx, sy);
        if let Some((near2, point)) = nearest.first()
            && (is_outside || near2.sqrt() > reach_mm)
        {
            let [px, py, _] = self.points[*point];
            let fit = self.fit(px, py, self.nearest(px, py));
            let mut tangent = [0.0; TERMS];
            tangent[..3].copy_from_slice(&[fit[0] + fit[1] * (x - px) + fit[2] * (y - py), fit[1], fit[2]]);
            return tangent;
        }
        self.fit(x, y, nearest)
    }

    /// Returns the coefficients of the fit about (x, y) to the points `nearest`.
    fn fit(&self, x: f64, y: f64, nearest: Vec<(f64, usize)>) -> [f64; TERMS] {
        let radius_mm = MARGIN * nearest.last().map_or(1.0, |(far2, _)| far2.sqrt()).max(f64::MIN_POSITIVE.sqrt());
        let mut normal = [[0.0; TERMS]; TERMS];
        let mut right = [0.0; TERMS];
        for (far2, point) in nearest {
            let [px, py, pz] = self.points[point];
            // Lengths in units of the radius keep the equations well conditioned.
            let [u, v] = [(px - x) / radius_mm, (py - y) / radius_mm];
            let terms = [1.0, u, v, u * u, u * v, v * v, u * u * u, u * u * v, u * v * v, v * v * v];
            let weight = (1.0 - far2 / (radius_mm * radius_mm)).max(0.0).powi(4);
            for a in 0..TERMS {
                right[a] += weight * terms[a] * pz;
                for b in 0..=a {
                    normal[a][b] += weight * terms[a] * terms[b];
                }
            }
        }
        let found = solved(normal, right);
        let powers = [0, 1, 1, 2, 2, 2, 3, 3, 3, 3];
        std::array::from_fn(|k| found[k] / radius_mm.powi(powers[k]))
    }
}

/// Solves the normal equations by a Cholesky factor of their lower triangle. A direction that the points do not
/// determine gets the coefficient 0.
fn solved(mut matrix: [[f64; TERMS]; TERMS], mut right: [f64; TERMS]) -> [f64; TERMS] {
    const LEAST_PIVOT: f64 = 1e-12;
    let trace: f64 = (0..TERMS).map(|k| matrix[k][k]).sum();
    for k in 0..TERMS {
        let pivot = matrix[k][k] - (0..k).map(|j| matrix[k][j] * matrix[k][j]).sum::<f64>();
        let is_known = pivot > LEAST_PIVOT * trace;
        matrix[k][k] = if is_known { pivot.sqrt() } else { 0.0 };
        for i in k + 1..TERMS {
            let rest = matrix[i][k] - (0..k).map(|j| matrix[i][j] * matrix[k][j]).sum::<f64>();
            matrix[i][k] = if is_known { rest / matrix[k][k] } else { 0.0 };
        }
    }
    let divided = |value: f64, by: f64| if by > 0.0 { value / by } else { 0.0 };
    for k in 0..TERMS {
        let rest = right[k] - (0..k).map(|j| matrix[k][j] * right[j]).sum::<f64>();
        right[k] = divided(rest, matrix[k][k]);
    }
    for k in (0..TERMS).rev() {
        let rest = right[k] - (k + 1..TERMS).map(|j| matrix[j][k] * right[j]).sum::<f64>();
        right[k] = divided(rest, matrix[k][k]);
    }
    right
}

impl Shape for PointSurface {
    fn height(&self, x: f64, y: f64) -> f64 {
        self.coefficients(x, y)[0]
    }

    fn gradient(&self, x: f64, y: f64) -> [f64; 2] {
        let found = self.coefficients(x, y);
        [found[1], found[2]]
    }

    fn hessian(&self, x: f64, y: f64) -> [f64; 3] {
        let found = self.coefficients(x, y);
        [2.0 * found[3], found[4], 2.0 * found[5]]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shape::FreeForm;

    fn grid_of(shape: &dyn Shape, step_mm: f64) -> Vec<Vec3> {
        let [columns, rows] = [102.0 / step_mm, 62.0 / step_mm].map(|count| count as usize + 1);
        let at = |k: usize, half: f64| k as f64 * step_mm - half;
        (0..rows)
            .flat_map(|r| (0..columns).map(move |c| [at(c, 51.0), at(r, 31.0)]))
            .map(|[x, y]| shape.point(x, y))
            .collect()
    }

    #[test]
    fn cubic_is_exact() {
        struct Cubic;
        impl Shape for Cubic {
            fn height(&self, x: f64, y: f64) -> f64 {
                1.0 + 0.1 * x - 0.2 * y + 1e-3 * x * x + 2e-3 * x * y - 1e-5 * x * x * y + 3e-5 * y * y * y
            }
            fn gradient(&self, x: f64, y: f64) -> [f64; 2] {
                [0.1 + 2e-3 * x + 2e-3 * y - 2e-5 * x * y, -0.2 + 2e-3 * x - 1e-5 * x * x + 9e-5 * y * y]
            }
            fn hessian(&self, x: f64, y: f64) -> [f64; 3] {
                [2e-3 - 2e-5 * y, 2e-3 - 2e-5 * x, 1.8e-4 * y]
            }
        }
        let surface = PointSurface::through(grid_of(&Cubic, 2.0)).unwrap();
        for [x, y] in [[0.0, 0.0], [10.3, -4.7], [-50.9, 30.9], [51.0, -31.0], [53.0, 33.0]] {
            assert!((surface.height(x, y) - Cubic.height(x, y)).abs() < 1e-9, "{x} {y}");
            for (found, is) in surface.gradient(x, y).iter().zip(Cubic.gradient(x, y)) {
                assert!((found - is).abs() < 1e-9, "{x} {y}: {found} {is}");
            }
            for (found, is) in surface.hessian(x, y).iter().zip(Cubic.hessian(x, y)) {
                assert!((found - is).abs() < 1e-8, "{x} {y}: {found} {is}");
            }
        }
    }

    /// Halving the spacing must reduce the error of the height by about 2^4, and that of the gradient by 2^3.
    #[test]
    fn free_form_converges() {
        let shape = FreeForm::default();
        let error = |step_mm: f64| {
            let surface = PointSurface::through(grid_of(&shape, step_mm)).unwrap();
            let places = (0..200).map(|k| [f64::from(k) * 0.47 - 47.0, f64::from(k * 37 % 200) * 0.28 - 28.0]);
            places.fold([0.0f64; 2], |[height, slope], [x, y]| {
                let (found, is) = (surface.gradient(x, y), shape.gradient(x, y));
                let off = (found[0] - is[0]).hypot(found[1] - is[1]);
                [height.max((surface.height(x, y) - shape.height(x, y)).abs()), slope.max(off)]
            })
        };
        let [coarse, fine] = [error(1.0), error(0.5)];
        println!("1 mm: {coarse:?}, 0.5 mm: {fine:?}");
        assert!(fine[0] < 1e-5 && fine[1] < 1e-5, "{fine:?}");
        assert!(coarse[0] / fine[0] > 8.0 && coarse[1] / fine[1] > 4.0, "{coarse:?} {fine:?}");
    }

    /// A disc of points in the corner of its bounding square, and far from it.
    #[test]
    fn surface_goes_on_along_tangent() {
        let shape = crate::shape::Sphere { radius_mm: 100.0 };
        let mut points = grid_of(&shape, 1.0);
        points.retain(|[x, y, _]| x.hypot(*y) <= 30.0);
        let surface = PointSurface::through(points).unwrap();
        for [x, y] in [[30.0, 30.0], [-29.0, 25.0], [300.0, 0.0]] {
            let slope = surface.gradient(x, y);
            assert!(slope[0].hypot(slope[1]) < 0.35 && surface.height(x, y).abs() < 100.0, "{x} {y} {slope:?}");
            assert_eq!(surface.hessian(x, y), [0.0; 3]);
        }
        assert!((surface.height(0.3, 29.9) - shape.height(0.3, 29.9)).abs() < 1e-6);
    }

    #[test]
    fn too_few_or_flat_points_refused() {
        assert!(PointSurface::through(vec![[0.0; 3]; NEAREST - 1]).is_none());
        assert!(PointSurface::through((0..40).map(|k| [f64::from(k), 0.0, 0.0]).collect()).is_none());
        let mut points = grid_of(&FreeForm::default(), 10.0);
        points[3][2] = f64::NAN;
        assert!(PointSurface::through(points).is_none());
    }

    #[test]
    fn far_places_continue_along_tangent_without_passing_all_cells() {
        let shape = FreeForm::default();
        let surface = PointSurface::through(grid_of(&shape, 0.5)).unwrap();
        for (x, y) in [(51.0 + 3.0, 2.0), (-90.0, 40.0), (0.0, 1e4)] {
            let [cx, cy] = surface.clamped(x, y);
            let found = surface.height(x, y);
            let [gx, gy] = surface.gradient(x, y);
            assert!(found.is_finite() && gx.is_finite() && gy.is_finite());
            let tangent = surface.height(cx, cy) + gx * (x - cx) + gy * (y - cy);
            assert!(
                (found - tangent).abs() < 1e-3 * (1.0 + (x - cx).abs() + (y - cy).abs()),
                "{x} {y}: {found} {tangent}"
            );
        }
        let far = surface.nearest(80.0, 60.0);
        assert!(far.len() == NEAREST && far.windows(2).all(|pair| pair[0].0 <= pair[1].0));
    }
}
