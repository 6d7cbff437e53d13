//! Where an offset surface folds: a probe does not fit into a place that is more concave than itself.

use rayon::prelude::*;

use crate::geometry::Vector;

use super::SurfaceError;
use super::grid::GridLattice;
use super::offset::{OffsetSurface, Place};
use super::patch::{Facets, Lattice, Patch};

/// Facets of a mesh that are looked at besides those touched: its normals are fitted only where they are needed.
const LOOKED_AT: usize = 2048;

/// A grid is first looked over in steps of two nodes with a probe this much larger; only if that one nearly folds anywhere is
/// every facet looked at. A surface whose curvature changes by a third between neighbouring nodes is not sampled but guessed.
const STEP: usize = 2;
const DOUBT: f64 = 1.4;

impl OffsetSurface<'_> {
    /// Returns the worst place where the offset surface folds, if it does: over a whole grid, and over a mesh where it was
    /// touched and at some thousand places besides.
    pub(crate) fn fold(&self, touched: impl Iterator<Item = Place>) -> Option<SurfaceError> {
        if self.radius_mm() == 0.0 {
            return None;
        }
        let patches = self.nominal().patches();
        let everywhere = patches.iter().flat_map(|patch| {
            let folded: Vec<u32> = match &patch.lattice {
                Lattice::Grid(grid) => {
                    let doubtful = (0..grid.rows() - 1)
                        .into_par_iter()
                        .step_by(STEP)
                        .any(|j| self.row_is_doubtful(patch, grid, j));
                    let rows = if doubtful { grid.rows() - 1 } else { 0 };
                    (0..rows)
                        .into_par_iter()
                        .flat_map_iter(|j| grid.row_of_facets(j))
                        .filter(|&(facet, corners)| grid.has_facet(facet) && self.folds(patch, corners))
                        .map(|(facet, _)| facet)
                        .collect()
                }
                Lattice::Mesh(mesh) => {
                    let stride = (mesh.facet_count() as usize).div_ceil(LOOKED_AT);
                    let looked_at: Vec<u32> = (0..mesh.facet_count()).step_by(stride).collect();
                    patch.fit_normals(&looked_at.iter().flat_map(|&f| mesh.corners(f)).collect::<Vec<_>>());
                    looked_at.into_par_iter().filter(|&f| self.folds(patch, mesh.corners(f))).collect()
                }
            };
            folded.into_iter().map(move |f| (patch, f))
        });
        let there = touched.map(|place| (&patches[place.patch() as usize], place.facet()));
        let there: Vec<(&Patch, u32)> = there.filter(|(p, _)| matches!(p.lattice, Lattice::Mesh(_))).collect();
        let there: Vec<_> = there.into_par_iter().filter(|(p, f)| self.folds(p, p.corners(*f))).collect();
        let worst = everywhere.chain(there).map(|(p, f)| (self.least_curvature(p, f), p, f));
        let (curvature, patch, facet) = worst.min_by(|a, b| a.0.total_cmp(&b.0))?;
        let at = patch.points[patch.corners(facet)[0] as usize].into();
        Some(SurfaceError::OffsetFolds { at, concave_radius_mm: -1.0 / curvature, probe_radius_mm: self.radius_mm() })
    }

    /// Whether any of the wide facets along a row of nodes comes near to folding; holes do not.
    fn row_is_doubtful(&self, patch: &Patch, grid: &GridLattice, row: usize) -> bool {
        let (columns, normals) = (grid.columns(), patch.known_normals());
        let up = STEP.min(grid.rows() - 1 - row) * columns;
        let reach = self.radius_mm() * self.side().sign() * DOUBT;
        (row * columns..(row + 1) * columns - STEP).step_by(STEP).any(|node| {
            let edges = [node + STEP, node + up].map(|k| patch.points[k] - patch.points[node]);
            let changes = [node + STEP, node + up].map(|k| (normals[k] - normals[node]) * reach);
            not_positive(edges[0], edges[1], changes[0], changes[1])
        })
    }

    /// Whether the offset turns a facet over or flattens it: whether E + r B is no longer positive definite.
    #[inline]
    fn folds(&self, patch: &Patch, corners: [u32; 3]) -> bool {
        let [p, q, t] = corners.map(|v| patch.points[v as usize]);
        let [a, b, c] = corners.map(|v| patch.normal(v));
        let reach = self.radius_mm() * self.side().sign();
        not_positive(q - p, t - p, (b - a) * reach, (c - a) * reach)
    }

    /// Returns the least normal curvature of a facet in 1/mm, negative where it is concave seen from the probe's side: the
    /// least eigenvalue of E^-1 B.
    fn least_curvature(&self, patch: &Patch, facet: u32) -> f64 {
        let ([e, f, g], [l, m, k]) = self.forms(patch, patch.corners(facet));
        let det = e * g - f * f;
        let mean = 0.5 * (e * k - 2.0 * f * m + g * l) / det;
        let gauss = (l * k - m * m) / det;
        mean - (mean * mean - gauss).max(0.0).sqrt()
    }

    /// Returns the first and second fundamental forms over two edges of a facet, seen from the probe's side.
    ///
    /// The normals change by dn = K e along an edge e, so with E_ij = e_i . e_j and B_ij the symmetric part of e_i . dn_j, K is
    /// E^-1 B and the offset has the first form E + 2 r B + O(r^2), which is singular where E + r B is.
    #[inline]
    fn forms(&self, patch: &Patch, [a, b, c]: [u32; 3]) -> ([f64; 3], [f64; 3]) {
        let (p, q) = (patch.points[a as usize], patch.normal(a));
        let (e1, e2) = (patch.points[b as usize] - p, patch.points[c as usize] - p);
        let sign = self.side().sign();
        let (d1, d2) = ((patch.normal(b) - q) * sign, (patch.normal(c) - q) * sign);
        let first = [e1.dot(&e1), e1.dot(&e2), e2.dot(&e2)];
        (first, [e1.dot(&d1), 0.5 * (e1.dot(&d2) + e2.dot(&d1)), e2.dot(&d2)])
    }
}

/// Whether E + r B is not positive definite, for two edges and r times the change of the normal along each; not so for NaN.
#[inline(always)]
fn not_positive(e1: Vector, e2: Vector, d1: Vector, d2: Vector) -> bool {
    let e = e1.dot(&(e1 + d1));
    let g = e2.dot(&(e2 + d2));
    let f = e1.dot(&e2) + 0.5 * (e1.dot(&d2) + e2.dot(&d1));
    e <= 0.0 || e * g - f * f <= 0.0
}
