//! Repeatable error that other machines learned for a recipe, as a prior for a machine that has not ground it yet.
//!
//! The repeatable error on machine j is R_j = C + D_j: C is common to all machines that grind the same recipe, D_j is
//! the machine's own. Passes on K machines give means m_j of R_j with variances v_j. Each band of wavelengths is
//! separate. With P for the power of R, the mean over the machines of |m_j|^2 - v_j, and k for the share of P that is
//! the machine's own,
//!
//! ```text
//!  t = k P      c = (1 - k) P      w_j = 1 / (t + v_j)
//!  C^ = c sum(w m) / (1 + c sum w)           q = t + c / (1 + c sum w)
//! ```
//!
//! are the best linear prediction of the repeatable error on a machine that has not ground the recipe, and its
//! variance (random effects: Henderson 1975, Robinson 1991). With k = 1 the prediction is 0. With k = 0 and one
//! machine it is that machine's own mean times Wiener's share.
//!
//! **Machine similarity** is estimated from recipes that two machines have both ground: |m_1 - m_2|^2 - v_1 - v_2 is
//! 2 t of that recipe. The n comparisons give a mean of k. The next machine can differ by more, so this mean is
//! widened by 1 + 1/n. If comparisons with this machine itself give a larger k, theirs counts. If all bands of a
//! comparison together give a larger k than one band, it counts too, since in one band a few waves can agree by
//! chance. Without any comparison the similarity of machines is unknown, and nothing is taken over. Nor is anything
//! taken over from machines that have more of their own than in common.
//!
//! **Own evidence prevails.** The prior from other machines weighs as one own pass at most, so it is never narrower.
//! Its remaining share of a mean is stored with the mean: a machine passes on only what its own passes showed.
//! Otherwise the finding of one machine would come back as that of all.

use super::learning::{Band, LearningState, MeanError, RESPONSE_LIMITS, VALUES_PER_INDEPENDENT_VALUE, mean_square};
use crate::geometry::{Grid, GridMap};

/// Minimum ratio of the variance of the mean to the variance of N: the ratio after one pass.
const MIN_VARIANCE_RATIO: f64 = 1.0;
/// Standard deviation of the response between machines that is assumed before any response is known.
const RESPONSE_SIGMA_BETWEEN_MACHINES: f64 = 0.05;
/// Number of machines that [`RESPONSE_SIGMA_BETWEEN_MACHINES`] weighs as.
const PRIOR_MACHINES: f64 = 2.0;
/// Maximum share of the power that is a machine's own; above it machines have next to nothing to share, and can agree
/// by chance.
const MAX_OWN_SHARE: f64 = 0.5;
/// Maximum share of a mean that comes from other machines; above it the mean carries no information on its own
/// machine.
const MAX_BORROWED_SHARE: f64 = 0.5;
/// Maximum plausible repeatable error at any place, in millimetres.
const MAX_MEAN_MM: f64 = 1.0;
/// Maximum number of computation steps of a comparison: nodes times (columns plus rows) times bands.
const MAX_STEPS: f64 = 1e9;
/// Relative difference below which two bands begin at the same wavelength.
const SAME: f64 = 1e-9;

/// Similarity of machines: the share of the repeatable error that is a machine's own, estimated from comparisons of two
/// machines.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MachineSimilarity {
    comparisons: Vec<Comparison>,
}

#[derive(Clone, Debug, PartialEq)]
struct Comparison {
    /// True if one of the two machines is the machine that receives the initial state.
    is_own: bool,
    /// Shortest wavelength of each band, in millimetres, and the share of its power that is the machine's own; `None`
    /// if the band was not comparable.
    shares: Vec<(f64, Option<f64>)>,
    /// The same share for all bands together.
    whole: f64,
}

/// Initial state of a machine that has not ground a recipe.
#[derive(Clone, Debug, PartialEq)]
pub struct TransferredState {
    /// State of the machine, as after passes of its own; [`LearningState::next_correction_mm`] is the correction of its
    /// first pass.
    pub state: LearningState,
    /// For each band taken over: its shortest wavelength, in millimetres, and the assumed rms share of the repeatable
    /// error that is a machine's own.
    pub own_shares: Vec<[f64; 2]>,
}

/// Repeatable error in one band, as the passes of one machine show it.
struct BandEvidence {
    values_mm: Vec<f64>,
    mean_mm2: f64,
    /// Variance of the mean.
    variance_mm2: f64,
    /// Variance of the non-repeatable error of a pass.
    noise_mm2: f64,
}

