//! Form of a part and position of its nominal frame, estimated from a registered measurement.
//!
//! The registration places the part where the deviations are smallest. The form of the part influences that pose. The
//! model accounts for it: the motions that the registration was free to make are the fixed effects, and the form is the
//! field. The figures are those of the form after its own best fit, over samples of the posterior
//! ([`super::posterior`]). Therefore they do not contain the noise of the probe, and their uncertainty contains that of
//! the pose.

use faer::Mat;
use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, SymmetricEigen, Vector6};
use regrind_figures::FormFigures;
use regrind_figures::statistics::median;

use super::budget::{self, BudgetEntry};
use super::hypotheses::FieldHypotheses;
use super::inputs::ModelInputs;
use super::machine_uncertainty::{MachineEffects, UncertaintySource, invalid_uncertainty};
use super::posterior::{HypothesisSet, Posterior, PosteriorSamples, select_hypotheses};
use super::random_normals::NormalGenerator;
use super::sampled_forms::{
    FormBounds, FormPoint, MAX_PLACES, MIN_PROBABILITY, SAMPLES, SampledForms, inverse_of_products, is_underdetermined,
    noise_prior, without_best_fit,
};
use super::{Hyperparameters, ModelError, Observations, spacing_mm};
use super::{IsoFigures, SlopeFigures};
use crate::form::{IsoFits, SlopeOperator};
use crate::geometry::{Point, Vector};
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
    /// Figures of the form over [`Form::points`], or over the places that were asked for.
    pub figures: FormFigures,
    /// Bounds of these figures, for decisions while the measurement grows.
    pub bounds: FormBounds,
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

/// Seed of the samples of all fields.
const SEED: u64 = 1;
/// Number of samples of one kind of field: the smooth fields for the lower bounds, the rough fields for the upper
/// bounds.
const BOUND_SAMPLES: usize = 250;
/// Minimum logarithm of the likelihood ratio of the best field and no field for a form to count as detected. Without a
/// form one part in a hundred exceeds it.
const MIN_EVIDENCE: f64 = 3.0;
/// Maximum distance of a point from the field, in robust sigmas, that counts as noise.
const OUTLIER_SIGMAS: f64 = 6.0;
/// Maximum share of points that can stand out from the field. If more stand out, they are part of the form itself.
const MAX_OUTLIER_SHARE: f64 = 0.1;
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
        let at_points = AtPoints::new(&seen);
        let whole = |drawn: SampledForms, apart: &[usize], inputs: &ModelInputs| {
            at_points.with_all_form(drawn, apart, (&posterior, inputs))
        };
        let drawn = at_points.smooth_forms(posterior.samples(HypothesisSet::All, SAMPLES, SEED)?, true);
        let slope = seen.slope(inputs, &posterior, &drawn);
        let drawn = whole(drawn, &seen.unexplained, inputs);
        let form = if seen.is_chance { &[][..] } else { &seen.confirmed };
        let bounded = |of: HypothesisSet, seed: u64, apart: &[usize], inputs: &ModelInputs| {
            let drawn = at_points.smooth_forms(posterior.samples(of, BOUND_SAMPLES, seed)?, false);
            Ok::<_, ModelError>(whole(drawn, apart, inputs).figures_at_places())
        };
        let least = bounded(HypothesisSet::Smooth, 2, form, &min_form_inputs(&posterior, inputs))?;
        let most = match posterior.rough_probability() > MIN_PROBABILITY {
            true => bounded(HypothesisSet::Rough, 3, &seen.unexplained, inputs)?,
            false => Vec::new(),
        };
        let ground_in = at_points.ground_in(&drawn.chosen);
        Ok(Self { slope, ..seen.form(inputs, &posterior, (&drawn, [&least, &most]), ground_in, true) })
    }

    /// Draws `count` samples of the form from its posterior, at the points of [`Form::points`]. The result has one row
    /// for each point and one column for each sample, in mm. Each sample is a form after its own best fit. The same
    /// `count` gives the same samples. 1000 samples are those of the figures.
    ///
    /// # Errors
    /// Returns the errors of [`Form::estimate`].
    pub fn sample(registration: &Registration, inputs: &ModelInputs, count: usize) -> Result<DMatrix<f64>, ModelError> {
        let seen = FittedModel::fit(registration, inputs, true)?;
        let posterior = seen.posterior(inputs);
        let at_points = AtPoints::new(&seen);
        let drawn = at_points.smooth_forms(posterior.samples(HypothesisSet::All, count, SEED)?, true);
        let [forms, _] = at_points.with_all_form(drawn, &seen.unexplained, (&posterior, inputs)).forms;
        Ok(forms)
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
        let drawn =
            seen.evaluate_samples(posterior.samples(HypothesisSet::All, SAMPLES, SEED)?, at, effects, is_between);
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

/// Fitted model with the measured points at which its samples are evaluated.
struct AtPoints<'a> {
    model: &'a FittedModel,
    /// Indices of these points among those that are not outliers.
    chosen: Vec<usize>,
    observed: Observations,
}

