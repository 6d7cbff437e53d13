//! Status of the cell whose runs are in a folder: the active run, an interrupted run, and the result of the last run.
//! `regrind tell` and `regrind ship` publish this status.
//!
//! The current run is the one with the newest record. The time of the folder does not count, because anybody can read,
//! copy or create a folder.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use regrind::drive::{Request, is_live};
use regrind::journal::{Reader, Stamp, has_record, is_driven, stamp};
use regrind::record::{Begin, RunContent};
use regrind::report::{RunResult, RunSummary, run_summary};
use regrind_live::{CellStatus, EndedRun, RunStatus};

use super::super::control;

/// Time for which a run may give no answer, for example while it starts or ends. After this time its status is
/// `Unresponsive`.
const GRACE: Duration = Duration::from_secs(5);

/// Status of the cell, updated by repeated reading of the runs in a folder.
pub(super) struct CellMonitor {
    runs: PathBuf,
    status: CellStatus,
    /// Run that does not answer, and the time of its first missing answer.
    silent: Option<(PathBuf, Instant)>,
    /// Time of the last record of each run, with the stamp of its files when it was read. `None` for the record of a
    /// recovery, which is not a run of a part.
    known: HashMap<PathBuf, (Stamp, Option<Timestamp>)>,
    /// Run whose summary was read last, with the stamp of its files at that time. While the stamp is unchanged, the run
    /// is not read again.
    settled: Option<(PathBuf, Stamp)>,
}

impl CellMonitor {
    pub(super) fn new(runs: &Path) -> Self {
        Self {
            runs: runs.to_owned(),
            status: CellStatus::default(),
            silent: None,
            known: HashMap::new(),
            settled: None,
        }
    }

    /// Updates the status of the cell and returns it. If a run is active, asks this run. Otherwise, reads the records
    /// of the runs.
    ///
    /// Keeps the last known status if the records cannot be read at the moment, or if the run does not answer. If the
    /// run has not answered for more than 5 s, the status becomes `Unresponsive`.
    pub(super) fn poll(&mut self) -> &CellStatus {
        let live = live_runs(&self.runs).next();
        match live {
            Some(run) => match regrind_control::send_request(&run, &Request::Status) {
                Ok(reply) => {
                    self.silent = None;
                    self.status.run_status = RunStatus::Active { run: name(&run), snapshot: Box::new(reply.status) };
                }
                Err(_) => self.does_not_answer(run),
            },
            None => self.update_from_records(),
        }
        &self.status
    }

    /// Calls [`CellMonitor::poll`] on a separate thread, and returns the monitor with the new status. The calling task
    /// can continue meanwhile, even if a journal is long or a run does not answer. If the thread panics, returns a new
    /// monitor without a status.
    pub(super) async fn poll_in_background(mut self) -> Self {
        let runs = self.runs.clone();
        let looked = tokio::task::spawn_blocking(move || {
            self.poll();
            self
        });
        looked.await.unwrap_or_else(|_| Self::new(&runs))
    }

    /// Returns the status of the cell that was last read or set. Does not read it again.
    pub(super) fn status(&self) -> &CellStatus {
        &self.status
    }

    /// Returns true if the status holds now. Returns false if a run gives no answer for a short time, and the status is
    /// the last known one.
    pub(super) fn is_confirmed(&self) -> bool {
        self.silent.is_none() || matches!(self.status.run_status, RunStatus::Unresponsive { .. })
    }

    /// Stores `now` as the status of the run. The caller has received this status from the active run.
    pub(super) fn set_run_status(&mut self, now: RunStatus) {
        (self.status.run_status, self.silent) = (now, None);
    }

    fn does_not_answer(&mut self, run: PathBuf) {
        let since = match self.silent.take() {
            Some((silent, since)) if silent == run => since,
            _ => Instant::now(),
        };
        if since.elapsed() > GRACE {
            self.status.run_status = RunStatus::Unresponsive { run: name(&run) };
        }
        self.silent = Some((run, since));
    }

