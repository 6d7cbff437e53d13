//! Triangulation of scattered points in the plane of their projection.

use std::collections::HashMap;

use rayon::prelude::*;
use spade::{MIN_ALLOWED_VALUE, validate_coordinate};

use crate::geometry::{Point, bounds, find_far_off};

use super::error::SurfaceError;
use super::mesh_topology::BORDER;
use super::plane_projection::Projector;
use super::triangulation::Triangles;

/// Minimum ratio of height to border edge of a border triangle. A flatter triangle is a needle of the convex hull, not
/// a piece of the surface.
const NEEDLE: f64 = 0.05;

/// Maximum ratio of the longest edge of a triangle to the usual edge length around its corners. A triangle with a
/// longer edge bridges a hole.
const BRIDGE: f64 = 6.0;

/// Maximum ratio of the extent of the points to the side of a square that the same number of points would fill at the
/// usual distance. In a wider cloud a point far from the others is searched for.
const WIDE: f64 = 100.0;

/// Minimum ratio of the distance of two points to the usual edge length. Nearer points are near-duplicates.
const TWINS: f64 = 1e-4;

/// Triangulates scattered points by the Delaunay method in a plane. The projector `map` projects the points to this
/// plane. Then removes flat triangles at the convex hull, and triangles that bridge holes.
///
/// Shapes: returns the points in a new order and the triangles. The order follows a Z-curve, so that neighbours in the
/// plane are mostly neighbours in memory. The corners of a triangle are indices of the returned points,
/// counter-clockwise in the plane.
///
/// # Errors
/// Returns an error if a coordinate is not finite or is too large, if two points coincide or nearly coincide in the
/// plane, if all points lie on one line, or if one point is far from all other points.
pub(crate) fn triangulate(points: &[Point], map: &Projector) -> Result<(Vec<Point>, Triangles), SurfaceError> {
    let places: Vec<[f64; 2]> = points.par_iter().map(|p| map.project(p).0.map(flushed_to_zero)).collect();
    if let Some(index) = places.iter().position(|p| p.iter().any(|c| validate_coordinate(*c).is_err())) {
        return Err(SurfaceError::NotFinite { index });
    }
    let along = z_curve_order(&places);
    let ordered: Vec<[f64; 2]> = along.par_iter().map(|(_, index)| places[*index as usize]).collect();
    if ordered.windows(2).any(|w| w[0] == w[1]) {
        return Err(first_duplicate(points, &places));
    }
    let triangles = Triangles::delaunay(&ordered);
    if triangles.corners.is_empty() {
        return Err(SurfaceError::Collinear { points: points.len() });
    }
    let lengths = EdgeLengths::new(&triangles, &ordered);
    if let Some(twins) = find_near_duplicates(&triangles, &lengths, &ordered) {
        let [first, second] = twins.map(|k| along[k as usize].1 as usize);
        let apart_mm = (points[first] - points[second]).norm();
        let (first, second) = (first.min(second), first.max(second));
        return Err(SurfaceError::NearDuplicates { first, second, at: points[first].into(), apart_mm });
    }
    let [low, high] = bounds(ordered.iter().copied());
    if (high[0] - low[0]).max(high[1] - low[1]) > WIDE * lengths.median_max_edge * (points.len() as f64).sqrt()
        && let Some((index, distance_mm)) = find_far_off(points)
    {
        return Err(SurfaceError::FarOff { index, at: points[index].into(), distance_mm });
    }
    let triangles = without_bridges_and_needles(triangles, &lengths, &ordered);
    Ok((along.par_iter().map(|(_, index)| points[*index as usize]).collect(), triangles))
}

/// Returns one pair per point (u, v) of `places`: the key of the point on a Z-curve (Morton order), and the index of
/// the point in `places`. The pairs are sorted by key. Pairs with equal keys are sorted by u, then by v.
pub(crate) fn z_curve_order(places: &[[f64; 2]]) -> Vec<(u64, u32)> {
    let [low, high] = bounds(places.iter().copied());
    let per_mm = [0, 1].map(|k: usize| f64::from(u32::MAX) / (high[k] - low[k]));
    let key = |p: &[f64; 2]| {
        // Rounding is monotonic, so that the lower of two cells holds the lower places.
        let [u, v] = [0, 1].map(|k| ((p[k] - low[k]) * per_mm[k]) as u32);
        spread_bits(u) | spread_bits(v) << 1
    };
    let mut along: Vec<(u64, u32)> = places.par_iter().enumerate().map(|(i, p)| (key(p), i as u32)).collect();
    along.par_sort_unstable();
    let place = |(_, index): &(u64, u32)| places[*index as usize];
    for run in along.chunk_by_mut(|a, b| a.0 == b.0).filter(|run| run.len() > 1) {
        run.sort_unstable_by(|a, b| {
            let (p, q) = (place(a), place(b));
            p[0].total_cmp(&q[0]).then(p[1].total_cmp(&q[1]))
        });
    }
    along
}

