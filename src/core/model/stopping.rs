//! Stopping rule of a measurement, and choice of the targets to touch next.
//!
//! ```text
//!  registration --> Form at all targets --> decided? known well enough for a correction? innovations as expected?
//!                        |                                             |
//!                        +--> IncrementalPosterior --> next targets <--+ no
//! ```
//!
//! The targets are those of a measuring pattern: the probe can reach every one, and the whole pattern is all of them. A
//! batch goes to the places with the largest posterior variance, with more weight where the maximum or the minimum of
//! the form can lie. One touch in ten goes to a random target, so that the measurement also finds what the model does
//! not expect. Further touches go to the neighbours of outliers.

use super::form::FreeMotions;
use super::random_normals::NormalGenerator;
use super::{Form, IncrementalPosterior, ModelError, ModelInputs, Observations, Prediction};
use crate::geometry::{Point, Vector};
use crate::registration::{Deviation, PointStatus, Registration};

/// Limits of the figures and required accuracy of the form, by which [`decide`] ends a measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StoppingCriteria {
    /// Largest accepted peak to valley, in mm; infinite if it is not limited.
    pub pv_mm: f64,
    /// Largest accepted PV 99.8 % (without the outermost 0.1 % at either end), in mm; infinite if it is not limited.
    pub pv_998_mm: f64,
    /// Largest accepted root mean square, in mm; infinite if it is not limited.
    pub rms_mm: f64,
    /// Standard uncertainty of the smooth form (RMS over all targets) that is enough for a correction, in mm. A smaller
    /// one brings no gain, because the pass itself adds a larger error.
    pub correction_sigma_mm: f64,
    /// True if another pass is allowed and is expected to improve the part.
    pub may_grind: bool,
}

/// Measurement in progress.
#[derive(Clone, Copy, Debug)]
pub struct PartialMeasurement<'a> {
    /// All targets, touched or not: points of the nominal surface with their unit normals, in the model frame, in mm.
    pub targets: &'a [(Point, Vector)],
    /// Number of the batch in which each target was tried; `None` if it was not tried yet.
    pub tried: &'a [Option<u32>],
    /// Index of the target of each deviation of the registration.
    pub touched: &'a [usize],
}

/// Decision about a measurement: the form so far, and the targets to touch next.
#[derive(Clone, Debug)]
pub struct StoppingDecision {
    /// Form at all targets; without slopes, ISO figures and budget if more touches follow.
    pub form: Form,
    /// Targets to touch next, in the order of a short tour; empty if enough is known.
    pub next: Vec<usize>,
    /// Reason of the decision.
    pub reason: Reason,
}

/// Reason why the measurement continues or ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// Every figure is within its limit, with the probability that one decision among many requires
    /// ([`ModelInputs::decision_risk`]).
    WithinLimits,
    /// The part has to be corrected, and the form is known well enough for the correction.
    FormKnown,
    /// The part has to be corrected. Its form is not known well enough yet, but another pass is worth more than further
    /// touches.
    CorrectionPreferred,
    /// All targets were tried.
    AllTargetsTried,
    /// There are fewer touches than [`MIN_TOUCHES`]: too few for a decision.
    TooFewTouches,
    /// The innovations of the last batch are larger than expected.
    LargeInnovations,
    /// A touch is an outlier, and too few of its neighbouring targets were tried to confirm or reject it.
    UnconfirmedOutlier,
    /// The part has a narrow feature: only the whole pattern shows its size.
    NarrowFeature,
    /// The interval of a figure contains its limit.
    Undecided,
    /// The form is not known well enough for a correction.
    FormUnknown,
    /// A figure is certainly beyond its limit, and no further pass is available to correct it.
    BeyondLimit,
    /// [`MAX_BATCHES`] batches were touched: all remaining targets follow at once.
    MaxBatchesReached,
}

