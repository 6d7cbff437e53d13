//! Basis functions of the field: cosines over a rectangle larger than the part, and low polynomials over the part.
//!
//! A Gaussian field of any stationary covariance is approximately a weighted sum of the cosines:
//!
//! ```text
//!  phi_ab(x, y) = c_a c_b cos(pi a u / L_u) cos(pi b v / L_v) / sqrt(L_u L_v)        c_0 = 1, else c = sqrt 2
//!  f = sum z_ab sqrt(S(w_ab)) phi_ab        z independent and standard normal, w_ab = pi (a / L_u, b / L_v)
//! ```
//!
//! S is the spectral density of the covariance (Solin and Sarkka 2020). The coordinates u and v run along and across
//! the anisotropy of the field. The slope of each cosine is zero at the edge of the rectangle. Therefore the rectangle
//! extends beyond the part on every side.
//!
//! A field whose range is longer than the part still has a slope at the edge of the rectangle, where no cosine has one.
//! Its error is largest in the corners. A smooth field with a long range is nearly a polynomial over the part.
//! Therefore products of Legendre polynomials are added to the cosines, with as much variance in total as the field
//! has.

use faer::Mat;

use super::{Anisotropy, Smoothness};
use crate::geometry::bounds;

/// Margin of the rectangle on each side of the part, as a share of the longer side of the part.
const WIDER: f64 = 0.15;

/// Cosines of the lowest wavenumbers over a rectangle, preceded by polynomials over the part.
pub(super) struct Basis {
    pub(super) anisotropy: Anisotropy,
    corner_mm: [f64; 2],
    lengths_mm: [f64; 2],
    /// Centre and half lengths of the rectangle around the part, on which the polynomials are defined.
    middle_mm: [f64; 2],
    halves_mm: [f64; 2],
    degree: usize,
    /// Degrees of each polynomial along u and v.
    degrees: Vec<[usize; 2]>,
    /// Orders a and b of each cosine along u and v.
    orders: Vec<[usize; 2]>,
    /// Highest order along each axis, plus one.
    counts: [usize; 2],
    /// Squared wavenumber of each cosine, in 1 / mm^2, in the coordinates in which the field is isotropic. Ascending.
    squared_wavenumbers: Vec<f64>,
}

impl Basis {
    /// Builds the basis functions of a random field at the given places (x and y in mm): polynomials of total degree 2
    /// to `degree`, then `count` cosines. The polynomials of degree 0 and 1 (constant and tilt) are left out, because a
    /// motion of the part has the same effect.
    ///
    /// `lay` is the anisotropy of the field. The cosines are defined on a rectangle that is wider than the area of the
    /// places. Those with the largest variance in a field of this anisotropy are used, in descending order of their
    /// variance.
    pub(super) fn over(places: &[[f64; 2]], lay: Anisotropy, count: usize, degree: usize) -> Self {
        let [low, high] = bounds(places.iter().map(|&place| lay.rotated(place)));
        let spans_mm = [0, 1].map(|axis| high[axis] - low[axis]);
        let wider_mm = WIDER * spans_mm[0].max(spans_mm[1]).max(f64::MIN_POSITIVE.sqrt());
        let corner_mm = low.map(|low| low - wider_mm);
        let lengths_mm = spans_mm.map(|span_mm| span_mm + 2.0 * wider_mm);
        let root = lay.stretch.sqrt();
        let steps = [root / lengths_mm[0], 1.0 / (root * lengths_mm[1])].map(|step| step * std::f64::consts::PI);
        // The quarter ellipse with these half axes has the area of `count` unit cells, so it contains at least `count`
        // waves.
        let longest = (4.0 * count as f64 * steps[0] * steps[1] / std::f64::consts::PI).sqrt();
        let most = steps.map(|step| (longest / step) as usize + 2);
        let number2 = |[a, b]: [usize; 2]| (a as f64 * steps[0]).powi(2) + (b as f64 * steps[1]).powi(2);
        let mut orders: Vec<[usize; 2]> = (0..most[0]).flat_map(|a| (0..most[1]).map(move |b| [a, b])).collect();
        orders.sort_by(|a, b| number2(*a).total_cmp(&number2(*b)).then(a.cmp(b)));
        orders.truncate(count);
        let counts = [0, 1].map(|axis| orders.iter().map(|order| order[axis] + 1).max().unwrap_or(1));
        let numbers2 = orders.iter().map(|&order| number2(order)).collect();
        let middle_mm = [0, 1].map(|axis| 0.5 * (low[axis] + high[axis]));
        // If the points lie on a line, a minimum width avoids a division by zero.
        let halves_mm = spans_mm.map(|span_mm| (0.5 * span_mm).max(0.01 * wider_mm));
        let degrees = (2..=degree).flat_map(|whole| (0..=whole).map(move |b| [whole - b, b])).collect();
        Self {
            anisotropy: lay,
            corner_mm,
            lengths_mm,
            middle_mm,
            halves_mm,
            degree,
            degrees,
            orders,
            counts,
            squared_wavenumbers: numbers2,
        }
    }

