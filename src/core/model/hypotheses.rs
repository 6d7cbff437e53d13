//! Hypotheses of the field over the points of a measurement: everything that does not depend on the deviations.
//!
//! The deviations d of n points have p fixed effects H with coefficients b, random effects E with factors t, the field
//! f, and the noise e:
//!
//! ```text
//!  W d = W H b + W E t + W f + e        e of variance s^2; W subtracts what noise shares with the touch before
//!  R K R = U diag(l) U'                 R = 1 - Q Q', Q an orthonormal base of W H; K: covariance of W f for one node
//! ```
//!
//! A node is one smoothness and one range. After one reduction to a tridiagonal form for the node ([`TridiagonalForm`]),
//! each variance ratio costs O(n). In terms of the eigenvectors, which only samples of the node need:
//!
//! ```text
//!  v = U'R W d
//!  -2 ln p = sum ln(1 + l tau) + (n - p) ln sum v^2 / (1 + l tau)
//! ```
//!
//! Here tau is the variance ratio of field and noise. The eigenvalues l are scaled so that tau is the mean square of
//! the form after the best fit, in units of the variance of the noise. The noise s is integrated out with the prior
//! density 1 / s^2.
//!
//! Points up to [`MAX_INDIVIDUAL_POINTS`] are used one by one. For more points, a pivoted Cholesky factor of the
//! products of the basis functions keeps only what the points can distinguish. A field also has waves shorter than
//! those of the basis. These are nearly independent from point to point, and add the same amount to every l.

use std::f64::consts::LN_2;
use std::ops::Range;
use std::sync::OnceLock;

use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Accum, Mat, Par};
use nalgebra::DMatrix;
use rayon::prelude::*;

use super::basis::Basis;
use super::tridiagonal::{Eigenpairs, ShiftedFactor, TridiagonalForm};
use super::{Anisotropy, ModelError, Observations, Smoothness, orthonormal_base, spacing_mm};

/// Smoothnesses of the hypotheses, from rough to smooth.
pub(super) const SMOOTHNESSES: [Smoothness; 3] =
    [Smoothness::Exponential, Smoothness::Matern2, Smoothness::SquaredExponential];
/// Number of ranges for each smoothness.
const RANGES: usize = 9;
/// Shortest range, in spacings of the points.
const MIN_RANGE_SPACINGS: f64 = 2.5;
/// Longest range, in sizes of the part (root mean square distance of the points from their centroid).
const MAX_RANGE_SIZES: f64 = 5.0;
/// Shortest range, in half wavelengths of the shortest cosine.
const MIN_RANGE_HALF_WAVELENGTHS: f64 = 2.0;
/// Number of variance ratios (field to noise), in equal steps of their logarithm.
const VARIANCE_RATIOS: usize = 33;
/// Lowest and highest variance ratio.
const VARIANCE_RATIO_LIMITS: [f64; 2] = [1e-3, 1e5];
/// Maximum number of cosines: for at most [`MAX_INDIVIDUAL_POINTS`] points, and for more.
const MAX_COSINES: [usize; 2] = [1000, 600];
/// Number of cosines for each point, within the limits of the total number.
const COSINES_PER_POINT: f64 = 5.0;
/// Minimum number of cosines.
const MIN_COSINES: usize = 150;
/// Maximum number of points that are used one by one. More points are reduced to the products of the basis functions.
const MAX_INDIVIDUAL_POINTS: usize = 600;
/// Degree of the polynomials that are added to the cosines if there are more than [`MAX_INDIVIDUAL_POINTS`] points. Few
/// points cannot distinguish these polynomials from wheel wear or from a motion of the part.
const DEGREE: usize = 4;
/// Relative limit of the standard deviation: a node drops the basis functions after the last one above this share of
/// the largest.
const MIN_SIGMA_SHARE: f64 = 1e-4;
/// Relative limit of the remaining variance: the factor stops at pivots below this share of the largest.
const MIN_PIVOT_SHARE: f64 = 1e-5;
/// Number of rows that are processed at a time.
const ROWS: usize = 1024;
/// Number of blocks of rows whose sums are in memory at a time.
const BLOCKS_AT_ONCE: usize = 32;

/// Correlation of the noise from one point to the next, and anisotropy of the field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct NoiseKind {
    pub(super) anisotropy: Anisotropy,
    pub(super) autocorrelation: f64,
}

impl NoiseKind {
    pub(super) const PLAIN: Self = Self { anisotropy: Anisotropy::NONE, autocorrelation: 0.0 };
}

