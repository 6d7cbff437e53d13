//! Where an offset surface folds: a probe does not fit into a place that is more concave than itself.

use rayon::prelude::*;

use super::offset::{OffsetSurface, Place};
use super::patch::{Lattice, Patch};
use super::{Side, SurfaceError};

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
        let everywhere = patches.iter().filter_map(|patch| {
            let stride = match &patch.lattice {
                // The lower halves of all cells.
                Lattice::Grid(_) => 2,
                Lattice::Mesh(mesh) => (mesh.facet_count() as usize).div_ceil(LOOKED_AT),
            };
            let facets = (0..patch.facet_count()).into_par_iter().step_by(stride);
            facets.map(|f| (self.least_curvature(patch, f), f)).min_by(|a, b| a.0.total_cmp(&b.0)).map(|w| (w, patch))
        });
        let there = touched.filter_map(|place| {
            let patch = &patches[place.patch() as usize];
            matches!(patch.lattice, Lattice::Mesh(_))
                .then(|| ((self.least_curvature(patch, place.facet()), place.facet()), patch))
        });
        let ((curvature, facet), patch) = everywhere.chain(there).min_by(|a, b| a.0.0.total_cmp(&b.0.0))?;
        // 1 + r k is the length of an element of the offset surface against that of the nominal one.
        if 1.0 + self.radius_mm() * curvature > 0.0 {
            return None;
        }
        let at = patch.points[patch.facet(facet)?[0] as usize].into();
        Some(SurfaceError::OffsetFolds { at, concave_radius_mm: -1.0 / curvature, probe_radius_mm: self.radius_mm() })
    }

    /// Returns the least normal curvature of a facet in 1/mm, negative where it is concave seen from the probe's side;
    /// infinity where there is no facet.
    ///
    /// The normals change by dn = K e along an edge e; with two edges as basis, K is E^-1 B with E the Gram matrix of the edges
    /// and B the symmetric part of e_i . dn_j.
    fn least_curvature(&self, patch: &Patch, facet: u32) -> f64 {
        let Some([a, b, c]) = patch.facet(facet) else { return f64::INFINITY };
        let p = [a, b, c].map(|v| patch.points[v as usize]);
        let sign = if self.side() == Side::Normal { 1.0 } else { -1.0 };
        let n = [a, b, c].map(|v| patch.normal(v) * sign);
        let (e1, e2, d1, d2) = (p[1] - p[0], p[2] - p[0], n[1] - n[0], n[2] - n[0]);
        let (e, f, g) = (e1.dot(&e1), e1.dot(&e2), e2.dot(&e2));
        let (l, m, k) = (e1.dot(&d1), 0.5 * (e1.dot(&d2) + e2.dot(&d1)), e2.dot(&d2));
        let det = e * g - f * f;
        let mean = 0.5 * (e * k - 2.0 * f * m + g * l) / det;
        let gauss = (l * k - m * m) / det;
        let least = mean - (mean * mean - gauss).max(0.0).sqrt();
        if least.is_nan() { f64::INFINITY } else { least }
    }
}
