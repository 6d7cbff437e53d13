//! Normal equations of the small motions of all maps, their solution, and its covariance.

use std::collections::HashMap;

use nalgebra::{DMatrix, DVector, Matrix6, SymmetricEigen, Vector6};

use super::overlap::PairRows;
use super::projected_map::ProjectedMap;
use super::scale::Scale;

/// Maximum number of points of a map that are summed over its area.
const MAX_SUMMED: usize = 5_000;

/// Smallest eigenvalue, as a share of the largest, of a direction that the overlaps determine. Below it is rounding.
const MIN_SHARE: f64 = 1e-13;

/// Smallest information of a direction that the overlaps determine, as a multiple of that of the start poses. A direction
/// with less stays at its start: noise and the slope of the form would move it, and the start pose is as good.
const MIN_INFORMATION: f64 = 100.0;

/// Standard deviations of what is not an overlap.
#[derive(Clone, Copy, Debug)]
pub(super) struct SideSigmas {
    /// Standard deviation of the form, in millimetres. The deviations of a map count as one sample of it.
    pub(super) form_mm: f64,
    /// Standard uncertainty of the start pose of a map, in millimetres.
    pub(super) placement_mm: f64,
}

/// Properties of the noise of a map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct MapNoise {
    /// Standard deviation of one point, in millimetres.
    pub(super) sigma_mm: f64,
    /// Factor of the variance of means over areas, because the noise of neighbouring points is correlated.
    pub(super) correlation_factor: f64,
}

/// Normal equations H m = b of the motions of all maps, six coordinates for each, in 1/mm^2.
pub(super) struct NormalEquations {
    /// The part of H from overlaps and the nominal surface.
    matrix: DMatrix<f64>,
    /// The part of b from overlaps and the nominal surface.
    right: DVector<f64>,
    /// The part of b from the start poses.
    pull: DVector<f64>,
    /// The part of `matrix` from the nominal surface.
    nominal: DMatrix<f64>,
    /// The part of H from the start poses is this number times the identity.
    placement: f64,
}

impl NormalEquations {
    /// Sums the equations. `moved` has the motion of each map since the start.
    pub(super) fn new(
        pairs: &[PairRows],
        maps: &[ProjectedMap],
        scale: &Scale,
        sigmas: SideSigmas,
        moved: &[Vector6<f64>],
    ) -> Self {
        let size = 6 * maps.len();
        let mut nominal = DMatrix::zeros(size, size);
        let (mut right, mut pull) = (DVector::zeros(size), DVector::zeros(size));
        let (form, placement) = (sigmas.form_mm.powi(-2), sigmas.placement_mm.powi(-2));
        for (k, map) in maps.iter().enumerate() {
            let (mean, mean_right) = mean_over_map(map, scale);
            add(&mut nominal, k, k, &(mean * form));
            add_rows(&mut right, k, &-(mean_right * form));
            add_rows(&mut pull, k, &-(moved[k] * placement));
        }
        let mut matrix = nominal.clone();
        for PairRows { first, second, rows } in pairs {
            let (mut square, mut sum) = (Matrix6::zeros(), Vector6::zeros());
            for row in rows {
                square += row.jacobian * row.jacobian.transpose() * row.weight();
                sum += row.jacobian * (row.weight() * row.residual_mm);
            }
            add(&mut matrix, *first, *first, &square);
            add(&mut matrix, *second, *second, &square);
            add(&mut matrix, *first, *second, &-square);
            add(&mut matrix, *second, *first, &-square);
            add_rows(&mut right, *first, &-sum);
            add_rows(&mut right, *second, &sum);
        }
        Self { matrix, right, pull, nominal, placement }
    }

    /// Solves for the motions, with |m| <= `radius_mm` for all of them together: eq. (15) of the paper.
    pub(super) fn solve(&self, radius_mm: f64) -> Vec<Vector6<f64>> {
        let Spectrum { values, directions, is_determined } = self.spectrum();
        let [right, pull] = [&self.right, &self.pull].map(|part| directions.transpose() * part);
        let along = right.component_mul(&is_determined) + pull;
        let step = |mu: f64| &directions * along.zip_map(&values, |a, e| a / (e + mu));
        let mut found = step(0.0);
        if found.norm() > radius_mm {
            // Halving the interval of the multiplier on a scale of powers is exact enough for a limit.
            let (mut low, mut high) = (values.min(), values.amax() * 1e6);
            for _ in 0..80 {
                let middle = (low * high).sqrt();
                if step(middle).norm() > radius_mm { low = middle } else { high = middle }
            }
            found = step(high);
        }
        (0..found.len() / 6).map(|k| found.fixed_rows::<6>(6 * k).into()).collect()
    }

    fn spectrum(&self) -> Spectrum {
        let eigen = SymmetricEigen::new(self.matrix.clone());
        let limit = (MIN_SHARE * eigen.eigenvalues.amax()).max(MIN_INFORMATION * self.placement);
        let is_determined = eigen.eigenvalues.map(|e| if e > limit { 1.0 } else { 0.0 });
        let values = eigen.eigenvalues.component_mul(&is_determined).add_scalar(self.placement);
        Spectrum { values, directions: eigen.eigenvectors, is_determined }
    }

