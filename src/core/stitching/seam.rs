//! Seams: where two maps overlap, how far they agree, and how far they can be trusted to.

use std::collections::{BTreeMap, HashMap};

use nalgebra::{DMatrix, Matrix6};

use super::joint::squared_slope;
use super::normal_equations::MapNoise;
use super::overlap::{OverlapRow, PairRows};
use super::projected_map::ProjectedMap;
use super::scale::Scale;
use crate::geometry::{Point, Pose, Vector};

/// Overlap of two maps after the stitching.
#[derive(Clone, Debug, PartialEq)]
pub struct Seam {
    /// Indices of the maps, from 0, the smaller first.
    pub maps: [usize; 2],
    /// Number of places that were compared.
    pub places: usize,
    /// Number of places that were left out, because the two maps do not agree there.
    pub left_out: usize,
    /// Middle of the overlap in the model frame, in millimetres.
    pub middle: Point,
    /// Mean of the deviation of the first map minus that of the second, in millimetres.
    pub step_mm: f64,
    /// Standard uncertainty of the true step in the middle because of the poses of the maps, in millimetres. The true
    /// step is that of the noise-free maps at their estimated poses; its estimate is 0.
    pub sigma_mm: f64,
    /// Largest standard uncertainty of the true step anywhere in the overlap, in millimetres.
    pub max_sigma_mm: f64,
    /// Root mean square of the differences, in millimetres. Without an error of the maps it is about the noise of a
    /// point, times 1.1 to 1.4.
    pub rms_mm: f64,
    /// Variance of means over blocks of the overlap, as a multiple of that of independent noise; about 1 if the maps
    /// differ by nothing else.
    pub correlation_factor: f64,
}

/// Number of blocks along each side of an overlap within which noise is averaged.
const BLOCKS: f64 = 4.0;

/// Row of a pair, with the sign that makes it the deviation of the smaller map minus that of the larger one.
type SignedRow<'a> = (&'a OverlapRow, &'a PairRows, f64);

/// State of the maps after the last round.
#[derive(Clone, Copy)]
pub(super) struct StitchedMaps<'a> {
    pub(super) pairs: &'a [PairRows],
    pub(super) projected: &'a [ProjectedMap],
    pub(super) noise: &'a [MapNoise],
    pub(super) scale: &'a Scale,
    /// Covariance of the motions.
    pub(super) covariance: &'a DMatrix<f64>,
}

