//! State of all cycles of a run, and the inputs of each next step.
//!
//! The loop and the replay of a record both use it, so a run that continues has the same state as before.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::CycleRow;
use super::task::{ComputationProduct, CycleState, Task, UsablePoints};
use crate::cell::Tolerance;
use crate::device::{CorrectionMap, Pass, Plan};
use crate::geometry::Pose;
use crate::model::{FIRST_BATCH, PartPriors, farthest_points, short_tour};

/// Cycles, by number.
#[derive(Default)]
pub(super) struct Cycles(BTreeMap<u32, CycleState>);

impl Cycles {
    pub(super) fn get(&self, number: u32) -> Option<&CycleState> {
        self.0.get(&number)
    }

    /// Returns what the grinder receives for the pass of cycle `number`: the correction map and the parameters of the
    /// pass. A cycle that does not exist yet is created with the first correction of the task.
    pub(super) fn pass_payloads(&mut self, task: &Task, number: u32) -> (CorrectionMap, Pass) {
        let cycle = self.0.entry(number).or_insert_with(|| CycleState::new(task.first_correction()));
        task.payloads(&cycle.correction)
    }

    /// Creates the measuring plan for the next measurement of cycle `number`, stores it in the cycle, and returns it.
    pub(super) fn create_plan(&mut self, task: &Task, number: u32) -> Arc<Plan> {
        // A part that is measured before any pass, or measured once more, has the state that the last pass left.
        let last = self.0.range(..=number).next_back().map(|(_, c)| Arc::clone(&c.correction));
        let correction = last.unwrap_or_else(|| Arc::new(task.first_correction()));
        // Start from the pose of the last judged measurement. After a measurement that a gate refused, the part may
        // have been clamped again.
        let last = self.0.range(..number).next_back().map(|(_, cycle)| cycle);
        let judged = last.filter(|cycle| cycle.is_judged()).and_then(|cycle| cycle.registration.as_ref());
        let pose = judged.map_or(task.fixture_cmm_from_model, |found| found.cmm_from_model);
        let seated_anew = last.is_some_and(|cycle| cycle.plan.is_some() && !cycle.is_judged());
        let cycle = self.0.entry(number).or_insert_with(|| CycleState::new((*correction).clone()));
        cycle.plan_pose = pose;
        let plan = match (&task.adaptive, cycle.repeated_touches.clone(), &cycle.registration) {
            (Some(_), ..) => next_batch_plan(task, cycle, &pose, seated_anew),
            (None, Some(again), Some(found)) => {
                cycle.batch = cycle.points.as_ref().map_or(0, |points| points.repeat_rounds + 1);
                let targets = (Vec::new(), again.targets.iter().collect());
                cycle.plan_pose = found.cmm_from_model;
                task.plan_targets(cycle.correction.level_mm, &found.cmm_from_model, targets, false)
            }
            _ => task.plan(correction.level_mm, &pose, seated_anew),
        };
        cycle.plan.insert(Arc::new(plan)).clone()
    }

    /// Returns the number of the current batch of touches of cycle `number`. It is 0 for the first batch, and for a
    /// cycle that does not exist.
    pub(super) fn batch(&self, number: u32) -> u32 {
        self.get(number).map_or(0, |cycle| cycle.batch)
    }

    /// Returns two counts, each summed over all measurements of the run:
    ///
    /// - The number of targets on the part that the probe tried to touch. In a measurement that is not adaptive, only
    ///   the touched points are counted.
    /// - The number of measurements times the number of targets of `task`. It is the number of tries without adaptive
    ///   measurement.
    pub(super) fn touch_counts(&self, task: &Task) -> [usize; 2] {
        let measured = self.0.values().filter_map(|cycle| cycle.points.as_ref());
        let tried = measured.clone().map(|points| match points.tried_targets.is_empty() {
            true => points.part.len(),
            false => points.tried_targets.iter().map(Vec::len).sum(),
        });
        [tried.sum(), measured.count() * task.targets.len()]
    }

    /// Returns the last cycle before cycle `number` that fulfils three conditions:
    ///
    /// - The cycle was judged, so at least one judgement of its result was written.
    /// - Its measurement has updated the learning state (the estimate of how the part responds to corrections).
    /// - It measured the result of an earlier pass than cycle `number` did.
    ///
    /// Returns `None` if there is no such cycle, or if cycle `number` does not exist.
    pub(super) fn previous_judged(&self, number: u32) -> Option<&CycleState> {
        let pass = self.get(number)?.correction.cycle;
        let earlier = |c: &&CycleState| c.is_judged() && c.learning.is_some() && c.correction.cycle < pass;
        self.0.range(..number).rev().map(|(_, c)| c).find(earlier)
    }

