//! How strong and how wide the field is, and how far a point scatters: by what was measured.
//!
//! The restricted likelihood, whatever the effects are, times what was known beforehand, is made as large as it gets. Its two shapes, the
//! range and the share of the scatter, are searched; the scale follows from them at once: sigma^2 is the mean square of the whitened
//! residuals. Beside them stand the smoothness of the field, the lay along which it is wider, and, where the points were measured along a path, the
//! drift of the probe, each as far as it is spoken for.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::hill::climb;
use super::profile::{Profile, best_scale};
use super::{Dense, Field, Hyper, Lay, ModelError, Observed, Smoothness, spacing_mm};

/// What is known of a field before anything is measured: the median of each, and by what factor it may be off (one standard deviation of
/// its logarithm).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Priors {
    /// Of the range.
    pub range_mm: [f64; 2],
    /// Of the ratio of the scatter to the field.
    pub scatter_ratio: [f64; 2],
}

/// By what factors the range and the ratio of a part are off of which nothing is known, and how many parts are like none before.
const EVERY: [f64; 2] = [6.0, 20.0];
const LIKE_NONE: f64 = 0.2;
/// Ratios of scatter to field at which the search begins.
const RATIOS: [f64; 4] = [0.01, 0.1, 0.6, 3.0];
/// What is spoken for by so much less than the best (in the logarithm) is left out; so is what has all but the same range.
const NEAR: f64 = 8.0;
const APART: f64 = 0.2;
/// Of so many points every pair is looked at.
const MOST_TOGETHER: usize = 250;
/// Of more, so many that lie all over the part tell how wide the field is.
const SPREAD: usize = 150;
/// The field, in scatters, that is as good as none.
const NO_FIELD: f64 = 1e-6;
/// How far beside the best parameters the likelihood is looked at, and the most by which a scatter is taken for unknown (of its logarithm).
const STEP: f64 = 0.1;
const MOST_UNKNOWN: f64 = 0.5;
/// Drifts at which the search begins, and by how much one has to be spoken for more than none, in the logarithm of the likelihood.
const DRIFTS: [f64; 3] = [0.3, 0.6, 0.85];
const DRIFT_EVIDENCE: f64 = 2.0;
/// Kinds of field: all, and those that have a precision on a grid.
pub(super) const ANY: [Smoothness; 3] = [Smoothness::Once, Smoothness::Thrice, Smoothness::Endless];
pub(super) const ON_A_GRID: [Smoothness; 2] = [Smoothness::Once, Smoothness::Thrice];
/// The logarithm of the stretch of a lay at which the search begins, the most that is told, and by how much it has to be spoken for.
const FIRST_STRETCH: f64 = 0.6;
const MOST_STRETCHED: f64 = 10.0;
const LAY_EVIDENCE: f64 = 4.0;
/// By what factor a field may be stronger than what is seen of it (one standard deviation of its logarithm).
const STRONGER: f64 = 2.0;
/// By how much more each step of smoothness has to be spoken for.
const DOUBT: f64 = 2.0;
/// How finely a drift is told, and the most that is.
const DRIFT_STEPS: [f64; 3] = [0.12, 0.06, 0.03];
const MOST_DRIFT: f64 = 0.97;
/// Neighbours tell how far a point scatters, and what is narrow: blocks of so many at most, so many blocks at most.
const POINTS_A_BLOCK: usize = 48;
const MOST_BLOCKS: usize = 40;

impl Priors {
    /// What every part is like: the range some third of its size, the scatter a twentieth of the field, each by a factor of its own.
    pub fn of_size(size_mm: f64) -> Self {
        Self { range_mm: [size_mm / 3.0, EVERY[0]], scatter_ratio: [0.05, EVERY[1]] }
    }

    /// Says what makes these no expectations.
    pub(super) fn check(&self) -> Result<(), ModelError> {
        for (what, [median, factor]) in [("range", self.range_mm), ("ratio of scatter to field", self.scatter_ratio)] {
            if !(median.is_finite() && median > 0.0 && factor.is_finite() && factor > 1.0) {
                return Err(ModelError::Expected { what, median, factor });
            }
        }
        Ok(())
    }

