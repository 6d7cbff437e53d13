//! Areal Gaussian filter (ISO 16610-61) for readings at arbitrary places, without padding at edges and holes.
//!
//! At a place the filter fits a polynomial of order 0, 1 or 2 to the readings around it with the weights
//! exp(-pi (r / (alpha cutoff))^2). The height of the polynomial there is the filtered value: the Gaussian regression
//! filter (ISO 16610-31, areal). Far from edges and holes (in the open) this is the Gaussian filter. At an edge or a
//! hole only the existing readings are weighted, and no padding is needed. The normal equations of a fit are moments of
//! the weights. The weights separate, so the moments at all nodes of a grid are sums along x and then along y: the cost
//! grows with the reach on one axis, not with its square.
//!
//! **Readings between nodes.** A narrow Gaussian of width s spreads a reading over the 7 x 7 nodes around it. The sums
//! along the axes then use a Gaussian that is narrower to match, of width sqrt(sigma^2 - s^2), and the polynomials of
//! the moments change accordingly (Hermite). Both together are the required weight at the true place of the reading, up
//! to the sampling error of the product of two Gaussians, which falls as exp(-2 pi^2 s^2 (1 - s^2 / sigma^2) / step^2).
//! With a step of at most 0.55 sigma and s of 0.75 steps, weights are right to 2e-4 of the largest; half the step gives
//! 4e-6. The filter subtracts a polynomial of its own order before and adds it again after, so that planes (quadrics)
//! still pass to rounding.

use std::f64::consts::PI;

use nalgebra::{DMatrix, DVector, SMatrix, SVector};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::geometry::{Grid, bounds};

/// Width of the spreading Gaussian, in steps of the grid.
const SPREAD: f64 = 0.75;
/// Number of nodes to either side that a reading is spread over; beyond them the weight is 2e-5 of the largest.
const SPREAD_REACH: usize = 3;
/// Widest step of the grid, in standard deviations of the weights.
const MAX_STEP: f64 = 0.55;
/// Reach of the weights, in standard deviations; beyond it they are below 1e-6 of the largest.
const REACH: f64 = 5.3;
/// Minimum number of readings within the cut-off of a node, along x and along y; fewer are no evidence for a surface.
pub(super) const MIN_READINGS: u32 = 6;
/// Maximum number of nodes that a filter may work on; a short cut-off on a wide grid needs more nodes than the grid
/// has.
pub(super) const MAX_FILTER_NODES: f64 = 2e7;
/// Maximum ratio of the variance of a filtered value to the variance of one reading. A node with a larger ratio is not
/// supported.
const MAX_VARIANCE: f64 = 2.0;

/// Maximum spread of the readings around a node: their weighted variance along x plus that along y, in units of the
/// squared standard deviation of the weights. It is 2 far from edges and holes, 3.6 between four readings half a
/// cut-off apart, and more in a hole.
const MAX_SPREAD: f64 = 4.5;

/// Order of the polynomial that the filter lets pass unchanged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum FilterOrder {
    /// Order 0: constants pass unchanged. The filter is a weighted mean, which is biased at an edge where the surface
    /// slopes.
    Constant,
    /// Order 1: planes pass unchanged.
    #[default]
    Plane,
    /// Order 2: quadrics pass unchanged.
    Quadric,
}

impl FilterOrder {
    /// Returns the constant alpha of the Gaussian filter. The filter weights a reading (a value at a place) with
    /// exp(-pi (r / (alpha cutoff))^2). Here r is the distance of the reading from the place of the filtered value, and
    /// cutoff is the cut-off wavelength. With this alpha, a wave with the cut-off wavelength keeps half of its
    /// amplitude.
    ///
    /// Derivation: let u = pi (alpha cutoff / wavelength)^2. A filter of order 0 or 1 (constant, plane) passes the
    /// share exp(-u) of the amplitude. A filter of order 2 (quadric) passes the share (1 + u) exp(-u). The share is one
    /// half at u = ln 2 for orders 0 and 1, and at u = 1.678347 for order 2. At wavelength = cutoff, u is pi alpha^2.
    /// Therefore alpha = sqrt(u / pi).
    pub fn alpha(self) -> f64 {
        match self {
            Self::Constant | Self::Plane => 0.469_718_639_349_825_66,
            Self::Quadric => 0.730_913_428_094_675,
        }
    }

