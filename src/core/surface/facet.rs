//! Geometry of one facet: its corners on the offset surface, the projection of a point onto it, and the curved distance
//! of the point.
//!
//! A corner is offset along its normal, S_e = S + r n, eq. (3). The flat distance is that of the paper, eq. (1) and
//! (2). The curved distance accounts for the bulge of the surface between its corners. With barycentric weights b and
//! the slope of the surface along each edge at each of its ends, the height over the flat facet is the cubic
//!
//! ```text
//! h(b) = sum over i != j of g_ij b_i^2 b_j + 1/2 b_0 b_1 b_2 sum over i != j of g_ij,   g_ij = -n_i.(p_j - p_i)
//! ```
//!
//! This is the cubic triangle with quadratic precision (Vlachos et al., Curved PN triangles, 2001), with its heights
//! taken along the normals of the surface instead of the normal of the facet. The projection onto the flat facet is
//! displaced by the distance times the tilt of the surface against the facet. So the distance along the normal n(b) of
//! the surface is d (N.n(b)) - h(b), with the flat distance d and the flat normal N. It is exact to third order in the
//! size of a facet.
//!
//! The code is generic over [`Real`], so that the same code works for one facet and for four in parallel lanes.

use super::simd::{F64x4, LANES, Real, Vector3x4, cross, dot, minus, times};
use crate::geometry::{Point, Vector};

/// Point of a surface with its unit normal. A point location needs both; they are adjacent in memory, because two
/// separate arrays would need twice the cache lines.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Vertex {
    pub(crate) point: Point,
    pub(crate) normal: Vector,
}

/// Side of the nominal surface on which the probe travels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Side {
    /// The side that the normals of the nominal surface point to: +z for a height over the plane, outwards for a mesh.
    #[default]
    Normal,
    /// The opposite side.
    Opposite,
}

impl Side {
    /// Returns +1 for the side of the normals and -1 for the opposite side.
    pub fn sign(self) -> f64 {
        match self {
            Self::Normal => 1.0,
            Self::Opposite => -1.0,
        }
    }

    /// Returns the other side.
    pub fn other(self) -> Self {
        match self {
            Self::Normal => Self::Opposite,
            Self::Opposite => Self::Normal,
        }
    }
}

/// Triangles for a point location; counter-clockwise as seen from the side of the normals.
pub(crate) trait Facets: Sync {
    /// Returns the three corners of a facet, as indices of vertices.
    fn corners(&self, facet: u32) -> [u32; 3];

    /// Returns the next facet of a walk towards the projection of a point. `weights` are the barycentric weights of the
    /// point in the current facet `facet`; a negative weight means that the point lies beyond an edge. Returns `None`
    /// if the surface ends in this direction, or if the walk would stay in the same facet.
    fn advance(&self, facet: u32, weights: &[f64; 3]) -> Option<u32>;

    /// Returns true if the surface ends at one edge of a facet: the edge opposite to the corner with the number
    /// `corner` (0 to 2).
    fn ends_at(&self, facet: u32, corner: usize) -> bool;

    /// Returns a facet from which to start the search for the projection of `p`.
    fn start(&self, p: &Point) -> u32;
}

/// Corner on the offset surface, eq. (3), and its unit normal towards the probe's side.
pub(crate) type Corner<T> = ([T; 3], [T; 3]);

/// One facet, or four in parallel lanes, with the corners on the offset surface.
pub(crate) struct Facet<T> {
    corners: [[T; 3]; 3],
    normals: [[T; 3]; 3],
    /// Normal of the flat facet, not of unit length; its direction follows from the order of the corners.
    /// `area_normal_squared` is its squared length.
    pub(crate) area_normal: [T; 3],
    pub(crate) area_normal_squared: T,
    /// +1 for the side of the normals, -1 for the opposite side.
    sign: T,
}

