//! Content of a record of the journal, in one line for a person.

use std::fmt::Write;

use serde::Serialize;

use regrind_cell::{
    Alarm, Command, CompensationRefusal, ConnectionRefusal, Device, Ending, Event, Figures, GateFailure, GateResult,
    Judgement, Occupation, Reconciliation, RecordFailure,
};
use regrind_figures::Interval;
use regrind_formats::result::Coordinates;
use regrind_journal::Record;
use regrind_record::{
    Answer, Artefact, Begin, Confirmation, Content, MachineNotes, PartEnd, PassFigures, RecoveryOrder, Remark,
    RunContent, RunEnd, Seal, Transfer,
};

/// Returns the content of a record of the journal as one readable line. The reason of the record, if it has one,
/// follows in brackets. If this version of the program cannot interpret the content, the line contains the original
/// text of the record. Control characters are replaced by spaces.
pub fn words(record: &Record) -> String {
    let told = Content::read(record).ok().and_then(|content| content_words(&content));
    let as_written = || record.value().as_str().map_or_else(|| record.payload.clone(), str::to_owned);
    let mut line = told.unwrap_or_else(as_written);
    if !record.reason.is_empty() {
        let _ = write!(line, " ({})", record.reason);
    }
    // Some texts come from a machine. Control characters could change the terminal, so they are replaced.
    line.replace(|c: char| c.is_control(), " ")
}

fn content_words(content: &Content) -> Option<String> {
    match content {
        Content::Begin(begin) => begin_words(begin),
        Content::Reopen(_) => Some("reopened".to_owned()),
        Content::Command(record) => Some(command_words(&record.command)),
        Content::Event(record) => Some(event_words(&record.event)),
        Content::Answer(Answer::Event { event }) => Some(format!("answered: {}", event.replace('_', " "))),
        Content::Answer(Answer::Found { found }) => Some(format!("answered: {found}")),
        Content::Confirmation(confirmation) => Some(confirmation_words(confirmation)),
        Content::Recovery(RecoveryOrder { recover, device, seen }) => {
            let seen = seen.as_deref().unwrap_or("unknown");
            Some(format!("{device}: order {recover} to recover the machine; state before the order: {seen}"))
        }
        Content::MachineNotes(MachineNotes { device, notes }) => Some(format!("{device}: {}", notes.join("; "))),
        Content::Remark(Remark { remark, alarm: None }) => Some(remark.clone()),
        Content::Remark(Remark { remark, alarm: Some(alarm) }) => {
            let remark = if remark.is_empty() { String::new() } else { format!(": {remark}") };
            Some(format!("alarm acknowledged, {}{remark}", alarm.head()))
        }
        Content::Pass(pass) => Some(pass_words(&pass.pass_record)),
        Content::Transfer(note) => Some(transfer_words(&note.transfer)),
        Content::Artefact(Artefact { name, bytes, sha256 }) => {
            Some(format!("{name}, {bytes} bytes, sha256 {}...", sha256.get(..12).unwrap_or(sha256)))
        }
        Content::Seal(Seal { records, key, .. }) => {
            let key = key.get(..12).unwrap_or(key);
            Some(format!("the records up to record {records} are sealed with key {key}..."))
        }
        Content::End(end) => match &end.ending {
            RunEnd::Part(PartEnd { ending, .. }) | RunEnd::Bare(ending) => Some(ending_words(ending)),
            RunEnd::Recovery(end) => Some(home_words([end.cmm_home, end.grinder_home])),
            RunEnd::Other(_) => None,
        },
        Content::Unknown(_) => None,
    }
}

fn begin_words(begin: &Begin<RunContent>) -> Option<String> {
    let marked = if begin.simulation == Some(true) { "SIMULATION  " } else { "" };
    let mut line = format!("{marked}run {}", begin.run.as_ref()?);
    for text in begin.content.names().into_iter().flatten() {
        let _ = write!(line, ", {text}");
    }
    Some(line)
}

/// Returns one line about the confirmation of a person: the machine and the confirmed state. The digits of the map and
/// the path of the file follow if the person gave them.
fn confirmation_words(confirmation: &Confirmation) -> String {
    let (device, state, map, file) = confirmation.parts();
    let mut line = format!("{device}: {state}");
    for (key, text) in [("map", map), ("file", file)] {
        if let Some(text) = text {
            let _ = write!(line, ", {key} {text}");
        }
    }
    line
}

