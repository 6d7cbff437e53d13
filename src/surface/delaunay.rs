//! Triangulation of scattered points in the plane of their projection.

use rayon::prelude::*;
use spade::{DelaunayTriangulation, HasPosition, Point2, Triangulation};

use crate::geometry::Point;

use super::SurfaceError;
use super::mesh::BORDER;
use super::projection::Map;

/// Triangles and the neighbours across the edge opposite to each corner.
pub(crate) struct Triangles {
    pub(crate) corners: Vec<[u32; 3]>,
    pub(crate) neighbours: Vec<[u32; 3]>,
}

/// A border triangle flatter than this (height over border edge) is a needle of the convex hull, not a piece of surface.
const NEEDLE: f64 = 0.05;

/// A triangle whose longest edge is this many times what is usual around its corners bridges a hole.
const BRIDGE: f64 = 6.0;

/// A projected point that remembers where it came from.
struct Site {
    place: Point2<f64>,
    index: u32,
}

impl HasPosition for Site {
    type Scalar = f64;

    fn position(&self) -> Point2<f64> {
        self.place
    }
}

/// Triangulates scattered points in the plane of a map, without the needles at the hull and the bridges over holes.
///
/// Shapes: corners index the points; counter-clockwise in the plane.
///
/// # Errors
/// Two points at one place of the plane, or no three points off one line.
pub(crate) fn triangulate(points: &[Point], map: &Map) -> Result<Triangles, SurfaceError> {
    let places: Vec<[f64; 2]> = points.par_iter().map(|p| map.project(p).0).collect();
    let sites = places
        .iter()
        .enumerate()
        .map(|(index, &[u, v])| Site { place: Point2::new(lifted(u), lifted(v)), index: index as u32 })
        .collect();
    let triangulation = DelaunayTriangulation::<Site>::bulk_load(sites)
        .map_err(|_| SurfaceError::NotFinite { index: places.iter().position(|p| !p[0].is_finite()).unwrap_or(0) })?;
    if triangulation.num_vertices() < points.len() {
        return Err(first_duplicate(points, &places));
    }
    if triangulation.num_inner_faces() == 0 {
        return Err(SurfaceError::Collinear { points: points.len() });
    }
    let triangles = flat_arrays(&triangulation);
    Ok(in_order_of_corners(without_bridges_and_needles(triangles, &places)))
}

/// Returns an order of the points in which neighbours in the plane are mostly neighbours in memory: along a Z-curve.
pub(crate) fn neighbourly_order(points: &[Point], map: &Map) -> Vec<u32> {
    let places: Vec<[f64; 2]> = points.par_iter().map(|p| map.project(p).0).collect();
    let (low, high) = places.iter().fold(([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]), |(l, h), p| {
        ([l[0].min(p[0]), l[1].min(p[1])], [h[0].max(p[0]), h[1].max(p[1])])
    });
    let cells = |k: usize| 65_535.0 / (high[k] - low[k]);
    let per_mm = [cells(0), cells(1)];
    let key = |p: &[f64; 2]| {
        let [u, v] = [0, 1].map(|k| ((p[k] - low[k]) * per_mm[k]) as u32);
        spread_bits(u) | spread_bits(v) << 1
    };
    let mut keyed: Vec<(u32, u32)> = places.par_iter().enumerate().map(|(i, p)| (key(p), i as u32)).collect();
    keyed.par_sort_unstable();
    keyed.into_iter().map(|(_, index)| index).collect()
}

/// Puts a zero between each two of the lower sixteen bits.
fn spread_bits(mut bits: u32) -> u32 {
    bits = (bits | bits << 8) & 0x00FF_00FF;
    bits = (bits | bits << 4) & 0x0F0F_0F0F;
    bits = (bits | bits << 2) & 0x3333_3333;
    (bits | bits << 1) & 0x5555_5555
}