    /// One part of a few is like none before, and differs from what is expected as much as parts of which nothing is known (Schmidli and others
    /// 2014). Beyond one factor either falls as slowly as it does there (Huber 1964).
    pub(super) fn log_density(&self, range_mm: f64, ratio: f64) -> f64 {
        let of = |value: f64, median: f64, factor: f64| {
            let off = ((value / median).ln() / factor.ln()).abs();
            (if off <= 1.0 { -0.5 * off * off } else { 0.5 - off }) - factor.ln().ln()
        };
        let by = |[of_range, of_ratio]: [f64; 2]| {
            of(range_mm, self.range_mm[0], of_range) + of(ratio, self.scatter_ratio[0], of_ratio)
        };
        let factors = [self.range_mm[1], self.scatter_ratio[1]];
        let like = by(factors) + (1.0 - LIKE_NONE).ln();
        let unlike = by([factors[0].max(EVERY[0]), factors[1].max(EVERY[1])]) + LIKE_NONE.ln();
        let higher = like.max(unlike);
        higher + ((like - higher).exp() + (unlike - higher).exp()).ln()
    }
}

impl Hyper {
    /// Finds the parameters that what was measured speaks for most, of fields that both ways of the model can work with.
    ///
    /// Of many points the likelihood is a composite one (Varin, Reid and Firth 2011): of some that lie all over the part, and of blocks of neighbours,
    /// each with a plane of its own that nobody knows.
    ///
    /// # Errors
    /// Those of [`Dense::fit`].
    pub fn of(observed: &Observed, priors: &Priors) -> Result<Self, ModelError> {
        Self::told(observed, priors, &ON_A_GRID).map(|told| told.likely[0].0)
    }

    /// The same, with what else it might be, of fields of some smoothness.
    pub(super) fn told(observed: &Observed, priors: &Priors, smoothness: &[Smoothness]) -> Result<Told, ModelError> {
        observed.check()?;
        priors.check()?;
        let search = Search::of(observed, priors);
        let rough = Shape::default();
        let mut tops = search.tops(rough, &RATIOS);
        let mut best = (rough, search.climbed(&tops, rough));
        if !observed.path.is_empty()
            && let Some(drifting) = search.drift(best.1)
        {
            best = drifting;
            tops = search.tops(best.0, &RATIOS);
        }
        let (plain, _) = search.at(&search.all, best.1.0, best.0)?;
        let ratio = best.1.0[1].exp();
        let mut all = vec![best];
        let others: Vec<_> = smoothness.iter().filter(|of| **of != best.0.smoothness).collect();
        let climb = |smoothness: &&Smoothness| {
            let shape = Shape { smoothness: **smoothness, ..best.0 };
            // What is smoother is narrower, and leaves more to the scatter.
            let seen = search.tops(shape, &[ratio, 3.0 * ratio]);
            let top = search.climbed(&seen, shape);
            (shape, seen, top)
        };
        for (shape, seen, top) in others.par_iter().map(climb).collect::<Vec<_>>() {
            if top.1 > all[0].1.1 {
                tops = seen;
                all.insert(0, (shape, top));
            } else {
                all.push((shape, top));
            }
        }
        if let Some(lay) = search.lay(all[0]) {
            // The others are as much less likely beside it as they were without it.
            all.iter_mut().for_each(|(shape, _)| shape.lay = lay.0.lay);
            let higher = lay.1.1 - all[0].1.1;
            all.iter_mut().for_each(|(_, top)| top.1 += higher);
            all[0] = lay;
        }
        search.told(&all, &tops, plain)
    }
}

/// What of the parameters is not climbed to: it is taken one by one.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Shape {
    smoothness: Smoothness,
    lay: Lay,
    drift: f64,
}

impl Default for Shape {
    fn default() -> Self {
        Self { smoothness: Smoothness::Once, lay: Lay::NONE, drift: 0.0 }
    }
}

