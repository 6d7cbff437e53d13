//! Robust Gaussian filter (ISO 16610-71) and detection of readings that do not belong to the surface.
//!
//! The filter gives readings far from the filtered surface less weight, by Tukey's biweight (1 - (r / c)^2)^2 with
//! c = 4.4 median |r|, and repeats until c changes by less than 1 % or after fifteen rounds.
//!
//! **Outliers.** Near a reading the surface leans towards it, the more the fewer other readings are around. With the
//! share l of the reading in the value at its place, and the variance v of that value, a residual r has the variance
//! sigma^2 (1 - 2 l + v); z = r / sqrt(1 - 2 l + v) has the same variance everywhere. Sigma is 1.4826 median |z|. A
//! reading with |z| above the limit is an outlier, unless one of its eight neighbours is off to the same side by at
//! least half the limit and a quarter of the height. That is a feature of the part, or dirt of the same size; no rule
//! for single points can separate the two. A repeated reading of the same place is not a neighbour. As the surface
//! leans towards a wide feature, heights are also measured from the plane through the readings around it.

use nalgebra::{Matrix3, Vector3};
use regrind_figures::statistics::median;

use super::filter::{FilterResult, GaussianFilter};
use crate::geometry::{Grid, Point, PointTree};

/// Maximum number of rounds of the robust filter.
const ROUNDS: usize = 15;
/// Relative change of c below which the filter has converged.
const SETTLED: f64 = 0.01;
/// Ratio of the limit c to the median of the absolute residuals.
const BIWEIGHT: f64 = 4.4;
/// Ratio of the standard deviation to the median of the absolute values, for a normal distribution.
const SIGMA_OVER_MEDIAN: f64 = 1.482_602_218_505_602;
/// Minimum freedom of a residual: the ratio of its variance to the variance of a reading. A residual with less freedom
/// carries no information on its reading.
const MIN_FREEDOM: f64 = 0.02;
/// Minimum number of readings for a noise estimate to compare with.
const MIN_READINGS: usize = 20;
/// Minimum scale of the residuals, in millimetres; below it they are rounding of the files, not outliers.
const MIN_SCALE_MM: f64 = 1e-6;
/// Minimum share of the limit by which a neighbour must be off to confirm a reading.
const MIN_LIMIT_SHARE: f64 = 0.5;
/// Minimum share of the height of a reading by which a neighbour must be off to confirm it.
const MIN_HEIGHT_SHARE: f64 = 0.25;
/// Number of nearest readings that are examined around a reading. The plane of comparison is fitted to those of them
/// that are no neighbours.
const AROUND: usize = 48;
/// Maximum distance of a neighbour along both axes, in spacings: on a grid there are eight.
const NEIGHBOUR: f64 = 1.5;
/// Distance along both axes, in spacings, below which readings are repeats of one place; they carry no information on
/// the places around.
const SAME_PLACE: f64 = 0.25;

/// Result of the robust filter.
///
/// All vectors have one entry for each reading, in the order of the readings.
#[derive(Clone, Debug)]
pub(super) struct RobustResult {
    pub filtered: FilterResult,
    /// Weight of every reading.
    pub weights: Vec<f64>,
    /// Residual of every reading; `NaN` where there is no surface.
    pub residuals: Vec<f64>,
    /// Residual divided by the square root of its freedom; `NaN` if the freedom is below [`MIN_FREEDOM`].
    pub scaled_residuals: Vec<f64>,
    /// Standard deviation of one reading.
    pub sigma: f64,
    /// Number of times that the filter was applied.
    pub rounds: usize,
}

/// Residuals of readings from a filtered surface.
pub(super) struct Residuals {
    /// Reading minus surface; `NaN` where there is no surface.
    pub values: Vec<f64>,
    /// Freedom: ratio of the variance of a residual to the variance of a reading.
    pub freedom: Vec<f64>,
}