/// Returns a text that says for each machine if it is home, such as "CMM home, grinder not home". A machine is home if
/// a recovery brought it back to the idle state. `home` has one value for the CMM and one for the grinder, in this
/// order.
pub(super) fn home_words(home: [bool; 2]) -> String {
    let of = |(device, home): (Device, bool)| format!("{device} {}", if home { "home" } else { "not home" });
    Device::BOTH.into_iter().zip(home).map(of).collect::<Vec<_>>().join(", ")
}

/// Formats the share of the part over which the wheel passes without contact, such as "1.5 % in air". `share` is from 0
/// to 1. The text is "none in air" if `share` is 0, and "< 0.1 % in air" if `share` is smaller than 0.001.
pub fn in_air(share: f64) -> String {
    match 100.0 * share {
        0.0 => "none in air".to_owned(),
        percent if percent < 0.1 => "< 0.1 % in air".to_owned(),
        percent => format!("{percent:.1} % in air"),
    }
}

/// Returns one line with the values that the grinder reported about a pass, such as path length and removed volume.
/// The line omits each value that the grinder did not report. If there is none, the line is "pass: no details
/// reported".
fn pass_words(pass: &PassFigures) -> String {
    let told = [
        pass.path_mm.map(|mm| format!("path {mm:.0$} mm", usize::from(mm < 100.0))),
        pass.removed_mm3.map(|mm3| format!("{mm3:.1} mm³ removed")),
        pass.max_depth_mm.map(|mm| format!("largest depth {:.1} µm", 1e3 * mm)),
        pass.idle_share.map(|share| format!("{:.0} % of the path in air", 1e2 * share)),
        pass.spindle_load.map(|share| format!("spindle load {:.0} %", 1e2 * share)),
        pass.wheel_radius_mm.map(|mm| format!("wheel radius {mm:.4} mm")),
        pass.temperature_c.map(|c| format!("{c:.1} °C")),
        pass.duration_s.map(|s| format!("{s:.0} s")),
    ];
    let told: Vec<String> = told.into_iter().flatten().collect();
    if told.is_empty() { "pass: no details reported".into() } else { format!("pass: {}", told.join(", ")) }
}

fn transfer_words(transfer: &Transfer) -> String {
    let mut line = format!("{} points fetched in {:.2} s", transfer.points, transfer.seconds);
    if let Some(ms) = transfer.ms_per_point {
        let _ = write!(line, ", {ms:.3} ms per point");
    }
    match transfer.coordinates {
        Some(Coordinates::Centres) => line += ", probe centres",
        Some(Coordinates::Contacts) => line += ", contact points",
        None => {}
    }
    line
}

/// Returns in one line how a run ended, with the reason: accepted, not accepted, stopped or aborted.
pub fn ending_words(ending: &Ending) -> String {
    match ending {
        Ending::Accepted { reason, .. } => format!("ACCEPTED: {reason}"),
        Ending::NotAccepted { reason, .. } => format!("NOT ACCEPTED: {reason}"),
        Ending::Stopped { reason, .. } => format!("STOPPED: {reason}"),
        Ending::Aborted { reason, confirmed: true, .. } => format!("ABORTED: {reason}"),
        Ending::Aborted { reason, confirmed: false, .. } => {
            format!(
                "ABORTED, but at least one machine has not confirmed its standstill: check the machines. Reason of the abort: {reason}"
            )
        }
    }
}

/// Converts an identifier from the code into lower-case words. Both `load_confirmed` and `LoadConfirmed` become "load
/// confirmed".
fn spaced(name: &str) -> String {
    let mut words = String::new();
    for c in name.chars() {
        if c.is_uppercase() && !words.is_empty() {
            words.push(' ');
        }
        words.extend(if c == '_' { ' ' } else { c }.to_lowercase());
    }
    words
}

/// Returns the name with which `value` is recorded, as lower-case words. `value` is of a type that is recorded as a name,
/// such as a verdict.
pub(super) fn recorded_name(value: &impl Serialize) -> String {
    serde_json::to_value(value).ok().as_ref().and_then(|name| name.as_str()).map(spaced).unwrap_or_default()
}

