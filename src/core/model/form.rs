//! What a registered measurement says of the form of a part, and of where its nominal frame is.
//!
//! The registration put the part where the deviations are smallest. What the part's own form did to that is told by the model: the motions
//! that the registration was free to make are its effects, the form is its field. The figures are those of the form after its own
//! best fit, over fields drawn from what the measurement leaves possible ([`super::posterior`]); so the scatter of the probe is taken off them, and
//! the pose is in their uncertainty.

use faer::Mat;
use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, SymmetricEigen, Vector6};

use rayon::prelude::*;

use super::budget::{self, BudgetEntry};
use super::hypotheses::FieldHypotheses;
use super::intermediate::IntermediateNodes;
use super::machine_uncertainty::{MachineEffects, MachineUncertainty, UncertaintySource, unsound};
use super::normals::Normals;
use super::posterior::{HypothesisSet, NoisePrior, Posterior, PosteriorSamples, select_hypotheses};
use super::spacing_mm;
use super::{AreaOptions, IsoFigures, SlopeFigures};
use super::{Hyperparameters, ModelError, Observed, Prediction, Prior};
use crate::form::{IsoFits, SlopesAt};
use crate::geometry::{Nearest, Point, Vector};
use crate::registration::{Deviation, LEAST_SIGMA_MM, PointStatus, Registration, robust_sigma};

/// What a registered measurement says of the form of a part.
#[derive(Clone, Debug)]
pub struct Form {
    /// How strong and how wide the form is, and how far the probe scatters.
    pub hyperparameters: Hyperparameters,
    /// Covariance of the pose as the place of the nominal frame: of the twist [v; omega] in the model frame, as that of the registration,
    /// which is how well the same pose would be found again. Units mm^2, mm rad, rad^2. Directions that were held have no variance.
    pub frame_covariance: Matrix6<f64>,
    /// The form after its own best fit, at every point that was used, in the order given; of a scan with more than 6,000 points at as many of
    /// them.
    pub points: Vec<FormPoint>,
    /// The figures of the form.
    pub figures: FormFigures,
    /// Power, irregularity and their like; none where the points are too few for them.
    pub iso: Option<IsoFigures>,
    /// The slopes of the smooth form; none where the points are too few for them.
    pub slope: Option<SlopeFigures>,
    /// How well the smooth form is known: the RMS of its standard uncertainty over all places.
    pub known_mm: f64,
    /// What the standard uncertainties of the figures come from, source by source; empty where they cannot be parted.
    pub budget: Vec<BudgetEntry>,
    /// What the points alone tell of the parameters, whatever was expected of them: it teaches of the parts that follow. None where no form is seen.
    pub hyperparameters_without_prior: Option<Hyperparameters>,
    /// Whether the points show a form at all. Where they do not, the figures are known from above alone, and their intervals begin at 0.
    pub is_seen: bool,
    /// How many degrees of freedom the fit leaves the points that the fields are told by.
    pub degrees_of_freedom: f64,
    /// Whether these are too few to tell the form from the scatter: the upper ends are those of a form that is all of what was found then.
    pub is_of_few: bool,
}

/// The form at a measured point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FormPoint {
    /// Where, in the model frame.
    pub at_mm: [f64; 2],
    /// The form there and its standard uncertainty.
    pub form: Prediction,
    /// Standard uncertainty of what of it is smooth: what a correction can be made by.
    pub smooth_sigma_mm: f64,
}

/// Figures with what the measurement leaves possible of each.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FormFigures {
    /// Root mean square.
    pub rms: Interval,
    /// Largest less least at the places of the form: of a whole pattern the touched points.
    pub pv: Interval,
    /// The same of the aperture, the places between them in it: without the outermost 0.1 % at either end, but none of the touched places is left
    /// out.
    pub pv_most_points: Interval,
}

/// A median, and the interval that holds the value with a probability of 95 %.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Interval {
    /// As probably above as below.
    pub median_mm: f64,
    /// Below it with a probability of 2.5 %.
    pub low_mm: f64,
    /// Above it with a probability of 2.5 %.
    pub high_mm: f64,
    /// Below it with the probability of [`ModelInputs::look_risk`]: for who looks more than once.
    #[serde(skip)]
    pub least_mm: f64,
    /// Above it with that probability.
    #[serde(skip)]
    pub most_mm: f64,
    /// Below it with the probability of [`ModelInputs::probability`]: for who judges.
    #[serde(skip)]
    pub accepted_mm: f64,
    /// Below each of them with one of [`Interval::PROBABILITIES`].
    #[serde(skip)]
    pub quantiles_mm: [f64; 15],
}

/// Fields that are drawn, and places at which they are looked at, at most.
const SAMPLES: usize = 1000;
/// Fields of one kind that are drawn, where one kind is looked at: the smooth ones for the lower ends, the rough ones for the upper ones where these are at
/// least so probable.
const FEWER: usize = 250;
const MAY_BE: f64 = 0.025;
const MOST_PLACES: usize = 6000;
/// Drawn fields that are worked on at a time.
const A_TIME: usize = 50;
/// By how much more a form has to be spoken for than none, in the logarithm of the likelihood of the best one: without a form it is so in one part of a hundred.
const EVIDENCE: f64 = 3.0;
/// A point further from the field than this many robust sigmas is none that scattered.
const STANDS_OUT: f64 = 6.0;
/// Where more than this share of the points stood out, they would not be apart from the form: it has no other.
const MOST_APART: f64 = 0.1;
/// Where the fit leaves fewer degrees of freedom, no field tells the scatter from the form.
const FEW_FREE: f64 = 20.0;
/// A direction whose variance is less than this share of the largest was held.
const HELD: f64 = 1e-13;

