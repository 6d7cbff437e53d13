//! Repeatable error of the grinder, learned pass by pass, and the share of it to compensate.
//!
//! A measured error is e = R + s u + N. R is the repeatable error, the same in every pass. u is the correction, and s
//! is the response: the share of u that the part answers with. N is the non-repeatable error (noise) of grinder and
//! measurement: it is new in every pass, and nothing can compensate it. A correction that takes back all of e grinds
//! the N of the last pass into the next one. So every pass gives an observation e - s u = R + N. R is estimated from
//! all of them in two steps, separately for each band of wavelengths: one octave each, from the cut-off up.
//!
//! A Kalman filter estimates the mean. With p for the variance of the mean over that of N, the gain g of the newest
//! pass and the variance p' afterwards are
//!
//! ```text
//!  g = p / (1 + p)        p' = p / (1 + p) + q
//! ```
//!
//! Without prior knowledge (p without bound) the gains are 1, 1/2, 1/3, those of a plain mean, which leaves
//! N sqrt(1 + 1/k) after k passes. The process noise q keeps the filter responsive to a machine that drifts. When the
//! estimate of s improves, the mean is scaled so that its correction stays the same. Otherwise a small error of s would
//! multiply all of R and be ground in; this way it multiplies only the error that is still measured.
//!
//! Then the mean m is shrunk by Wiener's share, 1 - p' |N|^2 / |m|^2: where nothing exceeds the noise, nothing is
//! taken back. The differences between passes give |N|^2. Before there are any, and unless |N|^2 is stated, only the
//! noise of the points is known, and its share of each band follows from the filter. If the noise is stated for all
//! bands together, each band gets an equal part of it until passes give their own estimate. This part is only a mean,
//! so the share is then the average over all noise variances with this mean, exponentially distributed (the
//! distribution of maximum entropy for a given mean): with c = |m|^2 / (p' |N|^2), 1 - (1 - exp(-c)) / c.

use regrind_figures::{Forecast, PartResponse};
use serde::{Deserialize, Serialize};

use super::correction::Correction;
use super::filter::FilterOrder;
use super::map::{ErrorMap, MapOptions, filter_grid};
use super::response::Response;
use crate::geometry::{Grid, GridMap};

/// Process noise q of one pass: increase of the variance of the estimate of R, relative to the variance of N.
const PROCESS_NOISE: f64 = 0.02;
/// Process noise between two parts, in the same ratio. It allows for another blank, a newly dressed wheel, and a
/// machine that has cooled.
const PROCESS_NOISE_TO_NEXT_PART: f64 = 0.3;
/// Threshold for a change of the machine: number of standard deviations by which the mean square of the innovation
/// exceeds its expectation. Below it the innovation counts as noise.
const CHANGED_SIGMAS: f64 = 6.0;
/// Number of correlated values of the noise that carry as much information as one independent value. The noise is
/// correlated over longer distances than the shortest waves.
pub(super) const VALUES_PER_INDEPENDENT_VALUE: f64 = 4.0;
/// Standard uncertainty of the response s before the first measured response.
const RESPONSE_SIGMA: f64 = 0.1;
/// Standard uncertainty of the response s that a change to another part adds in quadrature.
const RESPONSE_SIGMA_OF_NEXT_PART: f64 = 0.02;
/// Range of credible responses. A response outside it has other causes than the correction and is ignored.
pub(super) const RESPONSE_LIMITS: [f64; 2] = [0.5, 1.5];

/// Rule for the gain: the share of an error that the correction takes back.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum GainRule {
    /// Constant gain on the newest error: the value.
    #[cfg_attr(feature = "schema", schemars(skip))]
    Fixed(f64),
    /// One gain for all wavelengths, estimated from the repeatable and the non-repeatable error of the passes.
    Adaptive,
    /// One gain for each octave of wavelengths, estimated in the same way.
    #[default]
    Wavelength,
}

/// State of the estimate in one band of wavelengths.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Band {
    /// Shortest wavelength of the band, in millimetres.
    #[serde(rename = "from_mm")]
    pub(super) min_wavelength_mm: f64,
    /// Ratio p of the variance of the mean to the variance of N; `None` before the first estimate.
    #[serde(rename = "belief")]
    pub(super) variance_ratio: Option<f64>,
    /// Weighted sum of the estimates of the variance of N, in square millimetres, and sum of their weights.
    #[serde(rename = "scatter")]
    pub(super) noise_sums: [f64; 2],
    /// Weight of the newest pass in the mean: the Kalman gain g.
    #[serde(rename = "gain")]
    pub(super) kalman_gain: f64,
    /// Share of the mean that remains after shrinkage, from 0 to 1.
    #[serde(rename = "share")]
    pub(super) shrinkage: f64,
    /// True if the innovation of the last pass was treated as a change of the machine.
    pub(super) changed: bool,
    /// Share of the mean that still comes from other machines; it is no evidence of this machine.
    #[serde(rename = "borrowed", default, skip_serializing_if = "is_zero")]
    pub(super) transferred_share: f64,
}

/// Weighted mean of the observations of R, on the grid of the correction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct MeanError {
    #[serde(rename = "net")]
    pub(super) grid: Grid,
    pub(super) values_mm: Vec<f64>,
}

/// State of the estimate of the repeatable error.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LearningState {
    rule: GainRule,
    /// Response (change of the surface over change of the correction) and its standard uncertainty.
    pub(super) response: [f64; 2],
    /// Bands from the shortest waves to the longest.
    pub(super) bands: Vec<Band>,
    /// Estimate for all wavelengths together. It is separate because the bands overlap: the sum of their noise
    /// variances is not the variance of the whole.
    pub(super) whole: Band,
    /// Number of passes that this state was learned from.
    passes: u32,
    /// Estimate of R, on the grid of the correction.
    pub(super) mean: Option<MeanError>,
    /// Correction of the next pass, in millimetres, on the grid of the correction; `None` before a pass of this part.
    #[serde(skip)]
    pub(super) next_correction_mm: Option<Vec<f64>>,
}

