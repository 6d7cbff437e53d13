//! What the grinder leaves in every pass, learned pass by pass, and how much of the last measurement to believe.
//!
//! A measured error is e = R + s u + N: R comes back in every pass, u is the correction, s the share of it that the part answers
//! with, and N is drawn afresh each time, so that nothing can take it away. A correction that takes all of e back grinds the N of
//! the last pass into the next one. So R is estimated as a Kalman filter does it: with p for the variance of what is believed of R
//! over that of N, the share of the newest error to take back and what is known afterwards are
//!
//! ```text
//!  g = p / (1 + p)        p' = p / (1 + p) + q
//! ```
//!
//! From nothing (p without bound) these are the gains 1, 1/2, 1/3 of a plain mean, which leave N sqrt(1 + 1/k) after k corrections; q keeps
//! the filter awake to a machine that drifts. Where N is known beforehand the first gain is Wiener's, 1 - |N|^2 / |e|^2. All of this holds
//! for each band of wavelengths by itself: an octave each, from the cut-off up.

use serde::{Deserialize, Serialize};

use super::correction::Correction;
use super::filter::Order;
use super::map::{ErrorMap, MapOptions, filter_net};
use super::response::{Response, Sense};

/// Variance by which a pass makes what is believed of R older, over that of N.
const DRIFT: f64 = 0.02;
/// The same from one part to the next: another blank, dressed anew, in a machine that has cooled.
const DRIFT_TO_NEXT_PART: f64 = 0.3;
/// An error so many standard deviations of a mean square above what is expected is a change of the machine and not its scatter.
const CHANGED_SIGMAS: f64 = 6.0;
/// Scatter is correlated over longer ways than the shortest waves, so that so many of its values make one that is independent.
const CORRELATED: f64 = 4.0;
/// What is believed of s before anything answered.
const RESPONSE_SIGMA: f64 = 0.1;
/// A response is never taken to be outside this.
const RESPONSE_LIMITS: [f64; 2] = [0.5, 1.5];

/// By what the share of an error that is taken back is chosen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GainRule {
    /// Always the same share.
    Fixed(f64),
    /// By what passes have told so far, one share for all wavelengths.
    Adaptive,
    /// By what passes have told so far, for each octave of wavelengths by itself.
    Wavelength,
}

/// What is known of one band of wavelengths.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Band {
    /// Waves longer than this belong to it, in millimetres.
    from_mm: f64,
    /// Variance of what is believed of R over that of N; `None` while nothing is known.
    belief: Option<f64>,
    /// Sum of what passes told of the variance of N, in square millimetres, and of how many.
    scatter: [f64; 2],
    /// The share that was taken back last.
    gain: f64,
}

/// What is known of the error that comes back in every pass.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Knowledge {
    rule: GainRule,
    /// Change of the surface over change of the correction, and its standard uncertainty.
    response: [f64; 2],
    /// From the shortest waves to the longest.
    bands: Vec<Band>,
    /// Passes that it was learned from.
    passes: u32,
}

/// What the next pass is expected to leave.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Forecast {
    /// Root mean square of the error that is expected, in millimetres.
    pub rms_mm: f64,
    /// Its standard deviation from part to part, in millimetres.
    pub sigma_mm: f64,
    /// Root mean square that no correction can go below, in millimetres; `None` while only one pass was seen.
    pub floor_mm: Option<f64>,
}

/// One measured pass.
#[derive(Clone, Copy, Debug)]
pub struct Seen<'a> {
    /// What it was ground with.
    pub correction: &'a Correction,
    /// What it left.
    pub error: &'a ErrorMap,
    /// How the part answered to the change of the correction, after the first pass.
    pub answer: Option<Response>,
}

impl Knowledge {
    /// Knows nothing yet. `repeatability_mm` is the rms of what a pass adds by itself, where that is known from elsewhere; it is shared out
    /// over the bands alike.
    pub fn new(rule: GainRule, map: &MapOptions, size_mm: [f64; 2], repeatability_mm: Option<f64>) -> Self {
        let mut edges = vec![map.cutoff_mm];
        if rule == GainRule::Wavelength {
            let longest_mm = size_mm[0].max(size_mm[1]) / 2.0;
            let octave = |from: &f64| Some(2.0 * from).filter(|next| *next < longest_mm);
            edges = std::iter::successors(Some(map.cutoff_mm), octave).collect();
        }
        let each = repeatability_mm.map_or([0.0; 2], |rms| [rms * rms / edges.len() as f64, 1.0]);
        let bands = edges.into_iter().map(|from_mm| Band { from_mm, belief: None, scatter: each, gain: 1.0 });
        Self { rule, response: [1.0, RESPONSE_SIGMA], bands: bands.collect(), passes: 0 }
    }

