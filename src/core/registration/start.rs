//! Search for the initial pose when the pose of the part is unknown.
//!
//! The curvature distinguishes the places of a free-form surface. The search fits some measured points locally. It lays
//! each of them on the places of the offset surface with similar curvature, in the two ways in which the principal
//! directions can match. Further candidates lay the principal axes of the whole clouds on each other in all ways, and
//! one is the identity. The search scores each candidate on a few points and refines the best on some hundred. The best
//! of those wins; others that fit as well are reported.

use rayon::prelude::*;
use regrind_figures::statistics::root_mean;

use crate::geometry::{Point, Pose, Vector};
use crate::surface::{CurvatureFeature, FacetIndex, OffsetSurface, Side, fit_features, principal_axes};

use super::correspond::{Correspondence, EDGE_TOLERANCE_STEPS, beyond_steps, centroid_and_size};
use super::error::RegistrationError;
use super::iterate::Problem;
use super::options::{RegistrationOptions, Start};
use super::part::Part;
use super::robust_loss::{Loss, ScaledLoss, robust_median_and_sigma};

/// Initial pose of a registration.
#[derive(Clone, Debug)]
pub(crate) struct InitialPose {
    pub(crate) cmm_from_model: Pose,
    pub(crate) side: Side,
    /// True if the side was given, or determined by the data. Otherwise it was assumed.
    pub(crate) side_known: bool,
    /// True if the pose is already refined, so that outliers can be detected at once.
    pub(crate) is_refined: bool,
    /// Other poses, clearly different, that fit about as well.
    pub(crate) alternatives: Vec<Candidate>,
}

/// Pose, with figures of how well a sample of the points fits under it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Candidate {
    pub(crate) cmm_from_model: Pose,
    /// Root mean square of the smallest nine tenths of the distances, in millimetres.
    pub(crate) rms_mm: f64,
    /// Root mean square of the smallest nine tenths of the distances of the points on the part, in millimetres.
    on_part_rms_mm: f64,
    /// Share of the points whose projections lie beyond the edge.
    off_part_share: f64,
    side: Side,
}

impl Candidate {
    /// Orders candidates from the best fit to the worst, by the rms times (1 + 4 times the share of points off the
    /// part).
    fn by_fit(&self, other: &Self) -> std::cmp::Ordering {
        let badness = |c: &Self| c.rms_mm * (1.0 + 4.0 * c.off_part_share);
        badness(self).total_cmp(&badness(other))
    }
}

/// Numbers of points for the first score of a candidate, for its second score, for its refinement, and for the
/// comparison.
const FIRST_SCORE_POINTS: usize = 10;
const SCORE_POINTS: usize = 40;
const REFINE_POINTS: usize = 160;
const COMPARE_POINTS: usize = 640;
/// Maximum number of candidates that remain after the first score.
const MAX_SCORED: usize = 300;
/// Number of features of the measured points to match, and number of features of the surface that are tried for each.
const MEASURED_FEATURES: usize = 24;
const MATCHES_PER_FEATURE: usize = 36;
/// Maximum number of candidates that are refined.
const MAX_REFINED: usize = 24;
/// Maximum number of candidates that are compared on both sides.
const MAX_COMPARED: usize = 6;

/// Minimum ratio of the rms on one side to that on the other at which the other side fits better. Form error alone
/// gives a smaller ratio.
const MIN_SIDE_RATIO: f64 = 2.0;

/// Maximum difference of the shares of points off the part at which the side with more of them can still fit better.
const MAX_OFF_PART_EXCESS: f64 = 0.05;

/// Returns the initial pose and the side of the surface on which the probe is. If `options` contain a start pose, this
/// pose is kept and only the side is determined. Otherwise a search tries many poses.
///
/// # Errors
/// Returns [`RegistrationError::WrongSide`] if the side in `options` fits much worse than the other side. Returns
/// [`RegistrationError::Undetermined`] if the search finds no pose.
pub(crate) fn initial_pose(
    part: &Part,
    measured: &[Point],
    options: &RegistrationOptions,
) -> Result<InitialPose, RegistrationError> {
    let search = Search::new(part, measured, options);
    match options.start {
        Start::Pose(pose) => search.determine_side(pose),
        Start::Search => search.search(),
    }
}