/// Hypotheses of the field over the points of a measurement.
pub(super) struct FieldHypotheses {
    pub(super) kind: NoiseKind,
    pub(super) basis: Basis,
    places: Vec<[f64; 2]>,
    /// Coefficients of the whitening of each point: the factor of its own row, and the factor of the row before, which
    /// is subtracted.
    whitening: Vec<[f64; 2]>,
    /// Orthonormal base Q of the whitened fixed effects.
    base: DMatrix<f64>,
    /// Degrees of freedom n - p.
    pub(super) degrees_of_freedom: f64,
    /// Term ln |W| - 1/2 ln |H'W'W H|, which makes likelihoods with and without noise autocorrelation comparable.
    pub(super) log_whitened: f64,
    reduced: Reduced,
    /// Products Q'W phi: the part of the basis functions phi that the best fit removes.
    removed_by_fit: Mat<f64>,
    pub(super) hypotheses: Vec<FieldHypothesis>,
}

/// Basis functions at the points, reduced to the smallest number of coordinates that distinguishes the basis functions.
struct Reduced {
    /// One row for each coordinate, one column for each basis function.
    rows: Mat<f64>,
    /// Basis functions at the pivots that define the coordinates; None if each point is a coordinate.
    pivots: Option<Vec<usize>>,
}

/// Node: one smoothness and one range, with the covariance of its field in a form that is easily inverted.
pub(super) struct FieldHypothesis {
    pub(super) smoothness: Smoothness,
    pub(super) range_mm: f64,
    /// Standard deviations of the coefficients of the first basis functions, in a field of variance 1.
    pub(super) standard_deviations: Vec<f64>,
    /// Variance of a point in waves shorter than those of the basis, in a field of variance 1.
    pub(super) truncated_variance: f64,
    /// Factor by which tau s^2 is multiplied to give the variance of the field.
    pub(super) scale: f64,
    /// Products C'C of the rows C of the node if it has fewer basis functions than coordinates, otherwise C C'. Without
    /// the truncated variance, and before scaling.
    products: TridiagonalForm,
    /// True if the products are C'C.
    by_waves: bool,
    components: OnceLock<Option<Components>>,
    /// Logarithm of the prior of each variance ratio.
    pub(super) prior: Vec<f64>,
}

/// Principal components of the field of a node: the solution of its eigenproblem.
pub(super) struct Components {
    /// Eigenvalues l before scaling and without the truncated variance.
    pub(super) eigenvalues: Vec<f64>,
    /// Eigenvectors U in the coordinates.
    pub(super) eigenvectors: Mat<f64>,
}

/// Columns of reduced coordinates, seen through the tridiagonal form of a node.
pub(super) struct Projected {
    /// Q'C' or Q' times the columns: one row for each row of the tridiagonal form.
    rotated: Mat<f64>,
    /// Products of all pairs of columns; without those of `rotated` if the products of the node are C C'.
    rest: DMatrix<f64>,
}

/// Covariance of field and noise for one node and one variance ratio, for noise of variance 1.
pub(super) struct NodeCovariance {
    /// Variance of the noise and of the waves that are as independent as noise.
    noise: f64,
    /// Factor on the products of the node.
    field: f64,
    factor: ShiftedFactor,
}

/// Returns the variance ratios at which every field hypothesis (a smoothness and a range of the random field) is
/// evaluated. A variance ratio is the variance of the field divided by the variance of the noise. There are
/// [`VARIANCE_RATIOS`] values in ascending order, with equal steps of their logarithm.
pub(super) fn variance_ratios() -> impl Iterator<Item = f64> {
    let [least, most] = VARIANCE_RATIO_LIMITS.map(f64::ln);
    (0..VARIANCE_RATIOS).map(move |k| (least + (most - least) * k as f64 / (VARIANCE_RATIOS - 1) as f64).exp())
}

impl FieldHypotheses {
    /// Prepares all hypotheses of the field for the observed points. A hypothesis (node) is one smoothness with one
    /// range. Reduces one covariance to tridiagonal form for each node.
    ///
    /// `kind` has the anisotropy of the field and the autocorrelation of the noise. The deviations in `observed` are
    /// not used, but they must be finite. Nodes without a solution are left out.
    ///
    /// # Errors
    /// Returns an error if the numbers of rows differ, if a number is not finite, if there are not more points than
    /// fixed effects, or if the fixed effects are linearly dependent.
    pub(super) fn over(observed: &Observations, kind: NoiseKind) -> Result<Self, ModelError> {
        Self::of_smoothness(observed, kind, |_| true)
    }

