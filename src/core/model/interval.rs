//! Credible interval of a figure.

use super::inputs::ModelInputs;

/// Median and 95 % credible interval of a figure.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Interval {
    /// Median.
    pub median_mm: f64,
    /// 2.5 % quantile.
    pub low_mm: f64,
    /// 97.5 % quantile.
    pub high_mm: f64,
    /// Lower bound for a decision that is repeated while the measurement grows: the quantile of the probability
    /// [`ModelInputs::decision_risk`].
    #[serde(skip)]
    pub decision_low_mm: f64,
    /// Upper bound for a decision that is repeated while the measurement grows: the quantile of the probability 1 -
    /// [`ModelInputs::decision_risk`].
    #[serde(skip)]
    pub decision_high_mm: f64,
    /// Bound for acceptance: the quantile of the probability [`ModelInputs::acceptance_probability`].
    #[serde(skip)]
    pub acceptance_bound_mm: f64,
    /// Quantiles of the probabilities [`Interval::PROBABILITIES`].
    #[serde(skip)]
    pub quantiles_mm: [f64; 15],
}

impl Interval {
    /// Probabilities of the quantiles that are recorded for a figure.
    pub const PROBABILITIES: [f64; 15] =
        [0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975, 0.99, 0.995, 0.999];

    /// Returns the standard uncertainty in mm: the width of the 95 % interval divided by 3.92. The 95 % interval of a
    /// normal distribution is 3.92 standard deviations wide.
    pub fn standard_uncertainty_mm(&self) -> f64 {
        const WIDTH: f64 = 2.0 * 1.96;
        (self.high_mm - self.low_mm) / WIDTH
    }

    /// Builds the credible interval of a figure from `values`: the value of the figure in each of several equally
    /// probable samples. `values` must not be empty.
    ///
    /// `higher` has further sets of values. They can only raise the quantiles above the median: each quantile is the
    /// maximum of the quantiles of `values` and of every set in `higher`. No set in `higher` may be empty. `lower` is
    /// one further set of values. It can only lower the quantiles below the median: each quantile is the minimum of the
    /// quantiles of `values` and of `lower`. An empty `lower` is ignored. If `has_low` is false, all quantiles below
    /// the median are 0.
    ///
    /// `inputs` gives the probabilities of three bounds. [`ModelInputs::decision_risk`] is the probability that the
    /// figure is below the bound `decision_low_mm`, and also that it is above the bound `decision_high_mm`.
    /// [`ModelInputs::acceptance_probability`] is the probability that the figure is below the bound
    /// `acceptance_bound_mm`.
    pub(super) fn from_samples(
        values: Vec<f64>,
        (lower, higher): (Vec<f64>, impl Iterator<Item = Vec<f64>>),
        has_low: bool,
        inputs: &ModelInputs,
    ) -> Self {
        Self::with_low_factor(values, (lower, higher), (has_low, 1.0), inputs)
    }

    /// Builds the credible interval of a figure from `values`: the value of the figure in each of several equally
    /// probable samples. `values` must not be empty.
    ///
    /// The sets in `higher` can only raise the quantiles above the median. The set `lower` can only lower the quantiles
    /// below the median; an empty `lower` is ignored. If `has_low` is true, the quantiles below the median are then
    /// multiplied by `low_factor`. If `has_low` is false, they are 0. `inputs` gives the probabilities of the bounds,
    /// as in [`Interval::from_samples`].
    pub(super) fn with_low_factor(
        mut values: Vec<f64>,
        (mut lower, higher): (Vec<f64>, impl Iterator<Item = Vec<f64>>),
        (has_low, low_factor): (bool, f64),
        inputs: &ModelInputs,
    ) -> Self {
        values.sort_unstable_by(f64::total_cmp);
        lower.sort_unstable_by(f64::total_cmp);
        let higher: Vec<Vec<f64>> = higher
            .map(|mut of| {
                of.sort_unstable_by(f64::total_cmp);
                of
            })
            .collect();
        let ModelInputs { decision_risk: look_risk, acceptance_probability: probability, .. } = *inputs;
        let nth = |of: &[f64], share: f64| of[((of.len() - 1) as f64 * share).round() as usize];
        let at = |share: f64| {
            let own = nth(&values, share);
            match share {
                _ if share > 0.5 => higher.iter().fold(own, |most, of| most.max(nth(of, share))),
                _ if share < 0.5 && !lower.is_empty() => own.min(nth(&lower, share)),
                _ => own,
            }
        };
        let low = |share: f64| if has_low { low_factor * at(share) } else { 0.0 };
        Self {
            median_mm: at(0.5),
            low_mm: low(0.025),
            high_mm: at(0.975),
            decision_low_mm: low(look_risk),
            decision_high_mm: at(1.0 - look_risk),
            acceptance_bound_mm: at(probability),
            quantiles_mm: Self::PROBABILITIES.map(|share| if share < 0.5 { low(share) } else { at(share) }),
        }
    }
}
