//! How strong and how wide the field is, and how far a point scatters: by what was measured.
//!
//! The restricted likelihood, whatever the effects are, times what was known beforehand, is made as large as it gets. Its two shapes, the
//! range and the share of the scatter, are searched; the scale follows from them at once: sigma^2 is the mean square of the whitened
//! residuals. Where the points were measured along a path the drift of the probe is a third one, as far as it is spoken for.

use nalgebra::DMatrix;

use super::{Dense, Field, Hyper, ModelError, Observed, spacing_mm};

/// What is known of a field before anything is measured: the median of each, and by what factor it may be off (one standard deviation of
/// its logarithm).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Priors {
    /// Of the range.
    pub range_mm: [f64; 2],
    /// Of the ratio of the scatter to the field.
    pub scatter_ratio: [f64; 2],
}

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
/// How finely a drift is told, and the most that is.
const DRIFT_STEPS: [f64; 3] = [0.12, 0.06, 0.03];
const MOST_DRIFT: f64 = 0.97;
/// Neighbours tell how far a point scatters, and what is narrow: blocks of so many at most, so many blocks at most.
const POINTS_A_BLOCK: usize = 48;
const MOST_BLOCKS: usize = 40;

impl Priors {
    /// What every part is like: the range some third of its size, the scatter a twentieth of the field, each by a factor of six.
    pub fn of_size(size_mm: f64) -> Self {
        Self { range_mm: [size_mm / 3.0, 6.0], scatter_ratio: [0.05, 20.0] }
    }

    pub(super) fn log_density(&self, range_mm: f64, ratio: f64) -> f64 {
        let of = |value: f64, [median, factor]: [f64; 2]| -0.5 * ((value / median).ln() / factor.ln()).powi(2);
        of(range_mm, self.range_mm) + of(ratio, self.scatter_ratio)
    }
}

impl Hyper {
    /// Finds the parameters that what was measured speaks for most.
    ///
    /// Of many points the likelihood is a composite one (Varin, Reid and Firth 2011): of some that lie all over the part, and of blocks of neighbours,
    /// each with a plane of its own that nobody knows.
    ///
    /// # Errors
    /// Those of [`Dense::fit`].
    pub fn of(observed: &Observed, priors: &Priors) -> Result<Self, ModelError> {
        Self::told(observed, priors).map(|told| told.likely[0].0)
    }

    /// The same, with what else it might be.
    pub(super) fn told(observed: &Observed, priors: &Priors) -> Result<Told, ModelError> {
        observed.check()?;
        let least_mm = least_range_mm(observed);
        let all = if observed.places.len() <= MOST_TOGETHER {
            vec![observed.clone()]
        } else {
            std::iter::once(thinned(observed, SPREAD)).chain(blocks(observed)).collect()
        };
        let at = |of: &[Observed], [range, ratio]: [f64; 2], drift: f64| {
            scaled(of, [range.exp(), ratio.exp(), drift], priors)
        };
        // What is narrower than can be told has no height.
        let height_of = |of: &[Observed], place: [f64; 2], drift: f64| match at(of, place, drift) {
            Ok((_, value)) if place[0] >= least_mm.ln() => value,
            _ => f64::NEG_INFINITY,
        };
        // A hill may have two tops: a wide form and a narrow one.
        let far = (priors.range_mm[0] / least_mm).max(1.5);
        let ranges = [0.1, 0.4, 0.7, 1.0, 1.5].map(|power: f64| (least_mm * far.powf(power)).ln());
        let higher = |a: Top, b: Top| if b.1 > a.1 { b } else { a };
        let tops_of = |drift: f64| {
            ranges.map(|range| {
                let places = RATIOS.map(|ratio| [range, ratio.ln()]);
                let seen = places.map(|place| (place, height_of(&all, place, drift)));
                seen.into_iter().fold(([range, 0.0], f64::NEG_INFINITY), higher)
            })
        };
        let climbed = |tops: &[Top], drift: f64| {
            let start = tops.iter().copied().fold(tops[0], higher);
            climb(start.0, [0.15 * far.ln(), 0.7], 0.01, |place| height_of(&all, place, drift))
        };
        let (mut drift, mut tops) = (0.0, tops_of(0.0));
        let mut found = climbed(&tops, drift);
        if !observed.path.is_empty() {
            let drifting =
                told_drift(found, |drift| climbed(&tops_of(drift), drift), |top, drift| climbed(&[top], drift));
            if let Some((told, top)) = drifting {
                (drift, found, tops) = (told, top, tops_of(told));
            }
        }
        let (best, top) = found;
        let at = |of: &[Observed], place: [f64; 2]| at(of, place, drift);
        let height = |of: &[Observed], place: [f64; 2]| height_of(of, place, drift);
        let (hyper, _) = at(&all, best)?;
        let others = tops.into_iter().filter(|(place, of)| top - of < NEAR && (place[0] - best[0]).abs() > APART);
        let others =
            others.map(|(place, _)| climb(place, [0.0, 0.3], 0.05, |[_, ratio]| height(&all, [place[0], ratio])));
        let mut likely = vec![(hyper, 1.0)];
        likely.extend(others.filter_map(|(place, of)| Some((at(&all, place).ok()?.0, (of - top).exp()))));
        // The wide waves by those points alone that see them.
        let (wide, _) = climb(best, [0.3, 0.3], 0.03, |place| height(&all[..1], place));
        let wide = at(&all[..1], wide).map_or(hyper, |(wide, _)| Self { scatter_mm: hyper.scatter_mm, ..wide });
        // By the curvature of the hill along the scatter, whose scale moves with it.
        let beside = |step: f64| at(&all, [best[0], best[1] + step]).unwrap_or((hyper, top));
        let (below, above) = (beside(-STEP), beside(STEP));
        let moved = 0.5 * (above.0.scatter_mm / below.0.scatter_mm).ln();
        let falls = (2.0 * top - below.1 - above.1).max(f64::MIN_POSITIVE);
        Ok(Told { likely, wide, scatter_u: (moved / falls.sqrt()).abs().min(MOST_UNKNOWN) })
    }
}

