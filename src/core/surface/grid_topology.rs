//! Grid of nodes as a surface: two triangles in each cell, computed from the indices, without any triangulation.

use rayon::prelude::*;

use crate::geometry::grid_recognition::{GriddedCloud, NO_POINT, OrderedGrid};
use crate::geometry::{Point, Vector};

use super::facet::{Facets, Vertex, points_x4};
use super::simd::{F64x4, LANES, Real, Vector3x4, cross, minus, times};

/// Triangles of a structured grid, row by row with the column fastest.
///
/// Facet 2n is the lower right half (nodes 00, 10, 11) of the cell whose first node is n; facet 2n + 1 is the upper
/// left half (00, 11, 01). Facets are numbered by nodes, so that their corners need no division. The facets of the last
/// column do not exist.
#[derive(Clone, Debug)]
pub(crate) struct GridTopology {
    columns: u32,
    rows: u32,
    /// True for each node that exists; empty if all nodes exist.
    present: Vec<bool>,
    /// First corner in mm, and nodes per millimetre, along x and y; `None` for a grid that is not regular in x and y.
    /// With these a search starts near the right cell.
    regular: Option<([f64; 2], [f64; 2])>,
}

/// Returns one point per node of the grid, row by row with x fastest. A node without a point gets NaN coordinates.
/// `order` gives the index in `points` for each node.
pub(crate) fn reorder_to_grid(points: Vec<Point>, order: &GriddedCloud) -> Vec<Point> {
    if order.is_ordered() {
        return points;
    }
    let hole = Point::new(f64::NAN, f64::NAN, f64::NAN);
    order.point_indices.par_iter().map(|&i| if i == NO_POINT { hole } else { points[i as usize] }).collect()
}

impl GridTopology {
    /// Builds the triangles of a grid over `points`, which are ordered row by row with the column fastest. A NaN point
    /// is a hole. `regular_in_xy` is true if the nodes have equal steps in x and in y.
    pub(crate) fn new(columns: usize, rows: usize, points: &[Point], regular_in_xy: bool) -> Self {
        let holes = points.par_iter().any(|p| p.x.is_nan());
        let present = if holes { points.iter().map(|p| p.x.is_finite()).collect() } else { Vec::new() };
        let regular = regular_in_xy.then(|| {
            let (low, high) = extremes(points);
            let per_mm = |k: usize, n: usize| (n - 1) as f64 / (high[k] - low[k]);
            (low, [per_mm(0, columns), per_mm(1, rows)])
        });
        Self { columns: columns as u32, rows: rows as u32, present, regular }
    }

    /// Builds the triangles of the grid `found`. `found` holds the number of columns and rows, and x and y of the first
    /// and the last node. The grid must be regular in x and y and must have no hole.
    pub(crate) fn from_ordered_grid(found: &OrderedGrid) -> Self {
        let [low, high] = found.corners;
        let per_mm = |k: usize, n: usize| (n - 1) as f64 / (high[k] - low[k]);
        Self {
            columns: found.columns as u32,
            rows: found.rows as u32,
            present: Vec::new(),
            regular: Some((low, [per_mm(0, found.columns), per_mm(1, found.rows)])),
        }
    }

    /// Returns the number of nodes in a row.
    pub(crate) fn columns(&self) -> usize {
        self.columns as usize
    }

    /// Returns true if the nodes have equal steps in x and y.
    pub(crate) fn is_regular(&self) -> bool {
        self.regular.is_some()
    }

    /// Returns the number of rows of nodes.
    pub(crate) fn rows(&self) -> usize {
        self.rows as usize
    }

    /// Returns one triangle of each cell of a row of cells: the lower right facet. A cell is the rectangle between four
    /// neighbouring nodes, and two facets divide it. The row of cells `row` lies between the rows of nodes `row` and
    /// `row + 1`.
    ///
    /// Each item is the facet number and the node indices of the three corners. The corners are the nodes 00, 10 and 11
    /// of the cell: the first digit counts columns, the second digit rows. A facet is returned even if one of its
    /// corners is a hole.
    pub(crate) fn row_of_facets(&self, row: usize) -> impl Iterator<Item = (u32, [u32; 3])> {
        let first = row as u32 * self.columns;
        (first..first + self.columns - 1).map(|node| (2 * node, [node, node + 1, node + self.columns + 1]))
    }

