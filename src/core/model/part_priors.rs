//! Prior of the field from earlier parts: its range and the ratio of the noise to it, after passes with and without a
//! correction.
//!
//! A pass without a correction leaves the systematic errors of the machine: wide waves. A pass with a correction leaves
//! the errors that no correction removes: narrow waves. So each kind has a prior of its own, independent of the number
//! of the pass: a part that starts with the correction of an earlier part has no pass of the first kind.
//!
//! Each part contributes the hyperparameters from its own points, without any prior. The logarithms of range and ratio
//! of n parts have a mean and a variance v. The prior of the next part has that mean and the variance
//!
//! ```text
//!  (2 w^2 + (n - 1) v) / (n + 1) * (1 + 1 / n)        and no less than (ln 2)^2
//! ```
//!
//! where w = ln 2.5 is the difference between parts that is assumed before any part is measured.

use serde::{Deserialize, Serialize};

use super::{Hyperparameters, Prior};

/// Factor by which parts differ according to the prior, and number of parts that this prior counts for.
const PART_FACTOR: f64 = 2.5;
const PRIOR_PARTS: f64 = 2.0;
/// Minimum factor of the prior: the points of a part that differs can still overrule it.
const MIN_FACTOR: f64 = 2.0;
/// Maximum number of parts that count, because machines change.
const MAX_PARTS: u32 = 20;

/// Statistics of the fields of earlier parts, by the kind of pass.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PartPriors {
    /// Statistics after a pass that was ground without a correction.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub without_correction: Option<PartFit>,
    /// Statistics after a pass that was ground with a correction.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub with_correction: Option<PartFit>,
}

/// Statistics of the fields of several parts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PartFit {
    /// Median of the range, in millimetres, and factor by which the ranges of parts differ: one standard deviation of
    /// the logarithm.
    pub range_mm: [f64; 2],
    /// Median and factor of the ratio of the noise to the standard deviation of the field.
    #[serde(rename = "scatter_ratio")]
    pub noise_ratio: [f64; 2],
    /// Number of parts in the statistics; at most twenty, and later parts replace earlier ones gradually.
    pub parts: u32,
}

impl PartPriors {
    /// Returns the statistics of the fields of earlier parts; `None` if there is no such part yet. `is_corrected`
    /// selects the kind of pass before the measurement: true for a pass with a correction, false for a pass without
    /// one.
    pub fn fit(&self, is_corrected: bool) -> Option<PartFit> {
        if is_corrected { self.with_correction } else { self.without_correction }
    }

    /// Adds the hyperparameters of a further part to the statistics. `is_corrected` is true if the pass before its
    /// measurement was ground with a correction.
    pub fn update(&mut self, is_corrected: bool, hyperparameters: &Hyperparameters) {
        let lesson = if is_corrected { &mut self.with_correction } else { &mut self.without_correction };
        *lesson = Some(PartFit::updated(*lesson, hyperparameters));
    }

    /// Pools the statistics of other machines, as a start for a machine that has no parts of its own yet. Each machine
    /// in `machines` counts as one part, because a new machine can differ from the others as much as they differ from
    /// each other. The statistics with and without a correction are pooled separately.
    #[must_use]
    pub fn pooled(machines: &[Self]) -> Self {
        let of = |is_corrected| PartFit::pooled(machines.iter().filter_map(|of| of.fit(is_corrected)));
        Self { without_correction: of(false), with_correction: of(true) }
    }

    /// Returns true if every number is in its range: medians finite and above 0, factors finite and at least 1, and
    /// from 1 to twenty parts. Use it for values that were read from a file.
    pub fn is_valid(&self) -> bool {
        let number = |of: [f64; 2]| of[0].is_finite() && of[0] > 0.0 && of[1].is_finite() && of[1] >= 1.0;
        let is_sound = |lesson: PartFit| {
            number(lesson.range_mm) && number(lesson.noise_ratio) && (1..=MAX_PARTS).contains(&lesson.parts)
        };
        [self.without_correction, self.with_correction].into_iter().flatten().all(is_sound)
    }
}

