//! Maximization of a function of two variables.

/// Maximizes the function `height` of two variables by the simplex method (Nelder and Mead 1965). Returns the two
/// variables at the maximum, and the value of `height` there.
///
/// The corners of the first simplex are `start`, and `start` moved by `steps` along each axis. The search ends when
/// both variables of all corners differ by less than `near`, or after 120 iterations.
pub(super) fn maximize(
    start: [f64; 2],
    steps: [f64; 2],
    near: f64,
    height: impl Fn([f64; 2]) -> f64,
) -> ([f64; 2], f64) {
    const MAX_ITERATIONS: usize = 120;
    let seen = |place: [f64; 2]| (place, height(place));
    let mut corners = [seen(start), seen([start[0] + steps[0], start[1]]), seen([start[0], start[1] + steps[1]])];
    for _ in 0..MAX_ITERATIONS {
        corners.sort_by(|a, b| b.1.total_cmp(&a.1));
        let [best, middle, worst] = corners;
        let spread =
            (0..2).map(|k| (best.0[k] - worst.0[k]).abs().max((best.0[k] - middle.0[k]).abs())).fold(0.0, f64::max);
        if spread < near {
            break;
        }
        let centre = [0, 1].map(|k| 0.5 * (best.0[k] + middle.0[k]));
        let along = |factor: f64| [0, 1].map(|k| centre[k] + factor * (centre[k] - worst.0[k]));
        let reflected = seen(along(1.0));
        let replaced = if reflected.1 > best.1 {
            let further = seen(along(2.0));
            if further.1 > reflected.1 { further } else { reflected }
        } else if reflected.1 > middle.1 {
            reflected
        } else {
            let nearer = seen(along(if reflected.1 > worst.1 { 0.5 } else { -0.5 }));
            if nearer.1 <= worst.1.max(reflected.1) {
                for corner in &mut corners[1..] {
                    *corner = seen([0, 1].map(|k| 0.5 * (corner.0[k] + best.0[k])));
                }
                continue;
            }
            nearer
        };
        corners[2] = replaced;
    }
    corners.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((start, f64::NEG_INFINITY))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nelder_mead_finds_peak() {
        let hill = |[x, y]: [f64; 2]| -(x - 1.0).powi(2) - 30.0 * (y + 2.0 - 0.3 * x).powi(2);
        let (top, height) = maximize([-3.0, 4.0], [0.7, 0.9], 1e-4, hill);
        assert!((top[0] - 1.0).abs() < 1e-3 && (top[1] + 1.7).abs() < 1e-3 && height > -1e-6, "{top:?}");
    }
}
