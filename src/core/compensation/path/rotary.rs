//! Rotary axis of a machine, and how the wheel is tilted about it.

use crate::geometry::Vector;

/// Axis of the model frame about which a head rotates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RotationAxis {
    /// x, the axis of an A rotation.
    X,
    /// y, the axis of a B rotation.
    Y,
}

/// Rotary axis of a head.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RotaryAxis {
    /// Letter of the axis in programs.
    pub letter: char,
    /// Axis of rotation, right-handed.
    pub axis: RotationAxis,
    /// True if the scale of the axis counts in the opposite direction.
    pub reversed: bool,
    /// Minimum and maximum angle on the scale of the axis.
    pub range_rad: [f64; 2],
    /// Maximum angular speed.
    pub rate_rad_s: f64,
    /// Increment of the written angles; 0 if every angle can be written.
    pub step_rad: f64,
    /// Vector from the wheel's centre to the pivot with the head upright. `None` if the control itself keeps the
    /// wheel's centre at the programmed position.
    pub pivot_mm: Option<Vector>,
}

/// Tilt of a wheel, right-handed about the axis of its head.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TiltMode {
    /// The same angle everywhere.
    Constant {
        /// Tilt angle.
        angle_rad: f64,
    },
    /// An angle that follows the normal of the surface, seen along the axis.
    Following {
        /// Angle from the normal to the axis of the head.
        lead_rad: f64,
    },
}

impl RotaryAxis {
    /// Returns the vector `v` after a rotation of the head by `angle_rad` about the rotary axis, right-handed. `v`
    /// turns with the head. It is given as it points when the head is upright (angle 0).
    #[inline]
    pub fn rotated(&self, v: &Vector, angle_rad: f64) -> Vector {
        let (s, c) = angle_rad.sin_cos();
        match self.axis {
            RotationAxis::X => Vector::new(v.x, v.y * c - v.z * s, v.y * s + v.z * c),
            RotationAxis::Y => Vector::new(v.x * c + v.z * s, v.y, v.z * c - v.x * s),
        }
    }

    /// Converts the angle `angle_rad`, right-handed about the rotary axis, into the angle that the scale of the machine
    /// shows, in rad. The sign changes if the scale counts in the opposite direction ([`RotaryAxis::reversed`]).
    /// Otherwise the angle is unchanged.
    pub fn scale_reading_rad(&self, angle_rad: f64) -> f64 {
        if self.reversed { 0.0 - angle_rad } else { angle_rad }
    }

    /// Returns the offset, in mm, that must be added to the positions of the linear axes so that the wheel's centre
    /// does not move when the head tilts by `angle_rad`. The head rotates about a pivot point that is not the wheel's
    /// centre.
    ///
    /// Equation: (R - 1) v, where R is the rotation by `angle_rad`, and v is the vector from the wheel's centre to the
    /// pivot of the upright head. Returns 0 if the controller itself keeps the centre in place (`pivot_mm` is `None`).
    #[inline]
    pub fn pivot_shift_mm(&self, angle_rad: f64) -> Vector {
        self.pivot_mm.map_or_else(Vector::zeros, |pivot| self.rotated(&pivot, angle_rad) - pivot)
    }

    /// Returns the angle, in rad, by which the head must rotate so that its axis (z of the upright head) points along
    /// the surface normal. The normal is first projected onto the plane perpendicular to the rotary axis.
    #[inline]
    pub(super) fn normal_tilt_rad(&self, normal: &Vector) -> f64 {
        match self.axis {
            RotationAxis::X => (-normal.y).atan2(normal.z),
            RotationAxis::Y => normal.x.atan2(normal.z),
        }
    }

    #[inline]
    pub(super) fn rounded(&self, angle_rad: f64) -> f64 {
        if self.step_rad > 0.0 { (angle_rad / self.step_rad).round() * self.step_rad } else { angle_rad }
    }

    /// Returns the largest height, in mm, that [`Self::pivot_shift_mm`] adds to the linear axes at any angle in the
    /// range of the axis.
    pub(super) fn max_lift_mm(&self) -> f64 {
        let [a, b] = self.range_rad.map(|angle| self.scale_reading_rad(angle));
        // The height is a sine of the angle: this number of samples finds its maximum to a millionth of the distance
        // to the pivot.
        const SAMPLES: u32 = 2000;
        let at = |k: u32| a + (b - a) * f64::from(k) / f64::from(SAMPLES);
        (0..=SAMPLES).map(|k| self.pivot_shift_mm(at(k)).z).fold(f64::NEG_INFINITY, f64::max)
    }
}
