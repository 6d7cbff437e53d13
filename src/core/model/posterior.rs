//! Posterior of the field hypotheses: a probability for every node and variance ratio, and samples of the form.
//!
//! For a node and a variance ratio tau, let w = V'z be the projections of the coefficients z of the field, and
//! q = l tau / (1 + l tau). The posterior of these is that of independent numbers (Rasmussen and Williams 2006, 2.7).
//! Noise, variance ratio, smoothness and range are sampled together with the field, because a larger noise means a
//! weaker form. s^2 is sampled from its inverse gamma distribution. With random effects, or with a prior of the noise
//! of the probe, s is sampled from its density in equal steps of ln s.
//!
//! A stationary field treats a single peak as noise and shrinks it. Therefore the upper bounds of extremes use fields
//! of [`UPPER_BOUND_VARIANCE_FACTOR`] times the variance. These follow the points more closely.

use faer::Mat;
use nalgebra::{DMatrix, DVector, SymmetricEigen};
use rayon::prelude::*;

use super::hypotheses::{Components, FieldHypotheses, FieldHypothesis, NoiseKind, Projected, variance_ratios};
use super::noise_kind::candidates;
use super::random_normals::NormalGenerator;
use super::{Field, Hyperparameters, ModelError, Observations, Prior, Smoothness};

/// Factor on the variance of smooth fields for the upper bounds of extremes.
const UPPER_BOUND_VARIANCE_FACTOR: f64 = 16.0;
/// Factor on the variance of rough fields for the upper bounds of extremes.
const UPPER_BOUND_VARIANCE_FACTOR_ROUGH: f64 = 4.0;
/// Factor on the variance of fields for the lower bounds of extremes.
const LOWER_BOUND_VARIANCE_FACTOR: f64 = 1.0 / 4.0;
/// Factor by which the standard deviation of a field can exceed the RMS of the residuals (one standard deviation of its
/// logarithm). Used for the pose and for the hyperparameters.
const STRONGER: f64 = 3.0;

/// Prepares the field hypotheses for the more likely of two kinds of noise: with or without autocorrelation. A field
/// hypothesis is a smoothness with a range of the random field. The two kinds are compared by their marginal likelihood
/// from all points. If the points give too little evidence for an autocorrelation ([`candidates`]), only the kind
/// without autocorrelation is used.
///
/// All points are used for this reason: a comparison with neighbouring points alone can fail. Waves of the form across
/// the path of the probe then look like autocorrelation along the path.
///
/// # Errors
/// Returns the errors of [`FieldHypotheses::over`].
pub(super) fn select_hypotheses(observed: &Observations) -> Result<FieldHypotheses, ModelError> {
    let (plain, drifting) = candidates(observed);
    let fields = FieldHypotheses::over(observed, plain)?;
    let Some(drifting) = drifting else { return Ok(fields) };
    let other = FieldHypotheses::over(observed, drifting)?;
    let [without, with] = [&fields, &other].map(|of| Posterior::new(of, observed, None, None).log_likelihood());
    Ok(if with > without { other } else { fields })
}

/// Prior of the noise of the probe: its standard deviation in mm, and the standard deviation of the logarithm of this
/// value.
pub(super) type NoisePrior = Option<[f64; 2]>;

/// Field hypotheses with their probabilities.
pub(super) struct Posterior<'f> {
    pub(super) fields: &'f FieldHypotheses,
    observed: &'f Observations,
    probe: NoisePrior,
    /// Reduced coordinates of the deviations (first column) and of the random effects.
    coordinates: Mat<f64>,
    /// Projections of these columns for each node.
    projected: Vec<Projected>,
    /// Logarithm of the posterior density: one vector for each node, one value for each variance ratio.
    densities: Vec<Vec<f64>>,
    /// Logarithm of the likelihood ratio of the best field and no field.
    pub(super) evidence: f64,
    squares: f64,
}

/// Set of fields to sample from.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum HypothesisSet {
    /// All fields. The second variance factor is above 1, so that the samples follow the points more closely.
    All,
    /// Smooth fields only, because noise that is not normal looks like a rough field. The second variance factor is
    /// below 1, so that peaks are lower.
    Smooth,
    /// Rough fields only. The second variance factor is above 1.
    Rough,
}

impl HypothesisSet {
    fn contains(self, smoothness: Smoothness) -> bool {
        let is_rough = smoothness == Smoothness::Exponential;
        match self {
            Self::All => true,
            Self::Smooth => !is_rough,
            Self::Rough => is_rough,
        }
    }

    /// Returns the two factors by which the variance of a field with the given smoothness is multiplied for sampling.
    /// `self` is the set of fields.
    ///
    /// The first factor is 1, for samples of the posterior. The second factor is for samples that bound extreme values,
    /// such as the maximum of the form. The fields of `Smooth` give the lower bound, so the factor is below 1:
    /// [`LOWER_BOUND_VARIANCE_FACTOR`]. The fields of `All` and `Rough` give the upper bound, so the factor is above 1:
    /// [`UPPER_BOUND_VARIANCE_FACTOR_ROUGH`] if the field is rough ([`Smoothness::Exponential`]), otherwise
    /// [`UPPER_BOUND_VARIANCE_FACTOR`].
    fn variance_factors(self, smoothness: Smoothness) -> [f64; 2] {
        match self {
            Self::Smooth => [1.0, LOWER_BOUND_VARIANCE_FACTOR],
            _ if Self::Rough.contains(smoothness) => [1.0, UPPER_BOUND_VARIANCE_FACTOR_ROUGH],
            _ => [1.0, UPPER_BOUND_VARIANCE_FACTOR],
        }
    }
}

/// Samples of the field.
pub(super) struct PosteriorSamples {
    /// Coefficients of the basis functions, one column for each sample, for each of the two variance factors.
    pub(super) coefficients: [Mat<f64>; 2],
    /// Standard deviation of the noise of each sample.
    pub(super) noise_mm: Vec<f64>,
    /// Standard deviation of the waves shorter than those of the basis, for each of the two variance factors.
    pub(super) truncated_mm: [Vec<f64>; 2],
    /// Random effects in standard uncertainties, one column for each sample.
    pub(super) random_effects: DMatrix<f64>,
}