    /// Returns the transmission of the filter: the share, from 0 to 1, of the amplitude of a wave that passes.
    /// `wavelength_in_cutoffs` is the wavelength divided by the cut-off. The value is valid far from edges and holes.
    pub fn transmission(self, wavelength_in_cutoffs: f64) -> f64 {
        let u = PI * (self.alpha() / wavelength_in_cutoffs).powi(2);
        if self == Self::Quadric { (1.0 + u) * (-u).exp() } else { (-u).exp() }
    }

    fn degree(self) -> usize {
        match self {
            Self::Constant => 0,
            Self::Plane => 1,
            Self::Quadric => 2,
        }
    }
}

/// Exponents of x and y of the terms of a polynomial, ordered by degree.
const TERMS: [[usize; 2]; 6] = [[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]];
/// Number of moments up to the fourth degree.
const MOMENTS: usize = 15;

/// Returns the index of the moment with the exponents `a` and `b` in a list of moments. This moment is the sum of
/// weight times x^a y^b over points. The list is ordered by the degree a + b, and within a degree by b: 1, x, y, x^2, x
/// y, y^2, and so on.
const fn moment(a: usize, b: usize) -> usize {
    (a + b) * (a + b + 1) / 2 + b
}

const fn terms(degree: usize) -> usize {
    (degree + 1) * (degree + 2) / 2
}

/// Gaussian filter of a cut-off and an order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct GaussianFilter {
    pub cutoff_mm: f64,
    pub order: FilterOrder,
}

/// Result of a filter at every node of its grid.
#[derive(Clone, Debug)]
pub(super) struct FilterResult {
    pub grid: Grid,
    /// Filtered values; 0 at nodes that are not supported.
    pub values: Vec<f64>,
    /// Slopes of the fitted polynomial along x and y, per millimetre.
    pub slopes: Vec<[f64; 2]>,
    /// Leverage: change of the filtered value at the node per unit change of a reading of weight 1 at the node.
    pub leverage: Vec<f64>,
    /// Ratio of the variance of the filtered value to the variance of one reading.
    pub variance: Vec<f64>,
    /// True for a node that has enough readings around it, not all of them on one side.
    pub supported: Vec<bool>,
}

impl GaussianFilter {
    /// Returns the product of the leverage of a reading and the density of the readings, in 1/mm². The leverage is the
    /// change of the filtered value at a place per unit change of a reading at the same place. The density is the
    /// number of readings per square millimetre. The product is the same for every density. The result is valid far
    /// from edges and holes.
    ///
    /// Equation: 1 / (alpha cutoff)^2 for orders 0 and 1, and 2 / (alpha cutoff)^2 for order 2. Alpha is the constant
    /// [`FilterOrder::alpha`].
    pub fn open_leverage(&self) -> f64 {
        let weight = (self.order.alpha() * self.cutoff_mm).powi(2);
        if self.order == FilterOrder::Quadric { 2.0 / weight } else { 1.0 / weight }
    }

    /// Returns the standard deviation of the Gaussian weight function, in millimetres.
    fn sigma_mm(&self) -> f64 {
        self.order.alpha() * self.cutoff_mm / (2.0 * PI).sqrt()
    }

    /// Returns into how many steps the spacing of `grid` must be divided along x and along y, so that no step is wider
    /// than [`MAX_STEP`] standard deviations of the weights.
    pub fn division(&self, grid: &Grid) -> [usize; 2] {
        let widest_mm = MAX_STEP * self.sigma_mm();
        grid.spacing_mm.map(|spacing| (spacing / widest_mm).ceil().clamp(1.0, 1e6) as usize)
    }

    /// Filters readings at arbitrary places, and returns the filtered surface at the nodes of `grid`. `places` holds
    /// the position `[x, y]` of each reading in millimetres, and `values` its value. `weights` holds a factor from 0 to
    /// 1 for each reading; `None` means the factor 1 for all.
    pub fn filter_scattered(
        &self,
        places: &[[f64; 2]],
        values: &[f64],
        weights: Option<&[f64]>,
        grid: &Grid,
    ) -> FilterResult {
        let degree = self.order.degree();
        let trend = Trend::fit(places, values, degree);
        let sigma_mm = self.sigma_mm();
        let spread = grid.spacing_mm.map(|step| SPREAD * step / sigma_mm);
        let taps = self.taps(grid);
        let rest: Vec<f64> = places.iter().zip(values).map(|(p, v)| v - trend.at(*p)).collect();
        let channels = spread_readings(places, &rest, weights, grid, taps);
        let counts = ReadingCounts::new(places, grid);
        let mut filtered = self.solve(&channels, spread, taps, grid, &counts);
        filtered.add_trend(&trend);
        filtered
    }

