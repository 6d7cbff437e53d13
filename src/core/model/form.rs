//! Form of a part and position of its nominal frame, estimated from a registered measurement.
//!
//! The registration places the part where the deviations are smallest. The form of the part influences that pose. The
//! model accounts for it: the motions that the registration was free to make are the fixed effects, and the form is the
//! field. The figures are those of the form after its own best fit, over samples of the posterior
//! ([`super::posterior`]). Therefore they do not contain the noise of the probe, and their uncertainty contains that of
//! the pose.

use faer::Mat;
use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, SymmetricEigen, Vector6};

use rayon::prelude::*;

use super::budget::{self, BudgetEntry};
use super::hypotheses::FieldHypotheses;
use super::intermediate::IntermediateNodes;
use super::machine_uncertainty::{MachineEffects, MachineUncertainty, UncertaintySource, invalid_uncertainty};
use super::posterior::{HypothesisSet, NoisePrior, Posterior, PosteriorSamples, select_hypotheses};
use super::random_normals::NormalGenerator;
use super::{AreaOptions, IsoFigures, SlopeFigures};
use super::{Hyperparameters, ModelError, Observations, Prediction, Prior, orthonormal_base, spacing_mm};
use crate::form::{IsoFits, SlopeOperator};
use crate::geometry::{Point, PointTree, Vector};
use crate::registration::{Deviation, MIN_SIGMA_MM, PointStatus, Registration, robust_median_and_sigma};

/// Posterior of the form of a part, from a registered measurement.
#[derive(Clone, Debug)]
pub struct Form {
    /// Standard deviation and range of the form, and noise of the probe.
    pub hyperparameters: Hyperparameters,
    /// Covariance of the pose of the nominal frame, as the twist [v; omega] in the model frame. It includes the
    /// uncertainty due to the form. Its layout is that of the covariance of the registration, which describes only how
    /// well the same pose would be found again. Units mm^2, mm rad, rad^2. Locked directions have zero variance.
    pub frame_covariance: Matrix6<f64>,
    /// Form after its own best fit at every used point, in the order of the points. A scan of more than 6,000 points is
    /// reduced to 6,000, evenly spaced.
    pub points: Vec<FormPoint>,
    /// Figures of the form.
    pub figures: FormFigures,
    /// ISO 10110-5 figures (power, irregularity and others); None if there are too few points for them.
    pub iso: Option<IsoFigures>,
    /// Slopes of the smooth form; None if there are too few points for them.
    pub slope: Option<SlopeFigures>,
    /// RMS of the standard uncertainty of the smooth form over all places, in mm.
    pub rms_smooth_sigma_mm: f64,
    /// Sources of the standard uncertainties of the figures; empty if these cannot be decomposed.
    pub budget: Vec<BudgetEntry>,
    /// Hyperparameters from the points alone, without the given prior. The prior of later parts is learned from them.
    /// None if no form is detectable.
    pub hyperparameters_without_prior: Option<Hyperparameters>,
    /// True if the points show a form. If false, only upper bounds of the figures are given, and their intervals begin
    /// at 0.
    pub is_detected: bool,
    /// Number of points from which the field is estimated, minus the number of fixed effects.
    pub degrees_of_freedom: f64,
    /// True if the degrees of freedom are too few to separate the form from the noise, and the noise of the probe is
    /// unknown. The upper bounds then assume that the deviations are entirely form, and include the form that the pose
    /// absorbed.
    pub is_underdetermined: bool,
}

/// Form at a measured point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FormPoint {
    /// Position in the model frame, in mm.
    pub place_mm: [f64; 2],
    /// Form at the point and its standard uncertainty.
    pub form: Prediction,
    /// Standard uncertainty of the smooth part of the form, which a correction can use.
    pub smooth_sigma_mm: f64,
}

/// Figures of the form with their credible intervals.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FormFigures {
    /// Root mean square.
    pub rms: Interval,
    /// Peak to valley over the places of [`Form::points`]. If the whole pattern was measured, these are the touched
    /// points.
    pub pv: Interval,
    /// PV 99.8 %: peak to valley over the aperture, including the places between. The outermost 0.1 % at either end are
    /// left out, but never a touched place.
    pub pv_998: Interval,
}

/// Median and 95 % credible interval of a figure.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Interval {
    /// Median.
    pub median_mm: f64,
    /// 2.5 % quantile.
    pub low_mm: f64,
    /// 97.5 % quantile.
    pub high_mm: f64,
    /// Lower bound for a decision that is repeated while the measurement grows: the quantile of the probability
    /// [`ModelInputs::decision_risk`].
    #[serde(skip)]
    pub decision_low_mm: f64,
    /// Upper bound for a decision that is repeated while the measurement grows: the quantile of the probability 1 -
    /// [`ModelInputs::decision_risk`].
    #[serde(skip)]
    pub decision_high_mm: f64,
    /// Bound for acceptance: the quantile of the probability [`ModelInputs::acceptance_probability`].
    #[serde(skip)]
    pub acceptance_bound_mm: f64,
    /// Quantiles of the probabilities [`Interval::PROBABILITIES`].
    #[serde(skip)]
    pub quantiles_mm: [f64; 15],
}

/// Number of samples of the posterior.
const SAMPLES: usize = 1000;
/// Number of samples of one kind of field: the smooth fields for the lower bounds, the rough fields for the upper
/// bounds.
const BOUND_SAMPLES: usize = 250;
/// Minimum probability at which a possibility counts: that the field is rough, or that isolated points are neighbours
/// by chance.
const MIN_PROBABILITY: f64 = 0.025;
/// Maximum number of places at which the samples are evaluated.
const MAX_PLACES: usize = 6000;
/// Number of samples that are processed at a time.
const SAMPLES_PER_BLOCK: usize = 50;
/// Minimum logarithm of the likelihood ratio of the best field and no field for a form to count as detected. Without a
/// form one part in a hundred exceeds it.
const MIN_EVIDENCE: f64 = 3.0;
/// Maximum distance of a point from the field, in robust sigmas, that counts as noise.
const OUTLIER_SIGMAS: f64 = 6.0;
/// Maximum share of points that can stand out from the field. If more stand out, they are part of the form itself.
const MAX_OUTLIER_SHARE: f64 = 0.1;
/// Minimum degrees of freedom for a field to separate the noise from the form.
const MIN_DEGREES_OF_FREEDOM: f64 = 20.0;
/// Number of points below which correlated noise of the probe, a drift for example, can look like form.
const FEW_POINTS: usize = 200;
/// Factor of the values below the median if there are few points. In simulations of a drift at 25, 50 and 100 points,
/// factor 1 covers the RMS in 91, 83 and 89 of 100 parts, this factor in 92 and more.
const FEW_LOW_FACTOR: f64 = 0.75;
/// Maximum share of the largest variance at which a direction counts as locked.
const MAX_LOCKED_SHARE: f64 = 1e-13;
/// Maximum variance of a direction of the twist, as a share of the sum of its terms without their signs, at which the
/// terms count as cancelled. The direction is then locked.
const MAX_CANCELLED_SHARE: f64 = 1e-12;

impl Form {
    /// Estimates the form of a part at the measured points, from the deviations of a registered measurement. The form
    /// is the deviation of the surface from the nominal one, after its best fit is subtracted. The result also has the
    /// figures of the form with their uncertainties. `inputs` has the stated uncertainties and priors.
    ///
    /// # Errors
    /// Returns an error if there are too few points, if the points do not determine the motions of the part, or if a
    /// number in `inputs` is invalid.
    pub fn estimate(registration: &Registration, inputs: &ModelInputs) -> Result<Self, ModelError> {
        let seen = FittedModel::fit(registration, inputs, true)?;
        let posterior = seen.posterior(inputs);
        let chosen: Vec<usize> = thinned(seen.observed.places.len()).collect();
        let some = seen.observed.subset(&chosen);
        let at = |chosen: &[usize]| seen.ground_in.as_ref().map(|ground_in| ground_in.select_rows(chosen));
        let of = |draws: PosteriorSamples, is_between: bool| {
            let drawn = seen.evaluate_samples(draws, some.places.clone(), some.fixed_effects.clone(), is_between);
            let drawn = SampledForms { chosen: chosen.clone(), ..drawn }.with_smooth_sigma(&seen.observed);
            drawn.without_ground_in(at(&seen.indices_of_all(&chosen)).as_ref())
        };
        let whole = |drawn: SampledForms, apart: &[usize], inputs: &ModelInputs| {
            seen.with_unexplained_points(apart, drawn.with_unresolved_form(&seen.observed, &posterior, inputs), inputs)
                .after_best_fit()
        };
        let drawn = of(posterior.samples(HypothesisSet::All, SAMPLES, 1), true);
        let slope = seen.slope(inputs, &posterior, &drawn);
        let drawn = whole(drawn, &seen.unexplained, inputs);
        let form = if seen.is_chance { &[][..] } else { &seen.confirmed };
        let least = whole(
            of(posterior.samples(HypothesisSet::Smooth, BOUND_SAMPLES, 2), false),
            form,
            &min_form_inputs(&posterior, inputs),
        )
        .figures_at_places();
        let most = match posterior.rough_probability() > MIN_PROBABILITY {
            true => {
                whole(of(posterior.samples(HypothesisSet::Rough, BOUND_SAMPLES, 3), false), &seen.unexplained, inputs)
                    .figures_at_places()
            }
            false => Vec::new(),
        };
        let ground_in = at(&drawn.chosen);
        Ok(Self { slope, ..seen.form(inputs, &posterior, (&drawn, [&least, &most]), ground_in, true) })
    }

