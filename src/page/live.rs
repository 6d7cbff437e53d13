//! Status of each run that a browser shows: one watcher for each run, independent of the number of browsers.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use regrind_cell::StateName;
use regrind_control::{PreliminaryTouches, Request, Snapshot, send_request, watch};
use regrind_report::{AlarmHistory, HoldOrder, RunResult, RunSummary};
use tokio::sync::watch::{Receiver, Sender};
use tokio::task::{JoinHandle, spawn_blocking};

use super::history::History;

/// Interval between two attempts to connect to the program of a run that does not answer.
const BETWEEN_TRIES: Duration = Duration::from_secs(1);

/// Time for which a run is watched after the last browser has left. A page that is loaded again finds its status, and
/// the cell is not asked for a new connection each time.
const LINGERS: Duration = Duration::from_secs(5);

/// Interval between two looks at the record while people may say something that changes no state.
const READ_AGAIN_AFTER: Duration = Duration::from_millis(500);

/// Current knowledge about a run.
#[derive(Clone, Default)]
pub(crate) struct ObservedRun {
    /// Last snapshot from the program of the run; `None` if there was none.
    pub(crate) snapshot: Option<Arc<Snapshot>>,
    /// True if the program answers.
    pub(crate) answers: bool,
    pub(crate) summary: Arc<RunSummary>,
    /// Preliminary touches of the measurement that runs; empty if none runs.
    pub(crate) touches: Arc<PreliminaryTouches>,
    /// Time at which the last snapshot came; `None` if there was none.
    pub(crate) snapshot_at: Option<Instant>,
}

impl ObservedRun {
    /// Returns true if the run is lost: its record has no end, and no program answers for it. The state of the machines
    /// is then unknown.
    pub(crate) fn is_lost(&self) -> bool {
        !self.answers && self.summary.ended.is_none()
    }
}

/// Status of each watched run, by the folder of the run.
type WatchedRuns = Arc<Mutex<HashMap<PathBuf, Sender<ObservedRun>>>>;

pub(crate) struct RunWatcher {
    history: Arc<History>,
    watched: WatchedRuns,
}

impl RunWatcher {
    pub(crate) fn new(history: Arc<History>) -> Self {
        Self { history, watched: WatchedRuns::default() }
    }

    /// Returns a receiver of the current status of the run in `folder` and of its changes. Starts a watcher for this
    /// run if there is none.
    pub(crate) fn subscribe(self: &RunWatcher, folder: &Path) -> Receiver<ObservedRun> {
        let mut watched = self.watched.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(seen) = watched.get(folder) {
            return seen.subscribe();
        }
        let (seen, looked) = tokio::sync::watch::channel(ObservedRun::default());
        watched.insert(folder.to_owned(), seen.clone());
        tokio::spawn(keep_watching(folder.to_owned(), Arc::clone(&self.history), Arc::clone(&self.watched), seen));
        looked
    }
}

/// Sends the status of the run in `folder` to `seen` whenever it changes. `history` gives access to the records of the
/// runs. If the program of the run does not answer, reads the record and tries again after a short time. Ends some time
/// after the last receiver of `seen` is gone, and then removes the run from `watched`.
async fn keep_watching(folder: PathBuf, history: Arc<History>, watched: WatchedRuns, seen: Sender<ObservedRun>) {
    let watching = async {
        loop {
            // After any end of the connection the program can return, because another program can continue the run.
            let _ = follow(&folder, &history, &seen).await;
            let summary = read(&folder, &history).await;
            seen.send_if_modified(|now| {
                let changed = now.answers || now.summary.ended != summary.ended || now.summary.run != summary.run;
                (now.answers, now.summary) = (false, summary);
                changed
            });
            tokio::time::sleep(BETWEEN_TRIES).await;
        }
    };
    tokio::select! {
        () = watching => {}
        () = unwatched(&folder, &watched, &seen) => {}
    }
}