    /// Filters values that are known at the nodes of `grid` and returns the filtered surface at the same nodes.
    /// `values` and `weights` have one entry for each node. A node with weight 0 has no value.
    pub fn filter_nodes(&self, values: &[f64], weights: &[f64], grid: &Grid) -> FilterResult {
        let degree = self.order.degree();
        let (places, known): (Vec<[f64; 2]>, Vec<f64>) =
            (0..grid.len()).filter(|&k| weights[k] > 0.0).map(|k| (grid.place_mm(k), values[k])).unzip();
        let trend = Trend::fit(&places, &known, degree);
        let taps = self.taps(grid);
        let mut channels = GridSums::new(grid, taps, true);
        for k in (0..grid.len()).filter(|&k| weights[k] > 0.0) {
            let slot = channels.slot(k % grid.columns, k / grid.columns);
            let weight = weights[k];
            channels.weight[slot] = weight;
            channels.value[slot] = weight * (values[k] - trend.at(grid.place_mm(k)));
            channels.weight2[slot] = weight * weight;
        }
        let counts = ReadingCounts::new(&places, grid);
        let mut filtered = self.solve(&channels, [0.0; 2], taps, grid, &counts);
        filtered.add_trend(&trend);
        filtered
    }

    /// Returns the reach of the filter weights, as the number of nodes of `grid` on each side of a node, along x and
    /// along y. Beyond this reach the weights are treated as 0.
    fn taps(&self, grid: &Grid) -> [usize; 2] {
        [0, 1].map(|k| {
            let nodes = grid.counts()[k];
            ((REACH * self.sigma_mm() / grid.spacing_mm[k]).ceil() as usize).clamp(1, nodes.max(4)).max(SPREAD_REACH)
        })
    }

    fn solve(
        &self,
        channels: &GridSums,
        spread: [f64; 2],
        taps: [usize; 2],
        grid: &Grid,
        counts: &ReadingCounts,
    ) -> FilterResult {
        let degree = self.order.degree();
        let sigma_mm = self.sigma_mm();
        let kernels = |scale: f64, most: usize| {
            [0, 1].map(|k| kernels(most, scale, grid.spacing_mm[k] / sigma_mm, spread[k], taps[k]))
        };
        // The check for one-sided readings needs the second moments, whatever the order.
        let most = (2 * degree).max(2);
        let ([wx, wy], [qx, qy]) = (kernels(1.0, most), kernels(2f64.sqrt(), 2 * degree));
        let weight = RowSums::along_x(channels, &channels.weight, &wx);
        let value = RowSums::along_x(channels, &channels.value, &wx[..=degree]);
        let weight2 = RowSums::along_x(channels, channels.squares(), &qx);
        let rows: Vec<Vec<NodeFit>> = (0..grid.rows)
            .into_par_iter()
            .map(|j| {
                let weight = weight.along_y(&wy, most, j);
                let sums = [weight, value.along_y(&wy, degree, j), weight2.along_y(&qy, 2 * degree, j)];
                let enough = |i: usize| counts.within(i, j, self.cutoff_mm) >= MIN_READINGS;
                (0..grid.columns).map(|i| if enough(i) { fit_node(self.order, &sums, i) } else { None }).collect()
            })
            .collect();
        gathered(grid, sigma_mm, rows.into_iter().flatten())
    }
}

/// Value, slopes along x and y per standard deviation of the weights, leverage and relative variance of the fit at a
/// node; `None` if the node is not supported.
type NodeFit = Option<[f64; 5]>;

