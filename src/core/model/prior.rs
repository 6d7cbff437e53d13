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

/// Factors of range and ratio for a part of which nothing is known.
const UNKNOWN_PART_FACTORS: [f64; 2] = [6.0, 20.0];

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
    /// Each of the two has a median and a factor. From median / factor to median x factor, the density is normal in the
    /// logarithm of the value. Beyond these limits, it falls only exponentially (Huber 1964).
    pub(super) fn log_density(&self, range_mm: f64, ratio: f64) -> f64 {
        let of = |value: f64, median: f64, factor: f64| {
            let off = ((value / median).ln() / factor.ln()).abs();
            (if off <= 1.0 { -0.5 * off * off } else { 0.5 - off }) - factor.ln().ln()
        };
        of(range_mm, self.range_mm[0], self.range_mm[1]) + of(ratio, self.noise_ratio[0], self.noise_ratio[1])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prior_density_has_heavy_tail() {
        let taught = Prior { range_mm: [8.0, 2.0], noise_ratio: [0.1, 2.0] };
        let [at, off] = [8.0, 8.0 * 25.0].map(|range_mm| taught.log_density(range_mm, 0.1));
        // By hand: -2 ln ln 2 at both medians, and lower by (0.5 - ln 25 / ln 2) at 25 times the range.
        let median = -2.0 * 2f64.ln().ln();
        assert!((at - median).abs() < 1e-12, "{at}");
        assert!((off - (median + 0.5 - 25f64.ln() / 2f64.ln())).abs() < 1e-12, "{off}");
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