/// Returns the residual (reading minus surface) of each reading, and the freedom of each residual: the ratio of its
/// variance to the variance of a reading. The residual is NaN and the freedom is 0 where `filtered` has no value.
///
/// `filtered` must be the result of filtering these readings (`places` and `values`) with these `weights`. If `weights`
/// is `None`, all weights are 1.
pub(super) fn residuals(
    filtered: &FilterResult,
    places: &[[f64; 2]],
    values: &[f64],
    weights: Option<&[f64]>,
) -> Residuals {
    use rayon::prelude::*;
    let each = |k: usize| match filtered.at(places[k]) {
        Some([value, leverage, variance]) => {
            let share = weights.map_or(1.0, |w| w[k]) * leverage;
            (values[k] - value, (1.0 - 2.0 * share + variance).max(0.0))
        }
        None => (f64::NAN, 0.0),
    };
    let (plain, freedom) = (0..places.len()).into_par_iter().with_min_len(512).map(each).unzip();
    Residuals { values: plain, freedom }
}

impl Residuals {
    fn scaled(&self) -> Vec<f64> {
        let each = |(r, f): (&f64, &f64)| if *f < MIN_FREEDOM { f64::NAN } else { r / f.sqrt() };
        self.values.iter().zip(&self.freedom).map(each).collect()
    }

    /// Estimates the standard deviation of one reading: the square root of the ratio (sum of the squared residuals) /
    /// (sum of the freedoms). The freedom of a residual is the ratio of its variance to the variance of a reading.
    /// Residuals that are NaN or have a freedom of at most 0.02 are omitted. Returns 0 if none remains.
    pub fn sigma(&self) -> f64 {
        let known = (0..self.values.len()).filter(|&k| self.freedom[k] > MIN_FREEDOM && self.values[k].is_finite());
        let (squares, freedom) = known.fold((0.0, 0.0), |(s, f), k| (s + self.values[k].powi(2), f + self.freedom[k]));
        if freedom > 0.0 { (squares / freedom).sqrt() } else { 0.0 }
    }
}

/// Applies the robust Gaussian filter of ISO 16610-71 to scattered readings: a reading far from the filtered surface
/// gets less weight. `places` are the positions `[x, y]` of the readings, `values` their heights. `gaussian` is the
/// filter to apply in each round, and the result is computed at the nodes of `grid`.
///
/// Returns the filtered surface, and weight and residual of each reading.
pub(super) fn filter_robust(
    gaussian: &GaussianFilter,
    places: &[[f64; 2]],
    values: &[f64],
    grid: &Grid,
) -> RobustResult {
    let again = |weights: &[f64]| gaussian.filter_scattered(places, values, Some(weights), grid);
    let compare = |filtered: &FilterResult, weights: Option<&[f64]>| residuals(filtered, places, values, weights);
    iterate(gaussian.filter_scattered(places, values, None, grid), values.len(), again, compare)
}

/// Filters the readings repeatedly until the weights converge or after fifteen rounds (iteratively reweighted least
/// squares). Each round computes new weights from the residuals and filters the readings with these weights.
///
/// `first` is the filtered surface with all weights 1. `count` is the number of readings. `again` filters the readings
/// with the weights that it is given. `compare` returns the residuals of the readings from a filtered surface; its
/// second argument holds the weights of that surface, or `None` if all are 1.
pub(super) fn iterate(
    first: FilterResult,
    count: usize,
    again: impl Fn(&[f64]) -> FilterResult,
    compare: impl Fn(&FilterResult, Option<&[f64]>) -> Residuals,
) -> RobustResult {
    let mut filtered = first;
    let mut weights = vec![1.0; count];
    let mut found = compare(&filtered, None);
    let mut scale = f64::NAN;
    let mut rounds = 1;
    while rounds < ROUNDS {
        let c = BIWEIGHT * median_size(&found.values);
        // NaN, at first, is not converged; a surface without residuals is.
        if c == 0.0 || (c - scale).abs() <= SETTLED * c {
            break;
        }
        scale = c;
        let weigh = |r: &f64| if r.abs() < c { (1.0 - (r / c).powi(2)).powi(2) } else { 0.0 };
        // A reading without a surface around it keeps its weight: it may be the first of one.
        weights = found.values.iter().map(|r| if r.is_nan() { 1.0 } else { weigh(r) }).collect();
        filtered = again(&weights);
        found = compare(&filtered, Some(&weights));
        rounds += 1;
    }
    let scaled = found.scaled();
    let sigma = SIGMA_OVER_MEDIAN * median_size(&scaled);
    RobustResult { filtered, weights, residuals: found.values, scaled_residuals: scaled, sigma, rounds }
}

