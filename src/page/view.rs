//! Pages as HTML, in the language of the reader. Only this module makes the pieces of a run's page, both for the first
//! response and for each later change.

use axum::Extension;
use axum::extract::{Path, Query, State};
use axum::http::header::{ACCEPT_LANGUAGE, CONTENT_TYPE, COOKIE};
use axum::http::{HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Redirect, Response};
use data_encoding::HEXLOWER;
use maud::{DOCTYPE, Markup, html};
use regrind_cell::{Alarm, Device, Role, StateName, Tolerance};
use regrind_control::{JobProgress, NextStep, PreviewStatistics, Snapshot};
use regrind_formats::operator_step::StepConfirmation;
use regrind_formats::run_files::RunFile;
use regrind_report::{AlarmHistory, ColourMap, CycleSummary, RunResult, RunSummary};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::task::spawn_blocking;

use super::alarms::alarm_texts;
use super::chart::chart;
use super::guard::{Denied, Session, text};
use super::history::Listed;
use super::live::{ObservedRun, verdict};
use super::operator_step;
use super::shared::Shared;
use super::subject::PageSubject;
use super::texts::{self, Language, Text};
use super::users::Person;

/// Piece of the page of a run, which is updated on its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Piece {
    Banner,
    About,
    Next,
    Job,
    Alarms,
    Figures,
    Convergence,
    Control,
}

impl Piece {
    /// Returns the id of the HTML element that contains the piece.
    pub(crate) fn id(self) -> &'static str {
        match self {
            Self::Banner => "banner",
            Self::About => "about",
            Self::Next => "next",
            Self::Job => "job",
            Self::Alarms => "alarms",
            Self::Figures => "figures",
            Self::Convergence => "convergence",
            Self::Control => "control",
        }
    }
}

/// Returns the HTML of each piece of the page of a run. A piece is a part of the page that is updated on its own.
/// `seen` is the current status of the run. If `has_control` is false and the program of the run answers, one piece
/// offers to take control of the cell.
pub(crate) fn pieces(seen: &ObservedRun, has_control: bool, language: Language) -> [(Piece, String); 8] {
    let ObservedRun { snapshot, summary, .. } = seen;
    let snapshot = snapshot.as_deref();
    let live = snapshot.filter(|_| seen.answers);
    let tolerance = summary.tolerance.as_ref();
    [
        (Piece::Banner, banner(seen, language)),
        (Piece::About, about(seen, language)),
        (Piece::Next, next(seen, language)),
        (Piece::Job, live.map_or_else(Markup::default, |snapshot| job(snapshot, language))),
        (Piece::Alarms, alarms(seen, language)),
        (Piece::Figures, figures(&summary.cycles, tolerance, language)),
        (Piece::Convergence, chart(&summary.cycles, tolerance, live.is_some(), language)),
        (Piece::Control, control(live.is_some() && !has_control, language)),
    ]
    .map(|(piece, markup)| (piece, markup.into_string()))
}

/// Returns the state of a run as JSON for the scripts of the page. `seen` is the current status of the run. `session`
/// decides which orders are allowed. `has_control` is true if the browser has control of the cell, or if no browser has
/// control.
pub(crate) fn state(seen: &ObservedRun, session: &Session, has_control: bool) -> Value {
    let live = seen.snapshot.as_deref().filter(|_| seen.answers);
    let cycles: Vec<_> = seen
        .summary
        .cycles
        .iter()
        .map(|of| {
            json!({
                "cycle": of.cycle, "map": of.map, "points": of.deviations,
            })
        })
        .collect();
    let progress = live.and_then(|live| live.progress);
    let measures = progress.filter(|progress| progress.device == Device::Cmm);
    json!({
        "answers": seen.answers,
        "lost": seen.is_lost(),
        "last": seen.summary.last,
        "machinesWithin": seen.summary.machines_within,
        "over": seen.summary.ended.is_some() && !seen.answers,
        "number": live.map(|live| live.state_number),
        "can": live.map_or_else(Vec::new, |live| can(live, session, has_control)),
        "cycle": live.map(|live| live.cycle),
        "cycles": cycles,
        "touched": measures.map(|progress| [progress.done, progress.total]),
        "alarms": live.map_or(0, |live| live.alarms.len()),
        "verdict": verdict(seen),
    })
}

