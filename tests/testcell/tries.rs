//! One run that another terminal holds, resumes and aborts at a chosen moment, with the results.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use regrind::cell::Ending;
use regrind::drive::{Drive, Request};

use crate::rig::{CMM, GRINDER, PATIENCE, Ready, Rig, event, order, until, words};

/// Moment of a run, as the events that lead to it.
pub struct Moment {
    /// Name of the moment.
    pub name: &'static str,
    /// Events to wait for, each with its number of occurrences.
    pub after: &'static [(&'static str, usize)],
    /// True if the loading of the part is confirmed automatically.
    pub loaded: bool,
}

const fn moment(name: &'static str, after: &'static [(&'static str, usize)]) -> Moment {
    Moment { name, after, loaded: true }
}

/// All phases, each with the event that leads to it.
pub const MOMENTS: [Moment; 15] = [
    Moment { name: "load", after: &[("connected", 2)], loaded: false },
    moment("grind, send", &[("load_confirmed", 1)]),
    moment("grind, prepare", &[("pass_loaded", 1)]),
    moment("grind, start", &[("prepared", 1)]),
    moment("grind, run", &[("started", 1), ("progressed", 1)]),
    moment("grind, end", &[("ended", 1)]),
    moment("transfer", &[("acknowledged", 1)]),
    moment("measure, send", &[("acknowledged", 1), ("cleared", 1)]),
    moment("measure, prepare", &[("plan_loaded", 1)]),
    moment("measure, start", &[("prepared", 2)]),
    moment("measure, run", &[("started", 2)]),
    moment("measure, collect", &[("ended", 2)]),
    moment("register", &[("acknowledged", 2)]),
    moment("judge and compensate", &[("registered", 1)]),
    moment("grind again", &[("compensated", 1)]),
];

/// Result of one try. Times count from before the order was written.
#[derive(Debug, Default)]
pub struct Tried {
    /// State of the cell after the first order.
    pub state: String,
    /// Time until the HOLD is on the wire; `None` if no machine moved.
    pub hold: Option<Duration>,
    /// Time until the HOLD is answered.
    pub hold_answered: Option<Duration>,
    /// Time until the RESUME is on the wire; `None` if no machine was held.
    pub resume: Option<Duration>,
    /// Time until the RESUME is answered.
    pub resume_answered: Option<Duration>,
    /// Time until the ABORT is on each wire.
    pub abort: Vec<Duration>,
    /// Time until the ABORT is answered.
    pub abort_answered: Duration,
    /// Commands that arrived at a machine after its ABORT, other than ABORT and the RELEASE that gives the machine
    /// back.
    pub after_abort: Vec<u16>,
}

/// Starts a run, holds and resumes it at a moment if `hold` is set, aborts it, and follows it to its end. Returns the
/// results and the run folder.
pub async fn attempt(rig: &mut Rig, moment: &Moment, hold: bool) -> (Tried, PathBuf) {
    let ready = rig.next(moment.loaded);
    attempt_with(rig, ready, moment, hold).await
}

/// Does the same as [`attempt`] with a run that is prepared already.
pub async fn attempt_with(rig: &Rig, ready: Ready, moment: &Moment, hold: bool) -> (Tried, PathBuf) {
    let Ready { run, cmm, grinder, mut notices, folder } = ready;
    let (drive, _orders) = Drive::new(run, cmm, grinder).unwrap();
    let running = tokio::spawn(drive.run());
    for (name, times) in moment.after {
        event(&mut notices, name, *times).await;
    }
    let mut tried = Tried::default();
    if hold {
        hold_and_resume(rig, &folder, &mut tried).await;
    }
    let (reply, began, took) = order(&folder, Request::Abort { reason: "a try".into() }).await;
    assert!(reply.accepted, "{}: {reply:?}", moment.name);
    tried.abort_answered = took;
    if !hold {
        tried.state = reply.message;
    }
    let ending = tokio::time::timeout(PATIENCE, running).await.expect("it ends").unwrap();
    assert!(matches!(ending, Ending::Aborted { confirmed: true, .. }), "{}: {ending:?}", moment.name);
    for machine in [CMM, GRINDER] {
        let at = rig.command_at(machine, 7, began).expect("ABORT came to both machines");
        tried.abort.push(at - began);
        let came = rig.came[machine].lock().unwrap();
        let later = came.iter().filter(|c| c.at > at).filter_map(|c| c.command);
        tried.after_abort.extend(later.filter(|command| ![7, 10].contains(command)));
    }
    (tried, folder)
}

async fn hold_and_resume(rig: &Rig, folder: &Path, tried: &mut Tried) {
    let (reply, began, took) = order(folder, Request::Hold { reason: "a try".into(), state_number: None }).await;
    assert!(reply.accepted, "{reply:?}");
    tried.hold_answered = Some(took);
    until(folder, |words| words.starts_with("Held")).await;
    tried.hold = [CMM, GRINDER].iter().find_map(|m| rig.command_at(*m, 4, began)).map(|at| at - began);
    tried.state = words(folder).await;
    let began = Instant::now();
    let (reply, began_order, took) =
        order(folder, Request::Resume { reason: "a try".into(), state_number: None }).await;
    assert!(reply.accepted, "{reply:?}, {began:?}");
    tried.resume_answered = Some(took);
    if reply.message.starts_with("Unholding") {
        until(folder, |words| !words.starts_with("Unholding")).await;
        tried.resume =
            [CMM, GRINDER].iter().find_map(|m| rig.command_at(*m, 5, began_order)).map(|at| at - began_order);
        assert!(tried.resume.is_some(), "a held machine was told to go on");
    }
}
