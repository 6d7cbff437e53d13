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

mod common_motion;
mod error;
mod joint;
mod normal_equations;
mod overlap;
mod projected_map;
mod scale;
mod seam;
mod spikes;

use std::collections::BTreeMap;

use nalgebra::DMatrix;

use common_motion::back_to_start;
pub use error::StitchingError;
use joint::{Joint, Settled};
use normal_equations::MapNoise;
pub use seam::Seam;
use seam::StitchedMaps;

use crate::geometry::{Point, Pose};
use crate::registration::{Method, PointStatus, Registration, RegistrationOptions, Start, register};
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
    /// Pose of each map in the common frame. On average the maps stay where their start poses place them.
    pub common_from_map: Vec<Pose>,
    /// Points in the common frame, map by map.
    pub common_points: Vec<Point>,
    /// Registration of these points. Its pose transforms the model frame to the common frame. Its warnings include those
    /// of the stitching.
    pub whole: Registration,
    /// Standard uncertainty of each deviation because of the poses of the maps, in millimetres.
    pub placement_sigmas_mm: Vec<f64>,
    /// Covariance of the small motions of the maps relative to the whole, 6 rows for each map: translation in millimetres,
    /// rotation in radians, in the model frame about its origin.
    pub covariance: DMatrix<f64>,
    /// Standard deviation of the noise of one point of each map, from the overlaps.
    pub noise_sigmas_mm: Vec<f64>,
    /// For each map, the factor of the variances of means over areas, because the noise of neighbouring points is
    /// correlated; 1 for independent noise.
    pub correlation_factors: Vec<f64>,
    /// Places where two maps overlap.
    pub seams: Vec<Seam>,
    /// Number of rounds of new correspondences.
    pub rounds: usize,
}

/// Registers several maps of one part together. Returns their poses, the deviations of all points, the covariance of the
/// poses, and the seams.
///
/// Shapes: at least two maps, each of at least 30 points, each joined to the others by at least 30 places of overlap.
/// Frames: the points of a map are in its own frame; its start pose places it in the common frame. Units: millimetres.
/// Equations: at the top of this module. An error that all maps have, such as that of the reference of an
/// interferometer, is not in the overlaps, so no figure here contains it.
///
/// # Errors
/// Returns an error if there are too few maps or points, if a map does not lie on the part or does not overlap the others,
/// if the steps do not converge, or if the registration of the whole fails.
pub fn stitch(
    nominal: &Nominal,
    maps: &[MeasuredMap],
    options: &StitchingOptions,
) -> Result<Stitching, StitchingError> {
    check(maps, options)?;
    let start: Vec<Pose> = maps.iter().map(|map| map.common_from_map).collect();
    // Before the stitching the maps do not agree, so the limit of the fit holds only for the end.
    let unlimited = RegistrationOptions { rms_limit_mm: Some(f64::INFINITY), ..options.registration };
    let first = register(nominal, &placed_points(maps, &start), &unlimited)?;
    let is_outlier: Vec<bool> = first.deviations.iter().map(|d| d.status == PointStatus::Outlier).collect();
    let model_from_common = first.cmm_from_model.inverse();
    let radius_mm =
        if options.registration.method == Method::Contact { 0.0 } else { options.registration.probe_radius_mm };
    let surface = OffsetSurface::new(nominal, radius_mm, first.side)?;
    let joint = Joint {
        surface: surface.with_distance_model(options.registration.distance_model),
        maps: maps.iter().map(|map| map.points).collect(),
        outliers: split(&is_outlier, maps),
        start: start.iter().map(|pose| model_from_common * *pose).collect(),
        placement_sigma_mm: options.placement_sigma_mm,
    };
    let settled = joint.settle()?;
    let back = back_to_start(&joint.maps, &joint.start, &settled.model_from_map, &settled.projected, &settled.scale);
    let common_from_settled = first.cmm_from_model * back;
    let common_from_map: Vec<Pose> = settled.model_from_map.iter().map(|pose| common_from_settled * *pose).collect();
    let common_points = placed_points(maps, &common_from_map);
    let from_first = RegistrationOptions { start: Start::Pose(first.cmm_from_model), ..options.registration };
    let mut whole = register(nominal, &common_points, &from_first)?;
    let final_from_settled = whole.cmm_from_model.inverse() * common_from_settled;
    let Settled { projected, pairs, scale, .. } = &settled;
    let correlation_factors = seam::correlation_factors(pairs, projected, &settled.noise);
    let factors = settled.noise.iter().zip(&correlation_factors);
    let noise: Vec<MapNoise> =
        factors.map(|(noise, &correlation_factor)| MapNoise { correlation_factor, ..*noise }).collect();
    let covariance = settled.equations.covariance(pairs, &noise);
    let covariance = normal_equations::relative_to_whole(&covariance, projected, scale);
    let stitched = StitchedMaps { pairs, projected, noise: &noise, scale, covariance: &covariance };
    let seams = stitched.seams(&final_from_settled);
    whole.quality.warnings.extend(warnings(&seam::left_out(pairs), &correlation_factors));
    Ok(Stitching {
        placement_sigmas_mm: stitched.placement_sigmas_mm(),
        seams,
        covariance: normal_equations::about_origin(&covariance, scale),
        noise_sigmas_mm: noise.iter().map(|noise| noise.sigma_mm).collect(),
        correlation_factors,
        common_from_map,
        common_points,
        whole,
        rounds: settled.rounds,
    })
}

/// Returns the values of each map from those of all points.
fn split<'a>(values: &'a [bool], maps: &[MeasuredMap]) -> Vec<&'a [bool]> {
    let mut rest = values;
    let part = |map: &MeasuredMap| {
        let (own, others) = rest.split_at(map.points.len());
        rest = others;
        own
    };
    maps.iter().map(part).collect()
}

/// Returns warnings of maps whose differences are not noise, and of seams at which many places are left out.
fn warnings(left_out: &BTreeMap<[usize; 2], [usize; 2]>, correlation_factors: &[f64]) -> Vec<String> {
    const MAX_FACTOR: f64 = 3.0;
    const MAX_LEFT_OUT: f64 = 0.1;
    let of_map = |(k, factor): (usize, &f64)| {
        format!(
            "map {}: its differences from other maps vary over areas with {factor:.1} times the variance that its noise \
             explains; check the scale, the reference and the cleanness of this map",
            k + 1
        )
    };
    let of_seam = |(maps, [left_out, places]): (&[usize; 2], &[usize; 2])| {
        let [first, second] = maps.map(|map| map + 1);
        format!(
            "maps {first} and {second} do not agree at {left_out} of {places} places, which are left out; check both for \
             dirt and for steps"
        )
    };
    let many = |(_, [left_out, places]): &(&[usize; 2], &[usize; 2])| *left_out as f64 > MAX_LEFT_OUT * *places as f64;
    let maps = correlation_factors.iter().enumerate().filter(|(_, factor)| **factor > MAX_FACTOR).map(of_map);
    maps.chain(left_out.iter().filter(many).map(of_seam)).collect()
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
