//! The correlation of a Matern field of smoothness 2.
//!
//! M(x) = x^2 K_2(x) / 2 with x = kappa r, kappa = 4 / range: at one range the correlation has fallen to about 0.1. K_2 is the modified
//! Bessel function of the second kind; its integral over exp(-x cosh t) cosh(2 t) is summed once at equal steps of x, and read by cubics
//! between them: within 1e-10.

use std::sync::OnceLock;

/// Steps of the table in 1, and where it ends: M(45) is below 1e-16.
const STEPS: usize = 256;
const LAST: usize = 45;

/// Returns the correlation at a distance of `x` in units of 1 / kappa.
pub(super) fn correlation(x: f64) -> f64 {
    static TABLE: OnceLock<Vec<[f64; 2]>> = OnceLock::new();
    let table = TABLE.get_or_init(|| (0..=LAST * STEPS).map(|k| exact(k as f64 / STEPS as f64)).collect());
    let at = (x.abs() * STEPS as f64).min((LAST * STEPS) as f64);
    let k = at as usize;
    let (Some([a, da]), Some([b, db])) = (table.get(k), table.get(k + 1)) else { return 0.0 };
    let t = at - k as f64;
    let h = 1.0 / STEPS as f64;
    let (u, v) = (1.0 - t, t);
    u * u * (1.0 + 2.0 * v) * a + v * v * (1.0 + 2.0 * u) * b + h * u * v * (u * da - v * db)
}

/// The correlation and its slope: M' = -x^2 K_1(x) / 2.
fn exact(x: f64) -> [f64; 2] {
    if x == 0.0 {
        return [1.0, 0.0];
    }
    let half_square = 0.5 * x * x;
    [half_square * bessel(2.0, x), -half_square * bessel(1.0, x)]
}

/// K_nu(x) by equal steps: the integrand is analytic and falls doubly exponentially, so the sum is exact to rounding.
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

#[cfg(test)]
mod tests {
    use super::*;

    /// K_2 from tables (Abramowitz and Stegun, 9.8; Wolfram): 0.1, 1, 2, 5, 10.
    const K2: [(f64, f64); 5] = [
        (0.1, 199.503_964_642_114_1),
        (1.0, 1.624_838_898_635_177_4),
        (2.0, 0.253_759_754_566_055_8),
        (5.0, 5.308_943_712_223_46e-3),
        (10.0, 2.150_981_700_693_277e-5),
    ];

    #[test]
    fn it_is_that_of_the_tables() {
        for (x, k2) in K2 {
            let expected = 0.5 * x * x * k2;
            assert!((correlation(x) / expected - 1.0).abs() < 1e-10, "{x}: {} {expected}", correlation(x));
        }
        assert_eq!(correlation(0.0), 1.0);
        assert_eq!(correlation(1e9), 0.0);
        assert_eq!(correlation(f64::INFINITY), 0.0);
    }

    #[test]
    fn between_the_steps_it_is_as_exact() {
        for k in 0..4000 {
            let x = 1e-4 + 0.011_37 * f64::from(k);
            assert!((correlation(x) - exact(x)[0]).abs() < 1e-10, "{x}");
        }
    }

    #[test]
    fn at_one_range_it_has_fallen_to_a_tenth() {
        assert!((correlation(4.0) - 0.139).abs() < 1e-3, "{}", correlation(4.0));
    }
}
