//! The surface on which the centre of a probe travels, and the signed distance of a point from it.
//!
//! A corner of a facet is offset along its normal, S_e = S + r n, eq. (3). The flat distance is that of the paper,
//! eq. (1) and (2). The curved distance knows that the surface bulges between its corners: with barycentric weights b and the
//! slope of the surface along each edge at each of its ends, the height over the flat facet is the cubic
//!
//! ```text
//! h(b) = sum over i != j of g_ij b_i^2 b_j + 1/2 b_0 b_1 b_2 sum over i != j of g_ij,   g_ij = -n_i.(p_j - p_i)
//! ```
//!
//! which is the cubic triangle with quadratic precision (Vlachos et al., Curved PN triangles, 2001), its heights taken along
//! the normals of the surface instead of the normal of the facet. The foot of the perpendicular on the flat facet is off by
//! the distance times the lean of the surface against the facet, so the distance along the normal n(b) of the surface is
//! d (N.n(b)) - h(b), with d and N the flat distance and normal: exact to third order in the size of a facet.

use crate::geometry::{Point, Vector};

use super::patch::{Facets, Lattice, Patch};
use super::{Nominal, SurfaceError};

/// How the surface runs between the corners of a facet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Distance {
    /// As the cubic that its corners and normals define.
    #[default]
    Curved,
    /// Flat, eq. (2).
    Triangle,
}

/// Which facet a point belongs to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Lookup {
    /// The one that holds the foot of its perpendicular.
    #[default]
    Foot,
    /// The one above or below which it lies along z, as in section 2.1 of the paper.
    Projection,
}

/// On which side of the nominal surface the probe travels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Side {
    /// Where the normals of the nominal surface point: +z for a height over the plane, outwards for a mesh.
    #[default]
    Normal,
    /// The other one.
    Opposite,
}

impl Side {
    /// Returns +1 on the side of the normals and -1 on the other.
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

/// The offset of a nominal surface: a view that holds no points of its own.
#[derive(Clone, Copy, Debug)]
pub struct OffsetSurface<'a> {
    nominal: &'a Nominal,
    /// Distance from the nominal surface along the outward normal, in millimetres.
    radius_mm: f64,
    side: Side,
    distance: Distance,
    lookup: Lookup,
}

/// Where a search for a foot begins: the facet where the last one ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    patch: u32,
    facet: u32,
}

impl Place {
    /// Nothing known yet.
    pub const UNKNOWN: Self = Self { patch: 0, facet: u32::MAX };

    /// A facet of a surface of one patch.
    pub(crate) fn on_first_patch(facet: u32) -> Self {
        Self { patch: 0, facet }
    }

    pub(crate) fn patch(self) -> u32 {
        self.patch
    }

    pub(crate) fn facet(self) -> u32 {
        self.facet
    }
}

/// The foot of a point on the offset surface.
#[derive(Clone, Copy, Debug)]
pub struct Foot {
    /// The facet that holds it.
    pub place: Place,
    /// Signed distance of the point from the offset surface, in millimetres; positive on the probe's side.
    pub distance_mm: f64,
    /// Unit normal at the foot, towards the probe's side.
    pub normal: Vector,
    /// How far the foot lies beyond the edge of the surface, in millimetres; 0 on the part.
    pub beyond_mm: f64,
    /// How far that is in steps of the nominal sampling.
    pub beyond_steps: f64,
}

/// A foot this many steps of the sampling beyond the edge is still on the part: the curved facet continues that far.
const EDGE_REACH: f64 = 0.5;

/// Steps after which a search gives up and takes the facet it is at: far more than any search that converges needs.
const MOST_STEPS: usize = 4096;

/// Weights that far below zero count as inside.
pub(super) const INSIDE: f64 = -1e-10;

