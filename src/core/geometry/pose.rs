//! Rigid poses: SE(3) in the parametrisation of the paper, eq. (8) to (10).
//!
//! **Conventions.** The name of a pose says what it does: `cmm_from_model` transforms model coordinates to CMM
//! coordinates and is the paper's g. A [`Twist`] has the order translation, rotation, eq. (9). An update multiplies on
//! the right, `g_next = g * Pose::exp(&m)`, eq. (10), so that a twist is expressed in the model frame.

use nalgebra::{Matrix3, UnitQuaternion, Vector3, Vector6};
use thiserror::Error;

use super::{Point, Vector};

/// Twist coordinates (v, omega): translation in millimetres, then rotation in radians.
pub type Twist = Vector6<f64>;

/// Angle below which the coefficients of the exponential come from their series. The closed forms lose half their
/// digits to cancellation there; four terms of the series are exact to the last bit.
const SERIES_BELOW_RAD: f64 = 0.02;

/// Maximum entry of |R R^T - 1| at which a matrix R from outside counts as a rotation and is orthonormalised. A matrix
/// with a larger entry is rejected.
const ROTATION_TOLERANCE: f64 = 1e-4;

/// Rigid motion: a rotation followed by a translation.
///
/// Units: the translation is in millimetres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Rotation matrix, indexed by row and column.
    pub rotation: Matrix3<f64>,
    /// Translation in millimetres, applied after the rotation.
    pub translation_mm: Vector,
}

/// Reason why sixteen numbers are not a rigid pose. Rows and columns count from 1.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum PoseError {
    /// An entry is NaN or infinite.
    #[error("row {row}, column {column} of the pose is {value}; every entry must be a finite number")]
    NotFinite { row: usize, column: usize, value: f64 },
    /// The last row is not 0 0 0 1.
    #[error("the last row of a pose must be 0 0 0 1, not {0:?}")]
    LastRow([f64; 4]),
    /// The upper left block is not a rotation: the largest entry of R R^T - 1 is too large, or the determinant is
    /// negative (-1 for a mirror image).
    #[error(
        "the upper left 3 x 3 block R of the pose is not a rotation: the largest entry of R R^T - 1 is {off:.3e} \
         (limit {ROTATION_TOLERANCE:.0e}), and the determinant is {determinant:.6}; give a matrix without \
         scale, shear or mirror image"
    )]
    NotARotation { off: f64, determinant: f64 },
}

impl Pose {
    /// Returns the identity pose, which moves no point.
    pub fn identity() -> Self {
        Self { rotation: Matrix3::identity(), translation_mm: Vector::zeros() }
    }

    /// Returns the pose that belongs to `twist`: the exact exponential map of SE(3) (the group of rigid motions).
    ///
    /// Units: the first three coordinates of the twist in millimetres, the last three in radians.
    pub fn exp(twist: &Twist) -> Self {
        let v: Vector = twist.fixed_rows::<3>(0).into();
        let omega: Vector = twist.fixed_rows::<3>(3).into();
        let [a, b, c] = exponential_coefficients(omega.norm());
        let hat = omega.cross_matrix();
        let hat_squared = hat * hat;
        Self {
            rotation: Matrix3::identity() + hat * a + hat_squared * b,
            translation_mm: v + hat * v * b + hat_squared * v * c,
        }
    }

    /// Returns the twist that [`Pose::exp`] maps to this pose: the logarithm in SE(3). The first three coordinates are
    /// in mm. The last three are the rotation vector in radians; its length, the angle of rotation, is from 0 to pi.
    pub fn log(&self) -> Twist {
        let omega = rotation_logarithm(&self.rotation);
        let [a, b, _] = exponential_coefficients(omega.norm());
        let hat = omega.cross_matrix();
        let theta_squared = omega.norm_squared();
        // V^-1 = 1 - hat/2 + d hat^2, with d = (1 - a / 2b) / theta^2, which tends to 1/12.
        let d = if theta_squared < SERIES_BELOW_RAD * SERIES_BELOW_RAD {
            1.0 / 12.0 + theta_squared / 720.0 + theta_squared * theta_squared / 30240.0
        } else {
            (1.0 - a / (2.0 * b)) / theta_squared
        };
        let v = self.translation_mm - hat * self.translation_mm * 0.5 + hat * (hat * self.translation_mm) * d;
        Twist::new(v.x, v.y, v.z, omega.x, omega.y, omega.z)
    }

