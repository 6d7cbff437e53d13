//! State that is shown to people: the published snapshot, the notices, and what they contain besides the cell.

use regrind_control::Snapshot;
use tokio::sync::{mpsc, watch};

use super::notice::Notice;
use super::preview::PreviewAccumulator;
use super::progress_estimator::ProgressEstimator;

/// State that is shown to people.
pub(super) struct Display {
    pub(super) status: watch::Sender<Snapshot>,
    pub(super) notices: mpsc::UnboundedSender<Notice>,
    pub(super) progress_estimator: ProgressEstimator,
    pub(super) preview_statistics: PreviewAccumulator,
    /// Number of changes of state of the cell.
    pub(super) state_changes: u64,
}

impl Display {
    /// Creates the display of a run with the channels for snapshots and notices. `state_changes` are those of an
    /// interrupted program.
    pub(super) fn new(
        status: watch::Sender<Snapshot>,
        notices: mpsc::UnboundedSender<Notice>,
        state_changes: u64,
    ) -> Self {
        let (progress_estimator, preview_statistics) = (ProgressEstimator::default(), PreviewAccumulator::default());
        Self { status, notices, progress_estimator, preview_statistics, state_changes }
    }
}
