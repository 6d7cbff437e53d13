//! Compares the actions of the machines with the record and with what people were shown. It knows nothing of the
//! program except its record, and nothing of the machines except their actions.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::Duration;

use regrind::cell::{Phase, StateName};
use regrind::journal::{Reader, verify};
use regrind_sim::command::{Command, State};
use regrind_sim::dme::event::MachineEvent;
use regrind_sim::event_log::HandshakeEvent;
use regrind_sim::rsh::event::ControllerEvent;
use serde_json::Value;
use tokio::time::Instant;

use crate::ledger::Recorded;
use crate::machines::Moment;
use crate::person::GivenOrder;
use crate::schedule::Tally;
use crate::wire::{Sent, Traffic};
use crate::{programs, touches};

/// Longest time for which a cell can wrongly show that nothing moves: a machine without communication holds by itself
/// after three seconds.
const STANDS_WITHIN: Duration = Duration::from_millis(3_600);
/// Time limit for an abort to reach a moving machine, whatever the disk does.
const ABORTS_WITHIN: Duration = Duration::from_millis(100);
/// Time after which an obstacle to queries to the machines has been removed.
const RECOVERS_WITHIN: Duration = Duration::from_secs(12);
/// Time limit for the detection of a machine that moves without an order, until it is held.
const FOUND_WITHIN: Duration = Duration::from_millis(800);
/// Maximum age of a report of a machine, with the delays of the wire.
const REPORTED_WITHIN: Duration = Duration::from_millis(1_500);
/// Time within which the alarms of a new state are shown.
const RAISED_WITHIN: Duration = Duration::from_millis(200);
/// Time limit for the HOLD command to a machine that is found moving, if it is reachable.
const HOLDS_WITHIN: Duration = Duration::from_secs(4);
/// Time limit of a transitional state, if nothing but the disk fails.
const LEADS_ON_WITHIN: Duration = Duration::from_secs(9);
/// States in which the cell shows that nothing moves.
const STANDS: [StateName; 4] = [StateName::Held, StateName::Stopped, StateName::Aborted, StateName::Complete];
const NAMES: [&str; 2] = ["cmm", "grinder"];

/// State that the cell showed from a moment on; none if nobody could see it.
#[derive(Clone, Copy, Debug)]
pub struct Shown {
    pub at: Instant,
    pub state: Option<StateName>,
    pub phase: Option<Phase>,
    /// Machines that are named as not having confirmed standstill.
    pub unconfirmed: [bool; 2],
    /// True if an alarm asks a person whether a machine is at rest, because the outcome of its job is unknown.
    pub asks_to_check: bool,
}

/// Evidence that a schedule leaves.
pub struct Evidence {
    pub began: Instant,
    pub job: u32,
    pub folder: PathBuf,
    pub log: Vec<Moment>,
    /// Actions of the CMM, if it is one by I++ DME.
    pub machine_events: Vec<(Instant, MachineEvent)>,
    /// Actions of the grinder, if it is one by LinuxCNC.
    pub rsh_events: Vec<(Instant, ControllerEvent)>,
    pub given: Vec<GivenOrder>,
    pub written: Vec<Recorded>,
    pub shown: Vec<Shown>,
    pub tally: Tally,
    pub wires: Traffic,
    /// Intervals in which something obstructed queries to the machines; none if that is possible at any time.
    pub hindered: Option<Vec<(Instant, Instant)>>,
    /// Height of the travel of the probe's centre above the highest target, in mm.
    pub clearance_mm: f64,
    /// True if the application of a machine can have frozen.
    pub freezes: bool,
    /// True if nothing fails except the disk, for a while.
    pub disk_alone: bool,
    /// True if machines report false values: only the machines themselves then know their position and motion.
    pub lies: bool,
    /// True if the run had the expected end, provided that only deaths of the program disturbed it.
    pub ended_well: bool,
    pub effects: u64,
}