    /// Returns the inverse pose.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation_mm: -(rotation * self.translation_mm) }
    }

    /// Transforms a point: rotates it about the origin, then translates it.
    #[inline]
    pub fn transform_point(&self, p: &Point) -> Point {
        Point::from(self.rotation * p.coords + self.translation_mm)
    }

    /// Rotates a direction.
    #[inline]
    pub fn transform_direction(&self, v: &Vector) -> Vector {
        self.rotation * v
    }

    /// Returns the same pose with an orthonormal rotation matrix. Use it after many products of poses, because their
    /// rounding errors add up.
    ///
    /// The method is one Newton step towards the nearest rotation. The result is exact to rounding if the matrix
    /// differs from a rotation by less than 1e-8.
    pub fn orthonormalised(&self) -> Self {
        let gram = self.rotation.transpose() * self.rotation;
        Self { rotation: self.rotation * (Matrix3::identity() * 1.5 - gram * 0.5), translation_mm: self.translation_mm }
    }

    /// Returns the angle of the rotation in radians, from 0 to pi.
    pub fn angle_rad(&self) -> f64 {
        rotation_logarithm(&self.rotation).norm()
    }

    /// Returns the pose as a homogeneous matrix of four rows. The upper left 3 x 3 block is the rotation, the last
    /// column has the translation in mm, and the last row is 0 0 0 1.
    pub fn to_rows(&self) -> [[f64; 4]; 4] {
        let (r, t) = (&self.rotation, &self.translation_mm);
        [
            [r[(0, 0)], r[(0, 1)], r[(0, 2)], t[0]],
            [r[(1, 0)], r[(1, 1)], r[(1, 2)], t[1]],
            [r[(2, 0)], r[(2, 1)], r[(2, 2)], t[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    }

    /// Builds a pose from a homogeneous matrix of four rows, with the translation in mm in the last column. Small
    /// errors of the rotation are removed: the result has an orthonormal rotation.
    ///
    /// # Errors
    /// Returns an error if an entry is not finite, if the last row is not 0 0 0 1, or if the upper left 3 x 3 block R
    /// is not a rotation. R counts as a rotation if every entry of R R^T - 1 is at most 1e-4 in magnitude and the
    /// determinant is positive.
    pub fn from_rows(rows: [[f64; 4]; 4]) -> Result<Self, PoseError> {
        for (row, entries) in rows.iter().enumerate() {
            if let Some(column) = entries.iter().position(|v| !v.is_finite()) {
                return Err(PoseError::NotFinite { row: row + 1, column: column + 1, value: entries[column] });
            }
        }
        if rows[3] != [0.0, 0.0, 0.0, 1.0] {
            return Err(PoseError::LastRow(rows[3]));
        }
        let rotation = Matrix3::from_fn(|i, j| rows[i][j]);
        let off = (rotation * rotation.transpose() - Matrix3::identity()).amax();
        let determinant = rotation.determinant();
        if off > ROTATION_TOLERANCE || determinant < 0.0 {
            return Err(PoseError::NotARotation { off, determinant });
        }
        let translation_mm = Vector3::new(rows[0][3], rows[1][3], rows[2][3]);
        Ok(Self { rotation, translation_mm }.orthonormalised().orthonormalised())
    }
}

impl std::ops::Mul for Pose {
    type Output = Pose;

    /// Composes two poses. The result applies `right` first, then `self`.
    fn mul(self, right: Pose) -> Pose {
        Pose {
            rotation: self.rotation * right.rotation,
            translation_mm: self.rotation * right.translation_mm + self.translation_mm,
        }
    }
}

/// Returns three coefficients of the exponential map for the angle t = `theta` (in radians, at least 0): sin(t)/t, (1 -
/// cos t)/t^2 and (t - sin t)/t^3. If t is small, they are computed from their power series.
fn exponential_coefficients(theta: f64) -> [f64; 3] {
    let t2 = theta * theta;
    if theta < SERIES_BELOW_RAD {
        return [
            1.0 - t2 / 6.0 * (1.0 - t2 / 20.0 * (1.0 - t2 / 42.0)),
            0.5 - t2 / 24.0 * (1.0 - t2 / 30.0 * (1.0 - t2 / 56.0)),
            1.0 / 6.0 - t2 / 120.0 * (1.0 - t2 / 42.0 * (1.0 - t2 / 72.0)),
        ];
    }
    let half_sine = (0.5 * theta).sin();
    [theta.sin() / theta, 2.0 * half_sine * half_sine / t2, (theta - theta.sin()) / (t2 * theta)]
}

/// Returns the rotation vector of a rotation matrix: the unit vector of the axis times the angle in radians, from 0 to
/// pi. The computation uses the quaternion of the rotation. Therefore the result is accurate even for angles near pi.
fn rotation_logarithm(rotation: &Matrix3<f64>) -> Vector {
    let q = UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(*rotation));
    let (w, v) = (q.w.abs(), q.imag() * if q.w < 0.0 { -1.0 } else { 1.0 });
    let sine = v.norm();
    if sine < 1e-12 { v * 2.0 } else { v * (2.0 * sine.atan2(w) / sine) }
}

/// Returns the smallest rotation that maps the z axis to `n`, a vector of length 1. For n = -z it is the half turn about
/// x.
pub(crate) fn min_rotation(n: &Vector) -> Matrix3<f64> {
    let across = n.x * n.x + n.y * n.y;
    // 1 / (1 + z), without the loss of digits near z = -1.
    let s = if n.z < 0.0 { (1.0 - n.z) / across } else { 1.0 / (1.0 + n.z) };
    if n.z < 0.0 && across < 1e-30 {
        return Matrix3::from_diagonal(&Vector::new(1.0, -1.0, -1.0));
    }
    let x = Vector::new(1.0 - n.x * n.x * s, -n.x * n.y * s, -n.x);
    let y = Vector::new(-n.x * n.y * s, 1.0 - n.y * n.y * s, -n.y);
    Matrix3::from_columns(&[x, y, *n])
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    /// Returns twists at zero, at every scale where a branch changes, and up to half a turn.
    fn twists() -> Vec<Twist> {
        let axis = Vector::new(0.36, -0.48, 0.8);
        let angles = [0.0, 1e-300, 1e-16, 1e-8, 1e-4, 0.0199, 0.0201, 0.3, 1.0, 3.0, PI - 1e-7];
        angles
            .iter()
            .flat_map(|&angle| {
                let omega = axis * angle;
                [0.0, 1e-6, 1.0, 1e4].map(|s| Twist::new(s, -2.0 * s, 0.5 * s, omega.x, omega.y, omega.z))
            })
            .collect()
    }

    #[test]
    fn exp_rotates_quarter_about_z() {
        // The screw of pitch zero about the vertical line through (1, 0): v = -omega x q.
        let pose = Pose::exp(&Twist::new(0.0, -PI / 2.0, 0.0, 0.0, 0.0, PI / 2.0));
        let moved = pose.transform_point(&Point::new(2.0, 0.0, 5.0));
        assert!((moved - Point::new(1.0, 1.0, 5.0)).norm() < 1e-15, "{moved}");
    }

    #[test]
    fn log_undoes_exp_at_every_scale() {
        for m in twists() {
            let back = Pose::exp(&m).log();
            let scale = m.amax().max(1.0);
            // Near half a turn the angle itself is only as accurate as the square root of the rounding error.
            let tolerance = if m.fixed_rows::<3>(3).norm() > 3.1 { 1e-8 } else { 4e-15 };
            assert!((back - m).amax() <= tolerance * scale, "{m} came back as {back}");
        }
    }

    #[test]
    fn exp_inverse_is_exp_of_opposite() {
        for m in twists() {
            let pose = Pose::exp(&m);
            assert!((pose.rotation * pose.rotation.transpose() - Matrix3::identity()).amax() < 1e-15);
            let round = pose * Pose::exp(&-m);
            assert!((round.rotation - Matrix3::identity()).amax() < 1e-15);
            assert!(round.translation_mm.amax() <= 4e-15 * m.amax().max(1.0));
        }
    }

    #[test]
    fn one_parameter_subgroups_add() {
        for m in twists() {
            let halves = Pose::exp(&(m * 0.5)) * Pose::exp(&(m * 0.5));
            let whole = Pose::exp(&m);
            assert!((halves.rotation - whole.rotation).amax() < 1e-15);
            assert!((halves.translation_mm - whole.translation_mm).amax() <= 4e-15 * m.amax().max(1.0));
        }
    }

    #[test]
    fn pose_from_rows_round_trip() {
        let pose = Pose::exp(&Twist::new(1.0, 2.0, 3.0, 0.1, 0.2, -0.3));
        let read = Pose::from_rows(pose.to_rows()).unwrap();
        assert!((read.rotation - pose.rotation).amax() < 1e-15);

        let mut mirrored = Pose::identity().to_rows();
        mirrored[0][0] = -1.0;
        assert!(
            matches!(Pose::from_rows(mirrored), Err(PoseError::NotARotation { determinant, .. }) if determinant < 0.0)
        );
        let mut broken = Pose::identity().to_rows();
        broken[1][2] = f64::NAN;
        assert!(matches!(Pose::from_rows(broken), Err(PoseError::NotFinite { row: 2, column: 3, .. })));
        let mut projective = Pose::identity().to_rows();
        projective[3][0] = 0.5;
        assert!(matches!(Pose::from_rows(projective), Err(PoseError::LastRow(_))));
    }

    #[test]
    fn min_rotation_is_exact_everywhere() {
        let near = [1e-3, 1e-7, 1e-12, 0.0].map(|e| Vector::new(e, -0.5 * e, -1.0).normalize());
        let others = [Vector::z(), Vector::x(), Vector::new(0.3, -0.4, -0.2).normalize()];
        for n in near.into_iter().chain(others) {
            let rotation = min_rotation(&n);
            assert!((rotation * Vector::z() - n).norm() < 1e-15);
            assert!((rotation * rotation.transpose() - Matrix3::identity()).amax() < 1e-15, "{n}");
            assert!((rotation.determinant() - 1.0).abs() < 1e-15);
            // A rotation about an axis in the xy plane.
            assert!((rotation[(0, 1)] - rotation[(1, 0)]).abs() < 1e-15);
        }
    }
}
