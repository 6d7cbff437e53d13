//! Correction of the next pass: the last correction minus the error to compensate, within limits.

use regrind_figures::normal;
use thiserror::Error;

use super::correction::Correction;
use super::learning::LearningState;
use super::map::ErrorMap;
use super::parameters::ParameterCorrections;

/// Limits of a correction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CorrectionLimits {
    /// Standard depth of a pass below the previous pass, in millimetres. A pass is deeper if this is necessary to cut
    /// everywhere.
    pub depth_of_cut_mm: f64,
    /// Minimum depth of removal at any place, in millimetres.
    pub min_depth_mm: f64,
    /// Maximum correction at any place, in millimetres.
    pub max_correction_mm: f64,
    /// Level of the first pass, in millimetres: the zero point of the total removal.
    pub allowance_mm: f64,
    /// Maximum total removal below the surface of the first pass, in millimetres.
    pub removal_budget_mm: f64,
    /// Maximum depth that the machine may remove in one pass at any place, in millimetres.
    pub max_depth_mm: f64,
}

/// Correction of the next pass and its expected removal.
#[derive(Clone, Debug, PartialEq)]
pub struct NextPass {
    /// Correction of the next pass.
    pub correction: Correction,
    /// Depth of this pass below the one before, in millimetres: the depth of cut, or more where the part is low.
    pub depth_mm: f64,
    /// Total removal below the surface of the first pass, at the place of the most removal, in millimetres.
    pub removed_mm: f64,
    /// Predicted share of the part where the wheel does not cut, from 0 to 1.
    pub air_share: f64,
}

/// Reason why no next pass is possible.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum NextPassError {
    #[error(
        "the correction would reach {found_um:.2} µm at x {x_mm:.2}, y {y_mm:.2} mm; the recipe allows {limit_um:.2} \
         µm; find the cause of this large error, or raise max_correction_um",
        found_um = 1e3 * found_mm, limit_um = 1e3 * limit_mm
    )]
    TooLarge { found_mm: f64, x_mm: f64, y_mm: f64, limit_mm: f64 },
    #[error(
        "the next pass would bring the removal to {removed_um:.2} µm, more than the budget of {budget_um:.2} µm; the \
         part has no more material to remove: accept it as it is, or scrap it",
        removed_um = 1e3 * removed_mm, budget_um = 1e3 * budget_mm
    )]
    BudgetSpent { removed_mm: f64, budget_mm: f64 },
    #[error(
        "the first pass would remove up to {removed_um:.2} µm, more than the budget of {budget_um:.2} µm; raise \
         removal_budget_um",
        removed_um = 1e3 * removed_mm, budget_um = 1e3 * budget_mm
    )]
    BudgetAtOnce { removed_mm: f64, budget_mm: f64 },
    #[error(
        "the next pass would remove up to {found_um:.2} µm; grinder.limits.max_depth_mm allows {limit_um:.2} µm; \
         reduce the error in another way, or raise the limit if the machine allows it",
        found_um = 1e3 * found_mm, limit_um = 1e3 * limit_mm
    )]
    TooDeep { found_mm: f64, limit_mm: f64 },
}

impl Correction {
    /// Returns a copy of this correction with new values that compensate the learned error. The copy has the same pass
    /// number and the same level (the height of the target surface above the nominal surface). No limit is checked.
    ///
    /// `known` is the learned state. It gives the total correction that is required, in millimetres at each node. If
    /// `known` contains no next correction, the total of the present correction is used.
    ///
    /// `set` holds the parameter corrections of the next pass, or `None` if there are none. A parameter correction
    /// changes the surface. The part of this change that a measurement shows is subtracted from the new values, so that
    /// no part of the error is compensated twice.
    pub fn compensating(&self, known: &LearningState, set: Option<&ParameterCorrections>) -> Self {
        let seen_mm = self.apparent_mm();
        let mut values_mm = known.next_correction_mm().unwrap_or(&seen_mm).to_vec();
        if let Some(set) = set {
            values_mm.iter_mut().zip(&set.apparent_mm).for_each(|(value, seen)| *value -= seen);
        }
        Self { values_mm, parameters: set.cloned(), ..self.clone() }
    }

