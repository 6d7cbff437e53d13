//! What the next pass is asked for: the correction so far, less what was found, within limits.

use thiserror::Error;

use super::map::ErrorMap;
use super::net::Net;

/// What the grinder is to displace its surface by: absolute, it replaces the one before.
#[derive(Clone, Debug, PartialEq)]
pub struct Correction {
    /// Where the nodes are.
    pub net: Net,
    /// Wanted displacement along the outward normal at every node, in millimetres; positive leaves material.
    pub values_mm: Vec<f64>,
    /// The pass it is for, from 1.
    pub cycle: u16,
    /// Height of the surface wanted over the nominal one, along the normal, in millimetres: the allowance that is left.
    pub level_mm: f64,
}

/// What a correction must keep to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CorrectionLimits {
    /// Share of the error that is taken back, from 0 to 1.2.
    pub gain: f64,
    /// Least depth of cut of the pass, in millimetres.
    pub depth_of_cut_mm: f64,
    /// Largest correction anywhere, in millimetres.
    pub largest_correction_mm: f64,
    /// Level of the first pass, in millimetres: what removal is counted from.
    pub allowance_mm: f64,
    /// All that may be removed below the surface of the first pass, in millimetres.
    pub removal_budget_mm: f64,
}

/// A correction and what it will do.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// For the next pass.
    pub correction: Correction,
    /// Depth of this pass under the one before, in millimetres: the depth of cut, or more where the part is low.
    pub depth_mm: f64,
    /// Removed in all below the surface of the first pass, where it is most, in millimetres.
    pub removed_mm: f64,
    /// Root mean square of the error that should be left, in millimetres.
    pub predicted_rms_mm: f64,
}

/// Why there is no next pass.
#[derive(Clone, Debug, Error, PartialEq)]
#[allow(missing_docs)]
pub enum StepError {
    #[error(
        "the correction would reach {found_um:.2} um at x {x_mm:.2}, y {y_mm:.2} mm, more than the {limit_um:.2} um that the recipe allows; find \
         the cause of so large an error, or raise largest_correction_um",
        found_um = 1e3 * found_mm, limit_um = 1e3 * limit_mm
    )]
    TooLarge { found_mm: f64, x_mm: f64, y_mm: f64, limit_mm: f64 },
    #[error(
        "the next pass would bring the removal to {removed_um:.2} um, more than the budget of {budget_um:.2} um; the part has no more material to \
         give: accept it as it is, or scrap it",
        removed_um = 1e3 * removed_mm, budget_um = 1e3 * budget_mm
    )]
    BudgetSpent { removed_mm: f64, budget_mm: f64 },
}

impl Correction {
    /// The first pass of a part: nothing is known yet.
    pub fn none(net: Net, level_mm: f64) -> Self {
        Self { net, values_mm: vec![0.0; net.len()], cycle: 1, level_mm }
    }

    /// Returns the correction at a place, in millimetres.
    pub fn at(&self, place_mm: [f64; 2]) -> f64 {
        self.net.interpolate(&self.values_mm, place_mm)
    }

    /// Takes back a share of the error that the last pass left and goes deep enough to cut everywhere.
    ///
    /// Only removal is possible: the new surface must lie below the present one everywhere. What is there is the old level
    /// plus the error e; what comes is the new level plus e - gain e. So the depth is at least -gain e where the part is low.
    ///
    /// # Errors
    /// A correction above its limit, and a removal above the budget.
    pub fn next(&self, error: &ErrorMap, limits: &CorrectionLimits) -> Result<Step, StepError> {
        let net = error.net;
        let values_mm: Vec<f64> =
            (0..net.len()).map(|k| self.at(net.place_mm(k)) - limits.gain * error.values_mm[k]).collect();
        if let Some(k) = (0..net.len()).find(|&k| values_mm[k].abs() > limits.largest_correction_mm) {
            let [x_mm, y_mm] = net.place_mm(k);
            let limit_mm = limits.largest_correction_mm;
            return Err(StepError::TooLarge { found_mm: values_mm[k], x_mm, y_mm, limit_mm });
        }
        let lowest_mm = error.values_mm.iter().copied().fold(0.0, f64::min);
        let depth_mm = limits.depth_of_cut_mm.max(-limits.gain * lowest_mm);
        let level_mm = self.level_mm - depth_mm;
        // Below the first pass's surface; the correction itself adds where it is negative.
        let deepest_mm = values_mm.iter().copied().fold(0.0, f64::min);
        let removed_mm = limits.allowance_mm - level_mm - deepest_mm;
        // A picometre is rounding, not removal.
        if removed_mm > limits.removal_budget_mm + 1e-9 {
            return Err(StepError::BudgetSpent { removed_mm, budget_mm: limits.removal_budget_mm });
        }
        let left2 = error.samples_mm().iter().map(|[_, _, e]| ((1.0 - limits.gain) * e).powi(2)).sum::<f64>();
        let count = error.valid.iter().filter(|v| **v).count().max(1) as f64;
        let predicted_rms_mm = (left2 / count + error.rest_sigma_mm.powi(2)).sqrt();
        let correction = Self { net, values_mm, cycle: self.cycle + 1, level_mm };
        Ok(Step { correction, depth_mm, removed_mm, predicted_rms_mm })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: CorrectionLimits = CorrectionLimits {
        gain: 1.0,
        depth_of_cut_mm: 0.01,
        largest_correction_mm: 0.05,
        allowance_mm: 0.06,
        removal_budget_mm: 0.06,
    };

    fn map(values_mm: [f64; 4]) -> ErrorMap {
        let net = Net { columns: 2, rows: 2, first_mm: [0.0, 0.0], spacing_mm: [1.0, 1.0] };
        ErrorMap::known(net, values_mm.to_vec(), vec![true; 4])
    }

    fn first() -> Correction {
        Correction::none(map([0.0; 4]).net, 0.06)
    }

    #[test]
    fn the_error_is_taken_back_and_the_pass_cuts_everywhere() {
        let step = first().next(&map([0.004, -0.012, 0.0, 0.002]), &LIMITS).unwrap();
        assert_eq!(step.correction.values_mm, [-0.004, 0.012, 0.0, -0.002]);
        assert_eq!((step.correction.cycle, step.depth_mm, step.predicted_rms_mm), (2, 0.012, 0.0));
        assert!((step.correction.level_mm - 0.048).abs() < 1e-15);
        assert!((step.removed_mm - 0.016).abs() < 1e-15, "{}", step.removed_mm);
    }

    #[test]
    fn corrections_add_up_and_the_gain_counts() {
        let half = CorrectionLimits { gain: 0.5, ..LIMITS };
        let once = first().next(&map([0.004; 4]), &half).unwrap();
        let twice = once.correction.next(&map([0.002; 4]), &half).unwrap();
        assert!(twice.correction.values_mm.iter().all(|v| (v + 0.003).abs() < 1e-15));
        assert!((twice.correction.level_mm - 0.04).abs() < 1e-15);
        assert_eq!(twice.correction.cycle, 3);
    }

    #[test]
    fn limits_are_kept() {
        let far = first().next(&map([0.0, 0.051, 0.0, 0.0]), &LIMITS);
        assert!(matches!(far, Err(StepError::TooLarge { x_mm: 1.0, y_mm: 0.0, .. })), "{far:?}");
        let mut correction = first();
        for _ in 0..6 {
            correction = correction.next(&map([0.0; 4]), &LIMITS).unwrap().correction;
        }
        let spent = correction.next(&map([0.0; 4]), &LIMITS);
        assert!(matches!(spent, Err(StepError::BudgetSpent { .. })), "{spent:?}");
    }
}