impl Evidence {
    /// Returns all events, line by line.
    pub fn trace(&self) -> Vec<String> {
        let log = self.log.iter().map(|m| (m.at, format!("{} {:?}", NAMES[m.machine], m.what)));
        let written = self.written.iter().map(|w| (w.at, format!("record {}", w.payload)));
        let given = self.given.iter().map(|g| (g.answered, format!("{} {} {}", g.what, g.reason, g.accepted)));
        let shown = self.shown.iter().map(|s| (s.at, format!("shown {:?} {:?}", s.state, s.phase)));
        let sent = self
            .wires
            .sent
            .iter()
            .map(|s| (s.at, format!("{} is sent {:?} {}", NAMES[s.machine], s.command, s.frame.sequence)));
        let machine_events = self.machine_events.iter().map(|(at, event)| (*at, format!("cmm {event:?}")));
        let rsh_events =
            self.rsh_events.iter().map(|(at, event)| (*at, format!("grinder {:.180}", format!("{event:?}"))));
        let spoken = self.wires.lines.iter().map(|s| (s.at, format!("{} is told {}", NAMES[s.machine], s.line)));
        let mut lines: Vec<(Instant, String)> = log
            .chain(written)
            .chain(given)
            .chain(shown)
            .chain(sent)
            .chain(machine_events)
            .chain(rsh_events)
            .chain(spoken)
            .collect();
        lines.sort_by_key(|(at, _)| *at);
        // Journals and programs are in neighbouring folders.
        let home = self.folder.parent().unwrap_or(&self.folder).display().to_string();
        let line = |(at, what): (Instant, String)| format!("{:10.4} {}", self.seconds(at), what.replace(&home, "HOME"));
        lines.into_iter().map(line).collect()
    }

    pub fn seconds(&self, at: Instant) -> f64 {
        (at - self.began).as_secs_f64()
    }

    /// Returns the last state that the cell showed before a moment.
    pub fn shown_before(&self, at: Instant) -> Option<&Shown> {
        let next = self.shown.partition_point(|shown| shown.at < at);
        self.shown[..next].last()
    }

    /// Returns the state that the cell shows at a moment.
    fn shown_at(&self, at: Instant) -> Option<&Shown> {
        let next = self.shown.partition_point(|shown| shown.at <= at);
        self.shown[..next].last()
    }

    /// Returns the records of an event of a machine between two moments.
    fn events_between(
        &self,
        event: &str,
        machine: usize,
        from: Instant,
        to: Instant,
    ) -> impl Iterator<Item = &Recorded> {
        let of_it = move |w: &&Recorded| w.payload["event"] == event && w.payload["device"] == NAMES[machine];
        self.written.iter().filter(move |w| from <= w.at && w.at <= to).filter(of_it)
    }

    /// Returns the last START on record before a record, for the same machine.
    fn intent_before(&self, number: usize, machine: usize) -> Option<usize> {
        self.written[..number].iter().rposition(|w| is_intent(w, machine))
    }
}

/// Checks a schedule against every promise.
///
/// # Errors
///
/// Returns the first broken promise.
pub fn check(evidence: &Evidence) -> Result<(), String> {
    let (records, is_closed) = sound_record(evidence)?;
    intended_before(evidence)?;
    map_of_record(evidence, &records)?;
    begun_is_not_intended_again(evidence)?;
    if evidence.lies {
        answered_is_on_record(evidence, &records)?;
        let last = evidence.shown.iter().rev().find_map(|shown| shown.state);
        return if is_closed { Ok(()) } else { Err(format!("the run comes to no end; last it shows {last:?}")) };
    }
    began_once(evidence)?;
    said_of_starts_is_so(evidence)?;
    never_both(evidence)?;
    still_where_shown(evidence)?;
    held_when_it_holds(evidence)?;
    moved_by_nothing_that_stands(evidence)?;
    told_to_hold(evidence)?;
    strays_are_told_to_hold(evidence)?;
    aborted_at_once(evidence)?;
    waits_for_nothing_for_long(evidence)?;
    answered_is_on_record(evidence, &records)?;
    asked_as_it_should_be(evidence)?;
    touches::check(evidence)?;
    programs::check(evidence)?;
    if !evidence.ended_well {
        return Err("nothing went wrong but that the program died, and the run does not end as it should".to_owned());
    }
    // After the last fault, the run finishes.
    let last = evidence.shown.iter().rev().find_map(|shown| shown.state);
    if is_closed { Ok(()) } else { Err(format!("the run comes to no end; last it shows {last:?}")) }
}