    /// Returns true if the facet number belongs to a cell of the grid, and if the three corners of the facet exist.
    pub(crate) fn has_facet(&self, facet: u32) -> bool {
        let (i, j) = self.cell_of(facet);
        i + 1 < self.columns && j + 1 < self.rows && self.corners(facet).iter().all(|&c| self.is_present(c as usize))
    }

    /// Returns true if the node exists; false if it is a hole.
    pub(crate) fn is_present(&self, node: usize) -> bool {
        self.present.is_empty() || self.present[node]
    }

    /// Returns the existing nodes at most `reach` rows and columns away from a node, without the node itself.
    pub(crate) fn block_around(&self, node: u32, reach: u32) -> Vec<u32> {
        let (i, j) = (node % self.columns, node / self.columns);
        let within = |k: u32, count: u32| k.saturating_sub(reach)..(k + reach + 1).min(count);
        let nodes = within(j, self.rows).flat_map(|j| within(i, self.columns).map(move |i| j * self.columns + i));
        nodes.filter(|&k| k != node && self.is_present(k as usize)).collect()
    }

    /// Returns the number of a facet near the node `node`: the lower right facet of a cell. The cell is the one in
    /// which `node` has the smallest column and row. If `node` is in the last column or row, the cell is the last one
    /// in this direction.
    ///
    /// If one of the four nodes of this cell is a hole, another cell nearby is used whose four nodes exist. Returns
    /// facet 0 if the grid has no such cell.
    pub(crate) fn facet_near(&self, node: u32) -> u32 {
        let (i, j) = (node % self.columns, node / self.columns);
        let (i, j) = self.nearest_whole_cell(i.min(self.columns - 2), j.min(self.rows - 2));
        self.facet_at(i, j, 0)
    }

    /// Returns true if the four nodes of the cell in column `i` and row `j` exist.
    fn cell_is_whole(&self, i: u32, j: u32) -> bool {
        let node = (j * self.columns + i) as usize;
        let above = node + self.columns as usize;
        self.present.is_empty()
            || (self.present[node] && self.present[node + 1] && self.present[above] && self.present[above + 1])
    }

    /// Returns the number of a facet of the cell in column `i` and row `j`. `half` is 0 for the lower right facet and 1
    /// for the upper left one.
    fn facet_at(&self, i: u32, j: u32, half: u32) -> u32 {
        2 * (j * self.columns + i) + half
    }

    /// Returns column and row of the cell of a facet.
    fn cell_of(&self, facet: u32) -> (u32, u32) {
        let node = facet / 2;
        (node % self.columns, node / self.columns)
    }

    /// Returns the column and the row of the cell that contains a target point. The start is the node of the cell (i,
    /// j) with the smallest column and row. The target is `u` columns and `v` rows away from the start. `u` and `v` may
    /// be fractions or negative. A target outside the grid is moved to the nearest cell of the grid.
    ///
    /// If one of the four nodes of the target cell is a hole, halves `u` and `v` and tries again. Returns `None` if the
    /// target reaches the cell (i, j) and a node of this cell is a hole. Also returns `None` if the distance is less
    /// than 1e-4 of the first distance and no cell was found.
    fn cell_towards(&self, (i, j): (u32, u32), u: f64, v: f64) -> Option<(u32, u32)> {
        let clamp =
            |from: u32, step: f64, cells: u32| (f64::from(from) + step).floor().clamp(0.0, f64::from(cells - 1));
        let mut share = 1.0;
        loop {
            let target = (clamp(i, u * share, self.columns - 1) as u32, clamp(j, v * share, self.rows - 1) as u32);
            if self.cell_is_whole(target.0, target.1) {
                return Some(target);
            }
            if target == (i, j) || share < 1e-4 {
                return None;
            }
            share *= 0.5;
        }
    }