impl<T: Real> Facet<T> {
    /// Creates a facet from its corners on the offset surface. `sign` is +1 if the probe is on the side of the normals,
    /// otherwise -1.
    #[inline(always)]
    pub(crate) fn new([a, b, c]: [Corner<T>; 3], sign: T) -> Self {
        let turned = cross(&minus(&b.0, &a.0), &minus(&c.0, &a.0));
        Self {
            corners: [a.0, b.0, c.0],
            normals: [a.1, b.1, c.1],
            area_normal: turned,
            area_normal_squared: dot(&turned, &turned),
            sign,
        }
    }

    /// Returns the vector from a corner (number 0 to 2) to the point `p`.
    #[inline(always)]
    pub(crate) fn vector_from_corner(&self, corner: usize, p: &[T; 3]) -> [T; 3] {
        minus(p, &self.corners[corner])
    }

    /// Returns the vector along the edge from one corner to another (numbers 0 to 2).
    #[inline(always)]
    pub(crate) fn edge(&self, from: usize, to: usize) -> [T; 3] {
        minus(&self.corners[to], &self.corners[from])
    }

    /// Returns the barycentric weights of a point projected perpendicularly onto the plane of the flat facet. Weight k
    /// belongs to corner k, and the sum of the weights is 1. A negative weight means that the projection lies outside
    /// the facet. `w` is the vector from corner 0 to the point, in mm.
    #[inline(always)]
    pub(crate) fn weights(&self, w: &[T; 3]) -> [T; 3] {
        let (e1, e2) = (self.edge(0, 1), self.edge(0, 2));
        let per_squared = T::splat(1.0) / self.area_normal_squared;
        let b1 = dot(&cross(w, &e2), &self.area_normal) * per_squared;
        let b2 = dot(&cross(&e1, w), &self.area_normal) * per_squared;
        [T::splat(1.0) - b1 - b2, b1, b2]
    }

    /// Returns the unit normal of the flat facet, towards the side of the probe; eq. (1) of the paper.
    #[inline(always)]
    pub(crate) fn flat_normal(&self) -> [T; 3] {
        times(&self.area_normal, self.sign / self.area_normal_squared.sqrt())
    }

    /// Returns the point of the flat facet with the barycentric weights `b`.
    #[inline(always)]
    pub(crate) fn point(&self, b: &[T; 3]) -> [T; 3] {
        weighted(&self.corners, b)
    }

    /// Returns the unit normal of the curved surface at the barycentric weights `b`: the normalised weighted mean of
    /// the corner normals.
    #[inline(always)]
    pub(crate) fn normal(&self, b: &[T; 3]) -> [T; 3] {
        T::unit(&weighted(&self.normals, b))
    }

    /// Returns the height of the curved surface above the flat facet at the barycentric weights `b`, in mm. It is
    /// positive on the side of the probe.
    #[inline(always)]
    pub(crate) fn height(&self, b: &[T; 3]) -> T {
        let zero = T::splat(0.0);
        let (mut along, mut total) = (zero, zero);
        for (i, j) in [(0, 1), (1, 2), (2, 0)] {
            let edge = self.edge(i, j);
            // Slope of the surface along the edge at its start, and the slope against the edge's direction at its end.
            let (leaving, arriving) = (zero - dot(&self.normals[i], &edge), dot(&self.normals[j], &edge));
            along = along + b[i] * b[j] * (b[i] * leaving + b[j] * arriving);
            total = total.plus(leaving, arriving);
        }
        along + T::splat(0.5) * total * b[0] * b[1] * b[2]
    }

    /// Returns the signed distance of a point from the plane through the three corners, in mm, and the unit normal of
    /// this plane; eq. (2) of the paper. The distance is positive on the side of the probe. `w` is the vector from
    /// corner 0 to the point, in mm.
    #[inline(always)]
    pub(crate) fn flat_distance(&self, w: &[T; 3]) -> (T, [T; 3]) {
        let flat = self.flat_normal();
        (dot(w, &flat), flat)
    }

