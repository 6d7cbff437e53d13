//! Delaunay triangulation of points in the order of a Z-curve: by divide and conquer, on all cores.
//!
//! The construction is that of Guibas and Stolfi (Primitives for the manipulation of general subdivisions, 1985). The
//! cuts alternate between u and v; Dwyer (1987) found that this leaves little to merge. A Z-curve contains these cuts.
//! At the highest bit in which the keys of a range differ, all points before the change lie below a line of the plane
//! and all points after it lie above. The two halves are independent until they are merged. So a thread can build each,
//! and the result does not depend on the number of threads.
//!
//! The tests compare with the spade crate, but spade does not replace this module. For 451,401 unordered points its
//! bulk load in tiles of 8,000 with a halo of 3.5 steps takes 1.5 times the processor time of this whole module, even
//! before the seams are checked and the neighbours joined (0.37 s against 0.24 s on one thread). Its single global load
//! takes twice that, and on one thread only.
//!
//! Every decision is exact: if rounding could change the sign of a determinant, the adaptive predicates of Shewchuk
//! compute it. Four points on one circle may be divided along either diagonal.

use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering};

use rayon::prelude::*;
use robust::Coord;

use super::mesh_topology::BORDER;

/// Points and their keys in the order of a Z-curve; points with equal keys are ordered by u, then by v. All points are
/// distinct.
#[derive(Clone, Copy)]
pub(crate) struct SortedSites<'a> {
    pub(crate) places: &'a [[f64; 2]],
    /// Interleaved bits of v and u; the bit of v is the higher one of each pair.
    pub(crate) keys: &'a [u64],
}

/// Directed edge of a subdivision of the plane. The numbers of an edge and of its reverse differ only in the last bit.
type Edge = [u32; 3];

const ORIGIN: usize = 0;
/// Index of the next edge counter-clockwise around the origin.
const AFTER: usize = 1;
/// Index of the next edge clockwise around the origin.
const BEFORE: usize = 2;

/// Origin of an edge that is deleted or was never created.
const DELETED: u32 = u32::MAX;

/// Maximum number of directed edges per vertex: a planar graph of n vertices has fewer than 3 n edges, each in two
/// directions.
const PER_VERTEX: usize = 6;

/// Maximum number of points that one thread triangulates alone.
const MAX_POINTS_PER_THREAD: usize = 8192;

/// Axis of the plane across which a cut separates the points: those before the cut have the smaller coordinate.
#[derive(Clone, Copy, PartialEq)]
enum CutAxis {
    U,
    V,
}

/// Finished part of a triangulation: one vertex, or a hull edge that has the whole part on its left.
#[derive(Clone, Copy)]
enum PartialTriangulation {
    Vertex(u32),
    Hull(u32),
}

/// Directed edges of a triangulation.
pub(crate) struct Triangulation {
    edges: Vec<Edge>,
    /// Hull edge that has all points on its left.
    hull: u32,
}

impl Triangulation {
    /// Computes the Delaunay triangulation of `sites`, by divide and conquer. `sites` must contain at least three
    /// points. If all points lie on one line, the triangulation has no triangles.
    pub(crate) fn new(sites: SortedSites) -> Self {
        let count = sites.places.len();
        // The system supplies zeroed memory untouched; the threads that build here are the first to touch it.
        let mut edges: Vec<Edge> = vec![[0; 3]; PER_VERTEX * count];
        let (part, unused) = divide(sites, 0..count, &mut edges, 0);
        let PartialTriangulation::Hull(hull) = part else { unreachable!("three points have an edge") };
        unused.mark_deleted(&mut edges);
        Self { edges, hull }
    }

