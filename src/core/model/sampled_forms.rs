//! Samples of the form from its posterior.

use nalgebra::{DMatrix, SymmetricEigen};
use rayon::prelude::*;
use regrind_figures::statistics::rms;

use super::hypotheses::FieldHypotheses;
use super::inputs::ModelInputs;
use super::intermediate::IntermediateNodes;
use super::interval::{DecisionBounds, FigureSamples};
use super::posterior::{NoisePrior, Posterior, PosteriorSamples};
use super::random_normals::NormalGenerator;
use super::{Observations, Prediction, orthonormal_base, spacing_mm};
use crate::geometry::{Point, PointTree};

/// Samples of the form at a set of places, one column for each sample.
pub(super) struct SampledForms {
    /// Samples of the posterior, and samples of fields with the second variance factor, which bound the extremes.
    pub(super) forms: [DMatrix<f64>; 2],
    /// Samples that count the measured deviations entirely as form, with the form that the pose absorbed. None unless
    /// the points are too few to separate form from noise, and the noise of the probe is unknown.
    pub(super) all_form: Option<DMatrix<f64>>,
    /// Motions by which the pose can have followed the form, one column for each sample. They belong to `all_form`.
    pub(super) absorbed_motions: DMatrix<f64>,
    pub(super) places: Vec<[f64; 2]>,
    /// Motions that a best fit removes, at the places.
    pub(super) effects: DMatrix<f64>,
    /// Index of the measured point at each place; empty if the places are not measured points.
    pub(super) chosen: Vec<usize>,
    /// Indices of the places that were not touched; empty if the places are measured points.
    pub(super) untouched: Vec<usize>,
    /// Standard uncertainty of the smooth form at each place.
    pub(super) smooth_sigma_mm: Vec<f64>,
    /// Standard deviation of the noise of each sample. `truncated_mm` is, for each variance factor, the standard
    /// deviation of the waves shorter than those of the basis.
    pub(super) noise_mm: Vec<f64>,
    pub(super) truncated_mm: [Vec<f64>; 2],
    /// Random effects of each sample, in standard uncertainties.
    pub(super) random_effects: DMatrix<f64>,
    /// The same samples between the places; None if they were not evaluated there.
    pub(super) intermediate: Option<IntermediateForms>,
}

