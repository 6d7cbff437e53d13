//! Estimates the poses of all maps in turn with their correspondences.

use nalgebra::{DMatrix, DVector, Vector6};

use super::error::StitchingError;
use super::normal_equations::{MapNoise, NormalEquations, SideSigmas};
use super::overlap::{OverlapRow, PairRows, overlap_rows};
use super::projected_map::ProjectedMap;
use super::scale::Scale;
use super::spikes::spikes;
use crate::geometry::{Point, Pose};
use crate::surface::{FacetIndex, OffsetSurface};

/// Maximum number of rounds, each with new correspondences.
const MAX_ROUNDS: usize = 12;

/// Maximum number of steps of a round.
const MAX_STEPS: usize = 60;

/// Minimum number of overlap rows that join two maps.
pub(super) const MIN_ROWS: usize = 30;

/// Minimum share of the points of a map that are on the part.
const MIN_ON_PART: f64 = 0.25;

/// Largest step, in sizes of the part and in radians.
const BALL_RADIUS: f64 = 0.1;

/// Root mean square of the changes of the overlap residuals, in noise standard deviations, at which a round ends.
const CONVERGED_SIGMAS: f64 = 1e-3;

/// Shift of the points since the correspondences were made, in millimetres times the slope of the form, at which they
/// are still right: as a share of the noise of a point.
const SETTLED_SIGMAS: f64 = 0.05;

/// Change of the noise of a map in one round, as a share, at which the rows that are left out are the right ones.
const SETTLED_NOISE: f64 = 0.1;

/// Limit of a residual in robust standard deviations; a row beyond it is left out.
const OUTLIER_SIGMAS: f64 = 6.0;

/// Numbers of steps with the weights of Huber and then of Tukey, which find the rows that are left out.
const ROBUST_STEPS: [usize; 2] = [8, 12];

/// Smallest noise in millimetres: exact data have only rounding.
const MIN_NOISE_MM: f64 = 1e-10;

/// Maps to stitch.
pub(super) struct Joint<'a> {
    pub(super) surface: OffsetSurface<'a>,
    pub(super) maps: Vec<&'a [Point]>,
    /// Points that are not used, for each map.
    pub(super) outliers: Vec<&'a [bool]>,
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
    pub(super) noise: Vec<MapNoise>,
    pub(super) rounds: usize,
}

impl Joint<'_> {
    /// Repeats correspondences and steps until the points no longer move along the surface.
    pub(super) fn settle(&self) -> Result<Settled, StitchingError> {
        let mut poses = self.start.clone();
        let mut facets: Vec<Vec<FacetIndex>> =
            self.maps.iter().map(|points| vec![FacetIndex::UNKNOWN; points.len()]).collect();
        let mut noise_mm = Vec::new();
        let mut outliers: Vec<Vec<bool>> = self.outliers.iter().map(|outliers| outliers.to_vec()).collect();
        let projected = self.projected(&poses, &outliers, &mut facets);
        for (outliers, map) in outliers.iter_mut().zip(&projected) {
            outliers.iter_mut().zip(spikes(map)).for_each(|(outlier, spike)| *outlier |= spike);
        }
        for round in 1..=MAX_ROUNDS {
            let projected = self.projected(&poses, &outliers, &mut facets);
            check_on_part(&projected)?;
            let scale = Scale::of_places(projected.iter().flat_map(|map| &map.feet));
            let pairs = overlap_rows(&projected, &scale);
            check_joined(&pairs, projected.len())?;
            if noise_mm.is_empty() {
                // As if the noise were a hundredth of the form, until the overlaps tell.
                noise_mm = vec![(1e-2 * form_rms_mm(&projected)).max(MIN_NOISE_MM); projected.len()];
            }
            let (before, noise_before_mm) = (poses.clone(), noise_mm.clone());
            let (poses_of_round, facets) = (&mut poses, &mut facets[..]);
            let mut descent =
                Descent { joint: self, outliers: &outliers, poses: poses_of_round, facets, projected, pairs, scale };
            let equations = descent.run(&mut noise_mm, round == 1)?;
            let Descent { projected, pairs, scale, .. } = descent;
            let effect_mm = lateral_shift_mm(&before, &poses, &self.maps) * slope(&pairs, &noise_mm);
            let noise_is_known =
                noise_mm.iter().zip(&noise_before_mm).all(|(a, b)| (a / b - 1.0).abs() < SETTLED_NOISE);
            if (noise_is_known && effect_mm <= SETTLED_SIGMAS * mean(&noise_mm)) || round == MAX_ROUNDS {
                let noise = noise_mm.iter().map(|&sigma_mm| MapNoise { sigma_mm, correlation_factor: 1.0 }).collect();
                return Ok(Settled { model_from_map: poses, projected, pairs, scale, equations, noise, rounds: round });
            }
        }
        Err(StitchingError::NotConverged { rounds: MAX_ROUNDS })
    }

    fn projected(&self, poses: &[Pose], outliers: &[Vec<bool>], facets: &mut [Vec<FacetIndex>]) -> Vec<ProjectedMap> {
        let maps = self.maps.iter().zip(outliers).zip(poses).zip(facets);
        maps.map(|(((points, outliers), pose), facets)| {
            ProjectedMap::new(&self.surface, points, outliers, pose, facets)
        })
        .collect()
    }
}

