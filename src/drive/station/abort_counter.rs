//! Number of ordered and handled aborts, so that an abort gives up the request in progress.

use tokio::sync::watch;

/// Number of aborts that were ordered and handled. The drive counts an abort before it sends the request; the station
/// counts an abort when it receives the request.
pub(in super::super) struct AbortCounter {
    ordered_count: watch::Receiver<u64>,
    pub(super) handled_count: u64,
}

impl AbortCounter {
    pub(in super::super) fn new(ordered: watch::Receiver<u64>) -> Self {
        Self { ordered_count: ordered, handled_count: 0 }
    }

    /// Waits until an abort is ordered that this station (the task of one machine) has not yet handled. Never returns
    /// if no sender is left that could order one.
    pub(super) async fn wait_for_abort(&mut self) {
        let taken = self.handled_count;
        if self.ordered_count.wait_for(|ordered| *ordered > taken).await.is_err() {
            // No sender is left that could order an abort.
            std::future::pending::<()>().await;
        }
    }
}
