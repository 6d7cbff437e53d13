//! Credible interval of a figure, and the probability that the figure is within a limit.

use serde::{Deserialize, Serialize};

use super::normal;

/// Median and 95 % credible interval of a figure after a measurement.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Median.
    #[serde(with = "super::number")]
    pub median_mm: f64,
    /// Quantile at 2.5 %. It is 0 if only an upper bound of the figure is known.
    #[serde(with = "super::number")]
    pub low_mm: f64,
    /// Quantile at 97.5 %.
    #[serde(with = "super::number")]
    pub high_mm: f64,
    /// Quantiles at [`Interval::PROBABILITIES`]. `None` if the figure is treated as normal, if only the interval is
    /// needed, and in records of earlier versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quantiles_mm: Option<[f64; Interval::COUNT]>,
}

impl Interval {
    /// Number of quantiles of a figure.
    pub const COUNT: usize = 15;
    /// Probabilities of the quantiles. They are dense near the usual required probabilities, and end at 0.001 and
    /// 0.999: a thousand samples do not determine quantiles beyond these.
    pub const PROBABILITIES: [f64; Self::COUNT] =
        [0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975, 0.99, 0.995, 0.999];
    /// Standard normal deviates of [`Self::PROBABILITIES`]. Between two quantiles, the figure is interpolated linearly
    /// over the deviate.
    const DEVIATES: [f64; Self::COUNT] = [
        -3.090_232_306_167_813_5,
        -2.575_829_303_548_901,
        -2.326_347_874_040_840_8,
        -1.959_963_984_540_054_2,
        -1.644_853_626_951_472_7,
        -1.281_551_565_544_600_5,
        -0.674_489_750_196_081_7,
        0.0,
        0.674_489_750_196_081_7,
        1.281_551_565_544_600_5,
        1.644_853_626_951_472_7,
        1.959_963_984_540_054_2,
        2.326_347_874_040_840_8,
        2.575_829_303_548_901,
        3.090_232_306_167_813_5,
    ];

    /// Returns the interval from `median_mm - expanded_mm` to `median_mm + expanded_mm`. `median_mm` is the value of a
    /// figure (such as PV or RMS), and `expanded_mm` is the expanded uncertainty (k = 2) of this figure. The figure is
    /// treated as normally distributed.
    pub fn from_expanded(median_mm: f64, expanded_mm: f64) -> Self {
        Self { median_mm, low_mm: median_mm - expanded_mm, high_mm: median_mm + expanded_mm, quantiles_mm: None }
    }

    /// Returns the expanded uncertainty (k = 2) of the figure, in mm. This is half of the width of the interval.
    pub fn expanded_mm(&self) -> f64 {
        0.5 * (self.high_mm - self.low_mm)
    }

    /// Returns the standard uncertainty in mm: the width of the 95 % interval divided by 3.92. The 95 % interval of a
    /// normal distribution is 3.92 standard deviations wide.
    pub fn standard_uncertainty_mm(&self) -> f64 {
        const WIDTH: f64 = 2.0 * 1.96;
        (self.high_mm - self.low_mm) / WIDTH
    }

    /// Returns the probability that the figure is at most `limit_mm`. The result is clamped to 0.001 to 0.999, because
    /// the quantiles beyond these probabilities are unknown.
    pub fn probability_within(&self, limit_mm: f64) -> f64 {
        let quantiles = self.quantiles();
        let (Some(below), last) = (quantiles.iter().rposition(|q| *q <= limit_mm), Self::COUNT - 1) else {
            return Self::PROBABILITIES[0];
        };
        if below == last {
            return Self::PROBABILITIES[last];
        }
        let share = (limit_mm - quantiles[below]) / (quantiles[below + 1] - quantiles[below]);
        if share == 0.0 {
            return Self::PROBABILITIES[below];
        }
        normal::probability(Self::DEVIATES[below] + share * (Self::DEVIATES[below + 1] - Self::DEVIATES[below]))
    }

    /// Returns the quantile of the figure at `probability` (0 to 1), in mm. A probability below 0.001 counts as 0.001,
    /// and one above 0.999 as 0.999, because no quantiles beyond these are recorded. Returns NaN if `probability` is
    /// NaN.
    pub fn quantile_mm(&self, probability: f64) -> f64 {
        // `p` and `1 - (1 - p)` differ in their last digits.
        const SAME: f64 = 1e-9;
        if probability.is_nan() {
            return f64::NAN;
        }
        let (quantiles, last) = (self.quantiles(), Self::COUNT - 1);
        let next = Self::PROBABILITIES.iter().position(|p| *p >= probability - SAME).unwrap_or(last);
        if next == 0 || Self::PROBABILITIES[next] <= probability + SAME {
            return quantiles[next];
        }
        let deviate = normal::deviate(probability);
        let share = (deviate - Self::DEVIATES[next - 1]) / (Self::DEVIATES[next] - Self::DEVIATES[next - 1]);
        quantiles[next - 1] + share * (quantiles[next] - quantiles[next - 1])
    }