/// Spreads 32 bits to the even positions of 64 bits, with zeros between them, as a Morton key requires.
fn spread_bits(bits: u32) -> u64 {
    let mut bits = u64::from(bits);
    bits = (bits | bits << 16) & 0x0000_FFFF_0000_FFFF;
    bits = (bits | bits << 8) & 0x00FF_00FF_00FF_00FF;
    bits = (bits | bits << 4) & 0x0F0F_0F0F_0F0F_0F0F;
    bits = (bits | bits << 2) & 0x3333_3333_3333_3333;
    (bits | bits << 1) & 0x5555_5555_5555_5555
}

/// Returns 0 for -0 and for a coordinate so close to zero that spade refuses it, because its products would underflow.
/// Returns other coordinates unchanged.
fn flushed_to_zero(coordinate: f64) -> f64 {
    if coordinate.abs() < MIN_ALLOWED_VALUE { 0.0 } else { coordinate }
}

/// Returns an error that names two points at the same place in the plane. `places` contains the plane coordinates (u,
/// v) of each of the `points`. If there are several such pairs, names the pair with the smallest u, and among equal u
/// with the smallest v. At least two places must be equal.
fn first_duplicate(points: &[Point], places: &[[f64; 2]]) -> SurfaceError {
    let mut order: Vec<usize> = (0..places.len()).collect();
    let key = |i: usize| (places[i][0], places[i][1]);
    order.sort_by(|&a, &b| key(a).0.total_cmp(&key(b).0).then(key(a).1.total_cmp(&key(b).1)).then(a.cmp(&b)));
    let pair = order.windows(2).find(|w| key(w[0]) == key(w[1])).map_or((0, 0), |w| (w[0], w[1]));
    SurfaceError::DuplicatePoints { first: pair.0, second: pair.1, at: points[pair.0].into() }
}

/// Shortest and longest edge of each triangle, and the median of the longest edges.
struct EdgeLengths {
    min_edge: Vec<f64>,
    max_edge: Vec<f64>,
    median_max_edge: f64,
}

impl EdgeLengths {
    /// Computes the shortest and the longest edge of each triangle in `t`, and the median of the longest edges. Lengths
    /// are measured between the `places` of the vertices in the plane, in mm. There must be at least one triangle.
    fn new(t: &Triangles, places: &[[f64; 2]]) -> Self {
        let of = |corners: &[u32; 3]| {
            let [a, b, c] = squared_lengths(corners, places);
            (a.min(b).min(c).sqrt(), a.max(b).max(c).sqrt())
        };
        let (shortest, longest): (Vec<f64>, Vec<f64>) = t.corners.par_iter().map(of).unzip();
        Self { median_max_edge: median(&longest), min_edge: shortest, max_edge: longest }
    }
}

/// Returns the indices of two vertices that are nearer to each other than 1e-4 times the median of the longest edges of
/// all triangles. The surface between two such points would consist of rounding errors. Returns `None` if no edge is
/// that short.
fn find_near_duplicates(t: &Triangles, lengths: &EdgeLengths, places: &[[f64; 2]]) -> Option<[u32; 2]> {
    let least = TWINS * lengths.median_max_edge;
    let facet = lengths.min_edge.par_iter().position_first(|shortest| *shortest < least)?;
    let corners = t.corners[facet];
    let squared = squared_lengths(&corners, places);
    let across = (0..3).min_by(|&a, &b| squared[a].total_cmp(&squared[b]))?;
    Some([corners[(across + 1) % 3], corners[(across + 2) % 3]])
}

