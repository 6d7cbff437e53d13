//! Capability of a process whose figure has an upper limit only: Cpk and Ppk with 95 % intervals.
//!
//! A form error has no lower limit, so Cp, which needs two limits, is not defined, and Cpk is the index of the upper
//! side (CPU). With the limit U and the quantiles of the distribution of the figure, by the method of percentiles of
//! ISO 22514-2:
//!
//! ```text
//! Cpk = (U - X50) / (X99.865 - X50)
//!   normal:      X50 = mean,       X99.865 = mean + 3 sigma          Cpk = (U - mean) / (3 sigma)
//!   log-normal:  X50 = exp(mean),  X99.865 = exp(mean + 3 sigma),    of the logarithms
//! ```
//!
//! Sigma of Cpk is that within the process: the mean moving range / 1.128. Sigma of Ppk is the standard deviation of all
//! values. PV is never negative and often skewed, so the distribution is tested first (T. W. Anderson, D. A. Darling,
//! JASA 49, 1954; critical values of M. A. Stephens, JASA 69, 1974): normal, otherwise log-normal, otherwise there is no
//! index. The intervals are those of A. F. Bissell (Applied Statistics 39, 1990), by linear propagation.

use regrind_figures::normal::two_sided_tail;

use super::control_chart::{D2, ranges};

/// Minimum number of parts for an index. Of fewer parts its interval is wider than what it shall decide.
pub(super) const MIN_PARTS: usize = 50;
/// Degrees of freedom of a sigma from moving ranges of two values, for each range (J. D. Cryer, T. P. Ryan, J. Quality
/// Technology 22, 1990).
const FREEDOM_OF_RANGE: f64 = 0.605;
/// Critical value of the corrected statistic of Anderson and Darling at 5 %, with mean and sigma from the values.
const CRITICAL: f64 = 0.752;
/// 97.5 % quantile of the normal distribution.
const Z: f64 = 1.959_964;

/// Distribution of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Distribution {
    Normal,
    LogNormal,
}

/// Index with its 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Index {
    pub(super) value: f64,
    pub(super) interval: [f64; 2],
}

/// Capability of a process.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Capability {
    pub(super) distribution: Distribution,
    /// Upper limit of all parts.
    pub(super) limit: f64,
    /// Cpk, from the sigma within the process.
    pub(super) within: Index,
    /// Ppk, from the sigma of all values.
    pub(super) overall: Index,
}

/// Reason why there is no index.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NoCapability {
    TooFewParts,
    /// A part has no limit.
    NoLimit,
    /// The limits of the parts differ.
    SeveralLimits,
    /// All values are equal.
    NoSpread,
    /// The values are neither normal nor log-normal.
    OtherDistribution,
}

/// Computes the capability of a process from the values of its parts in the order of measurement, and from the limit of
/// each part. Values and limits have the same unit.
pub(super) fn capability(values: &[f64], limits: &[Option<f64>]) -> Result<Capability, NoCapability> {
    if values.len() < MIN_PARTS {
        return Err(NoCapability::TooFewParts);
    }
    let limits: Vec<f64> = limits.iter().filter_map(|limit| limit.filter(|limit| limit.is_finite())).collect();
    let limit = *limits.first().filter(|_| limits.len() == values.len()).ok_or(NoCapability::NoLimit)?;
    if limits.iter().any(|other| (other - limit).abs() > 1e-9 * limit.abs()) {
        return Err(NoCapability::SeveralLimits);
    }
    let logarithms: Vec<f64> = values.iter().map(|value| value.ln()).collect();
    if is_zero(Sample::new(values).sigma) {
        return Err(NoCapability::NoSpread);
    }
    let is_log_normal = || limit > 0.0 && logarithms.iter().all(|value| value.is_finite()) && is_normal(&logarithms);
    let distribution = if is_normal(values) {
        Distribution::Normal
    } else if is_log_normal() {
        Distribution::LogNormal
    } else {
        return Err(NoCapability::OtherDistribution);
    };
    let values = if distribution == Distribution::Normal { values } else { &logarithms };
    let sample = Sample::new(values);
    let steps = ranges(values);
    let within = steps.iter().sum::<f64>() / steps.len() as f64 / D2;
    if is_zero(within) {
        return Err(NoCapability::NoSpread);
    }
    let index = |sigma: f64, freedom: f64| index(distribution, limit, sample, sigma, freedom);
    Ok(Capability {
        distribution,
        limit,
        within: index(within, FREEDOM_OF_RANGE * steps.len() as f64),
        overall: index(sample.sigma, sample.count - 1.0),
    })
}

