//! Sequence of the statuses of a cell that are published: each status of an active run, the end of each run, and between
//! the runs that there is none.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use regrind_control::{PartVerdict, Snapshot};
use regrind_live::{CellStatus, EndedRun, RunStatus, StatusSender, TimedStatus};

use super::super::cell_monitor::{CellMonitor, live_runs, name};
use super::run_ends::{RunEnd, RunEnds};

/// Time between two looks for a run.
const ROUND: Duration = Duration::from_secs(1);
/// Time for which the end state of a run is published at least, before another run.
const MIN_END_STATE: Duration = Duration::from_millis(250);
/// Time for which the end state of a run is published before the message that no run is on.
const END_STATE: Duration = Duration::from_secs(1);

/// Source of the published statuses.
pub(super) struct Follower {
    runs: PathBuf,
    look: CellMonitor,
    ends: Arc<Mutex<RunEnds>>,
    to: StatusSender,
    /// Status that was sent last; `None` at the begin.
    sent: Option<TimedStatus>,
    /// Last run whose end was published.
    last_run: Option<EndedRun>,
    /// True if the list of published ends cannot be written.
    disk_fails: bool,
}

pub(super) enum Never {}

impl Follower {
    pub(super) fn new(runs: &Path, ends: RunEnds, to: StatusSender) -> Self {
        let ends = Arc::new(Mutex::new(ends));
        let (runs, look) = (runs.to_owned(), CellMonitor::new(runs));
        Self { runs, look, ends, to, sent: None, last_run: None, disk_fails: false }
    }

    /// Sends every status of the cell to the publishers. If a run is active, sends each status of this run until the run
    /// no longer answers. Between runs, reads the status of the cell every [`ROUND`]. Sends an unchanged status again,
    /// so that the publishers know that it still holds. Never returns.
    pub(super) async fn follow(&mut self) -> Never {
        loop {
            self.publish_once().await;
            let live = live_runs(&self.runs).next();
            match live {
                Some(run) => self.watch(&run).await,
                None => tokio::time::sleep(ROUND).await,
            }
        }
    }

    /// Sends the ends of runs that were not published yet, and then the present status.
    pub(super) async fn publish_once(&mut self) {
        let look = std::mem::replace(&mut self.look, CellMonitor::new(&self.runs));
        self.look = look.poll_in_background().await;
        // After the look: no end that the look has seen is missed.
        self.publish_ends().await;
        let is_over = match &self.look.status().run_status {
            RunStatus::Active { run, .. } | RunStatus::Unresponsive { run } => self.ends().is_published(run),
            RunStatus::NoRun | RunStatus::ProgramGone { .. } => false,
        };
        let is_new = self.sent.as_ref().is_none_or(|sent| sent.status.run_status != self.look.status().run_status);
        if !is_over && (is_new || self.look.is_confirmed()) {
            self.send_look();
        }
    }

    /// Sends each status of the active run in the folder `run`. Returns when the run ends or no longer answers.
    async fn watch(&mut self, run: &Path) {
        let Ok(mut watch) = regrind_control::watch(run).await else { return tokio::time::sleep(ROUND).await };
        // An earlier run ended before this one began.
        self.publish_ends().await;
        while let Ok(Some(snapshot)) = watch.next().await {
            self.look.set_run_status(RunStatus::Active { run: name(run), snapshot: Box::new(snapshot) });
            self.send_look();
        }
    }

    /// Sends the status of the last look.
    fn send_look(&mut self) {
        let seen = self.look.status();
        let ended_ms = |run: &EndedRun| run.ended_ms;
        let last_run = match &self.last_run {
            Some(last) if seen.last_run.as_ref().map(ended_ms) <= Some(last.ended_ms) => Some(last.clone()),
            _ => seen.last_run.clone(),
        };
        self.send(CellStatus { last_run, ..seen.clone() }, now_ms());
    }

    /// Sends `status`, which holds at the time `at_ms`, in milliseconds since 1970. No status is earlier than the one
    /// before.
    fn send(&mut self, status: CellStatus, at_ms: u64) {
        let changed = self.sent.as_ref().is_none_or(|sent| sent.status != status);
        let earliest = self.sent.as_ref().map_or(0, |sent| sent.at_ms + u64::from(changed));
        let status = TimedStatus { status, at_ms: at_ms.max(earliest) };
        self.to.send(status.clone());
        self.sent = Some(status);
    }

    /// Sends the end state of each run whose end was not published yet: Complete, Stopped or Aborted.
    async fn publish_ends(&mut self) {
        let ends = self.ends.clone();
        let found = tokio::task::spawn_blocking(move || locked(&ends).find()).await.unwrap_or_default();
        if self.sent.is_none() {
            let last_run = self.ends().last().cloned();
            self.last_run.clone_from(&last_run);
            if let Some(first) = found.first() {
                // The publishers compare with it: all that the ends tell is a change.
                let at_ms = first.run.ended_ms.saturating_sub(1);
                self.send(CellStatus { last_run, ..CellStatus::default() }, at_ms);
            }
        }
        for end in found {
            let run = end.run.clone();
            self.send_end(end);
            let written = self.ends().published(&run);
            if let Err(error) = &written
                && !self.disk_fails
            {
                eprintln!("tell: the end of {} is possibly published again later: {error}", run.run);
            }
            self.disk_fails = written.is_err();
            self.last_run = Some(run);
            tokio::time::sleep(MIN_END_STATE).await;
        }
        let mut shown = MIN_END_STATE;
        while shown < END_STATE && self.shows_end() && live_runs(&self.runs).next().is_none() {
            tokio::time::sleep(MIN_END_STATE).await;
            shown += MIN_END_STATE;
        }
    }

    fn shows_end(&self) -> bool {
        self.sent.as_ref().is_some_and(|sent| end_state(&sent.status.run_status).is_some())
    }

    fn send_end(&mut self, mut end: RunEnd) {
        let live = self.sent.as_ref().and_then(|sent| match &sent.status.run_status {
            RunStatus::Active { run, snapshot } if *run == end.run.run => Some(snapshot),
            _ => None,
        });
        let (snapshot, from_record) = match live {
            Some(live) if is_end(live) => (live.clone(), false),
            live => {
                if let Some(live) = live {
                    end.keep_rows_of(live);
                }
                (Box::new(end.snapshot), true)
            }
        };
        let at_ms = end.run.ended_ms;
        let run_status = RunStatus::Active { run: end.run.run.clone(), snapshot };
        self.send(CellStatus { run_status, from_record, last_run: Some(end.run) }, at_ms);
    }

    fn ends(&self) -> MutexGuard<'_, RunEnds> {
        locked(&self.ends)
    }
}

fn locked(ends: &Mutex<RunEnds>) -> MutexGuard<'_, RunEnds> {
    ends.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns true if the run of `snapshot` is over.
fn is_end(snapshot: &Snapshot) -> bool {
    PartVerdict::from_state(snapshot.state) != PartVerdict::Open
}

fn end_state(status: &RunStatus) -> Option<&Snapshot> {
    match status {
        RunStatus::Active { snapshot, .. } => Some(&**snapshot).filter(|snapshot| is_end(snapshot)),
        _ => None,
    }
}

fn now_ms() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}
