//! The robust Gaussian filter (ISO 16610-71) and the readings that do not belong to the surface.
//!
//! Readings far from the filtered surface are weighed less, by Tukey's biweight (1 - (r / c)^2)^2 with c = 4.4 median |r|, and the filter is
//! applied again, until c changes by less than 1 % or fifteen rounds are over.
//!
//! **Outliers.** Near a reading the surface leans towards it, the more the fewer others are about. With the share l of the
//! reading in the value at its place, and the variance v of that value, a residual r has the variance sigma^2 (1 - 2 l + v);
//! z = r / sqrt(1 - 2 l + v) scatters alike everywhere. Sigma is 1.4826 median |z|. What has |z| above the limit is an outlier
//! unless one of its eight neighbours is off to the same side too, by half the limit and a quarter of the height at least: that is a feature of
//! the part, or dirt as large as one, and no point rule can tell which. A place that is touched again is not its own neighbour. As the surface leans towards a wide feature, heights are also told from
//! the plane through what was read around.

use nalgebra::{Matrix3, Vector3};

use super::filter::{Filtered, Gaussian};
use crate::geometry::{Grid, Nearest, Point};

/// Most rounds of the robust filter.
const ROUNDS: usize = 15;
/// Change of the scale at which it has settled.
const SETTLED: f64 = 0.01;
/// c over the median of the residuals.
const BIWEIGHT: f64 = 4.4;
/// Standard deviation over the median of the absolute values, of a normal distribution.
const SIGMA_OVER_MEDIAN: f64 = 1.482_602_218_505_602;
/// Below this share of its variance a residual tells nothing about its reading.
const LEAST_FREEDOM: f64 = 0.02;
/// Fewer readings than this have no scatter to compare with.
const LEAST_READINGS: usize = 20;
/// Residuals below this are rounding of the files, not outliers, in millimetres.
const LEAST_SCALE_MM: f64 = 1e-6;
/// A neighbour that is off by these shares of the limit and of the height of a reading found the same as it.
const SHARE_OF_LIMIT: f64 = 0.5;
const SHARE_OF_HEIGHT: f64 = 0.25;
/// Readings about one, of which those that are no neighbours tell what is usual there.
const AROUND: usize = 48;
/// What is within so many distances of neighbours along both axes is a neighbour: eight are, on a grid.
const NEIGHBOUR: f64 = 1.5;
/// Readings nearer than so many distances along both axes are one place, touched again: they say nothing of the places around.
const SAME_PLACE: f64 = 0.25;

/// The robust filter's result.
#[derive(Clone, Debug)]
pub(super) struct Robust {
    pub filtered: Filtered,
    /// Weight of every reading.
    pub weights: Vec<f64>,
    /// Residual of every reading; `NaN` where the surface is not known.
    pub plain: Vec<f64>,
    /// The same over the square root of its freedom; `NaN` where it tells nothing.
    pub scaled: Vec<f64>,
    /// Standard deviation of one reading.
    pub sigma: f64,
    /// How often the filter was applied.
    pub rounds: usize,
}

/// Residuals of readings from a filtered surface.
pub(super) struct Residuals {
    /// Reading less surface; `NaN` where the surface is not known.
    pub plain: Vec<f64>,
    /// Variance of a residual over that of a reading.
    pub freedom: Vec<f64>,
}

/// Compares readings with the surface that was filtered from them.
pub(super) fn residuals(
    filtered: &Filtered,
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
    Residuals { plain, freedom }
}

impl Residuals {
    fn scaled(&self) -> Vec<f64> {
        let each = |(r, f): (&f64, &f64)| if *f < LEAST_FREEDOM { f64::NAN } else { r / f.sqrt() };
        self.plain.iter().zip(&self.freedom).map(each).collect()
    }

    /// Returns the standard deviation of one reading: the residuals' sum of squares over their freedom.
    pub fn sigma(&self) -> f64 {
        let known = (0..self.plain.len()).filter(|&k| self.freedom[k] > LEAST_FREEDOM && self.plain[k].is_finite());
        let (squares, freedom) = known.fold((0.0, 0.0), |(s, f), k| (s + self.plain[k].powi(2), f + self.freedom[k]));
        if freedom > 0.0 { (squares / freedom).sqrt() } else { 0.0 }
    }
}

/// Applies the robust filter.
pub(super) fn robust(gaussian: &Gaussian, places: &[[f64; 2]], values: &[f64], grid: &Grid) -> Robust {
    let again = |weights: &[f64]| gaussian.scattered(places, values, Some(weights), grid);
    let compare = |filtered: &Filtered, weights: Option<&[f64]>| residuals(filtered, places, values, weights);
    iterate(gaussian.scattered(places, values, None, grid), values.len(), again, compare)
}