/// Returns the names of the orders that the browser can give now, such as `hold`. `live` is the current state of the
/// cell, and the role of the person of `session` limits the orders. `has_control` is true if the browser has control of
/// the cell, or if no browser has control. Without control, only `hold`, `stop` and `abort` are possible.
fn can(live: &Snapshot, session: &Session, has_control: bool) -> Vec<&'static str> {
    let mut can = vec!["hold", "stop", "abort"];
    if is_over(live.state) {
        can.clear();
    }
    if has_control && live.state == StateName::Held {
        can.push("resume");
    }
    match live.next_step {
        NextStep::Load if has_control => can.push("loaded"),
        NextStep::SeeClear { .. } if has_control => can.push("clear"),
        NextStep::SeeWhetherItStands { .. } if has_control => can.push("over"),
        NextStep::AtMachine { .. } if has_control => {
            let confirmation = live.operator_step.as_ref().and_then(|step| step.confirmation);
            can.extend(confirmation.map(|confirmation| match confirmation {
                StepConfirmation::Started => "started",
                StepConfirmation::Done => "done",
                StepConfirmation::DoneWithFile => "measurement",
                StepConfirmation::Still => "still",
            }));
        }
        _ => {}
    }
    can.retain(|order| session.may(order));
    can
}

fn is_over(state: StateName) -> bool {
    matches!(state, StateName::Stopped | StateName::Aborted | StateName::Complete)
}

/// Returns the HTML of the banner of a run. The banner shows one word with a shape and a colour, and can be read from a
/// distance of two metres. `seen` is the current status of the run. The word is the state of the cell while the run is
/// active, and the result of the run afterwards. If the run has no end and its program does not answer, the word is
/// "?".
fn banner(seen: &ObservedRun, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let mark = |class: &str, shape: &str, word: &str, more: &str| {
        html! {
            div .banner .(class) {
                svg .shape viewBox="0 0 24 24" aria-hidden="true" { path d=(shape) {} }
                div { strong { (word) } @if !more.is_empty() { span .more { (more) } } }
                @if seen.summary.simulation { span .simulation { (say(Text::Simulation)) } }
            }
        }
    };
    let live = seen.snapshot.as_deref().filter(|live| seen.answers && !is_over(live.state));
    if let Some(live) = live {
        let phase = live.phase.map_or(String::new(), |phase| say(texts::phase(phase)).to_owned());
        let not_confirmed = live.unconfirmed.iter().map(|device| format!("{device}?")).collect::<Vec<_>>().join(" ");
        let cycle = match live.cycle {
            0 => String::new(),
            cycle => format!("{} {cycle} {} {}", say(Text::Cycle), say(Text::OfAtMost), live.max_cycles),
        };
        let more =
            [phase, cycle, not_confirmed].into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join(" · ");
        let (class, shape) = state_symbol(live);
        return mark(class, shape, say(texts::state(live.state)), &more);
    }
    if seen.is_lost() && !seen.summary.run.is_empty() {
        let gone = if seen.summary.machines_within { Text::SimulationGone } else { Text::ProgramGone };
        return mark("lost", UNKNOWN, "?", say(gone));
    }
    let result = seen.summary.result;
    let (class, shape) = match result {
        RunResult::Accepted => ("good", TICK),
        RunResult::Aborted => ("bad", OCTAGON),
        RunResult::Open | RunResult::Recovery => ("still", SQUARE),
        _ => ("bad", CROSS),
    };
    // The text of the record begins with the same word.
    let verdict = &seen.summary.verdict;
    let reason = verdict.split_once(": ").filter(|(word, _)| word.chars().all(|c| !c.is_lowercase()));
    mark(class, shape, say(texts::result(result)), reason.map_or(verdict, |(_, reason)| reason))
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
        S::Execute
            if matches!(
                live.next_step,
                NextStep::Load | NextStep::SeeClear { .. } | NextStep::AtMachine { .. } | NextStep::Bring { .. }
            ) =>
        {
            ("asks", TRIANGLE)
        }
        S::Execute | S::Starting | S::Unholding | S::Unsuspending | S::Completing => ("runs", PLAY),
        S::Held | S::Holding | S::Suspending | S::Suspended => ("held", PAUSE),
        _ => ("still", SQUARE),
    }
}

fn about(seen: &ObservedRun, language: Language) -> Markup {
    let RunSummary { run, part, name, recipe, operator, began, ended, .. } = &*seen.summary;
    let say = |text: Text| text.to(language);
    html! {
        dl {
            dt { (say(Text::Part)) } dd { strong { (part) } " " (name) }
            dt { (say(Text::Recipe)) } dd { (recipe) }
            dt { (say(Text::Operator)) } dd { (operator) }
            dt { (say(Text::Began)) } dd { (when(began)) }
            @if let Some(ended) = ended { dt { (say(Text::Ended)) } dd { (when(ended)) } }
            dt { (say(Text::Run)) } dd .id { (run) }
        }
    }
}