    /// Prepares the hypotheses of [`Self::over`] with a smoothness for which `is_of` returns true.
    ///
    /// # Errors
    /// Returns the errors of [`Self::over`].
    pub(super) fn of_smoothness(
        observed: &Observations,
        kind: NoiseKind,
        is_of: impl Fn(Smoothness) -> bool,
    ) -> Result<Self, ModelError> {
        let mut fields = Self::without_nodes(observed, kind)?;
        // Rough fields hardly differ from one range to the next, and cost most: every second range is enough.
        let is_laid = |k: usize, smoothness: Smoothness| {
            is_of(smoothness) && (smoothness != Smoothness::Exponential || k.is_multiple_of(2))
        };
        let all = fields.ranges_mm().enumerate().flat_map(|(k, range_mm)| SMOOTHNESSES.map(|of| (k, of, range_mm)));
        let all: Vec<_> = all.filter(|&(k, smoothness, _)| is_laid(k, smoothness)).collect();
        let node = |&(_, smoothness, range_mm): &(usize, Smoothness, f64)| fields.node(smoothness, range_mm);
        fields.hypotheses = all.par_iter().filter_map(node).collect();
        // Each rough node represents two ranges, so its prior doubles.
        let rough = fields.hypotheses.iter_mut().filter(|node| node.smoothness == Smoothness::Exponential);
        rough.for_each(|node| node.prior.iter_mut().for_each(|of| *of += LN_2));
        Ok(fields)
    }

    /// Returns the ranges of the nodes, in mm, in ascending order. A node is one smoothness with one range. There are
    /// [`RANGES`] values in equal steps of their logarithm.
    ///
    /// The shortest range is the larger of two limits: [`MIN_RANGE_SPACINGS`] spacings of the points, and
    /// [`MIN_RANGE_HALF_WAVELENGTHS`] half wavelengths of the shortest cosine of the basis. The longest range is
    /// [`MAX_RANGE_SIZES`] times the size of the part (root mean square distance of the points from their centroid),
    /// but at least 1.5 times the shortest range.
    fn ranges_mm(&self) -> impl Iterator<Item = f64> + use<> {
        let min_mm = (MIN_RANGE_SPACINGS * spacing_mm(&self.places))
            .max(MIN_RANGE_HALF_WAVELENGTHS * self.basis.min_half_wavelength_mm());
        let max_mm = (MAX_RANGE_SIZES * size_mm(&self.places)).max(1.5 * min_mm);
        let ratio = (max_mm / min_mm).ln() / (RANGES - 1) as f64;
        (0..RANGES).map(move |k| min_mm * (ratio * k as f64).exp())
    }

    /// Prepares the data that all nodes (pairs of one smoothness and one range) share, and no node yet. These data are
    /// the basis functions at the points. They are whitened (the correlation of successive noise is removed), and their
    /// best fit by the fixed effects is subtracted.
    ///
    /// # Errors
    /// Returns the errors of [`Self::over`].
    fn without_nodes(observed: &Observations, kind: NoiseKind) -> Result<Self, ModelError> {
        observed.check()?;
        let places = observed.places.clone();
        let n = places.len();
        let count = ((COSINES_PER_POINT * n as f64) as usize)
            .clamp(MIN_COSINES, MAX_COSINES[usize::from(n > MAX_INDIVIDUAL_POINTS)]);
        let waves = Basis::over(&places, kind.anisotropy, count, if n > MAX_INDIVIDUAL_POINTS { DEGREE } else { 0 });
        let whitening = whitening(&observed.path, n, kind.autocorrelation);
        let effects = whitened(&whitening, &observed.fixed_effects);
        let factor = super::dense::checked_cholesky(effects.tr_mul(&effects))?;
        let log_whitened =
            whitening.iter().map(|[own, _]| own.ln()).sum::<f64>() - factor.l().diagonal().map(f64::ln).sum();
        let base = orthonormal_base(effects);
        let free = (n - base.ncols()) as f64;
        let reduced = Reduced { rows: Mat::new(), pivots: None };
        let mut fields = Self {
            kind,
            basis: waves,
            places,
            whitening,
            base,
            degrees_of_freedom: free,
            log_whitened,
            reduced,
            removed_by_fit: Mat::new(),
            hypotheses: Vec::new(),
        };
        (fields.reduced, fields.removed_by_fit) =
            if n <= MAX_INDIVIDUAL_POINTS { fields.individual_points() } else { fields.reduced_by_products() };
        Ok(fields)
    }

