//! Stitching: registers several maps or clouds of one part together, so that they agree where they overlap.
//!
//! ```text
//!  maps  --register-->  deviations  -->  overlap rows  -->  normal equations  -->  small motion of each map
//!                            ^                                                          |
//!                            +------------------ until nothing changes <----------------+
//! ```
//!
//! The method is that of Chen, Li and Dai (2005) and of Chen, Xue, Dai and Li (2015), references 21 and 22 of the paper:
//! the poses of all maps are estimated at once from their deviations where they overlap, and correspondences and poses are
//! estimated in turn, with steps that a ball limits. For a point i of map k above a place that map l has measured too,
//!
//! ```text
//!  r = d_ki - sum_j w_j d_lj,    dr = J_i (m_k - m_l),    J = [n, (p - c) x n]
//! ```
//!
//! with the deviations d from the nominal surface, weights w_j of the neighbours in map l (a local quadratic), the normal
//! n, and the small motions m. The form of the part is in both deviations, so it cancels. The deviations from the nominal
//! surface count as little as one sample of the form for each map: they place the whole, and do not bend it.
//!
//! Frames: each map has a frame of its own; a start pose places it in the common frame {W}, and the whole is registered
//! in this frame. Units: millimetres and radians. Pure: the same input gives the same bits.

mod error;
mod joint;
mod normal_equations;
mod overlap;
mod projected_map;
mod scale;
mod seam;

use nalgebra::DMatrix;

pub use error::StitchingError;
use joint::{Joint, Settled};
pub use seam::Seam;

use crate::geometry::{Point, Pose};
use crate::registration::{Method, Registration, RegistrationOptions, Start, register};
use crate::surface::{Nominal, OffsetSurface};

/// Minimum number of points of a map.
const MIN_POINTS: usize = 30;

/// Map or cloud of a part of the surface.
#[derive(Clone, Copy, Debug)]
pub struct MeasuredMap<'a> {
    /// Measured points in the frame of the map, in millimetres.
    pub points: &'a [Point],
    /// Approximate pose that transforms the frame of the map to the common frame.
    pub common_from_map: Pose,
}

/// Options of a stitching.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StitchingOptions {
    /// Options of the registration of the whole.
    pub registration: RegistrationOptions,
    /// Standard uncertainty of the start pose of a map, in millimetres at the border of the part. It keeps a map in place
    /// along directions that neither the overlaps nor the nominal surface determine.
    pub placement_sigma_mm: f64,
}

/// Result of a stitching.
#[derive(Clone, Debug)]
pub struct Stitching {
    /// Pose of each map in the common frame.
    pub common_from_map: Vec<Pose>,
    /// Points in the common frame, map by map.
    pub common_points: Vec<Point>,
    /// Registration of these points. Its pose transforms the model frame to the common frame.
    pub whole: Registration,
    /// Standard uncertainty of each deviation because of the poses of the maps, in millimetres.
    pub placement_sigmas_mm: Vec<f64>,
    /// Covariance of the small motions of the maps relative to the whole, 6 rows for each map: translation in millimetres,
    /// rotation in radians, in the model frame about its origin.
    pub covariance: DMatrix<f64>,
    /// Standard deviation of the noise of one point, from the overlaps.
    pub noise_sigma_mm: f64,
    /// Factor of the covariance because the noise of neighbouring points is correlated; 1 for independent noise.
    pub correlation_factor: f64,
    /// Places where two maps overlap.
    pub seams: Vec<Seam>,
    /// Number of rounds.
    pub rounds: usize,
}

