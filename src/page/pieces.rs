//! Pieces of a run's page as HTML: the header, the steps, the next action, the alarms, the figures. Only this module
//! makes them, both for the first response and for each later change.

use maud::{Markup, html};
use regrind_cell::{Alarm, Device, Phase, Role, StateName, Tolerance};
use regrind_control::{JobProgress, NextStep, PreviewStatistics, Snapshot};
use regrind_report::{AlarmAcknowledgement, AlarmHistory, CycleSummary, RunResult, RunSummary, verdict_in_words};

use super::alarms::alarm_texts;
use super::chart::chart;
use super::gauge::gauge;
use super::live::ObservedRun;
use super::operator_step;
use super::texts::{self, Text};
use regrind_language::{Language, decimal};

/// Piece of the page of a run, which is updated on its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Piece {
    Banner,
    Steps,
    Next,
    Alarms,
    Judged,
    Convergence,
    Cycles,
    About,
    Control,
}

impl Piece {
    /// Returns the id of the HTML element that contains the piece.
    pub(crate) fn id(self) -> &'static str {
        match self {
            Self::Banner => "banner",
            Self::Steps => "steps",
            Self::Next => "next",
            Self::Alarms => "alarms",
            Self::Judged => "judged",
            Self::Convergence => "convergence",
            Self::Cycles => "cycles",
            Self::About => "about",
            Self::Control => "control",
        }
    }
}

/// Returns the HTML of each piece of the page of a run. A piece is a part of the page that is updated on its own.
/// `seen` is the current status of the run. If `has_control` is false and the program of the run answers, one piece
/// offers to take control of the cell.
pub(crate) fn run_pieces(seen: &ObservedRun, has_control: bool, language: Language) -> [(Piece, String); 9] {
    let ObservedRun { snapshot, summary, .. } = seen;
    let live = snapshot.as_deref().filter(|_| seen.answers);
    let tolerance = summary.tolerance.as_ref();
    [
        (Piece::Banner, banner(seen, language)),
        (Piece::Steps, steps(seen, language)),
        (Piece::Next, next(seen, language)),
        (Piece::Alarms, alarms(seen, language)),
        (Piece::Judged, judged(&summary.cycles, tolerance, language)),
        (Piece::Convergence, chart(&summary.cycles, tolerance, live.is_some(), language)),
        (Piece::Cycles, figures(&summary.cycles, tolerance, language)),
        (Piece::About, about(seen, language)),
        (Piece::Control, control(live.is_some() && !has_control, language)),
    ]
    .map(|(piece, markup)| (piece, markup.into_string()))
}

pub(super) fn is_over(state: StateName) -> bool {
    matches!(state, StateName::Stopped | StateName::Aborted | StateName::Complete)
}

/// Returns the HTML of the header of a run: the part, and one word with a shape and a colour for the state. `seen` is
/// the current status of the run. The word is the state of the cell while the run is active, and the result of the run
/// afterwards. If the run has no end and its program does not answer, the word is "?".
pub(super) fn banner(seen: &ObservedRun, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let RunSummary { part, name, recipe, operator, simulation, .. } = &*seen.summary;
    let StateChip { class, shape, word, more } = state_chip(seen, language);
    let subject = [part, recipe, operator].map(String::as_str).into_iter().filter(|text| !text.is_empty());
    let remaining_s = seen.snapshot.as_deref().filter(|_| seen.answers).and_then(|live| live.progress?.remaining_s);
    html! {
        div .banner .(class) {
            div .subject { strong { (name) } span { (subject.collect::<Vec<_>>().join(" · ")) } }
            @if *simulation { span .simulation { (say(Text::Simulation)) } }
            div .state {
                svg .shape viewBox="0 0 24 24" aria-hidden="true" { path d=(shape) {} }
                div { strong { (word) } @if !more.is_empty() { span .more title=(more) { (more) } } }
            }
            // An empty place keeps the others where they are.
            div .remaining {
                @if let Some(remaining_s) = remaining_s {
                    strong { (range(remaining_s, language)) } " " span { (say(Text::ToEndOfStep)) }
                } @else { strong { "\u{a0}" } }
            }
        }
    }
}

