//! List of what was read of each run, on disk, so that each event is notified once over restarts of the program.

use std::collections::HashMap;
use std::io;
use std::path::Path;

use jiff::{SignedDuration, Timestamp};
use regrind::formats::{LineFile, PersistentCounter, ResultFolder};
use regrind_notify::NotifyError;
use serde::{Deserialize, Serialize};

/// Age up to which an event is notified when this cell notifies for the first time. The run that starts this program can
/// have an event before this program is ready.
const FIRST_LOOK_BACK: SignedDuration = SignedDuration::from_mins(10);

/// Progress of reading the runs. Also the lock that only one program can have.
pub(super) struct Progress {
    file: LineFile,
    /// Earlier events are not notified.
    since: Timestamp,
    runs: HashMap<String, RunProgress>,
    _lock: PersistentCounter,
}

/// Progress of reading one run.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct RunProgress {
    /// Number of the last record whose event was notified.
    pub(super) record: u64,
    /// Number of the last record when the run was notified as interrupted; 0 if it was not.
    pub(super) interrupted: u64,
    /// True if the end of the run was read.
    pub(super) is_over: bool,
}

/// Line of the file.
#[derive(Serialize, Deserialize)]
struct Line {
    run: String,
    #[serde(flatten)]
    progress: RunProgress,
}

impl Progress {
    /// Takes the lock in `folder`, which is created if it does not exist, and reads the list. Returns `None` if another
    /// program has the lock.
    ///
    /// # Errors
    /// A file in the folder cannot be read or written.
    pub(super) fn open(folder: &Path) -> Result<Option<Self>, NotifyError> {
        ResultFolder::prepare(folder)?.keep();
        let failed = |source: io::Error| NotifyError::Folder { path: folder.to_owned(), source };
        let Some(lock) = PersistentCounter::lock(&folder.join("lock")).map_err(failed)? else { return Ok(None) };
        let file = LineFile::at(folder.join("read"));
        let lines: Vec<_> =
            file.lines().map_err(failed)?.into_iter().map(|line| String::from_utf8_lossy(&line).into_owned()).collect();
        let since = lines.first().and_then(|first| first.parse().ok());
        let since = since.unwrap_or_else(|| Timestamp::now() - FIRST_LOOK_BACK);
        let read = lines.iter().filter_map(|line| serde_json::from_str::<Line>(line).ok());
        let runs = read.map(|Line { run, progress }| (run, progress)).collect();
        let mut progress = Self { file, since, runs, _lock: lock };
        progress.write_anew().map_err(failed)?;
        Ok(Some(progress))
    }

    /// Returns true if events at the time `at` are too old to be notified.
    pub(super) fn is_too_old(&self, at: Timestamp) -> bool {
        at < self.since
    }

    /// Returns what was read of the run named `run`.
    pub(super) fn of_run(&self, run: &str) -> RunProgress {
        self.runs.get(run).cloned().unwrap_or_default()
    }

    /// Notes what was read of the run named `run`.
    ///
    /// # Errors
    /// The file cannot be written. Events are possibly notified again after the end of this program.
    pub(super) fn note(&mut self, run: &str, progress: RunProgress) -> io::Result<()> {
        if self.of_run(run) == progress {
            return Ok(());
        }
        let line = line(run, &progress);
        self.runs.insert(run.to_owned(), progress);
        if !self.file.is_open() || self.file.count() > 2 * self.runs.len() + 1000 {
            return self.write_anew();
        }
        self.file.append(&line)
    }

    fn write_anew(&mut self) -> io::Result<()> {
        let runs = self.runs.iter().map(|(run, progress)| line(run, progress));
        self.file.write_anew(&std::iter::once(self.since.to_string()).chain(runs).collect::<Vec<_>>())
    }
}

fn line(run: &str, progress: &RunProgress) -> String {
    let line = Line { run: run.to_owned(), progress: progress.clone() };
    // Does not fail: all keys are texts.
    serde_json::to_string(&line).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_outlives_the_program_and_is_exclusive() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join("plant.notify");
        let mut progress = Progress::open(&folder).unwrap().unwrap();
        assert!(Progress::open(&folder).unwrap().is_none());
        let since = progress.since;
        assert!(progress.is_too_old(since - SignedDuration::from_secs(1)) && !progress.is_too_old(since));
        let noted = RunProgress { record: 7, interrupted: 0, is_over: false };
        progress.note("a", RunProgress { record: 3, ..noted }).unwrap();
        progress.note("a", noted.clone()).unwrap();
        drop(progress);
        let progress = Progress::open(&folder).unwrap().unwrap();
        assert_eq!((progress.of_run("a"), progress.of_run("b")), (noted, RunProgress::default()));
        assert_eq!(progress.since, since, "what came while no program ran is not too old");
    }
}