/// Samples of the form between the places.
pub(super) struct IntermediateForms {
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
    pub(super) fn evaluate(
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
    pub(super) fn rough_where_touched(mut self, touched: &[[f64; 2]]) -> Self {
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
    pub(super) fn with_smooth_sigma(self, observed: &Observations) -> Self {
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
    pub(super) fn with_unresolved_form(
        mut self,
        observed: &Observations,
        posterior: &Posterior,
        inputs: &ModelInputs,
    ) -> Self {
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
    pub(super) fn with_narrow_form(mut self, inputs: &ModelInputs) -> Self {
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
    pub(super) fn without_ground_in(mut self, ground_in: Option<&DMatrix<f64>>) -> Self {
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
    pub(super) fn joined_with(self, other: Self) -> Self {
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
    pub(super) fn replaced_by(mut self, other: &Self) -> Self {
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
    pub(super) fn after_best_fit(mut self) -> Self {
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

    pub(super) fn points(&self) -> Vec<FormPoint> {
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
    pub(super) fn rms_smooth_sigma_mm(&self) -> f64 {
        rms(&self.smooth_sigma_mm)
    }

    /// Returns the figures RMS, PV and PV 99.8 % (PV without the outermost 0.1 % at either end) of each sample, in mm.
    /// They are computed from the places only, not from the nodes between the places.
    ///
    /// RMS comes from the posterior samples. PV and PV 99.8 % come from the second set of samples, which bounds the
    /// extremes. In this set, the variance of the field is multiplied by the second variance factor
    /// ([`HypothesisSet`]).
    pub(super) fn figures_at_places(&self) -> Vec<[f64; 3]> {
        let [plain, other] = self.forms.each_ref().map(|forms| self.figures_of(forms, None));
        plain.iter().zip(&other).map(|([rms, ..], [_, pv, most])| [*rms, *pv, *most]).collect()
    }

    /// Returns the samples of the figures RMS, PV and PV 99.8 % (PV without the outermost 0.1 % at either end), in mm.
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
    pub(super) fn figures(&self, is_seen: bool, [least, most]: [&[[f64; 3]]; 2]) -> [FigureSamples; 3] {
        let [plain, rough] =
            [0, 1].map(|k| self.figures_of(&self.forms[k], self.intermediate.as_ref().map(|of| &of.forms[0])));
        let all = self.all_form.as_ref().map(|all| self.figures_of(all, None));
        let low_factor = if (1..FEW_POINTS).contains(&self.chosen.len()) { FEW_LOW_FACTOR } else { 1.0 };
        [0, 1, 2].map(|k| {
            let of = |figures: &[[f64; 3]]| figures.iter().map(|of| of[k]).collect::<Vec<f64>>();
            let others = if k == 0 { most } else { &rough };
            let higher = [Some(others), all.as_deref()].into_iter().flatten().filter(|of| !of.is_empty()).map(of);
            FigureSamples::new(of(&plain), (of(least), higher), is_seen.then_some(low_factor))
        })
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
pub(super) fn without_best_fit(mut forms: DMatrix<f64>, effects: &DMatrix<f64>) -> DMatrix<f64> {
    let base = orthonormal_base(effects.clone());
    forms -= &base * base.tr_mul(&forms);
    forms
}

/// Returns the standard deviation of each row of `forms`, in mm. A row has the values of all samples at one place.
fn row_sigmas_mm(forms: &DMatrix<f64>) -> Vec<f64> {
    forms.row_iter().map(|row| row.variance().sqrt()).collect()
}

/// Number of samples of the posterior.
pub(super) const SAMPLES: usize = 1000;

/// Maximum number of places at which the samples are evaluated.
pub(super) const MAX_PLACES: usize = 6000;

/// Number of samples that are processed at a time.
const SAMPLES_PER_BLOCK: usize = 50;

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

/// Bounds of the figures of the form, for decisions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FormBounds {
    /// Peak to valley.
    pub pv: DecisionBounds,
    /// PV 99.8 %.
    pub pv_998: DecisionBounds,
    /// Root mean square.
    pub rms: DecisionBounds,
}

/// Minimum probability at which a possibility counts: that the field is rough, or that isolated points are neighbours
/// by chance.
pub(super) const MIN_PROBABILITY: f64 = 0.025;

/// Minimum degrees of freedom for a field to separate the noise from the form.
pub(super) const MIN_DEGREES_OF_FREEDOM: f64 = 20.0;

/// Number of points below which correlated noise of the probe, a drift for example, can look like form.
const FEW_POINTS: usize = 200;

/// Factor of the values below the median if there are few points. In simulations of a drift at 25, 50 and 100 points,
/// factor 1 covers the RMS in 91, 83 and 89 of 100 parts, this factor in 92 and more.
const FEW_LOW_FACTOR: f64 = 0.75;

/// Returns true if the noise of the probe is unknown and the points have fewer than [`MIN_DEGREES_OF_FREEDOM`] degrees
/// of freedom: too few to separate the form from the noise.
pub(super) fn is_underdetermined(posterior: &Posterior, inputs: &ModelInputs) -> bool {
    posterior.degrees_of_freedom() < MIN_DEGREES_OF_FREEDOM && noise_prior(inputs).is_none()
}

/// Returns [`ModelInputs::probe_noise_mm`] as the prior of the noise: its standard deviation in mm and the relative
/// uncertainty of this standard deviation. Returns `None` if the standard deviation is 0, that is, unknown.
pub(super) fn noise_prior(inputs: &ModelInputs) -> NoisePrior {
    (inputs.probe_noise_mm[0] > 0.0).then_some(inputs.probe_noise_mm)
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
pub(super) fn inverse_of_products(effects: &DMatrix<f64>) -> DMatrix<f64> {
    if effects.ncols() == 0 {
        return DMatrix::zeros(0, 0);
    }
    let inverse = effects.tr_mul(effects).pseudo_inverse(f64::EPSILON);
    inverse.unwrap_or_else(|_| DMatrix::zeros(effects.ncols(), effects.ncols()))
}