/// Returns the rms distance in mm of the best fit of the mirror image of the points, on the given side of the surface.
/// The search treats all six coordinates of the pose as free, even if `options` lock some. The fit uses a sample of the
/// points. The rms is taken from the smallest nine tenths of the distances. Returns `None` if no pose is found.
pub(crate) fn mirrored_rms(part: &Part, measured: &[Point], options: &RegistrationOptions, side: Side) -> Option<f64> {
    searched_rms(part, &mirrored(measured), options, side)
}

/// Returns the rms distance in mm of the best fit of the measured points, not mirrored, on the given side of the
/// surface. The search treats all six coordinates of the pose as free, even if `options` lock some. The fit uses a
/// sample of the points. The rms is taken from the smallest nine tenths of the distances. Returns `None` if no pose is
/// found.
pub(crate) fn free_rms(part: &Part, measured: &[Point], options: &RegistrationOptions, side: Side) -> Option<f64> {
    let some: Vec<Point> = sample_evenly(measured, 4 * COMPARE_POINTS).copied().collect();
    searched_rms(part, &some, options, side)
}

/// Tests whether the measured points are a mirror image of the part. Returns the rms of the points as measured, and the
/// rms of the mirrored points, both in mm. Returns `None` if the points are not mirrored, or if no pose is found.
///
/// The points are mirrored if the mirrored rms is within the rms limit, and less than 0.3 times the rms of the points
/// as measured. If `options` give no side, both sides of the surface are tried and the better one counts.
pub(crate) fn detect_mirror_image(
    part: &Part,
    measured: &[Point],
    options: &RegistrationOptions,
) -> Option<(f64, f64)> {
    let sides = options.side.side().map_or(vec![Side::Normal, Side::Opposite], |side| vec![side]);
    let best = |points: &[Point]| {
        sides.iter().filter_map(|side| searched_rms(part, points, options, *side)).min_by(f64::total_cmp)
    };
    let mirrored_rms_mm = best(&mirrored(measured)).filter(|rms| *rms <= part.rms_limit_mm(options))?;
    let some: Vec<Point> = sample_evenly(measured, 4 * COMPARE_POINTS).copied().collect();
    let rms_mm = best(&some)?;
    (mirrored_rms_mm < 0.3 * rms_mm).then_some((rms_mm, mirrored_rms_mm))
}

/// Returns a sample of the points, mirrored in the plane x = 0 of the CMM frame. Any other plane would do as well,
/// because the search tries all poses.
fn mirrored(measured: &[Point]) -> Vec<Point> {
    sample_evenly(measured, 4 * COMPARE_POINTS).map(|p| Point::new(-p.x, p.y, p.z)).collect()
}

/// Returns the rms distance in mm of the best fit of `points` on the given side of the surface. The search tries many
/// poses, and treats all six coordinates of the pose as free, even if `options` lock some. The fit uses a sample of the
/// points. The rms is taken from the smallest nine tenths of the distances. Returns `None` if no pose is found.
fn searched_rms(part: &Part, points: &[Point], options: &RegistrationOptions, side: Side) -> Option<f64> {
    let options = RegistrationOptions { side: side.into(), locked: [false; 6], ..*options };
    let search = Search::new(part, points, &options);
    search.refine_and_compare(&search.candidates(side), side).first().map(|c| c.rms_mm)
}

/// Returns at most `count` of the points, taken at nearly equal steps through the list. The position in each step
/// varies a little, so that the sample does not follow one column of a grid. The variation is fixed: each call with the
/// same input gives the same sample.
pub(super) fn sample_evenly(points: &[Point], count: usize) -> impl Iterator<Item = &Point> {
    let n = points.len();
    let take = count.min(n);
    let jitter = move |k: usize| (k.wrapping_mul(0x9E37_79B9) >> 7) % (n / take.max(1)).max(1);
    (0..take).map(move |k| &points[k * n / take + jitter(k)])
}