/// Filters and weighs by turns, from the plain filter's result.
pub(super) fn iterate(
    first: Filtered,
    count: usize,
    again: impl Fn(&[f64]) -> Filtered,
    compare: impl Fn(&Filtered, Option<&[f64]>) -> Residuals,
) -> Robust {
    let mut filtered = first;
    let mut weights = vec![1.0; count];
    let mut found = compare(&filtered, None);
    let mut scale = f64::NAN;
    let mut rounds = 1;
    while rounds < ROUNDS {
        let c = BIWEIGHT * median_size(&found.plain);
        // NaN, at first, is not settled; a surface without residuals is.
        if c == 0.0 || (c - scale).abs() <= SETTLED * c {
            break;
        }
        scale = c;
        let weigh = |r: &f64| if r.abs() < c { (1.0 - (r / c).powi(2)).powi(2) } else { 0.0 };
        // A reading without a surface about it keeps its weight: it may be the first of one.
        weights = found.plain.iter().map(|r| if r.is_nan() { 1.0 } else { weigh(r) }).collect();
        filtered = again(&weights);
        found = compare(&filtered, Some(&weights));
        rounds += 1;
    }
    let scaled = found.scaled();
    let sigma = SIGMA_OVER_MEDIAN * median_size(&scaled);
    Robust { filtered, weights, plain: found.plain, scaled, sigma, rounds }
}

/// Readings that are far from the filtered surface, by their indices, ascending.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Far {
    /// Those that are alone, and do not belong to the surface.
    pub outliers: Vec<usize>,
    /// Those that a neighbour agrees with.
    pub features: Vec<usize>,
}

impl Robust {
    /// Returns the readings that are far from the surface.
    ///
    /// `apart` is the distance of neighbouring readings along x and y. `None` where more than a tenth would be outliers: such readings are
    /// no exception, and the surface has no other rule.
    pub fn far(&self, (places, values): (&[[f64; 2]], &[f64]), limit: f64, apart: [f64; 2]) -> Option<Far> {
        if places.len() < LEAST_READINGS {
            return Some(Far::default());
        }
        let limit = limit * self.sigma.max(LEAST_SCALE_MM);
        let size = |k: usize| self.scaled[k].abs();
        let mut off: Vec<usize> = (0..places.len()).filter(|&k| size(k) > SHARE_OF_LIMIT * limit).collect();
        off.sort_by(|&a, &b| places[a][0].total_cmp(&places[b][0]));
        let far = (0..off.len()).filter(|&n| size(off[n]) > limit);
        let (mut features, alone): (Vec<usize>, Vec<usize>) =
            far.partition(|&n| self.is_feature(n, &off, places, apart));
        features.iter_mut().for_each(|n| *n = off[*n]);
        let mut outliers = Vec::new();
        if !alone.is_empty() {
            let around = Around { places, values, tree: Nearest::of(places.iter().map(on_plane)), apart };
            let least = SHARE_OF_LIMIT * limit;
            for k in alone.into_iter().map(|n| off[n]) {
                if around.agrees(k, self.scaled[k].signum(), least) { features.push(k) } else { outliers.push(k) }
            }
        }
        features.sort_unstable();
        outliers.sort_unstable();
        (outliers.len() * 10 <= places.len()).then_some(Far { outliers, features })
    }

    /// Whether one of the eight neighbours is off too, to the same side; `off` is sorted along x.
    fn is_feature(&self, n: usize, off: &[usize], places: &[[f64; 2]], apart: [f64; 2]) -> bool {
        let k = off[n];
        let away = |j: usize| [0, 1].map(|axis| places[j][axis] - places[k][axis]);
        let agrees = |j: &usize| {
            is_beside(away(*j), apart)
                && self.scaled[*j] * self.scaled[k].signum() >= SHARE_OF_HEIGHT * self.scaled[k].abs()
        };
        let in_reach = |j: &&usize| away(**j)[0].abs() <= NEIGHBOUR * apart[0];
        let mut before = off[..n].iter().rev().take_while(in_reach);
        let mut after = off[n + 1..].iter().take_while(in_reach);
        before.any(agrees) || after.any(agrees)
    }
}

/// Whether a place so far away along x and y is that of a neighbour, neither the same place nor beyond the eight around it.
fn is_beside(away: [f64; 2], apart: [f64; 2]) -> bool {
    is_within(away, apart, NEIGHBOUR) && !is_within(away, apart, SAME_PLACE)
}

fn is_within(away: [f64; 2], apart: [f64; 2], distances: f64) -> bool {
    (0..2).all(|axis| away[axis].abs() <= distances * apart[axis])
}

/// Readings by their places.
struct Around<'r> {
    places: &'r [[f64; 2]],
    values: &'r [f64],
    tree: Nearest,
    apart: [f64; 2],
}

impl Around<'_> {
    /// Whether a neighbour of a reading stands over the plane through what is around both too, by `least` and by a quarter of the reading's height.
    fn agrees(&self, k: usize, side: f64, least: f64) -> bool {
        let own = on_plane(&self.places[k]);
        let near = self.tree.to(&own, AROUND as u32 + 1).map(|(other, _)| other).filter(|other| *other != k);
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
        let agrees = |other: usize| height(other) >= least.max(SHARE_OF_HEIGHT * height(k));
        near.into_iter().any(|other| is_beside(away(other), self.apart) && agrees(other))
    }
}

fn on_plane(&[x, y]: &[f64; 2]) -> Point {
    Point::new(x, y, 0.0)
}

/// Returns the median of the absolute values, of those that are numbers; 0 of none.
fn median_size(values: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = values.iter().filter(|v| !v.is_nan()).map(|v| v.abs()).collect();
    if sizes.is_empty() {
        return 0.0;
    }
    let middle = sizes.len() / 2;
    *sizes.select_nth_unstable_by(middle, f64::total_cmp).1
}