/// Returns the identifier `name` of a command or an event as lower-case words. If `device` is given, the name of this
/// machine comes first, such as "CMM: load confirmed".
fn named(name: &str, device: Option<Device>) -> String {
    device.map_or_else(|| spaced(name), |device| format!("{device}: {}", spaced(name)))
}

/// Returns in one line the verdict of a judgement and its reason.
pub(super) fn judgement_words(judgement: &Judgement) -> String {
    format!("judged, {}: {}", verdict_words(judgement), judgement.reason)
}

/// Returns the verdict of a judgement as lower-case words, such as "wrong response".
pub(super) fn verdict_words(judgement: &Judgement) -> String {
    recorded_name(&judgement.verdict)
}

/// Returns in one line the cause of an alarm, its consequence, and what to do.
pub(super) fn alarm_words(alarm: &Alarm) -> String {
    format!("{} {} {}", alarm.event, alarm.consequence, alarm.remedy.join(" "))
}

fn command_words(command: &Command) -> String {
    match command {
        Command::Announce(judgement) => judgement_words(judgement),
        Command::Raise(alarm) => format!("ALARM {} {}", alarm.event, alarm.consequence),
        Command::Withdraw { alarm } => format!("alarm withdrawn: {}", recorded_name(alarm)),
        Command::Refuse { event, state, reason } => format!("{} refused in {state}: {reason}", spaced(event.name())),
        Command::Finish(ending) => format!("finish, {}", ending_words(ending)),
        command => {
            let name = command.name();
            let (name, device) =
                name.split_once(' ').map_or((name.as_str(), None), |(name, device)| (name, Some(device)));
            let words = spaced(name.strip_suffix("_machine").unwrap_or(name));
            device.map_or(words.clone(), |device| format!("{device}: {words}"))
        }
    }
}

fn event_words(event: &Event) -> String {
    let name = named(event.name(), event.device());
    let more = match event {
        Event::Hold { reason, .. }
        | Event::Resume { reason, .. }
        | Event::Stop { reason, .. }
        | Event::Abort { reason, .. } => reason.clone(),
        Event::DeclaredOver { evidence, .. } => evidence.clone(),
        Event::Connected { simulated, occupation, .. } => found_words(*simulated, occupation),
        Event::NotConnected { reason, .. } => mismatch_words(reason),
        Event::LinkLost { reason, .. }
        | Event::StartUnknown { reason, .. }
        | Event::RegistrationFailed { reason, .. } => reason.clone(),
        Event::ConditionLost { condition, message, .. } => format!("{condition}: {message}"),
        Event::ConditionBack { condition, .. } => condition.to_string(),
        Event::Progressed { done, total, .. } => format!("{done} of {total}"),
        Event::Ended { result, .. } => result.to_string(),
        Event::Obstructed { message, .. } => message.clone(),
        Event::Refused { request, reason, .. } => format!("{}: {reason}", recorded_name(request)),
        Event::Fault { code, message, .. } => format!("{code}, {message}"),
        Event::Reconciled { outcome, .. } => reconciliation_words(outcome),
        Event::Collected { targets, found, gate, .. } => {
            format!("{found} of {targets} points, {}", gate_words(gate))
        }
        Event::Qualified { radius_error_mm, .. } => {
            format!("radius error of the probe {:.2} µm", 1e3 * radius_error_mm)
        }
        Event::Registered { figures, .. } => figures_words(figures),
        Event::Compensated { summary, .. } => format!(
            "largest correction {:.2} µm, largest removal {:.2} µm, share of the part that the wheel does not touch: {}, expected PV after the pass {:.2} µm{}",
            1e3 * summary.max_correction_mm,
            1e3 * summary.depth_mm,
            in_air(summary.air_share),
            1e3 * summary.predicted_pv_mm,
            parameters_words(summary)
                .iter()
                .chain(&summary.warnings)
                .map(|said| format!("; {said}"))
                .collect::<String>()
        ),
        Event::CompensationRefused { reason, .. } => match reason {
            CompensationRefusal::BudgetSpent(words) | CompensationRefusal::Failed(words) => words.clone(),
            CompensationRefusal::WeakDirections(directions) => format!("weak directions: {}", directions.join(", ")),
        },
        Event::RecordFailed { reason: RecordFailure::DiskFull(words) | RecordFailure::Unwritable(words) } => {
            words.clone()
        }
        _ => String::new(),
    };
    if more.is_empty() { name } else { format!("{name}, {more}") }
}