/// Returns a time of the record, such as `2026-03-01T12:00:00.5Z`, as `2026-03-01 12:00:00 UTC`.
fn when(utc: &str) -> String {
    let second: String = utc.chars().take(19).collect();
    if second.is_empty() { second } else { format!("{} UTC", second.replacen('T', " ", 1)) }
}

/// Returns the HTML that tells a person what to do next, with the buttons for this. If the program of the run no longer
/// answers, there are no buttons. Then the text says to read the report if the run has ended, and otherwise the HTML is
/// empty.
fn next(seen: &ObservedRun, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let Some(live) = seen.snapshot.as_deref().filter(|_| seen.answers) else {
        // For a lost run the banner already says what to do.
        return html! { @if !seen.is_lost() { p .sentence { (say(Text::ReadReport)) } } };
    };
    if let (NextStep::AtMachine { device }, Some(step)) = (&live.next_step, &live.operator_step) {
        let run = format!("/runs/{}", in_path(&seen.summary.run));
        return html! {
            (operator_step::card(step, *device, &run, language))
            (waits(live, language))
        };
    }
    let (sentence, device) = texts::next(&live.next_step, language);
    let named = device.map(|device| device.to_string().to_lowercase());
    html! {
        p .sentence { (sentence) @if let Some(device) = device { " " strong { (device) } } }
        @match &live.next_step {
            NextStep::Load => { button type="button" data-order="loaded" { (say(Text::Loaded)) } }
            NextStep::SeeClear { device } => {
                button type="button" data-order="clear" data-device=(named.unwrap_or_default()) { (device) " " (say(Text::IsClear)) }
            }
            NextStep::SeeWhetherItStands { .. } => {
                label { (say(Text::WhatYouSaw)) input id="evidence" type="text" maxlength="300" autocomplete="off"; }
                button type="button" data-order="over" data-device=(named.unwrap_or_default()) { (say(Text::DeclareOver)) }
            }
            _ => {}
        }
        @if let Some(phase) = live.phase.filter(|_| live.state == StateName::Held) {
            @let (first, device) = texts::on_resume(phase);
            p .first { (say(Text::FirstThing)) " " @if let Some(device) = device { (device) ": " } (say(first)) }
        }
        (waits(live, language))
    }
}

/// Returns the HTML of what the machine of the current job waits for.
fn waits(live: &Snapshot, language: Language) -> Markup {
    html! { @for waits in &live.waits_for { p .quiet { (Text::Waits.to(language)) ": " (waits) } } }
}

/// Returns the HTML of the progress of the current job (work of one machine, such as grinding or measuring). The HTML
/// is empty if no job runs.
fn job(live: &Snapshot, language: Language) -> Markup {
    let Some(JobProgress { device, done, total, remaining_s }) = live.progress else {
        return Markup::default();
    };
    let percent = 100.0 * f64::from(done.min(total)) / f64::from(total.max(1));
    let unit = if device == Device::Cmm { format!(" {done}/{total}") } else { String::new() };
    html! {
        p .phase {
            span { (device) " " (live.phase.map_or("", |phase| texts::phase(phase).to(language))) (unit) }
            strong { (format!("{percent:.0} %")) }
            @if let Some(left) = remaining_s { span .left { (range(left)) " " (Text::TimeLeft.to(language)) } }
        }
        progress max=(total.max(1)) value=(done) aria-label=(device) {}
        @if let Some(PreviewStatistics { touch_count, rms_um, min_um, max_um }) = live.preview {
            p .quiet title=(Text::PreliminaryMeans.to(language)) {
                (Text::PreliminaryPoints.to(language)) ": " (touch_count) " " (Text::Touched.to(language))
                (format!(", RMS {rms_um:.2} µm, min {min_um:+.2} µm, max {max_um:+.2} µm"))
            }
        }
    }
}

/// Formats a range of durations as text, such as `5 – 8 min`. The input is the minimum and the maximum in seconds. The
/// maximum decides the unit: seconds below 90 s, minutes below 90 min, otherwise hours. If both numbers look the same,
/// the text contains only one.
fn range([least, most]: [f64; 2]) -> String {
    let (unit, per) = match most {
        most if most < 90.0 => ("s", 1.0),
        most if most < 5400.0 => ("min", 60.0),
        _ => ("h", 3600.0),
    };
    let digits = usize::from(unit == "h");
    let [least, most] = [least, most].map(|seconds| format!("{:.digits$}", seconds / per));
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
            @for alarm in &live.alarms { (standing(alarm, language)) }
        };
    }
    let told = &seen.summary.alarms;
    html! {
        @if told.is_empty() && !seen.summary.run.is_empty() { p .quiet { (say(Text::NoAlarmRaised)) } }
        @for AlarmHistory { alarm, raised, withdrawn } in told {
            @if withdrawn.is_none() && seen.is_lost() {
                (standing(alarm, language))
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
                }
            }
        }
    }
}