impl<'a> OffsetSurface<'a> {
    /// Offsets a nominal surface by a probe radius.
    ///
    /// Units: millimetres. A radius of 0 is the nominal surface itself.
    ///
    /// # Errors
    /// A radius that is negative or not finite.
    pub fn new(nominal: &'a Nominal, radius_mm: f64, side: Side) -> Result<Self, SurfaceError> {
        if !(radius_mm >= 0.0 && radius_mm.is_finite()) {
            return Err(SurfaceError::ProbeRadius { radius_mm });
        }
        Ok(Self { nominal, radius_mm, side, distance: Distance::default(), lookup: Lookup::default() })
    }

    /// Chooses how the surface runs between the corners.
    pub fn with_distance(self, distance: Distance) -> Self {
        Self { distance, ..self }
    }

    /// Chooses which facet a point belongs to.
    pub fn with_lookup(self, lookup: Lookup) -> Self {
        Self { lookup, ..self }
    }

    /// Chooses the side of the nominal surface.
    pub fn with_side(self, side: Side) -> Self {
        Self { side, ..self }
    }

    /// Returns the nominal surface that is offset.
    pub fn nominal(&self) -> &'a Nominal {
        self.nominal
    }

    /// Returns the offset in millimetres.
    pub fn radius_mm(&self) -> f64 {
        self.radius_mm
    }

    pub(crate) fn distance(&self) -> Distance {
        self.distance
    }

    pub(crate) fn lookup(&self) -> Lookup {
        self.lookup
    }

    /// Returns the side of the nominal surface.
    pub fn side(&self) -> Side {
        self.side
    }

    /// Returns the step of the nominal sampling at a place, in millimetres: the side of a square of two of its facets.
    pub(crate) fn spacing_mm(&self, place: Place) -> f64 {
        let patch = &self.nominal.patches()[place.patch as usize];
        let [a, b, c] = patch.corners(place.facet).map(|v| *patch.point(v));
        (b - a).cross(&(c - a)).norm().sqrt()
    }

    /// Finds the foot of a point given in the model frame, starting from where the last search for it ended.
    ///
    /// Beyond the edge the surface is continued: by its own facet for half a step of the sampling, then by the tangent plane
    /// at the nearest place of the edge.
    #[inline]
    pub fn foot(&self, p: &Point, start: Place) -> Foot {
        match self.nominal.patches() {
            [only] => self.foot_on(only, 0, p, start),
            patches => self.nearest_foot(patches, p, start),
        }
    }

    /// The foot on the patch that a point belongs to: the nearest one that has it inside, else the one it is least beyond.
    fn nearest_foot(&self, patches: &[Patch], p: &Point, start: Place) -> Foot {
        let rank = |f: &Foot| {
            let beyond = if f.beyond_steps <= EDGE_REACH { 0.0 } else { f.beyond_mm };
            (beyond, f.distance_mm.abs())
        };
        patches
            .iter()
            .enumerate()
            .map(|(k, patch)| self.foot_on(patch, k as u32, p, start))
            .min_by(|a, b| {
                let (a, b) = (rank(a), rank(b));
                a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1))
            })
            .expect("a nominal surface has at least one patch")
    }

    #[inline]
    fn foot_on(&self, patch: &Patch, number: u32, p: &Point, start: Place) -> Foot {
        let start = if start.patch == number { start.facet } else { u32::MAX };
        match &patch.lattice {
            Lattice::Grid(grid) => self.search(patch, grid, number, p, start),
            Lattice::Mesh(mesh) => self.search(patch, mesh, number, p, start),
        }
    }

    /// Walks over the flat facets of the nominal surface to about where the foot is, without a normal having to be fitted on
    /// the way: the point is brought back to the surface along the normal of each facet.
    #[inline]
    fn approach<F: Facets>(&self, patch: &Patch, facets: &F, p: &Point, start: u32) -> u32 {
        let mut facet = if start == u32::MAX { facets.start(p) } else { start };
        if !patch.has_scattered_normals() {
            return facet;
        }
        let mut before = u32::MAX;
        for _ in 0..MOST_STEPS {
            let [a, b, c] = facets.corners(facet).map(|v| *patch.point(v));
            let (e1, e2) = (b - a, c - a);
            let turned = e1.cross(&e2);
            let squared = turned.norm_squared();
            let w = p - a - turned * (self.radius_mm * self.side.sign() / squared.sqrt());
            let (b1, b2) = (w.cross(&e2).dot(&turned) / squared, e1.cross(&w).dot(&turned) / squared);
            let weights = [1.0 - b1 - b2, b1, b2];
            let inside = weights[0].min(b1).min(b2) >= 0.0;
            match if inside { None } else { facets.advance(facet, &weights) } {
                Some(next) if next != before => (before, facet) = (facet, next),
                _ => break,
            }
        }
        facet
    }

    /// Finds a facet of the first patch near the foot of a point, without its normals.
    pub(super) fn place_near<F: Facets>(&self, patch: &Patch, facets: &F, p: &Point, start: Place) -> Place {
        Place { patch: 0, facet: self.approach(patch, facets, p, start.facet) }
    }

    /// Walks from facet to facet until one holds the foot, then measures there.
    #[inline]
    fn search<F: Facets>(&self, patch: &Patch, facets: &F, number: u32, p: &Point, start: u32) -> Foot {
        let mut facet = self.approach(patch, facets, p, start);
        let mut before = u32::MAX;
        for _ in 0..MOST_STEPS {
            let corner = OffsetFacet::new(self, patch, facets.corners(facet));
            let weights = corner.weights(p, self.lookup);
            let inside = weights[0].min(weights[1]).min(weights[2]) >= INSIDE;
            let next = if inside { None } else { facets.advance(facet, &weights) };
            match next {
                // Two facets that point at each other: the foot lies on their common edge, in the gap that prisms over a
                // convex edge leave.
                Some(next) if next != before => {
                    before = facet;
                    facet = next;
                }
                _ => return corner.foot(p, weights, inside || next.is_some(), self.distance, number, facet),
            }
        }
        let corner = OffsetFacet::new(self, patch, facets.corners(facet));
        let weights = corner.weights(p, self.lookup);
        corner.foot(p, weights, true, self.distance, number, facet)
    }
}