/// Share of the parts that is expected to resemble no earlier part.
const DISSIMILAR_SHARE: f64 = 0.2;

/// Returns the logarithm of the sum of the exponentials.
fn log_sum_exp(values: impl Iterator<Item = f64>) -> f64 {
    let all: Vec<f64> = values.collect();
    let top = all.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    top + all.iter().map(|value| (value - top).exp()).sum::<f64>().ln()
}

/// Returns the logarithm of the prior density of each hypothesis and variance ratio.
///
/// Without `priors` from earlier parts it is that of the hypothesis. Otherwise it is a mixture of both, each with the
/// sum 1: a part that resembles no earlier part, which the weight [`DISSIMILAR_SHARE`] expects, is judged as if no part
/// had been made (robust prior, Schmidli and others 2014). The sum of the mixture is that of the hypotheses.
fn expected_densities(hypotheses: &[FieldHypothesis], priors: Option<&Prior>) -> Vec<Vec<f64>> {
    let untaught: Vec<Vec<f64>> = hypotheses.iter().map(|node| node.prior.clone()).collect();
    let Some(priors) = priors else { return untaught };
    let of = |node: &FieldHypothesis| -> Vec<f64> {
        variance_ratios().map(|tau| priors.log_density(node.range_mm, (tau * node.scale).sqrt().recip())).collect()
    };
    let taught: Vec<Vec<f64>> = hypotheses.iter().map(of).collect();
    let [sum_taught, sum_untaught] = [&taught, &untaught].map(|all| log_sum_exp(all.iter().flatten().copied()));
    let mixed = |(taught, untaught): (&f64, &f64)| {
        let like = taught - sum_taught + sum_untaught + (1.0 - DISSIMILAR_SHARE).ln();
        log_sum_exp([like, untaught + DISSIMILAR_SHARE.ln()].into_iter())
    };
    taught.iter().zip(&untaught).map(|(taught, untaught)| taught.iter().zip(untaught).map(mixed).collect()).collect()
}

impl<'f> Posterior<'f> {
    /// Computes the posterior probability of every node (one smoothness with one range) at every variance ratio of
    /// field to noise.
    ///
    /// - `fields` has the nodes, and `observed` has the deviations. Both must have the same points.
    /// - `priors` is the prior of the range and of the ratio of noise to field. With `None`, the prior that is stored
    ///   with each node is used.
    /// - `probe` is the prior of the noise of the probe; `None` if nothing is known about it.
    pub(super) fn new(
        fields: &'f FieldHypotheses,
        observed: &'f Observations,
        priors: Option<&Prior>,
        probe: NoisePrior,
    ) -> Self {
        let stated = observed.random_effects.ncols();
        let columns = DMatrix::from_fn(observed.places.len(), 1 + stated, |r, c| match c {
            0 => observed.deviations_mm[r],
            c => observed.random_effects[(r, c - 1)],
        });
        let (coordinates, products) = fields.coordinates(&columns);
        let see = |node: &FieldHypothesis| fields.projected(node, &coordinates, &products);
        let seen: Vec<Projected> = fields.hypotheses.iter().map(see).collect();
        let posterior = Self {
            fields,
            observed,
            probe,
            coordinates,
            projected: seen,
            densities: Vec::new(),
            evidence: 0.0,
            squares: products[(0, 0)],
        };
        let expected = expected_densities(&fields.hypotheses, priors);
        let of = |(k, expected): (usize, &Vec<f64>)| {
            let likelihoods: Vec<f64> =
                variance_ratios().map(|tau| posterior.noise_likelihood(k, tau).log_marginal()).collect();
            let densities =
                likelihoods.iter().zip(expected).map(|(likelihood, expected)| likelihood + expected).collect();
            (likelihoods, densities)
        };
        let (likelihoods, densities): (Vec<Vec<f64>>, Vec<Vec<f64>>) = expected.par_iter().enumerate().map(of).unzip();
        let best = likelihoods.into_iter().flatten().fold(f64::NEG_INFINITY, f64::max);
        let none = if fields.hypotheses.is_empty() { best } else { posterior.noise_likelihood(0, 0.0).log_marginal() };
        Self { densities, evidence: best - none, ..posterior }
    }

    /// Returns the logarithm of the marginal likelihood of the deviations: the likelihood, averaged over all nodes and
    /// variance ratios with their prior probabilities.
    fn log_likelihood(&self) -> f64 {
        let expected = log_sum_exp(self.fields.hypotheses.iter().flat_map(|node| &node.prior).copied());
        log_sum_exp(self.densities.iter().flatten().copied()) - expected + self.fields.log_whitened
    }

    /// Returns the likelihood as a function of the standard deviation of the noise. The field is given by the node
    /// (smoothness with range) with the index `node`, and by the variance ratio `tau` of field to noise.
    fn noise_likelihood(&self, node: usize, tau: f64) -> NoiseLikelihood {
        let (node, columns) = (&self.fields.hypotheses[node], &self.projected[node]);
        let covariance = node.covariance(tau);
        let products = covariance.products(node, columns);
        let logs = covariance.log_determinant(self.fields.degrees_of_freedom);
        NoiseLikelihood::new(&products, logs, self.fields.degrees_of_freedom, self.probe)
    }

    /// Finds the most probable hypothesis. Returns the index of its node (smoothness with range), and its variance
    /// ratio of field to noise. Returns `None` if there are no nodes.
    fn most_probable(&self) -> Option<(usize, f64)> {
        let all = self.probabilities(HypothesisSet::All);
        all.into_iter().max_by(|a, b| a.2.total_cmp(&b.2)).map(|(node, tau, _)| (node, tau))
    }