    /// Returns the total removal at the node with the largest removal, in millimetres. The total removal is the depth
    /// of the commanded surface of this correction below the commanded surface of a first pass without correction.
    /// `limits` holds the limits of the recipe, and the allowance, which is the level of the first pass.
    ///
    /// # Errors
    /// Returns [`NextPassError::TooLarge`] if the magnitude of a value of the correction exceeds `max_correction_mm` of
    /// `limits`, and [`NextPassError::BudgetSpent`] if the total removal exceeds `removal_budget_mm` of `limits`.
    pub fn removed_mm(&self, limits: &CorrectionLimits) -> Result<f64, NextPassError> {
        let within = |v: f64| v.abs() <= limits.max_correction_mm;
        if let Some(k) = self.values_mm.iter().position(|v| !within(*v)) {
            let ([x_mm, y_mm], limit_mm) = (self.grid.place_mm(k), limits.max_correction_mm);
            return Err(NextPassError::TooLarge { found_mm: self.values_mm[k], x_mm, y_mm, limit_mm });
        }
        // Negative values of the correction and of the parameters increase the removal.
        let max_depth_mm = self.displacement_mm().iter().copied().fold(0.0, f64::min);
        let removed_mm = limits.allowance_mm - self.level_mm - max_depth_mm;
        // A picometre is rounding, not removal.
        if removed_mm > limits.removal_budget_mm + 1e-9 {
            return Err(NextPassError::BudgetSpent { removed_mm, budget_mm: limits.removal_budget_mm });
        }
        Ok(removed_mm)
    }