/// Returns when no receiver of `seen` has been left for some time. The run in `folder` is then removed from `watched`.
async fn unwatched(folder: &Path, watched: &WatchedRuns, seen: &Sender<ObservedRun>) {
    loop {
        seen.closed().await;
        tokio::time::sleep(LINGERS).await;
        // A new receiver subscribes under the same lock.
        let mut watched = watched.lock().unwrap_or_else(PoisonError::into_inner);
        if seen.receiver_count() == 0 {
            watched.remove(folder);
            return;
        }
    }
}

/// Connects to the program of the run in `folder` and waits for its snapshots. Sends each changed status to `seen`.
/// `history` supplies the summary of the record. Returns `Ok` when the program ends the connection.
///
/// # Errors
/// The program cannot be reached, or the connection fails.
async fn follow(folder: &Path, history: &Arc<History>, seen: &Sender<ObservedRun>) -> std::io::Result<()> {
    let mut watch = watch(folder).await?;
    let mut read_at = None;
    let mut reading = None;
    let mut may_be_told = false;
    loop {
        let next = {
            let mut next = pin!(watch.next());
            loop {
                // The record has what people say only after the state that this belongs to, and with no state of its own.
                tokio::select! {
                    next = &mut next => break next?,
                    () = tokio::time::sleep(READ_AGAIN_AFTER), if may_be_told => {
                        let summary = read(folder, history).await;
                        seen.send_if_modified(|now| {
                            let changed = told_by_people(&now.summary) != told_by_people(&summary);
                            now.summary = summary;
                            changed
                        });
                    }
                }
            }
        };
        let Some(snapshot) = next else { return Ok(()) };
        // Measurements, judgements and alarms always come with a new state. The reason of a hold and the acknowledgement
        // of an alarm do not.
        let at = (snapshot.state_number, snapshot.cycles.len());
        may_be_told = matches!(snapshot.state, StateName::Holding | StateName::Held) || !snapshot.alarms.is_empty();
        let summary = match read_at {
            Some(before) if before == at && !may_be_told => Arc::clone(&seen.borrow().summary),
            _ => read(folder, history).await,
        };
        read_at = Some(at);
        let known = Arc::clone(&seen.borrow().touches);
        let touches = newer_touches(folder, known, &snapshot, &mut reading).await;
        let snapshot = Some(Arc::new(snapshot));
        seen.send_if_modified(|now| {
            let changed =
                now.snapshot != snapshot || !now.answers || told_by_people(&now.summary) != told_by_people(&summary);
            *now = ObservedRun { snapshot, answers: true, summary, touches, snapshot_at: Some(Instant::now()) };
            changed
        });
    }
}

/// Returns what people have said about the present state: the reason of a hold, and acknowledgements of alarms.
fn told_by_people(summary: &RunSummary) -> (Option<&HoldOrder>, &[AlarmHistory]) {
    (summary.hold.as_ref(), &summary.alarms)
}

/// Task that asks the cell for further touches.
type TouchReader = JoinHandle<Option<PreliminaryTouches>>;

/// Returns the touches of the measurement of `snapshot`: those that are `known`, with the answer of the task `reading`
/// if it has come. Starts this task again for the next answer. A cell that answers slowly delays nothing. After the
/// measurement, the touches stay until the next cycle.
async fn newer_touches(
    folder: &Path,
    known: Arc<PreliminaryTouches>,
    snapshot: &Snapshot,
    reading: &mut Option<TouchReader>,
) -> Arc<PreliminaryTouches> {
    let measured = snapshot.preview.map_or(0, |preview| preview.touch_count as usize);
    let mut touches = if is_of_measurement(&known, snapshot.cycle, measured) { known } else { Arc::default() };
    if reading.as_ref().is_some_and(TouchReader::is_finished)
        && let Some(task) = reading.take()
        && let Ok(Some(newer)) = task.await
        && newer.cycle == snapshot.cycle
    {
        touches = joined(touches, newer);
    }
    let is_due = measured > 0 && (measured != touches.found_count() || snapshot.progress.is_some());
    if reading.is_none() && is_due {
        let (folder, from) = (folder.to_owned(), touches.deviations_um.len() as u32);
        let ask = move || send_request(&folder, &Request::Touches { from }).ok()?.touches;
        *reading = Some(spawn_blocking(ask));
    }
    touches
}