impl Form {
    /// Fits the model to a registration: its deviations over x and y of the model frame.
    ///
    /// # Errors
    /// Too few points, and points that leave nothing to tell the form by.
    pub fn estimate(registration: &Registration, inputs: &ModelInputs) -> Result<Self, ModelError> {
        let seen = FittedModel::of(registration, inputs, true)?;
        let posterior = seen.posterior(inputs);
        let chosen: Vec<usize> = thinned(seen.observed.places.len()).collect();
        let some = seen.observed.subset(&chosen);
        let at = |chosen: &[usize]| seen.ground_in.as_ref().map(|ground_in| ground_in.select_rows(chosen));
        let of = |draws: PosteriorSamples, is_between: bool| {
            let drawn = seen.drawn(draws, some.places.clone(), some.fixed_effects.clone(), is_between);
            let drawn = SampledForms { chosen: chosen.clone(), ..drawn }.known_as(&seen.observed);
            drawn.without(at(&seen.of_all(&chosen)).as_ref())
        };
        let whole = |drawn: SampledForms, apart: &[usize], inputs: &ModelInputs| {
            seen.with_those(apart, drawn.with_the_scatter(&seen.observed, &posterior, inputs), inputs).after_best_fit()
        };
        let drawn = of(posterior.samples(HypothesisSet::All, SAMPLES, 1), true);
        let slope = seen.slope(inputs, &posterior, &drawn);
        let drawn = whole(drawn, &seen.apart, inputs);
        let form = if seen.is_chance { &[][..] } else { &seen.agreed };
        let least =
            whole(of(posterior.samples(HypothesisSet::Smooth, FEWER, 2), false), form, &least_form(&posterior, inputs))
                .told_by();
        let most = match posterior.is_rough() > MAY_BE {
            true => whole(of(posterior.samples(HypothesisSet::Rough, FEWER, 3), false), &seen.apart, inputs).told_by(),
            false => Vec::new(),
        };
        let ground_in = at(&drawn.chosen);
        Ok(Self { slope, ..seen.form(inputs, &posterior, (&drawn, [&least, &most]), ground_in, true) })
    }

    /// Tells the form at places of the part that need not have been touched: points of the nominal surface with their normals, in the model
    /// frame. The figures are those of all of them.
    ///
    /// What is too narrow for the distance of the points is told from the scatter of the probe by [`ModelInputs::probe_scatter_mm`] alone. As
    /// nothing says how wide it is, every place has one of its own.
    ///
    /// # Errors
    /// Those of [`Form::of`].
    pub fn estimate_at(
        registration: &Registration,
        inputs: &ModelInputs,
        places: &[(Point, Vector)],
    ) -> Result<Self, ModelError> {
        Self::estimate_with(registration, inputs, places, true)
    }

    /// The same; where not all is asked for without slopes, ISO figures and the budget, which cost most where few points were touched.
    pub(super) fn estimate_with(
        registration: &Registration,
        inputs: &ModelInputs,
        places: &[(Point, Vector)],
        is_whole: bool,
    ) -> Result<Self, ModelError> {
        let seen = FittedModel::of(registration, inputs, false)?;
        let posterior = seen.posterior(inputs);
        let places: Vec<_> = thinned(places.len()).map(|k| places[k]).collect();
        let effects = seen.motions.rows(places.iter().copied());
        // Many more places than touches are close enough to each other.
        let is_between = places.len() < 2 * seen.kept.len();
        let at = places.iter().map(plane).collect();
        let drawn = seen.drawn(posterior.samples(HypothesisSet::All, SAMPLES, 1), at, effects, is_between);
        let drawn = SampledForms { untouched: (0..places.len()).collect(), ..drawn };
        let drawn = drawn.rough_where_touched(&seen.observed.places).known_as(&seen.observed);
        let ground_in = seen.ground_in.is_some().then(|| seen.stated.columns(places.iter().copied()));
        let drawn = drawn.without(ground_in.as_ref());
        let slope = if is_whole { seen.slope(inputs, &posterior, &drawn) } else { None };
        let drawn = seen.with_those(&seen.apart, drawn.with_what_is_narrow(inputs), inputs).after_best_fit();
        Ok(Self { slope, ..seen.form(inputs, &posterior, (&drawn, [&[], &[]]), ground_in, is_whole) })
    }
}

/// A registration as the model sees it, with what speaks for which parameters.
struct FittedModel {
    motions: Motions,
    /// What was observed at all points that were used.
    all: Observed,
    /// Those of them that no field explains, ascending: what stands there is form all the same.
    apart: Vec<usize>,
    /// Those of these that touches beside them agree with.
    agreed: Vec<usize>,
    /// Whether so many stand alone that two of them are neighbours by chance.
    is_chance: bool,
    /// The rest of them, and what was observed at those.
    kept: Vec<usize>,
    observed: Observed,
    /// What is stated of all points together.
    stated: MachineEffects,
    /// What of that has been ground into the part, at all points: nothing before the first correction.
    ground_in: Option<DMatrix<f64>>,
    fields: FieldHypotheses,
}

impl FittedModel {
    /// Lays the fields, without the points that none of them explains.
    fn of(registration: &Registration, inputs: &ModelInputs, at_points: bool) -> Result<Self, ModelError> {
        /// Each round tells the parameters anew, and without the tallest of a defect its flanks stand out.
        const ROUNDS: usize = 3;
        if let Some(priors) = &inputs.priors {
            priors.check()?;
        }
        /// So many touches lie around one.
        const AROUND: f64 = 8.0;
        let mut seen = Self::with_all_in_the_fit(registration, inputs, at_points)?;
        for _ in 0..ROUNDS {
            let more = seen.unexplained(inputs);
            let apart = seen.apart.len() + more.len();
            if more.is_empty() || apart as f64 > MOST_APART * seen.all.places.len() as f64 {
                break;
            }
            let mut apart = [&seen.apart[..], &more[..]].concat();
            apart.sort_unstable();
            let kept: Vec<usize> = (0..seen.all.places.len()).filter(|k| apart.binary_search(k).is_err()).collect();
            let observed = seen.all.subset(&kept);
            // What is left may be too few to tell anything; then it is told with them.
            let Ok(fields) = FieldHypotheses::over(&observed, seen.fields.kind) else { break };
            seen = Self { apart, kept, observed, fields, ..seen };
        }
        let left_out = registration.deviations.iter().filter(|d| d.status == PointStatus::Outlier).count();
        let alone = (left_out + seen.apart.len() - seen.agreed.len()) as f64;
        let by_chance = 0.5 * AROUND * alone * alone / seen.all.places.len() as f64;
        Ok(Self { is_chance: by_chance > MAY_BE, ..seen })
    }

