//! Credible interval of a figure, and bounds for decisions on it, from samples of the figure.

use regrind_figures::Interval;
use regrind_figures::statistics::nearest_quantile;

use super::inputs::ModelInputs;

/// Bounds of a figure for decisions while a measurement grows, and for acceptance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DecisionBounds {
    /// Lower bound for a decision that is repeated while the measurement grows: the quantile of the probability
    /// [`ModelInputs::decision_risk`].
    pub low_mm: f64,
    /// Upper bound for a decision that is repeated while the measurement grows: the quantile of the probability 1 -
    /// [`ModelInputs::decision_risk`].
    pub high_mm: f64,
    /// Bound for acceptance: the quantile of the probability [`ModelInputs::acceptance_probability`].
    pub acceptance_mm: f64,
}

/// Values of a figure in equally probable samples, and further values that can only widen its interval. Every list is
/// sorted.
pub(super) struct FigureSamples {
    values: Vec<f64>,
    lower: Vec<f64>,
    higher: Vec<Vec<f64>>,
    /// Factor of the quantiles below the median; `None` if they are 0.
    low_factor: Option<f64>,
}

impl FigureSamples {
    /// Collects the samples of a figure. `values` has the value of the figure in each of several equally probable
    /// samples; it must not be empty.
    ///
    /// `higher` has further sets of values. They can only raise the quantiles above the median: each quantile is the
    /// maximum of the quantiles of `values` and of every set in `higher`. No set in `higher` may be empty. `lower` is
    /// one further set of values. It can only lower the quantiles below the median: each quantile is the minimum of the
    /// quantiles of `values` and of `lower`. An empty `lower` is ignored. The quantiles below the median are then
    /// multiplied by `low_factor`. If it is `None`, they are 0.
    pub(super) fn new(
        values: Vec<f64>,
        (lower, higher): (Vec<f64>, impl Iterator<Item = Vec<f64>>),
        low_factor: Option<f64>,
    ) -> Self {
        let sorted = |mut of: Vec<f64>| {
            of.sort_unstable_by(f64::total_cmp);
            of
        };
        Self { values: sorted(values), lower: sorted(lower), higher: higher.map(sorted).collect(), low_factor }
    }

    /// Returns the median and the 95 % credible interval, without other quantiles.
    pub(super) fn interval(&self) -> Interval {
        let [low_mm, median_mm, high_mm] = [0.025, 0.5, 0.975].map(|share| self.quantile_mm(share));
        Interval { median_mm, low_mm, high_mm, quantiles_mm: None }
    }

    /// Returns the median and the 95 % credible interval, with all quantiles that are recorded.
    pub(super) fn interval_with_quantiles(&self) -> Interval {
        let quantiles_mm = Interval::PROBABILITIES.map(|share| self.quantile_mm(share));
        Interval { quantiles_mm: Some(quantiles_mm), ..self.interval() }
    }

    /// Returns the bounds of the figure at the probabilities in `inputs`: [`ModelInputs::decision_risk`] and
    /// [`ModelInputs::acceptance_probability`].
    pub(super) fn bounds(&self, inputs: &ModelInputs) -> DecisionBounds {
        DecisionBounds {
            low_mm: self.low_mm(inputs.decision_risk),
            high_mm: self.own_quantile_mm(1.0 - inputs.decision_risk),
            acceptance_mm: self.own_quantile_mm(inputs.acceptance_probability),
        }
    }

    fn quantile_mm(&self, share: f64) -> f64 {
        if share < 0.5 { self.low_mm(share) } else { self.own_quantile_mm(share) }
    }

    fn low_mm(&self, share: f64) -> f64 {
        self.low_factor.map_or(0.0, |factor| factor * self.own_quantile_mm(share))
    }

    /// Returns a quantile without the factor of the quantiles below the median.
    fn own_quantile_mm(&self, share: f64) -> f64 {
        let own = nearest_quantile(&self.values, share);
        match share {
            _ if share > 0.5 => self.higher.iter().fold(own, |most, of| most.max(nearest_quantile(of, share))),
            _ if share < 0.5 && !self.lower.is_empty() => own.min(nearest_quantile(&self.lower, share)),
            _ => own,
        }
    }
}
