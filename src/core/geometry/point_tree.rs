//! Search for the points nearest to a place.

use nabo::{CandidateContainer, KDTree, NotNan, Parameters};

use super::Point;

/// Search tree of points, for queries of the nearest ones.
#[derive(Debug)]
pub(crate) struct PointTree(KDTree<f64, TreePoint>);

impl PointTree {
    /// Builds a k-d tree of `points`, for the search of nearest points. A point with a coordinate that is not finite is
    /// not removed: NaN is replaced by 0, and an infinite coordinate by a very large one.
    pub(crate) fn new(points: impl Iterator<Item = Point>) -> Self {
        // With 16 points in a leaf the tree is built faster than with 8, and a query takes the same time.
        Self(KDTree::new_with_bucket_size(&points.map(TreePoint::from).collect::<Vec<_>>(), 16))
    }

    /// Returns the `count` points of the tree that are nearest to `p`, in ascending order of distance. Each entry has
    /// the index of the point in the sequence given to [`PointTree::new`], and the squared distance from `p` in mm^2.
    /// Returns all points if the tree has fewer than `count`.
    pub(crate) fn nearest(&self, p: &Point, count: u32) -> impl Iterator<Item = (usize, f64)> {
        let exact = Parameters { epsilon: 0.0, max_radius: f64::INFINITY, allow_self_match: true, sort_results: true };
        // For some tens of neighbours a list is faster than the crate's default, a heap.
        let found = self.0.knn_advanced(count, &TreePoint::from(*p), CandidateContainer::Linear, &exact, None);
        found.into_iter().map(|n| (n.index as usize, *n.dist2))
    }
}

/// Point in the form that the tree needs.
#[derive(Clone, Copy, Debug, Default)]
struct TreePoint([NotNan<f64>; 3]);

impl From<Point> for TreePoint {
    fn from(p: Point) -> Self {
        /// Limit of the coordinates: squares of larger ones would overflow.
        const MAX_COORDINATE: f64 = 1e100;
        Self(
            <[f64; 3]>::from(p)
                .map(|c| NotNan::new(spread(c.clamp(-MAX_COORDINATE, MAX_COORDINATE))).unwrap_or_default()),
        )
    }
}

/// Rounds a coordinate so that two different ones always have a number between them. The tree is cut at the middle of
/// two coordinates; if this were one of the two, the cut would never end.
fn spread(c: f64) -> f64 {
    const MIN_MAGNITUDE: f64 = 1e-200;
    if c.abs() < MIN_MAGNITUDE { 0.0 } else { f64::from_bits(c.to_bits() & !0b11) }
}

impl nabo::Point<f64> for TreePoint {
    const DIM: u32 = 3;

    fn set(&mut self, axis: u32, value: NotNan<f64>) {
        self.0[axis as usize] = value;
    }

    fn get(&self, axis: u32) -> NotNan<f64> {
        self.0[axis as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearest_points_match_brute_force() {
        let at = |k: usize| [0.754_877_666, 0.569_840_291, 0.381_966_011].map(|step| (k as f64 * step).fract()).into();
        let mut points: Vec<Point> = (0..3000).map(at).collect();
        // Some points twice, and many at one place.
        points.extend_from_within(..40);
        points.extend([at(5000); 50]);
        let tree = PointTree::new(points.iter().copied());
        for place in (2990..3100).map(at).chain([Point::new(9.0, -9.0, 9.0)]) {
            let mut exact: Vec<f64> = points.iter().map(|p| (p - place).norm_squared()).collect();
            let found: Vec<(usize, f64)> = tree.nearest(&place, 25).collect();
            assert!(found.iter().all(|&(k, square)| (exact[k] - square).abs() < 1e-12));
            exact.sort_by(f64::total_cmp);
            assert_eq!(found.len(), 25);
            assert!(found.iter().zip(exact).all(|((_, square), exact)| (exact - square).abs() < 1e-12));
        }
    }

    #[test]
    fn neighbouring_numbers_are_divided() {
        for (low, high) in
            [(1.0f64, 1.0f64.next_up()), (0.0, 5e-324), (-5e-324, 5e-324), (1e-310, 2e-310), (8.0f64.next_down(), 8.0)]
        {
            let points = (0..100).map(|i| Point::new(if i % 2 == 0 { low } else { high }, 7.0, 7.0));
            assert_eq!(PointTree::new(points).nearest(&Point::new(low, 7.0, 7.0), 20).count(), 20);
        }
    }

    #[test]
    fn nearest_of_few_and_non_finite_points() {
        assert_eq!(PointTree::new([].into_iter()).nearest(&Point::origin(), 4).count(), 0);
        let two = PointTree::new([Point::origin(), Point::new(3.0, 0.0, 0.0)].into_iter());
        assert_eq!(two.nearest(&Point::new(2.0, 0.0, 0.0), 4).collect::<Vec<_>>(), [(1, 1.0), (0, 4.0)]);
        let strange = [f64::NAN, f64::INFINITY, f64::MIN, 1.0].map(|c| Point::new(c, f64::MAX, 0.0));
        assert_eq!(PointTree::new(strange.into_iter().cycle().take(100)).nearest(&strange[0], 1).count(), 1);
    }
}