/// Numbers the triangles in the order of their lowest corners, so that they stand in memory where their points do.
fn in_order_of_corners(t: Triangles) -> Triangles {
    let mut order: Vec<(u32, u32)> =
        t.corners.par_iter().enumerate().map(|(f, c)| (c[0].min(c[1]).min(c[2]), f as u32)).collect();
    order.par_sort_unstable();
    let mut number = vec![0; order.len()];
    for (new, (_, old)) in order.iter().enumerate() {
        number[*old as usize] = new as u32;
    }
    let renumbered = |n: u32| if n == BORDER { BORDER } else { number[n as usize] };
    Triangles {
        corners: order.par_iter().map(|(_, old)| t.corners[*old as usize]).collect(),
        neighbours: order.par_iter().map(|(_, old)| t.neighbours[*old as usize].map(renumbered)).collect(),
    }
}

/// Spade refuses coordinates closer to zero than 2^-142; those are zero to us.
fn lifted(coordinate: f64) -> f64 {
    if coordinate.abs() < 1e-40 { 0.0 } else { coordinate }
}

fn first_duplicate(points: &[Point], places: &[[f64; 2]]) -> SurfaceError {
    let mut order: Vec<usize> = (0..places.len()).collect();
    let key = |i: usize| (lifted(places[i][0]), lifted(places[i][1]));
    order.sort_by(|&a, &b| key(a).0.total_cmp(&key(b).0).then(key(a).1.total_cmp(&key(b).1)).then(a.cmp(&b)));
    let pair = order.windows(2).find(|w| key(w[0]) == key(w[1])).map_or((0, 0), |w| (w[0], w[1]));
    SurfaceError::DuplicatePoints { first: pair.0, second: pair.1, at: points[pair.0].into() }
}

fn flat_arrays(triangulation: &DelaunayTriangulation<Site>) -> Triangles {
    let count = triangulation.num_inner_faces();
    let (mut corners, mut neighbours) = (Vec::with_capacity(count), Vec::with_capacity(count));
    // Face 0 is the outer one; the inner ones follow in order.
    for face in triangulation.inner_faces() {
        let edges = face.adjacent_edges();
        corners.push(edges.map(|e| e.from().data().index));
        // Opposite to corner k lies the edge that begins at corner k + 1.
        neighbours.push([1, 2, 0].map(|k: usize| match edges[k].rev().face().as_inner() {
            Some(face) => face.fix().index() as u32 - 1,
            None => BORDER,
        }));
    }
    Triangles { corners, neighbours }
}

fn without_bridges_and_needles(mut t: Triangles, places: &[[f64; 2]]) -> Triangles {
    let mut dropped = vec![false; t.corners.len()];
    let mut open: Vec<u32> = Vec::new();
    for facet in bridges(&t, places) {
        drop_facet(&mut t, &mut dropped, facet, &mut open);
    }
    open.extend((0..t.corners.len() as u32).filter(|&f| t.neighbours[f as usize].contains(&BORDER)));
    while let Some(facet) = open.pop() {
        if !dropped[facet as usize] && is_needle(&t, places, facet) {
            drop_facet(&mut t, &mut dropped, facet, &mut open);
        }
    }
    compacted(t, &dropped)
}

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

/// Lengths of the edges opposite to each corner.
fn edge_lengths(corners: &[u32; 3], places: &[[f64; 2]]) -> [f64; 3] {
    let at = corners.map(|c| places[c as usize]);
    [(1, 2), (2, 0), (0, 1)].map(|(a, b): (usize, usize)| {
        let (u, v) = (at[a][0] - at[b][0], at[a][1] - at[b][1]);
        (u * u + v * v).sqrt()
    })
}