impl MachineSimilarity {
    /// Adds the estimate of a person as one comparison of machines, valid for all wavelengths. `rms_share` (0 to 1) is
    /// the rms of the part of the repeatable error that only one machine has, divided by the rms of its whole
    /// repeatable error.
    pub fn add_statement(&mut self, rms_share: f64) {
        let share = rms_share * rms_share;
        self.comparisons.push(Comparison { is_own: true, shares: vec![(0.0, Some(share))], whole: share });
    }

    /// Compares the repeatable errors that two machines learned for the same recipe, and stores the comparison. Returns
    /// true if at least one band of wavelengths could be compared. Otherwise stores nothing and returns false, for
    /// example if the bands of the two states differ.
    ///
    /// `is_own` is true if one of the two machines is the machine for which an initial state is required.
    pub fn compare(&mut self, [one, other]: [&LearningState; 2], is_own: bool) -> bool {
        let Some(grid) = one.mean.as_ref().map(|mean| mean.grid) else { return false };
        if !has_same_bands(one, other) {
            return false;
        }
        let [ones, others] = [one, other].map(|known| band_evidence(known, &grid));
        let (mut shares, mut whole) = (Vec::new(), [0.0; 2]);
        for ((band, a), b) in one.bands.iter().zip(ones).zip(others) {
            let compared = a.zip(b).and_then(|(a, b)| own_and_power(&a, &b));
            shares.push((band.min_wavelength_mm, compared.map(|[own_mm2, power_mm2]| (own_mm2 / power_mm2).min(1.0))));
            let [own_mm2, power_mm2] = compared.unwrap_or_default();
            whole = [whole[0] + own_mm2, whole[1] + power_mm2];
        }
        let is_compared = shares.iter().any(|(_, share)| share.is_some());
        if is_compared {
            self.comparisons.push(Comparison { is_own, shares, whole: (whole[0] / whole[1]).min(1.0) });
        }
        is_compared
    }

    /// Returns the number of comparisons. Each statement of a person counts as one.
    pub fn comparisons(&self) -> usize {
        self.comparisons.len()
    }

    /// Returns the expected share of the repeatable error that is specific to one machine and not common to all
    /// machines. The share is a ratio of mean squares, from 0 to 1, for the band of wavelengths that begins at
    /// `from_mm`. Returns `None` if no comparison covers this band.
    ///
    /// The share is the mean over n comparisons, multiplied by 1 + 1/n because few comparisons are uncertain, and
    /// limited to 1. The same value is computed from the comparisons that include the machine for which an initial
    /// state is required. If this second value is larger, it is returned. The statement of a person counts as such a
    /// comparison.
    pub fn own_share(&self, from_mm: f64) -> Option<f64> {
        let all = self.expected_share(from_mm, |_| true)?;
        Some(self.expected_share(from_mm, |of| of.is_own).map_or(all, |own| own.max(all)))
    }

    fn expected_share(&self, from_mm: f64, counts: impl Fn(&Comparison) -> bool) -> Option<f64> {
        let shares: Vec<f64> =
            self.comparisons.iter().filter(|of| counts(of)).filter_map(|of| of.share(from_mm)).collect();
        let n = shares.len() as f64;
        (n > 0.0).then(|| (shares.iter().sum::<f64>() / n * (1.0 + 1.0 / n)).clamp(0.0, 1.0))
    }
}

impl Comparison {
    /// Returns the share of the repeatable error that is specific to one machine, according to this comparison. The
    /// share is a ratio of mean squares, from 0 to 1, for the band that contains the wavelength `from_mm`. The last
    /// band contains all longer wavelengths. If the share for all bands together is larger, returns that share.
    ///
    /// Returns `None` if the two machines could not be compared in this band, or if `from_mm` is shorter than the waves
    /// of the first band.
    fn share(&self, from_mm: f64) -> Option<f64> {
        let (_, share) = self.shares.iter().rev().find(|(from, _)| *from <= from_mm * (1.0 + SAME))?;
        share.map(|share| share.max(self.whole))
    }
}

