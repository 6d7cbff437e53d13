//! Judgement of the figures of a cycle: the verdict and its reason, in words.

use regrind_figures::{Interval, PartResponse};

use super::command::Verdict;
use super::event::Figures;
use super::plan::{CellPlan, PvPoints, Tolerance};

/// Factor by which a figure must exceed the one of the cycle before to make the cycle worse.
const DIVERGENCE_FACTOR: f64 = 1.05;

/// Verdict and its reason.
pub(super) struct ReasonedVerdict {
    pub(super) verdict: Verdict,
    pub(super) reason: String,
}

impl Figures {
    /// Returns true if the figures can be judged: every checked figure is finite and not negative, and every credible
    /// interval in `form` is valid. An interval is valid if its values are finite and in ascending order and its median
    /// is not negative.
    pub(super) fn are_valid(&self) -> bool {
        let all = [
            self.pv_mm,
            self.rms_mm,
            self.pv_expanded_mm,
            self.rms_expanded_mm,
            self.coverage,
            self.shift_mm,
            self.rotation_rad,
            self.pv_998_mm.unwrap_or(0.0),
            self.forecast.map_or(0.0, |f| f.rms_mm + f.sigma_mm + f.floor_mm.unwrap_or(0.0)),
            self.removed_mm.unwrap_or(0.0),
            self.with_outliers.as_ref().map_or(0.0, |of| of.pv_mm),
            self.with_outliers.as_ref().map_or(0.0, |of| of.rms_mm),
        ];
        let form = self.form.iter().flat_map(|form| [form.pv, form.pv_998, form.rms]);
        all.iter().all(|figure| figure.is_finite() && *figure >= 0.0) && form.into_iter().all(|of| of.is_valid())
    }

    /// Returns two results: the credible intervals of the figures that are judged, and a flag.
    ///
    /// The first interval belongs to the peak to valley (PV), and the second one to the root mean square (RMS).
    /// `pv_points` selects the PV: PV 99.8 % or the PV of all points. If no PV 99.8 % was computed, the PV of all
    /// points is used.
    ///
    /// The flag is true if the first interval belongs to the PV 99.8 %, and false if it belongs to the PV of all
    /// points.
    fn judged_intervals(&self, pv_points: PvPoints) -> ([Interval; 2], bool) {
        match &self.form {
            Some(form) if pv_points == PvPoints::MostPoints => ([form.pv_998, form.rms], true),
            Some(form) => ([form.pv, form.rms], false),
            None => {
                let robust = self.pv_998_mm.filter(|_| pv_points == PvPoints::MostPoints);
                let pv = Interval::from_expanded(robust.unwrap_or(self.pv_mm), self.pv_expanded_mm);
                ([pv, Interval::from_expanded(self.rms_mm, self.rms_expanded_mm)], robust.is_some())
            }
        }
    }
}

/// Conformity of a figure with its limit (ISO 14253-1, JCGM 106): proven within the limit, proven beyond the limit, or
/// neither. A proof requires the probability of the tolerance.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Conformity {
    /// Within, for certain.
    Within,
    /// The limit lies within the uncertainty of the figure: nothing is proven.
    Undecided,
    /// Beyond, for certain.
    Beyond,
}

impl Conformity {
    fn from_interval([low, high]: [f64; 2], limit: f64) -> Self {
        if high <= limit {
            Self::Within
        } else if low <= limit {
            Self::Undecided
        } else {
            Self::Beyond
        }
    }
}