/// State of a run as one word, with its CSS class (colour), its SVG path (shape), and some more words.
struct StateChip {
    class: &'static str,
    shape: &'static str,
    word: &'static str,
    more: String,
}

fn state_chip(seen: &ObservedRun, language: Language) -> StateChip {
    let say = |text: Text| text.to(language);
    if let Some(live) = seen.snapshot.as_deref().filter(|live| seen.answers && !is_over(live.state)) {
        let phase = live.phase.map_or(String::new(), |phase| say(texts::phase(phase)).to_owned());
        let not_confirmed = live.unconfirmed.iter().map(|device| format!("{device}?")).collect::<Vec<_>>().join(" ");
        let cycle = match live.cycle {
            0 => String::new(),
            cycle => format!("{} {cycle} {} {}", say(Text::Cycle), say(Text::OfAtMost), live.max_cycles),
        };
        let parts = [not_confirmed, phase, cycle].into_iter().filter(|part| !part.is_empty());
        let (class, shape) = state_symbol(live);
        return StateChip {
            class,
            shape,
            word: say(texts::state(live.state)),
            more: parts.collect::<Vec<_>>().join(" · "),
        };
    }
    if seen.is_lost() && !seen.summary.run.is_empty() {
        return StateChip { class: "lost", shape: UNKNOWN, word: "?", more: String::new() };
    }
    let result = seen.summary.result;
    // A person who ends a run raises no alarm.
    let (class, shape) = match result {
        RunResult::Accepted => ("good", TICK),
        RunResult::NotAccepted => ("rejected", CROSS),
        RunResult::Aborted => ("bad", OCTAGON),
        RunResult::Stopped | RunResult::Open | RunResult::Recovery => ("still", SQUARE),
    };
    StateChip { class, shape, word: say(texts::result(result)), more: String::new() }
}

/// Returns the reason of the verdict on a run. The verdict of the record begins with the word that the header shows.
pub(super) fn verdict_reason(summary: &RunSummary) -> &str {
    let parts = summary.verdict.split_once(": ").filter(|(word, _)| word.chars().all(|c| !c.is_lowercase()));
    parts.map_or(summary.verdict.as_str(), |(_, reason)| reason)
}

const PLAY: &str = "M6 3 L21 12 L6 21 Z";
const PAUSE: &str = "M5 3 H10 V21 H5 Z M14 3 H19 V21 H14 Z";
const SQUARE: &str = "M4 4 H20 V20 H4 Z";
const OCTAGON: &str = "M8 2 H16 L22 8 V16 L16 22 H8 L2 16 V8 Z";
const TICK: &str = "M2 13 L9 20 L22 6 L19 3 L9 14 L5 10 Z";
const CROSS: &str = "M4 7 L7 4 L12 9 L17 4 L20 7 L15 12 L20 17 L17 20 L12 15 L7 20 L4 17 L9 12 Z";
const TRIANGLE: &str = "M12 2 L23 21 H1 Z";
const UNKNOWN: &str = "M12 2 L22 12 L12 22 L2 12 Z";

/// Returns the CSS class (colour) and the SVG path (shape) for the state of the cell.
fn state_symbol(live: &Snapshot) -> (&'static str, &'static str) {
    use StateName as S;
    match live.state {
        S::Aborting | S::Aborted => ("bad", OCTAGON),
        _ if !live.alarms.is_empty() || !live.unconfirmed.is_empty() => ("alarm", TRIANGLE),
        S::Execute if asks_person(&live.next_step) => ("asks", TRIANGLE),
        S::Execute | S::Starting | S::Unholding | S::Unsuspending | S::Completing => ("runs", PLAY),
        S::Held | S::Holding | S::Suspending | S::Suspended => ("held", PAUSE),
        _ => ("still", SQUARE),
    }
}

/// Returns true if the cell waits for a person.
fn asks_person(next: &NextStep) -> bool {
    matches!(next, NextStep::Load | NextStep::SeeClear { .. } | NextStep::AtMachine { .. } | NextStep::Bring { .. })
}

/// Steps of a cycle, in their order. A part is loaded before the first cycle.
const STEPS: [Text; 6] =
    [Text::LoadStep, Text::GrindStep, Text::MeasureStep, Text::RegisterStep, Text::JudgeStep, Text::CorrectStep];

