//! Reaction to a measurement: its gates, the judgement of the cycle, and a refused compensation.

use std::sync::Arc;

use super::alarm::AlarmId;
use super::cell::Cell;
use super::command::{Command, Judgement, Verdict};
use regrind_figures::PartResponse;

use super::event::{CompensationRefusal, Figures, GateFailure, GateResult};
use super::judge::{self, ReasonedVerdict, format_um};
use super::plan::HoldOrStop;
use super::state::{Device, JobStep, Phase, State};

use Phase::{Compensate, Judge, Measure, Register};
use State::{Completing, Held};

impl Cell {
    pub(super) fn on_collected(&mut self, targets: u32, found: u32, gate: &GateResult) {
        let share = f64::from(found) / f64::from(targets.max(1));
        let gate = match gate {
            GateResult::Failed(reason) => Some(gate_alarm(reason)),
            GateResult::Passed if found > targets || share < self.plan.gates.min_found_share => {
                let least = 100.0 * self.plan.gates.min_found_share;
                Some((
                    AlarmId::Coverage,
                    format!(
                        "the probe found {found} of {targets} planned points, allowed are {least:.0} % to 100 % of the planned points"
                    ),
                ))
            }
            GateResult::Passed => None,
        };
        match gate {
            Some((id, case)) => {
                self.raise(id, &case);
                self.advance(Measure(JobStep::Discard));
            }
            None if self.plan.gates.max_radius_error_mm.is_some() => self.advance(Measure(JobStep::Qualify)),
            None => self.advance(Measure(JobStep::Acknowledge)),
        }
    }

    pub(super) fn on_qualified(&mut self, radius_error_mm: f64) {
        let most = self.plan.gates.max_radius_error_mm.unwrap_or(f64::INFINITY);
        if radius_error_mm.abs() <= most {
            return self.advance(Measure(JobStep::Acknowledge));
        }
        let case = format!("the difference is {}, limit {}", format_um(radius_error_mm), format_um(most));
        self.raise(AlarmId::ProbeRadius, &case);
        self.advance(Measure(JobStep::Discard));
    }

    pub(super) fn on_registered(&mut self, figures: &Figures) {
        let gates = self.plan.gates;
        let (shift, turn) = (figures.shift_mm, figures.rotation_rad.to_degrees());
        if !figures.are_valid() {
            self.reject_measurement(
                AlarmId::RegistrationFailed,
                "a figure of the registration is negative or not a number",
            );
        } else if figures.further_touches.is_none() && figures.coverage < gates.min_coverage {
            let (found, least) = (100.0 * figures.coverage, 100.0 * gates.min_coverage);
            self.reject_measurement(
                AlarmId::Coverage,
                &format!("{found:.0} % of the aperture is covered, at least {least:.0} % is required"),
            );
        } else if shift > gates.max_shift_mm || figures.rotation_rad > gates.max_rotation_rad {
            let (most, max_turn) = (gates.max_shift_mm, gates.max_rotation_rad.to_degrees());
            let case = format!("shift {shift:.3} mm, limit {most:.3} mm; turn {turn:.2}°, limit {max_turn:.2}°");
            self.reject_measurement(AlarmId::PartMisplaced, &case);
        } else if figures.further_touches.is_some() {
            // More points of the same measurement follow. A partial measurement is not judged.
            self.advance(Measure(JobStep::Send));
        } else {
            self.figures = Some(Arc::new(figures.clone()));
            self.advance(Judge);
        }
    }