/// One measured pass.
#[derive(Clone, Copy)]
pub struct PassObservation<'a> {
    /// Correction that the pass was ground with.
    pub correction: &'a Correction,
    /// Error that the pass left.
    pub error: &'a ErrorMap,
    /// Response of the part to the change of the correction; `None` for the first pass.
    pub response: Option<Response>,
    /// Function that extracts the part of a repeatable error that parameters and slides of the machine explain;
    /// `None` if these are not estimated.
    pub explained: Option<ParameterExplainer<'a>>,
}

/// Function of values at the nodes of the correction, in millimetres, that returns the part of them that parameters
/// and slides of the machine explain, at the same nodes.
pub type ParameterExplainer<'a> = &'a (dyn Fn(&[f64]) -> Vec<f64> + Sync);

impl LearningState {
    /// Creates the initial state for a recipe, before any pass. The repeatable error (the error that is the same in
    /// every pass) is unknown. The response (the change of the surface divided by the commanded change of the
    /// correction) starts at 1.
    ///
    /// `rule` selects how the gain is computed. The cut-off wavelength of `map` is the shortest wavelength of the
    /// state. With [`GainRule::Wavelength`], the wavelengths from this cut-off up to half of the longer side of the
    /// part are divided into bands of one octave each. With any other rule there is one band. `size_mm` is the extent
    /// of the part along x and y.
    ///
    /// `repeatability_mm` is the rms of the non-repeatable error of a pass (grinding and measuring), or `None` if this
    /// rms is unknown. The mean square `repeatability_mm`^2 is divided equally between the bands.
    pub fn new(rule: GainRule, map: &MapOptions, size_mm: [f64; 2], repeatability_mm: Option<f64>) -> Self {
        let mut edges = vec![map.cutoff_mm];
        if rule == GainRule::Wavelength {
            let longest_mm = size_mm[0].max(size_mm[1]) / 2.0;
            let octave = |from: &f64| Some(2.0 * from).filter(|next| *next < longest_mm);
            edges = std::iter::successors(Some(map.cutoff_mm), octave).collect();
        }
        let count = edges.len() as f64;
        let band = |from_mm: f64, share: f64, passes: f64| {
            let scatter = repeatability_mm.map_or([0.0; 2], |rms| [passes * rms * rms * share, passes]);
            Band {
                min_wavelength_mm: from_mm,
                variance_ratio: None,
                noise_sums: scatter,
                kalman_gain: 1.0,
                shrinkage: 1.0,
                changed: false,
                transferred_share: 0.0,
            }
        };
        let whole = band(map.cutoff_mm, 1.0, 1.0);
        // Its division between several bands is unknown, so in each band it weighs as one of the many values of a
        // pass.
        let stated = |from_mm: f64| match rule {
            GainRule::Wavelength => {
                (VALUES_PER_INDEPENDENT_VALUE * independent_values(size_mm[0] * size_mm[1], from_mm)).recip()
            }
            GainRule::Fixed(_) | GainRule::Adaptive => 1.0,
        };
        let bands = edges.into_iter().map(|from_mm| band(from_mm, 1.0 / count, stated(from_mm)));
        Self {
            rule,
            response: [1.0, RESPONSE_SIGMA],
            bands: bands.collect(),
            whole,
            passes: 0,
            mean: None,
            next_correction_mm: None,
        }
    }

    /// Returns the state after the measured pass `seen`. The new state contains the updated estimate of the repeatable
    /// error. [`Self::next_correction_mm`] of the new state gives the next correction.
    ///
    /// The response in `seen` compares the measured change of the surface with the commanded change. If this response
    /// shows that the pass was not ground as commanded (for example mirrored), all estimates stay unchanged. The next
    /// correction is then the same as the correction of this pass.
    pub fn updated(&self, seen: &PassObservation) -> Self {
        let mut known = self.clone();
        if seen.response.is_some_and(|answer| !matches!(answer.kind, PartResponse::Expected | PartResponse::Unclear)) {
            known.next_correction_mm = Some(seen.correction.apparent_mm().into_owned());
            return known;
        }
        // All learned values are on the grid of the correction, so only the measured error is interpolated. It becomes
        // smaller from pass to pass, and with it the error of the interpolation.
        let told = seen.error.nodes.resample(seen.correction.grid);
        if let Some(answer) = seen.response.filter(|answer| answer.kind == PartResponse::Expected) {
            known.response = combine_responses(self.response, &answer, self.bands[0].independent(&told));
        }
        let response = known.response[0];
        let mut mean = MeanError::resampled(self.mean.as_ref(), told.grid, response / self.response[0]);
        let u = seen.correction.apparent_mm();
        let news: Vec<f64> =
            told.values_mm.iter().zip(u.iter()).zip(&mean.values_mm).map(|((e, u), m)| e - response * u - m).collect();
        known.whole.update(mean_square(&told.valid, &news), known.whole.independent(&told));
        for (band, news) in known.bands.iter_mut().zip(self.split_bands(&told, news)) {
            band.update(mean_square(&told.valid, &news), band.independent(&told));
            add(&mut mean.values_mm, band.kalman_gain, &news);
        }
        // All points together determine the smooth part: it is used in full, and the bands shrink only the rest.
        let mut believed = seen.explained.map_or_else(|| vec![0.0; told.grid.len()], |smooth| smooth(&mean.values_mm));
        let rest: Vec<f64> = mean.values_mm.iter().zip(&believed).map(|(mean, smooth)| mean - smooth).collect();
        let noise = known.band_noise_mm2(points_noise_mm2(seen.error));
        for ((band, mean), noise_mm2) in known.bands.iter_mut().zip(self.split_bands(&told, rest)).zip(noise) {
            band.shrink(mean_square(&told.valid, &mean), noise_mm2);
            add(&mut believed, band.shrinkage, &mean);
        }
        known.next_correction_mm = Some(match self.rule {
            GainRule::Fixed(share) => {
                let last = u.iter().zip(&told.values_mm);
                last.map(|(u, e)| u - share / response * e).collect()
            }
            GainRule::Adaptive | GainRule::Wavelength => believed.iter().map(|r| -r / response).collect(),
        });
        known.mean = Some(mean);
        known.passes += 1;
        known
    }

