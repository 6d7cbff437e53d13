//! Kind of noise and field: autocorrelation of the noise from one touch to the next, and anisotropy of the field, each
//! only if neighbouring points give enough evidence.
//!
//! The likelihood is a composite one (Varin, Reid and Firth 2011): of some points all over the part, and of blocks of
//! neighbours, each with an unknown plane of its own. It selects only the kind of field; strength and range follow
//! later from all points together.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::hypotheses::{NoiseKind, size_mm};
use super::nelder_mead::maximize;
use super::{Anisotropy, DensePosterior, Field, Hyperparameters, Observations, Prior, spacing_mm};
use crate::geometry::bounds;

/// Maximum number of points of a block, and maximum number of blocks.
const POINTS_PER_BLOCK: usize = 48;
const MAX_BLOCKS: usize = 24;
/// Maximum number of points that are spread over the whole part.
const SPREAD: usize = 150;
/// Start values of the noise autocorrelation, steps of its refinement, its maximum value, and the minimum gain of the
/// log-likelihood over that without autocorrelation.
const START_AUTOCORRELATIONS: [f64; 3] = [0.3, 0.6, 0.85];
const AUTOCORRELATION_STEPS: [f64; 3] = [0.12, 0.06, 0.03];
const MAX_AUTOCORRELATION: f64 = 0.97;
const MIN_AUTOCORRELATION_EVIDENCE: f64 = 2.0;
/// Logarithm of the stretch at which the search of an anisotropy starts, maximum stretch, and minimum gain of the
/// log-likelihood over that of an isotropic field.
const START_LOG_STRETCH: f64 = 0.6;
const MAX_STRETCH: f64 = 10.0;
const MIN_ANISOTROPY_EVIDENCE: f64 = 4.0;
/// Start values of the search: ranges in spacings of the points, and noise as a ratio to the standard deviation of the
/// field.
const RANGES: [f64; 4] = [3.0, 6.0, 12.0, 24.0];
const RATIOS: [f64; 4] = [0.01, 0.1, 0.6, 3.0];
/// Minimum range in spacings of the points: a narrower field cannot be distinguished from noise.
const MIN_RANGE_SPACINGS: f64 = 2.5;

/// Factor by which the standard deviation of the field can exceed the RMS of the observed deviations (one standard
/// deviation of its logarithm).
const STRONGER: f64 = 2.0;

/// Result of a search: the two variables at the maximum, and the log-likelihood there. The variables are the logarithms
/// of the range and of the noise ratio, except in the search of an anisotropy.
type Maximum = ([f64; 2], f64);

/// Selects the two kinds of noise and field to compare. The first kind has no noise autocorrelation. The second kind
/// has the most likely noise autocorrelation. Each kind has the most likely anisotropy of the field, or none if the
/// points give too little evidence for an anisotropy.
///
/// The second kind is `None` if the points do not follow a path, or if they give too little evidence for an
/// autocorrelation.
pub(super) fn candidates(observed: &Observations) -> (NoiseKind, Option<NoiseKind>) {
    let blocks = CompositeLikelihood::new(observed);
    let plain = blocks.find_maximum(NoiseKind::PLAIN, None);
    let with_lay = |kind: NoiseKind, top: Maximum| NoiseKind {
        anisotropy: blocks.most_likely_anisotropy(kind, top).unwrap_or(Anisotropy::NONE),
        ..kind
    };
    let drifting = if observed.path.is_empty() { None } else { blocks.most_likely_autocorrelation(plain) };
    (with_lay(NoiseKind::PLAIN, plain), drifting.map(|(kind, top)| with_lay(kind, top)))
}

struct CompositeLikelihood {
    all: Vec<Observations>,
    distance_mm: f64,
    /// Prior for any part of this size, and root mean square of the deviations.
    priors: Prior,
    rms_mm: f64,
}

