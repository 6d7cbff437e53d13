//! Folds of an offset surface. It folds where the nominal surface is more concave than the probe: the probe does not
//! fit there.

use rayon::prelude::*;

use super::error::SurfaceError;
use super::facet::FacetIndex;
use super::facet::{Facets, Vertex, vertices_x4};
use super::grid_topology::GridTopology;
use super::offset::OffsetSurface;
use super::patch::{Patch, Topology};
use super::simd::{F64x4, LANES, Real, Vector3x4, dot, minus, times};
use crate::geometry::Vector;

/// Maximum number of facets of a mesh that are checked in addition to those near the measured points. It is limited
/// because a mesh fits a normal only when it is needed.
const MAX_CHECKED_FACETS: usize = 2048;

/// Step of the first check of a grid, in nodes. This check uses a probe that is `PROBE_ENLARGEMENT` times as large.
/// Every facet is checked only if the offset of that probe folds somewhere. If the curvature changes by a third between
/// neighbouring nodes, the sampling is too coarse to show the surface.
const STEP: usize = 2;
const PROBE_ENLARGEMENT: f64 = 1.4;

impl OffsetSurface<'_> {
    /// Searches for folds of the offset surface: places where the nominal surface is more concave than the probe.
    /// Returns an error that names the most concave fold. Returns `None` if no fold is found, or if the probe radius is
    /// 0.
    ///
    /// Checks each grid over its whole area, and up to [`MAX_CHECKED_FACETS`] facets of each mesh.
    pub(crate) fn find_fold(&self) -> Option<SurfaceError> {
        if self.radius_mm() == 0.0 {
            return None;
        }
        let patches = self.nominal().patches();
        self.worst_fold(patches.iter().flat_map(|patch| self.folded_facets(patch).into_iter().map(move |f| (patch, f))))
    }

    /// Searches for folds of the offset surface at the facets `touched`, onto which measured points project. Returns an
    /// error that names the most concave fold. Returns `None` if no facet folds, or if the probe radius is 0.
    ///
    /// Checks only facets of meshes, because [`OffsetSurface::find_fold`] already checks each grid over its whole area.
    pub(crate) fn find_fold_among(&self, touched: impl Iterator<Item = FacetIndex>) -> Option<SurfaceError> {
        let patches = self.nominal().patches();
        let is_mesh = |patch: &Patch| matches!(patch.topology, Topology::Mesh(_));
        if self.radius_mm() == 0.0 || !patches.iter().any(is_mesh) {
            return None;
        }
        let there = touched.map(|place| (&patches[place.patch() as usize], place.facet()));
        let there: Vec<(&Patch, u32)> = there.filter(|(patch, _)| is_mesh(patch)).collect();
        let there: Vec<_> = there.into_par_iter().filter(|(p, f)| self.is_folded(p, p.corners(*f))).collect();
        self.worst_fold(there.into_iter())
    }

    /// Returns an error that names the most concave of the facets in `folded`; `None` if there are none.
    fn worst_fold<'a>(&self, folded: impl Iterator<Item = (&'a Patch, u32)>) -> Option<SurfaceError> {
        let worst = folded.map(|(p, f)| (self.min_curvature(p, f), p, f));
        let (curvature, patch, facet) = worst.min_by(|a, b| a.0.total_cmp(&b.0))?;
        let at = (*patch.point(patch.corners(facet)[0])).into();
        Some(SurfaceError::OffsetFolds { at, concave_radius_mm: -1.0 / curvature, probe_radius_mm: self.radius_mm() })
    }

    /// Returns the numbers of the facets of a patch at which the offset surface folds (the nominal surface is more
    /// concave than the probe).
    ///
    /// A grid is checked in two steps, because the first step is fast:
    ///
    /// - The first step checks a coarse grid. Each of its facets is two nodes wide. The probe radius is enlarged by the
    ///   factor 1.4, so that the coarse grid misses no fold.
    /// - The second step checks one facet of each cell of the full grid, with the true probe radius. It runs only if a
    ///   facet folds in the first step.
    ///
    /// In a mesh, up to [`MAX_CHECKED_FACETS`] facets spread over the mesh are checked.
    fn folded_facets(&self, patch: &Patch) -> Vec<u32> {
        match &patch.topology {
            Topology::Grid(grid) => {
                let (arch, nodes) = (pulp::Arch::new(), patch.nodes());
                let doubtful = (0..(grid.rows() - 1).div_ceil(STEP))
                    .into_par_iter()
                    .with_min_len(16)
                    .any(|k| arch.dispatch(self.wide_row(grid, nodes, STEP * k)));
                let rows = if doubtful { grid.rows() - 1 } else { 0 };
                (0..rows)
                    .into_par_iter()
                    .flat_map_iter(|j| grid.row_of_facets(j))
                    .filter(|&(facet, corners)| grid.has_facet(facet) && self.is_folded(patch, corners))
                    .map(|(facet, _)| facet)
                    .collect()
            }
            Topology::Mesh(mesh) => {
                let stride = (mesh.facet_count() as usize).div_ceil(MAX_CHECKED_FACETS);
                let looked_at: Vec<u32> = (0..mesh.facet_count()).step_by(stride).collect();
                patch.fit_normals(&looked_at.iter().flat_map(|&f| mesh.corners(f)).collect::<Vec<_>>());
                looked_at.into_par_iter().filter(|&f| self.is_folded(patch, mesh.corners(f))).collect()
            }
        }
    }

    /// Returns the input for the coarse check of one row of a grid for folds. The coarse check uses facets two nodes
    /// wide, and a probe radius enlarged by the factor [`PROBE_ENLARGEMENT`].
    ///
    /// The result contains the nodes of row `row`, the nodes of the row that is [`STEP`] rows above, and the enlarged
    /// radius in mm as a signed offset. If the grid has no row [`STEP`] rows above, its last row is used. The offset is
    /// negative if the probe is on the side opposite to the normals.
    fn wide_row<'a>(&self, grid: &GridTopology, nodes: &'a [Vertex], row: usize) -> WideRow<'a> {
        let columns = grid.columns();
        let up = STEP.min(grid.rows() - 1 - row);
        WideRow {
            nodes: &nodes[row * columns..][..columns],
            above: &nodes[(row + up) * columns..][..columns],
            reach: self.radius_mm() * self.side().sign() * PROBE_ENLARGEMENT,
        }
    }

    /// Returns true if the facet folds when its vertices are moved by the probe radius along their normals. A facet
    /// folds if the moved facet is turned over, or if its area becomes zero. `corners` are the numbers of the vertices
    /// of the facet in `patch`.
    ///
    /// Criterion: the matrix E + r B is not positive definite. E and B are the fundamental forms of the facet, see
    /// [`Self::fundamental_forms`], and r is the probe radius.
    #[inline]
    fn is_folded(&self, patch: &Patch, corners: [u32; 3]) -> bool {
        let (p, q, t) = (patch.vertex(corners[0]), patch.vertex(corners[1]), patch.vertex(corners[2]));
        let reach = self.radius_mm() * self.side().sign();
        let edges = (q.point - p.point, t.point - p.point);
        is_not_positive_definite(edges.0, edges.1, (q.normal - p.normal) * reach, (t.normal - p.normal) * reach)
    }

    /// Returns the smallest normal curvature of facet number `facet` in 1/mm. The curvature is negative if the facet is
    /// concave as seen from the side of the probe.
    ///
    /// Equation: the smallest eigenvalue of E^-1 B. E and B are the fundamental forms of the facet, see
    /// [`Self::fundamental_forms`].
    fn min_curvature(&self, patch: &Patch, facet: u32) -> f64 {
        let ([e, f, g], [l, m, k]) = self.fundamental_forms(patch, patch.corners(facet));
        let det = e * g - f * f;
        let mean = 0.5 * (e * k - 2.0 * f * m + g * l) / det;
        let gauss = (l * k - m * m) / det;
        mean - (mean * mean - gauss).max(0.0).sqrt()
    }

    /// Returns the first and the second fundamental form, E and B, of a facet with the corners a, b and c. Each form is
    /// a symmetric 2 x 2 matrix, given by its entries 11, 12 and 22. The entries are with respect to the basis e_1 = b
    /// - a and e_2 = c - a.
    ///
    /// Equations: the unit normal n points to the side of the probe and changes by dn_j along the edge e_j. E_ij = e_i
    /// . e_j, and B_ij is the symmetric part of e_i . dn_j. With the linear map K from an edge to the change of the
    /// normal, dn = K e and K = E^-1 B. The surface offset by r has the first fundamental form E + 2 r B + O(r^2). The
    /// offset surface is singular if E + r B is singular.
    #[inline]
    fn fundamental_forms(&self, patch: &Patch, [a, b, c]: [u32; 3]) -> ([f64; 3], [f64; 3]) {
        let (a, b, c) = (patch.vertex(a), patch.vertex(b), patch.vertex(c));
        let (e1, e2) = (b.point - a.point, c.point - a.point);
        let sign = self.side().sign();
        let (d1, d2) = ((b.normal - a.normal) * sign, (c.normal - a.normal) * sign);
        let first = [e1.dot(&e1), e1.dot(&e2), e2.dot(&e2)];
        (first, [e1.dot(&d1), 0.5 * (e1.dot(&d2) + e2.dot(&d1)), e2.dot(&d2)])
    }
}