    /// Returns the correction of the next pass at each node of the grid of the last correction, in millimetres. Returns
    /// `None` if no pass of this part has been processed and no state of another machine was taken over.
    pub fn next_correction_mm(&self) -> Option<&[f64]> {
        self.next_correction_mm.as_deref()
    }

    /// Returns the state for the start of the next part of the same recipe. The new state contains the learned
    /// repeatable error and the learned response (the change of the surface divided by the commanded change). Both have
    /// a larger uncertainty than before. The new state has no next correction, because the next correction belongs to
    /// the previous part.
    pub fn for_next_part(&self) -> Self {
        let mut known = self.clone();
        for band in known.bands.iter_mut().chain([&mut known.whole]) {
            band.variance_ratio = band.variance_ratio.map(|belief| belief + PROCESS_NOISE_TO_NEXT_PART);
            band.changed = false;
        }
        known.response[1] = known.response[1].hypot(RESPONSE_SIGMA_OF_NEXT_PART);
        known.next_correction_mm = None;
        known
    }

    /// Forecasts the rms of the error after the next pass, in millimetres, with the standard deviation of this rms. The
    /// result also contains the lowest rms that any correction can reach. This lowest rms is `None` if the
    /// non-repeatable error is unknown.
    ///
    /// `error` is the map measured after the last pass. `scallops_mm` is the rms of the scallops (grooves between the
    /// tracks of the wheel), in millimetres.
    ///
    /// The forecast includes structure that is too fine for the map: noise of the points, and scallops. If the probe
    /// reaches the bottom of the grooves, the residuals of the map already contain the scallops. So the forecast uses
    /// the larger of the rms of the residuals and `scallops_mm`, not their sum.
    pub fn forecast(&self, error: &ErrorMap, scallops_mm: f64) -> Forecast {
        let rest2 = error.residual_sigma_mm.max(scallops_mm).powi(2);
        let (mut left2, mut scatter2, mut independent) = (0.0, 0.0, 0.0);
        let told = &error.nodes;
        let noise = self.band_noise_mm2(points_noise_mm2(error));
        for ((band, values), noise_mm2) in
            self.bands.iter().zip(self.split_bands(told, told.values_mm.clone())).zip(noise)
        {
            let seen2 = mean_square(&told.valid, &values);
            let [n2, taken] = [band.noise_mm2().unwrap_or(noise_mm2), self.compensated_share(band)];
            // Sum of: the repeatable error that is not compensated, the noise that the correction grinds in, the
            // noise of the next pass, and the error from the uncertainty of the response.
            let left = match (self.rule, band.noise_mm2(), band.variance_ratio) {
                (GainRule::Adaptive | GainRule::Wavelength, Some(_), Some(belief)) => {
                    n2 * (1.0 + band.shrinkage * belief)
                }
                _ => (1.0 - taken).powi(2) * (seen2 - n2).max(0.0) + n2 * (1.0 + taken * taken),
            };
            left2 += left + seen2 * (taken * self.response[1]).powi(2);
            scatter2 += n2;
            independent += band.independent(told);
        }
        // Bands overlap, so their mean squares do not add up to that of the whole; the ratio of the noise corrects
        // for this.
        let whole2 = self.whole.noise_mm2().unwrap_or(scatter2);
        let in_common = if scatter2 > 0.0 { whole2 / scatter2 } else { 1.0 };
        let rms_mm = (rest2 + in_common * left2).sqrt();
        // The rms of m independent values varies by 1 / sqrt(2 m), relatively. While N is a guess, so is the
        // forecast.
        let known = self
            .bands
            .iter()
            .all(|band| band.noise_sums[1] > 0.0 && !(band.is_guessed() && band.transferred_share > 0.0));
        let relative = if known { 1.0 / (2.0 * independent).sqrt() } else { 0.5 };
        Forecast { rms_mm, sigma_mm: relative * rms_mm, floor_mm: known.then(|| (rest2 + whole2).sqrt()) }
    }

    /// Returns a pair `[min_wavelength_mm, gain]` for each band of wavelengths, from the shortest waves to the longest.
    /// `min_wavelength_mm` is the shortest wavelength of the band in millimetres. `gain` is the share of the newest
    /// error that the next correction compensates in this band; 1 compensates all of the error.
    pub fn gains(&self) -> Vec<[f64; 2]> {
        self.bands.iter().map(|band| [band.min_wavelength_mm, self.compensated_share(band)]).collect()
    }

    /// Returns the share of the newest error that the next correction compensates in `band`, the estimate for one band
    /// of wavelengths. For [`GainRule::Fixed`] the share is the gain that the rule contains. For the other rules the
    /// share is from 0 to 1. It is the Kalman gain times the Wiener share (the share of the learned mean error that
    /// remains after it was reduced for its noise).
    fn compensated_share(&self, band: &Band) -> f64 {
        if let GainRule::Fixed(share) = self.rule { share } else { band.kalman_gain * band.shrinkage }
    }

    /// Returns the response and its standard uncertainty. The response is the change of the surface divided by the
    /// commanded change of the correction; 1 is as commanded.
    pub fn response(&self) -> [f64; 2] {
        self.response
    }

    /// Returns the rms of the non-repeatable error of a pass (grinding and measuring), in millimetres. The value was
    /// given at the start, taken from other machines, or estimated from at least two passes. Returns `None` if there is
    /// no such value yet.
    pub fn repeatability_mm(&self) -> Option<f64> {
        self.whole.noise_mm2().map(f64::sqrt)
    }

    /// Returns the number of passes that this state was learned from.
    pub fn passes(&self) -> u32 {
        self.passes
    }

