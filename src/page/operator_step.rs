//! Card with the step that a machine asks of a person: what to do, what to check, the file to take, and the button that
//! confirms it.

use std::path::PathBuf;

use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use maud::{Markup, html};
use regrind_cell::Device;
use regrind_control::{Request, send_request};
use regrind_formats::operator_step::{OperatorAction, OperatorStep, RequiredPoints, StepConfirmation};
use tokio::task::spawn_blocking;

use super::attachment::attachment;
use super::shared::Shared;
use super::texts::Text;
use regrind_language::{Language, shortest};

/// Returns the HTML of the step `step` of the machine `device`. `run` is the address of the run.
pub(crate) fn card(step: &OperatorStep, device: Device, run: &str, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    html! {
        article .step {
            h3 { (device) ": " (say(title(&step.action))) }
            (table(&step.action, run, language))
            @let checks = checks(&step.action);
            @if !checks.is_empty() {
                div .checks {
                    p .quiet { (say(Text::CheckFirst)) }
                    ul { @for check in checks { li { (say(check)) } } }
                }
            }
            @if let Some(confirmation) = step.confirmation {
                div .confirmation {
                    p { (say(before_confirmation(&step.action))) }
                    (button(confirmation, step, device, language))
                }
            }
        }
    }
}

/// Returns the HTML of the button that confirms `step`, with the field for a file if it needs one.
fn button(confirmation: StepConfirmation, step: &OperatorStep, device: Device, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let order = |name: &str, label: Text| {
        let machine = device.to_string().to_lowercase();
        html! {
            button type="button" data-order=(name) data-device=(machine) data-map=[&step.named_map] { (say(label)) }
        }
    };
    match confirmation {
        StepConfirmation::Started => order("started", Text::PassHasBegun),
        StepConfirmation::Done => order("done", Text::JobIsDone),
        StepConfirmation::Still => order("still", Text::IsAtRest),
        StepConfirmation::DoneWithFile => html! {
            label { (say(Text::MeasurementFile)) input id="result-file" type="file"; }
            (order("measurement", Text::SendMeasurement))
        },
    }
}

fn title(action: &OperatorAction) -> Text {
    match action {
        OperatorAction::Measure { .. } => Text::StepMeasure,
        OperatorAction::MoveProbeClear => Text::StepMoveProbeClear,
        OperatorAction::BeginPass { .. } => Text::StepBeginPass,
        OperatorAction::EndPass => Text::StepEndPass,
        OperatorAction::Hold { .. } => Text::StepHold,
        OperatorAction::Stop { .. } => Text::StepStop,
        OperatorAction::Abort => Text::StepAbort,
    }
}

fn checks(action: &OperatorAction) -> Vec<Text> {
    match action {
        OperatorAction::Measure { .. } => vec![Text::RightPartClean, Text::WheelIsClear, Text::ProbeFits],
        OperatorAction::BeginPass { .. } => vec![Text::RightPartClamped, Text::ProbeIsClear, Text::WheelFits],
        _ => Vec::new(),
    }
}

fn before_confirmation(action: &OperatorAction) -> Text {
    match action {
        OperatorAction::Measure { .. } => Text::WhenMeasured,
        OperatorAction::MoveProbeClear => Text::WhenProbeClear,
        OperatorAction::BeginPass { .. } => Text::WhenPassBegun,
        OperatorAction::EndPass => Text::WhenPassEnded,
        _ => Text::WhenAtRest,
    }
}

/// Returns the HTML of the values of a step: the part, and what the machine is set to.
fn table(action: &OperatorAction, run: &str, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let file = |path: &PathBuf| {
        let name = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
        html! { a href=(format!("{run}/step-file")) download=(name) { (name) } }
    };
    match action {
        OperatorAction::Measure { part, cycle, points, plan, probe_radius_mm } => html! {
            dl {
                dt { (say(Text::Part)) } dd { (part) }
                dt { (say(Text::Cycle)) } dd { (cycle) }
                dt { (say(Text::RequiredPoints)) }
                dd {
                    @match points {
                        RequiredPoints::AtLeast(least) => { (say(Text::AtLeast)) " " (least) }
                        RequiredPoints::Listed { count, file: list } => { (count) ", " (file(list)) }
                    }
                }
                @if let Some(plan) = plan { dt { (say(Text::PlanDigits)) } dd .id { (plan) } }
                @if let Some(radius) = probe_radius_mm { dt { (say(Text::ProbeRadius)) } dd { (shortest(*radius, language)) " mm" } }
            }
        },
        OperatorAction::BeginPass { part, cycle, program, map, wheel_radius_mm, feed_mm_min, spark_out_passes } => {
            html! {
                dl {
                    dt { (say(Text::Part)) } dd { (part) }
                    dt { (say(Text::Cycle)) } dd { (cycle) }
                    dt { (say(Text::Program)) }
                    dd { @match program { Some(program) => { (file(program)) } None => { (say(Text::OwnProgram)) } } }
                    dt { (say(Text::MapDigits)) } dd .id { (map) }
                    dt { (say(Text::WheelRadius)) } dd { (shortest(*wheel_radius_mm, language)) " mm" }
                    dt { (say(Text::Feed)) } dd { (shortest(*feed_mm_min, language)) " mm/min" }
                    dt { (say(Text::SparkOutPasses)) } dd { (spark_out_passes) }
                }
            }
        }
        OperatorAction::Hold { remaining: Some(remaining) } | OperatorAction::Stop { remaining: Some(remaining) } => {
            html! { p .quiet { (remaining) } }
        }
        _ => Markup::default(),
    }
}

/// Serves the file of the present step of the run named `run`: the targets of a measurement, or the program of a pass.
/// Responds with the status 404 if the run does not ask for a step with a file.
pub(crate) async fn step_file(State(page): State<Shared>, Path(run): Path<String>) -> Response {
    let Some(folder) = page.history.folder(&run) else { return StatusCode::NOT_FOUND.into_response() };
    let read = spawn_blocking(move || {
        let step = send_request(&folder, &Request::Status).ok()?.status.operator_step?;
        let path = match step.action {
            OperatorAction::Measure { points: RequiredPoints::Listed { file, .. }, .. } => file,
            OperatorAction::BeginPass { program, .. } => program?,
            _ => return None,
        };
        let (name, holder) = (path.file_name()?.to_owned(), path.parent()?.file_name()?.to_owned());
        // A file of this run lies in the folder of a cycle; the program of the run may name it from another folder.
        let in_run = folder.join(holder).join(&name);
        let bytes = regrind_formats::result::read_bytes(if in_run.is_file() { &in_run } else { &path }).ok()?;
        Some((name.to_string_lossy().into_owned(), bytes))
    });
    match read.await {
        Ok(Some((name, bytes))) => attachment(&name, bytes),
        Ok(None) => StatusCode::NOT_FOUND.into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}