/// Steps of one round, with correspondences that stay.
struct Descent<'a, 'b> {
    joint: &'a Joint<'b>,
    outliers: &'a [Vec<bool>],
    poses: &'a mut Vec<Pose>,
    facets: &'a mut [Vec<FacetIndex>],
    projected: Vec<ProjectedMap>,
    pairs: Vec<PairRows>,
    scale: Scale,
}

impl Descent<'_, '_> {
    /// Moves the maps until the residuals no longer change. `noise_mm` has the noise of each map, and receives it.
    fn run(&mut self, noise_mm: &mut Vec<f64>, is_first: bool) -> Result<NormalEquations, StitchingError> {
        // In the first round the maps are not yet near their places.
        let first_step = if is_first { 0 } else { ROBUST_STEPS[0] };
        self.leave_out_outliers(noise_mm, first_step);
        for _ in 0..MAX_STEPS {
            let equations = self.equations();
            let steps = equations.solve(BALL_RADIUS * self.scale.size_mm);
            let change_mm = change_mm(&self.pairs, &steps);
            self.move_by(&steps);
            let found = noise_of_maps_mm(&self.pairs, self.projected.len());
            let is_known = found.iter().zip(&*noise_mm).all(|(a, b)| (a / b - 1.0).abs() < 0.02);
            *noise_mm = found;
            weigh(&mut self.pairs, noise_mm);
            if is_known && change_mm <= CONVERGED_SIGMAS * mean(noise_mm) {
                return Ok(self.equations());
            }
        }
        Err(StitchingError::NotConverged { rounds: MAX_STEPS })
    }

    fn equations(&self) -> NormalEquations {
        let poses = self.poses.iter().zip(&self.joint.start);
        let moved: Vec<Vector6<f64>> =
            poses.map(|(pose, start)| self.scale.motion(&(*pose * start.inverse()))).collect();
        let sigmas = SideSigmas {
            form_mm: form_rms_mm(&self.projected).max(MIN_NOISE_MM),
            placement_mm: self.joint.placement_sigma_mm,
        };
        NormalEquations::new(&self.pairs, &self.projected, &self.scale, sigmas, &moved)
    }

    fn move_by(&mut self, steps: &[Vector6<f64>]) {
        for (pose, step) in self.poses.iter_mut().zip(steps) {
            *pose = (self.scale.pose(step) * *pose).orthonormalised();
        }
        self.projected = self.joint.projected(self.poses, self.outliers, self.facets);
        self.pairs.iter_mut().for_each(|pair| pair.update(&self.projected));
    }