impl StitchedMaps<'_> {
    /// Returns the seam of each pair of maps that overlap. `final_from_model` is the last correction of the frame.
    pub(super) fn seams(&self, final_from_model: &Pose) -> Vec<Seam> {
        by_seam(self.pairs).into_iter().map(|(maps, rows)| self.seam(maps, &rows, final_from_model)).collect()
    }

    fn seam(&self, indices: [usize; 2], rows: &[SignedRow], final_from_model: &Pose) -> Seam {
        let maps = self.projected;
        let count = rows.len() as f64;
        let middle = Point::from(rows.iter().map(|row| place(maps, row).coords).sum::<Vector>() / count);
        let weights: f64 = rows.iter().map(|(row, ..)| row.weight()).sum();
        let step_mm = rows.iter().map(|(row, _, sign)| sign * row.weight() * row.residual_mm).sum::<f64>() / weights;
        let rms_mm = (rows.iter().map(|(row, ..)| row.residual_mm.powi(2)).sum::<f64>() / count).sqrt();
        let distance = |row: &SignedRow| (place(maps, row) - middle).norm_squared();
        let Some(nearest) = rows.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))) else {
            unreachable!("a seam has rows")
        };
        let difference = difference_covariance(self.covariance, indices);
        let slope = self.squared_slope(indices);
        let sigma_mm = |row: &SignedRow| self.sigma_mm(&difference, slope, row);
        let (found, expected) = block_ratio(rows, maps, self.noise);
        let all = self.pairs.iter().filter(|pair| indices.contains(&pair.first) && indices.contains(&pair.second));
        Seam {
            maps: indices,
            places: rows.len(),
            left_out: all.map(|pair| pair.rows.len()).sum::<usize>() - rows.len(),
            middle: final_from_model.transform_point(&place(maps, nearest)),
            step_mm,
            sigma_mm: sigma_mm(nearest),
            max_sigma_mm: rows.iter().map(sigma_mm).fold(0.0, f64::max),
            rms_mm,
            correlation_factor: if expected > 0.0 { found / expected } else { 1.0 },
        }
    }

    /// Returns the standard uncertainty of the step at the place of a row: across the surface, and along it times the
    /// slope of the form.
    fn sigma_mm(&self, difference: &Matrix6<f64>, squared_slope: f64, (row, pair, _): &SignedRow) -> f64 {
        let map = &self.projected[pair.first];
        let (point, normal) = (&map.points[row.point as usize], &map.normals[row.point as usize]);
        let across = (row.jacobian.transpose() * difference * row.jacobian)[0];
        let along = squared_slope * self.scale.lateral_variance(difference, point, normal);
        (across + along).max(0.0).sqrt()
    }

    /// Returns the mean square of the slope of the form in the overlap of two maps.
    fn squared_slope(&self, indices: [usize; 2]) -> f64 {
        let pairs = self.pairs.iter().filter(|pair| indices.contains(&pair.first) && indices.contains(&pair.second));
        let slopes: Vec<f64> = pairs.map(|pair| squared_slope(pair, self.noise[pair.second].sigma_mm)).collect();
        slopes.iter().sum::<f64>() / slopes.len().max(1) as f64
    }

    /// Returns the standard uncertainty of each deviation because of the poses of the maps.
    pub(super) fn placement_sigmas_mm(&self) -> Vec<f64> {
        let of_map = |(k, map): (usize, &ProjectedMap)| -> Vec<f64> {
            let own: Matrix6<f64> = self.covariance.fixed_view::<6, 6>(6 * k, 6 * k).into();
            let slopes: Vec<f64> = (0..self.projected.len())
                .filter(|l| self.pairs.iter().any(|pair| pair.first == k && pair.second == *l))
                .map(|l| self.squared_slope([k, l]))
                .collect();
            let slope = slopes.iter().sum::<f64>() / slopes.len().max(1) as f64;
            let sigma_mm = |(point, normal)| {
                let jacobian = self.scale.jacobian(point, normal);
                let along = slope * self.scale.lateral_variance(&own, point, normal);
                ((jacobian.transpose() * own * jacobian)[0] + along).max(0.0).sqrt()
            };
            map.points.iter().zip(&map.normals).map(sigma_mm).collect()
        };
        self.projected.iter().enumerate().flat_map(of_map).collect()
    }
}

fn by_seam(pairs: &[PairRows]) -> BTreeMap<[usize; 2], Vec<SignedRow<'_>>> {
    let mut seams: BTreeMap<[usize; 2], Vec<SignedRow<'_>>> = BTreeMap::new();
    for pair in pairs {
        let (key, sign) =
            if pair.first < pair.second { ([pair.first, pair.second], 1.0) } else { ([pair.second, pair.first], -1.0) };
        let rows = pair.rows.iter().filter(|row| row.is_used()).map(|row| (row, pair, sign));
        seams.entry(key).or_default().extend(rows);
    }
    seams.retain(|_, rows| !rows.is_empty());
    seams
}

/// Returns for each two maps that overlap the number of places that were left out, and the number of all.
pub(super) fn left_out(pairs: &[PairRows]) -> BTreeMap<[usize; 2], [usize; 2]> {
    let mut counts: BTreeMap<[usize; 2], [usize; 2]> = BTreeMap::new();
    for pair in pairs {
        let key = [pair.first.min(pair.second), pair.first.max(pair.second)];
        let [left_out, places] = counts.entry(key).or_default();
        *left_out += pair.rows.iter().filter(|row| !row.is_used()).count();
        *places += pair.rows.len();
    }
    counts
}

fn place(maps: &[ProjectedMap], (row, pair, _): &SignedRow) -> Point {
    maps[pair.first].feet[row.point as usize]
}

