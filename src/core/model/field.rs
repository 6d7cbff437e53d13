//! A random field in the plane: how strong it is, how wide, how smooth, and along what lay.

use faer::Mat;

use super::ModelError;
use super::matern::Curve;

/// A random field whose mean is 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Field {
    /// Standard deviation of the field about 0.
    pub sigma_mm: f64,
    /// The distance at which it has all but forgotten itself: correlation 0.14. Where it has a lay, the geometric mean of those along and across it.
    pub range_mm: f64,
    /// How smooth it is.
    pub smoothness: Smoothness,
    /// The direction along which it is wider.
    pub lay: Anisotropy,
}

/// How smooth a field is: the nu of its Matern covariance, or how often it can be differentiated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Smoothness {
    /// nu = 1/2, exp(-2 r / range), the roughest: nowhere.
    Never,
    /// nu = 2: once.
    Once,
    /// nu without end, exp(-2 (r / range)^2): as often as one likes.
    Endless,
}

/// The direction along which a field is wider than across, as the tracks of a wheel make it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Anisotropy {
    /// The direction, a unit vector.
    pub along: [f64; 2],
    /// How many times as wide it is along as across; 1 where all directions are alike.
    pub stretch: f64,
}

impl Smoothness {
    /// Returns its word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Never => "never",
            Self::Once => "once",
            Self::Endless => "endless",
        }
    }
}

impl Anisotropy {
    /// All directions are alike.
    pub const NONE: Self = Self { along: [1.0, 0.0], stretch: 1.0 };

    /// A lay by its angle from x.
    pub fn at(angle_rad: f64, stretch: f64) -> Self {
        Self { along: [angle_rad.cos(), angle_rad.sin()], stretch }
    }

    /// Returns its angle from x, above -90 degrees and 90 at most; none where all directions are alike.
    pub fn angle_rad(&self) -> Option<f64> {
        let [c, s] = self.along;
        let angle = if c > 0.0 || c == 0.0 && s > 0.0 { s.atan2(c) } else { (-s).atan2(-c) };
        (self.stretch > 1.0).then_some(angle)
    }
}

impl Field {
    /// A field that is the same in all directions and can be differentiated once.
    pub const fn new(sigma_mm: f64, range_mm: f64) -> Self {
        Self { sigma_mm, range_mm, smoothness: Smoothness::Once, lay: Anisotropy::NONE }
    }

    /// Returns the covariance of the field at two places.
    pub fn covariance_mm2(&self, a: [f64; 2], b: [f64; 2]) -> f64 {
        self.pairs().covariance_mm2(a, b)
    }

    /// What the covariance of every pair of places is told by: for who asks for many.
    pub(super) fn pairs(&self) -> Pairs {
        let [x, y] = [[1.0, 0.0], [0.0, 1.0]].map(|axis| self.straightened(axis).map(|v| v / self.range_mm));
        Pairs { x, y, variance_mm2: self.sigma_mm * self.sigma_mm, curve: Curve::of(self.smoothness) }
    }

    /// Takes the plane to one in which the field is alike in all directions; an area stays as large as it is.
    pub(super) fn straightened(&self, at: [f64; 2]) -> [f64; 2] {
        let Anisotropy { along: [c, s], stretch } = self.lay;
        if stretch == 1.0 {
            return at;
        }
        let root = stretch.sqrt();
        [(c * at[0] + s * at[1]) / root, (c * at[1] - s * at[0]) * root]
    }

    /// Says what makes this no field.
    pub(super) fn check(&self) -> Result<(), ModelError> {
        for (what, value) in [("field", self.sigma_mm), ("range", self.range_mm)] {
            if !(value.is_finite() && value > 0.0) {
                return Err(ModelError::Hyper { what, value });
            }
        }
        let Anisotropy { along: [c, s], stretch } = self.lay;
        let is_lay = stretch.is_finite() && stretch >= 1.0 && (c.hypot(s) - 1.0).abs() < 1e-9;
        if is_lay { Ok(()) } else { Err(ModelError::Lay { along: [c, s], stretch }) }
    }
}

/// A field, as it is asked for pairs of places.
#[derive(Clone, Copy)]
pub(super) struct Pairs {
    /// Where the axes go in the plane in which the field is alike in all directions and has a range of 1.
    x: [f64; 2],
    y: [f64; 2],
    variance_mm2: f64,
    curve: Curve,
}

impl Pairs {
    #[inline]
    pub(super) fn covariance_mm2(&self, a: [f64; 2], b: [f64; 2]) -> f64 {
        let (dx, dy) = (a[0] - b[0], a[1] - b[1]);
        let (u, v) = (self.x[0] * dx + self.y[0] * dy, self.x[1] * dx + self.y[1] * dy);
        self.variance_mm2 * self.curve.at(u * u + v * v)
    }

    /// Writes the covariances of a place with others.
    pub(super) fn column(&self, at: [f64; 2], places: &[[f64; 2]], into: &mut [f64]) {
        into.iter_mut().zip(places).for_each(|(into, place)| *into = self.covariance_mm2(at, *place));
    }

    /// The covariances of some places, a row each, with others, a column each.
    pub(super) fn across(&self, rows: &[[f64; 2]], columns: &[[f64; 2]]) -> Mat<f64> {
        let mut across = Mat::zeros(rows.len(), columns.len());
        columns.iter().enumerate().for_each(|(c, at)| self.column(*at, rows, across.col_as_slice_mut(c)));
        across
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn along_its_lay_a_field_is_wider_and_its_range_is_the_mean_of_both() {
        let field = Field { lay: Anisotropy::at(0.5, 4.0), ..Field::new(2.0, 30.0) };
        let at = |r: f64, angle: f64| field.covariance_mm2([1.0, 1.0], [1.0 + r * angle.cos(), 1.0 + r * angle.sin()]);
        let alike = Field::new(2.0, 30.0).covariance_mm2([0.0; 2], [20.0, 0.0]);
        // 4 times as wide along as across: twice and half of the mean.
        assert!((at(40.0, 0.5) - alike).abs() < 1e-12, "{} {alike}", at(40.0, 0.5));
        assert!((at(10.0, 0.5 + std::f64::consts::FRAC_PI_2) - alike).abs() < 1e-12);
        assert_eq!(field.covariance_mm2([3.0, 4.0], [3.0, 4.0]), 4.0);
        let angle_deg = |angle: f64| Anisotropy::at(f64::to_radians(angle), 2.0).angle_rad().unwrap().to_degrees();
        for (angle, told) in [(30.0, 30.0), (120.0, -60.0), (-150.0, 30.0), (90.0, 90.0)] {
            assert!((angle_deg(angle) - told).abs() < 1e-9, "{angle}: {}", angle_deg(angle));
        }
        assert_eq!(Anisotropy::NONE.angle_rad(), None);
    }

    #[test]
    fn what_is_no_field_is_refused_in_words() {
        let of = |field: Field| field.check().err().map(|error| error.to_string()).unwrap_or_default();
        assert!(of(Field::new(0.0, 1.0)).contains("the field is 0 mm"));
        assert!(of(Field::new(1.0, f64::INFINITY)).contains("the range is inf mm"));
        for lay in
            [Anisotropy::at(0.0, 0.5), Anisotropy::at(f64::NAN, 2.0), Anisotropy { along: [1.0, 1.0], stretch: 2.0 }]
        {
            assert!(of(Field { lay, ..Field::new(1.0, 1.0) }).contains("lay"));
        }
        assert!(of(Field { lay: Anisotropy::at(3.0, 5.0), ..Field::new(1.0, 1.0) }).is_empty());
    }
}