    /// Finds the most probable hypothesis. Returns its node (smoothness with range), its variance ratio of field to
    /// noise, and the most probable standard deviation of the noise in mm for this node and ratio. Returns `None` if
    /// there are no nodes.
    pub(super) fn best(&self) -> Option<(&FieldHypothesis, f64, f64)> {
        let (number, tau) = self.most_probable()?;
        Some((&self.fields.hypotheses[number], tau, self.noise_likelihood(number, tau).mode_mm()))
    }

    /// Returns the posterior probability that the field is rough ([`Smoothness::Exponential`]).
    pub(super) fn rough_probability(&self) -> f64 {
        let is = |of: &(usize, f64, f64)| HypothesisSet::Rough.contains(self.fields.hypotheses[of.0].smoothness);
        self.probabilities(HypothesisSet::All).iter().filter(|of| is(of)).map(|of| of.2).sum()
    }

    /// Returns the degrees of freedom of the residuals: the number of points minus the number of fixed effects.
    pub(super) fn degrees_of_freedom(&self) -> f64 {
        self.fields.degrees_of_freedom
    }

    /// Returns the root mean square of the deviations after a least-squares fit of the fixed effects, in mm.
    fn rms_mm(&self) -> f64 {
        (self.squares / self.observed.places.len() as f64).max(0.0).sqrt()
    }

    /// Returns the posterior probabilities of the hypotheses in the set `which`. A hypothesis is a node (smoothness
    /// with range) at one variance ratio of field to noise. An entry has the index of the node, the variance ratio, and
    /// the probability. The probabilities have the sum 1. Hypotheses with at most 1e-7 of the largest probability are
    /// left out.
    fn probabilities(&self, which: HypothesisSet) -> Vec<(usize, f64, f64)> {
        let chosen =
            || self.densities.iter().enumerate().filter(|of| which.contains(self.fields.hypotheses[of.0].smoothness));
        let top = chosen().flat_map(|(_, of)| of).copied().fold(f64::NEG_INFINITY, f64::max);
        let all = chosen().flat_map(|(node, of)| {
            variance_ratios().zip(of).map(move |(tau, density)| (node, tau, (density - top).exp()))
        });
        let some: Vec<_> = all.filter(|(.., weight)| *weight > 1e-7).collect();
        let whole: f64 = some.iter().map(|(.., weight)| weight).sum();
        some.into_iter().map(|(node, tau, weight)| (node, tau, weight / whole)).collect()
    }

    /// Returns the hyperparameters of one hypothesis: the node (smoothness with range) with the index `node`, at the
    /// variance ratio `tau` of field to noise. The noise is set to its most probable standard deviation for this
    /// hypothesis.
    fn hyperparameters(&self, node: usize, tau: f64) -> Hyperparameters {
        let FieldHypothesis { smoothness, range_mm, scale, .. } = &self.fields.hypotheses[node];
        // If every deviation is zero, the noise is zero too: a positive minimum keeps the hyperparameters valid.
        let scatter_mm = self.noise_likelihood(node, tau).mode_mm().max(f64::MIN_POSITIVE.sqrt());
        let sigma_mm = scatter_mm * (tau * scale).sqrt();
        let NoiseKind { anisotropy: lay, autocorrelation: drift } = self.fields.kind;
        Hyperparameters {
            field: Field { sigma_mm, range_mm: *range_mm, smoothness: *smoothness, anisotropy: lay },
            noise_sigma_mm: scatter_mm,
            noise_autocorrelation: drift,
        }
    }

    /// Returns a weight, from 0 to 1, for a field with the given hyperparameters. The weight is 1 if the standard
    /// deviation of the field is at most the RMS of the residuals. Above this RMS, the weight falls with the standard
    /// deviation. A field that is much stronger than the residuals is improbable, because the points would show almost
    /// nothing of this field.
    fn strength_weight(&self, hyperparameters: &Hyperparameters) -> f64 {
        let beyond =
            (hyperparameters.field.sigma_mm / self.rms_mm().max(f64::MIN_POSITIVE)).ln().max(0.0) / STRONGER.ln();
        (-0.5 * beyond * beyond).exp()
    }

    /// Returns the hyperparameters of each node (smoothness with range) at its most probable variance ratio, with a
    /// relative weight. The weight is the posterior probability of the node, lowered for fields that are much stronger
    /// than the residuals. The entry with the largest weight comes first and has the weight 1. The others follow in
    /// descending order.
    ///
    /// Only nodes for whose smoothness `is_of` returns true are included.
    pub(super) fn weighted_hyperparameters(&self, is_of: impl Fn(Smoothness) -> bool) -> Vec<(Hyperparameters, f64)> {
        let of = |(node, densities): (usize, &Vec<f64>)| {
            let (tau, most) = variance_ratios().zip(densities).max_by(|a, b| a.1.total_cmp(b.1))?;
            let hyperparameters = self.hyperparameters(node, tau);
            let sum: f64 = densities.iter().map(|of| (of - most).exp()).sum();
            Some((
                hyperparameters,
                most + sum.ln() + self.strength_weight(&hyperparameters).max(f64::MIN_POSITIVE).ln(),
            ))
        };
        let chosen = self.densities.iter().enumerate().filter(|of| is_of(self.fields.hypotheses[of.0].smoothness));
        let mut all: Vec<(Hyperparameters, f64)> = chosen.filter_map(of).collect();
        all.sort_by(|a, b| b.1.total_cmp(&a.1));
        let top = all.first().map_or(0.0, |(_, of)| *of);
        all.into_iter().map(|(hyperparameters, of)| (hyperparameters, (of - top).exp())).collect()
    }

