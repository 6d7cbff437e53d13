//! Where to touch next, and whether to touch on.
//!
//! ```text
//!  registration --> Form over all targets --> decided? known well enough to correct by? anything that was not expected?
//!                        |                                    |
//!                        +--> Growing --> the next targets <--+ no
//! ```
//!
//! Targets are those of a measuring pattern: every one is a place that the probe can reach, and touching all of them is the pattern itself.
//! A batch goes where least is known, where the highest and the lowest place may be first; a tenth of it goes anywhere, so that what the
//! model does not expect is met; and around what was not expected.

use super::form::Motions;
use super::normals::Normals;
use super::{Form, IncrementalPosterior, ModelError, ModelInputs, Observed, Prediction};
use crate::geometry::{Point, Vector};
use crate::registration::{Deviation, PointStatus, Registration};

/// What a measurement is to tell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StoppingCriteria {
    /// The largest peak to valley that is accepted; infinite where it is not limited.
    pub pv_mm: f64,
    /// The same without the outermost 0.1 % at either end.
    pub pv_most_points_mm: f64,
    /// The largest root mean square that is accepted; infinite where it is not limited.
    pub rms_mm: f64,
    /// How well the form has to be known for a correction: better is lost in what a pass adds by itself.
    pub correction_mm: f64,
    /// Whether another pass may be ground, and is expected to make the part better.
    pub may_grind: bool,
}

/// A measurement that is going on.
#[derive(Clone, Copy, Debug)]
pub struct PartialMeasurement<'a> {
    /// All targets, touched or not: points of the nominal surface and their normals, in the model frame.
    pub targets: &'a [(Point, Vector)],
    /// Which of them was tried in which batch; none where it was not.
    pub tried: &'a [Option<u32>],
    /// Which target each deviation of the registration is of.
    pub touched: &'a [usize],
}

/// What is known, and what follows.
#[derive(Clone, Debug)]
pub struct StoppingDecision {
    /// The form over all targets; without slopes, ISO figures and its budget where touches follow.
    pub form: Form,
    /// The targets to touch next, in the order of a short way; none where enough is known.
    pub next: Vec<usize>,
    /// Why.
    pub reason: Reason,
}

/// Why to touch on, or not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// The figures are within their limits, as surely as is asked of one look among many.
    Within,
    /// The part has to be corrected, and the form is known well enough for that.
    Known,
    /// The part has to be corrected, and more touches would cost more than another pass mends.
    Enough,
    /// Every target was tried.
    All,
    /// Fewer touches say nothing.
    Few,
    /// What was found last is not what was expected.
    Surprised,
    /// A touch stands out, and what is around it is not known.
    Around,
    /// Something narrow stands on the part: only the whole pattern tells its size.
    Feature,
    /// A figure may lie on either side of its limit.
    Undecided,
    /// The form is not known well enough for a correction.
    Unknown,
    /// A figure is beyond its limit for certain, and no pass is left that would be corrected.
    Beyond,
    /// So many batches were touched that the others are touched at once.
    Late,
}

/// Touches that tell whether it is the right part, and where it is.
pub const FIRST_BATCH: usize = 10;
/// Fewer touches decide nothing.
pub const MIN_TOUCHES: usize = 40;
/// Batches of a measurement, but for a last one of all that is left: who counts them on a wire has few bits for it.
pub const MAX_BATCHES: u32 = 60;
/// Touches of a batch, at least and at most.
const BATCH: [usize; 2] = [20, 100];
/// One in so many goes anywhere.
const ANYWHERE: usize = 10;
/// A touch that is off by so many standard deviations is looked at from around, with so many neighbours.
const STANDS_OUT: f64 = 4.5;
const NEIGHBOURS: usize = 6;
/// So many of them have to be tried.
const SURROUNDED: usize = 4;
/// By chance the squares of a batch are larger in one of a thousand.
const BY_CHANCE: f64 = 3.09;
/// Where nothing is accepted and another pass may help, touching on is given up at this share of the pattern, and at no fewer.
const GIVEN_UP: (f64, usize) = (1.0 / 6.0, 120);

/// Returns so many targets that lie as far apart as they can: each is the one farthest from those before it.
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