    /// Returns two lists with one entry for each triangle. The first list contains the three corners of the triangle,
    /// counter-clockwise, as indices of points. The second list contains the three neighbours of the triangle, as
    /// indices of triangles. Neighbour k is across the edge opposite to corner k; it is [`BORDER`] if there is no
    /// triangle. Returns empty lists if all points lie on one line.
    ///
    /// Triangles are numbered in the order of their edges. In memory, a triangle is therefore at about the same place
    /// as its corners.
    pub(crate) fn faces(&self) -> (Vec<[u32; 3]>, Vec<[u32; 3]>) {
        let number: Vec<AtomicU32> = (0..self.edges.len()).into_par_iter().map(|_| AtomicU32::new(0)).collect();
        self.visit_hull(|e| number[(e ^ 1) as usize].store(BORDER, Ordering::Relaxed));
        let of = |e: u32| number[e as usize].load(Ordering::Relaxed);
        let round = |e: u32| {
            let second = self.left_next(e);
            [e, second, self.left_next(second)]
        };
        let is_first = |&e: &u32| {
            self.edges[e as usize][ORIGIN] != DELETED && of(e) != BORDER && {
                let [e, second, third] = round(e);
                e < second && e < third
            }
        };
        let firsts: Vec<u32> = (0..self.edges.len() as u32).into_par_iter().filter(is_first).collect();
        firsts.par_iter().enumerate().for_each(|(face, &e)| {
            for e in round(e) {
                number[e as usize].store(face as u32, Ordering::Relaxed);
            }
        });
        let across = |e: u32| of(e ^ 1);
        firsts
            .par_iter()
            .map(|&e| {
                let [a, b, c] = round(e);
                ([a, b, c].map(|e| self.edges[e as usize][ORIGIN]), [across(b), across(c), across(a)])
            })
            .unzip()
    }

    /// Returns the number of the edge that follows the edge `e` around the face on the left of `e`. The returned edge
    /// starts where `e` ends.
    fn left_next(&self, e: u32) -> u32 {
        self.edges[(e ^ 1) as usize][BEFORE]
    }

    /// Calls `visit` with the number of each edge of the convex hull, in counter-clockwise order. Each of these
    /// directed edges has all points on its left.
    fn visit_hull(&self, visit: impl Fn(u32)) {
        let mut e = self.hull;
        loop {
            visit(e);
            e = self.edges[(e ^ 1) as usize][AFTER];
            if e == self.hull {
                return;
            }
        }
    }
}

/// Triangulates the points with the indices `range`. If the range is large, divides it between threads. `edges` is the
/// storage that is reserved for the edges of this part, and `base` is the number of the first edge in this storage.
/// Returns the triangulated part, and the edge numbers that the part did not use.
fn divide(sites: SortedSites, range: Range<usize>, edges: &mut [Edge], base: u32) -> (PartialTriangulation, FreeEdges) {
    if range.len() <= MAX_POINTS_PER_THREAD {
        let fresh = base..base + edges.len() as u32;
        let mut part =
            Subdivision { sites, edges, base, free_edges: FreeEdges { freed: Vec::new(), fresh: vec![fresh] } };
        let hull = part.build(range);
        return (hull, part.free_edges);
    }
    let (cut, axis) = sites.cut(&range);
    let set_aside = PER_VERTEX * (cut - range.start);
    let (below, above) = edges.split_at_mut(set_aside);
    let ((lower, mut slots), (upper, more)) = rayon::join(
        || divide(sites, range.start..cut, below, base),
        || divide(sites, cut..range.end, above, base + set_aside as u32),
    );
    slots.freed.extend(more.freed);
    slots.fresh.extend(more.fresh);
    let mut part = Subdivision { sites, edges, base, free_edges: slots };
    let hull = part.merge(lower, upper, axis);
    (hull, part.free_edges)
}

impl SortedSites<'_> {
    /// Divides the points with the indices `range`, at least two, into two parts. A line parallel to the u axis or the
    /// v axis separates the parts. Returns the index of the first point of the second part. Also returns the axis (u or
    /// v) along which the second part has the larger coordinates.
    ///
    /// The points are sorted by a key (the position on a Z-curve, computed from u and v). If all points of the range
    /// have the same key, divides the range in the middle. The returned axis is then u.
    fn cut(&self, range: &Range<usize>) -> (usize, CutAxis) {
        let keys = &self.keys[range.clone()];
        let differing = keys[0] ^ keys[keys.len() - 1];
        if differing == 0 {
            return (range.start + keys.len() / 2, CutAxis::U);
        }
        let bit = differing.ilog2();
        let cut = range.start + keys.partition_point(|key| key >> bit & 1 == 0);
        (cut, if bit.is_multiple_of(2) { CutAxis::U } else { CutAxis::V })
    }
}

/// Unused edge numbers: numbers of deleted edges, and numbers that were not yet assigned.
struct FreeEdges {
    freed: Vec<u32>,
    fresh: Vec<Range<u32>>,
}