/// Number of touches of the first batch: enough to check that the right part is clamped, and to find its pose.
pub const FIRST_BATCH: usize = 10;
/// Minimum number of touches of a decision.
pub const MIN_TOUCHES: usize = 40;
/// Maximum number of batches of a measurement, without a last batch of all remaining targets. A field bus has only a
/// few bits for the number of a batch.
pub const MAX_BATCHES: u32 = 60;
/// Minimum and maximum number of touches of a batch.
const BATCH: [usize; 2] = [20, 100];
/// One touch in this many goes to a random target.
const RANDOM_INTERVAL: usize = 10;
/// Number of standard deviations from which an innovation counts as an outlier, and number of neighbours that are
/// examined around an outlier.
const OUTLIER_SIGMAS: f64 = 4.5;
const NEIGHBOURS: usize = 6;
/// Minimum number of tried neighbours of an outlier. With fewer, its other neighbours are touched next.
const MIN_TRIED_NEIGHBOURS: usize = 4;
/// Normal quantile of 99.9 %: by chance, the mean square of the innovations exceeds its bound in one batch of a
/// thousand.
const INNOVATION_QUANTILE: f64 = 3.09;
/// Minimum share of the pattern, and minimum number of touches, at which the measurement ends if the part is not
/// accepted and another pass can help.
const GIVE_UP_LIMITS: (f64, usize) = (1.0 / 6.0, 120);

/// Chooses at most `most` targets that lie far apart from each other (farthest-point sampling). Returns their indices:
/// the first is target 0, and each next one is the target farthest from all chosen before it.
pub fn farthest_points(targets: &[(Point, Vector)], most: usize) -> Vec<usize> {
    let mut chosen: Vec<usize> = Vec::new();
    let mut apart_mm = vec![f64::INFINITY; targets.len()];
    while chosen.len() < most.min(targets.len()) {
        let next = (0..targets.len()).max_by(|a, b| apart_mm[*a].total_cmp(&apart_mm[*b]).then(b.cmp(a)));
        let Some(next) = next else { break };
        chosen.push(next);
        for (apart, target) in apart_mm.iter_mut().zip(targets) {
            *apart = apart.min((target.0 - targets[next].0).norm());
        }
    }
    chosen
}

/// Decides whether the touches so far are enough. Returns the estimated form, the reason of the decision, and the
/// indices of the targets to touch next. There is no next target if the measurement ends.
///
/// - `registration` has the deviation of each touch.
/// - `so_far` has all targets, and the target that belongs to each touch.
/// - `purpose` has the limits of the figures (PV, PV 99.8 %, RMS) and the accuracy that a correction needs.
/// - `seed` selects the random targets among the next targets.
///
/// # Errors
/// Returns the errors of [`Form::estimate_at`]. Also returns an error if the covariance of the touches is not positive
/// definite.
pub fn decide(
    registration: &Registration,
    inputs: &ModelInputs,
    so_far: &PartialMeasurement,
    purpose: &StoppingCriteria,
    seed: u64,
) -> Result<StoppingDecision, ModelError> {
    let form = Form::estimate_with(registration, inputs, so_far.targets, false)?;
    let mut growing = ExpectedTouches::new(registration, inputs, &form, so_far)?;
    let count = so_far.touched.len();
    let left = so_far.tried.iter().filter(|tried| tried.is_none()).count();
    let around = growing.untried_neighbours(so_far);
    let reason = match () {
        () if left == 0 => Reason::AllTargetsTried,
        () if count < MIN_TOUCHES => Reason::TooFewTouches,
        () if growing.has_feature(so_far) => Reason::NarrowFeature,
        () if growing.has_large_innovations() => Reason::LargeInnovations,
        () if !around.is_empty() => Reason::UnconfirmedOutlier,
        () => reason_from_form(&form, purpose, (count, so_far.targets.len())),
    };
    let is_over = matches!(
        reason,
        Reason::WithinLimits
            | Reason::FormKnown
            | Reason::CorrectionPreferred
            | Reason::BeyondLimit
            | Reason::AllTargetsTried
    );
    let batches = so_far.tried.iter().flatten().max().map_or(0, |last| last + 1);
    let reason = if batches >= MAX_BATCHES && !is_over { Reason::MaxBatchesReached } else { reason };
    let next = match reason {
        _ if is_over => Vec::new(),
        Reason::NarrowFeature | Reason::MaxBatchesReached => {
            (0..so_far.tried.len()).filter(|&k| so_far.tried[k].is_none()).collect()
        }
        _ => {
            let wanted = if count < MIN_TOUCHES { MIN_TOUCHES - count } else { (count / 2).clamp(BATCH[0], BATCH[1]) };
            growing.choose_next(so_far, &around, wanted.max(around.len()).min(left), seed)?
        }
    };
    let is_all = matches!(reason, Reason::NarrowFeature | Reason::MaxBatchesReached);
    let next = if is_all { next } else { short_tour(so_far.targets, next) };
    // Slopes, ISO figures and budget are computed for the last decision only.
    let form = if next.is_empty() { Form::estimate_at(registration, inputs, so_far.targets)? } else { form };
    Ok(StoppingDecision { form, next, reason })
}