/// Checks that the record is intact, and contains everything that was acknowledged.
fn sound_record(evidence: &Evidence) -> Result<(Vec<Value>, bool), String> {
    let verified = verify(&evidence.folder).map_err(|error| format!("the record is broken: {error}"))?;
    let reader = Reader::open(&evidence.folder).map_err(|error| error.to_string())?;
    let records: Vec<Value> =
        reader.records(0).map(|record| record.map(|r| r.value())).collect::<Result<_, _>>().unwrap();
    let mut left: BTreeMap<String, u64> = BTreeMap::new();
    records.iter().for_each(|payload| *left.entry(payload.to_string()).or_default() += 1);
    // A run that was started again has its own record.
    let first_of_run = evidence.written.iter().rposition(|w| w.payload["event"] == "start").unwrap_or(0);
    for recorded in evidence.written[first_of_run..].iter().filter(|w| w.payload.is_object()) {
        match left.get_mut(&recorded.payload.to_string()) {
            Some(count @ 1..) => *count -= 1,
            _ => return Err(format!("was acknowledged and is not on record: {}", recorded.payload)),
        }
    }
    Ok((records, verified.closed))
}

/// Returns true if a machine has forgotten a job that it began before any record had seen it: then nobody can know that
/// it began.
fn was_forgotten_unseen(evidence: &Evidence, began: &Moment) -> bool {
    let of_it = || evidence.log.iter().filter(|moment| moment.machine == began.machine && moment.at >= began.at);
    let forgot = of_it().find(|moment| matches!(moment.what, HandshakeEvent::Forgot));
    let Some(forgot) = forgot else { return false };
    let seen = |w: &Recorded| {
        let event = &w.payload;
        let at_work = event["outcome"] == "running" || event["outcome"] == "held";
        event["device"] == NAMES[began.machine]
            && (event["event"] == "started"
                || event["event"] == "progressed"
                || event["event"] == "reconciled" && at_work)
    };
    // A status that was in transit when the machine forgot arrives a moment later.
    let next_start = of_it().find(|moment| moment.at > began.at && matches!(moment.what, HandshakeEvent::Began { .. }));
    let until = next_start.map_or(forgot.at + Duration::from_secs(1), |next| next.at);
    !evidence.written.iter().any(|w| w.at >= began.at && w.at <= until && seen(w))
}

/// Checks that every START moves a machine once, and that every pass begins once.
fn began_once(evidence: &Evidence) -> Result<(), String> {
    let mut starts: BTreeSet<(usize, u32, u32, u16)> = BTreeSet::new();
    let mut passes = BTreeSet::new();
    for moment in &evidence.log {
        // A machine that was restarted counts from the beginning.
        if let HandshakeEvent::Rebooted { .. } | HandshakeEvent::Forgot = moment.what {
            starts.retain(|(machine, ..)| *machine != moment.machine);
        }
        let HandshakeEvent::Began { start, job, cycle } = moment.what else { continue };
        let (machine, at) = (NAMES[moment.machine], evidence.seconds(moment.at));
        // Numbers repeat after the counter has wrapped; the job identifies a START as well.
        if !starts.insert((moment.machine, start, job, cycle)) {
            return Err(format!("the {machine} carried out START {start} twice, again at {at:.3} s"));
        }
        if was_forgotten_unseen(evidence, moment) {
            continue;
        }
        if moment.machine == 1 && !passes.insert((job, cycle)) {
            return Err(format!("pass {cycle} of job {job} was begun twice, again at {at:.3} s"));
        }
    }
    Ok(())
}

