//! The way up a hill of two dimensions, and how much of it lies where.

use std::collections::BTreeMap;

use nalgebra::{Matrix2, SymmetricEigen, Vector2};
use rayon::prelude::*;

/// How far beside its top a hill is looked at to see how it falls, and the longest that an axis of it is.
const BESIDE: f64 = 0.1;
const WIDEST: f64 = 1.0;
/// What is lower than the top by so much is as good as nothing, and so many axes away at most.
const NOTHING: f64 = 3.0;
const FURTHEST: i32 = 5;

/// How many places stand for all, where these spread by one or more, and at least.
const MOST: f64 = 8.0;
const LEAST: f64 = 2.0;

/// Climbs to the highest place of two dimensions by a simplex (Nelder and Mead 1965).
///
/// It begins with a simplex of some steps, and ends with one that is smaller than `near`.
pub(super) fn climb(start: [f64; 2], steps: [f64; 2], near: f64, height: impl Fn([f64; 2]) -> f64) -> ([f64; 2], f64) {
    const TURNS: usize = 120;
    let seen = |place: [f64; 2]| (place, height(place));
    let mut corners = [seen(start), seen([start[0] + steps[0], start[1]]), seen([start[0], start[1] + steps[1]])];
    for _ in 0..TURNS {
        corners.sort_by(|a, b| b.1.total_cmp(&a.1));
        let [best, middle, worst] = corners;
        let spread =
            (0..2).map(|k| (best.0[k] - worst.0[k]).abs().max((best.0[k] - middle.0[k]).abs())).fold(0.0, f64::max);
        if spread < near {
            break;
        }
        let centre = [0, 1].map(|k| 0.5 * (best.0[k] + middle.0[k]));
        let along = |factor: f64| [0, 1].map(|k| centre[k] + factor * (centre[k] - worst.0[k]));
        let reflected = seen(along(1.0));
        let replaced = if reflected.1 > best.1 {
            let further = seen(along(2.0));
            if further.1 > reflected.1 { further } else { reflected }
        } else if reflected.1 > middle.1 {
            reflected
        } else {
            let nearer = seen(along(if reflected.1 > worst.1 { 0.5 } else { -0.5 }));
            if nearer.1 <= worst.1.max(reflected.1) {
                for corner in &mut corners[1..] {
                    *corner = seen([0, 1].map(|k| 0.5 * (corner.0[k] + best.0[k])));
                }
                continue;
            }
            nearer
        };
        corners[2] = replaced;
    }
    corners.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((start, f64::NEG_INFINITY))
}

/// Places all over the top of a hill, each with the logarithm of the volume beneath its surroundings, where the height is that of a logarithm.
///
/// They lie on a grid along the axes of the top, a standard deviation apart, out to where the hill is as good as nothing (Rue, Martino and Chopin
/// 2009, 3.1).
pub(super) fn around(top: [f64; 2], height: impl Fn([f64; 2]) -> f64 + Sync) -> Vec<([f64; 2], f64)> {
    let highest = height(top);
    if !highest.is_finite() {
        return Vec::new();
    }
    let axes = axes(top, highest, &height);
    let at = |[a, b]: [i32; 2]| {
        let place = Vector2::from(top) + axes * Vector2::new(f64::from(a), f64::from(b));
        [place.x, place.y]
    };
    let mut seen = BTreeMap::from([([0, 0], highest)]);
    let mut rim = vec![[0, 0]];
    while !rim.is_empty() {
        let beside = |[a, b]: [i32; 2]| [[a - 1, b], [a + 1, b], [a, b - 1], [a, b + 1]];
        let mut next: Vec<[i32; 2]> = rim.iter().copied().flat_map(beside).collect();
        next.sort_unstable();
        next.dedup();
        next.retain(|node| !seen.contains_key(node) && node.iter().all(|steps| steps.abs() <= FURTHEST));
        let heights: Vec<f64> = next.par_iter().map(|&node| height(at(node))).collect();
        seen.extend(next.iter().copied().zip(heights.iter().copied()));
        rim = next.into_iter().zip(heights).filter(|(_, of)| highest - of < NOTHING).map(|(node, _)| node).collect();
    }
    let area = axes.determinant().abs().ln();
    seen.into_iter().filter(|(_, of)| of.is_finite()).map(|(node, of)| (at(node), of + area)).collect()
}

