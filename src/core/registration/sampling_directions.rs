//! Directions that only the sampling of the nominal surface determines.
//!
//! A cap about z is the same for any rotation about z. But its points lie on a grid, and the surface between them
//! differs slightly with the rotation. The rank test wrongly takes this as a weak determination of the rotation. So a
//! direction with a very small singular value is examined again on every second node of the grid. The contribution of
//! the part itself stays the same; the contribution of the sampling changes.

use super::correspond::Correspondence;
use super::iterate::{Descent, Problem, free_projector};
use super::solve::Spectrum;
use crate::surface::{FacetIndex, OffsetSurface};

/// Maximum singular value of a direction that is examined, as a share of the root of the sum of all squared singular
/// values.
const MAX_DOUBTFUL_SHARE: f64 = 1e-4;
/// Relative change of a direction's contribution above which the direction comes from the sampling.
const MAX_RELATIVE_CHANGE: f64 = 0.5;
/// Maximum number of points that are examined.
const MAX_EXAMINED: usize = 400;

/// Returns a lower limit for the singular values of the Jacobian. The limit is a share (0 to 1) of the root of the sum
/// of all squared singular values. The shape of the part does not determine the directions of the pose with a smaller
/// singular value. Only the node positions of the nominal grid determine these directions. An example is the rotation
/// of a spherical cap about its axis.
///
/// Only directions with a share of at most 1e-4 are tested. The test compares the Jacobian of the surface with the
/// Jacobian of a coarser surface through every second node. A direction depends on the node positions if its part of
/// the Jacobian changes by more than half.
///
/// Returns `None` if no direction depends on the node positions, if the surface is not a single grid, or if the coarser
/// surface cannot be made.
pub(super) fn sampling_share(problem: &Problem, descent: &Descent, correspondences: &[Correspondence]) -> Option<f64> {
    let free = free_projector(&problem.locked, &descent.scaling);
    let gram = descent.sums.gram();
    let spectrum = Spectrum::new(&(free * gram * free));
    let share = |k: usize| (spectrum.squares[k] / gram.trace()).sqrt();
    if descent.rank == 0 || share(descent.rank - 1) > MAX_DOUBTFUL_SHARE {
        return None;
    }
    let half = problem.surface.nominal().coarsened()?;
    let surface = &problem.surface;
    let coarse = OffsetSurface::new(&half, surface.radius_mm(), surface.side())
        .ok()?
        .with_distance_model(surface.distance_model());
    let model_from_cmm = descent.cmm_from_model.inverse();
    let used: Vec<usize> = (0..correspondences.len()).filter(|&k| correspondences[k].in_fit).collect();
    let rows: Vec<[[f64; 6]; 2]> = used
        .iter()
        .step_by(used.len().div_ceil(MAX_EXAMINED).max(1))
        .map(|&k| {
            let p = model_from_cmm.transform_point(&problem.measured[k]);
            [surface, &coarse].map(|on| descent.scaling.row(&p, &on.project(&p, FacetIndex::UNKNOWN).normal))
        })
        .collect();
    let is_of_the_sampling = |k: &usize| {
        let direction = spectrum.directions.column(*k);
        let along = |row: &[f64; 6]| row.iter().zip(direction.iter()).map(|(r, d)| r * d).sum::<f64>();
        let (seen, changed) = rows.iter().fold((0.0, 0.0), |(seen, changed), [fine, coarse]| {
            (seen + along(fine).powi(2), changed + (along(coarse) - along(fine)).powi(2))
        });
        changed > MAX_RELATIVE_CHANGE * MAX_RELATIVE_CHANGE * seen
    };
    let doubted = (0..descent.rank).rev().take_while(|k| share(*k) <= MAX_DOUBTFUL_SHARE).filter(is_of_the_sampling);
    let last = doubted.last()?;
    // Between the largest of them and the next larger singular value.
    let next = if last == 0 { 1.0 } else { share(last - 1) };
    Some((share(last) * next).sqrt())
}