    /// Takes in what a pass left; afterwards [`Self::step_mm`] tells the next change of the correction.
    pub fn after(&self, seen: &Seen) -> Self {
        let mut known = self.clone();
        if let Some(answer) = seen.answer.filter(|answer| answer.sense == Sense::AsCommanded) {
            known.response = combined(self.response, &answer, self.bands[0].independent(seen.error));
        }
        for (band, values) in known.bands.iter_mut().zip(self.split(seen.error)) {
            let independent = band.independent(seen.error);
            band.take_in(mean_square(seen.error, &values), independent, self.rule, self.passes > 0);
        }
        known.passes += 1;
        known
    }

    /// Returns what the next part of the same kind begins with.
    pub fn for_next_part(&self) -> Self {
        let mut known = self.clone();
        for band in &mut known.bands {
            band.belief = band.belief.map(|belief| belief + DRIFT_TO_NEXT_PART);
        }
        known
    }

    /// Returns by how much the correction changes after an error, at each node of its net, in millimetres.
    pub fn step_mm(&self, error: &ErrorMap) -> Vec<f64> {
        let mut step = vec![0.0; error.net.len()];
        for (band, values) in self.bands.iter().zip(self.split(error)) {
            step.iter_mut().zip(values).for_each(|(sum, value)| *sum -= band.gain / self.response[0] * value);
        }
        step
    }

    /// Returns what the pass after this error is expected to leave.
    pub fn forecast(&self, error: &ErrorMap) -> Forecast {
        let rest2 = error.rest_sigma_mm.powi(2);
        let (mut left2, mut floor2, mut independent) = (rest2, rest2, 0.0);
        for (band, values) in self.bands.iter().zip(self.split(error)) {
            let seen2 = mean_square(error, &values);
            let scatter2 = band.scatter_mm2();
            // What is not taken back, and what is taken back by a response known that well only.
            let missed2 = seen2 * ((1.0 - band.gain).powi(2) + (band.gain * self.response[1]).powi(2));
            left2 += match scatter2 {
                // The error is R - R' + N, with the variances p and 1 in units of that of N.
                Some(n2) => n2 * (1.0 + band.belief.unwrap_or(1.0)),
                None => missed2,
            };
            floor2 += scatter2.unwrap_or(0.0);
            independent += band.independent(error);
        }
        let rms_mm = left2.sqrt();
        // The rms of m independent values scatters by 1 / sqrt(2 m); while N is a guess, so is the forecast.
        let known = self.bands.iter().all(|band| band.scatter[1] > 0.0);
        let relative = if known { 1.0 / (2.0 * independent).sqrt() } else { 0.5 };
        Forecast { rms_mm, sigma_mm: relative * rms_mm, floor_mm: known.then(|| floor2.sqrt()) }
    }

    /// Returns the share of the error that is taken back, from the shortest waves to the longest, with the wavelength from which each counts.
    pub fn gains(&self) -> Vec<[f64; 2]> {
        self.bands.iter().map(|band| [band.from_mm, band.gain]).collect()
    }

    /// Returns the share of a correction that the part answers with, and its standard uncertainty.
    pub fn response(&self) -> [f64; 2] {
        self.response
    }

    /// Returns the rms of what a pass adds by itself, in millimetres, as far as passes have told.
    pub fn scatter_mm(&self) -> Option<f64> {
        self.bands.iter().map(Band::scatter_mm2).sum::<Option<f64>>().map(f64::sqrt)
    }

    /// Returns the number of passes that this was learned from.
    pub fn passes(&self) -> u32 {
        self.passes
    }

    /// Whether every number is one that can be, for what was read from a file.
    pub fn is_sound(&self) -> bool {
        let number = |v: f64| v.is_finite() && v >= 0.0;
        let [least, most] = RESPONSE_LIMITS;
        let of_band =
            |b: &Band| number(b.from_mm) && b.from_mm > 0.0 && b.scatter.iter().all(|v| number(*v)) && number(b.gain);
        (least..=most).contains(&self.response[0])
            && number(self.response[1])
            && (1..=32).contains(&self.bands.len())
            && self.bands.iter().all(|b| of_band(b) && b.belief.is_none_or(number))
            && self.bands.windows(2).all(|w| w[0].from_mm < w[1].from_mm)
    }

