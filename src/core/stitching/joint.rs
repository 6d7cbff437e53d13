//! Estimates the poses of all maps in turn with their correspondences.

use nalgebra::Vector6;
use rayon::prelude::*;

use super::error::StitchingError;
use super::normal_equations::{NormalEquations, SideWeights};
use super::overlap::{OverlapRow, PairRows, overlap_rows};
use super::projected_map::ProjectedMap;
use super::scale::Scale;
use crate::geometry::{Point, Pose};
use crate::surface::{FacetIndex, OffsetSurface};

/// Maximum number of rounds of correspondences and steps.
const MAX_ROUNDS: usize = 40;

/// Minimum number of overlap rows that join two maps.
pub(super) const MIN_ROWS: usize = 30;

/// Largest step of a round, in sizes of the part and in radians.
const BALL_RADIUS: f64 = 0.1;

/// Root mean square of the changes of the overlap residuals, in noise standard deviations, at which the rounds end.
const CONVERGED_SIGMAS: f64 = 1e-3;

/// Limit of a residual in robust standard deviations; a row beyond it is left out.
const OUTLIER_SIGMAS: f64 = 6.0;

/// Smallest noise in millimetres: exact data have only rounding.
const MIN_NOISE_MM: f64 = 1e-11;

/// Maps to stitch.
pub(super) struct Joint<'a> {
    pub(super) surface: OffsetSurface<'a>,
    pub(super) maps: Vec<&'a [Point]>,
    /// Start pose of each map: `model_from_map`.
    pub(super) start: Vec<Pose>,
    pub(super) placement_sigma_mm: f64,
}

/// State after the last round.
pub(super) struct Settled {
    pub(super) model_from_map: Vec<Pose>,
    pub(super) projected: Vec<ProjectedMap>,
    pub(super) pairs: Vec<PairRows>,
    pub(super) scale: Scale,
    pub(super) equations: NormalEquations,
    pub(super) noise_sigma_mm: f64,
    pub(super) rounds: usize,
}

impl Joint<'_> {
    /// Repeats correspondences and steps until the residuals of the overlaps no longer change.
    pub(super) fn settle(&self) -> Result<Settled, StitchingError> {
        let mut poses = self.start.clone();
        let mut facets: Vec<Vec<FacetIndex>> =
            self.maps.iter().map(|points| vec![FacetIndex::UNKNOWN; points.len()]).collect();
        // As if the noise were a hundredth of the form, until the overlaps tell.
        let mut noise_share = 1e-2;
        for round in 1..=MAX_ROUNDS {
            let projected: Vec<ProjectedMap> = self
                .maps
                .iter()
                .zip(&poses)
                .zip(&mut facets)
                .map(|((points, pose), facets)| ProjectedMap::new(&self.surface, points, pose, facets))
                .collect();
            let scale = Scale::of_places(projected.iter().flat_map(|map| &map.feet));
            let mut pairs = overlap_rows(&projected, &scale);
            check_joined(&pairs, projected.len())?;
            let form_mm = form_rms_mm(&projected).max(MIN_NOISE_MM);
            let noise_mm = (noise_share * form_mm).max(MIN_NOISE_MM);
            let weights = SideWeights {
                nominal: noise_share * noise_share,
                placement: (noise_mm / self.placement_sigma_mm).powi(2),
            };
            let start = poses.iter().zip(&self.start).map(|(pose, start)| scale.motion(&(*pose * start.inverse())));
            let moved: Vec<Vector6<f64>> = start.collect();
            let radius_mm = BALL_RADIUS * scale.size_mm;
            let solve = |pairs: &[PairRows]| {
                let equations = NormalEquations::new(pairs, &projected, &scale, weights, &moved);
                let steps = equations.solve(radius_mm);
                (equations, steps)
            };
            let (_, steps) = solve(&pairs);
            leave_out_outliers(&mut pairs, &steps);
            let (equations, steps) = solve(&pairs);
            let noise_sigma_mm = noise_sigma_mm(&pairs, &steps, projected.len()).max(MIN_NOISE_MM);
            let is_settled = change_mm(&pairs, &steps) <= CONVERGED_SIGMAS * noise_sigma_mm;
            let known = (noise_sigma_mm / form_mm).min(1.0);
            if is_settled && (known / noise_share - 1.0).abs() < 0.1 {
                let (model_from_map, rounds) = (poses, round);
                return Ok(Settled { model_from_map, projected, pairs, scale, equations, noise_sigma_mm, rounds });
            }
            noise_share = known;
            poses = poses.iter().zip(&steps).map(|(pose, step)| (scale.pose(step) * *pose).orthonormalised()).collect();
        }
        Err(StitchingError::NotConverged { rounds: MAX_ROUNDS })
    }
}