    fn posterior(&self, inputs: &ModelInputs) -> Posterior<'_> {
        Posterior::of(&self.fields, &self.observed, inputs.priors.as_ref(), probe(inputs))
    }

    /// Forms at some places, in the frame of the registration: with the motions that take each to what was found.
    fn drawn(
        &self,
        draws: PosteriorSamples,
        places: Vec<[f64; 2]>,
        effects: DMatrix<f64>,
        is_between: bool,
    ) -> SampledForms {
        let Observed { fixed_effects: rows, random_effects: stated, deviations_mm, .. } = &self.observed;
        let weights = rows * inverse_of_products(rows);
        let found = weights.tr_mul(&DVector::from_column_slice(deviations_mm));
        let beside = weights.tr_mul(stated) * &draws.stated;
        let sums = self.fields.sums(&weights);
        let sums = Mat::from_fn(sums.nrows(), sums.ncols(), |r, c| sums[(r, c)]);
        let moved = draws.waves.each_ref().map(|waves| {
            let of_form = &sums * waves;
            DMatrix::from_fn(rows.ncols(), waves.ncols(), |m, c| found[m] - beside[(m, c)] - of_form[(m, c)])
        });
        SampledForms::by(&self.fields, draws, (places, effects), &moved, is_between)
    }

    /// The points that are further from the field than its scatter lets any of them be, of all that were used.
    fn unexplained(&self, inputs: &ModelInputs) -> Vec<usize> {
        /// Of fewer points nobody knows what is usual.
        const FEWEST: usize = 40;
        let Observed { places, deviations_mm, fixed_effects: effects, random_effects: stated, .. } = &self.observed;
        if places.len() < FEWEST {
            return Vec::new();
        }
        let posterior = self.posterior(inputs);
        let (waves, of_stated) = posterior.mean();
        let told = self.fields.at_points(&waves);
        let moved = stated * of_stated;
        let left = |k: usize| deviations_mm[k] - told[k] - moved[k];
        let residuals_mm = best_fitted(DMatrix::from_fn(places.len(), 1, |k, _| left(k)), effects);
        let (middle_mm, sigma_mm) = robust_sigma(residuals_mm.iter().copied());
        // Where a field goes through every point, what is left of them is no scatter.
        let scatter_mm = posterior.mean_hyperparameters().noise_sigma_mm;
        let limit_mm = STANDS_OUT * sigma_mm.max(0.5 * scatter_mm).max(LEAST_SIGMA_MM);
        let stands_out = |k: &usize| (residuals_mm[*k] - middle_mm).abs() > limit_mm;
        self.of_all(&(0..places.len()).filter(stands_out).collect::<Vec<_>>())
    }

    /// The numbers among all that were used of some that were kept.
    fn of_all(&self, chosen: &[usize]) -> Vec<usize> {
        chosen.iter().map(|&k| self.kept[k]).collect()
    }

    /// Puts points that no field explains into what is drawn, each with the height that was found there but for the scatter of a touch:
    /// in their order among the points, or in place of the nearest of other places.
    fn with_those(&self, apart: &[usize], drawn: SampledForms, inputs: &ModelInputs) -> SampledForms {
        let (rows, at_points) = (drawn.places.len(), !drawn.chosen.is_empty());
        let chosen = self.of_all(&drawn.chosen);
        let drawn = SampledForms { chosen, ..drawn };
        if apart.is_empty() {
            return drawn;
        }
        // Of the points of a scan as large a share as of the others, the tallest of them.
        let count = apart.len();
        let mut apart = apart.to_vec();
        if at_points {
            apart.sort_by(|a, b| self.all.deviations_mm[*b].abs().total_cmp(&self.all.deviations_mm[*a].abs()));
            apart.truncate((count * rows).div_ceil(self.kept.len().max(1)));
            apart.sort_unstable();
        }
        let found = self.touched_at(&apart, &drawn, inputs);
        if at_points { drawn.beside(found) } else { drawn.replaced_by(&found) }
    }

    /// What some of the points found, as often as forms are drawn.
    fn touched_at(&self, points: &[usize], drawn: &SampledForms, inputs: &ModelInputs) -> SampledForms {
        let stated = self.all.random_effects.select_rows(points) * &drawn.stated;
        let of_probe = |mm: f64| probe(inputs).map_or(mm, |[probe_mm, _]| mm.min(probe_mm));
        let mut forms = [0, 1].map(|_| DMatrix::zeros(points.len(), drawn.scatter_mm.len()));
        for c in 0..drawn.scatter_mm.len() {
            let mut normals = Normals::new(6, c as u64);
            let scatter_mm = of_probe(drawn.scatter_mm[c]);
            // The tallest touch of a defect is one that scattered upwards: where extremes are told from below, all of them do.
            let alike_mm = scatter_mm * normals.next();
            for (r, &k) in points.iter().enumerate() {
                let found_mm = self.all.deviations_mm[k] - stated[(r, c)];
                forms[0][(r, c)] = found_mm - scatter_mm * normals.next();
                forms[1][(r, c)] = found_mm - alike_mm;
            }
        }
        let found = SampledForms {
            all: drawn.all.is_some().then(|| forms[0].clone()),
            forms,
            places: points.iter().map(|&k| self.all.places[k]).collect(),
            effects: self.all.fixed_effects.select_rows(points),
            chosen: points.to_vec(),
            untouched: Vec::new(),
            smooth_sigma_mm: vec![mean(&drawn.scatter_mm); points.len()],
            scatter_mm: drawn.scatter_mm.clone(),
            narrow_mm: [Vec::new(), Vec::new()],
            stated: drawn.stated.clone(),
            between: None,
        };
        found.without(self.ground_in.as_ref().map(|columns| columns.select_rows(points)).as_ref())
    }

    /// Lays the fields over the points that the pose was fitted to. The others are far from the surface, and no field.
    fn with_all_in_the_fit(
        registration: &Registration,
        inputs: &ModelInputs,
        at_points: bool,
    ) -> Result<Self, ModelError> {
        let all = registration.deviations.iter().enumerate().filter(|(_, d)| d.status == PointStatus::Used);
        let (path, used): (Vec<f64>, Vec<&Deviation>) = all.map(|(k, d)| (k as f64, d)).unzip();
        if used.is_empty() {
            return Err(ModelError::TooFewPoints { points: 0, least: 7 });
        }
        let motions = Motions::of(registration, used.iter().map(|d| d.point));
        let stated = motions.stated(registration, inputs)?;
        let columns = stated.columns(used.iter().map(|d| (d.point, d.normal)));
        let (shown, ground_in) =
            if inputs.is_corrected { (DMatrix::zeros(used.len(), 0), Some(columns)) } else { (columns, None) };
        let observed = Observed { random_effects: shown, ..motions.observed(&used) };
        let path = if at_points && is_path(&observed.places) { path } else { Vec::new() };
        let observed = Observed { path, ..observed };
        let (kept, apart): (Vec<usize>, Vec<usize>) = (0..used.len()).partition(|&k| used[k].in_fit);
        let (all, observed) =
            if apart.is_empty() { (observed.clone(), observed) } else { (observed.clone(), observed.subset(&kept)) };
        let fields = select_hypotheses(&observed)?;
        Ok(Self {
            motions,
            all,
            agreed: apart.clone(),
            is_chance: false,
            apart,
            kept,
            observed,
            stated,
            ground_in,
            fields,
        })
    }

    /// The slopes of what is drawn, before anything is added that has none.
    fn slope(&self, inputs: &ModelInputs, posterior: &Posterior, drawn: &SampledForms) -> Option<SlopeFigures> {
        let slopes = SlopesAt::over(&drawn.places, inputs.area.integration_mm)?;
        let smooth = [0, 1].map(|k| best_fitted(drawn.forms[k].clone(), &drawn.effects));
        Some(SlopeFigures::of(&slopes, &smooth, (is_seen(posterior), inputs)))
    }

    /// The form by what is drawn, without its slopes; `ground_in` is what of it each of the stated effects may have made there.
    fn form(
        &self,
        inputs: &ModelInputs,
        posterior: &Posterior,
        (drawn, ends): (&SampledForms, [&[[f64; 3]]; 2]),
        ground_in: Option<DMatrix<f64>>,
        is_whole: bool,
    ) -> Form {
        let ground_into_kept = self.ground_in.as_ref().map(|columns| columns.select_rows(&self.kept));
        let alike = ground_into_kept.as_ref().unwrap_or(&self.observed.random_effects);
        let covariance = of_the_fit(&self.observed, (&self.fields, posterior), alike);
        // What stands apart is seen, whatever the rest shows.
        let is_seen = is_seen(posterior) || !self.apart.is_empty();
        let figures = drawn.figures(is_seen, ends, inputs);
        let budget = if is_whole { self.budget(inputs, posterior, drawn, ground_in, &figures) } else { Vec::new() };
        let iso = IsoFits::over(&drawn.places, inputs.area.middle_mm).filter(|_| is_whole);
        let hyperparameters = posterior.mean_hyperparameters();
        let alone = match inputs.priors {
            None => hyperparameters,
            Some(_) => self.posterior(&ModelInputs { priors: None, ..*inputs }).mean_hyperparameters(),
        };
        Form {
            hyperparameters: hyperparameters,
            hyperparameters_without_prior: is_seen.then_some(alone),
            frame_covariance: self.motions.to_twist(&covariance),
            points: drawn.points(),
            figures,
            budget,
            iso: iso.map(|fits| IsoFigures::of(&fits, &drawn.forms, is_seen, inputs)),
            slope: None,
            known_mm: drawn.known_mm(),
            is_seen,
            degrees_of_freedom: posterior.degrees_of_freedom(),
            is_of_few: is_of_few(posterior, inputs),
        }
    }
}