/// Figure that is judged, with its limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ComparedFigure {
    /// Name of the figure.
    pub name: &'static str,
    /// Median of the figure.
    pub median_mm: f64,
    /// Expanded measuring uncertainty (k = 2): half of the width of `interval_mm`. Given even if the tolerance ignores
    /// the uncertainty.
    pub expanded_mm: f64,
    /// Lower and upper end of the 95 % credible interval. Given even if the tolerance ignores the uncertainty.
    pub interval_mm: [f64; 2],
    /// Largest accepted value; infinite if the figure is not limited.
    pub limit_mm: f64,
    /// Probability that the figure is within its limit, 0.001 to 0.999. Given even if the tolerance ignores the
    /// uncertainty. `None` if the figure is not limited.
    pub probability_in_tolerance: Option<f64>,
    /// Lower and upper value that are compared with the limit: the quantiles at 1 - p and p, where p is the probability
    /// of the tolerance. If the tolerance ignores the uncertainty, both values are the median.
    pub compared_mm: [f64; 2],
    /// Conformity of the figure. The uncertainty counts unless the tolerance ignores it.
    pub conformity: Conformity,
}

impl ComparedFigure {
    /// Returns a text for people with the probability that the figure is within its limit, for example "P(in tolerance)
    /// = 84.1 %". Returns `None` if the figure has no limit.
    pub fn probability_in_words(&self) -> Option<String> {
        let [least, most] = [Interval::PROBABILITIES[0], Interval::PROBABILITIES[Interval::COUNT - 1]];
        self.probability_in_tolerance.map(|within| match within {
            _ if within <= least => format!("P(in tolerance) < {}", format_percent(least)),
            _ if within >= most => format!("P(in tolerance) > {}", format_percent(most)),
            _ => format!("P(in tolerance) = {}", format_percent(within)),
        })
    }
}

/// Formats `probability` (0 to 1) for people, in percent with one decimal, for example "84.1 %". Rounds down, so that
/// the text never states more than the probability.
fn format_percent(probability: f64) -> String {
    format!("{:.1} %", 0.1 * (1e3 * probability + 1e-6).floor())
}

impl Tolerance {
    /// Compares the peak to valley (PV) and the root mean square (RMS) in `figures` with their limits. Returns one
    /// result for the PV and one for the RMS, in this order. The field `pv_points` of the tolerance selects the PV: PV
    /// 99.8 % or the PV of all points.
    pub fn compare(&self, figures: &Figures) -> [ComparedFigure; 2] {
        let ([pv, rms], is_robust) = figures.judged_intervals(self.pv_points);
        let compared = |name, of: Interval, limit_mm: f64| {
            let between_mm = [of.low_mm, of.high_mm];
            let held_mm = match self.with_uncertainty {
                true => [1.0 - self.probability, self.probability].map(|share| of.quantile_mm(share)),
                false => [of.median_mm; 2],
            };
            let within = limit_mm.is_finite().then(|| of.probability_within(limit_mm));
            let (conformity, expanded_mm) = (Conformity::from_interval(held_mm, limit_mm), of.expanded_mm());
            ComparedFigure {
                name,
                median_mm: of.median_mm,
                expanded_mm,
                interval_mm: between_mm,
                limit_mm,
                probability_in_tolerance: within,
                compared_mm: held_mm,
                conformity,
            }
        };
        [compared(if is_robust { "PV 99.8 %" } else { "PV" }, pv, self.pv_mm), compared("RMS", rms, self.rms_mm)]
    }

    /// Returns true if the part is within its limits without the outliers and exceeds a limit with the outliers.
    pub fn outliers_decide(&self, figures: &Figures) -> bool {
        let [pv, rms] = self.compare(figures).map(|compared| compared.conformity);
        pv.max(rms) == Conformity::Within && self.exceeded_with_outliers(figures).is_some()
    }

