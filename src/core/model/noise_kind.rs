//! Whether the scatter goes on from a touch to the next, and whether fields are wider along some direction: as far as neighbours speak for it.
//!
//! The likelihood is a composite one (Varin, Reid and Firth 2011): of some points all over the part, and of blocks of neighbours, each with a plane of its
//! own that nobody knows. It chooses
//! a kind of field, and says nothing of how strong or wide it is: that is told by all points together.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::hypotheses::{NoiseKind, size_mm};
use super::nelder_mead::maximize;
use super::{Anisotropy, DensePosterior, Field, Hyperparameters, Observed, Prior, spacing_mm};

/// Blocks of so many neighbours at most, and so many blocks at most.
const POINTS_A_BLOCK: usize = 48;
const MOST_BLOCKS: usize = 24;
/// Points all over the part.
const SPREAD: usize = 150;
/// Drifts at which the search begins, how finely one is told, the most, and by how much one has to be spoken for more than none.
const DRIFTS: [f64; 3] = [0.3, 0.6, 0.85];
const DRIFT_STEPS: [f64; 3] = [0.12, 0.06, 0.03];
const MOST_DRIFT: f64 = 0.97;
const DRIFT_EVIDENCE: f64 = 2.0;
/// The logarithm of the stretch of a lay at which the search begins, the most that is told, and by how much it has to be spoken for.
const FIRST_STRETCH: f64 = 0.6;
const MOST_STRETCHED: f64 = 10.0;
const LAY_EVIDENCE: f64 = 4.0;
/// Where the search of range and ratio begins: in distances of the points, and in strengths of the field.
const RANGES: [f64; 4] = [3.0, 6.0, 12.0, 24.0];
const RATIOS: [f64; 4] = [0.01, 0.1, 0.6, 3.0];
/// No range is below so many distances of the points: what is narrower cannot be told from scatter.
const LEAST_RANGE: f64 = 2.5;

/// By what factor a field may be stronger than what is seen of it (one standard deviation of its logarithm).
const STRONGER: f64 = 2.0;

/// A place of range and ratio, by their logarithms, and the logarithm of the likelihood there.
type Top = ([f64; 2], f64);

/// Tells the kinds of field that the points may speak for: one without a drift, and one with a drift where neighbours speak for it.
pub(super) fn candidates(observed: &Observed) -> (NoiseKind, Option<NoiseKind>) {
    let blocks = CompositeLikelihood::of(observed);
    let plain = blocks.maximum(NoiseKind::PLAIN, None);
    let with_lay = |kind: NoiseKind, top: Top| NoiseKind {
        lay: blocks.most_likely_anisotropy(kind, top).unwrap_or(Anisotropy::NONE),
        ..kind
    };
    let drifting = if observed.path.is_empty() { None } else { blocks.most_likely_autocorrelation(plain) };
    (with_lay(NoiseKind::PLAIN, plain), drifting.map(|(kind, top)| with_lay(kind, top)))
}

struct CompositeLikelihood {
    all: Vec<Observed>,
    distance_mm: f64,
    /// What every part of this size is like, and the root mean square of what was measured.
    priors: Prior,
    rms_mm: f64,
}

impl CompositeLikelihood {
    fn of(observed: &Observed) -> Self {
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
        let blocks = done.iter().step_by(every).map(|block| with_plane(observed, block));
        let all = std::iter::once(spread(observed)).chain(blocks).collect();
        let squares: f64 = observed.deviations_mm.iter().map(|d| d * d).sum();
        let n = observed.places.len() as f64;
        let priors = Prior::for_size(size_mm(&observed.places));
        Self { all, distance_mm: spacing_mm(&observed.places), priors, rms_mm: (squares / n).sqrt() }
    }

    /// The likelihood by a kind of field, its scale the best.
    fn log_likelihood(&self, kind: NoiseKind, [range, ratio]: [f64; 2]) -> f64 {
        if range < (LEAST_RANGE * self.distance_mm).ln() {
            return f64::NEG_INFINITY;
        }
        let field = Field { lay: kind.lay, ..Field::new(1.0, range.exp()) };
        let unit = Hyperparameters { field, noise_sigma_mm: ratio.exp(), noise_autocorrelation: kind.autocorrelation };
        let fit = |block: &Observed| {
            // What tells nothing of its plane, such as points on a line, tells nothing here.
            let model = DensePosterior::fit(block, unit).ok()?;
            Some([
                model.log_likelihood(),
                model.whitened_squares(block),
                (block.places.len() - block.fixed_effects.ncols()) as f64,
            ])
        };
        let told: Vec<[f64; 3]> = self.all.par_iter().filter_map(fit).collect();
        let [likelihood, squares, free] = [0, 1, 2].map(|k| told.iter().map(|of| of[k]).sum::<f64>());
        if told.is_empty() || squares <= 0.0 {
            return f64::NEG_INFINITY;
        }
        // A field far stronger than what is seen would be one of which the points show next to nothing.
        let sigma_mm = (squares / free).sqrt();
        let beyond = (sigma_mm / self.rms_mm.max(f64::MIN_POSITIVE)).ln().max(0.0) / STRONGER.ln();
        let known = self.priors.log_density(range.exp(), ratio.exp()) - 0.5 * beyond * beyond;
        known + likelihood + 0.5 * squares - 0.5 * free - free * sigma_mm.ln()
    }