impl FreeEdges {
    /// Takes two unused edge numbers, one for an edge and one for its reverse, and returns the lower one. They differ
    /// only in the last bit.
    fn allocate(&mut self) -> u32 {
        if let Some(e) = self.freed.pop() {
            return e;
        }
        loop {
            let range = self.fresh.last_mut().expect("a planar graph has fewer than three edges a vertex");
            if range.start < range.end {
                range.start += 2;
                return range.start - 2;
            }
            self.fresh.pop();
        }
    }

    /// Writes the mark for a deleted edge to each entry of `edges` whose number was never assigned to an edge.
    fn mark_deleted(&self, edges: &mut [Edge]) {
        for range in &self.fresh {
            edges[range.start as usize..range.end as usize].fill([DELETED; 3]);
        }
    }
}

/// Part of the plane that is being triangulated.
struct Subdivision<'a> {
    sites: SortedSites<'a>,
    edges: &'a mut [Edge],
    /// Number of the first edge in `edges`.
    base: u32,
    free_edges: FreeEdges,
}

impl Subdivision<'_> {
    /// Triangulates the points with the indices `range` on this thread, by divide and conquer.
    fn build(&mut self, range: Range<usize>) -> PartialTriangulation {
        match range.len() {
            1 => PartialTriangulation::Vertex(range.start as u32),
            2 => PartialTriangulation::Hull(self.make(range.start as u32, range.start as u32 + 1)),
            3 => self.join_three(range.start as u32),
            _ => {
                let (cut, axis) = self.sites.cut(&range);
                let lower = self.build(range.start..cut);
                let upper = self.build(cut..range.end);
                self.merge(lower, upper, axis)
            }
        }
    }

    /// Joins three points, from the index `first` on, to a triangle, or to two edges if they lie on one line.
    fn join_three(&mut self, first: u32) -> PartialTriangulation {
        let mut v = [first, first + 1, first + 2];
        let orientation = self.orient2d(v[0], v[1], v[2]);
        if orientation == 0.0 {
            v.sort_by(|&a, &b| self.compare(CutAxis::U, a, b));
        } else if orientation < 0.0 {
            v.swap(1, 2);
        }
        let (a, b) = (self.make(v[0], v[1]), self.make(v[1], v[2]));
        self.insert_after(b, a ^ 1);
        if orientation != 0.0 {
            self.connect(b, a);
        }
        PartialTriangulation::Hull(a)
    }

    /// Merges two triangulated parts that a line separates, and returns the merged part. `lower` has the smaller
    /// coordinates along `axis`.
    fn merge(
        &mut self,
        lower: PartialTriangulation,
        upper: PartialTriangulation,
        axis: CutAxis,
    ) -> PartialTriangulation {
        let mut base = self.tangent(lower, upper, axis);
        loop {
            let (right, left) = (self.origin(base), self.destination(base));
            let mut at_left = self.edge(base ^ 1)[AFTER];
            let goes_left = self.orient2d(right, left, self.destination(at_left)) < 0.0;
            if goes_left {
                at_left = self.clear(at_left, AFTER, left, right);
            }
            let mut at_right = self.edge(base)[BEFORE];
            let goes_right = self.orient2d(right, left, self.destination(at_right)) < 0.0;
            if goes_right {
                at_right = self.clear(at_right, BEFORE, left, right);
            }
            base = match (goes_left, goes_right) {
                (false, false) => return PartialTriangulation::Hull(base),
                (false, true) => self.connect(at_right, base ^ 1),
                (true, false) => self.connect(base ^ 1, at_left ^ 1),
                (true, true) if self.in_circle(self.destination(at_left), left, right, self.destination(at_right)) => {
                    self.connect(at_right, base ^ 1)
                }
                (true, true) => self.connect(base ^ 1, at_left ^ 1),
            };
        }
    }

    /// Deletes invalid edges at one end of the base edge while two parts are merged. The base edge is the last edge
    /// that connects the two parts; `left` and `right` are its two ends. All tested edges start at one of these ends.
    ///
    /// The first tested edge is `e`. The next ones follow around the same end in the direction `way`: [`AFTER`]
    /// (counter-clockwise) or [`BEFORE`] (clockwise). Deletes an edge if the circle through `left`, `right` and the
    /// destination of this edge contains the destination of the next edge. Such an edge is not Delaunay. Returns the
    /// first edge that is not deleted.
    fn clear(&mut self, mut e: u32, way: usize, left: u32, right: u32) -> u32 {
        loop {
            let next = self.edge(e)[way];
            if !self.in_circle(left, right, self.destination(e), self.destination(next)) {
                return e;
            }
            self.delete(e);
            e = next;
        }
    }

    /// Adds the lower common tangent of the parts `lower` and `upper`. This is the edge from a vertex of `upper` to a
    /// vertex of `lower` that has no point of the two parts on its left. `lower` has the smaller coordinates along
    /// `axis`. Returns the number of this edge.
    fn tangent(&mut self, lower: PartialTriangulation, upper: PartialTriangulation, axis: CutAxis) -> u32 {
        // The search runs clockwise along the lower hull and counter-clockwise along the upper one.
        let mut l = match lower {
            PartialTriangulation::Vertex(_) => None,
            PartialTriangulation::Hull(e) => {
                Some(self.edge(self.farthest(e, |a, b| self.compare(axis, a, b).is_lt()))[BEFORE])
            }
        };
        let mut u = match upper {
            PartialTriangulation::Vertex(_) => None,
            PartialTriangulation::Hull(e) => Some(self.farthest(e, |a, b| self.compare(axis, a, b).is_gt())),
        };
        let vertex = |plane: &Self, part: PartialTriangulation, e: Option<u32>| match (part, e) {
            (PartialTriangulation::Vertex(v), _) => v,
            (_, e) => plane.origin(e.expect("a hull has edges")),
        };
        loop {
            let (at_l, at_u) = (vertex(self, lower, l), vertex(self, upper, u));
            if let Some(e) = l
                && self.orient2d(at_l, self.destination(e), at_u) > 0.0
            {
                l = Some(self.left_next(e));
            } else if let Some(e) = u
                && self.orient2d(at_u, self.destination(e), at_l) < 0.0
            {
                u = Some(self.edge(e ^ 1)[AFTER]);
            } else {
                let base = self.make(at_u, at_l);
                if let Some(e) = u {
                    self.insert_after(base, self.edge(e)[BEFORE]);
                }
                if let Some(e) = l {
                    self.insert_after(base ^ 1, e);
                }
                return base;
            }
        }
    }

    /// Walks along the convex hull of a part to the farthest vertex of the hull. `e` is the hull edge at which the walk
    /// starts. `beyond(a, b)` must return true if vertex b is farther than vertex a. Returns the hull edge whose origin
    /// is the farthest vertex.
    fn farthest(&self, mut e: u32, beyond: impl Fn(u32, u32) -> bool) -> u32 {
        let next = |e: u32| self.edge(e ^ 1)[AFTER];
        let previous = |e: u32| self.edge(e)[BEFORE] ^ 1;
        while beyond(self.origin(e), self.origin(next(e))) {
            e = next(e);
        }
        while beyond(self.origin(e), self.origin(previous(e))) {
            e = previous(e);
        }
        e
    }

    /// Compares the coordinates of the vertices `a` and `b` along `axis`. If these coordinates are equal, compares the
    /// other coordinates: v in ascending order for the axis u, and u in descending order for the axis v. The order for
    /// v is thus the order for u, turned by a right angle.
    fn compare(&self, axis: CutAxis, a: u32, b: u32) -> std::cmp::Ordering {
        let (a, b) = (self.sites.places[a as usize], self.sites.places[b as usize]);
        match axis {
            CutAxis::U => a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])),
            // The same order, turned by a right angle.
            CutAxis::V => a[1].total_cmp(&b[1]).then(b[0].total_cmp(&a[0])),
        }
    }

    /// Returns the edge with the number `e`.
    #[inline(always)]
    fn edge(&self, e: u32) -> &Edge {
        &self.edges[(e - self.base) as usize]
    }

    /// Returns the edge with the number `e`, to be changed.
    #[inline(always)]
    fn edge_mut(&mut self, e: u32) -> &mut Edge {
        &mut self.edges[(e - self.base) as usize]
    }

    /// Returns the vertex where the edge `e` starts.
    #[inline(always)]
    fn origin(&self, e: u32) -> u32 {
        self.edge(e)[ORIGIN]
    }

    /// Returns the vertex where the edge `e` ends.
    #[inline(always)]
    fn destination(&self, e: u32) -> u32 {
        self.edge(e ^ 1)[ORIGIN]
    }

    /// Returns the number of the edge that follows the edge `e` around the face on the left of `e`. The returned edge
    /// starts where `e` ends.
    #[inline(always)]
    fn left_next(&self, e: u32) -> u32 {
        self.edge(e ^ 1)[BEFORE]
    }

    /// Adds an edge between the vertices `from` and `to` that is not connected to any other edge. Returns its number.
    fn make(&mut self, from: u32, to: u32) -> u32 {
        let e = self.free_edges.allocate();
        *self.edge_mut(e) = [from, e, e];
        *self.edge_mut(e ^ 1) = [to, e ^ 1, e ^ 1];
        e
    }

    /// Inserts the edge `e`, which is not yet connected at its origin, directly after the edge `other`,
    /// counter-clockwise around their common origin.
    #[inline(always)]
    fn insert_after(&mut self, e: u32, other: u32) {
        let next = self.edge(other)[AFTER];
        self.edge_mut(other)[AFTER] = e;
        self.edge_mut(next)[BEFORE] = e;
        let edge = self.edge_mut(e);
        (edge[BEFORE], edge[AFTER]) = (other, next);
    }

    /// Adds an edge from the end of the edge `a` to the origin of the edge `b`. Both must have the same face on their
    /// left, which the new edge divides. Returns the number of the new edge.
    fn connect(&mut self, a: u32, b: u32) -> u32 {
        let e = self.make(self.destination(a), self.origin(b));
        self.insert_after(e, self.left_next(a));
        self.insert_after(e ^ 1, b);
        e
    }

    /// Removes the edge `e` and its reverse, and frees their numbers.
    fn delete(&mut self, e: u32) {
        for e in [e, e ^ 1] {
            let [_, after, before] = *self.edge(e);
            self.edge_mut(before)[AFTER] = after;
            self.edge_mut(after)[BEFORE] = before;
            self.edge_mut(e)[ORIGIN] = DELETED;
        }
        self.free_edges.freed.push(e & !1);
    }

    /// Returns a positive value if the vertices `a`, `b` and `c` are counter-clockwise, a negative value if they are
    /// clockwise, and 0 if they lie on one line. Uses the function [`orient2d`].
    #[inline(always)]
    fn orient2d(&self, a: u32, b: u32, c: u32) -> f64 {
        orient2d([a, b, c].map(|v| self.sites.places[v as usize]))
    }

    /// Returns true if the vertex `d` lies inside the circle through the vertices `a`, `b` and `c`, which must be
    /// counter-clockwise. Uses the function [`in_circle`].
    #[inline(always)]
    fn in_circle(&self, a: u32, b: u32, c: u32, d: u32) -> bool {
        in_circle([a, b, c, d].map(|v| self.sites.places[v as usize]))
    }
}