impl LearningState {
    /// Returns a text with the reason why this state cannot be used for other machines: neither as the source of their
    /// initial state nor for a comparison with their states. Returns `None` if there is no such reason.
    ///
    /// Even a valid state ([`LearningState::is_valid`]) can have such a reason: a learned error without uncertainty, an
    /// implausibly large learned error, or too many nodes.
    pub fn transfer_obstacle(&self) -> Option<String> {
        if self.bands.iter().any(|band| band.variance_ratio.is_some_and(|belief| belief <= 0.0)) {
            return Some("a learned mean error has no uncertainty".into());
        }
        let MeanError { grid, values_mm } = self.mean.as_ref()?;
        let max_mm = values_mm.iter().fold(0.0, |most: f64, v| most.max(v.abs()));
        if max_mm > MAX_MEAN_MM {
            return Some(format!("a learned mean error of {max_mm:.3e} mm, limit {MAX_MEAN_MM} mm"));
        }
        let steps = grid.len() as f64 * (grid.columns + grid.rows) as f64 * self.bands.len() as f64;
        let (columns, rows, bands) = (grid.columns, grid.rows, self.bands.len());
        let reason = || {
            format!("{columns} x {rows} nodes in {bands} bands: {steps:.0e} computation steps, limit {MAX_STEPS:.0e}")
        };
        (steps > MAX_STEPS).then(reason)
    }

    /// Predicts the initial state of a machine that has not ground this recipe, from the states of machines that have
    /// ground it. The method is the best linear unbiased prediction with random effects.
    ///
    /// `self` is the state of the machine before this prediction. `others` holds the states of the other machines,
    /// `alike` the similarity of the machines, and `grid` is the grid of the correction. A band of wavelengths is
    /// predicted only if at least half of the mean square of its repeatable error is common to the machines. The other
    /// bands stay unchanged; [`TransferredState::own_shares`] lists the predicted bands.
    ///
    /// Returns `None` if none of `others` has learned an error in the same bands.
    #[must_use]
    pub fn seeded_from(&self, others: &[&Self], alike: &MachineSimilarity, grid: Grid) -> Option<TransferredState> {
        let others: Vec<&Self> =
            others.iter().copied().filter(|other| other.mean.is_some() && has_same_bands(self, other)).collect();
        if others.is_empty() {
            return None;
        }
        let all: Vec<Vec<Option<BandEvidence>>> = others.iter().map(|other| band_evidence(other, &grid)).collect();
        let mut known = self.clone();
        let mut mean = MeanError { grid, values_mm: vec![0.0; grid.len()] };
        let (mut differ, mut variance_mm2) = (Vec::new(), 0.0);
        let on_grid = zero_error(grid);
        for (k, band) in known.bands.iter_mut().enumerate() {
            let of_band: Vec<&BandEvidence> = all.iter().filter_map(|of| of[k].as_ref()).collect();
            let Some(share) = alike.own_share(band.min_wavelength_mm).filter(|share| *share <= MAX_OWN_SHARE) else {
                continue;
            };
            let Some((values_mm, q)) = predicted(&of_band, share, grid.len()) else { continue };
            let scatter_mm2 = of_band.iter().map(|of| of.noise_mm2).sum::<f64>() / of_band.len() as f64;
            let counts = (VALUES_PER_INDEPENDENT_VALUE * band.independent(&on_grid)).recip();
            band.noise_sums = [counts * scatter_mm2, counts];
            band.variance_ratio = Some((q / scatter_mm2).max(MIN_VARIANCE_RATIO));
            band.transferred_share = 1.0;
            variance_mm2 += q;
            differ.push([band.min_wavelength_mm, share.sqrt()]);
            mean.values_mm.iter_mut().zip(values_mm).for_each(|(sum, value)| *sum += value);
        }
        if !differ.is_empty() {
            // A state with only the means of others carries no information on its own machine.
            let own = |of: &&Vec<Option<BandEvidence>>| of.iter().any(Option::is_some);
            let tell: Vec<&Self> = others.iter().zip(&all).filter(|(_, of)| own(of)).map(|(other, _)| *other).collect();
            known.response = response(&tell, self.response);
            known.whole = whole(&known.whole, &tell, variance_mm2);
            known.next_correction_mm = Some(mean.values_mm.iter().map(|r| -r / known.response[0]).collect());
            known.mean = Some(mean);
        }
        Some(TransferredState { state: known, own_shares: differ })
    }
}

/// Returns, for each of `states`, true if it contradicts most of the others: more than half of its comparisons show that
/// more than [`MAX_OWN_SHARE`] of the repeatable error is a machine's own. All states must be of the same recipe on
/// different machines. Two machines that contradict each other are both named, because nothing tells which of them is
/// right. A state without a comparison contradicts none.
pub fn contradicting_machines(states: &[&LearningState]) -> Vec<bool> {
    let own_share = |one: &LearningState, other: &LearningState| {
        let mut alike = MachineSimilarity::default();
        alike.compare([one, other], false).then(|| alike.comparisons[0].whole)
    };
    let contradicts = |(k, state): (usize, &&LearningState)| {
        let others = states.iter().enumerate().filter(|(j, _)| *j != k);
        let shares: Vec<f64> = others.filter_map(|(_, other)| own_share(state, other)).collect();
        2 * shares.iter().filter(|share| **share > MAX_OWN_SHARE).count() > shares.len()
    };
    states.iter().enumerate().map(contradicts).collect()
}