    /// Updates the status of the cell from the records in the folder of runs. Called when no run answers at its control
    /// socket: a run is starting or ending, was interrupted, or has ended.
    fn update_from_records(&mut self) {
        let folders: Vec<PathBuf> = control::folders(&self.runs).collect();
        self.known.retain(|run, _| folders.contains(run));
        if folders.is_empty() {
            (self.status, self.silent) = (CellStatus::default(), None);
            return;
        }
        if let Some(begins) = folders.iter().find(|run| !has_record(run) && is_driven(run)) {
            return self.does_not_answer(begins.clone());
        }
        let last = folders.iter().filter_map(|run| Some((self.last_recorded(run)?, run))).max();
        let Some((_, run)) = last else {
            // A folder without files is not a run. The state of an unreadable run is unknown.
            match folders.iter().find(|run| has_record(run) && !self.known.contains_key(*run)) {
                Some(run) if is_driven(run) => self.does_not_answer(run.clone()),
                Some(run) => {
                    (self.status.run_status, self.silent) =
                        (RunStatus::ProgramGone { run: name(run), machines_within: false }, None)
                }
                None => (self.status.run_status, self.silent) = (RunStatus::NoRun, None),
            }
            return;
        };
        let at = stamp(run);
        if self.settled.as_ref().is_some_and(|(settled, then)| settled == run && *then == at)
            && !matches!(self.status.run_status, RunStatus::Active { .. } | RunStatus::Unresponsive { .. })
        {
            return;
        }
        match run_summary(run) {
            Ok(summary) if summary.ended.is_some() => {
                let last_run = ended_run(run, &summary);
                self.status = CellStatus { run_status: RunStatus::NoRun, last_run, ..CellStatus::default() };
            }
            Ok(_) if is_driven(run) => return self.does_not_answer(run.clone()),
            Ok(RunSummary { machines_within, .. }) => {
                self.status.run_status = RunStatus::ProgramGone { run: name(run), machines_within }
            }
            // The record cannot be read at the moment.
            Err(_) => return,
        }
        (self.settled, self.silent) = (Some((run.clone(), at)), None);
    }

    /// Returns the time of the last record of the run in the folder `run`. Returns `None` if the folder cannot be read,
    /// has no record, or contains the record of a recovery, which is not a run of a part.
    fn last_recorded(&mut self, run: &Path) -> Option<Timestamp> {
        let at = stamp(run);
        if let Some((_, last)) = self.known.get(run).filter(|(then, _)| *then == at) {
            return *last;
        }
        // Reading does not create a journal.
        let reader = Reader::open(run).ok()?;
        let first = reader.records(0).next()?.ok()?;
        let last = reader.last().ok()??.utc.parse().ok()?;
        let is_recovery = Begin::<RunContent>::read(&first).is_some_and(|begin| begin.content.is_recovery());
        let last = (!is_recovery).then_some(last);
        self.known.insert(run.to_owned(), (at, last));
        last
    }
}

/// Returns the end of the run in the folder `run` with the summary `summary`. Returns `None` if the record has no end, or
/// is that of a recovery.
pub(super) fn ended_run(run: &Path, summary: &RunSummary) -> Option<EndedRun> {
    let ended: Timestamp = summary.ended.as_ref()?.parse().ok()?;
    let accepted = match summary.result {
        RunResult::Open | RunResult::Recovery => return None,
        result => result == RunResult::Accepted,
    };
    Some(EndedRun {
        run: name(run),
        result: summary.result.name(),
        verdict: summary.verdict.clone(),
        accepted,
        ended_ms: u64::try_from(ended.as_millisecond()).unwrap_or_default(),
    })
}

/// Returns the folders of the active runs in the folder `runs`. A run is active if a cell listens for orders at the
/// control socket in the run folder.
pub(super) fn live_runs(runs: &Path) -> impl Iterator<Item = PathBuf> {
    control::folders(runs).filter(|folder| is_live(folder))
}

/// Returns the name of a run: the name of its folder.
pub(super) fn name(folder: &Path) -> String {
    folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}