impl<'a> AtPoints<'a> {
    fn new(model: &'a FittedModel) -> Self {
        let chosen: Vec<usize> = thinned(model.observed.places.len()).collect();
        Self { observed: model.observed.subset(&chosen), chosen, model }
    }

    /// Returns the columns of the machine effects that are ground into the part, at the points `chosen`.
    fn ground_in(&self, chosen: &[usize]) -> Option<DMatrix<f64>> {
        self.model.ground_in.as_ref().map(|ground_in| ground_in.select_rows(chosen))
    }

    /// Evaluates samples of the smooth form. `is_between` is that of [`FittedModel::evaluate_samples`].
    fn smooth_forms(&self, draws: PosteriorSamples, is_between: bool) -> SampledForms {
        let Observations { places, fixed_effects, .. } = &self.observed;
        let drawn = self.model.evaluate_samples(draws, places.clone(), fixed_effects.clone(), is_between);
        let drawn = SampledForms { chosen: self.chosen.clone(), ..drawn }.with_smooth_sigma(&self.model.observed);
        drawn.without_ground_in(self.ground_in(&self.model.indices_of_all(&self.chosen)).as_ref())
    }

    /// Adds the form that is too narrow to be resolved and the points `apart` that no field explains, and subtracts
    /// the best fit of each sample.
    fn with_all_form(
        &self,
        drawn: SampledForms,
        apart: &[usize],
        (posterior, inputs): (&Posterior, &ModelInputs),
    ) -> SampledForms {
        let drawn = drawn.with_unresolved_form(&self.model.observed, posterior, inputs);
        self.model.with_unexplained_points(apart, drawn, inputs).after_best_fit()
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
        Some(SlopeFigures::from_forms(&slopes, &smooth, is_form_detected(posterior)))
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
        let hyperparameters = posterior.mean_hyperparameters();
        let [rms, pv, pv_998] = drawn.figures(is_seen, ends);
        let figures = FormFigures {
            pv: pv.interval_with_quantiles(),
            pv_998: pv_998.interval_with_quantiles(),
            rms: rms.interval_with_quantiles(),
            noise_sigma_mm: hyperparameters.noise_sigma_mm,
        };
        let bounds = FormBounds { pv: pv.bounds(inputs), pv_998: pv_998.bounds(inputs), rms: rms.bounds(inputs) };
        let budget = if is_whole { self.budget(inputs, posterior, drawn, ground_in, &figures) } else { Vec::new() };
        let iso = IsoFits::new(&drawn.places, inputs.area.middle_mm).filter(|_| is_whole);
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
            bounds,
            budget,
            iso: iso.map(|fits| IsoFigures::from_forms(&fits, &drawn.forms, is_seen)),
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
    median(&mut steps_mm).is_some_and(|median_mm| median_mm <= NEAR * spacing_mm(places))
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
