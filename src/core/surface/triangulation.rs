//! Delaunay triangulation of points in a plane, by the spade crate.
//!
//! Spade inserts the points one by one on one thread, so the result does not depend on the number of threads. The points
//! come in the order of a Z-curve, coarse to fine, so that each point is near the one before it. For 451,401 unordered
//! points this takes half the time of spade's bulk load.
//!
//! Every decision is exact: spade uses the adaptive predicates of Shewchuk. Four points on one circle may be divided
//! along either diagonal. The order of insertion decides which one.

use rayon::prelude::*;
use robust::{Coord, orient2d};
use spade::{DelaunayTriangulation, HasPosition, Point2, Triangulation as _};

use super::mesh_topology::BORDER;

/// Triangles and, for each corner, the neighbour across the edge opposite to the corner.
pub(crate) struct Triangles {
    pub(crate) corners: Vec<[u32; 3]>,
    pub(crate) neighbours: Vec<[u32; 3]>,
}

/// Number of points of a level of the insertion order, of which one also belongs to the next coarser level.
const LEVEL_RATIO: u32 = 16;

/// Point to be triangulated.
#[derive(Clone, Copy)]
struct Site {
    place: [f64; 2],
    /// Index of the point in the input.
    index: u32,
}

impl HasPosition for Site {
    type Scalar = f64;

    fn position(&self) -> Point2<f64> {
        self.place.into()
    }
}

impl Triangles {
    /// Computes the Delaunay triangulation of the distinct points `places` of a plane. Neighbours in `places` should be
    /// neighbours in the plane. The corners are indices of `places`, counter-clockwise. Returns no triangles if all
    /// points lie on one line.
    ///
    /// # Panics
    /// Panics if spade refuses a coordinate (`spade::validate_coordinate`).
    pub(crate) fn delaunay(places: &[[f64; 2]]) -> Self {
        let count = places.len();
        let mut delaunay = DelaunayTriangulation::<Site>::with_capacity(count, 3 * count, 2 * count);
        for index in insertion_order(places) {
            let site = Site { place: places[index as usize], index };
            delaunay.insert(site).expect("the coordinates are within the limits of spade");
        }
        let faces: Vec<_> = delaunay.fixed_inner_faces().collect();
        let triangle = |face| {
            let edges = delaunay.face(face).adjacent_edges();
            // Face 0 of spade is the outer one.
            let across = [1, 2, 0].map(|k| edges[k].rev().face().as_inner().map_or(BORDER, |f| f.index() as u32 - 1));
            (edges.map(|edge| edge.from().data().index), across)
        };
        let (corners, neighbours) = faces.into_par_iter().map(triangle).unzip();
        Self { corners, neighbours }
    }
}

/// Returns the indices of `places` in the order of insertion: level by level, coarse to fine. The coarsest level has at
/// most 16 points. In all places, every 16th point belongs to a level above the finest, every 256th to one above that,
/// and so on. Without levels, the time for points on a few lines would grow with the square of their number.
///
/// The first three points do not lie on one line. As long as all inserted points lie on one line, spade sorts all of
/// them for each new point. Returns an empty list if all `places` lie on one line.
fn insertion_order(places: &[[f64; 2]]) -> Vec<u32> {
    let count = places.len() as u32;
    let mut step = LEVEL_RATIO.pow(count.max(1).ilog(LEVEL_RATIO));
    let mut order: Vec<u32> = (0..count).step_by(step as usize).collect();
    while step > 1 {
        let finer = step / LEVEL_RATIO;
        order.extend((0..count).step_by(finer as usize).filter(|k| k % step != 0));
        step = finer;
    }
    let coord = |k: usize| {
        let [x, y] = places[order[k] as usize];
        Coord { x, y }
    };
    let Some(third) = (2..order.len()).find(|&k| orient2d(coord(0), coord(1), coord(k)) != 0.0) else {
        return Vec::new();
    };
    order.swap(2, third);
    order
}

#[cfg(test)]
mod tests {
    use super::super::delaunay::z_curve_order;
    use super::*;