/// Returns the reason to end or to continue the measurement. The reason follows from the figures of the form (PV, PV
/// 99.8 %, RMS), from their limits in `purpose`, and from the uncertainty of the form. `count` is the number of touches
/// so far. `pattern` is the number of all targets, touched or not.
fn reason_from_form(form: &Form, purpose: &StoppingCriteria, (count, pattern): (usize, usize)) -> Reason {
    let bounds =
        [(form.bounds.pv, purpose.pv_mm), (form.bounds.pv_998, purpose.pv_998_mm), (form.bounds.rms, purpose.rms_mm)];
    if bounds.iter().all(|(of, limit)| of.high_mm <= *limit) {
        return Reason::WithinLimits;
    }
    let is_known = form.rms_smooth_sigma_mm <= purpose.correction_sigma_mm;
    let is_beyond = bounds.iter().any(|(of, limit)| of.low_mm > *limit);
    let (share, least) = GIVE_UP_LIMITS;
    let gives_up = count >= least.max((share * pattern as f64) as usize);
    // The final judgement is a single decision, so its limit is less strict than that of one decision among many. A
    // part that it can accept gets more touches, not another pass.
    let is_accepted = bounds.iter().all(|(of, limit)| of.acceptance_mm <= *limit);
    match () {
        () if is_beyond && !purpose.may_grind => Reason::BeyondLimit,
        () if is_known && (is_beyond || gives_up && purpose.may_grind && !is_accepted) => Reason::FormKnown,
        () if gives_up && purpose.may_grind && !is_accepted => Reason::CorrectionPreferred,
        () if is_beyond => Reason::FormUnknown,
        () => Reason::Undecided,
    }
}

/// Posterior of the touches so far, with the innovations of the last batch.
struct ExpectedTouches {
    posterior: IncrementalPosterior,
    /// Target and standardized innovation of each touch of the last batch.
    last_innovations: Vec<(usize, f64)>,
    outliers: Vec<usize>,
}

impl ExpectedTouches {
    /// Builds the posterior of all touches so far, with the hyperparameters of `form`. First all batches before the
    /// last batch are added. The touches of the last batch are compared with the prediction from these earlier batches
    /// (standardized innovations). Then the last batch is added too.
    ///
    /// `registration` has the deviation of each touch, `inputs` has the known uncertainties, and `so_far` assigns the
    /// touches to the targets.
    ///
    /// # Errors
    /// Returns an error if an uncertainty in `inputs` is invalid, if a number is not finite, or if the covariance of
    /// the touches is not positive definite.
    fn new(
        registration: &Registration,
        inputs: &ModelInputs,
        form: &Form,
        so_far: &PartialMeasurement,
    ) -> Result<Self, ModelError> {
        let PartialMeasurement { targets, tried, touched } = so_far;
        let all: Vec<_> = registration.deviations.iter().zip(touched.iter().copied()).collect();
        let used = || all.iter().filter(|(d, _)| d.status == PointStatus::Inlier && d.in_fit);
        let motions = FreeMotions::from_registration(registration, used().map(|(d, _)| d.point));
        let stated = motions.machine_effects(registration, inputs)?;
        let last = tried.iter().flatten().max().copied().unwrap_or(0);
        let of = |is_last: bool| -> (Observations, Vec<usize>) {
            let chosen: Vec<_> = used().filter(|(_, target)| (tried[*target] == Some(last)) == is_last).collect();
            let rows: Vec<_> = chosen.iter().map(|(d, _)| *d).collect();
            let columns = stated.columns(rows.iter().map(|d| (d.point, d.normal)));
            (
                Observations { random_effects: columns, ..motions.observed(&rows) },
                chosen.iter().map(|(_, target)| *target).collect(),
            )
        };
        let ((before, _), (found, of_targets)) = (of(false), of(true));
        let places: Vec<[f64; 2]> = targets.iter().map(|(point, _)| [point.x, point.y]).collect();
        let (rows, columns) = (motions.rows(targets.iter().copied()), stated.columns(targets.iter().copied()));
        let mut growing = IncrementalPosterior::at_places(&places, &rows, &columns, form.hyperparameters)?;
        growing.update(&before)?;
        // With no more points than fixed effects the motions are not determined, so the model predicts nothing.
        let is_held = before.places.len() > before.fixed_effects.ncols();
        let off = if is_held { growing.standardized_innovations(&found)? } else { vec![0.0; found.places.len()] };
        growing.update(&found)?;
        let is_far = |d: &Deviation| d.status != PointStatus::OffPart && !d.in_fit;
        let outliers = all.iter().filter(|(d, _)| is_far(d)).map(|(_, target)| *target).collect();
        Ok(Self { posterior: growing, last_innovations: of_targets.into_iter().zip(off).collect(), outliers })
    }

