//! Uncertainty budget of the figures, source by source.
//!
//! Near the sampled forms, a figure is approximated by a sum over places of the form times the mean derivative of the
//! figure at that place. The variance of that sum is decomposed exactly, for the most probable field. The standard
//! uncertainty of the figure itself, from the sampled forms, is divided in the same proportions.

use faer::linalg::solvers::{Llt, Solve};
use faer::{Mat, Side};
use nalgebra::{DMatrix, DVector};

use super::hypotheses::FieldHypotheses;
use super::machine_uncertainty::UncertaintySource;
use super::posterior::Posterior;
use super::sampled_forms::SampledForms;
use super::{Observations, orthonormal_base};

/// Contribution of one source to the standard uncertainties of the figures; the squares of all contributions add up.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct BudgetEntry {
    /// Source of the contribution.
    pub source: UncertaintySource,
    /// True if the standard uncertainty of the source is stated; if not, the source counts as 0.
    pub is_stated: bool,
    /// Contribution to the standard uncertainty of the root mean square, in mm.
    pub rms_mm: f64,
    /// Contribution to the standard uncertainty of PV 99.8 % (without the outermost 0.1 % at either end), in mm.
    pub pv_99_8_mm: f64,
}

/// Components of a variance, by source.
struct VarianceComponents {
    /// Noise of the points.
    noise: f64,
    /// Field between the points.
    form: f64,
    /// Unknown motions of the part.
    pose: f64,
    /// Each random effect.
    random_effects: Vec<f64>,
}

/// Computes the uncertainty budget of two figures of the form: the root mean square and PV 99.8 % (PV without the
/// outermost 0.1 % at either end). `uncertainties_mm` has the standard uncertainties of the two figures, in mm. Each is
/// divided among its sources. Returns one entry for each source of uncertainty, such as the noise or the pose. Returns
/// no entry if the variances cannot be computed.
///
/// - `observed` has the observed points and their random effects.
/// - `sources` has the source of each column of `ground_in`. If `ground_in` is `None`, `sources` has the source of each
///   random effect in `observed`.
/// - `fields` and `posterior` are the hypotheses (smoothness and range) of the random field, and their probabilities.
/// - `drawn` has the sampled forms.
/// - `ground_in` is `None` before the first correction of the part. Later, each column has the form that one error of
///   the machine has ground into the part. The size of this error is one standard uncertainty. The best fit of the form
///   is already subtracted. There is one row for each place of `drawn`.
pub(super) fn decompose(
    (observed, sources): (&Observations, &[UncertaintySource]),
    (fields, posterior): (&FieldHypotheses, &Posterior),
    (drawn, ground_in): (&SampledForms, Option<&DMatrix<f64>>),
    uncertainties_mm: [f64; 2],
) -> Vec<BudgetEntry> {
    let (slopes, by_ground_in) = slopes(drawn, ground_in);
    let of = |figure: usize| {
        let mut parts = parts(observed, fields, posterior, (&drawn.places, &slopes[figure]))?;
        if ground_in.is_some() {
            parts.random_effects.clone_from(&by_ground_in[figure]);
        }
        let whole = parts.noise + parts.form + parts.pose + parts.random_effects.iter().sum::<f64>();
        let share = |source: UncertaintySource| match source {
            UncertaintySource::Scatter => parts.noise,
            UncertaintySource::Form => parts.form,
            UncertaintySource::Pose => parts.pose,
            _ => parts.random_effects.iter().zip(sources).filter(|(_, of)| **of == source).map(|(part, _)| part).sum(),
        };
        let of_whole = UncertaintySource::ALL.map(|source| uncertainties_mm[figure] * (share(source) / whole).sqrt());
        of_whole.iter().all(|part| part.is_finite()).then_some(of_whole)
    };
    let (Some(rms), Some(pv)) = (of(0), of(1)) else { return Vec::new() };
    let told = [UncertaintySource::Scatter, UncertaintySource::Form, UncertaintySource::Pose];
    let one = |(k, &source): (usize, &UncertaintySource)| {
        let is_stated = told.contains(&source) || sources.contains(&source);
        BudgetEntry { source, is_stated, rms_mm: rms[k], pv_99_8_mm: pv[k] }
    };
    UncertaintySource::ALL.iter().enumerate().map(one).collect()
}