    /// Returns one value for each hyperparameter: the weighted geometric mean over the nodes (smoothness with range).
    /// The weights are those of [`Self::weighted_hyperparameters`]. Only nodes with the smoothness of the most probable
    /// node are averaged.
    ///
    /// Rough fields are not used, because their variance cannot be separated from the noise. If there is no smooth
    /// field, the standard deviations of field and noise are both the RMS of the residuals, and the range is 1 mm.
    pub(super) fn mean_hyperparameters(&self) -> Hyperparameters {
        let likely = self.weighted_hyperparameters(|smoothness| smoothness != Smoothness::Exponential);
        let Some((first, _)) = likely.first().copied() else {
            let scatter_mm = self.rms_mm().max(f64::MIN_POSITIVE.sqrt());
            return Hyperparameters {
                field: Field::new(scatter_mm, 1.0),
                noise_sigma_mm: scatter_mm,
                noise_autocorrelation: self.fields.kind.autocorrelation,
            };
        };
        let alike: Vec<_> = likely.iter().filter(|(of, _)| of.field.smoothness == first.field.smoothness).collect();
        let whole: f64 = alike.iter().map(|(_, weight)| weight).sum();
        let mean = |of: fn(&Hyperparameters) -> f64| {
            (alike.iter().map(|(hyperparameters, weight)| weight * of(hyperparameters).ln()).sum::<f64>() / whole).exp()
        };
        let field =
            Field { sigma_mm: mean(|of| of.field.sigma_mm), range_mm: mean(|of| of.field.range_mm), ..first.field };
        Hyperparameters { field, noise_sigma_mm: mean(|of| of.noise_sigma_mm), ..first }
    }

    /// Draws `count` samples from the posterior. `which` selects the fields: all, only the smooth ones, or only the
    /// rough ones. A sample has the coefficients of the basis functions for each of two variance factors, the standard
    /// deviation of the noise in mm, and the random effects in units of their standard uncertainties. A variance factor
    /// multiplies the variance of the field ([`HypothesisSet`]).
    ///
    /// The same `seed` gives the same samples. The result is empty if the set has no field.
    ///
    /// # Errors
    /// Returns an error if the eigenproblem of a field has no solution.
    pub(super) fn samples(
        &self,
        which: HypothesisSet,
        count: usize,
        seed: u64,
    ) -> Result<PosteriorSamples, ModelError> {
        let probabilities = self.probabilities(which);
        // Equal steps through the cumulative probability: the count of each field is within one of its expected value.
        let mut chosen: Vec<(usize, f64, usize)> = Vec::with_capacity(count);
        let (mut until, mut next) = (0.0, probabilities.iter());
        let mut now = next.next();
        for k in 0..count {
            let at = (k as f64 + 0.5) / count as f64;
            while let Some((_, _, weight)) = now
                && until + weight < at
                && next.len() > 0
            {
                until += weight;
                now = next.next();
            }
            if let Some((node, tau, _)) = now {
                chosen.push((*node, *tau, k));
            }
        }
        let nodes: Vec<&[(usize, f64, usize)]> =
            chosen.chunk_by(|a, b| a.0 == b.0).flat_map(|of| of.chunks(64)).collect();
        // Each eigenproblem once, before several chunks ask for the same one.
        let mut sampled: Vec<usize> = nodes.iter().map(|of| of[0].0).collect();
        sampled.dedup();
        sampled.par_iter().for_each(|&number| {
            self.fields.components(&self.fields.hypotheses[number]);
        });
        let made: Vec<PosteriorSamples> =
            nodes.par_iter().map(|of| self.samples_of(of[0].0, of, (which, seed))).collect::<Result<_, _>>()?;
        let mut draws = PosteriorSamples {
            coefficients: [0, 1].map(|_| Mat::zeros(self.fields.basis.len(), chosen.len())),
            noise_mm: Vec::new(),
            truncated_mm: [Vec::new(), Vec::new()],
            random_effects: DMatrix::zeros(self.observed.random_effects.ncols(), chosen.len()),
        };
        for of in made {
            let first = draws.noise_mm.len();
            draws.random_effects.columns_mut(first, of.random_effects.ncols()).copy_from(&of.random_effects);
            for (into, from) in draws.coefficients.iter_mut().zip(&of.coefficients) {
                for c in 0..from.ncols() {
                    into.col_as_slice_mut(first + c)[..from.nrows()].copy_from_slice(from.col_as_slice(c));
                }
            }
            draws.noise_mm.extend(of.noise_mm);
            draws.truncated_mm.iter_mut().zip(of.truncated_mm).for_each(|(into, from)| into.extend(from));
        }
        Ok(draws)
    }

