//! Where an offset surface folds: a probe does not fit into a place that is more concave than itself.

use rayon::prelude::*;

use crate::geometry::{Point, Vector};

use super::SurfaceError;
use super::offset::{OffsetSurface, Place};
use super::patch::{Facets, Lattice, Patch};

/// Facets of a mesh that are looked at besides those touched: its normals are fitted only where they are needed.
const LOOKED_AT: usize = 8192;

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
                    let (columns, normals) = (grid.columns(), patch.known_normals());
                    let rows = (0..grid.rows() - 1).into_par_iter().with_min_len(8);
                    let first = |j: usize| j * columns..(j + 2) * columns;
                    rows.filter(|&j| self.row_folds(columns, &patch.points[first(j)], &normals[first(j)]))
                        .flat_map_iter(|j| grid.row_of_facets(j))
                        .filter(|&(facet, corners)| grid.has_facet(facet) && self.folds(patch, corners))
                        .map(|(facet, _)| facet)
                        .collect()
                }
                Lattice::Mesh(mesh) => {
                    let stride = (mesh.facet_count() as usize).div_ceil(LOOKED_AT);
                    (0..mesh.facet_count())
                        .into_par_iter()
                        .step_by(stride)
                        .filter(|&f| self.folds(patch, mesh.corners(f)))
                        .collect()
                }
            };
            folded.into_iter().map(move |f| (patch, f))
        });
        let there = touched.map(|place| (&patches[place.patch() as usize], place.facet()));
        let there = there.filter(|(p, f)| matches!(p.lattice, Lattice::Mesh(_)) && self.folds(p, p.corners(*f)));
        let worst = everywhere.chain(there).map(|(p, f)| (self.least_curvature(p, f), p, f));
        let (curvature, patch, facet) = worst.min_by(|a, b| a.0.total_cmp(&b.0))?;
        let at = patch.points[patch.corners(facet)[0] as usize].into();
        Some(SurfaceError::OffsetFolds { at, concave_radius_mm: -1.0 / curvature, probe_radius_mm: self.radius_mm() })
    }

    /// Whether any lower facet between two rows of nodes folds; holes do not.
    fn row_folds(&self, columns: usize, points: &[Point], normals: &[Vector]) -> bool {
        let reach = self.radius_mm() * self.side().sign();
        let (p0, p1) = points.split_at(columns);
        let (n0, n1) = normals.split_at(columns);
        let ends = p0.windows(2).zip(&p1[1..]).zip(n0.windows(2).zip(&n1[1..]));
        ends.fold(false, |any, ((p, above), (n, n_above))| {
            any | not_positive(p[1] - p[0], above - p[0], (n[1] - n[0]) * reach, (n_above - n[0]) * reach)
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