impl CompositeLikelihood {
    /// Prepares the composite likelihood (a product of likelihoods of subsets of the points). Selects the subsets: one
    /// has points all over the part, and each of the others is a block of neighbouring points.
    fn new(observed: &Observations) -> Self {
        let mut whole: Vec<Vec<usize>> = vec![(0..observed.places.len()).collect()];
        let mut done = Vec::new();
        while let Some(mut block) = whole.pop() {
            if block.len() <= POINTS_PER_BLOCK {
                done.push(block);
                continue;
            }
            let [low, high] = bounds(block.iter().map(|&k| observed.places[k]));
            let axis = usize::from(high[1] - low[1] > high[0] - low[0]);
            block.sort_by(|&a, &b| observed.places[a][axis].total_cmp(&observed.places[b][axis]).then(a.cmp(&b)));
            let rest = block.split_off(block.len() / 2);
            whole.extend([block, rest]);
        }
        let every = done.len().div_ceil(MAX_BLOCKS);
        let blocks = done.iter().step_by(every).map(|block| with_plane(observed, block));
        let all = std::iter::once(spread(observed)).chain(blocks).collect();
        let squares: f64 = observed.deviations_mm.iter().map(|d| d * d).sum();
        let n = observed.places.len() as f64;
        let priors = Prior::for_size(size_mm(&observed.places));
        Self { all, distance_mm: spacing_mm(&observed.places), priors, rms_mm: (squares / n).sqrt() }
    }