fn has_same_bands(one: &LearningState, other: &LearningState) -> bool {
    let same = |(a, b): (&Band, &Band)| (a.min_wavelength_mm - b.min_wavelength_mm).abs() <= SAME * a.min_wavelength_mm;
    one.bands.len() == other.bands.len() && one.bands.iter().zip(&other.bands).all(same)
}

/// Returns a map in which every node of `grid` is valid and 0.
fn zero_error(grid: Grid) -> GridMap {
    GridMap::all_valid(grid, vec![0.0; grid.len()])
}

/// Returns, for each band of wavelengths, the repeatable error of a machine at the nodes of `grid`, with its variance.
/// `known` is the state of this machine. The variance excludes the information that came from other machines, so it is
/// larger than the variance in `known`.
///
/// An element is `None` if the machine has learned no error in this band, if the variance in this band is unknown or 0,
/// or if most of the learned error comes from other machines.
fn band_evidence(known: &LearningState, grid: &Grid) -> Vec<Option<BandEvidence>> {
    let Some(mean) = &known.mean else { return known.bands.iter().map(|_| None).collect() };
    let on_grid = zero_error(*grid);
    let parts = known.split_bands(&on_grid, mean.grid.resample(&mean.values_mm, grid));
    let of_band = |(band, values_mm): (&Band, Vec<f64>)| {
        let (belief, scatter_mm2) = band.variance_ratio.zip(band.noise_mm2())?;
        let is_told = scatter_mm2 > 0.0 && band.transferred_share <= MAX_BORROWED_SHARE;
        // The machine's own part of the mean is what remains without the borrowed share, so its variance is larger.
        let variance_mm2 = belief * scatter_mm2 / (1.0 - band.transferred_share).powi(2);
        let mean_mm2 = mean_square(&on_grid.valid, &values_mm);
        is_told.then_some(BandEvidence { values_mm, mean_mm2, variance_mm2, noise_mm2: scatter_mm2 })
    };
    known.bands.iter().zip(parts).map(of_band).collect()
}

/// Compares the repeatable errors `a` and `b` of two machines in one band, and returns two mean squares in mm². The
/// first is that of the part that is specific to one machine, the second that of the whole repeatable error. Each is
/// the average of the two machines, with the noise subtracted.
///
/// Returns `None` if the second mean square is not above 0: then the error does not exceed the noise.
fn own_and_power(a: &BandEvidence, b: &BandEvidence) -> Option<[f64; 2]> {
    let power_mm2 = 0.5 * [a, b].map(|of| of.mean_mm2 - of.variance_mm2).iter().sum::<f64>();
    let apart: f64 = a.values_mm.iter().zip(&b.values_mm).map(|(a, b)| (a - b).powi(2)).sum();
    let apart_mm2 = apart / a.values_mm.len().max(1) as f64;
    let own_mm2 = 0.5 * (apart_mm2 - a.variance_mm2 - b.variance_mm2).max(0.0);
    (power_mm2 > 0.0).then_some([own_mm2, power_mm2])
}

/// Predicts the repeatable error in one band for a machine that has not ground the recipe. Returns the predicted error
/// at each node in millimetres, and its variance in mm².
///
/// `machines` holds the errors of the other machines. `own_share` is the share (0 to 1) of the mean square of the error
/// that is specific to one machine. `nodes` is the number of nodes. Returns `None` if the errors of `machines` do not
/// exceed their noise, or if they have nothing in common (`own_share` is 1).
fn predicted(machines: &[&BandEvidence], own_share: f64, nodes: usize) -> Option<(Vec<f64>, f64)> {
    let power = machines.iter().map(|of| of.mean_mm2 - of.variance_mm2).sum::<f64>() / machines.len().max(1) as f64;
    let (own, common) = (own_share * power, (1.0 - own_share) * power);
    if common.is_nan() || common <= 0.0 {
        return None;
    }
    let weights: Vec<f64> = machines.iter().map(|of| 1.0 / (own + of.variance_mm2)).collect();
    let rest = 1.0 + common * weights.iter().sum::<f64>();
    let mut values_mm = vec![0.0; nodes];
    for (of, weight) in machines.iter().zip(&weights) {
        values_mm.iter_mut().zip(&of.values_mm).for_each(|(sum, value)| *sum += common * weight / rest * value);
    }
    Some((values_mm, own + common / rest))
}