fn found_words(simulated: bool, found: &Occupation) -> String {
    let kind = if simulated { "a simulation" } else { "a real machine" };
    match found {
        Occupation::Idle => format!("{kind}, idle"),
        Occupation::ToClear => format!("{kind}, aborted or in fault: this state must be cleared before a run"),
        Occupation::Busy(words) => format!("{kind}, busy: {words}"),
    }
}

fn mismatch_words(reason: &ConnectionRefusal) -> String {
    match reason {
        ConnectionRefusal::Unreachable(words) => format!("unreachable: {words}"),
        ConnectionRefusal::WrongDevice(words) => format!("another device: {words}"),
        ConnectionRefusal::WordOrder(words) => {
            format!(
                "the machine sends the registers of a value in another order (word order) than the cell file states: {words}"
            )
        }
        ConnectionRefusal::Inches => "the machine works in inches".to_owned(),
        ConnectionRefusal::Owned(words) => format!("owned by another client: {words}"),
        ConnectionRefusal::AtAnotherJob(words) => format!("busy with the job of another run: {words}"),
    }
}

fn reconciliation_words(outcome: &Reconciliation) -> String {
    match outcome {
        Reconciliation::Running => "running".to_owned(),
        Reconciliation::Held => "held".to_owned(),
        Reconciliation::Ended(result) => format!("ended, {result}"),
        Reconciliation::NotStarted => "not started".to_owned(),
        Reconciliation::Unknown(words) => format!("unknown: {words}"),
    }
}

/// Returns "usable" if a measurement passed its checks, and otherwise "not usable: " and the reason. `gate` is the
/// result of these checks.
pub(super) fn gate_words(gate: &GateResult) -> String {
    match gate {
        GateResult::Passed => "usable".to_owned(),
        GateResult::Failed(GateFailure::NoPart) => "not usable: nothing was touched".to_owned(),
        GateResult::Failed(GateFailure::Contacts) => {
            "not usable: the CMM returned contact points instead of probe centres".to_owned()
        }
        GateResult::Failed(GateFailure::Inches) => "not usable: the coordinates seem to be in inches".to_owned(),
        GateResult::Failed(
            GateFailure::Coverage(words)
            | GateFailure::Foreign(words)
            | GateFailure::Broken(words)
            | GateFailure::Temperature(words)
            | GateFailure::Moved(words),
        ) => format!("not usable: {words}"),
    }
}

fn figures_words(figures: &Figures) -> String {
    let mut line = format!(
        "PV {:.2} µm, RMS {:.3} µm, {} points, {} outliers",
        1e3 * figures.pv_mm,
        1e3 * figures.rms_mm,
        figures.points,
        figures.outliers
    );
    if let Some(form) = &figures.form {
        let um =
            |of: &Interval| format!("{:.2} ({:.2} to {:.2}) µm", 1e3 * of.median_mm, 1e3 * of.low_mm, 1e3 * of.high_mm);
        let (pv, rms, scatter_um) = (um(&form.pv_998), um(&form.rms), 1e3 * form.noise_sigma_mm);
        let _ = write!(line, "; form without the probe noise of {scatter_um:.2} µm: PV 99.8 % {pv}, RMS {rms}");
    }
    for words in figures.weak_directions.iter().chain(&figures.warnings) {
        let _ = write!(line, "; {words}");
    }
    line
}

/// Returns readable lines about the compensation of machine parameters. There is one line for each estimated parameter,
/// with its error and the compensated part. A last line gives the rms of the residual error, in micrometres, that the
/// correction map must correct. It is omitted if this rms is not known. Returns no lines if no parameters were
/// estimated.
pub(super) fn parameters_words(summary: &regrind_cell::CompensationSummary) -> Vec<String> {
    let told = summary.parameters.iter().map(regrind_cell::RecordedParameter::in_words);
    let left = summary.map_rms_mm.filter(|_| !summary.parameters.is_empty());
    told.chain(left.map(|mm| format!("error that the correction map must correct: {:.2} µm RMS", 1e3 * mm))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn in_air_formats_percentages() {
        let said =
            ["none in air", "< 0.1 % in air", "< 0.1 % in air", "0.1 % in air", "62.5 % in air", "100.0 % in air"];
        assert_eq!([0.0, 8.05e-11, 9.9e-4, 1e-3, 0.625, 1.0].map(in_air), said);
    }
}
