//! View of the machines of a run: links, values with their course, probe, wheel and calibration.

use axum::Extension;
use axum::extract::{Path, State};
use axum::http::HeaderMap;
use axum::response::{IntoResponse, Redirect, Response};
use maud::{Markup, PreEscaped, html};
use regrind_cell::Device;
use regrind_control::{MachineStatus, MachineValue, Request, ValueKind, send_request};
use regrind_report::{Chart, ChartAxis, CycleSummary, Layer, Mark, RunSummary, Scale};
use tokio::task::spawn_blocking;

use super::guard::Session;
use super::pieces::in_path;
use super::reader::language;
use super::shared::{Equipment, Shared};
use super::subject::PageSubject;
use super::texts::Text;
use super::view::{first_run, not_here, plain_document};
use regrind_language::{Language, decimal};

/// Width and height of the chart of a value, in pixels.
const CHART: [f64; 2] = [400.0, 120.0];
/// Interval between two updates of the view while the run is active, in ms.
const REFRESH_MS: u32 = 2000;
/// Age of an answer, in s, above which the machine counts as silent.
const SILENT_AFTER_S: f64 = 5.0;

/// Serves the machines of the run that the page shows first.
pub(crate) async fn home(State(page): State<Shared>) -> Response {
    let path = first_run(&page).await.map_or("/runs".to_owned(), |run| format!("/runs/{}/machines", in_path(&run)));
    Redirect::to(&path).into_response()
}

