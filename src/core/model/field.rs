//! Random field in the plane: its strength, range, smoothness and anisotropy.

use faer::Mat;

use super::ModelError;
use super::matern::Correlation;
use super::matern::Smoothness;

/// Random field with mean 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Field {
    /// Standard deviation of the field about 0.
    pub sigma_mm: f64,
    /// Distance at which the correlation has fallen to 0.14. If the field is anisotropic, the geometric mean of this
    /// distance along and across the anisotropy.
    pub range_mm: f64,
    /// Smoothness of the field.
    pub smoothness: Smoothness,
    /// Direction along which the range is longest, and ratio of the ranges along and across it.
    pub anisotropy: Anisotropy,
}

/// Anisotropy of a field: its range along one direction is longer than across it, as in the tracks of a grinding wheel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Anisotropy {
    /// Direction, a unit vector.
    pub along: [f64; 2],
    /// Ratio of the range along to the range across; 1 if all directions are alike.
    pub stretch: f64,
}

impl Anisotropy {
    /// Isotropic: all directions are alike.
    pub const NONE: Self = Self { along: [1.0, 0.0], stretch: 1.0 };

    /// Creates an anisotropy. `angle_rad` is the angle from the x axis to the direction in which the range of the field
    /// is longest. `stretch` is the range along this direction, divided by the range across it. The values are not
    /// checked.
    pub fn from_angle(angle_rad: f64, stretch: f64) -> Self {
        Self { along: [angle_rad.cos(), angle_rad.sin()], stretch }
    }

    /// Rotates a position into the axes of the anisotropy. Returns two coordinates: along the direction
    /// [`Anisotropy::along`], and perpendicular to this direction.
    pub(super) fn rotated(self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [c, s] = self.along;
        [c * x + s * y, c * y - s * x]
    }

    /// Returns the angle from the x axis to the direction of the longest range, in radians, above -pi/2 and at most
    /// pi/2. Returns `None` if the field is isotropic.
    pub fn angle_rad(&self) -> Option<f64> {
        let [c, s] = self.along;
        let angle = if c > 0.0 || c == 0.0 && s > 0.0 { s.atan2(c) } else { (-s).atan2(-c) };
        (self.stretch > 1.0).then_some(angle)
    }
}

impl Field {
    /// Creates an isotropic field with the standard deviation `sigma_mm` and the range `range_mm`. Its smoothness is
    /// [`Smoothness::Matern2`].
    pub const fn new(sigma_mm: f64, range_mm: f64) -> Self {
        Self { sigma_mm, range_mm, smoothness: Smoothness::Matern2, anisotropy: Anisotropy::NONE }
    }

    /// Returns the covariance of the values of the field at the places `a` and `b`, in mm^2.
    pub fn covariance_mm2(&self, a: [f64; 2], b: [f64; 2]) -> f64 {
        self.pair_covariance().covariance_mm2(a, b)
    }

    /// Precomputes the constants of the covariance function of this field. With the result, the covariances of many
    /// pairs of positions are computed fast.
    pub(super) fn pair_covariance(&self) -> PairCovariance {
        let [x, y] = [[1.0, 0.0], [0.0, 1.0]].map(|axis| self.isotropic_place(axis).map(|v| v / self.range_mm));
        PairCovariance { x, y, variance_mm2: self.sigma_mm * self.sigma_mm, curve: Correlation::new(self.smoothness) }
    }

    /// Maps a position to coordinates in which the field is isotropic. The coordinate along the anisotropy is divided
    /// by the root of the stretch, and the coordinate across it is multiplied by this root. Areas do not change.
    /// Returns `at` unchanged if the field is isotropic.
    fn isotropic_place(&self, at: [f64; 2]) -> [f64; 2] {
        if self.anisotropy.stretch == 1.0 {
            return at;
        }
        let root = self.anisotropy.stretch.sqrt();
        let [along, across] = self.anisotropy.rotated(at);
        [along / root, across * root]
    }

