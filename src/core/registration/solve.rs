//! Ball-constrained linear least-squares problem, eq. (15): A m = b subject to |m| <= alpha.

use nalgebra::{Matrix6, SymmetricEigen, Vector6};

/// Singular values and right singular vectors of A, from its normal matrix.
#[derive(Clone, Debug)]
pub(crate) struct Spectrum {
    /// Squared singular values, in descending order.
    pub(crate) squares: Vector6<f64>,
    /// Right singular vectors, one per column.
    pub(crate) directions: Matrix6<f64>,
}

impl Spectrum {
    /// Computes the singular values S and the right singular vectors V of the Jacobian A from `gram` = A^T A = V S^2
    /// V^T, by a symmetric eigendecomposition. The singular values are in descending order.
    ///
    /// A^T A has larger rounding errors than A. They do no harm here, because A is scaled: its rotations are about the
    /// centroid of the points, and its translations are in units of the rms size of the points. With this scaling, the
    /// rounding errors hide only directions that the surface does not determine.
    pub(crate) fn new(gram: &Matrix6<f64>) -> Self {
        let eigen = SymmetricEigen::new(*gram);
        let mut order: [usize; 6] = std::array::from_fn(|k| k);
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        Self {
            squares: Vector6::from_fn(|k, _| eigen.eigenvalues[order[k]].max(0.0)),
            directions: Matrix6::from_fn(|i, k| eigen.eigenvectors[(i, order[k])]),
        }
    }

    /// Returns the number of directions of the pose that the surface determines. These are the directions with a
    /// squared singular value above `whole * least_share^2`.
    ///
    /// `min_share` is a share from 0 to 1. `whole` is the sum of all squared singular values before any direction was
    /// locked. A locked direction has a singular value of 0 except for rounding errors. `whole` includes the locked
    /// directions, so that the limit exceeds these rounding errors.
    pub(crate) fn rank(&self, min_share: f64, whole: f64) -> usize {
        let limit = whole * min_share * min_share;
        (0..6).take_while(|&k| self.squares[k] > limit).count()
    }

    /// Solves the ball-constrained least-squares problem: returns the m that minimises |A m - b| with |m| <= `alpha`,
    /// within the first `rank` directions. `right` is A^T b.
    ///
    /// Equation: m(mu) = sum_k v_k (v_k . A^T b) / (s_k^2 + mu), with the singular values s_k and right singular
    /// vectors v_k of A. Here mu = 0 if that m lies in the ball; otherwise mu is the root of the secular equation
    /// |m(mu)| = alpha (Golub and Van Loan, Matrix Computations, 12.1.2).
    pub(crate) fn step(&self, right: &Vector6<f64>, rank: usize, alpha: f64) -> Vector6<f64> {
        let along = self.directions.transpose() * right;
        let step = |mu: f64| {
            let mut m = Vector6::zeros();
            for k in 0..rank {
                m += self.directions.column(k) * (along[k] / (self.squares[k] + mu));
            }
            m
        };
        let free = step(0.0);
        if free.norm() <= alpha {
            return free;
        }
        step(self.multiplier(&along, rank, alpha))
    }

    /// Returns the Lagrange multiplier mu of the ball constraint |m| <= `alpha` in [`Self::step`]. Solves 1/|m(mu)| =
    /// 1/`alpha` for mu by Newton's method, starting at 0. `along` contains the components of A^T b along the singular
    /// vectors, of which the first `rank` are used.
    ///
    /// The function 1/|m(mu)| is almost linear in mu. So the iteration rises to the solution from below, and does not
    /// overshoot.
    fn multiplier(&self, along: &Vector6<f64>, rank: usize, alpha: f64) -> f64 {
        let mut mu = 0.0;
        for _ in 0..60 {
            let (mut norm2, mut slope) = (0.0, 0.0);
            for k in 0..rank {
                let s = self.squares[k] + mu;
                let part = (along[k] / s).powi(2);
                norm2 += part;
                slope += part / s;
            }
            let norm = norm2.sqrt();
            let change = (norm - alpha) / alpha * norm2 / slope;
            mu += change;
            if change <= 1e-14 * mu {
                break;
            }
        }
        mu
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problem() -> (Matrix6<f64>, Vector6<f64>) {
        let a = Matrix6::from_fn(|i, j| ((i * 7 + j * 3) as f64 * 0.77).sin() + if i == j { 2.0 } else { 0.0 });
        let b = Vector6::from_fn(|i, _| (i as f64 * 1.3).cos());
        (a.transpose() * a, a.transpose() * b)
    }

    #[test]
    fn wide_trust_region_is_least_squares() {
        let (gram, right) = problem();
        let m = Spectrum::new(&gram).step(&right, 6, 1e6);
        assert!((gram * m - right).norm() < 1e-12);
    }

    #[test]
    fn small_trust_region_step_is_optimal() {
        let (gram, right) = problem();
        let spectrum = Spectrum::new(&gram);
        let free = spectrum.step(&right, 6, 1e6).norm();
        for share in [1e-9, 1e-3, 0.3, 0.999_999] {
            let alpha = share * free;
            let m = spectrum.step(&right, 6, alpha);
            assert!((m.norm() / alpha - 1.0).abs() < 1e-10, "{share}: {}", m.norm() / alpha);
            // Stationary on the sphere: the residual gradient points along m.
            let gradient = right - gram * m;
            assert!((gradient.normalize() - m.normalize()).norm() < 1e-6 && gradient.dot(&m) > 0.0);
        }
    }

    #[test]
    fn step_skips_undetermined_direction() {
        let mut gram = Matrix6::from_diagonal(&Vector6::new(4.0, 3.0, 2.0, 1.0, 0.5, 1e-14));
        gram[(0, 1)] = 0.5;
        gram[(1, 0)] = 0.5;
        let spectrum = Spectrum::new(&gram);
        assert_eq!(spectrum.rank(1e-6, gram.trace()), 5);
        let m = spectrum.step(&Vector6::repeat(1.0), 5, 10.0);
        assert!(m[5].abs() < 1e-12);
    }

    #[test]
    fn zero_gradient_gives_no_step() {
        let (gram, _) = problem();
        assert_eq!(Spectrum::new(&gram).step(&Vector6::zeros(), 6, 0.5).norm(), 0.0);
        assert_eq!(Spectrum::new(&Matrix6::zeros()).rank(1e-6, 0.0), 0);
    }
}