struct Search<'a> {
    part: &'a Part<'a>,
    options: &'a RegistrationOptions,
    measured: &'a [Point],
    few: Vec<Point>,
    some: Vec<Point>,
    many: Vec<Point>,
}

impl<'a> Search<'a> {
    /// Prepares a search for the pose. Draws three samples of the measured points: 40 to score poses, 160 to refine
    /// poses, and 640 to compare the best poses.
    fn new(part: &'a Part, measured: &'a [Point], options: &'a RegistrationOptions) -> Self {
        let sample = |count| sample_evenly(measured, count).copied().collect();
        Self {
            part,
            options,
            measured,
            few: sample(SCORE_POINTS),
            some: sample(REFINE_POINTS),
            many: sample(COMPARE_POINTS),
        }
    }

    /// Determines the side of the surface on which the probe is, for a given start pose. Returns the pose unchanged,
    /// with the side on which the points fit much better. If neither side fits much better, takes the side on which
    /// most points lie. A side that the options give is kept.
    ///
    /// # Errors
    /// Returns [`RegistrationError::WrongSide`] if the options give a side and the points fit the other side much
    /// better.
    fn determine_side(&self, pose: Pose) -> Result<InitialPose, RegistrationError> {
        // A given pose can refer to either side.
        let at = |side: Side| {
            let as_given = self.refine(pose, side, &self.some, 2, 8);
            if as_given.rms_mm <= self.part.rms_limit_mm(self.options) {
                return as_given;
            }
            let across = self.refine(self.move_across(pose, side), side, &self.some, 2, 8);
            if across.rms_mm < as_given.rms_mm { across } else { as_given }
        };
        let (normal, opposite) = rayon::join(|| at(Side::Normal), || at(Side::Opposite));
        let (side, _, side_known) = self.choose_side(normal, opposite)?;
        let side = if side_known { side } else { self.nearer_side(&pose) };
        Ok(InitialPose { cmm_from_model: pose, side, side_known, is_refined: false, alternatives: Vec::new() })
    }

    /// Returns the side of the nominal surface on which most points lie. `pose` maps the model frame to the CMM frame.
    /// A tie gives the side of the normals.
    fn nearer_side(&self, pose: &Pose) -> Side {
        let nominal = OffsetSurface::new(self.part.nominal, 0.0, Side::Normal).expect("0 is a radius");
        let inverse = pose.inverse();
        let above = self
            .many
            .iter()
            .filter(|p| nominal.project(&inverse.transform_point(p), FacetIndex::UNKNOWN).distance_mm >= 0.0);
        if above.count() * 2 >= self.many.len() { Side::Normal } else { Side::Opposite }
    }

    /// Tries many poses. Returns the best pose, its side of the surface, and other poses that fit about as well.
    ///
    /// First all start poses are refined on one side of the surface. Then only the best refined poses are compared on
    /// both sides. This is enough, because the two sides are only two probe radii apart. Right and wrong poses differ
    /// by much more.
    ///
    /// # Errors
    /// Returns [`RegistrationError::Undetermined`] if there is no pose on one of the sides. Returns
    /// [`RegistrationError::WrongSide`] if the side in the options fits much worse than the other side.
    fn search(&self) -> Result<InitialPose, RegistrationError> {
        let side = self.options.side.side().unwrap_or_default();
        let candidates = self.candidates(side);
        let there = self.refine_and_compare(&candidates, side);
        let through: Vec<Candidate> = candidates
            .iter()
            .map(|c| Candidate { cmm_from_model: self.move_across(c.cmm_from_model, side.other()), ..*c })
            .collect();
        let across = self.refine_and_compare(&through, side.other());
        let (normal, opposite) = if side == Side::Normal { (&there, &across) } else { (&across, &there) };
        let (Some(&at_normal), Some(&at_opposite)) = (normal.first(), opposite.first()) else {
            return Err(RegistrationError::Undetermined);
        };
        let (side, best, side_known) = self.choose_side(at_normal, at_opposite)?;
        let all = if side == Side::Normal { normal } else { opposite };
        let best = self.prefer_file_frame(best, all);
        let alternatives = self.alternatives(&best, all);
        Ok(InitialPose { cmm_from_model: best.cmm_from_model, side, side_known, is_refined: true, alternatives })
    }