    /// Checks that the standard deviation and the range are finite and above 0, that the direction of the anisotropy is
    /// a unit vector, and that its stretch is at least 1.
    ///
    /// # Errors
    /// Returns [`ModelError::Hyperparameter`] or [`ModelError::Anisotropy`] with the wrong value.
    pub(super) fn check(&self) -> Result<(), ModelError> {
        for (what, value) in [("standard deviation of the field", self.sigma_mm), ("range", self.range_mm)] {
            if !(value.is_finite() && value > 0.0) {
                return Err(ModelError::Hyperparameter { what, value });
            }
        }
        let Anisotropy { along: [c, s], stretch } = self.anisotropy;
        let is_lay = stretch.is_finite() && stretch >= 1.0 && (c.hypot(s) - 1.0).abs() < 1e-9;
        if is_lay { Ok(()) } else { Err(ModelError::Anisotropy { along: [c, s], stretch }) }
    }
}

/// Field, prepared for the covariance of many pairs of places.
#[derive(Clone, Copy)]
pub(super) struct PairCovariance {
    /// Images of the unit vectors along x and y in the plane in which the field is isotropic and has a range of 1.
    x: [f64; 2],
    y: [f64; 2],
    variance_mm2: f64,
    curve: Correlation,
}

impl PairCovariance {
    #[inline]
    pub(super) fn covariance_mm2(&self, a: [f64; 2], b: [f64; 2]) -> f64 {
        let (dx, dy) = (a[0] - b[0], a[1] - b[1]);
        let (u, v) = (self.x[0] * dx + self.y[0] * dy, self.x[1] * dx + self.y[1] * dy);
        self.variance_mm2 * self.curve.at(u * u + v * v)
    }

    /// Computes the covariance, in mm^2, between the value of the field at `at` and its value at each of `places`.
    /// Writes one covariance for each place to `into`.
    pub(super) fn column(&self, at: [f64; 2], places: &[[f64; 2]], into: &mut [f64]) {
        into.iter_mut().zip(places).for_each(|(into, place)| *into = self.covariance_mm2(at, *place));
    }

    /// Returns the matrix of the covariances of the field at two sets of places, in mm^2: one row for each place of
    /// `rows`, one column for each place of `columns`.
    pub(super) fn cross_covariance(&self, rows: &[[f64; 2]], columns: &[[f64; 2]]) -> Mat<f64> {
        let mut across = Mat::zeros(rows.len(), columns.len());
        columns.iter().enumerate().for_each(|(c, at)| self.column(*at, rows, across.col_as_slice_mut(c)));
        across
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn anisotropic_field_range_by_direction() {
        let field = Field { anisotropy: Anisotropy::from_angle(0.5, 4.0), ..Field::new(2.0, 30.0) };
        let at = |r: f64, angle: f64| field.covariance_mm2([1.0, 1.0], [1.0 + r * angle.cos(), 1.0 + r * angle.sin()]);
        let alike = Field::new(2.0, 30.0).covariance_mm2([0.0; 2], [20.0, 0.0]);
        // The range along is 4 times that across: twice the mean along, half of it across.
        assert!((at(40.0, 0.5) - alike).abs() < 1e-12, "{} {alike}", at(40.0, 0.5));
        assert!((at(10.0, 0.5 + std::f64::consts::FRAC_PI_2) - alike).abs() < 1e-12);
        assert_eq!(field.covariance_mm2([3.0, 4.0], [3.0, 4.0]), 4.0);
        let angle_deg =
            |angle: f64| Anisotropy::from_angle(f64::to_radians(angle), 2.0).angle_rad().unwrap().to_degrees();
        for (angle, told) in [(30.0, 30.0), (120.0, -60.0), (-150.0, 30.0), (90.0, 90.0)] {
            assert!((angle_deg(angle) - told).abs() < 1e-9, "{angle}: {}", angle_deg(angle));
        }
        assert_eq!(Anisotropy::NONE.angle_rad(), None);
    }

    #[test]
    fn field_check_refuses_bad_values() {
        let of = |field: Field| field.check().err().map(|error| error.to_string()).unwrap_or_default();
        assert!(of(Field::new(0.0, 1.0)).contains("the field is 0 mm"));
        assert!(of(Field::new(1.0, f64::INFINITY)).contains("the range is inf mm"));
        for lay in [
            Anisotropy::from_angle(0.0, 0.5),
            Anisotropy::from_angle(f64::NAN, 2.0),
            Anisotropy { along: [1.0, 1.0], stretch: 2.0 },
        ] {
            assert!(of(Field { anisotropy: lay, ..Field::new(1.0, 1.0) }).contains("lay"));
        }
        assert!(of(Field { anisotropy: Anisotropy::from_angle(3.0, 5.0), ..Field::new(1.0, 1.0) }).is_empty());
    }
}
