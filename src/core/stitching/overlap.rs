//! Overlap of two maps: differences of their deviations at the same places.

use std::collections::HashMap;

use nalgebra::{SMatrix, SVector, Vector6};
use rayon::prelude::*;

use super::projected_map::ProjectedMap;
use super::scale::Scale;
use crate::geometry::{Point, PointTree, Vector};

/// Number of neighbours that the deviation of the other map is estimated from.
pub(super) const NEIGHBOURS: usize = 12;

/// Maximum number of points of a map that are compared with other maps.
const MAX_COMPARED: usize = 40_000;

/// Maximum distance of the farthest neighbour, as a multiple of its median within the other map.
const MAX_REACH: f64 = 1.6;

/// Maximum sum of squared weights: a place at or beyond the border of the other map has a larger one.
const MAX_SQUARED_WEIGHTS: f64 = 1.0;

/// Difference of the deviations of two maps at the place of a point of the first.
pub(super) struct OverlapRow {
    /// Index of the point in the first map.
    pub(super) point: u32,
    /// Indices of the neighbours in the second map, and their weights. The sum of the weights is 1.
    pub(super) neighbours: [u32; NEIGHBOURS],
    pub(super) weights: [f64; NEIGHBOURS],
    /// Sum of the squares of the weights.
    pub(super) squared_weights: f64,
    /// Deviation of the point minus the deviation of the second map there.
    pub(super) residual_mm: f64,
    /// Derivative of the residual by the motion of the first map; by that of the second it is the opposite.
    pub(super) jacobian: Vector6<f64>,
    /// Square of the slope of the second map's deviations.
    pub(super) squared_slope: f64,
    /// Sum of the squares of the weights by which this slope comes from the deviations, in 1/mm^2.
    pub(super) squared_slope_weights: f64,
    /// Inverse of the variance of the residual, in 1/mm^2; 0 for a row that is left out.
    pub(super) precision: f64,
    /// Two, divided by the number of maps at the place.
    share: f64,
}

impl OverlapRow {
    /// Returns the weight of the row in a sum of squares.
    pub(super) fn weight(&self) -> f64 {
        self.precision * self.share
    }

    pub(super) fn is_used(&self) -> bool {
        self.precision > 0.0
    }
}

/// Rows of the points of one map over another one.
pub(super) struct PairRows {
    /// Index of the map of the points.
    pub(super) first: usize,
    /// Index of the map of the neighbours.
    pub(super) second: usize,
    pub(super) rows: Vec<OverlapRow>,
}

impl PairRows {
    /// Takes the residuals from new deviations of the same points.
    pub(super) fn update(&mut self, maps: &[ProjectedMap]) {
        let (first, second) = (&maps[self.first], &maps[self.second]);
        for row in &mut self.rows {
            let pairs = row.neighbours.iter().zip(row.weights);
            let other: f64 = pairs.map(|(&j, w)| w * second.deviations_mm[j as usize]).sum();
            row.residual_mm = first.deviations_mm[row.point as usize] - other;
        }
    }
}

/// Returns the rows of all ordered pairs of maps that overlap.
pub(super) fn overlap_rows(maps: &[ProjectedMap], scale: &Scale) -> Vec<PairRows> {
    let there: Vec<Neighbourhood> = maps.par_iter().map(Neighbourhood::new).collect();
    let pairs: Vec<(usize, usize)> =
        (0..maps.len()).flat_map(|k| (0..maps.len()).filter(move |l| *l != k).map(move |l| (k, l))).collect();
    let rows = |&(first, second): &(usize, usize)| {
        let rows = pair_rows(&maps[first], &maps[second], &there[second], scale);
        (!rows.is_empty()).then_some(PairRows { first, second, rows })
    };
    let mut found: Vec<PairRows> = pairs.par_iter().filter_map(rows).collect();
    share_places(&mut found, maps.len());
    found
}

/// Divides the weights of the rows at a place by the number of maps there. With m maps, the squares of all differences
/// add up to m times the squares of the differences from the mean, which least squares with a free form has.
fn share_places(pairs: &mut [PairRows], map_count: usize) {
    let mut others: Vec<HashMap<u32, u32>> = vec![HashMap::new(); map_count];
    for pair in pairs.iter() {
        pair.rows.iter().for_each(|row| *others[pair.first].entry(row.point).or_default() += 1);
    }
    for pair in pairs {
        pair.rows.iter_mut().for_each(|row| row.share = 2.0 / f64::from(1 + others[pair.first][&row.point]));
    }
}

/// Search tree of the projections of a map that are on the part.
struct Neighbourhood {
    tree: PointTree,
    /// Index in the map of each point of the tree.
    indices: Vec<u32>,
    /// Largest distance of a farthest neighbour within the map.
    max_reach_mm: f64,
    bounds: [Point; 2],
}

impl Neighbourhood {
    fn new(map: &ProjectedMap) -> Self {
        const SAMPLES: usize = 200;
        let indices: Vec<u32> = (0..map.len()).filter(|&i| map.is_usable[i]).map(|i| i as u32).collect();
        let feet = || indices.iter().map(|&i| map.feet[i as usize]);
        let tree = PointTree::new(feet());
        let step = (indices.len() / SAMPLES).max(1);
        let reach = |p: Point| Some(tree.nearest(&p, NEIGHBOURS as u32).last()?.1.sqrt());
        let mut reaches: Vec<f64> = feet().step_by(step).filter_map(reach).collect();
        reaches.sort_by(f64::total_cmp);
        let max_reach_mm = MAX_REACH * reaches.get(reaches.len() / 2).copied().unwrap_or(0.0);
        let start = [Vector::repeat(f64::INFINITY), Vector::repeat(f64::NEG_INFINITY)].map(Point::from);
        let bounds = feet().fold(start, |[low, high], p| [low.inf(&p), high.sup(&p)]);
        Self { tree, indices, max_reach_mm, bounds }
    }