/// Returns a positive value if the points a, b and c are counter-clockwise, a negative value if they are clockwise, and
/// 0 if they lie on one line. The sign is exact (Shewchuk's predicate).
#[inline(always)]
fn orient2d([a, b, c]: [[f64; 2]; 3]) -> f64 {
    // The first filter of Shewchuk's predicate is repeated here so that it is inlined. Its epsilon is half the distance
    // from 1 to the next number.
    const BOUND: f64 = (3.0 + 16.0 * HALF_EPSILON) * HALF_EPSILON;
    let left = (a[0] - c[0]) * (b[1] - c[1]);
    let right = (a[1] - c[1]) * (b[0] - c[0]);
    let det = left - right;
    let permanent = left.abs() + right.abs();
    // If both products are zero, the determinant is exactly zero.
    if det.abs() > BOUND * permanent || permanent == 0.0 { det } else { robust::orient2d(coord(a), coord(b), coord(c)) }
}

const HALF_EPSILON: f64 = 0.5 * f64::EPSILON;

/// Returns true if the point d lies inside the circle through the points a, b and c, which must be counter-clockwise.
/// Returns false if d lies on the circle or outside. The result is exact (Shewchuk's predicate).
#[inline(always)]
fn in_circle([a, b, c, d]: [[f64; 2]; 4]) -> bool {
    const BOUND: f64 = (10.0 + 96.0 * HALF_EPSILON) * HALF_EPSILON;
    let [a_d, b_d, c_d] = [a, b, c].map(|p| [p[0] - d[0], p[1] - d[1]]);
    let lift = |p: [f64; 2]| p[0] * p[0] + p[1] * p[1];
    let minor = |p: [f64; 2], q: [f64; 2]| (p[0] * q[1], q[0] * p[1]);
    let terms = [(minor(b_d, c_d), lift(a_d)), (minor(c_d, a_d), lift(b_d)), (minor(a_d, b_d), lift(c_d))];
    let (mut det, mut permanent) = (0.0, 0.0);
    for ((plus, minus), lift) in terms {
        det += lift * (plus - minus);
        permanent += lift * (plus.abs() + minus.abs());
    }
    if det.abs() > BOUND * permanent || permanent == 0.0 {
        det > 0.0
    } else {
        robust::incircle(coord(a), coord(b), coord(c), coord(d)) > 0.0
    }
}

