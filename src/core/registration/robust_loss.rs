//! Robust losses: a point far from the surface has less influence on the fit than its square, or none.

use regrind_figures::statistics::median;
use serde::{Deserialize, Serialize};

/// Loss function of the distance of a point in the objective.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Loss {
    /// Square of the distance, eq. (7).
    #[default]
    None,
    /// Square of the distance near the surface, and linear beyond 1.345 robust standard deviations: 95 % efficient on
    /// Gaussian errors.
    Huber,
    /// Biweight with 4.685 robust standard deviations: a point farther away has no effect.
    Tukey,
}

/// A loss with its scale in millimetres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ScaledLoss {
    loss: Loss,
    limit_mm: f64,
}

/// Ratio of the standard deviation of Gaussian errors to the median of their absolute values: 1 / Phi^-1(3/4).
const SIGMA_PER_MAD: f64 = 1.482_602_218_505_602;

impl ScaledLoss {
    /// Creates a loss with a scale. The scale is the distance limit, in mm, beyond which the loss reduces the weight of
    /// a point: the tuning constant of `loss` (1.345 for Huber, 4.685 for Tukey) times `sigma_mm`, the robust standard
    /// deviation of the distances.
    pub(crate) fn new(loss: Loss, sigma_mm: f64) -> Self {
        let tuning = match loss {
            Loss::None => f64::INFINITY,
            Loss::Huber => 1.345,
            Loss::Tukey => 4.685,
        };
        Self { loss, limit_mm: tuning * sigma_mm }
    }

    /// Returns the weight of a distance (in mm) for iteratively reweighted least squares, and its contribution to the
    /// objective in mm^2. Near zero the contribution is the squared distance for every loss.
    #[inline]
    pub(crate) fn weigh(&self, distance: f64) -> (f64, f64) {
        let square = distance * distance;
        match self.loss {
            Loss::None => (1.0, square),
            Loss::Huber => {
                let (d, c) = (distance.abs(), self.limit_mm);
                if d <= c { (1.0, square) } else { (c / d, c * (2.0 * d - c)) }
            }
            Loss::Tukey => {
                let c2 = self.limit_mm * self.limit_mm;
                if square >= c2 {
                    return (0.0, c2 / 3.0);
                }
                let inner = 1.0 - square / c2;
                (inner * inner, c2 / 3.0 * (1.0 - inner * inner * inner))
            }
        }
    }
}

/// Returns the median of the distances, and their robust standard deviation: 1.4826 times the median absolute deviation
/// (MAD). Returns zeros if there are no distances.
pub(crate) fn robust_median_and_sigma(distances: impl Iterator<Item = f64>) -> (f64, f64) {
    let mut values: Vec<f64> = distances.collect();
    let middle = median(&mut values).unwrap_or(0.0);
    for v in &mut values {
        *v = (*v - middle).abs();
    }
    (middle, SIGMA_PER_MAD * median(&mut values).unwrap_or(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loss_weights_match_slope() {
        for loss in [Loss::None, Loss::Huber, Loss::Tukey] {
            let scaled = ScaledLoss::new(loss, 0.001);
            assert!((scaled.weigh(1e-6).1 / 1e-12 - 1.0).abs() < 1e-5);
            for d in [1e-5, -5e-4, 0.0013, -0.002, 0.0046, 0.2] {
                let (weight, _) = scaled.weigh(d);
                let h = 1e-9;
                let slope = (scaled.weigh(d + h).1 - scaled.weigh(d - h).1) / (2.0 * h);
                assert!((slope - 2.0 * weight * d).abs() < 1e-7, "{loss:?} at {d}: {slope}");
            }
        }
    }

    #[test]
    fn robust_sigma_ignores_outliers() {
        // Evenly spaced from -1 to 1: the median of |d| is 1/2.
        let even = (0..=2000).map(|k| f64::from(k) / 1000.0 - 1.0);
        let (median, sigma) = robust_median_and_sigma(even.clone());
        assert!(median.abs() < 1e-12 && (sigma - 0.5 * SIGMA_PER_MAD).abs() < 1e-3);
        let (_, soiled) = robust_median_and_sigma(even.chain(std::iter::repeat_n(1e6, 40)));
        assert!((soiled / sigma - 1.0).abs() < 0.05);
        assert_eq!(robust_median_and_sigma(std::iter::empty()), (0.0, 0.0));
    }
}
