//! Smoothing surface fitted to scattered readings: tensor-product cubic B-splines with a penalty on bending.
//!
//! The coefficients c minimise |d - B c|^2 + mu c^T P c, where c^T P c is the integral of f_xx^2 + 2 f_xy^2 + f_yy^2
//! over the grid: the bending of a thin plate, computed exactly for the splines. So A c = B^T d with A = B^T B + mu
//! P. A is sparse (7 x 7 neighbours), and sparse Cholesky solves the system. Planes have no penalty and pass.
//!
//! **Cut-off.** With rho readings per square millimetre a wave of wave number k passes by 1 / (1 + mu k^4 / rho), in
//! any direction. So mu = rho (cutoff / 2 pi)^4 passes half of it at the cut-off, as the spline filters of
//! ISO 16610-22 and -62 do. The transmission falls with the fourth power, less sharply than that of the Gaussian.
//! Alternatively generalised cross-validation chooses mu, for cut-offs between the requested one and the size of the
//! part.
//!
//! **Uncertainty.** Noise sigma of the readings gives c the covariance sigma^2 S, S = A^-1 B^T B A^-1. So a value
//! b^T c has the standard uncertainty sigma sqrt(b^T S b), its variation over repeated measurements. Only entries of S
//! between neighbours are needed. With Z = A^-1, dZ / d ln mu = -mu Z P Z, and so S = Z + dZ / d ln mu: the selected
//! inverses of A at a slightly smaller and a slightly larger mu give Z and the derivative.
//! sigma^2 = |d - B c|^2 / (n - 2 tr H + tr H^2), H = B A^-1 B^T.
//!
//! **Cost.** n readings take 152 n sums to assemble. N coefficients take about N^1.5 to factor, three times, and
//! twice as much for each of the two selected inverses.

use std::f64::consts::TAU;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::filter::Trend;
use super::inliers::InlierReadings;
use crate::geometry::Grid;
use crate::sparse::{SelectedInverse, SparsityPattern};

/// Number of knots per cut-off: with five the splines alone pass waves at the cut-off to 0.2 %.
const KNOTS: f64 = 5.0;
/// Maximum number of coefficients; a factor of a matrix of this size takes some 2 GB.
const MAX_COEFFICIENTS: f64 = 2e5;
/// Step of ln mu for the derivative of the inverse.
const STEP: f64 = 0.02;
/// Share of the largest diagonal entry that is added to all diagonal entries. Far outside the readings nothing else
/// determines the surface.
const RIDGE: f64 = 1e-13;

/// Choice of the smoothness of a spline.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum SplineSmoothness {
    /// Half of the amplitude of a wave at the cut-off passes.
    #[default]
    Cutoff,
    /// Generalised cross-validation, no rougher than by the cut-off: the smoothness that predicts withheld readings
    /// best.
    CrossValidation,
}

/// Reason why no smoothing surface can be fitted.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum SplineError {
    #[error(
        "a spline with a cut-off of {cutoff_mm} mm over {width_mm:.1} x {depth_mm:.1} mm requires {coefficients:.0} \
         coefficients, more than {MAX_COEFFICIENTS:.0}; choose a longer cut-off, or the Gaussian filter"
    )]
    TooFine { cutoff_mm: f64, width_mm: f64, depth_mm: f64, coefficients: f64 },
    #[error("the {points} points do not determine a surface; they must not lie on one line")]
    NotDetermined { points: usize },
}

/// Smoothing surface at the nodes of a grid.
#[derive(Clone, Debug)]
pub(super) struct SplineResult {
    pub values: Vec<f64>,
    pub slopes: Vec<[f64; 2]>,
    /// Standard uncertainty at every node.
    pub sigma: Vec<f64>,
    /// Standard deviation of one reading.
    pub point_sigma: f64,
    /// Effective cut-off of the chosen smoothness, in millimetres.
    #[allow(dead_code, reason = "told by tests")]
    pub cutoff_mm: f64,
}

