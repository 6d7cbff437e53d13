//! Sparse Cholesky factors, and the entries of the inverse at the places where the matrix has entries.
//!
//! The faer crate orders, factors and solves. The inverse of a sparse matrix is full. Its entries within the pattern of
//! the factor follow from each other, from the last column to the first (Takahashi, Fagan and Chen 1973), at about
//! twice the cost of the factorization. Here this is done supernode by supernode. Let L11 be the factor's block on the
//! diagonal and L21 the block below it, Y = L21 L11^-1, and Z22 the inverse on the rows of L21. Then Z21 = -Z22 Y and
//! Z11 = (L11 L11^T)^-1 - Y^T Z21.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::matmul::matmul;
use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::sparse::linalg::SupernodalThreshold;
use faer::sparse::linalg::cholesky::supernodal::{SupernodalLltRef, SymbolicSupernodalCholesky};
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LltRef, SymbolicCholesky, SymbolicCholeskyRaw, SymmetricOrdering,
    factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMat};
use faer::{Accum, Conj, Mat, MatMut, Par, Side};

/// Pattern of the lower triangle of a symmetric matrix, with its symbolic factorization.
pub(crate) struct SparsityPattern {
    matrix: SymbolicSparseColMat<usize>,
    symbolic: SymbolicCholesky<usize>,
    /// Supernode of each column of the factor.
    supernode: Vec<u32>,
}

/// Cholesky factor of a matrix with a given pattern.
pub(crate) struct CholeskyFactor<'a> {
    pattern: &'a SparsityPattern,
    values: Vec<f64>,
}

/// Entries of the inverse within the pattern of the factor.
pub(crate) struct SelectedInverse<'a> {
    pattern: &'a SparsityPattern,
    /// For each supernode, the square block on the diagonal and the block below it, stacked.
    blocks: Vec<Mat<f64>>,
}

impl SparsityPattern {
    /// Prepares the Cholesky factorization of all symmetric matrices with the same sparsity pattern. Computes a
    /// fill-reducing order of the rows, and the symbolic factorization.
    ///
    /// The arguments describe the lower triangle column by column. `rows` contains the row of each entry, in ascending
    /// order within a column. `begins[c]` is the index in `rows` of the first entry of column c. One more element at
    /// the end of `begins` contains the number of entries. Returns `None` if there is not enough memory. Panics if the
    /// pattern is not valid.
    pub fn new(columns: usize, begins: Vec<usize>, rows: Vec<usize>) -> Option<Self> {
        let matrix = SymbolicSparseColMat::new_checked(columns, columns, begins, None, rows);
        let params = CholeskySymbolicParams {
            supernodal_flop_ratio_threshold: SupernodalThreshold::FORCE_SUPERNODAL,
            ..CholeskySymbolicParams::default()
        };
        let symbolic =
            factorize_symbolic_cholesky(matrix.as_ref(), Side::Lower, SymmetricOrdering::Amd, params).ok()?;
        let mut pattern = Self { matrix, symbolic, supernode: vec![0; columns] };
        let blocks = pattern.blocks()?;
        let mut supernode = vec![0; columns];
        for s in 0..blocks.n_supernodes() {
            supernode[blocks.supernode_begin()[s]..blocks.supernode_end()[s]].fill(s as u32);
        }
        pattern.supernode = supernode;
        Some(pattern)
    }

    fn blocks(&self) -> Option<&SymbolicSupernodalCholesky<usize>> {
        match self.symbolic.raw() {
            SymbolicCholeskyRaw::Supernodal(blocks) => Some(blocks),
            SymbolicCholeskyRaw::Simplicial(_) => None,
        }
    }

    /// Computes the Cholesky factor of a matrix with this sparsity pattern. `values` contains the entries of the lower
    /// triangle, in the order of the pattern. Returns `None` if the matrix is not positive definite or if there is not
    /// enough memory.
    pub fn factor(&self, values: &[f64]) -> Option<CholeskyFactor<'_>> {
        let matrix = SparseColMatRef::new(self.matrix.as_ref(), values);
        let mut factor = vec![0.0; self.symbolic.len_val()];
        let scratch = self.symbolic.factorize_numeric_llt_scratch::<f64>(Par::Seq, Default::default());
        let mut memory = MemBuffer::try_new(scratch).ok()?;
        let stack = MemStack::new(&mut memory);
        let (side, plain) = (Side::Lower, Default::default());
        self.symbolic
            .factorize_numeric_llt(&mut factor, matrix, side, plain, Par::Seq, stack, Default::default())
            .ok()?;
        factor.iter().all(|v| v.is_finite()).then_some(CholeskyFactor { pattern: self, values: factor })
    }
}

impl<'a> CholeskyFactor<'a> {
    /// Solves A x = b for x, where A is the factored matrix and `right` is b. Returns `None` if there is not enough
    /// memory.
    pub fn solve(&self, right: &[f64]) -> Option<Vec<f64>> {
        let symbolic = &self.pattern.symbolic;
        let mut solution = right.to_vec();
        let mut memory = MemBuffer::try_new(symbolic.solve_in_place_scratch::<f64>(1, Par::Seq)).ok()?;
        LltRef::new(symbolic, &self.values).solve_in_place_with_conj(
            Conj::No,
            MatMut::from_column_major_slice_mut(&mut solution, right.len(), 1),
            Par::Seq,
            MemStack::new(&mut memory),
        );
        Some(solution)
    }