/// Returns the covariance of the difference of the motions of two maps.
fn difference_covariance(covariance: &DMatrix<f64>, [k, l]: [usize; 2]) -> Matrix6<f64> {
    let block = |i: usize, j: usize| -> Matrix6<f64> { covariance.fixed_view::<6, 6>(6 * i, 6 * j).into() };
    block(k, k) + block(l, l) - block(k, l) - block(l, k)
}

/// Returns for each map the variance of means over blocks of its overlaps, as a multiple of that of independent noise:
/// the median over its seams, at least 1. Noise that neighbouring points share, and errors of the map such as of its
/// scale, raise it.
pub(super) fn correlation_factors(pairs: &[PairRows], maps: &[ProjectedMap], noise: &[MapNoise]) -> Vec<f64> {
    let mut ratios: Vec<Vec<f64>> = vec![Vec::new(); maps.len()];
    for (indices, rows) in by_seam(pairs) {
        let (found, expected) = block_ratio(&rows, maps, noise);
        if expected > 0.0 {
            indices.iter().for_each(|&map| ratios[map].push(found / expected));
        }
    }
    let median = |mut ratios: Vec<f64>| {
        ratios.sort_by(f64::total_cmp);
        // An even number of ratios has two in the middle: the larger one counts.
        ratios.get(ratios.len() / 2).copied().unwrap_or(1.0).max(1.0)
    };
    ratios.into_iter().map(median).collect()
}

/// Returns the sum of the squared means over the blocks of a seam, in variances of independent noise, and the sum that
/// is expected.
fn block_ratio(rows: &[SignedRow], maps: &[ProjectedMap], noise: &[MapNoise]) -> (f64, f64) {
    // The fit of the motions takes this many of the means of one seam.
    const FITTED: f64 = 3.0;
    let blocks = blocks(rows, maps);
    let expected = blocks.len() as f64 - FITTED;
    let ratio = |block: &Vec<SignedRow>| {
        let weights: f64 = block.iter().map(|(row, ..)| row.weight()).sum();
        let mean = block.iter().map(|(row, _, sign)| sign * row.weight() * row.residual_mm).sum::<f64>() / weights;
        let mut by_point: HashMap<(usize, u32), f64> = HashMap::new();
        for (row, pair, sign) in block {
            *by_point.entry((pair.first, row.point)).or_default() += sign * row.weight();
            for (&neighbour, w) in row.neighbours.iter().zip(row.weights) {
                *by_point.entry((pair.second, neighbour)).or_default() -= sign * row.weight() * w;
            }
        }
        // In the order of the points, so that rounding does not depend on the order of the table.
        let mut sums: Vec<((usize, u32), f64)> = by_point.into_iter().collect();
        sums.sort_unstable_by_key(|(key, _)| *key);
        let variance: f64 = sums.iter().map(|((map, _), sum)| (sum * noise[*map].sigma_mm).powi(2)).sum();
        mean * mean * weights * weights / variance
    };
    (blocks.iter().map(ratio).sum(), expected.max(0.0))
}

/// Divides the rows of a seam into blocks along the two longest sides of its box.
fn blocks<'a>(rows: &[SignedRow<'a>], maps: &[ProjectedMap]) -> Vec<Vec<SignedRow<'a>>> {
    let places: Vec<Point> = rows.iter().map(|row| place(maps, row)).collect();
    let start = [Vector::repeat(f64::INFINITY), Vector::repeat(f64::NEG_INFINITY)];
    let [low, high] = places.iter().fold(start, |[low, high], p| [low.inf(&p.coords), high.sup(&p.coords)]);
    let size = high - low;
    let mut axes = [0, 1, 2];
    axes.sort_by(|&a, &b| size[b].total_cmp(&size[a]));
    let index =
        |p: &Point, axis: usize| (BLOCKS * (p[axis] - low[axis]) / size[axis].max(1e-300)).min(BLOCKS - 1.0) as usize;
    let mut blocks: BTreeMap<[usize; 2], Vec<SignedRow<'a>>> = BTreeMap::new();
    for (row, p) in rows.iter().zip(&places) {
        blocks.entry([index(p, axes[0]), index(p, axes[1])]).or_default().push(*row);
    }
    blocks.into_values().collect()
}
