//! Holds what the machines did against what is on record and what people were shown and told. Knows nothing of the program but its
//! record, and nothing of the machines but what they did.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::Duration;

use regrind::cell::StateName;
use regrind::journal::{Reader, verify};
use regrind_sim::command::State;
use regrind_sim::seen::What;
use serde_json::Value;
use tokio::time::Instant;

use crate::ledger::Recorded;
use crate::machines::Moment;
use crate::person::Given;
use crate::schedule::Tally;

/// A cell that shows that it stands may be wrong for so long: a machine that hears nothing holds by itself after three seconds.
const STANDS_WITHIN: Duration = Duration::from_millis(3_600);
/// An abort is at a machine that moves within this, whatever the disk does.
const ABORTS_WITHIN: Duration = Duration::from_millis(100);
/// A command is on a wire that carries for less than this.
const ON_ITS_WAY: Duration = Duration::from_millis(20);
/// What a cell shows that stands.
const STANDS: [StateName; 4] = [StateName::Held, StateName::Stopped, StateName::Aborted, StateName::Complete];
const NAMES: [&str; 2] = ["cmm", "grinder"];

/// What the cell showed from a moment on; nothing where nobody could see it.
#[derive(Clone, Copy, Debug)]
pub struct Shown {
    pub at: Instant,
    pub state: Option<StateName>,
}

/// What is left of a schedule.
pub struct Evidence {
    pub began: Instant,
    pub job: u32,
    pub folder: PathBuf,
    pub log: Vec<Moment>,
    pub given: Vec<Given>,
    pub written: Vec<Recorded>,
    pub shown: Vec<Shown>,
    pub tally: Tally,
    /// Whether the wires carried everything at once.
    pub is_steady: bool,
    pub effects: u64,
}

impl Evidence {
    /// Everything that happened, line by line.
    pub fn trace(&self) -> Vec<String> {
        let log = self.log.iter().map(|m| (m.at, format!("{} {:?}", NAMES[m.machine], m.what)));
        let written = self.written.iter().map(|w| (w.at, format!("record {}", w.payload)));
        let given = self.given.iter().map(|g| (g.answered, format!("{} {} {}", g.what, g.reason, g.accepted)));
        let mut lines: Vec<(Instant, String)> = log.chain(written).chain(given).collect();
        lines.sort_by_key(|(at, _)| *at);
        let home = self.folder.display().to_string();
        let line = |(at, what): (Instant, String)| format!("{:10.4} {}", self.seconds(at), what.replace(&home, "RUN"));
        lines.into_iter().map(line).collect()
    }

    fn seconds(&self, at: Instant) -> f64 {
        (at - self.began).as_secs_f64()
    }
}

/// Holds a schedule against every promise.
///
/// # Errors
/// The first that was broken.
pub fn check(evidence: &Evidence) -> Result<(), String> {
    let (records, is_closed) = sound_record(evidence)?;
    began_once(evidence)?;
    intended_before(evidence)?;
    map_of_record(evidence, &records)?;
    never_both(evidence)?;
    still_where_shown(evidence)?;
    begins_nothing_where_it_stands(evidence)?;
    aborted_at_once(evidence)?;
    answered_is_on_record(evidence, &records)?;
    // Once nothing goes wrong any more, the run comes to its end.
    let last = evidence.shown.iter().rev().find_map(|shown| shown.state);
    if is_closed { Ok(()) } else { Err(format!("the run comes to no end; last it shows {last:?}")) }
}

