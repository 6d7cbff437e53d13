//! Alternating iteration of section 2.3 of the paper: project, take a ball-constrained step, project again.

use nalgebra::{Matrix6, Vector6};

use crate::geometry::{Point, Pose};
use crate::surface::OffsetSurface;

use super::correspond::{Correspondence, ResidualModel, correspond};
use super::error::RegistrationError;
use super::linearize::{Scaling, Sums};
use super::solve::Spectrum;

/// Record of one step of the iteration.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Iteration {
    /// Objective after the step, in mm^2: the sum of the squared distances, eq. (7), or of their robust loss.
    pub objective_mm2: f64,
    /// Length of the step in scaled coordinates: radians, and translations in units of the cloud's rms size.
    pub step: f64,
    /// Radius of the ball that limited the step, alpha in eq. (15).
    pub ball_radius: f64,
    /// True if the step was accepted. A step that raises the objective is undone.
    #[serde(rename = "taken")]
    pub accepted: bool,
    /// Number of points in the fit.
    pub points: usize,
}

/// Input and stopping rules of the iteration.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Problem<'a> {
    pub(crate) surface: OffsetSurface<'a>,
    pub(crate) residual: ResidualModel,
    pub(crate) measured: &'a [Point],
    /// Centroid of the measured points, and their rms distance from it.
    pub(crate) centroid: Point,
    pub(crate) size_mm: f64,
    /// Locked coordinates of the twist: x, y, z, rx, ry, rz of the model frame.
    pub(crate) locked: [bool; 6],
    /// Minimum singular value of a direction that the surface determines, as a share of the root of the sum of all
    /// squared singular values.
    pub(crate) min_singular_share: f64,
    /// Relative decrease 1 - f(l+1) / f(l) at which the iteration stops: epsilon in the paper.
    pub(crate) tolerance: f64,
    /// Initial radius of the ball.
    pub(crate) ball_radius: f64,
    pub(crate) max_iterations: usize,
}

/// Result of a descent.
#[derive(Clone, Debug)]
pub(crate) struct Descent {
    pub(crate) cmm_from_model: Pose,
    pub(crate) objective_mm2: f64,
    pub(crate) scaling: Scaling,
    pub(crate) sums: Sums,
    pub(crate) rank: usize,
    pub(crate) converged: bool,
}

/// Length of a step, in scaled coordinates, that moves no point by more than rounding.
const MIN_STEP: f64 = 1e-14;

/// Minimum predicted decrease of the objective for which a step is tried, as a share of the tolerance. With a smaller
/// decrease a pass over all points would only confirm that nothing decreases.
const MIN_DECREASE_SHARE: f64 = 1e-2;

/// Step length below which an increase of the objective is noise, from rounding or from the edge of one triangle. The
/// direction of such a step is not wrong.
const NOISE_STEP: f64 = 1e-7;

/// Pose, with the linear problem at the projections of the points under this pose.
struct LinearizedPose {
    pose: Pose,
    scaling: Scaling,
    sums: Sums,
}

/// A step within the ball, in scaled coordinates.
struct BallStep {
    scaled: Vector6<f64>,
    length: f64,
    /// Upper bound of the decrease of the objective, from the linear problem.
    predicted_decrease_mm2: f64,
    /// Number of directions that the surface determines.
    rank: usize,
}