    /// Returns the composite log-likelihood for the noise and the anisotropy of `kind`, plus the log prior density. The
    /// composite likelihood is a product of the likelihoods of subsets of the points.
    ///
    /// `range` is the logarithm of the range in mm. `ratio` is the logarithm of the standard deviation of the noise
    /// divided by that of the field. The standard deviations of field and noise are scaled together to their most
    /// probable values.
    ///
    /// Returns minus infinity if the points cannot resolve the range, or if no subset can be fitted.
    fn log_likelihood(&self, kind: NoiseKind, [range, ratio]: [f64; 2]) -> f64 {
        if range < (MIN_RANGE_SPACINGS * self.distance_mm).ln() {
            return f64::NEG_INFINITY;
        }
        let field = Field { anisotropy: kind.anisotropy, ..Field::new(1.0, range.exp()) };
        let unit = Hyperparameters { field, noise_sigma_mm: ratio.exp(), noise_autocorrelation: kind.autocorrelation };
        let fit = |block: &Observations| {
            // A block that does not determine its plane, for example points on a line, is left out.
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
        // The prior limits the strength of the field: the points would show almost nothing of a field far stronger than
        // the deviations.
        let sigma_mm = (squares / free).sqrt();
        let beyond = (sigma_mm / self.rms_mm.max(f64::MIN_POSITIVE)).ln().max(0.0) / STRONGER.ln();
        let known = self.priors.log_density(range.exp(), ratio.exp()) - 0.5 * beyond * beyond;
        known + likelihood + 0.5 * squares - 0.5 * free - free * sigma_mm.ln()
    }

    /// Finds the maximum of [`Self::log_likelihood`] for the noise and the anisotropy of `kind`. The two variables are
    /// the logarithm of the range, and the logarithm of the ratio of noise to field. The search starts at the variables
    /// of `near`. With `None`, it starts at the best of several fixed start values.
    fn find_maximum(&self, kind: NoiseKind, near: Option<Maximum>) -> Maximum {
        let start = near.unwrap_or_else(|| {
            let starts =
                RANGES.iter().flat_map(|range| RATIOS.map(|ratio| [(range * self.distance_mm).ln(), ratio.ln()]));
            starts.map(|place| (place, self.log_likelihood(kind, place))).fold(([0.0; 2], f64::NEG_INFINITY), higher)
        });
        maximize(start.0, [0.3, 0.6], 0.05, |place| self.log_likelihood(kind, place))
    }

    /// Finds the most likely noise autocorrelation for an isotropic field. `plain` is the maximum of the log-likelihood
    /// without autocorrelation. Returns the kind of noise with the autocorrelation found, and the maximum of the
    /// log-likelihood for this kind.
    ///
    /// The search first tries the fixed values [`START_AUTOCORRELATIONS`], then refines the best of them. Returns
    /// `None` if the best fixed value raises the maximum of the log-likelihood by less than
    /// [`MIN_AUTOCORRELATION_EVIDENCE`], compared with `plain`.
    fn most_likely_autocorrelation(&self, plain: Maximum) -> Option<(NoiseKind, Maximum)> {
        let of = |drift: f64| NoiseKind { autocorrelation: drift, ..NoiseKind::PLAIN };
        let mut best = (0.0, plain);
        for drift in START_AUTOCORRELATIONS {
            let top = self.find_maximum(of(drift), None);
            if top.1 > best.1.1 {
                best = (drift, top);
            }
        }
        if best.1.1 < plain.1 + MIN_AUTOCORRELATION_EVIDENCE {
            return None;
        }
        for step in AUTOCORRELATION_STEPS {
            for drift in [best.0 - step, best.0 + step].map(|drift| drift.clamp(0.0, MAX_AUTOCORRELATION)) {
                let top = self.find_maximum(of(drift), Some(best.1));
                if top.1 > best.1.1 {
                    best = (drift, top);
                }
            }
        }
        Some((of(best.0), best.1))
    }

    /// Finds the most likely anisotropy of the field for the noise autocorrelation of `kind`. `without` is the maximum
    /// of the log-likelihood for an isotropic field. Returns `None` if an anisotropy raises the log-likelihood by at
    /// most [`MIN_ANISOTROPY_EVIDENCE`].
    fn most_likely_anisotropy(&self, kind: NoiseKind, without: Maximum) -> Option<Anisotropy> {
        // A lay is the same after half a turn, and an isotropic field has no direction. So twice the angle and the
        // logarithm of the stretch are polar coordinates of the search plane.
        let of = |[a, b]: [f64; 2]| Anisotropy::from_angle(0.5 * b.atan2(a), a.hypot(b).exp().min(MAX_STRETCH));
        let height = |place: [f64; 2]| self.log_likelihood(NoiseKind { anisotropy: of(place), ..kind }, without.0);
        let starts = [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]
            .map(|along: [f64; 2]| along.map(|v| v * START_LOG_STRETCH));
        let start = starts.map(|start| (start, height(start))).into_iter().fold(([0.0; 2], without.1), higher);
        if start.0 == [0.0; 2] {
            return None;
        }
        let (place, top) = maximize(start.0, [0.3, 0.3], 0.05, height);
        (top > without.1 + MIN_ANISOTROPY_EVIDENCE).then(|| of(place))
    }
}

fn higher(a: Maximum, b: Maximum) -> Maximum {
    if b.1 > a.1 { b } else { a }
}

/// Returns at most [`SPREAD`] of the points, spread over the whole measurement, with both large and small distances
/// between them. Random effects are left out.
fn spread(observed: &Observations) -> Observations {
    let n = observed.places.len();
    // Steps of the golden section cover the whole sequence evenly, without a repeating pattern.
    let golden = |k: usize| (((k as f64 + 0.5) * 0.618_033_988_749_894_9).fract() * n as f64) as usize;
    let mut chosen: Vec<usize> = if n <= SPREAD { (0..n).collect() } else { (0..SPREAD).map(golden).collect() };
    chosen.sort_unstable();
    chosen.dedup();
    Observations { random_effects: DMatrix::zeros(chosen.len(), 0), ..observed.subset(&chosen) }
}

/// Returns the observations of the points with the indices `block`. The fixed effects of the result are a plane: a
/// constant, x and y, relative to the centroid of the block. The result has no random effects.
fn with_plane(observed: &Observations, block: &[usize]) -> Observations {
    let some = observed.subset(block);
    let middle = [0, 1].map(|axis| some.places.iter().map(|place| place[axis]).sum::<f64>() / block.len() as f64);
    let effects = DMatrix::from_fn(block.len(), 3, |r, c| match c {
        0 => 1.0,
        c => some.places[r][c - 1] - middle[c - 1],
    });
    // The random effects vary slowly: over a block of neighbours they are a plane, which the fixed effects contain.
    Observations { fixed_effects: effects, random_effects: DMatrix::zeros(block.len(), 0), ..some }
}