/// Returns the band that holds the estimate for all wavelengths together, for a machine whose initial state is
/// predicted from the machines `others`. `own` is this band of the machine before the prediction. `variance_mm2` is the
/// variance of the predicted error, in mm².
///
/// The result takes the variance of the non-repeatable error from `own`. If `own` has none, the result takes the mean
/// over those of `others` that have one. The result also contains the ratio of `variance_mm2` to this variance, at
/// least [`MIN_VARIANCE_RATIO`]. This ratio is `None` if the variance of the non-repeatable error is unknown or 0.
fn whole(own: &Band, others: &[&LearningState], variance_mm2: f64) -> Band {
    let of_others: Vec<f64> = others.iter().filter_map(|other| other.whole.noise_mm2()).collect();
    let others_mm2 = of_others.iter().sum::<f64>() / of_others.len() as f64;
    let scatter = if own.noise_mm2().is_some() || of_others.is_empty() {
        own.noise_sums
    } else {
        let counts = VALUES_PER_INDEPENDENT_VALUE.recip();
        [counts * others_mm2, counts]
    };
    let with = Band { noise_sums: scatter, ..*own };
    let belief = with.noise_mm2().filter(|n2| *n2 > 0.0).map(|n2| (variance_mm2 / n2).max(MIN_VARIANCE_RATIO));
    Band { variance_ratio: belief, transferred_share: 1.0, ..with }
}