/// Returns true if the touches `known` belong to the present measurement of `cycle`, or to its last one while none runs.
/// `measured` is the number of touches that the cell states; it is 0 while none runs. A measurement that is repeated
/// begins anew, so the cell then states fewer touches than are known.
fn is_of_measurement(known: &PreliminaryTouches, cycle: u32, measured: usize) -> bool {
    known.cycle == cycle && (measured == 0 || measured >= known.found_count())
}

/// Joins the touches `known` with `newer` ones. Touches of another batch, or that do not follow the known ones, begin
/// anew.
fn joined(known: Arc<PreliminaryTouches>, newer: PreliminaryTouches) -> Arc<PreliminaryTouches> {
    if (known.cycle, known.batch) != (newer.cycle, newer.batch) && newer.first_index != 0 {
        return Arc::new(PreliminaryTouches {
            cycle: newer.cycle,
            batch: newer.batch,
            ..PreliminaryTouches::default()
        });
    }
    if newer.first_index == 0 {
        return Arc::new(newer);
    }
    if newer.first_index as usize != known.deviations_um.len() || newer.deviations_um.is_empty() {
        return known;
    }
    let mut all = Arc::unwrap_or_clone(known);
    all.places_mm.extend(newer.places_mm);
    all.deviations_um.extend(newer.deviations_um);
    Arc::new(all)
}

async fn read(folder: &Path, history: &Arc<History>) -> Arc<RunSummary> {
    let (folder, history) = (folder.to_owned(), Arc::clone(history));
    spawn_blocking(move || history.summary(&folder)).await.ok().flatten().unwrap_or_default()
}

/// Returns true if the part of the run was accepted. Returns false if the part was not accepted, or if the run was
/// stopped or aborted. Returns `None` if the run is still open, or if its result is `RunResult::Recovery`. `seen` is
/// the current status of the run.
pub(crate) fn verdict(seen: &ObservedRun) -> Option<bool> {
    match seen.summary.result {
        RunResult::Accepted => Some(true),
        RunResult::NotAccepted | RunResult::Aborted | RunResult::Stopped => Some(false),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn touches(batch: u32, first_index: u32, um: &[f64]) -> PreliminaryTouches {
        let places_mm = um.iter().map(|um| [*um, 0.0]).collect();
        PreliminaryTouches {
            cycle: 1,
            batch,
            first_index,
            places_mm,
            deviations_um: um.iter().copied().map(Some).collect(),
        }
    }

    #[test]
    fn repeated_measurement_begins_anew() {
        let known = touches(0, 0, &[1.0, 2.0, 3.0]);
        for (cycle, measured, stays) in
            [(1, 3, true), (1, 9, true), (1, 0, true), (1, 1, false), (2, 3, false), (2, 0, false)]
        {
            assert_eq!(is_of_measurement(&known, cycle, measured), stays, "cycle {cycle}, {measured} touches");
        }
    }

    #[test]
    fn touches_join_in_their_order() {
        let known = joined(Arc::default(), touches(0, 0, &[1.0, 2.0]));
        let more = joined(known.clone(), touches(0, 2, &[3.0]));
        assert_eq!(*more, PreliminaryTouches { first_index: 0, ..touches(0, 0, &[1.0, 2.0, 3.0]) });
        // One that was answered twice, and one that skips a touch.
        assert_eq!(joined(more.clone(), touches(0, 2, &[3.0])), more);
        assert_eq!(joined(more.clone(), touches(0, 4, &[5.0])), more);
        // A new batch begins from its first touch.
        assert_eq!(joined(more.clone(), touches(1, 3, &[9.0])).deviations_um, []);
        assert_eq!(joined(more, touches(1, 0, &[9.0])).deviations_um, [Some(9.0)]);
    }
}
