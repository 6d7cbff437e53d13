//! Points of one map with their deviations from the nominal surface.

use rayon::prelude::*;

use crate::geometry::{Point, Pose, Vector};
use crate::surface::{FacetIndex, OffsetSurface};

/// Distance of a projection beyond the edge, in steps of the sampling, up to which it is on the part.
const EDGE_TOLERANCE_STEPS: f64 = 1e-3;

/// Points of one map under a pose, in the model frame.
pub(super) struct ProjectedMap {
    /// The measured points.
    pub(super) points: Vec<Point>,
    /// Their projections onto the offset surface.
    pub(super) feet: Vec<Point>,
    /// Normals there, towards the probe.
    pub(super) normals: Vec<Vector>,
    pub(super) deviations_mm: Vec<f64>,
    /// False for an outlier, and for a point whose projection is beyond the edge of the nominal surface.
    pub(super) is_usable: Vec<bool>,
}

impl ProjectedMap {
    /// Projects points onto the offset surface under the pose `model_from_map`. `facets` has the facet of each point at
    /// which the search begins, and receives the facet that is found. `is_outlier` marks points that are not used.
    pub(super) fn new(
        surface: &OffsetSurface,
        points: &[Point],
        is_outlier: &[bool],
        pose: &Pose,
        facets: &mut [FacetIndex],
    ) -> Self {
        let found: Vec<_> = points
            .par_iter()
            .zip(facets.par_iter_mut())
            .map(|(point, facet)| {
                let point = pose.transform_point(point);
                let found = surface.project(&point, *facet);
                *facet = found.facet;
                (point, found)
            })
            .collect();
        let on_part = found.iter().map(|(_, found)| found.beyond_edge_steps <= EDGE_TOLERANCE_STEPS);
        Self {
            points: found.iter().map(|(point, _)| *point).collect(),
            feet: found.iter().map(|(point, found)| point - found.normal * found.distance_mm).collect(),
            normals: found.iter().map(|(_, found)| found.normal).collect(),
            deviations_mm: found.iter().map(|(_, found)| found.distance_mm).collect(),
            is_usable: on_part.zip(is_outlier).map(|(on_part, is_outlier)| on_part && !is_outlier).collect(),
        }
    }

    pub(super) fn len(&self) -> usize {
        self.points.len()
    }

    /// Tells whether a point belongs to a sample of about `most` points that are spread over the map.
    pub(super) fn is_sampled(&self, i: usize, most: usize) -> bool {
        /// Multiples of the golden section are spread evenly, whatever the length of the rows of a map.
        const GOLDEN: f64 = 0.618_033_988_749_894_9;
        (i as f64 * GOLDEN).fract() * self.len() as f64 <= most as f64
    }
}
