//! Ends of runs, from their records. Each end is published once, also if nobody saw the run alive, and also if the run
//! ended while this program did not run.

use std::collections::{HashMap, HashSet};
use std::io;
use std::path::{Path, PathBuf};

use jiff::{SignedDuration, Timestamp};
use regrind::formats::LineFile;
use regrind::journal::{Reader, RecordKind, Stamp, stamp};
use regrind::report::{RunResult, RunSummary, run_summary};
use regrind_cell::{CycleRow, StateName};
use regrind_control::{NextStep, PartVerdict, Snapshot};
use regrind_live::EndedRun;

use super::super::super::control;
use super::super::cell_monitor::{ended_run, name};

/// Age up to which an end is published when this cell is published for the first time. The run that starts this program
/// can end before this program is ready.
const FIRST_LOOK_BACK: SignedDuration = SignedDuration::from_mins(10);

/// Ends of the runs in a folder that are not yet published.
pub(super) struct RunEnds {
    runs: PathBuf,
    /// File with the earliest time, and the names of the runs whose ends were published.
    file: LineFile,
    /// Earlier ends are not published.
    since: Timestamp,
    published: HashSet<String>,
    /// Last run whose end was published, or is too old for that.
    last: Option<EndedRun>,
    /// Runs without an end, with the stamp of their files when this was read.
    open: HashMap<PathBuf, Stamp>,
}

/// End of a run, as its record tells it.
pub(super) struct RunEnd {
    pub(super) run: EndedRun,
    /// Last state of the cell, without what the record does not tell.
    pub(super) snapshot: Snapshot,
}

impl RunEnds {
    /// Opens the list of published ends in the file `path`, or begins it, for the runs in the folder `runs`.
    ///
    /// # Errors
    /// The file cannot be read or written.
    pub(super) fn open(runs: &Path, path: PathBuf) -> io::Result<Self> {
        let mut file = LineFile::at(path);
        let lines: Vec<_> = file.lines()?.iter().map(|line| String::from_utf8_lossy(line).into_owned()).collect();
        let since = lines.first().and_then(|first| first.parse().ok());
        let since: Timestamp = since.unwrap_or_else(|| Timestamp::now() - FIRST_LOOK_BACK);
        let names = lines.get(1..).unwrap_or_default();
        let last = names.last().map(|run| runs.join(run));
        let last = last.and_then(|run| ended_run(&run, &run_summary(&run).ok()?));
        let published = names.iter().cloned().collect();
        file.write_anew(&[&[since.to_string()], names].concat())?;
        Ok(Self { runs: runs.to_owned(), file, since, published, last, open: HashMap::new() })
    }

    /// Returns the last run whose end is no news: it was published, or is too old for that. Returns `None` if there is
    /// none.
    pub(super) fn last(&self) -> Option<&EndedRun> {
        self.last.as_ref()
    }

    /// Returns the ends that were not published yet, in the order of their times. Call [`Self::published`] for each.
    pub(super) fn find(&mut self) -> Vec<RunEnd> {
        let folders: Vec<_> = control::folders(&self.runs).filter(|run| !self.is_published(&name(run))).collect();
        self.open.retain(|run, _| folders.contains(run));
        let mut ends: Vec<_> = folders.iter().filter_map(|run| self.end_of(run)).collect();
        ends.sort_by_key(|end| end.run.ended_ms);
        ends
    }

    /// Returns true if the end of the run with the name `run` was published.
    pub(super) fn is_published(&self, run: &str) -> bool {
        self.published.contains(run)
    }

    /// Notes that the end of the run `run` was published.
    ///
    /// # Errors
    /// The file cannot be written. The end is possibly published again after the end of this program.
    pub(super) fn published(&mut self, run: &EndedRun) -> io::Result<()> {
        let name = run.run.clone();
        self.last = Some(run.clone());
        let earlier = self.published.iter().filter(|other| **other != name);
        let written = match self.file.is_open() {
            true => self.file.append(&name),
            false => {
                // The last line is the last run.
                let lines = std::iter::once(self.since.to_string()).chain(earlier.cloned());
                self.file.write_anew(&lines.chain([name.clone()]).collect::<Vec<_>>())
            }
        };
        self.published.insert(name);
        written
    }

    fn end_of(&mut self, run: &Path) -> Option<RunEnd> {
        let at = stamp(run);
        if self.open.get(run).is_some_and(|then| *then == at) {
            return None;
        }
        // Reading does not create a journal.
        let has_end = Reader::open(run).ok().and_then(|reader| reader.last().ok()?);
        let summary = has_end.filter(|last| last.kind == RecordKind::End).and_then(|_| run_summary(run).ok());
        let end = summary.and_then(|summary| Some((ended_run(run, &summary)?, summary)));
        let Some((ended, summary)) = end else {
            self.open.insert(run.to_owned(), at);
            return None;
        };
        // A copy of a folder is no other run.
        let is_old = i64::try_from(ended.ended_ms).is_ok_and(|ended_ms| ended_ms < self.since.as_millisecond());
        if is_old || self.is_published(&summary.run) {
            self.published.insert(ended.run.clone());
            if is_old && self.last.as_ref().is_none_or(|last| last.ended_ms < ended.ended_ms) {
                self.last = Some(ended);
            }
            return None;
        }
        Some(RunEnd { snapshot: last_snapshot(&summary), run: ended })
    }
}

/// Returns the state of a cell at the end of the run with the summary `summary`.
fn last_snapshot(summary: &RunSummary) -> Snapshot {
    let state = match summary.result {
        RunResult::Accepted => StateName::Complete,
        RunResult::Aborted => StateName::Aborted,
        _ => StateName::Stopped,
    };
    let active = summary.alarms.iter().filter(|alarm| alarm.withdrawn.is_none());
    Snapshot {
        simulation: summary.simulation,
        part: summary.name.clone(),
        serial: summary.part.clone(),
        state,
        message: summary.verdict.clone(),
        verdict: PartVerdict::from_state(state),
        cycle: summary.cycles.last().map_or(0, |cycle| cycle.cycle),
        tolerance: summary.tolerance,
        cycles: rows(summary),
        alarms: active.map(|alarm| alarm.alarm.clone()).collect(),
        next_step: NextStep::ReadReport,
        next: NextStep::ReadReport.to_string(),
        ..Snapshot::default()
    }
}

fn rows(summary: &RunSummary) -> Vec<CycleRow> {
    let rows = summary.cycles.iter().filter_map(|cycle| {
        let [[pv_um, _], [rms_um, _]] = cycle.figures?;
        Some(CycleRow {
            cycle: cycle.cycle,
            pv_um,
            judged_pv_um: None,
            rms_um,
            judged_rms_um: None,
            points: 0,
            outliers: 0,
            level_um: 0.0,
        })
    });
    rows.collect()
}

impl RunEnd {
    /// Keeps the rows of `live`, the last snapshot from the program of this run, for cycles with the same figures: they
    /// tell more than the record.
    pub(super) fn keep_rows_of(&mut self, live: &Snapshot) {
        for row in &mut self.snapshot.cycles {
            let same = |other: &&CycleRow| other.cycle == row.cycle && other.judged_um() == row.judged_um();
            if let Some(known) = live.cycles.iter().find(same) {
                row.clone_from(known);
            }
        }
    }
}
