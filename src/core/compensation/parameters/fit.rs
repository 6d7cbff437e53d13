//! Fit of the columns of the parameters to the deviations.

use nalgebra::{DMatrix, DVector};
use regrind_figures::statistics::rms;

use super::columns::Extent;
use super::columns::{Column, OrthonormalBasis, dot};
use super::error::ParameterError;
use super::kinds::{
    COVERAGE_FACTOR, EstimatedParameter, MIN_EFFECT_MM2, ParameterKind, ParameterOptions, SurfacePoint,
};
use super::{columns, texts};
use crate::model::{EffectEstimates, ModelError, Observations, Prior};

/// All columns of the fit.
pub(super) struct Columns {
    pub(super) motions: Vec<Column<&'static str>>,
    pub(super) slides: Vec<Column<&'static str>>,
    pub(super) candidates: Vec<Column<ParameterKind>>,
}

/// Fitted values of slides and candidates.
pub(super) struct ColumnFit {
    /// Value of each slide and, after them, of each candidate; 0 if it was not fitted.
    values: DVector<f64>,
    covariance: DMatrix<f64>,
    /// Root mean square over the points of the effect of one unit of each column, in the order of `values`.
    sizes: Vec<f64>,
    rms_mm: f64,
    pub(super) slides: usize,
}

impl Columns {
    fn nuisance(&self) -> impl Iterator<Item = &Vec<f64>> {
        self.motions.iter().chain(&self.slides).map(|c| &c.values)
    }

    /// Tests which candidate parameters can be separated from other effects. A candidate is a machine parameter that
    /// may be estimated, with its effect on the deviation at each contact. The other effects are the motions of the
    /// part, the bent guideways, and the other separable candidates.
    ///
    /// Returns two lists with one entry for each candidate. An entry of the first list is true if the candidate is
    /// separable: its independent share is above 0.02. An entry of the second list is the independent share, from 0 to
    /// 1: the part of the effect of the candidate that the other effects cannot imitate.
    ///
    /// If two candidates have the same effect, at most the first is separable.
    pub(super) fn separability(&self) -> (Vec<bool>, Vec<f64>) {
        let mut told: Vec<bool> = Vec::new();
        for k in 0..self.candidates.len() {
            let before = (0..k).filter(|&j| told[j]).map(|j| &self.candidates[j].values);
            told.push(
                own_share(&self.candidates[k].values, &OrthonormalBasis::new(self.nuisance().chain(before)))
                    > MIN_OWN_SHARE,
            );
        }
        let share = |k: usize| {
            let others = (0..told.len()).filter(|&j| j != k && told[j]).map(|j| &self.candidates[j].values);
            own_share(&self.candidates[k].values, &OrthonormalBasis::new(self.nuisance().chain(others)))
        };
        let shares: Vec<f64> = (0..told.len()).map(share).collect();
        // A candidate that is no longer separable once later ones are included is dropped in their favour.
        (told.iter().zip(&shares).map(|(told, share)| *told && *share > MIN_OWN_SHARE).collect(), shares)
    }

    /// Fits the bends of the guideways and the separable candidate parameters, together with the motions of the part
    /// and a random field for the form error. Returns values and covariance of guideway bends and candidates.
    ///
    /// `told[k]` is true if candidate `k` is separable. The value of any other candidate stays 0. `rms_mm` is the root
    /// mean square of the deviations without the part that motions explain, in millimetres. If `rms_mm` is practically
    /// 0, all values are 0.
    ///
    /// # Errors
    /// Returns an error if the points do not determine the random field.
    pub(super) fn fitted(
        &self,
        contacts: &[SurfacePoint],
        told: &[bool],
        rms_mm: f64,
        options: &ParameterOptions,
    ) -> Result<ColumnFit, ParameterError> {
        let slides = self.slides.len();
        let all: Vec<&Vec<f64>> =
            self.slides.iter().map(|c| &c.values).chain(self.candidates.iter().map(|c| &c.values)).collect();
        let unseen = OrthonormalBasis::new(self.motions.iter().map(|m| &m.values));
        let mut basis = OrthonormalBasis::new(self.motions.iter().map(|m| &m.values));
        let mut chosen = Vec::new();
        for k in (0..all.len()).filter(|&k| k < slides || told[k - slides]) {
            if own_share(all[k], &basis) > MIN_OWN_SHARE {
                chosen.push(k);
                basis = OrthonormalBasis::new(basis.columns.iter().chain([all[k]]));
            }
        }
        let (mut values, mut covariance) = (DVector::zeros(all.len()), DMatrix::zeros(all.len(), all.len()));
        if rms_mm * rms_mm > MIN_EFFECT_MM2 {
            let found = self.effects(contacts, &unseen, &chosen.iter().map(|&k| all[k]).collect::<Vec<_>>())?;
            let first = unseen.columns.len();
            for (a, &r) in chosen.iter().enumerate() {
                values[r] = found.values[first + a];
                for (b, &c) in chosen.iter().enumerate() {
                    covariance[(r, c)] = found.covariance[(first + a, first + b)];
                }
            }
        }
        // An error of the datum looks like the setting with the same effect, so its variance adds to that of the
        // setting.
        for (k, kind) in ParameterKind::ALL.into_iter().enumerate().filter(|(k, _)| told[*k]) {
            let held = kind.motion().filter(|&motion| !options.free_motions[motion]);
            if let Some((motion, [shift, turn])) = held.zip(options.locked_sigmas) {
                covariance[(slides + k, slides + k)] += if motion < 3 { shift * shift } else { turn * turn };
            }
        }
        let sizes = all.iter().map(|column| rms(*column)).collect();
        Ok(ColumnFit { values, covariance, sizes, rms_mm, slides })
    }

