//! Knowledge about the cycles of a run, and the inputs of each next step.
//!
//! The loop and the replay of a record both use it, so a run that continues has the same state as before.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::CycleRow;
use super::task::{Cycle, Points, Product, Task};
use crate::cell::Tolerance;
use crate::device::{CorrectionMap, Pass, Plan};
use crate::geometry::Pose;
use crate::model::{FIRST_BATCH, PartPriors, farthest_points, short_tour};

/// Cycles, by number.
#[derive(Default)]
pub(super) struct Cycles(BTreeMap<u32, Cycle>);

impl Cycles {
    pub(super) fn get(&self, number: u32) -> Option<&Cycle> {
        self.0.get(&number)
    }

    /// Returns the payloads of the pass of a cycle. The first pass uses the first correction of the task.
    pub(super) fn pass(&mut self, task: &Task, number: u32) -> (CorrectionMap, Pass) {
        let cycle = self.0.entry(number).or_insert_with(|| Cycle::new(task.first_correction()));
        task.payloads(&cycle.correction)
    }

    /// Creates the plan of a cycle and stores it.
    pub(super) fn plan(&mut self, task: &Task, number: u32) -> Arc<Plan> {
        // A part that is measured before any pass, or measured once more, has the state that the last pass left.
        let last = self.0.range(..=number).next_back().map(|(_, c)| Arc::clone(&c.correction));
        let correction = last.unwrap_or_else(|| Arc::new(task.first_correction()));
        // Start from the pose of the last judged measurement. After a measurement that a gate refused, the part may
        // have been clamped again.
        let last = self.0.range(..number).next_back().map(|(_, cycle)| cycle);
        let judged = last.filter(|cycle| cycle.is_judged()).and_then(|cycle| cycle.registration.as_ref());
        let pose = judged.map_or(task.fixture_cmm_from_model, |found| found.cmm_from_model);
        let seated_anew = last.is_some_and(|cycle| cycle.plan.is_some() && !cycle.is_judged());
        let cycle = self.0.entry(number).or_insert_with(|| Cycle::new((*correction).clone()));
        let plan = match (&task.adaptive, cycle.again.clone(), &cycle.registration) {
            (Some(_), ..) => batch(task, cycle, &pose, seated_anew),
            (None, Some(again), Some(found)) => {
                cycle.batch = cycle.points.as_ref().map_or(0, |points| points.rounds + 1);
                let targets = (Vec::new(), again.targets.iter().collect());
                task.plan_at(cycle.correction.level_mm, &found.cmm_from_model, targets, false)
            }
            _ => task.plan(correction.level_mm, &pose, seated_anew),
        };
        cycle.plan.insert(Arc::new(plan)).clone()
    }

    /// Returns the batch of touches to which the plan of a cycle belongs.
    pub(super) fn batch(&self, number: u32) -> u32 {
        self.get(number).map_or(0, |cycle| cycle.batch)
    }

    /// Returns the number of touches tried on the part, and the number that the whole pattern would have needed, in all
    /// measurements.
    pub(super) fn touches(&self, task: &Task) -> [usize; 2] {
        let measured = self.0.values().filter_map(|cycle| cycle.points.as_ref());
        let tried = measured.clone().map(|points| match points.tried.is_empty() {
            true => points.part.len(),
            false => points.tried.iter().map(Vec::len).sum(),
        });
        [tried.sum(), measured.count() * task.targets.len()]
    }

    /// Returns the last measurement of an earlier pass that was judged. A measurement that a gate refused, or that
    /// repeats one after the same pass, does not count.
    pub(super) fn before(&self, number: u32) -> Option<&Cycle> {
        let pass = self.get(number)?.correction.cycle;
        let earlier = |c: &&Cycle| c.is_judged() && c.known.is_some() && c.correction.cycle < pass;
        self.0.range(..number).rev().map(|(_, c)| c).find(earlier)
    }

    /// Returns the number and the points of the last measurement before a cycle.
    pub(super) fn measured_before(&self, number: u32) -> Option<(u32, Arc<Points>)> {
        self.0.range(..number).rev().find_map(|(earlier, cycle)| Some((*earlier, cycle.points.clone()?)))
    }

    /// Stores the result of a computation of a cycle.
    pub(super) fn take(&mut self, number: u32, product: Product) {
        if let Product::Correction(next) = product {
            self.0.insert(number + 1, Cycle::new(next));
        } else if let Some(cycle) = self.0.get_mut(&number) {
            cycle.take(product);
        }
    }

    /// Counts a judgement of a cycle. Returns how many it has had.
    pub(super) fn judged(&mut self, number: u32) -> u32 {
        let Some(cycle) = self.0.get_mut(&number) else { return 1 };
        cycle.judgements += 1;
        cycle.judgements
    }

    /// Returns the last cycle with information about the grinder.
    pub(super) fn last_known(&self) -> Option<&Cycle> {
        self.0.values().rev().find(|cycle| cycle.is_judged() && cycle.known.is_some())
    }

    /// Returns the priors from earlier parts for the fields of errors, updated with the last judged pass of each kind
    /// in this run. Priors from other cells are not included: they would come back to them as those of this cell.
    pub(super) fn taught(&self, task: &Task) -> PartPriors {
        let of_this_cell = task.learned.as_ref().filter(|learned| learned.taught_by.is_none());
        let mut taught = of_this_cell.map(|learned| learned.fields).unwrap_or_default();
        for is_corrected in [false, true] {
            let alike = |cycle: &&Cycle| cycle.is_judged() && cycle.correction.is_zero() != is_corrected;
            if let Some(field) = self.0.values().filter(alike).filter_map(|cycle| cycle.field).next_back() {
                taught.update(is_corrected, &field);
            }
        }
        taught
    }

    /// Returns the rows of the table of cycles.
    pub(super) fn rows(&self, tolerance: &Tolerance) -> Vec<CycleRow> {
        let rows = self.0.iter().filter_map(|(&cycle, c)| {
            let figures = c.figures.as_ref()?;
            let [judged_pv_um, judged_rms_um] = tolerance.compare(figures).map(|of| Some(1e3 * of.found_mm));
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

/// Creates the next batch of touches of a measurement. The first batch has targets that are far apart; they are
/// approached slowly if the part may have been clamped again.
fn batch(task: &Task, cycle: &mut Cycle, pose: &Pose, seated_anew: bool) -> Plan {
    cycle.batch = cycle.points.as_ref().map_or(0, |points| points.tried.len() as u32);
    cycle.asked = match &cycle.next {
        Some(next) => Arc::clone(next),
        None => {
            let places = task.places();
            Arc::new(short_tour(&places, farthest_points(&places, FIRST_BATCH)))
        }
    };
    let is_first = cycle.batch == 0;
    let pose = cycle.registration.as_ref().map_or(*pose, |found| found.cmm_from_model);
    let chosen = cycle.asked.to_vec();
    let order = if is_first && seated_anew { (chosen, Vec::new()) } else { (Vec::new(), chosen) };
    task.plan_of(cycle.correction.level_mm, &pose, order, is_first)
}