/// Returns the HTML of the active alarm `alarm`: its cause, its consequence, its remedy, and who can clear it.
fn standing(alarm: &Alarm, language: Language) -> Markup {
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
        }
    }
}

/// Returns the HTML table of the measured form errors. Each cycle has one row with its PV and RMS, their uncertainties
/// U (all in micrometres), and its verdict. A cycle without a measurement shows dashes. If `tolerance` is given, one
/// more row contains the limits.
fn figures(cycles: &[CycleSummary], tolerance: Option<&Tolerance>, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let limit = |mm: f64| if mm.is_finite() { format!("{:.2}", 1e3 * mm) } else { "–".to_owned() };
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
                            td .n { strong { (format!("{pv:.2}")) } } td .n { (format!("{pv_u:.2}")) }
                            td .n { strong { (format!("{rms:.3}")) } } td .n { (format!("{rms_u:.3}")) }
                        }
                        None => { @for _ in 0..4 { td .n { "–" } } }
                    }
                    td title=(of.reason) { (of.verdict.as_deref().unwrap_or(&of.reason)) }
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

fn control(is_elsewhere: bool, language: Language) -> Markup {
    html! {
        @if is_elsewhere {
            p { (Text::ControlElsewhere.to(language)) }
            button type="button" data-order="control" { (Text::TakeControl.to(language)) }
        }
    }
}

/// Percent-encodes the name of a run for use in a URL, because a folder can have any name.
fn in_path(run: &str) -> String {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-._~".contains(&byte);
    run.bytes().map(|byte| if is_plain(byte) { char::from(byte).to_string() } else { format!("%{byte:02X}") }).collect()
}

/// Serves the page of the active run, or of the last run if none is active.
pub(crate) async fn home(State(page): State<Shared>) -> Response {
    let history = std::sync::Arc::clone(&page.history);
    let listed = spawn_blocking(move || history.list()).await.unwrap_or_default();
    let live = listed.iter().filter(|run| run.is_live).count();
    match listed.first().filter(|_| live <= 1) {
        Some(first) => Redirect::to(&format!("/runs/{}", in_path(&first.id))).into_response(),
        None => Redirect::to("/runs").into_response(),
    }
}

pub(crate) async fn run(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Response {
    let language = language(&headers);
    let Some(folder) = page.history.folder(&id) else { return not_here(PageSubject::Cell, &headers) };
    let mut looked = page.run_watcher.subscribe(&folder);
    let known = looked.borrow().summary.run.is_empty();
    if known {
        // An active run reports its status at once. For a run that has ended, the record contains it.
        drop(tokio::time::timeout(std::time::Duration::from_secs(2), looked.changed()).await);
    }
    let seen = looked.borrow().clone();
    let has_control = page.guard.has_control(&session, false);
    let main = cell(&seen, &id, &session, has_control, language);
    let title = format!("{} {}", seen.summary.part, seen.summary.name);
    document(&title, &Frame { language, person: session.person.as_ref(), kind: Kind::WithMaps }, main)
}

/// Returns the HTML of the page of the run named `id`. While the run is active, the page shows the cell and its
/// controls. Afterwards it shows the result. `seen` is the current status of the run. `has_control` is true if the
/// browser has control of the cell, or if no browser has control.
fn cell(seen: &ObservedRun, id: &str, session: &Session, has_control: bool, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let made = pieces(seen, has_control || !session.may("control"), language);
    let piece = |piece: Piece| {
        let html = made.iter().find(|(made, _)| *made == piece).map_or("", |(_, html)| html);
        maud::PreEscaped(html.to_owned())
    };
    let state = state(seen, session, has_control);
    let data = json!({ "run": id, "state": state, "colours": colours(ColourMap::Diverging), "unsigned": colours(ColourMap::Sequential), "texts": script_texts(language) });
    html! {
        a .skip href="#orders" { (say(Text::SkipToOrders)) }
        div #old role="alert" hidden {}
        section #banner aria-live="polite" { (piece(Piece::Banner)) }
        main .cell data-run=(id) {
            section #next aria-live="polite" aria-label=(say(Text::NextAction)) { (piece(Piece::Next)) }
            section #job aria-label=(say(Text::TimeLeft)) { (piece(Piece::Job)) }
            section .map aria-label=(say(Text::Map)) { (map(language)) }
            section .side {
                h2 { (say(Text::Alarms)) }
                div #alarms aria-live="assertive" { (piece(Piece::Alarms)) }
                h2 { (say(Text::Convergence)) }
                div #convergence { (piece(Piece::Convergence)) }
                h2 { (say(Text::Figures)) }
                div #figures { (piece(Piece::Figures)) }
                div #about { (piece(Piece::About)) }
                p { a href=(format!("/runs/{}/report", in_path(id))) { (say(Text::Report)) } }
            }
        }
        section #orders .orders {
            button .hold type="button" data-order="hold" disabled { (say(Text::Hold)) }
            button .resume type="button" data-order="resume" disabled { (say(Text::Resume)) }
            button .stop type="button" data-order="stop" disabled { (say(Text::Stop)) }
            div #control { (piece(Piece::Control)) }
            p #answer role="status" { (say(Text::NoButtonStops)) }
            button .abort type="button" data-order="abort" disabled { (say(Text::Abort)) }
        }
        script #data type="application/json" { (maud::PreEscaped(harmless(&data))) }
    }
}