    /// Returns column and row of the cell nearest to (i, j) whose four nodes exist. Searches in square rings of growing
    /// size. Returns (0, 0) if there is no such cell.
    fn nearest_whole_cell(&self, i: u32, j: u32) -> (u32, u32) {
        if self.cell_is_whole(i, j) {
            return (i, j);
        }
        let (cells_i, cells_j) = (i64::from(self.columns - 1), i64::from(self.rows - 1));
        let ring = |r: i64| {
            let (i, j) = (i64::from(i), i64::from(j));
            (-r..=r).flat_map(move |d| [(i + d, j - r), (i + d, j + r), (i - r, j + d), (i + r, j + d)])
        };
        (1..cells_i.max(cells_j))
            .flat_map(ring)
            .filter(|&(i, j)| (0..cells_i).contains(&i) && (0..cells_j).contains(&j))
            .map(|(i, j)| (i as u32, j as u32))
            .find(|&(i, j)| self.cell_is_whole(i, j))
            .unwrap_or((0, 0))
    }
}

impl Facets for GridTopology {
    #[inline]
    fn corners(&self, facet: u32) -> [u32; 3] {
        let node = facet / 2;
        let far = node + self.columns + 1;
        if facet & 1 == 0 { [node, node + 1, far] } else { [node, far, far - 1] }
    }

    /// Returns the number of the next facet in the search for the facet that contains the projection of a point.
    /// `facet` is the present facet, and `weights` are the barycentric weights of the point in this facet.
    ///
    /// Extends the plane of `facet` beyond its edges. Jumps to the grid cell in which the point lies in this plane. If
    /// one of the four nodes of that cell is a hole, takes a cell between the present cell and that cell. Returns
    /// `None` if the new facet is `facet` itself, or if no cell on the way has four nodes.
    #[inline]
    fn advance(&self, facet: u32, weights: &[f64; 3]) -> Option<u32> {
        let (u, v) =
            if facet & 1 == 0 { (weights[1] + weights[2], weights[2]) } else { (weights[1], weights[1] + weights[2]) };
        let here = self.cell_of(facet);
        let cell = self.cell_towards(here, u, v)?;
        let (du, dv) = (u + f64::from(here.0) - f64::from(cell.0), v + f64::from(here.1) - f64::from(cell.1));
        let next = self.facet_at(cell.0, cell.1, u32::from(dv > du));
        (next != facet).then_some(next)
    }

    fn ends_at(&self, facet: u32, corner: usize) -> bool {
        let (i, j) = self.cell_of(facet);
        let is_whole = |i: Option<u32>, j: Option<u32>| {
            i.zip(j).is_some_and(|(i, j)| i + 1 < self.columns && j + 1 < self.rows && self.cell_is_whole(i, j))
        };
        match (facet & 1, corner) {
            (0, 0) => !is_whole(Some(i + 1), Some(j)),
            (0, 2) => !is_whole(Some(i), j.checked_sub(1)),
            (1, 0) => !is_whole(Some(i), Some(j + 1)),
            (1, 1) => !is_whole(i.checked_sub(1), Some(j)),
            // The diagonal of the cell.
            _ => false,
        }
    }

    fn start(&self, p: &Point) -> u32 {
        let cell = |at: f64, cells: u32| at.clamp(0.0, f64::from(cells - 1)) as u32;
        let (i, j) = match &self.regular {
            Some((first, per_mm)) => (
                cell((p.x - first[0]) * per_mm[0], self.columns - 1),
                cell((p.y - first[1]) * per_mm[1], self.rows - 1),
            ),
            None => ((self.columns - 1) / 2, (self.rows - 1) / 2),
        };
        let (i, j) = self.nearest_whole_cell(i, j);
        self.facet_at(i, j, 0)
    }
}