impl PartFit {
    /// Returns the statistics `before` with one more part added. `hyperparameters` are those of the added part. If
    /// `before` is `None`, returns the statistics of the added part alone. From the twentieth part on, an added part
    /// always has the weight 1/20, so that the weights of earlier parts decrease.
    pub fn updated(before: Option<Self>, hyperparameters: &Hyperparameters) -> Self {
        let [range_mm, ratio] =
            [hyperparameters.field.range_mm, hyperparameters.noise_sigma_mm / hyperparameters.field.sigma_mm];
        let Some(before) = before else {
            return Self { range_mm: [range_mm, 1.0], noise_ratio: [ratio, 1.0], parts: 1 };
        };
        let n = f64::from((before.parts + 1).min(MAX_PARTS));
        // Online mean and variance (Welford 1962).
        let with = |[median, factor]: [f64; 2], value: f64| {
            let off = (value / median).ln();
            let squares = factor.ln().powi(2) * (n - 2.0) + off * off * (n - 1.0) / n;
            [median * (off / n).exp(), (squares / (n - 1.0)).sqrt().exp()]
        };
        Self {
            range_mm: with(before.range_mm, range_mm),
            noise_ratio: with(before.noise_ratio, ratio),
            parts: n as u32,
        }
    }

    /// Pools the statistics of several machines into one. Only the first twenty machines are used, and each counts as
    /// one part. Returns `None` if `machines` is empty.
    fn pooled(machines: impl Iterator<Item = Self>) -> Option<Self> {
        let machines: Vec<Self> = machines.take(MAX_PARTS as usize).collect();
        let n = machines.len() as f64;
        let pooled = |of: fn(&Self) -> [f64; 2]| {
            let mean = machines.iter().map(|of_one| of(of_one)[0].ln()).sum::<f64>() / n;
            let between: f64 = machines.iter().map(|of_one| (of(of_one)[0].ln() - mean).powi(2)).sum();
            let within = machines.iter().map(|of_one| of(of_one)[1].ln().powi(2)).sum::<f64>() / n;
            [mean.exp(), (within + between / (n - 1.0).max(1.0)).sqrt().exp()]
        };
        let parts = machines.len() as u32;
        (parts > 0).then(|| Self {
            range_mm: pooled(|of| of.range_mm),
            noise_ratio: pooled(|of| of.noise_ratio),
            parts,
        })
    }