    /// Estimates the form of a part at the given `places`, and the figures over all these places. The places need not
    /// be measured points. Each is a point of the nominal surface with its normal, in the model frame.
    ///
    /// Narrow form is form that is narrower than the spacing of the measured points. The points alone cannot
    /// distinguish it from the noise of the probe. Therefore the noise of the probe in [`ModelInputs::probe_noise_mm`]
    /// is required. Noise beyond this value counts as narrow form. Narrow form is added as an independent random value
    /// at every place. If the noise of the probe is unknown (0), all noise counts as noise of the probe.
    ///
    /// # Errors
    /// Returns the errors of [`Form::estimate`].
    pub fn estimate_at(
        registration: &Registration,
        inputs: &ModelInputs,
        places: &[(Point, Vector)],
    ) -> Result<Self, ModelError> {
        Self::estimate_with(registration, inputs, places, true)
    }

    /// Estimates the form of a part at the given `places`, which need not be measured points, and the figures over all
    /// these places. If `is_whole` is true, the result is that of [`Form::estimate_at`]. If it is false, the slopes,
    /// the ISO figures and the budget are omitted. For few measured points, this saves most of the computing time.
    ///
    /// # Errors
    /// Returns the errors of [`Form::estimate`].
    pub(super) fn estimate_with(
        registration: &Registration,
        inputs: &ModelInputs,
        places: &[(Point, Vector)],
        is_whole: bool,
    ) -> Result<Self, ModelError> {
        let seen = FittedModel::fit(registration, inputs, false)?;
        let posterior = seen.posterior(inputs);
        let places: Vec<_> = thinned(places.len()).map(|k| places[k]).collect();
        let effects = seen.motions.rows(places.iter().copied());
        // If there are many more places than touches, the places are close enough to each other.
        let is_between = places.len() < 2 * seen.inliers.len();
        let at = places.iter().map(xy).collect();
        let drawn = seen.evaluate_samples(posterior.samples(HypothesisSet::All, SAMPLES, 1), at, effects, is_between);
        let drawn = SampledForms { untouched: (0..places.len()).collect(), ..drawn };
        let drawn = drawn.rough_where_touched(&seen.observed.places).with_smooth_sigma(&seen.observed);
        let ground_in = seen.ground_in.is_some().then(|| seen.machine_effects.columns(places.iter().copied()));
        let drawn = drawn.without_ground_in(ground_in.as_ref());
        let slope = if is_whole { seen.slope(inputs, &posterior, &drawn) } else { None };
        let drawn =
            seen.with_unexplained_points(&seen.unexplained, drawn.with_narrow_form(inputs), inputs).after_best_fit();
        Ok(Self { slope, ..seen.form(inputs, &posterior, (&drawn, [&[], &[]]), ground_in, is_whole) })
    }
}

/// Observations of a registration, with the field hypotheses.
struct FittedModel {
    motions: FreeMotions,
    /// Observations at all used points.
    all: Observations,
    /// Indices of the points that no field explains, ascending. They count as form.
    unexplained: Vec<usize>,
    /// Indices of those unexplained points that neighbouring touches confirm.
    confirmed: Vec<usize>,
    /// True if there are so many isolated points that two of them can be neighbours by chance.
    is_chance: bool,
    /// Indices of all other used points, and the observations at these points.
    inliers: Vec<usize>,
    observed: Observations,
    /// Effects of the machine, its probe, the temperature and the datum that are common to all points.
    machine_effects: MachineEffects,
    /// Columns of the machine effects that are ground into the part, at all used points; None before the first
    /// correction.
    ground_in: Option<DMatrix<f64>>,
    fields: FieldHypotheses,
}

impl FittedModel {
    /// Fits the model of the form to the points of a registration. Computes the field hypotheses (covariance functions
    /// with their smoothness and range), then finds outliers: points that the field does not explain. The hypotheses
    /// are computed again without the outliers, up to three times. Newly found outliers stay in the model if there
    /// would be more than 10 % outliers in total.
    ///
    /// If `at_points` is true, the noise of successive points can be correlated (autocorrelation along the path of the
    /// probe).
    ///
    /// # Errors
    /// Returns an error if the prior in `inputs` is invalid. Otherwise returns the errors of
    /// [`Self::from_fitted_points`].
    fn fit(registration: &Registration, inputs: &ModelInputs, at_points: bool) -> Result<Self, ModelError> {
        /// Number of rounds. Each round estimates the hyperparameters again. Once the tallest points of a defect are
        /// left out, its flanks stand out too.
        const ROUNDS: usize = 3;
        if let Some(priors) = &inputs.prior {
            priors.check()?;
        }
        /// Number of touches that are direct neighbours of one touch.
        const AROUND: f64 = 8.0;
        let mut seen = Self::from_fitted_points(registration, inputs, at_points)?;
        for _ in 0..ROUNDS {
            let more = seen.find_unexplained(inputs);
            let apart = seen.unexplained.len() + more.len();
            if more.is_empty() || apart as f64 > MAX_OUTLIER_SHARE * seen.all.places.len() as f64 {
                break;
            }
            let mut apart = [&seen.unexplained[..], &more[..]].concat();
            apart.sort_unstable();
            let kept: Vec<usize> = (0..seen.all.places.len()).filter(|k| apart.binary_search(k).is_err()).collect();
            let observed = seen.all.subset(&kept);
            // The remaining points can be too few for the model. Then these points stay in it.
            let Ok(fields) = FieldHypotheses::over(&observed, seen.fields.kind) else { break };
            seen = Self { unexplained: apart, inliers: kept, observed, fields, ..seen };
        }
        let left_out = registration.deviations.iter().filter(|d| d.status == PointStatus::Outlier).count();
        let alone = (left_out + seen.unexplained.len() - seen.confirmed.len()) as f64;
        let by_chance = 0.5 * AROUND * alone * alone / seen.all.places.len() as f64;
        Ok(Self { is_chance: by_chance > MIN_PROBABILITY, ..seen })
    }

