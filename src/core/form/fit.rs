//! Least-squares fit of polynomials to the points at their measured positions.
//!
//! The deviations d are the last column of the matrix [terms | d]. The rows of this matrix are decomposed by QR in
//! chunks. Only the small triangles R are kept. They are stacked in order and decomposed again, so the number of cores
//! does not change the result. The last column of the final R contains Q^T d. The columns of Q are the terms, each made
//! orthogonal to those before it on the true aperture (Gram-Schmidt). Q^T d / sqrt(n), with n points, is the root mean
//! square that each orthogonal term explains; later terms do not change it. R^-1 Q^T d are the coefficients of the
//! terms themselves.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::FormError;
use super::error::check;
use super::polynomial_basis::{PolynomialBasis, Terms};
use crate::geometry::DeviationSample;

/// Number of rows in a chunk.
const CHUNK_ROWS: usize = 512;
/// Minimum share of a term that is independent of the terms before it. With a smaller share, the points do not
/// determine the term.
const MIN_INDEPENDENT_SHARE: f64 = 1e-7;
/// Minimum number of points per term in [`fit_determined_terms`].
const POINTS_PER_TERM: usize = 4;

/// Fit of polynomials to deviations.
#[derive(Clone, Debug, PartialEq)]
pub struct PolynomialFit {
    /// Polynomials of the fit.
    pub basis: PolynomialBasis,
    /// Coefficient of each term in millimetres. Each term is scaled to a mean square of 1 over the full disc or
    /// rectangle.
    pub coefficients_mm: Vec<f64>,
    /// Signed contribution of each term to the root mean square of the deviations, in millimetres. Each term is first
    /// made orthogonal, at the points, to the terms before it.
    pub orthogonal_mm: Vec<f64>,
    /// Root mean square of the residuals, in millimetres.
    pub residual_rms_mm: f64,
    /// Number of fitted points.
    pub points: usize,
}

/// Fits the first `terms` polynomials of `basis` to the deviations of the samples by least squares.
///
/// Frame: model. Units: millimetres.
///
/// # Errors
/// Returns an error if `terms` is 0 or above the number of terms of the basis (37 for Fringe Zernike, otherwise 105),
/// if there are fewer points than terms, if the points do not determine a term, or if a point is not finite or lies
/// more than 1.5 radii from the centre of a Zernike disc.
pub fn fit_polynomials(
    basis: &PolynomialBasis,
    terms: usize,
    samples: &[DeviationSample],
) -> Result<PolynomialFit, FormError> {
    check(samples, terms)?;
    let rows = basis.prepare_terms(terms)?;
    let solved = solve_least_squares(terms, samples, |index, sample, row| rows.values(index, sample, row))?;
    let LeastSquaresSolution { coefficients, orthogonal, residual, undetermined } = solved;
    if let Some(k) = undetermined {
        return Err(FormError::Undetermined { term: basis.term_name(k), points: samples.len() });
    }
    Ok(PolynomialFit {
        basis: basis.clone(),
        coefficients_mm: coefficients,
        orthogonal_mm: orthogonal,
        residual_rms_mm: residual,
        points: samples.len(),
    })
}

/// Fits as many of the first `most` polynomials of `basis` as the points determine, by least squares.
///
/// Only complete orders are fitted, with at least four points per term: with a Legendre basis, for example, all terms
/// of a total degree or none.
///
/// # Errors
/// Returns an error if there are fewer than four points, if they do not determine even the first term, if `most` is 0,
/// or if a point is not finite or lies more than 1.5 radii from the centre of a Zernike disc.
pub fn fit_determined_terms(
    basis: &PolynomialBasis,
    most: usize,
    samples: &[DeviationSample],
) -> Result<PolynomialFit, FormError> {
    check(samples, POINTS_PER_TERM)?;
    let mut terms = basis.complete_terms(most.min(samples.len() / POINTS_PER_TERM));
    loop {
        match fit_polynomials(basis, terms, samples) {
            Err(FormError::Undetermined { .. }) if terms > 1 => terms = basis.complete_terms(terms - 1),
            fitted => return fitted,
        }
    }
}

