//! Frames of curves and surfaces.

use nalgebra::Matrix3;

use crate::geometry::{Point, Pose, Vector};

/// Right-handed frame of axes of length 1, in the frame of the model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// The origin in millimetres.
    pub origin: Point,
    /// The axes x, y and z.
    pub axes: [Vector; 3],
}

impl Frame {
    /// Returns the frame with the given z axis. The x axis is the part of `x` that is perpendicular to it. Returns
    /// `None` if the two are parallel, or if one is zero or not finite.
    pub fn new(origin: Point, z: Vector, x: Vector) -> Option<Self> {
        let z = z.try_normalize(1e-300)?;
        let x = x.try_normalize(1e-300)?;
        let x = (x - z * x.dot(&z)).try_normalize(1e-9)?;
        let finite = (origin.coords.sum() + x.sum() + z.sum()).is_finite();
        finite.then(|| Self { origin, axes: [x, z.cross(&x), z] })
    }

    /// Returns the coordinates of `p` in this frame.
    pub(super) fn local(&self, p: &Point) -> Vector {
        let d = p - self.origin;
        Vector::new(d.dot(&self.axes[0]), d.dot(&self.axes[1]), d.dot(&self.axes[2]))
    }

    /// Returns the direction that has the coordinates (`x`, `y`, `z`) in this frame.
    pub(super) fn direction(&self, x: f64, y: f64, z: f64) -> Vector {
        self.axes[0] * x + self.axes[1] * y + self.axes[2] * z
    }

    /// Returns the pose that transforms coordinates in this frame to those of the frame in which it is given.
    pub fn pose(&self) -> Pose {
        Pose { rotation: Matrix3::from_columns(&self.axes), translation_mm: self.origin.coords }
    }

    /// Returns the frame moved by `motion`.
    pub(super) fn moved(&self, motion: &Pose) -> Self {
        let axes = self.axes.map(|axis| motion.transform_direction(&axis));
        Self { origin: motion.transform_point(&self.origin), axes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frame_is_right_handed() {
        let frame = Frame::new(Point::origin(), Vector::new(0.0, 2.0, 0.0), Vector::new(1.0, 5.0, 0.0)).unwrap();
        let [x, y, z] = frame.axes;
        assert!((x - Vector::x()).norm() < 1e-15 && (z - Vector::y()).norm() < 1e-15);
        assert!((y + Vector::z()).norm() < 1e-15);
        assert_eq!(Frame::new(Point::origin(), Vector::z(), Vector::z() * 4.0), None);
        assert_eq!(Frame::new(Point::origin(), Vector::zeros(), Vector::x()), None);
        assert_eq!(Frame::new(Point::new(f64::NAN, 0.0, 0.0), Vector::z(), Vector::x()), None);
    }
}