fn gathered(grid: &Grid, sigma_mm: f64, nodes: impl Iterator<Item = NodeFit>) -> FilterResult {
    let count = grid.len();
    let mut all = FilterResult {
        grid: *grid,
        values: Vec::with_capacity(count),
        slopes: Vec::with_capacity(count),
        leverage: Vec::with_capacity(count),
        variance: Vec::with_capacity(count),
        supported: Vec::with_capacity(count),
    };
    for node in nodes {
        let [value, p, q, leverage, variance] = node.unwrap_or_default();
        all.values.push(value);
        all.slopes.push([p / sigma_mm, q / sigma_mm]);
        all.leverage.push(leverage);
        all.variance.push(variance);
        all.supported.push(node.is_some());
    }
    all
}

fn fit_node(order: FilterOrder, sums: &[Vec<Vec<f64>>; 3], i: usize) -> NodeFit {
    let at = |sums: &[Vec<f64>]| {
        let mut m = [0.0; MOMENTS];
        sums.iter().zip(&mut m).for_each(|(sum, m)| *m = sum[i]);
        m
    };
    let (weight, value, weight2) = (at(&sums[0]), at(&sums[1]), at(&sums[2]));
    match order {
        FilterOrder::Constant => fit::<1>(&weight, &value, &weight2),
        FilterOrder::Plane => fit::<3>(&weight, &value, &weight2),
        FilterOrder::Quadric => fit::<6>(&weight, &value, &weight2),
    }
}

/// Fits a polynomial with P terms (1: constant, 3: plane, 6: quadric) to the readings around a node by weighted least
/// squares. Returns five values at the node: the height of the polynomial, its slope along x, its slope along y, the
/// leverage and the relative variance.
///
/// - The slopes are the change of the height per standard deviation of the weights. They are 0 for a constant.
/// - The leverage is the change of the height per unit change of a reading of weight 1 at the node.
/// - The relative variance is the variance of the height divided by the variance of one reading.
///
/// `weight`, `value` and `weight2` hold the moments of the weights, of the weighted values and of the squared weights,
/// in the order of [`moment`].
///
/// Returns `None` if the readings do not surround the node closely ([`is_one_sided`]), if the readings do not determine
/// the polynomial, or if the relative variance exceeds [`MAX_VARIANCE`].
fn fit<const P: usize>(weight: &[f64; MOMENTS], value: &[f64; MOMENTS], weight2: &[f64; MOMENTS]) -> NodeFit {
    if is_one_sided(weight) {
        return None;
    }
    let gram = |m: &[f64; MOMENTS]| {
        SMatrix::<f64, P, P>::from_fn(|r, c| m[moment(TERMS[r][0] + TERMS[c][0], TERMS[r][1] + TERMS[c][1])])
    };
    let solved = gram(weight).cholesky()?;
    let terms = solved.solve(&SVector::<f64, P>::from_fn(|r, _| value[r]));
    // Row of the inverse that gives the height: the share of a reading is its weight times this polynomial.
    let share = solved.solve(&SVector::<f64, P>::from_fn(|r, _| if r == 0 { 1.0 } else { 0.0 }));
    let variance = share.dot(&(gram(weight2) * share));
    let slope = |k: usize| if P > 1 { terms[k.min(P - 1)] } else { 0.0 };
    let node = [terms[0], slope(1), slope(2), share[0], variance];
    (variance <= MAX_VARIANCE && node.iter().all(|v| v.is_finite())).then_some(node)
}

/// Returns true if the readings around a node do not surround the node closely. This is the case if they lie on a line,
/// if they lie on one side of the node, or if the node is in a hole and all readings are far away. A polynomial at such
/// a node would be an extrapolation.
///
/// `m` holds the moments of the weights about the node, in the order of [`moment`].
fn is_one_sided(m: &[f64; MOMENTS]) -> bool {
    let (mx, my) = (m[1] / m[0], m[2] / m[0]);
    let (cxx, cxy, cyy) = (m[3] / m[0] - mx * mx, m[4] / m[0] - mx * my, m[5] / m[0] - my * my);
    let spread = cxx + cyy;
    // At the corner of a dense square the squared offset of the mean is 1.8 of the spread; one standard deviation
    // outside a straight edge it is 1.9.
    let inside = cxx * cyy - cxy * cxy > 1e-4 * spread * spread && mx * mx + my * my <= 2.0 * spread;
    !inside || spread > MAX_SPREAD
}

/// Sums of the readings at the nodes of a grid. The grid is extended on all sides by the reach of the weights.
struct GridSums {
    columns: usize,
    rows: usize,
    border: [usize; 2],
    weight: Vec<f64>,
    value: Vec<f64>,
    /// Squares of the weights; empty if all weights are 0 or 1.
    weight2: Vec<f64>,
}