    /// Selects the side of the surface on which the probe is. `normal` is the best fit on the side of the normals, and
    /// `opposite` the best fit on the other side. Returns the side, the fit on this side, and true if the side is
    /// certain.
    ///
    /// A side that the options give is kept and is certain. Without a given side, the side is certain if its rms is
    /// less than half of the rms on the other side, and if hardly more points are beyond the edge. Otherwise the side
    /// of the normals is returned as not certain. If the surface has no offset, both sides are the same and the side is
    /// certain.
    ///
    /// # Errors
    /// Returns [`RegistrationError::WrongSide`] if the rms on the given side is more than eight times the rms on the
    /// other side.
    fn choose_side(
        &self,
        normal: Candidate,
        opposite: Candidate,
    ) -> Result<(Side, Candidate, bool), RegistrationError> {
        // Without an offset the two sides are one surface.
        let told = |better: &Candidate, worse: &Candidate| {
            // The distance of the points beyond the edge says nothing about the side.
            let is_nearer = better.on_part_rms_mm * MIN_SIDE_RATIO < worse.on_part_rms_mm;
            self.part.offset_mm == 0.0
                || is_nearer && better.off_part_share <= worse.off_part_share + MAX_OFF_PART_EXCESS
        };
        match self.options.side.side() {
            None if self.part.offset_mm > 0.0 && told(&opposite, &normal) => Ok((Side::Opposite, opposite, true)),
            None => Ok((Side::Normal, normal, told(&normal, &opposite))),
            Some(side) => {
                let (given, other) = if side == Side::Normal { (normal, opposite) } else { (opposite, normal) };
                // Much better on the other side, by more than a form error explains.
                if other.rms_mm * 4.0 * MIN_SIDE_RATIO < given.rms_mm && self.part.offset_mm > 0.0 {
                    return Err(RegistrationError::WrongSide { rms_mm: given.rms_mm, other_rms_mm: other.rms_mm });
                }
                Ok((side, given, true))
            }
        }
    }

    /// Converts `pose`, which fits with the probe on the other side of the surface, to a start pose for `side`. Shifts
    /// the surface by two probe radii along its mean normal.
    fn move_across(&self, pose: Pose, side: Side) -> Pose {
        let mean = self.part.nominal.mean_normal();
        let shift = mean * (-2.0 * self.part.offset_mm * side.sign());
        pose * Pose { translation_mm: shift, ..Pose::identity() }
    }

    /// Returns at most 24 of the best poses on the given side of the surface, refined on a sample of 160 points, with
    /// the best first. The start poses are the identity, the poses that align principal axes, and the poses that match
    /// curvatures.
    fn candidates(&self, side: Side) -> Vec<Candidate> {
        let surface = self.part.surface(self.options, side);
        let mut starts = vec![Pose::identity()];
        starts.extend(self.by_principal_axes(side));
        starts.extend(self.by_curvature(side));
        let scored = |poses: Vec<Pose>, points: &[Point]| {
            let mut scored: Vec<(f64, Pose)> =
                poses.into_par_iter().with_min_len(16).map(|p| (self.score(&surface, &p, points), p)).collect();
            scored.sort_by(|a, b| a.0.total_cmp(&b.0));
            scored.into_iter().map(|(_, pose)| pose)
        };
        let glanced = self.few.iter().step_by(self.few.len().div_ceil(FIRST_SCORE_POINTS)).copied().collect::<Vec<_>>();
        let promising = scored(starts, &glanced).take(MAX_SCORED).collect();
        let mut kept: Vec<Pose> = Vec::new();
        for pose in scored(promising, &self.few) {
            if kept.len() < MAX_REFINED && kept.iter().all(|k| self.pose_distance(k, &pose) > 0.1) {
                kept.push(pose);
            }
        }
        let mut refined: Vec<Candidate> =
            kept.into_par_iter().map(|pose| self.refine(pose, side, &self.some, 2, 6)).collect();
        refined.sort_by(Candidate::by_fit);
        refined
    }