    /// Estimates the coefficients of the `chosen` columns and of the motions of the part, with their covariance, by
    /// generalised least squares. A column is the effect of one unit of a parameter or guideway bend at every contact.
    ///
    /// `unseen` is an orthonormal basis of the effects of the motions. The result lists the motions first and then the
    /// chosen columns, in the given order. The coefficient of a column is the value of its parameter or bend, in
    /// millimetres or radians.
    ///
    /// # Errors
    /// Returns an error if the points do not determine the random field of the form error.
    fn effects(
        &self,
        contacts: &[SurfacePoint],
        unseen: &OrthonormalBasis,
        chosen: &[&Vec<f64>],
    ) -> Result<EffectEstimates, ModelError> {
        let n = contacts.len();
        // Scale the columns to one size, since their units differ. Their overlap with the motions changes no value.
        let sizes: Vec<f64> = chosen.iter().map(|column| rms(*column)).collect();
        let of = unseen.columns.len();
        let scale = (n as f64).sqrt();
        let effects = DMatrix::from_fn(n, of + chosen.len(), |r, c| match c.checked_sub(of) {
            None => scale * unseen.columns[c][r],
            Some(c) => chosen[c][r] / sizes[c],
        });
        let places: Vec<[f64; 2]> = contacts.iter().map(|c| [c.point.x, c.point.y]).collect();
        let size_mm = Extent::from_places(places.iter().copied()).size_mm();
        let deviations_mm = contacts.iter().map(|c| c.deviation_mm).collect();
        let observed = Observations { fixed_effects: effects, ..Observations::without_effects(places, deviations_mm) };
        let mut found = EffectEstimates::estimate(&observed, &Prior::for_size(size_mm))?;
        for (c, size) in (of..).zip(&sizes) {
            found.values[c] /= size;
            found.covariance.row_mut(c).scale_mut(size.recip());
            found.covariance.column_mut(c).scale_mut(size.recip());
        }
        Ok(found)
    }

    /// Returns names, for messages to people, of the effects from which the candidate parameter with the index `k`
    /// cannot be separated.
    ///
    /// Returns one name if the cause is a datum without a stated uncertainty, or a free motion with the same effect.
    /// Otherwise returns at most three names of the motions, guideway bends and parameters that imitate the candidate
    /// best.
    pub(super) fn inseparable_from(&self, k: usize, options: &ParameterOptions) -> Vec<String> {
        let before = self.candidates.iter().enumerate().filter(|(j, _)| *j != k).map(|(_, c)| (c.kind, &c.values));
        let others = self.motions.iter().chain(&self.slides).map(|c| (c.kind.to_owned(), &c.values));
        let others: Vec<_> = others.chain(before.map(|(kind, of)| (texts::name(kind).to_owned(), of))).collect();
        let of = &self.candidates[k];
        match of.kind.motion() {
            _ if options.lacks_locked_sigma(k) => vec![texts::UNSTATED_LOCKED_SIGMA.to_owned()],
            Some(motion) if options.free_motions[motion] => vec![columns::MOTIONS[motion].to_owned()],
            _ => texts::inseparable_names(&of.values, &others),
        }
    }
}