/// A place of range and ratio, by their logarithms, and how high the likelihood is there.
type Top = ([f64; 2], f64);

/// The hill of the likelihood.
struct Search<'a> {
    /// Points all over the part, and blocks of neighbours.
    all: Vec<Observed>,
    priors: &'a Priors,
    /// The root mean square of what was measured.
    rms_mm: f64,
    /// The logarithms of the least range that can be told, and of how many of it the range is that is expected.
    least: f64,
    far: f64,
}

impl<'a> Search<'a> {
    fn of(observed: &Observed, priors: &'a Priors) -> Self {
        let all = if observed.places.len() <= MOST_TOGETHER {
            vec![observed.clone()]
        } else {
            std::iter::once(thinned(observed, SPREAD)).chain(blocks(observed)).collect()
        };
        let least_mm = least_range_mm(observed);
        // However narrow a form is expected to be, it may be wide.
        let widest_mm = priors.range_mm[0].max(size_mm(&observed.places) / 3.0);
        let squares: f64 = observed.deviations_mm.iter().map(|d| d * d).sum();
        let rms_mm = (squares / observed.places.len() as f64).sqrt();
        Self { all, priors, rms_mm, least: least_mm.ln(), far: (widest_mm / least_mm).max(1.5).ln() }
    }

    fn at(&self, of: &[Observed], [range, ratio]: [f64; 2], shape: Shape) -> Result<(Hyper, f64), ModelError> {
        let (hyper, value) = scaled(of, [range.exp(), ratio.exp()], shape, self.priors)?;
        // What a fit takes off a form is about as much as what it leaves: a field that was far stronger would be one of which the points show next to nothing.
        let beyond = (hyper.field.sigma_mm / self.rms_mm.max(f64::MIN_POSITIVE)).ln().max(0.0) / STRONGER.ln();
        Ok((hyper, value - 0.5 * beyond * beyond))
    }

    /// What is narrower than can be told has no height.
    fn height(&self, of: &[Observed], place: [f64; 2], shape: Shape) -> f64 {
        match self.at(of, place, shape) {
            Ok((_, value)) if place[0] >= self.least => value,
            _ => f64::NEG_INFINITY,
        }
    }

    /// A hill may have two tops: a wide form and a narrow one.
    fn tops(&self, shape: Shape, ratios: &[f64]) -> Vec<Top> {
        let ranges = [0.1, 0.4, 0.7, 1.0, 1.5].map(|power: f64| self.least + power * self.far);
        let top = |range: &f64| {
            let places = ratios.iter().map(|ratio| [*range, ratio.ln()]);
            let seen = places.map(|place| (place, self.height(&self.all, place, shape)));
            seen.fold(([*range, 0.0], f64::NEG_INFINITY), higher)
        };
        ranges.par_iter().map(top).collect()
    }

    fn climbed(&self, tops: &[Top], shape: Shape) -> Top {
        let start = tops.iter().copied().fold(tops[0], higher);
        climb(start.0, [0.15 * self.far, 0.7], 0.02, |place| self.height(&self.all, place, shape))
    }

    /// The drift that is spoken for most, with the top of the likelihood by it; none where it is spoken for by too little more than none.
    fn drift(&self, without: Top) -> Option<(Shape, Top)> {
        let of = |drift| Shape { drift, ..Shape::default() };
        let found = told_drift(
            without,
            |drift| self.climbed(&self.tops(of(drift), &RATIOS), of(drift)),
            |top, drift| self.climbed(&[top], of(drift)),
        );
        found.map(|(drift, top)| (of(drift), top))
    }