    /// Refines the first six of `candidates` on the given side of the surface, on a sample of 640 points. Returns the
    /// refined candidates with the best fit first. Omits a pose that is nearly equal to a better one.
    fn refine_and_compare(&self, candidates: &[Candidate], side: Side) -> Vec<Candidate> {
        let best = &candidates[..candidates.len().min(MAX_COMPARED)];
        let mut compared: Vec<Candidate> =
            best.par_iter().map(|c| self.refine(c.cmm_from_model, side, &self.many, 4, 10)).collect();
        compared.sort_by(Candidate::by_fit);
        let mut distinct: Vec<Candidate> = Vec::new();
        for c in compared {
            if distinct.iter().all(|d| self.pose_distance(&d.cmm_from_model, &c.cmm_from_model) > 0.01) {
                distinct.push(c);
            }
        }
        distinct
    }

    /// Returns the difference of two poses without unit: the rotation in radians, plus the shift of the centroid of the
    /// cloud divided by the rms size of the cloud.
    fn pose_distance(&self, a: &Pose, b: &Pose) -> f64 {
        let between = a.inverse() * *b;
        let centre = self.few.iter().map(|p| p.coords).sum::<Vector>() / self.few.len() as f64;
        let shift = (a.inverse().transform_point(&Point::from(centre))
            - b.inverse().transform_point(&Point::from(centre)))
        .norm();
        between.angle_rad() + shift / self.part.size_mm
    }

    /// Returns the upper limit, in mm, for the distance of one point in [`Self::score`]: a tenth of the rms size of the
    /// measured points. The score counts a larger distance as equal to this limit.
    fn truncation_mm(&self) -> f64 {
        0.1 * self.part.size_mm
    }

    /// Returns the score of the pose `cmm_from_model`, which maps the model frame to the CMM frame. The score is the
    /// root mean square, in mm, of the distances of `points` from the part; a smaller score is better.
    ///
    /// If the projection of a point lies beyond the edge of the surface, its distance from the edge is included in the
    /// distance of the point. Each distance is limited to [`Self::truncation_mm`], so that points far away do not
    /// dominate.
    fn score(&self, surface: &OffsetSurface, cmm_from_model: &Pose, points: &[Point]) -> f64 {
        let limit2 = self.truncation_mm().powi(2);
        root_mean(self.squared_distances_mm2(surface, cmm_from_model, points).map(|d2| d2.min(limit2)))
    }

    /// Returns the pose with its figures of fit to `points`: the rms of all distances, the rms of the points on the
    /// part (both in mm), and the share of points beyond the edge. Both rms values use only the smallest nine tenths of
    /// the distances. So outliers have no influence if they are in the largest tenth.
    fn assess_candidate(&self, surface: &OffsetSurface, cmm_from_model: Pose, points: &[Point]) -> Candidate {
        let inverse = cmm_from_model.inverse();
        let (mut all, mut on_part) = (Vec::with_capacity(points.len()), Vec::with_capacity(points.len()));
        for p in points.iter().map(|p| inverse.transform_point(p)) {
            let foot = surface.project(&p, FacetIndex::UNKNOWN);
            let square = (foot.distance_mm - self.part.subtract_mm).powi(2);
            all.push(square + foot.beyond_edge_mm.powi(2));
            if beyond_steps(surface, &p, &foot) <= EDGE_TOLERANCE_STEPS {
                on_part.push(square);
            }
        }
        let off_part = 1.0 - on_part.len() as f64 / points.len() as f64;
        let trimmed_rms_mm = |mut squares: Vec<f64>| {
            squares.sort_unstable_by(f64::total_cmp);
            let kept = &squares[..(squares.len() * 9).div_ceil(10)];
            root_mean(kept.iter().copied())
        };
        let (rms_mm, on_part_rms_mm) = (trimmed_rms_mm(all), trimmed_rms_mm(on_part));
        Candidate { cmm_from_model, rms_mm, on_part_rms_mm, off_part_share: off_part, side: surface.side() }
    }