/// Fits a smoothing surface (cubic B-splines with a penalty on bending) to the readings `kept` and returns it at the
/// nodes of `grid`.
///
/// `density` is the number of readings per square millimetre. `cutoff_mm` is the wavelength at which half of the
/// amplitude passes; `roughness` selects if this cut-off or cross-validation sets the smoothness.
///
/// # Errors
/// Returns [`SplineError::TooFine`] if the cut-off needs too many coefficients, and [`SplineError::NotDetermined`] if
/// the readings do not determine a surface.
pub(super) fn fit_spline(
    kept: &InlierReadings,
    grid: &Grid,
    density: f64,
    cutoff_mm: f64,
    roughness: SplineSmoothness,
) -> Result<SplineResult, SplineError> {
    let points = kept.values.len();
    let undetermined = || SplineError::NotDetermined { points };
    let axes = spline_axes(grid, cutoff_mm)?;
    let trend = Trend::fit(&kept.places, &kept.values, 1);
    let rest: Vec<f64> = kept.places.iter().zip(&kept.values).map(|(p, v)| v - trend.at(*p)).collect();
    let system = NormalEquations::new(axes, &kept.places, &rest).ok_or_else(undetermined)?;
    let mu_of = |cutoff_mm: f64| density * (cutoff_mm / TAU).powi(4);
    let size_mm = (0..2).map(|k| system.axes[k].length()).fold(cutoff_mm, f64::max);
    let mu = match roughness {
        SplineSmoothness::Cutoff => mu_of(cutoff_mm),
        SplineSmoothness::CrossValidation => {
            system.cross_validated(mu_of(cutoff_mm), mu_of(size_mm)).ok_or_else(undetermined)?
        }
    };
    let mut fitted = system.fitted(grid, mu).ok_or_else(undetermined)?;
    fitted.cutoff_mm = TAU * (mu / density).sqrt().sqrt();
    trend.put_back(grid, |_| true, &mut fitted.values, &mut fitted.slopes);
    Ok(fitted)
}

fn spline_axes(grid: &Grid, cutoff_mm: f64) -> Result<[SplineAxis; 2], SplineError> {
    let length = |k: usize| grid.counts()[k].saturating_sub(1).max(1) as f64 * grid.spacing_mm[k];
    let cells = |k: usize| (KNOTS * length(k) / cutoff_mm).ceil().max(4.0);
    let coefficients = (cells(0) + 3.0) * (cells(1) + 3.0);
    if coefficients > MAX_COEFFICIENTS {
        let [width_mm, depth_mm] = [length(0), length(1)];
        return Err(SplineError::TooFine { cutoff_mm, width_mm, depth_mm, coefficients });
    }
    Ok([0, 1].map(|k| SplineAxis { first: grid.first_mm[k], step: length(k) / cells(k), cells: cells(k) as usize }))
}

/// Uniform cubic B-splines along one axis.
#[derive(Clone, Copy, Debug)]
struct SplineAxis {
    first: f64,
    step: f64,
    cells: usize,
}

/// Evaluates the four uniform cubic B-splines that are not 0 in a grid cell, at the position `u` in the cell, from 0 to
/// 1. `derivative` is 0 for the values, and 1 or 2 for the first or second derivative with respect to `u`.
fn basis(derivative: usize, u: f64) -> [f64; 4] {
    let v = 1.0 - u;
    match derivative {
        0 => [
            v * v * v / 6.0,
            (3.0 * u * u * u - 6.0 * u * u + 4.0) / 6.0,
            (3.0 * v * v * v - 6.0 * v * v + 4.0) / 6.0,
            u * u * u / 6.0,
        ],
        1 => [-0.5 * v * v, 1.5 * u * u - 2.0 * u, 2.0 * v - 1.5 * v * v, 0.5 * u * u],
        _ => [v, 3.0 * u - 2.0, 3.0 * v - 2.0, u],
    }
}

impl SplineAxis {
    fn count(&self) -> usize {
        self.cells + 3
    }

