//! Isolated points of a map that its other points do not confirm.

use rayon::prelude::*;

use super::overlap::{NEIGHBOURS, quadratic_weights};
use super::projected_map::ProjectedMap;
use crate::geometry::PointTree;

/// Limit of the difference from the neighbours, in robust standard deviations.
const SPIKE_SIGMAS: f64 = 8.0;

/// Largest difference of a neighbour, as a share of that of a spike. Along a step the neighbours differ as much.
const MAX_SHARE: f64 = 0.5;

/// Number of passes: a spike hides smaller ones near it.
const PASSES: usize = 3;

/// Marks points whose deviation is far from the quadratic through their neighbours in the same map, and much farther than
/// those of the neighbours. A spike would spoil every row in which it is a neighbour.
pub(super) fn spikes(map: &ProjectedMap) -> Vec<bool> {
    let mut is_spike = vec![false; map.len()];
    for _ in 0..PASSES {
        let kept: Vec<usize> = (0..map.len()).filter(|&i| map.is_usable[i] && !is_spike[i]).collect();
        if kept.len() <= NEIGHBOURS {
            break;
        }
        let tree = PointTree::new(kept.iter().map(|&i| map.feet[i]));
        let differences: Vec<Option<(f64, [usize; NEIGHBOURS])>> =
            kept.par_iter().map(|&i| difference(map, i, &kept, &tree)).collect();
        let mut sizes: Vec<f64> = differences.iter().flatten().map(|(difference, _)| *difference).collect();
        if sizes.is_empty() {
            break;
        }
        let middle = sizes.len() / 2;
        let sigma = 1.4826 * *sizes.select_nth_unstable_by(middle, f64::total_cmp).1;
        let mut size = vec![0.0; map.len()];
        for (&i, found) in kept.iter().zip(&differences) {
            size[i] = found.map_or(0.0, |(difference, _)| difference);
        }
        let is_far = |&(i, found): &(usize, &Option<(f64, [usize; NEIGHBOURS])>)| {
            found.is_some_and(|(difference, neighbours)| {
                difference > SPIKE_SIGMAS * sigma && neighbours.iter().all(|&j| size[j] < MAX_SHARE * size[i])
            })
        };
        let found: Vec<usize> = kept.iter().copied().zip(&differences).filter(is_far).map(|(i, _)| i).collect();
        if found.is_empty() {
            break;
        }
        found.into_iter().for_each(|i| is_spike[i] = true);
    }
    is_spike
}

/// Returns the difference of a point from its neighbours, in standard deviations of independent noise of 1, and the
/// neighbours. Returns `None` at the border.
fn difference(map: &ProjectedMap, i: usize, kept: &[usize], tree: &PointTree) -> Option<(f64, [usize; NEIGHBOURS])> {
    let found: Vec<(usize, f64)> = tree
        .nearest(&map.feet[i], NEIGHBOURS as u32 + 1)
        .map(|(k, square)| (kept[k], square))
        .filter(|(k, _)| *k != i)
        .take(NEIGHBOURS)
        .collect();
    let reach_mm = found.get(NEIGHBOURS - 1)?.1.sqrt();
    let neighbours: [usize; NEIGHBOURS] = std::array::from_fn(|k| found[k].0);
    let offsets = neighbours.map(|k| map.feet[k] - map.feet[i]);
    let [weights, ..] = quadratic_weights(&offsets, &map.normals[i], reach_mm)?;
    let squares: f64 = weights.iter().map(|w| w * w).sum();
    if squares > 1.0 {
        return None;
    }
    let there: f64 = neighbours.iter().zip(weights).map(|(&k, w)| w * map.deviations_mm[k]).sum();
    Some(((map.deviations_mm[i] - there).abs() / (1.0 + squares).sqrt(), neighbours))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Point, Vector};

    #[test]
    fn single_points_are_spikes_and_steps_are_not() {
        let at = |i: usize| ((i % 40) as f64, (i / 40) as f64);
        let noise = |i: usize| 1e-5 * ((i as f64 * 0.618_034).fract() - 0.5);
        let step = |x: f64| if x > 20.0 { 1e-3 } else { 0.0 };
        let mut deviations: Vec<f64> = (0..1600).map(|i| step(at(i).0) + 1e-4 * at(i).1 + noise(i)).collect();
        for i in [205, 230, 1000] {
            deviations[i] += 5e-3;
        }
        let points: Vec<Point> = (0..1600).map(|i| Point::new(at(i).0, at(i).1, 0.0)).collect();
        let map = ProjectedMap {
            feet: points.clone(),
            normals: vec![Vector::z(); 1600],
            deviations_mm: deviations,
            is_usable: vec![true; 1600],
            points,
        };
        let found = spikes(&map);
        let found: Vec<usize> = (0..1600).filter(|&i| found[i]).collect();
        assert_eq!(found, [205, 230, 1000]);
    }
}
