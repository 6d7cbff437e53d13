//! Jacobi polynomials P_k^(0, b), the common root of Zernike's and Forbes' polynomials.

/// Sums N series of Jacobi polynomials at once. Returns for each series the sum over k of c_k P_k^(0, b)(t), and its
/// derivative with respect to `t`.
///
/// Shapes: `coefficients[k]` contains the k-th coefficient of every series. The three-term recurrence (Abramowitz and
/// Stegun, 22.7.1, alpha = 0) runs from low to high degree, which is stable for `t` in [-1, 1]. The recurrence itself
/// is differentiated, so the derivative is exact and no difference quotient.
pub(super) fn series<const N: usize>(coefficients: &[[f64; N]], b: u32, t: f64) -> [(f64, f64); N] {
    let b = f64::from(b);
    let mut sums = [(0.0, 0.0); N];
    let [mut below, mut here] = [(0.0, 0.0), (1.0, 0.0)];
    for (k, row) in coefficients.iter().enumerate() {
        for (sum, c) in sums.iter_mut().zip(row) {
            sum.0 += c * here.0;
            sum.1 += c * here.1;
        }
        let next = step(k as f64 + 1.0, b, t, here, below);
        (below, here) = (here, next);
    }
    sums
}

/// Fills `out` with the values at t of the Jacobi polynomials P_0^(0, b), P_1^(0, b) and so on.
pub(crate) fn values(b: u32, t: f64, out: &mut [f64]) {
    let [mut below, mut here] = [(0.0, 0.0), (1.0, 0.0)];
    for (k, value) in out.iter_mut().enumerate() {
        *value = here.0;
        (below, here) = (here, step(k as f64 + 1.0, f64::from(b), t, here, below));
    }
}

/// Returns the value and the derivative of the Jacobi polynomial P_n^(0, b) at `t`, by the three-term recurrence.
/// `here` is the pair (value, derivative) of degree n - 1, and `below` the pair of degree n - 2. `n` is at least 1.
fn step(n: f64, b: f64, t: f64, here: (f64, f64), below: (f64, f64)) -> (f64, f64) {
    if n == 1.0 {
        // The general step divides 0 by 0 here when b is 0.
        return (1.0 + 0.5 * (b + 2.0) * (t - 1.0), 0.5 * (b + 2.0));
    }
    let s = 2.0 * n + b;
    let scale = 1.0 / (2.0 * n * (n + b) * (s - 2.0));
    let a1 = (s - 1.0) * s * (s - 2.0) * scale;
    let a0 = -(s - 1.0) * b * b * scale;
    let a2 = 2.0 * (n - 1.0) * (n + b - 1.0) * s * scale;
    let factor = a1 * t + a0;
    (factor * here.0 - a2 * below.0, factor * here.1 + a1 * here.0 - a2 * below.1)
}

/// Maximum distance from the axis, in normalisation radii, at which polynomials on a disc are evaluated. It is more
/// than 1 because a sampling has one ring of nodes beyond the aperture.
pub(super) const MAX_EXTRAPOLATION: f64 = 1.5;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jacobi_series_by_hand() {
        for t in [-1.0, -0.3, 0.0, 0.7, 1.0] {
            let [(p, dp)] = series(&[[0.0], [0.0], [0.0], [1.0]], 0, t);
            assert!((p - 0.5 * (5.0 * t * t * t - 3.0 * t)).abs() < 1e-15);
            assert!((dp - 0.5 * (15.0 * t * t - 3.0)).abs() < 1e-14);
            // P_1^(0,4)(2x - 1) = 6x - 5 and P_2^(0,4)(2x - 1) = 28 x^2 - 42 x + 15, Forbes 2007.
            let x = 0.5 * (t + 1.0);
            let [(one, _), (two, slope)] = series(&[[0.0; 2], [1.0, 0.0], [0.0, 1.0]], 4, t);
            assert!((one - (6.0 * x - 5.0)).abs() < 1e-15);
            assert!((two - (28.0 * x * x - 42.0 * x + 15.0)).abs() < 1e-14);
            assert!((slope - 0.5 * (56.0 * x - 42.0)).abs() < 1e-14);
        }
    }
}