    /// Computes the selected inverse: the entries of the inverse matrix at the positions where the Cholesky factor has
    /// entries. Returns `None` if the factor is not stored in supernodes (blocks of columns with the same pattern).
    pub fn selected_inverse(&self) -> Option<SelectedInverse<'a>> {
        let symbolic = self.pattern.blocks()?;
        let factor = SupernodalLltRef::new(symbolic, &self.values);
        let mut inverse = SelectedInverse { pattern: self.pattern, blocks: vec![Mat::new(); symbolic.n_supernodes()] };
        let mut local = vec![0usize; symbolic.nrows()];
        for s in (0..symbolic.n_supernodes()).rev() {
            let node = factor.supernode(s);
            let (rows, columns) = (node.val().nrows(), node.val().ncols());
            let (l11, l21) = node.val().split_at_row(columns);
            let mut block = Mat::zeros(rows, columns);
            // (L11 L11^T)^-1
            let mut square = Mat::<f64>::identity(columns, columns);
            solve_lower_triangular_in_place(l11, square.as_mut(), Par::Seq);
            solve_upper_triangular_in_place(l11.transpose(), square.as_mut(), Par::Seq);
            if rows > columns {
                // Y^T = L11^-T L21^T
                let mut y = l21.transpose().to_owned();
                solve_upper_triangular_in_place(l11.transpose(), y.as_mut(), Par::Seq);
                let outer = inverse.on_rows(node.pattern(), &mut local);
                let below = block.as_mut().subrows_mut(columns, rows - columns);
                matmul(below, Accum::Replace, &outer, y.transpose(), -1.0, Par::Seq);
                matmul(&mut square, Accum::Add, &y, block.as_ref().subrows(columns, rows - columns), -1.0, Par::Seq);
            }
            block.as_mut().subrows_mut(0, columns).copy_from(&square);
            inverse.blocks[s] = block;
        }
        Some(inverse)
    }
}

impl SelectedInverse<'_> {
    /// Returns the entry of the inverse in row `a` and column `b` of the original matrix. Returns NaN if the Cholesky
    /// factor has no entry at this position, because such entries of the inverse are not computed. Every position with
    /// an entry of the original matrix also has an entry of the Cholesky factor.
    pub fn entry(&self, a: usize, b: usize) -> f64 {
        let at = |k: usize| self.pattern.symbolic.perm().map_or(k, |perm| perm.arrays().1[k]);
        let (column, row) = (at(a).min(at(b)), at(a).max(at(b)));
        let Some(symbolic) = self.pattern.blocks() else { return f64::NAN };
        let s = self.pattern.supernode[column] as usize;
        let (begin, end) = (symbolic.supernode_begin()[s], symbolic.supernode_end()[s]);
        let place = if row < end {
            Some(row - begin)
        } else {
            symbolic.supernode(s).pattern().binary_search(&row).ok().map(|k| end - begin + k)
        };
        place.map_or(f64::NAN, |place| self.blocks[s][(place, column - begin)])
    }

    /// Returns the symmetric dense block of the inverse whose rows and columns are `rows` of the Cholesky factor.
    /// `rows` must be in ascending order. The inverse must already be computed for all supernodes (blocks of columns)
    /// that contain these rows. `local` is working memory with one element for each row of the matrix.
    fn on_rows(&self, rows: &[usize], local: &mut [usize]) -> Mat<f64> {
        let mut dense = Mat::zeros(rows.len(), rows.len());
        let Some(symbolic) = self.pattern.blocks() else { return dense };
        let mut first = 0;
        while first < rows.len() {
            let t = self.pattern.supernode[rows[first]] as usize;
            let (begin, end) = (symbolic.supernode_begin()[t], symbolic.supernode_end()[t]);
            symbolic.supernode(t).pattern().iter().enumerate().for_each(|(k, &row)| local[row] = end - begin + k);
            let last = first + rows[first..].partition_point(|&row| row < end);
            for c in first..last {
                let column = self.blocks[t].col_as_slice(rows[c] - begin);
                for (r, &row) in rows.iter().enumerate().skip(c) {
                    let place = if row < end { row - begin } else { local[row] };
                    let value = column[place];
                    dense[(r, c)] = value;
                    dense[(c, r)] = value;
                }
            }
            first = last;
        }
        dense
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selected_inverse_matches_full() {
        // A band matrix with a few far entries, 40 columns.
        const N: usize = 40;
        let entry = |r: usize, c: usize| match r - c {
            0 => Some(9.0 + (r % 5) as f64),
            1 | 2 | 7 => Some(-1.0 - 0.1 * (c % 3) as f64),
            _ => None,
        };
        let (mut begins, mut rows, mut values) = (vec![0], Vec::new(), Vec::new());
        let mut full = nalgebra::DMatrix::<f64>::zeros(N, N);
        for c in 0..N {
            for r in c..N {
                if let Some(value) = entry(r, c) {
                    rows.push(r);
                    values.push(value);
                    (full[(r, c)], full[(c, r)]) = (value, value);
                }
            }
            begins.push(rows.len());
        }
        let pattern = SparsityPattern::new(N, begins, rows).unwrap();
        let factor = pattern.factor(&values).unwrap();
        let (inverse, selected) = (full.clone().try_inverse().unwrap(), factor.selected_inverse().unwrap());
        for c in 0..N {
            for r in (c..N).filter(|&r| entry(r, c).is_some()) {
                assert!((selected.entry(r, c) - inverse[(r, c)]).abs() < 1e-14, "{r} {c}");
            }
        }
        let right: Vec<f64> = (0..N).map(|k| (k as f64).sin()).collect();
        let exact = &inverse * nalgebra::DVector::from_column_slice(&right);
        assert!(factor.solve(&right).unwrap().iter().zip(exact.iter()).all(|(a, b)| (a - b).abs() < 1e-13));
    }

    #[test]
    fn indefinite_matrix_has_no_factor() {
        let pattern = SparsityPattern::new(2, vec![0, 2, 3], vec![0, 1, 1]).unwrap();
        assert!(pattern.factor(&[1.0, 2.0, 1.0]).is_none());
    }
}