impl ColumnFit {
    /// Returns the estimate of each parameter, in the order of [`ParameterKind::ALL`].
    ///
    /// For each parameter, `alike` holds the names of the effects from which the parameter is not separable. If this
    /// list is empty, the parameter is separable; otherwise its value and uncertainty are 0. `own_shares` holds the
    /// independent share of the effect of each parameter, from 0 to 1.
    ///
    /// In the returned estimates `message` is empty and `rms_reduction_mm` is 0. The caller sets both.
    pub(super) fn parameters(
        &self,
        alike: Vec<Vec<String>>,
        own_shares: &[f64],
        options: &ParameterOptions,
    ) -> Vec<EstimatedParameter> {
        let parameter = |(k, alike): (usize, Vec<String>)| {
            let is_told = alike.is_empty();
            let variance = self.covariance[(self.slides + k, self.slides + k)].max(0.0);
            let [value, sigma] = if is_told { [self.values[self.slides + k], variance.sqrt()] } else { [0.0; 2] };
            EstimatedParameter {
                kind: ParameterKind::ALL[k],
                value,
                sigma,
                own_share: own_shares[k],
                is_offered: is_told && value.abs() > COVERAGE_FACTOR * sigma,
                inseparable_from: alike,
                compensated: 0.0,
                exceeds_tolerance: false,
                rms_reduction_mm: 0.0,
                message: String::new(),
            }
        };
        let mut found: Vec<EstimatedParameter> = alike.into_iter().enumerate().map(parameter).collect();
        let wanted = |k: &usize| {
            let tolerance_2 = options.tolerances[*k].map(|tolerance| (tolerance / COVERAGE_FACTOR).powi(2));
            tolerance_2.filter(|_| found[*k].is_offered && found[*k].kind != ParameterKind::Wear).map(|t2| (*k, t2))
        };
        let chosen: Vec<(usize, f64)> = (0..found.len()).filter_map(|k| wanted(&k)).collect();
        for ((k, _), taken) in chosen.iter().zip(self.expected(&chosen).iter()) {
            found[*k].compensated = *taken;
            found[*k].exceeds_tolerance = options.tolerances[*k].is_some_and(|tolerance| taken.abs() > tolerance);
        }
        found
    }

    /// Returns the posterior mean of the parameters in `chosen`, in the same order. `chosen` holds the index of each
    /// parameter and its prior variance.
    ///
    /// Equation: T (T + S)^-1 b. Here b is the vector of the fitted values, S is the covariance of b, and T is the
    /// diagonal matrix of the prior variances. Returns zeros if T + S is not positive definite.
    fn expected(&self, chosen: &[(usize, f64)]) -> DVector<f64> {
        let at = |k: usize| self.slides + chosen[k].0;
        let n = chosen.len();
        let told = DVector::from_fn(n, |k, _| self.values[at(k)]);
        let both = |r: usize, c: usize| self.covariance[(at(r), at(c))] + if r == c { chosen[r].1 } else { 0.0 };
        let solved = DMatrix::from_fn(n, n, both).cholesky().map(|both| both.solve(&told));
        solved.map_or_else(|| DVector::zeros(n), |solved| DVector::from_fn(n, |k, _| chosen[k].1 * solved[k]))
    }

