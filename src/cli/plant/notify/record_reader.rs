//! Reader of the records of all runs in a folder, also while they are written. It opens them for reading only.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use regrind::journal::{JournalError, Reader, Stamp, is_driven, stamp};
use regrind_notify::Notification;

use super::super::super::control;
use super::progress::Progress;
use super::record_events::RecordEvents;

/// Reader of the records in a folder of runs.
pub(super) struct RecordReader {
    runs: PathBuf,
    cell: String,
    progress: Progress,
    known: HashMap<PathBuf, KnownRun>,
}

/// Run of which records were read.
struct KnownRun {
    /// Stamp of the files before all records were read; `None` if some could not be read.
    stamp: Option<Stamp>,
    /// Number of the next record.
    next: u64,
    events: RecordEvents,
    /// True if it was told that the states of this run are not known.
    is_unclear: bool,
}

/// Finding for the terminal.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Finding {
    /// The states of this run cannot be known from its record.
    Unclear { run: String },
    /// The list of what was read cannot be written.
    DiskFails { reason: String },
}

impl RecordReader {
    /// Returns a reader of the runs in the folder `runs` of the cell named `cell`, which goes on from `progress`.
    pub(super) fn new(runs: &Path, cell: &str, progress: Progress) -> Self {
        Self { runs: runs.to_owned(), cell: cell.to_owned(), progress, known: HashMap::new() }
    }

    /// Reads the new records of all runs, and gives each new notification to `push`, which returns when it is on disk.
    /// Returns what a person should know.
    pub(super) fn read_new(&mut self, mut push: impl FnMut(&Notification)) -> Vec<Finding> {
        let folders: Vec<_> = control::folders(&self.runs).collect();
        self.known.retain(|folder, _| folders.contains(folder));
        let mut findings = Vec::new();
        for folder in folders {
            self.read_run(&folder, &mut push, &mut findings);
        }
        findings
    }

    fn read_run(&mut self, folder: &Path, push: &mut impl FnMut(&Notification), findings: &mut Vec<Finding>) {
        let now = stamp(folder);
        let is_old = |at| self.progress.is_too_old(at);
        let mut run = match self.known.remove(folder) {
            Some(run) if run.events.is_over && run.stamp.is_some_and(|read| read.has_same_files(&now)) => {
                self.known.insert(folder.to_owned(), run);
                return;
            }
            Some(run) => run,
            // Nothing in it is new enough.
            None if now.changed_at().is_none_or(|at| Timestamp::try_from(at).is_ok_and(is_old)) => return,
            None => {
                let events = RecordEvents::new(&self.cell);
                KnownRun { stamp: None, next: 0, events, is_unclear: false }
            }
        };
        if run.stamp != Some(now) {
            // A record that cannot be read now is read at the next look.
            run.stamp = self.read_records(folder, &mut run, push, findings).is_ok().then_some(now);
        } else if !is_driven(folder) && stamp(folder) == now {
            // The files have not changed for seconds, so a reader would see the end.
            self.interrupted(&run, push, findings);
        }
        self.known.insert(folder.to_owned(), run);
    }

    /// Reads the records of `run` from the next one on.
    fn read_records(
        &mut self,
        folder: &Path,
        run: &mut KnownRun,
        push: &mut impl FnMut(&Notification),
        findings: &mut Vec<Finding>,
    ) -> Result<(), JournalError> {
        for record in Reader::open(folder)?.records(run.next) {
            let record = record?;
            run.next = record.seq + 1;
            let found = run.events.add_record(&record);
            if run.events.run.is_empty() || run.events.is_recovery {
                continue;
            }
            let mut progress = self.progress.of_run(&run.events.run);
            let is_new = record.utc.parse().is_ok_and(|at| !self.progress.is_too_old(at));
            if let Some(found) = found.filter(|_| is_new && !progress.is_over && record.seq > progress.record) {
                push(&found);
                progress.record = record.seq;
            }
            progress.is_over |= run.events.is_over;
            self.note(&run.events.run, progress, findings);
        }
        if !run.events.has_states() && !run.events.is_over && !run.events.is_recovery && !run.is_unclear && run.next > 0
        {
            run.is_unclear = true;
            findings.push(Finding::Unclear { run: run.events.run.clone() });
        }
        Ok(())
    }