    /// Returns the number of basis functions: polynomials and cosines.
    pub(super) fn len(&self) -> usize {
        self.degrees.len() + self.orders.len()
    }

    /// Returns the number of polynomials. They come first in the basis.
    pub(super) fn polynomial_count(&self) -> usize {
        self.degrees.len()
    }

    /// Returns half the wavelength of the cosine with the shortest wavelength, in mm.
    pub(super) fn min_half_wavelength_mm(&self) -> f64 {
        std::f64::consts::PI / self.squared_wavenumbers.last().copied().unwrap_or(0.0).sqrt()
    }

    /// Returns the prior standard deviation of the coefficient of each basis function, in mm, for a field with the
    /// given smoothness and range. The variance of the field is 1, without a unit. The polynomials come first, then the
    /// cosines.
    ///
    /// The second result is the share (0 to 1) of the variance of the field that the basis functions cannot represent.
    /// This is the share of all waves that are shorter than the shortest cosine.
    ///
    /// The standard deviations of the polynomials are 0 if the field is not differentiable, or if `range_mm` is less
    /// than the longer side of the part.
    pub(super) fn standard_deviations(&self, smoothness: Smoothness, range_mm: f64) -> (Vec<f64>, f64) {
        let strength = |number2: &f64| spectral_density_mm2(smoothness, range_mm, *number2).sqrt();
        let last2 = self.squared_wavenumbers.last().copied().unwrap_or(0.0);
        let area_mm2 = self.lengths_mm[0] * self.lengths_mm[1];
        let longest_mm = 2.0 * self.halves_mm[0].max(self.halves_mm[1]);
        let is_long = smoothness != Smoothness::Exponential && range_mm >= longest_mm;
        let of_polynomial = if is_long { (area_mm2 / self.degrees.len().max(1) as f64).sqrt() } else { 0.0 };
        let polynomials = self.degrees.iter().map(|_| of_polynomial);
        (
            polynomials.chain(self.squared_wavenumbers.iter().map(strength)).collect(),
            truncated_share(smoothness, range_mm, last2),
        )
    }

    /// Evaluates every basis function at `places` (x and y in mm). Returns a matrix with one row for each place and one
    /// column for each basis function: the polynomials first, then the cosines.
    pub(super) fn at(&self, places: &[[f64; 2]]) -> Mat<f64> {
        let at_mm =
            [0, 1].map(|axis| places.iter().map(|&place| self.anisotropy.rotated(place)[axis]).collect::<Vec<f64>>());
        let polynomials = [0, 1].map(|axis| self.polynomials(axis, &at_mm[axis]));
        let cosines = [0, 1].map(|axis| self.cosines(axis, &at_mm[axis]));
        let of_polynomials = self.degrees.iter().map(|order| (&polynomials, order));
        let all = of_polynomials.chain(self.orders.iter().map(|order| (&cosines, order)));
        let mut waves = Mat::zeros(places.len(), self.len());
        for (k, (along, [a, b])) in all.enumerate() {
            let column = waves.col_as_slice_mut(k);
            column.iter_mut().zip(along[0][*a].iter().zip(&along[1][*b])).for_each(|(value, (u, v))| *value = u * v);
        }
        waves
    }

