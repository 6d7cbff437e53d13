//! Linear problem A m = b with one row per point, summed into its normal matrix.

use nalgebra::{Matrix6, Vector6};

use crate::geometry::{Point, Twist, Vector};
use crate::surface::simd::{F64x4, LANES, Real, Vector3x4, cross, minus};

/// Centre and size to which the twist of a step refers: rotations are about the centroid of the cloud, and translations
/// are in units of the size of the cloud.
///
/// About the origin of the model frame, every rotation of a distant part would look like a translation. About the
/// centroid, the columns of A are as independent as the surface allows. In units of the size, a ball |m| <= alpha
/// allows the same motion of the rim by translation as by rotation, for any size of the part.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Scaling {
    pub(crate) centre: Point,
    pub(crate) size_mm: f64,
}

impl Scaling {
    /// Converts a step in scaled coordinates to a twist in the model frame, in mm and radians. The scaled coordinates
    /// are three translations in units of `size_mm`, then three rotations about `centre` in radians.
    pub(crate) fn twist(&self, scaled: &Vector6<f64>) -> Twist {
        let omega: Vector = scaled.fixed_rows::<3>(3).into();
        let shift: Vector = scaled.fixed_rows::<3>(0) * self.size_mm;
        let v = shift - omega.cross(&self.centre.coords);
        Twist::new(v.x, v.y, v.z, omega.x, omega.y, omega.z)
    }

    /// Returns the 6x6 matrix that converts a step in scaled coordinates to a twist in the model frame, in mm and
    /// radians. The scaled coordinates are three translations in units of `size_mm`, then three rotations about
    /// `centre` in radians. [`Self::twist`] converts one step.
    pub(crate) fn to_twist(self) -> Matrix6<f64> {
        Matrix6::from_columns(&std::array::from_fn::<_, 6, _>(|k| {
            let mut unit = Vector6::zeros();
            unit[k] = 1.0;
            self.twist(&unit)
        }))
    }

    /// Returns the row of the Jacobian A for the point `p`, eq. (12) of the paper. `normal` is the unit normal of the
    /// surface at the projection of `p`. Point and normal are in the model frame.
    ///
    /// Element k is the decrease of the distance of the point from the surface, in mm, per unit of coordinate k of the
    /// step. The six coordinates are three translations in units of `size_mm`, then three rotations about `centre` in
    /// radians.
    #[inline]
    pub(crate) fn row(&self, p: &Point, normal: &Vector) -> [f64; 6] {
        let arm = (p - self.centre).cross(normal);
        let s = self.size_mm;
        [s * normal.x, s * normal.y, s * normal.z, arm.x, arm.y, arm.z]
    }
}

impl Scaling {
    /// Returns the rows of the Jacobian A for four points at once. [`Self::row`] defines the row of one point. Each
    /// lane (element of a vector register) of `p`, `normal` and the result holds one point.
    #[inline(always)]
    pub(crate) fn four_rows(&self, p: &Vector3x4, normal: &Vector3x4) -> [F64x4; 6] {
        let centre = [F64x4::splat(self.centre.x), F64x4::splat(self.centre.y), F64x4::splat(self.centre.z)];
        let arm = cross(&minus(p, &centre), normal);
        let s = F64x4::splat(self.size_mm);
        [s * normal[0], s * normal[1], s * normal[2], arm[0], arm[1], arm[2]]
    }
}

/// Sums over points in groups of four, one sum per lane.
#[derive(Clone, Debug)]
pub(crate) struct FourSums {
    gram: [F64x4; 21],
    right: [F64x4; 6],
    objective_mm2: F64x4,
    points: usize,
}

impl FourSums {
    pub(crate) fn zero() -> Self {
        let zero = F64x4::splat(0.0);
        Self { gram: [zero; 21], right: [zero; 6], objective_mm2: zero, points: 0 }
    }

    /// Adds four points to the normal equations. Each of the four lanes (elements of a vector register) holds one
    /// point. `row` has the rows of the Jacobian A, `distance` the distances in mm, `weight` the weights, and
    /// `loss_mm2` the contributions to the objective.
    ///
    /// `used` is the number of these points that are in the fit. A point that is not in the fit must have weight 0 and
    /// loss 0.
    #[inline(always)]
    pub(crate) fn add(&mut self, row: &[F64x4; 6], distance: F64x4, weight: F64x4, loss_mm2: F64x4, used: usize) {
        let mut k = 0;
        for i in 0..6 {
            let weighted = weight * row[i];
            for other in &row[..=i] {
                self.gram[k] = self.gram[k] + weighted * *other;
                k += 1;
            }
            self.right[i] = self.right[i] + weighted * distance;
        }
        self.objective_mm2 = self.objective_mm2 + loss_mm2;
        self.points += used;
    }