    /// Draws posterior samples for one node (smoothness with range). Returns the samples in the order of `chosen`.
    ///
    /// - `number` is the index of the node.
    /// - `chosen` has one entry for each sample: the index of the node, the variance ratio of field to noise, and the
    ///   number of the sample.
    /// - `seed` and the number of the sample select the sequence of random numbers.
    /// - `which` is the set of fields. It selects two variance factors, which multiply the variance of the field.
    ///   Coefficients are drawn for each of the two factors.
    ///
    /// First a sample z0 of the prior is drawn. Then z0 is corrected so that its projections on the eigenvectors of the
    /// node get values drawn from the posterior (Matheron's rule).
    fn samples_of(
        &self,
        number: usize,
        chosen: &[(usize, f64, usize)],
        (which, seed): (HypothesisSet, u64),
    ) -> Result<PosteriorSamples, ModelError> {
        let node = &self.fields.hypotheses[number];
        let Components { eigenvalues, eigenvectors } =
            self.fields.components(node).ok_or(ModelError::Eigenproblem { range_mm: node.range_mm })?;
        let v = eigenvectors.transpose() * &self.coordinates;
        let (waves, seen, count) = (node.standard_deviations.len(), eigenvalues.len(), chosen.len());
        let mut streams: Vec<NormalGenerator> =
            chosen.iter().map(|(.., k)| NormalGenerator::new(seed, *k as u64)).collect();
        let told: Vec<(f64, DVector<f64>)> = chosen
            .iter()
            .zip(&mut streams)
            .map(|((_, tau, _), normals)| {
                let scale = self.noise_likelihood(number, *tau);
                let scatter_mm = scale.sample_mm(normals);
                (scatter_mm, scale.sample_random_effects(scatter_mm, normals))
            })
            .collect();
        let mut before = Mat::<f64>::zeros(waves, count);
        let mut by_points = Mat::<f64>::zeros(seen, count);
        for (c, normals) in streams.iter_mut().enumerate() {
            before.col_as_slice_mut(c).iter_mut().for_each(|value| *value = normals.next());
            by_points.col_as_slice_mut(c).iter_mut().for_each(|value| *value = normals.next());
        }
        let of_before = eigenvectors.transpose() * self.fields.coordinates_from(node, &before);
        let strength2 = |c: usize, under: f64| under * chosen[c].1 * node.scale * told[c].0.powi(2);
        let of = |under: f64| {
            let left = Mat::from_fn(seen, count, |k, c| {
                let (scatter2, field2, l) = (told[c].0.powi(2), strength2(c, under), eigenvalues[k]);
                let found = v[(k, 0)] - (0..told[c].1.len()).map(|e| told[c].1[e] * v[(k, 1 + e)]).sum::<f64>();
                let all = field2 * (l + node.truncated_variance) + scatter2;
                // Mean and standard deviation of l^(1/2) w.
                let mean = field2 * l / all * found;
                let spread = (field2 * l * (field2 * node.truncated_variance + scatter2) / all).sqrt();
                (mean + spread * by_points[(k, c)] - field2.sqrt() * of_before[(k, c)]) / l
            });
            let mut coefficients = self.fields.coefficients_from(node, &(eigenvectors * left));
            for c in 0..count {
                let sigma_mm = strength2(c, under).sqrt();
                let column = coefficients.col_as_slice_mut(c).iter_mut().zip(before.col_as_slice(c));
                column.zip(&node.standard_deviations).for_each(|((value, z), d)| *value = d * (*value + sigma_mm * z));
            }
            coefficients
        };
        let narrow_mm = which
            .variance_factors(node.smoothness)
            .map(|under| (0..count).map(|c| (strength2(c, under) * node.truncated_variance).sqrt()).collect());
        Ok(PosteriorSamples {
            coefficients: which.variance_factors(node.smoothness).map(of),
            random_effects: DMatrix::from_fn(self.observed.random_effects.ncols(), count, |e, c| told[c].1[e]),
            noise_mm: told.into_iter().map(|(scatter_mm, _)| scatter_mm).collect(),
            truncated_mm: narrow_mm,
        })
    }

    /// Returns the posterior mean for the most probable hypothesis. The first result has the coefficients of the basis
    /// functions. The second result has the random effects in units of their standard uncertainties. All values are 0
    /// if there is no hypothesis.
    pub(super) fn mean(&self) -> (Vec<f64>, DVector<f64>) {
        let mut waves = vec![0.0; self.fields.basis.len()];
        let Some((number, tau)) = self.most_probable() else {
            return (waves, DVector::zeros(self.observed.random_effects.ncols()));
        };
        let scale = self.noise_likelihood(number, tau);
        let stated = scale.random_effects_mode(scale.mode_mm());
        let weights: Vec<f64> = std::iter::once(1.0).chain(stated.iter().map(|effect| -effect)).collect();
        let node = &self.fields.hypotheses[number];
        let coefficients = self.fields.mean_coefficients((node, tau), &self.projected[number], &weights);
        waves.iter_mut().zip(coefficients).for_each(|(into, of)| *into = of);
        (waves, stated)
    }

    /// Returns two posterior averages over all hypotheses, both in mm^2: the covariance matrix of weighted sums of the
    /// field, and the variance of the noise. `sums` comes from [`FieldHypotheses::sums`] and has one row for each sum,
    /// one column for each basis function.
    ///
    /// The covariance includes only the cosines of the basis, not its polynomials. The variance of the noise includes
    /// the waves shorter than the basis functions. A field that is stronger than the residuals has less weight. Without
    /// any hypothesis, the covariance is 0 and the variance is the mean square of the residuals.
    pub(super) fn mean_covariance(&self, sums: &DMatrix<f64>) -> (DMatrix<f64>, f64) {
        let p = sums.nrows();
        let (mut covered, mut scatter2, mut whole) = (DMatrix::zeros(p, p), 0.0, 0.0);
        for (number, tau, weight) in self.probabilities(HypothesisSet::All) {
            let node = &self.fields.hypotheses[number];
            let weight = weight * self.strength_weight(&self.hyperparameters(number, tau));
            if weight < 1e-6 {
                continue;
            }
            let own2 = self.noise_likelihood(number, tau).mode_mm().powi(2);
            let strength2 = own2 * tau * node.scale;
            // The variance of the polynomials is as large as the corners of the part need. As form of the part, the
            // polynomials would make the pose more uncertain than real forms do.
            let cosines = self.fields.basis.polynomial_count()..node.standard_deviations.len();
            let strong = DMatrix::from_fn(p, cosines.len(), |r, k| {
                let wave = cosines.start + k;
                sums[(r, wave)] * node.standard_deviations[wave]
            });
            covered += &strong * strong.transpose() * (weight * strength2);
            scatter2 += weight * (own2 + strength2 * node.truncated_variance);
            whole += weight;
        }
        if whole > 0.0 { (covered / whole, scatter2 / whole) } else { (covered, self.rms_mm().powi(2)) }
    }
}

/// Likelihood of the noise s, with m degrees of freedom:
///
/// ```text
///  -2 ln p(s) = 2 m ln s + logs + sum ln(1 + u / s^2) + (S - sum b^2 / (s^2 + u)) / s^2
/// ```
///
/// K0 is the covariance of field and noise for s = 1 without random effects, S is d'K0^-1 d, and `logs` is the
/// logarithm of the determinant of K0. u are the eigenvalues of E'K0^-1 E. b are the components of E'K0^-1 d along the
/// eigenvectors.
struct NoiseLikelihood {
    degrees_of_freedom: f64,
    logs: f64,
    squares: f64,
    random_effect_terms: Vec<[f64; 2]>,
    axes: DMatrix<f64>,
    probe: NoisePrior,
}