    /// The lay of the field, where it is spoken for by enough more than none.
    fn lay(&self, (shape, without): (Shape, Top)) -> Option<(Shape, Top)> {
        // A lay turns, and none has none: twice its angle and the logarithm of its stretch are the polar coordinates of a plane.
        let of = |[a, b]: [f64; 2]| {
            let stretch = a.hypot(b).exp().min(MOST_STRETCHED);
            Shape { lay: Lay::at(0.5 * b.atan2(a), stretch), ..shape }
        };
        let height = |place: [f64; 2]| self.height(&self.all, without.0, of(place));
        let starts =
            [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]].map(|along: [f64; 2]| along.map(|v| v * FIRST_STRETCH));
        let seen = starts.map(|start| (start, height(start)));
        let start = seen.into_iter().fold(seen[0], higher);
        if start.1 < without.1 {
            return None;
        }
        let (place, _) = climb(start.0, [0.3, 0.3], 0.03, height);
        let top = self.climbed(&[without], of(place));
        (top.1 > without.1 + LAY_EVIDENCE).then(|| (of(place), top))
    }

    /// The best of some shapes, with what else it might be: `tops` are those of the first.
    fn told(&self, shapes: &[(Shape, Top)], tops: &[Top], plain: Hyper) -> Result<Told, ModelError> {
        let (shape, (best, top)) = shapes[0];
        let (hyper, _) = self.at(&self.all, best, shape)?;
        let mut likely = vec![(hyper, 1.0)];
        let near = tops.iter().filter(|(place, of)| top - of < NEAR && (place[0] - best[0]).abs() > APART);
        let climbed = near.map(|(place, _)| {
            (shape, climb(*place, [0.0, 0.3], 0.05, |[_, ratio]| self.height(&self.all, [place[0], ratio], shape)))
        });
        let others: Vec<_> =
            climbed.chain(shapes[1..].iter().copied()).filter(|(_, (_, of))| top - of < NEAR).collect();
        likely.extend(
            others
                .into_iter()
                .filter_map(|(shape, (place, of))| Some((self.at(&self.all, place, shape).ok()?.0, (of - top).exp()))),
        );
        // By the curvature of the hill along the scatter, whose scale moves with it.
        let beside = |step: f64| self.at(&self.all, [best[0], best[1] + step], shape).unwrap_or((hyper, top));
        let (below, above) = (beside(-STEP), beside(STEP));
        let moved = 0.5 * (above.0.scatter_mm / below.0.scatter_mm).ln();
        let falls = (2.0 * top - below.1 - above.1).max(f64::MIN_POSITIVE);
        let scatter_u = (moved / falls.sqrt()).abs().min(MOST_UNKNOWN);
        Ok(Told { likely, plain, wide: self.wide(shapes, hyper), scatter_u })
    }

    /// How strong and how wide the widest waves are, by those points alone that see them, with how much speaks for each smoothness.
    fn wide(&self, shapes: &[(Shape, Top)], found: Hyper) -> Vec<(Hyper, f64)> {
        let (best, (from, _)) = shapes[0];
        let spread = &self.all[..1];
        let of = |smoothness| {
            let known = shapes.iter().find(|(shape, _)| shape.smoothness == smoothness && self.all.len() == 1);
            let (shape, (place, top)) = known.copied().unwrap_or_else(|| {
                let shape = Shape { smoothness, ..best };
                (shape, climb(from, [0.3, 0.3], 0.03, |place| self.height(spread, place, shape)))
            });
            let (wide, _) = self.at(spread, place, shape).ok()?;
            // Each is taken for as likely as it is: what is too careful of the three makes the mean of them careful.
            Some((Hyper { scatter_mm: found.scatter_mm, ..wide }, top - doubt(smoothness)))
        };
        let seen: Vec<(Hyper, f64)> = ANY.into_par_iter().filter_map(of).collect();
        let top = seen.iter().map(|(_, of)| *of).fold(f64::NEG_INFINITY, f64::max);
        if !top.is_finite() {
            return vec![(found, 1.0)];
        }
        seen.into_iter().map(|(wide, of)| (wide, (of - top).exp())).collect()
    }
}

fn higher(a: Top, b: Top) -> Top {
    if b.1 > a.1 { b } else { a }
}