/// The record is whole, and has everything that was acknowledged.
fn sound_record(evidence: &Evidence) -> Result<(Vec<Value>, bool), String> {
    let verified = verify(&evidence.folder).map_err(|error| format!("the record is broken: {error}"))?;
    let reader = Reader::open(&evidence.folder).map_err(|error| error.to_string())?;
    let records: Vec<Value> =
        reader.records(0).map(|record| record.map(|r| r.value())).collect::<Result<_, _>>().unwrap();
    let mut left: BTreeMap<String, u64> = BTreeMap::new();
    records.iter().for_each(|payload| *left.entry(payload.to_string()).or_default() += 1);
    // A run that was begun anew has a record of its own.
    let first_of_run = evidence.written.iter().rposition(|w| w.payload["event"] == "start").unwrap_or(0);
    for recorded in evidence.written[first_of_run..].iter().filter(|w| w.payload.is_object()) {
        match left.get_mut(&recorded.payload.to_string()) {
            Some(count @ 1..) => *count -= 1,
            _ => return Err(format!("was acknowledged and is not on record: {}", recorded.payload)),
        }
    }
    Ok((records, verified.closed))
}

/// Every START moves a machine once, and every pass is begun once.
fn began_once(evidence: &Evidence) -> Result<(), String> {
    let mut starts: BTreeSet<(usize, u32, u32, u16)> = BTreeSet::new();
    let mut passes = BTreeSet::new();
    for moment in &evidence.log {
        // A machine that was started anew counts anew.
        if let What::Rebooted { .. } = moment.what {
            starts.retain(|(machine, ..)| *machine != moment.machine);
        }
        let What::Began { start, job, cycle } = moment.what else { continue };
        let (machine, at) = (NAMES[moment.machine], evidence.seconds(moment.at));
        // Numbers come again where somebody has counted to their end; a START is told by its job too.
        if !starts.insert((moment.machine, start, job, cycle)) {
            return Err(format!("the {machine} carried out START {start} twice, again at {at:.3} s"));
        }
        if moment.machine == 1 && !passes.insert((job, cycle)) {
            return Err(format!("pass {cycle} of job {job} was begun twice, again at {at:.3} s"));
        }
    }
    Ok(())
}

/// What a machine begins was on record before.
fn intended_before(evidence: &Evidence) -> Result<(), String> {
    for moment in &evidence.log {
        let What::Began { start, job, cycle } = moment.what else { continue };
        let is_intent = |w: &&Recorded| {
            w.payload["command"] == "start_machine"
                && w.payload["device"] == NAMES[moment.machine]
                && w.payload["cycle"] == cycle
                && w.payload["intent"]["job"] == job
        };
        if !evidence.written.iter().filter(is_intent).any(|w| w.at <= moment.at) {
            let (machine, at) = (NAMES[moment.machine], evidence.seconds(moment.at));
            return Err(format!(
                "START {start} of cycle {cycle} moved the {machine} at {at:.3} s and was not on record"
            ));
        }
    }
    Ok(())
}

/// What is in force at a machine as it begins is what the record names.
fn map_of_record(evidence: &Evidence, records: &[Value]) -> Result<(), String> {
    let mut in_force: [BTreeMap<u16, [u8; 32]>; 2] = Default::default();
    for moment in &evidence.log {
        match &moment.what {
            What::Taken { kind, identity } => drop(in_force[moment.machine].insert(*kind, *identity)),
            What::Rebooted { .. } => in_force[moment.machine].clear(),
            What::Began { job, cycle, .. } if *job == evidence.job => {
                let bytes: Vec<u8> = in_force[moment.machine].values().flatten().copied().collect();
                let digest = u64::from(crc32fast::hash(&bytes));
                let named = records.iter().rev().find(|r| {
                    r["command"] == "start_machine" && r["device"] == NAMES[moment.machine] && r["cycle"] == *cycle
                });
                let named = named.and_then(|r| r["intent"]["digest"].as_u64());
                if named != Some(digest) {
                    let (machine, at) = (NAMES[moment.machine], evidence.seconds(moment.at));
                    return Err(format!(
                        "the {machine} began cycle {cycle} at {at:.3} s with {digest:08x}, and the record names {named:x?}"
                    ));
                }
            }
            _ => {}
        }
    }
    Ok(())
}