    /// Returns the covariance of the motions. `noise` has the properties of each map.
    ///
    /// A point stands in several rows, so the rows are not independent: C = H^-1 (sum_p F s^2 S_p S_p^T + H_side) H^-1,
    /// with the sums S_p over the rows of the point p, and with s and F of its map.
    pub(super) fn covariance(&self, pairs: &[PairRows], noise: &[MapNoise]) -> DMatrix<f64> {
        let size = self.matrix.nrows();
        let mut spread = self.nominal.clone();
        for (k, sums) in sums_by_point(pairs, size / 6).into_iter().enumerate() {
            let variance = noise[k].sigma_mm.powi(2) * noise[k].correlation_factor;
            // In the order of the points, so that rounding does not depend on the order of the table.
            let mut sums: Vec<(u32, Parts)> = sums.into_iter().collect();
            sums.sort_unstable_by_key(|(point, _)| *point);
            for (_, parts) in sums {
                let own: Vector6<f64> = parts.iter().map(|(_, part)| part).sum();
                let blocks: Vec<(usize, Vector6<f64>)> =
                    parts.into_iter().map(|(l, part)| (l, -part)).chain([(k, own)]).collect();
                for (i, a) in &blocks {
                    for (j, b) in &blocks {
                        add(&mut spread, *i, *j, &(a * b.transpose() * variance));
                    }
                }
            }
        }
        let Spectrum { values, directions, is_determined } = self.spectrum();
        let mut spread = directions.transpose() * spread * &directions;
        for i in 0..size {
            for j in 0..size {
                spread[(i, j)] *= is_determined[i] * is_determined[j] / (values[i] * values[j]);
            }
            spread[(i, i)] += self.placement / (values[i] * values[i]);
        }
        &directions * spread * directions.transpose()
    }
}

/// Directions of the motions of all maps together.
struct Spectrum {
    /// Information of each direction: eigenvalues of H.
    values: DVector<f64>,
    /// The directions, one in each column.
    directions: DMatrix<f64>,
    /// 1 for a direction that the overlaps or the nominal surface determine, 0 for one that stays at its start.
    is_determined: DVector<f64>,
}

/// Parts of the sum of a point, by the map that its rows compare with.
type Parts = Vec<(usize, Vector6<f64>)>;

/// Returns, for each map, the sums of the rows by the point whose noise is in them. Each sum is divided by the map that
/// the rows compare with; it acts on the motion of the map of the point, and oppositely on that of the other map.
fn sums_by_point(pairs: &[PairRows], map_count: usize) -> Vec<HashMap<u32, Parts>> {
    let mut sums: Vec<HashMap<u32, Parts>> = vec![HashMap::new(); map_count];
    let mut push = |map: usize, point: u32, other: usize, part: Vector6<f64>| {
        let parts = sums[map].entry(point).or_default();
        match parts.iter_mut().find(|(l, _)| *l == other) {
            Some((_, sum)) => *sum += part,
            None => parts.push((other, part)),
        }
    };
    for PairRows { first, second, rows } in pairs {
        for row in rows.iter().filter(|row| row.is_used()) {
            let part = row.jacobian * row.weight();
            push(*first, row.point, *second, part);
            // The noise of a neighbour is in the row with a negative weight, as its map is.
            for (&neighbour, w) in row.neighbours.iter().zip(row.weights) {
                push(*second, neighbour, *first, part * w);
            }
        }
    }
    sums
}

/// Returns the mean of J J^T, and of J times the deviation, over the usable points of a map.
fn mean_over_map(map: &ProjectedMap, scale: &Scale) -> (Matrix6<f64>, Vector6<f64>) {
    let (mut square, mut sum, mut count) = (Matrix6::zeros(), Vector6::zeros(), 0.0);
    for i in (0..map.len()).filter(|&i| map.is_usable[i] && map.is_sampled(i, MAX_SUMMED)) {
        let jacobian = scale.jacobian(&map.points[i], &map.normals[i]);
        square += jacobian * jacobian.transpose();
        sum += jacobian * map.deviations_mm[i];
        count += 1.0;
    }
    let count = f64::max(count, 1.0);
    (square / count, sum / count)
}

/// Returns the covariance of the motions without the motion of the whole: that of least squares over all points.
pub(super) fn relative_to_whole(covariance: &DMatrix<f64>, maps: &[ProjectedMap], scale: &Scale) -> DMatrix<f64> {
    let usable = |map: &ProjectedMap| map.is_usable.iter().filter(|usable| **usable).count() as f64;
    let squares: Vec<Matrix6<f64>> = maps.iter().map(|map| mean_over_map(map, scale).0 * usable(map)).collect();
    let total: Matrix6<f64> = squares.iter().sum();
    let eigen = SymmetricEigen::new(total);
    let limit = 1e-12 * eigen.eigenvalues.amax();
    let inverse = eigen.eigenvalues.map(|e| if e > limit { 1.0 / e } else { 0.0 });
    let inverse = eigen.eigenvectors * Matrix6::from_diagonal(&inverse) * eigen.eigenvectors.transpose();
    let size = 6 * maps.len();
    let mut relative = DMatrix::identity(size, size);
    for (l, square) in squares.iter().enumerate() {
        for k in 0..maps.len() {
            add(&mut relative, k, l, &-(inverse * square));
        }
    }
    &relative * covariance * relative.transpose()
}

/// Returns the covariance of twists about the origin from that of motions.
pub(super) fn about_origin(covariance: &DMatrix<f64>, scale: &Scale) -> DMatrix<f64> {
    let size = covariance.nrows();
    let mut matrix = DMatrix::zeros(size, size);
    for k in 0..size / 6 {
        add(&mut matrix, k, k, &scale.twist_from_motion());
    }
    &matrix * covariance * matrix.transpose()
}

fn add(matrix: &mut DMatrix<f64>, row: usize, column: usize, block: &Matrix6<f64>) {
    let mut view = matrix.fixed_view_mut::<6, 6>(6 * row, 6 * column);
    view += block;
}

fn add_rows(vector: &mut DVector<f64>, row: usize, block: &Vector6<f64>) {
    let mut view = vector.fixed_rows_mut::<6>(6 * row);
    view += block;
}
