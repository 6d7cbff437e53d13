//! Seams: where two maps overlap, how far they agree, and how far they can be trusted to.

use std::collections::{BTreeMap, HashMap};

use nalgebra::{DMatrix, Matrix6, Vector6};

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
}

/// Number of blocks along each side of an overlap within which noise is averaged.
const BLOCKS: f64 = 4.0;

/// Row of a pair, with the sign that makes it the deviation of the smaller map minus that of the larger one.
type SignedRow<'a> = (&'a OverlapRow, &'a PairRows, f64);

/// Returns the seam of each pair of maps that overlap. `covariance` is that of the motions, and `final_from_model` the
/// last correction of the frame.
pub(super) fn seams(
    pairs: &[PairRows],
    maps: &[ProjectedMap],
    scale: &Scale,
    covariance: &DMatrix<f64>,
    final_from_model: &Pose,
) -> Vec<Seam> {
    by_seam(pairs)
        .into_iter()
        .map(|(indices, rows)| seam(indices, &rows, maps, scale, covariance, final_from_model))
        .collect()
}

fn by_seam(pairs: &[PairRows]) -> BTreeMap<[usize; 2], Vec<SignedRow<'_>>> {
    let mut seams: BTreeMap<[usize; 2], Vec<SignedRow<'_>>> = BTreeMap::new();
    for pair in pairs {
        let (key, sign) =
            if pair.first < pair.second { ([pair.first, pair.second], 1.0) } else { ([pair.second, pair.first], -1.0) };
        let rows = pair.rows.iter().filter(|row| row.precision > 0.0).map(|row| (row, pair, sign));
        seams.entry(key).or_default().extend(rows);
    }
    seams.retain(|_, rows| !rows.is_empty());
    seams
}

fn place(maps: &[ProjectedMap], (row, pair, _): &SignedRow) -> Point {
    maps[pair.first].feet[row.point as usize]
}

fn seam(
    indices: [usize; 2],
    rows: &[SignedRow],
    maps: &[ProjectedMap],
    scale: &Scale,
    covariance: &DMatrix<f64>,
    final_from_model: &Pose,
) -> Seam {
    let count = rows.len() as f64;
    let middle = Point::from(rows.iter().map(|row| place(maps, row).coords).sum::<Vector>() / count);
    let weights: f64 = rows.iter().map(|(row, ..)| row.weight()).sum();
    let step_mm = rows.iter().map(|(row, _, sign)| sign * row.weight() * row.residual_mm).sum::<f64>() / weights;
    let rms_mm = (rows.iter().map(|(row, ..)| row.residual_mm.powi(2)).sum::<f64>() / count).sqrt();
    let difference = difference_covariance(covariance, indices);
    let sigma_mm = |jacobian: &Vector6<f64>| (jacobian.transpose() * difference * jacobian)[0].max(0.0).sqrt();
    let distance = |row: &SignedRow| (place(maps, row) - middle).norm_squared();
    let nearest = rows.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    let middle_point = nearest.map_or(middle, |row| place(maps, row));
    let normal = nearest.map_or_else(Vector::z, |(row, pair, _)| maps[pair.first].normals[row.point as usize]);
    Seam {
        maps: indices,
        places: rows.len(),
        middle: final_from_model.transform_point(&middle_point),
        step_mm,
        sigma_mm: sigma_mm(&scale.jacobian(&middle_point, &normal)),
        max_sigma_mm: rows.iter().map(|(row, ..)| sigma_mm(&row.jacobian)).fold(0.0, f64::max),
        rms_mm,
    }
}

/// Returns the covariance of the difference of the motions of two maps.
fn difference_covariance(covariance: &DMatrix<f64>, [k, l]: [usize; 2]) -> Matrix6<f64> {
    let block = |i: usize, j: usize| -> Matrix6<f64> { covariance.fixed_view::<6, 6>(6 * i, 6 * j).into() };
    block(k, k) + block(l, l) - block(k, l) - block(l, k)
}

/// Returns the variance of means over blocks of the overlaps, as a multiple of that of independent noise; at least 1.
/// Noise that neighbouring points share, and form that the neighbours do not resolve, raise it.
pub(super) fn correlation_factor(pairs: &[PairRows], maps: &[ProjectedMap], noise_sigma_mm: f64) -> f64 {
    // The fit of the motions takes this many of the means of one seam.
    const FITTED: f64 = 3.0;
    let (mut found, mut expected) = (0.0, 0.0);
    for rows in by_seam(pairs).values() {
        let blocks = blocks(rows, maps);
        let freedom = (blocks.len() as f64 - FITTED) / blocks.len() as f64;
        if freedom <= 0.0 {
            continue;
        }
        for block in &blocks {
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
            let variance = sums.iter().map(|(_, sum)| sum * sum).sum::<f64>() * (noise_sigma_mm / weights).powi(2);
            found += mean * mean / variance;
            expected += freedom;
        }
    }
    if expected > 0.0 { f64::max(1.0, found / expected) } else { 1.0 }
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