    fn length(&self) -> f64 {
        self.cells as f64 * self.step
    }

    /// Finds the cell of this axis that contains the coordinate `at`, in mm. Returns the index of the cell and the
    /// position in the cell, from 0 to 1. The index is also that of the first of the four splines that are not 0 in the
    /// cell. For a coordinate outside the axis, the nearest end of the axis is used.
    fn cell(&self, at: f64) -> (usize, f64) {
        let u = ((at - self.first) / self.step).clamp(0.0, self.cells as f64);
        let cell = (u as usize).min(self.cells - 1);
        (cell, u - cell as f64)
    }

    /// Integrates products of B-splines along the axis. For each spline, returns four integrals: of its product with
    /// itself, and with each of the next three splines. `derivative` is 0 for the splines themselves, and 1 or 2 for
    /// their first or second derivatives.
    fn products(&self, derivative: usize) -> Vec<[f64; 4]> {
        // Gauss-Legendre with four points is exact up to the seventh degree; here the degree is at most six.
        const GAUSS: [(f64, f64); 4] = [
            (-0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
            (-0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
            (0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
            (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
        ];
        let scale = self.step.powi(1 - 2 * derivative as i32);
        let mut products = vec![[0.0; 4]; self.count()];
        for (node, weight) in GAUSS {
            let b = basis(derivative, 0.5 * (node + 1.0));
            for cell in 0..self.cells {
                for first in 0..4 {
                    for second in first..4 {
                        products[cell + first][second - first] += 0.5 * weight * scale * b[first] * b[second];
                    }
                }
            }
        }
        products
    }
}

/// Number of entries of a coefficient: with itself and 24 later neighbours.
const LATER: usize = 25;

/// Returns the storage index (0 to 24) of the matrix entry that couples a spline coefficient with itself or with one of
/// its later neighbours. The coefficients form a grid. A later neighbour is in the same row, up to 3 columns to the
/// right, or in one of the next 3 rows, up to 3 columns to either side.
///
/// `di` is the number of columns and `dj` the number of rows from the coefficient to the neighbour. The function
/// [`offset`] is the inverse.
fn later(di: isize, dj: isize) -> usize {
    if dj == 0 { di as usize } else { (4 + (dj - 1) * 7 + di + 3) as usize }
}

/// Normal equations, with the bending separate and not yet weighted.
struct NormalEquations<'a> {
    axes: [SplineAxis; 2],
    places: &'a [[f64; 2]],
    values: &'a [f64],
    /// B^T B, [`LATER`] entries to a coefficient.
    normal: Vec<f64>,
    /// Bending P, in the same layout.
    bending: Vec<f64>,
    right: Vec<f64>,
    /// Coefficients and their existing later neighbours, in the order of the pattern.
    entries: Vec<(u32, u8)>,
    pattern: SparsityPattern,
}

impl<'a> NormalEquations<'a> {
    fn new(axes: [SplineAxis; 2], places: &'a [[f64; 2]], values: &'a [f64]) -> Option<Self> {
        let [nx, ny] = [axes[0].count(), axes[1].count()];
        let (entries, begins, rows) = neighbours(nx, ny);
        let pattern = SparsityPattern::new(nx * ny, begins, rows)?;
        let mut system = Self {
            axes,
            places,
            values,
            normal: vec![0.0; nx * ny * LATER],
            bending: bending(&axes),
            right: vec![0.0; nx * ny],
            entries,
            pattern,
        };
        for (place, value) in places.iter().zip(values) {
            system.add_reading(*place, *value);
        }
        Some(system)
    }

    fn add_reading(&mut self, place: [f64; 2], value: f64) {
        let local = LocalSplines::new(&self.axes, place);
        for a in 0..16 {
            let from = &mut self.normal[local.index(a) * LATER..][..LATER];
            let (ia, ja) = ((a % 4) as isize, (a / 4) as isize);
            for b in a..16 {
                from[later((b % 4) as isize - ia, (b / 4) as isize - ja)] += local.shares[a] * local.shares[b];
            }
            self.right[local.index(a)] += local.shares[a] * value;
        }
    }

    /// Returns the non-zero entries of the matrix A = B^T B + `mu` P, in the order of the sparsity pattern. B holds the
    /// values of the splines at the readings, P is the matrix of the bending energy, and `mu` is the weight of the
    /// bending energy. A tiny constant is added to the diagonal, so that A is positive definite.
    fn matrix(&self, mu: f64) -> Vec<f64> {
        let at = |&(c, s): &(u32, u8)| c as usize * LATER + s as usize;
        let largest =
            (0..self.right.len()).map(|c| self.normal[c * LATER] + mu * self.bending[c * LATER]).fold(0.0, f64::max);
        let ridge = |&(_, s): &(u32, u8)| if s == 0 { RIDGE * largest } else { 0.0 };
        self.entries.iter().map(|e| self.normal[at(e)] + mu * self.bending[at(e)] + ridge(e)).collect()
    }

    /// Copies the entries of the matrix `inverse` into the storage layout of `self.normal`, and returns them. This
    /// layout has [`LATER`] entries for each spline coefficient: one for the coefficient itself, and one for each later
    /// neighbour. A later neighbour is a coefficient up to 3 columns and 3 rows away that follows in the order row by
    /// row. The entry is 0 if the neighbour does not exist.
    fn spread(&self, inverse: &SelectedInverse) -> Vec<f64> {
        let nx = self.axes[0].count();
        let mut spread = vec![0.0; self.right.len() * LATER];
        for &(c, s) in &self.entries {
            let [di, dj] = offset(s as usize);
            let other = (c as isize + dj * nx as isize + di) as usize;
            spread[c as usize * LATER + s as usize] = inverse.entry(c as usize, other);
        }
        spread
    }

    fn inverse(&self, mu: f64) -> Option<Vec<f64>> {
        Some(self.spread(&self.pattern.factor(&self.matrix(mu))?.selected_inverse()?))
    }

    fn solve(&self, mu: f64) -> Option<Vec<f64>> {
        self.pattern.factor(&self.matrix(mu))?.solve(&self.right)
    }

    /// Returns the trace of the product of the two symmetric matrices `a` and `b`. The trace is the sum of the products
    /// of corresponding entries; an entry off the diagonal counts twice. Each matrix is stored with [`LATER`] entries
    /// for each spline coefficient.
    fn trace(&self, a: &[f64], b: &[f64]) -> f64 {
        let twice = |k: usize| if k.is_multiple_of(LATER) { 1.0 } else { 2.0 };
        a.iter().zip(b).enumerate().map(|(k, (a, b))| twice(k) * a * b).sum()
    }

    fn squares(&self, coefficients: &[f64]) -> f64 {
        let left = |(p, v): (&[f64; 2], &f64)| (v - LocalSplines::new(&self.axes, *p).sum(coefficients)).powi(2);
        self.places.iter().zip(self.values).map(left).sum()
    }

    fn fitted(&self, grid: &Grid, mu: f64) -> Option<SplineResult> {
        let coefficients = self.solve(mu)?;
        let (below, above) = rayon::join(|| self.inverse(mu * (-STEP).exp()), || self.inverse(mu * STEP.exp()));
        let (below, above) = (below?, above?);
        let pair = |f: fn(f64, f64) -> f64| below.iter().zip(&above).map(|(b, a)| f(*b, *a)).collect::<Vec<f64>>();
        let inverse = pair(|b, a| 0.5 * (a + b));
        let sandwich = pair(|b, a| 0.5 * (a + b) + (a - b) / (2.0 * STEP));
        let freedom =
            self.values.len() as f64 - 2.0 * self.trace(&inverse, &self.normal) + self.trace(&sandwich, &self.normal);
        let point_sigma = (self.squares(&coefficients) / freedom.max(1.0)).sqrt();
        let nodes: Vec<[f64; 4]> = (0..grid.len())
            .into_par_iter()
            .with_min_len(256)
            .map(|k| {
                let local = LocalSplines::new(&self.axes, grid.place_mm(k));
                let [p, q] = local.slopes(&self.axes, &coefficients);
                [local.sum(&coefficients), p, q, point_sigma * local.quadratic_form(&sandwich).max(0.0).sqrt()]
            })
            .collect();
        let finite = nodes.iter().flatten().all(|v| v.is_finite());
        finite.then(|| SplineResult {
            values: nodes.iter().map(|n| n[0]).collect(),
            slopes: nodes.iter().map(|n| [n[1], n[2]]).collect(),
            sigma: nodes.iter().map(|n| n[3]).collect(),
            point_sigma,
            cutoff_mm: 0.0,
        })
    }

    /// Chooses the weight mu of the bending energy between `least` and `most` by generalised cross-validation. Returns
    /// the weight that minimises n |d - B c|^2 / (n - tr H)^2. Returns `None` if a matrix cannot be factored.
    ///
    /// Symbols: n is the number of readings and d their values. B holds the values of the splines at the readings. c
    /// are the spline coefficients fitted with mu. H is the matrix that maps d to the fitted values B c.
    ///
    /// First tries nine weights with equal steps in ln mu. Then a golden-section search continues between the
    /// neighbours of the best weight.
    fn cross_validated(&self, least: f64, most: f64) -> Option<f64> {
        const TRIED: usize = 9;
        let count = self.values.len() as f64;
        let score = |ln_mu: f64| {
            let mu = ln_mu.exp();
            let squares = self.squares(&self.solve(mu)?);
            let freedom = count - self.trace(&self.inverse(mu)?, &self.normal);
            Some(count * squares / freedom.max(1e-3 * count).powi(2))
        };
        let at = |k: usize| least.ln() + (most / least).ln() * k as f64 / (TRIED - 1) as f64;
        let scores: Vec<f64> = (0..TRIED).into_par_iter().map(|k| score(at(k))).collect::<Option<_>>()?;
        let best = (0..TRIED).min_by(|a, b| scores[*a].total_cmp(&scores[*b]))?;
        let (mut low, mut high) = (at(best.saturating_sub(1)), at((best + 1).min(TRIED - 1)));
        const GOLDEN: f64 = 0.618_033_988_749_894_9;
        for _ in 0..6 {
            let (a, b) = (high - GOLDEN * (high - low), low + GOLDEN * (high - low));
            let (at_a, at_b) = rayon::join(|| score(a), || score(b));
            if at_a? < at_b? { high = b } else { low = a }
        }
        Some((0.5 * (low + high)).exp())
    }
}

/// Returns the offset `[columns, rows]` from a spline coefficient to one of its later neighbours. A later neighbour is
/// a coefficient up to 3 columns and 3 rows away that follows in the order row by row. `s` is the storage index (0 to
/// 24) of the matrix entry that couples these two coefficients; for 0 the offset is `[0, 0]`. The function [`later`] is
/// the inverse.
fn offset(s: usize) -> [isize; 2] {
    if s < 4 { [s as isize, 0] } else { [((s - 4) % 7) as isize - 3, ((s - 4) / 7) as isize + 1] }
}

/// Returns the sparsity pattern of the matrix for a grid of `nx` x `ny` spline coefficients, as three lists. A matrix
/// entry couples a coefficient with itself or with a later neighbour. A later neighbour is a coefficient up to 3
/// columns and 3 rows away that follows in the order row by row. Neighbours outside the grid are omitted.
///
/// - The first list holds, for each matrix entry, the index of the coefficient and the storage index (0 to 24) of the
///   neighbour.
/// - The second list holds the position of the first entry of each matrix column, and the total number of entries at
///   the end.
/// - The third list holds the matrix row of each entry.
fn neighbours(nx: usize, ny: usize) -> (Vec<(u32, u8)>, Vec<usize>, Vec<usize>) {
    let (mut entries, mut begins, mut rows) = (Vec::new(), vec![0], Vec::new());
    for c in 0..nx * ny {
        for s in 0..LATER {
            let [di, dj] = offset(s);
            let (i, j) = ((c % nx) as isize + di, (c / nx) as isize + dj);
            if (0..nx as isize).contains(&i) && (0..ny as isize).contains(&j) {
                entries.push((c as u32, s as u8));
                rows.push(j as usize * nx + i as usize);
            }
        }
        begins.push(rows.len());
    }
    (entries, begins, rows)
}

/// Returns the matrix P of the bending energy of the splines. An entry is the integral, over the grid, of f_xx g_xx + 2
/// f_xy g_xy + f_yy g_yy for two neighbouring splines f and g. The matrix is stored with [`LATER`] entries for each
/// spline coefficient.
fn bending(axes: &[SplineAxis; 2]) -> Vec<f64> {
    let [x, y] = axes.map(|axis| [0, 1, 2].map(|derivative| axis.products(derivative)));
    let (nx, ny) = (axes[0].count(), axes[1].count());
    let product = |table: &[[f64; 4]], i: usize, d: isize| {
        let first = if d < 0 { i.checked_add_signed(d) } else { Some(i) };
        first.and_then(|first| table.get(first)).map_or(0.0, |row| row[d.unsigned_abs()])
    };
    let mut bending = vec![0.0; nx * ny * LATER];
    for (k, value) in bending.iter_mut().enumerate() {
        let (c, [di, dj]) = (k / LATER, offset(k % LATER));
        let (i, j) = (c % nx, c / nx);
        let along = |d: usize| (product(&x[d], i, di), product(&y[2 - d], j, dj));
        let [(x0, y2), (x1, y1), (x2, y0)] = [along(0), along(1), along(2)];
        *value = x2 * y0 + 2.0 * x1 * y1 + x0 * y2;
    }
    bending
}

/// Values of the sixteen splines that are not 0 at a place.
struct LocalSplines {
    first: usize,
    across: usize,
    fraction: [f64; 2],
    shares: [f64; 16],
}

impl LocalSplines {
    fn new(axes: &[SplineAxis; 2], place: [f64; 2]) -> Self {
        let ((i, u), (j, v)) = (axes[0].cell(place[0]), axes[1].cell(place[1]));
        let (x, y) = (basis(0, u), basis(0, v));
        let across = axes[0].count();
        Self { first: j * across + i, across, fraction: [u, v], shares: std::array::from_fn(|k| x[k % 4] * y[k / 4]) }
    }

    fn index(&self, k: usize) -> usize {
        self.first + (k / 4) * self.across + k % 4
    }

    fn sum(&self, coefficients: &[f64]) -> f64 {
        (0..16).map(|k| self.shares[k] * coefficients[self.index(k)]).sum()
    }

    fn slopes(&self, axes: &[SplineAxis; 2], coefficients: &[f64]) -> [f64; 2] {
        [0, 1].map(|axis| {
            let x = basis(usize::from(axis == 0), self.fraction[0]);
            let y = basis(usize::from(axis == 1), self.fraction[1]);
            (0..16).map(|k| x[k % 4] * y[k / 4] * coefficients[self.index(k)]).sum::<f64>() / axes[axis].step
        })
    }

    /// Returns b^T S b, where b holds the values of the splines at this place. S is the symmetric matrix `matrix`,
    /// stored with [`LATER`] entries for each spline coefficient.
    fn quadratic_form(&self, matrix: &[f64]) -> f64 {
        let mut sum = 0.0;
        for a in 0..16 {
            let row = &matrix[self.index(a) * LATER..][..LATER];
            for b in a..16 {
                let entry = row[later((b % 4) as isize - (a % 4) as isize, (b / 4) as isize - (a / 4) as isize)];
                sum += if a == b { 1.0 } else { 2.0 } * self.shares[a] * self.shares[b] * entry;
            }
        }
        sum
    }
}