/// A place of range and ratio, by their logarithms, and how high the likelihood is there.
type Top = ([f64; 2], f64);

/// The drift that is spoken for most, with the top of the likelihood by it; none where it is spoken for by too little more than none.
fn told_drift(without: Top, search: impl Fn(f64) -> Top, climb: impl Fn(Top, f64) -> Top) -> Option<(f64, Top)> {
    let higher = |a: (f64, Top), b: (f64, Top)| if b.1.1 > a.1.1 { b } else { a };
    let mut best = DRIFTS.map(|drift| (drift, search(drift))).into_iter().fold((0.0, without), higher);
    // From there in ever smaller steps: what is near is spoken for by much the same range and ratio.
    for step in DRIFT_STEPS {
        let beside = [best.0 - step, best.0 + step].map(|drift| drift.clamp(0.0, MOST_DRIFT));
        best = beside.map(|drift| (drift, climb(best.1, drift))).into_iter().fold(best, higher);
    }
    (best.1.1 > without.1 + DRIFT_EVIDENCE).then_some(best)
}

/// What speaks for which parameters.
pub(super) struct Told {
    /// The most probable first, with how much more it is spoken for than each other.
    pub(super) likely: Vec<(Hyper, f64)>,
    /// By points all over the part: how strong and how wide its widest waves are.
    pub(super) wide: Hyper,
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
    Observed { deviations_mm, places, effects, path: observed.path_of(block) }
}

impl Hyper {
    /// Returns by how much more what was measured speaks for this field than for none, in the logarithm of the restricted likelihood.
    pub(super) fn evidence(&self, observed: &Observed) -> f64 {
        let few = thinned(observed, MOST_TOGETHER);
        let with = Dense::fit(&few, *self).map_or(f64::NEG_INFINITY, |model| model.log_likelihood());
        // As good as none, and a scatter that suits it best.
        let unit = Self { field: Field { sigma_mm: NO_FIELD, ..self.field }, scatter_mm: 1.0, ..*self };
        let Ok(without) = Dense::fit(&few, unit) else { return f64::INFINITY };
        let squares = without.whitened_squares(&few);
        let free = (few.places.len() - few.effects.ncols()) as f64;
        with - (without.log_likelihood() + 0.5 * squares - 0.5 * free - 0.5 * free * (squares / free).ln())
    }
}

/// A field that forgets itself between two neighbours is no form: what is narrower than this cannot be told from scatter.
fn least_range_mm(observed: &Observed) -> f64 {
    const NEIGHBOURS: f64 = 2.5;
    NEIGHBOURS * spacing_mm(&observed.places)
}

