//! Compares the actions of a measuring machine by I++ DME with the record. Its server knows no jobs. Only the program
//! ensures that every motion is intended, and that every measured point was touched.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use regrind::cell::StateName;
use regrind_sim::dme::event::MachineEvent;
use tokio::time::Instant;

use crate::checker::{Evidence, is_intent};
use crate::ledger::Recorded;

/// Time within which the task that carries out the job sees a hold.
const HOLDS_WITHIN: Duration = Duration::from_millis(100);
/// Tolerance for equal places, in mm.
const SAME_MM: f64 = 1e-6;
/// Maximum distance, in mm, from the target at which a touch retracts: it starts at the true contact, which is off by
/// the error of the part.
const STRAIGHT_MM: f64 = 0.1;
/// Commands that move the machine.
const MOTIONS: [&str; 4] = ["GoTo(", "PtMeas(", "Home(", "ChangeTool("];

/// Checks a measuring machine by I++ DME against every promise.
///
/// # Errors
///
/// Returns the first broken promise.
pub fn check(evidence: &Evidence) -> Result<(), String> {
    if evidence.machine_events.is_empty() {
        return Ok(());
    }
    moves_by_an_intent(evidence)?;
    nothing_after_an_abort(evidence)?;
    travels_at_the_clearance(evidence)?;
    measured_is_touched(evidence)?;
    told_nothing_while_it_stands(evidence)?;
    holds_at_the_next_target(evidence)
}

/// Returns every motion that began: its command, its start and its end.
fn motions(evidence: &Evidence) -> impl Iterator<Item = (Instant, &str, [[f64; 3]; 2])> {
    evidence.machine_events.iter().filter_map(|(at, event)| match event {
        MachineEvent::MotionStarted { command, from_mm, to_mm } => Some((*at, command.as_str(), [*from_mm, *to_mm])),
        _ => None,
    })
}

/// Returns true if a record says that the job of the CMM is over.
fn is_over(payload: &serde_json::Value) -> bool {
    let of_cmm = payload["device"] == "cmm";
    let ended = matches!(payload["event"].as_str(), Some("ended" | "abort_confirmed" | "fault"));
    let reconciled = payload["event"] == "reconciled"
        && (payload["outcome"]["ended"].is_string() || payload["outcome"] == "not_started");
    of_cmm && (ended || reconciled)
}

/// Checks that nothing moves except for a START that is on record and not over.
fn moves_by_an_intent(evidence: &Evidence) -> Result<(), String> {
    for (at, command, _) in motions(evidence) {
        let intent = evidence.written.iter().rfind(|w| w.at <= at && is_intent(w, 0));
        let what = match intent {
            None => "no START is on record",
            Some(intent) if evidence.written.iter().any(|w| intent.at < w.at && w.at < at && is_over(&w.payload)) => {
                "its job is over by the record"
            }
            Some(_) => continue,
        };
        return Err(format!("the cmm moves by {command} at {:.3} s, and {what}", evidence.seconds(at)));
    }
    Ok(())
}

/// Checks that nothing moves after an abort before a person resumes the job, or the next START is on record.
fn nothing_after_an_abort(evidence: &Evidence) -> Result<(), String> {
    let mut aborted = None;
    for (at, event) in &evidence.machine_events {
        match (event, aborted) {
            (MachineEvent::Aborted, _) => aborted = Some(*at),
            (MachineEvent::MotionStarted { command, .. }, Some(since)) => {
                let goes_on = |w: &Recorded| {
                    is_intent(w, 0) || w.payload["command"] == "resume_machine" && w.payload["device"] == "cmm"
                };
                if !evidence.written.iter().any(|w| since <= w.at && w.at <= *at && goes_on(w)) {
                    let [since, at] = [since, *at].map(|at| evidence.seconds(at));
                    return Err(format!("the cmm was aborted at {since:.3} s, and moves by {command} at {at:.3} s"));
                }
                aborted = None;
            }
            _ => {}
        }
    }
    Ok(())
}

/// Checks that below the clearance the probe only moves straight up or down, and to a target directly there. Homing is
/// excluded: the machine does it in its own way.
fn travels_at_the_clearance(evidence: &Evidence) -> Result<(), String> {
    let touched = evidence.machine_events.iter().filter_map(|(_, event)| match event {
        MachineEvent::Touched { point_mm, .. } => Some(point_mm[2]),
        _ => None,
    });
    let clearance_mm = touched.fold(f64::NEG_INFINITY, f64::max) + evidence.clearance_mm;
    for (at, command, [from, to]) in motions(evidence) {
        let across = (to[0] - from[0]).hypot(to[1] - from[1]);
        let lowest = from[2].min(to[2]);
        let is_low = match command {
            "GoTo" => across > STRAIGHT_MM && lowest < clearance_mm - SAME_MM,
            "PtMeas" => across > STRAIGHT_MM,
            _ => false,
        };
        if is_low {
            let at = evidence.seconds(at);
            return Err(format!("{command} goes {across:.3} mm across at {at:.3} s, from {from:?} to {to:?}"));
        }
    }
    Ok(())
}

