//! Measurements in several sessions: the deviations common to all, and the prediction of a further session.
//!
//! A session is everything that is measured in one setup: a day, a station of a tracker, a clamping. The deviation of a
//! point is
//!
//! ```text
//!  d_i = h_i' b + f(x_i) + g_s(x_i) + e_i
//! ```
//!
//! The motions and the field f of the part are as in the model of one measurement. g_s is a field of session s alone,
//! independent of that of any other session: how the frame was established, how the part hung, how the air bent the
//! beam. g has a strength and a range of its own. A field g that is wider than the part shifts and tilts it. The points
//! of one session cannot separate f from g; this needs two sessions.
//!
//! Frame: places lie in the plane of projection of the model {M}. Units: millimetres.

use faer::Mat;
use nalgebra::DMatrix;
use regrind_figures::student_t_quantile;

use super::form::FreeMotions;
use super::nelder_mead::maximize;
use super::{DensePosterior, Field, Hyperparameters, ModelError, Observations, Prior, orthonormal_base};
use crate::registration::{Deviation, PointStatus, Registration};

/// Observed points, and the session of each.
#[derive(Clone, Debug)]
pub struct Sessions {
    observed: Observations,
    session_numbers: Vec<u32>,
}

/// Hyperparameters of the field common to all sessions, and of the field of each session.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BetweenSessionVariance {
    /// Field common to all sessions, and noise of a point.
    pub hyperparameters: Hyperparameters,
    /// Field of a single session.
    pub session_field: Field,
    /// Standard uncertainty of the logarithm of the standard deviation of `session_field`.
    pub session_log_sigma_u: f64,
    /// Number of sessions in the estimate.
    pub sessions: usize,
}

/// Prediction of the deviation that an unseen session will find at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PredictionInterval {
    /// Most probable deviation, after the best fit of that session.
    pub mean_mm: f64,
    /// Standard uncertainty of the deviation that will be found, including the field of the session and the noise.
    pub sigma_mm: f64,
    /// Degrees of freedom of `sigma_mm`.
    pub degrees_of_freedom: f64,
}

/// Maximum number of points of which every pair is evaluated: in the search of hyperparameters, and in the prediction.
const MAX_SEARCH_POINTS: usize = 300;
const MAX_KNOWN_POINTS: usize = 1500;
/// Minimum number of sessions: one alone contains no difference between sessions.
const MIN_SESSIONS: usize = 2;
/// Start values of the search: strengths of the session's field as shares of that of the part's field, and factors of
/// the prior median of each range.
const SHARES: [f64; 3] = [0.1, 0.5, 2.0];
const RANGES: [f64; 3] = [0.3, 1.0, 3.0];
/// Number of rounds of the search: each searches the hyperparameters of the common field with those of the session's
/// field fixed, and then the reverse.
const ROUNDS: usize = 4;
/// Prior of the session's field, as the median and the factor of one standard deviation of the logarithm: its strength
/// as a share of that of the part's field, and its range divided by the prior median of the part's range.
const SESSION_STRENGTH_PRIOR: [f64; 2] = [0.5, 6.0];
const SESSION_RANGE_PRIOR: [f64; 2] = [3.0, 6.0];
/// Distance from the maximum, in the logarithm of the strength, at which the likelihood is evaluated for its curvature.
const STEP: f64 = 0.1;
/// Minimum number of degrees of freedom; a smaller one counts as this.
const MIN_DEGREES_OF_FREEDOM: f64 = 2.0;

impl Sessions {
    /// Combines observed points with their sessions. A session is everything that is measured in one setup. `of` has
    /// the session number of each point, in the order of the points.
    ///
    /// # Errors
    /// Returns an error if the number of rows or of session numbers differs from the number of points, if there are not
    /// more points than fixed effects, or if a number is not finite.
    pub fn new(observed: Observations, of: Vec<u32>) -> Result<Self, ModelError> {
        observed.check()?;
        if of.len() != observed.places.len() {
            return Err(ModelError::Sessions { points: observed.places.len(), sessions: of.len() });
        }
        Ok(Self { observed, session_numbers: of })
    }