    /// Returns the usable points of the last measurement before cycle `number`, with the number of its cycle; `None` if
    /// there are none.
    pub(super) fn previous_points(&self, number: u32) -> Option<(u32, Arc<UsablePoints>)> {
        self.0.range(..number).rev().find_map(|(earlier, cycle)| Some((*earlier, cycle.points.clone()?)))
    }

    /// Stores the result `product` of a computation in cycle `number`. A correction is for the next pass, so it creates
    /// cycle `number + 1`. Does nothing with any other result if cycle `number` does not exist.
    pub(super) fn store(&mut self, number: u32, product: ComputationProduct) {
        if let ComputationProduct::Correction(next) = product {
            self.0.insert(number + 1, CycleState::new(next));
        } else if let Some(cycle) = self.0.get_mut(&number) {
            cycle.store(product);
        }
    }

    /// Increments the number of judgements of cycle `number`, and returns it. Returns 1 for a cycle that does not
    /// exist.
    pub(super) fn count_judgement(&mut self, number: u32) -> u32 {
        let Some(cycle) = self.0.get_mut(&number) else { return 1 };
        cycle.judgement_count += 1;
        cycle.judgement_count
    }

    /// Returns the last judged cycle that contains a learning state (the estimate of how the part responds to
    /// corrections). Returns `None` if there is no such cycle.
    pub(super) fn last_with_learning(&self) -> Option<&CycleState> {
        self.0.values().rev().find(|cycle| cycle.is_judged() && cycle.learning.is_some())
    }

    /// Returns the priors of the error model for the next parts: one for passes without a correction, and one for
    /// passes with a correction. Each prior is the prior that this cell has learned from earlier parts, updated with
    /// the last judged cycle of the same kind.
    ///
    /// A prior that this cell received from another cell is not included. The result is later sent to other cells, and
    /// they would receive their own results again.
    pub(super) fn part_priors(&self, task: &Task) -> PartPriors {
        let of_this_cell = task.learned.as_ref().filter(|learned| learned.origin.is_none());
        let mut taught = of_this_cell.map(|learned| learned.fields).unwrap_or_default();
        for is_corrected in [false, true] {
            let alike = |cycle: &&CycleState| cycle.is_judged() && cycle.correction.is_zero() != is_corrected;
            if let Some(field) =
                self.0.values().filter(alike).filter_map(|cycle| cycle.field_hyperparameters).next_back()
            {
                taught.update(is_corrected, &field);
            }
        }
        taught
    }

    /// Returns the figures of each measured cycle as one row of the table in the status of the cell. The rows are in
    /// the order of the cycle numbers, and the lengths in µm. `tolerance` determines which figures are judged. Cycles
    /// without figures are omitted.
    pub(super) fn rows(&self, tolerance: &Tolerance) -> Vec<CycleRow> {
        let rows = self.0.iter().filter_map(|(&cycle, c)| {
            let figures = c.figures.as_ref()?;
            let [judged_pv_um, judged_rms_um] = tolerance.compare(figures).map(|of| Some(1e3 * of.median_mm));
            Some(CycleRow {
                cycle,
                pv_um: 1e3 * figures.pv_mm,
                judged_pv_um,
                rms_um: 1e3 * figures.rms_mm,
                judged_rms_um,
                points: figures.points,
                outliers: figures.outliers,
                level_um: 1e3 * c.correction.level_mm,
            })
        });
        rows.collect()
    }
}

/// Creates the plan for the next batch of an adaptive measurement, and stores the number of the batch and its targets
/// in `cycle`. The targets of the first batch are as far apart as possible. Later batches have the targets that the
/// last evaluation chose.
///
/// `pose` is the pose of the model in the CMM frame. It is used only if the cycle has no registration. If `seated_anew`
/// is true, the part may have been clamped again, and the targets of the first batch are touched at low speed.
fn next_batch_plan(task: &Task, cycle: &mut CycleState, pose: &Pose, seated_anew: bool) -> Plan {
    cycle.batch = cycle.points.as_ref().map_or(0, |points| points.tried_targets.len() as u32);
    cycle.batch_targets = match &cycle.next_targets {
        Some(next) => Arc::clone(next),
        None => {
            let places = task.target_places();
            Arc::new(short_tour(&places, farthest_points(&places, FIRST_BATCH)))
        }
    };
    let is_first = cycle.batch == 0;
    let pose = cycle.registration.as_ref().map_or(*pose, |found| found.cmm_from_model);
    let chosen = cycle.batch_targets.to_vec();
    let order = if is_first && seated_anew { (chosen, Vec::new()) } else { (Vec::new(), chosen) };
    task.plan_by_index(cycle.correction.level_mm, &pose, order, is_first)
}