    /// Computes the whitened basis functions at the points, and subtracts their best fit by the fixed effects.
    /// Whitening removes the correlation of the noise of successive points.
    ///
    /// Returns two results. The first has one coordinate (row) for each point. The second is the product Q'W phi, with
    /// one row for each fixed effect and one column for each basis function. Here phi are the basis functions at the
    /// points, W is the whitening, and Q is an orthonormal base of the whitened fixed effects.
    fn individual_points(&self) -> (Reduced, Mat<f64>) {
        let mut rows = self.rows_of(0..self.places.len());
        let (n, p) = self.base.shape();
        let base = Mat::from_fn(n, p, |r, c| self.base[(r, c)]);
        let taken = base.transpose() * &rows;
        rows -= &base * &taken;
        (Reduced { rows, pivots: None }, taken)
    }

    /// Computes the whitened basis functions at the points, after their best fit by the fixed effects is subtracted.
    /// Whitening removes the correlation of the noise of successive points. The result has reduced coordinates: fewer
    /// rows than there are points.
    ///
    /// First the products of all pairs of basis functions are summed over the points. The part that the best fit
    /// removes is subtracted from these sums. A pivoted Cholesky factorization of the result then gives one coordinate
    /// after another, until the remaining variance is negligible.
    ///
    /// Returns the coordinates, and the product Q'W phi with one row for each fixed effect and one column for each
    /// basis function. Here phi are the basis functions at the points, W is the whitening, and Q is an orthonormal base
    /// of the whitened fixed effects.
    fn reduced_by_products(&self) -> (Reduced, Mat<f64>) {
        let (p, count) = (self.base.ncols(), self.basis.len());
        let of = |points: Range<usize>| {
            let base = Mat::from_fn(points.len(), p, |r, c| self.base[(points.start + r, c)]);
            let rows = self.rows_of(points);
            let mut products = Mat::zeros(count, count);
            lower_product(&mut products, &rows);
            [products, base.transpose() * &rows]
        };
        let [mut products, taken] = self.sum_over_blocks([(count, count), (p, count)], of);
        products -= taken.transpose() * &taken;
        (pivoted_cholesky(&products), taken)
    }

    /// Calls the function `of` for each block of points, in parallel, and adds up the matrices that `of` returns. The
    /// argument of `of` is the range of point indices of the block. Each call returns `N` matrices. `shapes` are the
    /// numbers of rows and columns of these matrices.
    ///
    /// Returns the `N` sums. The blocks are added in the order of the points. So the sums have the same bits on any
    /// number of threads.
    fn sum_over_blocks<const N: usize>(
        &self,
        shapes: [(usize, usize); N],
        of: impl Fn(Range<usize>) -> [Mat<f64>; N] + Sync,
    ) -> [Mat<f64>; N] {
        let n = self.places.len();
        let firsts: Vec<usize> = (0..n).step_by(ROWS).collect();
        let mut sums = shapes.map(|(rows, columns)| Mat::zeros(rows, columns));
        for some in firsts.chunks(BLOCKS_AT_ONCE) {
            let blocks: Vec<_> = some.par_iter().map(|&first| of(first..(first + ROWS).min(n))).collect();
            blocks.into_iter().for_each(|block| sums.iter_mut().zip(block).for_each(|(sum, block)| *sum += block));
        }
        sums
    }

    /// Evaluates the whitened basis functions at the points with the indices `points`. Returns one row for each point,
    /// one column for each basis function. Whitening makes the noise of successive points independent.
    fn rows_of(&self, points: Range<usize>) -> Mat<f64> {
        let first = points.start;
        let before = first.saturating_sub(1);
        let waves = self.basis.at(&self.places[before..points.end]);
        let mut rows = Mat::zeros(points.len(), self.basis.len());
        for c in 0..self.basis.len() {
            let (from, into) = (waves.col_as_slice(c), rows.col_as_slice_mut(c));
            for (r, value) in into.iter_mut().enumerate() {
                let [own, last] = self.whitening[first + r];
                let at = first + r - before;
                *value = own * from[at] - if last == 0.0 { 0.0 } else { last * from[at - 1] };
            }
        }
        rows
    }