impl GridSums {
    fn new(grid: &Grid, border: [usize; 2], squares: bool) -> Self {
        let (columns, rows) = (grid.columns + 2 * border[0], grid.rows + 2 * border[1]);
        let empty = || vec![0.0; columns * rows];
        let weight2 = if squares { empty() } else { Vec::new() };
        Self { columns, rows, border, weight: empty(), value: empty(), weight2 }
    }

    fn slot(&self, i: usize, j: usize) -> usize {
        (j + self.border[1]) * self.columns + i + self.border[0]
    }

    fn squares(&self) -> &[f64] {
        if self.weight2.is_empty() { &self.weight } else { &self.weight2 }
    }

    fn add(&mut self, other: &Self) {
        for (mine, theirs) in
            [(&mut self.weight, &other.weight), (&mut self.value, &other.value), (&mut self.weight2, &other.weight2)]
        {
            mine.iter_mut().zip(theirs).for_each(|(a, b)| *a += b);
        }
    }
}

/// Distributes each reading over the 7 x 7 nodes around its place, with a Gaussian weight for each node. Returns three
/// sums for each node: the sum of the weights, the sum of the weighted values, and the sum of the squared weights. If
/// `weights` is `None`, omits the third sum, because it then equals the first sum.
///
/// `places` holds the position `[x, y]` of each reading in millimetres, and `values` its value. `weights` holds a
/// factor from 0 to 1 for each reading. `None` means the factor 1 for all readings. The squared weights contain the
/// square of this factor.
///
/// The sums belong to the nodes of `grid` and of a border around `grid`. `border` is the width of this border on each
/// side, in nodes along x and along y.
fn spread_readings(
    places: &[[f64; 2]],
    values: &[f64],
    weights: Option<&[f64]>,
    grid: &Grid,
    border: [usize; 2],
) -> GridSums {
    // The number of parts depends on the sizes alone, so that the sums are the same on every machine.
    let nodes = (grid.columns + 2 * border[0]) * (grid.rows + 2 * border[1]);
    let parts = if nodes < 4 * places.len() { 4 } else { 1 };
    let size = places.len().div_ceil(parts).max(1);
    let peaks = std::array::from_fn(|n| (-0.5 * (n as f64 / SPREAD).powi(2)).exp() / (SPREAD * (2.0 * PI).sqrt()));
    let chunks: Vec<GridSums> = places
        .par_chunks(size)
        .enumerate()
        .map(|(part, chunk)| {
            let mut channels = GridSums::new(grid, border, weights.is_some());
            for (k, place) in chunk.iter().enumerate() {
                let index = part * size + k;
                spread_reading(&mut channels, grid, &peaks, *place, values[index], weights.map_or(1.0, |w| w[index]));
            }
            channels
        })
        .collect();
    let mut chunks = chunks.into_iter();
    let mut all = chunks.next().unwrap_or_else(|| GridSums::new(grid, border, weights.is_some()));
    chunks.for_each(|chunk| all.add(&chunk));
    all
}

fn spread_reading(
    channels: &mut GridSums,
    grid: &Grid,
    peaks: &[f64; SPREAD_REACH + 1],
    place: [f64; 2],
    value: f64,
    weight: f64,
) {
    let mut first = [0usize; 2];
    let shares = [0, 1].map(|k| {
        let last = grid.counts()[k] - 1;
        let at = (place[k] - grid.first_mm[k]) / grid.spacing_mm[k];
        let nearest = at.round().clamp(0.0, last as f64);
        first[k] = nearest as usize;
        // exp(-((n - d) / s)^2 / 2) from two exponentials: the factor in n^2 is a constant, the factor in n d is a
        // power.
        let off = at - nearest;
        let (middle, ratio) = ((-0.5 * (off / SPREAD).powi(2)).exp(), (off / (SPREAD * SPREAD)).exp());
        let mut shares = [middle * peaks[0]; 2 * SPREAD_REACH + 1];
        let mut power = 1.0;
        for n in 1..=SPREAD_REACH {
            power *= ratio;
            shares[SPREAD_REACH + n] = middle * peaks[n] * power;
            shares[SPREAD_REACH - n] = middle * peaks[n] / power;
        }
        shares
    });
    let squares = !channels.weight2.is_empty();
    for (n, across) in shares[1].iter().enumerate() {
        let begin = channels.slot(first[0], first[1] + n) - SPREAD_REACH - SPREAD_REACH * channels.columns;
        let ends = begin..begin + shares[0].len();
        let factor = weight * across;
        channels.weight[ends.clone()].iter_mut().zip(&shares[0]).for_each(|(sum, s)| *sum += factor * s);
        let factor = value * factor;
        channels.value[ends.clone()].iter_mut().zip(&shares[0]).for_each(|(sum, s)| *sum += factor * s);
        if squares {
            let factor = weight * weight * across;
            channels.weight2[ends].iter_mut().zip(&shares[0]).for_each(|(sum, s)| *sum += factor * s);
        }
    }
}