/// A facet with its corners on the offset surface.
struct OffsetFacet {
    x: [Vector; 3],
    n: [Vector; 3],
    /// Normal of the flat facet, not of unit length, in the sense in which the corners turn.
    turned: Vector,
    /// The same of unit length, towards the probe's side; eq. (1).
    flat: Vector,
    per_turned_squared: f64,
}

impl OffsetFacet {
    #[inline(always)]
    fn new(surface: &OffsetSurface, patch: &Patch, [a, b, c]: [u32; 3]) -> Self {
        let sign = surface.side.sign();
        let (a, b, c) = (patch.vertex(a), patch.vertex(b), patch.vertex(c));
        let n = [a.normal * sign, b.normal * sign, c.normal * sign];
        let offset = |point: &Point, n: &Vector| point.coords + n * surface.radius_mm; // eq. (3)
        let x = [offset(&a.point, &n[0]), offset(&b.point, &n[1]), offset(&c.point, &n[2])];
        let turned = (x[1] - x[0]).cross(&(x[2] - x[0]));
        let squared = turned.norm_squared();
        let flat = turned * (sign / squared.sqrt());
        Self { x, n, turned, flat, per_turned_squared: 1.0 / squared }
    }

    /// Barycentric weights of the foot on the plane of the flat facet.
    #[inline(always)]
    fn weights(&self, p: &Point, lookup: Lookup) -> [f64; 3] {
        let mut w = p.coords - self.x[0];
        if lookup == Lookup::Projection {
            w.z -= w.dot(&self.turned) / self.turned.z;
        }
        let b1 = w.cross(&(self.x[2] - self.x[0])).dot(&self.turned) * self.per_turned_squared;
        let b2 = (self.x[1] - self.x[0]).cross(&w).dot(&self.turned) * self.per_turned_squared;
        [1.0 - b1 - b2, b1, b2]
    }