    /// Converts columns of point values, such as deviations, to reduced coordinates. `columns` has one row for each
    /// point. There is one reduced coordinate for each point if the points are few. Otherwise there are fewer
    /// coordinates than points, but enough to distinguish the basis functions ([`Reduced`]).
    ///
    /// The columns are first whitened, which removes the correlation of the noise of successive points. Then their best
    /// fit by the fixed effects is subtracted.
    ///
    /// Returns two results. The first has one row for each reduced coordinate and one column for each column of
    /// `columns`. The second has the products of all pairs of the columns, summed over the points, after the
    /// subtraction.
    pub(super) fn coordinates(&self, columns: &DMatrix<f64>) -> (Mat<f64>, DMatrix<f64>) {
        let mut columns = whitened(&self.whitening, columns);
        let taken = &self.base * self.base.tr_mul(&columns);
        columns -= taken;
        let products = columns.tr_mul(&columns);
        let (n, count) = columns.shape();
        let Some(pivots) = &self.reduced.pivots else {
            return (Mat::from_fn(n, count, |r, c| columns[(r, c)]), products);
        };
        let of = |points: Range<usize>| {
            let columns = Mat::from_fn(points.len(), count, |r, c| columns[(points.start + r, c)]);
            [self.rows_of(points).transpose() * columns]
        };
        let [by_waves] = self.sum_over_blocks([(self.basis.len(), count)], of);
        let mut coordinates = Mat::from_fn(pivots.len(), count, |r, c| by_waves[(pivots[r], c)]);
        let factor = Mat::from_fn(pivots.len(), pivots.len(), |r, c| self.reduced.rows[(c, pivots[r])]);
        solve_lower_triangular_in_place(factor.as_ref(), coordinates.as_mut(), Par::Seq);
        (coordinates, products)
    }

    /// Prepares one node: a field with the given smoothness, and with the range `range_mm` in mm. Returns `None` if
    /// nothing of this field remains at the points after the best fit of the fixed effects.
    fn node(&self, smoothness: Smoothness, range_mm: f64) -> Option<FieldHypothesis> {
        let (mut strengths, narrow) = self.basis.standard_deviations(smoothness, range_mm);
        let least = MIN_SIGMA_SHARE * strengths.iter().copied().fold(0.0, f64::max);
        let last = strengths.iter().rposition(|strength| *strength > least);
        strengths.truncate(last.map_or(0, |last| last + 1));
        let rows = self.scaled_rows(&strengths);
        let by_waves = rows.ncols() < rows.nrows();
        let size = rows.ncols().min(rows.nrows());
        let mut products = Mat::zeros(size, size);
        match by_waves {
            true => lower_product(&mut products, &rows),
            false => lower_product(&mut products, &rows.transpose().to_owned()),
        }
        let products = TridiagonalForm::reduce(products);
        let n = self.places.len() as f64;
        let whole = products.trace() + narrow * self.degrees_of_freedom;
        let scale = n / whole;
        let mut node = FieldHypothesis {
            smoothness,
            range_mm,
            standard_deviations: strengths,
            truncated_variance: narrow,
            scale,
            products,
            by_waves,
            components: OnceLock::new(),
            prior: Vec::new(),
        };
        if !(whole.is_finite() && whole > 0.0) {
            return None;
        }
        node.prior = node.log_prior(self.degrees_of_freedom);
        Some(node)
    }

    /// Returns the rows C of a node: the basis functions in the reduced coordinates, each times its standard deviation
    /// in `strengths`.
    fn scaled_rows(&self, strengths: &[f64]) -> Mat<f64> {
        Mat::from_fn(self.reduced.rows.nrows(), strengths.len(), |k, wave| {
            self.reduced.rows[(k, wave)] * strengths[wave]
        })
    }

    /// Projects the columns `coordinates` on the tridiagonal form of `node`. `products` has the products of all pairs of
    /// these columns. Both are those of [`Self::coordinates`].
    pub(super) fn projected(
        &self,
        node: &FieldHypothesis,
        coordinates: &Mat<f64>,
        products: &DMatrix<f64>,
    ) -> Projected {
        if node.by_waves {
            let by_waves = self.scaled_rows(&node.standard_deviations).transpose() * coordinates;
            return Projected { rotated: node.products.rotate(&by_waves), rest: products.clone() };
        }
        let seen = coordinates.transpose() * coordinates;
        let rest = DMatrix::from_fn(products.nrows(), products.ncols(), |a, b| products[(a, b)] - seen[(a, b)]);
        Projected { rotated: node.products.rotate(coordinates), rest }
    }