    /// Returns the posterior of the field, computed from all points that are not outliers. The priors of the field and
    /// of the probe noise are those in `inputs`.
    fn posterior(&self, inputs: &ModelInputs) -> Posterior<'_> {
        Posterior::new(&self.fields, &self.observed, inputs.prior.as_ref(), noise_prior(inputs))
    }

    /// Evaluates the posterior samples `draws` of the field at `places` (x and y in mm). Returns the sampled forms.
    ///
    /// A motion of the part is added to each sample: the motion for which the sample fits the observed deviations best
    /// (least squares). `effects` has one row for each place and one column for each motion. An element is the
    /// deviation that one unit of the motion causes at the place.
    ///
    /// If `is_between` is true, the samples are also evaluated at grid nodes between the places
    /// ([`IntermediateNodes`]).
    fn evaluate_samples(
        &self,
        draws: PosteriorSamples,
        places: Vec<[f64; 2]>,
        effects: DMatrix<f64>,
        is_between: bool,
    ) -> SampledForms {
        let Observations { fixed_effects: rows, random_effects: stated, deviations_mm, .. } = &self.observed;
        let weights = rows * inverse_of_products(rows);
        let found = weights.tr_mul(&DVector::from_column_slice(deviations_mm));
        let beside = weights.tr_mul(stated) * &draws.random_effects;
        let sums = self.fields.sums(&weights);
        let sums = Mat::from_fn(sums.nrows(), sums.ncols(), |r, c| sums[(r, c)]);
        let moved = draws.coefficients.each_ref().map(|waves| {
            let of_form = &sums * waves;
            DMatrix::from_fn(rows.ncols(), waves.ncols(), |m, c| found[m] - beside[(m, c)] - of_form[(m, c)])
        });
        SampledForms::evaluate(&self.fields, draws, (places, effects), &moved, is_between)
    }

    /// Finds outliers: points whose residual from the most probable field is too large to be noise. The limit is six
    /// robust standard deviations of the residuals, or more if the residuals are much smaller than the estimated noise.
    /// Returns the indices of the outliers among all used points. Returns no index if the model has fewer than 40
    /// points.
    fn find_unexplained(&self, inputs: &ModelInputs) -> Vec<usize> {
        /// Minimum number of points: with fewer, the usual residual is unknown.
        const MIN_POINTS: usize = 40;
        let Observations { places, deviations_mm, fixed_effects: effects, random_effects: stated, .. } = &self.observed;
        if places.len() < MIN_POINTS {
            return Vec::new();
        }
        let posterior = self.posterior(inputs);
        let (waves, of_stated) = posterior.mean();
        let told = self.fields.evaluate_at_points(&waves);
        let moved = stated * of_stated;
        let left = |k: usize| deviations_mm[k] - told[k] - moved[k];
        let residuals_mm = without_best_fit(DMatrix::from_fn(places.len(), 1, |k, _| left(k)), effects);
        let (middle_mm, sigma_mm) = robust_median_and_sigma(residuals_mm.iter().copied());
        // If a field passes through every point, the residuals do not show the noise.
        let scatter_mm = posterior.mean_hyperparameters().noise_sigma_mm;
        let limit_mm = OUTLIER_SIGMAS * sigma_mm.max(0.5 * scatter_mm).max(MIN_SIGMA_MM);
        let stands_out = |k: &usize| (residuals_mm[*k] - middle_mm).abs() > limit_mm;
        self.indices_of_all(&(0..places.len()).filter(stands_out).collect::<Vec<_>>())
    }

    /// Converts indices of points. An index in `chosen` counts only the points that are not outliers. An index in the
    /// result counts all used points.
    fn indices_of_all(&self, chosen: &[usize]) -> Vec<usize> {
        chosen.iter().map(|&k| self.inliers[k]).collect()
    }

    /// Adds outliers (points that the field does not explain) to the sampled forms in `drawn`. Returns the extended
    /// samples. `apart` has the indices of the outliers among all used points. The form at an outlier is the measured
    /// deviation, minus the random effects and a random noise of the probe.
    ///
    /// If the places of `drawn` are measured points, the outliers are inserted in the order of measurement. If `drawn`
    /// has only a share of the measured points, the same share of the outliers is inserted. These are the outliers with
    /// the largest absolute deviations.
    ///
    /// If the places of `drawn` are not measured points, no place is added. The samples at the place nearest to each
    /// outlier are replaced.
    fn with_unexplained_points(&self, apart: &[usize], drawn: SampledForms, inputs: &ModelInputs) -> SampledForms {
        let (rows, at_points) = (drawn.places.len(), !drawn.chosen.is_empty());
        let chosen = self.indices_of_all(&drawn.chosen);
        let drawn = SampledForms { chosen, ..drawn };
        if apart.is_empty() {
            return drawn;
        }
        // A reduced scan keeps the same share of these points as of the others, the tallest first.
        let count = apart.len();
        let mut apart = apart.to_vec();
        if at_points {
            apart.sort_by(|a, b| self.all.deviations_mm[*b].abs().total_cmp(&self.all.deviations_mm[*a].abs()));
            apart.truncate((count * rows).div_ceil(self.inliers.len().max(1)));
            apart.sort_unstable();
        }
        let found = self.samples_at_points(&apart, &drawn, inputs);
        if at_points { drawn.joined_with(found) } else { drawn.replaced_by(&found) }
    }

    /// Returns samples of the form at outliers (points that the field does not explain). `points` has the indices of
    /// the outliers among all used points. There is one sample for each sample of `drawn`. It is the measured
    /// deviation, minus the random effects of the sample of `drawn` and a random noise of the probe.
    ///
    /// After a correction, the errors of the machine are ground into the part. In this case a random error of the
    /// machine is also subtracted.
    ///
    /// The result has two sets of samples, each with one row for each outlier and one column for each sample. In the
    /// first set, each outlier has its own noise value. In the second set, which bounds the extremes, all outliers of a
    /// sample have the same noise value.
    fn samples_at_points(&self, points: &[usize], drawn: &SampledForms, inputs: &ModelInputs) -> SampledForms {
        let stated = self.all.random_effects.select_rows(points) * &drawn.random_effects;
        let of_probe = |mm: f64| noise_prior(inputs).map_or(mm, |[probe_mm, _]| mm.min(probe_mm));
        let mut forms = [0, 1].map(|_| DMatrix::zeros(points.len(), drawn.noise_mm.len()));
        for c in 0..drawn.noise_mm.len() {
            let mut normals = NormalGenerator::new(6, c as u64);
            let scatter_mm = of_probe(drawn.noise_mm[c]);
            // The tallest touch of a defect probably has positive noise. Therefore the second samples, which bound the
            // extremes, use one noise for all touches.
            let alike_mm = scatter_mm * normals.next();
            for (r, &k) in points.iter().enumerate() {
                let found_mm = self.all.deviations_mm[k] - stated[(r, c)];
                forms[0][(r, c)] = found_mm - scatter_mm * normals.next();
                forms[1][(r, c)] = found_mm - alike_mm;
            }
        }
        let found = SampledForms {
            all_form: None,
            absorbed_motions: DMatrix::zeros(0, 0),
            forms,
            places: points.iter().map(|&k| self.all.places[k]).collect(),
            effects: self.all.fixed_effects.select_rows(points),
            chosen: points.to_vec(),
            untouched: Vec::new(),
            smooth_sigma_mm: vec![mean(&drawn.noise_mm); points.len()],
            noise_mm: drawn.noise_mm.clone(),
            truncated_mm: [Vec::new(), Vec::new()],
            random_effects: drawn.random_effects.clone(),
            intermediate: None,
        };
        found.without_ground_in(self.ground_in.as_ref().map(|columns| columns.select_rows(points)).as_ref())
    }

    /// Computes the field hypotheses (covariance functions with their smoothness and range) from the points to which
    /// the pose of the registration was fitted. All other points of the part lie far from the nominal surface. No field
    /// describes them, so they count as outliers.
    ///
    /// If `at_points` is true, the noise of successive points can be correlated (autocorrelation along the path of the
    /// probe).
    ///
    /// # Errors
    /// Returns an error if there are too few points, if the points do not determine the motions of the part, or if a
    /// stated uncertainty in `inputs` is invalid.
    fn from_fitted_points(
        registration: &Registration,
        inputs: &ModelInputs,
        at_points: bool,
    ) -> Result<Self, ModelError> {
        let all = registration.deviations.iter().enumerate().filter(|(_, d)| d.status == PointStatus::Inlier);
        let (path, used): (Vec<f64>, Vec<&Deviation>) = all.map(|(k, d)| (k as f64, d)).unzip();
        if used.is_empty() {
            return Err(ModelError::TooFewPoints { points: 0, min_points: 7 });
        }
        let motions = FreeMotions::from_registration(registration, used.iter().map(|d| d.point));
        let stated = motions.machine_effects(registration, inputs)?;
        let columns = stated.columns(used.iter().map(|d| (d.point, d.normal)));
        let (shown, ground_in) =
            if inputs.is_corrected { (DMatrix::zeros(used.len(), 0), Some(columns)) } else { (columns, None) };
        let mut all = Observations { random_effects: shown, ..motions.observed(&used) };
        if at_points && is_path(&all.places) {
            all.path = path;
        }
        let (kept, apart): (Vec<usize>, Vec<usize>) = (0..used.len()).partition(|&k| used[k].in_fit);
        let observed = all.subset(&kept);
        let fields = select_hypotheses(&observed)?;
        Ok(Self {
            motions,
            all,
            confirmed: apart.clone(),
            is_chance: false,
            unexplained: apart,
            inliers: kept,
            observed,
            machine_effects: stated,
            ground_in,
            fields,
        })
    }

    /// Computes the slope figures (RMS and maximum slope) of the sampled forms in `drawn`. `inputs` has the integration
    /// length of the slopes. `posterior` shows whether a form was detected: if not, the lower ends of the intervals are
    /// 0.
    ///
    /// Call this function before form that is too narrow to be resolved is added to `drawn`, because the slope of such
    /// form cannot be measured. Returns `None` if there are too few places, or if they are too far apart.
    fn slope(&self, inputs: &ModelInputs, posterior: &Posterior, drawn: &SampledForms) -> Option<SlopeFigures> {
        let slopes = SlopeOperator::new(&drawn.places, inputs.area.integration_mm)?;
        let smooth = [0, 1].map(|k| without_best_fit(drawn.forms[k].clone(), &drawn.effects));
        Some(SlopeFigures::from_forms(&slopes, &smooth, (is_form_detected(posterior), inputs)))
    }

    /// Builds the result of the model from the sampled forms in `drawn`. The slopes of the result are `None`.
    ///
    /// - `ends` has two sets of further samples. Each entry has the figures RMS, PV and PV 99.8 % of one sample, in mm.
    ///   The first set can only lower the lower ends of the credible intervals. The second set can only raise the upper
    ///   end of the interval of RMS. A set can be empty.
    /// - `ground_in` is `None` before the first correction. Later, each column has the form that one error of the
    ///   machine has ground into the part, with one row for each place of `drawn`.
    /// - If `is_whole` is false, the ISO figures and the uncertainty budget are omitted.
    fn form(
        &self,
        inputs: &ModelInputs,
        posterior: &Posterior,
        (drawn, ends): (&SampledForms, [&[[f64; 3]]; 2]),
        ground_in: Option<DMatrix<f64>>,
        is_whole: bool,
    ) -> Form {
        let ground_into_kept = self.ground_in.as_ref().map(|columns| columns.select_rows(&self.inliers));
        let alike = ground_into_kept.as_ref().unwrap_or(&self.observed.random_effects);
        let covariance = best_fit_covariance(&self.observed, (&self.fields, posterior), alike);
        // Points apart from the field are detected, whatever the others show.
        let is_seen = is_form_detected(posterior) || !self.unexplained.is_empty();
        let figures = drawn.figures(is_seen, ends, inputs);
        let budget = if is_whole { self.budget(inputs, posterior, drawn, ground_in, &figures) } else { Vec::new() };
        let iso = IsoFits::new(&drawn.places, inputs.area.middle_mm).filter(|_| is_whole);
        let hyperparameters = posterior.mean_hyperparameters();
        let alone = match inputs.prior {
            None => hyperparameters,
            Some(_) => self.posterior(&ModelInputs { prior: None, ..*inputs }).mean_hyperparameters(),
        };
        Form {
            hyperparameters,
            hyperparameters_without_prior: is_seen.then_some(alone),
            frame_covariance: self.motions.to_twist(&covariance),
            points: drawn.points(),
            figures,
            budget,
            iso: iso.map(|fits| IsoFigures::from_forms(&fits, &drawn.forms, is_seen, inputs)),
            slope: None,
            rms_smooth_sigma_mm: drawn.rms_smooth_sigma_mm(),
            is_detected: is_seen,
            degrees_of_freedom: posterior.degrees_of_freedom(),
            is_underdetermined: is_underdetermined(posterior, inputs),
        }
    }

    fn budget(
        &self,
        inputs: &ModelInputs,
        posterior: &Posterior,
        drawn: &SampledForms,
        ground_in: Option<DMatrix<f64>>,
        figures: &FormFigures,
    ) -> Vec<BudgetEntry> {
        let ground_in = ground_in.map(|columns| without_best_fit(columns, &drawn.effects));
        let uncertainties_mm = [figures.rms, figures.pv_998].map(|of| of.standard_uncertainty_mm());
        let model = (&self.fields, posterior);
        let points = (&self.observed, &self.machine_effects.sources()[..]);
        let mut budget = budget::decompose(points, model, (drawn, ground_in.as_ref()), uncertainties_mm);
        budget.retain(|share| share.source != UncertaintySource::Datum || inputs.locked_sigmas.is_some());
        budget
    }
}