    fn maximum(&self, kind: NoiseKind, near: Option<Top>) -> Top {
        let start = near.unwrap_or_else(|| {
            let starts =
                RANGES.iter().flat_map(|range| RATIOS.map(|ratio| [(range * self.distance_mm).ln(), ratio.ln()]));
            starts.map(|place| (place, self.log_likelihood(kind, place))).fold(([0.0; 2], f64::NEG_INFINITY), higher)
        });
        maximize(start.0, [0.3, 0.6], 0.05, |place| self.log_likelihood(kind, place))
    }

    /// The drift that is spoken for most, where it is by enough more than none.
    fn most_likely_autocorrelation(&self, plain: Top) -> Option<(NoiseKind, Top)> {
        let of = |drift: f64| NoiseKind { autocorrelation: drift, ..NoiseKind::PLAIN };
        let mut best = (0.0, plain);
        for drift in DRIFTS {
            let top = self.maximum(of(drift), None);
            if top.1 > best.1.1 {
                best = (drift, top);
            }
        }
        if best.1.1 < plain.1 + DRIFT_EVIDENCE {
            return None;
        }
        for step in DRIFT_STEPS {
            for drift in [best.0 - step, best.0 + step].map(|drift| drift.clamp(0.0, MOST_DRIFT)) {
                let top = self.maximum(of(drift), Some(best.1));
                if top.1 > best.1.1 {
                    best = (drift, top);
                }
            }
        }
        Some((of(best.0), best.1))
    }

    /// The lay of the field, where it is spoken for by enough more than none.
    fn most_likely_anisotropy(&self, kind: NoiseKind, without: Top) -> Option<Anisotropy> {
        // A lay turns, and none has none: twice its angle and the logarithm of its stretch are the polar coordinates of a plane.
        let of = |[a, b]: [f64; 2]| Anisotropy::at(0.5 * b.atan2(a), a.hypot(b).exp().min(MOST_STRETCHED));
        let height = |place: [f64; 2]| self.log_likelihood(NoiseKind { lay: of(place), ..kind }, without.0);
        let starts =
            [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]].map(|along: [f64; 2]| along.map(|v| v * FIRST_STRETCH));
        let start = starts.map(|start| (start, height(start))).into_iter().fold(([0.0; 2], without.1), higher);
        if start.0 == [0.0; 2] {
            return None;
        }
        let (place, top) = maximize(start.0, [0.3, 0.3], 0.05, height);
        (top > without.1 + LAY_EVIDENCE).then(|| of(place))
    }
}

fn higher(a: Top, b: Top) -> Top {
    if b.1 > a.1 { b } else { a }
}

/// Some of the points, far from each other and near.
fn spread(observed: &Observed) -> Observed {
    let n = observed.places.len();
    // Steps of the golden section go everywhere and repeat nothing.
    let golden = |k: usize| (((k as f64 + 0.5) * 0.618_033_988_749_894_9).fract() * n as f64) as usize;
    let mut chosen: Vec<usize> = if n <= SPREAD { (0..n).collect() } else { (0..SPREAD).map(golden).collect() };
    chosen.sort_unstable();
    chosen.dedup();
    Observed { random_effects: DMatrix::zeros(chosen.len(), 0), ..observed.subset(&chosen) }
}

fn with_plane(observed: &Observed, block: &[usize]) -> Observed {
    let some = observed.subset(block);
    let middle = [0, 1].map(|axis| some.places.iter().map(|place| place[axis]).sum::<f64>() / block.len() as f64);
    let effects = DMatrix::from_fn(block.len(), 3, |r, c| match c {
        0 => 1.0,
        c => some.places[r][c - 1] - middle[c - 1],
    });
    // What is stated is wide: beside neighbours it is a plane.
    Observed { fixed_effects: effects, random_effects: DMatrix::zeros(block.len(), 0), ..some }
}