    /// Returns the principal components of the field of `node`. They are computed when they are first asked for.
    /// Returns `None` if the eigenproblem has no solution.
    pub(super) fn components<'n>(&self, node: &'n FieldHypothesis) -> Option<&'n Components> {
        node.components.get_or_init(|| self.solve_eigenproblem(node)).as_ref()
    }

    fn solve_eigenproblem(&self, node: &FieldHypothesis) -> Option<Components> {
        let Eigenpairs { values: all, vectors: found } = node.products.eigenpairs()?;
        let top = all.iter().copied().fold(0.0, f64::max);
        let values: Vec<f64> = all.iter().copied().filter(|l| *l > 1e-7 * top && *l > 0.0).collect();
        let found = found.subcols(all.len() - values.len(), values.len());
        let vectors = match node.by_waves {
            true => {
                let mut vectors = self.scaled_rows(&node.standard_deviations) * found;
                for (k, value) in values.iter().enumerate() {
                    let by = value.sqrt().recip();
                    vectors.col_as_slice_mut(k).iter_mut().for_each(|v| *v *= by);
                }
                vectors
            }
            false => found.to_owned(),
        };
        Some(Components { eigenvalues: values, eigenvectors: vectors })
    }

    /// Returns the posterior mean of the coefficients of the basis functions at the variance ratio `tau`: D C'K^-1 z.
    /// Here z is the sum of the columns of `projected`, each times its element of `weights`, and K is the covariance of
    /// field and noise in units of the variance of the field. The result has one value for each basis function of
    /// `node`.
    pub(super) fn mean_coefficients(
        &self,
        (node, tau): (&FieldHypothesis, f64),
        projected: &Projected,
        weights: &[f64],
    ) -> Vec<f64> {
        let NodeCovariance { field, factor, .. } = node.covariance(tau);
        let column: Vec<f64> = (0..projected.rotated.nrows())
            .map(|k| weights.iter().enumerate().map(|(c, weight)| weight * projected.rotated[(k, c)]).sum())
            .collect();
        let solved = factor.solve(&column);
        let solved = node.products.rotate_back(&Mat::from_fn(solved.len(), 1, |k, _| field * solved[k]));
        let mut coefficients = match node.by_waves {
            true => solved,
            false => self.coefficients_from(node, &solved),
        };
        let column = coefficients.col_as_slice_mut(0);
        column.iter_mut().zip(&node.standard_deviations).for_each(|(value, d)| *value *= d);
        column.to_vec()
    }

    /// Maps values in reduced coordinates to coefficients of the basis functions. There is one reduced coordinate for
    /// each point if the points are few. Otherwise there are fewer coordinates than points, but enough to distinguish
    /// the basis functions ([`Reduced`]).
    ///
    /// Returns D C' times `coordinates`. C has the basis functions in the reduced coordinates ([`Reduced::rows`]). D is
    /// the diagonal matrix of the standard deviations of the coefficients in `node`.
    ///
    /// `coordinates` has one row for each reduced coordinate. The result has one row for each basis function of `node`,
    /// and one column for each column of `coordinates`.
    pub(super) fn coefficients_from(&self, node: &FieldHypothesis, coordinates: &Mat<f64>) -> Mat<f64> {
        let c = node.standard_deviations.len();
        let mut coefficients = self.reduced.rows.subcols(0, c).transpose() * coordinates;
        for k in 0..coefficients.ncols() {
            coefficients
                .col_as_slice_mut(k)
                .iter_mut()
                .zip(&node.standard_deviations)
                .for_each(|(value, d)| *value *= d);
        }
        coefficients
    }

    /// Maps coefficients of the basis functions to values in reduced coordinates. There is one reduced coordinate for
    /// each point if the points are few. Otherwise there are fewer coordinates than points, but enough to distinguish
    /// the basis functions ([`Reduced`]).
    ///
    /// Returns C D times `coefficients`. C has the basis functions in the reduced coordinates ([`Reduced::rows`]). D is
    /// the diagonal matrix of the standard deviations of the coefficients in `node`.
    ///
    /// `coefficients` has one row for each basis function of `node`. Each coefficient is in units of its standard
    /// deviation. The result has one row for each reduced coordinate, and one column for each column of `coefficients`.
    pub(super) fn coordinates_from(&self, node: &FieldHypothesis, coefficients: &Mat<f64>) -> Mat<f64> {
        let c = node.standard_deviations.len();
        let strong = Mat::from_fn(c, coefficients.ncols(), |r, k| node.standard_deviations[r] * coefficients[(r, k)]);
        self.reduced.rows.subcols(0, c) * &strong
    }

    /// Returns the number of fixed effects.
    pub(super) fn effects(&self) -> usize {
        self.base.ncols()
    }

    /// Projects columns of point values onto the space of the fixed effects. `columns` has one row for each point.
    /// Returns Q'W times `columns`, with one row for each fixed effect. W is the whitening, which removes the
    /// correlation of the noise of successive points. Q is an orthonormal base of the whitened fixed effects.
    pub(super) fn project_onto_effects(&self, columns: &DMatrix<f64>) -> DMatrix<f64> {
        self.base.tr_mul(&whitened(&self.whitening, columns))
    }

    /// Returns the matrix that maps coefficients of the basis functions to whitened observations. Whitening removes the
    /// correlation of the noise of successive points. Each coefficient is in units of its standard deviation in `node`.
    /// The matrix has one column for each basis function of `node`.
    ///
    /// The first rows are C D, one for each reduced coordinate. C has the basis functions in the reduced coordinates,
    /// after their best fit by the fixed effects is subtracted ([`Reduced::rows`]). D is the diagonal matrix of the
    /// standard deviations of the coefficients.
    ///
    /// Then follow the rows Q'W phi D, one for each fixed effect. They have the part of the basis functions that the
    /// best fit removes. Here phi are the basis functions at the points, W is the whitening, and Q is an orthonormal
    /// base of the whitened fixed effects.
    pub(super) fn with_effects(&self, node: &FieldHypothesis) -> Mat<f64> {
        let (r, p) = (self.reduced.rows.nrows(), self.removed_by_fit.nrows());
        Mat::from_fn(r + p, node.standard_deviations.len(), |k, wave| {
            let of = if k < r { self.reduced.rows[(k, wave)] } else { self.removed_by_fit[(k - r, wave)] };
            of * node.standard_deviations[wave]
        })
    }

    /// Returns the weighted sums of the basis functions over the points: one row for each column of `weights`, one
    /// column for each basis function. `weights` has one row for each point.
    pub(super) fn sums(&self, weights: &DMatrix<f64>) -> DMatrix<f64> {
        let of = |points: Range<usize>| {
            let weights = Mat::from_fn(weights.ncols(), points.len(), |r, c| weights[(points.start + c, r)]);
            [weights * self.basis.at(&self.places[points])]
        };
        let [sums] = self.sum_over_blocks([(weights.ncols(), self.basis.len())], of);
        DMatrix::from_fn(sums.nrows(), sums.ncols(), |r, c| sums[(r, c)])
    }

    /// Evaluates the field with the given coefficients of the basis functions at every point. Returns one value in mm
    /// for each point.
    pub(super) fn evaluate_at_points(&self, coefficients: &[f64]) -> Vec<f64> {
        let column = Mat::from_fn(coefficients.len(), 1, |r, _| coefficients[r]);
        let of = |places: &[[f64; 2]]| (self.basis.at(places) * &column).col_as_slice(0).to_vec();
        self.places.par_chunks(ROWS).flat_map_iter(of).collect()
    }
}