/// Readings far from the filtered surface, by their indices, ascending.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct FarReadings {
    /// Readings that no neighbour confirms: they do not belong to the surface.
    pub outliers: Vec<usize>,
    /// Readings that a neighbour confirms.
    pub features: Vec<usize>,
}

impl RobustResult {
    /// Finds the readings that are far from the filtered surface and divides them into outliers and features of the
    /// part. Returns the indices of the outliers and the indices of the features, each in ascending order. Both lists
    /// are empty if there are fewer than 20 readings.
    ///
    /// A reading is far if its scaled residual exceeds `limit` times the standard deviation of one reading. The scaled
    /// residual is the residual divided by the square root of its freedom (the ratio of the variance of the residual to
    /// the variance of a reading). A far reading is a feature if a neighbouring reading confirms it: the neighbour
    /// deviates to the same side, by at least half of this limit and at least a quarter as much. Otherwise the far
    /// reading is an outlier.
    ///
    /// `places` and `values` are the positions and heights of the readings. `apart` is the usual distance between
    /// neighbouring readings along x and along y.
    ///
    /// Returns `None` if more than a tenth of the readings would be outliers, because then the surface itself is
    /// doubtful.
    pub fn find_far(
        &self,
        (places, values): (&[[f64; 2]], &[f64]),
        limit: f64,
        apart: [f64; 2],
    ) -> Option<FarReadings> {
        if places.len() < MIN_READINGS {
            return Some(FarReadings::default());
        }
        let limit = limit * self.sigma.max(MIN_SCALE_MM);
        let size = |k: usize| self.scaled_residuals[k].abs();
        let mut off: Vec<usize> = (0..places.len()).filter(|&k| size(k) > MIN_LIMIT_SHARE * limit).collect();
        off.sort_by(|&a, &b| places[a][0].total_cmp(&places[b][0]));
        let far = (0..off.len()).filter(|&n| size(off[n]) > limit);
        let (mut features, alone): (Vec<usize>, Vec<usize>) =
            far.partition(|&n| self.is_feature(n, &off, places, apart));
        features.iter_mut().for_each(|n| *n = off[*n]);
        let mut outliers = Vec::new();
        if !alone.is_empty() {
            let around = ReadingIndex { places, values, tree: PointTree::new(places.iter().map(on_plane)), apart };
            let least = MIN_LIMIT_SHARE * limit;
            for k in alone.into_iter().map(|n| off[n]) {
                if around.is_confirmed(k, self.scaled_residuals[k].signum(), least) {
                    features.push(k)
                } else {
                    outliers.push(k)
                }
            }
        }
        features.sort_unstable();
        outliers.sort_unstable();
        (outliers.len() * 10 <= places.len()).then_some(FarReadings { outliers, features })
    }