    /// Returns the quantiles of the figure in mm, one for each of [`Self::PROBABILITIES`].
    ///
    /// If no quantiles were recorded, they are computed from two half normal distributions that meet at the median.
    /// Below the median, the standard deviation is `(median_mm - low_mm) / 1.96`. Above the median, it is `(high_mm -
    /// median_mm) / 1.96`.
    fn quantiles(&self) -> [f64; Self::COUNT] {
        let Self { median_mm, low_mm, high_mm, quantiles_mm } = *self;
        let of_normal = |k: usize| {
            let share = Self::DEVIATES[k] / Self::DEVIATES[11];
            match k {
                3 => low_mm,
                7 => median_mm,
                11 => high_mm,
                0..7 => median_mm + share * (median_mm - low_mm),
                _ => median_mm + share * (high_mm - median_mm),
            }
        };
        quantiles_mm.unwrap_or_else(|| std::array::from_fn(of_normal))
    }

    /// Returns true if all values are finite and in ascending order, and the median is not negative.
    pub fn is_valid(&self) -> bool {
        let Self { median_mm, low_mm, high_mm, quantiles_mm } = *self;
        let ascend = |all: &[f64]| all.iter().all(|v| v.is_finite()) && all.is_sorted();
        ascend(&[low_mm, median_mm, high_mm]) && median_mm >= 0.0 && quantiles_mm.is_none_or(|all| ascend(&all))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interval_deviates_match_probabilities() {
        for (p, z) in Interval::PROBABILITIES.iter().zip(Interval::DEVIATES) {
            assert!((normal::probability(z) - p).abs() < 1e-7, "{z} {p}");
            assert!((normal::deviate(*p) - z).abs() < 1e-4, "{z} {p}");
        }
    }

    #[test]
    fn probability_within_normal_interval() {
        // u = 1, so the expanded uncertainty is 1.96.
        let of = Interval::from_expanded(10.0, 1.959_963_984_540_054_2);
        for (limit, probability) in [(10.0, 0.5), (11.0, 0.841_344_7), (12.0, 0.977_249_9), (8.5, 0.066_807_2)] {
            assert!((of.probability_within(limit) - probability).abs() < 1e-6, "{limit}");
        }
        assert_eq!((of.probability_within(30.0), of.probability_within(-30.0)), (0.999, 0.001), "nobody knows more");
        assert!((of.quantile_mm(0.841_344_7) - 11.0).abs() < 1e-5);
        // The ends of the interval are exact, to the last digit.
        assert_eq!([of.quantile_mm(1.0 - 0.975), of.quantile_mm(0.975)], [of.low_mm, of.high_mm]);
        assert_eq!([of.probability_within(of.high_mm), of.probability_within(of.low_mm)], [0.975, 0.025]);
    }

    #[test]
    fn probability_within_zero_uncertainty() {
        let of = Interval::from_expanded(5.0, 0.0);
        assert_eq!([4.9, 5.0, 5.1].map(|limit| of.probability_within(limit)), [0.001, 0.999, 0.999]);
        assert_eq!(of.quantile_mm(0.6), 5.0);
    }

    #[test]
    fn probability_within_recorded_quantiles() {
        // Only an upper bound is known: all quantiles below the median are 0.
        let quantiles: [f64; Interval::COUNT] = std::array::from_fn(|k| if k < 7 { 0.0 } else { k as f64 });
        let of = Interval { quantiles_mm: Some(quantiles), median_mm: 7.0, low_mm: 0.0, high_mm: 11.0 };
        assert!(of.is_valid());
        assert_eq!([8.0, 11.0, 12.0, 14.0].map(|limit| of.probability_within(limit)), [0.75, 0.975, 0.99, 0.999]);
        assert!((0.9..0.95).contains(&of.probability_within(9.5)));
        assert!(of.quantile_mm(1.0 - 0.995) == 0.0 && of.quantile_mm(0.93) > 9.0);
        let broken = Interval { quantiles_mm: Some(quantiles.map(|q| -q)), ..of };
        assert!(!broken.is_valid());
    }
}