    /// Returns true if every number is in its valid range and the sizes of the grids and vectors agree. Call it for a
    /// state that was read from a file.
    pub fn is_valid(&self) -> bool {
        let number = |v: f64| v.is_finite() && v >= 0.0;
        let [least, most] = RESPONSE_LIMITS;
        let of_band = |b: &Band| {
            number(b.min_wavelength_mm)
                && b.min_wavelength_mm > 0.0
                && b.noise_sums.iter().all(|v| number(*v))
                && number(b.kalman_gain)
                && number(b.shrinkage)
                && (0.0..=1.0).contains(&b.transferred_share)
        };
        let of_mean = |m: &MeanError| {
            m.grid.is_valid() && m.values_mm.len() == m.grid.len() && m.values_mm.iter().all(|v| v.is_finite())
        };
        (least..=most).contains(&self.response[0])
            && number(self.response[1])
            && self.mean.as_ref().is_none_or(of_mean)
            && (1..=32).contains(&self.bands.len())
            && self.bands.iter().chain([&self.whole]).all(|b| of_band(b) && b.variance_ratio.is_none_or(number))
            && self.bands.windows(2).all(|w| w[0].min_wavelength_mm < w[1].min_wavelength_mm)
    }

    /// Splits the map `rest` into bands of wavelengths. `rest` has one value for each node. Returns one map for each
    /// band of this state, from the shortest waves to the longest. The sum of the returned maps is `rest`.
    ///
    /// `told` gives the grid of `rest` and the nodes that are valid. The values in `told` are not used.
    pub(super) fn split_bands(&self, told: &GridMap, mut rest: Vec<f64>) -> Vec<Vec<f64>> {
        let mut parts = Vec::with_capacity(self.bands.len());
        let whole = GridMap { grid: told.grid, values_mm: rest.clone(), valid: told.valid.clone() };
        for longer in &self.bands[1..] {
            let smooth = low_pass(&whole, longer.min_wavelength_mm);
            parts.push(rest.iter().zip(&smooth).map(|(value, smooth)| value - smooth).collect());
            rest = smooth;
        }
        parts.push(rest);
        parts
    }

    /// Returns the mean square of the noise in each band of an error map, in mm², from the shortest waves to the
    /// longest. This noise comes from the noise of the measured points. `whole_mm2` is the mean square of the noise in
    /// the unsplit map, in mm².
    ///
    /// Equation: white noise after a Gaussian low-pass filter of width s has a mean square proportional to 1 / s^2. A
    /// band is the difference of two low-pass filters of the widths s and t, one for each end of the band. Its mean
    /// square is proportional to 1 / s^2 + 1 / t^2 - 4 / (s^2 + t^2). The last band is a single low-pass filter: 1 /
    /// s^2.
    ///
    /// The map has already passed the filter with the shortest cut-off, and this filter has the width 1. A second
    /// filter with the cut-off ratio w (its cut-off divided by the shortest cut-off) gives the total width s^2 = 1 +
    /// w^2. At the short end of the first band there is no second filter, so s^2 = 1.
    ///
    /// The result applies far from edges. Near the border, the longest waves can contain up to twice as much noise.
    fn band_noise_mm2(&self, whole_mm2: f64) -> Vec<f64> {
        let first2 = self.bands[0].min_wavelength_mm.powi(2);
        let width2 = |k: usize| if k == 0 { 1.0 } else { 1.0 + self.bands[k].min_wavelength_mm.powi(2) / first2 };
        let last = self.bands.len() - 1;
        let between = |k: usize| 1.0 / width2(k) + 1.0 / width2(k + 1) - 4.0 / (width2(k) + width2(k + 1));
        (0..=last).map(|k| whole_mm2 * if k == last { 1.0 / width2(k) } else { between(k) }).collect()
    }
}

impl MeanError {
    /// Returns the learned mean error at the nodes of `grid`: the values of `mean`, interpolated bilinearly to these
    /// nodes and multiplied by `factor`. If `mean` is already on this grid, its values are not interpolated. If `mean`
    /// is `None`, all values are 0.
    fn resampled(mean: Option<&Self>, grid: Grid, factor: f64) -> Self {
        let mut values_mm = mean.map_or_else(|| vec![0.0; grid.len()], |m| m.grid.resample(&m.values_mm, &grid));
        values_mm.iter_mut().for_each(|value| *value *= factor);
        Self { grid, values_mm }
    }
}

impl Band {
    pub(super) fn noise_mm2(&self) -> Option<f64> {
        let [sum, count] = self.noise_sums;
        (count > 0.0).then(|| sum / count)
    }

    /// Returns true if the noise variance of this band is known only by an assumption. Such a variance is an equal part
    /// of one value that was given for all bands together, or it comes from other machines. The total weight of the
    /// estimates of the variance is then above 0 and below 1, where a full estimate from a pass has the weight 1.
    /// Returns false if the variance is unknown.
    fn is_guessed(&self) -> bool {
        self.noise_sums[1] > 0.0 && self.noise_sums[1] < 1.0
    }

    /// Updates the Kalman filter of this band after a pass: the noise variance, the Kalman gain, and the variance of
    /// the mean error. `news_mm2` is the mean square, in mm², of the innovation (the observed error minus its
    /// prediction) in this band. `independent` is the number of independent values in this mean square.
    ///
    /// If the innovation is much larger than expected, the machine is treated as changed, and the gain becomes larger.
    /// If this happens in two consecutive passes, the noise variance is treated as too small and is replaced.
    fn update(&mut self, news_mm2: f64, independent: f64) {
        let expected = self.variance_ratio.zip(self.noise_mm2()).map(|(belief, n2)| (1.0 + belief) * n2);
        let changed = 1.0 + CHANGED_SIGMAS * (2.0 / independent * (1.0 + 1.0 / self.noise_sums[1].max(1.0))).sqrt();
        let stands_out = expected.is_some_and(|expected| news_mm2 > changed * expected);
        match self.variance_ratio {
            // This exceeds the known noise: the machine has changed, and the earlier estimate of R counts for little.
            Some(_) if stands_out && !self.changed => {
                self.variance_ratio =
                    self.noise_mm2().map(|n2| news_mm2 / n2 - 1.0).filter(|belief| belief.is_finite());
            }
            // A second outlying pass is no change: the noise was underestimated.
            Some(belief) if stands_out => self.noise_sums = [news_mm2 / (1.0 + belief), 1.0],
            Some(belief) => {
                // The uncertainty of a mean from other machines is a guess, and so is the noise that remains after
                // it.
                let counts = (1.0 + self.transferred_share * belief).powi(-2);
                self.noise_sums[0] += counts * news_mm2 / (1.0 + belief);
                self.noise_sums[1] += counts;
            }
            None => {}
        }
        self.changed = stands_out && !self.changed;
        self.kalman_gain = self.variance_ratio.map_or(1.0, |p| p / (1.0 + p));
        self.variance_ratio = Some(self.kalman_gain + PROCESS_NOISE);
        self.transferred_share *= 1.0 - self.kalman_gain;
    }