    /// Returns a text for people if the part exceeds a limit when the outliers are included. The text names the
    /// outliers and each exceeded limit. Returns `None` if there are no outliers, or if no limit is exceeded with them.
    ///
    /// The PV with outliers is estimated as the judged PV plus the increase, in mm, that the outliers cause in the PV
    /// of the measured points. The RMS is estimated in the same way, with squares: the outliers increase the square of
    /// the judged RMS by as much as the square of the RMS of the measured points. An increase is never negative.
    fn exceeded_with_outliers(&self, now: &Figures) -> Option<String> {
        let left_out = now.with_outliers.as_ref()?;
        let [pv, rms] = self.compare(now);
        let more = |with_mm: f64, without_mm: f64| (with_mm - without_mm).max(0.0);
        let pv_mm = pv.median_mm + more(left_out.pv_mm, now.pv_mm);
        let rms_mm = (rms.median_mm.powi(2) + more(left_out.rms_mm.powi(2), now.rms_mm.powi(2))).sqrt();
        let beyond = [("PV", pv_mm, pv.limit_mm), ("RMS", rms_mm, rms.limit_mm)];
        let beyond: Vec<String> = beyond
            .into_iter()
            .filter(|(_, with_mm, limit_mm)| with_mm > limit_mm)
            .map(|(name, with_mm, limit_mm)| format!("{name} {}, limit {}", format_um(with_mm), format_um(limit_mm)))
            .collect();
        (!beyond.is_empty()).then(|| format!("{}; with the outliers: {}", left_out.description, beyond.join("; ")))
    }
}

/// Judges the measurement of a cycle and returns the verdict with its reason. `now` are the figures of this cycle.
/// `before` are the figures of the last judged cycle, or `None` if there is none. `passes` is the number of passes that
/// were begun.
///
/// The rules are checked in this order, and the first rule that applies gives the verdict:
///
/// - The part is proven in tolerance. The verdict is `Accept`. If the part exceeds a limit when the outliers are
///   included, the verdict is `LeftOut`.
/// - Another pass of the minimum depth would exceed the removal budget (the total removal that the plan allows):
///   `BudgetSpent`.
/// - The maximum number of passes was begun: `MaxCycles`.
/// - The part responded wrongly to the last correction map, for example with the opposite sign: `WrongResponse`.
/// - The PV or the RMS is more than 1.05 times the value of the last judged cycle: `Diverging`.
/// - Neither the PV nor the RMS has improved enough since the last judged cycle: `Stalled`.
/// - Otherwise, the expected improvement by another pass decides: `Continue`, `Undecided` or `Stalled`.
pub(super) fn judge(plan: &CellPlan, before: Option<&Figures>, now: &Figures, passes: u32) -> ReasonedVerdict {
    let tell = |verdict, reason| ReasonedVerdict { verdict, reason };
    let figures = figures_in_words(plan, now);
    let conformity = conformity(plan, now);
    if conformity == Conformity::Within {
        if let Some(beyond) = plan.tolerance.exceeded_with_outliers(now) {
            return tell(Verdict::LeftOut, format!("{beyond}; without the outliers: {figures}"));
        }
        return tell(Verdict::Accept, format!("in tolerance: {figures}"));
    }
    let spent = now.removed_mm.filter(|removed| removed + plan.min_depth_mm > plan.removal_budget_mm);
    if let Some(removed) = spent {
        let (removed, budget) = (format_um(removed), format_um(plan.removal_budget_mm));
        return tell(
            Verdict::BudgetSpent,
            format!("removed {removed} in total, limit {budget}: another pass would exceed the limit; {figures}"),
        );
    }
    if passes >= plan.max_cycles {
        let response = now.response.and_then(wrong_response).map_or(String::new(), |message| format!("; {message}"));
        return tell(
            Verdict::MaxCycles,
            format!(
                "the part is not proven in tolerance after {passes} of {} allowed passes: {figures}{response}",
                plan.max_cycles
            ),
        );
    }
    if let Some(message) = now.response.and_then(wrong_response) {
        return tell(Verdict::WrongResponse, format!("{message}; {figures}"));
    }
    if let Some(before) = before {
        let [[pv, rms], [pv_before, rms_before]] = [now, before].map(|of| judged_medians_mm(plan, of));
        let was = format!("previous cycle: PV {}, RMS {}", format_um(pv_before), format_um(rms_before));
        if pv > DIVERGENCE_FACTOR * pv_before || rms > DIVERGENCE_FACTOR * rms_before {
            return tell(Verdict::Diverging, format!("worse than the previous cycle: {figures}; {was}"));
        }
        if has_stalled(plan, before, now) {
            let least = match plan.stall_mm {
                0.0 => format!(
                    "the larger of two limits (measuring uncertainty; {:.0} % of the previous value)",
                    100.0 * plan.stall_share
                ),
                least => {
                    format!(
                        "the largest of three limits (measuring uncertainty; {:.0} % of the previous value; {})",
                        100.0 * plan.stall_share,
                        format_um(least)
                    )
                }
            };
            return tell(Verdict::Stalled, format!("improvement below {least}: {figures}; {was}"));
        }
    }
    judge_next_pass(plan, before, now, conformity)
}