impl FieldHypothesis {
    /// Returns the covariance of field and noise at the variance ratio `tau` of field to noise.
    pub(super) fn covariance(&self, tau: f64) -> NodeCovariance {
        let noise = 1.0 + self.scale * self.truncated_variance * tau;
        let field = self.scale * tau;
        NodeCovariance { noise, field, factor: self.products.shifted(noise, field) }
    }

    /// Returns the logarithm of the prior probability of each variance ratio tau, up to a constant. tau is the variance
    /// of the field divided by the variance of the noise. The order is that of [`variance_ratios`]. `free` is n - p,
    /// the number of points minus the number of fixed effects.
    ///
    /// The prior is J / (1 + J), where J^2 is the Fisher information on ln tau (a bounded Jeffreys prior). Let l = scale
    /// (eigenvalue + truncated variance) and q = l tau / (1 + l tau). Then J^2 = (sum q^2 - (sum q)^2 / (n - p)) / 2.
    /// The sums have n - p terms. Terms beyond the size of the products have the eigenvalue 0. The others follow from
    /// the traces of the inverse of the covariance, because q = 1 - 1 / (1 + l tau). A field that cannot be
    /// distinguished from noise has little prior probability.
    fn log_prior(&self, free: f64) -> Vec<f64> {
        let size = self.products.size() as f64;
        let of = |tau: f64| {
            let NodeCovariance { noise, factor, .. } = self.covariance(tau);
            let [inverse, inverse2] = factor.inverse_traces();
            let alike = 1.0 - noise.recip();
            let sum = (free - size) * alike + size - inverse;
            let squares = (free - size) * alike * alike + size - 2.0 * inverse + inverse2;
            let told = (0.5 * (squares - sum * sum / free)).max(0.0).sqrt();
            (told / (1.0 + told)).max(f64::MIN_POSITIVE).ln()
        };
        variance_ratios().map(of).collect()
    }
}

impl NodeCovariance {
    /// Returns the logarithm of the determinant of the covariance K0 with `free` degrees of freedom.
    pub(super) fn log_determinant(&self, free: f64) -> f64 {
        (free - self.factor.size() as f64) * self.noise.ln() + self.factor.log_determinant()
    }

    /// Returns the products a'K0^-1 b of all pairs of the columns that were projected on the node.
    pub(super) fn products(&self, node: &FieldHypothesis, columns: &Projected) -> DMatrix<f64> {
        // C'C: (noise I + field C C')^-1 = (I - field C (noise I + field C'C)^-1 C') / noise
        let weight = if node.by_waves { -self.field / self.noise } else { 1.0 };
        &columns.rest / self.noise + self.factor.products(&columns.rotated) * weight
    }
}