/// Returns one-dimensional convolution kernels for the powers k = 0 to `most` (at most 4). Kernel k computes a moment
/// from the sums of [`spread_readings`] along one axis. The moment at a node is the sum of w t^k over the readings.
/// Here t is the distance of a reading from the node along this axis, with its sign, and w = exp(-(`scale` t)^2 / 2) is
/// the weight of the reading.
///
/// Each kernel has 2 `taps` + 1 values: one for the node itself and one for each of the `taps` nodes on both sides. t,
/// `step` and `spread` are in standard deviations of the filter weights. `step` is the node spacing. `spread` is the
/// standard deviation of the Gaussian with which [`spread_readings`] has distributed the readings; 0 means not
/// distributed.
///
/// Method: let G be the required Gaussian weight, and S the Gaussian of the distribution. T is the narrower Gaussian
/// with G = S * T, where * is the convolution. Then t^k G is a sum of derivatives of G. Each derivative of G is the
/// convolution of S with the same derivative of T. A derivative of T is a Hermite polynomial times T. Therefore kernel
/// k is a polynomial times T.
fn kernels(most: usize, scale: f64, step: f64, spread: f64, taps: usize) -> Vec<Vec<f64>> {
    let tau = (1.0 - (scale * spread).powi(2)).sqrt();
    let (t1, t2) = (1.0 / tau, 1.0 / (tau * tau));
    (0..=most)
        .map(|k| {
            let sample = |n: usize| {
                let a = scale * step * (n as f64 - taps as f64) * t1;
                let a2 = a * a;
                let polynomial = match k {
                    0 => 1.0,
                    1 => a * t1,
                    2 => (a2 - 1.0) * t2 + 1.0,
                    3 => a * t1 * ((a2 - 3.0) * t2 + 3.0),
                    _ => ((a2 * a2 - 6.0 * a2 + 3.0) * t2 + 6.0 * (a2 - 1.0)) * t2 + 3.0,
                };
                polynomial * (-0.5 * a2).exp() * t1 / scale.powi(k as i32)
            };
            (0..=2 * taps).map(sample).collect()
        })
        .collect()
}

/// Sums along x of one channel (weights, weighted values or squared weights), for each power of x.
struct RowSums {
    columns: usize,
    powers: Vec<Vec<f64>>,
}

impl RowSums {
    fn along_x(channels: &GridSums, channel: &[f64], kernels: &[Vec<f64>]) -> Self {
        let columns = channels.columns - 2 * channels.border[0];
        let powers = kernels
            .iter()
            .map(|kernel| {
                let mut sums = vec![0.0; columns * channels.rows];
                let rows = sums.par_chunks_mut(columns).zip(channel.par_chunks(channels.columns));
                rows.with_min_len(8).for_each(|(out, row)| {
                    // Most rows of the border, and rows in holes, are empty.
                    if row.iter().any(|v| *v != 0.0) {
                        for (tap, factor) in kernel.iter().enumerate() {
                            out.iter_mut().zip(&row[tap..]).for_each(|(sum, v)| *sum += factor * v);
                        }
                    }
                });
                sums
            })
            .collect();
        Self { columns, powers }
    }