/// Returns the index in [`STEPS`] of a phase.
fn step_of(phase: Phase) -> usize {
    match phase {
        Phase::Load => 0,
        Phase::Grind(_) => 1,
        Phase::Transfer | Phase::Measure(_) => 2,
        Phase::Register => 3,
        Phase::Judge => 4,
        Phase::Compensate => 5,
    }
}

/// Returns the HTML of the steps of a cycle: those that are done, the present one with its progress, and those that
/// follow. The steps keep their places in every state. If the program of the run does not answer, or if the run has
/// ended, no step is the present one.
fn steps(seen: &ObservedRun, language: Language) -> Markup {
    let live = seen.snapshot.as_deref().filter(|live| seen.answers && !is_over(live.state));
    let now = live.and_then(|live| live.phase).map(step_of);
    // A cycle that begins with a measurement has no pass.
    let is_ground = live.is_some_and(|live| seen.summary.pass_cycle == Some(live.cycle));
    let is_judged = matches!(seen.summary.result, RunResult::Accepted | RunResult::NotAccepted);
    let class = |k: usize| match now {
        Some(now) if k == now => "now",
        Some(now) if k < now && (k != 1 || is_ground) => "done",
        None if is_judged && k <= step_of(Phase::Judge) => "done",
        _ => "",
    };
    html! {
        ol .steps {
            @for (k, name) in STEPS.into_iter().enumerate() {
                li class=(class(k)) aria-current=[(now == Some(k)).then_some("step")] {
                    @let progress = live.and_then(|live| live.progress).filter(|_| now == Some(k));
                    (step_bar(progress, class(k)))
                    span .name { (name.to(language)) }
                    @if let Some(progress) = progress { " " span .detail { (progress_text(progress, language)) } }
                }
            }
        }
        @if let Some(PreviewStatistics { touch_count, rms_um, min_um, max_um }) = live.and_then(|live| live.preview) {
            @let um = |value: f64| decimal(value, 2, language);
            p .preview title=(Text::PreliminaryMeans.to(language)) {
                (Text::PreliminaryPoints.to(language)) ": " (touch_count) " " (Text::Touched.to(language))
                " · RMS " (um(rms_um)) " µm · " (um(min_um)) " … " (um(max_um)) " µm"
            }
        }
    }
}

/// Returns the bar of one step. A step without a job has a full or an empty bar.
fn step_bar(progress: Option<JobProgress>, class: &str) -> Markup {
    match progress {
        Some(JobProgress { device, done, total, .. }) => {
            html! { progress max=(total.max(1)) value=(done) aria-label=(device) {} }
        }
        None => html! { progress max="1" value=(u8::from(class == "done")) aria-hidden="true" {} },
    }
}

fn progress_text(JobProgress { device, done, total, .. }: JobProgress, language: Language) -> String {
    let percent = decimal(100.0 * f64::from(done.min(total)) / f64::from(total.max(1)), 0, language);
    if device == Device::Cmm { format!("{percent} % · {done}/{total}") } else { format!("{percent} %") }
}

/// Returns the HTML of a time of the record, such as `2026-03-01T12:00:00.5Z`. A browser shows it in its own time zone;
/// without scripts it reads `2026-03-01 12:00:00 UTC`.
pub(super) fn when(utc: &str) -> Markup {
    let second: String = utc.chars().take(19).collect();
    html! { @if !second.is_empty() { time datetime=(utc) { (second.replacen('T', " ", 1)) " UTC" } } }
}