impl FittedModel {
    fn budget(
        &self,
        inputs: &ModelInputs,
        posterior: &Posterior,
        drawn: &SampledForms,
        ground_in: Option<DMatrix<f64>>,
        figures: &FormFigures,
    ) -> Vec<BudgetEntry> {
        let ground_in = ground_in.map(|columns| best_fitted(columns, &drawn.effects));
        let of_drawn = budget::SampledFigures {
            forms: &drawn.forms[0],
            places: &drawn.places,
            effects: &drawn.effects,
            ground_in,
        };
        let uncertainties_mm = [figures.rms, figures.pv_most_points].map(|of| of.standard_mm());
        let sources = self.stated.sources();
        let mut budget =
            budget::decompose((&self.observed, &sources), (&self.fields, posterior), &of_drawn, uncertainties_mm);
        budget.retain(|share| share.source != UncertaintySource::Datum || inputs.datum.is_some());
        budget
    }
}

/// Whether the points show a form at all.
fn is_seen(posterior: &Posterior) -> bool {
    posterior.evidence > EVIDENCE
}

/// Takes all of the scatter for that of the probe, where it may be: by this a form is told from below.
///
/// A reference sphere that was touched some twenty times tells the scatter of the probe to 15 %. What the points scatter by more need be no form.
fn least_form(posterior: &Posterior, inputs: &ModelInputs) -> ModelInputs {
    /// A probe that scatters by so many standard uncertainties more than was found is none.
    const MAY_SCATTER: f64 = 2.0;
    match probe(inputs) {
        Some([probe_mm, u]) if posterior.mean_hyperparameters().noise_sigma_mm < probe_mm * (MAY_SCATTER * u).exp() => {
            ModelInputs { probe_noise_mm: [0.0; 2], ..*inputs }
        }
        _ => *inputs,
    }
}