    /// Returns true if the innovations of the last batch (deviations minus predictions, standardized) are larger than
    /// chance explains. The test: their mean square exceeds the 99.9 % quantile of chi-squared divided by its degrees
    /// of freedom. Innovations of at least [`OUTLIER_SIGMAS`] standard deviations are not counted. Returns false if no
    /// innovation is left.
    fn has_large_innovations(&self) -> bool {
        let squares: Vec<f64> =
            self.last_innovations.iter().filter(|(_, z)| z.abs() < OUTLIER_SIGMAS).map(|(_, z)| z * z).collect();
        let n = squares.len() as f64;
        // Quantile of chi-squared divided by its degrees of freedom (Wilson and Hilferty 1931).
        let ninth = 2.0 / (9.0 * n);
        n > 0.0 && squares.iter().sum::<f64>() / n > (1.0 - ninth + INNOVATION_QUANTILE * ninth.sqrt()).powi(3)
    }

    /// Returns the indices of the targets whose touches are outliers. First come the touches of the last batch with an
    /// innovation of at least [`OUTLIER_SIGMAS`] standard deviations. Then come the outliers of the registration. A
    /// target can occur twice.
    fn all_outliers(&self) -> impl Iterator<Item = usize> + '_ {
        let off = self.last_innovations.iter().filter(|(_, z)| z.abs() >= OUTLIER_SIGMAS).map(|(target, _)| *target);
        off.chain(self.outliers.iter().copied())
    }

    /// Returns the indices of untried targets near outliers, in ascending order and without duplicates. A target is
    /// tried if a batch of touches has already included it. Near means among the [`NEIGHBOURS`] targets that are
    /// nearest to the outlier. `so_far` has all targets, and the batch in which each target was tried.
    ///
    /// An outlier is skipped if at least [`MIN_TRIED_NEIGHBOURS`] of these nearest targets were tried.
    fn untried_neighbours(&self, so_far: &PartialMeasurement) -> Vec<usize> {
        let mut around = Vec::new();
        for target in self.all_outliers() {
            let near = neighbours(so_far.targets, target);
            if near.iter().filter(|&&k| so_far.tried[k].is_some()).count() < MIN_TRIED_NEIGHBOURS.min(near.len()) {
                around.extend(near.into_iter().filter(|&k| so_far.tried[k].is_none()));
            }
        }
        around.sort_unstable();
        around.dedup();
        around
    }

    /// Returns true if two neighbouring targets are both outliers of the registration. Two such outliers indicate a
    /// narrow feature of the part. A particle of dust causes only one outlier. `so_far` has the positions of the
    /// targets.
    fn has_feature(&self, so_far: &PartialMeasurement) -> bool {
        let is_beside = |&a: &usize| neighbours(so_far.targets, a).iter().any(|k| self.outliers.contains(k));
        self.outliers.iter().any(is_beside)
    }

    /// Chooses the targets to touch next, and returns their indices. Only targets that were not tried yet are chosen.
    /// `wanted` is the number of targets to choose. More are chosen if `around` alone has more untried targets. Fewer
    /// are chosen if fewer untried targets exist.
    ///
    /// The targets are chosen in three steps:
    ///
    /// - All untried targets in `around`. These are the neighbours of outliers.
    /// - Random targets. `seed` selects them.
    /// - The targets with the largest posterior variance. The variance counts twice at targets where the maximum or the
    ///   minimum of the form can lie ([`Self::max_variance_target`]). Targets that are already chosen count as touched.
    ///
    /// # Errors
    /// Returns [`ModelError::NotDefinite`] if the covariance of the touches is not positive definite.
    fn choose_next(
        &mut self,
        so_far: &PartialMeasurement,
        around: &[usize],
        wanted: usize,
        seed: u64,
    ) -> Result<Vec<usize>, ModelError> {
        let mut open: Vec<bool> = so_far.tried.iter().map(Option::is_none).collect();
        let mut chosen: Vec<usize> = around.iter().copied().filter(|&k| open[k]).collect();
        chosen.iter().for_each(|&k| open[k] = false);
        let mut random = NormalGenerator::new(seed, so_far.touched.len() as u64);
        for _ in 0..wanted.div_ceil(RANDOM_INTERVAL).min(wanted.saturating_sub(chosen.len())) {
            // The phase of two independent normal numbers is uniformly distributed.
            let share = (random.next().atan2(random.next()) / std::f64::consts::TAU).rem_euclid(1.0);
            let free: Vec<usize> = (0..open.len()).filter(|&k| open[k]).collect();
            let Some(&anywhere) = free.get((share * free.len() as f64) as usize) else { break };
            open[anywhere] = false;
            chosen.push(anywhere);
        }
        for &place in &chosen {
            self.posterior.update_with_expected(place)?;
        }
        while chosen.len() < wanted {
            let Some(best) = self.max_variance_target(&open) else { break };
            self.posterior.update_with_expected(best)?;
            open[best] = false;
            chosen.push(best);
        }
        Ok(chosen)
    }

    /// Returns the index of the target with the largest product of posterior variance and weight. The weight is 2 if
    /// the maximum or the minimum of the form can lie at the target, within two standard deviations; otherwise 1.
    /// `open` has one value for each target: true if the target may be chosen. Returns `None` if no target may be
    /// chosen.
    fn max_variance_target(&self, open: &[bool]) -> Option<usize> {
        let known: Vec<Prediction> = self.posterior.predictions().collect();
        let surely =
            |sign: f64| known.iter().map(|p| sign * p.mean_mm - 2.0 * p.sigma_mm).fold(f64::NEG_INFINITY, f64::max);
        let [highest, lowest] = [surely(1.0), surely(-1.0)];
        let weight = |p: &Prediction| {
            let may_be = p.mean_mm + 2.0 * p.sigma_mm > highest || 2.0 * p.sigma_mm - p.mean_mm > lowest;
            if may_be { 2.0 } else { 1.0 }
        };
        let all = known.iter().enumerate().filter(|(k, _)| open[*k]);
        all.map(|(k, p)| (k, weight(p) * p.sigma_mm.powi(2)))
            .max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))
            .map(|(k, _)| k)
    }
}