/// Returns the HTML that tells a person what to do next, with the buttons for this. If the program of the run no longer
/// answers, there are no buttons. Then the text says to read the report if the run has ended, and otherwise to go to
/// the machines.
fn next(seen: &ObservedRun, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let Some(live) = seen.snapshot.as_deref().filter(|_| seen.answers) else {
        if seen.is_lost() {
            let gone = if seen.summary.machines_within { Text::SimulationGone } else { Text::ProgramGone };
            return html! { @if !seen.summary.run.is_empty() { p .sentence .called { (say(gone)) } } };
        }
        let report = format!("/runs/{}/report", in_path(&seen.summary.run));
        return html! {
            p .sentence .called { (say(Text::ReadReport)) " " a href=(report) { (say(Text::Report)) } }
            p .quiet { (verdict_reason(&seen.summary)) }
        };
    };
    if let (NextStep::AtMachine { device }, Some(step)) = (&live.next_step, &live.operator_step) {
        let run = format!("/runs/{}", in_path(&seen.summary.run));
        return html! {
            (operator_step::card(step, *device, &run, language))
            (waits(live, language))
        };
    }
    let (sentence, device) = texts::next(&live.next_step, language);
    let is_called = live.next_step != NextStep::Nothing;
    html! {
        (held_by(seen, live, language))
        p .sentence .called[is_called] { (sentence) @if let Some(device) = device { " " strong { (device) } } }
        (next_buttons(&live.next_step, device, language))
        @if let Some(phase) = live.phase.filter(|_| live.state == StateName::Held) {
            @let (first, device) = texts::on_resume(phase);
            p .first { (say(Text::FirstThing)) " " @if let Some(device) = device { (device) ": " } (say(first)) }
        }
        (waits(live, language))
    }
}

/// Returns the HTML of the buttons with which a person confirms the next action.
fn next_buttons(next: &NextStep, device: Option<Device>, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let named = device.map(|device| device.to_string().to_lowercase()).unwrap_or_default();
    html! {
        @match next {
            NextStep::Load => { button type="button" data-order="loaded" { (say(Text::Loaded)) } }
            NextStep::SeeClear { device } => {
                button type="button" data-order="clear" data-device=(named) { (device) " " (say(Text::IsClear)) }
            }
            NextStep::SeeWhetherItStands { .. } => {
                label { (say(Text::WhatYouSaw)) input id="evidence" type="text" maxlength="300" autocomplete="off"; }
                button type="button" data-order="over" data-device=(named) { (say(Text::DeclareOver)) }
            }
            _ => {}
        }
    }
}

/// Returns the HTML that tells who ordered the hold, when and why. It is empty if the cell is not held, or if no person
/// ordered the hold.
fn held_by(seen: &ObservedRun, live: &Snapshot, language: Language) -> Markup {
    let is_held = matches!(live.state, StateName::Holding | StateName::Held);
    html! {
        @if let Some(hold) = seen.summary.hold.as_ref().filter(|_| is_held) {
            p .quiet {
                (Text::HeldBy.to(language)) " " strong { (hold.by) } ", " (when(&hold.at))
                @if !hold.reason.is_empty() { ": " (hold.reason) }
            }
            @if lacks_reason(seen, live) {
                div .reason {
                    label { (Text::ReasonOfHold.to(language)) " " input id="hold-reason" type="text" maxlength="300" autocomplete="off"; }
                    button type="button" data-order="reason" { (Text::StateReason.to(language)) }
                }
            }
        }
    }
}

/// Returns true if a person ordered the hold and has not stated the reason.
pub(super) fn lacks_reason(seen: &ObservedRun, live: &Snapshot) -> bool {
    let is_held = matches!(live.state, StateName::Holding | StateName::Held);
    is_held && seen.summary.hold.as_ref().is_some_and(|hold| hold.reason.is_empty())
}

/// Returns the HTML of what the machine of the current job waits for.
fn waits(live: &Snapshot, language: Language) -> Markup {
    html! { @for waits in &live.waits_for { p .quiet { (Text::Waits.to(language)) ": " (waits) } } }
}

/// Formats a range of durations as text, such as `5 – 8 min`. The input is the minimum and the maximum in seconds. The
/// maximum decides the unit: seconds below 90 s, minutes below 90 min, otherwise hours. If both numbers look the same,
/// the text contains only one.
fn range([least, most]: [f64; 2], language: Language) -> String {
    let (unit, per) = match most {
        most if most < 90.0 => ("s", 1.0),
        most if most < 5400.0 => ("min", 60.0),
        _ => ("h", 3600.0),
    };
    let digits = usize::from(unit == "h");
    let [least, most] = [least, most].map(|seconds| decimal(seconds / per, digits, language));
    if least == most { format!("{most} {unit}") } else { format!("{least} – {most} {unit}") }
}