/// Facets two nodes wide along a row of a grid.
struct WideRow<'a> {
    nodes: &'a [Vertex],
    above: &'a [Vertex],
    reach: f64,
}

impl pulp::NullaryFnOnce for WideRow<'_> {
    type Output = bool;

    /// Returns true if at least one facet of this row folds when its vertices are moved along their normals by `reach`,
    /// a signed length in mm. A facet folds if the moved facet is turned over or has no area. A facet with a hole of
    /// the grid as a corner has NaN coordinates, and never counts as folded.
    #[inline(always)]
    fn call(self) -> bool {
        let (nodes, above) = (self.nodes, &self.above[..self.nodes.len()]);
        let mut k = 0;
        let mut doubtful = false;
        while k + LANES * STEP < nodes.len() {
            let (a, b, c) = (k + STEP, k + 2 * STEP, k + 3 * STEP);
            let here = vertices_x4(&[nodes[k], nodes[a], nodes[b], nodes[c]]);
            let next = vertices_x4(&[nodes[a], nodes[b], nodes[c], nodes[c + STEP]]);
            let up = vertices_x4(&[above[k], above[a], above[b], above[c]]);
            doubtful |= self.any_folds_x4(&here, &next, &up);
            k += LANES * STEP;
        }
        while k + STEP < nodes.len() {
            let (p, q, t) = (nodes[k], nodes[k + STEP], above[k]);
            let edges = (q.point - p.point, t.point - p.point);
            let changes = ((q.normal - p.normal) * self.reach, (t.normal - p.normal) * self.reach);
            doubtful |= is_not_positive_definite(edges.0, edges.1, changes.0, changes.1);
            k += STEP;
        }
        doubtful
    }
}