/// Returns `data` as JSON that is safe within an HTML script element: it contains no `<`.
fn harmless(data: &Value) -> String {
    data.to_string().replace('<', "\\u003c")
}

fn map(language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    html! {
        div .tools role="group" {
            button type="button" data-view="map" aria-pressed="true" { (say(Text::Map)) }
            button type="button" data-view="difference" aria-pressed="false" { (say(Text::Difference)) }
            button type="button" data-view="sigma" aria-pressed="false" { (say(Text::Sigma)) }
            button type="button" data-view="relief" aria-pressed="false" { (say(Text::Relief)) }
            button type="button" data-points aria-pressed="false" { (say(Text::Points)) }
            label { (say(Text::Cycle)) " " select #cycle {} }
        }
        canvas #map tabindex="0" role="img" aria-label=(say(Text::MapHelp)) {}
        canvas #relief tabindex="0" role="img" aria-label=(say(Text::MapHelp)) hidden {}
        output #reading {}
        canvas #histogram role="img" aria-label=(say(Text::Histogram)) {}
    }
}

/// Returns, as JSON, the texts in `language` that the scripts show.
fn script_texts(language: Language) -> Value {
    let say = |text: Text| text.to(language);
    json!({
        "noData": say(Text::NotConnected), "pageGone": say(Text::PageGone), "programGone": say(Text::ProgramGone), "simulationGone": say(Text::SimulationGone),
        "noRelief": say(Text::NoRelief), "notMeasured": say(Text::NotMeasured), "planned": say(Text::Planned),
        "touched": say(Text::Touched), "filtered": say(Text::Filtered), "known": say(Text::KnownTo), "order": say(Text::NoButtonStops),
    })
}

/// Returns the 255 colours of a colour map, from the lowest value to the highest, as hexadecimal digits: three bytes
/// (red, green, blue) for each.
fn colours(of: ColourMap) -> String {
    let colour = |k: u32| of.at(f64::from(k) / 254.0);
    HEXLOWER.encode(&(0..255).flat_map(colour).collect::<Vec<u8>>())
}

/// Filter for a list of runs. An empty field matches all runs.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(crate) struct RunFilter {
    part: String,
    recipe: String,
    result: String,
    /// First and last day of the start of the run, `2026-07-04`, in UTC.
    since: String,
    until: String,
}

impl RunFilter {
    fn fits(&self, run: &Listed) -> bool {
        let has = |value: &str, wanted: &str| {
            wanted.is_empty() || value.to_lowercase().contains(&wanted.trim().to_lowercase())
        };
        let result = self.result.is_empty() || self.result == run.summary.result.name();
        let day = run.summary.began.get(..10).unwrap_or_default();
        let in_time =
            (self.since.is_empty() || day >= self.since.trim()) && (self.until.is_empty() || day <= self.until.trim());
        has(&run.summary.part, &self.part) && has(&run.summary.recipe, &self.recipe) && result && in_time
    }
}