/// The drift that is spoken for most, with the top of the likelihood by it; none where it is spoken for by too little more than none.
fn told_drift(
    without: Top,
    search: impl Fn(f64) -> Top + Sync,
    climb: impl Fn(Top, f64) -> Top + Sync,
) -> Option<(f64, Top)> {
    let higher = |a: (f64, Top), b: (f64, Top)| if b.1.1 > a.1.1 { b } else { a };
    let seen: Vec<_> = DRIFTS.par_iter().map(|&drift| (drift, search(drift))).collect();
    let mut best = seen.into_iter().fold((0.0, without), higher);
    // From there in ever smaller steps: what is near is spoken for by much the same range and ratio.
    for step in DRIFT_STEPS {
        let beside = [best.0 - step, best.0 + step].map(|drift| drift.clamp(0.0, MOST_DRIFT));
        let seen: Vec<_> = beside.par_iter().map(|&drift| (drift, climb(best.1, drift))).collect();
        best = seen.into_iter().fold(best, higher);
    }
    (best.1.1 > without.1 + DRIFT_EVIDENCE).then_some(best)
}

/// What speaks for which parameters.
pub(super) struct Told {
    /// The most probable first, with how much more it is spoken for than each other.
    pub(super) likely: Vec<(Hyper, f64)>,
    /// The most probable of the roughest without a lay: how much speaks for a form is known of these.
    pub(super) plain: Hyper,
    /// By points all over the part: how strong and how wide its widest waves are, of each smoothness, with how much speaks for it.
    pub(super) wide: Vec<(Hyper, f64)>,
    /// Standard uncertainty of the logarithm of the scatter.
    pub(super) scatter_u: f64,
}

/// Neighbours, block by block, each with a plane as the effect that nobody knows.
fn blocks(observed: &Observed) -> Vec<Observed> {
    let mut whole: Vec<Vec<usize>> = vec![(0..observed.places.len()).collect()];
    let mut done = Vec::new();
    while let Some(mut block) = whole.pop() {
        if block.len() <= POINTS_A_BLOCK {
            done.push(block);
            continue;
        }
        let span = |axis: usize| {
            let of = block.iter().map(|&k| observed.places[k][axis]);
            of.clone().fold(f64::NEG_INFINITY, f64::max) - of.fold(f64::INFINITY, f64::min)
        };
        let axis = usize::from(span(1) > span(0));
        block.sort_by(|&a, &b| observed.places[a][axis].total_cmp(&observed.places[b][axis]).then(a.cmp(&b)));
        let rest = block.split_off(block.len() / 2);
        whole.extend([block, rest]);
    }
    let every = done.len().div_ceil(MOST_BLOCKS);
    done.iter().step_by(every).map(|block| with_plane(observed, block)).collect()
}

fn with_plane(observed: &Observed, block: &[usize]) -> Observed {
    let places: Vec<[f64; 2]> = block.iter().map(|&k| observed.places[k]).collect();
    let middle = [0, 1].map(|axis| places.iter().map(|place| place[axis]).sum::<f64>() / places.len() as f64);
    let effects = DMatrix::from_fn(places.len(), 3, |r, c| match c {
        0 => 1.0,
        c => places[r][c - 1] - middle[c - 1],
    });
    let deviations_mm = block.iter().map(|&k| observed.deviations_mm[k]).collect();
    let stated = observed.stated.select_rows(block);
    Observed { deviations_mm, places, effects, stated, path: observed.path_of(block) }
}

impl Hyper {
    /// Returns by how much more what was measured speaks for this field than for none, in the logarithm of the restricted likelihood.
    pub(super) fn evidence(&self, observed: &Observed) -> f64 {
        let few = thinned(observed, MOST_TOGETHER);
        let with = Dense::fit(&few, *self).map_or(f64::NEG_INFINITY, |model| model.log_likelihood());
        // As good as none, and a scatter that suits it best.
        let unit = Self { field: Field { sigma_mm: NO_FIELD, ..self.field }, scatter_mm: 1.0, ..*self };
        if few.stated.ncols() > 0 {
            return Profile::of(&few, unit).map_or(f64::INFINITY, |without| with - best_scale(&[without]).1);
        }
        let Ok(without) = Dense::fit(&few, unit) else { return f64::INFINITY };
        let squares = without.whitened_squares(&few);
        let free = (few.places.len() - few.effects.ncols()) as f64;
        with - (without.log_likelihood() + 0.5 * squares - 0.5 * free - 0.5 * free * (squares / free).ln())
    }
}

