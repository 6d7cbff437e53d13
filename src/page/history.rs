//! List of the runs in a folder. The summary of a run is cached until its record changes.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use regrind_control::is_live;
use regrind_report::{RecordStamp, RunSummary, has_record, record_stamp, run_summary};

pub(crate) struct History {
    runs: PathBuf,
    read: Mutex<HashMap<PathBuf, (RecordStamp, Arc<RunSummary>)>>,
}

/// Run in the list.
#[derive(Clone)]
pub(crate) struct Listed {
    /// Name of the run folder.
    pub(crate) id: String,
    pub(crate) is_live: bool,
    pub(crate) summary: Arc<RunSummary>,
}

impl History {
    pub(crate) fn new(runs: PathBuf) -> Self {
        Self { runs, read: Mutex::default() }
    }

    /// Returns the folder of all runs.
    pub(crate) fn home(&self) -> &Path {
        &self.runs
    }

    /// Returns the folder of the run named `id`. Returns `None` if there is no such run. Also returns `None` if `id` is
    /// not a plain folder name, for example if it contains a slash or begins with a dot. Such a name could give access
    /// to files outside the folder of all runs.
    pub(crate) fn folder(&self, id: &str) -> Option<PathBuf> {
        let plain = !id.is_empty() && !id.starts_with('.') && !id.contains(['/', '\\', '\0', ':']);
        let folder = self.runs.join(id);
        (plain && has_record(&folder)).then_some(folder)
    }

    /// Returns the folders of the active runs: a program drives each of them. Blocks while it reads the disk.
    pub(crate) fn live(&self) -> Vec<PathBuf> {
        self.ids().filter_map(|id| self.folder(&id)).filter(|folder| is_live(folder)).collect()
    }

    /// Returns the folder of a run, if there is one. Blocks while it reads the disk.
    pub(crate) fn first(&self) -> Option<PathBuf> {
        self.ids().find_map(|id| self.folder(&id))
    }

    fn ids(&self) -> impl Iterator<Item = String> + use<> {
        let folders = std::fs::read_dir(&self.runs).into_iter().flatten().filter_map(Result::ok);
        folders.filter_map(|entry| entry.file_name().into_string().ok())
    }

    /// Lists the runs: active runs first, then from the newest to the oldest. Blocks while it reads the disk.
    pub(crate) fn list(&self) -> Vec<Listed> {
        let (mut all, _) = self.all();
        all.sort_by(|a, b| (b.is_live, &b.summary.began, &b.id).cmp(&(a.is_live, &a.summary.began, &a.id)));
        all
    }

    /// Returns all runs in no order, and the names of those whose record cannot be read in alphabetical order. Blocks while
    /// it reads the disk.
    pub(crate) fn all(&self) -> (Vec<Listed>, Vec<String>) {
        let (mut listed, mut unreadable) = (Vec::new(), Vec::new());
        for id in self.ids() {
            let Some(folder) = self.folder(&id) else { continue };
            match self.summary(&folder) {
                Some(summary) => listed.push(Listed { is_live: is_live(&folder), summary, id }),
                None => unreadable.push(id),
            }
        }
        unreadable.sort();
        (listed, unreadable)
    }

    /// Returns the summary of the run in `folder`. If the record of the run has not changed since the last call, takes
    /// the summary from the cache. Returns `None` if the record cannot be read. Blocks while it reads the disk.
    pub(crate) fn summary(&self, folder: &Path) -> Option<Arc<RunSummary>> {
        let stamp = record_stamp(folder);
        let kept = |read: &HashMap<PathBuf, (RecordStamp, Arc<RunSummary>)>| {
            read.get(folder).filter(|(at, _)| *at == stamp).map(|(_, summary)| Arc::clone(summary))
        };
        if let Some(summary) = kept(&self.read.lock().unwrap_or_else(PoisonError::into_inner)) {
            return Some(summary);
        }
        let summary = Arc::new(run_summary(folder).ok()?);
        let mut read = self.read.lock().unwrap_or_else(PoisonError::into_inner);
        read.insert(folder.to_owned(), (stamp, Arc::clone(&summary)));
        Some(summary)
    }
}
