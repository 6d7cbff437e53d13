//! The way up a hill of two dimensions, and how much of it lies where.

use std::collections::BTreeMap;

use nalgebra::{Matrix2, SymmetricEigen, Vector2};
use rayon::prelude::*;

/// How far beside its top a hill is looked at to see how it falls, and the longest that an axis of it is.
const BESIDE: f64 = 0.1;
const WIDEST: f64 = 1.0;
/// What is lower than the top by so much is as good as nothing, and so many axes away at most; what is nearer than so much of one is the same.
const NOTHING: f64 = 3.0;
const FURTHEST: i32 = 5;
const NEAR: f64 = 0.75;

/// How many places stand for all, where these spread by one or more, and at least.
const MOST: f64 = 10.0;
const LEAST: f64 = 3.0;

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

/// What belongs to the top of a hill.
pub(super) struct Hill {
    /// Takes what lies between two places to the axes of the top.
    in_axes: Matrix2<f64>,
    /// Places all over it, each with the logarithm of the volume beneath its surroundings, where the height is that of a logarithm.
    pub(super) places: Vec<([f64; 2], f64)>,
}

impl Hill {
    /// Looks at what belongs to a top, and to none before it.
    ///
    /// The places lie on a grid along the axes of the top, a standard deviation apart, out to where the hill is as good as nothing (Rue, Martino and
    /// Chopin 2009, 3.1).
    pub(super) fn around(top: [f64; 2], before: &[&Self], height: impl Fn([f64; 2]) -> f64 + Sync) -> Self {
        let axes = axes(top, &height);
        let in_axes = axes.try_inverse().unwrap_or_else(Matrix2::identity);
        let at = |[a, b]: [i32; 2]| {
            let place = Vector2::from(top) + axes * Vector2::new(f64::from(a), f64::from(b));
            [place.x, place.y]
        };
        let mut seen = BTreeMap::new();
        let mut highest = f64::NEG_INFINITY;
        let mut next = vec![[0, 0]];
        while !next.is_empty() {
            let of = |&node: &[i32; 2]| match at(node) {
                place if before.iter().any(|hill| hill.has(place)) => f64::NEG_INFINITY,
                place => height(place),
            };
            let heights: Vec<f64> = next.par_iter().map(of).collect();
            highest = heights.iter().copied().fold(highest, f64::max);
            let rim: Vec<[i32; 2]> =
                next.iter().zip(&heights).filter(|(_, of)| highest - **of < NOTHING).map(|(node, _)| *node).collect();
            seen.extend(next.iter().copied().zip(heights));
            let beside = |[a, b]: [i32; 2]| [[a - 1, b], [a + 1, b], [a, b - 1], [a, b + 1]];
            next = rim.into_iter().flat_map(beside).collect();
            next.sort_unstable();
            next.dedup();
            next.retain(|node| !seen.contains_key(node) && node.iter().all(|steps| steps.abs() <= FURTHEST));
        }
        let area = axes.determinant().abs().ln();
        let places =
            seen.into_iter().filter(|(_, of)| of.is_finite()).map(|(node, of)| (at(node), of + area)).collect();
        Self { in_axes, places }
    }

    /// Whether a place lies in the surroundings of one of it.
    fn has(&self, place: [f64; 2]) -> bool {
        let near = |of: &[f64; 2]| (self.in_axes * (Vector2::from(place) - Vector2::from(*of))).amax() < NEAR;
        self.places.iter().any(|(of, _)| near(of))
    }
}

/// Some of the places on hills, of which [`Hill::around`] tells the volumes, that stand for all of them, each so many times: at even steps of the volume.
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
fn axes(top: [f64; 2], height: &(impl Fn([f64; 2]) -> f64 + Sync)) -> Matrix2<f64> {
    let highest = height(top);
    let beside = |a: f64, b: f64| highest - height([top[0] + a * BESIDE, top[1] + b * BESIDE]);
    let steps = [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]];
    let falls: Vec<f64> = steps.par_iter().map(|[a, b]| beside(*a, *b)).collect();
    // Where the hill ends on one side it goes there as it does on the other.
    let both = |a: f64, b: f64| match [a, b].map(f64::is_finite) {
        [true, true] => a + b,
        [true, false] => 2.0 * a,
        [false, true] => 2.0 * b,
        [false, false] => 0.0,
    };
    let bends: Vec<f64> = falls.chunks(2).map(|pair| both(pair[0], pair[1]).clamp(-1e3, 1e3)).collect();
    let across = (bends[2] - bends[3]) / 4.0;
    let bends = Matrix2::new(bends[0], across, across, bends[1]) / BESIDE.powi(2);
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
        let all = Hill::around([1.0, -1.5], &[], hill).places;
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
            Hill::around([3.0, 0.0], &[], hill)
                .places
                .into_iter()
                .map(move |(at, v)| (what, at, v + higher))
                .collect::<Vec<_>>()
        };
        // The second weighs three times as much.
        let both: Vec<_> = of('a', 0.0).into_iter().chain(of('b', 3.0_f64.ln())).collect();
        let some = some_for_all(&both);
        let times = |what| some.iter().filter(|(of, ..)| *of == what).map(|(.., times)| times).sum::<f64>();
        assert_eq!(times('a') + times('b'), MOST);
        assert!((times('b') - 0.75 * MOST).abs() <= 0.5, "{}", times('b'));
        assert_eq!(some_for_all(&[('a', [1.0, 2.0], -700.0)]), [('a', [1.0, 2.0], LEAST)], "one for all");
        assert_eq!(some_for_all::<char>(&[]), []);
        assert_eq!(Hill::around([0.0, 0.0], &[], |_| f64::NEG_INFINITY).places, [], "no hill");
    }

    fn volume(of: &[([f64; 2], f64)]) -> f64 {
        of.iter().map(|(_, of)| of.exp()).sum()
    }

    #[test]
    fn a_hill_that_ends_beside_its_top_is_as_wide_as_it_is() {
        for beside in [0.0, 0.03, 0.09] {
            let hill = |[x, y]: [f64; 2]| match x < -beside {
                true => f64::NEG_INFINITY,
                false => -0.5 * (x / 0.4).powi(2) - 0.5 * (y / 0.5).powi(2),
            };
            let found = volume(&Hill::around([0.0, 0.0], &[], hill).places);
            // Half of it is there.
            let half = 0.5 * std::f64::consts::TAU * 0.4 * 0.5;
            assert!((0.8 * half..1.7 * half).contains(&found), "{beside}: {found}, {half}");
        }
    }

    #[test]
    fn what_belongs_to_a_top_belongs_to_no_other() {
        let one = |[x, y]: [f64; 2], at: f64| -0.5 * ((x - at).powi(2) + y.powi(2)) / 0.09;
        let hills = |place| (one(place, 0.0).exp() + (one(place, 1.6) - 2.0).exp()).ln();
        let first = Hill::around([0.0, 0.0], &[], hills);
        let second = Hill::around([1.6, 0.0], &[&first], hills);
        let whole = std::f64::consts::TAU * 0.09;
        let (first_has, second_has) = (volume(&first.places) / whole, volume(&second.places) / whole);
        let (rest, all) = ((-2.0_f64).exp(), 1.0 + (-2.0_f64).exp());
        assert!((first_has + second_has - all).abs() < 0.1 * all, "{first_has} and {second_has}");
        assert!(second_has < 1.1 * rest, "{second_has}");
        let again = Hill::around([0.1, 0.1], &[&first, &second], hills);
        assert!(volume(&again.places) < 0.05 * whole, "{:?}", again.places);
    }
}