/// Serves the page with the list of runs. `wanted` is the filter from the address: only runs that match the filter are
/// listed, and an empty field of the filter matches all runs. `session` contains the person who has signed in, and
/// `headers` determine the language.
pub(crate) async fn runs(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Query(wanted): Query<RunFilter>,
    headers: HeaderMap,
) -> Response {
    let language = language(&headers);
    let say = |text: Text| text.to(language);
    let history = std::sync::Arc::clone(&page.history);
    let listed = spawn_blocking(move || history.list()).await.unwrap_or_default();
    const RESULTS: [RunResult; 5] =
        [RunResult::Open, RunResult::Accepted, RunResult::NotAccepted, RunResult::Stopped, RunResult::Aborted];
    let main = html! {
        main .list {
            h1 { (say(Text::Runs)) }
            form .filter method="get" action="/runs" {
                label { (say(Text::Part)) " " input name="part" value=(wanted.part); }
                label { (say(Text::Recipe)) " " input name="recipe" value=(wanted.recipe); }
                label { (say(Text::Result)) " "
                    select name="result" {
                        option value="" { (say(Text::All)) }
                        @for result in RESULTS {
                            @let name = result.name();
                            option value=(name) selected[name == wanted.result] { (say(texts::result(result))) }
                        }
                    }
                }
                label { (say(Text::Since)) " " input type="date" name="since" value=(wanted.since); }
                label { (say(Text::Until)) " " input type="date" name="until" value=(wanted.until); }
                button { (say(Text::Show)) }
            }
            form method="get" action="/compare" {
                (table_of(listed.iter().filter(|run| wanted.fits(run)), language))
                p { (say(Text::TwoSideBySide)) " " button { (say(Text::Compare)) } }
            }
        }
    };
    document(
        say(Text::Runs),
        &Frame { language, person: session.person.as_ref(), kind: Kind::Plain(PageSubject::Cell) },
        main,
    )
}

fn table_of<'a>(runs: impl Iterator<Item = &'a Listed>, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    html! {
        table {
            tr {
                th {} th { (say(Text::Run)) } th { (say(Text::Part)) } th { (say(Text::Recipe)) } th { (say(Text::Began)) }
                th .n { (say(Text::Cycle)) } th .n { "PV, µm" } th .n { "RMS, µm" } th .n { (say(Text::Alarms)) } th { (say(Text::Result)) }
            }
            @for Listed { id, is_live, summary } in runs {
                @let figures = summary.cycles.iter().rev().find_map(|of| of.figures);
                tr {
                    td { input type="checkbox" name="run" value=(id) aria-label=(id); }
                    td { a href=(format!("/runs/{}", in_path(id))) { (id) } }
                    td { (summary.part) } td { (summary.recipe) } td { (when(&summary.began)) }
                    td .n { (summary.cycles.len()) }
                    @for k in 0..2 {
                        td .n { @if let Some(figures) = figures { (format!("{:.2}", figures[k][0])) } @else { "–" } }
                    }
                    td .n { (summary.alarms.len()) }
                    td class=(if summary.result == RunResult::Accepted { "good" } else { "" }) {
                        @if *is_live { strong { (say(Text::Live)) } } @else { (say(texts::result(summary.result))) }
                    }
                }
            }
        }
    }
}

/// Serves the page with two runs side by side. The query of the address names them: `run=A&run=B`. Without two existing
/// runs, redirects to the list of runs.
pub(crate) async fn compare(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    axum::extract::RawQuery(query): axum::extract::RawQuery,
    headers: HeaderMap,
) -> Response {
    let language = language(&headers);
    let say = |text: Text| text.to(language);
    let query = query.unwrap_or_default();
    let ids: Vec<String> = query.split('&').filter_map(|pair| pair.strip_prefix("run=")).map(str::to_owned).collect();
    let history = std::sync::Arc::clone(&page.history);
    let found = spawn_blocking(move || {
        let of = |id: &String| Some((id.clone(), history.summary(&history.folder(id)?)?));
        ids.iter().filter_map(of).take(2).collect::<Vec<_>>()
    });
    let found = found.await.unwrap_or_default();
    if found.len() < 2 {
        return Redirect::to("/runs").into_response();
    }
    let main = html! {
        main .compare {
            @for (id, summary) in &found {
                @let seen = ObservedRun { summary: std::sync::Arc::clone(summary), ..ObservedRun::default() };
                @let tolerance = summary.tolerance.as_ref();
                section data-compared=(id) {
                    h2 { a href=(format!("/runs/{}", in_path(id))) { (id) } }
                    (banner(&seen, language))
                    canvas role="img" aria-label=(say(Text::Map)) {}
                    (chart(&summary.cycles, tolerance, false, language))
                    (figures(&summary.cycles, tolerance, language))
                    (about(&seen, language))
                }
            }
        }
        @let maps: Vec<_> = found.iter().map(|(id, summary)| {
            json!({ "run": id, "cycle": summary.cycles.iter().rev().find(|of| of.map.is_some()).map(|of| of.cycle) })
        }).collect();
        script #data type="application/json" {
            (maud::PreEscaped(harmless(&json!({ "compared": maps, "colours": colours(ColourMap::Diverging), "texts": script_texts(language) }))))
        }
    };
    document(say(Text::Compare), &Frame { language, person: session.person.as_ref(), kind: Kind::WithMaps }, main)
}