/// Divides the variance of a figure of the form among its sources. Returns the variance of each source, in mm^2. The
/// figure is linear in the form: it is the sum over `places` of the form times the element of `slopes` for the place.
/// An element of `slopes` is the derivative of the figure with respect to the form at this place. Only the most
/// probable hypothesis (smoothness, range and variance of the random field) is used.
///
/// If the motions of the part were known, the figure would be estimated as w'd. Here d are the observed deviations in
/// the reduced coordinates of [`FieldHypotheses::coordinates`], and w are their weights. The variance of the error then
/// has three components: s^2 w'w from the noise s, (w'e)^2 from each random effect e, and the remainder from the field.
/// A fourth component comes from the pose: the increase of the variance because the motions are unknown.
///
/// Returns `None` if there is no hypothesis, or if a covariance is singular.
fn parts(
    observed: &Observations,
    fields: &FieldHypotheses,
    posterior: &Posterior,
    (places, slopes): (&[[f64; 2]], &DVector<f64>),
) -> Option<VarianceComponents> {
    let (node, tau, scatter_mm) = posterior.best()?;
    let field2 = tau * node.scale * scatter_mm.powi(2);
    let scatter2 = scatter_mm.powi(2) + field2 * node.truncated_variance;
    let slopes = Mat::from_fn(1, slopes.len(), |_, c| slopes[c]);
    let sums = slopes * fields.basis.at(places);
    let own = Mat::from_fn(node.standard_deviations.len(), 1, |k, _| sums[(0, k)] * node.standard_deviations[k]);
    let rows = fields.with_effects(node);
    let known = rows.nrows() - fields.effects();
    // The random effects in the coordinates, then in those of the motions, and then the part of them that no wave
    // shows.
    let (coordinates, products) = fields.coordinates(&observed.random_effects);
    let of_effects = fields.project_onto_effects(&observed.random_effects);
    let stated = observed.random_effects.ncols();
    let shown = DMatrix::from_fn(stated, stated, |a, b| {
        products[(a, b)] - (0..known).map(|k| coordinates[(k, a)] * coordinates[(k, b)]).sum::<f64>()
    });
    let beside = shown.clone().cholesky().map_or_else(|| DMatrix::zeros(stated, stated), |root| root.l().transpose());
    let effect = |k: usize, e: usize| match k {
        k if k < known => coordinates[(k, e)],
        k if k < rows.nrows() => of_effects[(k - known, e)],
        k => beside[(k - rows.nrows(), e)],
    };
    // Returns the weights, and the variance they explain, from all coordinates or from all but those of the motions.
    let by =
        |chosen: &[usize]| {
            let some = Mat::from_fn(chosen.len(), own.nrows(), |r, c| {
                if chosen[r] < rows.nrows() { rows[(chosen[r], c)] } else { 0.0 }
            });
            let effects = Mat::from_fn(chosen.len(), stated, |r, e| effect(chosen[r], e));
            let mut covariance = &some * some.transpose() * faer::Scale(field2) + &effects * effects.transpose();
            (0..chosen.len()).for_each(|k| covariance[(k, k)] += scatter2);
            let towards = &some * &own * faer::Scale(field2);
            let weights = Llt::new(covariance.as_ref(), Side::Lower).ok()?.solve(&towards);
            let explained: f64 = (0..chosen.len()).map(|k| weights[(k, 0)] * towards[(k, 0)]).sum();
            Some((weights, explained))
        };
    let whole = rows.nrows() + stated;
    let all: Vec<usize> = (0..whole).collect();
    let free: Vec<usize> = (0..whole).filter(|k| *k < known || *k >= rows.nrows()).collect();
    let ((weights, explained), (_, explained_free)) = (by(&all)?, by(&free)?);
    let before: f64 = field2 * (0..own.nrows()).map(|k| own[(k, 0)].powi(2)).sum::<f64>();
    let pose_known = (before - explained).max(0.0);
    let scatter = scatter2 * (0..whole).map(|k| weights[(k, 0)].powi(2)).sum::<f64>();
    let of_stated = |e: usize| (0..whole).map(|k| effect(k, e) * weights[(k, 0)]).sum::<f64>().powi(2);
    let stated: Vec<f64> = (0..stated).map(of_stated).collect();
    let form = (pose_known - scatter - stated.iter().sum::<f64>()).max(0.0);
    Some(VarianceComponents {
        noise: scatter,
        form,
        pose: (explained - explained_free).max(0.0),
        random_effects: stated,
    })
}

/// Returns the derivatives of two figures with respect to the form at each place: of the root mean square, and of PV
/// 99.8 % (PV without the outermost 0.1 % at either end). The derivatives are averaged over the sampled forms in
/// `drawn`. Their components along the motions of the part are removed, because the best fit removes these motions from
/// the form.
///
/// The second result has one value for each figure and each column of `ground_in`. A column is the form that one error
/// of the machine has ground into the part. The value is the mean square, over the sampled forms, of the derivative of
/// the figure in the direction of the column. The mean itself is of no use: the derivative is as often positive as
/// negative, so its mean is 0. Without `ground_in`, there are no such values.
fn slopes(drawn: &SampledForms, ground_in: Option<&DMatrix<f64>>) -> ([DVector<f64>; 2], [Vec<f64>; 2]) {
    let forms = &drawn.forms[0];
    let (n, count) = forms.shape();
    let mut slopes = [DVector::zeros(n), DVector::zeros(n)];
    let mut squares = [0, 1].map(|_| vec![0.0; ground_in.map_or(0, DMatrix::ncols)]);
    let mut order: Vec<usize> = (0..n).collect();
    let left_out = n / 1000;
    for form in forms.column_iter() {
        let rms = form.norm() / (n as f64).sqrt();
        let of_rms = 1.0 / (n as f64 * rms).max(f64::MIN_POSITIVE);
        slopes[0].axpy(of_rms / count as f64, &form, 1.0);
        let nth =
            |order: &mut [usize], k: usize| *order.select_nth_unstable_by(k, |a, b| form[*a].total_cmp(&form[*b])).1;
        let [lowest, highest] = [left_out, n - 1 - left_out].map(|k| nth(&mut order, k));
        slopes[1][highest] += 1.0 / count as f64;
        slopes[1][lowest] -= 1.0 / count as f64;
        for (k, column) in ground_in.iter().flat_map(|columns| columns.column_iter()).enumerate() {
            let of = [of_rms * form.dot(&column), column[highest] - column[lowest]];
            squares.iter_mut().zip(of).for_each(|(sum, of)| sum[k] += of * of / count as f64);
        }
    }
    let base = orthonormal_base(drawn.effects.clone());
    slopes.iter_mut().for_each(|slope| *slope -= &base * base.tr_mul(slope));
    (slopes, squares)
}
