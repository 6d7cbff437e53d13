//! What the uncertainty of the figures comes from, source by source.
//!
//! Near the forms that may have been a figure is a sum over places, each with its mean slope. The variance of that sum is parted exactly, by the
//! most probable field; the uncertainty of the figure itself, as the drawn forms have it, is shared out in that proportion.

use faer::linalg::solvers::{Llt, Solve};
use faer::{Mat, Side};
use nalgebra::{DMatrix, DVector};

use super::Observed;
use super::hypotheses::FieldHypotheses;
use super::machine_uncertainty::UncertaintySource;
use super::posterior::Posterior;

/// What one source makes of the standard uncertainty of the figures: the squares of all add up.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct BudgetEntry {
    /// The source.
    pub source: UncertaintySource,
    /// Whether anything tells how large it is; where nothing does, it is taken for 0.
    pub is_stated: bool,
    /// Of the root mean square.
    pub rms_mm: f64,
    /// Of the peak to valley without the outermost 0.1 % at either end.
    pub pv_99_8_mm: f64,
}

/// Forms that may have been, a column each, with their places and the motions that are taken off there.
pub(super) struct SampledFigures<'a> {
    pub(super) forms: &'a DMatrix<f64>,
    pub(super) places: &'a [[f64; 2]],
    pub(super) effects: &'a DMatrix<f64>,
    /// What each of the stated effects has had ground into the part there, after its own best fit; nothing before the first correction.
    pub(super) ground_in: Option<DMatrix<f64>>,
}

/// The parts of a variance.
struct Parts {
    /// The points by themselves.
    scatter: f64,
    /// The field between them.
    form: f64,
    /// The motions that nobody knows.
    pose: f64,
    /// Each effect that is stated.
    stated: Vec<f64>,
}

/// Parts the standard uncertainties of root mean square and peak to valley; nothing where they cannot be.
pub(super) fn decompose(
    (observed, sources): (&Observed, &[UncertaintySource]),
    (fields, posterior): (&FieldHypotheses, &Posterior),
    drawn: &SampledFigures,
    uncertainties_mm: [f64; 2],
) -> Vec<BudgetEntry> {
    let (slopes, ground_in) = slopes(drawn);
    let of = |figure: usize| {
        let mut parts = parts(observed, fields, posterior, (drawn.places, &slopes[figure]))?;
        if drawn.ground_in.is_some() {
            parts.stated.clone_from(&ground_in[figure]);
        }
        let whole = parts.scatter + parts.form + parts.pose + parts.stated.iter().sum::<f64>();
        let share = |source: UncertaintySource| match source {
            UncertaintySource::Scatter => parts.scatter,
            UncertaintySource::Form => parts.form,
            UncertaintySource::Pose => parts.pose,
            _ => parts.stated.iter().zip(sources).filter(|(_, of)| **of == source).map(|(part, _)| part).sum(),
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

/// Tells what the uncertainty of a sum a'f over places comes from: the variance of the field is that of sigma^2 D z with z of variance 1, and the
/// coordinates of the points have it as B z.
///
/// With the motions known the sum is told by w'd, of whose error the scatter makes s^2 w'w, an effect that is stated (w'e)^2, and the field what
/// is left; that the motions are not known adds the rest.
fn parts(
    observed: &Observed,
    fields: &FieldHypotheses,
    posterior: &Posterior,
    (places, slopes): (&[[f64; 2]], &DVector<f64>),
) -> Option<Parts> {
    let (node, tau, scatter_mm) = posterior.best()?;
    let field2 = tau * node.scale * scatter_mm.powi(2);
    let scatter2 = scatter_mm.powi(2) + field2 * node.truncated_variance;
    let slopes = Mat::from_fn(1, slopes.len(), |_, c| slopes[c]);
    let sums = slopes * fields.basis.at(places);
    let own = Mat::from_fn(node.standard_deviations.len(), 1, |k, _| sums[(0, k)] * node.standard_deviations[k]);
    let rows = fields.with_effects(node);
    let known = rows.nrows() - fields.effects();
    // The stated effects in the coordinates, behind the motions, and the part of them that no wave shows.
    let (coordinates, products) = fields.coordinates(&observed.random_effects);
    let of_effects = fields.of_effects(&observed.random_effects);
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
    // All coordinates, or all but those of the motions.
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
    Some(Parts { scatter, form, pose: (explained - explained_free).max(0.0), stated })
}

/// By how much root mean square and peak to valley rise with each place, on the average of the forms, and by the mean of the squares with what
/// was ground in, column by column; what a motion does to them is nothing.
///
/// What was ground in makes a form whether it adds to the others or not: its slope is as often up as down, and its square is not 0.
fn slopes(drawn: &SampledFigures) -> ([DVector<f64>; 2], [Vec<f64>; 2]) {
    let (n, count) = drawn.forms.shape();
    let mut slopes = [DVector::zeros(n), DVector::zeros(n)];
    let none = DMatrix::zeros(n, 0);
    let columns = drawn.ground_in.as_ref().unwrap_or(&none);
    let mut ground_in = [0, 1].map(|_| vec![0.0; columns.ncols()]);
    let mut order: Vec<usize> = (0..n).collect();
    let left_out = n / 1000;
    for form in drawn.forms.column_iter() {
        let rms = form.norm() / (n as f64).sqrt();
        let of_rms = 1.0 / (n as f64 * rms).max(f64::MIN_POSITIVE);
        slopes[0].axpy(of_rms / count as f64, &form, 1.0);
        let nth =
            |order: &mut [usize], k: usize| *order.select_nth_unstable_by(k, |a, b| form[*a].total_cmp(&form[*b])).1;
        let [lowest, highest] = [left_out, n - 1 - left_out].map(|k| nth(&mut order, k));
        slopes[1][highest] += 1.0 / count as f64;
        slopes[1][lowest] -= 1.0 / count as f64;
        for (k, column) in columns.column_iter().enumerate() {
            let of = [of_rms * form.dot(&column), column[highest] - column[lowest]];
            ground_in.iter_mut().zip(of).for_each(|(sum, of)| sum[k] += of * of / count as f64);
        }
    }
    if drawn.effects.ncols() > 0 {
        let base = drawn.effects.clone().qr().q();
        slopes.iter_mut().for_each(|slope| *slope -= &base * base.tr_mul(slope));
    }
    (slopes, ground_in)
}
