//! Offset surface, on which the centre of a probe travels, and the projection of a point onto it. The formulas are in
//! [`super::facet`].

use super::error::SurfaceError;
use super::facet::FacetIndex;
use super::facet::{Facet, Facets, Side, offset_corner};
use super::nominal::Nominal;
use super::patch::{Patch, Topology};
use super::simd::{dot, minus};
use crate::geometry::{Point, Vector};

/// Shape of the surface between the corners of a facet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum DistanceModel {
    /// The cubic that the corners of a facet and their normals define.
    #[default]
    Curved,
    /// Flat, eq. (2).
    Triangle,
}

/// Rule that assigns a point to a facet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Lookup {
    /// The facet that contains the projection of the point.
    #[default]
    ContainingFacet,
    /// The facet that the point lies above or below along z, as in section 2.1 of the paper.
    AlongZ,
}

/// Offset of a nominal surface: a view of the nominal surface, without points of its own.
#[derive(Clone, Copy, Debug)]
pub struct OffsetSurface<'a> {
    nominal: &'a Nominal,
    /// Distance from the nominal surface along the outward normal, in millimetres.
    radius_mm: f64,
    side: Side,
    distance_model: DistanceModel,
    lookup: Lookup,
}

/// Projection of a point onto the offset surface.
#[derive(Clone, Copy, Debug)]
pub struct PointProjection {
    /// Facet that contains the projection.
    pub facet: FacetIndex,
    /// Signed distance of the point from the offset surface, in millimetres; positive on the probe's side.
    pub distance_mm: f64,
    /// Unit normal at the projection, towards the probe's side.
    pub normal: Vector,
    /// Distance of the projection beyond the edge of the surface, in millimetres; 0 on the part.
    pub beyond_edge_mm: f64,
    /// Distance of the projection beyond the edge, in steps of the nominal sampling.
    pub beyond_edge_steps: f64,
}

impl PointProjection {
    /// Compares two projections of one point. Returns `Less` if `self` is nearer than `other`. The nearer projection
    /// has the smaller distance beyond the edge of the surface. If these distances are equal, the nearer one has the
    /// smaller absolute distance from the surface.
    fn by_nearness(&self, other: &Self) -> std::cmp::Ordering {
        self.beyond_edge_mm
            .total_cmp(&other.beyond_edge_mm)
            .then(self.distance_mm.abs().total_cmp(&other.distance_mm.abs()))
    }
}

/// Maximum distance beyond the edge, in steps of the sampling, up to which the curved facet is continued. A projection
/// within this distance counts as on the part.
const MAX_CONTINUATION_STEPS: f64 = 0.5;

/// Maximum number of steps of a search. After that the search ends at the facet that it has reached. A search that
/// converges needs far fewer steps.
const MAX_STEPS: usize = 4096;

/// Minimum barycentric weight of a place that counts as inside a facet; slightly negative because of rounding.
pub(super) const MIN_INSIDE_WEIGHT: f64 = -1e-10;

impl<'a> OffsetSurface<'a> {
    /// Creates the offset of a nominal surface by a probe radius, towards `side`.
    ///
    /// Units: millimetres. A radius of 0 gives the nominal surface itself.
    ///
    /// # Errors
    /// Returns an error if the radius is negative or not finite.
    pub fn new(nominal: &'a Nominal, radius_mm: f64, side: Side) -> Result<Self, SurfaceError> {
        if !(radius_mm >= 0.0 && radius_mm.is_finite()) {
            return Err(SurfaceError::ProbeRadius { radius_mm });
        }
        Ok(Self { nominal, radius_mm, side, distance_model: DistanceModel::default(), lookup: Lookup::default() })
    }

    /// Sets the shape of the surface between the corners of a facet: curved or flat.
    pub fn with_distance_model(self, distance: DistanceModel) -> Self {
        Self { distance_model: distance, ..self }
    }

    /// Returns the same offset surface with the rule `lookup`, which assigns a point to a facet: the facet that
    /// contains its projection, or the facet above or below the point along z. See [`Lookup`].
    pub(crate) fn with_lookup(self, lookup: Lookup) -> Self {
        Self { lookup, ..self }
    }

