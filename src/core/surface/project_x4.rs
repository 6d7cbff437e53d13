//! Point location and distance for four points at a time.
//!
//! When a registration has nearly converged, almost every point stays on its facet from one iteration to the next. On a
//! grid, a point that leaves its facet is one or two jumps away. The arithmetic of the [facet](super::facet) is then
//! the same for all points, without branches, and the compiler turns it into vector instructions over four lanes.
//! Points beyond the edge of the surface, and points farther away, use the single search. The results agree except for
//! rounding.

use super::facet::FacetIndex;
use super::facet::{Corner, Facet, Facets, offset_corner, vertices_x4};
use super::offset::{DistanceModel, Lookup, MIN_INSIDE_WEIGHT, OffsetSurface};
use super::patch::{Patch, Topology};
use super::simd::{F64x4, LANES, Real, Vector3x4};

/// Maximum number of jumps of four points together over a grid; after that the single search is used.
const JUMPS: usize = 4;

/// Projections of four points onto the offset surface.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ProjectionX4 {
    pub(crate) distance_mm: F64x4,
    pub(crate) normal: Vector3x4,
}

impl OffsetSurface<'_> {
    /// Returns true if [`OffsetSurface::project_x4`] supports this surface. Three conditions are required: the surface
    /// has one patch; the distance to a facet is computed with its curvature (the curved distance model); and a point
    /// is assigned to the facet that contains its projection.
    pub(crate) fn supports_project_x4(&self) -> bool {
        self.nominal().patches().len() == 1
            && self.distance_model() == DistanceModel::Curved
            && self.lookup() == Lookup::ContainingFacet
    }

    /// Projects four points `p` onto the offset surface, one point in each lane (one of the four parallel numbers).
    /// Returns the distance in mm and the unit normal for each point. `places` contains the facet at which the search
    /// for each point starts. The facet of each projection replaces it.
    ///
    /// Returns `None` if one of the points is beyond the edge of the surface or too far from its start facet. The
    /// content of `places` is then invalid. On a mesh, returns `None` as soon as a point is not on its start facet,
    /// because the search for another facet of a mesh would fit new normals. The caller must check
    /// [`OffsetSurface::supports_project_x4`] first.
    #[inline(always)]
    pub(crate) fn project_x4(&self, p: &Vector3x4, places: &mut [FacetIndex; LANES]) -> Option<ProjectionX4> {
        let patch = &self.nominal().patches()[0];
        match &patch.topology {
            Topology::Grid(grid) => self.project_x4_onto(patch, grid, JUMPS, p, places),
            Topology::Mesh(mesh) => self.project_x4_onto(patch, mesh, 0, p, places),
        }
    }

    /// Predicts the facets of the next four points on a grid by linear extrapolation. `before` and `last` are the
    /// facets of the two previous groups of four points. Each predicted facet continues the step from the facet in
    /// `before` to the facet in `last`.
    ///
    /// Keeps the facet in `last` if the facet in `before` is unknown, or if the predicted facet is outside the grid or
    /// at a hole. Returns `None` on a mesh, or if a facet in `last` is unknown.
    pub(crate) fn extrapolate_x4(
        &self,
        before: &[FacetIndex; LANES],
        last: &[FacetIndex; LANES],
    ) -> Option<[FacetIndex; LANES]> {
        let Topology::Grid(grid) = &self.nominal().patches()[0].topology else { return None };
        if last.contains(&FacetIndex::UNKNOWN) {
            return None;
        }
        Some(std::array::from_fn(|l| {
            let step =
                if before[l] == FacetIndex::UNKNOWN { 0 } else { last[l].facet().wrapping_sub(before[l].facet()) };
            let next = last[l].facet().wrapping_add(step);
            if grid.has_facet(next) { FacetIndex::in_first_patch(next) } else { last[l] }
        }))
    }

    /// Projects four points `p` onto one patch with the facets `facets`, one point in each lane. Returns the distance
    /// in mm and the unit normal for each point. `places` contains the start facet of each point; the facet of each
    /// projection replaces it.
    ///
    /// Moves to other facets at most `jumps` times. Returns `None` if a point is not on its facet after these moves, or
    /// if the surface ends on the way.
    #[inline(always)]
    fn project_x4_onto<F: Facets>(
        &self,
        patch: &Patch,
        facets: &F,
        jumps: usize,
        p: &Vector3x4,
        places: &mut [FacetIndex; LANES],
    ) -> Option<ProjectionX4> {
        let mut jump = 0;
        loop {
            let four = self.facets_x4(patch, facets, places);
            let w = four.vector_from_corner(0, p);
            let b = four.weights(&w);
            let least = b[0].min(b[1]).min(b[2]);
            let stays = [
                least.0[0] >= MIN_INSIDE_WEIGHT,
                least.0[1] >= MIN_INSIDE_WEIGHT,
                least.0[2] >= MIN_INSIDE_WEIGHT,
                least.0[3] >= MIN_INSIDE_WEIGHT,
            ];
            if stays == [true; LANES] {
                let (distance_mm, normal) = four.curved_distance(&w, &b);
                return Some(ProjectionX4 { distance_mm, normal });
            }
            if jump == jumps || !jump_to_facets(facets, places, &stays, &b) {
                return None;
            }
            jump += 1;
        }
    }

    /// Returns the four facets with the indices `places` as one facet of four lanes: lane k contains facet k. The
    /// corners of the facets are on the offset surface.
    #[inline(always)]
    fn facets_x4<F: Facets>(&self, patch: &Patch, facets: &F, places: &[FacetIndex; LANES]) -> Facet<F64x4> {
        let (a, b) = (facets.corners(places[0].facet()), facets.corners(places[1].facet()));
        let (c, d) = (facets.corners(places[2].facet()), facets.corners(places[3].facet()));
        let first = self.corners_x4(patch, [a[0], b[0], c[0], d[0]]);
        let second = self.corners_x4(patch, [a[1], b[1], c[1], d[1]]);
        let third = self.corners_x4(patch, [a[2], b[2], c[2], d[2]]);
        Facet::new([first, second, third], F64x4::splat(self.side().sign()))
    }

    /// Returns one corner of each of four facets, packed into four lanes. `a`, `b`, `c` and `d` are the vertex indices
    /// of these corners, one for each facet. Each corner consists of its point on the offset surface and its unit
    /// normal.
    #[inline(always)]
    fn corners_x4(&self, patch: &Patch, [a, b, c, d]: [u32; LANES]) -> Corner<F64x4> {
        let four = vertices_x4(&[patch.vertex(a), patch.vertex(b), patch.vertex(c), patch.vertex(d)]);
        offset_corner(four, F64x4::splat(self.side().sign()), F64x4::splat(self.radius_mm()))
    }
}