/// Finds triangles far longer than is usual around their corners.
fn bridges(t: &Triangles, places: &[[f64; 2]]) -> Vec<u32> {
    let longest: Vec<f64> =
        t.corners.par_iter().map(|c| edge_lengths(c, places).into_iter().fold(0.0, f64::max)).collect();
    let usual_everywhere = median(longest.clone());
    let suspects: Vec<u32> =
        (0..t.corners.len() as u32).filter(|&f| longest[f as usize] > BRIDGE * usual_everywhere).collect();
    if suspects.is_empty() {
        return suspects;
    }
    // What is usual at a vertex: the lower quartile of the longest edges around it, since at the rim of a hole half of its
    // triangles may be bridges.
    let mut around: Vec<(u32, f64)> =
        t.corners.iter().zip(&longest).flat_map(|(c, &l)| c.map(|vertex| (vertex, l))).collect();
    around.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut usual = vec![0.0; places.len()];
    for at_vertex in around.chunk_by(|a, b| a.0 == b.0) {
        usual[at_vertex[0].0 as usize] = at_vertex[(at_vertex.len() - 1) / 4].1;
    }
    suspects
        .into_iter()
        .filter(|&f| {
            let least = t.corners[f as usize].iter().map(|&c| usual[c as usize]).fold(f64::INFINITY, f64::min);
            longest[f as usize] > BRIDGE * least.max(usual_everywhere)
        })
        .collect()
}

fn is_needle(t: &Triangles, places: &[[f64; 2]], facet: u32) -> bool {
    let [a, b, c] = t.corners[facet as usize].map(|c| places[c as usize]);
    let double_area = ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs();
    let lengths = edge_lengths(&t.corners[facet as usize], places);
    (0..3).any(|k| t.neighbours[facet as usize][k] == BORDER && double_area < NEEDLE * lengths[k] * lengths[k])
}

fn compacted(t: Triangles, dropped: &[bool]) -> Triangles {
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
    let keep = |f: &usize| !dropped[*f];
    Triangles {
        corners: (0..dropped.len()).filter(keep).map(|f| t.corners[f]).collect(),
        neighbours: (0..dropped.len())
            .filter(keep)
            .map(|f| t.neighbours[f].map(|n| if n == BORDER { BORDER } else { renumbered[n as usize] }))
            .collect(),
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Projection;

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

    fn triangulated(points: &[Point]) -> Triangles {
        triangulate(points, &Projection::Xy.prepare(points).unwrap().1).unwrap()
    }

    #[test]
    fn a_disc_is_covered_and_turns_counter_clockwise() {
        let points = sunflower(3000, 0.0);
        let t = triangulated(&points);
        let disc = std::f64::consts::PI * 900.0;
        assert!((area(&t, &points) / disc - 1.0).abs() < 0.02);
        assert!(t.corners.iter().all(|&[a, b, c]| {
            let p = |i: u32| points[i as usize];
            (p(b) - p(a)).cross(&(p(c) - p(a))).z > 0.0
        }));
    }

    #[test]
    fn neighbours_know_each_other_after_trimming() {
        let points = sunflower(2000, 0.5);
        let t = triangulated(&points);
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
    fn the_hole_of_an_annulus_is_not_bridged() {
        let points = sunflower(3000, 0.5);
        let t = triangulated(&points);
        let annulus = std::f64::consts::PI * 900.0 * 0.75;
        assert!((area(&t, &points) / annulus - 1.0).abs() < 0.03, "{}", area(&t, &points) / annulus);
    }

    #[test]
    fn degenerate_clouds_are_named() {
        let map = Map::Plane {
            origin: Point::origin(),
            axes: [crate::geometry::Vector::x(), crate::geometry::Vector::y(), crate::geometry::Vector::z()],
        };
        let line: Vec<_> = (0..20).map(|i| Point::new(f64::from(i), 2.0 * f64::from(i), 0.0)).collect();
        assert!(matches!(triangulate(&line, &map), Err(SurfaceError::Collinear { points: 20 })));
        let mut doubled = sunflower(50, 0.0);
        doubled.push(doubled[7]);
        assert!(matches!(triangulate(&doubled, &map), Err(SurfaceError::DuplicatePoints { first: 7, second: 50, .. })));
    }
}