/// Returns the indices of the [`NEIGHBOURS`] targets that are nearest to the target with the index `of`. This target
/// itself is not included. The order is arbitrary. If there are fewer other targets, all of them are returned.
fn neighbours(targets: &[(Point, Vector)], of: usize) -> Vec<usize> {
    let apart = |k: usize| (targets[k].0 - targets[of].0).norm_squared();
    let mut others: Vec<usize> = (0..targets.len()).filter(|&k| k != of).collect();
    let count = NEIGHBOURS.min(others.len());
    if count < others.len() {
        others.select_nth_unstable_by(count, |&a, &b| apart(a).total_cmp(&apart(b)).then(a.cmp(&b)));
    }
    others.truncate(count);
    others
}

/// Sorts the targets with the indices `chosen` into a short tour. The tour starts at the target with the smallest x and
/// always goes to the nearest remaining target; then crossings are removed (2-opt).
pub fn short_tour(targets: &[(Point, Vector)], chosen: Vec<usize>) -> Vec<usize> {
    let apart = |a: usize, b: usize| (targets[a].0 - targets[b].0).norm();
    let mut open = chosen;
    let Some(first) = (0..open.len()).min_by(|&a, &b| targets[open[a]].0.x.total_cmp(&targets[open[b]].0.x)) else {
        return open;
    };
    let mut way = vec![open.swap_remove(first)];
    while let Some(nearest) = {
        let last = way[way.len() - 1];
        (0..open.len()).min_by(|&a, &b| apart(last, open[a]).total_cmp(&apart(last, open[b])))
    } {
        way.push(open.swap_remove(nearest));
    }
    const MAX_PASSES: usize = 8;
    for _ in 0..MAX_PASSES {
        let mut is_shorter = false;
        for i in 0..way.len().saturating_sub(2) {
            for j in i + 2..way.len() {
                let after = way.get(j + 1).map_or([0.0; 2], |&end| [apart(way[j], end), apart(way[i + 1], end)]);
                if apart(way[i], way[j]) + after[1] + 1e-9 < apart(way[i], way[i + 1]) + after[0] {
                    way[i + 1..=j].reverse();
                    is_shorter = true;
                }
            }
        }
        if !is_shorter {
            break;
        }
    }
    way
}