    /// Returns a generator of pseudorandom numbers between 0 and 1 (splitmix64).
    fn noise(mut seed: u64) -> impl FnMut() -> f64 {
        move || {
            seed = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mixed = (seed ^ seed >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            let mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
            (mixed ^ mixed >> 31) as f64 / u64::MAX as f64
        }
    }

    fn scattered(count: usize, seed: u64) -> Vec<[f64; 2]> {
        let mut next = noise(seed);
        (0..count).map(|_| [next(), next()]).collect()
    }

    fn grid(columns: usize, rows: usize) -> Vec<[f64; 2]> {
        (0..columns * rows).map(|k| [(k % columns) as f64 * 0.1, (k / columns) as f64 * 0.1]).collect()
    }

    /// Returns points in five clusters that are far apart; most points lie much closer than `breadth` to their centre.
    fn clustered(count: usize, breadth: f64) -> Vec<[f64; 2]> {
        let (centres, mut next) = (scattered(5, 3), noise(4));
        (0..count).map(|k| centres[k % 5].map(|c| c + breadth * next() * next())).collect()
    }

    fn in_order(places: &[[f64; 2]]) -> Vec<[f64; 2]> {
        z_curve_order(places).into_iter().map(|(_, index)| places[index as usize]).collect()
    }

    /// Triangulates, and proves by the predicates of robust that the triangulation is Delaunay and reaches the convex
    /// hull. Returns the number of triangles, and true if other Delaunay triangulations exist.
    fn checked(places: &[[f64; 2]]) -> (usize, bool) {
        let places = in_order(places);
        let Triangles { corners, neighbours } = Triangles::delaunay(&places);
        let at = |v: u32| {
            let [x, y] = places[v as usize];
            Coord { x, y }
        };
        let (mut border, mut ambiguous) = (0, false);
        for (f, c) in corners.iter().enumerate() {
            let [p, q, r] = c.map(at);
            assert!(orient2d(p, q, r) > 0.0);
            for k in 0..3 {
                let (n, edge) = (neighbours[f][k], [c[(k + 1) % 3], c[(k + 2) % 3]]);
                if n == BORDER {
                    border += 1;
                    let [a, b] = edge.map(at);
                    assert!((0..places.len() as u32).all(|v| orient2d(a, b, at(v)) >= 0.0), "an edge of the hull");
                    continue;
                }
                let back = neighbours[n as usize].iter().position(|&n| n == f as u32);
                let (across, j) = (corners[n as usize], back.expect("neighbours know each other"));
                assert_eq!([across[(j + 2) % 3], across[(j + 1) % 3]], edge);
                // A triangulation that is locally Delaunay at every edge is Delaunay.
                let within = robust::incircle(p, q, r, at(across[j]));
                assert!(within <= 0.0);
                ambiguous |= within == 0.0;
            }
        }
        if !corners.is_empty() {
            assert_eq!(corners.len() + border + 2, 2 * places.len(), "Euler");
        }
        (corners.len(), ambiguous)
    }

    #[test]
    fn edges_unique_without_cocircular() {
        for count in (3..60).chain([1000, 30_000]) {
            assert!(!checked(&scattered(count, count as u64)).1, "{count} points");
        }
        let mut next = noise(9);
        let rough: Vec<_> = grid(120, 90).into_iter().map(|p| p.map(|c| c + 1e-3 * next())).collect();
        assert!(!checked(&rough).1);
        for breadth in [1e-3, 1e-7, 1e-11] {
            assert!(!checked(&clustered(12_000, breadth)).1, "clusters of {breadth}");
        }
    }

    #[test]
    fn edges_of_cocircular_and_grid_points() {
        assert!(checked(&grid(150, 110)).1);
        checked(&grid(2, 500));
        checked(&grid(500, 2));
        // A rotated grid, whose lines are straight only to rounding.
        let (s, c) = 0.3f64.sin_cos();
        checked(&grid(130, 70).iter().map(|[u, v]| [c * u - s * v, s * u + c * v]).collect::<Vec<_>>());
        let circle = |k: usize| [(k as f64).cos(), (k as f64).sin()];
        checked(&(0..5000).map(circle).collect::<Vec<_>>());
        // All points but one on a line: along v, along u, oblique.
        for [du, dv] in [[0.0, 1.0], [1.0, 0.0], [1.0, 3.0]] {
            let line = (0..2000).map(|k| [f64::from(k) * du, f64::from(k) * dv]);
            checked(&line.chain([[500.5, 200.25]]).collect::<Vec<_>>());
        }
    }

    #[test]
    fn edges_of_small_integer_points() {
        let mut next = noise(1);
        for _ in 0..4000 {
            let (count, size) = (3 + (9.0 * next()) as usize, 2.0 + 4.0 * next());
            let mut places: Vec<[f64; 2]> = (0..count).map(|_| [0; 2].map(|_| (size * next()).floor())).collect();
            places.sort_by(|a, b| a.partial_cmp(b).unwrap());
            places.dedup();
            if places.len() >= 3 {
                checked(&places);
            }
        }
    }

    #[test]
    fn edges_of_collinear_points() {
        for [du, dv] in [[0.0, 1.0], [1.0, 0.0], [1.0, 2.0]] {
            let line: Vec<_> = (0..300).map(|k| [f64::from(k) * du, f64::from(k) * dv]).collect();
            assert_eq!(checked(&line).0, 0);
        }
    }

    #[test]
    fn edges_of_points_far_from_origin() {
        let far: Vec<_> = scattered(3000, 5).into_iter().map(|[u, v]| [1e9 + u, -1e9 + v]).collect();
        let mut places = in_order(&far);
        places.dedup();
        checked(&places);
    }

    #[test]
    fn delaunay_of_points_on_few_lines() {
        let count = 100_000;
        let lines =
            |n: usize| in_order(&(0..count).map(|k| [(k / n) as f64, (k % n) as f64 * 5e3]).collect::<Vec<_>>());
        assert_eq!(Triangles::delaunay(&lines(1)).corners.len(), 0);
        assert_eq!(Triangles::delaunay(&[&lines(1)[..], &[[0.3, 7.0]]].concat()).corners.len(), count - 1);
        assert_eq!(Triangles::delaunay(&lines(2)).corners.len(), count - 2);
    }

    #[test]
    fn delaunay_same_on_any_number_of_threads() {
        let places = in_order(&grid(120, 90));
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| Triangles::delaunay(&places))
        };
        let (one, three) = (on(1), on(3));
        assert_eq!((one.corners, one.neighbours), (three.corners, three.neighbours));
    }
}