    /// Returns the signed distance of a point from the curved surface, in mm, and the unit normal of the curved surface
    /// at the projection of the point. The distance is positive on the side of the probe. `w` is the vector from corner
    /// 0 to the point, in mm. `b` are the barycentric weights of the projection.
    #[inline(always)]
    pub(crate) fn curved_distance(&self, w: &[T; 3], b: &[T; 3]) -> (T, [T; 3]) {
        let (flat_mm, flat) = self.flat_distance(w);
        let normal = self.normal(b);
        (flat_mm * dot(&normal, &flat) - self.height(b), normal)
    }
}

/// Returns the sum of three vectors `v`, each multiplied by its weight in `b`.
#[inline(always)]
fn weighted<T: Real>(v: &[[T; 3]; 3], b: &[T; 3]) -> [T; 3] {
    let at = |k: usize| v[0][k] * b[0] + v[1][k] * b[1] + v[2][k] * b[2];
    [at(0), at(1), at(2)]
}

/// Moves a vertex of the nominal surface by `radius_mm` along its normal onto the offset surface, eq. (3) of the paper.
/// Returns the moved point, and the unit normal towards the side of the probe. `sign` is +1 if the probe is on the side
/// of the given normal, otherwise -1.
#[inline(always)]
pub(crate) fn offset_corner<T: Real>((point, normal): ([T; 3], [T; 3]), sign: T, radius_mm: T) -> Corner<T> {
    let normal = times(&normal, sign);
    ([point[0] + normal[0] * radius_mm, point[1] + normal[1] * radius_mm, point[2] + normal[2] * radius_mm], normal)
}

/// Packs four vertices into SIMD lanes, one vertex per lane. Returns the points and the normals of the vertices. Each
/// of the two results contains three SIMD vectors: the four x, the four y and the four z.
///
/// Each SIMD vector is built directly from four numbers, not through an array in memory. An array would be slower: the
/// processor must finish the four single writes before it can read them as one vector.
#[inline(always)]
pub(crate) fn vertices_x4([a, b, c, d]: &[Vertex; LANES]) -> (Vector3x4, Vector3x4) {
    let normal = [
        F64x4([a.normal.x, b.normal.x, c.normal.x, d.normal.x]),
        F64x4([a.normal.y, b.normal.y, c.normal.y, d.normal.y]),
        F64x4([a.normal.z, b.normal.z, c.normal.z, d.normal.z]),
    ];
    (points_x4(&[a.point, b.point, c.point, d.point]), normal)
}

/// Packs four points into SIMD lanes, one point per lane. Returns x, y and z of the four points.
#[inline(always)]
pub(crate) fn points_x4(points: &[Point; LANES]) -> Vector3x4 {
    let [a, b, c, d] = points;
    [F64x4([a.x, b.x, c.x, d.x]), F64x4([a.y, b.y, c.y, d.y]), F64x4([a.z, b.z, c.z, d.z])]
}

/// Facet as the start of a search: the facet where the last search for this point ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FacetIndex {
    pub(super) patch: u32,
    pub(super) facet: u32,
}

impl FacetIndex {
    /// Unknown facet: the search chooses its own start.
    pub const UNKNOWN: Self = Self { patch: 0, facet: u32::MAX };

    /// Combines the number `patch` of a patch and the number `facet` of a facet in this patch into one index.
    pub(crate) fn new(patch: u32, facet: u32) -> Self {
        Self { patch, facet }
    }

    /// Creates the index of the facet with the number `facet` in the first patch (patch 0). Use it for a surface that
    /// has a single patch.
    pub(crate) fn in_first_patch(facet: u32) -> Self {
        Self { patch: 0, facet }
    }

    pub(crate) fn patch(self) -> u32 {
        self.patch
    }

    pub(crate) fn facet(self) -> u32 {
        self.facet
    }
}