/// Looks at what has been touched: is it enough, and where to touch next if not.
///
/// # Errors
/// Those of [`Form::over`].
pub fn decide(
    registration: &Registration,
    inputs: &ModelInputs,
    so_far: &PartialMeasurement,
    purpose: &StoppingCriteria,
    seed: u64,
) -> Result<StoppingDecision, ModelError> {
    let form = Form::estimate_with(registration, inputs, so_far.targets, false)?;
    let mut growing = ExpectedTouches::of(registration, inputs, &form, so_far)?;
    let count = so_far.touched.len();
    let left = so_far.tried.iter().filter(|tried| tried.is_none()).count();
    let around = growing.around(so_far);
    let why = match () {
        () if left == 0 => Reason::All,
        () if count < MIN_TOUCHES => Reason::Few,
        () if growing.feature(so_far) => Reason::Feature,
        () if growing.is_surprised() => Reason::Surprised,
        () if !around.is_empty() => Reason::Around,
        () => settled(&form, purpose, (count, so_far.targets.len())),
    };
    let is_over = matches!(why, Reason::Within | Reason::Known | Reason::Enough | Reason::Beyond | Reason::All);
    let batches = so_far.tried.iter().flatten().max().map_or(0, |last| last + 1);
    let why = if batches >= MAX_BATCHES && !is_over { Reason::Late } else { why };
    let next = match why {
        _ if is_over => Vec::new(),
        Reason::Feature | Reason::Late => (0..so_far.tried.len()).filter(|&k| so_far.tried[k].is_none()).collect(),
        _ => {
            let wanted = if count < MIN_TOUCHES { MIN_TOUCHES - count } else { (count / 2).clamp(BATCH[0], BATCH[1]) };
            growing.next(so_far, &around, wanted.max(around.len()).min(left), seed)?
        }
    };
    let is_all = matches!(why, Reason::Feature | Reason::Late);
    let next = if is_all { next } else { short_tour(so_far.targets, next) };
    // More is said of the last look alone.
    let form = if next.is_empty() { Form::estimate_at(registration, inputs, so_far.targets)? } else { form };
    Ok(StoppingDecision { form, next, reason: why })
}

/// What the figures and the map say.
fn settled(form: &Form, purpose: &StoppingCriteria, (count, pattern): (usize, usize)) -> Reason {
    let figures = [
        (form.figures.pv, purpose.pv_mm),
        (form.figures.pv_most_points, purpose.pv_most_points_mm),
        (form.figures.rms, purpose.rms_mm),
    ];
    if figures.iter().all(|(figure, limit)| figure.most_mm <= *limit) {
        return Reason::Within;
    }
    let is_known = form.known_mm <= purpose.correction_mm;
    let is_beyond = figures.iter().any(|(figure, limit)| figure.least_mm > *limit);
    let (share, least) = GIVEN_UP;
    let gives_up = count >= least.max((share * pattern as f64) as usize);
    // Who judges looks once, and may accept what a look among many may not: then more is touched, not ground.
    let is_accepted = figures.iter().all(|(figure, limit)| figure.accepted_mm <= *limit);
    match () {
        () if is_beyond && !purpose.may_grind => Reason::Beyond,
        () if is_known && (is_beyond || gives_up && purpose.may_grind && !is_accepted) => Reason::Known,
        () if gives_up && purpose.may_grind && !is_accepted => Reason::Enough,
        () if is_beyond => Reason::Unknown,
        () => Reason::Undecided,
    }
}

/// What was expected, held against what was found.
struct ExpectedTouches {
    growing: IncrementalPosterior,
    /// By how many standard deviations each touch of the last batch is off, with its target.
    last: Vec<(usize, f64)>,
    outliers: Vec<usize>,
}

impl ExpectedTouches {
    /// Tells the model all that was found before the last batch, looks what it expects of that, and tells it the rest.
    fn of(
        registration: &Registration,
        inputs: &ModelInputs,
        form: &Form,
        so_far: &PartialMeasurement,
    ) -> Result<Self, ModelError> {
        let PartialMeasurement { targets, tried, touched } = so_far;
        let all: Vec<_> = registration.deviations.iter().zip(touched.iter().copied()).collect();
        let used = || all.iter().filter(|(d, _)| d.status == PointStatus::Used && d.in_fit);
        let motions = Motions::of(registration, used().map(|(d, _)| d.point));
        let stated = motions.stated(registration, inputs)?;
        let last = tried.iter().flatten().max().copied().unwrap_or(0);
        let of = |is_last: bool| -> (Observed, Vec<usize>) {
            let chosen: Vec<_> = used().filter(|(_, target)| (tried[*target] == Some(last)) == is_last).collect();
            let rows: Vec<_> = chosen.iter().map(|(d, _)| *d).collect();
            let columns = stated.columns(rows.iter().map(|d| (d.point, d.normal)));
            (
                Observed { random_effects: columns, ..motions.observed(&rows) },
                chosen.iter().map(|(_, target)| *target).collect(),
            )
        };
        let ((before, _), (found, of_targets)) = (of(false), of(true));
        let places = targets.iter().map(|(point, _)| [point.x, point.y]).collect();
        let (rows, columns) = (motions.rows(targets.iter().copied()), stated.columns(targets.iter().copied()));
        let mut growing = IncrementalPosterior::with_random_effects(places, rows, &columns, form.hyperparameters)?;
        growing.update(&before)?;
        // Before the motions are held nothing is expected.
        let is_held = before.places.len() > before.fixed_effects.ncols();
        let off = if is_held { growing.standardized_innovations(&found) } else { vec![0.0; found.places.len()] };
        growing.update(&found)?;
        let is_far = |d: &Deviation| d.status != PointStatus::OffPart && !d.in_fit;
        let outliers = all.iter().filter(|(d, _)| is_far(d)).map(|(_, target)| *target).collect();
        Ok(Self { growing, last: of_targets.into_iter().zip(off).collect(), outliers })
    }