/// Some of the places on hills, of which `around` tells the volumes, that stand for all of them, each so many times: at even steps of the volume.
pub(super) fn some_for_all<T: Copy>(hills: &[(T, [f64; 2], f64)]) -> Vec<(T, [f64; 2], f64)> {
    let highest = hills.iter().map(|(.., volume)| *volume).fold(f64::NEG_INFINITY, f64::max);
    let weights: Vec<f64> = hills.iter().map(|(.., volume)| (volume - highest).exp()).collect();
    let whole: f64 = weights.iter().sum();
    let mean = |of: &dyn Fn([f64; 2]) -> f64| {
        hills.iter().zip(&weights).map(|((_, place, _), weight)| weight / whole * of(*place)).sum::<f64>()
    };
    let variance = |axis: usize| mean(&|place| place[axis].powi(2)) - mean(&|place| place[axis]).powi(2);
    let spread = (variance(0) + variance(1)).max(0.0).sqrt();
    let count = (MOST * spread).ceil().clamp(LEAST, MOST);
    let mut passed = 0.5;
    let mut some = Vec::new();
    for ((what, place, _), weight) in hills.iter().zip(&weights) {
        let before: f64 = passed;
        passed += count * weight / whole;
        let times = passed.floor() - before.floor();
        if times > 0.0 {
            some.push((*what, *place, times));
        }
    }
    some
}

/// The axes of the top of a hill, a column each, as long as the standard deviation along it.
fn axes(top: [f64; 2], highest: f64, height: &(impl Fn([f64; 2]) -> f64 + Sync)) -> Matrix2<f64> {
    let beside = |a: f64, b: f64| (highest - height([top[0] + a * BESIDE, top[1] + b * BESIDE])).clamp(-1e3, 1e3);
    let steps = [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]];
    let fall: Vec<f64> = steps.par_iter().map(|[a, b]| beside(*a, *b)).collect();
    let across = (fall[4] + fall[5] - fall[6] - fall[7]) / 4.0;
    let bends = Matrix2::new(fall[0] + fall[1], across, across, fall[2] + fall[3]) / BESIDE.powi(2);
    let SymmetricEigen { eigenvalues, eigenvectors } = bends.symmetric_eigen();
    let long = eigenvalues.map(|bend| bend.max(WIDEST.powi(-2)).powf(-0.5));
    eigenvectors * Matrix2::from_diagonal(&long)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hill_is_climbed() {
        let hill = |[x, y]: [f64; 2]| -(x - 1.0).powi(2) - 30.0 * (y + 2.0 - 0.3 * x).powi(2);
        let (top, height) = climb([-3.0, 4.0], [0.7, 0.9], 1e-4, hill);
        assert!((top[0] - 1.0).abs() < 1e-3 && (top[1] + 1.7).abs() < 1e-3 && height > -1e-6, "{top:?}");
    }
    #[test]
    fn the_volume_of_a_hill_lies_where_it_is() {
        let hill = |[x, y]: [f64; 2]| -0.5 * ((x - 1.0) / 0.3).powi(2) - 0.5 * ((y + 2.0 - 0.5 * x) / 0.1).powi(2);
        let all = around([1.0, -1.5], hill);
        let whole: f64 = all.iter().map(|(_, of)| of.exp()).sum();
        let volume = std::f64::consts::TAU * 0.3 * 0.1;
        assert!((whole / volume - 1.0).abs() < 0.05, "{whole}, {volume}");
        let mean = |of: &dyn Fn([f64; 2]) -> f64| all.iter().map(|(at, w)| w.exp() * of(*at)).sum::<f64>() / whole;
        let (x, y) = (mean(&|[x, _]| x), mean(&|[_, y]| y));
        assert!((x - 1.0).abs() < 1e-6 && (y + 1.5).abs() < 1e-6, "{x}, {y}");
        let u = mean(&|[x, _]| (x - 1.0).powi(2)).sqrt();
        assert!((u / 0.3 - 1.0).abs() < 0.05, "{u}");
    }

    #[test]
    fn some_places_stand_for_all_as_often_as_they_weigh() {
        let hill = |[x, y]: [f64; 2]| -0.5 * (x - 3.0).powi(2) - 0.5 * y.powi(2);
        let of = |what: char, higher: f64| {
            around([3.0, 0.0], hill).into_iter().map(move |(at, v)| (what, at, v + higher)).collect::<Vec<_>>()
        };
        // The second weighs three times as much.
        let both: Vec<_> = of('a', 0.0).into_iter().chain(of('b', 3.0_f64.ln())).collect();
        let some = some_for_all(&both);
        let times = |what| some.iter().filter(|(of, ..)| *of == what).map(|(.., times)| times).sum::<f64>();
        assert_eq!((times('a'), times('b')), (2.0, 6.0));
        assert_eq!(some_for_all(&[('a', [1.0, 2.0], -700.0)]), [('a', [1.0, 2.0], LEAST)], "one for all");
        assert_eq!(some_for_all::<char>(&[]), []);
        assert_eq!(around([0.0, 0.0], |_| f64::NEG_INFINITY), [], "no hill");
    }
}