/// Returns the verdict on another pass. The verdict depends on the RMS that is forecast after this pass. `now` are the
/// figures of the present cycle, and `before` are those of the last judged cycle. `conformity` is the conformity of the
/// part.
///
/// The verdict is `Continue` in two cases:
///
/// - There is no forecast, or no cycle was judged before (`before` is `None`).
/// - The forecast improvement of the RMS is more than the limits in `plan`: `stall_mm`, and the share `stall_share` (0
///   to 1) of the present RMS. In addition, the present RMS must exceed the lower bound in the forecast by more than
///   the expanded uncertainty of the RMS. This lower bound is the lowest RMS that further corrections can reach. If it
///   is unknown, only the limits in `plan` count.
///
/// Otherwise, no improvement is expected. The verdict is then `Undecided` if the conformity is undecided, or else
/// `Stalled`.
fn judge_next_pass(
    plan: &CellPlan,
    before: Option<&Figures>,
    now: &Figures,
    conformity: Conformity,
) -> ReasonedVerdict {
    let (tell, figures) = (|verdict, reason| ReasonedVerdict { verdict, reason }, figures_in_words(plan, now));
    let undecided = conformity == Conformity::Undecided;
    let so_far = if undecided {
        "the uncertainty is too large to prove the part in or out of tolerance"
    } else {
        "not yet in tolerance"
    };
    // Before the first correction nothing is known about the effect of a correction.
    let forecast = now.forecast.filter(|_| before.is_some());
    let Some(forecast) = forecast else { return tell(Verdict::Continue, format!("{so_far}: {figures}")) };
    let (expected, sigma) = (format_um(forecast.rms_mm), format_um(forecast.sigma_mm));
    let floor = forecast.floor_mm.map_or(String::new(), |floor| format!(", lower bound {}", format_um(floor)));
    let expected = format!("expected after another pass: RMS {expected} ± {sigma} (standard deviation){floor}");
    let [_, rms] = plan.tolerance.compare(now);
    // If the found rms exceeds the floor by no more than its uncertainty, another pass cannot improve it.
    let at_floor = forecast.floor_mm.is_some_and(|floor| rms.median_mm <= floor + rms.expanded_mm);
    if !at_floor && rms.median_mm - forecast.rms_mm > plan.stall_mm.max(plan.stall_share * rms.median_mm) {
        return tell(Verdict::Continue, format!("{so_far}: {figures}; {expected}"));
    }
    let verdict = if undecided { Verdict::Undecided } else { Verdict::Stalled };
    tell(verdict, format!("no improvement expected, {so_far}: {figures}; {expected}"))
}

/// Returns the conformity of the part with its limits. This is the worse one of two values: the conformity of the
/// judged peak to valley, and that of the judged RMS. `now` are the figures of the part. The order from good to bad is
/// `Within`, `Undecided`, `Beyond`.
fn conformity(plan: &CellPlan, now: &Figures) -> Conformity {
    let [pv, rms] = plan.tolerance.compare(now);
    pv.conformity.max(rms.conformity)
}

/// Returns two medians in mm: that of the judged peak to valley and that of the RMS, in this order. The tolerance in
/// `plan` selects the judged peak to valley: PV 99.8 % or the PV of all points.
fn judged_medians_mm(plan: &CellPlan, figures: &Figures) -> [f64; 2] {
    plan.tolerance.compare(figures).map(|compared| compared.median_mm)
}