    /// Combines the inliers ([`PointStatus::Inlier`]) of several registrations, and the session (setup) of each inlier.
    /// Each element of `registrations` has a registration and the session numbers of all its measured points, outliers
    /// included.
    ///
    /// The fixed effects are the free motions of each registration. They act only on the points of this registration.
    ///
    /// # Errors
    /// Returns the errors of [`Sessions::new`]. Also returns an error if a registration has no inlier, or if its number
    /// of session numbers differs from its number of points.
    pub fn from_registrations(registrations: &[(&Registration, &[u32])]) -> Result<Self, ModelError> {
        let (mut parts, mut of) = (Vec::new(), Vec::new());
        for (registration, sessions) in registrations {
            let deviations = &registration.deviations;
            if deviations.len() != sessions.len() {
                return Err(ModelError::Sessions { points: deviations.len(), sessions: sessions.len() });
            }
            let used = deviations.iter().zip(*sessions).filter(|(d, _)| d.status == PointStatus::Inlier);
            let (used, numbers): (Vec<&Deviation>, Vec<u32>) = used.unzip();
            if used.is_empty() {
                return Err(ModelError::TooFewPoints { points: 0, min_points: 7 });
            }
            parts.push(FreeMotions::from_registration(registration, used.iter().map(|d| d.point)).observed(&used));
            of.extend(numbers);
        }
        Self::new(joined(&parts), of)
    }

    /// Returns the deviation of each point, in mm, in the order of the points: one registration after another, without
    /// outliers.
    pub fn deviations_mm(&self) -> &[f64] {
        &self.observed.deviations_mm
    }

    /// Estimates two fields and the noise by restricted likelihood. The first field is common to all sessions (setups).
    /// The second is the additional field of each single session. `priors` is the prior of the common field. If there
    /// are more than 300 points, 300 of them are used.
    ///
    /// # Errors
    /// Returns an error if there are fewer than two sessions or if the prior is invalid. Otherwise returns the errors
    /// of [`DensePosterior::fit`].
    pub fn between_session_variance(&self, priors: &Prior) -> Result<BetweenSessionVariance, ModelError> {
        priors.check()?;
        let mut numbers = self.session_numbers.clone();
        numbers.sort_unstable();
        numbers.dedup();
        if numbers.len() < MIN_SESSIONS {
            return Err(ModelError::TooFewSessions { sessions: numbers.len(), min_sessions: MIN_SESSIONS });
        }
        let few = self.thinned(MAX_SEARCH_POINTS);
        let (found, top) = few.search_maximum(priors);
        let (hyperparameters, own, _) = few.scaled(found, priors)?;
        // The uncertainty of the strength follows from the curvature of the log-likelihood along it. The common scale
        // changes with it, so the change of ln(sigma) is taken from the fits.
        let beside = |step: f64| {
            let [common, [share, range]] = found;
            few.scaled([common, [share + step, range]], priors).map(|(_, own, value)| (own.sigma_mm.ln(), value))
        };
        let (below, above) = (beside(-STEP)?, beside(STEP)?);
        let falls = (2.0 * top - below.1 - above.1).max(f64::MIN_POSITIVE);
        let own_u = (0.5 * (above.0 - below.0) / falls.sqrt()).abs().min(1.0);
        Ok(BetweenSessionVariance {
            hyperparameters,
            session_field: own,
            session_log_sigma_u: own_u,
            sessions: numbers.len(),
        })
    }

    /// Searches the most probable hyperparameters. `priors` is the prior of the common field. The search starts at the
    /// best of several start values. It alternates between two pairs of hyperparameters.
    ///
    /// Returns the two pairs at the maximum, as natural logarithms, and the logarithm of the posterior density at the
    /// maximum:
    ///
    /// - The first pair is the range of the common field in mm, and the standard deviation of the noise divided by that
    ///   of the common field.
    /// - The second pair is the standard deviation of the field of a session divided by that of the common field, and
    ///   the range of the field of a session in mm.
    fn search_maximum(&self, priors: &Prior) -> ([[f64; 2]; 2], f64) {
        let height = |at| self.scaled(at, priors).map_or(f64::NEG_INFINITY, |(_, _, value)| value);
        let [median_mm, _] = priors.range_mm;
        let mut best = ([[median_mm.ln(), 0.5_f64.ln()]; 2], f64::NEG_INFINITY);
        for range in RANGES {
            for share in SHARES {
                for own in RANGES {
                    let ranges_mm = [range * median_mm, own * SESSION_RANGE_PRIOR[0] * median_mm];
                    let at = [[ranges_mm[0].ln(), 0.5_f64.ln()], [share.ln(), ranges_mm[1].ln()]];
                    let value = height(at);
                    if value > best.1 {
                        best = (at, value);
                    }
                }
            }
        }
        for _ in 0..ROUNDS {
            let own = best.0[1];
            let (common, _) = maximize(best.0[0], [0.4, 0.4], 0.02, |common| height([common, own]));
            let (own, value) = maximize(own, [0.4, 0.4], 0.02, |own| height([common, own]));
            best = ([common, own], value);
        }
        best
    }

