//! Test whether one cell differs from the others by more than chance: the rank-sum test of Mann and Whitney, with
//! Holm's correction for several cells.
//!
//! The test uses only the order of the figures. It assumes no normal distribution, and the size of an outlier has no
//! effect beyond its rank. H. B. Mann, D. R. Whitney, Ann. Math. Stat. 18 (1947); S. Holm, Scand. J. Stat. 6 (1979).

use regrind_figures::normal::two_sided_tail;

/// Minimum number of figures on each side; the normal approximation needs them.
pub(super) const ENOUGH: usize = 8;

/// Returns the two-sided p-value of the Wilcoxon rank-sum test (Mann-Whitney U) for two samples, by the normal
/// approximation with corrections for ties and for continuity. Returns `None` if a sample has fewer than [`ENOUGH`]
/// values, or if all values are equal.
pub(super) fn rank_sum(one: &[f64], other: &[f64]) -> Option<f64> {
    if one.len() < ENOUGH || other.len() < ENOUGH {
        return None;
    }
    let mut all: Vec<(f64, bool)> =
        one.iter().map(|value| (*value, true)).chain(other.iter().map(|value| (*value, false))).collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (mut sum, mut ties) = (0.0, 0.0);
    let mut from = 0;
    while from < all.len() {
        let alike = all[from..].iter().take_while(|(value, _)| *value == all[from].0).count();
        // Tied figures share the mean of the ranks from + 1 to from + alike.
        let rank = from as f64 + 0.5 * (alike as f64 + 1.0);
        sum += rank * all[from..from + alike].iter().filter(|(_, is_one)| *is_one).count() as f64;
        ties += (alike as f64).powi(3) - alike as f64;
        from += alike;
    }
    let (m, n) = (one.len() as f64, other.len() as f64);
    let u = sum - 0.5 * m * (m + 1.0);
    let all = m + n;
    let variance = m * n / 12.0 * (all + 1.0 - ties / (all * (all - 1.0)));
    if variance <= 0.0 {
        return None;
    }
    let z = ((u - 0.5 * m * n).abs() - 0.5).max(0.0) / variance.sqrt();
    Some(two_sided_tail(z))
}

/// Corrects the p-values `found` for the number of tests by the Holm-Bonferroni method. Returns the corrected p-values
/// (at most 1) in the same order. A `None` in `found` stays `None` and does not count as a test.
pub(super) fn holm(found: &[Option<f64>]) -> Vec<Option<f64>> {
    let mut order: Vec<usize> = (0..found.len()).filter(|k| found[*k].is_some()).collect();
    order.sort_by(|a, b| found[*a].partial_cmp(&found[*b]).unwrap_or(std::cmp::Ordering::Equal));
    let mut corrected = vec![None; found.len()];
    let mut most = 0.0_f64;
    for (rank, k) in order.iter().enumerate() {
        most = most.max(found[*k].unwrap_or(1.0) * (order.len() - rank) as f64).min(1.0);
        corrected[*k] = Some(most);
    }
    corrected
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rank_sum_matches_scipy() {
        // scipy.stats.mannwhitneyu(one, other, method="asymptotic"): U = 57, p = 0.14263.
        let one = [0.8, 0.83, 1.89, 1.04, 1.45, 1.38, 1.91, 1.64, 0.73, 1.46];
        let other = [1.15, 0.88, 0.9, 0.74, 1.21, 0.85, 0.81, 0.92];
        let p = rank_sum(&one, &other).unwrap();
        assert!((p - rank_sum(&other, &one).unwrap()).abs() < 1e-12, "whichever comes first");
        assert!((p - 0.142_631).abs() < 1e-5, "{p}");
        let shifted: Vec<f64> = one.iter().map(|value| value + 10.0).collect();
        assert!(rank_sum(&one, &shifted).unwrap() < 3e-4);
        assert_eq!((rank_sum(&[1.0; 10], &[1.0; 10]), rank_sum(&one[..7], &other)), (None, None));
    }

    #[test]
    fn holm_correction() {
        let corrected = holm(&[Some(0.01), None, Some(0.04), Some(0.03)]);
        let near = |k: usize, known: f64| (corrected[k].unwrap() - known).abs() < 1e-12;
        assert!(near(0, 0.03) && near(2, 0.06) && near(3, 0.06) && corrected[1].is_none(), "{corrected:?}");
    }
}
