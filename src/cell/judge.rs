//! What follows from the figures of a cycle, and why, in words.

use super::command::Verdict;
use super::event::{Figures, Response};
use super::plan::CellPlan;

/// A figure that is worse than the one before by more than this share makes a cycle worse.
const WORSE: f64 = 1.05;

/// A verdict and its reason.
pub(super) struct Judged {
    pub(super) verdict: Verdict,
    pub(super) reason: String,
}

impl Figures {
    /// Returns whether all figures are numbers, and those that cannot be negative are not.
    pub(super) fn are_sound(&self) -> bool {
        let all = [
            self.pv_mm,
            self.rms_mm,
            self.pv_expanded_mm,
            self.rms_expanded_mm,
            self.coverage,
            self.shift_mm,
            self.turn_rad,
            self.removed_mm.unwrap_or(0.0),
        ];
        all.iter().all(|figure| figure.is_finite() && *figure >= 0.0)
    }
}

/// Judges the figures of a cycle after `passes` passes. The order of the rules is the order of what cannot be undone.
pub(super) fn judge(plan: &CellPlan, before: Option<&Figures>, now: &Figures, passes: u32) -> Judged {
    let tell = |verdict, reason| Judged { verdict, reason };
    let figures = told(plan, now);
    if in_tolerance(plan, now) {
        return tell(Verdict::Accept, format!("in tolerance: {figures}"));
    }
    let spent = now.removed_mm.filter(|removed| removed + plan.least_depth_mm > plan.removal_budget_mm);
    if let Some(removed) = spent {
        let (removed, budget) = (um(removed), um(plan.removal_budget_mm));
        return tell(
            Verdict::BudgetSpent,
            format!("{removed} of {budget} have been taken off, no pass is left; {figures}"),
        );
    }
    if passes >= plan.max_cycles {
        let response = now.response.and_then(wrong).map_or(String::new(), |words| format!("; {words}"));
        return tell(
            Verdict::MaxCycles,
            format!("{passes} of {} passes are ground; {figures}{response}", plan.max_cycles),
        );
    }
    if let Some(words) = now.response.and_then(wrong) {
        return tell(Verdict::WrongResponse, format!("{words}; {figures}"));
    }
    let Some(before) = before else { return tell(Verdict::Continue, format!("not yet in tolerance: {figures}")) };
    let was = format!("before: PV {}, RMS {}", um(before.pv_mm), um(before.rms_mm));
    if now.pv_mm > WORSE * before.pv_mm || now.rms_mm > WORSE * before.rms_mm {
        return tell(Verdict::Diverging, format!("worse than the cycle before: {figures}; {was}"));
    }
    if has_stalled(plan, before, now) {
        let least = format!("less than the measuring uncertainty or {:.0} %", 100.0 * plan.stall_share);
        return tell(Verdict::Stalled, format!("improved by {least}: {figures}; {was}"));
    }
    tell(Verdict::Continue, format!("better, not yet in tolerance: {figures}; {was}"))
}

fn in_tolerance(plan: &CellPlan, now: &Figures) -> bool {
    let tolerance = &plan.tolerance;
    let (pv, rms) = if tolerance.with_uncertainty { (now.pv_expanded_mm, now.rms_expanded_mm) } else { (0.0, 0.0) };
    now.pv_mm + pv <= tolerance.pv_mm && now.rms_mm + rms <= tolerance.rms_mm
}

fn has_stalled(plan: &CellPlan, before: &Figures, now: &Figures) -> bool {
    let still = |was: f64, is: f64, uncertainty: f64| was - is < uncertainty.max(plan.stall_share * was);
    still(before.pv_mm, now.pv_mm, now.pv_expanded_mm) && still(before.rms_mm, now.rms_mm, now.rms_expanded_mm)
}

/// Says what a wrong response means.
fn wrong(response: Response) -> Option<&'static str> {
    match response {
        Response::Expected | Response::Unclear => None,
        Response::SignFlipped => Some("the part answered to the map the other way round: its sign is wrong"),
        Response::Mirrored => Some("the part answered as to a mirrored map: an axis points the other way"),
        Response::NoEffect => Some("the part did not answer to the map"),
    }
}

fn told(plan: &CellPlan, now: &Figures) -> String {
    let tolerance = &plan.tolerance;
    let (pv, rms) = (um(now.pv_mm), um(now.rms_mm));
    let (pv_u, rms_u) = (um(now.pv_expanded_mm), um(now.rms_expanded_mm));
    let counts = if tolerance.with_uncertainty { "with" } else { "without" };
    format!(
        "PV {pv} ± {pv_u} of {}, RMS {rms} ± {rms_u} of {}, {counts} the uncertainty",
        um(tolerance.pv_mm),
        um(tolerance.rms_mm)
    )
}

/// Writes a length in micrometres, for people.
pub(super) fn um(mm: f64) -> String {
    format!("{:.2} um", 1e3 * mm)
}