    /// Splits a map into what each band holds of it; the parts add up to the map.
    fn split(&self, error: &ErrorMap) -> Vec<Vec<f64>> {
        let mut rest = error.values_mm.clone();
        let mut parts = Vec::with_capacity(self.bands.len());
        for longer in &self.bands[1..] {
            let smooth = low_passed(error, longer.from_mm);
            parts.push(rest.iter().zip(&smooth).map(|(value, smooth)| value - smooth).collect());
            rest = smooth;
        }
        parts.push(rest);
        parts
    }
}

impl Band {
    fn scatter_mm2(&self) -> Option<f64> {
        let [sum, count] = self.scatter;
        (count > 0.0).then(|| sum / count)
    }

    /// Takes in the mean square of an error in this band.
    fn take_in(&mut self, seen_mm2: f64, independent: f64, rule: GainRule, seen_before: bool) {
        let expected = self.belief.zip(self.scatter_mm2()).map(|(belief, n2)| (1.0 + belief) * n2);
        let changed = 1.0 + CHANGED_SIGMAS * (2.0 / independent * (1.0 + 1.0 / self.scatter[1].max(1.0))).sqrt();
        match (self.belief, expected) {
            // Not the scatter of before: the machine has changed, and what is believed of it counts for little.
            (Some(_), Some(expected)) if seen_mm2 > changed * expected => {
                self.belief = self.scatter_mm2().map(|n2| seen_mm2 / n2 - 1.0);
            }
            (Some(belief), _) => {
                self.scatter[0] += seen_mm2 / (1.0 + belief);
                self.scatter[1] += 1.0;
            }
            (None, _) => {}
        }
        let prior = self.belief.or_else(|| self.scatter_mm2().map(|n2| (seen_mm2 / n2 - 1.0).max(0.0)));
        let best = prior.map_or(1.0, |p| if p.is_finite() { p / (1.0 + p) } else { 1.0 });
        self.gain = if let GainRule::Fixed(share) = rule { share } else { best };
        // Of an unknown error a share of less than one leaves an unknown rest; after two such steps it is small.
        let rest = match prior {
            Some(p) => Some((1.0 - self.gain).powi(2) * p),
            None => (self.gain == 1.0 || seen_before).then_some(0.0),
        };
        self.belief = rest.map(|rest| rest + self.gain * self.gain + DRIFT).filter(|belief| belief.is_finite());
    }

    /// Number of independent values that a map has in this band: half a wave each way makes one.
    fn independent(&self, error: &ErrorMap) -> f64 {
        let [dx, dy] = error.net.spacing_mm;
        let area_mm2 = dx * dy * error.valid.iter().filter(|valid| **valid).count() as f64;
        (area_mm2 / (2.0 * self.from_mm).powi(2) / CORRELATED).max(1.0)
    }
}

/// What is believed of the response with an answer taken in, each by its certainty.
fn combined([before, sigma]: [f64; 2], answer: &Response, independent: f64) -> [f64; 2] {
    let of_answer = (answer.unexplained_mm / answer.asked_mm / independent.sqrt()).max(1e-3);
    let [w, v] = [sigma, of_answer].map(|s| 1.0 / (s * s));
    let [least, most] = RESPONSE_LIMITS;
    [((w * before + v * answer.slope) / (w + v)).clamp(least, most), (w + v).sqrt().recip()]
}

fn mean_square(error: &ErrorMap, values: &[f64]) -> f64 {
    let valid = || error.valid.iter().zip(values).filter(|(valid, _)| **valid);
    valid().map(|(_, value)| value * value).sum::<f64>() / valid().count().max(1) as f64
}

/// The map without waves shorter than a wavelength, on the same net.
fn low_passed(error: &ErrorMap, cutoff_mm: f64) -> Vec<f64> {
    match filter_net(&error.net, &error.values_mm, &error.valid, cutoff_mm, Order::default(), false) {
        Ok(smooth) => smooth.values,
        // A map too small for this wavelength has no waves that are longer.
        Err(_) => vec![0.0; error.net.len()],
    }
}