/// Returns the HTML of the alarms of a run. `seen` is the current status of the run. While the run is active and its
/// program answers, the result contains the active alarms. Otherwise it contains all alarms on record, with the times
/// at which they were raised and withdrawn.
fn alarms(seen: &ObservedRun, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    if let Some(live) = seen.snapshot.as_deref().filter(|live| seen.answers && !is_over(live.state)) {
        return html! {
            @if live.alarms.is_empty() { p .quiet { (say(Text::NoAlarm)) } }
            @for alarm in &live.alarms { (standing(alarm, acknowledged(&seen.summary, alarm), true, language)) }
        };
    }
    let told = &seen.summary.alarms;
    html! {
        @if told.is_empty() && !seen.summary.run.is_empty() { p .quiet { (say(Text::NoAlarmRaised)) } }
        @for AlarmHistory { alarm, raised, withdrawn, acknowledged } in told {
            @if withdrawn.is_none() && seen.is_lost() {
                (standing(alarm, acknowledged.as_ref(), false, language))
            } @else {
                article .alarm .past {
                    h3 { (alarm_texts(alarm, language).event) }
                    p .quiet {
                        (say(Text::Raised)) " " (when(raised)) ", "
                        @match withdrawn {
                            Some(withdrawn) => { (say(Text::Withdrawn)) " " (when(withdrawn)) }
                            None => { (say(Text::StoodAtTheEnd)) }
                        }
                    }
                    (acknowledgement(acknowledged.as_ref(), language))
                }
            }
        }
    }
}

/// Returns the acknowledgement of the active alarm `alarm`, if a person has acknowledged it.
fn acknowledged<'s>(summary: &'s RunSummary, alarm: &Alarm) -> Option<&'s AlarmAcknowledgement> {
    let active = summary.alarms.iter().rev().find(|told| told.alarm.id == alarm.id && told.withdrawn.is_none());
    active.and_then(|told| told.acknowledged.as_ref())
}

/// Returns the HTML that names who has acknowledged an alarm, and when. It is empty if nobody has.
fn acknowledgement(acknowledged: Option<&AlarmAcknowledgement>, language: Language) -> Markup {
    html! {
        @if let Some(AlarmAcknowledgement { by, at, remark }) = acknowledged {
            p .quiet { (Text::SeenBy.to(language)) " " (by) ", " (when(at)) @if !remark.is_empty() { ": " (remark) } }
        }
    }
}

/// Returns the HTML of the active alarm `alarm`: its cause, its consequence, its remedy, who can clear it, and who has
/// acknowledged it. `can_acknowledge` is true if a person can acknowledge it now.
fn standing(
    alarm: &Alarm,
    acknowledged: Option<&AlarmAcknowledgement>,
    can_acknowledge: bool,
    language: Language,
) -> Markup {
    let (say, said) = (|text: Text| text.to(language), alarm_texts(alarm, language));
    html! {
        article .alarm {
            h3 { (said.event) }
            p { (said.consequence) }
            p .quiet { (say(Text::WhatToDo)) ":" }
            ol { @for remedy in &said.remedy { li { (remedy) } } }
            p .quiet { (say(Text::ClearedBy)) ": " (say(match alarm.cleared_by {
                Role::Nobody => Text::ByItself,
                Role::Operator => Text::ByOperator,
                _ => Text::ByEngineer,
            })) }
            (acknowledgement(acknowledged, language))
            @if can_acknowledge && acknowledged.is_none() {
                @let id = serde_json::to_value(alarm.id).unwrap_or_default();
                button type="button" data-order="remark" data-alarm=[id.as_str()] { (say(Text::SeenAlarm)) }
            }
        }
    }
}

/// Returns the decision on a cycle in words; the reason why there is none, if it was not judged.
fn decision(of: &CycleSummary, language: Language) -> String {
    of.verdict.map_or_else(|| of.reason.clone(), |verdict| verdict_in_words(verdict, language))
}