    /// Adds the normal equations of the four lanes (elements of a vector register, one point each) to `sums`, in the
    /// order of the lanes.
    pub(crate) fn add_to(&self, sums: &mut Sums) {
        for l in 0..LANES {
            for (a, b) in sums.gram.iter_mut().zip(&self.gram) {
                *a += b.0[l];
            }
            for (a, b) in sums.right.iter_mut().zip(&self.right) {
                *a += b.0[l];
            }
            sums.objective_mm2 += self.objective_mm2.0[l];
        }
        sums.points += self.points;
    }
}

/// Normal equations of the linear problem: A^T W A, A^T W b, the objective and the number of points.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Sums {
    /// Lower triangle of A^T W A, row by row.
    gram: [f64; 21],
    /// A^T W b, eq. (13).
    right: [f64; 6],
    /// Objective in mm^2: the sum of the squared distances, or of their robust loss; eq. (7).
    pub(crate) objective_mm2: f64,
    /// Number of points in the fit.
    pub(crate) points: usize,
}

impl Sums {
    pub(crate) fn zero() -> Self {
        Self { gram: [0.0; 21], right: [0.0; 6], objective_mm2: 0.0, points: 0 }
    }

    /// Adds one point in the fit: its row of the Jacobian A, its distance in mm, its weight, and its contribution
    /// `loss_mm2` to the objective.
    #[inline]
    pub(crate) fn add(&mut self, row: &[f64; 6], distance: f64, weight: f64, loss_mm2: f64) {
        let mut k = 0;
        for i in 0..6 {
            let weighted = weight * row[i];
            for other in &row[..=i] {
                self.gram[k] += weighted * other;
                k += 1;
            }
            self.right[i] += weighted * distance;
        }
        self.objective_mm2 += loss_mm2;
        self.points += 1;
    }

    /// Returns the normal equations, the objective and the number of points, added from `self` and `other`. Callers
    /// merge in a fixed order, so that the result does not depend on the number of threads.
    pub(crate) fn merge(mut self, other: &Self) -> Self {
        for (a, b) in self.gram.iter_mut().zip(&other.gram) {
            *a += b;
        }
        for (a, b) in self.right.iter_mut().zip(&other.right) {
            *a += b;
        }
        self.objective_mm2 += other.objective_mm2;
        self.points += other.points;
        self
    }

    /// Returns the matrix A^T W A of the normal equations. A has one row per point, and W is diagonal with the weights
    /// of the points.
    pub(crate) fn gram(&self) -> Matrix6<f64> {
        Matrix6::from_fn(|i, j| {
            let (i, j) = (i.max(j), i.min(j));
            self.gram[i * (i + 1) / 2 + j]
        })
    }

    /// Returns the right side A^T W b of the normal equations, eq. (13) of the paper. A is the Jacobian with one row
    /// for each point, W is the diagonal matrix of the weights, and b has the distances of the points in mm.
    pub(crate) fn right(&self) -> Vector6<f64> {
        Vector6::from(self.right)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;

    /// Compares the row with the derivative of the distance to a fixed plane, with the sign of eq. (11).
    #[test]
    fn row_is_distance_derivative() {
        let scaling = Scaling { centre: Point::new(30.0, -20.0, 7.0), size_mm: 40.0 };
        let (p, normal) = (Point::new(55.0, 12.0, -3.0), Vector::new(0.2, -0.5, 0.9).normalize());
        let anchor = Point::new(54.0, 12.0, -2.0);
        let row = scaling.row(&p, &normal);
        for k in 0..6 {
            let distance = |step: f64| {
                let mut m = Vector6::zeros();
                m[k] = step;
                let moved = Pose::exp(&scaling.twist(&m)).inverse().transform_point(&p);
                (moved - anchor).dot(&normal)
            };
            let slope = (distance(1e-6) - distance(-1e-6)) / 2e-6;
            assert!((row[k] + slope).abs() < 1e-7, "coordinate {k}: {} against {slope}", row[k]);
        }
    }

    #[test]
    fn row_ignores_in_plane_motion() {
        let scaling = Scaling { centre: Point::origin(), size_mm: 1.0 };
        let normal = Vector::new(1.0, 1.0, 1.0).normalize();
        let row = scaling.row(&Point::new(3.0, 4.0, 5.0), &normal);
        let slide = Vector::new(1.0, -1.0, 0.0);
        assert!((row[0] * slide.x + row[1] * slide.y + row[2] * slide.z).abs() < 1e-15);
    }

    #[test]
    fn sums_are_the_normal_equations() {
        let rows = [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [0.5, -1.0, 0.0, 2.0, 1.0, -3.0]];
        let b = [0.25, -0.75];
        let mut halves = [Sums::zero(), Sums::zero()];
        for k in 0..2 {
            halves[k].add(&rows[k], b[k], 2.0, b[k] * b[k]);
        }
        let [first, second] = halves;
        let sums = first.merge(&second);
        let a = nalgebra::Matrix2x6::from_row_slice(&rows.concat());
        assert_eq!(sums.gram(), a.transpose() * a * 2.0);
        assert_eq!(sums.right(), a.transpose() * nalgebra::Vector2::from(b) * 2.0);
        assert_eq!((sums.points, sums.objective_mm2), (2, 0.25 * 0.25 + 0.75 * 0.75));
    }
}