impl NoiseLikelihood {
    /// Prepares the likelihood of the standard deviation of the noise. K0 is the covariance of field and noise for
    /// noise of variance 1, without the random effects.
    ///
    /// - `products` has the products a'K0^-1 b for all pairs a, b of columns. The first column is the deviations, the
    ///   others are the random effects.
    /// - `logs` is the logarithm of the determinant of K0.
    /// - `free` is the number of degrees of freedom: points minus fixed effects.
    /// - `probe` is the prior of the noise of the probe; `None` if nothing is known about it.
    fn new(products: &DMatrix<f64>, logs: f64, free: f64, probe: NoisePrior) -> Self {
        let stated = products.nrows() - 1;
        let (by_stated, axes) = if stated == 0 {
            (Vec::new(), DMatrix::zeros(0, 0))
        } else {
            let own = products.view((1, 1), (stated, stated)).into_owned();
            let SymmetricEigen { eigenvalues, eigenvectors } = own.symmetric_eigen();
            let beside = eigenvectors.tr_mul(&products.view((1, 0), (stated, 1)));
            (eigenvalues.iter().zip(&beside).map(|(u, b)| [u.max(0.0), *b]).collect(), eigenvectors)
        };
        Self {
            degrees_of_freedom: free,
            logs,
            squares: products[(0, 0)].max(f64::MIN_POSITIVE),
            random_effect_terms: by_stated,
            axes,
            probe,
        }
    }

    /// Returns the logarithm of the posterior density of ln s at the value `log_mm`, up to a constant. Here s is the
    /// standard deviation of the noise in mm. The prior of the noise of the probe is included if there is one.
    fn density(&self, log_mm: f64) -> f64 {
        let s2 = (2.0 * log_mm).exp();
        let mut value = 2.0 * self.degrees_of_freedom * log_mm + self.logs;
        let mut squares = self.squares;
        for [u, b] in &self.random_effect_terms {
            value += (u / s2).ln_1p();
            squares -= b * b / (s2 + u);
        }
        value += squares.max(0.0) / s2;
        // A touch has at least the noise of the probe. It has more if the form is too narrow to be resolved.
        let below = self.probe.map_or(0.0, |[probe_mm, u]| ((log_mm - probe_mm.ln()) / u.max(0.02)).min(0.0));
        -0.5 * (value + below * below)
    }

    /// Evaluates the posterior density of ln s on a grid of equal steps that covers practically the whole distribution.
    /// Here s is the standard deviation of the noise in mm. Returns the first value of ln s, the step of ln s, and the
    /// logarithm of the density at each grid point.
    fn steps(&self) -> (f64, f64, Vec<f64>) {
        const COARSE: usize = 24;
        const FINE: usize = 41;
        let told: f64 = self.random_effect_terms.iter().map(|[u, b]| b * b / u.max(f64::MIN_POSITIVE)).sum();
        let wide = (16.0 / (2.0 * self.degrees_of_freedom).sqrt()).max(0.05);
        let least = (self.squares - told).max(1e-12 * self.squares);
        let [mut low, mut high] = [
            0.5 * (least / self.degrees_of_freedom).ln() - wide,
            0.5 * (self.squares / self.degrees_of_freedom).ln() + wide,
        ];
        if let Some([probe_mm, u]) = self.probe {
            high = high.max(probe_mm.ln() + 4.0 * u);
        }
        let best = |low: f64, step: f64, count: usize| {
            let values = (0..=count).map(|k| self.density(low + step * k as f64));
            values.enumerate().fold((0, f64::NEG_INFINITY), |a, b| if b.1 > a.1 { b } else { a })
        };
        let mut at = low;
        let mut sigma = high - low;
        for _ in 0..24 {
            let step = (high - low) / COARSE as f64;
            at = low + step * best(low, step, COARSE).0 as f64;
            let [a, b, c] = [-step, 0.0, step].map(|off| self.density(at + off));
            let falls = (2.0 * b - a - c).max(f64::MIN_POSITIVE);
            sigma = step / falls.sqrt();
            if step < 0.5 * sigma {
                break;
            }
            (low, high) = (at - 1.5 * step, at + 1.5 * step);
        }
        let wide = 7.0 * sigma.min(wide);
        let step = 2.0 * wide / (FINE - 1) as f64;
        let first = at - wide;
        (first, step, (0..FINE).map(|k| self.density(first + step * k as f64)).collect())
    }

    fn is_closed_form(&self) -> bool {
        self.random_effect_terms.is_empty() && self.probe.is_none()
    }

    /// Returns the log marginal likelihood: the likelihood with the standard deviation s of the noise integrated out.
    /// Constants that are the same for every field are left out.
    fn log_marginal(&self) -> f64 {
        if self.is_closed_form() {
            return -0.5 * (self.logs + self.degrees_of_freedom * self.squares.ln());
        }
        let (_, step, densities) = self.steps();
        let top = densities.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        top + (step * densities.iter().map(|of| (of - top).exp()).sum::<f64>()).ln()
    }

    /// Returns the most probable standard deviation of the noise, in mm.
    fn mode_mm(&self) -> f64 {
        if self.is_closed_form() {
            return (self.squares / self.degrees_of_freedom).sqrt();
        }
        let (first, step, densities) = self.steps();
        let best = (0..densities.len()).fold(0, |best, k| if densities[k] > densities[best] { k } else { best });
        (first + step * best as f64).exp()
    }