/// Returns the smallest and the largest x and y of the points. NaN points are ignored.
fn extremes(points: &[Point]) -> ([f64; 2], [f64; 2]) {
    let merge = |a: ([f64; 2], [f64; 2]), b: ([f64; 2], [f64; 2])| {
        ([a.0[0].min(b.0[0]), a.0[1].min(b.0[1])], [a.1[0].max(b.1[0]), a.1[1].max(b.1[1])])
    };
    let none = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    points.par_iter().map(|p| ([p.x, p.y], [p.x, p.y])).reduce(|| none, merge)
}

/// Weights of the first derivative at each node of a window of equally spaced nodes, for windows of 2 to 5 nodes.
///
/// Each row differentiates the polynomial through its window exactly. Five nodes determine a quartic, so that a
/// bi-cubic patch of surface has its exact normal at every node, also at the border.
#[rustfmt::skip]
const DERIVATIVES: [&[&[f64]]; 6] = [
    &[],
    &[],
    &[&[-1.0, 1.0], &[-1.0, 1.0]],
    &[&[-1.5, 2.0, -0.5], &[-0.5, 0.0, 0.5], &[0.5, -2.0, 1.5]],
    &[
        &[-11.0 / 6.0, 3.0, -1.5, 1.0 / 3.0], &[-1.0 / 3.0, -0.5, 1.0, -1.0 / 6.0],
        &[1.0 / 6.0, -1.0, 0.5, 1.0 / 3.0], &[-1.0 / 3.0, 1.5, -3.0, 11.0 / 6.0],
    ],
    &[
        &[-25.0 / 12.0, 4.0, -3.0, 4.0 / 3.0, -0.25], &[-0.25, -5.0 / 6.0, 1.5, -0.5, 1.0 / 12.0],
        &[1.0 / 12.0, -2.0 / 3.0, 0.0, 2.0 / 3.0, -1.0 / 12.0], &[-1.0 / 12.0, 0.5, -1.5, 5.0 / 6.0, 0.25],
        &[0.25, -4.0 / 3.0, 3.0, -4.0, 25.0 / 12.0],
    ],
];

/// Fits the unit normals of the nodes of a grid. Returns one vertex per node, in grid order: the point and its normal.
/// The directions of growing column number, of growing row number and of the normal are right-handed. The normal is NaN
/// at a hole, and at a node that has no neighbour in its row or in its column.
///
/// Equation: the normal is the cross product of the tangents along the row and along the column. A tangent is the
/// derivative of the quartic polynomial through five nodes on the grid line. Inside the grid the five nodes are centred
/// on the node. At the border and near holes they are one-sided. If fewer than five consecutive nodes exist, the degree
/// is lower.
pub(crate) fn fit_grid_nodes(points: &[Point], lattice: &GridTopology) -> Vec<Vertex> {
    let arch = pulp::Arch::new();
    // Whole blocks are written directly into the result; the last block is filled up with the last node.
    let blocks: Vec<[Vertex; BLOCK]> = (0..points.len().div_ceil(BLOCK))
        .into_par_iter()
        .with_min_len(64)
        .map(|block| arch.dispatch(NodeBlock { points, topology: lattice, first: block * BLOCK }))
        .collect();
    let mut nodes = blocks.into_flattened();
    nodes.truncate(points.len());
    nodes
}

/// Number of nodes that one call fits with the vector instructions of the machine.
const BLOCK: usize = 32;

struct NodeBlock<'a> {
    points: &'a [Point],
    topology: &'a GridTopology,
    first: usize,
}