/// Serves the report of the run named `id`. Uses the report file in the folder of the run. If there is no such file,
/// creates the report from the record. Responds with the status 404 if the run does not exist, and 422 if the report
/// cannot be created.
pub(crate) async fn report(State(page): State<Shared>, Path(id): Path<String>, headers: HeaderMap) -> Response {
    let Some(folder) = page.history.folder(&id) else { return not_here(PageSubject::Cell, &headers) };
    let read = spawn_blocking(move || {
        std::fs::read(folder.join(RunFile::Report.name()))
            .or_else(|_| regrind_report::run_report(&folder).map(String::into_bytes))
    });
    match read.await {
        Ok(Ok(html)) => {
            // The report contains its style. It must not run scripts and must not fetch anything.
            let policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'";
            let headers = [
                (CONTENT_TYPE, "text/html; charset=utf-8"),
                (HeaderName::from_static("content-security-policy"), policy),
            ];
            (headers, html).into_response()
        }
        Ok(Err(error)) => (StatusCode::UNPROCESSABLE_ENTITY, error.to_string()).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// Returns the page for an address that does not exist, with the status 404. `of` says whether the server shows one
/// cell or the plant; it determines the links at the top of the page. `headers` are the headers of the request; they
/// determine the language.
pub(crate) fn not_here(of: PageSubject, headers: &HeaderMap) -> Response {
    let language = language(headers);
    let main = html! { main .list { h1 { "404" } p { (Text::NotHere.to(language)) } } };
    (StatusCode::NOT_FOUND, document("404", &Frame { language, person: None, kind: Kind::Plain(of) }, main))
        .into_response()
}

/// Returns the page for a client without access. `reason` decides what the page asks for: the key, or a sign-in. `of`
/// says whether the server shows one cell or the plant; it determines the links at the top of the page. `headers` are
/// the headers of the request; they determine the language.
pub(crate) fn denied(reason: Denied, of: PageSubject, headers: &HeaderMap) -> Response {
    match reason {
        Denied::NoKey => key_needed(StatusCode::UNAUTHORIZED, of, headers),
        Denied::TooManyKeys => key_needed(StatusCode::TOO_MANY_REQUESTS, of, headers),
        Denied::NotSignedIn => sign_in(StatusCode::UNAUTHORIZED, of, headers, None),
    }
}

/// Returns the page on which a person enters the access key. A client without a valid key gets this page. `status` is
/// the HTTP status of the response. `of` says whether the server shows one cell or the plant; it determines the links
/// at the top of the page. `headers` are the headers of the request; they determine the language.
fn key_needed(status: StatusCode, of: PageSubject, headers: &HeaderMap) -> Response {
    let language = language(headers);
    let main = html! {
        main .list {
            h1 { "Regrind" }
            p { (Text::KeyNeeded.to(language)) }
            form method="get" action="/" { label { "key " input name="key" type="password" autocomplete="off"; } " " button { "OK" } }
        }
    };
    (status, document("Regrind", &Frame { language, person: None, kind: Kind::Plain(of) }, main)).into_response()
}

/// Returns the sign-in page. `status` is the HTTP status of the response. `of` says whether the server shows one cell
/// or the plant; it determines the links at the top of the page. `headers` are the headers of the request; they
/// determine the language. `told` is the message after a failed sign-in; without a message it is `None`.
pub(crate) fn sign_in(status: StatusCode, of: PageSubject, headers: &HeaderMap, told: Option<Text>) -> Response {
    let language = language(headers);
    let say = |text: Text| text.to(language);
    let main = html! {
        main .list .sign-in {
            h1 { (say(Text::SignIn)) }
            @if let Some(told) = told { p .no role="alert" { (say(told)) } }
            form method="post" action="/sign-in" {
                label { (say(Text::UserName)) " " input name="name" autocomplete="username" required maxlength="64" autofocus; }
                label { (say(Text::Password)) " " input name="password" type="password" autocomplete="current-password" required maxlength="256"; }
                button { (say(Text::SignIn)) }
            }
            p .quiet { (say(Text::WhoMakesUsers)) }
        }
    };
    (status, document(say(Text::SignIn), &Frame { language, person: None, kind: Kind::Plain(of) }, main))
        .into_response()
}

/// Frame around every page.
struct Frame<'a> {
    language: Language,
    /// Person who has signed in.
    person: Option<&'a Person>,
    kind: Kind<'a>,
}

/// Kind of a page: which scripts and styles it needs.
#[derive(Clone, Copy)]
enum Kind<'a> {
    Plain(PageSubject),
    /// Page of the cell with maps.
    WithMaps,
    /// Page of the plant, which is reloaded after some seconds if it changes.
    Plant {
        again_s: Option<u32>,
        style: &'a str,
    },
}