    /// Evaluates the one-dimensional cosines along one axis of the basis at the coordinates `at_mm`. `axis` is 0 for u
    /// or 1 for v. The axis u is the direction of the longest range of the field (the x axis if the field is
    /// isotropic). The axis v is perpendicular to u. Returns one vector for each order of the cosines, from order 0.
    /// Each vector has one value for each coordinate.
    fn cosines(&self, axis: usize, at_mm: &[f64]) -> Vec<Vec<f64>> {
        let length_mm = self.lengths_mm[axis];
        let scale = |order: usize| if order == 0 { 1.0 } else { 2.0_f64.sqrt() } / length_mm.sqrt();
        let phases: Vec<f64> =
            at_mm.iter().map(|at| std::f64::consts::PI * (at - self.corner_mm[axis]) / length_mm).collect();
        let of = |order: usize| phases.iter().map(|phase| scale(order) * (order as f64 * phase).cos()).collect();
        (0..self.counts[axis]).map(of).collect()
    }

    /// Evaluates the Legendre polynomials of one variable at the coordinates `at_mm`. `axis` is 0 for u or 1 for v. The
    /// axis u is the direction of the longest range of the field (the x axis if the field is isotropic). The axis v is
    /// perpendicular to u. Returns one vector for each degree, from degree 0. Each vector has one value for each
    /// coordinate.
    ///
    /// The polynomials are scaled so that their mean square over the part is 1 / L, as for the cosines. L is the length
    /// along this axis of the rectangle on which the cosines are defined.
    fn polynomials(&self, axis: usize, at_mm: &[f64]) -> Vec<Vec<f64>> {
        let root = self.lengths_mm[axis].sqrt().recip();
        let places: Vec<f64> = at_mm.iter().map(|at| (at - self.middle_mm[axis]) / self.halves_mm[axis]).collect();
        let mut all = vec![vec![1.0; places.len()], places.clone()];
        for degree in 2..=self.degree {
            let n = degree as f64;
            let next = places.iter().zip(&all[degree - 1]).zip(&all[degree - 2]);
            all.push(next.map(|((x, one), two)| ((2.0 * n - 1.0) * x * one - (n - 1.0) * two) / n).collect());
        }
        for (degree, values) in all.iter_mut().enumerate() {
            let by = (2.0 * degree as f64 + 1.0).sqrt() * root;
            values.iter_mut().for_each(|value| *value *= by);
        }
        all
    }

    /// Evaluates the one-dimensional polynomials and cosines at the node coordinates of `grid`. The result is the input
    /// of [`Self::on_grid`].
    ///
    /// Returns two matrices: the first for the axis u, the second for the axis v. The axis u is the direction of the
    /// longest range of the field (the x axis if the field is isotropic). The axis v is perpendicular to u. Each matrix
    /// has one row for each node along its axis. The columns are the polynomials from degree 0, then the cosines from
    /// order 0.
    pub(super) fn grid(&self, grid: &BasisGrid) -> [Mat<f64>; 2] {
        [0, 1].map(|axis| {
            let at_mm: Vec<f64> =
                (0..grid.counts[axis]).map(|k| grid.corner_mm[axis] + grid.spacing_mm * k as f64).collect();
            let all = [self.polynomials(axis, &at_mm), self.cosines(axis, &at_mm)].concat();
            Mat::from_fn(at_mm.len(), all.len(), |r, c| all[c][r])
        })
    }

    /// Evaluates a field at all nodes of a grid. `coefficients` has the coefficient of each basis function. `along` and
    /// `across` are the two matrices that [`Self::grid`] returns: the one-dimensional basis functions at the node
    /// coordinates along the two axes u and v of the basis. Returns a matrix of values with one row for each node along
    /// u and one column for each node along v.
    pub(super) fn on_grid(&self, [along, across]: &[Mat<f64>; 2], coefficients: &[f64]) -> Mat<f64> {
        let mut square = Mat::<f64>::zeros(along.ncols(), across.ncols());
        let (polynomials, cosines) = coefficients.split_at(self.degrees.len().min(coefficients.len()));
        self.degrees.iter().zip(polynomials).for_each(|([a, b], of)| square[(*a, *b)] = *of);
        let first = [along.ncols() - self.counts[0], across.ncols() - self.counts[1]];
        self.orders.iter().zip(cosines).for_each(|([a, b], of)| square[(first[0] + a, first[1] + b)] = *of);
        along * &square * across.transpose()
    }
}

