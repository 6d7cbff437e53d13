//! Normal equations of the small motions of all maps, their solution, and its covariance.

use std::collections::HashMap;

use nalgebra::{DMatrix, DVector, Matrix6, SymmetricEigen, Vector6};

use super::overlap::PairRows;
use super::projected_map::ProjectedMap;
use super::scale::Scale;

/// Maximum number of points of a map that are summed over its area.
const MAX_SUMMED: usize = 5_000;

/// Smallest eigenvalue, as a share of the largest, of a direction that is solved for.
const MIN_SHARE: f64 = 1e-14;

/// Weights of what is not an overlap, in overlap rows.
#[derive(Clone, Copy, Debug)]
pub(super) struct SideWeights {
    /// Weight of the deviations of one map from the nominal surface, all together.
    pub(super) nominal: f64,
    /// Weight of the start pose of one map.
    pub(super) placement: f64,
}

/// Parts of the sum of a point, by the map that its rows compare with.
type Parts = Vec<(usize, Vector6<f64>)>;

/// Normal equations H m = b of the motions of all maps, six coordinates for each.
pub(super) struct NormalEquations {
    matrix: DMatrix<f64>,
    right: DVector<f64>,
    /// Part of the matrix that does not come from overlaps.
    side_matrix: DMatrix<f64>,
}

impl NormalEquations {
    /// Sums the equations. `moved` has the motion of each map since the start.
    pub(super) fn new(
        pairs: &[PairRows],
        maps: &[ProjectedMap],
        scale: &Scale,
        weights: SideWeights,
        moved: &[Vector6<f64>],
    ) -> Self {
        let size = 6 * maps.len();
        let mut side_matrix = DMatrix::zeros(size, size);
        let mut right = DVector::zeros(size);
        for (k, map) in maps.iter().enumerate() {
            let (mean, mean_right) = mean_over_map(map, scale);
            add(&mut side_matrix, k, k, &(mean * weights.nominal + Matrix6::identity() * weights.placement));
            let pull = mean_right * weights.nominal + moved[k] * weights.placement;
            add_rows(&mut right, k, &-pull);
        }
        let mut matrix = side_matrix.clone();
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
        Self { matrix, right, side_matrix }
    }

    /// Solves for the motions, with |m| <= `radius_mm` for all of them together: eq. (15) of the paper.
    pub(super) fn solve(&self, radius_mm: f64) -> Vec<Vector6<f64>> {
        let eigen = SymmetricEigen::new(self.matrix.clone());
        let along = eigen.eigenvectors.transpose() * &self.right;
        let limit = MIN_SHARE * eigen.eigenvalues.amax();
        let step = |mu: f64| {
            let scaled = along.zip_map(&eigen.eigenvalues, |a, e| if e > limit { a / (e + mu) } else { 0.0 });
            &eigen.eigenvectors * scaled
        };
        let mut found = step(0.0);
        // Halving the interval of the multiplier on a scale of powers is exact enough for a limit.
        let (mut low, mut high) = (limit, eigen.eigenvalues.amax() * 1e6);
        if found.norm() > radius_mm {
            for _ in 0..80 {
                let middle = (low * high).sqrt();
                found = step(middle);
                if found.norm() > radius_mm { low = middle } else { high = middle }
            }
            found = step(high);
        }
        (0..found.len() / 6).map(|k| found.fixed_rows::<6>(6 * k).into()).collect()
    }

    /// Returns the covariance of the motions for a noise of `noise_sigma_mm` of each point. `correlation_factor` is the
    /// factor of the overlaps' part for noise that is not independent.
    ///
    /// A point stands in several rows, so the rows are not independent: C = s^2 H^-1 (F sum_p S_p S_p^T + H_side) H^-1,
    /// with the sums S_p over the rows of the point p.
    pub(super) fn covariance(&self, pairs: &[PairRows], noise_sigma_mm: f64, correlation_factor: f64) -> DMatrix<f64> {
        let size = self.matrix.nrows();
        let mut spread = DMatrix::zeros(size, size);
        for (k, sums) in sums_by_point(pairs, size / 6).into_iter().enumerate() {
            // In the order of the points, so that rounding does not depend on the order of the table.
            let mut sums: Vec<(u32, Parts)> = sums.into_iter().collect();
            sums.sort_unstable_by_key(|(point, _)| *point);
            for (_, parts) in sums {
                let own: Vector6<f64> = parts.iter().map(|(_, part)| part).sum();
                let blocks: Vec<(usize, Vector6<f64>)> =
                    parts.into_iter().map(|(l, part)| (l, -part)).chain([(k, own)]).collect();
                for (i, a) in &blocks {
                    for (j, b) in &blocks {
                        add(&mut spread, *i, *j, &(a * b.transpose()));
                    }
                }
            }
        }
        let inverse = pseudo_inverse(&self.matrix, MIN_SHARE);
        let inner = spread * correlation_factor + &self.side_matrix;
        &inverse * inner * &inverse * noise_sigma_mm.powi(2)
    }
}

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
        for row in rows.iter().filter(|row| row.precision > 0.0) {
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

/// Returns the mean of J J^T, and of J times the deviation, over the points of a map on the part.
fn mean_over_map(map: &ProjectedMap, scale: &Scale) -> (Matrix6<f64>, Vector6<f64>) {
    let (mut square, mut sum, mut count) = (Matrix6::zeros(), Vector6::zeros(), 0.0);
    for i in (0..map.len()).step_by(map.len().div_ceil(MAX_SUMMED)).filter(|&i| map.on_part[i]) {
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
    let squares: Vec<Matrix6<f64>> = maps
        .iter()
        .map(|map| mean_over_map(map, scale).0 * map.on_part.iter().filter(|on| **on).count() as f64)
        .collect();
    let total: Matrix6<f64> = squares.iter().sum();
    let inverse = pseudo_inverse(&DMatrix::from_column_slice(6, 6, total.as_slice()), 1e-12);
    let size = 6 * maps.len();
    let mut relative = DMatrix::identity(size, size);
    for (l, square) in squares.iter().enumerate() {
        let share: Matrix6<f64> = Matrix6::from_column_slice(inverse.as_slice()) * square;
        for k in 0..maps.len() {
            add(&mut relative, k, l, &-share);
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

/// Returns the inverse of a symmetric matrix within the directions whose eigenvalue is above `min_share` of the largest.
fn pseudo_inverse(matrix: &DMatrix<f64>, min_share: f64) -> DMatrix<f64> {
    let eigen = SymmetricEigen::new(matrix.clone());
    let limit = min_share * eigen.eigenvalues.amax();
    let inverse = eigen.eigenvalues.map(|e| if e > limit { 1.0 / e } else { 0.0 });
    &eigen.eigenvectors * DMatrix::from_diagonal(&inverse) * eigen.eigenvectors.transpose()
}
