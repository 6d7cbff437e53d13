//! Tridiagonal form of a symmetric matrix. It gives what likelihoods need at many variance ratios, without eigenvectors.
//!
//! ```text
//!  A = Q T Q'                    T: tridiagonal; Q: a sequence of reflections (Golub and Van Loan 2013, 8.3)
//!  shift I + factor A = Q L D L' Q'
//! ```
//!
//! After the reduction of A, which costs O(n^3), each pair of a shift and a factor costs O(n). The eigenvectors of A cost
//! as much again as the reduction, and are computed from T where they are needed.

use faer::diag::Diag;
use faer::dyn_stack::{MemBuffer, MemStack, StackReq};
use faer::linalg::evd::{ComputeEigenvectors, self_adjoint_evd_scratch, tridiag, tridiagonal_self_adjoint_evd};
use faer::linalg::householder::{
    apply_block_householder_sequence_on_the_left_in_place_scratch as reflection_scratch,
    apply_block_householder_sequence_on_the_left_in_place_with_conj as reflect,
    apply_block_householder_sequence_transpose_on_the_left_in_place_scratch as transposed_scratch,
    apply_block_householder_sequence_transpose_on_the_left_in_place_with_conj as reflect_transposed,
};
use faer::linalg::qr::no_pivoting::factor::recommended_block_size;
use faer::{Conj, Mat, Par, Spec};
use nalgebra::DMatrix;

/// Symmetric matrix A = Q T Q' with the tridiagonal matrix T and the orthogonal matrix Q.
pub(super) struct TridiagonalForm {
    /// T on the diagonal and below it; the reflections of Q further below.
    reduced: Mat<f64>,
    /// Coefficients of blocks of reflections.
    coefficients: Mat<f64>,
}

/// Eigenvalues of a matrix in ascending order, and their eigenvectors.
pub(super) struct Eigenpairs {
    pub(super) values: Vec<f64>,
    /// One column for each eigenvalue.
    pub(super) vectors: Mat<f64>,
}

impl TridiagonalForm {
    /// Reduces the symmetric matrix `matrix` to its tridiagonal form. Only the lower triangle is read.
    pub(super) fn reduce(matrix: Mat<f64>) -> Self {
        let n = matrix.nrows();
        let mut reduced = matrix;
        let mut coefficients = Mat::zeros(recommended_block_size::<f64>(n, n), n.saturating_sub(1));
        with_memory(tridiag::tridiag_in_place_scratch::<f64>(n, Par::Seq, Spec::default()), |memory| {
            tridiag::tridiag_in_place(reduced.as_mut(), coefficients.as_mut(), Par::Seq, memory, Spec::default());
        });
        Self { reduced, coefficients }
    }

    /// Returns the number of rows of A.
    pub(super) fn size(&self) -> usize {
        self.reduced.nrows()
    }

    /// Returns the sum of the eigenvalues of A.
    pub(super) fn trace(&self) -> f64 {
        (0..self.size()).map(|k| self.reduced[(k, k)]).sum()
    }

    /// Returns Q' times `columns`, which have one row for each row of A.
    pub(super) fn rotate(&self, columns: &Mat<f64>) -> Mat<f64> {
        self.reflected(columns, true)
    }

    /// Returns Q times `columns`, which have one row for each row of T.
    pub(super) fn rotate_back(&self, columns: &Mat<f64>) -> Mat<f64> {
        self.reflected(columns, false)
    }

    /// Returns Q' times `columns` if `transposed` is true, otherwise Q times `columns`. The reflections leave the first
    /// row as it is.
    fn reflected(&self, columns: &Mat<f64>, transposed: bool) -> Mat<f64> {
        let (mut columns, n) = (columns.clone(), self.size());
        if n < 2 {
            return columns;
        }
        let (block, count) = (self.coefficients.nrows(), columns.ncols());
        let reflections = self.reduced.submatrix(1, 0, n - 1, n - 1);
        let others = columns.as_mut().subrows_mut(1, n - 1);
        let coefficients = self.coefficients.as_ref();
        if transposed {
            let scratch = transposed_scratch::<f64>(n - 1, block, count);
            with_memory(scratch, |memory| {
                reflect_transposed(reflections, coefficients, Conj::No, others, Par::Seq, memory);
            });
        } else {
            let scratch = reflection_scratch::<f64>(n - 1, block, count);
            with_memory(scratch, |memory| reflect(reflections, coefficients, Conj::No, others, Par::Seq, memory));
        }
        columns
    }

    /// Factors `shift` I + `factor` T. `shift` is above 0, `factor` at least 0, and A has no negative eigenvalues.
    pub(super) fn shifted(&self, shift: f64, factor: f64) -> ShiftedFactor {
        let mut found = ShiftedFactor { below: vec![0.0; self.size()], pivots: Vec::with_capacity(self.size()) };
        for k in 0..self.size() {
            let mut pivot = shift + factor * self.reduced[(k, k)];
            if k > 0 {
                found.below[k] = factor * self.reduced[(k, k - 1)];
                pivot -= found.below[k] * found.below[k] / found.pivots[k - 1];
            }
            // No eigenvalue is below the shift, and so no pivot is: only rounding makes one smaller.
            found.pivots.push(pivot.max(shift));
        }
        found
    }