/// Square grid along the axes u and v of the basis.
#[derive(Clone, Debug)]
pub(super) struct BasisGrid {
    pub(super) corner_mm: [f64; 2],
    pub(super) spacing_mm: f64,
    pub(super) counts: [usize; 2],
}

impl BasisGrid {
    /// Converts the index of a grid node to the indices of the node along the two axes: first along u, then along v.
    /// The axis u is the direction of the longest range of the field (the x axis if the field is isotropic). The axis v
    /// is perpendicular to u. All indices count from 0. Nodes are counted row by row, u fastest.
    pub(super) fn indices(&self, node: usize) -> [usize; 2] {
        [node % self.counts[0], node / self.counts[0]]
    }

    /// Returns the coordinates u and v of the grid node with the index `node`, in mm. The axis u is the direction of
    /// the longest range of the field (the x axis if the field is isotropic). The axis v is perpendicular to u.
    pub(super) fn place(&self, node: usize) -> [f64; 2] {
        let indices = self.indices(node);
        [0, 1].map(|axis: usize| self.corner_mm[axis] + self.spacing_mm * indices[axis] as f64)
    }
}

/// Returns the spectral density of an isotropic field of variance 1, in mm^2. `number2` is the squared angular
/// wavenumber w^2, in 1 / mm^2.
///
/// A squared-exponential field has the covariance exp(-2 (r / range)^2) at the distance r. Every other field has a
/// Matern covariance with the smoothness nu. With kappa^2 = 8 nu / range^2, its density is 4 pi nu kappa^(2 nu) /
/// (kappa^2 + w^2)^(nu + 1) (Rasmussen and Williams 2006, 4.15).
fn spectral_density_mm2(smoothness: Smoothness, range_mm: f64, number2: f64) -> f64 {
    let Some(nu) = smoothness.nu() else {
        return 0.25 * std::f64::consts::TAU * range_mm.powi(2) * (-number2 * range_mm.powi(2) / 8.0).exp();
    };
    let kappa2 = 8.0 * nu / (range_mm * range_mm);
    2.0 * std::f64::consts::TAU * nu * kappa2.powf(nu) / (kappa2 + number2).powf(nu + 1.0)
}

/// Returns the share (0 to 1) of the variance of a field that lies in short waves, that is, waves with a squared
/// wavenumber above `number2`, in 1 / mm^2. This is the integral of the spectral density outside a circle in the plane
/// of wavenumbers.
fn truncated_share(smoothness: Smoothness, range_mm: f64, number2: f64) -> f64 {
    let Some(nu) = smoothness.nu() else {
        return (-number2 * range_mm.powi(2) / 8.0).exp();
    };
    let kappa2 = 8.0 * nu / (range_mm * range_mm);
    (kappa2 / (kappa2 + number2)).powf(nu)
}

#[cfg(test)]
mod tests {
    use super::super::Field;
    use super::*;

    const PART: [[f64; 2]; 2] = [[-30.0, -20.0], [30.0, 20.0]];

    /// Returns the covariance of two places under the basis.
    fn covariance(waves: &Basis, field: &Field, places: [[f64; 2]; 2]) -> f64 {
        let (strengths, _) = waves.standard_deviations(field.smoothness, field.range_mm);
        let at = waves.at(&places);
        (0..waves.len()).map(|k| strengths[k].powi(2) * at[(0, k)] * at[(1, k)]).sum()
    }

    #[test]
    fn basis_reproduces_field_covariance() {
        for (smoothness, near) in
            [(Smoothness::Exponential, 0.05), (Smoothness::Matern2, 0.02), (Smoothness::SquaredExponential, 0.02)]
        {
            for lay in [Anisotropy::NONE, Anisotropy::from_angle(0.7, 3.0)] {
                let field = Field { smoothness, anisotropy: lay, ..Field::new(1.0, 12.0) };
                let waves = Basis::over(&PART, lay, 3000, 4);
                for (a, b) in [([0.0, 0.0], [3.0, 1.0]), ([10.0, -5.0], [14.0, 2.0]), ([20.0, 10.0], [20.0, 2.0])] {
                    let [made, exact] = [covariance(&waves, &field, [a, b]), field.covariance_mm2(a, b)];
                    assert!((made - exact).abs() < near, "{smoothness:?} {lay:?} {a:?}: {made} {exact}");
                }
                let (_, left) = waves.standard_deviations(smoothness, 12.0);
                let [made, all] = [covariance(&waves, &field, [[1.0, 2.0]; 2]), 1.0 - left];
                assert!((made - all).abs() < 0.03, "{smoothness:?} {lay:?}: {made} {all}");
            }
        }
    }