    /// Returns the moments at all nodes of the grid row with the index `row`. A moment at a node is the sum of q x^a
    /// y^b over the readings. Here x and y are the distances of a reading from the node, in standard deviations of the
    /// filter weights. q is the weight, the weighted value or the squared weight of the reading; the input of
    /// [`Self::along_x`] determines which of them.
    ///
    /// The outer list has one entry for each pair of exponents a, b with a + b up to `degree`, in the order of
    /// [`moment`]. Each inner list has one value for each node of the row. `kernels` holds the convolution kernels
    /// along y for the powers 0 to `degree` (at least).
    fn along_y(&self, kernels: &[Vec<f64>], degree: usize, row: usize) -> Vec<Vec<f64>> {
        let mut moments = vec![vec![0.0; self.columns]; terms(degree)];
        for (a, sums) in self.powers.iter().enumerate().take(degree + 1) {
            for (b, kernel) in kernels.iter().enumerate().take(degree + 1 - a) {
                let out = &mut moments[moment(a, b)];
                for (tap, factor) in kernel.iter().enumerate() {
                    let line = &sums[(row + tap) * self.columns..][..self.columns];
                    out.iter_mut().zip(line).for_each(|(sum, v)| *sum += factor * v);
                }
            }
        }
        moments
    }
}

/// Summed-area table of the readings: gives the number of readings in any rectangle of nodes.
struct ReadingCounts {
    grid: Grid,
    sums: Vec<u32>,
}

impl ReadingCounts {
    fn new(places: &[[f64; 2]], grid: &Grid) -> Self {
        let columns = grid.columns + 1;
        let mut sums = vec![0u32; columns * (grid.rows + 1)];
        for place in places {
            let [i, j] = [0, 1].map(|k| {
                let last = grid.counts()[k] - 1;
                ((place[k] - grid.first_mm[k]) / grid.spacing_mm[k]).round().clamp(0.0, last as f64) as usize
            });
            sums[(j + 1) * columns + i + 1] += 1;
        }
        for j in 1..=grid.rows {
            let mut along = 0;
            for i in 1..columns {
                along += sums[j * columns + i];
                sums[j * columns + i] = along + sums[(j - 1) * columns + i];
            }
        }
        Self { grid: *grid, sums }
    }

    /// Returns the number of readings in a square about the node in column `i` and row `j`. `half_side_mm` is half of
    /// the side of the square.
    fn within(&self, i: usize, j: usize, half_side_mm: f64) -> u32 {
        let range = |at: usize, k: usize, nodes: usize| {
            let reach = (half_side_mm / self.grid.spacing_mm[k]).round().min(1e9) as usize;
            (at.saturating_sub(reach), (at + reach + 1).min(nodes))
        };
        let ((i0, i1), (j0, j1)) = (range(i, 0, self.grid.columns), range(j, 1, self.grid.rows));
        let sum = |i: usize, j: usize| self.sums[j * (self.grid.columns + 1) + i];
        sum(i1, j1) + sum(i0, j0) - sum(i0, j1) - sum(i1, j0)
    }
}

/// Polynomial over all readings, subtracted before filtering.
pub(super) struct Trend {
    middle: [f64; 2],
    size: f64,
    terms: Vec<f64>,
}

impl Trend {
    /// Fits a polynomial in x and y of at most `degree` (0, 1 or 2) to the readings by least squares. If the readings
    /// do not determine this degree, fits the highest lower degree that they determine. Without readings the polynomial
    /// is 0.
    pub fn fit(places: &[[f64; 2]], values: &[f64], degree: usize) -> Self {
        let [low, high] = bounds(places.iter().copied());
        let middle = [0, 1].map(|k| 0.5 * (low[k] + high[k]));
        let size = 0.5 * (high[0] - low[0]).max(high[1] - low[1]).max(f64::MIN_POSITIVE);
        let mut trend = Self { middle, size, terms: Vec::new() };
        // Readings on a line do not determine a plane; their mean always exists.
        trend.terms =
            (0..=degree).rev().find_map(|degree| trend.solve(places, values, terms(degree))).unwrap_or_default();
        // Second solution on the residuals: normal equations lose half the digits, and this restores them.
        let rest: Vec<f64> = places.iter().zip(values).map(|(p, v)| v - trend.at(*p)).collect();
        let more = trend.solve(places, &rest, trend.terms.len()).unwrap_or_default();
        trend.terms.iter_mut().zip(more).for_each(|(term, more)| *term += more);
        trend
    }