    /// Notifies that the program of `run` has gone, if the record has no end. Each interruption is notified once.
    fn interrupted(&mut self, run: &KnownRun, push: &mut impl FnMut(&Notification), findings: &mut Vec<Finding>) {
        let events = &run.events;
        let Some((last, utc)) = &events.last else { return };
        let is_new = utc.parse().is_ok_and(|at| !self.progress.is_too_old(at));
        let mut progress = self.progress.of_run(&events.run);
        if events.is_over || events.is_recovery || progress.is_over || !is_new || progress.interrupted == *last {
            return;
        }
        if let Some(found) = events.interrupted() {
            push(&found);
            progress.interrupted = *last;
            self.note(&events.run, progress, findings);
        }
    }

    fn note(&mut self, run: &str, progress: super::progress::RunProgress, findings: &mut Vec<Finding>) {
        if let Err(error) = self.progress.note(run, progress) {
            findings.push(Finding::DiskFails { reason: error.to_string() });
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use regrind::report::run_summary;
    use regrind_notify::EventKind;

    use super::*;

    /// Returns a folder with runs of earlier versions, and a list by which none of their events is too old.
    fn runs() -> (tempfile::TempDir, PathBuf) {
        let home = tempfile::tempdir().unwrap();
        for run in ["table-9", "table-10", "table-12", "figures", "recovery"] {
            let (from, to) = (Path::new("tests/records").join(run), home.path().join("runs").join(run));
            fs::create_dir_all(&to).unwrap();
            for file in ["journal.sqlite", "journal.anchor"] {
                fs::copy(Path::new(env!("CARGO_MANIFEST_DIR")).join(&from).join(file), to.join(file)).unwrap();
            }
        }
        let folder = home.path().join("plant.notify");
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("read"), "2000-01-01T00:00:00Z\n").unwrap();
        (home, folder)
    }

    #[test]
    fn every_event_on_record_is_notified_once() {
        let (home, folder) = runs();
        let runs = home.path().join("runs");
        let read = |reader: &mut RecordReader| {
            let mut found = Vec::new();
            reader.read_new(|notification| found.push(notification.clone()));
            found
        };
        let mut reader = RecordReader::new(&runs, "cell-1", Progress::open(&folder).unwrap().unwrap());
        let found = read(&mut reader);
        for run in ["table-9", "table-10", "table-12", "figures"] {
            let summary = run_summary(&runs.join(run)).unwrap();
            let of_run: Vec<_> = found.iter().filter(|one| one.run == summary.run).collect();
            let count = |event| of_run.iter().filter(|one| one.event == event).count();
            let ended =
                of_run.iter().filter(|one| [EventKind::Stopped, EventKind::Aborted].contains(&one.event)).count();
            assert_eq!(
                (count(EventKind::Started), count(EventKind::Alarm), ended),
                (1, summary.alarms.len(), 1),
                "{run}"
            );
            assert!(of_run.iter().is_sorted_by_key(|one| one.record), "{run}");
            assert!(of_run.iter().all(|one| one.simulation == Some(summary.simulation)), "{run}");
            let end = of_run.last().unwrap();
            assert!(
                end.text.contains(end.reason.as_ref().unwrap())
                    && summary.verdict.contains(end.reason.as_ref().unwrap())
            );
        }
        let name = run_summary(&runs.join("recovery")).unwrap().run;
        assert!(found.iter().all(|one| one.run != name), "a recovery makes no part");
        assert!(read(&mut reader).is_empty());
        drop(reader);
        let mut again = RecordReader::new(&runs, "cell-1", Progress::open(&folder).unwrap().unwrap());
        assert!(read(&mut again).is_empty(), "a restart repeats nothing");
    }
}