/// Checks that every job that a machine begins was on record before.
fn intended_before(evidence: &Evidence) -> Result<(), String> {
    for moment in &evidence.log {
        let HandshakeEvent::Began { start, job, cycle } = moment.what else { continue };
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

/// Checks that the payload in force when a machine begins is the one in the record.
fn map_of_record(evidence: &Evidence, records: &[Value]) -> Result<(), String> {
    let mut in_force: [BTreeMap<u16, [u8; 32]>; 2] = Default::default();
    for moment in &evidence.log {
        match &moment.what {
            HandshakeEvent::Taken { kind, identity } => drop(in_force[moment.machine].insert(*kind, *identity)),
            HandshakeEvent::Rebooted { .. } | HandshakeEvent::Forgot => in_force[moment.machine].clear(),
            HandshakeEvent::Began { job, cycle, .. } if *job == evidence.job => {
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

/// Returns the state of each machine from moment to moment.
fn states(evidence: &Evidence) -> Vec<(Instant, [State; 2])> {
    let mut now = [State::Idle; 2];
    let mut states = vec![(evidence.began, now)];
    for moment in &evidence.log {
        if let HandshakeEvent::Changed { to, .. } = moment.what {
            now[moment.machine] = to;
            states.push((moment.at, now));
        }
    }
    states
}

/// Checks that the two machines never move at the same time by an order of the program.
fn never_both(evidence: &Evidence) -> Result<(), String> {
    let (mut now, mut strays) = ([State::Idle; 2], [false; 2]);
    for moment in &evidence.log {
        match moment.what {
            HandshakeEvent::Strayed => strays[moment.machine] = true,
            HandshakeEvent::Changed { to, .. } => {
                now[moment.machine] = to;
                strays[moment.machine] &= to == State::Execute;
            }
            _ => continue,
        }
        if now == [State::Execute; 2] && strays == [false; 2] {
            return Err(format!("both machines move at {:.3} s", evidence.seconds(moment.at)));
        }
    }
    Ok(())
}

/// Motion of a machine: start, end, and whether nobody had ordered it.
struct Motion {
    machine: usize,
    from: Instant,
    to: Instant,
    strayed: bool,
}

fn motions(evidence: &Evidence) -> Vec<Motion> {
    let last = evidence.log.last().map_or(evidence.began, |moment| moment.at) + Duration::from_secs(60);
    let mut motions: Vec<Motion> = Vec::new();
    let mut strayed = [false; 2];
    for moment in &evidence.log {
        let (machine, from) = (moment.machine, moment.at);
        match moment.what {
            HandshakeEvent::Strayed => strayed[machine] = true,
            HandshakeEvent::Changed { to: State::Execute, .. } => {
                motions.push(Motion { machine, from, to: last, strayed: std::mem::take(&mut strayed[machine]) });
            }
            HandshakeEvent::Changed { from: State::Execute, .. } => {
                let open = motions.iter_mut().rfind(|motion| motion.machine == machine);
                open.expect("it moved").to = moment.at;
            }
            _ => {}
        }
    }
    motions
}

/// Checks that nothing moves while the cell shows standstill, except a machine that it names as not having confirmed
/// that it is at rest: after an abort, and in a held cell a CMM on I++ DME, which ends the motion that it was told also
/// if it hears nothing more. Nobody watches for stray motions after the run is over, or in the moment before.
fn still_where_shown(evidence: &Evidence) -> Result<(), String> {
    let motions = motions(evidence);
    // Machines on the other wires hold by themselves when they hear nothing.
    let moves_on_alone = [!evidence.machine_events.is_empty(), false];
    for (k, shown) in evidence.shown.iter().enumerate() {
        let Some(state) = shown.state.filter(|state| STANDS.contains(state)) else { continue };
        let next = evidence.shown.get(k + 1).map(|next| next.at);
        let over = state != StateName::Held;
        for motion in &motions {
            let (from, to) =
                (motion.from.max(shown.at + STANDS_WITHIN), next.map_or(motion.to, |at| motion.to.min(at)));
            let may_be_named = state == StateName::Aborted || moves_on_alone[motion.machine];
            let is_named = may_be_named && shown.unconfirmed[motion.machine];
            let is_unseen = over && motion.strayed && motion.from + FOUND_WITHIN > shown.at;
            if from < to && !is_named && !is_unseen {
                let (name, at) = (NAMES[motion.machine], evidence.seconds(from));
                let since = evidence.seconds(shown.at);
                return Err(format!("the {name} moves at {at:.3} s, and the cell shows {state} since {since:.3} s"));
            }
        }
    }
    Ok(())
}

/// Checks that no transitional state lasts if only the disk fails: the cell does not wait for a command that did not
/// reach the record.
fn waits_for_nothing_for_long(evidence: &Evidence) -> Result<(), String> {
    const LEADS_ON: [StateName; 6] = [
        StateName::Holding,
        StateName::Unholding,
        StateName::Suspending,
        StateName::Unsuspending,
        StateName::Stopping,
        StateName::Aborting,
    ];
    for pair in evidence.shown.windows(2).filter(|_| evidence.disk_alone) {
        let [shown, next] = pair else { continue };
        let Some(state) = shown.state.filter(|state| LEADS_ON.contains(state)) else { continue };
        if next.at - shown.at > LEADS_ON_WITHIN {
            let (at, lasts) = (evidence.seconds(shown.at), (next.at - shown.at).as_secs_f64());
            return Err(format!("the cell shows {state} {:?} from {at:.3} s on for {lasts:.1} s", shown.phase));
        }
    }
    Ok(())
}

/// Checks that a cell that holds shows Held only after the machine reports that it holds. There are two exceptions. An
/// alarm asks a person to check a machine that gives no answer. The machine was held, and a person resumed it at its
/// panel while the report of its standstill was on the wire.
fn held_when_it_holds(evidence: &Evidence) -> Result<(), String> {
    let states = states(evidence);
    for (k, pair) in evidence.shown.windows(2).enumerate() {
        let [before, now] = pair else { continue };
        if (before.state, now.state) != (Some(StateName::Holding), Some(StateName::Held)) {
            continue;
        }
        let Some(device) = before.phase.and_then(Phase::moving_device) else { continue };
        let soon = evidence.shown[k + 1..].iter().take_while(|shown| shown.at <= now.at + RAISED_WITHIN);
        if soon.clone().any(|shown| shown.asks_to_check) {
            continue;
        }
        let at = states.partition_point(|(at, _)| *at <= now.at);
        let of_it = |k: usize| (states[k].0, states[k].1[device as usize]);
        let began = (0..at).rev().take_while(|k| of_it(*k).1 == State::Execute).last();
        let was_held =
            began.is_some_and(|k| k > 0 && of_it(k - 1).1 == State::Held && of_it(k).0 + REPORTED_WITHIN > now.at);
        if of_it(at - 1).1 == State::Execute && !was_held {
            return Err(format!("the {device} moves as it is shown to be held at {:.3} s", evidence.seconds(now.at)));
        }
    }
    Ok(())
}

/// Checks that no command that moves a machine leaves the program while the cell shows standstill.
fn moved_by_nothing_that_stands(evidence: &Evidence) -> Result<(), String> {
    let mut numbers = BTreeSet::new();
    let moves = evidence.wires.sent.iter().filter(|sent| matches!(sent.command, Command::Start | Command::Resume));
    for sent in moves {
        // A rewrite is the same command, with the same decision.
        let is_first = numbers.insert((sent.machine, sent.frame.owner, sent.frame.epoch, sent.frame.sequence));
        let Some(last) = evidence.shown_before(sent.at).filter(|_| is_first) else { continue };
        if last.state.is_some_and(|state| state == StateName::Suspended || STANDS.contains(&state)) {
            let (machine, at) = (NAMES[sent.machine], evidence.seconds(sent.at));
            return Err(format!(
                "{:?} {} is sent to the {machine} at {at:.3} s, and the cell shows {:?}",
                sent.command, sent.frame.sequence, last.state
            ));
        }
    }
    Ok(())
}

/// Checks that the cell, if it holds, sends HOLD to a job that was out of sight and is found running.
fn told_to_hold(evidence: &Evidence) -> Result<(), String> {
    for (k, name) in NAMES.iter().enumerate() {
        let found =
            evidence.events_between("reconciled", k, evidence.began, evidence.began + Duration::from_secs(86_400));
        for found in found.filter(|found| found.payload["outcome"] == "running") {
            let by = found.at + HOLDS_WITHIN;
            let holds = |shown: &Shown| shown.state == Some(StateName::Holding);
            let from = evidence.shown.partition_point(|shown| shown.at <= found.at);
            let still = evidence.shown_at(found.at).is_some_and(holds)
                && evidence.shown[from..].iter().take_while(|shown| shown.at <= by).all(holds);
            let told = evidence.wires.sent.iter().any(|sent| {
                let makes_safe = matches!(sent.command, Command::Hold | Command::Stop | Command::Abort);
                sent.machine == k && makes_safe && found.at <= sent.at && sent.at <= by
            });
            if still && !told && evidence.events_between("link_lost", k, found.at, by).next().is_none() {
                let at = evidence.seconds(found.at);
                return Err(format!("the {name} is found to run at {at:.3} s, and is not told to hold"));
            }
        }
    }
    Ok(())
}

/// Checks that the cell sends HOLD to a machine that begins to move without an order while the cell is at a standstill,
/// if the machine is reachable and visible.
fn strays_are_told_to_hold(evidence: &Evidence) -> Result<(), String> {
    let Some(hindered) = evidence.hindered.as_ref().filter(|_| !evidence.freezes) else { return Ok(()) };
    for (number, moment) in
        evidence.log.iter().enumerate().filter(|(_, moment)| matches!(moment.what, HandshakeEvent::Strayed))
    {
        let (machine, by) = (moment.machine, moment.at + FOUND_WITHIN);
        let is_hindered = hindered.iter().any(|(from, to)| *from <= by && moment.at <= *to + RECOVERS_WITHIN);
        let goes_on = !evidence.log[number..].iter().any(|next| {
            next.machine == machine
                && next.at <= by
                && matches!(&next.what, HandshakeEvent::Changed { from: State::Execute, .. })
        });
        let from = evidence.shown.partition_point(|shown| shown.at <= moment.at).saturating_sub(1);
        let stands = |shown: &Shown| shown.state == Some(StateName::Held);
        let stood = evidence.shown[from..].iter().take_while(|shown| shown.at <= by).all(stands);
        if !is_hindered && goes_on && stood {
            let (name, at) = (NAMES[machine], evidence.seconds(moment.at));
            return Err(format!("the {name} moves without an order from {at:.3} s on, and is not told to hold"));
        }
    }
    Ok(())
}

/// Checks that an abort is sent at once to a moving machine, whatever the disk does, if nothing obstructs it.
fn aborted_at_once(evidence: &Evidence) -> Result<(), String> {
    let Some(hindered) = &evidence.hindered else { return Ok(()) };
    let by_lines = [!evidence.machine_events.is_empty(), !evidence.rsh_events.is_empty()];
    for abort in evidence.given.iter().filter(|given| given.what == "abort" && given.done) {
        let by = abort.at + ABORTS_WITHIN;
        let is_hindered = hindered.iter().any(|(from, to)| *from <= by && abort.at <= *to + RECOVERS_WITHIN);
        // A restarted program first has to connect to the machines.
        let lives = evidence.shown.iter().rposition(|shown| shown.at <= abort.at && shown.state.is_none());
        let has_met = lives.is_none_or(|end| evidence.shown[end].at + RECOVERS_WITHIN < abort.at);
        let met = |k: usize| has_met || by_lines[k];
        for (k, name) in NAMES.iter().enumerate().filter(|(k, _)| abort.moved[*k] && !is_hindered && met(*k)) {
            let began = evidence.log.iter().rfind(|moment| {
                moment.machine == k
                    && moment.at <= abort.at
                    && match &moment.what {
                        HandshakeEvent::Began { .. } | HandshakeEvent::Strayed => true,
                        // For a machine without jobs, the change of state shows the motion.
                        HandshakeEvent::Changed { to, .. } => by_lines[k] && *to == State::Execute,
                        _ => false,
                    }
            });
            let since = began.map_or(evidence.began, |moment| moment.at);
            let aborts = |sent: &&Sent| sent.machine == k && sent.command == Command::Abort;
            if !evidence.wires.sent.iter().filter(aborts).any(|sent| since <= sent.at && sent.at <= by) {
                return Err(format!(
                    "no abort leaves for the {name} within 0.1 s of {:.3} s",
                    evidence.seconds(abort.at)
                ));
            }
        }
    }
    Ok(())
}

/// Checks that a pass that a machine has begun is never intended again. The check does not rely on the machine to
/// refuse it.
fn begun_is_not_intended_again(evidence: &Evidence) -> Result<(), String> {
    for began in evidence.log.iter().filter(|moment| moment.machine == 1) {
        let HandshakeEvent::Began { start, job, cycle } = began.what else { continue };
        if was_forgotten_unseen(evidence, began) {
            continue;
        }
        let again = evidence.written.iter().find(|w| {
            w.at > began.at
                && is_intent(w, 1)
                && w.payload["cycle"] == cycle
                && w.payload["intent"]["job"] == job
                && w.payload["intent"]["start_sequence"] != start
        });
        if let Some(again) = again {
            let [begun, at] = [began.at, again.at].map(|at| evidence.seconds(at));
            return Err(format!("pass {cycle} has begun at {begun:.3} s, and is to be started again at {at:.3} s"));
        }
    }
    Ok(())
}

/// Checks that a START that is on record as not taken has moved nothing, and never does.
fn said_of_starts_is_so(evidence: &Evidence) -> Result<(), String> {
    for (number, said) in evidence.written.iter().enumerate() {
        let event = &said.payload;
        let refused = event["event"] == "refused" && event["what"] == "start";
        let not_started = event["event"] == "reconciled" && event["outcome"] == "not_started";
        if !refused && !not_started {
            continue;
        }
        let machine = usize::from(event["device"] == NAMES[1]);
        let Some(intent) = evidence.intent_before(number, machine) else { continue };
        let (intended, rest) = (&evidence.written[intent], &evidence.written[intent + 1..]);
        if not_started && event["cycle"] != intended.payload["cycle"] {
            // No START of this cycle was ever on record.
            continue;
        }
        let meant = &intended.payload["intent"];
        let moved = evidence.log.iter().filter(|moment| moment.machine == machine && moment.at >= intended.at);
        for moment in moved {
            let HandshakeEvent::Began { start, job, cycle } = moment.what else { continue };
            let is_it = meant["start_sequence"] == start && meant["job"] == job && intended.payload["cycle"] == cycle;
            // A machine that was restarted counts from the beginning: a later START can have the same number.
            let is_later = || {
                rest.iter().any(|w| {
                    is_intent(w, machine) && w.at <= moment.at && w.payload["intent"]["start_sequence"] == start
                })
            };
            // A machine that has forgotten its job reports that it never began. The record contains that report, and no
            // conclusion follows from it.
            let forgot = |then: &&Moment| matches!(then.what, HandshakeEvent::Forgot) && then.machine == machine;
            let is_a_lie = evidence.log.iter().filter(forgot).any(|then| moment.at <= then.at && then.at <= said.at);
            if is_it && !is_later() && !is_a_lie {
                let [at, told] = [moment.at, said.at].map(|at| evidence.seconds(at));
                return Err(format!(
                    "the {} begins by START {start} at {at:.3} s, of which the record says at {told:.3} s that it was not taken",
                    NAMES[machine]
                ));
            }
        }
    }
    Ok(())
}

/// Returns true if a record is the intent of a START of a machine.
pub fn is_intent(recorded: &Recorded, machine: usize) -> bool {
    recorded.payload["command"] == "start_machine" && recorded.payload["device"] == NAMES[machine]
}

/// Checks that there is one query at a time, on a connection without waiting commands and with an established machine,
/// and that the program never fails.
fn asked_as_it_should_be(evidence: &Evidence) -> Result<(), String> {
    if let Some((at, what)) = evidence.wires.wrong.first() {
        return Err(format!("at {:.3} s {what}", evidence.seconds(*at)));
    }
    match evidence.written.iter().find(|w| w.payload["event"] == "station_failed") {
        Some(failed) => Err(format!("at {:.3} s the program fails: {}", evidence.seconds(failed.at), failed.payload)),
        None => Ok(()),
    }
}

/// Checks that an accepted order is on record, and was so before its answer.
fn answered_is_on_record(evidence: &Evidence, records: &[Value]) -> Result<(), String> {
    for given in evidence.given.iter().filter(|given| given.accepted) {
        let names = |payload: &Value| match given.what {
            "clear" => payload["event"] == "clear_confirmed",
            _ => payload["reason"] == given.reason || payload["evidence"] == given.reason,
        };
        let in_time = evidence.written.iter().any(|w| names(&w.payload) && w.at <= given.answered);
        let stands = records.iter().any(names) || evidence.job > 1;
        if !in_time || !stands {
            let at = evidence.seconds(given.answered);
            return Err(format!("{} ({}) was answered at {at:.3} s and is not on record", given.what, given.reason));
        }
    }
    Ok(())
}