    /// Returns the squared distance of each point from the part, in mm^2. `cmm_from_model` maps the model frame to the
    /// CMM frame. For a point beyond the edge of the surface, this is the squared distance along the normal plus the
    /// squared distance of the projection beyond the edge.
    fn squared_distances_mm2<'b>(
        &self,
        surface: &'b OffsetSurface,
        cmm_from_model: &Pose,
        points: &'b [Point],
    ) -> impl Iterator<Item = f64> + 'b {
        let model_from_cmm = cmm_from_model.inverse();
        let subtract_mm = self.part.subtract_mm;
        points.iter().map(move |p| {
            let foot = surface.project(&model_from_cmm.transform_point(p), FacetIndex::UNKNOWN);
            (foot.distance_mm - subtract_mm).powi(2) + foot.beyond_edge_mm.powi(2)
        })
    }

    /// Refines the pose `start` on `points`. Does at most `rounds` minimisations, each with at most `iterations` steps.
    /// The first minimisation uses the square loss. Each later one uses Tukey's loss, which ignores gross outliers,
    /// with a scale from the current distances, and without the points beyond the edge. Ends early if a minimisation
    /// fails. Returns the last pose with its figures of fit to `points`.
    fn refine(&self, start: Pose, side: Side, points: &[Point], rounds: usize, iterations: usize) -> Candidate {
        let (middle, size_mm) = centroid_and_size(points);
        let mut problem = Problem {
            centroid: middle,
            size_mm,
            tolerance: 1e-6,
            ball_radius: 0.4,
            max_iterations: iterations,
            ..self.part.problem(points, self.options, side)
        };
        let mut pose = start;
        let mut correspondences = vec![Correspondence::INITIAL; points.len()];
        let mut trace = Vec::new();
        for round in 0..rounds {
            if round > 0 {
                let (_, sigma) = robust_median_and_sigma(correspondences.iter().map(|t| t.distance_mm));
                problem.residual.loss = ScaledLoss::new(Loss::Tukey, sigma.max(1e-4));
                exclude_off_part(&mut correspondences);
            }
            match problem.descend(pose, None, &mut correspondences, &mut trace) {
                Ok(descent) => pose = descent.cmm_from_model,
                Err(_) => break,
            }
        }
        self.assess_candidate(&problem.surface, pose, points)
    }

    /// Returns the pose with the smallest rotation between model frame and CMM frame, among the poses that fit as well
    /// as `best`. The reason: if the surface does not determine a rotation, the coordinates in the measured file are
    /// the only information about it.
    ///
    /// The candidates are the poses in `all`, and up to two more that are refined here from start poses without
    /// rotation. A candidate fits as well as `best` if all three conditions hold:
    ///
    /// - It is on the same side of the surface.
    /// - Its rms is at most 1.1 times the rms of `best` plus 1e-5 mm.
    /// - Its share of points off the part is not larger.
    ///
    /// Returns `best` if the selected pose is nearly equal to `best`, or if no candidate fits as well.
    fn prefer_file_frame(&self, best: Candidate, all: &[Candidate]) -> Candidate {
        /// Largest ratio of two rms that differ by chance.
        const MAX_RMS_RATIO: f64 = 1.1;
        /// Smallest difference of rms that distinguishes two fits, in mm.
        const MIN_DIFFERENCE_MM: f64 = 1e-5;
        /// Maximum ratio of the rms of a candidate that is not yet converged to the best rms, at which it is still
        /// considered.
        const MAX_UNCONVERGED_RATIO: f64 = 3.0;
        /// Difference below which two poses are the same.
        const MAX_POSE_DISTANCE: f64 = 0.01;
        let nominal = self.part.nominal.sample(REFINE_POINTS);
        let middle_of = |points: &[Point]| points.iter().map(|p| p.coords).sum::<Vector>() / points.len().max(1) as f64;
        let offset = self.part.nominal.mean_normal() * (best.side.sign() * self.part.offset_mm);
        let centred = middle_of(&self.many) - middle_of(&nominal) - offset;
        // These starts mostly lead to nothing, or to the best pose. So a few points decide first.
        let refined = |translation_mm: Vector| {
            let start = Pose { translation_mm, ..Pose::identity() };
            let glanced = self.refine(start, best.side, &self.some, 2, 6);
            let may_be = glanced.rms_mm <= MAX_UNCONVERGED_RATIO * best.rms_mm + MIN_DIFFERENCE_MM
                && self.pose_distance(&glanced.cmm_from_model, &best.cmm_from_model) > MAX_POSE_DISTANCE;
            may_be.then(|| self.refine(glanced.cmm_from_model, best.side, &self.many, 4, 10))
        };
        let as_filed = rayon::join(|| refined(Vector::zeros()), || refined(centred));
        let as_filed = [as_filed.0, as_filed.1].into_iter().flatten().collect::<Vec<_>>();
        let fits_as_well = |c: &&Candidate| {
            c.side == best.side
                && c.rms_mm <= MAX_RMS_RATIO * best.rms_mm + MIN_DIFFERENCE_MM
                && c.off_part_share <= best.off_part_share
        };
        let turn = |c: &Candidate| c.cmm_from_model.angle_rad();
        let least = as_filed.iter().chain(all).filter(fits_as_well).min_by(|a, b| turn(a).total_cmp(&turn(b)));
        least
            .filter(|c| self.pose_distance(&c.cmm_from_model, &best.cmm_from_model) > MAX_POSE_DISTANCE)
            .copied()
            .unwrap_or(best)
    }

    /// Returns the other poses in `all` that fit nearly as well as `best` and clearly differ from `best`. A pose fits
    /// nearly as well if it is on the same side, has an rms below 1.5 times that of `best`, and has a share of points
    /// beyond the edge that is larger by at most 0.02.
    fn alternatives(&self, best: &Candidate, all: &[Candidate]) -> Vec<Candidate> {
        all.iter()
            .filter(|c| {
                c.rms_mm < 1.5 * best.rms_mm + 1e-6
                    && c.side == best.side
                    && c.off_part_share <= best.off_part_share + 0.02
            })
            .filter(|c| self.pose_distance(&c.cmm_from_model, &best.cmm_from_model) > 0.05)
            .copied()
            .collect()
    }

    /// Returns 48 start poses for the given side of the surface. Each aligns the principal axes of the nominal points
    /// with those of the measured points. The shortest axis is taken in both directions. For each direction there are
    /// 24 rotations about this axis, in steps of 15°.
    fn by_principal_axes(&self, side: Side) -> Vec<Pose> {
        const STEPS_PER_TURN: usize = 24;
        let frame = |points: &[Point]| {
            let (centre, eigen) = principal_axes(points);
            let (least, most) = (eigen.eigenvalues.imin(), eigen.eigenvalues.imax());
            let normal: Vector = eigen.eigenvectors.column(least).into();
            let first: Vector = eigen.eigenvectors.column(most).into();
            (centre, normal, first)
        };
        let nominal: Vec<Point> = self.part.nominal.sample(4096);
        let (m_centre, m_normal, m_first) = frame(&nominal);
        let m_centre = m_centre + self.part.nominal.mean_normal() * (side.sign() * self.part.offset_mm);
        let (w_centre, w_normal, w_first) = frame(&self.many);
        let model = Frame::new(m_centre, m_normal, m_first);
        let mut starts = Vec::with_capacity(2 * STEPS_PER_TURN);
        for face in [1.0, -1.0] {
            for turn in 0..STEPS_PER_TURN {
                let angle = std::f64::consts::TAU * turn as f64 / STEPS_PER_TURN as f64;
                let second = w_normal.cross(&w_first);
                let first = w_first * angle.cos() + second * angle.sin();
                starts.push(Frame::new(w_centre, w_normal * face, first).from(&model));
            }
        }
        starts
    }

    /// Returns start poses that match curvatures, for the given side of the surface. Each pose maps a place of the
    /// offset surface to a place of the measured points with similar principal curvatures. Returns an empty list if the
    /// surface has fewer than 36 places with known curvature.
    fn by_curvature(&self, side: Side) -> Vec<Pose> {
        let on_nominal = self.part.nominal.features();
        if on_nominal.len() < MATCHES_PER_FEATURE {
            return Vec::new();
        }
        let offset: Vec<CurvatureFeature> =
            on_nominal.iter().filter_map(|f| f.offset(self.part.offset_mm, side)).collect();
        let sample: Vec<Point> = sample_evenly(self.measured, 2000).copied().collect();
        let measured = most_anisotropic(fit_features(&sample, None));
        measured.iter().flat_map(|m| [*m, m.flipped()]).flat_map(|m| poses_by_feature(&m, &offset)).collect()
    }
}