/// Returns true if the points show a form. The criterion is the logarithm of the likelihood ratio between the model
/// with the best field and the model without a field. It must be above [`MIN_EVIDENCE`].
fn is_form_detected(posterior: &Posterior) -> bool {
    posterior.evidence > MIN_EVIDENCE
}

/// Returns a copy of `inputs` for the lower bounds of the figures. If the estimated noise is consistent with
/// [`ModelInputs::probe_noise_mm`], the probe noise is set to unknown. All noise then counts as noise of the probe, and
/// none as form.
///
/// The reason: about twenty touches on a reference sphere determine the noise of the probe only to 15 %. If the
/// estimated noise is slightly larger, the excess is not necessarily form.
fn min_form_inputs(posterior: &Posterior, inputs: &ModelInputs) -> ModelInputs {
    /// Maximum excess of the noise over that of the probe, in standard uncertainties, that is still consistent with it.
    const MAX_EXCESS_SIGMAS: f64 = 2.0;
    match noise_prior(inputs) {
        Some([probe_mm, u])
            if posterior.mean_hyperparameters().noise_sigma_mm < probe_mm * (MAX_EXCESS_SIGMAS * u).exp() =>
        {
            ModelInputs { probe_noise_mm: [0.0; 2], ..*inputs }
        }
        _ => *inputs,
    }
}

/// Returns true if the noise of the probe is unknown and the points have fewer than [`MIN_DEGREES_OF_FREEDOM`] degrees
/// of freedom: too few to separate the form from the noise.
fn is_underdetermined(posterior: &Posterior, inputs: &ModelInputs) -> bool {
    posterior.degrees_of_freedom() < MIN_DEGREES_OF_FREEDOM && noise_prior(inputs).is_none()
}

/// Returns [`ModelInputs::probe_noise_mm`] as the prior of the noise: its standard deviation in mm and the relative
/// uncertainty of this standard deviation. Returns `None` if the standard deviation is 0, that is, unknown.
fn noise_prior(inputs: &ModelInputs) -> NoisePrior {
    (inputs.probe_noise_mm[0] > 0.0).then_some(inputs.probe_noise_mm)
}

fn mean(of: &[f64]) -> f64 {
    of.iter().sum::<f64>() / of.len().max(1) as f64
}

/// Returns true if successive places are close to each other, as on a path. The criterion: the median distance between
/// successive places is at most three times the typical spacing of all places. Returns false if there are fewer than
/// two places.
fn is_path(places: &[[f64; 2]]) -> bool {
    const NEAR: f64 = 3.0;
    let apart_mm = |pair: &[[f64; 2]]| (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1]);
    let mut steps_mm: Vec<f64> = places.windows(2).map(apart_mm).collect();
    if steps_mm.is_empty() {
        return false;
    }
    let middle = steps_mm.len() / 2;
    let median_mm = *steps_mm.select_nth_unstable_by(middle, f64::total_cmp).1;
    median_mm <= NEAR * spacing_mm(places)
}

fn xy((point, _): &(Point, Vector)) -> [f64; 2] {
    [point.x, point.y]
}

/// Returns the indices 0 to `of` - 1. If there are more than [`MAX_PLACES`], returns only [`MAX_PLACES`] of them,
/// evenly spaced.
fn thinned(of: usize) -> impl Iterator<Item = usize> {
    let most = of.min(MAX_PLACES);
    (0..most).map(move |k| k * of / most)
}

/// Inputs of the model that the measured points cannot show.
#[derive(Clone, Copy, Debug)]
pub struct ModelInputs {
    /// Prior of range and noise ratio. If None, a prior from the Fisher information of the variance ratio is used.
    pub prior: Option<Prior>,
    /// Uncertainty of the machine that is common to all points, from its cell file.
    pub machine: MachineUncertainty,
    /// Standard uncertainty of the calibrated radius of the probe, in mm. An error of the radius moves every point
    /// along its normal by the same amount.
    pub radius_sigma_mm: f64,
    /// Relative standard uncertainty of all lengths, from temperature and expansion.
    pub scale_sigma: f64,
    /// Standard uncertainties of the pose in the directions that the registration locked: of the shifts along x, y and
    /// z of the model in mm, and of the rotations about these axes through the centroid of the points in rad. 0 in
    /// directions that are known exactly or that the registration found. None if the registration locked no direction.
    pub locked_sigmas: Option<[f64; 6]>,
    /// True if the part was corrected by a measurement of the same machine in the same clamping. The effects of the
    /// machine, the probe, the temperature and the datum are then ground into the part, and the points no longer show
    /// them.
    pub is_corrected: bool,
    /// Noise of the probe itself: its standard deviation in mm, and the relative standard uncertainty of this standard
    /// deviation. Any further noise is form that is too narrow to be resolved. A standard deviation of 0 means that it
    /// is unknown: all noise then counts as noise of the probe.
    pub probe_noise_mm: [f64; 2],
    /// Probability that a figure is beyond each of the bounds [`Interval::decision_low_mm`] and
    /// [`Interval::decision_high_mm`].
    pub decision_risk: f64,
    /// Minimum probability that a figure is within its limit, for the part to be accepted.
    pub acceptance_probability: f64,
    /// Options of the figures over an area.
    pub area: AreaOptions,
}

impl Default for ModelInputs {
    fn default() -> Self {
        Self {
            prior: None,
            machine: MachineUncertainty::default(),
            radius_sigma_mm: 0.0,
            scale_sigma: 0.0,
            locked_sigmas: None,
            is_corrected: false,
            probe_noise_mm: [0.0; 2],
            decision_risk: 0.005,
            acceptance_probability: 0.975,
            area: AreaOptions::default(),
        }
    }
}

/// Returns the covariance of the motions of the part that a least-squares registration finds. There is one row and one
/// column for each motion. The covariance includes the error that the form of the part causes.
///
/// The covariance is A+ (K + s^2) A+' plus the covariance due to `alike` (least squares with correlated errors, Aitken
/// 1935). The symbols:
///
/// - A+ = (H'H)^-1 H', where H has the fixed effects (motions) as columns.
/// - K is the covariance of the field, averaged over all hypotheses in `fields` with their probabilities in
///   `posterior`.
/// - s is the standard deviation of the noise. For autocorrelated noise, s^2 is increased.
///
/// `alike` has one row for each point and one column for each effect that is common to all points, such as a machine
/// error.
fn best_fit_covariance(
    observed: &Observations,
    (fields, posterior): (&FieldHypotheses, &Posterior),
    alike: &DMatrix<f64>,
) -> DMatrix<f64> {
    let rows = &observed.fixed_effects;
    let inverse = inverse_of_products(rows);
    // A+, one row for each point.
    let weights = rows * &inverse;
    let (covered, scatter2) = posterior.mean_covariance(&fields.sums(&weights));
    let drift = fields.kind.autocorrelation;
    let of_alike = weights.tr_mul(alike);
    inverse * (scatter2 * (1.0 + drift) / (1.0 - drift)) + covered + &of_alike * of_alike.transpose()
}