    /// Returns true if a neighbour confirms that one reading belongs to a feature of the part. The index of this
    /// reading is `off[n]`. A neighbour confirms it if the residual of the neighbour has the same sign and at least a
    /// quarter of the size. The neighbours are the readings at the eight surrounding nodes of a grid. Only the readings
    /// in `off` are considered.
    ///
    /// `off` holds the indices of all readings with a large residual, sorted by x. `places` are the positions of all
    /// readings. `apart` is the usual distance between neighbouring readings along x and along y.
    fn is_feature(&self, n: usize, off: &[usize], places: &[[f64; 2]], apart: [f64; 2]) -> bool {
        let k = off[n];
        let away = |j: usize| [0, 1].map(|axis| places[j][axis] - places[k][axis]);
        let agrees = |j: &usize| {
            is_neighbour(away(*j), apart)
                && self.scaled_residuals[*j] * self.scaled_residuals[k].signum()
                    >= MIN_HEIGHT_SHARE * self.scaled_residuals[k].abs()
        };
        let in_reach = |j: &&usize| away(**j)[0].abs() <= NEIGHBOUR * apart[0];
        let mut before = off[..n].iter().rev().take_while(in_reach);
        let mut after = off[n + 1..].iter().take_while(in_reach);
        before.any(agrees) || after.any(agrees)
    }
}

/// Returns true if two readings are neighbours, as one of the eight surrounding nodes of a grid. `away` is the distance
/// between the two readings along x and y. `apart` is the usual distance between neighbouring readings along x and y.
///
/// The distance must be at most 1.5 spacings along both axes. Returns false if it is at most 0.25 spacings along both
/// axes: this is a repeated reading of the same place.
fn is_neighbour(away: [f64; 2], apart: [f64; 2]) -> bool {
    is_within(away, apart, NEIGHBOUR) && !is_within(away, apart, SAME_PLACE)
}

fn is_within(away: [f64; 2], apart: [f64; 2], distances: f64) -> bool {
    (0..2).all(|axis| away[axis].abs() <= distances * apart[axis])
}

/// Readings indexed by their places.
struct ReadingIndex<'r> {
    places: &'r [[f64; 2]],
    values: &'r [f64],
    tree: PointTree,
    apart: [f64; 2],
}

impl ReadingIndex<'_> {
    /// Returns true if a neighbour confirms that the reading with the index `k` is a feature of the part. The height of
    /// each reading is measured from a plane, which is fitted to nearby readings that are not neighbours of reading
    /// `k`.
    ///
    /// The height of the neighbour must be at least `least`, and at least a quarter of the height of reading `k`.
    /// `side` is 1 for a reading above the surface, and -1 for one below. Returns false if the nearby readings do not
    /// determine a plane.
    fn is_confirmed(&self, k: usize, side: f64, least: f64) -> bool {
        let own = on_plane(&self.places[k]);
        let near = self.tree.nearest(&own, AROUND as u32 + 1).map(|(other, _)| other).filter(|other| *other != k);
        let away = |other: usize| [0, 1].map(|a| self.places[other][a] - self.places[k][a]);
        let (near, around): (Vec<usize>, Vec<usize>) =
            near.partition(|other| is_within(away(*other), self.apart, NEIGHBOUR));
        let row = |other: usize| {
            let [x, y] = away(other);
            Vector3::new(1.0, x, y)
        };
        let (mut gram, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for &other in &around {
            gram += row(other) * row(other).transpose();
            right += row(other) * self.values[other];
        }
        let Some(plane) = gram.cholesky().map(|gram| gram.solve(&right)) else { return false };
        let height = |of: usize| side * (self.values[of] - row(of).dot(&plane));
        let agrees = |other: usize| height(other) >= least.max(MIN_HEIGHT_SHARE * height(k));
        near.into_iter().any(|other| is_neighbour(away(other), self.apart) && agrees(other))
    }
}

fn on_plane(&[x, y]: &[f64; 2]) -> Point {
    Point::new(x, y, 0.0)
}

/// Returns the median of the absolute values, ignoring NaN; 0 if there are no values.
fn median_size(values: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = values.iter().filter(|v| !v.is_nan()).map(|v| v.abs()).collect();
    median(&mut sizes).unwrap_or(0.0)
}