impl PolynomialFit {
    /// Evaluates the fitted polynomials at the position of every sample. Returns the values in millimetres, in the
    /// order of the samples. The deviations of the samples are not used.
    ///
    /// # Errors
    /// Returns an error if a sample lies more than 1.5 radii from the centre of a Zernike disc.
    pub fn values_mm(&self, samples: &[DeviationSample]) -> Result<Vec<f64>, FormError> {
        let terms: Terms = self.basis.prepare_terms(self.coefficients_mm.len())?;
        let value = |row: &mut Vec<f64>, (index, sample): (usize, &DeviationSample)| {
            terms.values(index, sample, row)?;
            Ok(row.iter().zip(&self.coefficients_mm).map(|(value, c)| value * c).sum())
        };
        let values: Vec<Result<f64, FormError>> =
            samples.par_iter().enumerate().map_init(|| vec![0.0; terms.len()], value).collect();
        // The error is that of the first failing sample in order, not in time.
        values.into_iter().collect()
    }
}

/// Solution of a least-squares problem.
pub(super) struct LeastSquaresSolution {
    pub(super) coefficients: Vec<f64>,
    pub(super) orthogonal: Vec<f64>,
    /// Root mean square of the residuals.
    pub(super) residual: f64,
    /// Index of the first term that the points do not determine; `None` if they determine all terms.
    pub(super) undetermined: Option<usize>,
}

/// Fits a weighted sum of `terms` functions to the deviations of the samples by least squares (QR decomposition).
///
/// The caller defines the functions by `row(index, sample, values)`. It is called once for each sample and writes the
/// value of every function at this sample into `values`.
///
/// If the samples do not determine all functions, [`LeastSquaresSolution::undetermined`] holds the index of the first
/// undetermined function, and all coefficients are 0.
///
/// # Errors
/// Returns the error of the first sample for which `row` fails.
pub(super) fn solve_least_squares(
    terms: usize,
    samples: &[DeviationSample],
    row: impl Fn(usize, &DeviationSample, &mut [f64]) -> Result<(), FormError> + Sync,
) -> Result<LeastSquaresSolution, FormError> {
    let width = terms + 1;
    let triangles: Vec<Result<DMatrix<f64>, FormError>> = samples
        .par_chunks(CHUNK_ROWS)
        .enumerate()
        .map(|(share, chunk)| {
            let mut rows = DMatrix::zeros(chunk.len(), width);
            let mut values = vec![0.0; terms];
            for (k, sample) in chunk.iter().enumerate() {
                row(share * CHUNK_ROWS + k, sample, &mut values)?;
                for (column, value) in values.iter().enumerate() {
                    rows[(k, column)] = *value;
                }
                rows[(k, terms)] = sample.deviation_mm;
            }
            Ok(rows.qr().r())
        })
        .collect();
    let triangles: Vec<DMatrix<f64>> = triangles.into_iter().collect::<Result<_, FormError>>()?;
    let mut r = DMatrix::<f64>::zeros(width, width);
    for some in triangles.chunks(CHUNK_ROWS.div_ceil(width)) {
        let height = width + some.iter().map(DMatrix::nrows).sum::<usize>();
        let mut stacked = DMatrix::zeros(height, width);
        stacked.rows_mut(0, width).copy_from(&r);
        let mut begin = width;
        for triangle in some {
            stacked.rows_mut(begin, triangle.nrows()).copy_from(triangle);
            begin += triangle.nrows();
        }
        r = stacked.qr().r();
    }
    Ok(back_substituted(&r, terms, samples.len()))
}

/// Solves a least-squares problem by back substitution. Returns the coefficients of the functions, the coefficients of
/// the orthonormalised functions, the RMS of the residuals, and the index of the first function that the points do not
/// determine. If there is such a function, the coefficients of the functions are 0.
///
/// `r` is the triangular matrix R of a QR decomposition. The decomposed matrix has one row for each point, one column
/// for each of the `terms` functions, and the deviations as the last column. `points` is the number of points.
fn back_substituted(r: &DMatrix<f64>, terms: usize, points: usize) -> LeastSquaresSolution {
    let scale = (points as f64).sqrt();
    let undetermined = (0..terms).find(|&k| {
        let norm = r.column(k).rows(0, k + 1).norm();
        // Not a plain comparison: a NaN determines nothing.
        !matches!(r[(k, k)].abs().partial_cmp(&(MIN_INDEPENDENT_SHARE * norm)), Some(std::cmp::Ordering::Greater))
    });
    let orthogonal: Vec<f64> = (0..terms).map(|k| r[(k, terms)] * r[(k, k)].signum() / scale).collect();
    let mut coefficients = vec![0.0; terms];
    if undetermined.is_none() {
        for k in (0..terms).rev() {
            let known: f64 = (k + 1..terms).map(|j| r[(k, j)] * coefficients[j]).sum();
            coefficients[k] = (r[(k, terms)] - known) / r[(k, k)];
        }
    }
    LeastSquaresSolution { coefficients, orthogonal, residual: r[(terms, terms)].abs() / scale, undetermined }
}