/// The state of each machine from moment to moment.
fn states(evidence: &Evidence) -> Vec<(Instant, [State; 2])> {
    let mut now = [State::Idle; 2];
    let mut states = vec![(evidence.began, now)];
    for moment in &evidence.log {
        if let What::Changed { to, .. } = moment.what {
            now[moment.machine] = to;
            states.push((moment.at, now));
        }
    }
    states
}

/// The two machines never move at the same time.
fn never_both(evidence: &Evidence) -> Result<(), String> {
    let both = states(evidence).into_iter().find(|(_, states)| *states == [State::Execute; 2]);
    both.map_or(Ok(()), |(at, _)| Err(format!("both machines move at {:.3} s", evidence.seconds(at))))
}

/// Where the cell shows that it stands, nothing moves.
fn still_where_shown(evidence: &Evidence) -> Result<(), String> {
    let last = evidence.log.last().map_or(evidence.began, |moment| moment.at) + Duration::from_secs(60);
    let states = states(evidence);
    for (k, shown) in evidence.shown.iter().enumerate() {
        if !shown.state.is_some_and(|state| STANDS.contains(&state)) {
            continue;
        }
        let until = evidence.shown.get(k + 1).map_or(last, |next| next.at);
        let from = shown.at + STANDS_WITHIN;
        for (j, (at, now)) in states.iter().enumerate() {
            let to = states.get(j + 1).map_or(last, |next| next.0);
            if now.contains(&State::Execute) && from.max(*at) < until.min(to) {
                let at = evidence.seconds(from.max(*at));
                return Err(format!(
                    "{now:?} at {at:.3} s, and the cell shows {:?} since {:.3} s",
                    shown.state,
                    evidence.seconds(shown.at)
                ));
            }
        }
    }
    Ok(())
}

/// Nothing begins while the cell shows that it stands; where the wire carries, and nobody died over it.
fn begins_nothing_where_it_stands(evidence: &Evidence) -> Result<(), String> {
    let began = evidence.log.iter().filter(|moment| matches!(moment.what, What::Began { .. }));
    for moment in began.filter(|_| evidence.is_steady && evidence.tally.has_one_life()) {
        let Some(last) = evidence.shown.iter().rev().find(|shown| shown.at + ON_ITS_WAY < moment.at) else { continue };
        if last.state.is_some_and(|state| STANDS.contains(&state)) {
            let (machine, at) = (NAMES[moment.machine], evidence.seconds(moment.at));
            return Err(format!("the {machine} begins at {at:.3} s, and the cell shows {:?}", last.state));
        }
    }
    Ok(())
}

/// A machine that moves is aborted at once, whatever the disk does; where the wire carries it.
fn aborted_at_once(evidence: &Evidence) -> Result<(), String> {
    let states = states(evidence);
    let aborts = evidence.given.iter().filter(|given| given.what == "abort" && given.accepted);
    for abort in aborts.filter(|_| evidence.is_steady) {
        let by = abort.at + ABORTS_WITHIN;
        let then = states.iter().take_while(|(at, _)| *at <= by).last().map(|(_, states)| *states);
        let Some(then) = then else { continue };
        for (k, name) in NAMES.iter().enumerate().filter(|(k, _)| abort.moved[*k]) {
            if then[k] == State::Execute {
                return Err(format!("the {name} goes on 0.1 s after the abort at {:.3} s", evidence.seconds(abort.at)));
            }
        }
    }
    Ok(())
}

/// An order that was accepted is on record, and was so before it was answered.
fn answered_is_on_record(evidence: &Evidence, records: &[Value]) -> Result<(), String> {
    for given in evidence.given.iter().filter(|given| given.accepted) {
        let names = |payload: &Value| payload["reason"] == given.reason || payload["evidence"] == given.reason;
        let in_time = evidence.written.iter().any(|w| names(&w.payload) && w.at <= given.answered);
        let stands = records.iter().any(names) || evidence.job > 1;
        if !in_time || !stands {
            let at = evidence.seconds(given.answered);
            return Err(format!("{} ({}) was answered at {at:.3} s and is not on record", given.what, given.reason));
        }
    }
    Ok(())
}
