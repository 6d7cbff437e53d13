//! Correlation of a field over the distance, by its smoothness.
//!
//! The Matern correlation of smoothness nu is M(x) = 2^(1 - nu) x^nu K_nu(x) / Gamma(nu) with x = kappa r and kappa =
//! sqrt(8 nu) / range. It is exp(-x) for nu = 1/2, and x^2 K_2(x) / 2 for nu = 2. At a distance of one range it has
//! fallen to 0.14. In the limit of large nu it is exp(-2 (r / range)^2).
//!
//! K_2 is the modified Bessel function of the second kind. Its integral over exp(-x cosh t) cosh(2 t) is summed once at
//! equal steps of x. Between these steps, cubics interpolate within 1e-10.

use std::sync::OnceLock;

/// Number of steps of the table per unit of x, and largest x of the table. The correlation and its slope are below
/// 1e-14 there.
const STEPS: usize = 256;
const LAST: usize = 45;
const STEPS_PER_RANGE: f64 = 4.0 * STEPS as f64;

/// Table of the Matern correlation for nu = 2 and of its slope, in equal steps of x.
type Table = OnceLock<Vec<[f64; 2]>>;

/// Correlation over the distance for one smoothness, the same for every pair of places.
#[derive(Clone, Copy)]
pub(super) struct Correlation {
    /// Table from which the correlation is interpolated; `None` if the correlation is an exponential function.
    table: Option<&'static [[f64; 2]]>,
    /// True if the exponent is proportional to the distance; false if it is proportional to the square of the distance.
    is_rough: bool,
}

impl Correlation {
    pub(super) fn new(smoothness: Smoothness) -> Self {
        static ONCE: Table = Table::new();
        Self {
            table: (smoothness == Smoothness::Matern2).then(|| read(&ONCE)),
            is_rough: smoothness == Smoothness::Exponential,
        }
    }

    /// Returns the correlation of the field at two places with the distance r, from 0 to 1. `ranges2` is (r / range)^2.
    #[inline]
    pub(super) fn at(&self, ranges2: f64) -> f64 {
        let Some(table) = self.table else {
            return (-2.0 * if self.is_rough { ranges2.sqrt() } else { ranges2 }).exp();
        };
        let at = (STEPS_PER_RANGE * ranges2.sqrt()).min((LAST * STEPS) as f64);
        let k = at as usize;
        let Some([[a, da], [b, db]]) = table.get(k..k + 2).and_then(|pair| pair.first_chunk::<2>()) else { return 0.0 };
        let t = at - k as f64;
        let (u, v) = (1.0 - t, t);
        const H: f64 = 1.0 / STEPS as f64;
        u * u * (1.0 + 2.0 * v) * a + v * v * (1.0 + 2.0 * u) * b + H * u * v * (u * da - v * db)
    }
}

fn read(table: &'static Table) -> &'static [[f64; 2]] {
    table.get_or_init(|| (0..=LAST * STEPS).map(|k| exact(k as f64 / STEPS as f64)).collect())
}

/// Returns the Matern correlation M(x) for the smoothness nu = 2, and its derivative M'(x) = -x^2 K_1(x) / 2. The
/// argument x is the distance of two places times sqrt(8 nu) / range. K_1 is the modified Bessel function of the second
/// kind and order 1.
fn exact(x: f64) -> [f64; 2] {
    if x == 0.0 {
        return [1.0, 0.0];
    }
    [0.5 * x * x * bessel(2.0, x), -0.5 * x * x * bessel(1.0, x)]
}

/// Computes K_nu(x), the modified Bessel function of the second kind and order `nu`, for `x` above 0. The integral of
/// the function is evaluated by the trapezoidal rule. This is exact to rounding, because the integrand is analytic and
/// falls doubly exponentially.
fn bessel(nu: f64, x: f64) -> f64 {
    const STEP: f64 = 0.125;
    let term = |t: f64| (-x * t.cosh()).exp() * (nu * t).cosh();
    let terms = (1..).map(|k| term(STEP * f64::from(k)));
    let begins = term(0.0);
    let mut largest = begins;
    let mut sum = 0.5 * begins;
    for value in terms {
        sum += value;
        largest = largest.max(value);
        if value <= 1e-18 * largest {
            break;
        }
    }
    STEP * sum
}

/// Smoothness of a field: the nu of its Matern covariance, or how many times it can be differentiated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Smoothness {
    /// nu = 1/2, exp(-2 r / range): the roughest, nowhere differentiable.
    Exponential,
    /// nu = 2: differentiable once.
    Matern2,
    /// nu = infinity, exp(-2 (r / range)^2): differentiable any number of times.
    SquaredExponential,
}

impl Smoothness {
    /// Returns the parameter nu of the Matern covariance; `None` for [`Smoothness::SquaredExponential`], where nu is
    /// infinite.
    pub(super) fn nu(self) -> Option<f64> {
        match self {
            Self::Exponential => Some(0.5),
            Self::Matern2 => Some(2.0),
            Self::SquaredExponential => None,
        }
    }

    /// Returns a word that says how many times the field can be differentiated: `never`, `once` or `endless` (any
    /// number of times).
    pub fn name(self) -> &'static str {
        match self {
            Self::Exponential => "never",
            Self::Matern2 => "once",
            Self::SquaredExponential => "endless",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn correlation(smoothness: Smoothness, ranges: f64) -> f64 {
        Correlation::new(smoothness).at(ranges * ranges)
    }

    /// Values of K_2 from tables (Abramowitz and Stegun, 9.8; Wolfram) at 0.1, 1, 2, 5, 10.
    const K: [(f64, f64); 5] = [
        (0.1, 199.503_964_642_114_1),
        (1.0, 1.624_838_898_635_177_4),
        (2.0, 0.253_759_754_566_055_8),
        (5.0, 5.308_943_712_223_46e-3),
        (10.0, 2.150_981_700_693_277e-5),
    ];

    #[test]
    fn matern_matches_bessel_tables() {
        for (x, k2) in K {
            let (found, expected) = (correlation(Smoothness::Matern2, x / 4.0), 0.5 * x * x * k2);
            assert!((found / expected - 1.0).abs() < 1e-10, "{x}: {found} {expected}");
            let rough = correlation(Smoothness::Exponential, x / 2.0);
            assert!((rough / (-x).exp() - 1.0).abs() < 1e-14, "{x}: {rough}");
        }
        for smoothness in ALL {
            assert_eq!(correlation(smoothness, 0.0), 1.0);
            assert_eq!(correlation(smoothness, 1e9), 0.0);
            assert_eq!(correlation(smoothness, f64::INFINITY), 0.0);
        }
    }

    const ALL: [Smoothness; 3] = [Smoothness::Exponential, Smoothness::Matern2, Smoothness::SquaredExponential];

    #[test]
    fn matern_interpolation_is_exact() {
        for k in 0..4000 {
            let x = 1e-4 + 0.011_37 * f64::from(k);
            let found = correlation(Smoothness::Matern2, x / 4.0);
            assert!((found - exact(x)[0]).abs() < 1e-10, "{x}");
        }
    }

    #[test]
    fn matern_at_one_range() {
        for smoothness in ALL {
            assert!((correlation(smoothness, 1.0) - 0.138).abs() < 4e-3, "{}", correlation(smoothness, 1.0));
        }
    }
}