    /// Returns three values for the given hyperparameters: the hyperparameters of the common field with the noise, the
    /// field of a session, and the logarithm of the posterior density. The standard deviations of both fields and of
    /// the noise are multiplied by one common factor, so that the density is largest.
    ///
    /// The first four arguments are natural logarithms:
    ///
    /// - `range`: range of the common field, in mm.
    /// - `ratio`: standard deviation of the noise divided by that of the common field.
    /// - `share`: standard deviation of the field of a session divided by that of the common field.
    /// - `own_range`: range of the field of a session, in mm.
    ///
    /// `priors` is the prior of the common field. Returns an error if the model cannot be fitted.
    fn scaled(
        &self,
        [[range, ratio], [share, own_range]]: [[f64; 2]; 2],
        priors: &Prior,
    ) -> Result<(Hyperparameters, Field, f64), ModelError> {
        let [range_mm, ratio, share, own_mm] = [range, ratio, share, own_range].map(f64::exp);
        let unit =
            Hyperparameters { field: Field::new(1.0, range_mm), noise_sigma_mm: ratio, noise_autocorrelation: 0.0 };
        let own = Field::new(share, own_mm);
        let model = self.fit(unit, own)?;
        let squares = model.whitened_squares(&self.observed);
        let free = (self.session_numbers.len() - self.observed.fixed_effects.ncols()) as f64;
        // If all deviations are 0, so is the scale; the limit keeps it above 0.
        let scale = (squares / free).sqrt().max(f64::MIN_POSITIVE.sqrt());
        let log_of = |value: f64, [median, factor]: [f64; 2]| -0.5 * ((value / median).ln() / factor.ln()).powi(2);
        let value = model.log_likelihood() + 0.5 * squares - 0.5 * free - free * scale.ln()
            + priors.log_density(range_mm, ratio)
            + log_of(share, SESSION_STRENGTH_PRIOR)
            + log_of(own_mm / priors.range_mm[0], SESSION_RANGE_PRIOR);
        let scaled = |field: Field| Field { sigma_mm: field.sigma_mm * scale, ..field };
        Ok((
            Hyperparameters { field: scaled(unit.field), noise_sigma_mm: ratio * scale, noise_autocorrelation: 0.0 },
            scaled(own),
            value,
        ))
    }

    /// Fits the model to all points, with an additional field `own` for each session (setup). Two points of the same
    /// session have the additional covariance of `own`. Points of different sessions have none. `hyperparameters` are
    /// those of the common field and of the noise.
    fn fit(&self, hyperparameters: Hyperparameters, own: Field) -> Result<DensePosterior, ModelError> {
        let places = &self.observed.places;
        let own = own.pair_covariance();
        DensePosterior::with_shared_covariance(&self.observed, hyperparameters, |a, b| {
            match self.session_numbers[a] == self.session_numbers[b] {
                true => own.covariance_mm2(places[a], places[b]),
                false => 0.0,
            }
        })
    }

    /// Returns at most `most` of the points with their sessions, evenly spaced in the order of measurement.
    fn thinned(&self, most: usize) -> Self {
        let n = self.session_numbers.len();
        let chosen: Vec<usize> = (0..n.min(most)).map(|k| k * n / n.min(most)).collect();
        Self {
            observed: self.observed.subset(&chosen),
            session_numbers: chosen.iter().map(|&k| self.session_numbers[k]).collect(),
        }
    }
}

/// Appends the observations of several registrations to each other. The fixed effects of each registration become
/// separate columns. In these columns, the points of all other registrations have the value 0. The result has no random
/// effects and no path.
fn joined(parts: &[Observations]) -> Observations {
    let rows = parts.iter().map(|part| part.places.len()).sum();
    let mut effects = DMatrix::zeros(rows, parts.iter().map(|part| part.fixed_effects.ncols()).sum());
    let (mut places, mut deviations_mm, mut column) = (Vec::new(), Vec::new(), 0);
    for part in parts {
        effects.view_mut((places.len(), column), part.fixed_effects.shape()).copy_from(&part.fixed_effects);
        column += part.fixed_effects.ncols();
        places.extend(&part.places);
        deviations_mm.extend(&part.deviations_mm);
    }
    Observations { fixed_effects: effects, ..Observations::without_effects(places, deviations_mm) }
}

