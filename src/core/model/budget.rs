//! What the uncertainty of the figures comes from, source by source.
//!
//! Near the forms that may have been a figure is a sum over places, each with its mean slope. The variance of that sum is parted exactly
//! ([`Sparse::parted`]); the uncertainty of the figure itself, as the drawn forms have it, is shared out in that proportion.

use nalgebra::{DMatrix, DVector};

use super::machine::Source;
use super::{Hyper, Lattice, Observed, Sparse};

/// What one source makes of the standard uncertainty of the figures: the squares of all add up.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Share {
    /// The source.
    pub source: Source,
    /// Whether anything tells how large it is; where nothing does, it is taken for 0.
    pub is_stated: bool,
    /// Of the root mean square.
    pub rms_mm: f64,
    /// Of the peak to valley without the outermost 0.1 % at either end.
    pub pv_99_8_mm: f64,
}

/// Forms that may have been, a column each, with their places and the motions that are taken off there.
pub(super) struct Drawn<'a> {
    pub(super) forms: &'a DMatrix<f64>,
    pub(super) places: &'a [[f64; 2]],
    pub(super) effects: &'a DMatrix<f64>,
    /// What each of the stated effects has had ground into the part there, after its own best fit; nothing before the first correction.
    pub(super) ground_in: Option<DMatrix<f64>>,
}

/// Parts the standard uncertainties of root mean square and peak to valley; nothing where they cannot be.
pub(super) fn parted(
    (observed, sources): (&Observed, &[Source]),
    hyper: &Hyper,
    drawn: &Drawn,
    uncertainties_mm: [f64; 2],
) -> Vec<Share> {
    let everywhere: Vec<[f64; 2]> = observed.places.iter().chain(drawn.places).copied().collect();
    let Ok(lattice) = Lattice::over(&everywhere, &hyper.field) else { return Vec::new() };
    let Ok(model) = Sparse::fit(&lattice, observed, *hyper) else { return Vec::new() };
    let (slopes, ground_in) = slopes(drawn);
    let of = |figure: usize| {
        let mut parts = model.parted(observed, hyper, (drawn.places, slopes[figure].as_slice()))?;
        if drawn.ground_in.is_some() {
            parts.stated.clone_from(&ground_in[figure]);
        }
        let whole = parts.scatter + parts.form + parts.pose + parts.stated.iter().sum::<f64>();
        let share = |source: Source| match source {
            Source::Scatter => parts.scatter,
            Source::Form => parts.form,
            Source::Pose => parts.pose,
            _ => parts.stated.iter().zip(sources).filter(|(_, of)| **of == source).map(|(part, _)| part).sum(),
        };
        let of_whole = Source::ALL.map(|source| uncertainties_mm[figure] * (share(source) / whole).sqrt());
        of_whole.iter().all(|part| part.is_finite()).then_some(of_whole)
    };
    let (Some(rms), Some(pv)) = (of(0), of(1)) else { return Vec::new() };
    let told = [Source::Scatter, Source::Form, Source::Pose];
    let one = |(k, &source): (usize, &Source)| {
        let is_stated = told.contains(&source) || sources.contains(&source);
        Share { source, is_stated, rms_mm: rms[k], pv_99_8_mm: pv[k] }
    };
    Source::ALL.iter().enumerate().map(one).collect()
}

/// By how much root mean square and peak to valley rise with each place, on the average of the forms, and by the mean of the squares with what
/// was ground in, column by column; what a motion does to them is nothing.
///
/// What was ground in makes a form whether it adds to the others or not: its slope is as often up as down, and its square is not 0.
fn slopes(drawn: &Drawn) -> ([DVector<f64>; 2], [Vec<f64>; 2]) {
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
