//! Prefetching: about where the feet of many points will be, and the normals there, before any foot is asked for.
//!
//! A scattered surface fits a normal where it is first touched. One by one, as the search for each foot meets them, that is the
//! most expensive part of a registration; all at once it runs four at a time on all cores.

use rayon::prelude::*;

use crate::geometry::Point;

use super::facet::Facets;
use super::offset::{OffsetSurface, Place};
use super::patch::Lattice;

/// Points that a task takes at a time.
const CHUNK: usize = 512;

/// From a neighbour so many steps of the sampling away a walk is shorter than a look into the tree.
const NEAR_STEPS: f64 = 24.0;

impl OffsetSurface<'_> {
    /// Whether normals are fitted where the surface is touched, so that it is well to touch little of it.
    pub(crate) fn fits_normals(&self) -> bool {
        self.nominal().patches().iter().any(|patch| patch.has_scattered_normals())
    }

    /// Fits the normals that the feet of points will need, all at once, and returns places to start from for each point, given
    /// in the model frame; nothing where normals are ready, or where several patches contend for a point.
    pub(crate) fn prefetch(&self, points: &[Point]) -> Vec<Place> {
        let [patch] = self.nominal().patches() else { return Vec::new() };
        let Lattice::Mesh(mesh) = &patch.lattice else { return Vec::new() };
        let walk = |chunk: &[Point]| -> Vec<Place> {
            let mut last = (Place::UNKNOWN, Point::origin(), 0.0);
            let mut found = Vec::with_capacity(chunk.len());
            for p in chunk {
                let (place, from, reach_mm) = last;
                let near = place != Place::UNKNOWN && (p - from).norm_squared() < reach_mm * reach_mm;
                let place = self.place_near(patch, mesh, p, if near { place } else { Place::UNKNOWN });
                last = (place, *p, NEAR_STEPS * self.spacing_mm(place));
                found.push(place);
            }
            found
        };
        let places: Vec<Place> = points.par_chunks(CHUNK).flat_map_iter(walk).collect();
        let mut touched: Vec<u32> = places.par_iter().flat_map_iter(|place| mesh.corners(place.facet())).collect();
        touched.par_sort_unstable();
        touched.dedup();
        patch.fit_normals(&touched);
        places
    }
}