    /// Returns the nominal surface from which this surface is offset.
    pub fn nominal(&self) -> &'a Nominal {
        self.nominal
    }

    /// Returns the probe radius in millimetres. It is the distance of this offset surface from the nominal surface.
    pub fn radius_mm(&self) -> f64 {
        self.radius_mm
    }

    pub(crate) fn distance_model(&self) -> DistanceModel {
        self.distance_model
    }

    pub(crate) fn lookup(&self) -> Lookup {
        self.lookup
    }

    /// Returns the side of the nominal surface on which the probe travels.
    pub fn side(&self) -> Side {
        self.side
    }

    /// Returns the local point spacing of the nominal surface at the facet with the index `place`, in millimetres. It
    /// is the side of a square with twice the area of the facet.
    pub(crate) fn spacing_mm(&self, place: FacetIndex) -> f64 {
        let patch = &self.nominal.patches()[place.patch as usize];
        let [a, b, c] = patch.corners(place.facet).map(|v| *patch.point(v));
        (b - a).cross(&(c - a)).norm().sqrt()
    }

    /// Projects the point `p`, in the model frame, onto the offset surface. Returns the projection. The search begins
    /// at the facet `start`: the facet that the previous search for this point returned. Use [`FacetIndex::UNKNOWN`] if
    /// there was no previous search.
    ///
    /// If the projection lies beyond the edge of the surface, the surface is extended there. Up to half the local point
    /// spacing of the nominal surface beyond the edge, the facet at the edge is extended. Farther out, the tangent
    /// plane at the nearest point of the edge is used.
    #[inline]
    pub fn project(&self, p: &Point, start: FacetIndex) -> PointProjection {
        match self.nominal.patches() {
            [only] => self.project_onto_patch(only, 0, p, start),
            patches => self.nearest_projection(patches, p, start),
        }
    }

    /// Projects the point `p` onto each of the `patches` and returns the nearest projection. A projection inside a
    /// patch is nearer than one beyond an edge. If no projection is inside, the one with the smallest distance beyond
    /// an edge is the nearest. `start` is the facet where the search begins in the patch of this facet; the searches in
    /// the other patches choose their own start.
    ///
    /// At a convex common edge of two patches, their offset surfaces do not meet: there is a gap between them. A
    /// projection in this gap counts as on the part. A projection is in the gap if three conditions are true:
    ///
    /// - It is at most half the local point spacing beyond an edge.
    /// - The projection onto another patch is also at most half the local point spacing beyond an edge.
    /// - The distances of `p` from the two projections differ by at most half the local point spacing.
    fn nearest_projection(&self, patches: &[Patch], p: &Point, start: FacetIndex) -> PointProjection {
        let feet: Vec<PointProjection> =
            patches.iter().enumerate().map(|(k, patch)| self.project_onto_patch(patch, k as u32, p, start)).collect();
        let best = feet
            .iter()
            .copied()
            .min_by(PointProjection::by_nearness)
            .expect("a nominal surface has at least one patch");
        let is_at_seam = |other: &PointProjection| {
            let apart_mm = (other.distance_mm - best.distance_mm).abs();
            other.facet.patch != best.facet.patch
                && other.beyond_edge_steps <= MAX_CONTINUATION_STEPS
                && apart_mm <= MAX_CONTINUATION_STEPS * self.spacing_mm(best.facet)
        };
        if best.beyond_edge_steps > 0.0
            && best.beyond_edge_steps <= MAX_CONTINUATION_STEPS
            && feet.iter().any(is_at_seam)
        {
            return PointProjection { beyond_edge_mm: 0.0, beyond_edge_steps: 0.0, ..best };
        }
        best
    }

    /// Projects the point `p` onto the offset surface without a known start facet. Takes the three points nearest to
    /// `p` from a sample of the nominal surface. Starts one search at a facet near each of these three points. Returns
    /// the nearest projection of the three searches.
    ///
    /// A single search can end at a wrong facet, because it moves only to neighbouring facets that are nearer. For
    /// example, it can end on the wrong wall of a groove.
    #[cold]
    pub(crate) fn project_without_start(&self, p: &Point) -> PointProjection {
        let found = self
            .nominal
            .facets_near(p)
            .map(|start| self.project_onto_patch(&self.nominal.patches()[start.patch as usize], start.patch, p, start));
        found.min_by(PointProjection::by_nearness).unwrap_or_else(|| self.project(p, FacetIndex::UNKNOWN))
    }

    /// Returns the projection of the point `p` onto one patch; `number` is the index of the patch. The search starts
    /// from `start` if that facet belongs to this patch.
    #[inline]
    fn project_onto_patch(&self, patch: &Patch, number: u32, p: &Point, start: FacetIndex) -> PointProjection {
        let start = if start.patch == number { start.facet } else { u32::MAX };
        match &patch.topology {
            Topology::Grid(grid) => self.search_projection(patch, grid, number, p, start),
            Topology::Mesh(mesh) => self.search_projection(patch, mesh, number, p, start),
        }
    }

    /// Returns the number of a facet near the projection of the point `p`. Moves from facet to facet over the flat
    /// facets of the nominal surface, without fitting normals. `start` is the number of the first facet; with
    /// `u32::MAX`, `facets` chooses the first facet. For a grid, returns the first facet at once, because all normals
    /// of a grid are known.
    ///
    /// `p` is the centre of the probe. At each facet, `p` is shifted by the probe radius along the normal of the flat
    /// facet, back to the nominal surface.
    #[inline]
    fn approach<F: Facets>(&self, patch: &Patch, facets: &F, p: &Point, start: u32) -> u32 {
        let mut facet = if start == u32::MAX { facets.start(p) } else { start };
        if !patch.has_scattered_normals() {
            return facet;
        }
        let mut before = u32::MAX;
        for _ in 0..MAX_STEPS {
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

    /// Returns the index of a facet near the projection of the point `p`, without fitting normals. `patch` must be the
    /// first patch (patch 0) of the surface. `start` is the facet where the search begins; only its facet number is
    /// used. With [`FacetIndex::UNKNOWN`], `facets` chooses the first facet.
    pub(super) fn facet_near<F: Facets>(&self, patch: &Patch, facets: &F, p: &Point, start: FacetIndex) -> FacetIndex {
        FacetIndex { patch: 0, facet: self.approach(patch, facets, p, start.facet) }
    }

    /// Walks from facet to facet of one patch until a facet contains the projection of the point `p`. The walk also
    /// ends where the surface ends, and if it would return to the previous facet. Returns the projection onto the last
    /// facet. `number` is the index of the patch. `start` is a facet number, or `u32::MAX` to let `facets` choose one.
    /// The walk has at most 4096 steps.
    #[inline]
    fn search_projection<F: Facets>(
        &self,
        patch: &Patch,
        facets: &F,
        number: u32,
        p: &Point,
        start: u32,
    ) -> PointProjection {
        let mut facet = self.approach(patch, facets, p, start);
        let mut before = u32::MAX;
        for _ in 0..MAX_STEPS {
            let here = self.facet(patch, facets.corners(facet));
            let weights = self.weights(&here, p);
            let inside = weights[0].min(weights[1]).min(weights[2]) >= MIN_INSIDE_WEIGHT;
            let next = if inside { None } else { facets.advance(facet, &weights) };
            match next {
                // Two facets point at each other: the foot lies on their common edge, in the gap between the prisms
                // over a convex edge.
                Some(next) if next != before => {
                    before = facet;
                    facet = next;
                }
                _ => {
                    // At the border this holds only along the common edge: a foot beyond a border edge is not inside.
                    let is_beyond = |k: usize| weights[k] < MIN_INSIDE_WEIGHT && facets.ends_at(facet, k);
                    let inside = inside || next.is_some() && !(0..3).any(is_beyond);
                    return self.project_in_facet(&here, p, weights, inside, FacetIndex { patch: number, facet });
                }
            }
        }
        let here = self.facet(patch, facets.corners(facet));
        self.project_in_facet(&here, p, self.weights(&here, p), true, FacetIndex { patch: number, facet })
    }

    /// Returns a facet of the offset surface. `corners` are the indices of its three vertices in `patch`. Each corner
    /// is the vertex shifted by the probe radius along its normal, towards the side of the probe.
    #[inline(always)]
    fn facet(&self, patch: &Patch, corners: [u32; 3]) -> Facet<f64> {
        let sign = self.side.sign();
        let [a, b, c] = corners.map(|k| patch.vertex(k)).map(|v| (v.point.coords.into(), v.normal.into()));
        Facet::new([a, b, c].map(|vertex| offset_corner(vertex, sign, self.radius_mm)), sign)
    }

    /// Returns the barycentric weights, in the flat facet, of the projection of the point `p`. The point is projected
    /// perpendicular to the facet, or along z if the lookup is [`Lookup::AlongZ`].
    #[inline(always)]
    fn weights(&self, facet: &Facet<f64>, p: &Point) -> [f64; 3] {
        let mut w = facet.vector_from_corner(0, &p.coords.into());
        if self.lookup == Lookup::AlongZ {
            w[2] -= dot(&w, &facet.area_normal) / facet.area_normal[2];
        }
        facet.weights(&w)
    }

    /// Returns the projection of the point `p` onto the facet `facet`. `place` is the index of this facet. `weights`
    /// are the barycentric weights of `p` in the facet. `inside` is true if the projection lies on the surface, and
    /// false if it lies beyond an edge where the surface ends.
    ///
    /// If `inside` is false, the surface is extended. Up to half the local point spacing beyond the edge, the facet is
    /// extended. Farther out, the tangent plane at the nearest point of the edge is used.
    #[inline(always)]
    fn project_in_facet(
        &self,
        facet: &Facet<f64>,
        p: &Point,
        weights: [f64; 3],
        inside: bool,
        place: FacetIndex,
    ) -> PointProjection {
        let w = facet.vector_from_corner(0, &p.coords.into());
        let (mut beyond_mm, mut beyond_steps) = (0.0, 0.0);
        if !inside {
            let clamped = clamped_weights(facet, &p.coords.into(), &weights);
            let beyond = minus(&facet.point(&clamped), &facet.point(&weights));
            beyond_mm = dot(&beyond, &beyond).sqrt();
            beyond_steps = beyond_mm / facet.area_normal_squared.sqrt().sqrt();
            if beyond_steps > MAX_CONTINUATION_STEPS {
                let (distance_mm, normal) = self.tangent_plane_distance(facet, p, &clamped);
                return PointProjection {
                    facet: place,
                    distance_mm,
                    normal,
                    beyond_edge_mm: beyond_mm,
                    beyond_edge_steps: beyond_steps,
                };
            }
        }
        let (distance_mm, normal) = match self.distance_model {
            DistanceModel::Triangle => facet.flat_distance(&w),
            DistanceModel::Curved => facet.curved_distance(&w, &weights),
        };
        PointProjection {
            facet: place,
            distance_mm,
            normal: normal.into(),
            beyond_edge_mm: beyond_mm,
            beyond_edge_steps: beyond_steps,
        }
    }

    /// Returns the signed distance of the point `p` from a tangent plane of the surface, in mm, and the unit normal of
    /// this plane. The plane touches the surface at one point of the edge of `facet`. `at` are the barycentric weights
    /// of this point.
    #[cold]
    fn tangent_plane_distance(&self, facet: &Facet<f64>, p: &Point, at: &[f64; 3]) -> (f64, Vector) {
        let (on_flat, flat) = (Vector::from(facet.point(at)), Vector::from(facet.flat_normal()));
        let (anchor, normal) = match self.distance_model {
            DistanceModel::Triangle => (on_flat, flat),
            DistanceModel::Curved => (on_flat + flat * facet.height(at), facet.normal(at).into()),
        };
        ((p.coords - anchor).dot(&normal), normal)
    }
}

/// Returns the barycentric weights of the place on one edge of a facet that is nearest to the point `p`. `b` are the
/// barycentric weights of `p`. The edge is the one opposite to the corner with the most negative weight in `b`.
fn clamped_weights(facet: &Facet<f64>, p: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    let k = (0..3).min_by(|&i, &j| b[i].total_cmp(&b[j])).expect("three weights");
    let (i, j) = ((k + 1) % 3, (k + 2) % 3);
    let edge = facet.edge(i, j);
    let t = (dot(&facet.vector_from_corner(i, p), &edge) / dot(&edge, &edge)).clamp(0.0, 1.0);
    let mut clamped = [0.0; 3];
    (clamped[i], clamped[j]) = (1.0 - t, t);
    clamped
}