/// What a rough field says of a smooth form is too careful, and what a smooth one says of a rough form is wrong: the smoother has to be spoken for by more.
fn doubt(smoothness: Smoothness) -> f64 {
    match smoothness {
        Smoothness::Once => 0.0,
        Smoothness::Thrice => -DOUBT,
        Smoothness::Endless => -2.0 * DOUBT,
    }
}

/// A field that forgets itself between two neighbours is no form: what is narrower than this cannot be told from scatter.
fn least_range_mm(observed: &Observed) -> f64 {
    const NEIGHBOURS: f64 = 2.5;
    NEIGHBOURS * spacing_mm(&observed.places)
}

/// The root mean square distance of places from their middle.
fn size_mm(places: &[[f64; 2]]) -> f64 {
    let n = places.len() as f64;
    let middle = [0, 1].map(|axis| places.iter().map(|place| place[axis]).sum::<f64>() / n);
    let squares = places.iter().map(|[x, y]| (x - middle[0]).powi(2) + (y - middle[1]).powi(2));
    (squares.sum::<f64>() / n).sqrt()
}

/// The parameters with the scale that suits them best, and the logarithm of their probability. What tells nothing of its plane, such as points
/// on a line, tells nothing here.
fn scaled(
    told: &[Observed],
    [range_mm, ratio]: [f64; 2],
    Shape { smoothness, lay, drift }: Shape,
    priors: &Priors,
) -> Result<(Hyper, f64), ModelError> {
    let unit = Hyper { field: Field { sigma_mm: 1.0, range_mm, smoothness, lay }, scatter_mm: ratio, drift };
    let known = priors.log_density(range_mm, ratio) + doubt(smoothness);
    let (mut value, mut squares, mut free) = (known, 0.0, 0.0);
    if told[0].stated.ncols() > 0 {
        let first = Profile::of(&told[0], unit)?;
        let others: Vec<_> = told[1..].par_iter().filter_map(|observed| Profile::of(observed, unit).ok()).collect();
        let (sigma_mm, of) = best_scale(&std::iter::once(first).chain(others).collect::<Vec<_>>());
        let hyper = Hyper { field: Field { sigma_mm, ..unit.field }, scatter_mm: ratio * sigma_mm, drift };
        return Ok((hyper, value + of));
    }
    let fit = |observed: &Observed| {
        Dense::fit(observed, unit).map(|model| (model.log_likelihood(), model.whitened_squares(observed)))
    };
    let fitted: Vec<_> = told.par_iter().map(fit).collect();
    for (k, (observed, fitted)) in told.iter().zip(fitted).enumerate() {
        let (likelihood, of) = match fitted {
            Ok(fitted) => fitted,
            Err(error) if k == 0 => return Err(error),
            Err(_) => continue,
        };
        value += likelihood + 0.5 * of;
        squares += of;
        free += (observed.places.len() - observed.effects.ncols()) as f64;
    }
    // No deviation at all is a field of no strength.
    let sigma_mm = (squares / free).sqrt().max(f64::MIN_POSITIVE.sqrt());
    let hyper = Hyper { field: Field { sigma_mm, ..unit.field }, scatter_mm: ratio * sigma_mm, drift };
    Ok((hyper, value - 0.5 * free - free * sigma_mm.ln()))
}

/// Some of the points, far from each other and near: every k-th in a fixed disorder.
fn thinned(observed: &Observed, most: usize) -> Observed {
    let n = observed.places.len();
    if n <= most {
        return observed.clone();
    }
    // Steps of the golden section go everywhere and repeat nothing.
    let mut chosen: Vec<usize> =
        (0..most).map(|k| (((k as f64 + 0.5) * 0.618_033_988_749_894_9).fract() * n as f64) as usize).collect();
    chosen.sort_unstable();
    chosen.dedup();
    observed.only(&chosen)
}