impl WideRow<'_> {
    /// Returns true if at least one of four facets, one per SIMD lane, folds when its vertices are moved along their
    /// normals by `reach`. `here`, `next` and `up` are the three corners of the facets: the first corner, the next
    /// corner in the same row, and the corner in the row above. Each is a pair of points and unit normals.
    ///
    /// Criterion: the matrix E + r B of the facet is not positive definite. E and B are the first and the second
    /// fundamental form of the facet, and r is `reach`. [`is_not_positive_definite`] tests the same criterion for one
    /// facet.
    #[inline(always)]
    fn any_folds_x4(
        &self,
        here: &(Vector3x4, Vector3x4),
        next: &(Vector3x4, Vector3x4),
        up: &(Vector3x4, Vector3x4),
    ) -> bool {
        let reach = F64x4::splat(self.reach);
        let (e1, e2) = (minus(&next.0, &here.0), minus(&up.0, &here.0));
        let (d1, d2) = (times(&minus(&next.1, &here.1), reach), times(&minus(&up.1, &here.1), reach));
        let e = dot(&e1, &e1) + dot(&e1, &d1);
        let g = dot(&e2, &e2) + dot(&e2, &d2);
        let f = dot(&e1, &e2) + F64x4::splat(0.5) * (dot(&e1, &d2) + dot(&e2, &d1));
        let det = e * g - f * f;
        let mut any = false;
        for l in 0..LANES {
            any |= (e.0[l] <= 0.0) | (det.0[l] <= 0.0);
        }
        any
    }
}

/// Returns true if the offset by r folds a facet with the edges `e1` and `e2` from one corner. `d1` and `d2` are r
/// times the change of the unit normal along `e1` and `e2`. Returns false if a vector contains NaN.
///
/// Criterion: the matrix E + r B is not positive definite. E and B are the first and the second fundamental form with
/// respect to the basis `e1`, `e2`.
#[inline(always)]
fn is_not_positive_definite(e1: Vector, e2: Vector, d1: Vector, d2: Vector) -> bool {
    let e = e1.dot(&(e1 + d1));
    let g = e2.dot(&(e2 + d2));
    let f = e1.dot(&e2) + 0.5 * (e1.dot(&d2) + e2.dot(&d1));
    e <= 0.0 || e * g - f * f <= 0.0
}