    /// Returns the eigenpairs of A, or `None` if the iteration does not converge.
    pub(super) fn eigenpairs(&self) -> Option<Eigenpairs> {
        let n = self.size();
        if n == 0 {
            return Some(Eigenpairs { values: Vec::new(), vectors: Mat::new() });
        }
        let mut values = Diag::<f64>::zeros(n);
        let mut vectors = Mat::<f64>::zeros(n, n);
        let mut below = Diag::<f64>::zeros(n);
        for k in 1..n {
            below[k - 1] = self.reduced[(k, k - 1)];
        }
        let params = Spec::default();
        let scratch = self_adjoint_evd_scratch::<f64>(n, ComputeEigenvectors::Yes, Par::Seq, params);
        with_memory(scratch, |memory| {
            tridiagonal_self_adjoint_evd(
                self.reduced.diagonal(),
                below.as_ref(),
                values.as_mut(),
                Some(vectors.as_mut()),
                Par::Seq,
                memory,
                params,
            )
        })
        .ok()?;
        let values = values.column_vector().iter().copied().collect();
        Some(Eigenpairs { values, vectors: self.rotate_back(&vectors) })
    }
}

/// Factors L D L' of the matrix M = shift I + factor T.
pub(super) struct ShiftedFactor {
    /// Elements of M left of the diagonal; the first is 0.
    below: Vec<f64>,
    /// Diagonal D.
    pivots: Vec<f64>,
}

impl ShiftedFactor {
    /// Returns the number of rows of M.
    pub(super) fn size(&self) -> usize {
        self.pivots.len()
    }

    /// Returns ln |M|.
    pub(super) fn log_determinant(&self) -> f64 {
        self.pivots.iter().map(|pivot| pivot.ln()).sum()
    }

    /// Returns the products a'M^-1 b of all pairs of columns of `columns`.
    pub(super) fn products(&self, columns: &Mat<f64>) -> DMatrix<f64> {
        let count = columns.ncols();
        let mut products = DMatrix::zeros(count, count);
        let mut solved = vec![0.0; count];
        for (k, (below, pivot)) in self.below.iter().zip(&self.pivots).enumerate() {
            let ratio = if k > 0 { below / self.pivots[k - 1] } else { 0.0 };
            for (c, value) in solved.iter_mut().enumerate() {
                *value = columns[(k, c)] - ratio * *value;
            }
            for b in 0..count {
                let scaled = solved[b] / pivot;
                for a in b..count {
                    products[(a, b)] += solved[a] * scaled;
                }
            }
        }
        products.fill_upper_triangle_with_lower_triangle();
        products
    }

    /// Returns M^-1 times `column`.
    pub(super) fn solve(&self, column: &[f64]) -> Vec<f64> {
        let mut solved = column.to_vec();
        for k in 1..solved.len() {
            solved[k] -= self.below[k] / self.pivots[k - 1] * solved[k - 1];
        }
        for k in (0..solved.len()).rev() {
            let after = if k + 1 < solved.len() { self.below[k + 1] * solved[k + 1] } else { 0.0 };
            solved[k] = (solved[k] - after) / self.pivots[k];
        }
        solved
    }

    /// Returns the traces of M^-1 and of M^-2.
    ///
    /// They are the first derivative of ln |M| with respect to the shift, and the second one with the other sign. Both
    /// follow from the derivatives of the pivots.
    pub(super) fn inverse_traces(&self) -> [f64; 2] {
        let (mut first, mut second) = (0.0, 0.0);
        let mut traces = [0.0, 0.0];
        for (k, (below, pivot)) in self.below.iter().zip(&self.pivots).enumerate() {
            if k == 0 {
                first = 1.0;
            } else {
                let before = self.pivots[k - 1];
                let (ratio2, rate) = ((below / before).powi(2), first / before);
                (first, second) = (1.0 + ratio2 * first, ratio2 * (second - 2.0 * first * rate));
            }
            traces[0] += first / pivot;
            traces[1] += (first / pivot).powi(2) - second / pivot;
        }
        traces
    }
}