/// The parameters with the scale that suits them best, and the logarithm of their probability. What tells nothing of its plane, such as points
/// on a line, tells nothing here.
fn scaled(told: &[Observed], [range_mm, ratio, drift]: [f64; 3], priors: &Priors) -> Result<(Hyper, f64), ModelError> {
    let unit = Hyper { field: Field { sigma_mm: 1.0, range_mm }, scatter_mm: ratio, drift };
    let (mut value, mut squares, mut free) = (priors.log_density(range_mm, ratio), 0.0, 0.0);
    for (k, observed) in told.iter().enumerate() {
        let model = match Dense::fit(observed, unit) {
            Ok(model) => model,
            Err(error) if k == 0 => return Err(error),
            Err(_) => continue,
        };
        let of = model.whitened_squares(observed);
        value += model.log_likelihood() + 0.5 * of;
        squares += of;
        free += (observed.places.len() - observed.effects.ncols()) as f64;
    }
    // No deviation at all is a field of no strength.
    let sigma_mm = (squares / free).sqrt().max(f64::MIN_POSITIVE.sqrt());
    let hyper = Hyper { field: Field { sigma_mm, range_mm }, scatter_mm: ratio * sigma_mm, drift };
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

/// Climbs to the highest place of two dimensions by a simplex (Nelder and Mead 1965).
///
/// It begins with a simplex of some steps, and ends with one that is smaller than `near`.
pub(super) fn climb(start: [f64; 2], steps: [f64; 2], near: f64, height: impl Fn([f64; 2]) -> f64) -> ([f64; 2], f64) {
    const TURNS: usize = 120;
    let seen = |place: [f64; 2]| (place, height(place));
    let mut corners = [seen(start), seen([start[0] + steps[0], start[1]]), seen([start[0], start[1] + steps[1]])];
    for _ in 0..TURNS {
        corners.sort_by(|a, b| b.1.total_cmp(&a.1));
        let [best, middle, worst] = corners;
        let spread =
            (0..2).map(|k| (best.0[k] - worst.0[k]).abs().max((best.0[k] - middle.0[k]).abs())).fold(0.0, f64::max);
        if spread < near {
            break;
        }
        let centre = [0, 1].map(|k| 0.5 * (best.0[k] + middle.0[k]));
        let along = |factor: f64| [0, 1].map(|k| centre[k] + factor * (centre[k] - worst.0[k]));
        let reflected = seen(along(1.0));
        let replaced = if reflected.1 > best.1 {
            let further = seen(along(2.0));
            if further.1 > reflected.1 { further } else { reflected }
        } else if reflected.1 > middle.1 {
            reflected
        } else {
            let nearer = seen(along(if reflected.1 > worst.1 { 0.5 } else { -0.5 }));
            if nearer.1 <= worst.1.max(reflected.1) {
                for corner in &mut corners[1..] {
                    *corner = seen([0, 1].map(|k| 0.5 * (corner.0[k] + best.0[k])));
                }
                continue;
            }
            nearer
        };
        corners[2] = replaced;
    }
    corners.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((start, f64::NEG_INFINITY))
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
        Observed { places, deviations_mm, effects, path: Vec::new() }
    }

    #[test]
    fn planted_parameters_are_found_again() {
        let planted = Hyper { field: Field { sigma_mm: 5e-3, range_mm: 30.0 }, scatter_mm: 3e-4, drift: 0.0 };
        let (mut sigma, mut range, mut scatter) = (0.0, 0.0, 0.0);
        const PARTS: u32 = 6;
        for seed in 0..PARTS {
            let found = Hyper::of(&drawn(planted, u64::from(seed)), &Priors::of_size(102.0)).unwrap();
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
        Observed { places, deviations_mm, effects, path: (0..n).map(|k| k as f64).collect() }
    }

    #[test]
    fn a_drift_along_the_path_is_found_again_and_none_is_seen_where_there_is_none() {
        for drift in [0.0, 0.7, 0.9] {
            let planted = Hyper { field: Field { sigma_mm: 5e-3, range_mm: 30.0 }, scatter_mm: 3e-4, drift };
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
    fn the_scale_of_everything_is_the_scale_of_what_is_found() {
        let planted = Hyper { field: Field { sigma_mm: 5e-3, range_mm: 30.0 }, scatter_mm: 3e-4, drift: 0.0 };
        let observed = drawn(planted, 1);
        let tenfold =
            Observed { deviations_mm: observed.deviations_mm.iter().map(|d| 10.0 * d).collect(), ..observed.clone() };
        let [a, b] = [observed, tenfold].map(|observed| Hyper::of(&observed, &Priors::of_size(102.0)).unwrap());
        assert!((b.field.sigma_mm / a.field.sigma_mm - 10.0).abs() < 1e-6);
        assert!((b.field.range_mm / a.field.range_mm - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_hill_is_climbed() {
        let hill = |[x, y]: [f64; 2]| -(x - 1.0).powi(2) - 30.0 * (y + 2.0 - 0.3 * x).powi(2);
        let (top, height) = climb([-3.0, 4.0], [0.7, 0.9], 1e-4, hill);
        assert!((top[0] - 1.0).abs() < 1e-3 && (top[1] + 1.7).abs() < 1e-3 && height > -1e-6, "{top:?}");
    }
}
