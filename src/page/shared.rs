//! State of the page of a cell, which all its handlers share.

use std::path::Path;
use std::sync::Arc;

use tokio::sync::Semaphore;

use super::guard::Guard;
use super::history::History;
use super::live::RunWatcher;
use super::viewers::Viewers;
use super::workbench::state::Workbench;

/// Source of what a run folder says of its run only together with the planning of Regrind. Each function takes the
/// folder of the run, and returns `None` if the recipe, the cell file or the first record is missing or invalid.
pub trait RunPlan: Send + Sync {
    /// Returns the planned points in touching order: x and y in millimetres, model frame.
    fn points(&self, folder: &Path) -> Option<Vec<[f64; 2]>>;

    /// Returns the path of the wheel in a pass: x and y of its centre in millimetres, model frame, and the share of the
    /// path that ends there, 0 to 1. A point that is not finite begins a new track. Returns `None` also if the path is
    /// planned by the grinder.
    fn path(&self, folder: &Path) -> Option<Vec<[f64; 3]>>;

    /// Returns what the cell file and the recipe say of the machines.
    fn equipment(&self, folder: &Path) -> Option<Equipment>;
}

/// Statements of a cell file and of a recipe about the machines.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Equipment {
    /// Day on which the calibration of the CMM, and that of the grinder, must be repeated.
    pub calibration_due: [Option<String>; 2],
    /// Radius of the probe, in millimetres.
    pub probe_radius_mm: f64,
    /// Maximum error of the probe's radius on the reference sphere, in micrometres; `None` if the sphere is not touched.
    pub radius_tolerance_um: Option<f64>,
    /// Radius of the wheel in the recipe, in millimetres; `None` if the recipe has no such wheel.
    pub wheel_radius_mm: Option<f64>,
}

/// Page of a cell with its state.
pub struct Page {
    pub(crate) guard: Arc<Guard>,
    pub(crate) run_watcher: RunWatcher,
    pub(crate) history: Arc<History>,
    pub(crate) plan: Box<dyn RunPlan>,
    pub(crate) viewers: Viewers,
    /// Workbench of the process engineer; `None` if the page has no folder of recipes.
    pub(crate) workbench: Option<Workbench>,
    /// Permits for streams of events to programs.
    pub(crate) streams: Arc<Semaphore>,
    /// Name of the run that the first page shows; None for the active run, or for the list if more than one is active.
    pub(crate) first_run: Option<String>,
}

/// Maximum number of streams of events to programs at a time.
pub(crate) const MAX_STREAMS: usize = 32;

/// State that all request handlers share.
pub(crate) type Shared = Arc<Page>;