/// Returns a matrix B for random samples of a motion of the part: the motion that a best fit finds only because of the
/// form. If z is a vector of independent standard normal numbers, B z is one sample. B has one row for each motion.
///
/// B satisfies B B' = A+ K A+'. Here A+ = (H'H)^-1 H', H has the fixed effects (motions) as columns, and K is the
/// posterior average of the covariance of the field.
fn absorbed_form_factor(observed: &Observations, posterior: &Posterior) -> DMatrix<f64> {
    let rows = &observed.fixed_effects;
    let weights = rows * inverse_of_products(rows);
    let (covered, _) = posterior.mean_covariance(&posterior.fields.sums(&weights));
    if covered.is_empty() {
        return covered;
    }
    let SymmetricEigen { eigenvalues, eigenvectors } = covered.symmetric_eigen();
    eigenvectors * DMatrix::from_diagonal(&eigenvalues.map(|value| value.max(0.0).sqrt()))
}

/// Returns the inverse of the matrix of products, (H'H)^-1, where H is the matrix `effects`. Returns the pseudo-inverse
/// if the columns of H are linearly dependent.
fn inverse_of_products(effects: &DMatrix<f64>) -> DMatrix<f64> {
    if effects.ncols() == 0 {
        return DMatrix::zeros(0, 0);
    }
    let inverse = effects.tr_mul(effects).pseudo_inverse(f64::EPSILON);
    inverse.unwrap_or_else(|_| DMatrix::zeros(effects.ncols(), effects.ncols()))
}

/// Samples of the form at a set of places, one column for each sample.
pub(super) struct SampledForms {
    /// Samples of the posterior, and samples of fields with the second variance factor, which bound the extremes.
    pub(super) forms: [DMatrix<f64>; 2],
    /// Samples that count the measured deviations entirely as form, with the form that the pose absorbed. None unless
    /// the points are too few to separate form from noise, and the noise of the probe is unknown.
    all_form: Option<DMatrix<f64>>,
    /// Motions by which the pose can have followed the form, one column for each sample. They belong to `all_form`.
    absorbed_motions: DMatrix<f64>,
    pub(super) places: Vec<[f64; 2]>,
    /// Motions that a best fit removes, at the places.
    pub(super) effects: DMatrix<f64>,
    /// Index of the measured point at each place; empty if the places are not measured points.
    chosen: Vec<usize>,
    /// Indices of the places that were not touched; empty if the places are measured points.
    untouched: Vec<usize>,
    /// Standard uncertainty of the smooth form at each place.
    smooth_sigma_mm: Vec<f64>,
    /// Standard deviation of the noise of each sample. `truncated_mm` is, for each variance factor, the standard
    /// deviation of the waves shorter than those of the basis.
    noise_mm: Vec<f64>,
    truncated_mm: [Vec<f64>; 2],
    /// Random effects of each sample, in standard uncertainties.
    random_effects: DMatrix<f64>,
    /// The same samples between the places; None if they were not evaluated there.
    intermediate: Option<IntermediateForms>,
}

/// Samples of the form between the places.
struct IntermediateForms {
    nodes: IntermediateNodes,
    forms: [DMatrix<f64>; 2],
    effects: DMatrix<f64>,
}

impl SampledForms {
    /// Evaluates the posterior samples `draws` of the field at `places` (x and y in mm), and adds a motion of the part
    /// to each sample.
    ///
    /// There are two sets of samples, one for each variance factor. The first factor is 1, for samples of the
    /// posterior. The second factor multiplies the variance of the field, for samples that bound the extremes
    /// ([`HypothesisSet`]).
    ///
    /// `effects` has one row for each place and one column for each motion. An element is the deviation that one unit
    /// of the motion causes at the place. `moved` has one matrix for each set of samples, with one row for each motion
    /// and one column for each sample. An element is the size of the motion.
    ///
    /// If `is_between` is true and there are fewer than [`MAX_PLACES`] places, the samples are also evaluated at grid
    /// nodes between the places ([`IntermediateNodes`]).
    fn evaluate(
        fields: &FieldHypotheses,
        draws: PosteriorSamples,
        (places, effects): (Vec<[f64; 2]>, DMatrix<f64>),
        moved: &[DMatrix<f64>; 2],
        is_between: bool,
    ) -> Self {
        let PosteriorSamples {
            coefficients: waves,
            noise_mm: scatter_mm,
            truncated_mm: narrow_mm,
            random_effects: stated,
        } = draws;
        let count = scatter_mm.len();
        let at = fields.basis.at(&places);
        let firsts: Vec<usize> = (0..count).step_by(SAMPLES_PER_BLOCK).collect();
        let is_between = is_between && places.len() < MAX_PLACES;
        let between = if is_between { IntermediateNodes::new(&places, &fields.basis) } else { None };
        let axes = between.as_ref().map(|between| fields.basis.grid(&between.grid));
        let mut forms = waves.each_ref().map(|waves| {
            let some = |first: &usize| {
                let of = &at * waves.subcols(*first, SAMPLES_PER_BLOCK.min(count - first));
                (0..of.ncols()).flat_map(|c| of.col_as_slice(c).to_vec()).collect::<Vec<f64>>()
            };
            DMatrix::from_vec(places.len(), count, firsts.par_iter().flat_map_iter(some).collect())
        });
        let between = between.zip(axes).map(|(between, axes)| {
            let on = waves.each_ref().map(|waves| {
                let one = |c: usize| {
                    let field = fields.basis.on_grid(&axes, waves.col_as_slice(c));
                    let at = |&node: &usize| field[between.grid.indices(node).into()];
                    between.nodes.iter().map(at).collect::<Vec<f64>>()
                };
                let all = (0..count).into_par_iter().flat_map_iter(one).collect();
                DMatrix::from_vec(between.nodes.len(), count, all)
            });
            IntermediateForms { effects: between.interpolate(&effects), forms: on, nodes: between }
        });
        let mut between = between;
        for (k, moved) in moved.iter().enumerate() {
            forms[k] += &effects * moved;
            if let Some(IntermediateForms { forms, effects, .. }) = &mut between {
                forms[k] += &*effects * moved;
            }
        }
        Self {
            forms,
            all_form: None,
            absorbed_motions: DMatrix::zeros(0, 0),
            places,
            effects,
            chosen: Vec::new(),
            untouched: Vec::new(),
            smooth_sigma_mm: Vec::new(),
            noise_mm: scatter_mm,
            truncated_mm: narrow_mm,
            random_effects: stated,
            intermediate: between,
        }
    }

    /// Limits the second set of samples to the places near a measured point. The second set has samples of a field with
    /// an increased variance, which bound the extremes ([`HypothesisSet`]). At places far from all measured points,
    /// these samples are replaced by the posterior samples, because hardly any measured point limits them there.
    ///
    /// `touched` has the positions of the measured points (x and y in mm). A place is near if its distance from a
    /// measured point is less than half the typical spacing of the places.
    fn rough_where_touched(mut self, touched: &[[f64; 2]]) -> Self {
        let at = |&[x, y]: &[f64; 2]| Point::new(x, y, 0.0);
        let near2 = (0.5 * spacing_mm(&self.places)).powi(2);
        let tree = PointTree::new(touched.iter().map(at));
        let is_touched = |k: &usize| tree.nearest(&at(&self.places[*k]), 1).any(|(_, square)| square < near2);
        for k in (0..self.places.len()).filter(|k| !is_touched(k)) {
            let row = self.forms[0].row(k).into_owned();
            self.forms[1].set_row(k, &row);
        }
        self
    }

    /// Computes the standard uncertainty of the smooth form at each place, in mm: the standard deviation of the samples
    /// at this place.
    ///
    /// The samples can contain motions of the part, which are not form. This is so if there are random effects, or if
    /// the places are not measured points. In these cases, the best fit of each sample is subtracted first.
    fn with_smooth_sigma(self, observed: &Observations) -> Self {
        let at_points = !self.chosen.is_empty();
        let smooth_sigma_mm = match at_points && observed.random_effects.ncols() == 0 {
            true => row_sigmas_mm(&self.forms[0]),
            false => row_sigmas_mm(&without_best_fit(self.forms[0].clone(), &self.effects)),
        };
        Self { smooth_sigma_mm, ..self }
    }