/// Excludes from the fit the points whose projections are beyond the edge of the surface, and includes all other
/// points. Includes all points if at least half of them are beyond the edge: the pose is then too far off to decide.
fn exclude_off_part(correspondences: &mut [Correspondence]) {
    let off = correspondences.iter().filter(|t| t.is_off_part()).count();
    let may_be = 2 * off < correspondences.len();
    correspondences.iter_mut().for_each(|t| t.in_fit = !(may_be && t.is_off_part()));
}

/// Selects at most 24 of `features` (places with principal curvatures). Sorts them by the difference between their two
/// principal curvatures, keeps the half with the largest differences (at least 24, if there are so many), and takes
/// every k-th of these. Where the difference is large, the principal directions are certain.
fn most_anisotropic(mut features: Vec<CurvatureFeature>) -> Vec<CurvatureFeature> {
    features.sort_by(|a, b| b.anisotropy().total_cmp(&a.anisotropy()));
    features.truncate((features.len() / 2).max(MEASURED_FEATURES));
    let stride = features.len().div_ceil(MEASURED_FEATURES).max(1);
    features.into_iter().step_by(stride).collect()
}

/// Returns start poses from one place of the measured points, `measured`. Selects the 36 places in `offset`, the offset
/// surface, whose principal curvatures are most similar. Each pose maps one of these places to `measured`. Each pair of
/// places gives two poses, because a principal direction has no sign.
fn poses_by_feature(measured: &CurvatureFeature, offset: &[CurvatureFeature]) -> Vec<Pose> {
    let unlike = |f: &CurvatureFeature| {
        (f.curvatures[0] - measured.curvatures[0]).powi(2) + (f.curvatures[1] - measured.curvatures[1]).powi(2)
    };
    let mut places: Vec<(f64, &CurvatureFeature)> = offset.iter().map(|f| (unlike(f), f)).collect();
    let count = MATCHES_PER_FEATURE.min(places.len());
    if count < places.len() {
        places.select_nth_unstable_by(count, |a, b| a.0.total_cmp(&b.0));
    }
    places[..count]
        .iter()
        .flat_map(|(_, f)| {
            let model = Frame::new(f.point, f.normal, f.direction);
            [1.0, -1.0].map(|way| Frame::new(measured.point, measured.normal, measured.direction * way).from(&model))
        })
        .collect()
}

/// Frame: origin and right-handed axes.
struct Frame {
    origin: Point,
    axes: nalgebra::Matrix3<f64>,
}

impl Frame {
    /// Creates a right-handed frame whose x axis is `first` and whose z axis is `normal`; both are unit vectors
    /// perpendicular to each other.
    fn new(origin: Point, normal: Vector, first: Vector) -> Self {
        let second = normal.cross(&first);
        Self { origin, axes: nalgebra::Matrix3::from_columns(&[first, second, normal]) }
    }

    /// Returns the pose that maps the frame `other` to the frame `self`: the origin of `other` to the origin of `self`,
    /// and the axes of `other` to the axes of `self`.
    fn from(&self, other: &Frame) -> Pose {
        let rotation = self.axes * other.axes.transpose();
        Pose { rotation, translation_mm: self.origin.coords - rotation * other.origin.coords }.orthonormalised()
    }
}