    /// Computes the Wiener share of this band, from 0 to 1, and stores it in `shrinkage`. The next correction uses this
    /// share of the learned mean error.
    ///
    /// Equation: with c = `mean_mm2` / v, the share is 1 - 1 / c, at least 0. If the noise variance is only an
    /// assumption, the share is 1 - (1 - exp(-c)) / c. Here v is the variance of the mean error: the variance of the
    /// non-repeatable error times the variance ratio of this band (1 if the ratio is unknown).
    ///
    /// `mean_mm2` is the mean square of the mean error in this band, in mm². `noise_mm2` is the mean square of the
    /// noise of the measured points in this band, in mm². It replaces the variance of the non-repeatable error if this
    /// variance is unknown.
    fn shrink(&mut self, mean_mm2: f64, noise_mm2: f64) {
        let of_mean_mm2 = self.noise_mm2().unwrap_or(noise_mm2) * self.variance_ratio.unwrap_or(1.0);
        let over = mean_mm2 / of_mean_mm2;
        let share = if self.is_guessed() { 1.0 + (-over).exp_m1() / over } else { 1.0 - over.recip() };
        // 0 / 0: of a mean of 0 all may remain.
        self.shrinkage = if share.is_nan() { 1.0 } else { share.max(0.0) };
    }

    /// Returns how many statistically independent values an error map contains for the waves of this band, at least 1.
    /// `told` is the error map. The number is proportional to the area of its valid nodes.
    pub(super) fn independent(&self, told: &GridMap) -> f64 {
        let [dx, dy] = told.grid.spacing_mm;
        let area_mm2 = dx * dy * told.valid_count() as f64;
        independent_values(area_mm2, self.min_wavelength_mm)
    }
}

/// Returns how many statistically independent values a map contains for waves longer than `from_mm`, at least 1.
/// `area_mm2` is the area of the map.
///
/// The area is divided into squares with sides of twice the wavelength `from_mm`, and each square gives one value.
/// These values are correlated: [`VALUES_PER_INDEPENDENT_VALUE`] of them count as one independent value.
fn independent_values(area_mm2: f64, from_mm: f64) -> f64 {
    (area_mm2 / (2.0 * from_mm).powi(2) / VALUES_PER_INDEPENDENT_VALUE).max(1.0)
}

