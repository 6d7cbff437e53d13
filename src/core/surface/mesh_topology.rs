//! Triangles in flat arrays: corners, neighbours, and iteration around a vertex.

use crate::geometry::{Point, PointTree, Vector};

use super::error::SurfaceError;
use super::facet::Facets;

/// Neighbour number of an edge without a neighbour: the surface ends there.
pub(crate) const BORDER: u32 = u32::MAX;

/// Maximum number of facets in the search tree that gives the first facet of a search without an earlier result.
const MAX_START_FACETS: usize = 1 << 15;

/// Triangle mesh in which each facet knows its neighbours.
#[derive(Debug)]
pub(crate) struct MeshTopology {
    corners: Vec<[u32; 3]>,
    /// Facet across the edge opposite to corner k; [`BORDER`] if there is no such facet.
    neighbours: Vec<[u32; 3]>,
    /// One facet at each vertex. At a vertex on the border it is the first facet in counter-clockwise order.
    vertex_facets: Vec<u32>,
    start_tree: PointTree,
    start_facets: Vec<u32>,
}

impl MeshTopology {
    /// Builds the mesh from triangles, given by the indices of their corners. Finds the neighbours of each triangle.
    ///
    /// # Errors
    /// Returns an error if there is no triangle, if an index is out of range, if more than two triangles share an edge,
    /// if a triangle is given twice, or if neighbours have opposite orientation.
    pub(crate) fn new(points: &[Point], corners: Vec<[u32; 3]>) -> Result<Self, SurfaceError> {
        if corners.is_empty() {
            return Err(SurfaceError::NoTriangles);
        }
        if let Some(&vertex) = corners.iter().flatten().find(|&&c| c as usize >= points.len()) {
            return Err(SurfaceError::VertexOutOfRange { vertex, points: points.len() });
        }
        // A doubled triangle also breaks a rule of edges; the error that names it helps more.
        let neighbours =
            facet_neighbours(&corners, points).map_err(|error| find_doubled(&corners, points).unwrap_or(error))?;
        Self::from_parts(points, corners, neighbours)
    }

    /// Builds the mesh from triangles whose neighbours are known. `neighbours[f][k]` is the triangle across the edge
    /// opposite to corner k of the triangle f, or [`BORDER`].
    ///
    /// # Errors
    /// Returns an error if there is no triangle.
    pub(crate) fn from_parts(
        points: &[Point],
        corners: Vec<[u32; 3]>,
        neighbours: Vec<[u32; 3]>,
    ) -> Result<Self, SurfaceError> {
        if corners.is_empty() {
            return Err(SurfaceError::NoTriangles);
        }
        let (facet_of, (starts, start_facets)) = rayon::join(
            || first_facets(points.len(), &corners, &neighbours),
            || {
                let stride = corners.len().div_ceil(MAX_START_FACETS);
                let start_facets: Vec<u32> = (0..corners.len() as u32).step_by(stride).collect();
                let centre = |f: &u32| {
                    let sum: Vector = corners[*f as usize].iter().map(|&c| points[c as usize].coords).sum();
                    (sum / 3.0).into()
                };
                (PointTree::new(start_facets.iter().map(centre)), start_facets)
            },
        );
        Ok(Self { corners, neighbours, vertex_facets: facet_of, start_tree: starts, start_facets })
    }

    /// Returns true if no triangle has a border edge, so that the mesh encloses a solid.
    pub(crate) fn is_closed(&self) -> bool {
        self.neighbours.iter().flatten().all(|neighbour| *neighbour != BORDER)
    }

    pub(crate) fn facet_count(&self) -> u32 {
        self.corners.len() as u32
    }

    /// Calls `visit` with each facet around a vertex, counter-clockwise, and with the corner number (0 to 2) of the
    /// vertex in that facet.
    #[inline]
    pub(crate) fn visit_facets_around(&self, vertex: u32, mut visit: impl FnMut(u32, usize)) {
        let first = self.vertex_facets[vertex as usize];
        let mut facet = first;
        // A fan is finite, but a mesh from a file may be connected to itself in invalid ways.
        for _ in 0..1024 {
            if facet == BORDER {
                return;
            }
            let Some(k) = self.corners[facet as usize].iter().position(|&c| c == vertex) else { return };
            visit(facet, k);
            // Counter-clockwise around corner k, the next edge runs from k to k + 2; it is opposite to corner k + 1.
            facet = self.neighbours[facet as usize][(k + 1) % 3];
            if facet == first {
                return;
            }
        }
    }
}

impl MeshTopology {
    /// Calls `visit` with each neighbouring vertex of a vertex once, counter-clockwise.
    #[inline]
    pub(crate) fn visit_neighbours(&self, vertex: u32, mut visit: impl FnMut(u32)) {
        let mut last = None;
        self.visit_facets_around(vertex, |facet, k| {
            visit(self.corners[facet as usize][(k + 1) % 3]);
            last = Some((facet as usize, k));
        });
        // If the facets do not close around the vertex, the last one has one more neighbour.
        if let Some((facet, k)) = last
            && self.neighbours[facet][(k + 1) % 3] == BORDER
        {
            visit(self.corners[facet][(k + 2) % 3]);
        }
    }
}