fn coord([x, y]: [f64; 2]) -> Coord<f64> {
    Coord { x, y }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use spade::{DelaunayTriangulation, Point2, Triangulation as _};

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

    fn in_order(places: &[[f64; 2]]) -> (Vec<[f64; 2]>, Vec<u64>) {
        z_curve_order(places).into_iter().map(|(key, index)| (places[index as usize], key)).unzip()
    }

    /// Triangulates, and proves by robust's predicates and one global load of spade that the triangulation is Delaunay.
    /// Returns the number of triangles, and true if other Delaunay triangulations exist.
    fn checked(places: &[[f64; 2]]) -> (usize, bool) {
        let (places, keys) = in_order(places);
        let (corners, neighbours) = Triangulation::new(SortedSites { places: &places, keys: &keys }).faces();
        let at = |v: u32| coord(places[v as usize]);
        let (mut certain, mut border, mut ambiguous, mut area) = (BTreeSet::new(), 0, false, 0.0);
        for (f, c) in corners.iter().enumerate() {
            let [p, q, r] = c.map(at);
            assert!(robust::orient2d(p, q, r) > 0.0);
            area += (q.x - p.x) * (r.y - p.y) - (q.y - p.y) * (r.x - p.x);
            for k in 0..3 {
                let (n, edge) = (neighbours[f][k], [c[(k + 1) % 3], c[(k + 2) % 3]]);
                let mut within = -1.0;
                if n == BORDER {
                    border += 1;
                } else {
                    let back = neighbours[n as usize].iter().position(|&n| n == f as u32);
                    let (across, j) = (corners[n as usize], back.expect("neighbours know each other"));
                    assert_eq!([across[(j + 2) % 3], across[(j + 1) % 3]], edge);
                    within = robust::incircle(p, q, r, at(across[j]));
                }
                // A triangulation that is locally Delaunay at every edge is Delaunay.
                assert!(within <= 0.0);
                ambiguous |= within == 0.0;
                if within < 0.0 {
                    certain.insert([edge[0].min(edge[1]), edge[0].max(edge[1])]);
                }
            }
        }
        let spade = by_spade(&places);
        assert_eq!(corners.len(), spade.num_inner_faces());
        if !corners.is_empty() {
            assert_eq!(corners.len() + border + 2, 2 * places.len(), "Euler");
            assert_eq!(certain, certain_of_spade(&spade));
            let [u, v] = places[0];
            let hull = spade.convex_hull().map(|e| e.positions().map(|p| (p.x - u, p.y - v)));
            let hull_area = hull.map(|[p, q]| p.0 * q.1 - p.1 * q.0).sum::<f64>().abs();
            assert!((area / hull_area - 1.0).abs() < 1e-9, "{area} covered of {hull_area}");
        }
        (corners.len(), ambiguous)
    }

    fn by_spade(places: &[[f64; 2]]) -> DelaunayTriangulation<Point2<f64>> {
        DelaunayTriangulation::bulk_load_stable(places.iter().map(|&[u, v]| Point2::new(u, v)).collect()).unwrap()
    }

    /// Returns the edges that every Delaunay triangulation contains: those of the hull, and those whose two triangles
    /// have different circumcircles.
    fn certain_of_spade(spade: &DelaunayTriangulation<Point2<f64>>) -> BTreeSet<[u32; 2]> {
        let certain = spade.undirected_edges().filter(|e| {
            let e = e.as_directed();
            let (Some(left), Some(right)) = (e.opposite_vertex(), e.rev().opposite_vertex()) else { return true };
            let [a, b, c, d] = [e.from(), e.to(), left, right].map(|v| coord(v.position().into()));
            robust::incircle(a, b, c, d) < 0.0
        });
        let ends = certain.map(|e| e.vertices().map(|v| v.index() as u32));
        ends.map(|[a, b]| [a.min(b), a.max(b)]).collect()
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
        let (mut places, _) = in_order(&far);
        places.dedup();
        checked(&places);
    }
}