/// Returns the expected response of a machine and its standard uncertainty. The response is the change of the surface
/// divided by the commanded change; 1 is as commanded.
///
/// The result combines the mean response of the machines `others` with the earlier estimate `before`, weighted by
/// inverse variances. `sigma` is the standard uncertainty of `before`. The variance of the mean includes the variance
/// between machines. The response is limited to [`RESPONSE_LIMITS`].
fn response(others: &[&LearningState], [before, sigma]: [f64; 2]) -> [f64; 2] {
    let n = others.len() as f64;
    let mean = others.iter().map(|other| other.response[0]).sum::<f64>() / n;
    let squares: f64 = others.iter().map(|other| (other.response[0] - mean).powi(2)).sum();
    let between = (PRIOR_MACHINES * RESPONSE_SIGMA_BETWEEN_MACHINES.powi(2) + squares) / (PRIOR_MACHINES + n - 1.0);
    let each = others.iter().map(|other| other.response[1].powi(2)).sum::<f64>() / n;
    let [w, v] = [sigma * sigma, between * (1.0 + 1.0 / n) + each / n].map(f64::recip);
    let [least, most] = RESPONSE_LIMITS;
    [((w * before + v * mean) / (w + v)).clamp(least, most), (w + v).sqrt().recip()]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compensation::{Correction, ErrorMap, GainRule, MapOptions, PassObservation};

    const GRID: Grid = Grid { columns: 41, rows: 31, first_mm: [-20.0, -15.0], spacing_mm: [1.0, 1.0] };

    fn fresh(rule: GainRule) -> LearningState {
        LearningState::new(rule, &MapOptions::new(2.5, 1.0), [40.0, 30.0], None)
    }

    /// Returns pseudo-random values of power 1 that are the same for the same seed.
    fn field(seed: u64) -> Vec<f64> {
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(1);
        let mut next = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        (0..GRID.len()).map(|_| 12f64.sqrt() * next()).collect()
    }

    /// Returns the state of a machine with this mean, variance ratio of the mean and noise variance.
    fn machine(rule: GainRule, values_mm: Vec<f64>, [belief, scatter_mm2]: [f64; 2]) -> LearningState {
        let mut known = fresh(rule);
        for band in known.bands.iter_mut().chain([&mut known.whole]) {
            (band.variance_ratio, band.noise_sums) = (Some(belief), [3.0 * scatter_mm2, 3.0]);
        }
        known.mean = Some(MeanError { grid: GRID, values_mm });
        known
    }

    fn similarity_of(rms_share: f64) -> MachineSimilarity {
        let mut alike = MachineSimilarity::default();
        alike.add_statement(rms_share);
        alike
    }

    fn sum(parts: &[(f64, &[f64])]) -> Vec<f64> {
        (0..GRID.len()).map(|k| parts.iter().map(|(factor, of)| factor * of[k]).sum()).collect()
    }

    fn power(values: &[f64]) -> f64 {
        values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64
    }

    #[test]
    fn shared_learning_two_machines_by_hand() {
        // One band; means of a power of 5 and 5, v = 0.5 * 2 = 1: P = 4. A share of 0.25, twice (one comparison):
        // k = 0.5, t = c = 2, w = 1/3, 1 + 2 * 2/3 = 7/3: each mean counts 2/3 / (7/3) = 2/7, q = 2 + 2 * 3/7 = 20/7.
        let flat = |value: f64| machine(GainRule::Adaptive, vec![value; GRID.len()], [0.5, 2.0]);
        let (one, two) = (flat(5f64.sqrt()), flat(-(5f64.sqrt())));
        let begun = |others: &[&LearningState]| {
            fresh(GainRule::Adaptive).seeded_from(others, &similarity_of(0.5), GRID).unwrap()
        };
        let TransferredState { state: known, own_shares: differ } = begun(&[&one, &one]);
        let values = &known.mean.as_ref().unwrap().values_mm;
        assert!(values.iter().all(|v| (v - 4.0 / 7.0 * 5f64.sqrt()).abs() < 1e-12), "{}", values[0]);
        assert!((known.bands[0].variance_ratio.unwrap() - 10.0 / 7.0).abs() < 1e-12, "{:?}", known.bands);
        assert!((differ[0][1] - 0.5f64.sqrt()).abs() < 1e-12 && known.is_valid());
        for (wanted, r) in known.next_correction_mm().unwrap().iter().zip(values) {
            assert_eq!(*wanted, -r / known.response()[0]);
        }
        // Two machines that contradict each other.
        assert!(power(&begun(&[&one, &two]).state.mean.unwrap().values_mm) < 1e-24);
    }

    #[test]
    fn shared_learning_by_machine_similarity() {
        for rule in [GainRule::Adaptive, GainRule::Wavelength] {
            let other = machine(rule, field(1), [0.5, 1e-9]);
            let begun = |alike: &MachineSimilarity| fresh(rule).seeded_from(&[&other], alike, GRID).unwrap();
            for unlike in [similarity_of(1.0), similarity_of(0.51), MachineSimilarity::default()] {
                let TransferredState { state: known, own_shares: differ } = begun(&unlike);
                assert!(differ.is_empty() && known == fresh(rule));
            }
            let TransferredState { state: known, own_shares: differ } = begun(&similarity_of(0.0));
            assert_eq!(differ.len(), known.bands.len());
            for (a, b) in known.mean.unwrap().values_mm.iter().zip(field(1)) {
                assert!((a - b).abs() < 1e-6, "{a} {b}");
            }
        }
    }

    #[test]
    fn machine_similarity_is_recovered() {
        let (common, rule) = (field(7), GainRule::Wavelength);
        for share in [0.0, 0.01, 0.1, 0.5, 1.0f64] {
            let mut alike = MachineSimilarity::default();
            for pair in 0..20 {
                let of = |seed: u64| {
                    let (own, noise) = (field(seed), field(seed + 1000));
                    sum(&[((1.0 - share).sqrt(), &common), (share.sqrt(), &own), (0.05, &noise)])
                };
                // A noise of 0.05 in all, divided between the bands as white noise is.
                let machines = [100 + 2 * pair, 101 + 2 * pair].map(|seed| {
                    let mut known = machine(rule, of(seed), [1.0, 1.0]);
                    let noise = known.split_bands(&zero_error(GRID), sum(&[(0.05, &field(seed + 1000))]));
                    for (band, noise) in known.bands.iter_mut().zip(noise) {
                        band.noise_sums = [power(&noise), 1.0];
                    }
                    known
                });
                assert!(alike.compare([&machines[0], &machines[1]], pair == 0));
            }
            let all = alike.expected_share(2.5, |_| true).unwrap();
            assert!((all / 1.05 - share).abs() < 0.03 + 0.05 * share || all == 1.0 && share == 1.0, "{share}: {all}");
            // The single comparison with this machine itself is widened more.
            assert!(alike.own_share(2.5).unwrap() >= all);
        }
    }

    #[test]
    fn shared_learning_ignores_machine_order() {
        let rule = GainRule::Wavelength;
        let machines: Vec<_> =
            (0..4).map(|k| machine(rule, field(k), [0.3 + 0.2 * k as f64, 1e-2 * (k + 1) as f64])).collect();
        let of = |order: [usize; 4]| {
            let others: Vec<&LearningState> = order.iter().map(|k| &machines[*k]).collect();
            let TransferredState { state: known, own_shares: differ } =
                fresh(rule).seeded_from(&others, &similarity_of(0.5), GRID).unwrap();
            (known.mean.unwrap().values_mm, known.bands, known.response, differ)
        };
        let (values, bands, response, differ) = of([0, 1, 2, 3]);
        let turned = of([3, 1, 0, 2]);
        assert!(values.iter().zip(&turned.0).all(|(a, b)| (a - b).abs() < 1e-12));
        assert!((response[0] - turned.2[0]).abs() < 1e-15 && differ == turned.3);
        for (a, b) in bands.iter().zip(&turned.1) {
            assert!((a.variance_ratio.unwrap() / b.variance_ratio.unwrap() - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn own_passes_outweigh_shared_learning() {
        // However certain the others are.
        let rule = GainRule::Adaptive;
        let other = machine(rule, vec![5.0; GRID.len()], [0.02, 1e-4]);
        let mut known = fresh(rule).seeded_from(&[&other], &similarity_of(0.01), GRID).unwrap().state;
        let mut alone = fresh(rule);
        let none = Correction::zero(GRID, 0.0);
        for pass in 1..=8 {
            let values = field(40 + pass).iter().map(|noise| 4.98 + 0.01 * noise).collect();
            let error = ErrorMap::exact(GRID, values, vec![true; GRID.len()]);
            let seen = PassObservation { correction: &none, error: &error, response: None, explained: None };
            (known, alone) = (known.updated(&seen), alone.updated(&seen));
            let [of, without] = [&known, &alone].map(|of| of.bands[0].variance_ratio.unwrap());
            assert!(of <= without + 1e-12, "pass {pass}: {of} against {without}");
        }
        let [with, without] = [&known, &alone].map(|of| of.gains()[0][1]);
        assert!((with / without - 1.0).abs() < 0.15, "{with} against {without}");
        assert!(known.bands[0].transferred_share < 0.15, "{}", known.bands[0].transferred_share);
        assert!((known.mean.as_ref().unwrap().values_mm[0] - 4.98).abs() < 0.01);
    }

    #[test]
    fn borrowed_learning_is_not_shared() {
        let rule = GainRule::Adaptive;
        let (one, mut told) = (machine(rule, field(1), [0.1, 1e-3]), machine(rule, field(1), [0.1, 1e-3]));
        told.bands[0].transferred_share = 0.9;
        let mut alike = MachineSimilarity::default();
        assert!(!alike.compare([&one, &told], true) && alike.comparisons() == 0);
        let shared = fresh(rule).seeded_from(&[&told], &similarity_of(0.1), GRID).unwrap();
        assert!(shared.own_shares.is_empty());
    }

    #[test]
    fn shared_learning_resamples_other_grids() {
        let (rule, wave) = (GainRule::Wavelength, |[x, y]: [f64; 2]| (0.2 * x).sin() + 0.05 * y);
        let on = |grid: Grid| (0..grid.len()).map(|k| wave(grid.place_mm(k))).collect::<Vec<f64>>();
        let finer = Grid { columns: 81, rows: 61, spacing_mm: [0.5, 0.5], ..GRID };
        let mut other = machine(rule, on(GRID), [0.1, 1e-6]);
        other.mean = Some(MeanError { grid: finer, values_mm: on(finer) });
        let shared = fresh(rule).seeded_from(&[&other], &similarity_of(0.05), GRID).unwrap();
        for (a, b) in shared.state.mean.unwrap().values_mm.iter().zip(on(GRID)) {
            assert!((a - b).abs() < 0.02 * b.abs() + 0.01, "{a} {b}");
        }
        let mut alike = MachineSimilarity::default();
        assert!(alike.compare([&machine(rule, on(GRID), [0.1, 1e-6]), &other], false));
        assert!(alike.own_share(2.5).unwrap() < 1e-3, "{alike:?}");
        // Bands of another cut-off, a machine that has ground nothing, no machine at all.
        let coarse = LearningState::new(rule, &MapOptions::new(4.0, 1.0), [40.0, 30.0], None);
        assert!(coarse.seeded_from(&[&other], &similarity_of(0.05), GRID).is_none());
        assert!(fresh(rule).seeded_from(&[&fresh(rule)], &similarity_of(0.05), GRID).is_none());
        assert!(fresh(rule).seeded_from(&[], &similarity_of(0.05), GRID).is_none());
        assert!(!alike.compare([&coarse, &other], false) && !alike.compare([&other, &coarse], false));
    }

    #[test]
    fn shared_learning_refuses_unfit_state() {
        let honest = machine(GainRule::Wavelength, field(1).iter().map(|v| 1e-3 * v).collect(), [0.3, 1e-8]);
        assert_eq!(honest.transfer_obstacle(), None);
        assert_eq!(fresh(GainRule::Wavelength).transfer_obstacle(), None);
        let mut certain = honest.clone();
        certain.bands[0].variance_ratio = Some(0.0);
        let mut huge = honest.clone();
        huge.mean.as_mut().unwrap().values_mm[7] = 1e200;
        let mut long = honest.clone();
        let grid = Grid { columns: 1_500_000, rows: 1, first_mm: [0.0; 2], spacing_mm: [1e-9, 1.0] };
        long.mean = Some(MeanError { grid, values_mm: vec![0.0; grid.len()] });
        for (state, reason) in [(certain, "no uncertainty"), (huge, "1.000e200 mm"), (long, "1500000 x 1 nodes")] {
            assert!(
                state.is_valid() && state.transfer_obstacle().unwrap().contains(reason),
                "{:?}",
                state.transfer_obstacle()
            );
        }
    }

    #[test]
    fn borrowed_response_is_not_shared() {
        let rule = GainRule::Fixed(1.0);
        let values: Vec<f64> = field(3).iter().map(|v| 1e-3 * v).collect();
        let mut own = machine(rule, values.clone(), [0.3, 1e-8]);
        own.response = [0.9, 0.02];
        let mut borrowed = own.clone();
        borrowed.bands.iter_mut().for_each(|band| band.transferred_share = 0.9);
        let begun = |others: &[&LearningState]| {
            fresh(rule).seeded_from(others, &similarity_of(0.1), GRID).unwrap().state.response
        };
        assert_eq!(begun(&[&own, &borrowed, &borrowed]), begun(&[&own]));
    }

    #[test]
    fn contradicting_machine_is_found() {
        let rule = GainRule::Wavelength;
        let like = |seed: u64, factor: f64| {
            let values = sum(&[(factor, &field(7)), (0.2, &field(seed))]);
            machine(rule, values, [0.5, 1e-9])
        };
        let found = |states: &[LearningState]| contradicting_machines(&states.iter().collect::<Vec<_>>());
        // Their own errors have a share of 0.04 / 1.04 of the power.
        assert_eq!(found(&[like(1, 1.0), like(2, 1.0), like(3, 1.0)]), [false; 3]);
        // Five times as large, of the other sign, of another form, and none at all.
        let other = machine(rule, field(8), [0.5, 1e-9]);
        let none = machine(rule, vec![0.0; GRID.len()], [0.5, 1e-9]);
        for wrong in [like(3, 5.0), like(3, -1.0), other, none] {
            assert_eq!(found(&[like(1, 1.0), wrong.clone(), like(2, 1.0)]), [false, true, false]);
            assert_eq!(found(&[wrong, like(2, 1.0)]), [true; 2], "nothing tells which of two is right");
        }
        // Alone, or without anything to compare.
        assert_eq!((found(&[like(1, 1.0)]), found(&[])), (vec![false], vec![]));
        assert_eq!(found(&[fresh(rule), like(1, 1.0), like(2, 1.0)]), [false; 3]);
    }

    #[test]
    fn bands_without_comparison_not_shared() {
        let compared = |is_own, share, whole| Comparison { is_own, shares: vec![(5.0, Some(share))], whole };
        let mut alike = MachineSimilarity { comparisons: vec![compared(false, 0.02, 0.01)] };
        assert_eq!(alike.own_share(2.5), None);
        // The longest band contains all longer waves, but no band replaces one that was not comparable.
        assert_eq!(alike.own_share(20.0), Some(0.04));
        let shares = vec![(5.0, Some(0.02)), (10.0, None)];
        let short = MachineSimilarity { comparisons: vec![Comparison { is_own: false, shares, whole: 0.01 }] };
        assert_eq!([5.0, 10.0, 20.0].map(|from_mm| short.own_share(from_mm)), [Some(0.04), None, None]);
        // This machine differs from the others by more than they differ from each other.
        alike.comparisons.push(compared(true, 0.3, 0.1));
        assert_eq!(alike.own_share(5.0), Some(0.6));
        // A machine that differs as a whole differs in every band, even if a few waves agree.
        alike.comparisons.push(compared(true, 0.0, 0.4));
        assert!((alike.own_share(5.0).unwrap() - 0.35 * 1.5).abs() < 1e-12);
    }
}
