//! Noise of the points of a nominal surface about a smooth surface.
//!
//! A cubic is fitted to a few neighbours of a point, and another one to about twice as many. On a smooth surface the
//! residual grows with the fourth power of the distance; with noise the residual is the same in both fits.

use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;

use super::normals::{NEIGHBOURS, ring_around, tangents};
use super::patch::{Patch, Topology};
use crate::geometry::Point;

/// Number of terms of a cubic in two variables.
const TERMS: usize = 10;
/// Number of points that are checked.
const CHECKED_POINTS: usize = 100;
/// Maximum ratio of the residual with many neighbours to that with few. A larger ratio means that the residual is the
/// form of the surface itself.
const MAX_GROWTH: f64 = 2.0;

/// Returns the standard deviation of the noise of the points along the normal, in millimetres. Fits two local cubics at
/// each of about 100 vertices: one to 17 points, the other to 31. The estimate is the rms residual of the fits to 31
/// points.
///
/// Returns 0 if this residual is more than twice that of the fits to 17 points: such a residual shows the form of the
/// surface and not noise. Returns 0 if no fit is possible.
pub(super) fn noise_sigma_mm(patches: &[Patch]) -> f64 {
    let some = |patch| Patch::sample(patch, (CHECKED_POINTS / patches.len()).max(1)).map(move |vertex| (patch, vertex));
    let vertices: Vec<(&Patch, u32)> = patches.iter().flat_map(some).collect();
    let left: Vec<[f64; 2]> =
        vertices.into_par_iter().filter_map(|(patch, vertex)| residual_variances(patch, vertex)).collect();
    if left.is_empty() {
        return 0.0;
    }
    let [few, many] = [0, 1].map(|k| (left.iter().map(|squares| squares[k]).sum::<f64>() / left.len() as f64).sqrt());
    if many > MAX_GROWTH * few { 0.0 } else { many }
}

/// Returns the residual variances in mm^2 of two cubics about a vertex: one fitted to 17 points, the other to 31.
/// Returns `None` if there are too few neighbours, or if they do not determine a cubic.
fn residual_variances(patch: &Patch, vertex: u32) -> Option<[f64; 2]> {
    let around = tangent_frame_neighbours(patch, vertex);
    // The point itself is included; these are the smallest numbers that leave a few degrees of freedom.
    let of = |count: usize| around.get(..count).and_then(cubic_residual_variance);
    Some([of(NEIGHBOURS + 3)?, of(2 * NEIGHBOURS + 3)?])
}

/// Returns the positions [u, v, w] of a vertex and its neighbours in mm, sorted by the distance in the tangent plane,
/// nearest first. The origin is the vertex. The axes u and v are two tangents, and w is the unit normal at the vertex.
///
/// In a mesh the neighbours are whole rings of vertices with at least 31 vertices, as far as the mesh allows. In a grid
/// they are the nodes at most 3 rows and 3 columns away.
fn tangent_frame_neighbours(patch: &Patch, vertex: u32) -> Vec<[f64; 3]> {
    let wanted = 2 * NEIGHBOURS + 3;
    let others: Vec<u32> = match &patch.topology {
        Topology::Mesh(mesh) => ring_around(mesh, vertex, wanted),
        Topology::Grid(grid) => grid.block_around(vertex, 3),
    };
    let (at, normal) = (*patch.point(vertex), patch.normal(vertex));
    let [tu, tv] = tangents(&normal);
    let local = |p: &Point| {
        let d = p - at;
        [d.dot(&tu), d.dot(&tv), d.dot(&normal)]
    };
    let mut around: Vec<[f64; 3]> = others.iter().map(|&k| local(patch.point(k))).chain([[0.0; 3]]).collect();
    around.sort_by(|a, b| (a[0] * a[0] + a[1] * a[1]).total_cmp(&(b[0] * b[0] + b[1] * b[1])));
    around
}

/// Fits a cubic w(u, v) to places [u, v, w] by least squares. Returns the sum of squared residuals divided by the
/// degrees of freedom. Returns `None` if the places do not determine a cubic, or if no degree of freedom is left.
fn cubic_residual_variance(places: &[[f64; 3]]) -> Option<f64> {
    let size = places.last().map(|[u, v, _]| u.hypot(*v)).filter(|size| *size > 0.0)?;
    let mut normal = SMatrix::<f64, TERMS, TERMS>::zeros();
    let mut right = SVector::<f64, TERMS>::zeros();
    let row = |[u, v, _]: [f64; 3]| {
        let [u, v] = [u / size, v / size];
        SVector::<f64, TERMS>::from([1.0, u, v, u * u, u * v, v * v, u * u * u, u * u * v, u * v * v, v * v * v])
    };
    for place in places {
        let row = row(*place);
        normal.ger(1.0, &row, &row, 1.0);
        right.axpy(place[2], &row, 1.0);
    }
    let freedom = places.len().checked_sub(TERMS).filter(|freedom| *freedom > 0)?;
    let factor = normal.cholesky()?;
    let diagonal = factor.l_dirty().diagonal();
    if diagonal.min() < 1e-6 * diagonal.max() {
        return None;
    }
    let cubic = factor.solve(&right);
    let left: f64 = places.iter().map(|place| (place[2] - row(*place).dot(&cubic)).powi(2)).sum();
    Some(left / freedom as f64)
}

#[cfg(test)]
mod tests {
    use crate::geometry::Point;
    use crate::surface::{Nominal, PlaneProjection};

    /// Returns a wavy surface from points 1 mm apart with the given noise; a jitter other than 0 makes them scattered
    /// points and not a grid.
    fn nominal(jitter_mm: f64, scatter_mm: f64) -> Nominal {
        let mut state = 1u64;
        let mut uniform = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        let points = (0..60 * 40).map(|k| {
            let [x, y] = [(k % 60) as f64 + jitter_mm * uniform(), (k / 60) as f64 + jitter_mm * uniform()];
            // A uniform variable from -sqrt 3 to sqrt 3 has a standard deviation of 1.
            Point::new(x, y, (0.1 * x).sin() + 0.01 * y * y + scatter_mm * 12f64.sqrt() * uniform())
        });
        Nominal::from_points(points.collect(), PlaneProjection::Xy).unwrap()
    }

    #[test]
    fn surface_noise_is_recovered() {
        for jitter_mm in [0.0, 0.5] {
            for scatter_mm in [1e-3, 1e-2] {
                let found_mm = nominal(jitter_mm, scatter_mm).noise_sigma_mm();
                assert!((found_mm / scatter_mm - 1.0).abs() < 0.2, "{jitter_mm}: {found_mm} of {scatter_mm}");
            }
            let smooth_mm = nominal(jitter_mm, 0.0).noise_sigma_mm();
            assert!(smooth_mm < 5e-5, "{jitter_mm}: {smooth_mm}");
        }
    }
}