/// Adds the product R'R to the lower triangle of `products`, where R is the matrix `rows` and R' is its transpose.
fn lower_product(products: &mut Mat<f64>, rows: &Mat<f64>) {
    triangular::matmul(
        products.as_mut(),
        BlockStructure::TriangularLower,
        Accum::Add,
        rows.transpose(),
        BlockStructure::Rectangular,
        rows.as_ref(),
        BlockStructure::Rectangular,
        1.0,
        Par::Seq,
    );
}

/// Computes the pivoted Cholesky factor of the symmetric matrix `products`. Only the lower triangle of `products` is
/// read. The factorization ends when the next pivot would be at most [`MIN_PIVOT_SHARE`] of the largest diagonal
/// element. Returns the columns of the factor as rows of [`Reduced`], and the indices of the pivots in their order.
fn pivoted_cholesky(products: &Mat<f64>) -> Reduced {
    let count = products.nrows();
    let at = |a: usize, b: usize| if a >= b { products[(a, b)] } else { products[(b, a)] };
    let mut left: Vec<f64> = (0..count).map(|k| products[(k, k)]).collect();
    let most = left.iter().copied().fold(0.0, f64::max);
    let mut pivots = Vec::new();
    // The columns of the factor are the rows of the coordinates.
    let mut rows: Vec<Vec<f64>> = Vec::new();
    while pivots.len() < count {
        let pivot = (0..count).fold(0, |best, k| if left[k] > left[best] { k } else { best });
        if left[pivot] <= MIN_PIVOT_SHARE * most {
            break;
        }
        let mut row: Vec<f64> = (0..count).map(|k| at(k, pivot)).collect();
        for before in &rows {
            let by = before[pivot];
            row.iter_mut().zip(before).for_each(|(value, of)| *value -= by * of);
        }
        let root = left[pivot].sqrt();
        row.iter_mut().for_each(|value| *value /= root);
        pivots.iter().for_each(|&before: &usize| row[before] = 0.0);
        row[pivot] = root;
        left.iter_mut().zip(&row).for_each(|(left, value)| *left -= value * value);
        left[pivot] = 0.0;
        pivots.push(pivot);
        rows.push(row);
    }
    Reduced { rows: Mat::from_fn(rows.len(), count, |r, c| rows[r][c]), pivots: Some(pivots) }
}

/// Returns the whitening coefficients, which make autocorrelated noise independent and keep its variance. There are two
/// coefficients for each point: the factor of the row of this point, and the factor of the row of the point before. The
/// second product is subtracted from the first.
///
/// `path` is the position of each point in steps of the path; `path` is empty if the points do not follow a path.
/// `points` is the number of points. `drift` is the autocorrelation of the noise over one step, from 0 to below 1. With
/// an empty `path` or `drift` = 0, the two coefficients are 1 and 0.
fn whitening(path: &[f64], points: usize, drift: f64) -> Vec<[f64; 2]> {
    if drift == 0.0 || path.is_empty() {
        return vec![[1.0, 0.0]; points];
    }
    let of = |k: usize| {
        let shared = if k == 0 { 0.0 } else { drift.powf((path[k] - path[k - 1]).abs()) };
        let own = (1.0 - shared * shared).sqrt().recip();
        [own, own * shared]
    };
    (0..points).map(of).collect()
}

/// Whitens `columns` with the coefficients that [`whitening`] returns, so that the noise of successive points becomes
/// independent. `columns` has one row for each point. Each row is multiplied by its first coefficient, and the row
/// before times the second coefficient is subtracted. Returns a matrix of the same shape.
fn whitened(whitening: &[[f64; 2]], columns: &DMatrix<f64>) -> DMatrix<f64> {
    DMatrix::from_fn(columns.nrows(), columns.ncols(), |r, c| {
        let [own, last] = whitening[r];
        own * columns[(r, c)] - if last == 0.0 { 0.0 } else { last * columns[(r - 1, c)] }
    })
}

/// Returns the root mean square distance of the places from their centroid, in mm.
pub(super) fn size_mm(places: &[[f64; 2]]) -> f64 {
    let n = places.len() as f64;
    let middle = [0, 1].map(|axis| places.iter().map(|place| place[axis]).sum::<f64>() / n);
    let squares = places.iter().map(|[x, y]| (x - middle[0]).powi(2) + (y - middle[1]).powi(2));
    (squares.sum::<f64>() / n).sqrt()
}