    /// Returns the next pass: a correction that compensates the learned error, and a depth at which the wheel cuts
    /// everywhere.
    ///
    /// `self` is the correction of the last pass, `error` the map measured after that pass, and `known` the learned
    /// state. `set` holds the parameter corrections of the next pass, or `None`. The parameter corrections compensate a
    /// part of the error. The values at the nodes of the new correction compensate the other part.
    ///
    /// A pass can only remove material, so the new surface must be below the present surface everywhere. If the
    /// correction increases by d at a node, the surface rises there by s d. Here s is the response of the part (the
    /// change of the surface divided by the commanded change). In addition, every pass has a non-repeatable error. So
    /// the depth is at least the sum of three values: the largest rise s d, two standard deviations of the
    /// non-repeatable error, and the minimum depth of removal. The depth is also at least the standard depth of cut in
    /// `limits`.
    ///
    /// Frames: x and y of the model frame. Units: millimetres.
    ///
    /// # Errors
    /// Returns an error if the correction exceeds its limit, if the pass is deeper than the machine may cut, or if the
    /// total removal exceeds the removal budget of `limits`.
    pub fn next_pass(
        &self,
        error: &ErrorMap,
        known: &LearningState,
        set: Option<&ParameterCorrections>,
        limits: &CorrectionLimits,
    ) -> Result<NextPass, NextPassError> {
        let changed = self.compensating(known, set);
        let on_grid: Vec<f64> =
            changed.displacement_mm().iter().zip(self.displacement_mm().iter()).map(|(next, now)| next - now).collect();
        // At the nodes of the measured map: only there the depth of the next cut can be predicted.
        let changes_mm = self.grid.resample(&on_grid, &error.nodes.grid);
        let (response, scatter_mm) = (known.response()[0], known.repeatability_mm().unwrap_or(0.0));
        let rise_mm = on_grid.iter().map(|change| response * change).fold(0.0, f64::max);
        let depth_mm = limits.depth_of_cut_mm.max(rise_mm + 2.0 * scatter_mm + limits.min_depth_mm);
        let fall_mm = on_grid.iter().map(|change| response * change).fold(0.0, f64::min);
        let (found_mm, limit_mm) = (depth_mm - fall_mm, limits.max_depth_mm);
        if found_mm > limit_mm {
            return Err(NextPassError::TooDeep { found_mm, limit_mm });
        }
        let correction = Self { cycle: self.cycle + 1, level_mm: self.level_mm - depth_mm, ..changed };
        let removed_mm = correction.removed_mm(limits)?;
        let depths_mm = || {
            changes_mm.iter().zip(&error.nodes.valid).filter(|(_, valid)| **valid).map(|(c, _)| depth_mm - response * c)
        };
        let air: f64 = depths_mm().map(|depth| normal::tail(depth / (2f64.sqrt() * scatter_mm))).sum();
        let air_share = air / depths_mm().count().max(1) as f64;
        Ok(NextPass { correction, depth_mm, removed_mm, air_share })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compensation::{GainRule, MapOptions, PassObservation};
    use crate::geometry::Grid;

    const LIMITS: CorrectionLimits = CorrectionLimits {
        depth_of_cut_mm: 0.01,
        min_depth_mm: 0.0005,
        max_correction_mm: 0.05,
        allowance_mm: 0.06,
        removal_budget_mm: 0.06,
        max_depth_mm: 0.062,
    };

    fn map(values_mm: [f64; 4]) -> ErrorMap {
        let grid = Grid { columns: 2, rows: 2, first_mm: [0.0, 0.0], spacing_mm: [1.0, 1.0] };
        ErrorMap::exact(grid, values_mm.to_vec(), vec![true; 4])
    }

    fn first() -> Correction {
        Correction::zero(map([0.0; 4]).nodes.grid, 0.06)
    }

    fn next(correction: &Correction, error: &ErrorMap, gain: f64) -> Result<NextPass, NextPassError> {
        let options = MapOptions::new(1.0, 1.0);
        let known = LearningState::new(GainRule::Fixed(gain), &options, [1.0; 2], None);
        correction.next_pass(
            error,
            &known.updated(&PassObservation { correction, error, response: None, explained: None }),
            None,
            &LIMITS,
        )
    }

    #[test]
    fn next_pass_reverses_error_without_air() {
        let step = next(&first(), &map([0.004, -0.012, 0.0, 0.002]), 1.0).unwrap();
        assert_eq!(step.correction.values_mm, [-0.004, 0.012, 0.0, -0.002]);
        assert_eq!((step.correction.cycle, step.depth_mm, step.air_share), (2, 0.0125, 0.0));
        assert!((step.correction.level_mm - 0.0475).abs() < 1e-15);
        assert!((step.removed_mm - 0.0165).abs() < 1e-15, "{}", step.removed_mm);
    }

    #[test]
    fn corrections_accumulate_with_gain() {
        let once = next(&first(), &map([0.004; 4]), 0.5).unwrap();
        let twice = next(&once.correction, &map([0.002; 4]), 0.5).unwrap();
        assert!(twice.correction.values_mm.iter().all(|v| (v + 0.003).abs() < 1e-15));
        assert!((twice.correction.level_mm - 0.04).abs() < 1e-15);
        assert_eq!(twice.correction.cycle, 3);
    }

    #[test]
    fn next_pass_limits_depth_and_budget() {
        let far = next(&first(), &map([0.0, 0.051, 0.0, 0.0]), 1.0);
        assert!(matches!(far, Err(NextPassError::TooLarge { x_mm: 1.0, y_mm: 0.0, .. })), "{far:?}");
        // 49 um where it stands proud, and 13.5 um everywhere.
        let deep = next(&first(), &map([0.049, -0.013, 0.0, 0.0]), 1.0);
        let Err(NextPassError::TooDeep { found_mm, limit_mm: 0.062 }) = deep else { panic!("{deep:?}") };
        assert!((found_mm - 0.0625).abs() < 1e-12, "{found_mm}");
        let mut correction = first();
        for _ in 0..6 {
            correction = next(&correction, &map([0.0; 4]), 1.0).unwrap().correction;
        }
        let spent = next(&correction, &map([0.0; 4]), 1.0);
        assert!(matches!(spent, Err(NextPassError::BudgetSpent { .. })), "{spent:?}");
    }
}
