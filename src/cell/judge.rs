//! What follows from the figures of a cycle, and why, in words.

use super::command::Verdict;
use super::event::{Figures, Response};
use super::plan::{CellPlan, PvOf, Tolerance};

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
            self.pv_robust_mm.unwrap_or(0.0),
            self.forecast.map_or(0.0, |f| f.rms_mm + f.sigma_mm + f.floor_mm.unwrap_or(0.0)),
            self.removed_mm.unwrap_or(0.0),
        ];
        all.iter().all(|figure| figure.is_finite() && *figure >= 0.0)
    }
}

/// Where a figure lies beside its limit once its uncertainty is counted (ISO 14253-1).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Conformity {
    /// Within, for certain.
    Within,
    /// The uncertainty reaches over the limit: nothing is proven.
    Undecided,
    /// Beyond, for certain.
    Beyond,
}

impl Conformity {
    fn of(found: f64, expanded: f64, limit: f64) -> Self {
        if found + expanded <= limit {
            Self::Within
        } else if found - expanded <= limit {
            Self::Undecided
        } else {
            Self::Beyond
        }
    }
}

/// A figure that is judged, beside its limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Compared {
    /// What the figure is called.
    pub name: &'static str,
    /// What was found.
    pub found_mm: f64,
    /// Its expanded measuring uncertainty (k = 2), whether it is counted or not.
    pub expanded_mm: f64,
    /// The largest that is accepted; infinite where it is not limited.
    pub limit_mm: f64,
    /// What follows, with the uncertainty where the tolerance counts it.
    pub conformity: Conformity,
}

impl Tolerance {
    /// Compares the two figures that are judged with their limits: the peak to valley of the points that it is taken of, and the RMS.
    pub fn compare(&self, figures: &Figures) -> [Compared; 2] {
        let robust = figures.pv_robust_mm.filter(|_| self.pv_of == PvOf::MostPoints);
        let pv_name = if robust.is_some() { "PV 99.8 %" } else { "PV" };
        let compared = |name, found_mm, expanded_mm, limit_mm| {
            let counted = if self.with_uncertainty { expanded_mm } else { 0.0 };
            Compared { name, found_mm, expanded_mm, limit_mm, conformity: Conformity::of(found_mm, counted, limit_mm) }
        };
        [
            compared(pv_name, robust.unwrap_or(figures.pv_mm), figures.pv_expanded_mm, self.pv_mm),
            compared("RMS", figures.rms_mm, figures.rms_expanded_mm, self.rms_mm),
        ]
    }
}

/// Judges the figures of a cycle after `passes` passes. The order of the rules is the order of what cannot be undone.
pub(super) fn judge(plan: &CellPlan, before: Option<&Figures>, now: &Figures, passes: u32) -> Judged {
    let tell = |verdict, reason| Judged { verdict, reason };
    let figures = told(plan, now);
    let conformity = conformity(plan, now);
    if conformity == Conformity::Within {
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
        let response = now.response.and_then(wrong).map_or(String::new(), |message| format!("; {message}"));
        return tell(
            Verdict::MaxCycles,
            format!("{passes} of {} passes are ground; {figures}{response}", plan.max_cycles),
        );
    }
    if let Some(message) = now.response.and_then(wrong) {
        return tell(Verdict::WrongResponse, format!("{message}; {figures}"));
    }
    if let Some(before) = before {
        let was = format!("before: PV {}, RMS {}", um(judged_pv(plan, before)), um(before.rms_mm));
        if judged_pv(plan, now) > WORSE * judged_pv(plan, before) || now.rms_mm > WORSE * before.rms_mm {
            return tell(Verdict::Diverging, format!("worse than the cycle before: {figures}; {was}"));
        }
        if has_stalled(plan, before, now) {
            let least = match plan.stall_mm {
                0.0 => format!("less than the measuring uncertainty or {:.0} %", 100.0 * plan.stall_share),
                least => {
                    format!("less than the measuring uncertainty, {:.0} % or {}", 100.0 * plan.stall_share, um(least))
                }
            };
            return tell(Verdict::Stalled, format!("improved by {least}: {figures}; {was}"));
        }
    }
    go_on(plan, before, now, conformity)
}

/// Whether another pass is worth its material.
fn go_on(plan: &CellPlan, before: Option<&Figures>, now: &Figures, conformity: Conformity) -> Judged {
    let (tell, figures) = (|verdict, reason| Judged { verdict, reason }, told(plan, now));
    let undecided = conformity == Conformity::Undecided;
    let so_far = if undecided { "neither in tolerance nor out of it for certain" } else { "not yet in tolerance" };
    // Before the first correction nobody knows what one can do.
    let forecast = now.forecast.filter(|_| before.is_some());
    let Some(forecast) = forecast else { return tell(Verdict::Continue, format!("{so_far}: {figures}")) };
    let (expected, sigma) = (um(forecast.rms_mm), um(forecast.sigma_mm));
    let floor = forecast.floor_mm.map_or(String::new(), |floor| format!(", no pass can go below {}", um(floor)));
    let expected = format!("RMS {expected} ± {sigma} is expected of another pass{floor}");
    if now.rms_mm - forecast.rms_mm > plan.stall_mm.max(plan.stall_share * now.rms_mm) {
        return tell(Verdict::Continue, format!("{so_far}: {figures}; {expected}"));
    }
    let verdict = if undecided { Verdict::Undecided } else { Verdict::Stalled };
    tell(verdict, format!("no gain is to be expected, and {so_far}: {figures}; {expected}"))
}

/// The worse of the two figures that are limited.
fn conformity(plan: &CellPlan, now: &Figures) -> Conformity {
    let [pv, rms] = plan.tolerance.compare(now);
    pv.conformity.max(rms.conformity)
}

/// The peak to valley that is judged: of all points, or of all but the outermost.
fn judged_pv(plan: &CellPlan, figures: &Figures) -> f64 {
    plan.tolerance.compare(figures)[0].found_mm
}

fn has_stalled(plan: &CellPlan, before: &Figures, now: &Figures) -> bool {
    let still = |was: f64, is: f64, least: f64| was - is < least.max(plan.stall_share * was);
    still(judged_pv(plan, before), judged_pv(plan, now), now.pv_expanded_mm)
        && still(before.rms_mm, now.rms_mm, now.rms_expanded_mm.max(plan.stall_mm))
}

/// Says what a wrong response means.
fn wrong(response: Response) -> Option<&'static str> {
    match response {
        Response::Expected | Response::Unclear => None,
        Response::SignFlipped => Some("the part answered to the map the other way round: its sign is wrong"),
        Response::Mirrored => Some("the part answered as to a mirrored or turned map: an axis points another way"),
        Response::NoEffect => Some("the part did not answer to the map"),
        Response::Doubled => Some("the part answered to the map twice: it was applied two times"),
    }
}

fn told(plan: &CellPlan, now: &Figures) -> String {
    let of = |Compared { name, found_mm, expanded_mm, limit_mm, .. }: Compared| {
        format!("{name} {} ± {} of {}", um(found_mm), um(expanded_mm), um(limit_mm))
    };
    let [pv, rms] = plan.tolerance.compare(now).map(of);
    let counts = if plan.tolerance.with_uncertainty { "with" } else { "without" };
    format!("{pv}, {rms}, {counts} the uncertainty")
}

/// Writes a length in micrometres, for people.
pub(super) fn um(mm: f64) -> String {
    format!("{:.2} um", 1e3 * mm)
}