impl Kind<'_> {
    fn subject(self) -> PageSubject {
        match self {
            Self::Plain(of) => of,
            Self::WithMaps => PageSubject::Cell,
            Self::Plant { .. } => PageSubject::Plant,
        }
    }
}

/// Returns a complete web page of the plant. `main` is the content. The function adds the parts that all pages have:
/// the title `title`, the links at the top, and the person who has signed in (from `session`). The browser reloads the
/// page every `again_s` seconds. If `again_s` is `None`, it does not reload the page. `style` is the address of an
/// additional style sheet.
pub fn plant_document(title: &str, session: &Session, again_s: Option<u32>, style: &str, main: Markup) -> Response {
    let kind = Kind::Plant { again_s, style };
    document(title, &Frame { language: Language::En, person: session.person.as_ref(), kind }, main)
}

fn document(title: &str, frame: &Frame, main: Markup) -> Response {
    let Frame { language, person, kind } = *frame;
    let say = |text: Text| text.to(language);
    let markup = html! {
        (DOCTYPE)
        html lang=(language.tag()) {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) " · Regrind" }
                link rel="icon" href="/assets/icon.svg";
                link rel="stylesheet" href="/assets/page.css";
                @if let Kind::Plant { again_s, style } = kind {
                    link rel="stylesheet" href=(style);
                    @if let Some(again_s) = again_s { meta http-equiv="refresh" content=(again_s); }
                }
                script src="/assets/theme.js" {}
                script src="/assets/post.js" defer {}
                @if matches!(kind, Kind::WithMaps) {
                    script src="/assets/map.js" defer {}
                    script src="/assets/relief.js" defer {}
                    script src="/assets/page.js" defer {}
                }
            }
            body {
                nav {
                    @match kind.subject() {
                        PageSubject::Cell => { a href="/" { (say(Text::Cell)) } " " a href="/runs" { (say(Text::Runs)) } }
                        PageSubject::Plant => {
                            @for (path, name) in [("/", "Plant"), ("/trend", "Trend"), ("/cells", "Compare"), ("/parts", "Parts")] { a href=(path) { (name) } " " }
                        }
                    }
                    span .settings {
                        @if let Some(person) = person {
                            span .person { (person.name) " · " (say(texts::role(person.role))) } " "
                            button #sign-out type="button" { (say(Text::SignOut)) } " "
                        }
                        @if !matches!(kind, Kind::Plant { .. }) {
                            label { (say(Text::Language)) " "
                                select #language {
                                    @for each in Language::ALL {
                                        option value=(each.tag()) lang=(each.tag()) selected[each == language] { (each.name()) }
                                    }
                                }
                            }
                            " "
                        }
                        label { (say(Text::Appearance)) " "
                            select #theme {
                                @for (value, text) in [("", Text::AsTheSystem), ("light", Text::Light), ("dark", Text::Dark), ("contrast", Text::HighContrast)] {
                                    option value=(value) { (say(text)) }
                                }
                            }
                        }
                    }
                }
                (main)
            }
        }
    };
    ([(CONTENT_TYPE, "text/html; charset=utf-8")], markup.into_string()).into_response()
}

/// Returns the language of the page for a request. `headers` are the headers of the request. The first rule that gives
/// a language applies:
///
/// - the language that the person chose in this browser (stored in a cookie)
/// - the first supported language in the header `Accept-Language`
/// - English
pub(crate) fn language(headers: &HeaderMap) -> Language {
    let chosen = text(headers, COOKIE).and_then(|cookies| {
        let pair = cookies.split(';').find_map(|pair| pair.trim().strip_prefix("regrind_language="))?;
        Language::first_of(pair)
    });
    chosen.or_else(|| Language::first_of(text(headers, ACCEPT_LANGUAGE)?)).unwrap_or_default()
}
