//! Where an offset surface folds: a probe does not fit into a place that is more concave than itself.

use rayon::prelude::*;

use super::SurfaceError;
use super::offset::{OffsetSurface, Place};
use super::patch::{Lattice, Patch};

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
            let stride = match &patch.lattice {
                // The lower halves of all cells.
                Lattice::Grid(_) => 2,
                Lattice::Mesh(mesh) => (mesh.facet_count() as usize).div_ceil(LOOKED_AT),
            };
            let facets = (0..patch.facet_count()).into_par_iter().step_by(stride).with_min_len(4096);
            facets.filter(|&f| self.folds(patch, f)).collect::<Vec<_>>().into_iter().map(move |f| (patch, f))
        });
        let there = touched.map(|place| (&patches[place.patch() as usize], place.facet()));
        let there = there.filter(|(p, f)| matches!(p.lattice, Lattice::Mesh(_)) && self.folds(p, *f));
        let worst = everywhere.chain(there).map(|(p, f)| (self.least_curvature(p, f), p, f));
        let (curvature, patch, facet) = worst.min_by(|a, b| a.0.total_cmp(&b.0))?;
        let at = patch.points[patch.facet(facet)?[0] as usize].into();
        Some(SurfaceError::OffsetFolds { at, concave_radius_mm: -1.0 / curvature, probe_radius_mm: self.radius_mm() })
    }

    /// Whether the offset turns a facet over or flattens it: whether E + r B is no longer positive definite.
    #[inline]
    fn folds(&self, patch: &Patch, facet: u32) -> bool {
        let Some(([e, f, g], [l, m, k])) = self.forms(patch, facet) else { return false };
        let r = self.radius_mm();
        let (e, f, g) = (e + r * l, f + r * m, g + r * k);
        // Not so for NaN, which a hole has.
        e <= 0.0 || e * g - f * f <= 0.0
    }

    /// Returns the least normal curvature of a facet in 1/mm, negative where it is concave seen from the probe's side: the
    /// least eigenvalue of E^-1 B.
    fn least_curvature(&self, patch: &Patch, facet: u32) -> f64 {
        let Some(([e, f, g], [l, m, k])) = self.forms(patch, facet) else { return f64::INFINITY };
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
    fn forms(&self, patch: &Patch, facet: u32) -> Option<([f64; 3], [f64; 3])> {
        let [a, b, c] = patch.facet(facet)?;
        let (p, q) = (patch.points[a as usize], patch.normal(a));
        let (e1, e2) = (patch.points[b as usize] - p, patch.points[c as usize] - p);
        let sign = self.side().sign();
        let (d1, d2) = ((patch.normal(b) - q) * sign, (patch.normal(c) - q) * sign);
        let first = [e1.dot(&e1), e1.dot(&e2), e2.dot(&e2)];
        Some((first, [e1.dot(&d1), 0.5 * (e1.dot(&d2) + e2.dot(&d1)), e2.dot(&d2)]))
    }
}