/// Whether the points are too few to tell the form from a scatter that nothing else tells.
fn is_of_few(posterior: &Posterior, inputs: &ModelInputs) -> bool {
    posterior.degrees_of_freedom() < FEW_FREE && probe(inputs).is_none()
}

/// What is known of the scatter of the probe itself.
fn probe(inputs: &ModelInputs) -> NoisePrior {
    (inputs.probe_noise_mm[0] > 0.0).then_some(inputs.probe_noise_mm)
}

fn mean(of: &[f64]) -> f64 {
    of.iter().sum::<f64>() / of.len().max(1) as f64
}

/// Whether points follow each other like those of a path that is gone along: most are near the one before.
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

fn plane((point, _): &(Point, Vector)) -> [f64; 2] {
    [point.x, point.y]
}

/// Some of so many, evenly.
fn thinned(of: usize) -> impl Iterator<Item = usize> {
    let most = of.min(MOST_PLACES);
    (0..most).map(move |k| k * of / most)
}

/// What the points cannot tell of themselves.
#[derive(Clone, Copy, Debug)]
pub struct ModelInputs {
    /// What is known of form and scatter beforehand; without it what every part of its size is like.
    pub priors: Option<Prior>,
    /// What the machine does to all points together, as its cell file states it.
    pub machine: MachineUncertainty,
    /// Standard uncertainty of the radius of the probe as it was found: it moves every point along its normal alike.
    pub radius_sigma_mm: f64,
    /// Standard uncertainty of all lengths, as a share of them: that of temperature and expansion.
    pub scale_sigma: f64,
    /// Standard uncertainties of where the part was held, where the registration was not free to move it: along x, y and z of the model in
    /// millimetres, and of its turns about them through the middle of the points in radians. 0 in what is taken for known, or was found.
    /// Nothing where the registration held nothing.
    pub datum: Option<[f64; 6]>,
    /// Whether the part was corrected by what the same machine found of it where it is held: then all that is stated is ground into it, and the
    /// points show it no more.
    pub is_corrected: bool,
    /// How far the probe itself scatters, and to what share of that it is known: what points scatter by more is form, too narrow to be told
    /// otherwise. 0 where nothing tells; all of the scatter is the probe's then.
    pub probe_noise_mm: [f64; 2],
    /// With what probability a figure may be beyond either of the bounds [`Interval::least_mm`] and [`Interval::most_mm`].
    pub look_risk: f64,
    /// With what probability a figure must be within its limit to be accepted.
    pub probability: f64,
    /// What the figures of an area go by.
    pub area: AreaOptions,
}

impl Default for ModelInputs {
    fn default() -> Self {
        Self {
            priors: None,
            machine: MachineUncertainty::default(),
            radius_sigma_mm: 0.0,
            scale_sigma: 0.0,
            datum: None,
            is_corrected: false,
            probe_noise_mm: [0.0; 2],
            look_risk: 0.005,
            probability: 0.975,
            area: AreaOptions::default(),
        }
    }
}

/// The covariance of the motions as the registration finds them, by least squares of deviations that a form makes alike: A+ (K + s^2) A+'
/// with A+ = (H'H)^-1 H' (Aitken 1935), and of what adds to all points alike. K is the mean of those of all fields that it may be.
fn of_the_fit(
    observed: &Observed,
    (fields, posterior): (&FieldHypotheses, &Posterior),
    alike: &DMatrix<f64>,
) -> DMatrix<f64> {
    let rows = &observed.fixed_effects;
    let inverse = inverse_of_products(rows);
    // A+, a row a point.
    let weights = rows * &inverse;
    let (covered, scatter2) = posterior.mean_covariance(&fields.sums(&weights));
    let drift = fields.kind.autocorrelation;
    let of_alike = weights.tr_mul(alike);
    inverse * (scatter2 * (1.0 + drift) / (1.0 - drift)) + covered + &of_alike * of_alike.transpose()
}

/// (H'H)^-1 of the effects H.
fn inverse_of_products(effects: &DMatrix<f64>) -> DMatrix<f64> {
    let inverse = effects.tr_mul(effects).pseudo_inverse(f64::EPSILON);
    inverse.unwrap_or_else(|_| DMatrix::zeros(effects.ncols(), effects.ncols()))
}

/// Forms that may have been, a column each, at some places.
struct SampledForms {
    /// The forms, and those by fields that follow the points more closely: by these the upper ends of extremes are told.
    forms: [DMatrix<f64>; 2],
    /// Where the points are few: forms that are all of what was found, but for the scatter.
    all: Option<DMatrix<f64>>,
    places: Vec<[f64; 2]>,
    effects: DMatrix<f64>,
    /// Which of the points the places are, where they are points.
    chosen: Vec<usize>,
    /// Which of the places were not touched, where they are no points.
    untouched: Vec<usize>,
    /// Standard uncertainty of what is told of each place, as far as it is smooth.
    smooth_sigma_mm: Vec<f64>,
    /// The scatter of each form, and what of either kind is in waves too short to be told.
    scatter_mm: Vec<f64>,
    narrow_mm: [Vec<f64>; 2],
    /// How much of what is stated each has beside it.
    stated: DMatrix<f64>,
    /// The same forms between the places.
    between: Option<IntermediateForms>,
}

/// Forms between places.
struct IntermediateForms {
    between: IntermediateNodes,
    forms: [DMatrix<f64>; 2],
    effects: DMatrix<f64>,
}

