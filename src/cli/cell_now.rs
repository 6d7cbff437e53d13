//! How the cell is whose runs lie in a folder: which run is on, which was left, and how the last one ended. It is told to others as it is found.
//!
//! The run that counts is the one on whose record something stands last: a folder may be looked into, copied or made by anybody.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use regrind::drive::Request;
use regrind::journal::{DATABASE, Reader, Stamp, is_driven, stamp};
use regrind::report::{RunResult, RunSummary, run_summary};
use regrind_live::{Ended, Now, Told};

use super::control;

/// How long a run may be at its beginning or its end, or silent, before it is told that it does not answer.
const GRACE: Duration = Duration::from_secs(5);

/// Looks at the runs in a folder, time and again.
pub(super) struct Look {
    runs: PathBuf,
    told: Told,
    /// The run that does not answer, and since when.
    silent: Option<(PathBuf, Instant)>,
    /// When something was put on the record of each run last, as its files stood then; none for what is no run.
    known: HashMap<PathBuf, (Stamp, Option<Timestamp>)>,
    /// The run that counted last, as its files stood then: it needs no second look.
    settled: Option<(PathBuf, Stamp)>,
}

impl Look {
    pub(super) fn new(runs: &Path) -> Self {
        Self { runs: runs.to_owned(), told: Told::default(), silent: None, known: HashMap::new(), settled: None }
    }

    /// Returns how the cell is; where that cannot be seen just now, as it was.
    pub(super) fn now(&mut self) -> &Told {
        let live = control::live_runs(&self.runs).next();
        match live {
            Some(run) => match regrind_control::ask(&run, &Request::Status) {
                Ok(reply) => {
                    self.silent = None;
                    self.told.now = Now::On { run: name(&run), snapshot: Box::new(reply.status) };
                }
                Err(_) => self.does_not_answer(run),
            },
            None => self.by_the_records(),
        }
        &self.told
    }

    /// Looks once more, on a thread of its own: a record is long, and a run may not answer.
    pub(super) async fn again(mut self) -> Self {
        let runs = self.runs.clone();
        let looked = tokio::task::spawn_blocking(move || {
            self.now();
            self
        });
        looked.await.unwrap_or_else(|_| Self::new(&runs))
    }

    /// Returns what was found last.
    pub(super) fn told(&self) -> &Told {
        &self.told
    }

    /// Takes over how the run is that is on, which somebody else has heard.
    pub(super) fn heard(&mut self, now: Now) {
        (self.told.now, self.silent) = (now, None);
    }

    fn does_not_answer(&mut self, run: PathBuf) {
        let since = match self.silent.take() {
            Some((silent, since)) if silent == run => since,
            _ => Instant::now(),
        };
        if since.elapsed() > GRACE {
            self.told.now = Now::Silent { run: name(&run) };
        }
        self.silent = Some((run, since));
    }

    /// No run listens: one may have begun or ended just now, was left, or is over.
    fn by_the_records(&mut self) {
        let folders: Vec<PathBuf> = control::folders(&self.runs).collect();
        self.known.retain(|run, _| folders.contains(run));
        if folders.is_empty() {
            (self.told, self.silent) = (Told::default(), None);
            return;
        }
        if let Some(begins) = folders.iter().find(|run| !run.join(DATABASE).is_file() && is_driven(run)) {
            return self.does_not_answer(begins.clone());
        }
        let last = folders.iter().filter_map(|run| Some((self.last_recorded(run)?, run))).max();
        let Some((_, run)) = last else {
            // Folders in which nothing stands are no runs; one that cannot be read is one of which nothing is known.
            match folders.iter().find(|run| run.join(DATABASE).is_file() && !self.known.contains_key(*run)) {
                Some(run) if is_driven(run) => self.does_not_answer(run.clone()),
                Some(run) => {
                    (self.told.now, self.silent) = (Now::Gone { run: name(run), machines_within: false }, None)
                }
                None => (self.told.now, self.silent) = (Now::NoRun, None),
            }
            return;
        };
        let at = stamp(run);
        if self.settled.as_ref().is_some_and(|(settled, then)| settled == run && *then == at)
            && !matches!(self.told.now, Now::On { .. } | Now::Silent { .. })
        {
            return;
        }
        match run_summary(run) {
            Ok(RunSummary { ended: Some(_), result, verdict, .. }) => {
                let accepted = result == RunResult::Accepted;
                self.told = Told { now: Now::NoRun, last: Some(Ended { run: name(run), verdict, accepted }) };
            }
            Ok(_) if is_driven(run) => return self.does_not_answer(run.clone()),
            Ok(RunSummary { machines_within, .. }) => self.told.now = Now::Gone { run: name(run), machines_within },
            // It cannot be read just now.
            Err(_) => return,
        }
        (self.settled, self.silent) = (Some((run.clone(), at)), None);
    }

    /// When something was put on the record of a run last; none for what is no run of a part, and what cannot be read.
    fn last_recorded(&mut self, run: &Path) -> Option<Timestamp> {
        let at = stamp(run);
        if let Some((_, last)) = self.known.get(run).filter(|(then, _)| *then == at) {
            return *last;
        }
        // To look makes no journal where there is none.
        let reader = Reader::open(run).ok()?;
        let first = reader.records(0).next()?.ok()?;
        let last = reader.last().ok()??.utc.parse().ok()?;
        let last = (first.value()["content"]["recover"] != true).then_some(last);
        self.known.insert(run.to_owned(), (at, last));
        last
    }
}

/// What a run is called.
pub(super) fn name(folder: &Path) -> String {
    folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}