/// Combines the known response with the newly measured response `answer`, as a mean weighted by inverse variances. The
/// response is the change of the surface divided by the commanded change. Returns the new response and its standard
/// uncertainty.
///
/// `before` is the known response and `sigma` its standard uncertainty. `independent` is the number of independent
/// values in the measurement. If the measured response is outside [`RESPONSE_LIMITS`], returns the known response
/// unchanged.
fn combine_responses([before, sigma]: [f64; 2], answer: &Response, independent: f64) -> [f64; 2] {
    let [least, most] = RESPONSE_LIMITS;
    if !(least..=most).contains(&answer.slope) {
        return [before, sigma];
    }
    let of_answer = (answer.unexplained_mm / answer.commanded_mm / independent.sqrt()).max(1e-3);
    let [w, v] = [sigma, of_answer].map(|s| 1.0 / (s * s));
    [((w * before + v * answer.slope) / (w + v)).clamp(least, most), (w + v).sqrt().recip()]
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

/// Returns the mean square of the standard uncertainty of a node that comes from the noise of the points, in mm².
fn points_noise_mm2(error: &ErrorMap) -> f64 {
    mean_square(&error.nodes.valid, &error.sigma_mm)
}

/// Applies a Gaussian low-pass filter with the cut-off `cutoff_mm` to the valid nodes of `map`, and returns the
/// filtered values. Returns 0 at every node if the filter cannot be computed, because the map is too small for this
/// cut-off.
fn low_pass(map: &GridMap, cutoff_mm: f64) -> Vec<f64> {
    match filter_grid(map, cutoff_mm, FilterOrder::default(), false) {
        Ok(smooth) => smooth.nodes.values_mm,
        // A map too small for this wavelength contains no longer waves.
        Err(_) => vec![0.0; map.grid.len()],
    }
}

/// Returns the mean of the squared `values` for which `valid` is true; 0 if there are none.
pub(super) fn mean_square(valid: &[bool], values: &[f64]) -> f64 {
    let used = || valid.iter().zip(values).filter(|(valid, _)| **valid);
    used().map(|(_, value)| value * value).sum::<f64>() / used().count().max(1) as f64
}

fn add(sum: &mut [f64], factor: f64, values: &[f64]) {
    sum.iter_mut().zip(values).for_each(|(sum, value)| *sum += factor * value);
}

#[cfg(test)]
mod tests {
    use super::*;
    use regrind_figures::statistics::rms;

    const GRID: Grid = Grid { columns: 41, rows: 31, first_mm: [-20.0, -15.0], spacing_mm: [1.0, 1.0] };
    /// Bands from 2.5, 5 and 10 mm; a further octave would be half the part.
    const CUTOFF_MM: f64 = 2.5;

    fn begin(rule: GainRule, repeatability_mm: Option<f64>) -> LearningState {
        LearningState::new(rule, &MapOptions::new(CUTOFF_MM, 1.0), [40.0, 30.0], repeatability_mm)
    }

    fn map(value: impl Fn([f64; 2]) -> f64) -> ErrorMap {
        let values = (0..GRID.len()).map(|k| value(GRID.place_mm(k))).collect();
        ErrorMap::exact(GRID, values, vec![true; GRID.len()])
    }

    fn none() -> Correction {
        Correction::zero(GRID, 0.0)
    }

    fn after(known: &LearningState, correction: &Correction, error: &ErrorMap) -> LearningState {
        known.updated(&PassObservation { correction, error, response: None, explained: None })
    }

    /// Noise that no two passes share: each of up to ten passes has its own wave, with a whole number of periods on
    /// the part.
    fn noise_wave(pass: u32, rms_mm: f64) -> Vec<f64> {
        let number = f64::from(pass + 2) * std::f64::consts::TAU / 41.0;
        let at = |[x, _]: [f64; 2]| (number * x + f64::from(pass)).sin();
        (0..GRID.len()).map(|k| at(GRID.place_mm(k)) * rms_mm * 2f64.sqrt()).collect()
    }

    fn error_map_of(values_mm: Vec<f64>) -> ErrorMap {
        ErrorMap::exact(GRID, values_mm, vec![true; GRID.len()])
    }

    #[test]
    fn adaptive_gain_is_mean_of_passes() {
        // An error far above the noise is used in full; its gains are those of a plain mean, slightly larger for a
        // machine that may drift.
        let mut known = begin(GainRule::Adaptive, None);
        for pass in 1..=4 {
            let error = noise_wave(pass, 0.01).iter().map(|n| n + 1.0).collect();
            known = after(&known, &none(), &error_map_of(error));
            let [[from_mm, gain]] = known.gains()[..] else { panic!("one band") };
            assert_eq!(from_mm, CUTOFF_MM);
            assert!((gain - 1.0 / f64::from(pass)).abs() < 0.03, "pass {pass}: {gain}");
        }
    }

    #[test]
    fn gain_is_zero_within_noise() {
        // Known noise of 1 um in one band: of 2 um rms Wiener's share is 1 - 1.02 / 4, of 0.5 um it is 0.
        let gain = |rms_mm: f64| after(&begin(GainRule::Adaptive, Some(1e-3)), &none(), &map(|_| rms_mm)).gains()[0][1];
        assert!((gain(2e-3) - (1.0 - (1.0 + PROCESS_NOISE) / 4.0)).abs() < 1e-12, "{}", gain(2e-3));
        assert_eq!(gain(0.5e-3), 0.0);
        // Without a second pass only the noise of the points is known: nearly all of it is in the shortest waves, so
        // that these are not compensated.
        let noisy = |error: ErrorMap| ErrorMap { sigma_mm: vec![1e-3; GRID.len()], ..error };
        let short = noisy(map(|[x, _]| 0.9e-3 * (x * std::f64::consts::TAU / 4.0).sin()));
        let known = after(&begin(GainRule::Wavelength, None), &none(), &short);
        let shares: Vec<f64> = known.gains().iter().map(|[_, gain]| *gain).collect();
        assert!(shares[0] < 0.05, "{shares:?}");
        assert!(rms(known.next_correction_mm().unwrap()) < 0.1 * rms(&short.nodes.values_mm));
        let long = noisy(map(|[x, _]| 5e-3 * (x * std::f64::consts::TAU / 30.0).cos()));
        let known = after(&begin(GainRule::Wavelength, None), &none(), &long);
        assert!(known.gains().last().unwrap()[1] > 0.98, "{:?}", known.gains());
    }

    #[test]
    fn band_noise_prior_from_repeatability() {
        // Three bands, a third of the stated 1 um^2 in each: of a mean with this square 1 - (1 - 1 / e) remains, of
        // one far above it nearly all.
        let known = begin(GainRule::Wavelength, Some(1e-3));
        let share = |mean_um: f64| {
            let mut band = Band { variance_ratio: Some(1.0), ..known.bands[0] };
            band.shrink(1e-6 * mean_um * mean_um, 0.0);
            band.shrinkage
        };
        assert!((share((1.0f64 / 3.0).sqrt()) - (-1f64).exp()).abs() < 1e-12, "{}", share((1.0f64 / 3.0).sqrt()));
        assert!((share(10.0) - (1.0 - 1.0 / 300.0)).abs() < 1e-12, "{}", share(10.0));
        assert!(share(1e-3) < 1e-5, "{}", share(1e-3));
        // The estimates of the passes soon outweigh it: 1,200 mm^2 are 48 squares of 5 mm, and the guess weighs as
        // one of these.
        let mut band = Band { variance_ratio: Some(1.0), ..known.bands[0] };
        band.update(0.0, 3.0);
        assert!((band.noise_mm2().unwrap() - 1e-6 / 3.0 / 49.0).abs() < 1e-12, "{:?}", band.noise_sums);
        assert!(!band.is_guessed());
    }

    #[test]
    fn adaptive_gain_rises_after_change() {
        let mut known = begin(GainRule::Adaptive, None);
        for pass in 1..=4 {
            known = after(&known, &none(), &error_map_of(noise_wave(pass, 1e-3)));
        }
        let before = known.bands[0].kalman_gain;
        let changed = after(&known, &none(), &map(|_| 0.02));
        assert!(before < 0.35 && changed.bands[0].kalman_gain > 0.95, "{before} then {}", changed.bands[0].kalman_gain);
        assert_eq!(changed.repeatability_mm(), known.repeatability_mm(), "a change is no scatter");
        let next_part = known.for_next_part();
        let first = after(&next_part, &none(), &error_map_of(noise_wave(5, 1e-3)));
        assert!(first.bands[0].kalman_gain > before, "another part is believed more than another pass");
    }

    #[test]
    fn fixed_gain_stays_constant() {
        for share in [0.0, 0.8, 1.2] {
            let mut known = begin(GainRule::Fixed(share), None);
            let mut correction = none();
            for pass in 0..3 {
                let error = map(|[x, _]| 1e-3 + correction.at([x, 0.0]));
                known = after(&known, &correction, &error);
                let next = correction.compensating(&known, None);
                for ((now, next), e) in correction.values_mm.iter().zip(&next.values_mm).zip(&error.nodes.values_mm) {
                    assert_eq!(*next, now - share * e, "pass {pass}");
                }
                correction = next;
                let forecast = known.forecast(&error, 0.0);
                assert!(forecast.rms_mm.is_finite() && forecast.sigma_mm.is_finite(), "{forecast:?}");
            }
            assert_eq!(known.gains(), [[CUTOFF_MM, share]]);
        }
    }

    #[test]
    fn response_below_one_is_compensated() {
        let (known, form) = (begin(GainRule::Adaptive, None), map(|[x, y]| 1e-3 * (0.1 * x).sin() + 2e-5 * y));
        let answer = Response {
            slope: 0.9,
            correlation: 1.0,
            commanded_mm: 1e-3,
            unexplained_mm: 0.0,
            kind: PartResponse::Expected,
        };
        let known = known.updated(&PassObservation {
            correction: &none(),
            error: &form,
            response: Some(answer),
            explained: None,
        });
        assert!((known.response()[0] - 0.9).abs() < 1e-3, "{:?}", known.response());
        for (u, e) in known.next_correction_mm().unwrap().iter().zip(&form.nodes.values_mm) {
            assert!((u + e / known.response()[0]).abs() < 1e-15);
        }
        // Four times the commanded change is no answer to it.
        let wild = Response { slope: 4.0, ..answer };
        let known = begin(GainRule::Adaptive, None).updated(&PassObservation {
            correction: &none(),
            error: &form,
            response: Some(wild),
            explained: None,
        });
        assert_eq!(known.response(), [1.0, RESPONSE_SIGMA]);
    }

    #[test]
    fn learning_ignores_wrong_response_sense() {
        let form = map(|[x, y]| 1e-3 * (0.2 * x + 0.1 * y).sin());
        let first = after(&begin(GainRule::Wavelength, None), &none(), &form);
        let asked = none().compensating(&first, None);
        for sense in [PartResponse::NoEffect, PartResponse::SignFlipped, PartResponse::Mirrored, PartResponse::Doubled]
        {
            let answer =
                Response { slope: 0.0, correlation: 0.0, commanded_mm: 1e-3, unexplained_mm: 1e-3, kind: sense };
            let twice = first.updated(&PassObservation {
                correction: &asked,
                error: &form,
                response: Some(answer),
                explained: None,
            });
            assert_eq!((twice.next_correction_mm(), twice.passes()), (Some(&asked.values_mm[..]), 1), "{sense:?}");
            assert_eq!(twice.repeatability_mm(), None);
        }
    }

    #[test]
    fn response_estimate_corrects_next_passes() {
        // A part that answers with 0.8 of the command. By hand, in units of the error: the second pass leaves 0.2 and
        // yields the response. With a gain of 0.505 the mean is 0.901, of which 0.987 remains for a noise variance of
        // 0.2^2 / 2.02: the third pass leaves 0.1105. Then 0.344, 0.935, 0.9945 and 0.0701. The grid of the error is
        // offset from that of the correction and has a hole, so that interpolation between the nodes loses some of
        // it.
        let form = |[x, y]: [f64; 2]| 0.02 * (0.15 * x + 0.1).sin() * (0.12 * y).cos();
        let grid = Grid { columns: 38, rows: 29, first_mm: [-18.6, -14.3], spacing_mm: [1.0, 1.0] };
        let mut known = begin(GainRule::Adaptive, None);
        let mut correction = none();
        let mut left = Vec::new();
        for slope in [None, Some(0.8), Some(0.8), Some(0.8)] {
            let at = |place| form(place) + 0.8 * correction.at(place);
            let hole = |[x, y]: [f64; 2]| x.hypot(y) > 4.0;
            let places: Vec<[f64; 2]> = (0..grid.len()).map(|k| grid.place_mm(k)).collect();
            let error = ErrorMap::exact(
                grid,
                places.iter().map(|p| at(*p)).collect(),
                places.iter().map(|p| hole(*p)).collect(),
            );
            left.push(mean_square(&error.nodes.valid, &error.nodes.values_mm).sqrt());
            let answer = slope.map(|slope| Response {
                slope,
                correlation: 1.0,
                commanded_mm: 1.0,
                unexplained_mm: 0.0,
                kind: PartResponse::Expected,
            });
            known = known.updated(&PassObservation {
                correction: &correction,
                error: &error,
                response: answer,
                explained: None,
            });
            correction = correction.compensating(&known, None);
        }
        for (left_mm, expected) in left.windows(2).map(|w| w[1] / w[0]).zip([0.2, 0.5525, 0.634]) {
            assert!((left_mm - expected).abs() < 0.01, "{left:?}");
        }
    }

    #[test]
    fn learning_raises_small_repeatability() {
        let mut known = begin(GainRule::Adaptive, Some(1e-4));
        for pass in 1..=5 {
            known = after(&known, &none(), &error_map_of(noise_wave(pass, 1e-3)));
        }
        let told = known.repeatability_mm().unwrap();
        assert!((0.6e-3..1.5e-3).contains(&told), "{told}");
        assert!(known.bands[0].kalman_gain < 0.4, "{}", known.bands[0].kalman_gain);
    }

    #[test]
    fn bands_are_octaves_and_add_up() {
        let known = begin(GainRule::Wavelength, None);
        assert_eq!(known.bands.iter().map(|b| b.min_wavelength_mm).collect::<Vec<_>>(), [2.5, 5.0, 10.0]);
        let error = map(|[x, y]| (1.3 * x).sin() + 0.1 * y + (0.2 * x * y).cos());
        let parts = known.split_bands(&error.nodes, error.nodes.values_mm.clone());
        for (k, value) in error.nodes.values_mm.iter().enumerate() {
            assert!((parts.iter().map(|part| part[k]).sum::<f64>() - value).abs() < 1e-12);
        }
        // A long wave is in the last band, a short one in the first.
        let share = |wavelength_mm: f64, band: usize| {
            let wave = map(|[x, _]| (x * std::f64::consts::TAU / wavelength_mm).cos());
            rms(&known.split_bands(&wave.nodes, wave.nodes.values_mm.clone())[band]) / rms(&wave.nodes.values_mm)
        };
        assert!(share(30.0, 2) > 0.85 && share(3.0, 0) > 0.8, "{} {}", share(30.0, 2), share(3.0, 0));
    }

    #[test]
    fn band_noise_split_matches_filter() {
        // White noise leaves at a place the sum of the squares of what one point leaves at all places: one point in
        // the middle, and points everywhere for the mean that includes the border.
        let known = begin(GainRule::Wavelength, None);
        let powers = |node: usize| {
            let mut point = GridMap::all_valid(GRID, vec![0.0; GRID.len()]);
            point.values_mm[node] = 1.0;
            let smooth = low_pass(&point, CUTOFF_MM);
            let power = |values: &[f64]| values.iter().map(|v| v * v).sum::<f64>();
            let parts = known.split_bands(&point, smooth.clone());
            [power(&parts[0]), power(&parts[1]), power(&parts[2]), power(&smooth)]
        };
        let share = |nodes: &mut dyn Iterator<Item = usize>| {
            let sum = nodes.map(powers).fold([0.0; 4], |a, b| std::array::from_fn(|k| a[k] + b[k]));
            [0, 1, 2].map(|k| sum[k] / sum[3])
        };
        let (inside, everywhere) = (share(&mut [15 * 41 + 20].into_iter()), share(&mut (0..GRID.len()).step_by(7)));
        // By hand: 1 + 1/5 - 4/6, 1/5 + 1/17 - 4/22, 1/17.
        let shares = known.band_noise_mm2(1.0);
        for (share, by_hand) in shares.iter().zip([0.533_333, 0.077_005, 0.058_824]) {
            assert!((share - by_hand).abs() < 1e-6, "{shares:?}");
        }
        for k in 0..3 {
            assert!((inside[k] / shares[k] - 1.0).abs() < 0.35, "{inside:?} against {shares:?}");
            assert!((0.5..2.5).contains(&(everywhere[k] / shares[k])), "{everywhere:?} against {shares:?}");
        }
    }

    #[test]
    fn learning_handles_zero_error_and_noise() {
        for repeatability_mm in [None, Some(0.0), Some(1e-3)] {
            for rule in [GainRule::Wavelength, GainRule::Adaptive, GainRule::Fixed(1.0)] {
                let mut known = begin(rule, repeatability_mm);
                for value in [0.0, 0.0, 1e-3, 0.0, 1e6, 1e-300] {
                    let error = map(|_| value);
                    known = after(&known, &none(), &error);
                    assert!(known.is_valid(), "{known:?}");
                    let forecast = known.forecast(&error, 0.0);
                    assert!(
                        forecast.rms_mm.is_finite()
                            && known.next_correction_mm().unwrap().iter().all(|v| v.is_finite())
                    );
                }
            }
        }
        let all = after(&begin(GainRule::Adaptive, None), &none(), &map(|_| 0.0));
        assert!(
            all.next_correction_mm().unwrap().iter().all(|v| *v == 0.0)
                && all.forecast(&map(|_| 0.0), 0.0).rms_mm == 0.0
        );
    }

    #[test]
    fn forecast_counts_scallops_once() {
        let mut known = begin(GainRule::Adaptive, None);
        for pass in 1..=3 {
            known = after(&known, &none(), &error_map_of(noise_wave(pass, 1e-3)));
        }
        let found = |rest_mm: f64, scallops_mm: f64| {
            let error = ErrorMap { residual_sigma_mm: rest_mm, ..error_map_of(noise_wave(4, 1e-3)) };
            let Forecast { rms_mm, floor_mm, .. } = known.forecast(&error, scallops_mm);
            [rms_mm, floor_mm.unwrap()]
        };
        let [rms_mm, floor_mm] = found(0.0, 0.0);
        for (k, without) in [rms_mm, floor_mm].into_iter().enumerate() {
            assert!((found(0.0, 3e-3)[k] - without.hypot(3e-3)).abs() < 1e-15);
            // The probe has measured the same scallops in the grooves: they do not count twice.
            assert_eq!(found(4e-3, 3e-3)[k], found(4e-3, 0.0)[k]);
        }
    }

    #[test]
    fn learning_state_detects_bad_values() {
        let known = after(&begin(GainRule::Wavelength, None), &none(), &map(|[x, _]| 1e-3 * x));
        assert!(known.is_valid());
        let broken = |change: fn(&mut LearningState)| {
            let mut known = known.clone();
            change(&mut known);
            !known.is_valid()
        };
        assert!(broken(|k| k.response[0] = 9.0));
        assert!(broken(|k| k.response[1] = f64::NAN));
        assert!(broken(|k| k.bands.clear()));
        assert!(broken(|k| k.bands.swap(0, 1)));
        assert!(broken(|k| k.bands[1].variance_ratio = Some(-1.0)));
        assert!(broken(|k| k.bands[1].noise_sums[0] = f64::INFINITY));
        assert!(broken(|k| k.bands[0].min_wavelength_mm = 0.0));
        assert!(broken(|k| k.bands[0].shrinkage = f64::NAN));
        assert!(broken(|k| k.mean.as_mut().unwrap().values_mm.truncate(3)));
        assert!(broken(|k| k.mean.as_mut().unwrap().values_mm[0] = f64::NAN));
        assert!(broken(|k| k.mean.as_mut().unwrap().grid.spacing_mm[0] = 0.0));
        assert!(broken(|k| {
            let mean = k.mean.as_mut().unwrap();
            (mean.grid.columns, mean.values_mm) = (0, Vec::new());
        }));
    }
}