#[cfg(test)]
mod tests {
    use super::super::normals::Normals;
    use super::*;
    use nalgebra::DVector;

    /// A field of known parameters at 300 places of a part of 102 x 62 mm, moved and tilted by what nobody knows.
    fn drawn(hyper: Hyper, seed: u64) -> Observed {
        let places: Vec<[f64; 2]> = (0..300)
            .map(|k| f64::from(k) + 0.5)
            .map(|k| [(0.754_877_666 * k).fract() * 102.0, (0.569_840_291 * k).fract() * 62.0])
            .collect();
        let n = places.len();
        let covariance = DMatrix::from_fn(n, n, |r, c| {
            hyper.field.covariance_mm2(places[r], places[c]) + if r == c { 1e-14 } else { 0.0 }
        });
        let mut normals = Normals::new(seed, 0);
        let field = covariance.cholesky().unwrap().l() * DVector::from_fn(n, |_, _| normals.next());
        let of = |k: usize, scatter: f64| field[k] + hyper.scatter_mm * scatter + 0.3 - 0.01 * places[k][0];
        let deviations_mm = (0..places.len()).map(|k| of(k, normals.next())).collect();
        let effects = DMatrix::from_fn(places.len(), 3, |r, c| [1.0, places[r][0], places[r][1]][c]);
        Observed { effects, ..Observed::without_effects(places, deviations_mm) }
    }

    #[test]
    fn planted_parameters_are_found_again() {
        let planted = Hyper { field: Field::new(5e-3, 30.0), scatter_mm: 3e-4, drift: 0.0 };
        let (mut sigma, mut range, mut scatter) = (0.0, 0.0, 0.0);
        const PARTS: u32 = 6;
        for seed in 0..PARTS {
            let told = Hyper::told(&drawn(planted, u64::from(seed)), &Priors::of_size(102.0), &ANY).unwrap();
            let found = told.likely[0].0;
            sigma += (found.field.sigma_mm / planted.field.sigma_mm).ln() / f64::from(PARTS);
            range += (found.field.range_mm / planted.field.range_mm).ln() / f64::from(PARTS);
            scatter += (found.scatter_mm / planted.scatter_mm).ln() / f64::from(PARTS);
        }
        let off = [sigma, range, scatter].map(f64::exp);
        println!("sigma, range, scatter: {off:.3?} of what was planted");
        assert!((off[0] - 1.0).abs() < 0.3 && (off[1] - 1.0).abs() < 0.25 && (off[2] - 1.0).abs() < 0.08, "{off:?}");
    }

    /// The same along a path to and fro over a grid of 30 by 18, on which the probe drifts.
    fn along_a_path(hyper: Hyper, seed: u64) -> Observed {
        let at = |k: usize| {
            [if (k / 30).is_multiple_of(2) { k % 30 } else { 29 - k % 30 }, k / 30].map(|at| 3.5 * at as f64)
        };
        let places: Vec<[f64; 2]> = (0..540).map(at).collect();
        let n = places.len();
        let covariance = DMatrix::from_fn(n, n, |r, c| {
            hyper.field.covariance_mm2(places[r], places[c]) + if r == c { 1e-14 } else { 0.0 }
        });
        let mut normals = Normals::new(seed, 0);
        let field = covariance.cholesky().unwrap().l() * DVector::from_fn(n, |_, _| normals.next());
        let mut scatter = normals.next();
        let mut of = |k: usize| {
            scatter = hyper.drift * scatter + (1.0 - hyper.drift * hyper.drift).sqrt() * normals.next();
            field[k] + hyper.scatter_mm * scatter
        };
        let deviations_mm = (0..n).map(&mut of).collect();
        let effects = DMatrix::from_fn(n, 3, |r, c| [1.0, places[r][0], places[r][1]][c]);
        let path = (0..n).map(|k| k as f64).collect();
        Observed { effects, path, ..Observed::without_effects(places, deviations_mm) }
    }