/// Returns the triangles without bridges and needles. First removes the bridges: triangles that close a hole of the
/// surface. Then removes the needles, from the border inwards. A needle is a triangle with a border edge whose height
/// over this edge is less than 0.05 of the edge length.
fn without_bridges_and_needles(mut t: Triangles, lengths: &EdgeLengths, places: &[[f64; 2]]) -> Triangles {
    let mut dropped = vec![false; t.corners.len()];
    let mut open: Vec<u32> = Vec::new();
    for facet in find_bridges(&t, lengths) {
        drop_facet(&mut t, &mut dropped, facet, &mut open);
    }
    let at_border = |f: &u32| t.neighbours[*f as usize].contains(&BORDER);
    open.extend((0..t.corners.len() as u32).into_par_iter().filter(at_border).collect::<Vec<_>>());
    while let Some(facet) = open.pop() {
        if !dropped[facet as usize] && is_needle(&t, places, facet) {
            drop_facet(&mut t, &mut dropped, facet, &mut open);
        }
    }
    compact(t, &dropped)
}

/// Removes triangle number `facet`: sets its flag in `dropped`. The edges that the triangle shares with its neighbours
/// become border edges of these neighbours. Appends the neighbours to `open`, the list of triangles whose border must
/// be checked.
fn drop_facet(t: &mut Triangles, dropped: &mut [bool], facet: u32, open: &mut Vec<u32>) {
    dropped[facet as usize] = true;
    for neighbour in t.neighbours[facet as usize] {
        if neighbour != BORDER {
            let across = &mut t.neighbours[neighbour as usize];
            across[across.iter().position(|&f| f == facet).expect("neighbours know each other")] = BORDER;
            open.push(neighbour);
        }
    }
    t.neighbours[facet as usize] = [BORDER; 3];
}

/// Returns the squared lengths of the three edges of a triangle; entry k is the edge opposite to corner k.
fn squared_lengths(corners: &[u32; 3], places: &[[f64; 2]]) -> [f64; 3] {
    let at = corners.map(|c| places[c as usize]);
    [(1, 2), (2, 0), (0, 1)].map(|(a, b): (usize, usize)| {
        let (u, v) = (at[a][0] - at[b][0], at[a][1] - at[b][1]);
        u * u + v * v
    })
}

/// Returns the numbers of the triangles that bridge a hole. In such a triangle the longest edge is more than six times
/// the usual edge length. The usual length is the largest value of [`usual_lengths`] at the three corners, and at least
/// the median of the longest edges of all triangles.
fn find_bridges(t: &Triangles, lengths: &EdgeLengths) -> Vec<u32> {
    let suspects: Vec<u32> = (0..t.corners.len() as u32)
        .into_par_iter()
        .filter(|&f| lengths.max_edge[f as usize] > BRIDGE * lengths.median_max_edge)
        .collect();
    if suspects.is_empty() {
        return suspects;
    }
    let usual = usual_lengths(t, lengths, &suspects);
    suspects
        .into_iter()
        .filter(|&f| {
            let most = t.corners[f as usize].iter().map(|c| usual[c]).fold(0.0, f64::max);
            lengths.max_edge[f as usize] > BRIDGE * most.max(lengths.median_max_edge)
        })
        .collect()
}

/// Returns the usual edge length in mm at each vertex of the triangles `suspects`: a map from the vertex to the length.
///
/// The length at a vertex is the lower quartile of the longest edges of the triangles around this vertex. The lower
/// quartile is used because at the rim of a hole half of these triangles can be bridges (triangles that close the
/// hole).
///
/// Two rules apply:
///
/// - A single stray point must not justify its own bridges. So the length at a vertex is limited to the second largest
///   of the quartiles at the neighbouring vertices.
/// - A triangle between a dense and a sparse region has the edge length of the sparse region. So the caller must
///   compare its longest edge with the largest of the lengths at its three corners.
fn usual_lengths(t: &Triangles, lengths: &EdgeLengths, suspects: &[u32]) -> HashMap<u32, f64> {
    let neighbours = triangles_at(t, suspects.iter().flat_map(|&f| t.corners[f as usize]));
    let around = triangles_at(t, neighbours.values().flatten().flat_map(|&f| t.corners[f as usize]));
    let quartile = |facets: &Vec<u32>| {
        let mut longest: Vec<f64> = facets.iter().map(|&f| lengths.max_edge[f as usize]).collect();
        longest.sort_unstable_by(f64::total_cmp);
        longest[(longest.len() - 1) / 4]
    };
    let own: HashMap<u32, f64> = around.iter().map(|(&c, facets)| (c, quartile(facets))).collect();
    let confirmed = |(&c, facets): (&u32, &Vec<u32>)| {
        let mut others: Vec<u32> = facets.iter().flat_map(|&f| t.corners[f as usize]).filter(|&o| o != c).collect();
        others.sort_unstable();
        others.dedup();
        let mut usual: Vec<f64> = others.iter().map(|o| own[o]).collect();
        usual.sort_unstable_by(|a, b| b.total_cmp(a));
        (c, own[&c].min(usual.get(1).copied().unwrap_or(0.0)))
    };
    neighbours.iter().map(confirmed).collect()
}