    #[test]
    fn basis_reports_truncated_variance() {
        let waves = Basis::over(&PART, Anisotropy::NONE, 200, 0);
        let left = [20.0, 5.0, 1.0].map(|range_mm| waves.standard_deviations(Smoothness::Exponential, range_mm).1);
        assert!(left[0] < 0.2 && left[1] > 0.3 && left[2] > 0.8 && left[2] < 1.0, "{left:?}");
        assert!(waves.standard_deviations(Smoothness::SquaredExponential, 30.0).1 < 0.02);
    }

    #[test]
    fn basis_polynomials_are_orthogonal() {
        let waves = Basis::over(&PART, Anisotropy::NONE, 10, 4);
        let count = waves.degrees.len();
        assert_eq!(count, 12);
        // Midpoints of 200 by 200 tiles; each polynomial has the mean square of a cosine, 1 / (78 mm 58 mm).
        let at = |k: usize, n: f64| (k as f64 + 0.5) / 200.0 * 2.0 * n - n;
        let tiles: Vec<[f64; 2]> = (0..40_000).map(|k| [at(k % 200, 30.0), at(k / 200, 20.0)]).collect();
        let values = waves.at(&tiles);
        for a in 0..count {
            for b in 0..count {
                let mean: f64 = (0..tiles.len()).map(|r| values[(r, a)] * values[(r, b)]).sum::<f64>() / 40_000.0;
                let expected = if a == b { 1.0 } else { 0.0 };
                assert!((mean * 78.0 * 58.0 - expected).abs() < 2e-3, "{a} {b}: {mean}");
            }
        }
        // At (30, -20) the product of the two polynomials of degree 2 is 1. Scaled to the mean square of a cosine it is
        // 5.
        let two_by_two = waves.degrees.iter().position(|degrees| *degrees == [2, 2]).unwrap();
        let corner = waves.at(&[[30.0, -20.0]])[(0, two_by_two)];
        assert!((corner - 5.0 / (78.0_f64 * 58.0).sqrt()).abs() < 1e-12, "{corner}");
        for (smoothness, range_mm, has) in [
            (Smoothness::SquaredExponential, 61.0, true),
            (Smoothness::Matern2, 61.0, true),
            (Smoothness::SquaredExponential, 59.0, false),
            (Smoothness::Exponential, 200.0, false),
        ] {
            let (strengths, _) = waves.standard_deviations(smoothness, range_mm);
            assert!(strengths[..count].iter().all(|strength| (*strength > 0.0) == has), "{smoothness:?} {range_mm}");
        }
        let line: Vec<[f64; 2]> = (0..30).map(|k| [f64::from(k), 1.0 + 1e-15 * f64::from(k % 3)]).collect();
        assert!(
            Basis::over(&line, Anisotropy::from_angle(0.3, 2.0), 10, 4)
                .at(&line)
                .col_iter()
                .all(|column| column.norm_max() < 1e3)
        );
    }

    #[test]
    fn basis_on_grid_matches_points() {
        let waves = Basis::over(&PART, Anisotropy::from_angle(0.4, 2.0), 60, 4);
        let grid = BasisGrid { corner_mm: [-5.0, 2.0], spacing_mm: 1.5, counts: [4, 3] };
        let coefficients: Vec<f64> = (0..60).map(|k| (f64::from(k) * 0.7).sin()).collect();
        let on = waves.on_grid(&waves.grid(&grid), &coefficients);
        let (c, s) = (0.4_f64.cos(), 0.4_f64.sin());
        for (i, j) in [(0, 0), (3, 2), (1, 2)] {
            let [u, v] = [grid.corner_mm[0] + 1.5 * i as f64, grid.corner_mm[1] + 1.5 * j as f64];
            let at = waves.at(&[[c * u - s * v, s * u + c * v]]);
            let by_hand: f64 = (0..60).map(|k| at[(0, k)] * coefficients[k]).sum();
            assert!((on[(i, j)] - by_hand).abs() < 1e-12);
        }
    }
}