impl SampledForms {
    /// At some places, each with so much of the motions there, and where it is asked for between them.
    fn by(
        fields: &FieldHypotheses,
        draws: PosteriorSamples,
        (places, effects): (Vec<[f64; 2]>, DMatrix<f64>),
        moved: &[DMatrix<f64>; 2],
        is_between: bool,
    ) -> Self {
        let PosteriorSamples { waves, scatter_mm, narrow_mm, stated } = draws;
        let count = scatter_mm.len();
        let at = fields.basis.at(&places);
        let firsts: Vec<usize> = (0..count).step_by(A_TIME).collect();
        let is_between = is_between && places.len() < MOST_PLACES;
        let between = if is_between { IntermediateNodes::of(&places, &fields.basis) } else { None };
        let axes = between.as_ref().map(|between| fields.basis.grid(&between.grid));
        let mut forms = waves.each_ref().map(|waves| {
            let some = |first: &usize| {
                let of = &at * waves.subcols(*first, A_TIME.min(count - first));
                (0..of.ncols()).flat_map(|c| of.col_as_slice(c).to_vec()).collect::<Vec<f64>>()
            };
            DMatrix::from_vec(places.len(), count, firsts.par_iter().flat_map_iter(some).collect())
        });
        let between = between.zip(axes).map(|(between, axes)| {
            let on = waves.each_ref().map(|waves| {
                let one = |c: usize| {
                    let field = fields.basis.on_grid(&axes, waves.col_as_slice(c));
                    let along = between.grid.counts[0];
                    between.nodes.iter().map(|node| field[(node % along, node / along)]).collect::<Vec<f64>>()
                };
                let all = (0..count).into_par_iter().flat_map_iter(one).collect();
                DMatrix::from_vec(between.nodes.len(), count, all)
            });
            IntermediateForms { effects: between.rows(&effects), forms: on, between }
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
            all: None,
            places,
            effects,
            chosen: Vec::new(),
            untouched: Vec::new(),
            smooth_sigma_mm: Vec::new(),
            scatter_mm,
            narrow_mm,
            stated,
            between,
        }
    }

    /// Leaves the fields that follow the points more closely to the places that were touched: of others they say no more than that they may be anything.
    fn rough_where_touched(mut self, touched: &[[f64; 2]]) -> Self {
        let at = |&[x, y]: &[f64; 2]| Point::new(x, y, 0.0);
        let near2 = (0.5 * spacing_mm(&self.places)).powi(2);
        let tree = Nearest::of(touched.iter().map(at));
        let is_touched = |k: &usize| tree.to(&at(&self.places[*k]), 1).any(|(_, square)| square < near2);
        for k in (0..self.places.len()).filter(|k| !is_touched(k)) {
            let row = self.forms[0].row(k).into_owned();
            self.forms[1].set_row(k, &row);
        }
        self
    }

    /// Tells how well the smooth form is known. What is stated moves the part too, and so do motions at other places: neither is form.
    fn known_as(self, observed: &Observed) -> Self {
        let at_points = !self.chosen.is_empty();
        let smooth_sigma_mm = match at_points && observed.random_effects.ncols() == 0 {
            true => spread_mm(&self.forms[0]),
            false => spread_mm(&best_fitted(self.forms[0].clone(), &self.effects)),
        };
        Self { smooth_sigma_mm, ..self }
    }

    /// Takes in what of the scatter is too narrow a form to be told from it.
    ///
    /// What a smooth form leaves of the observations is the scatter of the probe and, as far as it is more than that, form. That share of what is left at a point is form; how much more or less is as uncertain as
    /// the scatter of the probe lets it be.
    fn with_the_scatter(mut self, observed: &Observed, posterior: &Posterior, inputs: &ModelInputs) -> Self {
        // Motions are left of the observations as well, and what is stated: neither is scatter. Between the touches the forms have all of their motions.
        let seen = observed.subset(&self.chosen);
        let effects = seen.all_effects();
        let base = if effects.ncols() > 0 { effects.qr().q() } else { effects };
        let fitted = |column: DMatrix<f64>| &column - &base * base.tr_mul(&column);
        let found = &seen.deviations_mm;
        if is_of_few(posterior, inputs) {
            let mut all = DMatrix::zeros(found.len(), self.scatter_mm.len());
            let free = posterior.degrees_of_freedom().max(1.0);
            for (c, mut form) in all.column_iter_mut().enumerate() {
                let mut normals = Normals::new(7, c as u64);
                // So few points may by chance have found less than the form has elsewhere: its variance is told like that of a sample.
                let chi2: f64 = (0..free as usize).map(|_| normals.next().powi(2)).sum();
                let larger = (found.len() as f64 / chi2.max(f64::MIN_POSITIVE)).sqrt().max(1.0);
                let scatter_mm = self.scatter_mm[c];
                form.iter_mut().zip(found).for_each(|(value, of)| *value = larger * of + scatter_mm * normals.next());
            }
            self.all = Some(all);
        }
        let Self { forms, scatter_mm, narrow_mm, .. } = &mut self;
        for (forms, narrow_mm) in forms.iter_mut().zip(narrow_mm) {
            let rows = forms.nrows();
            let of = |(c, form): (usize, &mut [f64])| {
                let mut normals = Normals::new(2, c as u64);
                let [probe_mm, more_mm] = parted(scatter_mm[c], narrow_mm[c], inputs, &mut normals);
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
        self.narrow_between(inputs);
        self
    }

    /// Adds what is too narrow to be told at places that were not touched: what the scatter is more than that of the probe, and short waves.
    fn with_what_is_narrow(mut self, inputs: &ModelInputs) -> Self {
        let Self { forms, scatter_mm, narrow_mm, .. } = &mut self;
        forms
            .iter_mut()
            .zip(narrow_mm)
            .for_each(|(forms, narrow_mm)| add_narrow(forms, (scatter_mm, narrow_mm), inputs, 4));
        self.narrow_between(inputs);
        self
    }

    fn narrow_between(&mut self, inputs: &ModelInputs) {
        let Self { between, scatter_mm, narrow_mm, .. } = self;
        if let Some(IntermediateForms { forms, .. }) = between {
            forms
                .iter_mut()
                .zip(narrow_mm)
                .for_each(|(forms, narrow_mm)| add_narrow(forms, (scatter_mm, narrow_mm), inputs, 8));
        }
    }

    /// Takes off what was ground in: each column as often as a normal number says.
    ///
    /// A part that was corrected by what a machine found of it has the machine's errors as its form, d = (f - E t) + E t + e, and the points
    /// show neither: t is as little known as before anything was measured.
    fn without(mut self, ground_in: Option<&DMatrix<f64>>) -> Self {
        let Some(columns) = ground_in.filter(|columns| columns.ncols() > 0) else { return self };
        let take = |forms: &mut DMatrix<f64>, columns: &DMatrix<f64>| {
            for (c, mut form) in forms.column_iter_mut().enumerate() {
                let mut normals = Normals::new(5, c as u64);
                for column in columns.column_iter() {
                    form.axpy(-normals.next(), &column, 1.0);
                }
            }
        };
        self.forms.iter_mut().for_each(|forms| take(forms, columns));
        if let Some(IntermediateForms { between, forms, .. }) = &mut self.between {
            let columns = between.rows(columns);
            forms.iter_mut().for_each(|forms| take(forms, &columns));
        }
        self
    }

    /// Both, in the order of the points.
    fn beside(self, other: Self) -> Self {
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
            all: self.all.as_ref().map(|all| joined(all, &other.forms[0])),
            effects: joined(&self.effects, &other.effects),
            places: order.iter().map(|&row| places[row]).collect(),
            chosen: order.iter().map(|&row| chosen[row]).collect(),
            smooth_sigma_mm: order.iter().map(|&row| sigma_mm[row]).collect(),
            ..self
        }
    }

    /// With what others found in the rows of the places that are nearest to theirs.
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

    /// Each form after its own best fit to the places.
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
        self.all.iter_mut().for_each(|all| {
            fit(all);
        });
        if let Some(IntermediateForms { forms, effects, .. }) = &mut self.between {
            for (forms, taken) in forms.iter_mut().zip(&taken) {
                // What the registration was free to do is seen by the points: the factor has an inverse.
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
            FormPoint { at_mm: *at_mm, form: Prediction { mean_mm, sigma_mm }, smooth_sigma_mm }
        };
        self.places.iter().enumerate().map(of).collect()
    }

    /// The RMS over all places of how well the smooth form is known.
    fn known_mm(&self) -> f64 {
        let squares: f64 = self.smooth_sigma_mm.iter().map(|sigma| sigma * sigma).sum();
        (squares / self.smooth_sigma_mm.len().max(1) as f64).sqrt()
    }

    /// The figures of each form at the places alone: RMS by the fields as they are, extremes by the others.
    fn told_by(&self) -> Vec<[f64; 3]> {
        let [plain, other] = self.forms.each_ref().map(|forms| self.figures_of(forms, None));
        plain.iter().zip(&other).map(|([rms, ..], [_, pv, most])| [*rms, *pv, *most]).collect()
    }

    /// The figures; where no form is seen they are known from above alone.
    fn figures(&self, is_seen: bool, [least, most]: [&[[f64; 3]]; 2], inputs: &ModelInputs) -> FormFigures {
        let [plain, rough] =
            [0, 1].map(|k| self.figures_of(&self.forms[k], self.between.as_ref().map(|of| &of.forms[0])));
        let all = self.all.as_ref().map(|all| self.figures_of(all, None));
        let interval = |k: usize| {
            let of = |figures: &[[f64; 3]]| figures.iter().map(|of| of[k]).collect::<Vec<f64>>();
            let others = if k == 0 { most } else { &rough };
            let higher = [Some(others), all.as_deref()].into_iter().flatten().filter(|of| !of.is_empty()).map(of);
            Interval::of(of(&plain), (of(least), higher), is_seen, inputs)
        };
        FormFigures { rms: interval(0), pv: interval(1), pv_most_points: interval(2) }
    }

    /// Root mean square, peak to valley, and that of the aperture, of each form.
    fn figures_of(&self, forms: &DMatrix<f64>, between: Option<&DMatrix<f64>>) -> Vec<[f64; 3]> {
        let rows = forms.nrows();
        let mut is_touched = vec![true; rows];
        self.untouched.iter().for_each(|&row| is_touched[row] = false);
        let of = |(c, form): (usize, &[f64])| {
            let squares: f64 = form.iter().map(|v| v * v).sum();
            let [low, high] = ends(form.iter().copied());
            // The outermost of all places are left out, but none that was touched.
            let touched = form.iter().zip(&is_touched).filter_map(|(value, is)| is.then_some(*value));
            let mut others: Vec<f64> = self.untouched.iter().map(|&row| form[row]).collect();
            between.iter().for_each(|between| others.extend(between.column(c).iter()));
            let [mut lowest, mut highest] = ends(touched);
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

fn ends(of: impl Iterator<Item = f64>) -> [f64; 2] {
    of.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| [low.min(value), high.max(value)])
}

/// Adds to every place of each form what is too narrow to be told there.
fn add_narrow(forms: &mut DMatrix<f64>, (scatter_mm, narrow_mm): (&[f64], &[f64]), inputs: &ModelInputs, stream: u64) {
    let rows = forms.nrows();
    let of = |(c, form): (usize, &mut [f64])| {
        let [_, more_mm] = parted(scatter_mm[c], narrow_mm[c], inputs, &mut Normals::new(2, c as u64));
        let mut normals = Normals::new(stream, c as u64);
        if more_mm > 0.0 {
            form.iter_mut().for_each(|value| *value += more_mm * normals.next());
        }
    };
    forms.as_mut_slice().par_chunks_mut(rows.max(1)).enumerate().for_each(of);
}

/// The scatter of the probe and what beside it is too narrow a form, each as it may be. Where nothing tells how
/// far the probe scatters all of the scatter is its own.
fn parted(scatter_mm: f64, narrow_mm: f64, inputs: &ModelInputs, normals: &mut Normals) -> [f64; 2] {
    let Some([probe_mm, probe_u]) = probe(inputs) else { return [scatter_mm, narrow_mm] };
    let own_mm = (probe_mm * (probe_u * normals.next()).exp()).min(scatter_mm);
    [own_mm, (scatter_mm.powi(2) - own_mm.powi(2)).max(0.0).sqrt().hypot(narrow_mm)]
}

/// Each form after its own best fit.
fn best_fitted(mut forms: DMatrix<f64>, effects: &DMatrix<f64>) -> DMatrix<f64> {
    if effects.ncols() > 0 {
        let base = effects.clone().qr().q();
        let fitted: DMatrix<f64> = &base * base.tr_mul(&forms);
        forms -= fitted;
    }
    forms
}

/// The standard deviation of each row.
fn spread_mm(forms: &DMatrix<f64>) -> Vec<f64> {
    forms.row_iter().map(|row| row.variance().sqrt()).collect()
}

impl Interval {
    /// The probabilities of the quantiles by which a figure is recorded.
    pub const PROBABILITIES: [f64; 15] =
        [0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975, 0.99, 0.995, 0.999];

    /// Returns the standard uncertainty: its width over that of a normal figure.
    pub fn standard_mm(&self) -> f64 {
        const WIDTH: f64 = 2.0 * 1.96;
        (self.high_mm - self.low_mm) / WIDTH
    }

    /// Of values that are equally probable; from below by others where those are lower, from above by whichever of others are higher.
    pub(super) fn of(
        mut values: Vec<f64>,
        (mut lower, higher): (Vec<f64>, impl Iterator<Item = Vec<f64>>),
        has_low: bool,
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
        let ModelInputs { look_risk, probability, .. } = *inputs;
        let nth = |of: &[f64], share: f64| of[((of.len() - 1) as f64 * share).round() as usize];
        let at = |share: f64| {
            let own = nth(&values, share);
            match share {
                _ if share > 0.5 => higher.iter().fold(own, |most, of| most.max(nth(of, share))),
                _ if share < 0.5 && !lower.is_empty() => own.min(nth(&lower, share)),
                _ => own,
            }
        };
        let low = |share: f64| if has_low { at(share) } else { 0.0 };
        Self {
            median_mm: at(0.5),
            low_mm: low(0.025),
            high_mm: at(0.975),
            least_mm: low(look_risk),
            most_mm: at(1.0 - look_risk),
            accepted_mm: at(probability),
            quantiles_mm: Self::PROBABILITIES.map(|share| if share < 0.5 { low(share) } else { at(share) }),
        }
    }
}

/// The motions that the registration was free to make, about the middle of the points and in units of their size.
pub(super) struct Motions {
    centre: Point,
    size_mm: f64,
    /// A column a motion.
    free: DMatrix<f64>,
}

impl Motions {
    pub(super) fn of(registration: &Registration, points: impl Iterator<Item = Point> + Clone) -> Self {
        let n = points.clone().count() as f64;
        let centre = Point::from(points.clone().fold(Vector::zeros(), |sum, p| sum + p.coords) / n);
        let size_mm = (points.map(|p| (p - centre).norm_squared()).sum::<f64>() / n).sqrt().max(f64::MIN_POSITIVE);
        let about = about(centre, size_mm);
        let covariance = about * registration.verdict.covariance * about.transpose();
        let SymmetricEigen { eigenvalues, eigenvectors } = covariance.symmetric_eigen();
        let seen = |k: &usize| eigenvalues[*k] > HELD * eigenvalues.max();
        let columns: Vec<Vector6<f64>> = (0..6).filter(seen).map(|k| eigenvectors.column(k).into_owned()).collect();
        let free = DMatrix::from_fn(6, columns.len(), |r, c| columns[c][r]);
        Self { centre, size_mm, free }
    }

    /// Deviations of which the motions move them all.
    pub(super) fn observed(&self, used: &[&Deviation]) -> Observed {
        Observed {
            places: used.iter().map(|d| [d.point.x, d.point.y]).collect(),
            deviations_mm: used.iter().map(|d| d.deviation_mm).collect(),
            fixed_effects: self.rows(used.iter().map(|d| (d.point, d.normal))),
            random_effects: DMatrix::zeros(used.len(), 0),
            path: Vec::new(),
        }
    }

    /// What is stated of all points together, about their middle.
    pub(super) fn stated(
        &self,
        registration: &Registration,
        inputs: &ModelInputs,
    ) -> Result<MachineEffects, ModelError> {
        let of_others = [inputs.radius_sigma_mm, inputs.scale_sigma];
        let datum = inputs.datum.unwrap_or_default();
        if let Some((what, value)) = unsound(&inputs.machine, of_others, &datum) {
            return Err(ModelError::Stated { what, value });
        }
        let model_from_machine = registration.cmm_from_model.rotation.transpose();
        Ok(MachineEffects::new(inputs.machine, of_others, self.centre, model_from_machine).held(datum))
    }

    /// What a unit of each motion adds to the distance of each point from the surface.
    pub(super) fn rows(&self, points: impl Iterator<Item = (Point, Vector)>) -> DMatrix<f64> {
        let rows: Vec<[f64; 6]> = points
            .map(|(point, normal)| {
                let arm = (point - self.centre).cross(&normal) / self.size_mm;
                [normal.x, normal.y, normal.z, arm.x, arm.y, arm.z]
            })
            .collect();
        DMatrix::from_fn(rows.len(), 6, |r, c| rows[r][c]) * &self.free
    }

    /// The covariance of the twist about the origin, of that of the free motions.
    fn to_twist(&self, covariance: &DMatrix<f64>) -> Matrix6<f64> {
        let whole = &self.free * covariance * self.free.transpose();
        let whole = Matrix6::from_fn(|r, c| whole[(r, c)]);
        // A motion is always one of a part that is there: the matrix has an inverse.
        let back = about(self.centre, self.size_mm).try_inverse().unwrap_or_else(Matrix6::identity);
        back * whole * back.transpose()
    }
}

/// Takes a twist about the origin to the motion of a centre and, in millimetres at the size, the turn about it.
fn about(centre: Point, size_mm: f64) -> Matrix6<f64> {
    let mut about = Matrix6::identity();
    // v + omega x c
    let cross: Matrix3<f64> = -centre.coords.cross_matrix();
    about.fixed_view_mut::<3, 3>(0, 3).copy_from(&cross);
    about.fixed_view_mut::<3, 3>(3, 3).copy_from(&(Matrix3::identity() * size_mm));
    about
}