    /// Leaves out the rows that do not agree with the others, by robust weights in turn with steps.
    fn leave_out_outliers(&mut self, noise_mm: &[f64], first_step: usize) {
        let mut steps = vec![Vector6::zeros(); self.projected.len()];
        for step in first_step..ROBUST_STEPS[0] + ROBUST_STEPS[1] {
            self.weigh_by_residuals(noise_mm, &steps, |residual| robust_weight(residual, step));
            steps = self.equations().solve(BALL_RADIUS * self.scale.size_mm);
        }
        self.weigh_by_residuals(noise_mm, &steps, |residual| if residual <= OUTLIER_SIGMAS { 1.0 } else { 0.0 });
    }

    /// Gives each row its precision from the noise of its maps, times a weight by its residual after the steps. The
    /// residual is in robust standard deviations of the rows of the map that agrees less with the others.
    fn weigh_by_residuals(&mut self, noise_mm: &[f64], steps: &[Vector6<f64>], weight: impl Fn(f64) -> f64) {
        weigh_all(&mut self.pairs, noise_mm);
        let scaled = |pair: &PairRows, row: &OverlapRow| residual_mm(row, pair, steps).abs() * row.precision.sqrt();
        let mut of_map: Vec<Vec<f64>> = vec![Vec::new(); self.projected.len()];
        for pair in &self.pairs {
            let residuals: Vec<f64> = pair.rows.iter().map(|row| scaled(pair, row)).collect();
            of_map[pair.first].extend_from_slice(&residuals);
            of_map[pair.second].extend(residuals);
        }
        let sigmas: Vec<f64> = of_map.into_iter().map(|residuals| robust_sigma(residuals).max(1e-6)).collect();
        for pair in &mut self.pairs {
            let sigma = sigmas[pair.first].max(sigmas[pair.second]);
            let weights: Vec<f64> = pair.rows.iter().map(|row| weight(scaled(pair, row) / sigma)).collect();
            pair.rows.iter_mut().zip(weights).for_each(|(row, weight)| row.precision *= weight);
        }
    }
}

/// Returns the weight of a residual in robust standard deviations: of Huber in the first steps, then of Tukey.
fn robust_weight(residual: f64, step: usize) -> f64 {
    const HUBER: f64 = 1.345;
    const TUKEY: f64 = 4.685;
    if step < ROBUST_STEPS[0] {
        return (HUBER / residual.max(HUBER)).min(1.0);
    }
    // Not zero, so that each map keeps all its rows until the end.
    (1.0 - (residual / TUKEY).powi(2)).max(0.0).powi(2).max(1e-6)
}