impl MeshTopology {
    /// Writes the vertices around `vertex` into `ring`, each once. First come the neighbours of `vertex`,
    /// counter-clockwise (the first ring). Then come the other neighbours of these neighbours (the second ring).
    ///
    /// Returns two numbers: the count of the vertices in the first ring, and the count in both rings together. Returns
    /// `None` if the surface ends within the rings, or if `ring` is too small.
    ///
    /// For speed, only the facets outside the first ring are searched for the vertices of the second ring.
    #[inline(always)]
    pub(crate) fn two_rings<const N: usize>(&self, vertex: u32, ring: &mut [u32; N]) -> Option<[usize; 2]> {
        let place = |facet: u32, of: u32| self.corners[facet as usize].iter().position(|&c| c == of);
        let mut beyond = [BORDER; N];
        let (begin, mut first) = (self.vertex_facets[vertex as usize], 0);
        let mut facet = begin;
        while facet != BORDER && first < N {
            let k = place(facet, vertex)?;
            ring[first] = self.corners[facet as usize][(k + 1) % 3];
            beyond[first] = self.neighbours[facet as usize][k];
            first += 1;
            facet = self.neighbours[facet as usize][(k + 1) % 3];
            if facet == begin {
                break;
            }
        }
        if facet != begin || facet == BORDER {
            return None;
        }
        let (mut count, mut before) = (first, beyond[first - 1]);
        for k in 0..first {
            let (of, after) = (ring[k], beyond[k]);
            let mut facet = before;
            // A mesh from a file may be connected to itself in invalid ways.
            for _ in 0..N {
                if facet == BORDER {
                    return None;
                }
                if facet == after {
                    break;
                }
                let j = place(facet, of)?;
                let candidate = self.corners[facet as usize][(j + 2) % 3];
                if candidate != vertex && !ring[..count].contains(&candidate) {
                    *ring.get_mut(count)? = candidate;
                    count += 1;
                }
                facet = self.neighbours[facet as usize][(j + 1) % 3];
            }
            before = after;
        }
        Some([first, count])
    }
}

impl Facets for MeshTopology {
    #[inline]
    fn corners(&self, facet: u32) -> [u32; 3] {
        self.corners[facet as usize]
    }

    /// Returns the next facet of a walk towards the projection of a point. `weights` are the barycentric weights of the
    /// point in the facet `facet`. A negative weight means that the point lies beyond the edge opposite to that corner.
    ///
    /// Returns the neighbour across the edge with the most negative weight. Ignores border edges. Returns `None` if no
    /// edge with a negative weight has a neighbour.
    #[inline]
    fn advance(&self, facet: u32, weights: &[f64; 3]) -> Option<u32> {
        let across = &self.neighbours[facet as usize];
        (0..3)
            .filter(|&k| weights[k] < 0.0 && across[k] != BORDER)
            .min_by(|&a, &b| weights[a].total_cmp(&weights[b]))
            .map(|k| across[k])
    }

    fn ends_at(&self, facet: u32, corner: usize) -> bool {
        self.neighbours[facet as usize][corner] == BORDER
    }

    fn start(&self, p: &Point) -> u32 {
        let nearest = self.start_tree.nearest(p, 1).next();
        nearest.map_or(0, |(k, _)| self.start_facets[k])
    }
}

/// Returns three facet numbers for each facet: its neighbours across its three edges. Neighbour k is across the edge
/// opposite to corner k; it is [`BORDER`] if no facet is there. `corners` are the vertex indices of each facet, and
/// `points` are used only in the error. The neighbours are found by sorting the edges.
///
/// # Errors
/// Returns an error if more than two facets share an edge, or if two neighbours have opposite orientation.
fn facet_neighbours(corners: &[[u32; 3]], points: &[Point]) -> Result<Vec<[u32; 3]>, SurfaceError> {
    let mut edges: Vec<(u32, u32, u32)> = Vec::with_capacity(3 * corners.len());
    for (facet, c) in corners.iter().enumerate() {
        for k in 0..3 {
            let (a, b) = (c[(k + 1) % 3], c[(k + 2) % 3]);
            edges.push((a.min(b), a.max(b), (facet * 3 + k) as u32));
        }
    }
    rayon::slice::ParallelSliceMut::par_sort_unstable(edges.as_mut_slice());
    let mut neighbours = vec![[BORDER; 3]; corners.len()];
    for shared in edges.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        let at = points[shared[0].0 as usize];
        match shared {
            [_] => {}
            [(.., e), (.., f)] => {
                let [(fe, ke), (ff, kf)] = [e, f].map(|e| ((e / 3) as usize, (e % 3) as usize));
                if corners[fe][(ke + 1) % 3] == corners[ff][(kf + 1) % 3] {
                    return Err(SurfaceError::Orientation { at: at.into() });
                }
                neighbours[fe][ke] = ff as u32;
                neighbours[ff][kf] = fe as u32;
            }
            more => return Err(SurfaceError::NonManifold { at: at.into(), triangles: more.len() }),
        }
    }
    Ok(neighbours)
}