/// Checks that the overlaps join all maps.
fn check_joined(pairs: &[PairRows], map_count: usize) -> Result<(), StitchingError> {
    let mut places = vec![vec![0; map_count]; map_count];
    for pair in pairs {
        places[pair.first][pair.second] += pair.rows.len();
        places[pair.second][pair.first] += pair.rows.len();
    }
    let mut joined = vec![false; map_count];
    joined[0] = true;
    loop {
        let to_joined = |map: usize| (0..map_count).filter(|&l| joined[l]).map(|l| places[map][l]).max().unwrap_or(0);
        let next = (0..map_count).filter(|&map| !joined[map]).max_by_key(|&map| (to_joined(map), map_count - map));
        match next {
            None => return Ok(()),
            Some(map) if to_joined(map) >= MIN_ROWS => joined[map] = true,
            Some(map) => {
                return Err(StitchingError::NoOverlap { map, places: to_joined(map), min_places: MIN_ROWS });
            }
        }
    }
}

/// Returns the root mean square of the deviations of all maps from the nominal surface.
fn form_rms_mm(maps: &[ProjectedMap]) -> f64 {
    let on_part = maps.iter().flat_map(|map| map.deviations_mm.iter().zip(&map.on_part)).filter(|(_, on)| **on);
    let (sum, count) = on_part.fold((0.0, 0.0), |(sum, n), (d, _)| (sum + d * d, n + 1.0));
    (sum / f64::max(count, 1.0)).sqrt()
}

/// Returns the residual of a row after the steps.
fn residual_mm(row: &OverlapRow, pair: &PairRows, steps: &[Vector6<f64>]) -> f64 {
    row.residual_mm + row.jacobian.dot(&(steps[pair.first] - steps[pair.second]))
}

/// Gives no weight to rows whose residual after the steps is far from those of the others.
fn leave_out_outliers(pairs: &mut [PairRows], steps: &[Vector6<f64>]) {
    let scaled = |row: &OverlapRow, pair: &PairRows| residual_mm(row, pair, steps).abs() * row.precision.sqrt();
    let mut all: Vec<f64> = pairs.iter().flat_map(|pair| pair.rows.iter().map(move |row| scaled(row, pair))).collect();
    let middle = all.len() / 2;
    let (_, median, _) = all.select_nth_unstable_by(middle, f64::total_cmp);
    let limit = OUTLIER_SIGMAS * 1.4826 * median.max(MIN_NOISE_MM);
    pairs.par_iter_mut().for_each(|pair| {
        let far: Vec<bool> = pair.rows.iter().map(|row| scaled(row, pair) > limit).collect();
        pair.rows.iter_mut().zip(far).filter(|(_, far)| *far).for_each(|(row, _)| row.precision = 0.0);
    });
}

/// Returns the standard deviation of the noise of one point from the residuals after the steps.
fn noise_sigma_mm(pairs: &[PairRows], steps: &[Vector6<f64>], map_count: usize) -> f64 {
    let used = pairs
        .iter()
        .flat_map(|pair| pair.rows.iter().map(move |row| (row, pair)))
        .filter(|(row, _)| row.precision > 0.0);
    let (sum, count) = used.fold((0.0, 0.0), |(sum, n), (row, pair)| {
        (sum + row.precision * residual_mm(row, pair, steps).powi(2), n + 1.0)
    });
    let freedom = f64::max(count - 6.0 * (map_count as f64 - 1.0), 1.0);
    (sum / freedom).sqrt()
}

/// Returns the root mean square of the changes of the residuals by the steps.
fn change_mm(pairs: &[PairRows], steps: &[Vector6<f64>]) -> f64 {
    let changes = pairs.iter().flat_map(|pair| {
        let step = steps[pair.first] - steps[pair.second];
        pair.rows.iter().map(move |row| row.jacobian.dot(&step))
    });
    let (sum, count) = changes.fold((0.0, 0.0), |(sum, n), change| (sum + change * change, n + 1.0));
    (sum / f64::max(count, 1.0)).sqrt()
}