/// Moves each point whose flag in `stays` is false to the next facet on the way to its projection. `places` contains
/// the facet of each of the four points and is changed. `b` contains the three barycentric weights of each point in its
/// present facet; they give the direction of the move.
///
/// Returns false if one of these points has no next facet. Some of `places` may have changed then.
#[inline(never)]
fn jump_to_facets<F: Facets>(
    facets: &F,
    places: &mut [FacetIndex; LANES],
    stays: &[bool; LANES],
    b: &[F64x4; 3],
) -> bool {
    for l in (0..LANES).filter(|&l| !stays[l]) {
        match facets.advance(places[l].facet(), &[b[0].0[l], b[1].0[l], b[2].0[l]]) {
            Some(next) => places[l] = FacetIndex::in_first_patch(next),
            None => return false,
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use super::super::facet::points_x4;
    use super::*;
    use crate::geometry::Point;
    use crate::surface::{Nominal, PlaneProjection, Side};

    #[test]
    fn project_x4_matches_single_projection() {
        let z = |x: f64, y: f64| 3.0 * (0.11 * x + 0.2).sin() * (0.07 * y - 0.4).cos();
        let cloud: Vec<Point> = (0..41 * 31)
            .map(|k| (f64::from(k % 41) * 0.8 - 16.0, f64::from(k / 41) * 0.9 - 13.0))
            .map(|(x, y)| Point::new(x, y, z(x, y)))
            .collect();
        for nominal in [
            Nominal::from_points(cloud.clone(), PlaneProjection::Auto).unwrap(),
            Nominal::from_triangulated_points(cloud, PlaneProjection::Auto).unwrap(),
        ] {
            for side in [Side::Normal, Side::Opposite] {
                let surface = OffsetSurface::new(&nominal, 1.5, side).unwrap();
                let mut left = 0;
                for k in 0..400 {
                    let points: [Point; LANES] = std::array::from_fn(|l| {
                        let t = f64::from(4 * k + l as i32);
                        let (x, y) = (13.0 * (t * 0.613).sin(), 11.0 * (t * 0.377).cos());
                        Point::new(x, y, z(x, y) + side.sign() * (1.5 + 0.01 * t.sin()))
                    });
                    let feet = points.map(|p| surface.project(&p, FacetIndex::UNKNOWN));
                    let mut places = feet.map(|f| f.facet);
                    let Some(four) = surface.project_x4(&points_x4(&points), &mut places) else {
                        left += 1;
                        continue;
                    };
                    for (l, foot) in feet.iter().enumerate() {
                        assert_eq!(places[l], foot.facet);
                        // The four-lane code groups a sum differently: the last bit may differ.
                        assert!((four.distance_mm.0[l] - foot.distance_mm).abs() < 1e-14);
                        assert!((0..3).all(|c| (four.normal[c].0[l] - foot.normal[c]).abs() < 1e-14));
                    }
                }
                assert!(left < 8, "{left} of 400");
            }
        }
    }

    #[test]
    fn project_x4_jumps_and_stops_at_edge() {
        let cloud = (0..100).map(|k| Point::new(f64::from(k % 10), f64::from(k / 10), 0.0)).collect::<Vec<_>>();
        let nominal = Nominal::from_points(cloud.clone(), PlaneProjection::Auto).unwrap();
        let surface = OffsetSurface::new(&nominal, 0.5, Side::Normal).unwrap();
        let at = |x: f64| Point::new(x, 4.3, 0.5);
        let place = surface.project(&at(2.6), FacetIndex::UNKNOWN).facet;
        let points = [at(2.6), at(3.6), at(8.1), at(0.2)];
        let mut places = [place; LANES];
        assert!(surface.project_x4(&points_x4(&points), &mut places).is_some());
        assert_eq!(places, points.map(|p| surface.project(&p, FacetIndex::UNKNOWN).facet));
        let beyond = [at(2.6), at(9.6), at(2.6), at(2.7)];
        assert!(surface.project_x4(&points_x4(&beyond), &mut [place; LANES]).is_none());

        let mesh = Nominal::from_triangulated_points(cloud, PlaneProjection::Auto).unwrap();
        let surface = OffsetSurface::new(&mesh, 0.5, Side::Normal).unwrap();
        let place = surface.project(&at(2.6), FacetIndex::UNKNOWN).facet;
        assert!(surface.project_x4(&points_x4(&[at(2.6); LANES]), &mut [place; LANES]).is_some());
        assert!(surface.project_x4(&points_x4(&points), &mut [place; LANES]).is_none());
    }
}