/// Returns an error that counts the repeated triangles and names the place of one of them; `None` if no triangle is
/// given twice.
fn find_doubled(corners: &[[u32; 3]], points: &[Point]) -> Option<SurfaceError> {
    let mut sorted: Vec<[u32; 3]> = corners.to_vec();
    sorted.iter_mut().for_each(|corners| corners.sort_unstable());
    sorted.sort_unstable();
    let twice = sorted.windows(2).filter(|pair| pair[0] == pair[1]);
    let count = twice.clone().count();
    let first = twice.map(|pair| pair[0][0]).next()?;
    Some(SurfaceError::DoubledTriangles { count, at: points[first as usize].into() })
}

/// Returns one facet number for each of the `vertices` vertices: a facet that has this vertex as a corner. The value is
/// [`BORDER`] if no facet has this vertex.
///
/// For a vertex on the border of the mesh, the facet is the first one in counter-clockwise order around the vertex. A
/// counter-clockwise walk from this facet therefore visits all facets at the vertex.
fn first_facets(vertices: usize, corners: &[[u32; 3]], neighbours: &[[u32; 3]]) -> Vec<u32> {
    let mut first = vec![BORDER; vertices];
    for (facet, c) in corners.iter().enumerate() {
        for k in 0..3 {
            // Clockwise from this facet around corner k, the shared edge is opposite to corner k + 2.
            let at_border = neighbours[facet][(k + 2) % 3] == BORDER;
            if first[c[k] as usize] == BORDER || at_border {
                first[c[k] as usize] = facet as u32;
            }
        }
    }
    first
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a square of four points and its centre, as a fan.
    fn fan() -> (Vec<Point>, Vec<[u32; 3]>) {
        let points = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0], [1.0, 1.0]].map(|[x, y]| Point::new(x, y, 0.0));
        (points.to_vec(), vec![[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    }

    #[test]
    fn mesh_neighbours_across_opposite_edge() {
        let (points, corners) = fan();
        let mesh = MeshTopology::new(&points, corners).unwrap();
        assert_eq!(mesh.neighbours[0], [1, 3, BORDER]);
        assert_eq!(mesh.neighbours[2], [3, 1, BORDER]);
    }

    #[test]
    fn mesh_vertex_ring_meets_all_facets() {
        let (points, corners) = fan();
        let mesh = MeshTopology::new(&points, corners).unwrap();
        let met = |vertex| {
            let mut facets = Vec::new();
            mesh.visit_facets_around(vertex, |f, _| facets.push(f));
            facets.sort_unstable();
            facets
        };
        assert_eq!(met(4), [0, 1, 2, 3]);
        assert_eq!(met(0), [0, 3]);
        assert_eq!(met(2), [1, 2]);
    }

    #[test]
    fn mesh_advance_stops_at_border() {
        let (points, corners) = fan();
        let mesh = MeshTopology::new(&points, corners).unwrap();
        assert_eq!(mesh.advance(0, &[-0.5, 0.9, 0.6]), Some(1));
        assert_eq!(mesh.advance(0, &[-0.2, -0.5, 1.7]), Some(3));
        assert_eq!(mesh.advance(0, &[0.6, 0.6, -0.2]), None);
    }

    #[test]
    fn closed_mesh_has_no_border() {
        let (points, corners) = fan();
        assert!(!MeshTopology::new(&points, corners).unwrap().is_closed());
        let corner = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(Point::from);
        let solid = vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        assert!(MeshTopology::new(&corner, solid).unwrap().is_closed());
    }

    #[test]
    fn mesh_refuses_non_surfaces() {
        let (points, mut corners) = fan();
        corners[1] = [2, 1, 4];
        assert!(matches!(MeshTopology::new(&points, corners.clone()), Err(SurfaceError::Orientation { .. })));
        let one_edge = vec![[0, 1, 4], [1, 0, 3], [0, 1, 2]];
        assert!(matches!(MeshTopology::new(&points, one_edge), Err(SurfaceError::NonManifold { .. })));
        let (_, once) = fan();
        // The result does not depend on the first corner or on the turning sense.
        for again in [[0, 1, 4], [4, 0, 1], [1, 0, 4]] {
            let twice = MeshTopology::new(&points, [&once[..], &[again]].concat());
            assert!(matches!(twice, Err(SurfaceError::DoubledTriangles { count: 1, .. })), "{again:?}");
        }
        assert!(matches!(MeshTopology::new(&points, vec![[0, 1, 9]]), Err(SurfaceError::VertexOutOfRange { .. })));
        assert!(matches!(MeshTopology::new(&points, Vec::new()), Err(SurfaceError::NoTriangles)));
    }
}