/// Registers several maps of one part together. Returns their poses, the deviations of all points, the covariance of the
/// poses, and the seams.
///
/// Shapes: at least two maps, each of at least 30 points, each joined to the others by at least 30 places of overlap.
/// Frames: the points of a map are in its own frame; its start pose places it in the common frame. Units: millimetres.
/// Equations: at the top of this module.
///
/// # Errors
/// Returns an error if there are too few maps or points, if a map does not overlap the others, if the rounds do not
/// converge, or if the registration of the whole fails.
pub fn stitch(
    nominal: &Nominal,
    maps: &[MeasuredMap],
    options: &StitchingOptions,
) -> Result<Stitching, StitchingError> {
    check(maps, options)?;
    let start: Vec<Pose> = maps.iter().map(|map| map.common_from_map).collect();
    let first = register(nominal, &placed_points(maps, &start), &options.registration)?;
    let model_from_common = first.cmm_from_model.inverse();
    let radius_mm =
        if options.registration.method == Method::Contact { 0.0 } else { options.registration.probe_radius_mm };
    let surface = OffsetSurface::new(nominal, radius_mm, first.side)?;
    let joint = Joint {
        surface: surface.with_distance_model(options.registration.distance_model),
        maps: maps.iter().map(|map| map.points).collect(),
        start: start.iter().map(|pose| model_from_common * *pose).collect(),
        placement_sigma_mm: options.placement_sigma_mm,
    };
    let settled = joint.settle()?;
    let common_from_map: Vec<Pose> = settled.model_from_map.iter().map(|pose| first.cmm_from_model * *pose).collect();
    let common_points = placed_points(maps, &common_from_map);
    let from_first = RegistrationOptions { start: Start::Pose(first.cmm_from_model), ..options.registration };
    let whole = register(nominal, &common_points, &from_first)?;
    let final_from_model = whole.cmm_from_model.inverse() * first.cmm_from_model;
    let Settled { projected, pairs, scale, noise_sigma_mm, .. } = &settled;
    let correlation_factor = seam::correlation_factor(pairs, projected, *noise_sigma_mm);
    let covariance = settled.equations.covariance(pairs, *noise_sigma_mm, correlation_factor);
    let covariance = normal_equations::relative_to_whole(&covariance, projected, scale);
    Ok(Stitching {
        placement_sigmas_mm: placement_sigmas_mm(&covariance, &settled),
        seams: seam::seams(pairs, projected, scale, &covariance, &final_from_model),
        covariance: normal_equations::about_origin(&covariance, scale),
        noise_sigma_mm: *noise_sigma_mm,
        correlation_factor,
        common_from_map,
        common_points,
        whole,
        rounds: settled.rounds,
    })
}

/// Checks the input before any computation.
fn check(maps: &[MeasuredMap], options: &StitchingOptions) -> Result<(), StitchingError> {
    if maps.len() < 2 {
        return Err(StitchingError::TooFewMaps { maps: maps.len() });
    }
    if let Some((map, found)) = maps.iter().enumerate().find(|(_, map)| map.points.len() < MIN_POINTS) {
        return Err(StitchingError::TooFewPoints { map, points: found.points.len(), min_points: MIN_POINTS });
    }
    let sigma_mm = options.placement_sigma_mm;
    if !(sigma_mm > 0.0 && sigma_mm.is_finite()) {
        return Err(StitchingError::PlacementSigma { sigma_mm });
    }
    if options.registration.method == Method::SubtractRadius {
        return Err(StitchingError::Method);
    }
    Ok(())
}

fn placed_points(maps: &[MeasuredMap], poses: &[Pose]) -> Vec<Point> {
    let placed = maps.iter().zip(poses).map(|(map, pose)| map.points.iter().map(|p| pose.transform_point(p)));
    placed.flatten().collect()
}

/// Returns the standard uncertainty of each deviation because of the poses of the maps.
fn placement_sigmas_mm(covariance: &DMatrix<f64>, settled: &Settled) -> Vec<f64> {
    let of_map = |(k, map): (usize, &projected_map::ProjectedMap)| -> Vec<f64> {
        let own = covariance.fixed_view::<6, 6>(6 * k, 6 * k);
        let sigma_mm = |(point, normal)| {
            let jacobian = settled.scale.jacobian(point, normal);
            (jacobian.transpose() * own * jacobian)[0].max(0.0).sqrt()
        };
        map.points.iter().zip(&map.normals).map(sigma_mm).collect()
    };
    settled.projected.iter().enumerate().flat_map(of_map).collect()
}
