//! Coordinates of small motions.

use nalgebra::{Matrix3, Matrix3x6, Matrix6, Vector6};

use crate::geometry::{Point, Pose, Twist, Vector};

/// Centre and size to which small motions refer. A motion has three translations in millimetres, and three rotations in
/// millimetres at the distance `size_mm` from the centre.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scale {
    pub(super) centre: Point,
    pub(super) size_mm: f64,
}

impl Scale {
    /// Returns the scale of some places: their mean, and the root mean square of their distances from it.
    pub(super) fn of_places<'a>(places: impl Iterator<Item = &'a Point> + Clone) -> Self {
        let (sum, count) = places.clone().fold((Vector::zeros(), 0.0), |(sum, n), p| (sum + p.coords, n + 1.0));
        let centre = Point::from(sum / count);
        let square: f64 = places.map(|p| (p - centre).norm_squared()).sum();
        Self { centre, size_mm: (square / count).sqrt() }
    }

    /// Returns the derivative of a deviation by the motion of its map: J = [n, (p - c) x n / s].
    pub(super) fn jacobian(&self, point: &Point, normal: &Vector) -> Vector6<f64> {
        let turn = (point - self.centre).cross(normal) / self.size_mm;
        Vector6::new(normal.x, normal.y, normal.z, turn.x, turn.y, turn.z)
    }

    /// Returns the pose that makes a motion.
    pub(super) fn pose(&self, motion: &Vector6<f64>) -> Pose {
        let [x, y, z] = [3, 4, 5].map(|k| motion[k] / self.size_mm);
        let turn = Pose::exp(&Twist::new(0.0, 0.0, 0.0, x, y, z));
        let shift = Vector::new(motion[0], motion[1], motion[2]);
        let centre = self.centre.coords;
        Pose { rotation: turn.rotation, translation_mm: centre + shift - turn.rotation * centre }
    }

    /// Returns the motion that a pose makes.
    pub(super) fn motion(&self, pose: &Pose) -> Vector6<f64> {
        let shift = pose.transform_point(&self.centre) - self.centre;
        let twist = pose.log();
        let [x, y, z] = [3, 4, 5].map(|k| twist[k] * self.size_mm);
        Vector6::new(shift.x, shift.y, shift.z, x, y, z)
    }

    /// Returns the matrix that gives the shift of a point by a motion.
    pub(super) fn shift_from_motion(&self, point: &Point) -> Matrix3x6<f64> {
        let arm = (point - self.centre) / self.size_mm;
        let mut shift = Matrix3x6::zeros();
        shift.fixed_view_mut::<3, 3>(0, 0).copy_from(&Matrix3::identity());
        shift.fixed_view_mut::<3, 3>(0, 3).copy_from(&-arm.cross_matrix());
        shift
    }

    /// Returns the variance of the shift of a point along the surface, from the covariance of the motion: the mean of the
    /// two directions.
    pub(super) fn lateral_variance(&self, covariance: &Matrix6<f64>, point: &Point, normal: &Vector) -> f64 {
        let shift = self.shift_from_motion(point);
        let spread = shift * covariance * shift.transpose();
        (0.5 * (spread.trace() - (normal.transpose() * spread * normal)[0])).max(0.0)
    }

    /// Returns the matrix that transforms a motion to a small twist about the origin: translation in millimetres,
    /// rotation in radians.
    pub(super) fn twist_from_motion(&self) -> Matrix6<f64> {
        let mut matrix = Matrix6::identity();
        matrix.fixed_view_mut::<3, 3>(3, 3).scale_mut(1.0 / self.size_mm);
        // The point at the origin moves by t + w x (0 - c) = t + c x w.
        let across = self.centre.coords.cross_matrix() / self.size_mm;
        matrix.fixed_view_mut::<3, 3>(0, 3).copy_from(&across);
        matrix
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn motion_and_pose_agree() {
        let scale = Scale { centre: Point::new(10.0, -20.0, 5.0), size_mm: 30.0 };
        let motion = Vector6::new(0.03, -0.02, 0.01, 0.05, -0.04, 0.02);
        let pose = scale.pose(&motion);
        assert!((scale.motion(&pose) - motion).norm() < 1e-13);
        let (point, normal) = (Point::new(40.0, 7.0, -3.0), Vector::new(0.1, -0.2, 1.0).normalize());
        let small = motion * 1e-5;
        let moved = (scale.pose(&small).transform_point(&point) - point).dot(&normal);
        assert!((moved - scale.jacobian(&point, &normal).dot(&small)).abs() < 1e-11);
        let twist = scale.twist_from_motion() * small;
        assert!(
            (Pose::exp(&twist).transform_point(&point) - scale.pose(&small).transform_point(&point)).norm() < 1e-11
        );
    }

    #[test]
    fn lateral_variance_of_known_motions() {
        let scale = Scale { centre: Point::origin(), size_mm: 10.0 };
        let (point, normal) = (Point::new(20.0, 0.0, 0.0), Vector::z());
        let one = |k: usize| Matrix6::from_diagonal(&Vector6::ith(k, 1.0));
        // Shifts along x and y, none along z; a rotation about z shifts by twice the motion at twice the size.
        let variances = [0, 1, 2, 3, 4, 5].map(|k| scale.lateral_variance(&one(k), &point, &normal));
        assert_eq!(variances, [0.5, 0.5, 0.0, 0.0, 0.0, 2.0]);
    }

    #[test]
    fn scale_of_square() {
        let places = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]].map(|[x, y]| Point::new(x, y, 7.0));
        let scale = Scale::of_places(places.iter());
        assert_eq!(scale.centre, Point::new(1.0, 1.0, 7.0));
        assert!((scale.size_mm - 2f64.sqrt()).abs() < 1e-15);
    }
}