    /// Draws a random standard deviation of the noise, in mm, from its posterior.
    fn sample_mm(&self, normals: &mut NormalGenerator) -> f64 {
        if self.is_closed_form() {
            // Chi-squared: for few degrees of freedom a sum of squared normal numbers, which is exact; otherwise the
            // cube-root approximation (Wilson and Hilferty 1931).
            const MANY: f64 = 60.0;
            let chi2 = if self.degrees_of_freedom <= MANY {
                (0..self.degrees_of_freedom as usize).map(|_| normals.next().powi(2)).sum::<f64>()
            } else {
                let ninth = 2.0 / (9.0 * self.degrees_of_freedom);
                self.degrees_of_freedom * (1.0 - ninth + ninth.sqrt() * normals.next()).powi(3)
            };
            return (self.squares / chi2.max(f64::MIN_POSITIVE)).sqrt();
        }
        let (first, step, densities) = self.steps();
        let top = densities.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let weights: Vec<f64> = densities.iter().map(|of| (of - top).exp()).collect();
        let mut left = normals.uniform() * weights.iter().sum::<f64>();
        let at = weights.iter().position(|weight| {
            left -= weight;
            left <= 0.0
        });
        (first + step * (at.unwrap_or(0) as f64 + normals.uniform() - 0.5)).exp()
    }

    /// Returns the most probable random effects, each in units of its standard uncertainty, if the standard deviation
    /// of the noise is `scatter_mm`.
    fn random_effects_mode(&self, scatter_mm: f64) -> DVector<f64> {
        let along = self.random_effect_terms.iter().map(|[u, b]| b / (scatter_mm * scatter_mm + u));
        &self.axes * DVector::from_iterator(self.random_effect_terms.len(), along)
    }