/// Checks that every point of a measurement is the last touch of the machine at one of its targets, in this very job.
fn measured_is_touched(evidence: &Evidence) -> Result<(), String> {
    for cycle in 1.. {
        let folder = evidence.folder.join(format!("cycle-{cycle}"));
        if !folder.is_dir() {
            return Ok(());
        }
        let intents = || evidence.written.iter().filter(|w| is_intent(w, 0));
        let of_cycle = |w: &&Recorded| w.payload["cycle"] == cycle && w.payload["intent"]["job"] == evidence.job;
        let Some(intent) = intents().rfind(of_cycle) else { continue };
        let next = intents().find(|w| w.at > intent.at).map(|w| w.at);
        let mut last = BTreeMap::new();
        for (at, event) in &evidence.machine_events {
            if let MachineEvent::Touched { point_mm, centre_mm, .. } = event
                && intent.at <= *at
                && next.is_none_or(|next| *at < next)
            {
                last.insert(point_mm.map(f64::to_bits), *centre_mm);
            }
        }
        let mut left: Vec<[f64; 3]> = last.into_values().collect();
        for name in ["reference_sphere.csv", "measured.csv"] {
            for row in rows(&folder.join(name)) {
                let same = |centre: &[f64; 3]| (0..3).all(|k| (centre[k] - row[k]).abs() < SAME_MM);
                match left.iter().position(same) {
                    Some(k) => drop(left.swap_remove(k)),
                    None => {
                        return Err(format!(
                            "cycle {cycle} has a point at {row:?} in {name}, where nothing was touched"
                        ));
                    }
                }
            }
        }
    }
    Ok(())
}

fn rows(file: &Path) -> Vec<[f64; 3]> {
    let text = std::fs::read_to_string(file).unwrap_or_default();
    let numbers = |line: &str| line.split(',').map(|n| n.trim().parse().ok()).collect::<Option<Vec<f64>>>();
    text.lines().filter_map(|line| numbers(line)?.try_into().ok()).collect()
}

/// Returns true if a line moves the machine.
fn is_motion(line: &str) -> bool {
    line.split_once(' ').is_some_and(|(_, command)| MOTIONS.iter().any(|motion| command.starts_with(motion)))
}

/// Checks that no command that moves the machine leaves the program while the cell shows standstill.
fn told_nothing_while_it_stands(evidence: &Evidence) -> Result<(), String> {
    for spoken in evidence.wires.lines.iter().filter(|spoken| spoken.machine == 0 && is_motion(&spoken.line)) {
        let stands = [StateName::Held, StateName::Stopped, StateName::Aborted, StateName::Complete];
        let shown = evidence.shown_before(spoken.at).and_then(|shown| shown.state);
        if shown.is_some_and(|state| stands.contains(&state)) {
            let at = evidence.seconds(spoken.at);
            return Err(format!("the cmm is told {:?} at {at:.3} s, and the cell shows {shown:?}", spoken.line));
        }
    }
    Ok(())
}

/// Checks that after a hold or a stop no target begins, except the one that was already in progress.
fn holds_at_the_next_target(evidence: &Evidence) -> Result<(), String> {
    for given in
        evidence.given.iter().filter(|given| matches!(given.what, "hold" | "stop") && given.done && given.moved[0])
    {
        let from = given.at + HOLDS_WITHIN;
        let goes_on = |at: &Instant| *at > given.at;
        let resumed = evidence.given.iter().filter(|other| other.what == "resume").map(|other| other.at).find(goes_on);
        let died = evidence.shown.iter().filter(|shown| shown.state.is_none()).map(|shown| shown.at).find(goes_on);
        let to = resumed.into_iter().chain(died).min();
        let touches = evidence.wires.lines.iter().filter(|spoken| {
            spoken.machine == 0
                && spoken.at > from
                && to.is_none_or(|to| spoken.at < to)
                && spoken.line.contains(" PtMeas(")
        });
        // The machine retries a missed target.
        let mut targets: Vec<&str> =
            touches.filter_map(|spoken| spoken.line.split_once(' ').map(|(_, of)| of)).collect();
        targets.dedup();
        if targets.len() > 1 {
            let at = evidence.seconds(given.at);
            return Err(format!(
                "{} is given at {at:.3} s, and {} targets are begun behind it",
                given.what,
                targets.len()
            ));
        }
    }
    Ok(())
}