/// Returns true if a spread is 0 or not a number.
fn is_zero(spread: f64) -> bool {
    spread.is_nan() || spread <= 0.0
}

/// Number, mean and standard deviation of values.
#[derive(Clone, Copy, Debug)]
struct Sample {
    count: f64,
    mean: f64,
    sigma: f64,
}

impl Sample {
    fn new(values: &[f64]) -> Self {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        Self { count, mean, sigma: (squares / (count - 1.0)).sqrt() }
    }
}

/// Returns the index for an upper limit. `sigma` has `freedom` degrees of freedom. With C the index and n the number of
/// values, the variance is (dC/dmean)^2 sigma^2 / n + (dC/dsigma)^2 sigma^2 / (2 freedom).
fn index(distribution: Distribution, limit: f64, sample: Sample, sigma: f64, freedom: f64) -> Index {
    let (value, of_mean, of_sigma) = match distribution {
        Distribution::Normal => {
            let value = (limit - sample.mean) / (3.0 * sigma);
            (value, 1.0 / (3.0 * sigma), value / sigma)
        }
        Distribution::LogNormal => {
            let (limit, spread) = (limit / sample.mean.exp(), (3.0 * sigma).exp_m1());
            let value = (limit - 1.0) / spread;
            (value, limit / spread, value * 3.0 * (3.0 * sigma).exp() / spread)
        }
    };
    let half = Z * sigma * (of_mean.powi(2) / sample.count + of_sigma.powi(2) / (2.0 * freedom)).sqrt();
    Index { value, interval: [value - half, value + half] }
}

/// Returns false if a test at 5 % refutes that the values are normal (Anderson and Darling).
fn is_normal(values: &[f64]) -> bool {
    let Sample { count, mean, sigma } = Sample::new(values);
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let z = |value: &f64| (value - mean) / sigma;
    // Logarithm of the probability of a larger deviate.
    let log_tail = |z: f64| {
        let half = 0.5 * two_sided_tail(z);
        if z < 0.0 { (-half).ln_1p() } else { half.ln() }
    };
    let terms = sorted.iter().zip(sorted.iter().rev()).zip(1_u32..);
    let sum: f64 =
        terms.map(|((low, high), k)| (2.0 * f64::from(k) - 1.0) * (log_tail(-z(low)) + log_tail(z(high)))).sum();
    let statistic = (-count - sum / count) * (1.0 + 0.75 / count + 2.25 / (count * count));
    statistic < CRITICAL
}

#[cfg(test)]
mod tests {
    use super::super::draws::normal_numbers;
    use super::*;

    fn limits(count: usize, limit: f64) -> Vec<Option<f64>> {
        vec![Some(limit); count]
    }

    /// Sixty values of the quantiles of a normal distribution with mean 4 and sigma 0.5, in an order without a trend.
    fn quantiles() -> Vec<f64> {
        (0..60).map(|k| 4.0 + 0.5 * regrind_figures::normal::deviate((f64::from(k * 37 % 60) + 0.5) / 60.0)).collect()
    }