    /// Adds narrow form (form that is too narrow to be resolved) to the samples, at the measured points and at the
    /// nodes between them.
    ///
    /// At a measured point, the residual is the deviation minus the smooth form of the sample. It is the sum of probe
    /// noise and narrow form. The variance of this sum is the noise variance of the sample plus the variance of the
    /// waves shorter than the basis functions. Each residual is multiplied by the share (0 to 1) of narrow form in this
    /// variance, and then added to the sample. A random number is also added, because the split into noise and form is
    /// uncertain.
    ///
    /// If the points are too few to separate form from noise ([`is_underdetermined`]), another set of samples is
    /// created. In this set, the deviations count entirely as form, and the form that the pose absorbed is added.
    fn with_unresolved_form(mut self, observed: &Observations, posterior: &Posterior, inputs: &ModelInputs) -> Self {
        // The residuals also contain motions and random effects. Neither is noise. Between the touches the samples keep
        // all of their motions.
        let seen = observed.subset(&self.chosen);
        let base = orthonormal_base(seen.all_effects());
        let fitted = |column: DMatrix<f64>| &column - &base * base.tr_mul(&column);
        let found = &seen.deviations_mm;
        if is_underdetermined(posterior, inputs) {
            let mut all = DMatrix::zeros(found.len(), self.noise_mm.len());
            let free = posterior.degrees_of_freedom().max(1.0);
            for (c, mut form) in all.column_iter_mut().enumerate() {
                let mut normals = NormalGenerator::new(7, c as u64);
                // So few points can by chance show less than the form has elsewhere: a chi-squared number samples the
                // variance.
                let chi2: f64 = (0..free as usize).map(|_| normals.next().powi(2)).sum();
                let larger = (found.len() as f64 / chi2.max(f64::MIN_POSITIVE)).sqrt().max(1.0);
                let scatter_mm = self.noise_mm[c];
                form.iter_mut().zip(found).for_each(|(value, of)| *value = larger * of + scatter_mm * normals.next());
            }
            let factor = absorbed_form_factor(observed, posterior);
            let mut numbers = DMatrix::zeros(factor.ncols(), all.ncols());
            for (c, mut column) in numbers.column_iter_mut().enumerate() {
                let mut normals = NormalGenerator::new(9, c as u64);
                column.iter_mut().for_each(|value| *value = normals.next());
            }
            self.absorbed_motions = factor * numbers;
            self.all_form = Some(all);
        }
        let Self { forms, noise_mm: scatter_mm, truncated_mm: narrow_mm, .. } = &mut self;
        for (forms, narrow_mm) in forms.iter_mut().zip(narrow_mm) {
            let rows = forms.nrows();
            let of = |(c, form): (usize, &mut [f64])| {
                let mut normals = NormalGenerator::new(2, c as u64);
                let [probe_mm, more_mm] = split_noise(scatter_mm[c], narrow_mm[c], inputs, &mut normals);
                let is_form = more_mm.powi(2) / (probe_mm.powi(2) + more_mm.powi(2)).max(f64::MIN_POSITIVE);
                if is_form < 1e-6 {
                    return;
                }
                let left = fitted(DMatrix::from_fn(rows, 1, |k, _| found[k] - form[k]));
                let moved_mm = is_form.sqrt() * probe_mm;
                form.iter_mut()
                    .zip(&left)
                    .for_each(|(value, left)| *value += is_form * left + moved_mm * normals.next());
            };
            forms.as_mut_slice().par_chunks_mut(rows.max(1)).enumerate().for_each(of);
        }
        self.add_narrow_between(inputs);
        self
    }

    /// Adds form that is too narrow to be resolved to the samples: an independent normal random number at every place,
    /// and at every node between the places. Use it for places that are not measured points.
    ///
    /// The variance of the random numbers has two terms. The first is the noise variance of the sample minus that of
    /// the probe. The second is the variance of the waves that are shorter than the basis functions.
    fn with_narrow_form(mut self, inputs: &ModelInputs) -> Self {
        add_narrow(&mut self.forms, (&self.noise_mm, &self.truncated_mm), inputs, 4);
        self.add_narrow_between(inputs);
        self
    }

    fn add_narrow_between(&mut self, inputs: &ModelInputs) {
        if let Some(between) = &mut self.intermediate {
            add_narrow(&mut between.forms, (&self.noise_mm, &self.truncated_mm), inputs, 8);
        }
    }

    /// Subtracts a random error of the machine from each sample. This error is ground into the part. It is the sum of
    /// the columns of `ground_in`, each times a standard normal random number. Returns the samples unchanged if
    /// `ground_in` is `None` or has no column.
    ///
    /// The measured points do not show this error. Let f be the form after a correction by a measurement without error.
    /// Let E be the columns of `ground_in`, and t the normal numbers. A part that was corrected by a measurement with
    /// the error `E t` has the form `f - E t`. The next measurement has the same error, so its deviations are `(f - E
    /// t) + E t` plus noise. The error `E t` is not in these deviations.
    fn without_ground_in(mut self, ground_in: Option<&DMatrix<f64>>) -> Self {
        let Some(columns) = ground_in.filter(|columns| columns.ncols() > 0) else { return self };
        let take = |forms: &mut DMatrix<f64>, columns: &DMatrix<f64>| {
            for (c, mut form) in forms.column_iter_mut().enumerate() {
                let mut normals = NormalGenerator::new(5, c as u64);
                for column in columns.column_iter() {
                    form.axpy(-normals.next(), &column, 1.0);
                }
            }
        };
        self.forms.iter_mut().for_each(|forms| take(forms, columns));
        if let Some(IntermediateForms { nodes: between, forms, .. }) = &mut self.intermediate {
            let columns = between.interpolate(columns);
            forms.iter_mut().for_each(|forms| take(forms, &columns));
        }
        self
    }

    /// Merges the places of `other`, with their samples, into those of `self`. The places of the result are sorted by
    /// the index of their measured point.
    fn joined_with(self, other: Self) -> Self {
        let chosen = [&self.chosen[..], &other.chosen].concat();
        let mut order: Vec<usize> = (0..chosen.len()).collect();
        order.sort_unstable_by_key(|&row| chosen[row]);
        let joined = |of: &DMatrix<f64>, other: &DMatrix<f64>| {
            let rows = of.nrows();
            let mut of = of.clone().resize_vertically(rows + other.nrows(), 0.0);
            of.rows_mut(rows, other.nrows()).copy_from(other);
            of.select_rows(&order)
        };
        let places = [&self.places[..], &other.places].concat();
        let sigma_mm = [&self.smooth_sigma_mm[..], &other.smooth_sigma_mm].concat();
        Self {
            forms: [0, 1].map(|k| joined(&self.forms[k], &other.forms[k])),
            all_form: self.all_form.as_ref().map(|all| joined(all, &other.forms[0])),
            effects: joined(&self.effects, &other.effects),
            places: order.iter().map(|&row| places[row]).collect(),
            chosen: order.iter().map(|&row| chosen[row]).collect(),
            smooth_sigma_mm: order.iter().map(|&row| sigma_mm[row]).collect(),
            ..self
        }
    }