/// Serves the machines of the run named `id`: their live status if the program of the run answers, and what the record
/// and the cell file say. Responds with the status 404 if the run does not exist.
pub(crate) async fn machines(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Response {
    drop(page.viewers.enter());
    let Some(folder) = page.history.folder(&id) else { return not_here(PageSubject::Cell, &headers) };
    let shared = Shared::clone(&page);
    let found = spawn_blocking(move || {
        let live = send_request(&folder, &Request::Machines).ok().and_then(|reply| reply.machines);
        let summary = shared.history.summary(&folder).unwrap_or_default();
        (live, summary, shared.plan.equipment(&folder).unwrap_or_default())
    });
    let Ok((live, summary, equipment)) = found.await else { return not_here(PageSubject::Cell, &headers) };
    let language = language(&headers);
    let say = |text: Text| text.to(language);
    let main = html! {
        main .list .machines data-refresh-ms=[live.is_some().then_some(REFRESH_MS)] {
            h1 { (say(Text::Machines)) " " a href=(format!("/runs/{}", in_path(&id))) { (id) } }
            @if live.is_none() { p .quiet { (say(Text::MachinesNotLive)) } }
            div .pair {
                @for device in Device::BOTH {
                    @let status = live.as_ref().map(|live| &live[device as usize]);
                    (machine(device, status, (&summary, &equipment), language))
                }
            }
        }
    };
    plain_document(say(Text::Machines), &session, language, main)
}

/// Returns the card of a machine. `status` is its live status, if there is one.
fn machine(
    device: Device,
    status: Option<&MachineStatus>,
    (summary, equipment): (&RunSummary, &Equipment),
    language: Language,
) -> Markup {
    let say = |text: Text| text.to(language);
    let reported = summary.machines[device as usize].as_deref().unwrap_or_default();
    html! {
        section .card {
            h2 .machine-name { (device) @if !reported.is_empty() { " · " (reported) } }
            @if let Some(status) = status {
                (link(status, language))
                div .values {
                    @for value in &status.values { (value_card(value, language)) }
                }
            }
            h3 { (say(if device == Device::Cmm { Text::Probe } else { Text::Wheel })) }
            @match device {
                Device::Cmm => (probe(summary, equipment, language)),
                Device::Grinder => (wheel(summary, equipment, language)),
            }
        }
    }
}

/// Returns the state of a machine and of the link to it.
fn link(status: &MachineStatus, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let is_silent = !status.is_connected || status.answer_age_s.is_none_or(|age_s| age_s > SILENT_AFTER_S);
    let yes_or_no = |known: Option<bool>| match known {
        Some(true) => Text::Yes,
        Some(false) => Text::No,
        None => Text::NotReported,
    };
    html! {
        dl {
            dt { (say(Text::StateOfMachine)) } dd { strong { (status.state.as_deref().unwrap_or("–")) } }
            dt { (say(Text::Link)) }
            dd .warns[is_silent] {
                @match status.answer_age_s {
                    None => (say(Text::NoAnswerYet)),
                    Some(age_s) if is_silent => { (say(Text::NoAnswerSince)) " " (decimal(age_s, 0, language)) " s" },
                    Some(_) => (say(Text::Answers)),
                }
                " · " (say(Text::LostLinks)) ": " (status.lost_links)
                @if !status.name.is_empty() { br; span .quiet { (status.name) } }
            }
            dt { (say(Text::Automatic)) } dd .warns[status.is_automatic == Some(false)] { (say(yes_or_no(status.is_automatic))) }
            dt { (say(Text::ClearOfPart)) } dd { (say(yes_or_no(status.is_clear))) }
            dt { (say(Text::Supplies)) } dd .warns[status.has_supplies == Some(false)] { (say(yes_or_no(status.has_supplies))) }
        }
    }
}

/// Returns a value with its limits and its course.
fn value_card(value: &MachineValue, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let name = match value.kind {
        ValueKind::AnswerTime => say(Text::AnswerTime),
        ValueKind::Temperature => say(Text::Temperature),
        ValueKind::Signal => &value.name,
    };
    let digits = if value.kind == ValueKind::AnswerTime { 1 } else { 2 };
    let number = |of: f64| decimal(of, digits, language);
    let is_out = value.range.is_some_and(|[low, high]| !value.value.is_some_and(|now| (low..=high).contains(&now)));
    html! {
        figure .value-card {
            figcaption {
                span { (name) }
                strong .warns[is_out] { (value.value.map_or("–".to_owned(), number)) " " (value.unit) }
                @if let Some([low, high]) = value.range {
                    span .quiet { (say(Text::Limit)) " " (number(low)) " … " (number(high)) }
                }
            }
            (PreEscaped(course(name, value, language)))
        }
    }
}

/// Returns the chart of the course of a value: minutes before now to the right, the value upwards. The band is the
/// range of the value within each sample. Limits are drawn if they are near the values.
fn course(name: &str, value: &MachineValue, language: Language) -> String {
    let samples = &value.samples;
    let [low, high] = samples
        .iter()
        .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], sample| [low.min(sample[1]), high.max(sample[2])]);
    if !(low.is_finite() && high.is_finite()) {
        return String::new();
    }
    let extent = (high - low).max(0.02 * high.abs()).max(0.1);
    let near = value.range.into_iter().flatten().filter(|limit| (low - extent..=high + extent).contains(limit));
    let [bottom, top] = near.clone().fold([low, high], |[low, high], limit| [low.min(limit), high.max(limit)]);
    let number = |value: f64, decimals: usize| decimal(value, decimals, language);
    let places: Vec<[f64; 3]> = samples.iter().map(|[age_s, low, high]| [-age_s / 60.0, *low, *high]).collect();
    let begin = places.first().map_or(-1.0, |first| first[0]).min(-0.5);
    let middle = places.iter().map(|[at, low, high]| [*at, 0.5 * (low + high)]).collect();
    let mut marks: Vec<Mark> = near.map(|at| Mark::Across { class: "limit", name: String::new(), at }).collect();
    marks.extend([Mark::Band(places), Mark::Line(middle)]);
    let chart = Chart {
        description: format!("{name}: {} … {} {}", number(low, 2), number(high, 2), value.unit),
        size: CHART,
        right_margin: 30.0,
        x: ChartAxis::new("min", Scale::Linear, [begin, 0.0], 6, &number),
        y: ChartAxis::new("", Scale::Linear, [bottom - 0.1 * extent, top + 0.1 * extent], 4, &number),
        layers: vec![Layer { class: "pv".into(), marks, ..Layer::default() }],
        ..Chart::default()
    };
    chart.to_markup()
}