impl Problem<'_> {
    /// Minimises the objective from the pose `start` to the nearest minimum, by ball-constrained Gauss-Newton steps (a
    /// trust-region method). A step that raises the objective is undone, eq. (14) of the paper.
    ///
    /// `known` has the normal equations at `start`, or is `None` if they are not computed yet. One entry for each step
    /// is appended to `trace`. At the end, `correspondences` and the sums of the result belong to the returned pose. If
    /// the maximum number of steps is reached before the minimum, `converged` of the result is false.
    ///
    /// # Errors
    /// Returns [`RegistrationError::TooFewUsed`] if the number of points in the fit is smaller than the number of free
    /// coordinates of the pose.
    pub(crate) fn descend(
        &self,
        start: Pose,
        known: Option<Sums>,
        correspondences: &mut [Correspondence],
        trace: &mut Vec<Iteration>,
    ) -> Result<Descent, RegistrationError> {
        let mut at = match known {
            Some(sums) => LinearizedPose { pose: start, scaling: self.scaling_at(&start), sums },
            None => self.linearize_at(start, correspondences),
        };
        let (mut ball_radius, mut rank, mut converged) = (self.ball_radius, 0, false);
        // True if the correspondences belong to the current pose, false if they belong to a step that was undone.
        let mut current = true;
        for _ in 0..self.max_iterations {
            let step = self.step_within(ball_radius, &at)?;
            rank = step.rank;
            converged = self.is_at_minimum(&step, &at.sums, trace.is_empty());
            if converged {
                break;
            }
            let there = (at.pose * Pose::exp(&at.scaling.twist(&step.scaled))).orthonormalised(); // eq. (10), left side
            let candidate = self.linearize_at(there, correspondences);
            let Sums { objective_mm2, points, .. } = candidate.sums;
            current = objective_mm2 <= at.sums.objective_mm2;
            trace.push(Iteration { objective_mm2, step: step.length, ball_radius, accepted: current, points });
            if current {
                converged = 1.0 - objective_mm2 / at.sums.objective_mm2 <= self.tolerance;
                if step.length > 0.99 * ball_radius {
                    ball_radius *= 2.0;
                }
                at = candidate;
            } else {
                converged = step.length < NOISE_STEP;
                ball_radius = step.length.min(ball_radius) * 0.25;
            }
            if converged {
                break;
            }
        }
        if !current {
            at = self.linearize_at(at.pose, correspondences);
        }
        let LinearizedPose { pose, scaling, sums } = at;
        Ok(Descent { cmm_from_model: pose, objective_mm2: sums.objective_mm2, scaling, sums, rank, converged })
    }

    /// Projects all points onto the surface under `pose`, and updates `correspondences`, which has one entry for each
    /// point. Returns the pose together with the normal equations of the next step.
    fn linearize_at(&self, pose: Pose, correspondences: &mut [Correspondence]) -> LinearizedPose {
        let scaling = self.scaling_at(&pose);
        LinearizedPose { pose, scaling, sums: self.project_all(correspondences, &pose, &scaling) }
    }

    /// Returns the least-squares step from the pose `at`, eq. (15) of the paper. The length of the step is at most
    /// `ball_radius`. It is measured in scaled coordinates: translations in units of the size of the cloud, rotations
    /// in radians. The step does not move in directions that are locked or that the surface does not determine.
    ///
    /// # Errors
    /// Returns [`RegistrationError::TooFewUsed`] if the number of points in the fit is smaller than the number of free
    /// coordinates of the pose.
    fn step_within(&self, ball_radius: f64, at: &LinearizedPose) -> Result<BallStep, RegistrationError> {
        let sums = &at.sums;
        if sums.points < self.locked.iter().filter(|locked| !**locked).count() {
            return Err(RegistrationError::TooFewUsed { used: sums.points, points: self.measured.len() });
        }
        let free = free_projector(&self.locked, &at.scaling);
        let spectrum = Spectrum::new(&(free * sums.gram() * free));
        let rank = spectrum.rank(self.min_singular_share, sums.gram().trace());
        let right = free * sums.right();
        let m = spectrum.step(&right, rank, ball_radius);
        // m.(2 A^T b - A^T A m) <= 2 m.(A^T b).
        Ok(BallStep { scaled: m, length: m.norm(), predicted_decrease_mm2: 2.0 * m.dot(&right), rank })
    }

    /// Returns true if the current pose counts as the minimum, so that `step` is not tried. `sums` are the normal
    /// equations at this pose. There are three cases:
    ///
    /// - The step is zero except for rounding.
    /// - The objective is 0.
    /// - The predicted decrease of the objective is at most 1 % of `tolerance` (the relative decrease at which the
    ///   iteration stops) times the objective. This case does not apply to the first step of a registration
    ///   (`is_first`).
    fn is_at_minimum(&self, step: &BallStep, sums: &Sums, is_first: bool) -> bool {
        let little =
            !is_first && step.predicted_decrease_mm2 <= MIN_DECREASE_SHARE * self.tolerance * sums.objective_mm2;
        step.length < MIN_STEP || sums.objective_mm2 == 0.0 || little
    }

    /// Returns the scaling of a step from `pose`: the centroid of the measured points in the model frame, and their
    /// size (rms distance from the centroid, in mm).
    pub(crate) fn scaling_at(&self, pose: &Pose) -> Scaling {
        Scaling { centre: pose.inverse().transform_point(&self.centroid), size_mm: self.size_mm }
    }

    /// Projects all measured points onto the surface under `pose`, and stores the projections in `correspondences`, one
    /// per point. Returns the normal equations of the next step from this pose.
    ///
    /// `scaling` defines the coordinates of the step: translations in units of the rms size of the points, rotations
    /// about their centroid in radians.
    pub(crate) fn project_all(&self, correspondences: &mut [Correspondence], pose: &Pose, scaling: &Scaling) -> Sums {
        correspond(&self.surface, &self.residual, self.measured, correspondences, pose, scaling)
    }
}

/// Returns the 6x6 matrix of the orthogonal projection that removes from a step every motion of the `locked`
/// coordinates of the pose. The six flags in `locked` are in the order x, y, z, rx, ry, rz of the model frame; true
/// means locked.
///
/// The step is in scaled coordinates: three translations in units of the rms size of the points, then three rotations
/// about their centroid in radians. `scaling` contains the rms size and the centroid.
pub(crate) fn free_projector(locked: &[bool; 6], scaling: &Scaling) -> Matrix6<f64> {
    let to_twist = scaling.to_twist();
    let mut projector = Matrix6::identity();
    // Gram-Schmidt over the locked rows.
    for k in (0..6).filter(|&k| locked[k]) {
        let row = projector * to_twist.row(k).transpose();
        let norm2 = row.norm_squared();
        if norm2 > 0.0 {
            projector -= row * row.transpose() / norm2;
        }
    }
    projector
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn free_directions_skip_locked() {
        let scaling = Scaling { centre: Point::new(10.0, 20.0, -5.0), size_mm: 30.0 };
        let locked = [true, false, false, false, true, true];
        let free = free_projector(&locked, &scaling);
        assert!((free * free - free).amax() < 1e-12);
        for k in 0..6 {
            let twist = scaling.twist(&free.column(k).into());
            for (c, _) in locked.iter().enumerate().filter(|(_, l)| **l) {
                assert!(twist[c].abs() < 1e-12 * 30.0, "{twist}");
            }
        }
        assert!((free.trace() - 3.0).abs() < 1e-12);
    }
}