    /// Replaces samples of `self` by those of `other`. For each place of `other`, the samples at the nearest place of
    /// `self` are replaced. The positions of the places do not change.
    fn replaced_by(mut self, other: &Self) -> Self {
        let square = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2);
        for (r, place) in other.places.iter().enumerate() {
            let nearer =
                |a: &usize, b: &usize| square(self.places[*a], *place).total_cmp(&square(self.places[*b], *place));
            let Some(nearest) = (0..self.places.len()).min_by(nearer) else { continue };
            for k in [0, 1] {
                self.forms[k].row_mut(nearest).copy_from(&other.forms[k].row(r));
            }
            self.effects.row_mut(nearest).copy_from(&other.effects.row(r));
            self.untouched.retain(|row| *row != nearest);
            self.smooth_sigma_mm[nearest] = other.smooth_sigma_mm[r];
        }
        self
    }

    /// Subtracts from each sample its least-squares best fit at the places: the motion of the part that is closest to
    /// the sample. The same motion is also subtracted between the places.
    fn after_best_fit(mut self) -> Self {
        if self.effects.ncols() == 0 {
            return self;
        }
        let factor = self.effects.clone().qr();
        let (base, upper) = (factor.q(), factor.r());
        let fit = |forms: &mut DMatrix<f64>| {
            let taken = base.tr_mul(forms);
            *forms -= &base * &taken;
            taken
        };
        let taken = self.forms.each_mut().map(fit);
        if let Some(all) = &mut self.all_form {
            fit(all);
            // The pose takes most of a wide form away from so few points. This part is added after the best fit.
            *all += &self.effects * &self.absorbed_motions;
        }
        if let Some(IntermediateForms { forms, effects, .. }) = &mut self.intermediate {
            for (forms, taken) in forms.iter_mut().zip(&taken) {
                // The points determine every motion that the registration was free to make, so the factor is
                // invertible.
                if let Some(moved) = upper.solve_upper_triangular(taken) {
                    *forms -= &*effects * moved;
                }
            }
        }
        self
    }

    fn points(&self) -> Vec<FormPoint> {
        let count = self.forms[0].ncols() as f64;
        let of = |(k, at_mm): (usize, &[f64; 2])| {
            let row = self.forms[0].row(k);
            let mean_mm = row.sum() / count;
            let sigma_mm = (row.iter().map(|v| (v - mean_mm).powi(2)).sum::<f64>() / (count - 1.0)).sqrt();
            let smooth_sigma_mm = self.smooth_sigma_mm[k];
            FormPoint { place_mm: *at_mm, form: Prediction { mean_mm, sigma_mm }, smooth_sigma_mm }
        };
        self.places.iter().enumerate().map(of).collect()
    }

    /// Returns the root mean square over all places of [`SampledForms::smooth_sigma_mm`], in mm.
    fn rms_smooth_sigma_mm(&self) -> f64 {
        let squares: f64 = self.smooth_sigma_mm.iter().map(|sigma| sigma * sigma).sum();
        (squares / self.smooth_sigma_mm.len().max(1) as f64).sqrt()
    }

    /// Returns the figures RMS, PV and PV 99.8 % (PV without the outermost 0.1 % at either end) of each sample, in mm.
    /// They are computed from the places only, not from the nodes between the places.
    ///
    /// RMS comes from the posterior samples. PV and PV 99.8 % come from the second set of samples, which bounds the
    /// extremes. In this set, the variance of the field is multiplied by the second variance factor
    /// ([`HypothesisSet`]).
    fn figures_at_places(&self) -> Vec<[f64; 3]> {
        let [plain, other] = self.forms.each_ref().map(|forms| self.figures_of(forms, None));
        plain.iter().zip(&other).map(|([rms, ..], [_, pv, most])| [*rms, *pv, *most]).collect()
    }

    /// Returns the figures RMS, PV and PV 99.8 % (PV without the outermost 0.1 % at either end) with their credible
    /// intervals, in mm.
    ///
    /// The medians and the intervals come from the posterior samples (the first set of `self.forms`). Four other sets
    /// of samples can only widen the intervals:
    ///
    /// - `least` can only lower the lower ends of all three figures. It has one entry [RMS, PV, PV 99.8 %] for each
    ///   sample.
    /// - `most` can only raise the upper end of RMS. Its entries are the same, but PV and PV 99.8 % are not used.
    /// - The second set of `self.forms` can only raise the upper ends of PV and PV 99.8 %. In this set, the variance of
    ///   the field is multiplied by the second variance factor ([`HypothesisSet`]).
    /// - `self.all_form` can only raise the upper ends of all three figures. These samples count the deviations
    ///   entirely as form.
    ///
    /// If the places are measured points and there are fewer than 200, the lower ends are multiplied by
    /// [`FEW_LOW_FACTOR`]. `is_seen` is true if a form was detected. If it is false, the lower ends are 0.
    fn figures(&self, is_seen: bool, [least, most]: [&[[f64; 3]]; 2], inputs: &ModelInputs) -> FormFigures {
        let [plain, rough] =
            [0, 1].map(|k| self.figures_of(&self.forms[k], self.intermediate.as_ref().map(|of| &of.forms[0])));
        let all = self.all_form.as_ref().map(|all| self.figures_of(all, None));
        let low_factor = if (1..FEW_POINTS).contains(&self.chosen.len()) { FEW_LOW_FACTOR } else { 1.0 };
        let interval = |k: usize| {
            let of = |figures: &[[f64; 3]]| figures.iter().map(|of| of[k]).collect::<Vec<f64>>();
            let others = if k == 0 { most } else { &rough };
            let higher = [Some(others), all.as_deref()].into_iter().flatten().filter(|of| !of.is_empty()).map(of);
            Interval::with_low_factor(of(&plain), (of(least), higher), (is_seen, low_factor), inputs)
        };
        FormFigures { rms: interval(0), pv: interval(1), pv_998: interval(2) }
    }

    /// Computes three figures of each sample, in mm: RMS, PV and PV 99.8 %. RMS and PV are computed from the places. PV
    /// 99.8 % is computed from the places and the nodes between them.
    ///
    /// `forms` has the samples at the places, `between` has the samples at the nodes; each has one column for each
    /// sample. If `between` is `None`, PV 99.8 % is also computed from the places only.
    fn figures_of(&self, forms: &DMatrix<f64>, between: Option<&DMatrix<f64>>) -> Vec<[f64; 3]> {
        let rows = forms.nrows();
        let mut is_touched = vec![true; rows];
        self.untouched.iter().for_each(|&row| is_touched[row] = false);
        let of = |(c, form): (usize, &[f64])| {
            let squares: f64 = form.iter().map(|v| v * v).sum();
            let [low, high] = min_and_max(form.iter().copied());
            // The outermost of all places are left out, but never a touched place.
            let touched = form.iter().zip(&is_touched).filter_map(|(value, is)| is.then_some(*value));
            let mut others: Vec<f64> = self.untouched.iter().map(|&row| form[row]).collect();
            between.iter().for_each(|between| others.extend(between.column(c).iter()));
            let [mut lowest, mut highest] = min_and_max(touched);
            if let Some(last) = others.len().checked_sub(1) {
                let left_out = ((rows - self.untouched.len() + others.len()) / 1000).min(last / 2);
                let mut nth = |k: usize| *others.select_nth_unstable_by(k, f64::total_cmp).1;
                lowest = lowest.min(nth(left_out));
                highest = highest.max(nth(last - left_out));
            }
            [(squares / rows as f64).sqrt(), high - low, highest - lowest]
        };
        forms.as_slice().par_chunks(rows.max(1)).enumerate().map(of).collect()
    }
}

fn min_and_max(of: impl Iterator<Item = f64>) -> [f64; 2] {
    of.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| [low.min(value), high.max(value)])
}

/// Adds narrow form (form that is too narrow to be resolved) to every place of each sample. The narrow form at a place
/// is an independent normal random number. Its standard deviation is the second result of [`split_noise`].
///
/// - `forms` has two sets of samples, one for each variance factor ([`HypothesisSet`]). The factor multiplies the
///   variance of the field. A matrix has one row for each place and one column for each sample.
/// - `scatter_mm` has the standard deviation of the noise of each sample, in mm.
/// - `narrow_mm` has the standard deviation of the waves shorter than the basis functions, in mm, for each variance
///   factor and sample.
/// - `stream` is the seed of the random numbers.
fn add_narrow(
    forms: &mut [DMatrix<f64>; 2],
    (scatter_mm, narrow_mm): (&[f64], &[Vec<f64>; 2]),
    inputs: &ModelInputs,
    stream: u64,
) {
    for (forms, narrow_mm) in forms.iter_mut().zip(narrow_mm) {
        let rows = forms.nrows();
        let of = |(c, form): (usize, &mut [f64])| {
            let [_, more_mm] = split_noise(scatter_mm[c], narrow_mm[c], inputs, &mut NormalGenerator::new(2, c as u64));
            let mut normals = NormalGenerator::new(stream, c as u64);
            if more_mm > 0.0 {
                form.iter_mut().for_each(|value| *value += more_mm * normals.next());
            }
        };
        forms.as_mut_slice().par_chunks_mut(rows.max(1)).enumerate().for_each(of);
    }
}

/// Splits the noise of a sample into probe noise and form that is too narrow to be resolved. Returns the standard
/// deviations of the two, in mm.
///
/// `scatter_mm` is the standard deviation of the noise. `narrow_mm` is the standard deviation of the waves shorter than
/// the basis functions; it always counts as narrow form. The probe noise is drawn at random from
/// [`ModelInputs::probe_noise_mm`], and is at most `scatter_mm`. The remaining noise counts as narrow form. If the
/// probe noise is unknown, all of `scatter_mm` is probe noise.
fn split_noise(scatter_mm: f64, narrow_mm: f64, inputs: &ModelInputs, normals: &mut NormalGenerator) -> [f64; 2] {
    let Some([probe_mm, probe_u]) = noise_prior(inputs) else { return [scatter_mm, narrow_mm] };
    let own_mm = (probe_mm * (probe_u * normals.next()).exp()).min(scatter_mm);
    [own_mm, (scatter_mm.powi(2) - own_mm.powi(2)).max(0.0).sqrt().hypot(narrow_mm)]
}

/// Subtracts from each column of `forms` its best fit: the linear combination of the columns of `effects` that is
/// closest to it in least squares. Returns the residuals.
fn without_best_fit(mut forms: DMatrix<f64>, effects: &DMatrix<f64>) -> DMatrix<f64> {
    let base = orthonormal_base(effects.clone());
    forms -= &base * base.tr_mul(&forms);
    forms
}

/// Returns the standard deviation of each row of `forms`, in mm. A row has the values of all samples at one place.
fn row_sigmas_mm(forms: &DMatrix<f64>) -> Vec<f64> {
    forms.row_iter().map(|row| row.variance().sqrt()).collect()
}

impl Interval {
    /// Probabilities of the quantiles that are recorded for a figure.
    pub const PROBABILITIES: [f64; 15] =
        [0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975, 0.99, 0.995, 0.999];

    /// Returns the standard uncertainty in mm: the width of the 95 % interval divided by 3.92. The 95 % interval of a
    /// normal distribution is 3.92 standard deviations wide.
    pub fn standard_uncertainty_mm(&self) -> f64 {
        const WIDTH: f64 = 2.0 * 1.96;
        (self.high_mm - self.low_mm) / WIDTH
    }

