//! Prefetching: finds the approximate projections of many points and fits the normals there, before any projection is
//! requested.
//!
//! A scattered surface fits a normal when it is first needed. One by one, in the search for each projection, these fits
//! are the most expensive part of a registration. All together they run four at a time on all cores.

use rayon::prelude::*;

use super::facet::FacetIndex;
use super::facet::Facets;
use super::offset::OffsetSurface;
use super::patch::Topology;
use crate::geometry::Point;

/// Number of points per task.
const CHUNK: usize = 512;

/// Maximum distance, in steps of the sampling, at which a walk from the last point is shorter than a search in the
/// tree.
const NEAR_STEPS: f64 = 24.0;

impl OffsetSurface<'_> {
    /// Returns true if a patch of the surface is a mesh. A mesh fits the normal of a vertex only when the normal is
    /// first needed. This is slow, so callers should use few normals then. Returns false if all patches are grids,
    /// whose normals are known from the start.
    pub(crate) fn has_lazy_normals(&self) -> bool {
        self.nominal().patches().iter().any(|patch| patch.has_scattered_normals())
    }

    /// Fits all normals that the later projections of `points` onto this surface will need. `points` are in the model
    /// frame. Returns one facet for each point, in the same order: the facet at which the search for the projection of
    /// the point should start.
    ///
    /// Fits nothing and returns an empty list if the surface is a grid, because its normals are already known, or if
    /// the surface has several patches.
    pub(crate) fn prefetch(&self, points: &[Point]) -> Vec<FacetIndex> {
        let [patch] = self.nominal().patches() else { return Vec::new() };
        let Topology::Mesh(mesh) = &patch.topology else { return Vec::new() };
        let walk = |chunk: &[Point]| -> Vec<FacetIndex> {
            let mut last = (FacetIndex::UNKNOWN, Point::origin(), 0.0);
            let mut found = Vec::with_capacity(chunk.len());
            for p in chunk {
                let (place, from, reach_mm) = last;
                let near = place != FacetIndex::UNKNOWN && (p - from).norm_squared() < reach_mm * reach_mm;
                let place = self.facet_near(patch, mesh, p, if near { place } else { FacetIndex::UNKNOWN });
                last = (place, *p, NEAR_STEPS * self.spacing_mm(place));
                found.push(place);
            }
            found
        };
        let places: Vec<FacetIndex> = points.par_chunks(CHUNK).flat_map_iter(walk).collect();
        let mut touched: Vec<u32> = places.par_iter().flat_map_iter(|place| mesh.corners(place.facet())).collect();
        touched.par_sort_unstable();
        touched.dedup();
        patch.fit_normals(&touched);
        places
    }
}