/// Returns what is known of the probe: its radius, its error on the reference sphere in each cycle, and the day of the
/// next calibration of the CMM.
fn probe(summary: &RunSummary, equipment: &Equipment, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let measured: Vec<(u32, f64)> =
        summary.cycles.iter().filter_map(|of| Some((of.cycle, of.radius_error_um?))).collect();
    html! {
        dl {
            dt { (say(Text::ProbeRadius)) }
            dd { @if equipment.probe_radius_mm > 0.0 { (decimal(equipment.probe_radius_mm, 4, language)) " mm" } @else { "–" } }
            (calibration(Device::Cmm, equipment, language))
            @if let Some(tolerance_um) = equipment.radius_tolerance_um {
                dt { (say(Text::RadiusTolerance)) } dd { "± " (decimal(tolerance_um, 2, language)) " µm" }
            }
        }
        @if !measured.is_empty() {
            table {
                tr { th { (say(Text::Cycle)) } th .n { (say(Text::RadiusError)) ", µm" } }
                @for (cycle, um) in measured { tr { td { (cycle) } td .n { (decimal(um, 3, language)) } } }
            }
        }
    }
}

/// Returns the day of the next calibration of a machine.
fn calibration(device: Device, equipment: &Equipment, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let due = equipment.calibration_due[device as usize].as_deref();
    let is_overdue = due.is_some_and(|due| *due < *regrind_report::today());
    html! {
        dt { (say(Text::CalibrationDue)) }
        dd .warns[is_overdue] {
            (due.unwrap_or(say(Text::NotStated)))
            @if is_overdue { " · " strong { (say(Text::Overdue)) } }
        }
    }
}

/// Returns what is known of the wheel: its radius, and what the grinder reported of each pass.
fn wheel(summary: &RunSummary, equipment: &Equipment, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let passes: Vec<&CycleSummary> = summary.cycles.iter().filter(|of| of.pass.is_some()).collect();
    html! {
        dl {
            dt { (say(Text::WheelRadius)) }
            dd {
                @match summary.wheel_radius_mm {
                    Some(mm) => { (decimal(mm, 4, language)) " mm · " (say(Text::ReportedByGrinder)) },
                    None => (say(Text::NotReported)),
                }
                @if let Some(mm) = equipment.wheel_radius_mm { br; span .quiet { (decimal(mm, 4, language)) " mm · " (say(Text::InRecipe)) } }
            }
            (calibration(Device::Grinder, equipment, language))
        }
        @if !passes.is_empty() {
            div .wide {
                table {
                    tr {
                        th { (say(Text::Cycle)) } th .n { (say(Text::WheelRadius)) ", mm" } th .n { (say(Text::RemovedVolume)) ", mm³" }
                        th .n { (say(Text::LargestDepth)) ", µm" } th .n { (say(Text::SpindleLoad)) ", %" }
                        th .n { (say(Text::Temperature)) ", °C" } th .n { (say(Text::Duration)) ", min" }
                    }
                    @for of in passes {
                        @let pass = of.pass.unwrap_or_default();
                        @let shown = |value: Option<f64>, factor: f64, digits: usize| value.map_or("–".to_owned(), |value| decimal(factor * value, digits, language));
                        tr {
                            td { (of.cycle) }
                            td .n { (shown(pass.wheel_radius_mm, 1.0, 4)) } td .n { (shown(pass.removed_mm3, 1.0, 1)) }
                            td .n { (shown(pass.max_depth_mm, 1e3, 1)) } td .n { (shown(pass.spindle_load, 1e2, 0)) }
                            td .n { (shown(pass.temperature_c, 1.0, 1)) } td .n { (shown(pass.duration_s, 1.0 / 60.0, 1)) }
                        }
                    }
                }
            }
        }
    }
}
