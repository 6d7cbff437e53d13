//! Prior of the hyperparameters of a field, before anything is measured.

use super::ModelError;

/// Prior of a field's hyperparameters: the median of each, and the factor by which it can differ (one standard
/// deviation of its logarithm).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prior {
    /// Median and factor of the range; the median in mm.
    pub range_mm: [f64; 2],
    /// Median and factor of the ratio of the noise to the standard deviation of the field.
    pub noise_ratio: [f64; 2],
}

/// Factors of range and ratio for a part of which nothing is known, and share of parts that resemble no earlier part.
const UNKNOWN_PART_FACTORS: [f64; 2] = [6.0, 20.0];
const DISSIMILAR_SHARE: f64 = 0.2;

impl Prior {
    /// Returns a wide prior for a part of which only the size is known. `size_mm` is the size of the part in mm. The
    /// median of the range is a third of `size_mm`. The median of the ratio of noise to field (standard deviations) is
    /// 0.05.
    pub fn for_size(size_mm: f64) -> Self {
        Self { range_mm: [size_mm / 3.0, UNKNOWN_PART_FACTORS[0]], noise_ratio: [0.05, UNKNOWN_PART_FACTORS[1]] }
    }

    /// Checks that each median is finite and above 0, and each factor finite and above 1.
    ///
    /// # Errors
    /// Returns [`ModelError::Prior`] with the name, the median and the factor of the first wrong hyperparameter.
    pub(super) fn check(&self) -> Result<(), ModelError> {
        for (what, [median, factor]) in [("range", self.range_mm), ("ratio of noise to field", self.noise_ratio)] {
            if !(median.is_finite() && median > 0.0 && factor.is_finite() && factor > 1.0) {
                return Err(ModelError::Prior { what, median, factor });
            }
        }
        Ok(())
    }

    /// Returns the logarithm of the prior density, up to a constant. `range_mm` is the range of the field in mm.
    /// `ratio` is the standard deviation of the noise divided by that of the field.
    ///
    /// The density is a mixture of two priors: this prior, and a wider prior with a small weight. The wider prior is
    /// for parts that resemble no earlier part (robust prior, Schmidli and others 2014).
    ///
    /// Each prior has a median and a factor. From median / factor to median x factor, the density is normal in the
    /// logarithm of the value. Beyond these limits, it falls only exponentially (Huber 1964).
    pub(super) fn log_density(&self, range_mm: f64, ratio: f64) -> f64 {
        let of = |value: f64, median: f64, factor: f64| {
            let off = ((value / median).ln() / factor.ln()).abs();
            (if off <= 1.0 { -0.5 * off * off } else { 0.5 - off }) - factor.ln().ln()
        };
        let by = |[of_range, of_ratio]: [f64; 2]| {
            of(range_mm, self.range_mm[0], of_range) + of(ratio, self.noise_ratio[0], of_ratio)
        };
        let factors = [self.range_mm[1], self.noise_ratio[1]];
        let like = by(factors) + (1.0 - DISSIMILAR_SHARE).ln();
        let unlike = by([factors[0].max(UNKNOWN_PART_FACTORS[0]), factors[1].max(UNKNOWN_PART_FACTORS[1])])
            + DISSIMILAR_SHARE.ln();
        let higher = like.max(unlike);
        higher + ((like - higher).exp() + (unlike - higher).exp()).ln()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prior_density_has_heavy_tail() {
        let taught = Prior { range_mm: [8.0, 2.0], noise_ratio: [0.1, 2.0] };
        let [at, off] = [8.0, 8.0 * 25.0].map(|range_mm| taught.log_density(range_mm, 0.1));
        // By hand: ln(0.8 / ln^2 2 + 0.2 / (ln 6 ln 20)). At 25 times the range almost only the second term remains,
        // lower by (0.5 - ln 25 / ln 6).
        let (like, unlike) = (0.8 / 2f64.ln().powi(2), 0.2 / (6f64.ln() * 20f64.ln()));
        let [near, far] = [0.5 - 25f64.ln() / 2f64.ln(), 0.5 - 25f64.ln() / 6f64.ln()];
        assert!((at - (like + unlike).ln()).abs() < 1e-12, "{at}");
        assert!((off - (like * near.exp() + unlike * far.exp()).ln()).abs() < 1e-12, "{off}");
    }

    #[test]
    fn prior_check_refuses_bad_values() {
        let good = Prior::for_size(102.0);
        for (bad, words) in [
            (Prior { range_mm: [8.0, 1.0], ..good }, "the range has the median 8 and the factor 1;"),
            (Prior { range_mm: [0.0, 2.0], ..good }, "the range has the median 0 and the factor 2;"),
            (Prior { noise_ratio: [f64::NAN, 2.0], ..good }, "the ratio of noise to field has the median NaN"),
            (Prior { noise_ratio: [0.1, f64::INFINITY], ..good }, "the factor inf;"),
        ] {
            let error = bad.check().unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
        }
        assert_eq!(good.check(), Ok(()));
    }
}