/// Returns the HTML of the last judged figures: PV and RMS, each as a number with its uncertainty and its limit, and as
/// a bar that shows all three. If nothing was measured, returns a sentence.
fn judged(cycles: &[CycleSummary], tolerance: Option<&Tolerance>, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let last = cycles.iter().rev().find_map(|of| Some((of, of.figures?)));
    let Some((of, [pv_um, rms_um])) = last else { return html! { p .quiet { (say(Text::NotMeasured)) } } };
    let limits_um = tolerance.map(|tolerance| [tolerance.pv_mm, tolerance.rms_mm].map(|mm| 1e3 * mm));
    let limit_um = |k: usize| limits_um.map(|limits| limits[k]).filter(|limit| limit.is_finite());
    html! {
        p .verdict {
            (say(Text::Cycle)) " " (of.cycle) ": "
            strong title=(of.reason) { (decision(of, language)) }
        }
        (gauge("PV", pv_um, limit_um(0), 2, language))
        (gauge("RMS", rms_um, limit_um(1), 3, language))
        p .quiet { (say(Text::UncertaintyOfGauge)) }
    }
}

/// Returns the HTML table of the measured form errors. Each cycle has one row with its PV and RMS, their uncertainties
/// U (all in micrometres), and its verdict. A cycle without a measurement shows dashes. If `tolerance` is given, one
/// more row contains the limits.
pub(super) fn figures(cycles: &[CycleSummary], tolerance: Option<&Tolerance>, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let um = |value: f64, digits: usize| decimal(value, digits, language);
    let limit = |mm: f64| if mm.is_finite() { um(1e3 * mm, 2) } else { "–".to_owned() };
    html! {
        table {
            tr {
                th .n { (say(Text::Cycle)) }
                th .n { "PV, µm" } th .n { "± U" } th .n { "RMS, µm" } th .n { "± U" } th { (say(Text::Judged)) }
            }
            @for of in cycles {
                tr {
                    td .n { (of.cycle) }
                    @match of.figures {
                        Some([[pv, pv_u], [rms, rms_u]]) => {
                            td .n { strong { (um(pv, 2)) } } td .n { (um(pv_u, 2)) }
                            td .n { strong { (um(rms, 3)) } } td .n { (um(rms_u, 3)) }
                        }
                        None => { @for _ in 0..4 { td .n { "–" } } }
                    }
                    td title=(of.reason) { (decision(of, language)) }
                }
            }
            @if let Some(tolerance) = tolerance {
                tr .limit {
                    td .n { (say(Text::Limit)) }
                    td .n { (limit(tolerance.pv_mm)) } td {} td .n { (limit(tolerance.rms_mm)) } td {} td {}
                }
            }
        }
        @for (cycle, places) in cycles.iter().filter_map(|of| Some((of.cycle, of.left_out.as_ref()?))) {
            p { strong { (say(Text::LeftOut)) ", " (say(Text::Cycle)) " " (cycle) ": " } (places) }
        }
        p .quiet { "U: " (say(Text::Uncertainty)) }
    }
}

/// Returns the HTML of the facts about a run: times, people, machines, and the link to its report.
pub(super) fn about(seen: &ObservedRun, language: Language) -> Markup {
    let RunSummary { run, part, name, recipe, operator, began, ended, .. } = &*seen.summary;
    let say = |text: Text| text.to(language);
    html! {
        dl {
            dt { (say(Text::Part)) } dd { strong { (part) } " " (name) }
            dt { (say(Text::Recipe)) } dd { (recipe) }
            dt { (say(Text::Operator)) } dd { (operator) }
            dt { (say(Text::Began)) } dd { (when(began)) }
            @if let Some(ended) = ended { dt { (say(Text::Ended)) } dd { (when(ended)) } }
            @for (device, machine) in Device::BOTH.into_iter().zip(&seen.summary.machines) {
                @if let Some(machine) = machine { dt { (device) } dd { (machine) } }
            }
            dt { (say(Text::Run)) } dd .id { (run) }
        }
    }
}

fn control(is_elsewhere: bool, language: Language) -> Markup {
    html! {
        @if is_elsewhere {
            span { (Text::ControlElsewhere.to(language)) }
            button type="button" data-order="control" { (Text::TakeControl.to(language)) }
        }
    }
}

/// Percent-encodes the name of a run for use in a URL, because a folder can have any name.
pub(super) fn in_path(run: &str) -> String {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-._~".contains(&byte);
    run.bytes().map(|byte| if is_plain(byte) { char::from(byte).to_string() } else { format!("%{byte:02X}") }).collect()
}