    pub(super) fn judge_cycle(&mut self) {
        let Some(figures) = self.figures.take() else { return self.enter_state(Held(Register)) };
        let ReasonedVerdict { verdict, mut reason } =
            judge::judge(&self.plan, self.previous.as_deref(), &figures, self.pass_count);
        let response = figures.response;
        if verdict == Verdict::LeftOut {
            // The figures of the part are not known yet, so nothing is compared with them.
            self.push(Command::Announce(Judgement { cycle: self.cycle, verdict, reason: reason.clone() }));
            if !figures.with_outliers.as_ref().is_some_and(|left_out| left_out.can_repeat) {
                return self.reject_measurement(AlarmId::LeftOut, &reason);
            }
            // Touch only the named places again, in the same measurement. A point that is not touched again keeps its
            // value.
            self.raise(AlarmId::LeftOut, &reason);
            return self.enter_state(Held(Measure(JobStep::Send)));
        }
        let distance = |of: &Figures| judge::distance_to_acceptance(&self.plan, of);
        match &self.best_cycle {
            Some((cycle, best)) if distance(best) < distance(&figures) && *cycle != self.cycle => {
                if !matches!(verdict, Verdict::Accept | Verdict::Continue | Verdict::WrongResponse) {
                    reason += &judge::best_in_words(&self.plan, *cycle, best);
                }
            }
            _ => self.best_cycle = Some((self.cycle, Arc::clone(&figures))),
        }
        self.previous = Some(figures);
        self.diverging_cycles = if verdict == Verdict::Diverging { self.diverging_cycles + 1 } else { 0 };
        self.push(Command::Announce(Judgement { cycle: self.cycle, verdict, reason: reason.clone() }));
        match verdict {
            Verdict::Accept => self.accept(reason),
            Verdict::LeftOut => {}
            Verdict::Continue => self.advance(Compensate),
            Verdict::MaxCycles => self.stop_not_accepted(AlarmId::MaxCycles, &reason),
            Verdict::BudgetSpent => self.stop_not_accepted(AlarmId::BudgetSpent, &reason),
            Verdict::Diverging => {
                self.raise(AlarmId::Diverging, &reason);
                if self.diverging_cycles < 2 {
                    self.advance(Compensate)
                } else {
                    self.hold_or_stop(self.plan.on_divergence, &reason)
                }
            }
            Verdict::Stalled => {
                self.raise(AlarmId::Stalled, &reason);
                self.hold_or_stop(self.plan.on_stall, &reason);
            }
            Verdict::Undecided => {
                self.raise(AlarmId::Undecided, &reason);
                self.hold_or_stop(self.plan.on_stall, &reason);
            }
            Verdict::WrongResponse => {
                self.raise(response.map_or(AlarmId::NoEffect, response_alarm), &reason);
                self.enter_state(Held(Compensate));
            }
        }
    }

    pub(super) fn accept(&mut self, reason: String) {
        self.ending_reason = reason;
        self.enter_state(Completing);
        for device in Device::BOTH {
            self.verify_clear(device);
        }
    }

    fn stop_not_accepted(&mut self, id: AlarmId, reason: &str) {
        self.raise(id, reason);
        self.stop(reason, true);
    }

    fn hold_or_stop(&mut self, disposal: HoldOrStop, reason: &str) {
        match disposal {
            HoldOrStop::Hold => self.enter_state(Held(Compensate)),
            HoldOrStop::Stop => self.stop(reason, true),
        }
    }

    pub(super) fn on_compensation_refused(&mut self, refusal: &CompensationRefusal) {
        match refusal {
            CompensationRefusal::BudgetSpent(message) => {
                let (cycle, verdict, reason) = (self.cycle, Verdict::BudgetSpent, message.clone());
                self.push(Command::Announce(Judgement { cycle, verdict, reason }));
                self.stop_not_accepted(AlarmId::BudgetSpent, message);
            }
            CompensationRefusal::WeakDirections(directions) => {
                let case = directions.join(", ");
                self.raise(AlarmId::WeakDirections, &case);
                self.hold_or_stop(self.plan.on_refusal, &format!("no correction is computed: {case}"));
            }
            CompensationRefusal::Failed(message) => {
                self.raise(AlarmId::CompensationFailed, message);
                self.hold_or_stop(self.plan.on_refusal, message);
            }
        }
    }

    /// Rejects a measurement that cannot be used. Raises the alarm `id`, in which `case` describes the fault, and
    /// prepares a repetition of the measurement. The cell is then held until a person resumes it.
    pub(super) fn reject_measurement(&mut self, id: AlarmId, case: &str) {
        self.raise(id, case);
        self.repeat_measurement();
    }

    /// Prepares a repetition of the measurement: takes the next cycle number, and holds the cell before the plan is
    /// sent. A person resumes the cell. The measurement gets a new number, so that no START is sent twice for one
    /// cycle.
    pub(super) fn repeat_measurement(&mut self) {
        self.cycle += 1;
        self.enter_state(Held(Measure(JobStep::Send)));
    }
}

fn gate_alarm(reason: &GateFailure) -> (AlarmId, String) {
    match reason {
        GateFailure::Coverage(message) => (AlarmId::Coverage, message.clone()),
        GateFailure::NoPart => (AlarmId::NoPart, String::new()),
        GateFailure::Contacts => (AlarmId::Contacts, String::new()),
        GateFailure::Inches => (AlarmId::Inches, "the points of the CMM".to_owned()),
        GateFailure::Foreign(message) => (AlarmId::ForeignResult, message.clone()),
        GateFailure::Broken(message) => (AlarmId::BrokenResult, message.clone()),
        GateFailure::Temperature(message) => (AlarmId::Temperature, message.clone()),
        GateFailure::Moved(message) => (AlarmId::PartMoved, message.clone()),
    }
}

fn response_alarm(response: PartResponse) -> AlarmId {
    match response {
        PartResponse::SignFlipped => AlarmId::SignFlipped,
        PartResponse::Mirrored => AlarmId::Mirrored,
        PartResponse::Doubled => AlarmId::Doubled,
        PartResponse::NoEffect | PartResponse::Expected | PartResponse::Unclear => AlarmId::NoEffect,
    }
}
