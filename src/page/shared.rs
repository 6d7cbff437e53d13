//! State of the page of a cell, which all its handlers share.

use std::path::Path;
use std::sync::Arc;

use super::guard::Guard;
use super::history::History;
use super::live::RunWatcher;
use super::viewers::Viewers;

/// Function that returns the planned points of a run in touching order: x and y in millimetres, model frame.
pub type PlannedPoints = dyn Fn(&Path) -> Option<Vec<[f64; 2]>> + Send + Sync;

/// Page of a cell with its state.
pub struct Page {
    pub(crate) guard: Arc<Guard>,
    pub(crate) run_watcher: RunWatcher,
    pub(crate) history: Arc<History>,
    pub(crate) planned: Box<PlannedPoints>,
    pub(crate) viewers: Viewers,
    /// Name of the run that the first page shows; None for the active run, or for the list if more than one is active.
    pub(crate) first_run: Option<String>,
}

/// State that all request handlers share.
pub(crate) type Shared = Arc<Page>;