impl BetweenSessionVariance {
    /// Predicts the deviations that new sessions (setups) will find, from the points `known`. Returns one prediction
    /// for each point of `unseen`, in the order of the points.
    ///
    /// Only the places, the fixed effects and the sessions of `unseen` are used, not its deviations. Every session of
    /// `unseen` counts as new, even if its number also occurs in `known`. The prediction is for the deviations after
    /// the best fit by the fixed effects of `unseen`.
    ///
    /// If there are more than 1,500 known points, 1,500 of them are used. The cost is cubic in the number of points.
    ///
    /// # Errors
    /// Returns the errors of [`DensePosterior::fit`].
    pub fn predict(&self, known: &Sessions, unseen: &Sessions) -> Result<Vec<PredictionInterval>, ModelError> {
        let model = known.thinned(MAX_KNOWN_POINTS).fit(self.hyperparameters, self.session_field)?;
        let Observations { places, fixed_effects: effects, .. } = &unseen.observed;
        let (means_mm, common) = model.predict_together(places);
        let pairs = self.session_field.pair_covariance();
        let own = Mat::from_fn(places.len(), places.len(), |r, c| {
            match unseen.session_numbers[r] == unseen.session_numbers[c] {
                true => pairs.covariance_mm2(places[r], places[c]),
                false => 0.0,
            }
        });
        let base = BestFitBasis::new(effects);
        let fitted_mm = base.after_best_fit(&means_mm);
        let [common, own] = [common, own].map(|covariance| base.variances_after(&covariance));
        let scatter_mm2 = self.hyperparameters.noise_sigma_mm.powi(2);
        let of = |k: usize| {
            let steady_mm2 = common[k] + scatter_mm2 * base.remaining_share(k);
            let variance_mm2 = (steady_mm2 + own[k]).max(f64::MIN_POSITIVE);
            // Degrees of freedom of a total variance of which one part is uncertain (Satterthwaite 1946): the logarithm
            // of the session's variance has the standard uncertainty 2 u.
            let relative = 2.0 * self.session_log_sigma_u * own[k] / variance_mm2;
            let degrees = (2.0 / relative.powi(2).max(f64::MIN_POSITIVE)).max(MIN_DEGREES_OF_FREEDOM);
            PredictionInterval { mean_mm: fitted_mm[k], sigma_mm: variance_mm2.sqrt(), degrees_of_freedom: degrees }
        };
        Ok((0..places.len()).map(of).collect())
    }
}

impl PredictionInterval {
    /// Returns half the width of the 95 % prediction interval, in mm: the standard uncertainty times the quantile of
    /// Student's t, because an uncertainty that is estimated from few sessions is uncertain itself.
    pub fn half_width_mm(&self) -> f64 {
        self.sigma_mm * student_t_quantile(self.degrees_of_freedom)
    }
}

/// Orthonormal basis Q of the effects that a best fit removes.
struct BestFitBasis {
    q: DMatrix<f64>,
}

impl BestFitBasis {
    fn new(effects: &DMatrix<f64>) -> Self {
        Self { q: orthonormal_base(effects.clone()) }
    }

    /// Returns `values` minus their least-squares fit by the effects (for example motions of the part) of this basis.
    /// `values` has one value for each point.
    fn after_best_fit(&self, values: &[f64]) -> Vec<f64> {
        let taken = self.q.tr_mul(&nalgebra::DVector::from_column_slice(values));
        let fitted = &self.q * taken;
        values.iter().zip(fitted.iter()).map(|(value, fitted)| value - fitted).collect()
    }

    /// Returns the share (0 to 1) of the variance of independent noise that remains at one point after the best fit by
    /// the effects. `point` is the index of the point. The share is 1 minus the leverage of the point.
    fn remaining_share(&self, point: usize) -> f64 {
        1.0 - self.q.row(point).norm_squared()
    }

    /// Returns the variance of the value at each point, after the best fit by the effects (for example motions of the
    /// part) is subtracted. `covariance` is the covariance matrix V of the values before the subtraction. The result is
    /// the diagonal of P V P, where P is the projection that removes the effects.
    fn variances_after(&self, covariance: &Mat<f64>) -> Vec<f64> {
        let (n, p) = self.q.shape();
        let q = Mat::from_fn(n, p, |r, c| self.q[(r, c)]);
        let taken = covariance * &q;
        let both = q.transpose() * &taken;
        let back = &q * &both;
        let of = |r: usize| {
            let off = |c: usize| q[(r, c)] * (back[(r, c)] - 2.0 * taken[(r, c)]);
            (covariance[(r, r)] + (0..p).map(off).sum::<f64>()).max(0.0)
        };
        (0..n).map(of).collect()
    }
}

#[cfg(test)]
mod tests;