    /// Returns the prior of the field of the next part. The prior has a median and a factor for the range, and a median
    /// and a factor for the ratio of noise to field (standard deviations). The natural logarithm of a factor is one
    /// standard deviation of the logarithm of the value.
    ///
    /// The medians are those of the earlier parts. The factors cover the differences between parts. A factor is at
    /// least 2. With few parts in the statistics, the uncertainty of their median makes the factors larger.
    pub fn prior(&self) -> Prior {
        let n = f64::from(self.parts.max(1));
        let expected = |[median, factor]: [f64; 2]| {
            let squares = PRIOR_PARTS * PART_FACTOR.ln().powi(2) + (n - 1.0) * factor.ln().powi(2);
            let variance = squares / (PRIOR_PARTS + n - 1.0) * (1.0 + 1.0 / n);
            [median, variance.sqrt().exp().max(MIN_FACTOR)]
        };
        Prior { range_mm: expected(self.range_mm), noise_ratio: expected(self.noise_ratio) }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Field;
    use super::*;

    fn hyperparameters(range_mm: f64, ratio: f64) -> Hyperparameters {
        Hyperparameters { field: Field::new(2e-3, range_mm), noise_sigma_mm: 2e-3 * ratio, noise_autocorrelation: 0.0 }
    }

    #[test]
    fn part_priors_of_two_parts_by_hand() {
        let mut taught = PartPriors::default();
        assert!(taught.fit(true).is_none());
        taught.update(true, &hyperparameters(10.0, 0.1));
        let one = taught.fit(true).unwrap().prior();
        // With one part, the variance is 2 (ln 2.5)^2.
        assert!((one.range_mm[0] - 10.0).abs() < 1e-12, "{one:?}");
        assert!((one.range_mm[1].ln() - 2f64.sqrt() * 2.5f64.ln()).abs() < 1e-12, "{one:?}");
        taught.update(true, &hyperparameters(40.0, 0.1));
        let lesson = taught.fit(true).unwrap();
        // The mean of the logarithms is that of 20. Each differs from it by ln 2, and the sample variance is 2 (ln
        // 2)^2.
        assert!((lesson.range_mm[0] - 20.0).abs() < 1e-12 && lesson.parts == 2, "{lesson:?}");
        assert!((lesson.range_mm[1].ln() - 2f64.sqrt() * 2f64.ln()).abs() < 1e-12, "{lesson:?}");
        assert!((lesson.noise_ratio[0] - 0.1).abs() < 1e-12 && (lesson.noise_ratio[1] - 1.0).abs() < 1e-12);
        let variance = (2.0 * 2.5f64.ln().powi(2) + 2.0 * 2f64.ln().powi(2)) / 3.0 * 1.5;
        assert!((lesson.prior().range_mm[1].ln() - variance.sqrt()).abs() < 1e-12);
        assert!(taught.fit(false).is_none() && taught.is_valid());
    }

    #[test]
    fn part_priors_forget_old_parts() {
        let mut lesson = None;
        let mut factors = Vec::new();
        for _ in 0..200 {
            let next = PartFit::updated(lesson, &hyperparameters(15.0, 0.3));
            factors.push(next.prior().range_mm[1]);
            lesson = Some(next);
        }
        assert!(factors.windows(2).all(|pair| pair[1] <= pair[0] + 1e-12), "{factors:?}");
        assert_eq!((factors[199], lesson.unwrap().parts), (2.0, 20));
        // From here on the machine has changed.
        for _ in 0..80 {
            lesson = Some(PartFit::updated(lesson, &hyperparameters(60.0, 0.3)));
        }
        let lesson = lesson.unwrap();
        assert!((lesson.range_mm[0] / 60.0 - 1.0).abs() < 0.05, "{lesson:?}");
    }

    #[test]
    fn part_priors_pool_machines() {
        let machine = |range_mm: f64| {
            let mut taught = PartPriors::default();
            (0..9).for_each(|_| taught.update(true, &hyperparameters(range_mm, 0.1)));
            taught
        };
        let one = PartPriors::pooled(&[machine(10.0)]);
        let [one, part] =
            [one.fit(true).unwrap(), PartFit::updated(None, &hyperparameters(10.0, 0.1))].map(|of| of.prior());
        let numbers = |of: Prior| [of.range_mm, of.noise_ratio].concat();
        assert!(numbers(one).iter().zip(numbers(part)).all(|(a, b)| (a / b - 1.0).abs() < 1e-12), "{one:?} {part:?}");
        assert!(
            PartPriors::pooled(&[machine(10.0)]).fit(false).is_none() && PartPriors::pooled(&[]).fit(true).is_none()
        );
        let two = PartPriors::pooled(&[machine(10.0), machine(40.0)]).fit(true).unwrap();
        let parts =
            PartFit::updated(Some(PartFit::updated(None, &hyperparameters(10.0, 0.1))), &hyperparameters(40.0, 0.1));
        assert!((two.range_mm[0] - 20.0).abs() < 1e-9 && two.parts == 2, "{two:?}");
        assert!((two.range_mm[1] / parts.range_mm[1] - 1.0).abs() < 1e-9, "{two:?}");
        assert!(PartPriors { with_correction: Some(two), without_correction: None }.is_valid());
    }

    #[test]
    fn part_priors_widen_with_spread() {
        let lesson = (0..12)
            .map(|k| hyperparameters(if k % 2 == 0 { 5.0 } else { 80.0 }, 0.3))
            .fold(None, |lesson, hyperparameters| Some(PartFit::updated(lesson, &hyperparameters)));
        let priors = lesson.unwrap().prior();
        assert!(priors.range_mm[1] > 3.5 && priors.noise_ratio[1] < 2.1, "{priors:?}");
    }

    #[test]
    fn part_priors_detect_bad_values() {
        let good = PartFit::updated(None, &hyperparameters(15.0, 0.3));
        let of = |lesson| PartPriors { with_correction: Some(lesson), without_correction: None }.is_valid();
        assert!(of(good) && PartPriors::default().is_valid());
        for bad in [
            PartFit { range_mm: [0.0, 2.0], ..good },
            PartFit { range_mm: [15.0, 0.5], ..good },
            PartFit { noise_ratio: [f64::NAN, 2.0], ..good },
            PartFit { noise_ratio: [0.1, f64::INFINITY], ..good },
            PartFit { parts: 0, ..good },
            PartFit { parts: 21, ..good },
        ] {
            assert!(!of(bad), "{bad:?}");
        }
    }
}
