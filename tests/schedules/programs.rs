//! Compares the actions of a grinder by LinuxCNC with the record. Its controller knows programs and no passes. Only the
//! program that drives it ensures that each pass begins once and with the right file.

use std::collections::BTreeSet;
use std::time::Duration;

use regrind::cell::StateName;
use regrind_sim::rsh::event::ControllerEvent;
use tokio::time::Instant;

use crate::checker::{Evidence, is_intent};

/// Time limit for a hold to be sent to a running program.
const HOLDS_WITHIN: Duration = Duration::from_millis(100);
/// Time limit for the first poll after a program was started; before it nobody knows whether there is anything to hold.
const SEEN_WITHIN: Duration = Duration::from_millis(130);
/// Time after which an obstacle to lines has been removed.
const RECOVERS_WITHIN: Duration = Duration::from_secs(12);

/// Checks a grinder by LinuxCNC against every promise.
///
/// # Errors
///
/// Returns the first broken promise.
pub fn check(evidence: &Evidence) -> Result<(), String> {
    if evidence.rsh_events.is_empty() {
        return Ok(());
    }
    begins_what_is_meant(evidence)?;
    goes_on_by_an_order(evidence)?;
    told_nothing_while_it_stands(evidence)?;
    paused_at_once(evidence)
}

/// Returns the run and the cycle of a program, from its name.
fn named(path: &str) -> Option<(&str, u64)> {
    let (named, _) = path.rsplit('/').next()?.rsplit_once('-')?;
    let (run, cycle) = named.rsplit_once("-c")?;
    Some((run, cycle.parse().ok()?))
}

/// Checks that a program begins once, for a START on record that belongs to its pass, and that it grinds the correction
/// of that pass.
fn begins_what_is_meant(evidence: &Evidence) -> Result<(), String> {
    let mut begun = BTreeSet::new();
    for (at, event) in &evidence.rsh_events {
        let ControllerEvent::Began { path, text } = event else { continue };
        let when = evidence.seconds(*at);
        if !begun.insert(path) {
            return Err(format!("{path} was begun twice, again at {when:.3} s"));
        }
        let Some((run, cycle)) = named(path) else {
            return Err(format!("{path}, which is none of ours, was begun at {when:.3} s"));
        };
        let intent = evidence.written.iter().rfind(|w| w.at <= *at && is_intent(w, 1));
        let meant = intent.map(|w| (w.payload["intent"]["job"].as_u64(), w.payload["cycle"].as_u64()));
        let job = run.strip_prefix("run-").and_then(|job| job.parse().ok());
        if meant != Some((job, Some(cycle + 1))) {
            return Err(format!("{path} was begun at {when:.3} s, and the record means {meant:?}"));
        }
        let pass = evidence.folder.with_file_name(run).join(format!("cycle-{cycle}/toolpath.ngc"));
        let pass = std::fs::read_to_string(pass).unwrap_or_default();
        // A run that never began is removed with its folder.
        if !pass.is_empty() && !text.contains(pass.trim_end().trim_end_matches("M2")) {
            return Err(format!("{path} was begun at {when:.3} s, and holds another pass than that of the correction"));
        }
    }
    Ok(())
}

/// Checks that a paused program continues only by an order on record or by a person at the machine, and after an abort
/// only by a START.
fn goes_on_by_an_order(evidence: &Evidence) -> Result<(), String> {
    let mut aborted: Option<Instant> = None;
    for (at, event) in &evidence.rsh_events {
        match event {
            ControllerEvent::Aborted => aborted = Some(*at),
            ControllerEvent::MotionStarted => {
                let Some(since) = aborted.take() else { continue };
                if !evidence.written.iter().any(|w| since <= w.at && w.at <= *at && is_intent(w, 1)) {
                    let [since, at] = [since, *at].map(|at| evidence.seconds(at));
                    return Err(format!("the grinder was aborted at {since:.3} s, and moves at {at:.3} s"));
                }
            }
            _ => {}
        }
    }
    Ok(())
}

/// Checks that no command that moves the grinder leaves the program while the cell shows standstill.
fn told_nothing_while_it_stands(evidence: &Evidence) -> Result<(), String> {
    let moves = |line: &str| matches!(line, "set run" | "set resume");
    for spoken in evidence.wires.lines.iter().filter(|spoken| spoken.machine == 1 && moves(&spoken.line)) {
        use StateName::{Aborted, Complete, Held, Stopped, Suspended};
        let shown = evidence.shown_before(spoken.at).and_then(|shown| shown.state);
        if shown.is_some_and(|state| [Held, Stopped, Aborted, Complete, Suspended].contains(&state)) {
            let at = evidence.seconds(spoken.at);
            return Err(format!("the grinder is told {:?} at {at:.3} s, and the cell shows {shown:?}", spoken.line));
        }
    }
    Ok(())
}

/// Checks that a hold or a stop is sent at once to a running program, whatever the disk does, if nothing obstructs it.
fn paused_at_once(evidence: &Evidence) -> Result<(), String> {
    let Some(hindered) = &evidence.hindered else { return Ok(()) };
    for given in
        evidence.given.iter().filter(|given| matches!(given.what, "hold" | "stop") && given.done && given.moved[1])
    {
        let moved =
            evidence.rsh_events.iter().rfind(|(at, event)| *at <= given.at && *event == ControllerEvent::MotionStarted);
        let since = moved.map_or(evidence.began, |(at, _)| *at);
        let by = given.at.max(since + SEEN_WITHIN) + HOLDS_WITHIN;
        let is_hindered = hindered.iter().any(|(from, to)| *from <= by && given.at <= *to + RECOVERS_WITHIN);
        // A restarted program first has to connect to the machines.
        let ended = evidence.shown.iter().rfind(|shown| shown.at <= by && shown.state.is_none());
        let has_met = ended.is_none_or(|ended| ended.at + RECOVERS_WITHIN < given.at);
        let stands = evidence
            .rsh_events
            .iter()
            .any(|(at, event)| given.at <= *at && *at <= by && *event == ControllerEvent::MotionEnded);
        let told = evidence.wires.lines.iter().any(|spoken| {
            let makes_safe = matches!(spoken.line.as_str(), "set pause" | "set abort");
            spoken.machine == 1 && makes_safe && since <= spoken.at && spoken.at <= by
        });
        if !is_hindered && has_met && !told && !stands {
            let at = evidence.seconds(given.at);
            return Err(format!("no {} leaves for the grinder within 0.1 s of {at:.3} s", given.what));
        }
    }
    Ok(())
}