    /// Whether the last batch as a whole is not what was expected, those that stand out left aside.
    fn is_surprised(&self) -> bool {
        let squares: Vec<f64> = self.last.iter().filter(|(_, z)| z.abs() < STANDS_OUT).map(|(_, z)| z * z).collect();
        let n = squares.len() as f64;
        // The quantile of chi-squared over its degrees of freedom (Wilson and Hilferty 1931).
        let ninth = 2.0 / (9.0 * n);
        n > 0.0 && squares.iter().sum::<f64>() / n > (1.0 - ninth + BY_CHANCE * ninth.sqrt()).powi(3)
    }

    fn standing_out(&self) -> impl Iterator<Item = usize> + '_ {
        let off = self.last.iter().filter(|(_, z)| z.abs() >= STANDS_OUT).map(|(target, _)| *target);
        off.chain(self.outliers.iter().copied())
    }

    /// Targets around touches that stand out, where few of their neighbours were tried.
    fn around(&self, so_far: &PartialMeasurement) -> Vec<usize> {
        let mut around = Vec::new();
        for target in self.standing_out() {
            let near = neighbours(so_far.targets, target);
            if near.iter().filter(|&&k| so_far.tried[k].is_some()).count() < SURROUNDED.min(near.len()) {
                around.extend(near.into_iter().filter(|&k| so_far.tried[k].is_none()));
            }
        }
        around.sort_unstable();
        around.dedup();
        around
    }

    /// Whether two neighbours were both taken for outliers: dust is alone.
    fn feature(&self, so_far: &PartialMeasurement) -> bool {
        let is_beside = |&a: &usize| neighbours(so_far.targets, a).iter().any(|k| self.outliers.contains(k));
        self.outliers.iter().any(is_beside)
    }

    /// Chooses what to touch next.
    fn next(
        &mut self,
        so_far: &PartialMeasurement,
        around: &[usize],
        wanted: usize,
        seed: u64,
    ) -> Result<Vec<usize>, ModelError> {
        let mut open: Vec<bool> = so_far.tried.iter().map(Option::is_none).collect();
        let mut chosen: Vec<usize> = around.iter().copied().filter(|&k| open[k]).collect();
        chosen.iter().for_each(|&k| open[k] = false);
        let mut random = Normals::new(seed, so_far.touched.len() as u64);
        for _ in 0..wanted.div_ceil(ANYWHERE).min(wanted.saturating_sub(chosen.len())) {
            // The phase of two normal numbers is as probable everywhere.
            let share = (random.next().atan2(random.next()) / std::f64::consts::TAU).rem_euclid(1.0);
            let free: Vec<usize> = (0..open.len()).filter(|&k| open[k]).collect();
            let Some(&anywhere) = free.get((share * free.len() as f64) as usize) else { break };
            open[anywhere] = false;
            chosen.push(anywhere);
        }
        for &place in &chosen {
            self.growing.update_with_expected(place)?;
        }
        while chosen.len() < wanted {
            let Some(best) = self.least_known(&open) else { break };
            self.growing.update_with_expected(best)?;
            open[best] = false;
            chosen.push(best);
        }
        Ok(chosen)
    }

    /// The open place of which least is known; what may be the highest or the lowest counts twice.
    fn least_known(&self, open: &[bool]) -> Option<usize> {
        let known: Vec<Prediction> = self.growing.predictions().collect();
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

/// The nearest other targets.
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

/// Puts targets in the order of a short way: always to the nearest, and crossings taken out (2-opt).
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
    const TURNS: usize = 8;
    for _ in 0..TURNS {
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