    /// Returns the posterior mean of all guideway bends and all parameters, estimated together. The result lists the
    /// guideway bends first; a value that was not fitted is 0.
    ///
    /// The prior standard deviation of a parameter with a tolerance is half of this tolerance. All other values share
    /// one prior strength: the prior rms, in millimetres, of the effect of a value. This strength is estimated from the
    /// fitted values (empirical Bayes, Morris 1983).
    ///
    /// Equation: T (T + S)^-1 b, with the fitted values b, their covariance S and the diagonal matrix T of the prior
    /// variances. The equation is evaluated for several trial strengths, from 0.1 % to 100 % of the rms of the
    /// deviations. The result is the weighted mean over the trial strengths. The weight is the marginal likelihood of
    /// b.
    pub(super) fn joint_expectation(&self, options: &ParameterOptions) -> DVector<f64> {
        let chosen: Vec<usize> = (0..self.values.len()).filter(|&k| self.covariance[(k, k)] > 0.0).collect();
        let told = DVector::from_fn(chosen.len(), |k, _| self.values[chosen[k]]);
        let stated = |k: usize| k.checked_sub(self.slides).and_then(|k| options.tolerances[k]);
        let variance = |k: usize, strength_mm: f64| match stated(k) {
            Some(tolerance) => (tolerance / COVERAGE_FACTOR).powi(2),
            None => (strength_mm / self.sizes[k]).powi(2),
        };
        let by = |strength_mm: f64| {
            let prior = DVector::from_fn(chosen.len(), |k, _| variance(chosen[k], strength_mm));
            let both = DMatrix::from_fn(chosen.len(), chosen.len(), |r, c| {
                self.covariance[(chosen[r], chosen[c])] + if r == c { prior[r] } else { 0.0 }
            });
            let factor = both.cholesky()?;
            let solved = factor.solve(&told);
            Some((prior.component_mul(&solved), -0.5 * told.dot(&solved) - 0.5 * factor.ln_determinant()))
        };
        let strengths = (0..PRIOR_STRENGTHS)
            .map(|k| self.rms_mm * MIN_STRENGTH_SHARE.powf(f64::from(k) / f64::from(PRIOR_STRENGTHS - 1)));
        let seen: Vec<_> = strengths.filter_map(by).collect();
        let top = seen.iter().map(|(_, likely)| *likely).fold(f64::NEG_INFINITY, f64::max);
        let weight = |likely: f64| (likely - top).exp();
        let whole: f64 = seen.iter().map(|(_, likely)| weight(*likely)).sum();
        let mut believed = DVector::zeros(self.values.len());
        for (values, likely) in &seen {
            for (k, value) in chosen.iter().zip(values.iter()) {
                believed[*k] += weight(*likely) / whole * value;
            }
        }
        believed
    }
}

pub(super) fn own_share(column: &[f64], others: &OrthonormalBasis) -> f64 {
    let own = others.orthogonal_part(column);
    let size = dot(column, column);
    // On a level surface the effect of the wheel's radius is only rounding.
    if size > MIN_EFFECT_MM2 * column.len() as f64 { (dot(&own, &own) / size).sqrt() } else { 0.0 }
}

/// Minimum share of a column that is independent of the others; a column with less is not separable from them.
pub(super) const MIN_OWN_SHARE: f64 = 0.02;

/// Number of trial strengths of the prior of values without a tolerance, from the rms of the deviations down to
/// [`MIN_STRENGTH_SHARE`] of it.
pub(super) const PRIOR_STRENGTHS: i32 = 25;

/// Minimum trial strength, as a share of the rms of the deviations.
pub(super) const MIN_STRENGTH_SHARE: f64 = 1e-3;

#[cfg(test)]
mod tests {
    use super::*;

    /// Fit with a slide of 2 mm rms per unit and a radius of 1 mm rms per unit, each with a standard uncertainty of
    /// 1 um, and a setting that was not fitted.
    fn fitted(values_um: [f64; 2]) -> ColumnFit {
        let [slide, radius] = values_um.map(|value| 1e-3 * value);
        ColumnFit {
            values: DVector::from_column_slice(&[slide, radius, 0.0]),
            covariance: DMatrix::from_diagonal(&DVector::from_column_slice(&[1e-6, 1e-6, 0.0])),
            sizes: vec![2.0, 1.0, 1.0],
            rms_mm: 1.0,
            slides: 1,
        }
    }

    #[test]
    fn parameter_shrinkage_uses_tolerance() {
        let mut options = ParameterOptions::new(12.5);
        options.tolerances[0] = Some(2e-3);
        let believed = |values_um: [f64; 2]| {
            let of = fitted(values_um).joint_expectation(&options);
            assert_eq!(of[2], 0.0, "what was not fitted");
            [1e3 * of[0], 1e3 * of[1]]
        };
        // A tolerance of 2 um is a standard uncertainty of 1 um, equal to that of the value: half of any value
        // remains.
        for radius_um in [0.0, 3.0, -40.0] {
            let [slide, radius] = believed([0.0, radius_um]);
            assert!((radius - 0.5 * radius_um).abs() < 1e-12 && slide == 0.0, "{slide} {radius}");
        }
        // A slide has no tolerance: far above its uncertainty all of it remains, within its uncertainty less than two
        // thirds.
        assert!((believed([100.0, 0.0])[0] - 100.0).abs() < 0.1, "{:?}", believed([100.0, 0.0]));
        assert!(believed([0.5, 0.0])[0].abs() < 0.33, "{:?}", believed([0.5, 0.0]));
        // The same with the other sign, and in another unit.
        assert_eq!(believed([-0.5, 1.0])[0], -believed([0.5, -1.0])[0]);
    }
}