    /// Draws random effects from their posterior, each in units of its standard uncertainty, for a noise with the
    /// standard deviation `scatter_mm`.
    fn sample_random_effects(&self, scatter_mm: f64, normals: &mut NormalGenerator) -> DVector<f64> {
        let scatter2 = scatter_mm * scatter_mm;
        let spread = self.random_effect_terms.iter().map(|[u, _]| (1.0 + u / scatter2).sqrt().recip() * normals.next());
        let spread = &self.axes * DVector::from_iterator(self.random_effect_terms.len(), spread);
        self.random_effects_mode(scatter_mm) + spread
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns places on a part of 102 x 62 mm that cover it evenly and never repeat.
    fn places(count: u32) -> Vec<[f64; 2]> {
        let at = (0..count).map(|k| f64::from(k) + 0.5);
        at.map(|k| [(0.754_877_666 * k).fract() * 102.0, (0.569_840_291 * k).fract() * 62.0]).collect()
    }

    /// Returns observations of a field with known hyperparameters, plus a shift and a tilt that the model does not
    /// know.
    fn simulated(hyperparameters: Hyperparameters, places: Vec<[f64; 2]>, path: Vec<f64>, seed: u64) -> Observations {
        let n = places.len();
        let covariance = DMatrix::from_fn(n, n, |r, c| {
            hyperparameters.field.covariance_mm2(places[r], places[c]) + if r == c { 1e-14 } else { 0.0 }
        });
        let mut normals = NormalGenerator::new(seed, 0);
        let field = covariance.cholesky().unwrap().l() * DVector::from_fn(n, |_, _| normals.next());
        let mut last = normals.next();
        let mut of = |k: usize| {
            last = hyperparameters.noise_autocorrelation * last
                + (1.0 - hyperparameters.noise_autocorrelation * hyperparameters.noise_autocorrelation).sqrt()
                    * normals.next();
            field[k] + hyperparameters.noise_sigma_mm * last + 0.3 - 0.01 * places[k][0]
        };
        let deviations_mm = (0..n).map(&mut of).collect();
        let effects = DMatrix::from_fn(n, 3, |r, c| [1.0, places[r][0], places[r][1]][c]);
        Observations { fixed_effects: effects, path, ..Observations::without_effects(places, deviations_mm) }
    }

    const PLANTED: Hyperparameters =
        Hyperparameters { field: Field::new(5e-3, 30.0), noise_sigma_mm: 3e-4, noise_autocorrelation: 0.0 };

    #[test]
    fn hyperparameters_are_recovered() {
        let (mut sigma, mut range, mut scatter) = (0.0, 0.0, 0.0);
        const PARTS: u32 = 6;
        for seed in 0..PARTS {
            let found = Hyperparameters::estimate(
                &simulated(PLANTED, places(300), Vec::new(), u64::from(seed)),
                Some(&Prior::for_size(102.0)),
            )
            .unwrap();
            sigma += (found.field.sigma_mm / PLANTED.field.sigma_mm).ln() / f64::from(PARTS);
            range += (found.field.range_mm / PLANTED.field.range_mm).ln() / f64::from(PARTS);
            scatter += (found.noise_sigma_mm / PLANTED.noise_sigma_mm).ln() / f64::from(PARTS);
        }
        let off = [sigma, range, scatter].map(f64::exp);
        println!("sigma, range, scatter: {off:.3?} of what was planted");
        assert!((off[0] - 1.0).abs() < 0.3 && (off[1] - 1.0).abs() < 0.25 && (off[2] - 1.0).abs() < 0.12, "{off:?}");
    }

    /// Returns observations of points that are measured row by row, back and forth.
    fn in_rows(hyperparameters: Hyperparameters, seed: u64) -> Observations {
        let at = |k: usize| {
            [if (k / 30).is_multiple_of(2) { k % 30 } else { 29 - k % 30 }, k / 30].map(|at| 3.5 * at as f64)
        };
        simulated(hyperparameters, (0..540).map(at).collect(), (0..540).map(f64::from).collect(), seed)
    }

    #[test]
    fn noise_autocorrelation_is_recovered() {
        for drift in [0.0, 0.7, 0.9] {
            let planted = Hyperparameters { noise_autocorrelation: drift, ..PLANTED };
            // A strong drift leaves few independent touches, so the evidence for it varies by chance: the test uses the
            // median.
            const PARTS: u64 = 5;
            let told =
                |seed| Hyperparameters::estimate(&in_rows(planted, seed), Some(&Prior::for_size(102.0))).unwrap();
            let all: Vec<Hyperparameters> = (1..=PARTS).map(told).collect();
            let median = |of: &dyn Fn(&Hyperparameters) -> f64| {
                regrind_figures::statistics::median(&mut all.iter().map(of).collect::<Vec<f64>>()).unwrap()
            };
            let off = [
                median(&|h| h.noise_autocorrelation) - drift,
                median(&|h| (h.noise_sigma_mm / planted.noise_sigma_mm).ln()),
            ];
            println!(
                "drift {drift}: off by {off:.3?}, {:.3?}",
                all.iter().map(|h| h.noise_autocorrelation).collect::<Vec<_>>()
            );
            assert!(off[0].abs() < 0.2 && off[1].abs() < 0.3, "{off:?} {all:?}");
            assert!(drift > 0.0 || all.iter().all(|h| h.noise_autocorrelation == 0.0), "{all:?}");
        }
    }

    /// Next to a form, a strong drift looks like form. An estimate that misses the drift must assign it to the field,
    /// and must not count it as independent noise.
    #[test]
    fn strong_autocorrelation_is_not_noise() {
        let planted = Hyperparameters { noise_autocorrelation: 0.9, ..PLANTED };
        for seed in 1..=5 {
            let told = Hyperparameters::estimate(&in_rows(planted, seed), Some(&Prior::for_size(102.0))).unwrap();
            println!("seed {seed}: drift {:.2}, scatter {:.2e} mm", told.noise_autocorrelation, told.noise_sigma_mm);
            assert!(
                (told.noise_autocorrelation - 0.9).abs() < 0.2 || told.noise_sigma_mm < 0.7 * planted.noise_sigma_mm,
                "{seed}: {told:?}"
            );
        }
    }

    #[test]
    fn hyperparameters_scale_with_data() {
        let observed = simulated(PLANTED, places(120), Vec::new(), 1);
        let tenfold = Observations {
            deviations_mm: observed.deviations_mm.iter().map(|d| 10.0 * d).collect(),
            ..observed.clone()
        };
        let [a, b] = [observed, tenfold].map(|observed| Hyperparameters::estimate(&observed, None).unwrap());
        assert!((b.field.sigma_mm / a.field.sigma_mm - 10.0).abs() < 1e-6);
        assert!((b.field.range_mm / a.field.range_mm - 1.0).abs() < 1e-9);
    }

    /// Priors that exclude everything but one range leave the fifth of the other parts as it was.
    #[test]
    fn dissimilar_part_is_judged_without_earlier_parts() {
        let observed = simulated(PLANTED, places(60), Vec::new(), 3);
        let fields = FieldHypotheses::over(&observed, NoiseKind::PLAIN).unwrap();
        let untaught = expected_densities(&fields.hypotheses, None);
        let priors = Prior { range_mm: [30.0, 1.0 + 1e-9], noise_ratio: [0.1, 1.0 + 1e-9] };
        let taught = expected_densities(&fields.hypotheses, Some(&priors));
        let sum = |all: &[Vec<f64>]| log_sum_exp(all.iter().flatten().copied());
        assert!((sum(&taught) - sum(&untaught)).abs() < 1e-9, "{} {}", sum(&taught), sum(&untaught));
        let pairs = || taught.iter().flatten().zip(untaught.iter().flatten());
        let kept = pairs().filter(|(taught, untaught)| (**taught - **untaught - 0.2f64.ln()).abs() < 1e-9).count();
        // One place, or a few that are equally near, have the rest.
        assert!(kept + 4 >= pairs().count() && kept < pairs().count(), "{kept} of {}", pairs().count());
    }

    /// Compares the likelihood with the one that the covariance of the basis functions gives directly, for few and for
    /// many points:
    ///
    /// ```text
    ///  -2 ln p = ln |K| + ln |H'K^-1 H| - ln |H'H| + m ln d'K^-1 (d - H b)
    /// ```
    #[test]
    fn likelihood_matches_basis_covariance() {
        for (count, near) in [(60, 1e-6), (500, 0.2)] {
            let observed = simulated(PLANTED, places(count), Vec::new(), 3);
            let n = observed.places.len();
            let fields = FieldHypotheses::over(&observed, NoiseKind::PLAIN).unwrap();
            let posterior = Posterior::new(&fields, &observed, None, None);
            let is_one = |node: &FieldHypothesis| node.smoothness == Smoothness::Matern2 && node.range_mm > 30.0;
            let number = fields.hypotheses.iter().position(is_one).unwrap();
            let node = &fields.hypotheses[number];
            let waves = fields.basis.at(&observed.places);
            let rows =
                DMatrix::from_fn(n, node.standard_deviations.len(), |r, c| waves[(r, c)] * node.standard_deviations[c]);
            let field = &rows * rows.transpose() + DMatrix::identity(n, n) * node.truncated_variance;
            let (h, d) = (&observed.fixed_effects, DVector::from_column_slice(&observed.deviations_mm));
            let by_hand = |tau: f64| {
                let k = (&field * (tau * node.scale) + DMatrix::identity(n, n)).cholesky().unwrap();
                let log_det = |of: nalgebra::Cholesky<f64, nalgebra::Dyn>| 2.0 * of.l().diagonal().map(f64::ln).sum();
                let gram = h.tr_mul(&k.solve(h));
                let b = gram.clone().cholesky().unwrap().solve(&h.tr_mul(&k.solve(&d)));
                let squares = d.dot(&k.solve(&(&d - h * b)));
                let logs = log_det(k) + log_det(gram.cholesky().unwrap()) - log_det(h.tr_mul(h).cholesky().unwrap());
                -0.5 * (logs + fields.degrees_of_freedom * squares.ln())
            };
            for tau in [0.0, 0.3, 30.0, 1000.0] {
                let [told, exact] = [posterior.noise_likelihood(number, tau).log_marginal(), by_hand(tau)];
                assert!((told - exact).abs() < near, "{count} {tau}: {told} {exact}");
            }
        }
    }
}