    #[test]
    fn a_drift_along_the_path_is_found_again_and_none_is_seen_where_there_is_none() {
        for drift in [0.0, 0.7, 0.9] {
            let planted = Hyper { field: Field::new(5e-3, 30.0), scatter_mm: 3e-4, drift };
            const PARTS: u64 = 4;
            let told = |seed| Hyper::of(&along_a_path(planted, seed), &Priors::of_size(102.0)).unwrap();
            let all: Vec<Hyper> = (1..=PARTS).map(told).collect();
            let mean = |of: &dyn Fn(&Hyper) -> f64| all.iter().map(of).sum::<f64>() / PARTS as f64;
            let off = [mean(&|h| h.drift) - drift, mean(&|h| (h.scatter_mm / planted.scatter_mm).ln())];
            println!("drift {drift}: off by {off:.3?}, {:.3?}", all.iter().map(|h| h.drift).collect::<Vec<_>>());
            assert!(off[0].abs() < 0.1 && off[1].abs() < 0.3, "{off:?} {all:?}");
            assert!(drift > 0.0 || all.iter().all(|h| h.drift == 0.0), "{all:?}");
        }
    }

    #[test]
    fn what_was_taught_counts_for_no_more_than_that_one_part_of_five_is_like_none_before() {
        let taught = Priors { range_mm: [8.0, 2.0], scatter_ratio: [0.1, 2.0] };
        let [at, off] = [8.0, 8.0 * 25.0].map(|range_mm| taught.log_density(range_mm, 0.1));
        // By hand: ln(0.8 / ln^2 2 + 0.2 / (ln 6 ln 20)), and of what is 25 times as wide all but nothing but the second, (0.5 - ln 25 / ln 6) lower.
        let (like, unlike) = (0.8 / 2f64.ln().powi(2), 0.2 / (6f64.ln() * 20f64.ln()));
        let [near, far] = [0.5 - 25f64.ln() / 2f64.ln(), 0.5 - 25f64.ln() / 6f64.ln()];
        assert!((at - (like + unlike).ln()).abs() < 1e-12, "{at}");
        assert!((off - (like * near.exp() + unlike * far.exp()).ln()).abs() < 1e-12, "{off}");
    }

    #[test]
    fn what_cannot_be_expected_is_refused_in_words() {
        let good = Priors::of_size(102.0);
        let observed = drawn(Hyper { field: Field::new(5e-3, 30.0), scatter_mm: 3e-4, drift: 0.0 }, 1);
        for (bad, words) in [
            (Priors { range_mm: [8.0, 1.0], ..good }, "the range is expected to be 8 by a factor of 1;"),
            (Priors { range_mm: [0.0, 2.0], ..good }, "the range is expected to be 0 by a factor of 2;"),
            (Priors { scatter_ratio: [f64::NAN, 2.0], ..good }, "the ratio of scatter to field is expected to be NaN"),
            (Priors { scatter_ratio: [0.1, f64::INFINITY], ..good }, "by a factor of inf;"),
        ] {
            let error = Hyper::of(&observed, &bad).unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
        }
    }

    #[test]
    fn the_scale_of_everything_is_the_scale_of_what_is_found() {
        let planted = Hyper { field: Field::new(5e-3, 30.0), scatter_mm: 3e-4, drift: 0.0 };
        let observed = drawn(planted, 1);
        let tenfold =
            Observed { deviations_mm: observed.deviations_mm.iter().map(|d| 10.0 * d).collect(), ..observed.clone() };
        let [a, b] = [observed, tenfold].map(|observed| Hyper::of(&observed, &Priors::of_size(102.0)).unwrap());
        assert!((b.field.sigma_mm / a.field.sigma_mm - 10.0).abs() < 1e-6);
        assert!((b.field.range_mm / a.field.range_mm - 1.0).abs() < 1e-9);
    }
}