/// Returns a map from each vertex in `vertices` to the numbers of the triangles that have this vertex as a corner. A
/// vertex without triangles is not in the map.
fn triangles_at(t: &Triangles, vertices: impl Iterator<Item = u32>) -> HashMap<u32, Vec<u32>> {
    let mut is_wanted = vec![false; t.corners.par_iter().flatten_iter().max().map_or(0, |most| *most as usize + 1)];
    vertices.for_each(|c| is_wanted[c as usize] = true);
    let at = |(f, corners): (usize, &[u32; 3])| {
        let wanted = corners.map(|c| is_wanted[c as usize].then_some((c, f as u32)));
        wanted.into_iter().flatten()
    };
    let found: Vec<(u32, u32)> = t.corners.par_iter().enumerate().flat_map_iter(at).collect();
    let mut of: HashMap<u32, Vec<u32>> = HashMap::new();
    found.into_iter().for_each(|(c, f)| of.entry(c).or_default().push(f));
    of
}

/// Returns true if a triangle has a border edge and its height over this edge is less than 0.05 of the edge length.
fn is_needle(t: &Triangles, places: &[[f64; 2]], facet: u32) -> bool {
    let [a, b, c] = t.corners[facet as usize].map(|c| places[c as usize]);
    let double_area = ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs();
    let squared = squared_lengths(&t.corners[facet as usize], places);
    (0..3).any(|k| t.neighbours[facet as usize][k] == BORDER && double_area < NEEDLE * squared[k])
}

/// Returns the triangles without those whose flag in `dropped` is true. The remaining triangles keep their order and
/// are renumbered. Their neighbour numbers are adapted; a removed neighbour becomes [`BORDER`].
fn compact(t: Triangles, dropped: &[bool]) -> Triangles {
    if !dropped.contains(&true) {
        return t;
    }
    let mut next = 0;
    let renumbered: Vec<u32> = dropped
        .iter()
        .map(|&gone| {
            let number = next;
            next += u32::from(!gone);
            if gone { BORDER } else { number }
        })
        .collect();
    let kept: Vec<u32> = (0..dropped.len() as u32).filter(|&f| !dropped[f as usize]).collect();
    let across = |n: u32| if n == BORDER { BORDER } else { renumbered[n as usize] };
    Triangles {
        corners: kept.par_iter().map(|&f| t.corners[f as usize]).collect(),
        neighbours: kept.par_iter().map(|&f| t.neighbours[f as usize].map(across)).collect(),
    }
}