    fn solve(&self, places: &[[f64; 2]], values: &[f64], count: usize) -> Option<Vec<f64>> {
        let mut gram = DMatrix::<f64>::zeros(count, count);
        let mut right = DVector::<f64>::zeros(count);
        for (place, value) in places.iter().zip(values) {
            let basis = self.basis(*place);
            for r in 0..count {
                for c in 0..=r {
                    gram[(r, c)] += basis[r] * basis[c];
                }
                right[r] += basis[r] * value;
            }
        }
        let least = 1e-10 * places.len() as f64;
        let solved = gram.cholesky()?;
        let definite = (0..count).all(|k| solved.l_dirty()[(k, k)].powi(2) > least);
        definite.then(|| solved.solve(&right).as_slice().to_vec())
    }

    fn basis(&self, place: [f64; 2]) -> [f64; 6] {
        let [x, y] = [0, 1].map(|k| (place[k] - self.middle[k]) / self.size);
        [1.0, x, y, x * x, x * y, y * y]
    }

    pub fn at(&self, place: [f64; 2]) -> f64 {
        self.terms.iter().zip(self.basis(place)).map(|(term, basis)| term * basis).sum()
    }

    /// Adds this polynomial to a filtered surface at the nodes of `grid`: its height to `values`, and its slopes along
    /// x and y to `slopes`. Changes only the nodes for whose index `wanted` returns true.
    pub fn put_back(&self, grid: &Grid, wanted: impl Fn(usize) -> bool, values: &mut [f64], slopes: &mut [[f64; 2]]) {
        let term = |k: usize| self.terms.get(k).copied().unwrap_or(0.0);
        for k in (0..grid.len()).filter(|&k| wanted(k)) {
            let place = grid.place_mm(k);
            let [x, y] = [0, 1].map(|a| (place[a] - self.middle[a]) / self.size);
            values[k] += self.at(place);
            slopes[k][0] += (term(1) + 2.0 * term(3) * x + term(4) * y) / self.size;
            slopes[k][1] += (term(2) + term(4) * x + 2.0 * term(5) * y) / self.size;
        }
    }
}

impl FilterResult {
    fn add_trend(&mut self, trend: &Trend) {
        let supported = &self.supported;
        trend.put_back(&self.grid, |k| supported[k], &mut self.values, &mut self.slopes);
    }

    /// Returns `[value, leverage, variance]` of the filter result, interpolated at the place `[x, y]` in millimetres.
    /// The three numbers are described at the fields of [`FilterResult`]. For a place outside the grid, uses the nodes
    /// of the nearest grid cell. Returns `None` if none of the four nodes of the grid cell is supported. A node is
    /// supported if there are enough readings around it, not all of them on one side.
    ///
    /// The interpolation is bilinear. For the value, each of the four nodes contributes its value plus half of the rise
    /// along its slope from the node to the place. This is exact for quadrics, because the second-order errors of
    /// values and slopes cancel. If some of the four nodes are not supported, only the supported nodes contribute, with
    /// the full rise along their slopes.
    pub fn at(&self, place: [f64; 2]) -> Option<[f64; 3]> {
        let grid = &self.grid;
        let [(i, u), (j, v)] = grid.cell(place);
        let corners = [[0, 0], [1, 0], [0, 1], [1, 1]].map(|[a, b]: [usize; 2]| {
            let node = (j + b).min(grid.rows - 1) * grid.columns + (i + a).min(grid.columns - 1);
            let share = (if a == 0 { 1.0 - u } else { u }) * (if b == 0 { 1.0 - v } else { v });
            (node, if self.supported[node] { share } else { 0.0 })
        });
        let total: f64 = corners.iter().map(|(_, share)| share).sum();
        if total < 1e-6 {
            return None;
        }
        // If a corner is missing, the values of the others are extended to the place along their full slopes.
        let along = if total > 1.0 - 1e-9 { 0.5 } else { 1.0 };
        let mut sums = [0.0; 3];
        for (node, share) in corners.into_iter().filter(|(_, share)| *share > 0.0) {
            let [x, y] = grid.place_mm(node);
            let [p, q] = self.slopes[node];
            sums[0] += share * (self.values[node] + along * (p * (place[0] - x) + q * (place[1] - y)));
            sums[1] += share * self.leverage[node];
            sums[2] += share * self.variance[node];
        }
        Some(sums.map(|sum| sum / total))
    }
}