    #[test]
    fn index_by_hand() {
        let values = quantiles();
        let found = capability(&values, &limits(60, 7.0)).unwrap();
        assert_eq!((found.distribution, found.limit), (Distribution::Normal, 7.0));
        // Ppk by its definition; the quantiles have a standard deviation of 0.4989.
        let sample = Sample::new(&values);
        assert!((sample.sigma - 0.4989).abs() < 5e-4 && (sample.mean - 4.0).abs() < 1e-6, "{sample:?}");
        let by_hand = 3.0 / (3.0 * sample.sigma);
        assert!((found.overall.value - by_hand).abs() < 1e-6, "{found:?}");
        // Bissell: 1.96 sqrt(1 / (9 n) + Cpk^2 / (2 (n - 1))).
        let half = 1.959_964 * (1.0 / 540.0 + by_hand * by_hand / 118.0_f64).sqrt();
        assert!((found.overall.interval[1] - by_hand - half).abs() < 1e-6, "{found:?}");
        let mean_range = ranges(&values).iter().sum::<f64>() / 59.0;
        assert!((found.within.value - 3.0 / (3.0 * mean_range / 1.128)).abs() < 1e-3, "{found:?}");
    }

    #[test]
    fn skewed_figures_by_percentiles() {
        // The same quantiles as logarithms: exp(4 +- ...) has a long upper tail.
        let values: Vec<f64> = quantiles().iter().map(|value| value.exp()).collect();
        let found = capability(&values, &limits(60, 7.0_f64.exp())).unwrap();
        assert_eq!(found.distribution, Distribution::LogNormal);
        let sigma = Sample::new(&quantiles()).sigma;
        let by_hand = (7.0_f64.exp() - 4.0_f64.exp()) / ((4.0 + 3.0 * sigma).exp() - 4.0_f64.exp());
        assert!((found.overall.value / by_hand - 1.0).abs() < 1e-5, "{found:?}, {by_hand}");
        // Two separate processes are neither normal nor log-normal.
        let two: Vec<f64> = (0..60).map(|k| if k % 2 == 0 { 2.0 } else { 6.0 } + 0.01 * f64::from(k)).collect();
        assert_eq!(capability(&two, &limits(60, 7.0)), Err(NoCapability::OtherDistribution));
    }

    #[test]
    fn no_index_without_its_conditions() {
        let values = quantiles();
        let of = |values: &[f64], limits: &[Option<f64>]| capability(values, limits).unwrap_err();
        assert_eq!(of(&values[..49], &limits(49, 7.0)), NoCapability::TooFewParts);
        assert_eq!(of(&values, &[limits(59, 7.0), vec![None]].concat()), NoCapability::NoLimit);
        assert_eq!(of(&values, &[limits(59, 7.0), vec![Some(f64::NAN)]].concat()), NoCapability::NoLimit);
        assert_eq!(of(&values, &[limits(59, 7.0), limits(1, 7.5)].concat()), NoCapability::SeveralLimits);
        assert_eq!(of(&[3.0; 60], &limits(60, 7.0)), NoCapability::NoSpread);
        let mut negative = [-1.0; 60];
        negative[0] = 90.0;
        assert_eq!(of(&negative, &limits(60, 100.0)), NoCapability::OtherDistribution);
    }

    /// The 95 % interval covers the true index in about 95 of 100 processes, and the test of the distribution refuses
    /// about 5 of 100 normal ones.
    #[test]
    fn intervals_cover_true_index() {
        const PROCESSES: u64 = 600;
        let (mut covered, mut normal) = ([0, 0], 0);
        for k in 0..PROCESSES {
            let values: Vec<f64> = normal_numbers(100, 31 * k + 5).iter().map(|z| 20.0 + z).collect();
            normal += u64::from(is_normal(&values));
            let sample = Sample::new(&values);
            let steps = ranges(&values);
            let within = steps.iter().sum::<f64>() / 99.0 / D2;
            for (count, (sigma, freedom)) in
                covered.iter_mut().zip([(within, FREEDOM_OF_RANGE * 99.0), (sample.sigma, 99.0)])
            {
                let [low, high] = index(Distribution::Normal, 24.0, sample, sigma, freedom).interval;
                *count += u64::from(low <= 4.0 / 3.0 && 4.0 / 3.0 <= high);
            }
        }
        assert!((PROCESSES * 92 / 100..=PROCESSES * 98 / 100).contains(&normal), "{normal}");
        assert!(
            covered.iter().all(|count| (PROCESSES * 92 / 100..=PROCESSES * 98 / 100).contains(count)),
            "{covered:?}"
        );
    }
}
