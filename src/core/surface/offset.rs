//! The surface on which the centre of a probe travels, and where the foot of a point on it is; the formula is in [`super::facet`].

use crate::geometry::{Point, Vector};

use super::error::SurfaceError;
use super::facet::{Facet, Facets, Side, corner};
use super::nominal::Nominal;
use super::patch::{Lattice, Patch};
use super::simd::{dot, minus};

/// How the surface runs between the corners of a facet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
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
pub(crate) enum Lookup {
    /// The one that holds the foot of its perpendicular.
    #[default]
    Foot,
    /// The one above or below which it lies along z, as in section 2.1 of the paper.
    Projection,
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

    /// A facet of a patch.
    pub(crate) fn on(patch: u32, facet: u32) -> Self {
        Self { patch, facet }
    }

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

impl Foot {
    /// The one that is least beyond an edge first; of those on the part the nearest.
    fn by_nearness(&self, other: &Self) -> std::cmp::Ordering {
        self.beyond_mm.total_cmp(&other.beyond_mm).then(self.distance_mm.abs().total_cmp(&other.distance_mm.abs()))
    }
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
    pub(crate) fn with_lookup(self, lookup: Lookup) -> Self {
        Self { lookup, ..self }
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
    ///
    /// The offsets of patches that only touch leave a gap over a convex seam. A foot that is a little beyond two of them at one height lies in that
    /// gap, and on the part.
    fn nearest_foot(&self, patches: &[Patch], p: &Point, start: Place) -> Foot {
        let feet: Vec<Foot> =
            patches.iter().enumerate().map(|(k, patch)| self.foot_on(patch, k as u32, p, start)).collect();
        let best = feet.iter().copied().min_by(Foot::by_nearness).expect("a nominal surface has at least one patch");
        let is_at_seam = |other: &Foot| {
            let apart_mm = (other.distance_mm - best.distance_mm).abs();
            other.place.patch != best.place.patch
                && other.beyond_steps <= EDGE_REACH
                && apart_mm <= EDGE_REACH * self.spacing_mm(best.place)
        };
        if best.beyond_steps > 0.0 && best.beyond_steps <= EDGE_REACH && feet.iter().any(is_at_seam) {
            return Foot { beyond_mm: 0.0, beyond_steps: 0.0, ..best };
        }
        best
    }

    /// Searches for the foot of a point anew, from the places of the surface nearest to it, and returns the nearest one that is found.
    ///
    /// A search walks downhill, and in a gutter from the wrong wall: it ends where no neighbour is nearer, at a foot on the other side.
    #[cold]
    pub(crate) fn foot_from_anywhere(&self, p: &Point) -> Foot {
        let found = self
            .nominal
            .places_near(p)
            .map(|start| self.foot_on(&self.nominal.patches()[start.patch as usize], start.patch, p, start));
        found.min_by(Foot::by_nearness).unwrap_or_else(|| self.foot(p, Place::UNKNOWN))
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
            let here = self.facet(patch, facets.corners(facet));
            let weights = self.weights(&here, p);
            let inside = weights[0].min(weights[1]).min(weights[2]) >= INSIDE;
            let next = if inside { None } else { facets.advance(facet, &weights) };
            match next {
                // Two facets that point at each other: the foot lies on their common edge, in the gap that prisms over a
                // convex edge leave.
                Some(next) if next != before => {
                    before = facet;
                    facet = next;
                }
                _ => {
                    // Two that point at each other at the border have the foot between them only along it.
                    let is_beyond = |k: usize| weights[k] < INSIDE && facets.ends_at(facet, k);
                    let inside = inside || next.is_some() && !(0..3).any(is_beyond);
                    return self.foot_in(&here, p, weights, inside, Place { patch: number, facet });
                }
            }
        }
        let here = self.facet(patch, facets.corners(facet));
        self.foot_in(&here, p, self.weights(&here, p), true, Place { patch: number, facet })
    }

    /// A facet with its corners on the offset surface.
    #[inline(always)]
    fn facet(&self, patch: &Patch, corners: [u32; 3]) -> Facet<f64> {
        let sign = self.side.sign();
        let [a, b, c] = corners.map(|k| patch.vertex(k)).map(|v| (v.point.coords.into(), v.normal.into()));
        Facet::new([a, b, c].map(|vertex| corner(vertex, sign, self.radius_mm)), sign)
    }

    /// Barycentric weights of the foot on the plane of the flat facet.
    #[inline(always)]
    fn weights(&self, facet: &Facet<f64>, p: &Point) -> [f64; 3] {
        let mut w = facet.seen_from(0, &p.coords.into());
        if self.lookup == Lookup::Projection {
            w[2] -= dot(&w, &facet.turned) / facet.turned[2];
        }
        facet.weights(&w)
    }

    #[inline(always)]
    fn foot_in(&self, facet: &Facet<f64>, p: &Point, weights: [f64; 3], inside: bool, place: Place) -> Foot {
        let w = facet.seen_from(0, &p.coords.into());
        let (mut beyond_mm, mut beyond_steps) = (0.0, 0.0);
        if !inside {
            let clamped = clamped(facet, &p.coords.into(), &weights);
            let beyond = minus(&facet.at(&clamped), &facet.at(&weights));
            beyond_mm = dot(&beyond, &beyond).sqrt();
            beyond_steps = beyond_mm / facet.squared.sqrt().sqrt();
            if beyond_steps > EDGE_REACH {
                let (distance_mm, normal) = self.over_tangent_plane(facet, p, &clamped);
                return Foot { place, distance_mm, normal, beyond_mm, beyond_steps };
            }
        }
        let (distance_mm, normal) = match self.distance {
            Distance::Triangle => facet.flat_distance(&w),
            Distance::Curved => facet.curved_distance(&w, &weights),
        };
        Foot { place, distance_mm, normal: normal.into(), beyond_mm, beyond_steps }
    }

    /// The distance from the tangent plane at a place of the edge, and its normal.
    #[cold]
    fn over_tangent_plane(&self, facet: &Facet<f64>, p: &Point, at: &[f64; 3]) -> (f64, Vector) {
        let (on_flat, flat) = (Vector::from(facet.at(at)), Vector::from(facet.flat_normal()));
        let (anchor, normal) = match self.distance {
            Distance::Triangle => (on_flat, flat),
            Distance::Curved => (on_flat + flat * facet.height(at), facet.normal(at).into()),
        };
        ((p.coords - anchor).dot(&normal), normal)
    }
}

/// Weights of the nearest place of a facet for a point that lies beyond its most negative edge.
fn clamped(facet: &Facet<f64>, p: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    let k = (0..3).min_by(|&i, &j| b[i].total_cmp(&b[j])).expect("three weights");
    let (i, j) = ((k + 1) % 3, (k + 2) % 3);
    let edge = facet.edge(i, j);
    let t = (dot(&facet.seen_from(i, p), &edge) / dot(&edge, &edge)).clamp(0.0, 1.0);
    let mut clamped = [0.0; 3];
    (clamped[i], clamped[j]) = (1.0 - t, t);
    clamped
}
