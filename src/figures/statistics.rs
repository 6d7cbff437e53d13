//! Statistics of lists of numbers.

use std::borrow::Borrow;

/// Returns the root mean square of the values; 0 if there are none.
pub fn rms(values: impl IntoIterator<Item = impl Borrow<f64>>) -> f64 {
    root_mean(values.into_iter().map(|value| value.borrow() * value.borrow()))
}

/// Returns the square root of the mean of the values, which are squares; 0 if there are none.
pub fn root_mean(squares: impl IntoIterator<Item = f64>) -> f64 {
    let (sum, count) = squares.into_iter().fold((0.0, 0_usize), |(sum, count), square| (sum + square, count + 1));
    (sum / count.max(1) as f64).sqrt()
}

/// Returns the median of the values, the upper one of two middle values; `None` if there are no values. Changes their
/// order.
pub fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Returns the quantile at `share` (0 to 1) of sorted values: the value whose rank is nearest.
///
/// # Panics
/// If there are no values.
pub fn nearest_quantile(sorted: &[f64], share: f64) -> f64 {
    sorted[((sorted.len() - 1) as f64 * share).round() as usize]
}

/// Returns the quantile at `share` (0 to 1) of sorted values, interpolated between the two nearest values; `None`
/// without values.
pub fn quantile(sorted: &[f64], share: f64) -> Option<f64> {
    let at = share * (sorted.len().checked_sub(1)?) as f64;
    let (below, above) = (at.floor() as usize, at.ceil() as usize);
    Some(sorted[below] + (at - at.floor()) * (sorted[above] - sorted[below]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rms_and_root_mean() {
        assert_eq!((rms([3.0, -4.0, 0.0, 0.0]), root_mean([9.0, 16.0, 0.0, 0.0])), (2.5, 2.5));
        assert_eq!((rms([0.0; 0]), root_mean([])), (0.0, 0.0));
    }

    #[test]
    fn median_is_upper_middle() {
        assert_eq!((median(&mut []), median(&mut [7.0])), (None, Some(7.0)));
        assert_eq!((median(&mut [5.0, 1.0, 2.0]), median(&mut [4.0, 3.0, 1.0, 2.0])), (Some(2.0), Some(3.0)));
    }

    #[test]
    fn quantile_interpolates_or_takes_nearest() {
        let sorted = [1.0, 2.0, 4.0, 8.0];
        assert_eq!([0.0, 0.25, 0.5, 1.0].map(|share| quantile(&sorted, share)), [1.0, 1.75, 3.0, 8.0].map(Some));
        assert_eq!(quantile(&[], 0.5), None);
        assert_eq!([0.0, 0.25, 0.6, 1.0].map(|share| nearest_quantile(&sorted, share)), [1.0, 2.0, 4.0, 8.0]);
    }
}