    #[inline(always)]
    fn foot(&self, p: &Point, weights: [f64; 3], inside: bool, distance: Distance, patch: u32, facet: u32) -> Foot {
        let place = Place { patch, facet };
        let (mut beyond_mm, mut beyond_steps) = (0.0, 0.0);
        if !inside {
            let clamped = self.clamped(p, &weights);
            beyond_mm = (self.at(&clamped) - self.at(&weights)).norm();
            beyond_steps = beyond_mm / self.turned.norm().sqrt();
            if beyond_steps > EDGE_REACH {
                let (distance_mm, normal) = self.over_tangent_plane(p, &clamped, distance);
                return Foot { place, distance_mm, normal, beyond_mm, beyond_steps };
            }
        }
        let flat_mm = (p.coords - self.x[0]).dot(&self.flat); // eq. (2)
        let (distance_mm, normal) = match distance {
            Distance::Triangle => (flat_mm, self.flat),
            Distance::Curved => {
                let normal = self.normal(&weights);
                (flat_mm * normal.dot(&self.flat) - self.height(&weights), normal)
            }
        };
        Foot { place, distance_mm, normal, beyond_mm, beyond_steps }
    }

    /// The distance from the tangent plane at a place of the edge, and its normal.
    #[cold]
    fn over_tangent_plane(&self, p: &Point, at: &[f64; 3], distance: Distance) -> (f64, Vector) {
        let (anchor, normal) = match distance {
            Distance::Triangle => (self.at(at), self.flat),
            Distance::Curved => (self.at(at) + self.flat * self.height(at), self.normal(at)),
        };
        ((p.coords - anchor).dot(&normal), normal)
    }

    #[inline(always)]
    fn at(&self, b: &[f64; 3]) -> Vector {
        self.x[0] * b[0] + self.x[1] * b[1] + self.x[2] * b[2]
    }

    #[inline(always)]
    fn normal(&self, b: &[f64; 3]) -> Vector {
        let n = self.n[0] * b[0] + self.n[1] * b[1] + self.n[2] * b[2];
        n / n.norm_squared().sqrt()
    }

    /// Height of the curved surface over the flat facet, positive on the probe's side.
    #[inline(always)]
    fn height(&self, b: &[f64; 3]) -> f64 {
        let edges = [self.x[1] - self.x[0], self.x[2] - self.x[1], self.x[0] - self.x[2]];
        // Slope of the surface along edge k, at its beginning and against its direction at its end.
        let leaving = |k: usize| -self.n[k].dot(&edges[k]);
        let arriving = |k: usize, end: usize| self.n[end].dot(&edges[k]);
        let g = [(leaving(0), arriving(0, 1)), (leaving(1), arriving(1, 2)), (leaving(2), arriving(2, 0))];
        let along = b[0] * b[1] * (b[0] * g[0].0 + b[1] * g[0].1)
            + b[1] * b[2] * (b[1] * g[1].0 + b[2] * g[1].1)
            + b[2] * b[0] * (b[2] * g[2].0 + b[0] * g[2].1);
        let total = g[0].0 + g[0].1 + g[1].0 + g[1].1 + g[2].0 + g[2].1;
        along + 0.5 * total * b[0] * b[1] * b[2]
    }

    /// Weights of the nearest place of the facet for a point that lies beyond its most negative edge.
    fn clamped(&self, p: &Point, b: &[f64; 3]) -> [f64; 3] {
        let k = (0..3).min_by(|&i, &j| b[i].total_cmp(&b[j])).expect("three weights");
        let (i, j) = ((k + 1) % 3, (k + 2) % 3);
        let edge = self.x[j] - self.x[i];
        let t = ((p.coords - self.x[i]).dot(&edge) / edge.norm_squared()).clamp(0.0, 1.0);
        let mut clamped = [0.0; 3];
        (clamped[i], clamped[j]) = (1.0 - t, t);
        clamped
    }
}