    /// Tells whether a place can be above the map.
    fn can_reach(&self, p: &Point) -> bool {
        let margin = Vector::repeat(self.max_reach_mm);
        let [low, high] = self.bounds;
        p >= &(low - margin) && p <= &(high + margin)
    }
}

fn pair_rows(first: &ProjectedMap, second: &ProjectedMap, there: &Neighbourhood, scale: &Scale) -> Vec<OverlapRow> {
    if there.indices.len() < NEIGHBOURS {
        return Vec::new();
    }
    let is_compared = |i: &usize| first.is_usable[*i] && first.is_sampled(*i, MAX_COMPARED);
    let compared: Vec<usize> =
        (0..first.len()).filter(is_compared).filter(|&i| there.can_reach(&first.feet[i])).collect();
    compared.par_iter().filter_map(|&i| row(first, i, second, there, scale)).collect()
}

fn row(
    first: &ProjectedMap,
    i: usize,
    second: &ProjectedMap,
    there: &Neighbourhood,
    scale: &Scale,
) -> Option<OverlapRow> {
    let (place, normal) = (first.feet[i], first.normals[i]);
    let found: Vec<(usize, f64)> = there.tree.nearest(&place, NEIGHBOURS as u32).collect();
    let reach_mm = found.last()?.1.sqrt();
    if found.len() < NEIGHBOURS || reach_mm > there.max_reach_mm {
        return None;
    }
    let neighbours: [u32; NEIGHBOURS] = std::array::from_fn(|j| there.indices[found[j].0]);
    let offsets = neighbours.map(|j| second.feet[j as usize] - place);
    let [weights, x, y] = quadratic_weights(&offsets, &normal, reach_mm)?;
    let squares = |weights: &[f64; NEIGHBOURS]| weights.iter().map(|w| w * w).sum::<f64>();
    let squared_weights = squares(&weights);
    if squared_weights > MAX_SQUARED_WEIGHTS {
        return None;
    }
    let sum = |weights: &[f64; NEIGHBOURS]| -> f64 {
        neighbours.iter().zip(weights).map(|(&j, w)| w * second.deviations_mm[j as usize]).sum()
    };
    Some(OverlapRow {
        point: i as u32,
        neighbours,
        weights,
        squared_weights,
        residual_mm: first.deviations_mm[i] - sum(&weights),
        jacobian: scale.jacobian(&first.points[i], &normal),
        squared_slope: sum(&x).powi(2) + sum(&y).powi(2),
        squared_slope_weights: squares(&x) + squares(&y),
        precision: 1.0,
        share: 1.0,
    })
}

/// Returns the weights by which values at `offsets` from a place give the value there and its two slopes, per
/// millimetre: those of the quadratic of least squares over the tangent plane. Returns `None` if the neighbours do not
/// determine it.
pub(super) fn quadratic_weights(
    offsets: &[Vector; NEIGHBOURS],
    normal: &Vector,
    reach_mm: f64,
) -> Option<[[f64; NEIGHBOURS]; 3]> {
    let across = if normal.x.abs() < 0.6 { Vector::x() } else { Vector::y() };
    let x = across.cross(normal).normalize() / reach_mm;
    let y = normal.cross(&x);
    let mut design = SMatrix::<f64, NEIGHBOURS, 6>::zeros();
    for (j, offset) in offsets.iter().enumerate() {
        let (u, v) = (offset.dot(&x), offset.dot(&y));
        design.set_row(j, &SMatrix::<f64, 1, 6>::from([1.0, u, v, u * u, u * v, v * v]));
    }
    let factor = (design.transpose() * design).cholesky()?;
    let weights = [0, 1, 2].map(|k| -> [f64; NEIGHBOURS] {
        let mut wanted = SVector::<f64, 6>::zeros();
        wanted[k] = if k == 0 { 1.0 } else { 1.0 / reach_mm };
        (design * factor.solve(&wanted)).into()
    });
    weights.iter().flatten().all(|w| w.is_finite()).then_some(weights)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The weights are exact for a quadratic, and their sum is 1.
    #[test]
    fn weights_reproduce_quadratic() {
        let offsets: [Vector; NEIGHBOURS] = std::array::from_fn(|j| {
            let t = j as f64;
            Vector::new((2.4 * t).cos() * (0.3 + 0.1 * t), (2.4 * t).sin() * (0.3 + 0.1 * t), 0.0)
        });
        let [weights, x, y] = quadratic_weights(&offsets, &Vector::z(), 1.5).unwrap();
        let value = |p: &Vector| 3.0 + 0.5 * p.x - p.y + 2.0 * p.x * p.x - 0.7 * p.x * p.y + 0.1 * p.y * p.y;
        let found = |weights: [f64; NEIGHBOURS]| offsets.iter().zip(weights).map(|(p, w)| w * value(p)).sum::<f64>();
        assert!((found(weights) - 3.0).abs() < 1e-12);
        assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        assert!((found(x).hypot(found(y)) - 0.5f64.hypot(1.0)).abs() < 1e-12);
        // Twelve points on a line determine no quadratic.
        let line: [Vector; NEIGHBOURS] = std::array::from_fn(|j| Vector::new(j as f64, 0.0, 0.0));
        let weights = quadratic_weights(&line, &Vector::z(), 11.0);
        assert!(weights.is_none_or(|[w, ..]| w.iter().map(|w| w * w).sum::<f64>() > MAX_SQUARED_WEIGHTS));
    }
}
