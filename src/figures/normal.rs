//! Standard normal distribution.
//!
//! [`tail`] is an approximation and stays as it is, to the last digit: records contain its values, and a run resumes
//! only if its computations repeat the recorded numbers. [`two_sided_tail`] is for values that no record contains.

use std::f64::consts::{SQRT_2, TAU};

/// Returns the probability that a standard normal variable exceeds `deviate`, with an error below 1e-7; 0 if `deviate`
/// is NaN or above 8.
pub fn tail(deviate: f64) -> f64 {
    // Abramowitz and Stegun, 26.2.17, for a deviate of at least 0; a negative one by symmetry.
    const FACTORS: [f64; 5] = [0.319_381_530, -0.356_563_782, 1.781_477_937, -1.821_255_978, 1.330_274_429];
    if deviate.is_nan() || deviate > 8.0 {
        return 0.0;
    }
    let t = 1.0 / (1.0 + 0.231_641_9 * deviate.abs());
    let series = FACTORS.iter().rev().fold(0.0, |sum, factor| (sum + factor) * t);
    let above = (-0.5 * deviate * deviate).exp() / TAU.sqrt() * series;
    if deviate >= 0.0 { above } else { 1.0 - above }
}

/// Returns the probability that a standard normal variable is at most `deviate`, with an error below 1e-7.
pub fn probability(deviate: f64) -> f64 {
    tail(-deviate)
}

/// Returns the probability that a standard normal variable is farther from 0 than `deviate`, on either side, with all
/// digits.
pub fn two_sided_tail(deviate: f64) -> f64 {
    libm::erfc(deviate.abs() / SQRT_2)
}

/// Returns the quantile of the standard normal distribution at `probability`, which must be from 0.001 to 0.999. The
/// quantile is found by bisection of the distribution function; its error is below 3e-5.
pub fn deviate(probability: f64) -> f64 {
    let (mut low, mut high) = (-4.0, 4.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if self::probability(middle) < probability { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_tail_matches_tables() {
        for (z, p) in [(0.0, 0.5), (1.0, 0.158_655_254), (-1.0, 0.841_344_746), (3.0, 0.001_349_898), (9.0, 0.0)] {
            assert!((tail(z) - p).abs() < 1e-7 && (probability(-z) - p).abs() < 1e-7, "{z}");
        }
        assert_eq!(tail(f64::INFINITY), 0.0);
        // The numbers of earlier records, to the last digit.
        for (z, p) in
            [(0.5, 0.308_537_532_212_675_16), (1.25, 0.105_649_838_962_656_06), (4.0, 3.168_603_459_117_637e-5)]
        {
            assert!((tail(z) / p - 1.0).abs() < 5e-16, "{z}");
        }
    }

    #[test]
    fn two_sided_tail_is_exact() {
        for (z, p) in
            [(0.0, 1.0), (0.5, 0.617_075_077_451_974), (2.0, 0.045_500_263_896_358_4), (6.0, 1.973_175_290_075_402e-9)]
        {
            assert!((two_sided_tail(z) / p - 1.0).abs() < 1e-12 && two_sided_tail(-z) == two_sided_tail(z), "{z}");
        }
    }

    #[test]
    fn deviate_inverts_probability() {
        for k in 1..1000 {
            let p = f64::from(k) / 1000.0;
            let z = deviate(p);
            assert!((probability(z) - p).abs() < 1e-8, "{p}");
            assert!((0.5 * two_sided_tail(z) - p.min(1.0 - p)).abs() < 1e-7, "{p}");
        }
    }
}