impl pulp::NullaryFnOnce for NodeBlock<'_> {
    type Output = [Vertex; BLOCK];

    /// Returns 32 consecutive nodes of the grid with their fitted unit normals. The first one is the node with the
    /// index `first` of this block. Beyond the end of the grid, the last node of the grid is repeated.
    #[inline(always)]
    fn call(self) -> [Vertex; BLOCK] {
        const NONE: Vertex = Vertex { point: Point::new(0.0, 0.0, 0.0), normal: Vector::new(0.0, 0.0, 0.0) };
        let mut nodes = [NONE; BLOCK];
        let (columns, rows) = (self.topology.columns(), self.topology.rows());
        let (mut i, mut j) = (self.first % columns, self.first / columns);
        for (k, four) in nodes.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
            let node = self.first + k * LANES;
            let inner = i >= 2 && i + LANES + 2 <= columns && j >= 2 && j + 2 < rows;
            if inner && self.topology.present.is_empty() {
                self.fit_inside_x4(node, four);
            } else {
                self.fit_anywhere_x4(node, four);
            }
            i += LANES;
            if i >= columns {
                (i, j) = (i % columns, j + i / columns);
            }
        }
        nodes
    }
}

impl NodeBlock<'_> {
    /// Fits the unit normals of four consecutive nodes of one row, from the index `first` on, in SIMD lanes. Writes the
    /// nodes with their normals to `nodes`. The grid must have no holes. Each of the four nodes must have at least two
    /// nodes on every side in its row and in its column.
    #[inline(always)]
    fn fit_inside_x4(&self, first: usize, nodes: &mut [Vertex; LANES]) {
        let (u, v) = (self.central_derivative(first, 1), self.central_derivative(first, self.topology.columns()));
        let n = cross(&u, &v);
        let normal = F64x4::unit(&n);
        for (l, node) in nodes.iter_mut().enumerate() {
            let normal = Vector::new(normal[0].0[l], normal[1].0[l], normal[2].0[l]);
            *node = Vertex { point: self.points[first + l], normal };
        }
    }

    /// Returns the derivative of the position with respect to the node number on a grid line, in mm, at four nodes from
    /// the index `node` on, one node per SIMD lane. `stride` is the index step along the line: 1 for a row, the number
    /// of columns for a column.
    ///
    /// Equation: the central derivative of the quartic polynomial through five nodes of the line.
    #[inline(always)]
    fn central_derivative(&self, node: usize, stride: usize) -> Vector3x4 {
        let near = minus(&self.points_x4(node + stride), &self.points_x4(node - stride));
        let far = minus(&self.points_x4(node + 2 * stride), &self.points_x4(node - 2 * stride));
        minus(&times(&near, F64x4::splat(2.0 / 3.0)), &times(&far, F64x4::splat(1.0 / 12.0)))
    }

    /// Packs the four points from the index `first` on into SIMD lanes. Panics if fewer than four points are left.
    #[inline(always)]
    fn points_x4(&self, first: usize) -> Vector3x4 {
        let (four, _) = self.points[first..].split_first_chunk::<LANES>().expect("inside the grid");
        points_x4(four)
    }

    /// Fits the normals of four nodes from the index `first` on, one by one, and writes them to `nodes`. Works at
    /// borders and holes. Past the end it repeats the last node.
    #[inline(never)]
    fn fit_anywhere_x4(&self, first: usize, nodes: &mut [Vertex; LANES]) {
        let (points, lattice) = (self.points, self.topology);
        let (columns, rows) = (lattice.columns(), lattice.rows());
        for (l, vertex) in nodes.iter_mut().enumerate() {
            let node = (first + l).min(points.len() - 1);
            let u = line_derivative(points, lattice, node, 1, node % columns, columns);
            let v = line_derivative(points, lattice, node, columns, node / columns, rows);
            *vertex = Vertex { point: points[node], normal: u.cross(&v).normalize() };
        }
    }
}