/// Returns the median of the values, the upper one of two middle values. There must be at least one value.
fn median(values: &[f64]) -> f64 {
    const SAMPLE: usize = 1024;
    let middle = values.len() / 2;
    let mut sample: Vec<f64> = values.iter().step_by(values.len().div_ceil(SAMPLE)).copied().collect();
    sample.sort_unstable_by(f64::total_cmp);
    // The median of all values lies near that of a sample. Values outside the middle of the sample are only counted.
    let [low, high] = [4, 6].map(|tenths| sample[sample.len() * tenths / 10]);
    let below = values.par_iter().filter(|v| **v < low).count();
    let mut within: Vec<f64> = values.par_iter().copied().filter(|v| (low..=high).contains(v)).collect();
    if (below..below + within.len()).contains(&middle) {
        *within.select_nth_unstable_by(middle - below, f64::total_cmp).1
    } else {
        *values.to_vec().select_nth_unstable_by(middle, f64::total_cmp).1
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::PlaneProjection;

    fn sunflower(count: usize, inner: f64) -> Vec<Point> {
        (0..count)
            .map(|k| {
                let r = (inner * inner + (1.0 - inner * inner) * (k as f64 + 0.5) / count as f64).sqrt() * 30.0;
                let phi = 2.399_963_229_728_653 * k as f64;
                Point::new(r * phi.cos(), r * phi.sin(), 0.001 * r * r)
            })
            .collect()
    }

    fn area(t: &Triangles, points: &[Point]) -> f64 {
        let p = |i: u32| points[i as usize];
        t.corners.iter().map(|&[a, b, c]| 0.5 * (p(b) - p(a)).cross(&(p(c) - p(a))).z).sum()
    }

    fn triangulated(points: &[Point]) -> (Vec<Point>, Triangles) {
        triangulate(points, &PlaneProjection::Xy.choose(points).unwrap().1).unwrap()
    }

    #[test]
    fn delaunay_covers_disc_ccw() {
        let (points, t) = triangulated(&sunflower(3000, 0.0));
        let disc = std::f64::consts::PI * 900.0;
        assert!((area(&t, &points) / disc - 1.0).abs() < 0.02);
        assert!(t.corners.iter().all(|&[a, b, c]| {
            let p = |i: u32| points[i as usize];
            (p(b) - p(a)).cross(&(p(c) - p(a))).z > 0.0
        }));
    }

    #[test]
    fn delaunay_of_shuffled_grid() {
        let node = |k: usize| Point::new((k % 173) as f64 * 0.1, (k / 173) as f64 * 0.1, 0.0);
        let in_order: Vec<Point> = (0..173 * 149).map(node).collect();
        let shuffled: Vec<Point> = (0..173 * 149).map(|k| node(k * 7919 % (173 * 149))).collect();
        let (a, b) = (triangulated(&in_order), triangulated(&shuffled));
        assert_eq!((a.0, a.1.corners, a.1.neighbours), (b.0, b.1.corners, b.1.neighbours));
    }

    #[test]
    fn delaunay_neighbours_after_trimming() {
        let (_, t) = triangulated(&sunflower(2000, 0.5));
        for (f, across) in t.neighbours.iter().enumerate() {
            for (k, &n) in across.iter().enumerate() {
                if n != BORDER {
                    assert!(t.neighbours[n as usize].contains(&(f as u32)));
                    assert!(!t.corners[n as usize].contains(&t.corners[f][k]));
                }
            }
        }
    }

    #[test]
    fn delaunay_leaves_annulus_hole() {
        let (points, t) = triangulated(&sunflower(3000, 0.5));
        let annulus = std::f64::consts::PI * 900.0 * 0.75;
        assert!((area(&t, &points) / annulus - 1.0).abs() < 0.03, "{}", area(&t, &points) / annulus);
    }

    #[test]
    fn median_matches_sorting() {
        let exact = |mut values: Vec<f64>| {
            values.sort_by(f64::total_cmp);
            values[values.len() / 2]
        };
        let fractions = |count: usize| (0..count).map(|k| (k as f64 * 0.618_033_988_749_895).fract());
        // The last one misleads a sample of every third value.
        let periodic = (0..3000).map(|k| if k % 3 == 0 { 0.0 } else { 1.0 + f64::from(k) });
        for values in [vec![3.0], vec![2.0, 1.0], vec![5.0; 4000], fractions(10_001).collect(), periodic.collect()] {
            assert_eq!(median(&values), exact(values.clone()));
        }
    }

    #[test]
    fn delaunay_refuses_degenerate_clouds() {
        let map = Projector::Plane {
            origin: Point::origin(),
            axes: [crate::geometry::Vector::x(), crate::geometry::Vector::y(), crate::geometry::Vector::z()],
        };
        let line: Vec<_> = (0..20).map(|i| Point::new(f64::from(i), 2.0 * f64::from(i), 0.0)).collect();
        assert!(matches!(triangulate(&line, &map), Err(SurfaceError::Collinear { points: 20 })));
        let mut doubled = sunflower(50, 0.0);
        doubled.push(doubled[7]);
        assert!(matches!(triangulate(&doubled, &map), Err(SurfaceError::DuplicatePoints { first: 7, second: 50, .. })));
        let mut huge = sunflower(50, 0.0);
        huge[9].x = 1e61;
        assert!(matches!(triangulate(&huge, &map), Err(SurfaceError::NotFinite { index: 9 })));
        let mut tiny = sunflower(50, 0.0);
        tiny.push(Point::new(1e-50, -0.0, 0.0));
        assert_eq!(triangulate(&tiny, &map).unwrap().0.len(), 51);
    }
}