/// Returns the standard deviation of normal noise with the median of these absolute values.
fn robust_sigma(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    1.4826 * *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Gives each used row its precision from the noise of its maps.
fn weigh(pairs: &mut [PairRows], noise_mm: &[f64]) {
    for pair in pairs {
        let [own, other] = [noise_mm[pair.first].powi(2), noise_mm[pair.second].powi(2)];
        for row in pair.rows.iter_mut().filter(|row| row.is_used()) {
            row.precision = 1.0 / (own + other * row.squared_weights);
        }
    }
}

/// Gives each row its precision, also a row that was left out.
fn weigh_all(pairs: &mut [PairRows], noise_mm: &[f64]) {
    pairs.iter_mut().flat_map(|pair| &mut pair.rows).for_each(|row| row.precision = 1.0);
    weigh(pairs, noise_mm);
}

/// Checks that each map lies on the part.
fn check_on_part(maps: &[ProjectedMap]) -> Result<(), StitchingError> {
    for (map, found) in maps.iter().enumerate() {
        let on_part = found.is_usable.iter().filter(|usable| **usable).count();
        if (on_part as f64) < MIN_ON_PART * found.len() as f64 {
            return Err(StitchingError::OffPart { map, on_part, points: found.len() });
        }
    }
    Ok(())
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
    let usable =
        maps.iter().flat_map(|map| map.deviations_mm.iter().zip(&map.is_usable)).filter(|(_, usable)| **usable);
    let (sum, count) = usable.fold((0.0, 0.0), |(sum, n), (d, _)| (sum + d * d, n + 1.0));
    (sum / f64::max(count, 1.0)).sqrt()
}

/// Returns the residual of a row after the steps.
fn residual_mm(row: &OverlapRow, pair: &PairRows, steps: &[Vector6<f64>]) -> f64 {
    row.residual_mm + row.jacobian.dot(&(steps[pair.first] - steps[pair.second]))
}

fn used(pair: &PairRows) -> impl Iterator<Item = &OverlapRow> {
    pair.rows.iter().filter(|row| row.is_used())
}

/// Returns the standard deviation of the noise of one point of each map: the variances that explain the squares of the
/// residuals of all ordered pairs, which are s_k^2 + s_l^2 sum w^2. The median of each pair tells its square, because the
/// mean would hide rows that do not agree.
fn noise_of_maps_mm(pairs: &[PairRows], map_count: usize) -> Vec<f64> {
    let mut matrix = DMatrix::<f64>::zeros(map_count, map_count);
    let mut right = DVector::<f64>::zeros(map_count);
    let (mut squares, mut count) = (0.0, 0.0);
    for pair in pairs {
        let n = used(pair).count() as f64;
        if n == 0.0 {
            continue;
        }
        let square = robust_sigma(used(pair).map(|row| row.residual_mm.abs()).collect()).powi(2);
        let share = used(pair).map(|row| row.squared_weights).sum::<f64>() / n;
        squares += n * square / (1.0 + share);
        count += n;
        // The error of a mean square is a share of itself.
        let weight = n / square.max(MIN_NOISE_MM * MIN_NOISE_MM).powi(2);
        let terms = [(pair.first, 1.0), (pair.second, share)];
        for (k, a) in terms {
            right[k] += weight * a * square;
            for (l, b) in terms {
                matrix[(k, l)] += weight * a * b;
            }
        }
    }
    let freedom = f64::max(count - 6.0 * (map_count as f64 - 1.0), 1.0);
    let mean = squares / count.max(1.0);
    let found = matrix.cholesky().map(|factor| factor.solve(&right));
    // A map whose overlaps say nothing of its own has the mean.
    let variance = |k: usize| found.as_ref().map_or(mean, |found| found[k].max(1e-2 * mean));
    (0..map_count).map(|k| (variance(k) * count / freedom).sqrt().max(MIN_NOISE_MM)).collect()
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

/// Returns the largest shift of a point of a map by new poses, relative to the other maps.
fn lateral_shift_mm(before: &[Pose], after: &[Pose], maps: &[&[Point]]) -> f64 {
    let shifts = before.iter().zip(after).zip(maps).map(|((before, after), points)| {
        let ends = points.iter().step_by(points.len().div_ceil(50));
        ends.map(|p| (after.transform_point(p) - before.transform_point(p)).norm()).fold(0.0, f64::max)
    });
    shifts.fold(0.0, f64::max)
}

/// Returns the root mean square of the slope of the form in the overlaps.
fn slope(pairs: &[PairRows], noise_mm: &[f64]) -> f64 {
    let squares: Vec<f64> = pairs.iter().map(|pair| squared_slope(pair, noise_mm[pair.second])).collect();
    (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
}

/// Returns the mean square of the slope of the form over the overlap of a pair, without that of the noise.
pub(super) fn squared_slope(pair: &PairRows, noise_mm: f64) -> f64 {
    let square = |row: &OverlapRow| row.squared_slope - row.squared_slope_weights * noise_mm * noise_mm;
    let (sum, count) = used(pair).fold((0.0, 0.0), |(sum, n), row| (sum + square(row), n + 1.0));
    (sum / f64::max(count, 1.0)).max(0.0)
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}