/// Returns the derivative of the position with respect to the node number on a row or column, in mm, at the node with
/// the index `node`. The derivative is that of the polynomial through up to five existing nodes around `node`. Returns
/// NaN if the node is a hole or has no neighbour on the line.
///
/// `stride` is the index step between neighbouring nodes of the line. `at` is the number of the node on the line, from
/// 0. `count` is the number of nodes on the line.
fn line_derivative(
    points: &[Point],
    lattice: &GridTopology,
    node: usize,
    stride: usize,
    at: usize,
    count: usize,
) -> Vector {
    let nan = Vector::repeat(f64::NAN);
    if !lattice.is_present(node) {
        return nan;
    }
    let before = (1..=at.min(4)).take_while(|k| lattice.is_present(node - k * stride)).count();
    let after = (1..=(count - 1 - at).min(4)).take_while(|k| lattice.is_present(node + k * stride)).count();
    let width = (before + after + 1).min(5);
    if width < 2 {
        return nan;
    }
    let first = before.min(2.max((width - 1).saturating_sub(after)));
    let weights = DERIVATIVES[width][first];
    let start = node - first * stride;
    weights.iter().enumerate().map(|(k, w)| points[start + k * stride].coords * *w).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid_topology(columns: usize, rows: usize, z: impl Fn(f64, f64) -> f64) -> (Vec<Point>, GridTopology) {
        let points: Vec<_> = (0..rows)
            .flat_map(|j| (0..columns).map(move |i| (i as f64 * 0.5 - 2.0, j as f64 * 0.25 + 1.0)))
            .map(|(x, y)| Point::new(x, y, z(x, y)))
            .collect();
        let lattice = GridTopology::new(columns, rows, &points, true);
        (points, lattice)
    }

    #[test]
    fn grid_normals_of_bicubic_are_exact() {
        let z = |x: f64, y: f64| 0.01 * x * x * x * y * y * y - 0.2 * x * y * y + 0.3 * x;
        let gradient =
            |x: f64, y: f64| [0.03 * x * x * y.powi(3) - 0.2 * y * y + 0.3, 0.03 * x.powi(3) * y * y - 0.4 * x * y];
        for (columns, rows) in [(9, 8), (5, 5), (6, 12), (41, 9)] {
            let (points, lattice) = grid_topology(columns, rows, z);
            let nodes = fit_grid_nodes(&points, &lattice);
            assert_eq!(nodes.len(), points.len());
            for (p, Vertex { point, normal: n }) in points.iter().zip(nodes) {
                assert_eq!(*p, point);
                let [a, b] = gradient(p.x, p.y);
                assert!((n - Vector::new(-a, -b, 1.0).normalize()).norm() < 1e-13, "{p} {n}");
            }
        }
    }

    #[test]
    fn grid_normals_at_holes() {
        let (mut points, _) = grid_topology(7, 4, |x, y| 0.3 * x - 0.1 * y);
        points[9] = Point::new(f64::NAN, f64::NAN, f64::NAN);
        let lattice = GridTopology::new(7, 4, &points, true);
        let expected = Vector::new(-0.3, 0.1, 1.0).normalize();
        for (node, n) in fit_grid_nodes(&points, &lattice).iter().map(|vertex| vertex.normal).enumerate() {
            // Node 2 lies in no whole cell: the node above it is a hole.
            if node == 9 || node == 2 {
                assert!(n.x.is_nan());
            } else {
                assert!((n - expected).norm() < 1e-14, "node {node}: {n}");
            }
        }
    }

    #[test]
    fn grid_advance_stops_at_edge() {
        let (_, lattice) = grid_topology(9, 8, |_, _| 0.0);
        let from = lattice.facet_at(1, 1, 0);
        // u = 3.6, v = 2.2 from the lower left of cell (1, 1): cell (4, 3), the half at its lower right.
        assert_eq!(lattice.advance(from, &[1.0 - 3.6, 3.6 - 2.2, 2.2]), Some(lattice.facet_at(4, 3, 0)));
        let corner = lattice.facet_at(7, 6, 0);
        assert_eq!(lattice.advance(corner, &[-4.0, 3.0, 2.0]), None);
    }

    #[test]
    fn grid_search_starts_in_whole_cell() {
        let (mut points, _) = grid_topology(9, 8, |_, _| 0.0);
        points[..4 * 9].fill(Point::new(f64::NAN, f64::NAN, f64::NAN));
        let lattice = GridTopology::new(9, 8, &points, true);
        let facet = lattice.start(&Point::new(-2.0, 1.0, 0.0));
        assert!(lattice.corners(facet).iter().all(|&c| lattice.is_present(c as usize)));
    }
}