    /// Builds the credible interval of a figure from `values`: the value of the figure in each of several equally
    /// probable samples. `values` must not be empty.
    ///
    /// `higher` has further sets of values. They can only raise the quantiles above the median: each quantile is the
    /// maximum of the quantiles of `values` and of every set in `higher`. No set in `higher` may be empty. `lower` is
    /// one further set of values. It can only lower the quantiles below the median: each quantile is the minimum of the
    /// quantiles of `values` and of `lower`. An empty `lower` is ignored. If `has_low` is false, all quantiles below
    /// the median are 0.
    ///
    /// `inputs` gives the probabilities of three bounds. [`ModelInputs::decision_risk`] is the probability that the
    /// figure is below the bound `decision_low_mm`, and also that it is above the bound `decision_high_mm`.
    /// [`ModelInputs::acceptance_probability`] is the probability that the figure is below the bound
    /// `acceptance_bound_mm`.
    pub(super) fn from_samples(
        values: Vec<f64>,
        (lower, higher): (Vec<f64>, impl Iterator<Item = Vec<f64>>),
        has_low: bool,
        inputs: &ModelInputs,
    ) -> Self {
        Self::with_low_factor(values, (lower, higher), (has_low, 1.0), inputs)
    }

    /// Builds the credible interval of a figure from `values`: the value of the figure in each of several equally
    /// probable samples. `values` must not be empty.
    ///
    /// The sets in `higher` can only raise the quantiles above the median. The set `lower` can only lower the quantiles
    /// below the median; an empty `lower` is ignored. If `has_low` is true, the quantiles below the median are then
    /// multiplied by `low_factor`. If `has_low` is false, they are 0. `inputs` gives the probabilities of the bounds,
    /// as in [`Interval::from_samples`].
    fn with_low_factor(
        mut values: Vec<f64>,
        (mut lower, higher): (Vec<f64>, impl Iterator<Item = Vec<f64>>),
        (has_low, low_factor): (bool, f64),
        inputs: &ModelInputs,
    ) -> Self {
        values.sort_unstable_by(f64::total_cmp);
        lower.sort_unstable_by(f64::total_cmp);
        let higher: Vec<Vec<f64>> = higher
            .map(|mut of| {
                of.sort_unstable_by(f64::total_cmp);
                of
            })
            .collect();
        let ModelInputs { decision_risk: look_risk, acceptance_probability: probability, .. } = *inputs;
        let nth = |of: &[f64], share: f64| of[((of.len() - 1) as f64 * share).round() as usize];
        let at = |share: f64| {
            let own = nth(&values, share);
            match share {
                _ if share > 0.5 => higher.iter().fold(own, |most, of| most.max(nth(of, share))),
                _ if share < 0.5 && !lower.is_empty() => own.min(nth(&lower, share)),
                _ => own,
            }
        };
        let low = |share: f64| if has_low { low_factor * at(share) } else { 0.0 };
        Self {
            median_mm: at(0.5),
            low_mm: low(0.025),
            high_mm: at(0.975),
            decision_low_mm: low(look_risk),
            decision_high_mm: at(1.0 - look_risk),
            acceptance_bound_mm: at(probability),
            quantiles_mm: Self::PROBABILITIES.map(|share| if share < 0.5 { low(share) } else { at(share) }),
        }
    }
}

/// Motions that the registration was free to make, about the centroid of the points. Rotations are in mm at the RMS
/// distance of the points from the centroid.
pub(super) struct FreeMotions {
    centre: Point,
    size_mm: f64,
    /// One column for each motion.
    free: DMatrix<f64>,
}

impl FreeMotions {
    /// Finds the motions of the part that the registration did not lock. These are the directions in which the
    /// covariance of the pose in `registration` is not 0. `points` are the points used in the model, in the model
    /// frame; rotations are taken about their centroid.
    pub(super) fn from_registration(registration: &Registration, points: impl Iterator<Item = Point> + Clone) -> Self {
        let n = points.clone().count() as f64;
        let centre = Point::from(points.clone().fold(Vector::zeros(), |sum, p| sum + p.coords) / n);
        let size_mm = (points.map(|p| (p - centre).norm_squared()).sum::<f64>() / n).sqrt().max(f64::MIN_POSITIVE);
        let about = motion_about(centre, size_mm);
        let covariance = about * registration.quality.covariance * about.transpose();
        let SymmetricEigen { eigenvalues, eigenvectors } = covariance.symmetric_eigen();
        let seen = |k: &usize| eigenvalues[*k] > MAX_LOCKED_SHARE * eigenvalues.max();
        let columns: Vec<Vector6<f64>> = (0..6).filter(seen).map(|k| eigenvectors.column(k).into_owned()).collect();
        let free = DMatrix::from_fn(6, columns.len(), |r, c| columns[c][r]);
        Self { centre, size_mm, free }
    }

    /// Returns the observations at the points `used`: the positions (x and y) and the deviations, in mm. The fixed
    /// effects are the motions of the part that the registration did not lock. There are no random effects.
    pub(super) fn observed(&self, used: &[&Deviation]) -> Observations {
        let places = used.iter().map(|d| [d.point.x, d.point.y]).collect();
        let deviations_mm = used.iter().map(|d| d.deviation_mm).collect();
        let fixed_effects = self.rows(used.iter().map(|d| (d.point, d.normal)));
        Observations { fixed_effects, ..Observations::without_effects(places, deviations_mm) }
    }

    /// Returns the random effects that are common to all points: errors of the machine, of the probe, of the
    /// temperature and of the fixture. Their sizes are the standard uncertainties in `inputs`. Rotations of the fixture
    /// are about the centroid of the points.
    ///
    /// # Errors
    /// Returns [`ModelError::StatedUncertainty`] if a standard uncertainty in `inputs` is negative, not a number or too
    /// large.
    pub(super) fn machine_effects(
        &self,
        registration: &Registration,
        inputs: &ModelInputs,
    ) -> Result<MachineEffects, ModelError> {
        let of_others = [inputs.radius_sigma_mm, inputs.scale_sigma];
        let datum = inputs.locked_sigmas.unwrap_or_default();
        if let Some((what, value)) = invalid_uncertainty(&inputs.machine, of_others, &datum) {
            return Err(ModelError::StatedUncertainty { what, value });
        }
        let model_from_machine = registration.cmm_from_model.rotation.transpose();
        Ok(MachineEffects::new(inputs.machine, of_others, datum, self.centre, model_from_machine))
    }

    /// Returns the Jacobian of the deviations with respect to the motions of the part. `points` has each point with its
    /// unit normal. The result has one row for each point and one column for each motion that the registration did not
    /// lock.
    ///
    /// An element is the change of the signed distance of the point from the surface, in mm, for a unit of the motion.
    /// A rotation is about the centroid. Its unit is 1 mm of arc at the RMS distance of the points from the centroid.
    pub(super) fn rows(&self, points: impl Iterator<Item = (Point, Vector)>) -> DMatrix<f64> {
        let rows: Vec<[f64; 6]> = points
            .map(|(point, normal)| {
                let arm = (point - self.centre).cross(&normal) / self.size_mm;
                [normal.x, normal.y, normal.z, arm.x, arm.y, arm.z]
            })
            .collect();
        DMatrix::from_fn(rows.len(), 6, |r, c| rows[r][c]) * &self.free
    }

    /// Converts the covariance of the motions that the registration did not lock to the covariance of a
    /// [`Twist`](crate::geometry::Twist) about the origin, in mm^2, mm rad and rad^2. The motions are about the
    /// centroid of the points. Locked directions get a variance of 0.
    fn to_twist(&self, covariance: &DMatrix<f64>) -> Matrix6<f64> {
        let whole = &self.free * covariance * self.free.transpose();
        let whole = Matrix6::from_fn(|r, c| whole[(r, c)]);
        // The size is positive, so the matrix is invertible.
        let back = motion_about(self.centre, self.size_mm).try_inverse().unwrap_or_else(Matrix6::identity);
        let mut twist = back * whole * back.transpose();
        // The terms of a locked direction cancel each other. A remainder of rounding can be negative.
        let terms = back.abs() * whole.abs() * back.abs().transpose();
        for k in 0..6 {
            if twist[(k, k)] <= MAX_CANCELLED_SHARE * terms[(k, k)] {
                twist.row_mut(k).fill(0.0);
                twist.column_mut(k).fill(0.0);
            }
        }
        twist
    }
}

/// Returns the matrix that converts a twist about the origin to a motion about the point `centre`. The first three
/// components of the motion are the shift of `centre`, in mm. The last three are the rotation in radians times
/// `size_mm`, so that they are also lengths in mm.
fn motion_about(centre: Point, size_mm: f64) -> Matrix6<f64> {
    let mut about = Matrix6::identity();
    // v + omega x c
    let cross: Matrix3<f64> = -centre.coords.cross_matrix();
    about.fixed_view_mut::<3, 3>(0, 3).copy_from(&cross);
    about.fixed_view_mut::<3, 3>(3, 3).copy_from(&(Matrix3::identity() * size_mm));
    about
}