fn has_stalled(plan: &CellPlan, before: &Figures, now: &Figures) -> bool {
    let still = |was: f64, is: f64, least: f64| was - is < least.max(plan.stall_share * was);
    let [pv, rms] = plan.tolerance.compare(now);
    let [pv_before, rms_before] = judged_medians_mm(plan, before);
    still(pv_before, pv.median_mm, pv.expanded_mm)
        && still(rms_before, rms.median_mm, rms.expanded_mm.max(plan.stall_mm))
}

/// Returns a number that ranks cycles: the smaller it is, the nearer is the part to acceptance. It is the larger of PV
/// divided by its limit and RMS divided by its limit. A figure without a limit is ignored. Returns the RMS in mm if
/// neither figure has a limit.
pub(super) fn distance_to_acceptance(plan: &CellPlan, figures: &Figures) -> f64 {
    let compared = plan.tolerance.compare(figures);
    let shares = compared.iter().filter(|of| of.limit_mm.is_finite() && of.limit_mm > 0.0);
    shares.map(|of| of.median_mm / of.limit_mm).reduce(f64::max).unwrap_or(compared[1].median_mm)
}

/// Returns the text that names the best cycle of a run: its number, its judged figures, and the folder with its
/// correction. The text begins with "; ", because it is appended to the reason why the run ended.
pub(super) fn best_in_words(plan: &CellPlan, cycle: u32, figures: &Figures) -> String {
    let [pv, rms] = judged_medians_mm(plan, figures);
    format!(
        "; best cycle {cycle}: PV {}, RMS {}; the correction and the map of this cycle are in the folder cycle-{cycle}",
        format_um(pv),
        format_um(rms)
    )
}

/// Returns a text for people if the part responded wrongly to the last correction map. A response is the change of the
/// surface by the pass that used this map. It is wrong, for example, if it has the opposite sign or is twice as large
/// as expected. Returns `None` if the response is as expected or unclear.
fn wrong_response(response: PartResponse) -> Option<&'static str> {
    match response {
        PartResponse::Expected | PartResponse::Unclear => None,
        PartResponse::SignFlipped => Some("the part responded with the opposite sign: the sign of the map is wrong"),
        PartResponse::Mirrored => {
            Some("the part responded as it would to a mirrored or rotated map: the direction of an axis is wrong")
        }
        PartResponse::NoEffect => Some("the part did not respond to the map"),
        PartResponse::Doubled => Some("the part responded twice as much as expected: the map was applied twice"),
    }
}

fn figures_in_words(plan: &CellPlan, now: &Figures) -> String {
    let of = |compared: ComparedFigure| {
        let within = compared.probability_in_words().map_or(String::new(), |words| format!(", {words}"));
        let ComparedFigure { name, median_mm: found_mm, expanded_mm, limit_mm, .. } = compared;
        let limit = if limit_mm.is_finite() { format!(", limit {}", format_um(limit_mm)) } else { String::new() };
        format!("{name}: {} ± {}{limit}{within}", format_um(found_mm), format_um(expanded_mm))
    };
    let [pv, rms] = plan.tolerance.compare(now).map(of);
    let Tolerance { with_uncertainty, probability, .. } = plan.tolerance;
    let counts = if with_uncertainty {
        let unstated = match now.unstated {
            Some([some, all]) if some > 0 => {
                format!("; {some} of {all} contributions to the uncertainty are not stated and count as 0")
            }
            _ => String::new(),
        };
        format!("{} required{unstated}", format_percent(probability))
    } else {
        "uncertainty not counted".into()
    };
    format!("{pv}; {rms}; {counts}")
}

/// Formats the length `mm`, given in millimetres, in µm with two decimals, for example "3.31 µm".
pub(super) fn format_um(mm: f64) -> String {
    format!("{:.2} µm", 1e3 * mm)
}