/// Calls `act` with working memory of the size `required`.
fn with_memory<T>(required: StackReq, act: impl FnOnce(&mut MemStack) -> T) -> T {
    act(MemStack::new(&mut MemBuffer::new(required)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Covariance of a field with an exponential correlation at `n` places, without its upper triangle.
    fn covariance(n: usize) -> Mat<f64> {
        let place = |k: usize| [7.0 * (1.7 * k as f64).sin(), 5.0 * (0.9 * k as f64).cos()];
        Mat::from_fn(n, n, |a, b| {
            let [[ax, ay], [bx, by]] = [place(a), place(b)];
            if a < b { f64::NAN } else { (-(ax - bx).hypot(ay - by) / 4.0).exp() }
        })
    }

    fn whole(lower: &Mat<f64>) -> DMatrix<f64> {
        DMatrix::from_fn(lower.nrows(), lower.nrows(), |a, b| lower[(a.max(b), a.min(b))])
    }

    fn columns(n: usize) -> Mat<f64> {
        Mat::from_fn(n, 3, |r, c| ((1 + r) as f64 * (0.3 + c as f64)).sin())
    }

    /// A = [2 1; 1 2] with shift 1 and factor 1 is M = [3 1; 1 3]: |M| = 8, M^-1 = [3 -1; -1 3] / 8.
    #[test]
    fn two_rows_match_hand_calculation() {
        let form = TridiagonalForm::reduce(Mat::from_fn(2, 2, |a, b| if a == b { 2.0 } else { 1.0 }));
        let factor = form.shifted(1.0, 1.0);
        assert!((factor.log_determinant() - 8f64.ln()).abs() < 1e-14);
        let [inverse, inverse2] = factor.inverse_traces();
        assert!((inverse - 0.75).abs() < 1e-15);
        assert!((inverse2 - 20.0 / 64.0).abs() < 1e-15);
        let rotated = form.rotate(&Mat::from_fn(2, 1, |r, _| if r == 0 { 1.0 } else { 0.0 }));
        assert!((factor.products(&rotated)[(0, 0)] - 0.375).abs() < 1e-15);
        assert_eq!(form.trace(), 4.0);
    }

    #[test]
    fn factors_match_dense_inverse() {
        for n in [1, 2, 3, 5, 40, 130] {
            let lower = covariance(n);
            let (matrix, form, columns) = (whole(&lower), TridiagonalForm::reduce(lower), columns(n));
            let dense = DMatrix::from_fn(n, 3, |r, c| columns[(r, c)]);
            for (shift, factor) in [(1.0, 0.0), (1.0, 1e-3), (1.5, 2.0), (1.0, 1e6)] {
                let expected = (DMatrix::identity(n, n) * shift + &matrix * factor).cholesky().unwrap();
                let inverse = expected.inverse();
                let near = |found: f64, of: f64| (found - of).abs() <= 1e-9 * of.abs().max(1e-6);
                let found = form.shifted(shift, factor);
                let log_determinant: f64 = 2.0 * expected.l().diagonal().map(f64::ln).sum();
                assert!((found.log_determinant() - log_determinant).abs() < 1e-9 * (1.0 + log_determinant.abs()));
                let [first, second] = found.inverse_traces();
                assert!(near(first, inverse.trace()) && near(second, inverse.norm_squared()), "{n} {shift} {factor}");
                let rotated = form.rotate(&columns);
                let products = found.products(&rotated);
                let by_hand = dense.tr_mul(&(&inverse * &dense));
                assert!((products - &by_hand).amax() < 1e-9 * by_hand.amax(), "{n} {shift} {factor}");
                let solved = form.rotate_back(&Mat::from_fn(n, 1, |r, _| found.solve(rotated.col_as_slice(0))[r]));
                let by_hand = &inverse * dense.column(0);
                let apart = (0..n).map(|r| (solved[(r, 0)] - by_hand[r]).abs()).fold(0.0, f64::max);
                assert!(apart < 1e-9 * by_hand.amax(), "{n} {shift} {factor}");
            }
        }
    }

    #[test]
    fn eigenpairs_restore_matrix() {
        for n in [1, 2, 3, 40, 130] {
            let lower = covariance(n);
            let (matrix, form) = (whole(&lower), TridiagonalForm::reduce(lower));
            let Eigenpairs { values, vectors } = form.eigenpairs().unwrap();
            assert!(values.is_sorted());
            assert!((values.iter().sum::<f64>() - form.trace()).abs() < 1e-12 * n as f64);
            let vectors = DMatrix::from_fn(n, n, |r, c| vectors[(r, c)]);
            let restored = &vectors * DMatrix::from_diagonal(&values.into()) * vectors.transpose();
            assert!((restored - matrix).amax() < 1e-12 * n as f64);
            assert!((vectors.tr_mul(&vectors) - DMatrix::identity(n, n)).amax() < 1e-13 * n as f64);
        }
    }

    #[test]
    fn empty_and_zero_matrices_are_noise_alone() {
        let empty = TridiagonalForm::reduce(Mat::new()).shifted(2.0, 3.0);
        assert_eq!((empty.size(), empty.log_determinant(), empty.inverse_traces()), (0, 0.0, [0.0, 0.0]));
        assert!(TridiagonalForm::reduce(Mat::new()).eigenpairs().unwrap().values.is_empty());
        let zero = TridiagonalForm::reduce(Mat::zeros(4, 4));
        assert_eq!(zero.shifted(2.0, 3.0).inverse_traces(), [2.0, 1.0]);
        assert_eq!(zero.eigenpairs().unwrap().values, [0.0; 4]);
    }
}
